"""The simulated LWR4+ of the dynamic study: its models, its truth, and its logs with and without the payload.

Geometry: the calibrated column of Table 2 of Kolyubin, Shiriaev & Jubien (2019). By construction, no evidence about a
real arm: motor inertias and total friction are the published ones of another unit (Jubien, Gautier & Janot 2014); their
split between the sides, offsets and noise are chosen with Table 4 in view; the truth obeys the model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from calib.dynamics import base as bases
from calib.dynamics import drives
from calib.estimation.triangles import Triangles, absorb, empty
from calib.identification.closed_loop.controllers import pd
from calib.simulation import known_robots, lwr4plus
from calib.toolkit.chains import Chain
from calib.toolkit.recordings import FilterOptions, Recording, make_motion
from calib.toolkit.simulations import LoopController, Plant, Reference, Sensing, feed_forward, simulate
from calib.toolkit.torque_models import (
    LINK,
    MOTOR,
    Base,
    Case,
    IdentificationModel,
    TorqueRows,
    bodies_of,
    make_case,
    observe,
    standard_parameters,
    with_payload,
)
from calib.transforms import pose

PAYLOAD = "8"
# torque limits [N m]; noise is stated as their share
TORQUE = np.array([176.0, 176.0, 100.0, 100.0, 100.0, 38.0, 38.0])
FILTERS = FilterOptions(cutoff=10.0, band=2.0, clock="stamps")
# bandwidth [Hz] and damping of the controller (our choice)
BANDWIDTH, DAMPING = 8.0, 0.8
# essential parameters of the paper's Table 4: motor side, link side, bodies with the payload
MOTOR_SIDE = "Ia1 Fvm1 Fcm1 Ia2 Fvm2 Fcm2 Ia3 Fvm3 Fcm3 Fvm4 Ia5 Fvm5 Fcm5 Ia6 Fvm6 Fcm6 Ia7 Fvm7 Fcm7 offm7"
LINK_SIDE = "Fcl1 Fcl2 offl2 Fcl3 Fcl4 offl4 Fcl5 offl5 Fcl7 offl7"
BODIES = "XX2R ZZ2R MY2R XX4R ZZ4R MY4R MY5R MY6R XX8 YY8 YZ8 MY8 MZ8 M8"
TABLE_4 = (*MOTOR_SIDE.split(), *LINK_SIDE.split(), *BODIES.split())


@dataclass(frozen=True)
class Data:
    """One motion, recorded without and with the payload."""

    empty: Recording
    loaded: Recording

    def cases(self, kind: TorqueRows) -> list[Case]:
        """Return the filtered recordings, without and with the payload."""
        empty_motion = make_motion(self.empty, FILTERS)
        loaded_motion = make_motion(self.loaded, FILTERS)
        return [
            make_case("empty", empty_motion, kind, carried=()),
            make_case("loaded", loaded_motion, kind, carried=(PAYLOAD,)),
        ]


def model(
    chain: Chain, kind: TorqueRows, gravity: np.ndarray | None = None, v0: float = drives.V0
) -> IdentificationModel:
    """Return the study's model: seven links and a payload, seven drive terms each; the payload's move nothing.

    Args:
        chain: the geometry.
        kind: rows of torque: motors, joint torque sensors, or both.
        gravity: (3,) gravity in the base frame [m/s²]; None: that of the chain.
        v0: speed over which the sign of Coulomb friction is smoothed [rad/s].
    """
    position = np.array([0.0, 0.0, known_robots.truth("lwr4plus")["payload"]["r"]])
    bodies = with_payload(bodies_of(chain), pose(position=position))
    if gravity is not None:
        bodies = bodies.with_gravity(gravity)
    terms = drives.standard([" ".join(known_robots.SIDED)] * chain.n, v0)
    return IdentificationModel(bodies, (*terms, *drives.without_effect(PAYLOAD)), kind)


def true_chain() -> Chain:
    """Return the simulated arm: the calibrated column of Table 2 with the library's inertias."""
    return lwr4plus.arm(lwr4plus.table_2()[1])


def true_parameters(chain: Chain) -> np.ndarray:
    """Return the standard parameters (136,) of the simulated arm, in the order of `model` of both rows."""
    truth = known_robots.truth("lwr4plus")
    # joint by joint, as the model's terms
    drive_values = np.column_stack([truth["drives"][name] for name in known_robots.SIDED]).ravel()
    payload_drive = np.zeros(len(known_robots.SIDED))
    return np.concatenate([standard_parameters(chain), truth["payload"]["inertia"], drive_values, payload_drive])


@cache
def nominal_base(kind: TorqueRows) -> Base:
    """Return the base columns of a model, chosen on the CAD geometry."""
    return bases.find(model(lwr4plus.nominal_chain(), kind))


def record(chain: Chain, reference: Reference, seed: list[int]) -> Data:
    """Let the true arm follow a motion, empty and loaded, and log positions, motor torques and joint torques."""
    empty_recording = _record(chain, reference, False, [*seed, 0])
    loaded_recording = _record(chain, reference, True, [*seed, 1])
    return Data(empty_recording, loaded_recording)


def _record(chain: Chain, reference: Reference, loaded: bool, seed: list[int]) -> Recording:
    noise = known_robots.truth("lwr4plus")["noise"]
    values = true_parameters(chain)
    if not loaded:
        payload = slice(10 * chain.n, 10 * (chain.n + 1))
        values[payload] = 0.0
    motor_model = model(chain, MOTOR)
    plant = Plant(motor_model.bodies, motor_model.terms, values)
    run = simulate(plant, controller(plant, reference), reference, Sensing(noise["sigma_q"]), seed)
    # joint torques, in which only bodies and friction of the link side act
    link_model = model(chain, LINK)
    on_link_side = np.array([name in link_model.names for name in motor_model.names])
    regressor = link_model.regressor(run.q, run.v, run.a)
    joint_torque = np.einsum("kij,j->ki", regressor, values[on_link_side])
    rng = np.random.default_rng([*seed, 2])
    sensor = joint_torque + noise["sigma_tau_l"] * TORQUE * rng.normal(size=joint_torque.shape)
    motor = run.torque + noise["sigma_tau_m"] * TORQUE * rng.normal(size=joint_torque.shape)
    names = tuple(f"joint_{joint + 1}" for joint in range(chain.n))
    return Recording(run.t, run.measured, motor, "torque", names, tau_link=sensor)


def controller(plant: Plant, reference: Reference) -> LoopController:
    """Return a PD controller (8 Hz, damping 0.8, our choice) with feed-forward of gravity and friction."""
    omega = 2 * np.pi * BANDWIDTH
    inertia = plant.inertia_diagonal(reference.q[::500])
    without_acceleration = replace(reference, a=np.zeros_like(reference.a))
    kp = omega**2 * inertia
    kd = 2 * DAMPING * omega * inertia
    return pd(kp, kd).with_feedforward(feed_forward(plant, without_acceleration))


def collected(full: IdentificationModel, base: Base, data: Data) -> Triangles:
    """Return the filtered and decimated rows of both loads, in one triangle per torque."""
    triangles = empty(base.names, base.units, full.rows)
    for case in data.cases(full.torque_rows):
        rows = observe(full, base.kept, case, case.motion.decimator)
        for row in range(full.rows):
            triangles = absorb(triangles, rows.matrix[:, row], rows.target[:, row], row)
    return triangles

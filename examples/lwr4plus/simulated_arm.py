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
TORQUE = np.array([176.0, 176.0, 100.0, 100.0, 100.0, 38.0, 38.0])
FILTERS = FilterOptions(cutoff=10.0, band=2.0, clock="stamps")
TABLE_4 = (
    "Ia1", "Fvm1", "Fcm1", "Ia2", "Fvm2", "Fcm2", "Ia3", "Fvm3", "Fcm3", "Fvm4", "Ia5", "Fvm5", "Fcm5", "Ia6", "Fvm6",
    "Fcm6", "Ia7", "Fvm7", "Fcm7", "offm7", "Fcl1", "Fcl2", "offl2", "Fcl3", "Fcl4", "offl4", "Fcl5", "offl5", "Fcl7",
    "offl7", "XX2R", "ZZ2R", "MY2R", "XX4R", "ZZ4R", "MY4R", "MY5R", "MY6R", "XX8", "YY8", "YZ8", "MY8", "MZ8", "M8",
)  # fmt: skip


@dataclass(frozen=True)
class Data:
    """One motion, recorded without and with the payload."""

    empty: Recording
    loaded: Recording

    def cases(self, kind: TorqueRows) -> list[Case]:
        motions = [make_motion(part, FILTERS) for part in (self.empty, self.loaded)]
        return [
            make_case("empty", motions[0], kind, carried=()),
            make_case("loaded", motions[1], kind, carried=(PAYLOAD,)),
        ]


def model(
    chain: Chain, kind: TorqueRows, gravity: np.ndarray | None = None, v0: float = drives.V0
) -> IdentificationModel:
    """Return the study's model: seven links and a payload, seven drive terms each; the payload's move nothing.

    The sign of Coulomb friction is smoothed over v0 [rad/s].
    """
    bodies = with_payload(
        bodies_of(chain), pose(position=np.array([0.0, 0.0, known_robots.truth("lwr4plus")["payload"]["r"]]))
    )
    bodies = bodies if gravity is None else bodies.with_gravity(gravity)
    terms = drives.standard([" ".join(known_robots.SIDED)] * chain.n, v0)
    return IdentificationModel(bodies, (*terms, *drives.without_effect(PAYLOAD)), kind)


def true_chain() -> Chain:
    """Return the simulated arm: the calibrated column of Table 2 with the library's inertias."""
    return lwr4plus.arm(lwr4plus.table_2()[1])


def true_parameters(chain: Chain) -> np.ndarray:
    """Return the standard parameters (136,) of the simulated arm, in the order of `model` of both rows."""
    known = known_robots.truth("lwr4plus")
    sided = [known["drives"][name][joint] for joint in range(chain.n) for name in known_robots.SIDED]
    return np.concatenate([standard_parameters(chain), known["payload"]["inertia"], sided, np.zeros(7)])


@cache
def nominal_base(kind: TorqueRows) -> Base:
    """Return the base columns of a model, chosen on the CAD geometry."""
    return bases.find(model(lwr4plus.nominal_chain(), kind))


def record(chain: Chain, reference: Reference, seed: list[int]) -> Data:
    """Let the true arm follow a motion, empty and loaded, and log positions, motor torques and joint torques."""
    parts = [_record(chain, reference, loaded, [*seed, int(loaded)]) for loaded in (False, True)]
    return Data(*parts)


def _record(chain: Chain, reference: Reference, loaded: bool, seed: list[int]) -> Recording:
    noise, values = known_robots.truth("lwr4plus")["noise"], true_parameters(chain)
    whole = model(chain, MOTOR)
    if not loaded:
        values[10 * chain.n : 10 * (chain.n + 1)] = 0.0
    plant = Plant(whole.bodies, whole.terms, values)
    run = simulate(plant, controller(plant, reference), reference, Sensing(noise["sigma_q"]), seed)
    link = model(chain, LINK)
    shared = np.array([name in link.names for name in whole.names])
    tau_l = np.einsum("kij,j->ki", link.regressor(run.q, run.v, run.a), values[shared])
    rng = np.random.default_rng([*seed, 2])
    sensed = tau_l + noise["sigma_tau_l"] * TORQUE * rng.normal(size=tau_l.shape)
    motor = run.torque + noise["sigma_tau_m"] * TORQUE * rng.normal(size=tau_l.shape)
    return Recording(
        run.t, run.measured, motor, "torque", tuple(f"joint_{j + 1}" for j in range(chain.n)), tau_link=sensed
    )


def controller(plant: Plant, reference: Reference) -> LoopController:
    """Return a PD controller (8 Hz, damping 0.8, our choice) with feed-forward of gravity and friction."""
    omega, inertia = 2 * np.pi * 8.0, plant.inertia_diagonal(reference.q[::500])
    slow = replace(reference, a=0.0 * reference.a)
    return pd(omega**2 * inertia, 2 * 0.8 * omega * inertia).with_feedforward(feed_forward(plant, slow))


def collected(own: IdentificationModel, base: Base, data: Data) -> Triangles:
    """Return the filtered and decimated rows of both loads, in one triangle per torque."""
    result = empty(base.names, base.units, own.rows)
    for case in data.cases(own.torque_rows):
        rows = observe(own, base.kept, case, case.motion.decimator)
        for row in range(own.rows):
            result = absorb(result, rows.matrix[:, row], rows.target[:, row], row)
    return result

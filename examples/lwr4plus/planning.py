"""Section 5 of the LWR4+ study: time-optimal motion on the identified model, against CAD and against the truth.

Kolyubin, Shiriaev & Jubien (2019), Int. J. Adv. Manuf. Technol. 101, 243-259, eq. 29 to 32. The truth is the library's
(lwr4plus_truth.toml: geometry, drives, noise). Base parameters are fitted by weighted least squares to a simulated
motion; Proposition 1 turns them into A, B, Γ of each path. Every planned motion is then judged by the true robot: which
share of its torque limits would it really need? "CAD" is what one has without identifying: nominal geometry, the CAD's
bodies (here the true ones), motor inertias and friction of another unit, each up to 20 % off, which is how much the
paper says units differ. "with margin" keeps three standard deviations of the predicted torque. The truth is of the
identified form (no effect is hidden), so the margins are those of noise alone.

    python examples/lwr4plus/planning.py --out lwr4plus-planning [--paths 12] [--seed 0]

Some twenty seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import study_options
import study_tables

import calib
from calib import files
from calib.dynamics import base, drives
from calib.dynamics.path_dynamics import PathDynamics, of_standard
from calib.toolkit.chains import Chain, random_joints
from calib.toolkit.simulations import known_truth as truth
from calib.toolkit.torque_models import BaseModel, IdentificationModel, bodies_of, standard_parameters
from calib.trajectories.errors import BadInput
from calib.trajectories.timing.path import Path as JointPath
from calib.trajectories.timing.path import check_within, spline
from calib.trajectories.timing.path_limits import TimingLimits
from calib.trajectories.timing.profile import dense
from calib.trajectories.timing.shape import shorten
from calib.trajectories.timing.time_scaling import Timing, time_optimal

# share of the joint limits, for waypoints
REACH = 0.7
# σ of the predicted torque, kept free of its limit
SIGMAS = 3.0
# share by which drives of two units differ at most (the paper, section 6.3)
UNITS = 0.2
# duration [s], rate [Hz] and number of sines of the motion that is identified from
SECONDS, RATE, SINES = 10.0, 200.0, 20
# shares of the limits of position and velocity that it fills
POSITION_SHARE, VELOCITY_SHARE = 0.8, 0.9
# paths whose shape is optimised; timings for each; largest offset of a via point [rad]; grid of a timing
SHAPED, TIMINGS, STRAY, GRID = 3, 60, 0.3, 150


def nominal_chain() -> Chain:
    return calib.load("lwr4plus").chain


def true_chain() -> Chain:
    """Return the library's arm with the calibrated geometry, assumed to be known here."""
    chain = nominal_chain()
    values = {}
    for key, column in truth("lwr4plus")["dynamic_geometry"].items():
        for row, value in enumerate(column, 1):
            name = f"{key}{row}"
            if name in chain.names:
                values[name] = value
    return chain.with_values(values)


def true_robot(chain: Chain) -> tuple[IdentificationModel, np.ndarray]:
    """Return the model with Ia, Fv, Fc, off of every joint and its true parameters."""
    published = truth("lwr4plus")["drives"]
    offsets = np.add(published["offl"], published["offm"])
    by_joint = np.column_stack([published["Ia"], published["Fv"], published["Fc"], offsets])
    model = IdentificationModel(bodies_of(chain), drives.standard(["Ia Fv Fc off"] * chain.n))
    return model, np.concatenate([standard_parameters(chain), by_joint.ravel()])


@dataclass(frozen=True, eq=False)
class Identified:
    """Model identified from a noisy motion.

    Attributes:
        law: its path dynamics.
        model: its base parameters.
        covariance: (b, b) covariance of their estimate.
    """

    law: PathDynamics
    model: BaseModel
    covariance: np.ndarray


def training_motion(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, velocities and accelerations (N, n) of random sines that fill the limits."""
    harmonics = np.arange(1, SINES + 1)
    omega = 2 * np.pi / SECONDS * harmonics
    amplitude = rng.normal(size=(n, SINES)) / np.sqrt(harmonics)
    phase = rng.uniform(0, 2 * np.pi, (n, SINES))
    t = np.arange(0, SECONDS, 1 / RATE)[:, None, None]
    sine, cosine = np.sin(omega * t + phase), np.cos(omega * t + phase)
    q = (amplitude * sine).sum(axis=2)
    v = (amplitude * omega * cosine).sum(axis=2)
    a = -(amplitude * omega**2 * sine).sum(axis=2)
    chain = nominal_chain()
    position_scale = POSITION_SHARE * chain.upper / np.abs(q).max(axis=0)
    velocity_scale = VELOCITY_SHARE * limits(chain).velocity / np.abs(v).max(axis=0)
    scale = np.minimum(position_scale, velocity_scale)
    return scale * q, scale * v, scale * a


def identify(model: IdentificationModel, values: np.ndarray, seed: int) -> Identified:
    """Return what a noisy simulated motion identifies, by weighted least squares.

    Args:
        model: model of the true robot.
        values: (p,) its true standard parameters.
        seed: seed of motion and noise.
    """
    rng = np.random.default_rng(seed)
    q, v, a = training_motion(model.bodies.n, rng)
    sigma = truth("lwr4plus")["noise"]["sigma_tau_m"] * limits(nominal_chain()).torque
    tau = model.regressor(q, v, a) @ values + sigma * rng.normal(size=q.shape)
    base_model = BaseModel(model, base.find(model))
    W = (base_model.regressor(q, v, a) / sigma[:, None]).reshape(-1, base_model.base.b)
    y = (tau / sigma).ravel()
    estimate = np.linalg.lstsq(W, y, rcond=None)[0]
    inverse = np.linalg.inv(np.linalg.qr(W, mode="r"))
    law = of_standard(model, base_model.base.to_standard(estimate))
    return Identified(law, base_model, inverse @ inverse.T)


def guarded(path: JointPath, identified: Identified, bounds: TimingLimits) -> Timing:
    """Return the timing with a torque margin of `SIGMAS` σ per joint, the largest along the first timing."""
    sampled = time_optimal(path, bounds, identified.law).sampled
    W = identified.model.regressor(sampled.q, sampled.v, sampled.a)
    variance = np.einsum("Nib,bc,Nic->Ni", W, identified.covariance, W, optimize=True)
    sigma = np.sqrt(variance).max(axis=0)
    with_margin = replace(bounds, torque=bounds.torque - SIGMAS * sigma)
    return time_optimal(path, with_margin, identified.law)


def limits(chain: Chain) -> TimingLimits:
    """Return the limits of velocity and torque; accelerations are not limited."""
    velocity = np.array([joint.velocity for joint in chain.joints])
    effort = np.array([joint.effort for joint in chain.joints])
    return TimingLimits(velocity, np.full(chain.n, np.inf), effort)


def check_on_robot(timing: Timing, robot: PathDynamics, effort: np.ndarray) -> dict[str, float]:
    """Return what the true robot would need for a planned motion: peak share, and share of the time beyond a limit.

    Args:
        timing: the planned motion.
        robot: path dynamics of the true robot.
        effort: (n,) torque limits [N m].
    """
    sampled = dense(timing.path, timing.profile, robot.torque)
    assert sampled.tau is not None
    share = (np.abs(sampled.tau) / effort).max(axis=1)
    beyond = float(sampled.weights @ (share > 1.0) / sampled.weights.sum())
    return {"seconds": timing.duration, "peak": float(share.max()), "beyond": beyond, "active": timing.active_share}


def cad_values(values: np.ndarray, seed: int) -> np.ndarray:
    """Return what one has without identifying: the CAD's bodies, and drives of another unit.

    Args:
        values: (p,) true standard parameters.
        seed: seed of the other unit.
    """
    bodies = standard_parameters(nominal_chain())
    drive = values[len(bodies) :]
    factors = np.random.default_rng([seed, 1]).uniform(1.0 - UNITS, 1.0 + UNITS, drive.shape)
    return np.concatenate([bodies, drive * factors])


def random_waypoints(chain: Chain, rng: np.random.Generator) -> np.ndarray:
    """Return waypoints (4, n) whose spline keeps the joint limits."""
    while True:
        waypoints = REACH * random_joints(chain, 4, rng)
        with suppress(BadInput):
            check_within(spline(waypoints), chain.lower, chain.upper)
            return waypoints


def shortened(waypoints: np.ndarray, timer: Callable[[JointPath], float]) -> float:
    """Return the duration of a path after its shape was optimised, as share of that before."""
    result = shorten(waypoints, timer, evaluations=TIMINGS, stray=STRAY)
    return result.after / result.before


def summary_of(rows: list[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Return medians over the paths, and the worst peak, of every model."""
    summary = {}
    for name, first in rows[0].items():
        plans = [row[name] for row in rows]
        summary[name] = {key: _median(plans, key) for key in first}
        summary[name]["worst_peak"] = max(plan["peak"] for plan in plans)
    return summary


def _median(plans: list[dict[str, float]], key: str) -> float:
    return float(np.median([plan[key] for plan in plans]))


def run(paths: int, seed: int) -> dict[str, Any]:
    """Plan each path with every model, and check the plans on the true robot."""
    chain = true_chain()
    bounds = limits(chain)
    model, values = true_robot(chain)
    robot = of_standard(model, values)
    identified = identify(model, values, seed)
    cad_model = IdentificationModel(bodies_of(nominal_chain()), model.terms)
    cad = of_standard(cad_model, cad_values(values, seed))
    laws = {"CAD": cad, "identified": identified.law, "truth": robot}

    def duration(path: JointPath) -> float:
        return time_optimal(path, bounds, robot, grid=GRID).duration

    rng = np.random.default_rng(seed)
    rows, shaped = [], []
    for number in range(paths):
        waypoints = random_waypoints(chain, rng)
        path = spline(waypoints)
        timings = {name: time_optimal(path, bounds, law) for name, law in laws.items()}
        timings["with margin"] = guarded(path, identified, bounds)
        rows.append({name: check_on_robot(timing, robot, bounds.torque) for name, timing in timings.items()})
        if number < SHAPED:
            shaped.append(shortened(waypoints, duration))
    return {"summary": summary_of(rows), "paths": rows, "shaped": shaped, "sigmas": SIGMAS, "seed": seed}


def main() -> None:
    """Run the study from the command line."""
    arguments = study_options.read(__doc__, paths=(12, "to plan"))
    metrics = run(arguments.paths, arguments.seed)
    files.write_json(arguments.out / "metrics.json", metrics)
    study_tables.show(study_tables.planning(metrics))
    print(f"\nwritten to {arguments.out / 'metrics.json'}")


if __name__ == "__main__":
    main()

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

from dataclasses import replace
from typing import Any

import numpy as np
import study_options
import study_tables

from calib import files
from calib.dynamics import base, drives
from calib.dynamics.path_dynamics import PathDynamics, of_standard
from calib.robot import description, library
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

REACH = 0.7  # of the joint limits, for waypoints
SIGMAS = 3.0  # of the predicted torque, kept free of its limit
UNITS = 0.2  # by how much drives of two units differ at most (the paper, section 6.3)
SECONDS, RATE, SINES = 10.0, 200.0, 20  # of the motion that is identified from


def nominal() -> Chain:
    return description.read(library.path("lwr4plus"))


def true_chain() -> Chain:
    """Return the library's arm with the calibrated geometry, assumed to be known here."""
    columns = truth("lwr4plus")["dynamic_geometry"]
    names = {f"{key}{row + 1}": value for key, values in columns.items() for row, value in enumerate(values)}
    chain = nominal()
    return chain.with_values({name: value for name, value in names.items() if name in chain.names})


def true_robot(chain: Chain) -> tuple[IdentificationModel, np.ndarray]:
    """Return the model with Ia, Fv, Fc, off of every joint and its true parameters."""
    known = truth("lwr4plus")["drives"]
    offsets = np.array(known["offl"]) + np.array(known["offm"])
    amounts = np.column_stack([known["Ia"], known["Fv"], known["Fc"], offsets]).ravel()
    model = IdentificationModel(bodies_of(chain), drives.standard(["Ia Fv Fc off"] * chain.n))
    return model, np.concatenate([standard_parameters(chain), amounts])


def identified(model: IdentificationModel, values: np.ndarray, seed: int) -> tuple[PathDynamics, BaseModel, np.ndarray]:
    """Return the path dynamics identified from a noisy simulated motion, with model and covariance."""
    rng, n = np.random.default_rng(seed), model.bodies.n
    times = np.arange(0, SECONDS, 1 / RATE)[:, None, None]
    pace = 2 * np.pi / SECONDS * np.arange(1, SINES + 1)
    size, phase = rng.normal(size=(n, SINES)) / np.sqrt(np.arange(1, SINES + 1)), rng.uniform(0, 2 * np.pi, (n, SINES))
    wave, slope = np.sin(pace * times + phase), np.cos(pace * times + phase)
    q, v, a = (size * wave).sum(2), (size * pace * slope).sum(2), -(size * pace**2 * wave).sum(2)
    scale = np.minimum(0.8 * nominal().upper / np.abs(q).max(0), 0.9 * limits(nominal()).velocity / np.abs(v).max(0))
    q, v, a = scale * q, scale * v, scale * a
    sigma = truth("lwr4plus")["noise"]["sigma_tau_m"] * limits(nominal()).torque
    tau = model.regressor(q, v, a) @ values + sigma * rng.normal(size=q.shape)
    found = BaseModel(model, base.find(model))
    W = (found.regressor(q, v, a) / sigma[:, None]).reshape(-1, found.base.b)
    factor = np.linalg.qr(W, mode="r")
    fitted = np.linalg.lstsq(W, (tau / sigma).ravel(), rcond=None)[0]
    spread = np.linalg.inv(factor)
    return of_standard(model, found.base.to_standard(fitted)), found, spread @ spread.T


def guarded(
    path: JointPath, law: PathDynamics, model: BaseModel, covariance: np.ndarray, bounds: TimingLimits
) -> Timing:
    """Return the timing with a torque margin of `SIGMAS` σ per joint, the largest along the first timing."""
    sampled = time_optimal(path, bounds, law).sampled
    W = model.regressor(sampled.q, sampled.v, sampled.a)
    sigma = np.sqrt(np.einsum("Nib,bc,Nic->Ni", W, covariance, W, optimize=True)).max(axis=0)
    return time_optimal(path, replace(bounds, torque=bounds.torque - SIGMAS * sigma), law)


def limits(chain: Chain) -> TimingLimits:
    speeds, efforts = (np.array([getattr(j, key) for j in chain.joints]) for key in ("velocity", "effort"))
    return TimingLimits(speeds, np.full(chain.n, np.inf), efforts)


def judged(timing: Timing, robot: PathDynamics, efforts: np.ndarray) -> dict[str, float]:
    """Return what the true robot would need for a planned motion: peak share, and share of the time beyond a limit."""
    sampled = dense(timing.path, timing.profile, robot.torque)
    assert sampled.tau is not None
    share = (np.abs(sampled.tau) / efforts).max(axis=1)
    beyond = float(sampled.weights @ (share > 1.0) / sampled.weights.sum())
    return {"seconds": timing.duration, "peak": float(share.max()), "beyond": beyond, "active": timing.active_share}


def run(paths: int, seed: int) -> dict[str, Any]:
    """Plan each path with every model, and check the plans on the true robot."""
    chain = true_chain()
    model, values = true_robot(chain)
    robot = of_standard(model, values)
    cad, other = IdentificationModel(bodies_of(nominal()), model.terms), standard_parameters(nominal())
    drive = values[len(other) :]
    unit = drive * np.random.default_rng([seed, 1]).uniform(1.0 - UNITS, 1.0 + UNITS, drive.shape)
    fitted, seen, covariance = identified(model, values, seed)
    models = {"CAD": of_standard(cad, np.concatenate([other, unit])), "identified": fitted, "truth": robot}
    rng, rows, shaped = np.random.default_rng(seed), [], []
    while len(rows) < paths:
        waypoints = REACH * random_joints(chain, 4, rng)
        path = spline(waypoints)
        try:
            check_within(path, chain.lower, chain.upper)
        except BadInput:
            continue
        timings = {name: time_optimal(path, limits(chain), law) for name, law in models.items()}
        timings["with margin"] = guarded(path, fitted, seen, covariance, limits(chain))
        rows.append({name: judged(one, robot, limits(chain).torque) for name, one in timings.items()})
        if len(shaped) < 3:
            timer = lambda path: time_optimal(path, limits(chain), robot, grid=150).duration  # noqa: E731
            found = shorten(waypoints, timer, evaluations=60, stray=0.3)
            shaped.append(found.after / found.before)
    summary = {
        name: {key: float(np.median([row[name][key] for row in rows])) for key in rows[0][name]}
        | {"worst_peak": max(row[name]["peak"] for row in rows)}
        for name in rows[0]
    }
    return {"summary": summary, "paths": rows, "shaped": shaped, "sigmas": SIGMAS, "seed": seed}


def main() -> None:
    """Run the study from the command line."""
    given = study_options.read(__doc__, paths=(12, "to plan"))
    found = run(given.paths, given.seed)
    files.write_json(given.out / "metrics.json", found)
    study_tables.show(study_tables.planning(found))
    print(f"\nwritten to {given.out / 'metrics.json'}")


if __name__ == "__main__":
    main()

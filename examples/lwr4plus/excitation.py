"""The excitation of the LWR4+ study, scripted: trajectory A, trajectory B, random waypoints and trapezoidal moves.

Kolyubin, Shiriaev & Jubien (2019), Int. J. Adv. Manuf. Technol. 101, 243-259, sections 4.3 and 6.2. Motor torques only
(the paper's Model 2 has joint torques, too), so 69 base columns: 43 inertial, Ia 3 to 7 and Fv Fc off of all seven
drives. A minimises cond(Ω_B), columns in SI units; B attains cond ≤ 35 and mean |τ| of joints 6 and 7 of a tenth of
their limits (eq. 24). Baselines: minimum-jerk and trapezoidal moves between random poses, at the same limits.

    python examples/lwr4plus/excitation.py --out lwr4plus-excitation [--quick] [--period 25] [--seed 0]

Some two minutes; --quick takes half a minute.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.dynamics import base, drives
from calib.dynamics.base import BaseModel
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.tree import standard_parameters, tree
from calib.procedure.motion_limits import Points
from calib.robot import description, library
from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from calib.simulation import lwr4plus
from trajectories.basis import Motion
from trajectories.constraints import TorqueLimit, box_limits
from trajectories.fourier import fourier
from trajectories.objectives import Excitation, TorqueSlack, condition_numbers
from trajectories.optimise import design
from trajectories.places import Workspace
from trajectories.problem import Goal, Problem
from trajectories.verify import dense_motion, ensured

HARMONICS, SAMPLES = 5, 500  # samples of every motion that identification sees, whatever its length
NOISE = 0.015  # of the torque limits, white (the truth table's motor torque)


def truth(chain: Chain) -> tuple[BaseModel, BaseModel, np.ndarray]:
    """Return the model for the search, the one with its Coulomb sign sharp, and the true base parameters."""
    known = description.read_extra(library.path("lwr4plus_truth"))["truth"]["drives"]
    values = np.column_stack([known["Ia"], known["Fv"], known["Fc"], np.add(known["offl"], known["offm"])])
    models = [IdentificationModel(tree(chain), drives.standard(["Ia Fv Fc off"] * 7, v0)) for v0 in (0.05, 0.01)]
    # columns chosen on the nominal chain, regrouped on this one: the exact rank of a tilted axis is 71, of no use
    nominal = IdentificationModel(tree(lwr4plus.nominal_chain()), models[0].terms)
    found = base.regroup(base.find(nominal), models[0])
    chi = found.transform @ np.concatenate([standard_parameters(chain), values.ravel()])
    return BaseModel(models[0], found), BaseModel(models[1], found), chi


def problem(chain: Chain, period: float) -> Problem:
    smooth, _, chi = truth(chain)
    velocity, effort = (np.array([getattr(j, key) for j in chain.joints]) for key in ("velocity", "effort"))
    tool = Points(chain, (0,), np.zeros((1, 3)))
    limits = (
        *box_limits(chain.lower, chain.upper, velocity),
        TorqueLimit(smooth.regressor, smooth.regressor_gradient, chi, effort),
        Workspace(tool, tool.product, radius=0.3, lowest=-0.2),
    )
    family = fourier(HARMONICS, period, chain.n, rate=1000.0)
    return Problem(family, smooth.regressor, smooth.regressor_gradient, constraints=limits)


def designed(chain: Chain, period: float, which: str, starts: int, seed: int) -> tuple[Motion, dict[str, Any]]:
    """Return trajectory A or B, verified."""
    spot, chi = problem(chain, period), truth(chain)[2]
    effort = np.array([joint.effort for joint in chain.joints])
    if which == "B":
        slacks = tuple(Goal(TorqueSlack((j,), chi, effort), 0.9) for j in (5, 6))
        spot = Problem(**(spot.__dict__ | {"goals": (Goal(Excitation("cond", "raw"), 35.0), *slacks)}))
    found, proof = ensured(spot, design(spot, starts=starts, seed=seed))
    motion = dense_motion(spot.family, found.x, period / SAMPLES * np.arange(SAMPLES))
    return motion, {
        "feasible": proof.feasible, "seconds": found.seconds, "evaluations": found.evaluations,
        "margins": {name: one.margin for name, one in proof.worst.items()},
    }  # fmt: skip


def moves(chain: Chain, period: float, shape: str, seed: int, count: int = 20) -> Motion:
    """Return rest-to-rest moves between random poses of the workspace, cut to the same number of samples.

    The moves keep 90 % of the velocity limits; between the poses the workspace is not kept (random poses do not know).
    """
    rng = np.random.default_rng(seed)
    q = rng.uniform(0.9 * chain.lower, 0.9 * chain.upper, (4000, chain.n))
    place = forward(chain, q)[:, :3, 3]
    q = q[(np.hypot(place[:, 0], place[:, 1]) > 0.3) & (place[:, 2] > -0.2)][: count + 1]
    velocity = np.array([joint.velocity for joint in chain.joints])
    peak = 1.875 if shape == "minimum jerk" else 1.5  # of the normalised speed
    times = (np.abs(np.diff(q, axis=0)) * peak / (0.9 * velocity)).max(axis=1)
    ends = np.concatenate([[0.0], np.cumsum(times)])
    t = np.linspace(0.0, min(period, ends[-1]), SAMPLES, endpoint=False)
    k = np.searchsorted(ends, t, side="right") - 1
    s, width, step = ((t - ends[k]) / times[k])[:, None], times[k][:, None], np.diff(q, axis=0)[k]
    if shape == "minimum jerk":
        place_, rate = 10 * s**3 - 15 * s**4 + 6 * s**5, 30 * s**2 * (1 - s) ** 2
        bend = 60 * s - 180 * s**2 + 120 * s**3
    else:  # a third each of acceleration, cruise and deceleration
        rate = np.minimum(1.5, np.minimum(4.5 * s, 4.5 * (1 - s)))
        place_ = np.where(s < 1 / 3, 2.25 * s**2, np.where(s < 2 / 3, 1.5 * s - 0.25, 1 - 2.25 * (1 - s) ** 2))
        bend = np.where(s < 1 / 3, 4.5, np.where(s < 2 / 3, 0.0, -4.5))
    return Motion(t, q[k] + step * place_, step * rate / width, step * bend / width**2, np.zeros_like(step * s))


def judged(chain: Chain, motion: Motion, seeds: int = 20) -> dict[str, Any]:
    """Return what a motion tells: condition numbers, torque shares, RSD, and errors over noise seeds."""
    _, sharp, chi = truth(chain)
    effort = np.array([joint.effort for joint in chain.joints])
    Y = sharp.regressor(motion.q, motion.v, motion.a)
    tau = Y @ chi
    W = (Y / (NOISE * effort)[:, None]).transpose(1, 0, 2).reshape(-1, len(chi))
    inverse = np.linalg.pinv(W)
    rsd = 100 * np.linalg.norm(inverse, axis=1) / np.abs(chi)
    noise = np.random.default_rng(0).normal(size=(seeds, len(W)))
    error = 100 * np.sqrt(np.mean((noise @ inverse.T) ** 2, axis=0)) / np.abs(chi)
    wrist = [k for k, name in enumerate(sharp.names) if name.rstrip("R")[-1] in "67"]
    return {
        "condition_number": condition_numbers(Y),
        "torque_share": (np.abs(tau).mean(axis=0) / effort).tolist(),
        "rsd_median": float(np.median(rsd)), "rsd_median_wrist": float(np.median(rsd[wrist])),
        "parameters_below_10_percent": int((rsd < 10).sum()),
        "error_median_20_seeds": float(np.median(error)),
        "rsd": dict(zip(sharp.names, rsd.tolist())),
    }  # fmt: skip


def study(period: float, starts: int, seed: int) -> dict[str, Any]:
    nominal, calibrated = lwr4plus.nominal_chain(), lwr4plus.arm(lwr4plus.table_2()[1])
    rows: dict[str, Any] = {}
    for name in ("A, cond alone", "B, goal attainment"):
        motion, search = designed(nominal, period, name[0], starts, seed)
        # planned with CAD geometry; on the calibrated one the same motion tells the same columns
        rows[name] = judged(nominal, motion) | {"search": search, "calibrated": judged(calibrated, motion)}
    for shape in ("minimum jerk", "trapezoidal"):
        tried = [judged(nominal, moves(nominal, period, shape, seed + k)) for k in range(5)]
        tried.sort(key=lambda row: row["rsd_median"])
        rows[f"{shape} moves, 20 random waypoints (median of 5)"] = tried[2]
    _summarise(list(rows.values()))
    return {"period": period, "harmonics": HARMONICS, "samples": SAMPLES, "columns": 69, "motions": rows}


def _summarise(rows: list[dict[str, Any]]) -> None:
    """Add medians over the parameters that any of the motions tells to 30 %, and σ against the last motion's.

    The others are too small to be told by any of them, and would drown the comparison.
    """
    rsd = np.array([list(row["rsd"].values()) for row in rows])
    told = rsd.min(axis=0) < 30.0
    wrist = told & np.array([name.rstrip("R")[-1] in "67" for name in rows[0]["rsd"]])
    for row, own in zip(rows, rsd):
        row["told"] = int(told.sum())
        row["rsd_median_told"], row["rsd_median_told_wrist"] = float(np.median(own[told])), float(np.median(own[wrist]))
        row["sigma_against_last"] = float(np.exp(np.log(own / rsd[-1]).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--period", type=float, default=25.0)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    found = study(chosen.period, 1 if chosen.quick else 4, chosen.seed)
    files.write_json(chosen.out / "metrics.json", found)
    told = next(iter(found["motions"].values()))["told"]
    print(f"RSD: medians over the {told} of 69 parameters that any of these motions tells to 30 %")
    print(f"{'motion':52} cond raw  norm.  |tau6|  |tau7|      RSD    wrist  sigma against the last motion's")
    for name, row in found["motions"].items():
        cond, share = row["condition_number"], row["torque_share"]
        print(
            f"{name:52} {cond['raw']:8.1f} {cond['normalised']:6.2f} {share[5]:7.3f} {share[6]:7.3f} "
            f"{row['rsd_median_told']:6.2f} % {row['rsd_median_told_wrist']:6.2f} % {row['sigma_against_last']:6.2f}"
        )


if __name__ == "__main__":
    main()

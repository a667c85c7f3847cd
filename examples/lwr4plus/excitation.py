"""The excitation of the LWR4+ study, scripted: trajectories A and B against random waypoints and trapezoidal moves.

Kolyubin, Shiriaev & Jubien (2019), Int. J. Adv. Manuf. Technol. 101, 243-259, sections 4.3 and 6.2. Model 2 (joint and
motor torques) without payload has 92 base columns, Model 1 64, Model 3 28; motor torques alone 69. A minimises
cond(Ω_B), columns in SI units; B attains cond ≤ 35 and mean |τ| of joints 6 and 7 of a tenth of their limits (eq. 24);
D, ours, minimises -log det. Baselines go through random waypoints at the same limits of position, velocity, torque and
workspace, as fast as these allow. Every motion is sampled at 20 Hz; noise is white, 0.3 % of the limits on joint
torques and 1.5 % on motor torques (chosen, the truth's); or coloured: besides, Stribeck friction of up to 0.3 Fc below
some 0.05 rad/s that no model knows. Fourier series have 5 harmonics, and 12 where said.

Why RSDs differ: σ_k = 1 / (‖w_k‖ √(1 - R_k²)), ‖w_k‖ the size of a whitened column and √(1 - R_k²) what no other column
explains of it. A condition number of normalised columns sees the second factor alone; speed and acceleration make the
first.

    python examples/lwr4plus/excitation.py --out lwr4plus-excitation [--full] [--seed 0]

Some ten seconds; --full sweeps T0, Models 1 to 3 and both geometries, some four minutes of processor time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import excitation_figures as figures
import numpy as np
import study_options
from excitation_moves import moves

from calib import files
from calib.dynamics import base, drives
from calib.dynamics.base import BaseModel
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.torque_rows import BOTH, MODELS, MOTOR, TorqueRows
from calib.procedure.excitation.limits import Points
from calib.procedure.report.style import save
from calib.robot.chain import Chain
from calib.simulation.cells import known_robots, lwr4plus
from trajectories.basis import SampledMotion
from trajectories.constraints import TorqueLimit, box_limits
from trajectories.design.objectives import Excitation, TorqueSlack, condition_numbers
from trajectories.design.optimise import design
from trajectories.design.problem import AttainmentGoal, ExcitationProblem
from trajectories.design.verify import dense_motion, ensured
from trajectories.fourier import fourier_family
from trajectories.places import Workspace

HARMONICS, RATE, SEEDS = 5, 20.0, 20
NOISE = {"link": 0.003, "motor": 0.015}  # of the torque limits
STRIBECK, SLOW = 0.3, 0.05  # share of Fc at most, and speed [rad/s]
KINDS = {"Model 1": MODELS[1], "Model 3": MODELS[3], "motor torques": MOTOR}  # Model 2 is the study itself
TOLD = 30.0  # RSD [%] up to which a motion tells a parameter


@dataclass(frozen=True, eq=False)
class Plant:
    """A chain's model of one kind: smooth for searches, sharp for judging, and its true base parameters."""

    smooth: BaseModel
    sharp: BaseModel
    values: np.ndarray
    sigma: np.ndarray  # (rows,) of the noise


@cache
def geometry(name: str) -> Chain:
    return lwr4plus.nominal_chain() if name == "CAD" else lwr4plus.arm(lwr4plus.table_2()[1])


@cache
def plant(where: str, kind: TorqueRows) -> Plant:
    """Return the arm's model; its columns are chosen on the CAD geometry, and regrouped on its own."""
    known, chain = known_robots.truth("lwr4plus"), geometry(where)
    values = np.column_stack([known["drives"][key] for key in known_robots.SIDED])
    names = " ".join(known_robots.SIDED)
    if kind.motors_alone:
        total = [known["drives"][key] for key in ("Ia", "Fv", "Fc")]
        values = np.column_stack([*total, np.add(known["drives"]["offl"], known["drives"]["offm"])])
        names = "Ia Fv Fc off"
    models = [IdentificationModel(bodies_of(chain), drives.standard([names] * 7, v0), kind) for v0 in (0.05, 0.01)]
    nominal = IdentificationModel(bodies_of(geometry("CAD")), models[0].terms, kind)
    found = base.regroup(base.find(nominal), models[0])
    amounts = dict(zip([f"{key}{j + 1}" for j in range(7) for key in names.split()], values.ravel()))
    bodies = standard_parameters(chain) if kind.has_bodies else np.zeros(0)
    own = np.concatenate([bodies, [amounts[one.name] for one in models[0].columns]])
    effort = np.array([joint.effort for joint in chain.joints])
    sigma = np.concatenate([NOISE["motor" if block.motor else "link"] * effort for block in kind.blocks])
    return Plant(BaseModel(models[0], found), BaseModel(models[1], found), found.transform @ own, sigma)


def torque(where: str, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    motor = plant(where, MOTOR)
    return motor.sharp.regressor(q, v, a) @ motor.values


def problem(where: str, kind: TorqueRows, period: float, which: str, harmonics: int) -> ExcitationProblem:
    """Return the design problem of trajectory A, B or D."""
    chain, own, motor = geometry(where), plant(where, kind), plant(where, MOTOR)
    velocity, effort = (np.array([getattr(joint, key) for joint in chain.joints]) for key in ("velocity", "effort"))
    tool = Points(chain, (0,), np.zeros((1, 3)))
    limits = (
        *box_limits(chain.lower, chain.upper, velocity),
        TorqueLimit(motor.smooth.regressor, motor.smooth.regressor_gradient, motor.values, effort),
        Workspace(tool, tool.product, radius=0.3, lowest=-0.2),
    )
    family = fourier_family(harmonics, period, chain.n, rate=1000.0)
    objective = Excitation("logdet", sigmas=own.sigma) if which == "D" else Excitation("cond", "raw")
    spot = ExcitationProblem(family, own.smooth.regressor, own.smooth.regressor_gradient, ((objective, 1.0),), limits)
    if which != "B":
        return spot
    rows = len(own.sigma)  # motor torques are the last seven rows
    slacks = [TorqueSlack((j,), own.values, np.resize(effort, rows)) for j in (rows - 2, rows - 1)]
    return replace(spot, goals=(AttainmentGoal(objective, 35.0), *(AttainmentGoal(one, 0.9) for one in slacks)))


def designed(
    where: str, kind: TorqueRows, period: float, which: str, starts: int, seed: int, evaluations: int,
    harmonics: int = HARMONICS,
) -> SampledMotion:  # fmt: skip
    """Return a designed motion, verified between its samples."""
    spot = problem(where, kind, period, which, harmonics)
    found, proof = ensured(spot, design(spot, starts=starts, evaluations=evaluations, seed=seed))
    assert proof.feasible
    return dense_motion(spot.family, found.x, np.arange(0.0, period, 1.0 / RATE))


def judged(where: str, kind: TorqueRows, motion: SampledMotion) -> dict[str, Any]:
    """Return what a motion tells: condition numbers, torque shares, RSD and its two factors, errors over seeds."""
    own = plant(where, kind)
    Y = own.sharp.regressor(motion.q, motion.v, motion.a)
    W = (Y / own.sigma[:, None]).transpose(1, 0, 2).reshape(-1, Y.shape[2])
    inverse = np.linalg.pinv(W)
    sigma, size, scale = np.linalg.norm(inverse, axis=1), np.linalg.norm(W, axis=0), np.abs(own.values)
    rng = np.random.default_rng(0)
    white = rng.normal(size=(SEEDS, len(W)))
    unknown = np.array([_stribeck(where, own, motion, rng) for _ in range(SEEDS)]) / own.sigma[:, None]
    coloured = white + unknown.reshape(SEEDS, -1)
    errors = {
        name: 100 * np.sqrt(np.mean((noise @ inverse.T) ** 2, axis=0)) / scale
        for name, noise in (("white", white), ("coloured", coloured))
    }
    tau = torque(where, motion.q, motion.v, motion.a)
    return {
        "seconds": len(motion) / RATE,
        "condition_number": condition_numbers(Y),
        "torque_share": (np.abs(tau).mean(axis=0) / [joint.effort for joint in geometry(where).joints]).tolist(),
        "rsd": dict(zip(own.sharp.names, (100 * sigma / scale).tolist())),
        "size": size.tolist(), "separation": (1.0 / (sigma * size)).tolist(),
        "error": {name: error.tolist() for name, error in errors.items()},
    }  # fmt: skip


def _stribeck(where: str, own: Plant, motion: SampledMotion, rng: np.random.Generator) -> np.ndarray:
    """Return friction (rows, N) on the motors' rows that no model knows: b_j Fc_j exp(-(v/v_s)²) sign v."""
    amount = rng.uniform(0.0, STRIBECK, 7) * np.array(known_robots.truth("lwr4plus")["drives"]["Fc"])
    bump = amount * np.exp(-((motion.v / SLOW) ** 2)) * np.tanh(motion.v / 0.01)
    result = np.zeros((len(own.sigma), len(motion)))
    if own.smooth.model.torque_rows.with_motors:
        result[-7:] = bump.T
    return result


def baselines(
    where: str, kind: TorqueRows, period: float, seed: int, draws: int
) -> dict[str, tuple[SampledMotion, dict[str, Any]]]:
    """Return per kind of moves the draw whose σ are in the middle of all."""
    found = {}
    for shape, cut in (("minimum jerk", period), ("trapezoidal", period), ("trapezoidal", None)):
        tried = []
        for k in range(draws):
            motion = moves(geometry(where), lambda *x: torque(where, *x), shape, seed + k, RATE, cut)
            tried.append((motion, judged(where, kind, motion)))
        tried.sort(key=lambda one: np.log(list(one[1]["rsd"].values())).mean())
        name = f"{shape} moves" if cut else f"{shape} moves, all 20"
        found[name] = tried[draws // 2]
    return found


def summarised(rows: dict[str, dict[str, Any]], against: str) -> None:
    """Add medians over the parameters that any of the motions tells, and geometric means of ratios to one of them."""
    names = list(next(iter(rows.values()))["rsd"])
    table = {name: np.array(list(row["rsd"].values())) for name, row in rows.items()}
    told = np.min(list(table.values()), axis=0) < TOLD
    wrist = told & np.array([name.rstrip("R")[-1] in "67" for name in names])
    other = rows[against]
    mean = lambda x: float(np.exp(np.log(x[told]).mean()))  # noqa: E731
    for name, row in rows.items():
        row["told"] = int(told.sum())
        row["median_rsd"], row["median_rsd_wrist"] = (float(np.median(table[name][k])) for k in (told, wrist))
        row["sigma_ratio"] = mean(table[name] / table[against])
        for key in ("size", "separation"):
            row[f"{key}_ratio"] = mean(np.array(row[key]) / np.array(other[key]))
        row["median_error"] = {key: float(np.median(np.array(x)[told])) for key, x in row["error"].items()}


def estimates(motions: dict[str, SampledMotion], kind: TorqueRows = BOTH) -> dict[str, Any]:
    """Identify the calibrated arm from each motion with CAD and with calibrated geometry: relative errors [%]."""
    truth, rows = plant("ID", kind), dict[str, Any]()
    for name, motion in motions.items():
        own = truth.sharp.regressor(motion.q, motion.v, motion.a)
        y = (own @ truth.values) / truth.sigma
        noise = np.random.default_rng(0).normal(size=(SEEDS, *y.shape))
        for where in ("CAD", "ID"):
            model = plant(where, kind)
            W = model.sharp.regressor(motion.q, motion.v, motion.a) / truth.sigma[:, None]
            inverse = np.linalg.pinv(W.reshape(-1, W.shape[2]))
            found = (y + noise).reshape(SEEDS, -1) @ inverse.T
            error = 100 * np.sqrt(np.mean((found - model.values) ** 2, axis=0)) / np.abs(model.values)
            rows[f"{where}, {name}"] = {
                "estimate": found.mean(axis=0).tolist(), "error": error.tolist(), "truth": model.values.tolist(),
            }  # fmt: skip
    return {"names": list(truth.sharp.names), "rows": rows}


def study(full: bool, seed: int) -> tuple[dict[str, Any], dict[str, SampledMotion]]:
    kind, period = (BOTH, 25.0) if full else (MOTOR, 25.0)
    starts, evaluations, draws = (3, 450, 5) if full else (1, 120, 3)
    motions = dict[str, SampledMotion]()
    plans = [("A", "cond", HARMONICS), ("B", "goals", HARMONICS), ("D", "log det", HARMONICS)]
    plans += [("A", "cond, n_f 12", 12), ("D", "log det, n_f 12", 12)] if full else []
    for which, words, harmonics in plans:
        motion = designed("CAD", kind, period, which, starts, seed, evaluations, harmonics)
        motions[f"{which}, {words}"] = motion
        print(f"{which}, {words} designed", flush=True)
    plain = baselines("CAD", kind, period, seed, draws)
    rows = {name: judged("CAD", kind, motion) for name, motion in motions.items()}
    rows |= {name: row for name, (_, row) in plain.items()}
    summarised(rows, "trapezoidal moves")
    found: dict[str, Any] = {
        "kind": kind.name,
        "period": period,
        "columns": len(plant("CAD", kind).values),
        "motions": rows,
    }
    random = next(iter(plain.values()))[0]
    found["estimates"] = estimates({"random path": random, "optimised": motions["B, goals"]}, kind)
    if full:
        found |= swept(seed, motions)
    return found, motions | {"random path": random}


def swept(seed: int, motions: dict[str, SampledMotion]) -> dict[str, Any]:
    """Return condition numbers over T0, over the models, and of designs on the calibrated geometry."""
    periods, models, places = dict[str, Any](), dict[str, Any](), dict[str, Any]()
    for period in (10.0, 15.0, 20.0, 30.0):
        for which in "AB":
            row = judged("CAD", BOTH, designed("CAD", BOTH, period, which, 1, seed, 300))
            periods[f"{which}, {period:g} s"] = _short(row)
            print(f"{which}, {period:g} s: {_short(row)}", flush=True)
    for name, kind in KINDS.items():
        for which in "A" if not kind.with_motors else "AB":  # slacks are of motor torques
            row = judged("CAD", kind, designed("CAD", kind, 25.0, which, 1, seed, 300))
            models[f"{name}, {which}"] = _short(row) | {"columns": len(row["rsd"])}
            print(f"{name}, {which}: {models[f'{name}, {which}']}", flush=True)
    for which, name in (("A", "A, cond"), ("B", "B, goals")):
        own = designed("ID", BOTH, 25.0, which, 1, seed, 300)
        motions[f"{name}, planned on ID"] = own
        for planned, motion in (("CAD", motions[name]), ("ID", own)):
            places[f"{which} planned on {planned}, judged on ID"] = _short(judged("ID", BOTH, motion))
    return {"periods": periods, "models": models, "geometries": places}


def _short(row: dict[str, Any]) -> dict[str, Any]:
    rsd = np.array(list(row["rsd"].values()))
    wrist = np.array([name.rstrip("R")[-1] in "67" for name in row["rsd"]])
    return {
        **row["condition_number"], "torque_share": row["torque_share"], "told": int((rsd < TOLD).sum()),
        "told_wrist": int((rsd < TOLD)[wrist].sum()),
    }  # fmt: skip


def printed(found: dict[str, Any]) -> str:
    """Return the main comparison as text."""
    rows = found["motions"]
    lines = [
        f"{found['columns']} columns, T0 = {found['period']:g} s; medians over the {next(iter(rows.values()))['told']} "
        f"parameters that any of these motions tells to {TOLD:g} %; ratios against the trapezoidal moves",
        f"{'motion':26} {'s':>5} {'raw':>7} {'norm.':>6} {'|t6|':>6} {'|t7|':>6} {'RSD %':>6} {'wrist':>6} "
        f"{'sigma':>6} {'size':>5} {'apart':>5} {'white':>6} {'colour':>6}",
    ]
    for name, row in rows.items():
        cond, share, error = row["condition_number"], row["torque_share"], row["median_error"]
        lines.append(
            f"{name:26} {row['seconds']:5.1f} {cond['raw']:7.1f} {cond['normalised']:6.2f} {share[5]:6.3f} "
            f"{share[6]:6.3f} {row['median_rsd']:6.2f} {row['median_rsd_wrist']:6.2f} {row['sigma_ratio']:6.2f} "
            f"{row['size_ratio']:5.2f} {row['separation_ratio']:5.2f} {error['white']:6.2f} {error['coloured']:6.2f}"
        )
    errors = {name: np.array(row["error"]) for name, row in found["estimates"]["rows"].items()}
    told = np.min(list(errors.values()), axis=0) < TOLD
    for name, error in errors.items():
        lines.append(f"identified with {name:24} median error {np.median(error[told]):6.2f} % of {told.sum()} told")
    for key in ("periods", "models", "geometries"):
        for name, row in found.get(key, {}).items():
            shares = " ".join(f"{x:.3f}" for x in row["torque_share"])
            lines.append(
                f"{name:32} {row['raw']:7.1f} {row['normalised']:6.2f}  |tau| {shares}  told {row['told']}, wrist "
                f"{row['told_wrist']}"
            )
    return "\n".join(lines)


def main() -> None:
    chosen = study_options.read(__doc__, full="sweep T0, Models 1 to 3 and both geometries")
    found, motions = study(chosen.full, chosen.seed)
    save(figures.paths(geometry("CAD"), motions), chosen.out / "plot_paths.png")
    save(figures.estimates(found["estimates"]), chosen.out / "plot_estimates.png")
    files.write_json(chosen.out / "metrics.json", found)
    print(printed(found))


if __name__ == "__main__":
    main()

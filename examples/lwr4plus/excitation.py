"""The excitation of the LWR4+ study, scripted: trajectories A and B of eq. 24, and whether designing halves the RSDs.

Kolyubin, Shiriaev & Jubien (2019), Int. J. Adv. Manuf. Technol. 101, 243-259, sections 4.3, 6.2 and 6.3. Model 2 (joint
and motor torques), logged empty and with the payload of 3.28 kg; both loads stand in one observation matrix: 102 base
columns, of which 44 are Table 4's. A minimises cond(Ω_B), columns in SI units; B attains cond ≤ 35 and mean |τ| of
joints 6 and 7 of a tenth of their limits (eq. 24). The paper does not say which columns its Ω_B has: both are done,
"102" and "44". D, ours, minimises -log det of the 44 under the stated noise, with twelve harmonics. T0 = 25 s, five
harmonics, rest at both ends; limits of position, velocity, torque with either load, and workspace, verified between the
samples.

Motions are designed with the *current estimate* of the arm: the geometry fitted to 60 measured poses, and Model 2
identified on one slow log of plain moves (0.3 of the limits). What the truth would have given stands beside,
and what the CAD geometry would.

The RSDs "shrink twice" in the paper against another unit's non-optimised trapezoidal moves, whose speed it does not
give. Here: 50 s of each motion per load, in closed loop at 1 kHz, through the study's own filters (10 Hz Butterworth,
decimated to 2 Hz), Table 4's 44 by weighted least squares, weights from the residuals. Baselines: trapezoidal moves
through random waypoints at 0.3, 0.45, 0.6 and 0.9 of the limits, and a 25-s spline through 20 random waypoints. The
truth is of the identified form; the 58 parameters that the 44 leave out are in it.

    python examples/lwr4plus/excitation.py --out lwr4plus-excitation [--seeds 3] [--evaluations 250] [--workers 2]

25 minutes on two busy cores.
"""

from __future__ import annotations

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import excitation_figures as figures
import numpy as np
import study_options
import study_tables
from excitation_moves import moves, waypoint_spline
from simulated_arm import PAYLOAD, TABLE_4, Data, collected, model, nominal_base, record, true_chain, true_parameters

from calib import files
from calib.api.motions import ExcitationDesign
from calib.dynamics import base as bases
from calib.estimation.triangles import combine
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.design import Designed, search_motion
from calib.procedure.excitation.excited_model import excited_model
from calib.procedure.excitation.inputs import ExcitationInputs, IdentifiableColumns
from calib.procedure.excitation.limits import read_motion_limits
from calib.procedure.excitation.settings import ExcitationSettings
from calib.procedure.report.figures.sheets import save
from calib.robot.tables import dumps
from calib.simulation import lwr4plus
from calib.toolkit.chains import Chain, random_joints
from calib.toolkit.installations import calibrated_chain, install
from calib.toolkit.installations import fit_installation as fit
from calib.toolkit.simulations import Reference, lwr4plus_cell, measure
from calib.toolkit.statistics import settled_std, wls
from calib.toolkit.torque_models import BOTH, MOTOR, Base, IdentificationModel, LoadCases
from calib.trajectories.design.objectives import condition_numbers
from calib.workers.threads import one_blas_thread

PERIODS = (10.0, 15.0, 20.0, 25.0, 30.0)  # the paper's T0, section 4.3 [s]
PERIOD, SECONDS, RATE = 25.0, 50.0, 1000.0  # of a trajectory and of a log [s]; of the controller [Hz]
STARTS, EVALUATIONS = 6, 250  # of a design
FRONT = 6  # motions on the Pareto front of B
SPEEDS = (0.3, 0.45, 0.6, 0.9)  # of the plain moves, shares of the limits
NOISE = np.repeat([0.003, 0.015], 7)  # of the limits, on joint and motor torques: D's weights (the truth's)
RUNS = ((PAYLOAD,), ())  # of the same motion: loaded, then empty
GOALS = {"A": ("raw=2",), "B": ("raw=35", "joint6=0.1", "joint7=0.1"), "D": ("logdet",)}  # A: as small as can be
LIMITS = {
    "without": ["joint-margin", "self-collision", "floor"], "target": {"axis_distance": 0.3, "height": -0.2},
    "torque": {"margin": 0.0},
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Arm:
    """The arm as it is known: its geometry, and the standard parameters (136,) of `model`."""

    chain: Chain
    values: np.ndarray

    @cached_property
    def observed(self) -> tuple[IdentificationModel, Base]:
        """Model 2, sharp, and its base columns: chosen on the CAD geometry, regrouped on this one."""
        own = model(self.chain, BOTH, v0=0.01)
        return own, bases.regroup(nominal_base(BOTH), own)

    @cached_property
    def without_payload(self) -> np.ndarray:
        payload = slice(10 * self.chain.n, 10 * (self.chain.n + 1))
        return np.concatenate([self.values[: payload.start], np.zeros(10), self.values[payload.stop :]])

    @cached_property
    def effort(self) -> np.ndarray:
        return np.array([joint.effort for joint in self.chain.joints])

    def torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the larger of the motor torques' moduli with and without the payload (N, n)."""
        Y = model(self.chain, MOTOR, v0=0.01).regressor(q, v, a)
        return np.abs(np.stack([Y @ self.values, Y @ self.without_payload])).max(axis=0)


@cache
def truth() -> Arm:
    chain = true_chain()
    return Arm(chain, true_parameters(chain))


def estimate(seed: int) -> Arm:
    """Return what is known before the design: fitted geometry, Model 2 from a slow log of plain moves.

    The moves are planned with the CAD bodies alone.
    """
    nominal = lwr4plus.nominal_chain()
    measured = measure(lwr4plus_cell(), random_joints(nominal, 60, [seed, 1]), [seed, 2])
    chain = calibrated_chain(fit(install(nominal, [measured]), [measured])).chain
    bodies = np.arange(17 * (nominal.n + 1)) < 10 * (nominal.n + 1)
    slow = moves(nominal, Arm(nominal, true_parameters(nominal) * bodies).torque, SPEEDS[0], seed, RATE, SECONDS)
    own, base = Arm(chain, np.zeros(0)).observed
    rows = collected(own, base, record(truth().chain, slow, [seed, 3]))
    return Arm(chain, base.to_standard(wls(rows, settled_std(rows)).estimate.values))


def table_4(base: Base) -> np.ndarray:
    """Return the positions of the 44 essential parameters among the base columns."""
    return np.array([base.names.index(name) for name in TABLE_4])


@dataclass(frozen=True)
class Plan:
    """A trajectory to design: A, B or D, by the condition of 102 or 44 columns, by which knowledge.

    With `front` motions to choose from, between that condition and joint 6's torque.
    """

    which: str
    columns: int = 102
    knowledge: str = "estimate"
    harmonics: int = 5
    seed: int = 0
    period: float = PERIOD
    front: int = 0

    @property
    def name(self) -> str:
        base = f"{self.which}, {self.columns} columns"
        longer = "" if self.period == PERIOD else f", T0 = {self.period:g} s"
        return base + longer + {"truth": ", known truth", "cad": ", CAD geometry"}.get(self.knowledge, "")


def designed(plan: Plan, arm: Arm, starts: int, evaluations: int) -> tuple[Reference, list[dict[str, Any]]]:
    """Return one period of a designed trajectory, verified between its samples, and what its front is worth."""
    whole, base = arm.observed
    excited = excited_model(whole, RUNS, arm.values, friction=True, nominal=lwr4plus.nominal_chain())
    columns = table_4(base) if plan.columns == len(TABLE_4) else np.arange(base.b)
    sigmas = np.tile(NOISE * np.tile(arm.effort, 2), len(RUNS)) if plan.which == "D" else None
    given = ExcitationInputs(
        arm.chain, read_motion_limits(LIMITS, arm.chain), excited, {},
        IdentifiableColumns(None, sigmas, base.names, chosen=columns), None,
    )  # fmt: skip
    settings = ExcitationSettings(
        goals=GOALS[plan.which], period=plan.period, harmonics=plan.harmonics, rate=RATE, front=plan.front,
        samples=80 + 8 * plan.harmonics, starts=starts, evaluations=evaluations, seed=plan.seed, outlook=False,
    )  # fmt: skip
    found = search_motion(given, settings)
    return _period(found), [] if found.front is None else [
        {"cond": motion["cond"]["44"]["raw"], "share": motion["torque_share"][5],
         "best": bool(found.front.best[k]), "designed": k == found.front.designed}
        for k, motion in enumerate(exact(_period(replace(found, found=run))) for run in found.front.found)
    ]  # fmt: skip


def _period(found: Designed) -> Reference:
    """Return one period at the controller's rate without its end: periods follow each other."""
    return Reference(*(series[:-1] for series in ExcitationDesign(**vars(found)).sampled()))


def keep(period: Reference, folder: Path) -> Path:
    """Write one period of a Fourier series as ``trajectory.toml``, which `dynamics.py` plays."""
    lines = np.fft.rfft(period.q, axis=0)[: Plan("B").harmonics + 1] / len(period.q)
    own = tuple(np.concatenate([[c[0].real], -2.0 * c[1:].imag, 2.0 * c[1:].real]) for c in lines.T)
    names, kinds = zip(*((joint.name, joint.kind) for joint in lwr4plus.nominal_chain().joints))
    motion = coefficients.Periodic(names, kinds, len(period.q) / RATE, RATE, 1, "fourier", own)
    return files.write(folder / coefficients.NAME, dumps(coefficients.table(motion, "lwr4plus", ())))


def repeated(period: Reference, seconds: float = SECONDS) -> Reference:
    """Return as many whole periods of a motion as fit into a log."""
    times = max(1, round(seconds / (len(period.t) / RATE)))
    q, v, a = (np.tile(x, (times, 1)) for x in (period.q, period.v, period.a))
    return Reference(np.arange(len(q)) / RATE, q, v, a)


def exact(motion: Reference) -> dict[str, Any]:
    """Return what a motion is worth by the true arm, without noise: condition numbers, torque shares, peak."""
    arm, part = truth(), slice(None, None, 50)
    own, base = arm.observed
    state = (motion.q[part], motion.v[part], motion.a[part])
    runs = LoadCases(own, base, RUNS)
    Y = runs.regressor(*state)
    tau = np.abs(Y @ (base.transform @ arm.values))[:, runs.limited] / arm.effort
    return {
        "cond": {str(len(base.kept)): condition_numbers(Y), "44": condition_numbers(Y, columns=table_4(base))},
        "torque_share": tau.mean(axis=(0, 1)).tolist(),
        "peak": float((arm.torque(motion.q, motion.v, motion.a) / arm.effort).max()),
    }


def logged(motion: Reference, seed: list[int]) -> Data:
    """Return the logs of the true arm on a motion of 50 s, without and with payload."""
    return record(truth().chain, motion, seed)


def fitted(arm: Arm, data: Data) -> dict[str, Any]:
    """Filter, decimate and fit; what is said of the 44 with all 102 columns fitted, and fitted alone."""
    own, base = arm.observed
    true = (truth().observed[1].transform @ truth().values)[table_4(base)]
    whole = collected(own, base, data)
    result: dict[str, Any] = {"truth": true.tolist(), "rows": int(whole.rows[0])}
    for name, rows in (("102 fitted", whole), ("44 fitted", whole.select(table_4(base)))):
        std = settled_std(rows)
        found, size = wls(rows, std).estimate, np.linalg.norm(combine(rows, std)[:, :-1], axis=0)
        index = [found.names.index(one) for one in TABLE_4]
        values, sigma, rsd = found.values[index], found.sigma[index], found.rsd[index]
        wrist = [one.rstrip("R")[-1] in "67" for one in TABLE_4]
        result[name] = {
            "estimate": values.tolist(), "rsd": rsd.tolist(), "median_rsd": float(np.median(rsd)),
            "median_rsd_wrist": float(np.median(rsd[wrist])),
            "size": size[index].tolist(), "separation": (1.0 / (sigma * size[index])).tolist(),
            "error_in_sigma": float(np.sqrt(np.mean(((values - true) / sigma) ** 2))),
            "median_error": float(np.median(100.0 * np.abs(values / true - 1.0))),
        }  # fmt: skip
    return result


@dataclass(frozen=True, eq=False)
class Task:
    """One motion to make, log and identify from: a plan, the speed of plain moves, or the waypoints' spline (None)."""

    what: Plan | float | None
    seed: int
    arm: Arm  # as it is known
    starts: int
    evaluations: int

    @property
    def name(self) -> str:
        if isinstance(self.what, Plan):
            return self.what.name
        return "spline, 20 waypoints" if self.what is None else f"moves at {self.what:g}"


@one_blas_thread()  # as the API does
def done(task: Task) -> tuple[Reference, dict[str, Any]]:
    """Return the result of one task: motion, logs, identification and errors."""
    arm, plan, front = task.arm, task.what, list[dict[str, Any]]()
    if isinstance(plan, Plan):
        effort = task.evaluations * (2 if plan.which == "D" else 1)
        known = {"truth": truth(), "estimate": arm, "cad": Arm(lwr4plus.nominal_chain(), arm.values)}[plan.knowledge]
        motion, front = designed(plan, known, task.starts, effort)
    elif plan is None:
        motion, _ = waypoint_spline(arm.chain, arm.torque, task.seed, RATE, PERIOD)
    else:
        motion = moves(arm.chain, arm.torque, plan, task.seed, RATE, SECONDS)
    return motion, exact(motion) | fitted(arm, logged(repeated(motion), [task.seed, 4])) | {"front": front}


def study(
    seed: int, seeds: int, starts: int, evaluations: int, workers: int, quick: bool
) -> tuple[dict[str, Any], dict[str, Reference]]:
    """Make and judge all motions; the metrics, and one of each kind of motion by the first seed."""
    arm = estimate(seed)
    assert arm.observed  # chosen once, and handed to every process
    wanted: list[tuple[Plan | float | None, int]] = []
    front = 0 if quick else FRONT
    for k in range(seed, seed + seeds):
        kinds = [("B", 44)] if quick else [("A", 102), ("B", 102), ("A", 44), ("B", 44)]
        for knowledge in ("estimate",) if quick or k > seed else ("estimate", "truth"):
            chosen = ("B", 44, "estimate", seed)
            wanted += [
                (Plan(*kind, knowledge, seed=k, front=front * ((*kind, knowledge, k) == chosen)), k) for kind in kinds
            ]
        wanted += [(speed, k) for speed in ((0.45, 0.9) if quick else SPEEDS)] + [(None, k)]
    if not quick:
        wanted.append((Plan("D", 44, harmonics=12, seed=seed), seed))
        wanted += [(Plan("B", 44, period=period, seed=seed), seed) for period in PERIODS if period != PERIOD]
        wanted.append((Plan("B", 44, "cad", seed=seed), seed))
    tasks = [Task(what, k, arm, starts, evaluations) for what, k in wanted]
    motions, rows = dict[str, Reference](), dict[str, list[dict[str, Any]]]()
    with ProcessPoolExecutor(workers) as pool:
        for task, (motion, row) in zip(tasks, pool.map(done, tasks), strict=True):
            motions.setdefault(task.name, motion)
            rows.setdefault(task.name, []).append(row | {"seed": task.seed})
            print(
                f"{task.name}, seed {task.seed}: cond of 44 {row['cond']['44']['raw']:.1f}", file=sys.stderr, flush=True
            )
    base = arm.observed[1]
    columns, now, true = table_4(base), base.transform @ arm.values, truth().observed[1].transform @ truth().values
    off = 100.0 * np.abs(now[columns] / true[columns] - 1.0)
    return {
        "seed": seed, "seeds": seeds, "columns": len(base.kept), "period": PERIOD, "seconds": SECONDS,
        "estimate_off_percent": {"median": float(np.median(off)), "largest": float(off.max())},
        "motions": rows,
        "compared": compared(rows),
        "geometries": geometries(arm, motions, seed),
    }, motions  # fmt: skip


def compared(rows: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Return per motion medians over the seeds, and the RSDs' ratio to those of B, 44 columns."""
    result = dict[str, Any]()
    for name, runs in rows.items():
        one: dict[str, Any] = {
            "cond": {
                key: {form: _spread([run["cond"][key][form] for run in runs]) for form in ("raw", "normalised")}
                for key in runs[0]["cond"]
            },
            "share": np.median([run["torque_share"] for run in runs], axis=0).tolist(),
            "peak": _spread([run["peak"] for run in runs]),
        }
        for key in ("102 fitted", "44 fitted"):
            if key in runs[0]:
                own, other = [run[key] for run in runs], [run[key] for run in rows["B, 44 columns"]]
                level = np.median([one["median_rsd"] for one in other])
                one[key] = {
                    what: _spread([run[what] for run in own])
                    for what in ("median_rsd", "median_rsd_wrist", "error_in_sigma", "median_error")
                } | {"ratio": _spread([run["median_rsd"] / level for run in own])}
                for what in ("size", "separation"):
                    logs = [np.mean(np.log([run[what] for run in some])) for some in (own, other)]
                    one[key][f"{what}_ratio"] = float(np.exp(logs[0] - logs[1]))
        result[name] = one
    return result


def _spread(values: list[float]) -> list[float]:
    """Return median, least and largest."""
    return [float(np.median(values)), float(min(values)), float(max(values))]


def geometries(arm: Arm, motions: dict[str, Reference], seed: int) -> dict[str, Any]:
    """Identify from random waypoints (RP) and from B (OT) on CAD and on fitted (ID) geometry: Figs 6 and 7."""
    result = dict[str, Any]()
    for motion, key in (("RP", "spline, 20 waypoints"), ("OT", "B, 44 columns")):
        data = logged(repeated(motions[key]), [seed, 5])
        for name, known in (("CAD", Arm(lwr4plus.nominal_chain(), arm.values)), ("ID", arm)):
            found = fitted(known, data)
            result[f"{name}, {motion}"] = found["102 fitted"] | {"truth": found["truth"]}
    return result


def main() -> None:
    given = study_options.read(
        __doc__,
        quick="B of 44 columns without its front, and a few baselines, one seed",
        seeds=(3, "of designs, waypoints and noise"),
        starts=(STARTS, "of each design"),
        evaluations=(EVALUATIONS, "of each start; twice as many for D"),
        workers=(2, "local processes"),
    )
    seeds = 1 if given.quick else given.seeds
    found, motions = study(given.seed, seeds, given.starts, given.evaluations, given.workers, given.quick)
    files.write_json(given.out / "metrics.json", found)
    shown = (
        "A, 102 columns",
        "B, 102 columns",
        "A, 44 columns",
        "B, 44 columns",
        "D, 44 columns",
        "spline, 20 waypoints",
    )
    drawn = {name: motions[name] for name in shown if name in motions}
    save(figures.paths(truth().chain, drawn), given.out / "plot_paths.png")
    save(figures.estimates(found["geometries"]), given.out / "plot_estimates.png")
    save(figures.speeds(found["motions"], SPEEDS), given.out / "plot_speeds.png")
    if not given.quick:
        save(figures.front(found["motions"]), given.out / "plot_front.png")
    keep(motions["B, 44 columns"], given.out)
    study_tables.show(study_tables.excitation(found))


if __name__ == "__main__":
    main()

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

import calib
from calib import files
from calib.dynamics import base as bases
from calib.estimation.triangles import Triangles, combine
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.design import Designed, search_motion
from calib.procedure.excitation.excited_model import excited_model
from calib.procedure.excitation.inputs import ExcitationInputs, IdentifiableColumns
from calib.procedure.excitation.limits import read_motion_limits
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

# the paper's T0, section 4.3 [s]
PERIODS = (10.0, 15.0, 20.0, 25.0, 30.0)
# duration of a trajectory and of a log [s]; rate of the controller [Hz]
PERIOD, SECONDS, RATE = 25.0, 50.0, 1000.0
# speed over which the Coulomb sign is smoothed, where motions are judged [rad/s]
SHARP_SPEED = 0.01
# of a design
STARTS, EVALUATIONS = 6, 250
# motions on the Pareto front of B
FRONT = 6
# of the plain moves, shares of the limits
SPEEDS = (0.3, 0.45, 0.6, 0.9)
# shares of the limits, on joint and motor torques: D's weights (the truth's)
NOISE = np.repeat([0.003, 0.015], 7)
# load cases of the same motion: loaded, then empty
RUNS = ((PAYLOAD,), ())
# A: as small as can be
GOALS = {"A": ("raw=2",), "B": ("raw=35", "joint6=0.1", "joint7=0.1"), "D": ("logdet",)}
LIMITS = {
    "without": ["joint-margin", "self-collision", "floor"],
    "target": {"axis_distance": 0.3, "height": -0.2},
    "torque": {"margin": 0.0},
}
# motion that the others are compared with
REFERENCE = "B, 44 columns"
SPLINE = "spline, 20 waypoints"
# motions whose paths are drawn
DRAWN = ("A, 102 columns", "B, 102 columns", "A, 44 columns", REFERENCE, "D, 44 columns", SPLINE)
FITS = ("102 fitted", "44 fitted")
FIGURES = ("median_rsd", "median_rsd_wrist", "error_in_sigma", "median_error")
Metrics = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Arm:
    """The arm as it is known.

    Attributes:
        chain: its geometry.
        values: (136,) standard parameters of `model`.
    """

    chain: Chain
    values: np.ndarray

    @cached_property
    def observed(self) -> tuple[IdentificationModel, Base]:
        """Model 2, sharp, and its base columns: chosen on the CAD geometry, regrouped on this one."""
        full = model(self.chain, BOTH, v0=SHARP_SPEED)
        return full, bases.regroup(nominal_base(BOTH), full)

    @property
    def base_values(self) -> np.ndarray:
        """Base parameters (102,)."""
        _, base = self.observed
        return base.transform @ self.values

    @cached_property
    def without_payload(self) -> np.ndarray:
        """Standard parameters (136,) of the empty arm."""
        values = np.array(self.values)
        values[10 * self.chain.n : 10 * (self.chain.n + 1)] = 0.0
        return values

    @cached_property
    def effort(self) -> np.ndarray:
        """Torque limits (n,) [N m]."""
        return np.array([joint.effort for joint in self.chain.joints])

    def torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the larger of the motor torques' moduli with and without the payload (N, n)."""
        regressor = model(self.chain, MOTOR, v0=SHARP_SPEED).regressor(q, v, a)
        loaded = np.abs(regressor @ self.values)
        empty = np.abs(regressor @ self.without_payload)
        return np.maximum(loaded, empty)


@cache
def truth() -> Arm:
    chain = true_chain()
    return Arm(chain, true_parameters(chain))


def estimated_arm(seed: int) -> Arm:
    """Return what is known before the design: fitted geometry, Model 2 from a slow log of plain moves.

    The moves are planned with the CAD bodies alone.
    """
    nominal = lwr4plus.nominal_chain()
    measured = measure(lwr4plus_cell(), random_joints(nominal, 60, [seed, 1]), [seed, 2])
    result = fit(install(nominal, [measured]), [measured])
    chain = calibrated_chain(result).chain
    bodies = 10 * (nominal.n + 1)
    cad_values = true_parameters(nominal)
    cad_values[bodies:] = 0.0
    slow = moves(nominal, Arm(nominal, cad_values).torque, SPEEDS[0], seed, RATE, SECONDS)
    full, base = Arm(chain, np.zeros(0)).observed
    rows = collected(full, base, record(truth().chain, slow, [seed, 3]))
    estimate = wls(rows, settled_std(rows)).estimate
    return Arm(chain, base.to_standard(estimate.values))


def table_4(base: Base) -> np.ndarray:
    """Return the positions (44,) of the essential parameters among the base columns."""
    return np.array([base.names.index(name) for name in TABLE_4])


@dataclass(frozen=True)
class Plan:
    """A trajectory to design.

    Attributes:
        which: A, B or D.
        columns: number of columns of the condition number, 102 or 44.
        knowledge: by which arm, ``estimate``, ``truth`` or ``cad``.
        harmonics: of the Fourier series.
        seed: seed of the starts.
        period: duration [s].
        front: number of motions to choose from, between that condition and joint 6's torque.
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
        name = f"{self.which}, {self.columns} columns"
        if self.period != PERIOD:
            name += f", T0 = {self.period:g} s"
        if self.knowledge == "truth":
            name += ", known truth"
        if self.knowledge == "cad":
            name += ", CAD geometry"
        return name


def design(plan: Plan, arm: Arm, starts: int, evaluations: int) -> tuple[Reference, list[Metrics]]:
    """Return one period of a designed trajectory, verified between its samples, and what its front is worth.

    Args:
        plan: the trajectory.
        arm: the arm as it is known.
        starts: number of starts.
        evaluations: evaluations of each start.
    """
    full, base = arm.observed
    excited = excited_model(full, RUNS, arm.values, friction=True, nominal=lwr4plus.nominal_chain())
    columns = table_4(base) if plan.columns == len(TABLE_4) else np.arange(base.b)
    sigmas = None
    if plan.which == "D":
        # joint and motor torques, in each load case
        sigmas = np.tile(NOISE * np.tile(arm.effort, 2), len(RUNS))
    identifiable = IdentifiableColumns(None, sigmas, base.names, chosen=columns)
    limits = read_motion_limits(LIMITS, arm.chain)
    inputs = ExcitationInputs(arm.chain, limits, excited, {}, identifiable, None)
    settings = calib.ExcitationSettings(
        goals=GOALS[plan.which],
        period=plan.period,
        harmonics=plan.harmonics,
        rate=RATE,
        front=plan.front,
        samples=80 + 8 * plan.harmonics,
        starts=starts,
        evaluations=evaluations,
        seed=plan.seed,
        outlook=False,
    )
    designed = search_motion(inputs, settings)
    return _period(designed), front_metrics(designed)


def front_metrics(designed: Designed) -> list[Metrics]:
    """Return condition number and torque of joint 6 of each motion on a Pareto front; empty without a front."""
    front = designed.front
    if front is None:
        return []
    metrics = []
    for k, result in enumerate(front.found):
        merits = merits_of(_period(replace(designed, found=result)))
        motion = {
            "cond": merits["cond"]["44"]["raw"],
            "share": merits["torque_share"][5],
            "best": bool(front.best[k]),
            "designed": k == front.designed,
        }
        metrics.append(motion)
    return metrics


def _period(designed: Designed) -> Reference:
    """Return one period at the controller's rate without its end: periods follow each other."""
    sampled = calib.ExcitationDesign(**vars(designed)).sampled()
    return Reference(*(series[:-1] for series in sampled))


def write_trajectory(period: Reference, folder: Path) -> Path:
    """Write one period of a Fourier series as ``trajectory.toml``, which `dynamics.py` plays."""
    count = len(period.q)
    # a column per joint: constant, then sines and cosines of each harmonic
    spectrum = np.fft.rfft(period.q, axis=0)[: Plan("B").harmonics + 1] / count
    sines, cosines = -2.0 * spectrum[1:].imag, 2.0 * spectrum[1:].real
    series = tuple(np.concatenate([spectrum[:1].real, sines, cosines]).T)
    joints = lwr4plus.nominal_chain().joints
    names = tuple(joint.name for joint in joints)
    kinds = tuple(joint.kind for joint in joints)
    motion = coefficients.Periodic(names, kinds, count / RATE, RATE, 1, "fourier", series)
    return files.write(folder / coefficients.NAME, dumps(coefficients.table(motion, "lwr4plus", ())))


def trajectory_b() -> Reference:
    """Return one period of Trajectory B, 44 columns, as kept of the first seed."""
    series = coefficients.read(Path(__file__).parent)
    t = np.arange(round(series.period * RATE)) / RATE
    return Reference(t, *series.orders(t))


def repeated(period: Reference, seconds: float = SECONDS) -> Reference:
    """Return as many whole periods of a motion as fit into a log [s]."""
    count = max(1, round(seconds / (len(period.t) / RATE)))
    q, v, a = (np.tile(series, (count, 1)) for series in (period.q, period.v, period.a))
    return Reference(np.arange(len(q)) / RATE, q, v, a)


def merits_of(motion: Reference) -> Metrics:
    """Return what a motion is worth by the true arm, without noise: condition numbers, torque shares, peak."""
    arm = truth()
    full, base = arm.observed
    part = slice(None, None, 50)
    cases = LoadCases(full, base, RUNS)
    regressor = cases.regressor(motion.q[part], motion.v[part], motion.a[part])
    torque_share = np.abs(regressor @ arm.base_values)[:, cases.limited] / arm.effort
    peak = (arm.torque(motion.q, motion.v, motion.a) / arm.effort).max()
    return {
        "cond": {str(base.b): condition_numbers(regressor), "44": condition_numbers(regressor, columns=table_4(base))},
        "torque_share": torque_share.mean(axis=(0, 1)).tolist(),
        "peak": float(peak),
    }


def log_motion(motion: Reference, seed: list[int]) -> Data:
    """Return the logs of the true arm on a motion of 50 s, without and with payload."""
    return record(truth().chain, motion, seed)


def identify(arm: Arm, data: Data) -> Metrics:
    """Filter, decimate and fit: the 44 essential parameters with all 102 columns fitted, and fitted alone.

    Args:
        arm: the arm as it is known, for its geometry.
        data: the logs.
    """
    full, base = arm.observed
    columns = table_4(base)
    true = truth().base_values[columns]
    rows = collected(full, base, data)
    essential_rows = rows.select(columns)
    return {
        "truth": true.tolist(),
        "rows": int(rows.rows[0]),
        "102 fitted": fit_metrics(rows, true),
        "44 fitted": fit_metrics(essential_rows, true),
    }


def fit_metrics(rows: Triangles, true: np.ndarray) -> Metrics:
    """Return estimates of the 44 essential parameters, their RSDs [%] and their errors.

    Args:
        rows: the rows of all columns to fit.
        true: (44,) true values.
    """
    std = settled_std(rows)
    estimate = wls(rows, std).estimate
    index = [estimate.names.index(name) for name in TABLE_4]
    values, sigma, rsd = estimate.values[index], estimate.sigma[index], estimate.rsd[index]
    # length of a whitened column; its part that no other column explains is 1 / σ
    size = np.linalg.norm(combine(rows, std)[:, :-1], axis=0)[index]
    separation = 1.0 / (sigma * size)
    errors = (values - true) / sigma
    wrist = [name.rstrip("R")[-1] in "67" for name in TABLE_4]
    return {
        "estimate": values.tolist(),
        "rsd": rsd.tolist(),
        "median_rsd": float(np.median(rsd)),
        "median_rsd_wrist": float(np.median(rsd[wrist])),
        "size": size.tolist(),
        "separation": separation.tolist(),
        "error_in_sigma": float(np.sqrt(np.mean(errors**2))),
        "median_error": float(np.median(100.0 * np.abs(values / true - 1.0))),
    }


Kind = Plan | Reference | float | None


@dataclass(frozen=True, eq=False)
class Task:
    """One motion to make, log and identify from.

    Attributes:
        motion: a plan, one period of the motion that the others are compared with, the speed of plain moves, or None
            for the waypoints' spline.
        seed: seed of motion and noise.
        arm: the arm as it is known.
        starts: starts of a design.
        evaluations: evaluations of each start.
    """

    motion: Kind
    seed: int
    arm: Arm
    starts: int
    evaluations: int

    @property
    def name(self) -> str:
        if isinstance(self.motion, Plan):
            return self.motion.name
        if isinstance(self.motion, Reference):
            return REFERENCE
        if self.motion is None:
            return SPLINE
        return f"moves at {self.motion:g}"

    def make(self) -> tuple[Reference, list[Metrics]]:
        """Return the motion, and what its front is worth."""
        arm = self.arm
        if isinstance(self.motion, Plan):
            return self._design(self.motion)
        if isinstance(self.motion, Reference):
            return self.motion, []
        if self.motion is None:
            spline, _ = waypoint_spline(arm.chain, arm.torque, self.seed, RATE, PERIOD)
            return spline, []
        return moves(arm.chain, arm.torque, self.motion, self.seed, RATE, SECONDS), []

    def _design(self, plan: Plan) -> tuple[Reference, list[Metrics]]:
        arm = self.arm
        if plan.knowledge == "truth":
            arm = truth()
        if plan.knowledge == "cad":
            arm = Arm(lwr4plus.nominal_chain(), arm.values)
        evaluations = self.evaluations
        if plan.which == "D":
            evaluations *= 2
        return design(plan, arm, self.starts, evaluations)


@one_blas_thread()  # as the API does
def run_task(task: Task) -> tuple[Reference, Metrics]:
    """Return the result of one task: motion, logs, identification and errors."""
    motion, front = task.make()
    data = log_motion(repeated(motion), [task.seed, 4])
    return motion, merits_of(motion) | identify(task.arm, data) | {"front": front}


def quick_motions(seed: int) -> list[tuple[Kind, int]]:
    """Return motions and seeds of the quick form: B of 44 columns as kept, a shorter B, two moves and the spline."""
    kinds: list[Kind] = [trajectory_b(), Plan("B", 44, seed=seed, period=PERIODS[0]), 0.45, 0.9, None]
    return [(kind, seed) for kind in kinds]


def all_motions(seed: int, seeds: int) -> list[tuple[Kind, int]]:
    """Return motions and seeds of the whole study.

    Args:
        seed: the first seed, with which D, other periods, the known truth and the CAD geometry are designed too.
        seeds: number of seeds.
    """
    motions: list[tuple[Kind, int]] = []
    for k in range(seed, seed + seeds):
        for knowledge in ("estimate", "truth"):
            if knowledge == "truth" and k > seed:
                continue
            for which, columns in (("A", 102), ("B", 102), ("A", 44), ("B", 44)):
                plan = Plan(which, columns, knowledge, seed=k)
                # one front, of the first design of B
                if plan == Plan("B", 44, seed=seed):
                    plan = replace(plan, front=FRONT)
                motions.append((plan, k))
        motions += [(speed, k) for speed in SPEEDS]
        motions.append((None, k))
    motions.append((Plan("D", 44, harmonics=12, seed=seed), seed))
    motions += [(Plan("B", 44, period=period, seed=seed), seed) for period in PERIODS if period != PERIOD]
    motions.append((Plan("B", 44, "cad", seed=seed), seed))
    return motions


def study(
    seed: int, seeds: int, starts: int, evaluations: int, workers: int, quick: bool
) -> tuple[Metrics, dict[str, Reference]]:
    """Make and judge all motions; the metrics, and one of each kind of motion by the first seed.

    Args:
        seed: the first seed.
        seeds: number of seeds.
        starts: starts of each design.
        evaluations: evaluations of each start.
        workers: number of processes.
        quick: whether few motions are made.
    """
    arm = estimated_arm(seed)
    # chosen once, and handed to every process
    assert arm.observed
    motions_and_seeds = quick_motions(seed) if quick else all_motions(seed, seeds)
    tasks = [Task(motion, k, arm, starts, evaluations) for motion, k in motions_and_seeds]
    motions: dict[str, Reference] = {}
    rows: dict[str, list[Metrics]] = {}
    with ProcessPoolExecutor(workers) as pool:
        for task, (motion, row) in zip(tasks, pool.map(run_task, tasks), strict=True):
            motions.setdefault(task.name, motion)
            rows.setdefault(task.name, []).append(row | {"seed": task.seed})
            condition = row["cond"]["44"]["raw"]
            print(f"{task.name}, seed {task.seed}: cond of 44 {condition:.1f}", file=sys.stderr, flush=True)
    _, base = arm.observed
    columns = table_4(base)
    error = 100.0 * np.abs(arm.base_values[columns] / truth().base_values[columns] - 1.0)
    estimate_error = {"median": float(np.median(error)), "largest": float(error.max())}
    metrics = {
        "seed": seed,
        "seeds": seeds,
        "columns": base.b,
        "period": PERIOD,
        "seconds": SECONDS,
        "estimate_off_percent": estimate_error,
        "motions": rows,
        "compared": {name: summary_of(runs, rows[REFERENCE]) for name, runs in rows.items()},
        "geometries": geometries(arm, motions, seed),
    }
    return metrics, motions


def summary_of(runs: list[Metrics], reference: list[Metrics]) -> Metrics:
    """Return medians of a motion over the seeds, and its RSDs' ratio to those of the reference.

    Args:
        runs: metrics of the motion by seed.
        reference: metrics of B, 44 columns, by seed.
    """
    condition: dict[str, dict[str, list[float]]] = {}
    for columns in runs[0]["cond"]:
        condition[columns] = {}
        for scaling in ("raw", "normalised"):
            condition[columns][scaling] = _spread(_by_seed(runs, "cond", columns, scaling))
    summary: Metrics = {
        "cond": condition,
        "share": np.median(_by_seed(runs, "torque_share"), axis=0).tolist(),
        "peak": _spread(_by_seed(runs, "peak")),
    }
    for key in FITS:
        summary[key] = fit_summary(runs, reference, key)
    return summary


def fit_summary(runs: list[Metrics], reference: list[Metrics], key: str) -> Metrics:
    """Return medians of `fit_metrics` over the seeds, and ratios to those of the reference.

    Args:
        runs: metrics of a motion by seed.
        reference: metrics of the reference by seed.
        key: one of `FITS`.
    """
    summary: Metrics = {}
    for figure in FIGURES:
        summary[figure] = _spread(_by_seed(runs, key, figure))
    reference_rsd = np.median(_by_seed(reference, key, "median_rsd"))
    summary["ratio"] = _spread(_by_seed(runs, key, "median_rsd") / reference_rsd)
    for figure in ("size", "separation"):
        mean = _geometric_mean(_by_seed(runs, key, figure))
        reference_mean = _geometric_mean(_by_seed(reference, key, figure))
        summary[f"{figure}_ratio"] = mean / reference_mean
    return summary


def _by_seed(runs: list[Metrics], *keys: str) -> np.ndarray:
    """Return the values (seeds, …) that stand under nested keys of each run's metrics."""
    values: list[Any] = []
    for run in runs:
        value: Any = run
        for key in keys:
            value = value[key]
        values.append(value)
    return np.array(values)


def _geometric_mean(values: np.ndarray) -> float:
    return float(np.exp(np.mean(np.log(values))))


def _spread(values: np.ndarray) -> list[float]:
    """Return median, least and largest."""
    return [float(np.median(values)), float(values.min()), float(values.max())]


def geometries(arm: Arm, motions: dict[str, Reference], seed: int) -> Metrics:
    """Identify from random waypoints (RP) and from B (OT) on CAD and on fitted (ID) geometry: Figs 6 and 7.

    Args:
        arm: the arm as it is known.
        motions: name of a motion to the motion.
        seed: seed of the noise.
    """
    cad = Arm(lwr4plus.nominal_chain(), arm.values)
    metrics: Metrics = {}
    for label, name in (("RP", SPLINE), ("OT", REFERENCE)):
        data = log_motion(repeated(motions[name]), [seed, 5])
        for geometry, known_arm in (("CAD", cad), ("ID", arm)):
            result = identify(known_arm, data)
            metrics[f"{geometry}, {label}"] = result["102 fitted"] | {"truth": result["truth"]}
    return metrics


def main() -> None:
    arguments = study_options.read(
        __doc__,
        quick="B of 44 columns as kept, a shorter B without a front, and a few baselines, one seed",
        seeds=(3, "of designs, waypoints and noise"),
        starts=(STARTS, "of each design"),
        evaluations=(EVALUATIONS, "of each start; twice as many for D"),
        workers=(2, "local processes"),
    )
    quick, out = arguments.quick, arguments.out
    seeds = 1 if quick else arguments.seeds
    metrics, motions = study(arguments.seed, seeds, arguments.starts, arguments.evaluations, arguments.workers, quick)
    files.write_json(out / "metrics.json", metrics)
    drawn = {name: motions[name] for name in DRAWN if name in motions}
    save(figures.paths(truth().chain, drawn), out / "plot_paths.png")
    save(figures.estimates(metrics["geometries"]), out / "plot_estimates.png")
    save(figures.speeds(metrics["motions"], SPEEDS), out / "plot_speeds.png")
    if not quick:
        save(figures.front(metrics["motions"]), out / "plot_front.png")
    write_trajectory(motions[REFERENCE], out)
    study_tables.show(study_tables.excitation(metrics))


if __name__ == "__main__":
    main()

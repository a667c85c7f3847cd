"""The DualV study: parameters of an actuation-redundant parallel robot by its inverse dynamic and power models.

    python examples/dualv/study.py --out dualv-study [--seeds 5] [--trials 5] [--design] [--readme]

A simulated DualV (Briot, Gautier & Krut 2013, two papers) runs designed motions without and with a payload of 5.37 kg,
under computed torque with an internal preload. IDIM-WLS on the platform's coordinates and PIM-WLS on the power identify
it from encoders and motor torques alone, from two motions at a time; the papers' Table II stands beside.
The motions are stored, in `motions`; `--design` searches for them again, which takes most of the study's time.
The truth obeys the model, its friction and noise are chosen: methods are compared, not a real robot's errors with the
papers'.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import tomllib
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from computed_torque import ComputedTorque, ParallelRun, simulate

import calib
from calib import files
from calib.estimation.essential import Rule, eliminate
from calib.identification.identify import identify_model
from calib.parallel.excite import ParallelExcitation, design_parallel
from calib.parallel.mechanism.parallel_model import make_parallel_model, rows_named
from calib.parallel.mechanism.velocities import distributed, overconstraint
from calib.parallel.robots import find
from calib.procedure.excitation import coefficients
from calib.robot.tables import dumps
from calib.toolkit.model_identification import Identification
from calib.toolkit.recordings import FilterOptions, Recording, make_motion
from calib.toolkit.statistics import Estimate
from calib.toolkit.torque_models import Case, IdentificationSettings, make_case, predict

# rate [Hz] and duration [s] of a recording
RATE, SECONDS = 1000.0, 6.0
# truth of the payload in SI units: mass as weighed, the others as the papers identify them
PAYLOAD = {"M5": 5.37, "MX5": -0.127, "ZZ5": 0.0161}
# friction of each motor in SI units: in the truth, in none of the papers' nine parameters
FRICTION = {"Fv": 0.05, "Fc": 0.3}
# internal preload [N m], σ of logged torques [N m] and of encoders [rad]
PRELOAD, TORQUE_NOISE, ENCODER_NOISE = 10.0, 2.0, 1e-5
# load cases: payloads on board
LOADS = {"empty": (), "loaded": ("5",)}
SEEDS = 5
# evaluations of a design: it ends before, where the search finds no better motion
MAX_EVALUATIONS = 1500
# standard gravity, and largest acceleration of the platform [m/s²]
GRAVITY = 9.81
MAX_ACCELERATION = 25 * GRAVITY
FILTER = FilterOptions(cutoff=120.0, band=40.0, borders=0.2)
METHODS = {"idim": "IDIM", "pim": "PIM", "pim_equal_legs": "PIM, equal legs"}
# the papers' parameters; the first six are regrouped
NINE = ("ZZ11", "ZZ12", "ZZ13", "ZZ14", "ZZ4", "M4", "ZZ5", "MX5", "M5")
REGROUPED = NINE[:6]
LEGS = NINE[:4]
# Table II of either paper: identified values in SI units and σ [%], in the order of NINE
PAPER_VALUES = {
    "idim": (4.45e-2, 4.81e-2, 4.81e-2, 5.07e-2, 2.06e-2, 1.92, 1.61e-2, -0.127, 5.42),
    "pim": (5.2e-2, 4.1e-2, 2.6e-2, 4.0e-2, 1.9e-2, 2.1, 1.8e-2, -0.19, 5.4),
    "pim_equal_legs": (3.9e-2, 3.9e-2, 3.9e-2, 3.9e-2, 2.0e-2, 2.1, 1.8e-2, -0.20, 5.4),
}
PAPER_SIGMAS = {
    "idim": (1.58, 1.39, 1.41, 1.38, 1.37, 1.08, 1.71, 0.76, 0.30),
    "pim": (4.26, 4.49, 8.35, 5.58, 3.30, 1.22, 5.13, 23.39, 0.20),
    "pim_equal_legs": (2.28, 2.28, 2.28, 2.28, 3.23, 1.17, 5.11, 22.07, 0.20),
}
# the IDIM paper's relative errors of x, y, rz on another motion
PAPER_ERRORS = (0.0987, 0.0841, 0.1492)
FORCE_LABELS = ["Fx [N]", "Fy [N]", "Mz [N m]"]
MOTIONS = Path(__file__).with_name("motions")
MARKS = ("<!-- the table is written by --readme -->", "<!-- end of the table -->")

# the runs of one motion, by load
Runs = dict[str, ParallelRun]
Metrics = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("dualv-study"))
    parser.add_argument("--seeds", type=int, default=SEEDS, help="of motions and noise; three at least")
    parser.add_argument("--trials", type=int, default=SEEDS, help="identifications, each from three of the motions")
    parser.add_argument(
        "--design", action="store_true", help="search for the motions, and store them beside this script"
    )
    parser.add_argument("--workers", type=int, default=2, help="local processes for the designs")
    parser.add_argument("--readme", action="store_true", help="put the tables into the README beside this script")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    wall_start, processor_start = time.perf_counter(), processor_time()
    if arguments.design:
        design_motions(arguments.seeds, arguments.workers)
    motions = [Motion.read(seed) for seed in range(arguments.seeds)]
    trials = run_trials(motions, arguments.trials)
    figures(trials[0], arguments.out)
    metrics = report(motions, trials)
    seconds = processor_time() - processor_start
    metrics["seconds"] = {"wall": time.perf_counter() - wall_start, "processor": seconds}
    (arguments.out / "metrics.json").write_text(json.dumps(metrics, indent=1), encoding="utf-8")
    rows = readme_rows(metrics)
    if arguments.readme:
        write_readme(rows)
    print("\n".join(rows))
    print(f"{seconds:.0f} s of processor time; figures and metrics.json in {arguments.out}")


def processor_time() -> float:
    """Return processor seconds of this process and of its processes that ended."""
    return sum(os.times()[:4])


def design_motions(seeds: int, workers: int) -> None:
    """Search for motions in local processes, and store them beside this script."""
    with ProcessPoolExecutor(workers) as pool:
        for seed, design in enumerate(pool.map(design_motion, range(seeds))):
            store(design, seed)


def run_trials(motions: list[Motion], count: int) -> list[Trial]:
    """Return identifications, each from two motions and validated on a third one.

    Args:
        motions: three motions or more.
        count: number of trials; each begins with the next motion.
    """
    robot = Robot()
    runs: list[Runs] = []
    for seed, motion in enumerate(motions):
        runs.append({load: robot.run(motion, carried, seed) for load, carried in LOADS.items()})
    trials = []
    for k in range(min(count, len(runs))):
        first, second, validation = (runs[(k + offset) % len(runs)] for offset in range(3))
        trials.append(Trial(robot, (first, second), validation))
    return trials


def write_readme(rows: list[str]) -> None:
    """Put the tables between the marks of the README beside this script."""
    path = Path(__file__).with_name("README.md")
    start, end = MARKS
    head, rest = path.read_text(encoding="utf-8").split(start)
    _, tail = rest.split(end)
    path.write_text("\n".join([head + start, *rows, end + tail]), encoding="utf-8")


def design_motion(seed: int, evaluations: int = MAX_EVALUATIONS) -> ParallelExcitation:
    """Return a motion that excites robot and payload within 127 N m (a fifth of it kept free) and 25 g."""
    robot = Robot()
    settings = calib.ExcitationSettings(
        period=0.5, harmonics=5, starts=1, evaluations=evaluations, seed=seed, rate=RATE
    )
    limits = np.array([MAX_ACCELERATION, MAX_ACCELERATION, np.inf])
    preloaded = replace(robot.model, preload=(PRELOAD,))
    return design_parallel(find("dualv"), preloaded, robot.values, settings, acceleration=limits)


def store(design: ParallelExcitation, seed: int) -> None:
    """Write a designed motion of the platform, with what was reached, to its folder beside this script."""
    content = coefficients.table(design.periodic(design.found), "dualv", ())
    torques, accelerations = design.peaks
    content["reached"] = {
        "evaluations": design.found.evaluations,
        "merit": design.found.merit,
        "condition": design.condition.table(),
        "peak_torque": torques.tolist(),
        "peak_g": (accelerations[:2] / GRAVITY).tolist(),
    }
    files.write(MOTIONS / str(seed) / coefficients.NAME, dumps(content))


@dataclass(frozen=True)
class Motion:
    """A stored motion of the platform's coordinates, and what its design reached."""

    series: coefficients.Periodic
    reached: Metrics

    @classmethod
    def read(cls, seed: int) -> Motion:
        """Return the stored motion of a seed."""
        folder = MOTIONS / str(seed)
        content = tomllib.loads((folder / coefficients.NAME).read_text(encoding="utf-8"))
        return cls(coefficients.read(folder), content["reached"])


class Robot:
    """The simulated robot: library geometry, parameters of its file, friction, and a payload that may be on board.

    Attributes:
        mechanism: its geometry.
        model: its dynamics.
        values: (p,) its true parameters.
    """

    def __init__(self) -> None:
        self.mechanism = find("dualv").mechanism
        self.model = make_parallel_model(self.mechanism, ["Fv Fc"], v0=0.05, payloads=["5"])
        friction = [FRICTION[term.name[:2]] for term in self.model.terms]
        self.values = np.concatenate([self.model.known_parameters(), friction])
        for name, value in PAYLOAD.items():
            self.values[self.model.names.index(name)] = value

    def run(self, motion: Motion, carried: tuple[str, ...], seed: int) -> ParallelRun:
        """Return the log of a motion.

        Args:
            motion: the motion.
            carried: payloads on board.
            seed: seed of the noise.
        """
        controller = ComputedTorque(self.values, preload=PRELOAD, rate=RATE, encoder=ENCODER_NOISE, torque=TORQUE_NOISE)
        t = np.arange(int(SECONDS * RATE)) / RATE
        x, v, a = motion.series.orders(t)
        return simulate(self.model, self.values, controller, x, v, a, carried, seed)


class Method:
    """One method on the recordings: IDIM on the platform's coordinates, or PIM on the power.

    Attributes:
        model: the model that is identified.
        unseen: the loaded recording of another motion.
        identification: the identification of all base parameters.
        base_estimate: all base parameters.
        free_estimate: the parameters that elimination by the ratio of σ keeps.
        nine_estimate: the papers' nine parameters.
        equal_legs: the same with equal legs; None for IDIM.
    """

    def __init__(self, robot: Robot, name: str, training: tuple[Runs, Runs], validation: Runs):
        rows = rows_named(robot.mechanism, "platform" if name == "idim" else "power")
        self.model = make_parallel_model(robot.mechanism, ["Ia Fv Fc"], v0=0.05, rows=rows, payloads=["5"])

        def case_of(motion: int, runs: Runs, load: str) -> Case:
            run = runs[load]
            label = f"{load}, motion {motion}"
            names = robot.mechanism.robot.joint_names
            recording = Recording(run.t, run.q, run.tau, "torque", names, file=label)
            return make_case(label, make_motion(recording, FILTER), rows, carried=LOADS[load])

        cases = []
        for motion, runs in enumerate(training):
            cases += [case_of(motion, runs, load) for load in LOADS]
        self.unseen = case_of(2, validation, "loaded")
        settings = IdentificationSettings(prior="none", essential="none", torque_rows=rows)
        self.identification: Identification = identify_model(self.model, cases, settings)
        self.base_estimate = self.identification.fitted.estimate
        self.free_estimate = eliminated(self.identification, ratio=10.0)
        self.nine_estimate = eliminated(self.identification, NINE)
        self.equal_legs: Estimate | None = None
        if name == "pim":
            equal_model = replace(self.model, identical_legs=True)
            self.equal_legs = eliminated(identify_model(equal_model, cases, settings), NINE)

    def predicted(self, estimate: Estimate) -> np.ndarray:
        """Return the torques that estimated base parameters predict for the validation motion."""
        by_name = dict(zip(estimate.names, estimate.values))
        # with equal legs the first stands for all
        if not by_name.keys() >= set(LEGS):
            by_name |= dict.fromkeys(LEGS, by_name[LEGS[0]])
        values = np.zeros(self.model.p)
        for k in self.identification.base.kept:
            values[k] = by_name.get(self.model.names[k], 0.0)
        dynamics = type(self.identification.dynamics)(self.model, values)
        return predict(dynamics, self.unseen)

    def errors(self, estimate: Estimate) -> list[float]:
        """Return the relative error ‖ρ‖/‖y‖ of each joint on the validation motion, in the identification band."""
        target = self.unseen.motion.in_band(self.unseen.target)
        predicted = self.unseen.motion.in_band(self.predicted(estimate))
        shares = np.linalg.norm(target - predicted, axis=0) / np.linalg.norm(target, axis=0)
        return shares.tolist()


def eliminated(identification: Identification, names: Sequence[str] = (), ratio: float = np.inf) -> Estimate:
    """Return the parameters that elimination keeps: down to `names`, or until max σ% / min σ% < ratio."""
    fitted = identification.fitted
    drop = [name for name in fitted.pooled.names if names and name not in names]
    elimination = eliminate(fitted.pooled, Rule.RSD, ratio=ratio, drop=drop, std=fitted.std, inflation=fitted.inflation)
    return elimination.essential.estimate


class Trial:
    """Both methods on two motions without and with the payload, validated on a third motion with it.

    Attributes:
        robot: the simulated robot.
        idim, pim: the methods.
        truth: name of a base parameter to its true value.
        inertial: number of inertial base parameters of the empty robot.
    """

    def __init__(self, robot: Robot, training: tuple[Runs, Runs], validation: Runs):
        self.robot = robot
        self.idim = Method(robot, "idim", training, validation)
        self.pim = Method(robot, "pim", training, validation)
        model, base = self.idim.model, self.idim.identification.base
        true_values = dict(zip(robot.model.names, robot.values))
        standard = np.array([true_values.get(name, 0.0) for name in model.names])
        self.truth = dict(zip(self.idim.base_estimate.names, base.transform @ standard))
        self.inertial = 0
        for k in base.kept:
            if k < model.inertial and not model.names[k].endswith("5"):
                self.inertial += 1

    def metrics(self) -> Metrics:
        """Return the estimates of all methods, and their errors on the validation motion."""
        idim, pim = self.idim, self.pim
        assert pim.equal_legs is not None
        estimates = {
            "idim": idim.nine_estimate,
            "pim": pim.nine_estimate,
            "pim_equal_legs": pim.equal_legs,
            "idim_all": idim.base_estimate,
            "pim_all": pim.base_estimate,
            "idim_free": idim.free_estimate,
            "pim_free": pim.free_estimate,
        }
        torque_errors = {"idim": idim.errors(idim.nine_estimate), "idim_all": idim.errors(idim.base_estimate)}
        (power_error,) = pim.errors(pim.nine_estimate)
        (equal_legs_error,) = pim.errors(pim.equal_legs)
        return {
            "methods": {name: self._estimate_metrics(estimate) for name, estimate in estimates.items()},
            "cross_validation": torque_errors,
            "power_error": {"pim": power_error, "pim_equal_legs": equal_legs_error},
        }

    def _estimate_metrics(self, estimate: Estimate) -> dict[str, dict[str, float]]:
        """Return values, σ [%] and errors [σ] of an estimate by parameter."""
        errors = estimate.values - np.array([self.truth[name] for name in estimate.names])
        errors_in_sigma = errors / estimate.sigma
        return {
            "values": dict(zip(estimate.names, estimate.values.tolist())),
            "sigma_percent": dict(zip(estimate.names, estimate.rsd.tolist())),
            "error_in_sigma": dict(zip(estimate.names, errors_in_sigma.tolist())),
        }


def report(motions: list[Motion], trials: list[Trial]) -> Metrics:
    """Return the metrics of all seeds."""
    first = trials[0]
    truth = {name: float(first.truth[name]) for name in NINE}
    counts = {"idim": first.idim.identification.base.b, "pim": first.pim.identification.base.b}
    return {
        "truth": truth,
        "base_parameters": counts,
        "inertial_base_parameters": first.inertial,
        "designs": [motion.reached for motion in motions],
        "runs": [trial.metrics() for trial in trials],
    }


def readme_rows(metrics: Metrics) -> list[str]:
    """Return the README's tables: values, stated sigmas [%], errors; medians (least to most) of the seeds."""
    runs = metrics["runs"]
    titles = " | ".join(f"{title} | paper" for title in METHODS.values())
    rows = ["", f"| value | truth | {titles} |", "|---" * 8 + "|"]
    for number, name in enumerate(NINE):
        cells = [label(name), f"{metrics['truth'][name]:.4g}"]
        for method, paper in PAPER_VALUES.items():
            cells += [parameter_cell(runs, method, "values", name, ".4g"), f"{paper[number]:.3g}"]
        rows.append(table_line(cells))
    rows += ["", f"| stated σ [%] | {titles} |", "|---" * 7 + "|"]
    for number, name in enumerate(NINE):
        cells = [label(name)]
        for method, paper in PAPER_SIGMAS.items():
            cells += [parameter_cell(runs, method, "sigma_percent", name, ".2f"), f"{paper[number]:.3g}"]
        rows.append(table_line(cells))
    return [*rows, *error_rows(runs), *summary_rows(runs)]


def error_rows(runs: list[Metrics]) -> list[str]:
    """Return the table of relative errors on another motion."""
    errors = by_trial(runs, "cross_validation", "idim")
    return [
        "",
        "| relative error on another loaded motion | x | y | rz |",
        "|---|---|---|---|",
        table_line(["IDIM", *(median_range(column, ".3f") for column in errors.T)]),
        table_line(["paper", *(f"{error:.3f}" for error in PAPER_ERRORS)]),
    ]


def summary_rows(runs: list[Metrics]) -> list[str]:
    """Return the table of true errors [σ], of the numbers of parameters, and of the power."""
    rows = ["", f"| | {' | '.join(METHODS.values())} |", "|---|---|---|---|"]
    for text, names in (("leg inertias", LEGS), ("the others", NINE[4:])):
        cells = [largest_error_cell(runs, method, names) for method in METHODS]
        rows.append(table_line([f"largest error of {text} [σ]", *cells]))
    base_cells = [largest_error_cell(runs, f"{method}_all", NINE) for method in ("idim", "pim")]
    rows.append(f"| of the nine, all base parameters fitted [σ] | {' | '.join(base_cells)} | |")
    count_cells = []
    for method in ("idim_free", "pim_free"):
        counts = [len(run["methods"][method]["values"]) for run in runs]
        count_cells.append(median_range(counts, ".0f"))
    rows.append(f"| parameters that elimination keeps | {' | '.join(count_cells)} | |")
    power_cell = median_range(by_trial(runs, "power_error", "pim"), ".3f")
    equal_legs_cell = median_range(by_trial(runs, "power_error", "pim_equal_legs"), ".3f")
    rows.append(f"| of the power, relative error | | {power_cell} | {equal_legs_cell} |")
    return rows


def table_line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def by_trial(runs: list[Metrics], *keys: str) -> np.ndarray:
    """Return the values (trials, …) that stand under nested keys of each trial's metrics."""
    values: list[Any] = []
    for run in runs:
        value: Any = run
        for key in keys:
            value = value[key]
        values.append(value)
    return np.array(values)


def label(name: str) -> str:
    """Return the name of a parameter, with R where it is regrouped."""
    return f"{name}R" if name in REGROUPED else name


def median_range(values: Sequence[float] | np.ndarray, form: str) -> str:
    """Return a median with the smallest and the largest value."""
    return f"{np.median(values):{form}} ({min(values):{form}} to {max(values):{form}})"


def parameter_cell(runs: list[Metrics], method: str, kind: str, name: str, form: str) -> str:
    """Return the median of a parameter's figure over the trials; = for a leg that is equal to the first.

    Args:
        runs: metrics of the trials.
        method: one of `METHODS`.
        kind: ``values`` or ``sigma_percent``.
        name: name of the parameter.
        form: format of a number.
    """
    if method == "pim_equal_legs" and name in LEGS[1:]:
        return "="
    return median_range(by_trial(runs, "methods", method, kind, name), form)


def largest_error_cell(runs: list[Metrics], method: str, names: Sequence[str]) -> str:
    """Return the median over the trials of the largest error [σ] of some parameters."""
    largest = []
    for run in runs:
        errors = run["methods"][method]["error_in_sigma"]
        largest.append(max(abs(errors[name]) for name in names if name in errors))
    return median_range(largest, ".1f")


def figures(trial: Trial, out: Path) -> None:
    """Draw the papers' figures for the loaded robot on the other motion: forces, torques, overconstraint, power."""
    idim, pim = trial.idim, trial.pim
    mechanism = trial.robot.mechanism
    motion = idim.unseen.motion
    # the first seconds
    part = motion.t < motion.t[0] + 3.0
    t = motion.t[part]
    forces = motion.in_band(idim.unseen.target)[part]
    predicted_forces = motion.in_band(idim.predicted(idim.nine_estimate))[part]
    _draw(t, forces, predicted_forces, FORCE_LABELS, out / "forces.png")

    jacobians = idim.model.moved(motion.q[part], motion.v[part], motion.a[part]).jacobians
    torques = motion.in_band(np.array(motion.effort))[part]
    constraint = overconstraint(mechanism, jacobians, torques)
    predicted_torques = distributed(mechanism, jacobians, predicted_forces, constraint)
    torque_labels = [f"{name} [N m]" for name in mechanism.robot.joint_names]
    _draw(t, torques, predicted_torques, torque_labels, out / "torques.png")
    _draw(t, constraint, np.full_like(constraint, PRELOAD), ["overconstraint [N m]"], out / "overconstraint.png")

    power = pim.unseen.motion.in_band(pim.unseen.target)[part]
    predicted_power = pim.unseen.motion.in_band(pim.predicted(pim.nine_estimate))[part]
    _draw(t, power, predicted_power, ["power [W]"], out / "power.png")


def _draw(t: np.ndarray, measured: np.ndarray, model: np.ndarray, labels: list[str], path: Path) -> None:
    """Draw measured and modelled series (N, k) with their differences, an axis per column."""
    figure, axes = plt.subplots(len(labels), 1, figsize=(7, 1.8 * len(labels) + 0.6), sharex=True, squeeze=False)
    for axis, text, measured_series, model_series in zip(axes[:, 0], labels, measured.T, model.T):
        axis.plot(t, measured_series, "r", lw=1.2, label="measured")
        axis.plot(t, model_series, "b", lw=0.8, label="model")
        axis.plot(t, measured_series - model_series, "k", lw=0.6, label="error")
        axis.set_ylabel(text)
    axes[0, 0].legend(loc="upper right", fontsize=7, ncols=3)
    axes[-1, 0].set_xlabel("time [s]")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main()

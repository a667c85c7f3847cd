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

from calib import files
from calib.estimation.essential import Rule, eliminate
from calib.identification.identify import identify_model
from calib.parallel.excite import ParallelExcitation, design_parallel
from calib.parallel.mechanism.parallel_model import make_parallel_model, rows_named
from calib.parallel.mechanism.velocities import distributed, overconstraint
from calib.parallel.robots import find
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.settings import ExcitationSettings
from calib.robot.tables import dumps
from calib.toolkit.model_identification import Identification
from calib.toolkit.recordings import FilterOptions, Recording, make_motion
from calib.toolkit.statistics import Estimate
from calib.toolkit.torque_models import Case, IdentificationSettings, make_case, predict

RATE, SECONDS = 1000.0, 6.0  # of a recording: Hz, s
PAYLOAD = {"M5": 5.37, "MX5": -0.127, "ZZ5": 0.0161}  # truth: mass as weighed, the others as the papers identify them
FRICTION = {"Fv": 0.05, "Fc": 0.3}  # of each motor: in the truth, in none of the papers' nine parameters
PRELOAD, TORQUE_NOISE, ENCODER_NOISE = 10.0, 2.0, 1e-5  # N m, N m, rad
LOADS = {"empty": (), "loaded": ("5",)}
SEEDS = 5
MOST = 1500  # evaluations of a design: it ends before, where the search finds no better motion
ACCELERATION = 25 * 9.81
FILTER = FilterOptions(cutoff=120.0, band=40.0, borders=0.2)
METHODS = {"idim": "IDIM", "pim": "PIM", "pim_equal_legs": "PIM, equal legs"}
NINE = ("ZZ11", "ZZ12", "ZZ13", "ZZ14", "ZZ4", "M4", "ZZ5", "MX5", "M5")  # the first six regrouped
LEGS = NINE[:4]
PAPERS = {  # identified value, sigma %: Table II of either paper
    "idim": dict(zip(NINE, ((4.45e-2, 1.58), (4.81e-2, 1.39), (4.81e-2, 1.41), (5.07e-2, 1.38), (2.06e-2, 1.37),
                            (1.92, 1.08), (1.61e-2, 1.71), (-0.127, 0.76), (5.42, 0.30)))),
    "pim": dict(zip(NINE, ((5.2e-2, 4.26), (4.1e-2, 4.49), (2.6e-2, 8.35), (4.0e-2, 5.58), (1.9e-2, 3.30),
                           (2.1, 1.22), (1.8e-2, 5.13), (-0.19, 23.39), (5.4, 0.20)))),
    "pim_equal_legs": dict(zip(NINE, (*((3.9e-2, 2.28),) * 4, (2.0e-2, 3.23), (2.1, 1.17), (1.8e-2, 5.11),
                                 (-0.20, 22.07), (5.4, 0.20)))),
}  # fmt: skip
CROSS = (0.0987, 0.0841, 0.1492)  # the IDIM paper's relative errors of x, y, rz
COORDINATES = ("x", "y", "rz")
MOTIONS = Path(__file__).with_name("motions")
MARKS = ("<!-- the table is written by --readme -->", "<!-- end of the table -->")


Runs = dict[str, ParallelRun]  # of one motion, by load


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
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    began, used = time.perf_counter(), os.times()
    seeds = range(options.seeds)
    if options.design:
        with ProcessPoolExecutor(options.workers) as pool:
            for seed, design in zip(seeds, pool.map(designed, seeds)):
                store(design, seed)
    designs = [Motion.read(seed) for seed in seeds]
    robot = Robot()
    runs = [{label: robot.run(designs[k], LOADS[label], k) for label in LOADS} for k in seeds]
    found = [Trial(robot, *(runs[(k + later) % len(runs)] for later in range(3))) for k in seeds[: options.trials]]
    figures(robot, found[0], options.out)
    metrics = report(designs, found)
    spent = sum(now - then for now, then in zip(os.times()[:4], used))
    metrics["seconds"] = {"wall": time.perf_counter() - began, "processor": spent}
    (options.out / "metrics.json").write_text(json.dumps(metrics, indent=1), encoding="utf-8")
    rows = readme_rows(metrics)
    if options.readme:
        put_into_readme(rows)
    print("\n".join(rows))
    print(f"{spent:.0f} s of processor time; figures and metrics.json in {options.out}")


def put_into_readme(rows: list[str]) -> None:
    path = Path(__file__).with_name("README.md")
    head, rest = path.read_text(encoding="utf-8").split(MARKS[0])
    tail = MARKS[1] + rest.split(MARKS[1])[1]
    path.write_text("\n".join([head + MARKS[0], *rows, tail]), encoding="utf-8")


def designed(seed: int, evaluations: int = MOST) -> ParallelExcitation:
    """Return a motion that excites robot and payload within 127 N m (a fifth of it kept free) and 25 g."""
    robot = Robot()
    settings = ExcitationSettings(period=0.5, harmonics=5, starts=1, evaluations=evaluations, seed=seed, rate=RATE)
    limits = np.array([ACCELERATION, ACCELERATION, np.inf])
    loaded = replace(robot.model, preload=(PRELOAD,))
    return design_parallel(find("dualv"), loaded, robot.values, settings, acceleration=limits)


def store(design: ParallelExcitation, seed: int) -> None:
    """Write a designed motion of the platform, with what was reached, to its folder beside this script."""
    content = coefficients.table(design.periodic(design.found), "dualv", ())
    torques, accelerations = design.peaks
    content["reached"] = {
        "evaluations": design.found.evaluations, "merit": design.found.merit, "condition": design.condition.table(),
        "peak_torque": torques.tolist(), "peak_g": (accelerations[:2] / 9.81).tolist(),
    }  # fmt: skip
    files.write(MOTIONS / str(seed) / coefficients.NAME, dumps(content))


@dataclass(frozen=True)
class Motion:
    """A stored motion of the platform's coordinates, and what its design reached."""

    series: coefficients.Periodic
    reached: dict[str, Any]

    @classmethod
    def read(cls, seed: int) -> Motion:
        folder = MOTIONS / str(seed)
        content = tomllib.loads((folder / coefficients.NAME).read_text(encoding="utf-8"))
        return cls(coefficients.read(folder), content["reached"])


class Robot:
    """The simulated robot: library geometry, parameters of its file, friction, and a payload that may be on board."""

    def __init__(self) -> None:
        self.mechanism = find("dualv").mechanism
        self.model = make_parallel_model(self.mechanism, ["Fv Fc"], v0=0.05, payloads=["5"])
        bodies = self.model.known_parameters()
        self.values = np.concatenate([bodies, [FRICTION[one.name[:2]] for one in self.model.terms]])
        for name, value in PAYLOAD.items():
            self.values[self.model.names.index(name)] = value

    def run(self, motion: Motion, carried: tuple[str, ...], seed: int) -> ParallelRun:
        controller = ComputedTorque(self.values, preload=PRELOAD, rate=RATE, encoder=ENCODER_NOISE, torque=TORQUE_NOISE)
        orders = motion.series.orders(np.arange(int(SECONDS * RATE)) / RATE)
        return simulate(self.model, self.values, controller, *orders, carried, seed)


class Method:
    """What one method makes of the recordings: IDIM on the platform's coordinates, or PIM on the power."""

    def __init__(self, robot: Robot, name: str, seen: tuple[Runs, Runs], other: Runs):
        rows = rows_named(robot.mechanism, "platform" if name == "idim" else "power")
        self.model = make_parallel_model(robot.mechanism, ["Ia Fv Fc"], v0=0.05, rows=rows, payloads=["5"])

        def case(motion: int, runs: Runs, load: str) -> Case:
            run, label = runs[load], f"{load}, motion {motion}"
            recording = Recording(run.t, run.q, run.tau, "torque", robot.mechanism.robot.joint_names, file=label)
            return make_case(label, make_motion(recording, FILTER), rows, carried=LOADS[load])

        self.unseen = case(2, other, "loaded")
        settings = IdentificationSettings(prior="none", essential="none", torque_rows=rows)
        cases = [case(k, runs, load) for k, runs in enumerate(seen) for load in LOADS]
        self.found: Identification = identify_model(self.model, cases, settings)
        self.all = self.found.fitted.estimate
        self.free = _kept(self.found, ratio=10.0)
        self.nine = _kept(self.found, NINE)
        if name == "pim":
            alike = identify_model(replace(self.model, identical_legs=True), cases, settings)
            self.equal_legs = _kept(alike, NINE)

    def predicted(self, estimate: Estimate) -> np.ndarray:
        """Return the torques that estimated base parameters predict for the validation motion."""
        values = np.zeros(self.model.p)
        known = dict(zip(estimate.names, estimate.values))
        if not set(LEGS) <= set(known):  # equal legs: the first stands for all
            known |= dict.fromkeys(LEGS, known[LEGS[0]])
        for k in self.found.base.kept:
            values[k] = known.get(self.model.names[k], 0.0)
        return predict(type(self.found.dynamics)(self.model, values), self.unseen)

    def errors(self, estimate: Estimate) -> list[float]:
        """Return the relative error ‖ρ‖/‖y‖ of each joint on the validation motion, in the identification band."""
        y, found = (self.unseen.motion.in_band(x) for x in (self.unseen.target, self.predicted(estimate)))
        return [float(x) for x in np.linalg.norm(y - found, axis=0) / np.linalg.norm(y, axis=0)]


def _kept(found: Identification, names: Sequence[str] = (), ratio: float = np.inf) -> Estimate:
    """Return the parameters that elimination keeps: down to `names`, or until max σ% / min σ% < ratio."""
    fitted, every = found.fitted, found.fitted.pooled.names
    drop = [name for name in every if name not in names] if names else ()
    limits: Any = {"ratio": ratio, "drop": drop, "std": fitted.std, "inflation": fitted.inflation}
    return eliminate(fitted.pooled, Rule.RSD, **limits).essential.estimate


class Trial:
    """Both methods on two motions without and with the payload, validated on a third motion with it."""

    def __init__(self, robot: Robot, one: Runs, two: Runs, other: Runs):
        self.idim, self.pim = (Method(robot, name, (one, two), other) for name in ("idim", "pim"))
        base = self.idim.found.base
        own = dict(zip(robot.model.names, robot.values))
        standard = np.array([own.get(name, 0.0) for name in self.idim.model.names])
        self.truth = dict(zip(self.idim.all.names, base.transform @ standard))
        self.inertial = sum(
            1 for k in base.kept if k < self.idim.model.inertial and not self.idim.model.names[k].endswith("5")
        )

    def metrics(self) -> dict[str, Any]:
        idim, pim = self.idim, self.pim
        estimates = {
            "idim": idim.nine, "pim": pim.nine, "pim_equal_legs": pim.equal_legs,
            "idim_all": idim.all, "pim_all": pim.all, "idim_free": idim.free, "pim_free": pim.free,
        }  # fmt: skip
        return {
            "methods": {name: self._table(estimate) for name, estimate in estimates.items()},
            "cross_validation": {"idim": idim.errors(idim.nine), "idim_all": idim.errors(idim.all)},
            "power_error": {"pim": pim.errors(pim.nine)[0], "pim_equal_legs": pim.errors(pim.equal_legs)[0]},
        }

    def _table(self, estimate: Estimate) -> dict[str, dict[str, float]]:
        errors = estimate.values - np.array([self.truth[name] for name in estimate.names])
        return {
            "values": dict(zip(estimate.names, estimate.values.tolist())),
            "sigma_percent": dict(zip(estimate.names, estimate.rsd.tolist())),
            "error_in_sigma": dict(zip(estimate.names, (errors / estimate.sigma).tolist())),
        }


def report(designs: list[Motion], found: list[Trial]) -> dict[str, Any]:
    """Return the metrics of all seeds."""
    return {
        "truth": {name: float(found[0].truth[name]) for name in NINE},
        "base_parameters": {name: getattr(found[0], name).found.base.b for name in ("idim", "pim")},
        "inertial_base_parameters": found[0].inertial,
        "designs": [motion.reached for motion in designs],
        "runs": [trial.metrics() for trial in found],
    }  # fmt: skip


def readme_rows(metrics: dict[str, Any]) -> list[str]:
    """Return the README's tables: values, stated sigmas [%], errors; medians (least to most) of the seeds."""

    def cell(values: list[float], form: str) -> str:
        middle, least, most = (f"{x:{form}}" for x in (np.median(values), min(values), max(values)))
        return f"{middle} ({least} to {most})"

    def of(method: str, kind: str, name: str) -> list[float]:
        return [run["methods"][method][kind][name] for run in metrics["runs"]]

    def largest(method: str, names: tuple[str, ...]) -> list[float]:
        tables = [run["methods"][method]["error_in_sigma"] for run in metrics["runs"]]
        return [max(abs(table[name]) for name in names if name in table) for table in tables]

    titles = " | ".join(f"{title} | paper" for title in METHODS.values())
    rows = ["", f"| value | truth | {titles} |", "|---" * 8 + "|"]
    sigmas = ["", f"| stated σ [%] | {titles} |", "|---" * 7 + "|"]
    for name in NINE:
        values, shares = [f"{metrics['truth'][name]:.4g}"], []
        for method, paper in PAPERS.items():
            tied = method == "pim_equal_legs" and name in LEGS[1:]
            values += ["=" if tied else cell(of(method, "values", name), ".4g"), f"{paper[name][0]:.3g}"]
            shares += ["=" if tied else cell(of(method, "sigma_percent", name), ".2f"), f"{paper[name][1]:.3g}"]
        for table, cells in ((rows, values), (sigmas, shares)):
            table.append(f"| {name}{'R' if name in NINE[:6] else ''} | {' | '.join(cells)} |")
    rows += sigmas
    cross = np.array([run["cross_validation"]["idim"] for run in metrics["runs"]]).T
    rows += ["", "| relative error on another loaded motion | x | y | rz |", "|---|---|---|---|"]
    rows.append(f"| IDIM | {' | '.join(cell(list(one), '.3f') for one in cross)} |")
    rows.append(f"| paper | {' | '.join(f'{x:.3f}' for x in CROSS)} |")
    rows += ["", f"| | {' | '.join(METHODS.values())} |", "|---|---|---|---|"]
    for words, names in (("leg inertias", LEGS), ("the others", NINE[4:])):
        rows.append(f"| largest error of {words} [σ] | {' | '.join(cell(largest(m, names), '.1f') for m in METHODS)} |")
    cells = [cell(largest(f"{name}_all", NINE), ".1f") for name in ("idim", "pim")]
    rows.append(f"| of the nine, all base parameters fitted [σ] | {' | '.join(cells)} | |")
    kept = [[len(run["methods"][f"{name}_free"]["values"]) for run in metrics["runs"]] for name in ("idim", "pim")]
    rows.append(f"| parameters that elimination keeps | {' | '.join(cell(one, '.0f') for one in kept)} | |")
    power = [[run["power_error"][name] for run in metrics["runs"]] for name in ("pim", "pim_equal_legs")]
    rows.append(f"| of the power, relative error | | {' | '.join(cell(one, '.3f') for one in power)} |")
    return rows


def figures(robot: Robot, trial: Trial, out: Path) -> None:
    """Draw the papers' figures for the loaded robot on the other motion: forces, torques, overconstraint, power."""
    idim, pim = trial.idim, trial.pim
    case = idim.unseen
    y, found = (case.motion.in_band(x) for x in (case.target, idim.predicted(idim.nine)))
    span = case.motion.t < case.motion.t[0] + 3.0
    t = case.motion.t[span]
    _draw(t, y[span], found[span], [f"F{c} [N]" if c != "rz" else "Mz [N m]" for c in COORDINATES], out / "forces.png")
    motion = idim.model.moved(case.motion.q[span], case.motion.v[span], case.motion.a[span])
    tau = case.motion.in_band(np.array(case.motion.effort))[span]
    c = overconstraint(robot.mechanism, motion.jacobians, tau)
    rebuilt = distributed(robot.mechanism, motion.jacobians, found[span], c)
    _draw(t, tau, rebuilt, [f"{name} [N m]" for name in robot.mechanism.robot.joint_names], out / "torques.png")
    _draw(t, c, np.full_like(c, PRELOAD), ["overconstraint [N m]"], out / "overconstraint.png")
    P, model = (pim.unseen.motion.in_band(x) for x in (pim.unseen.target, pim.predicted(pim.nine)))
    _draw(t, P[span], model[span], ["power [W]"], out / "power.png")


def _draw(t: np.ndarray, measured: np.ndarray, model: np.ndarray, labels: list[str], path: Path) -> None:
    figure, axes = plt.subplots(len(labels), 1, figsize=(7, 1.8 * len(labels) + 0.6), sharex=True, squeeze=False)
    for axis, label, one, two in zip(axes[:, 0], labels, measured.T, model.T):
        axis.plot(t, one, "r", lw=1.2, label="measured")
        axis.plot(t, two, "b", lw=0.8, label="model")
        axis.plot(t, one - two, "k", lw=0.6, label="error")
        axis.set_ylabel(label)
    axes[0, 0].legend(loc="upper right", fontsize=7, ncols=3)
    axes[-1, 0].set_xlabel("time [s]")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main()

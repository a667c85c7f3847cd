"""The DualV study: parameters of an actuation-redundant parallel robot by its inverse dynamic and power models.

    python examples/dualv/study.py --out dualv-study [--seed 0] [--readme]

A simulated DualV (Briot, Gautier & Krut 2013, two papers) runs designed motions without and with a payload of 5.37 kg,
under computed torque with an internal preload. IDIM-WLS on the platform's coordinates and PIM-WLS on the power identify
it from encoders and motor torques alone; the papers' Table II stands beside. The truth obeys the model, its friction
and noise are chosen: methods are compared, not a real robot's errors with the papers'.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.estimation.essential import Rule, eliminate
from calib.estimation.triangles import tie
from calib.identification.cases import Case, make_case
from calib.identification.identify import Identification, identify_model
from calib.identification.prediction import predict
from calib.identification.settings import IdentificationSettings
from calib.mechanism import library, parallel_files
from calib.mechanism.closure import closed
from calib.mechanism.computed_torque import ComputedTorque, ParallelRun, simulate
from calib.mechanism.distribution import distributed, overconstraint
from calib.mechanism.parallel_model import make_parallel_model, rows_named
from calib.procedure.excitation.settings import ExcitationSettings
from calib.procedure.parallel_stage.design import ParallelDesign, design_parallel

RATE, SECONDS = 1000.0, 6.0  # of a recording: Hz, s
PAYLOAD = {"M5": 5.37, "MX5": -0.127, "ZZ5": 0.0161}  # truth: mass as weighed, the others as the papers identify them
FRICTION = {"Fv": 0.05, "Fc": 0.3}  # of each motor: in the truth, in none of the papers' nine parameters
PRELOAD, TORQUE_NOISE, ENCODER_NOISE = 10.0, 2.0, 1e-5  # N m, N m, rad
ACCELERATION = 25 * 9.81
FILTER = FilterOptions(cutoff=120.0, band=40.0, borders=0.2)
NINE = ("ZZ11", "ZZ12", "ZZ13", "ZZ14", "ZZ4", "M4", "ZZ5", "MX5", "M5")  # the first six regrouped
LEGS = NINE[:4]
A_PRIORI = dict(zip(NINE, (0.0492, 0.0492, 0.0492, 0.0492, 0.0216, 2.0, None, None, 5.37)))
PAPERS = {  # identified value, sigma %: Table II of either paper
    "idim": dict(zip(NINE, ((4.45e-2, 1.58), (4.81e-2, 1.39), (4.81e-2, 1.41), (5.07e-2, 1.38), (2.06e-2, 1.37),
                            (1.92, 1.08), (1.61e-2, 1.71), (-0.127, 0.76), (5.42, 0.30)))),
    "pim": dict(zip(NINE, ((5.2e-2, 4.26), (4.1e-2, 4.49), (2.6e-2, 8.35), (4.0e-2, 5.58), (1.9e-2, 3.30),
                           (2.1, 1.22), (1.8e-2, 5.13), (-0.19, 23.39), (5.4, 0.20)))),
    "pim_case2": dict(zip(NINE, (*((3.9e-2, 2.28),) * 4, (2.0e-2, 3.23), (2.1, 1.17), (1.8e-2, 5.11),
                                 (-0.20, 22.07), (5.4, 0.20)))),
}  # fmt: skip
CROSS = (0.0987, 0.0841, 0.1492)  # the IDIM paper's relative errors of x, y, rz
COORDINATES = ("x", "y", "rz")
MARKS = ("<!-- the table is written by --readme -->", "<!-- end of the table -->")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("dualv-study"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--readme", action="store_true", help="put the table into the README beside this script")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    robot = Robot()
    designs = [robot.designed(options.seed + k) for k in range(2)]
    other = robot.designed(options.seed + 7, evaluations=6)
    seconds = {"design": time.perf_counter() - began}
    runs, loads = {}, {"empty": (), "loaded": ("5",)}
    for label, carried in loads.items():
        for k, one in enumerate((*designs, other)):
            name = f"{label} {'other motion' if one is other else k + 1}"
            runs[name] = robot.run(one, carried, 10 * options.seed + k)
    seconds["simulation"] = time.perf_counter() - began - seconds["design"]
    results = {name: Method(robot, name, runs, loads) for name in ("idim", "pim")}
    seconds["identification"] = time.perf_counter() - began - sum(seconds.values())
    found = report(robot, designs, results, options.out)
    seconds["all"] = time.perf_counter() - began
    metrics = found | {"seconds": seconds, "seed": options.seed}
    (options.out / "metrics.json").write_text(json.dumps(metrics, indent=1), encoding="utf-8")
    if options.readme:
        path = Path(__file__).with_name("README.md")
        head, rest = path.read_text(encoding="utf-8").split(MARKS[0])
        tail = MARKS[1] + rest.split(MARKS[1])[1]
        path.write_text("\n".join([head + MARKS[0], *readme_rows(metrics), tail]), encoding="utf-8")
    print(f"{seconds['all']:.0f} s; figures and metrics.json in {options.out}")


class Robot:
    """The simulated robot: library geometry, parameters of its file, friction, and a payload that may be on board."""

    def __init__(self) -> None:
        self.known = closed(parallel_files.read(library.path("dualv")))
        self.model = make_parallel_model(self.known, ["Fv Fc"], v0=0.05, payloads=["5"])
        bodies = self.model.known_parameters()
        self.values = np.concatenate([bodies, [FRICTION[one.name[:2]] for one in self.model.terms]])
        for name, value in PAYLOAD.items():
            self.values[self.model.names.index(name)] = value

    def designed(self, seed: int, evaluations: int = 30) -> ParallelDesign:
        """Return a motion that excites robot and payload within 127 N m (a fifth of it kept free) and 25 g."""
        settings = ExcitationSettings(period=0.5, harmonics=5, starts=1, evaluations=evaluations, seed=seed, rate=RATE)
        limits = np.array([ACCELERATION, ACCELERATION, np.inf])
        return design_parallel(
            self.model, settings, values=self.values, acceleration=limits, margin=0.2, preload=PRELOAD, index="logdet"
        )

    def run(self, design: ParallelDesign, carried: tuple[str, ...], seed: int) -> ParallelRun:
        controller = ComputedTorque(self.values, preload=PRELOAD, rate=RATE, encoder=ENCODER_NOISE, torque=TORQUE_NOISE)
        orders = design.orders(np.arange(int(SECONDS * RATE)) / RATE)
        return simulate(self.model, self.values, controller, *orders, carried, seed)


class Method:
    """What one method makes of the recordings: IDIM on the platform's coordinates, or PIM on the power."""

    def __init__(self, robot: Robot, name: str, runs: dict[str, ParallelRun], loads: dict[str, tuple[str, ...]]):
        rows = rows_named(robot.known, "platform" if name == "idim" else "power")
        self.model = make_parallel_model(robot.known, ["Ia Fv Fc"], v0=0.05, rows=rows, payloads=["5"])
        cases = {}
        for label, run in runs.items():
            recording = Recording(run.t, run.q, run.tau, "torque", robot.known.robot.joint_names, file=label)
            carried = loads[label.split()[0]]
            cases[label] = make_case(label, make_motion(recording, FILTER), rows, carried=carried)
        self.cases = [case for label, case in cases.items() if "other" not in label]
        self.unseen = [case for label, case in cases.items() if "other" in label]
        settings = IdentificationSettings(prior="none", essential="none", torque_rows=rows)
        self.found: Identification = identify_model(self.model, self.cases, settings)
        pooled, std = self.found.fitted.pooled, self.found.fitted.std
        inflation = self.found.fitted.inflation
        others = [one for one in pooled.names if one not in NINE]
        self.free = eliminate(pooled, Rule.RSD, ratio=10.0, std=std, inflation=inflation).essential.estimate
        self.nine = eliminate(
            pooled, Rule.RSD, ratio=1e9, drop=others, std=std, inflation=inflation
        ).essential.estimate  # fmt: skip
        tied = tie(pooled, [LEGS])
        rest = [one for one in others if one in tied.names]
        self.identical = eliminate(
            tied, Rule.RSD, ratio=1e9, drop=rest, std=std, inflation=inflation
        ).essential.estimate  # fmt: skip

    def predicted(self, case: Case, estimate) -> np.ndarray:
        """Return the rows that an estimate of base parameters predicts for a recording."""
        values = np.zeros(self.model.p)
        known = dict(zip(estimate.names, estimate.values))
        for k in self.found.base.kept:
            values[k] = known.get(self.model.names[k], 0.0)
        return predict(type(self.found.dynamics)(self.model, values), case)

    def errors(self, case: Case, estimate) -> list[float]:
        """Return ‖ρ‖/‖y‖ by row, both sides in the identification band."""
        y, found = (case.motion.in_band(x) for x in (case.target, self.predicted(case, estimate)))
        return [float(x) for x in np.linalg.norm(y - found, axis=0) / np.linalg.norm(y, axis=0)]


def report(robot: Robot, designs: list[ParallelDesign], results: dict[str, Method], out: Path) -> dict:
    """Print the papers' table beside ours, draw the figures, and return the metrics."""
    idim, pim = results["idim"], results["pim"]
    truth = dict(zip(idim.found.fitted.pooled.names, idim.found.base.transform @ _values_of(robot, idim)))
    tables = {
        "idim": idim.nine, "pim": pim.nine, "pim_case2": pim.identical, "idim_case2": idim.identical,
        "idim_free": idim.free, "pim_free": pim.free,
    }  # fmt: skip
    metrics: dict = {"methods": {name: _table(estimate, truth) for name, estimate in tables.items()}}
    metrics["truth"] = {name: float(truth[name]) for name in NINE}
    metrics["base_parameters"] = {name: one.found.base.b for name, one in results.items()}
    metrics["inertial_base_parameters"] = sum(
        1 for k in idim.found.base.kept if k < idim.model.inertial and not idim.model.names[k].endswith("5")
    )
    metrics["payload_kg"] = {name: _of(estimate, "M5")[0] for name, estimate in tables.items()}
    loaded = {name: one.unseen[-1] for name, one in results.items()}
    metrics["cross_validation"] = {
        "coordinates": list(COORDINATES), "papers": list(CROSS),
        "idim": idim.errors(loaded["idim"], idim.nine),
        "idim_all_base": idim.errors(loaded["idim"], idim.found.fitted.estimate),
        "pim": pim.errors(loaded["pim"], pim.nine), "pim_case2": pim.errors(loaded["pim"], _untied(pim.identical)),
    }  # fmt: skip
    metrics["design"] = [
        {"condition": one.condition, "peak_torque": one.peak.tolist(), "peak_g": (one.fastest[:2] / 9.81).tolist()}
        for one in designs
    ]
    print(f"{'':8}{'a priori':>10}{'IDIM':>18}{'papers':>18}{'PIM':>18}{'papers':>18}{'PIM case 2':>18}{'papers':>18}")
    for name in NINE:
        cells = [f"{A_PRIORI[name] or truth[name]:>10.4g}"]
        for key in PAPERS:
            cells += [_cell(*_of(tables[key], name)), _cell(*PAPERS[key][name])]
        print(f"{name:8}" + "".join(cells))
    cross = metrics["cross_validation"]
    print("cross-validation, relative errors of x, y, rz:", *(f"{x:.3f}" for x in cross["idim"]), "papers", *CROSS)
    print("of the power:", *(f"{x:.3f}" for x in cross["pim"]), "case 2", *(f"{x:.3f}" for x in cross["pim_case2"]))
    for key in ("idim_free", "pim_free"):
        print(
            f"{key}: elimination to max/min sigma% < 10 keeps {len(tables[key].names)}: {', '.join(tables[key].names)}"
        )
    figures(robot, idim, pim, out)
    return metrics


def readme_rows(metrics: dict) -> list[str]:
    """Return the README's table: values with sigma [%] by inverse dynamics, power, and power with equal legs."""
    rows = [
        "| | truth | IDIM | paper | PIM | paper | PIM, equal legs | paper |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in NINE:
        cells = [f"{metrics['truth'][name]:.4g}"]
        for key in PAPERS:
            own = metrics["methods"][key]
            if name in own["values"]:
                cells.append(f"{own['values'][name]:.4g} ({own['sigma_percent'][name]:.1f})")
            else:
                cells.append("=")
            cells.append("{:.3g} ({:.1f})".format(*PAPERS[key][name]))
        rows.append(f"| {name}{'R' if name in NINE[:6] else ''} | {' | '.join(cells)} |")
    cross = metrics["cross_validation"]
    rows += ["", "| relative error on another loaded motion | x | y | rz |", "|---|---|---|---|"]
    for words, values in (("IDIM", cross["idim"]), ("paper", cross["papers"])):
        rows.append(f"| {words} | {' | '.join(f'{x:.3f}' for x in values)} |")
    rows += ["", "| | IDIM | PIM | PIM, equal legs |", "|---|---|---|---|"]
    for words, names in (("leg inertias", LEGS), ("the others", NINE[4:])):
        own = ([metrics["methods"][key]["error_in_sigma"].get(name, 0.0) for name in names] for key in PAPERS)
        rows.append(f"| largest error of {words} [σ] | {' | '.join(f'{max(map(abs, each)):.1f}' for each in own)} |")
    kept = [len(metrics["methods"][f"{name}_free"]["values"]) for name in ("idim", "pim")]
    rows.append(f"| parameters that elimination keeps | {kept[0]} | {kept[1]} | |")
    rows.append(f"| of the power, relative error | | {cross['pim'][0]:.3f} | {cross['pim_case2'][0]:.3f} |")
    return rows


def _values_of(robot: Robot, method: Method) -> np.ndarray:
    """Return the truth in the columns of a method's model."""
    own = dict(zip(robot.model.names, robot.values))
    return np.array([own.get(name, 0.0) for name in method.model.names])


def _untied(estimate):
    """Return an estimate of identical legs with the value of the first at each."""
    from dataclasses import replace

    index = [estimate.names.index(LEGS[0] if name in LEGS else name) for name in NINE]
    covariance = estimate.covariance[np.ix_(index, index)]
    return replace(
        estimate, names=NINE, units=tuple(estimate.units[k] for k in index), values=estimate.values[index],
        covariance=covariance,
    )  # fmt: skip


def _of(estimate, name: str) -> tuple[float, float]:
    """Return value and sigma [%] of a parameter."""
    key = LEGS[0] if name in LEGS and name not in estimate.names else name
    k = estimate.names.index(key)
    return float(estimate.values[k]), float(estimate.rsd[k])


def _table(estimate, truth: dict[str, float]) -> dict:
    errors = estimate.values - np.array([truth[name] for name in estimate.names])
    return {
        "values": dict(zip(estimate.names, estimate.values.tolist())),
        "sigma_percent": dict(zip(estimate.names, estimate.rsd.tolist())),
        "error_in_sigma": dict(zip(estimate.names, (errors / estimate.sigma).tolist())),
    }


def _cell(value: float, percent: float) -> str:
    return f"{value:>10.4g} ({percent:4.2f}%)"


def figures(robot: Robot, idim: Method, pim: Method, out: Path) -> None:
    """Draw the papers' figures for the loaded robot on the other motion: forces, torques, overconstraint, power."""
    case = idim.unseen[-1]
    y, found = (case.motion.in_band(x) for x in (case.target, idim.predicted(case, idim.nine)))
    span = case.motion.t < case.motion.t[0] + 3.0
    t = case.motion.t[span]
    _draw(t, y[span], found[span], [f"F{c} [N]" if c != "rz" else "Mz [N m]" for c in COORDINATES], out / "forces.png")
    motion = idim.model.moved(case.motion.q[span], case.motion.v[span], case.motion.a[span])
    tau = case.motion.in_band(np.array(case.motion.effort))[span]
    c = overconstraint(robot.known, motion.jacobians, tau)
    rebuilt = distributed(robot.known, motion.jacobians, found[span], c)
    _draw(t, tau, rebuilt, [f"{name} [N m]" for name in robot.known.robot.joint_names], out / "torques.png")
    _draw(t, c, np.full_like(c, PRELOAD), ["overconstraint [N m]"], out / "overconstraint.png")
    power = pim.unseen[-1]
    P, model = (power.motion.in_band(x) for x in (power.target, pim.predicted(power, pim.nine)))
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

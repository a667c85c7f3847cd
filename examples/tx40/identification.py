"""The TX40 study, scripted: least squares against instrumental variables on clean and on degraded data.

After Janot's slides (TX40, IDIM-LS, IDIM-IV, PC-IDIM-IV), with a simulated robot: BIRDy's parameters and controller,
the coupled wrist, six torque offsets, 60 base parameters; 5 kHz control, 1 kHz log, 50 Hz Butterworth, 20 Hz parallel
decimation. By construction, so no evidence about a real arm: the size of what no model holds (5 % of the torque,
coloured at 10 Hz), and the noise of the degraded data. The slides do not say how they degraded; here, twice:

    degraded    white noise on the logged positions only, of the size that brings least squares to the slides' 25 %
    in the loop position noise that the controller acts on, coloured at 10 Hz: the torques answer it, so that noise of
                the regressor and of the torque are correlated through the loop, which is why IV exists

A direct error of least squares is |y - W x| with the noisy W, one of IV is |y - Z x| with the simulated Z: no other
reading lets IV come out below least squares on its own rows, and the slides' do. It judges robot and controller at
once: with a wrong controller it grows although the parameters stay right, and of noise in the loop it holds the torques
that answered the noise, which no prediction can. `torque_error` compares fairly: the torque of another motion,
noise-free, against the truth. A dash: that estimate could not be simulated along that motion.

    python examples/tx40/identification.py --out tx40-study [--quick] [--seed 0] [--tried NAME …] [--methods NAME …]
        [--readme]
"""

from __future__ import annotations

import argparse
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.dynamics import base as bases
from calib.errors import CalibError, NotConverged
from calib.estimation.essential import Rule, eliminate
from calib.estimation.linear import subsystem_std
from calib.estimation.triangles import collect, combine
from calib.estimation.whiteness import examine
from calib.identification.closed_loop.controllers import identify_controller, pd
from calib.identification.closed_loop.instrumental import Instrumental, Round, identify_instrumental
from calib.identification.closed_loop.loop_recordings import Loop, simulated_case
from calib.identification.methods.parameter_constraints import hold, make_constraints
from calib.identification.rows import ObservationRows
from calib.simulation import known_robots
from calib.simulation.known_robots import trapezoidal
from calib.toolkit.recordings import FilterOptions, Recording, make_motion
from calib.toolkit.simulations import LoopController, Plant, Reference, Sensing, SimulatedRun, random_fourier, simulate
from calib.toolkit.statistics import LinearFit
from calib.toolkit.torque_models import Base, Case, ConstraintSettings, IdentificationModel, make_case, observe

RATE, EVERY = 5000.0, 5
FILTERS = FilterOptions(cutoff=50.0, band=20.0, clock="stamps")
REACH = np.array([2.8, 1.8, 2.0, 3.5, 1.9, 4.0])  # [rad]
SPEED = 0.8 * np.deg2rad([287.0, 287.0, 430.0, 410.0, 320.0, 700.0])
OFFSETS = np.array([0.3, -0.4, 0.2, 0.1, -0.1, 0.05])  # [N m], chosen
UNMODELLED = 0.05  # of each joint's rms torque, chosen
DEGRADED = np.array([2.3, 2.7, 7.0, 9.0, 12.0, 13.0]) * 1e-3  # noise of the logged positions [rad], chosen: see above
LOOP, LOOP_BAND = 3e-4, 10.0  # noise of the positions that the controller sees [rad], its colour [Hz], chosen
KINDS = ("clean", "degraded", "in the loop")
METHODS = ("IV", "PC-IV", "DIDIM")  # the table has the first two
TRIED = ("identified", "kp +30 %, kd -30 %", "bandwidth / 2", "bandwidth / 3")  # controllers, on degraded data
MARKS = ("<!-- the table is written by --readme -->", "<!-- end of the table -->")
SLIDES = {
    "clean": {"direct": {"LS": [5.2, 5.0, 5.0, 5.6, 7.2, 7.1], "IV": [5.4, 5.3, 5.1, 5.7, 7.2, 7.5]},
              "cross": {"LS": [6.1, 6.3, 6.7], "IV": [6.4, 6.8, 7.0]}},
    "degraded": {"direct": {"LS": [25.3, 24.7, 25.2, 25.8, 27.5, 28.0], "IV": [6.1, 5.9, 6.0, 5.9, 8.0, 8.1]},
                 "cross": {"LS": [26.4, 26.5, 27.8], "IV": [7.1, 7.6, 7.9]}},
    "identified controllers": {"direct": {"IV": [6.1, 6.3, 5.9, 6.4, 7.9, 8.1]}},
    "essential": 27,
}  # fmt: skip


@dataclass(frozen=True)
class Log:
    """One recorded motion: what was asked, what is true, positions as logged, and what identification sees of them."""

    reference: Reference
    run: SimulatedRun
    seen: np.ndarray
    case: Case
    rows: ObservationRows


@dataclass(frozen=True)
class Study:
    """Data shared by all parts of the study."""

    plant: Plant
    model: IdentificationModel
    base: Base
    controller: LoopController
    seed: int

    @property
    def truth(self) -> np.ndarray:
        return self.base.transform @ self.plant.parameters


def references(quick: bool, seed: int) -> tuple[Reference, list[Reference]]:
    """Return the training motion (best condition number of some random motions) and three other motions."""
    model = known_robots.model(known_robots.plant("tx40", coupled=True, offset=OFFSETS))
    kept = bases.find(model).kept
    duration = 8.0 if quick else 10.0

    def draw(number: int) -> Reference:
        return random_fourier(-REACH, REACH, SPEED, duration, RATE, 20, acceleration=40.0, seed=[seed, number])

    def condition(reference: Reference) -> float:
        part = slice(None, None, 50)
        matrix = model.regressor(reference.q[part], reference.v[part], reference.a[part])[:, :, kept]
        matrix = matrix.reshape(-1, len(kept))
        return float(np.linalg.cond(matrix / np.linalg.norm(matrix, axis=0)))

    training = min((draw(number) for number in range(5 if quick else 30)), key=condition)
    points = np.random.default_rng([seed, 99]).uniform(-0.7, 0.7, (4 if quick else 8, 6)) * REACH
    moves = trapezoidal(points, 0.6 * SPEED, 12.0, RATE, pause=0.2)
    return training, [draw(1001), draw(1002), moves]


def unmodelled(study: Study, reference: Reference) -> np.ndarray:
    """Return the size of the torque that no model holds (n,) [N m], from the torque of a motion without noise."""
    silent = simulate(study.plant, study.controller, reference, Sensing(every=EVERY))
    return UNMODELLED * np.sqrt(np.mean(silent.torque**2, axis=0))


def record(study: Study, reference: Reference, push: np.ndarray, kind: str, number: int) -> Log:
    """Simulate a motion with noise and unmodelled torque of a size, and log it."""
    sensing = Sensing(np.deg2rad(1e-4), 0.0, 0.05, push, push_band=10.0, every=EVERY)
    if kind == "in the loop":
        sensing = replace(sensing, sigma_q=LOOP, q_band=LOOP_BAND)
    run = simulate(study.plant, study.controller, reference, sensing, [study.seed, number])
    seen = run.measured
    if kind == "degraded":
        seen = seen + DEGRADED * np.random.default_rng([study.seed, number, 7]).normal(size=seen.shape)
    recording = Recording(run.t, seen, run.tau, "torque", tuple(f"joint_{j + 1}" for j in range(6)), file=kind)
    case = make_case(kind, make_motion(recording, FILTERS))
    return Log(reference, run, seen, case, observe(study.model, study.base.kept, case, case.motion.decimator))


def relative(target: np.ndarray, predicted: np.ndarray) -> tuple[float, list[float]]:
    """Return 100 ‖τ - τ̂‖ / ‖τ‖ [%] of all joints and of each."""
    gone, size = target - predicted, target
    joints = 100.0 * np.linalg.norm(gone, axis=0) / np.linalg.norm(size, axis=0)
    return float(100.0 * np.linalg.norm(gone) / np.linalg.norm(size)), joints.tolist()


def with_measured(log: Log, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return decimated torque and prediction W x, W from the log."""
    return log.rows.target, log.rows.matrix @ values


def with_simulated(
    study: Study, log: Log, values: np.ndarray, controller: LoopController
) -> tuple[np.ndarray, np.ndarray]:
    """Return decimated torque and prediction Z x, Z from a noise-free simulation with x itself."""
    plant = Plant(study.model.bodies, study.model.terms, study.base.to_standard(values))
    loop = Loop(controller, log.reference, EVERY)
    own = simulated_case(log.case, simulate(plant, controller, log.reference, Sensing(every=EVERY)), loop)
    rows = observe(study.model, study.base.kept, own, log.case.motion.decimator)
    return rows.target, rows.matrix @ values


def torque_error(study: Study, reference: Reference, values: np.ndarray) -> list[float]:
    """Return the error of the torque along a reference, joint by joint, against the truth [%]: no noise anywhere."""
    part = slice(None, None, 20)
    matrix = study.model.regressor(reference.q[part], reference.v[part], reference.a[part])[:, :, study.base.kept]
    return relative(matrix @ study.truth, matrix @ values)[1]


def judge(
    study: Study, training: Log, others: list[Log], results: dict[str, Instrumental], controller: LoopController
) -> dict[str, Any]:
    """Return the errors of least squares and of instrumental methods (direct and cross), and the test results."""
    first = next(iter(results.values()))
    values = {"LS": first.ordinary.estimate.values, "PC-LS": consistent(study, first).estimate.values}
    values |= {name: result.fit.estimate.values for name, result in results.items()}

    def predicted(name: str, log: Log) -> tuple[np.ndarray, np.ndarray]:
        return (
            with_measured(log, values[name])
            if name.endswith("LS")
            else with_simulated(study, log, values[name], controller)
        )

    def cross(name: str, log: Log) -> float | None:
        try:
            return relative(*predicted(name, log))[0]
        except CalibError:  # a poor estimate need not be a possible robot everywhere
            return None

    return {
        "direct": {name: relative(*predicted(name, training))[1] for name in values},
        "cross": {name: [cross(name, log) for log in others] for name in values},
        "torque_error": {name: torque_error(study, others[0].reference, own) for name, own in values.items()},
        "estimated": len(first.names),
        "rounds": {name: [vars(one) for one in finite(result)] for name, result in results.items()},
        "verdict": verdict(first),
        "constrained_forms_apart": float(results["PC-IV"].apart.max()),
    }


def consistent(study: Study, result: Instrumental) -> LinearFit:
    """Return the least-squares estimate of the same rows with the sign constraints of PC-IV (PC-IDIM-LS)."""
    data, std = result.problem.least_squares(), result.ordinary.group_std
    bounds = dict.fromkeys(signs(result.names), (0.0, np.inf))
    settings = ConstraintSettings(signs=False, inertia=0, bounds=bounds)
    asked = make_constraints(settings, study.model, study.base, result.names, [None] * study.base.b)
    return hold(result.ordinary, combine(data, std), data, std, asked, stated_noise=True)[0]


def finite(result: Instrumental) -> list[Round]:
    """Return the rounds of an iteration; a change that is not finite (first round) becomes 1."""
    return [one if np.isfinite(one.change) else replace(one, change=1.0) for one in result.rounds]


def verdict(result: Instrumental) -> dict[str, Any]:
    """Return the test of least squares, and the largest difference of both estimates in standard deviations."""
    return {
        "F": result.verdict.statistic, "p": result.verdict.p, "least_squares_biased": result.verdict.biased(),
        "largest_shift_in_sigma": float(result.shift.max()), "cragg_donald": result.strength.cragg_donald,
        "instruments_valid": result.valid,
    }  # fmt: skip


def estimate(study: Study, log: Log, controller: LoopController, method: str) -> Instrumental:
    """Return the estimate of IV, PC-IV or DIDIM from a log, with an assumed controller.

    The regular robot they start from has the motors' inertia, as on a data sheet.
    """
    return identify_instrumental(
        study.model, study.base, [(log.case, Loop(controller, log.reference, EVERY))], log.case.motion.decimator,
        method="didim" if method == "DIDIM" else "iv", limit=20,
        inertia=np.array(known_robots.truth("tx40")["drives"]["Ia"]),
        positive=signs(study.base.names) if method == "PC-IV" else (),
    )  # fmt: skip


def essential_count(study: Study, training: Log) -> dict[str, Any]:
    """Return the number of base parameters that an F-test keeps on clean data (the slides: 27 of 60)."""
    rows = training.rows
    samples, joints, p = rows.matrix.shape
    group = np.repeat(np.arange(joints), samples)
    matrix, target = rows.matrix.transpose(1, 0, 2).reshape(-1, p), rows.target.T.ravel()
    data = collect(matrix, target, group, study.base.names, study.base.units)
    gone = eliminate(data, Rule.F, std=subsystem_std(data))
    return {"F": len(gone.kept), "names": [study.base.names[k] for k in gone.kept], "slides": SLIDES["essential"]}


def controllers(study: Study, log: Log) -> dict[str, LoopController]:
    """Return the controllers to try on degraded data: identified from that log, and wrong ones."""
    found = identify_controller(log.reference, log.seen, np.asarray(log.run.tau), RATE / EVERY)
    right = study.controller
    assumed = (found.controller, pd(1.3 * right.kp, 0.7 * right.kd), right.slower(2.0), right.slower(3.0))
    return dict(zip(TRIED, assumed))


def run(
    out: Path, quick: bool = False, seed: int = 0, tried: Container[str] = TRIED, methods: Sequence[str] = METHODS
) -> dict[str, Any]:
    """Run the study, on degraded data with the named ones of the controllers; write and return the metrics."""
    plant = known_robots.plant("tx40", coupled=True, offset=OFFSETS)
    model = known_robots.model(plant)
    study = Study(plant, model, bases.find(model), known_robots.controller("tx40"), seed)
    training, others = references(quick, seed)
    metrics: dict[str, Any] = {
        "parameters": {"standard": model.p, "base": study.base.b},
        "by_construction": ["unmodelled torque", "noise of the degraded data", "offsets", "truth"],
        "slides": SLIDES,
    }
    pushes = [unmodelled(study, reference) for reference in (training, *others)]
    for kind in KINDS[: 2 if quick else None]:
        motions = enumerate(zip((training, *others), pushes))
        log, *rest = (record(study, reference, push, kind, number) for number, (reference, push) in motions)
        if kind == "clean":
            metrics["essential"] = essential_count(study, log)
        results = {name: estimate(study, log, study.controller, name) for name in methods}
        metrics[kind] = judge(study, log, rest, results, study.controller)
        draw(study, log, results["IV"], out / f"residuals_{kind.replace(' ', '_')}.png")
        if kind == "degraded":
            metrics["wrong controllers"] = {}
            for name, controller in controllers(study, log).items():
                if name not in tried:
                    continue
                try:
                    found = {each: estimate(study, log, controller, each) for each in ("IV", "PC-IV")}
                except NotConverged as error:  # a wrong controller need not hold the robot
                    metrics["wrong controllers"][name] = {"failed": str(error)}
                else:
                    metrics["wrong controllers"][name] = judge(study, log, rest, found, controller)
    metrics["parameters"]["essential"] = metrics["essential"]["F"]
    files.write_json(out / "metrics.json", metrics)
    return metrics


def signs(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of parameters that physics keeps positive: Ia, Fv, Fc, and moments ZZ about joint axes."""
    return tuple(name for name in names if name.startswith(("Ia", "Fv", "Fc", "ZZ")))


def show(metrics: dict[str, Any]) -> None:
    """Print the tables next to those of the slides."""
    count = metrics["parameters"]
    print(
        f"{count['standard']} standard, {count['base']} base parameters; F-test keeps {count['essential']} (slides: 27)"
    )
    for kind in filter(metrics.__contains__, KINDS):
        table(kind, metrics[kind], SLIDES.get(kind, {}))
    for name, found in metrics["wrong controllers"].items():
        if "failed" in found:
            print(f"\ndegraded, controller {name}: {found['failed']}")
            continue
        table(f"degraded, controller {name}", found, {})


def table(title: str, found: dict[str, Any], slides: dict[str, Any]) -> None:
    """Print one set [%]: direct and torque_error joint by joint, cross motion by motion."""
    said, rounds = found["verdict"], {name: len(one) for name, one in found["rounds"].items()}
    test = f"F = {said['F']:.3g}, largest shift {said['largest_shift_in_sigma']:.2g} sigma"
    print(f"\n{title}: {found['estimated']} parameters, rounds {rounds}")
    print(f"  least squares biased: {said['least_squares_biased']} ({test})")
    for part in ("direct", "cross", "torque_error"):
        for method, errors in found[part].items():
            known = slides.get(part, {}).get(method)
            beside = "" if known is None else "   slides " + " ".join(f"{x:5.1f}" for x in known)
            print(f"  {part:12} {method:6}" + " ".join("     -" if x is None else f"{x:6.2f}" for x in errors) + beside)


def draw(study: Study, log: Log, found: Instrumental, path: Path) -> None:
    """Draw autocorrelation, partial autocorrelation and histogram of residuals, joint by joint, as the slides do."""
    import matplotlib.pyplot as plt

    series = {
        "LS": np.subtract(*with_measured(log, found.ordinary.estimate.values)),
        "IV": np.subtract(*with_simulated(study, log, found.fit.estimate.values, study.controller)),
    }
    figure, axes = plt.subplots(3, 6, figsize=(15, 7))
    for j in range(6):
        for k, (name, values) in enumerate(series.items()):
            looked = examine(values[:, j])
            lags = np.arange(1, len(looked.acf) + 1) + 0.3 * k
            for axis, heights in ((axes[0, j], looked.acf), (axes[1, j], looked.pacf)):
                axis.vlines(lags, 0.0, heights, color=f"C{k}", lw=1.0, label=name)
                axis.axhspan(-looked.bound, looked.bound, color="0.9", zorder=0)
                axis.set_ylim(-0.6, 1.0)
            axes[2, j].hist(values[:, j] / values[:, j].std(), 40, histtype="step", color=f"C{k}", density=True)
        x = np.linspace(-4.0, 4.0, 100)
        axes[2, j].plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), "k:", lw=0.8)
        axes[0, j].set_title(f"joint {j + 1}")
    for row, name in zip(axes[:, 0], ("autocorrelation", "partial autocorrelation", "residual / std")):
        row.set_ylabel(name)
    axes[0, 0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def readme_rows(metrics: dict[str, Any]) -> list[str]:
    """Return the README's table [%]: joints 1 to 6, or three other motions."""
    sets = {kind: metrics[kind] for kind in KINDS if kind in metrics}
    sets |= {
        f"degraded, {name}": found for name, found in metrics["wrong controllers"].items() if "failed" not in found
    }
    rows = ["| | LS | PC-LS | IV | PC-IV | slides: LS, IV |", "|---|---|---|---|---|---|"]
    for kind, found in sets.items():
        known = SLIDES.get("identified controllers" if kind == "degraded, identified" else kind, {})
        for part, words in (("direct", "direct"), ("cross", "cross"), ("torque_error", "another motion, noise-free")):
            cells = [_cell(found[part][name]) for name in ("LS", "PC-LS", "IV", "PC-IV")]
            said = [_cell(known[part][name]) if name in known.get(part, {}) else "–" for name in ("LS", "IV")]
            rows.append(f"| {kind}, {words} | {' | '.join(cells)} | {' / '.join(said) if known.get(part) else '–'} |")
    return rows


def _cell(values: list[float | None]) -> str:
    return " ".join("–" if x is None else f"{x:.1f}" for x in values)


def write_readme(metrics: dict[str, Any], path: Path) -> None:
    """Put the table between the marks of a README."""
    text = path.read_text(encoding="utf-8")
    head, rest = text.split(MARKS[0])
    files.write(path, "\n".join([head + MARKS[0], *readme_rows(metrics), MARKS[1] + rest.split(MARKS[1])[1]]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for metrics.json")
    parser.add_argument("--quick", action="store_true", help="shorter motions, fewer candidates, two sets")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tried", nargs="+", choices=TRIED, default=TRIED, help="controllers on degraded data")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS, help="IV and PC-IV among them")
    parser.add_argument("--readme", action="store_true", help="put the table into the README beside this script")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    metrics = run(options.out, options.quick, options.seed, options.tried, options.methods)
    show(metrics)
    if options.readme:
        write_readme(metrics, Path(__file__).with_name("README.md"))


if __name__ == "__main__":
    main()

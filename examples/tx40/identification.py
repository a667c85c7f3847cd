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
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import calib
from calib import files
from calib.dynamics import base as bases
from calib.errors import NotConverged
from calib.estimation.essential import Rule, eliminate
from calib.estimation.linear import subsystem_std
from calib.estimation.triangles import collect, combine
from calib.estimation.whiteness import examine
from calib.identification.closed_loop.controllers import identify_controller, pd
from calib.identification.closed_loop.instrumental import Instrumental, identify_instrumental
from calib.identification.closed_loop.instrumental_variables import projected
from calib.identification.closed_loop.loop_recordings import Loop, simulated_case
from calib.identification.methods.constraint_settings import Held
from calib.identification.methods.parameter_constraints import hold, make_constraints
from calib.identification.rows import ObservationRows
from calib.simulation import known_robots
from calib.simulation.known_robots import trapezoidal
from calib.toolkit.recordings import FilterOptions, Recording, make_motion
from calib.toolkit.simulations import LoopController, Plant, Reference, Sensing, SimulatedRun, random_fourier, simulate
from calib.toolkit.statistics import LinearFit
from calib.toolkit.torque_models import Base, Case, ConstraintSettings, IdentificationModel, make_case, observe

# rate of the controller [Hz], and control periods per logged sample
RATE, EVERY = 5000.0, 5
FILTERS = FilterOptions(cutoff=50.0, band=20.0, clock="stamps")
# random motions: amplitudes [rad], speeds [rad/s], largest acceleration [rad/s²], harmonics
REACH = np.array([2.8, 1.8, 2.0, 3.5, 1.9, 4.0])
SPEED = 0.8 * np.deg2rad([287.0, 287.0, 430.0, 410.0, 320.0, 700.0])
ACCELERATION, HARMONICS = 40.0, 20
# torque offsets [N m], chosen
OFFSETS = np.array([0.3, -0.4, 0.2, 0.1, -0.1, 0.05])
# σ of the encoders [rad] and of the logged torques [N m]
ENCODER_NOISE, TORQUE_NOISE = np.deg2rad(1e-4), 0.05
# unmodelled torque: share of each joint's rms torque, chosen; its colour [Hz]
UNMODELLED, UNMODELLED_BAND = 0.05, 10.0
# noise of the logged positions of degraded data [rad], chosen: see above
DEGRADED = np.array([2.3, 2.7, 7.0, 9.0, 12.0, 13.0]) * 1e-3
# noise of the positions that the controller sees [rad], its colour [Hz], chosen
LOOP, LOOP_BAND = 3e-4, 10.0
# rounds of an iteration, at most
MAX_ROUNDS = 20
KINDS = ("clean", "degraded", "in the loop")
# the table has the first two
METHODS = ("IV", "PC-IV", "DIDIM")
COLUMNS = ("LS", "PC-LS", "IV", "PC-IV")
# controllers, on degraded data
TRIED = ("identified", "kp +30 %, kd -30 %", "bandwidth / 2", "bandwidth / 3")
MARKS = ("<!-- the table is written by --readme -->", "<!-- end of the table -->")
# kinds of error and their labels in the README
PARTS = {"direct": "direct", "cross": "cross", "torque_error": "another motion, noise-free"}
# errors in the slides [%], and the number of their essential parameters
SLIDES = {
    "clean": {
        "direct": {"LS": [5.2, 5.0, 5.0, 5.6, 7.2, 7.1], "IV": [5.4, 5.3, 5.1, 5.7, 7.2, 7.5]},
        "cross": {"LS": [6.1, 6.3, 6.7], "IV": [6.4, 6.8, 7.0]},
    },
    "degraded": {
        "direct": {"LS": [25.3, 24.7, 25.2, 25.8, 27.5, 28.0], "IV": [6.1, 5.9, 6.0, 5.9, 8.0, 8.1]},
        "cross": {"LS": [26.4, 26.5, 27.8], "IV": [7.1, 7.6, 7.9]},
    },
    "identified controllers": {"direct": {"IV": [6.1, 6.3, 5.9, 6.4, 7.9, 8.1]}},
    "essential": 27,
}
Metrics = dict[str, Any]


@dataclass(frozen=True)
class Log:
    """One recorded motion.

    Attributes:
        reference: the motion that the controller was asked for.
        run: the simulated run.
        positions: (N, n) positions as logged [rad].
        case: the filtered recording.
        rows: its rows for identification.
    """

    reference: Reference
    run: SimulatedRun
    positions: np.ndarray
    case: Case
    rows: ObservationRows


@dataclass(frozen=True)
class Study:
    """Data shared by all parts of the study.

    Attributes:
        plant: the true robot.
        model: the model to identify.
        base: its base parameters.
        controller: the true controller.
        seed: seed of all noise.
    """

    plant: Plant
    model: IdentificationModel
    base: Base
    controller: LoopController
    seed: int

    @property
    def truth(self) -> np.ndarray:
        """True base parameters (b,)."""
        return self.base.transform @ self.plant.parameters


@dataclass(frozen=True)
class Extent:
    """How much of the study is run.

    Attributes:
        duration: duration of a random motion [s].
        candidates: random motions of which the training motion is the best.
        points: points of the moves.
        kinds: kinds of data.
    """

    duration: float = 10.0
    candidates: int = 30
    points: int = 8
    kinds: tuple[str, ...] = KINDS


QUICK = Extent(8.0, 5, 4, KINDS[:2])


def references(extent: Extent, seed: int) -> tuple[Reference, list[Reference]]:
    """Return the training motion (best condition number of some random motions) and three other motions."""
    model = known_robots.model(known_robots.plant("tx40", coupled=True, offset=OFFSETS))
    base_columns = bases.find(model).kept

    def random_motion(number: int) -> Reference:
        return random_fourier(
            -REACH, REACH, SPEED, extent.duration, RATE, HARMONICS, acceleration=ACCELERATION, seed=[seed, number]
        )

    def condition(reference: Reference) -> float:
        matrix = base_regressor(model, base_columns, reference, 50).reshape(-1, len(base_columns))
        return float(np.linalg.cond(matrix / np.linalg.norm(matrix, axis=0)))

    training = min(map(random_motion, range(extent.candidates)), key=condition)
    points = np.random.default_rng([seed, 99]).uniform(-0.7, 0.7, (extent.points, 6)) * REACH
    moves = trapezoidal(points, 0.6 * SPEED, 12.0, RATE, pause=0.2)
    return training, [random_motion(1001), random_motion(1002), moves]


def base_regressor(model: IdentificationModel, columns: np.ndarray, reference: Reference, step: int) -> np.ndarray:
    """Return the base columns of the regressor (N / step, n, b) along a reference.

    Args:
        model: the model.
        columns: (b,) its base columns.
        reference: the motion, N samples.
        step: samples of the motion per sample of the regressor.
    """
    part = slice(None, None, step)
    return model.regressor(reference.q[part], reference.v[part], reference.a[part])[:, :, columns]


def unmodelled(study: Study, reference: Reference) -> np.ndarray:
    """Return the size of the torque that no model holds (n,) [N m], from the torque of a motion without noise."""
    noise_free = simulate(study.plant, study.controller, reference, Sensing(every=EVERY))
    return UNMODELLED * np.sqrt(np.mean(noise_free.torque**2, axis=0))


def record(study: Study, reference: Reference, push: np.ndarray, kind: str, number: int) -> Log:
    """Simulate a motion with noise and unmodelled torque, and log it.

    Args:
        study: robot, model and controller.
        reference: the motion.
        push: (n,) size of the unmodelled torque [N m].
        kind: one of `KINDS`.
        number: number of the motion, for the seed of its noise.
    """
    sensing = Sensing(ENCODER_NOISE, 0.0, TORQUE_NOISE, push, push_band=UNMODELLED_BAND, every=EVERY)
    if kind == "in the loop":
        sensing = replace(sensing, sigma_q=LOOP, q_band=LOOP_BAND)
    run = simulate(study.plant, study.controller, reference, sensing, [study.seed, number])
    positions = run.measured
    if kind == "degraded":
        rng = np.random.default_rng([study.seed, number, 7])
        positions = positions + DEGRADED * rng.normal(size=positions.shape)
    names = tuple(f"joint_{joint + 1}" for joint in range(6))
    recording = Recording(run.t, positions, run.tau, "torque", names, file=kind)
    case = make_case(kind, make_motion(recording, FILTERS))
    rows = observe(study.model, study.base.kept, case, case.motion.decimator)
    return Log(reference, run, positions, case, rows)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Measured and predicted torques (N, n) [N m]."""

    measured: np.ndarray
    predicted: np.ndarray

    @property
    def residual(self) -> np.ndarray:
        return self.measured - self.predicted

    @property
    def error(self) -> float:
        """100 ‖τ - τ̂‖ / ‖τ‖ [%] of all joints together."""
        return float(100.0 * np.linalg.norm(self.residual) / np.linalg.norm(self.measured))

    @property
    def joint_errors(self) -> list[float]:
        """The same of each joint [%]."""
        shares = np.linalg.norm(self.residual, axis=0) / np.linalg.norm(self.measured, axis=0)
        return (100.0 * shares).tolist()


def with_measured(log: Log, values: np.ndarray) -> Prediction:
    """Return decimated torque and prediction W x, W from the log."""
    return Prediction(log.rows.target, log.rows.matrix @ values)


def simulated_rows(study: Study, log: Log, values: np.ndarray, controller: LoopController) -> ObservationRows:
    """Return the decimated rows of a log with the regressor Z of a noise-free simulation with the parameters x."""
    plant = Plant(study.model.bodies, study.model.terms, study.base.to_standard(values))
    run = simulate(plant, controller, log.reference, Sensing(every=EVERY))
    case = simulated_case(log.case, run, Loop(controller, log.reference, EVERY))
    return observe(study.model, study.base.kept, case, log.case.motion.decimator)


def torque_error(study: Study, reference: Reference, values: np.ndarray) -> list[float]:
    """Return the error of the torque along a reference, joint by joint, against the truth [%]: no noise anywhere."""
    matrix = base_regressor(study.model, study.base.kept, reference, 20)
    return Prediction(matrix @ study.truth, matrix @ values).joint_errors


def judge(
    study: Study,
    training: Log,
    validation: list[Log],
    results: dict[str, Instrumental],
    controller: LoopController,
    figure: Path | None = None,
) -> Metrics:
    """Return the errors of least squares and of instrumental methods (direct and cross), and the test results.

    Args:
        study: robot, model and true controller.
        training: the log that was identified from.
        validation: logs of other motions.
        results: name of an instrumental method to its result.
        controller: the controller that the methods assume.
        figure: picture of the residuals of LS and IV to write; None: none.
    """
    first = next(iter(results.values()))
    values = {"LS": first.ordinary.estimate.values, "PC-LS": constrained(study, first).estimate.values}
    for name, result in results.items():
        values[name] = result.fit.estimate.values

    logs = [training, *validation]

    @cache
    def simulated(name: str, number: int) -> ObservationRows:
        return simulated_rows(study, logs[number], values[name], controller)

    def prediction(name: str, number: int) -> Prediction:
        if name.endswith("LS"):
            return with_measured(logs[number], values[name])
        # constraints change IV's robot too little for a simulation of its own
        rows = simulated(name.removeprefix("PC-"), number)
        return Prediction(rows.target, rows.matrix @ values[name])

    def cross_error(name: str, number: int) -> float | None:
        try:
            return prediction(name, number).error
        except calib.CalibError:
            # A poor estimate need not be physically consistent along every motion.
            return None

    metrics: Metrics = {"direct": {}, "cross": {}, "torque_error": {}}
    direct = {name: prediction(name, 0) for name in values}
    if figure is not None:
        draw({name: direct[name].residual for name in ("LS", "IV")}, figure)
    for name in values:
        metrics["direct"][name] = direct[name].joint_errors
        metrics["cross"][name] = [cross_error(name, number) for number in range(1, len(logs))]
        metrics["torque_error"][name] = torque_error(study, validation[0].reference, values[name])
    return metrics | {
        "estimated": len(first.names),
        "rounds": {name: finite_rounds(result) for name, result in results.items()},
        "verdict": verdict(first),
        "constrained_forms_apart": float(results["PC-IV"].apart.max()),
    }


def constrained(study: Study, result: Instrumental) -> LinearFit:
    """Return the least-squares estimate of the same rows with the sign constraints of PC-IV (PC-IDIM-LS)."""
    std = result.ordinary.group_std
    factor = combine(result.problem.least_squares(), std)
    fit, _ = under_signs(study, result, result.ordinary, factor, std, stated_noise=True)
    return fit


def under_signs(
    study: Study, result: Instrumental, fit: LinearFit, factor: np.ndarray, std: np.ndarray, stated_noise: bool = False
) -> tuple[LinearFit, Held]:
    """Return a fit of a result's rows under the sign constraints, and the constraints that bind.

    Args:
        study: model and base parameters.
        result: an instrumental estimate, with the rows.
        fit: the estimate without constraints.
        factor: (p + 1, p + 1) R factor of its criterion.
        std: (n,) standard deviations of the joints' torques [N m].
        stated_noise: whether they are the noise that the covariance follows from.
    """
    bounds = dict.fromkeys(positive_names(result.names), (0.0, np.inf))
    settings = ConstraintSettings(signs=False, inertia=0, bounds=bounds)
    constraints = make_constraints(settings, study.model, study.base, result.names, [None] * study.base.b)
    return hold(fit, factor, result.problem.least_squares(), std, constraints, stated_noise=stated_noise)


def finite_rounds(result: Instrumental) -> list[dict[str, Any]]:
    """Return the rounds of an iteration; a change that is not finite (first round) becomes 1."""
    rounds = []
    for step in result.rounds:
        content = dict(vars(step))
        if not np.isfinite(step.change):
            content["change"] = 1.0
        rounds.append(content)
    return rounds


def verdict(result: Instrumental) -> Metrics:
    """Return the test of least squares, and the largest difference of both estimates in standard deviations."""
    return {
        "F": result.verdict.statistic,
        "p": result.verdict.p,
        "least_squares_biased": result.verdict.biased(),
        "largest_shift_in_sigma": float(result.shift.max()),
        "cragg_donald": result.strength.cragg_donald,
        "instruments_valid": result.valid,
    }


def estimates(study: Study, log: Log, controller: LoopController, methods: Sequence[str]) -> dict[str, Instrumental]:
    """Return the estimates of instrumental methods from a log, with an assumed controller.

    PC-IV is IV's last round under the constraints: further rounds would change no error by more than 0.01 %.

    Args:
        study: robot and model.
        log: the log.
        controller: the assumed controller.
        methods: some of `METHODS`, IV among them.
    """
    results = {method: estimate(study, log, controller, method) for method in methods if method != "PC-IV"}
    if "PC-IV" in methods:
        free = results["IV"]
        fit, bound = under_signs(study, free, free.fit, projected(free.problem, free.std), free.std)
        results["PC-IV"] = replace(free, fit=fit, constrained=bound)
    # in the order asked for
    return {method: results[method] for method in methods}


def estimate(study: Study, log: Log, controller: LoopController, method: str) -> Instrumental:
    """Return the estimate of IV or DIDIM from a log, with an assumed controller.

    The regular robot they start from has the motors' inertia, as on a data sheet.
    """
    return identify_instrumental(
        study.model,
        study.base,
        [(log.case, Loop(controller, log.reference, EVERY))],
        log.case.motion.decimator,
        method=method.lower(),
        limit=MAX_ROUNDS,
        inertia=np.array(known_robots.truth("tx40")["drives"]["Ia"]),
    )


def essential_count(study: Study, training: Log) -> Metrics:
    """Return the number of base parameters that an F-test keeps on clean data (the slides: 27 of 60)."""
    rows = training.rows
    samples, joints, p = rows.matrix.shape
    # joint by joint, so that each has a σ of its own
    group = np.repeat(np.arange(joints), samples)
    matrix = rows.matrix.transpose(1, 0, 2).reshape(-1, p)
    data = collect(matrix, rows.target.T.ravel(), group, study.base.names, study.base.units)
    kept = eliminate(data, Rule.F, std=subsystem_std(data)).kept
    return {"F": len(kept), "names": [study.base.names[k] for k in kept], "slides": SLIDES["essential"]}


def assumed_controllers(study: Study, log: Log) -> dict[str, LoopController]:
    """Return the controllers to try on degraded data: identified from that log, and wrong ones."""
    identified = identify_controller(log.reference, log.positions, np.asarray(log.run.tau), RATE / EVERY)
    true = study.controller
    wrong_gains = pd(1.3 * true.kp, 0.7 * true.kd)
    controllers = (identified.controller, wrong_gains, true.slower(2.0), true.slower(3.0))
    return dict(zip(TRIED, controllers))


def run_controllers(study: Study, log: Log, validation: list[Log], names: Container[str]) -> Metrics:
    """Return the metrics of IV and PC-IV on degraded data with assumed controllers.

    Args:
        study: robot, model and true controller.
        log: the degraded log.
        validation: degraded logs of other motions.
        names: controllers to try.
    """
    metrics: Metrics = {}
    for name, controller in assumed_controllers(study, log).items():
        if name not in names:
            continue
        try:
            results = estimates(study, log, controller, METHODS[:2])
        except NotConverged as error:
            # A wrong controller need not hold the robot.
            metrics[name] = {"failed": str(error)}
        else:
            metrics[name] = judge(study, log, validation, results, controller)
    return metrics


def run(
    out: Path, quick: bool = False, seed: int = 0, tried: Container[str] = TRIED, methods: Sequence[str] = METHODS
) -> Metrics:
    """Run the study; write and return the metrics.

    Args:
        out: folder for metrics and figures.
        quick: shorter motions, fewer candidates, two kinds of data.
        seed: seed of motions and noise.
        tried: controllers on degraded data.
        methods: instrumental methods, IV and PC-IV among them.
    """
    extent = QUICK if quick else Extent()
    plant = known_robots.plant("tx40", coupled=True, offset=OFFSETS)
    model = known_robots.model(plant)
    study = Study(plant, model, bases.find(model), known_robots.controller("tx40"), seed)
    training, unseen = references(extent, seed)
    motions = [training, *unseen]
    pushes = [unmodelled(study, motion) for motion in motions]
    metrics: Metrics = {
        "parameters": {"standard": model.p, "base": study.base.b},
        "by_construction": ["unmodelled torque", "noise of the degraded data", "offsets", "truth"],
        "slides": SLIDES,
    }
    for kind in extent.kinds:
        logs = []
        for number, (motion, push) in enumerate(zip(motions, pushes)):
            logs.append(record(study, motion, push, kind, number))
        log, *validation = logs
        if kind == "clean":
            metrics["essential"] = essential_count(study, log)
        results = estimates(study, log, study.controller, methods)
        figure = out / f"residuals_{kind.replace(' ', '_')}.png"
        metrics[kind] = judge(study, log, validation, results, study.controller, figure)
        if kind == "degraded":
            metrics["wrong controllers"] = run_controllers(study, log, validation, tried)
    metrics["parameters"]["essential"] = metrics["essential"]["F"]
    files.write_json(out / "metrics.json", metrics)
    return metrics


def positive_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of parameters that physics keeps positive: Ia, Fv, Fc, and moments ZZ about joint axes."""
    return tuple(name for name in names if name.startswith(("Ia", "Fv", "Fc", "ZZ")))


def show(metrics: Metrics) -> None:
    """Print the tables next to those of the slides."""
    counts = metrics["parameters"]
    sizes = f"{counts['standard']} standard, {counts['base']} base parameters"
    print(f"{sizes}; F-test keeps {counts['essential']} (slides: 27)")
    for kind in KINDS:
        if kind in metrics:
            show_errors(kind, metrics[kind], SLIDES.get(kind, {}))
    for name, errors in metrics["wrong controllers"].items():
        title = f"degraded, controller {name}"
        if "failed" in errors:
            print(f"\n{title}: {errors['failed']}")
        else:
            show_errors(title, errors, {})


def show_errors(title: str, metrics: Metrics, slides: Metrics) -> None:
    """Print one set [%]: direct and torque_error joint by joint, cross motion by motion.

    Args:
        title: name of the set.
        metrics: metrics of the set.
        slides: errors in the slides, by part and method.
    """
    test = metrics["verdict"]
    rounds = {name: len(steps) for name, steps in metrics["rounds"].items()}
    print(f"\n{title}: {metrics['estimated']} parameters, rounds {rounds}")
    numbers = f"F = {test['F']:.3g}, largest shift {test['largest_shift_in_sigma']:.2g} sigma"
    print(f"  least squares biased: {test['least_squares_biased']} ({numbers})")
    for part in PARTS:
        for method, errors in metrics[part].items():
            cells = ["     -" if error is None else f"{error:6.2f}" for error in errors]
            line = f"  {part:12} {method:6}{' '.join(cells)}"
            if method in slides.get(part, {}):
                line += "   slides " + " ".join(f"{error:5.1f}" for error in slides[part][method])
            print(line)


def draw(series: dict[str, np.ndarray], path: Path) -> None:
    """Draw autocorrelation, partial autocorrelation and histogram of residuals, joint by joint, as the slides do.

    Args:
        series: name of a method to its residuals (N, n) [N m].
        path: picture to write.
    """
    import matplotlib.pyplot as plt

    x = np.linspace(-4.0, 4.0, 100)
    normal_density = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    figure, axes = plt.subplots(3, 6, figsize=(15, 7))
    for joint, (acf_axis, pacf_axis, histogram) in enumerate(axes.T):
        for k, (name, residuals) in enumerate(series.items()):
            residual = residuals[:, joint]
            correlation = examine(residual)
            lags = np.arange(1, len(correlation.acf) + 1) + 0.3 * k
            for axis, heights in ((acf_axis, correlation.acf), (pacf_axis, correlation.pacf)):
                axis.vlines(lags, 0.0, heights, color=f"C{k}", lw=1.0, label=name)
                axis.axhspan(-correlation.bound, correlation.bound, color="0.9", zorder=0)
                axis.set_ylim(-0.6, 1.0)
            histogram.hist(residual / residual.std(), 40, histtype="step", color=f"C{k}", density=True)
        histogram.plot(x, normal_density, "k:", lw=0.8)
        acf_axis.set_title(f"joint {joint + 1}")
    for axis, label in zip(axes[:, 0], ("autocorrelation", "partial autocorrelation", "residual / std")):
        axis.set_ylabel(label)
    axes[0, 0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def readme_rows(metrics: Metrics) -> list[str]:
    """Return the README's table [%]: joints 1 to 6, or three other motions."""
    # label of a set: its metrics, and the slides' errors by part and method
    sets: dict[str, tuple[Metrics, Metrics]] = {}
    for kind in KINDS:
        if kind in metrics:
            sets[kind] = metrics[kind], SLIDES.get(kind, {})
    for name, errors in metrics["wrong controllers"].items():
        slides = SLIDES["identified controllers"] if name == "identified" else {}
        if "failed" not in errors:
            sets[f"degraded, {name}"] = errors, slides
    rows = ["| | LS | PC-LS | IV | PC-IV | slides: LS, IV |", "|---|---|---|---|---|---|"]
    for kind, (errors, slides) in sets.items():
        for part, label in PARTS.items():
            cells = [_cell(errors[part][name]) for name in COLUMNS]
            rows.append(f"| {kind}, {label} | {' | '.join(cells)} | {_slides_cell(slides.get(part, {}))} |")
    return rows


def _slides_cell(errors: dict[str, list[float]]) -> str:
    """Return the slides' errors of LS and IV; a dash for those that they do not have."""
    if not errors:
        return "–"
    cells = [_cell(errors[name]) if name in errors else "–" for name in ("LS", "IV")]
    return " / ".join(cells)


def _cell(errors: Sequence[float | None]) -> str:
    cells = ["–" if error is None else f"{error:.1f}" for error in errors]
    return " ".join(cells)


def write_readme(metrics: Metrics, path: Path) -> None:
    """Put the table between the marks of a README."""
    start, end = MARKS
    head, rest = path.read_text(encoding="utf-8").split(start)
    _, tail = rest.split(end)
    files.write(path, "\n".join([head + start, *readme_rows(metrics), end + tail]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for metrics.json")
    parser.add_argument("--quick", action="store_true", help="shorter motions, fewer candidates, two sets")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tried", nargs="+", choices=TRIED, default=TRIED, help="controllers on degraded data")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS, help="IV and PC-IV among them")
    parser.add_argument("--readme", action="store_true", help="put the table into the README beside this script")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    metrics = run(arguments.out, arguments.quick, arguments.seed, arguments.tried, arguments.methods)
    show(metrics)
    if arguments.readme:
        write_readme(metrics, Path(__file__).with_name("README.md"))


if __name__ == "__main__":
    main()

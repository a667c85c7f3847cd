"""`calib compare`: all methods on the same recordings, ranked by their error on a held-out motion.

All methods estimate the same parameters (base parameters and standard friction, unless another is requested), each as
`calib identify --method` does. The method wls regularises what the motion does not identify towards a prior. Errors are
relative to the torque, in the identification band, over all held-out recordings together. Their standard errors, and
those of differences between methods, are jackknife estimates over blocks of time (Künsch 1989), since residuals are not
white.

Methods within `MAX_SIGMAS` standard errors of the best, or within `MAX_SHARE` of its error, count as equally good. The
first of these in rank that is fast is recommended: its time is at most `FAST_SECONDS`, or `MAX_TIMES` times that of the
fastest. The verdict on it, printed below the table, is that of `calib identify`, from the same findings. No method is
recommended where this verdict is fail, where the best method predicts no better than no model (100 %), or where all
held-out recordings repeat the training motion. A single held-out recording that repeats it is ignored.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import CalibError, UsageError, require
from calib.toolkit.model_identification import (
    Identification,
    IdentificationInputs,
    identify,
    judged,
    motion_findings,
    overlaps,
    repeated_motion,
)
from calib.toolkit.report_pages import Block, RecordColumn, Section, Text, table
from calib.toolkit.result_folders import Note, Verdict, as_notes, lines_of, notes_of
from calib.toolkit.torque_models import METHODS, Case, IdentificationSettings, Method, method_named, predict

# Of the rule above (our choices).
MAX_SIGMAS = 2.0
MAX_SHARE = 0.05
MAX_TIMES = 2.0
FAST_SECONDS = 1.0
# Blocks of time in each recording, for the jackknife (our choice).
TIME_BLOCKS = 10
LOOP = "needs the closed loop: add [loop] to the options file (calib formats identify-options)"
# Error of predicting no torque at all [%].
NO_MODEL = 100.0


@dataclass(frozen=True)
class ComparedMethod:
    """Result of one method.

    Attributes:
        name: name of the method.
        failure: why there is no estimate; empty where there is one.
        rank: rank by the error on the held-out motion, from 1; 0 without an estimate.
        unseen, sigma: error on the held-out motion in the identification band, and its standard error [%].
        raw: error on the held-out motion against the torque as recorded [%].
        training: error on the training recordings in the identification band [%].
        worst: joint with the largest error on the held-out motion, counted from 1, and that error [%].
        behind, behind_sigma: `unseen` minus that of the best method, and the standard error of this difference [%].
        good: whether the method is as good as the best.
        chosen: whether the method is the recommended one.
        parameters: number of estimated parameters.
        seconds: computing time of the method alone [s].
        iterations, simulations: number of iterations and simulations of the method.
        verdict, warnings: verdict and warnings of `calib identify` on the method's model; None and empty for all
            methods but the selected one.
    """

    name: str
    failure: str = ""
    rank: int = 0
    unseen: float = np.nan
    sigma: float = np.nan
    raw: float = np.nan
    training: float = np.nan
    worst: tuple[int, float] = (0, np.nan)
    behind: float = 0.0
    behind_sigma: float = 0.0
    good: bool = False
    chosen: bool = False
    parameters: int = 0
    seconds: float = np.nan
    iterations: int = 0
    simulations: int = 0
    verdict: Verdict | None = None
    warnings: tuple[Note, ...] = ()


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sums over blocks of time, each (k, rows), of squared errors and squared torques.

    Attributes:
        error, size: errors and torques in the identification band.
        raw_error, raw_size: errors and torques as recorded.
    """

    error: np.ndarray
    size: np.ndarray
    raw_error: np.ndarray
    raw_size: np.ndarray


def _ignore(message: object) -> None:
    pass


def compare_methods(
    inputs: IdentificationInputs,
    methods: Sequence[str] | None = None,
    friction: str = "standard",
    say: Callable[[str], None] = _ignore,
    done: Callable[[ComparedMethod], None] = _ignore,
) -> list[ComparedMethod]:
    """Return the results of all methods on the recordings, best first; methods without an estimate are last.

    Args:
        inputs: training recordings, and held-out ones.
        methods: names of methods; None: all.
        friction: friction model: ``standard``, ``auto``, or a step of the ladder; methods that simulate support only
            ``standard``.
        say: called with each message on progress.
        done: called with each method's result as soon as it is available, not yet ranked.

    Raises:
        UsageError: no recording is held out, a held-out one overlaps the training recordings, or a method is unknown.
    """
    require(inputs.unseen, "methods are ranked on unseen motion: give a recording with --validate", UsageError)
    shared = overlaps(inputs.cases, inputs.unseen)
    if shared:
        raise UsageError(
            f"{lines_of(shared)[0]}: state parts that do not overlap, such as log.npz@0:20 and log.npz@20:30"
        )
    # Recordings that repeat the training motion do not rank methods, unless there are no others.
    repeated = repeated_motion(inputs.cases, inputs.unseen)
    validation = tuple(case for case in inputs.unseen if case.name not in repeated)
    if validation:
        inputs = replace(inputs, unseen=validation)
    candidates = {name: method_named(name) for name in methods or METHODS}
    without_loop = inputs.options.settings.loop is None
    if without_loop and all(method.needs_controller for method in candidates.values()):
        raise UsageError(f"{', '.join(candidates)}: {LOOP}")
    results: list[tuple[ComparedMethod, _Sums]] = []
    models: dict[str, Identification] = {}
    failed: list[ComparedMethod] = []
    joints = np.arange(inputs.cases[0].target.shape[1])
    same_unit = ~np.isin(joints, inputs.currents.own)
    for name, method in candidates.items():
        if method.needs_controller and without_loop:
            failed.append(ComparedMethod(name, LOOP))
            continue
        say(name)
        settings = _settings(inputs, method, friction)
        try:
            model = identify(inputs.robot, inputs.cases, settings, partial(_say_of, say, name))
            compared, sums = _errors(model, inputs, same_unit)
        except CalibError as error:
            failed.append(ComparedMethod(name, _one_line(error)))
            done(failed[-1])
        except Exception as error:  # of one method: the others' results are not lost by it
            failed.append(ComparedMethod(name, f"internal error: {type(error).__name__}: {error}"))
            done(failed[-1])
        else:
            results.append((compared, sums))
            models[name] = model
            done(compared)
    ranked = _ranked(results, same_unit)
    for rank, method in enumerate(ranked):
        if method.chosen:
            ranked[rank] = _judged(method, inputs, models[method.name], bool(validation), say)
    return ranked + failed


def caveats(inputs: IdentificationInputs, compared: Sequence[ComparedMethod]) -> list[Note]:
    """Return notes on a ranking, and the reason if no method is recommended.

    Args:
        inputs: the recordings.
        compared: results of the methods, best first.
    """
    repeated = repeated_motion(inputs.cases, inputs.unseen)
    notes = [Note(note) for note in inputs.currents.notes]
    notes += notes_of(motion_findings({}, repeated))
    for method in compared:
        notes += method.warnings
    if len(repeated) == len(inputs.unseen):
        message = "no method recommended: all unseen files repeat the training motion; give others with --validate"
        notes.append(Note(message))
    elif repeated:
        notes.append(Note(f"excluded from the ranking: {', '.join(repeated)}"))
    if compared and compared[0].unseen >= NO_MODEL:
        message = (
            f"no method recommended: best unseen error {compared[0].unseen:.3g} %, without a model {NO_MODEL:g} %: "
            "add training motion"
        )
        notes.append(Note(message))
    else:
        for method in compared:
            if method.verdict is not None and method.verdict.level == "fail":
                message = (
                    f"no method recommended: the model of {method.name} fails in calib identify for the reason below"
                )
                notes.append(Note(message))
                break
    return list(dict.fromkeys(notes))


def _say_of(say: Callable[[str], None], name: str, message: str) -> None:
    say(f"{name}: {message}")


def _one_line(error: CalibError) -> str:
    return " ".join(str(error).split())


def _settings(inputs: IdentificationInputs, method: Method, friction: str) -> IdentificationSettings:
    """Return the identification settings for a method, without those settings that the method does not use.

    Args:
        inputs: the recordings with the user's settings.
        method: the method.
        friction: friction model: ``standard``, ``auto``, or a step of the ladder.
    """
    settings = replace(inputs.options.settings, method=method.name, essential="none", friction=friction)
    if not method.takes_constraints:
        settings = replace(settings, constraints=None)
    if not method.takes_prior:
        settings = replace(settings, weights="residuals")
    if method.needs_controller:
        return settings
    return replace(settings, loop=None)


def _judged(
    method: ComparedMethod,
    inputs: IdentificationInputs,
    model: Identification,
    proven: bool,
    say: Callable[[str], None],
) -> ComparedMethod:
    """Return the selected method with the verdict on its model; if the verdict is fail, the method is not recommended.

    Args:
        method: the selected method.
        inputs: the recordings.
        model: the method's model.
        proven: whether a held-out recording differs from the training motion.
        say: called with messages on progress.
    """
    warnings: tuple[Note, ...] = ()
    try:
        outcome = judged(inputs, model, progress=partial(_say_of, say, method.name))
        verdict = outcome.verdict
        warnings = tuple(as_notes(outcome.warnings, outcome.noticed))
    except CalibError as error:
        verdict = Verdict("fail", _one_line(error))
    recommended = proven and method.unseen < NO_MODEL and verdict.level != "fail"
    return replace(method, chosen=recommended, verdict=verdict, warnings=warnings)


def _errors(model: Identification, inputs: IdentificationInputs, same_unit: np.ndarray) -> tuple[ComparedMethod, _Sums]:
    """Return a method's result with the errors of its model, and the sums of these errors by block of time.

    Args:
        model: the method's model.
        inputs: the recordings.
        same_unit: (rows,) whether a torque row has the unit in which errors are summed.
    """
    unseen = _sums(model, inputs.unseen)
    training = _sums(model, inputs.cases)
    joint_sizes = np.maximum(unseen.size.sum(axis=0), 1e-300)
    joint_errors = 100.0 * np.sqrt(unseen.error.sum(axis=0) / joint_sizes)
    worst = int(np.argmax(np.where(same_unit, joint_errors, -1.0)))
    fitted = model.fitted
    compared = ComparedMethod(
        fitted.method,
        unseen=_percent(unseen.error[:, same_unit], unseen.size[:, same_unit]),
        sigma=float(_jackknife(_leaving_out(unseen, same_unit))),
        raw=_percent(unseen.raw_error[:, same_unit], unseen.raw_size[:, same_unit]),
        training=_percent(training.error[:, same_unit], training.size[:, same_unit]),
        worst=(worst + 1, float(joint_errors[worst])),
        parameters=len(fitted.estimate.values),
        seconds=fitted.seconds,
        iterations=fitted.iterations,
        simulations=fitted.simulations,
    )
    return compared, unseen


def _sums(model: Identification, cases: Sequence[Case]) -> _Sums:
    """Return the sums of a model's errors over each block of time of the recordings.

    Args:
        model: the model.
        cases: the recordings.
    """
    errors = []
    sizes = []
    raw_errors = []
    raw_sizes = []
    for case in cases:
        motion = case.motion
        usable = motion.weight > 0.5
        starts = np.linspace(0, len(usable), TIME_BLOCKS, endpoint=False).astype(int)

        def block_sums(values: np.ndarray, usable: np.ndarray = usable, starts: np.ndarray = starts) -> np.ndarray:
            return np.add.reduceat(np.where(usable[:, None], values, 0.0) ** 2, starts, axis=0)

        predicted = predict(model.dynamics, case)
        target = motion.in_band(np.asarray(case.target))
        errors.append(block_sums(target - motion.in_band(predicted)))
        sizes.append(block_sums(target))
        raw_errors.append(block_sums(case.target - predicted))
        raw_sizes.append(block_sums(case.target))
    return _Sums(np.concatenate(errors), np.concatenate(sizes), np.concatenate(raw_errors), np.concatenate(raw_sizes))


def _percent(error: np.ndarray, size: np.ndarray) -> float:
    return float(100.0 * np.sqrt(error.sum() / max(float(size.sum()), 1e-300)))


def _leaving_out(sums: _Sums, same_unit: np.ndarray) -> np.ndarray:
    """Return the relative error (k,) [%] with each of the k blocks of time left out in turn.

    Args:
        sums: sums of squared errors and torques over k blocks of time.
        same_unit: (rows,) whether a torque row has the unit in which errors are summed.
    """
    error = sums.error[:, same_unit].sum(axis=1)
    size = sums.size[:, same_unit].sum(axis=1)
    return 100.0 * np.sqrt((error.sum() - error) / np.maximum(size.sum() - size, 1e-300))


def _jackknife(values: np.ndarray) -> float:
    """Return the jackknife's standard error of a quantity.

    Args:
        values: (k,) the quantity with each of k blocks left out in turn.
    """
    count = len(values)
    return float(np.sqrt((count - 1) / count * np.sum((values - values.mean()) ** 2)))


def _unseen_error(result: tuple[ComparedMethod, _Sums]) -> float:
    return result[0].unseen


def _ranked(results: Sequence[tuple[ComparedMethod, _Sums]], same_unit: np.ndarray) -> list[ComparedMethod]:
    """Return the methods by rank; the first fast one among the equally good methods is marked as recommended.

    Args:
        results: each method's result, and its sums of squared errors and torques over blocks of time.
        same_unit: (rows,) whether a torque row has the unit in which errors are summed.
    """
    if not results:
        return []
    order = sorted(results, key=_unseen_error)
    best, best_sums = order[0]
    ranked = []
    for rank, (method, sums) in enumerate(order, 1):
        behind = method.unseen - best.unseen
        sigma = _jackknife(_leaving_out(sums, same_unit) - _leaving_out(best_sums, same_unit))
        good = behind <= max(MAX_SIGMAS * sigma, MAX_SHARE * best.unseen)
        ranked.append(replace(method, rank=rank, behind=behind, behind_sigma=sigma, good=bool(good)))
    fastest = min(method.seconds for method in ranked if method.good)
    fast = max(FAST_SECONDS, MAX_TIMES * fastest)
    for index, method in enumerate(ranked):
        if method.good and method.seconds <= fast:
            ranked[index] = replace(method, chosen=True)
            break
    return ranked


HEADER = [
    "rank",
    "method",
    "unseen_percent",
    "sigma",
    "raw_percent",
    "training_percent",
    "worst_joint",
    "worst_joint_percent",
    "behind",
    "behind_sigma",
    "as_good",
    "take",
    "parameters",
    "seconds",
    "iterations",
    "simulations",
    "failure",
]


def write_table(compared: Sequence[ComparedMethod], path: Path) -> Path:
    """Write the results of the methods as CSV and return its path."""
    lines = []
    for method in compared:
        worst_joint, worst_error = method.worst
        cells = (
            method.rank or "",
            method.name,
            method.unseen,
            method.sigma,
            method.raw,
            method.training,
            worst_joint or "",
            worst_error,
            method.behind,
            method.behind_sigma,
            _yes_or_no(method.good),
            _yes_or_no(method.chosen),
            method.parameters,
            method.seconds,
            method.iterations,
            method.simulations,
            method.failure,
        )
        lines.append(cells)
    return files.write_table(path, HEADER, lines)


def _yes_or_no(value: bool) -> str:
    if value:
        return "yes"
    return "no"


def _behind(method: ComparedMethod) -> str:
    if method.rank == 1:
        return ""
    return f"{method.behind:.2g} ± {method.behind_sigma:.2g}"


def _choice(method: ComparedMethod) -> str:
    if method.chosen:
        return "take"
    if method.good:
        return "as good"
    return ""


COLUMNS = (
    RecordColumn("rank", "{0.rank}"),
    RecordColumn("method", "{0.name}", number=False),
    RecordColumn("unseen [%]", "{0.unseen:.3g} ± {0.sigma:.2g}"),
    RecordColumn("behind the best", _behind),
    RecordColumn("raw [%]", "{0.raw:.3g}"),
    RecordColumn("training [%]", "{0.training:.3g}"),
    RecordColumn("worst joint", "{0.worst[0]}: {0.worst[1]:.3g} %"),
    RecordColumn("parameters", "{0.parameters}"),
    RecordColumn("rounds", "{0.iterations}"),
    RecordColumn("simulations", "{0.simulations}"),
    RecordColumn("seconds", "{0.seconds:.2g}"),
    RecordColumn("choice", _choice, number=False),
)


def line(method: ComparedMethod) -> str:
    """Return one line on a method's result: its error, or the reason of its failure."""
    if method.failure:
        return f"{method.name}: {method.failure}"
    return f"{method.name}: {method.unseen:.3g} % on unseen motion, {method.seconds:.2g} s"


def section(compared: Sequence[ComparedMethod], notes: Sequence[Note]) -> Section:
    """Return the report section: table of methods, notes, and the verdict on the selected method's model.

    Args:
        compared: results of the methods, best first.
        notes: notes on the ranking.
    """
    blocks = [*_blocks(compared), Text("", notes, "note")]
    for method in compared:
        if method.verdict is not None:
            return Section("Methods", blocks, method.verdict.level, f"{method.name}: {method.verdict.reason}")
    return Section("Methods", blocks)


def _blocks(compared: Sequence[ComparedMethod]) -> Iterator[Block]:
    """Yield the report blocks with the ranked table, and with the reasons for methods without an estimate.

    Args:
        compared: results of the methods, best first.
    """
    ranked = [method for method in compared if not method.failure]
    note = (
        "100 ‖τ - τ̂‖ / ‖τ‖ on unseen motion, in the identification band, ± its standard error over blocks of time; "
        f"methods are as good within {MAX_SIGMAS:g} standard errors of the difference, or {MAX_SHARE:.0%}, of the best"
    )
    if ranked:
        yield table("Methods", COLUMNS, ranked, note, lambda method: method.chosen)
    lines = [line(method) for method in compared if method.failure]
    if lines:
        yield Text("Without an estimate", lines, "no estimate")

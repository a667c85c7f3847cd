"""``calib compare``: all methods on the same recordings, ranked by their error on unseen motion.

All estimate the same columns (base parameters and standard friction, unless another is asked for), each as
`calib identify --method` does it: wls regularises what the motion does not identify towards a prior. Errors are
relative, in the identification band, over all unseen recordings together; their standard errors, and those of
differences between methods, come from a jackknife over blocks of time (Künsch 1989), since residuals are not white.
Methods within `MAX_SIGMAS` standard errors of the best, or within `MAX_SHARE` of its error, are as good; of these one
is taken that is fast: at most `FAST_SECONDS` seconds, or `MAX_TIMES` times the time of the fastest, the first in rank.
Below the table stands what `calib identify` says of it: the same verdict, from the same findings. None is taken where
that verdict is fail, where the best predicts no better than no model does (100 %), or where all recordings repeat the
training motion; one that does is left out.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import CalibError, UsageError, require
from calib.identification.identify import Identification, identify
from calib.identification.methods.method import Method
from calib.identification.prediction import predict
from calib.identification.registry import METHODS, method_named
from calib.identification.rows import Case
from calib.identification.settings import IdentificationSettings
from calib.procedure.dynamic_stage.identify import judged, overlaps, repeated_motion
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.verdict import motion_findings
from calib.procedure.findings import Verdict, lines_of
from calib.procedure.report.page import Block, Column, Section, Text, table

MAX_SIGMAS, MAX_SHARE, MAX_TIMES, FAST_SECONDS = 2.0, 0.05, 2.0, 1.0  # our choices
LOOP = "needs the closed loop: add [loop] to the options file (calib formats identify-options)"
NO_MODEL = 100.0  # error [%] of predicting no torque at all


@dataclass(frozen=True)
class ComparedMethod:
    """Result of one method.

    Attributes:
        name: of it.
        failure: why there is no estimate; "" where there is one.
        rank: by the error on unseen motion, from 1; 0 without an estimate.
        unseen, sigma: error on unseen motion in the band, and its standard error [%].
        raw: the same against the torque as recorded [%].
        training: in the band, of the training data [%].
        worst: joint with the largest error on unseen motion, counted from 1, and that [%].
        behind, behind_sigma: difference from the best, and its standard error [%].
        good, chosen: whether it is as good as the best, and the one to take.
        parameters: number of them.
        seconds: of the method alone.
        iterations, simulations: of the method.
        verdict, warnings: what `calib identify` says of it; None and empty but for the one that the rule comes to.
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
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sums per block of time (k, rows): squared errors and squared torques, in the band and as recorded."""

    error: np.ndarray
    size: np.ndarray
    raw_error: np.ndarray
    raw_size: np.ndarray


def compare_methods(
    inputs: IdentificationInputs,
    methods: Sequence[str] | None = None,
    friction: str = "standard",
    say: Callable[[str], None] = lambda words: None,
    each: Callable[[ComparedMethod], None] = lambda one: None,
) -> list[ComparedMethod]:
    """Return the results of all methods on the recordings, best first; failed methods come last.

    Args:
        inputs: training recordings, and unseen ones.
        methods: their names; None: all.
        friction: as of `IdentificationSettings`; methods that simulate know ``standard`` alone.
        say: called with words on progress.
        each: called with every method when it is done, not yet ranked.

    Raises:
        UsageError: where no recording is unseen, or one overlaps the training recordings; where a name is none of
            a method.
    """
    require(inputs.unseen, "methods are ranked on unseen motion: give a recording with --validate", UsageError)
    if shared := overlaps(inputs.cases, inputs.unseen):
        raise UsageError(f"{lines_of(shared)[0]}: cut them apart, log.npz@0:20 and log.npz@20:30")
    repeated = repeated_motion(inputs.cases, inputs.unseen)
    proofs = tuple(case for case in inputs.unseen if case.name not in repeated)
    inputs = replace(inputs, unseen=proofs or inputs.unseen)
    chosen = {name: method_named(name) for name in methods or METHODS}
    if inputs.options.settings.loop is None and all(method.needs_controller for method in chosen.values()):
        raise UsageError(f"{', '.join(chosen)}: {LOOP}")
    done: list[tuple[ComparedMethod, _Sums]] = []
    models: dict[str, Identification] = {}
    failed: list[ComparedMethod] = []
    same_unit = ~np.isin(np.arange(inputs.cases[0].target.shape[1]), inputs.currents.own)
    for name, method in chosen.items():
        if method.needs_controller and inputs.options.settings.loop is None:
            failed.append(ComparedMethod(name, LOOP))
            continue
        say(name)
        try:
            found = identify(inputs.robot, inputs.cases, _settings(inputs, method, friction), partial(_said, say, name))
            done.append(_errors(found, inputs, same_unit))
            models[name] = found
            each(done[-1][0])
        except CalibError as error:
            failed.append(ComparedMethod(name, " ".join(str(error).split())))
            each(failed[-1])
        except Exception as error:  # of one method: the others' results are not lost by it
            failed.append(ComparedMethod(name, f"internal error: {type(error).__name__}: {error}"))
            each(failed[-1])
    ranked = _ranked(done, same_unit)
    return [
        *(_held(one, inputs, models[one.name], bool(proofs), say) if one.chosen else one for one in ranked),
        *failed,
    ]


def caveats(inputs: IdentificationInputs, found: Sequence[ComparedMethod]) -> list[str]:
    """Return notes on a ranking, and the reason if no method is recommended."""
    repeated = repeated_motion(inputs.cases, inputs.unseen)
    notes = [*inputs.currents.notes, *lines_of(motion_findings({}, repeated))]
    notes += [line for one in found for line in one.warnings]
    if len(repeated) == len(inputs.unseen):
        notes.append("no method recommended: all unseen files repeat the training motion; give others with --validate")
    elif repeated:
        notes.append(f"excluded from the ranking: {', '.join(repeated)}")
    judged_one = next((one for one in found if one.verdict is not None and one.verdict.level == "fail"), None)
    if found and found[0].unseen >= NO_MODEL:
        notes.append(
            f"no method recommended: best unseen error {found[0].unseen:.3g} %, without a model {NO_MODEL:g} %: "
            "add training motion"
        )
    elif judged_one is not None:
        notes.append(f"no method recommended: the model of {judged_one.name} fails in calib identify, reason below")
    return list(dict.fromkeys(notes))


def _said(say: Callable[[str], None], name: str, words: str) -> None:
    say(f"{name}: {words}")


def _settings(inputs: IdentificationInputs, method: Method, friction: str) -> IdentificationSettings:
    """Return the identification settings for a method, without settings that it does not use."""
    settings = replace(inputs.options.settings, method=method.name, essential="none", friction=friction)
    if not method.takes_constraints:
        settings = replace(settings, constraints=None)
    if not method.takes_prior:
        settings = replace(settings, weights="residuals")
    return settings if method.needs_controller else replace(settings, loop=None)


def _held(
    one: ComparedMethod, inputs: IdentificationInputs, found: Identification, proven: bool, say: Callable[[str], None]
) -> ComparedMethod:
    """Return the selected method with the verdict on its model; with verdict fail it is not recommended.

    Args:
        proven: whether the recordings are motion that it has not seen.
    """
    warnings: tuple[str, ...] = ()
    try:
        outcome = judged(inputs, found, partial(_said, say, one.name))
        verdict, warnings = outcome.verdict, outcome.warnings
    except CalibError as error:
        verdict = Verdict("fail", " ".join(str(error).split()))
    taken = proven and one.unseen < NO_MODEL and verdict.level != "fail"
    return replace(one, chosen=taken, verdict=verdict, warnings=warnings)


def _errors(found: Identification, inputs: IdentificationInputs, same_unit: np.ndarray) -> tuple[ComparedMethod, _Sums]:
    """Return the errors of a method's model, and their sums by block of time."""
    unseen, training = (_sums(found, cases) for cases in (inputs.unseen, inputs.cases))
    joints = 100.0 * np.sqrt(unseen.error.sum(axis=0) / np.maximum(unseen.size.sum(axis=0), 1e-300))
    worst = int(np.argmax(np.where(same_unit, joints, -1.0)))
    fitted = found.fitted
    return ComparedMethod(
        fitted.method,
        unseen=_percent(unseen.error[:, same_unit], unseen.size[:, same_unit]),
        sigma=float(_jackknife(_leaving_out(unseen, same_unit))),
        raw=_percent(unseen.raw_error[:, same_unit], unseen.raw_size[:, same_unit]),
        training=_percent(training.error[:, same_unit], training.size[:, same_unit]),
        worst=(worst + 1, float(joints[worst])),
        parameters=len(fitted.estimate.values),
        seconds=fitted.seconds,
        iterations=fitted.iterations,
        simulations=fitted.simulations,
    ), unseen


def _sums(found: Identification, cases: Sequence[Case], blocks: int = 10) -> _Sums:
    # blocks: of time in each recording
    parts = []
    for case in cases:
        motion, known = case.motion, case.motion.weight > 0.5
        predicted = predict(found.dynamics, case)
        low, target = motion.in_band(predicted), motion.in_band(np.asarray(case.target))
        starts = np.linspace(0, len(known), blocks, endpoint=False).astype(int)
        parts.append(
            [
                np.add.reduceat(np.where(known[:, None], x, 0.0) ** 2, starts, axis=0)
                for x in (target - low, target, case.target - predicted, case.target)
            ]
        )
    return _Sums(*(np.concatenate(own) for own in zip(*parts)))


def _percent(error: np.ndarray, size: np.ndarray) -> float:
    return float(100.0 * np.sqrt(error.sum() / max(float(size.sum()), 1e-300)))


def _leaving_out(sums: _Sums, same_unit: np.ndarray) -> np.ndarray:
    """Return the error (k,) [%] with each of k blocks of time left out."""
    error, size = sums.error[:, same_unit].sum(axis=1), sums.size[:, same_unit].sum(axis=1)
    return 100.0 * np.sqrt((error.sum() - error) / np.maximum(size.sum() - size, 1e-300))


def _jackknife(each: np.ndarray) -> float:
    return float(np.sqrt((len(each) - 1) / len(each) * np.sum((each - each.mean()) ** 2)))


def _ranked(done: Sequence[tuple[ComparedMethod, _Sums]], same_unit: np.ndarray) -> list[ComparedMethod]:
    """Return the methods by rank; the first fast one of the good methods is marked as chosen."""
    if not done:
        return []
    order = sorted(done, key=lambda pair: pair[0].unseen)
    best, own = order[0]
    result = []
    for rank, (one, sums) in enumerate(order, 1):
        behind = one.unseen - best.unseen
        sigma = _jackknife(_leaving_out(sums, same_unit) - _leaving_out(own, same_unit))
        good = behind <= max(MAX_SIGMAS * sigma, MAX_SHARE * best.unseen)
        result.append(replace(one, rank=rank, behind=behind, behind_sigma=sigma, good=bool(good)))
    least = min(one.seconds for one in result if one.good)
    taken = next(one for one in result if one.good and one.seconds <= max(FAST_SECONDS, MAX_TIMES * least))
    return [replace(one, chosen=one is taken) for one in result]


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


def write_table(found: Sequence[ComparedMethod], path: Path) -> Path:
    """Write the comparison as CSV."""
    lines = [
        (
            one.rank or "",
            one.name,
            one.unseen,
            one.sigma,
            one.raw,
            one.training,
            one.worst[0] or "",
            one.worst[1],
            one.behind,
            one.behind_sigma,
            "yes" if one.good else "no",
            "yes" if one.chosen else "no",
            one.parameters,
            one.seconds,
            one.iterations,
            one.simulations,
            one.failure,
        )
        for one in found
    ]
    return files.write_table(path, HEADER, lines)


COLUMNS = (
    Column("rank", "{0.rank}"),
    Column("method", "{0.name}", number=False),
    Column("unseen [%]", "{0.unseen:.3g} ± {0.sigma:.2g}"),
    Column("behind the best", lambda one: "" if one.rank == 1 else f"{one.behind:.2g} ± {one.behind_sigma:.2g}"),
    Column("raw [%]", "{0.raw:.3g}"),
    Column("training [%]", "{0.training:.3g}"),
    Column("worst joint", "{0.worst[0]}: {0.worst[1]:.3g} %"),
    Column("parameters", "{0.parameters}"),
    Column("rounds", "{0.iterations}"),
    Column("simulations", "{0.simulations}"),
    Column("seconds", "{0.seconds:.2g}"),
    Column("choice", lambda one: "take" if one.chosen else "as good" if one.good else "", number=False),
)


def line(one: ComparedMethod) -> str:
    """Return one line on a method's result: its error, or the reason of its failure."""
    words = one.failure or f"{one.unseen:.3g} % on unseen motion, {one.seconds:.2g} s"
    return f"{one.name}: {words}"


def section(found: Sequence[ComparedMethod], notes: Sequence[str]) -> Section:
    """Return a report section: table of methods, notes, and the verdict on the selected method's model."""
    own = next((one for one in found if one.verdict is not None), None)
    shown = (*_blocks(found), Text("", notes, "note"))
    if own is None or own.verdict is None:
        return Section("Methods", shown)
    return Section("Methods", shown, own.verdict.level, f"{own.name}: {own.verdict.reason}")


def _blocks(found: Sequence[ComparedMethod]) -> Iterator[Block]:
    """Yield the ranked table, and the reasons for excluded methods."""
    good = [one for one in found if not one.failure]
    note = (
        "100 ‖τ - τ̂‖ / ‖τ‖ on unseen motion, in the identification band, ± its standard error over blocks of time; "
        f"methods are as good within {MAX_SIGMAS:g} standard errors of the difference, or {MAX_SHARE:.0%}, of the best"
    )
    if good:
        yield table("Methods", COLUMNS, good, note, lambda one: one.chosen)
    lines = [line(one) for one in found if one.failure]
    if lines:
        yield Text("Without an estimate", lines, "no estimate")

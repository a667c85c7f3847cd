"""The identification as the guided procedure runs it: read, identify, predict other motion, say how far to trust it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calib.data.recordings.recording import Joints, Recording
from calib.data.recordings.recording_files import read_recording
from calib.data.signals.decimation import SHARE
from calib.data.signals.motion import FilterOptions, Motion, make_motion, sample
from calib.data.signals.persistency import ExcitationReport, repeats, report_excitation
from calib.data.signals.reference_files import with_reference
from calib.data.signals.resampling import Resampled
from calib.errors import UsageError, suggestion
from calib.identification.cases import Case, case_names, make_case
from calib.identification.friction.passivity import driven
from calib.identification.gains import DriveGains
from calib.identification.geometry_uncertainty import GeometryUncertainty, propagate
from calib.identification.identify import Identification, identify
from calib.identification.identify_options import FileSettings, IdentifyOptions, file_settings
from calib.identification.prediction import Dynamics, predict
from calib.identification.scores import Score, score
from calib.identification.settings import IdentificationSettings
from calib.identification.two_geometries import GeometryComparison, compare
from calib.procedure.dynamic_stage.gains import FoundGains, find_gains, relative_warnings
from calib.procedure.dynamic_stage.tracking import Tracking, track
from calib.procedure.dynamic_stage.verdict import (
    Resting,
    judge,
    model_warnings,
    resting_parameters,
    warnings,
    with_prior,
)
from calib.procedure.kinematic_stage.inputs import joint_kinds
from calib.procedure.kinematic_stage.verdict import Verdict
from calib.robot.calibrated import CalibratedChain, without_corrections
from calib.robot.chain import Chain
from calib.robot.load import load_calibrated, resolve

LOST = 0.05  # of a recording may fall to the windows of the parallel decimation (our choice)
QUIET = 0.02  # noise of the accelerations that is no matter, of their rms (our choice)
WINDOW = 18  # samples per decimation factor that one window needs
REPEAT = 0.5  # share of states met in training from which on a validation file proves nothing (our choice)

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class IdentificationInputs:
    """A robot and its recordings.

    Attributes:
        robot: as a geometric fit has left it, or as it was described; joint corrections left out.
        source: the file it came from.
        cases: recordings to learn from.
        unseen: recordings to be predicted.
        options: the options file's content, the command's choices put in.
        notes: what a user should know about how the files were understood.
        unit: of the torques.
        gains: drive gains that were identified; None where none were.
    """

    robot: CalibratedChain
    source: Path
    cases: tuple[Case, ...]
    unseen: tuple[Case, ...]
    options: IdentifyOptions
    notes: tuple[str, ...] = ()
    unit: str = "N m"
    gains: DriveGains | None = None

    @property
    def chain(self) -> Chain:
        """The arm that is identified."""
        return self.robot.chain


@dataclass(frozen=True, eq=False)
class IdentificationOutcome:
    """What an identification came to.

    Attributes:
        inputs: what it worked on.
        found: the model and how it came about.
        fit, validation: case name → its score.
        predictions: case name → predicted torques (N, rows) at the full rate.
        repeated: validation case → share of its states that the training motion has been in, where it is no proof.
        excitation: case name → what the motion can tell.
        warnings, verdict: as of `calib.procedure.dynamic_stage.verdict`.
        seed: that reproduces it.
        carried: what the geometry's uncertainty adds; None for an identification that was not asked for it.
        geometries: the estimate on the nominal geometry beside it; None where there is no other than the nominal.
    """

    inputs: IdentificationInputs
    found: Identification
    fit: Mapping[str, Score]
    validation: Mapping[str, Score]
    predictions: Mapping[str, np.ndarray]
    repeated: Mapping[str, float]
    excitation: Mapping[str, ExcitationReport]
    warnings: tuple[str, ...]
    verdict: Verdict
    seed: int = 0
    extra: Mapping[str, object] = field(default_factory=dict)
    carried: GeometryUncertainty | None = None
    geometries: GeometryComparison | None = None
    tracking: Tracking = field(default_factory=Tracking)


def gather(
    robot: str | Path | CalibratedChain,
    recordings: Sequence[str],
    validate: Sequence[str] = (),
    *,
    options: IdentifyOptions | None = None,
    method: str | None = None,
    friction: str | None = None,
    base: str | None = None,
    tip: str | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> IdentificationInputs:
    """Read the robot and all recordings, and make motions of them.

    Args:
        robot: see `calib.robot.load`; or as a geometric fit returns it.
        recordings, validate: paths, each with a cut if wanted (``log.npz@0:9.4``).
        options: the options file's content.
        method, friction: in place of the options'.
        base, tip: links of a URDF.
        seed: for everything random.
    """
    say = progress or (lambda words: None)
    options = with_choices(options or IdentifyOptions(), method, friction, seed)
    if not recordings:
        raise UsageError("no recording given")
    check_files(options, [*recordings, *validate])
    known = robot if isinstance(robot, CalibratedChain) else load_calibrated(robot, base, tip)
    source = Path(known.source or known.chain.name) if isinstance(robot, CalibratedChain) else resolve(robot)
    chain = known.chain
    paths = [*map(str, recordings), *map(str, validate)]
    names = case_names(paths)
    motions: list[Motion] = []
    for name, path in zip(names, paths):
        say(f"reading {name}")
        like = motions[0] if len(motions) >= len(recordings) else None
        motion = read_motion(path, chain, file_settings(options, path), like)
        motions.append(referred(motion, path, chain, options) if len(motions) < len(recordings) else motion)
    notes = [f"{name}: {note}" for name, motion in zip(names, motions) for note in motion.notes]
    count = len(recordings)
    found = find_gains(chain, options, dict(zip(paths, motions)), paths[:count], say)
    options = found.options
    cases = [read_case(path, name, motion, options, found) for name, path, motion in zip(names, paths, motions)]
    return IdentificationInputs(
        without_corrections(known), source, tuple(cases[:count]), tuple(cases[count:]), options,
        (*notes, *found.notes), found.unit, found.found,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Assessment:
    """A model beside the recordings, and what that comes to.

    Attributes:
        fit, validation: case name → its score.
        predictions: case name → predicted torques (N, rows) at the full rate.
        repeated: validation case → share of its states that the training motion has been in, where it is no proof.
        excitation: case name → what the motion can tell.
        verdict: as of `calib.procedure.dynamic_stage.verdict`.
        warnings: what a user should know of the recordings, and of the model.
    """

    fit: Mapping[str, Score]
    validation: Mapping[str, Score]
    predictions: Mapping[str, np.ndarray]
    repeated: Mapping[str, float]
    excitation: Mapping[str, ExcitationReport]
    verdict: Verdict
    warnings: tuple[str, ...]


def run(inputs: IdentificationInputs, progress: Progress | None = None) -> IdentificationOutcome:
    """Identify, predict every recording, and judge."""
    say, settings = progress or (lambda words: None), inputs.options.settings
    found = identify(inputs.robot, inputs.cases, settings, progress)
    wrong = driven(found.dynamics, inputs.cases)  # refused before hours go into the geometry's share
    carried, geometries = carry(inputs, found, say)
    excitation = {case.name: report_excitation(case.motion) for case in inputs.cases}
    amperes = relative_warnings(inputs.unit)
    said = *amperes, *model_warnings(inputs.cases, found, excitation)
    result = assess(inputs, found.dynamics, resting_parameters(found), said, wrong, progress=say)
    say("tracking with the model fed forward")
    tracking = (
        Tracking(unseen=bool(inputs.unseen), failure=amperes[0]) if amperes
        else track(inputs.chain, found, inputs.cases, inputs.unseen, result.predictions, inputs.unit)
    )  # fmt: skip
    return IdentificationOutcome(
        inputs, found, result.fit, result.validation, result.predictions, result.repeated, result.excitation,
        result.warnings, result.verdict, settings.seed, carried=carried, geometries=geometries, tracking=tracking,
    )  # fmt: skip


def assess(
    inputs: IdentificationInputs,
    dynamics: Dynamics,
    rests: Resting,
    said: Sequence[str],
    wrong: Sequence[int] | None = None,
    tolerance: float = 0.0,
    progress: Progress | None = None,
) -> Assessment:
    """Predict every recording and judge: in the command, and of a model read from its folder.

    Args:
        inputs: recordings to learn from (for the model's own error) and unseen ones.
        dynamics: the model.
        rests: its parameters that rest on a prior.
        said: warnings of the model itself.
        wrong: joints that friction drives, where that is known already (`friction.passivity.driven`).
        tolerance: largest error of the torque on unseen motion that is good enough [%]; 0: none.
    """
    say = progress or (lambda words: None)
    wrong = driven(dynamics, inputs.cases) if wrong is None else wrong
    predictions, scores = {}, {}
    for case in (*inputs.cases, *inputs.unseen):
        say(f"predicting {case.name}")
        predictions[case.name] = predict(dynamics, case)
        scores[case.name] = score(case, predictions[case.name], inputs.options.slow)
    say("judging")
    shares = {case.name: max(repeats(own.motion, case.motion) for own in inputs.cases) for case in inputs.unseen}
    repeated = {name: share for name, share in shares.items() if share >= REPEAT}
    excitation = {case.name: report_excitation(case.motion) for case in inputs.cases}
    fit = {case.name: scores[case.name] for case in inputs.cases}
    validation = {case.name: scores[case.name] for case in inputs.unseen}
    proofs = {name: one for name, one in validation.items() if name not in repeated}
    labels = inputs.options.settings.torque_rows.numbered(inputs.chain.n)
    verdict = with_prior(judge(fit, proofs, repeated, excitation, wrong, labels), rests)
    told = *warnings(inputs.cases, inputs.unseen, validation, repeated, excitation, inputs.chain), *said
    return Assessment(
        fit, validation, predictions, repeated, excitation, tolerated(verdict, proofs, tolerance),
        tuple(dict.fromkeys(told)),
    )  # fmt: skip


def tolerated(verdict: Verdict, proofs: Mapping[str, Score], tolerance: float) -> Verdict:
    """Return the verdict, made to fail where the tolerance [%] is not kept."""
    worst = max((one.raw.total for one in proofs.values()), default=0.0)
    if not tolerance or worst <= tolerance:
        return verdict
    return replace(verdict, level="fail", reason=f"{verdict.reason}; above the tolerance of {tolerance:g} %")


def carry(
    inputs: IdentificationInputs, found: Identification, say: Progress
) -> tuple[GeometryUncertainty, GeometryComparison | None]:
    """Return what the geometry's uncertainty adds to the estimate, and the estimate on the nominal geometry beside."""
    carried = propagate(found, inputs.robot, inputs.cases, say)
    if inputs.robot.nominal is None or not inputs.robot.moved:
        return carried, None
    say("the same on the nominal geometry")
    return carried, compare(found, carried, inputs.robot.nominal, inputs.cases)


def with_choices(options: IdentifyOptions, method: str | None, friction: str | None, seed: int) -> IdentifyOptions:
    """Return the options with the command's choices in them, held against what exists."""
    from calib.identification.friction.friction_ladder import NAMES
    from calib.identification.methods.least_squares import METHODS

    settings: IdentificationSettings = replace(options.settings, seed=seed)
    for value, allowed, key in ((method, METHODS, "method"), (friction, NAMES, "friction")):
        if value is None:
            continue
        if value not in allowed:
            raise UsageError(f"--{key} {value}: expected {', '.join(allowed)}")
        settings = replace(settings, **{key: value})
    return replace(options, settings=settings)


def read_case(path: str, name: str, motion: Motion, options: IdentifyOptions, found: FoundGains) -> Case:
    """Return the case of one recording; payload and gains as the options, or the gain identification, say."""
    own = file_settings(options, path)
    slow = (options.slow if options.slow is not None else 0.01) if options.cut_slow else None
    return make_case(
        name, motion, options.settings.torque_rows, gains=found.for_motion(motion, own), carried=own.payload, slow=slow
    )  # fmt: skip


def read_motion(path: str, chain: Chain, own: FileSettings, like: Motion | None = None) -> Motion:
    """Return the motion of a recording, held against the robot's joints and limits.

    Args:
        like: a motion whose identification band it is judged in, where the options state none; how far its own
            positions need filtering, it says itself.
    """
    recording = read_recording(path, joints_of(chain), own.recording)
    sampled = sample(recording, own.filter)
    if like is not None and own.filter.band is None and like.band * np.median(np.diff(recording.t)) < 0.4:
        banded = replace(own.filter, band=like.band * (1.0 - 1e-9))
        motion = make_motion(recording, banded, sampled)
        return motion if own.filter.cutoff is not None else _sharper(recording, motion, banded, sampled)
    motion = make_motion(recording, own.filter, sampled)
    if own.filter.cutoff is None:
        motion = _sharper(recording, motion, own.filter, sampled)
    widest = LOST * len(motion) / WINDOW  # decimation factor
    if own.filter.band is not None or motion.decimator.factor <= max(widest, 1.0):
        return motion
    band = SHARE * motion.rate / (2 * max(1, int(widest)))
    cutoff = tuple(float(f) for f in motion.cutoff)
    wider = make_motion(recording, replace(own.filter, band=min(band, 0.45 * motion.rate), cutoff=cutoff), sampled)
    note = f"f_p = {wider.band:.3g} Hz instead: a short recording must not lose its ends to the decimation's window"
    return replace(wider, notes=(*motion.notes, note))


def joints_of(chain: Chain) -> Joints:
    """Return what a recording is held against."""
    return Joints(
        chain.joint_names, tuple(joint_kinds(chain)), chain.lower, chain.upper,
        np.array([joint.velocity for joint in chain.joints]), np.array([joint.effort for joint in chain.joints]),
    )  # fmt: skip


def _sharper(recording: Recording, motion: Motion, options: FilterOptions, sampled: Resampled) -> Motion:
    """Return the motion with a higher f_q, where the encoders are quiet enough: f_q ≥ 5 f_dyn is a least value.

    White noise of the positions, σ_q, makes σ_a = σ_q (2π)² sqrt(2 f_q⁵ / (5 f_s)) in the accelerations; f_q is
    doubled where that stays below `QUIET` of every moving joint's rms acceleration (our choice).
    """
    size = np.sqrt(np.mean(motion.a**2, axis=0))
    moves = np.ptp(motion.q, axis=0) > 1e-3
    cutoff = float(motion.cutoff.max())
    f = 2.0 * cutoff
    noise = motion.cutoffs.noise * (2 * np.pi) ** 2 * np.sqrt(2 * f**5 / (5 * motion.rate))
    if f > 0.4 * motion.rate or not moves.any() or not (noise < QUIET * size)[moves].all():
        return motion
    borders = 2.0 / cutoff if options.borders is None else options.borders  # no samples that the wider band would add
    sharper = make_motion(recording, replace(options, cutoff=f, borders=borders), sampled)
    note = f"f_q = {f:.3g} Hz instead: the positions are quiet enough"
    return replace(sharper, notes=(*motion.notes, note), cutoffs=motion.cutoffs)


def referred(motion: Motion, path: str, chain: Chain, options: IdentifyOptions) -> Motion:
    """Return the motion with the reference of a file of its own, where the options name one."""
    own, loop = file_settings(options, path), options.settings.loop
    named = own.reference or (loop.reference if loop is not None and loop.reference != "recording" else "")
    if not named or loop is None:
        return motion
    beside = Path(options.source).parent / named
    return with_reference(motion, beside if beside.exists() else Path(named), Joints(chain.joint_names), own.recording)


def check_files(options: IdentifyOptions, paths: Sequence[str]) -> None:
    """Refuse a [files] table that names none of the recordings."""

    from calib.data.recordings.recording import parse_cut

    plain = [Path(parse_cut(str(path))[0]) for path in paths]
    for name in options.files:
        wanted = Path(name).parts
        if not any(path.parts[-len(wanted) :] == wanted for path in plain):
            shown = [path.name for path in plain]
            message = f'{options.source}: files."{name}" is none of the recordings{suggestion(name, shown)}'
            raise UsageError(f"{message}: {', '.join(shown)}")

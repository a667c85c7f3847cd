"""Inputs of an identification: the robot, the training recordings, and the held-out recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.recordings.checks import check_recording
from calib.data.recordings.recording import Recording, earlier, in_pieces, parse_cut
from calib.data.recordings.recording_files import read_recording
from calib.data.schema import Joints
from calib.data.signals.filtering import SHARE
from calib.data.signals.fingerprint import in_motion, sample_hashes
from calib.data.signals.motion import FilterOptions, Motion, make_motion, with_reference
from calib.data.signals.resampling import Resampled, resample
from calib.errors import MeasurementError, NoPosture, UsageError, refuse_data, refused_as, suggestion
from calib.identification.checks.recorded_motion import DesignedMotion, locate
from calib.identification.friction.friction_ladder import NAMES
from calib.identification.gains import DriveGains
from calib.identification.identify_options import FileSettings, IdentifyOptions
from calib.identification.link_motion import with_link_motion
from calib.identification.registry import METHODS
from calib.identification.rows import Case, case_names, make_case
from calib.identification.settings import IdentificationSettings
from calib.procedure.dynamic_stage.recorded_gains import FoundGains, find_gains
from calib.procedure.robot_kinds import Mechanism, joints_of
from calib.records import FieldValues, frozen
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain
from calib.robot.description import remarks
from calib.robot.library import load_calibrated, resolve
from calib.units import TORQUE

# of a recording may fall to the windows of the parallel decimation (our choice)
LOST = 0.05
# noise of the accelerations that is no matter, of their rms (our choice)
QUIET = 0.02
# samples per decimation factor that one window needs
WINDOW = 18
# of the sampling rate: highest identification band, and highest cutoff of positions
MAX_BAND = 0.45
MAX_CUTOFF = 0.4
# range of positions from which on a joint moves [rad or m]
MIN_RANGE = 1e-3


Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class IdentificationInputs:
    """Robot, recordings and options of an identification.

    Attributes:
        robot: `CalibratedChain` from a geometric fit or from a description, with joint corrections only if they move
            the links; or a `calib.procedure.robot_kinds.Mechanism`.
        source: file from which the robot was read.
        cases: training recordings.
        unseen: held-out recordings, whose torques are predicted.
        options: content of the options file, with the command's options replacing the file's values.
        notes: remarks for the user on the interpretation of the files.
        currents: drive gains that convert currents to torques.
        replayed: whether tracking with the model as feedforward is simulated.
    """

    robot: Any
    source: Path
    cases: tuple[Case, ...]
    unseen: tuple[Case, ...]
    options: IdentifyOptions
    notes: tuple[str, ...]
    currents: FoundGains
    replayed: bool = True

    @property
    def unit(self) -> str:
        """Unit of the torques: N m, or amperes if the drive gains are unknown."""
        return self.currents.unit

    @property
    def row_units(self) -> tuple[str, ...]:
        """Unit of each torque row.

        Joints without an identified drive gain keep their currents in amperes and are excluded from totals over joints.
        """
        rows = self.options.settings.torque_rows.units([joint.kind == "prismatic" for joint in self.chain.joints])
        if self.unit == TORQUE:
            return tuple(rows)
        in_amperes = self.currents.own
        return tuple(f"A of joint {k + 1}" if k in in_amperes else self.unit for k in range(len(rows)))

    @property
    def gains(self) -> DriveGains | None:
        """Identified drive gains; None if no gains were identified."""
        return self.currents.found

    @property
    def chain(self) -> Any:
        """The arm (`Chain`); for other robots, the actuated joints with names and limits."""
        return self.robot.chain

    def with_unseen(self, validate: Sequence[str | Path | Recording]) -> IdentificationInputs:
        """Return inputs with additional held-out recordings.

        Args:
            validate: paths, each with an optional cut (``log.npz@0:9.4``), or recordings in memory.
        """
        joints = joints_of(self.chain)
        paths = [_path(recording) for recording in validate]
        earlier_names = [case.name for case in (*self.cases, *self.unseen)]
        names = case_names([*earlier_names, *paths])[-len(paths) :]
        cases = []
        notes = []
        for name, path, recording in zip(names, paths, validate):
            motion = read_motion(recording, joints, self.options.file_settings(path), self.cases[0].motion)
            cases.append(_read_case(path, name, motion, self.options, self.currents, self.robot))
            notes += [f"{name}: {note}" for note in motion.notes]
        return replace(self, unseen=(*self.unseen, *cases), notes=(*self.notes, *notes))


def gather(
    robot: str | Path | CalibratedChain | Mechanism,
    recordings: Sequence[str | Path | Recording],
    validate: Sequence[str | Path | Recording] = (),
    *,
    options: IdentifyOptions | None = None,
    method: str | None = None,
    friction: str | None = None,
    base: str | None = None,
    tip: str | None = None,
    seed: int = 0,
    designed: Sequence[DesignedMotion] = (),
    progress: Progress | None = None,
) -> IdentificationInputs:
    """Return the inputs of an identification from files: the robot, and all recordings as filtered motions.

    Args:
        robot: name of a library robot, file (URDF, or MDH table in TOML), folder of a fit, or a robot in memory.
        recordings, validate: training and held-out recordings: paths, each with an optional cut (``log.npz@0:9.4``), or
            recordings in memory.
        options: content of the options file; None: defaults.
        method, friction: identification method and friction model; None: as in the options.
        base, tip: first and last link of the arm in a URDF; None: its root, and its flange.
        seed: seed of all random numbers.
        designed: designed motions, which are searched in recordings without a reference if the options have a [loop].
        progress: called with a text on each step; None: silent.

    Raises:
        UsageError: without a recording, and for unknown options.
        MeasurementError: for a recording that cannot be used.
    """
    options = with_choices(options or IdentifyOptions(), method, friction, seed)
    if not recordings:
        raise UsageError("no recording given")
    sources = [*recordings, *validate]
    unnamed = sum(isinstance(recording, Recording) and not recording.file for recording in sources)
    paths = []
    for number, recording in enumerate(sources, 1):
        name = f"recording {number}" if unnamed > 1 else "recording"
        paths.append(_path(recording, name))
    # a mechanism's outcome may be judged on more files later, named in the same options
    if not isinstance(robot, Mechanism):
        _check_files(options, paths)
    if isinstance(robot, (str, Path)):
        described, source = load_calibrated(robot, base, tip), resolve(robot)
    else:
        described, source = robot, Path(robot.source or robot.chain.name)
    chain = described.chain
    joints = joints_of(chain)
    if options.settings.loop is not None:
        options.settings.loop.check_lengths(chain.n)

    notes: list[str] = []
    if isinstance(described, CalibratedChain):
        notes += remarks(chain, bodies=False)
    names = case_names(paths)
    motions: list[Motion] = []
    files = [source for source in sources if not isinstance(source, Recording)]
    for name, path, recording in zip(names, paths, sources):
        if progress is not None:
            progress(f"reading {name}")
        file_options = options.file_settings(path)
        if len(motions) < len(recordings):
            motion = read_motion(recording, joints, file_options, companions=files)
            motion = _referred(motion, recording, joints, options, designed)
        else:
            # unseen recordings are judged in the band of the first training recording
            motion = read_motion(recording, joints, file_options, motions[0], files)
        motions.append(motion)
        notes += [f"{name}: {note}" for note in motion.notes]

    count = len(recordings)
    gains = find_gains(chain, options, dict(zip(paths, motions)), paths[:count], progress or silent)
    options = gains.options
    cases = []
    for name, path, motion in zip(names, paths, motions):
        cases.append(_read_case(path, name, motion, options, gains, described))
    _check_payloads(cases[:count], cases[count:], options.settings)
    if isinstance(described, CalibratedChain) and described.corrections is not None:
        shifts = [np.abs(case.link[0] - case.motion.q).max() for case in cases if case.link is not None]
        if shifts:
            effect = f"move the links by up to {1e3 * max(shifts):.3g} mrad or mm"
        else:
            effect = "are not used: the links are rigid"
            described = described.without_corrections()
        notes.append(f"joint corrections of the geometric fit {effect}")
    return IdentificationInputs(
        robot=described,
        source=source,
        cases=tuple(cases[:count]),
        unseen=tuple(cases[count:]),
        options=options,
        notes=(*notes, *gains.notes),
        currents=gains,
    )


def silent(words: str) -> None:
    """Ignore a progress text, `words`."""


def _check_payloads(cases: Sequence[Case], unseen: Sequence[Case], settings: IdentificationSettings) -> None:
    """Check that the payload of each held-out recording is identifiable or known.

    Args:
        cases: training recordings.
        unseen: held-out recordings.
        settings: settings of the identification with the payloads.

    Raises:
        UsageError: for a payload that is neither carried in a training recording nor stated in the options.
    """
    available = set(settings.payload_values)
    available.update(label for label, load in settings.payloads.items() if load.parameters)
    for case in cases:
        available.update(case.carried)
    for case in unseen:
        for label in set(case.carried) - available:
            raise UsageError(
                f"payload '{label}' of {case.name} is in no training recording; state its mass and com under "
                f"[payload.{label}], or add a training recording with it"
            )


def _path(recording: str | Path | Recording, unnamed: str = "recording") -> str:
    """Return the path of a recording, by which options and names refer to it.

    For a recording in memory, this is its file name with its time span, so that two cuts of one file differ.

    Args:
        recording: the recording.
        unnamed: name of a recording in memory without a file.
    """
    if not isinstance(recording, Recording):
        return str(recording)
    file = recording.file or unnamed
    # what times must be is checked later
    t = recording.t[np.isfinite(recording.t)]
    if len(t) < 2:
        return file
    return f"{file}@{t.min():.6g}:{t.max():.6g}"


def with_choices(options: IdentifyOptions, method: str | None, friction: str | None, seed: int) -> IdentifyOptions:
    """Return the options with the method, friction model and seed that the command states; None: as in the options.

    Args:
        options: content of the options file.
        method, friction: identification method and friction model; None: as in the options.
        seed: seed of all random numbers.

    Raises:
        UsageError: for an unknown method or friction model.
    """
    choices: FieldValues = {"seed": seed}
    if method is not None:
        _check_choice("method", method, tuple(METHODS))
        choices["method"] = method
    if friction is not None:
        _check_choice("friction", friction, NAMES)
        choices["friction"] = friction
    return replace(options, settings=replace(options.settings, **choices))


def _check_choice(option: str, value: str, allowed: Sequence[str]) -> None:
    """Raise a UsageError if the value of a command's option is not among the allowed values."""
    if value not in allowed:
        raise UsageError(f"--{option} {value}: expected {', '.join(allowed)}{suggestion(value, allowed)}")


def _read_case(path: str, name: str, motion: Motion, options: IdentifyOptions, gains: FoundGains, robot: Any) -> Case:
    """Return a recording as a `Case`: motion, torques by drive gains, payload, and the links' motion.

    The links' motion differs from the joints' motion only if the robot has joint corrections.

    Args:
        path: path of the recording, by which the options refer to it.
        name: name of the recording in results and messages.
        motion: the filtered motion.
        options: content of the options file.
        gains: drive gains.
        robot: the calibrated robot.
    """
    file_options = options.file_settings(path)
    rows = options.settings.torque_rows
    with refused_as(MeasurementError, NoPosture, "{}", name):
        values = gains.for_motion(motion, file_options)
        case = make_case(name, motion, rows, gains=values, carried=file_options.payload)
    if getattr(robot, "corrections", None) is not None:
        case = with_link_motion(robot, case, options.settings)
    return case


def read_motion(
    given: str | Path | Recording,
    chain: Chain | Joints,
    own: FileSettings,
    like: Motion | None = None,
    companions: Sequence[str | Path] = (),
) -> Motion:
    """Return the filtered motion of a recording, checked against the robot's joints and limits.

    Args:
        given: a path, with an optional cut, or a recording in memory.
        chain: the robot, or its joints.
        own: the options for this recording.
        like: motion whose identification band is used if the options state no band; the cutoff of the position filter
            still follows from the recording. None: both follow from the recording.
        companions: other files of the same command, one of which may have what this one lacks.
    """
    joints = chain if isinstance(chain, Joints) else joints_of(chain)
    if isinstance(given, Recording):
        pieces = in_pieces(given, own.recording.samples)
        recording = check_recording(earlier(pieces, own.recording.lag), joints)
    else:
        recording = read_recording(given, joints, own.recording, companions)
    sampled = resample(recording, own.filter.clock, own.filter.gap)

    moving = in_motion(recording.t, recording.q)
    hashes = sample_hashes([recording.q[moving], recording.effort[moving]])

    options = own.filter
    same_band = like is not None and own.filter.band is None
    if like is not None and same_band and like.band * np.median(np.diff(recording.t)) < MAX_CUTOFF:
        options = replace(own.filter, band=like.band * (1.0 - 1e-9))
    motion = make_motion(recording, options, sampled)
    if own.filter.cutoff is None:
        motion = _sharper(recording, motion, options, sampled)
    motion = replace(motion, hashes=hashes)
    # windows of the decimation take too much of the ends of a short recording
    max_factor = LOST * len(motion) / WINDOW
    if options.band is not None or motion.decimator.factor <= max(max_factor, 1.0):
        return motion
    band = SHARE * motion.rate / (2 * max(1, int(max_factor)))
    wider_options = replace(
        own.filter,
        cutoff=_joints(motion.cutoff),
        velocity_cutoff=_joints(motion.velocity_cutoff),
        band=min(band, MAX_BAND * motion.rate),
    )
    wider = make_motion(recording, wider_options, sampled, motion.cutoffs)
    note = f"identification band f_p = {wider.band:.3g} Hz instead, to keep the ends of a short recording"
    return replace(wider, notes=(*motion.notes, note), hashes=hashes)


def rows_per_second(band: float, duration: float) -> float:
    """Return the least number of rows per second with which `read_motion` lets a recording be identified.

    Windows of the decimation take less than `LOST` of a recording, and its band passes.

    Args:
        band: identification band of the motion [Hz].
        duration: duration of the recording [s].
    """
    return max(2.0 * band / SHARE, WINDOW / (LOST * duration))


def _joints(values: np.ndarray) -> tuple[float, ...]:
    return tuple(map(float, values))


def _sharper(recording: Recording, motion: Motion, options: FilterOptions, sampled: Resampled) -> Motion:
    """Return the motion filtered with twice the cutoff f_q if the encoder noise is low; otherwise the unchanged motion.

    The default f_q ≥ 5 f_dyn is only a minimum. f_q is doubled if the resulting acceleration noise stays below `QUIET`
    times the rms acceleration of every moving joint (our choice).

    Args:
        recording: the recording.
        motion: the recording, filtered with the default cutoff.
        options: options of the filters.
        sampled: the recording at a constant sampling rate.
    """
    rms = np.sqrt(np.mean(motion.a**2, axis=0))
    moves = np.ptp(motion.q, axis=0) > MIN_RANGE
    cutoff = float(motion.cutoff.max())
    doubled = 2.0 * cutoff
    noise = motion.cutoffs.acceleration_noise(doubled, motion.rate)
    if doubled > MAX_CUTOFF * motion.rate or not moves.any() or not (noise < QUIET * rms)[moves].all():
        return motion
    # no samples that the wider band would add
    borders = 2.0 / cutoff if options.borders is None else options.borders
    sharper_options = replace(options, velocity_cutoff=_joints(motion.velocity_cutoff), borders=borders, cutoff=doubled)
    sharper = make_motion(recording, sharper_options, sampled, motion.cutoffs)
    note = f"cut-off of positions f_q = {doubled:.3g} Hz instead: the position noise is low enough"
    return replace(sharper, notes=(*motion.notes, note))


def _referred(
    motion: Motion,
    recording: str | Path | Recording,
    joints: Joints,
    options: IdentifyOptions,
    designed: Sequence[DesignedMotion],
) -> Motion:
    """Return the motion with reference positions of the control loop, if the options describe a control loop.

    The reference positions are from a file named in the options, from the recording, or from a designed motion.

    Args:
        motion: the filtered motion.
        recording: the recording, or its path.
        joints: the robot's joints.
        options: content of the options file.
        designed: designed motions, which are searched in the recording.
    """
    file_options, loop = options.file_settings(_path(recording)), options.settings.loop
    if loop is None:
        return motion
    reference = file_options.reference
    if not reference and loop.reference != "recording":
        reference = loop.reference
    if reference:
        beside = Path(options.source).parent / reference
        path = beside if beside.exists() else Path(reference)
        return with_reference(motion, path, joints, file_options.recording)
    if designed and motion.q_ref is None:
        return _with_design(motion, recording, joints, file_options, designed)
    return motion


def _with_design(
    motion: Motion,
    source: str | Path | Recording,
    joints: Joints,
    options: FileSettings,
    designed: Sequence[DesignedMotion],
) -> Motion:
    """Return the part of a motion in which whole periods of a designed motion were played, with reference positions.

    The reference positions are those of the designed motion. It is searched in the whole file, since a cut may contain
    less than a period.

    Args:
        motion: the filtered motion of the recording.
        source: the recording, or its path with an optional cut.
        joints: the robot's joints.
        options: the options for this recording.
        designed: designed motions to search for.

    Raises:
        MeasurementError: if no designed motion is found.
    """
    recording = source
    if not isinstance(recording, Recording):
        file = parse_cut(str(source))[0]
        recording = read_recording(file, joints, replace(options.recording, samples=None))
    for design in designed:
        located = locate(recording, design)
        if located is None:
            continue
        span = [located.began, located.began + located.periods * design.period]
        start, stop = np.searchsorted(motion.t, span)
        if start < stop:
            part = slice(start, stop)
            q_ref = frozen(design.orders(motion.t[part] - located.began)[0])
            return replace(motion.part(part), q_ref=q_ref, located=located.began)
    refuse_data(
        motion.file,
        "has no reference positions (q_ref), and contains none of the designed motions whole: log the reference, or "
        "record again",
    )


def _check_files(options: IdentifyOptions, paths: Sequence[str]) -> None:
    """Check that each entry of the options' table ``[files]`` names one of the recordings.

    Args:
        options: content of the options file.
        paths: paths of all recordings.

    Raises:
        UsageError: for an entry that matches no recording.
    """
    files = [Path(parse_cut(str(path))[0]) for path in paths]
    file_names = [file.name for file in files]
    source = f"{options.source}: " if options.source else ""
    for name in options.files:
        parts = Path(name).parts
        if not any(file.parts[-len(parts) :] == parts for file in files):
            message = f'{source}files."{name}" names none of the recordings{suggestion(name, file_names)}'
            raise UsageError(f"{message}: {', '.join(file_names)}")

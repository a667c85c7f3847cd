"""Inputs of an identification: the robot, the training recordings, and the unseen recordings."""

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
from calib.procedure.dynamic_stage.gains import FoundGains, find_gains
from calib.procedure.robot_kinds import Mechanism, joints_of
from calib.records import frozen
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain
from calib.robot.description import remarks
from calib.robot.library import load_calibrated, resolve
from calib.units import TORQUE

LOST = 0.05  # of a recording may fall to the windows of the parallel decimation (our choice)
QUIET = 0.02  # noise of the accelerations that is no matter, of their rms (our choice)
WINDOW = 18  # samples per decimation factor that one window needs

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class IdentificationInputs:
    """Robot, recordings and options of an identification.

    Attributes:
        robot: `CalibratedChain` from a geometric fit or from a description, with joint corrections only where these
            move the links; or a `calib.procedure.robot_kinds.Mechanism`.
        source: the file it came from.
        cases: training recordings.
        unseen: recordings to be predicted.
        options: content of the options file, updated by the command's options.
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
        """Unit of the torques."""
        return self.currents.unit

    @property
    def row_units(self) -> tuple[str, ...]:
        """Unit of each torque row; separate amperes for a joint without an identified gain."""
        rows = self.options.settings.torque_rows.units([joint.kind == "prismatic" for joint in self.chain.joints])
        if self.unit == TORQUE:
            return tuple(rows)
        own = self.currents.own
        return tuple(f"A of joint {k + 1}" if k in own else self.unit for k in range(len(rows)))

    @property
    def gains(self) -> DriveGains | None:
        """Identified drive gains; None if none were identified."""
        return self.currents.found

    @property
    def chain(self) -> Any:
        """Identified arm; for other robots, their actuated joints with names and limits."""
        return self.robot.chain

    def with_unseen(self, validate: Sequence[str | Path | Recording]) -> IdentificationInputs:
        """Return inputs with additional unseen recordings.

        Args:
            validate: paths, each with a cut if wanted, or recordings in memory.
        """
        paths = [_path(each) for each in validate]
        names = case_names([*(case.name for case in (*self.cases, *self.unseen)), *paths])[-len(paths) :]
        cases, notes = [], []
        for name, path, each in zip(names, paths, validate):
            joints = joints_of(self.chain)
            motion = read_motion(each, joints, self.options.file_settings(path), self.cases[0].motion)
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
    """Return the inputs of an identification from files: the robot, and all recordings as motions.

    Args:
        robot: see `calib.robot.library`; or as a geometric fit returns it.
        recordings, validate: paths, each with a cut if wanted (``log.npz@0:9.4``), or recordings in memory.
        options: the options file's content.
        method, friction: in place of the options'.
        base, tip: links of a URDF.
        seed: for everything random.
        designed: motions of which a recording without a reference contains one, for options with a [loop].
    """
    say = progress or (lambda words: None)
    options = _with_choices(options or IdentifyOptions(), method, friction, seed)
    if not recordings:
        raise UsageError("no recording given")
    given = [*recordings, *validate]
    paths = [_path(each) for each in given]
    if not isinstance(robot, Mechanism):  # whose outcome may be judged on more files later, named in the same options
        _check_files(options, paths)
    known = load_calibrated(robot, base, tip) if isinstance(robot, (str, Path)) else robot
    source = resolve(robot) if isinstance(robot, (str, Path)) else Path(known.source or known.chain.name)
    chain, arm = known.chain, isinstance(known, CalibratedChain)
    joints = joints_of(chain)
    if options.settings.loop is not None:
        options.settings.loop.check_lengths(chain.n)
    names = case_names(paths)
    motions: list[Motion] = []
    for name, path, each in zip(names, paths, given):
        say(f"reading {name}")
        like = motions[0] if len(motions) >= len(recordings) else None
        motion = read_motion(each, joints, options.file_settings(path), like)
        motions.append(_referred(motion, each, joints, options, designed) if like is None else motion)
    notes = [
        *(remarks(chain, bodies=False) if arm else ()),
        *(f"{name}: {note}" for name, motion in zip(names, motions) for note in motion.notes),
    ]
    count = len(recordings)
    found = find_gains(chain, options, dict(zip(paths, motions)), paths[:count], say)
    options = found.options
    cases = [_read_case(path, name, motion, options, found, known) for name, path, motion in zip(names, paths, motions)]
    _check_payloads(cases[:count], cases[count:], options.settings)
    if isinstance(known, CalibratedChain) and known.corrections is not None:
        far = [np.abs(case.link[0] - case.motion.q).max() for case in cases if case.link is not None]
        known = known if far else known.without_corrections()
        how = f"move the links by up to {1e3 * max(far):.3g} mrad or mm" if far else "take no part: the links are rigid"
        notes.append(f"joint corrections of the geometric fit {how}")
    return IdentificationInputs(
        known, source, tuple(cases[:count]), tuple(cases[count:]), options, (*notes, *found.notes), found
    )


def _check_payloads(cases: Sequence[Case], unseen: Sequence[Case], settings: IdentificationSettings) -> None:
    """Refuse an unseen recording with a payload that is neither in the training recordings nor in the options."""
    known = {*settings.payload_values, *(label for label, load in settings.payloads.items() if load.parameters)}
    known.update(label for case in cases for label in case.carried)
    for case in unseen:
        for label in set(case.carried) - known:
            raise UsageError(
                f"payload '{label}' of {case.name} is in no training recording; state its mass and com under "
                f"[payload.{label}], or add a training recording with it"
            )


def _path(each: str | Path | Recording) -> str:
    """Return the path of a recording; in memory, its file and time span (so that two cuts of a file differ)."""
    if not isinstance(each, Recording):
        return str(each)
    file, t = each.file or "recording", each.t[np.isfinite(each.t)]
    return f"{file}@{t.min():.6g}:{t.max():.6g}" if len(t) > 1 else file  # what they must be is checked later


def _with_choices(options: IdentifyOptions, method: str | None, friction: str | None, seed: int) -> IdentifyOptions:
    """Return the options with the command's method, friction model and seed; refuse unknown names."""
    given = {key: value for key, value in (("method", method), ("friction", friction)) if value is not None}
    for key, value in given.items():
        allowed = tuple(METHODS) if key == "method" else NAMES
        if value not in allowed:
            raise UsageError(f"--{key} {value}: expected {', '.join(allowed)}{suggestion(value, allowed)}")
    return replace(options, settings=replace(options.settings, seed=seed, **given))


def _read_case(path: str, name: str, motion: Motion, options: IdentifyOptions, found: FoundGains, robot: Any) -> Case:
    """Return the case of one recording: payload, gains, and the links' motion where joints have corrections."""
    own = options.file_settings(path)
    with refused_as(MeasurementError, NoPosture, "{}", name):
        case = make_case(
            name, motion, options.settings.torque_rows, gains=found.for_motion(motion, own), carried=own.payload
        )
    if getattr(robot, "corrections", None) is not None:
        case = with_link_motion(robot, case, options.settings)
    return case


def read_motion(
    given: str | Path | Recording, chain: Chain | Joints, own: FileSettings, like: Motion | None = None
) -> Motion:
    """Return the motion of a recording, checked against the robot's joints and limits.

    Args:
        given: a path, with a cut if wanted, or the recording.
        chain: the robot, or its joints.
        like: a motion whose identification band it is judged in, where the options state none; how far its own
            positions need filtering, it says itself.
    """
    joints = chain if isinstance(chain, Joints) else joints_of(chain)
    if isinstance(given, Recording):
        some = in_pieces(given, own.recording.samples)
        recording = check_recording(earlier(some, own.recording.lag), joints)
    else:
        recording = read_recording(given, joints, own.recording)
    sampled = resample(recording, own.filter.clock, own.filter.gap)
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
    same = replace(own.filter, cutoff=_joints(motion.cutoff), velocity_cutoff=_joints(motion.velocity_cutoff))
    wider = make_motion(recording, replace(same, band=min(band, 0.45 * motion.rate)), sampled, motion.cutoffs)
    note = f"f_p = {wider.band:.3g} Hz instead, so that decimation does not remove the ends of a short recording"
    return replace(wider, notes=(*motion.notes, note))


def _joints(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(one) for one in values)


def _sharper(recording: Recording, motion: Motion, options: FilterOptions, sampled: Resampled) -> Motion:
    """Return the motion with a higher f_q if the encoders have low noise: f_q ≥ 5 f_dyn is a minimum.

    f_q is doubled where noise stays below `QUIET` of every moving joint's rms acceleration (our choice).
    """
    size = np.sqrt(np.mean(motion.a**2, axis=0))
    moves = np.ptp(motion.q, axis=0) > 1e-3
    cutoff = float(motion.cutoff.max())
    f = 2.0 * cutoff
    noise = motion.cutoffs.acceleration_noise(f, motion.rate)
    if f > 0.4 * motion.rate or not moves.any() or not (noise < QUIET * size)[moves].all():
        return motion
    borders = 2.0 / cutoff if options.borders is None else options.borders  # no samples that the wider band would add
    same = replace(options, velocity_cutoff=_joints(motion.velocity_cutoff), borders=borders)
    sharper = make_motion(recording, replace(same, cutoff=f), sampled, motion.cutoffs)
    note = f"f_q = {f:.3g} Hz instead: the position noise is low enough"
    return replace(sharper, notes=(*motion.notes, note))


def _referred(
    motion: Motion,
    given: str | Path | Recording,
    joints: Joints,
    options: IdentifyOptions,
    designed: Sequence[DesignedMotion],
) -> Motion:
    """Return the motion with its reference: of a file that the options name, its own, or a designed motion."""
    own, loop = options.file_settings(_path(given)), options.settings.loop
    if loop is None:
        return motion
    if named := own.reference or loop.reference * (loop.reference != "recording"):
        beside = Path(options.source).parent / named
        return with_reference(motion, beside if beside.exists() else Path(named), joints, own.recording)
    return _with_design(motion, given, joints, own, designed) if designed and motion.q_ref is None else motion


def _with_design(
    motion: Motion, given: str | Path | Recording, joints: Joints, own: FileSettings, designed: Sequence[DesignedMotion]
) -> Motion:
    """Return the part of a motion in which whole periods of a designed motion were played, with it as the reference.

    They are looked for in the whole file: a cut may contain less than a period.
    """
    options = replace(own.recording, samples=None)
    whole = given if isinstance(given, Recording) else read_recording(parse_cut(str(given))[0], joints, options)
    for design in designed:
        if (found := locate(whole, design)) is None:
            continue
        part = slice(*np.searchsorted(motion.t, [found.began, found.began + found.periods * design.period]))
        if part.start < part.stop:
            q_ref = frozen(design.orders(motion.t[part] - found.began)[0])
            return replace(motion.part(part), q_ref=q_ref, located=found.began)
    refuse_data(motion.file, "has no reference positions (q_ref), and contains none of the designed motions whole")


def _check_files(options: IdentifyOptions, paths: Sequence[str]) -> None:
    """Refuse a [files] table that names none of the recordings."""
    plain = [Path(parse_cut(str(path))[0]) for path in paths]
    for name in options.files:
        wanted = Path(name).parts
        if not any(path.parts[-len(wanted) :] == wanted for path in plain):
            shown = [path.name for path in plain]
            message = f'{options.source}: files."{name}" names none of the recordings{suggestion(name, shown)}'
            raise UsageError(f"{message}: {', '.join(shown)}")

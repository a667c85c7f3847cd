"""Drive gains that convert currents to torques: from the options or the recording, or identified by a known payload."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.data.recordings.recording import parse_cut
from calib.data.recordings.recording_files import read_recording
from calib.data.schema import Joints
from calib.data.signals.motion import Motion, make_motion
from calib.dynamics.bodies import STANDARD
from calib.errors import UsageError
from calib.identification.gains import DriveGains, identify_gains, identify_relative_gains
from calib.identification.identify import chain_states, common_decimator, find_base
from calib.identification.identify_options import FileSettings, GainPair, IdentifyOptions
from calib.identification.prior import first_fit
from calib.identification.rows import Case, make_case, observe, pool, triangulate, with_blocks
from calib.identification.settings import IdentificationSettings, make_model
from calib.procedure.robot_kinds import ROBOTS
from calib.robot.chain import Chain
from calib.units import TORQUE, without_gains

# relative sigma of a gain from which on it is called poorly identified
MAX_GAIN_SIGMA = 0.1


@dataclass(frozen=True, eq=False)
class FoundGains:
    """Drive gains that convert currents to torques.

    Attributes:
        options: the options, including payload parameters that were identified together with the gains.
        gains: (n,) gains for recordings that state no gains; None if not needed.
        found: identified gains with their σ; None if no gains were identified.
        unit: unit of the converted torques.
        notes: remarks for the user.
    """

    options: IdentifyOptions
    gains: np.ndarray | None
    found: DriveGains | None
    unit: str
    notes: tuple[str, ...]

    @property
    def own(self) -> tuple[int, ...]:
        """Indices of joints without an identified gain, whose torques stay in amperes."""
        return () if self.found is None else self.found.own

    def for_motion(self, motion: Motion, options: FileSettings) -> np.ndarray | None:
        """Return the gains (n,) that apply to a motion; None if the motion contains torques instead of currents.

        Gains in the options take precedence over identified gains, and these over gains in the recording.

        Args:
            motion: the motion.
            options: the options for its recording.
        """
        if options.gains is not None:
            if len(options.gains) not in (1, motion.n):
                raise UsageError(
                    f"gains: {len(options.gains)} values for {motion.n} joints ({motion.file}): state one per joint"
                )
            return np.broadcast_to(np.array(options.gains), (motion.n,))
        if motion.kind != "current":
            return None
        return self.gains if self.gains is not None else motion.drive_gain


def find_gains(
    chain: Chain,
    options: IdentifyOptions,
    motions: Mapping[str, Motion],
    training: Sequence[str],
    say: Callable[[str], None],
) -> FoundGains:
    """Return the drive gains that convert recorded currents to torques.

    Args:
        chain: the arm.
        options: options of the identification; if they name recordings without and with a known payload, these
            determine the gains.
        motions: path of a recording -> motion, for all recordings.
        training: paths of the training recordings, from which relative gains are identified.
        say: called with a text on each step.

    Raises:
        UsageError: if some recordings contain currents without gains, and others torques.
    """
    if options.gain_pair is not None:
        say("drive gains")
        return _from_pair(chain, options, options.gain_pair, motions)
    bare_currents = []
    for path, motion in motions.items():
        if motion.kind == "current" and motion.drive_gain is None and options.file_settings(path).gains is None:
            bare_currents.append(path)
    if not bare_currents:
        return FoundGains(options, None, None, TORQUE, ())
    with_gains = [path for path in motions if path not in bare_currents]
    if with_gains:
        raise UsageError(
            f"{bare_currents[0]} contains currents without gains, {with_gains[0]} torques (or currents with gains): "
            "one model cannot use both A and N m; state gains for all of them"
        )
    say("relative drive gains")
    return _relative(chain, options, [(path, motions[path]) for path in training if path in bare_currents])


def _from_pair(chain: Chain, options: IdentifyOptions, pair: GainPair, motions: Mapping[str, Motion]) -> FoundGains:
    """Return absolute drive gains, identified from recordings without and with a payload of known mass.

    Args:
        chain: the arm.
        options: options of the identification with the payload's mass.
        pair: names of the recordings without and with the payload.
        motions: path of a recording -> motion.
    """
    settings = options.settings
    known_values = {f"M{label}": load.mass for label, load in settings.payloads.items() if load.mass is not None}
    for label, load in settings.payloads.items():
        if load.com is not None and load.mass is not None:
            known_values |= {f"M{axis}{label}": load.mass * c for axis, c in zip("XYZ", load.com)}
    if not known_values:
        raise UsageError(f"{options.source}: gain_identification needs a [payload.<label>] with its mass")
    cases = [_case(name, chain, options, motions, ()) for name in pair.unloaded]
    cases += [_case(name, chain, options, motions, tuple(settings.payloads)) for name in pair.loaded]
    gains = _identify(chain, cases, settings, known_values, None)

    values = dict(zip(gains.names, gains.values))
    loads = {}
    for label in settings.payloads:
        loads[label] = tuple(float(values.get(name + label, 0.0)) for name in STANDARD)
    printed = ", ".join(f"{gain:.4g} ± {sigma:.2g}" for gain, sigma in zip(gains.gains, gains.sigma))
    files = ", ".join(Path(parse_cut(name)[0]).name for name in (*pair.unloaded, *pair.loaded))
    notes = (
        f"drive gains from {files} ({gains.scale}): {printed}",
        f"gains and payload are estimated from {files}, so these do not validate the model; the σ of parameters do not "
        "contain the uncertainty of the gains",
        *_poor_gains(gains),
    )
    with_loads = replace(options, settings=replace(settings, payload_values=loads))
    return FoundGains(with_loads, gains.gains, gains, TORQUE, notes)


def _relative(chain: Chain, options: IdentifyOptions, currents: Sequence[tuple[str, Motion]]) -> FoundGains:
    """Return drive gains relative to the joint with the largest current; all torques are then in amperes of this joint.

    Args:
        chain: the arm.
        options: options of the identification.
        currents: path and motion of each training recording of currents; empty: the gains remain unknown.
    """
    if not currents:
        return FoundGains(options, None, None, "A", ("drive gains are unknown: torques are currents [A]",))
    cases = [make_case(path, motion, carried=options.file_settings(path).payload) for path, motion in currents]
    squares = sum(np.sum(np.asarray(case.target) ** 2, axis=0) for case in cases)
    reference = int(np.argmax(squares))
    gains = _identify(chain, cases, options.settings, {}, reference)
    unit = f"A of joint {reference + 1}"

    printed = []
    for j, (gain, sigma) in enumerate(zip(gains.gains, gains.sigma)):
        if j in gains.own:
            printed.append("unknown")
        elif j == reference:
            printed.append("1")
        else:
            printed.append(f"{gain:.4g} ± {sigma:.2g}")
    notes = [
        f"torques are {without_gains(unit)}; gains by joint, relative to that reference: {', '.join(printed)}; for N "
        "m give gains, "
        "or [gain_identification] with a payload of known mass"
    ]
    if gains.own:
        joints = ", ".join(f"joint {j + 1}" for j in sorted(gains.own))
        notes.append(
            f"this motion does not identify the gain of {joints}: torques of such a joint stay in A and "
            "are omitted from totals; record richer motion, or give the gain"
        )
    notes += _poor_gains(gains)
    options = replace(options, settings=replace(options.settings, apart=tuple(gains.own)))
    return FoundGains(options, gains.gains, gains, unit, tuple(notes))


def _identify(
    chain: Chain,
    cases: Sequence[Case],
    settings: IdentificationSettings,
    known_values: Mapping[str, float],
    reference: int | None,
) -> DriveGains:
    if not isinstance(chain, Chain):
        return ROBOTS.first().drive_gains(chain, cases, settings, known_values, reference)
    model = make_model(chain, settings)
    base = find_base(model, cases, chain_states(chain, model, settings.seed))
    missing = [name for name in known_values if name not in [model.names[k] for k in base.kept]]
    if missing:
        raise UsageError(f"'{missing[0]}' is not separately identifiable from these runs; was the payload attached?")
    decimator = common_decimator(cases, settings)
    rows = with_blocks([observe(model, base.kept, case, decimator) for case in cases], settings.folds)
    tau = first_fit(rows)[1]
    if reference is not None:
        return identify_relative_gains(triangulate(rows), chain.n, tau, reference)
    return identify_gains(pool(triangulate(rows), chain.n), known_values, tau)


def _case(
    name: str, chain: Chain, options: IdentifyOptions, motions: Mapping[str, Motion], carried: tuple[str, ...]
) -> Case:
    """Return a recording of currents as a `Case`.

    The recording is one of `motions`, or else a file in the folder of the options file.

    Args:
        name: name or path of the recording in the options.
        chain: the arm.
        options: options of the identification.
        motions: path of a recording -> motion, for all recordings of the command.
        carried: labels of the payloads that the arm carries.

    Raises:
        UsageError: if there is no such recording.
    """
    file = parse_cut(name)[0]
    for path, motion in motions.items():
        if path == name or Path(parse_cut(path)[0]).name == file:
            return make_case(name, motion, carried=carried)
    beside = Path(options.source).parent / name if options.source else Path(name)
    recording = name
    if Path(parse_cut(str(beside))[0]).exists():
        recording = str(beside)
    if not Path(parse_cut(recording)[0]).exists():
        raise UsageError(f"{options.source}: gain_identification names {name}, neither a given recording nor a file")
    file_options = options.file_settings(recording)
    joints = Joints(chain.joint_names)
    motion = make_motion(read_recording(recording, joints, file_options.recording), file_options.filter)
    return make_case(name, motion, carried=carried)


def _poor_gains(gains: DriveGains) -> list[str]:
    """Return a note for the user on gains with a large relative σ; an empty list if there are none."""
    joints = []
    for j, (gain, sigma) in enumerate(zip(gains.gains, gains.sigma)):
        if sigma > MAX_GAIN_SIGMA * abs(gain):
            joints.append(f"joint {j + 1} ({100 * sigma / abs(gain):.0f} %)")
    return [f"these runs identify some gains poorly:  {', '.join(joints)}"] if joints else []

"""Options for reading recordings: accepted names of series, their units, and names stated by the user.

Accepted names (the first name of a row found in the file is used; case and blanks do not matter):

========== =============================================================================================
ours       in an archive, and in a table before the joint's number or name
========== =============================================================================================
t          t, time, times, timestamp, timestamps, stamp, __time; or a rate: frequency, rate, sample_rate, fs [Hz]
q          q, positions, position, pos, joint_positions, qpos
v          v, dq, qd, dot_q, velocities, velocity, vel, joint_velocities, qvel
effort     torque: tau, torque, torques, effort, efforts, joint_torques, measured_torque
           current: i, current, currents, motor_current, actual_current, joint_currents
tau_link   tau_link, tau_l, tau_sensor, link_torque
tau_motor  tau_motor, tau_m, motor_torque
q_link     q_link, link_position
q_ref      q_ref, q_des, q_cmd, q_desired, q_reference, q_command, q_target, position_reference, position_command,
           desired_position, reference_position, target_position, target_q (UR's RTDE), q_d (Franka)
tau_ff     tau_ff, tau_feedforward, torque_feedforward
========== =============================================================================================

FloBaRoID writes times, positions, velocities, torques. Words before a name that only mean "measured"
(`MEASURED`: ``actual_q_0``, ``state.q[0]``) do not matter where no column has the plain name.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from calib.config import strict
from calib.config_types import Checked, Flag, Hidden, Name, OneOf, Positive, Real, Text, Whole, shown
from calib.data.recordings.recording import named
from calib.data.schema import Joints
from calib.errors import UsageError, refuse_data, refused_as, require, suggestion
from calib.units import COUNT_WORDS, CURRENTS, EFFORTS, POSITIONS, TIMES, TURNED, VELOCITIES, encoder_counts

SYNONYMS: Mapping[str, tuple[str, ...]] = {
    "t": ("t", "time", "times", "timestamp", "timestamps", "stamp", "__time", "%time"),
    "q": ("q", "positions", "position", "pos", "joint_positions", "qpos"),
    "v": ("v", "dq", "qd", "dot_q", "velocities", "velocity", "vel", "joint_velocities", "qvel"),
    "torque": ("tau", "torque", "torques", "effort", "efforts", "joint_torques", "measured_torque"),
    "current": ("i", "current", "currents", "motor_current", "actual_current", "joint_currents"),
    "tau_link": ("tau_link", "tau_l", "tau_sensor", "link_torque"),
    "tau_motor": ("tau_motor", "tau_m", "motor_torque"),
    "q_link": ("q_link", "link_position"),
    "q_ref": (
        "q_ref",
        "q_des",
        "q_cmd",
        "q_desired",
        "q_reference",
        "q_command",
        "q_target",
        "position_reference",
        "position_command",
        "desired_position",
        "reference_position",
        "target_position",
        "target_q",
        "q_d",
    ),
    "tau_ff": ("tau_ff", "tau_feedforward", "torque_feedforward"),
}
MEASURED = ("actual", "measured", "state", "robot")
_NUMBER = re.compile(r"\d+(?!.*\d)")
# Largest lag that is believed [s] (our choice).
MAX_LAG = 1.0
RATES = ("frequency", "rate", "sample_rate", "fs")
KEYS_BESIDE_SERIES = ("joint_names", "drive_gain", "use_range")
SCALES = {
    "t": TIMES,
    "q": POSITIONS,
    "v": VELOCITIES,
    "torque": EFFORTS,
    "current": CURRENTS,
    "tau_link": EFFORTS,
    "tau_motor": EFFORTS,
    "tau_ff": EFFORTS,
    "q_link": POSITIONS,
    "q_ref": POSITIONS,
}


def _ours(names: object) -> object:
    """Return `names` unchanged; raise ValueError for a name that is not a series of the toolkit."""
    if not isinstance(names, Mapping):
        return names
    for name in names:
        message = f"'{name}' is not a known name{suggestion(name, SYNONYMS)}; known are {', '.join(SYNONYMS)}"
        require(name in SYNONYMS, message, ValueError)
    return names


def _known(units: object) -> object:
    """Return `units` unchanged; raise ValueError for a unit that does not suit its series."""
    if not isinstance(units, Mapping):
        return units
    _ours(units)
    for name, unit in units.items():
        if isinstance(unit, str) and SCALES[name] is POSITIONS and encoder_counts(unit):
            continue
        if unit and (not isinstance(unit, str) or unit.lower() not in SCALES[name]):
            raise ValueError(f"unit {shown(unit)} of {name} is unknown; expected one of {', '.join(SCALES[name])}")
    return units


@strict
@dataclass(frozen=True)
class RecordingOptions:
    """Options for reading a recording; by default the file determines everything.

    Attributes:
        kind: what the efforts are: needed if a file has torques and currents, or currents under a torque's name.
        names: the toolkit's name of a series → the file's name.
        columns: the same, joint by joint too (``q1``, ``tau_2``, a joint's name); ``{joint}`` in a heading stands for
            each joint's name.
        units: the toolkit's name of a series → its unit, if the file states none; SI by default.
        rate: sampling rate of a file without stamps [Hz].
        topic: name of the topic to read, for a ROS bag with several topics of joint states.
        use_range: use only the rows of the file's `use_range` if the path has no cut.
        controller: joints are as this controller shows them (`calib program --list`); torques take its signs only.
        external: names of joints that are external axes of the controller, where names and kinds do not tell.
        samples: largest number of samples used; of a longer recording, pieces spread over it; None: all.
        lag: delay of torques and currents relative to the positions in the same row [s].
        rows: name of the torques to be explained, for messages.
        motors, sensors: whether these need the motors' torques, the torques of sensors after the gears; if they need
            sensors and no column is named torque or current, tau_motor is the effort.
    """

    kind: Annotated[str, OneOf(("torque", "current"))] = ""
    names: Annotated[Mapping[str, Name], Checked(_ours)] = field(default_factory=dict)
    columns: Mapping[str, Name] = field(default_factory=dict)
    units: Annotated[Mapping[str, Text], Checked(_known)] = field(default_factory=dict)
    rate: Positive | None = None
    topic: Name = ""
    controller: Name = ""
    external: tuple[Name, ...] = ()
    use_range: Flag = True
    samples: Annotated[int, Whole(10_000, 1_000_000_000)] | None = None
    lag: Annotated[float, Real(least=-MAX_LAG, most=MAX_LAG, unit="s")] = 0.0
    rows: Annotated[str, Hidden()] = "motor"
    motors: Annotated[bool, Hidden()] = True
    sensors: Annotated[bool, Hidden()] = False

    def __post_init__(self) -> None:
        if self.kind not in ("", "torque", "current"):
            raise UsageError(f"kind: expected 'torque' or 'current', found '{self.kind}'")
        with refused_as(UsageError, ValueError, "{}"):
            _ours(self.names)
            _known(self.units)

    def factor(self, name: str) -> float:
        """Return the factor to SI for the unit that the options state for the series `name`; 1 if they state none."""
        unit = self.units.get(name, "")
        counts = encoder_counts(unit)
        if counts is not None:
            return math.tau / counts[0]
        return SCALES[name][unit.lower()] if unit else 1.0

    def zero(self, name: str) -> float:
        """Return the count at zero that the options state for a series in encoder counts; 0 for other units."""
        counts = encoder_counts(self.units.get(name, ""))
        return counts[1] if counts else 0.0


def check_units(name: str, units: Sequence[str], joints: Joints | None, path: str | Path) -> None:
    """Raise MeasurementError for units of a series that do not suit revolute or prismatic joints.

    Args:
        name: name of the series.
        units: unit of each column; "" for SI.
        joints: the robot's joints; None: no check.
        path: the file, for messages.
    """
    if joints is None or len(units) != len(joints.names) or name not in ("q", "v", "q_link", "q_ref"):
        return
    for joint, kind, unit in zip(joints.names, joints.kinds, units):
        turns = unit.lower() in (*TURNED, *COUNT_WORDS) or encoder_counts(unit) is not None
        if unit and turns == (kind == "prismatic"):
            message = f"the unit [{unit}] of {name} does not suit {joint}, a {kind} joint: is it the file's unit?"
            refuse_data(path, message)


def stem_of(name: str) -> tuple[str, int | None]:
    """Return the quantity in a column's name, in lower case, and the last number in the name: (q, 1) for ``J1 q``.

    The number is None if there is none.
    """
    match = _NUMBER.search(name)
    number = None
    if match:
        number = int(match[0])
        name = f"{name[: match.start()]} {name[match.end() :]}"
    parts = [part for part in re.split(r"[\W_]+", name.lower()) if part not in ("", "joint", "j")]
    return "_".join(parts), number


def plain_stems(stems: Sequence[str]) -> dict[str, str]:
    """Return a mapping to each stem from the stem itself and from its form without leading words of `MEASURED`.

    A short form that several stems share is left out.
    """
    short: dict[str, list[str]] = {}
    for stem in stems:
        parts = stem.split("_")
        while len(parts) > 1 and parts[0] in MEASURED:
            parts = parts[1:]
            short.setdefault("_".join(parts), []).append(stem)
    result = {name: full_stems[0] for name, full_stems in short.items() if len(full_stems) == 1}
    return result | {stem: stem for stem in stems}


def find_names(members: tuple[str, ...], options: RecordingOptions, path: Path) -> dict[str, str]:
    """Return a mapping from the toolkit's name of each series in the file to the file's name.

    Args:
        members: names of the columns or arrays in the file.
        options: options for reading the file, which may name series.
        path: the file, for messages.
    """
    members_by_stem: dict[str, str] = {}
    for member in members:
        stem, number = stem_of(member)
        if not number:
            members_by_stem.setdefault(stem, member)
    for name, stem in plain_stems(tuple(members_by_stem)).items():
        members_by_stem[name] = members_by_stem[stem]
    names = {}
    for series, synonyms in SYNONYMS.items():
        if series in options.names:
            member = options.names[series]
            if member not in members:
                message = f"has no '{member}'{suggestion(member, members)}"
                refuse_data(path, f"{message}; found: {', '.join(members)}")
            names[series] = member
            continue
        for synonym in synonyms:
            stem = stem_of(synonym)[0]
            if stem in members_by_stem:
                names[series] = members_by_stem[stem]
                break
    return names


def one_effort(
    names: dict[str, str], options: RecordingOptions, members: tuple[str, ...], path: Path, advice: str = ""
) -> dict[str, str]:
    """Return `names` with either ``torque`` or ``current``; ``tau_link`` becomes the torque if the file has neither.

    Args:
        names: the toolkit's names of series to the file's names.
        options: options for reading the file.
        members: all names in the file, for messages.
        path: the file, for messages.
        advice: what to do where positions or torques are missing; empty: names that share a word with them.
    """
    if "q" not in names:
        expected = ", ".join(SYNONYMS["q"])
        message = f"has no joint positions ({expected}); found: {', '.join(members)}"
        refuse_data(path, message + (advice or _advice(names, members)))
    kinds = [kind for kind in ("torque", "current") if kind in names]
    if not kinds and options.sensors:
        kinds = _two_torques(names, options, members, path)
    if not kinds and "tau_link" in names:
        names["torque"] = names.pop("tau_link")
        kinds = ["torque"]
    if not kinds:
        expected = ", ".join((*SYNONYMS["torque"], *SYNONYMS["current"]))
        message = f"has no torques and no currents ({expected}); found: {', '.join(members)}"
        refuse_data(path, message + (advice or _advice(names, members)))
    kind = options.kind or kinds[0]
    # The options may say that what the file calls a torque is a current.
    if kind not in names:
        names[kind] = names.pop(kinds[0])
    unused = {"torque", "current"} - {kind}
    return {series: name for series, name in names.items() if series not in unused}


def _advice(names: Mapping[str, str], members: Sequence[str]) -> str:
    """Return advice to state the missing series in the options, with columns of the file that share a word with it.

    Args:
        names: the toolkit's names of the series found, to the file's names.
        members: all names in the file.
    """
    stems = []
    for member in members:
        stem = stem_of(member)[0]
        if stem and stem not in names.values():
            stems.append(stem)
    likely = {}
    for series in ("q", "torque", "current"):
        if series in names:
            continue
        series_words: set[str] = set()
        for synonym in SYNONYMS[series]:
            series_words.update(synonym.split("_"))
        series_words -= {"joint", *MEASURED}
        for stem in stems:
            if series_words & set(stem.split("_")):
                likely[series] = stem
                break
    if not likely:
        repeated = [stem for stem in stems if stems.count(stem) > 1]
        candidates = repeated or stems or ["..."]
        likely = {"q": candidates[0], "torque": candidates[-1]}
    example = ", ".join(f'{series} = "{stem}"' for series, stem in likely.items())
    return f". State their names in the options (--options): recording.names = {{ {example} }}"


def _two_torques(names: dict[str, str], options: RecordingOptions, members: tuple[str, ...], path: Path) -> list[str]:
    """Add the motors' torque to `names` as the effort, or the sensors' torque if only that is needed.

    Returns a list with the name of the added series.

    Args:
        names: the toolkit's names of series to the file's names; extended in place.
        options: options for reading the file: whether torques of motors or of sensors are needed.
        members: all names in the file, for messages.
        path: the file, for messages.
    """
    series = "tau_motor" if "tau_motor" in names else "tau_link"
    if "tau_link" not in names or (options.motors and series == "tau_link"):
        torques = "two torques, of motors and of sensors" if options.motors else "torques of sensors"
        message = f"rows '{options.rows}' need {torques} behind the gear"
        expected = f"{', '.join(SYNONYMS['tau_motor'])}; {', '.join(SYNONYMS['tau_link'])}"
        refuse_data(path, f"{message} ({expected}); found: {', '.join(members)}")
    names["torque"] = names[series]
    if series == "tau_motor":
        del names[series]
    return ["torque"]


def joint_order(names: list[str], joints: Joints | None, n: int, path: str | Path) -> tuple[list[int], tuple[str, ...]]:
    """Return the indices of the robot's joints among the file's joints, and their names.

    The file may have more joints than the robot.

    Args:
        names: joint names in the file; empty if it has none.
        joints: the robot's joints; None: the file's order is kept.
        n: number of joint columns in the file.
        path: the file, for messages.
    """
    if names and len(names) != n:
        refuse_data(path, f"joint_names has {len(names)} names for {n} columns: state one per column")
    if joints is None or not names:
        column_names: Sequence[str] = names
        if joints is not None and len(joints.names) == n:
            column_names = joints.names
        return list(range(n)), named(column_names, n)
    missing = [name for name in joints.names if name not in names]
    if missing:
        message = f"has no joint '{missing[0]}'{suggestion(missing[0], names)}; found: {', '.join(names)}"
        refuse_data(path, message)
    return [names.index(name) for name in joints.names], joints.names

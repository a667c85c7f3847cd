"""How recordings call what they hold: the names that are understood, their units, and what a caller may say instead.

Names that are understood (the first of a row that the file has is taken; case and blanks do not matter):

========== =============================================================================================
ours       in an archive, and in a table before the joint's number or name
========== =============================================================================================
t          t, time, times, timestamp, timestamps, stamp; or a rate: frequency, rate, sample_rate, fs [Hz]
q          q, positions, position, pos, joint_positions, qpos
v          v, dq, qd, dot_q, velocities, velocity, vel, joint_velocities, qvel
effort     torque: tau, torque, torques, effort, efforts, joint_torques, measured_torque
           current: i, current, currents, motor_current, actual_current, joint_currents
tau_link   tau_link, tau_l, tau_sensor, link_torque
tau_motor  tau_motor, tau_m, motor_torque
q_link     q_link, link_position
q_ref      q_ref, q_des, q_cmd, q_desired, q_reference, q_command, q_target, position_reference, position_command,
           desired_position, reference_position, target_position
tau_ff     tau_ff, tau_feedforward, torque_feedforward
========== =============================================================================================

FloBaRoID writes times, positions, velocities, torques.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from calib.data.csv_table import nearest
from calib.data.recordings.recording import Joints, named
from calib.errors import MeasurementError, UsageError

SYNONYMS: Mapping[str, tuple[str, ...]] = {
    "t": ("t", "time", "times", "timestamp", "timestamps", "stamp"),
    "q": ("q", "positions", "position", "pos", "joint_positions", "qpos"),
    "v": ("v", "dq", "qd", "dot_q", "velocities", "velocity", "vel", "joint_velocities", "qvel"),
    "torque": ("tau", "torque", "torques", "effort", "efforts", "joint_torques", "measured_torque"),
    "current": ("i", "current", "currents", "motor_current", "actual_current", "joint_currents"),
    "tau_link": ("tau_link", "tau_l", "tau_sensor", "link_torque"),
    "tau_motor": ("tau_motor", "tau_m", "motor_torque"),
    "q_link": ("q_link", "link_position"),
    "q_ref": (
        "q_ref", "q_des", "q_cmd", "q_desired", "q_reference", "q_command", "q_target", "position_reference",
        "position_command", "desired_position", "reference_position", "target_position",
    ),
    "tau_ff": ("tau_ff", "tau_feedforward", "torque_feedforward"),
}  # fmt: skip
RATES = ("frequency", "rate", "sample_rate", "fs")
OWN = ("joint_names", "drive_gain", "use_range")
SCALES = {
    "t": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9},
    "q": {"rad": 1.0, "m": 1.0, "deg": np.pi / 180, "°": np.pi / 180, "mrad": 1e-3, "mm": 1e-3},
    "v": {"rad/s": 1.0, "m/s": 1.0, "deg/s": np.pi / 180, "°/s": np.pi / 180, "mm/s": 1e-3, "rpm": np.pi / 30},
    "torque": {"nm": 1.0, "n·m": 1.0, "n.m": 1.0, "n*m": 1.0, "n m": 1.0, "n": 1.0, "mnm": 1e-3, "knm": 1e3},
    "current": {"a": 1.0, "ma": 1e-3},
}
SCALES |= {name: SCALES["torque"] for name in ("tau_link", "tau_motor", "tau_ff")}
SCALES |= {name: SCALES["q"] for name in ("q_link", "q_ref")}


@dataclass(frozen=True)
class RecordingOptions:
    """How a recording is to be read; the defaults leave everything to the file.

    Attributes:
        kind: ``torque`` or ``current``, where a file has both or calls one the other.
        names: our name (`SYNONYMS`) → the file's.
        units: our name → unit, where the file states none; for SI nothing is needed.
        rate: sampling rate of a file without stamps [Hz].
        topic: of a ROS bag with several topics of joint states.
        use_range: follow the file's own `use_range` where the path has no cut.
        rows: what the torques to be explained are called, for messages.
        motors, sensors: whether they need the motors' torques, those of sensors behind the gears: where they need
            these and no column is called a torque or current, tau_motor is the effort.
    """

    kind: str = ""
    names: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    rate: float | None = None
    topic: str = ""
    use_range: bool = True
    rows: str = "motor"
    motors: bool = True
    sensors: bool = False

    def __post_init__(self) -> None:
        if self.kind not in ("", "torque", "current"):
            raise UsageError(f"kind: expected 'torque' or 'current', found '{self.kind}'")
        for name in (*self.names, *self.units):
            if name not in SYNONYMS:
                ours = ", ".join(SYNONYMS)
                raise UsageError(f"'{name}' is none of our names{nearest(name, tuple(SYNONYMS))}; ours are {ours}")
        for name, unit in self.units.items():
            scale(name, unit)


def scale(name: str, unit: str) -> float:
    """Return the factor from `unit` to SI for one of our names; "" is SI."""
    if not unit:
        return 1.0
    known = SCALES[name]
    if unit.lower() not in known:
        raise UsageError(f"unit '{unit}' of {name} is none of {', '.join(known)}")
    return known[unit.lower()]


def find_names(members: tuple[str, ...], options: RecordingOptions, path: Path) -> dict[str, str]:
    """Return our name → the file's, with either ``torque`` or ``current``; needs positions and one of these two."""
    plain = {member.lower().strip(): member for member in reversed(members)}
    found = {}
    for ours, synonyms in SYNONYMS.items():
        if ours in options.names:
            if options.names[ours] not in members:
                message = f"there is no '{options.names[ours]}'{nearest(options.names[ours], members)}"
                raise MeasurementError(f"{message}; found: {', '.join(members)}", path)
            found[ours] = options.names[ours]
        elif name := next((plain[synonym] for synonym in synonyms if synonym in plain), ""):
            found[ours] = name
    return one_effort(found, options, members, path)


def one_effort(
    found: dict[str, str], options: RecordingOptions, members: tuple[str, ...], path: Path
) -> dict[str, str]:
    """Return `found` with one of ``torque`` and ``current``; sensors behind the gear serve where there is neither."""
    if "q" not in found:
        wanted = ", ".join(SYNONYMS["q"])
        raise MeasurementError(f"has no joint positions ({wanted}); found: {', '.join(members)}", path)
    kinds = [kind for kind in ("torque", "current") if kind in found]
    if not kinds and options.sensors:
        kinds = _two_torques(found, options, members, path)
    if not kinds and "tau_link" in found:
        found["torque"] = found.pop("tau_link")
        kinds = ["torque"]
    if not kinds:
        wanted = ", ".join((*SYNONYMS["torque"], *SYNONYMS["current"]))
        raise MeasurementError(f"has no torques and no currents ({wanted}); found: {', '.join(members)}", path)
    kind = options.kind or kinds[0]
    if kind not in found:  # the options say that what is called a torque is a current
        found[kind] = found.pop(kinds[0])
    return {ours: theirs for ours, theirs in found.items() if ours not in ("torque", "current") or ours == kind}


def _two_torques(found: dict[str, str], options: RecordingOptions, members: tuple[str, ...], path: Path) -> list[str]:
    """Put the motors' torque (or, where the sensors' alone are wanted, theirs) among `found` as the effort."""
    own = "tau_motor" if "tau_motor" in found else "tau_link"
    if "tau_link" not in found or (options.motors and own == "tau_link"):
        what = "two torques, of motors and of sensors" if options.motors else "torques of sensors"
        message = f"rows '{options.rows}' need {what} behind the gear"
        wanted_names = f"{', '.join(SYNONYMS['tau_motor'])}; {', '.join(SYNONYMS['tau_link'])}"
        raise MeasurementError(f"{message} ({wanted_names}); found: {', '.join(members)}", path)
    found["torque"] = found[own]
    if own == "tau_motor":
        del found[own]
    return ["torque"]


def joint_order(names: list[str], joints: Joints | None, n: int, path: str | Path) -> tuple[list[int], tuple[str, ...]]:
    """Return where the robot's joints stand among the file's, and their names; the file may hold more joints."""
    if names and len(names) != n:
        raise MeasurementError(f"joint_names has {len(names)} names for {n} columns", path)
    if joints is None or not names:
        known = joints.names if joints is not None and len(joints.names) == n else names
        return list(range(n)), named(known, n)
    missing = [name for name in joints.names if name not in names]
    if missing:
        message = f"has no joint '{missing[0]}'{nearest(missing[0], names)}; found: {', '.join(names)}"
        raise MeasurementError(message, path)
    return [names.index(name) for name in joints.names], joints.names

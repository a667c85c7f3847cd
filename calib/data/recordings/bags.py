"""Recordings in ROS bags: joint states from MCAP, ROS 2 (sqlite3) and ROS 1 files, without ROS.

Read are, in this order of preference, as the bag has them with torques:

==================================================  ===================================================================
``sensor_msgs/JointState``                          joint_state_broadcaster, franka_ros, most drivers
``control_msgs/DynamicJointState``                  joint_state_broadcaster: ``position``, ``velocity``, ``effort``
                                                    (``torque``, ``current``) among its interfaces
``control_msgs/InterfacesValues``                   state_interfaces_broadcaster, with its ``InterfacesNames`` beside it
``franka_msgs/FrankaRobotState``                    its ``measured_joint_state``, where the bag holds the definition
``control_msgs/JointTrajectoryControllerState``     feedback (or actual) and reference (desired), likewise
==================================================  ===================================================================

Positions, velocities and efforts are taken by joint name; efforts are torques (or currents, where the options say so:
many drivers publish currents under that name). Stamps are those of the headers; where these are all zero, the times
at which the messages were logged. Messages that lack one of the joints (a gripper's own) are left out. A quantity that
is NaN in every message is not provided.

Read by `rosbags` (pure Python, Apache-2.0; its wheels' C parts exist for Linux and macOS), which is
imported when a bag is read (75 ms). Memory grows with the joint states alone, time with their number.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.data.csv_table import Table
from calib.data.recordings.recording import Recording
from calib.data.recordings.recording_options import RecordingOptions
from calib.data.schema import Joints
from calib.errors import MeasurementError, refuse_data, refused_as, require, suggestion
from calib.workers.extras import needing

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore

Message = Any  # as rosbags makes it from the message's definition
JOINT_STATE = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")
FRANKA_STATE = ("franka_msgs/msg/FrankaRobotState",)  # of franka_ros2
DYNAMIC_STATE = ("control_msgs/msg/DynamicJointState", "control_msgs/DynamicJointState")
INTERFACE_VALUES = ("control_msgs/msg/InterfacesValues",)
INTERFACE_NAMES = "control_msgs/msg/InterfacesNames"
TRAJECTORY_STATE = ("control_msgs/msg/JointTrajectoryControllerState", "control_msgs/JointTrajectoryControllerState")
# Accepted types, the preferred ones first.
KINDS = (JOINT_STATE, DYNAMIC_STATE, INTERFACE_VALUES, FRANKA_STATE, TRAJECTORY_STATE)
# Messages of a topic that are read to see which quantities it has.
FIRST_MESSAGES = 20
# Definitions that bags of ROS 2 Humble (sqlite3) leave out: ros-controls/control_msgs, branch humble.
DEFINITIONS = {
    "control_msgs/msg/InterfacesNames": "std_msgs/Header header\nstring[] names\n",
    "control_msgs/msg/InterfacesValues": "std_msgs/Header header\nfloat64[] values\n",
    "control_msgs/msg/InterfaceValue": "string[] interface_names\nfloat64[] values\n",
    "control_msgs/msg/DynamicJointState": (
        "std_msgs/Header header\nstring[] joint_names\ncontrol_msgs/InterfaceValue[] interface_values\n"
    ),
}


@dataclass(frozen=True)
class JointState:
    """A message of any accepted type as a joint state; quantities that it does not contain are empty.

    Attributes:
        stamp: time in the header [ns]; 0 if it is not set.
        name: the joints' names.
        position, velocity, effort: one value per joint.
        reference: reference positions.
        kind: ``current`` where the efforts are stated as currents; else empty.
    """

    stamp: int
    name: tuple[str, ...]
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    reference: np.ndarray
    kind: str = ""


def read_bag(path: Path, joints: Joints | None, options: RecordingOptions) -> Recording:
    """Return the recording of the joint states in a ROS bag; shapes are checked, values are not.

    Args:
        path: the bag, a file or a folder.
        joints: the robot's joints, in whose order columns are put; None: as in the first message.
        options: options for reading the bag: topic, kind of the efforts.
    """
    with opened(path) as reader:
        connections = _with_torques(reader, options.topic, joints, path)
        names, parts, skipped = joint_states(reader, connections, joints, path)
        topics = sorted(f"{connection.topic} ({connection.msgtype})" for connection in reader.connections)
    source = f"{connections[0].topic} ({connections[0].msgtype})"
    notes = []
    if connections[0].msgtype not in JOINT_STATE:
        notes.append(f"read as joint states from {source}")
    for series in ("q", "v", "effort", "reference"):
        if parts[series].size and np.isnan(parts[series]).all():
            parts[series] = np.empty((0, 0))
            notes.append(f"{series} is NaN in every message: not provided")
    for series, quantity in (("q", "positions"), ("effort", "efforts")):
        if not parts[series].size:
            message = f"its joint states on {source} have no {quantity}"
            refuse_data(
                path, f"{message}, and no other topic has: identification needs both; found: {', '.join(topics)}"
            )
    if skipped:
        notes.append(f"{skipped} messages that lack a joint are not used")
    if not parts["header"].any():
        notes.append("message headers have no stamps; the logging times are used, which jitter more")
    stated_kind = "current" if parts["current"].all() else "torque"
    optional = {}
    for field, series in (("v", "v"), ("q_ref", "reference")):
        if parts[series].size:
            optional[field] = parts[series]
    return Recording(
        (parts["stamp"] - parts["stamp"][0]) * 1e-9,
        parts["q"],
        parts["effort"],
        options.kind or stated_kind,
        names,
        **optional,  # ty: ignore[invalid-argument-type]
        file=str(path),
        notes=tuple(notes),
    )


def is_bag(path: Path) -> bool:
    """Return whether a path is a ROS bag: a file by its suffix, a folder by its metadata."""
    return path.suffix in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file()


def bag_table(path: Path) -> Table:
    """Return the joint states in a ROS bag as a table: ``t`` [s], and ``q_``, ``v_`` and ``tau_`` with joints' names.

    Args:
        path: the bag, a file or a folder.
    """
    with opened(path) as reader:
        connections = _with_torques(reader, "", None, path)
        names, parts, skipped = joint_states(reader, connections, None, path)
    header, columns = ["t"], [parts["stamp"] * 1e-9]
    for letters, series in (("q", "q"), ("v", "v"), ("tau", "effort")):
        if parts[series].size and not np.isnan(parts[series]).all():
            header += [f"{letters}_{name}" for name in names]
            columns += list(parts[series].T)
    note = f"read as {len(columns[0])} joint states from {connections[0].topic}; {skipped} lack a joint"
    rows = np.arange(1, len(columns[0]) + 1)
    return Table(str(path), tuple(header), ("",) * len(header), tuple(columns), rows, (note,))


def _with_torques(reader: AnyReader, topic: str, joints: Joints | None, path: Path) -> list[Connection]:
    """Return the connections of the first type of joint states that has torques; of the first type if none has.

    Args:
        reader: reader of the bag.
        topic: the requested topic; empty: any.
        joints: the robot's joints; None: any.
        path: the bag, for messages.
    """
    accepted = {connection.msgtype for connection in reader.connections if topic in ("", connection.topic)}
    option = "in the options (--options): recording.topic = '...'"
    choices = [
        connections_of(reader, kind, topic, path, "joint states", option, "/joint_states")
        for kind in filter(accepted.intersection, KINDS)
    ]
    if not choices:
        any_kind = tuple(chain.from_iterable(KINDS))
        return connections_of(reader, any_kind, topic, path, "joint states", option)
    for connections in choices:
        if _has_torques(reader, connections, joints):
            return connections
    return choices[0]


def _has_torques(reader: AnyReader, connections: list[Connection], joints: Joints | None) -> bool:
    """Return whether one of the first messages with all joints has positions and efforts."""
    interfaces = _interface_names(reader)
    for connection, _, raw in islice(reader.messages(connections=connections), FIRST_MESSAGES):
        state = as_joint_state(reader.deserialize(raw, connection.msgtype), interfaces.get(_namespace(connection), ()))
        has_all = joints is None or set(joints.names) <= set(state.name)
        if has_all and _is_there(state.position) and _is_there(state.effort):
            return True
    return False


def _interface_names(reader: AnyReader) -> dict[str, tuple[str, ...]]:
    """Return the names of state interfaces (``elbow/position``) that a broadcaster states once, by its namespace."""
    names: dict[str, tuple[str, ...]] = {}
    for connection in reader.connections:
        if connection.msgtype != INTERFACE_NAMES:
            continue
        for _, _, raw in reader.messages(connections=[connection]):
            message: Message = reader.deserialize(raw, connection.msgtype)
            names.setdefault(_namespace(connection), tuple(message.names))
    return names


def _namespace(connection: Connection) -> str:
    return connection.topic.rpartition("/")[0]


def _is_there(values: np.ndarray) -> bool:
    return len(values) > 0 and not np.isnan(values).all()


def as_joint_state(message: Message, interfaces: Sequence[str] = ()) -> JointState:
    """Return a message of any accepted type as a joint state.

    Args:
        message: the message.
        interfaces: names of the values of an ``InterfacesValues``, as ``elbow/position``.
    """
    message = getattr(message, "measured_joint_state", message)
    stamp = header_stamp(message)
    empty = np.empty(0)
    values_of: dict[str, dict[str, float]] = {}
    if hasattr(message, "values"):
        for name, value in zip(interfaces, message.values):
            joint, _, interface = name.rpartition("/")
            values_of.setdefault(joint, {})[interface] = value
        return _of_interfaces(stamp, values_of)
    if hasattr(message, "interface_values"):
        for joint, interface in zip(message.joint_names, message.interface_values):
            values_of[joint] = dict(zip(interface.interface_names, interface.values))
        return _of_interfaces(stamp, values_of)
    if hasattr(message, "joint_names"):
        point = _first_point(message, ("feedback", "actual"))
        reference = _first_point(message, ("reference", "desired"))
        effort = np.asarray(point.effort)
        return JointState(
            stamp, tuple(message.joint_names), point.positions, point.velocities, effort, reference.positions
        )
    return JointState(stamp, tuple(message.name), message.position, message.velocity, message.effort, empty)


def _first_point(message: Message, names: Sequence[str]) -> Message:
    """Return the first of a message's points that has positions; the first that there is if none has."""
    points = [getattr(message, name) for name in names if hasattr(message, name)]
    filled = [point for point in points if len(point.positions)]
    return (filled or points)[0]


def _of_interfaces(stamp: int, values_of: Mapping[str, Mapping[str, float]]) -> JointState:
    """Return a joint state from the values of state interfaces.

    Args:
        stamp: time in the header [ns].
        values_of: joint → name of the interface → value.
    """
    joints = [joint for joint, values in values_of.items() if "position" in values]
    series = dict.fromkeys(("position", "velocity", "effort", "torque", "current"), np.empty(0))
    for interface in series:
        column = np.array([values_of[joint].get(interface, np.nan) for joint in joints])
        if _is_there(column):
            series[interface] = column
    kind, effort = "", series["torque"]
    if len(series["effort"]):
        effort = series["effort"]
    elif not len(effort):
        kind, effort = "current", series["current"]
    return JointState(stamp, tuple(joints), series["position"], series["velocity"], effort, np.empty(0), kind)


@contextmanager
def opened(path: Path) -> Iterator[AnyReader]:
    """Yield a reader of a ROS bag; errors of the package `rosbags` become MeasurementError.

    Args:
        path: the bag, a file or a folder.
    """
    with needing("rosbags"):
        from rosbags.highlevel import AnyReader

    damaged = "cannot be read as a ROS bag ({}): was it closed properly?"
    with (
        refused_as(MeasurementError, Exception, damaged, path),
        AnyReader([path], default_typestore=_typestore()) as reader,
    ):
        yield reader


def _typestore() -> Typestore:
    """Return the types of ROS 2, with those of `DEFINITIONS`."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, definition in DEFINITIONS.items():
        store.register(get_types_from_msg(definition, name))
    return store


def connections_of(
    reader: AnyReader, kinds: Sequence[str], topic: str, path: Path, what: str, option: str, usual: str = ""
) -> list[Connection]:
    """Return a bag's connections for one topic with messages of the given types.

    Args:
        reader: reader of the bag.
        kinds: accepted message types.
        topic: the requested topic; if empty, the only topic found, or the `usual` one.
        path: the bag, for messages.
        what, option: description of the topics' content, and the option that selects a topic, for messages.
        usual: topic that is preferred if there are several.

    Raises:
        MeasurementError: there is no such topic, or there are several and none is requested.
    """
    connections = [connection for connection in reader.connections if connection.msgtype in kinds]
    topics = sorted({connection.topic for connection in connections})
    if not topics:
        all_topics = sorted(f"{connection.topic} ({connection.msgtype})" for connection in reader.connections)
        refuse_data(path, f"has no topic of {what} ({', '.join(kinds)}); found: {', '.join(all_topics) or 'none'}")
    chosen = topic
    if not topic:
        chosen = topics[0] if len(topics) == 1 else usual
    if chosen not in topics:
        message = f"{len(topics)} topics have {what}: {', '.join(topics)}; state one ({option})"
        if topic:
            message = f"has no {what} on '{topic}'{suggestion(topic, topics)}; found: {', '.join(topics)}"
        refuse_data(path, message)
    return [connection for connection in connections if connection.topic == chosen]


def joint_states(
    reader: AnyReader, connections: list[Connection], joints: Joints | None, path: Path
) -> tuple[tuple[str, ...], dict[str, np.ndarray], int]:
    """Return the joint names, arrays of time stamps [ns], q, v, effort, reference, and the number of unused messages.

    Args:
        reader: reader of the bag.
        connections: connections of the topic.
        joints: the robot's joints; messages without one of them are not used. None: as in the first message.
        path: the bag, for messages.
    """
    names = joints.names if joints else ()
    order: dict[tuple[str, ...], list[int] | None] = {}
    rows: dict[str, list[object]] = {"header": [], "logged": [], "q": [], "v": [], "effort": [], "reference": []}
    rows["current"] = []
    skipped = 0
    interfaces = _interface_names(reader)
    for connection, logged, raw in reader.messages(connections=connections):
        state = as_joint_state(reader.deserialize(raw, connection.msgtype), interfaces.get(_namespace(connection), ()))
        message_names = state.name
        names = names or message_names
        if message_names not in order:
            has_all = set(names) <= set(message_names)
            order[message_names] = [message_names.index(name) for name in names] if has_all else None
        index = order[message_names]
        if index is None:
            skipped += 1
            continue
        rows["header"].append(state.stamp)
        rows["current"].append(state.kind == "current")
        rows["logged"].append(logged)
        quantities = {"q": state.position, "v": state.velocity, "effort": state.effort, "reference": state.reference}
        for series, values in quantities.items():
            rows[series].append(values[index] if len(values) == len(message_names) else None)
    if not rows["q"]:
        _refuse_joints(names, list(order), path)
    arrays = {series: _stack(values, series, path) for series, values in rows.items()}
    arrays["stamp"] = arrays["header"] if arrays["header"].any() else arrays["logged"]
    return names, arrays, skipped


def header_stamp(message: Message) -> int:
    """Return the time stamp in a message's header [ns]; 0 if it is not set."""
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def _stack(values: list[object], series: str, path: Path) -> np.ndarray:
    """Return a quantity's rows as one array; an empty array if no message contains the quantity.

    Args:
        values: one row per message; None where the message does not contain the quantity.
        series: name of the quantity, for messages.
        path: the bag, for messages.
    """
    missing = [k for k, value in enumerate(values) if value is None]
    if len(missing) == len(values):
        return np.empty((0, 0))
    if missing:
        refuse_data(
            path, f"this message has no {series}, unlike other messages: cut this part out", series, missing[0] + 1
        )
    return np.array(values)


def _refuse_joints(names: Sequence[str], message_names: Sequence[tuple[str, ...]], path: Path) -> None:
    require(message_names, "its topic of joint states has no messages", MeasurementError, path)
    bag_names = sorted(set().union(*message_names))
    fault = "no message with all joints of the robot at once"
    missing = [name for name in names if name not in bag_names]
    if missing:
        fault = f"no joint '{missing[0]}'{suggestion(missing[0], bag_names)}"
    refuse_data(path, f"has {fault}; found: {', '.join(bag_names)}")

"""Recordings in ROS bags: ``sensor_msgs/JointState`` from MCAP, ROS 2 (sqlite3) and ROS 1 files, without ROS.

Positions, velocities and efforts are taken by joint name; efforts are torques (or currents, where the options say so:
many drivers publish currents under that name). Stamps are those of the headers; where these are all zero, the times
at which the messages were logged. Messages that lack one of the joints (a gripper's own) are left out. So bags of
ros2_control's joint_state_broadcaster and of franka_ros are read; of franka_ros2 the ``measured_joint_state`` of
``franka_msgs/FrankaRobotState``, too, where the bag holds the message's definition.

Read by `rosbags` (pure Python, Apache-2.0; its wheels' C parts exist for Linux and macOS), which is
imported when a bag is read (75 ms). Memory grows with the joint states alone, time with their number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.data.recordings.recording import Recording
from calib.data.recordings.recording_options import RecordingOptions
from calib.data.schema import Joints
from calib.errors import MeasurementError, refuse_data, refused_as, require, suggestion
from calib.workers.extras import needing

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

JOINT_STATE = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")
FRANKA_STATE = "franka_msgs/msg/FrankaRobotState"  # of franka_ros2: a joint state, measured_joint_state, among others


def read_bag(path: Path, joints: Joints | None, options: RecordingOptions) -> Recording:
    """Return the recording of the joint states in a ROS bag; shapes are checked, values are not.

    Args:
        path: the bag, a file or a folder.
        joints: the robot's joints, in whose order columns are put; None: as in the first message.
        options: options for reading the bag: topic, kind of the efforts.
    """
    with opened(path) as reader:
        connections = connections_of(
            reader, (*JOINT_STATE, FRANKA_STATE), options.topic, path, "joint states", "topic = '...'", "/joint_states"
        )
        names, parts, skipped = joint_states(reader, connections, joints, path)
    for series, quantity in (("q", "positions"), ("effort", "efforts")):
        require(parts[series].size, f"its joint states have no {quantity}", MeasurementError, path)
    notes = []
    if skipped:
        notes.append(f"{skipped} messages that lack a joint are not used")
    if not parts["header"].any():
        notes.append("message headers have no stamps; the logging times are used, which jitter more")
    return Recording(
        (parts["stamp"] - parts["stamp"][0]) * 1e-9,
        parts["q"],
        parts["effort"],
        options.kind or "torque",
        names,
        v=parts["v"] if parts["v"].size else None,
        file=str(path),
        notes=tuple(notes),
    )


@contextmanager
def opened(path: Path) -> Iterator[AnyReader]:
    """Yield a reader of a ROS bag; errors of the package `rosbags` become MeasurementError.

    Args:
        path: the bag, a file or a folder.
    """
    with needing("rosbags"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

    damaged = "cannot be read as a ROS bag ({}): was it closed properly?"
    with (
        refused_as(MeasurementError, Exception, damaged, path),
        AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader,
    ):
        yield reader


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
    """Return the joint names, arrays of time stamps [ns], q, v and effort, and the number of unused messages.

    Args:
        reader: reader of the bag.
        connections: connections of the topic.
        joints: the robot's joints; messages without one of them are not used. None: as in the first message.
        path: the bag, for messages.
    """
    names = joints.names if joints else ()
    order: dict[tuple[str, ...], list[int] | None] = {}
    rows: dict[str, list[object]] = {"header": [], "logged": [], "q": [], "v": [], "effort": []}
    skipped = 0
    for connection, logged, raw in reader.messages(connections=connections):
        message: Any = reader.deserialize(raw, connection.msgtype)
        message = getattr(message, "measured_joint_state", message)
        message_names = tuple(message.name)
        names = names or message_names
        if message_names not in order:
            has_all = set(names) <= set(message_names)
            order[message_names] = [message_names.index(name) for name in names] if has_all else None
        index = order[message_names]
        if index is None:
            skipped += 1
            continue
        rows["header"].append(header_stamp(message))
        rows["logged"].append(logged)
        for series, values in (("q", message.position), ("v", message.velocity), ("effort", message.effort)):
            rows[series].append(values[index] if len(values) == len(message_names) else None)
    if not rows["q"]:
        _refuse_joints(names, list(order), path)
    arrays = {series: _stack(values, series, path) for series, values in rows.items()}
    arrays["stamp"] = arrays["header"] if arrays["header"].any() else arrays["logged"]
    return names, arrays, skipped


def header_stamp(message: Any) -> int:
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

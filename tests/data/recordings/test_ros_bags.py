"""Bags of ros2_control's broadcasters are read like those of joint states: the topic with torques counts."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calib.data.recordings.recording_files import read_recording
from calib.data.schema import Joints
from calib.errors import MeasurementError

ROBOT = Joints(("a", "b", "c"))
# joints of the messages, in their order: a gripper among them
NAMES = ("finger", "c", "a", "b")
POINT = "trajectory_msgs/JointTrajectoryPoint"
TYPES = {
    "control_msgs/msg/InterfaceValue": "string[] interface_names\nfloat64[] values\n",
    "control_msgs/msg/DynamicJointState": (
        "std_msgs/Header header\nstring[] joint_names\ncontrol_msgs/InterfaceValue[] interface_values\n"
    ),
    "control_msgs/msg/JointTrajectoryControllerState": (
        f"std_msgs/Header header\nstring[] joint_names\n{POINT} reference\n{POINT} feedback\n{POINT} error\n"
    ),
    "control_msgs/msg/InterfacesNames": "std_msgs/Header header\nstring[] names\n",
    "control_msgs/msg/InterfacesValues": "std_msgs/Header header\nfloat64[] values\n",
}


class Bag:
    """A bag in which messages of several types are written by topic."""

    def __init__(self, folder: Path, kind: str) -> None:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.store = get_typestore(Stores.ROS2_HUMBLE)
        for name, definition in TYPES.items():
            self.store.register(get_types_from_msg(definition, name))
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.writer = Writer(folder, version=9, storage_plugin=plugin)
        self.topics = {}

    def write(self, topic: str, kind: str, nanoseconds: int, **fields: object) -> None:
        """Write one message of the type `kind`, whose header has the given time."""
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        message = self.store.types[kind](header=self.header(nanoseconds), **fields)
        self.writer.write(self.topics[topic], nanoseconds, self.store.serialize_cdr(message, kind))

    def header(self, nanoseconds: int):
        time = self.store.types["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))
        return self.store.types["std_msgs/msg/Header"](stamp=time, frame_id="")

    def point(self, positions: np.ndarray, velocities: np.ndarray, effort: np.ndarray):
        duration = self.store.types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
        point = self.store.types["trajectory_msgs/msg/JointTrajectoryPoint"]
        return point(positions, velocities, np.empty(0), effort, duration)


@pytest.fixture
def filled(tmp_path, series) -> Callable[..., Path]:
    """Write 300 samples by a function of (bag, time, q, v, tau), whose columns are those of `NAMES`; return the bag."""

    def _filled(write: Callable[..., None], kind: str = "mcap") -> Path:
        bag = Bag(tmp_path / "bag", kind)
        with bag.writer:
            for k in range(300):
                values = (np.array([0.02, *series[key][k, [2, 0, 1]]]) for key in ("q", "dq", "tau"))
                write(bag, 10**18 + k * 5_000_000, *values)
        return tmp_path / "bag"

    return _filled


def nan_efforts(bag: Bag, time: int, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> None:
    """Write a joint state without efforts and velocities, as a broadcaster does that lacks their interfaces."""
    absent = np.full(4, np.nan)
    bag.write(
        "/joint_states", "sensor_msgs/msg/JointState", time, name=NAMES, position=q, velocity=absent, effort=absent
    )


def dynamic(bag: Bag, time: int, q: np.ndarray, v: np.ndarray, tau: np.ndarray, effort: str = "effort") -> None:
    interface = bag.store.types["control_msgs/msg/InterfaceValue"]
    values = [interface([effort, "position", "velocity"], np.array(row)) for row in zip(tau, q, v)]
    bag.write(
        "/dynamic_joint_states", "control_msgs/msg/DynamicJointState", time, joint_names=NAMES, interface_values=values
    )


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
@pytest.mark.parametrize("effort", ["effort", pytest.param("torque", marks=pytest.mark.slow), "current"])
def test_dynamic_joint_states_have_the_torques(filled, series, kind, effort):
    """Where joint states have NaN efforts, those of the dynamic joint states count; currents are named so."""

    def write(*values) -> None:
        nan_efforts(*values)
        dynamic(*values, effort=effort)

    recording = read_recording(filled(write, kind), ROBOT)
    np.testing.assert_array_equal(recording.q, series["q"][:300])
    np.testing.assert_array_equal(recording.effort, series["tau"][:300])
    assert recording.kind == ("current" if effort == "current" else "torque") and recording.v is not None
    assert "read as joint states from /dynamic_joint_states" in recording.notes[0]


def test_interfaces_values_are_named_by_their_topic(filled, series):
    """Values of the state interfaces' broadcaster are read by the names that it states once."""
    names = [f"{joint}/{interface}" for interface in ("position", "velocity", "effort") for joint in NAMES]

    def write(bag, time, *values) -> None:
        topic = "/state_interfaces_broadcaster"
        if not bag.topics:
            bag.write(f"{topic}/names", "control_msgs/msg/InterfacesNames", time, names=[*names, "gpio/digital"])
        numbers = np.concatenate([*values, [1.0]])
        bag.write(f"{topic}/values", "control_msgs/msg/InterfacesValues", time, values=numbers)

    recording = read_recording(filled(write), ROBOT)
    np.testing.assert_array_equal(recording.q, series["q"][:300])
    np.testing.assert_array_equal(recording.effort, series["tau"][:300])


def test_trajectory_controller_state_has_the_reference(filled, series):
    """A trajectory controller's state gives positions, torques and the reference."""

    def write(bag, time, q, v, tau) -> None:
        feedback, reference = bag.point(q, v, tau), bag.point(q + 0.01, v, np.empty(0))
        name = "control_msgs/msg/JointTrajectoryControllerState"
        points = {"reference": reference, "feedback": feedback, "error": reference}
        bag.write("/arm_controller/controller_state", name, time, joint_names=NAMES, **points)

    recording = read_recording(filled(write), ROBOT)
    np.testing.assert_array_equal(recording.effort, series["tau"][:300])
    np.testing.assert_allclose(recording.q_ref, series["q"][:300] + 0.01)


def test_bag_without_torques_says_where_it_looked(filled):
    """A bag whose efforts are NaN throughout is refused with its topics."""
    with pytest.raises(MeasurementError, match=r"have no efforts, and no other topic has.*found: /joint_states"):
        read_recording(filled(nan_efforts), ROBOT)

"""Files of every kind that is read, damaged in every way: they are read, or refused as such, and stay as they were."""

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import planted_motion as planted
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from option_files import FILES
from strategies import damaged

from calib.data.images.board import Board, read_board, write_board
from calib.data.images.board_print import raster
from calib.data.images.detection import detect
from calib.data.images.images import decode as read_image_of
from calib.data.images.images import read_image
from calib.data.images.lens import Lens, write_lens
from calib.data.images.lens_files import read_lens
from calib.data.images.pixels import Detections, read_corners, write_corners
from calib.data.poses.fit_options import read_options
from calib.data.poses.pose_files import read_measurements
from calib.data.poses.pose_lists import read_poses, read_targets
from calib.data.recordings.recording_files import read_recording
from calib.data.schema import Joints
from calib.errors import CalibError
from calib.geometry.observability import targets_of
from calib.identification import identify_options
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.limits import read_motion_limits
from calib.procedure.excitation.planning import read_waypoints
from calib.procedure.measuring.pose_limits import read_limits
from calib.procedure.session.folder import Session, read_state
from calib.procedure.session.settings import read_settings
from calib.robot import description
from calib.robot.formats import urdf_write
from calib.robot.library import load
from calib.robot.tables import dumps

LENS = Lens("pinhole", np.array([900.0, 900.0, 319.5, 239.5, 0, 0, 0, 0, 0]), (640, 480))

CHECKS = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
FEW = settings(max_examples=8, deadline=None, derandomize=True, suppress_health_check=CHECKS)
MANY = settings(max_examples=400, deadline=None, suppress_health_check=CHECKS)
JOINTS = ("joint1", "joint2", "joint3")


def poses(names: str, seed: int = 0) -> bytes:
    rng = np.random.default_rng(seed)
    rows = [",".join(f"{value:.6g}" for value in rng.uniform(-0.5, 0.5, names.count(",") + 1)) for _ in range(12)]
    return "\n".join([names, *rows, ""]).encode()


def archive(**more: Any) -> bytes:
    stream = io.BytesIO()
    series = {key: value[:400] for key, value in planted.series(0).items()}
    np.savez(stream, **series, joint_names=np.array(JOINTS), use_range=[0, 390], drive_gain=np.ones(3), **more)
    return stream.getvalue()


def log() -> bytes:
    series = {key: value[:400:2] for key, value in planted.series(0).items()}
    table = np.column_stack(list(series.values()))
    head = ",".join(["t", *(f"q{j}" for j in (1, 2, 3)), *(f"tau{j}" for j in (1, 2, 3))])
    return "\n".join([head, *(",".join(f"{x:.7g}" for x in row) for row in table), ""]).encode()


def documented(kind: str, write: Callable[[Any], str] = dumps) -> Callable[[Path], bytes]:
    table = {key: value for key, value in FILES[kind][0].items() if key != "camera"}  # which is a file beside it
    return lambda tmp: write(table).encode()


def in_folder(read: Callable[[Path], Any]) -> Callable[[Path], Any]:
    return lambda path: read(path.parent)


def robot_toml(tmp: Path) -> bytes:
    return description.write(tmp / "made.toml", planted.arm()).read_bytes()


def bag(tmp: Path) -> bytes:
    """Return a bag of joint states, one file of MCAP."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    place = tmp / f"bag{len(list(tmp.glob('bag*')))}"
    store, series = get_typestore(Stores.ROS2_HUMBLE), planted.series(0)
    state, header, stamp = (
        store.types[name]
        for name in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    with Writer(place, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/joint_states", state.__msgtype__, typestore=store)
        for k in range(150):
            time = header(stamp=stamp(sec=k // 100, nanosec=k % 100 * 10_000_000), frame_id="")
            q, tau = (series[key][2 * k].copy() for key in ("q", "tau"))
            message = state(header=time, name=list(JOINTS), position=q, velocity=q, effort=tau)
            writer.write(topic, k * 10_000_000, store.serialize_cdr(message, state.__msgtype__))
    return next(place.glob("*.mcap")).read_bytes()


def picture(tmp: Path) -> bytes:
    image = raster(BOARD, 600.0, 0.01)
    return bytes(cv2.imencode(".png", image)[1].tobytes())


def corner_table(tmp: Path) -> bytes:
    found = detect(read_image_of(picture(tmp)), BOARD)
    return write_corners(tmp / "made_corners.csv", Detections({"a.png": found}, (200, 200))).read_bytes()


def look(path: Path) -> None:
    detect(read_image(path), BOARD)


TURNED = b"q1,q2,q3,x,y,z,qx,qy,qz,qw\n" + b"0.1,0.2,0.3,0.4,0.5,0.6,0,0,0,1\n0.2,0.1,0.3,0.4,0.5,0.6,0,0,0,1\n" * 4


BOARD = Board(columns=5, rows=4, marker=0.02)
ARM = load("ur5")
KINDS: dict[str, tuple[str, Callable[[Path], bytes], Callable[[Path], Any]]] = {
    "positions": ("m.csv", lambda tmp: poses("q1,q2,q3,x,y,z"), lambda path: read_measurements(path, JOINTS)),
    "poses": (
        "m.csv", lambda tmp: TURNED,
        lambda path: read_measurements(path, JOINTS),
    ),
    "sockets": (
        "m.csv", lambda tmp: b"q1,q2,q3,tool_position,socket\n" + b"0.1,0.2,0.3,high,0\n0.2,0.3,0.1,high,1\n" * 4,
        lambda path: read_measurements(path, JOINTS),
    ),
    "plan": ("p.csv", lambda tmp: poses("joint1,joint2,joint3"), lambda path: read_poses(path, JOINTS)),
    "log": ("l.csv", lambda tmp: log(), lambda path: read_recording(path, Joints(JOINTS))),
    "archive": ("l.npz", lambda tmp: archive(), lambda path: read_recording(path, Joints(JOINTS))),
    "fit options": ("o.toml", documented("options"), read_options),
    "identify options": ("o.toml", documented("identify-options"), identify_options.read_options),
    "robot.toml": ("r.toml", robot_toml, lambda path: load(path)),
    "urdf": ("r.urdf", lambda tmp: urdf_write.write_new(ARM).encode(), lambda path: load(path)),
    "trajectory": ("trajectory.toml", documented("trajectory"), in_folder(coefficients.read)),
    "waypoints": (
        "w.csv", lambda tmp: poses("q1,q2,q3,q4,q5,q6"), lambda path: read_waypoints(path, ARM, ARM.lower, ARM.upper),
    ),
    "targets": ("t.csv", lambda tmp: poses("x,y,z,q1,q2,q3"), lambda path: read_targets(path, JOINTS)),
    "session.toml": ("session.toml", documented("session"), read_settings),
    "state.json": (
        "state.json", documented("state", json.dumps), in_folder(lambda folder: read_state(Session(folder, None))),
    ),
    "constraints": ("c.toml", documented("constraints"), lambda path: read_limits(path, targets_of(ARM))),
    "motion limits": ("l.toml", documented("limits"), lambda path: read_motion_limits(path, ARM)),
    "image": ("i.png", picture, look),
    "corners": ("corners.csv", corner_table, lambda path: read_corners(path, BOARD)),
    "board": ("board.toml", lambda tmp: write_board(BOARD, tmp / "made_board.toml").read_bytes(), read_board),
    "camera": (
        "camera.yaml", lambda tmp: write_lens(LENS, tmp / "made.yaml").read_bytes(), read_lens,
    ),
    "bag": ("b.mcap", bag, lambda path: read_recording(path, Joints(JOINTS))),
}  # fmt: skip


_CONTENT: dict[str, bytes] = {}


def _made(kind: str, make: Callable[[Path], bytes], tmp_path: Path) -> bytes:
    if kind not in _CONTENT:
        _CONTENT[kind] = make(tmp_path)
    return _CONTENT[kind]


def read_damaged(kind: str, data: st.DataObject, tmp_path: Path) -> None:
    """Read a damaged file: nothing but an error of the toolkit may come of it."""
    name, make, read = KINDS[kind]
    content = data.draw(damaged(_made(kind, make, tmp_path)))
    path = tmp_path / "here" / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    try:
        read(path)
    except CalibError as error:
        assert 0 < len(str(error)) < 3000
    assert path.read_bytes() == content and [one.name for one in path.parent.iterdir()] == [name]


@pytest.mark.parametrize("kind", KINDS)
@FEW
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused(kind: str, data: st.DataObject, tmp_path: Path) -> None:
    read_damaged(kind, data, tmp_path)


@pytest.mark.parametrize("kind", KINDS)
def test_the_file_itself_is_read(kind: str, tmp_path: Path) -> None:
    name, make, read = KINDS[kind]
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / name).write_bytes(_made(kind, make, tmp_path))
    read(tmp_path / "here" / name)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@MANY
@given(data=st.data())
def test_damaged_files_by_the_hundred(kind: str, data: st.DataObject, tmp_path: Path) -> None:
    read_damaged(kind, data, tmp_path)


ODD_MEMBERS = (
    5, 0.0, "text", True, 1j, [], [np.nan], [[1.0]], np.zeros((6, 6)), np.array(["a", "b", "c"]), np.zeros(3),
    np.array([1, 2], dtype="datetime64[s]"), np.zeros(2, dtype=[("a", float)]), np.full(3, 1e300), -1, 10**18,
)  # fmt: skip


@pytest.mark.parametrize("name", ["t", "q", "tau", "joint_names", "use_range", "drive_gain", "rate", "periods"])
def test_archive_with_odd_member_is_handled(name: str, tmp_path: Path) -> None:
    """An archive with an odd member is read or refused."""
    series = {key: value[:200] for key, value in planted.series(0).items()}
    for odd in ODD_MEMBERS:
        read_odd(series, name, odd, tmp_path)


def read_odd(series: dict[str, np.ndarray], name: str, odd: Any, tmp_path: Path) -> None:
    members: dict[str, Any] = series | {"joint_names": np.array(JOINTS)}
    if name == "rate":
        del members["t"]
    np.savez(tmp_path / "l.npz", **(members | {name: odd, "variance_tau": members["tau"] ** 2}))
    try:
        read_recording(tmp_path / "l.npz", Joints(JOINTS))
    except CalibError as error:
        assert str(error).startswith(str(tmp_path))

"""Hand-eye calibration from poses and from pairs of poses, by a simulation that shares no code with the toolkit."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import DATA
from scipy.spatial.transform import Rotation

import calib
from calib.apps.registration.settings import PlacementSettings
from calib.cli import run
from calib.data.poses.fit_options import CameraOptions, FitOptions
from calib.errors import CalibError, UsageError
from calib.geometry.checks import pose_steps
from calib.geometry.first_guess import place_pose

CASE = DATA / "cases/13_hand_eye_pose_pairs"


def motion(rotation: Rotation, position: np.ndarray | list[float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix()
    matrix[:3, 3] = position
    return matrix


CARRIED = motion(Rotation.from_euler("xyz", [2, -3, 91], degrees=True), [0.03, -0.06, 0.045])
BOARD = motion(Rotation.from_euler("xyz", [-180, 5, 20], degrees=True), [0.55, 0.05, 0.02])
CAMERA = motion(Rotation.from_euler("xyz", [-120, 5, 60], degrees=True), [1.2, -0.6, 0.8])
inv = np.linalg.inv


def sampled(seed: int, count: int = 15, in_hand: bool = True, turns: tuple = (0.45, 0.45, 1.0)) -> tuple:
    """Return poses of the tool in the base, and of the board in the camera with noise of 0.2 mm and 0.5 mrad."""
    rng = np.random.default_rng(seed)
    robot = []
    seen = []
    for _ in range(count):
        turn = Rotation.from_euler("x", np.pi) * Rotation.from_rotvec(rng.normal(size=3) * turns)
        tool = motion(turn, [0.6, 0.05, 0.65] + 0.1 * rng.normal(size=3))
        board = inv(tool @ CARRIED) @ BOARD if in_hand else inv(CAMERA) @ tool @ CARRIED
        noise = Rotation.from_rotvec(5e-4 * rng.normal(size=3)).as_matrix()
        board[:3, :3] = noise @ board[:3, :3]
        board[:3, 3] += 2e-4 * rng.normal(size=3)
        robot.append(tool)
        seen.append(board)
    return np.array(robot), np.array(seen)


def columns(poses: np.ndarray, form: str) -> tuple[np.ndarray, list[str]]:
    turns = Rotation.from_matrix(poses[:, :3, :3])
    forms = {
        "quaternion": (turns.as_quat(), ["qx", "qy", "qz", "qw"]),
        "w first": (np.roll(turns.as_quat(), 1, axis=1), ["qx", "qy", "qz", "qw"]),
        "vector": (turns.as_rotvec(), ["rx", "ry", "rz"]),
        "rvec": (turns.as_rotvec(), ["rvec_x", "rvec_y", "rvec_z"]),
        "kuka": (turns.as_euler("ZYX", degrees=True), ["a", "b", "c"]),
        "zyz": (turns.as_euler("ZYZ", degrees=True), ["rx", "ry", "rz"]),
        "matrix": (turns.as_matrix().reshape(-1, 9), [f"r{i}{j}" for i in "123" for j in "123"]),
    }
    numbers, names = forms[form]
    return np.hstack([poses[:, :3, 3], numbers]), ["x", "y", "z", *names]


def table(path: Path, robot: np.ndarray, seen: np.ndarray, forms=("quaternion", "quaternion"), names="{0}_{1}", mm=1.0):
    first, first_names = columns(robot, forms[0])
    second, second_names = columns(seen, forms[1])
    second[:, :3] *= mm
    header = [names.format("tcp", name) for name in first_names] + [names.format("cam", name) for name in second_names]
    np.savetxt(path, np.hstack([first, second]), delimiter=",", header=",".join(header), comments="")
    return path


def off(frame, truth: np.ndarray) -> np.ndarray:
    """Return position [m] and rotation [rad] by which a frame differs from the truth."""
    turn = Rotation.from_matrix(frame.pose[:3, :3] @ truth[:3, :3].T).as_rotvec()
    return np.concatenate([frame.pose[:3, 3] - truth[:3, 3], turn])


@pytest.mark.slow
@pytest.mark.parametrize("in_hand", [True, False])
def test_sigma_covers_the_errors(tmp_path, in_hand):
    """Errors of camera and board are as large as their σ, for both mountings."""
    scaled = []
    for seed in range(20):
        robot, seen = sampled(seed, in_hand=in_hand)
        fit = calib.hand_eye(None, table(tmp_path / "pairs.csv", robot, seen))
        carried, standing = fit.transforms
        for frame, truth in ((carried, CARRIED), (standing, BOARD if in_hand else CAMERA)):
            scaled.append(off(frame, truth) / frame.sigma)
    assert 0.8 < np.sqrt(np.mean(np.square(scaled))) < 1.25


@pytest.mark.slow
def test_detector_poses_with_joints_are_read_as_their_inverse(tmp_path, capsys):
    """Poses of the board in a camera on the arm are read as their inverse, and weighed as they were measured."""
    arm = calib.load("ur5").chain
    rng = np.random.default_rng(0)
    q = np.array([0.2, -1.3, 1.6, -1.9, -1.5, 0.3]) + 0.35 * rng.normal(size=(14, 6))
    tools = calib.load("ur5").forward(q)
    noise = 2e-4 * rng.normal(size=(14, 3))
    seen = inv(tools @ CARRIED) @ BOARD
    seen[:, :3, 3] += noise
    values, names = columns(seen, "quaternion")
    path = tmp_path / "board.csv"
    np.savetxt(path, np.hstack([q, values]), delimiter=",", header=",".join([*arm.joint_names, *names]), comments="")
    assert run(["hand-eye", "ur5", str(path), "--for", "krl"]) == 0
    lines = capsys.readouterr().out
    assert "no tolerance stated" in lines and "agree as their inverse" in lines
    assert "camera in" in lines and "TOOL_DATA[1]" in lines and "--child-frame-id camera_optical_frame" in lines
    fit = calib.hand_eye("ur5", path)
    carried, standing = fit.transforms
    assert np.abs(off(carried, CARRIED)).max() < 6e-4 and np.abs(off(standing, BOARD)).max() < 6e-4
    # the residual is that of what was measured, not of the camera's position
    assert fit.fit.errors[1].rms < 1.3 * np.sqrt(np.mean(np.sum(noise**2, axis=1)))


@pytest.mark.parametrize(
    ("forms", "names", "mm"),
    [
        (("vector", "rvec"), "{0}_{1}", 1.0),
        (("kuka", "matrix"), "{1}_{0}", 1.0),
        (("zyz", "vector"), "{0}.{1}", 1e3),
        pytest.param(("w first", "quaternion"), "{0}_{1}", 1e2, marks=pytest.mark.slow),
    ],
)
def test_conventions_and_units_are_found_by_what_agrees(tmp_path, forms, names, mm):
    """Conventions of orientations, and units, that a file does not state are those with which the poses agree."""
    robot, seen = sampled(3)
    path = table(tmp_path / "pairs.csv", robot, seen, forms, names, mm)
    carried, standing = calib.hand_eye(None, path).transforms
    assert carried.name == "camera in tool" and standing.name == "board in base"
    assert np.abs(off(carried, CARRIED)[:3]).max() < 5e-4 and np.abs(off(standing, BOARD)[:3]).max() < 5e-4


def as_transform(pose: np.ndarray) -> dict:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    position = dict(zip("xyz", pose[:3, 3].tolist()))
    return {"translation": position, "rotation": {"x": x, "y": y, "z": z, "w": w}}


def easy_handeye(path: Path, robot, seen, in_hand: bool):
    samples = [{"robot": as_transform(a), "optical": as_transform(b)} for a, b in zip(robot, seen)]
    path.write_text(json.dumps({"parameters": {"eye_on_hand": in_hand}, "samples": samples}))


def moveit(path: Path, robot, seen, in_hand: bool):
    lines = []
    for a, b in zip(robot, seen):
        lines += [f"- effector_wrt_world: {a.ravel().tolist()}", f"  object_wrt_sensor: {b.ravel().tolist()}"]
    path.write_text("\n".join(lines))


def opencv(path: Path, robot, seen, in_hand: bool):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    hand = "gripper2base" if in_hand else "base2gripper"
    for name, poses in ((hand, robot), ("target2cam", seen)):
        for part, content in (("R", poses[:, :3, :3]), ("t", poses[:, :3, 3:])):
            storage.startWriteStruct(f"{part}_{name}", cv2.FileNode_SEQ)
            for matrix in content:
                storage.write("", np.ascontiguousarray(matrix))
            storage.endWriteStruct()
    storage.release()


@pytest.mark.parametrize("in_hand", [pytest.param(True, marks=pytest.mark.slow), False])
@pytest.mark.parametrize(
    ("write", "name"),
    [
        (easy_handeye, "s.yaml"),
        (moveit, "s.yaml"),
        (opencv, "s.yml"),
        pytest.param(opencv, "s.xml", marks=pytest.mark.slow),
        pytest.param(opencv, "s.json", marks=pytest.mark.slow),
    ],
)
def test_files_of_other_tools(tmp_path, write, name, in_hand):
    """Samples of easy_handeye, MoveIt and OpenCV are read, also where the robot's poses are stored as their inverse."""
    robot, seen = sampled(4, in_hand=in_hand)
    stored = robot if in_hand or write is moveit else inv(robot)
    write(tmp_path / name, stored, seen, in_hand)
    carried, standing = calib.hand_eye(None, tmp_path / name).transforms
    labels = ("camera in tool", "board in base") if in_hand else ("board in tool", "camera in base")
    assert (carried.name, standing.name) == labels
    truth = BOARD if in_hand else CAMERA
    assert np.abs(off(carried, CARRIED)[:3]).max() < 6e-4 and np.abs(off(standing, truth)[:3]).max() < 6e-4


def park_martin(robot: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return the camera in the tool by Park and Martin (1994), the closed form that OpenCV has, too."""
    normal = np.zeros((3, 3))
    rows = []
    sides = []
    for i, j in zip(range(len(robot) - 1), range(1, len(robot))):
        a = inv(robot[j]) @ robot[i]
        b = seen[j] @ inv(seen[i])
        normal += np.outer(Rotation.from_matrix(b[:3, :3]).as_rotvec(), Rotation.from_matrix(a[:3, :3]).as_rotvec())
        rows.append((a, b))
    values, vectors = np.linalg.eigh(normal.T @ normal)
    rotation = vectors @ np.diag(values**-0.5) @ vectors.T @ normal.T
    for a, b in rows:
        sides.append(rotation @ b[:3, 3] - a[:3, 3])
    matrix = np.concatenate([a[:3, :3] - np.eye(3) for a, _ in rows])
    position = np.linalg.lstsq(matrix, np.concatenate(sides), rcond=None)[0]
    return motion(Rotation.from_matrix(rotation), position)


def test_closed_form_agrees(tmp_path):
    """The closed form of Park and Martin differs by no more than the noise allows."""
    robot, seen = sampled(5)
    fit = calib.hand_eye(None, table(tmp_path / "pairs.csv", robot, seen))
    assert np.abs(off(fit.transforms[0], park_martin(robot, seen))).max() < 1.5e-3


@pytest.mark.slow
def test_camera_turned_halfway_is_named_with_its_row(tmp_path):
    """A camera that was turned by 180° between two rows is named, with the rows."""
    robot, seen = sampled(6, 14)
    turned = CARRIED @ motion(Rotation.from_euler("z", np.pi), np.zeros(3))
    seen[8:] = inv(robot[8:] @ turned) @ BOARD
    fit = calib.hand_eye(None, table(tmp_path / "pairs.csv", robot, seen))
    assert fit.verdict == "fail"
    text = str(fit)
    assert "rows 1–8 and 9–14 agree apart" in text
    assert "what the arm carries was turned by 180°" in text


def small_step(robot: np.ndarray, measured: np.ndarray) -> pose_steps.Step | None:
    return pose_steps.small_step(robot, measured, place_pose(robot, measured))


def turned_later(seed: int, count: int, angle: float, first: int, end: int | None = None) -> tuple:
    """Return poses whose camera was turned by an angle [rad] from the row `first` on, and back at the row `end`."""
    robot, seen = sampled(seed, count)
    turn = motion(Rotation.from_rotvec([0, 0, -angle]), np.zeros(3))
    seen[first:end] = turn @ seen[first:end]
    return robot, inv(seen)


def test_small_turns_are_steps_and_sound_sets_have_none():
    """A turn of 0.6° is a step with its σ; sets without a turn have no step."""
    step = small_step(*turned_later(2, 24, 0.01, 12))
    assert (step.cut, step.part) == (12, "tool")
    assert abs(step.angle - 0.01) < 4 * step.angle_sigma < 2e-3 and step.shift < 4 * step.shift_sigma
    for seed in range(10):
        assert small_step(*turned_later(seed, 15, 0.0, 8)) is None


def test_drift_and_errors_of_the_arm_are_no_steps():
    """A camera that turns slowly, and an arm whose error depends on its pose, are not called steps."""
    for seed in range(5):
        robot, seen = sampled(seed, 24)
        turns = Rotation.from_rotvec(np.linspace(0.0, 0.02, 24)[:, None] * [0.0, 0.0, 1.0]).as_matrix()
        drifted = seen.copy()
        drifted[:, :3] = turns @ seen[:, :3]
        assert small_step(robot, inv(drifted)) is None
        order = np.argsort(robot[:, 0, 3])
        bent = robot[order]
        bent[:, :3, 3] += 0.02 * (bent[:, :3, 3] - bent[:, :3, 3].mean(axis=0))[:, ::-1]
        assert small_step(bent, inv(seen[order])) is None


@pytest.mark.slow
def test_first_of_two_turns_is_named(tmp_path):
    """Of two turns, the first is named with its rows."""
    robot, camera = turned_later(3, 24, np.pi / 2, 8, 16)
    text = str(calib.hand_eye(None, table(tmp_path / "pairs.csv", robot, inv(camera))))
    assert "rows 1–8 and 9–" in text


@pytest.mark.slow
@pytest.mark.parametrize(("lag", "first"), [pytest.param(3, 0, marks=pytest.mark.slow), (-1, 8)])
def test_rows_that_lag_are_named_with_the_first_of_them(tmp_path, lag, first):
    """Camera rows that lag behind the robot's, or lead them, are named with lag and row, whichever the mounting."""
    robot, seen = sampled(10, 24, in_hand=lag > 0)
    lost = range(first, first + abs(lag))
    if lag > 0:
        robot, seen = robot[:-lag], np.delete(seen, lost, axis=0)
    else:
        robot, seen = np.delete(robot, lost, axis=0), seen[:lag]
    fit = calib.hand_eye(None, table(tmp_path / "pairs.csv", robot, seen))
    assert fit.verdict == "fail"
    rows = f"{abs(lag)} row{'s' * (abs(lag) > 1)} further {'down' if lag > 0 else 'up'} from row {first + 1} on"
    assert f"with the robot's poses {rows}" in str(fit)


@pytest.mark.slow
def test_mounting_that_nothing_says_is_asked_for(tmp_path):
    """Poses that agree as they are may be of a board on the arm, or of a camera in the board: it is asked."""
    path = table(tmp_path / "pairs.csv", *sampled(7, in_hand=False))
    fit = calib.hand_eye("ur5", path)
    assert fit.carried == "camera or board" and "State [camera] mounting" in str(fit)
    with pytest.raises(UsageError, match="not known whether"):
        fit.urdf(Path("ur5.urdf"))
    stated = calib.hand_eye("ur5", path, options=FitOptions(camera=CameraOptions("to hand")))
    assert stated.carried == "board"


def test_too_few_pairs_are_refused(tmp_path):
    """Two pairs determine nothing; three agree both ways."""
    robot, seen = sampled(1, 3)
    for count, words in ((2, "need at least 3"), (3, "agree both as they are")):
        with pytest.raises(CalibError, match=words):
            calib.hand_eye(None, table(tmp_path / "pairs.csv", robot[:count], seen[:count]))


@pytest.mark.slow
def test_failed_frames_are_not_for_use(tmp_path, capsys):
    """With the verdict fail no frame is written for a controller or into a URDF; the verdict states an error once."""
    robot, seen = sampled(6, 14)
    path = table(tmp_path / "pairs.csv", robot, seen[np.random.default_rng(0).permutation(14)])
    urdf = tmp_path / "with_camera.urdf"
    options = tmp_path / "options.toml"
    options.write_text('[camera]\nmounting = "in hand"')
    command = ["hand-eye", "ur5", str(path), "--for", "krl", "--urdf", str(urdf), "--options", str(options)]
    assert run(command) == 1
    text = capsys.readouterr().out
    assert "no frames are printed or written for use: the verdict is fail" in text
    assert "KUKA" not in text and not urdf.exists() and "nominal" not in text
    with pytest.raises(UsageError, match="the verdict is fail"):
        calib.hand_eye(None, path).urdf()
    table(path, robot[:1], seen[:1])
    assert run(["hand-eye", str(path)]) == 2 and "1 pair of poses" in capsys.readouterr().err


@pytest.mark.slow
def test_turns_about_one_axis_leave_positions_open(tmp_path, capsys):
    """With turns about one axis only, positions are not identifiable, and no frame is offered for use."""
    path = table(tmp_path / "pairs.csv", *sampled(8, turns=(0.0, 0.0, 1.0)))
    assert run(["hand-eye", str(path), "--for", "krl"]) == 3
    text = capsys.readouterr().out
    assert "x y z not identifiable, not identifiable, not identifiable mm" in text and "KUKA" not in text
    fit = calib.hand_eye(None, path)
    assert "about one axis only" in str(fit) and "URDF:" not in str(fit)
    for frame in fit.transforms:
        assert np.isnan(frame.sigma[:3]).all()


@pytest.mark.slow
def test_pass_prints_no_error_above_the_tolerance(tmp_path):
    """Held-out poses within the tolerance do not make a pass of fitted poses above it."""
    robot, seen = sampled(8, 36)
    seen[:, :3, 3] += 2e-3 * np.random.default_rng(9).normal(size=(36, 3))
    path = table(tmp_path / "pairs.csv", robot, seen)
    fit = calib.hand_eye(None, path, PlacementSettings(holdout=0.25))
    fitted = fit.fit.errors[1].rms
    (held_out,) = [comparison.errors[1].rms for comparison in fit.validation.values()]
    assert held_out < fitted
    tolerance = 0.5 * (held_out + fitted)
    judged = calib.hand_eye(None, path, PlacementSettings(holdout=0.25, tolerance=tolerance))
    assert judged.verdict == "marginal" and "rms on the fitted poses, above the tolerance" in str(judged)


@pytest.mark.slow
def test_result_is_written_into_a_urdf(tmp_path, capsys):
    """The URDF with camera and board has both frames where the result says."""
    source = tmp_path / "arm.urdf"
    source.write_text(
        '<robot name="a"><link name="base"/><link name="tool0"/><joint name="j" type="revolute"><parent link="base"/>'
        '<child link="tool0"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>'
    )
    path = table(tmp_path / "pairs.csv", *sampled(2))
    out = tmp_path / "out.urdf"
    assert run(["hand-eye", str(source), str(path), "--urdf", str(out)]) == 0
    assert "links camera_optical_frame, board" in capsys.readouterr().out
    (camera, _) = calib.hand_eye(source, path).transforms
    chain = calib.load(out, tip="camera_optical_frame")
    assert np.abs(chain.forward(np.zeros((1, 1)))[0] - camera.pose).max() < 1e-6


@pytest.mark.skipif(not CASE.is_dir(), reason=f"no data: {CASE}")
@pytest.mark.parametrize(
    "name", ["pairs.csv", "samples.yaml", pytest.param("joints_cam_in_board.csv", marks=pytest.mark.slow)]
)
def test_reported_case(name):
    """The public reports' pairs give the camera at 30, -60, 45 mm."""
    carried, _ = calib.hand_eye(CASE / "arm.urdf", CASE / name).transforms
    assert 1e3 * carried.pose[:3, 3] == pytest.approx([30.0, -60.0, 45.0], abs=0.6)


def test_other_commands_name_pairs(tmp_path):
    """A fit refuses pairs of poses by naming the command that takes them; hand-eye without files says what it needs."""
    path = table(tmp_path / "pairs.csv", *sampled(0))
    with pytest.raises(CalibError, match=r"15 pairs of poses .* and no joints: calib hand-eye"):
        calib.tool("ur5", path)
    with pytest.raises(UsageError, match="a robot and measured poses are needed"):
        calib.hand_eye("ur5")

"""A base frame measured beside the target takes the instrument out of the measurement, and its noise comes in."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.data.poses.base_frame import relative_to_base
from calib.data.poses.fit_options import FileOptions
from calib.data.poses.measurements import Poses
from calib.data.poses.pose_files import read_measurements
from calib.errors import MeasurementError
from calib.transforms import from_quaternion, invert, to_quaternion


def random_poses(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return from_quaternion(rng.uniform(-2, 2, (count, 3)), Rotation.random(count, rng=rng).as_quat())


NAMES = ["x", "y", "z", "qx", "qy", "qz", "qw"]


def write(path, seen: np.ndarray, base: np.ndarray) -> None:
    q = np.random.default_rng(0).uniform(-1, 1, (len(seen), 2))
    rows = np.hstack([q, seen[:, :3, 3], to_quaternion(seen), base[:, :3, 3], to_quaternion(base)])
    head = ["q1", "q2", *NAMES, *(f"base_{name}" for name in NAMES)]
    lines = [",".join(head), *(",".join(repr(float(value)) for value in row) for row in rows)]
    path.write_text("\n".join(lines))


def test_instrument_may_move_between_rows(tmp_path):
    """The instrument may move between rows."""
    seen, base, moves = random_poses(8, 1), random_poses(1, 2)[0], random_poses(8, 3)
    write(tmp_path / "still.csv", seen, np.broadcast_to(base, seen.shape))
    write(tmp_path / "moved.csv", moves @ seen, moves @ base)
    still, moved = (read_measurements(tmp_path / f"{name}.csv", ("a", "b"))[0] for name in ("still", "moved"))
    expected = invert(base) @ seen
    np.testing.assert_allclose(still.position, expected[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(moved.position, still.position, atol=1e-12)
    np.testing.assert_allclose(moved.quaternion, still.quaternion, atol=1e-12)
    assert not [name for name in moved.ignored if name.startswith("base_")]


def test_sigmas_hold_noise_of_both_frames():
    """Stated sigmas hold the noise of both frames."""
    seen, base = random_poses(1, 4)[0], random_poses(1, 5)[0]
    rng, sigma, sigma_rotation, count = np.random.default_rng(6), 1e-4, 3e-4, 4000

    def noisy(pose: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(rng.normal(0, sigma_rotation, (count, 3))).as_matrix()
        result = np.tile(pose, (count, 1, 1))
        result[:, :3, :3] = turn @ pose[:3, :3]
        result[:, :3, 3] += rng.normal(0, sigma, (count, 3))
        return result

    tool, frame = noisy(seen), noisy(base)
    block = Poses(
        np.zeros((count, 1)), ("a",), tool[:, :3, 3], to_quaternion(tool), 
        sigma=np.full((count, 3), sigma), sigma_rotation=np.full((count, 3), sigma_rotation),
    )  # fmt: skip
    found = relative_to_base(block, frame[:, :3, 3], to_quaternion(frame))
    truth = invert(base) @ seen
    ratio = (found.position - truth[:3, 3]).std(axis=0) / found.sigma.mean(axis=0)
    assert np.abs(ratio - 1).max() < 0.05
    error = (Rotation.from_quat(found.quaternion) * Rotation.from_matrix(truth[:3, :3]).inv()).as_rotvec()
    assert np.abs(error.std(axis=0) / found.sigma_rotation.mean(axis=0) - 1).max() < 0.05


def rows_of(tmp_path, count: int = 12) -> tuple:
    """Write a good file; return its path, its columns and its rows as texts."""
    seen, base, moves = random_poses(count, 7), random_poses(1, 8)[0], random_poses(count, 9)
    path = tmp_path / "series.csv"
    write(path, moves @ seen, moves @ base)
    head, *lines = path.read_text().splitlines()
    return path, head.split(","), [line.split(",") for line in lines]


def save(path, head: list[str], rows: list[list[str]]):
    path.write_text("\n".join(",".join(row) for row in [head, *rows]))
    return path


def read(path, **options) -> Poses:
    (block,) = read_measurements(path, ("a", "b"), FileOptions(**options))
    assert isinstance(block, Poses)
    return block


def test_rows_without_base_frame_are_named(tmp_path):
    """Rows in which the base frame is empty or nan are left out, and named."""
    path, head, rows = rows_of(tmp_path)
    rows[2][-7:] = [""] * 7
    rows[11][-7:] = ["nan"] * 7
    block = read(save(path, head, rows))
    assert list(block.rows) == [1, 2, *range(4, 12)]
    assert "base frame not measured in 2 of 12 rows, which are left out: 3, 12" in block.notes
    assert len(read(path, base_frame="ignored")) == 12


def test_ignored_base_frame_changes_nothing(tmp_path):
    """Ignored columns of a base frame leave the measurement as if they were not there."""
    path, head, rows = rows_of(tmp_path)
    ignored = read(path, base_frame="ignored")
    assert {"base_x", "base_qw"} <= set(ignored.ignored)
    alone = read(save(path, head[:-7], [row[:-7] for row in rows]))
    np.testing.assert_array_equal(ignored.position, alone.position)
    assert alone.base is None and not alone.notes
    with pytest.raises(MeasurementError, match=r"has no base frame: columns base_x, .*not in a file apart"):
        read(path, base_frame="measured")


def test_sigmas_of_base_frame_count(tmp_path):
    """Sigmas of the base frame's own columns replace those of the target."""
    path, head, rows = rows_of(tmp_path)
    names = [f"{name}{axis}" for name in ("sigma_", "sigma_r", "base_sigma_", "base_sigma_r") for axis in "xyz"]
    values = [*["1e-4"] * 3, *["1e-3"] * 3, *["2e-4"] * 3, *["3e-3"] * 3]
    block = read(save(path, [*head, *names], [[*row, *values] for row in rows]))
    squares = block.position**2
    across = squares.sum(axis=1, keepdims=True) - squares
    np.testing.assert_allclose(block.sigma**2, 5e-8 + 9e-6 * across, rtol=1e-9)
    np.testing.assert_allclose(block.sigma_rotation**2, 1e-5, rtol=1e-9)
    np.testing.assert_allclose(block.base_sigma, np.tile([2e-4] * 3 + [3e-3] * 3, (12, 1)))
    assert "positions are relative to the base frame measured with each row" in block.notes


def test_base_frame_by_matrix_is_the_same(tmp_path):
    path, head, rows = rows_of(tmp_path)
    expected = read(path)
    names = [f"base_r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
    matrices = [Rotation.from_quat([float(cell) for cell in row[-4:]]).as_matrix().ravel() for row in rows]
    rows = [[*row[:-4], *map(repr, map(float, matrix))] for row, matrix in zip(rows, matrices)]
    block = read(save(path, [*head[:-4], *names], rows))
    np.testing.assert_allclose(block.position, expected.position, atol=1e-12)


def shorter(head, rows):
    for row in rows[-4:]:
        row[-7:] = [""] * 7


def longer(head, rows):
    rows += [["", "", *[""] * 7, *row[-7:]] for row in rows[:3]]


def partly(head, rows):
    rows[4][-2] = ""


def absent(head, rows):
    for row in rows:
        row[-7:] = [""] * 7


def another_clock(head, rows):
    head += ["time", "base_time"]
    for k, row in enumerate(rows):
        row += [str(10.0 * k), str(10.0 * k + 7.0 * (k > 4))]


def millimetres(head, rows):
    for row in rows:
        row[-7:-4] = [str(1e3 * float(cell)) for cell in row[-7:-4]]


def apart(head, rows):
    head[:] = head[-7:]
    rows[:] = [row[-7:] for row in rows]


def without_orientation(head, rows):
    head[:] = head[:-4]
    rows[:] = [row[:-4] for row in rows]


@pytest.mark.parametrize(
    ("spoil", "row", "words"),
    [
        (shorter, 9, "ends 4 rows before the target: were base frames recorded at other rows.*read with its target"),
        (longer, 13, "has a base frame and no joint values: were base frames recorded at other rows"),
        (partly, 5, "is empty, unlike others of the base frame"),
        (absent, None, "the base frame was measured in no row"),
        (another_clock, 6, "was measured at 57 s, the target at 50 s.*another clock.*its target's time"),
        (millimetres, 1, r"if it is in mm, name the column 'base_x \[mm\]'"),
        (apart, None, "contains base frames .* and no target.*into the same rows"),
        (without_orientation, None, "the base frame is incomplete: it needs base_x"),
    ],
)
def test_bad_base_frames_are_refused(tmp_path, spoil, row, words):
    path, head, rows = rows_of(tmp_path)
    spoil(head, rows)
    with pytest.raises(MeasurementError, match=words) as error:
        read(save(path, head, rows))
    assert error.value.row == row

"""A base frame measured beside the target takes the instrument out of the measurement, and its noise comes in."""

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.poses.base_frame import relative_to_base
from calib.data.poses.measurements import Poses
from calib.data.poses.pose_files import read_measurements
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

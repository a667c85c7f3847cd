"""A file with rows in two conventions is named with the rows of each; a sound file is not remarked upon."""

from dataclasses import replace

import numpy as np
import pytest
from planted import cell, load, perturb, random_joints
from scipy.spatial.transform import Rotation

import calib
from calib.data.poses.measurements import PoseMeasurements, Poses
from calib.data.poses.plausible import from_angles, to_angles
from calib.geometry.checks.mixed_rows import mixed_orientations
from calib.geometry.checks.pose_direction import parted_set_up
from calib.geometry.diagnosis import wrong_columns
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import see
from calib.transforms import from_xyz_rpy, to_quaternion
from calib.units import DEG

ROWS, CUT = 40, 22


def poses(seed: int = 1, euler: str = "") -> Poses:
    """Return measured poses of an arm with planted errors."""
    truth = cell(perturb(load("ur5"), seed, 0.5e-3, 1e-3), seed)
    q = random_joints(truth.chain, ROWS, seed)
    seen = see(truth, q).poses()
    block = PoseMeasurements.of(
        q, seen[:, :3, 3], to_quaternion(seen), joint_names=truth.chain.joint_names, file="day.csv"
    )
    return replace(block, euler=euler)


def found(block: Poses):
    return mixed_orientations(install(load("ur5"), [block]), [block])


def reordered(quaternion: np.ndarray) -> np.ndarray:
    return quaternion[:, [3, 0, 1, 2]]


def inverted(quaternion: np.ndarray) -> np.ndarray:
    return quaternion * [1, 1, 1, -1]


@pytest.mark.parametrize(("change", "reading"), [(reordered, "w x y z"), (inverted, "inverse")])
@pytest.mark.parametrize("later", [np.arange(ROWS) >= CUT, np.arange(ROWS) < CUT, np.arange(ROWS) % 2 == 1])
def test_two_readings_of_quaternions_are_named_with_their_rows(change, reading, later):
    """Half of the rows, or every other one, holds the quaternion in another order, or inverted."""
    block = poses()
    quaternion = np.where(later[:, None], change(np.asarray(block.quaternion)), block.quaternion)
    (finding,) = found(replace(block, quaternion=quaternion))
    values = finding.values
    parts = {values[f"{part}_reading"]: values[f"{part}_rows"] for part in ("first", "second")}
    (text,) = (parts[name] for name in parts if reading in name)
    rows = set()
    for run in text:
        first, _, last = run.partition("–")
        rows |= set(range(int(first), int(last or first) + 1))
    assert rows == set((np.flatnonzero(later) + 1).tolist())


@pytest.mark.parametrize("other", ["xyz fixed", "vector", "rad"])
def test_two_readings_of_angles_are_named(other):
    """A second half by another convention, or in another unit, is named whatever the convention stated."""
    block = poses(euler="zyx moving")
    turns = Rotation.from_quat(block.quaternion)
    if other == "rad":
        mixed = from_angles(to_angles(turns, "zyx moving") * DEG, "zyx moving")
    else:
        mixed = from_angles(to_angles(turns, other), "zyx moving")
    quaternion = np.concatenate([block.quaternion[:CUT], mixed.as_quat()[CUT:]])
    (finding,) = found(replace(block, quaternion=quaternion))
    assert finding.values["start"] == CUT + 1 and other in finding.values["second_reading"]
    assert finding.values["first_rows"][0] == f"1–{CUT}"


@pytest.mark.parametrize("seed", range(3))
def test_one_reading_is_not_remarked_upon(seed):
    """Rows in one reading are no finding, whether it is the stated one or another, nor are random orientations."""
    block = poses(seed, "zyx moving")
    assert found(block) == []
    wrong = from_angles(to_angles(Rotation.from_quat(block.quaternion), "xyz fixed"), "zyx moving")
    assert found(replace(block, quaternion=wrong.as_quat())) == []
    assert found(replace(block, quaternion=Rotation.random(ROWS, random_state=seed).as_quat())) == []


@pytest.mark.parametrize(
    ("of_joints", "factor", "early"),
    [
        (False, 1e-3, True),
        pytest.param(False, 1 / 25.4, False, marks=pytest.mark.slow),
        pytest.param(True, DEG, False, marks=pytest.mark.slow),
    ],
)
def test_rows_in_another_unit_are_named(of_joints, factor, early):
    """Rows of a smaller unit among those of a larger one are named with the factor."""
    block = poses()
    part = (np.arange(ROWS) < CUT) == early
    scale = np.where(part, factor, 1.0)[:, None]
    if of_joints:
        block = replace(block, q=block.q * scale)
    else:
        block = replace(block, position=block.position * scale)
    nominal = polish_frames(install(load("ur5"), [block]), [block]).cell
    explanation = wrong_columns(nominal, [block])
    finding = explanation.finding(nominal.chain.joint_names, rms=0.0, before=1.0, times=9.0)
    assert finding.code == "units-mixed" and finding.values["factor"] == pytest.approx(1 / factor)
    rows = (1, CUT) if early else (CUT + 1, ROWS)
    assert (finding.values["first"], finding.values["last"]) == rows


def test_positions_in_another_frame_from_a_row_on_are_named():
    """Positions alone tell a moved instrument with its row; without a move nothing is said."""
    block = poses()
    move = from_xyz_rpy([0.2, 0.1, 0.0], [0.1, 0.2, 0.5])
    later = block.position[CUT:] @ move[:3, :3].T + move[:3, 3]
    position = np.concatenate([block.position[:CUT], later])
    moved = PoseMeasurements.of(block.q, position, joint_names=block.joint_names, file="day.csv")
    (finding,) = parted_set_up(load("ur5"), moved)
    assert (finding.values["last"], finding.values["next"]) == (CUT, CUT + 1)
    assert finding.values["changed"] == "what stands beside the arm"
    assert parted_set_up(load("ur5"), replace(moved, position=block.position)) == []


@pytest.mark.slow
def test_a_fit_names_rows_in_another_unit():
    """A fit of positions whose later rows are in mm, read as m, says so and fails."""
    block = poses()
    scale = np.where(np.arange(ROWS) < CUT, 1.0, 1e-3)[:, None]
    fit = calib.fit_geometry("ur5", replace(block, position=block.position * scale))
    codes = [note.code for note in fit.outcome.findings.noticed]
    assert "units-mixed" in codes and fit.verdict.level == "fail"

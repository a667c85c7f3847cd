"""How pairs of poses are meant: convention of the orientations, and direction of the poses, found by what agrees.

Poses A_i of the robot's tool in its base and B_i of a board in a camera belong together by constant placements:

    camera in hand   B_i⁻¹ = S A_i X    S: base in board, X: camera in tool
    camera beside    B_i   = S A_i X    S: base in camera, X: board in tool

so that |log(R_Aᵢᵀ R_Aⱼ)| = |log(R_Bᵢᵀ R_Bⱼ)| for any two samples, whatever the placements and directions. Conventions
are compared by these angles first; those that agree are placed (Shah 2013) and compared by the misfit of whole poses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import refuse_data
from calib.records import evenly
from calib.toolkit.installations import direction, median_misfit
from calib.toolkit.pose_pairs import PoseList, PosePairs, poses_of
from calib.transforms import invert
from calib.units import DEG, LENGTHS

# Largest number of samples by which readings are compared.
MAX_ROWS = 60
# Fewest samples that tell open conventions apart.
MIN_ROWS = 5
# Largest difference of relative rotations [rad], and largest ratio to the smallest, of readings that are placed.
MAX_GAP = 1.0 * DEG
GAP_RATIO = 3.0
# Largest number of readings that are placed.
MAX_PLACED = 24
# Smallest ratio of misfits at which the better of two readings is taken.
CLEAR_RATIO = 2.5
# Units in which lengths may be meant.
UNITS = ("m", "cm", "mm", "in")
# Difference of orientations [rad] below which two readings are one.
SAME = 1e-6


@dataclass(frozen=True, eq=False)
class Reading:
    """One reading of pairs of poses.

    Attributes:
        robot, camera: (m, 4, 4) poses of the robot and of what was camera.
        conventions: conventions of both orientations; empty where there is nothing to choose.
        misfit: median misfit, angles included [m].
    """

    robot: np.ndarray
    camera: np.ndarray
    conventions: tuple[str, str]
    misfit: float

    def equals(self, reading: Reading) -> bool:
        """Return whether two readings are one, in other words."""
        same_robot = np.abs(self.robot - reading.robot).max() < SAME
        same_camera = np.abs(self.camera - reading.camera).max() < SAME
        return bool(same_robot and same_camera)


def agreed(pairs: PosePairs) -> tuple[Reading, list[str]]:
    """Return the reading of pairs of poses in which they agree, and notes on what was not stated.

    Args:
        pairs: m pairs of poses.

    Raises:
        MeasurementError: several conventions agree about as well, and the file states none.
    """
    robot_position, robot_note = pairs.robot.metres()
    camera_position, camera_note = pairs.camera.metres()
    best = _best_reading(pairs, robot_position, camera_position)
    if not pairs.camera.length_unit and len(pairs) >= MIN_ROWS and not direction(best.robot, best.camera).agrees:
        for unit in UNITS:
            reading = _best_reading(pairs, robot_position, pairs.camera.position * LENGTHS[unit])
            agreement = direction(reading.robot, reading.camera)
            if agreement.agrees and agreement.is_inverse is not None:
                best = reading
                reason = "with which the poses agree (no unit is stated)"
                camera_note = f"{pairs.camera.title}: the lengths are read as {unit}, {reason}"
                break
    notes = list(filter(None, (robot_note, camera_note)))
    for poses, convention in zip((pairs.robot, pairs.camera), best.conventions):
        if convention and convention != poses.convention:
            note = f"{poses.title}: the orientation is read as {convention}, with which the poses agree"
            if poses.convention:
                note += f" ({poses.convention} is stated)"
            notes.append(note)
    return best, notes


def _best_reading(pairs: PosePairs, robot_position: np.ndarray, camera_position: np.ndarray) -> Reading:
    """Return the reading of the orientations in which poses agree; the stated one unless another agrees clearly better.

    Args:
        pairs: m pairs of poses.
        robot_position, camera_position: (m, 3) their positions [m].
    """
    rows = evenly(len(pairs), MAX_ROWS)
    robot_turns = dict(pairs.robot.readings())
    camera_turns = dict(pairs.camera.readings())
    choices = list(_choices(robot_turns, camera_turns, rows))
    smallest = min(gap for gap, _ in choices)
    limit = max(MAX_GAP, GAP_RATIO * smallest)
    likely = sorted((choice for choice in choices if choice[0] <= limit), key=lambda choice: choice[0])
    readings = []
    for _, names in dict.fromkeys([choices[0], *likely[:MAX_PLACED]]):
        robot = poses_of(robot_position, robot_turns[names[0]])
        camera = poses_of(camera_position, camera_turns[names[1]])
        readings.append(_placed(robot, camera, names, rows))
    stated_reading = readings[0]
    readings.sort(key=lambda reading: reading.misfit)
    best = readings[0]
    has_conventions = _states(pairs.robot) and _states(pairs.camera)
    if has_conventions and stated_reading.misfit <= CLEAR_RATIO * best.misfit:
        return stated_reading
    if has_conventions:
        return best
    for reading in readings[1:]:
        if not reading.equals(best):
            _check_clear(pairs, best, reading)
            break
    return best


def _states(poses: PoseList) -> bool:
    """Return whether nothing is open in how an orientation is read; matrices are row by row unless that disagrees."""
    return bool(poses.convention) or poses.kind == "matrix"


def _choices(
    robot: dict[str, np.ndarray], camera: dict[str, np.ndarray], rows: np.ndarray
) -> Iterator[tuple[float, tuple[str, str]]]:
    """Yield for each choice of conventions the median difference of relative rotations [rad], and the conventions."""
    robot_angles = {name: _relative_angles(turns[rows]) for name, turns in robot.items()}
    camera_angles = {name: _relative_angles(turns[rows]) for name, turns in camera.items()}
    for robot_name, camera_name in product(robot_angles, camera_angles):
        difference = np.abs(robot_angles[robot_name] - camera_angles[camera_name])
        yield float(np.median(difference)), (robot_name, camera_name)


def _relative_angles(turns: np.ndarray) -> np.ndarray:
    """Return the angles [rad] between each orientation of (m, 3, 3) and the next two; the last two wrap around."""
    angles = []
    for step in (1, 2):
        following = np.roll(turns, -step, axis=0)
        relative = np.einsum("mji,mjk->mik", turns, following)
        angles.append(Rotation.from_matrix(relative).magnitude())
    return np.concatenate(angles)


def _placed(robot: np.ndarray, camera: np.ndarray, names: tuple[str, str], rows: np.ndarray) -> Reading:
    """Return a reading with its misfit in the direction of the poses camera in which they agree better."""
    direct = median_misfit(robot[rows], camera[rows])
    inverse = median_misfit(robot[rows], invert(camera[rows]))
    return Reading(robot, camera, names, min(direct, inverse))


def _check_clear(pairs: PosePairs, best: Reading, second: Reading) -> None:
    """Raise MeasurementError if two readings agree about as well, or if there are too few samples to choose."""
    if len(pairs) >= MIN_ROWS and second.misfit > CLEAR_RATIO * best.misfit:
        return
    texts = []
    for reading in (best, second):
        robot_convention, camera_convention = reading.conventions
        names = f"{pairs.robot.title} {robot_convention} and {pairs.camera.title} {camera_convention}"
        texts.append(f"{names} ({1e3 * reading.misfit:.3g} mm)")
    refuse_data(
        pairs.file,
        f"the file does not say how its orientations are meant, and {len(pairs)} pairs agree about as well as "
        f"{texts[0]} or as {texts[1]}: state the convention in the options (euler = 'vector', 'zyx moving' …), or give "
        "quaternions",
    )

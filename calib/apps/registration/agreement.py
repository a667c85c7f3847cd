"""How pairs of poses are meant: convention of the orientations, and direction of the poses, found by what agrees.

Poses A_i of the robot's tool in its base and B_i of a board in a camera belong together by constant placements:

    camera in hand   B_i⁻¹ = S A_i X    S: base in board, X: camera in tool
    camera beside    B_i   = S A_i X    S: base in camera, X: board in tool

so that |log(R_Aᵢᵀ R_Aⱼ)| = |log(R_Bᵢᵀ R_Bⱼ)| for any two samples, whatever the placements and directions. Conventions
are compared by these angles first; those that agree are placed (Shah 2013) and compared by the misfit of whole poses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import refuse_data
from calib.records import evenly
from calib.toolkit.installations import direction, median_misfit
from calib.toolkit.pose_pairs import MAX_METRES, PoseList, PosePairs, poses_of
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
        robot, seen: (m, 4, 4) poses of the robot and of what was seen.
        conventions: conventions of both orientations; empty where there is nothing to choose.
        misfit: median misfit, angles included [m].
    """

    robot: np.ndarray
    seen: np.ndarray
    conventions: tuple[str, str]
    misfit: float

    def equals(self, other: Reading) -> bool:
        """Return whether two readings are one, in other words."""
        same_robot = np.abs(self.robot - other.robot).max() < SAME
        same_seen = np.abs(self.seen - other.seen).max() < SAME
        return bool(same_robot and same_seen)


def agreed(pairs: PosePairs) -> tuple[Reading, list[str]]:
    """Return the reading of pairs of poses in which they agree, and notes on what was not stated.

    Args:
        pairs: m pairs of poses.

    Raises:
        MeasurementError: several conventions agree about as well, and the file states none.
    """
    robot_position, robot_note = pairs.robot.metres()
    seen_position, seen_note = pairs.seen.metres()
    notes = [note for note in (robot_note, seen_note) if note]
    rows = evenly(len(pairs), MAX_ROWS)
    robot_turns = dict(pairs.robot.readings())
    seen_turns = dict(pairs.seen.readings())
    choices = list(_choices(robot_turns, seen_turns, rows))
    stated = pairs.robot.convention, pairs.seen.convention
    is_stated = _states(pairs.robot) and _states(pairs.seen)
    first = choices[0]
    smallest = min(gap for gap, _ in choices)
    limit = max(MAX_GAP, GAP_RATIO * smallest)
    likely = sorted((choice for choice in choices if choice[0] <= limit), key=lambda choice: choice[0])
    readings = []
    for _, names in dict.fromkeys([first, *likely[:MAX_PLACED]]):
        robot = poses_of(robot_position, robot_turns[names[0]])
        seen = poses_of(seen_position, seen_turns[names[1]])
        readings.append(_placed(robot, seen, names, rows))
    as_stated = readings[0]
    readings.sort(key=lambda reading: reading.misfit)
    best = readings[0]
    if is_stated and as_stated.misfit <= CLEAR_RATIO * best.misfit:
        return _in_likely_unit(pairs, as_stated, notes), notes
    others = [reading for reading in readings[1:] if not reading.equals(best)]
    if others and not is_stated:
        _check_clear(pairs, best, others[0])
    for poses, convention, name in zip((pairs.robot, pairs.seen), best.conventions, stated):
        if convention and convention != name:
            notes.append(
                f"{poses.name or 'poses'}: the orientation is read as {convention}, with which the poses agree"
                f"{f' ({name} is stated)' if name else ''}"
            )
    return _in_likely_unit(pairs, best, notes), notes


def _in_likely_unit(pairs: PosePairs, reading: Reading, notes: list[str]) -> Reading:
    """Return a reading with the lengths of the poses seen in the unit with which they agree, where none is stated.

    Args:
        pairs: the pairs.
        reading: their reading.
        notes: remarks, to which that on the unit is added.
    """
    if pairs.seen.length_unit or len(pairs) < MIN_ROWS or direction(reading.robot, reading.seen).agrees:
        return reading
    read_unit = "m" if np.abs(pairs.seen.position).max() <= MAX_METRES else "mm"
    for unit in UNITS:
        factor = LENGTHS[unit] / LENGTHS[read_unit]
        seen = reading.seen.copy()
        seen[:, :3, 3] *= factor
        ways = direction(reading.robot, seen)
        if unit != read_unit and ways.agrees and ways.is_inverse is not None:
            name = pairs.seen.name or "poses"
            notes[:] = [note for note in notes if not note.startswith(f"{name}: up to")]
            notes.append(f"{name}: the lengths are read as {unit}, with which the poses agree (no unit is stated)")
            return replace(reading, seen=seen)
    return reading


def _states(poses: PoseList) -> bool:
    """Return whether nothing is open in how an orientation is read; matrices are row by row unless that disagrees."""
    return bool(poses.convention) or poses.kind == "matrix"


def _choices(
    robot: dict[str, np.ndarray], seen: dict[str, np.ndarray], rows: np.ndarray
) -> Iterator[tuple[float, tuple[str, str]]]:
    """Yield for each choice of conventions the median difference of relative rotations [rad], and the conventions."""
    robot_angles = {name: _relative_angles(turns[rows]) for name, turns in robot.items()}
    seen_angles = {name: _relative_angles(turns[rows]) for name, turns in seen.items()}
    for robot_name, seen_name in product(robot_angles, seen_angles):
        difference = np.abs(robot_angles[robot_name] - seen_angles[seen_name])
        yield float(np.median(difference)), (robot_name, seen_name)


def _relative_angles(turns: np.ndarray) -> np.ndarray:
    """Return the angles [rad] between each orientation of (m, 3, 3) and the next two; the last two wrap around."""
    angles = []
    for step in (1, 2):
        following = np.roll(turns, -step, axis=0)
        relative = np.einsum("mji,mjk->mik", turns, following)
        angles.append(Rotation.from_matrix(relative).magnitude())
    return np.concatenate(angles)


def _placed(robot: np.ndarray, seen: np.ndarray, names: tuple[str, str], rows: np.ndarray) -> Reading:
    """Return a reading with its misfit in the direction of the poses seen in which they agree better."""
    direct = median_misfit(robot[rows], seen[rows])
    inverse = median_misfit(robot[rows], invert(seen[rows]))
    return Reading(robot, seen, names, min(direct, inverse))


def _check_clear(pairs: PosePairs, best: Reading, second: Reading) -> None:
    """Raise MeasurementError if two readings agree about as well, or if there are too few samples to choose."""
    if len(pairs) >= MIN_ROWS and second.misfit > CLEAR_RATIO * best.misfit:
        return
    words = []
    for reading in (best, second):
        names = [
            f"{poses.name or 'poses'} {name}" for poses, name in zip((pairs.robot, pairs.seen), reading.conventions)
        ]
        words.append(f"{' and '.join(names)} ({1e3 * reading.misfit:.3g} mm)")
    refuse_data(
        pairs.file,
        f"the file does not say how its orientations are meant, and {len(pairs)} pairs agree about as well as "
        f"{words[0]} or as {words[1]}: state the convention in the options (euler = 'vector', 'zyx moving' …), or give "
        "quaternions",
    )

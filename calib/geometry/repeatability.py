"""Pose accuracy and repeatability after ISO 9283:1998, from poses measured several times.

For the n cycles of one commanded pose, p_j measured, p̄ their mean (the barycentre), p_c the command:

    AP  = |p̄ - p_c|,   AP_x = x̄ - x_c, …                  pose accuracy (7.2.1)
    RP  = l̄ + 3 S_l,   l_j = |p_j - p̄|                    pose repeatability (7.2.2), S_l with n - 1
    AP_a, AP_b, AP_c; RP_a = 3 S_a, …                      of orientations, as rotation vectors about the base's axes
    vAP = the largest distance between the barycentres of cycles that came from different directions (7.2.3)

The command is what an arm's model says of the mean joints of the cycles, so that nominal and calibrated arm each have
an accuracy of their own, while repeatability is the robot's (and the instrument's). Rotation vectors in place of the
norm's Euler angles are our choice; for the small angles at hand they differ by nothing that counts.

Rows that stand twice in what was measured: copied, or a file given twice. They count twice, and prove nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from calib.data.poses.measurements import PoseMeasurements, Poses, Positions
from calib.errors import counted
from calib.geometry.installation import Installation
from calib.geometry.observation import Block, predict, prepare, rows_of
from calib.records import stored

SAME = 1e-3  # joints of one commanded pose, as read back, differ by less [rad or m]; our choice, as the next two
ARMS = ("nominal", "calibrated")
MeanAndMax = Mapping[str, float]
APART = np.radians(30.0)  # directions of approach that differ by more are different ones


@dataclass(frozen=True)
class RepeatedPose:
    """One pose measured several times: its rows, AP of both arms per axis in the arm's base, RP, vAP; mm and deg."""

    rows: tuple[int, ...]
    repeatability_mm: float
    nominal_mm: tuple[float, ...]
    calibrated_mm: tuple[float, ...]
    repeatability_deg: tuple[float, ...] = ()
    multidirectional_mm: float | None = None
    nominal_deg: tuple[float, ...] = ()
    calibrated_deg: tuple[float, ...] = ()


@dataclass(frozen=True)
class RepeatedPoses:
    """Accuracy and repeatability of poses measured several times: of each pose, and mean and maximum over all."""

    each: tuple[RepeatedPose, ...]

    @stored
    def poses(self) -> int:
        """Number of poses."""
        return len(self.each)

    @stored
    def cycles(self) -> tuple[int, int]:
        """Smallest and largest number of cycles of a pose."""
        counts = [len(one.rows) for one in self.each]
        return min(counts), max(counts)

    @stored
    def repeatability_mm(self) -> MeanAndMax:
        """Position repeatability RP, mean and maximum [mm]."""
        return _mean_and_max([one.repeatability_mm for one in self.each])

    @stored
    def accuracy_mm(self) -> dict[str, MeanAndMax]:
        """Position accuracy AP of each arm, mean and maximum [mm]."""
        return {arm: _mean_and_max([np.linalg.norm(getattr(one, f"{arm}_mm")) for one in self.each]) for arm in ARMS}

    @stored
    def orientation_repeatability_deg(self) -> MeanAndMax | None:
        """Orientation repeatability RP, the largest of three axes, mean and maximum [deg]."""
        return _sizes([max(one.repeatability_deg) for one in self.each if one.repeatability_deg])

    @stored
    def orientation_accuracy_deg(self) -> dict[str, MeanAndMax | None]:
        """Orientation accuracy AP of each arm, mean and maximum [deg]."""
        turns = {arm: [getattr(one, f"{arm}_deg") for one in self.each] for arm in ARMS}
        return {arm: _sizes([np.linalg.norm(turn) for turn in each if turn]) for arm, each in turns.items()}

    @stored
    def multidirectional_mm(self) -> MeanAndMax | None:
        """Multidirectional variation vAP of the position, mean and maximum [mm]."""
        return _sizes([one.multidirectional_mm for one in self.each if one.multidirectional_mm is not None])


def _mean_and_max(values: Sequence[Any]) -> MeanAndMax:
    return {"mean": float(np.mean(values)), "max": float(np.max(values))}


def _sizes(values: Sequence[Any]) -> MeanAndMax | None:
    return _mean_and_max(values) if values else None


def repeated_poses(
    cells: tuple[Installation, Installation], measured: Sequence[PoseMeasurements]
) -> RepeatedPoses | None:
    """Return accuracy and repeatability of all poses measured at least `min_cycles` times; None without such poses.

    Args:
        cells: the nominal and the calibrated arm, whose predictions are compared.
        measured: blocks; those without an instrument are ignored.
    """
    ready = zip(measured, *(prepare(cell, measured) for cell in cells))
    found = [
        _repeated_pose(cells, blocks, block, index)
        for block, *blocks in ready
        if isinstance(block, Positions)
        for index in repeated_rows(block)
    ]
    return RepeatedPoses(tuple(found)) if found else None


def repeated_rows(measured: PoseMeasurements) -> list[np.ndarray]:
    """Return the row indices of each pose measured at least `min_cycles` times, in the file's order.

    Rows with the very same numbers are copies of one measurement and count once. Empty for kinds without positions.
    """
    if not isinstance(measured, Positions):
        return []
    table = np.hstack([measured.q, measured.position, measured.tool[:, None].astype(float)])
    _, first = np.unique(np.round(table, 12), axis=0, return_index=True)
    rows = np.sort(first)
    key = np.hstack([measured.q[rows], 1e3 * measured.tool[rows, None]])  # another reflector is another pose
    min_cycles = 3  # cycles that make a repeated pose
    tree, groups, taken = KDTree(key), [], np.zeros(len(rows), dtype=bool)
    often = np.flatnonzero(tree.query_ball_point(key, SAME, p=np.inf, return_length=True) >= min_cycles)
    for k, each in zip(often, tree.query_ball_point(key[often], SAME, p=np.inf)):
        own = np.array([i for i in each if not taken[i]], dtype=int)
        if not taken[k] and len(own) >= min_cycles:
            taken[own] = True
            groups.append(np.sort(rows[own]))
    return groups


def spread(points: np.ndarray) -> float:
    """Return the position repeatability RP = l̄ + 3 S_l of points (n, 3) [m]."""
    length = np.linalg.norm(points - points.mean(axis=0), axis=1)
    return float(length.mean() + 3.0 * length.std(ddof=1))


def _repeated_pose(
    cells: Sequence[Installation], blocks: Sequence[Block], measured: Positions, index: np.ndarray
) -> RepeatedPose:
    """Return accuracy and repeatability of one pose from its rows."""
    points = measured.position[index]
    turns = Rotation.from_quat(measured.quaternion[index]) if isinstance(measured, Poses) else None
    own: dict[str, Any] = {}
    for arm, cell, block in reversed(list(zip(ARMS, cells, blocks))):
        seen, base = predict(cell, rows_of(cell, block, index)), cell.stations[block.station][:3, :3]
        own[f"{arm}_mm"] = _numbers(1e3 * base.T @ (points.mean(axis=0) - seen.point.mean(axis=1)))
        if turns is not None:
            middle, command = turns.mean(), Rotation.from_matrix(seen.rotation.transpose(2, 1, 0)).mean()
            own[f"{arm}_deg"] = _numbers(np.degrees(base.T @ (middle * command.inv()).as_rotvec()))
            spread_about = 3.0 * ((turns * middle.inv()).as_rotvec() @ base).std(axis=0, ddof=1)
            own["repeatability_deg"] = _numbers(np.degrees(spread_about))
    varied = _variation(points, _directions(measured, index))
    return RepeatedPose(
        tuple(int(row) for row in measured.rows[index]),
        1e3 * spread(points),
        multidirectional_mm=None if np.isnan(varied) else 1e3 * varied,
        **own,
    )


def _numbers(values: np.ndarray) -> tuple[float, ...]:
    return tuple(values.tolist())


def _directions(measured: Positions, index: np.ndarray) -> np.ndarray:
    """Return each row's direction of approach (k, 3), from the previous row of the file; NaN without that row.

    Both as measured: what counts is the direction, not the tenths of a millimetre.
    """
    result = np.full((len(index), 3), np.nan)
    place = {int(row): k for k, row in reversed(list(enumerate(measured.rows)))}
    for number, k in enumerate(index):
        before = place.get(int(measured.rows[k]) - 1)
        if before is not None and measured.tool[before] == measured.tool[k]:
            step = measured.position[k] - measured.position[before]
            length = np.linalg.norm(step)
            if length > SAME:
                result[number] = step / length
    return result


def _variation(points: np.ndarray, directions: np.ndarray) -> float:
    """Return vAP [m] of points (k, 3) approached in directions (k, 3); NaN for fewer than two directions."""
    left = np.flatnonzero(~np.isnan(directions[:, 0]))
    centres = []
    while len(left):
        parallel = directions[left] @ directions[left[0]] > np.cos(APART)
        if parallel.sum() > 1:
            centres.append(points[left[parallel]].mean(axis=0))
        left = left[~parallel]
    if len(centres) < 2:
        return float("nan")
    return max(float(np.linalg.norm(a - b)) for k, a in enumerate(centres) for b in centres[:k])


def repeated(fit: Sequence[PoseMeasurements], unseen: Mapping[str, PoseMeasurements]) -> tuple[set[str], list[str]]:
    """Return the names of validation files that mostly repeat rows of the fit, and notes on repeated rows.

    Args:
        fit: the fit's blocks.
        unseen: rows kept from it, by name.

    Returns:
        Names of those in `unseen` that mostly are rows of the fit; and notes for the user.
    """
    notes, proofless, known = [], set(), set[bytes]()
    for block in fit:
        marks = _marks(block)
        first = {mark: k for k, mark in reversed(list(enumerate(marks)))}
        within = _row_numbers(block, [first[mark] < k for k, mark in enumerate(marks)])
        before = _row_numbers(block, [mark in known for mark in marks])
        name = Path(block.file).name
        if within:
            notes.append(f"{name}: {_rows(within)} identical to another row of the file: each counts twice")
        if before:
            notes.append(f"{name}: {_rows(before)} identical to rows of another fitted file. Is the file given twice?")
        known.update(marks)
    # of a validation file's rows that are the fit's: from there on it proves nothing (our choice)
    max_copied_share = 0.5
    for name, aside in unseen.items():
        copied = np.array([mark in known for mark in _marks(aside)], dtype=bool)
        again = _measured_again(fit, aside) & ~copied
        for chosen, words in ((copied, "identical to fitted rows"), (again, "at joint values of fitted rows")):
            if repeats := _row_numbers(aside, chosen):
                notes.append(f"{name}: {_rows(repeats)} {words}, so they do not count as validation")
        if len(_row_numbers(aside, again | copied)) > max_copied_share * len(aside):
            proofless.add(name)
    return proofless, notes


def _measured_again(fit: Sequence[PoseMeasurements], aside: PoseMeasurements) -> np.ndarray:
    """Return a mask (m,) of the rows with the joint values of a fitted row."""
    seen = [block.q for block in fit if type(block) is type(aside) and block.has_instrument]
    if not seen:
        return np.zeros(len(aside), dtype=bool)
    return KDTree(np.concatenate(seen)).query(aside.q, p=np.inf)[0] <= SAME


def _marks(block: PoseMeasurements) -> list[bytes]:
    """Return a key of each row: its joint values and measured numbers, rounded to 12 decimals."""
    table = np.column_stack([block.q, block.tool.astype(float), block.measured])
    return [row.tobytes() for row in np.round(table, 12) + 0.0]


def _row_numbers(block: PoseMeasurements, chosen: Sequence[bool] | np.ndarray) -> list[int]:
    return [int(row) for row in dict.fromkeys(block.rows[np.array(chosen, dtype=bool)])]


def _rows(numbers: Sequence[int]) -> str:
    shown = ", ".join(str(number) for number in numbers[:5]) + (", ..." if len(numbers) > 5 else "")
    return f"{counted(len(numbers), 'row')} ({shown})"

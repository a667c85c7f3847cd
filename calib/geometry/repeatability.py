"""Pose accuracy and repeatability after ISO 9283:1998, from poses measured several times.

For the n cycles of one commanded pose, with measured positions p_j, their mean p̄ (the barycentre) and the command p_c:

    AP  = |p̄ - p_c|,   AP_x = x̄ - x_c, …                  pose accuracy (7.2.1)
    RP  = l̄ + 3 S_l,   l_j = |p_j - p̄|                    pose repeatability (7.2.2), S_l with n - 1
    AP_a, AP_b, AP_c; RP_a = 3 S_a, …                      of orientations, as rotation vectors about the base's axes
    vAP = the largest distance between the barycentres of cycles approached from different directions (7.2.3)

The command is the pose that an arm's model predicts for the mean joint values of the cycles. Nominal and calibrated arm
therefore each have an accuracy of their own, while repeatability is a property of the robot (and the instrument).
Rotation vectors in place of the norm's Euler angles are our choice; for small angles the difference is negligible.

The module also finds rows that occur twice in the measurements because they were copied, or a file was given twice.
Such rows would be weighted twice, and are useless for validation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from calib.data.poses.measurements import PoseMeasurements, Poses, Positions, take
from calib.errors import counted
from calib.geometry.installation import Installation
from calib.geometry.observation import Block, predict, prepare, rows_of
from calib.records import stored

# largest difference of joint values read back at one commanded pose [rad or m] (our choice)
SAME = 1e-3
# smallest angle between directions of approach that are treated as different (our choice)
APART = np.radians(30.0)
# smallest number of cycles of a repeated pose
MIN_CYCLES = 3
# largest share of a validation file's rows that may be rows of the fit, for the file to be used (our choice)
MAX_COPIED_SHARE = 0.5
ARMS = ("nominal", "calibrated")
MeanAndMax = Mapping[str, float]


@dataclass(frozen=True)
class RepeatedPose:
    """One pose measured several times: its rows, AP of both arms along the base's axes, RP and vAP [mm, deg]."""

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
        counts = [len(pose.rows) for pose in self.each]
        return min(counts), max(counts)

    @stored
    def repeatability_mm(self) -> MeanAndMax:
        """Position repeatability RP, mean and maximum [mm]."""
        return _mean_and_max([pose.repeatability_mm for pose in self.each])

    @stored
    def accuracy_mm(self) -> dict[str, MeanAndMax]:
        """Position accuracy AP of each arm, mean and maximum [mm]."""
        return {
            "nominal": _mean_and_max([_norm(pose.nominal_mm) for pose in self.each]),
            "calibrated": _mean_and_max([_norm(pose.calibrated_mm) for pose in self.each]),
        }

    @stored
    def orientation_repeatability_deg(self) -> MeanAndMax | None:
        """Orientation repeatability RP, the largest of three axes, mean and maximum [deg]; None if not measured."""
        return _sizes([max(pose.repeatability_deg) for pose in self.each if pose.repeatability_deg])

    @stored
    def orientation_accuracy_deg(self) -> dict[str, MeanAndMax | None]:
        """Orientation accuracy AP of each arm, mean and maximum over the poses [deg]; None if not measured."""
        return {
            "nominal": _sizes([_norm(pose.nominal_deg) for pose in self.each if pose.nominal_deg]),
            "calibrated": _sizes([_norm(pose.calibrated_deg) for pose in self.each if pose.calibrated_deg]),
        }

    @stored
    def multidirectional_mm(self) -> MeanAndMax | None:
        """Multidirectional variation vAP of the position, mean and maximum [mm]; None if not measured."""
        return _sizes([pose.multidirectional_mm for pose in self.each if pose.multidirectional_mm is not None])


def _norm(values: Sequence[float]) -> float:
    return float(np.linalg.norm(values))


def _mean_and_max(values: Sequence[float]) -> MeanAndMax:
    return {"mean": float(np.mean(values)), "max": float(np.max(values))}


def _sizes(values: Sequence[float]) -> MeanAndMax | None:
    """Return mean and maximum of the values; None for no values."""
    return _mean_and_max(values) if values else None


def repeated_poses(
    cells: tuple[Installation, Installation], measured: Sequence[PoseMeasurements]
) -> RepeatedPoses | None:
    """Return accuracy and repeatability of all poses measured at least `MIN_CYCLES` times; None if there are none.

    Args:
        cells: the nominal and the calibrated arm, whose predictions are compared.
        measured: blocks of measurements; those without an instrument are ignored.
    """
    nominal, calibrated = cells
    result = []
    for block, nominal_block, calibrated_block in zip(
        measured, prepare(nominal, measured), prepare(calibrated, measured)
    ):
        if not isinstance(block, Positions):
            continue
        for rows in repeated_rows(block):
            nominal_command = _command(nominal, nominal_block, rows)
            calibrated_command = _command(calibrated, calibrated_block, rows)
            result.append(_repeated_pose(block, rows, nominal_command, calibrated_command))
    return RepeatedPoses(tuple(result)) if result else None


def repeated_rows(measured: PoseMeasurements) -> list[np.ndarray]:
    """Return the row numbers of each pose measured at least `MIN_CYCLES` times, in the file's order.

    Rows with exactly equal numbers are copies of one measurement and are counted once. The result is empty for kinds of
    measurement without positions.
    """
    if not isinstance(measured, Positions):
        return []
    table = np.hstack([measured.q, measured.position, measured.tool[:, None].astype(float)])
    _, first = np.unique(np.round(table, 12), axis=0, return_index=True)
    rows = np.sort(first)
    # another reflector is another pose
    key = np.hstack([measured.q[rows], 1e3 * measured.tool[rows, None]])
    tree = KDTree(key)
    counts = tree.query_ball_point(key, SAME, p=np.inf, return_length=True)
    often = np.flatnonzero(counts >= MIN_CYCLES)
    grouped = np.zeros(len(rows), dtype=bool)
    groups = []
    for row, neighbours in zip(often, tree.query_ball_point(key[often], SAME, p=np.inf)):
        members = np.array([member for member in neighbours if not grouped[member]], dtype=int)
        if not grouped[row] and len(members) >= MIN_CYCLES:
            grouped[members] = True
            groups.append(np.sort(rows[members]))
    return groups


def spread(points: np.ndarray) -> float:
    """Return the position repeatability RP = l̄ + 3 S_l of points (n, 3) [m]."""
    length = np.linalg.norm(points - points.mean(axis=0), axis=1)
    return float(length.mean() + 3.0 * length.std(ddof=1))


@dataclass(frozen=True, eq=False)
class CommandedPose:
    """Pose that an arm's model predicts for the mean joints of repeated rows.

    Attributes:
        base: (3, 3) orientation of the arm's base in the instrument's frame.
        position: (3,) position of the target in the instrument's frame [m].
        rotation: rotation of the target in the instrument's frame.
    """

    base: np.ndarray
    position: np.ndarray
    rotation: Rotation

    def accuracy_mm(self, points: np.ndarray) -> tuple[float, ...]:
        """Return AP [mm] along the axes of the arm's base for measured points (n, 3) [m]."""
        return _numbers(1e3 * self.base.T @ (points.mean(axis=0) - self.position))

    def accuracy_deg(self, mean: Rotation) -> tuple[float, ...]:
        """Return AP [deg] about the axes of the arm's base for a mean measured rotation."""
        return _numbers(np.degrees(self.base.T @ (mean * self.rotation.inv()).as_rotvec()))


def _command(cell: Installation, block: Block, rows: np.ndarray) -> CommandedPose:
    """Return the pose that an arm predicts for the mean joint values of some rows of a block.

    Args:
        cell: the installation of the arm, its station and its tool.
        block: the prepared measurements.
        rows: row numbers in the block.
    """
    seen = predict(cell, rows_of(cell, block, rows))
    rotations = Rotation.from_matrix(seen.rotation.transpose(2, 1, 0))
    return CommandedPose(cell.stations[block.station][:3, :3], seen.point.mean(axis=1), rotations.mean())


def _repeated_pose(
    measured: Positions, rows: np.ndarray, nominal: CommandedPose, calibrated: CommandedPose
) -> RepeatedPose:
    """Return accuracy and repeatability of one pose from its rows and the pose that each arm predicts.

    Args:
        measured: the block of measurements.
        rows: row numbers of the pose's cycles.
        nominal, calibrated: pose predicted by the nominal and by the calibrated arm.
    """
    points = measured.position[rows]
    variation = _variation(points, _directions(measured, rows))
    result = RepeatedPose(
        rows=tuple(int(row) for row in measured.rows[rows]),
        repeatability_mm=1e3 * spread(points),
        nominal_mm=nominal.accuracy_mm(points),
        calibrated_mm=calibrated.accuracy_mm(points),
        multidirectional_mm=None if np.isnan(variation) else 1e3 * variation,
    )
    if not isinstance(measured, Poses):
        return result
    rotations = Rotation.from_quat(measured.quaternion[rows])
    mean = rotations.mean()
    # about the axes of the nominal arm's base
    turns = (rotations * mean.inv()).as_rotvec() @ nominal.base
    return replace(
        result,
        repeatability_deg=_numbers(np.degrees(3.0 * turns.std(axis=0, ddof=1))),
        nominal_deg=nominal.accuracy_deg(mean),
        calibrated_deg=calibrated.accuracy_deg(mean),
    )


def _numbers(values: np.ndarray) -> tuple[float, ...]:
    return tuple(values.tolist())


def _directions(measured: Positions, rows: np.ndarray) -> np.ndarray:
    """Return each row's direction of approach (k, 3), from the previous row of the file; NaN where that row is missing.

    Both positions are the measured ones; their errors are small against the distance between the two rows.

    Args:
        measured: the block of measurements.
        rows: (k,) row numbers in the block.
    """
    result = np.full((len(rows), 3), np.nan)
    index = {int(number): row for row, number in reversed(list(enumerate(measured.rows)))}
    for k, row in enumerate(rows):
        before = index.get(int(measured.rows[row]) - 1)
        if before is None or measured.tool[before] != measured.tool[row]:
            continue
        step = measured.position[row] - measured.position[before]
        length = np.linalg.norm(step)
        if length > SAME:
            result[k] = step / length
    return result


def _variation(points: np.ndarray, directions: np.ndarray) -> float:
    """Return the multidirectional variation vAP [m] of points approached from several directions.

    It is the largest distance between the means of points with different directions; NaN for fewer than two directions.

    Args:
        points: (k, 3) positions [m].
        directions: (k, 3) direction of approach of each point; NaN where unknown.
    """
    remaining = np.flatnonzero(~np.isnan(directions[:, 0]))
    centres: list[np.ndarray] = []
    while len(remaining):
        parallel = directions[remaining] @ directions[remaining[0]] > np.cos(APART)
        if parallel.sum() > 1:
            centres.append(points[remaining[parallel]].mean(axis=0))
        remaining = remaining[~parallel]
    if len(centres) < 2:
        return float("nan")
    return max(float(np.linalg.norm(first - second)) for first, second in combinations(centres, 2))


def without_copies(block: PoseMeasurements) -> tuple[PoseMeasurements, list[str]]:
    """Return a block without rows whose joint values and readings are those of an earlier row, and notes on these rows.

    A copied row contains no new information. If it were used, σ would be too small, and held-out rows could be copies
    of fitted rows.
    """
    marks = set[bytes]()
    copied = np.zeros(len(block), dtype=bool)
    for row, mark in enumerate(_marks(block)):
        copied[row] = mark in marks
        marks.add(mark)
    if not copied.any():
        return block, []
    numbers = _row_numbers(block, copied)
    note = f"{Path(block.file).name}: {_rows(numbers)} identical to another row of the file: not counted again"
    return take(block, np.flatnonzero(~copied)), [note]


def repeated(fit: Sequence[PoseMeasurements], unseen: Mapping[str, PoseMeasurements]) -> tuple[set[str], list[str]]:
    """Return the names of validation files that mostly repeat rows of the fit, and notes on repeated rows.

    Args:
        fit: the fitted blocks.
        unseen: blocks of held-out rows, by name.

    Returns:
        The names of the blocks in `unseen` most of whose rows are rows of the fit, and notes for the user.
    """
    notes = []
    fitted = set[bytes]()
    for block in fit:
        marks = _marks(block)
        before = _row_numbers(block, [mark in fitted for mark in marks])
        fitted |= set(marks)
        if before:
            name = Path(block.file).name
            notes.append(f"{name}: {_rows(before)} identical to rows of another fitted file. Was the file given twice?")
    proofless = set()
    for name, block in unseen.items():
        copied = np.array([mark in fitted for mark in _marks(block)], dtype=bool)
        again = _measured_again(fit, block) & ~copied
        for rows, reason in ((copied, "identical to fitted rows"), (again, "at joint values of fitted rows")):
            numbers = _row_numbers(block, rows)
            if numbers:
                notes.append(f"{name}: {_rows(numbers)} {reason}, so they do not count as validation")
        if len(_row_numbers(block, again | copied)) > MAX_COPIED_SHARE * len(block):
            proofless.add(name)
    return proofless, notes


def _measured_again(fit: Sequence[PoseMeasurements], unseen: PoseMeasurements) -> np.ndarray:
    """Return a mask (m,) of the rows of `unseen` whose joint values are those of a fitted row.

    Args:
        fit: the fitted blocks.
        unseen: a block of m held-out rows.
    """
    fitted = [block.q for block in fit if type(block) is type(unseen) and block.has_instrument]
    if not fitted:
        return np.zeros(len(unseen), dtype=bool)
    distances, _ = KDTree(np.concatenate(fitted)).query(unseen.q, p=np.inf)
    return distances <= SAME


def _marks(block: PoseMeasurements) -> list[bytes]:
    """Return a key for each row: its joint values and measured numbers, rounded to 12 decimals.

    Equal rows have equal keys.

    Args:
        block: the measurements.
    """
    table = np.column_stack([block.q, block.tool.astype(float), block.measured])
    return [row.tobytes() for row in np.round(table, 12) + 0.0]


def _row_numbers(block: PoseMeasurements, mask: Sequence[bool] | np.ndarray) -> list[int]:
    """Return the row numbers in the file of the rows in a mask (m,), each once.

    Args:
        block: the measurements.
        mask: (m,) the wanted rows.
    """
    rows = block.rows[np.array(mask, dtype=bool)]
    return [int(row) for row in dict.fromkeys(rows)]


def _rows(numbers: Sequence[int]) -> str:
    listed = ", ".join(str(number) for number in numbers[:5])
    if len(numbers) > 5:
        listed += ", ..."
    return f"{counted(len(numbers), 'row')} ({listed})"

"""Plausibility checks of pose measurements: each error names the row, the column and the likely cause."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.csv_table import Table
from calib.data.poses.columns import POSITION, QUATERNION, SIGMA, TURNS, Sheet
from calib.data.poses.fit_options import FileOptions
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions
from calib.data.schema import (
    BOUNDS,
    Column,
    Joints,
    Rows,
    check_travel,
    joint_unit,
    max_travel,
    refuse,
    two_conventions,
)
from calib.errors import MeasurementError, refuse_data, require
from calib.units import ANGLES, COUNT_WORDS, DEG, encoder_counts

# share of rows with an impossible angle from which on the columns are in degrees (our choice)
MOST_ROWS = 0.5
# offsets of a joint's zero that are tried where values are outside the limits [rad]
QUARTERS = (math.pi / 2.0, -math.pi / 2.0, math.pi, -math.pi)


def check_joints(q: np.ndarray, sheet: Sheet, columns: Sequence[str], robot: Joints) -> tuple[str, ...]:
    """Check joint values (m, n) [rad or m] for plausibility and return notes on unusual but possible values.

    Args:
        q: the joint values.
        sheet: the file's table with its options.
        columns: the file's names of the joint columns.
        robot: types and limits of the joints.

    Raises:
        MeasurementError: degrees although the header says rad, values outside the limits, or a robot that never moved.
    """
    joints, kinds, lower, upper, table = robot.names, robot.kinds, robot.lower, robot.upper, sheet.table
    units = [sheet.unit(column, "joints") for column in columns]
    _check_joint_units(sheet, columns, kinds, units)
    if len(q) > 1 and np.ptp(q, axis=0).max() < BOUNDS.min_travel:
        message = f"all {len(q)} rows have the same joint values: one pose determines no parameter"
        refuse_data(table.file, message, columns[0], int(table.rows[-1]))
    bounded = np.isfinite(lower) & np.isfinite(upper)
    sliding = np.array([kind == "prismatic" for kind in kinds])
    plain = np.array([unit in ("", "rad", "m") for unit in units])
    # degrees from 0 to 360 exceed limits in degrees, too: all joints together show the unit, not one alone
    too_large = np.abs(q[:, ~sliding & plain]) > BOUNDS.max_turn
    rows_in_degrees = np.asarray(too_large.any(axis=1))
    in_degrees = bool(np.mean(rows_in_degrees) > MOST_ROWS)
    split = two_conventions(table, rows_in_degrees, "deg", "rad")

    def advice(j: int, unit: str) -> str:
        if split and plain[j] and not sliding[j]:
            return split
        if units[j] in ("", "rad", "m"):
            return f"looks like {unit}; if so, name the column '{columns[j]} [{unit}]'"
        return f"the column is read as [{units[j]}]: is it in another unit (counts, grad), or of another joint?"

    remedy = "correct its limits or set check_limits = false in the options"
    otherwise = f"are joint columns swapped? If the robot reached it, {remedy}"

    def says(row: int, j: int) -> str:
        unit, mistaken_unit, factor = joint_unit(kinds[j])
        fault = f"{q[row, j]:g} {unit} is outside the limits {lower[j]:g} to {upper[j]:g} {unit} of {joints[j]}"
        if split and rows_in_degrees[row]:
            return f"{fault}: {advice(j, mistaken_unit)}"
        fits_other_unit = not outside(q[:, j] * factor, lower[j], upper[j]).any()
        if in_degrees and plain[j] and not sliding[j] and abs(q[row, j]) > BOUNDS.max_turn:
            return f"{fault}: {advice(j, mistaken_unit)}"
        if units[j] in ("", "rad", "m") and np.abs(q[:, j]).max() > BOUNDS.max_turn and fits_other_unit:
            return f"{fault}: {advice(j, mistaken_unit)}"
        turns = _turns_beyond(float(q[row, j]), float(lower[j]), float(upper[j]))
        if turns and not sliding[j]:
            there = f"{fault}, {q[row, j] + turns * math.tau:g} rad ({turns:+d} turn) is inside"
            return f"{there}: was the joint wound, or its turn lost? Then add the turn to these rows. Or {otherwise}"
        for angle in () if sliding[j] else QUARTERS:
            if not outside(q[:, j] + angle, lower[j], upper[j]).any():
                question = (
                    f"does the controller count {joints[j]} from another zero? With {angle / DEG:+g}° all rows fit"
                )
                return f"{fault}: {question}. Or {otherwise}"
        return f"{fault}: {otherwise}"

    if sheet.options.check_limits:
        refuse(table, outside(q, lower, upper) & bounded, columns, says)
    free = ~bounded if sheet.options.check_limits else sliding
    check_travel(q, np.where(free, max_travel(kinds), math.inf), table, columns, joints, kinds, advice)
    notes = []
    excess = np.where(bounded, np.maximum(lower - q, q - upper), 0.0)
    for j in np.flatnonzero((excess > 0.0).any(axis=0)).tolist():
        row_of_worst = int(np.argmax(excess[:, j]))
        share = f"{int((excess[:, j] > 0.0).sum())} of {len(q)} rows"
        where = f"most in row {table.rows[row_of_worst]}, by {excess[row_of_worst, j]:.2g} {joint_unit(kinds[j])[0]}"
        notes.append(f"{joints[j]} is outside its limits in {share}, {where}; these rows are used")
    turning = [j for j in range(len(joints)) if not sliding[j]]
    stated_degrees = turning and all(units[j] in ("deg", "°", "degrees") for j in turning)
    if stated_degrees and np.abs(q[:, turning]).max() < BOUNDS.max_turn * DEG:
        notes.append("all joint values are below 6.6 deg: are they radians instead of degrees?")
    return tuple(notes)


def _turns_beyond(value: float, lower: float, upper: float) -> int:
    """Return the whole turns that bring a joint's value [rad] inside its limits; 0 if no number of turns does."""
    turns = round(((lower + upper) / 2.0 - value) / math.tau)
    inside = lower <= value + turns * math.tau <= upper
    return turns if inside else 0


def within_limits(q: np.ndarray, robot: Joints, columns: Sequence[str]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return joint values (m, n) [rad or m] with those outside their limits moved by a turn, and notes.

    Controllers show a joint as 0 to 360° or as -180 to 180°. A column is changed only if a turn brings all of its
    values within the limits.

    Args:
        q: the joint values.
        robot: types and limits of the joints.
        columns: the file's names of the joint columns.
    """
    exceeds = outside(q, robot.lower, robot.upper)
    turns = np.where(q > robot.upper, -1, 1) * 2.0 * math.pi
    turned = np.where(exceeds, q + turns, q)
    notes = []
    result = q.copy()
    for j in np.flatnonzero(exceeds.any(axis=0) & ~outside(turned, robot.lower, robot.upper).any(axis=0)).tolist():
        if robot.kinds[j] != "prismatic":
            result[:, j] = turned[:, j]
            count = int(exceeds[:, j].sum())
            notes.append(
                f"{columns[j]} is outside its limits in {count} of {len(q)} rows, and within them by a turn: read so"
            )
    return result, tuple(notes)


def outside(q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return which joint values (m, n) exceed their limits (n,) by more than an encoder's error, (m, n) bool.

    Args:
        q: (m, n) joint values [rad or m].
        lower, upper: (n,) limits; infinite for no limit.
    """
    return (q < lower - BOUNDS.limit_slack) | (q > upper + BOUNDS.limit_slack)


def _check_joint_units(sheet: Sheet, columns: Sequence[str], kinds: Sequence[str], units: Sequence[str]) -> None:
    """Raise MeasurementError for a unit of the wrong kind: mm for a revolute joint, deg for a prismatic one.

    Args:
        sheet: the file's table with its options.
        columns: the file's names of the joint columns.
        kinds: URDF type of each joint.
        units: unit of each joint column; "" without one.
    """
    for name, kind, unit in zip(columns, kinds, units):
        turns = unit.lower() in (*ANGLES, *COUNT_WORDS) or encoder_counts(unit) is not None
        if unit and turns == (kind == "prismatic"):
            advice = "is it the right column?"
            if not sheet.table.units[sheet.table.index(name)]:
                advice = "the unit is from the options; if only some joints have it, state it by their column names"
            sheet.fail(f"the unit [{unit}] does not suit a {kind} joint: {advice}", name)


def check_block(block: PoseMeasurements, options: FileOptions, robot: Joints) -> PoseMeasurements:
    """Return measurements from memory with notes, after the checks that are also applied to files.

    Args:
        block: measurements made from arrays.
        options: options for reading a file, with stated sigmas.
        robot: types and limits of the joints.
    """
    q, joints = np.asarray(block.q), tuple(block.joint_names)
    where = block.file or "measurements in memory"
    message = f"q has shape {q.shape}, expected (rows, joints) with {len(joints)} joints"
    require(len(block) and q.ndim == 2 and q.shape[1] == len(joints), message, MeasurementError, where)
    table = Table(where, joints, ("",) * len(joints), tuple(q.T), block.rows)
    table.check(joints)
    notes = check_joints(q, Sheet(table, replace(options, units={}, columns={})), joints, replace(robot, names=joints))
    if isinstance(block, Positions):
        replace(table, header=POSITION.names, cells=tuple(block.position.T)).check(POSITION.names)
        POSITION.check(block.position, table, POSITION.names)
        if block.sigma is not None:
            SIGMA.check(block.sigma, table, SIGMA.names)
    if isinstance(block, Poses):
        unit_quaternions(block.quaternion, table, QUATERNION.names)
    return replace(block, notes=tuple(dict.fromkeys((*block.notes, *notes))))


def unit_quaternions(values: np.ndarray, source: Rows, columns: Sequence[str]) -> np.ndarray:
    """Return normalised quaternions (m, 4); refuse norms that differ from 1 by more than rounding.

    Args:
        values: (m, 4) quaternions.
        source: file and row numbers, for messages.
        columns: names of the columns.
    """
    norm = np.linalg.norm(values, axis=1)
    advice = "not 1: were columns rounded or swapped, or are they not a quaternion?"
    refuse(
        source,
        np.abs(norm - 1) > BOUNDS.max_norm_error,
        columns,
        lambda row, _: f"the quaternion {', '.join(columns)} has norm {norm[row]:.4g}, {advice}",
    )
    return values / norm[:, None]


def orientation(sheet: Sheet, names: Sequence[str]) -> np.ndarray:
    """Return unit quaternions (m, 4) x y z w from the columns `names` of a quaternion, a matrix or three angles.

    Args:
        sheet: the file's table with its options, which define the convention of angles.
        names: the file's names of four, nine or three columns.
    """
    column = Column(tuple(names))
    # Angles are bounded below, unless they are a rotation vector.
    if len(names) == 3:
        column = replace(TURNS, most=math.inf)
    values = sheet.numbers(names, column)
    if len(names) == 4:
        return unit_quaternions(values, sheet.table, names)
    if len(names) == 9:
        return _from_matrices(values.reshape(-1, 3, 3), sheet.table, names).as_quat(canonical=True)
    if sheet.options.euler != "vector":
        TURNS.check(values, sheet.table, names)
    return from_angles(values, sheet.options.euler).as_quat(canonical=True)


def from_angles(values: np.ndarray, euler: str) -> Rotation:
    """Return the rotations for three numbers each (m, 3) [rad], in the convention that the option ``euler`` names.

    Args:
        values: the three numbers.
        euler: convention, such as ``xyz fixed`` or ``zyx moving`` (``calib formats options``).
    """
    if euler == "vector":
        return Rotation.from_rotvec(values)
    return Rotation.from_euler(_axes(euler), values)


def to_angles(turns: Rotation, euler: str) -> np.ndarray:
    """Return three numbers (m, 3) [rad] for rotations, the inverse of `from_angles`.

    Args:
        turns: the m rotations.
        euler: convention, as in `from_angles`.
    """
    return turns.as_rotvec() if euler == "vector" else turns.as_euler(_axes(euler))


def _axes(euler: str) -> str:
    """Return a convention's axes in SciPy's notation: small letters for fixed axes, capital letters for moving axes.

    Args:
        euler: convention, such as ``xyz fixed`` or ``zyx moving``.
    """
    convention = {"wpr": "xyz fixed", "xyz": "xyz moving"}.get(euler, euler)
    axes, _, frame = convention.partition(" ")
    return axes if frame == "fixed" else axes.upper()


def _from_matrices(matrices: np.ndarray, source: Rows, columns: Sequence[str]) -> Rotation:
    """Return the rotations for matrices (m, 3, 3); refuse a matrix that is not a rotation.

    Args:
        matrices: (m, 3, 3) the numbers as read.
        source: file and row numbers, for messages.
        columns: the file's names of the nine columns.
    """
    defect = np.abs(matrices @ np.swapaxes(matrices, 1, 2) - np.eye(3)).max(axis=(1, 2))
    skewed = defect > 2 * BOUNDS.max_norm_error

    def says(row: int, _: int) -> str:
        if skewed[row]:
            return f"the matrix r11 to r33 is not orthonormal (R Rᵀ differs from 1 by {defect[row]:.2g})"
        return "the matrix r11 to r33 is left-handed (determinant -1): an axis is mirrored, or two are swapped"

    refuse(source, skewed | (np.linalg.det(matrices) < 0), columns, says)
    return Rotation.from_matrix(matrices)

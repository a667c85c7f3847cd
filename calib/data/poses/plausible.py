"""Can these numbers be what their header says? Each complaint names the row, the column and the likely cause."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.csv_table import Table
from calib.data.poses.fit_options import FINEST, FileOptions
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions
from calib.errors import MeasurementError
from calib.units import ANGLES

TURN = 2.1 * math.pi  # a joint value beyond this needs limits that allow it [rad]; our choice, as all of these
FAR = 50.0  # no instrument measures a robot from further away [m]
STILL = 1e-6  # a joint that moves less has not moved [rad or m]
SLACK = 1e-3  # encoders stand a little beyond a limit [rad or m]
NORM = 1e-3  # rounding of a quaternion or a matrix that is corrected
DEGREE = math.pi / 180

Limits = tuple[Sequence[float] | np.ndarray, Sequence[float] | np.ndarray]


def check_joints(
    q: np.ndarray,
    table: Table,
    columns: Sequence[str],
    joints: Sequence[str],
    options: FileOptions,
    kinds: Sequence[str] | None = None,
    limits: Limits | None = None,
) -> tuple[str, ...]:
    """Check joint values (m, n) [rad or m]; `kinds` are URDF's joint types, `limits` lower and upper (n,).

    Returns:
        Notes on what is odd but possible.

    Raises:
        MeasurementError: for degrees under a rad header, values outside the limits, a robot that never moved.
    """
    kinds = kinds or ["revolute"] * len(joints)
    _check_joint_units(table, columns, kinds, options)
    if len(q) > 1 and np.ptp(q, axis=0).max() < STILL:
        message = f"all {len(q)} rows have the same joint values: one pose tells nothing of the robot"
        raise MeasurementError(message, table.file, int(table.rows[-1]), columns[0])
    lower, upper = (np.full(len(joints), side) for side in (-np.inf, np.inf))
    if limits is not None:
        lower, upper = (np.asarray(side, dtype=float) for side in limits)
    notes = []
    for j, (column, joint, kind) in enumerate(zip(columns, joints, kinds)):
        span = (float(lower[j]), float(upper[j]))
        bounded = bool(np.isfinite(span).all())
        if options.check_limits and bounded:
            _check_limits(q[:, j], table, column, joint, span, kind, _stated(table, column, options))
        elif options.check_limits or kind == "prismatic":
            _check_size(q[:, j], table, column, joint, kind, _stated(table, column, options))
        if bounded:
            notes += _beyond(q[:, j], table, joint, span, kind)
    return (*notes, *_few_degrees(q, table, columns, kinds, options))


def check_block(
    block: PoseMeasurements, options: FileOptions, kinds: Sequence[str] | None = None, limits: Limits | None = None
) -> PoseMeasurements:
    """Return a block in memory with the notes that a file of its rows would get, or refuse it as that file."""
    q, joints = np.asarray(block.q), tuple(block.joint_names)
    place = block.file or "measurements in memory"
    if len(block) == 0 or q.ndim != 2 or q.shape[1] != len(joints):
        message = f"q has shape {q.shape} where there are {len(joints)} joints: expected (rows, joints)"
        raise MeasurementError(message, place)
    table = Table(place, joints, ("",) * len(joints), tuple(q.T), block.rows)
    _check_finite(q, table, joints)
    notes = check_joints(q, table, joints, joints, replace(options, units={}, columns={}), kinds, limits)
    if isinstance(block, Positions):
        _check_finite(block.position, table, "xyz")
        check_lengths(block.position, table, "xyz")
        if block.sigma is not None:
            check_positive(block.sigma, table, ("sigma_x", "sigma_y", "sigma_z"), "a sigma must be above 0")
    if isinstance(block, Poses):
        unit_quaternions(block.quaternion, table, ("qx", "qy", "qz", "qw"))
    return replace(block, notes=tuple(dict.fromkeys((*block.notes, *notes))))


def _check_finite(values: np.ndarray, table: Table, columns: Sequence[str]) -> None:
    """Refuse values (m, k) that are not finite."""
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        row, k = (int(i) for i in bad[0])
        message = f"found {values[row, k]:g} where a number is needed"
        raise MeasurementError(message, table.file, int(table.rows[row]), columns[k])


def _check_joint_units(table: Table, columns: Sequence[str], kinds: Sequence[str], options: FileOptions) -> None:
    """Refuse a stated unit that does not suit the joint: mm for a revolute one, deg for a prismatic one."""
    for name, kind in zip(columns, kinds):
        unit = _stated(table, name, options)
        if unit and (unit.lower() in ANGLES) == (kind == "prismatic"):
            message, advice = f"the unit [{unit}] does not suit a {kind} joint", "is the column in its place?"
            if not table.units[table.index(name)]:
                advice = "the options state it; if it holds for some joints only, state it by their columns' names"
            raise MeasurementError(f"{message}: {advice}", table.file, column=name)


def check_lengths(values: np.ndarray, table: Table, columns: Sequence[str]) -> None:
    """Refuse positions or distances (m, k) [m] beyond `FAR`."""
    far = np.argwhere(np.abs(values) > FAR)
    if len(far):
        row, k = (int(i) for i in far[0])
        message = f"found {values[row, k]:g} m; if it is in mm, name the column '{columns[k]} [mm]'"
        raise MeasurementError(message, table.file, int(table.rows[row]), columns[k])


def unit_quaternions(values: np.ndarray, table: Table, columns: Sequence[str]) -> np.ndarray:
    """Return quaternions (m, 4) with norm 1; one that is off by more than `NORM` is refused."""
    norm = np.linalg.norm(values, axis=1)
    bad = np.abs(norm - 1) > NORM
    if bad.any():
        row = int(np.argmax(bad))
        message = f"the quaternion {', '.join(columns)} has norm {norm[row]:.4g}, not 1"
        message += "; are these four columns a quaternion, and has none of them been rounded or swapped?"
        raise MeasurementError(message, table.file, int(table.rows[row]), columns[0])
    return values / norm[:, None]


def rotation_matrices(values: np.ndarray, table: Table, columns: Sequence[str]) -> np.ndarray:
    """Return matrices (m, 3, 3), given row by row (m, 9), that are rotations within `NORM`; others are refused."""
    matrices = values.reshape(-1, 3, 3)
    defect = np.abs(matrices @ np.swapaxes(matrices, 1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = (defect > 2 * NORM) | (np.linalg.det(matrices) < 0)
    if bad.any():
        row = int(np.argmax(bad))
        message = f"the matrix r11 to r33 is not orthonormal (R Rᵀ differs from 1 by {defect[row]:.2g})"
        if defect[row] <= 2 * NORM:
            message = "the matrix r11 to r33 is left-handed (determinant -1): an axis is mirrored, or two are swapped"
        raise MeasurementError(message, table.file, int(table.rows[row]), columns[0])
    return matrices


def turns(values: np.ndarray, table: Table, columns: Sequence[str], euler: str) -> np.ndarray:
    """Return quaternions (m, 4) x y z w of three angles each (m, 3) [rad], whose meaning `euler` is (`fit_options`)."""
    if euler == "vector":
        return Rotation.from_rotvec(values).as_quat(canonical=True)
    _check_turn(values, table, columns)
    axes, _, how = {"wpr": "xyz fixed", "xyz": "xyz moving"}.get(euler, euler).partition(" ")
    return Rotation.from_euler(axes if how == "fixed" else axes.upper(), values).as_quat(canonical=True)


def _check_turn(values: np.ndarray, table: Table, columns: Sequence[str]) -> None:
    beyond = np.argwhere(np.abs(values) > TURN)
    if len(beyond):
        row, k = (int(i) for i in beyond[0])
        message = f"{values[row, k]:g} rad is more than a turn: if it is in deg, name the column '{columns[k]} [deg]'"
        raise MeasurementError(message, table.file, int(table.rows[row]), columns[k])


def check_positive(values: np.ndarray, table: Table, columns: Sequence[str], advice: str) -> None:
    """Refuse sigmas and distances (m, k) that are not above zero, or that no instrument has; NaN passes."""
    bad = np.argwhere((values <= 0) | (values < FINEST) | (values > FAR))
    if len(bad):
        row, k = (int(i) for i in bad[0])
        found = values[row, k]
        words = advice if found <= 0 else f"expected {FINEST:g} to {FAR:g}, in SI: is the unit right?"
        raise MeasurementError(f"found {found:g}: {words}", table.file, int(table.rows[row]), columns[k])


def _units(kind: str) -> tuple[str, str, float]:
    return ("m", "mm", 1e-3) if kind == "prismatic" else ("rad", "deg", DEGREE)


def _stated(table: Table, column: str, options: FileOptions) -> str:
    """Return the unit that header or options state for a joint's column; "" for none."""
    ours = {theirs: name for name, theirs in options.columns.items()}
    units = options.units
    own = table.units[table.index(column)]
    return own or units.get(ours.get(column, column), units.get(column, units.get("joints", "")))


def _advice(column: str, other: str, stated: str) -> str:
    """Return what to do about values that would suit a joint in another unit."""
    if stated in ("", "rad", "m"):
        return f"looks like {other}; if so, name the column '{column} [{other}]'"
    return f"the column is read as [{stated}]: does it hold another unit (counts, grad), or another joint?"


def _check_size(q: np.ndarray, table: Table, column: str, joint: str, kind: str, stated: str) -> None:
    """Refuse values that no joint has, where there are no limits to hold against."""
    if kind == "continuous":
        return
    beyond = np.abs(q) > (FAR if kind == "prismatic" else TURN)
    if beyond.any():
        row, (unit, other, _) = int(np.argmax(beyond)), _units(kind)
        travel = "cannot be the travel" if kind == "prismatic" else "is more than a turn"
        message = f"{q[row]:g} {unit} {travel} of {joint} ({_share(beyond)}): {_advice(column, other, stated)}"
        raise MeasurementError(message, table.file, int(table.rows[row]), column)


def _check_limits(
    q: np.ndarray, table: Table, column: str, joint: str, span: tuple[float, float], kind: str, stated: str
) -> None:
    outside = (q < span[0] - SLACK) | (q > span[1] + SLACK)
    if not outside.any():
        return
    row, (unit, other, factor) = int(np.argmax(outside)), _units(kind)
    message = (
        f"{q[row]:g} {unit} is outside the limits {span[0]:g} to {span[1]:g} {unit} of {joint} ({_share(outside)})"
    )
    small = q * factor
    si = stated in ("", "rad", "m")
    if si and np.abs(q).max() > TURN and ((small >= span[0] - SLACK) & (small <= span[1] + SLACK)).all():
        message += f": {_advice(column, other, stated)}"
    else:
        message += ": are joint columns swapped? If the robot does go there, correct its limits or set"
        message += " check_limits = false in the options"
    raise MeasurementError(message, table.file, int(table.rows[row]), column)


def _beyond(q: np.ndarray, table: Table, joint: str, span: tuple[float, float], kind: str) -> list[str]:
    beyond = np.maximum(span[0] - q, q - span[1])
    if not (beyond > 0).any():
        return []
    worst = int(np.argmax(beyond))
    where = f"most in row {table.rows[worst]}, by {beyond[worst]:.2g} {_units(kind)[0]}"
    return [f"{joint} is outside its limits in {_share(beyond > 0)}, {where}; kept"]


def _share(mask: np.ndarray) -> str:
    return f"{int(mask.sum())} of {len(mask)} rows"


def _few_degrees(
    q: np.ndarray, table: Table, columns: Sequence[str], kinds: Sequence[str], options: FileOptions
) -> list[str]:
    turning = [j for j, kind in enumerate(kinds) if kind != "prismatic"]
    stated = [table.units[table.index(columns[j])] or options.units.get("joints", "rad") for j in turning]
    if (
        turning
        and all(unit in ("deg", "°", "degrees") for unit in stated)
        and np.abs(q[:, turning]).max() < TURN * DEGREE
    ):
        return ["no joint goes beyond 6.6 deg: are these values really degrees, not radians?"]
    return []

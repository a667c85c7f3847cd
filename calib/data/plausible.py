"""Can these numbers be what their header says? Each complaint names the row, the column and the likely cause."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from calib.data.options import FileOptions
from calib.data.tables import Table
from calib.errors import MeasurementError

TURN = 2.1 * math.pi  # a joint value beyond this needs limits that allow it; our choice
FAR = 50.0  # no instrument measures a robot from further away [m]; our choice
STILL = 1e-6  # a joint that moves less has not moved [rad or m]
SLACK = 1e-3  # encoders stand a little beyond a limit [rad or m]
NORM = 1e-3  # rounding of a quaternion or a matrix that we correct
RADIANS = math.pi / 180

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
    if len(q) > 1 and np.ptp(q, axis=0).max() < STILL:
        message = f"all {len(q)} rows have the same joint values: nothing can be learnt from one pose"
        raise MeasurementError(message, table.file, column=columns[0])
    kinds = kinds or ["revolute"] * len(joints)
    lower, upper = (np.asarray(side, dtype=float) for side in limits) if limits is not None else (None, None)
    notes = []
    for j, (column, joint, kind) in enumerate(zip(columns, joints, kinds)):
        turns = kind == "revolute"
        allowed = None if lower is None or upper is None else (lower[j], upper[j])
        bounded = allowed is not None and np.isfinite(allowed).all()
        if options.check_limits and bounded and allowed is not None:
            _check_limits(q[:, j], table, column, joint, allowed, turns)
        elif kind == "prismatic" and (np.abs(q[:, j]) > FAR).any():
            row = int(np.argmax(np.abs(q[:, j]) > FAR))
            message = f"{q[row, j]:g} m cannot be a joint's travel; if it is in mm, name the column '{column} [mm]'"
            raise MeasurementError(message, table.file, int(table.rows[row]), column)
        elif turns and not bounded and options.check_limits:
            _check_turns(q[:, j], table, column, joint)
        if allowed is not None and bounded:
            beyond = np.maximum(allowed[0] - q[:, j], q[:, j] - allowed[1])
            if (count := int((beyond > 0).sum())) > 0:
                unit = "m" if kind == "prismatic" else "rad"
                worst = int(np.argmax(beyond))
                notes.append(
                    f"{count} of {len(q)} values of {joint} are outside its limits, "
                    f"row {table.rows[worst]} by {beyond[worst]:.2g} {unit}; kept"
                )
    revolute = [j for j, kind in enumerate(kinds) if kind in ("revolute", "continuous")]
    stated = {table.units[table.index(columns[j])] for j in revolute}
    if revolute and stated <= {"deg", "°", "degrees"} and np.abs(q[:, revolute]).max() < TURN * RADIANS:
        notes.append("no joint goes beyond 6.6 deg: is the header's [deg] right, or are these radians?")
    return tuple(notes)


def check_lengths(values: np.ndarray, table: Table, columns: Sequence[str], rows: np.ndarray) -> None:
    """Refuse positions or distances (m, k) [m] beyond `FAR`."""
    far = np.argwhere(np.abs(values) > FAR)
    if len(far):
        row, k = far[0]
        message = f"found {values[row, k]:g} m; if it is in mm, name the column '{columns[k]} [mm]'"
        raise MeasurementError(message, table.file, int(rows[row]), columns[k])


def unit_quaternions(values: np.ndarray, table: Table, columns: Sequence[str], rows: np.ndarray) -> np.ndarray:
    """Return quaternions (m, 4) with norm 1; one that is off by more than `NORM` is refused."""
    norm = np.linalg.norm(values, axis=1)
    bad = np.abs(norm - 1) > NORM
    if bad.any():
        row = int(np.argmax(bad))
        message = f"the quaternion {', '.join(columns)} has norm {norm[row]:.4g}, not 1"
        message += "; are the columns a quaternion, and none of them swapped or rounded away?"
        raise MeasurementError(message, table.file, int(rows[row]), columns[0])
    return values / norm[:, None]


def rotation_matrices(values: np.ndarray, table: Table, columns: Sequence[str], rows: np.ndarray) -> np.ndarray:
    """Return matrices (m, 3, 3) that are orthonormal and right-handed within `NORM`; others are refused."""
    matrices = values.reshape(-1, 3, 3)
    defect = np.abs(matrices @ np.swapaxes(matrices, 1, 2) - np.eye(3)).max(axis=(1, 2))
    left = np.linalg.det(matrices) < 0
    bad = (defect > 2 * NORM) | left
    if bad.any():
        row = int(np.argmax(bad))
        message = f"the matrix r11 to r33 is not orthonormal (R Rᵀ differs from 1 by {defect[row]:.2g})"
        if defect[row] <= 2 * NORM:
            message = "the matrix r11 to r33 is left-handed (determinant -1): an axis is mirrored, or two are swapped"
        raise MeasurementError(message, table.file, int(rows[row]), columns[0])
    return matrices


def positive(values: np.ndarray, table: Table, columns: Sequence[str], rows: np.ndarray, what: str) -> None:
    """Refuse values (m, k) that are not above zero."""
    bad = np.argwhere(values <= 0)
    if len(bad):
        row, k = bad[0]
        raise MeasurementError(f"found {values[row, k]:g}: {what}", table.file, int(rows[row]), columns[k])


def _check_turns(q: np.ndarray, table: Table, column: str, joint: str) -> None:
    beyond = np.abs(q) > TURN
    if beyond.any():
        row = int(np.argmax(beyond))
        message = f"{q[row]:g} rad is more than a turn of {joint} ({int(beyond.sum())} of {len(q)} rows are)"
        message += f": looks like degrees; if so, name the column '{column} [deg]'"
        raise MeasurementError(message, table.file, int(table.rows[row]), column)


def _check_limits(
    q: np.ndarray, table: Table, column: str, joint: str, limits: tuple[float, float], turns: bool
) -> None:
    outside = (q < limits[0] - SLACK) | (q > limits[1] + SLACK)
    if not outside.any():
        return
    row = int(np.argmax(outside))
    unit, other, factor = ("rad", "deg", RADIANS) if turns else ("m", "mm", 1e-3)
    message = (
        f"{q[row]:g} {unit} is outside the limits {limits[0]:g} to {limits[1]:g} {unit} of {joint} "
        f"({int(outside.sum())} of {len(q)} rows are)"
    )
    small = q * factor
    if ((small >= limits[0] - SLACK) & (small <= limits[1] + SLACK)).all() and np.abs(q).max() > TURN:
        message += f": looks like {other}; if so, name the column '{column} [{other}]'"
    else:
        message += "; if the robot does go there, correct its limits or set check_limits = false in the options"
    raise MeasurementError(message, table.file, int(table.rows[row]), column)

"""A frame on the robot's base measured beside the target, from which the target is seen where the instrument moves.

The study (Kolyubin et al. 2019, section 3.5) marks the base with LEDs of its own, so that the camera may be moved
between series. Both measurements are noisy, and the base's orientation noise acts over the distance to the target.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.poses import plausible
from calib.data.poses.columns import BASE_TIME, POSITION, SIGMA, SIGMA_ROTATION, TIME, Layout, Sheet
from calib.data.poses.measurements import Poses, Positions
from calib.data.schema import refuse

# names of the target's time in a file
TARGET_TIMES = (*TIME.names, "t")
# number of last rows without a base frame, all others having one, that are a column of another length (our choice)
MIN_SHORTER = 2
OTHER_ROWS = "were base frames recorded at other rows? Put into each row the base frame that was read with its target"


def rows_with_base(sheet: Sheet, layout: Layout) -> tuple[Sheet, tuple[str, ...]]:
    """Return the sheet with only those rows in which the base frame was measured, and notes on the other rows.

    Args:
        sheet: the table with its options.
        layout: the columns to read.

    Raises:
        MeasurementError: a base frame that is partly empty, was measured in no row, or belongs to other rows.
    """
    if not layout.base:
        return sheet, ()
    table = sheet.table
    columns = np.column_stack(table.check(layout.base, layout.base))
    empty = np.isnan(columns)
    missing = np.asarray(empty.all(axis=1))
    partial = empty & ~missing[:, None]
    message = "is empty, unlike others of the base frame: leave all of them empty where it was not measured"
    refuse(table, partial, layout.base, lambda row, k: message)
    if missing.all():
        sheet.fail("the base frame was measured in no row", layout.base[0])
    _refuse_longer(sheet, layout, missing)
    _refuse_shorter(sheet, layout, missing)
    _refuse_other_clock(sheet)
    if not missing.any():
        return sheet, ()
    rows = ", ".join(str(row) for row in table.rows[missing][:6])
    more = ", …" if missing.sum() > 6 else ""
    note = f"base frame not measured in {missing.sum()} of {len(table)} rows, which are left out: {rows}{more}"
    return replace(sheet, table=table.where(~missing)), (note,)


def _refuse_longer(sheet: Sheet, layout: Layout, missing: np.ndarray) -> None:
    """Raise MeasurementError for rows with a base frame and without joint values: a column of another length.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
        missing: (m,) rows without a base frame.
    """
    joints = np.column_stack(sheet.table.check(layout.joints, layout.joints))
    without_joints = np.isnan(joints).all(axis=1) & ~missing
    message = f"has a base frame and no joint values: {OTHER_ROWS}"
    refuse(sheet.table, without_joints, layout.base, lambda row, k: message)


def _refuse_shorter(sheet: Sheet, layout: Layout, missing: np.ndarray) -> None:
    """Raise MeasurementError if the base frame is missing in the last rows only: a column of another length.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
        missing: (m,) rows without a base frame.
    """
    count = int(missing.sum())
    rows = len(missing)
    if count < MIN_SHORTER or not missing[rows - count :].all():
        return
    sheet.table.fail(
        f"ends {count} rows before the target: {OTHER_ROWS}; if it was out of sight at the end, remove these rows",
        layout.base[0],
        rows - count,
    )


def _refuse_other_clock(sheet: Sheet) -> None:
    """Raise MeasurementError if the times of base frames are nearer to the target's times of other rows.

    Args:
        sheet: the table with its options.
    """
    table = sheet.table
    times = [
        name for name in (*TARGET_TIMES, BASE_TIME) if name in table and table.cells[table.index(name)].dtype == float
    ]
    if BASE_TIME not in times or len(times) < 2 or len(table) < 2:
        return
    t = table.numbers(times[0], TIME.dimension)
    base_t = table.numbers(BASE_TIME, TIME.dimension, gaps=True)
    interval = float(np.median(np.abs(np.diff(t))))
    difference = np.abs(base_t - t)

    def says(row: int, column: int) -> str:
        return (
            f"the base frame was measured at {base_t[row]:.6g} s, the target at {t[row]:.6g} s, further apart than "
            f"half the {interval:.3g} s between rows: was it recorded with another clock, or at other rows? Put "
            f"into each row the base frame of its target's time; if they were read together, remove {BASE_TIME}"
        )

    refuse(table, difference > 0.5 * interval, (BASE_TIME,), says)


def seen_from_base(sheet: Sheet, layout: Layout, block: Positions, row: np.ndarray) -> Positions:
    """Return measurements relative to the base frame in the columns of a table.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
        block: positions or poses, in the instrument's frame.
        row: (m,) index of the table's row of each measurement.
    """
    position = sheet.numbers(layout.base[:3], POSITION)
    quaternion = plausible.orientation(sheet, layout.base[3:])
    sigma = None
    sigma_rotation = None
    if layout.base_sigma:
        sigma = sheet.numbers(layout.base_sigma, SIGMA)[row]
    if layout.base_sigma_rotation:
        sigma_rotation = sheet.numbers(layout.base_sigma_rotation, SIGMA_ROTATION)[row]
    elif sheet.options.sigma.orientation is not None and not isinstance(block, Poses):
        sigma_rotation = np.tile(sheet.options.sigma.orientation, (len(row), 1))
    return relative_to_base(block, position[row], quaternion[row], sigma, sigma_rotation)


def is_constant(base: np.ndarray) -> bool:
    """Return whether base frames (m, 7) are equal to the last digit, so that they were not measured in every row."""
    return len(base) > 1 and bool(np.all(base == base[0]))


def relative_to_base(
    block: Positions,
    position: np.ndarray,
    quaternion: np.ndarray,
    sigma: np.ndarray | None = None,
    sigma_rotation: np.ndarray | None = None,
) -> Positions:
    """Return measurements relative to the base frame that was measured with every row.

        p = R_bᵀ (p_t - p_b),   R = R_bᵀ R_t
        Σ_p = R_bᵀ (Σ_t + Σ_b + [l]× Σ_rb [l]×ᵀ) R_b,  l = p_t - p_b;   Σ_r = R_bᵀ (Σ_rt + Σ_rb) R_b

    Index t denotes the target, b the base frame. Only the diagonals of the covariances are kept. A base frame that is
    the same in all rows has an error that is common to them, which the placement of the base takes: no noise is added.

    Args:
        block: positions or poses, in the instrument's frame.
        position: (m, 3) positions of the base frame [m].
        quaternion: (m, 4) orientations of the base frame, x y z w, of unit norm.
        sigma: (m, 3) standard deviations of its position [m]; None: those of the target.
        sigma_rotation: (m, 3) standard deviations of its orientation, about the instrument's axes [rad]; None: those
            of the target.
    """
    base = np.hstack([position, quaternion])
    turn = Rotation.from_quat(quaternion)
    lever = block.position - position
    R_base_instrument = turn.inv().as_matrix()
    changes: dict[str, object] = {"position": turn.inv().apply(lever), "base": base}
    if block.late is not None:
        changes["late"] = np.einsum("mij,mkj->mki", R_base_instrument, block.late)
    target_rotation = None
    if isinstance(block, Poses):
        target_rotation = block.sigma_rotation
        rotation = turn.inv() * Rotation.from_quat(block.quaternion)
        changes["quaternion"] = rotation.as_quat(canonical=True)

    is_assumed = sigma is None or (sigma_rotation is None and target_rotation is not None)
    sigma = block.sigma if sigma is None else sigma
    sigma_rotation = target_rotation if sigma_rotation is None else sigma_rotation
    changes["base_sigma"] = _stacked(sigma, sigma_rotation, len(block))
    note = "positions are relative to the base frame measured with each row"
    if is_constant(base):
        sigma = sigma_rotation = np.zeros((len(block), 3))
    elif is_assumed:
        note += "; its noise is assumed equal to the target's"
    if target_rotation is not None:
        covariance = _diagonal(target_rotation)
        if sigma_rotation is not None:
            covariance = covariance + _diagonal(sigma_rotation)
        changes["sigma_rotation"] = _rotated_sigma(R_base_instrument, covariance)
    if block.sigma is not None:
        covariance = _diagonal(block.sigma)
        if sigma is not None:
            covariance = covariance + _diagonal(sigma)
        if sigma_rotation is not None:
            # [l]×, its columns l × e
            cross = np.swapaxes(np.cross(lever[:, None], np.eye(3)), 1, 2)
            covariance = covariance + cross @ _diagonal(sigma_rotation) @ np.swapaxes(cross, 1, 2)
        changes["sigma"] = _rotated_sigma(R_base_instrument, covariance)
    return replace(block, notes=(*block.notes, note), **changes)


def _stacked(sigma: np.ndarray | None, sigma_rotation: np.ndarray | None, rows: int) -> np.ndarray:
    """Return the sigmas (m, 6) of position and orientation; NaN where not known.

    Args:
        sigma: (m, 3) standard deviations of the position [m]; None if not known.
        sigma_rotation: (m, 3) standard deviations of the orientation [rad]; None if not known.
        rows: number m of rows.
    """
    unknown = np.full((rows, 3), np.nan)
    parts: Sequence[np.ndarray | None] = (sigma, sigma_rotation)
    return np.hstack([unknown if part is None else part for part in parts])


def _diagonal(sigma: np.ndarray) -> np.ndarray:
    return np.einsum("mi,ij->mij", sigma**2, np.eye(3))


def _rotated_sigma(rotation: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the standard deviations (m, 3) along rotated axes, from covariances (m, 3, 3) and rotations (m, 3, 3)."""
    return np.sqrt(np.einsum("mij,mjk,mik->mi", rotation, covariance, rotation))

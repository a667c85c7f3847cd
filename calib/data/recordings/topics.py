"""Rows of several topics in one table, or in two files: brought to the times of one of them.

Exports of several ROS topics to one table (PlotJuggler) have one row per message, whose cells of all other topics are
empty. The rows with positions count; torques and velocities of other rows are interpolated linearly at their times.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib.data.csv_table import Table
from calib.records import interpolated

# Longest time over which values are interpolated, in median steps of the series, and at least [s] (our choice).
MAX_STEPS, MIN_GAP = 5.0, 0.01
# Largest difference of two stamps of one instant [s]: rounding of times since 1970.
SAME_TIME = 1e-6


def of_one_topic(
    table: Table, columns_of: Mapping[str, Sequence[int]], t: np.ndarray
) -> tuple[Table, np.ndarray, list[str]]:
    """Return the rows that have positions with the other series at their times, the rows' times, and notes.

    Args:
        table: the table.
        columns_of: columns of each series, by the toolkit's name; ``q`` among them.
        t: (N,) times of the rows [s].
    """
    filled = {}
    for series, columns in columns_of.items():
        cells = [table.cells[column] for column in columns]
        if series == "t" or any(column.dtype != float for column in cells):
            continue
        filled[series] = ~np.isnan(np.stack(cells)).all(axis=0)
    with_positions = filled.get("q", np.ones(len(t), bool))
    if with_positions.all() or not with_positions.any():
        return table, t, []
    notes = [f"{int((~with_positions).sum())} rows without positions are not used (empty, or of another topic)"]
    table_cells = list(table.cells)
    complete = with_positions.copy()
    for series, rows in filled.items():
        needed = with_positions & ~rows
        if not needed.any() or not (rows & ~with_positions).any():
            continue
        order = np.flatnonzero(rows)[np.argsort(t[rows], kind="stable")]
        columns = list(columns_of[series])
        values = np.column_stack([table.cells[column][order] for column in columns])
        interpolated = at_times(t[order], values, t[needed])
        for column, cells in zip(columns, interpolated.T):
            table_cells[column] = table_cells[column].copy()
            table_cells[column][needed] = cells
        complete[needed] &= ~np.isnan(interpolated).any(axis=1)
        notes.append(f"{series} is of other rows: interpolated at the times of the positions")
    missing = int((with_positions & ~complete).sum())
    if missing:
        notes.append(f"{missing} rows are not used, since other quantities have no sample near their times")
    return replace(table, cells=tuple(table_cells)).where(complete), t[complete], notes


def at_times(t: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return values (m, k) linearly interpolated at `times` (m,); NaN outside and in gaps.

    A gap is longer than `MAX_STEPS` median steps and than `MIN_GAP`.

    Args:
        t: (N,) times of the values [s], rising.
        values: (N, k) values.
        times: (m,) times of the result [s].
    """
    if len(t) < 2:
        return np.full((len(times), values.shape[1]), np.nan)
    max_gap = max(MAX_STEPS * float(np.median(np.diff(t))), MIN_GAP)
    after = np.clip(np.searchsorted(t, times), 1, len(t) - 1)
    distance = np.minimum(np.abs(t[after] - times), np.abs(times - t[after - 1]))
    in_gap = (t[after] - t[after - 1] > max_gap) & (distance > SAME_TIME)
    in_gap |= (times < t[0] - SAME_TIME) | (times > t[-1] + SAME_TIME)
    result = interpolated(times, t, values)
    result[in_gap] = np.nan
    return result

"""Placeholders that instruments and programs write where a target was not seen.

The three cells of a position are all empty, hold the same text (``---``, ``lost``) or the same large number
(``9999``): no instrument measures a position whose three coordinates agree in all digits. Zeros count if the
orientation is zeros, too; of zeros in positions alone the arm's geometry tells (`calib.geometry.checks.readings`).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.data.csv_table import Table
from calib.data.poses.columns import Layout, Sheet
from calib.errors import listing
from calib.records import frozen
from calib.units import is_number

# smallest equal coordinates, in the file's unit, that are a placeholder (our choice)
MIN_PLACEHOLDER = 900.0
# texts that spreadsheets write for an error: cells to be corrected, not targets that were not seen
ERRORS = "#"


def without_placeholders(sheet: Sheet, layout: Layout) -> tuple[Sheet, tuple[str, ...]]:
    """Return the sheet without placeholders, and notes that name their columns and rows.

    The rows of a single target are left out; of several targets, the cells become empty.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
    """
    table = sheet.table
    notes = []
    cells = list(table.cells)
    single = len(layout.positions) == 1
    for names in layout.positions:
        orientation = layout.orientation if single else ()
        unseen = _placeholders(table, names, orientation, single)
        if layout.base or not unseen.any() or unseen.all():
            continue
        rows = listing(table.rows[unseen].tolist(), 8)
        notes.append(f"{', '.join(names)}: not seen in row(s) {rows}, which hold {_written(table, names, unseen)}")
        if single:
            return replace(sheet, table=table.where(~unseen)), tuple(notes)
        for name in names:
            cells[table.index(name)] = _emptied(cells[table.index(name)], unseen)
    return replace(sheet, table=replace(table, cells=tuple(cells))), tuple(notes)


def _placeholders(table: Table, names: Sequence[str], orientation: Sequence[str], single: bool) -> np.ndarray:
    """Return which rows (m,) hold a placeholder instead of a position.

    Args:
        table: the table.
        names: the names of the position's columns.
        orientation: the names of the orientation's columns; () without one.
        single: whether the table has no other target, so that an empty position is a row without measurement.
    """
    columns, are_numbers = _cells(table, names)
    if are_numbers:
        x, y, z = columns
        unseen = (x == y) & (y == z) & (np.abs(x) >= MIN_PLACEHOLDER)
        if single:
            unseen |= np.isnan(x) & np.isnan(y) & np.isnan(z)
        turns, are_numbers = _cells(table, orientation)
        if turns and are_numbers:
            unseen |= ~np.any([*columns, *turns], axis=0)
        return unseen
    texts = list(map(table.texts, names))
    unseen = []
    for x, y, z in zip(*texts):
        empty = x in ("", "nan")
        marked = not empty and not x.startswith(ERRORS) and _is_mark(x)
        unseen.append(x == y == z and (marked or (empty and single)))
    return np.array(unseen)


def _cells(table: Table, names: Sequence[str]) -> tuple[list[np.ndarray], bool]:
    """Return the cells of columns, and whether all of them are numbers or empty."""
    columns = [table.cells[table.index(name)] for name in names]
    return columns, all(column.dtype == float for column in columns)


def _is_mark(text: str) -> bool:
    return not is_number(text) or abs(float(text)) >= MIN_PLACEHOLDER


def _written(table: Table, names: Sequence[str], unseen: np.ndarray) -> str:
    """Return what the first placeholder is, for a note.

    Args:
        table: the table.
        names: the names of the position's columns.
        unseen: which rows (m,) hold a placeholder.
    """
    row = int(np.flatnonzero(unseen)[0])
    text = table.texts(names[0])[row]
    return "nothing" if text in ("", "nan") else f"'{text}' three times"


def _emptied(column: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """Return a column with empty cells in the rows (m,) of `unseen`; numbers where all others are numbers.

    Args:
        column: cells of the column.
        unseen: mask of the rows.
    """
    if column.dtype == float:
        return frozen(np.where(unseen, np.nan, column))
    texts = np.where(unseen, "", column)
    if all(not text or is_number(text) for text in texts):
        return frozen([float(text or "nan") for text in texts])
    return texts

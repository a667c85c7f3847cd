"""Tables without names: which columns may be joints, positions and orientations, by their number and their values.

Behind up to three texts and a counter stand the joints before or behind the target: x y z alone, with three angles, a
quaternion (w last or first), nine elements of a rotation, or a whole matrix 3x4 or 4x4 by rows (DELMIA's Auto ID: tag,
x y z, roll pitch yaw, joints). Which arrangement it is, the nominal arm tells
(`calib.procedure.kinematic_stage.undecided_files`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.data.csv_table import Table
from calib.data.poses.exports import unnamed_table
from calib.data.poses.fit_options import FileOptions
from calib.errors import MeasurementError

POSITION = ("x", "y", "z")
ANGLES = ("rx", "ry", "rz")
W_LAST = ("qx", "qy", "qz", "qw")
W_FIRST = ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
# a matrix by rows, with the position in its last column; "" for a column that is not read
ROWS = ("r11", "r12", "r13", "x", "r21", "r22", "r23", "y", "r31", "r32", "r33", "z")
TARGETS = (
    POSITION,
    (*POSITION, *ANGLES),
    (*POSITION, *W_LAST),
    (*POSITION, *W_FIRST),
    (*POSITION, *MATRIX),
    ROWS,
    (*ROWS, "", "", "", ""),
)


def arrangements(path: str | Path, joints: int, options: FileOptions) -> tuple[Table, dict[str, FileOptions]] | None:
    """Return a file without names as a table, and the options of each possible arrangement of its columns.

    None for a file with names, or with a number of columns that no arrangement has. An arrangement's key is the line of
    names that would state it.

    Args:
        path: the file.
        joints: number of the robot's joints.
        options: options for reading the file.
    """
    try:
        table = unnamed_table(path)
    except (OSError, MeasurementError):
        return None
    if table is None:
        return None
    numbers = [name for name, cells in zip(table.header, table.cells) if cells.dtype == float]
    if len(numbers) < joints + len(POSITION):
        return None
    choices = {}
    for names in _orders(table, numbers, joints):
        columns = {standard_names: column for standard_names, column in names.items() if standard_names}
        heading = [""] * len(table.header)
        for standard_names, column in columns.items():
            heading[table.header.index(column)] = standard_names
        for index, name in enumerate(table.header):
            heading[index] = heading[index] or name
        choices[",".join(heading)] = replace(options, columns={**columns, **options.columns})
    if not choices:
        return None
    return table, choices


def _orders(table: Table, numbers: Sequence[str], joints: int) -> Iterator[dict[str, str]]:
    """Yield the toolkit's names of columns → the table's, for each arrangement that takes all columns of numbers.

    Args:
        table: the table.
        numbers: names of the columns of numbers.
        joints: number of the robot's joints.
    """
    q = tuple(f"q{number}" for number in range(1, joints + 1))
    counted = _is_counter(table.cells[table.header.index(numbers[0])])
    for target in TARGETS:
        for standard_names in ((*target, *q), (*q, *target)):
            if len(standard_names) == len(numbers):
                yield dict(zip(standard_names, numbers))
            elif counted and len(standard_names) == len(numbers) - 1:
                yield dict(zip(standard_names, numbers[1:]))


def _is_counter(values: np.ndarray) -> bool:
    """Return whether numbers (m,) rise in equal steps, as the numbers of rows or the times of samples do."""
    steps = np.diff(values)
    return len(steps) > 1 and bool(np.all(steps > 0) and np.allclose(steps, steps[0]))

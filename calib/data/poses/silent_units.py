"""Units of columns whose names come from a controller or another program, where the header states none.

The toolkit's own names (``q1``, a joint's name, ``x``) without a unit are SI. Controllers show deg and mm, programs
write rad and m: where most rows are impossible in SI, the columns are deg or mm, and the notes say so. A name may hold
its unit as a word (``x_mm``, ``J1 deg``).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.data.joint_columns import words_of
from calib.data.poses.columns import Layout, Sheet, Undecided
from calib.data.schema import BOUNDS, Joints
from calib.errors import listing
from calib.units import ANGLES, COUNT_WORDS

# share of rows that must be impossible in SI (our choice)
MOST_ROWS = 0.5
# encoders' usual counts per turn: powers of two, and thousands of lines or of degrees (our choice)
COUNTS_PER_TURN = (*(2**bits for bits in range(10, 25)), 1000, 2000, 4000, 8000, 10_000, 20_000, 36_000, 360_000)
# largest value of a joint in deg: two turns
MAX_DEGREES = 720.0
# units that are recognised as a word of a name; single letters are not
WORD_UNITS = ("mm", "cm", "um", "deg", "degrees", "rad", "mrad")
SI = {"deg": "rad", "mm": "m"}


def with_silent_units(sheet: Sheet, layout: Layout, robot: Joints) -> tuple[Sheet, tuple[str, ...]]:
    """Return the sheet with units for columns of foreign names, and notes on those that were concluded from numbers.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
        robot: names, types and limits of the joints.

    Raises:
        Undecided: angles of an orientation that may be rad or deg beside joints in deg; joints in encoder counts.
    """
    _ask_for_counts(sheet, layout, robot)
    sheet = _with_units_of_names(sheet, layout)
    if sheet.has_our_names(layout.joints, robot.names, mapped=False) and not _is_mapped(sheet, layout):
        return sheet, ()
    turning: list[str] = []
    sliding: list[str] = []
    for name, kind in zip(layout.joints, robot.kinds):
        names = sliding if kind == "prismatic" else turning
        names.append(name)
    families = [(turning, "joints", "deg", BOUNDS.max_turn), (sliding, "joints", "mm", _travel(robot))]
    families += [(list(names), "position", "mm", BOUNDS.max_length) for names in layout.positions]
    if len(layout.orientation) == 3:
        families.append((list(layout.orientation), "orientation", "deg", BOUNDS.max_turn))
    units = dict(sheet.options.units)
    notes = []
    for names, family, unit, limit in families:
        silent = bool(names) and not any(sheet.unit(name, family) for name in names)
        if silent and _share_above(sheet, names, limit) > MOST_ROWS:
            units |= dict.fromkeys(names, unit)
            notes.append(f"{', '.join(names)}: no unit stated, read in {unit}; in {SI[unit]} they are impossible")
    read = replace(sheet, options=replace(sheet.options, units=units))
    _ask_for_angles(read, layout, turning)
    return read, tuple(notes)


def _ask_for_counts(sheet: Sheet, layout: Layout, robot: Joints) -> None:
    """Raise `Undecided` for turning joints whose values are whole numbers that no joint reaches in deg.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
        robot: types of the joints.
    """
    turning = [name for name, kind in zip(layout.joints, robot.kinds) if kind != "prismatic"]
    units = {sheet.unit(name, "joints").lower() for name in turning}
    if not turning or not units <= {"", *COUNT_WORDS}:
        return
    cells = [sheet.table.cells[sheet.table.index(name)] for name in turning]
    if any(column.dtype != float for column in cells):
        return
    counts = np.column_stack(cells)
    if (counts % 1.0 != 0.0).any() or _share_above(sheet, turning, MAX_DEGREES) <= MOST_ROWS:
        return
    encoders = [f"counts/{per_turn}@{zero}" for per_turn in COUNTS_PER_TURN for zero in (0, per_turn // 2)]
    choices = {}
    for unit in (*encoders, *["mrad"] * ("" in units)):
        stated = {**sheet.options.units, **dict.fromkeys(turning, unit)}
        choices[f"units = {{ joints = '{unit}' }}"] = replace(sheet.options, units=stated)
    message = (
        f"{listing(turning, 3)} are whole numbers, too large for deg: encoder counts? One line in the options states "
        "the counts per turn and the count at the joints' zero: units = { joints = 'counts/4096@2048' }; joint by "
        f"joint: units = {{ {turning[0]} = 'counts/4096@2048', ... }}"
    )
    raise Undecided(sheet.table, message, choices, turning[0])


def _with_units_of_names(sheet: Sheet, layout: Layout) -> Sheet:
    """Return the sheet with the units that stand as words in the names of columns without a unit.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
    """
    families = [(layout.joints, "joints"), (layout.orientation, "orientation")]
    families += [(names, "position") for names in layout.positions]
    units = dict(sheet.options.units)
    for names, family in families:
        for name in names:
            terms = list(filter(WORD_UNITS.__contains__, words_of(name)))
            if len(terms) == 1 and not sheet.unit(name, family):
                units[name] = terms[0]
    return replace(sheet, options=replace(sheet.options, units=units))


def _is_mapped(sheet: Sheet, layout: Layout) -> bool:
    """Return whether a position or an orientation was told from the shape of its names.

    Args:
        sheet: the table with its options, into which the shapes' columns were written.
        layout: the columns to read.
    """
    names = [*layout.orientation]
    for position in layout.positions:
        names += position
    return not set(names).isdisjoint(sheet.options.columns.values())


def _travel(robot: Joints) -> float:
    """Return the largest travel [m] of the robot's prismatic joints; that of any robot where a limit is unknown.

    Args:
        robot: types and limits of the joints.
    """
    travel = 0.0
    for kind, lower, upper in zip(robot.kinds, robot.lower, robot.upper):
        if kind == "prismatic":
            travel = np.maximum(travel, max(abs(lower), abs(upper)))
    return float(np.fmin(travel + BOUNDS.limit_slack, BOUNDS.max_length))


def _share_above(sheet: Sheet, names: Sequence[str], limit: float) -> float:
    """Return the share of rows with a number above `most` in one of the columns, among rows with numbers.

    Args:
        sheet: the table.
        names: the file's names of the columns.
        limit: largest possible absolute value.
    """
    columns = [np.abs(sheet.table.numbers(name, None, gaps=True)) for name in names]
    largest = np.max(np.stack(columns), axis=0)
    largest = largest[np.isfinite(largest)]
    return float(np.sum(largest > limit)) / max(len(largest), 1)


def _ask_for_angles(sheet: Sheet, layout: Layout, turning: Sequence[str]) -> None:
    """Raise `Undecided` for small angles of an orientation without a unit beside joints in deg.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
        turning: the file's names of the columns of turning joints.
    """
    joint_units = {ANGLES.get(sheet.unit(name, "joints")) for name in turning}
    silent = len(layout.orientation) == 3 and not sheet.unit(layout.orientation[0], "orientation")
    if not silent or joint_units != {ANGLES["deg"]}:
        return
    choices = {}
    for unit in ("deg", "rad"):
        units = {**sheet.options.units, "orientation": unit}
        choices[f"units = {{ orientation = '{unit}' }}"] = replace(sheet.options, units=units)
    lines = " or ".join(choices)
    message = (
        f"{', '.join(layout.orientation)} have no unit and may be either: one line in the options says it: {lines}"
    )
    raise Undecided(sheet.table, message, choices, layout.orientation[0])

"""Columns and units that the options of `calib join` state: [columns] and [units], as for `calib fit` and `identify`.

::

    [columns]                 # our name = the file's, in whichever of the two files has it
    q1 = "A1"                 # a joint's position, by its number or name
    x = "X_leica"
    torque = "{joint} load"   # of a log: a quantity of all joints; {joint} stands for each joint's name or number
    [units]                   # of columns whose header states none
    joints = "deg"            # or one column (q1), position, torque, current
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from calib.apps.joining.joined import CLOCKS
from calib.config import parse, read_toml, strict
from calib.config_types import Name, Text
from calib.errors import MeasurementError, suggestion
from calib.toolkit.pose_data import OURS, POSITION, Table
from calib.toolkit.recordings import SYNONYMS

PLACEHOLDER = re.compile(r"\{(?:joint|n)\}")
# units of groups of columns: name of the group → expression that their names match
GROUPS = {"position": "|".join(POSITION.names), "joints": r"q(\d+|_.+)"}
for _series in SYNONYMS:
    GROUPS[_series] = rf"{_series}_.+"


@strict
@dataclass(frozen=True)
class JoinOptions:
    """Names and units of columns.

    Attributes:
        columns: the toolkit's name → the file's name.
        units: the toolkit's name, or a group of columns → unit.
    """

    columns: Mapping[str, Name] = field(default_factory=dict)
    units: Mapping[str, Text] = field(default_factory=dict)


def read_mapping(path: Path | None) -> JoinOptions:
    """Return the options in the TOML file at `path`; keys that only `calib fit` and `identify` need are passed over.

    Raises:
        UsageError: a missing file, or invalid tables.
    """
    if path is None:
        return JoinOptions()
    tables = read_toml(path)
    mapping = {}
    for key in ("columns", "units"):
        if key in tables:
            mapping[key] = tables[key]
    return parse(JoinOptions, mapping, str(path))


def clock_names(columns: Mapping[str, str]) -> JoinOptions:
    """Return the options that name the columns of times alone.

    Args:
        columns: the toolkit's name of a column → the file's.
    """
    clocks = {name: heading for name, heading in columns.items() if name in CLOCKS}
    return JoinOptions(clocks)


def mapped(tables: tuple[Table, Table], options: JoinOptions) -> tuple[tuple[Table, Table], list[str]]:
    """Return two tables with the names and units that the options state, and notes on them.

    Raises:
        MeasurementError: a heading that neither table has, or a unit for no column.
    """
    headings = [*tables[0].header, *tables[1].header]
    for name, heading in options.columns.items():
        if not any(list(_matches(table, name, heading)) for table in tables):
            message = f"[columns] {name} = '{heading}' is in neither file{suggestion(heading, headings)}"
            raise MeasurementError(f"{message}; found: {', '.join(headings)}", tables[0].file)
    first, second = (with_options(table, options) for table in tables)
    names = (*first.header, *second.header)
    for name in options.units:
        if not any(_group(name).fullmatch(heading) for heading in names):
            raise MeasurementError(f"[units] {name}: no column of this name; found: {', '.join(names)}", first.file)
    notes = []
    for table, renamed in zip(tables, (first, second)):
        entries = []
        for new, old in zip(renamed.header, table.header):
            if new != old:
                entries.append(f"{new} = '{old}'")
        if entries:
            notes.append(f"{table.file}: read as {', '.join(entries)}")
    return (first, second), notes


def with_options(table: Table, options: JoinOptions) -> Table:
    """Return a table with the names and units that the options state, as far as it has those columns."""
    header = list(table.header)
    for name, heading in options.columns.items():
        for column, new in _matches(table, name, heading):
            header[column] = new
    units = list(table.units)
    for name, unit in options.units.items():
        for column, heading in enumerate(header):
            if _group(name).fullmatch(heading) and not units[column]:
                units[column] = unit
    return replace(table, header=tuple(header), units=tuple(units))


def _group(name: str) -> re.Pattern[str]:
    """Return the expression for the columns to which a unit of this name applies."""
    return re.compile(GROUPS.get(name, re.escape(name)))


def _matches(table: Table, name: str, heading: str) -> Iterator[tuple[int, str]]:
    """Yield the index and the new name of each column of a table that the options mean by `name` = `heading`."""
    if heading in table.header:
        yield table.header.index(heading), name
        return
    expression = ""
    if PLACEHOLDER.search(heading):
        start, end = PLACEHOLDER.split(heading, 1)
        expression = f"{re.escape(start)}(.+){re.escape(end)}"
    elif name in SYNONYMS and name not in OURS:
        expression = f"{re.escape(heading)}[\\W_]*(.+)"
    if not expression:
        return
    for column, old in enumerate(table.header):
        match = re.fullmatch(expression, old)
        if match:
            yield column, f"{name}_{match[1]}"

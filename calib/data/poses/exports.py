"""Text exports of instruments, read as the tables of `calib formats measurements` are.

Read from the numbers up: the separator (tab, semicolon, bar, comma, blanks) and the decimal mark with which most cells
are numbers; above them a row of names, a row of units, rows of quantities and objects (motion capture), and whatever a
program says of itself (comments ``#``, ``//``, ``%``, ``!``; ``Units: inches``). ``X``, ``Measured X`` or ``X_actual``
are ``x``; several triples are ``x1 y1 z1 x2 …``; of one rigid body among markers only its own pose is read. Without
names, texts first are collection, group and name, and the three numbers behind them x, y, z. Angles are ``rx ry rz``:
the options' ``euler`` says about which axes, fixed or moving. Each file so read says so in its notes.

Known by their first line: SpatialAnalyzer (``//``), OptiTrack Motive and Vicon; sources are in ``presets.toml``. Of
PolyWorks, Leica, FARO CAM2, API, Creaform VXelements and Zeiss no published description was found: their files are read
by the rules above.
"""

from __future__ import annotations

import csv
import io
import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from calib.data.csv_table import MINUS, Table, as_column, encoding_of
from calib.data.poses.columns import SUFFIXES
from calib.data.poses.robodk import recognises
from calib.errors import listing
from calib.records import frozen

# Letters of a file in which its numbers begin (our choice).
HEAD = 1 << 16
# Rows of numbers, alike, that make a table (or as many as there are).
ROWS = 3
# Lines, without comments, in which the numbers begin (our choice).
BEGIN = 60
# Letters of a title that a note quotes.
TITLE = 40
# Rows above the numbers that may name columns.
STACK = 7
# Least number of numbers in a row, and least share of its cells.
MIN_NUMBERS = 3
MIN_NUMBER_SHARE = 0.3
COMMENTS = ("#", "//", "%", "!")
UNITS = {
    **dict.fromkeys(("in", "inch", "inches", '"'), "in"),
    **dict.fromkeys(("s", "sec", "seconds"), "s"),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("rad", "radians"), "rad"),
    **dict.fromkeys(("cm", "centimeter", "centimeters"), "cm"),
    **dict.fromkeys(("deg", "degree", "degrees", "°", "grad", "grados", "gradi"), "deg"),
}
_STATED = re.compile(r"(?i)\b(?:length )?units?\b[\s:=,;]*([a-z]+)")
_NUMBER = {mark: re.compile(rf"[+-]?(\d+\{mark}?\d*|\{mark}\d+)([eE][+-]?\d+)?|nan") for mark in ".,"}
_HEADING = re.compile(r"^(.*?)\s*[\[(]([^\[\]()]*)[\])]$")
_AXIS = re.compile(r"(?:actual|measured|meas|position|pos)?([xyz])(?:actual|measured|meas|position|pos|coordinate)?")
_TURN = re.compile(r"[rq][xyzw]")


class InstrumentExport(io.StringIO):
    """An instrument's file, rewritten as the text of a CSV table, with notes on how it was read."""

    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Grid:
    """Position of the numbers in a text.

    Attributes:
        separator: separator of cells.
        mark: decimal mark.
        first: index of the first line of numbers.
        cells: cells of this line.
        above: cells of the lines above it.
    """

    separator: str
    mark: str
    first: int
    cells: tuple[str, ...]
    above: tuple[tuple[str, ...], ...]

    @property
    def numeric(self) -> list[bool]:
        """For each cell of the first line of numbers, whether it is a number."""
        return _numeric(self.cells, self.mark)


@cache
def presets() -> dict[str, dict[str, str]]:
    """Return the known exports by name, as the tables of ``presets.toml``."""
    return tomllib.loads(Path(__file__).with_name("presets.toml").read_text(encoding="utf-8"))


def translated(path: str | Path) -> InstrumentExport | None:
    """Return an instrument's file as the text of a CSV table.

    None if the file is a CSV table already, or has no positions and no decimal commas.

    Args:
        path: the file.
    """
    with open(path, "rb") as file:
        beginning = file.read(HEAD)
        encoding = encoding_of(beginning)
        head = beginning.decode(encoding, errors="replace").replace(MINUS, "-")
        lines = head.splitlines()
        grid = _grid(lines)
        if grid is None:
            return None
        names, units, differs = _columns(grid)
        has_commas = grid.mark == "," and bool(names)
        if not recognises(names) and not _is_ours(names) and not has_commas and not _has_title(lines, grid, names):
            return None
        preset = _preset(lines)
        is_plain = not preset and grid.mark == "." and encoding != "utf-16" and not differs
        if is_plain and _first_content(lines) == grid.first - 1:
            return None
        text = (beginning + file.read()).decode(encoding, errors="replace").replace(MINUS, "-")

    length_unit = _length_unit(preset, head, lines[: grid.first])
    export = InstrumentExport()
    writer = csv.writer(export, lineterminator="\n")
    columns = [k for k, name in enumerate(names) if name]
    header = []
    for k in columns:
        unit = units[k]
        if not unit and re.fullmatch(r"[xyz]\d*", names[k]):
            unit = length_unit
        header.append(f"{names[k]} [{unit}]" if unit else names[k])
    writer.writerow(header)
    for row in _rows(text.splitlines()[grid.first :], grid):
        writer.writerow([row[k] for k in columns] if len(row) == len(names) else row)
    export.seek(0)

    note = f"read as {preset['says']}" if preset else "read as an instrument's export"
    if grid.mark == ",":
        note += ", decimal commas"
    if length_unit:
        note += f", lengths in {length_unit}"
    left_out = () if preset else _left_out(lines, grid)
    export.notes = (f"{note}: columns {', '.join(filter(None, names))}", *left_out)
    return export


def _has_title(lines: Sequence[str], grid: Grid, names: Sequence[str]) -> bool:
    """Return whether a line of one cell stands above a complete row of names: as CSV the file cannot be read.

    Args:
        lines: the text's lines.
        grid: position of its numbers.
        names: names of the columns.
    """
    first = _first_content(lines)
    return first < grid.first - 1 and all(names) and bool(names) and len(_split(lines[first], grid.separator)) == 1


def unnamed_table(path: str | Path) -> Table | None:
    """Return a file of numbers without a row of names as a table with columns ``column 1``, ``column 2`` ….

    None for a file with names, and for what is no regular file, which reading the header refuses.

    Args:
        path: the file.
    """
    if not Path(path).is_file():
        return None
    with open(path, "rb") as file:
        content = file.read(HEAD)
        encoding = encoding_of(content)
        lines = content.decode(encoding, errors="replace").splitlines()
        grid = _grid(lines)
        if grid is None or _headings(grid) or _named_by_comment(lines[: grid.first], grid):
            return None
        if any(_number_count(line, grid) for line in lines[: grid.first]):
            return None
        content += file.read()
    lines = content.decode(encoding, errors="replace").splitlines()
    rows = [row for row in _rows(lines[grid.first :], grid) if len(row) == len(grid.cells)]
    header = tuple(f"column {number + 1}" for number in range(len(grid.cells)))
    cells = list(map(as_column, zip(*rows)))
    numbers = frozen(np.arange(1, len(rows) + 1), int)
    return Table(str(path), header, ("",) * len(header), tuple(cells), numbers, _left_out(lines, grid))


def _preset(lines: Sequence[str]) -> dict[str, str]:
    """Return the preset of the known export whose files begin with these lines; {} for another file."""
    first_line = ""
    for line in lines:
        if line.strip():
            first_line = line
            break
    for preset in presets().values():
        if re.match(preset["head"], first_line):
            return preset
    return {}


def _first_content(lines: Sequence[str]) -> int:
    """Return the index of the first line that is neither empty nor begins with ``#``; 0 if there is none."""
    for index, line in enumerate(lines):
        if line.strip() and not line.startswith("#"):
            return index
    return 0


def _length_unit(preset: dict[str, str], head: str, preamble: Sequence[str]) -> str:
    """Return the unit of lengths that a file states before its numbers; "" if there is none.

    Args:
        preset: preset of the file's format; {} for an unknown format.
        head: first line of the file.
        preamble: lines before the numbers.
    """
    if "unit" in preset:
        match = re.search(preset["unit"], head)
        if match:
            return UNITS.get(match[1].lower(), "")
    for line in preamble:
        match = _STATED.search(line)
        if match:
            return UNITS.get(match[1].lower(), "")
    return ""


def _grid(lines: Sequence[str]) -> Grid | None:
    """Return the position of a text's numbers; None if the text has no numbers.

    The separator is the one that makes most cells of a line numbers.
    """
    content = [(i, line) for i, line in enumerate(lines) if _is_content(line)]
    best, best_count = None, MIN_NUMBERS - 1
    for separator in "\t;|, ":
        rows = [_split(line, separator) for _, line in content[:BEGIN]]
        for mark in ".," if separator != "," else ".":
            counts = [sum(_numeric(row, mark)) for row in rows]
            first = _first_of_numbers(rows, counts)
            if first is not None and counts[first] > best_count:
                best_count = counts[first]
                row = rows[first]
                above = []
                for upper_row in rows[max(first - STACK, 0) : first]:
                    if len(upper_row) <= len(row):
                        padding = [""] * (len(row) - len(upper_row))
                        above.append((*upper_row, *padding))
                best = Grid(separator, mark, content[first][0], tuple(row), tuple(above))
    return best


def _first_of_numbers(rows: Sequence[Sequence[str]], counts: Sequence[int]) -> int | None:
    """Return the index of the first row that begins a series of rows of numbers; None if there is none.

    Args:
        rows: cells of each row; all rows of a series have equal length.
        counts: number of numeric cells in each row.
    """
    for k, row in enumerate(rows):
        if counts[k] < MIN_NUMBER_SHARE * len(row):
            continue
        same_length = all(len(next_row) == len(row) for next_row in rows[k : k + ROWS])
        if same_length and min(counts[k : k + ROWS]) >= MIN_NUMBERS:
            return k
    return None


def _is_content(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith(COMMENTS)


def _numeric(cells: Sequence[str], mark: str) -> list[bool]:
    """Return for each cell whether it is a number with the decimal mark `mark`."""
    return [bool(_NUMBER[mark].fullmatch(cell)) for cell in cells]


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def _rows(lines: Sequence[str], grid: Grid) -> Iterator[list[str]]:
    """Yield the cells of the rows of numbers, with points as decimal marks.

    Args:
        lines: all lines of the text.
        grid: position of the numbers in the text.
    """
    for line in lines:
        if not _is_content(line):
            continue
        row = _split(line, grid.separator)
        if grid.mark == ",":
            for k, is_number in enumerate(_numeric(row, ",")):
                if is_number:
                    row[k] = row[k].replace(",", ".")
        yield row


def _columns(grid: Grid) -> tuple[list[str], list[str], bool]:
    """Return the toolkit's name and the unit of each column, and whether any name or unit differs from the file's.

    The name is "" for a column that is left out.

    Args:
        grid: position of the numbers in the text, with the cells above them.
    """
    above, width = list(grid.above), len(grid.cells)
    units = [""] * width
    if above and any(above[-1]) and all(cell.lower() in UNITS for cell in above[-1] if cell):
        units = [UNITS[cell.lower()] if cell else "" for cell in above.pop()]
    headings = _headings(replace(grid, above=tuple(above)))
    if not headings:
        names, units = _unnamed(grid)
        return names, units, True
    file_names, file_units = [], []
    for k, heading in enumerate(headings):
        match = _HEADING.match(heading)
        name, unit = match.groups() if match else (heading, "")
        file_names.append(name)
        file_units.append(unit)
        if not units[k]:
            units[k] = UNITS.get(unit.lower(), unit)
    names = file_names
    if not recognises(file_names) and not _is_ours(file_names):
        names = _ours(file_names, above[:-1])
    return names, units, names != file_names or units != file_units


def _headings(grid: Grid) -> tuple[str, ...]:
    """Return the row of names above the numbers; () if there is none, or if it is numbers, too.

    Args:
        grid: position of the numbers in the text, with the cells above them but for a row of units.
    """
    if not grid.above:
        return ()
    headings = grid.above[-1]
    width = len(grid.cells)
    is_named = sum(map(bool, headings)) > width / 2 and sum(_numeric(headings, grid.mark)) <= width / 2
    return headings * is_named


def _named_by_comment(lines: Sequence[str], grid: Grid) -> bool:
    """Return whether a comment above the numbers has as many words as there are columns (numpy's savetxt).

    Args:
        lines: lines above the numbers.
        grid: position of the numbers in the text.
    """
    for line in lines:
        text = line.strip().lstrip("#/%! ")
        if text and len(_split(text, grid.separator)) == len(grid.cells):
            return True
    return False


def _left_out(lines: Sequence[str], grid: Grid) -> tuple[str, ...]:
    """Return notes on the lines above the numbers that name no column: titles, or rows that were run together.

    Args:
        lines: lines of the text.
        grid: position of the numbers in the text.
    """
    indices = [index for index, line in enumerate(lines[: grid.first]) if _is_content(line)]
    understood = int(bool(_headings(grid)))
    if grid.above and all(cell.lower() in UNITS for cell in grid.above[-1] if cell):
        understood = 2
    titles = []
    notes = []
    for index in indices[: len(indices) - understood]:
        beginning = lines[index].strip()[:TITLE]
        count = _number_count(lines[index], grid)
        if count:
            notes.append(
                f"line {index + 1} was left out, with {count} numbers in it: '{beginning} …'; are rows run together, "
                "or is a line break missing?"
            )
        elif not _STATED.search(lines[index]):
            titles.append(f"{index + 1} ('{beginning}')")
    if titles:
        notes.append(f"left out as titles: line(s) {listing(titles, 4)}")
    return tuple(notes)


def _number_count(line: str, grid: Grid) -> int:
    """Return the number of numbers in a line above the numbers, if it may hold a row of them; else 0.

    Args:
        line: the line.
        grid: position of the numbers in the text.
    """
    if not _is_content(line):
        return 0
    count = sum(_numeric(_split(line, grid.separator), grid.mark))
    return count * (count >= max(MIN_NUMBERS, sum(grid.numeric)))


def _is_ours(names: Sequence[str]) -> bool:
    """Return whether the position columns already have names that the toolkit reads.

    Args:
        names: the file's names of the columns.
    """
    suffixes = (*SUFFIXES, "1")
    return any({f"x{suffix}", f"y{suffix}", f"z{suffix}"} <= set(names) for suffix in suffixes)


def _unnamed(grid: Grid) -> tuple[list[str], list[str]]:
    """Return names and units for columns without names: up to three texts, then x, y, z.

    Both lists are empty if the first cell is not a text.

    Args:
        grid: position of the numbers in the text.
    """
    numeric = grid.numeric
    texts = numeric.index(True)
    if not 0 < texts <= 3 or not all(numeric[texts : texts + 3]):
        return [], []
    names = [*("collection", "group", "name")[3 - texts :], "x", "y", "z"]
    names += [f"column {k + 1}" for k in range(len(names), len(numeric))]
    return names, [""] * len(numeric)


def _ours(names: Sequence[str], above: Sequence[Sequence[str]]) -> list[str]:
    """Return the toolkit's names of columns.

    Args:
        names: the file's row of names.
        above: rows above it, with quantities and objects (of motion capture).
    """
    plain_names = [re.sub(r"[^a-z0-9]", "", name.lower()) for name in names]
    is_rotation = [any(row[k].lower() == "rotation" for row in above) for k in range(len(names))]
    axes = []
    for plain_name, rotation in zip(plain_names, is_rotation):
        match = _AXIS.fullmatch(plain_name)
        if plain_name == "w" and rotation:
            axes.append("w")
        else:
            axes.append(match[1] if match else "")
    position_axes = [axis for axis, rotation in zip(axes, is_rotation) if not rotation]
    rotation_axes = [axis for axis, rotation in zip(axes, is_rotation) if rotation]
    if not {"x", "y", "z"} <= set(position_axes):
        return list(names)

    rotation_letter = "q" if "w" in axes else "r"
    # Of one rigid body among markers only its own pose is read.
    several = position_axes.count("x") > 1 and rotation_axes.count("x") != 1
    counts: dict[str, int] = {}
    result: list[str] = []
    for name, plain_name, axis, rotation in zip(names, plain_names, axes, is_rotation):
        if axis and rotation:
            column = "" if several else f"{rotation_letter}{axis}"
        elif axis:
            counts[axis] = counts.get(axis, 0) + 1
            column = f"{axis}{counts[axis]}" if several else axis
        else:
            column = plain_name if _TURN.fullmatch(plain_name) else name
        # Of columns with one name the first is read.
        result.append("" if column in result else column)
    return result

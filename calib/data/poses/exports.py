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
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from calib.data.poses.columns import SUFFIXES
from calib.data.poses.robodk import recognises

HEAD = 1 << 16  # letters of a file in which its numbers begin (our choice)
ROWS = 3  # of numbers, alike, that make a table (or as many as there are)
BEGIN = 60  # lines, without comments, in which the numbers begin (our choice)
STACK = 7  # rows above the numbers that may name columns
COMMENTS = ("#", "//", "%", "!")
UNITS = {
    **dict.fromkeys(("in", "inch", "inches", '"'), "in"),
    **dict.fromkeys(("s", "sec", "seconds"), "s"),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("rad", "radians"), "rad"),
    **dict.fromkeys(("cm", "centimeter", "centimeters"), "cm"),
    **dict.fromkeys(("deg", "degree", "degrees"), "deg"),
}
_STATED = re.compile(r"(?i)\b(?:length )?units?\b[\s:=,;]*([a-z]+)")
_NUMBER = {mark: re.compile(rf"[+-]?(\d+\{mark}?\d*|\{mark}\d+)([eE][+-]?\d+)?|nan") for mark in ".,"}
_HEADING = re.compile(r"^(.*?)\s*[\[(]([^\[\]()]*)[\])]$")
_AXIS = re.compile(r"(?:actual|measured|meas|position|pos)?([xyz])(?:actual|measured|meas|position|pos|coordinate)?")
_TURN = re.compile(r"[rq][xyzw]")


class Export(io.StringIO):
    """A file as the toolkit's own table of text, with notes on how it was read."""

    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Grid:
    """Where a text's numbers are: separator, decimal mark, index of the first line, its cells, and the rows above."""

    separator: str
    mark: str
    first: int
    cells: tuple[str, ...]
    above: tuple[tuple[str, ...], ...]

    @property
    def numeric(self) -> list[bool]:
        """Whether each cell of the first line of numbers is a number."""
        return [bool(_NUMBER[self.mark].fullmatch(cell)) for cell in self.cells]


@cache
def presets() -> dict[str, dict[str, str]]:
    """Return the known exports by name."""
    return tomllib.loads(Path(__file__).with_name("presets.toml").read_text(encoding="utf-8"))


def translated(path: str | Path) -> Export | None:
    """Return the file at `path` as a table of the toolkit; None where it is one already, or no table of positions."""
    with open(path, "rb") as file:
        begin = file.read(HEAD)
        utf16 = begin[:2] in (b"\xff\xfe", b"\xfe\xff")
        head = begin.decode("utf-16" if utf16 else "utf-8-sig", errors="replace")
        lines = head.splitlines()
        first = next((line for line in lines if line.strip()), "")
        known: dict[str, Any] = next((each for each in presets().values() if re.match(each["head"], first)), {})
        if (grid := _grid(lines)) is None:
            return None
        preamble = lines[: grid.first]
        names, units, said = _columns(grid)
        stated = re.search(known["unit"], head) if "unit" in known else None
        stated = stated or next(filter(None, map(_STATED.search, preamble)), None)
        length = UNITS.get(stated[1].lower(), "") if stated else ""
        plain = not known and grid.mark == "." and not utf16 and not said
        begins = next((i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")), 0)
        if not (recognises(names) or _is_ours(names)) or (plain and begins == grid.first - 1):
            return None
        text = (begin + file.read()).decode("utf-16" if utf16 else "utf-8-sig", errors="replace")
    units = [length if not unit and re.fullmatch(r"[xyz]\d*", name) else unit for name, unit in zip(names, units)]
    found = Export()
    out = csv.writer(found, lineterminator="\n")
    kept = [k for k, name in enumerate(names) if name]
    out.writerow([f"{names[k]} [{units[k]}]" if units[k] else names[k] for k in kept])
    for row in _rows(text.splitlines()[grid.first :], grid):
        out.writerow([row[k] for k in kept] if len(row) == len(names) else row)
    found.seek(0)
    how = f"read as {known['says']}" if known else "read as an instrument's export"
    comma = ", decimal commas" if grid.mark == "," else ""
    found.notes = (
        f"{how}{comma}{f', lengths in {length}' if length else ''}: columns {', '.join(filter(None, names))}",
    )
    return found


def _grid(lines: Sequence[str]) -> Grid | None:
    """Return where the numbers of a text begin, with the separator that makes most cells of a line numbers."""
    kept = [(i, line) for i, line in enumerate(lines) if line.strip() and not line.lstrip().startswith(COMMENTS)]
    best, most = None, 2
    for separator in "\t;|, ":
        cells = [(i, _split(line, separator)) for i, line in kept[:BEGIN]]
        for mark in ".," if separator != "," else ".":
            counts = [sum(bool(_NUMBER[mark].fullmatch(cell)) for cell in row) for _, row in cells]
            for k, (i, row) in enumerate(cells):
                near = zip(cells[k : k + ROWS], counts[k:])
                alike = all(len(other) == len(row) and count >= 3 for (_, other), count in near)
                if alike and counts[k] >= 0.3 * len(row):
                    if counts[k] > most:
                        above = [other for _, other in cells[max(k - STACK, 0) : k]]
                        wide = [(*other, *[""] * (len(row) - len(other))) for other in above if len(other) <= len(row)]
                        best, most = Grid(separator, mark, i, tuple(row), tuple(wide)), counts[k]
                    break
    return best


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def _rows(lines: Sequence[str], grid: Grid) -> Iterator[list[str]]:
    """Yield the rows of numbers, with decimal points."""
    for line in lines:
        if line.strip() and not line.lstrip().startswith(COMMENTS):
            row = _split(line, grid.separator)
            decimal = grid.mark == ","
            yield [cell.replace(",", ".") if decimal and _NUMBER[","].fullmatch(cell) else cell for cell in row]


def _columns(grid: Grid) -> tuple[list[str], list[str], bool]:
    """Return our name ("": left out) and unit of each column, and whether one differs from what the file says."""
    above, width = list(grid.above), len(grid.cells)
    under = [""] * width
    if above and any(above[-1]) and all(cell.lower() in UNITS for cell in above[-1] if cell):
        under = [UNITS[cell.lower()] if cell else "" for cell in above.pop()]
    named = above[-1] if above and sum(map(bool, above[-1])) > width / 2 else ()
    if not named or sum(bool(_NUMBER[grid.mark].fullmatch(cell)) for cell in named) > width / 2:
        return *_unnamed(grid), True
    heads = [match.groups() if (match := _HEADING.match(cell)) else (cell, "") for cell in named]
    names = [name for name, _ in heads]
    units = [unit or UNITS.get(own.lower(), own) for unit, (_, own) in zip(under, heads)]
    ours = names if recognises(names) or _is_ours(names) else _ours(names, above[:-1])
    return ours, units, ours != names or units != [own for _, own in heads]


def _is_ours(names: Sequence[str]) -> bool:
    """Return whether positions already have names of the toolkit."""
    return any({f"{axis}{suffix}" for axis in "xyz"} <= set(names) for suffix in (*SUFFIXES, "1"))


def _unnamed(grid: Grid) -> tuple[list[str], list[str]]:
    """Return names and units of columns that no row names: texts first, then x, y, z; none where no text is first."""
    numeric = grid.numeric
    texts = numeric.index(True)
    if not 0 < texts <= 3 or not all(numeric[texts : texts + 3]):
        return [], []
    names = [*("collection", "group", "name")[3 - texts :], "x", "y", "z"]
    return names + [f"column {k + 1}" for k in range(len(names), len(numeric))], [""] * len(numeric)


def _ours(names: Sequence[str], above: Sequence[Sequence[str]]) -> list[str]:
    """Return the toolkit's names of columns, from the row of names and the rows of quantities and objects above it."""
    plain = [re.sub(r"[^a-z0-9]", "", name.lower()) for name in names]
    turns = [any(row[k].lower() == "rotation" for row in above) for k in range(len(names))]
    axes = [
        name if name == "w" and turn else match[1] if (match := _AXIS.fullmatch(name)) else ""
        for name, turn in zip(plain, turns)
    ]
    if not {"x", "y", "z"} <= {axis for axis, turn in zip(axes, turns) if not turn}:
        return list(names)
    letter = "q" if "w" in axes else "r"
    bodies = [k for k, turn in enumerate(turns) if turn and axes[k] == "x"]
    several = sum(axis == "x" and not turn for axis, turn in zip(axes, turns)) > 1 and len(bodies) != 1
    result, seen = list[str](), dict[str, int]()
    for name, short, axis, turn in zip(names, plain, axes, turns):
        if axis and turn:
            result.append("" if several else f"{letter}{axis}")
        elif axis:
            seen[axis] = seen.get(axis, 0) + 1
            result.append(f"{axis}{seen[axis]}" if several else axis if seen[axis] == 1 else "")
        else:
            result.append(short if _TURN.fullmatch(short) else name)
    return [name if name not in result[:k] else "" for k, name in enumerate(result)]

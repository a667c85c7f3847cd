"""CSV tables: headers with units, columns converted to SI, errors with row and column.

The separator is tab, semicolon, comma or bar (the first of these that the header contains). It is blanks if the first
row of numbers, split at blanks, has as many cells as the header. Files are UTF-8 with or without a byte order mark, or
Windows-1252 (ANSI); the decimal mark is a point. Lines that begin with ``#`` are comments, except for a spreadsheet's
error (``#REF!``). If only a comment names the columns (numpy's savetxt), the last comment before the numbers is the
header.
"""

from __future__ import annotations

import codecs
import csv
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import IO, NoReturn

import numpy as np

from calib.data.schema import refuse
from calib.errors import MeasurementError, refuse_data, require, suggestion
from calib.extensions import Point
from calib.files import check_regular
from calib.records import frozen, plain_text, read_only
from calib.units import (
    ANGLES,
    COUNT_WORDS,
    CURRENTS,
    EFFORTS,
    LENGTHS,
    MASSES,
    QUANTITIES,
    TIMES,
    UNIT_WORDS,
    VELOCITIES,
    encoder_counts,
    is_number,
    unit_of,
)

EXPORTS: Point[Callable[[str | Path], IO[str] | None]] = Point(
    "exports", "a file of another program as a stream of our text; None where it is our table"
)

_HEADING = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\[\]()]*)[\])]$")
# x / mm (ISO 80000-1, 7.1.4)
_QUOTIENT = re.compile(r"^(?P<name>[^/]+?)\s*/\s*(?P<unit>\(.+\)|[^/\s]+(/s)?)$")
_QUOTED_UNITS = {*ANGLES, *LENGTHS, *TIMES, *VELOCITIES, *EFFORTS, *CURRENTS, *UNIT_WORDS}
# q[0], T[0,1]: numbers of elements, no units
_ELEMENT = re.compile(r"\d+(\s*,\s*\d+)*")
# q1 [deg], where blanks separate the names
_DETACHED_UNIT = re.compile(r"[ ]+([\[(])")
# A cell of a spreadsheet, not a comment.
_ERROR = re.compile(r"#(REF!|N/A|NUM!|DIV/0!|VALUE!|NAME\?|NULL!)", re.I)
_DECIMAL_COMMA = re.compile(r"^[+-]?\d*,\d+([eE][+-]?\d+)?$")
# 1.045,8959 and 1,045.8959, 1'045.8959 (Swiss) and 1 045,8959 (French, SI)
_GROUPED = re.compile(
    r"^[+-]?(\d{1,3}(\.\d{3})+,\d*|\d{1,3}(,\d{3})+\.\d*|\d{1,3}(['\u2019 \u00a0\u2009\u202f]\d{3})+([.,]\d*)?)$"
)
# 470,801: a decimal comma, or thousands
_AMBIGUOUS = re.compile(r"^[+-]?\d{1,3}(,\d{3})+$")
# Rows read at a time.
_CHUNK = 20_000
# Bytes of a file by which its encoding is told (our choice).
HEAD = 1 << 16
# Minus sign of typeset numbers (U+2212).
MINUS = "\u2212"
# First bytes of a Parquet file.
PARQUET = b"PAR1"
# Letters of a line (our choice).
LONGEST = 1 << 20
# A row this many times as wide as the header probably has decimal commas.
MAX_WIDTH_RATIO = 1.5


@dataclass(frozen=True, eq=False)
class Table:
    """Header, units and cells of a CSV file, before conversion to SI.

    Attributes:
        file: path of the file, for messages.
        header: column names without units.
        units: unit in brackets after each name; "" where there is none.
        cells: one array per column: floats (NaN for an empty cell) if every cell is a number, else texts.
        rows: (m,) number of each row in the file; data rows count from 1.
        notes: remarks on how a file of another program was read.
    """

    file: str
    header: tuple[str, ...]
    units: tuple[str, ...]
    cells: tuple[np.ndarray, ...]
    rows: np.ndarray
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.rows)

    def __contains__(self, name: str) -> bool:
        return name in self.header

    def fail(self, message: str, column: str | None = None, row: int | None = None) -> NoReturn:
        """Raise MeasurementError about the table, or about one of its columns or cells.

        Args:
            message: text of the error; the file's name is prepended.
            column: name of the column; None: the whole table.
            row: index of the cell's row, from 0; None: the whole column.
        """
        refuse_data(self.file, message, column, None if row is None else int(self.rows[row]))

    def index(self, name: str) -> int:
        """Return the index of the column `name`.

        Raises:
            MeasurementError: the column is missing; the message suggests the most similar name.
        """
        if name not in self.header:
            headings = ", ".join(self.header)
            self.fail(f"column '{name}' is missing{suggestion(name, self.header)}; found: {headings}")
        return self.header.index(name)

    def texts(self, name: str) -> list[str]:
        """Return a column (m,) as texts, with numbers in their shortest form (``0``, not ``0.0``).

        Args:
            name: name of the column.
        """
        cells = self.cells[self.index(name)]
        if cells.dtype == float:
            return [f"{cell:.12g}" for cell in cells]
        return [plain_text(str(cell)) for cell in cells]

    def block(self, head: str) -> np.ndarray | None:
        """Return the columns named `head` and a joint (``q_joint1`` or ``q1``) as an array (m, n), not in SI.

        None if there are no such columns.

        Args:
            head: name of the quantity, such as ``q``.
        """
        names = [name for name in self.header if re.fullmatch(rf"{head}(\d+|_.+)", name)]
        if not names:
            return None
        return np.column_stack([self.numbers(name, None) for name in names])

    def numbers(self, name: str, dimension: str | None = "", unit: str = "", gaps: bool = False) -> np.ndarray:
        """Return a column (m,) as floats in SI.

        Args:
            name: name of the column.
            dimension: ``angle`` [rad], ``length`` [m], ``joint`` (either), ``speed`` [m/s], ``time`` [s], ``torque``
                [N m], ``mass`` [kg], "" (a plain number) or None (not converted).
            unit: unit of the column if its header has none; "" for SI.
            gaps: whether empty and NaN cells become NaN; otherwise they are refused.

        Raises:
            MeasurementError: a cell that is not a finite number, or a unit of another dimension.
        """
        column = self.index(name)
        (cells,) = self.check((name,), (name,) if gaps else ())
        if dimension is None:
            return cells
        units = {"angle": ANGLES, "length": LENGTHS, "joint": ANGLES | LENGTHS, "": {"1": 1.0, "-": 1.0}}
        units |= {"speed": QUANTITIES["speed"], "time": TIMES, "torque": EFFORTS, "mass": MASSES}  # ty: ignore[unsupported-operator]
        return (cells - self.zero(column, unit)) * self.factor(column, units[dimension], unit)

    def check(self, names: Sequence[str], gaps: Collection[str] = ()) -> list[np.ndarray]:
        """Return columns (m,) as floats, not converted to SI, after checking that every cell is a finite number.

        Args:
            names: names of the columns.
            gaps: names of columns whose cells may be empty or NaN.

        Raises:
            MeasurementError: a cell is not a finite number. The message names the first row with such a cell, and the
                number of such rows, in all and by column.
        """
        cells = [self.cells[self.index(name)] for name in names]
        columns = []
        invalid = []
        for name, column in zip(names, cells):
            values = column if column.dtype == float else _as_floats(column)
            columns.append(values)
            invalid.append(np.isinf(values) if name in gaps else ~np.isfinite(values))
        refuse(self, np.column_stack(invalid), names, lambda row, k: _not_a_number(cells[k][row]))
        return columns

    def factor(self, column: int, factors: Mapping[str, float], unit: str) -> float:
        """Return the factor that converts a column to SI, by the unit in its header, or `unit` if the header has none.

        Args:
            column: index of the column.
            factors: accepted units and their factors.
            unit: unit stated by the options; "" if none. If both the header and the options state one, they must agree.
        """
        name, header_unit = self.header[column], self.units[column]
        if encoder_counts(unit) and header_unit.lower() in COUNT_WORDS:
            header_unit = ""
        if header_unit and unit and header_unit != unit:
            self.fail(f"the header states [{header_unit}], the options state {unit}: remove one of them", name)
        unit = header_unit or unit
        if not unit:
            return 1.0
        counts = encoder_counts(unit)
        if counts is not None and "rad" in factors:
            return math.tau / counts[0]
        if unit.lower() not in factors:
            expected = ", ".join(name for name in factors if name.isascii())
            counts = ""
            if unit.lower() in COUNT_WORDS and "rad" in factors:
                counts = "; of an encoder, state counts per turn and the count at zero, as in [counts/4096@2048]"
            self.fail(f"unit [{unit}] is not one of {expected}{counts}", name)
        return factors[unit.lower()]

    def zero(self, column: int, unit: str) -> float:
        """Return the count of an encoder at the joint's zero, by its unit; 0 for other units.

        Args:
            column: index of the column.
            unit: unit stated by the options; "" if none.
        """
        counts = encoder_counts(unit) or encoder_counts(self.units[column])
        return counts[1] if counts else 0.0

    def where(self, keep: np.ndarray) -> Table:
        """Return the table with only those rows that the mask `keep` (m,) selects."""
        return replace(self, cells=tuple(cells[keep] for cells in self.cells), rows=self.rows[keep])


def read_table(path: str | Path, header: Sequence[str] | None = None, doubles: bool = False) -> Table:
    """Return the table of the CSV file at `path`; 100 MB of numbers take about 3 s and 100 MB of memory.

    Args:
        path: the file.
        header: column names for a file without a header; None: the file has a header.
        doubles: allow a name to occur twice in the header.

    Raises:
        MeasurementError: a file that is missing, empty, not UTF-8, without a header, or with decimal commas; a name
            that occurs twice; a row whose number of cells differs from the header's.
    """
    with opened(path, header is None) as (lines, separator, first_line):
        if header is None:
            names, units = split_units(first_line)
        else:
            names, units = tuple(header), ("",) * len(header)
        if not doubles:
            _refuse_doubles(names, path)
        cells = _read_columns(lines, separator, names, path)
        notes = getattr(lines, "notes", ())
    require(len(cells[0]), "has a header but no data rows", MeasurementError, path)
    rows = frozen(np.arange(1, len(cells[0]) + 1), int)
    # Each line ends with a separator.
    if header is None and names[-1] == f"column {len(names)}" and not _filled(cells[-1]):
        names, units, cells = names[:-1], units[:-1], cells[:-1]
    return Table(str(path), names, units, cells, rows, notes)


def _refuse_doubles(names: tuple[str, ...], path: str | Path) -> None:
    """Raise MeasurementError for a header in which a name occurs twice.

    Args:
        names: the names in the header.
        path: the file, for messages.
    """
    for index, name in enumerate(names):
        if name in names[:index]:
            columns = " and ".join(str(column) for column, heading in enumerate(names, 1) if heading == name)
            refuse_data(path, f"occurs more than once in the header (columns {columns})", name)


def read_header(path: str | Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the column names and units of the CSV file at `path` without reading its rows."""
    with opened(path, True) as (_, _, header):
        return split_units(header)


def row_width(path: str | Path) -> int:
    """Return the number of cells in the first line of the CSV file at `path`."""
    with opened(path, False) as (_, _, first):
        return len(first)


@contextmanager
def opened(path: str | Path, headed: bool) -> Iterator[tuple[IO[str], str, list[str]]]:
    """Yield a file positioned after its header line, the file's separator, and the header's cells.

    Args:
        path: the file.
        headed: whether the file has a header; otherwise its first row is returned in place of the header.
    """
    try:
        check_regular(path)
        with open(path, "rb") as beginning:
            head = beginning.read(HEAD)
        if head.startswith(PARQUET):
            refuse_data(
                path,
                "is a Parquet file, as LeRobot writes: calib identify and calib join read it as a motion; save "
                "measured poses as CSV",
            )
        encoding = encoding_of(head)
        raw = open(path, encoding=encoding, newline="")  # noqa: SIM115 (closed below)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or error
        raise MeasurementError(f"cannot be read: {reason}", path) from error
    with raw as file:
        export = _as_our_text(path) if headed else None
        if export is not None:
            file = export
        yield file, *_first_line(file, path, headed)


def encoding_of(head: bytes) -> str:
    """Return the encoding of a text file: UTF-8, UTF-16 by its mark, else Windows-1252 ('ANSI', contains Latin-1).

    Args:
        head: the first bytes of the file.
    """
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    if b"\0" in head or head[:2] == b"PK":
        return "utf-8-sig"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def _as_our_text(path: str | Path) -> IO[str] | None:
    """Return another program's export as a text stream of a CSV table; None if the file is no known export.

    Args:
        path: the file, which may be the export of an instrument or a controller.
    """
    for read_export in EXPORTS.all():
        export = read_export(path)
        if export is not None:
            return export
    return None


def _first_line(file: IO[str], path: str | Path, headed: bool) -> tuple[str, list[str]]:
    """Return the separator and the cells of the first line that is not a comment.

    The file is then positioned after this line.

    Args:
        file: the open file.
        path: its path, for messages.
        headed: whether this line is a header; otherwise it is the first row of numbers.
    """
    try:
        comment = ""
        line_start = 0
        for line in iter(partial(file.readline, LONGEST), ""):
            if len(line) == LONGEST:
                refuse_data(
                    path, f"has a line of more than {LONGEST} characters: it is not a table; was it saved as CSV?"
                )
            text = line.strip()
            if text.startswith("#"):
                comment = text
            elif text:
                line = _with_quoted_breaks(line, file)
                separator = _separator(line.strip(), partial(_next_row, file))
                if separator == " ":
                    line = _DETACHED_UNIT.sub(r"\1", line)
                lines = line.strip("\r\n").splitlines(keepends=True)
                cells = next(csv.reader(lines, delimiter=separator, skipinitialspace=True))
                if _headless(cells, path) or not headed:
                    file.seek(line_start)
                    if headed:
                        cells = _comment_header(comment, separator, len(cells), path)
                return separator, [cell.strip() for cell in cells]
            line_start = file.tell()
    except UnicodeDecodeError as error:
        raise _not_utf8(error, path) from error
    except (csv.Error, StopIteration) as error:
        raise MeasurementError(f"is no CSV: {error}", path) from error
    refuse_data(path, "is empty: a header and rows are needed")


def _with_quoted_breaks(line: str, file: IO[str]) -> str:
    """Return a line joined with the following lines, if a quoted name in it contains line breaks.

    Args:
        line: a line of the file.
        file: the open file, from which the following lines are read.
    """
    while line.count('"') % 2 and len(line) < LONGEST:
        continuation = file.readline(LONGEST)
        if not continuation:
            break
        line += continuation
    return line


def _headless(cells: Sequence[str], path: str | Path) -> bool:
    """Return whether most cells of a first line are numbers, so that the file has no header.

    Args:
        cells: cells of the file's first line.
        path: the file, for messages.

    Raises:
        MeasurementError: most cells are numbers with decimal commas.
    """
    if sum(bool(_DECIMAL_COMMA.match(cell)) for cell in cells) > len(cells) / 2:
        refuse_data(path, _not_a_number(cells[0]), row=1)
    return sum(is_number(cell) for cell in cells) > len(cells) / 2


def _separator(line: str, next_row: Callable[[], str]) -> str:
    """Return the separator of a file from its first line; `next_row` returns the line after it."""
    line = re.sub(r'"[^"]*"', "", line)
    for mark in "\t;,|":
        if mark in line:
            return mark
    # numpy's savetxt
    if all(is_number(cell) for cell in line.split()):
        return " "
    names = _DETACHED_UNIT.sub(r"\1", line).split()
    numbers = next_row().split()
    if 1 < len(names) == len(numbers) and all(is_number(cell) for cell in numbers):
        return " "
    return ","


def _next_row(file: IO[str]) -> str:
    """Return the next line that is neither empty nor a comment; the file position is unchanged."""
    position = file.tell()
    row = ""
    for line in iter(partial(file.readline, LONGEST), ""):
        if line.strip() and not line.startswith("#"):
            row = line
            break
    file.seek(position)
    return row


def _comment_header(comment: str, separator: str, width: int, path: str | Path) -> list[str]:
    names = [name.strip() for name in comment.lstrip("# ").split(separator)]
    if len(names) == width and not any(is_number(name) for name in names if name):
        return names
    message = (
        f"has no header: its first line contains only numbers ({width} cells). Add a line with the column names "
        "(q1,q2,...,x,y,z), or state `format` in the options for a known headerless format"
    )
    refuse_data(path, message)


def split_units(cells: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names and the units in a header's cells: ``q1 [deg]`` gives ``q1`` and ``deg``; "" without a unit.

    A unit stands in brackets, or behind a slash (``q1 / deg``).

    Args:
        cells: cells of the header.
    """
    names, units = [], []
    for number, cell in enumerate(cells, 1):
        name, unit = plain_text(cell), ""
        match = _HEADING.match(name)
        quotient = _QUOTIENT.match(name)
        if quotient and quotient["unit"].strip("()").strip().lower() in _QUOTED_UNITS:
            match = quotient
        if match and not _ELEMENT.fullmatch(match["unit"]):
            name, unit = match["name"], match["unit"].strip("()").strip()
        names.append(name or f"column {number}")
        units.append(unit_of(unit))
    return tuple(names), tuple(units)


def _read_columns(lines: IO[str], separator: str, names: tuple[str, ...], path: str | Path) -> tuple[np.ndarray, ...]:
    """Return the columns below the header.

    Blocks of rows that contain only numbers are read by numpy, which is about five times faster. From the first other
    block on, the file is read cell by cell.

    Args:
        lines: the open file, positioned below the header.
        separator: the file's separator.
        names: column names.
        path: the file, for messages.
    """
    body = _without_comments(lines)
    blocks: list[np.ndarray] = []
    try:
        while block := list(islice(body, _CHUNK)):
            numbers = plain_rows(block, separator, len(names))
            if numbers is None:
                body = chain(block, body)
                break
            blocks.append(numbers)
        row_count = sum(len(block) for block in blocks)
        parts = _read_cells(body, separator, names, path, row_count)
    except UnicodeDecodeError as error:
        raise _not_utf8(error, path) from error
    table = _transposed(blocks, len(names))
    if not any(parts):
        return tuple(table)
    return tuple(_join([column, *part]) for column, part in zip(table, parts))


def _without_comments(lines: IO[str]) -> Iterator[str]:
    """Yield the lines that are neither empty nor comments."""
    for line in lines:
        text = line.lstrip()
        if text and (text[0] != "#" or _ERROR.match(text)):
            yield line


def plain_rows(block: list[str], separator: str, width: int) -> np.ndarray | None:
    """Return lines of numbers as an array (m, width); None if a cell is not a number or a row has another width.

    Args:
        block: m lines of the file.
        separator: separator of the cells.
        width: number of cells in each line.
    """
    delimiter = None if separator == " " else separator
    try:
        values = np.loadtxt(block, delimiter=delimiter, comments=None, quotechar='"', ndmin=2)
    except ValueError:
        return None
    return values if values.shape == (len(block), width) else None


def _transposed(blocks: list[np.ndarray], width: int) -> np.ndarray:
    """Return blocks (m_i, width) as one array (width, m) with contiguous columns; the list `blocks` is emptied."""
    table = np.empty((width, sum(len(block) for block in blocks)))
    start = 0
    blocks.reverse()
    # Blocks go as they are copied: an hour's log is held once, not twice.
    while blocks:
        block = blocks.pop()
        table[:, start : start + len(block)] = block.T
        start += len(block)
    return read_only(table)


def _read_cells(
    body: Iterator[str], separator: str, names: tuple[str, ...], path: str | Path, row_count: int
) -> list[list[np.ndarray]]:
    """Return each column in parts of floats or of texts.

    Args:
        body: lines of the file.
        separator: the file's separator.
        names: column names.
        path: the file, for messages.
        row_count: number of rows read before these lines, for messages.
    """
    parts: list[list[np.ndarray]] = [[] for _ in names]
    reader = csv.reader(body, delimiter=separator, skipinitialspace=True)
    rows = (row for row in reader if any(row))
    try:
        while chunk := list(islice(rows, _CHUNK)):
            for index, row in enumerate(chunk):
                if len(row) != len(names):
                    is_last = index == len(chunk) - 1 and next(rows, None) is None
                    refuse_data(path, _ragged(row, names, separator, is_last), row=row_count + index + 1)
            for part, column in zip(parts, zip(*chunk)):
                part.append(as_column(column))
            row_count += len(chunk)
    except csv.Error as error:
        raise MeasurementError(f"is no CSV: {error}", path, row_count + 1) from error
    return parts


def as_column(column: Sequence[str]) -> np.ndarray:
    """Return a column's cells as floats if all of them are numbers or empty, else as texts."""
    joined = "".join(column)
    if MINUS in joined:
        column = [cell.replace(MINUS, "-") for cell in column]
        joined = joined.replace(MINUS, "-")
    try:
        if "_" in joined or not joined.isascii():
            raise ValueError("digits that Python alone takes for such")
        return np.array(column, dtype=float)
    except ValueError:
        texts = [cell.strip() for cell in column]
        if all(not text or is_number(text) for text in texts):
            return np.array([float(text or "nan") for text in texts])
        return np.array(texts, dtype=object)


def _join(parts: Sequence[np.ndarray]) -> np.ndarray:
    if not parts:
        return frozen([])
    if all(part.dtype == float for part in parts):
        return frozen(np.concatenate(parts))
    texts = [part if part.dtype == object else _as_texts(part) for part in parts]
    return read_only(np.concatenate(texts))


def _as_texts(part: np.ndarray) -> np.ndarray:
    texts = ["" if math.isnan(value) else f"{value:.12g}" for value in part]
    return np.array(texts, dtype=object)


def _filled(cells: np.ndarray) -> bool:
    return cells.dtype != float or not np.isnan(cells).all()


def _as_floats(texts: np.ndarray) -> np.ndarray:
    """Return texts (m,) as floats: NaN for an empty text, infinity for a text that is not a number."""
    values = np.full(len(texts), math.inf)
    for row, text in enumerate(texts):
        if not text:
            values[row] = math.nan
        elif is_number(text):
            values[row] = float(text)
    return values


def _not_a_number(cell: str | float) -> str:
    text = str(cell)
    if _AMBIGUOUS.match(text):
        return (
            f"found '{text}', with a decimal comma or separators between thousands: save the table with decimal "
            "points, and without such separators"
        )
    if _DECIMAL_COMMA.match(text):
        return f"found '{text}', with a decimal comma: save the table with decimal points (1.5, not 1,5)"
    if _GROUPED.match(text):
        return f"found '{text}', with separators between thousands: save the table without them (1045.9)"
    content = "an empty or NaN cell" if text.lower() in ("", "nan") else f"'{text}'"
    advice = "rows are counted without the header; leave such rows out, or measure them again"
    return f"found {content} where a number is needed; {advice}"


def _ragged(row: Sequence[str], names: Sequence[str], separator: str, last: bool) -> str:
    message = f"has {len(row)} cells, the header has {len(names)} columns"
    if last and len(row) < len(names):
        return f"{message}: the file ends here, in the middle of a line (power lost, disk full?); delete its last line"
    if separator == "," and len(row) > MAX_WIDTH_RATIO * len(names):
        message += "; if these are decimal commas, save the table with decimal points and commas between columns"
    return message


def _not_utf8(error: UnicodeDecodeError, path: str | Path) -> MeasurementError:
    byte = error.object[error.start]
    if _begins_as_archive(path):
        return MeasurementError("is an archive (.npz or spreadsheet), not a CSV table; save a spreadsheet as CSV", path)
    return MeasurementError(f"is not UTF-8 text (byte 0x{byte:02x}): save it as 'CSV UTF-8'", path)


def _begins_as_archive(path: str | Path) -> bool:
    with open(path, "rb") as file:
        return file.read(4) == b"PK\3\4"

"""Tables in spreadsheets (xlsx), XML, YAML and JSON, read as CSV tables are by every command.

===================================  ==================================================================================
``.xlsx``                            the first sheet with cells, others are named; formulas by their last result
``<point name="P1" x="0.47" …/>``    XML: the elements that occur most often, with attributes or elements inside
``rostopic echo`` or                 YAML of several documents, or a list of tables; JSON alike. Nested names are joined
``ros2 topic echo`` into a file      by points (``pose.position.x``), stamps become ``t``; ``name`` beside ``position``,
                                     ``velocity``, ``effort`` (joint states) become ``q_elbow``, ``v_elbow``,
                                     ``tau_elbow``
===================================  ==================================================================================

Sources: ECMA-376, part 1, 18.3 (SpreadsheetML); sensor_msgs/JointState; std_msgs/Header of ROS 1 and 2.
"""

from __future__ import annotations

import csv
import io
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

from calib.data.trees import read_tree
from calib.errors import MeasurementError, listing, refuse_data

# first bytes of a file, by which its form is recognised
HEAD = 4096
ZIP = b"PK"
_XML = re.compile(r"<(\?xml|[A-Za-z])")
# first line of ``rostopic echo``: a name alone
_ECHO = re.compile(r"(---\s+)?[A-Za-z_]\w*:[ ]*\r?\n")
YAML_SUFFIXES = (".yaml", ".yml", ".json")
# letters before the joint's name in the columns of a joint state's quantities
QUANTITIES = {"position": "q", "velocity": "v", "effort": "tau"}
# fields of a stamp in ROS 1 and in ROS 2
STAMPS = (("secs", "nsecs"), ("sec", "nanosec"))
PER_SECOND = 10**9
# rows that make a table
MIN_ROWS = 2
# largest size of an unpacked spreadsheet [byte]
MAX_SIZE = 1 << 28
_SHEET = re.compile(r"xl/worksheets/sheet(\d+)\.xml")
_COLUMN = re.compile(r"[A-Z]+")

Row = Mapping[str, object]


class NestedTable(io.StringIO):
    """A file of rows, rewritten as the text of a CSV table, with notes on how it was read."""

    notes: tuple[str, ...] = ()


def translated(path: str | Path) -> NestedTable | None:
    """Return a spreadsheet, or rows in XML, YAML or JSON, as the text of a CSV table; None for another file.

    Raises:
        MeasurementError: a file of such a form that is damaged, or without rows.
    """
    path = Path(path)
    with open(path, "rb") as file:
        head = file.read(HEAD)
    if head.startswith(ZIP) and (path.suffix.lower() == ".xlsx" or zipfile.is_zipfile(path)):
        return _spreadsheet(path)
    text = head.decode("utf-8-sig", errors="replace").lstrip()
    if _XML.match(text):
        return _of_rows(_xml_rows(path), "rows of XML")
    if path.suffix.lower() not in YAML_SUFFIXES and not _ECHO.match(text):
        return None
    content = read_tree(path)
    if not isinstance(content, list):
        return None
    documents = [document for document in content if isinstance(document, Mapping)]
    return _of_rows([_flat_row(document) for document in documents], "documents of YAML or JSON")


def _of_rows(rows: Sequence[Row], kind: str) -> NestedTable | None:
    """Return rows as the text of a CSV table with all their columns; None if there are too few.

    Args:
        rows: per row, name of the column → cell.
        kind: what the rows were, for a note.
    """
    if len(rows) < MIN_ROWS:
        return None
    header: dict[str, None] = {}
    for row in rows:
        header.update(dict.fromkeys(name for name, cell in row.items() if cell != ""))
    cells = [[row.get(name, "") for name in header] for row in rows]
    return _written([list(header), *cells], f"read as {len(rows)} {kind}: columns {listing(header)}")


def _written(lines: Sequence[Sequence[object]], note: str) -> NestedTable:
    """Return lines of cells as the text of a CSV table.

    Args:
        lines: the header and the rows.
        note: how they were read.
    """
    table = NestedTable()
    csv.writer(table, lineterminator="\n").writerows(lines)
    table.seek(0)
    table.notes = (note,)
    return table


def _flat_row(document: Mapping[str, object]) -> Row:
    """Return a document as a row: nested names joined by points, a stamp in seconds, joint states by joint.

    Args:
        document: a message.
    """
    row: dict[str, object] = {}
    names = document.get("name")
    if isinstance(names, list):
        for quantity, letters in QUANTITIES.items():
            values = document.get(quantity)
            if isinstance(values, list) and len(values) == len(names):
                row.update({f"{letters}_{name}": value for name, value in zip(names, values)})
        document = {key: value for key, value in document.items() if key not in ("name", *QUANTITIES)}
    for name, value in _leaves(document):
        row.setdefault(name, value)
    return row


def _leaves(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """Yield names and values of nested tables and lists; a stamp of whole numbers is one number ``t`` [s].

    Args:
        value: a table, a list or a value.
        name: its name.
    """
    if isinstance(value, Mapping):
        for fields in STAMPS:
            seconds, nanoseconds = map(value.get, fields)
            if isinstance(seconds, int) and isinstance(nanoseconds, int):
                whole_seconds, fraction = divmod(seconds * PER_SECOND + nanoseconds, PER_SECOND)
                yield "t", f"{whole_seconds}.{fraction:09d}"
                return
        for key, content in value.items():
            yield from _leaves(content, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list):
        for number, content in enumerate(value):
            yield from _leaves(content, f"{name}[{number}]")
    else:
        yield name, "" if value is None else value


def _xml_rows(path: Path) -> list[Row]:
    """Return the elements of an XML file that occur most often as rows of their attributes and inner texts.

    Args:
        path: the file.
    """
    try:
        content = path.read_bytes()
        if b"<!ENTITY" in content:
            refuse_data(path, "defines entities, which are not read: save it without a DTD")
        root = ET.fromstring(content.lstrip())
    except (OSError, ET.ParseError) as error:
        raise MeasurementError(f"cannot be read as XML ({error})", path) from error
    rows_of: dict[str, list[Row]] = {}
    for element in root.iter():
        row = dict(_xml_cells(element))
        if len(row) > 1:
            rows_of.setdefault(element.tag, []).append(row)
    return max(rows_of.values(), key=len, default=[])


def _xml_cells(element: ET.Element, name: str = "") -> Iterator[tuple[str, str]]:
    """Yield names and texts of an element's attributes and of the elements inside that do not repeat.

    Args:
        element: the element.
        name: its name within the row; "" for the row.
    """
    for key, text in element.attrib.items():
        yield f"{name}.{key}" if name else key, text
    counts = Counter(child.tag for child in element)
    for child in element:
        tag = child.tag.rpartition("}")[2]
        inner = f"{name}.{tag}" if name else tag
        if counts[child.tag] > 1:
            continue
        if child.text and child.text.strip():
            yield inner, child.text.strip()
        yield from _xml_cells(child, inner)


def _spreadsheet(path: Path) -> NestedTable | None:
    """Return the first sheet with cells of an xlsx file; None for another archive.

    Args:
        path: the file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            if "xl/workbook.xml" not in names:
                return None
            if sum(member.file_size for member in archive.infolist()) > MAX_SIZE:
                refuse_data(path, f"unpacks to more than {MAX_SIZE >> 20} MB: save the sheet as CSV")
            shared = []
            if "xl/sharedStrings.xml" in names:
                shared = ["".join(item.itertext()) for item in ET.fromstring(archive.read("xl/sharedStrings.xml"))]
            sheets = sorted(filter(_SHEET.fullmatch, names), key=_sheet_number)
            tables = {name: _sheet_rows(ET.fromstring(archive.read(name)), shared) for name in sheets}
    except (OSError, zipfile.BadZipFile, zlib.error, ET.ParseError, ValueError, IndexError, RuntimeError) as error:
        raise MeasurementError(f"cannot be read as a spreadsheet ({error}): save the sheet as CSV", path) from error
    filled = [name for name, rows in tables.items() if rows]
    if not filled:
        refuse_data(path, "has no sheet with cells")
    rows = tables[filled[0]]
    note = f"read as a spreadsheet: sheet {_sheet_number(filled[0])}, {len(rows)} rows"
    if len(filled) > 1:
        note += f"; {len(filled) - 1} more with cells are not read: save them as files of their own"
    return _written(rows, note)


def _sheet_number(name: str) -> int:
    match = _SHEET.fullmatch(name)
    return int(match[1]) if match else 0


def _sheet_rows(sheet: ET.Element, shared: Sequence[str]) -> list[list[str]]:
    """Return the cells of a sheet as texts, row by row, without empty rows; all rows have one width.

    Args:
        sheet: the sheet's root element.
        shared: the workbook's shared texts.
    """
    rows = []
    for row in sheet.iterfind(".//{*}row"):
        cells: dict[int, str] = {}
        for cell in row.iterfind("{*}c"):
            column = _column_index(cell.get("r", ""), len(cells))
            text = cell.findtext("{*}v") or ""
            if cell.get("t") == "s" and text:
                text = shared[int(text)]
            elif cell.get("t") == "inlineStr":
                text = "".join(cell.itertext())
            if text:
                cells[column] = text
        if cells:
            rows.append(cells)
    width = max((max(cells) + 1 for cells in rows), default=0)
    return [[cells.get(column, "") for column in range(width)] for cells in rows]


def _column_index(reference: str, following: int) -> int:
    """Return the index of a cell's column from its reference (``AB12``); the following one without a reference."""
    match = _COLUMN.match(reference)
    if match is None:
        return following
    index = 0
    for letter in match[0]:
        index = 26 * index + ord(letter) - ord("A") + 1
    return index - 1

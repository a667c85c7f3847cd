"""Spreadsheets, XML, YAML and JSON of rows are read as the same table in CSV is; what cannot be read says why."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from calib.data.csv_table import Table, read_table
from calib.data.recordings.recording_files import read_recording
from calib.data.schema import Joints
from calib.errors import MeasurementError

NAMES = ["pose", "q1", "x"]
ROWS = [["P1", 0.5, 101.25], ["P2", -1.25, 99.0], ["P3", 0.75, 98.5]]
SPREADSHEET = 'xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"'


def spreadsheet(path: Path, *sheets: list[list]) -> Path:
    """Write sheets as a program for spreadsheets does: texts shared, empty cells left out."""
    texts: list[str] = []
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("xl/workbook.xml", f"<workbook {SPREADSHEET}/>")
        for number, lines in enumerate(sheets, 1):
            rows = []
            for row, line in enumerate(lines, 1):
                cells = ""
                for letter, cell in zip("ABCDEF", line):
                    if isinstance(cell, str):
                        texts.append(cell)
                        cells += f'<c r="{letter}{row}" t="s"><v>{len(texts) - 1}</v></c>'
                    elif cell is not None:
                        cells += f'<c r="{letter}{row}"><v>{cell}</v></c>'
                rows.append(f'<row r="{row}">{cells}</row>')
            content = f"<worksheet {SPREADSHEET}><sheetData>{''.join(rows)}</sheetData></worksheet>"
            archive.writestr(f"xl/worksheets/sheet{number}.xml", content)
        items = "".join(f"<si><t>{text}</t></si>" for text in texts)
        archive.writestr("xl/sharedStrings.xml", f"<sst {SPREADSHEET}>{items}</sst>")
    return path


def check_rows(table: Table) -> None:
    assert table.header == tuple(NAMES) and table.texts("pose") == [row[0] for row in ROWS]
    np.testing.assert_array_equal(table.numbers("x"), [row[2] for row in ROWS])


def test_spreadsheets(tmp_path):
    """The first sheet with cells is read; an empty cell is one, and further sheets are said."""
    table = read_table(spreadsheet(tmp_path / "m.xlsx", [], [NAMES, *ROWS], [["note"]]))
    check_rows(table)
    assert "1 more with cells" in table.notes[0]
    gap = read_table(spreadsheet(tmp_path / "gap.xlsx", [NAMES, ["P1", None, 1.0], ["P2", 2.0, 3.0]]))
    assert np.isnan(gap.cells[1][0]) and gap.cells[1][1] == 2.0
    (tmp_path / "broken.xlsx").write_bytes((tmp_path / "m.xlsx").read_bytes()[:200])
    with pytest.raises(MeasurementError, match="spreadsheet"):
        read_table(tmp_path / "broken.xlsx")
    with pytest.raises(MeasurementError, match="no sheet with cells"):
        read_table(spreadsheet(tmp_path / "empty.xlsx", []))


def test_damaged_compression_of_a_spreadsheet_is_named(tmp_path):
    lines = [NAMES, *([f"P{number}", 0.37 * number, 1.1 * number] for number in range(400))]
    with zipfile.ZipFile(spreadsheet(tmp_path / "m.xlsx", lines)) as source:
        contents = {name: source.read(name) for name in source.namelist()}
    path = tmp_path / "compressed.xlsx"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    damaged = bytearray(path.read_bytes())
    start = damaged.find(b"sheet1.xml") + 60
    damaged[start : start + 300] = b"\xff" * 300
    path.write_bytes(damaged)
    with pytest.raises(MeasurementError, match="cannot be read as a spreadsheet"):
        read_table(path)


def test_rows_of_xml(tmp_path):
    """Attributes or elements inside are cells; lists of other elements stand beside."""
    attributes = "".join(f'<p pose="{name}" q1="{q}" x="{x}"/>' for name, q, x in ROWS)
    inner = "".join(f"<p><pose>{name}</pose><q1>{q}</q1><x>{x}</x></p>" for name, q, x in ROWS)
    for number, rows in enumerate((attributes, inner)):
        path = tmp_path / f"{number}.xml"
        path.write_text(f"\n<?xml version='1.0'?><file><made by='us' on='day'/><list>{rows}</list></file>")
        check_rows(read_table(path))
    path.write_text("<file><p")
    with pytest.raises(MeasurementError, match="cannot be read as XML"):
        read_table(path)


def test_documents(tmp_path):
    """YAML of several documents and JSON of a list; nested names are joined, the stamp becomes t."""
    (tmp_path / "m.json").write_text(json.dumps([dict(zip(NAMES, row)) for row in ROWS]))
    check_rows(read_table(tmp_path / "m.json"))
    echo = "header: \n  seq: 3\n  stamp: \n    secs: 17\n    nsecs: 5000000\npoint: \n  x: 1.5\n  y: 2.0\n---\n"
    (tmp_path / "echo.txt").write_text(echo * 3)
    table = read_table(tmp_path / "echo.txt")
    assert table.numbers("t")[0] == 17.005 and table.numbers("point.x")[2] == 1.5


@pytest.mark.parametrize("seconds", ["", "abc", "12.5"])
def test_stamps_of_other_than_whole_numbers_are_no_time(tmp_path, seconds):
    message = f"stamp:\n  sec: {seconds}\n  nanosec: 5\nx: 1.5\n---\n"
    (tmp_path / "m.yaml").write_text(message * 3)
    table = read_table(tmp_path / "m.yaml")
    assert "t" not in table.header and table.numbers("x")[2] == 1.5


def test_joint_states_of_rostopic_echo(tmp_path):
    """Messages of joint states as text are a log by joint names, whatever their order."""
    t = np.arange(0.0, 3.0, 0.01)
    q = np.column_stack([np.sin(t), np.cos(2.0 * t)])
    messages = []
    for time, (first, second) in zip(t, q):
        stamp = f"header:\n  stamp:\n    sec: {int(time)}\n    nanosec: {round(1e9 * (time % 1.0))}\n"
        lists = f"name: [b, a]\nposition: [{second}, {first}]\nvelocity: []\neffort: [{2.0 * second}, {first}]\n---\n"
        messages.append(stamp + lists)
    (tmp_path / "log.yaml").write_text("".join(messages))
    recording = read_recording(tmp_path / "log.yaml", Joints(("a", "b")))
    np.testing.assert_allclose(recording.q, q, atol=1e-12)
    np.testing.assert_allclose(recording.effort, q * [1.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(recording.t, t, atol=1e-6)


@pytest.mark.parametrize("cell", ["1'045.5", "1\u202f045,5", "1,045.5", "1.045,5"])
def test_thousands_are_named(tmp_path, cell):
    (tmp_path / "m.csv").write_text(f"q1;x\n0.5;{cell}\n" * 1 + f"0.5;{cell}\n" * 3)
    with pytest.raises(MeasurementError, match="separators between thousands"):
        read_table(tmp_path / "m.csv").numbers("x")


def test_thousands_or_decimal_comma_is_asked(tmp_path):
    (tmp_path / "m.csv").write_text("q1;x;y\n0.5;470,801;1.5\n" + "0.5;1,470,801;1.5\n" * 3)
    with pytest.raises(MeasurementError, match="a decimal comma or separators between thousands"):
        read_table(tmp_path / "m.csv").numbers("x")

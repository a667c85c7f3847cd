"""One record, several renderers: what the console prints is what report and certificate say, as HTML and as PDF."""

import io
import os
import re
from dataclasses import replace
from html.parser import HTMLParser
from io import StringIO

import pytest
from pypdf import PdfReader
from rich.console import Console

from calib.procedure.answers import MAX_LETTERS, CertificateSection
from calib.procedure.findings import PREDICTION_ONLY
from calib.procedure.report import page
from calib.procedure.report.certificate import rendering
from calib.procedure.report.certificate.record import (  # fmt: skip
    CERTIFIED_SETUP,
    MAX_LINES,
    MAX_PAGES,
    NO_DETAILS,
    Certificate,
    Entry,
    Judgement,
    StageRecord,
    records,
    report,
)
from calib.procedure.report.page import KeyFigure, Picture, Pictures, ReportTable, Section, Text

HOSTILE = "[bold]<script>alert(1)</script> & \"quoted\" 'one'[/]"
ROWS = [(HOSTILE,), ("nominal", "1.5"), ("calibrated", "0.25")]
TABLE = ReportTable("Errors", ("arm", "rms"), ROWS, "how to read", frozenset({2}), (1,))


class Reader(HTMLParser):
    """Collects the text inside each of some tags."""

    def __init__(self, tag: str, text: str) -> None:
        super().__init__()
        self.tag, self.inside, self.found = tag, 0, []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag == self.tag:
            self.inside += 1
            self.found.append("")

    def handle_endtag(self, tag):
        self.inside -= tag == self.tag

    def handle_data(self, data):
        if self.inside:
            self.found[-1] += data


def printed(*blocks, width: int = 200, markup: bool = False) -> str:
    out = Console(file=StringIO(), width=width, highlight=False)
    for line in page.rendered(blocks):
        out.print(line, soft_wrap=True, markup=markup)
    assert isinstance(out.file, StringIO)
    return out.file.getvalue()


SVG = b'<svg xmlns="http://www.w3.org/2000/svg" width="740" height="220"><rect width="9" height="9"/></svg>'
ROBOT = (Entry("robot", "ur5"),)
FILES = [(f"file{k}.csv", "measured", "10", f"{k:064x}") for k in range(20)]


def report_of(*sections: Section, setup=ROBOT, files=()) -> str:
    return rendering.html(report("Calibration of x", "Geometry", setup, sections, files))


def judged(verdict: str = "pass", reason: str = "rms 0.1 mm", blocks=()) -> Section:
    figures = [KeyFigure("position, rms", "1.1 mm", "0.12 mm", "± 0.01 mm", "20 unseen poses", "0.2 mm", "yes")]
    return Section("Geometry", list(blocks), verdict, reason, figures)


def certificate_of(*sections: Section, details=NO_DETAILS, known=ROBOT, alert="", files=(), findings=()) -> Certificate:
    stages = [StageRecord(one, one.blocks, (), findings) for one in sections]
    return records("Calibration of x", "Geometry", known, stages, ["obstacles"], files, details, alert)[0]


def words(document: bytes) -> str:
    """Return the text of a PDF; where lines end and what only lets long words break is left out."""
    text = " ".join(one.extract_text() for one in PdfReader(io.BytesIO(document)).pages)
    return re.sub(r"[\s\u200b]", "", text)


def said(value: object) -> list[str]:
    """Return every text of a record that is shown, each without blanks."""
    if isinstance(value, str):
        return [re.sub(r"[\s\u200b]", "", value)]
    if isinstance(value, Picture):
        return said(value.caption)
    if isinstance(value, Judgement):
        return said([value.title, value.label, value.reason])
    if isinstance(value, ReportTable | Text | Pictures | Section | Certificate) or hasattr(value, "label"):
        hidden = {"kind", "strong", "numbers", "figures", "verdict", "reason"}
        if not isinstance(value, Certificate) and hasattr(value, "kind") and not len(value):  # type: ignore[arg-type]
            return []
        return [text for name, one in vars(value).items() if name not in hidden for text in said(one)]
    return [text for one in value for text in said(one)] if isinstance(value, list | tuple) else []


def test_table_is_alike_on_page_and_console():
    """A table has the same cells on the console and on the page."""
    written = report_of(judged(blocks=[TABLE]))
    tables = [one for one in re.findall(r"<table>.*?</table>", written, re.DOTALL) if "rms" in one and "arm" in one]
    assert len(tables) == 1
    rows = re.findall(r"<tr.*?</tr>", tables[0], re.DOTALL)
    on_page = [[cell for tag in ("th", "td") for cell in Reader(tag, row).found] for row in rows]
    said = [[cell.strip() for cell in re.split("[┃│]", line) if cell.strip()] for line in printed(TABLE).splitlines()]
    on_console = [row for row in said if row in on_page]
    assert on_page == on_console and [HOSTILE] in on_page
    assert printed(TABLE) == printed(TABLE, markup=True), "a text in brackets is a text, however it is printed"


def test_every_text_is_escaped_for_all():
    blocks = [TABLE, Text(HOSTILE, [HOSTILE]), Pictures(HOSTILE, [Picture(SVG, HOSTILE)])]
    section = Section(HOSTILE, blocks, "fail", HOSTILE, [KeyFigure(*[HOSTILE] * 7)])
    entries, files = [Entry(HOSTILE, HOSTILE)], [(HOSTILE, HOSTILE, "1", HOSTILE)]
    details, stages = CertificateSection(*[HOSTILE] * 12), [StageRecord(section, blocks, [HOSTILE], [HOSTILE])]
    one, whole = records(HOSTILE, HOSTILE, entries, stages, [HOSTILE], files, details, HOSTILE)
    assert "<script>" not in rendering.html(whole) + rendering.html(one)
    assert HOSTILE in printed(Text("", [HOSTILE])) and HOSTILE in printed(TABLE)
    assert words(rendering.pdf(one)[0]).count(re.sub(r"\s", "", HOSTILE)) > 20, "no markup of Typst's, either"


@pytest.mark.parametrize("verdict", ["pass", PREDICTION_ONLY, "marginal", "fail"])
def test_pdf_and_html_say_the_record(verdict):
    """PDF and HTML say what the record says."""
    details = CertificateSection(
        certificate_number="K-17", robot_serial="SN 0815", operator="Ä. Ünal", temperature="21.5 °C"
    )
    picture = Picture(SVG, "a histogram")
    blocks = [TABLE, Text("Worst pose", ["row 3: 0.3 mm"]), Pictures("Before and after", [picture]), Text("None", [])]
    section = judged(verdict, "because", blocks)
    one = certificate_of(section, details=details, alert="SIMULATED", files=FILES)
    document, notes = rendering.pdf(one)
    on_page = "".join(re.sub(r"[\s\u200b]", "", text) for text in Reader("body", rendering.html(one)).found)
    in_document = words(document)
    expected = said(one)
    assert len(expected) > 50 and {"K-17", "SN0815", "Ä.Ünal", "21.5°C", "±0.01mm", "0.2mm", "Because."} <= set(
        expected
    )
    assert [text for text in expected if text not in on_page] == []
    assert [text for text in expected if text not in in_document and text.upper() not in in_document] == []
    assert not notes and "None" not in on_page
    word = "PASS (prediction only)" if verdict == PREDICTION_ONLY else verdict.upper()
    assert one.verdicts[0].label == word


def test_report_is_complete_with_contents():
    """The report has a table of contents, and all of it."""
    long = " ".join(f"measured{k}.csv," for k in range(80))
    lines = [f"finding {k}" for k in range(3 * MAX_LINES)]
    section = judged("marginal", "because", [TABLE, Text("Notes", lines), Pictures("", [Picture(SVG, "no title")])])
    written = report_of(section, setup=[Entry("measurements", long)], files=FILES)
    contents = dict(re.findall(r'<a href="#([^"]+)">([^<]*)</a>', written))
    assert {"Result", "Verdict", "Geometry", "Errors", "Notes", "Setup", "Files", "Limitations"} <= set(
        contents.values()
    )
    for anchor, title in contents.items():
        assert re.search(rf'id="{anchor}">\s*<h[12]>{title}<', written), title
    assert long in written and all(line in written for line in lines) and all(row[3] in written for row in FILES)


def test_what_a_certificate_cuts_it_counts():
    lines = [f"finding {k} " + "x" * 400 for k in range(3 * MAX_LINES)]
    one = certificate_of(judged(blocks=[Text("Findings", lines)]))
    shown = next(block for block in one.sections[0].blocks if isinstance(block, Text)).lines
    assert len(shown) == MAX_LINES and shown[-1] == f"{3 * MAX_LINES - MAX_LINES + 1} more: see report.html."


def test_report_shows_paths_of_this_machine():
    """Paths of this machine stay in the report."""
    line = "/home/someone/cell/3-measured/validation.csv: 5 rows; see ~/notes.txt, 3-measured/a.csv and m/s"
    one = certificate_of(
        judged(blocks=[Text("Findings", [line])]), known=[Entry("description", "/home/someone/robot.urdf")]
    )
    assert one.sections[0].blocks[0].lines == ["validation.csv: 5 rows; see ~/notes.txt, 3-measured/a.csv and m/s"]
    assert one.setup == [Entry("description", "robot.urdf")]


@pytest.mark.parametrize(
    "entry",
    [
        "",
        pytest.param("W" * MAX_LETTERS, marks=pytest.mark.slow),
        pytest.param("🤖 漢字 " * 28, marks=pytest.mark.slow),
        pytest.param("مستشعر الليزر " * 14, marks=pytest.mark.slow),
        "שלום-SN-123 " * 16,
    ],
)
def test_any_entries_fit_four_pages(entry):
    """Everything at its bound: empty, long without a blank, emoji, Chinese, right to left."""
    details = CertificateSection(*[entry[:MAX_LETTERS].strip()] * 12)
    rows = [(f"joint{k}", *["1.234 N m"] * 6) for k in range(14)]
    table = ReportTable("Torque errors", tuple("abcdefg"), rows, "n" * 300, numbers=range(1, 7))
    text, pictures = Text("Findings", ["f " * 200] * 30), Pictures("", [Picture(SVG, "c" * 200, True)] * 2)
    sections = [replace(judged(reason="r " * 400, blocks=[table, pictures, text]), title=name) for name in ("A", "B")]
    sections = [replace(one, figures=[*one.figures] * 8) for one in sections]
    known = [Entry(label, entry or "value") for label in CERTIFIED_SETUP]
    lines = ["f " * 200] * 30
    one = certificate_of(*sections, details=details, known=known, files=FILES, findings=lines, alert="a" * 200)
    document, _ = rendering.pdf(one)
    assert rendering.pages(document) == len(PdfReader(io.BytesIO(document)).pages) <= MAX_PAGES
    if entry and entry.isascii():
        assert words(document).count(entry) == 12, "no serial number is cut"


def test_unprintable_letters_are_named(monkeypatch):
    """Letters that no font has are named, and the rest is printed."""
    one = certificate_of(judged(), details=CertificateSection(operator="田中 太郎", place="Labor 3"))
    monkeypatch.setattr(rendering, "_fonts", lambda: iter([([rendering.FONT], "a-2b"), ([rendering.FONT], None)]))
    document, notes = rendering.pdf(one)
    assert "Labor3" in words(document) and len(notes) == 1 and "'田'" in notes[0]
    assert "田中 太郎" in rendering.html(one)


def test_empty_blocks_are_left_out():
    """Blocks with nothing in them are left out."""
    section = judged(blocks=[Text("Nothing here", []), Pictures("Nor here", []), Text("This", ["line"])])
    written = report_of(section)
    assert "Nothing here" not in written and "Nor here" not in written and "This" in written
    assert printed(*section.blocks) == "line\n"


def test_a_forked_process_does_not_hang(tmp_path):
    """Typst's threads are not in a fork; the certificate is then written without a PDF, and that is said."""
    one, whole = certificate_of(judged()), report("x", "", (), [judged()])
    assert rendering.write(tmp_path, one, whole) == [] and (tmp_path / "certificate.pdf").read_bytes()[:4] == b"%PDF"
    if not (child := os.fork()):
        os._exit("forked" not in str(rendering.write(tmp_path, one, whole)))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["certificate.html", "report.html"]

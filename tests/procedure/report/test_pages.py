"""One table, two renderers: what the console prints is what the page says; the first sheet holds the verdict."""

import re
from datetime import UTC, datetime
from html.parser import HTMLParser
from io import StringIO

import pytest
from rich.console import Console

from calib.procedure.findings import PREDICTION_ONLY
from calib.procedure.report import certificate, page
from calib.procedure.report.page import KeyFigure, Picture, Pictures, Section, Table, Text

HOSTILE = "[bold]<script>alert(1)</script> & \"quoted\" 'one'[/]"
ROWS = [(HOSTILE,), ("nominal", "1.5"), ("calibrated", "0.25")]
TABLE = Table("Errors", ("arm", "rms"), ROWS, "how to read", frozenset({2}), (1,))


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


def page_of(*sections: Section, files=(), setup=(("robot", "ur5"),)):
    return certificate.certificate(
        "Calibration of x", "Geometry", setup, sections, files, datetime(2026, 1, 2, tzinfo=UTC)
    )


def judged(verdict: str = "pass", reason: str = "rms 0.1 mm", blocks=()) -> Section:
    figures = [KeyFigure("position, rms", "1.1 mm", "0.12 mm", "± 0.01 mm", "20 unseen poses", "0.2 mm")]
    return Section("Geometry", list(blocks), verdict, reason, figures)


def test_a_table_has_the_same_cells_on_the_console_and_on_the_page():
    written = certificate.render(page_of(judged(blocks=[TABLE])))
    tables = [one for one in re.findall(r"<table>.*?</table>", written, re.DOTALL) if "rms" in one and "arm" in one]
    assert len(tables) == 1
    rows = re.findall(r"<tr.*?</tr>", tables[0], re.DOTALL)
    on_page = [[cell for tag in ("th", "td") for cell in Reader(tag, row).found] for row in rows]
    said = [[cell.strip() for cell in re.split("[┃│]", line) if cell.strip()] for line in printed(TABLE).splitlines()]
    on_console = [row for row in said if row in on_page]
    assert on_page == on_console and [HOSTILE] in on_page
    assert printed(TABLE) == printed(TABLE, markup=True), "a text in brackets is a text, however it is printed"


def test_every_text_is_escaped_for_both():
    blocks = [TABLE, Text(HOSTILE, [HOSTILE]), Pictures(HOSTILE, [Picture(b"png", HOSTILE)])]
    section = Section(HOSTILE, blocks, "fail", HOSTILE, [KeyFigure(*[HOSTILE] * 6)])
    setup, files = [(HOSTILE, HOSTILE)], [(HOSTILE, HOSTILE, "1", HOSTILE)]
    made = certificate.certificate(HOSTILE, HOSTILE, setup, [section], files)
    assert "<script>" not in certificate.render(made)
    assert HOSTILE in printed(Text("", [HOSTILE])) and HOSTILE in printed(TABLE)


def sheet(written: str) -> str:
    return " ".join("".join(Reader("article", written).found).split())


@pytest.mark.parametrize("verdict", ["pass", PREDICTION_ONLY, "marginal", "fail"])
def test_the_first_sheet_stands_alone(verdict):
    files = [(f"file{k}.csv", "measured", "10", f"{k:064x}") for k in range(20)]
    first = sheet(certificate.render(page_of(judged(verdict, "because", [TABLE]), files=files)))
    word = "PASS (prediction only)" if verdict == PREDICTION_ONLY else verdict.upper()
    wanted = ("Calibration of x", word, "Because.", "1.1 mm", "0.12 mm", "± 0.01 mm", "20 unseen poses")
    for words in (
        *wanted,
        "0.2 mm",
        "2026-01-02",
        "armature-calib",
        "ur5",
        "file0.csv",
        "more, see Files",
        "Signature",
    ):
        assert words in first, words
    assert "how to read" not in first and not re.search(r"[0-9a-f]{64}", first)


def test_what_stands_behind_the_first_sheet_folds_on_screen_and_prints_unfolded():
    written = certificate.render(page_of(judged(blocks=[TABLE])))
    behind = written[written.index("</article>") :]
    assert re.findall(r"<summary>([^<]*)", behind) == ["Geometry", "Setup", "Limitations and conventions"]
    assert "how to read" in behind and "<details open" not in behind
    assert re.search(r"@media print \{.*details::details-content \{ content-visibility: visible", written, re.DOTALL)


def test_a_long_line_of_the_setup_is_cut_on_the_first_sheet_and_whole_behind_it():
    long = " ".join(f"measured{k}.csv," for k in range(80))
    written = certificate.render(page_of(judged(), setup=[("measurements", long)]))
    assert long not in sheet(written) and "measured0.csv" in sheet(written) and long in written


def test_blocks_with_nothing_in_them_are_left_out():
    section = judged(blocks=[Text("Nothing here", []), Pictures("Nor here", []), Text("This", ["line"])])
    written = certificate.render(page_of(section))
    assert "Nothing here" not in written and "Nor here" not in written and "This" in written
    assert printed(*section.blocks) == "line\n"

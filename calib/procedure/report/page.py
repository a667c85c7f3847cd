"""Elements of a report as values (tables, texts, pictures, sections), and their output on the console by rich.

Report and certificate show the same values as HTML and PDF; this module does not depend on robots.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from rich import box
from rich.console import RenderableType
from rich.table import Table as RichTable
from rich.text import Text as RichText

from calib.procedure.findings import LEVELS, Note
from calib.procedure.report.figures import figure_files
from calib.procedure.report.figures.charts import Captioned, Chart
from calib.procedure.report.figures.style import HALF_WIDTH

# name, what it is, bytes, SHA-256
FileRow = tuple[str, str, str, str]
# RSD [%] above which no value is printed: the parameter is unknown
MAX_PRINTED_RSD = 999.0
# letters of what a screen reader says of a figure
MAX_SUMMARY_LETTERS = 400
COLOURS: dict[str, str] = dict(zip(LEVELS, ("green", "green", "yellow", "yellow", "red")))


@dataclass(frozen=True)
class ReportTable:
    """Table of a report: rows of text under a header.

    Attributes:
        title: title of the table.
        header: names of the columns.
        rows: cells of each row; a row with one cell is a heading above the next rows.
        note: explanation for the reader.
        strong: indices of the rows in bold.
        numbers: indices of the right-aligned columns.
        kind: name of the kind of block, for the templates.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    strong: frozenset[int] = frozenset()
    numbers: Sequence[int] = ()
    kind: str = "table"

    def __len__(self) -> int:
        return len(self.rows)


class RecordColumn(NamedTuple):
    """A column of a table of records.

    Attributes:
        name: name of the column.
        cell: format of a cell (``{0.sigma:.2g}``), or function that returns the text for a record.
        number: whether the column is right-aligned.
    """

    name: str
    cell: str | Callable[..., str]
    number: bool = True

    def of(self, record: object) -> str:
        """Return the text in this column for a record."""
        if isinstance(self.cell, str):
            return self.cell.format(record)
        return self.cell(record)


def _never(record: object) -> bool:
    return False


def table(
    title: str,
    columns: Sequence[RecordColumn],
    records: Sequence[object],
    note: str = "",
    strong: Callable[..., bool] = _never,
    most: int | None = None,
) -> ReportTable:
    """Return a table with one row per record.

    Args:
        title: title of the table.
        columns: the columns.
        records: the records.
        note: explanation for the reader.
        strong: function of a record that returns whether its row is bold.
        most: largest number of rows; None: all records.
    """
    if most is not None and len(records) > most:
        note = f"{note} {len(records) - most} more in metrics.json."
        records = records[:most]
    header = [column.name for column in columns]
    numbers = [k for k, column in enumerate(columns) if column.number]
    rows = []
    bold = set()
    for k, record in enumerate(records):
        rows.append([column.of(record) for column in columns])
        if strong(record):
            bold.add(k)
    return ReportTable(title, header, rows, note, frozenset(bold), numbers)


def grouped(
    title: str,
    header: Sequence[str],
    groups: Mapping[str, Iterable[Sequence[str]]],
    note: str = "",
    strong: Callable[[Sequence[str]], bool] = _never,
    texts: int = 1,
) -> ReportTable:
    """Return a table with groups of rows under headings.

    Args:
        title: title of the table.
        header: names of the columns.
        groups: heading -> rows.
        note: explanation for the reader.
        strong: function of a row that returns whether the row is bold.
        texts: number of left-aligned text columns at the left; the other columns are right-aligned.
    """
    rows: list[Sequence[str]] = []
    for heading, group in groups.items():
        rows.append((heading,))
        rows += group
    bold = frozenset(k for k, row in enumerate(rows) if strong(row))
    return ReportTable(title, header, rows, note, bold, range(texts, len(header)))


def shortened(text: str, max_letters: int) -> str:
    """Return a text, cut between words and ended by an ellipsis if it is longer than `max_letters`."""
    if len(text) <= max_letters:
        return text
    words, *_ = text[: max_letters - 1].rsplit(" ", 1)
    return f"{words} …"


@dataclass(frozen=True)
class Text:
    """A list of sentences.

    Attributes:
        title: title above the sentences; empty: none.
        lines: the sentences; a `Note` may be a warning.
        label: word before each sentence on the console; a warning has ``warning`` instead.
        kind: name of the kind of block, for the templates.
    """

    title: str
    lines: Sequence[str | Note]
    label: str = ""
    kind: str = "text"

    def __len__(self) -> int:
        return len(self.lines)


@dataclass(frozen=True)
class Picture:
    """A drawn figure, as PNG or SVG.

    Attributes:
        image: content of the PNG or SVG file.
        caption: caption of the figure.
        wide: whether the figure uses the full width of the page.
    """

    image: bytes
    caption: str
    wide: bool = False


@dataclass(frozen=True)
class ChartPicture:
    """A figure that the page draws from its chart.

    Attributes:
        chart: the chart.
        caption: caption of the figure.
        name: name of the figure; on a page no two figures have the same.
    """

    chart: Chart
    caption: str
    name: str = "figure"

    @property
    def wide(self) -> bool:
        """Whether the figure uses the full width of the page."""
        return self.chart.width > HALF_WIDTH

    @property
    def image(self) -> bytes:
        """The figure as PNG, drawn by matplotlib."""
        return figure_files.drawn(self.chart, "png")

    @property
    def still(self) -> bytes:
        """The figure as SVG, for viewers that run no scripts."""
        return figure_files.drawn(self.chart, "svg")

    def vector(self) -> Picture:
        """Return the figure as a vector picture (SVG) for print."""
        return Picture(self.still, self.caption, self.wide)

    @property
    def summary(self) -> str:
        """What the figure shows, for those who do not see it: its titles, and the quantities along its axes."""
        texts = [self.caption, self.chart.title]
        for panel in self.chart.panels:
            texts += [panel.title, f"{panel.y or panel.title} over {panel.x}" * bool(panel.x)]
        sentences = dict.fromkeys(text.rstrip(".") for text in texts if text)
        return shortened("; ".join(sentences), MAX_SUMMARY_LETTERS)


def chart_pictures(charts: Mapping[str, Captioned]) -> dict[str, ChartPicture]:
    """Return charts with captions as figures of a page, by name."""
    return {name: ChartPicture(chart, caption, name) for name, (chart, caption) in charts.items()}


@dataclass(frozen=True)
class Pictures:
    """Figures that are shown side by side."""

    title: str
    pictures: Sequence[Picture | ChartPicture]
    kind: str = "pictures"

    def __len__(self) -> int:
        return len(self.pictures)


def pictures(title: str, figures: Mapping[str, ChartPicture], names: Iterable[str]) -> Pictures:
    """Return the figures with the given names, to be shown side by side; absent figures are left out.

    Args:
        title: title above the figures.
        figures: name -> figure.
        names: names of the figures to show.
    """
    return Pictures(title, [figures[name] for name in names if name in figures])


Block = ReportTable | Text | Pictures


@dataclass(frozen=True)
class KeyFigure:
    """A number on which a verdict is based, as text.

    Attributes:
        quantity: name of the quantity.
        before, after: value for the nominal and for the calibrated robot, with unit.
        spread: standard error of the value.
        basis: number of poses or motions from which the value was computed, and whether they were held out.
        allowed: the tolerance; empty: no tolerance is shown.
        met: whether the tolerance is met.
    """

    quantity: str
    before: str
    after: str
    spread: str = ""
    basis: str = ""
    allowed: str = ""
    met: str = ""


def met(value: float, tolerance: float) -> str:
    """Return ``yes`` or ``NO``: whether a value is within a tolerance; empty without a tolerance (0)."""
    if not tolerance:
        return ""
    return "yes" if value <= tolerance else "NO"


@dataclass(frozen=True)
class Section:
    """A part of a report.

    Attributes:
        title: title of the section.
        blocks: tables, texts and pictures.
        verdict, reason: level of the verdict (pass, marginal, fail) and its reason; empty for sections that are not on
            a judged result.
        figures: numbers on which the verdict is based.
    """

    title: str
    blocks: Sequence[Block]
    verdict: str = ""
    reason: str = ""
    figures: Sequence[KeyFigure] = ()


def number(value: float, unit: str = "") -> str:
    """Return a value with three significant digits and its unit as text; a dash if it is not finite."""
    return f"{value:.3g}{unit}" if math.isfinite(value) else "–"


def relative_sigma(percent: float | None) -> str:
    """Return a relative standard deviation `percent` [%] as text; empty if it is None or above `MAX_PRINTED_RSD`."""
    if percent is None or percent > MAX_PRINTED_RSD:
        return ""
    if percent >= 10:
        return f"{percent:.0f} %"
    return f"{percent:.2g} %"


def rendered(blocks: Iterable[Block]) -> Iterator[RenderableType]:
    """Yield each table and text as a rich renderable; pictures and empty blocks are left out."""
    for block in blocks:
        if not len(block):
            continue
        if isinstance(block, ReportTable):
            yield _rich_table(block)
        elif isinstance(block, Text):
            for line in block.lines:
                label = block.label
                if isinstance(line, Note) and line.is_warning:
                    label = "warning"
                printed = RichText()
                if label:
                    printed.append(label, "yellow")
                    printed.append(": ")
                yield printed.append(single_colons(str(line)))


def single_colons(line: str) -> str:
    """Return a line in which a single colon replaces a doubled one.

    The name of a recording cut as ``log.npz@10:`` ends with a colon.
    """
    return line.replace(":: ", ": ")


def _rich_table(table: ReportTable) -> RichTable:
    """Return a table as a rich renderable."""
    title = table.title[:1].lower() + table.title[1:]
    caption = RichText(table.note) if table.note else None
    result = RichTable(
        title=RichText(title), title_justify="left", caption=caption, caption_justify="left", box=box.HEAVY_HEAD
    )
    numbers = set(table.numbers)
    for k, name in enumerate(table.header):
        justify: Literal["left", "right"] = "right" if k in numbers else "left"
        result.add_column(RichText(name), justify=justify, overflow="fold")
    for number, row in enumerate(table.rows):
        if len(row) == 1 and len(table.header) > 1:
            result.add_section()
            result.add_row(RichText(row[0], style="bold"))
        else:
            style = "bold" if number in table.strong else ""
            result.add_row(*map(RichText, row), style=style)
    return result


def section(section: Section) -> Iterator[RenderableType]:
    """Yield, as rich renderables, the verdict of a section with its reason, and then the section's content."""
    if section.verdict:
        style = f"bold {COLOURS[section.verdict]}"
        yield RichText.assemble("verdict: ", (section.verdict, style), f": {section.reason}")
    yield from rendered(section.blocks)

"""The values of `page` for rich to print: the same tables and sentences that a certificate holds."""

from collections.abc import Iterable, Iterator

from rich import box
from rich.console import RenderableType
from rich.table import Table as RichTable
from rich.text import Text as RichText

from calib.procedure.findings import LEVELS, Warned
from calib.procedure.report.page import Block, Section, Table, Text

COLOURS: dict[str, str] = dict(zip(LEVELS, ("green", "green", "yellow", "red")))


def rendered(blocks: Iterable[Block]) -> Iterator[RenderableType]:
    """Yield each block as rich prints it; pictures are left out."""
    for block in blocks:
        if isinstance(block, Table):
            yield _rich_table(block)
        elif isinstance(block, Text):
            for line in block.lines:
                label = "warning" if isinstance(line, Warned) else block.label
                yield RichText.assemble(*([(label, "yellow"), ": "] if label else []), line.replace(":: ", ": "))


def _rich_table(table: Table) -> RichTable:
    """Return a table of `page` as rich's."""
    title = table.title[:1].lower() + table.title[1:]
    result = RichTable(
        title=RichText(title), title_justify="left", caption=RichText(table.note) if table.note else None,
        caption_justify="left", box=box.HEAVY_HEAD,
    )  # fmt: skip
    numbers = set(table.numbers)
    for k, name in enumerate(table.header):
        result.add_column(RichText(name), justify="right" if k in numbers else "left")
    for number, row in enumerate(table.rows):
        if len(row) == 1 and len(table.header) > 1:
            result.add_section()
            result.add_row(RichText(row[0], style="bold"))
        else:
            result.add_row(*map(RichText, row), style="bold" if number in table.strong else "")
    return result


def section(shown: Section) -> Iterator[RenderableType]:
    """Yield the blocks of a section, and its verdict with the reason."""
    yield from rendered(shown.blocks)
    if shown.verdict:
        yield RichText.assemble("verdict: ", (shown.verdict, f"bold {COLOURS[shown.verdict]}"), f": {shown.reason}")

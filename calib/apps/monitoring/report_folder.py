"""Folder of a comparison, a drift study or a log: report.html with figures, tables, metrics.json."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from calib import files, folders
from calib.config_types import Plots
from calib.toolkit.report_pages import ChartPicture, Pictures, Section

if TYPE_CHECKING:
    from calib.toolkit.report_charts import Captioned, Chart

PAGE = "report.html"


class ResultPart(NamedTuple):
    """A section of the report page.

    Attributes:
        section: the section.
        charts: figures by name.
        captions: captions of the figures.
        table: name, header and rows of a table that is written as a file.
    """

    section: Section
    charts: Mapping[str, Chart]
    captions: Sequence[str]
    table: tuple[str, Sequence[str], Iterable[Sequence[object]]]


def save(
    out: Path,
    kind: str,
    title: str,
    setup: Mapping[str, str],
    parts: Sequence[ResultPart],
    numbers: object,
    tables: Sequence[str],
    plots: Plots = True,
) -> Path:
    """Write a result into the folder `out` and return its path.

    Args:
        out: the folder.
        kind: kind of the result, for messages.
        title: title of the report page.
        setup: name to text of the facts at the head of the page.
        parts: sections of the page.
        numbers: content of ``metrics.json``.
        tables: names of all tables that this kind of result may write.
        plots: a format writes the figures as files, too.

    Raises:
        UsageError: the folder contains files that are not of such a result.
    """
    file_names = (*tables, PAGE, folders.METRICS, *folders.figure_files("*"))
    folders.check_target(out, file_names, (folders.METRICS, PAGE), kind)
    return folders.write_staged(out, file_names, lambda folder: _write(folder, title, setup, parts, numbers, plots))


def _write(
    folder: Path, title: str, setup: Mapping[str, str], parts: Sequence[ResultPart], numbers: object, plots: Plots
) -> None:
    from calib.toolkit.report_charts import write_figures
    from calib.toolkit.report_pages import Entry, as_html, report_page

    sections = []
    charts: dict[str, Captioned] = {}
    for part in parts:
        drawings = []
        for (name, chart), caption in zip(part.charts.items(), part.captions):
            drawings.append(ChartPicture(chart, caption, name))
            charts[name] = chart, caption
        blocks = [*part.section.blocks, Pictures("", drawings)]
        sections.append(replace(part.section, blocks=blocks))
        name, header, rows = part.table
        files.write_table(folder / name, header, rows)
    entries = [Entry(*fields) for fields in setup.items()]
    page = report_page(title, " to ".join(setup.values()), entries, sections)
    files.write(folder / PAGE, as_html(page))
    write_figures(folder, charts, plots, paged=True)
    files.write_json(folder / folders.METRICS, numbers)

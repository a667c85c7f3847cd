"""Certificates and reports as HTML (one file without external resources) and as PDF (PDF/A-2b, by Typst).

The templates only arrange the texts of the records. The PDF uses the font that matplotlib contains; fonts installed on
the computer are used only for letters that this font lacks.
"""

import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from calib import files
from calib.folders import PAGES
from calib.procedure.report.certificate.record import MAX_PAGES, Certificate, Page
from calib.procedure.report.figures import figure_data
from calib.procedure.report.figures.charts import Captioned
from calib.procedure.report.page import ChartPicture, Pictures
from calib.procedure.report.templates import filled, interactive, read
from calib.records import plain
from calib.workers.extras import installed, lacking

PACKAGE = "calib.procedure.report.certificate"
FONT = "DejaVu Sans"
# refuses letters that no font shows
STANDARD = "a-2b"


def write(folder: Path, certificate: Certificate, report: Page) -> list[str]:
    """Write a certificate as HTML and PDF, and the report as HTML, into a folder; return notes for the user."""
    document, notes = pdf(certificate)
    for name, content in zip(PAGES, (html(certificate), document, html(report))):
        if content:
            files.write(folder / name, content)
        else:
            (folder / name).unlink(missing_ok=True)
    for name, content in figure_data.whole_figures(_charts(report)):
        files.write(folder / name, content)
    return notes


def _charts(page: Page) -> dict[str, Captioned]:
    """Return the charts of a page with their captions, by name."""
    charts = {}
    for section in page.sections:
        for block in section.blocks:
            if isinstance(block, Pictures):
                for picture in block.pictures:
                    if isinstance(picture, ChartPicture):
                        charts[picture.name] = picture.chart, picture.caption
    return charts


def write_figures(folder: Path, page: Page) -> int:
    """Write the figures of a report as SVG into a folder, numbered by section; return the number of figures.

    Args:
        folder: the folder.
        page: the report.
    """
    count = 0
    for section in page.sections:
        pictures: list[ChartPicture] = []
        for block in section.blocks:
            if isinstance(block, Pictures):
                pictures += [picture for picture in block.pictures if isinstance(picture, ChartPicture)]
        for number, picture in enumerate(pictures, 1):
            image = picture.vector().image
            files.write(folder / f"{section.title.lower()}_{number}.svg", image)
        count += len(pictures)
    return count


def html(page: Page) -> str:
    """Return a certificate or report (`page`) as HTML."""
    if isinstance(page, Certificate):
        return filled(PACKAGE, "sheet.html", page=page)
    sections, figures = interactive(page.sections)
    return filled(PACKAGE, "report.html", page=replace(page, sections=sections), figures=figures)


def pdf(page: Certificate) -> tuple[bytes, list[str]]:
    """Return a certificate as PDF, and notes for the user.

    A certificate above `MAX_PAGES` pages, which only very long entries cause, is set in smaller type. The PDF is empty
    in a process forked from one that has used Typst, since Typst's threads do not exist after a fork, and where Typst
    or matplotlib is not installed.
    """
    if _first_user() != os.getpid():
        return b"", [f"{PAGES[1]} was not written, since this process was forked: start processes by spawn"]
    for module in ("typst", "matplotlib"):
        if not installed(module):
            return b"", [f"{PAGES[1]} was not written; {lacking(module)}"]
    images: dict[str, bytes] = {}

    def as_json(value: Any) -> object:
        if not isinstance(value, bytes):
            return list(value)
        name = f"{len(images)}.svg"
        images[name] = value
        return name

    content = json.dumps(plain(page), default=as_json)
    template = read(PACKAGE, "sheet.typ")
    inputs = {"main.typ": template.encode(), "page.json": content.encode(), **images}
    document, notes = _typeset(inputs, dense=False)
    if pages(document) > MAX_PAGES:
        return _typeset(inputs, dense=True)
    return document, notes


@cache
def _first_user() -> int:
    return os.getpid()


def pages(document: bytes) -> int:
    """Return the number of pages of a PDF (`document`, the file's content) written by Typst."""
    return len(re.findall(rb"/Type\s*/Page\b", document))


def _typeset(inputs: Mapping[str, bytes], dense: bool) -> tuple[bytes, list[str]]:
    """Return the PDF that Typst makes, and a note on letters that no font has.

    Args:
        inputs: file name -> content, of the template and the texts.
        dense: whether smaller type is used.
    """
    import typst  # 80 MB, and needed for nothing else

    matplotlib_package = find_spec("matplotlib")
    assert matplotlib_package is not None and matplotlib_package.origin is not None
    font_folder = str(Path(matplotlib_package.origin).parent / "mpl-data/fonts/ttf")
    notes: list[str] = []
    for families, standard in _fonts():
        setting = json.dumps({"fonts": families, "dense": dense}).encode()
        all_inputs: Any = {**inputs, "setting.json": setting}
        own_font = families == [FONT]
        try:
            document: Any = typst.compile(
                all_inputs, font_paths=[font_folder], ignore_system_fonts=own_font, pdf_standards=standard
            )
            return document, notes
        except typst.TypstError as error:
            lacking = re.search('the text `"(.*)"` could not be displayed', str(error))
            if lacking is None or not standard:
                raise
            notes = [f"{PAGES[1]}: no font here has {lacking[1]!r}: a box replaces it; {PAGES[0]} shows it"]
    raise AssertionError("without a standard every letter is accepted")


def _fonts() -> Iterator[tuple[list[str], Any]]:
    """Yield lists of fonts in the order of the trials, each with a PDF standard; None: PDF without a standard."""
    import typst

    yield [FONT], STANDARD
    installed = typst.Fonts(include_system_fonts=True, include_embedded_fonts=True).families()
    families = [FONT, *installed]
    yield families, STANDARD
    yield families, None

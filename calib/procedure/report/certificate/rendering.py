"""Certificates and reports as HTML (one file that loads nothing) and as PDF (PDF/A-2b, by Typst).

The templates place what the records say, and add no words. The PDF's font is the one that comes with matplotlib; the
computer's own fonts are looked through only for letters that it lacks.
"""

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from calib import files
from calib.folders import PAGES
from calib.procedure.report.certificate.record import MAX_PAGES, Certificate, Page
from calib.procedure.report.page import Pictures
from calib.procedure.report.templates import filled, read
from calib.records import plain

HERE = "calib.procedure.report.certificate"
FONT = "DejaVu Sans"
OURS = str(Path(find_spec("matplotlib").origin or "").parent / "mpl-data/fonts/ttf")  # type: ignore[union-attr]
STANDARD = "a-2b"  # refuses letters that no font shows


def write(folder: Path, one: Certificate, whole: Page) -> list[str]:
    """Write a certificate as HTML and PDF and the report into a folder; return what there is to say."""
    made, notes = pdf(one)
    for name, content in zip(PAGES, (html(one), made, html(whole))):
        if content:
            files.write(folder / name, content)
        else:
            (folder / name).unlink(missing_ok=True)
    return notes


def write_figures(folder: Path, page: Page) -> int:
    """Write the figures of a report as SVG into a folder, numbered by section; return how many there are."""
    from calib.procedure.report.charts import vector

    count = 0
    for section in page.sections:
        drawn = [one for block in section.blocks if isinstance(block, Pictures) for one in block.pictures]
        for number, one in enumerate(drawn, 1):
            files.write(folder / f"{section.title.lower()}_{number}.svg", vector(one.chart, one.caption).image)
        count += len(drawn)
    return count


def html(page: Page) -> str:
    """Return a certificate or report as HTML."""
    return filled(HERE, "sheet.html" if isinstance(page, Certificate) else "report.html", page=page)


def pdf(page: Certificate) -> tuple[bytes, list[str]]:
    """Return a certificate as PDF, and what there is to say of it.

    Where it would have more than `MAX_PAGES` pages, which only very long entries bring about, it is set smaller. Empty
    in a process forked from one that has used Typst: its threads are not there, and it would wait for them for ever.
    """
    if _first_user() != os.getpid():
        return b"", [f"{PAGES[1]} was not written, since this process was forked: start processes by spawn"]
    images: dict[str, bytes] = {}

    def named(value: bytes | Iterable[object]) -> object:
        if not isinstance(value, bytes):
            return list(value)
        images[f"{len(images)}.svg"] = value
        return f"{len(images) - 1}.svg"

    content = json.dumps(plain(page), default=named)
    given = {"main.typ": read(HERE, "sheet.typ").encode(), "page.json": content.encode(), **images}
    made, notes = _typeset(given, dense=False)
    return (made, notes) if pages(made) <= MAX_PAGES else _typeset(given, dense=True)


@cache
def _first_user() -> int:
    return os.getpid()


def pages(document: bytes) -> int:
    """Return the number of pages of a PDF by Typst."""
    return len(re.findall(rb"/Type\s*/Page\b", document))


def _typeset(given: Mapping[str, bytes], dense: bool) -> tuple[bytes, list[str]]:
    """Return the PDF of a template and its files, and a note on letters that no font has."""
    import typst  # 80 MB, and needed for nothing else

    notes: list[str] = []
    for families, standard in _fonts():
        setting = json.dumps({"fonts": families, "dense": dense}).encode()
        try:
            files: dict[str, bytes] = {**given, "setting.json": setting}
            ours = families == [FONT]
            made: Any = typst.compile(files, font_paths=[OURS], ignore_system_fonts=ours, pdf_standards=standard)
            return made, notes
        except typst.TypstError as error:
            lacking = re.search('the text `"(.*)"` could not be displayed', str(error))
            if lacking is None or not standard:
                raise
            notes = [f"{PAGES[1]}: no font here has {lacking[1]!r}: a box stands for it; {PAGES[0]} shows it"]
    raise AssertionError("without a standard every letter is accepted")


def _fonts() -> Iterator[tuple[list[str], Any]]:
    """Yield families of fonts to try one after the other, and the standard of the PDF."""
    import typst

    yield [FONT], STANDARD
    every = [FONT, *typst.Fonts(include_system_fonts=True, include_embedded_fonts=True).families()]
    yield every, STANDARD
    yield every, None

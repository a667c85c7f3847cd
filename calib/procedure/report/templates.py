"""HTML pages from templates in a common style, with date and versions, which all pages state."""

from __future__ import annotations

import base64
import hashlib
import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from functools import cache
from importlib import metadata, resources
from typing import TYPE_CHECKING

from calib.procedure.report.figures import figure_data
from calib.procedure.report.figures.charts import Captioned
from calib.procedure.report.page import ChartPicture, Pictures, Section

if TYPE_CHECKING:
    import jinja2

HERE = "calib.procedure.report"  # where the templates of blocks and the style are
BROWSER = "calib.procedure.report.figures.browser"
# what draws figures in the browser: uPlot (see vendored.toml) and what uses it
BROWSER_FILES = {
    "library": "uPlot.iife.min.js",
    "library_style": "uPlot.min.css",
    "style": "figures.css",
    "script": "figures.js",
}


@cache
def versions() -> str:
    """Return a text with the versions of the toolkit, of the libraries on which the results depend, and of Python."""
    names = ("armature-calib", "numpy", "scipy")
    known = ", ".join(f"{name} {metadata.version(name)}" for name in names)
    return f"{known}, Python {platform.python_version()}"


def issued(now: datetime | None = None) -> str:
    """Return a text with date and toolkit version, for a page.

    Args:
        now: the date; None: the current date.
    """
    when = (now or datetime.now().astimezone()).strftime("%Y-%m-%d %H:%M %Z").strip()
    return f"{when}, armature-calib {metadata.version('armature-calib')}"


def read(package: str, file: str) -> str:
    """Return the text of a file in an installed package."""
    return resources.files(package).joinpath(file).read_text(encoding="utf-8")


def filled(package: str, file: str, **values: object) -> str:
    """Return a template filled with values.

    Templates may import ``blocks.html``, extend another one of their package, and print the variable ``style``, which
    contains the common style sheet.

    Args:
        package: package that contains the template.
        file: name of the template.
        values: values of the template's variables.
    """
    return _template(package, file).render(**values, style=read(HERE, "style.css"))


def interactive(sections: Sequence[Section]) -> tuple[list[Section], Mapping[str, str]]:
    """Return the sections of a page with numbered figures, and what draws these in the browser.

    The latter has the keys of `BROWSER_FILES` and ``data``; it is empty without figures.

    Args:
        sections: sections of the page.
    """
    charts: dict[str, Captioned] = {}
    numbered = []
    for section in sections:
        blocks = [_numbered(block, charts) if isinstance(block, Pictures) else block for block in section.blocks]
        numbered.append(replace(section, blocks=blocks))
    if not charts:
        return numbered, {}
    browser = {key: read(BROWSER, name) for key, name in BROWSER_FILES.items()}
    return numbered, browser | {"data": figure_data.page_text(charts)}


@cache
def script_sources() -> str:
    """Return the scripts of a page as sources of a Content-Security-Policy: their SHA-256, so that no others run."""
    sources = []
    for key in ("library", "script"):
        digest = hashlib.sha256(read(BROWSER, BROWSER_FILES[key]).encode()).digest()
        sources.append(f"'sha256-{base64.b64encode(digest).decode()}'")
    return " ".join(sources)


def _numbered(block: Pictures, charts: dict[str, Captioned]) -> Pictures:
    """Return a block whose figures have names that no figure in `charts` has, and add them there.

    Args:
        block: the figures.
        charts: charts with captions of the page so far, by name.
    """
    pictures = []
    for picture in block.pictures:
        if isinstance(picture, ChartPicture):
            name, number = picture.name, 2
            while name in charts:
                name, number = f"{picture.name}_{number}", number + 1
            charts[name] = picture.chart, picture.caption
            picture = replace(picture, name=name)
        pictures.append(picture)
    return replace(block, pictures=pictures)


@cache
def _template(package: str, file: str) -> jinja2.Template:
    """Return the compiled template in a file of a package; templates are cached within a process."""
    import jinja2  # slow to load, and not needed to write the rest

    def template_text(name: str) -> str:
        return read(package if resources.files(package).joinpath(name).is_file() else HERE, name)

    loader = jinja2.FunctionLoader(template_text)
    undefined = jinja2.StrictUndefined
    environment = jinja2.Environment(autoescape=True, undefined=undefined, trim_blocks=True, loader=loader)
    environment.filters["data_uri"] = lambda image: f"data:{_kind(image)};base64,{base64.b64encode(image).decode()}"
    return environment.from_string(read(package, file))


def _kind(image: bytes) -> str:
    return "image/png" if image[:4] == b"\x89PNG" else "image/svg+xml"

"""HTML pages from templates in a common style, with date and versions, which all pages state."""

from __future__ import annotations

import base64
import platform
from datetime import datetime
from functools import cache
from importlib import metadata, resources
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import jinja2

HERE = "calib.procedure.report"  # where the templates of blocks and the style are


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

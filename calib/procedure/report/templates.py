"""Pages from templates in a common style, with the date and the versions that all of them state."""

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
    """Return the versions of the toolkit and of the libraries that its results depend on."""
    names = ("armature-calib", "numpy", "scipy")
    known = ", ".join(f"{name} {metadata.version(name)}" for name in names)
    return f"{known}, Python {platform.python_version()}"


def issued(now: datetime | None = None) -> str:
    """Return date and toolkit version of a page as text."""
    when = (now or datetime.now().astimezone()).strftime("%Y-%m-%d %H:%M %Z").strip()
    return f"{when}, armature-calib {metadata.version('armature-calib')}"


def read(package: str, file: str) -> str:
    """Return the text of a file that is shipped in a package."""
    return resources.files(package).joinpath(file).read_text(encoding="utf-8")


def filled(package: str, file: str, **values: object) -> str:
    """Return a package's template, filled with values; it may import ``blocks.html`` and print the common `style`."""
    return _template(package, file).render(**values, style=read(HERE, "style.css"))


@cache
def _template(package: str, file: str) -> jinja2.Template:
    """Return the compiled template of a file, cached within a process."""
    import jinja2  # slow to load, and not needed to write the rest

    loader = jinja2.FunctionLoader(lambda name: read(HERE, name))
    undefined = jinja2.StrictUndefined
    environment = jinja2.Environment(autoescape=True, undefined=undefined, trim_blocks=True, loader=loader)
    environment.filters["data_uri"] = lambda image: f"data:{_kind(image)};base64,{base64.b64encode(image).decode()}"
    return environment.from_string(read(package, file))


def _kind(image: bytes) -> str:
    return "image/png" if image[:4] == b"\x89PNG" else "image/svg+xml"

"""A `page.Page` as HTML: one file without any outside reference, for the screen and for paper."""

from __future__ import annotations

import base64
from importlib import resources

import jinja2

from calib.procedure.report.page import Page

WORDS = {"pass": "PASS", "marginal": "MARGINAL", "fail": "FAIL"}


def render(page: Page) -> str:
    """Return the page as HTML."""
    here = resources.files("calib.procedure.report")
    source = here.joinpath("certificate.html").read_text(encoding="utf-8")
    style = here.joinpath("certificate.css").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.filters["data_uri"] = lambda png: f"data:image/png;base64,{base64.b64encode(png).decode()}"
    return environment.from_string(source).render(page=page, style=style, words=WORDS)

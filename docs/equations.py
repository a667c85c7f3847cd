"""Equations as drawings (SVG), made by ziamath while the pages are built: no script, no font, no network.

An equation with a command that ziamath does not know, or cannot draw, is a warning, with which the build fails.
"""

from typing import Any

import ziamath
from docutils import nodes
from sphinx.util import logging

EM = 20.0  # units of a drawing per letter height of the text around it
MAX_HEIGHT = 8.0  # letter heights; fences around some formulas come out many times as tall
ziamath.config.svg2 = False  # every drawing with its own paths
LOG = logging.getLogger(__name__)


def _drawing(node: Any, inline: bool) -> str:
    """Return the drawing of a node's equation, in units of the letters around it and on their base line."""
    formula = ziamath.Latex(node.astext(), size=EM, inline=inline)
    if "\\" in "".join(formula.mathml.itertext()):
        LOG.warning("equation with an unknown command: %s", node.astext(), location=node)
    svg = formula.svgxml()
    if float(svg.get("height")) > MAX_HEIGHT * EM:
        LOG.warning("equation came out too tall: %s", node.astext(), location=node)
    width = float(svg.attrib.pop("width")) / EM
    height = float(svg.attrib.pop("height")) / EM
    base_line = formula.getyofst() / EM
    svg.set("style", f"width:{width:.3f}em;height:{height:.3f}em;vertical-align:{base_line:.3f}em")
    svg.set("role", "img")
    svg.set("aria-label", node.astext())
    return ziamath.zmath.ET.tostring(svg, encoding="unicode")


def visit_inline(self: Any, node: Any) -> None:
    """Write an equation in a line of text."""
    self.body.append(f'<span class="math">{_drawing(node, inline=True)}</span>')
    raise nodes.SkipNode


def visit_block(self: Any, node: Any) -> None:
    """Write an equation that stands by itself, with its number where it has one."""
    number = ""
    if node.get("number"):
        number = f'<span class="eqno">({node["number"]})</span>'
    ids = ""
    if node["ids"]:
        ids = f' id="{node["ids"][0]}"'
    self.body.append(f'<div class="math"{ids}>{_drawing(node, inline=False)}{number}</div>')
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, Any]:
    """Register the renderer with Sphinx."""
    app.add_html_math_renderer("drawings", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}

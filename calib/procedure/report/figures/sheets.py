"""Sheets of matplotlib in the common style: light axes, PNG with a colour palette.

Margins are those of matplotlib's constrained layout. Text is never interpreted as mathematics, so that a ``$`` in a
name is printed as a ``$``.
"""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, YAxis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import LogLocator, NullLocator
from PIL import Image

from calib import files
from calib.procedure.report.figures.style import HALF_WIDTH, INK, QUIET, number

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

# of print
DPI = 200
# of a PNG with a palette, a third as large as one without
COLOURS = 256
STYLE: "dict[RcKeyType, str | float | bool]" = {
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "axes.titlesize": 8.5,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titley": 1.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": QUIET,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.axisbelow": True,
    "text.color": INK,
    "text.parse_math": False,
    "text.hinting": "none",  # of no use at this many dots per inch
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "grid.color": "#e3e5e8",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.borderpad": 0.0,
    "legend.borderaxespad": 0.2,
}


@contextmanager
def styled(quiet_titles: bool = False) -> Iterator[None]:
    """Apply the common figure style within a context, and restore matplotlib's settings afterwards.

    Args:
        quiet_titles: whether the titles of panels are small.
    """
    settings = dict(STYLE)
    if quiet_titles:
        settings |= {"axes.titleweight": "normal", "axes.titlesize": 7.5}
    with matplotlib.rc_context(settings):
        yield


class ShownFigure(Figure):
    """A matplotlib figure that a notebook shows as PNG without pyplot."""

    def _repr_png_(self) -> bytes:
        return png(self)


def sheet(
    rows: int = 1, columns: int = 1, width: float = HALF_WIDTH, height: float = 2.5, head: float = 0.0
) -> tuple[Figure, list[Axes]]:
    """Return a matplotlib figure without a window, and its axes row by row.

    Args:
        rows, columns: numbers of rows and columns of axes.
        width, height: size of the figure [in].
        head: height kept free at the top for `legend` [in].
    """
    drawn_part = (0.0, 0.0, 1.0, 1.0 - head / height)
    layout = ConstrainedLayoutEngine(rect=drawn_part, w_pad=0.04, h_pad=0.04, wspace=0.0, hspace=0.0)
    figure = ShownFigure(figsize=(width, height), layout=layout)
    return figure, list(figure.subplots(rows, columns, squeeze=False).flat)


def log_axis(axis: XAxis | YAxis, low: float, high: float, most: int = 7) -> None:
    """Make an axis logarithmic from `low` to `high`, with about `most` ticks at most: 1, 2, 5 or powers of ten."""
    axis.axes.set(**{f"{axis.axis_name}scale": "log", f"{axis.axis_name}lim": (low, high)})
    steps = (1.0, 2.0, 5.0) if high < 100.0 * low else (1.0,)
    locator = LogLocator(subs=steps, numticks=most)
    axis.set(major_locator=locator, minor_locator=NullLocator(), major_formatter=tick_text)


def tick_text(value: float, _: object) -> str:
    """Return the label of a tick at `value`; matplotlib calls this function as a formatter."""
    return number(value)


def legend(figure: Figure, axes: Axes | None, title: str) -> None:
    """Draw a title in the figure's upper left corner, and the legend of `axes` in the upper right corner.

    Args:
        figure: the figure.
        axes: axes with the labelled curves; None: no legend.
        title: the title.
    """
    width, height = figure.get_size_inches()
    figure.text(0.1 / width, 1.0 - 0.06 / height, title, va="top", fontsize=9.0, fontweight="bold")
    if axes is not None:
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(
            handles,
            labels,
            ncols=len(labels),
            fontsize=7.0,
            handlelength=1.4,
            markerscale=4.0,
            loc="upper right",
            bbox_to_anchor=(1.0 - 0.05 / width, 1.0 - 0.04 / height),
        )


def png(figure: Figure, dpi: float = DPI) -> bytes:
    """Return a figure as the content of a PNG file.

    Args:
        figure: the figure.
        dpi: resolution [dots per inch].
    """
    with styled():
        figure.set_dpi(dpi)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    image = Image.fromarray(np.ascontiguousarray(pixels))
    image = image.quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    palette = np.array(image.getpalette(), dtype=np.uint8)
    # the paper is white; the search for a palette misses it by a digit
    palette[palette > 251] = 255
    image.putpalette(palette.tolist())
    buffer = io.BytesIO()
    image.save(buffer, "png", dpi=(dpi, dpi))
    return buffer.getvalue()


def svg(figure: Figure) -> bytes:
    """Return a figure as the content of an SVG file, with letters as outlines, so that it does not depend on fonts."""
    # with a fixed salt the same figure is the same file
    with styled(), matplotlib.rc_context({"svg.hashsalt": "calib"}):
        buffer = io.BytesIO()
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def save(figure: Figure, path: str | Path, dpi: float = DPI) -> Path:
    """Write a figure as PNG; the file is written completely or not at all.

    Args:
        figure: the figure.
        path: the PNG file.
        dpi: resolution [dots per inch].
    """
    return files.write(path, png(figure, dpi))

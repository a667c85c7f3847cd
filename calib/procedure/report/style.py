"""How every figure looks and is drawn: one palette that survives a greyscale print, quiet axes, one drawing of each.

A figure is drawn once, as PNG: the same bytes stand in a folder as a file and on a page as an image. Margins are given
in inches, since measuring every label to find them takes longer than to draw it; text is never read as mathematics, so
that a ``$`` in a name is a ``$``.

Scales are drawn at once: grid, ticks and labels in three strokes, from what an axis says of itself (locator, formatter,
`Axis.get_tick_params`). matplotlib makes five artists for every tick and lays all labels out twice to find where the
axis' own label goes, which was two thirds of a figure's time; a figure that a person takes on has its ticks as ever.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis, YAxis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, get_font
from matplotlib.path import Path as Strokes
from matplotlib.text import Text
from matplotlib.ticker import FixedFormatter, FixedLocator, MaxNLocator, NullLocator
from matplotlib.transforms import IdentityTransform
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from calib import files
from calib.procedure.report.page import Picture

BEFORE, AFTER, MARK, QUIET, INK = "#e2a26b", "#17486e", "#b3261e", "#8a8f98", "#22262b"
BROWN = "#a8622a"  # BEFORE, dark enough for letters
HEAT = "cividis_r"
WIDE, HALF = 7.4, 3.6  # a page's line and half of it [in]
DPI = 200  # of print
COLOURS = 256  # of a PNG with a palette, a third as large as one without
POINTS = 700  # stretches of a curve, of which each keeps its smallest and its largest value
STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9.0,
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
def styled() -> Iterator[None]:
    """Draw in our style, leaving matplotlib's settings as they were."""
    with matplotlib.rc_context(STYLE):
        yield


def sheet(
    rows: int = 1, columns: int = 1, width: float = HALF, height: float = 2.5, *, left: float = 0.62,
    right: float = 0.12, bottom: float = 0.45, top: float = 0.28, across: float = 0.5, between: float = 0.42,
) -> tuple[Figure, list[Axes]]:  # fmt: skip
    """Return a figure without a window, and its axes row by row.

    Args:
        rows, columns: of axes.
        width, height: of the figure [in].
        left, right, bottom, top: what is kept free at the edges for labels and titles [in].
        across, between: what is kept free between columns, and between rows [in].
    """
    figure = Figure(figsize=(width, height))
    wide = (width - left - right - (columns - 1) * across) / columns
    high = (height - top - bottom - (rows - 1) * between) / rows
    axes = []
    for i, j in np.ndindex(rows, columns):
        place = left + j * (wide + across), bottom + (rows - 1 - i) * (high + between)
        axes.append(figure.add_axes((place[0] / width, place[1] / height, wide / width, high / height)))
    return figure, axes


def room(labels: Iterable[str], size: float) -> float:
    """Return the margin that the widest of these tick labels needs, printed in points of `size` [in]."""
    font = get_font(findfont("DejaVu Sans"))
    font.set_size(size, DPI)
    widest = 0.0
    for line in (line for label in labels for line in label.split("\n")):
        font.set_text(line)
        widest = max(widest, font.get_width_height()[0] / 64.0)
    return widest / DPI + 0.15  # and a tick with its distance


def colour_scale(figure: Figure, axes: Axes, drawn: Any, title: str = "", **options: Any) -> None:
    """Draw the scale of colours of what is drawn on these axes at their right, where 0.7 in are free."""
    width, place = figure.get_figwidth(), axes.get_position()
    scale = figure.add_axes((place.x1 + 0.1 / width, place.y0, 0.1 / width, place.height))
    figure.colorbar(drawn, cax=scale, **options)
    scale.tick_params(labelsize=7)
    scale.set_title(title, fontsize=7.5, fontweight="normal", pad=16.0 if options.get("extend") == "max" else None)


def log_axis(axis: XAxis | YAxis, low: float, high: float, most: int = 7) -> None:
    """Make an axis logarithmic from `low` to `high`, with at most about `most` ticks: 1, 2, 5 or powers of ten."""
    axes = axis.axes
    if isinstance(axis, XAxis):
        axes.set(xscale="log", xlim=(low, high))
    else:
        axes.set(yscale="log", ylim=(low, high))
    powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    ticks = (powers[:, None] * ([1.0, 2.0, 5.0] if high < 100.0 * low else [1.0])).ravel()
    ticks = ticks[(low <= ticks) & (ticks <= high)]
    if len(ticks) < 2:  # within less than a factor of about two: even steps
        ticks = np.asarray(MaxNLocator(min(most, 5)).tick_values(low, high))
        ticks = ticks[(low <= ticks) & (ticks <= high)]
    ticks = ticks[:: max(1, -(-len(ticks) // most))]
    label_ticks(axis, ticks, [number(tick) for tick in ticks])
    axis.set_minor_locator(NullLocator())


def label_ticks(axis: Axis, places: Any, labels: Sequence[str], size: float | None = None, rotation: float = 0) -> None:
    """Put ticks with these labels at these places, all within view, without making a tick.

    Args:
        places: (k,) data coordinates.
        labels: (k,).
        size: of the letters [pt].
        rotation: of the labels [deg].
    """
    places = np.asarray(places, dtype=float)
    axis.set_major_locator(FixedLocator(places))
    axis.set_major_formatter(FixedFormatter(labels))
    if len(places):
        axis.set_view_interval(places.min(), places.max())
    given: dict[str, Any] = {} if size is None else {"labelsize": size}
    axis.set_tick_params(rotation=rotation, **given)


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float) -> str:
    """Return a tick's number: plain from 0.001 to 10 000, else a power of ten."""
    if value == 0.0 or 0.99e-3 < abs(value) < 0.99e5:
        return f"{value:g}"
    digits, power = f"{value:.0e}".split("e")
    head = "" if digits == "1" else "-" if digits == "-1" else f"{digits}·"
    return f"{head}10{str(int(power)).translate(_RAISED)}"


def legend(figure: Figure, axes: Axes | None, title: str) -> None:
    """Write a figure's title in its upper left corner and the legend of `axes` in the right one, where no data are."""
    width, height = figure.get_size_inches()
    figure.text(0.1 / width, 1.0 - 0.06 / height, title, va="top", fontsize=9.0, fontweight="bold")
    if axes is not None:
        handles, labels = axes.get_legend_handles_labels()
        place = {"loc": "upper right", "bbox_to_anchor": (1.0 - 0.05 / width, 1.0 - 0.04 / height)}
        figure.legend(handles, labels, ncols=len(labels), fontsize=7.0, handlelength=1.4, markerscale=4.0, **place)


def thinned(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return of a long curve the smallest and the largest value of each of `POINTS` stretches, so that no peak is lost.

    Args:
        t: (N,) [s].
        values: (N,).
    """
    size = len(t) // POINTS
    if size < 3:
        return t, values
    count = len(t) // size
    blocks = values[: count * size].reshape(count, size)
    both = np.sort(np.stack([blocks.argmin(axis=1), blocks.argmax(axis=1)]), axis=0) + size * np.arange(count)
    kept = np.append(both.T.ravel(), len(t) - 1)
    return t[kept], values[kept]


@contextmanager
def _at_once(figure: Figure) -> Iterator[None]:
    """Have the plain axes of a figure drawn at once; those with ticks elsewhere or in between stay as they are."""
    plain = [
        axis for axes in figure.axes if axes.axison for axis in (axes.xaxis, axes.yaxis) if axis.get_visible()
        if not {"top", "right"} & {side for side, shown in axis.get_tick_params().items() if shown}
        if not len(axis.get_minorticklocs())
    ]  # fmt: skip
    scales = [axis.axes.add_artist(_Scale(axis)) for axis in plain]
    for axis in plain:
        axis.set_visible(False)
    try:
        yield
    finally:
        for axis, scale in zip(plain, scales):
            scale.remove()
            axis.set_visible(True)


class _Scale(Artist):
    """What draws an axis below its axes or at their left."""

    def __init__(self, axis: Axis) -> None:
        super().__init__()
        self._axis = axis
        self.set_zorder(axis.get_zorder())

    def draw(self, renderer: Any) -> None:
        axis, axes = self._axis, self._axis.axes
        across = isinstance(axis, XAxis)
        given: Any = axis.get_tick_params()
        style: Any = matplotlib.rcParams
        low, high = np.sort(axis.get_view_interval())
        places = np.asarray(axis.get_majorticklocs())
        labels = axis.get_major_formatter().format_ticks(list(places))
        if axis.get_major_formatter().get_offset():
            axis.set_visible(True)
            axis.draw(renderer)
            axis.set_visible(False)
            return
        slack = 1e-10 * (high - low)
        seen = (places >= low - slack) & (places <= high + slack)
        labels = [label for label, here in zip(labels, seen) if here]
        still = np.full(int(seen.sum()), (axes.get_ylim() if across else axes.get_xlim())[0])
        points = np.column_stack([places[seen], still] if across else [still, places[seen]])
        place = axes.transData.transform(points)[:, 0 if across else 1]
        box, pixel = axes.bbox, renderer.points_to_pixels(1.0)
        start, end = (box.y0, box.y1) if across else (box.x0, box.x1)
        key = "xtick" if across else "ytick"
        long = style[f"{key}.major.size"]
        if given.get("gridOn"):
            _strokes(renderer, place, start, end, across, style["grid.color"], style["grid.linewidth"])
        if given.get("bottom" if across else "left", True):
            width = style[f"{key}.major.width"]
            _strokes(renderer, place, start - long * pixel, start, across, style[f"{key}.color"], width)
        if given.get("labelbottom" if across else "labelleft", True):
            pad = long + given.get("pad", style[f"{key}.major.pad"])
            start = self._write(renderer, labels, place, start - pad * pixel, across, given)
        if axis.label.get_text():
            away = start - axis.labelpad * pixel
            axis.label.set_position((0.5, away) if across else (away, 0.5))
            axis.label.draw(renderer)

    def _write(
        self, renderer: Any, labels: Sequence[str], place: np.ndarray, level: float, across: bool, given: Any
    ) -> float:
        """Draw the labels at a level [px]; return where they end, beyond which the axis' own label stands."""
        axes: Axes = self._axis.axes
        style: Any = matplotlib.rcParams
        key = "xtick" if across else "ytick"
        _, vertical, horizontal = (axes.get_xaxis_text1_transform if across else axes.get_yaxis_text1_transform)(0.0)
        text = Text(
            va=vertical, ha=horizontal, rotation=given.get("rotation", 0), color=style[f"{key}.labelcolor"],
            fontsize=given.get("labelsize", style[f"{key}.labelsize"]), transform=IdentityTransform(),
        )  # fmt: skip
        text.set_figure(axes.figure)
        furthest, axes_label = level, self._axis.label.get_text()
        for label, where in zip(labels, place):
            if label:
                text.set_text(label)
                text.set_position((where, level) if across else (level, where))
                text.draw(renderer)
                if axes_label:  # stands beyond the widest of them
                    box = text.get_window_extent(renderer)
                    furthest = min(furthest, box.y0 if across else box.x0)
        return furthest


def _strokes(
    renderer: Any, place: np.ndarray, start: float, end: float, across: bool, colour: str, width: float
) -> None:
    """Draw parallel lines from start to end, one at every place, in display coordinates [px]; width in points."""
    if not len(place):
        return
    ends = np.empty((2 * len(place), 2))
    ends[:, 0 if across else 1] = np.repeat(place, 2)
    ends[:, 1 if across else 0] = np.tile([start, end], len(place))
    codes = np.tile(np.array([Strokes.MOVETO, Strokes.LINETO], dtype=Strokes.code_type), len(place))
    context = renderer.new_gc()
    context.set_foreground(colour)
    context.set_linewidth(width)
    context.set_capstyle("butt")
    context.set_snap(True)
    renderer.draw_path(context, Strokes(ends, codes), IdentityTransform())
    context.restore()


def png(figure: Figure, dpi: float = DPI) -> bytes:
    """Draw a figure and return it as PNG."""
    with styled():
        figure.set_dpi(dpi)
        canvas = FigureCanvasAgg(figure)
        with _at_once(figure):
            canvas.draw()
    colours = Image.fromarray(np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3]))
    image = colours.quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    palette = np.array(image.getpalette(), dtype=np.uint8)
    palette[palette > 251] = 255  # the paper is white; the search for a palette misses it by a digit
    image.putpalette(palette.tolist())
    buffer = io.BytesIO()
    told = PngInfo()
    told.add_text("Software", files.MAKER)
    image.save(buffer, "png", dpi=(dpi, dpi), pnginfo=told)
    return buffer.getvalue()


def save(figure: Figure, path: str | Path, dpi: float = DPI) -> Path:
    """Write a figure as PNG, whole or not at all."""
    return files.write(path, png(figure, dpi))


def save_all(figures: Mapping[str, Figure], folder: Path) -> None:
    """Write figures into a folder, as ``plot_<name>.png``."""
    for name, figure in figures.items():
        save(figure, folder / f"plot_{name}.png")


def picture(make: Callable[[], Figure], caption: str, wide: bool = False) -> Picture:
    """Draw a figure for a page, and for a file of its own.

    Args:
        make: the function that makes it and its arguments (`functools.partial`); what was drawn of the same ones before
            is taken again: a session's certificate shows much that its steps drew.
    """
    return Picture(_drawn(pickle.dumps(make)), caption, wide)


@lru_cache(maxsize=32)
def _drawn(make: bytes) -> bytes:
    return png(pickle.loads(make)())

"""Charts as SVG without matplotlib: for certificates, and for ``--plots svg``.

Letters stay text in DejaVu Sans, which the PDF contains, so that a figure takes milliseconds and a few kilobytes. Sizes
are points, a 72th of an inch.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import singledispatch
from html import escape
from itertools import pairwise
from math import isfinite
from operator import attrgetter, itemgetter

import numpy as np
from numpy.typing import ArrayLike

from calib.procedure.report.figures.charts import (
    Bars,
    Box,
    Chart,
    Dots,
    Heat,
    Histogram,
    Label,
    Layer,
    Level,
    Line,
    Panel,
)
from calib.procedure.report.figures.style import INK, MARK, QUIET, number, thinned

# share of a letter's size that letters take on average, in DejaVu Sans
LETTER = 0.6
# sizes of letters [pt]: ticks, labels, titles of panels, title of the figure
TICK, WORDS, TITLE, HEAD_TITLE = 7.0, 7.5, 8.5, 9.0
# heights and widths [pt] of what stands around a panel
HEAD, TITLE_SPACE, LABEL_SPACE, TICK_SPACE, GAP, SCALE_SPACE = 18.0, 13.0, 10.0, 11.0, 8.0, 44.0
# length of a tick [pt]
TICK_LENGTH = 2.5
# dashes of matplotlib's line styles [pt]
DASHES = {"--": "3.7 1.6", ":": "1 1.6"}
GRID = "#e3e5e8"
# share of the range that stays free around the content
FREE = 0.05
# colours of a scale are drawn in this many steps
STEPS = 32
# colour maps of matplotlib, at equal steps: cividis reversed (Nuñez, Anderton and Renslow, 2018), and PuOr (Brewer)
COLOUR_MAPS = {
    "cividis_r": ("#fee838", "#dac55c", "#b5a36e", "#938578", "#757575", "#576572", "#3b4f6d", "#123570", "#00224e"),
    "PuOr": ("#7f3b08", "#b35806", "#e08214", "#fdb863", "#f7f7f7", "#b2abd2", "#8073ac", "#542788", "#2d004b"),
}


def svg(chart: Chart) -> bytes:
    """Return a chart as the content of an SVG file."""
    width, height = 72.0 * chart.width, 72.0 * chart.height
    head = HEAD if chart.title else 0.0
    rows = -(-len(chart.panels) // chart.columns)
    margins = [_Margins(panel, chart, k) for k, panel in enumerate(chart.panels)]
    cell_width, cell_height = width / chart.columns, (height - head) / rows
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}pt" '
        f'height="{height:g}pt" font-family="DejaVu Sans, sans-serif" font-size="{TICK:g}" fill="{INK}">'
    ]
    if chart.title:
        parts.append(_text(chart.title, 4.0, 11.0, HEAD_TITLE, bold=True))
        parts += _legend(chart.panels[0].layers, width)
    for k, margin in enumerate(margins):
        row, column = divmod(k, chart.columns)
        # panels of a column begin, and those of a row end, along a common line
        begin = max(map(attrgetter("left"), margins[column :: chart.columns]))
        row_margins = margins[row * chart.columns : (row + 1) * chart.columns]
        top, bottom = max(map(attrgetter("top"), row_margins)), max(map(attrgetter("bottom"), row_margins))
        x, y = column * cell_width, head + row * cell_height
        frame = _Frame(
            x + begin, y + top, x + cell_width - margin.right, y + cell_height - bottom, margin.panel, f"c{k}"
        )
        parts += frame.drawn(margin, bool(chart.title))
    parts.append("</svg>\n")
    return "".join(parts).encode()


class _Margins:
    """What stands around a panel, and the space that it takes [pt].

    Attributes:
        panel: the panel.
        x, y: scales of the axes.
        xlabel, ylabel: labels of the axes; empty where another panel of the grid has them.
        xticks, yticks: ticks as (value, text).
        xtexts, ytexts: texts of the ticks; empty where another panel of the grid has them.
        upright: whether the texts along x are vertical.
        left, right, top, bottom: the space around the panel.
    """

    def __init__(self, panel: Panel, chart: Chart, k: int):
        lowest, first = k + chart.columns >= len(chart.panels), k % chart.columns == 0
        self.panel = panel
        self.x, self.y = _scales(panel)
        label_x, label_y = "x" not in chart.shared or lowest, "y" not in chart.shared or first
        self.xlabel, self.ylabel = panel.x * label_x, panel.y * label_y
        max_ticks = panel.ticks or (5 if chart.columns > 1 else 7)
        self.xticks, self.yticks = self.x.ticks(panel.xnames, max_ticks), self.y.ticks(panel.ynames, min(max_ticks, 6))
        self.xtexts = list(map(itemgetter(1), self.xticks)) * label_x
        self.ytexts = list(map(itemgetter(1), self.yticks)) * label_y
        names = "".join(panel.xnames or ())
        self.upright = bool(names) and "\n" not in names
        self.left = GAP + _widest(self.ytexts) + (LABEL_SPACE + 2.0) * bool(self.ylabel)
        self.right, self.top = GAP, 4.0 + TITLE_SPACE * bool(panel.title)
        if any(map(_has_scale, panel.layers)):
            self.right, self.top = SCALE_SPACE, 4.0 + TITLE_SPACE
        space = _widest(self.xtexts) + 4.0
        if not self.upright:
            lines = "\n".join(self.xtexts[:1]).count("\n") + bool(self.xtexts)
            space = lines * TICK_SPACE
        self.bottom = 3.0 + space + LABEL_SPACE * bool(self.xlabel)


def _has_scale(layer: Layer) -> bool:
    return isinstance(layer, Heat) or (isinstance(layer, Dots) and bool(layer.unit))


def _widest(texts: Iterable[str], size: float = TICK) -> float:
    """Return the width of the widest text [pt], as estimated from its number of letters."""
    lines = "\n".join(texts).split("\n")
    return LETTER * size * max(map(len, lines))


@dataclass(frozen=True)
class _Scale:
    """Scale of an axis.

    Attributes:
        low, high: limits.
        log: whether it is logarithmic.
        linear: the scale is linear between ± this value, and logarithmic beyond; 0: linear everywhere.
    """

    low: float
    high: float
    log: bool = False
    linear: float = 0.0

    def shares(self, values: object) -> np.ndarray:
        """Return the positions of values along the axis: 0 at the lower limit, 1 at the upper limit."""
        low, high = self._even(np.array([self.low, self.high]))
        return (self._even(np.asarray(values, dtype=float)) - low) / (high - low)

    def _even(self, values: np.ndarray) -> np.ndarray:
        if self.log:
            return np.log10(np.maximum(values, 1e-300))
        if self.linear:
            sizes = np.abs(values) / self.linear
            return np.sign(values) * np.where(sizes > 1.0, 1.0 + np.log10(np.maximum(sizes, 1.0)), sizes)
        return values

    def ticks(self, names: Sequence[str] | None, max_ticks: int) -> list[tuple[float, str]]:
        """Return the ticks as (value, text).

        Args:
            names: texts at 0, 1, …; None: numbers.
            max_ticks: about the largest number of ticks.
        """
        if names is not None:
            return list(zip(map(float, range(len(names))), names))
        if self.log:
            values = list(_log_ticks(self.low, self.high, max_ticks))
        elif self.linear:
            values = list(_symlog_ticks(self.linear, self.low, self.high))
        else:
            values = list(_even_ticks(self.low, self.high, max_ticks))
        return [(value, number(value)) for value in values]


def _even_ticks(low: float, high: float, max_ticks: int) -> Iterator[float]:
    """Yield about `max_ticks` multiples of 1, 2 or 5 times a power of ten between two limits."""
    step = _step((high - low) / max(max_ticks, 1))
    first = int(np.ceil(low / step - 1e-9))
    last = int(np.floor(high / step + 1e-9))
    for k in range(first, last + 1):
        yield float(f"{k * step:.10g}")


def _step(least: float) -> float:
    """Return the smallest 1, 2 or 5 times a power of ten that is not below a number."""
    power = 10.0 ** np.floor(np.log10(max(least, 1e-300)))
    for factor in (1.0, 2.0, 5.0):
        if factor * power >= least * (1.0 - 1e-9):
            return float(factor * power)
    return float(10.0 * power)


def _log_ticks(low: float, high: float, max_ticks: int) -> Iterator[float]:
    """Yield 1, 2 and 5 times powers of ten between two limits; over two decades and more, powers of ten."""
    factors = (1.0, 2.0, 5.0) if high < 100.0 * low else (1.0,)
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    stride = max(1, -(-len(powers) // max_ticks))
    for power in powers[::stride]:
        for factor in factors:
            value = factor * 10.0**power
            if low <= value <= high:
                yield value


def _symlog_ticks(linear: float, low: float, high: float) -> Iterator[float]:
    """Yield 0 and ± powers of ten times `linear` between two limits."""
    if low <= 0.0 <= high:
        yield 0.0
    value = linear
    while value <= max(-low, high):
        if -value >= low:
            yield -value
        if value <= high:
            yield value
        value *= 10.0


def _scales(panel: Panel) -> tuple[_Scale, _Scale]:
    """Return the scales of a panel's axes, from its limits or its content."""
    x, y = [], []
    for layer in panel.layers:
        layer_x, layer_y = _content(layer)
        x.append(np.ravel(layer_x))
        y.append(np.ravel(layer_y))
    return _scale(panel, "x", x), _scale(panel, "y", y)


def _scale(panel: Panel, letter: str, content: Sequence[np.ndarray]) -> _Scale:
    """Return the scale of an axis.

    Args:
        panel: the panel.
        letter: ``x`` or ``y``.
        content: values that the layers show along the axis.
    """
    names = panel.xnames if letter == "x" else panel.ynames
    limits = panel.xlim if letter == "x" else panel.ylim
    if names is not None:
        limits = -0.6, len(names) - 0.4
        # names along y begin at the top
        return _Scale(*(limits if letter == "x" else limits[::-1]))
    linear = panel.symlog if letter == "y" else 0.0
    if limits is None:
        values = np.concatenate([np.zeros(0), *content])
        values = values[np.isfinite(values)]
        low, high = float(values.min(initial=np.inf)), float(values.max(initial=-np.inf))
        if high < low:
            low, high = 0.0, 1.0
        image = bool(panel.layers) and isinstance(panel.layers[0], Heat)
        margin = 0.0
        if not image:
            margin = FREE * (high - low) or 0.5 * abs(high) or 0.5
        limits = low - margin, high + margin
        if image and letter == "y":
            # rows of an image begin at the top
            limits = limits[::-1]
    return _Scale(float(limits[0]), float(limits[1]), letter in panel.log, linear)


@singledispatch
def _content(layer: Layer) -> tuple[ArrayLike, ArrayLike]:
    """Return the values that a layer shows along x and along y."""
    raise TypeError(f"no layer of a chart: {layer!r}")


@_content.register
def _(line: Line) -> tuple[ArrayLike, ArrayLike]:
    y = np.asarray(line.y, dtype=float)
    if line.spread is None:
        return line.x, y
    spread = np.nan_to_num(np.asarray(line.spread, dtype=float))
    return line.x, np.concatenate([y - spread, y + spread])


@_content.register
def _(bars: Bars) -> tuple[ArrayLike, ArrayLike]:
    values = np.asarray(bars.values, dtype=float)
    spread = np.zeros(len(values)) + (0.0 if bars.spread is None else np.asarray(bars.spread))
    ends = np.concatenate([values - spread, values + spread, [bars.base]])
    positions = [-0.5, len(values) - 0.5]
    return (positions, ends) if bars.upright else (ends, positions)


@_content.register
def _(level: Level) -> tuple[ArrayLike, ArrayLike]:
    return ([level.at], ()) if level.upright else ((), [level.at])


@_content.register
def _(label: Label) -> tuple[ArrayLike, ArrayLike]:
    return (), ()


@_content.register
def _(dots: Dots) -> tuple[ArrayLike, ArrayLike]:
    return dots.x, dots.y


@_content.register
def _(heat: Heat) -> tuple[ArrayLike, ArrayLike]:
    rows, columns = np.shape(heat.values)
    left, right, bottom, top = heat.extent or (-0.5, columns - 0.5, rows - 0.5, -0.5)
    return [left, right], [bottom, top]


@_content.register
def _(histogram: Histogram) -> tuple[ArrayLike, ArrayLike]:
    return histogram.edges, np.append(histogram.counts, 0.0)


@_content.register
def _(box: Box) -> tuple[ArrayLike, ArrayLike]:
    return box.values, [box.position - 0.5, box.position + 0.5]


class _Frame:
    """The rectangle of a panel, onto which its layers are drawn.

    Attributes:
        left, top, right, bottom: the rectangle [pt].
        panel: the panel.
        clip: name of its clipping path.
        xscale, yscale: scales of the axes.
    """

    def __init__(self, left: float, top: float, right: float, bottom: float, panel: Panel, clip: str):
        self.left, self.top, self.right, self.bottom = left, top, max(right, left + 1.0), max(bottom, top + 1.0)
        self.panel, self.clip = panel, clip
        self.xscale, self.yscale = _scales(panel)
        if panel.equal or any(isinstance(layer, Heat) and layer.extent for layer in panel.layers):
            self._equal()

    def _equal(self) -> None:
        """Widen one axis so that both have the same scale."""
        width, height = self.right - self.left, self.bottom - self.top
        x_range, y_range = self.xscale.high - self.xscale.low, self.yscale.high - self.yscale.low
        unit = max(x_range / width, abs(y_range) / height)
        self.xscale = _widened(self.xscale, unit * width)
        self.yscale = _widened(self.yscale, np.copysign(unit * height, y_range))

    def x(self, values: object) -> np.ndarray:
        """Return the positions of values along x [pt]."""
        return self.left + self.xscale.shares(values) * (self.right - self.left)

    def y(self, values: object) -> np.ndarray:
        """Return the positions of values along y [pt]."""
        return self.bottom - self.yscale.shares(values) * (self.bottom - self.top)

    def drawn(self, margin: _Margins, quiet_title: bool) -> Iterator[str]:
        """Yield the SVG of the panel.

        Args:
            margin: what stands around the panel.
            quiet_title: whether its title is small.
        """
        panel = self.panel
        xticks, yticks = margin.xticks, margin.yticks
        if panel.equal:
            # the limits are wider than the content
            xticks = self.xscale.ticks(panel.xnames, len(xticks) or 1)
            yticks = self.yscale.ticks(panel.ynames, len(yticks) or 1)
        yield from self._grid(xticks, yticks)
        width, height = self.right - self.left, self.bottom - self.top
        rectangle = f'<rect x="{self.left:.1f}" y="{self.top:.1f}" width="{width:.1f}" height="{height:.1f}"/>'
        yield f'<clipPath id="{self.clip}">{rectangle}</clipPath>'
        for layer in panel.layers:
            if not isinstance(layer, Label | Level):
                yield f'<g clip-path="url(#{self.clip})">{"".join(_draw(layer, self))}</g>'
                yield from _colour_scale(layer, self)
        for layer in panel.layers:
            if isinstance(layer, Label | Level):
                yield from _draw(layer, self)
        corner = f"M{self.left:.1f} {self.top:.1f}V{self.bottom:.1f}H{self.right:.1f}"
        yield _path(corner, QUIET, 0.7)
        yield from self._ticks(margin, xticks, yticks)
        if panel.title:
            size = TITLE - (TITLE - WORDS) * quiet_title
            yield _text(panel.title, self.left, self.top - 4.0, size, bold=not quiet_title)

    def _grid(self, xticks: Sequence[tuple[float, str]], yticks: Sequence[tuple[float, str]]) -> Iterator[str]:
        if self.panel.grid in ("x", "both"):
            for x in self.x(list(map(itemgetter(0), xticks))):
                yield _path(f"M{x:.1f} {self.top:.1f}V{self.bottom:.1f}", GRID, 0.6)
        if self.panel.grid in ("y", "both"):
            for y in self.y(list(map(itemgetter(0), yticks))):
                yield _path(f"M{self.left:.1f} {y:.1f}H{self.right:.1f}", GRID, 0.6)

    def _ticks(
        self, margin: _Margins, xticks: Sequence[tuple[float, str]], yticks: Sequence[tuple[float, str]]
    ) -> Iterator[str]:
        """Yield the ticks of both axes with their texts, and the labels of the axes."""
        for value, text in xticks:
            x = float(self.x(value))
            yield _path(f"M{x:.1f} {self.bottom:.1f}v{TICK_LENGTH}", QUIET, 0.7)
            if not margin.xtexts:
                continue
            if margin.upright:
                turned = f' transform="rotate(-90 {x:.1f} {self.bottom + 4.0:.1f})"'
                yield _text(text, x + 2.4, self.bottom + 4.0, 6.0, "end", extra=turned)
                continue
            for k, line in enumerate(text.split("\n")):
                yield _text(line, x, self.bottom + 10.0 + k * 9.0, TICK, "middle")
        for value, text in yticks:
            y = float(self.y(value))
            yield _path(f"M{self.left:.1f} {y:.1f}h-{TICK_LENGTH}", QUIET, 0.7)
            if margin.ytexts:
                yield _text(text.replace("\n", " "), self.left - 4.5, y + 2.5, TICK, "end")
        middle_x, middle_y = (self.left + self.right) / 2.0, (self.top + self.bottom) / 2.0
        if margin.xlabel:
            yield _text(margin.xlabel, middle_x, self.bottom + margin.bottom - 4.5, WORDS, "middle")
        if margin.ylabel:
            x = self.left - margin.left + LABEL_SPACE
            lines = margin.ylabel.split("\n")
            for k, line in enumerate(lines):
                at = x - 8.0 * (len(lines) - 1 - k)
                turned = f' transform="rotate(-90 {at:.1f} {middle_y:.1f})"'
                yield _text(line, at, middle_y, WORDS, "middle", extra=turned)


def _widened(scale: _Scale, extent: float) -> _Scale:
    middle = (scale.low + scale.high) / 2.0
    return _Scale(middle - extent / 2.0, middle + extent / 2.0)


def _text(
    text: str,
    x: float,
    y: float,
    size: float,
    anchor: str = "start",
    colour: str = INK,
    bold: bool = False,
    extra: str = "",
) -> str:
    """Return a text as SVG.

    Args:
        text: the text.
        x, y: its position [pt].
        size: size of its letters [pt].
        anchor: ``start``, ``middle`` or ``end``: what of the text stands at x.
        colour: its colour.
        bold: whether it is bold.
        extra: further attributes.
    """
    weight = ' font-weight="bold"' if bold else ""
    position = f'x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" text-anchor="{anchor}" fill="{colour}"'
    return f"<text {position}{weight}{extra}>{escape(text, quote=False)}</text>"


def _path(d: str, colour: str, width: float, extra: str = "") -> str:
    return f'<path d="{d}" fill="none" stroke="{colour}" stroke-width="{width:g}"{extra}/>'


def _points(x: np.ndarray, y: np.ndarray, colour: str, size: float) -> str:
    """Return round points as one SVG path.

    Args:
        x, y: (k,) positions [pt].
        colour: their colour.
        size: their diameter [pt].
    """
    if not len(x):
        return ""
    d = "".join(map("M{:.1f} {:.1f}h.01".format, x.tolist(), y.tolist()))
    return _path(d, colour, size, ' stroke-linecap="round"')


def _curve(x: np.ndarray, y: np.ndarray) -> str:
    """Return the SVG path of a curve, which is interrupted where a value is not finite."""
    steps = []
    begin = "M"
    for px, py in zip(x.tolist(), y.tolist()):
        if not (isfinite(px) and isfinite(py)):
            begin = "M"
            continue
        steps.append(f"{begin}{px:.1f} {py:.1f}")
        begin = "L"
    return "".join(steps)


def _legend(layers: Sequence[Layer], width: float) -> Iterator[str]:
    """Yield the legend of labelled layers in the figure's upper right corner.

    Args:
        layers: the layers.
        width: width of the figure [pt].
    """
    x = width
    for layer in reversed(layers):
        if not isinstance(layer, Line | Bars) or not layer.label:
            continue
        x -= LETTER * TICK * len(layer.label) + 22.0
        colour = str(layer.colours) if isinstance(layer, Bars) else layer.colour
        if isinstance(layer, Line) and layer.form == "-":
            yield _path(f"M{x:.1f} 8.5h9", colour, max(layer.width, 1.0))
        else:
            yield f'<circle cx="{x + 5.0:.1f}" cy="8.5" r="2.5" fill="{colour}"/>'
        yield _text(layer.label, x + 12.0, 11.0, TICK)


@singledispatch
def _draw(layer: Layer, frame: _Frame) -> Iterator[str]:
    """Yield the SVG of a layer."""
    raise TypeError(f"no layer of a chart: {layer!r}")


@_draw.register
def _line(line: Line, frame: _Frame) -> Iterator[str]:
    x, y = np.atleast_1d(np.asarray(line.x, dtype=float)), np.atleast_1d(np.asarray(line.y, dtype=float))
    if line.spread is not None:
        spread = np.asarray(line.spread, dtype=float)
        finite = np.isfinite(y) & np.isfinite(spread)
        low, high = frame.y(y - spread)[finite].tolist(), frame.y(y + spread)[finite].tolist()
        strokes = map("M{:.1f} {:.1f}V{:.1f}".format, frame.x(x)[finite].tolist(), low, high)
        yield _path("".join(strokes), line.colour, line.width)
    if line.form == "-":
        x, y = thinned(x, y)
    px, py = frame.x(x), frame.y(y)
    style = line.form.strip("o.s+")
    if style:
        dashes = f' stroke-dasharray="{DASHES[style]}"' if style in DASHES else ""
        yield _path(_curve(px, py), line.colour, line.width, dashes + ' stroke-linejoin="round"')
    marker = line.form.strip("-:")
    finite = np.isfinite(px) & np.isfinite(py)
    px, py = px[finite], py[finite]
    if marker == "+":
        half = line.size / 2.0
        crosses = (
            f"M{a - half:.1f} {b:.1f}h{line.size:g}M{a:.1f} {b - half:.1f}v{line.size:g}" for a, b in zip(px, py)
        )
        yield _path("".join(crosses), line.colour, 0.8)
    elif marker == "s":
        half = line.size / 2.0
        squares = (
            f"M{a - half:.1f} {b - half:.1f}h{line.size:g}v{line.size:g}h-{line.size:g}z" for a, b in zip(px, py)
        )
        yield f'<path d="{"".join(squares)}" fill="{line.colour}"/>'
    elif marker:
        # matplotlib's point is half as large as its circle
        size = line.size / (1 + (marker == "."))
        yield _points(px, py, line.colour, size)
        if line.hollow:
            yield _points(px, py, "#ffffff", size - 1.6)


@_draw.register
def _bars(bars: Bars, frame: _Frame) -> Iterator[str]:
    values = np.asarray(bars.values, dtype=float)
    positions = np.arange(len(values)) + bars.shift
    colours = np.resize(bars.colours, len(values)).tolist()
    along, across = frame.x, frame.y
    if bars.upright:
        along, across = across, along
    ends, begin = along(values), float(along(bars.base))
    sides = across(positions - bars.thick / 2.0), across(positions + bars.thick / 2.0)
    for end, side, far_side, colour in zip(ends.tolist(), sides[0].tolist(), sides[1].tolist(), colours):
        if not isfinite(end):
            continue
        corners = (side, far_side, begin, end) if bars.upright else (begin, end, side, far_side)
        yield _rectangle(*corners, colour)
    if bars.spread is None:
        return
    spread = np.asarray(bars.spread, dtype=float)
    low, high, middle = along(values - spread), along(values + spread), across(positions)
    for a, b, c in zip(low.tolist(), high.tolist(), middle.tolist()):
        stroke = f"M{a:.1f} {c:.1f}H{b:.1f}"
        if bars.upright:
            stroke = f"M{c:.1f} {a:.1f}V{b:.1f}"
        yield _path(stroke, MARK, 0.9)


def _rectangle(x: float, end_x: float, y: float, end_y: float, colour: str) -> str:
    size = f'width="{abs(end_x - x):.2f}" height="{abs(end_y - y):.2f}"'
    return f'<rect x="{min(x, end_x):.2f}" y="{min(y, end_y):.2f}" {size} fill="{colour}"/>'


@_draw.register
def _level(level: Level, frame: _Frame) -> Iterator[str]:
    dashes = f' stroke-dasharray="{DASHES[level.form]}"' if level.form in DASHES else ""
    halo = ' stroke="#ffffff" stroke-width="2" paint-order="stroke" stroke-linejoin="round"'
    if not level.upright:
        y = float(frame.y(level.at))
        if frame.top <= y <= frame.bottom:
            yield _path(f"M{frame.left:.1f} {y:.1f}H{frame.right:.1f}", level.colour, 0.8, dashes)
            if level.text:
                yield _text(level.text, frame.left + 3.0, y - 2.0, WORDS, colour=level.colour, extra=halo)
        return
    x = float(frame.x(level.at))
    if not frame.left <= x <= frame.right:
        return
    yield _path(f"M{x:.1f} {frame.top:.1f}V{frame.bottom:.1f}", level.colour, 0.8, dashes)
    right = x < frame.left + 0.6 * (frame.right - frame.left)
    anchor, shift = "end", -3.0
    if right:
        anchor, shift = "start", 3.0
    y = frame.bottom - level.height * (frame.bottom - frame.top) + 6.0
    if level.text:
        yield _text(level.text, x + shift, y, WORDS, anchor, level.colour, extra=halo)


@_draw.register
def _label(label: Label, frame: _Frame) -> Iterator[str]:
    anchor = {"left": "start", "center": "middle", "right": "end"}[label.across]
    x = float(frame.x(label.x)) + label.offset[0]
    y = float(frame.y(label.y)) - label.offset[1]
    if label.along == "center":
        y += 0.36 * label.size
    yield _text(label.text, x, y, label.size, anchor, label.colour)


@_draw.register
def _dots(dots: Dots, frame: _Frame) -> Iterator[str]:
    values = np.asarray(dots.values, dtype=float)
    x, y = frame.x(dots.x), frame.y(dots.y)
    shares = np.clip((values - dots.low) / max(dots.high - dots.low, 1e-300), 0.0, 1.0)
    steps = np.round(shares * (STEPS - 1)).astype(int)
    # an outline, and the largest on top
    yield _points(x, y, QUIET, 4.4)
    colour = _colours("cividis_r")
    for step in np.unique(steps):
        chosen = steps == step
        yield _points(x[chosen], y[chosen], colour(step / (STEPS - 1)), 4.0)


def _colours(name: str) -> Callable[[float], str]:
    """Return the function from a share to the colour of a colour map."""
    stops = np.array([[int(code[k : k + 2], 16) for k in (1, 3, 5)] for code in COLOUR_MAPS[name]])
    positions = np.linspace(0.0, 1.0, len(stops))

    def colour(share: float) -> str:
        red, green, blue = (round(float(np.interp(share, positions, stops[:, k]))) for k in range(3))
        return f"#{red:02x}{green:02x}{blue:02x}"

    return colour


@_draw.register
def _heat(heat: Heat, frame: _Frame) -> Iterator[str]:
    values = np.asarray(heat.values, dtype=float)
    rows, columns = values.shape
    left, right, bottom, top = heat.extent or (-0.5, columns - 0.5, rows - 0.5, -0.5)
    x, y = frame.x(np.linspace(left, right, columns + 1)), frame.y(np.linspace(top, bottom, rows + 1))
    low, high = _heat_limits(heat)
    colour = _colours(heat.colours)
    for (i, j), value in np.ndenumerate(values):
        if not np.isfinite(value):
            continue
        share = (value - low) / max(high - low, 1e-300)
        yield _rectangle(x[j], x[j + 1], y[i], y[i + 1], colour(float(np.clip(share, 0.0, 1.0))))
        if heat.written:
            ink = "#ffffff"
            if abs(value) <= 0.6:
                ink = INK
            yield _text(f"{value:.2f}", (x[j] + x[j + 1]) / 2.0, (y[i] + y[i + 1]) / 2.0 + 2.0, 5.5, "middle", ink)


def _heat_limits(heat: Heat) -> tuple[float, float]:
    low, high = heat.limits
    largest = np.nanmax(heat.values, initial=low)
    return low, float(largest if high is None else high)


@_draw.register
def _histogram(histogram: Histogram, frame: _Frame) -> Iterator[str]:
    x, y = frame.x(histogram.edges), frame.y(histogram.counts)
    zero = float(frame.y(0.0))
    steps = [f"M{x[0]:.1f} {zero:.1f}"]
    for (_, right), top in zip(pairwise(x.tolist()), y.tolist()):
        steps.append(f"V{top:.1f}H{right:.1f}")
    yield f'<path d="{"".join(steps)}V{zero:.1f}z" fill="{histogram.colour}" fill-opacity="0.9"/>'


@_draw.register
def _box(box: Box, frame: _Frame) -> Iterator[str]:
    values = np.asarray(box.values, dtype=float)
    low, first, median, third, high = np.percentile(values, (5, 25, 50, 75, 95))
    middle = float(frame.y(box.position))
    top, bottom = float(frame.y(box.position - 0.28)), float(frame.y(box.position + 0.28))
    at_low, at_first, at_median, at_third, at_high = frame.x([low, first, median, third, high]).tolist()
    yield _path(f"M{at_low:.1f} {middle:.1f}H{at_first:.1f}M{at_third:.1f} {middle:.1f}H{at_high:.1f}", QUIET, 1.0)
    yield _rectangle(at_first, at_third, top, bottom, box.colour)
    yield _path(f"M{at_median:.1f} {top:.1f}V{bottom:.1f}", "#ffffff", 1.4)
    outliers = values[(values < low) | (values > high)]
    yield _points(frame.x(outliers), np.full(len(outliers), middle), QUIET, 1.0)


def _colour_scale(layer: Layer, frame: _Frame) -> Iterator[str]:
    """Yield the colour bar to the right of a panel; nothing for layers without one."""
    if isinstance(layer, Heat):
        scale, name, unit = _Scale(*_heat_limits(layer)), layer.colours, layer.unit
    elif isinstance(layer, Dots) and layer.unit:
        scale, name, unit = _Scale(layer.low, layer.high), "cividis_r", layer.unit
    else:
        return
    if scale.high <= scale.low:
        scale = _Scale(scale.low, scale.low + 1.0)
    x, height = frame.right + 6.0, frame.bottom - frame.top
    colour = _colours(name)
    for k in range(STEPS):
        y = frame.bottom - height * k / STEPS
        yield _rectangle(x, x + 6.0, y, y - height / STEPS - 0.2, colour(k / (STEPS - 1)))
    for value, text in scale.ticks(None, 5):
        y = frame.bottom - float(scale.shares(value)) * height
        yield _text(text, x + 8.0, y + 2.5, TICK)
    if unit:
        yield _text(unit, x + 3.0, frame.top - 4.0, TICK, "middle")

"""Figures as values: a `Chart` is a grid of `Panel`s, and a panel contains layers over two axes; `figure` draws a
chart.

Layers are lines, bars, marked levels, texts, coloured dots, heat maps, histograms and box plots.
"""

import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial, wraps
from pathlib import Path
from typing import Any, Concatenate, Literal, ParamSpec

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, YAxis
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator, NullLocator
from numpy.typing import ArrayLike

from calib import files
from calib.procedure.report import style
from calib.procedure.report.page import Picture
from calib.procedure.report.style import AFTER, INK, MARK, PAGE_WIDTH, QUIET, log_axis

# of a coloured dot [pt²]
DOT_SIZE = 16.0
# around labels, so that a line behind them does not hide them
HALO = [withStroke(linewidth=2.0, foreground="white")]
# tick labels along an axis from which on they are set small
MANY_LABELS = 60


P = ParamSpec("P")
Layer = Callable[..., None]  # draws onto the axes of a panel, whose scales are set


def layer(draw: Callable[Concatenate[Axes, P], None]) -> Callable[P, Layer]:
    """Return a function that makes a layer of a panel; it takes the arguments of a drawing function, except the axes.

    The layers can be pickled, as the cache of drawn pictures requires.
    """

    @wraps(draw)
    def make(*arguments: Any, on: Axes | None = None, **options: Any) -> Any:
        if on is None:
            return partial(make, *arguments, **options)
        return draw(on, *arguments, **options)

    return make  # ty: ignore[invalid-explicit-return]


@layer
def line(
    axes: Axes,
    x: ArrayLike,
    y: ArrayLike,
    form: str = "-",
    colour: str = AFTER,
    width: float = 0.9,
    size: float = 3.5,
    hollow: bool = False,
    label: str = "",
    spread: ArrayLike | None = None,
) -> None:
    """Draw a curve or points (k,); curves with many points are thinned.

    Args:
        axes: axes to draw on.
        x, y: (k,) coordinates.
        form: matplotlib format, such as ``-``, ``o`` or ``o-``.
        colour: colour of line and points.
        width: width of the line [pt].
        size: size of the points [pt].
        hollow: whether points are drawn as outlines only.
        label: text in the legend; empty: none.
        spread: (k,) half lengths of error bars; None: no error bars.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if form == "-":
        x, y = style.thinned(x, y)
    axes.errorbar(
        x,
        y,
        spread,
        fmt=form,
        color=colour,
        linewidth=width,
        markersize=size,
        label=label,
        markerfacecolor="white" if hollow else colour,
        markeredgewidth=0.8 if hollow or form == "+" else 0.0,
    )


@layer
def bars(
    axes: Axes,
    values: ArrayLike,
    colours: str | Sequence[str] = AFTER,
    upright: bool = False,
    shift: float = 0.0,
    thick: float = 0.7,
    base: float = 0.0,
    spread: ArrayLike | None = None,
    label: str = "",
) -> None:
    """Draw k bars from `base` to their values, at the positions 0, 1, … of the other axis.

    Args:
        axes: axes to draw on.
        values: (k,) ends of the bars.
        colours: one colour for all bars, or one per bar.
        upright: whether the bars are vertical.
        shift: offset of the positions.
        thick: thickness of the bars.
        base: value at which the bars begin.
        spread: (k,) half lengths of error bars; None: no error bars.
        label: text in the legend.
    """
    values = np.asarray(values, dtype=float)
    position = np.arange(len(values)) + shift
    options: dict[str, Any] = {"color": colours, "label": label}
    if spread is not None:
        direction = "yerr" if upright else "xerr"
        options |= {direction: spread, "ecolor": MARK, "capsize": 1.8, "error_kw": {"elinewidth": 0.9}}
    if upright:
        axes.bar(position, values - base, thick, base, **options)
    else:
        axes.barh(position, values - base, thick, base, **options)


@layer
def level(
    axes: Axes,
    at: float,
    colour: str = MARK,
    form: str = "--",
    upright: bool = False,
    words: str = "",
    height: float = 0.98,
) -> None:
    """Draw a horizontal or vertical line across the panel, with a label.

    Args:
        axes: axes to draw on.
        at: position of the line.
        colour: colour of line and label.
        form: matplotlib line style, such as ``--``.
        upright: whether the line is vertical.
        words: the label.
        height: height of a vertical line's label, as a share of the panel's height.
    """
    if upright:
        axes.axvline(at, color=colour, linewidth=0.8, linestyle=form)
        # the label of a line at the right edge stands on its left
        x, _ = axes.transAxes.inverted().transform(axes.transData.transform((at, at)))
        right = bool(x < 0.6)
        axes.annotate(
            words,
            (at, height),
            xycoords=("data", "axes fraction"),
            xytext=(3 if right else -3, 0),
            textcoords="offset points",
            color=colour,
            va="top",
            ha="left" if right else "right",
            path_effects=HALO,
        )
    else:
        axes.axhline(at, color=colour, linewidth=0.8, linestyle=form)
        axes.annotate(
            words,
            (0.0, at),
            xycoords=("axes fraction", "data"),
            xytext=(3, 1),
            textcoords="offset points",
            color=colour,
            va="bottom",
            ha="left",
            path_effects=HALO,
        )


@layer
def text(
    axes: Axes,
    words: str,
    x: float,
    y: float,
    offset: tuple[float, float] = (4, 4),
    colour: str = INK,
    size: float = 7.0,
    across: str = "left",
    along: str = "baseline",
) -> None:
    """Draw a text at a point, shifted by an offset.

    Args:
        axes: axes to draw on.
        words: the text.
        x, y: the point.
        offset: shift to the right and upwards [pt].
        colour: colour of the text.
        size: font size [pt].
        across, along: matplotlib's horizontal and vertical alignment of the text.
    """
    axes.annotate(words, (x, y), offset, textcoords="offset points", color=colour, fontsize=size, ha=across, va=along)


@layer
def dots(axes: Axes, x: ArrayLike, y: ArrayLike, values: ArrayLike, least: float, most: float, unit: str = "") -> None:
    """Draw points (k,) coloured by their values.

    Args:
        axes: axes to draw on.
        x, y: (k,) coordinates.
        values: (k,) values.
        least, most: values of the first and the last colour.
        unit: title of the colour bar; empty: no colour bar.
    """
    # the largest on top
    order = np.argsort(values)
    x, y, values = np.asarray(x)[order], np.asarray(y)[order], np.asarray(values)[order]
    points = axes.scatter(
        x, y, DOT_SIZE, values, cmap="cividis_r", vmin=least, vmax=most, edgecolors=QUIET, linewidths=0.25
    )
    if unit:
        _scale(axes, points, unit, extend="max" if values[-1] > most else "neither")


@layer
def heat(
    axes: Axes,
    values: ArrayLike,
    unit: str = "",
    extent: tuple[float, float, float, float] | None = None,
    limits: tuple[float, float | None] = (0.0, None),
    colours: str = "cividis_r",
    written: bool = False,
) -> None:
    """Draw a colour map of values (rows, columns) with a colour bar; row 0 is at the top, and NaN is white.

    Args:
        axes: axes to draw on.
        unit: title of the colour bar.
        extent: coordinates of the map's left, right, bottom and top edge; None: cell k is at coordinate k.
        limits: values of the first and the last colour; None: the largest value.
        colours: name of the colour map.
        written: whether each value is printed in its cell.
    """
    low, high = limits
    aspect: Literal["equal", "auto"] = "equal" if extent else "auto"
    image = axes.imshow(values, colours, vmin=low, vmax=high, extent=extent, interpolation="nearest", aspect=aspect)
    if written:
        for (i, j), value in np.ndenumerate(values):
            colour = INK if abs(value) <= 0.6 else "white"
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=5.5, color=colour)
    _scale(axes, image, unit)


@layer
def histogram(axes: Axes, counts: ArrayLike, edges: ArrayLike, colour: str = AFTER) -> None:
    """Draw a histogram of k counts (k,) between bin edges (k + 1,).

    Args:
        axes: axes to draw on.
        counts: number in each bin.
        edges: bin edges, rising.
        colour: colour of the bars.
    """
    axes.stairs(counts, edges, fill=True, color=colour, alpha=0.9)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))


@layer
def box(axes: Axes, values: ArrayLike, place: float, colour: str = AFTER) -> None:
    """Draw a horizontal box plot of values (k,) at a y position.

    It shows quartiles and median, 5th and 95th percentile, and all points beyond these percentiles.

    Args:
        axes: axes to draw on.
        values: the values.
        place: the y position.
        colour: colour of the box.
    """
    axes.boxplot(
        [values],
        positions=[place],
        orientation="horizontal",
        whis=(5, 95),
        widths=0.56,
        patch_artist=True,
        manage_ticks=False,
        boxprops={"facecolor": colour, "linewidth": 0},
        whiskerprops={"color": QUIET},
        medianprops={"color": "white", "linewidth": 1.4},
        capprops={"linewidth": 0},
        flierprops={"marker": ".", "markersize": 2.0, "markeredgecolor": QUIET},
    )


def _scale(axes: Axes, mappable: ScalarMappable, unit: str, **options: Any) -> None:
    """Draw the colour bar of a coloured layer.

    Args:
        axes: axes of the layer.
        mappable: the layer, as matplotlib's drawing function returned it.
        unit: title of the colour bar; empty: no colour bar.
        **options: options of matplotlib's ``colorbar``.
    """
    figure = axes.figure
    scale = figure.colorbar(mappable, ax=axes, pad=0.02, aspect=30, **options)
    scale.ax.set_title(unit, fontsize=7.0, fontweight="normal")


@dataclass(frozen=True, eq=False)
class Panel:
    """A panel of a chart: layers over two axes.

    Attributes:
        layers: layers in drawing order.
        title, x, y: title, and labels of the axes.
        xlim, ylim: limits of the axes; None: chosen by the content.
        log: letters of the logarithmic axes, whose limits are required.
        xnames, ynames: labels at 0, 1, … instead of numbers; x labels of one line are vertical; None: numbers.
        grid: axes with grid lines: ``x``, ``y``, ``both`` or empty.
        equal: whether both axes have the same scale.
        symlog: the y axis is linear between ± this value and logarithmic beyond; 0: linear everywhere.
        ticks: approximate largest number of ticks per axis; 0: default.
    """

    layers: Sequence[Layer]
    title: str = ""
    x: str = ""
    y: str = ""
    xlim: tuple[float, float] | None = None
    ylim: tuple[float, float] | None = None
    log: str = ""
    xnames: Sequence[str] | None = None
    ynames: Sequence[str] | None = None
    grid: str = ""
    equal: bool = False
    symlog: float = 0.0
    ticks: int = 0

    def draw(self, axes: Axes) -> None:
        """Draw the panel's layers, labels and limits on matplotlib axes."""
        axes.set(title=self.title, xlabel=self.x, ylabel=self.y)
        self._set_axis(axes, axes.xaxis, self.xnames, self.xlim)
        self._set_axis(axes, axes.yaxis, self.ynames, self.ylim)
        if self.ynames is not None:
            axes.invert_yaxis()
        if self.symlog:
            axes.set_yscale("symlog", linthresh=self.symlog)
            axes.yaxis.set(major_formatter=style.tick_text, minor_locator=NullLocator())
        if self.equal:
            axes.set_aspect("equal", adjustable="datalim")
        for draw_layer in self.layers:
            draw_layer(on=axes)
        if self.grid:
            axes.grid(axis=self.grid)  # ty: ignore[invalid-argument-type]

    def _set_axis(
        self, axes: Axes, axis: XAxis | YAxis, names: Sequence[str] | None, limits: tuple[float, float] | None
    ) -> None:
        """Set limits, scale and labels of an axis.

        Args:
            axes: the panel's axes.
            axis: the axis to set.
            names: labels at 0, 1, … instead of numbers; None: numbers.
            limits: limits of the axis; None: chosen by the content.
        """
        letter = axis.axis_name
        if limits:
            axes.set(**{f"{letter}lim": limits})
        if names is not None:
            # names of one line stand upright along x
            upright = letter == "x" and not any("\n" in name for name in names)
            size = 5.0 if len(names) > MANY_LABELS else 6.5
            axis.set_ticks(range(len(names)), names, fontsize=size, rotation=90 * upright)
            axes.set(**{f"{letter}lim": (-0.6, len(names) - 0.4)})
        elif letter in self.log and limits:
            log_axis(axis, *limits)
        elif self.ticks:
            axes.locator_params(letter, nbins=self.ticks)  # ty: ignore[invalid-argument-type]


@dataclass(frozen=True, eq=False)
class Chart:
    """A figure as a value: panels, row by row.

    Attributes:
        panels: at least one panel.
        height, width: size of the figure [in].
        columns: number of panels in a row.
        title: title of the figure, beside the legend of the first panel; empty: neither title nor legend.
        shared: letters of the axes whose labels are drawn only at the edge of the grid: ``x`` at the lowest panel of
            each column, ``y`` at the first panel of each row.
    """

    panels: Sequence[Panel]
    height: float
    columns: int = 1
    width: float = PAGE_WIDTH
    title: str = ""
    shared: str = ""


Captioned = tuple[Chart, str]  # with what it shows, in a sentence


def figure(chart: Chart) -> Figure:
    """Return a chart drawn as a matplotlib figure, without opening a window."""
    with style.styled(quiet_titles=bool(chart.title)):
        rows = -(-len(chart.panels) // chart.columns)
        head = 0.25 if chart.title else 0.0
        sheet, axes = style.sheet(rows, chart.columns, chart.width, chart.height, head)
        for k, (panel, panel_axes) in enumerate(zip(chart.panels, axes)):
            panel.draw(panel_axes)
            lowest, first = k + chart.columns >= len(chart.panels), k % chart.columns == 0
            if "x" in chart.shared and not lowest:
                panel_axes.set_xlabel("")
                panel_axes.tick_params(labelbottom=False)
            if "y" in chart.shared and not first:
                panel_axes.set_ylabel("")
                panel_axes.tick_params(labelleft=False)
        for empty in axes[len(chart.panels) :]:
            empty.set_axis_off()
        if chart.title:
            style.legend(sheet, axes[0], chart.title)
    return sheet


def picture(chart: Chart, caption: str) -> Picture:
    """Return a chart with a caption as a picture for a page; a chart that was drawn earlier is taken from a cache."""
    return Picture(_drawn(pickle.dumps(chart)), caption, chart.width > style.HALF_WIDTH, chart)


def pictures(charts: Mapping[str, Captioned]) -> dict[str, Picture]:
    """Return charts with captions as pictures for a page, by name."""
    return {name: picture(chart, caption) for name, (chart, caption) in charts.items()}


def vector(chart: Chart, caption: str) -> Picture:
    """Return a chart with a caption as a vector picture (SVG) for print."""
    return Picture(style.svg(figure(chart)), caption, chart.width > style.HALF_WIDTH)


@lru_cache(maxsize=32)
def _drawn(chart: bytes) -> bytes:
    return style.png(figure(pickle.loads(chart)))


def saved(charts: Mapping[str, Captioned], folder: Path) -> dict[str, Picture]:
    """Write charts into a folder as ``plot_<name>.png``, and return them as pictures by name."""
    save_all({name: chart for name, (chart, _) in charts.items()}, folder)
    return pictures(charts)


def save_all(charts: Mapping[str, Chart], folder: Path) -> None:
    """Write charts into a folder as ``plot_<name>.png``."""
    for name, chart in charts.items():
        files.write(folder / f"plot_{name}.png", picture(chart, "").image)

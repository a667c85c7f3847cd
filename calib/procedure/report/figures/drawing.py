"""Charts drawn by matplotlib, for ``plot()`` and for PNG files."""

from collections.abc import Sequence
from functools import singledispatch
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import XAxis, YAxis
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator, NullLocator

from calib.procedure.report.figures import sheets
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
from calib.procedure.report.figures.sheets import log_axis
from calib.procedure.report.figures.style import INK, MARK, QUIET, thinned

# of a coloured dot [pt²]
DOT_SIZE = 16.0
# around labels, so that a line behind them does not hide them
HALO = [withStroke(linewidth=2.0, foreground="white")]
# tick labels along an axis from which on they are set small
MANY_LABELS = 60


def figure(chart: Chart) -> Figure:
    """Return a chart drawn as a matplotlib figure, without opening a window."""
    with sheets.styled(quiet_titles=bool(chart.title)):
        rows = -(-len(chart.panels) // chart.columns)
        head = 0.25 if chart.title else 0.0
        sheet, axes = sheets.sheet(rows, chart.columns, chart.width, chart.height, head)
        for k, (panel, panel_axes) in enumerate(zip(chart.panels, axes)):
            _draw_panel(panel, panel_axes)
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
            sheets.legend(sheet, axes[0], chart.title)
    return sheet


def png(chart: Chart) -> bytes:
    """Return a chart as the content of a PNG file."""
    return sheets.png(figure(chart))


def _draw_panel(panel: Panel, axes: Axes) -> None:
    """Draw a panel's layers, labels and limits on matplotlib axes."""
    axes.set(title=panel.title, xlabel=panel.x, ylabel=panel.y)
    _set_axis(panel, axes, axes.xaxis, panel.xnames, panel.xlim)
    _set_axis(panel, axes, axes.yaxis, panel.ynames, panel.ylim)
    if panel.ynames is not None:
        axes.invert_yaxis()
    if panel.symlog:
        axes.set_yscale("symlog", linthresh=panel.symlog)
        axes.yaxis.set(major_formatter=sheets.tick_text, minor_locator=NullLocator())
    if panel.equal:
        axes.set_aspect("equal", adjustable="datalim")
    for layer in panel.layers:
        _draw(layer, axes)
    if panel.grid:
        axes.grid(axis=panel.grid)  # ty: ignore[invalid-argument-type]


def _set_axis(
    panel: Panel, axes: Axes, axis: XAxis | YAxis, names: Sequence[str] | None, limits: tuple[float, float] | None
) -> None:
    """Set limits, scale and labels of an axis.

    Args:
        panel: the panel.
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
    elif letter in panel.log and limits:
        log_axis(axis, *limits)
    elif panel.ticks:
        axes.locator_params(letter, nbins=panel.ticks)  # ty: ignore[invalid-argument-type]


@singledispatch
def _draw(layer: Layer, axes: Axes) -> None:
    """Draw a layer onto the axes of a panel, whose scales are set."""
    raise TypeError(f"no layer of a chart: {layer!r}")


@_draw.register
def _line(line: Line, axes: Axes) -> None:
    x, y = np.asarray(line.x, dtype=float), np.asarray(line.y, dtype=float)
    if line.form == "-":
        x, y = thinned(x, y)
    axes.errorbar(
        x,
        y,
        line.spread,
        fmt=line.form,
        color=line.colour,
        linewidth=line.width,
        markersize=line.size,
        label=line.label,
        markerfacecolor="white" if line.hollow else line.colour,
        markeredgewidth=0.8 if line.hollow or line.form == "+" else 0.0,
    )


@_draw.register
def _bars(bars: Bars, axes: Axes) -> None:
    values = np.asarray(bars.values, dtype=float)
    position = np.arange(len(values)) + bars.shift
    options: dict[str, Any] = {"color": bars.colours, "label": bars.label}
    if bars.spread is not None:
        direction = "yerr" if bars.upright else "xerr"
        options |= {direction: bars.spread, "ecolor": MARK, "capsize": 1.8, "error_kw": {"elinewidth": 0.9}}
    draw = axes.bar if bars.upright else axes.barh
    draw(position, values - bars.base, bars.thick, bars.base, **options)


@_draw.register
def _level(level: Level, axes: Axes) -> None:
    if not level.upright:
        axes.axhline(level.at, color=level.colour, linewidth=0.8, linestyle=level.form)
        axes.annotate(
            level.text,
            (0.0, level.at),
            xycoords=("axes fraction", "data"),
            xytext=(3, 1),
            textcoords="offset points",
            color=level.colour,
            va="bottom",
            ha="left",
            path_effects=HALO,
        )
        return
    axes.axvline(level.at, color=level.colour, linewidth=0.8, linestyle=level.form)
    # the label of a line at the right edge stands on its left
    x, _ = axes.transAxes.inverted().transform(axes.transData.transform((level.at, level.at)))
    right = bool(x < 0.6)
    axes.annotate(
        level.text,
        (level.at, level.height),
        xycoords=("data", "axes fraction"),
        xytext=(3 if right else -3, 0),
        textcoords="offset points",
        color=level.colour,
        va="top",
        ha="left" if right else "right",
        path_effects=HALO,
    )


@_draw.register
def _label(label: Label, axes: Axes) -> None:
    axes.annotate(
        label.text,
        (label.x, label.y),
        label.offset,
        textcoords="offset points",
        color=label.colour,
        fontsize=label.size,
        ha=label.across,
        va=label.along,
    )


@_draw.register
def _dots(dots: Dots, axes: Axes) -> None:
    # the largest on top
    order = np.argsort(dots.values)
    x, y, values = np.asarray(dots.x)[order], np.asarray(dots.y)[order], np.asarray(dots.values)[order]
    points = axes.scatter(
        x, y, DOT_SIZE, values, cmap="cividis_r", vmin=dots.low, vmax=dots.high, edgecolors=QUIET, linewidths=0.25
    )
    if dots.unit:
        _scale(axes, points, dots.unit, extend="max" if values[-1] > dots.high else "neither")


@_draw.register
def _heat(heat: Heat, axes: Axes) -> None:
    low, high = heat.limits
    aspect: Literal["equal", "auto"] = "equal" if heat.extent else "auto"
    values = np.asarray(heat.values)
    image = axes.imshow(
        values, heat.colours, vmin=low, vmax=high, extent=heat.extent, interpolation="nearest", aspect=aspect
    )
    if heat.written:
        for (i, j), value in np.ndenumerate(values):
            colour = INK if abs(value) <= 0.6 else "white"
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=5.5, color=colour)
    _scale(axes, image, heat.unit)


@_draw.register
def _histogram(histogram: Histogram, axes: Axes) -> None:
    axes.stairs(histogram.counts, histogram.edges, fill=True, color=histogram.colour, alpha=0.9)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))


@_draw.register
def _box(box: Box, axes: Axes) -> None:
    axes.boxplot(
        [box.values],
        positions=[box.position],
        orientation="horizontal",
        whis=(5, 95),
        widths=0.56,
        patch_artist=True,
        manage_ticks=False,
        boxprops={"facecolor": box.colour, "linewidth": 0},
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

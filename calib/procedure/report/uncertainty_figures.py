"""Figures of what is known how well: what more measurements would tell, the estimate on two geometries, what matters.

The latter two are drawn from an identification's folder (``geometries.csv``, ``geometry_effects.csv``), so that a
certificate made later shows the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from calib import files
from calib.procedure.dynamic_stage.geometry_tables import EFFECTS, GEOMETRIES, LEAST
from calib.procedure.dynamic_stage.metrics import GeometricEffect, TwoGeometries
from calib.procedure.report.page import Picture
from calib.procedure.report.style import (
    AFTER,
    BEFORE,
    HALF,
    MARK,
    QUIET,
    WIDE,
    label_ticks,
    legend,
    log_axis,
    number,
    picture,
    room,
    sheet,
    styled,
)
from calib.records import read_rows
from calib.units import small

Curve = Sequence[tuple[float, float]]
TOP = 15  # elements in the ranked figure
T = TypeVar("T")


def outlook_figure(others: Curve, own: tuple[float, float], along: str, across: str) -> Figure:
    """Draw a predicted sigma over the effort of measuring, both logarithmic; the plan in hand is marked.

    Args:
        others: pairs of effort and sigma; own: the same of the plan.
        along, across: what they are, with units.
    """
    points = np.array(sorted(others)).reshape(-1, 2)
    every = np.vstack([points, [own]])
    with styled():
        figure, (axis,) = sheet(width=HALF, height=2.5)
        axis.plot(*points.T, "o-", color=BEFORE, linewidth=1.0, markersize=3.5)
        axis.plot(*own, "o", color=MARK, markersize=5.5)
        axis.annotate("this plan", own, (5, 5), textcoords="offset points", fontsize=7)
        log_axis(axis.xaxis, 0.8 * every[:, 0].min(), 1.25 * every[:, 0].max())
        log_axis(axis.yaxis, 0.7 * every[:, 1].min(), 1.4 * every[:, 1].max())
        axis.set(xlabel=along, ylabel=across, title="predicted, before anything is moved")
        axis.grid(True)
    return figure


def from_folder(folder: Path) -> dict[str, Picture]:
    """Return the figures that an identification's folder gives, by name; none of a robot without a fit."""
    result: dict[str, Picture] = {}
    rows = [
        row for row in _read(TwoGeometries, folder / GEOMETRIES) if row.essential == "yes" and row.calibrated != 0.0
    ]
    if rows:
        words = (
            "Essential parameters identified from the same torques on the nominal (CAD) and on the calibrated geometry "
            "(as Fig. 7 of Kolyubin et al. 2019). Above: relative to the calibrated one, bars two sigmas (nominal: of "
            "torque noise; calibrated: with the geometry's uncertainty). Below: how far the nominal one's estimate "
            "is off, in the calibrated one's sigmas."
        )
        result["geometries"] = picture(partial(_geometries, rows), words, True)
    known = [row for row in _read(GeometricEffect, folder / EFFECTS) if row.sigma is not None]
    if known:
        words = (
            "Which geometric errors matter for the dynamics: what one standard deviation of each does to the parameter "
            "it moves most, in that parameter's sigma from torque noise. Below the dashed line no sigma grows by more "
            "than 1 %."
        )
        result["effects"] = picture(partial(_effects, known[:TOP]), words)
    return result


def write(folder: Path) -> None:
    """Write ``plot_geometries.png`` and ``plot_geometry_effects.png`` beside the tables they show."""
    drawn = from_folder(folder)
    for name, file in (("geometries", "plot_geometries.png"), ("effects", "plot_geometry_effects.png")):
        if name in drawn:
            files.write(folder / file, drawn[name].png)


def _geometries(rows: Sequence[TwoGeometries]) -> Figure:
    """Draw each parameter on both geometries with error bars, and the difference in sigmas."""
    table = np.array([(row.nominal, row.sigma_nominal, row.calibrated, row.sigma_calibrated) for row in rows])
    nominal, s_nominal, own, s_own = table.T
    x = np.arange(len(rows))
    percent = 100.0 / np.abs(own)
    size = np.divide(nominal - own, s_own, out=np.zeros(len(rows)), where=s_own > 0.0)
    thick = min(8.0, 0.7 * 72.0 * (WIDE - 0.75) / (len(rows) + 1))
    margin = room([row.name for row in rows], 6.5)
    with styled():
        figure, (above, below) = sheet(2, 1, WIDE, 3.7 + margin, bottom=margin, top=0.45, between=0.15)
        for values, sigma, colour, shift, label in (
            (nominal, s_nominal, BEFORE, -0.15, "nominal (CAD) geometry"), (own, s_own, AFTER, 0.15, "calibrated"),
        ):  # fmt: skip
            above.errorbar(
                x + shift, percent * (values - own), 2.0 * percent * sigma, fmt="o", color=colour, markersize=2.5,
                elinewidth=1.0, label=label,
            )  # fmt: skip
        _symlog(above, 1.0)
        above.axhline(0.0, color=QUIET, linewidth=0.6)
        above.set_ylabel("from calibrated [%]")
        below.vlines(x, 0.0, size, colors=np.where(np.abs(size) > 2.0, MARK, QUIET).tolist(), linewidth=thick)
        _symlog(below, 2.0)
        below.set_ylabel("difference [σ]")
        for axis in (above, below):
            axis.set_xlim(-0.7, len(rows) - 0.3)
            axis.grid(axis="y")
        label_ticks(above.xaxis, x, [""] * len(x))
        label_ticks(below.xaxis, x, [row.name for row in rows], 6.5, rotation=90)
        moved = int((np.abs(size) > 2.0).sum())
        legend(figure, above, f"{moved} of {len(rows)} parameters move by two sigmas with the geometry")
    return figure


def _symlog(axes: Axes, linear: float) -> None:
    """Make the y axis linear up to `linear` from zero, and logarithmic beyond."""
    axes.set_yscale("symlog", linthresh=linear)
    low, high = axes.get_ylim()
    low, high = axes.set_ylim(min(low, -linear), max(high, linear))  # so that there are ticks beside zero
    most = max(abs(low), abs(high), linear)
    powers = linear * 10.0 ** np.arange(0, max(1, int(np.log10(most / linear)) + 1))
    powers = powers[:: -(-len(powers) // 3)]
    ticks = [tick for tick in (*-powers[::-1], 0.0, *powers) if low <= tick <= high]
    label_ticks(axes.yaxis, ticks, [number(tick) for tick in ticks])
    axes.yaxis.set_minor_locator(NullLocator())


def _effects(rows: Sequence[GeometricEffect]) -> Figure:
    """Draw the ranked geometric errors by the largest shift they cause."""
    labels = [f"{row.element} ({_milli(row)})" for row in rows]
    size = np.array([row.shift_sigma or 0.0 for row in rows])
    places = np.arange(len(rows))[::-1]
    beside = room([row.parameter for row in rows], 6.5)
    with styled():
        figure, (axis,) = sheet(height=0.75 + 0.19 * len(rows), left=room(labels, 7.0), right=beside)
        axis.hlines(places, 0.0, size, colors=np.where(size > LEAST, AFTER, QUIET).tolist(), linewidth=8.0)
        axis.axvline(LEAST, color=MARK, linewidth=0.7, linestyle="--")
        for place, value, row in zip(places, size, rows):
            axis.text(value, place, f" {row.parameter}", va="center", fontsize=6.5)
        label_ticks(axis.yaxis, places, labels, 7)
        axis.set(xlabel="shift [σ of torque noise]", ylim=(-0.7, len(rows) - 0.3))
        axis.set_xlim(left=0.0)
        legend(figure, None, f"{int((size > LEAST).sum())} of these {len(rows)} geometric errors matter")
    return figure


def _milli(row: GeometricEffect) -> str:
    return small(row.sigma or 0.0, row.unit, digits=2)


def _read(kind: type[T], path: Path) -> tuple[T, ...]:
    return read_rows(kind, path) if path.is_file() else ()

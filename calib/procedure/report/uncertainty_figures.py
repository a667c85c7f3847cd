"""Figures of what is known how well: what more measurements would bring, the estimate on two geometries, what matters.

The latter two are drawn from an identification's folder (``geometries.csv``, ``geometry_effects.csv``), so that a
certificate made later shows the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from calib import files
from calib.procedure.dynamic_stage.geometry_tables import EFFECTS, GEOMETRIES, MIN_SHIFT, GeometricEffect, TwoGeometries
from calib.procedure.report.charts import Chart, Panel, bars, level, line, picture, text
from calib.procedure.report.page import Picture
from calib.procedure.report.style import AFTER, BEFORE, HALF_WIDTH, MARK, QUIET
from calib.records import read_rows
from calib.units import small

Curve = Sequence[tuple[float, float]]
MAX_ELEMENTS = 15  # elements in the ranked figure
T = TypeVar("T")


def outlook_figure(others: Curve, own: tuple[float, float], along: str, across: str) -> Chart:
    """Return a predicted σ over the effort of measuring, both logarithmic; the plan in hand is marked.

    Args:
        others: pairs of effort and sigma; own: the same of the plan.
        along, across: what they are, with units.
    """
    points = np.array(sorted(others)).reshape(-1, 2)
    low, high = np.vstack([points, [own]]).min(axis=0), np.vstack([points, [own]]).max(axis=0)
    layers = [
        line(points[:, 0], points[:, 1], "o-", BEFORE),
        line([own[0]], [own[1]], "o", MARK, size=5.5),
        text("this plan", *own),
    ]
    panel = Panel(
        layers, "predicted, before anything is moved", along, across, (0.8 * low[0], 1.25 * high[0]),
        (0.7 * low[1], 1.4 * high[1]), log="xy", grid="both",
    )  # fmt: skip
    return Chart([panel], 2.4, width=HALF_WIDTH)


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
        result["geometries"] = picture(_geometries(rows), words)
    known = [row for row in _read(GeometricEffect, folder / EFFECTS) if row.sigma is not None]
    if known:
        words = (
            "Which geometric errors matter for the dynamics: what one standard deviation of each does to the parameter "
            "it moves most, in that parameter's sigma from torque noise. Below the dashed line no sigma grows by more "
            "than 1 %."
        )
        result["effects"] = picture(_effects(known[:MAX_ELEMENTS]), words)
    return result


def write(folder: Path) -> None:
    """Write ``plot_geometries.png`` and ``plot_geometry_effects.png`` beside the tables they show."""
    drawn = from_folder(folder)
    for name, file in (("geometries", "plot_geometries.png"), ("effects", "plot_geometry_effects.png")):
        if name in drawn:
            files.write(folder / file, drawn[name].png)


def _geometries(rows: Sequence[TwoGeometries]) -> Chart:
    """Return each parameter on both geometries with error shown, and the difference in sigmas."""
    table = np.array([(row.nominal, row.sigma_nominal, row.calibrated, row.sigma_calibrated) for row in rows])
    nominal, s_nominal, own, s_own = table.T
    x, percent = np.arange(len(rows)), 100.0 / np.abs(own)
    size = np.divide(nominal - own, s_own, out=np.zeros(len(rows)), where=s_own > 0.0)
    above = [
        line(x + shift, percent * (values - own), "o", colour, 1.0, 2.5, label=label, spread=2.0 * percent * sigma)
        for values, sigma, colour, shift, label in (
            (nominal, s_nominal, BEFORE, -0.15, "nominal (CAD) geometry"), (own, s_own, AFTER, 0.15, "calibrated"),
        )
    ]  # fmt: skip
    moved = np.abs(size) > 2.0
    shown = bars(size, [MARK if one else QUIET for one in moved], upright=True)
    panels = [
        Panel(above, y="from calibrated [%]", xnames=[""] * len(rows), grid="y", symlog=1.0),
        Panel([shown], y="difference [σ]", xnames=[row.name for row in rows], grid="y", symlog=2.0),
    ]
    title = f"{int(moved.sum())} of {len(rows)} parameters move by two sigmas with the geometry"
    return Chart(panels, 4.2, title=title)


def _effects(rows: Sequence[GeometricEffect]) -> Chart:
    """Return the ranked geometric errors by the largest shift they cause."""
    size = np.array([row.shift_sigma or 0.0 for row in rows])
    layers = [
        bars(size, [AFTER if one > MIN_SHIFT else QUIET for one in size]), level(MIN_SHIFT, upright=True),
        *(text(row.parameter, one, k, (3, 0), along="center") for k, (row, one) in enumerate(zip(rows, size))),
    ]  # fmt: skip
    labels = [f"{row.element} ({_milli(row)})" for row in rows]
    title = f"{int((size > MIN_SHIFT).sum())} of these {len(rows)} geometric errors matter"
    limits = 0.0, 1.25 * float(size.max(initial=MIN_SHIFT))
    panel = Panel(layers, title, "shift [σ of torque noise]", xlim=limits, ynames=labels)
    return Chart([panel], 0.7 + 0.19 * len(rows), width=HALF_WIDTH)


def _milli(row: GeometricEffect) -> str:
    return small(row.sigma or 0.0, row.unit, digits=2)


def _read(kind: type[T], path: Path) -> tuple[T, ...]:
    return read_rows(kind, path) if path.is_file() else ()

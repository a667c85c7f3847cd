"""The figures of consistent geometry and dynamics: the estimate on two geometries, and the errors that matter.

Both are drawn from an identification's folder (``geometries.csv``, ``geometry_effects.csv``), so that a certificate
made later can embed them: ``drawing.svg(found.figure, name)`` of what `from_folder` returns.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from calib.procedure.dynamic_stage.geometry_tables import EFFECTS, GEOMETRIES, LEAST
from calib.procedure.report.figures import Drawn
from calib.procedure.report.style import AFTER, BEFORE, MARK, QUIET, WIDE, save, sheet, styled

TOP = 15  # elements in the ranked figure
Row = Mapping[str, str]


def from_folder(folder: Path) -> dict[str, Drawn]:
    """Return the figures that an identification's folder gives, by name; none of a robot without a fit."""
    result: dict[str, Drawn] = {}
    rows = [row for row in _read(folder / GEOMETRIES) if row["essential"] == "yes" and float(row["calibrated"]) != 0.0]
    if rows:
        words = (
            "Essential parameters identified from the same torques on the nominal (CAD) and on the calibrated geometry "
            "(as Fig. 7 of Kolyubin et al. 2019). Above: relative to the calibrated one, bars two sigmas (nominal: of "
            "torque noise; calibrated: with the geometry's uncertainty). Below: how far the nominal one's estimate "
            "is off, in the calibrated one's sigmas."
        )
        result["geometries"] = Drawn(geometries(rows), words, True)
    known = [row for row in _read(folder / EFFECTS) if row["sigma"]]
    if known:
        words = (
            "Which geometric errors matter for the dynamics: what one standard deviation of each does to the parameter "
            "it moves most, in that parameter's sigma from torque noise. Below the dashed line no sigma grows by more "
            "than 1 %."
        )
        result["effects"] = Drawn(effects(known[:TOP]), words)
    return result


def write(folder: Path) -> None:
    """Write ``plot_geometries.png`` and ``plot_geometry_effects.png`` beside the tables they show."""
    drawn = from_folder(folder)
    for name, file in (("geometries", "plot_geometries.png"), ("effects", "plot_geometry_effects.png")):
        if name in drawn:
            save(drawn[name].figure, folder / file)


def geometries(rows: Sequence[Row]) -> Figure:
    """Draw each parameter on both geometries with error bars, and the difference in sigmas."""
    columns = ("nominal", "sigma_nominal", "calibrated", "sigma_calibrated")
    nominal, s_nominal, own, s_own = (np.array([float(row[name]) for row in rows]) for name in columns)
    x = np.arange(len(rows))
    percent = 100.0 / np.abs(own)
    with styled():
        figure, (above, below) = sheet(2, 1, WIDE, 4.4)
        for values, sigma, colour, shift, label in (
            (nominal, s_nominal, BEFORE, -0.15, "nominal (CAD) geometry"), (own, s_own, AFTER, 0.15, "calibrated"),
        ):  # fmt: skip
            above.errorbar(
                x + shift, percent * (values - own), 2.0 * percent * sigma, fmt="o", color=colour, markersize=2.5,
                elinewidth=1.0, label=label,
            )  # fmt: skip
        above.set_yscale("symlog", linthresh=1.0)
        above.axhline(0.0, color=QUIET, linewidth=0.6)
        above.set(ylabel="from calibrated [%]", title="identified on two geometries")
        above.legend(ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize=7)
        size = np.divide(nominal - own, s_own, out=np.zeros(len(rows)), where=s_own > 0.0)
        below.bar(x, size, color=np.where(np.abs(size) > 2.0, MARK, QUIET).tolist(), width=0.7)
        below.set_yscale("symlog", linthresh=2.0)
        below.set(ylabel="difference [σ]")
        for axis in (above, below):
            axis.set_xlim(-0.7, len(rows) - 0.3)
            axis.grid(axis="y")
            axis.set_axisbelow(True)
        above.set_xticks(x, [])
        below.set_xticks(x, [row["name"] for row in rows], rotation=90, fontsize=6.5)
    return figure


def effects(rows: Sequence[Row]) -> Figure:
    """Draw the ranked geometric errors by the largest shift they cause."""
    labels = [f"{row['element']} ({_milli(row)})" for row in rows]
    size = np.array([float(row["shift_sigma"]) for row in rows])
    with styled():
        figure, (axis,) = sheet(1, 1, height=0.5 + 0.19 * len(rows))
        places = np.arange(len(rows))[::-1]
        axis.barh(places, size, color=np.where(size > LEAST, AFTER, QUIET).tolist(), height=0.7)
        axis.axvline(LEAST, color=MARK, linewidth=0.7, linestyle="--")
        for place, value, row in zip(places, size, rows):
            axis.text(value, place, f" {row['parameter']}", va="center", fontsize=6.5)
        axis.set_yticks(places, labels, fontsize=7)
        axis.set(xlabel="shift [σ of torque noise]", title="geometric errors that matter")
    return figure


def _milli(row: Row) -> str:
    return f"{1e3 * float(row['sigma']):.2g} {'mm' if row['unit'] == 'm' else 'mrad'}"


def _read(path: Path) -> list[Row]:
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))

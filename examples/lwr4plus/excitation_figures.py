"""Pictures of the excitation study, after Figs 5, 6 and 7 of Kolyubin, Shiriaev & Jubien (2019)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from simulated_arm import TABLE_4

from calib.procedure.report.figures.sheets import log_axis, sheet, styled
from calib.toolkit.chains import Chain, forward
from calib.toolkit.report_charts import AFTER, BEFORE, INK, MARK, PAGE_WIDTH, QUIET
from calib.toolkit.simulations import Reference

# metrics of one motion's run, as `excitation.py` writes them
Metrics = dict[str, Any]
# the paper's goals of trajectory B: condition number at most, mean torque of joint 6 at least [share of the limit]
PAPER_CONDITION, PAPER_SHARE = 35.0, 0.1
# least error drawn on a logarithmic axis [%]
MIN_ERROR = 0.002


def paths(chain: Chain, motions: dict[str, Reference]) -> Figure:
    """Draw the tool's path of every motion in space (Fig. 5)."""
    columns = min(len(motions), 3)
    rows = -(-len(motions) // 3)
    with styled():
        figure = Figure(figsize=(PAGE_WIDTH, 2.5 * rows))
        for number, (name, motion) in enumerate(motions.items(), 1):
            axis: Any = figure.add_subplot(rows, columns, number, projection="3d")
            positions = forward(chain, motion.q[::20])[:, :3, 3]
            axis.plot(*positions.T, color=AFTER, linewidth=0.7)
            axis.set_title(name, y=0.98, fontsize=9)
            axis.set(xlim=(-0.9, 0.9), ylim=(-0.9, 0.9), zlim=(-0.3, 0.9), box_aspect=(1.5, 1.5, 1.0))
            axis.set(xticks=(-0.8, 0.0, 0.8), yticks=(-0.8, 0.0, 0.8), zticks=(-0.2, 0.3, 0.8))
            axis.tick_params(labelsize=5, pad=-2)
        figure.subplots_adjust(left=0.01, right=0.97, bottom=0.03, top=0.95, wspace=0.05, hspace=0.08)
    return figure


def estimates(geometries: dict[str, Metrics]) -> Figure:
    """Draw the essential estimates' errors, CAD and fitted geometry, RP and OT (Figs 6 and 7).

    Args:
        geometries: "CAD, RP", "CAD, OT", "ID, RP" and "ID, OT" to their metrics.
    """
    column = np.arange(len(TABLE_4))
    colours = (BEFORE, MARK, QUIET, AFTER)
    with styled():
        figure, (errors, change) = sheet(2, 1, width=PAGE_WIDTH, height=5.8, head=0.3)
        for k, (name, metrics) in enumerate(geometries.items()):
            error = _percent_error(metrics["estimate"], metrics["truth"])
            x = column + 0.15 * (k - 1.5)
            errors.plot(x, error, "o", markersize=3, color=colours[k], label=name)
        cad_error = _percent_error(geometries["CAD, OT"]["estimate"], geometries["ID, OT"]["estimate"])
        change.bar(column, cad_error, color=BEFORE, bottom=0.001)
        change.set_title("After Fig. 7: what the geometry changes, OT")
        errors.set_ylabel("error of the estimate [%]")
        change.set_ylabel("|CAD - ID| / |ID| [%]")
        for axis in (errors, change):
            log_axis(axis.yaxis, 0.0015, 300.0)
            axis.set_xticks(column, TABLE_4, fontsize=6, rotation=90)
            axis.set_xlim(-1.0, len(column))
        errors.legend(ncols=4, fontsize=7, loc="lower left", bbox_to_anchor=(0.0, 0.98, 1.0, 0.1), mode="expand")
        title = "Error of the estimates, after Fig. 6: RP 20 random waypoints, OT trajectory B"
        figure.text(0.01, 0.985, title, fontsize=8)
    return figure


def _percent_error(values: Sequence[float], reference: Sequence[float]) -> np.ndarray:
    """Return relative errors [%], those below the drawn range at its end."""
    error = 100.0 * np.abs(np.divide(values, reference) - 1.0)
    return np.maximum(error, MIN_ERROR)


def speeds(motions: dict[str, list[Metrics]], shares: tuple[float, ...]) -> Figure:
    """Draw the plain moves' median RSD over that of B, and their true error in sigma, by speed; one dot per seed.

    Args:
        motions: name of a motion to its metrics over seeds.
        shares: speeds of the moves, as shares of the limits.
    """
    fits = (("102 fitted", AFTER, "all 102 fitted"), ("44 fitted", MARK, "the 44 fitted alone"))
    with styled():
        figure, (ratio_axis, error_axis) = sheet(1, 2, width=PAGE_WIDTH, height=2.8)
        for fit, colour, label in fits:
            _draw_fit(ratio_axis, error_axis, motions, shares, fit, colour, label)
        ratio_axis.axhline(2.0, color=INK, linewidth=0.5)
        ratio_axis.axhline(1.0, color=QUIET, linewidth=0.5, linestyle=":")
        ratio_axis.annotate("the paper's factor", (shares[-1], 2.03), ha="right", va="bottom", fontsize=7)
        ratio_axis.set(xlabel="speed of the moves, share of the limits", ylabel="median RSD over trajectory B's")
        ratio_axis.set_ylim(0.0)
        error_axis.set(xlabel="speed of the moves, share of the limits", ylabel="true error [σ, rms]")
        log_axis(error_axis.yaxis, 0.5, 15.0)
        error_axis.annotate("dotted: trajectory B", (shares[0], 2.5), fontsize=7)
        ratio_axis.legend(fontsize=7, loc="lower left")
    return figure


def _draw_fit(
    ratio_axis: Axes,
    error_axis: Axes,
    motions: dict[str, list[Metrics]],
    shares: tuple[float, ...],
    fit: str,
    colour: str,
    label: str,
) -> None:
    """Draw the moves' RSD over B's and their true error, of one way to fit.

    Args:
        ratio_axis, error_axis: axes to draw on.
        motions: name of a motion to its metrics over seeds.
        shares: speeds of the moves, as shares of the limits.
        fit: key of the fit in the metrics.
        colour: colour of its lines.
        label: name of it in the legend.
    """
    reference = motions["B, 44 columns"]
    reference_rsd = np.median(_by_seed(reference, fit, "median_rsd"))
    drawn, ratios, errors = [], [], []
    for share in shares:
        runs = motions.get(f"moves at {share:g}")
        if runs is None:
            continue
        drawn.append(share)
        ratios.append(_by_seed(runs, fit, "median_rsd") / reference_rsd)
        errors.append(_by_seed(runs, fit, "error_in_sigma"))
    ratio_axis.plot(drawn, np.median(ratios, axis=1), color=colour, label=label)
    ratio_axis.plot(drawn, ratios, ".", color=colour)
    error_axis.plot(drawn, np.median(errors, axis=1), color=colour, label=label)
    error_axis.plot(drawn, errors, ".", color=colour)
    reference_error = float(np.median(_by_seed(reference, fit, "error_in_sigma")))
    error_axis.axhline(reference_error, color=colour, linestyle=":")


def _by_seed(runs: Sequence[Metrics], fit: str, figure: str) -> np.ndarray:
    """Return a figure of merit of each seed (seeds,)."""
    return np.array([run[fit][figure] for run in runs])


def front(motions: dict[str, list[Metrics]]) -> Figure:
    """Draw the Pareto front of joint 6's torque and the condition number, the designs A and B, and the paper's goal.

    Args:
        motions: name of a motion to its metrics over seeds; the front is that of B by the first seed.
    """
    designs = motions["B, 44 columns"][0]["front"]
    best = sorted((design["share"], design["cond"]) for design in designs if design["best"])
    chosen = [(design["share"], design["cond"]) for design in designs if design["designed"]]
    with styled():
        figure, (axis,) = sheet(width=PAGE_WIDTH, height=2.8)
        axis.plot(*zip(*best), "o-", color=AFTER, markersize=4, label="Pareto front, ε-constraint")
        axis.plot(*zip(*chosen), "s", color=MARK, markersize=7, label="B of seed 0, chosen")
        for name, marker, colour in (("A", "^", BEFORE), ("B", "s", QUIET)):
            runs = motions.get(f"{name}, 44 columns", [])
            seeds = [(run["torque_share"][5], run["cond"]["44"]["raw"]) for run in runs]
            if seeds:
                axis.plot(*zip(*seeds), marker, color=colour, markersize=4, label=f"{name}, 44 columns, all seeds")
        goal = "asked by the paper: at most 35, at least 0.1"
        axis.plot([PAPER_SHARE], [PAPER_CONDITION], "x", color=INK, label=goal)
        axis.set(xlabel="mean torque of joint 6 / limit", ylabel="cond of 44 columns")
        axis.legend(fontsize=7)
    return figure

"""Pictures of the excitation study, after Figs 5, 6 and 7 of Kolyubin, Shiriaev & Jubien (2019)."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from simulated_arm import TABLE_4

from calib.procedure.report.figures.sheets import log_axis, sheet, styled
from calib.toolkit.chains import Chain, forward
from calib.toolkit.report_charts import AFTER, BEFORE, INK, MARK, PAGE_WIDTH, QUIET
from calib.toolkit.simulations import Reference


def paths(chain: Chain, motions: dict[str, Reference]) -> Figure:
    """Draw the tool's path of every motion in space (Fig. 5)."""
    with styled():
        across, down = min(len(motions), 3), -(-len(motions) // 3)
        figure = Figure(figsize=(PAGE_WIDTH, 2.5 * down))
        for k, (name, motion) in enumerate(motions.items()):
            axis: Any = figure.add_subplot(down, across, k + 1, projection="3d")
            axis.plot(*forward(chain, motion.q[::20])[:, :3, 3].T, color=AFTER, linewidth=0.7)
            axis.set_title(name, y=0.98, fontsize=9)
            axis.set(xlim=(-0.9, 0.9), ylim=(-0.9, 0.9), zlim=(-0.3, 0.9), box_aspect=(1.5, 1.5, 1.0))
            axis.set(xticks=(-0.8, 0.0, 0.8), yticks=(-0.8, 0.0, 0.8), zticks=(-0.2, 0.3, 0.8))
            axis.tick_params(labelsize=5, pad=-2)
        figure.subplots_adjust(left=0.01, right=0.97, bottom=0.03, top=0.95, wspace=0.05, hspace=0.08)
    return figure


def estimates(found: dict[str, Any]) -> Figure:
    """Draw the essential estimates' errors, CAD and fitted geometry, RP and OT (Figs 6 and 7)."""
    place, colours = np.arange(len(TABLE_4)), dict(zip(found, (BEFORE, MARK, QUIET, AFTER)))
    with styled():
        figure, (first, second) = sheet(2, 1, width=PAGE_WIDTH, height=5.8, head=0.3)
        for k, (name, row) in enumerate(found.items()):
            off = 100.0 * np.abs(np.array(row["estimate"]) / row["truth"] - 1.0)
            first.plot(
                place + 0.15 * (k - 1.5), np.maximum(off, 0.002), "o", markersize=3, color=colours[name], label=name
            )
        cad, own = (np.array(found[f"{name}, OT"]["estimate"]) for name in ("CAD", "ID"))
        second.bar(place, np.maximum(100.0 * np.abs(cad / own - 1.0), 0.002), color=BEFORE, bottom=0.001)
        second.set_title("After Fig. 7: what the geometry changes, OT")
        for axis, words in ((first, "error of the estimate [%]"), (second, "|CAD - ID| / |ID| [%]")):
            axis.set_ylabel(words)
            log_axis(axis.yaxis, 0.0015, 300.0)
            axis.set_xticks(place, TABLE_4, fontsize=6, rotation=90)
            axis.set_xlim(-1.0, len(place))
        first.legend(ncols=4, fontsize=7, loc="lower left", bbox_to_anchor=(0.0, 0.98, 1.0, 0.1), mode="expand")
        figure.text(
            0.01, 0.985, "Error of the estimates, after Fig. 6: RP 20 random waypoints, OT trajectory B", fontsize=8
        )
    return figure


def speeds(rows: dict[str, list[dict[str, Any]]], shares: tuple[float, ...]) -> Figure:
    """Draw the plain moves' median RSD over that of B, and their true error in sigma, by speed; one dot per seed."""
    own = rows["B, 44 columns"]
    with styled():
        figure, (left, right) = sheet(1, 2, width=PAGE_WIDTH, height=2.8)
        for key, colour, words in (("102 fitted", AFTER, "all 102 fitted"), ("44 fitted", MARK, "the 44 fitted alone")):
            runs = {share: rows[f"moves at {share:g}"] for share in shares if f"moves at {share:g}" in rows}
            level = np.median([one[key]["median_rsd"] for one in own])
            ratio = [[one[key]["median_rsd"] / level for one in x] for x in runs.values()]
            error = [[one[key]["error_in_sigma"] for one in x] for x in runs.values()]
            for axis, values in ((left, ratio), (right, error)):
                axis.plot(list(runs), np.median(values, axis=1), color=colour, label=words)
                axis.plot(list(runs), values, ".", color=colour)
            right.axhline(np.median([one[key]["error_in_sigma"] for one in own]), color=colour, linestyle=":")
        left.axhline(2.0, color=INK, linewidth=0.5)
        left.axhline(1.0, color=QUIET, linewidth=0.5, linestyle=":")
        left.annotate("the paper's factor", (shares[-1], 2.03), ha="right", va="bottom", fontsize=7)
        left.set(xlabel="speed of the moves, share of the limits", ylabel="median RSD over trajectory B's")
        left.set_ylim(0.0)
        right.set(xlabel="speed of the moves, share of the limits", ylabel="true error [σ, rms]")
        log_axis(right.yaxis, 0.5, 15.0)
        right.annotate("dotted: trajectory B", (shares[0], 2.5), fontsize=7)
        left.legend(fontsize=7, loc="lower left")
    return figure


def front(rows: dict[str, list[dict[str, Any]]]) -> Figure:
    """Draw the Pareto front of joint 6's torque and the condition number, the designs A and B, and the paper's goal."""
    chosen = rows["B, 44 columns"][0]["front"]
    best = sorted((one["share"], one["cond"]) for one in chosen if one["best"])
    with styled():
        figure, (axis,) = sheet(width=PAGE_WIDTH, height=2.8)
        axis.plot(*zip(*best), "o-", color=AFTER, markersize=4, label="Pareto front, ε-constraint")
        own = [(one["share"], one["cond"]) for one in chosen if one["designed"]]
        axis.plot(*zip(*own), "s", color=MARK, markersize=7, label="B of seed 0, chosen")
        for name, mark, colour in (("A", "^", BEFORE), ("B", "s", QUIET)):
            seeds = [(one["torque_share"][5], one["cond"]["44"]["raw"]) for one in rows.get(f"{name}, 44 columns", [])]
            if seeds:
                axis.plot(*zip(*seeds), mark, color=colour, markersize=4, label=f"{name}, 44 columns, all seeds")
        axis.plot([0.1], [35.0], "x", color=INK, label="asked by the paper: at most 35, at least 0.1")
        axis.set(xlabel="mean torque of joint 6 / limit", ylabel="cond of 44 columns")
        axis.legend(fontsize=7)
    return figure

"""Pictures of the excitation study, after Figs 5, 6 and 7 of Kolyubin, Shiriaev & Jubien (2019)."""

from __future__ import annotations

from typing import Any

import numpy as np
from dynamics import TABLE_4
from matplotlib.figure import Figure

from calib.procedure.report.style import AFTER, BEFORE, INK, MARK, QUIET, WIDE, sheet, styled
from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from calib.simulation.loop.references import Reference


def paths(chain: Chain, motions: dict[str, Reference]) -> Figure:
    """Draw the tool's path of every motion in space (Fig. 5)."""
    with styled():
        columns = min(len(motions), 3)
        figure = Figure(figsize=(WIDE, 2.6 * -(-len(motions) // columns)))
        for k, (name, motion) in enumerate(motions.items()):
            axis: Any = figure.add_subplot(-(-len(motions) // columns), columns, k + 1, projection="3d")
            place = forward(chain, motion.q[::20])[:, :3, 3]
            axis.plot(*place.T, color=AFTER, linewidth=0.7)
            axis.set_title(name)
            axis.set(xlim=(-0.9, 0.9), ylim=(-0.9, 0.9), zlim=(-0.3, 0.9), box_aspect=(1.5, 1.5, 1.0))
            axis.tick_params(labelsize=5)
    return figure


def estimates(found: dict[str, Any]) -> Figure:
    """Draw the essential estimates over the truth, CAD and fitted geometry, RP and OT (Figs 6 and 7)."""
    place, wide = np.arange(len(TABLE_4)), dict(zip(found, (BEFORE, MARK, QUIET, AFTER)))
    with styled():
        figure, (first, second) = sheet(2, 1, width=WIDE, height=5.6)
        for k, (name, row) in enumerate(found.items()):
            off = 100.0 * (np.array(row["estimate"]) / row["truth"] - 1.0)
            first.plot(place + 0.15 * (k - 1.5), off, "o", markersize=2.5, color=wide[name], label=name)
        first.axhline(0.0, color=INK, linewidth=0.5)
        first.set(
            ylabel="estimate over truth [%]", title="after Fig. 6: RP random waypoints, OT trajectory B, 44 columns"
        )
        first.set_yscale("symlog", linthresh=1.0)
        first.legend(ncols=4, fontsize=7)
        cad, own = (np.array(found[f"{name}, OT"]["estimate"]) for name in ("CAD", "ID"))
        second.bar(place, 100.0 * np.abs(cad / own - 1.0), color=BEFORE)
        second.set(yscale="log", ylabel="|CAD - ID| / |ID| [%]", title="after Fig. 7: what the geometry changes")
        for axis in (first, second):
            axis.set_xticks(place, TABLE_4, rotation=90, fontsize=6)
    return figure


def speeds(rows: dict[str, list[dict[str, Any]]], shares: tuple[float, ...]) -> Figure:
    """Draw the plain moves' median RSD over that of B, and their true error in sigma, by speed; one dot per seed."""
    own = rows["B, 44 columns"]
    with styled():
        figure, (left, right) = sheet(1, 2, width=WIDE, height=2.8)
        for key, colour, words in (("102 fitted", AFTER, "all 102 fitted"), ("44 fitted", MARK, "the 44 fitted alone")):
            runs = {share: rows[f"moves at {share:g}"] for share in shares if f"moves at {share:g}" in rows}
            ratio = [[a[key]["median_rsd"] / b[key]["median_rsd"] for a, b in zip(x, own)] for x in runs.values()]
            error = [[one[key]["error_in_sigma"] for one in x] for x in runs.values()]
            for axis, values in ((left, ratio), (right, error)):
                axis.plot(list(runs), np.median(values, axis=1), color=colour, label=words)
                axis.plot(list(runs), values, ".", color=colour)
            right.axhline(np.median([one[key]["error_in_sigma"] for one in own]), color=colour, linestyle=":")
        left.axhline(2.0, color=INK, linewidth=0.5)
        left.annotate("paper: twice", (shares[-1], 2.0), ha="right", va="bottom", fontsize=7)
        left.set(xlabel="speed of the moves, share of the limits", ylabel="median RSD over B's", ylim=(0.0, None))
        right.set(xlabel="speed of the moves, share of the limits", ylabel="true error [σ, rms]", yscale="log")
        right.set_title("dotted: trajectory B", fontsize=7)
        left.legend(fontsize=7)
    return figure

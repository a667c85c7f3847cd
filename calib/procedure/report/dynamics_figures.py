"""The figures of the dynamics on a certificate, drawn from the plain numbers that a session's folders hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from calib.procedure.report.style import AFTER, BEFORE, HALF, INK, MARK, QUIET, WIDE, sheet, styled

FEW = 8  # torque rows whose figures fit half a page


def torques(curves: Mapping[str, Any], rows: Sequence[str], units: Sequence[str]) -> Figure:
    """Draw measured and predicted torque of every row over time, and what is left."""
    t, count = np.array(curves["t"]), len(rows)
    columns = 2 if count > 4 else 1
    lines = -(-count // columns)
    with styled():
        figure, axes = sheet(lines, columns, WIDE, 1.05 * lines + 0.6)
        for j, axis in enumerate(axes):
            if j >= count:
                axis.set_visible(False)
                continue
            measured, predicted = (np.array(curves[key][j]) for key in ("measured", "predicted"))
            axis.plot(t, measured, color=BEFORE, linewidth=1.4, label="measured")
            axis.plot(t, predicted, color=AFTER, linewidth=0.7, label="predicted")
            axis.plot(t, measured - predicted, color=QUIET, linewidth=0.5, label="left")
            axis.set_title(f"{rows[j]} [{units[j]}]", fontsize=7.5)
            axis.tick_params(labelsize=6.5)
            if j + columns < count:
                axis.set_xticklabels([])
            else:
                axis.set_xlabel("time [s]", fontsize=7.5)
        axes[0].legend(ncols=3, loc="upper right", fontsize=6.5)
    return figure


def errors_by_row(fitted: Sequence[float], unseen: Sequence[float], rows: Sequence[str]) -> Figure:
    """Draw the relative error of every row, on the training and on unseen motion."""
    place = np.arange(len(rows))
    with styled():
        figure, (axis,) = sheet(1, 1, WIDE if len(rows) > FEW else HALF, 2.6)
        axis.barh(place - 0.19, fitted, 0.36, color=BEFORE, label="training motion")
        axis.barh(place + 0.19, unseen, 0.36, color=AFTER, label="unseen motion")
        axis.set_yticks(place, rows, fontsize=6.5 if len(rows) > 8 else 7.5)
        axis.invert_yaxis()
        axis.set_xlabel("torque unexplained [%]")
        axis.legend(fontsize=7)
    return figure


def whiteness(values: Sequence[Sequence[float] | None], bounds: Sequence[float | None], rows: Sequence[str]) -> Figure:
    """Draw the autocorrelation of every row's residual, with the bounds of white noise."""
    shown = [j for j in range(len(rows)) if values[j] is not None]
    many = len(rows) > FEW
    columns = min(7 if many else 4, max(1, len(shown)))
    with styled():
        figure, axes = sheet(-(-max(1, len(shown)) // columns), columns, WIDE if many else HALF, 2.6)
        for axis in axes[len(shown) :]:
            axis.set_visible(False)
        for j, axis in zip(shown, axes):
            series, bound = values[j] or (), bounds[j] or 0.0
            axis.bar(np.arange(1, len(series) + 1), series, color=AFTER, width=0.8)
            for edge in (-bound, bound):
                axis.axhline(edge, color=MARK, linewidth=0.6, linestyle="--")
            axis.set_title(rows[j], fontsize=6.5)
            axis.set(ylim=(-1, 1), yticks=(-1, 0, 1))
            axis.tick_params(labelsize=5.5)
    return figure


def motion(t: np.ndarray, q: np.ndarray, v: np.ndarray, names: Sequence[str], units: Sequence[str]) -> Figure:
    """Draw the designed positions and speeds of every joint over one period."""
    with styled():
        figure, axes = sheet(2, len(names), WIDE, 2.4)
        for j, name in enumerate(names):
            for k, (series, unit) in enumerate(((q, units[j]), (v, f"{units[j]}/s"))):
                axis = axes[k * len(names) + j]
                axis.plot(t, series[:, j], color=AFTER, linewidth=0.8)
                axis.axhline(0.0, color=QUIET, linewidth=0.4)
                axis.tick_params(labelsize=5.5)
                if k == 0:
                    axis.set_title(name, fontsize=7)
                    axis.set_xticklabels([])
                if j == 0:
                    axis.set_ylabel(f"{'position' if k == 0 else 'speed'} [{unit}]", fontsize=7)
        figure.supxlabel("time [s]", fontsize=7.5, color=INK)
    return figure


def significance(names: Sequence[str], values: np.ndarray, sigma: np.ndarray) -> Figure:
    """Draw how many sigmas each parameter is from zero; below two it is not told."""
    share = np.abs(values) / np.maximum(sigma, 1e-300)
    with styled():
        figure, (axis,) = sheet(1, 1, WIDE, 2.2)
        colours = [AFTER if one > 2 else QUIET for one in share]
        axis.bar(np.arange(len(names)), np.maximum(share, 0.1), color=colours, width=0.75)
        axis.axhline(2.0, color=MARK, linewidth=0.7, linestyle="--")
        axis.set_yscale("log")
        axis.set_xticks(np.arange(len(names)), names, rotation=90, fontsize=5 if len(names) > 60 else 6)
        axis.set_ylabel("|value| / σ")
        axis.margins(x=0.005)
    return figure

"""Box plots of a study: torque errors of all methods on one condition, failures named beside."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from calib.procedure.report.page import Picture
from calib.procedure.report.style import (
    AFTER,
    BEFORE,
    MARK,
    QUIET,
    WIDE,
    label_ticks,
    log_axis,
    picture,
    room,
    sheet,
    styled,
)
from calib.studies.summary import LEAST, ConditionSummary, spread
from calib.studies.trial import TrialRow

LINE = 0.21  # height of one method [in]


def boxes(one: ConditionSummary, rows: Sequence[TrialRow]) -> Picture:
    """Return the box plot of a condition."""
    series = [
        (
            method.method, method.as_good, sum(method.failures.values()),
            tuple(row.torque_error for row in rows if row.method == method.method and np.isfinite(row.torque_error)),
        )
        for method in one.methods
    ]  # fmt: skip
    words = (
        "Torque error on unseen motion, noise-free: boxes from quartile to quartile with the median, lines to the 5th "
        f"and 95th percentile, points beyond; fewer than {LEAST} as points. Dark: as good as the best. Trials without "
        "an estimate stand at the right."
    )
    return picture(partial(_draw, series), words, True)


def _draw(series: Sequence[tuple[str, bool, int, tuple[float, ...]]]) -> Figure:
    with styled():
        left = room([name for name, *_ in series], 8.5)
        figure, (axes,) = sheet(
            1, 1, WIDE, 0.75 + LINE * len(series), left=max(left, 0.6), right=0.9, bottom=0.45, top=0.12
        )  # fmt: skip
        everything = np.array([value for *_, values in series for value in values])
        low, high = (everything.min(), everything.max()) if len(everything) else (0.1, 1.0)
        log_axis(axes.xaxis, 0.8 * max(low, 1e-6), 1.25 * max(high, 1.1e-6))
        axes.set_ylim(len(series) - 0.5, -0.5)
        label_ticks(axes.yaxis, np.arange(len(series)), [name for name, *_ in series])
        axes.set_ylim(len(series) - 0.5, -0.5)
        axes.grid(True, axis="x")
        axes.set_xlabel("torque error [%]")
        for place, (_, good, failed, values) in enumerate(series):
            if values:
                _box(axes, place, np.asarray(values), AFTER if good else BEFORE)
            if failed:
                axes.text(
                    1.01, place, f"{failed} failed", transform=axes.get_yaxis_transform(), va="center", fontsize=7.0,
                    color=MARK,
                )  # fmt: skip
        return figure


def _box(axes, place: int, values: np.ndarray, colour: str) -> None:
    if len(values) < LEAST:
        axes.plot(values, np.full(len(values), place), "o", color=colour, markersize=4.0, zorder=3)
        return
    least, most = np.quantile(values, [0.05, 0.95], method="nearest")
    box = spread(values.tolist())
    axes.plot([least, most], [place, place], color=QUIET, linewidth=0.9, zorder=2)
    axes.barh(place, box.upper - box.lower, 0.56, box.lower, color=colour, zorder=3)
    axes.plot([box.median, box.median], [place - 0.34, place + 0.34], color="white", linewidth=1.4, zorder=4)
    beyond = values[(values < least) | (values > most)]
    axes.plot(beyond, np.full(len(beyond), place), ".", color=QUIET, markersize=2.0, zorder=2)

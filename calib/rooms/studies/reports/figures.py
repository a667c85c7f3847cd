"""Box plots of a study: torque errors of all methods on one condition, failures named beside."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.procedure.report.charts import Box, Chart, Line, Panel, Words, picture
from calib.procedure.report.page import Picture
from calib.procedure.report.style import AFTER, BEFORE, MARK
from calib.rooms.studies.summary import MIN_DATA_SETS, ConditionSummary
from calib.rooms.studies.trial import TrialRow


def boxes(one: ConditionSummary, rows: Sequence[TrialRow]) -> Picture:
    """Return the box plot of a condition."""
    layers: list = []
    every: list[float] = []
    for place, method in enumerate(one.methods):
        own = [row.torque_error for row in rows if row.method == method.method and np.isfinite(row.torque_error)]
        every += own
        colour = AFTER if method.as_good else BEFORE
        if len(own) < MIN_DATA_SETS:
            layers.append(Line(own, [place] * len(own), "o", colour, size=4.0))
        else:
            layers.append(Box(own, place, colour))
    low, high = 0.8 * max(min(every, default=0.1), 1e-6), 1.25 * max(max(every, default=1.0), 1.1e-6)
    for place, method in enumerate(one.methods):
        if failed := sum(method.failures.values()):
            layers.append(Words(f"{failed} failed", high, place, (3, 0), MARK, along="center"))
    names = [method.method for method in one.methods]
    panel = Panel(layers, x="torque error [%]", xlim=(low, high), log="x", ynames=names, grid="x")
    words = (
        "Torque error on unseen motion, noise-free: boxes from quartile to quartile with the median, lines to the 5th "
        f"and 95th percentile, points beyond; fewer than {MIN_DATA_SETS} as points. Dark: as good as the best. Trials "
        "without "
        "an estimate stand at the right."
    )
    line_height = 0.21  # height of one method [in]
    return picture(Chart([panel], 0.75 + line_height * len(names)), words)

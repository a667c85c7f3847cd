"""Drift during a measurement with its figures, as `calib drift` shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.apps.monitoring import pages
from calib.apps.monitoring.settings import DEFAULT_DRIFT, DriftSettings
from calib.arguments import checked
from calib.errors import Finding, UsageError, require
from calib.records import plain
from calib.result_kinds import BY_NAME
from calib.toolkit.pose_data import FitOptions, read_fit_options
from calib.toolkit.report_pages import RecordColumn, Section, Text, table
from calib.toolkit.result_folders import (
    ChartedResult,
    Judged,
    Verdict,
    lines_of,
    load_robot,
    read_measured_file,
    settle,
)
from calib.toolkit.sessions import Trend, noise_of_difference, repeats, trends

if TYPE_CHECKING:
    from calib.toolkit.report_charts import Chart

TABLE = "trends.csv"


@dataclass(frozen=True, eq=False)
class DriftFound(ChartedResult, Judged):
    """Drift of the target over a measurement. ``print`` shows verdict, trends and repeated poses.

    Attributes:
        robot: its name.
        trends: with time and temperatures.
        noticed: findings, worst first.
    """

    robot: str
    trends: tuple[Trend, ...]
    noticed: tuple[Finding, ...]

    kind = BY_NAME["drift"]
    tab = "trends noticed plot save"

    @property
    def verdict(self) -> Verdict:
        """Whether the drift matters."""
        totals = [f"{trend.what}: {1e3 * trend.total:.2g} mm in all" for trend in self.trends]
        return Verdict.of("; ".join(totals) or "no column of time or temperature", self.noticed)

    def section(self) -> Section:
        """Return a report section with the trends, and how far repeated poses are apart."""
        columns = [
            RecordColumn("with", "{0.what}", number=False),
            RecordColumn("poses", "{0.poses}"),
            RecordColumn("visits", "{0.x.size}"),
            RecordColumn("slope", _rate),
            *(RecordColumn(f"{axis} mm", _of_axis(k)) for k, axis in enumerate("xyz")),
            RecordColumn("in all mm", lambda trend: f"{1e3 * trend.total:.3g}"),
            RecordColumn("σ", lambda trend: f"{trend.sigmas:.1f}"),
        ]
        blocks = [Text("Notes", lines_of(self.noticed), "note"), table("Drift of the target", columns, self.trends)]
        return Section("Drift", blocks, self.verdict.level, self.verdict.reason)

    def charts(self) -> dict[str, Chart]:
        """Return what the figures show: the motion of repeated poses' targets, with the slope."""
        from calib.toolkit.report_charts import AFTER, QUIET, Chart, Panel, line

        panels = []
        for trend in self.trends:
            ends = np.array([trend.x.min(), trend.x.max()])
            for k, axis in enumerate("xyz"):
                drawn = 1e3 * trend.slope[k] * (ends - trend.x.mean())
                layers = [line(trend.x, 1e3 * trend.moved[:, k], "o", AFTER), line(ends, drawn, "-", QUIET)]
                panels.append(Panel(layers, f"{axis} [mm]", f"{trend.what} [{trend.unit}]"))
        return {"drift": Chart(panels, 2.2 * len(self.trends), 3)} if panels else {}

    @checked
    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write a folder: report.html, trends.csv, metrics.json, and the figure as PNG."""
        header = ("column", "unit", "x", "dx [mm]", "dy [mm]", "dz [mm]")
        rows = [
            (trend.what, trend.unit, x, *(1e3 * displacement))
            for trend in self.trends
            for x, displacement in zip(trend.x, trend.moved)
        ]
        part = pages.ResultPart(
            self.section(),
            self.charts() if plots else {},
            ["Targets of repeated poses less the arm's prediction."],
            (TABLE, header, rows),
        )
        verdict = self.verdict
        numbers: dict[str, object] = {
            "robot": self.robot,
            "verdict": verdict.level,
            "reason": verdict.reason,
            "noticed": self.noticed,
        }
        for trend in self.trends:
            numbers[trend.what] = {
                "slope": trend.slope,
                "sigma": trend.sigma,
                "sigmas": trend.sigmas,
                "total": trend.total,
            }
        title = f"Drift of {self.robot}"
        return pages.save(Path(out), "drift", title, {"robot": self.robot}, [part], plain(numbers), [TABLE])


def _rate(trend: Trend) -> str:
    return f"{1e3 * trend.size:.2g} ± {1e3 * trend.sigma:.1g} mm/{trend.unit}"


def _of_axis(k: int):
    return lambda trend: f"{1e3 * trend.slope[k]:+.2g}"


def drift(
    robot: str | Path,
    measured: Sequence[str | Path],
    settings: DriftSettings = DEFAULT_DRIFT,
    options: str | Path | FitOptions | None = None,
    base: str | None = None,
    tip: str | None = None,
) -> DriftFound:
    """Return how the target drifts with time and temperature, from poses that were measured more than once.

    Args:
        robot, base, tip: the arm, as of `calib.load`.
        measured: CSV files with some poses measured several times, and columns ``time`` or ``temperature``; all
            from one place of the instrument.
        settings: way that matters, and the instrument's σ.
        options: as of `fit_geometry`.

    Raises:
        UsageError: where no pose was measured twice.
    """
    chosen = (
        options if isinstance(options, FitOptions) else read_fit_options(None if options is None else Path(options))
    )
    chain = load_robot(robot, None, chosen, base=base, tip=tip)[0]
    blocks = [block for path in measured for block in read_measured_file(Path(path), chain, chosen)]
    repeat_findings = repeats(chain, blocks[:1], blocks[1:], settings.sigma or 0.0)
    trends_found = tuple(trends(chain, blocks[:1], blocks[1:], settings.sigma or 0.0))
    message = "no pose was measured twice: measure the first poses again at the end, into the same or a further file"
    require(repeat_findings or trends_found, message, UsageError)
    need = settings.tolerance or noise_of_difference(settings.sigma or 0.0)
    return DriftFound(
        chain.name, trends_found, settle([*repeat_findings, *(trend.finding(need) for trend in trends_found)])
    )

"""Result of `calib drift`: drift of the target during a measurement, with its figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.apps.monitoring import report_folder
from calib.apps.monitoring.settings import DEFAULT_DRIFT, DriftSettings
from calib.arguments import checked
from calib.config_types import Plots
from calib.errors import Finding, UsageError, require
from calib.records import plain
from calib.result_kinds import BY_NAME
from calib.toolkit.pose_data import FitOptions, read_fit_options
from calib.toolkit.report_pages import RecordColumn, Section, Text, table
from calib.toolkit.result_folders import (
    ChartedResult,
    ReportedResult,
    Verdict,
    load_robot,
    notes_of,
    read_measured_file,
    settle,
)
from calib.toolkit.sessions import Trend, noise_of_difference, repeats, trends

if TYPE_CHECKING:
    from calib.toolkit.report_charts import Chart

TABLE = "trends.csv"
HEADER = ("column", "unit", "x", "dx [mm]", "dy [mm]", "dz [mm]")
CAPTION = "Targets of repeated poses minus the arm's prediction."


@dataclass(frozen=True, eq=False)
class DriftFound(ChartedResult, ReportedResult):
    """Drift of the target over a measurement.

    ``print`` shows verdict, trends and repeated poses.

    Attributes:
        robot: name of the robot.
        trends: trends of the target's position with time and with temperatures.
        noticed: findings, worst first.
    """

    robot: str
    trends: tuple[Trend, ...]
    noticed: tuple[Finding, ...]

    kind = BY_NAME["drift"]
    tab = "trends noticed plot save"

    @property
    def verdict(self) -> Verdict:
        """Verdict on whether the drift is acceptable."""
        totals = [f"{trend.column}: {1e3 * trend.total:.2g} mm in all" for trend in self.trends]
        return Verdict.of("; ".join(totals) or "no column of time or temperature", self.noticed)

    def section(self) -> Section:
        """Return the report section with the trends, and the distances between readings of repeated poses."""
        columns = [
            RecordColumn("with", "{0.column}", number=False),
            RecordColumn("poses", "{0.poses}"),
            RecordColumn("visits", "{0.x.size}"),
            RecordColumn("slope", _rate),
            RecordColumn("x mm", _slope_x_mm),
            RecordColumn("y mm", _slope_y_mm),
            RecordColumn("z mm", _slope_z_mm),
            RecordColumn("in all mm", _total_mm),
            RecordColumn("σ", "{0.sigmas:.1f}"),
        ]
        blocks = [Text("Notes", notes_of(self.noticed), "note"), table("Drift of the target", columns, self.trends)]
        return Section("Drift", blocks, self.verdict.level, self.verdict.reason)

    def charts(self) -> dict[str, Chart]:
        """Return the figures by name: displacement of the target at repeated poses, with the trend.

        The mapping is empty if there are no trends.
        """
        from calib.toolkit.report_charts import AFTER, QUIET, Chart, Line, Panel

        panels = []
        for trend in self.trends:
            ends = np.array([trend.x.min(), trend.x.max()])
            for k, axis in enumerate("xyz"):
                motion = Line(trend.x, 1e3 * trend.displacement[:, k], "o", AFTER)
                slope = Line(ends, 1e3 * trend.slope[k] * (ends - trend.x.mean()), "-", QUIET)
                panels.append(Panel([motion, slope], f"{axis} [mm]", f"{trend.column} [{trend.unit}]"))
        if not panels:
            return {}
        return {"drift": Chart(panels, 2.2 * len(self.trends), 3)}

    @checked
    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Write the result into a folder and return its path.

        The folder contains report.html, trends.csv, metrics.json, and the figure as PNG.

        Args:
            out: the folder.
            plots: whether figures are drawn.
        """
        rows: list[tuple[object, ...]] = []
        for trend in self.trends:
            for x, displacement in zip(trend.x, trend.displacement):
                rows.append((trend.column, trend.unit, x, *(1e3 * displacement)))
        charts: dict[str, Chart] = {}
        if plots:
            charts = self.charts()
        part = report_folder.ResultPart(self.section(), charts, [CAPTION], (TABLE, HEADER, rows))
        verdict = self.verdict
        numbers: dict[str, object] = {
            "robot": self.robot,
            "verdict": verdict.level,
            "reason": verdict.reason,
            "noticed": self.noticed,
        }
        for trend in self.trends:
            numbers[trend.column] = {
                "slope": trend.slope,
                "sigma": trend.sigma,
                "sigmas": trend.sigmas,
                "total": trend.total,
            }
        title = f"Drift of {self.robot}"
        return report_folder.save(
            Path(out), "drift", title, {"robot": self.robot}, [part], plain(numbers), [TABLE], plots
        )


def _rate(trend: Trend) -> str:
    return f"{1e3 * trend.size:.2g} ± {1e3 * trend.sigma:.1g} mm/{trend.unit}"


def _slope_x_mm(trend: Trend) -> str:
    return f"{1e3 * trend.slope[0]:+.2g}"


def _slope_y_mm(trend: Trend) -> str:
    return f"{1e3 * trend.slope[1]:+.2g}"


def _slope_z_mm(trend: Trend) -> str:
    return f"{1e3 * trend.slope[2]:+.2g}"


def _total_mm(trend: Trend) -> str:
    return f"{1e3 * trend.total:.3g}"


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
        robot: the arm: library name, file (URDF, or MDH table in TOML), or folder of a fit.
        measured: CSV files with some poses measured several times, and columns ``time`` or ``temperature``; all from
            one station of the instrument.
        settings: displacement above which the drift is not acceptable, and σ of the instrument.
        options: options for reading the files (`calib formats options`): TOML file, or in memory; None: defaults.
        base, tip: first and last link of the arm in a URDF; None: its root, and its flange.

    Raises:
        UsageError: no pose was measured twice.
    """
    if isinstance(options, FitOptions):
        fit_options = options
    elif options is None:
        fit_options = read_fit_options(None)
    else:
        fit_options = read_fit_options(Path(options))
    chain = load_robot(robot, None, fit_options, base=base, tip=tip)[0]
    blocks = []
    for path in measured:
        blocks += read_measured_file(Path(path), chain, fit_options)

    first, later = blocks[:1], blocks[1:]
    sigma = settings.sigma or 0.0
    findings = list(repeats(chain, first, later, sigma))
    drifts = tuple(trends(chain, first, later, sigma))
    message = "no pose was measured twice: measure the first poses again at the end, into the same or a further file"
    require(findings or drifts, message, UsageError)
    need = settings.tolerance or noise_of_difference(sigma)
    findings += [trend.finding(need) for trend in drifts]
    return DriftFound(chain.name, drifts, settle(findings))

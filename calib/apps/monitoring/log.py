"""The log of one robot's calibrations, from the folders of its sessions: `calib log`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.apps.monitoring import pages
from calib.apps.monitoring.comparison.change_part import plus_minus
from calib.apps.monitoring.comparison.change_test import ParameterChange
from calib.apps.monitoring.comparison.geometry_change import GeometryChange
from calib.apps.monitoring.comparison.robot_change import diff
from calib.errors import SessionError, UsageError, command_line, require
from calib.records import plain
from calib.result_kinds import BY_NAME
from calib.toolkit.opened_results import Unjudged
from calib.toolkit.report_pages import RecordColumn, Section, table
from calib.toolkit.result_folders import ChartedResult, Judged
from calib.toolkit.sessions import Session, folders_of, open_session, position_errors, torque_error

if TYPE_CHECKING:
    from calib.toolkit.report_charts import Chart

TABLE = "log.csv"
HEADER = (
    "folder",
    "date",
    "robot",
    "serial",
    "verdict",
    "nominal [mm]",
    "calibrated [mm]",
    "torque [%]",
    "moved [mm]",
    "sigma [mm]",
    "parameter",
    "change",
    "change sigma",
    "unit",
)


@dataclass(frozen=True, eq=False)
class LogLine:
    """A calibration of the log.

    Attributes:
        folder, date, serial, verdict: of the session.
        errors: rms errors of nominal and calibrated robot on unseen poses [mm]; None without.
        torque: unexplained on unseen motion [%]; None without.
        change: of the geometry since the line before; None in the first, and where one of the two has no fit.
    """

    folder: str
    date: str
    serial: str
    verdict: str
    errors: tuple[float, float] | None
    torque: float | None
    change: GeometryChange | None

    @property
    def moved(self) -> tuple[float, float] | None:
        """How far the tool moved since the line before, rms, and what σ lets expect [mm]."""
        motion = self.change and self.change.motions[0]
        return (1e3 * motion.rms, 1e3 * motion.expected) if motion else None

    @property
    def first(self) -> ParameterChange | None:
        """The parameter that explains most of the change, where something changed."""
        return self.change.parameters[0] if self.change and self.change.changed else None

    @property
    def parameter(self) -> str:
        """That parameter with its change and σ."""
        change = self.first
        return f"{change.name} {plus_minus(change.alone, change.alone_sigma, change.unit)}" if change else ""

    def row(self, robot: str) -> tuple[object, ...]:
        """Return the cells of `HEADER`."""
        parameter = self.first
        change = (
            (parameter.name, parameter.alone, parameter.alone_sigma, parameter.unit)
            if parameter
            else ("", None, None, "")
        )
        errors, motion = self.errors or (None, None), self.moved or (None, None)
        return self.folder, self.date, robot, self.serial, self.verdict, *errors, self.torque, *motion, *change


@dataclass(frozen=True, eq=False)
class RobotLog(ChartedResult, Judged, Unjudged):
    """The calibrations of one robot, oldest first. ``print`` shows a line for each."""

    robot: str
    lines: tuple[LogLine, ...]

    kind = BY_NAME["log"]
    tab = "robot lines plot save"

    def section(self) -> Section:
        """Return a report section with a line per calibration."""
        columns = [
            *(RecordColumn(name, f"{{0.{name}}}", number=False) for name in ("date", "folder", "serial", "verdict")),
            RecordColumn("nominal mm", lambda log_line: f"{log_line.errors[0]:.3g}" if log_line.errors else ""),
            RecordColumn("calibrated mm", lambda log_line: f"{log_line.errors[1]:.3g}" if log_line.errors else ""),
            RecordColumn("torque %", lambda log_line: "" if log_line.torque is None else f"{log_line.torque:.3g}"),
            RecordColumn(
                "tool moved mm",
                lambda log_line: f"{log_line.moved[0]:.3g} (σ {log_line.moved[1]:.2g})" if log_line.moved else "",
            ),
            RecordColumn("most by", "{0.parameter}", number=False),
        ]
        return Section("Log", [table(f"Calibrations of {self.robot}", columns, self.lines)])

    def charts(self) -> dict[str, Chart]:
        """Return what the figure shows: errors of each calibration, and the tool's motion since the one before."""
        from calib.toolkit.report_charts import AFTER, BEFORE, Chart, Panel, line

        dates, panels = [log_line.date for log_line in self.lines], []
        values = {
            "error on unseen poses [mm]": [
                log_line.errors[1] if log_line.errors else np.nan for log_line in self.lines
            ],
            "the tool moved since the one before [mm]": [
                log_line.moved[0] if log_line.moved else np.nan for log_line in self.lines
            ],
        }
        expected = [log_line.moved[1] if log_line.moved else np.nan for log_line in self.lines]
        for title, series in values.items():
            layers = [line(range(len(series)), series, "o-", AFTER, label="found")]
            if "moved" in title:
                layers.append(line(range(len(series)), expected, "+", BEFORE, label="σ lets expect"))
            panels.append(Panel(layers, title, xnames=dates))
        return {"log": Chart(panels, 2.6, 2)}

    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write a folder: report.html, log.csv, metrics.json, and the figure as PNG."""
        rows = [log_line.row(self.robot) for log_line in self.lines]
        charts = self.charts() if plots else {}
        part = pages.ResultPart(self.section(), charts, ["Errors, and motion of the tool."], (TABLE, HEADER, rows))
        numbers = plain({"robot": self.robot, "lines": [dict(zip(HEADER, row)) for row in rows]})
        setup = {"robot": self.robot}
        return pages.save(Path(out), "log", f"Calibrations of {self.robot}", setup, [part], numbers, [TABLE])


def log(folders: Sequence[str | Path], *, mixed: bool = False) -> RobotLog:
    """Return the log of one robot's calibrations.

    Args:
        folders: of finished sessions, or their ``session.toml``.
        mixed: accept sessions of other names or serial numbers.

    Raises:
        UsageError: where sessions are of robots of other names or serial numbers.
        RobotError: where their nominal geometries differ.
        SessionError: for a session that has not come to a verdict.
    """
    sessions = sorted(
        (open_session(Path(path)) for path in folders_of(folders)), key=lambda session: session.settings.created
    )
    for attribute, of in (("robots", lambda session: session.settings.name), ("serial numbers", _serial)):
        names = list(dict.fromkeys(filter(None, map(of, sessions))))
        message = f"the sessions are of other {attribute} ({', '.join(names)}); --mixed takes them for one robot"
        require(len(names) < 2 or mixed, message, UsageError)
    for session in sessions:
        finished = session.concluded
        message = f"{session.folder} has no verdict yet: {command_line('next', session.folder)}"
        require(finished, message, SessionError)
    lines, last = list[LogLine](), None
    for session in sessions:
        change = None
        if session.fit.numbers.exists() and session.geometric:
            change = last and diff(last, session.folder).geometry
            last = session.folder
        lines.append(
            LogLine(
                str(session.folder),
                session.settings.created[:10],
                _serial(session),
                session.verdicts().level,
                position_errors(session),
                torque_error(session),
                change or None,
            )
        )
    return RobotLog(sessions[-1].settings.name, tuple(lines))


def _serial(session: Session) -> str:
    return session.settings.certificate.robot_serial

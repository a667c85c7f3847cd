"""The log of one robot's calibrations, from the folders of its sessions: `calib log`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.api.rendering import Drawn, Judged
from calib.apps.monitoring import pages
from calib.apps.monitoring.comparison.change_part import plus_minus
from calib.apps.monitoring.comparison.change_test import ParameterChange
from calib.apps.monitoring.comparison.geometry_change import GeometryChange
from calib.apps.monitoring.comparison.robot_change import diff
from calib.errors import SessionError, UsageError, command_line, require
from calib.folders import METRICS
from calib.procedure.report.page import Column, Section, table
from calib.procedure.session.folder import Session, open_session
from calib.procedure.session.results import folders_of, position_errors, torque_error
from calib.records import plain

if TYPE_CHECKING:
    from calib.procedure.report.charts import Chart

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
        one = self.first
        return f"{one.name} {plus_minus(one.alone, one.alone_sigma, one.unit)}" if one else ""

    def row(self, robot: str) -> tuple[object, ...]:
        """Return the cells of `HEADER`."""
        one = self.first
        change = (one.name, one.alone, one.alone_sigma, one.unit) if one else ("", None, None, "")
        errors, moved = self.errors or (None, None), self.moved or (None, None)
        return self.folder, self.date, robot, self.serial, self.verdict, *errors, self.torque, *moved, *change


@dataclass(frozen=True, eq=False)
class RobotLog(Drawn, Judged):
    """The calibrations of one robot, oldest first. ``print`` shows a line for each."""

    robot: str
    lines: tuple[LogLine, ...]

    tab = "robot lines plot save"

    def section(self) -> Section:
        """Return a report section with a line per calibration."""
        columns = [
            *(Column(name, f"{{0.{name}}}", number=False) for name in ("date", "folder", "serial", "verdict")),
            Column("nominal mm", lambda one: f"{one.errors[0]:.3g}" if one.errors else ""),
            Column("calibrated mm", lambda one: f"{one.errors[1]:.3g}" if one.errors else ""),
            Column("torque %", lambda one: "" if one.torque is None else f"{one.torque:.3g}"),
            Column("tool moved mm", lambda one: f"{one.moved[0]:.3g} (σ {one.moved[1]:.2g})" if one.moved else ""),
            Column("most by", "{0.parameter}", number=False),
        ]
        return Section("Log", [table(f"Calibrations of {self.robot}", columns, self.lines)])

    def charts(self) -> dict[str, Chart]:
        """Return what the figure shows: errors of each calibration, and the tool's motion since the one before."""
        from calib.procedure.report.charts import Chart, Panel, line
        from calib.procedure.report.style import AFTER, BEFORE

        dates, panels = [one.date for one in self.lines], []
        values = {
            "error on unseen poses [mm]": [one.errors[1] if one.errors else np.nan for one in self.lines],
            "the tool moved since the one before [mm]": [one.moved[0] if one.moved else np.nan for one in self.lines],
        }
        expected = [one.moved[1] if one.moved else np.nan for one in self.lines]
        for title, own in values.items():
            layers = [line(range(len(own)), own, "o-", AFTER, label="found")]
            if "moved" in title:
                layers.append(line(range(len(own)), expected, "+", BEFORE, label="σ lets expect"))
            panels.append(Panel(layers, title, xnames=dates))
        return {"log": Chart(panels, 2.6, 2)}

    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write a folder: report.html, log.csv, metrics.json, and the figure as PNG."""
        rows = [one.row(self.robot) for one in self.lines]
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
    found = sorted((open_session(Path(each)) for each in folders_of(folders)), key=lambda one: one.settings.created)
    for what, of in (("robots", lambda one: one.settings.name), ("serial numbers", _serial)):
        names = list(dict.fromkeys(filter(None, map(of, found))))
        words = f"the sessions are of other {what} ({', '.join(names)}); --mixed takes them for one robot"
        require(len(names) < 2 or mixed, words, UsageError)
    for one in found:
        done = one.path("verdict.json").exists()
        words = f"{one.folder} has no verdict yet: {command_line('next', one.folder)}"
        require(done, words, SessionError)
    lines, last = list[LogLine](), None
    for one in found:
        change = None
        if (one.fit.path / METRICS).exists() and one.geometric:
            change = last and diff(last, one.folder).geometry
            last = one.folder
        lines.append(
            LogLine(
                str(one.folder),
                one.settings.created[:10],
                _serial(one),
                one.verdicts().level,
                position_errors(one),
                torque_error(one),
                change or None,
            )
        )
    return RobotLog(found[-1].settings.name, tuple(lines))


def _serial(session: Session) -> str:
    return session.settings.certificate.robot_serial

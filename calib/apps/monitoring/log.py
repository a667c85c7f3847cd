"""The log of one robot's calibrations, from the folders of its sessions: `calib log`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.apps.monitoring import report_folder
from calib.apps.monitoring.comparison.change_part import plus_minus
from calib.apps.monitoring.comparison.change_test import ParameterChange
from calib.apps.monitoring.comparison.geometry_change import GeometryChange
from calib.apps.monitoring.comparison.robot_change import diff
from calib.config_types import Plots
from calib.errors import SessionError, UsageError, command_line, require
from calib.records import plain
from calib.result_kinds import BY_NAME
from calib.toolkit.report_pages import RecordColumn, Section, table
from calib.toolkit.result_folders import ChartedResult, ReportedResult, WithoutVerdict, open_result
from calib.toolkit.sessions import Session, folders_of, position_errors, torque_error

if TYPE_CHECKING:
    from calib.toolkit.report_charts import Chart

# where a calibration states no error, or no motion of the tool
NOT_KNOWN = (np.nan, np.nan)
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
    """One calibration in the log.

    Attributes:
        folder, date, serial, verdict: folder, date, serial number of the robot, and verdict of the session.
        errors: rms errors of nominal and calibrated robot at held-out poses [mm]; None without such poses.
        torque: unexplained share of the torque on the held-out motion [%]; None without dynamics.
        change: change of the geometry since the previous line; None in the first line, and where one of the two
            sessions has no fit.
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
        """Rms motion of the tool since the previous line, and the motion expected from the covariances [mm].

        None where the change is unknown.
        """
        if self.change is None:
            return None
        motion = self.change.motions[0]
        return 1e3 * motion.rms, 1e3 * motion.expected

    @property
    def first(self) -> ParameterChange | None:
        """The parameter whose change alone explains most since the previous line.

        None where no change is significant.
        """
        if self.change is None or not self.change.changed:
            return None
        return self.change.parameters[0]

    @property
    def parameter(self) -> str:
        """Name, change and σ of the parameter in `first`, as text; empty where `first` is None."""
        change = self.first
        if change is None:
            return ""
        return f"{change.name} {plus_minus(change.alone, change.alone_sigma, change.unit)}"

    def row(self, robot: str) -> tuple[object, ...]:
        """Return the cells of the log's table for this calibration, in the order of `HEADER`.

        Args:
            robot: name of the robot.
        """
        nominal, calibrated = self.errors or (None, None)
        motion, sigma = self.moved or (None, None)
        change: tuple[object, ...] = ("", None, None, "")
        if self.first:
            change = (self.first.name, self.first.alone, self.first.alone_sigma, self.first.unit)
        session = (self.folder, self.date, robot, self.serial, self.verdict)
        return (*session, nominal, calibrated, self.torque, motion, sigma, *change)


@dataclass(frozen=True, eq=False)
class RobotLog(ChartedResult, ReportedResult, WithoutVerdict):
    """The calibrations of one robot, oldest first; ``print`` shows one line for each."""

    robot: str
    lines: tuple[LogLine, ...]

    kind = BY_NAME["log"]
    tab = "robot lines plot save"

    def section(self) -> Section:
        """Return the report section with one line per calibration."""
        columns = [
            RecordColumn("date", "{0.date}", number=False),
            RecordColumn("folder", "{0.folder}", number=False),
            RecordColumn("serial", "{0.serial}", number=False),
            RecordColumn("verdict", "{0.verdict}", number=False),
            RecordColumn("nominal mm", _nominal_error),
            RecordColumn("calibrated mm", _calibrated_error),
            RecordColumn("torque %", _torque_error),
            RecordColumn("tool moved mm", _motion),
            RecordColumn("most by", "{0.parameter}", number=False),
        ]
        return Section("Log", [table(f"Calibrations of {self.robot}", columns, self.lines)])

    def charts(self) -> dict[str, Chart]:
        """Return the figure by name: errors of each calibration, and motion of the tool between calibrations."""
        from calib.toolkit.report_charts import AFTER, BEFORE, Chart, Line, Panel

        errors = []
        motions = []
        expected = []
        for log_line in self.lines:
            errors.append((log_line.errors or NOT_KNOWN)[1])
            motion = log_line.moved or NOT_KNOWN
            motions.append(motion[0])
            expected.append(motion[1])
        dates = [log_line.date for log_line in self.lines]
        numbers = range(len(dates))
        errors_drawn = [Line(numbers, errors, "o-", AFTER, label="measured")]
        motion_drawn = [
            Line(numbers, motions, "o-", AFTER, label="measured"),
            Line(numbers, expected, "+", BEFORE, label="expected from σ"),
        ]
        panels = [
            Panel(errors_drawn, "error on unseen poses [mm]", xnames=dates),
            Panel(motion_drawn, "motion of the tool since the last calibration [mm]", xnames=dates),
        ]
        return {"log": Chart(panels, 2.6, 2)}

    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Write the log into a folder and return its path.

        The folder contains report.html, log.csv, metrics.json, and the figure as PNG.

        Args:
            out: the folder.
            plots: whether figures are drawn.
        """
        charts: dict[str, Chart] = {}
        if plots:
            charts = self.charts()
        rows = [log_line.row(self.robot) for log_line in self.lines]
        part = report_folder.ResultPart(
            self.section(), charts, ["Errors, and motion of the tool."], (TABLE, HEADER, rows)
        )
        lines = [dict(zip(HEADER, row)) for row in rows]
        numbers = plain({"robot": self.robot, "lines": lines})
        title = f"Calibrations of {self.robot}"
        return report_folder.save(Path(out), "log", title, {"robot": self.robot}, [part], numbers, [TABLE], plots)


def _nominal_error(log_line: LogLine) -> str:
    if log_line.errors is None:
        return ""
    return f"{log_line.errors[0]:.3g}"


def _calibrated_error(log_line: LogLine) -> str:
    if log_line.errors is None:
        return ""
    return f"{log_line.errors[1]:.3g}"


def _torque_error(log_line: LogLine) -> str:
    if log_line.torque is None:
        return ""
    return f"{log_line.torque:.3g}"


def _motion(log_line: LogLine) -> str:
    if log_line.moved is None:
        return ""
    motion, sigma = log_line.moved
    return f"{motion:.3g} (σ {sigma:.2g})"


def log(folders: Sequence[str | Path], *, mixed: bool = False) -> RobotLog:
    """Return the log of one robot's calibrations.

    Args:
        folders: folders of finished sessions, or their ``session.toml``.
        mixed: accept sessions with different robot names or serial numbers.

    Raises:
        UsageError: the sessions have different robot names or serial numbers, without `mixed`.
        RobotError: the nominal geometries of the sessions' robots differ.
        SessionError: a session has no verdict yet.
    """
    sessions = [open_result(path, "session").require_session() for path in folders_of(folders)]
    sessions.sort(key=_created)
    _check_same("robots", [session.settings.name for session in sessions], mixed)
    _check_same("serial numbers", [_serial(session) for session in sessions], mixed)
    for session in sessions:
        finished = session.concluded
        message = f"{session.folder} has no verdict yet: {command_line('next', session.folder)}"
        require(finished, message, SessionError)

    lines = []
    last_fitted: Path | None = None
    for session in sessions:
        change = None
        if session.geometric and session.fit.numbers.exists():
            if last_fitted:
                change = diff(last_fitted, session.folder).geometry
            last_fitted = session.folder
        line = LogLine(
            folder=str(session.folder),
            date=_created(session)[:10],
            serial=_serial(session),
            verdict=session.verdicts().level,
            errors=position_errors(session),
            torque=torque_error(session),
            change=change,
        )
        lines.append(line)
    return RobotLog(sessions[-1].settings.name, tuple(lines))


def _check_same(attribute: str, names: Sequence[str], mixed: bool) -> None:
    """Raise UsageError if sessions have different names (or serial numbers) of the robot, unless `mixed`.

    Args:
        attribute: what differs, for the message, such as "serial numbers".
        names: name or serial number of each session; empty texts are ignored.
        mixed: whether different ones are accepted.
    """
    different = list(dict.fromkeys(name for name in names if name))
    message = f"the sessions have different {attribute} ({', '.join(different)}); give --mixed if they are of one robot"
    require(len(different) < 2 or mixed, message, UsageError)


def _created(session: Session) -> str:
    return session.settings.created


def _serial(session: Session) -> str:
    return session.settings.certificate.robot_serial

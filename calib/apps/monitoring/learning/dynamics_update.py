"""Result of an update of identified dynamics: the model of today, friction and gains against date, and its folder."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from calib import files, folders
from calib.apps.monitoring.learning.working_state import LOGS, STATE, LogRecord, WorkingState
from calib.config_types import Plots
from calib.errors import Finding
from calib.records import plain
from calib.result_kinds import BY_NAME
from calib.toolkit.model_identification import FRICTION, GAIN
from calib.toolkit.report_pages import (
    ChartPicture,
    Entry,
    Pictures,
    RecordColumn,
    Section,
    Text,
    as_html,
    report_page,
    table,
)
from calib.toolkit.result_folders import (
    INSTRUMENTAL,
    LEVELS,
    NOT_JUDGED,
    ChartedResult,
    IdentificationFolder,
    ReportedResult,
    TorqueCurves,
    UnseenReport,
    Verdict,
    lines_of,
    notes_of,
)
from calib.toolkit.statistics import whitened
from calib.toolkit.torque_models import INFORMATION, MODEL, Case, predict, score
from calib.units import headings

if TYPE_CHECKING:
    from calib.toolkit.report_charts import Captioned, Chart

PAGE = "report.html"
DRIFT, LOG_TABLE, TORQUES = "friction_drift.csv", "logs.csv", "torques_1.csv"
CAPTION = "Friction and gains against date; dashed: first identification. Bars: one σ."
LOG_HEADER = (
    "log",
    "date",
    "seconds",
    "error [%]",
    "error of the first model [%]",
    "times predicted",
    "cause",
    "learnt",
    "torque of one sigma [%]",
)
WRITTEN = (
    MODEL,
    folders.ESTIMATE,
    folders.COVARIANCE,
    INFORMATION,
    folders.METRICS,
    folders.REPORT,
    PAGE,
    DRIFT,
    LOG_TABLE,
    TORQUES,
    STATE,
    LOGS,
)
"""Files that an update writes anew."""
OUTDATED = (INSTRUMENTAL, *folders.PAGES, "torques_*.csv", *folders.figure_files("*"))
"""Files of the identification that do not hold for the updated model, and are not copied."""
DRAWN_SHAPES = ("sign", "velocity")
"""Shapes of drive terms that the figure shows: Coulomb and viscous friction."""
PANELS_PER_ROW = 4
PANEL_HEIGHT = 1.9
"""Height of a row of panels [in]."""
LEGEND_HEIGHT = 0.6
"""Height of the figure beside its panels [in]."""
TORQUE_RATE = 100.0
"""Rate of the table of torques [Hz]."""
FIXED = 1e12
"""Reciprocal standard deviation of parameters without variance: switched off, or fixed at a value."""


class PredictedLog(NamedTuple):
    """A log, and the torques (N, rows) predicted before it was learnt from."""

    case: Case
    torque: np.ndarray


class DriftingParameter(NamedTuple):
    """A parameter that drifts.

    Attributes:
        name, unit: its name and unit.
        first, last: values after the first and after the last log.
        sigma: standard deviation of the last one.
    """

    name: str
    unit: str
    first: float
    last: float
    sigma: float


@dataclass(frozen=True, eq=False)
class DynamicsUpdate(ChartedResult, ReportedResult):
    """An identified model updated by production logs.

    Attributes:
        state: the state after the last log.
        earlier_count: number of logs that the model had learnt from before.
        noticed: findings on the logs.
        log: the last log, with its prediction.
    """

    state: WorkingState
    earlier_count: int
    noticed: tuple[Finding, ...]
    log: PredictedLog

    kind = BY_NAME["identification"]
    tab = "state noticed plot save"

    @property
    def logs(self) -> tuple[LogRecord, ...]:
        """The logs of this update, without earlier ones."""
        return self.state.record.logs[self.earlier_count :]

    @property
    def verdict(self) -> Verdict:
        """Verdict: the worst of the findings and of the first identification; without any, not judged.

        The reason states the torques that the model predicted before it learnt from them.
        """
        learnt = [log for log in self.logs if log.learnt]
        figures = f"{len(learnt)} of {len(self.logs)} logs learnt from"
        if learnt:
            error = np.median([log.error for log in learnt])
            first_error = np.median([log.first_error for log in learnt])
            figures += (
                f", each predicted before: {error:.3g} % of the torque unexplained (median; first model: "
                f"{first_error:.3g} %)"
            )
        verdict = Verdict.of(figures, self.noticed)
        before = IdentificationFolder(self.state.folder).metrics()
        unproven = before.code == "no-unseen-motion"
        doubtful = before.verdict in ("marginal", "fail") and not unproven
        if doubtful and LEVELS.index(before.verdict) > LEVELS.index(verdict.level):
            reason = f"{figures}; {self.state.folder}: {before.reason}"
            return Verdict(before.verdict, reason, before.code, before.advice)
        if verdict.level == "pass":
            return Verdict(NOT_JUDGED, figures)
        return verdict

    def parameters(self) -> list[DriftingParameter]:
        """Return the parameters that drift, friction before gains."""
        record = self.state.record
        result = []
        for k, index in enumerate(self.state.drifting):
            logs = record.logs
            values = logs[0].parameters[k], logs[-1].parameters[k]
            result.append(DriftingParameter(record.names[index], record.units[index], *values, logs[-1].sigmas[k]))
        return result

    def section(self) -> Section:
        """Return the report section: findings, the logs, the drift of friction and gains, and its rates."""
        logs = [
            RecordColumn("log", "{0.name}", number=False),
            RecordColumn("date", "{0.date}", number=False),
            RecordColumn("s", "{0.seconds:.3g}"),
            RecordColumn("unexplained %", "{0.error:.3g}"),
            RecordColumn("by first model %", "{0.first_error:.3g}"),
            RecordColumn("times predicted", "{0.ratio:.2g}"),
            RecordColumn("errors", "{0.cause}", number=False),
            RecordColumn("learnt", _learnt, number=False),
            RecordColumn("torque of one σ %", "{0.sigma:.2g}"),
        ]
        drift = [
            RecordColumn("parameter", "{0.name}", number=False),
            RecordColumn("unit", "{0.unit}", number=False),
            RecordColumn("after the first log", "{0.first:.4g}"),
            RecordColumn("after the last log", "{0.last:.4g}"),
            RecordColumn("σ", "{0.sigma:.2g}"),
        ]
        verdict = self.verdict
        blocks = [
            Text("Notes", notes_of(self.noticed), "note"),
            table("Logs, each predicted before it was learnt from", logs, self.state.record.logs),
            table("Friction, and gains as factors on the torque", drift, self.parameters()),
            Text("Drift", self.rates()),
        ]
        return Section("Update", blocks, verdict.level, verdict.reason)

    def rates(self) -> list[str]:
        """Return sentences on the drift rates: estimate and 95 % interval."""
        unit = "√day" if self.logs[-1].date else "√log"
        lines = []
        for group, noun in ((FRICTION, "friction"), (GAIN, "gains")):
            low, middle, high = self.state.bank.rate_quantiles(group)
            lines.append(f"{noun}: {100 * middle:.2g} % per {unit} ({100 * low:.2g} to {100 * high:.2g})")
        return lines

    def charts(self) -> dict[str, Chart]:
        """Return the figure by name: Coulomb and viscous friction and gains against date, with one sigma."""
        from calib.toolkit.report_charts import AFTER, QUIET, Chart, Line, Panel

        record = self.state.record
        days = np.array([log.day for log in record.logs])
        label = "log"
        if record.logs[-1].date:
            days = days - days[0]
            label = f"days since {record.logs[0].date}"
        values = np.array([log.parameters for log in record.logs])
        sigmas = np.array([log.sigmas for log in record.logs])
        panels = []
        for k, index in enumerate(self.state.drifting):
            if not self._drawn(index):
                continue
            layers = [Line(days, values[:, k], "o-", AFTER, spread=sigmas[:, k])]
            first = 1.0
            if index < self.state.model.k:
                first = record.values[index]
            layers.append(Line(days[[0, -1]], np.full(2, first), "--", QUIET))
            title = _heading(record.names[index], record.units[index])
            panels.append(Panel(layers, title, label))
        row_count = -(-len(panels) // PANELS_PER_ROW)
        return {"drift": Chart(panels, LEGEND_HEIGHT + PANEL_HEIGHT * row_count, PANELS_PER_ROW)}

    def _drawn(self, parameter: int) -> bool:
        """Return whether the figure shows a parameter: gains, and friction of the standard model."""
        if parameter >= self.state.model.k:
            return True
        term = self.state.model.term(parameter)
        return term is not None and term.shape in DRAWN_SHAPES

    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Write the updated model into a folder, which is one of an identification, and return its path.

        Added are report.html, friction_drift.csv, logs.csv, and the state from which the next update goes on.

        Args:
            out: the folder; not the one that was updated.
            plots: False: no figure, True: in the page, ``png`` or ``svg``: as a file, too.

        Raises:
            UsageError: the folder contains files that are not of an identification.
        """
        out = Path(out)
        names = (*WRITTEN, *OUTDATED, *self._copied())
        folders.check_target(out, names, (folders.METRICS, MODEL), "identification", [self.state.folder])
        return folders.write_staged(out, names, lambda folder: self._write(folder, plots))

    def _copied(self) -> list[str]:
        """Return the names of the identification's files that hold for the updated model, too."""
        replaced = {*folders.files_of(self.state.folder, OUTDATED), *WRITTEN}
        names = {path.name for path in self.state.folder.iterdir() if path.is_file()}
        return sorted(names - replaced)

    def _write(self, folder: Path, plots: Plots) -> None:
        for name in self._copied():
            shutil.copy(self.state.folder / name, folder / name)
        self.state.write(folder)
        self._write_model(folder)
        self._write_torques(folder / TORQUES)
        drifting = self.state.drifting
        names = [self.state.record.names[index] for index in drifting]
        units = [self.state.record.units[index] for index in drifting]
        header = ["log", "date", "day"]
        for name, unit in zip(names, units):
            header += [_heading(name, unit), f"sigma {name}"]
        rows = []
        for log in self.state.record.logs:
            pairs = np.column_stack([log.parameters, log.sigmas]).ravel()
            rows.append((log.name, log.date, log.day, *pairs.tolist()))
        files.write_table(folder / DRIFT, header, rows)
        files.write_table(folder / LOG_TABLE, LOG_HEADER, [_table_row(log) for log in self.state.record.logs])
        self._write_page(folder, plots)
        files.write_json(folder / folders.REPORT, self._report())
        files.write_json(folder / folders.METRICS, self._metrics())

    def _write_model(self, folder: Path) -> None:
        """Write the updated values, with sigma, covariance and information, into the tables of the model."""
        model = self.state.model
        changes, covariance = self.state.bank.posterior()
        values, covariance = model.values + changes[: model.k], covariance[: model.k, : model.k]
        self._write_parameters(folder, changes)
        with (self.state.folder / folders.ESTIMATE).open(encoding="utf-8", newline="") as file:
            table_rows = csv.DictReader(file)
            header = list(table_rows.fieldnames or ())
            rows = list(table_rows)

        names, old_covariance = folders.read_covariance(self.state.folder)
        estimated = [names.index(name) for name in model.names[: model.k]]
        complete_covariance = np.zeros_like(old_covariance)
        complete_covariance[np.ix_(estimated, estimated)] = covariance
        folders.write_covariance(folder / folders.COVARIANCE, names, complete_covariance)

        first_values = np.array([float(row["value"]) for row in rows])
        information = FIXED * np.column_stack([np.eye(len(names)), first_values])
        information[estimated] = 0.0
        information[np.ix_(estimated, [*estimated, len(names)])] = whitened(values, covariance)
        files.write_numbers(folder / INFORMATION, (*names, "target"), information)

        sigmas = np.sqrt(np.diag(covariance))
        updated = {name: (float(value), float(sigma)) for name, value, sigma in zip(model.names, values, sigmas)}
        lines = [_updated_row(row, updated.get(row[header[0]])) for row in rows]
        files.write_table(folder / folders.ESTIMATE, header, [[line[column] for column in header] for line in lines])

    def _write_parameters(self, folder: Path, changes: np.ndarray) -> None:
        """Write the model file with changed parameters (p,)."""
        dynamics = self.state.model.updated(changes)
        table = json.loads((self.state.folder / MODEL).read_text(encoding="utf-8"))
        inertial = dynamics.model.inertial
        table["bodies"] = dict(zip(dynamics.model.names[:inertial], dynamics.values[:inertial].tolist()))
        for entry, value in zip(table["terms"], dynamics.values[inertial:]):
            entry["value"] = float(value)
        files.write_json(folder / MODEL, table)

    def _write_torques(self, path: Path) -> None:
        """Write measured and predicted torques of the last log, at about `TORQUE_RATE`."""
        case, torque = self.log
        motion = case.motion
        rows = np.arange(0, len(motion), max(1, round(motion.rate / TORQUE_RATE)))
        names = ["t [s]"]
        for quantity in ("measured", "predicted"):
            names += [f"{quantity}_{title} [{self.state.unit}]" for title in self.state.model.row_names]
        columns = [motion.t[rows], case.target[rows], torque[rows]]
        for quantity, values in (("q", motion.q), ("v", motion.v), ("a", motion.a)):
            names += headings(quantity, self.state.robot.chain.joints)
            columns.append(values[rows])
        files.write_numbers(path, names, np.column_stack(columns))

    def _write_page(self, folder: Path, plots: Plots) -> None:
        from calib.toolkit.report_charts import write_figures

        section = self.section()
        charts: dict[str, Captioned] = {}
        if plots:
            drawings = []
            for name, chart in self.charts().items():
                drawings.append(ChartPicture(chart, CAPTION, name))
                charts[name] = chart, CAPTION
            section = Section(section.title, [*section.blocks, Pictures("", drawings)], section.verdict, section.reason)
        robot = self.state.robot.chain.name
        entries = [Entry("robot", robot), Entry("updated from", str(self.state.folder))]
        page = report_page(f"Dynamics of {robot}, learnt at work", robot, entries, [section])
        files.write(folder / PAGE, as_html(page))
        write_figures(folder, charts, plots, paged=True)

    def _report(self) -> UnseenReport:
        """Return the data of certificate and figures: the last log, predicted before it was learnt from."""
        case, torque = self.log
        verdict = self.verdict
        return UnseenReport(
            verdict=verdict.level,
            reason=verdict.reason,
            code=verdict.code,
            advice=verdict.advice,
            warnings=tuple(lines_of(self.noticed)),
            noticed=self.noticed,
            rows=self.state.model.row_names,
            validation={case.name: score(case, torque)},
            units=(self.state.unit,) * len(self.state.model.row_names),
            fit={case.name: score(case, predict(self.state.model.updated(self.state.bank.posterior()[0]), case))},
            curves=(TorqueCurves.of(case, torque),),
            robot=self.state.robot.chain.name,
        )

    def _metrics(self) -> dict[str, object]:
        """Return the identification's metrics, with the verdict of the update and without errors of the old model."""
        metrics = json.loads((self.state.folder / folders.METRICS).read_text(encoding="utf-8"))
        verdict = self.verdict
        metrics |= {
            "verdict": verdict.level,
            "reason": verdict.reason,
            "code": verdict.code,
            "advice": verdict.advice,
            "warnings": lines_of(self.noticed),
            "noticed": plain(self.noticed),
            "validation": plain({self.log.case.name: score(*self.log)}),
            "tracking": {},
            "references": {},
            "update": plain(self.state.record.logs),
        }
        return metrics


def _learnt(log: LogRecord) -> str:
    return "yes" if log.learnt else "no"


def _heading(name: str, unit: str) -> str:
    """Return the heading of a column: the name with its unit, if it has one."""
    return f"{name} [{unit}]" if unit else name


def _updated_row(row: Mapping[str, str], updated: tuple[float, float] | None) -> Mapping[str, object]:
    """Return a row of ``estimate.csv`` with an updated value.

    Args:
        row: the row, by column.
        updated: value and standard deviation; None for a parameter that is not estimated.
    """
    if updated is None:
        return row
    value, sigma = updated
    rsd = 100.0 * sigma / abs(value) if value else None
    cells = {"value": value, "sigma": sigma, "rsd [%]": rsd, "sigma_torque": sigma, "sigma_geometry": None}
    if row["essential"]:
        cells["essential"] = value
    return {**row, **cells}


def _table_row(log: LogRecord) -> tuple[object, ...]:
    """Return the cells of the log's row in ``logs.csv``, in the order of `LOG_HEADER`."""
    return (log.name, log.date, log.seconds, log.error, log.first_error, log.ratio, log.cause, _learnt(log), log.sigma)

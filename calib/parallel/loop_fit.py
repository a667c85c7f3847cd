"""Geometric calibration of a parallel robot from a CSV of encoder readings, with or without platform poses.

Columns: one per actuated joint, by its name [rad or m, or the unit in brackets behind it]; and, where the platform was
measured, one per coordinate of its freedom (``x [mm]``, ``rz [deg]``), counted from home in the base's axes. Of the
options file ``fix`` counts: names of constants that stay, as ``estimate.csv`` has them.

Verdict, by rows the fit has not seen (validation files, rows held out; else rows of four folds left out in turn): fail
where a tolerance is exceeded or the calibrated robot is worse than the nominal one; marginal where there are no such
rows, where errors are three times the fit's own, where the gain is below 10 %, or where only encoders were read, which
give neither scale nor place; else pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib import files
from calib.api.rendering import ChartedResult, ReportedResult
from calib.api.result_table import data_frame
from calib.arguments import checked
from calib.config_types import Plots
from calib.data.csv_table import Table, read_table
from calib.data.poses.fit_options import FitOptions
from calib.errors import CalibError, MeasurementError, NoPosture, UsageError, finding, refuse_option, suggestion
from calib.estimation.estimate import Estimate
from calib.folders import (
    COVARIANCE,
    ESTIMATE,
    METRICS,
    PAGES,
    REPORT,
    check_target,
    figure_files,
    write_covariance,
    write_staged,
)
from calib.parallel.mechanism import parallel_robot
from calib.parallel.mechanism.closure import ClosedRobot
from calib.parallel.mechanism.geometric_fit import (
    LEFT_OUT,
    LoopCovariance,
    LoopFit,
    contradictions,
    fit_loops,
    loop_parameters,
    platform_errors,
)
from calib.parallel.mechanism.parallel_robot import COORDINATES, ParallelRobot
from calib.parallel.robots import ParallelMechanism, refuse_unread
from calib.procedure.findings import Verdict
from calib.procedure.kinematic_stage.folder import RESIDUALS
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.result_kinds import BY_NAME
from calib.robot import calibrated
from calib.robot.calibrated import ROBOT

if TYPE_CHECKING:
    from calib.api.result_table import DataFrame
    from calib.procedure.report.figures.charts import Chart
    from calib.procedure.report.page import Section

# Names of the settings that apply to parallel robots.
READ = ("holdout", "tolerance", "seed")
FIGURES = figure_files("*")
# Files of a fit's folder.
FIT = (ROBOT, METRICS, ESTIMATE, COVARIANCE, calibrated.COVARIANCE, RESIDUALS, REPORT, *PAGES, *FIGURES)
HEADER = ("name", "unit", "value", "sigma")
# Number of folds of the cross-validation that replaces missing held-out rows (our choice).
FOLDS = 4


@dataclass(frozen=True, eq=False, repr=False)
class ParallelFit(ChartedResult, ReportedResult):
    """Result of the geometric calibration of a parallel robot: estimate, calibrated robot, errors, verdict.

    Attributes:
        nominal: the robot before calibration.
        files: files that were read.
        rows: (m, n) fitted encoder readings, or (m, n + r) readings followed by the platform's measured coordinates.
        fit: the calibration.
        errors: (2, m, k) errors of the nominal and of the calibrated robot on the fitted rows: errors of the platform's
            coordinates or, without measured coordinates, contradictions between the encoders.
        unseen: errors of the same kind on held-out rows, by name of the set of rows.
        unseen_rows: held-out rows by name of the set; a cross-validation has none.
        settings: settings of the fit.
    """

    kind = BY_NAME["fit"]

    nominal: ParallelMechanism
    files: tuple[Path, ...]
    rows: np.ndarray
    fit: LoopFit
    errors: np.ndarray
    unseen: Mapping[str, np.ndarray]
    unseen_rows: Mapping[str, np.ndarray]
    settings: FitSettings

    @property
    def robot(self) -> ParallelMechanism:
        """The calibrated robot, as input of identification, excitation and planning."""
        return ParallelMechanism(self.fit.mechanism, self.nominal.source, LoopCovariance.fitted(self.fit))

    @property
    def estimate(self) -> Estimate:
        """Changes of the loops' constants [m, rad] with their covariance."""
        return self.fit.estimate

    @property
    def verdict(self) -> Verdict:
        """Pass, marginal or fail, with the reason; the module's docstring states the rules."""
        kinds = {"contradictions": (np.ones(self.errors.shape[2], dtype=bool), "mrad (or mm)")}
        figures = []
        rules = [finding("readings-alone")]
        if self.measured:
            places = self.nominal.chain.selected < 3
            kinds = {"position": (places, "mm"), "orientation": (~places, "mrad")}
            rules = []
        for (where, errors), (kind, (columns, unit)) in product(self.unseen.items(), kinds.items()):
            if not columns.any():
                continue
            nominal, calibrated = errors
            before = _rms(nominal[:, columns])
            after = _rms(calibrated[:, columns])
            figures.append(f"{kind} {1e3 * after:.3g} {unit} rms on {where} rows (nominal {1e3 * before:.3g})")
            tolerance = self.settings.tolerance
            if tolerance is not None and kind == "position":
                rules.append(finding("above-tolerance", tolerance=tolerance, times=after / tolerance))
                figures[-1] += f", tolerance {1e3 * tolerance:g} mm"
            fitted = _rms(self.errors[1][:, columns])
            share = after / max(before, 1e-300)
            times = after / max(fitted, 1e-300)
            rules.append(finding("worse-than-nominal", times=share))
            rules.append(finding("no-transfer", times=times, errors=f"on {where} rows", remedy=""))
            rules.append(finding("small-gain", left=share))
        if not figures:
            rules = [finding("no-unseen-poses")]
        return Verdict.of("; ".join(figures), rules)

    @property
    def measured(self) -> bool:
        """Whether the measurements contain platform coordinates."""
        return self.rows.shape[1] > self.nominal.chain.n

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the error components."""
        if self.measured:
            return self.nominal.chain.freedom
        return tuple(f"contradiction {k + 1}" for k in range(self.errors.shape[2]))

    @property
    def judged(self) -> Mapping[str, np.ndarray]:
        """Errors of the unseen rows by name or, without unseen rows, of the fitted rows."""
        return self.unseen or {"fitted": self.errors}

    @checked
    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Write the result folder of `calib fit`: either all files or none."""
        # slow to load, as all reports
        from calib.parallel import loop_report

        estimate = self.estimate

        def write(folder: Path) -> None:
            origin = f"calibrated from {self.nominal.source}"
            read = {"files": [str(file) for file in self.files]}
            parallel_robot.write(folder / ROBOT, self.robot.chain, origin, read)
            files.write_table(folder / ESTIMATE, HEADER, list(self._table()))
            write_covariance(folder / COVARIANCE, estimate.names, estimate.covariance)
            files.write_table(folder / RESIDUALS, *self._residuals())
            self.robot.write_covariance(folder)
            loop_report.write(self, folder, plots)
            files.write_json(folder / METRICS, self.to_dict())

        check_fit_target(Path(out), [self.nominal.source])
        return write_staged(Path(out), FIT, write)

    def charts(self) -> Mapping[str, Chart]:
        """Return what the figures show: errors before and after, changes of the constants, correlations."""
        from calib.parallel.loop_report import report_of
        from calib.procedure.report.geometry_figures import captioned

        return {name: chart for name, (chart, _) in captioned(report_of(self)).items()}

    def _table(self) -> Iterator[tuple[str, str, float, float]]:
        estimate = self.estimate
        return zip(estimate.names, estimate.units, estimate.values.tolist(), estimate.sigma.tolist())

    def _residuals(self) -> tuple[list[str], list[list[object]]]:
        """Return header and rows of ``residuals.csv``: readings, measured coordinates, and errors of both robots."""
        robot = self.nominal.chain
        scale = np.ones(self.errors.shape[2])
        rows = []
        head = ["set", *(f"{joint.name} [{joint.unit}]" for joint in robot.joints)]
        if self.measured:
            scale = np.where(robot.selected < 3, 1e3, np.degrees(1.0))
            coordinates = []
            for name, coordinate in zip(robot.freedom, robot.selected):
                unit = "mm" if coordinate < 3 else "deg"
                coordinates.append(f"{name} [{unit}]")
            head += coordinates
            errors = [f"d{heading}" for heading in coordinates]
        else:
            errors = list(self.columns)
        head += errors
        head += [f"nominal {heading}" for heading in errors]
        parts = {"fit": (self.rows, self.errors)}
        for name, unseen_rows in self.unseen_rows.items():
            parts[name] = (unseen_rows, self.unseen[name])
        for name, (table_rows, (before, after)) in parts.items():
            readings = table_rows[:, : robot.n]
            coordinates = scale * table_rows[:, robot.n :]
            table = np.hstack([readings, coordinates, scale * after, scale * before])
            rows += [[name, *row] for row in table.tolist()]
        return head, rows

    def to_dataframe(self) -> DataFrame:
        """Return the estimate as a pandas DataFrame: name, unit, value, sigma."""
        return data_frame(self._table(), HEADER)

    def to_dict(self) -> dict[str, object]:
        """Return the content of ``metrics.json``."""
        fit = self.fit
        verdict = self.verdict
        all_errors = np.concatenate(list(self.judged.values()), axis=1)
        nominal, calibrated = np.sqrt(np.mean(all_errors**2, axis=1)).tolist()
        errors = {"nominal": dict(zip(self.columns, nominal)), "calibrated": dict(zip(self.columns, calibrated))}
        return {
            "robot": self.nominal.chain.name,
            "parameters": len(fit.parameters),
            "not_told": list(fit.vague),
            "reading_rms": {"nominal": fit.before, "calibrated": fit.after},
            "platform_rms": errors if self.measured else None,
            "contradiction_rms": None if self.measured else errors,
            "judged_on": ", ".join(self.judged),
            "iterations": fit.iterations,
            "verdict": {"level": verdict.level, "reason": verdict.reason},
        }

    def section(self) -> Section:
        """Return errors on unseen rows and the verdict as a section of a report."""
        from calib.procedure.report.page import Section, Text

        fit = self.fit
        verdict = self.verdict
        count = len(fit.parameters)
        identified = count - len(fit.vague)
        lines = [
            f"{self.nominal.chain.name}: {identified} of {count} constants of the loops identified; "
            f"encoder residuals {fit.before:.3g} nominal, {fit.after:.3g} calibrated (rms, rad or m)"
        ]
        for where, errors in self.judged.items():
            rms = 1e3 * np.sqrt(np.mean(errors**2, axis=1))
            for name, (before, after) in zip(self.columns, rms.T):
                unit = "mrad (or mm)"
                if name in COORDINATES[:3]:
                    unit = "mm"
                elif name in COORDINATES:
                    unit = "mrad"
                lines.append(f"  {name} on {where} rows: {before:.3g} -> {after:.3g} {unit} rms")
        return Section("", (Text("", lines),), verdict.level, verdict.reason)

    def __repr__(self) -> str:
        return f"<ParallelFit of {self.nominal.chain.name}: {self.verdict.level}>"

    def with_unseen(self, unseen: Sequence[str | Path]) -> ParallelFit:
        """Return this fit, not fitted again, with a verdict that also counts further files of held-out rows."""
        validate = _paths(unseen)
        proofs = {name: self.unseen[name] for name in self.unseen_rows}
        unseen_rows = dict(self.unseen_rows)
        for path, rows in zip(validate, _read(self.nominal.chain, validate, self.rows.shape[1])):
            name = f"{path.name}, unseen"
            proofs[name] = _errors(self.nominal.mechanism, self.fit.mechanism, rows)
            unseen_rows[name] = rows
        return replace(self, unseen=proofs, unseen_rows=unseen_rows, files=(*self.files, *validate))


def check_fit_target(out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
    """Raise UsageError if an output folder has other content or contains an input file."""
    check_target(out, FIT, (METRICS, ROBOT), "fit", inputs)


def fit_parallel(
    robot: ParallelMechanism,
    measured: Sequence[str | Path],
    validate: Sequence[str | Path] = (),
    *,
    settings: FitSettings | None = None,
    options: FitOptions | None = None,
    progress: Callable[[str], None] | None = None,
) -> ParallelFit:
    """Return the geometric calibration of a parallel robot from measured files, with a verdict on unseen rows.

    Args:
        robot: the nominal robot.
        measured: CSV files to fit.
        validate: CSV files to judge by.
        settings: holdout, tolerance and seed; other settings apply to serial arms only.
        options: only ``fix`` is used.
        progress: function called with a line of text; None: none.

    Raises:
        UsageError: for options that apply to serial arms only.
        MeasurementError: for missing columns, or rows that no posture reaches.
        Unidentifiable: if only readings are given for a robot without redundant encoders.
    """
    settings = settings or FitSettings()
    mechanism = robot.mechanism
    measured = _paths(measured)
    validate = _paths(validate)
    fixed = _held(mechanism, settings, options or FitOptions())
    tables = _read(mechanism.robot, (*measured, *validate))
    rows = np.concatenate(tables[: len(measured)])
    unseen_rows = {}
    for path, table in zip(validate, tables[len(measured) :]):
        if len(table):
            unseen_rows[f"{path.name}, unseen"] = table
    has_position = rows.shape[1] > mechanism.robot.n and (mechanism.robot.selected < 3).any()
    if settings.tolerance is not None and not has_position:
        raise UsageError("a tolerance needs a measured platform position; none was measured")
    if settings.holdout:
        order = np.random.default_rng(settings.seed).permutation(len(rows))
        count = len(rows) - round(settings.holdout * len(rows))
        held_out = rows[order[count:]]
        rows = rows[order[:count]]
        if len(held_out):
            unseen_rows["held out, unseen"] = held_out
    if progress is not None:
        progress("fitting")
    try:
        fit = fit_loops(mechanism, *_parts(mechanism, rows), fixed=fixed)
        if progress is not None:
            progress("judging")
        proofs = {}
        for name, table in unseen_rows.items():
            proofs[name] = _errors(mechanism, fit.mechanism, table)
        fit_errors = _errors(mechanism, fit.mechanism, rows)
    except NoPosture as error:
        raise MeasurementError(f"{error}", measured[0]) from error
    if not proofs:
        proofs = _cross_validated(mechanism, rows, fixed, settings.seed)
    return ParallelFit(robot, (*measured, *validate), rows, fit, fit_errors, proofs, unseen_rows, settings)


def _paths(measured: Sequence[object]) -> tuple[Path, ...]:
    """Return the paths of measured files; raise UsageError for measurements in memory."""
    if all(isinstance(item, (str, Path)) for item in measured):
        return tuple(Path(str(item)) for item in measured)
    raise UsageError("a parallel robot's measurements are CSV files (calib formats parallel), not values in memory")


def read_rows(path: Path, robot: ParallelRobot) -> np.ndarray:
    """Return readings (m, n), or (m, n + r) with platform coordinates appended if the file has such columns.

    Raises:
        MeasurementError: for a missing or unknown column.
    """
    table = read_table(path)
    passive: list[str] = []
    for leg in robot.legs:
        passive += [name for name in leg.chain.joint_names if name not in robot.joint_names]
    readings = []
    for joint in robot.joints:
        quantity = "length"
        if joint.kind == "revolute":
            quantity = "angle"
        readings.append(table.numbers(joint.name, quantity))
    for name in table.header:
        if name in passive:
            table.fail("belongs to a passive joint, whose encoder cannot be used; remove the column", name)
        if name in COORDINATES and name not in robot.freedom:
            table.fail(f"is not a platform coordinate ({', '.join(robot.freedom)}); remove the column", name)
    if any(name in table for name in robot.freedom):
        readings.extend(read_coordinates(table, robot).T)
    return np.column_stack(readings)


def read_coordinates(table: Table, robot: ParallelRobot) -> np.ndarray:
    """Return the platform coordinates (m, r) [m, rad] from the columns of a table.

    Raises:
        MeasurementError: for a missing column.
    """
    columns = []
    for name in robot.freedom:
        quantity = "angle"
        if name in COORDINATES[:3]:
            quantity = "length"
        columns.append(table.numbers(name, quantity))
    return np.column_stack(columns)


def _held(mechanism: ClosedRobot, settings: FitSettings, options: FitOptions) -> tuple[str, ...]:
    """Return the names of fixed constants; raise UsageError for options that apply to serial arms only."""
    refuse_unread(settings, FitSettings(), READ)
    refuse_unread(options, FitOptions(), ("source", "fix"), options.source)
    names = [parameter.name for parameter in loop_parameters(mechanism)]
    for name in options.fix:
        if name not in names:
            refuse_option(options.source, f"fix '{name}' is not a constant of the loops{suggestion(name, names)}")
    return options.fix


def _read(robot: ParallelRobot, paths: Sequence[Path], width: int = 0) -> list[np.ndarray]:
    """Return the rows of each file; raise an error unless all files have the same number of columns.

    `width`: the number of columns; 0: that of the first file.
    """
    tables = [read_rows(path, robot) for path in paths]
    for path, rows in zip(paths, tables):
        if rows.shape[1] != (width or tables[0].shape[1]):
            refuse_option(path, "platform coordinates must be in all fitted and unseen files, or in none")
    return tables


def _parts(mechanism: ClosedRobot, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the readings (m, n) of rows, and the platform's coordinates (m, r) or None."""
    n = mechanism.robot.n
    if rows.shape[1] == n:
        return rows, None
    return rows[:, :n], rows[:, n:]


def _errors(nominal: ClosedRobot, calibrated: ClosedRobot, rows: np.ndarray) -> np.ndarray:
    """Return the errors (2, m, k) of the nominal and of the calibrated robot on rows.

    The k components are errors of the platform's coordinates or, without measured coordinates, `contradictions`.
    """
    readings, coordinates = _parts(nominal, rows)
    if coordinates is None:
        return np.array([contradictions(nominal, readings), contradictions(calibrated, readings)])
    before = platform_errors(nominal, readings, coordinates)
    after = platform_errors(calibrated, readings, coordinates)
    return np.array([before, after])


def _cross_validated(
    mechanism: ClosedRobot, rows: np.ndarray, fixed: Sequence[str], seed: int
) -> dict[str, np.ndarray]:
    """Return the cross-validated errors of all rows; empty if a fold cannot be fitted."""
    order = np.random.default_rng(seed).permutation(len(rows))
    folds = np.array_split(order, FOLDS)
    errors = []
    for k, fold in enumerate(folds):
        other_folds = folds[:k] + folds[k + 1 :]
        training = rows[np.concatenate(other_folds)]
        try:
            fitted = fit_loops(mechanism, *_parts(mechanism, training), fixed=fixed)
            errors.append(_errors(mechanism, fitted.mechanism, rows[fold]))
        except CalibError:
            return {}
    return {LEFT_OUT: np.concatenate(errors, axis=1)}


def _rms(errors: np.ndarray) -> float:
    """Return the root mean square of the row lengths of errors (m, k)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))

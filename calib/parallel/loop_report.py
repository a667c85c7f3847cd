"""Report of a parallel robot's fit in the form of a serial arm's report, for the common certificate and figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import numpy as np

from calib.config_types import Plots
from calib.estimation.estimate import Estimate
from calib.folders import REPORT
from calib.geometry.accuracy import Errors
from calib.parallel.mechanism.geometric_fit import LEFT_OUT, LoopFit, LoopParameter
from calib.parallel.mechanism.parallel_robot import ParallelRobot
from calib.parallel.robots import ParallelMechanism
from calib.procedure.findings import Verdict
from calib.procedure.kinematic_stage.metrics import ComparedRows, FitMetrics
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.report import fit_report
from calib.procedure.report.fit_report import CorrelatedPair, FittedParameter, Report, RowErrors


class ReportedFit(Protocol):
    """The part of `calib.parallel.loop_fit.ParallelFit` that a report reads."""

    @property
    def nominal(self) -> ParallelMechanism: ...
    @property
    def files(self) -> tuple[Path, ...]: ...
    @property
    def fit(self) -> LoopFit: ...
    @property
    def errors(self) -> np.ndarray: ...
    @property
    def unseen(self) -> Mapping[str, np.ndarray]: ...
    @property
    def settings(self) -> FitSettings: ...
    @property
    def estimate(self) -> Estimate: ...
    @property
    def verdict(self) -> Verdict: ...
    @property
    def measured(self) -> bool: ...


# Name of the geometry's model in a report: parallel robots have this model only.
MODEL = "loops"
# Correlation of two parameters from which on a report states it (our choice).
CORRELATED = 0.9


def report_of(fit: ReportedFit) -> Report:
    """Return the report of a fit: errors by set of rows, verdict, constants of the loops with their sigmas.

    The report of a fit of encoder readings alone states no errors: contradictions between encoders are neither errors
    of position nor of orientation.
    """
    robot = fit.nominal.chain
    estimate = fit.estimate
    changes = estimate.values.tolist()
    sigmas = estimate.sigma.tolist()
    parameters = []
    for parameter, change, sigma in zip(fit.fit.parameters, changes, sigmas):
        nominal = _nominal_value(robot, parameter)
        value = nominal + change
        relative = _relative(sigma, value)
        parameters.append(FittedParameter(parameter.name, parameter.unit, nominal, value, sigma, relative, "arm"))
    sets = [_row_errors(fit, "fit", fit.errors)]
    for name, errors in _unseen(fit).items():
        sets.append(_row_errors(fit, name, errors))
    prismatic = [joint.kind == "prismatic" for joint in robot.joints]
    strong = estimate.strong_correlations(CORRELATED)
    correlations = [CorrelatedPair(*pair) for pair in strong]
    correlated = fit_report.most_correlated(estimate.names, estimate.covariance)
    return Report(
        schema=fit_report.SCHEMA,
        robot=robot.name,
        base="base",
        tip="platform",
        joints=robot.joint_names,
        prismatic=tuple(prismatic),
        metrics=_metrics(fit),
        parameters=tuple(parameters),
        kept=(),
        correlations=tuple(correlations),
        correlated=correlated,
        singular_values=(),
        rank=0,
        sets=tuple(sets),
        noise={"position": None, "orientation": None},
        files=_files(fit),
        source=str(fit.nominal.source),
    )


def write(fit: ReportedFit, folder: Path, plots: Plots) -> None:
    """Write ``report.json``, figures (if `plots`) and the certificate into a fit's folder."""
    from calib.procedure.report import geometry_figures
    from calib.procedure.report.certificate import results
    from calib.procedure.report.figures import figure_files
    from calib.procedure.report.page import chart_pictures

    report = report_of(fit)
    fit_report.write(report, folder / REPORT)
    charts = geometry_figures.captioned(report) if plots else {}
    figure_files.write(folder, charts, plots, paged=True)
    results.write_fit(report, chart_pictures(charts), folder)


def _metrics(fit: ReportedFit) -> FitMetrics:
    """Return the metrics of a fit in the form of a serial arm's."""
    verdict = fit.verdict
    tolerance_mm = None
    if fit.settings.tolerance is not None:
        tolerance_mm = 1e3 * fit.settings.tolerance
    not_identifiable: tuple[str, ...] = ()
    if fit.fit.vague:
        names = ", ".join(fit.fit.vague)
        not_identifiable = (f"hardly identified by these poses: {names}",)
    validation = {}
    for name, errors in _unseen(fit).items():
        validation[name] = _compared(fit, errors)
    count = len(fit.fit.parameters)
    fitted_rows = _compared(fit, fit.errors, unseen=False, parameters=count)
    return FitMetrics(
        validation=validation,
        verdict=verdict.level,
        reason=verdict.reason,
        warnings=(),
        code=verdict.code,
        advice=verdict.advice,
        fit=fitted_rows,
        model=MODEL,
        ladder=(),
        seed=fit.settings.seed,
        tolerance_mm=tolerance_mm,
        not_identifiable=not_identifiable,
        outliers=(),
    )


def _unseen(fit: ReportedFit) -> dict[str, np.ndarray]:
    """Return the errors of both robots on rows that were not fitted, by the names of sets of rows in reports."""
    renamed = {LEFT_OUT: fit_report.CROSS_VALIDATED}
    return {renamed.get(name, name): errors for name, errors in fit.unseen.items()}


def _compared(fit: ReportedFit, errors: np.ndarray, unseen: bool = True, parameters: int = 0) -> ComparedRows:
    """Return the statistics of the errors of both robots on a set of rows.

    Args:
        fit: the fit.
        errors: (2, m, k) errors of the nominal and of the calibrated robot on m rows.
        unseen: whether the rows were not fitted.
        parameters: number of parameters fitted to the rows.
    """
    nominal, calibrated = errors
    before = _errors(fit, nominal).summary()
    after = _errors(fit, calibrated).summary()
    count = errors.shape[1]
    return ComparedRows(count, "the file's own", before, after, unseen=unseen, parameters=parameters)


def _errors(fit: ReportedFit, joint_errors: np.ndarray) -> Errors:
    """Return the magnitudes of errors (m, k) of position and orientation; None for a kind that was not measured."""
    if not fit.measured:
        return Errors(None, None, None)
    places = fit.nominal.chain.selected < 3
    position = None
    if places.any():
        position = np.linalg.norm(joint_errors[:, places], axis=1)
    orientation = None
    if (~places).any():
        orientation = np.linalg.norm(joint_errors[:, ~places], axis=1)
    return Errors(position, orientation, None)


def _row_errors(fit: ReportedFit, name: str, errors: np.ndarray) -> RowErrors:
    """Return the magnitudes of both robots' errors (2, m, k) on the set of rows `name`."""
    nominal, calibrated = errors
    before = _sizes(fit, nominal)
    after = _sizes(fit, calibrated)
    return RowErrors(name, name != "fit", errors.shape[1], before, after)


def _sizes(fit: ReportedFit, errors: np.ndarray) -> dict[str, tuple[float, ...]]:
    """Return the magnitudes of one robot's errors (m, k) by measured kind (position, orientation)."""
    sizes = _errors(fit, errors)
    by_kind = {}
    if sizes.position is not None:
        by_kind["position"] = tuple(sizes.position.tolist())
    if sizes.orientation is not None:
        by_kind["orientation"] = tuple(sizes.orientation.tolist())
    return by_kind


def _nominal_value(robot: ParallelRobot, parameter: LoopParameter) -> float:
    """Return a constant's nominal value; 0 for a displacement of a leg's base or attachment."""
    if parameter.part == "element":
        chain = robot.legs[parameter.leg].chain
        return float(chain.elements[parameter.index].value)
    return 0.0


def _relative(sigma: float, value: float) -> float | None:
    """Return σ as a share of a value [%]; None for the value 0."""
    if not value:
        return None
    return 100.0 * sigma / abs(value)


def _files(fit: ReportedFit) -> tuple[fit_report.FileRow, ...]:
    """Return the files that were read, as rows of the report; files that no longer exist are omitted."""
    roles = {fit.nominal.source: "nominal robot"}
    roles |= dict.fromkeys(fit.files, "measured")
    rows = []
    for path, role in roles.items():
        if path.is_file():
            rows.append(fit_report.file_row(path.name, role, path))
    return tuple(rows)

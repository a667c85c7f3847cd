"""The report of a parallel robot's fit in the form of a serial arm's, so that certificate and figures are the same."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import numpy as np

from calib.estimation.estimate import Estimate
from calib.folders import REPORT
from calib.geometry.accuracy import Errors
from calib.procedure.findings import Verdict
from calib.procedure.kinematic_stage.metrics import ComparedRows, FitMetrics
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.report import fit_report
from calib.procedure.report.fit_report import CorrelatedPair, FittedParameter, Report, RowErrors
from calib.rooms.parallel.mechanism.geometric_fit import LEFT_OUT, LoopFit, LoopParameter
from calib.rooms.parallel.mechanism.parallel_robot import ParallelRobot
from calib.rooms.parallel.robots import ParallelMechanism


class ReportedFit(Protocol):
    """What a report says of `calib.rooms.parallel.loop_fit.ParallelFit`."""

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


# the one model of a parallel robot's geometry
MODEL = "loops"


def report_of(fit: ReportedFit) -> Report:
    """Return the report of a fit: errors by set of rows, verdict, constants of the loops with their sigmas.

    Encoders that contradict each other measure neither position nor orientation: of readings alone it states no errors.
    """
    robot = fit.nominal.chain
    fit_ = fit.fit
    estimate = fit.estimate
    sets = {"fit": fit.errors} | _unseen(fit)
    parameters = []
    for parameter, change, sigma in zip(fit_.parameters, estimate.values.tolist(), estimate.sigma.tolist()):
        nominal = _nominal_value(robot, parameter)
        value = nominal + change
        parameters.append(
            FittedParameter(parameter.name, parameter.unit, nominal, value, sigma, _relative(sigma, value), "arm")
        )
    return Report(
        schema=fit_report.SCHEMA,
        robot=robot.name,
        base="base",
        tip="platform",
        joints=robot.joint_names,
        prismatic=tuple(joint.kind == "prismatic" for joint in robot.joints),
        metrics=_metrics(fit),
        parameters=tuple(parameters),
        kept=(),
        correlations=tuple(CorrelatedPair(*pair) for pair in estimate.strong_correlations(0.9)),
        correlated=fit_report.most_correlated(estimate.names, estimate.covariance),
        singular_values=(),
        rank=0,
        sets=tuple(_row_errors(fit, name, errors) for name, errors in sets.items()),
        noise={"position": None, "orientation": None},
        files=_files(fit),
        source=str(fit.nominal.source),
    )


def write(fit: ReportedFit, folder: Path, plots: bool) -> None:
    """Write ``report.json``, figures (if `plots`) and the pages that rooms make of them into a fit's folder."""
    from calib.procedure.report.charts import saved
    from calib.procedure.report.geometry_figures import captioned

    report = report_of(fit)
    fit_report.write(report, folder / REPORT)
    from calib.procedure.report.certificate import results

    drawn = {}
    if plots:
        drawn = saved(captioned(report), folder)
    results.write_fit(report, drawn, folder)


def _metrics(fit: ReportedFit) -> FitMetrics:
    verdict = fit.verdict
    tolerance = fit.settings.tolerance
    vague = fit.fit.vague
    return FitMetrics(
        validation={name: _compared(fit, errors) for name, errors in _unseen(fit).items()},
        verdict=verdict.level,
        reason=verdict.reason,
        warnings=(),
        code=verdict.code,
        advice=verdict.advice,
        fit=_compared(fit, fit.errors, unseen=False, parameters=len(fit.fit.parameters)),
        model=MODEL,
        ladder=(),
        seed=fit.settings.seed,
        tolerance_mm=None if tolerance is None else 1e3 * tolerance,
        not_identifiable=(f"hardly identified by these poses: {', '.join(vague)}",) if vague else (),
        outliers=(),
    )


def _unseen(fit: ReportedFit) -> dict[str, np.ndarray]:
    """Return the errors of both robots on rows that were not fitted, by the names that reports have for them."""
    return {fit_report.CROSS_VALIDATED if name == LEFT_OUT else name: errors for name, errors in fit.unseen.items()}


def _compared(fit: ReportedFit, errors: np.ndarray, unseen: bool = True, parameters: int = 0) -> ComparedRows:
    """Return the statistics of the errors (2, m, k) of both robots on some rows."""
    nominal, calibrated = (_errors(fit, joint_errors).summary() for joint_errors in errors)
    return ComparedRows(errors.shape[1], "the file's own", nominal, calibrated, unseen=unseen, parameters=parameters)


def _errors(fit: ReportedFit, joint_errors: np.ndarray) -> Errors:
    """Return the sizes of errors (m, k) by kind; none where no coordinate of the platform was measured."""
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
    nominal, calibrated = (
        {
            nature: tuple(size.tolist())
            for nature in ("position", "orientation")
            if (size := getattr(summary, nature)) is not None
        }
        for summary in (_errors(fit, joint_errors) for joint_errors in errors)
    )
    return RowErrors(name, name != "fit", errors.shape[1], nominal, calibrated)


def _nominal_value(robot: ParallelRobot, parameter: LoopParameter) -> float:
    """Return a constant's nominal value; 0 for a displacement of a leg's base or attachment."""
    if parameter.part == "element":
        return float(robot.legs[parameter.leg].chain.elements[parameter.index].value)
    return 0.0


def _relative(sigma: float, value: float) -> float | None:
    return 100.0 * sigma / abs(value) if value else None


def _files(fit: ReportedFit) -> tuple[fit_report.FileRow, ...]:
    roles = {fit.nominal.source: "nominal robot"} | dict.fromkeys(fit.files, "measured")
    return tuple(fit_report.file_row(path.name, role, path) for path, role in roles.items() if path.is_file())

"""The certificate's page on the geometry: errors on held-out poses, worst pose, ISO 9283 figures, and uncertainty."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from calib.config_types import Plots
from calib.procedure.findings import sentence
from calib.procedure.kinematic_stage.metrics import ComparedRows, FitMetrics
from calib.procedure.kinematic_stage.verdict.validation import ARM
from calib.procedure.report.certificate.record import StageRecord
from calib.procedure.report.fit_report import Report, RowErrors
from calib.procedure.report.geometry_section import (
    deciding,
    error_table,
    iso9283_tables,
    iso9283_words,
    meanings,
    report_section,
)
from calib.procedure.report.page import Block, ChartPicture, Picture, Pictures, Text
from calib.units import ERRORS, JOINT

# findings that belong to the uncertainty
UNCERTAINTY = ("interval-coverage", "outside-fitted-range", "sigma-ratio")
# of ISO 9283, which asks for five
MAX_POSES = 5
NO_ISO = (
    "pose accuracy AP and repeatability RP after ISO 9283: no pose was measured three times or more (the norm requires "
    "5 poses of 30 cycles)"
)


def stage(report: Report, drawn: Mapping[str, ChartPicture]) -> StageRecord:
    """Return the content of report and certificate on a fit.

    Args:
        report: stored results of the fit.
        drawn: figures of the report by name; empty: the certificate has no figures either.
    """
    blocks = list(_blocks(report, bool(drawn)))
    # what stands under uncertainty is not repeated among the findings
    uncertainty = tuple(_uncertainty_findings(report.metrics))
    findings = [line for line in report.metrics.warnings if not line.startswith(uncertainty)]
    return StageRecord(report_section(report, drawn), blocks, list(_unchecked(report)), findings)


def _blocks(report: Report, plots: Plots) -> Iterator[Block]:
    metrics = report.metrics
    proof, row_errors = deciding(report)
    label = f"{proof.poses} fitted poses: none were held out"
    if metrics.proofs:
        label = f"{proof.poses} held-out poses"
        if row_errors is not None:
            label += f" ({row_errors.name})"
    table = error_table([(label, proof)], metrics.deliverable)
    yield replace(table, note=" ".join(meanings(proof)))
    if row_errors is not None and row_errors.nominal:
        figures = list(_figures(report, row_errors, label)) if plots else []
        yield Pictures("Before and after", figures)
        yield Text("Worst pose", list(_worst(report, row_errors)))
    yield from _iso9283(metrics)
    yield Text("Uncertainty", list(_uncertainty(report, proof)))


def _unchecked(report: Report) -> Iterator[str]:
    """Yield texts on the properties that the measurements of a fit cannot prove.

    Args:
        report: stored results of the fit.
    """
    metrics = report.metrics
    if not metrics.proofs:
        yield "errors on held-out poses: none were measured"
    if not metrics.tolerance_mm:
        yield "a tolerance of the position: none was asked for; pass means better than the nominal robot"
    if not any(rows.iso9283 for rows in (metrics.fit, *metrics.validation.values())):
        yield NO_ISO


def _uncertainty_findings(metrics: FitMetrics) -> list[str]:
    return [sentence(finding) for finding in metrics.noticed if finding.code in UNCERTAINTY]


def _figures(report: Report, row_errors: RowErrors, label: str) -> Iterator[Picture]:
    """Yield histograms of nominal and calibrated errors, and a map of calibrated errors that marks the worst pose.

    Args:
        report: stored results of the fit.
        row_errors: errors on the rows to show.
        label: text that names these rows in captions.
    """
    from calib.procedure.report.figures.charts import Label
    from calib.procedure.report.figures.style import MARK
    from calib.procedure.report.geometry_figures import error_histogram, error_map

    deliverable = report.metrics.deliverable
    remaining = row_errors.judged(deliverable)
    for nature, errors in remaining.items():
        before, after = np.array(row_errors.nominal[nature]), np.array(errors)
        arm = row_errors.judged_arm(deliverable)
        chart = error_histogram(before, after, nature, report.noise.get(nature), arm)
        name = report.metrics.fit.words(nature).capitalize()
        caption = f"{name} errors, {label}; lines: rms, and the instrument's own error where it is stated."
        yield ChartPicture(replace(chart, height=2.0), caption).vector()
    if not row_errors.points or not row_errors.rows:
        return
    nature, errors = next(iter(remaining.items()))
    points, sizes = np.array(row_errors.points), np.array(errors)
    worst = points[np.argmax(sizes)]
    if row_errors.worst is not None:
        worst = row_errors.worst.points[0]
    # the map has two views, of x and y and of x and z
    chart = error_map(points, sizes)
    panels = []
    for vertical, panel in zip((1, 2), chart.panels):
        mark = Label("worst", worst[0], worst[vertical], colour=MARK)
        panels.append(replace(panel, layers=[*panel.layers, mark]))
    name = report.metrics.fit.words(nature).capitalize()
    drawn = replace(chart, panels=panels, height=2.4)
    yield ChartPicture(drawn, f"{name} errors that remain, {label}.").vector()


def _worst(report: Report, row_errors: RowErrors) -> Iterator[str]:
    """Yield sentences on the pose with the largest error: its errors, joint values, and target position.

    Args:
        report: stored results of the fit.
        row_errors: errors on the rows to show.
    """
    rows = row_errors.worst or row_errors
    deliverable = report.metrics.deliverable
    nature = next(iter(rows.nominal))
    factor, unit = ERRORS[nature]
    before = factor * np.array(rows.nominal[nature])
    after = factor * np.array(rows.judged(deliverable)[nature])
    worst = int(np.argmax(after))
    arm = f" ({ARM[deliverable]})" if rows.urdf_alone else ""
    errors = f"{after[worst]:.3g} {unit}{arm}, {before[worst]:.3g} {unit} with the nominal robot"
    if not rows.rows or len(rows.rows) != len(after):
        yield errors
        return
    joints = []
    for value, is_prismatic in zip(rows.q[worst], report.prismatic):
        scale, joint_unit = JOINT["prismatic" if is_prismatic else "revolute"]
        joints.append(f"{scale * value:.1f} {joint_unit}")
    position = ", ".join(f"{1e3 * coordinate:.0f}" for coordinate in rows.points[worst])
    yield f"row {rows.rows[worst]} of {rows.name}: {errors}"
    yield f"joints at {', '.join(joints)}; target at {position} mm (x, y, z) in the robot's base"


def _iso9283(metrics: FitMetrics) -> list[Block]:
    sets = {"fitted poses": metrics.fit, **metrics.validation}
    lines = [f"{name}: {iso9283_words(rows)}" for name, rows in sets.items() if rows.iso9283]
    if not lines:
        _, _, reason = NO_ISO.partition(": ")
        lines = [f"not measured: {reason}"]
    # at most one table fits on the page
    tables = [replace(table, title="") for table in iso9283_tables(metrics, MAX_POSES)[:1]]
    return [Text("Pose accuracy AP and repeatability RP (ISO 9283)", lines), *tables]


def _uncertainty(report: Report, proof: ComparedRows) -> Iterator[str]:
    noise = report.noise.get("position")
    if noise:
        yield f"instrument: its stated σ alone gives {1e3 * noise:.3g} mm rms (all three axes together)"
    else:
        yield "instrument: no σ was stated; it was estimated from the residuals"
    yield f"standard errors: of the rms over sets of {proof.poses} such poses, coverage factor 1; for 95 %, twice that"
    yield from _uncertainty_findings(report.metrics)

"""The certificate's page on the geometry: errors on held-out poses, worst pose, ISO 9283, uncertainty."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from calib.procedure.findings import sentence
from calib.procedure.kinematic_stage.metrics import ComparedRows, FitMetrics
from calib.procedure.kinematic_stage.validation import ARM
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
from calib.procedure.report.page import Block, Picture, Pictures, Text
from calib.units import ERRORS, JOINT

UNCERTAINTY = ("interval-coverage", "outside-fitted-range", "sigma-ratio")  # findings that belong to it
MAX_POSES = 5  # of ISO 9283, which asks for five
NO_ISO = (
    "pose accuracy AP and repeatability RP after ISO 9283: no pose was measured three times or more (the norm requires "
    "5 poses of 30 cycles)"
)


def stage(report: Report, drawn: Mapping[str, Picture]) -> StageRecord:
    """Return the stage of a fit.

    Args:
        drawn: figures of the report by name; without any the certificate has none either.
    """
    blocks = [*_blocks(report, bool(drawn))]
    return StageRecord(report_section(report, drawn), blocks, [*_unchecked(report)], _findings(report.metrics))


def _blocks(report: Report, plots: bool) -> Iterator[Block]:
    proof, own = deciding(report)
    where = "held-out poses" if report.metrics.proofs else "fitted poses: none were held out"
    label = f"{proof.poses} {where}" + (f" ({own.name})" if own is not None and report.metrics.proofs else "")
    yield replace(error_table([(label, proof)], report.metrics.deliverable), note=" ".join(meanings(proof)))
    if own is not None and own.nominal:
        yield Pictures("Before and after", list(_figures(report, own, label)) if plots else [])
        yield Text("Worst pose", list(_worst(report, own)))
    yield from _iso9283(report.metrics)
    yield Text("Uncertainty", list(_uncertainty(report, proof)))


def _unchecked(report: Report) -> Iterator[str]:
    """Yield what the measurements of a fit do not show."""
    metrics = report.metrics
    if not metrics.proofs:
        yield "errors on held-out poses: none were measured"
    if not metrics.tolerance_mm:
        yield "a tolerance of the position: none was asked for; pass means better than the nominal robot"
    if not any(rows.iso9283 for rows in (metrics.fit, *metrics.validation.values())):
        yield NO_ISO


def _findings(metrics: FitMetrics) -> list[str]:
    """Return what was noticed, worst first, without what stands under uncertainty."""
    said = tuple(_noticed(metrics))
    return [line for line in metrics.warnings if not line.startswith(said)]


def _noticed(metrics: FitMetrics) -> list[str]:
    return [sentence(one) for one in metrics.noticed if one.code in UNCERTAINTY]


def _figures(report: Report, own: RowErrors, label: str) -> Iterator[Picture]:
    """Yield the histograms of errors before and after, and the map of what remains with the worst pose marked."""
    from calib.procedure.report.charts import text, vector
    from calib.procedure.report.geometry_figures import error_histogram, error_map
    from calib.procedure.report.style import MARK

    left = own.judged(report.metrics.deliverable)
    for nature in left:
        before, after = np.array(own.nominal[nature]), np.array(left[nature])
        arm = own.judged_arm(report.metrics.deliverable)
        chart = error_histogram(before, after, nature, report.noise.get(nature), arm)
        named = report.metrics.fit.words(nature).capitalize()
        words = f"{named} errors, {label}; lines: rms, and the instrument's own error where it is stated."
        yield vector(replace(chart, height=2.0), words)
    if own.points and own.rows:
        nature = next(iter(left))
        points, sizes = np.array(own.points), np.array(left[nature])
        worst = points[np.argmax(sizes)] if own.worst is None else own.worst.points[0]
        chart = error_map(points, sizes)
        panels = [
            replace(panel, layers=[*panel.layers, text("worst", worst[0], worst[j], colour=MARK)])
            for j, panel in zip((1, 2), chart.panels)
        ]
        named = report.metrics.fit.words(nature).capitalize()
        yield vector(replace(chart, panels=panels, height=2.4), f"{named} errors that remain, {label}.")


def _worst(report: Report, own: RowErrors) -> Iterator[str]:
    """Yield a sentence on the pose with the largest error: its errors, joints, and place."""
    own, deliverable, nature = own.worst or own, report.metrics.deliverable, next(iter(own.nominal))
    factor, unit = ERRORS[nature]
    before, after = (factor * np.array(one[nature]) for one in (own.nominal, own.judged(deliverable)))
    worst = int(np.argmax(after))
    arm = f" ({ARM[deliverable]})" if own.urdf_alone else ""
    words = f"{after[worst]:.3g} {unit}{arm}, {before[worst]:.3g} {unit} with the nominal robot"
    if not own.rows or len(own.rows) != len(after):
        yield words
        return
    kinds = ("prismatic" if slides else "revolute" for slides in report.prismatic)
    turned = ((value, *JOINT[kind]) for value, kind in zip(own.q[worst], kinds))
    joints = ", ".join(f"{scale * value:.1f} {to}" for value, scale, to in turned)
    place = ", ".join(f"{1e3 * x:.0f}" for x in own.points[worst])
    yield f"row {own.rows[worst]} of {own.name}: {words}"
    yield f"joints at {joints}; target at {place} mm (x, y, z) in the robot's base"


def _iso9283(metrics: FitMetrics) -> list[Block]:
    sets = {"fitted poses": metrics.fit, **metrics.validation}
    said = [f"{name}: {iso9283_words(found)}" for name, found in sets.items() if found.iso9283]
    tables = [replace(one, title="") for one in iso9283_tables(metrics, MAX_POSES)[:1]]
    title = "Pose accuracy AP and repeatability RP (ISO 9283)"
    return [Text(title, said or [f"not measured: {NO_ISO.partition(': ')[2]}"]), *tables]


def _uncertainty(report: Report, proof: ComparedRows) -> Iterator[str]:
    stated = report.noise.get("position")
    if stated:
        yield f"instrument: its stated σ alone gives {1e3 * stated:.3g} mm rms (all three axes together)"
    else:
        yield "instrument: no σ was stated; it was estimated from the residuals"
    yield f"standard errors: of the rms over sets of {proof.poses} such poses, coverage factor 1; for 95 %, twice that"
    yield from _noticed(report.metrics)

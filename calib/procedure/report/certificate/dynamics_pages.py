"""The certificate's page on the dynamics: torque errors in N·m and as shares of the limits, and uncertainty."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.config_types import Plots
from calib.folders import METRICS
from calib.procedure.findings import sentence
from calib.procedure.report.certificate.record import StageRecord
from calib.procedure.report.dynamics_errors import percent, rms_words
from calib.procedure.report.dynamics_section import DynamicReport, proof_of, warnings_of
from calib.procedure.report.page import ChartPicture, Picture, Pictures, ReportTable, Section, Text
from calib.records import read_json
from calib.robot.chain import Joint

if TYPE_CHECKING:
    from calib.procedure.report.figures.charts import Captioned

UNCERTAINTY = ("torque-interval-coverage", "outside-training-range")
# torques in the table
MAX_ROWS = 14
# torques drawn
MAX_CURVES = 4
# of each curve of a motion
POINTS = 300
NOTE = (
    "rms error: of the torque as recorded; of limit: of the torque that the robot's description allows; in band: both "
    "torques low-passed to the band of the motion; 95 % interval: half width (median), and share of errors within it."
)


def stage(report: DynamicReport, section: Section, plots: Plots, has_tolerance: bool = False) -> StageRecord:
    """Return the content of report and certificate on an identification.

    Args:
        report: stored results of the identification.
        section: section of the report, with verdict and key figures.
        plots: whether to include figures.
        has_tolerance: whether a largest acceptable torque error is stated.
    """
    order = _worst_first(report)
    pictures = list(_curves(report, order)) if plots else []
    blocks = [
        _torque_table(report, order),
        Pictures("Torques", pictures),
        Text("Uncertainty", list(_uncertainty(report))),
    ]
    # what stands under uncertainty is not repeated among the findings
    uncertainty = tuple(_uncertainty_findings(report))
    findings = [line for line in warnings_of(report) if not line.startswith(uncertainty)]
    return StageRecord(section, blocks, list(_unchecked(report, has_tolerance)), findings)


def _unchecked(report: DynamicReport, has_tolerance: bool) -> Iterator[str]:
    """Yield texts on the properties that the recordings of an identification cannot prove.

    Args:
        report: stored results of the identification.
        has_tolerance: whether a largest acceptable torque error is stated.
    """
    if not report.unseen.proofs:
        yield "torque errors on unseen motion: none was recorded"
    if not has_tolerance:
        yield "a tolerance of the torque: none was asked for; pass means below 10 %"


def _uncertainty_findings(report: DynamicReport) -> list[str]:
    return [sentence(finding) for finding in report.unseen.noticed if finding.code in UNCERTAINTY]


def _worst_first(report: DynamicReport) -> np.ndarray:
    """Return the indices (from 0) of the torque rows, sorted by error, largest first.

    Errors are divided by the torque limits if all limits are known.

    Args:
        report: stored results of the identification.
    """
    _, proof, _ = proof_of(report.unseen)
    errors = np.nan_to_num(proof.raw.rms)
    limits = report.unseen.limits
    if limits is not None and np.isfinite(limits).all():
        errors = errors / limits
    return np.argsort(-errors, kind="stable")


def _torque_table(report: DynamicReport, order: np.ndarray) -> ReportTable:
    unseen = report.unseen
    name, proof, motion = proof_of(unseen)
    interval = proof.interval95
    coverage = "–" if interval is None else f"{interval.coverage_percent:.1f} %"
    rows = [["all torques", "", "", percent(proof.raw.total), percent(proof.filtered.total), "", coverage]]
    for j in np.sort(order[:MAX_ROWS]):
        rms, of_limit = rms_words(proof, unseen, j)
        unexplained = percent(float(proof.raw.joints[j]))
        in_band = percent(float(proof.filtered.joints[j]))
        half_width, coverage = "–", "–"
        if interval is not None:
            half_width = f"± {interval.median[j]:.3g} {unseen.units[j]}"
            coverage = f"{interval.joints_percent[j]:.0f} %"
        rows.append([unseen.rows[j], rms, of_limit, unexplained, in_band, half_width, coverage])
    note = NOTE
    if len(order) > MAX_ROWS:
        note += f" The {MAX_ROWS} largest of {len(order)}; all: see report.html."
    header = ("torque", "rms error", "of limit", "unexplained", "in band", "95 % interval", "within it")
    return ReportTable(f"Torque errors on {motion} ({name})", header, rows, note, frozenset({0}), range(1, 7))


def _curves(report: DynamicReport, order: np.ndarray) -> Iterator[Picture]:
    """Yield a picture of the torques with the largest errors, measured and predicted; nothing without curves.

    Args:
        report: stored results of the identification.
        order: indices of the torque rows, the row with the largest error first.
    """
    from calib.procedure.report.dynamics_figures import torques

    unseen = report.unseen
    name, proof, _ = proof_of(unseen)
    curves = next((recording for recording in unseen.curves if recording.name == name), None)
    if curves is None:
        return
    largest = np.sort(order[:MAX_CURVES])
    rows = [unseen.rows[j] for j in largest]
    units = [unseen.units[j] for j in largest]
    measured, predicted = curves.measured[largest].T, curves.predicted[largest].T
    chart = torques(curves.t, measured, predicted, rows, units, name, proof.raw.joints[largest], curves.band)
    subject = "Torques"
    if len(order) > len(largest):
        subject = f"The {len(largest)} of {len(order)} torques with the largest errors"
    filtered = ""
    if np.isfinite(curves.band):
        filtered = f", low-passed at {curves.band:.3g} Hz"
    caption = f"{subject}: measured, predicted, and the difference{filtered}. All: see report.html."
    yield ChartPicture(chart, caption).vector()


def _uncertainty(report: DynamicReport) -> Iterator[str]:
    metrics = report.metrics
    yield from _uncertainty_findings(report)
    yield (
        f"{metrics.parameters.base} base parameters, {metrics.parameters.essential} of them essential; their values "
        "and standard deviations: see report.html and estimate.csv"
    )
    if metrics.geometry is not None:
        yield metrics.geometry.summary


@dataclass(frozen=True)
class _DesignSetting:
    """Settings of a designed motion.

    Attributes:
        period: period of the motion [s].
        columns: names of the columns to identify.
        instants_verified: number of instants at which the limits were checked.
    """

    period: float
    columns: tuple[str, ...]
    instants_verified: int


@dataclass(frozen=True)
class _LimitMargin:
    """Smallest distance of a motion from a limit, as a share of the limit."""

    share: float


@dataclass(frozen=True)
class _DesignMetrics:
    """Entries of a designed motion's ``metrics.json`` that the certificate uses.

    Attributes:
        condition_number: ``raw`` (SI units) and ``normalised`` (unit columns) -> condition number.
        setting: settings of the design.
        margins: name of a limit -> distance of the motion from the limit.
    """

    condition_number: Mapping[str, float]
    setting: _DesignSetting
    margins: Mapping[str, _LimitMargin]


def trained_on(folder: Path, joints: Sequence[Joint]) -> Captioned:
    """Return a chart of the designed training motion in a folder, and a caption that states its condition number.

    Args:
        folder: folder of the designed motion.
        joints: the robot's joints.
    """
    from calib.procedure.excitation import coefficients
    from calib.procedure.report.motion_figures import motion_sheet

    motion = coefficients.read(folder)
    t = np.linspace(0.0, motion.period, POINTS)
    q, v, _ = motion.orders(t)
    metrics = read_json(folder / METRICS, "design the motion again", _DesignMetrics)
    raw, normalised = metrics.condition_number["raw"], metrics.condition_number["normalised"]
    margins = ", ".join(f"{name} {margin.share:.1%} of its scale" for name, margin in metrics.margins.items())
    setting = metrics.setting
    caption = (
        f"The training motion, one period of {setting.period:g} s: condition number "
        f"{raw:.3g} raw, {normalised:.3g} with unit columns, of "
        f"{len(setting.columns)} columns. All limits are kept, at and between {setting.instants_verified} "
        f"instants; smallest margins: {margins}."
    )
    no_limit = np.full(q.shape[1], np.inf)
    sheet = motion_sheet(t, [(q, -no_limit, no_limit), (v, -no_limit, no_limit)], joints)
    return sheet, caption

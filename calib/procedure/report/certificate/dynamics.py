"""The certificate's page on the dynamics: torque errors in N·m and of the limits, torques, uncertainty."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.folders import METRICS
from calib.procedure.excitation import coefficients
from calib.procedure.findings import sentence
from calib.procedure.report.certificate.record import StageRecord
from calib.procedure.report.dynamics_section import DynamicReport, percent, proof_of, rms_words, warnings_of
from calib.procedure.report.page import Picture, Pictures, ReportTable, Section, Text
from calib.records import read_json
from calib.robot.chain import Joint

if TYPE_CHECKING:
    from calib.procedure.report.charts import Captioned

UNCERTAINTY = ("torque-interval-coverage", "outside-training-range")
MAX_ROWS = 14  # torques in the table
MAX_CURVES = 4  # torques drawn
POINTS = 300  # of each curve of a motion
NOTE = (
    "rms error: of the torque as recorded; of limit: of the torque that the robot's description allows; in band: both "
    "torques low-passed to the band of the motion; 95 % interval: half width (median), and share of errors within it."
)


def stage(found: DynamicReport, section: Section, plots: bool, tolerance: float = 0.0) -> StageRecord:
    """Return the stage of an identification.

    Args:
        section: of the report, with verdict and key figures.
        plots: whether there are to be figures.
        tolerance: largest error of the torque on unseen motion that is good enough [%]; 0: none.
    """
    order = _worst_first(found)
    curves = Pictures("Torques", list(_curves(found, order)) if plots else [])
    blocks = [_torque_table(found, order), curves, Text("Uncertainty", list(_uncertainty(found)))]
    return StageRecord(section, blocks, [*_unchecked(found, tolerance)], _findings(found))


def _unchecked(found: DynamicReport, tolerance: float) -> Iterator[str]:
    """Yield what the recordings of an identification do not show."""
    if not found.unseen.proofs:
        yield "torque errors on unseen motion: none was recorded"
    if not tolerance:
        yield "a tolerance of the torque: none was asked for; pass means below 10 %"


def _findings(found: DynamicReport) -> list[str]:
    """Return what was noticed, without what stands under uncertainty."""
    said = tuple(_noticed(found))
    return [line for line in warnings_of(found) if not line.startswith(said)]


def _noticed(found: DynamicReport) -> list[str]:
    return [sentence(one) for one in found.unseen.noticed if one.code in UNCERTAINTY]


def _worst_first(found: DynamicReport) -> np.ndarray:
    """Return the torque rows by their error, as a share of the limit if all limits are known, else of the largest."""
    unseen, (_, proof, _) = found.unseen, proof_of(found.unseen)
    rms = np.nan_to_num(proof.raw.rms)
    limits = np.full(len(rms), np.inf) if unseen.limits is None else unseen.limits
    return np.argsort(-(rms / limits if np.isfinite(limits).all() else rms), kind="stable")


def _torque_table(found: DynamicReport, order: np.ndarray) -> ReportTable:
    unseen, (name, proof, where) = found.unseen, proof_of(found.unseen)
    held = proof.interval95
    inside = "–" if held is None else f"{held.coverage_percent:.1f} %"
    rows = [["all torques", "", "", percent(proof.raw.total), percent(proof.filtered.total), "", inside]]
    for j in np.sort(order[:MAX_ROWS]):
        half = "–" if held is None else f"± {held.median[j]:.3g} {unseen.units[j]}"
        inside = "–" if held is None else f"{held.joints_percent[j]:.0f} %"
        errors = [percent(float(one.joints[j])) for one in (proof.raw, proof.filtered)]
        rows.append([unseen.rows[j], *rms_words(proof, unseen, j), *errors, half, inside])
    left = len(order) - MAX_ROWS
    note = NOTE + (f" The {MAX_ROWS} largest of {len(order)}; all: see report.html." if left > 0 else "")
    header = ("torque", "rms error", "of limit", "unexplained", "in band", "95 % interval", "within it")
    return ReportTable(f"Torque errors on {where} ({name})", header, rows, note, frozenset({0}), range(1, 7))


def _curves(found: DynamicReport, order: np.ndarray) -> Iterator[Picture]:
    """Yield the picture of measured and predicted torques with the largest errors."""
    from calib.procedure.report.charts import vector
    from calib.procedure.report.dynamics_figures import torques

    unseen, (name, proof, _) = found.unseen, proof_of(found.unseen)
    curves = next((one for one in unseen.curves if one.name == name), None)
    if curves is None:
        return
    shown = np.sort(order[:MAX_CURVES])
    rows, units = ([names[j] for j in shown] for names in (unseen.rows, unseen.units))
    measured, predicted = curves.measured[shown].T, curves.predicted[shown].T
    chart = torques(curves.t, measured, predicted, rows, units, name, proof.raw.joints[shown], curves.band)
    which = (
        f"The {len(shown)} of {len(order)} torques with the largest errors" if len(order) > len(shown) else "Torques"
    )
    low = f", low-passed at {curves.band:.3g} Hz" if np.isfinite(curves.band) else ""
    yield vector(chart, f"{which}: measured, predicted, and the difference{low}. All: see report.html.")


def _uncertainty(found: DynamicReport) -> Iterator[str]:
    metrics = found.metrics
    yield from _noticed(found)
    yield (
        f"{metrics.parameters.base} base parameters, {metrics.parameters.essential} of them essential; their values "
        "and standard deviations: see report.html and estimate.csv"
    )
    if metrics.geometry is not None:
        yield metrics.geometry.summary


@dataclass(frozen=True)
class _DesignSetting:
    """Settings of a design: period [s], columns to identify, and number of verified instants."""

    period: float
    columns: tuple[str, ...]
    instants_verified: int


@dataclass(frozen=True)
class _LimitMargin:
    """Distance of a motion from a limit, as a share of the limit."""

    share: float


@dataclass(frozen=True)
class _DesignMetrics:
    """What is read of the ``metrics.json`` of a designed motion: condition number, settings, smallest margins."""

    condition_number: Mapping[str, float]
    setting: _DesignSetting
    margins: Mapping[str, _LimitMargin]


def trained_on(folder: Path, joints: Sequence[Joint]) -> Captioned:
    """Return the chart of a designed motion from its folder, with its condition number in the caption."""
    from calib.procedure.report.motion_figures import motion_sheet

    motion = coefficients.read(folder)
    t = np.linspace(0.0, motion.period, POINTS)
    q, v, _ = motion.orders(t)
    made = read_json(folder / METRICS, "design the motion again", _DesignMetrics)
    raw, unit = (made.condition_number[scaling] for scaling in ("raw", "normalised"))
    margins = ", ".join(f"{name} {one.share:.1%} of its scale" for name, one in made.margins.items())
    words = (
        f"The training motion, one period of {made.setting.period:g} s: condition number "
        f"{raw:.3g} raw, {unit:.3g} with unit columns, of "
        f"{len(made.setting.columns)} columns. All limits are kept, at and between {made.setting.instants_verified} "
        f"instants; smallest margins: {margins}."
    )
    none = np.full(q.shape[1], np.inf)
    return motion_sheet(t, [(q, -none, none), (v, -none, none)], joints), words

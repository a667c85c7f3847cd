"""Tables of torque errors in the report section on the dynamics: by recording and row, by reference, by interval."""

from collections.abc import Iterator, Sequence

import numpy as np

from calib.identification.prediction import Score
from calib.procedure.dynamic_stage.metrics import UnseenReport
from calib.procedure.report import page

ERROR_NOTE = (
    "Of limit: of the torque that the robot's description allows. "
    "Error: 100 ‖τ - τ̂‖ / ‖τ‖ of the torque as recorded; in band: both low-passed to the band of the motion; moving, "
    "standing: as recorded, where the joint moves or stands. Torque above that band (noise, ripple) is explained "
    "by no model of q, v, a. ACF outside: share of the residual's autocorrelations beyond the 95 % bounds of "
    "white noise; 5 % if it is white."
)
ERROR_HEADER = (
    "torque",
    "rms error",
    "of limit",
    "error",
    "in band",
    "moving",
    "standing",
    "torque above band",
    "ACF outside",
)
REFERENCE_NOTE = (
    "Plain least squares: weighted, base parameters with Coulomb and viscous friction and offsets, no prior, no "
    "selection, truncated at the data's rank. In motion, where joints stand for more than 5 % of the recording."
)
INTERVAL_HEADER = (
    "torque",
    "errors within the 95 % interval",
    "median interval in motion",
    "at rest",
    "of the time extrapolated",
)


def error_table(unseen: UnseenReport) -> page.ReportTable:
    """Return the table of torque errors for each recording and torque row.

    Args:
        unseen: report on the model's errors.
    """
    groups = {}
    for name, score in unseen.fit.items():
        groups[f"{name} (fitted)"] = _error_rows(score, unseen)
    for name, score in unseen.validation.items():
        role = "unseen" if score.evidence else "repeat: no evidence"
        groups[f"{name} ({role})"] = _error_rows(score, unseen)
    return page.grouped("Torque errors", ERROR_HEADER, groups, ERROR_NOTE, _of_all)


def _error_rows(score: Score, unseen: UnseenReport) -> Iterator[Sequence[str]]:
    """Yield the rows of the error table for one recording: first all torques together, then each torque row.

    Args:
        score: score of the model on the recording.
        unseen: report on the model's errors, with the names of the torque rows.
    """
    parts = score.raw, score.filtered, score.moving, score.standing
    totals = [percent(part.total) for part in parts]
    yield "all", "", "", *totals, "", ""
    for j, (row, whiteness) in enumerate(zip(unseen.rows, score.whiteness)):
        rms, share = rms_words(score, unseen, j)
        shares = [percent(part.joints[j]) for part in parts]
        acf_outside = "" if whiteness is None else f"{100 * whiteness.outside:.0f} %"
        yield row, rms, share, *shares, percent(score.above_band_percent[j]), acf_outside


def rms_words(score: Score, unseen: UnseenReport, row: int) -> tuple[str, str]:
    """Return as texts a torque row's rms error in its unit, and in percent of its limit; "–" if unknown.

    Args:
        score: score of the model on a recording.
        unseen: report with units and limits of the torque rows.
        row: index of the torque row, from 0.
    """
    rms = score.raw.rms[row]
    if not np.isfinite(rms):
        return "–", "–"
    share = "–"
    if unseen.limits is not None and np.isfinite(unseen.limits[row]):
        share = percent(100.0 * rms / unseen.limits[row])
    return f"{rms:.3g} {unseen.units[row]}", share


def reference_table(unseen: UnseenReport) -> page.ReportTable:
    """Return the table of errors on held-out motion by the plain references and by the model; may be empty.

    Args:
        unseen: report on the model's errors.
    """
    header = ("recording", "nominal masses, no friction", "plain least squares", "this model")
    rows = []
    for recording, references in unseen.references.items():
        errors = references.nominal, references.plain, references.delivered
        rows.append([recording, *map(percent, errors)])
    title = "Comparison with plain references: torque unexplained on held-out motion"
    return page.ReportTable(title, header, rows, REFERENCE_NOTE, numbers=[1, 2, 3])


def interval_table(unseen: UnseenReport) -> page.ReportTable:
    """Return the table of the coverage of predicted 95 % intervals on held-out recordings; may be empty.

    Args:
        unseen: report on the model's errors.
    """
    groups = {}
    for name, score in unseen.validation.items():
        coverage = score.interval95
        if coverage is None:
            continue
        # of earlier versions without any at rest; a single value holds for all rows
        at_rest = np.full(len(unseen.rows), np.nan)
        if len(coverage.median_at_rest):
            at_rest = np.resize(coverage.median_at_rest, len(unseen.rows))
        extrapolated = f"{coverage.extrapolated_percent:.0f} %"
        rows = [("all", f"{coverage.coverage_percent:.1f} %", "", "", extrapolated)]
        for k, (row, unit) in enumerate(zip(unseen.rows, unseen.units)):
            coverage_text = f"{coverage.joints_percent[k]:.0f} %"
            moving = f"± {coverage.median[k]:.3g} {unit}"
            resting = f"± {at_rest[k]:.3g} {unit}" if np.isfinite(at_rest[k]) else "–"
            rows.append((row, coverage_text, moving, resting, ""))
        groups[name] = rows
    return page.grouped("Intervals stated", INTERVAL_HEADER, groups, strong=_of_all)


def percent(value: float) -> str:
    """Return a percentage `value` [%] with three significant digits as text; a dash if it is not finite."""
    return page.number(value, " %")


def _of_all(row: Sequence[str]) -> bool:
    return row[0] == "all"

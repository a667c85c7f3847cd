"""Errors on unseen poses that contradict a fit, of however few poses.

Few poses, or few numbers beside a placement that was fitted to them, cannot prove a fit. Errors far above those that it
leads to expect can contradict it all the same. Limits and sentences are in the catalogue of findings, chapter 4.
"""

import math
from collections.abc import Iterator, Mapping

import numpy as np

from calib.errors import Finding, finding
from calib.geometry.error_model import outside
from calib.geometry.static_torques.sources import load_changes
from calib.procedure.findings import catalogue
from calib.procedure.kinematic_stage.verdict.comparison import MIN_UNSEEN, Comparison
from calib.procedure.kinematic_stage.verdict.plausibility import TOO_GOOD

# times the median error: a row from which on is probably measured wrongly (our choice)
OUTLIER_SIGMAS = 8.0
# largest share of the poses that is advised to be held out: the others have to determine an arm (our choice)
MAX_HOLDOUT = 0.3
# error [m] below which none is taken in a ratio
TINY = 1e-300
# share of a joint's fitted range by which a pose may be outside without being an extrapolation (our choice)
RANGE_MARGIN = 0.1


def expected_error(fit: Comparison, cross_validated: float | None) -> float:
    """Return the error [m] that a fit leads to expect on other poses: the cross-validated one, else the fitted one.

    Args:
        fit: errors of both arms on the fitted rows.
        cross_validated: cross-validated error [m]; None if not computed.
    """
    return max(fit.errors[1].rms if cross_validated is None else cross_validated, TINY)


def small_files(fit: Comparison, validation: Mapping[str, Comparison], promised: float) -> Iterator[Finding]:
    """Yield a finding on each validation file that proves nothing, but may contradict the fit.

    Rows that are far off with both arms do not count: they are findings of their own. What a fitted placement leaves is
    a lower bound of the error.

    Args:
        fit: errors of both arms on the fitted rows, some of which may be held out instead.
        validation: name of a validation file -> errors of both arms.
        promised: error that the fit leads to expect [m].
    """
    for name, rows in validation.items():
        if not rows.may_contradict:
            continue
        rms = _rms(rows.errors[1].main[~far_off_with_both_arms(rows)])
        times = rms / promised
        if rows.placed_by is not None:
            measured, fitted = rows.placed_by
            values = {"measured": measured, "fitted": fitted, "least": rows.least_poses}
            yield finding("placement-takes-all", file=name, rms=rms, times=times, **values)
        else:
            values = {"poses": rows.few, "least": MIN_UNSEEN, "holdout": _sufficient_holdout(fit, rows)}
            yield finding("few-unseen-poses", where=name, rms=rms, times=times, **values)


def _sufficient_holdout(fit: Comparison, rows: Comparison) -> str | None:
    """Return a share of the measured poses that is enough to decide a verdict; None if it leaves too few to fit.

    Args:
        fit: errors on the fitted rows.
        rows: errors on unseen rows: of the same file, if they were held out.
    """
    poses = fit.poses
    if {block.file for block in rows.blocks} <= {block.file for block in fit.blocks}:
        poses += rows.poses
    share = math.ceil(20.0 * MIN_UNSEEN / max(poses, 1)) / 20.0
    return f"{share:g}" if share <= MAX_HOLDOUT else None


def contradicted(fit: Comparison, validation: Mapping[str, Comparison], promised: float) -> Iterator[Finding]:
    """Yield a finding on each validation file whose errors within the fitted range are far above the expected error.

    Rows that are far off with both arms do not count, nor do poses at which the model extrapolates.

    Args:
        fit: errors of both arms on the fitted rows.
        validation: name of a validation file -> errors of both arms.
        promised: error that the fit leads to expect [m].
    """
    for name, rows in validation.items():
        extrapolated = _extrapolated(fit, rows)
        rms = _rms(rows.errors[1].main[~far_off_with_both_arms(rows) & ~extrapolated])
        within = ""
        if np.any(extrapolated):
            within = "within the fitted range"
        remedy = ""
        if rows.shares_frames:
            remedy = catalogue()["placed-elsewhere"].advice
        # a fit of exact simulated data promises less than any instrument measures
        times = rms / max(promised, TOO_GOOD)
        yield finding("contradicted", where=name, rms=rms, within=within, times=times, remedy=remedy)


def _extrapolated(fit: Comparison, rows: Comparison) -> np.ndarray:
    """Return flags (m,): whether each error of `rows` is of a pose outside the fitted joint ranges or loads.

    The ranges are widened by `RANGE_MARGIN` on both sides. Where errors do not belong to single rows, none is flagged
    by its joints.

    Args:
        fit: errors on the fitted rows.
        rows: errors on other rows.
    """
    sizes = rows.errors[1].main
    if load_changes(fit.blocks, rows.blocks):
        return np.ones(len(sizes), dtype=bool)
    if not fit.blocks or sum(len(block) for block in rows.blocks) != len(sizes):
        return np.zeros(len(sizes), dtype=bool)
    learnt = np.concatenate([block.q for block in fit.blocks])
    margin = RANGE_MARGIN * np.ptp(learnt, axis=0)
    widened = np.array([learnt.min(axis=0) - margin, learnt.max(axis=0) + margin])
    q = np.concatenate([block.q for block in rows.blocks])
    return np.any(outside(q, widened), axis=1)


def far_off_with_both_arms(comparison: Comparison) -> np.ndarray:
    """Return flags (m,): whether the errors of both arms are far above their medians in each row of a comparison."""
    nominal, calibrated = comparison.errors
    if not len(calibrated.main):
        return np.zeros(0, dtype=bool)
    return far_above_median(nominal.main) & far_above_median(calibrated.main)


def far_above_median(sizes: np.ndarray) -> np.ndarray:
    """Return flags (m,): whether each of m errors `sizes` [m] is above `OUTLIER_SIGMAS` times the median error."""
    return sizes > OUTLIER_SIGMAS * np.median(sizes)


def _rms(sizes: np.ndarray) -> float:
    """Return the root mean square of errors (m,); 0 without errors."""
    return float(np.sqrt(np.sum(sizes**2) / max(len(sizes), 1)))

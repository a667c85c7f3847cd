"""Findings on measurements that contradict this arm (catalogue, chapter 1): wrong columns, scale, large changes.

Rows that do not fit, and whether rigid geometry explains the measurements.
"""

from collections.abc import Sequence

import numpy as np

from calib.column_changes import Explanation
from calib.data.poses import IMAGES
from calib.data.poses.measurements import PoseMeasurements, take
from calib.errors import Finding, finding
from calib.geometry.accuracy import NATURE, errors
from calib.geometry.checks.joint_range import JointRange
from calib.geometry.checks.readings import repeated_readings
from calib.geometry.diagnosis import Scale, length_factor, scale_of, wrong_angles, wrong_columns
from calib.geometry.installation import Installation
from calib.geometry.model_choice.cross_validation import JUDGED_POSES
from calib.geometry.model_choice.ladder import MAX_RESIDUAL, ModelSelection
from calib.geometry.observation import sampled
from calib.geometry.weighing import GeometricFit
from calib.procedure.findings import level_of, limit
from calib.procedure.kinematic_stage.inputs import CAMERA_GUESS
from calib.procedure.kinematic_stage.metrics import Outlier
from calib.records import evenly
from calib.units import DEG, ERRORS

FLOOR = 4e-4  # rms per metre of reach: more is not left by a rigid geometry of a sound arm (our choice)
TOO_GOOD = 2e-6  # rms [m]: less is left by no instrument (our choice)


def named_outliers(found: GeometricFit) -> list[Outlier]:
    """Return the outliers of a fit (above four robust sigmas), worst first; several targets of one row count once."""
    result: dict[tuple[str, int, str], Outlier] = {}
    for file, row, label, sigmas, size in found.outliers():
        factor, unit = ERRORS[NATURE[label]]
        one = Outlier(file, row, NATURE[label], sigmas, **{f"size_{unit}": factor * size})
        result.setdefault((file, row, label), one)
    return list(result.values())


def misfit(found: ModelSelection, reach: float) -> Finding | None:
    """Return a finding if no rigid geometry explains the measurements: the error exceeds `FLOOR` of the reach.

    Both on the fitted rows, degrees of freedom counted, and cross-validated: few poses predict each other badly under
    any model, which says nothing against this one. Where the chosen model, joint corrections included, leaves less than
    `FLOOR`, it is a note.

    Args:
        found: the selection of models by cross-validation.
        reach: of the arm [m].
    """
    rigid = next((rung for rung in found.rungs if rung.model == "geometry"), None)
    if rigid is None:
        return None
    fitted = _left(found.rigid)
    if min(rigid.cross_validated, fitted) <= FLOOR * reach:
        return None
    left = found.cross_validated / (FLOOR * reach)
    return finding(
        "rigid-misfit", rms=fitted, folds=rigid.cross_validated, reach=reach, healthy=FLOOR * reach, left=left
    )


def gross_rows(found: ModelSelection, robust: ModelSelection, reach: float) -> Finding | None:
    """Return a finding if a few grossly wrong rows cause the error that `misfit` reports; otherwise None.

    Args:
        found: the selection of models with a loss that heeds every row.
        robust: the rigid models on the same rows with a loss that does not.
        reach: of the arm [m].
    """
    off = [row for row in named_outliers(robust.rigid) if row.sigmas > MAX_RESIDUAL]
    if not off or misfit(robust, reach):
        return None
    best = min(rung.cross_validated for rung in robust.rungs)
    return finding(
        "gross-rows",
        count=len({(row.file, row.row) for row in off}),
        rows=[row.words for row in off],
        loss=found.loss,
        rms=best,
        left=found.cross_validated / (FLOOR * reach),
    )


def _left(found: GeometricFit) -> float:
    """Return the rms position error of a fit on the fitted rows [m], corrected for degrees of freedom."""
    parts = [piece.part for piece in found.pieces]
    sizes = [part.sizes() for part in parts if NATURE[part.label] == "position"]
    rows, used = sum(part.height for part in parts), found.identified + sum(part.nuisances for part in parts)
    if not sizes or rows <= used:
        return np.inf
    return float(np.sqrt(np.mean(np.concatenate(sizes) ** 2) * rows / (rows - used)))


HALF = 0.5  # of the nominal arm's error: a fit that promises less than that elsewhere is better there (our choice)


def of_range(held: JointRange, tolerance: float | None) -> list[Finding]:
    """Return findings on the joint range that a calibration is about, and on what it promises outside.

    Args:
        held: the measured range, and σ over the whole range.
        tolerance: largest rms on unseen poses that is good enough [m]; None where none was given.
    """
    if held.sigma is None or not held.moved:
        return []
    shares = [held.shares[j] for j in held.moved]
    limit_elsewhere = tolerance if tolerance is not None else max(HALF * (held.nominal or np.inf), TOO_GOOD)
    values = {"sigma": held.sigma, "least": min(shares), "most": max(shares)}
    beyond, times = held.sigma / limit_elsewhere, held.sigma / max(held.left, 1e-300)
    return [
        finding("measured-range", joints=ranges(held), **values),
        finding("small-range", beyond=beyond, times=times, nominal=held.nominal, **values),
    ]


def ranges(held: JointRange) -> list[str]:
    """Return the measured range of each joint, as text [deg or mm]."""
    words = []
    for name, low, high, unit in zip(held.joints, held.lower, held.upper, held.units):
        factor, shown = (1e3, "mm") if unit == "m" else (1.0 / DEG, "°")
        words.append(f"{name} {round(factor * low)} to {round(factor * high)} {shown}".replace(" °", "°"))
    return words


MAX_TURN, MAX_SHIFT = 0.1, 0.03  # of a healthy arm's elements [rad], of the reach (our choice)
MAX_IMAGES = 100  # that the scale is judged by


def findings(
    nominal: Installation, fit: GeometricFit, blocks: Sequence[PoseMeasurements], left: float | None, reach: float
) -> list[Finding]:
    """Return findings on measurements that contradict the arm, the most likely cause first.

    Args:
        nominal: the arm as it was, placed.
        fit: of the calibrated one.
        blocks: the rows.
        left: cross-validated error of the chosen model [m]; None where it was not computed.
        reach: of the arm [m].
    """
    before, after = (errors(cell, blocks).rms for cell in (nominal, fit.cell))
    remains = after if left is None else min(left, max(after, _left(fit)))
    shown = [_as_positions(take(block, rows)) for block, rows in zip(blocks, sampled(blocks, JUDGED_POSES))]
    wrong = [*_misread(nominal, shown), *_wrong_way(nominal, shown, before, reach)]
    result = [*repeated_readings(nominal, shown), *(wrong or _moved(fit, reach))]
    result.append(finding("unexplained", rms=remains, reach=reach, share=remains / reach))
    if 0.0 < after < TOO_GOOD:
        arm, rms = ("nominal", before) if before < TOO_GOOD else ("calibrated", after)
        result.append(finding("commanded", arm=arm, rms=rms))
    scale = scale_of(nominal, shown)
    if scale is not None and before * np.sqrt(1.0 - scale.explained) < limit("unexplained", "share") * reach:
        result += _scale(("scale-of-another-robot", "scale"), scale) or _scale(
            ("lengths-of-another-robot", "lengths-grew"), length_factor(fit)
        )
    return [one for one in result if level_of(one)]


def _as_positions(block: PoseMeasurements) -> PoseMeasurements:
    """Return the block; images are replaced by board poses, scaled by the board's square."""
    if block.kind != IMAGES:
        return block
    rows = evenly(len(block), MAX_IMAGES)
    return CAMERA_GUESS.one().pnp_poses(take(block, rows))


def _wrong_way(nominal: Installation, blocks: Sequence[PoseMeasurements], before: float, reach: float) -> list[Finding]:
    """Return a finding if the nominal arm explains the rows once columns or rows are changed."""
    if not before > FLOOR * reach:
        return []
    changed = wrong_columns(nominal, blocks, mirrored=before > limit("unexplained", "share") * reach)
    return [] if changed is None else _told(changed, nominal)


def _misread(nominal: Installation, blocks: Sequence[PoseMeasurements]) -> list[Finding]:
    """Return a finding if the angles of orientations fit by another convention, and not as stated."""
    angle = errors(nominal, blocks).orientation
    if angle is None or not np.sqrt(np.mean(angle**2)) > limit("orientations-off", "angle"):
        return []
    changed = wrong_angles(nominal, blocks)
    return [] if changed is None else _told(changed, nominal)


def _told(changed: Explanation, nominal: Installation) -> list[Finding]:
    """Return the finding on a change that explains the rows, if it is serious enough."""
    was, rms = (float(np.sqrt(one[0])) for one in (changed.before, changed.after))
    one = changed.finding(nominal.chain.joint_names, rms=rms, before=was, times=was / max(rms, 1e-300))
    return [one] if level_of(one) else []


def _moved(fit: GeometricFit, reach: float) -> list[Finding]:
    """Return a finding if fitted elements differ implausibly much from nominal, largest change first."""
    changes = []
    for element, value, nominal in zip(fit.cell.chain.elements, fit.cell.chain.values, fit.start.chain.values):
        change = float(value - nominal)
        if element.unit == "m":
            changes.append((abs(change) / (MAX_SHIFT * reach), f"{element.name} by {1e3 * change:+.0f} mm"))
        else:
            change = (change + np.pi) % (2.0 * np.pi) - np.pi
            changes.append((abs(change) / MAX_TURN, f"{element.name} by {np.degrees(change):+.0f}°"))
    far = sorted((one for one in changes if one[0] > 1.0), reverse=True)
    return [finding("moved", elements=[words for _, words in far], times=far[0][0])] if far else []


def _scale(codes: tuple[str, str], one: Scale | None) -> list[Finding]:
    """Return the finding on an implausible scale factor, the first of two that is serious enough to report."""
    if one is None:
        return []
    off = abs(one.factor - 1.0)
    values = vars(one) | {"off": off, "surely_off": off - 3.0 * one.sigma, "sigmas": off / max(one.sigma, 1e-300)}
    return [each for code in codes if level_of(each := finding(code, **values))][:1]

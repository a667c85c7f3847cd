"""Findings on measurements that contradict the arm (catalogue, chapter 1): wrong columns, scale, large changes.

Further findings are on rows with large residuals, and on whether a rigid geometry explains the measurements.
"""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from calib.column_changes import Explanation
from calib.data.images.pixels import Pixels
from calib.data.poses.measurements import PoseMeasurements, Positions, take
from calib.errors import Finding, finding
from calib.geometry.accuracy import NATURE, errors
from calib.geometry.checks.base_motion import base_motion
from calib.geometry.checks.joint_range import JointRange
from calib.geometry.checks.mixed_rows import mixed_orientations
from calib.geometry.checks.readings import repeated_readings
from calib.geometry.checks.row_changes import MIN_ROWS
from calib.geometry.diagnosis import Scale, length_factor, scale_of, wrong_angles, wrong_columns
from calib.geometry.installation import Installation
from calib.geometry.model_choice.cross_validation import JUDGED_POSES
from calib.geometry.model_choice.ladder import MAX_RESIDUAL, ModelSelection
from calib.geometry.observation import layout, sampled
from calib.geometry.weighing import GeometricFit
from calib.procedure.findings import level_of, limit
from calib.procedure.kinematic_stage.metrics import Outlier
from calib.records import evenly
from calib.units import DEG, ERRORS

# rms per metre of reach: a rigid geometry of a sound arm leaves no more (our choice)
FLOOR = 4e-4
# rms [m]: no instrument leaves less (our choice)
TOO_GOOD = 2e-6
# of the nominal arm's error: a fit that promises less than that elsewhere is better there (our choice)
HALF = 0.5
# changes of a healthy arm's elements: [rad], and as a share of the reach (our choice)
MAX_TURN = 0.1
MAX_SHIFT = 0.03
# what sets the scale of images, in messages
SQUARES = " (square size of the board)"
# σ from which on a joint's scale is named, and the least scale that is: other effects of a turning joint leave a slope,
# too, and a gear with another number of teeth is off by more (our choice)
SURE_SCALE = 5.0
LEAST_SCALE = {"prismatic": 5e-5, "revolute": 2e-3}
# what the corrections of a model are caused by
CAUSES = {
    "stiffness": "joints that give way",
    "bending": "bearings or links that bend",
    "coupling": "joints that move others",
    "harmonics": "gear or encoder errors",
    "wobble": "axes that wobble",
}
# smallest share of the squared error of a rigid geometry that the corrections of one kind remove where they name its
# cause: of gear errors of first order other kinds removed up to 67 %, harmonics 79 % and more (our choice)
SHARE_OF_CAUSE = 0.75
# smallest share that all corrections remove where the cause is one of theirs (our choice)
SHARE_OF_CORRECTIONS = 0.25
# number of images by which the scale is judged
MAX_IMAGES = 100


def named_outliers(fit: GeometricFit) -> list[Outlier]:
    """Return the outliers of a fit (above four robust σ), worst first; several targets of one row count once."""
    outliers: dict[tuple[str, int, str], Outlier] = {}
    for file, row, label, sigmas, size in fit.outliers():
        nature = NATURE[label]
        factor, unit = ERRORS[nature]
        outlier = Outlier(file, row, nature, sigmas, **{f"size_{unit}": factor * size})
        outliers.setdefault((file, row, label), outlier)
    return list(outliers.values())


def misfit(selection: ModelSelection, reach: float) -> Finding | None:
    """Return a finding if no rigid geometry explains the measurements; otherwise None.

    The condition is an error above `FLOOR` times the reach, both on the fitted rows (corrected for degrees of freedom)
    and in cross-validation, since few poses predict each other badly under any model. If the error of the chosen model,
    joint corrections included, is below this limit, the finding is only a note.

    Args:
        selection: the selection of models by cross-validation.
        reach: reach of the arm [m].
    """
    rigid = next((rung for rung in selection.rungs if rung.model == "geometry"), None)
    if rigid is None:
        return None
    healthy = FLOOR * reach
    fitted = _position_rms(selection.rigid)
    if min(rigid.cross_validated, fitted) <= healthy:
        return None
    left = selection.cross_validated / healthy
    return finding(
        "rigid-misfit",
        rms=fitted,
        folds=rigid.cross_validated,
        reach=reach,
        healthy=healthy,
        left=left,
        causes=_causes(selection, rigid.cross_validated),
        excluded=None,
    )


def _causes(selection: ModelSelection, rigid: float) -> list[str]:
    """Return the cause of a rigid misfit that corrections name, with the share of the squared error that they remove.

    Corrections of one kind remove errors of another one in part.

    Args:
        selection: the selection of models by cross-validation.
        rigid: cross-validated error of the rigid geometry [m].
    """
    before = rigid
    for rung in selection.rungs:
        effect = rung.model.removeprefix("+ ")
        if not rung.kept or effect not in CAUSES:
            continue
        share = (before**2 - rung.cross_validated**2) / rigid**2
        before = rung.cross_validated
        if share > SHARE_OF_CAUSE:
            return [f"{CAUSES[effect]} ({share:.0%} of the squares)"]
    share = 1.0 - (before / rigid) ** 2
    if share > SHARE_OF_CORRECTIONS:
        return [f"joint errors of unclear kind ({share:.0%} of the squares)"]
    return []


def excluded_causes(selection: ModelSelection, blocks: Sequence[PoseMeasurements], scatter_tested: bool) -> list[str]:
    """Return what was looked for as the cause of a rigid misfit, and not found.

    Args:
        selection: the selection of models by cross-validation.
        blocks: the fitted rows.
        scatter_tested: whether random errors of joints were looked for.
    """
    excluded = ["wrong columns, units or rows"]
    if any(isinstance(block, Positions) and len(block) >= MIN_ROWS for block in blocks):
        excluded.append("a changed set-up")
    if scatter_tested:
        excluded.append("random joint errors")
    effects = [rung.model.removeprefix("+ ") for rung in selection.rungs]
    return excluded + [CAUSES[effect] for effect in effects if effect in CAUSES]


def gross_rows(selection: ModelSelection, robust: ModelSelection, reach: float) -> Finding | None:
    """Return a finding if a few rows with gross errors cause the error that `misfit` reports; otherwise None.

    Args:
        selection: models fitted with a loss that gives full weight to every row.
        robust: the rigid models fitted to the same rows with a robust loss.
        reach: reach of the arm [m].
    """
    gross = [outlier for outlier in named_outliers(robust.rigid) if outlier.sigmas > MAX_RESIDUAL]
    if not gross or misfit(robust, reach):
        return None
    rows = {(outlier.file, outlier.row) for outlier in gross}
    return finding(
        "gross-rows",
        count=len(rows),
        rows=[outlier.words for outlier in gross],
        loss=selection.loss,
        rms=min(rung.cross_validated for rung in robust.rungs),
        left=selection.cross_validated / (FLOOR * reach),
    )


def joint_scales(fit: GeometricFit) -> list[Finding]:
    """Return findings on joints whose fitted coupling with themselves is a scale of their readings.

    Args:
        fit: the fit, with its joint corrections.
    """
    cell = fit.cell
    first = len(layout(cell).names) - len(cell.deflection.terms)
    variance = dict(zip(fit.free.tolist(), np.diag(fit.estimate.covariance)))
    findings = []
    coefficients = np.asarray(cell.deflection.coefficients)
    for number, (term, scale) in enumerate(zip(cell.deflection.terms, coefficients)):
        joint = cell.chain.joints[term.source]
        own_element = cell.chain.names[cell.chain.moving[term.source]]
        sigma = np.sqrt(variance.get(first + number, 0.0))
        is_own_scale = term.basis == "joint" and term.element == own_element
        if is_own_scale and abs(scale) > max(LEAST_SCALE[joint.kind], SURE_SCALE * sigma):
            code = "rail-scale" if joint.kind == "prismatic" else "gear-scale"
            findings.append(finding(code, joint=joint.name, size=1e6 * scale, sigma=1e6 * sigma))
    return findings


def _position_rms(fit: GeometricFit) -> float:
    """Return the rms position error of a fit on the fitted rows [m], corrected for degrees of freedom."""
    parts = [piece.part for piece in fit.pieces]
    sizes = [part.sizes() for part in parts if NATURE[part.label] == "position"]
    rows = sum(part.height for part in parts)
    parameters = fit.identified + sum(part.nuisances for part in parts)
    if not sizes or rows <= parameters:
        return np.inf
    return float(np.sqrt(np.mean(np.concatenate(sizes) ** 2) * rows / (rows - parameters)))


def of_range(measured_range: JointRange, tolerance: float | None) -> list[Finding]:
    """Return findings on the joint range in which a calibration is valid, and on the error outside this range.

    Args:
        measured_range: the measured range, and the predicted σ over the arm's whole range.
        tolerance: largest acceptable rms on held-out poses [m]; None if not stated.
    """
    sigma, nominal = measured_range.sigma, measured_range.nominal
    if sigma is None or not measured_range.moved:
        return []
    limit_elsewhere = tolerance
    if limit_elsewhere is None:
        limit_elsewhere = max(HALF * (nominal or np.inf), TOO_GOOD)
    shares = [measured_range.shares[joint] for joint in measured_range.moved]
    values = {"sigma": sigma, "least": min(shares), "most": max(shares)}
    times = sigma / max(measured_range.left, 1e-300)
    return [
        finding("measured-range", joints=ranges(measured_range), **values),
        finding("small-range", beyond=sigma / limit_elsewhere, times=times, nominal=nominal, **values),
    ]


def ranges(measured_range: JointRange) -> list[str]:
    """Return a text on the measured range of each joint [deg or mm]."""
    texts = []
    limits = zip(measured_range.joints, measured_range.lower, measured_range.upper, measured_range.units)
    for name, low, high, unit in limits:
        if unit == "m":
            texts.append(f"{name} {round(1e3 * low)} to {round(1e3 * high)} mm")
        else:
            factor = 1.0 / DEG
            texts.append(f"{name} {round(factor * low)} to {round(factor * high)}°")
    return texts


def findings(
    nominal: Installation,
    fit: GeometricFit,
    blocks: Sequence[PoseMeasurements],
    cross_validated: float | None,
    reach: float,
    files: Sequence[PoseMeasurements],
) -> list[Finding]:
    """Return findings on measurements that contradict the arm, the most likely cause first.

    Args:
        nominal: the arm before the fit, with base and tool placed.
        fit: fit of the calibrated arm.
        blocks: the fitted rows.
        cross_validated: error of the chosen model [m]; None if not computed.
        reach: reach of the arm [m].
        files: the fitted rows with those that were held out: faults of a file show in the order of all its rows.
    """
    before = errors(nominal, blocks).rms
    after = errors(fit.cell, blocks).rms
    remains = after
    if cross_validated is not None:
        remains = min(cross_validated, max(after, _position_rms(fit)))
    sample = _judged_sample(blocks)
    file_sample = sample if files is blocks else _judged_sample(files)
    misread = _misread(nominal, file_sample) + _wrong_columns(nominal, file_sample, reach)
    result = base_motion(blocks) + repeated_readings(nominal, sample) + (misread or _large_changes(fit, reach))
    result.append(finding("unexplained", rms=remains, reach=reach, share=remains / reach))
    if 0.0 < after < TOO_GOOD:
        arm, rms = ("nominal", before) if before < TOO_GOOD else ("calibrated", after)
        result.append(finding("commanded", arm=arm, rms=rms))

    # A wrong scale is looked for where it leaves an error that an arm may have.
    scale = scale_of(nominal, sample)
    if scale is not None and before * np.sqrt(1.0 - scale.explained) < limit("unexplained", "share") * reach:
        board = SQUARES if any(isinstance(block, Pixels) for block in blocks) else ""
        scale_findings = _wrong_scale(("scale-of-another-robot", "scale"), scale, board)
        if not scale_findings:
            scale_findings = _wrong_scale(("lengths-of-another-robot", "lengths-grew"), length_factor(fit), board)
        result += scale_findings
    return list(filter(level_of, result))


def _judged_sample(blocks: Sequence[PoseMeasurements]) -> list[PoseMeasurements]:
    """Return the rows of each block by which measurements are judged, with positions for images."""
    sample = []
    for block, rows in zip(blocks, sampled(blocks, JUDGED_POSES)):
        sample.append(_as_positions(take(block, rows)))
    return sample


def _as_positions(block: PoseMeasurements) -> PoseMeasurements:
    """Return a block of measurements with positions.

    Images are replaced by board poses, whose scale is that of the board's squares; other blocks are unchanged.
    """
    if not isinstance(block, Pixels):
        return block
    rows = evenly(len(block), MAX_IMAGES)
    from calib.geometry.camera.camera_guess import pnp_poses

    return pnp_poses(take(block, rows))


def _wrong_columns(nominal: Installation, blocks: Sequence[PoseMeasurements], reach: float) -> list[Finding]:
    """Return a finding if the nominal arm explains the rows after a change of columns or rows.

    Otherwise, the list is empty.

    Args:
        nominal: the arm before the fit, with base and tool placed.
        blocks: the rows.
        reach: reach of the arm [m].
    """
    before = errors(nominal, blocks).rms
    if not before > FLOOR * reach:
        return []
    mirrored = before > limit("unexplained", "share") * reach
    return _explanation(wrong_columns(nominal, blocks, mirrored=mirrored), nominal)


def _misread(nominal: Installation, blocks: Sequence[PoseMeasurements]) -> list[Finding]:
    """Return findings if the measured orientations fit the arm in another reading than the stated one, or in two.

    Otherwise, the list is empty.

    Args:
        nominal: the arm before the fit, with base and tool placed.
        blocks: the rows.
    """
    angle = errors(nominal, blocks).orientation
    if angle is None or not np.sqrt(np.mean(angle**2)) > limit("orientations-off", "angle"):
        return []
    return mixed_orientations(nominal, blocks) or _explanation(wrong_angles(nominal, blocks), nominal)


def _explanation(change: Explanation | None, nominal: Installation) -> list[Finding]:
    """Return a finding on a change of columns that explains the rows.

    An empty list if there is no such change, or if the finding reaches no level of the catalogue.

    Args:
        change: the change of columns; None: there is none.
        nominal: the arm, which names the joints.
    """
    if change is None:
        return []
    before = float(np.sqrt(change.before[0]))
    after = float(np.sqrt(change.after[0]))
    times = before / max(after, 1e-300)
    explanation = change.finding(nominal.chain.joint_names, rms=after, before=before, times=times)
    return list(filter(level_of, [explanation]))


def _large_changes(fit: GeometricFit, reach: float) -> list[Finding]:
    """Return a finding if fitted elements differ implausibly much from nominal; otherwise an empty list.

    Args:
        fit: the fit.
        reach: reach of the arm [m], to which changes of lengths are compared.
    """
    large = []
    for element, value, nominal in zip(fit.cell.chain.elements, fit.cell.chain.values, fit.start.chain.values):
        change = float(value - nominal)
        if element.unit == "m":
            times = abs(change) / (MAX_SHIFT * reach)
            text = f"{element.name} by {1e3 * change:+.0f} mm"
        else:
            change = (change + np.pi) % (2.0 * np.pi) - np.pi
            times = abs(change) / MAX_TURN
            text = f"{element.name} by {np.degrees(change):+.0f}°"
        if times > 1.0:
            large.append((times, text))
    if not large:
        return []
    large.sort(reverse=True)
    largest_change, _ = large[0]
    return [finding("moved", elements=[text for _, text in large], times=largest_change)]


def _wrong_scale(codes: tuple[str, str], scale: Scale | None, board: str) -> list[Finding]:
    """Return a finding on an implausible scale factor; an empty list if the factor is plausible.

    Args:
        codes: two codes of findings; the first one that reaches a level of the catalogue is used.
        scale: the scale factor; None: unknown.
        board: what else sets the scale of images; empty for other instruments.
    """
    if scale is None:
        return []
    off = abs(scale.factor - 1.0)
    values = asdict(scale)
    values |= {
        "board": board,
        "off": off,
        "surely_off": off - 3.0 * scale.sigma,
        "sigmas": off / max(scale.sigma, 1e-300),
    }
    for code in codes:
        wrong_scale = finding(code, **values)
        if level_of(wrong_scale):
            return [wrong_scale]
    return []

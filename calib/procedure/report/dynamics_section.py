"""The report section on the dynamics, which is also the console output of an identification."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib.errors import UsageError, listing
from calib.folders import read_estimate
from calib.identification.friction.ripple import RippleWaves
from calib.identification.loop import (
    CAD,
    DAMPING,
    FEEDBACK,
    FLOOR,
    FREQUENCY,
    IDENTIFIED,
    MAX_SHIFT_SIGMAS,
    LoopMetrics,
    Replay,
)
from calib.identification.prediction import Score
from calib.identification.rows import Case
from calib.procedure.dynamic_stage import geometry_tables
from calib.procedure.dynamic_stage.computed_torque import TorqueTest
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.metrics import ModelMetrics, UnseenReport
from calib.procedure.dynamic_stage.metrics import metrics as record_of
from calib.procedure.dynamic_stage.with_geometry import GeometryFromTorquesMetrics
from calib.procedure.findings import as_notes, lines_of
from calib.procedure.report import page
from calib.records import read_rows
from calib.robot.chain import Chain
from calib.units import small

# RSD [%] from which on a parameter cannot be distinguished from zero: two sigmas
MAX_RSD = 50.0
# letters of a parameter's expression that are printed
EXPRESSION_LETTERS = 46
# geometric errors listed, and parameters that they change
MAX_EFFECTS = 8
# change of a parameter [σ] from which on it counts as changed
SIGNIFICANT = 2.0
# share of autocorrelations beyond the bound below which a residual may be called white (0.05 if it is)
WHITE = 0.10
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
FED_FORWARD = {
    FEEDBACK: "feedback alone",
    CAD: "CAD fed forward",
    IDENTIFIED: "model fed forward",
    FLOOR: "measured torque fed forward",
}


class IdentifiedParameter(NamedTuple):
    """A row of ``estimate.csv``.

    Attributes:
        name, unit: name and unit of the parameter.
        expression: text that explains the parameter: the combination of standard parameters that it stands for, or its
            drive term.
        value: the estimate.
        sigma: standard deviation, from torque noise and geometry; None if it was not estimated.
        rsd: `sigma` in percent of the value; None if it is unknown.
    """

    name: str
    expression: str
    unit: str
    value: float
    sigma: float | None
    rsd: float | None


@dataclass(frozen=True, eq=False)
class DynamicReport:
    """The stored results of an identification and its validation.

    Attributes:
        metrics: metrics of the identification.
        estimate: the parameters.
        effects: effects of geometric errors on the parameters; empty if the geometry is taken as exact.
        unseen: report on the model's errors on held-out motion, with the verdict.
        geometries: each parameter identified on the nominal and on the calibrated geometry; empty for one geometry.
    """

    metrics: ModelMetrics
    estimate: tuple[IdentifiedParameter, ...]
    effects: tuple[geometry_tables.GeometricEffect, ...]
    unseen: UnseenReport
    geometries: tuple[geometry_tables.TwoGeometries, ...] = ()


def read(folder: Path) -> DynamicReport:
    """Read the results of an identification and its validation from the folder of the identification.

    Raises:
        UsageError: if files are missing or were written by another version.
    """
    identification = IdentificationFolder(folder)
    effects_file = folder / geometry_tables.EFFECTS
    try:
        metrics = identification.metrics()
        estimate = read_estimate(folder, IdentifiedParameter)
        effects: tuple[geometry_tables.GeometricEffect, ...] = ()
        if effects_file.exists():
            effects = read_rows(geometry_tables.GeometricEffect, effects_file)
        geometries: tuple[geometry_tables.TwoGeometries, ...] = ()
        if (folder / geometry_tables.GEOMETRIES).exists():
            geometries = read_rows(geometry_tables.TwoGeometries, folder / geometry_tables.GEOMETRIES)
        return DynamicReport(metrics, estimate, effects, identification.judged, geometries)
    except (OSError, ValueError) as error:
        raise UsageError(f"{folder}: {error}; identify again: calib redo … identify") from error


def read_lines(inputs: IdentificationInputs) -> list[str]:
    """Return lines of text that list the robot and the recordings that were read.

    Args:
        inputs: robot and recordings of the identification.
    """
    chain = inputs.chain
    lines = [str(inputs.robot)]
    if isinstance(chain, Chain):
        geometry = "calibrated" if inputs.robot.moved else "nominal geometry"
        lines = [f"robot {chain.name}: {chain.n} joints, {chain.base} to {chain.tip}, {geometry}"]
    lines += [_recording_line(case, "for training") for case in inputs.cases]
    lines += [_recording_line(case, "unseen") for case in inputs.unseen]
    lines += [f"  {page.single_colons(note)}" for note in inputs.notes]
    return lines


def _recording_line(case: Case, role: str) -> str:
    """Return a line of text on a recording: name, duration, rate, kind of torque, payload, and use.

    Args:
        case: the recording.
        role: its use, such as ``unseen``.
    """
    motion = case.motion
    # a recording cut as log.npz@10: ends with a colon
    name = case.name.rstrip(":")
    load = ""
    if case.carried:
        load = f", carrying {', '.join(case.carried)}"
    return f"{name}: {case.duration:.1f} s at {motion.rate:.4g} Hz, {motion.kind}{load}, {role}"


def of_outcome(outcome: IdentificationOutcome, folder: Path | None = None) -> DynamicReport:
    """Return the report on an identification.

    Args:
        outcome: the identification.
        folder: folder of the identification, from which the parameters are read; None: the report has no parameters.
    """
    effects: Sequence[geometry_tables.GeometricEffect] = ()
    if outcome.carried is not None:
        effects = geometry_tables.effects(outcome.carried)
    estimate: tuple[IdentifiedParameter, ...] = ()
    if folder is not None:
        estimate = read_estimate(folder, IdentifiedParameter)
    unseen = UnseenReport.of(outcome.inputs, outcome)
    return DynamicReport(record_of(outcome), estimate, tuple(effects), unseen)


def outcome_section(outcome: IdentificationOutcome) -> page.Section:
    """Return the console output on an identification: the report section without figures and parameters.

    Args:
        outcome: the identification.
    """
    return report_section(of_outcome(outcome), {})


def report_section(
    report: DynamicReport,
    figures: Mapping[str, page.ChartPicture],
    exported: Sequence[str] = (),
    tolerance: float = 0.0,
    delivered: float | None = None,
    tests: Sequence[TorqueTest] = (),
) -> page.Section:
    """Return the report section on the dynamics: errors on held-out motion, torques, excitation, and parameters.

    Args:
        report: stored results of the identification.
        figures: figures by name (`dynamics_figures.captioned`); absent figures are left out of the section.
        exported: remarks on the export.
        tolerance: largest acceptable torque error on held-out motion [%]; 0: no tolerance.
        delivered: torque error of the exported robot on held-out motion [%]; None: unknown.
        tests: results of the computed-torque test; empty: no tolerances of joints are stated.
    """
    metrics, unseen = report.metrics, report.unseen
    blocks: list[page.Block] = [_error_table(unseen), _reference_table(unseen), _interval_table(unseen)]
    if tests:
        blocks.insert(0, _test_table(unseen, tests))

    torque_figures = [name for name in figures if name.startswith(("torque_", "velocity_"))]
    # each recording's velocities below its torques
    torque_figures.sort(key=lambda name: int(name.partition("_")[2]))
    blocks.append(page.pictures("", figures, ("errors", "residuals")))
    blocks.append(page.pictures("Torques", figures, torque_figures))
    blocks.append(page.pictures("Friction", figures, ("friction",)))
    blocks.append(page.pictures("Excitation", figures, ("excitation",)))

    if len(metrics.ladder) > 1:
        blocks.append(_friction_table(metrics))
    blocks.append(page.Text("The model", _model_sentences(metrics)))
    blocks.append(page.Text("What the motion identifies", _identifiability(report)))
    blocks += _joint_blocks(metrics.geometry_from_torques)
    blocks += _geometry_blocks(metrics, report.effects)
    blocks += _comparison_blocks(report.geometries)
    blocks.append(page.pictures("", figures, ("geometries", "geometry_effects")))
    blocks.append(page.pictures("Dynamic parameters", figures, ("significance",)))
    blocks.append(_parameter_table(report.estimate))

    if metrics.loop:
        blocks.append(page.Text("Closed loop", _loop_sentences(metrics.loop)))
    blocks += tracking_blocks(unseen.tracking, unseen.tracking_failure)
    blocks.append(page.Text("What was exported", exported))
    noticed = (*report.metrics.noticed, *report.unseen.noticed)
    blocks.append(page.Text("Notes on the dynamics", as_notes(warnings_of(report), noticed), "note"))
    key_figures = [*_key_figures(unseen, tolerance, delivered), *_test_figures(unseen, tests)]
    return page.Section("Dynamics", blocks, unseen.verdict, unseen.reason, key_figures)


def _test_table(unseen: UnseenReport, tests: Sequence[TorqueTest]) -> page.ReportTable:
    """Return the table of the computed-torque test: rms error of each torque row beside its tolerance.

    Args:
        unseen: report on the model's errors on held-out motion, which has the units of the rows.
        tests: results of the test.
    """
    answers = {True: "yes", False: "no", None: "not tested"}
    units = dict(zip(unseen.rows, unseen.units))
    rows = []
    for test in tests:
        rms = "–" if test.passed is None else f"{test.rms:.3g} {units[test.row]}"
        rows.append([test.row, rms, f"{test.tolerance:g} {units[test.row]}", answers[test.passed], test.recording])
    header = ("torque", "rms error", "tolerance", "within", "recording")
    return page.ReportTable("Computed-torque test on unseen motion", header, rows, numbers=[1, 2])


def _test_figures(unseen: UnseenReport, tests: Sequence[TorqueTest]) -> Iterator[page.KeyFigure]:
    """Yield the key figure of the computed-torque test: the torque nearest to its tolerance, or most above it.

    Args:
        unseen: report on the model's errors on held-out motion, which has the units of the rows.
        tests: results of the test; nothing is yielded without results.
    """
    tested = [test for test in tests if test.passed is not None]
    if not tested:
        return
    worst = max(tested, key=lambda test: test.rms / test.tolerance)
    unit = dict(zip(unseen.rows, unseen.units))[worst.row]
    name = f"rms torque error (identified model), {worst.row}"
    error, allowed = f"{worst.rms:.3g} {unit}", f"{worst.tolerance:g} {unit}"
    yield page.KeyFigure(name, "", error, "", worst.recording, allowed, page.met(worst.rms, worst.tolerance))


def _parameter_table(estimate: Sequence[IdentifiedParameter]) -> page.ReportTable:
    """Return the table of identified parameters with value, σ and relative standard deviation.

    Args:
        estimate: the parameters.
    """
    header = ("parameter", "unit", "value", "σ", "RSD", "contents")
    rows = []
    for parameter in estimate:
        sigma = "" if parameter.sigma is None else f"{parameter.sigma:.2g}"
        rsd = page.relative_sigma(parameter.rsd)
        expression = page.shortened(parameter.expression, EXPRESSION_LETTERS)
        rows.append([parameter.name, parameter.unit, f"{parameter.value:.4g}", sigma, rsd, expression])
    note = "R marks parameters that include others by regrouping; complete table: 8-dynamics/estimate.csv."
    return page.ReportTable("Identified parameters", header, rows, note, numbers=[2, 3, 4])


def warnings_of(report: DynamicReport) -> list[str]:
    """Return the warnings of identification and validation without duplicates.

    The warning that there is no held-out motion is omitted if the validation has such motion.

    Args:
        report: stored results of the identification.
    """
    refuted: list[str] = []
    if report.unseen.proofs:
        early = [finding for finding in report.metrics.noticed if finding.code == "no-unseen-motion"]
        refuted = lines_of(early)
    lines = dict.fromkeys((*report.metrics.warnings, *report.unseen.warnings))
    return [line for line in lines if line not in refuted]


def proof_of(unseen: UnseenReport) -> tuple[str, Score, str]:
    """Return name, score and kind of motion of the recording that decides the verdict.

    It is the held-out recording with the largest error; without held-out motion, the training recording with the
    largest error.

    Args:
        unseen: report on the model's errors.
    """
    scores, motion = unseen.fit, "the training motion"
    if unseen.proofs:
        scores, motion = unseen.proofs, "unseen motion"
    name = max(scores, key=lambda recording: scores[recording].judged.total)
    return name, scores[name], motion


def _key_figures(unseen: UnseenReport, tolerance: float, delivered: float | None) -> list[page.KeyFigure]:
    """Return the torque errors on which the verdict is based: those of the worst held-out recording.

    Args:
        unseen: report on the model's errors.
        tolerance: largest acceptable torque error [%]; 0: no tolerance.
        delivered: torque error of the exported robot [%]; None: unknown.
    """
    name, proof, _ = proof_of(unseen)
    count = len(unseen.proofs)
    basis = {0: "the training motion", 1: "1 unseen motion"}.get(count, f"worst of {count} unseen motions")

    spread = ""
    for curves in unseen.curves:
        if curves.name == name:
            if np.isfinite(curves.error_sigma):
                spread = f"± {curves.error_sigma:.2g} %"
            break

    error, in_band = "torque unexplained", "torque unexplained in the motion's band"
    if proof.stands:
        error += " in motion"
    # a tolerance is compared with the error in the band where most of the error is above it
    without_floor = proof.noisy or (tolerance > 0.0 and proof.floor_dominates)
    if without_floor:
        error += f" below {proof.band:.3g} Hz"
    model_error = proof.counted(without_floor).total
    identified = percent(model_error)
    allowed = f"{tolerance:g} %" if tolerance else "none"
    if delivered is None:
        met = page.met(model_error, tolerance)
        figures = [page.KeyFigure(error, "", identified, spread, basis, allowed, met)]
    else:
        # the exported robot is what is judged
        met = page.met(delivered, tolerance)
        figures = [
            page.KeyFigure(f"{error} (exported robot)", "", percent(delivered), "", basis, allowed, met),
            page.KeyFigure(f"{error} (identified model)", "", identified, spread, basis),
        ]
    if proof.stands:
        figures.append(page.KeyFigure("torque unexplained at rest", "", percent(proof.standing.total), "", basis))
    if without_floor:
        figures.append(page.KeyFigure("torque unexplained at all frequencies", "", percent(proof.raw.total), "", basis))
    figures.append(page.KeyFigure(in_band, "", percent(proof.filtered.total), "", basis))

    finite = [(share, row) for share, row in zip(proof.filtered.joints, unseen.rows) if np.isfinite(share)]
    worst, row = max(finite, default=(np.nan, "torque"))
    figures.append(page.KeyFigure(f"{in_band}, worst joint: {row}", "", percent(worst), "", basis))
    return figures


def percent(value: float) -> str:
    """Return a percentage `value` [%] with three significant digits as text; a dash if it is not finite."""
    return _number(value, " %")


def _rsd(percent: float) -> str:
    """Return a relative standard deviation [%] as text; "above 1000 %" for larger values."""
    return f"{percent:.0f} %" if percent < 1000.0 else "above 1000 %"


def _error_table(unseen: UnseenReport) -> page.ReportTable:
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


def _of_all(row: Sequence[str]) -> bool:
    return row[0] == "all"


def _reference_table(unseen: UnseenReport) -> page.ReportTable:
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


def _interval_table(unseen: UnseenReport) -> page.ReportTable:
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


def _friction_table(metrics: ModelMetrics) -> page.ReportTable:
    """Return the table of the tried friction models with their errors on held-out time, in total and by torque row.

    Args:
        metrics: metrics of the identification.
    """
    count = max(len(step.joints_percent) for step in metrics.ladder)
    joints = [str(j + 1) for j in range(count)]
    header = ["friction", "p", "total", *joints, "kept at joints"]
    rows = []
    strong = set()
    for k, step in enumerate(metrics.ladder):
        shares = [_rounded(share, 1) for share in step.joints_percent]
        shares += [""] * (count - len(shares))
        remark = ", ".join(map(str, step.kept_at_joints)) or step.note
        total = _rounded(step.cross_validated_percent, 2)
        rows.append([step.model, str(step.parameters), total, *shares, remark])
        if step.kept:
            strong.add(k)
    title = "Ladder of friction models: relative error on held-out time [%]"
    numbers = range(1, len(header) - 1)
    return page.ReportTable(title, header, rows, f"Chosen: {metrics.friction}.", frozenset(strong), list(numbers))


def _rounded(share: float, digits: int) -> str:
    return f"{share:.{digits}f}" if np.isfinite(share) else "–"


def _model_sentences(metrics: ModelMetrics) -> list[str]:
    """Return sentences on the model: ripple, couplings, method, number of parameters, and eliminated parameters.

    Args:
        metrics: metrics of the identification.
    """
    lines = [_ripple_sentence(ripple) for ripple in metrics.ripple]
    lines += _coupling_sentences(metrics)
    lines.append(f"method {metrics.method}: assumes that {metrics.method_assumes}")

    count, columns = metrics.parameters, metrics.counts
    base = count.standard - columns.without_effect - columns.regrouped
    raw = _condition(metrics.condition_number.raw)
    normalised = _condition(metrics.condition_number.normalised)
    lines.append(
        f"{count.standard} standard parameters: {columns.without_effect} without effect, {columns.regrouped} "
        f"regrouped, {base} base; {count.base - base} additional friction parameters; "
        f"condition {raw}, with unit columns {normalised}"
    )
    if metrics.elimination or count.essential < count.base:
        removed = []
        for step in metrics.elimination:
            rsd = f" ({_rsd(step.rsd)})" if np.isfinite(step.rsd) else ""
            removed.append(f"{step.name}{rsd}")
        names = ", ".join(removed) or "none"
        lines.append(f"{count.essential} essential parameters; removed, with their RSD: {names}")
    return lines


def _ripple_sentence(ripple: RippleWaves) -> str:
    """Return a sentence on a joint's torque ripple: its orders, and the share of the residual that it explains."""
    orders = []
    for wave in ripple.waves:
        gear = "" if wave.gear == ripple.joint else f" of joint {wave.gear}"
        orders.append(f"{wave.order_per_turn:g}{gear}")
    return (
        f"ripple at joint {ripple.joint}, orders {', '.join(orders)} per turn: explains "
        f"{100 * ripple.explained_share_on_unseen_blocks:.0f} % of the fast residual's power on held-out time blocks; "
        "not included in the covariance"
    )


def _condition(number: float) -> str:
    return f"{number:.0f}" if np.isfinite(number) else "infinite"


def _coupling_sentences(metrics: ModelMetrics) -> list[str]:
    """Return sentences on how much each coupling term between two joints lowers the errors of these joints.

    The physical cause of a coupling is not stated, since nobody measured it in the drives.

    Args:
        metrics: metrics of the identification.
    """
    lines: list[str] = []
    if not metrics.ladder:
        return lines
    before = metrics.ladder[0]
    for step in metrics.ladder:
        if step.model == "+ coupling":
            # the coupled joints are listed pair by pair
            joints = step.kept_at_joints
            for pair in zip(joints[::2], joints[1::2]):
                errors_before = " and ".join(f"{before.joints_percent[joint - 1]:.3g}" for joint in pair)
                errors_after = " and ".join(f"{step.joints_percent[joint - 1]:.3g}" for joint in pair)
                lines.append(
                    f"a coupling term between joints {pair[0]} and {pair[1]} lowers their errors on held-out rows "
                    f"from {errors_before} % to {errors_after} %"
                )
        if step.kept:
            before = step
    return lines


def _joint_blocks(jointly: GeometryFromTorquesMetrics | None) -> list[page.Block]:
    """Return what torques say about the geometry: the elements that they determine, before and after; empty: nothing.

    Args:
        jointly: geometry estimated together with the dynamics; None: not requested.
    """
    if jointly is None:
        return []
    determined = [change for change in jointly.elements if change.identified]
    resting = [change.element for change in jointly.elements if not change.identified]
    state = "the robot has the geometry from poses and torques" if jointly.delivered else "the geometry is unchanged"
    lines = [
        f"{state}: squared error of held-out torques {jointly.held_out:.4g} times that of the two stages",
        f"torques determine {jointly.combinations} combinations of {len(jointly.elements)} elements; offsets of the "
        "first and the last joint are not identifiable",
    ]
    poses = jointly.poses
    if poses is not None:
        lines.append(
            f"{poses.poses} held-out poses of the fit: {1e3 * poses.before:.4f} mm rms before the torques, "
            f"{1e3 * poses.after:.4f} mm after"
        )
    if resting:
        lines.append(f"determined by poses or their prior rather than by torques: {listing(resting, 8)}")
    rows = []
    for change in determined:
        before = f"{1e3 * change.sigma_before:.3g}"
        after = f"{1e3 * change.sigma_after:.3g}"
        shift = f"{1e3 * change.change:+.3g}"
        sigmas = f"{change.change / change.sigma_after:+.2g}"
        rows.append([change.element, f"m{change.unit}", shift, before, after, sigmas])
    blocks: list[page.Block] = [page.Text("Geometry from torques", lines)]
    if rows:
        header = ("element", "unit", "change", "σ before", "σ after", "change / σ after")
        blocks.append(page.ReportTable("Elements that torques determine", header, rows, numbers=[2, 3, 4, 5]))
    return blocks


def _geometry_blocks(metrics: ModelMetrics, effects: Sequence[geometry_tables.GeometricEffect]) -> list[page.Block]:
    """Return the summary of how geometric errors affect the dynamic parameters, and a table of the largest effects."""
    geometry = metrics.geometry
    if geometry is None:
        return []
    lines = [geometry.summary]
    tilt = geometry.moved_by_1_mrad_of_tilt
    jointly = metrics.geometry_from_torques
    includes_tilt = jointly is not None and jointly.delivered
    if geometry.propagated and not includes_tilt and tilt.sigmas > geometry_tables.MIN_SHIFT:
        lines.append(
            f"a tilt of the base is not included: 1 mrad against gravity would change {tilt.parameter} by "
            f"{tilt.sigmas:.2g} of its sigma of torque noise"
        )
    blocks: list[page.Block] = [page.Text("Geometry and dynamics", lines)]
    relevant = [effect for effect in effects if effect.matters == "yes"]
    if geometry.changed and relevant:
        blocks.append(_effect_table(relevant[:MAX_EFFECTS]))
    return blocks


def _comparison_blocks(rows: Sequence[geometry_tables.TwoGeometries]) -> list[page.Block]:
    """Return the table of the parameters that the calibrated geometry changes most, in σ; empty for one geometry."""
    if not rows:
        return []
    with_sigma = [row for row in rows if row.sigma_calibrated > 0.0]
    changes = np.array([(row.calibrated - row.nominal) / row.sigma_calibrated for row in with_sigma])
    table = []
    for k in np.argsort(-np.abs(changes), kind="stable")[:MAX_EFFECTS]:
        row = with_sigma[k]
        nominal = f"{row.nominal:.4g} ± {row.sigma_nominal:.2g}"
        calibrated = f"{row.calibrated:.4g} ± {row.sigma_calibrated:.2g}"
        table.append([row.name, row.unit, nominal, calibrated, f"{changes[k]:.2g} σ", row.essential])
    count = int(np.sum(np.abs(changes) > SIGNIFICANT))
    note = (
        f"{count} of {len(rows)} parameters change by more than {SIGNIFICANT:g} σ between the nominal and the "
        "calibrated geometry, identified from the same torques; all: geometries.csv."
    )
    header = ("parameter", "unit", "nominal geometry", "calibrated geometry", "change", "essential")
    title = "What the calibrated geometry changed in the dynamics"
    return [page.ReportTable(title, header, table, note, numbers=[2, 3, 4])]


def _effect_table(effects: Sequence[geometry_tables.GeometricEffect]) -> page.ReportTable:
    """Return the table of geometric errors, with the parameter that each shifts most, and the effect on the torque."""
    header = (
        "geometric error",
        "sigma",
        "moves most",
        "shift [its σ of torque noise]",
        "parameters moved",
        "torque rms [N m]",
    )
    rows = []
    for effect in effects:
        sigma = small(effect.sigma or 0.0, effect.unit)
        shift, count = f"{effect.shift_sigma:.2f}", str(effect.parameters_moved)
        torque = f"{effect.torque_rms or 0.0:.2g}"
        rows.append([effect.element, sigma, effect.parameter, shift, count, torque])
    return page.ReportTable("Which geometric errors matter for the dynamics", header, rows, numbers=[1, 3, 4, 5])


def _loop_sentences(loop: LoopMetrics) -> list[str]:
    """Return sentences on the closed-loop simulation, and on the bias of least squares that it reveals."""
    lines = list(loop.notes)
    test = loop.durbin_wu_hausman
    if test is None:
        return lines

    subject = ""
    if loop.beside:
        subject = f"results of the test of least squares by {loop.instruments}, not of this estimate: "
    lines.append(
        f"{subject}closed loop simulated, {loop.rounds} rounds; difference of simulated and recorded motion "
        f"{_joints(loop.distance_percent)} %, torque {_joints(loop.simulated_torque_error_percent)} %"
    )
    strength = "weak" if loop.instruments_weak else "strong"
    lines.append(
        f"instruments: full rank, Cragg-Donald {_number(loop.cragg_donald)} ({strength}), smallest explained share "
        f"of a column {100 * loop.least_partial_r2:.3g} %"
    )

    if not loop.explains:
        result = "no result, since the simulated loop explains less of the torque than the model"
    elif not test.least_squares_biased:
        result = "no bias of least squares is detected"
    elif loop.largest_shift_sigma < MAX_SHIFT_SIGMAS:
        result = "least squares is biased, significantly but slightly"
    else:
        result = "least squares is biased"
    if not loop.valid:
        result += ", but the instruments are unreliable"
    p = f"p = {test.p:.2g}" if test.p > 0.0 else "p < 1e-300"
    degrees = ", ".join(f"{degree:g}" for degree in test.degrees)
    lines.append(
        f"Durbin-Wu-Hausman: F({degrees}) = {_number(test.statistic)}, {p}: {result}; largest shift "
        f"{loop.largest_shift_sigma:.3g} sigma"
    )
    return lines


def _joints(shares: np.ndarray) -> str:
    return " ".join(map(_number, shares))


def _number(value: float, unit: str = "") -> str:
    return f"{value:.3g}{unit}" if np.isfinite(value) else "–"


def tracking_blocks(replays: Mapping[str, Replay], failure: str = "") -> list[page.Block]:
    """Return tables and texts on simulated tracking errors with the model as feedforward.

    Args:
        replays: name of a recording -> simulated tracking.
        failure: reason why no tracking was simulated; empty: none.
    """
    if failure:
        line = f"tracking with the model as feedforward was not simulated:  {failure}"
        return [page.Text("Tracking, simulated", [line])]
    if not replays:
        return []

    groups = {}
    for name, replay in replays.items():
        rows = []
        for key, rms in replay.rms.items():
            errors = map(_number, 1e3 * rms)
            rows.append((FED_FORWARD[key], *errors))
        groups[name] = rows

    first = next(iter(replays.values()))
    lines = []
    gain = f": feedforward of the model reduces the tracking error by a factor of {first.feedback_over_model:.3g}"
    if first.inertia_added.any():
        inertia = " ".join(f"{added:.2g}" for added in first.inertia_added)
        lines.append(
            f"the identified model is physically inconsistent: simulation adds motor inertia, {inertia} kg m² (kg); "
            "compare only the rows with each other"
        )
        gain = ""
    control = f"a PD of {FREQUENCY:g} Hz, damping {DAMPING:g} (our default)"
    if first.stated:
        control = "the controller of [loop]"
    motion = "unseen motion" if first.unseen else "the training motion, which gives too small errors"
    lines.append(f"the simulated robot is the identified model plus the unexplained torque; {control}; {motion}{gain}")

    title = "Tracking, simulated: rms of q - reference [mrad or mm]"
    joints = [str(j + 1) for j in range(len(first.inertia_added))]
    return [page.grouped(title, ("fed forward", *joints), groups), page.Text("", lines)]


def _identifiability(report: DynamicReport) -> list[str]:
    """Return sentences on parameters that are not distinguishable from zero, and on whether the residuals are white.

    Args:
        report: stored results of the identification.
    """
    lines = []
    weak = [row.name for row in report.estimate if row.rsd is not None and row.rsd > MAX_RSD]
    if weak:
        lines.append(f"Not distinguishable from zero (σ above half the value): {', '.join(weak)}.")

    _, proof, motion = proof_of(report.unseen)
    coloured = []
    for row, whiteness in zip(report.unseen.rows, proof.whiteness):
        if whiteness and whiteness.outside > WHITE:
            coloured.append(row)
    if coloured:
        lines.append(
            f"The residual on {motion} is not white in {', '.join(coloured)}: it contains unmodelled effects, "
            "so that σ is too small there."
        )
    elif any(proof.whiteness):
        lines.append(f"The residual on {motion} cannot be distinguished from white noise.")
    return lines

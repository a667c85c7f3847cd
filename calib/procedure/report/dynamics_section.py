"""The report section on the dynamics, which is also the console output of an identification."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib.errors import UsageError
from calib.folders import read_estimate
from calib.identification.prediction import Score
from calib.identification.rows import Case
from calib.procedure.dynamic_stage import geometry_tables
from calib.procedure.dynamic_stage.computed_torque import TorqueTest
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.metrics import ModelMetrics, UnseenReport
from calib.procedure.dynamic_stage.metrics import metrics as record_of
from calib.procedure.findings import as_notes, lines_of
from calib.procedure.report import dynamics_errors, dynamics_geometry, dynamics_loop, dynamics_model, page
from calib.procedure.report.dynamics_errors import percent
from calib.records import read_rows
from calib.robot.chain import Chain

# RSD [%] from which on a parameter cannot be distinguished from zero: two sigmas
MAX_RSD = 50.0
# letters of a parameter's expression that are printed
EXPRESSION_LETTERS = 46
# share of autocorrelations beyond the bound below which a residual may be called white (0.05 if it is)
WHITE = 0.10


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
    blocks: list[page.Block] = [
        dynamics_errors.error_table(unseen),
        dynamics_errors.reference_table(unseen),
        dynamics_errors.interval_table(unseen),
    ]
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
        blocks.append(dynamics_model.friction_table(metrics))
    blocks.append(page.Text("The model", dynamics_model.model_sentences(metrics)))
    blocks.append(page.Text("What the motion identifies", _identifiability(report)))
    blocks += dynamics_geometry.joint_blocks(metrics.geometry_from_torques)
    blocks += dynamics_geometry.geometry_blocks(metrics, report.effects)
    blocks += dynamics_geometry.comparison_blocks(report.geometries)
    blocks.append(page.pictures("", figures, ("geometries", "geometry_effects")))
    blocks.append(page.pictures("Dynamic parameters", figures, ("significance",)))
    blocks.append(_parameter_table(report.estimate))

    if metrics.loop:
        blocks.append(page.Text("Closed loop", dynamics_loop.loop_sentences(metrics.loop)))
    blocks += dynamics_loop.tracking_blocks(unseen.tracking, unseen.tracking_failure)
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

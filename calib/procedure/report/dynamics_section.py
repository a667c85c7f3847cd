"""The dynamics section of reports, for the console output of an identification and for its report."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from calib.errors import UsageError
from calib.folders import read_estimate
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
from calib.procedure.dynamic_stage import geometry_tables
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.metrics import ModelMetrics, UnseenReport
from calib.procedure.dynamic_stage.metrics import metrics as record_of
from calib.procedure.findings import lines_of
from calib.procedure.report import page
from calib.records import read_rows
from calib.robot.chain import Chain
from calib.units import small

MAX_RSD = 50.0  # RSD [%] from which on a parameter is not told from zero: two sigmas
WORDS = 46  # letters of what a parameter holds that are printed
SHOWN = 8  # geometric errors listed
WHITE = 0.10  # share of autocorrelations beyond the bound below which a residual may be called white (0.05 if it is)
ERROR_NOTE = (
    "Of limit: of the torque that the robot's description allows. "
    "Error: 100 ‖τ - τ̂‖ / ‖τ‖ of the torque as recorded; in band: both low-passed to the band of the motion; moving, "
    "standing: as recorded, where the joint moves or stands. Torque above that band (noise, ripple) is explained "
    "by no model of q, v, a. ACF outside: share of the residual's autocorrelations beyond the 95 % bounds of "
    "white noise; 5 % if it is white."
)
EFFECTS = (
    page.Column("geometric error", "{0.element}", number=False),
    page.Column("sigma", lambda one: small(one.sigma, one.unit)),
    page.Column("moves most", "{0.parameter}", number=False),
    page.Column("shift [its σ of torque noise]", "{0.shift_sigma:.2f}"),
    page.Column("parameters moved", "{0.parameters_moved}"),
    page.Column("torque rms [N m]", lambda one: f"{one.torque_rms or 0.0:.2g}"),
)
PARAMETERS = (
    page.Column("parameter", "{0.name}", number=False),
    page.Column("unit", "{0.unit}", number=False),
    page.Column("value", "{0.value:.4g}"),
    page.Column("σ", lambda row: "" if row.sigma is None else f"{row.sigma:.2g}"),
    page.Column("RSD", lambda row: page.relative_sigma(row.rsd)),
    page.Column("what it holds", lambda row: page.shortened(row.expression, WORDS), number=False),
)
FED_FORWARD = {
    FEEDBACK: "feedback alone",
    CAD: "CAD fed forward",
    IDENTIFIED: "model fed forward",
    FLOOR: "measured torque fed forward",
}


class IdentifiedParameter(NamedTuple):
    """A row of ``estimate.csv``; RSD in percent; σ is None if not measured."""

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
        metrics: of the identification.
        estimate: the parameters.
        effects: what the geometry's errors do to them; none where the geometry is taken as exact.
        unseen: the model on unseen motion, with the verdict.
    """

    metrics: ModelMetrics
    estimate: tuple[IdentifiedParameter, ...]
    effects: tuple[geometry_tables.GeometricEffect, ...]
    unseen: UnseenReport


_UNSEEN: WeakKeyDictionary[IdentificationOutcome, UnseenReport] = WeakKeyDictionary()  # for console and folder


def read(folder: Path) -> DynamicReport:
    """Read the results of the steps identify and predict.

    Raises:
        UsageError: if it is missing or made by another version.
    """
    effects = folder / geometry_tables.EFFECTS
    try:
        place = IdentificationFolder(folder)
        return DynamicReport(
            place.metrics(),
            read_estimate(folder, IdentifiedParameter),
            read_rows(geometry_tables.GeometricEffect, effects) if effects.exists() else (),
            place.judged,
        )
    except (OSError, ValueError) as error:
        raise UsageError(f"{folder}: {error}; identify again: calib redo … identify") from error


def read_lines(inputs: IdentificationInputs) -> list[str]:
    """Return lines on the robot and the recordings, as read."""
    chain = inputs.chain
    lines = [str(inputs.robot)]
    if isinstance(chain, Chain):
        how = "calibrated" if inputs.robot.moved else "nominal geometry"
        lines = [f"robot {chain.name}: {chain.n} joints, {chain.base} to {chain.tip}, {how}"]
    for case in (*inputs.cases, *inputs.unseen):
        motion = case.motion
        role = "unseen" if any(case is other for other in inputs.unseen) else "to learn from"
        load = f", carrying {', '.join(case.carried)}" if case.carried else ""
        lines.append(
            f"{case.name.rstrip(':')}: {case.duration:.1f} s at {motion.rate:.4g} Hz, {motion.kind}{load}, {role}"
        )
    return [*lines, *(f"  {note}".replace(":: ", ": ") for note in inputs.notes)]


def of_outcome(outcome: IdentificationOutcome, folder: Path | None = None) -> DynamicReport:
    """Return the report of an identification.

    Args:
        folder: written for it, of which its parameters are read; None: without them.
    """
    effects = () if outcome.carried is None else geometry_tables.effects(outcome.carried)
    estimate = () if folder is None else read_estimate(folder, IdentifiedParameter)
    if outcome not in _UNSEEN:
        _UNSEEN[outcome] = UnseenReport.of(outcome.inputs, outcome)
    return DynamicReport(record_of(outcome), estimate, tuple(effects), _UNSEEN[outcome])


def outcome_section(outcome: IdentificationOutcome) -> page.Section:
    """Return the console's section on an identification: that of its report, without figures and parameters."""
    return report_section(of_outcome(outcome), {})


def report_section(
    found: DynamicReport,
    drawn: Mapping[str, page.Picture],
    exported: Sequence[str] = (),
    tolerance: float = 0.0,
    delivered: float | None = None,
) -> page.Section:
    """Return the section of a report: errors on unseen motion, torques, excitation, and parameters.

    Args:
        drawn: figures by name (`dynamics_figures.captioned`); those that are not there are left out.
        exported: what the export had to say.
        tolerance: largest error of the torque on unseen motion that is good enough [%]; 0: none.
        delivered: error of the exported robot there [%]; None where it is not known.
    """
    metrics, unseen = found.metrics, found.unseen
    blocks: list[page.Block] = [_error_table(unseen), _reference_table(unseen), _interval_table(unseen)]
    recorded = [name for name in drawn if name.startswith("torque_")]
    blocks += [page.pictures("", drawn, ("errors", "residuals")), page.pictures("Torques", drawn, recorded)]
    blocks.append(page.pictures("Excitation", drawn, ("excitation",)))
    if len(metrics.ladder) > 1:
        blocks.append(_friction_table(metrics))
    blocks.append(page.Text("The model", _model_sentences(metrics)))
    blocks.append(page.Text("What the motion identifies", _identifiability(found)))
    blocks += [*_geometry_blocks(metrics, found.effects), page.pictures("", drawn, ("geometries", "geometry_effects"))]
    note = "R marks parameters that include others by regrouping; complete table: 8-dynamics/estimate.csv."
    blocks.append(page.pictures("Dynamic parameters", drawn, ("significance",)))
    blocks.append(page.table("Identified parameters", PARAMETERS, found.estimate, note))
    if metrics.loop:
        blocks.append(page.Text("Closed loop", _loop_sentences(metrics.loop)))
    blocks += tracking_blocks(unseen.tracking, unseen.tracking_failure)
    blocks += [page.Text("What was exported", exported), page.Text("Notes on the dynamics", warnings_of(found), "note")]
    return page.Section("Dynamics", blocks, unseen.verdict, unseen.reason, _key_figures(unseen, tolerance, delivered))


def warnings_of(found: DynamicReport) -> list[str]:
    """Return what was noticed by identification and validation, each once, and nothing that validation refuted."""
    early = [one for one in found.metrics.noticed if one.code == "no-unseen-motion" and found.unseen.proofs]
    lines = dict.fromkeys((*found.metrics.warnings, *found.unseen.warnings))
    return [line for line in lines if line not in lines_of(early)]


def proof_of(unseen: UnseenReport) -> tuple[str, Score, str]:
    """Return name, errors and kind of motion of the deciding recording: the worst unseen one, else the fitted one."""
    where = "unseen motion" if unseen.proofs else "the training motion"
    sets = unseen.proofs or unseen.fit
    name, found = max(sets.items(), key=lambda item: item[1].judged.total)
    return name, found, where


def _key_figures(unseen: UnseenReport, tolerance: float, delivered: float | None) -> list[page.KeyFigure]:
    """Return the torque errors that decide the verdict: those of the worst unseen recording."""
    name, proof, _ = proof_of(unseen)
    count = len(unseen.proofs)
    basis = {0: "the training motion", 1: "1 unseen motion"}.get(count, f"worst of {count} unseen motions")
    sigma = next((one.error_sigma for one in unseen.curves if one.name == name), np.nan)
    spread = f"± {sigma:.2g} %" if np.isfinite(sigma) else ""
    shares = ((x, row) for x, row in zip(proof.filtered.joints, unseen.rows) if np.isfinite(x))
    worst, row = max(shares, default=(np.nan, "torque"))
    left = proof.judged.total if delivered is None else delivered
    asked = {"allowed": f"{tolerance:g} %" if tolerance else "none", "met": page.met(left, tolerance)}
    error, in_band = "torque unexplained", "torque unexplained in the motion's band"
    if proof.stands:
        error += " in motion"
    figures = [page.KeyFigure(error, "", percent(proof.judged.total), spread, basis, **asked)]
    if delivered is not None:
        figures = [
            page.KeyFigure(f"{error} (exported robot)", "", percent(delivered), "", basis, **asked),
            page.KeyFigure(f"{error} (identified model)", "", percent(proof.judged.total), spread, basis),
        ]
    if proof.stands:
        figures.append(page.KeyFigure("torque unexplained at rest", "", percent(proof.standing.total), "", basis))
    return [
        *figures,
        page.KeyFigure(in_band, "", percent(proof.filtered.total), "", basis),
        page.KeyFigure(f"{in_band}, worst joint: {row}", "", percent(worst), "", basis),
    ]


def percent(value: float) -> str:
    """Return a percentage with three digits as text; a dash if not finite."""
    return _number(value, " %")


def _rsd(percent: float) -> str:
    """Return an RSD [%] as text; "above 1000 %" if larger."""
    return f"{percent:.0f} %" if percent < 1000.0 else "above 1000 %"


def _error_table(unseen: UnseenReport) -> page.Table:
    """Return the table of torque errors, per row and recording."""
    sets = {f"{name} (fitted)": one for name, one in unseen.fit.items()}
    for name, one in unseen.validation.items():
        sets[f"{name} ({'unseen' if one.evidence else 'repeat: no evidence'})"] = one
    groups = {label: _error_rows(one, unseen) for label, one in sets.items()}
    header = (
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
    return page.grouped("Torque errors", header, groups, ERROR_NOTE, _of_all)


def _reference_table(unseen: UnseenReport) -> page.Table:
    """Return the table of errors of plain references on held-out motion beside the model's; may be empty."""
    columns = [
        page.Column("recording", "{0[0]}", number=False),
        page.Column("nominal masses, no friction", lambda row: percent(row[1].nominal)),
        page.Column("plain least squares", lambda row: percent(row[1].plain)),
        page.Column("this model", lambda row: percent(row[1].delivered)),
    ]
    note = (
        "Plain least squares: weighted, base parameters with Coulomb and viscous friction and offsets, no prior, no "
        "selection, truncated at the data's rank. In motion, where joints stand for more than 5 % of the recording."
    )
    title = "Beside plain references: torque unexplained on held-out motion"
    return page.table(title, columns, list(unseen.references.items()), note)


def _error_rows(one: Score, unseen: UnseenReport) -> Iterator[Sequence[str]]:
    parts = one.raw, one.filtered, one.moving, one.standing
    yield "all", "", "", *(percent(part.total) for part in parts), "", ""
    for j, (row, white) in enumerate(zip(unseen.rows, one.whiteness)):
        yield (
            row,
            *rms_words(one, unseen, j),
            *(percent(part.joints[j]) for part in parts),
            percent(one.above_band_percent[j]),
            "" if white is None else f"{100 * white.outside:.0f} %",
        )


def rms_words(one: Score, unseen: UnseenReport, row: int) -> tuple[str, str]:
    """Return the rms error of a torque row in its unit, and in per cent of its limit; "–" where that is not known."""
    rms, limit = one.raw.rms[row], np.inf if unseen.limits is None else unseen.limits[row]
    share = percent(100.0 * rms / limit) if np.isfinite(limit) else "–"
    return (f"{rms:.3g} {unseen.units[row]}", share) if np.isfinite(rms) else ("–", "–")


def _of_all(row: Sequence[str]) -> bool:
    return row[0] == "all"


def _interval_table(unseen: UnseenReport) -> page.Table:
    """Return the table of the coverage of predicted 95 % intervals, per row of unseen recordings; may be empty."""
    groups = {}
    for name, one in unseen.validation.items():
        if (found := one.interval95) is not None:
            at_rest = np.resize(found.median_at_rest, len(unseen.rows)) if len(found.median_at_rest) else None
            groups[name] = [("all", f"{found.coverage_percent:.1f} %", "", "", f"{found.extrapolated_percent:.0f} %")]
            for k, (row, unit) in enumerate(zip(unseen.rows, unseen.units)):
                resting = "–" if at_rest is None or not np.isfinite(at_rest[k]) else f"± {at_rest[k]:.3g} {unit}"
                inside, half = f"{found.joints_percent[k]:.0f} %", f"± {found.median[k]:.3g} {unit}"
                groups[name].append((row, inside, half, resting, ""))
    header = (
        "torque",
        "errors within the 95 % interval",
        "median interval in motion",
        "at rest",
        "of the time extrapolated",
    )
    return page.grouped("Intervals stated", header, groups, strong=_of_all)


def _friction_table(metrics: ModelMetrics) -> page.Table:
    """Return the table of friction models with their errors on held-out time, for all rows and for each row."""

    def shown(shares: Iterable[float], digits: int) -> str:
        return "".join(f"{x:.{digits}f}" if np.isfinite(x) else "–" for x in shares)

    count = max(len(step.joints_percent) for step in metrics.ladder)
    columns = [
        page.Column("friction", "{0.model}", number=False),
        page.Column("p", "{0.parameters}"),
        page.Column("total", lambda step: shown([step.cross_validated_percent], 2)),
        *(page.Column(str(j + 1), lambda step, j=j: shown(step.joints_percent[j : j + 1], 1)) for j in range(count)),
        page.Column("kept at joints", lambda step: ", ".join(map(str, step.kept_at_joints)) or step.note, number=False),
    ]
    title = "Ladder of friction models: relative error on held-out time [%]"
    return page.table(title, columns, metrics.ladder, f"Chosen: {metrics.friction}.", lambda step: step.kept)


def _model_sentences(metrics: ModelMetrics) -> list[str]:
    """Return sentences on the model: number of parameters, method, and eliminated parameters."""
    lines = []
    for one in metrics.ripple:
        others = ("" if wave.gear == one.joint else f" of joint {wave.gear}" for wave in one.waves)
        waves = (f"{wave.order_per_turn:g}{other}" for wave, other in zip(one.waves, others))
        lines.append(
            f"ripple at joint {one.joint}, orders {', '.join(waves)} per turn: explains "
            f"{100 * one.explained_share_on_unseen_blocks:.0f} % of the fast residual's power on held-out time blocks; "
            "not included in the covariance"
        )
    lines += _coupling_sentences(metrics)
    lines.append(f"method {metrics.method}: assumes that {metrics.method_assumes}")
    count, columns = metrics.parameters, metrics.counts
    base = count.standard - columns.without_effect - columns.regrouped
    raw, normalised = metrics.condition_number.raw, metrics.condition_number.normalised
    condition = ", with unit columns ".join(f"{x:.0f}" if np.isfinite(x) else "infinite" for x in (raw, normalised))
    lines.append(
        f"{count.standard} standard parameters: {columns.without_effect} without effect, {columns.regrouped} "
        f"regrouped, {base} base; {count.base - base} additional friction parameters; condition {condition}"
    )
    if metrics.elimination or count.essential < count.base:
        gone = ", ".join(
            f"{one.name} ({_rsd(one.rsd)})" if np.isfinite(one.rsd) else one.name for one in metrics.elimination
        )
        lines.append(f"{count.essential} essential parameters; removed, with their RSD: {gone or 'none'}")
    return lines


def _coupling_sentences(metrics: ModelMetrics) -> list[str]:
    """Return what coupling terms do to the errors of their joints: what they are in the drives nobody measured."""
    lines = []
    before = metrics.ladder[0] if metrics.ladder else None
    for step in metrics.ladder:
        if step.model == "+ coupling" and before is not None:
            at = step.kept_at_joints
            for i, j in zip(at[::2], at[1::2]):
                old = " and ".join(f"{before.joints_percent[joint - 1]:.3g}" for joint in (i, j))
                new = " and ".join(f"{step.joints_percent[joint - 1]:.3g}" for joint in (i, j))
                lines.append(
                    f"a coupling term between joints {i} and {j} lowers their errors on held-out rows from {old} % to "
                    f"{new} %"
                )
        before = step if step.kept else before
    return lines


def _geometry_blocks(metrics: ModelMetrics, effects: Sequence[geometry_tables.GeometricEffect]) -> list[page.Block]:
    """Return the blocks on the effect of geometric errors on the dynamics: summary, and the largest effects."""
    found = metrics.geometry
    if found is None:
        return []
    lines, tilt = [found.summary], found.moved_by_1_mrad_of_tilt
    if found.propagated and tilt.sigmas > geometry_tables.MIN_SHIFT:
        lines.append(
            f"a tilt of the base is not included: 1 mrad against gravity would change {tilt.parameter} by "
            f"{tilt.sigmas:.2g} of its sigma of torque noise"
        )
    known = [one for one in effects if one.matters == "yes"]
    blocks: list[page.Block] = [page.Text("Geometry and dynamics", lines)]
    if found.changed and known:
        blocks.append(page.table("Which geometric errors matter for the dynamics", EFFECTS, known[:SHOWN]))
    return blocks


def _loop_sentences(loop: LoopMetrics) -> list[str]:
    """Return sentences on the closed-loop simulation, and on the bias of least squares."""
    lines, test = list(loop.notes), loop.durbin_wu_hausman
    if test is None:
        return lines
    whose = f"results of the test of least squares by {loop.instruments}, not of this estimate: " if loop.beside else ""
    lines.append(
        f"{whose}closed loop simulated, {loop.rounds} rounds; difference of simulated and recorded motion "
        f"{_joints(loop.distance_percent)} %, torque {_joints(loop.simulated_torque_error_percent)} %"
    )
    strength = "weak" if loop.instruments_weak else "strong"
    lines.append(
        f"instruments: full rank, Cragg-Donald {_number(loop.cragg_donald)} ({strength}), smallest explained share "
        f"of a column {100 * loop.least_partial_r2:.3g} %"
    )
    said = "no bias of least squares is detected"
    if test.least_squares_biased:
        little = loop.largest_shift_sigma < MAX_SHIFT_SIGMAS
        said = "least squares is biased, significantly but slightly" if little else "least squares is biased"
    if not loop.explains:
        said = "no result, since the simulated loop explains less of the torque than the model"
    if not loop.valid:
        said += ", but the instruments are unreliable"
    p = f"p = {test.p:.2g}" if test.p > 0.0 else "p < 1e-300"
    degrees = ", ".join(f"{one:g}" for one in test.degrees)
    lines.append(
        f"Durbin-Wu-Hausman: F({degrees}) = {_number(test.statistic)}, {p}: {said}; largest shift "
        f"{loop.largest_shift_sigma:.3g} sigma"
    )
    return lines


def _joints(shares: np.ndarray) -> str:
    return " ".join(map(_number, shares))


def _number(value: float, unit: str = "") -> str:
    return f"{value:.3g}{unit}" if np.isfinite(value) else "–"


def tracking_blocks(replays: Mapping[str, Replay], failure: str = "") -> list[page.Block]:
    """Return the blocks on the simulated tracking errors with the model as feedforward."""
    if failure:
        why = f"tracking with the model as feedforward was not simulated:  {failure}"
        return [page.Text("Tracking, simulated", [why])]
    if not replays:
        return []
    first = next(iter(replays.values()))
    groups = {
        name: [(FED_FORWARD[key], *map(_number, 1e3 * rms)) for key, rms in one.rms.items()]
        for name, one in replays.items()
    }
    joints = [str(j + 1) for j in range(len(first.inertia_added))]
    lines = []
    gain = f": feedforward of the model reduces the tracking error by a factor of {first.feedback_over_model:.3g}"
    if first.inertia_added.any():
        shown = " ".join(f"{x:.2g}" for x in first.inertia_added)
        lines.append(
            f"the identified model is physically inconsistent: simulation adds motor inertia, {shown} kg m² (kg); "
            "compare only the rows with each other"
        )
        gain = ""
    default = f"a PD of {FREQUENCY:g} Hz, damping {DAMPING:g} (our default)"
    control = "the controller of [loop]" if first.stated else default
    motion = "unseen motion" if first.unseen else "the training motion, which gives too small errors"
    lines.append(f"the simulated robot is the identified model plus the unexplained torque; {control}; {motion}{gain}")
    title = "Tracking, simulated: rms of q - reference [mrad or mm]"
    return [page.grouped(title, ("fed forward", *joints), groups), page.Text("", lines)]


def _identifiability(found: DynamicReport) -> list[str]:
    """Return sentences on the parameters that the motion identifies, and on the residuals."""
    lines = []
    weak = [row.name for row in found.estimate if row.rsd is not None and row.rsd > MAX_RSD]
    if weak:
        lines.append(f"Not distinguishable from zero (σ above half the value): {', '.join(weak)}.")
    _, proof, where = proof_of(found.unseen)
    coloured = [row for row, white in zip(found.unseen.rows, proof.whiteness) if white and white.outside > WHITE]
    if coloured:
        lines.append(
            f"The residual on {where} is not white in {', '.join(coloured)}: it contains unmodelled effects, "
            "so that σ is too small there."
        )
    elif any(proof.whiteness):
        lines.append(f"The residual on {where} cannot be distinguished from white noise.")
    return lines

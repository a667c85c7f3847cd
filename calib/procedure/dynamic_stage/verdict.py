"""Verdict on an identified model; its limits and sentences are in the catalogue, chapters 9 to 11.

The verdict of calib identify (exit code 0 for pass and marginal, 1 for fail) judges the raw total of the worst
validation recording in which the robot moves and which does not repeat the training (of joints in motion, where some
stand: what friction is at rest no model knows), beside the training's own error in its band; then every joint in the
band, and while it moves. `calib explain torque-unexplained` prints the limits, and so on for each code of chapter 11.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.signals.persistency import ExcitationReport
from calib.dynamics.regressor_model import RegressorModel
from calib.errors import Finding, finding
from calib.identification.identify import Identification
from calib.identification.prediction import Score
from calib.identification.rows import Case
from calib.identification.uncertainty.torque_errors import COVERED, TorqueIntervals
from calib.procedure.findings import Verdict, limit, lines_of, sentence, settle
from calib.robot.chain import Chain

# of a joint's range by which a recording may leave it: encoders and limits of a CAD are not exact
BEYOND = 0.05
# share of moving rows below which a recording is no motion
MOVES = 0.1
# rms of link minus motor position that shows elasticity [rad or m]
BEND = 1e-4
# sigmas below zero from which on a drive's inertia or friction is called negative
SURELY = 2.0
# sigmas from which on a payload's identified mass differs from zero, or from its stated mass (our choice)
SURELY_ABSENT = 3.0
# neighbouring rows that count as one from which on a residual is unmodelled dynamics, not noise
MAX_CORRELATED_ROWS = 3.0
# of all training files together [s] (our choice)
MIN_MOTION = 3.0
# share of the greatest joint's rms torque from which on a joint's torque matters
MATTERS = 0.1
# of the errors within intervals that state 0.95, of all joints and of one: it may be missed twice as often (our choice)
MIN_COVERED = 0.93
MIN_COVERED_AT_JOINT = 0.90
# sigmas of chance by which a coverage may be lower
CHANCE_SIGMAS = 3.0


@dataclass(frozen=True)
class Resting:
    """Base parameters whose values are determined by a prior, not by the motion.

    Attributes:
        names: names of these parameters.
        of: number of all base parameters.
        source: source of the prior: ``cad`` or ``sizes``; empty without a prior.
    """

    names: tuple[str, ...] = ()
    of: int = 0
    source: str = ""

    @property
    def origin(self) -> str:
        """Source of the prior's values, as text."""
        return "CAD values" if self.source == "cad" else "typical magnitudes of such parameters"


def judge(
    fit: Mapping[str, Score],
    validation: Mapping[str, Score],
    repeated: Mapping[str, float],
    excitation: Mapping[str, ExcitationReport],
    rows: Sequence[str] = (),
    coordinate: str = "joint",
) -> tuple[str, list[Finding]]:
    """Return the torque errors on unseen motion as a sentence, and the findings that worsen the verdict.

    Recordings in which the robot stands are ignored. The first list entry is the worst finding on the error of all
    joints together, among ``motion-poor``, ``torque-unexplained``, ``training-torque-unexplained`` and
    ``no-torque-transfer`` (the first of equals), or, without unseen motion, the reason why there is none.
    ``joints-unexplained`` follows, since a total hides small joints.

    Args:
        fit, validation: scores by recording; validation without repeats of the training motion.
        repeated: unseen recordings that repeat the training motion → share of their states found in the training.
        excitation: name of a training recording → report on its motion.
        rows: names of the torque rows, see `calib.dynamics.torque_rows.TorqueRows.numbered`; default 1, 2, ...
        coordinate: noun for what a torque row belongs to.
    """
    moving = {name: score for name, score in validation.items() if score.motion_share >= MOVES}
    training_error = max((score.judged.total for score in fit.values()), default=np.nan)
    training_in_band = max((score.filtered.total for score in fit.values()), default=np.nan)
    poor = limit("training-torque-unexplained", "share")
    training = finding("training-torque-unexplained", share=training_in_band, poor=poor)
    joints = _joints(moving or fit, rows, coordinate)
    if not moving:
        if repeated:
            reason = finding("validation-repeats")
        elif validation:
            reason = finding("robot-stands")
        else:
            reason = finding("no-unseen-motion")
        figures = sentence(finding("training-torque-error", own=training_error))
        return figures, [*settle([training]), reason, *joints]

    name = max(moving, key=lambda recording: moving[recording].judged.total)
    error = moving[name].judged.total
    totals = []
    if excitation and all(report.poor for report in excitation.values()):
        totals.append(finding("motion-poor"))
    good, poor = limit("torque-unexplained", "share", "marginal"), limit("torque-unexplained", "share")
    totals.append(finding("torque-unexplained", share=error, good=good, poor=poor))
    totals.append(training)
    times, most = error / max(training_error, 1e-300), limit("no-torque-transfer", "times", "marginal")
    totals.append(finding("no-torque-transfer", times=times, most=most))
    figures = finding("torque-errors", unseen=error, file=name, own=training_error, rest=moving[name].at_rest)
    worst = settle(totals)[:1]
    return sentence(figures), [*worst, *joints]


def friction_drives(joints: Iterable[object], payload: str = "") -> list[Finding]:
    """Return the finding that friction of joints adds energy, [] without joints; `payload`: label of a possible
    payload.
    """
    names = list(map(str, joints))
    return [finding("friction-drives", joints=names, payload=payload)] if names else []


def with_duration(verdict: Verdict, excitation: Mapping[str, ExcitationReport]) -> Verdict:
    """Return the verdict; if it is not pass and the training motion is too short, its reason begins with this cause."""
    seconds = sum(report.seconds for report in excitation.values())
    if verdict.level == "pass" or not excitation or seconds >= MIN_MOTION:
        return verdict
    (cause,) = lines_of([finding("training-short", seconds=seconds)])
    return replace(verdict, reason=f"{cause}; {verdict.reason}")


def _joints(scores: Mapping[str, Score], rows: Sequence[str], coordinate: str) -> list[Finding]:
    """Return the finding on joints whose torque the model does not explain.

    The error is taken in the identification band, since noise is not an error of the model, and while the joint moves,
    since friction at rest can take any value.
    """
    threshold = limit("joints-unexplained", "worst", "marginal")
    unexplained: dict[int, float] = {}
    of_torque = 0.0
    for score in scores.values():
        # NaN, a joint that stands, is not unexplained
        share = np.minimum(score.filtered.joints, score.moving.joints)
        with np.errstate(divide="ignore", invalid="ignore"):
            torque = np.nan_to_num(100.0 * score.raw.rms / score.raw.joints, posinf=0.0)
        matters = (torque >= MATTERS * torque.max()) & np.isfinite(share)
        of_torque = max(of_torque, *share[matters], 0.0)
        for k in np.flatnonzero(share > threshold).tolist():
            unexplained[k] = max(unexplained.get(k, 0.0), float(share[k]))
    names = []
    for k in sorted(unexplained):
        row = rows[k] if rows else k + 1
        names.append(f"{coordinate} {row} ({unexplained[k]:.0f} %)")
    worst = max(unexplained.values(), default=0.0)
    return list(settle([finding("joints-unexplained", joints=names, worst=worst, of_torque=of_torque)]))


def too_narrow(expected: Mapping[str, TorqueIntervals], rows: Sequence[str]) -> list[Finding]:
    """Return the finding on the first unseen recording with errors outside their intervals more often than by chance.

    Args:
        expected: name of an unseen recording → intervals of its torque errors.
        rows: names of the torque rows.
    """
    for name, intervals in expected.items():
        sigma = np.sqrt((1.0 - COVERED) * COVERED / np.maximum(intervals.independent, 1.0))
        chance = CHANCE_SIGMAS * sigma
        low = np.flatnonzero(intervals.joints < MIN_COVERED_AT_JOINT - chance).tolist()
        if len(low) or intervals.covered < MIN_COVERED - np.sqrt(np.sum(chance**2)) / len(chance):
            joints = [f"{rows[k]} ({100 * intervals.joints[k]:.0f} %)" for k in low]
            return [finding("torque-intervals-too-narrow", file=name, covered=intervals.covered, joints=joints)]
    return []


def extrapolates(name: str, expected: TorqueIntervals | None) -> list[Finding]:
    """Return the finding on a recording whose motion leaves the training range; [] if it does not, or if unknown."""
    if expected is None:
        return []
    share = float(expected.beyond.mean())
    if not share:
        return []
    joints = [str(joint + 1) for joint in range(expected.extrapolated.shape[2])]
    ways = "; ".join(expected.ways(joints))
    return [finding("outside-training-range", file=name, share=max(share, 0.01), ways=ways)]


def with_prior(verdict: Verdict, rests: Resting) -> Verdict:
    """Return the verdict, with a remark if most parameters are determined by a prior instead of the motion."""
    if 2 * len(rests.names) <= rests.of:
        return verdict
    remark = finding("mostly-prior", count=len(rests.names), parameters=rests.of, source=rests.origin)
    return replace(verdict, reason=f"{verdict.reason}; {sentence(remark)}")


def motion_findings(validation: Mapping[str, Score], repeated: Mapping[str, float]) -> list[Finding]:
    """Return the findings on recordings that repeat the training motion, or in which the robot stands; for any
    robot.
    """
    findings = [finding("repeats-training", file=name, share=share) for name, share in repeated.items()]
    standing = [name for name, score in validation.items() if score.motion_share < MOVES]
    findings += [finding("stands", file=name) for name in standing]
    return findings


def excitation_notes(excitation: Mapping[str, ExcitationReport]) -> list[str]:
    """Return remarks on what the training motion cannot identify, by file."""
    return [f"{name}: {note}" for name, report in excitation.items() for note in report.notes]


def model_findings(cases: Sequence[Case], identification: Identification) -> tuple[Finding, ...]:
    """Return the findings on the model and its training motion, independent of unseen motion."""
    return (
        *parameter_findings(identification),
        *identification.loop.findings,
        *_unmodelled(identification),
        *_elastic(cases),
    )


def parameter_findings(identification: Identification[RegressorModel]) -> tuple[Finding, ...]:
    """Return the findings on the parameters, for any robot: condition, bounds, signs, prior."""
    removed = []
    if identification.elimination is not None:
        steps = sorted(identification.elimination.steps, key=lambda step: -step.f)
        removed = [step.name for step in steps if step.p < identification.settings.level]
    _, condition = identification.condition
    findings = list(
        settle(
            [
                finding("motion-condition", condition=condition),
                finding("needed-parameters-dropped", count=len(removed), names=removed),
            ]
        )
    )
    if identification.fitted.held is not None:
        findings += identification.fitted.held.findings
    findings += _negative(identification)
    findings += settle(_payload_masses(identification))
    rests = resting_parameters(identification)
    if rests.names:
        count = len(rests.names)
        findings.append(
            finding("regularised", count=count, parameters=rests.of, source=rests.origin, names=rests.names)
        )
    return tuple(findings)


def beyond(case: Case, chain: Chain) -> list[Finding]:
    """Return the finding on joints that a recording moves far beyond the robot's limits."""
    q = np.asarray(case.motion.q)
    excess = np.maximum(chain.lower - q.min(axis=0), q.max(axis=0) - chain.upper)
    tolerance = BEYOND * (chain.upper - chain.lower)
    joints = []
    for j in np.flatnonzero(np.isfinite(excess) & (excess > tolerance)):
        unit = "m" if chain.joints[j].kind == "prismatic" else "rad"
        joints.append(f"{chain.joint_names[j]} by {excess[j]:.2g} {unit}")
    return [finding("beyond-joint-limits", file=case.name, joints=joints)] if joints else []


def resting_parameters(identification: Identification[RegressorModel]) -> Resting:
    """Return the base parameters that the motion does not identify."""
    count, prior = identification.base.b, identification.prior
    if prior is None:
        return Resting(of=count)
    rests = prior.resting(identification.fitted.estimate.covariance)
    names = tuple(name for name, by_prior in zip(identification.base.names, rests) if by_prior)
    return Resting(names, count, prior.source)


def _negative(identification: Identification[RegressorModel]) -> list[Finding]:
    """Return the finding on drive inertias and friction parameters that are negative by more than `SURELY` σ."""
    estimate = identification.fitted.estimate
    names = []
    for name, term, value, sigma in zip(identification.names, identification.terms, estimate.values, estimate.sigma):
        if term is not None and term.nonnegative and value < -SURELY * sigma:
            names.append(f"{name} = {value:.3g} ± {sigma:.2g}")
    return [finding("negative-drives", names=names)] if names else []


def _payload_masses(identification: Identification[RegressorModel]) -> Iterable[Finding]:
    """Yield findings on payloads whose identified mass is not positive, or not the stated one."""
    estimate = identification.fitted.estimate
    masses = dict(zip(identification.base.names, zip(estimate.values, estimate.sigma)))
    for label, payload in identification.settings.payloads.items():
        if f"M{label}" not in masses:
            continue
        mass, sigma = masses[f"M{label}"]
        if mass < -SURELY_ABSENT * sigma:
            yield finding("payload-exchanged", label=label, mass=mass, sigma=sigma)
        elif mass < SURELY_ABSENT * sigma:
            yield finding("payload-absent", label=label, mass=mass, sigma=sigma)
        elif payload.mass is not None and abs(mass - payload.mass) > SURELY_ABSENT * sigma:
            off = abs(mass - payload.mass) / payload.mass
            yield finding("payload-mass", label=label, mass=mass, sigma=sigma, stated=payload.mass, off=off)


def _unmodelled(identification: Identification) -> list[Finding]:
    """Return the finding on joints with autocorrelated residuals, whose σ are valid for this motion only."""
    inflation = np.nan_to_num(identification.fitted.inflation)
    rows = identification.settings.torque_rows.numbered(identification.dynamics.model.n)
    correlated = np.flatnonzero(inflation >= MAX_CORRELATED_ROWS)
    joints = [f"{rows[k]} (effective samples 1/{inflation[k]:.0f})" for k in correlated]
    return [finding("autocorrelated-residual", joints=joints)] if joints else []


def _elastic(cases: Sequence[Case]) -> Iterable[Finding]:
    """Yield the findings on joints whose second encoders show elasticity."""
    for case in cases:
        if case.motion.q_link is None:
            continue
        bend = np.std(np.asarray(case.motion.q_link - case.motion.q), axis=0)
        joints = [f"{1e3 * bend[j]:.2g} mrad at joint {j + 1}" for j in np.flatnonzero(bend > BEND)]
        if joints:
            yield finding("elastic-joints", file=case.name, joints=joints)

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
from calib.identification.checks.joint_compliance import encoder_difference
from calib.identification.identify import Identification
from calib.identification.prediction import Dynamics, Score
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
# findings on payloads, which decide the verdict
PAYLOAD_FINDINGS = ("payload-exchanged", "payload-absent", "payload-mass", "payload-centre")
# sigmas from which on a payload's identified mass differs from zero, or from its stated mass (our choice)
PAYLOAD_SIGMAS = 3.0
# neighbouring rows that count as one from which on a residual is unmodelled dynamics, not noise
MAX_CORRELATED_ROWS = 3.0
# of all training files together [s] (our choice)
MIN_MOTION = 3.0
# share of the greatest joint's rms torque from which on a joint's torque matters
MATTERS = 0.1
# logarithm of a ratio of probabilities, at most, so that the ratio is a number
LARGEST_LOG = 100.0
# of the errors within intervals that state 0.95, of all joints and of one: it may be missed twice as often (our choice)
MIN_COVERED = 0.93
MIN_COVERED_AT_JOINT = 0.90
# sigmas of chance by which a coverage may be lower
CHANCE_SIGMAS = 3.0


@dataclass(frozen=True)
class Resting:
    """Base parameters whose values are determined by a prior instead of the motion.

    Attributes:
        names: names of these parameters.
        of: number of base parameters in total.
        source: source of the prior: ``cad`` or ``sizes``; empty: no prior.
    """

    names: tuple[str, ...] = ()
    of: int = 0
    source: str = ""

    @property
    def origin(self) -> str:
        """Text that names the source of the prior's values."""
        return "CAD values" if self.source == "cad" else "typical magnitudes of such parameters"


def judge(
    fit: Mapping[str, Score],
    validation: Mapping[str, Score],
    repeated: Mapping[str, float],
    excitation: Mapping[str, ExcitationReport],
    rows: Sequence[str] = (),
    coordinate: str = "joint",
) -> tuple[str, list[Finding]]:
    """Return a sentence on the torque errors on held-out motion, and the findings that worsen the verdict.

    Recordings that the scores mark as no evidence, since the robot stands or nearly stands, are ignored. The first
    finding is the worst of ``motion-poor``,
    ``torque-unexplained``, ``training-torque-unexplained`` and ``no-torque-transfer`` (on the error of all joints
    together; the first one if several are equally bad). Without usable held-out motion, the first findings state the
    training error and why there is no held-out motion. ``joints-unexplained`` follows, since a total hides joints with
    small torques.

    Args:
        fit: name of a training recording -> score.
        validation: name of a held-out recording -> score, without recordings that repeat the training motion.
        repeated: name of a held-out recording that repeats training motion -> share of its states that are also in the
            training motion.
        excitation: name of a training recording -> report on its motion.
        rows: names of the torque rows, see `calib.dynamics.torque_rows.TorqueRows.numbered`; empty: 1, 2, ...
        coordinate: noun for a torque row in messages, such as joint.
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
    worst_score = moving[name]
    error = worst_score.judged.total
    # training and unseen motion are compared in the same frequencies
    training_error = max((score.counted(worst_score.noisy).total for score in fit.values()), default=np.nan)
    totals = []
    if excitation and all(report.poor for report in excitation.values()):
        totals.append(finding("motion-poor"))
    good, poor = limit("torque-unexplained", "share", "marginal"), limit("torque-unexplained", "share")
    totals.append(finding("torque-unexplained", share=error, good=good, poor=poor))
    totals.append(training)
    times, most = error / max(training_error, 1e-300), limit("no-torque-transfer", "times", "marginal")
    totals.append(finding("no-torque-transfer", times=times, most=most))
    figures = finding(
        "torque-errors",
        unseen=error,
        file=name,
        own=training_error,
        rest=worst_score.at_rest,
        band=worst_score.band,
        all=worst_score.above_band,
    )
    worst = settle(totals)[:1]
    return sentence(figures), [*worst, *joints]


def friction_drives(joints: Iterable[object], payload: str = "") -> list[Finding]:
    """Return a finding if the friction of some joints adds energy; an empty list without joints.

    Args:
        joints: names or numbers of the joints.
        payload: label of a payload that could be the cause; empty: none.
    """
    names = list(map(str, joints))
    return [finding("friction-drives", joints=names, payload=payload)] if names else []


def with_duration(verdict: Verdict, excitation: Mapping[str, ExcitationReport]) -> Verdict:
    """Return the verdict; if it is not pass and the training motion is too short, the reason begins with this cause.

    Args:
        verdict: the verdict.
        excitation: name of a training recording -> report on its motion.
    """
    seconds = sum(report.seconds for report in excitation.values())
    if verdict.level == "pass" or not excitation or seconds >= MIN_MOTION:
        return verdict
    (cause,) = lines_of([finding("training-short", seconds=seconds)])
    return replace(verdict, reason=f"{cause}; {verdict.reason}")


def _joints(scores: Mapping[str, Score], rows: Sequence[str], coordinate: str) -> list[Finding]:
    """Return a finding on joints whose torque the model does not explain; an empty list if there are none.

    The error is computed in the identification band, since noise is not a model error, and for moving joints only,
    since friction at rest can take any value.

    Args:
        scores: name of a held-out recording -> score.
        rows: names of the torque rows; empty: 1, 2, ...
        coordinate: noun for a torque row in messages, such as joint.
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
    """Return a finding on the first held-out recording whose torque errors exceed their 95 % intervals too often.

    An empty list if no recording has more such errors than chance allows.

    Args:
        expected: name of a held-out recording -> intervals of its torque errors.
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
    """Return a finding if the motion of a recording leaves the range of the training motion; otherwise an empty list.

    Args:
        name: name of the recording.
        expected: expected torque errors, which state where the model extrapolates; None: unknown, an empty list.
    """
    if expected is None:
        return []
    share = float(expected.beyond.mean())
    if not share:
        return []
    joints = [str(joint + 1) for joint in range(expected.extrapolated.shape[2])]
    ways = "; ".join(expected.ways(joints))
    return [finding("outside-training-range", file=name, share=max(share, 0.01), ways=ways)]


def with_prior(verdict: Verdict, rests: Resting) -> Verdict:
    """Return the verdict, with a remark if a prior determines more than half of the parameters.

    Args:
        verdict: the verdict.
        rests: the parameters that the prior determines.
    """
    if 2 * len(rests.names) <= rests.of:
        return verdict
    remark = finding("mostly-prior", count=len(rests.names), parameters=rests.of, source=rests.origin)
    return replace(verdict, reason=f"{verdict.reason}; {sentence(remark)}")


def motion_findings(validation: Mapping[str, Score], repeated: Mapping[str, float]) -> list[Finding]:
    """Return findings on held-out recordings that repeat the training motion, or in which the robot does not move.

    Args:
        validation: name of a held-out recording -> score of the model.
        repeated: name of a held-out recording that repeats training motion -> share of its states that are also in the
            training motion.
    """
    findings = [finding("repeats-training", file=name, share=share) for name, share in repeated.items()]
    standing = [name for name, score in validation.items() if score.motion_share < MOVES]
    findings += [finding("stands", file=name) for name in standing]
    return findings


def excitation_notes(excitation: Mapping[str, ExcitationReport]) -> list[str]:
    """Return remarks on parameters that the training motions cannot identify.

    Each begins with the name of the recording.

    Args:
        excitation: name of a training recording -> report on its motion.
    """
    return [f"{name}: {note}" for name, report in excitation.items() for note in report.notes]


def model_findings(cases: Sequence[Case], identification: Identification) -> tuple[Finding, ...]:
    """Return the findings on the model and its training motion that do not depend on held-out motion.

    Args:
        cases: training recordings.
        identification: the identification.
    """
    return (
        *parameter_findings(identification),
        *identification.loop.findings,
        *_unmodelled(identification),
        *elastic_findings(cases, identification.dynamics),
    )


def _left_earlier(identification: Identification[RegressorModel]) -> list[Finding]:
    """Return findings on what contradicts the choice of an earlier identification, and on what it has seen."""
    earlier = identification.settings.earlier
    if earlier is None:
        return []
    findings = []
    if earlier.contradiction > 0.0:
        ratio = float(np.exp(min(earlier.contradiction, LARGEST_LOG)))
        findings.append(finding("earlier-prior-left", source=earlier.source, ratio=ratio))
    names = [term.name for term in identification.friction.terms if term.name not in earlier.ridges]
    if names:
        findings.append(finding("earlier-friction-extended", source=earlier.source, names=names))
    if earlier.seen:
        findings.append(finding("earlier-recording-validates", source=earlier.source, files=list(earlier.seen)))
    return findings


def parameter_findings(identification: Identification[RegressorModel]) -> tuple[Finding, ...]:
    """Return findings on the parameters of any robot: condition number, bounds, signs, and prior.

    Args:
        identification: the identification.
    """
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
    findings += _left_earlier(identification)
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
    """Return a finding on joints that move far beyond their limits in a recording; otherwise an empty list.

    Args:
        case: the recording.
        chain: the arm with its joint limits.
    """
    q = np.asarray(case.motion.q)
    excess = np.maximum(chain.lower - q.min(axis=0), q.max(axis=0) - chain.upper)
    tolerance = BEYOND * (chain.upper - chain.lower)
    joints = []
    for j in np.flatnonzero(np.isfinite(excess) & (excess > tolerance)):
        unit = "m" if chain.joints[j].kind == "prismatic" else "rad"
        joints.append(f"{chain.joint_names[j]} by {excess[j]:.2g} {unit}")
    return [finding("beyond-joint-limits", file=case.name, joints=joints)] if joints else []


def resting_parameters(identification: Identification[RegressorModel]) -> Resting:
    """Return the base parameters that are determined by the prior because the motion does not identify them.

    Args:
        identification: the identification with its prior.
    """
    count, prior = identification.base.b, identification.prior
    if prior is None:
        return Resting(of=count)
    rests = prior.resting(identification.fitted.estimate.covariance)
    names = tuple(name for name, by_prior in zip(identification.base.names, rests) if by_prior)
    return Resting(names, count, prior.source)


def _negative(identification: Identification[RegressorModel]) -> list[Finding]:
    """Return a finding on drive inertias and friction parameters that are negative by more than `SURELY` σ, if any.

    Args:
        identification: the identification.
    """
    estimate = identification.fitted.estimate
    names = []
    for name, term, value, sigma in zip(identification.names, identification.terms, estimate.values, estimate.sigma):
        if term is not None and term.nonnegative and value < -SURELY * sigma:
            names.append(f"{name} = {value:.3g} ± {sigma:.2g}")
    return [finding("negative-drives", names=names)] if names else []


def _payload_masses(identification: Identification[RegressorModel]) -> Iterable[Finding]:
    """Yield findings on payloads whose identified mass is not positive, or not the stated one.

    Args:
        identification: the identification with identified payloads.
    """
    estimate = identification.fitted.estimate
    masses = dict(zip(identification.base.names, zip(estimate.values, estimate.sigma)))
    for label, payload in identification.settings.payloads.items():
        if f"M{label}" not in masses:
            continue
        mass, sigma = masses[f"M{label}"]
        if payload.com is not None and mass > PAYLOAD_SIGMAS * sigma:
            yield from _payload_centre(label, payload.com, mass, masses)
        doubt = PAYLOAD_SIGMAS * sigma
        stated_mass = payload.mass
        if stated_mass is not None and abs(mass - stated_mass) <= doubt:
            continue
        if mass < -doubt:
            yield finding("payload-exchanged", label=label, mass=mass, sigma=sigma)
        elif mass < doubt:
            yield finding("payload-absent", label=label, mass=mass, sigma=sigma)
        elif stated_mass is not None:
            off = abs(mass - stated_mass) / stated_mass
            yield finding("payload-mass", label=label, mass=mass, sigma=sigma, stated=stated_mass, off=off)


def _payload_centre(
    label: str, com: Sequence[float], mass: float, estimates: Mapping[str, tuple[float, float]]
) -> Iterable[Finding]:
    """Yield a finding if a payload's identified centre of mass is not the stated one.

    Args:
        label: label of the payload.
        com: (3,) stated centre of mass in the tip's frame [m].
        mass: identified mass [kg].
        estimates: value and σ of the base parameters by name, among them the first moments [kg m].
    """
    squares, doubts = [], []
    for axis, stated in zip("XYZ", com):
        moment = estimates.get(f"M{axis}{label}")
        if moment is None:
            return
        value, sigma = moment
        squares.append((value / mass - stated) ** 2)
        doubts.append((sigma / mass) ** 2)
    off, doubt = float(np.sqrt(sum(squares))), float(np.sqrt(sum(doubts)))
    if off > PAYLOAD_SIGMAS * doubt:
        yield finding("payload-centre", label=label, off=off, doubt=doubt)


def _unmodelled(identification: Identification) -> list[Finding]:
    """Return a finding on joints with autocorrelated residuals, if any.

    The σ of these joints' parameters are valid for the recorded motion only.

    Args:
        identification: the identification.
    """
    inflation = np.nan_to_num(identification.fitted.inflation)
    rows = identification.settings.torque_rows.numbered(identification.dynamics.model.n)
    correlated = np.flatnonzero(inflation >= MAX_CORRELATED_ROWS)
    joints = [f"{rows[k]} (effective samples 1/{inflation[k]:.0f})" for k in correlated]
    return [finding("autocorrelated-residual", joints=joints)] if joints else []


def elastic_findings(cases: Sequence[Case], dynamics: Dynamics[RegressorModel]) -> Iterable[Finding]:
    """Yield findings on second encoders: their delay, joints that bend, and compliances that they tell.

    Args:
        cases: training recordings.
        dynamics: the identified model, whose bodies' torques bend the joints.
    """
    with_encoders = [case for case in cases if case.motion.q_link is not None]
    difference = encoder_difference(dynamics, with_encoders)
    if difference is None:
        return
    file = ", ".join(case.name for case in with_encoders)
    if abs(difference.delay) > SURELY * difference.delay_sigma:
        delay, sigma = 1e3 * difference.delay, 1e3 * difference.delay_sigma
        yield finding("encoders-late", file=file, delay=delay, sigma=sigma)
    bent = [joint for joint in difference.joints if joint.delayed > BEND]
    joints = [f"{1e3 * joint.delayed:.2g} mrad at joint {joint.joint + 1}" for joint in bent]
    if joints:
        yield finding("elastic-joints", file=file, joints=joints)
    for joint in difference.joints:
        if joint.identified:
            stiffness = -1.0 / joint.compliance
            yield finding(
                "joint-compliance",
                joint=joint.joint + 1,
                compliance=joint.compliance,
                sigma=joint.sigma,
                stiffness=stiffness,
            )

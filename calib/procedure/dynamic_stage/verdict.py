"""Verdict on an identified model; its limits and sentences are in the catalogue, chapters 9 to 11.

The verdict of calib identify (exit code 0 for pass and marginal, 1 for fail) judges the raw total of the worst
validation recording in which the robot moves and which does not repeat the training (of joints in motion, where some
stand: what friction is at rest no model knows), beside the training's own error in its band; then every joint in the
band, and while it moves. `calib explain torque-unexplained` prints the limits, and so on for each code of chapter 11.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.data.signals.persistency import ExcitationReport
from calib.errors import Finding, finding
from calib.identification.identify import Identification
from calib.identification.prediction import Score
from calib.identification.rows import Case
from calib.identification.uncertainty.torque_errors import COVERED, TorqueIntervals
from calib.procedure.findings import Verdict, limit, lines_of, sentence, settle
from calib.robot.chain import Chain

BEYOND = 0.05  # of a joint's range by which a recording may leave it: encoders and limits of a CAD are not exact
MOVES = 0.1  # share of moving rows below which a recording is no motion
BEND = 1e-4  # rms of link minus motor position that shows elasticity [rad or m]
SURELY = 2.0  # sigmas below zero from which on a drive's inertia or friction is called negative
# neighbouring rows that count as one from which on a residual is unmodelled dynamics, not noise
MAX_CORRELATED_ROWS = 3.0


@dataclass(frozen=True)
class Resting:
    """Base parameters whose values are determined by a prior, not by the motion.

    Attributes:
        names: theirs.
        of: how many base parameters there are.
        source: of the prior: ``cad`` or ``sizes``; empty where there was none.
    """

    names: tuple[str, ...] = ()
    of: int = 0
    source: str = ""

    @property
    def origin(self) -> str:
        """Source of their values, as text."""
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

    Recordings in which the robot stands are left aside. Of the sum over joints the worst of the findings
    ``motion-poor``, ``torque-unexplained``, ``training-torque-unexplained``, ``no-torque-transfer``, of equals the
    first; without unseen motion why there is none. Then ``joints-unexplained``, since a total hides small joints.

    Args:
        fit, validation: scores by file; validation without repeats.
        repeated: validation files that repeat the training motion.
        excitation: of the training files.
        rows: what the torque rows are called, see `calib.dynamics.torque_rows.TorqueRows.numbered`; default 1, 2, ...
        coordinate: what such a row belongs to, in a word.
    """
    moves = {name: scored for name, scored in validation.items() if scored.motion_share >= MOVES}
    own = max((found.judged.total for found in fit.values()), default=np.nan)
    learnt = max((found.filtered.total for found in fit.values()), default=np.nan)
    training = finding("training-torque-unexplained", share=learnt, poor=limit("training-torque-unexplained", "share"))
    joints = _joints(moves or fit, rows, coordinate)
    if not moves:
        why = "validation-repeats" if repeated else "robot-stands" if validation else "no-unseen-motion"
        return sentence(finding("training-torque-error", own=own)), [*settle([training]), finding(why), *joints]
    name = max(moves, key=lambda key: moves[key].judged.total)
    worst, at_rest = moves[name].judged.total, moves[name].at_rest
    totals = [
        *([finding("motion-poor")] if excitation and all(report.poor for report in excitation.values()) else []),
        finding(
            "torque-unexplained",
            share=worst,
            good=limit("torque-unexplained", "share", "marginal"),
            poor=limit("torque-unexplained", "share"),
        ),
        training,
        finding(
            "no-torque-transfer", times=worst / max(own, 1e-300), most=limit("no-torque-transfer", "times", "marginal")
        ),
    ]
    figures = finding("torque-errors", unseen=worst, file=name, own=own, rest=at_rest)
    return sentence(figures), [*settle(totals)[:1], *joints]


def friction_drives(joints: Iterable[object], payload: str = "") -> list[Finding]:
    """Return the finding that friction of joints adds energy; `payload`: label of a possible payload."""
    names = [str(one) for one in joints]
    return [finding("friction-drives", joints=names, payload=payload)] if names else []


def with_duration(verdict: Verdict, excitation: Mapping[str, ExcitationReport]) -> Verdict:
    """Return the verdict; unless it is pass, its reason begins with a training motion that is too short."""
    seconds = sum(report.seconds for report in excitation.values())
    min_motion = 3.0  # of all training files together [s] (our choice)
    if verdict.level == "pass" or not excitation or seconds >= min_motion:
        return verdict
    (cause,) = lines_of([finding("training-short", seconds=seconds)])
    return replace(verdict, reason=f"{cause}; {verdict.reason}")


def _joints(scores: Mapping[str, Score], rows: Sequence[str], coordinate: str) -> list[Finding]:
    """Return the finding on joints whose torque the model does not explain.

    Taken in the band, since noise is no fault of the model, and moving, since friction at rest takes any value.
    """
    least, matters = limit("joints-unexplained", "worst", "marginal"), 0.1  # of the greatest joint's rms torque
    lost: dict[int, float] = {}
    of_torque = 0.0
    for scored in scores.values():
        share = np.minimum(scored.filtered.joints, scored.moving.joints)  # NaN, a joint that stands, is not lost
        with np.errstate(divide="ignore", invalid="ignore"):
            torque = np.nan_to_num(100.0 * scored.raw.rms / scored.raw.joints, posinf=0.0)
        of_torque = max(of_torque, *share[(torque >= matters * torque.max()) & np.isfinite(share)], 0.0)
        lost |= {int(k): max(lost.get(int(k), 0.0), float(share[k])) for k in np.flatnonzero(share > least)}
    named = [f"{coordinate} {rows[k] if rows else k + 1} ({lost[k]:.0f} %)" for k in sorted(lost)]
    worst = max(lost.values(), default=0.0)
    return list(settle([finding("joints-unexplained", joints=named, worst=worst, of_torque=of_torque)]))


def too_narrow(expected: Mapping[str, TorqueIntervals], rows: Sequence[str]) -> list[Finding]:
    """Return the finding on the first unseen recording with errors outside their intervals more often than by chance.

    Args:
        expected: by unseen case.
        rows: what the torque rows are called.
    """
    min_covered, min_covered_at_joint = 0.93, 0.90  # of 0.95 stated: a joint may miss it twice as often (our choice)
    for name, one in expected.items():
        chance = 3.0 * np.sqrt((1.0 - COVERED) * COVERED / np.maximum(one.independent, 1.0))
        rare = np.flatnonzero(one.joints < min_covered_at_joint - chance).tolist()
        if rare or one.covered < min_covered - np.sqrt(np.sum(chance**2)) / len(chance):
            low = [f"{rows[k]} ({100 * one.joints[k]:.0f} %)" for k in rare]
            return [finding("torque-intervals-too-narrow", file=name, covered=one.covered, joints=low)]
    return []


def extrapolates(name: str, expected: TorqueIntervals | None) -> list[Finding]:
    """Return the finding on a recording whose motion leaves the training range."""
    if expected is None or not (share := float(expected.beyond.mean())):
        return []
    joints = [str(joint + 1) for joint in range(expected.extrapolated.shape[2])]
    ways = "; ".join(expected.ways(joints))
    return [finding("outside-training-range", file=name, share=max(share, 0.01), ways=ways)]


def with_prior(verdict: Verdict, rests: Resting) -> Verdict:
    """Return the verdict, with a remark if most parameters come from a prior instead of the motion."""
    if 2 * len(rests.names) <= rests.of:
        return verdict
    one = finding("mostly-prior", count=len(rests.names), parameters=rests.of, source=rests.origin)
    return replace(verdict, reason=f"{verdict.reason}; {sentence(one)}")


def motion_findings(validation: Mapping[str, Score], repeated: Mapping[str, float]) -> list[Finding]:
    """Return the findings on the motion of recordings, for any robot."""
    return [
        *(finding("repeats-training", file=name, share=share) for name, share in repeated.items()),
        *(finding("stands", file=name) for name, one in validation.items() if one.motion_share < MOVES),
    ]


def excitation_notes(excitation: Mapping[str, ExcitationReport]) -> list[str]:
    """Return remarks on what the training motion cannot identify, by file."""
    return [f"{name}: {note}" for name, report in excitation.items() for note in report.notes]


def model_findings(cases: Sequence[Case], found: Identification) -> tuple[Finding, ...]:
    """Return the findings on the model and its training motion, independent of unseen motion."""
    own = (*parameter_findings(found), *found.loop.findings)
    return *own, *_unmodelled(found), *_elastic(cases)


def parameter_findings(found: Identification[Any]) -> tuple[Finding, ...]:
    """Return the findings on the parameters, for any robot: condition, bounds, signs, prior."""
    rests = resting_parameters(found)
    prior = finding("regularised", count=len(rests.names), parameters=rests.of, source=rests.origin, names=rests.names)
    steps = () if found.elimination is None else found.elimination.steps
    needed = [one.name for one in sorted(steps, key=lambda one: -one.f) if one.p < found.settings.level]
    gone = finding("needed-parameters-dropped", count=len(needed), names=needed)
    condition = settle([finding("motion-condition", condition=found.condition[1]), gone])
    held = found.fitted.held.findings if found.fitted.held is not None else ()
    return *condition, *held, *_negative(found), *([prior] if rests.names else [])


def beyond(case: Case, chain: Chain) -> list[Finding]:
    """Return the finding on joints that a recording moves far beyond the robot's limits."""
    q = np.asarray(case.motion.q)
    over = np.maximum(chain.lower - q.min(axis=0), q.max(axis=0) - chain.upper)
    far = np.flatnonzero(np.isfinite(over) & (over > BEYOND * (chain.upper - chain.lower)))
    named = [
        f"{chain.joint_names[j]} by {over[j]:.2g} {'m' if chain.joints[j].kind == 'prismatic' else 'rad'}" for j in far
    ]
    return [finding("beyond-joint-limits", file=case.name, joints=named)] if named else []


def resting_parameters(found: Identification[Any]) -> Resting:
    """Return the base parameters that the motion does not identify."""
    if found.prior is None:
        return Resting(of=found.base.b)
    on = found.prior.resting(found.fitted.estimate.covariance)
    names = tuple(name for name, rests in zip(found.base.names, on) if rests)
    return Resting(names, found.base.b, found.prior.source)


def _negative(found: Identification[Any]) -> list[Finding]:
    """Return the finding on drive inertias and friction that are negative by more than `SURELY` sigmas."""
    estimate = found.fitted.estimate
    wrong = [
        f"{name} = {value:.3g} ± {sigma:.2g}"
        for name, one, value, sigma in zip(found.names, found.terms, estimate.values, estimate.sigma)
        if one is not None and one.nonnegative and value < -SURELY * sigma
    ]
    return [finding("negative-drives", names=wrong)] if wrong else []


def _unmodelled(found: Identification) -> list[Finding]:
    """Return the finding on joints with autocorrelated residuals, whose sigmas are valid for this motion only."""
    alike = np.nan_to_num(found.fitted.inflation)
    rows = found.settings.torque_rows.numbered(found.dynamics.model.n)
    joints = [f"{rows[k]} (effective samples 1/{alike[k]:.0f})" for k in np.flatnonzero(alike >= MAX_CORRELATED_ROWS)]
    return [finding("autocorrelated-residual", joints=joints)] if joints else []


def _elastic(cases: Sequence[Case]) -> Iterable[Finding]:
    """Yield the findings on joints whose second encoders show elasticity."""
    for case in cases:
        if case.motion.q_link is None:
            continue
        bend = np.std(np.asarray(case.motion.q_link - case.motion.q), axis=0)
        if joints := [f"{1e3 * bend[j]:.2g} mrad at joint {j + 1}" for j in np.flatnonzero(bend > BEND)]:
            yield finding("elastic-joints", file=case.name, joints=joints)

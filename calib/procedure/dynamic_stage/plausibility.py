"""Findings on implausible sizes, signs and clocks of recordings (findings catalogue, chapter 9).

The catalogue contains the limits and sentences. A finding that makes the model's values grossly wrong fails the verdict
or limits it to marginal, unless the options' ``accept`` names the finding.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from calib.column_changes import Change, Explanation
from calib.data.recordings.checks import LIMITS as RECORDED
from calib.errors import Finding, finding
from calib.identification.checks.gravity import GravityHypotheses
from calib.identification.checks.recording_sizes import FOLLOWS, ClockRatio, RecordingSizes, compare_sizes, signs_of
from calib.identification.checks.torque_lag import Lag
from calib.identification.loop import LoopDisagreement
from calib.identification.physical_consistency.solve import Contradiction
from calib.identification.rows import Case
from calib.procedure.dynamic_stage.hypotheses import (
    gravity_findings,
    gravity_hypotheses,
    likelier_gravity,
    load_findings,
    tare_findings,
)
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.findings import level_of, limit, settle
from calib.robot.chain import Chain
from calib.robot.description import impossible_bodies
from calib.units import TORQUE

# of the velocities over the differentiated positions: at a joint, at all joints alike, and in sigmas (our choice)
MIN_SPEED_ERROR = 0.05
MIN_COMMON_SPEED_ERROR = 0.02
MIN_SPEED_SIGMAS = 5.0
# relative sigma of a robot's inertias over masses from its lengths (our choice)
RODS_SIGMA = 0.17
# of the loop's factors at the joints: spread below which they are one, and distance from 1 that counts (our choice)
MAX_FACTOR_SPREAD = 0.1
MIN_FACTOR_ERROR = 0.1
# jitter of the stamps in steps (rms), and share of missing samples, from which on they are noted (our choice)
MAX_JITTER = 0.15
MAX_MISSING = 0.02
# velocity units that logs use -> size of a radian, or metre, per second in them
VELOCITY_UNITS = {
    "deg/s": 180.0 / np.pi,
    "rpm": 30.0 / np.pi,
    "turns per second": 0.5 / np.pi,
    "mrad/s or mm/s": 1e3,
    "rad/min or m/min": 60.0,
}
# relative error of a factor up to which it is that of a unit (our choice)
MAX_UNIT_ERROR = 0.01


def implausible(
    inputs: IdentificationInputs,
    impossible_by: Contradiction | None,
    loop: LoopDisagreement | None,
    hypotheses: GravityHypotheses | None = None,
) -> tuple[Finding, ...]:
    """Return all findings on implausible recordings, descriptions and estimates; accepted findings are marked.

    Args:
        inputs: robot, recordings and options.
        impossible_by: distance of the estimate from every physically consistent robot; None: unknown.
        loop: disagreement of recorded torques with an estimate that relies on the stated control loop; None: no
            disagreement.
        hypotheses: gravity, for columns as recorded; None: computed.
    """
    chain, gravity = inputs.chain, inputs.options.settings.gravity
    cases = [*inputs.cases, *inputs.unseen]
    columns = {case.name: signs_of(case, chain, gravity) for case in cases}
    hypotheses = likelier_gravity(inputs, hypotheses or gravity_hypotheses(inputs), columns)
    if hypotheses is not None and hypotheses.direction is not None:
        # columns that seem exchanged or coupled under a wrong gravity need not be
        x, y, z = hypotheses.direction.tolist()
        gravity = (x, y, z)
        columns = {case.name: signs_of(case, chain, gravity) for case in cases}
    sizes = []
    for case in inputs.cases:
        recording = compare_sizes(case, chain, gravity, inputs.unit == TORQUE)
        sizes.append(recording if columns[case.name] is None else recording.without_masses())
    result = wrong_joints(columns, chain.joint_names)
    result += gravity_findings(hypotheses, chain.joint_names)
    result += load_findings(inputs, gravity)
    result += tare_findings(inputs, gravity)
    result += standing_columns(cases, chain.joint_names)
    result += findings(sizes, chain.joint_names)
    result += sampling_findings(cases)
    result += impossible(impossible_by)
    result += another_loop(loop)
    result += described(chain)
    for label, load in inputs.options.settings.payloads.items():
        if not load.parameters and not any(label in case.carried for case in inputs.cases):
            result.append(finding("payload-never", label=label))
    return settle(result, inputs.options.accept)


def findings(sizes: Sequence[RecordingSizes], joints: Sequence[str]) -> list[Finding]:
    """Return findings on torques and velocities of implausible size in recordings, and on wrong clocks.

    Args:
        sizes: for each recording, the sizes of its quantities compared with the robot's description.
        joints: names of the joints.
    """
    result: list[Finding] = []
    for recording in sizes:
        result += _limits(recording, joints)
        result += _masses(recording, joints)
        speed = list(_speed(recording, joints))
        result += speed
        # velocities that disagree with the positions say the same of the clock
        if not speed:
            result += _clock(recording.name, recording.clock)
        result += _unlike(recording, joints)
        result += _lag(recording.name, recording.lag, joints)
        change = recording.other
        if change is not None:
            result.append(
                change.finding(
                    joints,
                    file=recording.name,
                    factor=change.factor,
                    gain=1.0 - change.factor,
                    explained=1.0 - max(change.after),
                )
            )
        result += [finding("position-jump", file=recording.name, jump=jump) for jump in recording.jumps]
    return _of_some_level(result)


def _of_some_level(candidates: Iterable[Finding]) -> list[Finding]:
    """Return the findings whose values reach a level (note, marginal or fail) of the catalogue.

    Args:
        candidates: findings with their values.
    """
    return [candidate for candidate in candidates if level_of(candidate)]


def sampling_findings(cases: Sequence[Case]) -> list[Finding]:
    """Return findings on stamps that jitter, and on samples that were lost.

    Args:
        cases: the recordings.
    """
    result = []
    for case in cases:
        report = case.motion.sampling
        jitter = report.jitter[0] * report.rate
        length = float(case.motion.t[-1] - case.motion.t[0])
        missing = report.lost / report.rate + sum(duration for _, duration in report.gaps)
        share = missing / max(length, 1e-9)
        if jitter > MAX_JITTER:
            result.append(finding("stamps-jitter", file=case.name, jitter=jitter, seconds=report.jitter[0]))
        if share > MAX_MISSING:
            result.append(
                finding("samples-missing", file=case.name, share=share, count=report.lost, gaps=len(report.gaps))
            )
    return result


def standing_columns(cases: Sequence[Case], joints: Sequence[str]) -> list[Finding]:
    """Return findings on clipped torques, and on positions or velocities that stay constant while a joint moves.

    Args:
        cases: the recordings.
        joints: names of the joints.
    """
    result = []
    for case in cases:
        clipped, values = [], []
        for fault in case.motion.faults:
            joint = joints[fault.joint]
            if fault.kind == "clipped":
                extremes = " and ".join(f"{value:.4g}" for value in fault.values)
                clipped.append(joint)
                values.append(f"{extremes} in {fault.share:.0%} of its motion")
                continue
            if fault.kind in ("mean", "start"):
                continue
            code = "velocity-stands" if fault.kind == "velocity" else "encoder-stands"
            result.append(
                finding(
                    code,
                    missed=fault.missed,
                    file=case.name,
                    joint=joint,
                    start=fault.start,
                    stop=fault.stop,
                    share=fault.share,
                )
            )
        if clipped:
            result.append(finding("torque-clipped", file=case.name, joints=clipped, values=values))
    return _of_some_level(result)


def wrong_joints(explanations: Mapping[str, Explanation | None], joints: Sequence[str]) -> list[Finding]:
    """Return findings on columns of another joint, sign, factor or zero, or relative to another joint.

    Args:
        explanations: recording name -> changes of columns that explain the torques; None: no change is needed.
        joints: names of the joints.
    """
    result = []
    for name, explanation in explanations.items():
        if explanation is None:
            continue
        changed = sorted({change.joints[0] for change in explanation.changes if change.joints})
        rival = None
        if explanation.rival is not None:
            rival_joints = [joints[joint] for joint in explanation.rival.joints]
            rival = " at ".join([explanation.rival.code, *filter(None, [", ".join(rival_joints)])])
        for change in sorted(explanation.changes, key=_joints_of_change):
            if not change.joints:
                shares = {"before": _typical(explanation.before), "after": _typical(explanation.after)}
                result.append(finding(change.code, file=name, rival=rival, **change.values, **shares))
                continue
            j, k = change.joints[0], change.joints[-1]
            result.append(
                finding(
                    change.code,
                    file=name,
                    joint=joints[j],
                    other=joints[k],
                    joints=[joints[joint] for joint in change.joints],
                    **change.values,
                    rival=rival,
                    before=np.sqrt(explanation.before[j]),
                    after=np.sqrt(explanation.after[j]),
                    gain=1.0 - explanation.factor,
                    factor=explanation.factor,
                    explained=1.0 - float(np.max(explanation.after[changed])),
                )
            )
    return _of_some_level(result)


def _typical(squares: np.ndarray) -> float:
    """Return the geometric mean over the joints of their unexplained rms shares, from squared shares (n,)."""
    return float(np.exp(0.5 * np.mean(np.log(squares))))


def _joints_of_change(change: Change) -> tuple[int, ...]:
    return tuple(change.joints)


def impossible(contradiction: Contradiction | None) -> list[Finding]:
    """Return a finding if an estimate is far from every physically consistent robot; otherwise an empty list.

    Args:
        contradiction: distance of the estimate from every physically consistent robot; None: unknown.
    """
    if contradiction is None:
        return []
    candidate = finding(
        "no-possible-robot",
        distance=contradiction.distance,
        allowed=contradiction.allowed,
        unexplained=contradiction.unexplained,
        times=contradiction.distance / contradiction.allowed,
    )
    return _of_some_level([candidate])


def described(chain: Chain) -> list[Finding]:
    """Return a finding if the description of `chain` has physically inconsistent bodies; otherwise an empty list."""
    bodies = impossible_bodies(chain)
    return [finding("inconsistent-bodies", bodies=bodies)] if bodies else []


def another_loop(disagreement: LoopDisagreement | None) -> list[Finding]:
    """Return a finding if recorded torques contradict an estimate that relies on the stated control loop.

    Args:
        disagreement: how the torques contradict the estimate; None: they do not, which yields an empty list.
    """
    if disagreement is None:
        return []
    factors = np.array(disagreement.factor)
    median = float(np.median(factors))
    equal_factors = np.ptp(factors) < MAX_FACTOR_SPREAD * abs(median)
    # Hypotheses: one factor at all joints, a factor per joint, or else another velocity than the stated one.
    times = None
    wrong_factors: list[str] = []
    velocity = ""
    if equal_factors and abs(median - 1.0) > MIN_FACTOR_ERROR:
        times = median
    elif np.any(np.abs(factors - 1.0) > MIN_FACTOR_ERROR):
        wrong_factors = _three_digits(disagreement.factor)
    else:
        velocity = "reference_velocity"
    return [
        finding(
            "loop-refuted",
            method=disagreement.method,
            other=disagreement.beside,
            parameter=disagreement.parameter,
            sigmas=disagreement.sigmas,
            worst=max(disagreement.left),
            left=_three_digits(disagreement.left),
            other_left=_three_digits(disagreement.beside_left),
            times=times,
            factors=wrong_factors,
            velocity=velocity,
        )
    ]


def _three_digits(numbers: Sequence[float]) -> list[str]:
    return [f"{number:.3g}" for number in numbers]


def _masses(recording: RecordingSizes, joints: Sequence[str]) -> Iterator[Finding]:
    """Yield findings on signs and sizes of torques that disagree with the masses in the robot's description.

    Args:
        recording: sizes of a recording's quantities compared with the robot's description.
        joints: names of the joints.
    """
    share = recording.masses
    determined = np.flatnonzero(np.isfinite(share)).tolist()
    if not determined:
        return
    against = [joints[j] for j in determined if share[j] < 0.0]
    if against:
        yield finding("torques-against-masses", file=recording.name, joints=against)
        return
    shares = [f"{joints[j]} {share[j]:.2g}" for j in determined]
    common, largest = _off(np.median(share[determined])), _off(share[determined])
    of_all = finding("torques-unlike-masses", file=recording.name, times=common, shares=shares)
    of_joint = finding("torque-of-joint-unlike-masses", file=recording.name, times=largest, shares=shares)
    yield of_all if level_of(of_all) else of_joint


def _off(ratio: np.ndarray | np.floating) -> float:
    """Return the largest factor by which any ratio r differs from 1: the maximum of |r| and 1/|r|."""
    sizes = np.maximum(np.abs(ratio), 1e-300)
    return float(np.maximum(sizes, 1.0 / sizes).max())


def _limits(recording: RecordingSizes, joints: Sequence[str]) -> Iterator[Finding]:
    """Yield findings on torques far above or below the joints' torque limits, which indicates another unit.

    Args:
        recording: sizes of a recording's quantities compared with the robot's description.
        joints: names of the joints.
    """
    limited = np.isfinite(recording.limits)
    if not limited.any():
        return
    largest = float(recording.limits[limited].max())

    def above(times: float, digits: int) -> list[str]:
        rows = np.flatnonzero(limited & (recording.limits > times)).tolist()
        return [f"{joints[j]} {recording.limits[j]:.{digits}g}" for j in rows]

    in_another_unit = above(RECORDED.max_effort, 3)
    if in_another_unit:
        yield finding("torques-in-another-unit", file=recording.name, joints=in_another_unit)
        return
    over = above(limit("torques-beyond-limits", "times", "marginal"), 2)
    yield finding("torques-beyond-limits", file=recording.name, joints=over, times=largest)
    yield finding("torques-below-limits", file=recording.name, share=largest, short=1.0 / max(largest, 1e-300))


def _speed(recording: RecordingSizes, joints: Sequence[str]) -> Iterator[Finding]:
    """Yield findings on measured velocities whose size differs from that of the differentiated positions.

    Args:
        recording: sizes of a recording's quantities compared with the robot's description.
        joints: names of the joints.
    """
    ratio = recording.speed
    measured = np.flatnonzero(np.isfinite(ratio))
    median = float(np.median(ratio[measured])) if len(measured) else 1.0
    alike = len(measured) > 1 and np.ptp(ratio[measured]) < MIN_COMMON_SPEED_ERROR * median
    threshold = MIN_COMMON_SPEED_ERROR
    if not alike:
        threshold = np.maximum(MIN_SPEED_ERROR, MIN_SPEED_SIGMAS * recording.speed_sigma)
    wrong = np.flatnonzero(np.abs(np.nan_to_num(ratio, nan=1.0) - 1.0) > threshold).tolist()
    if not wrong:
        return
    if not alike:
        names = [f"{joints[j]} ({ratio[j]:.3g})" for j in wrong]
        yield finding("velocities-unlike-positions", file=recording.name, joints=names, times=_off(ratio[wrong]))
        return
    clock = recording.clock
    yield finding(
        "velocities-scaled",
        file=recording.name,
        factor=median,
        times=_off(ratio[wrong]),
        rate=recording.rate,
        counted=median * recording.rate,
        size=max(median, 1.0 / median),
        way="large" if median > 1.0 else "small",
        against=_against(clock, median),
        unit=_velocity_unit(median),
        ratio=clock and clock.ratio,
        sigma=clock and clock.relative_sigma,
    )


def _velocity_unit(factor: float) -> str | None:
    """Return the unit in which velocities are `factor` times those per second; None if no usual unit has this factor.

    Args:
        factor: measured velocities divided by differentiated positions.
    """
    for unit, size in VELOCITY_UNITS.items():
        if abs(factor / size - 1.0) < MAX_UNIT_ERROR:
            return unit
    return None


def _against(clock: ClockRatio | None, speed_ratio: float) -> str:
    """Return which measurement contradicts the known ratio of inertias to masses: ``stamps`` or ``velocities``.

    An empty text if the data do not decide between the two.

    Args:
        clock: ratio of inertias to masses found in the torques, relative to the expected ratio; None: unknown.
        speed_ratio: measured velocities divided by differentiated positions.
    """
    if clock is None:
        return ""
    stamps_error = abs(float(np.log(clock.ratio)))
    velocities_error = abs(float(np.log(clock.ratio / speed_ratio**2)))
    if abs(stamps_error - velocities_error) < 2.0 * np.hypot(RODS_SIGMA, clock.relative_sigma):
        return ""
    return "stamps" if velocities_error < stamps_error else "velocities"


def _unlike(recording: RecordingSizes, joints: Sequence[str]) -> Iterator[Finding]:
    """Yield a finding on joints whose measured velocities have the wrong sign or are unrelated to the positions.

    Args:
        recording: sizes of a recording's quantities compared with the robot's description.
        joints: names of the joints.
    """
    backwards = [joints[j] for j in np.flatnonzero(recording.follows < -FOLLOWS).tolist()]
    unrelated = [joints[j] for j in np.flatnonzero(np.abs(recording.follows) <= FOLLOWS).tolist()]
    if backwards or unrelated:
        yield finding(
            "velocities-astray",
            file=recording.name,
            backwards=backwards,
            others=unrelated,
            counted=recording.counted,
            clock="these velocities" if recording.counted else "the stamps",
        )


def _lag(name: str, lag: Lag | None, joints: Sequence[str]) -> Iterator[Finding]:
    """Yield findings on torques that are delayed relative to the motion, at all joints or at one joint.

    Args:
        name: name of the recording.
        lag: delay of its torques [s]; None: no delay was found.
        joints: names of the joints.
    """
    if lag is None:
        return
    if lag.certain:
        yield finding(
            "torques-late",
            file=name,
            by=abs(lag.seconds),
            sigma=lag.sigma,
            way=_direction(lag.seconds),
            commanded="the motion" if lag.seconds > 0 else None,
            lag=lag.seconds,
            before=lag.before,
            after=lag.after,
            times=lag.factor,
        )
    j = lag.joint
    if j is not None:
        difference = float(lag.own[j] - lag.seconds)
        yield finding(
            "joint-late",
            file=name,
            joint=joints[j],
            by=abs(difference),
            way=_direction(difference),
            times=float(lag.gains[j]),
        )


def _direction(seconds: float) -> str:
    return "later" if seconds > 0 else "earlier"


def _clock(name: str, clock: ClockRatio | None) -> Iterator[Finding]:
    """Yield a finding if the time stamps contradict the known ratio of inertias to masses.

    Args:
        name: name of the recording.
        clock: ratio of inertias to masses found in the torques, relative to the expected ratio; None: unknown.
    """
    if clock is None:
        return
    times = _off(np.float64(clock.ratio))
    yield finding(
        "clock-off",
        file=name,
        ratio=clock.ratio,
        sigma=clock.relative_sigma,
        times=times,
        surely=times * float(np.exp(-2.0 * clock.relative_sigma)),
        stamps=max(clock.clock, 1.0 / clock.clock),
        way="large" if clock.clock > 1.0 else "small",
    )

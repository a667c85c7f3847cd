"""Findings on sizes, signs and clocks of recordings (catalogue, chapter 9).

The limits and sentences stand there. A finding that makes the numbers of a model wrong by far fails the verdict, or
holds it at marginal, until the options' ``accept`` says that it is intended.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from calib.column_changes import Explanation
from calib.data.recordings.checks import LIMITS as RECORDED
from calib.errors import Finding, finding
from calib.identification.checks.recording_sizes import FOLLOWS, ClockRatio, RecordingSizes, compare_sizes, signs_of
from calib.identification.checks.torque_lag import Lag
from calib.identification.loop import LoopDisagreement
from calib.identification.physical_consistency.solve import Contradiction
from calib.identification.rows import Case
from calib.procedure.dynamic_stage.hypotheses import gravity_findings, gravity_hypotheses, load_findings
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.findings import level_of, limit, settle
from calib.robot.chain import Chain
from calib.robot.description import impossible_bodies
from calib.units import TORQUE


def implausible(
    inputs: IdentificationInputs, impossible_by: Contradiction | None, loop: LoopDisagreement | None
) -> tuple[Finding, ...]:
    """Return all findings on implausible recordings, descriptions and estimates, with the accepted ones marked.

    Args:
        impossible_by: distance of the estimate from every physically consistent robot.
        loop: disagreement of recorded torques with an estimate that relies on the stated loop.
    """
    chain, gravity = inputs.chain, inputs.options.settings.gravity
    hypotheses = gravity_hypotheses(inputs)
    if hypotheses is not None and hypotheses.direction is not None:
        # columns that seem exchanged or coupled under a wrong gravity need not be
        x, y, z = hypotheses.direction.tolist()
        gravity = (x, y, z)
    sizes = [compare_sizes(case, chain, gravity, inputs.unit == TORQUE) for case in inputs.cases]
    signs = {case.name: signs_of(case, chain, gravity) for case in (*inputs.cases, *inputs.unseen)}
    found = [
        *gravity_findings(hypotheses, chain.joint_names),
        *load_findings(inputs, gravity),
        *standing_columns([*inputs.cases, *inputs.unseen], chain.joint_names),
        *findings(sizes, chain.joint_names),
        *impossible(impossible_by),
        *another_loop(loop),
        *described(chain),
    ]
    for label, load in inputs.options.settings.payloads.items():
        if not load.parameters and not any(label in case.carried for case in inputs.cases):
            found.append(finding("payload-never", label=label))
    return settle([*found, *wrong_joints(signs, chain.joint_names)], inputs.options.accept)


def findings(sizes: Sequence[RecordingSizes], joints: Sequence[str]) -> list[Finding]:
    """Return the findings on implausible recordings."""
    found: list[Finding] = []
    for each in sizes:
        speed = list(_speed(each, joints))
        found += [*_limits(each, joints), *_masses(each, joints), *speed]
        found += [] if speed else _clock(each.name, each.clock)
        found += [*_unlike(each, joints), *_lag(each.name, each.lag, joints)]
        if (other := each.other) is not None:
            sizes_left = dict(factor=other.factor, gain=1.0 - other.factor, explained=1.0 - max(other.after))
            found.append(other.finding(joints, file=each.name, **sizes_left))
        found += [finding("position-jump", file=each.name, jump=words) for words in each.jumps]
    return [one for one in found if level_of(one)]


def standing_columns(cases: Sequence[Case], joints: Sequence[str]) -> list[Finding]:
    """Return the findings on clipped torques, and on positions and velocities that stand while their joint moves."""
    found = []
    for case in cases:
        clipped, values = [], []
        for fault in case.motion.faults:
            joint = joints[fault.joint]
            if fault.kind == "clipped":
                extremes = " and ".join(f"{value:.4g}" for value in fault.values)
                clipped.append(joint)
                values.append(f"{extremes} in {fault.share:.0%} of its motion")
                continue
            span = {"file": case.name, "joint": joint, "start": fault.start, "stop": fault.stop, "share": fault.share}
            if fault.kind == "velocity":
                found.append(finding("velocity-stands", missed=fault.missed, **span))
            else:
                found.append(finding("encoder-stands", missed=fault.missed, **span))
        if clipped:
            found.append(finding("torque-clipped", file=case.name, joints=clipped, values=values))
    return [one for one in found if level_of(one)]


def wrong_joints(found: Mapping[str, Explanation | None], joints: Sequence[str]) -> list[Finding]:
    """Return the findings on joints, by name, with a reversed sign or an angle relative to another joint."""
    wrong = []
    for name, each in found.items():
        if each is None:
            continue
        concerned = sorted({change.joints[0] for change in each.changes})
        for change in sorted(each.changes, key=lambda one: one.joints):
            j, k = change.joints[0], change.joints[-1]
            wrong.append(
                finding(
                    change.code,
                    file=name,
                    joint=joints[j],
                    other=joints[k],
                    **change.values,
                    before=np.sqrt(each.before[j]),
                    after=np.sqrt(each.after[j]),
                    gain=1.0 - each.factor,
                    factor=each.factor,
                    explained=1.0 - max(each.after[concerned]),
                )
            )
    return [one for one in wrong if level_of(one)]


def impossible(found: Contradiction | None) -> list[Finding]:
    """Return the finding that an estimate is far from every physically consistent robot."""
    if found is None:
        return []
    one = finding(
        "no-possible-robot",
        distance=found.distance,
        allowed=found.allowed,
        unexplained=found.unexplained,
        times=found.distance / found.allowed,
    )
    return [one] if level_of(one) else []


def described(chain: Chain) -> list[Finding]:
    """Return the finding on physically inconsistent bodies in the robot's description."""
    wrong = impossible_bodies(chain)
    return [finding("inconsistent-bodies", bodies=wrong)] if wrong else []


def another_loop(found: LoopDisagreement | None) -> list[Finding]:
    """Return the finding that recorded torques contradict an estimate based on the given control loop."""
    if found is None:
        return []

    def shown(numbers: Sequence[float]) -> list[str]:
        return [f"{x:.3g}" for x in numbers]

    times, median = np.array(found.factor), float(np.median(found.factor))
    scaled = bool(np.ptp(times) < 0.1 * abs(median) and abs(median - 1.0) > 0.1)
    by_joint = not scaled and bool(np.any(np.abs(times - 1.0) > 0.1))
    return [
        finding(
            "loop-refuted",
            method=found.method,
            other=found.beside,
            parameter=found.parameter,
            sigmas=found.sigmas,
            worst=max(found.left),
            left=shown(found.left),
            other_left=shown(found.beside_left),
            times=median if scaled else None,
            factors=shown(found.factor) if by_joint else (),
            velocity="" if scaled or by_joint else "reference_velocity",
        )
    ]


def _masses(each: RecordingSizes, joints: Sequence[str]) -> Iterator[Finding]:
    """Yield findings on the signs and sizes of torques compared with the robot's masses."""
    share = each.masses
    sure = np.flatnonzero(np.isfinite(share)).tolist()
    if not sure:
        return
    if against := [joints[j] for j in sure if share[j] < 0.0]:
        yield finding("torques-against-masses", file=each.name, joints=against)
        return
    shares = [f"{joints[j]} {share[j]:.2g}" for j in sure]
    all_off = finding("torques-unlike-masses", file=each.name, times=_off(np.median(share[sure])), shares=shares)
    one_off = finding("torque-of-joint-unlike-masses", file=each.name, times=_off(share[sure]), shares=shares)
    yield all_off if level_of(all_off) else one_off


def _off(ratio: np.ndarray | np.floating) -> float:
    """Return the largest factor by which one of several ratios differs from 1."""
    sizes = np.maximum(np.abs(ratio), 1e-300)
    return float(np.maximum(sizes, 1.0 / sizes).max())


def _limits(each: RecordingSizes, joints: Sequence[str]) -> Iterator[Finding]:
    """Yield findings on torques a thousand times too large or too small for the joints' limits: another unit."""
    known = np.isfinite(each.limits)
    if not known.any():
        return
    largest = float(each.limits[known].max())

    def beyond(times: float, digits: int) -> list[str]:
        far = np.flatnonzero(known & (each.limits > times)).tolist()
        return [f"{joints[j]} {each.limits[j]:.{digits}g}" for j in far]

    if far := beyond(RECORDED.max_effort, 3):
        yield finding("torques-in-another-unit", file=each.name, joints=far)
    else:
        over = beyond(limit("torques-beyond-limits", "times", "marginal"), 2)
        yield finding("torques-beyond-limits", file=each.name, joints=over, times=largest)
        yield finding("torques-below-limits", file=each.name, share=largest, short=1.0 / max(largest, 1e-300))


def _speed(each: RecordingSizes, joints: Sequence[str]) -> Iterator[Finding]:
    """Compare measured velocities with the differentiated positions."""
    min_off, min_common_off, min_sigmas = 0.05, 0.02, 5.0  # at a joint; at all joints alike (our choice)
    ratio = each.speed
    known = np.flatnonzero(np.isfinite(ratio))
    usual = float(np.median(ratio[known])) if len(known) else 1.0
    alike = len(known) > 1 and np.ptp(ratio[known]) < min_common_off * usual
    least = min_common_off if alike else np.maximum(min_off, min_sigmas * each.speed_sigma)
    off = np.flatnonzero(np.abs(np.nan_to_num(ratio, nan=1.0) - 1.0) > least).tolist()
    if not off:
        return
    if not alike:
        named = [f"{joints[j]} ({ratio[j]:.3g})" for j in off]
        yield finding("velocities-unlike-positions", file=each.name, joints=named, times=_off(ratio[off]))
        return
    clock = each.clock
    yield finding(
        "velocities-scaled",
        file=each.name,
        factor=usual,
        times=_off(ratio[off]),
        rate=each.rate,
        counted=usual * each.rate,
        size=max(usual, 1.0 / usual),
        way="large" if usual > 1.0 else "small",
        against=_against(clock, usual),
        ratio=clock and clock.ratio,
        sigma=clock and clock.relative_sigma,
    )


def _against(clock: ClockRatio | None, usual: float) -> str:
    """Return ``stamps`` or ``velocities``: whichever disagrees with the ratio of inertias to masses; "" if neither."""
    if clock is None:
        return ""
    rods_sigma = 0.17  # relative, of a robot's inertias over masses from its lengths (our choice)
    stamps_off, velocities_off = abs(float(np.log(clock.ratio))), abs(float(np.log(clock.ratio / usual**2)))
    if abs(stamps_off - velocities_off) < 2.0 * np.hypot(rods_sigma, clock.relative_sigma):
        return ""
    return "stamps" if velocities_off < stamps_off else "velocities"


def _unlike(each: RecordingSizes, joints: Sequence[str]) -> Iterator[Finding]:
    """Yield the finding on joints whose measured velocities do not match the positions."""
    backwards = [joints[j] for j in np.flatnonzero(each.follows < -FOLLOWS).tolist()]
    others = [joints[j] for j in np.flatnonzero(np.abs(each.follows) <= FOLLOWS).tolist()]
    if backwards or others:
        clock = "these velocities" if each.counted else "the stamps"
        yield finding(
            "velocities-astray", file=each.name, backwards=backwards, others=others, counted=each.counted, clock=clock
        )


def _lag(name: str, lag: Lag | None, joints: Sequence[str]) -> Iterator[Finding]:
    if lag is None:
        return
    if lag.certain:
        yield finding(
            "torques-late",
            file=name,
            by=abs(lag.seconds),
            sigma=lag.sigma,
            way=_way(lag.seconds),
            lag=lag.seconds,
            before=lag.before,
            after=lag.after,
            times=lag.factor,
        )
    if (j := lag.joint) is not None:
        apart = float(lag.own[j] - lag.seconds)
        yield finding(
            "joint-late", file=name, joint=joints[j], by=abs(apart), way=_way(apart), times=float(lag.gains[j])
        )


def _way(seconds: float) -> str:
    return "later" if seconds > 0 else "earlier"


def _clock(name: str, found: ClockRatio | None) -> Iterator[Finding]:
    if found is None:
        return
    times = _off(np.float64(found.ratio))
    yield finding(
        "clock-off",
        file=name,
        ratio=found.ratio,
        sigma=found.relative_sigma,
        times=times,
        surely=times * float(np.exp(-2.0 * found.relative_sigma)),
        stamps=max(found.clock, 1.0 / found.clock),
        way="large" if found.clock > 1.0 else "small",
    )

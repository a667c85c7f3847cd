"""What sizes, signs and clocks of the recordings mean for a verdict, and bodies that cannot be.

All thresholds are our choice. A finding that makes the numbers of a model wrong by far is no note under a pass: it
fails, or holds the verdict at marginal, until the options' ``accept`` says that it is meant. Findings and their names:

masses   torques that pull against the robot's own masses, or `FAR` times as much as these ask for, or a share of it:
         fail; beyond `OFF`, or `FAR` at single joints: marginal
speed    measured velocities that are not the slope of the positions, surely and by `SLIGHT`, or by `COMMON` at all
         joints alike, where either the stamps or the velocities are of another size: marginal; by `WRONG` times: fail.
         Those that do not follow the positions at all, or backwards: a note, marginal where they date the samples
lag      torques that come later than the positions of their row, surely and by 17 ms (``[recording] lag = …`` takes
         them earlier), or those of one joint alone: marginal; where that leaves all errors 1/`HALVES` or less: fail
clock    inertias that are `INERT` times too large or small beside the masses that gravity tells, for the lengths of the
         robot: marginal; beyond `FAR`: fail. Not said where measured velocities say so already
order    two joints with which exchanged the robot's own masses leave less than `EXCHANGED` of the torques, and of no
         joint's more than `UNTOLD`: marginal. Honest recordings gain nothing (1.0 and above), and where another robot,
         or a zero, is wrong, an exchange leaves that wrong
sign     joints whose torques one model of bodies and friction explains with the opposite sign only, also of unseen
         recordings (`calib.identification.checks.whole_robot.reversed_signs`), and of none more than `UNTOLD`: fail
zero     a joint with a right angle or two at whose zero they leave less than `TURNED`, likewise: marginal
limit    torques of a joint beyond `RecordingBounds.max_effort` times its limit, another unit there: fail; beyond `OVER`
         times, a wrong gain or limit: marginal, as where none at any joint reaches `REACHED` of its limit. Recordings
         at hand: 0.2 to 0.7
jump     a position that leaves the slope of the rows around it: marginal
bodies   an estimate that is `NO_ROBOT` times as far from every possible robot as 95 % of right ones are: marginal;
         beyond `NEVER` times: fail. Honest recordings at hand are up to 3.6 times as far (LWR4+; Panda 1.5, TIAGo 2.3).
         Not said where that robot leaves less than `NOTICED` % of the torque more: precise data find 0.1 % of a gain
description  bodies of it that cannot exist (`calib.robot.description_checks`): marginal, since what the
         torques do not tell is drawn to them, and the recordings are held against them
loop     an estimate that takes the loop for granted (cloe, clie) and that recorded torques refute, see
         `calib.identification.methods.loop_agreement`: marginal; where it leaves `LOST` % of a torque: fail
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from calib.data.recordings.checks import LIMITS as RECORDED
from calib.identification.checks.recording_sizes import FOLLOWS, RecordingSizes
from calib.identification.checks.torque_lag import Lag
from calib.identification.checks.whole_robot import ClockRatio, Rearranged, ReversedSigns
from calib.identification.methods.loop_agreement import LoopDisagreement
from calib.identification.possible.contradiction import Contradiction
from calib.procedure.findings import SpelledFinding as Finding
from calib.robot.chain import Chain
from calib.robot.description_checks import impossible_bodies

FAR, OFF = 3.0, 2.2
SLIGHT, COMMON, SURELY, WRONG = 0.05, 0.02, 5.0, 1.5
HALVES = 2.0
INERT, RODS = 2.0, 0.17
LOST = 30.0
EXCHANGED, TURNED, UNTOLD = 0.95, 0.7, 0.3
NO_ROBOT, NEVER, NOTICED = 5.0, 10.0, 2.0
OVER, REACHED = 1.2, 0.01


def findings(sizes: Sequence[RecordingSizes], joints: Sequence[str]) -> list[Finding]:
    """Return what is odd with recordings."""
    found: list[Finding] = []
    for each in sizes:
        speed = list(_speed(each, joints))
        found += [
            *_limits(each, joints),
            *_masses(each, joints),
            *speed,
            *([] if speed else _clock(each.name, each.clock)),
        ]
        found += _unlike(each, joints)
        found += [*_lag(each.name, each.lag, joints), *_other(each.name, each.other, joints)]
        found += [Finding("jump", "marginal", f"{each.name}: {words}") for words in each.jumps]
    return found


def wrong_signs(found: Mapping[str, ReversedSigns | None], joints: Sequence[str]) -> list[Finding]:
    """Return what it means that recordings, by name, are explained with torques of the opposite sign."""
    return [
        Finding(
            "sign", "fail",
            f"{name}: the torques of {joints[j]} have the wrong sign: with it reversed, bodies and friction leave "
            f"{100 * after:.0f} % of them unexplained, {100 * before:.0f} % as recorded; reverse it in the log",
        )
        for name, each in found.items()
        if each is not None and max(each.after) ** 2 < UNTOLD
        for j, before, after in zip(each.joints, each.before, each.after)
    ]  # fmt: skip


def impossible(found: Contradiction | None) -> list[Finding]:
    """Return what it means that an estimate is far from every possible robot."""
    if found is None or found.distance < NO_ROBOT * found.allowed or found.unexplained < NOTICED:
        return []
    return [
        Finding(
            "bodies", "fail" if found.distance > NEVER * found.allowed else "marginal",
            f"no possible robot has such torques: the nearest one is {found.distance:.3g} standard deviations away, "
            f"where {found.allowed:.3g} hold 95 % of right ones, and leaves {found.unexplained:.2g} % of the torque "
            "beside what the estimate leaves: is this the robot, are the columns in its order, "
            "which way does gravity point? If all are right, the model lacks a kind of friction, or a load",
        )
    ]  # fmt: skip


def described(chain: Chain) -> list[Finding]:
    """Return what it means that bodies of the robot's description cannot exist."""
    wrong = impossible_bodies(chain)
    if not wrong:
        return []
    words = (
        f"{'; '.join(wrong)}: recordings are held against such masses, and what the torques do not tell is drawn "
        "to them where it can be; correct them in the robot's file, or take them out"
    )
    return [Finding("description", "marginal", words)]


def another_loop(found: LoopDisagreement | None) -> list[Finding]:
    """Return what it means that recorded torques refute an estimate that takes the loop for granted."""
    if found is None:
        return []

    def shown(numbers: Sequence[float]) -> str:
        return " ".join(f"{x:.3g}" for x in numbers)

    times, mean = np.array(found.factor), float(np.median(found.factor))
    words = (
        f"{found.method} and {found.beside} disagree, {found.parameter} by {found.sigmas:.0f} sigma, and "
        f"{found.method} leaves {shown(found.left)} % of the torques where {found.beside} leaves "
        f"{shown(found.beside_left)} %: the [loop] is not the one of the recording, and the sigmas of {found.method} "
        f"do not hold; take {found.beside}, or see to [loop]"
    )
    if np.ptp(times) < 0.1 * abs(mean) and abs(mean - 1.0) > 0.1:
        words += f": all torques are {mean:.2g} times those of {found.beside}, are kp and kd off by that factor?"
    elif np.any(np.abs(times - 1.0) > 0.1):
        words += f": by joint, torques are {shown(found.factor)} times those of {found.beside}, kp, kd?"
    else:
        words += ": gains, rate, delay, how velocities are formed (reference_velocity)?"
    return [Finding("loop", "fail" if max(found.left) > LOST else "marginal", words)]


def _masses(each: RecordingSizes, joints: Sequence[str]) -> Iterator[Finding]:
    """Compare with the robot's own masses: signs, then sizes."""
    share = each.masses
    sure = np.flatnonzero(np.isfinite(share)).tolist()
    if not sure:
        return
    against = [joints[j] for j in sure if share[j] < 0.0]
    if against:
        yield Finding(
            "masses", "fail",
            f"{each.name}: the torques of {', '.join(against)} push the wrong way for the robot's own masses: is a "
            "sign reversed, the torques' or the gravity's, or are columns exchanged?",
        )  # fmt: skip
        return
    usual, told = float(np.median(share[sure])), ", ".join(f"{joints[j]} {share[j]:.2g}" for j in sure)
    words = f"{each.name}: the torques are not those of the robot's own masses, but times {told}"
    advice = "is this the robot, are the columns in its order, the torques in N m behind the gears?"
    if not 1.0 / FAR < usual < FAR:
        yield Finding("masses", "fail", f"{words}: {advice}")
    elif not 1.0 / OFF < usual < OFF or (share[sure] > FAR).any() or (share[sure] < 1.0 / FAR).any():
        yield Finding("masses", "marginal", f"{words}: {advice}")


def _limits(each: RecordingSizes, joints: Sequence[str]) -> Iterator[Finding]:
    """Compare torques with the joints' limits: what is a thousand times too large or too small is in another unit."""
    known = np.isfinite(each.limits)
    beyond = [
        f"{joints[j]} {each.limits[j]:.3g}"
        for j in np.flatnonzero(known & (each.limits > RECORDED.max_effort)).tolist()
    ]
    if beyond:
        yield Finding(
            "limit", "fail",
            f"{each.name}: the torques are beyond the joint's limit at {', '.join(beyond)} times, and not at the "
            "others: are these alone in N mm, or in another unit? Bring all joints to one unit (in a table by its "
            "header, 'tau_1 [Nmm]'), or correct the limits in the robot's file",
        )  # fmt: skip
    elif over := [f"{joints[j]} {each.limits[j]:.2g}" for j in np.flatnonzero(known & (each.limits > OVER)).tolist()]:
        yield Finding(
            "limit", "marginal",
            f"{each.name}: the torques are beyond the joint's limit at {', '.join(over)} times, more than 1 % of the "
            "time: is a gain wrong, a unit, or the limit in the robot's file?",
        )  # fmt: skip
    elif known.any() and (each.limits[known] < REACHED).all():
        yield Finding(
            "limit", "marginal",
            f"{each.name}: no torque reaches {100 * REACHED:g} % of its joint's limit, the largest "
            f"{100 * np.nanmax(each.limits):.2g} %: are these kN m, currents, or torques before the gear? If so, "
            "say units: torque = 'kNm', or kind = 'current'",
        )  # fmt: skip


def _speed(each: RecordingSizes, joints: Sequence[str]) -> Iterator[Finding]:
    """Compare measured velocities with the slopes of the positions."""
    ratio = each.speed
    known = np.flatnonzero(np.isfinite(ratio))
    usual = float(np.median(ratio[known])) if len(known) else 1.0
    alike = len(known) > 1 and np.ptp(ratio[known]) < COMMON * usual
    least = np.maximum(SLIGHT, SURELY * each.speed_sigma)
    off = np.flatnonzero(np.abs(np.nan_to_num(ratio, nan=1.0) - 1.0) > (COMMON if alike else least)).tolist()
    if not off:
        return
    level = "fail" if ((ratio[off] > WRONG) | (ratio[off] < 1.0 / WRONG)).any() else "marginal"
    words = f"{each.name}: the measured velocities are {usual:.3g} times the slopes of the positions at"
    if alike:
        larger = "large" if usual > 1 else "small"
        size = f"{max(usual, 1 / usual):.3g} times too {larger}"
        yield Finding(
            "speed", level,
            f"{words} every joint: by the stamps samples come at {each.rate:.5g} Hz, by the velocities at "
            f"{usual * each.rate:.5g} Hz: are the stamps {size}, or are the velocities? {_which(each, usual)}The "
            'stamps are taken for right here; [filter] clock = "counted" in the options takes the velocities, where '
            "they tell one sample from the next. Accelerations and inertias rest on it",
        )  # fmt: skip
        return
    named = ", ".join(f"{joints[j]} ({ratio[j]:.3g})" for j in off)
    words = f"{each.name}: the measured velocities are not the slopes of the positions but times {named}"
    yield Finding(
        "speed", level, f"{words}: are columns exchanged, or units? Accelerations and inertias rest on the stamps"
    )


def _which(each: RecordingSizes, usual: float) -> str:
    """Say whether inertias beside masses speak against the stamps or the velocities; empty: they do not tell."""
    if each.clock is None:
        return ""
    right = abs(float(np.log(each.clock.ratio)))
    wrong = abs(float(np.log(each.clock.ratio / usual**2)))
    if abs(right - wrong) < 2.0 * np.hypot(RODS, each.clock.relative_sigma):
        return ""
    against = "stamps" if wrong < right else "velocities"
    size = f"{each.clock.ratio:.3g} times (± {100 * each.clock.relative_sigma:.0f} %)"
    return f"Inertias beside masses, {size} those of a robot of these lengths, speak against the {against}. "


def _unlike(each: RecordingSizes, joints: Sequence[str]) -> Iterator[Finding]:
    """Say which measured velocities do not follow the positions."""
    against = [joints[j] for j in np.flatnonzero(each.follows < -FOLLOWS).tolist()]
    other = [joints[j] for j in np.flatnonzero(np.abs(each.follows) <= FOLLOWS).tolist()]
    ways = [
        f"{what} {', '.join(at)}" for what, at in (("run backwards at", against), ("are other ones at", other)) if at
    ]
    if ways:
        yield Finding(
            "speed", "marginal" if each.counted else "pass",
            f"{each.name}: the measured velocities are not the slopes of the positions: they {' and '.join(ways)}: is "
            "a sign reversed, are columns exchanged, or were they not logged? "
            + ("The samples are dated by them" if each.counted else "Nothing rests on them here"),
        )  # fmt: skip


def _lag(name: str, lag: Lag | None, joints: Sequence[str]) -> Iterator[Finding]:
    if lag is None:
        return
    if lag.told:
        size = f"{1e3 * abs(lag.seconds):.0f} ± {1e3 * lag.sigma:.0f} ms {_way(lag.seconds)}"
        yield Finding(
            "lag", "fail" if lag.factor > HALVES else "marginal",
            f"{name}: the torques come {size} than the positions: [recording] lag = {lag.seconds:.3f} in the options "
            f"takes them back; a model of bodies and friction then leaves {100 * lag.after:.1f} % of the joints' "
            f"torques, {100 * lag.before:.1f} % as recorded",
        )  # fmt: skip
    if (j := lag.joint) is not None:
        apart = float(lag.own[j] - lag.seconds)
        yield Finding(
            "lag", "marginal",
            f"{name}: the torques of {joints[j]} alone come some {1e3 * abs(apart):.0f} ms {_way(apart)} than those of "
            f"the other joints, which leaves {lag.gains[j]:.2g} times as much of them unexplained: have its drive and "
            "its encoder one clock?",
        )  # fmt: skip


def _way(seconds: float) -> str:
    return "later" if seconds > 0 else "earlier"


def _clock(name: str, found: ClockRatio | None) -> Iterator[Finding]:
    if found is None:
        return
    off = abs(np.log(found.ratio))
    if off < np.log(INERT) + 2.0 * found.relative_sigma:
        return
    times = max(found.clock, 1.0 / found.clock)
    yield Finding(
        "clock", "fail" if off > np.log(FAR) else "marginal",
        f"{name}: beside the masses that gravity tells, inertias are {found.ratio:.3g} times (± "
        f"{100 * found.relative_sigma:.0f} %) those of a robot of these lengths: are the stamps some {times:.2g} times "
        f"too {'large' if found.clock > 1.0 else 'small'}?",
    )  # fmt: skip


def _other(name: str, found: Rearranged | None, joints: Sequence[str]) -> Iterator[Finding]:
    if found is None or found.left > UNTOLD or found.factor > (TURNED if found.quarters else EXCHANGED):
        return
    named = " and ".join(joints[j] for j in found.joints)
    share = f"the robot's own masses leave {100 * found.factor:.0f} % of what they leave as recorded"
    if found.quarters:
        degrees = (90 * found.quarters + 180) % 360 - 180 or 180
        yield Finding(
            "zero", "marginal",
            f"{name}: with {degrees:+.0f} deg at {named} {share}: is its zero elsewhere than the robot file's, or is "
            "this another robot?",
        )  # fmt: skip
    else:
        yield Finding("order", "marginal", f"{name}: with {named} exchanged {share}: are these columns exchanged?")

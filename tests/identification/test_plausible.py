"""Recordings that are not what they claim: signs, sizes and clocks, against the robot's own masses and stamps."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.data.recordings.checks import check_recording
from calib.data.recordings.recording import Joints, Recording, earlier
from calib.data.signals.motion import FilterOptions, make_motion
from calib.errors import MeasurementError
from calib.identification.cases import Case, make_case
from calib.identification.checks.recording_sizes import compare_sizes, signs_of
from calib.identification.checks.whole_robot import Rearranged
from calib.identification.identify import identify
from calib.identification.possible.contradiction import Contradiction, contradiction
from calib.identification.settings import IdentificationSettings
from calib.procedure.dynamic_stage.plausibility import described, findings, impossible, wrong_signs
from calib.procedure.findings import SpelledFinding as Finding
from calib.procedure.findings import Verdict, settled
from calib.robot.load import load

NAMES = ("joint1", "joint2", "joint3")
ARM = replace(planted.arm(), joints=tuple(replace(joint, effort=60.0) for joint in planted.arm().joints))


def recorded(late: float = 0.0, clock: float = 1.0, seed: int = 0, **series: np.ndarray) -> Recording:
    """Return the planted arm's recording, with measured velocities, torques late [s], stamps times `clock`."""
    t, q, v, a = planted.motion(seed)
    tau = planted.torques(q, v, a) + 0.2 * np.random.default_rng(seed).normal(size=q.shape)
    tau = np.column_stack([np.interp(t - late, t, own) for own in tau.T])
    return Recording(clock * t, q, series.get("tau", tau), "torque", NAMES, v=series.get("v", v), file="log")


def case_of(recording: Recording) -> Case:
    return make_case("log", make_motion(recording, FilterOptions(cutoff=30.0, band=10.0)))


def found(recording: Recording, gravity: tuple[float, ...] | None = None) -> list[Finding]:
    return findings([compare_sizes(case_of(recording), ARM, gravity)], NAMES)


def test_a_sound_recording_is_not_remarked_upon() -> None:
    assert found(recorded()) == []
    sizes = compare_sizes(case_of(recorded()), ARM)
    assert sizes.masses[1] == pytest.approx(1.0, abs=0.15) and sizes.speed == pytest.approx(1.0, abs=1e-3)


def test_torques_against_the_robots_own_masses_fail() -> None:
    (one,) = found(recorded(), gravity=(0.0, 0.0, 9.81))
    assert (one.name, one.level) == ("masses", "fail") and "joint2" in one.words and "wrong way" in one.words


@pytest.mark.parametrize("joint", [0, 1, 2])
def test_one_joint_in_another_unit_is_named(joint: int) -> None:
    tau = recorded().effort.copy()
    tau[:, joint] *= 1e3
    (one,) = [one for one in found(recorded(tau=tau)) if one.name == "limit"]
    named = re.search(r"limit at joint(\d) ([0-9.e+]+) times", one.words)
    assert one.level == "fail" and named is not None and int(named[1]) == joint + 1
    assert float(named[2]) == pytest.approx(np.quantile(np.abs(tau[:, joint]), 0.99) / 60.0, rel=0.1)


@pytest.mark.parametrize("factor, level", [(1.0, None), (2.0, "marginal"), (10.0, "fail")])
def test_a_gain_that_takes_a_joint_beyond_its_limit_is_told(factor: float, level: str | None) -> None:
    usual = np.quantile(np.abs(recorded().effort[:, 2]), 0.99)
    arm = replace(ARM, joints=(*ARM.joints[:2], replace(ARM.joints[2], effort=1.1 * usual)))
    case = case_of(recorded(tau=recorded().effort * [1.0, 1.0, factor]))
    told = [one for one in findings([compare_sizes(case, arm)], NAMES) if one.name == "limit"]
    assert [one.level for one in told] == ([level] if level else [])
    assert all("limit at joint3" in one.words for one in told)


def test_torques_that_reach_no_share_of_any_limit_are_another_unit() -> None:
    (one,) = [one for one in found(recorded(tau=1e-3 * recorded().effort)) if one.name == "limit"]
    assert one.level == "marginal" and "kN m" in one.words


@pytest.mark.parametrize("factor, level", [(1.5, None), (2.6, "marginal"), (4.0, "fail"), (0.2, "fail")])
def test_torques_of_another_robot_are_told_by_their_size(factor: float, level: str | None) -> None:
    one = next((one for one in found(recorded(tau=factor * recorded().effort)) if one.name == "masses"), None)
    assert (one.level if one else None) == level


@pytest.mark.parametrize(
    "clock, level", [(1.01, None), (1.03, "marginal"), (1.1, "marginal"), (2.0, "fail"), (0.5, "fail")]
)
def test_velocities_that_are_no_slopes_are_told(clock: float, level: str | None) -> None:
    one = next((one for one in found(recorded(clock=clock)) if one.name == "speed"), None)
    assert (one.level if one else None) == level
    assert one is None or f"are the stamps {max(clock, 1 / clock):.3g} times too" in one.words


@pytest.mark.parametrize("late", [0.0, 0.005, 0.02, 0.05, -0.05, 0.1, 0.2])
def test_a_lag_of_all_torques_is_found_and_taken_back(late: float) -> None:
    lag = compare_sizes(case_of(recorded(late)), ARM).lag
    assert lag is not None and lag.seconds == pytest.approx(late, abs=0.001) and lag.told == (abs(late) > 0.015)
    told = [one for one in found(recorded(late)) if one.name == "lag"]
    assert [one.level for one in told] == ([] if not lag.told else ["fail" if abs(late) > 0.04 else "marginal"])
    if lag.told:
        assert f"{1e3 * abs(late):.0f} ± 5 ms {'later' if late > 0 else 'earlier'}" in told[0].words
        back = compare_sizes(case_of(earlier(recorded(late), lag.seconds)), ARM).lag
        assert back is not None and not back.told


def bending(t: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return friction (N, n) whose sign follows that of the speed as joints bend before they slide, 2 mrad long."""
    z = np.zeros_like(v)
    for k, step in enumerate(np.diff(t)):
        way = np.sign(v[k])
        z[k + 1] = way + (z[k] - way) * np.exp(-np.abs(v[k]) * step / 2e-3)
    return z


@pytest.mark.parametrize("late", [0.0, 0.05])
def test_friction_that_turns_over_late_is_no_lag(late: float) -> None:
    t, q, v, a = planted.motion(0)
    tau = planted.torques(q, v, a) + np.array(planted.DRIVES["Fc"]) * (bending(t, v) - np.sign(v))
    tau = np.column_stack([np.interp(t - late, t, own) for own in tau.T])
    lag = compare_sizes(case_of(recorded(tau=tau)), ARM).lag  # 31 ms more, were friction taken to turn at once
    assert lag is not None and lag.seconds == pytest.approx(late, abs=0.008) and lag.told == (late > 0)


def test_halves_that_disagree_and_short_motion_tell_no_lag() -> None:
    late, early = recorded(0.1).effort, recorded(-0.02).effort
    tau = np.where(recorded().t[:, None] < 10.0, late, early)
    lag = compare_sizes(case_of(recorded(tau=tau)), ARM).lag
    assert lag is not None and lag.sigma > 0.05 and not lag.told
    assert compare_sizes(case_of(recorded(0.1).cut(2.0, 4.5)), ARM).lag is None


def test_one_joint_that_comes_late_is_no_clock_and_named() -> None:
    tau = recorded().effort.copy()
    tau[:, 2] = recorded(0.05).effort[:, 2]
    lag = compare_sizes(case_of(recorded(tau=tau)), ARM).lag
    assert lag is not None and not lag.told and lag.joint == 2
    (one,) = [one for one in found(recorded(tau=tau)) if one.name == "lag"]
    assert one.level == "marginal" and "the torques of joint3 alone come some 49 ms later" in one.words


def test_a_finding_holds_the_verdict_until_it_is_accepted() -> None:
    odd = [Finding("masses", "fail", "wrong way"), Finding("lag", "pass", "late")]
    accepted = settled(odd, ("masses",))
    held = Verdict("pass", "5 %").held_by(odd)
    assert held == Verdict("fail", "wrong way; 5 %")
    assert Verdict("pass", "5 %").held_by(accepted) == Verdict("pass", "5 %")
    assert [one.told for one in odd] == ['wrong way; if that is meant, accept = ["masses"] in the options', "late"]
    assert accepted[0].told == "wrong way (accepted by the options)"


def test_torques_beyond_all_limits_are_another_unit() -> None:
    joints = Joints(NAMES, effort=np.full(3, 60.0))
    check_recording(recorded(), joints)
    with pytest.raises(MeasurementError, match="N mm"):
        check_recording(recorded(tau=1e3 * recorded().effort), joints)
    larger = recorded().effort * [1.0, 3.0, 1.0]
    assert "another unit?" in " ".join(check_recording(recorded(tau=larger), joints).notes)


@pytest.mark.parametrize("spike", [100.0, 1e5, 1e300])
@pytest.mark.parametrize("limit", [60.0, np.inf])
def test_a_spike_of_a_torque_is_left_out_with_its_row_and_many_are_refused(spike: float, limit: float) -> None:
    joints, log = Joints(NAMES, effort=np.full(3, limit)), recorded()
    spiked = log.effort.copy()
    spiked[7, 1] = spike
    kept = check_recording(recorded(tau=spiked), joints)
    if spike < 1e3:  # nothing says that it is none
        assert len(kept) == len(log)
        return
    (note,) = [note for note in kept.notes if "spike" in note]
    assert len(kept) == len(log) - 1 and note.startswith(f"row 8: the torque of joint2 (joint 2) is {spike:.4g} at ")
    assert check_recording(kept, joints).notes == kept.notes
    spiked[7:400:7, 1] = spike
    if limit < np.inf or spike > 1e12:
        with pytest.raises(MeasurementError, match=r"row 8.*torque of joint2.*more rows"):
            check_recording(recorded(tau=spiked), joints)


def test_currents_without_gains_compare_with_no_masses() -> None:
    one = replace(case_of(recorded()), target=5.0 * case_of(recorded()).target)
    assert np.isnan(compare_sizes(one, ARM, newtons=False).masses).all()


def test_an_encoder_that_jumps_is_named_with_its_rows_and_holds_the_verdict() -> None:
    assert check_recording(recorded()).jumps == ()
    q = recorded().q.copy()
    q[2000:, 2] += 0.05
    jumping = check_recording(replace(recorded(), q=q))
    assert "joint3 jumps by 50" in jumping.jumps[0] and "between rows 2000 and 2001" in jumping.jumps[0]
    (one,) = [one for one in found(jumping) if one.name == "jump"]
    assert one.level == "marginal" and one.words == f"log: {jumping.jumps[0]}"


@pytest.mark.parametrize("clock, level", [(1.0, None), (1.2, None), (2.0, "fail"), (0.5, "fail"), (3.0, "fail")])
def test_a_clock_is_told_without_velocities(clock: float, level: str | None) -> None:
    """Of a robot whose masses are not known, too: lengths suffice."""
    stamped = replace(recorded(clock=clock), v=None)
    for arm in (ARM, replace(ARM, inertias=None)):
        told = findings([compare_sizes(case_of(stamped), arm)], NAMES)
        one = next((one for one in told if one.name == "clock"), None)
        assert (one.level if one else None) == level
        if one is not None:
            times = re.search(r"stamps some ([0-9.]+) times too (large|small)", one.words)
            assert times is not None and float(times[1]) == pytest.approx(max(clock, 1 / clock), rel=0.35)
            assert times[2] == ("large" if clock > 1 else "small")


def test_a_clock_is_told_once() -> None:
    assert [one.name for one in found(recorded(clock=2.0))] == ["speed"]


def test_exchanged_joints_are_named() -> None:
    log = recorded()
    order = [0, 2, 1]
    one = replace(log, q=log.q[:, order], effort=log.effort[:, order], v=None)
    (told,) = [one for one in found(one) if one.name == "order"]
    assert told.level == "marginal" and "joint2 and joint3 exchanged" in told.words


def test_a_right_angle_at_a_joints_zero_is_named_and_no_exchange_is_told_in_its_place() -> None:
    turned = recorded().q + np.array([0.0, np.pi / 2, 0.0])
    told = [one for one in found(replace(recorded(), q=turned, v=None)) if one.name in ("zero", "order")]
    assert [one.level for one in told] == ["marginal"] and "with -90 deg at joint2" in told[0].words


@pytest.mark.parametrize("reverse", [(), (0,), (1,), (2,), (0, 2)])
def test_joints_of_reversed_sign_are_named_and_no_others(reverse: tuple[int, ...]) -> None:
    """Whether the robot's own masses are known or not."""
    signs = np.where(np.isin(np.arange(3), reverse), -1.0, 1.0)
    case = case_of(recorded(tau=recorded().effort * signs))
    for arm in (ARM, replace(ARM, inertias=None)):
        told = wrong_signs({"log": signs_of(case, arm)}, NAMES)
        assert [one.level for one in told] == ["fail"] * len(reverse)
        assert all(f"log: the torques of {NAMES[j]} have the wrong sign" in one.words for j, one in zip(reverse, told))


def test_an_exchange_that_leaves_the_torques_unexplained_is_not_told() -> None:
    def told(left: float, factor: float, quarters: int = 0) -> bool:
        joints = (1,) if quarters else (1, 2)
        size = replace(compare_sizes(case_of(recorded()), ARM), other=Rearranged(joints, quarters, factor, left))
        return bool(findings([size], NAMES))

    assert told(0.02, 0.9) and not told(0.46, 0.85) and not told(0.02, 0.99)
    assert told(0.02, 0.5, 1) and not told(0.02, 0.9, 1)


def logged(clock: float = 1.0, speed: float | np.ndarray = 1.0) -> Recording:
    """Return a recording whose logger read some samples twice and missed others: its dates are counted."""
    rng, whole = np.random.default_rng(3), recorded()
    k = np.cumsum(rng.choice([0, 1, 2], len(whole), p=[0.06, 0.88, 0.06]))
    k = k[k < len(whole)]
    t = np.arange(len(k)) * (whole.t[k[-1]] / len(k)) + rng.uniform(0.0, 1e-3, len(k))
    assert whole.v is not None
    return replace(
        whole, t=clock * t, q=whole.q[k], v=whole.v[k] * speed, effort=whole.effort[k], rows=np.arange(len(k))
    )


@pytest.mark.parametrize("clock, speed", [(1.0, 0.9), (1.0, 1.1), (1.0, 2.0), (2.0, 1.0), (0.9, 1.0), (0.1, 1.0)])
def test_counted_dates_that_contradict_the_stamps_are_told_with_both_rates(clock: float, speed: float) -> None:
    case = case_of(logged(clock, speed)) if clock != 0.1 else make_case("log", make_motion(logged(clock, speed)))
    assert case.motion.sampling.clock == "counted" and case.motion.rate * clock == pytest.approx(200.0, rel=0.01)
    (one,) = [one for one in findings([compare_sizes(case, ARM)], NAMES) if one.name == "speed"]
    assert one.level == ("fail" if not 0.6 < clock * speed < 1.5 else "marginal")
    rates = re.search(r"by the stamps samples come at ([0-9.]+) Hz, by the velocities at ([0-9.]+) Hz", one.words)
    assert rates is not None and float(rates[1]) == pytest.approx(200.0 / clock, rel=0.01)
    assert float(rates[2]) == pytest.approx(200.0 * speed, rel=0.01)


def test_inertias_beside_masses_say_whether_stamps_or_velocities_are_wrong() -> None:
    v = recorded().v
    assert v is not None
    for one, words in ((recorded(clock=2.0), "against the stamps"), (recorded(v=2.0 * v), "against the velocities")):
        (told,) = found(one)
        assert (told.name, told.level) == ("speed", "fail") and words in told.words


def test_counted_dates_are_the_velocities_where_that_is_asked_for_and_agree_where_nothing_is_wrong() -> None:
    assert found(logged()) == []
    asked = make_motion(logged(2.0), FilterOptions(cutoff=30.0, band=10.0, clock="counted"))
    assert asked.rate == pytest.approx(200.0, rel=0.01)
    (note,) = [note for note in asked.notes if "as long by the measured velocities as by the stamps" in note]
    assert float(note.split()[3]) == pytest.approx(0.5, rel=0.01)


def test_velocities_that_do_not_follow_the_positions_are_noted() -> None:
    v, noise = recorded().v, np.random.default_rng(1).normal(size=(len(recorded()), 3))
    assert v is not None
    for wrong, words in (
        (-v, "run backwards at joint1, joint2, joint3"), (0 * v, "are other ones at joint1, joint2, joint3"),
        (noise, "are other ones at joint1"),
        (v * [1.0, 1.0, -1.0], "they run backwards at joint3:"),
    ):  # fmt: skip
        (one,) = found(recorded(v=wrong))
        assert (one.name, one.level) == ("speed", "pass") and words in one.words


def test_a_motion_too_short_to_compare_velocities_is_not_remarked_upon() -> None:
    """A date wrong by 1 % moves a joint by that share of its travel, of which little is left beside a trend."""
    long, short = (compare_sizes(case_of(one), ARM) for one in (recorded(), recorded().cut(2.0, 3.6)))
    assert short.speed_sigma.max() > 2.0 * long.speed_sigma.max() and long.speed_sigma.max() < 0.012
    odd = replace(long, speed=np.array([1.0, 1.06, 0.99]))
    assert [one.name for one in findings([odd], NAMES)] == ["speed"]
    assert findings([replace(odd, speed_sigma=np.full(3, 0.02))], NAMES) == []


def test_a_gap_of_the_log_is_no_slope() -> None:
    log = recorded()
    gap = (log.t > 4.0) & (log.t < 7.0)
    assert found(log.take(~gap)) == []


def away(recording: Recording) -> Contradiction:
    """Return how far an identification is from every possible robot."""
    settings = IdentificationSettings(friction="standard", essential="none", prior="none")
    far = contradiction(identify(ARM, [case_of(recording)], settings), ARM)
    assert far is not None
    return far


def test_an_estimate_far_from_every_possible_robot_fails_and_one_with_other_friction_is_not_remarked() -> None:
    sound = away(recorded())
    assert sound.distance < sound.allowed and impossible(sound) == []
    bent = away(recorded(tau=recorded().effort + 5.0 * np.sin(3.0 * recorded().q)))
    assert impossible(bent) == []
    (one,) = impossible(away(recorded(tau=recorded().effort * [1.0, -1.0, 1.0])))
    assert one.level == "fail" and "no possible robot" in one.words and 'accept = ["bodies"]' in one.told
    assert settled([one], ["bodies"])[0].allows == "pass"


def test_a_contradiction_is_remarked_by_its_size() -> None:
    levels = [[one.level for one in impossible(Contradiction(10.0 * times, 10.0, 3.0))] for times in (4.0, 6.0, 12.0)]
    assert levels == [[], ["marginal"], ["fail"]] and impossible(None) == []
    assert impossible(Contradiction(120.0, 10.0, 0.1)) == []


def test_a_description_that_cannot_be_allows_no_pass():
    chain = load("lwr4plus")
    assert described(chain) == []
    bodies = np.array(chain.inertias)
    bodies[2, 9] = -1.0
    wrong = described(replace(chain, inertias=bodies))
    assert Verdict("pass", "good").held_by(settled(wrong, ())).level == "marginal"
    assert "a negative mass (M = -1 kg)" in wrong[0].words and 'accept = ["description"]' in wrong[0].told
    assert Verdict("pass", "good").held_by(settled(wrong, ["description"])).level == "pass"

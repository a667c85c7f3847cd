"""Recordings that are not what they claim: signs, sizes and clocks, against the robot's own masses and stamps."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.column_changes import Change, Explanation
from calib.data.recordings.checks import check_recording
from calib.data.recordings.recording import Recording, earlier
from calib.data.schema import Joints
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.rigid_body import inverse_dynamics
from calib.errors import Finding, MeasurementError, finding
from calib.identification.checks.recording_sizes import compare_sizes, signs_of
from calib.identification.identify import identify
from calib.identification.physical_consistency.solve import Contradiction, contradiction
from calib.identification.rows import Case, make_case
from calib.identification.settings import IdentificationSettings
from calib.procedure.dynamic_stage.hypotheses import tare_findings
from calib.procedure.dynamic_stage.inputs import IdentificationInputs, gather
from calib.procedure.dynamic_stage.plausibility import described, findings, impossible, sampling_findings, wrong_joints
from calib.procedure.findings import Verdict, level_of, lines_of, settle
from calib.robot.calibrated import CalibratedChain
from calib.robot.library import load
from calib.simulation.known_robots import random_fourier

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


def inputs_of(recording: Recording) -> IdentificationInputs:
    """Return the inputs of an identification of the planted arm from one recording, checked as a file is."""
    return gather(CalibratedChain(ARM, source="planted"), [recording])


def found(recording: Recording, gravity: tuple[float, ...] | None = None) -> list[Finding]:
    return findings([compare_sizes(case_of(recording), ARM, gravity)], NAMES)


def coded(found: list[Finding], *codes: str) -> list[Finding]:
    return [one for one in found if one.code in codes]


def test_sound_recording_is_not_remarked() -> None:
    """A sound recording is not remarked upon."""
    sizes = compare_sizes(case_of(recorded()), ARM)
    assert findings([sizes], NAMES) == []
    assert sizes.masses[1] == pytest.approx(1.0, abs=0.15) and sizes.speed == pytest.approx(1.0, abs=1e-3)


def test_torques_against_own_masses_fail() -> None:
    """Torques against the robot's own masses fail."""
    (one,) = found(recorded(), gravity=(0.0, 0.0, 9.81))
    assert (one.code, level_of(one)) == ("torques-against-masses", "fail") and "joint2" in one.values["joints"]


@pytest.mark.parametrize("joint", [pytest.param(0, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.slow), 2])
def test_one_joint_in_another_unit_is_named(joint: int) -> None:
    tau = recorded().effort.copy()
    tau[:, joint] *= 1e3
    (one,) = coded(found(recorded(tau=tau)), "torques-in-another-unit")
    (named,) = one.values["joints"]
    name, times = named.split()
    assert level_of(one) == "fail" and name == NAMES[joint]
    assert float(times) == pytest.approx(np.quantile(np.abs(tau[:, joint]), 0.99) / 60.0, rel=0.1)


@pytest.mark.parametrize(
    "factor, level",
    [
        pytest.param(1.0, None, marks=pytest.mark.slow),
        pytest.param(2.0, "marginal", marks=pytest.mark.slow),
        (10.0, "fail"),
    ],
)
def test_gain_beyond_joint_limit_is_told(factor: float, level: str | None) -> None:
    """A gain that takes a joint beyond its limit is told."""
    usual = np.quantile(np.abs(recorded().effort[:, 2]), 0.99)
    arm = replace(ARM, joints=(*ARM.joints[:2], replace(ARM.joints[2], effort=1.1 * usual)))
    case = case_of(recorded(tau=recorded().effort * [1.0, 1.0, factor]))
    told = coded(findings([compare_sizes(case, arm)], NAMES), "torques-beyond-limits", "torques-in-another-unit")
    assert [level_of(one) for one in told] == ([level] if level else [])
    assert all(one.values["joints"][0].startswith("joint3 ") for one in told)


def test_tiny_torques_are_another_unit() -> None:
    """Torques that reach no share of any limit are another unit."""
    (one,) = coded(found(recorded(tau=1e-3 * recorded().effort)), "torques-below-limits")
    assert level_of(one) == "marginal" and one.values["share"] < 0.01


@pytest.mark.parametrize(
    "factor, level",
    [
        pytest.param(1.5, None, marks=pytest.mark.slow),
        pytest.param(2.6, "marginal", marks=pytest.mark.slow),
        (4.0, "fail"),
        (0.2, "fail"),
    ],
)
def test_torques_of_another_robot_are_told(factor: float, level: str | None) -> None:
    """Torques of another robot are told by their size."""
    told = coded(found(recorded(tau=factor * recorded().effort)), "torques-unlike-masses")
    assert [level_of(one) for one in told] == ([level] if level else [])


@pytest.mark.parametrize(
    "clock, level",
    [
        (1.01, None),
        (1.03, "marginal"),
        pytest.param(1.1, "marginal", marks=pytest.mark.slow),
        pytest.param(2.0, "fail", marks=pytest.mark.slow),
        (0.5, "fail"),
    ],
)
def test_velocities_unlike_slopes_are_told(clock: float, level: str | None) -> None:
    """Velocities that are no slopes are told."""
    told = coded(found(recorded(clock=clock)), "velocities-scaled")
    assert [level_of(one) for one in told] == ([level] if level else [])
    assert all(one.values["size"] == pytest.approx(max(clock, 1 / clock), rel=2e-3) for one in told)


@pytest.mark.parametrize(
    "late",
    [
        0.0,
        0.005,
        0.02,
        pytest.param(0.05, marks=pytest.mark.slow),
        pytest.param(-0.05, marks=pytest.mark.slow),
        pytest.param(0.1, marks=pytest.mark.slow),
        pytest.param(0.2, marks=pytest.mark.slow),
    ],
)
def test_lag_of_all_torques_is_taken_back(late: float) -> None:
    """A lag of all torques is found and taken back."""
    sizes = compare_sizes(case_of(recorded(late)), ARM)
    lag, told = sizes.lag, coded(findings([sizes], NAMES), "torques-late")
    assert lag is not None and lag.seconds == pytest.approx(late, abs=0.001) and lag.certain == (abs(late) > 0.015)
    assert [level_of(one) for one in told] == ([] if not lag.certain else ["fail" if abs(late) > 0.04 else "marginal"])
    if lag.certain:
        assert told[0].values["by"] == pytest.approx(abs(late), abs=5e-4)
        assert told[0].values["way"] == ("later" if late > 0 else "earlier")
        assert told[0].values["sigma"] == pytest.approx(0.005, abs=5e-4)
        back = compare_sizes(case_of(earlier(recorded(late), lag.seconds)), ARM).lag
        assert back is not None and not back.certain


def bending(t: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return friction (N, n) whose sign follows that of the speed as joints bend before they slide, 2 mrad long."""
    z = np.zeros_like(v)
    for k, step in enumerate(np.diff(t)):
        way = np.sign(v[k])
        z[k + 1] = way + (z[k] - way) * np.exp(-np.abs(v[k]) * step / 2e-3)
    return z


@pytest.mark.parametrize("late", [pytest.param(0.0, marks=pytest.mark.slow), 0.05])
def test_late_friction_is_no_lag(late: float) -> None:
    """Friction that turns over late is no lag."""
    t, q, v, a = planted.motion(0)
    tau = planted.torques(q, v, a) + np.array(planted.DRIVES["Fc"]) * (bending(t, v) - np.sign(v))
    tau = np.column_stack([np.interp(t - late, t, own) for own in tau.T])
    lag = compare_sizes(case_of(recorded(tau=tau)), ARM).lag  # 31 ms more, were friction taken to turn at once
    assert lag is not None and lag.seconds == pytest.approx(late, abs=0.008) and lag.certain == (late > 0)


def test_disagreeing_halves_tell_no_lag() -> None:
    """Halves that disagree, and short motion, tell no lag."""
    late, early = recorded(0.1).effort, recorded(-0.02).effort
    tau = np.where(recorded().t[:, None] < 10.0, late, early)
    lag = compare_sizes(case_of(recorded(tau=tau)), ARM).lag
    assert lag is not None and lag.sigma > 0.05 and not lag.certain
    assert compare_sizes(case_of(recorded(0.1).cut(2.0, 4.5)), ARM).lag is None


def test_one_late_joint_is_named() -> None:
    """One joint that comes late is no clock, and is named."""
    tau = recorded().effort.copy()
    tau[:, 2] = recorded(0.05).effort[:, 2]
    sizes = compare_sizes(case_of(recorded(tau=tau)), ARM)
    lag = sizes.lag
    assert lag is not None and not lag.certain and lag.joint == 2
    (one,) = coded(findings([sizes], NAMES), "torques-late", "joint-late")
    assert (one.code, level_of(one), one.values["joint"]) == ("joint-late", "marginal", "joint3")
    assert one.values["way"] == "later" and one.values["by"] == pytest.approx(0.049, abs=5e-4)


def test_finding_waits_to_be_accepted() -> None:
    """A finding holds the verdict until it is accepted."""
    wrong = finding("torques-against-masses", file="log", joints=["joint2"])
    held = Verdict.of("5 %", [wrong])
    assert (held.level, held.code) == ("fail", wrong.code)
    assert Verdict.of("5 %", settle([wrong], ("masses",))) == Verdict("pass", "5 %")


def test_huge_torques_are_another_unit() -> None:
    """Torques beyond all limits are another unit."""
    joints = Joints(NAMES, effort=np.full(3, 60.0))
    check_recording(recorded(), joints)
    with pytest.raises(MeasurementError, match="N mm"):
        check_recording(recorded(tau=1e3 * recorded().effort), joints)
    larger = recorded().effort * [1.0, 3.0, 1.0]
    assert "another unit?" in " ".join(check_recording(recorded(tau=larger), joints).notes)


@pytest.mark.parametrize("spike", [100.0, 1e5, 1e300])
@pytest.mark.parametrize("limit", [pytest.param(60.0, marks=pytest.mark.slow), np.inf])
def test_spike_is_dropped_and_many_refused(spike: float, limit: float) -> None:
    """A spike of a torque is left out with its row, and many are refused."""
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


def test_currents_compare_with_no_masses() -> None:
    """Currents without gains compare with no masses."""
    one = replace(case_of(recorded()), target=5.0 * case_of(recorded()).target)
    assert np.isnan(compare_sizes(one, ARM, newtons=False).masses).all()


def test_jumping_encoder_is_named_with_rows() -> None:
    """An encoder that jumps is named with its rows, and holds the verdict."""
    assert check_recording(recorded()).jumps == ()
    q = recorded().q.copy()
    q[2000:, 2] += 0.05
    jumping = check_recording(replace(recorded(), q=q))
    assert "joint3 jumps by 50" in jumping.jumps[0] and "between rows 2000 and 2001" in jumping.jumps[0]
    (one,) = coded(found(jumping), "position-jump")
    assert level_of(one) == "marginal" and one.values == {"file": "log", "jump": jumping.jumps[0]}


def test_jitter_of_stamps_is_no_jump():
    """Stamps that jitter by a third of a step make no encoder jump."""
    log = recorded()
    jitter = 1.6e-3 * np.random.default_rng(0).uniform(-1.0, 1.0, len(log))
    fast = replace(log, t=log.t / 4.0 + jitter / 4.0, v=None)
    assert check_recording(fast).jumps == ()


def test_jitter_and_lost_samples_are_noted() -> None:
    log, rng = recorded(), np.random.default_rng(0)
    jittered = replace(log, t=log.t + 1.2e-3 * rng.uniform(-1.0, 1.0, len(log)), v=None)
    (jitter,) = sampling_findings([case_of(jittered)])
    assert jitter.code == "stamps-jitter" and 0.15 < jitter.values["jitter"] < 0.4
    (missing,) = sampling_findings([case_of(log.take(rng.random(len(log)) > 0.08))])
    assert missing.code == "samples-missing" and missing.values["share"] == pytest.approx(0.08, abs=0.02)
    assert sampling_findings([case_of(log)]) == []


@pytest.mark.parametrize("kind", ["average", pytest.param("start", marks=pytest.mark.slow)])
def test_tared_torques_are_named(kind):
    """Torques zeroed over the log, or at its start, are named; offsets of friction are not."""
    tau = recorded().effort
    zero = tau.mean(axis=0) if kind == "average" else tau[:20].mean(axis=0)
    told = tare_findings(inputs_of(recorded(tau=tau - zero)), None)
    assert [(one.code, one.values["kind"]) for one in told] == [("torques-tared", kind)]
    assert tare_findings(inputs_of(recorded()), None) == []


@pytest.mark.parametrize(
    "clock, level",
    [
        (1.0, None),
        pytest.param(1.2, None, marks=pytest.mark.slow),
        (2.0, "fail"),
        (0.5, "fail"),
        pytest.param(3.0, "fail", marks=pytest.mark.slow),
    ],
)
def test_a_clock_is_told_without_velocities(clock: float, level: str | None) -> None:
    """Of a robot whose masses are not known, too: lengths suffice."""
    stamped = replace(recorded(clock=clock), v=None)
    for arm in (ARM, replace(ARM, inertias=None)):
        told = coded(findings([compare_sizes(case_of(stamped), arm)], NAMES), "clock-off")
        assert [level_of(one) for one in told] == ([level] if level else [])
        for one in told:
            assert one.values["stamps"] == pytest.approx(max(clock, 1 / clock), rel=0.35)
            assert one.values["way"] == ("large" if clock > 1 else "small")


def test_a_clock_is_told_once() -> None:
    assert [one.code for one in found(recorded(clock=2.0))] == ["velocities-scaled"]


def test_exchanged_joints_are_named() -> None:
    log = recorded()
    order = [0, 2, 1]
    one = replace(log, q=log.q[:, order], effort=log.effort[:, order], v=None)
    (told,) = coded(found(one), "columns-exchanged")
    assert level_of(told) == "marginal" and told.values["joints"] == ("joint2", "joint3")


def test_right_angle_at_zero_is_no_exchange() -> None:
    """A right angle at a joint's zero is named, and no exchange is told in its place."""
    turned = recorded().q + np.array([0.0, np.pi / 2, 0.0])
    (told,) = coded(found(replace(recorded(), q=turned, v=None)), "zero-elsewhere", "columns-exchanged")
    assert (level_of(told), told.values["joints"]) == ("marginal", ("joint2",))
    assert told.values["angle"] == pytest.approx(-np.pi / 2)


@pytest.mark.parametrize(
    "reverse",
    [
        (),
        pytest.param((0,), marks=pytest.mark.slow),
        pytest.param((1,), marks=pytest.mark.slow),
        pytest.param((2,), marks=pytest.mark.slow),
        (0, 2),
    ],
)
def test_reversed_joints_alone_are_named(reverse: tuple[int, ...]) -> None:
    """Whether the robot's own masses are known or not."""
    signs = np.where(np.isin(np.arange(3), reverse), -1.0, 1.0)
    case = case_of(recorded(tau=recorded().effort * signs))
    for arm in (ARM, replace(ARM, inertias=None)):
        told = wrong_joints({"log": signs_of(case, arm)}, NAMES)
        assert [(one.code, level_of(one)) for one in told] == [("torque-sign", "fail")] * len(reverse)
        assert [(one.values["file"], one.values["joint"]) for one in told] == [("log", NAMES[j]) for j in reverse]


@pytest.mark.parametrize(
    ("left", "factor", "code", "told"),
    [
        (0.02, 0.9, "columns-exchanged", True),
        pytest.param(0.46, 0.85, "columns-exchanged", False, marks=pytest.mark.slow),
        (0.02, 0.99, "columns-exchanged", False),
        (0.02, 0.5, "zero-elsewhere", True),
        pytest.param(0.02, 0.9, "zero-elsewhere", False, marks=pytest.mark.slow),
    ],
)
def test_change_without_gain_is_not_told(left, factor, code, told) -> None:
    """A change that leaves the torques unexplained is not told."""
    change = Change(code, lambda samples: samples, (1, 0), {"angle": np.pi})
    other = Explanation((change,), np.array([left / factor**2]), np.array([left]))
    assert bool(findings([replace(compare_sizes(case_of(recorded()), ARM), other=other)], NAMES)) == told


@pytest.mark.parametrize("way", [1.0, pytest.param(-1.0, marks=pytest.mark.slow)])
def test_joint_counting_from_last_is_named(way: float) -> None:
    """Whether the robot's own masses are known or not."""
    log = recorded()
    case = case_of(replace(log, q=log.q - way * log.q[:, [0, 1, 1]] * [0.0, 0.0, 1.0], v=None))
    for arm in (ARM, replace(ARM, inertias=None)):
        (told,) = wrong_joints({"log": signs_of(case, arm)}, NAMES)
        assert (told.code, level_of(told)) == ("axis-coupled", "marginal")
        assert [told.values[key] for key in ("joint", "other", "way")] == ["joint3", "joint2", "+" if way > 0 else "-"]


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


@pytest.mark.parametrize(
    "clock, speed",
    [
        (1.0, 0.9),
        pytest.param(1.0, 1.1, marks=pytest.mark.slow),
        pytest.param(1.0, 2.0, marks=pytest.mark.slow),
        pytest.param(2.0, 1.0, marks=pytest.mark.slow),
        pytest.param(0.9, 1.0, marks=pytest.mark.slow),
        (0.1, 1.0),
    ],
)
def test_contradicting_dates_have_both_rates(clock: float, speed: float) -> None:
    """Counted dates that contradict the stamps are told with both rates."""
    case = case_of(logged(clock, speed)) if clock != 0.1 else make_case("log", make_motion(logged(clock, speed)))
    assert case.motion.sampling.clock.kind == "counted" and case.motion.rate * clock == pytest.approx(200.0, rel=0.01)
    (one,) = coded(findings([compare_sizes(case, ARM)], NAMES), "velocities-scaled", "velocities-unlike-positions")
    assert level_of(one) == ("fail" if not 0.6 < clock * speed < 1.5 else "marginal")
    assert one.values["rate"] == pytest.approx(200.0 / clock, rel=0.01)
    assert one.values["counted"] == pytest.approx(200.0 * speed, rel=0.01)


@pytest.mark.parametrize(
    ("factor", "unit"),
    [
        (30.0 / np.pi, "rpm"),
        pytest.param(1e3, "mrad/s or mm/s", marks=pytest.mark.slow),
        pytest.param(2.0, None, marks=pytest.mark.slow),
    ],
)
def test_unit_of_velocities_is_named(factor: float, unit: str | None) -> None:
    v = recorded().v
    assert v is not None
    (told,) = coded(found(recorded(v=factor * v)), "velocities-scaled")
    assert told.values["unit"] == unit and (unit is None or unit in "; ".join(lines_of([told])))


def test_frozen_position_is_asked_for() -> None:
    """A joint that alone never moves, although its torque varies, may have a frozen column."""
    q = np.array(recorded().q)
    q[:, 1] = q[0, 1]
    (note,) = check_recording(replace(recorded(), q=q, v=None)).notes
    assert "joint2 never moves" in note and "is its position column frozen?" in note


def test_inertias_tell_stamps_or_velocities() -> None:
    """Inertias beside masses say whether stamps or velocities are wrong."""
    v = recorded().v
    assert v is not None
    for one, against in ((recorded(clock=2.0), "stamps"), (recorded(v=2.0 * v), "velocities")):
        (told,) = found(one)
        assert (told.code, level_of(told)) == ("velocities-scaled", "fail") and told.values["against"] == against


def test_counted_dates_agree_where_right() -> None:
    """Counted dates follow the velocities where that is asked for, and agree where nothing is wrong."""
    assert found(logged()) == []
    asked = make_motion(logged(2.0), FilterOptions(cutoff=30.0, band=10.0, clock="counted"))
    assert asked.rate == pytest.approx(200.0, rel=0.01)
    (note,) = [note for note in asked.notes if "step from measured velocities / step from stamps" in note]
    assert float(note.split()[-1]) == pytest.approx(0.5, rel=0.01)


@pytest.mark.slow
def test_inconsistent_velocities_are_noted() -> None:
    """Velocities that do not follow the positions are noted."""
    v, noise = recorded().v, np.random.default_rng(1).normal(size=(len(recorded()), 3))
    assert v is not None
    for wrong, backwards, others in (
        (-v, NAMES, ()), (0 * v, (), NAMES), (noise, (), NAMES[:1]), (v * [1.0, 1.0, -1.0], NAMES[2:], ()),
    ):  # fmt: skip
        (one,) = found(recorded(v=wrong))
        assert (one.code, level_of(one)) == ("velocities-astray", "note") and one.values["backwards"] == backwards
        assert one.values["others"][: len(others)] == others


def test_short_motion_is_not_remarked_upon() -> None:
    """A date wrong by 1 % moves a joint by that share of its travel, of which little is left beside a trend."""
    long, short = (compare_sizes(case_of(one), ARM) for one in (recorded(), recorded().cut(2.0, 3.6)))
    assert short.speed_sigma.max() > 2.0 * long.speed_sigma.max() and long.speed_sigma.max() < 0.012
    odd = replace(long, speed=np.array([1.0, 1.06, 0.99]))
    assert [one.code for one in findings([odd], NAMES)] == ["velocities-unlike-positions"]
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


@pytest.mark.slow
def test_estimate_far_from_possible_fails() -> None:
    """An estimate far from every possible robot fails, and one with other friction is not remarked upon."""
    sound = away(recorded())
    assert sound.distance < sound.allowed and impossible(sound) == []
    bent = away(recorded(tau=recorded().effort + 5.0 * np.sin(3.0 * recorded().q)))
    assert impossible(bent) == []
    (one,) = impossible(away(recorded(tau=recorded().effort * [1.0, -1.0, 1.0])))
    assert (one.code, level_of(one)) == ("no-possible-robot", "fail")
    assert level_of(settle([one], ["bodies"])[0]) == "note"


def test_contradiction_is_judged_by_its_size() -> None:
    """A contradiction is remarked upon by its size."""
    far = (impossible(Contradiction(10.0 * times, 10.0, 3.0)) for times in (4.0, 6.0, 12.0))
    levels = [[level_of(one) for one in found] for found in far]
    assert levels == [[], ["marginal"], ["fail"]] and impossible(None) == []
    assert impossible(Contradiction(120.0, 10.0, 0.1)) == []


def test_impossible_description_cannot_pass():
    """A description that cannot exist allows no pass."""
    chain = load("lwr4plus")
    assert described(chain) == []
    bodies = np.array(chain.inertias)
    bodies[2, 9] = -1.0
    wrong = described(replace(chain, inertias=bodies))
    assert Verdict.of("good", wrong).level == "marginal"
    assert "a negative mass (M = -1 kg)" in wrong[0].values["bodies"][0]
    assert Verdict.of("good", settle(wrong, ["description"])).level == "pass"


@pytest.mark.parametrize(
    "clock, level",
    [(1.0, None), pytest.param(0.5, "fail", marks=pytest.mark.slow), pytest.param(3.0, "fail", marks=pytest.mark.slow)],
)
def test_masses_tell_clock_beyond_lengths(clock: float, level: str | None) -> None:
    """BIRDy's TX40 has half the inertia that rods of its lengths would have."""
    arm = load("tx40")
    speed = np.array([joint.velocity for joint in arm.joints])
    motion = random_fourier(0.7 * arm.lower, 0.7 * arm.upper, 0.7 * speed, 10.0, 250.0, acceleration=20.0)
    torque = inverse_dynamics(bodies_of(arm), standard_parameters(arm), motion.q, motion.v, motion.a)
    torque += 0.02 * torque.std(axis=0) * np.random.default_rng(0).normal(size=torque.shape)
    log = Recording(clock * motion.t, motion.q, torque, "torque", arm.joint_names, file="log")
    told = coded(findings([compare_sizes(case_of(log), arm)], arm.joint_names), "clock-off")
    assert [level_of(one) for one in told] == ([level] if level else [])

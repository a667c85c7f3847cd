"""From a log with a bad clock, gaps and noise to the motion that was."""

from dataclasses import replace

import numpy as np
import pytest

from calib.data.recordings.recording import Recording
from calib.data.signals.bandwidth import propose_cutoffs
from calib.data.signals.filtering import decimate
from calib.data.signals.motion import FilterOptions, make_motion, moving
from calib.data.signals.persistency import repeats, report_excitation
from calib.data.signals.resampling import find_clock, resample
from calib.errors import CalibError, MeasurementError, UsageError


def waves(t: np.ndarray, lines=((0.4, 0.9, 1.3), (0.3, 0.7, 1.1)), phase: float = 7.0) -> tuple[np.ndarray, ...]:
    """Return q, v, a (N, n) of sums of sines."""
    w = 2 * np.pi * np.array(lines)
    angle = w * t[:, None, None] + phase * np.array(lines)
    size = 0.8 * np.pi / w
    turned = (np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle))
    return tuple((size * each).sum(axis=-1) for each in turned)


def recorded(t: np.ndarray, true: np.ndarray, noise: float = 0.0, seed: int = 0, measured: bool = True) -> Recording:
    """Return a log stamped `t` of samples taken at `true`."""
    q, v, a = waves(true)
    random = np.random.default_rng(seed)
    tau = 20 * np.cos(q) + 2 * v + 0.5 * a
    q = q + random.normal(0, noise, q.shape) if noise else q
    return Recording(t, q, tau, "torque", ("a", "b"), v=v if measured else None, file="log.npz")


def even(rate: float = 500.0, duration: float = 10.0) -> np.ndarray:
    return np.arange(int(duration * rate)) / rate


def test_a_clean_log_gives_the_derivatives():
    t = even()
    motion = make_motion(recorded(t, t), FilterOptions(cutoff=30.0))
    for found, true in zip((motion.q, motion.v, motion.a), waves(motion.t)):
        np.testing.assert_allclose(found[100:-100], true[100:-100], atol=1e-4 * np.abs(true).max())
        np.testing.assert_allclose(found, true, atol=5e-3 * np.abs(true).max())  # what the ends still feel
    assert motion.segment.max() == 0 and motion.weight.min() == 1 and motion.sampling.clock.kind == "stamps"


def test_true_jitter_is_resampled():
    """True jitter is resampled by the stamps."""
    t = even()
    jittered = t + np.random.default_rng(1).uniform(-6e-4, 6e-4, len(t))
    sampled = resample(recorded(jittered, jittered))
    assert sampled.report.clock.kind == "stamps" and 2e-4 < sampled.report.jitter[0] < 8e-4
    np.testing.assert_allclose(sampled.series["q"], waves(sampled.t)[0], atol=1e-7)
    assert np.ptp(np.diff(sampled.t)) < 1e-12


@pytest.mark.parametrize("measured", [True, False])
def test_logger_jitter_is_seen_through(measured):
    """Jitter of the logger alone is seen through."""
    t = even()
    jittered = t + np.random.default_rng(2).uniform(-6e-4, 6e-4, len(t))
    clock = find_clock(recorded(jittered, t, measured=measured))
    assert clock.kind in ("even", "counted") and clock.roughness[clock.kind] < 0.1
    assert np.std(clock.t - t) < 1e-4


def test_repeated_and_missed_are_counted():
    """Samples read twice, and missed ones, are counted."""
    random = np.random.default_rng(3)
    k = np.cumsum(random.choice([0, 1, 2], 5000, p=[0.06, 0.88, 0.06]))
    true = k / 500
    stamps = np.arange(5000) / 500 + random.uniform(-5e-4, 5e-4, 5000)
    recording = recorded(stamps, true)
    clock = find_clock(recording)
    assert clock.kind == "counted" and (~clock.keep).sum() == (np.diff(k) == 0).sum()
    steps = np.diff(clock.t) * 500
    assert np.mean(np.abs(steps - np.diff(k)) < 0.01) > 0.99  # all but where the robot is too slow to count
    report = resample(recording).report
    assert report.repeated == (np.diff(k) == 0).sum() and report.lost > 200
    assert any("read twice" in line for line in report.lines())
    motion, blind = make_motion(recording), make_motion(recording, FilterOptions(clock="stamps"))
    assert np.abs(motion.a).max() < 1.1 * np.abs(waves(true)[2]).max() and motion.weight.min() == 0
    assert np.abs(blind.a - waves(blind.t)[2]).std() > 3 * np.abs(motion.a - waves(motion.t)[2]).std() * 0.5


def test_missing_clock_is_refused():
    """A clock that is not there is refused."""
    t = even()
    with pytest.raises(UsageError, match="cannot date the samples"):
        find_clock(recorded(t, t, measured=False), "counted")
    with pytest.raises(UsageError, match="expected one of auto, stamps"):
        find_clock(recorded(t, t), "sundial")


def test_short_gaps_bridged_long_ones_split():
    """Short gaps are bridged, and long ones split."""
    t = even()
    keep = np.ones(len(t), dtype=bool)
    keep[1000:1004] = False  # 10 ms
    keep[2500:3500] = False  # 2 s
    sampled = resample(recorded(t, t).take(keep))
    report = sampled.report
    assert report.lost == 4 and len(report.gaps) == 1 and not report.dropped
    start, length = report.gaps[0]
    assert start == pytest.approx(t[2499]) and length == pytest.approx(2.002)
    assert any(line == "gap of 2 s at 4.998 s: recording split" for line in report.lines())
    assert sampled.weight[1000:1004].max() == 0 and sampled.weight.sum() == keep.sum()
    np.testing.assert_allclose(sampled.series["q"][1000:1004], waves(t)[0][1000:1004], atol=1e-6)
    motion = make_motion(recorded(t, t).take(keep))
    assert sorted(set(motion.segment)) == [0, 1]
    assert not ((motion.t > t[2499] - 0.05) & (motion.t < t[3500] + 0.05)).any()


def test_crumbs_between_gaps_are_left_out():
    t = even()
    keep = np.ones(len(t), dtype=bool)
    keep[2000:2500] = keep[2515:3000] = False
    report = resample(recorded(t, t).take(keep)).report
    assert len(report.gaps) == 2 and len(report.dropped) == 1
    with pytest.raises(MeasurementError, match="none of its 13 parts is longer than 20 samples"):
        resample(recorded(t, t).take(np.arange(len(t)) % 400 < 15))


@pytest.mark.parametrize(
    ("options", "pattern"),
    [
        (FilterOptions(cutoff=250.0), "cut-off of 250 Hz is not between 0 and the Nyquist frequency, 250 Hz at 500 Hz"),
        (FilterOptions(cutoff=(10.0, 400.0)), "cut-off of 400 Hz"),
        (FilterOptions(velocity_cutoff=260.0), "cut-off of 260 Hz"),
        (FilterOptions(cutoff=(1.0, 2.0, 3.0)), "3 values for 2 joints"),
        (FilterOptions(band=300.0), "identification band of 300 Hz"),
        (FilterOptions(band=0.2), r"needs .* s without a gap"),
        (FilterOptions(band=1e-6), "1e-06 Hz keeps one of 200000000 samples; .* raise the band"),
    ],
)
def test_filters_that_cannot_be(options, pattern):
    t = even()
    with pytest.raises(CalibError, match=pattern):
        make_motion(recorded(t, t), options)


def test_cutoffs_follow_motion_and_noise():
    """Proposed cutoffs follow the motion and the noise."""
    t = even(500.0, 20.0)
    proposed = propose_cutoffs(resample(recorded(t, t, noise=1e-6)))
    assert proposed.dynamics == 2.0  # lines up to 1.3 Hz, windows of 4 s
    assert proposed.position == 10.0 and 3.99 < proposed.band < 4.2
    assert proposed.band == pytest.approx(0.8 * 500 / (2 * proposed.factor))
    np.testing.assert_allclose(proposed.noise, 1e-6, rtol=0.1)
    noisy = propose_cutoffs(resample(recorded(t, t, noise=3e-3)))
    assert noisy.position < 10.0 and any("noise exceeds 5 %" in reason for reason in noisy.reasons)
    stated = propose_cutoffs(resample(recorded(t, t)), dynamics=10.0)
    assert stated.position == 50.0 and stated.band > 19.99
    clean = recorded(t, t, noise=1e-7)
    ringing = propose_cutoffs(resample(replace(clean, q=clean.q + 2e-4 * np.sin(2 * np.pi * 60 * t)[:, None])))
    assert ringing.dynamics <= 2.0 and ringing.position <= 10.0  # a resonance does not raise the cut-off


def test_model_holds_after_decimation():
    """W x = y for the true parameters, filtered and thinned alike."""
    t = even()
    motion = make_motion(recorded(t, t), FilterOptions(cutoff=40.0, band=20.0))
    w = decimate(np.stack([np.cos(motion.q), motion.v, motion.a], axis=-1), motion.decimator, motion.segment)
    y = decimate(motion.effort, motion.decimator, motion.segment)
    x = np.linalg.lstsq(w.reshape(-1, 3), y.ravel(), rcond=None)[0]
    np.testing.assert_allclose(x, [20.0, 2.0, 0.5], rtol=2e-4)


def test_standing_and_moving_samples():
    t = even(500.0, 12.0)
    q = np.zeros((len(t), 2))
    s = np.clip((t - 3) / 6, 0, 1)
    q[:, 0] = s**3 * (10 - 15 * s + 6 * s**2)
    recording = Recording(t, q, np.ones_like(q) + q, "torque", ("a", "b"))
    motion = make_motion(recording, FilterOptions(cutoff=20.0))
    stands = motion.standstill()
    assert stands[motion.t < 2.9].all() and stands[motion.t > 9.1].all() and not stands[abs(motion.t - 6) < 2].any()
    assert not moving(motion)[:, 1].any()
    fast = moving(motion, [0.2, 0.2])[:, 0]
    assert 0 < fast.sum() < (~stands).sum()


def test_the_signal_in_the_band():
    t = even()
    clean = recorded(t, t)
    rippled = replace(clean, effort=clean.effort + np.sin(2 * np.pi * 90 * t)[:, None])
    motion = make_motion(rippled, FilterOptions(cutoff=30.0, band=20.0))
    inner = slice(100, -100)
    clear = 20 * np.cos(waves(motion.t)[0]) + 2 * waves(motion.t)[1] + 0.5 * waves(motion.t)[2]
    np.testing.assert_allclose(motion.in_band(motion.effort)[inner], clear[inner], atol=0.05)


def one_sine(t: np.ndarray) -> Recording:
    q = np.stack([np.sin(2 * np.pi * 0.4 * t), 0.5 * np.sin(2 * np.pi * 0.4 * t), np.cos(2 * np.pi * 0.4 * t)], 1)
    return Recording(t, q, q + 0.01, "torque", ("a", "b", "c"))


def test_one_frequency_is_noticed():
    t = even()
    report = report_excitation(make_motion(one_sine(t)))
    assert report.functions == 2 and report.poor
    assert any(note.startswith("each joint moves at one frequency (0.4 Hz)") for note in report.notes)
    assert any("a–b" in note for note in report.notes)
    rich = report_excitation(make_motion(recorded(t, t)))
    assert not rich.poor and not rich.notes


def test_shifted_repeat_is_recognised():
    """A repeat is recognised, however it is shifted."""
    t = even(200.0, 24.0)
    training = make_motion(recorded(t, t, noise=1e-5))
    late = make_motion(recorded(t, t + 3.3, noise=1e-5, seed=1))  # all lines are multiples of 0.1 Hz: a period of 10 s
    slower = make_motion(recorded(t, 0.5 * t, noise=1e-5, seed=2))
    q, v, a = waves(t, ((0.35, 0.85, 1.15), (0.25, 0.55, 0.95)), 3.0)
    other = make_motion(Recording(t, q, 20 * np.cos(q) + 2 * v + 0.5 * a, "torque", ("a", "b")))
    assert repeats(training, late) > 0.99
    assert repeats(training, training) == 1.0
    assert repeats(training, slower) < 0.2
    assert repeats(training, other) < 0.2


@pytest.mark.slow
def test_quiet_velocities_keep_the_corner():
    """A joint reverses against Coulomb friction: the filter that suits accelerations alone makes Ia 1 % too large."""
    ia, fv, fc, rate, fine = 0.8, 1.0, 2.0, 1000.0, 10
    step, gain, damping = 1.0 / (rate * fine), (2 * np.pi * 4) ** 2 * ia, 1.6 * 2 * np.pi * 4 * ia
    t = np.arange(int(20 * rate * fine)) * step
    lines = np.array([[0.2, 0.9, 0.0], [0.5, 0.5, 1.0]])
    angle = 2 * np.pi * lines[:, :1] * t + lines[:, 2:]
    asked, speed = lines[:, 1] @ np.sin(angle), (2 * np.pi * lines[:, 0] * lines[:, 1]) @ np.cos(angle)
    q, v, rows = asked[0], speed[0], []
    for k in range(len(t)):
        tau = gain * (asked[k] - q) + damping * (speed[k] - v)
        rows.append((q, tau))
        then = v + step * (tau - fv * v - fc * np.sign(v)) / ia
        v = 0.0 if v * then < 0 and abs(tau) < fc else then
        q += step * v
    log = np.array(rows[::fine]) + np.random.default_rng(0).normal(size=(len(t) // fine, 2)) * (1e-5, 0.02)
    recording = Recording(t[::fine], log[:, :1], log[:, 1:], "torque", ("a",))
    off = []
    for options in (FilterOptions(), FilterOptions(cutoff=10.0)):
        motion = make_motion(recording, options)
        W = decimate(np.column_stack([motion.a, motion.v, np.sign(motion.v)]), motion.decimator, motion.segment)
        found = np.linalg.lstsq(W, decimate(motion.effort[:, 0], motion.decimator, motion.segment), rcond=None)[0]
        off.append(np.abs(found / (ia, fv, fc) - 1.0))
        assert motion.cutoff[0] == 10.0
    assert off[0].max() < 0.004 < 0.008 < off[1][0]


def test_noisy_velocities_are_filtered():
    """Velocities of noisy encoders are filtered as positions are."""
    t = even()
    quiet, noisy = (make_motion(recorded(t, t, noise=noise)) for noise in (1e-6, 0.1))
    assert (quiet.velocity_cutoff > 2.0 * quiet.cutoff).all()
    np.testing.assert_array_equal(noisy.velocity_cutoff, noisy.cutoff)
    stated = make_motion(recorded(t, t), FilterOptions(cutoff=(20.0, 30.0), velocity_cutoff=(50.0, 60.0)))
    assert list(stated.cutoff) == [20.0, 30.0] and list(stated.velocity_cutoff) == [50.0, 60.0]

"""Gear ripple: found by its family, also where another gear's is felt, and not where there is none."""

from dataclasses import replace

import numpy as np
import planted_motion
import pytest

from calib.dynamics.shapes import TermMotion
from calib.identification.friction import ripple
from calib.identification.friction.ripple import GearTravel
from calib.records import frozen

RATE, TURNS = 500.0, 100


def track(seed: int, seconds: float = 12.0) -> GearTravel:
    """Return two joints on sums of sines."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1.0 / RATE)
    f, phase = 0.1 * np.arange(1, 6)[:, None], random.uniform(0.0, 2.0 * np.pi, (2, 5, 1))
    w = 2.0 * np.pi * f
    q = np.array([np.sum(0.25 * np.sin(w * t + own), axis=0) for own in phase]).T
    v = np.array([np.sum(0.25 * w * np.cos(w * t + own), axis=0) for own in phase]).T
    return GearTravel(q, v, np.arange(len(t)) * 8 // len(t), (0, 1))


def planted(where: GearTravel) -> np.ndarray:
    """Return torques (N, 2): gear 1's ripple in both joints, growing with speed."""
    q, v = where.q[:, 0], np.abs(where.v[:, 0])
    wave = v * (np.sin(2 * TURNS * q + 0.3) + 0.7 * np.cos((2 * TURNS + 2) * q) + 0.5 * np.sin(TURNS * q))
    return np.stack([wave, -0.6 * wave], axis=1)


def explained(one: ripple.Ripple, where: GearTravel, torque: np.ndarray) -> float:
    predicted = np.zeros(len(torque))
    for own, value in zip(one.terms, one.values):
        source = own.acts[0][1][0][0]
        q, v = where.q[:, source], where.v[:, source]
        predicted += value * own.values(TermMotion(q, v, np.zeros_like(q)))
    return 1.0 - float(np.sum((torque - predicted) ** 2) / np.sum(torque**2))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_ripple_predicts_other_motion(seed):
    """The family of waves is found, and predicts other motion."""
    learnt, other = track(seed), track(seed + 100)
    noise = np.random.default_rng(seed).normal(scale=0.2, size=learnt.q.shape)
    torque = planted(learnt) + noise
    turns = ripple.find_turns(learnt, torque)
    assert turns[0] == TURNS
    for joint in (0, 1):
        one = ripple.find(joint, learnt, torque[:, joint], turns)
        assert {(0, TURNS), (0, 2 * TURNS), (0, 2 * TURNS + 2)} <= set(one.waves)
        assert explained(one, other, planted(other)[:, joint]) > 0.8
        assert all(own.acts[0][0] == joint for own in one.terms)


@pytest.mark.parametrize("seed", range(3))
def test_noise_has_no_ripple(seed):
    learnt = track(seed)
    noise = np.random.default_rng(seed).normal(size=learnt.q.shape)
    turns = ripple.find_turns(learnt, noise)
    assert [ripple.find(joint, learnt, noise[:, joint], turns) for joint in (0, 1)] == [None, None]


def test_hardly_moving_joints_have_no_ripple():
    """Joints that hardly move have no ripple to be found."""
    case = planted_motion.case("still", 0, duration=4.0)
    still = replace(case, motion=replace(case.motion, q=frozen(1e-3 * case.motion.q)))
    assert ripple.find_all([still], [np.array(case.target)]) == []


def test_single_loud_moment_is_incoherent():
    """A single loud moment has no coherence."""
    learnt = track(0)
    burst = np.where(learnt.block == 3, np.sin(200.0 * learnt.q[:, 0]), 0.0)
    steady = np.sin(200.0 * learnt.q[:, 0])
    assert ripple.coherence(learnt, 0, burst).max() < 1e-6 * ripple.coherence(learnt, 0, steady).max()
    orders = np.array([16, 32, 101, 640])
    whole = ripple.coherence(learnt, 0, steady)
    assert np.allclose(ripple.coherence_at(learnt, 0, steady, orders), whole[orders], rtol=0, atol=1e-9 * whole.max())


@pytest.mark.parametrize("seed", range(3))
def test_residual_that_repeats_with_the_motion_is_no_ripple(seed):
    """What every period repeats is no proof of waves: a part of the motion is held out with all its repetitions."""
    random = np.random.default_rng(seed)
    case = planted_motion.case("once", seed, duration=4.0)
    once = case.motion.part(slice(0, round(3.0 * case.motion.rate)))
    # the same three seconds four times, with a fast residual that is the same in each
    repeated = np.tile(np.arange(len(once)), 4)
    series = {name: frozen(getattr(once, name)[repeated]) for name in ("q", "v", "a", "effort", "weight")}
    t = np.arange(len(repeated)) / once.rate
    motion = replace(once, t=t, segment=np.zeros(len(t), dtype=int), **series)
    residual = random.normal(size=once.q.shape)[repeated]
    assert ripple.find_all([replace(case, motion=motion)], [residual]) == []


def test_periods_at_other_speeds_are_no_proof_of_ripple():
    """Periods played a few percent faster or slower pass through the same states, too, without a common lag."""
    random = np.random.default_rng(0)
    case = planted_motion.case("once", 0, duration=4.0)
    once = case.motion.part(slice(0, round(3.0 * case.motion.rate)))
    disturbance = random.normal(size=once.q.shape)
    places, speeds = [], []
    for speed in (1.0, 0.97, 1.04, 0.98):
        place = np.arange(0.0, len(once) - 1, speed)
        places.append(place)
        speeds.append(np.full(len(place), speed))
    place, speed = np.concatenate(places), np.concatenate(speeds)[:, None]

    def played(values):
        return np.stack([np.interp(place, np.arange(len(once)), column) for column in values.T], axis=1)

    count = len(place)
    motion = replace(
        once,
        t=np.arange(count) / once.rate,
        segment=np.zeros(count, dtype=int),
        weight=frozen(np.ones(count)),
        q=frozen(played(once.q)),
        v=frozen(played(once.v) * speed),
        a=frozen(played(once.a) * speed**2),
        effort=frozen(played(once.effort)),
    )
    assert ripple.find_all([replace(case, motion=motion)], [played(disturbance)]) == []

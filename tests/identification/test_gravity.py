"""Gravity as a hypothesis: found where it is another, said to be absent where it is, silent where it is as stated."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.rigid_body import inverse_dynamics
from calib.identification.checks.gravity import GravityHypotheses, gravity_of
from calib.identification.checks.recorded_motion import MotionSamples
from calib.identification.checks.recording_sizes import wrong_joints
from calib.procedure.dynamic_stage.hypotheses import gravity_findings
from calib.procedure.findings import sentence
from calib.robot.library import load

STATED = np.array([0.0, 0.0, -9.81])
MOUNTS = {"wall": (9.81, 0.0, 0.0), "ceiling": (0.0, 0.0, 9.81), "slope": (0.0, 6.937, -6.937)}


def sines(t: np.ndarray, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q, v, a (N, n) of joints that move by 1 rad or so in four sines each."""
    q, v, a = np.zeros((3, len(t), n))
    for harmonic in range(1, 5):
        speed = 2.0 * np.pi * 0.15 * harmonic
        size, phase = rng.normal(size=n) / harmonic, rng.uniform(0.0, 2.0 * np.pi, n)
        turn = speed * t[:, None] + phase
        q += size * np.sin(turn)
        v += size * speed * np.cos(turn)
        a -= size * speed**2 * np.sin(turn)
    return q, v, a


def said(gravity: np.ndarray, masses: bool, without: tuple[int, ...] = (), seed: int = 0) -> GravityHypotheses:
    """Return what torques of the LWR4+ under a gravity vector (3,) say; joints `without` hold none."""
    chain = load("lwr4plus")
    t = np.arange(0.0, 20.0, 0.04)
    rng = np.random.default_rng(seed)
    q, v, a = sines(t, chain.n, rng)
    bodies = bodies_of(chain)
    torques = inverse_dynamics(bodies.with_gravity(gravity), standard_parameters(chain), q, v, a)
    free = inverse_dynamics(bodies.with_gravity(np.zeros(3)), standard_parameters(chain), q, v, a)
    torques[:, list(without)] = free[:, list(without)]
    size = free.std(axis=0)
    torques += size * (0.2 * np.tanh(v / 0.05) + 0.02 * rng.normal(size=q.shape))
    known = chain if masses else replace(chain, inertias=None)
    return gravity_of([MotionSamples(np.arange(len(t)), q, v, a, torques, v, bodies)], known)


@pytest.mark.parametrize("masses", [pytest.param(True, marks=pytest.mark.slow), False])
def test_stated_gravity_is_not_remarked_upon(masses):
    """Gravity as stated is not remarked upon."""
    for seed in range(3):
        assert not said(STATED, masses, seed=seed).refuted


@pytest.mark.parametrize("mount", [pytest.param(name, marks=[pytest.mark.slow] * (name != "slope")) for name in MOUNTS])
def test_other_mounting_is_found_with_vector(mount):
    """Another mounting is found with its vector."""
    gravity = np.array(MOUNTS[mount])
    hypotheses = said(gravity, masses=True)
    assert hypotheses.direction is not None and not hypotheses.absent
    assert hypotheses.direction @ gravity > 9.81**2 * np.cos(np.radians(5.0))


@pytest.mark.slow
def test_torques_without_gravity_are_named():
    """Torques without gravity are named as such."""
    assert 1 in said(np.zeros(3), masses=True).absent
    assert said(np.zeros(3), masses=True).direction is None


def test_compensated_joints_are_named():
    """Of joints compensated for gravity, the two concerned are named."""
    assert said(STATED, masses=True, without=(1, 2)).absent == (1, 2)


def test_mounting_is_said_with_its_option():
    """A finding of gravity is said with the option to write."""
    joints = load("lwr4plus").joint_names
    (mounted,) = gravity_findings(said(np.array(MOUNTS["wall"]), masses=True), joints)
    assert mounted.code == "gravity-direction"
    assert [float(value) for value in mounted.values["option"].split(", ")] == pytest.approx([9.81, 0, 0], abs=0.5)
    (missing,) = gravity_findings(said(STATED, masses=True, without=(1, 2)), joints)
    assert missing.code == "gravity-absent" and list(missing.values["joints"]) == [joints[1], joints[2]]
    assert joints[1] in sentence(missing) and gravity_findings(said(STATED, masses=True), joints) == []


def test_vertical_axes_tell_nothing():
    """Axes along the vertical tell nothing."""
    chain = planted.arm()
    assert chain.n == 3
    t, q, v, a = planted.motion(0)
    rows = slice(None, None, max(1, len(t) // 400))
    q, v, a = q[rows], v[rows], a[rows]
    q[:, 1:], v[:, 1:], a[:, 1:] = 0.0, 0.0, 0.0
    bodies = bodies_of(chain)
    torques = inverse_dynamics(bodies, standard_parameters(chain), q, v, a)
    assert not gravity_of([MotionSamples(np.arange(len(q)), q, v, a, torques, v, bodies)], chain).refuted


@pytest.mark.slow
def test_exchanged_columns_need_no_masses():
    """Exchanged torque columns are named without masses."""
    chain = load("lwr4plus")
    t = np.arange(0.0, 20.0, 0.04)
    q, v, a = sines(t, chain.n, np.random.default_rng(1))
    torques = inverse_dynamics(bodies_of(chain), standard_parameters(chain), q, v, a)
    sound = MotionSamples(np.arange(len(t)), q, v, a, torques, v, bodies_of(chain))
    assert wrong_joints(sound) is None
    exchanged = wrong_joints(replace(sound, effort=torques[:, [0, 2, 1, 3, 4, 5, 6]]))
    assert exchanged is not None and (exchanged.code, exchanged.joints) == ("torques-exchanged", (1, 2))

"""Columns of a recording that are wrong are named by one search; sound recordings accuse nothing."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calib.column_changes import exchange, reversal
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.rigid_body import inverse_dynamics
from calib.identification.checks.mistaken_columns import corrected, without_offsets, wrong_joints
from calib.identification.checks.recorded_motion import MotionSamples
from calib.procedure.dynamic_stage import plausibility
from calib.robot.library import load
from calib.simulation.known_robots import random_fourier

ROBOTS = ("tx40", "lwr4plus", "rv2sq", "ur10e")
RATE = 25.0


def recorded(robot: str, seed: int) -> MotionSamples:
    """Return samples of a recording of a library robot whose masses, friction and noise are drawn by a seed."""
    rng = np.random.default_rng(seed)
    chain = load(robot)
    lower, upper = np.maximum(chain.lower, -2.6), np.minimum(chain.upper, 2.6)
    motion = random_fourier(lower, upper, np.full(chain.n, 1.5), 8.0, RATE, 6, 8.0, seed)
    bodies = bodies_of(chain)
    if chain.inertias is None:
        masses = np.tile([0.02, 0.0, 0.0, 0.02, 0.0, 0.02, 0.1, 0.05, 0.1, 1.0], (bodies.count, 1))
    else:
        masses = standard_parameters(chain).reshape(bodies.count, 10)
    masses = (masses * rng.uniform(0.8, 1.2, (bodies.count, 1))).ravel()
    torque = inverse_dynamics(bodies, masses, motion.q, motion.v, motion.a)
    size = np.maximum(torque.std(axis=0), 0.02 * torque.std())
    torque += size * (rng.uniform(0.05, 0.2, chain.n) * np.tanh(motion.v / 0.03) + rng.normal(0.0, 0.05, chain.n))
    torque += 0.02 * size * rng.normal(size=torque.shape)
    return MotionSamples(np.arange(len(motion.q)), motion.q, motion.v, motion.a, torque, motion.v, bodies)


Mistake = Callable[[MotionSamples], MotionSamples]


def torques(matrix: np.ndarray) -> Mistake:
    return lambda samples: replace(samples, effort=samples.effort @ matrix.T)


def positions(matrix: np.ndarray, with_torques: bool = False) -> Mistake:
    def changed(samples: MotionSamples) -> MotionSamples:
        effort = samples.effort @ matrix.T if with_torques else samples.effort
        q, v, a = (values @ matrix.T for values in (samples.q, samples.v, samples.a))
        return replace(samples, q=q, v=v, a=a, velocity=v, effort=effort)

    return changed


def turned(joint: int, angle: float) -> Mistake:
    return lambda samples: replace(samples, q=samples.q + angle * np.eye(samples.q.shape[1])[joint])


def mistakes(n: int, j: int) -> list[tuple[str, tuple[int, ...], Mistake]]:
    """Return mistakes at joint `j` of n: the code to be named, its joints, and the mistake."""
    swap, factor = exchange(n, j, j + 1), np.ones(n)
    factor[j] = 4.0
    return [
        ("torque-sign", (j,), torques(reversal(n, j))),
        ("torques-exchanged", (j, j + 1), torques(swap)),
        ("torque-scaled", (j,), torques(np.diag(factor))),
        ("position-sign", (j,), positions(reversal(n, j))),
        ("positions-exchanged", (j, j + 1), positions(swap)),
        ("columns-exchanged", (j, j + 1), positions(swap, with_torques=True)),
        ("zero-elsewhere", (j,), turned(j, np.pi / 2)),
    ]


@pytest.mark.parametrize(
    "number", [pytest.param(number, marks=[pytest.mark.slow] * (number != 4)) for number in range(7)]
)
def test_wrong_column_is_named_without_masses(number):
    """A wrong column is named with its joints, and nothing else is."""
    code, joints, mistake = mistakes(6, 1)[number]
    explanation = wrong_joints(mistake(recorded("tx40", 0)))
    assert explanation is not None
    assert [(change.code, change.joints) for change in explanation.changes] == [(code, joints)]
    (found,) = plausibility.wrong_joints({"log": explanation}, load("tx40").joint_names)
    assert found.code == code and found.values["explained"] > 0.9


@pytest.mark.parametrize("robot", ROBOTS)
def test_shares_do_not_depend_on_rounding(robot):
    """Columns that the bodies explain wholly have no part in them: the order of the samples changes nothing."""
    samples = recorded(robot, 0)
    backwards = {name: getattr(samples, name)[::-1] for name in ("index", "q", "v", "a")}
    shares = without_offsets(replace(samples, **backwards))
    assert shares == pytest.approx(without_offsets(samples), rel=1e-9)


def test_robot_that_stands_without_noise_accuses_nothing():
    """Where no drive has an effect nothing is fitted: SciPy's solver ends the process without columns."""
    samples = recorded("tx40", 0)
    standing = np.zeros_like(samples.q)
    assert wrong_joints(replace(samples, q=samples.q[:1] + standing, v=standing, a=standing)) is None


@pytest.mark.slow
def test_corrected_columns_are_those_that_were_recorded():
    sound = recorded("tx40", 1)
    for _, _, mistake in mistakes(6, 2)[2::2]:
        samples = mistake(sound)
        again = corrected(samples, wrong_joints(samples))
        turns = (again.q - sound.q) / (2.0 * np.pi)
        assert np.allclose(turns, np.round(turns), atol=1e-9)
        assert np.allclose(again.torque, sound.torque, rtol=0.05)
    assert corrected(sound, None) is sound


@pytest.mark.slow
def test_log_of_another_robot_names_that_robot():
    panda = load("panda")
    log = recorded("lwr4plus", 3)
    explanation = wrong_joints(replace(log, bodies=bodies_of(panda)))
    assert explanation is not None and explanation.code == "another-robot"
    (found,) = plausibility.wrong_joints({"log": explanation}, panda.joint_names)
    assert found.values["robot"] in ("lwr4plus", "iiwa14") and found.values["after"] < 0.6 * found.values["before"]


@pytest.mark.parametrize("robot", [pytest.param(name, marks=[pytest.mark.slow] * (name != "ur10e")) for name in ROBOTS])
def test_sound_columns_accuse_nothing(robot):
    assert wrong_joints(recorded(robot, 4)) is None


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["lwr4plus", "rv2sq"])
def test_wrong_columns_of_many_robots_are_named(robot):
    """Each mistake at drawn joints of drawn robots: the first cause named is the right one, or its rival is."""
    rng = np.random.default_rng(7)
    wrong, total = [], 0
    for seed in range(1):
        sound = recorded(robot, 10 + seed)
        n = sound.q.shape[1]
        assert wrong_joints(sound) is None
        for code, joints, mistake in mistakes(n, int(rng.integers(1, n - 3))):
            explanation = wrong_joints(mistake(sound))
            total += 1
            named = [] if explanation is None else [(explanation.code, explanation.joints)]
            if explanation is not None and explanation.rival is not None:
                named.append((explanation.rival.code, explanation.rival.joints))
            if (code, joints) not in named:
                wrong.append((robot, seed, code, joints, named))
    assert len(wrong) <= 0.1 * total, wrong

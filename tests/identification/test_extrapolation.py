"""Models hold where they never learnt: friction is bounded and brakes, couplings are found, joints borrow of others."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.data.signals.filtering import design_decimator
from calib.dynamics import drives
from calib.dynamics.shapes import TermMotion
from calib.identification.friction.passivity import braking, driven
from calib.identification.identify import Identification, identify
from calib.identification.prediction import Dynamics, predict
from calib.identification.rows import Case
from calib.identification.settings import IdentificationSettings
from calib.identification.time_folds import regimes
from calib.procedure.export.identified import drive_table
from calib.records import frozen

PLAIN = IdentificationSettings(friction="standard", essential="none")
COUPLED = drives.coupled(1, 2, label="2.3")
GEARS = {"Iam2.3": 0.08, "Fvm2.3": 0.4, "Fcm2.3": 0.6}


def unexplained(found: Identification, case: Case) -> float:
    """Return 100 |tau - predicted| / |tau| of a case."""
    return float(100 * np.linalg.norm(case.target - predict(found.dynamics, case)) / np.linalg.norm(case.target))


def without_friction(case: Case) -> Case:
    """Return the case as a sensor behind the gears records it: no friction of joints."""
    v = case.motion.v
    friction = np.array(planted.DRIVES["Fv"]) * v + np.array(planted.DRIVES["Fc"]) * np.tanh(v / 0.01)
    return replace(case, target=frozen(case.target - friction))


@pytest.mark.parametrize(
    "one", [drives.term("F", shape, 0, 2.0, *more) for shape, *more in (("cubic",), ("speed",), ("root", 0.01))]
)
def test_bent_shape_stays_beyond_the_edge(one):
    """A shape that bends keeps its value beyond the edge."""

    def at(v: float) -> float:
        state = np.array([0.0]), np.array([v]), np.array([0.0])
        return float(one.values(TermMotion(*state))[0])

    assert at(6.0) == at(2.0) != at(1.0)
    assert at(-6.0) == at(-2.0)
    free = replace(one, settings=one.settings[1:])  # as files of before say it: no edge
    assert free.settings[0] == np.inf


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_sensor_friction_brakes_and_is_small(seed):
    """Friction of sensors behind the gears brakes and is small."""
    case = without_friction(planted.case("log", seed, noise=0.2))
    found = identify(planted.arm(), [case], replace(PLAIN, friction="auto"))
    terms, values = found.terms, found.fitted.estimate.values
    assert (braking(terms, np.abs(case.motion.v).max(axis=0)) @ values >= -1e-9).all()
    own = [abs(value) for one, value in zip(terms, values) if one is not None and one.shape == "sign"]
    assert max(own) < 0.1 * min(planted.DRIVES["Fc"])


@pytest.mark.slow
def test_planted_coupling_alone_is_found():
    """A coupling is found and written, and none where there is none."""
    case = planted.case("log", 0, noise=0.05, terms=COUPLED, values=GEARS)
    other = planted.case("other", 9, noise=0.05, terms=COUPLED, values=GEARS)
    found = identify(planted.arm(), [case], replace(PLAIN, friction="auto"))
    plain = identify(planted.arm(), [case], PLAIN)
    assert "coupling" in found.friction.chosen
    assert unexplained(found, other) < 0.5 * unexplained(plain, other)
    table = drive_table(found.dynamics)
    assert table.pairs == ((1, 2, 1.0),)
    np.testing.assert_allclose(table.couplings[0, :3], list(GEARS.values()), rtol=0.1)
    alone = identify(planted.arm(), [planted.case("log", 0, noise=0.05)], replace(PLAIN, friction="auto"))
    assert "coupling" not in alone.friction.chosen and drive_table(alone.dynamics).pairs == ()


@pytest.mark.slow
def test_one_frequency_tells_no_coupling():
    """Friction that the standard model lacks is explained by other joints' motion there, but not elsewhere."""
    case = planted.case("log", 0, noise=0.05, harmonics=1)
    v = case.motion.v
    richer = (8.0 * np.sqrt(np.abs(v)) + 6.0 * np.exp(-np.abs(v) / 0.1)) * np.tanh(v / 0.01)
    found = identify(planted.arm(), [replace(case, target=case.target + richer)], replace(PLAIN, friction="auto"))
    assert "coupling" not in found.friction.chosen and len(found.friction.steps) > 1


def test_one_way_joint_has_no_torque_offset():
    """Coulomb friction in proportion to the torque limits: joint 1's constant torque is its friction, not an offset."""
    arm = planted.arm()
    arm = replace(
        arm, joints=tuple(replace(one, effort=100.0 * own) for one, own in zip(arm.joints, planted.DRIVES["Fc"]))
    )
    case, other = planted.case("log", 0, noise=0.05), planted.case("other", 7, noise=0.05)
    present = np.array(case.present)
    present[:, 0] &= case.motion.v[:, 0] > 0.05
    found = identify(arm, [replace(case, present=frozen(present, bool))], PLAIN)
    names, values = found.names, found.fitted.estimate.values
    assert values[names.index("Fc1")] == pytest.approx(planted.DRIVES["Fc"][0], rel=0.2)
    assert unexplained(found, other) < 5.0


def test_regimes_hold_extremes_of_joints():
    """Regimes hold each joint's extremes, and with the rest are everything."""
    case = planted.case("log", 0)
    found = identify(planted.arm(), [case], PLAIN)
    rate = design_decimator(case.motion.rate, case.motion.decimator.factor)
    own = regimes(found.rows, [case], rate)
    assert own.squares.shape[0] == 6
    share = own.counts / own.total_counts
    np.testing.assert_allclose(share[:2], 0.1, atol=0.01)
    np.testing.assert_allclose(share[2:4], 0.15, atol=0.01)
    np.testing.assert_allclose(share[4] + share[5], 1.0, atol=0.01)
    np.testing.assert_allclose(
        own.squares[4] + own.squares[5], own.total_squares, rtol=0.02, atol=1e-3 * own.total_squares.max()
    )


def test_friction_drives_only_moving_joints():
    """Friction drives a joint only where it moves."""
    case, model, values = planted.case("log", 0), planted.model(), planted.truth()
    values[[model.names.index(name) for name in ("Fv2", "Fc2")]] *= -1.0
    speeds = np.array(case.motion.v)
    speeds[:, 1] = 1e-5 * np.random.default_rng(0).normal(size=len(speeds))
    still = replace(case, motion=replace(case.motion, v=frozen(speeds)))
    assert driven(Dynamics(model, values), [case]) == (1,)
    assert driven(Dynamics(model, values), [still]) == ()

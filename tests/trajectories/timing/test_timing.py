"""Timing: known optima are met, limits are kept by full inverse dynamics, and some limit is active almost always."""

import numpy as np
import pinocchio
import pytest
from pinocchio_model import model as pinocchio_model
from planned import CHAIN, WAYPOINTS, Cart, cart_limits, limits, lwr

from calib.robot.chain import random_joints
from calib.simulation.known_robots import truth
from calib.trajectories.errors import BadInput, NothingFeasible
from calib.trajectories.timing.path import spline
from calib.trajectories.timing.profile import track
from calib.trajectories.timing.time_scaling import time_optimal

LINE = spline([[0.0], [1.5]])


@pytest.mark.parametrize(
    ("velocity", "expected"), [(np.inf, 2 * np.sqrt(1.5 / 4)), (1.0, 1.5 / 1.0 + 1.0 / 4)], ids=["bang-bang", "trapeze"]
)
def test_double_integrator_is_time_optimal(velocity, expected):
    """A double integrator takes its known shortest time."""
    found = time_optimal(LINE, cart_limits(velocity=velocity, acceleration=4.0))
    assert found.duration == pytest.approx(expected, rel=1e-5)
    assert found.active_share > 0.999


@pytest.mark.slow
@pytest.mark.parametrize(
    ("viscous", "coulomb"),
    [
        *(pytest.param(*one, marks=pytest.mark.slow) for one in ((0.0, 0.0), (0.0, 3.0), (1.5, 0.0), (12.0, 2.0))),
        (80.0, 0.0),
    ],
)
def test_cart_with_friction_is_time_optimal(viscous, coulomb):
    """At 80 N s/m friction alone holds the speed for most of the way: a plain fixed point does not converge there."""
    cart = Cart(2.0, viscous, coulomb)
    coarse, fine = (time_optimal(LINE, cart_limits(force=10.0), cart, grid=grid) for grid in (400, 1600))
    shortest = cart.fastest(10.0, 1.5)
    assert shortest * (1 - 1e-6) < fine.duration < shortest * 1.0005
    assert shortest * (1 - 1e-6) < coarse.duration < shortest * 1.0015
    assert fine.margins["torque"].min() >= 0


def test_planned_torques_reach_the_limits():
    """Planned torques, by Pinocchio, keep the limits and reach them."""
    bounds, known = limits(), truth("lwr4plus")["drives"]
    found = time_optimal(spline(WAYPOINTS), bounds, lwr(), rate=1000.0)
    motion = track(found.path, found.profile, 1000.0, lwr().torque)
    moving = np.vstack([motion.v[1], motion.v[1:-1], motion.v[-2]])  # Coulomb's direction at the ends, too
    made = pinocchio_model(CHAIN)
    data = made.createData()
    rigid = np.array([pinocchio.rnea(made, data, *rows) for rows in zip(motion.q, motion.v, motion.a)])
    tau = rigid + known["Ia"] * motion.a + known["Fv"] * motion.v + known["Fc"] * np.sign(moving)
    np.testing.assert_allclose(motion.tau, tau, atol=1e-9)
    used = np.maximum(np.abs(tau) / bounds.torque, np.abs(motion.v) / bounds.velocity)
    assert used.max() <= 1.0
    assert np.mean(used.max(axis=1) > 0.98) > 0.97
    assert motion.duration == pytest.approx(found.duration, abs=1e-9)
    np.testing.assert_allclose(motion.v[[0, -1]], 0.0, atol=1e-9)
    np.testing.assert_allclose(motion.q[[0, -1]], WAYPOINTS[[0, -1]], atol=1e-9)
    np.testing.assert_allclose(np.diff(motion.q, axis=0) * 1000, (motion.v[1:] + motion.v[:-1]) / 2, atol=5e-3)


@pytest.mark.parametrize(
    "seed",
    [pytest.param(0, marks=pytest.mark.slow), 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 8))],
)
def test_any_path_is_timed_at_a_limit(seed):
    """Strong friction and accelerations limited, by turns; the sampling is other than that of the search."""
    from calib.trajectories.timing.profile import dense

    rng = np.random.default_rng(seed)
    bounds = limits(acceleration=np.full(7, 8.0)) if seed % 2 else limits()
    law = lwr(3.0 if seed % 4 < 2 else 1.0)
    path = spline(0.85 * random_joints(CHAIN, int(rng.integers(2, 6)), rng))
    found = time_optimal(path, bounds, law)
    checked = dense(path, found.profile, law.torque, per_interval=13)
    assert checked.tau is not None
    assert (np.abs(checked.tau) / bounds.torque).max() <= 1 + 1e-4
    assert (np.abs(checked.v) / bounds.velocity).max() <= 1 + 1e-4
    assert min(margin.min() for margin in found.margins.values()) >= 0
    assert found.active_share > 0.95
    assert np.isclose(checked.weights.sum(), found.duration)


@pytest.mark.slow
def test_faster_than_slowed_polynomials():
    """A quintic rest-to-rest law on the same path, slowed until it keeps the limits, takes longer."""
    path, bounds, law = spline(WAYPOINTS), limits(), lwr()
    z = np.linspace(0, 1, 2001)[1:-1]
    s, ds = path.length * z**3 * (10 - 15 * z + 6 * z**2), path.length * 30 * (z * (1 - z)) ** 2
    dds = path.length * 60 * z * (1 - z) * (1 - 2 * z)

    def most(T: float) -> float:
        v = path(s, 1) * ds[:, None] / T
        a = (path(s, 1) * dds[:, None] + path(s, 2) * ds[:, None] ** 2) / T**2
        return max((np.abs(law.torque(path(s), v, a)) / bounds.torque).max(), (np.abs(v) / bounds.velocity).max())

    quintic = next(T for T in np.arange(0.5, 5, 0.01) if most(T) <= 1)
    assert time_optimal(path, bounds, law).duration < 0.8 * quintic


@pytest.mark.slow
def test_friction_costs_time():
    """Viscous friction costs time, and finer grids agree."""
    path = spline(WAYPOINTS)
    free = limits(velocity=np.full(7, np.inf))
    durations = [time_optimal(path, free, lwr(factor)).duration for factor in (0.0, 1.0, 3.0)]
    assert durations[0] < durations[1] < durations[2]
    assert time_optimal(path, free, lwr(), grid=1500).duration == pytest.approx(durations[1], rel=2e-3)


def test_torque_below_gravity_names_joint():
    """Torque limits below gravity name the joint and the lack."""
    weak = limits(torque=np.array([176, 20, 100, 100, 100, 38, 38.0]))
    with pytest.raises(NothingFeasible, match=r"hold still at .* joint 2 needs .* limit is 20") as caught:
        time_optimal(spline(WAYPOINTS), weak, lwr())
    q = spline(WAYPOINTS)(np.linspace(0, spline(WAYPOINTS).length, 2000))
    lack = np.abs(lwr().torque(q, 0 * q, 0 * q)[:, 1]).max() - 20
    assert caught.value.excess == pytest.approx(lack, rel=1e-3)
    assert caught.value.unit == "N m"
    sticky = limits(torque=np.array([11.0, 176, 100, 100, 100, 38, 38.0]))
    with pytest.raises(NothingFeasible, match=r"move slowly .* joint 1 needs 11.9"):
        time_optimal(spline(WAYPOINTS), sticky, lwr())


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_impossible_limits_are_refused(value):
    """Limits that allow nothing are refused."""
    with pytest.raises(BadInput, match="velocity limit of joint 3 is"):
        limits(velocity=np.array([1, 1, value, 1, 1, 1, 1.0]))


def test_torque_limits_need_dynamics():
    """Torque limits without dynamics are refused."""
    with pytest.raises(BadInput, match="need the robot's dynamics"):
        time_optimal(spline(WAYPOINTS), limits())

"""Derivative: every column of every kind of residual against finite differences along `parameters.step`."""

from dataclasses import replace

import numpy as np
import pytest
from arms import motley_with_follower
from differences import check
from planted import cell, load, measure, perturb, random_joints
from scipy.spatial.transform import Rotation

from calib.geometry.model_choice.ladder import EFFECTS
from calib.geometry.observation import layout, observe, predict, prepare, step, target_jacobian
from calib.robot.calibrated import Deflection, Term
from calib.transforms import pose

NONE = np.array([], int)
CHAINS = {"lwr4plus": lambda: load("lwr4plus"), "ur5": lambda: load("ur5"), "mixed": motley_with_follower}


def every_basis(chain) -> Deflection:
    """Return a deflection that uses every basis on several elements, one of them twice."""
    names, last = chain.names, chain.n - 1
    moving = [names[k] for k in chain.moving]
    terms = [Term(moving[1], "torque", 1), Term(moving[last], "torque", last), Term(moving[1], "joint", 2)]
    terms += [Term(moving[2], "lever", 2, 0), Term(names[1], "lever", last, 2), Term(moving[1], "cos", 1, 3)]
    terms += [Term(moving[last], "sin", last, 7), Term(names[2], "cos", 2, 1), Term(names[-2], "sin", 1, 2)]
    values = np.random.default_rng(8).normal(size=len(terms)) * 1e-2
    return Deflection(tuple(terms), values, chain)


def moving_cell(name: str, tools=("tool",), stations=("station",)):
    chain = CHAINS[name]()
    truth = cell(perturb(chain, 1), 3, stations, tools)
    return replace(truth, deflection=every_basis(chain))


def torques(q: np.ndarray) -> np.ndarray:
    return 5.0 * np.sin(q + np.arange(q.shape[1]))


@pytest.mark.parametrize("name", CHAINS)
def test_target_positions_and_rotations(name):
    """Arm, two stations, two tools seen in one block, and every deflection basis."""
    truth = moving_cell(name, ("front", "back"), ("east", "west"))
    measured = measure(truth, "pose", 9, 5, station=1, tools=(0, 1), torque=torques)
    block = prepare(truth, [measured])[0]
    free = np.arange(len(layout(truth).names))
    seen = predict(truth, block)

    def moved(x):
        now = predict(step(truth, free, x), block)
        turn = Rotation.from_matrix(now.poses()[:, :3, :3] @ seen.poses()[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
        return np.concatenate([now.point, turn.T]).T  # (m, 6)

    jacobian = target_jacobian(truth, seen, free, block.station, block.tool, block.bases)
    check(moved, jacobian.transpose(2, 1, 0), np.zeros(len(free)), step=1e-5, tolerance=2e-9)
    east = layout(truth).find([f"east.{axis}" for axis in ("x", "rz")])
    assert np.all(jacobian[east] == 0.0)  # the other station sees nothing of it
    some = np.random.default_rng(0).permutation(free)[:15]
    assert np.array_equal(
        target_jacobian(truth, seen, some, block.station, block.tool, block.bases), jacobian[some]
    )  # any order, any subset
    only_arm = np.array([3, 1, 4])
    assert np.array_equal(
        target_jacobian(truth, seen, only_arm, block.station, block.tool, block.bases), jacobian[only_arm]
    )


@pytest.mark.parametrize("effect", EFFECTS)
@pytest.mark.parametrize("known", [True, False])
def test_every_effect_of_the_ladder(effect, known):
    chain = load("ur5")
    terms = EFFECTS[effect](chain, known)[:24]
    values = 1e-3 * np.random.default_rng(0).normal(size=len(terms))
    truth = replace(cell(perturb(chain, 2), 1), deflection=Deflection(tuple(terms), values, chain))
    measured = measure(truth, "pose", 5, torque=torques)
    block = prepare(truth, [measured])[0]
    free = layout(truth).index("deflection")
    seen = predict(truth, block)
    jacobian = target_jacobian(truth, seen, free, block.station, block.tool, block.bases)
    check(lambda x: predict(step(truth, free, x), block).point, jacobian[:, :3].transpose(1, 2, 0), np.zeros(len(free)),
          step=1e-6, tolerance=1e-7)  # fmt: skip
    assert np.abs(jacobian).max() > 0


def test_compliance_across_the_axes():
    """Moments of masses and of a load of each row tilt the elements that no joint turns."""
    chain = load("ur5")
    chain = replace(chain, inertias=np.tile([0.0] * 6 + [0.1, 0.2, 0.3, 2.0], (6, 1)))
    terms = EFFECTS["stiffness"](chain, True)
    values = 1e-5 * np.random.default_rng(0).normal(size=len(terms))
    truth = replace(cell(perturb(chain, 2), 1), deflection=Deflection(tuple(terms), values, chain))
    loads = np.random.default_rng(1).normal(size=(5, 4))
    measured = replace(measure(truth, "pose", 5, torque=torques), load=loads)
    block = prepare(truth, [measured])[0]
    free = layout(truth).index("deflection")
    seen = predict(truth, block)
    jacobian = target_jacobian(truth, seen, free, block.station, block.tool, block.bases)
    check(lambda x: predict(step(truth, free, x), block).point, jacobian[:, :3].transpose(1, 2, 0), np.zeros(len(free)),
          step=1e-6, tolerance=1e-7)  # fmt: skip
    assert {term.basis for term in terms} == {"torque", "moment"}
    bare = prepare(truth, [replace(measured, load=None)])[0]
    assert np.abs(block.bases - bare.bases)[[term.basis == "moment" for term in terms]].max() > 1.0


def residuals(truth, block, x, free):
    return np.concatenate([p.value.ravel() for p in observe(step(truth, free, x), block, NONE)])


@pytest.mark.parametrize(
    "name, kind",
    [(n, k) for n in CHAINS for k in ("pose", "position", "distance", "sockets") if (n, k) != ("mixed", "sockets")],
)
def test_residual_slope_is_minus_jacobian(name, kind):
    """Also far from the truth: residuals of centimetres, orientation residuals of a radian and more."""
    truth = cell(CHAINS[name](), 4)
    measured = measure(truth, kind, 24, 6)
    rng = np.random.default_rng(2)
    tools = truth.tools @ pose(Rotation.from_rotvec([1.2, -0.9, 0.8]), 0.05 * rng.normal(size=3))
    away = replace(truth, chain=perturb(truth.chain, 9, 0.02, 0.05), tools=tools)
    free = np.arange(len(layout(away).names))
    if kind == "sockets":  # without an instrument the residual vectors turn with station 0, their lengths do not
        free = np.setdiff1d(free, layout(away).index("station"))
    block = prepare(away, [measured])[0]
    parts = observe(away, block, free)
    claimed = -np.concatenate([p.jacobian.reshape(len(free), -1) for p in parts], axis=1).T
    check(lambda x: residuals(away, block, x, free), claimed, np.zeros(len(free)), step=1e-5, tolerance=5e-9)
    if kind == "pose":
        assert np.linalg.norm(parts[1].value, axis=0).min() > 1.0
    if kind == "sockets":
        assert [p.label for p in parts] == ["consistency", "distance"] and parts[1].value.shape[1] == 1


@pytest.mark.parametrize(
    "angle",
    [
        0.0,
        pytest.param(1e-10, marks=pytest.mark.slow),
        1e-6,
        pytest.param(5e-5, marks=pytest.mark.slow),
        2e-4,
        pytest.param(1e-2, marks=pytest.mark.slow),
        1.0,
        pytest.param(2.5, marks=pytest.mark.slow),
        3.1,
    ],
)
def test_orientation_residuals_of_every_size(angle):
    """The slope stays right through the series at small angles and up to nearly half a turn."""
    truth = cell(load("ur5"), 4)
    measured = measure(truth, "pose", 4, 6)
    away = replace(truth, tools=truth.tools @ pose(Rotation.from_rotvec(angle * np.array([2.0, -1.0, 2.0]) / 3)))
    free = np.arange(len(layout(away).names))
    block = prepare(away, [measured])[0]
    part = observe(away, block, free)[1]
    assert np.linalg.norm(part.value, axis=0) == pytest.approx(angle, abs=1e-7)
    value, slope = lambda x: observe(step(away, free, x), block, NONE)[1].value, -part.jacobian.transpose(1, 2, 0)
    check(value, slope, np.zeros(len(free)), step=1e-6, tolerance=1e-6 if angle < 3 else 1e-5)


@pytest.mark.parametrize("kind", ["plane", "bar", "sockets", "distance"])
@pytest.mark.parametrize("size", [pytest.param(1e-4, marks=pytest.mark.slow), 1e-2])
def test_cost_gradient_is_exact(kind, size):
    """Kaufman's Jacobian is not the slope of the residuals, but Jᵀr is the slope of half the squared cost."""
    truth = cell(load("lwr4plus"), 4)
    measured = measure(truth, kind, 48, 6)
    away = replace(truth, chain=perturb(truth.chain, 9, size, size))
    free = np.arange(len(layout(away).names))
    block = prepare(away, [measured])[0]
    parts = observe(away, block, free)
    gradient = -sum(np.einsum("frm,rm->f", p.jacobian, p.value) for p in parts)
    unit = np.abs(gradient).max()
    assert unit > 0
    cost = lambda x: np.array(0.5 * np.sum(residuals(away, block, x, free) ** 2) / unit)  # noqa: E731
    check(cost, gradient / unit, np.zeros(len(free)), step=1e-6, tolerance=1e-5)


@pytest.mark.parametrize("kind", ["plane", "bar"])
def test_kaufman_jacobian_is_slope_at_truth(kind):
    """At the truth Kaufman's Jacobian is the slope."""
    truth = cell(load("lwr4plus"), 4)
    measured = measure(truth, kind, 36, 6)
    free = np.arange(len(layout(truth).names))
    block = prepare(truth, [measured])[0]
    part = observe(truth, block, free)[0]
    assert np.abs(part.value).max() < 1e-9
    check(lambda x: residuals(truth, block, x, free), -part.jacobian[:, 0].T, np.zeros(len(free)), 1e-6, 2e-5)


def test_steps_add_up_and_zero_is_neutral():
    """Parameters of a step add up, and a zero step changes nothing."""
    truth = moving_cell("mixed", ("front", "back"))
    free = np.arange(len(layout(truth).names))
    q = random_joints(truth.chain, 3)
    same = step(truth, free, np.zeros(len(free)))
    assert np.array_equal(same.chain.values, truth.chain.values) and np.array_equal(same.tools, truth.tools)
    there = step(truth, free, 1e-3 * np.ones(len(free)))
    assert there.chain.values == pytest.approx(truth.chain.values + 1e-3)
    assert np.asarray(there.deflection.coefficients) == pytest.approx(np.asarray(truth.deflection.coefficients) + 1e-3)
    assert q.shape == (3, 5)

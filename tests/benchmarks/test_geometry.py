"""Speed of geometry, each against a peer with the same result in the same run.

python -m pytest tests/benchmarks/test_geometry.py -o addopts= --benchmark-group-by=group --benchmark-columns=min,median
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from planted import cell, load, measure, perturb, random_joints
from scipy.optimize import least_squares

from calib.geometry.first_guess import install
from calib.geometry.fit import fit, fit_with_prior, polish_frames
from calib.geometry.model_choice.ladder import select_model
from calib.geometry.observation import observe, predict, prepare, step
from calib.robot.chain import AXES, Chain
from calib.robot.formats import urdf, urdf_write
from calib.robot.kinematics import forward, jacobian

POSES = 1000


@cache
def six_per_joint(name: str) -> Chain:
    """Return a library robot as its URDF describes it: six elements per joint and the one that moves."""
    table = load(name)
    return urdf.parse(urdf_write.write_new(table), base=table.base, tip=table.tip)


def as_pinocchio(chain: Chain) -> tuple[pin.Model, int]:
    """Return a model with one joint per element of the chain, and the frame of its tip."""
    kinds = {"tx": pin.JointModelPX, "ty": pin.JointModelPY, "tz": pin.JointModelPZ}
    kinds |= {"rx": pin.JointModelRX, "ry": pin.JointModelRY, "rz": pin.JointModelRZ}
    model, parent = pin.Model(), 0
    for element in chain.elements:
        assert element.axis in AXES and element.sign == 1.0
        before = pin.SE3.Identity() if element.placement is None else pin.SE3(np.array(element.placement))
        parent = model.addJoint(parent, kinds[element.axis](), before, element.name)
    tip = pin.Frame("tip", parent, 0, pin.SE3(np.array(chain.tail)), pin.FrameType.OP_FRAME)
    return model, model.addFrame(tip)


def pinocchio_loop(model: pin.Model, tip: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return poses and Jacobians at displacements (m, K)."""
    data = model.createData()
    poses, jacobians = np.empty((len(values), 4, 4)), np.empty((len(values), 6, model.nv))
    for i, row in enumerate(values):
        pin.computeJointJacobians(model, data, row)
        pin.updateFramePlacement(model, data, tip)
        jacobians[i] = pin.getFrameJacobian(model, data, tip, pin.LOCAL_WORLD_ALIGNED)
        poses[i] = data.oMf[tip].homogeneous
    return poses, jacobians


def displacements(chain: Chain, q: np.ndarray) -> np.ndarray:
    values = np.tile(chain.values, (len(q), 1))
    for k, element in enumerate(chain.elements):
        if element.joint is not None:
            values[:, k] += element.ratio * q[:, element.joint]
    return values


def differences(chain: Chain, q: np.ndarray, h: float = 1e-6) -> np.ndarray:
    """Return the position rows of the Jacobian (m, 3, K) by forward differences."""
    here, values = forward(chain, q)[:, :3, 3], chain.values
    result = np.empty((len(q), 3, len(values)))
    for k in range(len(values)):
        moved = values.copy()
        moved[k] += h
        result[:, :, k] = (forward(chain.with_values(moved), q)[:, :3, 3] - here) / h
    return result


@pytest.mark.parametrize("way", ["batch", "pinocchio", "differences"])
@pytest.mark.parametrize("name", ["ur5", "lwr4plus"])
def test_forward_kinematics_and_jacobian(benchmark, name, way):
    chain = six_per_joint(name)
    q = random_joints(chain, POSES, 0)
    benchmark.group = f"FK + Jacobian, {POSES} poses x {len(chain.elements)} elements ({name})"
    ours = jacobian(chain, q)
    if way == "batch":
        benchmark(jacobian, chain, q)
    elif way == "pinocchio":
        model, tip = as_pinocchio(chain)
        poses, theirs = benchmark(pinocchio_loop, model, tip, displacements(chain, q))
        assert np.abs(poses - forward(chain, q)).max() < 1e-12
        assert np.abs(theirs - ours).max() < 1e-12
    else:
        theirs = benchmark(differences, chain, q)
        assert np.abs(theirs - ours[:, :3]).max() < 1e-5


@cache
def problem(description: str):
    """Return the UR5's nominal chain and 800 noisy positions of a perturbed one."""
    nominal = load("ur5") if description == "MDH" else six_per_joint("ur5")
    truth = cell(perturb(nominal, 1, 0.5e-3, 1e-3), 1)
    return nominal, measure(truth, "position", 800, 1, sigma=5e-5)


def whole(nominal, measured):
    start = polish_frames(install(nominal, [measured]), [measured])
    return fit(start.cell, [measured])


def by_scipy(start, block, free):
    """Minimise the same residuals over the same parameters, differences for the Jacobian."""
    sigma = block.measured.sigma.T

    def residual(x):
        return ((block.measured.position.T - predict(step(start, free, x), block).point) / sigma).ravel()

    return least_squares(residual, np.zeros(len(free)), method="lm")


@pytest.mark.parametrize("way", ["whole", "fit alone", "fit of given columns", "scipy of given columns", "selection"])
@pytest.mark.parametrize("description", ["MDH", "URDF"])
def test_fit_of_800_poses(benchmark, description, way):
    nominal, measured = problem(description)
    benchmark.group = f"fit, 800 positions x UR5, {description}, {len(nominal.elements)} elements"
    start = polish_frames(install(nominal, [measured]), [measured]).cell
    best = fit(start, [measured])
    block, free = prepare(start, [measured])[0], best.free
    cost = float(np.sum((best.pieces[0].part.value / best.pieces[0].sigma) ** 2))
    if way == "whole":
        benchmark(whole, nominal, measured)
    elif way == "fit alone":
        benchmark(fit, start, [measured])
    elif way == "selection":
        found = benchmark.pedantic(select_model, (install(nominal, [measured]), [measured]), rounds=3)
        assert found.chosen == "geometry"
    elif way == "fit of given columns":
        found = benchmark(fit_with_prior, start, [block], free)
        part = observe(found.cell, block, free)[0]
        assert float(np.sum((part.value / part.sigma) ** 2)) == pytest.approx(cost, rel=1e-9)
    else:
        found = benchmark.pedantic(by_scipy, (start, block, free), rounds=3)
        assert 2 * found.cost == pytest.approx(cost, rel=1e-6)
        there = replace(step(start, free, found.x))
        gap = predict(there, block).point - predict(best.cell, block).point
        assert np.abs(gap).max() < 1e-7

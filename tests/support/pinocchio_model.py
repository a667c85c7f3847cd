"""A chain as a Pinocchio model: the reference the kernels are checked against.

Pinocchio's joint frame j is the frame right after the chain's j-th moving element (the link frame of an MDH row), so
standard parameters compare digit by digit with ``model.inertias[j + 1]``.
"""

from typing import Any

import numpy as np
import pinocchio as pin

from calib.dynamics.bodies import PRISMATIC, Bodies, bodies_of
from calib.robot.chain import Chain

# Pinocchio's dynamic parameters are M MX MY MZ XX XY YY XZ YZ ZZ; ours in their order:
PINOCCHIO_ORDER = np.array([9, 6, 7, 8, 0, 1, 3, 2, 4, 5])


def model(chain: Chain, parameters: np.ndarray | None = None) -> Any:
    """Return the Pinocchio model of a chain without mimic joints.

    Args:
        parameters: (n, 10) or (10 n,) standard parameters; default the chain's, or zero where it has none.
    """
    bodies = bodies_of(chain)
    assert bodies.count == chain.n and np.all(np.abs(bodies.scales) == 1.0)
    if parameters is None:
        parameters = chain.inertias
    if parameters is None:
        parameters = np.zeros((chain.n, 10))
    values = np.reshape(parameters, (chain.n, 10))
    result = pin.Model()
    result.gravity = pin.Motion(np.array(chain.gravity), np.zeros(3))
    for j, joint in enumerate(chain.joints):
        placement = pin.SE3(np.array(bodies.placements[j]))
        limits = np.array([[joint.effort], [joint.velocity], [joint.lower], [joint.upper]])
        index = result.addJoint(j, _joint(bodies, j), placement, joint.name, *limits)
        result.appendBodyToJoint(index, to_inertia(values[j]), pin.SE3.Identity())
    return result


def to_inertia(parameters: np.ndarray) -> Any:
    """Return the inertia of ten standard parameters; first moments without mass have none: see `inverse_dynamics`."""
    if parameters[9] == 0.0:
        assert not np.any(parameters)
        return pin.Inertia.Zero()
    return pin.Inertia.FromDynamicParameters(parameters[PINOCCHIO_ORDER])


def inverse_dynamics(chain: Chain, parameters: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return rigid-body torques (N, n) by Pinocchio's RNEA, sample by sample, for any standard parameters (10 n,).

    Bodies without mass are represented by difference: tau(chi) = tau(chi + κ φ) - tau(κ φ), φ a unit body.
    """
    values = np.reshape(parameters, (chain.n, 10))
    massless = values[:, 9] == 0.0
    unit = np.zeros((chain.n, 10))
    unit[massless] = [1.0, 0, 0, 1, 0, 1, 0, 0, 0, 1]
    torques = _rnea(model(chain, values + unit), q, v, a)
    if massless.any():
        torques = torques - _rnea(model(chain, unit), q, v, a)
    return torques


def _rnea(robot: Any, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the torques (N, n) of a Pinocchio model, sample by sample."""
    data = robot.createData()
    return np.array([pin.rnea(robot, data, *state).copy() for state in zip(q, v, a)])


def regressor(chain: Chain, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the regressor (N, n, 10 n) by Pinocchio, sample by sample, columns in the field's order."""
    robot = model(chain, np.zeros((chain.n, 10)))
    data = robot.createData()
    columns = np.array([pin.computeJointTorqueRegressor(robot, data, *state).copy() for state in zip(q, v, a)])
    bodies = columns.reshape(len(q), chain.n, chain.n, 10)
    return bodies[..., np.argsort(PINOCCHIO_ORDER)].reshape(columns.shape)


def forward_dynamics(chain: Chain, parameters: np.ndarray, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return accelerations (N, n) by Pinocchio's articulated-body algorithm, sample by sample."""
    robot = model(chain, parameters)
    data = robot.createData()
    return np.array([pin.aba(robot, data, *state).copy() for state in zip(q, v, tau)])


def _joint(bodies: Bodies, j: int) -> Any:
    """Return the joint of body j; Pinocchio's plain ones where the axis points forward."""
    axis = bodies.scales[j] * np.eye(3)[bodies.axes[j]]
    kind = "P" if bodies.kinds[j] == PRISMATIC else "R"
    if bodies.scales[j] > 0:
        return getattr(pin, f"JointModel{kind}{'XYZ'[bodies.axes[j]]}")()
    if kind == "P":
        return pin.JointModelPrismaticUnaligned(axis)
    return pin.JointModelRevoluteUnaligned(axis)

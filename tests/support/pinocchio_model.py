"""A chain as a Pinocchio model: the reference the kernels are checked against, and the way to Pinocchio's other tools.

Pinocchio's joint frame j is the frame right after the chain's j-th moving element (the link frame of an MDH row), so
standard parameters compare digit by digit with ``model.inertias[j + 1]``. Pinocchio is imported at the first call.
"""

from typing import Any

import numpy as np

from calib.dynamics.bodies import PRISMATIC, Bodies, bodies_of
from calib.errors import RobotError
from calib.records import shaped
from calib.robot.chain import Chain

# Pinocchio's dynamic parameters are M MX MY MZ XX XY YY XZ YZ ZZ; ours in their order:
PINOCCHIO_ORDER = np.array([9, 6, 7, 8, 0, 1, 3, 2, 4, 5])


def model(chain: Chain, parameters: np.ndarray | None = None) -> Any:
    """Return the Pinocchio model of a chain.

    Args:
        parameters: (n, 10) or (10 n,) standard parameters; default the chain's, or zero where it has none.

    Raises:
        RobotError: for mimic joints, and for a body without mass that has moments or inertia.
    """
    pin = _pinocchio()
    bodies = bodies_of(chain)
    if bodies.count != chain.n or np.any(np.abs(bodies.scales) != 1.0):
        raise RobotError(f"robot '{chain.name}': the Pinocchio model has no mimic joints; the kernels handle them")
    values = chain.inertias if parameters is None else parameters
    values = np.zeros((chain.n, 10)) if values is None else np.reshape(values, (chain.n, 10))
    result = pin.Model()
    result.name = chain.name
    result.gravity = pin.Motion(np.array(chain.gravity), np.zeros(3))
    for j, joint in enumerate(chain.joints):
        index = result.addJoint(
            j,
            _joint(bodies, j),
            pin.SE3(np.array(bodies.placements[j])),
            joint.name,
            np.array([joint.effort]),
            np.array([joint.velocity]),
            np.array([joint.lower]),
            np.array([joint.upper]),
        )
        result.appendBodyToJoint(index, to_inertia(values[j], joint.name), pin.SE3.Identity())
    return result


def to_inertia(parameters: np.ndarray, name: str = "") -> Any:
    """Return the inertia of ten standard parameters.

    Pinocchio keeps mass, lever and inertia about the centre of mass, so first moments without mass have no place there:
    see `inverse_dynamics` for a way around it.
    """
    pin = _pinocchio()
    values = shaped(parameters, (10,), f"standard parameters {name}".strip())
    if values[9] == 0.0:
        if np.any(values):
            raise RobotError(f"body '{name}' has moments but no mass: no Pinocchio inertia can say so")
        return pin.Inertia.Zero()
    return pin.Inertia.FromDynamicParameters(values[PINOCCHIO_ORDER])


def inverse_dynamics(chain: Chain, parameters: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return rigid-body torques (N, n) by Pinocchio's RNEA, sample by sample, for any standard parameters (10 n,).

    Bodies without mass are represented by difference: tau(chi) = tau(chi + κ φ) - tau(κ φ), φ a unit body.
    """
    values = np.reshape(shaped(np.ravel(parameters), (10 * chain.n,), "standard parameters"), (chain.n, 10))
    unit = np.where((values[:, 9] == 0.0)[:, None], np.array([1.0, 0, 0, 1, 0, 1, 0, 0, 0, 1]), 0.0)
    result = _rnea(model(chain, values + unit), q, v, a)
    return result - _rnea(model(chain, unit), q, v, a) if unit.any() else result


def regressor(chain: Chain, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the regressor (N, n, 10 n) by Pinocchio, sample by sample, columns in the field's order."""
    pin = _pinocchio()
    made = model(chain, np.zeros((chain.n, 10)))
    data = made.createData()
    back = np.argsort(PINOCCHIO_ORDER)
    result = np.empty((len(q), chain.n, chain.n, 10))
    for k in range(len(q)):
        columns = pin.computeJointTorqueRegressor(made, data, q[k], v[k], a[k])
        result[k] = columns.reshape(chain.n, chain.n, 10)[..., back]
    return result.reshape(len(q), chain.n, 10 * chain.n)


def forward_dynamics(chain: Chain, parameters: np.ndarray, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return accelerations (N, n) by Pinocchio's articulated-body algorithm, sample by sample."""
    pin = _pinocchio()
    made = model(chain, parameters)
    data = made.createData()
    return np.array([pin.aba(made, data, q[k], v[k], tau[k]).copy() for k in range(len(q))])


def _rnea(made: Any, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    pin = _pinocchio()
    data = made.createData()
    return np.array([pin.rnea(made, data, q[k], v[k], a[k]).copy() for k in range(len(q))])


def _joint(bodies: Bodies, j: int) -> Any:
    """Return the joint of body j; Pinocchio's plain ones where the axis points forward."""
    pin = _pinocchio()
    axis = bodies.scales[j] * np.eye(3)[bodies.axes[j]]
    kind = "P" if bodies.kinds[j] == PRISMATIC else "R"
    if bodies.scales[j] > 0:
        return getattr(pin, f"JointModel{kind}{'XYZ'[bodies.axes[j]]}")()
    return pin.JointModelPrismaticUnaligned(axis) if kind == "P" else pin.JointModelRevoluteUnaligned(axis)


def _pinocchio() -> Any:
    """Return the module; its names come from C++, where no type checker sees them."""
    import pinocchio

    return pinocchio

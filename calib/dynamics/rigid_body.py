"""Regressor, torques and inertia matrix of `Bodies` for many samples at once; shapes are checked, then kernels called.

    tau = Y(q, v, a) · chi,    chi the standard parameters XX XY XZ YY YZ ZZ MX MY MZ M, body after body.

Sign: the drives of an arm at rest exert the gravity torques +g(q). numba is imported at the first call, not before.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from calib.dynamics.bodies import PRISMATIC, REVOLUTE, Bodies
from calib.records import shaped

MAX_ANGLE = 1e6
"""Angle up to which the kernels' sine is accurate [rad]."""


def regressor(bodies: Bodies, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the regressor (N, n, 10 B) of the standard parameters.

    Its memory order is (10 B, n, N), so that each column is contiguous in time and stacking needs no copy.

    Args:
        bodies: the robot's bodies.
        q, v, a: (N, n) joint motion [rad or m, and per s, per s²].
    """
    q, v, a = _states(bodies, q=q, v=v, a=a)
    out = np.zeros((10 * bodies.count, bodies.n, len(q)))
    fill_regressor(bodies, q, v, a, out)
    return out.transpose(2, 1, 0)


def fill_regressor(bodies: Bodies, q: np.ndarray, v: np.ndarray, a: np.ndarray, out: np.ndarray) -> None:
    """Write the regressor into `out`, without checks of q, v, a.

    Args:
        bodies: the robot's bodies.
        q, v, a: (N, n) joint motion [rad or m, and per s, per s²].
        out: (10 B, n or more, N) array of zeros, whose first n rows are filled.
    """
    from calib.dynamics import kernels

    amount = _amounts(bodies, q)
    v = np.ascontiguousarray(v.T)
    a = np.ascontiguousarray(a.T)
    kernels.regressor(bodies.links, bodies.constants, bodies.order, amount, v, a, out)


def regressor_products(
    variants: Sequence[Bodies], parameters: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray, weights: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the torques Y χ (n, N) and the sums Σ weights · Y (10 B,) over samples and joints, without forming Y.

    The results equal those by `regressor` at a fraction of the cost.

    Args:
        variants: bodies of robots that differ in geometry and gravity alone, and so have the same coordinates.
        parameters: (10 B,) standard parameters χ.
        q, v, a: (N, n) joint motion [rad or m, and per s, per s²].
        weights: (N, n) weight of each torque.
    """
    from calib.dynamics import kernels

    bodies = variants[0]
    q, v, a = _states(bodies, q=q, v=v, a=a)
    weights = shaped(weights, q.shape, "weights of the torques")
    chi = kernel_parameters(bodies, parameters)
    motion = (_amounts(bodies, q), *(np.ascontiguousarray(series.T) for series in (v, a, weights)))
    for bodies in variants:
        torques = np.zeros((bodies.n, len(q)))
        sums = np.zeros((bodies.count, 10, kernels.L))
        kernels.products(bodies.links, bodies.constants, chi, *motion, torques, sums.reshape(bodies.count, -1))
        pull = np.empty((bodies.count, 10))
        np.put_along_axis(pull, bodies.order, sums.sum(axis=2), axis=1)
        yield torques, pull.ravel()


def _amounts(bodies: Bodies, q: np.ndarray) -> np.ndarray:
    """Return the joint position (B, N) that moves each body [rad or m], below `MAX_ANGLE`, at positions q (N, n)."""
    coordinates = q.T[bodies.coordinates]
    amount = coordinates * bodies.scales[:, None]
    if np.abs(amount).max(initial=0.0) >= MAX_ANGLE:
        is_angle = bodies.kinds[:, None] == REVOLUTE
        amount = np.where(is_angle, np.remainder(amount, 2 * np.pi), amount)
    return amount


def energies(bodies: Bodies, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return kinetic plus potential energy (N, 10 B) per unit of each standard parameter.

        ½ q̇ᵀ [Y(q, 0, q̇) - Y(q, 0, 0)] - [0, gᵀ R, gᵀ p],    R, p: pose of the body's frame in the base

    Here g is the gravity vector and Y the regressor of the torques, so that M(q) q̇ = [Y(q, 0, q̇) - Y(q, 0, 0)] chi
    for the inertia matrix M and standard parameters chi (Gautier 1997).

    Args:
        bodies: the B bodies of the robot.
        q, v: (N, n) joint positions and velocities [rad or m, and per s].
    """
    zero = np.zeros_like(np.asarray(v, dtype=float))
    weightless = bodies.with_gravity(np.zeros(3))
    momentum = regressor(weightless, q, zero, v)
    result = 0.5 * np.einsum("nj,njc->nc", v, momentum)
    for body, T_base_body in enumerate(_frames(bodies, q)):
        mass = 10 * body + 9
        rotation = T_base_body[:, :3, :3]
        position = T_base_body[:, :3, 3]
        result[:, mass - 3 : mass] -= np.einsum("nji,j->ni", rotation, bodies.gravity)
        result[:, mass] -= position @ bodies.gravity
    return result


def _frames(bodies: Bodies, q: np.ndarray) -> np.ndarray:
    """Return the poses (B, N, 4, 4) of the bodies' frames in the base frame, at joint positions q (N, n) [rad or m]."""
    frames = np.empty((bodies.count, len(q), 4, 4))
    for body, parent in enumerate(bodies.parents):
        placement = bodies.placements[body]
        if parent >= 0:
            placement = frames[parent] @ placement
        motion = np.tile(np.eye(4), (len(q), 1, 1))
        coordinate = bodies.coordinates[body]
        if coordinate >= 0:
            amount = bodies.scales[body] * q[:, coordinate]
            axis = int(bodies.axes[body])
            if bodies.kinds[body] == PRISMATIC:
                motion[:, axis, 3] = amount
            else:
                first = (axis + 1) % 3
                second = (axis + 2) % 3
                cosine = np.cos(amount)
                sine = np.sin(amount)
                motion[:, first, first] = cosine
                motion[:, second, second] = cosine
                motion[:, second, first] = sine
                motion[:, first, second] = -sine
        frames[body] = placement @ motion
    return frames


def regressor_gradient(
    bodies: Bodies, q: np.ndarray, v: np.ndarray, a: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the exact gradients of Σ weights · Y(q, v, a) with respect to q, v and a, three arrays (N, n).

    The gradient of any scalar function of Y needs one call. Weights of rank one, ``weights[k] = outer(lambda_k, chi)``,
    give the gradients of Σ lambda · tau.

    Args:
        bodies: the robot's bodies.
        q, v, a: (N, n) joint motion [rad or m, and per s, per s²].
        weights: (N, n, 10 B) weight of each entry of Y.
    """
    from calib.dynamics import gradient_kernels

    q, v, a = _states(bodies, q=q, v=v, a=a)
    shape = (len(q), bodies.n, 10 * bodies.count)
    weights = _plain(shaped(weights, shape, "weights of the regressor"))
    amount, cosine, sine = _placed(bodies, q)
    by_q = np.zeros(q.shape)
    by_v = np.zeros(q.shape)
    by_a = np.zeros(q.shape)
    gradient_kernels.regressor_gradient(
        bodies.links, bodies.constants, bodies.order, amount, cosine, sine, v, a, weights, by_q, by_v, by_a
    )
    return by_q, by_v, by_a


def torque_gradient(
    bodies: Bodies, parameters: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the exact gradients of Σ weights · tau(q, v, a) with respect to q, v and a, three arrays (N, n).

    The result equals `regressor_gradient` with weights of rank one, at a fraction of the cost.

    Args:
        bodies: the robot's bodies.
        parameters: (10 B,) standard parameters.
        q, v, a: (N, n) joint motion [rad or m, and per s, per s²].
        weights: (N, n) weight of each torque.
    """
    from calib.dynamics import gradient_kernels

    q, v, a = _states(bodies, q=q, v=v, a=a)
    weights = _plain(shaped(weights, q.shape, "weights of the torques"))
    chi = shaped(parameters, (10 * bodies.count,), "standard parameters")
    chi = _plain(chi).reshape(1, -1)
    links, constants, order = bodies.links, bodies.constants, bodies.order
    chain = gradient_kernels.hung_on_one(links)
    amount, cosine, sine = _placed(bodies, q)
    by_q = np.zeros(q.shape)
    by_v = np.zeros(q.shape)
    by_a = np.zeros(q.shape)
    gradient_kernels.torque_gradient(
        links, chain, constants, order, amount, cosine, sine, v, a, chi, weights, by_q, by_v, by_a
    )
    return by_q, by_v, by_a


def inverse_dynamics(bodies: Bodies, parameters: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the rigid-body torques (N, n) [N m or N], without motor inertia and friction.

    Args:
        bodies: the robot's bodies.
        parameters: (10 B,) standard parameters; they need not be physically consistent.
        q, v, a: (N, n) joint motion [rad or m, and per s, per s²].
    """
    from calib.dynamics import kernels

    q, v, a = _states(bodies, q=q, v=v, a=a)
    chi = kernel_parameters(bodies, parameters)
    unweighted = np.empty((0, len(q)))
    torques = np.zeros((bodies.n, len(q)))
    kernels.products(
        bodies.links,
        bodies.constants,
        chi,
        _amounts(bodies, q),
        np.ascontiguousarray(v.T),
        np.ascontiguousarray(a.T),
        unweighted,
        torques,
        np.empty((bodies.count, 0)),
    )
    return np.ascontiguousarray(torques.T)


def mass_matrix(bodies: Bodies, parameters: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the joint-space inertia matrices M(q) (N, n, n) of the bodies, without motor inertia.

    Args:
        bodies: the robot's bodies.
        parameters: (10 B,) standard parameters.
        q: (N, n) joint positions [rad or m].
    """
    q = np.asarray(q, dtype=float)
    weightless = bodies.with_gravity(np.zeros(3))
    zero = np.zeros_like(q)
    columns = []
    for unit in np.eye(bodies.n):
        acceleration = np.broadcast_to(unit, q.shape)
        columns.append(inverse_dynamics(weightless, parameters, q, zero, acceleration))
    return np.stack(columns, axis=2)


def kernel_parameters(bodies: Bodies, parameters: np.ndarray) -> np.ndarray:
    """Return standard parameters (10 B,) in the order of the kernels' frames, whose z axis is the joint axis.

    Args:
        bodies: the robot's bodies.
        parameters: (10 B,) in the order of the bodies' own frames.
    """
    parameters = shaped(parameters, (10 * bodies.count,), "standard parameters")
    rows = parameters.reshape(bodies.count, 10)
    return np.take_along_axis(rows, bodies.order, axis=1).ravel()


_NAMES = {"q": "joint positions q", "v": "joint velocities v", "a": "joint accelerations a"}


def _states(bodies: Bodies, **arrays: np.ndarray) -> list[np.ndarray]:
    """Return q, v, a as checked, finite arrays (N, n) of one memory layout (numba compiles a kernel per layout).

    Args:
        bodies: the robot's bodies, which give n.
        arrays: the arrays by the names used in messages.
    """
    rows: int | None = None
    checked = []
    for key, array in arrays.items():
        series = shaped(array, (rows, bodies.n), _NAMES[key])
        checked.append(_plain(series))
        rows = len(series)
    return checked


def _plain(array: np.ndarray) -> np.ndarray:
    """Return the array in C-contiguous, writable memory, without a copy if possible."""
    return np.require(array, requirements=["C", "W"])


def _placed(bodies: Bodies, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the joint position that moves each body, its cosine and its sine, (N, B) each.

    Args:
        bodies: the robot's bodies.
        q: (N, n) joint positions [rad or m].
    """
    # Not q[:, …], which is laid out by columns.
    amount = q.take(bodies.coordinates, axis=1) * bodies.scales
    return amount, np.cos(amount), np.sin(amount)

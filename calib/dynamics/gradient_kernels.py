"""Compiled derivatives (numba) of regressor and torques with respect to q, v and a.

Reverse-mode differentiation, written by hand: the forward pass of `calib.dynamics.kernels` is differentiated from the
last body to the first. Arrays and notation are those of that module.
"""

import numpy as np
from numba import njit

from calib.dynamics.kernels import (
    COORDINATE,
    DEPTH,
    FIXED,
    INNER,
    KIND,
    OPTIONS,
    PARENT,
    PATH,
    REVOLUTE,
    SCALE,
    add,
    advance,
    carry,
    cross,
    dot,
    increase,
    inertia_times,
    place,
    scaled,
    three,
    turned,
)
from calib.records import frozen


@njit(**INNER)
def _share(links, order, i, weights, motion, twists, slopes, bars):
    """Add body i's contribution to the derivatives of Σ_j S_j · wrench_i(g_j) by the body's motion and twists.

    S_j is the twist of the body per unit rate of coordinate j; wrench_i is the body's wrench for the parameters g_j =
    weights[j, body i]. ``slopes`` (B + 1, 9) are the derivatives with respect to w, dw, a; ``bars`` (B + 1, n, 6) the
    derivatives with respect to the twists.

    Args:
        links, order: those of `Bodies`.
        i: index of the body.
        weights: (n, 10 B) weight of each entry of the regressor.
        motion, twists: motion and twists of all bodies, from `kernels.advance` and `kernels.carry`.
        slopes, bars: the derivatives, to which is added.
    """
    h = i + 1
    index = order[i]
    w = three(motion, h, 0)
    e = three(motion, h, 3)
    a = three(motion, h, 6)
    twist = twists[h]
    bar = bars[h]
    for k in range(links[i, DEPTH]):
        j = links[i, PATH + k]
        u = three(twist, j, 0)
        s = three(twist, j, 3)
        g = weights[j, 10 * i : 10 * i + 10]
        J = g[index[0]], g[index[1]], g[index[2]], g[index[3]], g[index[4]], g[index[5]]
        m = g[index[6]], g[index[7]], g[index[8]]
        mass = g[index[9]]
        p = inertia_times(J, w)
        moment = add(add(inertia_times(J, e), cross(w, p)), cross(m, a))
        force = add(add(scaled(mass, a), cross(e, m)), cross(w, cross(w, m)))
        increase(bar, j, 0, moment)
        increase(bar, j, 3, force)
        turning = add(cross(p, u), inertia_times(J, cross(u, w)))
        shifting = add(cross(cross(w, m), s), cross(m, cross(s, w)))
        increase(slopes, h, 0, add(turning, shifting))
        increase(slopes, h, 3, add(inertia_times(J, u), cross(m, s)))
        increase(slopes, h, 6, add(scaled(mass, s), cross(u, m)))


@njit(**INNER)
def _unjoint(links, i, rate, motion, slopes):
    """Reverse the joint's part of `advance`; return the derivatives by joint rate and joint acceleration.

    Args:
        links: those of `Bodies`.
        i: index of the body.
        rate: velocity of the body's joint.
        motion: (B + 1, 9) w, dw, a of all bodies, from `kernels.advance`.
        slopes: (B + 1, 9) derivatives with respect to w, dw, a; row i + 1 is changed to the derivatives before the
            joint.
    """
    h = i + 1
    if links[i, KIND] == FIXED:
        return 0.0, 0.0
    if links[i, KIND] == REVOLUTE:
        by_rate = slopes[h, 2] + slopes[h, 3] * motion[h, 1] - slopes[h, 4] * motion[h, 0]
        slopes[h, 1] += slopes[h, 3] * rate
        slopes[h, 0] -= slopes[h, 4] * rate
        return by_rate, slopes[h, 5]
    by_rate = 2.0 * (slopes[h, 6] * motion[h, 1] - slopes[h, 7] * motion[h, 0])
    slopes[h, 1] += 2.0 * slopes[h, 6] * rate
    slopes[h, 0] -= 2.0 * slopes[h, 7] * rate
    return by_rate, slopes[h, 8]


@njit(**INNER)
def _unadvance(links, i, rate, frames, motion, slopes):
    """Add body i's motion derivatives to its parent's; return the derivative by the joint position.

    Args:
        links: those of `Bodies`.
        i: index of the body.
        rate: velocity of the body's joint.
        frames: (B, 12) rotation and origin of each body in its parent's frame, from `kernels.place`.
        motion: (B + 1, 9) w, dw, a of all bodies, from `kernels.advance`.
        slopes: (B + 1, 9) derivatives with respect to w, dw, a.
    """
    p = links[i, PARENT] + 1
    h = i + 1
    by_amount = 0.0
    if links[i, KIND] == REVOLUTE:
        # d(Rᵀ x)/dθ = -z × Rᵀ x, of the rotated parts of w, dw, a alone.
        vx = motion[h, 0]
        vy = motion[h, 1]
        by_amount += slopes[h, 0] * vy - slopes[h, 1] * vx
        ex = motion[h, 3] - vy * rate
        ey = motion[h, 4] + vx * rate
        by_amount += slopes[h, 3] * ey - slopes[h, 4] * ex
        by_amount += slopes[h, 6] * motion[h, 7] - slopes[h, 7] * motion[h, 6]
    g = turned(frames, i, three(slopes, h, 6))
    w = three(motion, p, 0)
    x = three(frames, i, 9)
    across = cross(w, g)
    turning = add(cross(cross(w, x), g), cross(across, x))
    by_w = turned(frames, i, three(slopes, h, 0))
    by_e = turned(frames, i, three(slopes, h, 3))
    increase(slopes, p, 0, add(by_w, turning))
    increase(slopes, p, 3, add(by_e, cross(x, g)))
    increase(slopes, p, 6, g)
    if links[i, KIND] > REVOLUTE:
        # The slope by the shift, along z.
        shift = frames[i, 2], frames[i, 5], frames[i, 8]
        by_shift = add(cross(g, three(motion, p, 3)), cross(w, across))
        by_amount += dot(shift, by_shift)
    return by_amount


@njit(**INNER)
def _uncarry(links, i, frames, twists, bars):
    """Add body i's twist derivatives to its parent's; return the derivative by the joint position.

    Args:
        links: those of `Bodies`, or of `hung_on_one`.
        i: index of the body.
        frames: (B, 12) rotation and origin of each body in its parent's frame, from `kernels.place`.
        twists: (B + 1, n, 6) twists of all bodies, from `kernels.carry`.
        bars: (B + 1, n, 6) derivatives with respect to the twists.
    """
    p = links[i, PARENT]
    by_amount = 0.0
    twist = twists[i + 1]
    bar = bars[i + 1]
    twist_up = twists[p + 1]
    bar_up = bars[p + 1]
    for k in range(links[p, DEPTH] if p >= 0 else 0):
        j = links[p, PATH + k]
        b = three(bar, j, 0)
        c = three(bar, j, 3)
        s = turned(frames, i, c)
        lever = three(frames, i, 9)
        increase(bar_up, j, 0, add(turned(frames, i, b), cross(lever, s)))
        increase(bar_up, j, 3, s)
        if links[i, KIND] == REVOLUTE:
            by_turn = cross(b, three(twist, j, 0))
            by_lever = cross(c, three(twist, j, 3))
            by_amount += by_turn[2] + by_lever[2]
        elif links[i, KIND] != FIXED:
            shift = frames[i, 2], frames[i, 5], frames[i, 8]
            by_amount += dot(shift, cross(s, three(twist_up, j, 0)))
    return by_amount


@njit(**INNER)
def _back(links, hung, constants, v, frames, motion, twists, slopes, bars, gq, gv, ga):
    """Add one sample's derivatives to gq, gv, ga (n,), in a backward pass from the last body to the first.

    Args:
        links, constants: those of `Bodies`.
        hung: (B, 4 + n) the links used for the twists: those of the robot, or of `hung_on_one`.
        v: (n,) joint velocities.
        frames, motion, twists: results of `kernels.place`, `kernels.advance` and `kernels.carry` for the sample.
        slopes, bars: derivatives with respect to `motion` (B + 1, 9) and `twists` (B + 1, n, 6), which are overwritten.
        gq, gv, ga: (n,) derivatives with respect to q, v and a.
    """
    for i in range(len(frames) - 1, -1, -1):
        c = links[i, COORDINATE]
        scale = constants[i, SCALE]
        rate = scale * v[c]
        by_rate, by_change = _unjoint(links, i, rate, motion, slopes)
        by_amount = _unadvance(links, i, rate, frames, motion, slopes)
        by_amount += _uncarry(hung, i, frames, twists, bars)
        if c >= 0:
            gq[c] += scale * by_amount
            gv[c] += scale * by_rate
            ga[c] += scale * by_change


@njit(**OPTIONS)
def regressor_gradient(links, constants, order, amount, cosine, sine, v, a, weights, gq, gv, ga):
    """Add the gradients of Σ weights · Y(q, v, a), weights (N, n, 10 B), to gq, gv, ga (N, n), which must be zero.

    One forward and one backward pass per sample; the cost per sample is O(n B).

    Args:
        links, constants, order: those of `Bodies`.
        amount, cosine, sine: (N, B) joint position that moves each body [rad or m], its cosine and sine.
        v, a: (N, n) joint velocities and accelerations.
        weights: (N, n, 10 B) weight of each entry of the regressor Y.
        gq, gv, ga: (N, n) gradients with respect to q, v and a.
    """
    bodies = amount.shape[1]
    n = v.shape[1]
    frames = np.empty((bodies, 12))
    motion = np.zeros((bodies + 1, 9))
    twists = np.zeros((bodies + 1, n, 6))
    slopes = np.zeros((bodies + 1, 9))
    bars = np.zeros((bodies + 1, n, 6))
    for r in range(3):
        motion[0, 6 + r] = -constants[bodies, r]
    for sample in range(v.shape[0]):
        slopes[:] = 0.0
        bars[:] = 0.0
        for i in range(bodies):
            c = links[i, COORDINATE]
            scale = constants[i, SCALE]
            place(links, constants, i, amount[sample, i], cosine[sample, i], sine[sample, i], frames)
            advance(links, i, scale * v[sample, c], scale * a[sample, c], frames, motion)
            carry(links, constants, i, frames, twists)
            _share(links, order, i, weights[sample], motion, twists, slopes, bars)
        _back(
            links, links, constants, v[sample], frames, motion, twists, slopes, bars, gq[sample], gv[sample], ga[sample]
        )


def hung_on_one(links: np.ndarray) -> np.ndarray:
    """Return links (B, 4 + n) in which the path of every body is one virtual joint, as `torque_gradient` needs."""
    chain = links.copy()
    chain[:, DEPTH] = 1
    chain[:, PATH] = 0
    chain[:, COORDINATE] = -1
    return frozen(chain, np.int64)


@njit(**OPTIONS)
def torque_gradient(links, chain, constants, order, amount, cosine, sine, v, a, parameters, weights, gq, gv, ga):
    """Add the gradients of Σ weights · tau(q, v, a), weights (N, n), to gq, gv, ga (N, n), which must be zero.

    This equals `regressor_gradient` for weights of rank one. The joints' twists then occur only in their weighted sum,
    so that one virtual joint that carries every body (``chain``, from `hung_on_one`) replaces all joints. The cost per
    sample is O(B).

    Args:
        links, constants, order: those of `Bodies`.
        chain: links from `hung_on_one`.
        amount, cosine, sine: (N, B) joint position that moves each body [rad or m], its cosine and sine.
        v, a: (N, n) joint velocities and accelerations.
        parameters: (1, 10 B) standard parameters, which give the torques tau.
        weights: (N, n) weight of each torque.
        gq, gv, ga: (N, n) gradients with respect to q, v and a.
    """
    bodies = amount.shape[1]
    frames = np.empty((bodies, 12))
    motion = np.zeros((bodies + 1, 9))
    twists = np.zeros((bodies + 1, 1, 6))
    slopes = np.zeros((bodies + 1, 9))
    bars = np.zeros((bodies + 1, 1, 6))
    for r in range(3):
        motion[0, 6 + r] = -constants[bodies, r]
    for sample in range(v.shape[0]):
        slopes[:] = 0.0
        bars[:] = 0.0
        for i in range(bodies):
            c = links[i, COORDINATE]
            scale = constants[i, SCALE]
            place(links, constants, i, amount[sample, i], cosine[sample, i], sine[sample, i], frames)
            advance(links, i, scale * v[sample, c], scale * a[sample, c], frames, motion)
            twists[i + 1] = 0.0
            carry(chain, constants, i, frames, twists)
            if c >= 0:
                axis = 2 if links[i, KIND] == REVOLUTE else 5
                twists[i + 1, 0, axis] += scale * weights[sample, c]
            _share(chain, order, i, parameters, motion, twists, slopes, bars)
        _back(
            links, chain, constants, v[sample], frames, motion, twists, slopes, bars, gq[sample], gv[sample], ga[sample]
        )

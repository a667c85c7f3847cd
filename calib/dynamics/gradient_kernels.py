"""Compiled derivatives (numba) of the regressor and of torques by q, v and a: reverse differentiation, by hand.

Arrays and notation are those of `calib.dynamics.kernels`, whose forward pass is undone here from the last body to the
first.
"""

import numpy as np
from numba import njit

from calib.dynamics.kernels import (
    COORDINATE,
    DEPTH,
    FIXED,
    KIND,
    OPTIONS,
    PARENT,
    PATH,
    REVOLUTE,
    SCALE,
    advance,
    carry,
    place,
)
from calib.records import frozen


@njit(**OPTIONS)
def _share(links, order, i, weights, motion, twists, slopes, bars):
    """Add body i's part of the reverse pass: derivatives of Σ_j S_j · wrench_i(g_j), g_j = weights[j, body i].

    ``slopes`` (B + 1, 9) belongs to w, dw, a; ``bars`` (B + 1, n, 6) to the twists.
    """
    h, first = i + 1, 10 * i
    k0, k1, k2, k3, k4 = order[i, 0], order[i, 1], order[i, 2], order[i, 3], order[i, 4]
    k5, k6, k7, k8 = order[i, 5], order[i, 6], order[i, 7], order[i, 8]
    wx, wy, wz = motion[h, 0], motion[h, 1], motion[h, 2]
    ex, ey, ez = motion[h, 3], motion[h, 4], motion[h, 5]
    ax, ay, az = motion[h, 6], motion[h, 7], motion[h, 8]
    square = wx * wx + wy * wy + wz * wz
    for k in range(links[i, DEPTH]):
        j = links[i, PATH + k]
        ux, uy, uz = twists[h, j, 0], twists[h, j, 1], twists[h, j, 2]
        sx, sy, sz = twists[h, j, 3], twists[h, j, 4], twists[h, j, 5]
        xx, xy, xz = weights[j, first + k0], weights[j, first + k1], weights[j, first + k2]
        yy, yz, zz = weights[j, first + k3], weights[j, first + k4], weights[j, first + k5]
        hx, hy, hz = weights[j, first + k6], weights[j, first + k7], weights[j, first + k8]
        mass = weights[j, first + 9]
        px, py, pz = xx * wx + xy * wy + xz * wz, xy * wx + yy * wy + yz * wz, xz * wx + yz * wy + zz * wz
        dot = wx * hx + wy * hy + wz * hz
        bars[h, j, 0] += xx * ex + xy * ey + xz * ez + wy * pz - wz * py + hy * az - hz * ay
        bars[h, j, 1] += xy * ex + yy * ey + yz * ez + wz * px - wx * pz + hz * ax - hx * az
        bars[h, j, 2] += xz * ex + yz * ey + zz * ez + wx * py - wy * px + hx * ay - hy * ax
        bars[h, j, 3] += mass * ax + ey * hz - ez * hy + wx * dot - hx * square
        bars[h, j, 4] += mass * ay + ez * hx - ex * hz + wy * dot - hy * square
        bars[h, j, 5] += mass * az + ex * hy - ey * hx + wz * dot - hz * square
        cx, cy, cz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        sw, sh = sx * wx + sy * wy + sz * wz, 2.0 * (sx * hx + sy * hy + sz * hz)
        slopes[h, 0] += py * uz - pz * uy + xx * cx + xy * cy + xz * cz + sx * dot + hx * sw - wx * sh
        slopes[h, 1] += pz * ux - px * uz + xy * cx + yy * cy + yz * cz + sy * dot + hy * sw - wy * sh
        slopes[h, 2] += px * uy - py * ux + xz * cx + yz * cy + zz * cz + sz * dot + hz * sw - wz * sh
        slopes[h, 3] += xx * ux + xy * uy + xz * uz + hy * sz - hz * sy
        slopes[h, 4] += xy * ux + yy * uy + yz * uz + hz * sx - hx * sz
        slopes[h, 5] += xz * ux + yz * uy + zz * uz + hx * sy - hy * sx
        slopes[h, 6] += mass * sx + uy * hz - uz * hy
        slopes[h, 7] += mass * sy + uz * hx - ux * hz
        slopes[h, 8] += mass * sz + ux * hy - uy * hx


@njit(**OPTIONS)
def _unjoint(links, i, rate, motion, slopes):
    """Reverse the joint terms of `advance`; return the derivatives with respect to joint rate and acceleration."""
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


@njit(**OPTIONS)
def _unadvance(links, i, rate, frames, motion, slopes):
    """Propagate body i's motion derivatives to its parent; return the derivative with respect to the joint position."""
    p, h = links[i, PARENT] + 1, i + 1
    by_amount = 0.0
    if links[i, KIND] == REVOLUTE:  # d(Rᵀ x)/dθ = -z × Rᵀ x, of the rotated parts of w, dw, a alone
        vx, vy = motion[h, 0], motion[h, 1]
        by_amount += slopes[h, 0] * vy - slopes[h, 1] * vx
        by_amount += slopes[h, 3] * (motion[h, 4] + vx * rate) - slopes[h, 4] * (motion[h, 3] - vy * rate)
        by_amount += slopes[h, 6] * motion[h, 7] - slopes[h, 7] * motion[h, 6]
    sx, sy, sz = slopes[h, 6], slopes[h, 7], slopes[h, 8]
    gx = frames[i, 0] * sx + frames[i, 1] * sy + frames[i, 2] * sz
    gy = frames[i, 3] * sx + frames[i, 4] * sy + frames[i, 5] * sz
    gz = frames[i, 6] * sx + frames[i, 7] * sy + frames[i, 8] * sz
    for r in range(3):
        tx, ty, tz = frames[i, 3 * r], frames[i, 3 * r + 1], frames[i, 3 * r + 2]
        slopes[p, r] += tx * slopes[h, 0] + ty * slopes[h, 1] + tz * slopes[h, 2]
        slopes[p, 3 + r] += tx * slopes[h, 3] + ty * slopes[h, 4] + tz * slopes[h, 5]
    wx, wy, wz = motion[p, 0], motion[p, 1], motion[p, 2]
    x, y, z = frames[i, 9], frames[i, 10], frames[i, 11]
    dot, gw, gt = wx * x + wy * y + wz * z, gx * wx + gy * wy + gz * wz, 2.0 * (gx * x + gy * y + gz * z)
    slopes[p, 0] += gx * dot + x * gw - wx * gt
    slopes[p, 1] += gy * dot + y * gw - wy * gt
    slopes[p, 2] += gz * dot + z * gw - wz * gt
    slopes[p, 3] += y * gz - z * gy
    slopes[p, 4] += z * gx - x * gz
    slopes[p, 5] += x * gy - y * gx
    slopes[p, 6] += gx
    slopes[p, 7] += gy
    slopes[p, 8] += gz
    if links[i, KIND] > REVOLUTE:  # the slope by the shift, along z
        ex, ey, ez = motion[p, 3], motion[p, 4], motion[p, 5]
        square = wx * wx + wy * wy + wz * wz
        by_amount += frames[i, 2] * (gy * ez - gz * ey + wx * gw - gx * square)
        by_amount += frames[i, 5] * (gz * ex - gx * ez + wy * gw - gy * square)
        by_amount += frames[i, 8] * (gx * ey - gy * ex + wz * gw - gz * square)
    return by_amount


@njit(**OPTIONS)
def _uncarry(links, i, frames, twists, bars):
    """Propagate body i's twist derivatives to its parent; return the derivative with respect to the joint position."""
    p, h = links[i, PARENT], i + 1
    x, y, z = frames[i, 9], frames[i, 10], frames[i, 11]
    by_amount = 0.0
    for k in range(links[p, DEPTH] if p >= 0 else 0):
        j = links[p, PATH + k]
        bx, by, bz = bars[h, j, 0], bars[h, j, 1], bars[h, j, 2]
        cx, cy, cz = bars[h, j, 3], bars[h, j, 4], bars[h, j, 5]
        sx = frames[i, 0] * cx + frames[i, 1] * cy + frames[i, 2] * cz
        sy = frames[i, 3] * cx + frames[i, 4] * cy + frames[i, 5] * cz
        sz = frames[i, 6] * cx + frames[i, 7] * cy + frames[i, 8] * cz
        bars[p + 1, j, 0] += frames[i, 0] * bx + frames[i, 1] * by + frames[i, 2] * bz + y * sz - z * sy
        bars[p + 1, j, 1] += frames[i, 3] * bx + frames[i, 4] * by + frames[i, 5] * bz + z * sx - x * sz
        bars[p + 1, j, 2] += frames[i, 6] * bx + frames[i, 7] * by + frames[i, 8] * bz + x * sy - y * sx
        bars[p + 1, j, 3] += sx
        bars[p + 1, j, 4] += sy
        bars[p + 1, j, 5] += sz
        if links[i, KIND] == REVOLUTE:
            by_amount += bx * twists[h, j, 1] - by * twists[h, j, 0] + cx * twists[h, j, 4] - cy * twists[h, j, 3]
        elif links[i, KIND] != FIXED:
            ux, uy, uz = twists[p + 1, j, 0], twists[p + 1, j, 1], twists[p + 1, j, 2]
            by_amount += frames[i, 2] * (sy * uz - sz * uy)
            by_amount += frames[i, 5] * (sz * ux - sx * uz)
            by_amount += frames[i, 8] * (sx * uy - sy * ux)
    return by_amount


@njit(**OPTIONS)
def _back(links, hung, constants, v, frames, motion, twists, slopes, bars, gq, gv, ga):
    """Add one sample's derivatives to gq, gv, ga (n,), from the last body on; `hung`: links that carry the twists."""
    for i in range(len(frames) - 1, -1, -1):
        c, scale = links[i, COORDINATE], constants[i, SCALE]
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
    """Add the gradients of Σ weights · Y(q, v, a), weights (N, n, 10 B), to gq, gv, ga (N, n), which start at 0.

    Reverse differentiation of the regressor, by hand: one forward pass, one pass back, O(n B) per sample.
    """
    bodies, n = amount.shape[1], v.shape[1]
    frames, motion, twists = np.empty((bodies, 12)), np.zeros((bodies + 1, 9)), np.zeros((bodies + 1, n, 6))
    slopes, bars = np.zeros((bodies + 1, 9)), np.zeros((bodies + 1, n, 6))
    for r in range(3):
        motion[0, 6 + r] = -constants[bodies, r]
    for sample in range(v.shape[0]):
        slopes[:] = 0.0
        bars[:] = 0.0
        for i in range(bodies):
            c, scale = links[i, COORDINATE], constants[i, SCALE]
            place(links, constants, i, amount[sample, i], cosine[sample, i], sine[sample, i], frames)
            advance(links, i, scale * v[sample, c], scale * a[sample, c], frames, motion)
            carry(links, constants, i, frames, twists)
            _share(links, order, i, weights[sample], motion, twists, slopes, bars)
        _back(
            links, links, constants, v[sample], frames, motion, twists, slopes, bars, gq[sample], gv[sample], ga[sample]
        )


def hung_on_one(links: np.ndarray) -> np.ndarray:
    """Return links (B, 4 + n) with all bodies on one virtual joint without coordinate, for `torque_gradient`."""
    chain = links.copy()
    chain[:, DEPTH], chain[:, PATH], chain[:, COORDINATE] = 1, 0, -1
    return frozen(chain, np.int64)


@njit(**OPTIONS)
def torque_gradient(links, chain, constants, order, amount, cosine, sine, v, a, parameters, weights, gq, gv, ga):
    """Add the gradients of Σ weights · tau(q, v, a), weights (N, n), to gq, gv, ga (N, n), which start at 0.

    `regressor_gradient` for weights of rank one: the joints' twists enter only as their weighted sum, so one virtual
    joint, which every body hangs on (``chain``, `hung_on_one`), does for all of them: O(B) per sample. ``parameters``
    (1, 10 B).
    """
    bodies = amount.shape[1]
    frames, motion, twists = np.empty((bodies, 12)), np.zeros((bodies + 1, 9)), np.zeros((bodies + 1, 1, 6))
    slopes, bars = np.zeros((bodies + 1, 9)), np.zeros((bodies + 1, 1, 6))
    for r in range(3):
        motion[0, 6 + r] = -constants[bodies, r]
    for sample in range(v.shape[0]):
        slopes[:] = 0.0
        bars[:] = 0.0
        for i in range(bodies):
            c, scale = links[i, COORDINATE], constants[i, SCALE]
            place(links, constants, i, amount[sample, i], cosine[sample, i], sine[sample, i], frames)
            advance(links, i, scale * v[sample, c], scale * a[sample, c], frames, motion)
            twists[i + 1] = 0.0
            carry(chain, constants, i, frames, twists)
            if c >= 0:
                twists[i + 1, 0, 2 if links[i, KIND] == REVOLUTE else 5] += scale * weights[sample, c]
            _share(chain, order, i, parameters, motion, twists, slopes, bars)
        _back(
            links, chain, constants, v[sample], frames, motion, twists, slopes, bars, gq[sample], gv[sample], ga[sample]
        )

"""Compiled rigid-body kernels (numba) on the arrays of a `Tree`: the only module of dynamics that knows numba.

Notation, all in body i's own frame: w angular velocity, dw its derivative, a acceleration of the frame's origin minus
gravity, (u_j, s_j) angular and linear velocity of the frame per unit rate of coordinate j. The wrench of body i,

    f = M a + dw × h + w × (w × h),    n = J dw + w × J w + h × a,

J the inertia about the origin, h = [MX, MY, MZ] (Gautier & Khalil 1990), is linear in the parameters, and
tau_j = Σ_i (u_j · n_i + s_j · f_i): the regressor needs no backward pass. Products and sums may be fused ("contract");
nothing else of IEEE arithmetic is given up. ``tree`` is `Tree.arrays`, B bodies, n coordinates; ``amount``, ``cosine``,
``sine`` (N, B) are each body's own motion. Row 0 of ``motion`` and ``twists`` is the base, row i + 1 body i.
"""

from __future__ import annotations

import numpy as np
from numba import njit

FIXED, REVOLUTE = 0, 1
L = 32  # samples side by side in the regressor: 8 to 128 measured, flat from 32 on
OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract"}}


@njit(**OPTIONS)
def _place(tree, i, amount, cosine, sine, turn, shift):
    """Write rotation turn[i] and origin shift[i] of body i in its parent's frame, the joint moved by `amount`."""
    kind, axis, placement = tree[1][i], tree[2][i], tree[5]
    for r in range(3):
        turn[i, r, 0] = placement[i, r, 0]
        turn[i, r, 1] = placement[i, r, 1]
        turn[i, r, 2] = placement[i, r, 2]
        shift[i, r] = placement[i, r, 3]
    if kind == REVOLUTE:
        one, two = (axis + 1) % 3, (axis + 2) % 3
        for r in range(3):
            x, y = turn[i, r, one], turn[i, r, two]
            turn[i, r, one] = cosine * x + sine * y
            turn[i, r, two] = cosine * y - sine * x
    elif kind != FIXED:
        for r in range(3):
            shift[i, r] += amount * turn[i, r, axis]


@njit(**OPTIONS)
def _advance(tree, i, rate, change, turn, shift, motion):
    """Write w, dw, a of body i (row i + 1 of `motion`, (B + 1, 9)) from its parent's."""
    p, h = tree[0][i] + 1, i + 1
    wx, wy, wz = motion[p, 0], motion[p, 1], motion[p, 2]
    ex, ey, ez = motion[p, 3], motion[p, 4], motion[p, 5]
    x, y, z = shift[i, 0], shift[i, 1], shift[i, 2]
    dot, square = wx * x + wy * y + wz * z, wx * wx + wy * wy + wz * wz
    ax = motion[p, 6] + ey * z - ez * y + wx * dot - x * square
    ay = motion[p, 7] + ez * x - ex * z + wy * dot - y * square
    az = motion[p, 8] + ex * y - ey * x + wz * dot - z * square
    for r in range(3):
        tx, ty, tz = turn[i, 0, r], turn[i, 1, r], turn[i, 2, r]
        motion[h, r] = tx * wx + ty * wy + tz * wz
        motion[h, 3 + r] = tx * ex + ty * ey + tz * ez
        motion[h, 6 + r] = tx * ax + ty * ay + tz * az
    kind, axis = tree[1][i], tree[2][i]
    if kind == FIXED:
        return
    one, two = (axis + 1) % 3, (axis + 2) % 3
    if kind == REVOLUTE:
        motion[h, 3 + one] += motion[h, two] * rate
        motion[h, 3 + two] -= motion[h, one] * rate
        motion[h, 3 + axis] += change
        motion[h, axis] += rate
    else:
        motion[h, 6 + one] += 2.0 * motion[h, two] * rate
        motion[h, 6 + two] -= 2.0 * motion[h, one] * rate
        motion[h, 6 + axis] += change


@njit(**OPTIONS)
def _carry(tree, i, turn, shift, twists):
    """Write the twists (u_j, s_j) of body i (row i + 1 of `twists`, (B + 1, n, 6)) from its parent's."""
    t00, t01, t02 = turn[i, 0, 0], turn[i, 0, 1], turn[i, 0, 2]
    t10, t11, t12 = turn[i, 1, 0], turn[i, 1, 1], turn[i, 1, 2]
    t20, t21, t22 = turn[i, 2, 0], turn[i, 2, 1], turn[i, 2, 2]
    x, y, z = shift[i, 0], shift[i, 1], shift[i, 2]
    p, h, own = tree[0][i], i + 1, tree[4][i]
    if own >= 0:
        for r in range(6):
            twists[h, own, r] = 0.0
    for k in range(tree[8][p] if p >= 0 else 0):
        j = tree[7][p, k]
        ux, uy, uz = twists[p + 1, j, 0], twists[p + 1, j, 1], twists[p + 1, j, 2]
        sx = twists[p + 1, j, 3] + uy * z - uz * y
        sy = twists[p + 1, j, 4] + uz * x - ux * z
        sz = twists[p + 1, j, 5] + ux * y - uy * x
        twists[h, j, 0] = t00 * ux + t10 * uy + t20 * uz
        twists[h, j, 1] = t01 * ux + t11 * uy + t21 * uz
        twists[h, j, 2] = t02 * ux + t12 * uy + t22 * uz
        twists[h, j, 3] = t00 * sx + t10 * sy + t20 * sz
        twists[h, j, 4] = t01 * sx + t11 * sy + t21 * sz
        twists[h, j, 5] = t02 * sx + t12 * sy + t22 * sz
    if own >= 0:
        twists[h, own, tree[2][i] + (0 if tree[1][i] == REVOLUTE else 3)] += tree[3][i]


@njit(**OPTIONS)
def _place_lanes(placement, i, joint, turn):
    """Write rotation (rows 0 to 8) and origin (9 to 11) of body i from cosine, sine and shift in `joint`."""
    a0, a1, a2, x = placement[i, 0, 0], placement[i, 0, 1], placement[i, 0, 2], placement[i, 0, 3]
    b0, b1, b2, y = placement[i, 1, 0], placement[i, 1, 1], placement[i, 1, 2], placement[i, 1, 3]
    c0, c1, c2, z = placement[i, 2, 0], placement[i, 2, 1], placement[i, 2, 2], placement[i, 2, 3]
    for k in range(L):
        cosine, sine, shift = joint[k], joint[L + k], joint[2 * L + k]
        turn[k], turn[L + k], turn[2 * L + k] = cosine * a0 + sine * a1, cosine * a1 - sine * a0, a2
        turn[3 * L + k], turn[4 * L + k], turn[5 * L + k] = cosine * b0 + sine * b1, cosine * b1 - sine * b0, b2
        turn[6 * L + k], turn[7 * L + k], turn[8 * L + k] = cosine * c0 + sine * c1, cosine * c1 - sine * c0, c2
        turn[9 * L + k], turn[10 * L + k], turn[11 * L + k] = x + shift * a2, y + shift * b2, z + shift * c2


@njit(**OPTIONS)
def _advance_lanes(turning, joint, turn, up, here):
    """`_advance` for L samples, the joint about (turning 1) or along (turning 0) z."""
    f, g = turning, 1.0 - turning
    for k in range(L):
        wx, wy, wz = up[k], up[L + k], up[2 * L + k]
        ex, ey, ez = up[3 * L + k], up[4 * L + k], up[5 * L + k]
        x, y, z = turn[9 * L + k], turn[10 * L + k], turn[11 * L + k]
        t00, t01, t02 = turn[k], turn[L + k], turn[2 * L + k]
        t10, t11, t12 = turn[3 * L + k], turn[4 * L + k], turn[5 * L + k]
        t20, t21, t22 = turn[6 * L + k], turn[7 * L + k], turn[8 * L + k]
        rate, change = joint[3 * L + k], joint[4 * L + k]
        dot, square = wx * x + wy * y + wz * z, wx * wx + wy * wy + wz * wz
        ax = up[6 * L + k] + ey * z - ez * y + wx * dot - x * square
        ay = up[7 * L + k] + ez * x - ex * z + wy * dot - y * square
        az = up[8 * L + k] + ex * y - ey * x + wz * dot - z * square
        px, py = t00 * wx + t10 * wy + t20 * wz, t01 * wx + t11 * wy + t21 * wz
        here[k], here[L + k] = px, py
        here[2 * L + k] = t02 * wx + t12 * wy + t22 * wz + f * rate
        here[3 * L + k] = t00 * ex + t10 * ey + t20 * ez + f * rate * py
        here[4 * L + k] = t01 * ex + t11 * ey + t21 * ez - f * rate * px
        here[5 * L + k] = t02 * ex + t12 * ey + t22 * ez + f * change
        here[6 * L + k] = t00 * ax + t10 * ay + t20 * az + 2.0 * g * rate * py
        here[7 * L + k] = t01 * ax + t11 * ay + t21 * az - 2.0 * g * rate * px
        here[8 * L + k] = t02 * ax + t12 * ay + t22 * az + g * change


@njit(**OPTIONS)
def _carry_lanes(turn, up, here):
    """`_carry` of one coordinate's twist for L samples."""
    for k in range(L):
        x, y, z = turn[9 * L + k], turn[10 * L + k], turn[11 * L + k]
        t00, t01, t02 = turn[k], turn[L + k], turn[2 * L + k]
        t10, t11, t12 = turn[3 * L + k], turn[4 * L + k], turn[5 * L + k]
        t20, t21, t22 = turn[6 * L + k], turn[7 * L + k], turn[8 * L + k]
        ux, uy, uz = up[k], up[L + k], up[2 * L + k]
        sx = up[3 * L + k] + uy * z - uz * y
        sy = up[4 * L + k] + uz * x - ux * z
        sz = up[5 * L + k] + ux * y - uy * x
        here[k] = t00 * ux + t10 * uy + t20 * uz
        here[L + k] = t01 * ux + t11 * uy + t21 * uz
        here[2 * L + k] = t02 * ux + t12 * uy + t22 * uz
        here[3 * L + k] = t00 * sx + t10 * sy + t20 * sz
        here[4 * L + k] = t01 * sx + t11 * sy + t21 * sz
        here[5 * L + k] = t02 * sx + t12 * sy + t22 * sz


@njit(**OPTIONS)
def _project_lanes(motion, twist, columns):
    """Write the ten columns of one body in one coordinate's row for L samples."""
    for k in range(L):
        wx, wy, wz = motion[k], motion[L + k], motion[2 * L + k]
        ex, ey, ez = motion[3 * L + k], motion[4 * L + k], motion[5 * L + k]
        ax, ay, az = motion[6 * L + k], motion[7 * L + k], motion[8 * L + k]
        ux, uy, uz = twist[k], twist[L + k], twist[2 * L + k]
        sx, sy, sz = twist[3 * L + k], twist[4 * L + k], twist[5 * L + k]
        xx, yy, zz, xy, xz, yz = wx * wx, wy * wy, wz * wz, wx * wy, wx * wz, wy * wz
        cx, cy, cz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        columns[k] = ux * ex + cx * wx
        columns[L + k] = ux * ey + uy * ex + cx * wy + cy * wx
        columns[2 * L + k] = ux * ez + uz * ex + cx * wz + cz * wx
        columns[3 * L + k] = uy * ey + cy * wy
        columns[4 * L + k] = uy * ez + uz * ey + cy * wz + cz * wy
        columns[5 * L + k] = uz * ez + cz * wz
        columns[6 * L + k] = sy * (xy + ez) + sz * (xz - ey) - sx * (yy + zz) + ay * uz - az * uy
        columns[7 * L + k] = sx * (xy - ez) + sz * (yz + ex) - sy * (xx + zz) + az * ux - ax * uz
        columns[8 * L + k] = sx * (xz + ey) + sy * (yz - ex) - sz * (xx + yy) + ax * uy - ay * ux
        columns[9 * L + k] = sx * ax + sy * ay + sz * az


@njit(**OPTIONS)
def _load_lanes(tree, i, amount, cosine, sine, v, a, start, count, joint):
    """Write cosine, sine, shift, rate and change of body i's joint for `count` samples from `start`."""
    c, scale, revolute, sliding = tree[4][i], tree[3][i], tree[1][i] == REVOLUTE, tree[1][i] > REVOLUTE
    for k in range(count):
        joint[k] = cosine[i, start + k] if revolute else 1.0
        joint[L + k] = sine[i, start + k] if revolute else 0.0
        joint[2 * L + k] = amount[i, start + k] if sliding else 0.0
        joint[3 * L + k] = scale * v[c, start + k]
        joint[4 * L + k] = scale * a[c, start + k]


@njit(**OPTIONS)
def regressor(tree, upright, order, amount, cosine, sine, v, a, out):
    """Fill out (10 B, n, N), zero on entry, with the standard regressor; amount, cosine, sine (B, N), v, a (n, N).

    L samples at a time, the sample index innermost, so that the compiler turns every line into vector instructions.
    Frames are turned so that each joint's axis is z (`Tree.upright`); `order` (B, 10) puts the columns back.
    """
    bodies, count, n = amount.shape[0], amount.shape[1], v.shape[0]
    joint, turn, columns = np.zeros(5 * L), np.empty(12 * L), np.empty(10 * L)
    motion, twists = np.zeros((bodies + 1, 9 * L)), np.zeros((bodies + 1, n, 6 * L))
    for r in range(3):
        motion[0, (6 + r) * L : (7 + r) * L] = -tree[6][r]
    for start in range(0, count, L):
        width = min(L, count - start)
        for i in range(bodies):
            c, p, turning = tree[4][i], tree[0][i], 1.0 if tree[1][i] == REVOLUTE else 0.0
            _load_lanes(tree, i, amount, cosine, sine, v, a, start, width, joint)
            _place_lanes(upright, i, joint, turn)
            _advance_lanes(turning, joint, turn, motion[p + 1], motion[i + 1])
            if c >= 0:
                twists[i + 1, c, :] = 0.0
            for k in range(tree[8][p] if p >= 0 else 0):
                _carry_lanes(turn, twists[p + 1, tree[7][p, k]], twists[i + 1, tree[7][p, k]])
            if c >= 0:
                first = (2 if tree[1][i] == REVOLUTE else 5) * L
                twists[i + 1, c, first : first + L] += tree[3][i]
            for k in range(tree[8][i]):
                j = tree[7][i, k]
                _project_lanes(motion[i + 1], twists[i + 1, j], columns)
                for r in range(10):
                    row = 10 * i + order[i, r]
                    for lane in range(width):
                        out[row, j, start + lane] = columns[r * L + lane]


@njit(**OPTIONS)
def _wrench(i, parameters, motion, wrench):
    """Write force and moment of body i about its own frame's origin (row i of `wrench`, (B, 6))."""
    h, k = i + 1, 10 * i
    wx, wy, wz = motion[h, 0], motion[h, 1], motion[h, 2]
    ex, ey, ez = motion[h, 3], motion[h, 4], motion[h, 5]
    ax, ay, az = motion[h, 6], motion[h, 7], motion[h, 8]
    xx, xy, xz = parameters[k], parameters[k + 1], parameters[k + 2]
    yy, yz, zz = parameters[k + 3], parameters[k + 4], parameters[k + 5]
    hx, hy, hz, mass = parameters[k + 6], parameters[k + 7], parameters[k + 8], parameters[k + 9]
    dot, square = wx * hx + wy * hy + wz * hz, wx * wx + wy * wy + wz * wz
    wrench[i, 0] = mass * ax + ey * hz - ez * hy + wx * dot - hx * square
    wrench[i, 1] = mass * ay + ez * hx - ex * hz + wy * dot - hy * square
    wrench[i, 2] = mass * az + ex * hy - ey * hx + wz * dot - hz * square
    px, py, pz = xx * wx + xy * wy + xz * wz, xy * wx + yy * wy + yz * wz, xz * wx + yz * wy + zz * wz
    wrench[i, 3] = xx * ex + xy * ey + xz * ez + wy * pz - wz * py + hy * az - hz * ay
    wrench[i, 4] = xy * ex + yy * ey + yz * ez + wz * px - wx * pz + hz * ax - hx * az
    wrench[i, 5] = xz * ex + yz * ey + zz * ez + wx * py - wy * px + hx * ay - hy * ax


@njit(**OPTIONS)
def _return(tree, i, turn, shift, wrench, sign, tau):
    """Add sign times body i's share to tau (n,), then its wrench to the parent's."""
    c, p = tree[4][i], tree[0][i]
    if c >= 0:
        tau[c] += sign * tree[3][i] * wrench[i, tree[2][i] + (3 if tree[1][i] == REVOLUTE else 0)]
    if p >= 0:
        fx, fy, fz = wrench[i, 0], wrench[i, 1], wrench[i, 2]
        nx, ny, nz = wrench[i, 3], wrench[i, 4], wrench[i, 5]
        gx = turn[i, 0, 0] * fx + turn[i, 0, 1] * fy + turn[i, 0, 2] * fz
        gy = turn[i, 1, 0] * fx + turn[i, 1, 1] * fy + turn[i, 1, 2] * fz
        gz = turn[i, 2, 0] * fx + turn[i, 2, 1] * fy + turn[i, 2, 2] * fz
        x, y, z = shift[i, 0], shift[i, 1], shift[i, 2]
        wrench[p, 0] += gx
        wrench[p, 1] += gy
        wrench[p, 2] += gz
        wrench[p, 3] += turn[i, 0, 0] * nx + turn[i, 0, 1] * ny + turn[i, 0, 2] * nz + y * gz - z * gy
        wrench[p, 4] += turn[i, 1, 0] * nx + turn[i, 1, 1] * ny + turn[i, 1, 2] * nz + z * gx - x * gz
        wrench[p, 5] += turn[i, 2, 0] * nx + turn[i, 2, 1] * ny + turn[i, 2, 2] * nz + x * gy - y * gx


@njit(**OPTIONS)
def inverse_dynamics(tree, parameters, amount, cosine, sine, v, a, out):
    """Fill out (N, n), zero on entry, with the torques (recursive Newton-Euler; Luh, Walker, Paul 1980)."""
    bodies = amount.shape[1]
    turn, shift = np.empty((bodies, 3, 3)), np.empty((bodies, 3))
    motion, wrench, tau = np.zeros((bodies + 1, 9)), np.empty((bodies, 6)), np.empty(v.shape[1])
    motion[0, 6:] = -tree[6]
    for sample in range(v.shape[0]):
        tau[:] = 0.0
        for i in range(bodies):
            c = tree[4][i]
            rate = tree[3][i] * v[sample, c] if c >= 0 else 0.0
            change = tree[3][i] * a[sample, c] if c >= 0 else 0.0
            _place(tree, i, amount[sample, i], cosine[sample, i], sine[sample, i], turn, shift)
            _advance(tree, i, rate, change, turn, shift, motion)
            _wrench(i, parameters, motion, wrench)
        for i in range(bodies - 1, -1, -1):
            _return(tree, i, turn, shift, wrench, 1.0, tau)
        for j in range(v.shape[1]):
            out[sample, j] = tau[j]


@njit(**OPTIONS)
def _compose(tree, i, turn, shift, composite):
    """Add the parameters of body i, taken to its parent's frame, to the parent's (rows of `composite`, (B, 10))."""
    p = tree[0][i]
    if p < 0:
        return
    xx, xy, xz = composite[i, 0], composite[i, 1], composite[i, 2]
    yy, yz, zz = composite[i, 3], composite[i, 4], composite[i, 5]
    bx, by, bz, mass = composite[i, 6], composite[i, 7], composite[i, 8], composite[i, 9]
    x, y, z = shift[i, 0], shift[i, 1], shift[i, 2]
    hx = turn[i, 0, 0] * bx + turn[i, 0, 1] * by + turn[i, 0, 2] * bz
    hy = turn[i, 1, 0] * bx + turn[i, 1, 1] * by + turn[i, 1, 2] * bz
    hz = turn[i, 2, 0] * bx + turn[i, 2, 1] * by + turn[i, 2, 2] * bz
    # J about the parent's origin = R J Rᵀ + (2 t·h + M t·t) 1 - (h tᵀ + t hᵀ) - M t tᵀ
    trace = 2.0 * (x * hx + y * hy + z * hz) + mass * (x * x + y * y + z * z)
    k = 0
    for r in range(3):
        tx, ty, tz = turn[i, r, 0], turn[i, r, 1], turn[i, r, 2]
        cx, cy, cz = xx * tx + xy * ty + xz * tz, xy * tx + yy * ty + yz * tz, xz * tx + yz * ty + zz * tz
        for s in range(r, 3):
            composite[p, k] += cx * turn[i, s, 0] + cy * turn[i, s, 1] + cz * turn[i, s, 2]
            k += 1
    composite[p, 0] += trace - 2.0 * hx * x - mass * x * x
    composite[p, 3] += trace - 2.0 * hy * y - mass * y * y
    composite[p, 5] += trace - 2.0 * hz * z - mass * z * z
    composite[p, 1] -= hx * y + hy * x + mass * x * y
    composite[p, 2] -= hx * z + hz * x + mass * x * z
    composite[p, 4] -= hy * z + hz * y + mass * y * z
    composite[p, 6] += hx + mass * x
    composite[p, 7] += hy + mass * y
    composite[p, 8] += hz + mass * z
    composite[p, 9] += mass


@njit(**OPTIONS)
def _momentum(tree, i, composite, wrench):
    """Write what a unit rate of body i's own joint gives the composite body: force and moment (row i of `wrench`)."""
    axis = tree[2][i]
    one, two = (axis + 1) % 3, (axis + 2) % 3
    for k in range(6):
        wrench[i, k] = 0.0
    if tree[1][i] == REVOLUTE:
        wrench[i, one], wrench[i, two] = -composite[i, 6 + two], composite[i, 6 + one]
        wrench[i, 3] = composite[i, axis]
        wrench[i, 4] = composite[i, 1 if axis == 0 else 3 if axis == 1 else 4]
        wrench[i, 5] = composite[i, 2 if axis == 0 else 4 if axis == 1 else 5]
    else:
        wrench[i, axis] = composite[i, 9]
        wrench[i, 3 + one], wrench[i, 3 + two] = composite[i, 6 + two], -composite[i, 6 + one]


@njit(**OPTIONS)
def _inertia(tree, turn, shift, composite, wrench, matrix):
    """Add the joint-space inertia to matrix (n, n) (composite rigid bodies; Walker & Orin 1982)."""
    for i in range(turn.shape[0] - 1, -1, -1):
        _compose(tree, i, turn, shift, composite)
        c, k = tree[4][i], i
        if c < 0:
            continue
        _momentum(tree, i, composite, wrench)
        fx, fy, fz = wrench[i, 0], wrench[i, 1], wrench[i, 2]
        nx, ny, nz = wrench[i, 3], wrench[i, 4], wrench[i, 5]
        weight = tree[3][i]
        matrix[c, c] += weight * weight * wrench[i, tree[2][i] + (3 if tree[1][i] == REVOLUTE else 0)]
        while tree[0][k] >= 0:
            gx = turn[k, 0, 0] * fx + turn[k, 0, 1] * fy + turn[k, 0, 2] * fz
            gy = turn[k, 1, 0] * fx + turn[k, 1, 1] * fy + turn[k, 1, 2] * fz
            gz = turn[k, 2, 0] * fx + turn[k, 2, 1] * fy + turn[k, 2, 2] * fz
            mx = turn[k, 0, 0] * nx + turn[k, 0, 1] * ny + turn[k, 0, 2] * nz
            my = turn[k, 1, 0] * nx + turn[k, 1, 1] * ny + turn[k, 1, 2] * nz
            mz = turn[k, 2, 0] * nx + turn[k, 2, 1] * ny + turn[k, 2, 2] * nz
            x, y, z = shift[k, 0], shift[k, 1], shift[k, 2]
            fx, fy, fz = gx, gy, gz
            nx, ny, nz = mx + y * gz - z * gy, my + z * gx - x * gz, mz + x * gy - y * gx
            k = tree[0][k]
            d, axis = tree[4][k], tree[2][k]
            if d >= 0:
                if tree[1][k] == REVOLUTE:
                    share = nx if axis == 0 else ny if axis == 1 else nz
                else:
                    share = fx if axis == 0 else fy if axis == 1 else fz
                matrix[c, d] += weight * tree[3][k] * share
                matrix[d, c] += weight * tree[3][k] * share


@njit(**OPTIONS)
def solve(matrix, vector):
    """Overwrite vector (n,) with matrix⁻¹ vector by Cholesky; `matrix` is lost. False where it is not definite."""
    n = vector.shape[0]
    for j in range(n):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not pivot > 0.0:
            return False
        pivot = np.sqrt(pivot)
        matrix[j, j] = pivot
        for i in range(j + 1, n):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / pivot
        total = vector[j]
        for k in range(j):
            total -= matrix[j, k] * vector[k]
        vector[j] = total / pivot
    for j in range(n - 1, -1, -1):
        total = vector[j]
        for k in range(j + 1, n):
            total -= matrix[k, j] * vector[k]
        vector[j] = total / matrix[j, j]
    return True


@njit(**OPTIONS)
def workspace(bodies, n):
    """Return the scratch arrays of `accelerate` for B bodies and n coordinates."""
    turn, shift, motion = np.empty((bodies, 3, 3)), np.empty((bodies, 3)), np.zeros((bodies + 1, 9))
    return turn, shift, motion, np.empty((bodies, 6)), np.empty((bodies, 10)), np.empty((n, n))


@njit(**OPTIONS)
def accelerate(tree, parameters, added, q, v, tau, work, out):
    """Write the accelerations (n,) of one state: (M(q) + added) a = tau - c(q, v) - g(q).

    Made to be called from other compiled loops: allocates nothing, `work` from `workspace`.

    Returns:
        False where the inertia matrix is not positive definite; `out` is then not an answer.
    """
    turn, shift, motion, wrench, composite, matrix = work
    bodies, n = turn.shape[0], q.shape[0]
    motion[0, 6], motion[0, 7], motion[0, 8] = -tree[6][0], -tree[6][1], -tree[6][2]
    for j in range(n):
        out[j] = tau[j]
        for k in range(n):
            matrix[j, k] = added[j, k]
    for i in range(bodies):
        c = tree[4][i]
        amount, rate = (tree[3][i] * q[c], tree[3][i] * v[c]) if c >= 0 else (0.0, 0.0)
        _place(tree, i, amount, np.cos(amount), np.sin(amount), turn, shift)
        _advance(tree, i, rate, 0.0, turn, shift, motion)
        _wrench(i, parameters, motion, wrench)
        for k in range(10):
            composite[i, k] = parameters[10 * i + k]
    for i in range(bodies - 1, -1, -1):
        _return(tree, i, turn, shift, wrench, -1.0, out)
    _inertia(tree, turn, shift, composite, wrench, matrix)
    return solve(matrix, out)


@njit(**OPTIONS)
def forward_dynamics(tree, parameters, added, q, v, tau, out):
    """Fill out (N, n) by `accelerate`; return the first sample whose inertia is not positive definite, or -1."""
    work = workspace(tree[0].shape[0], q.shape[1])
    for sample in range(q.shape[0]):
        if not accelerate(tree, parameters, added, q[sample], v[sample], tau[sample], work, out[sample]):
            return sample
    return -1


@njit(**OPTIONS)
def mass_matrix(tree, parameters, amount, cosine, sine, out):
    """Fill out (N, n, n), zero on entry, with the joint-space inertia."""
    bodies = amount.shape[1]
    turn, shift, wrench = np.empty((bodies, 3, 3)), np.empty((bodies, 3)), np.empty((bodies, 6))
    composite = np.empty((bodies, 10))
    for sample in range(amount.shape[0]):
        for i in range(bodies):
            _place(tree, i, amount[sample, i], cosine[sample, i], sine[sample, i], turn, shift)
            for k in range(10):
                composite[i, k] = parameters[10 * i + k]
        _inertia(tree, turn, shift, composite, wrench, out[sample])


@njit(**OPTIONS)
def _share(tree, i, sample, weights, motion, twists, slopes, bars):
    """Add body i's own part of the reverse pass: slopes of Σ_j S_j · wrench_i(g_j), g_j = weights[sample, j, body i].

    ``slopes`` (B + 1, 9) belongs to w, dw, a; ``bars`` (B + 1, n, 6) to the twists.
    """
    h, first = i + 1, 10 * i
    wx, wy, wz = motion[h, 0], motion[h, 1], motion[h, 2]
    ex, ey, ez = motion[h, 3], motion[h, 4], motion[h, 5]
    ax, ay, az = motion[h, 6], motion[h, 7], motion[h, 8]
    square = wx * wx + wy * wy + wz * wz
    for k in range(tree[8][i]):
        j = tree[7][i, k]
        ux, uy, uz = twists[h, j, 0], twists[h, j, 1], twists[h, j, 2]
        sx, sy, sz = twists[h, j, 3], twists[h, j, 4], twists[h, j, 5]
        xx, xy, xz = weights[sample, j, first], weights[sample, j, first + 1], weights[sample, j, first + 2]
        yy, yz, zz = weights[sample, j, first + 3], weights[sample, j, first + 4], weights[sample, j, first + 5]
        hx, hy, hz = weights[sample, j, first + 6], weights[sample, j, first + 7], weights[sample, j, first + 8]
        mass = weights[sample, j, first + 9]
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
def _unjoint(tree, i, rate, motion, slopes):
    """Undo the joint's own terms of `_advance` in reverse; return the slopes by rate and by change."""
    kind, axis, h = tree[1][i], tree[2][i], i + 1
    one, two = (axis + 1) % 3, (axis + 2) % 3
    if kind == FIXED:
        return 0.0, 0.0
    if kind == REVOLUTE:
        by_rate = slopes[h, axis] + slopes[h, 3 + one] * motion[h, two] - slopes[h, 3 + two] * motion[h, one]
        slopes[h, two] += slopes[h, 3 + one] * rate
        slopes[h, one] -= slopes[h, 3 + two] * rate
        return by_rate, slopes[h, 3 + axis]
    by_rate = 2.0 * (slopes[h, 6 + one] * motion[h, two] - slopes[h, 6 + two] * motion[h, one])
    slopes[h, two] += 2.0 * slopes[h, 6 + one] * rate
    slopes[h, one] -= 2.0 * slopes[h, 6 + two] * rate
    return by_rate, slopes[h, 6 + axis]


@njit(**OPTIONS)
def _unadvance(tree, i, rate, turn, shift, motion, slopes):
    """Take the slopes of body i's motion to its parent's; return the slope by the joint's own motion."""
    p, h, axis = tree[0][i] + 1, i + 1, tree[2][i]
    one, two = (axis + 1) % 3, (axis + 2) % 3
    by_amount = 0.0
    if tree[1][i] == REVOLUTE:  # d(Rᵀ x)/dθ = -z × Rᵀ x, of the rotated parts of w, dw, a alone
        vx, vy = motion[h, one], motion[h, two]
        by_amount += slopes[h, one] * vy - slopes[h, two] * vx
        by_amount += slopes[h, 3 + one] * (motion[h, 3 + two] + vx * rate)
        by_amount -= slopes[h, 3 + two] * (motion[h, 3 + one] - vy * rate)
        by_amount += slopes[h, 6 + one] * motion[h, 6 + two] - slopes[h, 6 + two] * motion[h, 6 + one]
    for r in range(3):
        tx, ty, tz = turn[i, r, 0], turn[i, r, 1], turn[i, r, 2]
        for part in (0, 3, 6):
            up = tx * slopes[h, part] + ty * slopes[h, part + 1] + tz * slopes[h, part + 2]
            slopes[p, part + r] += up
            if part == 6:
                slopes[0, r] = up
    gx, gy, gz = slopes[0, 0], slopes[0, 1], slopes[0, 2]
    wx, wy, wz = motion[p, 0], motion[p, 1], motion[p, 2]
    x, y, z = shift[i, 0], shift[i, 1], shift[i, 2]
    dot, gw, gt = wx * x + wy * y + wz * z, gx * wx + gy * wy + gz * wz, 2.0 * (gx * x + gy * y + gz * z)
    slopes[p, 0] += gx * dot + x * gw - wx * gt
    slopes[p, 1] += gy * dot + y * gw - wy * gt
    slopes[p, 2] += gz * dot + z * gw - wz * gt
    slopes[p, 3] += y * gz - z * gy
    slopes[p, 4] += z * gx - x * gz
    slopes[p, 5] += x * gy - y * gx
    if tree[1][i] > REVOLUTE:  # the slope by the shift, along the axis
        ex, ey, ez = motion[p, 3], motion[p, 4], motion[p, 5]
        square = wx * wx + wy * wy + wz * wz
        by_amount += turn[i, 0, axis] * (gy * ez - gz * ey + wx * gw - gx * square)
        by_amount += turn[i, 1, axis] * (gz * ex - gx * ez + wy * gw - gy * square)
        by_amount += turn[i, 2, axis] * (gx * ey - gy * ex + wz * gw - gz * square)
    return by_amount


@njit(**OPTIONS)
def _uncarry(tree, i, turn, shift, twists, bars):
    """Take the slopes of body i's twists to its parent's; return the slope by the joint's own motion."""
    p, h, axis, own = tree[0][i], i + 1, tree[2][i], tree[4][i]
    one, two = (axis + 1) % 3, (axis + 2) % 3
    x, y, z = shift[i, 0], shift[i, 1], shift[i, 2]
    by_amount = 0.0
    for k in range(tree[8][p] if p >= 0 else 0):
        j = tree[7][p, k]
        if tree[1][i] == REVOLUTE:
            ua, ub = twists[h, j, one], twists[h, j, two]
            by_amount += bars[h, j, one] * ub - bars[h, j, two] * ua
            by_amount += bars[h, j, 3 + one] * twists[h, j, 3 + two] - bars[h, j, 3 + two] * twists[h, j, 3 + one]
        bx, by, bz = bars[h, j, 0], bars[h, j, 1], bars[h, j, 2]
        cx, cy, cz = bars[h, j, 3], bars[h, j, 4], bars[h, j, 5]
        sx = turn[i, 0, 0] * cx + turn[i, 0, 1] * cy + turn[i, 0, 2] * cz
        sy = turn[i, 1, 0] * cx + turn[i, 1, 1] * cy + turn[i, 1, 2] * cz
        sz = turn[i, 2, 0] * cx + turn[i, 2, 1] * cy + turn[i, 2, 2] * cz
        bars[p + 1, j, 0] += turn[i, 0, 0] * bx + turn[i, 0, 1] * by + turn[i, 0, 2] * bz + y * sz - z * sy
        bars[p + 1, j, 1] += turn[i, 1, 0] * bx + turn[i, 1, 1] * by + turn[i, 1, 2] * bz + z * sx - x * sz
        bars[p + 1, j, 2] += turn[i, 2, 0] * bx + turn[i, 2, 1] * by + turn[i, 2, 2] * bz + x * sy - y * sx
        bars[p + 1, j, 3] += sx
        bars[p + 1, j, 4] += sy
        bars[p + 1, j, 5] += sz
        if tree[1][i] > REVOLUTE:
            ux, uy, uz = twists[p + 1, j, 0], twists[p + 1, j, 1], twists[p + 1, j, 2]
            by_amount += turn[i, 0, axis] * (sy * uz - sz * uy)
            by_amount += turn[i, 1, axis] * (sz * ux - sx * uz)
            by_amount += turn[i, 2, axis] * (sx * uy - sy * ux)
    return by_amount if own >= 0 else 0.0


@njit(**OPTIONS)
def regressor_gradient(tree, amount, cosine, sine, v, a, weights, gq, gv, ga):
    """Add the slopes of Σ weights · Y(q, v, a) by q, v and a to gq, gv, ga (N, n), zero on entry; weights (N, n, 10 B).

    Reverse differentiation of `regressor`, by hand: one forward pass, one pass back, O(n B) per sample.
    """
    bodies, n = amount.shape[1], v.shape[1]
    turn, shift = np.empty((bodies, 3, 3)), np.empty((bodies, 3))
    motion, twists = np.zeros((bodies + 1, 9)), np.zeros((bodies + 1, n, 6))
    slopes, bars = np.zeros((bodies + 1, 9)), np.zeros((bodies + 1, n, 6))
    motion[0, 6:] = -tree[6]
    for sample in range(v.shape[0]):
        slopes[:] = 0.0
        bars[:] = 0.0
        for i in range(bodies):
            c = tree[4][i]
            rate = tree[3][i] * v[sample, c] if c >= 0 else 0.0
            change = tree[3][i] * a[sample, c] if c >= 0 else 0.0
            _place(tree, i, amount[sample, i], cosine[sample, i], sine[sample, i], turn, shift)
            _advance(tree, i, rate, change, turn, shift, motion)
            _carry(tree, i, turn, shift, twists)
            _share(tree, i, sample, weights, motion, twists, slopes, bars)
        for i in range(bodies - 1, -1, -1):
            c, scale = tree[4][i], tree[3][i]
            rate = scale * v[sample, c] if c >= 0 else 0.0
            by_rate, by_change = _unjoint(tree, i, rate, motion, slopes)
            by_amount = _unadvance(tree, i, rate, turn, shift, motion, slopes)
            by_amount += _uncarry(tree, i, turn, shift, twists, bars)
            if c >= 0:
                gq[sample, c] += scale * by_amount
                gv[sample, c] += scale * by_rate
                ga[sample, c] += scale * by_change


@njit(**OPTIONS)
def stop(x, width):
    """Return the states (N,) of a stop operator driven by x (N,), unstressed at first."""
    out = np.zeros(x.shape[0])
    for k in range(1, x.shape[0]):
        out[k] = min(1.0, max(-1.0, out[k - 1] + (x[k] - x[k - 1]) / width))
    return out

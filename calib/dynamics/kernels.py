"""Compiled rigid-body kernels (numba) on the arrays of `Bodies`: torques, regressor, inertia.

Notation, all in body i's own frame: w angular velocity, dw its derivative, a acceleration of the frame's origin minus
gravity, (u_j, s_j) angular and linear velocity of the frame per unit rate of coordinate j. The wrench of body i,

    f = M a + dw × h + w × (w × h),    n = J dw + w × J w + h × a,

J the inertia about the origin, h = [MX, MY, MZ] (Gautier & Khalil 1990), is linear in the parameters, and
tau_j = Σ_i (u_j · n_i + s_j · f_i): the regressor needs no backward pass. Products and sums may be fused ("contract");
nothing else of IEEE arithmetic is given up.

``links`` and ``constants`` are those of `Bodies` with B bodies and n coordinates: every frame is turned so that its
joint's axis is z, and ``parameters`` (10 B) follow `Bodies.order`. Row 0 of ``motion`` and ``twists`` is the base, row
i + 1 body i; row i of ``frames`` is its rotation (0 to 8) and origin (9 to 11) in its parent's frame.
"""

import numpy as np
from numba import njit

FIXED, REVOLUTE = 0, 1
PARENT, KIND, COORDINATE, DEPTH, PATH = 0, 1, 2, 3, 4  # columns of links
SCALE = 12  # of constants, behind the placement's three rows; its last row is gravity
L = 64  # samples side by side in the regressor: 8 to 128 measured, flat from 64 on
ROUND = 6755399441055744.0  # 1.5 · 2^52: adding and taking off rounds to the nearest whole number
OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract"}}


@njit(**OPTIONS)
def sincos(x):
    """Return sine and cosine of abs(x) < 1e6 within 2e-16: polynomials of fdlibm (Sun, 1993), no branches.

    A library call per value cannot be vectorised, and costs the regressor a third of its time.
    """
    n = (x * 0.6366197723675814 + ROUND) - ROUND
    r = ((x - n * 1.57079632673412561417) - n * 6.07710050630396597660e-11) - n * 2.02226624879595063154e-21
    z = r * r
    s = 2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
    s = -1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 + z * s))
    c = -2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 - z * 1.13596475577881948265e-11)
    c = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 + z * c))
    s, c = r + r * z * s, 1.0 - 0.5 * z + z * z * c
    quarter = n - 4.0 * ((0.25 * n + ROUND) - ROUND)  # -2 to 2
    odd = quarter * quarter == 1.0
    sine, cosine = c if odd else s, s if odd else c
    sine = -sine if quarter < 0.0 or quarter == 2.0 else sine
    cosine = -cosine if quarter > 0.0 or quarter == -2.0 else cosine
    return sine, cosine


@njit(**OPTIONS)
def place(links, constants, i, amount, cosine, sine, frames):
    """Write the frame of body i into row i of `frames`, at joint position `amount`."""
    for r in range(3):
        x, y, z, t = constants[i, 4 * r], constants[i, 4 * r + 1], constants[i, 4 * r + 2], constants[i, 4 * r + 3]
        frames[i, 3 * r], frames[i, 3 * r + 1] = x, y
        if links[i, KIND] == REVOLUTE:
            frames[i, 3 * r], frames[i, 3 * r + 1] = cosine * x + sine * y, cosine * y - sine * x
        elif links[i, KIND] != FIXED:
            t += amount * z
        frames[i, 3 * r + 2] = z
        frames[i, 9 + r] = t


@njit(**OPTIONS)
def advance(links, i, rate, change, frames, motion):
    """Write w, dw, a of body i from its parent's into row i + 1 of `motion` (B + 1, 9)."""
    p, h = links[i, PARENT] + 1, i + 1
    wx, wy, wz = motion[p, 0], motion[p, 1], motion[p, 2]
    ex, ey, ez = motion[p, 3], motion[p, 4], motion[p, 5]
    x, y, z = frames[i, 9], frames[i, 10], frames[i, 11]
    dot, square = wx * x + wy * y + wz * z, wx * wx + wy * wy + wz * wz
    ax = motion[p, 6] + ey * z - ez * y + wx * dot - x * square
    ay = motion[p, 7] + ez * x - ex * z + wy * dot - y * square
    az = motion[p, 8] + ex * y - ey * x + wz * dot - z * square
    for r in range(3):
        tx, ty, tz = frames[i, r], frames[i, 3 + r], frames[i, 6 + r]
        motion[h, r] = tx * wx + ty * wy + tz * wz
        motion[h, 3 + r] = tx * ex + ty * ey + tz * ez
        motion[h, 6 + r] = tx * ax + ty * ay + tz * az
    if links[i, KIND] == REVOLUTE:
        motion[h, 3] += motion[h, 1] * rate
        motion[h, 4] -= motion[h, 0] * rate
        motion[h, 5] += change
        motion[h, 2] += rate
    elif links[i, KIND] != FIXED:
        motion[h, 6] += 2.0 * motion[h, 1] * rate
        motion[h, 7] -= 2.0 * motion[h, 0] * rate
        motion[h, 8] += change


@njit(**OPTIONS)
def carry(links, constants, i, frames, twists):
    """Write the twists (u_j, s_j) of body i from its parent's into row i + 1 of `twists` (B + 1, n, 6)."""
    t00, t01, t02 = frames[i, 0], frames[i, 1], frames[i, 2]
    t10, t11, t12 = frames[i, 3], frames[i, 4], frames[i, 5]
    t20, t21, t22 = frames[i, 6], frames[i, 7], frames[i, 8]
    x, y, z = frames[i, 9], frames[i, 10], frames[i, 11]
    p, h, own = links[i, PARENT], i + 1, links[i, COORDINATE]
    if own >= 0:
        for r in range(6):
            twists[h, own, r] = 0.0
    for k in range(links[p, DEPTH] if p >= 0 else 0):
        j = links[p, PATH + k]
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
        twists[h, own, 2 if links[i, KIND] == REVOLUTE else 5] += constants[i, SCALE]


@njit(**OPTIONS)
def _place_lanes(constants, i, joint, turn):
    """Write rotation (rows 0 to 8) and origin (9 to 11) of body i from cosine, sine and shift in `joint`."""
    a0, a1, a2, x = constants[i, 0], constants[i, 1], constants[i, 2], constants[i, 3]
    b0, b1, b2, y = constants[i, 4], constants[i, 5], constants[i, 6], constants[i, 7]
    c0, c1, c2, z = constants[i, 8], constants[i, 9], constants[i, 10], constants[i, 11]
    for k in range(L):
        cosine, sine, shift = joint[k], joint[L + k], joint[2 * L + k]
        turn[k], turn[L + k], turn[2 * L + k] = cosine * a0 + sine * a1, cosine * a1 - sine * a0, a2
        turn[3 * L + k], turn[4 * L + k], turn[5 * L + k] = cosine * b0 + sine * b1, cosine * b1 - sine * b0, b2
        turn[6 * L + k], turn[7 * L + k], turn[8 * L + k] = cosine * c0 + sine * c1, cosine * c1 - sine * c0, c2
        turn[9 * L + k], turn[10 * L + k], turn[11 * L + k] = x + shift * a2, y + shift * b2, z + shift * c2


@njit(**OPTIONS)
def _advance_lanes(turning, joint, turn, up, here):
    """`advance` for L samples, the joint about (turning 1) or along (turning 0) z."""
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
    """`carry` of one coordinate's twist for L samples."""
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
def _load_lanes(kind, scale, amount, v, a, joint):
    """Write cosine, sine, shift, rate and change of one joint for all samples in amount, v, a (L or fewer)."""
    for k in range(amount.shape[0]):
        joint[2 * L + k] = amount[k]
        joint[3 * L + k] = scale * v[k]
        joint[4 * L + k] = scale * a[k]
    if kind == REVOLUTE:
        for k in range(L):
            joint[L + k], joint[k] = sincos(joint[2 * L + k])
            joint[2 * L + k] = 0.0
    else:
        for k in range(L):
            joint[k], joint[L + k] = 1.0, 0.0


@njit(**OPTIONS)
def regressor(links, constants, order, amount, v, a, out):
    """Fill out (10 B, n, N), initially zero, with the standard regressor.

    L samples at a time, the sample index innermost, so that the compiler turns every line into vector instructions.

    Args:
        order: (B, 10), `Bodies.order`: where the columns go.
        amount: (B, N), each body's own motion, angles below 1e6.
        v, a: (n, N).
    """
    bodies, count, n = amount.shape[0], amount.shape[1], v.shape[0]
    joint, turn, columns = np.zeros(5 * L), np.empty(12 * L), np.empty(10 * L)
    motion, twists = np.zeros((bodies + 1, 9 * L)), np.zeros((bodies + 1, n, 6 * L))
    for r in range(3):
        for lane in range((6 + r) * L, (7 + r) * L):
            motion[0, lane] = -constants[bodies, r]
    for start in range(0, count, L):
        width = min(L, count - start)
        for i in range(bodies):
            p, c, turning = links[i, PARENT], links[i, COORDINATE], 1.0 if links[i, KIND] == REVOLUTE else 0.0
            end = start + width
            _load_lanes(
                links[i, KIND], constants[i, SCALE], amount[i, start:end], v[c, start:end], a[c, start:end], joint
            )
            _place_lanes(constants, i, joint, turn)
            _advance_lanes(turning, joint, turn, motion[p + 1], motion[i + 1])
            if c >= 0:
                for lane in range(6 * L):
                    twists[i + 1, c, lane] = 0.0
            for k in range(links[p, DEPTH] if p >= 0 else 0):
                _carry_lanes(turn, twists[p + 1, links[p, PATH + k]], twists[i + 1, links[p, PATH + k]])
            if c >= 0:
                first = (2 if links[i, KIND] == REVOLUTE else 5) * L
                for lane in range(first, first + L):
                    twists[i + 1, c, lane] += constants[i, SCALE]
            for k in range(links[i, DEPTH]):
                j = links[i, PATH + k]
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
def _return(links, constants, i, frames, wrench, tau):
    """Add body i's torque to tau (n,) and its wrench to the parent's."""
    c, p = links[i, COORDINATE], links[i, PARENT]
    fx, fy, fz = wrench[i, 0], wrench[i, 1], wrench[i, 2]
    nx, ny, nz = wrench[i, 3], wrench[i, 4], wrench[i, 5]
    if c >= 0:
        tau[c] += constants[i, SCALE] * (nz if links[i, KIND] == REVOLUTE else fz)
    if p >= 0:
        gx = frames[i, 0] * fx + frames[i, 1] * fy + frames[i, 2] * fz
        gy = frames[i, 3] * fx + frames[i, 4] * fy + frames[i, 5] * fz
        gz = frames[i, 6] * fx + frames[i, 7] * fy + frames[i, 8] * fz
        x, y, z = frames[i, 9], frames[i, 10], frames[i, 11]
        wrench[p, 0] += gx
        wrench[p, 1] += gy
        wrench[p, 2] += gz
        wrench[p, 3] += frames[i, 0] * nx + frames[i, 1] * ny + frames[i, 2] * nz + y * gz - z * gy
        wrench[p, 4] += frames[i, 3] * nx + frames[i, 4] * ny + frames[i, 5] * nz + z * gx - x * gz
        wrench[p, 5] += frames[i, 6] * nx + frames[i, 7] * ny + frames[i, 8] * nz + x * gy - y * gx


@njit(**OPTIONS)
def inverse_dynamics(links, constants, parameters, amount, cosine, sine, v, a, out):
    """Fill out (N, n), initially zero, with the torques (recursive Newton-Euler; Luh, Walker, Paul 1980).

    Args:
        amount, cosine, sine: (N, B), each body's own motion.
    """
    bodies = amount.shape[1]
    frames, motion = np.empty((bodies, 12)), np.zeros((bodies + 1, 9))
    wrench, tau = np.empty((bodies, 6)), np.empty(v.shape[1])
    for r in range(3):
        motion[0, 6 + r] = -constants[bodies, r]
    for sample in range(v.shape[0]):
        for j in range(tau.shape[0]):
            tau[j] = 0.0
        for i in range(bodies):
            c, scale = links[i, COORDINATE], constants[i, SCALE]
            place(links, constants, i, amount[sample, i], cosine[sample, i], sine[sample, i], frames)
            advance(links, i, scale * v[sample, c], scale * a[sample, c], frames, motion)
            _wrench(i, parameters, motion, wrench)
        for i in range(bodies - 1, -1, -1):
            _return(links, constants, i, frames, wrench, tau)
        for j in range(tau.shape[0]):
            out[sample, j] = tau[j]


@njit(**OPTIONS)
def stop(x, width):
    """Return the states (N,) of a stop operator driven by x (N,), unstressed at first."""
    out = np.zeros(x.shape[0])
    for k in range(1, x.shape[0]):
        out[k] = min(1.0, max(-1.0, out[k - 1] + (x[k] - x[k - 1]) / width))
    return out

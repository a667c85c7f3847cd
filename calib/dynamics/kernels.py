"""Compiled rigid-body kernels (numba) on the arrays of `Bodies`: torques and regressor.

Notation, all in the frame of body i: w angular velocity, dw its derivative, a acceleration of the frame's origin minus
gravity, (u_j, s_j) angular and linear velocity of the frame per unit rate of coordinate j (its twist). The wrench of
body i,

    f = M a + dw × h + w × (w × h),    n = J dw + w × J w + h × a,

with J the inertia about the origin and h = [MX, MY, MZ] (Gautier & Khalil 1990), is linear in the parameters, and tau_j
= Σ_i (u_j · n_i + s_j · f_i); so the regressor needs no backward pass. Products and sums may be fused by the compiler
("contract"); otherwise arithmetic follows IEEE 754.

``links`` and ``constants`` are those of `Bodies` with B bodies and n coordinates: every frame is turned so that its
joint's axis is z, and ``parameters`` (10 B) follow `Bodies.order`. Row 0 of ``motion`` and ``twists`` is that of the
base, row i + 1 that of body i. Row i of ``frames`` contains rotation (0 to 8) and origin (9 to 11) of body i in its
parent's frame.
"""

import numpy as np
from numba import njit
from numba.extending import register_jitable

FIXED, REVOLUTE = 0, 1
PARENT = 0
KIND = 1
COORDINATE = 2
DEPTH = 3
PATH = 4
"""Columns of ``links``."""
SCALE = 12
"""Column of ``constants``, behind the placement's three rows; its last row is gravity."""
L = 64
"""Samples side by side in the regressor: 8 to 128 measured, flat from 64 on."""
ROUND = 6755399441055744.0
"""1.5 · 2^52: adding it and subtracting it again rounds to the nearest whole number."""
OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract"}, "no_cfunc_wrapper": True}
INNER = {**OPTIONS, "no_cpython_wrapper": True}
"""Of functions that kernels alone call: without a wrapper for Python they compile faster."""
joined = register_jitable(
    error_model="numpy", fastmath={"contract"}, forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True
)
"""Decorator of functions that are inlined into kernels. Calls with constants, as for columns, compile them once for all
constants; ``njit`` would compile them for each."""


@njit(**OPTIONS)
def sincos(x):
    """Return sine and cosine of x within 2e-16, for abs(x) < 1e6, by polynomials of fdlibm (Sun, 1993).

    There are no branches. Library functions could not be vectorised and would take a third of the regressor's time.
    """
    n = (x * 0.6366197723675814 + ROUND) - ROUND
    r = ((x - n * 1.57079632673412561417) - n * 6.07710050630396597660e-11) - n * 2.02226624879595063154e-21
    z = r * r
    s = 2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
    s = -1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 + z * s))
    c = -2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 - z * 1.13596475577881948265e-11)
    c = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 + z * c))
    s = r + r * z * s
    c = 1.0 - 0.5 * z + z * z * c
    # Quarter turns, -2 to 2.
    quarter = n - 4.0 * ((0.25 * n + ROUND) - ROUND)
    odd = quarter * quarter == 1.0
    sine = c if odd else s
    cosine = s if odd else c
    sine = -sine if quarter < 0.0 or quarter == 2.0 else sine
    cosine = -cosine if quarter > 0.0 or quarter == -2.0 else cosine
    return sine, cosine


@njit(**INNER)
def place(links, constants, i, amount, cosine, sine, frames):
    """Write rotation and origin of body i, in its parent's frame, into row i of `frames`.

    Args:
        links, constants: those of `Bodies`.
        i: index of the body.
        amount: joint position [rad or m].
        cosine, sine: cosine and sine of this position.
        frames: (B, 12) array to write: nine entries of the rotation, row by row, then the origin.
    """
    for r in range(3):
        x = constants[i, 4 * r]
        y = constants[i, 4 * r + 1]
        z = constants[i, 4 * r + 2]
        t = constants[i, 4 * r + 3]
        frames[i, 3 * r] = x
        frames[i, 3 * r + 1] = y
        if links[i, KIND] == REVOLUTE:
            frames[i, 3 * r] = cosine * x + sine * y
            frames[i, 3 * r + 1] = cosine * y - sine * x
        elif links[i, KIND] != FIXED:
            t += amount * z
        frames[i, 3 * r + 2] = z
        frames[i, 9 + r] = t


@joined
def three(x, i, k):
    """Return the vector x[i, k], x[i, k + 1], x[i, k + 2] as a tuple, which the compiler keeps in registers."""
    return x[i, k], x[i, k + 1], x[i, k + 2]


@joined
def write(x, i, k, a):
    """Write vector `a` (3,) into row i of x, from column k on."""
    x[i, k], x[i, k + 1], x[i, k + 2] = a


@joined
def increase(x, i, k, a):
    """Add vector `a` (3,) to row i of x, from column k on."""
    write(x, i, k, add(three(x, i, k), a))


@joined
def add(a, b):
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@joined
def scaled(k, a):
    """Return k · a."""
    return k * a[0], k * a[1], k * a[2]


@joined
def dot(a, b):
    """Return a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@joined
def cross(a, b):
    """Return a × b."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    z = a[0] * b[1] - a[1] * b[0]
    return x, y, z


@joined
def inertia_times(J, a):
    """Return J a, where J is the symmetric matrix with the six entries XX, XY, XZ, YY, YZ, ZZ."""
    x = dot((J[0], J[1], J[2]), a)
    y = dot((J[1], J[3], J[4]), a)
    z = dot((J[2], J[4], J[5]), a)
    return x, y, z


@joined
def turned(frames, i, a, k=0):
    """Return R a for a vector a (3,), with the rotation R stored row by row in row i of `frames`, from column k on."""
    x = dot(three(frames, i, k), a)
    y = dot(three(frames, i, k + 3), a)
    z = dot(three(frames, i, k + 6), a)
    return x, y, z


@joined
def turned_back(frames, i, a, k=0):
    """Return Rᵀ a for a vector a (3,), with the rotation R stored row by row in row i of `frames`, from column k on."""
    x = scaled(a[0], three(frames, i, k))
    y = scaled(a[1], three(frames, i, k + 3))
    z = scaled(a[2], three(frames, i, k + 6))
    return add(add(x, y), z)


@joined
def ten_columns(w, e, a, u, s):
    """Return the ten regressor columns of a body in the torque row of one coordinate.

    w, e = dw and a are the body's angular velocity, angular acceleration and acceleration minus gravity; (u, s) is the
    body's twist per unit rate of the coordinate.
    """
    c = cross(u, w)
    xx = u[0] * e[0] + c[0] * w[0]
    xy = u[0] * e[1] + c[0] * w[1]
    xz = u[0] * e[2] + c[0] * w[2]
    yx = u[1] * e[0] + c[1] * w[0]
    yy = u[1] * e[1] + c[1] * w[1]
    yz = u[1] * e[2] + c[1] * w[2]
    zx = u[2] * e[0] + c[2] * w[0]
    zy = u[2] * e[1] + c[2] * w[1]
    zz = u[2] * e[2] + c[2] * w[2]
    centripetal = cross(w, cross(w, s))
    h = add(add(cross(s, e), centripetal), cross(a, u))
    return xx, xy + yx, xz + zx, yy, yz + zy, zz, h[0], h[1], h[2], dot(s, a)


@njit(**INNER)
def advance(links, i, rate, change, frames, motion):
    """Write w, dw, a of body i, computed from its parent's, into row i + 1 of `motion` (B + 1, 9).

    Args:
        links: those of `Bodies`.
        i: index of the body.
        rate, change: joint velocity and joint acceleration.
        frames: (B, 12) rotation and origin of each body in its parent's frame, from `place`.
        motion: (B + 1, 9) angular velocity w, angular acceleration dw and acceleration a of the bodies; row 0 is the
            base.
    """
    p = links[i, PARENT] + 1
    h = i + 1
    w = three(motion, p, 0)
    e = three(motion, p, 3)
    x = three(frames, i, 9)
    tangential = cross(e, x)
    centripetal = cross(w, cross(w, x))
    a = add(add(three(motion, p, 6), tangential), centripetal)
    write(motion, h, 0, turned_back(frames, i, w))
    write(motion, h, 3, turned_back(frames, i, e))
    write(motion, h, 6, turned_back(frames, i, a))
    if links[i, KIND] == REVOLUTE:
        motion[h, 3] += motion[h, 1] * rate
        motion[h, 4] -= motion[h, 0] * rate
        motion[h, 5] += change
        motion[h, 2] += rate
    elif links[i, KIND] != FIXED:
        motion[h, 6] += 2.0 * motion[h, 1] * rate
        motion[h, 7] -= 2.0 * motion[h, 0] * rate
        motion[h, 8] += change


@njit(**INNER)
def carry(links, constants, i, frames, twists):
    """Write the twists (u_j, s_j) of body i, computed from its parent's, into row i + 1 of `twists` (B + 1, n, 6).

    Args:
        links, constants: those of `Bodies`.
        i: index of the body.
        frames: (B, 12) rotation and origin of each body in its parent's frame, from `place`.
        twists: (B + 1, n, 6) angular and linear velocity of each body per unit rate of each coordinate; row 0 is the
            base.
    """
    p = links[i, PARENT]
    coordinate = links[i, COORDINATE]
    up = twists[p + 1]
    twists_here = twists[i + 1]
    if coordinate >= 0:
        for r in range(6):
            twists_here[coordinate, r] = 0.0
    for k in range(links[p, DEPTH] if p >= 0 else 0):
        j = links[p, PATH + k]
        u = three(up, j, 0)
        write(twists_here, j, 0, turned_back(frames, i, u))
        s = add(three(up, j, 3), cross(u, three(frames, i, 9)))
        write(twists_here, j, 3, turned_back(frames, i, s))
    if coordinate >= 0:
        axis = 2 if links[i, KIND] == REVOLUTE else 5
        twists_here[coordinate, axis] += constants[i, SCALE]


@njit(**INNER)
def _place_lanes(constants, i, joint, turn):
    """Write rotation (rows 0 to 8) and origin (rows 9 to 11) of body i into `turn`, for L samples.

    Args:
        constants: those of `Bodies`.
        i: index of the body.
        joint: flat (5 L,), rows of L samples: cosine, sine and shift of the joint in rows 0 to 2.
        turn: flat (12 L,) array to write.
    """
    a0 = constants[i, 0]
    a1 = constants[i, 1]
    a2 = constants[i, 2]
    x = constants[i, 3]
    b0 = constants[i, 4]
    b1 = constants[i, 5]
    b2 = constants[i, 6]
    y = constants[i, 7]
    c0 = constants[i, 8]
    c1 = constants[i, 9]
    c2 = constants[i, 10]
    z = constants[i, 11]
    for k in range(L):
        cosine = joint[k]
        sine = joint[L + k]
        shift = joint[2 * L + k]
        turn[k] = cosine * a0 + sine * a1
        turn[L + k] = cosine * a1 - sine * a0
        turn[2 * L + k] = a2
        turn[3 * L + k] = cosine * b0 + sine * b1
        turn[4 * L + k] = cosine * b1 - sine * b0
        turn[5 * L + k] = b2
        turn[6 * L + k] = cosine * c0 + sine * c1
        turn[7 * L + k] = cosine * c1 - sine * c0
        turn[8 * L + k] = c2
        turn[9 * L + k] = x + shift * a2
        turn[10 * L + k] = y + shift * b2
        turn[11 * L + k] = z + shift * c2


@joined
def _lane(x, r, k):
    """Return the vector of sample k, stored in rows r to r + 2 of x; each row of x has L samples."""
    return x[r * L + k], x[(r + 1) * L + k], x[(r + 2) * L + k]


@joined
def _write_lane(x, r, k, a):
    x[r * L + k], x[(r + 1) * L + k], x[(r + 2) * L + k] = a


@joined
def _lane_back(turn, k, a):
    """Return Rᵀ a for sample k, with the rotation R of this sample from `turn`.

    Args:
        turn: flat (12 L,) rotations and origins of L samples, from `_place_lanes`.
        k: index of the sample.
        a: vector (3,).
    """
    x = scaled(a[0], _lane(turn, 0, k))
    y = scaled(a[1], _lane(turn, 3, k))
    z = scaled(a[2], _lane(turn, 6, k))
    return add(add(x, y), z)


@njit(**INNER)
def _advance_lanes(turning, joint, turn, up, motion_here):
    """Compute `advance` for L samples, for a joint about z (turning 1), or one along z or a fixed body (turning 0).

    Args:
        turning: 1.0 for a revolute joint, 0.0 otherwise.
        joint: flat (5 L,): cosine, sine, shift, velocity and acceleration of the joint, from `_load_lanes`.
        turn: flat (12 L,) rotation and origin of the body, from `_place_lanes`.
        up: flat (9 L,) w, dw, a of the parent.
        motion_here: flat (9 L,) array to write, those of the body.
    """
    f, g = turning, 2.0 - 2.0 * turning
    for k in range(L):
        w = _lane(up, 0, k)
        e = _lane(up, 3, k)
        x = _lane(turn, 9, k)
        rate = joint[3 * L + k]
        change = joint[4 * L + k]
        w_turned = _lane_back(turn, k, w)
        across = rate * w_turned[1], -rate * w_turned[0], change
        tangential = cross(e, x)
        centripetal = cross(w, cross(w, x))
        a = add(add(_lane(up, 6, k), tangential), centripetal)
        coriolis = (g * across[0], g * across[1], 0.5 * g * change)
        _write_lane(motion_here, 0, k, (w_turned[0], w_turned[1], w_turned[2] + f * rate))
        _write_lane(motion_here, 3, k, add(_lane_back(turn, k, e), scaled(f, across)))
        _write_lane(motion_here, 6, k, add(_lane_back(turn, k, a), coriolis))


@njit(**INNER)
def _carry_lanes(turn, up, twist_here):
    """Compute the twist of one coordinate as in `carry`, from the parent's twist `up`, for L samples.

    Args:
        turn: flat (12 L,) rotation and origin of the body, from `_place_lanes`.
        up: flat (6 L,) twist of the parent.
        twist_here: flat (6 L,) array to write, the twist of the body.
    """
    for k in range(L):
        u = _lane(up, 0, k)
        _write_lane(twist_here, 0, k, _lane_back(turn, k, u))
        s = add(_lane(up, 3, k), cross(u, _lane(turn, 9, k)))
        _write_lane(twist_here, 3, k, _lane_back(turn, k, s))


@njit(**INNER)
def _project_lanes(motion, twist, columns):
    """Write the ten regressor columns of one body in one coordinate's torque row, for L samples.

    Args:
        motion: flat (9 L,) w, dw, a of the body.
        twist: flat (6 L,) twist of the body per unit rate of the coordinate.
        columns: flat (10 L,) array to write.
    """
    for k in range(L):
        w = _lane(motion, 0, k)
        e = _lane(motion, 3, k)
        a = _lane(motion, 6, k)
        u = _lane(twist, 0, k)
        s = _lane(twist, 3, k)
        (
            columns[k],
            columns[L + k],
            columns[2 * L + k],
            columns[3 * L + k],
            columns[4 * L + k],
            columns[5 * L + k],
            columns[6 * L + k],
            columns[7 * L + k],
            columns[8 * L + k],
            columns[9 * L + k],
        ) = ten_columns(w, e, a, u, s)


@njit(**INNER)
def _load_lanes(kind, scale, amount, v, a, joint):
    """Write cosine, sine, shift, velocity and acceleration of one joint into `joint`, for up to L samples.

    Args:
        kind: kind of the joint, as in `Bodies.kinds`.
        scale: factor of the coordinate, as in `Bodies.scales`.
        amount: position of the joint in each sample [rad or m].
        v, a: velocity and acceleration of the coordinate in each sample.
        joint: flat (5 L,) array to write.
    """
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
            joint[k] = 1.0
            joint[L + k] = 0.0


@njit(**OPTIONS)
def regressor(links, constants, order, amount, v, a, out):
    """Write the standard regressor into out (10 B, n, N), which must be zero.

    L samples are processed at once with the sample index innermost, so that the compiler vectorises every line.

    Args:
        links, constants: those of `Bodies`.
        order: (B, 10) `Bodies.order`, the index in `out` of each column of a body.
        amount: (B, N) joint position that moves each body [rad or m], below 1e6.
        v, a: (n, N) joint velocities and accelerations.
        out: (10 B, n, N) the regressor.
    """
    bodies = amount.shape[0]
    count = amount.shape[1]
    n = v.shape[0]
    joint = np.zeros(5 * L)
    turn = np.empty(12 * L)
    columns = np.empty(10 * L)
    motion = np.zeros((bodies + 1, 9 * L))
    twists = np.zeros((bodies + 1, n, 6 * L))
    for r in range(3):
        for lane in range((6 + r) * L, (7 + r) * L):
            motion[0, lane] = -constants[bodies, r]
    for start in range(0, count, L):
        width = min(L, count - start)
        for i in range(bodies):
            p = links[i, PARENT]
            c = links[i, COORDINATE]
            turning = 1.0 if links[i, KIND] == REVOLUTE else 0.0
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


@njit(**INNER)
def _wrench(i, parameters, motion, wrench):
    """Write the inertial force and moment of body i about its frame's origin into row i of `wrench` (B, 6).

    Args:
        i: index of the body.
        parameters: (10 B,) standard parameters in the kernels' frames.
        motion: (B + 1, 9) w, dw, a of all bodies, from `advance`.
        wrench: (B, 6) array to write.
    """
    w = three(motion, i + 1, 0)
    e = three(motion, i + 1, 3)
    a = three(motion, i + 1, 6)
    body = parameters[10 * i : 10 * i + 10]
    h = body[6], body[7], body[8]
    centripetal = cross(w, cross(w, h))
    force = add(add(scaled(body[9], a), cross(e, h)), centripetal)
    gyroscopic = cross(w, inertia_times(body, w))
    moment = add(add(inertia_times(body, e), gyroscopic), cross(h, a))
    write(wrench, i, 0, force)
    write(wrench, i, 3, moment)


@njit(**INNER)
def _return(links, constants, i, frames, wrench, tau):
    """Add body i's joint torque to tau (n,) and its wrench to its parent's (the backward step of Newton-Euler).

    Args:
        links, constants: those of `Bodies`.
        i: index of the body.
        frames: (B, 12) rotation and origin of each body in its parent's frame, from `place`.
        wrench: (B, 6) force and moment about each body's origin; the parent's row is increased.
        tau: (n,) joint torques [N m or N].
    """
    c = links[i, COORDINATE]
    p = links[i, PARENT]
    if c >= 0:
        axis = 5 if links[i, KIND] == REVOLUTE else 2
        tau[c] += constants[i, SCALE] * wrench[i, axis]
    if p >= 0:
        force = turned(frames, i, three(wrench, i, 0))
        increase(wrench, p, 0, force)
        moment = turned(frames, i, three(wrench, i, 3))
        lever = three(frames, i, 9)
        increase(wrench, p, 3, add(moment, cross(lever, force)))


@njit(**OPTIONS)
def inverse_dynamics(links, constants, parameters, amount, cosine, sine, v, a, out):
    """Write the joint torques into out (N, n), which must be zero (recursive Newton-Euler; Luh, Walker, Paul 1980).

    Args:
        links, constants: those of `Bodies`.
        parameters: (10 B,) standard parameters in the kernels' frames.
        amount, cosine, sine: (N, B) joint position that moves each body [rad or m], its cosine and sine.
        v, a: (N, n) joint velocities and accelerations.
        out: (N, n) the torques.
    """
    bodies = amount.shape[1]
    frames = np.empty((bodies, 12))
    motion = np.zeros((bodies + 1, 9))
    wrench = np.empty((bodies, 6))
    tau = np.empty(v.shape[1])
    for r in range(3):
        motion[0, 6 + r] = -constants[bodies, r]
    for sample in range(v.shape[0]):
        for j in range(tau.shape[0]):
            tau[j] = 0.0
        for i in range(bodies):
            c = links[i, COORDINATE]
            scale = constants[i, SCALE]
            place(links, constants, i, amount[sample, i], cosine[sample, i], sine[sample, i], frames)
            advance(links, i, scale * v[sample, c], scale * a[sample, c], frames, motion)
            _wrench(i, parameters, motion, wrench)
        for i in range(bodies - 1, -1, -1):
            _return(links, constants, i, frames, wrench, tau)
        for j in range(tau.shape[0]):
            out[sample, j] = tau[j]


@njit(**INNER)
def _wrench_lanes(parameters, motion, wrench):
    """Compute `_wrench` for L samples of one body.

    Args:
        parameters: (10,) standard parameters of the body in the kernels' frames.
        motion: flat (9 L,) w, dw, a of the body.
        wrench: flat (6 L,) array to write, force and moment about the origin of the body's frame.
    """
    h = parameters[6], parameters[7], parameters[8]
    for k in range(L):
        w = _lane(motion, 0, k)
        e = _lane(motion, 3, k)
        a = _lane(motion, 6, k)
        centripetal = cross(w, cross(w, h))
        force = add(add(scaled(parameters[9], a), cross(e, h)), centripetal)
        gyroscopic = cross(w, inertia_times(parameters, w))
        moment = add(add(inertia_times(parameters, e), gyroscopic), cross(h, a))
        _write_lane(wrench, 0, k, force)
        _write_lane(wrench, 3, k, moment)


@njit(**INNER)
def _return_lanes(turn, wrench, up):
    """Add a body's wrench to that of its parent, for L samples.

    Args:
        turn: flat (12 L,) rotation and origin of the body, from `_place_lanes`.
        wrench: flat (6 L,) force and moment of the body.
        up: flat (6 L,) those of its parent, which are increased.
    """
    for k in range(L):
        f = _lane(wrench, 0, k)
        n = _lane(wrench, 3, k)
        force = dot(_lane(turn, 0, k), f), dot(_lane(turn, 3, k), f), dot(_lane(turn, 6, k), f)
        moment = dot(_lane(turn, 0, k), n), dot(_lane(turn, 3, k), n), dot(_lane(turn, 6, k), n)
        lever = _lane(turn, 9, k)
        _write_lane(up, 0, k, add(_lane(up, 0, k), force))
        _write_lane(up, 3, k, add(_lane(up, 3, k), add(moment, cross(lever, force))))


@njit(**OPTIONS)
def products(links, constants, parameters, amount, v, a, weights, torque, pull):
    """Add the products of the regressor Y with parameters and with weights, Y χ and Yᵀ w, without forming Y.

    Column c of body i in the torque row of coordinate j is linear in the twist of i per unit rate of j. So Yᵀ w is the
    ten columns of each body for its twist at the rates w, and Y χ is recursive Newton-Euler.

    Args:
        links, constants: those of `Bodies`.
        parameters: (10 B,) standard parameters χ in the kernels' frames.
        amount: (B, N) joint position that moves each body [rad or m], below 1e6.
        v, a: (n, N) joint velocities and accelerations.
        weights: (n, N) weights w of the torques; (0, N): Y χ alone is computed.
        torque: (n, N) the torques Y χ, increased.
        pull: (B, 10 L) increased; the sum of the L numbers of a body's column, in the kernels' frames, is that of Yᵀ w.
    """
    bodies = amount.shape[0]
    count = amount.shape[1]
    weighted = weights.shape[0] > 0
    joint = np.zeros(5 * L)
    columns = np.empty(10 * L)
    turns = np.empty((bodies, 12 * L))
    wrenches = np.zeros((bodies + 1, 6 * L))
    motion = np.zeros((bodies + 1, 9 * L))
    twists = np.zeros((bodies + 1, 6 * L))
    for r in range(3):
        for lane in range((6 + r) * L, (7 + r) * L):
            motion[0, lane] = -constants[bodies, r]
    for start in range(0, count, L):
        width = min(L, count - start)
        end = start + width
        for i in range(bodies):
            p = links[i, PARENT]
            c = links[i, COORDINATE]
            turning = 1.0 if links[i, KIND] == REVOLUTE else 0.0
            _load_lanes(
                links[i, KIND], constants[i, SCALE], amount[i, start:end], v[c, start:end], a[c, start:end], joint
            )
            _place_lanes(constants, i, joint, turns[i])
            _advance_lanes(turning, joint, turns[i], motion[p + 1], motion[i + 1])
            if weighted:
                _carry_lanes(turns[i], twists[p + 1], twists[i + 1])
                if c >= 0:
                    axis = (2 if links[i, KIND] == REVOLUTE else 5) * L
                    for lane in range(width):
                        twists[i + 1, axis + lane] += constants[i, SCALE] * weights[c, start + lane]
                _project_lanes(motion[i + 1], twists[i + 1], columns)
                for k in range(10):
                    for lane in range(k * L, k * L + width):
                        pull[i, lane] += columns[lane]
            _wrench_lanes(parameters[10 * i : 10 * i + 10], motion[i + 1], wrenches[i + 1])
        for i in range(bodies - 1, -1, -1):
            c = links[i, COORDINATE]
            if c >= 0:
                axis = (5 if links[i, KIND] == REVOLUTE else 2) * L
                for lane in range(width):
                    torque[c, start + lane] += constants[i, SCALE] * wrenches[i + 1, axis + lane]
            _return_lanes(turns[i], wrenches[i + 1], wrenches[links[i, PARENT] + 1])


@njit(**OPTIONS)
def stop(x, width):
    """Return the states (N,) within ±1 of a stop operator of half-width `width` driven by positions x (N,).

    The first state is 0. The state follows x / width and saturates at ±1 (hysteresis of friction).

    Args:
        x: (N,) positions in order of time.
        width: travel over which the state changes by 1.
    """
    out = np.zeros(x.shape[0])
    for k in range(1, x.shape[0]):
        free = out[k - 1] + (x[k] - x[k - 1]) / width
        out[k] = min(1.0, max(-1.0, free))
    return out

"""Compiled closed loop (numba): a tree of rigid bodies with drives under a sampled controller, integrated by RK4.

Forward dynamics are computed in the base frame, about its origin: velocities, forces and composite inertias then add up
along the tree without transformations, in half the operations of body-fixed recursions (`calib.dynamics.kernels`; tests
compare both). With S_i = [u_i; s_i] the twist of body i per unit rate of its joint,

    V_i = V_p + S_i v,   A_i = A_p + V_i × S_i v,   f_i = I_i A_i + V_i ×* I_i V_i,
    bias_c = Σ S_i · Σ_below f,   M_cd = Σ S_j · (Σ_below I) S_i      (Walker & Orin 1982; Featherstone 2008).

There are few arrays with many columns, and functions are inlined into their callers, because numba's reference counting
of arrays passed between functions would take half of the time. For B bodies, n joints and T nonlinear friction terms
("acts"):

    tree    (B, 3) integers: parent (B for the base), kind, coordinate
    body    (B + 1, 23): placement (rotation by rows, origin) with each joint about or along z, ten standard parameters
            in such a frame, scale; row B, columns 0 to 2: minus the gravity vector
    linear  (n, 2 n + 1): added inertia (n columns), viscous friction (n), offset
    kinds   (T, 2): torque row and shape code of each act
    acts    (T, 8 + n + k): parameter value, up to seven settings, weights of the joints' motions, knots of tables
    memory  (T, 2), for friction with hysteresis: state of the stop operator, and the position at which it had
            this state
    loads   (n,) torques that the gears transmitted at the last call, for load-dependent friction
    work    (B + 1, 46), first columns: pose 0, velocity 12, acceleration 18, twist 24, force 30, inertia about
            the origin 36
"""

from math import cos, sin, sqrt

import numpy as np
from numba import njit

from calib.dynamics.kernels import INNER, OPTIONS, add, cross, dot, inertia_times, joined, scaled, three, turned, write
from calib.dynamics.shape_kernels import LOAD, LOAD_VELOCITY, PRESLIDING, SIGN, STOP, shape, smooth_sign, steepest

FIXED, REVOLUTE, PRISMATIC = 0, 1, 2
MAX_STEPS = 64  # steps that friction may ask for in one period
MIDPOINT_STEP = 1.5  # reciprocals of friction's fastest decay in a step of the midpoint rule, which is stable up to 2
STIFF_REACH = 6.0  # smoothing widths from standstill within which the sign counts as stiff: at most 6 v0
FINE, SINGULAR, STIFF, DIVERGED = -1, 1, 2, 3


@joined
def twist_cross(w, v, u, s):
    """Return the cross product of two twists, (w, v) × (u, s), as its angular and linear parts.

    The first vector of a twist is its angular, the second its linear velocity.
    """
    return cross(w, u), add(cross(w, s), cross(v, u))


@joined
def inertia_of(work, i):
    """Return the composite inertia of body i and all bodies behind it.

    It is a tuple of the moments of inertia about the base's origin (6), first moments (3), and mass.

    Args:
        work: working array of the bodies, described in the module's docstring.
        i: index of the body.
    """
    J = work[i, 36], work[i, 37], work[i, 38], work[i, 39], work[i, 40], work[i, 41]
    return J, three(work, i, 42), work[i, 45]


@joined
def momentum(inertia, w, v):
    """Return the angular and linear momentum of a body with `inertia` and twist (w, v).

    Args:
        inertia: moments of inertia (6), first moments (3), and mass, as `inertia_of` returns them.
        w, v: angular and linear velocity (3,).
    """
    J, h, mass = inertia
    return add(inertia_times(J, w), cross(h, v)), add(scaled(mass, v), cross(w, h))


@joined
def wrench(inertia, w, v, e, a):
    """Return moment and force I A + V ×* I V of a body with V = (w, v), A = (e, a), and its linear momentum.

    Args:
        inertia: moments of inertia (6), first moments (3), and mass, as `inertia_of` returns them.
        w, v: angular and linear velocity (3,).
        e, a: angular and linear acceleration (3,).
    """
    angular, linear = momentum(inertia, w, v)
    n, f = momentum(inertia, e, a)
    return add(add(n, cross(w, angular)), cross(v, linear)), add(f, cross(w, linear)), linear


@joined
def _body(tree, body, i, amount, rate, work):
    """Write pose, velocity, twist and acceleration of body i into `work`, computed from its parent's.

    The joint acceleration is taken as zero.

    Args:
        tree, body, work: arrays of the robot, described in the module's docstring.
        i: index of the body.
        amount, rate: joint position and velocity.
    """
    p, kind, scale = tree[i, 0], tree[i, 1], body[i, 22]
    x, y, z, place = three(body, i, 0), three(body, i, 3), three(body, i, 6), three(body, i, 9)
    if kind == REVOLUTE:
        co, si = cos(amount), sin(amount)
        x = co * x[0] + si * x[1], co * x[1] - si * x[0], x[2]
        y = co * y[0] + si * y[1], co * y[1] - si * y[0], y[2]
        z = co * z[0] + si * z[1], co * z[1] - si * z[0], z[2]
    elif kind == PRISMATIC:
        place = add(place, scaled(amount, (x[2], y[2], z[2])))
    for r in range(0, 9, 3):
        up = three(work, p, r)
        write(work, i, r, add(add(scaled(up[0], x), scaled(up[1], y)), scaled(up[2], z)))
    place = add(three(work, p, 9), turned(work, p, place))
    axis, w, v = scaled(scale, (work[i, 2], work[i, 5], work[i, 8])), three(work, p, 12), three(work, p, 15)
    u, s = (axis, cross(place, axis)) if kind != PRISMATIC else ((0.0, 0.0, 0.0), axis)
    bent, moved = twist_cross(w, v, u, s)
    write(work, i, 9, place)
    write(work, i, 12, add(w, scaled(rate, u)))
    write(work, i, 15, add(v, scaled(rate, s)))
    write(work, i, 18, add(three(work, p, 18), scaled(rate, bent)))
    write(work, i, 21, add(three(work, p, 21), scaled(rate, moved)))
    write(work, i, 24, u)
    write(work, i, 27, s)


@joined
def _load(body, i, work):
    """Write the inertia of body i about the base's origin, and the wrench of its motion, into `work`.

    Args:
        body, work: arrays of the robot, described in the module's docstring.
        i: index of the body.
    """
    x, y, z, t = three(work, i, 0), three(work, i, 3), three(work, i, 6), three(work, i, 9)
    own, mass = (body[i, 12], body[i, 13], body[i, 14], body[i, 15], body[i, 16], body[i, 17]), body[i, 21]
    g, a, b = turned(work, i, three(body, i, 18)), inertia_times(own, x), inertia_times(own, y)
    # J about the base's origin = R J Rᵀ + (2 t·g + m t·t) 1 - (g tᵀ + t gᵀ) - m t tᵀ, h = g + m t, with h and g it is
    # R J Rᵀ + t·(g + h) 1 - (g tᵀ + t hᵀ), symmetric because h - g is along t
    h = add(g, scaled(mass, t))
    px, py, pz = t[0] * (g[0] + h[0]), t[1] * (g[1] + h[1]), t[2] * (g[2] + h[2])
    jxx, jyy, jzz = dot(x, a) + py + pz, dot(y, b) + px + pz, dot(z, inertia_times(own, z)) + px + py
    jxy, jxz = dot(y, a) - g[0] * t[1] - t[0] * h[1], dot(z, a) - g[0] * t[2] - t[0] * h[2]
    jyz = dot(z, b) - g[1] * t[2] - t[1] * h[2]
    moment, force, _ = wrench(
        ((jxx, jxy, jxz, jyy, jyz, jzz), h, mass),
        three(work, i, 12),
        three(work, i, 15),
        three(work, i, 18),
        three(work, i, 21),
    )
    write(work, i, 30, moment)
    write(work, i, 33, force)
    write(work, i, 36, (jxx, jxy, jxz))
    write(work, i, 39, (jyy, jyz, jzz))
    write(work, i, 42, h)
    work[i, 45] = mass


@joined
def dynamics(tree, body, linear, q, v, work, matrix, out):
    """Write M(q) plus added inertia into `matrix` (lower triangle), and subtract c(q, v) + g(q) from `out` (n,).

    Args:
        tree, body, linear, work: arrays of the robot, described in the module's docstring; `linear` has the added
            inertia.
        q, v: (n,) joint positions and velocities.
        matrix: (n, n) array to write.
        out: (n,) array from which Coriolis, centrifugal and gravity torques are subtracted.
    """
    count, n = tree.shape[0], q.shape[0]
    for j in range(n):
        for k in range(j + 1):
            matrix[j, k] = linear[j, k]
    for r in range(24):
        work[count, r] = 1.0 if r == 0 or r == 4 or r == 8 else 0.0
    work[count, 21], work[count, 22], work[count, 23] = body[count, 0], body[count, 1], body[count, 2]
    for i in range(count):
        c = tree[i, 2]
        amount, rate = (body[i, 22] * q[c], v[c]) if c >= 0 else (0.0, 0.0)
        _body(tree, body, i, amount, rate, work)
        _load(body, i, work)
    for i in range(count - 1, -1, -1):
        p, c = tree[i, 0], tree[i, 2]
        if c >= 0:
            u, s = three(work, i, 24), three(work, i, 27)
            out[c] -= dot(u, three(work, i, 30)) + dot(s, three(work, i, 33))
            n, f = momentum(inertia_of(work, i), u, s)
            matrix[c, c] += dot(n, u) + dot(f, s)
            k = p
            while k < count:
                d = tree[k, 2]
                if d >= 0:
                    share = dot(n, three(work, k, 24)) + dot(f, three(work, k, 27))
                    if d == c:  # a follower and its leader
                        matrix[c, c] += 2.0 * share
                    else:
                        matrix[max(c, d), min(c, d)] += share
                k = tree[k, 0]
        if p < count:
            for r in range(30, 46):
                work[p, r] += work[i, r]


@joined
def factorise(matrix):
    """Overwrite a matrix M by its factors M = L D Lᵀ: L below the diagonal, 1 / D on it.

    Return False if M is not positive definite. Only the lower triangle of M is used.
    """
    for i in range(matrix.shape[0]):
        for j in range(i):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total
        pivot = matrix[i, i]
        for j in range(i):
            low = matrix[i, j] * matrix[j, j]
            pivot -= matrix[i, j] * low
            matrix[i, j] = low
        if not pivot > 0.0:
            return False
        matrix[i, i] = 1.0 / pivot
    return True


@joined
def substitute(matrix, vector):
    """Overwrite `vector` (n,) by M⁻¹ vector, where `matrix` contains the factors of M (`factorise`)."""
    n = vector.shape[0]
    for i in range(n):
        total = vector[i]
        for j in range(i):
            total -= matrix[i, j] * vector[j]
        vector[i] = total
    for i in range(n - 1, -1, -1):
        total = vector[i] * matrix[i, i]
        for j in range(i + 1, n):
            total -= matrix[j, i] * vector[j]
        vector[i] = total


@joined
def seen(acts, t, motion):
    """Return the sum of a motion (n,) over the joints, weighted as friction term t requires.

    Args:
        acts: array of friction terms, described in the module's docstring.
        t: row of the term.
        motion: (n,) positions or velocities of the joints.
    """
    total = 0.0
    for k in range(motion.shape[0]):
        total += acts[t, 8 + k] * motion[k]
    return total


@joined
def _stop(memory, t, place, width):
    """Return the state of friction term t's stop operator at a position, from state and position in `memory`.

    Args:
        memory: (T, 2) states and positions, described in the module's docstring.
        t: row of the term.
        place: present position, weighted over the joints as the term requires.
        width: travel over which the state changes by 1.
    """
    return min(1.0, max(-1.0, memory[t, 0] + (place - memory[t, 1]) / width))


@joined
def act(code, acts, t, memory, q, v):
    """Return friction term t's torque per unit parameter, and its derivatives with respect to position and velocity.

    The factor of load-dependent terms (the load) is not included. The values are those of
    `calib.dynamics.shape_kernels.shape`.

    Args:
        code: code of the term's shape.
        acts, memory: arrays of friction terms, described in the module's docstring.
        t: row of the term.
        q, v: (n,) joint positions and velocities.
    """
    place = seen(acts, t, q)
    state = _stop(memory, t, place, acts[t, 1]) if code in (STOP, PRESLIDING) else 0.0
    return shape(code, acts, t, place, seen(acts, t, v), state)


@joined
def _friction(linear, kinds, acts, memory, q, v, out):
    """Subtract friction and offsets, without load-dependent terms, from `out` (n,).

    Return whether there are load-dependent terms.

    Args:
        linear, kinds, acts, memory: arrays of drives and friction, described in the module's docstring.
        q, v: (n,) joint positions and velocities.
        out: (n,) torques.
    """
    n, loaded = v.shape[0], False
    for j in range(n):
        total = linear[j, 2 * n]
        for k in range(n):
            total += linear[j, n + k] * v[k]
        out[j] -= total
    for t in range(kinds.shape[0]):
        code = kinds[t, 1]
        if code in (LOAD, LOAD_VELOCITY):
            loaded = True
        elif code == SIGN:
            out[kinds[t, 0]] -= acts[t, 0] * smooth_sign(seen(acts, t, v), acts[t, 1])
        else:
            out[kinds[t, 0]] -= acts[t, 0] * act(code, acts, t, memory, q, v)[0]
    return loaded


@njit(**INNER)
def _under_load(linear, kinds, acts, memory, q, v, tau, matrix, loads, out):
    """Replace the accelerations `out` (n,) by those with load-dependent friction.

    The load is the torque after friction minus added inertia times acceleration; friction depends on the load. Both are
    iterated until they agree, which they do if the friction coefficients are below one. Return False if the iteration
    does not converge.

    Args:
        linear, kinds, acts, memory: arrays of drives and friction, described in the module's docstring.
        q, v, tau: (n,) joint positions, velocities and drive torques.
        matrix: factors of M.
        loads: (n,) transmitted torques, from which the iteration starts and to which its result is written.
        out: (n,) accelerations without load-dependent friction.
    """
    n = out.shape[0]
    plain, extra, change = out.copy(), np.zeros(n), np.empty(n)
    left = tau.copy()
    _friction(linear, kinds, acts, memory, q, v, left)
    size, moved = 0.0, 0.0
    for _ in range(200):
        size, moved = 0.0, 0.0
        for j in range(n):
            load = left[j] - extra[j]
            for k in range(n):
                load -= linear[j, k] * out[k]
            size, moved = max(size, abs(load)), max(moved, abs(load - loads[j]))
            loads[j] = load
        if moved <= 1e-13 * size:
            return True
        for j in range(n):
            extra[j] = 0.0
        for t in range(kinds.shape[0]):
            if kinds[t, 1] == LOAD or kinds[t, 1] == LOAD_VELOCITY:
                size = abs(seen(acts, t, loads))
                extra[kinds[t, 0]] += acts[t, 0] * size * act(kinds[t, 1], acts, t, memory, q, v)[0]
        for j in range(n):
            change[j] = -extra[j]
        substitute(matrix, change)
        for j in range(n):
            out[j] = plain[j] + change[j]
    return moved <= 1e-6 * size


@njit(**INNER)
def stiffness(kinds, acts, loads, v, matrix, unit):
    """Return an upper bound [1/s] of the fastest decay rate that friction causes near standstill.

    The bound is the trace of M⁻¹ D, which is never below the largest eigenvalue. D contains the steepest slopes of all
    smoothed signs whose steep range is near the current speed, not the local slopes, since a step into this range must
    not overshoot. The stiffness of friction with hysteresis counts by four times its natural frequency, so that no step
    is longer than half a radian of this oscillation.

    Args:
        kinds, acts: arrays of friction terms, described in the module's docstring.
        loads: (n,) transmitted torques.
        v: (n,) joint velocities.
        matrix: factors of the inertia matrix M.
        unit: (n,) working memory.
    """
    total, springs, n = 0.0, 0.0, unit.shape[0]
    for t in range(kinds.shape[0]):
        slope, middle, width, spring = steepest(kinds[t, 1], acts, t)
        slope, spring = acts[t, 0] * slope, acts[t, 0] * spring
        if kinds[t, 1] == LOAD:
            slope *= abs(seen(acts, t, loads))
        if abs(abs(seen(acts, t, v)) - middle) > STIFF_REACH * width:
            slope = 0.0
        if slope == 0.0 and spring == 0.0:
            continue
        for j in range(n):
            unit[j] = 0.0
        unit[kinds[t, 0]] = 1.0
        substitute(matrix, unit)
        for k in range(n):
            total += abs(slope * acts[t, 8 + k] * unit[k])
            springs += abs(spring * acts[t, 8 + k] * unit[k])
    return total + 4.0 * sqrt(springs)


@njit(**INNER)
def accelerate(tree, body, linear, kinds, acts, memory, loads, q, v, tau, work, matrix, out):
    """Write the joint accelerations under drive torques tau (n,) into `out`, and factorise M into `matrix`.

    Return False if M is not positive definite, or load-dependent friction does not converge.

    Args:
        tree, body, linear, kinds, acts, memory, loads, work: arrays of the robot, described in the module's docstring.
        q, v, tau: (n,) joint positions, velocities and drive torques.
        matrix: (n, n) array to write.
        out: (n,) array to write.
    """
    for j in range(q.shape[0]):
        out[j] = tau[j]
    dynamics(tree, body, linear, q, v, work, matrix, out)
    loaded = _friction(linear, kinds, acts, memory, q, v, out)
    if not factorise(matrix):
        return False
    substitute(matrix, out)
    if loaded:
        return _under_load(linear, kinds, acts, memory, q, v, tau, matrix, loads, out)
    return True


@njit(**INNER)
def _unstressed(kinds, acts, q, memory):
    """Reset the states of friction with hysteresis to zero at positions q (n,).

    Args:
        kinds, acts, memory: arrays of friction terms, described in the module's docstring.
        q: (n,) joint positions.
    """
    for t in range(kinds.shape[0]):
        memory[t, 0], memory[t, 1] = 0.0, seen(acts, t, q)


@joined
def _remember(kinds, acts, q, memory):
    """Update the states of friction with hysteresis to positions q (n,).

    Args:
        kinds, acts, memory: arrays of friction terms, described in the module's docstring.
        q: (n,) joint positions.
    """
    for t in range(kinds.shape[0]):
        if kinds[t, 1] == STOP or kinds[t, 1] == PRESLIDING:
            place = seen(acts, t, q)
            memory[t, 0], memory[t, 1] = _stop(memory, t, place, acts[t, 1]), place


@njit(**INNER)
def set_parameters(values, order, entries, shares, owners, body, linear, acts):
    """Write parameters (p,) into the arrays body, linear and acts; their other entries do not change.

    Args:
        values: (p,) standard parameters of the bodies, then parameters of the drive terms.
        order: (B, 10) index in `values` of each standard parameter of a body, relative to the body's first one.
        entries: (E, 3) row and column of `linear`, and index of the parameter.
        shares: (E,) weights of these entries.
        owners: (T,) index of the parameter of each friction term.
        body, linear, acts: arrays of the robot, described in the module's docstring.
    """
    for i in range(order.shape[0]):
        for k in range(10):
            body[i, 12 + k] = values[10 * i + order[i, k]]
    linear[:] = 0.0
    for e in range(entries.shape[0]):
        linear[entries[e, 0], entries[e, 1]] += shares[e] * values[entries[e, 2]]
    for t in range(owners.shape[0]):
        acts[t, 0] = values[owners[t]]


@njit(**OPTIONS)
def forward_dynamics(tree, body, linear, kinds, acts, order, entries, shares, owners, values, q, v, tau, out):
    """Write accelerations to `out` (N, n); return the first sample whose accelerations cannot be computed, or -1.

    Args:
        tree, body, linear, kinds, acts: arrays of the robot, described in the module's docstring.
        order, entries, shares, owners: index arrays of `set_parameters`.
        values: (N, p) parameters of each sample; of shape (0, p) if the parameters in body, linear and acts are used.
        q, v, tau: (N, n) joint positions, velocities and drive torques.
        out: (N, n) array to write.
    """
    n, count = q.shape[1], kinds.shape[0]
    work, matrix = np.empty((tree.shape[0] + 1, 46)), np.empty((n, n))
    memory, loads = np.zeros((count, 2)), np.zeros(n)
    for sample in range(q.shape[0]):
        if values.shape[0]:
            set_parameters(values[sample], order, entries, shares, owners, body, linear, acts)
        args = (memory, loads, q[sample], v[sample], tau[sample], work, matrix, out[sample])
        if not accelerate(tree, body, linear, kinds, acts, *args):
            return sample
    return FINE


@njit(**INNER)
def _advance(tree, body, linear, kinds, acts, memory, loads, q, v, tau, period, slopes, work, matrix, at, rate):
    """Advance q, v (n,) by one control period under constant torques (classical Runge-Kutta); return a status.

    The number of steps follows from the stiffness of friction near standstill. On the negative real axis the method's
    stability function 1 + z + z²/2 + z³/6 + z⁴/24 is positive wherever it is stable: the velocity decays into the range
    of the smoothed sign without changing its sign from step to step (chatter). Here abs(z) <= 2.

    Args:
        tree, body, linear, kinds, acts, memory, loads, work: arrays of the robot, described in the module's docstring.
        q, v: (n,) state, overwritten.
        tau: (n,) drive torques.
        period: duration [s].
        slopes: (4, n) accelerations; row 0 must contain those at the start.
        matrix: (n, n) working memory, with the factors of M at the start.
        at, rate: (n,) working memory.
    """
    n = q.shape[0]
    pieces = int(0.5 * period * stiffness(kinds, acts, loads, v, matrix, at)) + 1
    if pieces > MAX_STEPS:
        return STIFF
    span = period / pieces
    for piece in range(pieces):
        for stage in range(4):
            if stage == 0:
                if piece == 0:
                    continue
                for j in range(n):
                    at[j], rate[j] = q[j], v[j]
            else:
                part, half = (span, 0.5 * span) if stage == 3 else (0.5 * span, 0.5 * span)
                for j in range(n):
                    before = slopes[stage - 2, j] if stage > 1 else 0.0
                    at[j] = q[j] + part * (v[j] + half * before)
                    rate[j] = v[j] + part * slopes[stage - 1, j]
            state = (at, rate, tau, work, matrix, slopes[stage])
            if not accelerate(tree, body, linear, kinds, acts, memory, loads, *state):
                return SINGULAR
        for j in range(n):
            first, inner, last = slopes[0, j], slopes[1, j] + slopes[2, j], slopes[3, j]
            q[j] += span * (v[j] + span / 6.0 * (first + inner))
            v[j] += span / 6.0 * (first + 2.0 * inner + last)
        _remember(kinds, acts, q, memory)
    return FINE


@njit(**INNER)
def _advance_midpoint(
    tree, body, linear, kinds, acts, memory, loads, q, v, tau, period, slopes, work, matrix, at, rate
):
    """Advance q, v (n,) by one short period with the midpoint rule, at half the cost of `_advance`; return a status.

    A step is at most `MIDPOINT_STEP` over friction's fastest decay rate. The rule's stability function 1 + z + z²/2 has
    no zero, so that the velocity does not change its sign; at the longest step it is 0.625.

    Args:
        tree, body, linear, kinds, acts, memory, loads, work: arrays of the robot, described in the module's docstring.
        q, v: (n,) state, overwritten.
        tau: (n,) drive torques.
        period: duration [s].
        slopes, matrix, at, rate: as in `_advance`.
    """
    n = q.shape[0]
    pieces = int(period * stiffness(kinds, acts, loads, v, matrix, at) / MIDPOINT_STEP) + 1
    if pieces > 2 * MAX_STEPS:
        return STIFF
    span = period / pieces
    plant = (tree, body, linear, kinds, acts, memory, loads)
    for piece in range(pieces):
        if piece > 0 and not accelerate(*plant, q, v, tau, work, matrix, slopes[0]):
            return SINGULAR
        for j in range(n):
            at[j], rate[j] = q[j] + 0.5 * span * v[j], v[j] + 0.5 * span * slopes[0, j]
        if not accelerate(*plant, at, rate, tau, work, matrix, slopes[1]):
            return SINGULAR
        for j in range(n):
            q[j] += span * rate[j]
            v[j] += span * slopes[1, j]
        _remember(kinds, acts, q, memory)
    return FINE


@njit(**OPTIONS)
def advance_points(tree, body, linear, kinds, acts, order, entries, shares, owners, values, q, v, tau, period, gain):
    """Advance K states q, v (K, n), each with its own parameters (K, p), by a period under the same torque (n,).

    Return a status and the index of the last state reached.

    Args:
        tree, body, linear, kinds, acts: arrays of the robot, described in the module's docstring.
        order, entries, shares, owners: index arrays of `set_parameters`.
        values: (K, p) parameters of each state.
        q, v: (K, n) states, overwritten.
        tau: (n,) drive torques, held for the period.
        period: duration [s].
        gain: (n, n) array to which M⁻¹ of the first state is written.
    """
    n, count = q.shape[1], kinds.shape[0]
    work, matrix, slopes = np.empty((tree.shape[0] + 1, 46)), np.empty((n, n)), np.empty((4, n))
    memory, loads, at, rate = np.zeros((count, 2)), np.zeros(n), np.empty(n), np.empty(n)
    plant = (tree, body, linear, kinds, acts, memory, loads)
    for k in range(q.shape[0]):
        set_parameters(values[k], order, entries, shares, owners, body, linear, acts)
        _unstressed(kinds, acts, q[k], memory)
        if not accelerate(*plant, q[k], v[k], tau, work, matrix, slopes[0]):
            return SINGULAR, k
        if k == 0:
            for i in range(n):
                for j in range(n):
                    at[j] = 1.0 if i == j else 0.0
                substitute(matrix, at)
                for j in range(n):
                    gain[j, i] = at[j]
        status = _advance_midpoint(*plant, q[k], v[k], tau, period, slopes, work, matrix, at, rate)
        if status != FINE:
            return status, k
        for j in range(n):
            if not abs(v[k, j]) < 1e6:
                return DIVERGED, k
    return FINE, q.shape[0]


@njit(**INNER)
def command(gains, aim, speed, seen, rate, integral, period, wish):
    """Write the controller's feedback command (n,) into `wish`, from reference and measurement.

    Args:
        gains: (6, n) controller values, as in `closed_loop`.
        aim, speed: (n,) reference position and velocity.
        seen, rate: (n,) measured position and velocity.
        integral: (n,) integral of the position error, updated.
        period: control period [s].
        wish: (n,) array to write.
    """
    for j in range(wish.shape[0]):
        error = aim[j] - seen[j]
        integral[j] = min(max(integral[j] + period * error, -gains[5, j]), gains[5, j])
        wish[j] = gains[0, j] * error + gains[1, j] * (gains[3, j] * speed[j] - rate[j]) + gains[2, j] * integral[j]


@njit(**INNER)
def linearise_command(tree, model, linear, ahead, seen, rate, work, matrix, wish):
    """Replace the commanded acceleration a = `wish` (n,) by the model's torque M(q) (a + ahead) + c(q, v) + g(q).

    Args:
        tree, linear, work: arrays of the robot, described in the module's docstring.
        model: array `body` of the controller's model.
        ahead: (n,) feedforward acceleration.
        seen, rate: (n,) measured position and velocity, q and v of the model.
        matrix: (n, n) working memory.
        wish: (n,) command, overwritten.
    """
    n = wish.shape[0]
    wanted = wish + ahead
    for j in range(n):
        wish[j] = 0.0
    dynamics(tree, model, linear, seen, rate, work, matrix, wish)
    for j in range(n):
        total = -wish[j]
        for k in range(n):
            total += matrix[max(j, k), min(j, k)] * wanted[k]
        wish[j] = total


@joined
def _reading(place, encoder, quantum, k, j):
    """Return the encoder reading of joint j in period k at a true position, with noise and resolution.

    Args:
        place: true position of the joint.
        encoder: (N, n) noise of the measured positions; (0, n) for no noise.
        quantum: (n,) resolution of the encoders; 0 for none.
        k: index of the control period.
        j: index of the joint.
    """
    read = place + (encoder[k, j] if encoder.shape[0] else 0.0)
    return quantum[j] * np.floor(read / quantum[j] + 0.5) if quantum[j] > 0.0 else read


@njit(**OPTIONS)
def closed_loop(
    tree,
    body,
    linear,
    kinds,
    acts,
    model,
    gains,
    reference,
    encoder,
    quantum,
    push,
    period,
    smoothing,
    late,
    every,
    q,
    v,
    out,
):
    """Run the control loop: measure, command, hold the torque for one period, integrate.

    `every` need not be an integer: sample m is at m · every periods, for which a part of a period is integrated.

    Args:
        tree, body, linear, kinds, acts: arrays of the robot, described in the module's docstring.
        model: array `body` of the controller's model; 0 rows if there is none.
        gains: (6, n) kp, kd, ki, share of the reference's velocity, torque limit, limit of the integral.
        reference: (4, N, n) position, velocity, feedforward torque, feedforward acceleration (for `model`).
        encoder, push: (N, n) or (0, n), noise of the measured position, and torque that the model does not contain.
        quantum: (n,) resolution of the encoders; 0 for none.
        period: control period [s].
        smoothing: weight of a new velocity sample in the controller's low-pass.
        late: delay in control periods.
        every: control periods per sample.
        q, v: (n,) the state, which is overwritten.
        out: (5, M, n) true q, v, a, measured q and applied torque at each sample.

    Returns:
        A status, and the index of the period reached.
    """
    count, n = reference.shape[1], q.shape[0]
    work, matrix, slopes = np.empty((tree.shape[0] + 1, 46)), np.empty((n, n)), np.zeros((4, n))
    at, rate, speed, read, before = np.empty(n), np.empty(n), np.zeros(n), np.empty(n), np.empty(n)
    integral, wish, tau, waiting = np.zeros(n), np.empty(n), np.empty(n), np.zeros((late + 1, n))
    memory, loads = np.zeros((kinds.shape[0], 2)), np.zeros(n)
    _unstressed(kinds, acts, q, memory)
    sample = 0
    for k in range(count):
        for j in range(n):
            read[j] = _reading(q[j], encoder, quantum, k, j)
            if k == 0:
                speed[j] = v[j]
            else:
                speed[j] += smoothing * ((read[j] - before[j]) / period - speed[j])
            before[j] = read[j]
        command(gains, reference[0, k], reference[1, k], read, speed, integral, period, wish)
        if model.shape[0]:
            linearise_command(tree, model, linear, reference[3, k], read, speed, work, matrix, wish)
        for j in range(n):
            wish[j] += reference[2, k, j]
            held = min(max(wish[j], -gains[4, j]), gains[4, j])
            if held != wish[j] and (reference[0, k, j] - read[j]) * wish[j] > 0.0:
                integral[j] -= period * (reference[0, k, j] - read[j])  # no winding up against the limit
            waiting[k % (late + 1), j] = held
            tau[j] = waiting[(k + 1) % (late + 1) if k >= late else 0, j]
            if push.shape[0]:
                at[j] = tau[j] + push[k, j]
            else:
                at[j] = tau[j]
        if not accelerate(tree, body, linear, kinds, acts, memory, loads, q, v, at, work, matrix, slopes[0]):
            return SINGULAR, k
        for j in range(n):
            wish[j] = at[j]
        while sample < out.shape[1] and sample * every < k + 1 - 1e-9:
            part = sample * every - k
            here, fast, first = q, v, slopes
            if part >= 1e-9:
                here, fast, first, past = q.copy(), v.copy(), slopes.copy(), memory.copy()
                factors = matrix.copy()
                args = (tree, body, linear, kinds, acts, past, loads.copy())
                status = _advance(*args, here, fast, wish, part * period, first, work, factors, at, rate)
                if status != FINE:
                    return status, k
                if not accelerate(*args, here, fast, wish, work, factors, first[0]):
                    return SINGULAR, k
            for j in range(n):
                out[0, sample, j], out[1, sample, j], out[2, sample, j] = here[j], fast[j], first[0, j]
                out[3, sample, j], out[4, sample, j] = _reading(here[j], encoder, quantum, k, j), tau[j]
            sample += 1
        if k + 1 < count:
            args = (tree, body, linear, kinds, acts, memory, loads)
            status = _advance(*args, q, v, wish, period, slopes, work, matrix, at, rate)
            if status != FINE:
                return status, k
        for j in range(n):
            if not abs(v[j]) < 1e6:
                return DIVERGED, k
    return FINE, count

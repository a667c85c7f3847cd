"""Compiled derivatives of the closed loop (numba): a simulated motion's Jacobian with respect to parameters.

The kernels compute the exact derivative of the results of `loop_kernels`, step by step. With K = ∂tau/∂q, D = ∂tau/∂v
and Y = ∂tau/∂χ of the inverse dynamics at a state and its accelerations,

    M δa = δtau - K δq - D δv - Y,

for c columns at a time, through the stages of the Runge-Kutta method, the controller and its memory. K and D follow
from composite quantities about the base's origin: with ψ̇_i = V_p × S_i and ψ̈_i = A_p × S_i + V_p × ψ̇_i,

    K_ji = S_jᵀ (2 B_i ψ̇_i + I_i ψ̈_i + S_i ×* f_i),   K_ij = S_iᵀ (2 B_i ψ̇_j + I_i ψ̈_j),
    D_ji = S_jᵀ (2 B_i S_i + 2 I_i ψ̇_i),               D_ij = S_iᵀ (2 B_i S_j + 2 I_i ψ̇_j),   j between base and i

(Singh, Russell & Wensing 2022, one degree of freedom per joint). About a common origin 2 B m = [2 P w; 2 w × L] for a
twist m with angular part w: P = -[ω]Σ - [h][ν] and L = m ν + ω × h add up along the tree as the inertias do.

Arrays are those of `loop_kernels`, and

    find      (p,): column of each parameter among the c columns, or -1
    order, entries, shares, owners: index arrays of `loop_kernels.set_parameters`
    extended  (B + 1, 36): acceleration, ψ̇, ψ̈, wrench, P in columns 24 … 32, L in columns 33 … 35
    bodies_own  (B, 10): inertia of each body alone
"""

import numpy as np
from numba import njit

from calib.dynamics.kernels import (
    INNER,
    OPTIONS,
    add,
    cross,
    dot,
    scaled,
    ten_columns,
    three,
    turned,
    turned_back,
    write,
)
from calib.identification.closed_loop.loop_kernels import (
    DIVERGED,
    FINE,
    MAX_STEPS,
    SINGULAR,
    STIFF,
    accelerate,
    act,
    command,
    dynamics,
    inertia_of,
    linearise_command,
    momentum,
    set_parameters,
    stiffness,
    substitute,
    twist_cross,
    wrench,
)


@njit(**INNER)
def _outward(tree, body, v, a, work, bodies_own, extended):
    """Write accelerations, ψ̇ and ψ̈, wrench, P and L of each body into `extended`, and its inertia into `bodies_own`.

    `work` must contain the results of `dynamics`.

    Args:
        tree, body, work, bodies_own, extended: arrays described in the module's docstring and in that of
            `loop_kernels`.
        v, a: (n,) joint velocities and accelerations.
    """
    count = tree.shape[0]
    for i in range(count):
        for r in range(10):
            bodies_own[i, r] = work[i, 36 + r]
    for i in range(count):
        p = tree[i, 0]
        if p < count:
            for r in range(10):
                bodies_own[p, r] -= work[i, 36 + r]
    for r in range(36):
        extended[count, r] = 0.0
    extended[count, 3], extended[count, 4], extended[count, 5] = body[count, 0], body[count, 1], body[count, 2]
    for i in range(count):
        p, c = tree[i, 0], tree[i, 2]
        rate, change = (v[c], a[c]) if c >= 0 else (0.0, 0.0)
        w, n, b, a_p = three(work, p, 12), three(work, p, 15), three(extended, p, 0), three(extended, p, 3)
        u, s = three(work, i, 24), three(work, i, 27)
        e, f = twist_cross(w, n, u, s)
        (first, second), (third, fourth) = twist_cross(b, a_p, u, s), twist_cross(w, n, e, f)
        write(extended, i, 6, e)
        write(extended, i, 9, f)
        write(extended, i, 12, add(first, third))
        write(extended, i, 15, add(second, fourth))
        write(extended, i, 0, add(b, add(scaled(rate, e), scaled(change, u))))
        write(extended, i, 3, add(a_p, add(scaled(rate, f), scaled(change, s))))
        w, n = three(work, i, 12), three(work, i, 15)
        J = bodies_own[i, 0], bodies_own[i, 1], bodies_own[i, 2], bodies_own[i, 3], bodies_own[i, 4], bodies_own[i, 5]
        h = three(bodies_own, i, 6)
        moment, force, linear = wrench((J, h, bodies_own[i, 9]), w, n, three(extended, i, 0), three(extended, i, 3))
        write(extended, i, 18, moment)
        write(extended, i, 21, force)
        half, along = 0.5 * (J[0] + J[3] + J[5]), dot(h, n)
        # P = -[ω] Σ - [h][ν], [h][ν] = ν hᵀ - (h·ν) 1; Σ has the off-diagonals of -J; its columns one by one
        sigma = (half - J[0], -J[1], -J[2]), (-J[1], half - J[3], -J[4]), (-J[2], -J[4], half - J[5])
        for k in range(3):
            turning = cross(sigma[k], w)
            for r in range(3):
                extended[i, 24 + 3 * r + k] = turning[r] - n[r] * h[k] + (along if r == k else 0.0)
        write(extended, i, 33, linear)


@njit(**INNER)
def _slopes(tree, work, extended, by_q, by_v):
    """Add the bodies' part of K and D (n, n) to `by_q` and `by_v`.

    Composite quantities are summed from the tips to the base.

    Args:
        tree, work, extended: arrays described in the module's docstring and in that of `loop_kernels`.
        by_q, by_v: (n, n) K and D, the derivatives of the torques by q and v.
    """
    count = tree.shape[0]
    for i in range(count - 1, -1, -1):
        p, c = tree[i, 0], tree[i, 2]
        if c >= 0:
            u, s, inertia, linear = three(work, i, 24), three(work, i, 27), inertia_of(work, i), three(extended, i, 33)
            y, g = momentum(inertia, u, s)
            x = add(turned_back(extended, i, u, 24), cross(linear, s))
            e, f = three(extended, i, 6), three(extended, i, 9)
            once, twice = momentum(inertia, e, f), momentum(inertia, three(extended, i, 12), three(extended, i, 15))
            moment, force = three(extended, i, 18), three(extended, i, 21)
            # by q: 2 B ψ̇ + I ψ̈ + S ×* f
            q0 = add(add(scaled(2.0, turned(extended, i, e, 24)), twice[0]), add(cross(u, moment), cross(s, force)))
            q1 = add(add(scaled(2.0, cross(e, linear)), twice[1]), cross(u, force))
            # by v: 2 B S + 2 I ψ̇
            v0 = scaled(2.0, add(turned(extended, i, u, 24), once[0]))
            v1 = scaled(2.0, add(cross(u, linear), once[1]))
            by_q[c, c] += dot(u, q0) + dot(s, q1)
            by_v[c, c] += dot(u, v0) + dot(s, v1)
            k = p
            while k < count:
                d = tree[k, 2]
                if d >= 0:
                    a, b, e, f = three(work, k, 24), three(work, k, 27), three(extended, k, 6), three(extended, k, 9)
                    by_q[d, c] += dot(a, q0) + dot(b, q1)
                    by_v[d, c] += dot(a, v0) + dot(b, v1)
                    by_v[c, d] += 2.0 * (dot(x, a) + dot(y, e) + dot(g, f))
                    by_q[c, d] += 2.0 * dot(x, e) + dot(y, three(extended, k, 12)) + dot(g, three(extended, k, 15))
                k = tree[k, 0]
        if p < count:
            for r in range(18, 36):
                extended[p, r] += extended[i, r]


@njit(**INNER)
def _columns(tree, order, find, work, extended, out):
    """Add the derivatives Y (n, c) by the bodies' parameters to `out`, for parameters that have a column.

    Args:
        tree, order, find, work, extended: arrays described in the module's docstring and in that of `loop_kernels`.
        out: (n, c) derivatives of the torques by c parameters.
    """
    count = tree.shape[0]
    for i in range(count):
        has_column = False
        for k in range(10):
            has_column = has_column or find[10 * i + order[i, k]] >= 0
        if not has_column:
            continue
        x, g = three(work, i, 9), three(work, i, 12)
        w, b = turned_back(work, i, g), three(extended, i, 0)
        # acceleration of the body's origin: spatial, moved there, and ω × ν
        moving = add(three(work, i, 15), cross(g, x))
        a = turned_back(work, i, add(add(three(extended, i, 3), cross(b, x)), cross(g, moving)))
        b, j = turned_back(work, i, b), i
        while j < count:
            d = tree[j, 2]
            if d >= 0:
                u = three(work, j, 24)
                s = turned_back(work, i, add(three(work, j, 27), cross(u, x)))
                ten = ten_columns(w, b, a, turned_back(work, i, u), s)
                for k in range(10):
                    column = find[10 * i + order[i, k]]
                    if column >= 0:
                        out[d, column] += ten[k]
            j = tree[j, 0]


@njit(**INNER)
def _linearise(
    tree,
    body,
    linear,
    kinds,
    acts,
    order,
    entries,
    shares,
    owners,
    find,
    memory,
    q,
    v,
    a,
    work,
    bodies_own,
    extended,
    by_q,
    by_v,
    out,
):
    """Write K, D (n, n) and Y (n, c) of the inverse dynamics at q, v, a into `by_q`, `by_v` and `out`.

    Args:
        tree, body, linear, kinds, acts, memory: arrays of the robot, described in the module `loop_kernels`.
        order, entries, shares, owners, find: index arrays, described in the module's docstring.
        q, v, a: (n,) joint positions, velocities and accelerations.
        work: array of the bodies, with the results of `dynamics`.
        bodies_own, extended: working arrays, described in the module's docstring.
        by_q, by_v: (n, n) arrays to write.
        out: (n, c) array to write.
    """
    n = q.shape[0]
    by_q[:] = 0.0
    out[:] = 0.0
    for j in range(n):
        for k in range(n):
            by_v[j, k] = linear[j, n + k]
    _outward(tree, body, v, a, work, bodies_own, extended)
    if find.shape[0]:
        _columns(tree, order, find, work, extended, out)
    _slopes(tree, work, extended, by_q, by_v)
    for t in range(kinds.shape[0]):
        row = kinds[t, 0]
        value, place, rate = act(kinds[t, 1], acts, t, memory, q, v)
        for k in range(n):
            by_q[row, k] += acts[t, 0] * acts[t, 8 + k] * place
            by_v[row, k] += acts[t, 0] * acts[t, 8 + k] * rate
        if find.shape[0] and find[owners[t]] >= 0:
            out[row, find[owners[t]]] += value
    if find.shape[0]:
        for e in range(entries.shape[0]):
            column, place = find[entries[e, 2]], entries[e, 1]
            if column >= 0:
                sees = a[place] if place < n else v[place - n] if place < 2 * n else 1.0
                out[entries[e, 0], column] += shares[e] * sees


@njit(**INNER)
def _solve(matrix, by_q, by_v, columns, dq, dv, dtau, out):
    """Write M⁻¹ (δtau - K δq - D δv - Y) into out (n, c); `matrix` contains the factors of M.

    Args:
        matrix: (n, n) factors of M.
        by_q, by_v, columns: K, D (n, n) and Y (n, c).
        dq, dv, dtau: (n, c) derivatives of position, velocity and drive torque by the parameters.
        out: (n, c) derivatives of the acceleration.
    """
    n, c = out.shape
    for j in range(n):
        for m in range(c):
            out[j, m] = dtau[j, m] - columns[j, m]
        for k in range(n):
            by_q_jk, by_v_jk = by_q[j, k], by_v[j, k]
            for m in range(c):
                out[j, m] -= by_q_jk * dq[k, m] + by_v_jk * dv[k, m]
        for k in range(j):
            low = matrix[j, k]
            for m in range(c):
                out[j, m] -= low * out[k, m]
    for j in range(n - 1, -1, -1):
        size = matrix[j, j]
        for m in range(c):
            out[j, m] *= size
        for k in range(j + 1, n):
            low = matrix[k, j]
            for m in range(c):
                out[j, m] -= low * out[k, m]


@njit(**INNER)
def _advance_tangent(
    plant, layout, memory, loads, q, v, dq, dv, tau, dtau, period, slopes, dslopes, work, matrix, rooms
):
    """Advance q, v (n,) and δq, δv (n, c) by one period, as `loop_kernels._advance` advances q, v; return a status.

    Args:
        plant: arrays tree, body, linear, kinds, acts of `loop_kernels`.
        layout: index arrays order, entries, shares, owners, find.
        memory, loads, work: arrays described in the module `loop_kernels`.
        q, v: (n,) state, overwritten.
        dq, dv: (n, c) its derivatives by the parameters, overwritten.
        tau, dtau: (n,) and (n, c) drive torques, and their derivatives.
        period: duration [s].
        slopes, dslopes: (4, n) and (4, n, c) working memory for accelerations; it need not contain those at the start.
        matrix: (n, n) working memory.
        rooms: working arrays of `_workspace`.
    """
    tree, body, linear, kinds, acts = plant
    bodies_own, extended, by_q, by_v, columns, at, rate, dat, drate = rooms
    n, c = dq.shape
    if not accelerate(tree, body, linear, kinds, acts, memory, loads, q, v, tau, work, matrix, slopes[0]):
        return SINGULAR
    pieces = int(0.5 * period * stiffness(kinds, acts, loads, v, matrix, at)) + 1
    if pieces > MAX_STEPS:
        return STIFF
    span = period / pieces
    for piece in range(pieces):
        for stage in range(4):
            part, half = (span, 0.5 * span) if stage == 3 else (0.5 * span, 0.5 * span)
            if stage == 0:
                part = 0.0
            for j in range(n):
                before = slopes[stage - 2, j] if stage > 1 else 0.0
                last = slopes[stage - 1, j] if stage > 0 else 0.0
                at[j] = q[j] + part * (v[j] + half * before)
                rate[j] = v[j] + part * last
                if stage == 0:
                    for m in range(c):
                        dat[j, m], drate[j, m] = dq[j, m], dv[j, m]
                elif stage == 1:
                    for m in range(c):
                        dat[j, m] = dq[j, m] + part * dv[j, m]
                        drate[j, m] = dv[j, m] + part * dslopes[0, j, m]
                else:
                    for m in range(c):
                        dat[j, m] = dq[j, m] + part * (dv[j, m] + half * dslopes[stage - 2, j, m])
                        drate[j, m] = dv[j, m] + part * dslopes[stage - 1, j, m]
            if piece > 0 or stage > 0:
                state = (at, rate, tau, work, matrix, slopes[stage])
                if not accelerate(tree, body, linear, kinds, acts, memory, loads, *state):
                    return SINGULAR
            where = (at, rate, slopes[stage], work, bodies_own, extended, by_q, by_v, columns)
            _linearise(tree, body, linear, kinds, acts, *layout, memory, *where)
            _solve(matrix, by_q, by_v, columns, dat, drate, dtau, dslopes[stage])
        for j in range(n):
            first, inner, last = slopes[0, j], slopes[1, j] + slopes[2, j], slopes[3, j]
            q[j] += span * (v[j] + span / 6.0 * (first + inner))
            v[j] += span / 6.0 * (first + 2.0 * inner + last)
            for m in range(c):
                by_q_jk, middle, by_v_jk = dslopes[0, j, m], dslopes[1, j, m] + dslopes[2, j, m], dslopes[3, j, m]
                dq[j, m] += span * (dv[j, m] + span / 6.0 * (by_q_jk + middle))
                dv[j, m] += span / 6.0 * (by_q_jk + 2.0 * middle + by_v_jk)
    return FINE


@njit(**INNER)
def _workspace(bodies, n, c):
    """Return the working arrays of `_advance_tangent` for a number of bodies, n joints and c columns.

    Args:
        bodies: number of bodies.
        n: number of joints.
        c: number of columns.
    """
    bodies_own, extended = np.empty((bodies, 10)), np.empty((bodies + 1, 36))
    square, wide = (np.empty((n, n)), np.empty((n, n))), np.empty((n, c))
    return (
        bodies_own,
        extended,
        square[0],
        square[1],
        wide,
        np.empty(n),
        np.empty(n),
        np.empty((n, c)),
        np.empty((n, c)),
    )


@njit(**OPTIONS)
def advance_linearised(plant, layout, values, q, v, tau, period, gain, dq, dv):
    """Advance a state q, v (n,) by one period under a constant torque (n,), and write its Jacobian; return a status.

    Args:
        plant: arrays tree, body, linear, kinds, acts of `loop_kernels`.
        layout: index arrays order, entries, shares, owners, find; the columns of the c parameters in `find` start at 2
            n.
        values: (p,) parameters of the robot.
        q, v: (n,) state, overwritten.
        tau: (n,) drive torques.
        period: duration [s].
        gain: (n, n) array to which M⁻¹ of the first state is written.
        dq, dv: (n, 2 n + c) arrays for the derivatives of the new state by q, v and the c parameters.
    """
    tree, body, linear, kinds, acts = plant
    order, entries, shares, owners, _ = layout
    n, c = dq.shape
    set_parameters(values, order, entries, shares, owners, body, linear, acts)
    work, matrix = np.empty((tree.shape[0] + 1, 46)), np.empty((n, n))
    slopes, dslopes = np.empty((4, n)), np.empty((4, n, c))
    memory, loads, dtau = np.zeros((kinds.shape[0], 2)), np.zeros(n), np.zeros((n, c))
    rooms = _workspace(tree.shape[0], n, c)
    dq[:] = 0.0
    dv[:] = 0.0
    for j in range(n):
        dq[j, j], dv[j, n + j] = 1.0, 1.0
    if not accelerate(tree, body, linear, kinds, acts, memory, loads, q, v, tau, work, matrix, slopes[0]):
        return SINGULAR
    for i in range(n):
        unit = np.zeros(n)
        unit[i] = 1.0
        substitute(matrix, unit)
        gain[:, i] = unit
    state = (q, v, dq, dv, tau, dtau, period, slopes, dslopes, work, matrix, rooms)
    status = _advance_tangent(plant, layout, memory, loads, *state)
    return status if np.all(np.abs(v) < 1e6) else DIVERGED


@njit(**INNER)
def _command_tangent(
    plant,
    layout,
    model,
    empty,
    gains,
    relative,
    ahead,
    read,
    speed,
    dread,
    dspeed,
    dintegral,
    feedback,
    wish,
    dwish,
    work,
    matrix,
    rooms,
):
    """Write the derivatives (n, c) of the command before saturation into `dwish`.

    Args:
        plant: arrays tree, body, linear, kinds, acts of `loop_kernels`.
        layout: index arrays order, entries, shares, owners, find.
        model: array `body` of the controller's model; 0 rows if there is none.
        empty: empty array in place of `find` for the controller's model, whose parameters have no columns.
        gains: (6, n) controller values, as in `loop_kernels.closed_loop`.
        relative: (n, c) derivatives of the logarithm of each joint's gains by the parameters.
        ahead: (n,) feedforward acceleration.
        read, speed: (n,) measured position and velocity.
        dread, dspeed, dintegral: (n, c) derivatives of measured position, measured velocity, and integral of the error.
        feedback: (n,) feedback part of the command.
        wish, work, matrix: working memory.
        dwish: (n, c) array to write.
        rooms: working arrays of `_workspace`.
    """
    bodies_own, extended, by_q, by_v, columns, at, _, dat, _ = rooms
    tree, linear = plant[0], plant[2]
    n = len(dwish)
    for j in range(n):
        total = gains[2, j] * dintegral[j] - gains[0, j] * dread[j] - gains[1, j] * dspeed[j]
        dwish[j] = total + feedback[j] * relative[j]
    if model.shape[0]:
        at[:], wish[:] = feedback + ahead, 0.0
        dynamics(tree, model, linear, read, speed, work, matrix, wish)
        bare = np.zeros_like(linear)
        order, entries, shares, owners, find = layout
        where = (read, speed, at, work, bodies_own, extended, by_q, by_v, columns)
        none = (np.zeros((0, 2), dtype=np.int64), np.zeros((0, 8 + n)))
        _linearise(tree, model, bare, none[0], none[1], order, entries, shares, owners, empty, np.zeros((0, 2)), *where)
        dat[:] = 0.0
        for j in range(n):
            for k in range(n):
                inertia = matrix[max(j, k), min(j, k)]
                dat[j] += inertia * dwish[k] + by_q[j, k] * dread[k] + by_v[j, k] * dspeed[k]
        dwish[:] = dat
        for e in range(entries.shape[0]):  # the controller's model has the drives' inertias of the plant
            if entries[e, 1] < n and find[entries[e, 2]] >= 0:
                dwish[entries[e, 0], find[entries[e, 2]]] += shares[e] * at[entries[e, 1]]


@njit(**OPTIONS)
def closed_loop_tangent(
    plant, layout, model, gains, relative, reference, encoder, period, smoothing, late, every, q, v, count, out, dout
):
    """Write the motion of `loop_kernels.closed_loop` and its tangents; return a status and a period.

    The period is the index of the last one reached.

    Args:
        plant: arrays tree, body, linear, kinds, acts of `loop_kernels`.
        layout: index arrays order, entries, shares, owners, find.
        model: array `body` of the controller's model; 0 rows if there is none.
        gains: (6, n) controller values, as in `loop_kernels.closed_loop`.
        relative: (n, c) derivatives of the logarithm of each joint's gains by the parameters; zero for constant gains.
        reference: (4, N, n) position, velocity, feedforward torque, feedforward acceleration.
        encoder: (N, n) or (0, n), noise of the measured positions, on which the controller acts.
        period: control period [s].
        smoothing: weight of a new velocity sample in the controller's low-pass.
        late: delay in control periods.
        every: control periods per sample.
        q, v: (n,) the state, which is overwritten.
        count: number of control periods.
        out: (3, M, n) q, v and torque at each sample.
        dout: (3, M, n, c) their tangents, i.e. derivatives by the parameters.
    """
    tree, linear, kinds = plant[0], plant[2], plant[3]
    n, c = relative.shape
    work, matrix = np.empty((tree.shape[0] + 1, 46)), np.empty((n, n))
    slopes, dslopes = np.zeros((4, n)), np.zeros((4, n, c))
    rooms, empty = _workspace(tree.shape[0], n, c), np.empty(0, dtype=np.int64)
    memory, loads = np.zeros((kinds.shape[0], 2)), np.zeros(n)
    speed, before, integral, wish, feedback = np.zeros(n), np.empty(n), np.zeros(n), np.empty(n), np.empty(n)
    tau, waiting, read = np.empty(n), np.zeros((late + 1, n)), np.empty(n)
    dq, dv, dspeed, dbefore = np.zeros((n, c)), np.zeros((n, c)), np.zeros((n, c)), np.zeros((n, c))
    dintegral, dwish, dtau, dwaiting = np.zeros((n, c)), np.zeros((n, c)), np.zeros((n, c)), np.zeros((late + 1, n, c))
    sample = 0
    for k in range(count):
        read[:] = q
        if encoder.shape[0]:
            read += encoder[k]
        if k == 0:
            speed[:] = v
        else:
            for j in range(n):  # rounded as in `loop_kernels.closed_loop`
                speed[j] += smoothing * ((read[j] - before[j]) / period - speed[j])
            dspeed += smoothing * ((dq - dbefore) / period - dspeed)
        before[:], dbefore[:] = read, dq
        command(gains, reference[0, k], reference[1, k], read, speed, integral, period, feedback)
        for j in range(n):
            if abs(integral[j]) < gains[5, j]:
                dintegral[j] -= period * dq[j]
            else:
                dintegral[j] = 0.0
        _command_tangent(
            plant,
            layout,
            model,
            empty,
            gains,
            relative,
            reference[3, k],
            read,
            speed,
            dq,
            dspeed,
            dintegral,
            feedback,
            wish,
            dwish,
            work,
            matrix,
            rooms,
        )
        wish[:] = feedback
        if model.shape[0]:
            linearise_command(tree, model, linear, reference[3, k], read, speed, work, matrix, wish)
        wish += reference[2, k]
        now, old = k % (late + 1), (k + 1) % (late + 1) if k >= late else 0
        for j in range(n):
            held = min(max(wish[j], -gains[4, j]), gains[4, j])
            error = reference[0, k, j] - read[j]
            if held != wish[j] and error * wish[j] > 0.0:
                integral[j] -= period * error
                dintegral[j] += period * dq[j]
            waiting[now, j], dwaiting[now, j] = held, 0.0
            if held == wish[j]:
                dwaiting[now, j] = dwish[j]
        tau[:], dtau[:] = waiting[old], dwaiting[old]
        while sample < out.shape[1] and sample * every < k + 1 - 1e-9:
            part = sample * every - k
            here, fast, dhere, dfast = q.copy(), v.copy(), dq.copy(), dv.copy()
            if part >= 1e-9:
                state = (here, fast, dhere, dfast, tau, dtau, part * period, slopes, dslopes, work, matrix, rooms)
                status = _advance_tangent(plant, layout, memory, loads, *state)
                if status != FINE:
                    return status, k
            out[0, sample], out[1, sample], out[2, sample] = here, fast, tau
            dout[0, sample], dout[1, sample], dout[2, sample] = dhere, dfast, dtau
            sample += 1
        if k + 1 < count:
            state = (q, v, dq, dv, tau, dtau, period, slopes, dslopes, work, matrix, rooms)
            status = _advance_tangent(plant, layout, memory, loads, *state)
            if status != FINE:
                return status, k
        if not np.all(np.abs(v) < 1e6):
            return DIVERGED, k
    return FINE, count

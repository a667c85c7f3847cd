"""Compiled kernels (numba) of closed loops: the legs at given postures, and a simulated run.

A leg is read from the arrays of its `Bodies`, ``links`` and ``constants``, every frame turned so that its joint's axis
is z; ``tail`` (4, 4) takes its last frame to its end. R, p place the platform; c of a leg's six equations are held.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from calib.dynamics.kernels import OPTIONS, inverse_dynamics, mass_matrix

KIND, SCALE, REVOLUTE = 1, 12, 1


@njit(**OPTIONS)
def invert(A, out):
    """Write A⁻¹ (n, n) by Gauss and Jordan with row pivots; A is lost. A zero pivot becomes tiny: huge entries."""
    n = A.shape[0]
    out[:] = 0.0
    for i in range(n):
        out[i, i] = 1.0
    for j in range(n):
        best = j
        for i in range(j + 1, n):
            if abs(A[i, j]) > abs(A[best, j]):
                best = i
        if best != j:
            for k in range(n):
                A[j, k], A[best, k] = A[best, k], A[j, k]
                out[j, k], out[best, k] = out[best, k], out[j, k]
        pivot = A[j, j]
        if abs(pivot) < 1e-200:
            pivot = 1e-200
        for k in range(n):
            A[j, k] /= pivot
            out[j, k] /= pivot
        for i in range(n):
            factor = A[i, j]
            if i != j and factor != 0.0:
                for k in range(n):
                    A[i, k] -= factor * A[j, k]
                    out[i, k] -= factor * out[j, k]


@njit(**OPTIONS)
def one_leg(links, constants, tail, attachment, q, R, p, full, inverse, carried, gap, lever, frame):
    """Write one leg at one posture; see `calib.mechanism.leg_links.LegLinks`.

    Args:
        full: (6, n), inverse (n, c), carried (c, 6), zero on entry, gap (c,), lever (3,);
            frame (4, 6 + 3 n) to work in.
    """
    n, held = q.shape[0], gap.shape[0]
    r, o, place = frame[:3, :3], frame[3, :3], frame[:3, 3:6]
    r[:] = 0.0
    o[:] = 0.0
    for i in range(3):
        r[i, i] = 1.0
    for j in range(n):
        for i in range(3):
            for k in range(3):
                total = 0.0
                for m in range(3):
                    total += r[i, m] * constants[j, 4 * m + k]
                place[i, k] = total
            o[i] += r[i, 0] * constants[j, 3] + r[i, 1] * constants[j, 7] + r[i, 2] * constants[j, 11]
        amount = constants[j, SCALE] * q[j]
        for i in range(3):
            frame[i, 6 + j] = o[i]
        if links[j, KIND] == REVOLUTE:
            cosine, sine = np.cos(amount), np.sin(amount)
            for i in range(3):
                r[i, 0] = cosine * place[i, 0] + sine * place[i, 1]
                r[i, 1] = cosine * place[i, 1] - sine * place[i, 0]
                r[i, 2] = place[i, 2]
                full[i, j], full[3 + i, j] = 0.0, constants[j, SCALE] * place[i, 2]
        else:
            for i in range(3):
                for k in range(3):
                    r[i, k] = place[i, k]
                o[i] += amount * place[i, 2]
                full[i, j], full[3 + i, j] = constants[j, SCALE] * place[i, 2], 0.0
    for i in range(3):
        lever[i] = R[i, 0] * attachment[0, 3] + R[i, 1] * attachment[1, 3] + R[i, 2] * attachment[2, 3]
        o[i] += r[i, 0] * tail[0, 3] + r[i, 1] * tail[1, 3] + r[i, 2] * tail[2, 3]
        gap[i] = o[i] - p[i] - lever[i]
        carried[i, i] = 1.0
    carried[0, 4], carried[1, 5], carried[2, 3] = lever[2], lever[0], lever[1]
    carried[0, 5], carried[1, 3], carried[2, 4] = -lever[1], -lever[2], -lever[0]
    for j in range(n):
        if links[j, KIND] == REVOLUTE:
            x, y, z = o[0] - frame[0, 6 + j], o[1] - frame[1, 6 + j], o[2] - frame[2, 6 + j]
            full[0, j] = full[4, j] * z - full[5, j] * y
            full[1, j] = full[5, j] * x - full[3, j] * z
            full[2, j] = full[3, j] * y - full[4, j] * x
    if held == 6:
        for i in range(3):
            carried[3 + i, 3 + i] = 1.0
        for i in range(3):  # orientations: ends in `place`, attachment in `r`, then the skew part of end · attachmentᵀ
            for k in range(3):
                place[i, k] = r[i, 0] * tail[0, k] + r[i, 1] * tail[1, k] + r[i, 2] * tail[2, k]
        for i in range(3):
            for k in range(3):
                r[i, k] = R[i, 0] * attachment[0, k] + R[i, 1] * attachment[1, k] + R[i, 2] * attachment[2, k]
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            total = 0.0
            for m in range(3):
                total += place[b, m] * r[a, m] - place[a, m] * r[b, m]
            gap[3 + i] = 0.5 * total
    square = np.empty((n, n))
    for i in range(n):
        for k in range(n):
            total = 0.0
            for m in range(held):
                total += full[m, i] * full[m, k]
            square[i, k] = total if held > n else full[i, k]
    back = np.empty((n, n))
    invert(square, back)
    for i in range(n):
        for m in range(held):
            if held > n:
                total = 0.0
                for k in range(n):
                    total += back[i, k] * full[m, k]
                inverse[i, m] = total
            else:
                inverse[i, m] = back[i, m]


@njit(**OPTIONS)
def legs(links, constants, tail, attachment, q, pose, full, inverse, carried, gap, lever):
    """Write one leg at N postures: q (N, n), pose (N, 4, 4); arrays as of `one_leg` with N before."""
    frame = np.empty((4, 6 + 3 * q.shape[1]))
    for s in range(q.shape[0]):
        one_leg(
            links, constants, tail, attachment, q[s], pose[s, :3, :3], pose[s, :3, 3], full[s], inverse[s], carried[s],
            gap[s], lever[s], frame,
        )  # fmt: skip


@njit(**OPTIONS)
def _cross(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(**OPTIONS)
def _add(A, x, out):
    """Add A x to `out`; loops, as BLAS takes longer to compile than to run."""
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            out[i] += A[i, k] * x[k]


@njit(**OPTIONS)
def _platform(body, R, turn, gravity, M, h):
    """Write the platform's inertia M (6, 6) and its wrench h (6,) where the twist does not change."""
    S, across, twice, n = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    own = np.array([[body[0], body[1], body[2]], [body[1], body[3], body[4]], [body[2], body[4], body[5]]])
    inertia, spin = np.empty((3, 3)), np.zeros(3)
    for i in range(3):
        S[i] = R[i, 0] * body[6] + R[i, 1] * body[7] + R[i, 2] * body[8]
        for k in range(3):
            total = 0.0
            for a in range(3):
                for b in range(3):
                    total += R[i, a] * own[a, b] * R[k, b]
            inertia[i, k] = total
    _cross(turn, S, across)
    _cross(turn, across, twice)
    _add(inertia, turn, spin)
    _cross(turn, spin, n)
    _cross(S, -gravity, across)
    M[:] = 0.0
    for i in range(3):
        h[i], h[3 + i], M[i, i] = twice[i] - body[9] * gravity[i], n[i] + across[i], body[9]
        for k in range(3):
            M[3 + i, 3 + k] = inertia[i, k]
    M[0, 4] = M[4, 0] = S[2]
    M[1, 5] = M[5, 1] = S[0]
    M[2, 3] = M[3, 2] = S[1]
    M[0, 5] = M[5, 0] = -S[1]
    M[1, 3] = M[3, 1] = -S[2]
    M[2, 4] = M[4, 2] = -S[0]


@njit(**OPTIONS)
def _bent(full, v, twist, lever, c, out):
    """Write the shift (c,) of a leg's acceleration equations J q̈ = G ṫ - out, see `calib.mechanism.velocities`."""
    w, moved, turned, across = np.zeros(3), np.empty(3), np.empty(3), np.empty(3)
    bias = np.zeros(6)
    for j in range(v.shape[0]):
        for m in range(3):
            moved[m], turned[m] = full[m, j] * v[j], full[3 + m, j] * v[j]
        _cross(2.0 * w + turned, moved, across)
        bias[:3] += across
        _cross(w, turned, across)
        bias[3:] += across
        w += turned
    _cross(twist[3:], lever, across)
    _cross(twist[3:], across, moved)
    bias[:3] -= moved
    out[:] = bias[:c]


@njit(**OPTIONS)
def _freedoms(full, inverse, carried, held, starts, selected, D, back):
    """Write D (6, r), the twists that all legs can follow, and `back` (L, 6, 6): t_0 = Σ_k back[k] e_k.

    The legs' equations J q̇ = G t - e leave (1 - J J⁺) (G t - e) = 0; of it the twist's other parts by least squares,
    the selected ones of t_0 being zero (`calib.mechanism.closure.twists`).
    """
    L, r = starts.shape[0] - 1, selected.shape[0]
    others = np.empty(6 - r, np.int64)
    count = 0
    for i in range(6):
        free = True
        for k in range(r):
            free = free and selected[k] != i
        if free:
            others[count] = i
            count += 1
    square, mixed = np.zeros((6 - r, 6 - r)), np.zeros((6 - r, r))
    rows, across = np.zeros((L, 6, 6)), np.zeros((L, 6, 6))
    for leg in range(L):
        n, c = starts[leg + 1] - starts[leg], held[leg]
        for i in range(c):
            across[leg, i, i] = 1.0
            for m in range(c):
                for j in range(n):
                    across[leg, i, m] -= full[leg, i, j] * inverse[leg, j, m]
        for i in range(c):
            for m in range(c):
                for a in range(6):
                    rows[leg, i, a] += across[leg, i, m] * carried[leg, m, a]
        for a in range(6 - r):
            for i in range(c):
                for b in range(6 - r):
                    square[a, b] += rows[leg, i, others[a]] * rows[leg, i, others[b]]
                for b in range(r):
                    mixed[a, b] += rows[leg, i, others[a]] * rows[leg, i, selected[b]]
    solved = np.empty((6 - r, 6 - r))
    invert(square, solved)
    D[:] = 0.0
    back[:] = 0.0
    for b in range(r):
        D[selected[b], b] = 1.0
        for a in range(6 - r):
            for k in range(6 - r):
                D[others[a], b] -= solved[a, k] * mixed[k, b]
    for leg in range(L):
        for k in range(6 - r):
            for m in range(held[leg]):
                through = 0.0
                for i in range(held[leg]):
                    through += rows[leg, i, others[k]] * across[leg, i, m]
                for a in range(6 - r):
                    back[leg, others[a], m] += solved[a, k] * through


@njit(**OPTIONS)
def accelerate(robot, values, q, R, p, rate, tau, rates, twist, change):
    """Write v̇ (r,) into `change`, q̇ (n_t,) into `rates` and t (6,) into `twist`; close the gaps in q, R, p on the way.

    Args:
        robot: links, constants, tails, attachments (tuples over the legs), starts, held, selected, actuated, gravity,
            and whether the platform's twist is always the selected parts alone.
        values: parameters of each leg's bodies (tuple), of the platform (10,), drives (5, n_t) Ia Fv Fc off and v0.
        q: (n_t,); R, p: of the platform; rate: (r,); tau: (n,) of the actuators.
    """
    links, constants, tails, attachments, starts, held, selected, actuated, gravity, fixed = robot
    parameters, body, drives = values
    r, n_t, L = rate.shape[0], q.shape[0], starts.shape[0] - 1
    most = 0
    for leg in range(L):
        most = max(most, starts[leg + 1] - starts[leg])
    full, inverse, carried = np.zeros((L, 6, most)), np.zeros((L, most, 6)), np.zeros((L, 6, 6))
    gap, lever, shift = np.zeros((L, 6)), np.empty((L, 3)), np.zeros((L, 6))
    for leg in range(L):
        first, n, c = starts[leg], starts[leg + 1] - starts[leg], held[leg]
        one_leg(
            links[leg], constants[leg], tails[leg], attachments[leg], q[first : first + n], R, p, full[leg, :, :n],
            inverse[leg, :n, :c], carried[leg, :c], gap[leg, :c], lever[leg], np.empty((4, 6 + 3 * n)),
        )  # fmt: skip
    D, back, mend, still = np.zeros((6, r)), np.zeros((L, 6, 6)), np.zeros(6), np.zeros(6)
    if fixed:
        for i in range(r):
            D[selected[i], i] = 1.0
    else:
        _freedoms(full, inverse, carried, held, starts, selected, D, back)
        for leg in range(L):
            _add(back[leg], gap[leg], mend)
        newR, newp = np.empty((3, 3)), np.empty(3)
        _turned(mend, R, p, newR, newp)
        R[:], p[:] = newR, newp
    twist[:] = 0.0
    _add(D, rate, twist)
    J = np.zeros((n_t, r))
    for leg in range(L):
        first, n, c = starts[leg], starts[leg + 1] - starts[leg], held[leg]
        missing = -gap[leg]
        _add(carried[leg], mend, missing)
        for j in range(n):
            for m in range(c):
                q[first + j] += inverse[leg, j, m] * missing[m]
                for a in range(6):
                    for i in range(r):
                        J[first + j, i] += inverse[leg, j, m] * carried[leg, m, a] * D[a, i]
    rates[:] = 0.0
    _add(J, rate, rates)
    for leg in range(L):
        n, c = starts[leg + 1] - starts[leg], held[leg]
        _bent(full[leg, :, :n], rates[starts[leg] : starts[leg + 1]], twist, lever[leg], c, shift[leg, :c])
        _add(back[leg], shift[leg], still)
    M, h, torque = np.zeros((r, r)), np.zeros(r), np.zeros(n_t)
    for j in range(actuated.shape[0]):
        torque[actuated[j]] = tau[j]
    for leg in range(L):
        first, n, c = starts[leg], starts[leg + 1] - starts[leg], held[leg]
        v, a, amount = np.empty((1, n)), np.zeros((1, n)), np.empty((1, n))
        bent = -shift[leg]
        _add(carried[leg], still, bent)
        for j in range(n):
            v[0, j], amount[0, j] = rates[first + j], constants[leg][j, SCALE] * q[first + j]
            for m in range(c):
                a[0, j] += inverse[leg, j, m] * bent[m]
        cosine, sine, need, inertia = np.cos(amount), np.sin(amount), np.zeros((1, n)), np.zeros((1, n, n))
        inverse_dynamics(links[leg], constants[leg], parameters[leg], amount, cosine, sine, v, a, need)
        mass_matrix(links[leg], constants[leg], parameters[leg], amount, cosine, sine, inertia)
        for j in range(n):
            own_drive = drives[:, first + j]
            inertia[0, j, j] += own_drive[0]
            need[0, j] += own_drive[0] * a[0, j] + own_drive[1] * v[0, j] + own_drive[3] - torque[first + j]
            need[0, j] += own_drive[2] * np.tanh(v[0, j] / own_drive[4])
        for i in range(r):
            for j in range(n):
                h[i] += J[first + j, i] * need[0, j]
                for k in range(n):
                    for m in range(r):
                        M[i, m] += J[first + j, i] * inertia[0, j, k] * J[first + k, m]
    whole, wrench = np.empty((6, 6)), np.empty(6)
    _platform(body, R, twist[3:], gravity, whole, wrench)
    _add(whole, still, wrench)
    for i in range(r):
        for a in range(6):
            h[i] += D[a, i] * wrench[a]
            for b in range(6):
                for m in range(r):
                    M[i, m] += D[a, i] * whole[a, b] * D[b, m]
    solved = np.empty((r, r))
    invert(M, solved)
    for i in range(r):
        change[i] = 0.0
        for k in range(r):
            change[i] -= solved[i, k] * h[k]


@njit(**OPTIONS)
def _turned(twist, R, p, newR, newp):
    """Write the pose moved by a twist (6,): p += v, R = Exp(ω) R (Rodrigues)."""
    angle = np.sqrt(twist[3] ** 2 + twist[4] ** 2 + twist[5] ** 2)
    one = np.sin(angle) / angle if angle > 1e-12 else 1.0
    two = 0.5 * (np.sin(0.5 * angle) / (0.5 * angle)) ** 2 if angle > 1e-12 else 0.5
    K = np.zeros((3, 3))
    K[0, 1], K[1, 2], K[2, 0] = -twist[5], -twist[3], -twist[4]
    K[1, 0], K[2, 1], K[0, 2] = twist[5], twist[3], twist[4]
    newp[:] = p + twist[:3]
    for i in range(3):
        for k in range(3):
            newR[i, k] = R[i, k]
            for a in range(3):
                turn = one * K[i, a]
                for b in range(3):
                    turn += two * K[i, b] * K[b, a]
                newR[i, k] += turn * R[a, k]


@njit(**OPTIONS)
def run(robot, values, q, R, p, rate, plan, noise, limit, gains, step, far, read, held):
    """Simulate a run under computed torque; see `calib.mechanism.computed_torque`. -1, or the sample it leaves at.

    Args:
        q, R, p, rate: the state it starts from, changed.
        plan: reference of the encoders (N, n), forces (N, r), inertia (N, r, r), J⁺ (N, r, n), preload (N, n).
        noise: (N, n) of the encoders; limit (n,); gains: of the error and of its rate.
        read, held: (N, n) what is written: readings, and torques held from sample to sample.
    """
    wanted, forces, inertia, back, preload = plan
    n, r = robot[7].shape[0], rate.shape[0]
    actuated = robot[7]
    rates, change, middle, twist = np.empty(q.shape[0]), np.empty(r), np.empty(r), np.empty(6)
    R2, p2, q2 = np.empty((3, 3)), np.empty(3), np.empty(q.shape[0])
    off, slow, push, force = np.empty(n), np.zeros(n), np.empty(r), np.empty(r)
    for k in range(wanted.shape[0]):
        for j in range(n):
            read[k, j] = q[actuated[j]] + noise[k, j]
            off[j] = wanted[k, j] - read[k, j]
            if not abs(off[j]) < far:
                return k
            if k:
                slow[j] = (wanted[k, j] - wanted[k - 1, j] - read[k, j] + read[k - 1, j]) / step
        push[:] = 0.0
        _add(back[k], gains[0] * off + gains[1] * slow, push)
        force[:] = forces[k]
        _add(inertia[k], push, force)
        for j in range(n):
            total = preload[k, j]
            for i in range(r):
                total += back[k, i, j] * force[i]
            held[k, j] = min(max(total, -limit[j]), limit[j])
        accelerate(robot, values, q, R, p, rate, held[k], rates, twist, change)
        middle[:] = rate + 0.5 * step * change
        _turned(0.5 * step * twist, R, p, R2, p2)
        q2[:] = q + 0.5 * step * rates
        accelerate(robot, values, q2, R2, p2, middle, held[k], rates, twist, change)
        _turned(step * twist, R, p, R2, p2)
        q += step * rates
        R[:], p[:] = R2, p2
        rate += step * change
    return -1

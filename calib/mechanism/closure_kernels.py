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
def _add_platform(body, R, turn, gravity, selected, M, h):
    """Add the platform's inertia and its force at rest of the twist's derivative; `body` its ten parameters."""
    S, across, twice, n = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    inertia, skew = np.empty((3, 3)), np.zeros((3, 3))
    own = np.array([[body[0], body[1], body[2]], [body[1], body[3], body[4]], [body[2], body[4], body[5]]])
    for i in range(3):
        S[i] = R[i, 0] * body[6] + R[i, 1] * body[7] + R[i, 2] * body[8]
        for k in range(3):
            total = 0.0
            for a in range(3):
                for b in range(3):
                    total += R[i, a] * own[a, b] * R[k, b]
            inertia[i, k] = total
    skew[0, 1], skew[1, 2], skew[2, 0] = -S[2], -S[0], -S[1]
    skew[1, 0], skew[2, 1], skew[0, 2] = S[2], S[0], S[1]
    _cross(turn, S, across)
    _cross(turn, across, twice)
    _cross(turn, inertia @ turn, n)
    _cross(S, -gravity, across)
    for i in range(selected.shape[0]):
        a = selected[i]
        h[i] += twice[a] - body[9] * gravity[a] if a < 3 else n[a - 3] + across[a - 3]
        for k in range(selected.shape[0]):
            b = selected[k]
            if a < 3 and b < 3:
                M[i, k] += body[9] if a == b else 0.0
            elif a < 3:
                M[i, k] -= skew[a, b - 3]
            elif b < 3:
                M[i, k] += skew[a - 3, b]
            else:
                M[i, k] += inertia[a - 3, b - 3]


@njit(**OPTIONS)
def accelerate(robot, values, q, R, p, rate, tau, rates, change):
    """Write v̇ (r,) into `change` and q̇ (n_t,) into `rates`; close the legs' gaps in q on the way.

    Args:
        robot: links, constants, tails, attachments (tuples over the legs), starts, held, selected, actuated, gravity.
        values: parameters of each leg's bodies (tuple), of the platform (10,), drives (5, n_t) Ia Fv Fc off and v0.
        q: (n_t,); R, p: of the platform; rate: (r,); tau: (n,) of the actuators.
    """
    links, constants, tails, attachments, starts, held, selected, actuated, gravity = robot
    parameters, body, drives = values
    r, n_t = rate.shape[0], q.shape[0]
    M, h, torque, twist = np.zeros((r, r)), np.zeros(r), np.zeros(n_t), np.zeros(6)
    for i in range(r):
        twist[selected[i]] = rate[i]
    for j in range(actuated.shape[0]):
        torque[actuated[j]] = tau[j]
    w, moved, turned, across, lever = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for leg in range(starts.shape[0] - 1):
        first, n, c = starts[leg], starts[leg + 1] - starts[leg], held[leg]
        full, inverse, carried, gap = np.empty((6, n)), np.empty((n, c)), np.zeros((c, 6)), np.empty(c)
        own = q[first : first + n]
        one_leg(
            links[leg], constants[leg], tails[leg], attachments[leg], own, R, p, full, inverse, carried, gap, lever,
            np.empty((4, 6 + 3 * n)),
        )  # fmt: skip
        J, v, bias = np.zeros((n, r)), np.zeros((1, n)), np.zeros(6)
        for j in range(n):
            for m in range(c):
                own[j] -= inverse[j, m] * gap[m]
                for i in range(r):
                    J[j, i] += inverse[j, m] * carried[m, selected[i]]
            for i in range(r):
                v[0, j] += J[j, i] * rate[i]
            rates[first + j] = v[0, j]
        w[:] = 0.0
        for j in range(n):
            for m in range(3):
                moved[m], turned[m] = full[m, j] * v[0, j], full[3 + m, j] * v[0, j]
            _cross(2.0 * w + turned, moved, across)
            bias[:3] += across
            _cross(w, turned, across)
            bias[3:] += across
            w += turned
        _cross(twist[3:], lever, across)
        _cross(twist[3:], across, moved)
        bias[:3] -= moved
        a, amount = np.zeros((1, n)), np.empty((1, n))
        for j in range(n):
            for m in range(c):
                a[0, j] -= inverse[j, m] * bias[m]
            amount[0, j] = constants[leg][j, SCALE] * own[j]
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
                h[i] += J[j, i] * need[0, j]
                for k in range(n):
                    for m in range(r):
                        M[i, m] += J[j, i] * inertia[0, j, k] * J[k, m]
    _add_platform(body, R, twist[3:], gravity, selected, M, h)
    back = np.empty((r, r))
    invert(M, back)
    for i in range(r):
        change[i] = 0.0
        for k in range(r):
            change[i] -= back[i, k] * h[k]


@njit(**OPTIONS)
def _carry_on(selected, rate, step, R, p, q, rates, newR, newp, newq):
    """Write the posture a step on at constant rates: q += step · q̇, p += step · ṗ, R = Exp(step · ω) R (Rodrigues)."""
    turn = np.zeros(3)
    newp[:] = p
    for i in range(selected.shape[0]):
        if selected[i] < 3:
            newp[selected[i]] += step * rate[i]
        else:
            turn[selected[i] - 3] = step * rate[i]
    angle = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    one = np.sin(angle) / angle if angle > 1e-12 else 1.0
    two = 0.5 * (np.sin(0.5 * angle) / (0.5 * angle)) ** 2 if angle > 1e-12 else 0.5
    K = np.zeros((3, 3))
    K[0, 1], K[1, 2], K[2, 0] = -turn[2], -turn[0], -turn[1]
    K[1, 0], K[2, 1], K[0, 2] = turn[2], turn[0], turn[1]
    newR[:] = R + (one * K + two * (K @ K)) @ R
    newq[:] = q + step * rates


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
    selected, actuated = robot[6], robot[7]
    n, r = actuated.shape[0], rate.shape[0]
    rates, change, middle = np.empty(q.shape[0]), np.empty(r), np.empty(r)
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
        push[:] = back[k] @ (gains[0] * off + gains[1] * slow)
        force[:] = forces[k] + inertia[k] @ push
        for j in range(n):
            total = preload[k, j]
            for i in range(r):
                total += back[k, i, j] * force[i]
            held[k, j] = min(max(total, -limit[j]), limit[j])
        accelerate(robot, values, q, R, p, rate, held[k], rates, change)
        middle[:] = rate + 0.5 * step * change
        _carry_on(selected, rate, 0.5 * step, R, p, q, rates, R2, p2, q2)
        accelerate(robot, values, q2, R2, p2, middle, held[k], rates, change)
        _carry_on(selected, middle, step, R, p, q, rates, R2, p2, q2)
        R[:], p[:], q[:] = R2, p2, q2
        rate += step * change
    return -1

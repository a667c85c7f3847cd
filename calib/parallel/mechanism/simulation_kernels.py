"""Compiled simulation (numba) of a parallel robot under a sampled controller of its actuators.

Between samples the platform's coordinates are integrated by the midpoint rule. The legs' joints follow the platform,
and each evaluation also corrects the gaps of the loops. Notation as in `closure_kernels`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from calib.dynamics.kernels import (
    INNER,
    OPTIONS,
    add,
    cross,
    dot,
    increase,
    inertia_times,
    inverse_dynamics,
    scaled,
    three,
)
from calib.identification.closed_loop.loop_kernels import (
    DIVERGED,
    FINE,
    MAX_STEPS,
    MIDPOINT_STEP,
    SINGULAR,
    STIFF,
    STIFF_REACH,
    command,
    factorise,
    substitute,
)
from calib.parallel.mechanism.closure_kernels import SCALE, invert, one_leg


@njit(**INNER)
def _add(A, x, out):
    """Add A x to `out`."""
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            out[i] += A[i, k] * x[k]


@njit(**INNER)
def _platform(body, pose, turn, gravity, M, h):
    """Write the platform's inertia M (6, 6), zero on entry, and its wrench h (6,) where the twist does not change."""
    w = (turn[0], turn[1], turn[2])
    g = (gravity[0], gravity[1], gravity[2])
    rows = (three(pose, 0, 0), three(pose, 1, 0), three(pose, 2, 0))
    moments = body[6], body[7], body[8]
    S = dot(rows[0], moments), dot(rows[1], moments), dot(rows[2], moments)
    for i in range(3):
        M[i, i] = body[9]
        for k in range(3):
            M[3 + i, 3 + k] = dot(rows[i], inertia_times(body, rows[k]))
    spin = dot(three(M, 3, 3), w), dot(three(M, 4, 3), w), dot(three(M, 5, 3), w)
    h[0], h[1], h[2] = add(cross(w, cross(w, S)), scaled(-body[9], g))
    h[3], h[4], h[5] = add(cross(w, spin), cross(g, S))
    M[0, 4] = M[4, 0] = S[2]
    M[1, 5] = M[5, 1] = S[0]
    M[2, 3] = M[3, 2] = S[1]
    M[0, 5] = M[5, 0] = -S[1]
    M[1, 3] = M[3, 1] = -S[2]
    M[2, 4] = M[4, 2] = -S[0]


@njit(**INNER)
def _bent(full, v, turn, lever, leg, shift):
    """Add the right-hand side of a leg's acceleration equations J q̈ = G ṫ - shift to row `leg` of `shift` (L, 6).

    The terms are those of `velocities.of_platform`.
    """
    w = (0.0, 0.0, 0.0)
    t = (turn[0], turn[1], turn[2])
    for j in range(v.shape[0]):
        moved = scaled(v[j], (full[0, j], full[1, j], full[2, j]))
        turned = scaled(v[j], (full[3, j], full[4, j], full[5, j]))
        increase(shift, leg, 3, cross(w, turned))
        increase(shift, leg, 0, cross(add(scaled(2.0, w), turned), moved))
        w = add(w, turned)
    increase(shift, leg, 0, cross(t, cross(three(lever, leg, 0), t)))


@njit(**INNER)
def _freedoms(full, inverse, carried, held, starts, selected, D, back):
    """Write D (6, r) and `back` (L, 6, 6), both zero on entry: platform twists that all legs can follow are t_0 + D v.

    t_0 = Σ_k back[k] e_k. From the equations J q̇ = G t - e of all legs remain (1 - J J⁺) (G t - e) = 0, which determine
    the components of the twist that are not selected, by least squares; the selected components of t_0 are zero
    (`calib.parallel.mechanism.closure.twists`).
    """
    L = starts.shape[0] - 1
    r = selected.shape[0]
    others = np.empty(6 - r, np.int64)
    count = 0
    for i in range(6):
        free = True
        for k in range(r):
            free = free and selected[k] != i
        if free:
            others[count] = i
            count += 1
    square = np.zeros((6 - r, 6 - r))
    mixed = np.zeros((6 - r, r))
    rows = np.zeros((L, 6, 6))
    across = np.zeros((L, 6, 6))
    for leg in range(L):
        n = starts[leg + 1] - starts[leg]
        c = held[leg]
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


@njit(**INNER)
def _follow(held, inverse, carried, gap, mend, D, q, J):
    """Move a leg's joints q (n,) so that they follow the platform's step `mend` (6,), and close the leg's gap.

    Also write J (n, r), zero on entry, with q̇ = J v.
    """
    for m in range(held):
        missing = -gap[m]
        for a in range(6):
            missing += carried[m, a] * mend[a]
        for j in range(q.shape[0]):
            q[j] += inverse[j, m] * missing
            for a in range(6):
                for i in range(D.shape[1]):
                    J[j, i] += inverse[j, m] * carried[m, a] * D[a, i]


@njit(**INNER)
def _leg_share(links, constants, parameters, drives, held, inverse, carried, shift, still, q, rates, tau, J, M, h):
    """Add a leg's share to the inertia M (r, r) and to the force h (r,), the force if ṫ = `still`.

    Args:
        drives: (n, 5) drive parameters of the leg's joints.
        q, rates, tau: (n,) joint values, rates and actuator torques of the leg.
        J: (n, r) Jacobian of the leg's joints.
    """
    n = q.shape[0]
    r = h.shape[0]
    # Row 0 is the motion; in row j + 1 the acceleration of joint j is larger by 1.
    rows = np.zeros((6, n + 1, n))
    amount = rows[0]
    cosine = rows[1]
    sine = rows[2]
    v = rows[3]
    a = rows[4]
    need = rows[5]
    for j in range(n):
        amount[:, j] = constants[j, SCALE] * q[j]
        v[:, j] = rates[j]
        cosine[:, j] = np.cos(amount[0, j])
        sine[:, j] = np.sin(amount[0, j])
        for m in range(held):
            bent = -shift[m]
            for b in range(6):
                bent += carried[m, b] * still[b]
            a[:, j] += inverse[j, m] * bent
        a[j + 1, j] += 1.0
    inverse_dynamics(links, constants, parameters, amount, cosine, sine, v, a, need)
    inertia = (need[1:] - need[0]).T + np.diag(drives[:, 0])
    for j in range(n):
        need[0, j] += drives[j, 0] * a[0, j] + drives[j, 1] * v[0, j] + drives[j, 3] - tau[j]
        need[0, j] += drives[j, 2] * np.tanh(v[0, j] / drives[j, 4])
    for i in range(r):
        for j in range(n):
            h[i] += J[j, i] * need[0, j]
            for k in range(n):
                for m in range(r):
                    M[i, m] += J[j, i] * inertia[j, k] * J[k, m]


@njit(**INNER)
def _accelerate(robot, values, q, pose, rate, tau, rates, twist, change):
    """Write the accelerations of a state, and correct the gaps of the loops in q and pose.

    Args:
        robot: arrays of L legs with at most B bodies: links (L, B, 4 + B), constants (L, B + 1, 13), tails and
            attachments (L, 4, 4), starts, held, selected, actuated, gravity, and whether the components of the twist
            that are not selected are always zero.
        values: parameters of the legs' bodies (L, 10 B) and of the platform (10,), drives (n_t, 5) Ia Fv Fc off and v0.
        q: (n_t,) values of all joints.
        pose: (4, 4) pose of the platform.
        rate: (r,) independent components v of the platform's twist.
        tau: (n,) torques of the actuators.
        rates, twist, change: results q̇ (n_t,), t (6,) and v̇ (r,).

    Returns:
        An upper bound [1/s] on the fastest decay rate of friction near standstill: the trace of M⁻¹ Jᵀ D J with the
        steepest slopes D of the friction. -1 if M is not positive definite.
    """
    links, constants, tails, attachments, starts, held, selected, actuated, gravity, fixed = robot
    parameters, body, drives = values
    r = rate.shape[0]
    n_t = q.shape[0]
    L = starts.shape[0] - 1
    most = links.shape[1]
    full = np.zeros((L, 6, most))
    inverse = np.zeros((L, most, 6))
    carried = np.zeros((L, 6, 6))
    gap = np.zeros((L, 6))
    lever = np.zeros((L, 3))
    shift = np.zeros((L, 6))
    back = np.zeros((L, 6, 6))
    frame = np.zeros((4, 6 + 3 * most))
    D = np.zeros((6, r))
    J = np.zeros((n_t, r))
    M = np.zeros((r, r))
    whole = np.zeros((6, 6))
    mend = np.zeros(6)
    still = np.zeros(6)
    wrench = np.zeros(6)
    h = np.zeros(r)
    torque = np.zeros(n_t)
    for leg in range(L):
        one_leg(
            links[leg],
            constants[leg],
            tails[leg],
            attachments[leg],
            held[leg],
            q[starts[leg] : starts[leg + 1]],
            pose,
            full[leg],
            inverse[leg],
            carried[leg],
            gap[leg],
            lever[leg],
            frame,
        )
    if fixed:
        for i in range(r):
            D[selected[i], i] = 1.0
    else:
        _freedoms(full, inverse, carried, held, starts, selected, D, back)
        for leg in range(L):
            _add(back[leg], gap[leg], mend)
        _turn(1.0, mend, pose, pose)
    for i in range(6):
        twist[i] = 0.0
    _add(D, rate, twist)
    for i in range(n_t):
        rates[i] = 0.0
    for j in range(actuated.shape[0]):
        torque[actuated[j]] = tau[j]
    for leg in range(L):
        first = starts[leg]
        last = starts[leg + 1]
        _follow(held[leg], inverse[leg], carried[leg], gap[leg], mend, D, q[first:last], J[first:last])
        _add(J[first:last], rate, rates[first:last])
        _bent(full[leg], rates[first:last], twist[3:], lever, leg, shift)
        _add(back[leg], shift[leg], still)
    for leg in range(L):
        first = starts[leg]
        last = starts[leg + 1]
        _leg_share(
            links[leg],
            constants[leg],
            parameters[leg],
            drives[first:last],
            held[leg],
            inverse[leg],
            carried[leg],
            shift[leg],
            still,
            q[first:last],
            rates[first:last],
            torque[first:last],
            J[first:last],
            M,
            h,
        )
    _platform(body, pose, twist[3:], gravity, whole, wrench)
    _add(whole, still, wrench)
    for i in range(r):
        for a in range(6):
            h[i] += D[a, i] * wrench[a]
            for b in range(6):
                for m in range(r):
                    M[i, m] += D[a, i] * whole[a, b] * D[b, m]
    for i in range(r):
        change[i] = -h[i]
    if not factorise(M):
        return -1.0
    substitute(M, change)
    decay = 0.0
    for j in range(n_t):
        slope = drives[j, 1]
        if abs(rates[j]) < STIFF_REACH * drives[j, 4]:
            slope += drives[j, 2] / drives[j, 4]
        if slope != 0.0:
            for i in range(r):
                h[i] = J[j, i]
            substitute(M, h)
            for i in range(r):
                decay += abs(slope * J[j, i] * h[i])
    return decay


@njit(**INNER)
def _turn(factor, twist, pose, out):
    """Write a pose moved by `factor` times a twist [v; ω] (6,): p + v and Exp(ω) R (Rodrigues); `out` may be `pose`."""
    x = factor * twist[3]
    y = factor * twist[4]
    z = factor * twist[5]
    angle = np.sqrt(x * x + y * y + z * z)
    one = np.sin(angle) / angle if angle > 1e-12 else 1.0
    two = 0.5 * (np.sin(0.5 * angle) / (0.5 * angle)) ** 2 if angle > 1e-12 else 0.5
    for k in range(3):
        a = pose[0, k]
        b = pose[1, k]
        c = pose[2, k]
        dx = y * c - z * b
        dy = z * a - x * c
        dz = x * b - y * a
        out[0, k] = a + one * dx + two * (y * dz - z * dy)
        out[1, k] = b + one * dy + two * (z * dx - x * dz)
        out[2, k] = c + one * dz + two * (x * dy - y * dx)
        out[k, 3] = pose[k, 3] + factor * twist[k]


@njit(**OPTIONS)
def run(robot, values, q, pose, rate, mixing, gains, reference, encoder, period, smoothing, late, far, out):
    """Simulate the closed loop: in each period measure, compute the torque, hold it, integrate.

    Args:
        robot, values: see `_accelerate`.
        q, pose, rate: the state at the beginning, overwritten.
        mixing: (N, n, n) matrices by which the feedback is multiplied; an array (0, n, n): none.
        gains: (6, n) of the actuators' controller, reference (4, N, n): see `loop_kernels.closed_loop`.
        encoder: (N, n) noise of the readings.
        far: distance from the reference [rad or m] at which a run has diverged.
        out: (3, N, n) results: true positions, measured positions, torque held during each period.

    Returns:
        Status, and the number of the last simulated period.
    """
    actuated = robot[7]
    n = robot[7].shape[0]
    r = rate.shape[0]
    q2 = q.copy()
    pose2 = pose.copy()
    rate2 = rate.copy()
    rates = np.zeros(q.shape[0])
    change = np.zeros(r)
    twist = np.zeros(6)
    speed = reference[1, 0].copy()
    read = np.zeros(n)
    before = np.zeros(n)
    integral = np.zeros(n)
    wish = np.zeros(n)
    tau = np.zeros(n)
    waiting = np.zeros((late + 1, n))
    for k in range(reference.shape[1]):
        for j in range(n):
            read[j] = q2[actuated[j]] + encoder[k, j]
            if not abs(reference[0, k, j] - read[j]) < far:
                return DIVERGED, k
            if k:
                speed[j] += smoothing * ((read[j] - before[j]) / period - speed[j])
            before[j] = read[j]
        command(gains, reference[0, k], reference[1, k], read, speed, integral, period, wish)
        for j in range(n):
            asked = reference[2, k, j] + (0.0 if mixing.shape[0] else wish[j])
            for m in range(n * (mixing.shape[0] > 0)):
                asked += mixing[k, j, m] * wish[m]
            held = min(max(asked, -gains[4, j]), gains[4, j])
            # The integral does not grow while the torque is at its limit.
            if held != asked and (reference[0, k, j] - read[j]) * asked > 0.0:
                integral[j] -= period * (reference[0, k, j] - read[j])
            waiting[k % (late + 1), j] = held
            tau[j] = waiting[(k + 1) % (late + 1) if k >= late else 0, j]
            out[0, k, j] = q2[actuated[j]]
            out[1, k, j] = read[j]
            out[2, k, j] = tau[j]
        left = period
        span = 0.0
        while left > 1e-9 * period:
            # A single call, since the compiler inlines each call and would take twice as long with two.
            for half in range(2):
                decay = _accelerate(robot, values, q2, pose2, rate2, tau, rates, twist, change)
                if decay < 0.0:
                    return SINGULAR, k
                if not half:
                    pieces = int(left * decay / MIDPOINT_STEP) + 1
                    if pieces * period > 2 * MAX_STEPS * left:
                        return STIFF, k
                    span = left / pieces
                    q[:] = q2
                    pose[:] = pose2
                    rate[:] = rate2
                length = span if half else 0.5 * span
                for i in range(q.shape[0]):
                    q2[i] = q[i] + length * rates[i]
                for i in range(r):
                    rate2[i] = rate[i] + length * change[i]
                _turn(length, twist, pose, pose2)
            left -= span
    return FINE, reference.shape[1]

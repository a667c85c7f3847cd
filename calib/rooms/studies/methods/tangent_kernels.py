"""Compiled derivatives of the closed loop (numba): a simulated motion's Jacobian with respect to parameters.

The exact derivative of what `loop_kernels` computes, step by step. With K = ∂tau/∂q, D = ∂tau/∂v and Y = ∂tau/∂χ of the
inverse dynamics at a state and its accelerations,

    M δa = δtau - K δq - D δv - Y,

c columns at a time, through the stages of Runge and Kutta, the controller and its memory. K and D come from composite
quantities about the base's origin: with ψ̇_i = V_p × S_i and ψ̈_i = A_p × S_i + V_p × ψ̇_i,

    K_ji = S_jᵀ (2 B_i ψ̇_i + I_i ψ̈_i + S_i ×* f_i),   K_ij = S_iᵀ (2 B_i ψ̇_j + I_i ψ̈_j),
    D_ji = S_jᵀ (2 B_i S_i + 2 I_i ψ̇_i),               D_ij = S_iᵀ (2 B_i S_j + 2 I_i ψ̇_j),   j on the way to i

(Singh, Russell & Wensing 2022, one degree of freedom per joint). About one origin 2 B m = [2 P w; 2 w × L] for a twist
m with angular part w: P = -[ω]Σ - [h][ν] and L = m ν + ω × h add up along the tree as the inertias do.

Arrays are those of `loop_kernels`; besides

    find     (p,): column of each parameter among the c, or -1
    order, entries, shares, owners: see `loop_kernels.set_parameters`
    more     (B + 1, 36): acceleration, ψ̇, ψ̈, wrench, P 24 … 32, L 33 … 35
    own      (B, 10): inertia of each body alone
"""

import numpy as np
from numba import njit

from calib.dynamics.kernels import OPTIONS
from calib.rooms.closed_loop.loop_kernels import (
    DIVERGED,
    FINE,
    MAX_STEPS,
    SINGULAR,
    STIFF,
    accelerate,
    act,
    command,
    dynamics,
    linearise_command,
    set_parameters,
    stiffness,
    substitute,
)


@njit(**OPTIONS)
def _outward(tree, body, v, a, work, own, more):
    """Write accelerations, ψ̇ and ψ̈, and each body's inertia, wrench, P and L; `work` is that of `dynamics`."""
    count = tree.shape[0]
    for i in range(count):
        for r in range(10):
            own[i, r] = work[i, 36 + r]
    for i in range(count):
        p = tree[i, 0]
        if p < count:
            for r in range(10):
                own[p, r] -= work[i, 36 + r]
    for r in range(36):
        more[count, r] = 0.0
    more[count, 3], more[count, 4], more[count, 5] = body[count, 0], body[count, 1], body[count, 2]
    for i in range(count):
        p, c = tree[i, 0], tree[i, 2]
        rate, change = (v[c], a[c]) if c >= 0 else (0.0, 0.0)
        wx, wy, wz, nx, ny, nz = work[p, 12], work[p, 13], work[p, 14], work[p, 15], work[p, 16], work[p, 17]
        bx, by, bz, ax, ay, az = more[p, 0], more[p, 1], more[p, 2], more[p, 3], more[p, 4], more[p, 5]
        ux, uy, uz, sx, sy, sz = work[i, 24], work[i, 25], work[i, 26], work[i, 27], work[i, 28], work[i, 29]
        ex, ey, ez = wy * uz - wz * uy, wz * ux - wx * uz, wx * uy - wy * ux
        fx = wy * sz - wz * sy + ny * uz - nz * uy
        fy = wz * sx - wx * sz + nz * ux - nx * uz
        fz = wx * sy - wy * sx + nx * uy - ny * ux
        more[i, 6], more[i, 7], more[i, 8], more[i, 9], more[i, 10], more[i, 11] = ex, ey, ez, fx, fy, fz
        more[i, 12] = by * uz - bz * uy + wy * ez - wz * ey
        more[i, 13] = bz * ux - bx * uz + wz * ex - wx * ez
        more[i, 14] = bx * uy - by * ux + wx * ey - wy * ex
        more[i, 15] = by * sz - bz * sy + ay * uz - az * uy + wy * fz - wz * fy + ny * ez - nz * ey
        more[i, 16] = bz * sx - bx * sz + az * ux - ax * uz + wz * fx - wx * fz + nz * ex - nx * ez
        more[i, 17] = bx * sy - by * sx + ax * uy - ay * ux + wx * fy - wy * fx + nx * ey - ny * ex
        bx, by, bz = bx + rate * ex + change * ux, by + rate * ey + change * uy, bz + rate * ez + change * uz
        ax, ay, az = ax + rate * fx + change * sx, ay + rate * fy + change * sy, az + rate * fz + change * sz
        more[i, 0], more[i, 1], more[i, 2], more[i, 3], more[i, 4], more[i, 5] = bx, by, bz, ax, ay, az
        wx, wy, wz, nx, ny, nz = work[i, 12], work[i, 13], work[i, 14], work[i, 15], work[i, 16], work[i, 17]
        jxx, jxy, jxz, jyy, jyz, jzz = own[i, 0], own[i, 1], own[i, 2], own[i, 3], own[i, 4], own[i, 5]
        hx, hy, hz, mass = own[i, 6], own[i, 7], own[i, 8], own[i, 9]
        lx, ly, lz = mass * nx + wy * hz - wz * hy, mass * ny + wz * hx - wx * hz, mass * nz + wx * hy - wy * hx
        kx = jxx * wx + jxy * wy + jxz * wz + hy * nz - hz * ny
        ky = jxy * wx + jyy * wy + jyz * wz + hz * nx - hx * nz
        kz = jxz * wx + jyz * wy + jzz * wz + hx * ny - hy * nx
        more[i, 18] = jxx * bx + jxy * by + jxz * bz + hy * az - hz * ay + wy * kz - wz * ky + ny * lz - nz * ly
        more[i, 19] = jxy * bx + jyy * by + jyz * bz + hz * ax - hx * az + wz * kx - wx * kz + nz * lx - nx * lz
        more[i, 20] = jxz * bx + jyz * by + jzz * bz + hx * ay - hy * ax + wx * ky - wy * kx + nx * ly - ny * lx
        more[i, 21] = mass * ax + by * hz - bz * hy + wy * lz - wz * ly
        more[i, 22] = mass * ay + bz * hx - bx * hz + wz * lx - wx * lz
        more[i, 23] = mass * az + bx * hy - by * hx + wx * ly - wy * lx
        half = 0.5 * (jxx + jyy + jzz)
        xx, yy, zz, dot = half - jxx, half - jyy, half - jzz, hx * nx + hy * ny + hz * nz
        # P = -[ω] Σ - [h][ν], [h][ν] = ν hᵀ - (h·ν) 1; Σ has the off-diagonals of -J
        more[i, 24] = -(wy * -jxz - wz * -jxy) - (nx * hx - dot)
        more[i, 25] = -(wy * -jyz - wz * yy) - nx * hy
        more[i, 26] = -(wy * zz - wz * -jyz) - nx * hz
        more[i, 27] = -(wz * xx - wx * -jxz) - ny * hx
        more[i, 28] = -(wz * -jxy - wx * -jyz) - (ny * hy - dot)
        more[i, 29] = -(wz * -jxz - wx * zz) - ny * hz
        more[i, 30] = -(wx * -jxy - wy * xx) - nz * hx
        more[i, 31] = -(wx * yy - wy * -jxy) - nz * hy
        more[i, 32] = -(wx * -jyz - wy * -jxz) - (nz * hz - dot)
        more[i, 33], more[i, 34], more[i, 35] = lx, ly, lz


@njit(**OPTIONS)
def _slopes(tree, work, more, by_q, by_v):
    """Add the bodies' part of K and D (n, n), summing composite quantities from the tips to the base."""
    count = tree.shape[0]
    for i in range(count - 1, -1, -1):
        p, c = tree[i, 0], tree[i, 2]
        if c >= 0:
            ux, uy, uz, sx, sy, sz = work[i, 24], work[i, 25], work[i, 26], work[i, 27], work[i, 28], work[i, 29]
            jxx, jxy, jxz = work[i, 36], work[i, 37], work[i, 38]
            jyy, jyz, jzz = work[i, 39], work[i, 40], work[i, 41]
            hx, hy, hz, mass = work[i, 42], work[i, 43], work[i, 44], work[i, 45]
            p0, p1, p2, p3, p4 = more[i, 24], more[i, 25], more[i, 26], more[i, 27], more[i, 28]
            p5, p6, p7, p8 = more[i, 29], more[i, 30], more[i, 31], more[i, 32]
            lx, ly, lz = more[i, 33], more[i, 34], more[i, 35]
            # y = I S and x = Pᵀ u + L × s
            yx = jxx * ux + jxy * uy + jxz * uz + hy * sz - hz * sy
            yy = jxy * ux + jyy * uy + jyz * uz + hz * sx - hx * sz
            yz = jxz * ux + jyz * uy + jzz * uz + hx * sy - hy * sx
            gx, gy, gz = mass * sx + uy * hz - uz * hy, mass * sy + uz * hx - ux * hz, mass * sz + ux * hy - uy * hx
            xx = p0 * ux + p3 * uy + p6 * uz + ly * sz - lz * sy
            xy = p1 * ux + p4 * uy + p7 * uz + lz * sx - lx * sz
            xz = p2 * ux + p5 * uy + p8 * uz + lx * sy - ly * sx
            wx, wy, wz, nx, ny, nz = more[i, 6], more[i, 7], more[i, 8], more[i, 9], more[i, 10], more[i, 11]
            bx, by, bz, ax, ay, az = more[i, 12], more[i, 13], more[i, 14], more[i, 15], more[i, 16], more[i, 17]
            tx, ty, tz, fx, fy, fz = more[i, 18], more[i, 19], more[i, 20], more[i, 21], more[i, 22], more[i, 23]
            # by q: 2 B ψ̇ + I ψ̈ + S ×* f
            q0 = 2.0 * (p0 * wx + p1 * wy + p2 * wz) + jxx * bx + jxy * by + jxz * bz + hy * az - hz * ay
            q1 = 2.0 * (p3 * wx + p4 * wy + p5 * wz) + jxy * bx + jyy * by + jyz * bz + hz * ax - hx * az
            q2 = 2.0 * (p6 * wx + p7 * wy + p8 * wz) + jxz * bx + jyz * by + jzz * bz + hx * ay - hy * ax
            q0 += uy * tz - uz * ty + sy * fz - sz * fy
            q1 += uz * tx - ux * tz + sz * fx - sx * fz
            q2 += ux * ty - uy * tx + sx * fy - sy * fx
            q3 = 2.0 * (wy * lz - wz * ly) + mass * ax + by * hz - bz * hy + uy * fz - uz * fy
            q4 = 2.0 * (wz * lx - wx * lz) + mass * ay + bz * hx - bx * hz + uz * fx - ux * fz
            q5 = 2.0 * (wx * ly - wy * lx) + mass * az + bx * hy - by * hx + ux * fy - uy * fx
            # by v: 2 B S + 2 I ψ̇
            v0 = 2.0 * (p0 * ux + p1 * uy + p2 * uz + jxx * wx + jxy * wy + jxz * wz + hy * nz - hz * ny)
            v1 = 2.0 * (p3 * ux + p4 * uy + p5 * uz + jxy * wx + jyy * wy + jyz * wz + hz * nx - hx * nz)
            v2 = 2.0 * (p6 * ux + p7 * uy + p8 * uz + jxz * wx + jyz * wy + jzz * wz + hx * ny - hy * nx)
            v3 = 2.0 * (uy * lz - uz * ly + mass * nx + wy * hz - wz * hy)
            v4 = 2.0 * (uz * lx - ux * lz + mass * ny + wz * hx - wx * hz)
            v5 = 2.0 * (ux * ly - uy * lx + mass * nz + wx * hy - wy * hx)
            by_q[c, c] += ux * q0 + uy * q1 + uz * q2 + sx * q3 + sy * q4 + sz * q5
            by_v[c, c] += ux * v0 + uy * v1 + uz * v2 + sx * v3 + sy * v4 + sz * v5
            k = p
            while k < count:
                d = tree[k, 2]
                if d >= 0:
                    ax, ay, az, bx, by, bz = (
                        work[k, 24],
                        work[k, 25],
                        work[k, 26],
                        work[k, 27],
                        work[k, 28],
                        work[k, 29],
                    )
                    by_q[d, c] += ax * q0 + ay * q1 + az * q2 + bx * q3 + by * q4 + bz * q5
                    by_v[d, c] += ax * v0 + ay * v1 + az * v2 + bx * v3 + by * v4 + bz * v5
                    ex, ey, ez, ox, oy, oz = more[k, 6], more[k, 7], more[k, 8], more[k, 9], more[k, 10], more[k, 11]
                    once = yx * ex + yy * ey + yz * ez + gx * ox + gy * oy + gz * oz
                    by_v[c, d] += 2.0 * (xx * ax + xy * ay + xz * az + once)
                    twice = yx * more[k, 12] + yy * more[k, 13] + yz * more[k, 14]
                    twice += gx * more[k, 15] + gy * more[k, 16] + gz * more[k, 17]
                    by_q[c, d] += 2.0 * (xx * ex + xy * ey + xz * ez) + twice
                k = tree[k, 0]
        if p < count:
            for r in range(18, 36):
                more[p, r] += more[i, r]


@njit(**OPTIONS)
def _columns(tree, order, find, work, more, ten, out):
    """Add the derivatives Y (n, c) with respect to the bodies' parameters that have a column."""
    count = tree.shape[0]
    for i in range(count):
        wanted = False
        for k in range(10):
            wanted = wanted or find[10 * i + order[i, k]] >= 0
        if not wanted:
            continue
        r00, r01, r02 = work[i, 0], work[i, 1], work[i, 2]
        r10, r11, r12 = work[i, 3], work[i, 4], work[i, 5]
        r20, r21, r22 = work[i, 6], work[i, 7], work[i, 8]
        x, y, z = work[i, 9], work[i, 10], work[i, 11]
        gx, gy, gz = work[i, 12], work[i, 13], work[i, 14]
        wx, wy, wz = r00 * gx + r10 * gy + r20 * gz, r01 * gx + r11 * gy + r21 * gz, r02 * gx + r12 * gy + r22 * gz
        fx, fy, fz = work[i, 15] + gy * z - gz * y, work[i, 16] + gz * x - gx * z, work[i, 17] + gx * y - gy * x
        bx, by, bz = more[i, 0], more[i, 1], more[i, 2]
        # acceleration of the body's origin: spatial, moved there, and ω × ν
        ax = more[i, 3] + by * z - bz * y + gy * fz - gz * fy
        ay = more[i, 4] + bz * x - bx * z + gz * fx - gx * fz
        az = more[i, 5] + bx * y - by * x + gx * fy - gy * fx
        ax, ay, az = r00 * ax + r10 * ay + r20 * az, r01 * ax + r11 * ay + r21 * az, r02 * ax + r12 * ay + r22 * az
        bx, by, bz = r00 * bx + r10 * by + r20 * bz, r01 * bx + r11 * by + r21 * bz, r02 * bx + r12 * by + r22 * bz
        j = i
        while j < count:
            d = tree[j, 2]
            if d >= 0:
                ux, uy, uz = work[j, 24], work[j, 25], work[j, 26]
                sx, sy, sz = work[j, 27] + uy * z - uz * y, work[j, 28] + uz * x - ux * z, work[j, 29] + ux * y - uy * x
                ux, uy, uz = (
                    r00 * ux + r10 * uy + r20 * uz, r01 * ux + r11 * uy + r21 * uz, r02 * ux + r12 * uy + r22 * uz
                )  # fmt: skip
                sx, sy, sz = (
                    r00 * sx + r10 * sy + r20 * sz, r01 * sx + r11 * sy + r21 * sz, r02 * sx + r12 * sy + r22 * sz
                )  # fmt: skip
                zx, zy, zz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
                ten[0], ten[3], ten[5] = ux * bx + zx * wx, uy * by + zy * wy, uz * bz + zz * wz
                ten[1] = ux * by + uy * bx + zx * wy + zy * wx
                ten[2] = ux * bz + uz * bx + zx * wz + zz * wx
                ten[4] = uy * bz + uz * by + zy * wz + zz * wy
                ex, ey, ez = sy * wz - sz * wy, sz * wx - sx * wz, sx * wy - sy * wx
                ten[6] = ay * uz - az * uy + sy * bz - sz * by + ey * wz - ez * wy
                ten[7] = az * ux - ax * uz + sz * bx - sx * bz + ez * wx - ex * wz
                ten[8] = ax * uy - ay * ux + sx * by - sy * bx + ex * wy - ey * wx
                ten[9] = sx * ax + sy * ay + sz * az
                for k in range(10):
                    column = find[10 * i + order[i, k]]
                    if column >= 0:
                        out[d, column] += ten[k]
            j = tree[j, 0]


@njit(**OPTIONS)
def _linearise(
    tree, body, linear, kinds, acts, order, entries, shares, owners, find, memory, q, v, a, work, own, more, ten,
    by_q, by_v, out,
):  # fmt: skip
    """Write K, D (n, n) and Y (n, c) of the inverse dynamics at q, v, a; `work` is that of `dynamics`."""
    n = q.shape[0]
    by_q[:] = 0.0
    out[:] = 0.0
    for j in range(n):
        for k in range(n):
            by_v[j, k] = linear[j, n + k]
    _outward(tree, body, v, a, work, own, more)
    if find.shape[0]:
        _columns(tree, order, find, work, more, ten, out)
    _slopes(tree, work, more, by_q, by_v)
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


@njit(**OPTIONS)
def _solve(matrix, by_q, by_v, columns, dq, dv, dtau, out):
    """Write M⁻¹ (δtau - K δq - D δv - Y) into out (n, c); M is given factorised."""
    n, c = out.shape
    for j in range(n):
        for m in range(c):
            out[j, m] = dtau[j, m] - columns[j, m]
        for k in range(n):
            one, other = by_q[j, k], by_v[j, k]
            for m in range(c):
                out[j, m] -= one * dq[k, m] + other * dv[k, m]
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


@njit(**OPTIONS)
def _advance_tangent(
    plant, layout, memory, loads, q, v, dq, dv, tau, dtau, period, slopes, dslopes, work, matrix, rooms
):  # fmt: skip
    """Advance q, v (n,) and δq, δv (n, c) by one period as `loop_kernels.advance` does; `slopes[0]` is not used."""
    tree, body, linear, kinds, acts = plant
    own, more, ten, by_q, by_v, columns, at, rate, dat, drate = rooms
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
            where = (at, rate, slopes[stage], work, own, more, ten, by_q, by_v, columns)
            _linearise(tree, body, linear, kinds, acts, *layout, memory, *where)  # pyright: ignore[reportCallIssue]
            _solve(matrix, by_q, by_v, columns, dat, drate, dtau, dslopes[stage])
        for j in range(n):
            first, inner, last = slopes[0, j], slopes[1, j] + slopes[2, j], slopes[3, j]
            q[j] += span * (v[j] + span / 6.0 * (first + inner))
            v[j] += span / 6.0 * (first + 2.0 * inner + last)
            for m in range(c):
                one, middle, other = dslopes[0, j, m], dslopes[1, j, m] + dslopes[2, j, m], dslopes[3, j, m]
                dq[j, m] += span * (dv[j, m] + span / 6.0 * (one + middle))
                dv[j, m] += span / 6.0 * (one + 2.0 * middle + other)
    return FINE


@njit(**OPTIONS)
def _workspace(bodies, n, c):
    """Return the work arrays of `_advance_tangent`."""
    own, more, ten = np.empty((bodies, 10)), np.empty((bodies + 1, 36)), np.empty(10)
    square, wide = (np.empty((n, n)), np.empty((n, n))), np.empty((n, c))
    return own, more, ten, square[0], square[1], wide, np.empty(n), np.empty(n), np.empty((n, c)), np.empty((n, c))


@njit(**OPTIONS)
def advance_linearised(plant, layout, values, q, v, tau, period, gain, dq, dv):
    """Advance a state q, v (n,) by a period under one torque (n,); write its Jacobian into dq and dv.

    dq, dv (n, 2 n + c): slopes by q, v and the c parameters of `layout`, whose columns start at 2 n. Writes M⁻¹ into
    gain (n, n); returns a status.
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


@njit(**OPTIONS)
def _command_tangent(
    plant, layout, model, empty, gains, relative, ahead, read, speed, dread, dspeed, dintegral, feedback, wish, dwish,
    work, matrix, rooms,
):  # fmt: skip
    """Write the derivatives (n, c) of the command before saturation; feedback (n,) is its feedback part."""
    own, more, ten, by_q, by_v, columns, at, _, dat, _ = rooms
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
        where = (read, speed, at, work, own, more, ten, by_q, by_v, columns)
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
    plant, layout, model, gains, relative, reference, period, smoothing, late, every, q, v, count, out, dout
):  # fmt: skip
    """Write the noise-free motion of `loop_kernels.closed_loop` with its tangents. Return (status, period reached).

    relative (n, c): slopes of the gains' common factor, joint by joint, over that factor; zero for gains that stay.
    `out` (3, M, n): q, v, torque; `dout` (3, M, n, c) their tangents, every `every` periods.
    """
    tree, linear, kinds = plant[0], plant[2], plant[3]
    n, c = relative.shape
    work, matrix = np.empty((tree.shape[0] + 1, 46)), np.empty((n, n))
    slopes, dslopes = np.zeros((4, n)), np.zeros((4, n, c))
    rooms, empty = _workspace(tree.shape[0], n, c), np.empty(0, dtype=np.int64)
    memory, loads = np.zeros((kinds.shape[0], 2)), np.zeros(n)
    speed, before, integral, wish, feedback = np.zeros(n), np.empty(n), np.zeros(n), np.empty(n), np.empty(n)
    tau, waiting = np.empty(n), np.zeros((late + 1, n))
    dq, dv, dspeed, dbefore = np.zeros((n, c)), np.zeros((n, c)), np.zeros((n, c)), np.zeros((n, c))
    dintegral, dwish, dtau, dwaiting = np.zeros((n, c)), np.zeros((n, c)), np.zeros((n, c)), np.zeros((late + 1, n, c))
    sample = 0
    for k in range(count):
        if k == 0:
            speed[:] = v
        else:
            for j in range(n):  # rounded as in `loop_kernels.closed_loop`
                speed[j] += smoothing * ((q[j] - before[j]) / period - speed[j])
            dspeed += smoothing * ((dq - dbefore) / period - dspeed)
        before[:], dbefore[:] = q, dq
        command(gains, reference[0, k], reference[1, k], q, speed, integral, period, feedback)
        for j in range(n):
            if abs(integral[j]) < gains[5, j]:
                dintegral[j] -= period * dq[j]
            else:
                dintegral[j] = 0.0
        _command_tangent(
            plant, layout, model, empty, gains, relative, reference[3, k], q, speed, dq, dspeed, dintegral, feedback,
            wish, dwish, work, matrix, rooms,
        )  # fmt: skip
        wish[:] = feedback
        if model.shape[0]:
            linearise_command(tree, model, linear, reference[3, k], q, speed, work, matrix, wish)
        wish += reference[2, k]
        now, old = k % (late + 1), (k + 1) % (late + 1) if k >= late else 0
        for j in range(n):
            held = min(max(wish[j], -gains[4, j]), gains[4, j])
            error = reference[0, k, j] - q[j]
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

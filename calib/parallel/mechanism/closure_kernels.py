"""Compiled kernels (numba) of closed loops: Jacobians and gaps of the legs at given postures, least squares.

A leg is given by the arrays ``links`` and ``constants`` of its `Bodies`, whose frames are turned so that the joint's
axis is z; ``tail`` (4, 4) is the pose of the leg's end in its last frame. ``pose`` (4, 4) is the platform's pose; c of
a leg's six closure equations are used. The kernels loop over elements, because numba takes several times as long to
compile array expressions. All arrays have one memory layout (C order, size of the largest leg), so that each kernel is
compiled once.
"""

from math import copysign, sqrt

import numpy as np
from numba import njit

from calib.dynamics.kernels import INNER, OPTIONS

# Column of `links` with the kind of the joint, and the kind of revolute joints.
KIND = 1
REVOLUTE = 1
# Column of `constants` with the factor on the joint's value.
SCALE = 12


@njit(**INNER)
def invert(A, out):
    """Write A⁻¹ (n, n) into `out` by Gauss–Jordan elimination with row pivots; A is overwritten.

    A zero pivot is replaced by a tiny one, so that the inverse of a singular matrix has huge entries.
    """
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            out[i, j] = 1.0 if i == j else 0.0
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


@njit(**INNER)
def one_leg(links, constants, tail, attachment, held, q, pose, full, inverse, carried, gap, lever, frame):
    """Write Jacobians and gap of one leg at one posture; see `calib.parallel.mechanism.closure.LegLinks`.

    All arrays may be larger than stated.

    Args:
        links, constants, tail, attachment: arrays of the leg, see the module.
        held: number c of closure equations.
        q: (n,) joint values.
        pose: (4, 4) pose of the platform.
        full, inverse, carried, gap, lever: (6, n), (n, c), (c, 6), (c,), (3,) results; `carried` is zero on entry.
        frame: (4, 6 + 3 n) memory for intermediate results.
    """
    n = q.shape[0]
    r = frame[:3, :3]
    o = frame[3, :3]
    place = frame[:3, 3:6]
    for i in range(3):
        o[i] = 0.0
        for k in range(3):
            r[i, k] = 1.0 if i == k else 0.0
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
            cosine = np.cos(amount)
            sine = np.sin(amount)
            for i in range(3):
                r[i, 0] = cosine * place[i, 0] + sine * place[i, 1]
                r[i, 1] = cosine * place[i, 1] - sine * place[i, 0]
                r[i, 2] = place[i, 2]
                full[i, j] = 0.0
                full[3 + i, j] = constants[j, SCALE] * place[i, 2]
        else:
            for i in range(3):
                for k in range(3):
                    r[i, k] = place[i, k]
                o[i] += amount * place[i, 2]
                full[i, j] = constants[j, SCALE] * place[i, 2]
                full[3 + i, j] = 0.0
    for i in range(3):
        lever[i] = pose[i, 0] * attachment[0, 3] + pose[i, 1] * attachment[1, 3] + pose[i, 2] * attachment[2, 3]
        o[i] += r[i, 0] * tail[0, 3] + r[i, 1] * tail[1, 3] + r[i, 2] * tail[2, 3]
        gap[i] = o[i] - pose[i, 3] - lever[i]
        carried[i, i] = 1.0
    carried[0, 4] = lever[2]
    carried[1, 5] = lever[0]
    carried[2, 3] = lever[1]
    carried[0, 5] = -lever[1]
    carried[1, 3] = -lever[2]
    carried[2, 4] = -lever[0]
    for j in range(n):
        if links[j, KIND] == REVOLUTE:
            x = o[0] - frame[0, 6 + j]
            y = o[1] - frame[1, 6 + j]
            z = o[2] - frame[2, 6 + j]
            full[0, j] = full[4, j] * z - full[5, j] * y
            full[1, j] = full[5, j] * x - full[3, j] * z
            full[2, j] = full[3, j] * y - full[4, j] * x
    if held == 6:
        for i in range(3):
            carried[3 + i, 3 + i] = 1.0
        # orientations: the end's in `place`, the attachment's in `r`; the gap is the skew part of end · attachmentᵀ
        for i in range(3):
            for k in range(3):
                place[i, k] = r[i, 0] * tail[0, k] + r[i, 1] * tail[1, k] + r[i, 2] * tail[2, k]
        for i in range(3):
            for k in range(3):
                r[i, k] = 0.0
                for m in range(3):
                    r[i, k] += pose[i, m] * attachment[m, k]
        for i in range(3):
            a = (i + 1) % 3
            b = (i + 2) % 3
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
    """Write Jacobians and gap of one leg at N postures; arrays as in `one_leg`, with a leading axis of length N."""
    frame = np.empty((4, 6 + 3 * q.shape[1]))
    for s in range(q.shape[0]):
        one_leg(
            links,
            constants,
            tail,
            attachment,
            gap.shape[1],
            q[s],
            pose[s],
            full[s],
            inverse[s],
            carried[s],
            gap[s],
            lever[s],
            frame,
        )


@njit(**OPTIONS)
def least_squares(A, B, out):
    """Write the solutions (N, k, l) of A x = B in the sense of least squares to `out`, sample by sample.

    Householder reflections without pivots; infinite or not numbers where columns of A depend on one another.

    Args:
        A: (N, m, k) matrices, m >= k, overwritten by their triangles.
        B: (N, m, l) right-hand sides, overwritten.
        out: (N, k, l) array to write.
    """
    m, k, right = A.shape[1], A.shape[2], B.shape[2]
    for s in range(A.shape[0]):
        for c in range(k):
            square = 0.0
            for i in range(c, m):
                square += A[s, i, c] ** 2
            corner = -copysign(sqrt(square), A[s, c, c])
            # the reflection is 1 - v vᵀ / half, with v in column c
            A[s, c, c] -= corner
            half = -corner * A[s, c, c]
            for j in range(c + 1, k):
                along = 0.0
                for i in range(c, m):
                    along += A[s, i, c] * A[s, i, j]
                along /= half
                for i in range(c, m):
                    A[s, i, j] -= along * A[s, i, c]
            for j in range(right):
                along = 0.0
                for i in range(c, m):
                    along += A[s, i, c] * B[s, i, j]
                along /= half
                for i in range(c, m):
                    B[s, i, j] -= along * A[s, i, c]
            A[s, c, c] = corner
        for j in range(right):
            for c in range(k - 1, -1, -1):
                total = B[s, c, j]
                for i in range(c + 1, k):
                    total -= A[s, c, i] * out[s, i, j]
                out[s, c, j] = total / A[s, c, c]

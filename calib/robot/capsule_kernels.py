"""Collision test of an arm made of capsules, compiled with numba: each posture ends at its first pair in collision.

A path search tests a few postures at a time, thousands of times. The overhead of NumPy's calls would cost more than the
arithmetic. The arguments are:

    form      (K, 5) elements of the chain: axis (0 to 5 as `calib.robot.chain.AXES`), sign, value, ratio, joint
              (-1: constant)
    fixed     (K + 1, 12) fixed transforms: rotation by rows and origin before each element; row K is the tail
    attached  (E, 7) links outside the chain: number of moving elements before the link; start and end of its capsule
              in the frame of the last of these elements [m]
    targets   (T, 3) measured targets in the tip's frame [m]
    pairs     (P, 2) indices of capsules to compare with each other
    radii     (C,) radii of the capsules [m]
    faces     (W, 5) walls to compare with a capsule: index of the capsule, normal, offset
"""

from math import cos, sin, sqrt

import numpy as np
from numba import njit
from numba.extending import register_jitable

OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
INNER = {**OPTIONS, "no_cpython_wrapper": True}  # of functions that kernels alone call
# of functions that are called with constants, for each of which njit would compile them
joined = register_jitable(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


@njit(**OPTIONS)
def clear(q, form, fixed, stand, attached, targets, pairs, radii, faces, margin):
    """Return at which joint values q (m, n) all distances of `pairs` and `faces` exceed `margin` [m], (m,) bool.

    Args:
        q: (m, n) joint values [rad or m].
        form, fixed, attached, targets, pairs, radii, faces: arrays of the capsule model, described in the module's
            docstring.
        stand: height [m] of the lower end of the base's capsule.
        margin: least distance [m].
    """
    count, moving = len(form), 0
    for k in range(count):
        moving += form[k, 4] >= 0
    lines = np.empty((moving + 1 + len(attached) + len(targets), 6))
    is_free = np.ones(len(q), dtype=np.bool_)
    for i in range(len(q)):
        _lines(q[i], form, fixed, stand, attached, targets, lines)
        for p in range(len(faces)):
            c = int(faces[p, 0])
            start_height = faces[p, 1] * lines[c, 0] + faces[p, 2] * lines[c, 1] + faces[p, 3] * lines[c, 2]
            end_height = faces[p, 1] * lines[c, 3] + faces[p, 2] * lines[c, 4] + faces[p, 3] * lines[c, 5]
            if not min(start_height, end_height) - faces[p, 4] - radii[c] > margin:
                is_free[i] = False
                break
        if not is_free[i]:
            continue
        for p in range(len(pairs)):
            a, b = pairs[p, 0], pairs[p, 1]
            if not _apart(lines[a], lines[b]) - (radii[a] + radii[b]) > margin:
                is_free[i] = False
                break
    return is_free


@njit(**INNER)
def _lines(q, form, fixed, stand, attached, targets, lines):
    """Write the centre lines of all capsules into `lines`: base, moving bodies, links outside the chain, targets.

    Args:
        q: (n,) joint values of one posture [rad or m].
        form, fixed, attached, targets: arrays of the capsule model, described in the module's docstring.
        stand: height [m] of the lower end of the base's capsule.
        lines: array to write, one row per capsule: start and end (6) [m].
    """
    r, x, rotated = np.zeros((3, 3)), np.zeros(3), np.empty((3, 3))
    r[0, 0] = r[1, 1] = r[2, 2] = 1.0
    lines[0] = 0.0
    lines[0, 2] = stand
    body, first = 0, len(lines) - len(attached) - len(targets)
    _carry(r, x, 0, attached, lines, first)
    for k in range(len(form) + 1):
        frame = fixed[k]
        for a in range(3):
            x[a] += r[a, 0] * frame[9] + r[a, 1] * frame[10] + r[a, 2] * frame[11]
        for a in range(3):
            for b in range(3):
                rotated[a, b] = r[a, 0] * frame[b] + r[a, 1] * frame[3 + b] + r[a, 2] * frame[6 + b]
        for a in range(3):
            for b in range(3):
                r[a, b] = rotated[a, b]
        if k == len(form):
            break
        axis, sign, joint = int(form[k, 0]) % 3, form[k, 1], int(form[k, 4])
        displacement = form[k, 2]
        if joint >= 0:
            displacement += form[k, 3] * q[joint]
            _put(x, lines, body, 3)
            body += 1
            _put(x, lines, body, 0)
        if form[k, 0] < 3:
            for a in range(3):
                x[a] += sign * displacement * r[a, axis]
            if joint >= 0:
                _put(x, lines, body, 0)
        else:
            co, si = cos(sign * displacement), sin(sign * displacement)
            next_axis, last_axis = (axis + 1) % 3, (axis + 2) % 3
            for a in range(3):
                u, v = r[a, next_axis], r[a, last_axis]
                r[a, next_axis], r[a, last_axis] = co * u + si * v, co * v - si * u
        if joint >= 0:
            _carry(r, x, body, attached, lines, first)
    _put(x, lines, body, 3)
    first += len(attached)
    for t in range(len(targets)):
        for a in range(3):
            lines[first + t, a] = x[a]
            lines[first + t, 3 + a] = x[a] + r[a, 0] * targets[t, 0] + r[a, 1] * targets[t, 1] + r[a, 2] * targets[t, 2]


@joined
def _carry(r, x, body, attached, lines, first):
    """Write the centre lines of the links fixed to a body into `lines`, from row `first` on.

    Args:
        r, x: rotation (3, 3) and origin (3,) of the body's frame in the base.
        body: number of moving elements before the body.
        attached: links outside the chain, as in the module's docstring.
        lines: array to write, one row per capsule: start and end (6) [m].
        first: row of the first link.
    """
    for e in range(len(attached)):
        if attached[e, 0] == body:
            for a in range(3):
                for end in range(2):
                    b = 1 + 3 * end
                    lines[first + e, 3 * end + a] = (
                        x[a] + r[a, 0] * attached[e, b] + r[a, 1] * attached[e, b + 1] + r[a, 2] * attached[e, b + 2]
                    )


@joined
def _put(x, lines, row, first):
    """Write x (3,) into row `row` of `lines`, starting at column `first` (numba compiles slices slowly)."""
    for a in range(3):
        lines[row, first + a] = x[a]


@njit(**INNER)
def _apart(first, second):
    """Return the distance [m] between the line segments `first` and `second` (6,), each given by start and end.

    The method is that of Ericson (2005), 5.1.9.
    """
    uu = vv = uv = uw = vw = 0.0
    for a in range(3):
        u, v, w = first[3 + a] - first[a], second[3 + a] - second[a], first[a] - second[a]
        uu, vv, uv, uw, vw = uu + u * u, vv + v * v, uv + u * v, uw + u * w, vw + v * w
    uu, vv = max(uu, 1e-18), max(vv, 1e-18)
    across = uu * vv - uv**2
    s = min(max((uv * vw - vv * uw) / across, 0.0), 1.0) if across > 1e-12 * uu * vv else 0.5
    t = min(max((uv * s + vw) / vv, 0.0), 1.0)
    s = min(max((uv * t - uw) / uu, 0.0), 1.0)
    total = 0.0
    for a in range(3):
        difference = second[a] + t * (second[3 + a] - second[a]) - first[a] - s * (first[3 + a] - first[a])
        total += difference * difference
    return sqrt(total)

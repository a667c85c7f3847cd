"""Compiled shapes (numba) of friction and other drive torques, used for arrays of samples and in simulations.

Each shape is a formula with its derivatives. One row of `acts` contains a shape's settings, from column 1 on, in the
order of `calib.dynamics.shapes.SHAPES`; the simulator uses the other columns. The settings of a table are the number of
its knots, the column from which the knots stand (place, value, slope), its steepest slope, and the place of its last
knot. The code of a shape is the constant with the shape's name.
"""

from math import cos, exp, isinf, pi, sin, sqrt, tanh

from numba import njit

from calib.dynamics.kernels import INNER, OPTIONS, joined

ACCELERATION, VELOCITY, ONE, POSITION, SIGN, DEAD, SPEED, CUBIC, ROOT = range(9)
STRIBECK, LOAD, LOAD_VELOCITY, STOP, PRESLIDING, SINE, COSINE, SINE_BAND, COSINE_BAND = range(9, 18)
VELOCITY_TABLE, POSITION_TABLE = 18, 19
FADE = 0.1
"""Travel over which ripple of a band fades outside the positions it was identified at [rad]."""


@joined
def smooth_sign(v, v0):
    """Return tanh(v / v0), set to ±1 where it differs only by rounding; the exact sign for v0 = 0."""
    if not v0 > 0.0:
        if v > 0.0:
            return 1.0
        if v < 0.0:
            return -1.0
        return 0.0
    scaled = v / v0
    if scaled > 20.0:
        return 1.0
    if scaled < -20.0:
        return -1.0
    return tanh(scaled)


@joined
def _sign_slope(sign, v0):
    """Return the derivative of `smooth_sign` with respect to v, given its value `sign` and its width `v0`."""
    return (1.0 - sign * sign) / v0 if v0 > 0.0 else 0.0


@joined
def _band(acts, t, x, v):
    """Return the gain of torque ripple that is identified for one frequency band and one direction of motion.

    The gain is a triangular function of the frequency order · |v| / 2π [Hz]. Beyond the positions of the identification
    (lower … upper) it decreases to zero within `FADE`.

    Args:
        acts: array of settings, one row per shape.
        t: row of this shape.
        x, v: position and velocity [rad or m, per s].
    """
    left = acts[t, 2]
    middle = acts[t, 3]
    right = acts[t, 4]
    lower = acts[t, 6]
    upper = acts[t, 7]
    frequency = abs(v) * acts[t, 1] / (2.0 * pi)
    falls = 1.0 if isinf(right) else (right - frequency) / (right - middle)
    gain = min(1.0, max(0.0, min((frequency - left) / (middle - left), falls)))
    if not acts[t, 5] * v > 0.0 or gain == 0.0:
        return 0.0
    excess = max(max(lower - x, x - upper), 0.0)
    return gain * min(1.0, max(0.0, 1.0 - excess / FADE))


@njit(**INNER)
def _tabulated(acts, t, argument):
    """Return value and slope of a table: the cubic between two knots, constant beyond them (Hermite).

    Args:
        acts: array of settings, one row per shape.
        t: row of this shape.
        argument: position or velocity [rad or m, per s].
    """
    first = int(acts[t, 2])
    low = 0
    high = int(acts[t, 1]) - 1
    if not argument > acts[t, first]:
        return acts[t, first + 1], 0.0
    if not argument < acts[t, first + 3 * high]:
        return acts[t, first + 3 * high + 1], 0.0
    while high - low > 1:
        middle = (low + high) // 2
        if argument < acts[t, first + 3 * middle]:
            high = middle
        else:
            low = middle
    start_knot = first + 3 * low
    end_knot = start_knot + 3
    width = acts[t, end_knot] - acts[t, start_knot]
    s = (argument - acts[t, start_knot]) / width
    rise = acts[t, end_knot + 1] - acts[t, start_knot + 1]
    start = acts[t, start_knot + 2] * width - rise
    stop = rise - acts[t, end_knot + 2] * width
    bend = start * (1.0 - s) + stop * s
    value = acts[t, start_knot + 1] + s * rise + s * (1.0 - s) * bend
    slope = rise + (1.0 - 2.0 * s) * bend + s * (1.0 - s) * (stop - start)
    return value, slope / width


@njit(**INNER)
def shape(code, acts, t, x, v, state):
    """Return the torque of a shape per unit parameter, and its derivatives with respect to position and velocity.

    Args:
        code: code of the shape.
        acts, t: array of settings, and the row of this shape in the array.
        x, v: position and velocity [rad or m, per s].
        state: state of the stop operator, from `calib.dynamics.drives.friction_states`.
    """
    first = acts[t, 1]
    second = acts[t, 2]
    third = acts[t, 3]
    if code in (SIGN, LOAD):
        sign = smooth_sign(v, first)
        return sign, 0.0, _sign_slope(sign, first)
    if code in (SPEED, CUBIC, ROOT, LOAD_VELOCITY):
        # Beyond the edge of the speeds that they were identified at they keep their value.
        clipped = min(first, max(-first, v))
        within = 1.0 if abs(v) < first else 0.0
        if code == SPEED:
            return abs(clipped), 0.0, within * smooth_sign(v, 0.0)
        if code == CUBIC:
            return clipped**3, 0.0, within * 3.0 * clipped * clipped
        if code == LOAD_VELOCITY:
            return clipped, 0.0, within
        size = abs(clipped) + second
        return clipped / sqrt(size), 0.0, within * (size - 0.5 * abs(clipped)) / (size * sqrt(size))
    if code == STRIBECK:
        sign = smooth_sign(v, third)
        ratio = abs(v) / first
        gain = exp(-(ratio**second))
        fall = second / first * ratio ** (second - 1.0) if ratio > 0.0 else 0.0
        return sign * gain, 0.0, gain * (_sign_slope(sign, third) - abs(sign) * fall)
    if code == STOP:
        return state, 0.0, 0.0
    if code == PRESLIDING:
        return state - smooth_sign(v, second), 0.0, 0.0
    if code in (SINE, COSINE):
        fading = 1.0 / (1.0 + (v / second) ** 2)
        wave = sin(first * x)
        rising = first * cos(first * x)
        if code == COSINE:
            wave = cos(first * x)
            rising = -first * sin(first * x)
        return fading * wave, fading * rising, -2.0 * v / (second * second) * fading * fading * wave
    if code in (SINE_BAND, COSINE_BAND):
        gain = _band(acts, t, x, v)
        # at most speeds, and in the other direction: no sine is needed
        if gain == 0.0:
            return 0.0, 0.0, 0.0
        wave = sin(first * x) if code == SINE_BAND else cos(first * x)
        return gain * wave, 0.0, 0.0
    if code == DEAD:
        if not second > 0.0:
            return smooth_sign(v, 0.0) if abs(v) > first else 0.0, 0.0, 0.0
        # A ramp: no jump is integrable.
        upper = smooth_sign(v - first, second)
        lower = smooth_sign(v + first, second)
        return 0.5 * (upper + lower), 0.0, 0.5 * (_sign_slope(upper, second) + _sign_slope(lower, second))
    if code == VELOCITY_TABLE:
        value, slope = _tabulated(acts, t, v)
        return value, 0.0, slope
    if code == POSITION_TABLE:
        value, slope = _tabulated(acts, t, x)
        return value, slope, 0.0
    if code == POSITION:
        return x, 1.0, 0.0
    if code == VELOCITY:
        return v, 0.0, 1.0
    return 1.0, 0.0, 0.0


@njit(**INNER)
def steepest(code, acts, t):
    """Return four numbers that limit a simulator's step size where a shape is steep.

    They are the largest slope of a smoothed sign, the |v| of that slope, its width in v, and the stiffness of a stop
    operator; 0, 0, 1, 0 for other shapes.

    Args:
        code: code of the shape.
        acts, t: array of settings, and the row of this shape in the array.
    """
    first = acts[t, 1]
    second = acts[t, 2]
    third = acts[t, 3]
    if code in (SIGN, LOAD):
        return 1.0 / first, 0.0, first, 0.0
    if code == STRIBECK:
        return 1.0 / third, 0.0, third, 0.0
    if code == ROOT:
        return 1.0 / sqrt(second), 0.0, second, 0.0
    if code == DEAD:
        return 0.5 / second, first, second, 0.0
    if code == VELOCITY_TABLE:
        return third, 0.0, acts[t, 4], 0.0
    if code == STOP:
        return 0.0, 0.0, 1.0, 1.0 / first
    if code == PRESLIDING:
        return 1.0 / second, 0.0, second, 1.0 / first
    return 0.0, 0.0, 1.0, 0.0


@njit(**OPTIONS)
def fill(code, acts, x, v, state, out):
    """Write the values of one shape into `out`.

    Args:
        code: code of the shape.
        acts: settings of the shape in the only row.
        x, v, state: (N,) position, velocity and state of the stop operator.
        out: (1, N) for the values, or (3, N) for the values and their derivatives with respect to x and v.
    """
    row = acts.shape[0] - 1  # for a constant the shape would be compiled anew
    for k in range(v.shape[0]):
        value, by_x, by_v = shape(code, acts, row, x[k], v[k], state[k])
        out[0, k] = value
        if out.shape[0] == 3:
            out[1, k] = by_x
            out[2, k] = by_v

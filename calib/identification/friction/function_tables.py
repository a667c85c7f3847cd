"""Tables of functions: knots with value and slope, between which the cubic (Hermite) stands for the function.

    f(x) = f_0 + s Δ + s (1 - s) [(1 - s) (f'_0 h - Δ) + s (Δ - f'_1 h)],
    s = (x - x_0) / h,   h = x_1 - x_0,   Δ = f_1 - f_0

Its error falls with h⁴ (Fritsch & Carlson 1980). Intervals are halved until the cubic is within `TOLERANCE` of the
function, so that a table can be stored, read and simulated without the function.
"""

from collections.abc import Callable

import numpy as np

from calib.errors import UsageError

Function = Callable[[np.ndarray], np.ndarray]
"""A function of places (m,) that returns values (m,)."""
# Largest error of the cubic, as a share of the largest value (our choice).
TOLERANCE = 1e-6
# Even intervals at the start, and places on each side of zero in geometric steps from this share of the range, where
# friction bends most (our choice).
EVEN = 32
NEAR_ZERO = np.geomspace(1e-5, 0.5, 24)
# Shares of an interval at which the cubic is compared with the function.
INSIDE = np.array([0.21, 0.5, 0.79])
# Most knots of a table, and the width of an interval, as a share of the range, from which a jump is assumed.
MAX_KNOTS = 3000
SHORTEST = 1e-9
# Largest error of a stated slope, as a share of slope and mean steepness of the function; steps of its differences.
MAX_SLOPE_ERROR = 1e-3
STEP = 1e-6


def knots_of(function: Function, slope: Function, lower: float, upper: float, title: str) -> np.ndarray:
    """Return knots (k, 3), each a place, the value and the slope there, that represent a function from lower to upper.

    Args:
        function, slope: the function and its derivative.
        lower, upper: range of the places.
        title: name of the function for messages.

    Raises:
        UsageError: the function or its slope has another shape or is not finite, the slope is not that of the function,
            or the function jumps.
    """
    span = upper - lower
    around_zero = np.concatenate([-NEAR_ZERO[::-1], [0.0], NEAR_ZERO]) * max(abs(lower), abs(upper))
    around_zero = around_zero[(around_zero > lower) & (around_zero < upper)]
    places = np.unique(np.concatenate([np.linspace(lower, upper, EVEN + 1), around_zero]))
    values = _evaluated(function, places, title, "function")
    slopes = _evaluated(slope, places, title, "slope")
    _check_slope(function, slope, places, title)
    size = np.abs(values).max()
    if size == 0.0:
        raise UsageError(f"{title}: the function is zero from {lower:.4g} to {upper:.4g}: it cannot be identified")
    while True:
        widths = np.diff(places)
        checked_places = places[:-1, None] + widths[:, None] * INSIDE
        exact = _evaluated(function, checked_places.ravel(), title, "function").reshape(checked_places.shape)
        error = np.abs(_cubic(places, values, slopes) - exact).max(axis=1)
        wrong = error > TOLERANCE * size
        if not wrong.any():
            return np.column_stack([places, values, slopes])
        narrow = wrong & (widths < SHORTEST * span)
        if narrow.any() or len(places) > MAX_KNOTS:
            k = int(np.argmax(np.where(wrong, error, 0.0)))
            raise UsageError(
                f"{title}: the function changes by {abs(values[k + 1] - values[k]):.3g} between {places[k]:.6g} and "
                f"{places[k + 1]:.6g}, too abruptly to be simulated: smooth it, for example sign(v) as tanh(v / 0.01)"
            )
        middles = 0.5 * (places[:-1] + places[1:])[wrong]
        order = np.argsort(np.concatenate([places, middles]), kind="stable")
        places = np.concatenate([places, middles])[order]
        values = np.concatenate([values, _evaluated(function, middles, title, "function")])[order]
        slopes = np.concatenate([slopes, _evaluated(slope, middles, title, "slope")])[order]


def _evaluated(function: Function, places: np.ndarray, title: str, role: str) -> np.ndarray:
    """Return the values (m,) of a function at places (m,), checked for shape and finite numbers.

    Args:
        function: the function.
        places: where it is evaluated.
        title: name of the function for messages.
        role: ``function`` or ``slope``, for messages.
    """
    values = np.asarray(function(places), dtype=float)
    if values.shape == () and role == "slope":
        values = np.full(len(places), float(values))
    if values.shape != places.shape:
        raise UsageError(
            f"{title}: {role}: expected an array of shape {places.shape} for places of that shape, found "
            f"{values.shape}; write it with numpy's functions"
        )
    if not np.isfinite(values).all():
        k = int(np.flatnonzero(~np.isfinite(values))[0])
        raise UsageError(f"{title}: {role} is {values[k]} at {places[k]:.6g}: it must be finite in the joint's range")
    return values


def _check_slope(function: Function, slope: Function, places: np.ndarray, title: str) -> None:
    """Raise an error if `slope` differs from differences of `function` at more than a few places, such as kinks.

    Args:
        function, slope: the function and its stated derivative.
        places: (m,) places; compared is between them.
        title: name of the function for messages.
    """
    widths = np.diff(places)
    between = places[:-1] + 0.37 * widths
    step = STEP * widths
    values = _evaluated(function, between, title, "function")
    after = _evaluated(function, between + step, title, "function")
    before = _evaluated(function, between - step, title, "function")
    difference = (after - before) / (2.0 * step)
    slopes_between = _evaluated(slope, between, title, "slope")
    rounding = 1e-15 * (np.abs(values) + np.abs(values).max()) / step
    steepness = np.abs(np.diff(_evaluated(function, places, title, "function"))).sum() / widths.sum()
    scale = np.maximum(np.abs(slopes_between), np.abs(difference)) + MAX_SLOPE_ERROR * steepness
    wrong = np.abs(slopes_between - difference) > MAX_SLOPE_ERROR * scale + rounding
    if wrong.sum() > 2:
        k = int(np.argmax(np.where(wrong, np.abs(slopes_between - difference), 0.0)))
        raise UsageError(
            f"{title}: slope is {slopes_between[k]:.6g} at {between[k]:.6g}, differences of the function give "
            f"{difference[k]:.6g} ({int(wrong.sum())} of {len(wrong)} places differ): give its derivative"
        )


def _cubic(places: np.ndarray, values: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Return the cubics between knots (k,) at the shares `INSIDE` of each interval, (k - 1, shares)."""
    width = np.diff(places)[:, None]
    rise = np.diff(values)[:, None]
    start = slopes[:-1, None] * width - rise
    stop = rise - slopes[1:, None] * width
    bend = start * (1.0 - INSIDE) + stop * INSIDE
    return values[:-1, None] + INSIDE * rise + INSIDE * (1.0 - INSIDE) * bend

"""Colours, sizes and tick labels of all figures, by whatever they are drawn.

The colours are distinguishable in greyscale.
"""

import numpy as np

BEFORE, AFTER, MARK, QUIET, INK = "#e2a26b", "#17486e", "#b3261e", "#8a8f98", "#22262b"
# of curves that stand together, such as those of joints
CURVES = (AFTER, BEFORE, "#2f7f5f", MARK, "#7a5ea8", "#3a9bb8", "#a8622a", QUIET)
# BEFORE, dark enough for letters
BROWN = "#a8622a"
# a page's line and half of it [in]
PAGE_WIDTH, HALF_WIDTH = 7.4, 3.6
# stretches of a curve, of which each keeps its smallest and its largest value
STRETCHES = 700
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float) -> str:
    """Return `value` as the label of a tick: plain from about 0.001 to 100 000, otherwise with a power of ten."""
    if value == 0.0 or 0.99e-3 < abs(value) < 0.99e5:
        return f"{value:g}"
    digits, power = f"{value:.0e}".split("e")
    power_of_ten = f"10{str(int(power)).translate(_RAISED)}"
    if digits == "1":
        return power_of_ten
    if digits == "-1":
        return f"-{power_of_ten}"
    return f"{digits}·{power_of_ten}"


def thinned(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a curve with fewer points, of which all peaks remain.

    The points are the minimum and maximum of each of `STRETCHES` intervals.

    Args:
        t: (N,) times [s].
        values: (N,) values.
    """
    size = len(t) // STRETCHES
    if size < 3:
        return t, values
    count = len(t) // size
    stretches = values[: count * size].reshape(count, size)
    extremes = np.stack([stretches.argmin(axis=1), stretches.argmax(axis=1)])
    rows = np.sort(extremes, axis=0) + size * np.arange(count)
    chosen = np.append(rows.T.ravel(), len(t) - 1)
    return t[chosen], values[chosen]

"""Units of time stamps that no heading states, where the numbers leave one possibility only.

Stamps since 1970 tell their unit by their size: seconds are 1e9 to 4.1e9 until the year 2100, milliseconds a thousand
times that. Steps of more than `LONGEST_STEP` are no seconds; they are read in the only unit that gives a rate at which
robots are logged. Smaller steps (2, 10) may be milliseconds, but also slow seconds: they are refused later, with the
line to paste.
"""

import numpy as np

from calib.units import TIMES

# Seconds since 1970 in the years 2001 and 2100.
EPOCH_START, EPOCH_END = 1e9, 4.1e9
# No log has samples further apart [s] (our choice).
LONGEST_STEP = 1e4
# Plausible rates of logs [Hz], as `RecordingBounds` has them.
MIN_RATE, MAX_RATE = 5.0, 50e3


def likely_unit(t: np.ndarray) -> str:
    """Return the unit of time stamps (N,) as its name in `TIMES`; "" if they are seconds, or it cannot be told."""
    finite = t[np.isfinite(t)]
    if len(finite) < 2:
        return ""
    step = float(np.median(np.abs(np.diff(finite))))
    units = []
    for unit in ("ms", "us", "ns"):
        seconds = step * TIMES[unit]
        if seconds > 0.0 and MIN_RATE <= 1.0 / seconds <= MAX_RATE:
            units.append(unit)
    middle = float(np.median(finite))
    since_1970 = [unit for unit in units if EPOCH_START <= middle * TIMES[unit] <= EPOCH_END]
    if since_1970:
        return since_1970[0]
    return units[0] if step > LONGEST_STEP and len(units) == 1 else ""


def in_seconds(t: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return time stamps (N,) without a unit as seconds since the first, and a note where they are no seconds."""
    unit = likely_unit(t.astype(float))
    seconds = (t - t[0]).astype(float) * TIMES[unit or "s"]
    if not unit:
        return seconds, []
    step = float(np.median(np.diff(seconds)))
    return seconds, [f"its stamps are read as {unit}: the only unit that gives a plausible rate ({1.0 / step:.4g} Hz)"]

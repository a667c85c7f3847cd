"""Units: every one that is read from a file or printed, with its factor to SI.

`QUANTITIES` says which units a quantity is read in; `of` the SI unit of a joint's coordinate and its derivatives.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

DEG = math.pi / 180
ANGLES = {"rad": 1.0, "deg": DEG, "mrad": 1e-3, "°": DEG, "degrees": DEG}
LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "cm": 1e-2, "in": 0.0254}

# as recordings name them, in small letters
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
POSITIONS = {"rad": 1.0, "m": 1.0, "deg": DEG, "°": DEG, "mrad": 1e-3, "mm": 1e-3}
VELOCITIES = {"rad/s": 1.0, "m/s": 1.0, "deg/s": DEG, "°/s": DEG, "mm/s": 1e-3, "rpm": math.pi / 30}
EFFORTS = {"nm": 1.0, "n·m": 1.0, "n.m": 1.0, "n*m": 1.0, "n m": 1.0, "n": 1.0, "mnm": 1e-3, "knm": 1e3}
CURRENTS = {"a": 1.0, "ma": 1e-3}

QUANTITIES: Mapping[str, Mapping[str, float]] = {
    "angle": ANGLES,
    "length": LENGTHS,
    "angular speed": {"rad/s": 1.0, "deg/s": DEG, "°/s": DEG, "rpm": math.pi / 30},
    "speed": {"m/s": 1.0, "mm/s": 1e-3},
    "torque": {"Nm": 1.0, "N m": 1.0},
    "force": {"N": 1.0},
    "frequency": {"rad/s": 1.0, "Hz": 2 * math.pi},
}
"""Quantity → unit → factor to SI; what is said of a unit that is none of them begins with the first."""

"""Units: units of input files with their factor to SI, and units of output with their factor from SI.

Numbers in all files written by the toolkit are in SI, unless a header or a key names another unit.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol

DEG = math.pi / 180
ANGLES = {"rad": 1.0, "deg": DEG, "mrad": 1e-3, "°": DEG, "degrees": DEG}
LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "cm": 1e-2, "in": 0.0254}

# counts per turn of an encoder, and the count at the joint's zero: counts/4096@2048
COUNTS = r"counts/(\d+(?:\.\d+)?)(?:@(-?\d+(?:\.\d+)?))?"

# units of encoders that do not say how many counts a turn has
COUNT_WORDS = frozenset(("count", "counts", "cts", "tick", "ticks", "inc", "incs", "increments", "pulses", "steps"))

# words for units in headers, in small letters, with the unit
UNIT_WORDS: Mapping[str, str] = {
    **dict.fromkeys(("grad", "degree", "deg.", "degré", "degrés", "grado", "grados", "gradi", "graus", "度"), "deg"),
    **dict.fromkeys(("radian", "radians", "radiant"), "rad"),
    **dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres", "мм", "毫米"), "mm"),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("inch", "inches"), "in"),
}

# names of units of time in recordings, in small letters, with their factor to seconds
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
POSITIONS = {"rad": 1.0, "m": 1.0, "deg": DEG, "°": DEG, "mrad": 1e-3, "mm": 1e-3}
TURNED = ("rad", "deg", "°", "mrad", "rad/s", "deg/s", "°/s", "rpm")
"""Units in `POSITIONS` and `VELOCITIES` of turning joints; the others are for sliding joints."""
VELOCITIES = {"rad/s": 1.0, "m/s": 1.0, "deg/s": DEG, "°/s": DEG, "mm/s": 1e-3, "rpm": math.pi / 30}
EFFORTS = {
    **{f"n{dot}{length}": size for length, size in (("m", 1.0), ("mm", 1e-3)) for dot in ("", "·", ".", "*", " ", "-")},
    "n": 1.0,
    "mnm": 1e-3,
    "knm": 1e3,
}
CURRENTS = {"a": 1.0, "ma": 1e-3}
MASSES = {"kg": 1.0, "g": 1e-3}

QUANTITIES: Mapping[str, Mapping[str, float]] = {
    "angle": ANGLES,
    "length": LENGTHS,
    "angular speed": {"rad/s": 1.0, "deg/s": DEG, "°/s": DEG, "rpm": math.pi / 30},
    "speed": {"m/s": 1.0, "mm/s": 1e-3},
    "torque": {"Nm": 1.0, "N m": 1.0, "N·m": 1.0, "Nmm": 1e-3, "N mm": 1e-3, "N·mm": 1e-3},
    "force": {"N": 1.0},
    "frequency": {"rad/s": 1.0, "Hz": 2 * math.pi},
}
"""Quantity → unit → factor to SI; the message on an unknown unit names the first quantity."""

ERRORS: Mapping[str, tuple[float, str]] = {
    "position": (1e3, "mm"),
    "orientation": (1 / DEG, "deg"),
    "distance": (1e3, "mm"),
}
"""Kind of a residual → factor from SI and printed unit."""

SMALL: Mapping[str, tuple[float, str]] = {"m": (1e3, "mm"), "rad": (1e3, "mrad")}
"""SI unit of a parameter → factor and printed unit of its small changes and standard deviations."""

JOINT: Mapping[str, tuple[float, str]] = {"revolute": (1 / DEG, "deg"), "prismatic": (1e3, "mm")}
"""Kind of a joint → factor from SI and printed unit of its coordinate."""

TORQUE = "N m"


def small(value: float, unit: str, digits: int = 3) -> str:
    """Return the printed text of a parameter's small change or standard deviation [m or rad], in mm or mrad."""
    factor, printed = SMALL[unit]
    return f"{factor * value:.{digits}g} {printed}"


class NamedJoint(Protocol):
    """A joint of any robot or recording, with its name and its kind, ``revolute`` or ``prismatic``."""

    @property
    def name(self) -> str: ...

    @property
    def kind(self) -> str: ...


def motion_units(kinds: Iterable[str]) -> tuple[str, str, str, str]:
    """Return the SI units of position, velocity, acceleration and torque for joints of the given kinds."""
    distinct_kinds = set(kinds)
    if "prismatic" not in distinct_kinds:
        position, torque = "rad", TORQUE
    elif distinct_kinds == {"prismatic"}:
        position, torque = "m", "N"
    else:
        position, torque = "rad, m", f"{TORQUE}, N"
    return position, f"{position}/s", f"{position}/s²", torque


def headings(series: str, joints: Sequence[NamedJoint]) -> list[str]:
    """Return the headers of the joints' columns in a table of motion, such as ``q_joint1 [rad]``.

    Args:
        series: quantity of the columns: ``q``, ``q_link``, ``v``, ``a``, ``current``; all others are torques.
        joints: the joints.
    """
    result = []
    for joint in joints:
        position, velocity, acceleration, torque = motion_units([joint.kind])
        units = {"q": position, "q_link": position, "v": velocity, "a": acceleration, "current": "A"}
        unit = units.get(series, torque).replace("²", "^2")
        result.append(f"{series}_{joint.name} [{unit}]")
    return result


def without_gains(unit: str) -> str:
    """Return a description of the torque unit `unit` ("A of joint 2") of a model that was identified from currents."""
    reference = unit.removeprefix("A of ")
    scale = f"scaled to {reference}, " if reference != unit else ""
    return f"in amperes, {scale}because no drive gains are known"


def per_ampere(parameter_unit: str, unit: str) -> str:
    """Return a parameter's unit in a model whose torques have the unit `unit`.

    If torques are in amperes, each parameter is divided by a gain [N m/A]: ``N m s/rad`` becomes ``A s/rad``, ``kg m²``
    becomes ``kg m² A/(N m)``.
    """
    if unit == TORQUE:
        return parameter_unit
    if TORQUE in parameter_unit:
        return parameter_unit.replace(TORQUE, "A")
    return f"{parameter_unit} A/({TORQUE})"


def plain_number(text: str) -> float:
    """Return the number in a text of ASCII digits.

    Raises:
        ValueError: the text is not a number, or has digits of other scripts or underscores (``0_5``).
    """
    if "_" in text or not text.isascii():
        raise ValueError(text)
    return float(text)


def is_number(text: str) -> bool:
    """Return whether `plain_number` accepts the text."""
    try:
        plain_number(text)
    except ValueError:
        return False
    return True


def encoder_counts(unit: str) -> tuple[float, float] | None:
    """Return the counts per turn of an encoder and the count at zero, of a unit such as ``counts/4096@2048``.

    None for other units, and for no counts per turn.
    """
    match = re.fullmatch(COUNTS, unit.lower())
    if match is None or not float(match[1]):
        return None
    return float(match[1]), float(match[2] or 0.0)


def unit_of(text: str) -> str:
    """Return a unit's short name for a word in a header: ``deg`` for ``Grad``; other texts as they are."""
    return UNIT_WORDS.get(text.lower(), text)

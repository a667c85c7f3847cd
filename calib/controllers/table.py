"""Robot controllers, as declared in ``controllers.toml``: joint values, programs, accepted settings.

A controller displays  s_i = sign_i · (q_i + Σ way · q_j)  for a description's joints q: signs and coupled axes (a
FANUC's J3 is measured from the horizontal). Descriptions are ROS-Industrial's or the maker's. If a description has
another zero of a joint, the programs would be wrong: play them in the controller's simulation first.
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from calib.config import parse, strict
from calib.errors import UsageError, one_of, require
from calib.files import shipped_text
from calib.units import ANGLES, LENGTHS


@strict
@dataclass(frozen=True)
class Controller:
    """One entry of ``controllers.toml``; the head of that file explains each key."""

    title: str
    files: Mapping[str, str]
    names: str
    unit: str
    decimals: int
    source: str
    takes: str
    closed: str
    checked: str
    tool_frame: str = ""
    base_frame: str = ""
    base: str = ""
    flange: str = ""
    base_at: str = ""
    flange_turn: tuple[float, ...] = ()
    frames: str = ""
    language: str = ""
    stream: Mapping[str, str] = field(default_factory=dict)
    cycle: float = 0.0
    keeps: str = ""
    outputs: bool = True
    mastered: bool = True
    pulses: bool = False
    axes: tuple[int, ...] = ()
    suffixes: tuple[str, ...] = ()
    saved: tuple[str, ...] = ()
    signs: tuple[int, ...] = ()
    coupled: tuple[tuple[int, int, int], ...] = ()
    joints: str = ""
    pose: str = ""
    numbered: str = ""
    moves: str = ""
    turn: str = ""
    length: str = "m"
    comment: str = ""

    def matrix(self, n: int) -> np.ndarray:
        """Return the matrix (n, n) from a description's joints to the joints that the controller displays."""
        coupling = np.eye(n)
        for axis, partner, sign in self.coupled:
            if max(axis, partner) <= n:
                coupling[axis - 1, partner - 1] = sign
        return np.array(self.signs or [1] * n)[:, None] * coupling

    def shown(self, q: np.ndarray) -> np.ndarray:
        """Return a description's joint values (…, n) [rad] as the controller displays them, in its unit."""
        return q @ self.matrix(q.shape[-1]).T / ANGLES[self.unit]

    def described(self, controller_values: np.ndarray) -> np.ndarray:
        """Return a description's joint values (…, n) from those that the controller displays, in the controller's
        unit.
        """
        return controller_values @ np.linalg.inv(self.matrix(controller_values.shape[-1])).T

    @property
    def metres(self) -> float:
        """Size of the unit of lengths in poses [m]."""
        return LENGTHS[self.length]


@cache
def controllers() -> dict[str, Controller]:
    """Return all controllers by name."""
    table = tomllib.loads(shipped_text("calib.controllers", "controllers.toml"))
    result = {}
    for name, entry in table.items():
        # an entry that is like another one takes over all keys that it does not have
        inherited = table[entry["like"]] if "like" in entry else {}
        keys = {key: value for key, value in entry.items() if key != "like"}
        result[name] = parse(Controller, inherited | keys, f"controllers.toml: {name}")
    return result


def controller_named(name: str) -> Controller:
    """Return a controller by its name.

    Raises:
        UsageError: for an unknown name; the message lists the known names.
    """
    return controllers()[one_of(name, controllers(), "controller", UsageError)]


def check_controller(name: str, axes: int, pulses: Sequence[float] = ()) -> None:
    """Raise a UsageError for an unknown name, an arm with another number of axes, or missing pulses per axis."""
    controller = controller_named(name)
    allowed = " or ".join(map(str, controller.axes))
    require(not allowed or axes in controller.axes, f"{axes} joints; {controller.title} takes {allowed}", UsageError)
    message = f"{controller.title} needs the pulses per degree of each of {axes} axes: calib program --pulse"
    require(not controller.pulses or (len(pulses) == axes and all(pulses)), message, UsageError)


def controller_of(path: Path, name: str = "") -> Controller:
    """Return the controller of a program at `path`: by `name`, or, if it is empty, by the file's suffix.

    Raises:
        UsageError: if no controller's programs have this suffix and targets that can be read.
    """
    if name:
        return controller_named(name)
    for controller in controllers().values():
        if path.suffix.lower() in controller.suffixes:
            return controller
    suffixes = ", ".join(suffix for controller in controllers().values() for suffix in controller.suffixes)
    raise UsageError(f"{path}: no program of a known controller: expected a suffix of {suffixes}")


def as_described(name: str, controller_values: np.ndarray) -> np.ndarray:
    """Return a description's joint values or speeds (…, n) from those that a controller displays, in the same unit."""
    return controller_named(name).described(controller_values)


def motors_as_described(name: str, controller_values: np.ndarray) -> np.ndarray:
    """Return motor torques or currents (…, n) with the description's signs; coupled axes do not affect them."""
    return controller_values * np.array(controller_named(name).signs or 1.0)

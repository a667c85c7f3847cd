"""Robot controllers, as declared in ``controllers.toml``: joint values, programs, accepted settings.

For the joints q of a robot description, a controller displays s_i = sign_i · (q_i + Σ way · q_j), with signs and
coupled axes (a FANUC's J3 is measured from the horizontal); `calib.controllers.axes` applies this to the arm's axes.
The table is valid for descriptions of ROS-Industrial or the maker. If a description defines another zero of a joint,
written programs would be wrong: play them in the controller's simulation first.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from calib.config import parse, strict
from calib.errors import UsageError, one_of
from calib.files import shipped_text
from calib.units import LENGTHS


@strict
@dataclass(frozen=True)
class Controller:
    """One entry of ``controllers.toml``; the comment at the head of that file explains each key."""

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
    external: int = 0
    scara: bool = False
    rail_group: int = 0
    suffixes: tuple[str, ...] = ()
    saved: tuple[str, ...] = ()
    signs: tuple[int, ...] = ()
    coupled: tuple[tuple[int, int, int], ...] = ()
    joints: str = ""
    extra: str = ""
    beside: str = ""
    pose: str = ""
    numbered: str = ""
    moves: str = ""
    turn: str = ""
    length: str = "m"
    comment: str = ""

    def matrix(self, n: int) -> np.ndarray:
        """Return the matrix (n, n) that maps a description's joint values to the joint values that the controller
        displays.
        """
        coupling = np.eye(n)
        for axis, partner, sign in self.coupled:
            if max(axis, partner) <= n:
                coupling[axis - 1, partner - 1] = sign
        return np.array(self.signs or [1] * n)[:, None] * coupling

    @property
    def metres(self) -> float:
        """Size of the controller's unit of length in poses [m]."""
        return LENGTHS[self.length]


@cache
def controllers() -> dict[str, Controller]:
    """Return all known controllers: name -> controller."""
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


def controller_of(path: Path, name: str = "") -> Controller:
    """Return the controller of a robot program.

    Args:
        path: file of the program.
        name: name of the controller; empty: determined by the file's suffix.

    Raises:
        UsageError: for an unknown controller or suffix.
    """
    if name:
        return controller_named(name)
    for controller in controllers().values():
        if path.suffix.lower() in controller.suffixes:
            return controller
    suffixes = ", ".join(suffix for controller in controllers().values() for suffix in controller.suffixes)
    raise UsageError(f"{path}: no program of a known controller: expected a suffix of {suffixes}")


def motors_as_described(name: str, controller_values: np.ndarray) -> np.ndarray:
    """Return motor torques or currents (…, n) with the signs of a description; coupled axes do not affect them.

    Args:
        name: name of the controller.
        controller_values: (…, n) torques or currents of the controller.
    """
    return controller_values * np.array(controller_named(name).signs or 1.0)

"""Where two calibrations are: folders of fits, of identifications, of sessions, or a robot's description."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.errors import RobotError, UsageError, command_line, listing, require
from calib.result_kinds import refusal
from calib.toolkit.chains import CalibratedChain, Element
from calib.toolkit.opened_results import open_result
from calib.toolkit.result_folders import FitFolder, IdentificationFolder
from calib.toolkit.sessions import Session

SAME = 1e-9  # of two nominal descriptions: largest difference [m, rad] that rounding in files explains


@dataclass(frozen=True)
class Place:
    """What one calibration is read from.

    Attributes:
        name: as the user gave it.
        session: None where it is no session's folder.
        fit, identification: folders of the results that are there; None: there is none.
    """

    name: str
    session: Session | None = None
    fit: FitFolder | None = None
    identification: IdentificationFolder | None = None

    @property
    def nominal(self) -> bool:
        """Whether it is a robot's description, not a folder."""
        return not (self.session or self.fit or self.identification)

    @property
    def serial(self) -> str:
        """Serial number of the robot as its session states it; empty if unknown."""
        return self.session.settings.certificate.robot_serial if self.session else ""

    @property
    def words(self) -> str:
        """What it holds, in a clause."""
        contents = [name for name, result in (("geometry", self.fit), ("dynamics", self.identification)) if result]
        if contents or not self.session:
            return f"{self.name} holds {' and '.join(contents) or 'the nominal robot'}"
        return f"{self.name} holds no result yet ({command_line('next', self.name)})"


def place_of(source: str | Path, verb: str = "diff") -> Place:
    """Return what a calibration is read from; what is no folder counts as a description.

    Raises:
        UsageError: for a folder of something else.
    """
    path, name = Path(source), str(source)
    if not path.is_dir():
        return Place(name)
    result = open_result(path, verb)
    fit, identification = result.fit(verb), result.identification
    require(result.session or fit or identification, refusal(path, verb), UsageError)
    return Place(name, result.session, fit, identification)


def check_same_robot(names: tuple[str, str], robots: tuple[CalibratedChain, CalibratedChain]) -> None:
    """Raise `RobotError` for two calibrations whose nominal descriptions differ."""
    first, second = (robot.nominal or robot.chain for robot in robots)
    beginning = f"{names[0]} and {names[1]} are of different robots"
    for attribute in ("joint_names", "names"):
        first_names, second_names = getattr(first, attribute), getattr(second, attribute)
        strange = [name for name in (*first_names, *second_names) if (name in first_names) != (name in second_names)]
        kind = "joints" if attribute == "joint_names" else "parameters"
        message = f"{beginning} ({first.name}, {second.name}): {kind} {listing(strange, 5)} exist in one of them only"
        require(
            first_names == second_names,
            message if strange else f"{beginning}: their {kind} are in another order",
            RobotError,
        )
    difference = np.abs(first.values - second.values)
    difference = np.maximum(
        difference, [np.abs(_placed(a) - _placed(b)).max() for a, b in zip(first.elements, second.elements)]
    )
    differing = [name for name, size in zip(first.names, difference) if size > SAME]
    tail = np.abs(first.tail - second.tail).max()
    ends = f"{beginning}: one ends at {first.tip}, the other at {second.tip}; fit one of them again with --tip"
    require(differing or tail <= SAME or first.tip == second.tip, ends, RobotError)
    message = f"{beginning}: the nominal {listing(differing or ['tip'], 5)} differ; fit both from one description"
    require(not differing and tail <= SAME, message, RobotError)


def _placed(element: Element) -> np.ndarray:
    return np.eye(4) if element.placement is None else element.placement

"""Sources of two calibrations to compare: folders of fits, identifications or sessions, or a robot's description."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.errors import RobotError, UsageError, command_line, listing, require
from calib.result_kinds import refusal
from calib.toolkit.chains import CalibratedChain, Element
from calib.toolkit.result_folders import FitFolder, IdentificationFolder, open_result
from calib.toolkit.sessions import Session

# of two nominal descriptions: largest difference [m, rad] that rounding in files explains
ROUNDING = 1e-9


@dataclass(frozen=True)
class Place:
    """Source of one calibration.

    Attributes:
        name: folder, file or name that the user gave.
        session: the session; None where the source is not a session's folder.
        fit, identification: folders of the results; None where there is no such result.
    """

    name: str
    session: Session | None = None
    fit: FitFolder | None = None
    identification: IdentificationFolder | None = None

    @property
    def nominal(self) -> bool:
        """Whether the source is a robot's description rather than a folder with results."""
        return not (self.session or self.fit or self.identification)

    @property
    def serial(self) -> str:
        """Serial number of the robot as its session states it; empty if unknown."""
        if self.session is None:
            return ""
        return self.session.settings.certificate.robot_serial

    @property
    def words(self) -> str:
        """Clause that lists what the source contains, for messages."""
        contents = []
        if self.fit:
            contents.append("geometry")
        if self.identification:
            contents.append("dynamics")
        if self.session and not contents:
            return f"{self.name} has no result yet ({command_line('next', self.name)})"
        return f"{self.name} contains {' and '.join(contents) or 'the nominal robot'}"


def place_of(source: str | Path, verb: str = "diff") -> Place:
    """Return the source of a calibration; a path that is not a folder counts as a robot's description.

    Args:
        source: folder, file or name.
        verb: name of the command, for messages.

    Raises:
        UsageError: a folder without a fit, an identification or a session.
    """
    path = Path(source)
    name = str(source)
    if not path.is_dir():
        return Place(name)
    result = open_result(path, verb)
    result.check_arm(verb)
    fit, identification = result.fit, result.identification
    require(result.session or fit or identification, refusal(path, verb), UsageError)
    return Place(name, result.session, fit, identification)


def check_same_robot(names: tuple[str, str], robots: tuple[CalibratedChain, CalibratedChain]) -> None:
    """Raise RobotError if the nominal descriptions of two calibrations differ; `names` are used in the message."""
    first = robots[0].nominal or robots[0].chain
    second = robots[1].nominal or robots[1].chain
    beginning = f"{names[0]} and {names[1]} are of different robots"
    compared = (("joints", first.joint_names, second.joint_names), ("parameters", first.names, second.names))
    for kind, names_first, names_second in compared:
        strange = [name for name in names_first if name not in names_second]
        strange += [name for name in names_second if name not in names_first]
        message = f"{beginning}: their {kind} are in another order"
        if strange:
            message = (
                f"{beginning} ({first.name}, {second.name}): {kind} {listing(strange, 5)} exist in one of them only"
            )
        require(names_first == names_second, message, RobotError)

    differing = []
    for k, name in enumerate(first.names):
        step = np.abs(first.values[k] - second.values[k])
        frame_step = np.abs(_placement(first.elements[k]) - _placement(second.elements[k])).max()
        if max(step, frame_step) > ROUNDING:
            differing.append(name)
    same_end = np.abs(first.tail - second.tail).max() <= ROUNDING
    ends = f"{beginning}: one ends at {first.tip}, the other at {second.tip}; fit one of them again with --tip"
    require(differing or same_end or first.tip == second.tip, ends, RobotError)
    message = f"{beginning}: the nominal {listing(differing or ['tip'], 5)} differ; fit both from one description"
    require(not differing and same_end, message, RobotError)


def _placement(element: Element) -> np.ndarray:
    if element.placement is None:
        return np.eye(4)
    return element.placement

"""Find a parallel robot by what a person types, and say so where a verb is for serial arms."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from calib.errors import UsageError
from calib.mechanism import library, parallel_files
from calib.mechanism.closure import ClosedRobot, closed
from calib.robot.calibrated import ROBOT

T = TypeVar("T")


@dataclass(frozen=True, eq=False, repr=False)
class FoundRobot:
    """A parallel robot with its loops closed, and the file it came from."""

    known: ClosedRobot
    source: Path

    def __repr__(self) -> str:
        robot = self.known.robot
        return (
            f"<FoundRobot {robot.name}: {len(robot.legs)} legs, {robot.n} actuators, {robot.r} freedoms "
            f"({', '.join(robot.freedom)})>"
        )


def path_of(robot: object) -> Path | None:
    """Return the file of a parallel robot that `robot` names: a TOML, a folder with one, a library name; else None."""
    if isinstance(robot, FoundRobot):
        return robot.source
    if not isinstance(robot, (str, Path)):
        return None
    path = Path(robot) / ROBOT if Path(robot).is_dir() else Path(robot)
    if path.is_file():
        return path if path.suffix == ".toml" and parallel_files.is_parallel(path) else None
    return library.path(str(robot)) if str(robot) in library.names() else None


def _find(robot: object) -> FoundRobot | None:
    """Return the parallel robot that `robot` is or names; None where it is another kind of robot, or none.

    Raises:
        RobotError: for a file that contradicts itself, loops that do not close at home.
    """
    if isinstance(robot, FoundRobot):
        return robot
    path = path_of(robot)
    return None if path is None else FoundRobot(closed(parallel_files.read(path)), path)


def recognised(robot: T) -> T | FoundRobot:
    """Return the parallel robot that `robot` is or names; another one as it is."""
    return _find(robot) or robot


def refuse_parallel(robot: object, what: str, instead: str = "") -> None:
    """Refuse a parallel robot, or a folder of one, for what knows serial arms only.

    Args:
        what: that is asked for, as ``calib select``.
        instead: what to do, in a clause.

    Raises:
        UsageError: saying which verbs take it.
    """
    if path_of(robot) is not None:
        told = instead or "fit, excite, identify, plan and recall take it"
        raise UsageError(f"{robot} is a parallel robot, and {what} is for serial arms yet; {told}")


def refuse_links(base: str | None, tip: str | None) -> None:
    """Refuse links of a URDF, which a parallel robot has none of."""
    for key, value in (("base", base), ("tip", tip)):
        if value:
            raise UsageError(f"{key} '{value}': a link of a URDF, which a parallel robot's file has none of")

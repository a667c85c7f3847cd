"""Find a parallel robot by what a person types, and say so where a command is for serial arms."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from calib.errors import UsageError
from calib.mechanism import library, parallel_files
from calib.mechanism.closure import ClosedRobot, closed
from calib.robot.calibrated import ROBOT


@dataclass(frozen=True, eq=False)
class FoundRobot:
    """A parallel robot with its loops closed, and the file it came from."""

    known: ClosedRobot
    source: Path


def path_of(robot: object) -> Path | None:
    """Return the file of a parallel robot that `robot` names: a TOML, a folder with one, a library name; else None."""
    if not isinstance(robot, (str, Path)):
        return None
    path = Path(robot) / ROBOT if Path(robot).is_dir() else Path(robot)
    if path.is_file():
        return path if path.suffix == ".toml" and parallel_files.is_parallel(path) else None
    return library.path(str(robot)) if str(robot) in library.names() else None


def find(robot: object) -> FoundRobot | None:
    """Return the parallel robot that `robot` names; None where it is another kind of robot, or none.

    Raises:
        RobotError: for a file that contradicts itself, loops that do not close at home.
    """
    path = path_of(robot)
    return None if path is None else FoundRobot(closed(parallel_files.read(path)), path)


def refuse_parallel(robot: object, command: str) -> None:
    """Refuse a parallel robot for a command that knows serial arms only.

    Raises:
        UsageError: saying which commands take it.
    """
    if path_of(robot) is not None:
        raise UsageError(
            f"{robot} is a parallel robot, and calib {command} is for serial arms yet; identify, excite and fit take it"
        )

"""Parallel robots: the commands for serial arms, applied to closed loops (`calib.parallel.mechanism`).

The functions are those of `calib.procedure.robot_kinds.RobotKind`. They import the package's modules when called,
because these imports are slow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calib.identification.gains import DriveGains
    from calib.identification.rows import Case
    from calib.identification.settings import IdentificationSettings
    from calib.parallel.mechanism.parallel_robot import ParallelRobot
    from calib.parallel.robots import ParallelMechanism
    from calib.procedure.robot_kinds import CommandStage

OFFERS = {"formats": ":FORMATS", "robots": ":"}
FORMATS = {
    "parallel": (
        "a parallel robot as legs and a platform, and what commands write of one",
        "calib.parallel.mechanism.parallel_robot calib.parallel.loop_fit calib.parallel.verbs calib.parallel.export",
        "",
    )
}
KIND = "parallel robot"
LIBRARY = Path(__file__).parent / "mechanism" / "library"


def find(robot: object) -> ParallelMechanism | None:
    """Return the parallel robot of a TOML file, a folder with one, or a library name; None for any other robot."""
    # what cannot be one is told before the slow import
    if not isinstance(robot, (str, Path)):
        return None
    path = Path(robot)
    if path.is_file() and path.suffix != ".toml":
        return None
    if not path.exists() and not (LIBRARY / f"{robot}.toml").is_file():
        return None
    from calib.parallel import robots

    return robots.find(robot)


def stages() -> Mapping[str, CommandStage]:
    """Return the implementation of each command for parallel robots."""
    from calib.parallel import verbs

    return verbs.STAGES


def drive_gains(
    robot: ParallelRobot,
    cases: Sequence[Case],
    settings: IdentificationSettings,
    known: Mapping[str, float],
    reference: int | None,
) -> DriveGains:
    """Return the drive gains [N m/A] of a parallel robot with their covariance.

    Arguments and errors are those of `calib.parallel.actuator_gains.drive_gains`.
    """
    from calib.parallel import actuator_gains

    return actuator_gains.drive_gains(robot, cases, settings, known, reference)

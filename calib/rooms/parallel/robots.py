"""Find a parallel robot by what a person types; what it is to the verbs (`calib.procedure.robot_kinds.Mechanism`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from calib.data.recordings.recording import Joints
from calib.robot.calibrated import ROBOT
from calib.rooms.parallel.mechanism import library, parallel_files
from calib.rooms.parallel.mechanism.closure import ClosedRobot, closed

INSTEAD = {
    "choosing poses": "spread poses over its workspace by hand",
    "calib.read_poses": "calib.fit_geometry takes its files",
    "compensation": "its controller takes the calibrated robot.toml",
    "export": "a URDF holds no closed loops: take its robot.toml and dynamics.json",
}  # of the verbs that there are not


@dataclass(frozen=True, eq=False, repr=False)
class ParallelMechanism:
    """A parallel robot with its loops closed, and the file it came from."""

    known: ClosedRobot
    source: Path
    kind: str = "parallel robot"
    instead: Mapping[str, str] = field(default_factory=lambda: INSTEAD)

    @property
    def joints(self) -> Joints:
        """What recordings are held against: the actuated joints."""
        joints = self.known.robot.joints
        return Joints(
            self.known.robot.joint_names, tuple(joint.kind for joint in joints),
            *(np.array([getattr(joint, key) for joint in joints]) for key in ("lower", "upper", "velocity", "effort")),
        )  # fmt: skip

    def __repr__(self) -> str:
        robot = self.known.robot
        return (
            f"<ParallelMechanism {robot.name}: {len(robot.legs)} legs, {robot.n} actuators, {robot.r} freedoms "
            f"({', '.join(robot.freedom)})>"
        )


def path_of(robot: object) -> Path | None:
    """Return the file of a parallel robot that `robot` names: a TOML, a folder with one, a library name; else None."""
    if not isinstance(robot, (str, Path)):
        return None
    path = Path(robot) / ROBOT if Path(robot).is_dir() else Path(robot)
    if path.is_file():
        return path if path.suffix == ".toml" and parallel_files.is_parallel(path) else None
    return library.path(str(robot)) if str(robot) in library.names() else None


def find(robot: object) -> ParallelMechanism | None:
    """Return the parallel robot that `robot` names; None where it names another kind of robot, or none.

    Raises:
        RobotError: for a file that contradicts itself, loops that do not close at home.
    """
    path = path_of(robot)
    return None if path is None else ParallelMechanism(closed(parallel_files.read(path)), path)

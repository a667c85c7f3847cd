"""Results on parallel robots: the members of those of serial arms, and folders that the next command takes as robots.

``robot.toml`` comes first. identify: ``dynamics.json`` (values of all parameters, base expressions); the others are
those of a serial arm (``calib formats identified``). fit: ``estimate.csv`` (changes of the loops' constants),
``covariance.csv``, ``metrics.json``. excite: ``motion.csv`` (time, platform coordinates, and position, speed, torque of
each actuator), ``trajectory.toml`` (the actuators' positions as Fourier series, for `calib recall`) and
``metrics.json``. plan: the same without series.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from calib import files
from calib.arguments import checked
from calib.folders import METRICS, check_target, write_staged
from calib.procedure.excitation.coefficients import PLANNED
from calib.procedure.excitation.motion_bounds import MotionBounds
from calib.robot.calibrated import ROBOT
from calib.rooms.parallel.mechanism import parallel_files
from calib.rooms.parallel.robots import ParallelMechanism
from trajectories.setpoints import Setpoints


@dataclass(frozen=True)
class ResultFolder:
    """What a verb leaves in its folder.

    Attributes:
        names: of all files, or patterns of them; marks: those by which an earlier result is known.
        what: kind of result, for messages.
    """

    names: tuple[str, ...]
    marks: tuple[str, ...]
    what: str

    def check(self, out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
        """Refuse, before any work is done, a folder that the result cannot go into."""
        check_target(out, (ROBOT, METRICS, *self.names), (METRICS, *self.marks), self.what, inputs)


class ParallelResult:
    """What a verb came to on a parallel robot; each result adds its metrics, its lines and its files."""

    folder: ClassVar[ResultFolder]
    robot: ParallelMechanism

    @property
    def origin(self) -> tuple[str, dict[str, Any]]:
        """Where the robot written into the folder is from, in words, and tables for its file."""
        return f"from {self.robot.source}", {}

    @checked
    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write the folder that the command writes, all files or none."""
        words, tables = self.origin

        def write(folder: Path) -> None:
            parallel_files.write(folder / ROBOT, self.robot.known.robot, words, tables)
            self.write(folder, plots)
            files.write_json(folder / METRICS, self.to_dict())

        self.folder.check(Path(out), [self.robot.source])
        return write_staged(Path(out), (ROBOT, METRICS, *self.folder.names), write)

    def write(self, folder: Path, plots: bool) -> None:
        """Write the files beside robot and metrics."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as ``metrics.json`` holds them."""
        raise NotImplementedError

    def lines(self) -> list[str]:
        """Return what the command prints."""
        raise NotImplementedError

    def __str__(self) -> str:
        return "\n".join(self.lines())


def finite(value: float) -> float | None:
    """Return a number as JSON holds it: None where it is not finite."""
    return float(value) if np.isfinite(value) else None


def write_motion(
    robot: ParallelMechanism, bounds: MotionBounds, track: Setpoints, coordinates: np.ndarray, folder: Path
) -> None:
    """Write ``motion.csv``: time, platform coordinates, and position, speed and, where known, torque of each actuator.

    Args:
        bounds: which the motion keeps; they stand at the head of the file.
        track: of the actuators; coordinates: (N, r) of the platform.
    """
    bounds.check(track)
    parts = {"q": track.q, "v": track.v} | ({} if track.tau is None else {"tau": track.tau})
    names = robot.known.robot.joint_names
    header = ["t [s]", *robot.known.robot.freedom, *(f"{what}_{name}" for what in parts for name in names)]
    table = np.hstack([track.times[:, None], coordinates, *parts.values()])
    files.write_numbers(folder / PLANNED, header, table, notes=bounds.lines())

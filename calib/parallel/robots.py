"""Parallel robots for the commands, loaded by name or from a file (`calib.procedure.robot_kinds.Mechanism`)."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from calib.errors import UsageError
from calib.folders import read_covariance, write_covariance
from calib.parallel.mechanism import parallel_robot
from calib.parallel.mechanism.closure import ClosedRobot, closed
from calib.parallel.mechanism.geometric_fit import LoopCovariance
from calib.parallel.mechanism.parallel_robot import ParallelRobot
from calib.robot.calibrated import COVARIANCE, ROBOT

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from calib.dynamics.base import Base
    from calib.identification.prediction import Dynamics
    from calib.parallel.mechanism.parallel_model import ParallelModel

# Commands and arguments that parallel robots do not have, and what to do instead.
INSTEAD = {
    "choosing poses": "choose poses manually, spread over its workspace",
    "diff": "compare the values and sigmas of both folders' estimate.csv",
    "calib.read_poses": "calib.fit_geometry takes its files",
    "compensation": "use the calibrated robot.toml in its controller",
    "limits": "state velocity, effort, lower and upper in its file",
    "drives": "identify a model with its drives, and name it",
    "poses": "pose selection does not support it",
    "export to single files": "give --into FOLDER",
    "urdf": "robot.urdf is written anew",
}


@dataclass(frozen=True, eq=False, repr=False)
class ParallelMechanism:
    """A parallel robot whose loops close at home, and the file that describes it.

    Attributes:
        mechanism: the robot, prepared for closing its loops.
        source: the file that describes the robot.
        covariance: covariance of the loops' constants from a fit; None if the geometry is taken as exact.
    """

    mechanism: ClosedRobot
    source: Path
    covariance: LoopCovariance | None = None
    kind = "parallel robot"
    instead = INSTEAD

    @property
    def chain(self) -> ParallelRobot:
        """The robot, which like a serial `Chain` has names, limits and number of the actuated joints."""
        return self.mechanism.robot

    def write(self, folder: Path) -> None:
        """Write the robot as ``robot.toml`` into a folder, with the covariance of its geometry if known."""
        parallel_robot.write(folder / ROBOT, self.mechanism.robot, f"from {self.source}")
        self.write_covariance(folder)

    def write_covariance(self, folder: Path) -> None:
        """Write the covariance of the geometry, if known, as ``chain_covariance.csv`` into a folder."""
        if self.covariance is not None:
            write_covariance(folder / COVARIANCE, self.covariance.names, self.covariance.matrix)

    def model_table(self, dynamics: Dynamics[ParallelModel], base: Base, unit: str) -> dict[str, object]:
        """Return the model as the content of ``dynamics.json``; `calib.parallel.design_goal.read_model` reads it."""
        # These imports are slow, and `find` does not need them.
        from calib.dynamics.base import expressions
        from calib.dynamics.shapes import V0
        from calib.folders import COVARIANCE as OF_PARAMETERS
        from calib.identification.model_file import regrouping

        model = dynamics.model
        sign_settings = [term.settings[0] for term in model.terms if term.shape == "sign"]
        v0 = V0
        if sign_settings:
            v0 = sign_settings[0]
        values = model.spread(dynamics.values).tolist()
        return {
            "robot": ROBOT,
            "kind": model.torque_rows.name,
            "unit": unit,
            "payloads": list(model.payloads),
            "preload": model.preload,
            "identical_legs": model.identical_legs,
            "v0": v0,
            "values": dict(zip(model.single.names, values)),
            "base": dict(zip(base.names, expressions(base))),
            "regrouping": regrouping(base),
            "covariance": OF_PARAMETERS,
        }

    def __repr__(self) -> str:
        robot = self.mechanism.robot
        return (
            f"<ParallelMechanism {robot.name}: {len(robot.legs)} legs, {robot.n} actuators, {robot.r} freedoms "
            f"({', '.join(robot.freedom)})>"
        )

    def __str__(self) -> str:
        return repr(self)[1:-1].replace("ParallelMechanism", self.kind)


def find(robot: object) -> ParallelMechanism | None:
    """Return the parallel robot of a TOML file, a folder with one, or a library name; None for any other robot.

    Raises:
        RobotError: for an inconsistent file, or loops that do not close at home.
    """
    if not isinstance(robot, (str, Path)):
        return None
    path = Path(robot)
    if path.is_dir():
        path = path / ROBOT
    if not path.is_file():
        path = parallel_robot.library().get(str(robot))
    elif path.suffix != ".toml" or not parallel_robot.is_parallel(path):
        return None
    if path is None:
        return None
    covariance = None
    covariance_file = path.with_name(COVARIANCE)
    if path.name == ROBOT and covariance_file.is_file():
        names, matrix = read_covariance(covariance_file)
        covariance = LoopCovariance(names, matrix)
    return ParallelMechanism(closed(parallel_robot.read(path)), path, covariance)


def refuse_unread(settings: DataclassInstance, plain: object, read: Collection[str], where: object = "") -> None:
    """Raise UsageError for settings that a stage does not read, unless their values are the default or False.

    Args:
        settings: the settings.
        plain: settings of the same type with the default values.
        read: names of the fields that the stage reads.
        where: the file that contains them.

    Raises:
        UsageError: naming the first such setting.
    """
    for field in fields(settings):
        value = getattr(settings, field.name)
        if field.name not in read and value is not False and value != getattr(plain, field.name):
            prefix = ""
            if where:
                prefix = f"{where}: "
            quoted = ""
            if isinstance(value, str):
                quoted = f" '{value}'"
            raise UsageError(f"{prefix}{field.name}{quoted} is for serial arms only, not for this kind of robot")

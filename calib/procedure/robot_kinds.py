"""Commands for robots other than serial arms: detection of the kind of robot, and its available commands."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from calib.errors import UsageError
from calib.extensions import Point

if TYPE_CHECKING:
    from calib.data.schema import Joints
    from calib.procedure.findings import Verdict


class RobotKind(Protocol):
    """A kind of robot that is not a serial arm, as a package or module.

    Attributes:
        KIND: `Mechanism.kind` of its robots.
        LIBRARY: folder with the robots that can be named without a file.
    """

    KIND: str
    LIBRARY: Path

    def find(self, robot: object) -> Mechanism | None:
        """Return the robot that a name, file or object describes; None if it is not of this kind."""
        ...

    def stages(self) -> Mapping[str, CommandStage]:
        """Return the implementation of each command."""
        ...

    def drive_gains(
        self,
        robot: object,
        cases: Sequence[object],
        settings: object,
        known: Mapping[str, float],
        reference: int | None,
    ) -> Any:
        """Return the drive gains (`calib.identification.gains.DriveGains`) of a robot's recordings in amperes."""
        ...


ROBOTS: Point[RobotKind] = Point("robots", "kinds of robot other than serial arms")


@dataclass(frozen=True)
class CommandStage:
    """Implementation of one command for robots of one kind.

    Attributes:
        run: takes the robot and the arguments of the `calib` command; returns the same result type as for an arm.
        check: takes the folder for the results and the files read; raises UsageError if an input would be overwritten.
        judge: takes inputs, model and findings of an identification; returns its assessment on all recordings.
    """

    run: Callable[..., Any]
    check: Callable[..., None]
    judge: Callable[..., Any] | None = None


@runtime_checkable
class Mechanism(Protocol):
    """Robot that is not a serial arm, found by a `RobotKind`.

    Attributes:
        kind: name of the kind: ``parallel robot``.
        source: file that it was read from.
        chain: its actuated joints in the form of an arm's: name, n, joint_names, joints.
        instead: command that it does not support → advice, as a clause.
    """

    @property
    def kind(self) -> str: ...
    @property
    def source(self) -> Path: ...
    @property
    def instead(self) -> Mapping[str, str]: ...
    @property
    def chain(self) -> Any: ...

    def write(self, folder: Path) -> None:
        """Write ``robot.toml`` into a folder, so that the folder can be given as this robot."""
        ...

    def model_table(self, dynamics: Any, base: Any, unit: str) -> dict[str, object]:
        """Return an identified model in the form of ``dynamics.json``."""
        ...


@runtime_checkable
class MechanismResult(Protocol):
    """Result of a fit or an identification of a robot that is not a serial arm."""

    @property
    def verdict(self) -> Verdict: ...

    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write the result folder in the form of `calib fit` or `calib identify`."""
        ...

    def with_unseen(self, unseen: Sequence[object]) -> MechanismResult:
        """Return the result with its verdict extended to more unseen files; nothing is fitted or identified again."""
        ...


def mechanism(robot: object) -> Mechanism | None:
    """Return the robot given as object, name or file if it is not a serial arm; otherwise None.

    Raises:
        RobotError: for a file that contradicts itself.
    """
    if isinstance(robot, Mechanism):
        return robot
    for kind in ROBOTS.all():
        machine = kind.find(robot)
        if machine is not None:
            return machine
    return None


def stage_of(robot: object, verb: str, base: str | None = None, tip: str | None = None) -> CommandStage | None:
    """Return the implementation of a command for a robot (its `run` needs no robot argument); None for serial arms.

    Args:
        base, tip: links of a URDF; other robots have no such links.

    Raises:
        UsageError: for a command that this kind of robot does not support, and for links.
    """
    machine = mechanism(robot)
    if machine is None:
        return None
    stages = next(kind for kind in ROBOTS.all() if machine.kind == kind.KIND).stages()
    if verb not in stages:
        advice = machine.instead.get(verb, f"use {', '.join(stages)}")
        name = machine.source
        if isinstance(robot, (str, Path)):
            name = robot
        raise UsageError(f"{name} is a {machine.kind}, and {verb} is for serial arms only; {advice}")
    for key, link in (("base", base), ("tip", tip)):
        if link:
            raise UsageError(f"{key} '{link}' is a link of a URDF; a {machine.kind} has no such links")
    stage = stages[verb]
    return replace(stage, run=partial(_run, stage.run, machine))


def _run(run: Callable[..., object], machine: Mechanism, *args: object, **options: object) -> object:
    """Return the result of a command; raise UsageError for an argument that is stated but only serial arms have."""
    parameters = signature(run).parameters
    run_options = {}
    for key, value in options.items():
        if key in parameters:
            run_options[key] = value
        elif value is not None:
            advice = machine.instead.get(key, "leave it out")
            raise UsageError(f"{key} is for serial arms only, not for a {machine.kind}; {advice}")
    return run(machine, *args, **run_options)


def joints_of(chain: Any) -> Joints:
    """Return the names and limits of the joints of an arm or mechanism, for checking measurements and recordings."""
    # slow to load, and the shell's completion asks this module for the kinds of robot
    import numpy as np

    from calib.data.schema import Joints
    from calib.robot.chain import joint_kinds

    lower = np.array([joint.lower for joint in chain.joints])
    upper = np.array([joint.upper for joint in chain.joints])
    effort = np.array([joint.effort for joint in chain.joints])
    return Joints(chain.joint_names, tuple(joint_kinds(chain)), lower, upper, effort)

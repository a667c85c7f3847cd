"""Commands for robots other than serial arms: the kind of a robot, and the commands available for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from calib.config_types import Plots
from calib.errors import UsageError
from calib.extensions import Point

if TYPE_CHECKING:
    from calib.data.schema import Joints
    from calib.procedure.findings import Verdict


class RobotKind(Protocol):
    """A kind of robot that is not a serial arm; a package or module implements this protocol.

    Attributes:
        KIND: name of the kind, equal to `Mechanism.kind` of its robots.
        LIBRARY: folder with the robots that can be referred to by name instead of by file.
    """

    KIND: str
    LIBRARY: Path

    def find(self, robot: object) -> Mechanism | None:
        """Return the robot that a name, file or object describes; None if the robot is not of this kind."""
        ...

    def stages(self) -> Mapping[str, CommandStage]:
        """Return the implementations of the commands: name of the command -> implementation."""
        ...

    def drive_gains(
        self,
        robot: object,
        cases: Sequence[object],
        settings: object,
        known: Mapping[str, float],
        reference: int | None,
    ) -> Any:
        """Return the drive gains (`calib.identification.gains.DriveGains`) from recordings of motor currents [A].

        Args:
            robot: the robot.
            cases: recordings with different payloads.
            settings: settings of the identification.
            known: known parameters of payloads: name -> value [SI].
            reference: index of the joint relative to whose gain the other gains are identified; None: a payload is
                known, and the gains are absolute.
        """
        ...


ROBOTS: Point[RobotKind] = Point("robots", "kinds of robot other than serial arms")


@dataclass(frozen=True)
class CommandStage:
    """Implementation of one command for robots of one kind.

    Attributes:
        run: takes the robot and the arguments of the `calib` command; returns the same result type as for an arm.
        check: takes the folder for the results and the files read; raises UsageError if an input would be overwritten.
        judge: takes inputs, model and findings of an identification; returns the assessment of the model on all
            recordings.
    """

    run: Callable[..., Any]
    check: Callable[..., None]
    judge: Callable[..., Any] | None = None


@runtime_checkable
class Mechanism(Protocol):
    """A robot that is not a serial arm; `RobotKind.find` returns such robots.

    Attributes:
        kind: name of the kind, such as ``parallel robot``.
        source: file from which the robot was read.
        chain: the actuated joints with the attributes of a serial arm: name, n, joint_names, joints.
        instead: name of a command that this robot does not support -> advice for the user, as a clause.
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
        """Write ``robot.toml`` into a folder; commands then accept the folder as this robot."""
        ...

    def model_table(self, dynamics: Any, base: Any, unit: str) -> dict[str, object]:
        """Return an identified dynamic model of this robot in the form of ``dynamics.json``.

        Args:
            dynamics: the model.
            base: its base parameters.
            unit: unit of the torques.
        """
        ...


@runtime_checkable
class MechanismResult(Protocol):
    """Result of a fit or an identification for a robot that is not a serial arm."""

    @property
    def verdict(self) -> Verdict: ...

    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Write a result folder with the same files as `calib fit` or `calib identify`, and return its path.

        Args:
            out: the folder.
            plots: whether figures are drawn.
        """
        ...

    def with_unseen(self, unseen: Sequence[object]) -> MechanismResult:
        """Return the result with a verdict that also covers further held-out files.

        Nothing is fitted or identified again.

        Args:
            unseen: the files: measurements for a fit, recordings for an identification.
        """
        ...


def mechanism(robot: object) -> Mechanism | None:
    """Return the robot given as object, name or file if it is not a serial arm; otherwise None.

    Raises:
        RobotError: for a robot file with contradictory content.
    """
    if isinstance(robot, Mechanism):
        return robot
    for kind in ROBOTS.all():
        machine = kind.find(robot)
        if machine is not None:
            return machine
    return None


def stage_of(robot: object, verb: str, base: str | None = None, tip: str | None = None) -> CommandStage | None:
    """Return the implementation of a command for a robot that is not a serial arm; None for serial arms.

    The returned `run` has the robot already bound as its first argument.

    Args:
        robot: the robot as object, name or file.
        verb: name of the command.
        base, tip: names of links of a URDF; only serial arms have them; None: not stated.

    Raises:
        UsageError: for a command that this kind of robot does not support, and if `base` or `tip` is stated.
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
    """Return the result of a command for a robot that is not a serial arm.

    Args:
        run: implementation of the command.
        machine: the robot.
        *args: further positional arguments of the command.
        **options: arguments of the command by name.

    Raises:
        UsageError: for an argument with a value that applies to serial arms only.
    """
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
    """Return names, kinds, position and torque limits of the joints, for checking measurements and recordings.

    Args:
        chain: the arm; for other robots, an object with its actuated joints.
    """
    # slow to load, and the shell's completion asks this module for the kinds of robot
    import numpy as np

    from calib.data.schema import Joints
    from calib.robot.chain import joint_kinds

    lower = np.array([joint.lower for joint in chain.joints])
    upper = np.array([joint.upper for joint in chain.joints])
    effort = np.array([joint.effort for joint in chain.joints])
    return Joints(chain.joint_names, tuple(joint_kinds(chain)), lower, upper, effort)

"""Commands for robots other than serial arms: detection of the kind of robot, and its available commands."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from calib.data.schema import Joints
from calib.errors import UsageError
from calib.extensions import Point, merged
from calib.procedure.findings import Verdict
from calib.robot.chain import joint_kinds

ROBOTS: Point[Callable[[object], Mechanism | None]] = Point(
    "robots", "the robot that a person names, if it is no serial arm"
)
STAGES: Point[Mapping[str, Mapping[str, Stage]]] = Point("stages", "kind of robot → verb → stage")


@dataclass(frozen=True)
class Stage:
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
    """Robot that is not a serial arm, provided by a plug-in package (``robots`` of `calib.extensions`).

    Attributes:
        kind: what it is, in words: ``parallel robot``.
        source: the file it came from.
        chain: its actuated joints as those of an arm: name, n, joint_names, joints.
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

    def model_table(self, dynamics: Any, base: Any, unit: str) -> dict[str, Any]:
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

    def with_unseen(self, unseen: Sequence[Any]) -> MechanismResult:
        """Return the result with its verdict extended to more unseen files; nothing is fitted or identified again."""
        ...


def mechanism(robot: object) -> Mechanism | None:
    """Return the robot given as object, name or file if it is not a serial arm; otherwise None.

    Raises:
        RobotError: for a file that contradicts itself.
    """
    if isinstance(robot, Mechanism):
        return robot
    return next((found for find in ROBOTS.all() if (found := find(robot)) is not None), None)


def stage_of(robot: object, verb: str, base: str | None = None, tip: str | None = None) -> Stage | None:
    """Return the implementation of a command for a robot (its `run` needs no robot argument); None for serial arms.

    Args:
        base, tip: links of a URDF; other robots have no such links.

    Raises:
        UsageError: for a command that this kind of robot does not support, and for links.
    """
    found = mechanism(robot)
    if found is None:
        return None
    stages: Mapping[str, Stage] = merged(STAGES)[found.kind]
    if verb not in stages:
        instead = found.instead.get(verb, f"{', '.join(stages)} take it")
        named = robot if isinstance(robot, (str, Path)) else found.source
        raise UsageError(f"{named} is a {found.kind}, and {verb} is for serial arms only; {instead}")
    for key, value in (("base", base), ("tip", tip)):
        if value:
            raise UsageError(f"{key} '{value}' is a link of a URDF; a {found.kind} has no such links")
    return replace(stages[verb], run=partial(_run, stages[verb].run, found))


def _run(run: Callable[..., Any], found: Mechanism, *args: Any, **given: Any) -> Any:
    """Return the result of a command; raise UsageError for an argument that is given but only serial arms have."""
    known = signature(run).parameters
    for key in given.keys() - known.keys():
        if given[key] is not None:
            instead = found.instead.get(key, "leave it out")
            raise UsageError(f"{key} is for serial arms only, not for a {found.kind}; {instead}")
    return run(found, *args, **{key: value for key, value in given.items() if key in known})


def joints_of(chain: Any) -> Joints:
    """Return the names and limits of the joints of an arm or mechanism, for checking measurements and recordings."""
    limits = (np.array([getattr(joint, key) for joint in chain.joints]) for key in ("lower", "upper", "effort"))
    return Joints(chain.joint_names, tuple(joint_kinds(chain)), *limits)

"""Serial arms and other robots behind the same verbs: how another kind of robot is found, and which verbs it has."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from calib.errors import UsageError
from calib.extensions import merged, offered
from calib.procedure.findings import Verdict


@dataclass(frozen=True)
class Stage:
    """How one verb is carried out for a kind of robot.

    Attributes:
        run: takes the robot and what the verb of `calib` takes; returns a result as of a serial arm.
        check: takes the folder for the results and the files read; raises UsageError for what would be written over.
        judge: takes inputs, model and findings of an identification; returns its assessment on all recordings.
    """

    run: Callable[..., Any]
    check: Callable[..., None]
    judge: Callable[..., Any] | None = None


@runtime_checkable
class Mechanism(Protocol):
    """A robot that is no serial arm, as a room offers it (``robots`` of `calib.extensions`).

    Attributes:
        kind: what it is, in words: ``parallel robot``.
        source: the file it came from.
        chain: its actuated joints as those of an arm: name, n, joint_names, joints.
        instead: verb that it does not have → what to do, in a clause.
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
        """Write ``robot.toml`` into a folder, by which the folder is this robot."""
        ...

    def model_table(self, dynamics: Any, base: Any, unit: str) -> dict[str, Any]:
        """Return an identified model as ``dynamics.json`` holds it."""
        ...


@runtime_checkable
class MechanismResult(Protocol):
    """A fit or an identification of a robot that is no serial arm; `verdict` judges it."""

    @property
    def verdict(self) -> Verdict: ...

    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write the folder that the command writes."""
        ...

    def with_unseen(self, unseen: Sequence[Any]) -> MechanismResult:
        """Return the result judged anew on more files; nothing is fitted or identified again."""
        ...


def mechanism(robot: object) -> Mechanism | None:
    """Return the robot of another kind that `robot` is, or names; None for a serial arm, and for what is no robot.

    Raises:
        RobotError: for a file that contradicts itself.
    """
    if isinstance(robot, Mechanism):
        return robot
    return next((found for find in offered("robots") if (found := find(robot)) is not None), None)


def stage_of(robot: object, verb: str, base: str | None = None, tip: str | None = None) -> Stage | None:
    """Return how a verb is carried out for a robot, its `run` bound to it; None for serial arms.

    Args:
        base, tip: links of a URDF, which other robots have none of.

    Raises:
        UsageError: for a verb that its kind of robot does not have, and for links.
    """
    found = mechanism(robot)
    if found is None:
        return None
    stages: Mapping[str, Stage] = merged("stages")[found.kind]
    if verb not in stages:
        instead = found.instead.get(verb, f"{', '.join(stages)} take it")
        named = robot if isinstance(robot, (str, Path)) else found.source
        raise UsageError(f"{named} is a {found.kind}, and {verb} is for serial arms yet; {instead}")
    for key, value in (("base", base), ("tip", tip)):
        if value:
            raise UsageError(f"{key} '{value}': a link of a URDF, which a {found.kind} has none of")
    return replace(stages[verb], run=partial(stages[verb].run, found))


def refuse_unread(settings: Any, plain: Any, read: Collection[str], where: object = "") -> None:
    """Refuse settings that a stage does not read, where they ask for something: neither as usual nor switched off.

    Args:
        settings, plain: dataclasses of one type: as given, and as usual.
        read: names of the fields that the stage reads.
        where: the file they stand in.

    Raises:
        UsageError: naming the first.
    """
    for each in fields(settings):
        value = getattr(settings, each.name)
        if each.name not in read and value is not False and value != getattr(plain, each.name):
            place, shown = f"{where}: " if where else "", f" '{value}'" if isinstance(value, str) else ""
            raise UsageError(f"{place}{each.name}{shown} is for serial arms yet, not for this kind of robot")

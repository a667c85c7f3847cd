"""Compensation inside a controller's program: ``calib compensate FIT PROGRAM.src --out SENT.src``.

The targets in a program (`calib.rooms.controllers.targets`) are replaced by ones that bring the real tool to where
they are meant; every other byte stays. A joint target becomes the joint command. A pose becomes the pose that the
nominal robot, the controller's own model, has at the joint command: ``--tool`` is the tool that the program has active,
``--frame`` where its base frame stands. A pose does not say elbow or wrist: they are those of the solution nearest to
``--start``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.data.poses.pose_lists import Targets
from calib.errors import UsageError
from calib.geometry.installation import see
from calib.rooms.compensation.joint_commands import Commands, Fitted, computed, lines, placements
from calib.rooms.controllers.targets import Program, pose_values


@dataclass(frozen=True, eq=False)
class CompensatedProgram:
    """A program and new targets for it.

    Attributes:
        program: as it was.
        commands: of its joint targets and of its poses; only kinds that it has.
        values: the new numbers of each target in the controller's units; None for a target that is not reached.
    """

    program: Program
    commands: tuple[Commands, ...]
    values: tuple[np.ndarray | None, ...]

    @property
    def lost(self) -> list[str]:
        """Targets that are not reached, each with its line and the reason."""
        reasons = {
            place: words
            for one in self.commands
            for place, words in zip(self.program.of("pose" if one.targets.q is None else "joints"), one.reason)
        }
        targets = self.program.targets
        return [f"line {targets[k].line}: {reasons[k]}" for k, value in enumerate(self.values) if value is None]

    def lines(self) -> list[str]:
        """Return the lines for the user."""
        met = [one for one in self.commands if one.reached.any()]
        shown = [line for one in met for line in lines(one) if not line.startswith("not reached")]
        kept = ["not reached, left as it was: " + words for words in self.lost]
        return [*dict.fromkeys(shown), *kept, *filter(None, [self.program.unread])]

    def write(self, out: Path, partial: bool) -> Path:
        """Write the program with its new targets.

        Raises:
            UsageError: where a target is not reached and `partial` does not allow that; nothing is written.
        """
        lost, path = self.lost, self.program.path
        if lost and (not partial or len(lost) == len(self.values)):
            head = f"{path}: {len(lost)} of {len(self.values)} targets are not reached; nothing was written"
            advice = "" if len(lost) == len(self.values) else "\nwith --partial, these stay as they are"
            raise UsageError("\n  ".join([head, *lost]) + advice)
        return files.write(out, self.program.rewritten(self.values))


def compensated(
    fitted: Fitted,
    program: Program,
    *,
    frame: str = "base",
    tool: str = "flange",
    start: Sequence[float] | None = None,
    **options: Any,
) -> CompensatedProgram:
    """Return a program's new targets.

    Args:
        fitted: the calibrated arm.
        program: see `calib.rooms.controllers.targets.read_program`.
        frame, tool: as for joint commands.
        start: (n,) near which the joints of poses are sought [rad]; needed where the program has poses.
        options: further ones of `joint_commands.computed`.

    Raises:
        UsageError: for a program of another number of axes, and for poses without a start.
    """
    joints, poses = program.of("joints"), program.of("pose")
    n, kind = fitted.nominal.chain.n, program.controller
    if joints and len(program.targets[joints[0]].values) != n:
        axes = len(program.targets[joints[0]].values)
        raise UsageError(f"{program.path}: its targets have {axes} axes, the robot has {n} joints")
    if poses and start is None:
        line = program.targets[poses[0]].line
        raise UsageError(
            f"{program.path}: {len(poses)} targets (the first in line {line}) are poses, which do not say elbow "
            "or wrist; give joints near them: --start q1,...,qn [rad]"
        )
    given: list[tuple[list[int], Targets]] = []
    if joints:
        given.append((joints, Targets(program.joints(), file=str(program.path))))
    if poses:
        given.append((poses, replace(Targets.of(program.poses()), file=str(program.path))))
    model, values, done = placements(fitted, frame, tool)[0], [None] * len(program.targets), []
    for places, targets in given:
        near = None if targets.q is not None else start
        found = computed(fitted, targets, frame=frame, tool=tool, start=near, **options)
        new = kind.shown(found.q) if near is None else pose_values(kind, see(model, found.q).poses())
        for place, row, reached in zip(places, new, found.reached):
            values[place] = row if reached else None
        done.append(found)
    return CompensatedProgram(program, tuple(done), tuple(values))

"""Compensation inside a controller's program: ``calib compensate FIT PROGRAM.src --out SENT.src``.

The targets in a program (`calib.apps.controller_programs.targets`) are replaced by ones that bring the real tool to
where they are meant; every other byte stays. A joint target becomes the joint command. A pose becomes the pose that the
nominal robot, the controller's own model, has at the joint command.

Tool and user frame of a pose are read from the program (`calib.apps.controller_programs.languages`), or stated:
``--tool``, ``--user-frame``, ``--frames`` with a file of the controller; else the program is refused. Elbow, wrist and
turns are those of its configuration (`calib.apps.controller_programs.configurations`); where it says none, of the
solution nearest to ``--start``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.apps.compensation.joint_commands import Commands, Fitted, computed, lines, placements
from calib.apps.compensation.program_frames import Group, Statements, placed, tool_in_tip, user_poses
from calib.apps.controller_programs.configurations import (
    Configuration,
    Postures,
    configuration_of,
    has_spherical_wrist,
    postures,
)
from calib.apps.controller_programs.targets import Program, pose_values
from calib.errors import UsageError, listing
from calib.records import FieldValues
from calib.toolkit.installations import Goal, see
from calib.toolkit.pose_data import Targets


@dataclass(frozen=True, eq=False)
class Part:
    """Joint commands for some of a program's targets.

    Attributes:
        indices: indices of these targets among the program's targets.
        commands: the joint commands.
        values: new numbers of the targets, one row per target [the controller's units].
        notes: remarks on these targets.
    """

    indices: tuple[int, ...]
    commands: Commands
    values: np.ndarray
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class CompensatedProgram:
    """A program and its new targets.

    Attributes:
        program: the program as read.
        parts: joint commands of the joint targets, and of the poses in groups of one tool and one configuration.
        notes: remarks on the frames of the poses.
    """

    program: Program
    parts: tuple[Part, ...]
    notes: tuple[str, ...] = ()

    @property
    def values(self) -> list[np.ndarray | None]:
        """New numbers of each target [the controller's units]; None for a target that is not reached."""
        values: list[np.ndarray | None] = [None] * len(self.program.targets)
        for part in self.parts:
            for index, numbers, reached in zip(part.indices, part.values, part.commands.reached):
                if reached:
                    values[index] = numbers
        return values

    @property
    def lost(self) -> list[str]:
        """One text for each target that is not reached: the line in the program, and the reason."""
        reasons = {}
        for part in self.parts:
            reasons |= dict(zip(part.indices, part.commands.reason))
        lost = []
        for k, (target, value) in enumerate(zip(self.program.targets, self.values)):
            if value is None:
                lost.append(f"line {target.line}: {reasons[k]}")
        return lost

    def lines(self) -> list[str]:
        """Return the console lines: notes, and the targets that are not reached."""
        notes = list(self.notes)
        for part in self.parts:
            notes += part.notes
            if part.commands.reached.any():
                notes += [line for line in lines(part.commands) if not line.startswith("not reached")]
        # a note that several parts have is said once
        result = list(dict.fromkeys(notes))
        result += [f"not reached, target unchanged: {reason}" for reason in self.lost]
        if self.program.unread:
            result.append(self.program.unread)
        return result

    def write(self, out: Path, partial: bool) -> Path:
        """Write the program with its new targets and return its path.

        Args:
            out: file of the new program.
            partial: also write the program if some targets are not reached; their numbers are unchanged.

        Raises:
            UsageError: no target is reached, or, without `partial`, some are not; nothing is written.
        """
        lost = self.lost
        count = len(self.values)
        if lost and (not partial or len(lost) == count):
            head = f"{self.program.path}: {len(lost)} of {count} targets are not reached; nothing was written"
            message = "\n  ".join([head, *lost])
            if len(lost) != count:
                message += "\nwith --partial, all other targets are written, and those above stay unchanged"
            raise UsageError(message)
        return files.write(out, self.program.rewritten(self.values))


def compensated(
    fitted: Fitted,
    program: Program,
    *,
    frame: str = "base",
    statements: Statements | None = None,
    start: Sequence[float] | None = None,
    seed: int = 0,
    **options: Any,
) -> CompensatedProgram:
    """Return a program with corrected targets, which bring the real tool to the program's nominal targets.

    Args:
        fitted: the calibrated arm.
        program: a program, as `calib.apps.controller_programs.targets.read_program` returns it.
        frame: frame of the targets, as for joint commands; a station is the program's user frame.
        statements: tool and frames that the program does not contain; None: nothing is specified.
        start: (n,) joint values near which the joint values of poses are sought [rad]; needed where poses have no
            configuration.
        seed: seed of further starts.
        options: further options of `joint_commands.computed`.

    Raises:
        UsageError: a number of axes other than the arm's, unknown frames, or poses without a configuration if there is
            no start.
    """
    statements = statements or Statements()
    joints, poses = program.of("joints"), program.of("pose")
    _check_arm(fitted, program)
    groups, notes = (), ()
    if poses:
        placement = placed(fitted, program, frame, statements)
        groups, notes = placement.groups, placement.notes
    _check_postures(fitted, program, groups, start)
    options |= {"frame": frame, "seed": seed}
    parts = []
    if joints:
        targets = Targets(program.joints(), file=str(program.path))
        tool = tool_in_tip(fitted, program.controller, statements)
        commands = computed(fitted, targets, tool=tool, **options)
        parts.append(Part(tuple(joints), commands, program.shown(commands.q)))
    parts += [_compensated_group(fitted, program, group, start, options) for group in groups]
    return CompensatedProgram(program, tuple(parts), notes)


def _check_arm(fitted: Fitted, program: Program) -> None:
    """Raise UsageError for joint targets of another robot, or poses of a robot on external axes.

    Args:
        fitted: the calibrated arm.
        program: the program.
    """
    chain = fitted.nominal.chain
    axes = len(program.axes.joints)
    if program.of("joints") and axes != chain.n:
        raise UsageError(
            f"{program.path}: its targets have {axes} axes, but the robot has {chain.n} joints: "
            "is it for another robot?"
        )
    lines = [program.targets[k].line for k in program.of("pose")]
    if lines and program.controller.axes and chain.n > max(program.controller.axes):
        raise UsageError(
            f"{program.path}: line {listing(lines, 3)}: poses of an arm with external axes are not compensated, since "
            "the frame in which they stand may move with these axes: give joint targets, or a CSV of targets"
        )


def _check_postures(fitted: Fitted, program: Program, groups: Sequence[Group], start: Sequence[float] | None) -> None:
    """Raise UsageError if poses have no configuration and no start is given.

    Args:
        fitted: the calibrated arm, whose nominal arm may have a spherical wrist (configurations require one).
        program: the program.
        groups: its poses by tool and configuration.
        start: (n,) joint values that decide between configurations; None: not given.
    """
    if start is not None:
        return
    spherical = has_spherical_wrist(fitted.nominal.chain)
    silent: list[int] = []
    for group in groups:
        if not group.configuration or not spherical:
            silent += group.indices
    if silent:
        location = f"{len(silent)} targets (the first in line {program.targets[min(silent)].line})"
        cause = "the program does not state the configuration of elbow and wrist"
        if not spherical and any(group.configuration for group in groups):
            cause = "configurations are read only for arms whose last three axes meet in a point, unlike this arm"
        raise UsageError(
            f"{program.path}: {location} are poses, and {cause}; give joint values near them: --start q1,...,qn [rad]"
        )


def _compensated_group(
    fitted: Fitted, program: Program, group: Group, start: Sequence[float] | None, options: FieldValues
) -> Part:
    """Return the joint commands and new numbers for the poses of one group.

    Args:
        fitted: the calibrated arm.
        program: the program.
        group: the poses, with one tool and one configuration.
        start: (n,) joint values near which the joint values of poses are sought [rad]; None: not given.
        options: frame, seed and further arguments of `joint_commands.computed`.
    """
    controller = program.controller
    model, _ = placements(fitted, options["frame"], group.tool)
    chain = model.chain
    configuration = None
    if has_spherical_wrist(chain):
        configuration = configuration_of(controller, group.configuration)
    targets = replace(Targets.of(group.poses), file=str(program.path))
    notes = ()
    if configuration is None:
        commands = computed(fitted, targets, tool=group.tool, start=start, **options)
    else:
        goal = Goal(model, 6, chain.lower, chain.upper)
        sought = postures(goal, group.poses, configuration, controller, start, options["seed"])
        targets = replace(targets, q=sought.q)
        commands = computed(fitted, targets, tool=group.tool, **options)
        if start is None:
            commands = _without(commands, sought.reasons)
        notes = _posture_notes(program, group, configuration, commands, sought)
    nominal_poses = see(model, commands.q).poses()
    values = pose_values(controller, user_poses(group, nominal_poses))
    return Part(group.indices, commands, values, notes)


def _without(commands: Commands, reasons: Sequence[str]) -> Commands:
    """Return the commands, those with a non-empty text in `reasons` marked as not reached for that reason.

    Args:
        commands: m joint commands.
        reasons: (m,) texts.
    """
    reached = commands.reached.copy()
    command_reasons = list(commands.reason)
    for k, reason in enumerate(reasons):
        if reason:
            reached[k] = False
            command_reasons[k] = f"{reason}; with --start q1,...,qn the posture nearest to it is taken"
    return replace(commands, reached=reached, reason=tuple(command_reasons))


def _posture_notes(
    program: Program, group: Group, configuration: Configuration, commands: Commands, sought: Postures
) -> tuple[str, ...]:
    """Return notes on poses whose configuration is contradictory, and on commands that are in another configuration.

    A configuration is contradictory if no posture at the pose has it, or if the posture nearest to the start has
    another.

    Args:
        program: the program.
        group: the poses, with one tool and one configuration.
        configuration: the configuration that the program prescribes.
        commands: the joint commands at these poses.
        sought: the nominal arm's postures at these poses.
    """
    notes = []
    reached = commands.reached
    lines = np.array([program.targets[index].line for index in group.indices])
    unfit = np.array(sought.reasons) != ""
    for k in np.flatnonzero(reached & unfit):
        outcome = "the posture nearest to --start is taken"
        notes.append(f"warning: line {lines[k]}: {sought.reasons[k]}; {outcome}")
    against = lines[reached & sought.contradicted & ~unfit]
    if len(against):
        message = f"the posture nearest to --start is not that of {configuration.text}; the latter is taken"
        notes.append(f"line {listing(against.tolist(), 5)}: {message}")
    chain = commands.fitted.nominal.chain
    crossing = lines[reached & ~unfit & ~configuration.holds(program.controller, chain, commands.q)]
    if len(crossing):
        message = f"the new joint values are outside {configuration.text}, which stays in the program: change it there"
        notes.append(f"warning: line {listing(crossing.tolist(), 5)}: {message}")
    return tuple(notes)

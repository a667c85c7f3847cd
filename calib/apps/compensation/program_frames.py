"""Where the poses of a controller's program stand: its tools and user frames, read or stated.

A pose P in user frame U for a tool T means, in the description's terms, the flange at  B · U · P · T⁻¹ · F⁻¹  of the
arm's base, with the controller's base B and flange F (`calib.apps.controller_programs.frames`). Numbers are read from
the program and from files beside it (`calib.apps.controller_programs.languages`), or stated; a frame that is neither is
named, and the program is refused.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.apps.compensation.joint_commands import Fitted
from calib.apps.controller_programs.frames import Description, base_frame, flange_frame, stated_frame
from calib.apps.controller_programs.languages import LANGUAGES, ProgramFrames, frames_in
from calib.apps.controller_programs.targets import Program
from calib.errors import UsageError, listing
from calib.toolkit.chains import Controller
from calib.transforms import invert, to_xyz_rpy

# largest difference between a frame stated by the user and the frame read from the program, in any element of their
# matrices (positions in m)
AGREE = 5e-5


@dataclass(frozen=True, eq=False)
class Statements:
    """What the user specifies about the frames of a program.

    Attributes:
        tool: ``flange`` (the all-zero tool), a tool of the fit, or ``x,y,z[,roll,pitch,yaw]`` in the controller's
            flange [m, rad]; None: the tool of each pose is read from the program.
        user: ``x,y,z[,roll,pitch,yaw]`` of the user frame in the controller's base [m, rad]; None: the frame is read
            from the program.
        world: (4, 4) pose of the controller's base in the arm's base; None: known from the robot's description, or from
            the controller's rule.
        flange: (4, 4) pose of the controller's flange in the arm's tip; None: known from the robot's description, or
            from the controller's rule.
        files: file name to text, of further files of the controller.
    """

    tool: str | None = None
    user: str | None = None
    world: np.ndarray | None = None
    flange: np.ndarray | None = None
    files: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Group:
    """Poses of a program that share one tool and one configuration.

    Attributes:
        indices: indices of these poses among the program's targets.
        tool: the tool, in the form that `joint_commands.placements` accepts.
        users: (m, 4, 4) poses of the user frames in the frame of the targets.
        poses: (m, 4, 4) tool poses in the frame of the targets [m].
        configuration: the configuration as the program writes it; empty where the program has none.
    """

    indices: tuple[int, ...]
    tool: str
    users: np.ndarray
    poses: np.ndarray
    configuration: str


@dataclass(frozen=True, eq=False)
class Placed:
    """All poses of a program in the frame of the targets, in groups, and notes on the program's frames."""

    groups: tuple[Group, ...]
    notes: tuple[str, ...]


def placed(fitted: Fitted, program: Program, frame: str, statements: Statements) -> Placed:
    """Return a program's poses in the frame of the targets, grouped by tool and configuration.

    Args:
        fitted: the calibrated arm.
        program: a program with poses.
        frame: ``base``, ``nominal``, or a station of the fit; a station is then the program's user frame.
        statements: what the user specifies about the frames.

    Raises:
        UsageError: frames that are neither in the program nor specified (the message lists all), or a specification
            that contradicts the program.
    """
    arm = Description.of_fit(fitted.folder, fitted.nominal.chain)
    frames = frames_in(program, statements.files)
    flange = flange_frame(program.controller, arm, statements.flange)
    base = base_frame(program.controller, arm, statements.world)
    names = fitted.cell.tool_names
    in_station = frame not in ("base", "nominal")
    measured = statements.tool in names
    refusals: list[str] = []
    notes: list[str] = []

    tool_names = {setting.tool for setting in frames.settings}
    tools = dict.fromkeys(tool_names, statements.tool or "")
    if not measured:
        numbers = _completed(program, frames, "tool", _stated_tool(statements.tool, names), refusals)
        if flange.pose is None:
            refusals.append(f"{flange.name} is {flange.basis}")
        else:
            for name, pose in numbers.items():
                tools[name] = _as_option(flange.pose @ pose)
                notes.append(f"tool {name or 'active'}: {_in_words(pose)} in {flange}")
    elif len(tools) > 1:
        refusals.append(f"--tool states one tool, the program has {listing(sorted(tools), 5)}: give --frames FILE")

    user_names = {setting.user for setting in frames.settings}
    users = dict.fromkeys(user_names, np.eye(4))
    if in_station and statements.user is not None:
        refusals.append(f"--user-frame and --frame {frame} both state the user frame: give one of them")
    if in_station:
        notes.append(f"user frame {listing(sorted(users), 5)}: that of station '{frame}', as calib deliver gives it")
    else:
        numbers = _completed(program, frames, "user", stated_frame(statements.user, "--user-frame"), refusals)
        if base.pose is None:
            refusals.append(f"{base.name} is {base.basis}")
        else:
            for name, pose in numbers.items():
                users[name] = base.pose @ pose
                notes.append(f"user frame {name or 'active'}: {_in_words(pose)} in {base}")
    if refusals:
        count = len(frames.settings)
        head = f"{program.path}: the frames of its {count} poses are missing or contradictory; nothing was written"
        raise UsageError("\n  ".join([head, *refusals]))
    if not in_station:
        warnings = [base.warning, flange.warning]
        notes += [f"warning: {warning}" for warning in warnings if warning]
    return Placed(_grouped(program, frames, tools, users), tuple(notes))


def tool_in_tip(fitted: Fitted, controller: Controller, statements: Statements) -> str:
    """Return the specified tool in the form that `joint_commands.placements` accepts; ``flange`` if none is specified.

    Used for joint targets, since a program does not name a tool for them.

    Args:
        fitted: the calibrated arm with its tools.
        controller: the program's controller, which defines the flange.
        statements: what the user specifies about the frames.

    Raises:
        UsageError: a tool that cannot be parsed, or a controller whose flange is not known.
    """
    names = fitted.cell.tool_names
    if statements.tool is None or statements.tool in names:
        return statements.tool or "flange"
    pose = _stated_tool(statements.tool, names)
    flange = flange_frame(controller, Description.of_fit(fitted.folder, fitted.nominal.chain), statements.flange)
    if pose is None or flange.pose is None:
        raise UsageError(f"--tool {statements.tool}: {flange.name} is {flange.basis}")
    return _as_option(flange.pose @ pose)


def _as_option(pose: np.ndarray) -> str:
    """Return a pose (4, 4) as the text ``x,y,z,roll,pitch,yaw`` [m, rad]."""
    values = np.hstack(to_xyz_rpy(pose))
    return ",".join(f"{value:.12g}" for value in values)


def _grouped(
    program: Program, program_frames: ProgramFrames, tools: Mapping[str, str], users: Mapping[str, np.ndarray]
) -> tuple[Group, ...]:
    """Return the program's poses grouped by tool and configuration, the groups in order of first appearance.

    Args:
        program: a program with poses.
        program_frames: tool, user frame and configuration of each pose.
        tools: name of a tool in the program to the tool in the form that `joint_commands.placements` accepts.
        users: name of a user frame in the program to its pose (4, 4) in the frame of the targets.
    """
    settings = program_frames.settings
    members: dict[tuple[str, str], list[int]] = {}
    for k, setting in enumerate(settings):
        key = (tools[setting.tool], setting.configuration)
        members.setdefault(key, []).append(k)
    poses = program.poses()
    target_indices = np.array(program.of("pose"))
    groups = []
    for (tool, configuration), rows in members.items():
        frames = np.array([users[settings[k].user] for k in rows])
        indices = tuple(target_indices[rows].tolist())
        groups.append(Group(indices, tool, frames, frames @ poses[rows], configuration))
    return tuple(groups)


def _stated_tool(statement: str | None, names: Sequence[str]) -> np.ndarray | None:
    """Return the specified tool's pose (4, 4) in the controller's flange; None where no tool is specified.

    Args:
        statement: ``flange`` or ``x,y,z[,roll,pitch,yaw]`` [m, rad]; None: not specified.
        names: names of the fit's tools, for the error message.

    Raises:
        UsageError: any other text.
    """
    if statement == "flange":
        return np.eye(4)
    try:
        return stated_frame(statement, "--tool")
    except UsageError as error:
        if statement is not None and "," in statement:
            raise
        expected = f"expected flange, a tool of the fit ({', '.join(names)}), or x,y,z[,...]"
        raise UsageError(f"tool {statement}: {expected}") from error


def _completed(
    program: Program, frames: ProgramFrames, kind: str, statement: np.ndarray | None, refusals: list[str]
) -> dict[str, np.ndarray]:
    """Return the poses (4, 4) of a program's tools or user frames by name; unknown frames are appended to `refusals`.

    Args:
        program: the program.
        frames: frames read from the program and from further files.
        kind: ``tool`` or ``user``.
        statement: (4, 4) pose that the user specifies for the frame whose numbers are not in the files; None: not
            specified.
        refusals: lines of the error message, one for each unknown frame; this function appends to the list.
    """
    if kind == "tool":
        option, label, numbers = "--tool", "tool", frames.tools
    else:
        option, label, numbers = "--user-frame", "user frame", frames.users
    # lines of the targets in each frame
    lines: dict[str, list[int]] = {}
    for index, setting in zip(program.of("pose"), frames.settings):
        name = setting.tool if kind == "tool" else setting.user
        lines.setdefault(name, []).append(program.targets[index].line)
    result: dict[str, np.ndarray] = {}
    missing: list[str] = []
    for name in lines:
        if name in numbers:
            result[name] = numbers[name]
        else:
            missing.append(name)
    if statement is not None and len(missing) == 1:
        return result | {missing[0]: statement}
    if statement is not None and missing:
        refusals.append(f"{option} states one {label}, but {len(missing)} have no values: give --frames FILE instead")
    elif statement is not None:
        # no frame lacks numbers: the statement has to agree with those that were read
        for name, pose in result.items():
            if np.abs(pose - statement).max() > AGREE:
                difference = f"but {label} {name} is {_in_words(pose)} in the program's files: correct one of them"
                refusals.append(f"{option} states {_in_words(statement)}, {difference}")
    for name in missing:
        location = f"line {listing(lines[name], 3)}"
        subject = f"the active {label}"
        if name:
            subject = f"{label} {name}"
        refusals.append(f"{subject} ({location}) has no values in these files: state {_advice(program, kind, option)}")
    return result


def _advice(program: Program, kind: str, option: str) -> str:
    """Return a text that explains how the user can specify the numbers of a tool or a user frame.

    Args:
        program: the program, whose controller names the reference frame.
        kind: ``tool`` or ``user``.
        option: name of the option by which the frame is specified.
    """
    frame = program.controller.base
    if kind == "tool":
        frame = program.controller.flange
    advice = f"{option} x,y,z[,roll,pitch,yaw] [m, rad], in {frame}"
    files = LANGUAGES[program.controller.language].files
    if files:
        advice += f"; or --frames FILE ({files})"
    return advice


def _in_words(pose: np.ndarray) -> str:
    """Return a frame's pose as text in millimetres and degrees; ``zero`` for the identity."""
    if np.abs(pose - np.eye(4)).max() < 1e-12:
        return "zero"
    xyz, rpy = to_xyz_rpy(pose)
    position = ", ".join(f"{1e3 * value:.6g}" for value in xyz)
    if np.abs(rpy).max() < 1e-12:
        return f"{position} mm"
    turn = ", ".join(f"{value:.6g}" for value in np.degrees(rpy))
    return f"{position} mm, roll, pitch, yaw {turn}°"


def user_poses(group: Group, poses: np.ndarray) -> np.ndarray:
    """Return poses (m, 4, 4) relative to the group's user frames, as the program writes them.

    Args:
        group: a group of poses of the program.
        poses: (m, 4, 4) poses in the frame of the targets [m].
    """
    return invert(group.users) @ poses

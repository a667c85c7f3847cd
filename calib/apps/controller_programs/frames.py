"""Where a controller's base and flange stand in a robot's description.

A number that is typed into a controller stands in the controller's frames, not in the description's: a FANUC's World is
at the height of axis 2, a UR's Base is base_link turned by 180° about z. What is known comes from, in this order,

    --world, --flange   what the user states: pose of the controller's frame in the arm's base, or in its tip
    links base, tool0   ROS-Industrial's convention, REP 199: ``base`` is the frame in which the controller reports
                        poses, ``tool0`` its all-zero tool
    the controller      rules of ``controllers.toml``, each with its source: against ``base_link``, or by axes 1 and 2;
                        against ``flange``

What none of these says is not known, and no number is given in it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from calib.errors import UsageError
from calib.toolkit.chains import (
    AXES,
    Axes,
    Chain,
    Controller,
    UrdfTree,
    description_text,
    forward,
    joint_frames,
    read_tree,
)
from calib.toolkit.result_folders import FitFolder
from calib.transforms import from_xyz_rpy, invert, rotation_vector, to_xyz_rpy
from calib.units import plain_number

# [m or rad] two frames that differ by less are one: descriptions are rounded to that
SAME = 1e-3
# [m] no controller's base or tool stands farther off: such numbers are millimetres
FARTHEST = 20.0
# [rad] between a tool frame's z and the last axis, between axis 1 and base_link's z
STRAIGHT = 0.02
NO_SHIFT = [0.0, 0.0, 0.0]
NO_TURN = [0.0, 0.0, 0.0]


@dataclass(frozen=True, eq=False)
class ControllerFrame:
    """Base or flange frame of a controller, located in the robot's description.

    Attributes:
        name: the controller's name of the frame.
        pose: (4, 4) pose in the arm's base (for a base frame) or tip (for a flange); None where it is not known.
        basis: how the pose is known; if it is not known, the reason and what to specify.
        warning: a contradiction between the pose and the controller's rule; empty without one.
    """

    name: str
    pose: np.ndarray | None
    basis: str
    warning: str = ""

    def __str__(self) -> str:
        return f"{self.name} ({self.basis})"


@dataclass(frozen=True, eq=False)
class Description:
    """The nominal arm, with the links of its URDF.

    Attributes:
        chain: the nominal arm.
        tree: links and joints of its URDF; None without a URDF.
        axes: its joints as axes of the controller; None: all are the arm's.
    """

    chain: Chain
    tree: UrdfTree | None = None
    axes: Axes | None = None

    @property
    def arm(self) -> tuple[int, ...]:
        """Indices of the joints that are the arm's axes."""
        if self.axes is None:
            return tuple(range(self.chain.n))
        return self.axes.arm

    @classmethod
    def of_fit(cls, folder: Path, chain: Chain, axes: Axes | None = None) -> Self:
        """Return the description of a fit's nominal arm, with the links of the fitted URDF if the fit has one.

        Args:
            folder: the fit's folder.
            chain: the nominal arm.
            axes: its joints as axes of the controller; None: all are the arm's.
        """
        path = FitFolder(folder).urdf
        if not path.is_file():
            return cls(chain, None, axes)
        xml, *_ = description_text(path)
        return cls(chain, read_tree(xml, str(path)), axes)

    @property
    def prefix(self) -> str:
        """Common prefix of the arm's link names, such as ``left_``; empty without one."""
        names = [self.chain.base, self.chain.tip]
        if self.tree is not None:
            root, _ = _fixed_to(self.tree, self.chain.base)
            names += [name for name, _ in self.tree.rigid(root)]
        for name in names:
            for standard in ("base_link", "tool0"):
                if name.endswith(standard):
                    return name.removesuffix(standard)
        return ""

    def has(self, link: str) -> bool:
        """Return whether the description has a link of this name."""
        if self.tree is None:
            return link in (self.chain.base, self.chain.tip)
        return link in self.tree.bodies

    def pose(self, link: str, start: str) -> np.ndarray | None:
        """Return the pose T_start_link (4, 4) [m]; None where a moving joint is between the two links.

        Args:
            link, start: names of existing links.
        """
        if link == start:
            return np.eye(4)
        if self.tree is None:
            return None
        root, pose = _fixed_to(self.tree, link)
        start_root, start_pose = _fixed_to(self.tree, start)
        if root != start_root:
            return None
        return invert(start_pose) @ pose

    def moving_joint(self, link: str) -> str:
        """Return the name of the last moving joint between the root of the URDF and a link; empty without one."""
        if self.tree is None:
            return ""
        for joint in reversed(self.tree.ancestry(link)):
            if joint.kind != "fixed":
                return joint.name
        return ""


def _fixed_to(tree: UrdfTree, link: str) -> tuple[str, np.ndarray]:
    """Return the uppermost link to which a link is rigidly fixed, and the pose (4, 4) of `link` in that link.

    Args:
        tree: links and joints of the URDF.
        link: name of the link.
    """
    pose = np.eye(4)
    while link in tree.above and tree.above[link].kind == "fixed":
        pose = tree.above[link].origin @ pose
        link = tree.above[link].parent
    return link, pose


def stated_frame(statement: str | None, option: str) -> np.ndarray | None:
    """Return the pose (4, 4) [m] that the user stated by an option; None where the option was not used.

    Args:
        statement: text ``x,y,z[,roll,pitch,yaw]`` [m, rad]; None: the option was not used.
        option: name of the option, for the message.

    Raises:
        UsageError: not three or six finite numbers, or a position so large that it must be in millimetres.
    """
    if statement is None:
        return None
    try:
        values = [plain_number(part) for part in statement.split(",")]
    except ValueError:
        values = []
    if len(values) not in (3, 6) or not np.isfinite(values).all():
        count = len(statement.split(","))
        expected = "x,y,z or x,y,z,roll,pitch,yaw [m, rad], separated by commas"
        raise UsageError(f"{option} {statement}: expected {expected}; found {count} values")
    if np.abs(values[:3]).max() > FARTHEST:
        raise UsageError(f"{option} {statement}: {max(values[:3], key=abs):g} m is too far for a robot; are these mm?")
    return from_xyz_rpy(values[:3], values[3:] or NO_TURN)


def base_frame(controller: Controller, arm: Description, statement: np.ndarray | None = None) -> ControllerFrame:
    """Return the controller's base frame, with its pose in the arm's base.

    Args:
        controller: the controller.
        arm: the nominal arm with its links.
        statement: (4, 4) pose that the user specifies, which overrides every other source; None: not specified.
    """
    name, chain = controller.base, arm.chain
    if statement is not None:
        return ControllerFrame(name, statement, f"stated: {_relation(statement, chain.base)}")
    if controller.base_at == "chain":
        return ControllerFrame(name, np.eye(4), f"link {chain.base}")
    ruled, rule = _by_rule(controller, arm)
    link, foot = arm.prefix + "base", arm.prefix + "base_link"
    footed = arm.has(foot)
    state = f"state it: --world x,y,z[,roll,pitch,yaw], its pose in '{chain.base}' [m, rad]"
    if not arm.has(link):
        if ruled is None or not footed:
            reason = rule
            if ruled is not None:
                reason = f"no link '{foot}' whose axes it would have"
            return ControllerFrame(name, None, f"not known: no link '{link}', and {reason}; {state}")
        return ControllerFrame(name, ruled, rule)
    pose = arm.pose(link, chain.base)
    if pose is None:
        joint = arm.moving_joint(link)
        return ControllerFrame(name, None, f"not known: link '{link}' moves with joint '{joint}'; {state}")
    if not footed and ruled is not None and _differs(pose, ruled):
        basis = f"not known: link '{link}' is the description's root, and {name} is usually {rule}; {state}"
        return ControllerFrame(name, None, basis)
    relation = _relation(pose, chain.base)
    if footed:
        pose_on_foot = arm.pose(link, foot)
        if pose_on_foot is not None:
            relation = _relation(pose_on_foot, foot)
    warning = ""
    if ruled is not None and _differs(pose, ruled):
        warning = f"link '{link}' is not where {name} usually is ({rule}): compare with the pendant"
    return ControllerFrame(name, pose, f"link {link}, {relation}", warning)


def flange_frame(controller: Controller, arm: Description, statement: np.ndarray | None = None) -> ControllerFrame:
    """Return the controller's flange frame (that of the all-zero tool), with its pose in the arm's tip.

    Args:
        controller: the controller.
        arm: the nominal arm with its links.
        statement: (4, 4) pose that the user specifies, which overrides every other source; None: not specified.
    """
    name, chain = controller.flange, arm.chain
    if statement is not None:
        return ControllerFrame(name, statement, f"stated: {_relation(statement, chain.tip)}")
    if controller.base_at == "chain":
        return ControllerFrame(name, np.eye(4), f"link {chain.tip}")
    state = f"state it: --flange x,y,z[,roll,pitch,yaw], its pose in '{chain.tip}' [m, rad]"
    for link, turn in ((arm.prefix + "tool0", ()), (arm.prefix + "flange", controller.flange_turn)):
        if not arm.has(link) or (link.endswith("flange") and not turn):
            continue
        pose = arm.pose(link, chain.tip)
        if pose is None:
            return ControllerFrame(name, None, f"not known: link '{link}' is not fixed to '{chain.tip}'; {state}")
        pose = pose @ from_xyz_rpy(NO_SHIFT, np.radians(turn or NO_TURN))
        if _off_axis(chain, arm.arm[-1], pose) > STRAIGHT:
            basis = f"not known: z of link '{link}' is not along the last axis, as a flange's is; {state}"
            return ControllerFrame(name, None, basis)
        basis = f"link {link}"
        if turn:
            basis += ", turned as this controller's"
        return ControllerFrame(name, pose, basis)
    return ControllerFrame(name, None, f"not known: no link 'tool0' or 'flange' in the description; {state}")


def _by_rule(controller: Controller, arm: Description) -> tuple[np.ndarray | None, str]:
    """Return the controller's base (4, 4) in the arm's base by the controller's rule, and the rule in words.

    Where no rule applies, the pose is None and the text gives the reason.
    """
    foot = arm.prefix + "base_link"
    if not controller.base_at:
        return None, f"the base frame of {controller.title} is not documented"
    start = arm.chain.base
    if arm.has(foot):
        start = foot
    placed = arm.pose(start, arm.chain.base)
    if placed is None:
        return None, f"link '{start}' is not fixed to '{arm.chain.base}'"
    if controller.base_at == "axis 2":
        height = _height_of_axis_2(arm.chain, arm.arm, placed)
        if height is None:
            return None, f"{controller.base} is at the height of axis 2, which this arm does not determine"
        rule = f"by rule at the height of axis 2, {height:.6g} m above {start}"
        return placed @ from_xyz_rpy([0.0, 0.0, height], NO_TURN), rule
    if not arm.has(foot):
        return None, f"no link '{foot}', relative to which {controller.base} is defined"
    if controller.base_at == "turned":
        turned = placed @ from_xyz_rpy(NO_SHIFT, [0.0, 0.0, np.pi])
        return turned, f"by rule {foot}, turned by 180° about z"
    return placed, f"by rule at {foot}"


def _height_of_axis_2(chain: Chain, joints: Sequence[int], foot: np.ndarray) -> float | None:
    """Return the height of axis 2 above the frame with pose `foot` (4, 4) in the arm's base [m].

    None where axis 1 is not the frame's z axis, or axis 2 is not horizontal.

    Args:
        chain: the arm.
        joints: indices of the arm's axes among its joints.
        foot: pose of the frame.
    """
    if len(joints) < 2:
        return None
    first, second = joints[:2]
    # both axes in the frame
    T_foot_base = invert(foot)
    turn, shift = T_foot_base[:3, :3], T_foot_base[:3, 3]
    point_1, axis_1 = _line(chain, first)
    point_2, axis_2 = _line(chain, second)
    axis_1, axis_2 = turn @ axis_1, turn @ axis_2
    point_1, point_2 = turn @ point_1 + shift, turn @ point_2 + shift

    across = point_1 - axis_1 * (point_1 @ axis_1)
    is_level = abs(float(axis_2[2])) < STRAIGHT
    is_upright = abs(abs(float(axis_1[2])) - 1.0) < STRAIGHT**2
    if is_level and is_upright and np.linalg.norm(across[:2]) < SAME:
        return float(point_2[2])
    return None


def _line(chain: Chain, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a point (3,) [m] on a joint's axis and the axis' direction (3,) at q = 0, in the arm's base.

    Args:
        chain: the arm.
        joint: index of the joint, from 0.
    """
    frame = joint_frames(chain, np.zeros((1, chain.n)))[joint, 0]
    element = chain.elements[int(chain.moving[joint])]
    column = AXES.index(element.axis) % 3
    return frame[:3, 3], element.sign * frame[:3, column]


def _off_axis(chain: Chain, joint: int, pose: np.ndarray) -> float:
    """Return the angle [rad] between the arm's last axis and the z axis of a frame.

    Args:
        chain: the arm.
        joint: index of the arm's last axis.
        pose: (4, 4) pose of the frame in the tip.
    """
    (tip,) = forward(chain, np.zeros((1, chain.n)))
    z = (tip @ pose)[:3, 2]
    _, last_axis = _line(chain, joint)
    return float(np.linalg.norm(np.cross(z, last_axis)))


def _differs(first: np.ndarray, second: np.ndarray) -> bool:
    between = invert(first) @ second
    shift = np.linalg.norm(between[:3, 3])
    turn = np.linalg.norm(rotation_vector(between[:3, :3]))
    return bool(max(shift, turn) > SAME)


def _relation(pose: np.ndarray, link: str) -> str:
    """Return as text the pose of a frame relative to a link."""
    xyz, rpy = to_xyz_rpy(pose)
    turned, shifted = np.abs(rpy) > 1e-9, np.abs(xyz) > 1e-9
    if not turned.any() and not shifted.any():
        return f"at {link}"
    if not turned.any() and not shifted[:2].any():
        side = "above" if xyz[2] > 0 else "below"
        return f"{abs(xyz[2]):.6g} m {side} {link}"
    shift, turn = "", ""
    if shifted.any():
        position = ", ".join(f"{value:.6g}" for value in xyz)
        shift = f"at {position} m in {link}"
    if turned.any():
        turn = f"turned by {np.degrees(rpy[2]):.6g}° about z"
    if turned[:2].any():
        angles = ", ".join(f"{value:.6g}" for value in np.degrees(rpy))
        turn = f"turned by roll, pitch, yaw {angles}°"
    if not turn:
        return shift
    if not shift:
        return f"{link} {turn}"
    return f"{shift}, {turn}"


def check_known(frames: list[ControllerFrame], heading: str) -> None:
    """Raise UsageError if the pose of one of the frames is not known.

    Raises:
        UsageError: the message begins with `heading`, and lists for each unknown frame what to specify.
    """
    missing = [f"  {frame.name} is {frame.basis}" for frame in frames if frame.pose is None]
    if missing:
        raise UsageError("\n".join([heading, *missing]))

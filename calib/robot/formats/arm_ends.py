"""Where the arm of a URDF begins and ends: the root, and the flange.

A number typed into a controller relates to the frame at the flange, so the chain ends there, however many links hang on
the last axis. Three questions are answered one after the other:

1. Which joints are no axes of an arm? Jaws and fingers, told by structure: a mimic joint and its leader in different
   branches; what hangs beside a tool0 or a flange; a fork of equally short branches. Where structure tells nothing (one
   jaw alone), by name. A joint whose name continues a series (``joint_6`` behind ``joint_5``) is an axis.
2. Which body ends the arm? The last of the longest chain of axes. Another chain with nearly as many axes of its own is
   another arm, and the user chooses.
3. Which of the links fixed to that body? ``tool0``, else ``flange`` (REP 199), else an end effector's frame, else the
   only link that nothing is fixed to, grippers and sensors not counted, else the body's own link.

The rules are our choice, judged on public descriptions of real arms (``tests/robot/formats/test_arm_ends.py``).
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from calib.errors import listing, refuse_robot, suggestion
from calib.robot.formats.urdf_tree import JointTag, UrdfTree

TOOL0 = re.compile(r"(^|[^a-z0-9])tool_?0(_(link|frame))?$", re.IGNORECASE)
FLANGE = re.compile(r"(^|[^a-z0-9])flange(_(link|frame))?$", re.IGNORECASE)
END_WORDS = frozenset(("ee", "eef", "tcp", "tool", "effector", "endeffector"))
SENSOR_WORDS = frozenset(
    ("camera", "cam", "optical", "depth", "lidar", "laser", "imu", "ft", "sensor", "led", "light", "marker")
)
FINGER_WORDS = ("finger", "jaw", "claw", "knuckle", "thumb")
GRIPPER_WORDS = (*FINGER_WORDS, "grip")
NUMBERED = re.compile(r"(\D*)(\d+)")
AXIS_WORDS = frozenset(
    ("wrist", "elbow", "shoulder", "roll", "pitch", "yaw", "rotate", "rotation", "pan", "tilt", "flex")
)
# A second chain is another arm from this many axes of its own, and this share of the longest one's (our choice).
ARM_AXES = 4
ARM_SHARE = 0.75


@dataclass(frozen=True)
class ArmEnds:
    """Base and tip links of an arm, and how they were chosen.

    Attributes:
        base, tip: names of the two links.
        reason: why the tip was chosen, worded to follow the tip's name.
        unused: remarks on joints outside the arm, columns that are not used, and frames that were not chosen.
    """

    base: str
    tip: str
    reason: str = ""
    unused: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """Text with the tip, why it was chosen, and remarks on what is not part of the arm."""
        return "; ".join([f"{self.tip}, {self.reason}", *self.unused])


def choose(tree: UrdfTree, base: str, joint_names: Sequence[str] | None = None) -> ArmEnds:
    """Return base and tip of the arm that begins at the link `base`.

    Args:
        tree: the checked tree of a URDF.
        base: name of the arm's base link.
        joint_names: joints with columns in a table; the arm ends with the last of them, gripper jaws excepted. None:
            all joints of the tree.

    Raises:
        RobotError: the choice is ambiguous; the message lists the candidates.
    """
    axes = _Axes(tree, base)
    ends = axes.chains if joint_names is None else axes.named(joint_names)
    if len(ends) > 1:
        tips = [_frame(tree, body)[0] for body in ends]
        table = "" if joint_names is None else "; the table has columns of several"
        count = "two arms" if len(ends) == 2 else f"{len(ends)} chains of joints"
        refuse_robot(tree.where, f"{count}: choose one by its last link, --tip {' or '.join(tips)}{table}")
    body = ends[0]
    tip, reason = _frame(tree, body)
    return ArmEnds(base, tip, reason, axes.remarks(body, joint_names))


class _Axes:
    """The joints below a link of a tree, divided into axes of arms and other joints (gripper jaws, fingers).

    A body is named by the link after its moving joint, and includes all links fixed to this link.

    Attributes:
        aside: name of each actuated joint that is not an axis, to the reason.
        chains: last bodies of the longest chains of axes: one, or one per arm.
    """

    def __init__(self, tree: UrdfTree, base: str) -> None:
        self.tree, self.base = tree, base
        self.aside: dict[str, str] = {}
        if not any(joint.actuated for joint in tree.joints.values()):
            refuse_robot(tree.where, "no actuated joint (revolute, continuous or prismatic) found")
        if not self._last_bodies():
            refuse_robot(tree.where, f"no actuated joint follows '{base}'; choose another base (--base)")
        for rule in (self._mimicking, self._named_jaws, self._behind_flange, self._beside_axis, self._forked):
            before = self.aside
            self.aside = {**rule(), **before}
            # A gripper alone is an arm.
            if not self._last_bodies():
                self.aside = before
        self.chains = self._rivals(self._last_bodies())

    def depth(self, link: str) -> int:
        """Return the number of actuated joints between the base and a link."""
        return sum(joint.actuated for joint in self.tree.path(self.base, link))

    def height(self, joint: JointTag) -> int:
        """Return the number of axes on the longest chain that begins with a joint; 0 if the joint is not an axis."""
        if joint.name in self.aside:
            return 0
        behind = [self.height(child) for child in self.tree.below[joint.child]]
        return joint.actuated + max(behind, default=0)

    def departing(self, body: str) -> list[JointTag]:
        """Return the moving joints whose parent link is fixed to the body `body`."""
        joints: list[JointTag] = []
        for link, _ in self.tree.rigid(body):
            joints += [joint for joint in self.tree.below[link] if joint.moves]
        return joints

    def named(self, joint_names: Sequence[str]) -> list[str]:
        """Return the last bodies of the chains that contain the named joints.

        Gripper jaws are left out, unless only jaws are named.

        Raises:
            RobotError: a joint that does not exist.
        """
        joints = self.tree.joints
        for name in joint_names:
            if name not in joints:
                actuated = ", ".join(joint.name for joint in joints.values() if joint.actuated)
                refuse_robot(self.tree.where, f"no joint '{name}'{suggestion(name, joints)} (joints: {actuated})")
        counted = [name for name in joint_names if name not in self.aside] or list(joint_names)
        children = [joints[name].child for name in counted]
        bodies = [body for body in children if _hangs(self.tree, body, self.base)]
        if not bodies:
            refuse_robot(self.tree.where, f"joint '{counted[0]}' does not follow '{self.base}'; choose another base")
        return self._rivals(_leaves(self.tree, bodies))

    def remarks(self, body: str, joint_names: Sequence[str] | None) -> tuple[str, ...]:
        """Return remarks on gripper jaws, on columns that are not used, and on a tool0 that does not end the arm.

        Args:
            body: last body of the arm.
            joint_names: joints with columns in a table; None without a table.
        """
        path = {joint.name for joint in self.tree.path(self.base, body)}
        joints = self.tree.joints
        joints_by_reason: dict[str, list[str]] = {}
        for name, reason in self.aside.items():
            if name not in path and joints[name].actuated:
                joints_by_reason.setdefault(reason, []).append(name)
        result: list[str] = []
        for reason, names in joints_by_reason.items():
            result.append(f"not an axis of the arm: {listing(names, 3)} ({reason})")
        unused = [name for name in joint_names or () if name not in path]
        if unused:
            result.append(f"columns not used: {listing(unused, 4)}")
        links = {link for link, _ in self.tree.rigid(body)}
        for joint in self.tree.path(self.base, body):
            if joint.child in links:
                continue
            axes_behind = self.depth(body) - self.depth(joint.child)
            for name, _ in self.tree.rigid(joint.child):
                if TOOL0.search(name) and name not in links:
                    result.append(f"{name} is not taken as the end: {axes_behind} axes follow it")
        return tuple(dict.fromkeys(result))

    def _reached(self) -> list[str]:
        """Return the links below the base, the base first, except those after joints that are not axes."""
        result: list[str] = []
        todo = [self.base]
        while todo:
            link = todo.pop(0)
            result.append(link)
            todo += [joint.child for joint in self.tree.below[link] if joint.name not in self.aside]
        return result

    def _last_bodies(self) -> list[str]:
        """Return the bodies after an axis from which no other axis departs."""
        last: list[str] = []
        for body in self._bodies():
            followed = any(self.height(joint) for joint in self.departing(body))
            if not followed and self.depth(body) and self._is_driven(body):
                last.append(body)
        return _leaves(self.tree, last)

    def _is_driven(self, body: str) -> bool:
        """Return whether a body's joint is actuated, or is a mimic of a joint before it in the chain."""
        joint = self.tree.above[body]
        leader = self.tree.joints.get(joint.mimic.leader) if joint.mimic else None
        return joint.actuated or (leader is not None and _hangs(self.tree, body, leader.child))

    def _rivals(self, bodies: list[str]) -> list[str]:
        """Return which of the last bodies end the longest chain, or end another arm."""
        depth = max(self.depth(body) for body in bodies)
        longest = [body for body in bodies if self.depth(body) == depth]
        shorter = [body for body in bodies if body not in longest]
        arms = [body for body in shorter if all(self._is_another_arm(body, main) for main in longest)]
        return [*longest, *arms]

    def _is_another_arm(self, body: str, main: str) -> bool:
        """Return whether a chain has nearly as many axes as the longest one after the link at which the two branch.

        Args:
            body: last body of the chain.
            main: last body of the longest chain.
        """
        path = self.tree.path(self.base, body)
        main_path = self.tree.path(self.base, main)
        shared = sum(joint.actuated for joint, main_joint in zip(path, main_path) if joint.name == main_joint.name)
        axes = self.depth(body) - shared
        main_axes = self.depth(main) - shared
        return axes >= ARM_AXES and axes >= ARM_SHARE * main_axes

    def _mimicking(self) -> dict[str, str]:
        """Return the joints that a mimic relation between branches shows to be jaws, each with the reason.

        These are mimic joints whose leader is in another branch, and the leaders themselves if no actuated joint
        follows.
        """
        tree = self.tree
        result: dict[str, str] = {}
        for joint in tree.joints.values():
            leader = tree.joints.get(joint.mimic.leader) if joint.mimic else None
            if leader is None or _hangs(tree, joint.child, leader.child) or _hangs(tree, leader.child, joint.child):
                continue
            result[joint.name] = "moves with another joint"
            followers = [follower for follower in tree.joints.values() if _hangs(tree, follower.child, leader.child)]
            if not any(follower.actuated for follower in followers):
                result[leader.name] = "drives a gripper"
        return result

    def _named_jaws(self) -> dict[str, str]:
        """Return the joints at the ends of chains that have names of jaws or fingers, each with the reason.

        Joints directly before them with such names are included.
        """
        result: dict[str, str] = {}
        jaws = [joint for joint in self.tree.joints.values() if joint.actuated and self._is_jaw(joint)]
        jaws.sort(key=self._depth_in_tree, reverse=True)
        for jaw in jaws:
            axes_behind = []
            for joint in self.tree.joints.values():
                is_axis = joint.actuated and joint.name not in result and joint.name not in self.aside
                if is_axis and _hangs(self.tree, joint.child, jaw.child):
                    axes_behind.append(joint)
            if not axes_behind:
                result[jaw.name] = "a gripper by its name"
        return result

    def _depth_in_tree(self, joint: JointTag) -> int:
        """Return the number of joints between the root and a joint's child link."""
        return len(self.tree.ancestry(joint.child))

    def _is_jaw(self, joint: JointTag) -> bool:
        """Return whether the name of a joint or of its link is that of a jaw.

        Words that also occur in the name of the chain's first joint are ignored, since they are a prefix of all names.
        """
        first = self._first(joint.child)
        name, link = joint.name.lower(), joint.child.lower()
        if name == first or self._is_named_axis(joint):
            return False
        if any(word in name and word not in first for word in GRIPPER_WORDS):
            return True
        return not self._in_series(joint) and any(word in link and word not in first for word in FINGER_WORDS)

    def _behind_flange(self) -> dict[str, str]:
        """Return the joints after bodies with a tool0 or a flange that belong to a tool, each with the reason."""
        result: dict[str, str] = {}
        for body in self._bodies():
            frames = [link for link, _ in self.tree.rigid(body) if TOOL0.search(link) or FLANGE.search(link)]
            branches = [joint for joint in self.departing(body) if self.height(joint)]
            if frames and branches and self._is_tool(body, branches):
                for joint in branches:
                    result |= dict.fromkeys(self._behind(joint), f"behind {frames[-1]}")
        return result

    def _is_tool(self, body: str, branches: list[JointTag]) -> bool:
        """Return whether the joints that depart from a body with a flange belong to a tool.

        A tool has single joints, or is a hand.

        Args:
            body: name of the body with the flange.
            branches: joints that depart from the body.
        """
        if any(self._in_series(joint) or self._is_named_axis(joint) for joint in branches):
            return False
        heights = [self.height(joint) for joint in branches]
        single = max(heights) == 1
        return max(heights) < self.depth(body) and (single or self._is_hand(body, branches))

    def _beside_axis(self) -> dict[str, str]:
        """Return the joints of short branches beside the branch in which the arm continues, each with the reason.

        The branch that continues the arm is known by its names, or because it leads to a flange.
        """
        result: dict[str, str] = {}
        for body in self._bodies():
            branches = [joint for joint in self.departing(body) if self.height(joint)]
            axes = [joint for joint in branches if self._in_series(joint) or self._is_flanged(joint)]
            if len(axes) != 1:
                continue
            for joint in branches:
                if joint is not axes[0] and self.height(joint) < ARM_AXES:
                    result |= dict.fromkeys(self._behind(joint), f"beside {axes[0].name}")
        return result

    def _is_flanged(self, joint: JointTag) -> bool:
        """Return whether a tool0 or a flange is fixed to a joint's child link or to a link after it."""
        for name in self._behind(joint):
            body = self.tree.joints[name].child
            if any(TOOL0.search(link) or FLANGE.search(link) for link, _ in self.tree.rigid(body)):
                return True
        return False

    def _forked(self) -> dict[str, str]:
        """Return the joints of hands (equally short branches at the end of a chain), each with the reason."""
        fingers: dict[str, str] = {}
        for body in self._bodies():
            branches = [joint for joint in self.departing(body) if self.height(joint) and joint.name not in fingers]
            if self._is_hand(body, branches):
                for joint in branches:
                    fingers |= dict.fromkeys(self._behind(joint), "finger of a hand")
        return fingers

    def _is_hand(self, body: str, branches: list[JointTag]) -> bool:
        """Return whether several branches are fingers of a hand.

        Fingers are shorter than the chain before them, of equal length, and not named as axes. With three or more
        branches, one may be longer by one joint (a thumb).

        Args:
            body: name of the body from which the branches depart.
            branches: first joint of each branch.
        """
        if len(branches) < 2:
            return False
        heights = sorted(self.height(joint) for joint in branches)
        difference = heights[-1] - heights[-2]
        even = difference == 0 or (len(heights) > 2 and difference == 1)
        if not even or heights[-1] >= self.depth(body):
            return False
        for joint in branches:
            if self._is_flanged(joint) or self._in_series(joint) or self._is_named_axis(joint):
                return False
        return True

    def _bodies(self) -> list[str]:
        """Return the bodies below the base that are reached by axes, nearest to the base first."""
        return [link for link in self._reached() if link != self.base and self.tree.above[link].moves]

    def _behind(self, joint: JointTag) -> list[str]:
        """Return the names of a joint and of all moving joints after it."""
        moving = [follower for follower in self.tree.joints.values() if follower.moves]
        behind = [follower.name for follower in moving if _hangs(self.tree, follower.child, joint.child)]
        return [joint.name, *behind]

    def _first(self, link: str) -> str:
        """Return the name of the first actuated joint between the root and a link, in lower case.

        Words in this name may be a prefix of all names.
        """
        return next(joint.name.lower() for joint in self.tree.ancestry(link) if joint.actuated)

    def _is_named_axis(self, joint: JointTag) -> bool:
        return bool((AXIS_WORDS & _words(joint.name)) - _words(self._first(joint.child)))

    def _in_series(self, joint: JointTag) -> bool:
        """Return whether a joint's name is that of the actuated joint before it, with the next number or letter."""
        before = [earlier for earlier in self.tree.ancestry(joint.child)[:-1] if earlier.actuated]
        return bool(before) and _follows(before[-1].name, joint.name)


def _follows(before: str, name: str) -> bool:
    """Return whether `before` and `name` begin alike and end in numbers n and n + 1: ``joint_1_s``, ``joint_2_l``."""
    first = NUMBERED.match(before.lower())
    second = NUMBERED.match(name.lower())
    if first is None or second is None:
        return False
    return first[1] == second[1] and int(second[2]) == int(first[2]) + 1


def _hangs(tree: UrdfTree, link: str, on: str) -> bool:
    return any(joint.parent == on for joint in tree.ancestry(link))


def _frame(tree: UrdfTree, body: str) -> tuple[str, str]:
    """Return the link at which an arm with the last body `body` ends, and the reason.

    Args:
        tree: the URDF.
        body: name of the arm's last body.
    """
    links = [link for link, _ in tree.rigid(body)]
    for pattern, reason in ((TOOL0, "its tool frame (REP 199)"), (FLANGE, "its flange (REP 199)")):
        frames = [link for link in links if pattern.search(link)]
        if frames:
            return frames[0], reason
    counted = _without_tools(tree, body)
    effectors = [link for link in counted if link != body and END_WORDS & _words(link)]
    last_effectors = _leaves(tree, effectors)
    if len(last_effectors) == 1:
        return last_effectors[0], "its end-effector frame"
    leaves = _leaves(tree, counted)
    if len(leaves) == 1 and len(counted) == len(links):
        return leaves[0], "the last link"
    if len(leaves) == 1:
        return leaves[0], "the last link that is no gripper or sensor"
    return body, f"the last moving link ({listing(leaves, 4)} are attached to it; choose one by --tip)"


def _without_tools(tree: UrdfTree, body: str) -> list[str]:
    """Return the links fixed to a body, except grippers, sensors and links on these.

    The first one is the body's main link.

    Args:
        tree: the URDF.
        body: name of the body.
    """
    prefix = body.lower()
    result: list[str] = []
    todo = [body]
    while todo:
        link = todo.pop(0)
        result.append(link)
        for joint in tree.below[link]:
            name = joint.child.lower()
            words_of_name = _words(joint.child)
            is_gripper = any(word in name and word not in prefix for word in GRIPPER_WORDS)
            carries_joint = any(follower.moves for follower in tree.below[joint.child])
            is_tool = is_gripper or (carries_joint and not END_WORDS & words_of_name)
            if joint.kind == "fixed" and not is_tool and not SENSOR_WORDS & words_of_name:
                todo.append(joint.child)
    return result


def _leaves(tree: UrdfTree, links: Iterable[str]) -> list[str]:
    """Return which of `links` have no descendant in `tree` that is also one of `links`."""
    links = list(links)
    before: set[str] = set()
    for link in links:
        before.update(joint.parent for joint in tree.ancestry(link))
    return [link for link in links if link not in before]


def _words(link: str) -> set[str]:
    """Return the words in a link's name: sequences of letters, in lower case."""
    return set(re.findall(r"[a-z]+", link.lower()))

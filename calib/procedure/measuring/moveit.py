"""MoveIt's files as limits: ``joint_limits.yaml`` and SRDF, wherever `calib formats limits` or constraints are taken.

The file, or the folder of a MoveIt configuration, for both (its files, or those in its ``config``)::

    calib select ur.urdf --constraints ur_moveit_config --out poses.csv
    calib excite ur.urdf --limits joint_limits.yaml --out motion
    calib new cell ur.urdf --limits ur_moveit_config

A session gets them as ``limits.toml``, to which the cell's own tables can be added. ``min_position`` and
``max_position`` become ``[joints]``, ``max_velocity``, ``max_acceleration``, ``max_jerk`` and ``max_effort`` the tables
``[velocity]``, ``[acceleration]``, ``[jerk]`` and ``[torque]``; what ``has_..._limits: false`` switches off is none.
Angles may be ``!degrees``, as in ur_description. Scaling factors are a planner's habits and no limits: they are not
taken. The SRDF's ``disable_collisions`` become ``[collision]`` ``ignored``; its groups and states are not used.

Joints and links of the robot's file that are not part of the arm (a gripper's) are left out. A joint that the robot
does not have is refused, and so is an SRDF of which no pair of links is the robot's.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING

from calib.config_types import ParsedTable, number, shown
from calib.errors import UsageError, one_of, refused_as, require
from calib.robot.beside import links_of
from calib.robot.chain import Chain
from calib.robot.formats.urdf_tree import is_urdf, parse, text
from calib.robot.formats.urdf_tree import read as read_tree

if TYPE_CHECKING:
    from ruamel.yaml.nodes import ScalarNode

JOINT_LIMITS = "joint_limits.yaml"
SRDF = ".srdf"
# table of a limits file -> MoveIt's name of the quantity
TABLES = {"velocity": "velocity", "acceleration": "acceleration", "jerk": "jerk", "torque": "effort"}


def moveit_files(path: Path) -> list[Path]:
    """Return the ``joint_limits.yaml`` and the SRDF file at a path.

    Args:
        path: one of these files, or a folder that contains them.

    Returns:
        The files; an empty list if the path is a file of another type.

    Raises:
        UsageError: for a folder without such files, or with several SRDF files.
    """
    if not path.is_dir():
        if path.suffix in (".yaml", ".yml", SRDF):
            return [path]
        return []
    folders = [path, path / "config"]
    limits = [folder / JOINT_LIMITS for folder in folders if (folder / JOINT_LIMITS).is_file()]
    srdf: list[Path] = []
    for folder in folders:
        srdf += folder.glob(f"*{SRDF}")
    srdf.sort()
    if len(srdf) > 1:
        raise UsageError(f"{path} has {len(srdf)} SRDF files: give one of them, as {srdf[0]}")
    if not limits and not srdf:
        raise UsageError(
            f"{path}: neither {JOINT_LIMITS} nor *{SRDF} in this folder or its config folder: give the MoveIt package"
        )
    return [*limits[:1], *srdf]


def limit_tables(path: Path, chain: Chain, source: Path | None) -> ParsedTable | None:
    """Return MoveIt's limits in the form of a limits file; None if the path is not a MoveIt file or folder.

    Args:
        path: a MoveIt file, or a folder with both files.
        chain: the arm.
        source: file of the arm; None: joints and links outside the arm are not known.

    Raises:
        UsageError: for files that cannot be read, or that belong to another robot.
    """
    tables: ParsedTable = {}
    for file in moveit_files(path):
        if file.suffix == SRDF:
            tables["collision"] = _pairs(file, chain, source)
        else:
            tables |= _limits(file, chain, source)
    return tables or None


def _limits(path: Path, chain: Chain, source: Path | None) -> ParsedTable:
    """Return the limits of a ``joint_limits.yaml`` as tables ``[joints]``, ``[velocity]`` … of a limits file.

    Args:
        path: the ``joint_limits.yaml``.
        chain: the arm.
        source: file of the arm; None: joints outside the arm are not known.
    """
    content = _yaml(path)
    entries = None
    if isinstance(content, dict):
        entries = content.get("joint_limits")
    if not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
        raise UsageError(f"{path}: is no {JOINT_LIMITS} of MoveIt: expected joints under 'joint_limits:'")
    robot_joints: Collection[str] = chain.joint_names
    if source and is_urdf(source):
        robot_joints = read_tree(text(source)[0], str(source)).joints
    for name in entries:
        one_of(name, robot_joints, f"{path}: joint", UsageError)

    tables: ParsedTable = {}
    for joint in chain.joints:
        limits = entries.get(joint.name, {})
        where = f"{path}: {joint.name}"
        for table, quantity in TABLES.items():
            largest = _limit(limits, quantity, "max", where)
            if largest is not None:
                tables.setdefault(table, {})[joint.name] = largest
        lower = _limit(limits, "position", "min", where)
        upper = _limit(limits, "position", "max", where)
        if lower is None and upper is None:
            continue
        # an end that is not stated is the robot's own
        if lower is None:
            lower = joint.lower
        if upper is None:
            upper = joint.upper
        tables.setdefault("joints", {})[joint.name] = [lower, upper]
    require(
        tables,
        f"{path}: limits no joint of the arm ({', '.join(chain.joint_names)}): is it for another robot?",
        UsageError,
    )
    return tables


def _limit(limits: Mapping[str, object], quantity: str, end: str, where: str) -> float | None:
    """Return a joint's limit in MoveIt's unit; None if the file does not state it or disables it.

    A limit is disabled by ``has_..._limits: false``.

    Args:
        limits: the joint's entry in ``joint_limits.yaml``.
        quantity: ``position``, ``velocity``, ``acceleration``, ``jerk`` or ``effort``.
        end: ``min`` or ``max``.
        where: name of the entry for messages.
    """
    key = f"{end}_{quantity}"
    if not limits.get(f"has_{quantity}_limits", True) or key not in limits:
        return None
    return number(limits[key], f"{where}.{key}")


def _yaml(path: Path) -> object:
    from ruamel.yaml import YAML
    from ruamel.yaml.constructor import SafeConstructor
    from ruamel.yaml.error import YAMLError

    class Angles(SafeConstructor):
        """YAML reader that converts values with the tags ``!degrees`` and ``!radians`` to radians."""

    def angle(factor: float) -> Callable[[object, ScalarNode], float]:
        return lambda loader, node: factor * number(node.value.strip(), f"{path}: {node.tag}")

    Angles.add_constructor("!degrees", angle(radians(1.0)))
    Angles.add_constructor("!radians", angle(1.0))
    reader = YAML(typ="safe", pure=True)
    reader.Constructor = Angles
    with refused_as(UsageError, (OSError, UnicodeDecodeError, YAMLError), f"{path}: cannot be read as YAML: {{}}"):
        return reader.load(path.read_text(encoding="utf-8"))


def _pairs(path: Path, chain: Chain, source: Path | None) -> ParsedTable:
    """Return the table ``[collision]`` for an SRDF: the pairs of links whose collisions are not checked.

    Pairs with links that do not exist are omitted.

    Args:
        path: the SRDF.
        chain: the arm.
        source: file of the arm; None: links outside the arm are not known.
    """
    with refused_as(UsageError, (OSError, UnicodeDecodeError), f"{path}: cannot be read: {{}}"):
        root = parse(path.read_text(encoding="utf-8"), str(path))
    attributes = [node.attributes for node in root.all("disable_collisions")]
    pairs = [(node.get("link1", ""), node.get("link2", "")) for node in attributes]
    links = {*links_of(chain, source)}
    ignored = [list(pair) for pair in pairs if {*pair} <= links]
    if pairs and not ignored:
        raise UsageError(
            f"{path}: none of its {len(pairs)} disabled pairs has links of {chain.name}, e.g. {shown(pairs[:1])}: "
            "is it for another robot?"
        )
    return {"ignored": ignored}

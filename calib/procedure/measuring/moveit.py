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

from collections.abc import Mapping
from math import radians
from pathlib import Path
from typing import Any

from calib.config_types import number, shown
from calib.errors import UsageError, one_of, refused_as, require
from calib.robot.beside import links_of
from calib.robot.chain import Chain
from calib.robot.formats.urdf_tree import is_urdf, parse, text
from calib.robot.formats.urdf_tree import read as read_tree

JOINT_LIMITS, SRDF = "joint_limits.yaml", ".srdf"
TABLES = {"velocity": "velocity", "acceleration": "acceleration", "jerk": "jerk", "torque": "effort"}  # ours: MoveIt's


def moveit_files(path: Path) -> list[Path]:
    """Return the SRDF and ``joint_limits.yaml`` that a path names, by itself or as a folder; none for other files.

    Raises:
        UsageError: for a folder without them, or with several SRDF.
    """
    if not path.is_dir():
        return [path] if path.suffix in (".yaml", ".yml", SRDF) else []
    places = [path, path / "config"]
    found = [one / JOINT_LIMITS for one in places if (one / JOINT_LIMITS).is_file()][:1]
    pairs = sorted(file for one in places for file in one.glob(f"*{SRDF}"))
    require(
        len(pairs) < 2,
        f"{path} has {len(pairs)} SRDF files: give one of them, as {', '.join(map(str, pairs[:1]))}",
        UsageError,
    )
    require(found or pairs, f"{path}: neither {JOINT_LIMITS} nor *{SRDF} in this folder or its config", UsageError)
    return [*found, *pairs]


def limit_tables(path: Path, chain: Chain, source: Path | None) -> dict[str, Any] | None:
    """Return the tables of a limits file from MoveIt's files; None where the path names none.

    Args:
        path: of a file, or of a folder with both.
        chain, source: the arm, and its file.

    Raises:
        UsageError: for files that cannot be read, or that are another robot's.
    """
    tables: dict[str, Any] = {}
    for file in moveit_files(path):
        tables |= {"collision": _pairs(file, chain, source)} if file.suffix == SRDF else _limits(file, chain, source)
    return tables or None


def _limits(path: Path, chain: Chain, source: Path | None) -> dict[str, Any]:
    """Return the tables [joints], [velocity] … of a ``joint_limits.yaml``."""
    found = _yaml(path)
    stated = found.get("joint_limits") if isinstance(found, dict) else None
    words = f"{path}: is no {JOINT_LIMITS} of MoveIt: expected joints under 'joint_limits:'"
    require(isinstance(stated, dict) and all(isinstance(one, dict) for one in stated.values()), words, UsageError)
    known = read_tree(text(source)[0], str(source)).joints if source and is_urdf(source) else chain.joint_names
    own, tables = dict[str, Any](stated or {}), dict[str, Any]()
    for name in own:
        one_of(name, known, f"{path}: joint", UsageError)
    for joint in chain.joints:
        limits = own.get(joint.name, {})
        place = f"{path}: {joint.name}"
        for table, what in TABLES.items():
            if (largest := _stated(limits, what, "max", place)) is not None:
                tables.setdefault(table, {})[joint.name] = largest
        ends = [_stated(limits, "position", end, place) for end in ("min", "max")]
        if ends != [None, None]:
            sides = zip(ends, (joint.lower, joint.upper))
            tables.setdefault("joints", {})[joint.name] = [side if end is None else end for end, side in sides]
    require(tables, f"{path}: limits no joint of the arm ({', '.join(chain.joint_names)})", UsageError)
    return tables


def _stated(limits: Mapping[str, Any], what: str, end: str, place: str) -> float | None:
    key = f"{end}_{what}"
    if not limits.get(f"has_{what}_limits", True) or key not in limits:
        return None
    return number(limits[key], f"{place}.{key}")


def _yaml(path: Path) -> Any:
    from ruamel.yaml import YAML
    from ruamel.yaml.constructor import SafeConstructor
    from ruamel.yaml.error import YAMLError

    class Angles(SafeConstructor):
        """Numbers and texts, and angles with ``!degrees`` or ``!radians``."""

    def angle(factor: float) -> Any:
        return lambda loader, node: factor * number(node.value.strip(), f"{path}: {node.tag}")

    Angles.add_constructor("!degrees", angle(radians(1.0)))
    Angles.add_constructor("!radians", angle(1.0))
    reader = YAML(typ="safe", pure=True)
    reader.Constructor = Angles
    with refused_as(UsageError, (OSError, UnicodeDecodeError, YAMLError), f"{path}: cannot be read as YAML: {{}}"):
        return reader.load(path.read_text(encoding="utf-8"))


def _pairs(path: Path, chain: Chain, source: Path | None) -> dict[str, Any]:
    """Return the table [collision] of an SRDF: its disabled pairs, of links that the robot has."""
    with refused_as(UsageError, (OSError, UnicodeDecodeError), f"{path}: cannot be read: {{}}"):
        root = parse(path.read_text(encoding="utf-8"), str(path))
    nodes = root.all("disable_collisions")
    pairs = [tuple(node.attributes.get(key, "") for key in ("link1", "link2")) for node in nodes]
    known = links_of(chain, source)
    own = [list(pair) for pair in pairs if {*pair} <= {*known}]
    words = f"{path}: none of its {len(pairs)} disabled pairs is of links of {chain.name}, as {shown(pairs[:1])}"
    require(own or not pairs, f"{words}: is it another robot's?", UsageError)
    return {"ignored": own}

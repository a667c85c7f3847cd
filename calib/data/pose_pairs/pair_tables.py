"""Pairs of poses in a CSV table: the columns of each pose are those whose names share a word."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from calib.data.csv_table import Table, read_header, read_table
from calib.data.pose_pairs.poses import PoseList, PosePairs, paired
from calib.data.poses.fit_options import FileOptions
from calib.errors import refuse_data

# Words of a column's name that say which quantity it is part of; the others name the pose.
POSITION_WORDS = frozenset(["position", "pos", "translation", "trans", "tvec", "t", "p", "xyz", "loc", "location"])
TURN_WORDS = frozenset(
    [
        "orientation",
        "orient",
        "rotation",
        "rot",
        "quaternion",
        "quat",
        "q",
        "rvec",
        "rotvec",
        "euler",
        "rpy",
        "angle",
        "angles",
        "axis",
        "r",
    ]
)
POSE_WORDS = frozenset(["pose", "poses", "transform", "tf", "frame", "field"])
# Names of columns → quantity, and number of the component.
COMPONENTS: dict[str, tuple[str, int]] = {}
for _quantity, _names in (
    ("position", ("tx", "ty", "tz")),
    ("position", ("px", "py", "pz")),
    ("position", ("tvecx", "tvecy", "tvecz")),
    ("angles", ("rx", "ry", "rz")),
    ("vector", ("rvecx", "rvecy", "rvecz")),
    ("vector", ("rotvecx", "rotvecy", "rotvecz")),
    ("quaternion", ("qx", "qy", "qz", "qw")),
    ("xyz fixed", ("roll", "pitch", "yaw")),
    ("zyx moving", ("a", "b", "c")),
    ("wpr", ("w", "p", "r")),
):
    for _number, _name in enumerate(_names):
        COMPONENTS[_name] = (_quantity, _number)
# r11 to r33, or r00 to r22
for _row in range(4):
    for _column in range(4):
        COMPONENTS[f"r{_row}{_column}"] = ("matrix", 10 * _row + _column)
SIZES = {"position": 3, "quaternion": 4, "matrix": 9}
# Quantities whose name says the convention of their angles.
CONVENTIONS = ("vector", "xyz fixed", "zyx moving", "wpr")
# Fewest further columns that count as those of joints.
MIN_JOINTS = 4
# Units at the end of a column's name.
UNIT_WORDS = ("mm", "cm", "m", "deg", "rad")


def read_table_of_pairs(path: Path, options: FileOptions) -> PosePairs | None:
    """Return the pairs of poses in a CSV table; None if the table has not two poses, or other measurements.

    Args:
        path: the file.
        options: column names and units that the header does not state.
    """
    names, _ = read_header(path)
    renamed = dict(zip(options.columns.values(), options.columns))
    families = _families([renamed.get(name, name) for name in names], names)
    if len(families) != 2:
        return None
    if "" in families:
        # one pose without a name, with another one beside it and joints: measurements at joint values
        of_poses = 0
        for family in families.values():
            of_poses += sum(map(len, family.values()))
        if len(names) - of_poses >= MIN_JOINTS:
            return None
    table = read_table(path)
    lists = [_pose_list(table, name, columns, options) for name, columns in families.items()]
    return paired(lists, str(path), table.rows)


def _families(names: list[str], headings: tuple[str, ...]) -> dict[str, dict[str, list[str]]]:
    """Return the columns of each complete pose: name of the pose → quantity → headings in the order of components.

    Args:
        names: names of the columns.
        headings: the file's headings of these columns.
    """
    parts: dict[str, dict[str, dict[int, str]]] = {}
    for name, heading in zip(names, headings):
        split = component(name)
        if split is not None:
            pose, quantity, number = split
            parts.setdefault(pose, {}).setdefault(quantity, {})[number] = heading
    families = {}
    for pose, quantities in parts.items():
        complete = {}
        for quantity, columns in quantities.items():
            if len(columns) == SIZES.get(quantity, 3) or (quantity == "turn" and len(columns) == 4):
                complete[quantity] = list(map(columns.__getitem__, sorted(columns)))
        if "position" in complete and len(complete) == 2:
            families[pose] = complete
    # the toolkit's own columns: a target, and the frame on the base that was measured with it
    if set(families) == {"base", ""}:
        return {}
    return families


def component(name: str) -> tuple[str, str, int] | None:
    """Return the pose, the quantity and the component that a column's name says; None for other columns.

    ``robot_x`` is (robot, position, 0), ``cam.orientation.w`` is (cam, quaternion, 3).

    Args:
        name: name of a column, without its unit.
    """
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()
    parts = re.findall(r"[a-z0-9]+", text)
    if parts and parts[-1] in UNIT_WORDS:
        parts.pop()
    if not parts:
        return None
    for index in dict.fromkeys([len(parts) - 1, *range(len(parts))]):
        beside = parts[:index] + parts[index + 1 :]
        split = _component_of_word(parts[index], beside)
        if split is not None:
            quantity, number = split
            pose_words = [part for part in beside if part not in POSITION_WORDS | TURN_WORDS | POSE_WORDS]
            return "_".join(pose_words), quantity, number
    return None


def _component_of_word(part: str, beside: list[str]) -> tuple[str, int] | None:
    """Return quantity and component that a word of a column's name says, beside the other words."""
    turns = TURN_WORDS.intersection(beside)
    if part in tuple("xyzw"):
        number = "xyzw".index(part)
        if not turns:
            if part == "w":
                return COMPONENTS["w"]
            return "position", number
        if turns & {"rvec", "rotvec"}:
            return "vector", number
        if turns & {"euler", "rpy", "angle", "angles"}:
            return "angles", number
        return "turn", number
    if part.isdigit() and len(part) == 1:
        number = int(part)
        if turns & {"rvec", "rotvec"}:
            return "vector", number
        if POSITION_WORDS.intersection(beside):
            return "position", number
        return None
    return COMPONENTS.get(part)


def _pose_list(table: Table, name: str, columns: Mapping[str, list[str]], options: FileOptions) -> PoseList:
    """Return one list of poses of a table.

    Args:
        table: the table.
        name: name of the pose.
        columns: quantity → the file's names of its columns.
        options: units and conventions that the header does not state.
    """
    (turned,) = set(columns) - {"position"}
    position = np.column_stack(table.check(columns["position"]))
    turn = np.column_stack(table.check(columns[turned]))
    convention = turned if turned in CONVENTIONS else ""
    if turn.shape[1] == 4:
        convention = "x y z w"
    angle_unit = ""
    if turn.shape[1] == 3:
        convention = options.euler or convention
        angle_unit = _unit(table, columns[turned], options.units.get("orientation", ""))
    length_unit = _unit(table, columns["position"], options.units.get("position", ""))
    return PoseList(name, position, turn, convention, length_unit, angle_unit)


def _unit(table: Table, columns: list[str], stated: str) -> str:
    """Return the common unit of columns, from their brackets or the end of their names; refuse different ones.

    Args:
        table: the table.
        columns: the file's names of the columns.
        stated: unit that the options state; empty for none.
    """
    units = set()
    for column in columns:
        unit = table.units[table.index(column)]
        if not unit:
            ending = re.split(r"[^a-z]+", column.lower())[-1]
            unit = ending if ending in UNIT_WORDS else ""
        units.add(unit)
    if len(units) > 1:
        refuse_data(table.file, f"{', '.join(columns)} have different units: {', '.join(sorted(units))}")
    return units.pop() or stated

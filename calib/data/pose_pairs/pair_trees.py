"""Pairs of poses in YAML, JSON and OpenCV's FileStorage (YAML, XML, JSON): samples with two poses, or two lists."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from calib.data.pose_pairs.poses import PoseList, PosePairs, paired
from calib.data.trees import as_numbers, by_lower_case, is_numeric, read_tree
from calib.errors import MeasurementError

SUFFIXES = (".yaml", ".yml", ".json", ".xml", ".samples")
# Least number of samples that are a list of poses rather than one pose.
MIN_SAMPLES = 2
# Largest number of keys of a table that is a list of poses with a header.
MAX_KEYS = 2
# Deepest nesting that is searched.
MAX_DEPTH = 12
POSITION_KEYS = ("translation", "position", "trans", "tvec", "t", "xyz", "origin", "p", "pos", "location")
TURN_KEYS = {
    **dict.fromkeys(("rotation", "orientation", "rot", "r", "quaternion", "quat", "q"), ""),
    **dict.fromkeys(("rvec", "rotvec", "rotation_vector", "axis_angle"), "vector"),
    **dict.fromkeys(("rpy", "euler"), ""),
}
# Keys that hold a pose, with what belongs to it beside them (stamps, frames).
WRAPPERS = ("transform", "pose", "matrix", "homogeneous", "value", "data", "h")
MOUNTING_KEYS = ("eye_on_hand", "eye_in_hand")
_PARALLEL = re.compile(
    r"(?i)(?P<part>rvecs?|tvecs?|rotvecs?|rot|trans|translations?|rotations?|quats?|r|t|q)_?(?P<of>.*)"
)
_PARALLEL_LAST = re.compile(
    r"(?i)(?P<of>.*?)_?(?P<part>rvecs?|tvecs?|rotvecs?|rot|trans|translations?|rotations?|quats?|positions?|r|t|q)"
)
_NUMBERED = re.compile(r"(?P<stem>.*?)_?(?P<number>\d+)")

# Position, numbers of the orientation, and its convention (empty where open).
Raw = tuple[np.ndarray, np.ndarray, str]


def read_pairs_of_tree(path: Path) -> PosePairs | None:
    """Return the pairs of poses in a YAML, JSON or XML file; None if it has none.

    Args:
        path: the file.

    Raises:
        MeasurementError: the file is damaged, or a sample lacks one of its poses.
    """
    tree = read_tree(path)
    in_hand = _in_hand(tree)
    for node in _nodes(tree):
        lists = _lists_of(node, path)
        if len(lists) == 2:
            rows = np.arange(1, len(lists[0]) + 1)
            return paired(lists, str(path), rows, in_hand)
    return None


def _in_hand(tree: object) -> bool | None:
    """Return whether the arm carries the camera, if a tree says so (easy_handeye)."""
    for node in _nodes(tree):
        if isinstance(node, Mapping):
            for key in MOUNTING_KEYS:
                if isinstance(node.get(key), bool):
                    return bool(node[key])
    return None


def _nodes(tree: object, depth: int = 0) -> Iterator[object]:
    """Yield the lists and tables of a tree, outer ones first."""
    if depth > MAX_DEPTH:
        return
    if isinstance(tree, Mapping):
        yield tree
        for value in tree.values():
            yield from _nodes(value, depth + 1)
    elif isinstance(tree, list) and not is_numeric(tree):
        yield tree
        for value in tree:
            yield from _nodes(value, depth + 1)


def _lists_of(node: object, path: Path) -> list[PoseList]:
    """Return the lists of poses that a list of samples, or a table of lists, contains."""
    if isinstance(node, Mapping):
        samples = list(node.values())
        counts = {len(_poses_in(sample)) for sample in samples}
        if len(samples) >= MIN_SAMPLES and counts == {2}:
            return _of_samples(samples, path)
        return _of_parallel(node, path)
    if isinstance(node, list) and len(node) >= MIN_SAMPLES and len(_poses_in(node[0])) == 2:
        return _of_samples(node, path)
    return []


def _poses_in(sample: object) -> dict[str, Raw]:
    """Return the poses of a sample by their keys."""
    poses = {}
    if isinstance(sample, Mapping):
        for key, value in sample.items():
            pose = pose_of(value)
            if pose is not None:
                poses[str(key)] = pose
    return poses


def _of_samples(samples: Sequence[object], path: Path) -> list[PoseList]:
    """Return two lists of poses, from samples with both poses."""
    names = list(_poses_in(samples[0]))
    poses: dict[str, list[Raw]] = {}
    for number, sample in enumerate(samples, 1):
        of_sample = _poses_in(sample)
        if list(of_sample) != names and set(of_sample) != set(names):
            message = f"sample {number} has {', '.join(of_sample) or 'no pose'}, sample 1 has {' and '.join(names)}"
            raise MeasurementError(f"{message}: every sample needs both poses; remove or complete it", path)
        for name in names:
            poses.setdefault(name, []).append(of_sample[name])
    return [_joined(name, poses[name], path) for name in names]


def _joined(name: str, poses: Sequence[Raw], path: Path) -> PoseList:
    """Return poses as one list; refuse orientations of different forms."""
    sizes = {len(turn) for _, turn, _ in poses}
    if len(sizes) > 1:
        raise MeasurementError(f"the orientations of '{name}' have different forms in different samples", path)
    positions, turns, conventions = zip(*poses)
    return PoseList(name, np.array(positions), np.array(turns), conventions[0])


def _of_parallel(node: Mapping[str, object], path: Path) -> list[PoseList]:
    """Return the lists of poses of a table: one key per list, or one for positions and one for orientations."""
    table = _without_numbers(node)
    lists = []
    parts: dict[str, dict[str, tuple[np.ndarray, str]]] = {}
    for key, content in table.items():
        value = content
        if isinstance(content, Mapping) and len(content) <= MAX_KEYS:
            # the poses of a PoseArray, with its header beside them
            for entry in content.values():
                if isinstance(entry, list):
                    value = entry
        if not isinstance(value, list) or len(value) < MIN_SAMPLES:
            continue
        complete = list(filter(None, map(pose_of, value)))
        if len(complete) == len(value):
            lists.append(_joined(key, complete, path))
            continue
        part = _part(key, value)
        if part is not None:
            of, quantity, numbers, convention = part
            parts.setdefault(of, {})[quantity] = (numbers, convention)
    for name, quantities in parts.items():
        if set(quantities) == {"position", "turn"}:
            turn, convention = quantities["turn"]
            lists.append(PoseList(name, quantities["position"][0], turn, convention))
    return lists


def _without_numbers(node: Mapping[str, object]) -> dict[str, object]:
    """Return a table in which keys that differ in their number only (``robot_0``, ``robot_1``) are one list."""
    table: dict[str, object] = {}
    numbered: dict[str, dict[int, object]] = {}
    for key, value in node.items():
        match = _NUMBERED.fullmatch(str(key))
        if match is None or not isinstance(value, (list, Mapping)):
            table[str(key)] = value
        else:
            numbered.setdefault(match["stem"], {})[int(match["number"])] = value
    for stem, values in numbered.items():
        table[stem] = list(map(values.__getitem__, sorted(values)))
    return table


def _part(key: str, value: list[object]) -> tuple[str, str, np.ndarray, str] | None:
    """Return name, quantity (position or turn), numbers (m, k) and convention of a list such as ``R_gripper2base``."""
    numbers = as_numbers(value)
    if numbers is None:
        return None
    numbers = numbers.reshape(len(value), -1)
    patterns = [_PARALLEL_LAST, _PARALLEL]
    if re.match(r"(?i)[rtq](vecs?)?_", key):
        patterns.reverse()
    match = patterns[0].fullmatch(key) or patterns[1].fullmatch(key)
    if match is None:
        return None
    part = match["part"].lower().rstrip("s")
    if part in ("t", "tvec", "tran", "trans", "translation", "position"):
        if numbers.shape[1] != 3:
            return None
        return match["of"], "position", numbers, ""
    if numbers.shape[1] not in (3, 4, 9):
        return None
    # OpenCV's functions take rotation vectors and matrices under one name
    convention = ""
    if numbers.shape[1] == 3:
        convention = "vector"
    return match["of"], "turn", numbers, convention


def pose_of(node: object) -> Raw | None:
    """Return the pose that a node of a tree is; None for other nodes.

    Args:
        node: a table with position and orientation, a 4 x 4 matrix (nested, or 12 or 16 numbers), 6 or 7 numbers, or a
            position and an orientation in a list.
    """
    if isinstance(node, Mapping):
        return _pose_of_table(by_lower_case(node))
    if not isinstance(node, list):
        return None
    if len(node) == 2 and not is_numeric(node):
        return _pose_of_two(*node)
    values = as_numbers(node)
    if values is None:
        return None
    if values.shape in ((4, 4), (3, 4), (16,), (12,)):
        return _pose_of_matrix(values.reshape(-1, 4))
    values = values.ravel()
    if len(values) in (6, 7):
        return values[:3], values[3:], ""
    return None


def _pose_of_two(first: object, second: object) -> Raw | None:
    """Return the pose of a position and an orientation (tf's tuples), or of a matrix and a position."""
    position = as_numbers(first)
    turn = as_numbers(second)
    if position is None or turn is None:
        return None
    if position.size == 9 and turn.size == 3:
        position, turn = turn, position
    if position.size != 3 or turn.size not in (3, 4, 9):
        return None
    return position.ravel(), turn.ravel(), ""


def _pose_of_matrix(matrix: np.ndarray) -> Raw | None:
    """Return the pose of a matrix (3 or 4, 4), which may be stored column by column; None for other matrices."""
    last = [0.0, 0.0, 0.0, 1.0]
    if len(matrix) == 4 and not np.allclose(matrix[3], last) and np.allclose(matrix[:, 3], last):
        matrix = matrix.T
    if len(matrix) == 4 and not np.allclose(matrix[3], last):
        return None
    return matrix[:3, 3], matrix[:3, :3].ravel(), ""


def _pose_of_table(table: Mapping[str, object]) -> Raw | None:
    """Return the pose of a table with lower-case keys: position and orientation, flat numbers, or a pose inside."""
    position = _position(table)
    turn = _turn(table)
    if position is not None and turn is not None:
        return position, *turn
    for key in WRAPPERS:
        if key in table:
            return pose_of(table[key])
    return None


def _position(table: Mapping[str, object]) -> np.ndarray | None:
    """Return the position (3,) of a table; None if it has none."""
    for key in POSITION_KEYS:
        if key in table:
            value = table[key]
            if isinstance(value, Mapping):
                return _components(by_lower_case(value), "xyz")
            numbers = as_numbers(value)
            if numbers is None or numbers.size != 3:
                return None
            return numbers.ravel()
    return _components(table, "xyz")


def _turn(table: Mapping[str, object]) -> tuple[np.ndarray, str] | None:
    """Return the numbers (3,), (4,) or (9,) of a table's orientation with their convention; None if it has none."""
    for key, convention in TURN_KEYS.items():
        if key in table:
            value = table[key]
            if isinstance(value, Mapping):
                return _turn_of_components(by_lower_case(value), "")
            numbers = as_numbers(value)
            if numbers is None or numbers.size not in (3, 4, 9):
                return None
            if numbers.size != 3:
                return numbers.ravel(), ""
            if key == "rpy":
                convention = "xyz fixed"
            return numbers.ravel(), convention
    return _turn_of_components(table, "q")


def _turn_of_components(table: Mapping[str, object], mark: str) -> tuple[np.ndarray, str] | None:
    """Return the orientation of named numbers: x y z w (after `mark`), roll pitch yaw, rx ry rz, or a b c."""
    quaternion = _components(table, [mark + axis for axis in "xyzw"])
    if quaternion is not None:
        return quaternion, "x y z w"
    for names, convention in ((("roll", "pitch", "yaw"), "xyz fixed"), (("rx", "ry", "rz"), ""), ("abc", "zyx moving")):
        angles = _components(table, names)
        if angles is not None:
            return angles, convention
    if mark:
        return None
    angles = _components(table, "xyz")
    if angles is None:
        return None
    return angles, ""


def _components(table: Mapping[str, object], names: Sequence[str]) -> np.ndarray | None:
    """Return the numbers of a table under these names; None if one is missing or no number."""
    values = list(map(table.get, names))
    if None in values:
        return None
    return as_numbers(values)

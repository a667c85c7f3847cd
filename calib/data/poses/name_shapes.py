"""Columns of positions and orientations by the shape of their names.

``position.x``, ``tvec_x``, ``t_x``, ``X-Position`` name an axis beside a word; ``orientation.w``, ``quat_x`` a
quaternion; ``rvec_x`` and ``rotvec[0]`` a rotation vector; ``phix1``, ``theta_x``, ``rot_x`` three angles; ``T_00`` to
``T_33`` (or ``m11`` …) the elements of a matrix, and ``pose_0`` to ``pose_15`` its rows one after the other. A shape is
used where the table has no column of this toolkit's names for the quantity, and only where it occurs once.
"""

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import filterfalse
from operator import attrgetter

import numpy as np

from calib.data.csv_table import Table
from calib.data.joint_columns import COMMANDED_WORDS, OTHER_WORDS, parted, words_of
from calib.data.poses.fit_options import FileOptions
from calib.data.schema import BOUNDS

VECTOR_WORDS = frozenset(("rvec", "rotvec", "rodrigues", "axisangle", "aa"))
QUATERNION_WORDS = frozenset(("q", "quat", "quaternion"))
ORIENTATION_WORDS = VECTOR_WORDS | QUATERNION_WORDS
ORIENTATION_WORDS |= {"orientation", "orient", "ori", "rotation", "rot", "r", "phi", "theta", "euler", "rpy", "ang"}
ORIENTATION_WORDS |= {"angle", "angles", "winkel", "orientierung", "drehung", "attitude"}
PLACE_WORDS = frozenset(("t", "tvec", "trans", "translation", "p", "pos", "position", "d", "tcp"))
# words of columns that are neither the measured position nor the measured orientation of a target
REJECTED_WORDS = (OTHER_WORDS - {"v", "i", "name"}) | {"base", "late", "offset", "std", "cov", "unc"}
UNIT_WORDS = frozenset(("mm", "cm", "deg", "rad"))
# three angles by names of their own, in the order of rx ry rz
ANGLE_NAMES = (("roll", "pitch", "yaw"), ("alpha", "beta", "gamma"), ("phi", "theta", "psi"))
ANGLE_NAMES += (("a", "b", "c"), ("o", "a", "t"))
# roll, pitch and yaw in German, French, Spanish, Italian
ANGLE_NAMES += (
    ("rollwinkel", "nickwinkel", "gierwinkel"),
    ("rollen", "nicken", "gieren"),
    ("roulis", "tangage", "lacet"),
)
ANGLE_NAMES += (("alabeo", "cabeceo", "guiñada"), ("alabeo", "cabeceo", "guinada"))
ANGLE_NAMES += (("rollio", "beccheggio", "imbardata"),)
AXES = "xyz"
QUATERNION = ("qx", "qy", "qz", "qw")
ANGLES = ("rx", "ry", "rz")
# number of columns of a matrix whose elements are numbered one after the other: with its last row, without, rotation
FLAT_SIZES = {16: 4, 12: 4, 9: 3}
_GLUED = re.compile(r"(?P<stem>[a-z]+)(?P<axis>[xyzw])|(?P<first>[xyz])(?P<rest>[a-z]+)")

Mapped = dict[str, str]


@dataclass(frozen=True)
class Shape:
    """Columns that by their names are one quantity.

    Attributes:
        columns: the toolkit's name of a column → the file's name.
        terms: words that the names have in common.
        euler: what three angles mean, where their name says it; "" otherwise.
    """

    columns: Mapping[str, str]
    terms: tuple[str, ...] = ()
    euler: str = ""

    @property
    def is_commanded(self) -> bool:
        """Whether a word means that the quantity was commanded, not measured."""
        return bool(COMMANDED_WORDS.intersection(self.terms))


def positions_by_shape(names: Sequence[str]) -> list[Shape]:
    """Return the triples of columns that name the axes of a position.

    Args:
        names: the file's names of the columns that have no other meaning yet.
    """
    shapes = []
    for (terms, _), columns in _by_axis(names).items():
        if ORIENTATION_WORDS.isdisjoint(terms) and "w" not in columns and set(AXES) <= columns.keys():
            shapes.append(Shape(_picked(columns, AXES, AXES), terms))
    for terms, columns in _numbered(names, PLACE_WORDS - {"p", "t", "d"}, 3).items():
        shapes.append(Shape(dict(zip(AXES, columns)), terms))
    return _measured(shapes)


def orientations_by_shape(names: Sequence[str]) -> list[Shape]:
    """Return the quaternions and triples of angles that columns name by axis, by number or by names of angles.

    Args:
        names: the file's names of the columns that have no other meaning yet.
    """
    shapes = []
    for (terms, _), columns in _by_axis(names).items():
        if set("xyzw") <= columns.keys():
            shapes.append(Shape(_picked(columns, QUATERNION, "xyzw"), terms))
        elif set(AXES) <= columns.keys() and not ORIENTATION_WORDS.isdisjoint(terms):
            shapes.append(_angles(columns, AXES, terms))
    for terms, columns in _numbered(names, ORIENTATION_WORDS - QUATERNION_WORDS, 3).items():
        shapes.append(_angles(dict(zip(AXES, columns)), AXES, terms))
    for angle_names in ANGLE_NAMES:
        shapes += _named_angles(names, angle_names)
    return _measured(shapes)


def numbered_quaternions(names: Sequence[str]) -> list[tuple[Shape, Shape]]:
    """Return the quaternions whose components are numbered, with w first and with w last.

    Args:
        names: the file's names of the columns that have no other meaning yet.
    """
    pairs = []
    for terms, columns in _numbered(names, ORIENTATION_WORDS, 4).items():
        w_first: Mapped = dict(zip(("qw", "qx", "qy", "qz"), columns))
        pairs.append((Shape(w_first, terms), Shape(dict(zip(QUATERNION, columns)), terms)))
    return pairs


def matrices_by_shape(table: Table, names: Sequence[str]) -> list[Shape]:
    """Return rotations and whole poses that columns name as elements of a matrix.

    Args:
        table: the table, whose numbers tell whether rows or columns of a matrix follow one another.
        names: the file's names of the columns that have no other meaning yet.
    """
    elements: dict[tuple[str, ...], dict[tuple[int, int], str]] = {}
    for name in names:
        numbers, beside = parted(words_of(name))
        digits = "".join(numbers)
        if len(digits) == 2:
            elements.setdefault(beside, {}).setdefault((int(digits[0]), int(digits[1])), name)
    shapes = []
    for terms, columns in elements.items():
        first = min(min(columns))
        if first in (0, 1):
            shapes += _matrix({(i - first, j - first): name for (i, j), name in columns.items()}, terms)
    for size, width in FLAT_SIZES.items():
        for terms, columns in _numbered(names, (), size).items():
            shapes += _flat_matrix(table, columns, width, terms)
    return _measured(shapes)


def _by_axis(names: Iterable[str]) -> dict[tuple[tuple[str, ...], str], Mapped]:
    """Return columns by axis (x, y, z, w), for the words beside the axis and the number behind it.

    Args:
        names: the file's names of columns.
    """
    result: dict[tuple[tuple[str, ...], str], Mapped] = {}
    for name in names:
        terms = list(filterfalse(UNIT_WORDS.__contains__, words_of(name)))
        number = ""
        if len(terms) > 1 and terms[-1].isdigit():
            number = terms.pop()
        axis, beside = _axis(terms)
        if axis and REJECTED_WORDS.isdisjoint(beside):
            result.setdefault((beside, number), {}).setdefault(axis, name)
    return result


def _axis(terms: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """Return the axis that words name, and the words beside it; "" if they name none or several.

    Args:
        terms: words of a column's name.
    """
    axes = list(filter(("x", "y", "z", "w").__contains__, terms))
    if len(axes) == 1:
        return axes[0], tuple(filterfalse(axes.__contains__, terms))
    if axes or not terms:
        return "", ()
    match = _GLUED.fullmatch(terms[-1])
    if match is None:
        return "", ()
    axis = match["axis"] or match["first"]
    stem = match["stem"] or match["rest"]
    if stem not in ORIENTATION_WORDS | PLACE_WORDS:
        return "", ()
    return axis, (*terms[:-1], stem)


def _numbered(names: Iterable[str], stems: Collection[str], size: int) -> dict[tuple[str, ...], list[str]]:
    """Return columns in the order of their numbers, for words with exactly `size` numbers from 0 or from 1.

    Args:
        names: the file's names of columns.
        stems: words of which one must stand beside the number; (): any.
        size: number of columns.
    """
    numbered: dict[tuple[str, ...], dict[int, str]] = {}
    for name in names:
        digits, beside = parted(words_of(name))
        if len(digits) == 1 and beside and REJECTED_WORDS.isdisjoint(beside):
            numbered.setdefault(beside, {}).setdefault(int(digits[0]), name)
    result = {}
    for terms, columns in numbered.items():
        numbers = sorted(columns)
        in_sequence = len(numbers) == size and numbers[0] in (0, 1) and numbers[-1] - numbers[0] == size - 1
        if in_sequence and (not stems or not set(stems).isdisjoint(terms)):
            result[terms] = list(map(columns.__getitem__, numbers))
    return result


def _named_angles(names: Sequence[str], angle_names: tuple[str, ...]) -> list[Shape]:
    """Return the triples of columns named as angles, such as ``tcp_roll tcp_pitch tcp_yaw``.

    Args:
        names: the file's names of columns.
        angle_names: names of the three angles. Those of one letter stand alone, and are capital letters.
    """
    by_words: dict[tuple[str, ...], Mapped] = {}
    for name in names:
        terms = words_of(name)
        # A B C, or a_deg b_deg c_deg
        bare = list(filterfalse(UNIT_WORDS.__contains__, terms))
        if len(angle_names[0]) == 1 and not (len(bare) == 1 and (name.isupper() or len(bare) < len(terms))):
            continue
        for angle in angle_names:
            if terms.count(angle) == 1:
                beside = tuple(filterfalse({angle, *UNIT_WORDS}.__contains__, terms))
                by_words.setdefault(beside, {}).setdefault(angle, name)
    shapes = []
    for terms, columns in by_words.items():
        if len(columns) == 3 and REJECTED_WORDS.isdisjoint(terms):
            shapes.append(_angles(columns, angle_names, terms))
    return shapes


def _picked(columns: Mapping[str, str], standard_names: Iterable[str], keys: Iterable[str]) -> Mapped:
    """Return the toolkit's names → the columns with these keys, in their order."""
    return dict(zip(standard_names, map(columns.__getitem__, keys)))


def _angles(columns: Mapping[str, str], keys: Iterable[str], terms: tuple[str, ...]) -> Shape:
    euler = "" if VECTOR_WORDS.isdisjoint(terms) else "vector"
    return Shape(_picked(columns, ANGLES, keys), terms, euler)


def _matrix(elements: Mapping[tuple[int, int], str], terms: tuple[str, ...]) -> list[Shape]:
    """Return the rotation, and the position if it is there, of a matrix 3x3, 3x4 or 4x4; [] for another set.

    Args:
        elements: columns by row and column of the matrix, from 0.
        terms: words that the columns have in common.
    """
    columns: Mapped = {}
    for i in range(3):
        for j in range(3):
            if (i, j) not in elements:
                return []
            columns[f"r{i + 1}{j + 1}"] = elements[i, j]
    for i, axis in enumerate(AXES):
        if (i, 3) in elements:
            columns[axis] = elements[i, 3]
    if len(columns) not in (9, 12):
        return []
    return [Shape(columns, terms)]


def _flat_matrix(table: Table, columns: Sequence[str], width: int, terms: tuple[str, ...]) -> list[Shape]:
    """Return the matrix whose elements are numbered, if its numbers are a rotation row by row or column by column.

    A rotation alone is read by rows: its transpose is a rotation, too.

    Args:
        table: the table.
        columns: the file's names of the elements, in order.
        width: number of elements in a row.
        terms: words that the columns have in common.
    """
    cells = [table.cells[table.header.index(name)] for name in columns]
    if any(values.dtype != float for values in cells):
        return []
    rows = len(columns) // width
    numbers = np.stack(cells, axis=1)
    for transposed in (False, True):
        order = np.arange(len(columns)).reshape(rows, width)
        if transposed:
            order = np.arange(len(columns)).reshape(width, rows).T
        matrices = numbers[:, order[:3, :3]]
        defect = np.abs(matrices @ np.swapaxes(matrices, 1, 2) - np.eye(3)).max()
        last_row = numbers[:, order[3:].ravel()]
        is_pose = rows < 4 or np.abs(last_row - [0.0, 0.0, 0.0, 1.0]).max() < BOUNDS.max_norm_error
        if math.isfinite(defect) and defect < 2 * BOUNDS.max_norm_error and is_pose:
            elements = {(i, j): columns[int(order[i, j])] for i in range(rows) for j in range(width)}
            return _matrix(elements, terms)
    return []


def _measured(shapes: Sequence[Shape]) -> list[Shape]:
    """Return the shapes that were not commanded; all of them if there are no others."""
    return list(filterfalse(attrgetter("is_commanded"), shapes)) or list(shapes)


def with_shape(options: FileOptions, shape: Shape) -> FileOptions:
    """Return options with the columns and the convention of a shape, under those that the options state.

    Args:
        options: options for reading a file.
        shape: columns of one quantity.
    """
    columns = {**shape.columns, **options.columns}
    return replace(options, columns=columns, euler=options.euler or shape.euler)

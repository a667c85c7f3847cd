"""Joint columns of a table by their names: which column holds which joint, and which quantity.

Measurement files and logs name a joint's column by the joint's name or number and words beside it:
``shoulder_pan.pos``, ``/joint_states/elbow/velocity``, ``A1 … A6, E1`` (KUKA), ``J1`` (FANUC), ``JT1`` (Kawasaki),
``rax_1`` (ABB), ``S L U R B T`` (Yaskawa), ``Base … Wrist 3`` (UR), ``field.position0`` with the joint's name in the
cells of ``field.name0`` (rostopic). Columns that agree in their words and differ in the joint are a `JointSeries`.
Numbers start at 0 or 1. External axes ``E1 …`` beside numbered axes are the robot's prismatic joints, if it has as
many; otherwise the names do not tell which joints they are.
"""

import re
import tomllib
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import filterfalse
from operator import attrgetter
from pathlib import Path

from calib.data.csv_table import Table
from calib.errors import listing

# words in names of columns, by what they mean
_WORDS = tomllib.loads(Path(__file__).with_name("column_words.toml").read_text(encoding="utf-8"))
JOINT_WORDS = frozenset(_WORDS["joint"].split())
POSITION_WORDS = frozenset(_WORDS["position"].split())
OTHER_WORDS = frozenset(_WORDS["other"].split())
PLAIN_WORDS = frozenset(_WORDS["plain"].split())
COMMANDED_WORDS = frozenset(_WORDS["commanded"].split())
EXTERNAL_WORDS = frozenset(_WORDS["external"].split())
# joints that a pendant shows by letters or names, in the order of the arm
PENDANTS = (
    ("s", "l", "u", "r", "b", "t"),
    ("s", "l", "e", "u", "r", "b", "t"),
    ("base", "shoulder", "elbow", "wrist1", "wrist2", "wrist3"),
)
# first words of columns that are no joints
TARGET_WORDS = frozenset(("x", "y", "z", "t", "time", "nr", "no", "row", "tag", "name", "point", "punkt"))
# units as words of names; a rail is in m beside turning joints in deg
UNIT_WORDS = frozenset(("mm", "m", "cm", "deg", "degrees", "rad"))
_BREAK = re.compile(r"(?<=[a-zäöü])(?=[A-ZÄÖÜ])")
_WORD = re.compile(r"[^\W\d_]+|\d+")


@dataclass(frozen=True)
class JointSeries:
    """One column per joint, all of one quantity.

    Attributes:
        columns: n names of columns, in the robot's order.
        terms: words that all names have beside the joint.
        by_name: whether the columns have the joints' names, not only numbers.
    """

    columns: tuple[str, ...]
    terms: tuple[str, ...]
    by_name: bool = False

    @property
    def is_position(self) -> bool:
        """Whether the words may mean a position; numbers alone count where a word for joints stands beside them."""
        terms = set(self.terms)
        if terms & OTHER_WORDS and not terms & (POSITION_WORDS - {"q"}):
            return False
        if self.by_name and terms <= PLAIN_WORDS:
            return True
        return bool(terms & (JOINT_WORDS | POSITION_WORDS))

    @property
    def is_commanded(self) -> bool:
        """Whether a word means that the position was commanded, not measured."""
        return bool(COMMANDED_WORDS.intersection(self.terms))


def words_of(name: str) -> tuple[str, ...]:
    """Return the words and numbers in a column's name, in lower case: (joint, 1, pos) for ``Joint1.pos``."""
    text = _BREAK.sub(" ", unicodedata.normalize("NFKC", name))
    return tuple(_WORD.findall(text.casefold()))


def parted(terms: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the numbers among the terms of a name, and the words."""
    return tuple(filter(str.isdigit, terms)), tuple(filterfalse(str.isdigit, terms))


def joint_series(header: Sequence[str], joints: Sequence[str], kinds: Sequence[str] = ()) -> list[JointSeries]:
    """Return the complete series of joint columns in a header: those by name before those by number.

    Args:
        header: names of the columns.
        joints: names of the robot's n joints.
        kinds: URDF type of each joint, which tells external axes apart; (): all revolute.
    """
    result = _by_names(header, list(map(words_of, joints)))
    if not result:
        result = _by_names(header, _short_names(joints))
    for pendant in PENDANTS:
        if len(pendant) == len(joints):
            result += _by_names(header, list(map(words_of, pendant)))
    kinds = kinds or ["revolute"] * len(joints)
    numbered = _numbered(header)
    result += _by_numbers(numbered, len(joints))
    return result + _with_external(numbered, kinds)


def series_named_in_cells(table: Table, joints: Sequence[str]) -> list[JointSeries]:
    """Return the series of columns whose joint stands in the cells of another column with the same number.

    Args:
        table: the table, for example with columns ``field.name0`` and ``field.position0``.
        joints: names of the robot's joints.
    """
    number_of: dict[str, int] = {}
    numbered = _numbered(table.header)
    for columns in numbered.values():
        for number, column in columns.items():
            cells = table.cells[table.header.index(column)]
            texts = set(cells.tolist())
            if cells.dtype == object and len(texts) == 1:
                number_of[texts.pop()] = number
    if not number_of.keys() >= set(joints):
        return []
    numbers = list(map(number_of.__getitem__, joints))
    result = []
    for terms, columns in numbered.items():
        if columns.keys() >= set(numbers):
            names = tuple(map(columns.__getitem__, numbers))
            result.append(JointSeries(names, terms, by_name=True))
    return result


def position_series(series: Sequence[JointSeries]) -> list[JointSeries]:
    """Return the series that may be measured joint positions: the named before the numbered, none that were commanded.

    Args:
        series: all series of a table.
    """
    positions = list(filter(attrgetter("is_position"), series))
    positions = list(filter(attrgetter("by_name"), positions)) or positions
    return list(filterfalse(attrgetter("is_commanded"), positions)) or positions


def joints_in(header: Sequence[str], joints: Sequence[str]) -> list[str]:
    """Return the joints whose names occur in a header, alone or with words beside them.

    Args:
        header: names of the columns.
        joints: names of joints.
    """
    longest = sorted(joints, key=lambda joint: len(words_of(joint)), reverse=True)
    result = []
    for column in header:
        terms = words_of(column)
        for joint in longest:
            if _without(terms, words_of(joint)) is not None:
                result.append(joint)
                break
    return list(dict.fromkeys(result))


def longest_numbering(header: Sequence[str]) -> int:
    """Return the number of columns of the longest series numbered from 0 or 1 whose words, or letter, may mean joints.

    Args:
        header: names of the columns.
    """
    longest = 0
    for terms, columns in _numbered(header).items():
        count = len(columns)
        is_letter = len("".join(terms)) == 1 and OTHER_WORDS.isdisjoint(terms)
        if _by_numbers({terms: columns}, count) and (is_letter or JointSeries((), terms).is_position):
            longest = max(longest, count)
    return longest


def mapping_line(series: JointSeries) -> str:
    """Return the line of an options file that maps the joints to the columns of a series."""
    entries = [f'q{number} = "{column}"' for number, column in enumerate(series.columns, 1)]
    return f"columns = {{ {', '.join(entries)} }}"


def proposed_line(header: Sequence[str], series: Sequence[JointSeries], n: int) -> str:
    """Return a line of an options file that maps n joints to columns of a header, as far as their names tell them.

    Args:
        header: names of the columns.
        series: complete series in the header, none of which is known to be positions.
        n: number of the robot's joints.
    """
    if series:
        return mapping_line(series[0])
    columns = [column for column in header if TARGET_WORDS.isdisjoint(words_of(column)[:1])]
    columns += ["..."] * n
    return mapping_line(JointSeries(tuple(columns[:n]), ()))


def described(series: JointSeries) -> str:
    """Return a series' columns as text, with the first and the last of many."""
    return listing(series.columns, 8)


def _without(terms: tuple[str, ...], part: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return `words` without the words of `part`, which stand together; None if they do not.

    Args:
        terms: words of a column's name.
        part: words of a joint's name.
    """
    for start in range(len(terms) - len(part) + 1):
        stop = start + len(part)
        if terms[start:stop] == part:
            return terms[:start] + terms[stop:]
    return None


def _by_names(header: Sequence[str], names: Sequence[tuple[str, ...]]) -> list[JointSeries]:
    """Return the series of columns that contain all of the names.

    Args:
        header: names of the columns.
        names: words of each joint's name; an empty one matches no column.
    """
    by_words: dict[tuple[str, ...], dict[tuple[str, ...], str]] = {}
    # the longest name first: wrist_roll is not the joint wrist
    longest = sorted(filter(None, names), key=len, reverse=True)
    for column in header:
        terms = words_of(column)
        for name in longest:
            remainder = _without(terms, name)
            if remainder is not None:
                remainder = tuple(filterfalse(UNIT_WORDS.__contains__, remainder))
                by_words.setdefault(remainder, {}).setdefault(name, column)
                break
    result = []
    for remainder, columns in by_words.items():
        if columns.keys() >= set(names):
            result.append(JointSeries(tuple(map(columns.__getitem__, names)), remainder, by_name=True))
    return result


def _short_names(joints: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the words of joints' names without those that all have and those that only mean a joint.

    The result is empty names where numbers alone would remain.

    Args:
        joints: names of the joints.
    """
    names = list(map(words_of, joints))
    common = set(names[0]).intersection(*names) | {"joint"}
    short = []
    for name in names:
        terms = tuple(filterfalse(common.__contains__, name))
        has_name = not "".join(terms).isdigit()
        short.append(terms * has_name)
    if len(set(short)) < len(short):
        return [()] * len(short)
    return short


def _numbered(header: Sequence[str]) -> dict[tuple[str, ...], dict[int, str]]:
    """Return the columns by number, for the words that stand beside the number; the last number in a name counts.

    Args:
        header: names of the columns.
    """
    result: dict[tuple[str, ...], dict[int, str]] = {}
    for column in header:
        terms = words_of(column)
        indices = [index for index, term in enumerate(terms) if term.isdigit()]
        if indices:
            index = indices[-1]
            beside = terms[:index] + terms[index + 1 :]
            result.setdefault(beside, {}).setdefault(int(terms[index]), column)
    return result


def _by_numbers(numbered: Mapping[tuple[str, ...], Mapping[int, str]], n: int) -> list[JointSeries]:
    """Return the series of n columns that are numbered from 0 or from 1 without gaps.

    Args:
        numbered: columns by number, for the words beside the number.
        n: number of the robot's joints.
    """
    result = []
    for terms, columns in numbered.items():
        numbers = sorted(columns)
        if len(numbers) == n and numbers[0] in (0, 1) and numbers[-1] - numbers[0] == n - 1:
            result.append(JointSeries(tuple(map(columns.__getitem__, numbers)), terms))
    return result


def _with_external(numbered: Mapping[tuple[str, ...], Mapping[int, str]], kinds: Sequence[str]) -> list[JointSeries]:
    """Return the series of numbered axes and external axes that together are the robot's joints.

    Args:
        numbered: columns by number, for the words beside the number.
        kinds: URDF type of each joint.
    """
    sliding = [index for index, kind in enumerate(kinds) if kind == "prismatic"]
    turning = [index for index, kind in enumerate(kinds) if kind != "prismatic"]
    if not sliding or not turning:
        return []
    series = _by_numbers(numbered, len(sliding))
    external = [entry for entry in series if EXTERNAL_WORDS.intersection(entry.terms)]
    result = []
    for arm in _by_numbers(numbered, len(turning)):
        for rail in external:
            columns = [""] * len(kinds)
            for index, column in zip((*turning, *sliding), (*arm.columns, *rail.columns)):
                columns[index] = column
            result.append(JointSeries(tuple(columns), arm.terms))
    return result

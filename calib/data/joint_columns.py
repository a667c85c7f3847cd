"""Joint columns of a table by their names: which column holds which joint, and which quantity.

Measurement files and logs name a joint's column by the joint's name or number and words beside it:
``shoulder_pan.pos``, ``/joint_states/elbow/velocity``, ``A1 … A6, E1`` (KUKA), ``J1`` (FANUC), ``JT1`` (Kawasaki),
``rax_1`` (ABB), ``S L U R B T`` (Yaskawa), ``Base … Wrist 3`` (UR), ``field.position0`` with the joint's name in the
cells of ``field.name0`` (rostopic). Columns that agree in their words and differ in the joint are a `JointSeries`.
Numbers start at 0 or 1. External axes ``E1 …`` beside numbered axes are the robot's prismatic joints, if it has as
many; otherwise the names do not tell which joints they are.
"""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from calib.data.csv_table import Table
from calib.errors import listing

# words for a joint, in languages of pendants and teaching programs
JOINT_WORDS = frozenset(
    "q j jt jnt joint joints a ax axis axes rax theta th θ motor servo achse gelenk axe articulation eje articulacion "
    "articulación junta eixo asse giunto oś os as led kloub eksen mafsal сустав ось 关节 轴 軸 関節 관절 축".split()
)
# words for a position of a joint
POSITION_WORDS = frozenset("q pos position positions qpos angle angles deg winkel angulo ángulo angolo 角度".split())
# words for another quantity of a joint
OTHER_WORDS = frozenset(
    "v vel velocity velocities speed dq qd qvel geschwindigkeit acc acceleration ddq qdd tau torque torques effort "
    "efforts moment force load i current currents strom voltage temperature temp error sigma time name names limit "
    "min max lower upper raw pwm duty power".split()
)
# words that say nothing about the quantity
PLAIN_WORDS = frozenset(
    "actual act measured meas state states ist istwert observation field value robot robax data feedback deg rad mm "
    "degrees".split()
)
# words for a position that was to be reached, not one that was measured
COMMANDED_WORDS = frozenset(
    "cmd command commanded target ref reference des desired action goal soll sollwert setpoint set nominal plan "
    "planned".split()
)
# words for an axis outside the arm, beside the arm's numbered axes
EXTERNAL_WORDS = frozenset("e eax ext extax external zusatzachse".split())
# joints that a pendant shows by letters or names, in the order of the arm
PENDANTS = (
    ("s", "l", "u", "r", "b", "t"),
    ("s", "l", "e", "u", "r", "b", "t"),
    ("base", "shoulder", "elbow", "wrist1", "wrist2", "wrist3"),
)
# first words of columns that are no joints
TARGET_WORDS = [(word,) for word in ("x", "y", "z", "t", "time", "nr", "no", "row", "tag", "name", "point", "punkt")]
_BREAK = re.compile(r"(?<=[a-zäöü])(?=[A-ZÄÖÜ])")
_WORD = re.compile(r"[^\W\d_]+|\d+")


@dataclass(frozen=True)
class JointSeries:
    """One column per joint, all of one quantity.

    Attributes:
        columns: n names of columns, in the robot's order.
        words: words that all names have beside the joint.
        named: whether the columns have the joints' names, not only numbers.
    """

    columns: tuple[str, ...]
    words: tuple[str, ...]
    named: bool = False

    @property
    def is_position(self) -> bool:
        """Whether the words may mean a position; numbers alone count where a word for joints stands beside them."""
        words = set(self.words)
        if words & OTHER_WORDS and not words & (POSITION_WORDS - {"q"}):
            return False
        if self.named and words <= PLAIN_WORDS:
            return True
        return bool(words & (JOINT_WORDS | POSITION_WORDS))

    @property
    def is_commanded(self) -> bool:
        """Whether a word means that the position was commanded, not measured."""
        return bool(COMMANDED_WORDS.intersection(self.words))


def words_of(name: str) -> tuple[str, ...]:
    """Return the words and numbers in a column's name, in lower case: (joint, 1, pos) for ``Joint1.pos``."""
    text = _BREAK.sub(" ", unicodedata.normalize("NFKC", name))
    return tuple(word.casefold() for word in _WORD.findall(text))


def joint_series(header: Sequence[str], joints: Sequence[str], kinds: Sequence[str] = ()) -> list[JointSeries]:
    """Return the complete series of joint columns in a header: those by name before those by number.

    Args:
        header: names of the columns.
        joints: names of the robot's n joints.
        kinds: URDF type of each joint, which tells external axes apart; (): all revolute.
    """
    result = _by_names(header, [words_of(joint) for joint in joints])
    if not result:
        result = _by_names(header, _short_names(joints))
    for pendant in PENDANTS:
        if len(pendant) == len(joints):
            result += _by_names(header, [words_of(name) for name in pendant])
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
            texts = set(cells.tolist()) if cells.dtype == object else set()
            if len(texts) == 1:
                number_of[texts.pop()] = number
    if any(joint not in number_of for joint in joints):
        return []
    numbers = [number_of[joint] for joint in joints]
    result = []
    for words, columns in numbered.items():
        if all(number in columns for number in numbers):
            names = tuple(columns[number] for number in numbers)
            result.append(JointSeries(names, words, named=True))
    return result


def position_series(series: Sequence[JointSeries]) -> list[JointSeries]:
    """Return the series that may be measured joint positions: the named before the numbered, none that were commanded.

    Args:
        series: all series of a table.
    """
    positions = [entry for entry in series if entry.is_position]
    positions = [entry for entry in positions if entry.named] or positions
    return [entry for entry in positions if not entry.is_commanded] or positions


def joints_in(header: Sequence[str], joints: Sequence[str]) -> list[str]:
    """Return the joints whose names occur in a header, alone or with words beside them.

    Args:
        header: names of the columns.
        joints: names of joints.
    """
    columns = [words_of(name) for name in header]
    result = []
    for joint in joints:
        words = words_of(joint)
        if any(_without(column, words) is not None for column in columns):
            result.append(joint)
    return result


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
    columns = [column for column in header if words_of(column)[:1] not in TARGET_WORDS]
    columns += ["..."] * n
    return mapping_line(JointSeries(tuple(columns[:n]), ()))


def described(series: JointSeries) -> str:
    """Return a series' columns as text, with the first and the last of many."""
    return listing(series.columns, 8)


def _without(words: tuple[str, ...], part: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return `words` without the words of `part`, which stand together; None if they do not.

    Args:
        words: words of a column's name.
        part: words of a joint's name.
    """
    for start in range(len(words) - len(part) + 1):
        stop = start + len(part)
        if words[start:stop] == part:
            return words[:start] + words[stop:]
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
        words = words_of(column)
        for name in longest:
            rest = _without(words, name)
            if rest is not None:
                by_words.setdefault(rest, {}).setdefault(name, column)
                break
    result = []
    for rest, columns in by_words.items():
        if all(name in columns for name in names):
            result.append(JointSeries(tuple(columns[name] for name in names), rest, named=True))
    return result


def _short_names(joints: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the words of joints' names without those that all have and those that only mean a joint.

    The result is empty names where numbers alone would remain.

    Args:
        joints: names of the joints.
    """
    names = [words_of(joint) for joint in joints]
    common = set(names[0]).intersection(*names) | {"joint"}
    short = []
    for name in names:
        words = tuple(word for word in name if word not in common)
        is_number = all(word.isdigit() for word in words)
        short.append(() if is_number else words)
    return short if len(set(short)) == len(short) else [()] * len(short)


def _numbered(header: Sequence[str]) -> dict[tuple[str, ...], dict[int, str]]:
    """Return the columns by number, for the words that stand beside the number; the last number in a name counts.

    Args:
        header: names of the columns.
    """
    result: dict[tuple[str, ...], dict[int, str]] = {}
    for column in header:
        words = words_of(column)
        places = [place for place, word in enumerate(words) if word.isdigit()]
        if places:
            place = places[-1]
            beside = words[:place] + words[place + 1 :]
            result.setdefault(beside, {}).setdefault(int(words[place]), column)
    return result


def _by_numbers(numbered: Mapping[tuple[str, ...], Mapping[int, str]], n: int) -> list[JointSeries]:
    """Return the series of n columns that are numbered from 0 or from 1 without gaps.

    Args:
        numbered: columns by number, for the words beside the number.
        n: number of the robot's joints.
    """
    result = []
    for words, columns in numbered.items():
        numbers = sorted(columns)
        if len(numbers) == n and numbers[0] in (0, 1) and numbers[-1] - numbers[0] == n - 1:
            result.append(JointSeries(tuple(columns[number] for number in numbers), words))
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
    external = []
    for series in _by_numbers(numbered, len(sliding)):
        if EXTERNAL_WORDS.intersection(series.words):
            external.append(series)
    result = []
    for arm in _by_numbers(numbered, len(turning)):
        for outside in external:
            columns = [""] * len(kinds)
            for index, column in zip((*turning, *sliding), (*arm.columns, *outside.columns)):
                columns[index] = column
            result.append(JointSeries(tuple(columns), arm.words))
    return result

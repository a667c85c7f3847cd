"""Columns of a log that belong together, one per joint, and the quantity that the words of their names tell.

Which columns belong together is said by `calib.data.joint_columns`. The last word that names a quantity decides
(``position``, ``effort``, ``current``); words such as ``desired``, ``error`` or ``external`` beside it tell a
reference, or columns that are not read. Of several topics with positions, the first with torques counts.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from calib.data.csv_table import Table
from calib.data.joint_columns import joint_series, words_of
from calib.data.recordings.recording_options import SYNONYMS
from calib.data.schema import Joints
from calib.errors import suggestion

JOINT, NUMBER = "{joint}", "{n}"
# Words that name a quantity; the last one in a heading decides. English, German, French, Spanish, Italian, Chinese.
_WORDS = {
    "q": "q qpos pos position positions angle angles winkel posicion posición ángulo posizione angolo 位置 角度",
    "v": "v dq qd qvel vel velocity velocities speed speeds geschwindigkeit drehzahl vitesse velocidad velocità 速度",
    "torque": "tau torque torques trq torq effort efforts eff moment drehmoment couple par coppia 力矩 扭矩",
    "current": "i current currents curr amps strom courant corriente corrente 电流",
}
QUANTITIES: dict[str, str] = {}
for _series, _tokens in _WORDS.items():
    QUANTITIES.update(dict.fromkeys(_tokens.split(), _series))
TIME_WORDS = {"t", "time", "times", "timestamp", "timestamps", "stamp", "clock", "header"}
TIME_WORDS |= {"zeit", "zeitstempel", "temps", "tiempo", "tempo", "时间"}
UNITS_OF_TIME = {"s": "s", "sec": "s", "secs": "s", "seconds": "s", "ms": "ms", "us": "us", "ns": "ns"}
UNITS_OF_TIME |= {"msec": "ms", "usec": "us", "nsec": "ns", "nanosec": "ns", "nanoseconds": "ns", "milliseconds": "ms"}
REFERENCE = {
    "ref",
    "reference",
    "des",
    "desired",
    "cmd",
    "command",
    "commanded",
    "target",
    "setpoint",
    "goal",
    "action",
    "d",
}
REFERENCE_SERIES = {"q": "q_ref"}
FEEDFORWARD = {"ff", "feedforward"}
FEEDFORWARD_SERIES = {"torque": "tau_ff"}
# Words of a heading whose values are no measurement of the quantity itself.
UNREAD = {"error", "errors", "err", "limit", "min", "max", "tolerance", "offset", "std", "sigma", "variance"}
UNREAD |= {"external", "ext", "estimated", "model", "computed", "output", "acceleration", "accelerations", "hat"}
# Series with a token of their own: (series of the last token, token) → series.
SPECIAL = {
    ("torque", "link"): "tau_link",
    ("torque", "sensor"): "tau_link",
    ("torque", "motor"): "tau_motor",
    ("q", "link"): "q_link",
}


def time_column(header: Sequence[str]) -> tuple[int, str] | None:
    """Return the index of the column of times and the unit in its name (``timestamp_ns``), "" for none; or None."""
    for column, heading in enumerate(header):
        tokens = re.findall(r"[^\W_]+", heading.lower())
        units = UNITS_OF_TIME.keys() & set(tokens)
        time_words = set(tokens) - units
        if time_words and len(units) <= 1 and time_words <= TIME_WORDS:
            unit = ""
            if units:
                unit = UNITS_OF_TIME[units.pop()]
            return column, unit
    return None


@dataclass(frozen=True)
class Family:
    """Columns of one quantity, one per joint.

    Attributes:
        pattern: the headings, with ``{joint}`` in place of the joint's name or ``{n}`` in place of its number.
        columns: indices of the columns, in the order of the robot's joints, or of the numbers.
        series: the toolkit's name of the quantity; empty if the words do not tell it.
        by_name: whether the columns have the joints' names, not only numbers.
        plain: whether the names are those of joints, without a word for a quantity (``elbow``, ``A1``).
    """

    pattern: str
    columns: tuple[int, ...]
    series: str
    by_name: bool = True
    plain: bool = False

    @property
    def topic(self) -> str:
        """The pattern without the words of the quantity: equal for all quantities of one message."""
        names = re.split(r"[\W_]+", self.pattern)
        return "/".join([name for name in names if name.lower() not in QUANTITIES])


def families(header: Sequence[str], joints: Joints) -> list[Family]:
    """Return the families of columns in a header that have one column per joint: by names, then by numbers.

    Args:
        header: names of the columns.
        joints: the robot's joints; without any, no columns belong together.
    """
    if not joints.names:
        return []
    headings = list(header)
    result = []
    for series in joint_series(header, joints.names, joints.kinds):
        columns = tuple(map(headings.index, series.columns))
        quantity = series_of(series.terms)
        plain = not quantity and series.is_position and not series.is_commanded
        result.append(Family(_pattern(series.columns, joints.names), columns, quantity, series.by_name, plain))
    return result


def _pattern(headings: Sequence[str], joints: Sequence[str]) -> str:
    """Return headings as one text, with ``{joint}``, or ``{n}`` for numbers, in place of what differs between them.

    Args:
        headings: the heading of each joint's column.
        joints: the joints' names.
    """
    patterns = set(map(str.replace, headings, joints, [JOINT] * len(joints)))
    if len(patterns) == 1 and JOINT in min(patterns):
        return patterns.pop()
    start = _common_start(headings)
    backwards = [heading[len(start) :][::-1] for heading in headings]
    end = _common_start(backwards)[::-1]
    parts = ""
    for heading in headings:
        parts += heading[len(start) : len(heading) - len(end)]
    placeholder = NUMBER if parts.isdigit() else JOINT
    return f"{start}{placeholder}{end}"


def series_of(tokens: Sequence[str]) -> str:
    """Return the toolkit's series that the words `tokens` of a family or column tell; "" if they do not tell it."""
    quantities = [QUANTITIES[token] for token in tokens if token in QUANTITIES]
    if not quantities or UNREAD & set(tokens):
        return ""
    series = quantities[-1]
    if FEEDFORWARD & set(tokens):
        return FEEDFORWARD_SERIES.get(series, "")
    if REFERENCE & set(tokens):
        return REFERENCE_SERIES.get(series, "")
    for (of_series, token), special in SPECIAL.items():
        if series == of_series and token in tokens:
            return special
    return series


def _common_start(texts: Sequence[str]) -> str:
    """Return the longest text with which all texts begin."""
    shortest = min(texts, key=len)
    for length in range(len(shortest), 0, -1):
        if all(text.startswith(shortest[:length]) for text in texts):
            return shortest[:length]
    return ""


def chosen(candidates: Sequence[Family]) -> tuple[dict[str, Family], tuple[str, ...]]:
    """Return one family for each series, and patterns of families that could be meant as well.

    Families by joint names are preferred; then those of the first topic with positions and torques (or currents).

    Args:
        candidates: families in the order of the file.
    """
    by_topic: dict[str, set[str]] = {}
    for family in candidates:
        by_topic.setdefault(family.topic, set()).add(family.series)
    complete = []
    for topic, series in by_topic.items():
        if "q" in series and series & {"torque", "current"}:
            complete.append(topic)
    ranked: dict[tuple[bool, bool], list[Family]] = {}
    for family in candidates:
        ranked.setdefault((family.topic not in complete[:1], not family.by_name), []).append(family)
    in_order: list[Family] = []
    for rank in sorted(ranked):
        in_order += ranked[rank]
    families_by_series: dict[str, Family] = {}
    rivals = []
    for family in in_order:
        first = families_by_series.setdefault(family.series, family)
        if family.series and first is not family and first.by_name == family.by_name:
            rivals.append(family.pattern)
    families_by_series.pop("", None)
    return families_by_series, tuple(rivals)


def columns_meant(value: str, header: Sequence[str], joints: Joints) -> tuple[int, ...]:
    """Return the columns that a user means by `value`, in the order of the joints; () if it is none of the families.

    Accepted are a pattern (``- {joint}_position``), the heading of any joint's column, with or without punctuation, and
    the words of a heading without the joint.

    Args:
        value: what the options state.
        header: names of the columns.
        joints: the robot's joints.
    """
    candidates = families(header, joints)
    for family in candidates:
        names = [header[column] for column in family.columns]
        if _plain(value) in map(_plain, [family.pattern, *names]):
            return family.columns
    tokens = words_of(value.replace(JOINT, " ").replace(NUMBER, " "))
    series = series_of(tokens)
    # as many tokens as a heading has, without some of the joint's
    for family in candidates:
        for column in family.columns:
            is_part = set(tokens) <= set(words_of(header[column]))
            if series and is_part and family.series == series:
                return family.columns
    return ()


def _plain(text: str) -> str:
    """Return a pattern or heading in small letters without punctuation."""
    return re.sub(r"[\W_]", "", text.replace(NUMBER, JOINT).lower())


def paste(header: Sequence[str], joints: Joints, needed: Sequence[str]) -> str:
    """Return a line for the options file that names the columns of the series in `needed`; "" if none can be proposed.

    Where no columns belong together, the first columns in the file's order are proposed, joint by joint.

    Args:
        header: names of the columns that may be meant, in the file's order.
        joints: the robot's joints.
        needed: the toolkit's names of the series.
    """
    count = len(joints.names)
    groups: dict[int, str] = {}
    together: set[int] = set()
    for family in families(header, joints):
        if not family.series:
            groups[min(family.columns)] = family.pattern
            together.update(family.columns)
    by_series: dict[str, list[int]] = {}
    for column, heading in enumerate(header):
        if not heading.startswith("\0") and column not in together:
            by_series.setdefault(series_of(words_of(heading)), []).append(column)
    unknown = by_series.get("", [])
    entries: list[str] = []
    for series in needed:
        columns = by_series.get(series, [])
        first_group = min(groups, default=len(header))
        if count and len(columns) >= count:
            entries += _joint_by_joint(series, header, columns[:count])
        elif count and len(unknown) >= count and unknown[0] < first_group:
            entries += _joint_by_joint(series, header, unknown[:count])
            unknown = unknown[count:]
        elif groups:
            entries.append(f'{series} = "{groups.pop(first_group)}"')
    if not entries:
        return ""
    return f"columns = {{ {', '.join(entries)} }}"


def _joint_by_joint(series: str, header: Sequence[str], columns: Sequence[int]) -> list[str]:
    """Return entries of the options' [columns] for a series, with one column per joint."""
    return [f'{series}{number} = "{header[column]}"' for number, column in enumerate(columns, 1)]


def mapping_line(header: Sequence[str], joints: Joints, columns_of: Mapping[str, Sequence[int]]) -> str:
    """Return the columns of each series in the form of the options' [columns], for the user to check.

    Args:
        header: names of the columns.
        joints: the robot's joints.
        columns_of: the columns of each series.
    """
    pattern_of = {}
    for family in families(header, joints):
        pattern_of[family.columns] = family.pattern
    entries = []
    for series in SYNONYMS:
        columns = tuple(columns_of.get(series, ()))
        if columns in pattern_of:
            entries.append(f'{series} = "{pattern_of[columns]}"')
        elif len(columns) == 1:
            entries.append(f'{series} = "{header[columns[0]]}"')
        else:
            entries += _joint_by_joint(series, header, columns)
    return f"columns = {{ {', '.join(entries)} }}"


def condensed(header: Sequence[str], joints: Joints, columns: Sequence[int]) -> list[str]:
    """Return headings of columns for a note, with the pattern in place of the columns of a family.

    Args:
        header: names of the columns.
        joints: the robot's joints.
        columns: indices of the columns.
    """
    remaining = dict.fromkeys(columns)
    patterns = []
    for family in families(header, joints):
        if set(family.columns) <= remaining.keys():
            patterns.append(family.pattern)
            for column in family.columns:
                del remaining[column]
    return [*patterns, *(header[column] for column in remaining)]


def near_names(value: str, header: Sequence[str], joints: Joints) -> str:
    """Return what the file has instead of `value`, for messages: the most similar pattern, then all patterns."""
    patterns = [family.pattern for family in families(header, joints)]
    hint = suggestion(value, [*patterns, *header])
    if patterns:
        hint += f"; groups of columns, one per joint: {', '.join(map(repr, patterns))}"
    return hint


def joint_keys(columns: Mapping[str, str], joints: Joints, table: Table) -> dict[str, dict[int, str]]:
    """Return the columns that the options state joint by joint: series → index of the joint → heading.

    A key is a series' name with the joint's number from 1 (``q1``, ``tau_2``), or a joint's name (its position).

    Args:
        columns: the options' table: key → heading.
        joints: the robot's joints.
        table: the table, for messages.

    Raises:
        MeasurementError: an unknown key, or a joint of which no column is stated.
    """
    result: dict[str, dict[int, str]] = {}
    series_by_name: dict[str, str] = {}
    for series, synonyms in SYNONYMS.items():
        series_by_name.update(dict.fromkeys(synonyms, series))
    for key, heading in columns.items():
        match = re.fullmatch(r"(.*?)_?(\d+)", key)
        if key in joints.names:
            result.setdefault("q", {})[list(joints.names).index(key)] = heading
        elif match and match[1] in series_by_name:
            result.setdefault(series_by_name[match[1]], {})[int(match[2]) - 1] = heading
        else:
            expected = f"{', '.join(SYNONYMS)}, with or without a joint's number (q1, torque_2), or a joint's name"
            table.fail(f"[columns] names '{key}', which is no quantity; expected {expected}", heading)
    for series, by_joint in result.items():
        for number in range(max(len(joints.names), len(by_joint))):
            if number not in by_joint:
                table.fail(f"[columns] states {series} of {len(by_joint)} joints only: {series}{number + 1} is missing")
    return result

"""Columns of a log that belong together, one per joint, and their quantity, by the words of their headings.

A heading is split at the joint's name, or at its last number: ``/joint_states/elbow/position`` is a column of the
family ``/joint_states/{joint}/position``, ``arm2 torque`` of ``arm{n} torque``. A joint's name is accepted without the
word ``joint``, and with any punctuation (``shoulder_pan`` for ``shoulder_pan_joint``). The last word that names a
quantity decides (``position``, ``effort``, ``current``); words such as ``desired``, ``error`` or ``external`` before or
after it tell a reference, or a column that is not read. Of several topics with positions, the one with torques counts.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from calib.data.csv_table import Table
from calib.data.recordings.recording_options import SYNONYMS
from calib.errors import suggestion

JOINT, NUMBER = "{joint}", "{n}"
# Words that name a quantity; the last one in a heading decides. English, German, French, Spanish, Italian, Chinese.
_WORDS = {
    "q": "q qpos pos position positions angle angles winkel posicion posición ángulo posizione angolo 位置 角度",
    "v": "v dq qd qvel vel velocity velocities speed speeds geschwindigkeit drehzahl vitesse velocidad velocità 速度",
    "torque": "tau torque torques effort efforts moment drehmoment couple par coppia 力矩 扭矩",
    "current": "i current currents amps strom courant corriente corrente 电流",
}
QUANTITIES: Mapping[str, str] = {word: series for series, words in _WORDS.items() for word in words.split()}
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
FEEDFORWARD = {"ff", "feedforward"}
# Words of a heading whose values are no measurement of the quantity itself.
UNREAD = {"error", "errors", "err", "limit", "min", "max", "tolerance", "offset", "std", "sigma", "variance"}
UNREAD |= {"external", "ext", "estimated", "model", "computed", "output", "acceleration", "accelerations", "hat"}
# Series with a word of their own: (series of the last word, word) → series.
SPECIAL = {
    ("torque", "link"): "tau_link",
    ("torque", "sensor"): "tau_link",
    ("torque", "motor"): "tau_motor",
    ("q", "link"): "q_link",
}
_NUMBER = re.compile(r"\d+(?!.*\d)")


def time_column(header: Sequence[str]) -> tuple[int, str] | None:
    """Return the index of the column of times and the unit in its name (``timestamp_ns``), "" for none; or None."""
    for column, heading in enumerate(header):
        words = re.findall(r"[^\W_]+", heading.lower())
        units = [UNITS_OF_TIME[word] for word in words if word in UNITS_OF_TIME]
        others = [word for word in words if word not in UNITS_OF_TIME]
        if others and len(units) <= 1 and TIME_WORDS.issuperset(others):
            return column, "".join(units)
    return None


@dataclass(frozen=True)
class Family:
    """Columns of one quantity, one per joint.

    Attributes:
        pattern: the headings, with ``{joint}`` in place of the joint's name or ``{n}`` in place of its number.
        columns: indices of the columns, in the order of the robot's joints, or of the numbers.
        series: the toolkit's name of the quantity; empty if the words do not tell it.
    """

    pattern: str
    columns: tuple[int, ...]
    series: str

    @property
    def topic(self) -> str:
        """The pattern without the words of the quantity: equal for all quantities of one message."""
        names = [word for word in re.split(r"[\W_]+", self.pattern) if word.lower() not in QUANTITIES]
        return "/".join(names)


def families(header: Sequence[str], joints: Sequence[str]) -> list[Family]:
    """Return the families of columns in a header that have one column per joint: by names, then by numbers.

    Args:
        header: names of the columns.
        joints: names of the robot's joints; empty: only numbers are looked for.
    """
    by_name: dict[str, dict[str, int]] = {}
    by_number: dict[str, dict[int, int]] = {}
    for column, heading in enumerate(header):
        pattern, joint = split_joint(heading, joints)
        if joint:
            by_name.setdefault(pattern, {}).setdefault(joint, column)
            continue
        match = _NUMBER.search(heading)
        if match:
            pattern = f"{heading[: match.start()]}{NUMBER}{heading[match.end() :]}"
            by_number.setdefault(pattern, {}).setdefault(int(match[0]), column)
    result = []
    for pattern, columns in by_name.items():
        if len(columns) == len(joints):
            ordered = tuple(columns[joint] for joint in joints)
            result.append(Family(pattern, ordered, series_of(pattern)))
    for pattern, columns_by_number in by_number.items():
        numbers = sorted(columns_by_number)
        if joints and len(numbers) != len(joints):
            continue
        if numbers[0] <= 1 and numbers == list(range(numbers[0], numbers[0] + len(numbers))):
            ordered = tuple(columns_by_number[number] for number in numbers)
            result.append(Family(pattern, ordered, series_of(pattern)))
    return result


def split_joint(heading: str, joints: Sequence[str]) -> tuple[str, str]:
    """Return a heading with ``{joint}`` in place of a joint's name, and that joint; the heading and "" without one.

    Of several names in the heading, the longest is taken.

    Args:
        heading: the column's name.
        joints: names of the robot's joints.
    """
    best = None
    for joint in joints:
        for expression in _spellings(joint):
            match = re.search(expression, heading, re.I)
            if match and (best is None or len(match[0]) > len(best[0][0])):
                best = (match, joint)
    if best is None:
        return heading, ""
    match, joint = best
    return f"{heading[: match.start()]}{JOINT}{heading[match.end() :]}", joint


def _spellings(joint: str) -> list[str]:
    """Return expressions that match a joint's name as it may stand in a heading, as whole words."""
    words = re.findall(r"[^\W\d_]+|\d+", joint)
    short = [word for word in words if word.lower() != "joint"]
    forms = [words]
    if any(not word.isdigit() for word in short):
        forms.append(short)
    return [r"(?<![^\W_])" + r"[\W_]*".join(map(re.escape, form)) + r"(?![^\W_])" for form in forms if form]


def series_of(pattern: str) -> str:
    """Return the toolkit's series of a family or column, from the words of its name; "" if the words do not tell it."""
    text = pattern.replace(JOINT, " ").replace(NUMBER, " ")
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text)
    words = re.findall(r"[^\W\d_]+", text.lower())
    quantity = next((word for word in reversed(words) if word in QUANTITIES), "")
    if not quantity or UNREAD & set(words):
        return ""
    series = QUANTITIES[quantity]
    if FEEDFORWARD & set(words):
        return "tau_ff" if series == "torque" else ""
    if REFERENCE & set(words):
        return "q_ref" if series == "q" else ""
    for (of_series, word), special in SPECIAL.items():
        if series == of_series and word in words:
            return special
    return series


def chosen(candidates: Sequence[Family]) -> tuple[dict[str, Family], tuple[str, ...]]:
    """Return one family for each series, and patterns of families that could be meant as well.

    Families by joint names are preferred; then those of the first topic with positions and torques (or currents).

    Args:
        candidates: families in the order of the file.
    """
    by_topic: dict[str, set[str]] = {}
    for family in candidates:
        by_topic.setdefault(family.topic, set()).add(family.series)
    complete = [topic for topic, series in by_topic.items() if "q" in series and series & {"torque", "current"}]
    ordered = sorted(candidates, key=lambda family: (family.topic not in complete[:1], NUMBER in family.pattern))
    families_by_series: dict[str, Family] = {}
    rivals = []
    for family in ordered:
        first = families_by_series.setdefault(family.series, family)
        if first is not family and (NUMBER in first.pattern) == (NUMBER in family.pattern):
            rivals.append(family.pattern)
    families_by_series.pop("", None)
    return families_by_series, tuple(pattern for pattern in rivals if series_of(pattern))


def stated(value: str, header: Sequence[str], joints: Sequence[str]) -> tuple[int, ...]:
    """Return the columns that a user means by `value`, in the order of the joints; () if it is none of the families.

    Accepted are a pattern (``- {joint}_position``), the heading of any joint's column, with or without punctuation, and
    the words of a heading without the joint.

    Args:
        value: what the options state.
        header: names of the columns.
        joints: names of the robot's joints.
    """
    pattern = split_joint(value, joints)[0]
    match = _NUMBER.search(value)
    numbered = f"{value[: match.start()]}{NUMBER}{value[match.end() :]}" if match else value
    wanted_patterns = {_plain(pattern), _plain(numbered), _plain(f"{JOINT}{value}"), _plain(f"{value}{JOINT}")}
    for family in families(header, joints):
        if _plain(family.pattern) in wanted_patterns:
            return family.columns
    return ()


def _plain(pattern: str) -> str:
    """Return a pattern in small letters without punctuation, in which numbers and names of joints are alike."""
    text = pattern.replace(NUMBER, JOINT).replace(JOINT, "\0").lower()
    return re.sub(r"[^\w\0]|_", "", text)


def paste(header: Sequence[str], joints: Sequence[str], needed: Sequence[str]) -> str:
    """Return a line for the options file that names the columns of the series in `needed`; "" if none can be proposed.

    Where no columns belong together, the first columns in the file's order are proposed, joint by joint.

    Args:
        header: names of the columns that may be meant, in the file's order.
        joints: names of the robot's joints.
        needed: the toolkit's names of the series.
    """
    patterns = [family.pattern for family in families(header, joints) if not family.series]
    headings = [heading for heading in header if not heading.startswith("\0")]
    entries = []
    for series in needed:
        if patterns:
            entries.append(f'{series} = "{patterns.pop(0)}"')
        elif not entries and len(joints) and len(headings) >= len(joints) * len(needed):
            entries += _joint_by_joint(headings, len(joints), needed)
            break
    return f"columns = {{ {', '.join(entries)} }}" if entries else ""


def _joint_by_joint(headings: Sequence[str], count: int, needed: Sequence[str]) -> list[str]:
    """Return entries of the options' [columns] for each series and joint, in the order of the headings."""
    entries = []
    remaining = iter(headings)
    for series in needed:
        entries += [f'{series}{number} = "{next(remaining)}"' for number in range(1, count + 1)]
    return entries


def mapping_line(header: Sequence[str], joints: Sequence[str], columns_of: Mapping[str, Sequence[int]]) -> str:
    """Return the columns of each series in the form of the options' [columns], for the user to check.

    Args:
        header: names of the columns.
        joints: names of the robot's joints.
        columns_of: the columns of each series.
    """
    pattern_of = {family.columns: family.pattern for family in families(header, joints)}
    entries = []
    for series, columns in columns_of.items():
        names = [header[column] for column in columns]
        pattern = pattern_of.get(tuple(columns), ", ".join(names))
        entries.append(f'{series} = "{pattern}"')
    return f"columns = {{ {', '.join(entries)} }}"


def condensed(header: Sequence[str], joints: Sequence[str], columns: Sequence[int]) -> list[str]:
    """Return headings of columns for a note, with the pattern in place of the columns of a family.

    Args:
        header: names of the columns.
        joints: names of the robot's joints.
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


def near_names(value: str, header: Sequence[str], joints: Sequence[str]) -> str:
    """Return what the file has instead of `value`, for messages: the most similar pattern, then all patterns."""
    patterns = [family.pattern for family in families(header, joints)]
    listed = ", ".join(f"'{pattern}'" for pattern in patterns)
    near = suggestion(value, [*patterns, *header])
    return f"{near}; groups of columns, one per joint: {listed}" if listed else near


def joint_keys(columns: Mapping[str, str], joints: Sequence[str], table: Table) -> dict[str, dict[int, str]]:
    """Return the columns that the options state joint by joint: series → index of the joint → heading.

    A key is a series' name with the joint's number from 1 (``q1``, ``tau_2``), or a joint's name (its position).

    Args:
        columns: the options' table: key → heading.
        joints: names of the robot's joints.
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
        if key in joints:
            result.setdefault("q", {})[list(joints).index(key)] = heading
        elif match and match[1] in series_by_name:
            result.setdefault(series_by_name[match[1]], {})[int(match[2]) - 1] = heading
        else:
            expected = f"{', '.join(SYNONYMS)}, with or without a joint's number (q1, torque_2), or a joint's name"
            table.fail(f"[columns] names '{key}', which is no quantity; expected {expected}", heading)
    for series, by_joint in result.items():
        for number in range(max(len(joints), len(by_joint))):
            if number not in by_joint:
                table.fail(f"[columns] states {series} of {len(by_joint)} joints only: {series}{number + 1} is missing")
    return result

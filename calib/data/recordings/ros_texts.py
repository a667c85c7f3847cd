"""Joint states that ROS's tools print as CSV, read as the tables of `calib formats recordings` are, by every command.

=====================================  ================================================================================
``rostopic echo -b log.bag -p TOPIC``  one line of names (``%time, field.header.seq, …, field.name0, …, field.effort5``)
``ros2 topic echo --csv TOPIC``        no line of names: seconds, nanoseconds, frame, names, then the values
=====================================  ================================================================================

Both write the joints' names in every row; columns are named by them (``q_elbow``, ``v_elbow``, ``tau_elbow``), so that
the order of the message does not matter. Read are ``sensor_msgs/JointState`` and ros2_control's ``DynamicJointState``.
Messages of other joints (a gripper's) in the same file become rows without the arm's positions. Stamps are those of the
headers; where these are zero, rostopic's times of arrival.

Sources: ros_comm, tools/rostopic (`_str_plot_fields`); ros2cli, ros2topic/verb/echo.py with
rosidl_runtime_py.convert.message_to_csv (fields in their order, arrays flattened, nothing for an empty array).
"""

import csv
import re
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from itertools import takewhile
from pathlib import Path

import numpy as np

from calib.data.recordings.controller_logs import LONGEST, Log
from calib.errors import refuse_data
from calib.units import is_number

# Names of the state interfaces of ros2_control with the letters of our columns.
INTERFACES = {"position": "q", "velocity": "v", "effort": "tau"}
ROSTOPIC, ROS2 = "rostopic echo -p", "ros2 topic echo --csv"
# Cells before the joints' names: time, sequence, stamp and frame; seconds, nanoseconds and frame.
LEADING = {ROSTOPIC: 4, ROS2: 3}
# Lines at the beginning in which the form is looked for, since tools print warnings between.
FIRST_LINES = 5
# Correlation with the slope of the positions, from which on the second of two quantities is the velocity (our choice).
MIN_CORRELATION = 0.8
_HEADER = re.compile(r"%time,.*\bfield\.(joint_)?names?0\b")


@dataclass
class _Message:
    """One row: its time as text [s], the joints' names, and the values of each quantity, by the letters of our columns.

    Attributes:
        second: values of a second quantity that may be velocities or efforts; empty if it is clear.
    """

    time: str
    names: tuple[str, ...]
    values: dict[str, tuple[str, ...]] = field(default_factory=dict)
    second: tuple[str, ...] = ()


def translated(path: str | Path) -> Log | None:
    """Return joint states in the file at `path` as the text of a CSV table; None if they are not of ROS's tools.

    Raises:
        MeasurementError: rows of names without the values of a joint state.
    """
    with open(path, encoding="utf-8-sig", errors="replace", newline="") as file:
        first_lines = [file.readline(LONGEST) for _ in range(FIRST_LINES)]
        tool = _tool(first_lines)
        if not tool:
            return None
        file.seek(0)
        header: tuple[str, ...] = ()
        messages = []
        unread = 0
        for cells in filter(None, csv.reader(file)):
            if cells[0].startswith("%time"):
                header = tuple(cells)
                continue
            message = _message(cells, tool, header)
            if message is not None:
                messages.append(message)
            else:
                unread += 1
    if not messages:
        refuse_data(path, f"looks like '{tool}', but none of its {unread} rows is a joint state: is it that topic?")
    notes = [f"read as joint states of '{tool}': columns are named by the joints' names in the rows"]
    notes += _resolved(messages)
    if unread:
        notes.append(f"{unread} lines that are no joint state are not used")
    return _log(messages, notes)


def _tool(lines: list[str]) -> str:
    """Return which tool wrote a file that begins with these lines; "" for none."""
    for line in lines:
        if _HEADER.match(line):
            return ROSTOPIC
        cells = line.strip().split(",")
        stamped = len(cells) > 5 and cells[0].isdigit() and cells[1].isdigit()
        if stamped and not is_number(cells[2]) and _is_name(cells[3]) and is_number(cells[-1]):
            return ROS2
    return ""


def _is_name(cell: str) -> bool:
    return bool(cell.strip()) and not is_number(cell) and cell.strip().lower() != "nan"


def _first_names(cells: list[str]) -> tuple[str, ...]:
    """Return the names with which cells begin."""
    return tuple(map(str.strip, takewhile(_is_name, cells)))


def _message(cells: list[str], tool: str, header: tuple[str, ...]) -> _Message | None:
    """Return a row as a message; None if it is no joint state.

    Args:
        cells: the row.
        tool: the tool that wrote it.
        header: the line of names; empty without one.
    """
    leading = LEADING[tool]
    if len(cells) <= leading or not cells[0].isdigit() or not cells[1].isdigit():
        return None
    time = _time(cells, tool)
    values = cells[leading:]
    names = _first_names(values)
    interfaces = list(takewhile(lambda name: name not in INTERFACES, names))
    if len(interfaces) < len(names):
        return _dynamic(_Message(time, tuple(interfaces)), values[len(interfaces) :])
    count = len(names)
    values = values[count:]
    if not count or not values or len(values) % count:
        return None
    groups = list(zip(*[iter(values)] * count))
    message = _Message(time, names, {"q": groups[0]})
    letters = ["q", "v", "tau"]
    if len(header) == len(cells):
        letters = []
        for name, letter in INTERFACES.items():
            if f"field.{name}0" in header:
                letters.append(letter)
    if len(letters) == len(groups):
        message.values = dict(zip(letters, groups))
    elif len(groups) == 2:
        message.second = groups[1]
    elif len(groups) > 2:
        return None
    return message


def _time(cells: list[str], tool: str) -> str:
    """Return the time of a row [s] as text, without loss of digits."""
    if tool == ROS2:
        return f"{cells[0]}.{int(cells[1]):09d}"
    nanoseconds = int(cells[0])
    # the header's stamp, where it is set
    if cells[2].isdigit() and int(cells[2]):
        nanoseconds = int(cells[2])
    return f"{nanoseconds // 10**9}.{nanoseconds % 10**9:09d}"


def _dynamic(message: _Message, cells: list[str]) -> _Message | None:
    """Return a `DynamicJointState` from its cells behind the joints' names: for each joint its interfaces, then values.

    Args:
        message: the message without values.
        cells: the cells.
    """
    columns: dict[str, list[str]] = {}
    start = 0
    for _ in message.names:
        interfaces = _first_names(cells[start:])
        count = len(interfaces)
        values = cells[start + count : start + 2 * count]
        if not count or len(values) < count:
            return None
        by_interface = dict(zip(interfaces, values))
        for interface, letter in INTERFACES.items():
            cell = by_interface.get(interface, "")
            columns.setdefault(letter, []).append(cell.strip())
        start += 2 * count
    if start != len(cells):
        return None
    for letter, column in columns.items():
        if any(column):
            message.values[letter] = tuple(column)
    return message


def _resolved(messages: list[_Message]) -> list[str]:
    """Assign the second of two quantities in messages to velocity or effort, by the positions' slope; return notes."""
    by_names: dict[tuple[str, ...], list[_Message]] = {}
    for message in messages:
        if message.second:
            by_names.setdefault(message.names, []).append(message)
    notes = []
    for names, group in by_names.items():
        rows = [(message.time, *message.values["q"], *message.second) for message in group]
        numbers = np.array(rows, dtype=float)
        positions, second = np.split(numbers[:, 1:], 2, axis=1)
        letter, quantity = "tau", "efforts"
        if _is_slope(numbers[:, 0], positions, second):
            letter, quantity = "v", "velocities: they are the slope of the positions"
        for message in group:
            message.values[letter] = message.second
        notes.append(f"the second quantity of {', '.join(names)} is read as {quantity}")
    return notes


def _is_slope(t: np.ndarray, q: np.ndarray, values: np.ndarray) -> bool:
    """Return whether values (N, n) are the slope of positions q (N, n) at times t (N,), judged on all joints."""
    if len(t) < 3:
        return True
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.nan_to_num(np.diff(q, axis=0) / np.diff(t)[:, None], posinf=0.0, neginf=0.0)
    mean = np.nan_to_num((values[1:] + values[:-1]) / 2.0)
    norm = float(np.linalg.norm(slope) * np.linalg.norm(mean))
    return norm == 0.0 or float((slope * mean).sum()) > MIN_CORRELATION * norm


def _log(messages: list[_Message], notes: list[str]) -> Log:
    """Return messages as the text of a CSV table; cells of joints that a message does not contain are empty."""
    counts = Counter(message.names for message in messages)
    columns: dict[str, str] = {}
    for letter in INTERFACES.values():
        for message in messages:
            if letter in message.values:
                columns.update(dict.fromkeys(_headings(letter, message.names), ""))
    log = Log()
    writer = csv.DictWriter(log, ["t [s]", *columns], restval="")
    writer.writeheader()
    for message in messages:
        row = {"t [s]": message.time}
        for letter, values in message.values.items():
            row.update(zip(_headings(letter, message.names), values))
        writer.writerow(row)
    log.seek(0)
    if len(counts) > 1:
        numbers = [f"{count} of {', '.join(names)}" for names, count in counts.most_common()]
        notes.append(f"messages: {', '.join(numbers)}")
    log.notes = tuple(notes)
    return log


@cache
def _headings(letter: str, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the headings of a quantity's columns of joints."""
    return tuple(f"{letter}_{name}" for name in names)

"""Logs of robot controllers, read as the tables of `calib formats recordings` are, by every command.

They are known by the names of their columns, and the notes say which was recognised:

* UR: RTDE recordings, of UR's own recorder (parted by blanks) and of ur_rtde
* Franka: libfranka's ``logToCSV``, its time in ms; a time that is not in whole numbers has been converted, to seconds
* ABB: EGM as abb_libegm logs it: positions only, no torques
* KUKA: Sunrise's DataRecorder; the torques' columns are told by a word (tau, torque) in their names, else stated

Sources stand in ``logs.toml``. ROS bags, of ros2_control and franka_ros too, are read by their joint states, those of
franka_ros2 by ``FrankaRobotState``, too. No published description of the text was found for KUKA's RSI monitor and KRC
trace (``.r64`` and its exports) and FRI, ABB's Signal Analyzer and Test Signal Viewer, FANUC, Staubli and Yaskawa:
none is invented, and the general rules read them, with names and units stated in the options. Joints are as the
controller shows them: ``controller = "fanuc"`` in the options sets signs and coupled axes right.
"""

import io
import re
import tomllib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from calib.config_types import ParsedTable
from calib.files import shipped_text

# Letters of a line of names (our choice).
LONGEST = 1 << 16
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
# Rows in which a time is looked at (our choice).
TIME_ROWS = 50


class Log(io.StringIO):
    """A controller's log, rewritten as the text of a CSV table, with notes on how it was read."""

    notes: tuple[str, ...] = ()


@cache
def logs() -> dict[str, ParsedTable]:
    """Return the known logs by name, as the tables of ``logs.toml``."""
    return tomllib.loads(shipped_text("calib.data.recordings", "logs.toml"))


def translated(path: str | Path) -> Log | None:
    """Return the log at `path` as the text of a CSV table; None if it is not a known log."""
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        head = file.readline(LONGEST)
        form = _form(head)
        if form is None:
            return None
        body = file.read()
    separator = "," if "," in head else None
    file_names = [name.strip() for name in head.strip().removeprefix("%").split(separator)]
    names = [_toolkit_name(name, form["columns"]) for name in file_names]
    notes = [f"read as {form['says']}"]
    if form.get("seconds"):
        body = _with_time(body, [file_names.index(name) for name in form["seconds"]])
        names = ["t [s]", *names]
    elif form.get("whole"):
        time_column = names.index("t [ms]")
        if not _is_whole(body, separator, time_column):
            names[time_column] = "t [s]"
            notes.append("its time is not in whole milliseconds and was taken as seconds")
    header = (separator or " ").join(name.replace(" [", "[") for name in names)
    log = Log()
    log.write(f"{header}\n{body}")
    log.seek(0)
    log.notes = tuple(notes)
    return log


def with_decimal_points(path: str | Path) -> Log | None:
    """Return a table that has decimal commas, and another separator, with points instead; None for other tables."""
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        head = file.readline(LONGEST)
        while head.startswith("#") or (head and not head.strip()):
            head = file.readline(LONGEST)
        marks = [mark for mark in "\t;|" if mark in head]
        first_row = file.readline(LONGEST)
        if not marks or not first_row.strip():
            return None
        cells = first_row.strip().split(marks[0])
        with_comma = [cell for cell in cells if DECIMAL_COMMA.fullmatch(cell.strip().strip('"'))]
        if 2 * len(with_comma) <= len(cells):
            return None
        body = first_row + file.read()
    log = Log()
    log.write(head.rstrip("\r\n") + "\n" + body.replace(",", "."))
    log.seek(0)
    log.notes = ("decimal commas are read as points",)
    return log


def _form(head: str) -> ParsedTable | None:
    """Return the table in ``logs.toml`` of the known log whose files have the first line `head`; or None."""
    for form in logs().values():
        if re.search(form["header"], head):
            return form
    return None


def _toolkit_name(name: str, columns: Sequence[Sequence[str]]) -> str:
    for pattern, template in columns:
        match = re.fullmatch(pattern, name)
        if match:
            return match.expand(template)
    return name


def _is_whole(body: str, separator: str | None, column: int) -> bool:
    """Return whether a column contains only whole numbers in the first rows.

    Args:
        body: rows of the log.
        separator: separator of the cells; None: blanks.
        column: index of the column.
    """
    for line in body.split("\n", TIME_ROWS)[:TIME_ROWS]:
        row = line.split(separator) if line.strip() else []
        if len(row) > column and not re.fullmatch(r"\s*\d+(\.0*)?\s*", row[column]):
            return False
    return True


def _with_time(body: str, columns: Sequence[int]) -> str:
    """Return blank-separated rows with the time since the first row [s] prepended.

    Args:
        body: rows of the log.
        columns: indices of the columns with the time stamps' seconds and nanoseconds.
    """
    result: list[str] = []
    first_second = 0.0
    for line in body.splitlines():
        if not line.strip() or line.lstrip().startswith("%"):
            continue
        row = line.split()
        seconds, nanoseconds = (float(row[column]) if column < len(row) else float("nan") for column in columns)
        if not result:
            first_second = seconds
        result.append(f"{seconds - first_second + 1e-9 * nanoseconds:.9f} {' '.join(row)}")
    return "\n".join(result)

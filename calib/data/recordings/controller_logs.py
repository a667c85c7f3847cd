"""Logs of robot controllers, read as the tables of `calib formats recordings` are, by every command.

They are known by the names of their columns, and the notes say which was recognised:

* UR: RTDE recordings, of UR's own recorder (parted by blanks) and of ur_rtde
* Franka: libfranka's ``logToCSV``, its time in ms; a time that is not in whole numbers has been converted, to seconds
* ABB: EGM as abb_libegm logs it: positions only, no torques
* KUKA: Sunrise's DataRecorder; the name of the torques' columns has to be stated

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
from typing import Any

from calib.files import shipped_text

LONGEST = 1 << 16  # letters of a line of names (our choice)
LOOKED = 50  # rows in which a time is looked at (our choice)


class Log(io.StringIO):
    """A log as the toolkit's own table of text, with notes on how it was read."""

    notes: tuple[str, ...] = ()


@cache
def logs() -> dict[str, dict[str, Any]]:
    """Return the known logs by name."""
    return tomllib.loads(shipped_text("calib.data.recordings", "logs.toml"))


def translated(path: str | Path) -> Log | None:
    """Return the log at `path` as a table of the toolkit; None where it is none of the known ones."""
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        head = file.readline(LONGEST)
        known = next((each for each in logs().values() if re.search(each["header"], head)), None)
        if known is None:
            return None
        body = file.read()
    separator = "," if "," in head else None
    names = [name.strip() for name in head.strip().removeprefix("%").split(separator)]
    times, said = known.get("seconds"), [f"read as {known['says']}"]
    ours = [_named(name, known["columns"]) for name in names]
    if times:
        body, ours = _with_time(body, [names.index(name) for name in times]), ["t [s]", *ours]
    elif known.get("whole") and not _whole(body, separator, place := ours.index("t [ms]")):
        ours[place] = "t [s]"
        said.append("its time is not in whole milliseconds and was taken as seconds")
    found = Log()
    found.write((separator or " ").join(name.replace(" [", "[") for name in ours) + "\n" + body)
    found.seek(0)
    found.notes = tuple(said)
    return found


def _named(name: str, columns: Sequence[Sequence[str]]) -> str:
    for pattern, own in columns:
        if match := re.fullmatch(pattern, name):
            return match.expand(own)
    return name


def _whole(body: str, separator: str | None, place: int) -> bool:
    rows = (line.split(separator) for line in body.split("\n", LOOKED)[:LOOKED] if line.strip())
    return all(re.fullmatch(r"\s*\d+(\.0*)?\s*", row[place]) for row in rows if len(row) > place)


def _with_time(body: str, places: Sequence[int]) -> str:
    """Return rows parted by blanks with their time since the first [s] in front, from seconds and nanoseconds."""
    rows = [line.split() for line in body.splitlines() if line.strip() and not line.lstrip().startswith("%")]
    stamps = [[float(row[place]) if place < len(row) else float("nan") for place in places] for row in rows]
    first = stamps[0][0] if stamps else 0.0
    return "\n".join(f"{second - first + 1e-9 * nano:.9f} {' '.join(row)}" for (second, nano), row in zip(stamps, rows))

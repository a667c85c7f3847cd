"""Production logs: their dates, by the names of their files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from calib.errors import UsageError, listing, require
from calib.toolkit.recordings import parse_cut

DATE = re.compile(r"(?<!\d)(20\d\d)[-_]?(\d\d)[-_]?(\d\d)(?:[T_ -]?(\d\d)[-:_h]?(\d\d)(?:[-:_]?(\d\d))?)?")
"""Date in a file's name, with or without a time; digits inside a longer number, such as a Unix time, are none."""
SECONDS_PER_DAY = 86_400.0
EPOCH = datetime(1970, 1, 1)


@dataclass(frozen=True)
class DatedLog:
    """A log with its date.

    Attributes:
        path: the path that the user gave, with its cut.
        day: date in days since 1970-01-01; without dates, the number of the log.
        date: the date as text; empty if the name contains none.
    """

    path: str
    day: float
    date: str


def dated(paths: Sequence[str], first_number: int) -> list[DatedLog]:
    """Return logs in the order of their dates; without dates, each file counts as taken a day after the one before.

    Args:
        paths: paths of the logs, each with a cut or without.
        first_number: number of the first log, if there are no dates.

    Raises:
        UsageError: if some names contain a date and others do not.
    """
    moments = [_moment(path) for path in paths]
    undated = [path for path, moment in zip(paths, moments) if moment is None]
    message = (
        f"{len(undated)} of {len(paths)} logs have no date in their names ({listing(undated)}): name all of them like "
        "log_2026-03-14.csv, or none"
    )
    require(len(undated) in (0, len(paths)), message, UsageError)
    logs = []
    number = first_number - 1
    previous = ""
    for path, moment in zip(paths, moments):
        file, start, _ = parse_cut(path)
        if file != previous:
            number += 1
        previous = file
        seconds = start or 0.0
        day, date = float(number), ""
        if moment is not None:
            day, date = (moment - EPOCH).total_seconds() / SECONDS_PER_DAY, _text(moment)
        logs.append(DatedLog(path, day + seconds / SECONDS_PER_DAY, date))
    return sorted(logs, key=lambda log: log.day)


def _moment(path: str) -> datetime | None:
    """Return the date and time in the last part of a path that contains one; None if no part does."""
    for part in reversed(re.split(r"[/\\]", path.partition("@")[0])):
        for match in DATE.finditer(part):
            try:
                year, month, day, hour, minute, second = map(int, match.groups(default="0"))
                return datetime(year, month, day, hour, minute, second)
            except ValueError:
                continue
    return None


def _text(moment: datetime) -> str:
    if moment.hour == moment.minute == moment.second == 0:
        return f"{moment:%Y-%m-%d}"
    return f"{moment:%Y-%m-%d %H:%M}"

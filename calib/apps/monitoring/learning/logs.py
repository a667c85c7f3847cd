"""Production logs: their dates, and whether a log was learnt from before."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from calib.errors import UsageError, listing, require
from calib.toolkit.recordings import Recording, parse_cut

DATE = re.compile(r"(?<!\d)(20\d\d)[-_]?(\d\d)[-_]?(\d\d)(?:[T_ -]?(\d\d)[-:_h]?(\d\d)(?:[-:_]?(\d\d))?)?")
"""Date in a file's name, with or without a time; digits inside a longer number, such as a Unix time, are none."""
SECONDS_PER_DAY = 86_400.0
EPOCH = datetime(1970, 1, 1)
SKETCH = 64
"""Samples by which a log is recognised: those with the smallest hashes (Broder 1997)."""
MIN_COMMON = 3
"""Common samples from which on two logs share a part (our choice); samples of different logs differ."""


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


def sample_hashes(recording: Recording) -> np.ndarray:
    """Return the sorted distinct hashes (N,) of a log's samples of positions and torques, before any filter.

    The hash of a sample is a product-sum of its bits, mixed as in SplitMix64 (Steele et al. 2014).
    """
    samples = np.column_stack([recording.q, recording.effort]).astype(np.float32)
    bits = np.ascontiguousarray(samples).view(np.uint32).astype(np.uint64)
    multipliers = np.random.default_rng(0).integers(1, 2**63, bits.shape[1], dtype=np.uint64) * np.uint64(2)
    hashes = (bits * (multipliers + np.uint64(1))).sum(axis=1, dtype=np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        hashes = (hashes ^ (hashes >> np.uint64(shift))) * np.uint64(factor)
    return np.unique(hashes ^ (hashes >> np.uint64(31)))


def sketch(hashes: np.ndarray) -> np.ndarray:
    """Return the `SKETCH` smallest hashes (64,) of a log; of a shorter one, the last hash is repeated."""
    smallest = hashes[:SKETCH]
    padding = np.repeat(smallest[-1:], SKETCH - len(smallest))
    return np.concatenate([smallest, padding])


def common_share(hashes: np.ndarray, earlier: np.ndarray) -> float:
    """Return the share of an earlier log's samples that a log contains; 0 where fewer than `MIN_COMMON` are equal.

    Args:
        hashes: hashes (N,) of the log.
        earlier: (64,) sketch of the earlier log.
    """
    distinct = np.unique(earlier)
    count = int(np.isin(distinct, hashes).sum())
    if count < MIN_COMMON:
        return 0.0
    return count / len(distinct)

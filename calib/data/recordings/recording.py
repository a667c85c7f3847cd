"""Recording of a motion by a controller: one frozen dataclass per file, independent of the robot."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from calib.data.recordings.column_faults import ColumnFault
from calib.errors import MeasurementError, UsageError, one_of, refuse_data, refuse_option, refused_as
from calib.records import frozen, interpolated

KINDS = ("torque", "current")
SERIES = ("q", "v", "effort", "tau_link", "tau_motor", "q_link", "q_ref", "tau_ff")
# Series that may come late: they have a path of their own to the log.
LATE = ("effort", "tau_link", "tau_motor")
Ends = tuple[float | None, float | None]
# Pieces of a recording of which not all is used (our choice).
PIECES = 20
# A recording longer than the largest number of samples by no more than this is used whole.
MAX_EXCESS = 1.25
# Tolerance of a cut [s].
TOLERANCE = 1e-9
_CUT = re.compile(r"^(?P<file>.+)@(?P<start>[^@:/\\]*):(?P<stop>[^@:/\\]*)$")


@dataclass(frozen=True, eq=False)
class Recording:
    """Logged samples from one file: N samples of n joints.

    Attributes:
        t: (N,) time since the file's first sample [s], strictly increasing, not necessarily uniform. In a part that was
            cut out, times still count from the file's first sample.
        q: (N, n) joint positions on the motor side of an elastic joint [rad or m].
        effort: (N, n) torques on the joint side [N·m or N], or motor currents [A].
        kind: kind of `effort`, ``torque`` or ``current``.
        joint_names: n names.
        v: (N, n) measured velocities [rad/s or m/s]; None if not recorded.
        tau_link: (N, n) second torque, from sensors after the gear [N·m or N]; None if not recorded.
        tau_motor: (N, n) torque on the motor side of the gear, as recorded [N·m]; None if not recorded.
        q_link: (N, n) positions from second encoders, after the gear [rad or m]; NaN in the columns of joints without
            one; None if no joint has one.
        q_ref: (N, n) reference positions [rad or m]; None if not recorded.
        tau_ff: (N, n) feedforward torque added by the controller [N·m or N]; None if not recorded.
        drive_gain: (n,) torque per current from the file [N·m/A or N/A]; None if the file has none.
        effort_variance: (n,) mean variance of the effort's samples, from repeats [the effort's unit²]; None if not
            known.
        file: path of the file.
        rows: (N,) number of each sample in the file, counted from 1.
        notes: remarks on unusual values that were accepted, for messages.
        jumps: descriptions of position jumps.
        faults: columns that are constant although the measured quantity changes.
        breaks: times of the last samples before intended breaks, such as those between a data set's episodes [s].
    """

    t: np.ndarray
    q: np.ndarray
    effort: np.ndarray
    kind: str
    joint_names: tuple[str, ...]
    v: np.ndarray | None = None
    tau_link: np.ndarray | None = None
    tau_motor: np.ndarray | None = None
    q_link: np.ndarray | None = None
    q_ref: np.ndarray | None = None
    tau_ff: np.ndarray | None = None
    drive_gain: np.ndarray | None = None
    effort_variance: np.ndarray | None = None
    file: str = ""
    rows: np.ndarray = None  # ty: ignore[invalid-assignment]  # set below
    notes: tuple[str, ...] = ()
    jumps: tuple[str, ...] = ()
    faults: tuple[ColumnFault, ...] = ()
    breaks: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        one_of(self.kind, KINDS, "kind", MeasurementError, self.file)
        shape = (len(self.t), len(self.joint_names))
        for name in SERIES:
            value = getattr(self, name)
            if value is not None:
                value = settled(value)
                object.__setattr__(self, name, value)
                if value.shape != shape:
                    refuse_data(self.file, f"{name} has shape {value.shape}, expected {shape} (samples, joints)")
        object.__setattr__(self, "t", settled(self.t))
        object.__setattr__(self, "joint_names", tuple(self.joint_names))
        rows = np.arange(1, shape[0] + 1) if self.rows is None else self.rows
        object.__setattr__(self, "rows", frozen(rows, int))
        for name in ("drive_gain", "effort_variance"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, frozen(value))

    @staticmethod
    def of(
        t: ArrayLike,
        q: ArrayLike,
        tau: ArrayLike,
        *,
        kind: str = "torque",
        joint_names: Sequence[str] = (),
        **fields: Any,
    ) -> Recording:
        """Return a recording from arrays.

        Args:
            t: (N,) time stamps [s].
            q: (N, n) positions [rad or m].
            tau: (N, n) torques [N m or N], or currents [A].
            kind: kind of `tau`, ``torque`` or ``current``.
            joint_names: n names; q1 to qn by default.
            fields: other fields: ``v``, ``tau_link``, ``q_ref``, ….

        Raises:
            MeasurementError: inconsistent shapes.
        """
        q = np.asarray(q, dtype=float)
        names = named(joint_names, q.shape[1])
        return Recording(np.asarray(t), q, np.asarray(tau), kind, names, **fields)

    def __len__(self) -> int:
        return len(self.t)

    @property
    def n(self) -> int:
        """The number of joints."""
        return self.q.shape[1]

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.t[-1] - self.t[0]) if len(self) else 0.0

    def cut(self, start: float | None = None, stop: float | None = None) -> Recording:
        """Return the recording of the samples with start ≤ t < stop [s]; None: no bound at that end.

        Args:
            start, stop: begin and end of the part [s], counted from the file's first sample.

        Raises:
            MeasurementError: no sample is in the interval.
        """
        return self.take(rows_of_cut(self.t, start, stop, self.file))

    def take(self, index: slice | np.ndarray) -> Recording:
        """Return the recording of the samples at `index`, with their times and row numbers.

        Args:
            index: a slice, indices, or a mask (N,).
        """
        series: dict[str, object] = {}
        for name in SERIES:
            values = getattr(self, name)
            series[name] = None if values is None else values[index]
        return replace(self, t=self.t[index], rows=self.rows[index], **series)


def rows_in_pieces(t: np.ndarray, first: int, stop: int, max_samples: int | None) -> tuple[np.ndarray, list[str]]:
    """Return the indices of the rows to use among the rows `first` to `stop`, and notes on the choice.

    These are all rows, or `max_samples` rows in pieces. Each of `PIECES` equal parts contributes one piece at a random
    position, so that the pieces cover the whole time and are not periodic like the motion. All rows are used if there
    are at most a quarter more than `max_samples`. All are used too if the time stamps t (N,) run backwards, since a
    later check then refuses them with advice on where to cut.

    Args:
        t: (N,) time stamps of the whole file [s].
        first, stop: index of the first row, and of the row after the last one.
        max_samples: largest number of rows; None: no limit.
    """
    count = stop - first
    if max_samples is None or count <= MAX_EXCESS * max_samples:
        return np.arange(first, stop), []
    length = max_samples // PIECES
    edges = np.linspace(first, stop, PIECES + 1).astype(int)
    free_rows = np.diff(edges) - length
    starts = edges[:-1] + np.random.default_rng(0).integers(free_rows + 1)
    rows = (starts[:, None] + np.arange(length)).ravel()
    if (np.diff(t[rows]) < 0).any():
        return np.arange(first, stop), []
    note = (
        f"{PIECES * length} of {count} samples are used, in {PIECES} pieces spread over the recording "
        "([recording] samples = … for more)"
    )
    return rows, [note]


def rows_used(t: np.ndarray, ends: Ends, max_samples: int | None, file: str | Path) -> tuple[np.ndarray, list[str]]:
    """Return the indices of a file's rows within a cut, at most `max_samples` of them in pieces, and notes.

    Args:
        t: (N,) time stamps [s].
        ends: begin and end of the cut [s]; None: no bound.
        max_samples: largest number of rows; None: no limit.
        file: the file, for messages.
    """
    cut = slice(0, len(t))
    if ends != (None, None):
        # Time that runs back is refused later.
        ordered = np.maximum.accumulate(np.nan_to_num(t, nan=-np.inf))
        cut = rows_of_cut(ordered, *ends, file)
    return rows_in_pieces(t, cut.start, cut.stop, max_samples)


def in_pieces(recording: Recording, max_samples: int | None) -> Recording:
    """Return the recording, or, if it has more than `max_samples` samples, pieces spread over it (`rows_in_pieces`).

    Args:
        recording: the recording.
        max_samples: largest number of samples; None: no limit.
    """
    rows, notes = rows_in_pieces(recording.t, 0, len(recording), max_samples)
    if not notes:
        return recording
    return replace(recording.take(rows), notes=(*recording.notes, *notes))


def settled(values: np.ndarray) -> np.ndarray:
    """Return `values` itself if it is a read-only float array, else a read-only copy.

    This avoids copies of large logs.
    """
    owner = values
    if isinstance(values, np.ndarray) and values.base is not None:
        owner = values.base
    is_fixed = isinstance(owner, np.ndarray) and not owner.flags.writeable and values.dtype == float
    return values if is_fixed else frozen(values)


def earlier(recording: Recording, lag: float) -> Recording:
    """Return the recording with torques and currents shifted `lag` [s] earlier, to the time of the positions.

    Samples for which there is no torque are removed.

    Args:
        recording: the recording.
        lag: delay of the torques behind the positions of the same row [s].

    Raises:
        MeasurementError: no sample remains.
    """
    if not lag:
        return recording
    t = recording.t + lag
    covered = np.zeros(0, bool)
    if len(t):
        covered = (t >= recording.t[0]) & (t <= recording.t[-1])
    if not covered.any():
        refuse_data(
            recording.file,
            f"a lag of {lag:g} s leaves no sample of a recording of {recording.duration:.3g} s: is it in s?",
        )
    shifted: dict[str, object] = {}
    for name in LATE:
        values = getattr(recording, name)
        if values is not None:
            shifted[name] = interpolated(t, recording.t, values)
    notes = (*recording.notes, f"torques are shifted {1e3 * lag:g} ms earlier, as the option lag states")
    return replace(recording, notes=notes, **shifted).take(covered)


def rows_of_cut(t: np.ndarray, start: float | None, stop: float | None, file: str | Path) -> slice:
    """Return the slice of samples with start ≤ t < stop (tolerance 1 ns).

    Args:
        t: (N,) time stamps [s], increasing.
        start, stop: begin and end [s]; None: no bound.
        file: the file, for messages.

    Raises:
        MeasurementError: the slice is empty.
    """
    first, end = 0, len(t)
    low = high = ""
    if start is not None:
        first = int(np.searchsorted(t, start - TOLERANCE))
        low = f"{start:g}"
    if stop is not None:
        end = int(np.searchsorted(t, stop - TOLERANCE))
        high = f"{stop:g}"
    if first >= end:
        last = f"{t[-1]:.4g} s" if len(t) else "nothing"
        refuse_data(file, f"the cut @{low}:{high} leaves no sample; the recording ends at {last}")
    return slice(first, end)


def parse_cut(text: str) -> tuple[str, float | None, float | None]:
    """Return file, start and stop [s] from a text such as ``log.npz@0:9.4``; None for an absent end (``log.npz@2:``).

    Seconds count from the file's first sample. A text without ``@`` is a file without a cut.

    Raises:
        UsageError: the cut does not consist of two times, or contains no time.
    """
    match = _CUT.match(text)
    if match is None:
        return text, None, None
    ends: list[float | None] = []
    for part in (match["start"], match["stop"]):
        message = f"{text}: '{part}' is not a time in seconds; to use a part of a recording, write log.npz@0:9.4"
        with refused_as(UsageError, ValueError, message):
            ends.append(float(part) if part.strip() else None)
    start, stop = ends
    if start is not None and start < 0.0:
        refuse_option(text, f"the cut starts at {start:g} s, before the recording; seconds count from its start")
    if start is not None and stop is not None and not start < stop:
        refuse_option(text, f"the cut ends at {stop:g} s, before it starts at {start:g} s")
    return match["file"], start, stop


def named(names: Sequence[str], n: int) -> tuple[str, ...]:
    """Return `names`, or q1 … qn if `names` is empty."""
    if len(names):
        return tuple(names)
    return tuple(f"q{j + 1}" for j in range(n))

"""Recordings resampled to an even grid: samples are dated, short gaps bridged, long gaps kept, all of it reported.

Stamps do not always state when a sample was taken.

A controller samples evenly; a program that logs it wakes up unevenly, misses samples and reads some twice. Stamps put
on by the logger then move every sample by v·δt, which two derivatives make into false accelerations, and a joint that
seems noisy is only badly dated. Three clocks are tried; the one with the smoothest positions is used:

``stamps``  the stamps as recorded;
``even``    one step, samples lost where a stamp is late by whole steps, a slow drift followed: a lattice with holes
            (`calib.data.signals.lattice`), or, of stamps that jitter by more, whole steps by which they stay late;
``counted`` the number of steps between two samples from the motion itself, Δk = Δq·v̄ / (T |v̄|²), where that is whole
            numbers (v̄ the mean of the two measured velocities); zero is a sample read twice, which is left out.

The measure is the rms of the fourth differences of q on the even grid. Counted steps are as long as the measured
velocities say, unless the stamps say otherwise by more than `APART`: then one of the two is of another size, nobody
knows which, the stamps' rate is kept, and that the velocities are no slopes is seen later. All of this is our choice.
Seen in real logs: the Panda's is counted (6 % read twice, 7 % missed), the LWR4+'s and TIAGo's are even, the UR10e's
stamps are true.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d

from calib.data.recordings.recording import SERIES, Recording, settled
from calib.data.signals.lattice import find_lattice
from calib.errors import UsageError, refuse_data, require
from calib.records import frozen, read_only

GAP = 0.05  # the longest time without a sample that is bridged [s]; our choice
CLOCKS = ("stamps", "even", "counted")
MAX_REPEATS = 3  # rows in a row that repeat a sample of a moving robot; more are one that stands (our choice)
APART = 0.01  # share by which the rates of stamps and velocities may differ


@dataclass(frozen=True, eq=False)
class Clock:
    """Times at which the samples of a recording were taken.

    Attributes:
        kind: one of `CLOCKS`.
        t: (N,) [s]; those of kept samples rise strictly.
        keep: (N,) mask; False where a sample was read a second time.
        period: of one step [s].
        times: the step by the measured velocities over that by the stamps; NaN where steps are not counted.
        roughness: clock → rms of the fourth differences of q under it, relative to that under the stamps.
    """

    kind: str
    t: np.ndarray
    keep: np.ndarray
    period: float
    times: float
    roughness: dict[str, float]


def find_clock(recording: Recording, kind: str = "auto") -> Clock:
    """Return the clock `kind`; with ``auto`` the clock with the smoothest positions.

    Raises:
        UsageError: for an unknown clock, or one that this recording does not allow.
    """
    require(kind in ("auto", *CLOCKS), f"clock: expected one of auto, {', '.join(CLOCKS)}, found '{kind}'", UsageError)
    fresh = ~_read_twice(recording)
    clocks = {"stamps": (recording.t, fresh, _step(recording.t[fresh]))}
    if (even := _even_times(recording.t[fresh])) is not None:
        dates = np.array(recording.t)
        dates[fresh] = even[0]
        clocks["even"] = (dates, fresh, even[1])
    times = np.nan
    if (counted := _counted_times(recording, kind == "counted")) is not None:
        clocks["counted"], times = counted[:3], counted[3]
    if kind != "auto" and kind not in clocks:
        raise UsageError(f"clock '{kind}': cannot date the samples of {recording.file or 'this recording'}")
    steps = {name: _roughness(recording.q, *clock) for name, clock in clocks.items()}
    rough = {name: value / max(steps["stamps"], 1e-300) for name, value in steps.items()}
    best = min(rough, key=lambda name: rough[name])
    max_roughness = 0.8  # another clock than the stamps' must bring the roughness below this share
    chosen = kind if kind != "auto" else best if rough[best] < max_roughness else "stamps"
    t, keep, period = clocks[chosen]
    return Clock(chosen, frozen(t), frozen(keep, bool), period, times, rough)


def _read_twice(recording: Recording) -> np.ndarray:
    """Return the mask (N,) of rows that repeat the row before, in positions and torques, while the robot moves.

    Such a row is the last sample read once more, since the next one is late. Rows of a robot that stands may well be
    equal: only short runs count, between rows whose positions differ.
    """
    moved = np.asarray(np.diff(recording.q, axis=0).any(axis=1))
    same = ~moved & ~np.asarray(np.diff(recording.effort, axis=0).any(axis=1))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]])))
    twice = np.zeros(len(recording), dtype=bool)
    for first, end in edges.reshape(-1, 2).tolist():
        inner = first > 0 and end < len(same)
        if inner and end - first <= MAX_REPEATS and moved[first - 1] and moved[end]:
            twice[first + 1 : end + 1] = True
    return twice


def _even_times(t: np.ndarray, drift_samples: int = 101) -> tuple[np.ndarray, float] | None:
    """Return even times k T + drift (N,), k counting lost samples, and T [s]; None if uneven.

    `drift_samples`: samples over which a drift of the stamps is followed.
    """
    lattice = find_lattice(t, drift_samples)
    if lattice is None:
        # stamps that jitter by more than that show lost samples only where all later ones stay late
        k = np.arange(len(t)) + np.concatenate([[0], np.cumsum(_lost(t, _step(t)))])
    else:
        k = lattice.steps
    period, start = np.polyfit(k, t, 1)
    late = t - (start + period * k)
    even = start + period * k + uniform_filter1d(late, drift_samples, mode="nearest")
    if not (np.diff(even) > 0.5 * period).all():
        return None
    return even, float(period)


def _counted_times(recording: Recording, asked: bool) -> tuple[np.ndarray, np.ndarray, float, float] | None:
    """Return counted times (N,), the mask of samples not read twice, the step [s], and the step by velocities over that
    by the stamps; None if steps are not whole.

    Where the robot is too slow to count, a repeated row counts zero, any other one; a wrong count there does little,
    since a date's error acts through the speed. Long stops of the log (more than 20 steps) are dated by the stamps.

    Args:
        asked: whether this clock was asked for: steps are then as long as the velocities say, whatever the stamps do.
    """
    if recording.v is None:
        return None
    dq, mean = np.diff(recording.q, axis=0), (recording.v[1:] + recording.v[:-1]) / 2
    speed = (mean**2).sum(axis=1)
    elapsed = (dq * mean).sum(axis=1) / np.maximum(speed, 1e-300)  # [s], by the motion
    fast = speed > 0.05 * np.quantile(speed, 0.95)
    moved = fast & (elapsed > 0.2 * _step(recording.t))
    min_fast_share = 0.3  # share of the steps at a speed at which they can be counted
    if fast.mean() < min_fast_share or not moved.any():
        return None
    count = np.round(elapsed / np.median(elapsed[moved]))
    period = float((elapsed * speed)[moved].sum() / (count * speed)[moved].sum())
    same = (dq == 0).all(axis=1) & (np.diff(recording.effort, axis=0) == 0).all(axis=1)
    off = np.sqrt(np.mean((elapsed[fast] / period - count[fast]) ** 2))
    max_rounding = 0.1  # rms distance of the counted steps from whole numbers
    if off > max_rounding or (count[fast] < 0).any() or ((count == 0) & fast & dq.any(axis=1)).any():
        return None
    step = np.diff(recording.t)
    seen = fast & (step < 20 * np.median(step))
    times = period * float(count[seen].sum()) / float(step[seen].sum())
    if not asked and abs(times - 1.0) > APART:
        period /= times
    stamped = np.round(step / period)
    count = np.where(fast, count, np.where(same, 0, 1))
    count = np.where(stamped > 20, np.maximum(stamped, 1), count)
    t = np.concatenate([[0], np.cumsum(count)]) * period
    return t + np.median(recording.t - t), np.concatenate([[True], count > 0]), period, times


def _lost(t: np.ndarray, step: float, late_samples: int = 15) -> np.ndarray:
    """Return the number of samples missing in each step (N - 1,): whole steps by which later stamps stay late.

    `late_samples`: samples over which it is judged whether the stamps stay late.
    """
    lost, late = np.zeros(len(t) - 1), t - step * np.arange(len(t))
    for i in np.flatnonzero(np.diff(t) > 1.5 * step) + 1:
        after, before = late[i : i + late_samples], late[max(0, i - late_samples) : i]
        lost[i - 1] = max(0.0, np.round((np.median(after) - np.median(before)) / step))
    return lost


def _step(t: np.ndarray) -> float:
    """Return the step of stamps (N,) [s]: the median of steps, or their mean if they differ only by rounding.

    Rounding errors of a median add up along a grid: a thousandth of a step in half an hour at 1 kHz.
    """
    step = np.diff(t)
    median = float(np.median(step))
    single = step[step < 1.5 * median]
    return float(single.mean()) if np.abs(single - median).max() < 1e-6 * median else median


def _roughness(q: np.ndarray, t: np.ndarray, keep: np.ndarray, period: float, max_samples: int = 20_000) -> float:
    """Return the median over the joints of the rms fourth difference of q on an even grid [rad or m].

    `max_samples`: samples that are compared.
    """
    t, q = t[keep][:max_samples], q[keep][:max_samples]
    grid = t[0] + period * np.arange(min(2 * len(t), int(np.ceil((t[-1] - t[0]) / period))))  # a gap may be of weeks
    fourth = np.diff(CubicSpline(t, q)(grid), 4, axis=0)
    near = np.searchsorted(t, grid[2:-2])  # a bridged gap says nothing
    measured = np.diff(t)[np.clip(near, 1, len(t) - 1) - 1] < 1.5 * period
    moving = np.ptp(q, axis=0) > 0
    if not moving.any() or not measured.any():
        return 0.0
    return float(np.median(np.sqrt(np.mean(fourth[measured][:, moving] ** 2, axis=0))))


@dataclass(frozen=True)
class SamplingReport:
    """Quality of a recording's time stamps.

    Attributes:
        clock: the clock used.
        jitter: rms and largest distance of the stamps' steps from whole numbers of periods [s].
        repeated: samples read twice, left out.
        lost: samples missing between others, interpolated.
        gaps: (start, length) [s] of the times without a sample that were too long to bridge, where segments end.
        dropped: (start, length) [s] of segments too short to use.
    """

    clock: Clock
    rate: float
    jitter: tuple[float, float]
    repeated: int
    lost: int
    gaps: tuple[tuple[float, float], ...]
    dropped: tuple[tuple[float, float], ...]

    def lines(self) -> list[str]:
        """Return notes on the sampling for the user, one finding per line."""
        lines = [f"{self.rate:.6g} Hz; jitter of the stamps: {self.jitter[0] * 1e3:.3g} ms rms"]
        lines[0] += f", {self.jitter[1] * 1e3:.3g} ms at most"
        kind, times = self.clock.kind, self.clock.times
        if kind != "stamps":
            share = self.clock.roughness[kind]
            lines.append(f"samples are dated by the clock '{kind}': positions are {1 / share:.3g} times smoother")
        if kind == "counted" and abs(times - 1.0) > APART:
            lines.append(f"step from measured velocities / step from stamps: {times:.4g}")
        if self.repeated:
            lines.append(f"{self.repeated} samples were read twice; the second one is not used")
        if self.lost:
            lines.append(f"{self.lost} samples are missing in short gaps; interpolated with weight 0")
        if len(self.gaps) > 3:
            lines.append(f"{len(self.gaps)} gaps of up to {max(gap for _, gap in self.gaps):.3g} s: recording split")
        else:
            lines += [f"gap of {length:.3g} s at {start:.6g} s: recording split" for start, length in self.gaps]
        lines += [
            f"{length:.3g} s at {start:.6g} s between gaps: too short, not used" for start, length in self.dropped
        ]
        return lines


@dataclass(frozen=True, eq=False)
class Resampled:
    """A recording resampled to an even grid.

    Attributes:
        t: (N,) [s]; within a segment in steps of 1/rate.
        series: name (`calib.data.recordings.recording.SERIES`) → (N, n), in the recording's units.
        weight: (N,) 1 at a sample, 0 at a bridged one.
        segment: (N,) number of the segment, rising.
        rate: [Hz].
        report: what was found.
    """

    t: np.ndarray
    series: dict[str, np.ndarray]
    weight: np.ndarray
    segment: np.ndarray
    rate: float
    report: SamplingReport


def resample(recording: Recording, clock: str = "auto", gap: float = GAP, rate: float | None = None) -> Resampled:
    """Return `recording` on an even grid, interpolated by cubic splines (exact where a sample lies on the grid).

    Args:
        clock: ``auto`` or one of `calib.data.signals.resampling.CLOCKS`.
        gap: the longest time without a sample that is bridged [s], at least 5 periods.
        rate: of the grid [Hz]; None for the recording's own. A lower one is not protected against aliasing.

    Raises:
        MeasurementError: where no segment is long enough.
    """
    found = find_clock(recording, clock)
    t, period = found.t[found.keep], found.period if rate is None else 1 / rate
    step = np.diff(t)
    long = step > max(gap, 5 * found.period)
    edges = np.concatenate([[0], np.flatnonzero(long) + 1, [len(t)]])
    spans = list(pairwise(edges))
    min_samples = 20  # samples of a segment that is kept: a filter needs them to begin and to end
    used = [(a, b) for a, b in spans if b - a > min_samples and (t[b - 1] - t[a]) / period > min_samples]
    if not used:
        message = f"has gaps: none of its {len(spans)} parts is longer than {min_samples} samples"
        refuse_data(recording.file, message)
    grids = [t[a] + period * np.arange(int((t[b - 1] - t[a]) / period + 1e-6) + 1) for a, b in used]
    weight = [_weight(t[a:b], grid, found.period) for (a, b), grid in zip(used, grids)]
    steps = np.diff(recording.t) / found.period
    off = (steps - np.maximum(np.round(steps), 1)) * found.period
    report = SamplingReport(
        found,
        1 / period,
        (float(np.sqrt(np.mean(off[steps < 20] ** 2))), float(np.abs(off).max())),
        int((~found.keep).sum()),
        int(np.maximum(np.round(step[~long] / found.period) - 1, 0).sum()),
        tuple((float(t[i]), float(step[i])) for i in np.flatnonzero(long)),
        tuple((float(t[a]), float(t[b - 1] - t[a])) for a, b in spans if (a, b) not in used),
    )
    return Resampled(
        frozen(np.concatenate(grids)),
        {
            name: _interpolate(value if found.keep.all() else value[found.keep], t, used, grids)
            for name in SERIES
            if (value := getattr(recording, name)) is not None
        },
        frozen(np.concatenate(weight)),
        frozen(np.concatenate([np.full(len(grid), i) for i, grid in enumerate(grids)]), int),
        1 / period,
        report,
    )


def _interpolate(values: np.ndarray, t: np.ndarray, used: list[tuple[int, int]], grids: list[np.ndarray]) -> np.ndarray:
    """Return `values` (N, n) interpolated on the grids, joint by joint (1 h at 1 kHz: 0.2 GB besides the result)."""
    on_grid = [_on_grid(t[a:b], grid) for (a, b), grid in zip(used, grids)]
    if used == [(0, len(values))] and on_grid[0]:
        return settled(values)
    out = np.empty((sum(len(grid) for grid in grids), values.shape[1]))
    place = 0
    for (a, b), grid, same in zip(used, grids, on_grid):
        for j in range(values.shape[1]):
            own = values[a:b, j]
            finite = np.isfinite(own).all()  # q_link of a joint without a second encoder is not
            new = own if same else CubicSpline(t[a:b], own)(grid) if finite else np.full(len(grid), np.nan)
            out[place : place + len(grid), j] = new
        place += len(grid)
    return read_only(out)


def _on_grid(t: np.ndarray, grid: np.ndarray) -> bool:
    """Return whether the sample times equal the grid."""
    return len(t) == len(grid) and bool(np.abs(grid - t).max() < 1e-6 * (grid[1] - grid[0]))


def _weight(t: np.ndarray, grid: np.ndarray, period: float) -> np.ndarray:
    """Return the weight of each grid time: 1 if a sample is within 0.75 periods, else 0."""
    after = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    distance = np.minimum(np.abs(grid - t[after - 1]), np.abs(t[after] - grid))
    return (distance < 0.75 * period).astype(float)

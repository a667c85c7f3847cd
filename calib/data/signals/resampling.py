"""A log on an even grid: samples dated, short gaps bridged, long ones left open, all of it counted."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline

from calib.arrays import frozen
from calib.data.recordings.clock import APART, find_clock
from calib.data.recordings.recording import SERIES, Recording, settled
from calib.errors import refuse_data

GAP = 0.05  # the longest time without a sample that is bridged [s]; our choice


@dataclass(frozen=True)
class SamplingReport:
    """What the time stamps of a recording were like.

    Attributes:
        clock: which dating was used (`calib.data.recordings.clock`), roughness: what spoke for it.
        rate: of the even grid [Hz].
        jitter: rms and largest distance of the stamps' steps from whole numbers of periods [s].
        repeated: samples read twice, left out.
        lost: samples missing between others, interpolated.
        gaps: (start, length) [s] of the times without a sample that were too long to bridge, where segments end.
        dropped: (start, length) [s] of segments too short to use.
        times: a counted step by the measured velocities over that by the stamps; NaN where steps are not counted.
    """

    clock: str
    roughness: dict[str, float]
    rate: float
    jitter: tuple[float, float]
    repeated: int
    lost: int
    gaps: tuple[tuple[float, float], ...]
    dropped: tuple[tuple[float, float], ...]
    times: float = np.nan

    def lines(self) -> list[str]:
        """Return notes for the user, one finding per line."""
        told = [f"{self.rate:.6g} Hz; the stamps' steps jitter by {self.jitter[0] * 1e3:.3g} ms rms"]
        told[0] += f", {self.jitter[1] * 1e3:.3g} ms at most"
        if self.clock != "stamps":
            share = self.roughness[self.clock]
            told.append(f"samples dated {self.clock}, not by their stamps: positions {1 / share:.3g} times smoother")
        if self.clock == "counted" and abs(self.times - 1.0) > APART:
            told.append(f"a step is {self.times:.4g} times as long by the measured velocities as by the stamps")
        if self.repeated:
            told.append(f"{self.repeated} samples were read twice; the second is left out")
        if self.lost:
            told.append(f"{self.lost} samples are missing one by one or a few at a time; interpolated, with weight 0")
        told += [f"gap of {length:.3g} s at {start:.6g} s: split there" for start, length in self.gaps]
        told += [
            f"{length:.3g} s at {start:.6g} s between gaps are too short; left out" for start, length in self.dropped
        ]
        return told


@dataclass(frozen=True, eq=False)
class Resampled:
    """A recording on an even grid.

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
        clock: ``auto`` or one of `calib.data.recordings.clock.CLOCKS`.
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
    min_samples = 50  # samples of a segment that is kept
    used = [(a, b) for a, b in spans if b - a > min_samples and (t[b - 1] - t[a]) / period > min_samples]
    if not used:
        message = f"falls into {len(spans)} parts by gaps in time, none longer than {min_samples} samples"
        refuse_data(recording.file, message)
    grids = [t[a] + period * np.arange(int((t[b - 1] - t[a]) / period + 1e-6) + 1) for a, b in used]
    weight = [_weight(t[a:b], grid, found.period) for (a, b), grid in zip(used, grids)]
    steps = np.diff(recording.t) / found.period
    off = (steps - np.maximum(np.round(steps), 1)) * found.period
    report = SamplingReport(
        found.kind,
        found.roughness,
        1 / period,
        (float(np.sqrt(np.mean(off[steps < 20] ** 2))), float(np.abs(off).max())),
        int((~found.keep).sum()),
        int(np.maximum(np.round(step[~long] / found.period) - 1, 0).sum()),
        tuple((float(t[i]), float(step[i])) for i in np.flatnonzero(long)),
        tuple((float(t[a]), float(t[b - 1] - t[a])) for a, b in spans if (a, b) not in used),
        found.times,
    )
    return Resampled(
        frozen(np.concatenate(grids)),
        {
            name: _interpolate(value if found.keep.all() else value[found.keep], t, used, grids)
            for name, value in _present(recording)
        },
        frozen(np.concatenate(weight)),
        frozen(np.concatenate([np.full(len(grid), i) for i, grid in enumerate(grids)]), int),
        1 / period,
        report,
    )


def _present(recording: Recording) -> list[tuple[str, np.ndarray]]:
    return [(name, value) for name in SERIES if (value := getattr(recording, name)) is not None]


def _interpolate(values: np.ndarray, t: np.ndarray, used: list[tuple[int, int]], grids: list[np.ndarray]) -> np.ndarray:
    """Return `values` (N, n) on the grids; joint by joint, so that an hour at 1 kHz needs 0.2 GB beside the result."""
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
    out.flags.writeable = False
    return out


def _on_grid(t: np.ndarray, grid: np.ndarray) -> bool:
    """Say whether the samples lie on the grid as they are."""
    return len(t) == len(grid) and bool(np.abs(grid - t).max() < 1e-6 * (grid[1] - grid[0]))


def _weight(t: np.ndarray, grid: np.ndarray, period: float) -> np.ndarray:
    """Return 1 where a sample lies within 0.75 periods of the grid's time, else 0."""
    after = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    distance = np.minimum(np.abs(grid - t[after - 1]), np.abs(t[after] - grid))
    return (distance < 0.75 * period).astype(float)

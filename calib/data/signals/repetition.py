"""Repetition of a motion within and between recordings.

Robots are excited by periods of one motion. A time block of a later period tests nothing, since the same states were
fitted in an earlier one: errors of the model that the motion repeats would be fitted there, too. A course is the part
of the recordings in which the motion is new; every repetition is mapped to it.

A lag at which a recording may repeat another (or itself) is a minimum of

    D(L) = Σ ‖z(t + L) - z'(t)‖² / Σ (‖z(t + L) - z̄‖² + ‖z'(t) - z̄'‖²)

with z the positions over their standard deviations, sums over the overlap, computed by FFT. A sample repeats another if
all positions differ by less than `MAX_DISTANCE` in the rms. Thresholds are our choice.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.spatial import KDTree

from calib.data.signals.motion import Motion
from calib.data.signals.persistency import MAX_DISTANCE, MIN_TRAVEL
from calib.records import evenly

# rate at which lags are searched [Hz]
RATE = 100.0
# largest number of samples that are read of a recording
MAX_SAMPLES = 100_000
# largest D(L) of a lag that is tested: 1 on average for unlike motion
MAX_UNLIKENESS = 0.7
# D(L) up to which a motion is in its own neighbourhood
NEIGHBOURHOOD = 0.2
# difference of D(L) within which lags are about as good
TIE = 0.1
# largest number of lags that are tested
MAX_LAGS = 12
# distance to a lag between recordings within which a better one is searched, in read samples
REACH = 128
# number of positions of a recording that are searched in the others, and the radius there, over `MAX_DISTANCE`
PROBES, RADIUS = 60, 1.25
# share of these that another recording has to contain, over `MIN_SHARE`: few positions tell a share only roughly
MET_SHARE = 0.8
# share of the moving samples that a repetition has to contain
MIN_SHARE = 0.25
# share of the moving samples of the overlap that has to be alike
MIN_ALIKE = 0.5
# share of the moving samples that a repetition contains where no other lag is tested
ENOUGH = 0.9


@dataclass(frozen=True, eq=False)
class Course:
    """Recordings mapped to the part of them in which the motion is new.

    Attributes:
        course_index: for each recording, the number (N,) of each sample along the course.
        fresh: for each recording, whether the motion is new at its samples (N,).
        recording: (K,) for each of these numbers, the recording in which the motion is new.
    """

    course_index: tuple[np.ndarray, ...]
    fresh: tuple[np.ndarray, ...]
    recording: np.ndarray

    @classmethod
    def without_repetition(cls, sizes: Sequence[int]) -> "Course":
        """Return the course of recordings with these numbers of samples, all of them new."""
        starts = np.cumsum([0, *sizes])
        course_indices = tuple(start + np.arange(size) for start, size in zip(starts, sizes))
        fresh = tuple(np.ones(size, dtype=bool) for size in sizes)
        return cls(course_indices, fresh, np.repeat(np.arange(len(sizes)), sizes))

    @property
    def repeats(self) -> bool:
        """Whether any motion is repeated."""
        return not all(fresh.all() for fresh in self.fresh)

    def at(self, rows: Sequence[np.ndarray]) -> "Course":
        """Return the course of some samples.

        Args:
            rows: for each recording, the indices (M,) of its samples.
        """
        course_indices = tuple(course_index[index] for course_index, index in zip(self.course_index, rows))
        fresh = tuple(is_new[index] for is_new, index in zip(self.fresh, rows))
        return replace(self, course_index=course_indices, fresh=fresh)

    def blocks(self, count: int) -> list[np.ndarray]:
        """Return for each recording the number (N,) of the block of each sample.

        Blocks are contiguous parts of the course, of about equal length, with their repetitions. At least one begins in
        each recording, but in those that repeat others so far that less than half a block is new: this belongs to the
        block before.

        Args:
            count: number of blocks, about.
        """
        size = len(self.recording)
        number = np.zeros(size, dtype=int)
        first = 0
        recordings = np.unique(self.recording).tolist()
        for recording in recordings:
            course_indices = np.flatnonzero(self.recording == recording)
            repeats = not self.fresh[recording].all()
            if first and repeats and len(course_indices) < 0.5 * size / count:
                number[course_indices] = first - 1
                continue
            blocks = 1
            if len(recordings) < count:
                blocks = max(1, round(count * len(course_indices) / size))
            number[course_indices] = first + (np.arange(len(course_indices)) * blocks) // len(course_indices)
            first += blocks
        return [number[course_index] for course_index in self.course_index]


@dataclass(frozen=True, eq=False)
class _Path:
    """Positions of a recording, read at every `step`-th sample.

    Attributes:
        q: (N, k) positions of the joints that move in any recording [rad or m].
        scale: (k,) their standard deviations over all recordings.
        moves: (M,) whether any joint moves, at every `step`-th sample.
        step: samples per read sample, the same for all recordings.
    """

    q: np.ndarray
    scale: np.ndarray
    moves: np.ndarray
    step: int

    @property
    def rows(self) -> np.ndarray:
        """Indices (M,) of the samples that are read."""
        return np.arange(0, len(self.q), self.step)

    def at(self, rows: np.ndarray) -> np.ndarray:
        """Return the positions (m, k) at samples (m,), in standard deviations."""
        return self.q[rows] / self.scale

    def at_all_samples(self, values: np.ndarray) -> np.ndarray:
        """Return values (N,) of all samples from those (M,) of the read ones: others have that of their predecessor."""
        return np.repeat(values, self.step)[: len(self.q)]


def course(motions: Sequence[Motion]) -> Course:
    """Return the course of recordings of one robot, in the order in which they are given.

    A lag is a number of samples. Recordings of clearly different rates repeat nothing of each other, therefore, and a
    repetition with a gap is mapped on one side of the gap at most.
    """
    paths = _paths(motions)
    met = _met_recordings(paths)
    course_indices, fresh, recordings = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    length = 0
    for number, path in enumerate(paths):
        source, row = _sources(paths, number, met[number])
        size = len(source)
        course_index = np.zeros(size, dtype=int)
        for earlier in range(number):
            selected = source == earlier
            course_index[selected] = course_indices[earlier][row[selected]]
        is_new = source < 0
        new_count = int(is_new.sum())
        course_index[is_new] = length + np.arange(new_count)
        # a sample may repeat one that itself repeats an earlier one
        origin = np.where(source == number, row, np.arange(size))
        while (origin[origin] != origin).any():
            origin = origin[origin]
        course_indices.append(course_index[origin])
        fresh.append(path.at_all_samples(is_new))
        recordings.append(np.full(new_count, number))
        length += new_count
    full_indices = tuple(path.at_all_samples(indices) for path, indices in zip(paths, course_indices))
    return Course(full_indices, tuple(fresh), np.concatenate(recordings))


def _paths(motions: Sequence[Motion]) -> list[_Path]:
    """Return the paths of all recordings."""
    lowest = np.min([motion.q.min(axis=0) for motion in motions], axis=0)
    highest = np.max([motion.q.max(axis=0) for motion in motions], axis=0)
    moving = highest - lowest > MIN_TRAVEL
    deviations = [motion.q.std(axis=0) for motion in motions]
    scale = np.maximum(np.max(deviations, axis=0), MIN_TRAVEL)[moving]
    # one step for all: rates from time stamps differ slightly, and long recordings are read more coarsely
    highest_rate = max(motion.rate for motion in motions)
    longest = max(len(motion) for motion in motions)
    step = max(1, int(highest_rate / RATE), longest // MAX_SAMPLES)
    return [_Path(motion.q[:, moving], scale, ~motion.standstill()[::step], step) for motion in motions]


def _met_recordings(paths: Sequence[_Path]) -> list[list[int]]:
    """Return for each recording the earlier ones that pass through enough of its positions, and the recording itself.

    Only these are searched for lags, which takes long for many recordings.
    """
    if len(paths) == 1 or not paths[0].q.shape[1]:
        return [[number] for number in range(len(paths))]
    positions = [path.at(path.rows[path.moves]) for path in paths]
    recording = np.repeat(np.arange(len(paths)), [len(moving) for moving in positions])
    tree = KDTree(np.concatenate(positions))
    radius = RADIUS * MAX_DISTANCE * np.sqrt(positions[0].shape[1])
    result = []
    for number, moving in enumerate(positions):
        probes = moving[evenly(len(moving), PROBES)]
        counts = np.zeros(len(paths))
        for neighbours in tree.query_ball_point(probes, radius):
            counts[np.unique(recording[neighbours])] += 1
        enough = np.flatnonzero(counts >= MET_SHARE * MIN_SHARE * len(probes))
        result.append([*enough[enough < number].tolist(), number])
    return result


def _sources(paths: Sequence[_Path], number: int, candidates: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the recording (M,) that each read sample repeats, and the read sample there (M,); -1 where it is new.

    Args:
        paths: the recordings.
        number: the recording.
        candidates: numbers of the recordings that it may repeat.
    """
    path = paths[number]
    size = len(path.moves)
    source = np.full(size, -1)
    row = np.full(size, -1)
    if not path.q.shape[1]:
        return source, row
    for earlier in candidates:
        repeated = _repeated(path, paths[earlier], within=earlier == number)
        fresh = (source < 0) & (repeated >= 0)
        source[fresh] = earlier
        row[fresh] = repeated[fresh]
    return source, row


def _repeated(path: _Path, reference: _Path, within: bool) -> np.ndarray:
    """Return the read samples (M,) of a reference that a recording repeats; -1 for none.

    Args:
        path: the recording.
        reference: the recording that it may repeat.
        within: whether both are the same; samples then repeat earlier ones.
    """
    rows = path.rows
    moving = path.moves.sum()
    z = path.at(rows)
    # a lag within a recording may not come near zero
    reach = path.step * (2 if within else REACH)
    result = np.full(len(rows), -1)
    largest_count = 0
    for coarse in _lags(z, reference.at(reference.rows), within):
        lag = _refined(path, reference, coarse * path.step, reach)
        target = rows - lag
        overlap = np.flatnonzero((target >= 0) & (target < len(reference.q)))
        difference = z[overlap] - reference.at(target[overlap])
        alike = overlap[np.sqrt(np.mean(difference**2, axis=1)) < MAX_DISTANCE]
        count = path.moves[alike].sum()
        if count < MIN_SHARE * moving or count < MIN_ALIKE * path.moves[overlap].sum():
            continue
        if count > largest_count:
            largest_count = count
            result = np.full(len(rows), -1)
            result[alike] = target[alike] // path.step
        if largest_count and (within or count >= ENOUGH * moving):
            break
    return result


def _refined(path: _Path, reference: _Path, lag: int, reach: int) -> int:
    """Return the lag with the smallest distance about a coarse one, searched by steps that halve [samples].

    The distance is the median over the moving samples: unlike parts, as the ways to the start, shift the minimum of
    D(L), but not its own.

    Args:
        path, reference: the recording, and the one that it may repeat.
        lag: the coarse lag [samples].
        reach: largest distance from the coarse lag, about [samples].
    """
    best, smallest = lag, _median_distance(path, reference, lag)
    step = reach // 2
    while step > 0:
        for candidate in (best - step, best + step):
            distance = _median_distance(path, reference, candidate)
            if distance < smallest:
                best, smallest = candidate, distance
        step //= 2
    return best


def _median_distance(path: _Path, reference: _Path, lag: int) -> float:
    """Return the median squared distance of two recordings at a lag [samples]; infinite where nothing moves."""
    rows = path.rows[path.moves]
    rows = rows[(rows >= lag) & (rows < len(reference.q) + lag)]
    if not len(rows):
        return np.inf
    difference = path.at(rows) - reference.at(rows - lag)
    return float(np.median(np.sum(difference**2, axis=1)))


def _lags(z: np.ndarray, reference: np.ndarray, within: bool) -> list[int]:
    """Return lags L with z(t) ≈ reference(t - L), in the order in which they are tested.

    Multiples of a period are about as good as the period. Within a recording the smallest of such lags comes first,
    else that with the longest overlap; other lags between recordings follow, the most alike first.

    Args:
        z, reference: (N, n) and (M, n) positions.
        within: whether both are the same recording; only lags after the motion has left its own neighbourhood count.
    """
    size, reference_size = len(z), len(reference)
    lags = np.arange(-(reference_size - 1), size)
    ratio = _unlikeness(z, reference, lags)
    # too short overlaps cannot contain enough of the motion
    overlap = np.minimum(size, lags + reference_size) - np.maximum(0, lags)
    usable = overlap >= MIN_SHARE * size
    if within:
        forward = lags > 0
        distant = np.flatnonzero(forward & (ratio > NEIGHBOURHOOD))
        if not len(distant):
            return []
        usable &= lags > lags[distant[0]]
    inner = np.zeros(len(lags), dtype=bool)
    inner[1:-1] = (ratio[1:-1] <= ratio[:-2]) & (ratio[1:-1] <= ratio[2:])
    candidates = np.flatnonzero(usable & inner & (ratio < MAX_UNLIKENESS))
    # multiples of a period are about as good
    alike = ratio[candidates] <= ratio[candidates].min(initial=np.inf) + TIE
    if within:
        best = candidates[alike]
    else:
        shared = np.where(alike, overlap[candidates], 0)
        best = candidates[np.lexsort((ratio[candidates], -shared))]
    return lags[best[:MAX_LAGS]].tolist()


def _unlikeness(z: np.ndarray, reference: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Return D(L) of the module's docstring for every lag from -(M - 1) to N - 1.

    Args:
        z, reference: (N, n) and (M, n) positions.
        lags: the lags, N + M - 1 of them.
    """
    size, reference_size = len(z), len(reference)
    first = np.maximum(0, lags)
    last = np.minimum(size, lags + reference_size)
    count = last - first
    length = next_fast_len(size + reference_size - 1, real=True)
    product = np.zeros(len(lags))
    spread = np.zeros(len(lags))
    squares = np.zeros(len(lags))
    for column, reference_column in zip(z.T, reference.T):
        spectrum = rfft(column, length) * np.conj(rfft(reference_column, length))
        correlation = irfft(spectrum, length)
        product += np.concatenate([correlation[length - (reference_size - 1) :], correlation[:size]])
        for series, shift in ((column, 0), (reference_column, lags)):
            sums = np.concatenate([[0.0], np.cumsum(series)])
            square_sums = np.concatenate([[0.0], np.cumsum(series**2)])
            total = sums[last - shift] - sums[first - shift]
            square = square_sums[last - shift] - square_sums[first - shift]
            squares += square
            spread += square - total**2 / count
    return (squares - 2.0 * product) / np.maximum(spread, 1e-12)

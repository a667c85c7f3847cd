"""Gear ripple: torque periodic in a gear's position, identified from a model's residuals above the motion's band.

    tau_j += Σ_i Σ_k Σ_m g_m(k v_i) (s_ikm sin k q_i + c_ikm cos k q_i),

g_m hat functions of the ripple's frequency k v / 2π, one set per direction: the structure answers it as an oscillator,
with a gain and a phase that depend on that frequency (our choice). Not only a joint's own gear is felt: on the Panda,
gear 1 explains more of joint 3's ripple than joint 3's own does. Beyond the positions it was learnt at, it fades.

Orders come in families: a gear of N motor turns per turn shows at N, a harmonic drive (whose wave has two lobes) above
all at 2 N against the flexspline and at 2 N + 2 against the output, and at twice those. A motion of three radians
hardly distinguishes orders two apart, and single ones that fit one place do not carry over to another: on the Panda,
with the same search, free orders explain less of unseen motion than the family does. So a gear's N is found first,
joints of similar gears sharing it; free orders are offered where no family pays. What repeats shows in how far the
residual's waves agree in phase between blocks of time:

    S(k) = Σ_b (|Σ_c F_bc(k)|² - Σ_c |F_bc(k)|²) / N_b,    F_bc(k) = Σ residual · exp(-i k q)

over speed bins b and time blocks c, for all whole orders at once by FFT over the position (our choice: neither noise
nor a single loud moment has a part in it). How strongly the columns are regularised towards zero, how finely frequency
is told apart, and whether an order stays at all, time blocks that are left out decide.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from calib.data.signals.filtering import low_pass
from calib.dynamics.drives import DriveTerm
from calib.dynamics.shapes import Joined
from calib.identification.rows import Case, segments
from calib.records import frozen

COARSE, FINE = (10.0, 40.0), (10.0, 20.0, 30.0, 45.0, 65.0)  # nodes of the gains [Hz]
MIN_ORDER, MAX_ORDER = 16, 800  # orders per turn
TURNS = range(16, 321)  # motor turns per turn that a family may have
RIDGES = (0.03, 0.1, 0.3, 1.0)  # of the mean information of a column

Wave = tuple[int, int]  # joint whose gear turns, order per turn of it


@dataclass(frozen=True)
class GearWave:
    """A wave of the ripple: number of the gear's joint (from 1), and order per turn of the gear."""

    gear: int
    order_per_turn: float


@dataclass(frozen=True)
class RippleWaves:
    """Ripple of a joint (from 1), and the share of high-frequency residual power that it explains on held-out time."""

    joint: int
    waves: tuple[GearWave, ...]
    explained_share_on_unseen_blocks: float


@dataclass(frozen=True, eq=False)
class Ripple:
    """The ripple in one joint's torque.

    Attributes:
        joint: from 0.
        waves: for each wave, the joint whose gear causes it, and the order per turn.
        terms, values: (k,) drive terms and their parameters.
        share: explained part of the fast residual's power on held-out blocks.
    """

    joint: int
    waves: tuple[Wave, ...]
    terms: tuple[DriveTerm, ...]
    values: np.ndarray
    share: float

    @property
    def found(self) -> RippleWaves:
        """Record of the waves and of the share of the residual that they explain."""
        return RippleWaves(self.joint + 1, tuple(GearWave(j + 1, order) for j, order in self.waves), self.share)


@dataclass(frozen=True, eq=False)
class GearTravel:
    """Gear positions in the recordings: q, v (N, n), the time block of each sample (N,), and the joints that move."""

    q: np.ndarray
    v: np.ndarray
    block: np.ndarray
    moving: tuple[int, ...]


def find_all(cases: Sequence[Case], residuals: Sequence[np.ndarray]) -> list[Ripple]:
    """Return the ripples in all joints' torques.

    Args:
        residuals: per case (N, n), torque not explained at the full rate; what is slow in it is taken off here.
    """
    max_samples = 4_000  # of the search
    step = max(1, sum(len(case.motion) for case in cases) // max_samples)
    used = np.concatenate([case.motion.weight[::step] > 0.5 for case in cases])
    block = np.where(used, np.concatenate([own[::step] for own in _blocks(cases)]), -1)
    kept = block >= 0
    if len(np.unique(block[kept])) < 2:
        return []
    q, v = (np.concatenate([getattr(case.motion, name)[::step] for case in cases])[kept] for name in ("q", "v"))
    min_travel = 0.1  # [rad] that a joint must travel
    moving = tuple(int(j) for j in np.flatnonzero(np.ptp(q, axis=0) >= min_travel))
    if not moving:
        return []
    track = GearTravel(q, v, block[kept], moving)
    fast = np.zeros(q.shape)
    for j in moving:
        parts = [_fast(case, residual[:, j])[::step] for case, residual in zip(cases, residuals)]
        fast[:, j] = np.concatenate(parts)[kept]
    turns = find_turns(track, fast)
    found = [find(j, track, fast[:, j], turns) for j in moving]
    return [one for one in found if one is not None]


def find_turns(track: GearTravel, residuals: np.ndarray) -> dict[int, int]:
    """Return joint → motor turns per gear turn for joints that move enough, from the most coherent orders.

    Args:
        residuals: (N, n) fast parts.
    """
    scores = {j: _lobes(coherence(track, j, residuals[:, j])) for j in track.moving}
    every = sum(score / max(float(score.max()), 1e-300) for score in scores.values())
    found = {j: int(np.argmax(score)) for j, score in scores.items()}
    offered = sorted({*found.values(), int(np.argmax(every))}, key=lambda k: -float(np.asarray(every)[k]))
    min_coherence = 0.6  # of a gear's own best coherence: a number of turns of other gears takes its place (our choice)
    return {
        j: TURNS[next((k for k in offered if scores[j][k] >= min_coherence * scores[j][own]), own)]
        for j, own in found.items()
    }


def find(joint: int, track: GearTravel, residual: np.ndarray, turns: Mapping[int, int]) -> Ripple | None:
    """Return the ripple in a joint's torque; None if held-out time blocks do not confirm it.

    Args:
        residual: (N,) torque not explained, without its slow part, at the samples of `track`.
        turns: as of `find_turns`.
    """
    if not residual.any():
        return None
    bench = _WaveCrossValidation(track, residual)
    others = {j: _lobes(coherence(track, j, residual))[turns[j] - TURNS[0]] for j in turns if j != joint}
    sources = [joint, *sorted(others, key=lambda j: -others[j])[:1]]
    offers = [tuple((j, order) for order in one) for j in sources for one in _family(turns[j])]
    min_gain = 0.015  # of the fast residual's power on left-out blocks, per step of the search in families
    taken, best, ridge = _climb(bench, lambda rest: offers, min_gain)
    max_free_sets = 3  # of free orders, at most
    min_free_gain = 0.04  # and where no family pays: 2 % of its rms (our choices)
    if not taken:
        taken, best, ridge = _climb(bench, lambda rest: _free(track, joint, rest), min_free_gain, max_free_sets)
    if not taken:
        return None
    nodes = COARSE
    share, level = bench.judge(taken, FINE)
    if share > best:
        nodes, best, ridge = FINE, share, level
    values = bench.fit(taken, nodes, ridge)[1]
    return Ripple(joint, taken, _terms(joint, taken, nodes, track), frozen(values), best)


def _family(n: int) -> tuple[tuple[int, ...], ...]:
    """Return the orders per turn of the ripple of a gear with n motor turns per turn, in sets tested together."""
    return tuple(
        one for one in ((2 * n, 2 * n + 2), (n,), (3 * n,), (4 * n, 4 * n + 2, 4 * n + 4)) if one[-1] <= MAX_ORDER
    )


def _terms(
    joint: int, waves: Sequence[Wave], nodes: Sequence[float], track: GearTravel | None
) -> tuple[DriveTerm, ...]:
    """Return the drive terms of a joint's ripple, wave by wave; without `track`, the terms apply at all positions."""
    edges = (0.0, *nodes, np.inf)
    found = []
    for source, order in waves:
        reach = (-np.inf, np.inf) if track is None else (track.q[:, source].min(), track.q[:, source].max())
        label = f"{joint + 1}" if source == joint else f"{joint + 1}q{source + 1}"
        shapes = ("sine_band", "Rs"), ("cosine_band", "Rc")
        for (m, node), (way, sign), (shape, name) in product(enumerate(nodes), ((1.0, "+"), (-1.0, "-")), shapes):
            settings = (order, *edges[m : m + 3], way, *reach)
            title = f"{name}{label}.{order}{sign}{node:g}Hz"
            found.append(DriveTerm(title, shape, ((joint, ((source, 1.0),)),), tuple(float(x) for x in settings)))
    return tuple(found)


class _WaveCrossValidation:
    """A joint's residual and its candidate columns, to test the share that they explain on held-out blocks.

    Columns of a wave are made once.
    """

    def __init__(self, track: GearTravel, residual: np.ndarray) -> None:
        self._track, self.residual = track, residual
        self._parts = [slice(a, b) for a, b in segments(track.block)]
        self._made: dict[tuple[Wave, tuple[float, ...]], np.ndarray] = {}

    def columns(self, waves: Sequence[Wave], nodes: tuple[float, ...]) -> np.ndarray:
        """Return the regressor columns (N, k) of the waves, in the order of `_terms`."""
        for wave in waves:
            if (wave, nodes) not in self._made:
                self._made[wave, nodes] = _columns(self._track, wave, nodes)
        return np.hstack([self._made[wave, nodes] for wave in waves])

    def judge(self, waves: Sequence[Wave], nodes: tuple[float, ...]) -> tuple[float, float]:
        """Return the explained share of the power on held-out blocks, and the best ridge."""
        matrix, residual = self.columns(waves, nodes), self.residual
        squares = [matrix[own].T @ matrix[own] for own in self._parts]
        crosses = [matrix[own].T @ residual[own] for own in self._parts]
        whole, cross = np.sum(squares, axis=0), np.sum(crosses, axis=0)
        unit, power = float(np.trace(whole)) / len(whole), float(residual @ residual)
        if unit == 0.0:
            return 0.0, RIDGES[-1]
        left = (whole - np.array(squares)) + (np.array(RIDGES) * unit)[:, None, None, None] * np.eye(len(whole))
        x = np.linalg.solve(left, (cross - np.array(crosses))[..., None])[..., 0]
        gained = 2.0 * np.einsum("rfk,fk->r", x, crosses) - np.einsum("rfk,fkl,rfl->r", x, squares, x, optimize=True)
        result = gained / power
        best = int(np.argmax(result))
        return float(result[best]), RIDGES[best]

    def fit(self, waves: Sequence[Wave], nodes: tuple[float, ...], ridge: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the residual after fitting the waves (N,), and their parameters (k,)."""
        matrix = self.columns(waves, nodes)
        square = matrix.T @ matrix
        unit = float(np.trace(square)) / len(square)
        x = np.linalg.solve(square + ridge * unit * np.eye(len(square)), matrix.T @ self.residual)
        return self.residual - matrix @ x, x


def _columns(track: GearTravel, wave: Wave, nodes: Sequence[float]) -> np.ndarray:
    """Return the regressor columns (N, k) of a wave along a track, in the order of `_terms`."""
    q, v = track.q[:, wave[0]], track.v[:, wave[0]]
    seen = Joined(q, v, np.zeros_like(q))
    return np.stack([one.values(seen) for one in _terms(wave[0], (wave,), nodes, None)], axis=1)


def coherence(track: GearTravel, source: int, residual: np.ndarray) -> np.ndarray:
    """Return the coherence S(k) of a gear's integer orders k = 0, 1, ..., (cells / 2 + 1,); see the module."""
    q, v = track.q[:, source], track.v[:, source]
    speed = np.abs(v)
    speed_bins = 4  # of the speed, per direction
    edges = np.quantile(speed, np.linspace(0.1, 1.0, speed_bins + 1))[:-1]
    bins = np.searchsorted(edges, speed, side="right") * np.where(v > 0.0, 1, -1)
    cells = 8192  # of a turn, for the search
    cell = np.floor(q / (2.0 * np.pi) * cells).astype(int) % cells
    numbers, place = np.unique(track.block, return_inverse=True)
    result = np.zeros(cells // 2 + 1)
    for b in np.unique(bins[bins != 0]):
        own = bins == b
        index = place[own] * cells + cell[own]
        waves = np.bincount(index, residual[own], len(numbers) * cells).reshape(len(numbers), cells)
        spectrum = np.fft.rfft(waves, axis=1)
        result += (np.abs(spectrum.sum(axis=0)) ** 2 - (np.abs(spectrum) ** 2).sum(axis=0)) / own.sum()
    return result


def _lobes(power: np.ndarray) -> np.ndarray:
    """Return the sum of the coherence S at N, 2 N and 2 N + 2, for every N of `TURNS`."""
    turns = np.array(TURNS)
    seen = np.maximum(power, 0.0)
    return seen[turns] + seen[2 * turns] + seen[2 * turns + 2]


def _climb(
    bench: _WaveCrossValidation, offer: Callable[[np.ndarray], Sequence[tuple[Wave, ...]]], pays: float, most: int = 12
) -> tuple[tuple[Wave, ...], float, float]:
    """Return the waves of a forward selection by held-out blocks, their explained share, and the ridge."""
    taken: tuple[Wave, ...] = ()
    best, ridge = 0.0, RIDGES[-1]
    rest = bench.residual
    for _ in range(most):
        wanted = [tuple(dict.fromkeys((*taken, *more))) for more in offer(rest) if not set(more) <= set(taken)]
        judged = [(*bench.judge(waves, COARSE), waves) for waves in wanted]
        share, level, waves = max(judged, default=(0.0, ridge, taken), key=lambda one: one[0])
        if share < best + pays:
            break
        taken, best, ridge = waves, share, level
        rest = bench.fit(taken, COARSE, ridge)[0]
    min_total_gain = 0.03  # in all: 1.5 % of its rms
    return (taken, best, ridge) if best >= min_total_gain else ((), 0.0, ridge)


def _free(track: GearTravel, joint: int, rest: np.ndarray) -> list[tuple[Wave, ...]]:
    """Return the most coherent order of the joint's gear, and the most coherent pair of orders with difference two."""
    power = coherence(track, joint, rest)
    order = MIN_ORDER + int(np.argmax(power[MIN_ORDER : MAX_ORDER + 1]))
    lower = MIN_ORDER + int(np.argmax(power[MIN_ORDER : MAX_ORDER - 1] + power[MIN_ORDER + 2 : MAX_ORDER + 1]))
    return [((joint, order),), ((joint, lower), (joint, lower + 2))]


def _fast(case: Case, residual: np.ndarray) -> np.ndarray:
    """Return the high-pass part of a residual (N,), above twice the bandwidth of the motion, by segments."""
    motion = case.motion
    cutoff = min(2.0 * motion.cutoffs.dynamics, 0.4 * motion.rate)
    slow = [low_pass(residual[a:b], motion.rate, cutoff) for a, b in segments(motion.segment)]
    return residual - np.concatenate(slow)


def _blocks(cases: Sequence[Case], blocks: int = 8, skipped_start: float = 0.5) -> list[np.ndarray]:
    """Return the block number of each sample, contiguous, about `blocks` in all; -1 at the start of a recording.

    `skipped_start`: excluded at the beginning, where the robot starts [s].
    """
    sizes = [len(case.motion) for case in cases]
    own = [max(1 if len(cases) > 1 else 2, round(blocks * size / sum(sizes))) for size in sizes]
    numbers, first = [], 0
    for case, size, count in zip(cases, sizes, own):
        number = first + np.arange(size) * count // size
        numbers.append(np.where(case.motion.t < skipped_start, -1, number))
        first += count
    return numbers

"""Gear ripple: torque that is periodic in a gear's position, identified from residuals above the motion's bandwidth.

    tau_j += Σ_i Σ_k Σ_m g_m(k v_i) (s_ikm sin k q_i + c_ikm cos k q_i),

where g_m are triangular functions of the ripple's frequency k v / 2π, one set per direction of motion: the structure
responds as an oscillator, with a gain and a phase that depend on this frequency (our choice). A joint's torque may
contain ripple of other gears: on the Panda, gear 1 explains more of joint 3's ripple than gear 3 does. The ripple model
decays to zero beyond the positions of the training data.

Orders (waves per turn of the joint) occur in families. A gear of N motor turns per turn shows order N. A harmonic drive
(whose wave has two lobes) mainly shows 2 N, against the flexspline, and 2 N + 2, against the output, and twice these
orders. A motion of three radians hardly distinguishes orders that differ by two, and single orders fitted at some
positions do not extrapolate to others: on the Panda, with the same search, free orders explain less of held-out motion
than the family does. Therefore N of each gear is found first, with a common value for similar gears; free orders are
tested only if no family reduces the error. Whether a wave repeats is measured by the coherence of the residual's phase
between time blocks:

    S(k) = Σ_b (|Σ_c F_bc(k)|² - Σ_c |F_bc(k)|²) / N_b,    F_bc(k) = Σ residual · exp(-i k q)

over speed bins b with N_b samples and time blocks c, for all integer orders at once by FFT over the position (our
choice: neither noise nor a single short disturbance contributes). Held-out time blocks decide how strongly the columns
are regularised towards zero, how finely frequency is resolved, and whether an order is kept. Where blocks repeat the
states of others, no ripple is claimed: any residual that the motion repeats would be confirmed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.data.signals.filtering import low_pass
from calib.data.signals.persistency import MAX_STATES, REPEATED, met_elsewhere
from calib.data.signals.repetition import course
from calib.dynamics.drives import DriveTerm
from calib.dynamics.shapes import TermMotion
from calib.identification.rows import Case, segments
from calib.records import frozen

COARSE = (10.0, 40.0)
"""Nodes of the gains in the search [Hz]."""
FINE = (10.0, 20.0, 30.0, 45.0, 65.0)
"""Nodes of the gains of the final fit, where held-out time confirms them [Hz]."""
MIN_ORDER, MAX_ORDER = 16, 800
"""Orders per turn."""
TURNS = range(16, 321)
"""Motor turns per turn that a family may have."""
RIDGES = (0.03, 0.1, 0.3, 1.0)
"""Ridges that are tried, in units of the mean information of a column."""
MAX_SAMPLES = 4_000
"""Samples that the search uses, about."""
MIN_TRAVEL = 0.1
"""Travel from which a joint takes part [rad]."""
MIN_COHERENCE = 0.6
"""Share of a gear's own best coherence from which another gear's number of turns is taken instead (our choice)."""
MIN_GAIN = 0.015
"""Share of the fast residual's power on held-out blocks that a step of the search in families explains (our choice)."""
MIN_FREE_GAIN = 0.04
"""The same of free orders, where no family pays: 2 % of the rms (our choice)."""
MIN_TOTAL_GAIN = 0.03
"""The same of all waves together: 1.5 % of the rms (our choice)."""
MAX_SETS = 12
"""Sets of waves, at most."""
MAX_FREE_SETS = 3
"""Sets of free orders, at most."""
SPEED_BINS = 4
"""Bins of the speed per direction in which the coherence is summed."""
CELLS = 8192
"""Cells of a turn for the search."""
TIME_BLOCKS = 8
"""Blocks of time in all, about."""
SKIPPED_START = 0.5
"""Time excluded at the beginning of a recording, where the robot starts [s]."""


Wave = tuple[int, int]
"""Joint whose gear turns, and order per turn of it."""


@dataclass(frozen=True)
class GearWave:
    """A wave of the ripple.

    Attributes:
        gear: joint of the gear, from 1.
        order_per_turn: waves per turn of the gear.
    """

    gear: int
    order_per_turn: float


@dataclass(frozen=True)
class RippleWaves:
    """Record of the ripple in a joint's torque.

    Attributes:
        joint: joint, from 1.
        waves: the waves.
        explained_share_on_unseen_blocks: share of the high-frequency residual's power that they explain on held-out
            time.
    """

    joint: int
    waves: tuple[GearWave, ...]
    explained_share_on_unseen_blocks: float


@dataclass(frozen=True, eq=False)
class Ripple:
    """Ripple in one joint's torque.

    Attributes:
        joint: joint, from 0.
        waves: for each wave, the joint whose gear causes it, and the order per turn.
        terms, values: (k,) drive terms and their parameters.
        share: explained share of the high-frequency residual's power on held-out blocks.
    """

    joint: int
    waves: tuple[Wave, ...]
    terms: tuple[DriveTerm, ...]
    values: np.ndarray
    share: float

    @property
    def found(self) -> RippleWaves:
        """Record of the waves, with the share of the residual that they explain."""
        waves = tuple(GearWave(gear + 1, order) for gear, order in self.waves)
        joint = self.joint + 1
        return RippleWaves(joint, waves, self.share)


@dataclass(frozen=True, eq=False)
class GearTravel:
    """Motion of the gears in the recordings.

    Attributes:
        q, v: (N, n) positions [rad or m] and velocities [per s].
        block: (N,) number of the block of each sample: a part of the motion with all its repetitions.
        moving: joints, from 0, that move enough.
    """

    q: np.ndarray
    v: np.ndarray
    block: np.ndarray
    moving: tuple[int, ...]

    @cached_property
    def blocks(self) -> tuple[int, np.ndarray]:
        """Number of blocks, and the index (N,) of each sample's block among them."""
        numbers, index = np.unique(self.block, return_inverse=True)
        return len(numbers), index

    @cached_property
    def cells(self) -> dict[int, tuple[np.ndarray, list[np.ndarray]]]:
        """For each joint that moves enough, the cell of the turn (N,) of each sample, and the masks (N,) of all bins.

        A bin is a range of speeds in one direction; the slowest tenth of the samples is in none.
        """
        result = {}
        for gear in self.moving:
            speed = np.abs(self.v[:, gear])
            edges = np.quantile(speed, np.linspace(0.1, 1.0, SPEED_BINS + 1))[:-1]
            direction = np.where(self.v[:, gear] > 0.0, 1, -1)
            speed_bin = np.searchsorted(edges, speed, side="right") * direction
            masks = [speed_bin == number for number in np.unique(speed_bin[speed_bin != 0])]
            turns = self.q[:, gear] / (2.0 * np.pi) * CELLS
            result[gear] = (np.floor(turns).astype(int) % CELLS, masks)
        return result


def find_all(cases: Sequence[Case], residuals: Sequence[np.ndarray]) -> list[Ripple]:
    """Return the ripple in the torques of all joints that have any.

    Args:
        cases: recordings.
        residuals: for each case, the unexplained torque (N, n) at the full rate; its slow part is removed here.
    """
    numbered = _blocks(cases)
    if _repeats_between(cases, numbered):
        return []
    step = max(1, sum(len(case.motion) for case in cases) // MAX_SAMPLES)
    case_blocks = []
    positions = []
    speeds = []
    for case, numbers in zip(cases, numbered):
        motion = case.motion
        valid = motion.weight[::step] > 0.5
        case_blocks.append(np.where(valid, numbers[::step], -1))
        positions.append(motion.q[::step])
        speeds.append(motion.v[::step])
    block = np.concatenate(case_blocks)
    used = block >= 0
    if len(np.unique(block[used])) < 2:
        return []
    q = np.concatenate(positions)[used]
    v = np.concatenate(speeds)[used]
    moving = tuple(np.flatnonzero(np.ptp(q, axis=0) >= MIN_TRAVEL).tolist())
    if not moving:
        return []
    track = GearTravel(q, v, block[used], moving)
    fast = np.zeros(q.shape)
    for joint in moving:
        parts = [_fast(case, residual[:, joint])[::step] for case, residual in zip(cases, residuals)]
        fast[:, joint] = np.concatenate(parts)[used]
    turns = find_turns(track, fast)
    ripples = []
    for joint in moving:
        ripple = find(joint, track, fast[:, joint], turns)
        if ripple is not None:
            ripples.append(ripple)
    return ripples


def find_turns(track: GearTravel, residuals: np.ndarray) -> dict[int, int]:
    """Return the motor turns per turn of each gear that moves enough, from the most coherent orders.

    The result maps a joint, from 0, to the number of turns.

    Args:
        track: motion of the gears.
        residuals: (N, n) high-frequency parts of the unexplained torques [N m or N].
    """
    scores: dict[int, np.ndarray] = {}
    total = np.zeros(len(TURNS))
    for joint in track.moving:
        power = coherence(track, joint, residuals[:, joint])
        score = _lobes(power)
        scores[joint] = score
        total = total + score / max(float(score.max()), 1e-300)

    # A gear takes the number of turns that is most coherent in all gears together, unless its own says otherwise.
    best = {joint: int(np.argmax(score)) for joint, score in scores.items()}
    tried = {*best.values(), int(np.argmax(total))}
    candidates = sorted(tried, key=lambda index: -float(total[index]))
    turns = {}
    for joint, score in scores.items():
        index = best[joint]
        for candidate in candidates:
            if score[candidate] >= MIN_COHERENCE * score[best[joint]]:
                index = candidate
                break
        turns[joint] = TURNS[index]
    return turns


def find(joint: int, track: GearTravel, residual: np.ndarray, turns: Mapping[int, int]) -> Ripple | None:
    """Return the ripple in a joint's torque; None if held-out time blocks do not confirm any.

    Args:
        joint: joint, from 0.
        track: motion of the gears.
        residual: (N,) unexplained torque [N m or N], without its slow part, at the samples of `track`.
        turns: motor turns per turn of each gear, from `find_turns`.
    """
    if not residual.any():
        return None
    validation = _WaveCrossValidation(track, residual)

    # Families of the joint's own gear, and of the one other gear that is felt most.
    power = {}
    for gear in turns:
        if gear != joint:
            orders = _lobe_orders(np.array(turns[gear]))
            power[gear] = np.maximum(coherence_at(track, gear, residual, orders), 0.0).sum()
    gears = [joint]
    if power:
        gears.append(max(power, key=power.__getitem__))
    families = []
    for gear in gears:
        families += [tuple((gear, order) for order in orders) for orders in _family(turns[gear])]
    waves, best, ridge = _climb(validation, lambda remainder: families, MIN_GAIN)
    if not waves:
        waves, best, ridge = _climb(
            validation, lambda remainder: _free(track, joint, remainder), MIN_FREE_GAIN, MAX_FREE_SETS
        )
    if not waves:
        return None
    nodes = COARSE
    fine_share, fine_ridge = validation.explained_share(waves, FINE)
    if fine_share > best:
        nodes, best, ridge = FINE, fine_share, fine_ridge
    _, values = validation.fit(waves, nodes, ridge)
    terms = _terms(joint, waves, nodes, track)
    return Ripple(joint, waves, terms, frozen(values), best)


def _family(turns: int) -> tuple[tuple[int, ...], ...]:
    """Return the orders per turn of a gear with `turns` motor turns per turn, in sets that are tested together."""
    twice, four_times = 2 * turns, 4 * turns
    sets = ((twice, twice + 2), (turns,), (3 * turns,), (four_times, four_times + 2, four_times + 4))
    return tuple(orders for orders in sets if orders[-1] <= MAX_ORDER)


def _terms(
    joint: int, waves: Sequence[Wave], nodes: Sequence[float], track: GearTravel | None
) -> tuple[DriveTerm, ...]:
    """Return the drive terms of a joint's ripple, wave by wave.

    Args:
        joint: joint whose torque contains the ripple, from 0.
        waves: pairs of a gear's joint and order per turn.
        nodes: frequencies of the gain's nodes [Hz].
        track: motion of the gears, beyond which the terms decay; None: the terms apply at all positions.
    """
    edges = (0.0, *nodes, np.inf)
    terms = []
    for gear, order in waves:
        lower, upper = -np.inf, np.inf
        if track is not None:
            lower = track.q[:, gear].min()
            upper = track.q[:, gear].max()
        label = f"{joint + 1}"
        if gear != joint:
            label = f"{joint + 1}q{gear + 1}"
        acts = ((joint, ((gear, 1.0),)),)
        for m, node in enumerate(nodes):
            for direction, sign in ((1.0, "+"), (-1.0, "-")):
                settings = (order, *edges[m : m + 3], direction, lower, upper)
                numbers = tuple(float(setting) for setting in settings)
                suffix = f"{label}.{order}{sign}{node:g}Hz"
                terms.append(DriveTerm(f"Rs{suffix}", "sine_band", acts, numbers))
                terms.append(DriveTerm(f"Rc{suffix}", "cosine_band", acts, numbers))
    return tuple(terms)


class _WaveCrossValidation:
    """Cross-validation of waves: the share of a joint's residual that they explain on held-out blocks.

    The columns of each wave are computed once and stored.
    """

    def __init__(self, track: GearTravel, residual: np.ndarray) -> None:
        self._track = track
        self.residual = residual
        count, block = track.blocks
        self._blocks = [np.flatnonzero(block == number) for number in range(count)]
        self._columns: dict[tuple[Wave, tuple[float, ...]], np.ndarray] = {}

    def columns(self, waves: Sequence[Wave], nodes: tuple[float, ...]) -> np.ndarray:
        """Return the regressor columns (N, k) of the waves, in the order of `_terms`.

        Args:
            waves: pairs of a gear's joint and order per turn.
            nodes: frequencies of the gain's nodes [Hz].
        """
        for wave in waves:
            if (wave, nodes) not in self._columns:
                self._columns[wave, nodes] = _columns(self._track, wave, nodes)
        return np.hstack([self._columns[wave, nodes] for wave in waves])

    def explained_share(self, waves: Sequence[Wave], nodes: tuple[float, ...]) -> tuple[float, float]:
        """Return the explained share of the residual's power on held-out blocks, and the best ridge of `RIDGES`.

        Args:
            waves: pairs of a gear's joint and order per turn.
            nodes: frequencies of the gain's nodes [Hz].
        """
        matrix = self.columns(waves, nodes)
        residual = self.residual
        parts = [matrix[block] for block in self._blocks]
        squares = np.array([part.T @ part for part in parts])
        crosses = np.array([part.T @ residual[block] for part, block in zip(parts, self._blocks)])
        square = np.sum(squares, axis=0)
        cross = np.sum(crosses, axis=0)
        unit = float(np.trace(square)) / len(square)
        if unit == 0.0:
            return 0.0, RIDGES[-1]
        # Estimates (ridges, blocks, k) without each block; what they leave of its power in comparison to zero.
        sizes = (np.array(RIDGES) * unit)[:, None, None, None]
        ridges = sizes * np.eye(len(square))
        right = (cross - crosses)[..., None]
        left_out = square - squares
        values = np.linalg.solve(left_out + ridges, right)[..., 0]
        linear = 2.0 * np.einsum("rfk,fk->r", values, crosses)
        quadratic = np.einsum("rfk,fkl,rfl->r", values, squares, values, optimize=True)
        share = (linear - quadratic) / float(residual @ residual)
        best = int(np.argmax(share))
        return float(share[best]), RIDGES[best]

    def fit(self, waves: Sequence[Wave], nodes: tuple[float, ...], ridge: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the residual after fitting the waves (N,), and their parameters (k,).

        Args:
            waves: pairs of a gear's joint and order per turn.
            nodes: frequencies of the gain's nodes [Hz].
            ridge: weight of the parameters' squares, in units of the mean information of a column.
        """
        matrix = self.columns(waves, nodes)
        square = matrix.T @ matrix
        unit = float(np.trace(square)) / len(square)
        ridge_matrix = ridge * unit * np.eye(len(square))
        right = matrix.T @ self.residual
        values = np.linalg.solve(square + ridge_matrix, right)
        return self.residual - matrix @ values, values


def _columns(track: GearTravel, wave: Wave, nodes: Sequence[float]) -> np.ndarray:
    """Return the regressor columns (N, k) of a wave along a motion of the gears, in the order of `_terms`.

    Args:
        track: motion of the gears.
        wave: pair of the gear's joint and order per turn.
        nodes: frequencies of the gain's nodes [Hz].
    """
    gear = wave[0]
    q = track.q[:, gear]
    v = track.v[:, gear]
    motion = TermMotion(q, v, np.zeros_like(q))
    wave_terms = [term.values(motion) for term in _terms(gear, (wave,), nodes, None)]
    return np.stack(wave_terms, axis=1)


def coherence(track: GearTravel, gear: int, residual: np.ndarray) -> np.ndarray:
    """Return the coherence S(k) of integer orders k = 0, 1, … of a gear, (cells / 2 + 1,).

    The module's docstring defines S(k).

    Args:
        track: motion of the gears.
        gear: joint of the gear, from 0.
        residual: (N,) high-frequency part of an unexplained torque.
    """
    cell, bins = track.cells[gear]
    count, block = track.blocks
    result = np.zeros(CELLS // 2 + 1)
    for selected in bins:
        index = block[selected] * CELLS + cell[selected]
        sums = np.bincount(index, residual[selected], count * CELLS)
        spectrum = np.fft.rfft(sums.reshape(count, CELLS), axis=1)
        result += _between_blocks(spectrum) / selected.sum()
    return result


def coherence_at(track: GearTravel, gear: int, residual: np.ndarray, orders: np.ndarray) -> np.ndarray:
    """Return the coherence S(k) of K orders k of a gear, (K,), equal to those by `coherence`.

    Args:
        track: motion of the gears.
        gear: joint of the gear, from 0.
        residual: (N,) high-frequency part of an unexplained torque.
        orders: (K,) orders k per turn.
    """
    cell, bins = track.cells[gear]
    count, block = track.blocks
    in_block = (np.arange(count)[:, None] == block).astype(float)
    roots_of_unity = np.exp(-2j * np.pi / CELLS * np.arange(CELLS))
    waves = residual[:, None] * roots_of_unity[np.outer(cell, orders) % CELLS]
    result = np.zeros(len(orders))
    for selected in bins:
        spectrum = in_block[:, selected] @ waves[selected]
        result += _between_blocks(spectrum) / selected.sum()
    return result


def _between_blocks(spectrum: np.ndarray) -> np.ndarray:
    """Return the power (K,) of the sum of spectra (blocks, K) beyond the sum of their powers."""
    together = np.abs(spectrum.sum(axis=0)) ** 2
    separately = (np.abs(spectrum) ** 2).sum(axis=0)
    return together - separately


def _lobes(power: np.ndarray) -> np.ndarray:
    """Return, for every N of `TURNS`, the sum of the coherence S(k) over the orders N, 2 N and 2 N + 2.

    Args:
        power: coherence S(k) of the orders k = 0, 1, …, from `coherence`.
    """
    positive = np.maximum(power, 0.0)
    return positive[_lobe_orders(np.array(TURNS))].sum(axis=0)


def _lobe_orders(turns: np.ndarray) -> np.ndarray:
    """Return the orders per turn N, 2 N and 2 N + 2 (3, ...) of gears with N motor turns per turn."""
    return np.stack([turns, 2 * turns, 2 * turns + 2])


def _climb(
    validation: _WaveCrossValidation,
    candidates: Callable[[np.ndarray], Sequence[tuple[Wave, ...]]],
    min_gain: float,
    max_sets: int = MAX_SETS,
) -> tuple[tuple[Wave, ...], float, float]:
    """Return the waves of a forward selection by held-out blocks, their explained share, and the ridge.

    Without a significant wave the result is an empty tuple and a share of 0.

    Args:
        validation: cross-validation of the joint's residual.
        candidates: function of the remaining residual (N,) that returns sets of waves.
        min_gain: smallest share of the residual's power that each further set must explain.
        max_sets: largest number of sets.
    """
    selection: tuple[Wave, ...] = ()
    selection_share, ridge = 0.0, RIDGES[-1]
    remainder = validation.residual
    for _ in range(max_sets):
        best_share, best_ridge, best_waves = 0.0, ridge, selection
        tested = False
        for wave_set in candidates(remainder):
            if set(wave_set) <= set(selection):
                continue
            waves = tuple(dict.fromkeys((*selection, *wave_set)))
            share, level = validation.explained_share(waves, COARSE)
            if not tested or share > best_share:
                best_share, best_ridge, best_waves = share, level, waves
            tested = True
        if best_share < selection_share + min_gain:
            break
        selection, selection_share, ridge = best_waves, best_share, best_ridge
        remainder, _ = validation.fit(selection, COARSE, ridge)
    if selection_share < MIN_TOTAL_GAIN:
        return (), 0.0, ridge
    return selection, selection_share, ridge


def _free(track: GearTravel, joint: int, residual: np.ndarray) -> list[tuple[Wave, ...]]:
    """Return two sets of waves of the joint's gear: the most coherent order, and the most coherent pair k, k + 2.

    Args:
        track: motion of the gears.
        joint: joint, from 0.
        residual: (N,) high-frequency part of its unexplained torque.
    """
    power = coherence(track, joint, residual)
    order = MIN_ORDER + int(np.argmax(power[MIN_ORDER : MAX_ORDER + 1]))
    pairs = power[MIN_ORDER : MAX_ORDER - 1] + power[MIN_ORDER + 2 : MAX_ORDER + 1]
    lower = MIN_ORDER + int(np.argmax(pairs))
    return [((joint, order),), ((joint, lower), (joint, lower + 2))]


def _fast(case: Case, residual: np.ndarray) -> np.ndarray:
    """Return the high-pass part of a residual (N,), above twice the bandwidth of the motion, segment by segment.

    Args:
        case: the recording.
        residual: (N,) unexplained torque of one joint.
    """
    motion = case.motion
    cutoff = min(2.0 * motion.cutoffs.dynamics, 0.4 * motion.rate)
    slow = []
    for start, stop in segments(motion.segment):
        slow.append(low_pass(residual[start:stop], motion.rate, cutoff))
    return residual - np.concatenate(slow)


def _blocks(cases: Sequence[Case]) -> list[np.ndarray]:
    """Return the block of each sample of each case, about `TIME_BLOCKS` in all; -1 at the start of a recording.

    A block is a part of the motion with all its repetitions, since the residual repeats with the motion.
    """
    numbers = []
    for case, block in zip(cases, course([case.motion for case in cases]).blocks(TIME_BLOCKS)):
        numbers.append(np.where(case.motion.t < SKIPPED_START, -1, block))
    return numbers


def _repeats_between(cases: Sequence[Case], numbered: Sequence[np.ndarray]) -> bool:
    """Return whether blocks mostly repeat the states of others, so that nothing is held out.

    Periods that are repeated at slightly other speeds have no common lag by which `course` would find them.

    Args:
        cases: recordings.
        numbered: for each case, the block (N,) of each sample; -1 for samples that are not used.
    """
    step = max(1, sum(len(case.motion) for case in cases) // MAX_STATES)
    states, blocks = [], []
    for case, block in zip(cases, numbered):
        motion = case.motion
        rows = np.flatnonzero(~motion.standstill() & (block >= 0))[::step]
        states.append(np.hstack([motion.q[rows], motion.v[rows]]))
        blocks.append(block[rows])
    number = np.concatenate(blocks)
    if len(np.unique(number)) < 2:
        return False
    return met_elsewhere(np.concatenate(states), number) >= REPEATED

"""Gear ripple: torque that repeats with the gear's position, found in what a model leaves above the motion's band.

    tau_j += Σ_k Σ_m g_m(v_j) (s_km sin k q_j + c_km cos k q_j),

g_m hat functions of the ripple's frequency k v / 2π, one set per direction: the structure answers it as an oscillator,
with a gain and a phase that depend on that frequency (our choice). A harmonic drive of ratio N shows at 2 N against the
case and at 2 (N + 1) against the output, so orders come in pairs two apart; a motion of three radians hardly tells them
apart, and a single order that fits one place does not carry over to another. Beyond the positions it was learnt at, the
ripple fades.

Orders are found one pair after the other as the pair that explains most of the residual. How strongly the columns are
drawn to zero, and whether a joint gets them at all, time blocks that are left out decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calib.arrays import frozen
from calib.data.filtering import low_pass
from calib.dynamics.drives import Term, term
from calib.dynamics.shapes import Joined
from calib.identification.cases import Case
from calib.identification.rows import segments

NODES = (10.0, 40.0)  # [Hz]
LOWEST, HIGHEST = 16.0, 800.0  # orders per turn
PAIRS = 3  # offered per joint, at most
RIDGES = (0.03, 0.1, 0.3, 1.0, 3.0)  # of the mean information of a column
LEAST = 0.1  # [rad] that a joint must travel
BLOCKS = 8
PAYS = 0.04  # of the fast residual's power on left-out blocks, per pair: 2 % of its rms
START = 0.5  # [s] left out at the beginning, where robots start
MOST = 300_000  # samples that are looked at; of longer recordings every second, third, ... one


@dataclass(frozen=True, eq=False)
class Ripple:
    """The ripple of one joint.

    Attributes:
        joint: from 0.
        orders: per radian of q, which is per turn.
        terms, values: (k,) drive terms and their parameters.
        share: part of the fast residual's power on left-out blocks that it explains.
    """

    joint: int
    orders: tuple[float, ...]
    terms: tuple[Term, ...]
    values: np.ndarray
    share: float


def find_all(cases: Sequence[Case], residuals: Sequence[np.ndarray]) -> list[Ripple]:
    """Return the ripples of all joints.

    Args:
        residuals: per case (N, n), torque not explained at the full rate; what is slow in it is taken off here.
    """
    step = -(-sum(len(case.motion) for case in cases) // MOST)
    used = np.concatenate([case.motion.weight[::step] > 0.5 for case in cases])
    block = np.where(used, np.concatenate([own[::step] for own in _blocks(cases)]), -1)
    found = []
    for j in range(cases[0].motion.n):
        q, v = (np.concatenate([getattr(case.motion, name)[::step, j] for case in cases]) for name in ("q", "v"))
        if np.ptp(q) < LEAST:
            continue
        fast = [_fast(case, residual[:, j])[::step] for case, residual in zip(cases, residuals)]
        one = find(j, q, v, np.concatenate(fast), block)
        found += [one] if one is not None else []
    return found


def find(joint: int, q: np.ndarray, v: np.ndarray, residual: np.ndarray, block: np.ndarray) -> Ripple | None:
    """Return the ripple that left-out blocks confirm, or None.

    Args:
        q, v: (N,) of the joint at the full rate.
        residual: (N,) torque not explained, without its slow part.
        block: (N,) number of the time block; -1 for samples not used.
    """
    used = block >= 0
    q, v, residual, block = q[used], v[used], residual[used], block[used]
    if len(np.unique(block)) < 2 or not residual.any():
        return None
    taken: list[float] = []
    best, kept = 0.0, None
    for _ in range(PAIRS):
        rest = residual if not taken else residual - _fit(columns(q, v, taken), residual, RIDGES[0])[0]
        order = _strongest(q, v, rest)
        wanted = [*taken, *(k for k in (order, order + 2.0) if k not in taken)]
        share, ridge = _judge(columns(q, v, wanted), residual, block)
        if share < best + PAYS:
            break
        taken, best = wanted, share
        values = _fit(columns(q, v, taken), residual, ridge)[1]
        own = terms(joint, taken, (float(q.min()), float(q.max())))
        kept = Ripple(joint, tuple(taken), own, frozen(values), share)
    return kept


def terms(joint: int, orders: Sequence[float], reach: tuple[float, float]) -> tuple[Term, ...]:
    """Return the terms of a joint's ripple, order after order; `reach`: the positions it was learnt at."""
    nodes = (0.0, *NODES, np.inf)
    found = []
    for order in orders:
        for m, node in enumerate(NODES):
            for way, label in ((1.0, "+"), (-1.0, "-")):
                for shape, name in (("sine_band", "Rs"), ("cosine_band", "Rc")):
                    settings = (order, *nodes[m : m + 3], way, *reach)
                    found.append(term(f"{name}{joint + 1}.{order:g}{label}{node:g}Hz", shape, joint, *settings))
    return tuple(found)


def columns(q: np.ndarray, v: np.ndarray, orders: Sequence[float]) -> np.ndarray:
    """Return the columns (N, k) at the full rate, in the order of `terms`, wherever q has been."""
    seen = Joined(q, v, np.zeros_like(q))
    own = terms(0, orders, (-np.inf, np.inf))
    return np.stack([one.form.values(seen, one.settings) for one in own], axis=1)


def _fast(case: Case, residual: np.ndarray) -> np.ndarray:
    """Return what of a residual (N,) lies above twice the motion's own band, each segment by itself."""
    motion = case.motion
    cutoff = min(2.0 * motion.cutoffs.dynamics, 0.4 * motion.rate)
    slow = [low_pass(residual[a:b], motion.rate, cutoff) for a, b in segments(motion.segment)]
    return residual - np.concatenate(slow)


def _blocks(cases: Sequence[Case]) -> list[np.ndarray]:
    """Number contiguous blocks of all cases, about `BLOCKS` in all; -1 at the start of a recording."""
    sizes = [len(case.motion) for case in cases]
    own = [max(1 if len(cases) > 1 else 2, round(BLOCKS * size / sum(sizes))) for size in sizes]
    numbers, first = [], 0
    for case, size, count in zip(cases, sizes, own):
        number = first + np.arange(size) * count // size
        numbers.append(np.where(case.motion.t < START, -1, number))
        first += count
    return numbers


def _strongest(q: np.ndarray, v: np.ndarray, residual: np.ndarray) -> float:
    """Return the lower order, a whole number, of the pair that explains most."""
    orders = np.arange(LOWEST, HIGHEST + 1.0)
    power = np.zeros(len(orders))
    step = max(1, len(q) // 20_000)
    q, v, residual = q[::step], v[::step], residual[::step]
    for own in (v > 0.0, v < 0.0):
        turns, turn = np.abs(v[own]) / (2.0 * np.pi), np.exp(-1j * q[own])
        wave = np.exp(-1j * LOWEST * q[own]) * residual[own]
        for i, order in enumerate(orders):
            for gain in _hats(order * turns):
                size = float(gain @ gain)
                if size > 30.0:
                    power[i] += 2.0 * ((gain @ wave.real) ** 2 + (gain @ wave.imag) ** 2) / size
            wave *= turn
    return float(orders[int(np.argmax(power[:-2] + power[2:]))])


def _hats(frequency: np.ndarray) -> list[np.ndarray]:
    """Return the gains (N,) of all bands for one direction, as `shapes` has them: what rises at a node and not yet at
    the next one."""
    nodes = (0.0, *NODES)
    rises = [np.clip((frequency - a) / (b - a), 0.0, 1.0) for a, b in pairwise(nodes)]
    return [*(here - ahead for here, ahead in pairwise(rises)), rises[-1]]


def _judge(matrix: np.ndarray, residual: np.ndarray, block: np.ndarray) -> tuple[float, float]:
    """Return the share of the power on left-out blocks that the columns explain, and the ridge with which."""
    masks = [block == b for b in np.unique(block)]
    squares = [matrix[own].T @ matrix[own] for own in masks]
    crosses = [matrix[own].T @ residual[own] for own in masks]
    powers = [float(np.sum(residual[own] ** 2)) for own in masks]
    whole, cross = np.sum(squares, axis=0), np.sum(crosses, axis=0)
    unit = float(np.trace(whole)) / len(whole)
    if unit == 0.0:
        return 0.0, RIDGES[-1]
    result = []
    for ridge in RIDGES:
        left = 0.0
        for square, own, power in zip(squares, crosses, powers):
            x = np.linalg.solve(whole - square + ridge * unit * np.eye(len(whole)), cross - own)
            left += float(power - 2.0 * x @ own + x @ square @ x)
        result.append(1.0 - left / sum(powers))
    best = int(np.argmax(result))
    return result[best], RIDGES[best]


def _fit(matrix: np.ndarray, residual: np.ndarray, ridge: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what the columns explain (N,), and their values (k,)."""
    square = matrix.T @ matrix
    unit = float(np.trace(square)) / len(square)
    x = np.linalg.solve(square + ridge * unit * np.eye(len(square)), matrix.T @ residual)
    return matrix @ x, x

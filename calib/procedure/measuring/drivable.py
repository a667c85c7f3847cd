"""Poses that one can drive to: where no clear way leads to one, a candidate takes its place that one leads to.

The same pose on another turn of its joints comes first. Of the candidates the one is taken that leaves most of the
criterion among those that a straight move reaches, or, where there are none, among the best few by via-points.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.procedure.measuring.run import Progress, Run, RunSettings, Ways, plan_run, same_turn, turns, way_to
from calib.robot.chain import Chain
from poses.by_index import merits
from poses.indices import Index, observability
from poses.information import log_det

ROUNDS = 3  # times that poses are replaced, and the run is planned again (our choice)
# candidates tried in the place of one pose, by straight moves, by via-points (our choice)
MAX_STRAIGHT_TRIES, MAX_VIA_TRIES = 200, 4


@dataclass(frozen=True, eq=False)
class Exchange:
    """What poses are replaced from, and judged by.

    Attributes:
        jacobian: q (m, n) -> whitened observation Jacobians (m, rows, p).
        candidates: (N, n) feasible poses [rad or m].
        before: (k, rows, p) of poses measured before; None without them.
        index: that counts.
    """

    jacobian: Callable[[np.ndarray], np.ndarray]
    candidates: np.ndarray
    before: np.ndarray | None
    index: Index

    def value(self, q: np.ndarray) -> tuple[float, float]:
        """Return the index of poses (m, n) with those before, and log det(WᵀW) / p."""
        rows = self._rows(q)
        flat = rows.reshape(-1, rows.shape[2])
        return observability(rows, self.index), float(log_det(flat.T @ flat)) / rows.shape[2]

    def ranked(self, q: np.ndarray) -> np.ndarray:
        """Return the candidates' numbers (N,), that first which is worth most beside poses (m, n)."""
        rows, trials = self._rows(q), self.jacobian(self.candidates)
        flat = rows.reshape(-1, rows.shape[2])
        matrices = flat.T @ flat + trials.transpose(0, 2, 1) @ trials
        values = log_det(matrices) if self.index == "O1" else merits(matrices, self.index)
        return np.argsort(-values, kind="stable")

    def _rows(self, q: np.ndarray) -> np.ndarray:
        rows = np.asarray(self.jacobian(q))
        return rows if self.before is None else np.concatenate([rows, self.before])


@dataclass(frozen=True, eq=False)
class Drivable:
    """Poses and their run.

    Attributes:
        q: (m, n) in the order they came, each revolute joint on the turn it is driven on [rad or m].
        run: through them.
        replaced: places in the list -> candidate that stands there, since no clear way led to what stood there.
        value: the index before and after.
        gain: in log det(WᵀW) / p.
    """

    q: np.ndarray
    run: Run
    replaced: Mapping[int, int]
    value: tuple[float, float]
    gain: float

    @property
    def words(self) -> str:
        """Which poses of the run were replaced, counted from 1 in its order; "" where none was."""
        if not self.replaced:
            return ""
        numbers = ", ".join(f"{k}" for k, place in enumerate(self.run.order, 1) if place in self.replaced)
        poses = f"pose{'s' if len(self.replaced) > 1 else ''} {numbers}"
        before, after = self.value
        return f"{poses} replaced: no clear way to what stood there (index {before:.5g} → {after:.5g})"


def drivable(
    chain: Chain,
    q: np.ndarray,
    exchange: Exchange,
    limits: Any,
    settings: RunSettings,
    seed: int = 0,
    progress: Progress | None = None,
) -> Drivable:
    """Plan the run through poses q (m, n), those replaced that no clear way leads to on any turn of their joints.

    Args:
        chain, limits, settings, seed, progress: see `calib.procedure.measuring.run.plan_run`.
        exchange: what poses are replaced from.
    """
    say, replaced, ways = progress or (lambda words: None), dict[int, int](), Ways()
    first = q = same_turn(chain, q, limits.lower, limits.upper)
    for last in (*[False] * ROUNDS, True):
        run = plan_run(chain, q, limits, settings, seed, say, ways)
        if last or not run.cut_off:
            break
        say(f"{len(run.cut_off)} poses that no clear way leads to")
        q, fresh, ways = _joined(chain, q, run, exchange, limits, settings, seed)
        replaced |= fresh
    (before, log_before), (after, log_after) = exchange.value(first), exchange.value(q)
    return Drivable(q, run, replaced, (before, after), log_after - log_before)


def _joined(
    chain: Chain, q: np.ndarray, run: Run, exchange: Exchange, limits: Any, settings: RunSettings, seed: int
) -> tuple[np.ndarray, dict[int, int], Ways]:
    """Return poses (m, n) that clear ways lead to, which candidates are among them, and all ways found."""
    q, found, ways = q.copy(), dict[int, int](), run.found_ways
    joined = [k for k in range(len(q)) if k not in run.cut_off]
    for place in run.cut_off:
        ranked = [
            int(k) for k in exchange.ranked(np.delete(q, place, axis=0))
            if np.abs(q - exchange.candidates[k]).max(axis=1).min() > 1e-9
        ]  # fmt: skip
        itself = [(None, straight) for straight in (True, False)]
        others = [(k, True) for k in ranked[:MAX_STRAIGHT_TRIES]] + [(k, False) for k in ranked[:MAX_VIA_TRIES]]
        for number, straight in itself + others:
            trial = q[place] if number is None else exchange.candidates[number]
            postures = turns(chain, trial, limits.lower, limits.upper)
            own = way_to(chain, limits, settings, postures, q[joined], straight=straight, seed=seed)
            if own is not None:
                start, path = joined[own[0]], own[1]
                q[place] = path[-1]
                ways[min(start, place), max(start, place)] = path if start < place else path[::-1]
                found |= {} if number is None else {place: number}
                joined.append(place)
                break
    return q, found, ways

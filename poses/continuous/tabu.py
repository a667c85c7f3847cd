"""IMHATR: iterative meta-heuristic with a tabu rule, in two stages.

The study of the KUKA LWR4+ by Kolyubin, Shiriaev & Jubien (2019) names the method after its reference [8] (most likely
Daney, Papegay & Madeline, IJRR 24(6), 2005: poses chosen one after another, a tabu list against local minima) and gives
no details. This is our reconstruction, and all numbers are ours:

1. *Construct.* Until there are m poses: draw N_c random feasible poses outside the tabu list and take the one that
   improves the index most. Improve this pose by a local search with the other poses fixed, and add it. The drawn and
   the improved pose become tabu.
2. *Exchange.* Drop the pose whose removal reduces the index least, search for its replacement as in stage 1, and accept
   the replacement where the index improves. Visited and rejected poses become tabu (first in, first out). Stop after
   `patience` · m failures in a row. A pose whose replacement failed is not dropped again until another exchange
   improves the index, so that every pose is tried.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..candidates import draw_candidates
from ..continuous.local import Improved, improved
from ..indices import Index, merit
from ..space import SearchSpace, is_feasible


@dataclass(frozen=True)
class TabuRule:
    """Settings of the tabu search, all our choice.

    Attributes:
        candidates: N_c, random poses per addition.
        radius: a pose is tabu within this largest joint difference of a listed one [rad or m].
        length: of the list.
        patience: failures in a row to stop after, as a multiple of m.
        evaluations: most evaluations of one pose's local search.
    """

    candidates: int = 100
    radius: float = 0.15
    length: int = 100
    patience: float = 2.0
    evaluations: int = 40


DEFAULT_RULE = TabuRule()


def tabu_search(
    space: SearchSpace,
    m: int,
    index: Index = "O1",
    existing: np.ndarray | None = None,
    *,
    seed: int = 0,
    rule: TabuRule = DEFAULT_RULE,
    seconds: float = np.inf,
    report: Callable[[int, float], None] | None = None,
) -> Improved:
    """Return m poses chosen by IMHATR, the method of the module's docstring.

    Args:
        space: limits, constraints, predicate, Jacobian.
        m: number of poses.
        index: the observability index to improve.
        existing: (k, rows, p) Jacobians of poses already measured; None without such poses.
        seed: seed of all draws.
        rule: settings of the tabu search.
        seconds: processor time [s] after which no further pose is exchanged.
        report: called after every step with the number of poses chosen so far and the merit; None for no report.
    """
    generator = np.random.default_rng(seed)
    listed: deque[np.ndarray] = deque(maxlen=rule.length)
    deadline = time.process_time() + seconds
    chosen = list[np.ndarray]()
    history = list[float]()
    spent = 0
    interrupted = False
    try:
        while len(chosen) < m:
            pose, evaluations = _newcomer(space, chosen, index, existing, generator, listed, rule)
            chosen.append(pose)
            spent += evaluations
            history.append(_merit(space, np.array(chosen), index, existing))
            if report:
                report(len(chosen), history[-1])
        spared = set[int]()
        failures = 0
        while failures < rule.patience * m and time.process_time() < deadline:
            out = _least_useful(space, np.array(chosen), index, existing, spared)
            remaining = chosen.copy()
            del remaining[out]
            pose, evaluations = _newcomer(space, remaining, index, existing, generator, listed, rule)
            spent += evaluations
            trial = np.array([*remaining, pose])
            value = _merit(space, trial, index, existing)
            if value > history[-1] + 1e-9:
                chosen[out] = pose
                spared = set[int]()
                failures = 0
                history.append(value)
                if report:
                    report(m, value)
            else:
                failures += 1
                spared = spared | {out}
                if len(spared) >= m:
                    spared = {out}
    except KeyboardInterrupt:
        if len(chosen) < m:
            raise
        interrupted = True
    rising = tuple(history[m - 1 :])
    return Improved(np.array(chosen), history[-1], rising, spent, interrupted)


def _newcomer(
    space: SearchSpace,
    poses: list[np.ndarray],
    index: Index,
    existing: np.ndarray | None,
    generator: np.random.Generator,
    listed: deque[np.ndarray],
    rule: TabuRule,
) -> tuple[np.ndarray, int]:
    """Return a pose (n,) to add to `poses`, improved by a local search, and the number of evaluations used.

    The drawn and the improved pose are added to the tabu list.

    Args:
        space: limits, constraints, predicate, Jacobian.
        poses: (n,) joint values of each pose chosen so far, which remain fixed.
        index: observability index to improve.
        existing: (k, rows, p) Jacobians of poses already measured; None without such poses.
        generator: source of the random poses.
        listed: the tabu list of poses (n,), extended in place.
        rule: settings of the tabu search.
    """

    def allowed(q: np.ndarray) -> np.ndarray:
        good = is_feasible(space, q)
        if listed:
            differences = np.abs(q[:, None] - np.array(listed)).max(2)
            good &= (differences > rule.radius).all(1)
        return good

    draws = draw_candidates(space.lower, space.upper, rule.candidates, allowed, seed=generator, block=256)
    fixed = _fixed(space, poses, existing)
    jacobians = np.asarray(space.jacobian(draws), dtype=float)
    parameters = jacobians.shape[2]
    rows = np.zeros((0, parameters))
    if fixed is not None:
        rows = fixed.reshape(-1, parameters)
    count = len(rows) + jacobians.shape[1]
    full = count >= parameters
    values = np.full(len(jacobians), -np.inf)
    if full:
        for i, jacobian in enumerate(jacobians):
            values[i], _ = merit(np.concatenate([rows, jacobian]), index)
    if not np.isfinite(values).any():  # not of full rank yet: what spans most, by a slightly regular determinant
        spanned = _spanning(rows, jacobians)
        pose = draws[int(spanned.argmax())]
        listed.append(pose)
        return pose, len(draws)
    start = draws[int(values.argmax())]
    run = improved(space, start[None], index, fixed, evaluations=rule.evaluations, tolerance=1e-4, sharpness=(128.0,))
    if run.interrupted:
        raise KeyboardInterrupt
    listed.extend([start, run.q[0]])
    return run.q[0], len(draws) + run.evaluations


def _spanning(rows: np.ndarray, jacobians: np.ndarray) -> np.ndarray:
    """Return log det(εI + information) (K,) of `rows` with each of K Jacobians added, columns scaled by their rms.

    Args:
        rows: (R, p) Jacobian rows of the poses chosen so far.
        jacobians: (K, rows, p) Jacobians of the poses that may be added.
    """
    mean_squares = (jacobians**2).mean((0, 1))
    scale = np.sqrt(mean_squares)
    scale = np.where(scale > 0, scale, 1.0)
    z = jacobians / scale
    scaled_rows = rows / scale
    matrix = scaled_rows.T @ scaled_rows + 1e-6 * np.eye(len(scale))
    matrices = matrix + z.transpose(0, 2, 1) @ z
    _, values = np.linalg.slogdet(matrices)
    return values


def _least_useful(
    space: SearchSpace, q: np.ndarray, index: Index, existing: np.ndarray | None, spared: set[int]
) -> int:
    """Return the index into q of the pose whose removal leaves the largest merit, among the poses not in `spared`.

    Args:
        space: provides the Jacobian.
        q: (m, n) poses chosen so far [rad or m].
        index: observability index of the merit.
        existing: (k, rows, p) Jacobians of poses already measured; None without such poses.
        spared: indices into q of poses that are not removed.
    """
    jacobians = np.asarray(space.jacobian(q), dtype=float)
    parameters = jacobians.shape[2]
    measured_rows = np.zeros((0, parameters))
    if existing is not None:
        measured_rows = existing.reshape(-1, parameters)
    merits = np.full(len(q), -np.inf)
    removable = [i for i in range(len(q)) if i not in spared]
    for i in removable:
        remaining = np.delete(jacobians, i, axis=0).reshape(-1, parameters)
        merits[i], _ = merit(np.concatenate([measured_rows, remaining]), index)
    best = int(merits[removable].argmax())
    return removable[best]


def _fixed(space: SearchSpace, poses: list[np.ndarray], existing: np.ndarray | None) -> np.ndarray | None:
    """Return the Jacobian rows (R, p) of `poses` and of those measured before; `existing` where `poses` is empty.

    Args:
        space: provides the Jacobian.
        poses: (n,) joint values of each pose [rad or m].
        existing: (k, rows, p) Jacobians of poses already measured; None without such poses.
    """
    if not poses:
        return existing
    q = np.array(poses)
    jacobians = np.asarray(space.jacobian(q), dtype=float)
    rows = jacobians.reshape(-1, jacobians.shape[2])
    if existing is None:
        return rows
    return np.concatenate([rows, existing.reshape(-1, rows.shape[1])])


def _merit(space: SearchSpace, q: np.ndarray, index: Index, existing: np.ndarray | None) -> float:
    rows = _fixed(space, list(q), existing)
    if rows is None:
        return -np.inf
    value, _ = merit(rows, index)
    return value

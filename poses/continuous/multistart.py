"""Multistart: the local search from several sets of feasible candidates, in parallel if `map` runs in parallel."""

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from ..continuous.local import Improved, improved
from ..indices import Index
from ..space import SearchSpace


def random_starts(q: np.ndarray, m: int, count: int, seed: int) -> list[np.ndarray]:
    """Return `count` random sets (m, n) of the candidates q (N, n), each drawn by its own generator.

    Args:
        q: (N, n) joint values of the candidates [rad or m].
        m: number of poses in each set, drawn without repetition.
        count: number of sets.
        seed: seed from which the generators of all sets are derived.
    """
    generators = np.random.default_rng(seed).spawn(count)
    return [q[generator.choice(len(q), m, replace=False)] for generator in generators]


def multistart_search(
    space: SearchSpace,
    starts: Sequence[np.ndarray],
    index: Index = "O1",
    existing: np.ndarray | None = None,
    *,
    evaluations: int = 5000,
    seconds: float = np.inf,
    map: Callable = map,
    report: Callable[[int, Improved], None] | None = None,
) -> Improved:
    """Run the local search from every start and return the best result (ties: the first).

    Args:
        space: limits, constraints, Jacobian; must be picklable where `map` runs in other processes.
        starts: sets (m, n) of poses [rad or m].
        index: the observability index to improve.
        existing: (k, rows, p) Jacobians of poses already measured; None without such poses.
        evaluations: largest number of evaluations per start.
        seconds: limit of processor time [s]; where it is finite the starts run in this process, one after another,
            until the time is used up.
        map: the builtin, or a parallel map that returns results in order.
        report: called after each start with its index (from 0) and its result; None for no report.

    Raises:
        ValueError: no starts.
    """
    best = None
    spent = 0
    history = list[float]()
    interrupted = False
    work = partial(_one, space, index, existing, evaluations)
    deadline = time.process_time() + seconds
    if np.isinf(seconds):
        runs = map(work, starts)
    else:
        runs = _in_time(work, starts, deadline)
    try:
        for number, run in enumerate(runs):
            spent += run.evaluations
            if best is None or run.merit > best.merit:
                best = run
            history.append(best.merit)
            interrupted |= run.interrupted
            if report:
                report(number, run)
            if run.interrupted:
                break
    except KeyboardInterrupt:
        if best is None:
            raise
        interrupted = True
    if best is None:
        raise ValueError("multistart needs at least one start")
    return Improved(best.q, best.merit, tuple(history), spent, interrupted)


def _one(
    space: SearchSpace,
    index: Index,
    existing: np.ndarray | None,
    evaluations: int,
    start: np.ndarray,
    seconds: float = np.inf,
) -> Improved:
    return improved(space, start, index, existing, evaluations=evaluations, seconds=seconds)


def _in_time(work: Callable[..., Improved], starts: Sequence[np.ndarray], deadline: float) -> Iterator[Improved]:
    """Yield the results of the searches that begin before `deadline` [s of process time]; the first always runs.

    Args:
        work: runs the search from one start (m, n).
        starts: sets (m, n) of poses [rad or m], in the order of the searches.
        deadline: value of `time.process_time` [s].
    """
    for number, start in enumerate(starts):
        if number and time.process_time() >= deadline:
            return
        yield work(start, seconds=deadline - time.process_time())

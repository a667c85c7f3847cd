"""Search among candidates for the largest determinant (index O1): greedy start, pair exchange, DETMAX excursions."""

import time
from collections.abc import Callable

import numpy as np

from .design import Design, Pool, best_addition, best_removal, design_of, with_added, with_removed
from .swaps import first_swap

# function called with each design of the requested size that is better than all before
Report = Callable[[Design], None]

# smallest gain of log det that is treated as an improvement (our choice)
TOLERANCE = 1e-9
# members for which candidates are compared at once: largest number, and largest number of their products with all
# candidates, which the processor's cache holds
MEMBERS_AT_ONCE = 16
NUMBERS_AT_ONCE = 1_000_000


def greedy(pool: Pool, m: int) -> Design:
    """Return the design of m candidates added one after another, each time the candidate that raises det M most.

    M (p, p) is the information of the chosen candidates and of the poses measured before.

    Args:
        pool: the candidates and the information of the poses measured before.
        m: number of candidates to choose.
    """
    design = design_of(pool, ())
    for _ in range(m):
        candidate, _ = best_addition(pool, design)
        design = with_added(pool, design, candidate)
    return design_of(pool, design.members)


def exchanged(pool: Pool, design: Design, report: Report | None = None, sweeps: int = 50) -> Design:
    """Return the design after replacing members one by one by the best candidate, until no replacement raises det M.

    M is the information matrix of the design. This is the modified Fedorov exchange (Fedorov 1972; one member after
    another: Cook & Nachtsheim 1980). The result is a local optimum: no exchange of one member for one candidate
    improves it.

    Args:
        pool: candidates.
        design: the design to start from.
        report: called with every improved design; None for no report.
        sweeps: largest number of passes over all members.
    """
    max_count = _members_at_once(pool)
    # members in whose place no candidate is better, of the design as it is
    settled: set[int] = set()
    for _ in range(sweeps):
        before = design.logdet
        waiting = [member for member in design.members if member not in settled]
        count = 1
        while waiting:
            block = waiting[:count]
            swap = first_swap(pool, design, block, TOLERANCE)
            if swap is None:
                settled.update(block)
                waiting = waiting[count:]
                count = min(2 * count, max_count)
                continue
            waiting = waiting[block.index(swap.leaving) + 1 :]
            count = max(count // 2, 1)
            design = swap.design
            settled.clear()
            if report:
                report(design)
        design = design_of(pool, design.members)
        if design.logdet <= before + TOLERANCE:
            return design
    return design


def _members_at_once(pool: Pool) -> int:
    rows = pool.z.shape[1]
    numbers = rows**2 * len(pool.z)
    count = min(MEMBERS_AT_ONCE, NUMBERS_AT_ONCE // numbers)
    return max(count, 1)


def detmax(pool: Pool, design: Design, report: Report | None = None, *, longest: int = 6, failures: int = 40) -> Design:
    """Return a design with larger det M, searched by temporarily adding and removing poses (DETMAX).

    M is the information matrix of the design. DETMAX (Mitchell 1974, section 3) makes excursions from the design of m
    poses: candidates are added (the best first) or members removed (the one that costs least first), and then the size
    is brought back to m. The designs passed on an excursion that gained nothing form the failure list. An excursion
    that meets a listed design is lengthened, up to m ± `longest` poses. The method ends when excursions in both
    directions exceed that length, or after `failures` excursions in a row without gain (our addition).

    Args:
        pool: candidates.
        design: start, of m poses.
        report: called with every improved design; None for no report.
        longest: largest number of poses by which an excursion may differ from m.
        failures: number of excursions in a row without gain after which the search ends.
    """
    failed: set[frozenset[int]] = set()
    fruitless = 0
    over = {True: False, False: False}
    upwards = True
    while fruitless < failures and not all(over.values()):
        back, passed = _excursion(pool, design, upwards, longest, failed)
        if back is not None and back.logdet > design.logdet + TOLERANCE:
            design = exchanged(pool, design_of(pool, back.members), sweeps=1)
            failed = set()
            fruitless = 0
            over = {True: False, False: False}
            if report:
                report(design)
            continue
        failed |= passed
        over[upwards] = back is None
        fruitless = fruitless + 1
        upwards = not upwards
    return design


def kicked(
    pool: Pool,
    design: Design,
    rounds: int,
    seed: int,
    report: Report | None = None,
    *,
    size: int = 3,
    weights=None,
    seconds: float = np.inf,
) -> Design:
    """Return the best design after random restarts near the present one.

    Each round replaces `size` random members by random candidates, runs the exchange, and keeps the result if det M is
    larger: iterated local search (Lourenço, Martin & Stützle 2003). New members are drawn with probabilities that rise
    with their relaxed weights, where these are given. The number replaced and the probabilities are our choice.

    Args:
        pool: candidates.
        design: the design to start from.
        rounds: number of restarts.
        seed: seed of the draws.
        report: called with every improved design; None for no report.
        size: number of members replaced in one restart.
        weights: (N,) relaxed weights; None for equal probabilities.
        seconds: processor time [s] after which no further restart begins.
    """
    deadline = time.process_time() + seconds
    generator = np.random.default_rng(seed)
    m = len(design.members)
    count = len(pool.z)
    if weights is None:
        share = np.full(count, 1.0)
    else:
        share = weights + 1e-3 * m / count
    size = min(size, m, count - m)
    for _ in range(rounds if size > 0 else 0):
        if time.process_time() > deadline:
            break
        leaving = set(generator.choice(design.members, size, replace=False).tolist())
        free = np.flatnonzero(~design.taken)
        probability = share[free] / share[free].sum()
        coming = generator.choice(free, size, replace=False, p=probability)
        remaining = [k for k in design.members if k not in leaving]
        members = remaining + coming.tolist()
        trial = exchanged(pool, design_of(pool, tuple(members)))
        if trial.logdet > design.logdet + TOLERANCE:
            design = trial
            if report:
                report(design)
    return design


def _excursion(
    pool: Pool, start: Design, upwards: bool, longest: int, failed: set[frozenset[int]]
) -> tuple[Design | None, set[frozenset[int]]]:
    """Return the design at the end of one DETMAX excursion, and the sets of members passed on the way.

    The design is None if the excursion exceeds m ± `longest` poses.

    Args:
        pool: the candidates.
        start: design of m poses from which the excursion starts.
        upwards: True adds poses first, False removes poses first.
        longest: largest number of poses by which the excursion may differ from m.
        failed: failure list: sets of members passed on earlier excursions without gain.
    """
    m = len(start.members)
    passed = set[frozenset[int]]()
    design = start
    larger = upwards
    while True:
        size = len(design.members) + (1 if larger else -1)
        if abs(size - m) > longest or size < 1 or size > len(pool.z):
            return None, passed
        design = _step(pool, design, larger)
        if size == m:
            return design, passed
        key = frozenset(design.members)
        outwards = key in failed or key in passed  # the second clause is ours: without it an excursion can circle
        passed.add(key)
        larger = (size > m) == outwards


def _step(pool: Pool, design: Design, add: bool) -> Design:
    if add:
        candidate, _ = best_addition(pool, design)
        return with_added(pool, design, candidate)
    member, _ = best_removal(pool, design)
    return with_removed(pool, design, member)

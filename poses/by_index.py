"""Exchange of candidates for any observability index, evaluated from the singular values of every set tried."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .indices import Index, index_of_singular_values, log_slope

# called with every improved set and its merit
Report = Callable[[tuple[int, ...], float], None]

# smallest gain of log O that counts (our choice)
TOLERANCE = 1e-9


class LocalOptimum(NamedTuple):
    """Set of candidates that no exchange tried improves.

    Attributes:
        members: indices of the candidates.
        merit: log O of the set (−log cond; O1 without 1/√m).
        trials: number of sets whose index was computed on the way.
    """

    members: tuple[int, ...]
    merit: float
    trials: int


def exchanged_by_index(
    jacobians: np.ndarray,
    known_information: np.ndarray,
    members: tuple[int, ...],
    index: Index,
    report: Report | None = None,
    *,
    sweeps: int = 20,
    screen: int = 32,
) -> LocalOptimum:
    """Return the set after replacing members one by one by candidates until no replacement tried improves the index.

    For O2-O5 and cond there is no determinant lemma: each set tried costs the eigenvalues of a p × p matrix. Only two
    groups of candidates are therefore tried for each member: those with the largest first-order gain tr(J_i G J_iᵀ), G
    = ∂ log O / ∂M with M the information matrix of the set, and those with the largest tr(J_i M⁻² J_iᵀ). The second is
    the gain of A-optimality, which also works where several singular values equal the smallest one. These two groups
    and their size are our choice; the result is a local optimum among the exchanges tried only.

    Args:
        jacobians: (N, rows, p) Jacobians J_i of the N candidates, each row divided by its standard deviation.
        known_information: (p, p) information Σ J_iᵀJ_i of the poses already measured; zeros for no such poses.
        members: indices of the candidates to start from.
        index: observability index O to improve, "O1" ... "O5" or "cond" (`calib.poses.indices`).
        report: called with the indices of every improved set and its merit; None for no report.
        sweeps: largest number of passes over all members.
        screen: number of candidates tried per member from each of the two groups.
    """
    chosen = list(members)
    matrix = known_information + _gram(jacobians[chosen])
    best = float(merits(matrix[None], index)[0])
    trial_count = 0
    for _ in range(sweeps):
        before = best
        for position in range(len(chosen)):
            thinned = matrix - _gram(jacobians[chosen[position]][None])
            trials = _screened(jacobians, matrix, chosen, index, screen)
            # every candidate is a member
            if not len(trials):
                continue
            trial_count += len(trials)
            candidate_rows = jacobians[trials]
            trial_information = thinned + candidate_rows.transpose(0, 2, 1) @ candidate_rows
            trial_merits = merits(trial_information, index)
            if trial_merits.max() > best + TOLERANCE:
                best = float(trial_merits.max())
                chosen[position] = int(trials[trial_merits.argmax()])
                matrix = known_information + _gram(jacobians[chosen])
                if report:
                    report(tuple(chosen), best)
        if best <= before + TOLERANCE:
            break
    return LocalOptimum(tuple(chosen), best, trial_count)


def kicked_by_index(
    jacobians: np.ndarray,
    known_information: np.ndarray,
    start: LocalOptimum,
    index: Index,
    trials: int,
    seed: int,
    report: Report | None = None,
    *,
    screen: int = 8,
    seconds: float = np.inf,
) -> LocalOptimum:
    """Return the best set after random kicks: swap members for random candidates, exchange, keep the better set.

    Iterated local search (Lourenço, Martin & Stützle 2003), as `calib.poses.exchange.kicked` for O1: indices of single
    singular values have many more local optima. Two members up to half of them are swapped; that law and the smaller
    screening are our choice. Effort is counted in trial sets, so that the same seed gives the same set on any machine.

    Args:
        jacobians, known_information, index, report: as in `exchanged_by_index`.
        start: the set to start from.
        trials: trial sets after which no further kick begins.
        seed: seed of the draws.
        screen: number of trials per member and screening rule after a kick.
        seconds: processor time after which no further kick begins.
    """
    deadline = time.process_time() + seconds
    generator = np.random.default_rng(seed)
    best = start
    count = len(start.members)
    all_candidates = np.arange(len(jacobians))
    largest = min(max(2, count // 2), count, len(jacobians) - count)
    spent = 0
    while largest > 0 and spent < trials and time.process_time() < deadline:
        size = int(generator.integers(min(2, largest), largest, endpoint=True))
        nonmembers = np.setdiff1d(all_candidates, best.members)
        staying = generator.choice(best.members, count - size, replace=False)
        coming = generator.choice(nonmembers, size, replace=False)
        kicked = tuple(np.concatenate([staying, coming]).astype(int).tolist())
        trial = exchanged_by_index(jacobians, known_information, kicked, index, screen=screen)
        spent += max(1, trial.trials)
        if trial.merit > best.merit + TOLERANCE:
            best = trial
            if report:
                report(best.members, best.merit)
    return best


def merits(matrices: np.ndarray, index: Index) -> np.ndarray:
    """Return the merits log O (−log cond) (K,) of K information matrices (K, p, p); −inf where a matrix is singular.

    Columns may have very different units, so the results are accurate only while the ratio of the smallest to the
    largest singular value is well above 1e-7.

    Args:
        matrices: (K, p, p) information matrices WᵀW of K sets of poses.
        index: observability index O, "O1" ... "O5" or "cond"; O1 without its factor 1/√m.
    """
    values = np.linalg.eigvalsh(matrices)[:, ::-1]
    regular = values[:, -1] > 1e-14 * values[:, 0]
    out = np.full(len(matrices), -np.inf)
    s = np.sqrt(values[regular])
    indices = index_of_singular_values(s, index, 1)
    sign = -1.0 if index == "cond" else 1.0
    out[regular] = np.log(indices) * sign
    return out


def _screened(jacobians: np.ndarray, matrix: np.ndarray, chosen: list[int], index: Index, screen: int) -> np.ndarray:
    values, vectors = np.linalg.eigh(matrix)
    floor = 1e-14 * values[-1]
    s = np.sqrt(np.maximum(values[::-1], floor))
    sign = -1.0 if index == "cond" else 1.0
    rows = jacobians.reshape(-1, jacobians.shape[2])
    flat = rows @ vectors[:, ::-1]
    squares = (flat**2).reshape(jacobians.shape).sum(1)
    trials = set[int]()
    first_order_gains = squares @ (sign * log_slope(s, index) / (2 * s))
    a_optimality_gains = squares @ s**-4.0
    for scores in (first_order_gains, a_optimality_gains):
        scores[chosen] = -np.inf
        ranked = np.argsort(-scores, kind="stable")
        trials |= set(ranked[:screen].tolist())
    return np.array(sorted(trials - set(chosen)))


def _gram(jacobians: np.ndarray) -> np.ndarray:
    rows = jacobians.reshape(-1, jacobians.shape[-1])
    return rows.T @ rows

"""Outer optimisation: path parameters φ for a shorter duration, with fixed waypoints.

Two kinds of parameters change a spline through m waypoints: the spacing of its knots (m - 2 ratios), and a via point in
the middle of each interval, which may differ from the first spline by up to `stray` (n parameters each). The duration
is continuous in φ but not smooth, since the active limit changes. The search therefore uses linear models over a
simplex (Powell 1994, nlopt's COBYLA; of three methods tried it needed the fewest evaluations). Where velocity limits
are active, only a few percent can be gained.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..errors import BadInput, NothingFeasible
from ..timing.path import Path, checked, spline

RATIO = 3.0  # knots lie at most this factor nearer or further apart than by chord length
STEP = 0.3  # first step, of the range -1 to 1

Timer = Callable[[Path], float]


@dataclass(frozen=True, eq=False)
class Shaped:
    """Result of the search for a path of shorter duration.

    Attributes:
        path: the fastest path.
        phi: (p,) path parameters φ of `path`, each from -1 to 1.
        before, after: durations [s] of the path at φ = 0 (the spline through the waypoints without via points), and of
            `path`.
        evaluations: number of paths timed.
        refused: number of the timed paths that have no timing within the limits.
    """

    path: Path
    phi: np.ndarray
    before: float
    after: float
    evaluations: int
    refused: int


def count(waypoints: np.ndarray, stray: float) -> int:
    """Return the number of path parameters φ that change a path: ratios of knot intervals, and offsets of via points.

    Args:
        waypoints: (m, n) joint values.
        stray: largest offset of a via point [rad or m]; with 0, via points are not counted.
    """
    m, n = np.shape(waypoints)
    parameters = m - 2
    if stray > 0:
        parameters += (m - 1) * n
    return parameters


def build(waypoints: np.ndarray, phi: np.ndarray, stray: float = 0.0) -> Path:
    """Return the path through the waypoints for parameters φ, each from -1 to 1.

    Args:
        waypoints: (m, n) joint values [rad or m].
        phi: φ (p,), log ratios of knot intervals, then the offsets of the via points as shares of `stray`.
        stray: largest offset of a via point from the first spline in each joint [rad or m]; 0 for no via points.
    """
    points = checked(waypoints)
    m, n = points.shape
    ratios = np.asarray(phi)[: m - 2]
    factors = RATIO ** np.append(0.0, ratios)
    if stray <= 0:
        return spline(points, factors)
    first = spline(points)
    middles = (first.knots[:-1] + first.knots[1:]) / 2
    offsets = np.reshape(phi[m - 2 :], (m - 1, n))
    middle = first(middles) + stray * offsets
    pieces = np.empty((2 * m - 1, n))
    pieces[::2] = points
    pieces[1::2] = middle
    return spline(pieces, np.repeat(factors, 2))


def shorten(
    waypoints: np.ndarray,
    timer: Timer,
    evaluations: int = 150,
    stray: float = 0.0,
    progress: Callable[[int, float], None] | None = None,
) -> Shaped:
    """Return the fastest path through the waypoints after at most `evaluations` timed paths.

    Args:
        waypoints: (m, n) joint values [rad or m].
        timer: function that returns the duration [s] of a path, and raises `NothingFeasible` or `BadInput` where no
            timing exists.
        evaluations: largest number of paths timed.
        stray: largest offset of a via point from the spline of φ = 0, in each joint [rad or m]; 0 for no via points.
        progress: called with the number of evaluations and the best duration [s]; None for no report. Ctrl-C ends the
            search with the best path so far.

    Raises:
        BadInput: negative `stray`, or no evaluations.
    """
    import nlopt

    if not (np.isfinite(stray) and stray >= 0) or evaluations < 1:
        raise BadInput(f"stray {stray:g}, {evaluations} evaluations: expected stray >= 0 and evaluations >= 1")
    p = count(waypoints, stray)
    first = build(waypoints, np.zeros(p), stray)
    before = timer(first)
    best = [before, np.zeros(p)]
    tally = [1, 0]

    def duration(phi: np.ndarray, _: np.ndarray) -> float:
        tally[0] += 1
        try:
            shorter = timer(build(waypoints, phi, stray))
        except (NothingFeasible, BadInput):
            tally[1] += 1
            return 10 * before
        if shorter < best[0]:
            best[:] = [shorter, phi.copy()]
        if progress is not None:
            progress(tally[0], best[0])
        return shorter

    if p:
        search = nlopt.opt(nlopt.LN_COBYLA, p)
        search.set_lower_bounds(np.full(p, -1.0))
        search.set_upper_bounds(np.full(p, 1.0))
        search.set_initial_step(STEP)
        search.set_maxeval(evaluations)
        search.set_xtol_abs(1e-4)
        search.set_min_objective(duration)
        try:
            search.optimize(np.zeros(p))
        except (KeyboardInterrupt, nlopt.ForcedStop):
            pass
        except nlopt.RoundoffLimited:
            pass
    shortest, phi = best
    timed, refused = tally
    return Shaped(build(waypoints, phi, stray), phi, before, shortest, timed, refused)

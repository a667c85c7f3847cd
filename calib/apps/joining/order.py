"""Which pose of a robot each measured point belongs to, found from the nominal arm.

A point p of pose i is S (a_i + R_i t) + noise: a_i, R_i the nominal tip, S the instrument's placement, t the target in
the tip's frame. Distances between points depend on neither the order nor S: t is first chosen so that the sorted
distances between the predicted points agree with those between the measured ones; triples of poses whose three
distances are those of three measured points each give a placement (random sample consensus, Fischler and Bolles 1981);
the best placements are refined, in turns: points to poses by the assignment of least cost (clipped, so that gross
errors do not count), then S and t by least squares.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import linear_sum_assignment, minimize
from scipy.spatial.distance import cdist, pdist, squareform

from calib.data.poses.measurements import PoseMeasurements
from calib.errors import CalibError
from calib.geometry.first_guess import install
from calib.robot.chain import Chain
from calib.robot.kinematics import forward

MAX_MISFIT = 0.02  # of the arm's length: what nominal errors leave in the right order, at most (our choice)
MIN_POINTS = 6  # below which an order is not checked: placing instrument and target takes all they say (our choice)
MIN_FOUND = 12  # below which no order is looked for: of 10 points in 40 poses, one in twelve was wrong
AMBIGUOUS = 3.0  # another pose is possible if its point is nearer than so many rms residuals (our choice)
STARTS, TRIPLES, KEPT = 6, 12, 8  # tools to start from, measured triples, placements that are refined (our choice)
TOOLS = [np.array(tool) for tool in product((-0.1, 0.0, 0.1), repeat=3)]  # tried where these fail [m] (our choice)
MAX_ROUNDS = 10  # of an assignment and a placement (our choice)
SCORED = 15  # points that a placement is scored by (our choice)
MAX_TRIPLES = 20_000  # of poses that are compared with one triple of points (our choice)


@dataclass(frozen=True, eq=False)
class Order:
    """Poses that m points belong to.

    Attributes:
        pose: (m,) index of each point's pose, -1 where it belongs to none; several readings of one pose share it.
        error: (m,) distance of each point from the nominal arm's point in that pose [m].
        rivals: points that could as well belong to another pose: their indices.
        how: how the order was found, in words.
    """

    pose: np.ndarray
    error: np.ndarray
    rivals: tuple[int, ...] = ()
    how: str = ""

    @property
    def rms(self) -> float:
        """Root mean square of the errors [m], of the points that belong to a pose."""
        return float(np.sqrt(np.mean(self.error[self.pose >= 0] ** 2)))


def find_order(chain: Chain, q: np.ndarray, points: np.ndarray, candidates: dict[str, np.ndarray]) -> Order | None:
    """Return which of the poses q (n, joints) each of the points (m, 3) [m] belongs to; None if no order explains them.

    Args:
        chain: the nominal arm.
        candidates: orders to try first, in words → (m,) index of each point's pose, -1 where it does not say.
    """
    arm, limit = forward(chain, q), MAX_MISFIT * chain.stretched_length()
    for origin, pose in candidates.items():
        assigned = np.flatnonzero(pose >= 0)
        predicted = _predicted(chain, q, points, pose, assigned) if len(assigned) >= MIN_POINTS else None
        if predicted is None or np.median(np.linalg.norm(predicted[pose[assigned]] - points[assigned], axis=1)) > limit:
            continue
        order = _refined(chain, q, points, pose, limit, prefer=pose)
        if order is not None and np.mean(order.pose[pose >= 0] == pose[pose >= 0]) > 0.5:
            return Order(order.pose, order.error, how=origin)
    good = list[Order]()
    for tools in (_tools(arm, points), TOOLS):
        for pose in _by_distances(arm, points, tools) if not good and len(points) >= MIN_FOUND else ():
            if (order := _refined(chain, q, points, pose, limit)) is not None:
                good.append(order)
                if np.mean(order.pose >= 0) > 0.9:
                    break
    if not good:
        return None
    best = max(good, key=lambda candidate: (int((candidate.pose >= 0).sum()), -candidate.rms))
    return Order(best.pose, best.error, best.rivals, "found from the nominal geometry")


def _refined(
    chain: Chain, q: np.ndarray, points: np.ndarray, pose: np.ndarray, limit: float, prefer: np.ndarray | None = None
) -> Order | None:
    """Return the order that a first order leads to, None if most of the points then belong to no pose."""
    for _ in range(MAX_ROUNDS):
        assigned = np.flatnonzero(pose >= 0)
        if len(assigned) < MIN_POINTS or (predicted := _predicted(chain, q, points, pose, assigned)) is None:
            return None
        cost = cdist(points, predicted)
        bound = max(limit, 3.0 * float(np.median(cost[assigned, pose[assigned]])))  # wide at first
        before, pose = pose, _assigned(cost, bound, prefer)
        if np.array_equal(before, pose):
            break
    nearest = np.argmin(cost, axis=1)
    pose = np.where((pose < 0) & (cost.min(axis=1) < limit), nearest, pose)  # read again
    error = cost[np.arange(len(points)), pose]
    pose = np.where(error < limit, pose, -1)
    if np.mean(pose >= 0) < 0.5:
        return None
    order = Order(pose, error)
    other_cost = np.where(np.arange(len(q)) == pose[:, None], np.inf, cost).min(axis=1)
    doubtful = (pose >= 0) & (other_cost < np.maximum(AMBIGUOUS * order.rms, error))
    return Order(pose, error, tuple(np.flatnonzero(doubtful).tolist()))


def _predicted(
    chain: Chain, q: np.ndarray, points: np.ndarray, pose: np.ndarray, assigned: np.ndarray
) -> np.ndarray | None:
    """Return the points (n, 3) of all poses after placing instrument and target by the `assigned` points."""
    block = PoseMeasurements.of(q[pose[assigned]], points[assigned], joint_names=chain.joint_names)
    try:
        cell = install(chain, [block])
    except CalibError:
        return None
    return (cell.stations[0] @ forward(chain, q) @ cell.tools[0])[:, :3, 3]


def _assigned(cost: np.ndarray, bound: float, prefer: np.ndarray | None) -> np.ndarray:
    """Return the pose (m,) of each point by the assignment of least total clipped cost; -1 at costs beyond `bound`."""
    clipped = np.minimum(cost, bound)
    if prefer is not None:  # a stated order holds wherever it is possible
        rows = np.flatnonzero(prefer >= 0)
        rows = rows[cost[rows, prefer[rows]] < bound]
        clipped[rows, prefer[rows]] = -bound
    pose = np.full(len(cost), -1)
    row, column = linear_sum_assignment(clipped)
    pose[row] = np.where(cost[row, column] < bound, column, -1)
    return pose


def _by_distances(arm: np.ndarray, points: np.ndarray, tools: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield orders to start from, by distances between points: the best of many triples of poses."""
    rng, scored = np.random.default_rng(0), list[tuple[float, np.ndarray, np.ndarray]]()
    few = rng.permutation(len(points))[:SCORED]
    for tool in tools:
        predicted = arm[:, :3, 3] + arm[:, :3, :3] @ tool
        between, bound = squareform(pdist(predicted)), 0.06 * float(np.linalg.norm(np.std(points, axis=0)))
        for triple in _wide_triples(points, rng):
            poses = _similar(between, points[triple], bound, rng)
            if not len(poses):
                continue
            placed = _moved(points[triple], predicted[poses], points)
            nearest = cdist(placed[:, few].reshape(-1, 3), predicted).min(axis=1).reshape(len(placed), -1)
            score = np.median(nearest, axis=1)
            scored += [(float(score[k]), placed[k], predicted) for k in np.argsort(score)[:KEPT]]
    scored.sort(key=lambda start: start[0])
    for _, placed, predicted in scored[:KEPT]:
        yield _assigned(cdist(placed, predicted), np.inf, None)


def _tools(arm: np.ndarray, points: np.ndarray) -> list[np.ndarray]:
    """Return offsets (3,) of the target in the tip's frame [m] with which distances between points agree best."""
    share = np.linspace(0.02, 0.98, 60)
    measured = np.quantile(pdist(points), share)

    def misfit(tool: np.ndarray) -> float:
        return float(np.mean(np.abs(np.quantile(pdist(arm[:, :3, 3] + arm[:, :3, :3] @ tool), share) - measured)))

    starts = 0.15 * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    optima = [minimize(misfit, start, method="Nelder-Mead", options={"maxfev": 150}) for start in starts]
    return [np.zeros(3), *(optimum.x for optimum in sorted(optima, key=lambda optimum: optimum.fun)[: STARTS - 1])]


def _wide_triples(points: np.ndarray, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield triples of points (indices) that span large triangles."""
    drawn = np.array([rng.permutation(len(points))[:3] for _ in range(20 * TRIPLES)])
    a, b, c = np.moveaxis(points[drawn], 1, 0)
    yield from drawn[np.argsort(-np.linalg.norm(np.cross(b - a, c - a), axis=1))[:TRIPLES]]


def _similar(between: np.ndarray, triangle: np.ndarray, bound: float, rng: np.random.Generator) -> np.ndarray:
    """Return triples (k, 3) of poses whose distances differ by less than `bound` from those of a triangle (3, 3)."""
    ab, ac, bc = pdist(triangle)
    a, b = np.nonzero(np.abs(between - ab) < bound)
    max_pairs = max(MAX_TRIPLES * 50 // len(between), 1)
    if len(a) > max_pairs:
        keep = rng.permutation(len(a))[:max_pairs]
        a, b = a[keep], b[keep]
    pair, c = np.nonzero((np.abs(between[a] - ac) < bound) & (np.abs(between[b] - bc) < bound))
    return np.column_stack([a[pair], b[pair], c])[:MAX_TRIPLES]


def _moved(triangle: np.ndarray, targets: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the points (k, m, 3) after the motions that lay a triangle (3, 3) on each target (k, 3, 3)."""
    centre, middle = triangle.mean(axis=0), targets.mean(axis=1)
    u, _, vt = np.linalg.svd(np.einsum("kia,ib->kab", targets - middle[:, None], triangle - centre))
    sign = np.ones((len(targets), 3))
    sign[:, 2] = np.linalg.det(u @ vt)
    return np.einsum("kab,mb->kma", (u * sign[:, None, :]) @ vt, points - centre) + middle[:, None]

"""Assignment of measured points to a robot's poses, found from the nominal arm's geometry.

A point p measured at pose i is S (a_i + R_i t) + noise, with a_i, R_i the nominal tip, S the instrument's placement,
and t the target in the tip's frame. Distances between points depend on neither the order nor S. First, t is chosen so
that the sorted distances between the predicted points agree with those between the measured ones. Then a triple of
poses and a triple of measured points with the same three distances give a candidate for S (random sample consensus,
Fischler and Bolles 1981). The best candidates are refined by alternating two steps: points are assigned to poses with
least total cost (clipped, so that gross errors have no influence), and S and t are fitted by least squares.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import linear_sum_assignment, minimize
from scipy.spatial.distance import cdist, pdist, squareform

from calib.errors import CalibError
from calib.toolkit.chains import Chain, forward
from calib.toolkit.installations import install
from calib.toolkit.pose_data import PoseMeasurements

# Thresholds are our choice.
# largest misfit of the right order due to the errors of the nominal arm, as a share of the arm's length
MAX_MISFIT = 0.02
# smallest number of points to check an order: fewer points suffice only to place instrument and target
MIN_POINTS = 6
# smallest number of points to search for an order: of orders found for 10 points in 40 poses, one in twelve was wrong
MIN_FOUND = 12
# another pose is possible if its predicted point is nearer than this number of rms residuals
AMBIGUOUS = 3.0
# number of tool positions to start from, of triples of measured points, and of placements that are refined
STARTS, TRIPLES, REFINED = 6, 12, 8
# tool positions that are tried where those do not lead to an order [m]
TOOLS = [np.array(tool) for tool in product((-0.1, 0.0, 0.1), repeat=3)]
# largest number of iterations of assignment and placement
MAX_ROUNDS = 10
# number of points by which the misfit of a placement is computed
SCORED = 15
# largest number of triples of poses that are compared with one triple of points
MAX_TRIPLES = 20_000


@dataclass(frozen=True, eq=False)
class Order:
    """Assignment of m measured points to poses.

    Attributes:
        pose: (m,) index of each point's pose, -1 for none; several readings of one pose have the same index.
        error: (m,) distance of each point from the point that the nominal arm predicts for that pose [m].
        rivals: indices of points that another pose explains nearly as well, with an error below `AMBIGUOUS` times the
            rms.
        origin: how the order was found, in words.
    """

    pose: np.ndarray
    error: np.ndarray
    rivals: tuple[int, ...] = ()
    origin: str = ""

    @property
    def rms(self) -> float:
        """Root mean square of the errors of all points that are assigned to a pose [m]."""
        errors = self.error[self.pose >= 0]
        return float(np.sqrt(np.mean(errors**2)))


def find_order(chain: Chain, q: np.ndarray, points: np.ndarray, candidates: dict[str, np.ndarray]) -> Order | None:
    """Return the assignment of points (m, 3) [m] to the poses q (n, joints); None if no order explains the points.

    Args:
        chain: the nominal arm.
        q: joint values of the poses [rad or m].
        points: measured positions.
        candidates: orders that are tried first: description of the order to (m,) index of each point's pose, -1 for
            none.
    """
    limit = MAX_MISFIT * chain.stretched_length()
    for origin, pose in candidates.items():
        assigned = np.flatnonzero(pose >= 0)
        if len(assigned) < MIN_POINTS:
            continue
        predicted = _predicted(chain, q, points, pose, assigned)
        if predicted is None:
            continue
        distance = np.linalg.norm(predicted[pose[assigned]] - points[assigned], axis=1)
        if np.median(distance) > limit:
            continue
        order = _refined(chain, q, points, pose, limit, prefer=pose)
        if order is not None and np.mean(order.pose[assigned] == pose[assigned]) > 0.5:
            return Order(order.pose, order.error, origin=origin)
    if len(points) < MIN_FOUND:
        return None

    arm = forward(chain, q)
    orders = _orders_from(chain, q, points, _by_distances(arm, points, _tools(arm, points)), limit)
    if not orders:
        orders = _orders_from(chain, q, points, _by_distances(arm, points, TOOLS), limit)
    if not orders:
        return None
    best = max(orders, key=lambda order: (int((order.pose >= 0).sum()), -order.rms))
    return Order(best.pose, best.error, best.rivals, "joined by geometry, which found their order")


def _orders_from(
    chain: Chain, q: np.ndarray, points: np.ndarray, starts: Iterable[np.ndarray], limit: float
) -> list[Order]:
    """Return the orders refined from each start, up to the first order that assigns nearly all points to poses.

    Args:
        chain: the nominal arm.
        q: (n, joints) joint values of the poses [rad or m].
        points: (m, 3) measured positions [m].
        starts: orders to begin from, each (m,) the index of each point's pose, -1 for none.
        limit: largest distance of a point from its pose's predicted point [m].
    """
    orders = list[Order]()
    for pose in starts:
        order = _refined(chain, q, points, pose, limit)
        if order is None:
            continue
        orders.append(order)
        if np.mean(order.pose >= 0) > 0.9:
            break
    return orders


def _refined(
    chain: Chain, q: np.ndarray, points: np.ndarray, pose: np.ndarray, limit: float, prefer: np.ndarray | None = None
) -> Order | None:
    """Return the order refined from the start `pose` (m,); None if most points are then assigned to no pose.

    Args:
        chain: the nominal arm.
        q: joint values of the poses [rad or m].
        points: measured positions (m, 3) [m].
        pose: index of each point's pose, -1 for none.
        limit: largest distance of a point from its pose's predicted point [m].
        prefer: (m,) poses that are taken where they are possible, -1 for none; None: no preference.
    """
    rounds = 0
    while True:
        assigned = np.flatnonzero(pose >= 0)
        if len(assigned) < MIN_POINTS:
            return None
        predicted = _predicted(chain, q, points, pose, assigned)
        if predicted is None:
            return None
        cost = cdist(points, predicted)
        # wide at first
        bound = max(limit, 3.0 * float(np.median(cost[assigned, pose[assigned]])))
        before = pose
        pose = _assigned(cost, bound, prefer)
        rounds += 1
        if np.array_equal(before, pose) or rounds == MAX_ROUNDS:
            break
    # several readings of one pose
    repeated = (pose < 0) & (cost.min(axis=1) < limit)
    pose = np.where(repeated, np.argmin(cost, axis=1), pose)
    error = cost[np.arange(len(points)), pose]
    pose = np.where(error < limit, pose, -1)
    if np.mean(pose >= 0) < 0.5:
        return None

    rms = Order(pose, error).rms
    is_assigned = np.arange(len(q)) == pose[:, None]
    second_cost = np.where(is_assigned, np.inf, cost).min(axis=1)
    doubtful = (pose >= 0) & (second_cost < np.maximum(AMBIGUOUS * rms, error))
    return Order(pose, error, tuple(np.flatnonzero(doubtful).tolist()))


def _predicted(
    chain: Chain, q: np.ndarray, points: np.ndarray, pose: np.ndarray, assigned: np.ndarray
) -> np.ndarray | None:
    """Return the predicted points (n, 3) [m] of all poses, in the instrument's frame.

    Instrument and target are placed by least squares over the assigned points.

    Args:
        chain: the nominal arm.
        q: (n, joints) joint values of the poses [rad or m].
        points: (m, 3) measured positions [m].
        pose: (m,) index of each point's pose.
        assigned: indices or mask of the points to use.

    Returns:
        The points; None if the assigned points do not determine the placement.
    """
    block = PoseMeasurements.of(q[pose[assigned]], points[assigned], joint_names=chain.joint_names)
    try:
        cell = install(chain, [block])
    except CalibError:
        return None
    poses = cell.stations[0] @ forward(chain, q) @ cell.tools[0]
    return poses[:, :3, 3]


def _assigned(cost: np.ndarray, bound: float, prefer: np.ndarray | None) -> np.ndarray:
    """Return the pose (m,) of each point by the assignment of least total clipped cost; -1 for costs above `bound`.

    Args:
        cost: (m, n) cost of assigning each point to each pose: their distance [m].
        bound: value at which costs are clipped.
        prefer: (m,) poses that are taken where their cost is below `bound`, -1 for none; None: no preference.
    """
    clipped = np.minimum(cost, bound)
    if prefer is not None:
        # a stated order holds wherever it is possible
        rows = np.flatnonzero(prefer >= 0)
        rows = rows[cost[rows, prefer[rows]] < bound]
        clipped[rows, prefer[rows]] = -bound
    pose = np.full(len(cost), -1)
    row, column = linear_sum_assignment(clipped)
    pose[row] = np.where(cost[row, column] < bound, column, -1)
    return pose


def _by_distances(arm: np.ndarray, points: np.ndarray, tools: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield start orders (m,) from the best of many triples of poses whose distances match those of measured points.

    Args:
        arm: (n, 4, 4) poses of the nominal arm's tip.
        points: (m, 3) measured positions [m].
        tools: possible positions (3,) of the target in the tip's frame [m], to be tried one after the other.
    """
    rng = np.random.default_rng(0)
    scored_points = rng.permutation(len(points))[:SCORED]
    bound = 0.06 * float(np.linalg.norm(np.std(points, axis=0)))
    placements = list[tuple[float, np.ndarray, np.ndarray]]()
    for tool in tools:
        predicted = _tool_points(arm, tool)
        between = squareform(pdist(predicted))
        for triple in _wide_triples(points, rng):
            poses = _similar(between, points[triple], bound, rng)
            if not len(poses):
                continue
            placed = _moved(points[triple], predicted[poses], points)
            distances = cdist(placed[:, scored_points].reshape(-1, 3), predicted)
            nearest = distances.min(axis=1).reshape(len(placed), -1)
            score = np.median(nearest, axis=1)
            for k in np.argsort(score)[:REFINED]:
                placements.append((float(score[k]), placed[k], predicted))
    placements.sort(key=lambda placement: placement[0])
    for _, placed, predicted in placements[:REFINED]:
        yield _assigned(cdist(placed, predicted), np.inf, None)


def _tool_points(arm: np.ndarray, tool: np.ndarray) -> np.ndarray:
    """Return the positions (n, 3) [m] of a point fixed to the tip.

    Args:
        arm: (n, 4, 4) poses of the tip.
        tool: (3,) coordinates of the point in the tip's frame [m].
    """
    return arm[:, :3, 3] + arm[:, :3, :3] @ tool


def _tools(arm: np.ndarray, points: np.ndarray) -> list[np.ndarray]:
    """Return possible positions (3,) of the target in the tip's frame [m].

    For these, the distances between predicted points are distributed most like those between measured points.

    Args:
        arm: (n, 4, 4) poses of the nominal arm's tip.
        points: (m, 3) measured positions [m].
    """
    share = np.linspace(0.02, 0.98, 60)
    measured = np.quantile(pdist(points), share)

    def misfit(tool: np.ndarray) -> float:
        predicted = np.quantile(pdist(_tool_points(arm, tool)), share)
        return float(np.mean(np.abs(predicted - measured)))

    starts = 0.15 * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    optima = [minimize(misfit, start, method="Nelder-Mead", options={"maxfev": 150}) for start in starts]
    optima.sort(key=lambda optimum: optimum.fun)
    return [np.zeros(3), *(optimum.x for optimum in optima[: STARTS - 1])]


def _wide_triples(points: np.ndarray, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield triples of indices of points that span large triangles.

    Args:
        points: (m, 3) positions [m].
        rng: generator for the choice of triples.
    """
    drawn = np.array([rng.permutation(len(points))[:3] for _ in range(20 * TRIPLES)])
    a, b, c = np.moveaxis(points[drawn], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    largest = np.argsort(-areas)[:TRIPLES]
    yield from drawn[largest]


def _similar(between: np.ndarray, triangle: np.ndarray, bound: float, rng: np.random.Generator) -> np.ndarray:
    """Return triples (k, 3) of poses whose mutual distances match those of a triangle (3, 3) within `bound`.

    Args:
        between: (n, n) distances between the poses' predicted points [m].
        triangle: corners of the triangle [m].
        bound: largest accepted difference of a distance [m].
        rng: generator for the choice among many pairs.
    """
    ab, ac, bc = pdist(triangle)
    a, b = np.nonzero(np.abs(between - ab) < bound)
    max_pairs = max(MAX_TRIPLES * 50 // len(between), 1)
    if len(a) > max_pairs:
        drawn = rng.permutation(len(a))[:max_pairs]
        a, b = a[drawn], b[drawn]
    near_ac = np.abs(between[a] - ac) < bound
    near_bc = np.abs(between[b] - bc) < bound
    pair, c = np.nonzero(near_ac & near_bc)
    return np.column_stack([a[pair], b[pair], c])[:MAX_TRIPLES]


def _moved(triangle: np.ndarray, targets: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the points after the rigid motions that map a triangle (3, 3) onto each of k triangles: (k, m, 3).

    Args:
        triangle: corners of the triangle.
        targets: (k, 3, 3) corners of the triangles onto which it is moved.
        points: (m, 3) points to move.
    """
    centre = triangle.mean(axis=0)
    middle = targets.mean(axis=1)
    covariance = np.einsum("kia,ib->kab", targets - middle[:, None], triangle - centre)
    u, _, vt = np.linalg.svd(covariance)
    # rotations, no reflections
    sign = np.ones((len(targets), 3))
    sign[:, 2] = np.linalg.det(u @ vt)
    rotations = (u * sign[:, None, :]) @ vt
    return np.einsum("kab,mb->kma", rotations, points - centre) + middle[:, None]

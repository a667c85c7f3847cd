"""Expected position error of a fitted arm at any pose: from its parameters' covariance and from the model's errors.

    E |e(q)|² = κ trace J Σ Jᵀ + s(q) v_0 + v_1 d(q)² + v_2 g(q)²

with Σ the parameters' covariance, d the distance of q from the nearest pose of the fit and g that from
the ranges of single joints that were, every joint counting by its lever [m]. s says where errors are larger than
elsewhere (`calib.geometry.left_out`). κ and v are the most probable ones of errors on held-out rows: at
random (near), by regions or stations, and by the ends of every joint's range (far); both kinds count alike. The radius
that holds 95 % comes of the same rows' errors in units of that sigma (`calib.geometry.left_out`): nothing
is said of their distribution. It goes from that of the near rows to that of the far ones as d² + g² goes from the
median of the ones to that of the others, and is larger outside the range of a joint, by what that end of it showed when
it was left out; sigmas are stated in units of the larger radius.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.blas import dtrsm  # type: ignore[attr-defined]
from scipy.spatial import KDTree

from calib.data.poses.measurements import PoseMeasurements, Positions, take
from calib.estimation.relevance import SETTLED, Gram, condensed, gram, relevance
from calib.geometry.fit import plausible_deviation
from calib.geometry.installation import Installation
from calib.geometry.left_out import LeftOut, Profile, unevenness
from calib.geometry.many_corrections import position_variances
from calib.geometry.model_choice.cross_validation import project_out, term_groups, term_sizes
from calib.geometry.model_choice.folds import Folds, random_folds
from calib.geometry.model_choice.ladder import MAX_RESIDUAL, ModelSelection
from calib.geometry.observation import layout, observe, prepare
from calib.records import evenly
from calib.robot.calibrated import Deflection
from calib.robot.chain import Chain
from calib.robot.kinematics import forward

END_SHARE = 0.2  # share of the poses at each end of a joint's range that is left out (our choice)


@dataclass(frozen=True)
class Discrepancy:
    """Parameters of the error model, estimated on held-out rows.

    Attributes:
        parameters: κ, the factor of the variance due to the parameters.
        floor: v_0 [m²], error variance at the fitted poses for s = 1, with the instrument's noise.
        far: v_1 [m²/m²], per squared distance from the nearest of them.
        beyond: v_2 [m²/m²], per squared distance from the ranges of their joints.
        radii: number of sigmas that contained 95 % of the errors on held-out rows, near and far.
        reach: median of d² + g² of the near rows, and of the far ones [m²].
        levers: (n,) by how much the tool moves with each joint [m/rad or 1], rms over the poses.
        profile: log s by joint; empty for equal errors everywhere.
        placed: the radii if base and tool are fitted to the rows; None if equal to `radii`.
        wider: widening factors of the interval below and above each joint's range; empty if unknown.
    """

    parameters: float
    floor: float
    far: float
    beyond: float
    radii: tuple[float, float]
    reach: tuple[float, float]
    levers: tuple[float, ...]
    profile: Profile = ()
    placed: tuple[float, float] | None = None
    wider: tuple[tuple[float, float], ...] = ()

    @property
    def radius(self) -> float:
        """Half-width of the 95 % interval, in standard deviations."""
        return max(self.radii)


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """Model of the expected tool position error of a fitted arm.

    Attributes:
        cell: the installation.
        free, covariance: of its parameters (`calib.geometry.observation`).
        learnt: (m, n) poses of the fit [rad or m].
        discrepancy: see `Discrepancy`.
    """

    cell: Installation
    free: np.ndarray
    covariance: np.ndarray
    learnt: np.ndarray
    discrepancy: Discrepancy

    def position_sigma(self, rows: PoseMeasurements, station: int = 0, tool: np.ndarray | int = 0) -> np.ndarray:
        """Return the expected tool position error (m,) [m] at poses: its standard deviation, all axes together.

        Args:
            rows: joint values (m, n), and gravity torques for compliance terms.
            station: index of the station of reference; -1 for the arm's base.
            tool: which of its tools, one or (m,).
        """
        own = position_variances(self.cell, rows, self.free, self.covariance, station, tool)
        return self._sigma(own, rows.q)

    def sigma_on(self, cell: Installation, block: Positions, placed_anew: bool = False) -> np.ndarray:
        """Return `position_sigma` at the poses of measured rows (m,) [m].

        Args:
            cell: the installation that predicts them: that of the fit, or one placed anew.
            block: m rows.
            placed_anew: whether base and tool were placed on these very rows; then errors that a placement takes up
                do not count.
        """
        ready = prepare(cell, [block])[0]
        if not placed_anew:
            return self.position_sigma(block, ready.station, ready.tool)
        own, now = layout(self.cell), layout(cell)
        kinds = np.array(own.kinds)[self.free]
        stays = ~np.isin(kinds, ("station", "tool"))
        where = self.free[stays] + np.where(kinds[stays] == "arm", 0, len(now.names) - len(own.names))
        columns = np.concatenate([now.frame_index, where])
        jacobian = next(part.jacobian for part in observe(cell, ready, columns) if part.label == "position")
        frames = len(now.frame_index)
        jacobian = project_out(jacobian, np.arange(frames))[frames:]
        values, vectors = np.linalg.eigh(self.covariance[np.ix_(stays, stays)])
        root = vectors * np.sqrt(np.clip(values, 0.0, None))
        spread = (root.T @ jacobian.reshape(len(root), 3 * len(block))).reshape(len(root), 3, len(block))
        return self._sigma(np.sum(spread**2, axis=(0, 1)), block.q, self.discrepancy.placed)

    def _sigma(self, own: np.ndarray, q: np.ndarray, radii: tuple[float, float] | None = None) -> np.ndarray:
        """Return `position_sigma` (m,) [m] from the variance due to the parameters, trace J Σ Jᵀ (m,) [m²]."""
        found, parts = self.discrepancy, _distances(q, self.learnt, np.array(self.discrepancy.levers))
        rest = unevenness(found.profile, q) * found.floor + found.far * parts[0] + found.beyond * parts[1]
        radius = np.interp(parts[0] + parts[1], found.reach, radii or found.radii)
        radius *= self._wider(q) if radii is None else 1.0
        return np.sqrt(found.parameters * own + rest) * radius / found.radius

    def _wider(self, q: np.ndarray) -> np.ndarray:
        """Return the widening factors (m,) of intervals outside the ranges: in full beyond half the width of an end."""
        result = np.ones(len(q))
        for j, most in enumerate(self.discrepancy.wider):
            low, first, last, high = np.quantile(self.learnt[:, j], [0.0, END_SHARE, 1.0 - END_SHARE, 1.0])
            for far, end, factor in ((low - q[:, j], first - low, most[0]), (q[:, j] - high, high - last, most[1])):
                share = np.clip(2.0 * far / max(end, 1e-9), 0.0, 1.0)
                result = np.maximum(result, 1.0 + (factor - 1.0) * share)
        return result


def outside(q: np.ndarray, learnt: np.ndarray) -> np.ndarray:
    """Return a mask (m, n) of the joint values q (m, n) outside the range of the fitted poses (k, n)."""
    return np.asarray((q < learnt.min(axis=0)) | (q > learnt.max(axis=0)))


def _variances(precision: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the diagonal (k,) of Jᵀ P⁻¹ J for columns J (p, k), from a precision matrix P with unit diagonal."""
    try:
        factor = np.linalg.cholesky(precision + 1e-12 * np.eye(len(precision)))
    except np.linalg.LinAlgError:  # by rounding; Cholesky is five times as fast
        values, vectors = np.linalg.eigh(precision)
        spread = columns.T @ vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    else:
        spread = dtrsm(1.0, factor.T, columns.T, side=1)  # rows (L⁻¹ J)ᵀ, without copies
    return np.einsum("kp,kp->k", spread, spread)


def _distances(q: np.ndarray, learnt: np.ndarray, levers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared distances (m,) [m²] of poses from the nearest fitted pose, and from each joint's range.

    The latter is, joint by joint, the way to where `near_share` of the learnt poses are within reach: a few of them far
    off the others do not say how a joint is there.
    """
    nearest = np.asarray(KDTree(learnt * levers).query(q * levers)[0]) ** 2
    alone, count = np.zeros(len(q)), len(learnt)
    near_share = 0.02  # share of the poses (our choice)
    some = int(np.clip(round(near_share * count), 1, count))
    for j, lever in enumerate(levers):
        values = np.sort(learnt[:, j])
        low, high = values[: count - some + 1], values[some - 1 :]  # ends of all that are `some` values wide
        middle = np.searchsorted(low + high, 2.0 * q[:, j])  # before it the low end is the further one
        before, after = np.maximum(middle - 1, 0), np.minimum(middle, count - some)
        way = np.minimum(*(np.maximum(np.abs(low[at] - q[:, j]), np.abs(high[at] - q[:, j])) for at in (before, after)))
        alone += (lever * way) ** 2
    return nearest, alone


def _joint_levers(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return how far the tip moves per unit of each joint (n,) [m/rad or 1], rms over poses."""
    rows = q[evenly(len(q), 50)]
    result, step = np.zeros(chain.n), 1e-4
    for j in range(chain.n):
        move = np.zeros(chain.n)
        move[j] = step
        way = forward(chain, rows + move)[:, :3, 3] - forward(chain, rows - move)[:, :3, 3]
        result[j] = np.sqrt(np.mean(np.sum(way**2, axis=1))) / (2.0 * step)
    return np.maximum(result, 0.05)


def learn_errors(selected: ModelSelection, measured: Sequence[PoseMeasurements], seed: int = 0) -> ErrorModel | None:
    """Return the error model, estimated from the errors on held-out rows; None if too few positions were measured.

    For every fold the geometry and the ridges of all chosen effects are estimated anew: ridges from all rows would
    depend on the held-out rows. With a robust loss, rows beyond `MAX_RESIDUAL` robust sigmas do not count.

    Args:
        selected: the model and its fit of all rows.
        measured: the blocks it was fitted to.
        seed: of the random folds.
    """
    found = selected.fit
    min_poses = 20  # poses from which errors on rows left out are worth a model (our choice)
    if sum(len(block) for block in measured) < min_poses or not all(isinstance(block, Positions) for block in measured):
        return None
    q = np.concatenate([block.q for block in measured])
    levers = _joint_levers(found.cell.chain, q)
    rows = _Rows(selected, measured)
    near = [*rows.left_out(random_folds(measured, 5, seed), levers)]
    groups = [(-1, selected.folds), *_range_folds(measured)]
    far = [(joint, errors) for joint, each in groups for errors in rows.left_out(each, levers)]
    left = LeftOut.of(near, [errors for _, errors in far], [joint for joint, _ in far])
    left, profile = left.scaled(rows.poses)
    weights, radii = left.learnt()
    low, high = (float(np.median(left.away[of])) for of in (left.near, ~left.near))
    reach = low, max(high, low * (1.0 + 1e-9) + 1e-12)
    wider = left.surprise(weights, reach)
    wide = radii[0] * wider[0], radii[1] * wider[1]
    outside = left.wider(weights, wide, reach, rows.poses)
    kappa, floor, near_by, beyond = weights
    lengths = tuple(levers.tolist())
    known = Discrepancy(kappa, floor, near_by, beyond, wide, reach, lengths, profile, radii, outside)
    return ErrorModel(found.cell, found.free, found.estimate.covariance, q, known)


def _range_folds(measured: Sequence[PoseMeasurements]) -> list[tuple[int, Folds]]:
    """Return, for each joint, its index and the two folds that hold out the ends of its range."""
    q = np.concatenate([block.q for block in measured])
    edges, result = np.cumsum([len(block) for block in measured])[:-1], []
    for j in range(q.shape[1]):
        low, high = np.quantile(q[:, j], [END_SHARE, 1.0 - END_SHARE])
        if high - low < 1e-6:
            continue
        fold = np.where(q[:, j] < low, 0, np.where(q[:, j] > high, 1, 2))
        result.append((j, Folds("ranges", 2, tuple(np.split(fold, edges)))))
    return result


class _Rows:
    """Residuals and Jacobians of a fit's rows at the rigid geometry, from which folds are evaluated."""

    def __init__(self, selected: ModelSelection, measured: Sequence[PoseMeasurements]):
        found, terms = selected.fit, selected.offered
        max_poses = 1500  # poses that folds are judged by (our choice)
        every = max(1, -(-sum(map(len, measured)) // max_poses))
        self.chosen = [np.arange(0, len(block), every) for block in measured]
        self.measured = [take(block, rows) for block, rows in zip(measured, self.chosen)]
        self.pose, poses = [], []
        for block in self.measured:
            _, first, which = np.unique(block.together, return_index=True, return_inverse=True)
            self.pose.append(which + sum(map(len, poses)))
            poses.append(block.q[first])
        self.poses = np.concatenate(poses)
        gross = set() if selected.loss == "none" else {(file, row) for file, row, *_ in found.outliers(MAX_RESIDUAL)}
        self.counts = [np.array([(b.file, int(row)) not in gross for row in b.rows], bool) for b in self.measured]
        cell = found.cell
        if terms:
            cell = replace(cell, deflection=Deflection(terms, np.zeros(len(terms)), selected.nominal.cell.chain))
        table = layout(cell)
        terms_index = table.index("deflection")
        own = np.flatnonzero(~np.isin(found.free, terms_index))
        self.free = np.concatenate([found.free[own], terms_index])
        self.station = np.flatnonzero(np.isin(self.free, table.index("station")))
        wide = plausible_deviation(cell, self.free[: len(own)])
        if found.prior is not None:
            wide = np.minimum(wide, found.prior[own])
        prior_sigma = 1.0  # what is known beforehand of a parameter that a fold does not tell [m, rad] (our choice)
        self.prior = np.where(np.isfinite(wide), wide, prior_sigma)
        scales, weights = found.used_sigmas(), found.row_weights()
        self.whitened: list[list[tuple[np.ndarray, np.ndarray]]] = []
        self.metric: list[tuple[np.ndarray, np.ndarray]] = []
        for number, ready in enumerate(prepare(cell, self.measured)):
            parts = observe(cell, ready, self.free)
            root = np.sqrt(weights[number][self.chosen[number]])
            self.whitened.append(
                [
                    (each.value * root / scales[number][each.label], each.jacobian * root / scales[number][each.label])
                    for each in parts
                ]
            )
            self.metric.append(next((each.value, each.jacobian) for each in parts if each.label == "position"))
        total = sum((self._gram(k, slice(None)) for k in range(1, len(self.measured))), self._gram(0, slice(None)))
        groups = np.concatenate([np.full(len(own), -1), term_groups(terms)]).astype(int)
        start = np.concatenate([np.ones(len(own)), term_sizes(terms)])
        self.coordinates = condensed(lambda columns: total.square[np.ix_(columns, columns)], groups, start)
        self.total, columns = self.coordinates.gram(total), self.coordinates.columns
        self.whitened = [[(value, columns(jacobian)) for value, jacobian in block] for block in self.whitened]
        self.metric = [(value, columns(jacobian)) for value, jacobian in self.metric]

    def _gram(self, block: int, rows: np.ndarray | slice) -> Gram:
        each = [
            gram(value[:, rows].ravel(), jacobian[:, :, rows].reshape(len(jacobian), -1).T)
            for value, jacobian in self.whitened[block]
        ]
        return sum(each[1:], each[0])

    def left_out(self, folds: Folds, levers: np.ndarray) -> Iterator[np.ndarray]:
        """Yield each fold's rows (rows, 5): |e|², trace J Σ Jᵀ, two squared distances to other rows, pose number."""
        free, sizes, space = np.arange(len(self.prior)), self.coordinates.sizes, self.coordinates
        for fold in range(folds.count):
            inside = [np.flatnonzero(members[rows] == fold) for members, rows in zip(folds.members, self.chosen)]
            if not 0 < sum(map(len, inside)) < sum(map(len, self.measured)):
                continue
            data = self.total
            for number, rows in enumerate(inside):
                if len(rows):
                    data = data - self._gram(number, rows)
            square = data.square.copy()
            square[free, free] += 1.0 / self.prior**2
            found = relevance(replace(data, square=square), space.groups, sizes, 8, SETTLED, space.counts)
            own = np.isfinite(found.ridge) & (found.ridge > 0.0)
            sizes = np.where(own, found.ridge, space.sizes)  # where the next fold's search begins
            alive = np.flatnonzero(found.ridge > 0.0)
            precision = square[np.ix_(alive, alive)] / found.noise**2 + np.diag(found.ridge[alive] ** -2.0)
            scale = 1.0 / np.sqrt(np.diag(precision))
            precision *= np.outer(scale, scale)
            learnt = np.concatenate([np.delete(b.q, rows, axis=0) for b, rows in zip(self.measured, inside)])
            stays = {b.station for b, rows in zip(self.measured, inside) if len(rows) < len(b)}
            for number, rows in enumerate(inside):
                if not len(rows):
                    continue
                value, jacobian = (each[..., rows] for each in self.metric[number])
                if self.measured[number].station not in stays:
                    both = project_out(np.concatenate([jacobian, value[None]]), self.station)
                    jacobian, value = both[:-1], both[-1]
                error = value - np.einsum("f,fim->im", found.values, jacobian)
                own = _variances(precision, scale[:, None] * jacobian[alive].reshape(len(alive), -1))
                near = _distances(self.measured[number].q[rows], learnt, levers)
                size, pose = np.sum(error**2, axis=0), self.pose[number][rows]
                result = np.stack([size, own.reshape(3, -1).sum(axis=0), *near, pose], axis=1)
                yield result[self.counts[number][rows]]

"""Expected errors at new poses, estimated from errors on held-out rows: variance model and 95 % intervals.

The 95 % interval is a quantile at the level (n + 1) / n · 95 % over n poses (conformal prediction; Vovk, Gammerman &
Shafer 2005). The same held-out rows were used to estimate the variances. Intervals are therefore widened until they
contain 95 % of the errors in a fold whose poses were not used for the variances. They are not widened where base and
tool are placed on the judged rows, since the placement then compensates errors that the rows of a fold share.

Outside a joint's range, the errors beyond one end are similar to each other, so that each end counts as one sample, not
each pose. z is the rms error at an end that was held out, in units of its interval. The error beyond that end is exp(m
+ LASTING (log z - m) + CHANGE ε), with m the mean of log z over the ends and ε normal. On five real recordings, fitted
without 60 ends of joint ranges, LASTING was 0.48 ± 0.16 and CHANGE 0.33, and m was unbiased.

The variance of errors depends on the pose. Its logarithm is modelled as a sum of one function per joint,

    log s(q) = Σ_j f_j(q_j),    f_j ~ GP(0, a_j² exp(-|Δ| / (CORRELATION_LENGTH · range)))

estimated by regression of the logarithms of squared errors on joint values (Harvey 1976, Econometrica 44:
multiplicative heteroscedasticity). Each a_j has its most probable value (`calib.estimation.relevance`), which is 0
where a joint has no influence. The stated value is exp(E f + var f / 2), the mean of s; it is larger where few or no
poses were measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from calib.estimation.relevance import SETTLED, Gram, gram, relevance
from calib.estimation.robust import ROUNDS, variance_weights

# number of values of a joint's function, which is linear between them (our choice)
KNOTS = 9
# correlation length of a joint's function, as a share of the joint's range (our choice)
CORRELATION_LENGTH = 0.5
# extension of the function beyond each end of the range, as a share of the range (our choice)
KNOT_MARGIN = 0.2
# squared errors are raised to this share of their median (our choice)
MIN_SQUARE = 0.02
# smallest variance of a logarithm: without it, copies of few poses would be fitted without any error
MIN_VARIANCE = 1e-4
# smallest motion of a joint for which its function is estimated [rad or m]
MIN_MOTION = 1e-3
# initial a_j of the search, and largest number of its iterations
FIRST_SIZE = 0.5
SEARCH_ROUNDS = 30
# share of the errors that an interval has to contain
COVERED = 0.95
# LASTING and CHANGE of the module's docstring: share of an end's excess that persists beyond it, and standard
# deviation of the remaining change, both of logarithms
LASTING = 0.5
CHANGE = 0.33
# smallest number of rows of each kind outside a fold to estimate an interval (our choice)
MIN_ROWS = 5
# smallest number of held-out ends of ranges to estimate their mean (our choice)
MIN_ENDS = 3
# largest number of iterations of the search for variances without a fold's poses
FOLD_ROUNDS = 100
# smallest expected squared error [m²]
SMALLEST_VARIANCE = 1e-30

# for each joint: joint values, and log s at these values
Profile = tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]


def unevenness(profile: Profile, q: np.ndarray) -> np.ndarray:
    """Return the factor s (m,) by which the error variance at poses q (m, n) is larger than on average.

    1 for an empty profile.

    Args:
        profile: log s as one function per joint; s is the exponential of their sum.
        q: (m, n) joint values [rad or m].
    """
    log_factor = np.zeros(len(q))
    for joint, (knots, values) in enumerate(profile):
        log_factor = log_factor + np.interp(q[:, joint], knots, values)
    return np.exp(log_factor)


class Unevenness:
    """Estimate of the factor s(q), by which the error variance at q is larger than on average, from squared errors.

    Args:
        q: (m, n) poses [rad or m].
        squares: (m,) squared errors at these poses, divided by the variance expected for s = 1.
    """

    def __init__(self, q: np.ndarray, squares: np.ndarray):
        low = q.min(axis=0)
        high = q.max(axis=0)
        grid = np.linspace(-KNOT_MARGIN, 1.0 + KNOT_MARGIN, KNOTS)
        self.moving = np.flatnonzero(high - low > MIN_MOTION)
        self.joints = q.shape[1]
        self.knots = low + np.outer(grid, high - low)
        root = np.linalg.cholesky(np.exp(-np.abs(grid[:, None] - grid) / CORRELATION_LENGTH))
        # per joint, hat functions at its knots, times the root of their prior covariance
        columns = [np.ones((len(q), 1))]
        for joint in self.moving:
            position = q[:, joint]
            knots = self.knots[:, joint]
            hats = [np.interp(position, knots, unit) for unit in np.eye(KNOTS)]
            columns.append(np.stack(hats, axis=1) @ root)
        self.columns = np.concatenate(columns, axis=1)
        mean = self.columns[:, 1:].mean(axis=0)
        self.columns[:, 1:] -= mean
        self.bases = [root - means for means in mean.reshape(-1, KNOTS)]
        group_of_knot = np.repeat(np.arange(len(self.moving)), KNOTS)
        self.groups = np.concatenate([[-1], group_of_knot])
        least = max(MIN_SQUARE * np.median(squares), 1e-300)
        self.logs = np.log(np.maximum(squares, least))
        self.data = gram(self.logs, self.columns)

    def profile(self, left_out: np.ndarray | None = None) -> Profile:
        """Return log s as one function per joint, estimated from all poses or without those in the mask `left_out`
        (m,).
        """
        data = self.data
        if left_out is not None:
            data = data - gram(self.logs[left_out], self.columns[left_out])
        result = [((0.0,), (0.0,))] * self.joints
        for joint, values in zip(self.moving, self._values(data)):
            if values.any():
                result[joint] = (tuple(self.knots[:, joint].tolist()), tuple(values.tolist()))
        return tuple(result)

    def _values(self, data: Gram) -> list[np.ndarray]:
        """Return E f + var f / 2 at the knots of each joint that moves, f being the joint's function in log s.

        Args:
            data: statistics of the squared errors for the values of all functions at their knots.
        """
        data = replace(data, total=data.total + MIN_VARIANCE * data.rows)
        sizes = np.full(len(self.groups), FIRST_SIZE)
        estimate = relevance(data, self.groups, sizes, SEARCH_ROUNDS, SETTLED)
        alive = np.flatnonzero(estimate.ridge > 0.0)
        information = data.square[np.ix_(alive, alive)] / estimate.noise**2
        precision = information + np.diag(estimate.ridge[alive] ** -2.0)
        covariance = np.zeros_like(data.square)
        covariance[np.ix_(alive, alive)] = np.linalg.inv(precision)
        values = []
        for number, basis in enumerate(self.bases):
            columns = slice(1 + number * KNOTS, 1 + (number + 1) * KNOTS)
            variance = np.einsum("ij,jk,ik->i", basis, covariance[columns, columns], basis)
            values.append(basis @ estimate.values[columns] + 0.5 * variance)
        return values


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Errors on held-out rows, as samples for the error model.

    Attributes:
        squares: (m,) |e|² [m²].
        shapes: (m, 4) quantities on which the variance depends linearly: trace J Σ Jᵀ, the factor s (at first 1), and
            the squared distances from the fitted poses and from the joints' fitted ranges.
        away: (m,) sum of the two squared distances [m²].
        pose: (m,) number of the pose.
        fold: (m,) number of the fold.
        near: (m,) True where the row was held out at random.
        joint: (m,) joint of which an end of the range was held out; -1 for none.
    """

    squares: np.ndarray
    shapes: np.ndarray
    away: np.ndarray
    pose: np.ndarray
    fold: np.ndarray
    near: np.ndarray
    joint: np.ndarray

    @classmethod
    def of(cls, near: Sequence[np.ndarray], far: Sequence[np.ndarray], joints: Sequence[int]) -> LeftOut:
        """Return the errors from one array (rows, 5) per fold, with the columns of `calib.geometry.error_model`.

        The columns are |e|² [m²] of the position error e, its variance due to the parameters [m²], squared distances
        from the fitted poses and from the joints' fitted ranges [m²], and the index of the pose.

        Args:
            near: arrays of the folds held out at random.
            far: arrays of the other folds.
            joints: for each fold of `far`, the joint of which an end of the range was held out; -1 for none.
        """
        folds = [*near, *far]
        rows = np.concatenate(folds)
        fold = np.repeat(np.arange(len(folds)), [len(errors) for errors in folds])
        distances = rows[:, 2:4]
        joint_of_fold = np.array([-1] * len(near) + list(joints))
        shapes = np.column_stack([rows[:, 1], np.ones(len(rows)), distances])
        return cls(
            squares=rows[:, 0],
            shapes=shapes,
            away=distances.sum(axis=1),
            pose=rows[:, 4].astype(int),
            fold=fold,
            near=fold < len(near),
            joint=joint_of_fold[fold],
        )

    def without(self, poses: np.ndarray) -> LeftOut:
        """Return the errors without the rows of the given poses.

        Args:
            poses: numbers of the poses.
        """
        rows = ~np.isin(self.pose, poses)
        return LeftOut(
            squares=self.squares[rows],
            shapes=self.shapes[rows],
            away=self.away[rows],
            pose=self.pose[rows],
            fold=self.fold[rows],
            near=self.near[rows],
            joint=self.joint[rows],
        )

    def scaled(self, q: np.ndarray) -> tuple[LeftOut, Profile]:
        """Return the errors with the variance term of `shapes` replaced by s(q), and the estimate of log s itself.

        For each fold, s is estimated from the poses of the other folds.

        Args:
            q: (poses, n) [rad or m].
        """
        weights, _ = self.learnt()
        squares = (self.squares / self._variances(weights))[self.near]
        poses, number = np.unique(self.pose[self.near], return_inverse=True)
        mean_squares = np.bincount(number, squares) / np.bincount(number)
        estimate = Unevenness(q[poses], mean_squares)
        shapes = self.shapes.copy()
        for fold in np.unique(self.fold):
            rows = self.fold == fold
            profile = estimate.profile(np.isin(poses, self.pose[rows]))
            shapes[rows, 1] = unevenness(profile, q[self.pose[rows]])
        return replace(self, shapes=shapes), estimate.profile()

    def learnt(self, start: Sequence[float] = ()) -> tuple[list[float], tuple[float, float]]:
        """Return κ, v_0, v_1, v_2, estimated from |e|² ~ variance · χ²_3 / 3, and the near and far 95 % radii.

        κ, v_0, v_1, v_2 are the weights of the columns of `shapes` in the variance of the error e; a radius is a number
        of standard deviations.

        Args:
            start: values from which the search starts; empty for values from the errors' median.
        """
        rounds = FOLD_ROUNDS
        if not start:
            rounds = ROUNDS
            median = float(np.median(self.squares))
            per_distance = 0.3 * median / np.maximum(self.shapes[:, 2:].mean(axis=0), 1e-12)
            start = [1.0, median, *per_distance]
        # both kinds of rows count alike
        near_count = max(1, round(np.sum(~self.near) / np.sum(self.near)))
        counts = np.where(self.near, near_count, 1.0)
        weights = variance_weights(self.squares, self.shapes, np.array(start), counts, rounds)
        sizes = np.sqrt(self.squares / self._variances(weights))
        return weights.tolist(), self.quantiles(sizes)

    def _variances(self, weights: np.ndarray | Sequence[float]) -> np.ndarray:
        """Return the expected variance (m,) [m²] of each error, for weights κ, v_0, v_1, v_2 of the `shapes`."""
        return np.maximum(self.shapes @ np.asarray(weights), SMALLEST_VARIANCE)

    def quantiles(self, sizes: np.ndarray) -> tuple[float, float]:
        """Return the bounds below which 95 % of future errors lie, for near and far rows, from error magnitudes (m,).

        They are conformal quantiles, as in the module's docstring.

        Args:
            sizes: (m,) error magnitudes, divided by the standard deviations expected for them.
        """
        poses = len(np.unique(self.pose))
        level = min(1.0, COVERED * (poses + 1) / poses)
        near_bound = float(np.quantile(sizes[self.near], level))
        far_bound = float(np.quantile(sizes[~self.near], level))
        return near_bound, far_bound

    def surprise(self, weights: Sequence[float], reach: tuple[float, float]) -> tuple[float, float]:
        """Return the factors (near, far), at least 1, by which intervals must widen to contain 95 % of a fold's errors.

        The intervals of a fold are estimated without its poses.

        Args:
            weights: κ, v_0, v_1, v_2 from which the search starts.
            reach: median of `away` over the near rows, and over the far rows [m²].
        """
        ratio = np.ones(len(self.squares))
        for fold in np.unique(self.fold):
            rows = self.fold == fold
            others = self.without(self.pose[rows])
            if min(others.near.sum(), (~others.near).sum()) <= MIN_ROWS:
                continue
            fold_weights, radii = others.learnt(weights)
            sigma = np.sqrt(np.maximum(self.shapes[rows] @ fold_weights, SMALLEST_VARIANCE))
            radius = np.interp(self.away[rows], reach, radii)
            ratio[rows] = np.sqrt(self.squares[rows]) / (sigma * radius)
        near_factor, far_factor = self.quantiles(ratio)
        return max(1.0, near_factor), max(1.0, far_factor)

    def wider(
        self, weights: Sequence[float], radii: tuple[float, float], reach: tuple[float, float], q: np.ndarray
    ) -> tuple[tuple[float, float], ...]:
        """Return the factors by which intervals widen beyond the lower and the upper end of each joint's range.

        Args:
            weights, radii, reach: parameters of the interval, as in `calib.geometry.error_model.Discrepancy`.
            q: (poses, n) [rad or m].

        Returns:
            (below, above) for each joint; empty where too few ends of ranges were held out.
        """
        sigma = np.sqrt(self._variances(weights))
        sizes = np.sqrt(self.squares) / (sigma * np.interp(self.away, reach, radii))
        side = (q > np.median(q, axis=0))[self.pose, self.joint].astype(int)
        joints, sides, sizes_of_ends = [], [], []
        for joint in range(q.shape[1]):
            for end in (0, 1):
                end_sizes = sizes[(self.joint == joint) & (side == end)]
                if len(end_sizes) > MIN_ROWS:
                    joints.append(joint)
                    sides.append(end)
                    sizes_of_ends.append(end_sizes)
        if len(sizes_of_ends) < MIN_ENDS:
            return ()
        rms = np.array([np.sqrt(np.mean(end_sizes**2)) for end_sizes in sizes_of_ends])
        mean = np.mean(np.log(rms))
        changes = np.exp(CHANGE * ndtri((np.arange(99) + 0.5) / 99))
        relative = [end_sizes / end_rms for end_sizes, end_rms in zip(sizes_of_ends, rms)]
        quantile = np.quantile(np.outer(np.concatenate(relative), changes), COVERED)
        expected = np.exp(mean + LASTING * (np.log(rms) - mean)) * quantile
        result = np.ones((q.shape[1], 2))
        result[joints, sides] = np.maximum(expected, 1.0)
        return tuple((float(below), float(above)) for below, above in result)

"""Expected errors at new poses, learnt from errors on held-out rows: variance model and 95 % intervals.

A quantile is taken at the level (n + 1) / n · 95 % of n poses (conformal prediction; Vovk, Gammerman & Shafer 2005). As
those rows have also chosen the variances, an interval is as much wider as it has to be to hold 95 % of a fold whose
poses took no part in it. Not where base and tool are placed on the rows: what errors of a fold share is taken up then.

Errors outside a joint's range are one draw per end of it, not one per pose. With z the rms error of an end left out, in
units of its interval, that beyond the end is exp(m + LASTING (log z - m) + CHANGE ε), m the mean of log z over the
ends, ε normal: 60 ends of joints that five real recordings were fitted without gave 0.48 ± 0.16 and 0.33, m unbiased.

Where errors are larger than elsewhere: the logarithm of their variance as a sum of one function per joint.

    log s(q) = Σ_j f_j(q_j),    f_j ~ GP(0, a_j² exp(-|Δ| / (CORRELATION_LENGTH · range)))

by regression of the logarithms of squared errors on joint values (Harvey 1976, Econometrica 44: multiplicative
heteroscedasticity), every a_j at its most probable (`calib.estimation.relevance`): 0 where a joint has no influence.
Stated is exp(E f + var f / 2), the mean of s: it is larger where few poses, or none, were measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from calib.estimation.relevance import SETTLED, Gram, gram, relevance
from calib.estimation.robust import ROUNDS, variance_weights

KNOTS = 9  # values per joint, linear in between (our choice)
CORRELATION_LENGTH = 0.5  # how far one value speaks for others, of the range (our choice)
KNOT_MARGIN = 0.2  # how far the function is stated outside the range, of it (our choice)
MIN_SQUARE = 0.02  # of the median squared error: smaller ones count as that (our choice)
MIN_VARIANCE = 1e-4  # variance of a logarithm that is known best: copies of few poses would be fitted without any error
MIN_MOTION = 1e-3  # a joint that moves by less tells nothing [rad or m]
SEARCH_ROUNDS = 30  # of the search for the a_j

Profile = tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]  # per joint: its values, log s there


def unevenness(profile: Profile, q: np.ndarray) -> np.ndarray:
    """Return the factor s (m,) of the error variance at poses q (m, n) [rad or m]; 1 for an empty profile."""
    return np.exp(sum((np.interp(q[:, j], *each) for j, each in enumerate(profile)), np.zeros(len(q))))


class Unevenness:
    """Estimate of the factor s from squared errors.

    Args:
        q: (m, n) poses [rad or m].
        squares: (m,) squared errors there, in units of those expected of an even arm.
    """

    def __init__(self, q: np.ndarray, squares: np.ndarray):
        low, high = q.min(axis=0), q.max(axis=0)
        grid = np.linspace(-KNOT_MARGIN, 1.0 + KNOT_MARGIN, KNOTS)
        self.moving = np.flatnonzero(high - low > MIN_MOTION)
        self.joints = q.shape[1]
        self.knots = low + np.outer(grid, high - low)
        root = np.linalg.cholesky(np.exp(-np.abs(grid[:, None] - grid) / CORRELATION_LENGTH))
        hats = [
            np.stack([np.interp(q[:, j], self.knots[:, j], one) for one in np.eye(KNOTS)], axis=1) for j in self.moving
        ]
        columns = np.concatenate([np.ones((len(q), 1)), *(each @ root for each in hats)], axis=1)
        mean = columns[:, 1:].mean(axis=0)
        columns[:, 1:] -= mean
        self.bases = [root - each for each in mean.reshape(-1, KNOTS)]
        self.groups = np.concatenate([[-1], np.repeat(np.arange(len(self.moving)), KNOTS)])
        self.columns, self.logs = columns, np.log(np.maximum(squares, max(MIN_SQUARE * np.median(squares), 1e-300)))
        self.data = gram(self.logs, self.columns)

    def profile(self, left_out: np.ndarray | None = None) -> Profile:
        """Return log s as one function per joint, from all poses or without those of a mask (m,)."""
        data = self.data if left_out is None else self.data - gram(self.logs[left_out], self.columns[left_out])
        values = dict(zip(self.moving.tolist(), self._values(data)))
        return tuple(
            (tuple(self.knots[:, j].tolist()), tuple(values[j].tolist()))
            if j in values and values[j].any()
            else ((0.0,), (0.0,))
            for j in range(self.joints)
        )

    def _values(self, data: Gram) -> list[np.ndarray]:
        data = replace(data, total=data.total + MIN_VARIANCE * data.rows)
        found = relevance(data, self.groups, np.full(len(self.groups), 0.5), SEARCH_ROUNDS, SETTLED)
        alive = np.flatnonzero(found.ridge > 0.0)
        precision = data.square[np.ix_(alive, alive)] / found.noise**2 + np.diag(found.ridge[alive] ** -2.0)
        covariance = np.zeros_like(data.square)
        covariance[np.ix_(alive, alive)] = np.linalg.inv(precision)
        values = []
        for number, basis in enumerate(self.bases):
            own = slice(1 + number * KNOTS, 1 + (number + 1) * KNOTS)
            spread = np.einsum("ij,jk,ik->i", basis, covariance[own, own], basis)
            values.append(basis @ found.values[own] + 0.5 * spread)
        return values


COVERED = 0.95
LASTING, CHANGE = 0.5, 0.33
MIN_ROWS = 5  # rows of a kind that the poses outside a fold must have to tell an interval (our choice)


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Errors on held-out rows, as samples for the error model.

    Attributes:
        squares: (m,) |e|² [m²].
        shapes: (m, 4) quantities on which the variance depends: trace J Σ Jᵀ, 1, squared distances to the other rows.
        away: (m,) the sum of these distances [m²].
        pose: (m,) which pose.
        fold: (m,) which fold.
        near: (m,) whether the row is from a random fold.
        joint: (m,) joint whose range end was held out; -1 for none.
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
        """Return the errors from arrays (rows, 5) by fold: |e|², trace J Σ Jᵀ, two squared distances, pose number.

        Args:
            joints: joint whose range end was held out, for each of `far`; -1 for none.
        """
        folds = [*near, *far]
        rows, number = np.concatenate(folds), np.repeat(np.arange(len(folds)), [len(each) for each in folds])
        shapes = np.column_stack([rows[:, 1], np.ones(len(rows)), rows[:, 2:4]])
        away, joint = rows[:, 2:4].sum(axis=1), np.array([*[-1] * len(near), *joints])[number]
        return cls(rows[:, 0], shapes, away, rows[:, 4].astype(int), number, number < len(near), joint)

    def without(self, poses: np.ndarray) -> LeftOut:
        """Return the rows without those of the given poses."""
        rows = ~np.isin(self.pose, poses)
        return LeftOut(*(each[rows] for each in vars(self).values()))

    def scaled(self, q: np.ndarray) -> tuple[LeftOut, Profile]:
        """Return the errors with their variance terms scaled by s (for each fold from the other poses), and s itself.

        Args:
            q: (poses, n) [rad or m].
        """
        weights, _ = self.learnt()
        squares = (self.squares / np.maximum(self.shapes @ weights, 1e-30))[self.near]
        known, where = np.unique(self.pose[self.near], return_inverse=True)
        found = Unevenness(q[known], np.bincount(where, squares) / np.bincount(where))
        shapes = self.shapes.copy()
        for fold in np.unique(self.fold):
            rows = self.fold == fold
            profile = found.profile(np.isin(known, self.pose[rows]))
            shapes[rows, 1] = unevenness(profile, q[self.pose[rows]])
        return replace(self, shapes=shapes), found.profile()

    def learnt(self, start: Sequence[float] = ()) -> tuple[list[float], tuple[float, float]]:
        """Return κ, v_0, v_1, v_2 of  |e|² ~ variance · χ²_3 / 3,  and the 95 % radii of near and far errors."""
        fold_rounds = 100  # rounds of the search for variances without a fold's poses
        near, rounds = self.near, fold_rounds
        if not start:
            middle, rounds = float(np.median(self.squares)), ROUNDS
            start = [1.0, middle, *0.3 * middle / np.maximum(self.shapes[:, 2:].mean(axis=0), 1e-12)]
        counts = np.where(near, max(1, round(np.sum(~near) / np.sum(near))), 1.0)
        weights = variance_weights(self.squares, self.shapes, np.array(start), counts, rounds)
        sizes = np.sqrt(self.squares / np.maximum(self.shapes @ weights, 1e-30))
        return weights.tolist(), self.quantiles(sizes)

    def quantiles(self, sizes: np.ndarray) -> tuple[float, float]:
        """Return the bounds that 95 % of future errors keep, near and far, from error magnitudes (m,) (conformal)."""
        poses = len(np.unique(self.pose))
        level = min(1.0, COVERED * (poses + 1) / poses)
        first, second = (float(np.quantile(sizes[of], level)) for of in (self.near, ~self.near))
        return first, second

    def surprise(self, weights: Sequence[float], reach: tuple[float, float]) -> tuple[float, float]:
        """Return the factors (near, far) by which intervals must widen to contain 95 % of a held-out fold's errors."""
        ratio = np.ones(len(self.squares))
        for fold in np.unique(self.fold):
            rows = self.fold == fold
            rest = self.without(self.pose[rows])
            if min(rest.near.sum(), (~rest.near).sum()) > MIN_ROWS:
                own, radii = rest.learnt(weights)
                sigma = np.sqrt(np.maximum(self.shapes[rows] @ own, 1e-30))
                ratio[rows] = np.sqrt(self.squares[rows]) / (sigma * np.interp(self.away[rows], reach, radii))
        first, second = self.quantiles(ratio)
        return max(1.0, first), max(1.0, second)

    def wider(
        self, weights: Sequence[float], radii: tuple[float, float], reach: tuple[float, float], q: np.ndarray
    ) -> tuple[tuple[float, float], ...]:
        """Return the factors by which intervals widen beyond the lower and the upper end of each joint's range.

        Args:
            weights, radii, reach: of the interval, as in `calib.geometry.error_model.Discrepancy`.
            q: (poses, n) [rad or m].
        """
        sigma = np.sqrt(np.maximum(self.shapes @ np.array(weights), 1e-30))
        sizes = np.sqrt(self.squares) / (sigma * np.interp(self.away, reach, radii))
        side = (q > np.median(q, axis=0))[self.pose, self.joint].astype(int)
        rows = {(j, k): sizes[(self.joint == j) & (side == k)] for j in range(q.shape[1]) for k in (0, 1)}
        rows = {end: each for end, each in rows.items() if len(each) > MIN_ROWS}
        min_ends = 3  # that tell what is common to them (our choice)
        if len(rows) < min_ends:
            return ()
        size = np.array([np.sqrt(np.mean(each**2)) for each in rows.values()])
        mean = np.mean(np.log(size))
        changed = np.exp(CHANGE * ndtri((np.arange(99) + 0.5) / 99))
        shapes = np.concatenate([each / own for each, own in zip(rows.values(), size)])
        expected = np.exp(mean + LASTING * (np.log(size) - mean)) * np.quantile(np.outer(shapes, changed), COVERED)
        result = np.ones((q.shape[1], 2))
        result[tuple(zip(*rows))] = np.maximum(expected, 1.0)
        return tuple((float(low), float(high)) for low, high in result)

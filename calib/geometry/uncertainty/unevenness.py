"""Where errors are larger than elsewhere: the logarithm of their variance as a sum of one function per joint.

    log s(q) = Σ_j f_j(q_j),    f_j ~ GP(0, a_j² exp(-|Δ| / (CORRELATION_LENGTH · range)))

by regression of the logarithms of squared errors on joint values (Harvey 1976, Econometrica 44: multiplicative
heteroscedasticity), every a_j at its most probable (`calib.estimation.relevance`): 0 where a joint has no influence.
Stated is exp(E f + var f / 2), the mean of s: it is larger where few poses, or none, were measured.
"""

from dataclasses import replace

import numpy as np

from calib.estimation.relevance import SETTLED, Gram, gram, relevance

KNOTS = 9  # values per joint, linear in between (our choice)
CORRELATION_LENGTH = 0.5  # how far one value speaks for others, of the range (our choice)
KNOT_MARGIN = 0.2  # how far the function is stated outside the range, of it (our choice)
MIN_SQUARE = 0.02  # of the median squared error: smaller ones count as that (our choice)
MIN_VARIANCE = 1e-4  # variance of a logarithm that is known best: copies of few poses would be fitted without any error
MIN_MOTION = 1e-3  # a joint that moves by less tells nothing [rad or m]
ROUNDS = 30  # of the search for the a_j

Profile = tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]  # per joint: its values, log s there


def unevenness(profile: Profile, q: np.ndarray) -> np.ndarray:
    """Return s (m,) at poses q (m, n) [rad or m]; 1 where the profile is empty."""
    return np.exp(sum((np.interp(q[:, j], *each) for j, each in enumerate(profile)), np.zeros(len(q))))


class Unevenness:
    """What squared errors say of s.

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
        """Return log s by joint from all poses, or from all but some (m,) [bool]."""
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
        found = relevance(data, self.groups, np.full(len(self.groups), 0.5), ROUNDS, SETTLED)
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

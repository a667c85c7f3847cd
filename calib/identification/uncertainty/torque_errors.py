"""How far off predicted torques may be: what the parameters leave open, and what the model itself leaves.

    E e_j² = κ_j w_j Σ w_jᵀ + v_j + u_j d²

with w_j the torque row's regressor, Σ the parameters' covariance, and d the distance of (q, v, a) from the box that was
learnt from, each in units of its standard deviation. κ, v and u are the most probable ones of errors on time left
out: block by block, and each half from the other. Such an error is what the model leaves of the torque as recorded,
ripple and noise above its band included, and what its prediction changes by where the parameters are estimated without
that time. How much the sizes of these errors differ from one block to another says how far those of other motion may:
the stated sigma is that of which 1.96 hold 95 % where the logarithm of their size has a t distribution.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree
from scipy.special import stdtrit

from calib.data.signals.decimation import kept
from calib.dynamics.idim import IdentificationModel
from calib.estimation.triangles import Triangles
from calib.estimation.variances import variance_weights
from calib.estimation.whiteness import inflation
from calib.identification.cases import Case
from calib.identification.friction import time_folds
from calib.identification.identify import Identification, common_decimator
from calib.identification.prediction import Dynamics
from calib.identification.rows import pool, segmented_states, triangulate
from calib.identification.uncertainty.torque_uncertainty import estimated_columns, parameter_variances

COVERED, SIGMAS = 0.95, 1.96
OPTIMISM = 0.4
"""By how many of the deviations between blocks errors on other motion are larger than those on time left out.

Friction and filters were chosen on that time, too. Chosen on twelve parts of real recordings, each judged on another
part of them: 5 s of a Panda's, 1.35 s of a TX40's, 6 s of a KR300's, 25 s of a TIAGo's, 3 s of an LWR's, and single
runs of a UR10e; there 0.3 holds 94.5 % of the errors, 0.4 95.2 % and 0.6 96.3 %.
"""
BORROWED = 4.0  # blocks' worth of what all joints say together of how sizes differ between blocks (our choice)
CHANCES = (np.arange(41) + 0.5) / 41
MOST = 5000  # samples of a recording that intervals are evaluated at
NEAR, REPEAT, FINER = 0.05, 0.5, 8  # of the spread of states; share of them met before; samples per thinned one
EDGE = 0.05  # of what was learnt from, by which a motion may leave it before that is said (our choice)
DOUBLE, PRIOR = 10.0, 0.02
"""The squared distance at which errors have twice their variance before any data; as share of all rows (our choice)."""
LARGE, EXACT = 5.0, 1e-9  # sigmas that an error counts as at most; of a joint's error, below which there is none
WAYS = ("outside the range of joint", "faster than learnt at joint", "accelerating more than learnt at joint")


@dataclass(frozen=True)
class TorqueDiscrepancy:
    """What makes an error of the torque likely, learnt on time left out.

    Attributes:
        parameters: (rows,) κ, by which the parameters' variance counts.
        floor: (rows,) v [N² m² or N²], of what no parameter of the model explains.
        beyond: (rows,) u, the same per squared distance from what was learnt from.
        lower, upper, scale: (3, n) least and largest q, v, a that were learnt from, and their standard deviations.
    """

    parameters: tuple[float, ...]
    floor: tuple[float, ...]
    beyond: tuple[float, ...]
    lower: tuple[tuple[float, ...], ...]
    upper: tuple[tuple[float, ...], ...]
    scale: tuple[tuple[float, ...], ...]

    def distance(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return d² (N,) of states, each (N, n)."""
        away = self._outside(q, v, a) / np.array(self.scale)[:, None]
        return np.sum(away**2, axis=(0, 2))

    def extrapolated(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return by which of q, v, a and at which joint (3, N, n) states leave what was learnt from."""
        return self._outside(q, v, a) > EDGE * (np.array(self.upper) - np.array(self.lower))[:, None]

    def _outside(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        states = np.stack([q, v, a])
        low, high = np.array(self.lower)[:, None], np.array(self.upper)[:, None]
        return np.maximum(low - states, 0.0) + np.maximum(states - high, 0.0)


@dataclass(frozen=True, eq=False)
class TorqueErrorModel:
    """Predicts the size of the errors of predicted torques.

    Attributes:
        columns: (k,) of the model's regressor that were estimated.
        covariance: (k, k) of their parameters.
        discrepancy: see `TorqueDiscrepancy`.
    """

    columns: np.ndarray
    covariance: np.ndarray
    discrepancy: TorqueDiscrepancy

    def sigma(
        self, dynamics: Dynamics, q: np.ndarray, v: np.ndarray, a: np.ndarray,
        carried: Collection[str] | None = None, states: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Return standard deviations (N, rows) of the errors of predicted torques [N m or N]: 1.96 hold 95 %.

        Args:
            dynamics: the model that predicts.
            q, v, a: (N, n) states [rad or m, and per s, per s²].
            carried: labels of the payloads on board; None: all.
            states: (s, N) of friction with memory; None: q is one uninterrupted record.
        """
        found = self.discrepancy
        own = parameter_variances(dynamics, self.columns, self.covariance, q, v, a, carried, states)
        far = found.distance(q, v, a)[:, None] * found.beyond
        return np.sqrt(np.array(found.parameters) * own + found.floor + far)


@dataclass(frozen=True, eq=False)
class TorqueIntervals:
    """What a model expects of its errors on one recording, beside those found, at M of its samples.

    Attributes:
        index: (M,) the samples.
        sigma: (M, rows) standard deviations stated [N m or N].
        inside: (M, rows) whether the errors found are within 1.96 of them.
        known: (M,) False at lost samples, which count nowhere.
        extrapolated: (3, M, n) by which of q, v, a and at which joint the motion leaves what was learnt from.
    """

    index: np.ndarray
    sigma: np.ndarray
    inside: np.ndarray
    known: np.ndarray
    extrapolated: np.ndarray

    @property
    def covered(self) -> float:
        """Share of all errors found that are within their interval."""
        return float(np.mean(self.inside[self.known]))

    @property
    def joints(self) -> np.ndarray:
        """(rows,) the same by torque row."""
        return np.asarray(np.mean(self.inside[self.known], axis=0))

    @property
    def independent(self) -> np.ndarray:
        """(rows,) how many independent errors they are worth, by the autocorrelation of being inside."""
        seen = self.inside[self.known].astype(float)
        return np.array([len(seen) / inflation(column) for column in seen.T])

    @property
    def median(self) -> np.ndarray:
        """(rows,) half width of the interval [N m or N]."""
        return np.asarray(SIGMAS * np.median(self.sigma, axis=0))

    @property
    def beyond(self) -> np.ndarray:
        """(M,) whether a sample extrapolates."""
        return np.asarray(self.extrapolated.any(axis=(0, 2)))

    def ways(self, joints: Sequence[str]) -> list[str]:
        """Say how the motion leaves what was learnt from: in which of q, v, a, and at which of the joints named."""
        outside = np.asarray(self.extrapolated.any(axis=1))
        return [
            f"{words} {', '.join(name for name, out in zip(joints, own.tolist()) if out)}"
            for words, own in zip(WAYS, outside)
            if own.any()
        ]


def intervals(errors: TorqueErrorModel, dynamics: Dynamics, case: Case, predicted: np.ndarray) -> TorqueIntervals:
    """Return what a model expects of its errors on a recording, beside those of its prediction (N, rows)."""
    motion = case.motion
    index = np.unique(np.linspace(0, len(motion) - 1, min(len(motion), MOST)).astype(int))
    q, v, a = (np.asarray(x[index]) for x in (motion.q, motion.v, motion.a))
    states = segmented_states(dynamics.model.columns, case)[:, index]
    sigma = errors.sigma(dynamics, q, v, a, case.carried, states)
    inside = np.abs(case.target[index] - predicted[index]) <= SIGMAS * sigma
    known = np.asarray(motion.weight[index] > 0.5)
    return TorqueIntervals(index, sigma, inside, known, errors.discrepancy.extrapolated(q, v, a))


def learn_torque_errors(
    found: Identification, cases: Sequence[Case], covariance: np.ndarray | None = None
) -> TorqueErrorModel | None:
    """Learn what errors of the torque to expect from those on time left out; None where there is too little of it.

    Args:
        found: the model and its rows.
        cases: the recordings it was identified from.
        covariance: (p, p) of its parameters; None: that of its estimate.
    """
    if not isinstance(found.dynamics.model, IdentificationModel):
        return None
    samples = _samples(found, cases)
    rest = [block for block in range(samples.block.max(initial=-1) + 1) if (samples.block == block).sum() > 1]
    if len(rest) < 2:
        return None
    count, rest = len(rest), _apart(samples, rest)
    halves = [np.unique(np.concatenate(part)) for part in (rest[: len(rest) // 2], rest[len(rest) // 2 :])]
    folds = [_left_out(found, samples, run) for run in (*rest, *(one for one in halves if len(one) < count))]
    rows = [[(error[:, row], shapes[:, row]) for error, shapes in folds] for row in range(samples.error.shape[1])]
    weights, logs, sizes = zip(*(_weighed(own) for own in rows))
    spread = np.array([np.var(own[: len(rest)], ddof=1) for own in logs])
    freedom = len(rest) - 1 + BORROWED
    spread = ((len(rest) - 1) * spread + BORROWED * spread.mean()) / freedom * (1.0 + 1.0 / len(rest))
    factors = [
        np.quantile(np.outer(own, np.exp(log.mean() + np.sqrt(one) * (OPTIMISM + stdtrit(freedom, CHANCES)))), COVERED)
        for own, log, one in zip(sizes, logs, spread)
    ]
    parts = np.stack(weights) * (np.array(factors)[:, None] / SIGMAS) ** 2
    known = replace(samples.box(), **dict(zip(("parameters", "floor", "beyond"), map(tuple, parts.T.tolist()))))
    own = found.fitted.estimate.covariance if covariance is None else covariance
    return TorqueErrorModel(estimated_columns(found.dynamics, found.names), own, known)


@dataclass(frozen=True, eq=False)
class _Samples:
    """M thinned samples of all recordings.

    Attributes:
        states: (3, M, n) q, v, a.
        error: (M, rows) of the model as it is, against the torque as recorded.
        matrix: (M, rows, p) filtered columns.
        block: (M,) of time; -1 where nothing is judged.
        whole, part: (K, 2 n) q and v at the full rate, or about as often as matters, and the block of each.
        triangles: of all rows, see `calib.identification.rows.triangulate`.
        values: (p,) estimated from all of them.
    """

    states: np.ndarray
    error: np.ndarray
    matrix: np.ndarray
    block: np.ndarray
    whole: np.ndarray
    part: np.ndarray
    triangles: Triangles
    values: np.ndarray

    def box(self, chosen: np.ndarray | slice = slice(None)) -> TorqueDiscrepancy:
        """Return what some of the states span, with no errors expected; in units of how all of them vary."""
        own = self.states[:, chosen]
        edges = own.min(axis=1), own.max(axis=1), np.maximum(self.states.std(axis=1), 1e-6)
        return TorqueDiscrepancy((), (), (), *(tuple(map(tuple, one.tolist())) for one in edges))


def _samples(found: Identification, cases: Sequence[Case]) -> _Samples:
    decimator, dynamics = common_decimator(cases, found.settings), found.dynamics
    states, errors, blocks, whole, parts = [], [], [], [], []
    for case, rows in zip(cases, found.rows):
        motion, index = case.motion, kept(case.motion.segment, decimator)
        q, v, a = own = np.stack([motion.q[index], motion.v[index], motion.a[index]])
        memory = segmented_states(dynamics.model.columns, case)[:, index]
        errors.append(case.target[index] - dynamics.model.torque(dynamics.values, q, v, a, case.carried, memory))
        states.append(own)
        blocks.append(np.where(motion.weight[index] > 0.5, rows.block, -1))
        every = slice(None, None, max(1, decimator.factor // FINER))
        whole.append(np.hstack([motion.q, motion.v])[every])
        near = np.searchsorted(index, np.arange(len(motion))[every]).clip(max=len(index) - 1)
        parts.append(rows.block[near])
    triangles = triangulate(found.rows)
    everything = range(triangles.groups // errors[0].shape[1])
    return _Samples(
        np.concatenate(states, axis=1), np.concatenate(errors), np.concatenate([rows.matrix for rows in found.rows]),
        np.concatenate(blocks), np.concatenate(whole), np.concatenate(parts), triangles,
        _estimate(found, triangles, everything)[0],
    )  # fmt: skip


def _apart(samples: _Samples, blocks: Sequence[int]) -> list[np.ndarray]:
    """Return the blocks, each with those that repeat its motion: time left out has to be motion left out.

    A block is repeated by another that has been in half of its states (see `calib.data.signals.persistency.repeats`).
    Where that leaves fewer than two, the blocks as they are.
    """
    spread = np.maximum(samples.whole.std(axis=0), 1e-6)
    trees = {k: KDTree(samples.whole[samples.part == k] / spread) for k in blocks}
    limit, runs = NEAR * np.sqrt(len(spread)), []
    for block in blocks:
        own = samples.states[:2, samples.block == block].transpose(1, 0, 2).reshape(-1, len(spread)) / spread
        met = [np.isfinite(tree.query(own, distance_upper_bound=limit)[0]).mean() for tree in trees.values()]
        run = tuple(k for k, share in zip(trees, met) if k == block or share >= REPEAT)
        if run not in runs and len(run) < len(blocks):
            runs.append(run)
    return [np.array(run) for run in (runs if len(runs) > 1 else [(block,) for block in blocks])]


def _estimate(found: Identification, data: Triangles, blocks: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return values (p,) from some blocks, with prior and ridges, and a root (p, k) of their covariance."""
    fitted, b = found.fitted, found.base.b
    group = np.concatenate([np.full(b, -1), np.asarray(found.friction.groups, dtype=int)])
    prior = None if found.prior is None else np.insert(found.prior.rows, [b] * (len(group) - b), 0.0, axis=1)
    pooled = pool(data, len(fitted.std), blocks)
    values, ridges = time_folds.estimate(pooled, fitted.std, fitted.inflation, group, prior)
    alive = np.flatnonzero(ridges > 0.0)
    weight = 1.0 / (fitted.std * np.sqrt(fitted.inflation))
    stacked = (pooled.factors[:, :, :-1] * weight[:, None, None]).reshape(-1, len(group))
    stacked = stacked if prior is None else np.vstack([stacked, prior[:, :-1]])
    square = (stacked.T @ stacked)[np.ix_(alive, alive)] + np.diag(ridges[alive] ** -2.0)
    unit = 1.0 / np.sqrt(np.maximum(np.diag(square), 1e-300))
    sizes, vectors = np.linalg.eigh(square * np.outer(unit, unit))
    root = np.zeros((len(group), len(alive)))
    root[alive] = unit[:, None] * vectors / np.sqrt(np.maximum(sizes, 1e-10))
    return values, root


def _left_out(
    found: Identification, samples: _Samples, run: Sequence[int] | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (m, rows) on blocks that the parameters did not see, and what they may grow by, (m, rows, 3)."""
    inside = np.isin(samples.block, run)
    others = [k for k in range(samples.triangles.groups // samples.error.shape[1]) if k not in run]
    values, root = _estimate(found, samples.triangles, others)
    rows, states = samples.matrix[inside], samples.states
    error = samples.error[inside] + rows @ (samples.values - values)
    own = np.sum((rows @ root) ** 2, axis=2)
    far = samples.box(~inside).distance(*states[:, inside])
    return error, np.stack([own, np.ones_like(own), np.broadcast_to(far[:, None], own.shape)], axis=2)


def _with_prior(squares: np.ndarray, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return squared errors and shapes with rows behind them that say how errors grow beyond what was learnt from.

    Where motion repeats itself, time left out hardly leaves it, and a chance excursion would say everything.
    """
    count = max(1, round(PRIOR * len(squares)))
    known = np.tile([0.0, 1.0, DOUBLE], (count, 1))
    return np.append(squares, np.full(count, 2.0 * squares.mean())), np.vstack([shapes, known])


def _weighed(folds: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return weights (3,) of what one joint's errors may grow by, log size per fold, and errors in units of both.

    Args:
        folds: errors (m,) and shapes (m, 3) of each.
    """
    squares, shapes = (np.concatenate(each) for each in zip(*((error**2, own) for error, own in folds)))
    least = max(EXACT**2 * float(squares.mean()), 1e-30)
    squares, shapes = _with_prior(squares, shapes)
    scale = np.maximum(shapes.mean(axis=0), 1e-300)
    start = np.full(3, np.median(squares) / 3.0)
    weights = variance_weights(np.maximum(squares, least), shapes / scale, start) / scale
    each = [np.sqrt(error**2 / np.maximum(own @ weights, least)) for error, own in folds]
    logs = np.array([0.5 * np.log(np.mean(np.minimum(one, LARGE) ** 2) + 1e-12) for one in each])
    return weights, logs, np.concatenate([one / np.exp(log) for one, log in zip(each, logs)])

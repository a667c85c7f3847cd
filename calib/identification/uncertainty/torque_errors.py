"""Expected errors of predicted torques: from the parameters' uncertainty, and from unmodelled effects.

    E e_j² = κ_j w_j Σ w_jᵀ + v_j + u_j log(1 + d_j²)

with w_j the torque row's regressor, Σ the parameters' covariance, and d_j the distance of its joint's q, v, a from the
training range, each in units of its standard deviation. What parameters do far from there is in Σ; what
no parameter explains (friction of another form, ripple) is of one size and soon forgets where it was: the logarithm. κ,
v and u are the most probable ones of errors on time left out: block by block, and each half from the other. A few
blocks of one joint identify the three badly, and κ = 0 would deny what the covariance says of itself: each joint's are
regularised to those of all, and to κ = 1. Such an error is what the model leaves of the torque as recorded, ripple and
noise above its band included, and what its prediction changes by where the parameters are estimated without that time.
A joint that stands has a floor of its own: errors at rest, each standstill counted once, and the variance F_c² / 3 of a
friction that may be anything within ± F_c, worth `BORROWED` standstills. How much the sizes of errors in motion differ
from one block to another says how far those of other motion may: the stated
sigma is that of which 1.96 hold 95 % where the logarithm of their size has a t distribution.

`Uncertainty` holds the parameters' share alone: standard deviations of torques from the covariance.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from scipy.special import stdtrit

from calib.data.signals.filtering import kept
from calib.dynamics.base import standard_name
from calib.dynamics.idim import IdentificationModel, friction_states
from calib.errors import UsageError, refused_as
from calib.estimation.robust import variance_weights
from calib.estimation.triangles import Triangles
from calib.estimation.whiteness import inflation
from calib.folders import COVARIANCE, read_covariance
from calib.identification import time_folds
from calib.identification.identify import Identification, common_decimator
from calib.identification.loop import per_joint
from calib.identification.prediction import Dynamics, IntervalCoverage
from calib.identification.rows import Case, pool, segmented_states, triangulate
from calib.records import evenly
from trajectories.timing.profile import Sampled

BLOCK = 4000


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """An identified model with the covariance of its parameters.

    Attributes:
        dynamics: the model; values of payloads that are not mounted are zero.
        carried: labels of the mounted payloads.
        columns: (k,) indices of the estimated columns of the regressor.
        covariance: (k, k) of their parameters.
    """

    dynamics: Dynamics
    carried: tuple[str, ...]
    columns: np.ndarray
    covariance: np.ndarray

    def sigma(self, sampled: Sampled) -> np.ndarray:
        """Return the largest standard deviation of each torque along a motion (n,): √(w Σ wᵀ) [N m or N]."""
        state = sampled.q, sampled.v, sampled.a
        variances = parameter_variances(self.dynamics, self.columns, self.covariance, *state, self.carried)
        return np.sqrt(variances.max(axis=0))[-sampled.q.shape[1] :]


def estimated_columns(dynamics: Dynamics, names: Sequence[str]) -> np.ndarray:
    """Return the regressor columns (k,) of the estimated parameters.

    Raises:
        ValueError: for a name that the model does not have.
    """
    standard = dynamics.model.names
    return np.array([standard.index(standard_name(name, standard)) for name in names])


def parameter_variances(
    dynamics: Dynamics,
    columns: np.ndarray,
    covariance: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    carried: Collection[str] | None = None,
    states: np.ndarray | None = None,
) -> np.ndarray:
    """Return the variances w Σ wᵀ (N, rows) of torques, for columns (k,) with covariance Σ (k, k) [N² m² or N²].

    Args:
        q, v, a: (N, n) states.
        carried: labels of the payloads on board; None: all.
        states: (s, N) of friction with memory; None: q is one uninterrupted record.
    """
    model, result = dynamics.model, []
    loaded = bool(model.with_load())
    states = friction_states(model, q) if states is None else states
    unit = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    root = unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    for start in range(0, len(q), BLOCK):
        part = slice(start, start + BLOCK)
        here, speed, change = (np.ascontiguousarray(x[part]) for x in (q, v, a))
        load = model.transmitted(dynamics.values, here, speed, change, carried) if loaded else None
        rows = model.regressor(here, speed, change, load, carried, states[:, part])[:, :, columns]
        result.append(np.sum((rows @ root) ** 2, axis=2))
    return np.concatenate(result)


def read_uncertainty(folder: Path, dynamics: Dynamics, carried: Sequence[str]) -> Uncertainty | None:
    """Read the covariance of an identification's parameters from its folder; None without the file."""
    if not (folder / COVARIANCE).is_file():
        return None
    names, covariance = read_covariance(folder)
    with refused_as(UsageError, ValueError, f"{folder}/covariance.csv and dynamics.json do not match: {{}}"):
        columns = estimated_columns(dynamics, names)
    return Uncertainty(dynamics, tuple(carried), columns, covariance)


COVERED, SIGMAS = 0.95, 1.96
OPTIMISM = 0.6
"""Factor on the deviations between blocks: errors on other motion exceed those on held-out time.

Friction and filters were chosen on that time, too. It holds 95 % on average over two kinds of pairs that count alike:
33 of parts of real recordings (1.35 to 50 s to learn from; 92.5 %) and 14 of simulated arms, which are the same on
every motion (97.8 %).
"""
BORROWED = 4.0  # blocks' worth of what all joints say together of one's errors (our choice)
CHANCES = (np.arange(41) + 0.5) / 41
SAME_STATE, MIN_REPEATED, FINER_BY = 0.05, 0.5, 8  # of states' spread; share of states met; samples per thinned one
DOUBLING, PRIOR = 2.0, 0.02
"""The log(1 + d²) at which errors have twice their variance before any data; as share of all rows (our choice)."""
MAX_ERROR, MIN_ERROR = 5.0, 1e-9  # sigmas that an error counts as; of a joint's error, below which it has none
WAYS = ("outside the range of joint", "faster than in training at joint", "accelerating more than in training at joint")


@dataclass(frozen=True)
class TorqueDiscrepancy:
    """Variance model of the torque's errors, estimated on held-out time.

    Attributes:
        parameters: (rows,) κ, factor of the parameters' variance.
        floor: (rows,) v [N² m² or N²], variance of unmodelled effects.
        beyond: (rows,) u, additional variance per log(1 + d²), d the distance from the training data.
        lower, upper, scale: (3, n) least and largest q, v, a of the training data, and their standard deviations.
        rest: (rows,) in place of v while a joint stands [N² m² or N²]; () in files of earlier versions.
        standing: (n,) speeds below which a joint stands [rad/s or m/s]; () in files of earlier versions.
    """

    parameters: tuple[float, ...]
    floor: tuple[float, ...]
    beyond: tuple[float, ...]
    lower: tuple[tuple[float, ...], ...]
    upper: tuple[tuple[float, ...], ...]
    scale: tuple[tuple[float, ...], ...]
    rest: tuple[float, ...] = ()
    standing: tuple[float, ...] = ()

    def at_rest(self, v: np.ndarray, rows: int) -> np.ndarray:
        """Return the mask (N, rows) of torque rows whose joint stands, from velocities (N, n)."""
        if not self.rest:
            return np.zeros((len(v), rows), dtype=bool)
        stands = np.abs(v) < np.array(self.standing)
        times, partial = divmod(rows, stands.shape[1])
        return np.zeros((len(v), rows), dtype=bool) if partial else np.tile(stands, times)

    def floors(self, v: np.ndarray, rows: int) -> np.ndarray:
        """Return the variance of unmodelled effects (N, rows) at velocities (N, n) [N² m² or N²]."""
        moving = np.broadcast_to(np.array(self.floor), (len(v), rows))
        return np.where(self.at_rest(v, rows), np.array(self.rest), moving) if self.rest else moving

    def distance(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, rows: int) -> np.ndarray:
        """Return log(1 + d²) (N, rows) of states q, v, a (N, n) each: of the row's joint, or of all joints."""
        away = np.sum((self._outside(q, v, a) / np.array(self.scale)[:, None]) ** 2, axis=0)
        own, left = divmod(rows, away.shape[1])
        return np.log1p(np.broadcast_to(away.sum(axis=1)[:, None], (len(q), rows)) if left else np.tile(away, own))

    def extrapolated(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the mask (3, N, n) of states outside the training range, by q, v, a and joint."""
        max_outside = 0.05  # of what was learnt from, by which a motion may leave it before that is said (our choice)
        return self._outside(q, v, a) > max_outside * (np.array(self.upper) - np.array(self.lower))[:, None]

    def _outside(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        states = np.stack([q, v, a])
        low, high = np.array(self.lower)[:, None], np.array(self.upper)[:, None]
        return np.maximum(low - states, 0.0) + np.maximum(states - high, 0.0)


@dataclass(frozen=True, eq=False)
class TorqueErrorModel:
    """Model of the standard deviation of torque prediction errors.

    Attributes:
        columns: (k,) indices of the estimated columns of the model's regressor.
        covariance: (k, k) of their parameters.
        discrepancy: see `TorqueDiscrepancy`.
    """

    columns: np.ndarray
    covariance: np.ndarray
    discrepancy: TorqueDiscrepancy

    def sigma(
        self,
        dynamics: Dynamics,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        carried: Collection[str] | None = None,
        states: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return standard deviations (N, rows) of the errors of predicted torques [N m or N]; 1.96 of them cover 95 %.

        Args:
            dynamics: the model that predicts.
            q, v, a: (N, n) states [rad or m, and per s, per s²].
            carried: labels of the payloads on board; None: all.
            states: (s, N) of friction with memory; None: q is one uninterrupted record.
        """
        found = self.discrepancy
        own = parameter_variances(dynamics, self.columns, self.covariance, q, v, a, carried, states)
        far = found.distance(q, v, a, own.shape[1]) * np.array(found.beyond)
        return np.sqrt(np.array(found.parameters) * own + found.floors(v, own.shape[1]) + far)


@dataclass(frozen=True, eq=False)
class TorqueIntervals:
    """Predicted error intervals of a model on one recording, and whether they contain the errors, at M samples.

    Attributes:
        index: (M,) indices of the samples.
        sigma: (M, rows) predicted standard deviations [N m or N].
        inside: (M, rows) whether the actual errors are within 1.96 of them.
        known: (M,) False at lost samples, which are not counted.
        standing: (M, rows) whether the row's joint stands.
        extrapolated: (3, M, n) whether the motion leaves the training range, by q, v, a and joint.
    """

    index: np.ndarray
    sigma: np.ndarray
    inside: np.ndarray
    known: np.ndarray
    standing: np.ndarray
    extrapolated: np.ndarray

    @property
    def covered(self) -> float:
        """Share of all errors within their interval."""
        return float(np.mean(self.inside[self.known]))

    @property
    def joints(self) -> np.ndarray:
        """Share of the errors within their interval, by torque row (rows,)."""
        return np.asarray(np.mean(self.inside[self.known], axis=0))

    @property
    def independent(self) -> np.ndarray:
        """Number of independent errors (rows,), from the autocorrelation of `inside`."""
        seen = self.inside[self.known].astype(float)
        return np.array([len(seen) / inflation(column) for column in seen.T])

    @property
    def median(self) -> np.ndarray:
        """Median half width of the interval in motion (rows,) [N m or N]; at rest, where a joint does not move."""
        moving = self._median(~self.standing)
        return np.where(np.isfinite(moving), moving, self._median(self.standing))

    @property
    def median_at_rest(self) -> np.ndarray:
        """Median half width of the interval at rest (rows,) [N m or N]; NaN where a joint does not stand."""
        return self._median(self.standing)

    def _median(self, used: np.ndarray) -> np.ndarray:
        """Return the median half width (rows,) over some samples (M, rows); NaN without any."""
        pairs = zip(self.sigma.T, used.T)
        return np.array([SIGMAS * np.median(sigma[own]) if own.any() else np.nan for sigma, own in pairs])

    @property
    def beyond(self) -> np.ndarray:
        """Whether each sample extrapolates (M,) bool."""
        return np.asarray(self.extrapolated.any(axis=(0, 2)))

    def coverage(self) -> IntervalCoverage:
        """Return the record of the shares of errors within their intervals."""
        return IntervalCoverage(
            100.0 * self.covered,
            100.0 * self.joints,
            self.median,
            int(self.known.sum()),
            100.0 * float(self.beyond.mean()),
            self.median_at_rest,
        )

    def ways(self, joints: Sequence[str]) -> list[str]:
        """Return texts on how the motion leaves the training range: by q, v or a, and at which of the named joints."""
        outside = np.asarray(self.extrapolated.any(axis=1))
        return [
            f"{words} {', '.join(name for name, out in zip(joints, own.tolist()) if out)}"
            for words, own in zip(WAYS, outside)
            if own.any()
        ]


def intervals(errors: TorqueErrorModel, dynamics: Dynamics, case: Case, predicted: np.ndarray) -> TorqueIntervals:
    """Return a model's 95 % error bounds on a recording, and which errors of `predicted` (N, rows) lie within them."""
    motion = case.motion
    max_samples = 5000  # samples of a recording that intervals are evaluated at
    index = evenly(len(motion), max_samples)
    q, v, a = (np.asarray(x[index]) for x in (motion.q, motion.v, motion.a))
    states = segmented_states(dynamics.model.columns, case)[:, index]
    sigma = errors.sigma(dynamics, q, v, a, case.carried, states)
    inside = np.abs(case.target[index] - predicted[index]) <= SIGMAS * sigma
    known = np.asarray(motion.weight[index] > 0.5)
    standing = errors.discrepancy.at_rest(v, sigma.shape[1])
    return TorqueIntervals(index, sigma, inside, known, standing, errors.discrepancy.extrapolated(q, v, a))


def learn_torque_errors(
    found: Identification, cases: Sequence[Case], covariance: np.ndarray | None = None
) -> TorqueErrorModel | None:
    """Return a model of the torque errors, estimated on held-out time; None if the recordings are too short.

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
    friction = _friction(found)
    slow = _standing_speeds(found, friction)
    runs = (*rest, *(one for one in halves if len(one) < count))
    folds = [_left_out(found, samples, run, slow) for run in runs]
    weights = _weights(folds, len(rest))
    logs, sizes = zip(*(_in_units(folds, row, own) for row, own in enumerate(weights)))
    spread = np.array([np.var(own[: len(rest)], ddof=1) for own in logs])
    freedom = len(rest) - 1 + BORROWED
    spread = ((len(rest) - 1) * spread + BORROWED * spread.mean()) / freedom * (1.0 + 1.0 / len(rest))
    factors = [
        np.quantile(np.outer(own, np.exp(log.mean() + np.sqrt(one) * (OPTIMISM + stdtrit(freedom, CHANCES)))), COVERED)
        for own, log, one in zip(sizes, logs, spread)
    ]
    parts = weights * (np.array(factors)[:, None] / SIGMAS) ** 2
    known = replace(samples.box(), **dict(zip(("parameters", "floor", "beyond"), map(tuple, parts.T.tolist()))))
    at_rest = _rest_floors(folds[: len(rest)], friction, parts)
    known = replace(known, rest=tuple(at_rest.tolist()), standing=tuple(slow.tolist()))
    own = found.fitted.estimate.covariance if covariance is None else covariance
    return TorqueErrorModel(estimated_columns(found.dynamics, found.names), own, known)


@dataclass(frozen=True, eq=False)
class _Samples:
    """Motion and residuals of M decimated samples of all recordings.

    Attributes:
        states: (3, M, n) q, v and a.
        torque, error: (M, rows) recorded torque, and its prediction error by the final model.
        matrix: (M, rows, p) filtered columns.
        block: (M,) number of the time block; -1 for samples not compared.
        whole, part: (K, 2 n) q and v at the full rate, or a sufficient part of it, and their time blocks.
        triangles: triangles of all rows, see `calib.identification.rows.triangulate`.
        values: (p,) estimated from all rows.
    """

    states: np.ndarray
    torque: np.ndarray
    error: np.ndarray
    matrix: np.ndarray
    block: np.ndarray
    whole: np.ndarray
    part: np.ndarray
    triangles: Triangles
    values: np.ndarray

    def box(self, chosen: np.ndarray | slice = slice(None)) -> TorqueDiscrepancy:
        """Return the range of the selected states with the standard deviation of all states; error terms are empty."""
        own = self.states[:, chosen]
        edges = own.min(axis=1), own.max(axis=1), np.maximum(self.states.std(axis=1), 1e-6)
        lower, upper, scale = (tuple(map(tuple, one.tolist())) for one in edges)
        return TorqueDiscrepancy((), (), (), lower, upper, scale)


def _samples(found: Identification, cases: Sequence[Case]) -> _Samples:
    decimator, dynamics = common_decimator(cases, found.settings), found.dynamics
    states, torques, errors, blocks, whole, parts = [], [], [], [], [], []
    for case, rows in zip(cases, found.rows):
        motion, index = case.motion, kept(case.motion.segment, decimator)
        q, v, a = own = np.stack([motion.q[index], motion.v[index], motion.a[index]])
        memory = segmented_states(dynamics.model.columns, case)[:, index]
        torques.append(np.asarray(case.target[index]))
        errors.append(torques[-1] - dynamics.model.torque(dynamics.values, q, v, a, case.carried, memory))
        states.append(own)
        blocks.append(np.where(motion.weight[index] > 0.5, rows.block, -1))
        every = slice(None, None, max(1, decimator.factor // FINER_BY))
        whole.append(np.hstack([motion.q, motion.v])[every])
        near = np.searchsorted(index, np.arange(len(motion))[every]).clip(max=len(index) - 1)
        parts.append(rows.block[near])
    triangles = triangulate(found.rows)
    matrices = [_together(rows.matrix, errors[0].shape[1]) for rows in found.rows]
    everything = range(triangles.groups // len(found.fitted.std))
    return _Samples(
        np.concatenate(states, axis=1),
        np.concatenate(torques),
        np.concatenate(errors),
        np.concatenate(matrices),
        np.concatenate(blocks),
        np.concatenate(whole),
        np.concatenate(parts),
        triangles,
        _estimate(found, triangles, everything)[0],
    )


def _together(matrix: np.ndarray, rows: int) -> np.ndarray:
    """Return columns (M, rows, p) without the zero rows of other recordings (`ObservationRows.by_recording`)."""
    return matrix if matrix.shape[1] == rows else matrix.sum(axis=1, keepdims=True)


def _apart(samples: _Samples, blocks: Sequence[int]) -> list[np.ndarray]:
    """Return the blocks to hold out together: each block with all blocks that repeat its motion.

    A block is repeated by another that has been in half of its states (see `calib.data.signals.persistency.repeats`).
    Where that leaves fewer than two, the blocks as they are.
    """
    spread = np.maximum(samples.whole.std(axis=0), 1e-6)
    trees = {k: KDTree(samples.whole[samples.part == k] / spread) for k in blocks}
    limit, runs = SAME_STATE * np.sqrt(len(spread)), []
    for block in blocks:
        own = samples.states[:2, samples.block == block].transpose(1, 0, 2).reshape(-1, len(spread)) / spread
        met = [np.isfinite(tree.query(own, distance_upper_bound=limit)[0]).mean() for tree in trees.values()]
        run = tuple(k for k, share in zip(trees, met) if k == block or share >= MIN_REPEATED)
        if run not in runs and len(run) < len(blocks):
            runs.append(run)
    return [np.array(run) for run in (runs if len(runs) > 1 else [(block,) for block in blocks])]


def _estimate(found: Identification, data: Triangles, blocks: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the values (p,) estimated from some time blocks, and a root (p, k) of their covariance."""
    fitted, b = found.fitted, found.base.b
    group = np.concatenate([np.full(b, -1), np.asarray(found.friction.groups, dtype=int)])
    prior = None if found.prior is None else found.prior.widened(len(group) - b)
    pooled = pool(data, len(fitted.std), blocks)
    stronger = None if found.prior is None or prior is None else np.sqrt(found.prior.tempering) * prior
    values, ridges = time_folds.estimate(pooled, fitted.std, fitted.inflation, group, stronger)
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


@dataclass(frozen=True, eq=False)
class _Fold:
    """Errors on held-out time.

    Attributes:
        error: (m, rows) of the torques [N m or N].
        shapes: (m, rows, 3) terms of their variance.
        moves: (m, rows) whether the row's joint moves.
    """

    error: np.ndarray
    shapes: np.ndarray
    moves: np.ndarray


def _friction(found: Identification) -> np.ndarray:
    """Return Coulomb's friction (rows,) of the torque rows that hold a motor's; zero in others [N m or N]."""
    coulomb = found.rows[0].coulomb[: found.dynamics.model.rows]  # recordings weighed apart repeat them
    return np.sum(np.abs(found.fitted.estimate.values) * coulomb, axis=1)


def _standing_speeds(found: Identification, friction: np.ndarray) -> np.ndarray:
    """Return the speeds (n,) below which joints stand: Coulomb's sign is as wide; zero where no row has friction."""
    n = found.dynamics.model.n
    width = np.array(per_joint(found.settings.v0, n, "v0"), dtype=float)
    return width if friction.any() else np.zeros(n)


def _left_out(found: Identification, samples: _Samples, run: Sequence[int] | np.ndarray, slow: np.ndarray) -> _Fold:
    """Return errors on held-out blocks.

    No error counts for more than the torque itself: a fold that fails wholly says nothing of how the whole model errs.

    Args:
        slow: (n,) speeds below which a joint stands.
    """
    inside, size = np.isin(samples.block, run), np.sqrt(np.mean(samples.torque**2, axis=0))
    others = [k for k in range(samples.triangles.groups // len(found.fitted.std)) if k not in run]
    values, root = _estimate(found, samples.triangles, others)
    rows, states = samples.matrix[inside], samples.states
    error = samples.error[inside] + rows @ (samples.values - values)
    own = np.sum((rows @ root) ** 2, axis=2)
    box = samples.box(~inside)
    far = box.distance(*states[:, inside], rows=own.shape[1])
    known = replace(box, rest=(0.0,) * own.shape[1], standing=tuple(slow.tolist()))
    moves = ~known.at_rest(states[1, inside], own.shape[1])
    return _Fold(error.clip(-size, size), np.stack([own, np.ones_like(own), far], axis=2), moves)


def _rest_floors(folds: Sequence[_Fold], friction: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Return the variance of unmodelled effects of standing joints (rows,) [N² m² or N²].

    Args:
        folds: of time.
        friction: (rows,) Coulomb's.
        parts: (rows, 3) κ, v and u in motion.
    """
    expected = parts[:, 1] + friction**2 / 3.0
    total, standstills = BORROWED * expected, np.full(len(friction), BORROWED)
    for fold in folds:
        for row in range(len(friction)):
            rests = ~fold.moves[:, row]
            if rests.any():
                count = max(1, int(np.sum(rests[1:] & ~rests[:-1]) + rests[0]))
                total[row] += count * float(np.mean(fold.error[rests, row] ** 2))
                standstills[row] += count
    return total / standstills


def _weights(folds: Sequence[_Fold], blocks: int, errors_used: int = 4000) -> np.ndarray:
    """Return the weights (rows, 3) of the error variance's terms in motion, regularised towards those of all rows.

    In units of a row's own mean square every row's κ, and its u over v, are of one kind. Behind a row's errors stand
    those of all others, worth `BORROWED` blocks, and what is known beforehand: the covariance is as it says, worth a
    block, and errors grow beyond the training range, which folds hardly leave where motion repeats itself.

    Args:
        folds: of time.
        blocks: of time.

    `errors_used`: errors of a joint that its weights are found from, about.
    """
    errors = np.concatenate([fold.error for fold in folds])
    every = max(1, len(errors) // errors_used)
    squares = errors[::every].T ** 2
    shapes = np.concatenate([fold.shapes for fold in folds])[::every].transpose(1, 0, 2).copy()
    moves = np.concatenate([fold.moves for fold in folds])[::every].T.astype(float)
    moves[moves.sum(axis=1) < 0.5 * blocks] = 1.0  # a joint that never moves is judged at rest
    size = np.maximum(np.sum(squares * moves, axis=1) / moves.sum(axis=1), 1e-300)
    squares = np.maximum(squares / size[:, None], MIN_ERROR**2)
    shapes[:, :, 0] /= size[:, None]
    count, known = squares.shape[1], np.array([[1.0, 0.0, 0.0], [0.0, 1.0, DOUBLING]])
    expected = np.array([1.0, 2.0]), known, np.array([count / blocks, max(1.0, PRIOR * count)])
    result = []
    for row in range(len(size)):
        others = np.delete(np.arange(len(size)), row)
        thinned = slice(None, None, max(1, len(others)))
        parts = (
            (squares[row], shapes[row], moves[row]),
            (
                squares[others, thinned].ravel(),
                shapes[others, thinned].reshape(-1, 3),
                BORROWED / blocks * moves[others, thinned].ravel(),
            ),
            expected,
        )
        own, by, worth = zip(*((one, shape, np.broadcast_to(counts, len(one))) for one, shape, counts in parts))
        scale = np.array([max(float(shapes[row, :, 0].mean()), 1e-300), 1.0, 1.0])
        found = variance_weights(
            np.concatenate(own), np.concatenate(by) / scale, np.full(3, 1.0 / 3.0), np.concatenate(worth)
        )
        result.append(found / scale * [1.0, size[row], size[row]])
    return np.stack(result)


def _in_units(folds: Sequence[_Fold], row: int, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for one row the log rms of error over predicted sigma in each fold, and the normalised errors.

    In motion; of a fold in which its joint does not move, at rest.
    """
    each = []
    for fold in folds:
        used = fold.moves[:, row] if fold.moves[:, row].any() else slice(None)
        each.append((fold.error[used, row] ** 2, fold.shapes[used, row] @ weights))
    least = max(MIN_ERROR**2 * float(np.mean(np.concatenate([square for square, _ in each]))), 1e-30)
    units = [np.sqrt(square / np.maximum(own, least)) for square, own in each]
    logs = np.array([0.5 * np.log(np.mean(np.minimum(one, MAX_ERROR) ** 2) + 1e-12) for one in units])
    return logs, np.concatenate([one / np.exp(log) for one, log in zip(units, logs)])

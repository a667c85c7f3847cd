"""Estimation of the expected torque errors from a model's errors on held-out training time.

κ, v and u of `calib.identification.uncertainty.torque_errors` are the most probable values given the errors on held-out
time: those of each block, and of each half predicted from the other. A few blocks of one joint identify the three
poorly, and κ = 0 would neglect the covariance. Therefore each joint's values are regularised towards those of all
joints, and towards κ = 1. An error consists of the residual of the recorded torque (including ripple and noise above
the band), and of the change of the prediction if parameters are estimated without the held-out time. Joints at rest
have a separate variance. It is estimated from errors at rest, each standstill counted once, and from the variance F_c²
/ 3 of a friction evenly distributed within ± F_c, which counts as `BORROWED` standstills. The variation of the errors'
size between blocks shows how much it may vary in other motion: 1.96 predicted sigmas cover 95 % of errors if the
logarithm of their size has a t distribution.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree
from scipy.special import stdtrit

from calib.data.signals.filtering import kept
from calib.data.signals.persistency import REPEATED, share_met
from calib.dynamics.idim import IdentificationModel
from calib.estimation.robust import variance_weights
from calib.estimation.triangles import Triangles
from calib.identification import time_folds
from calib.identification.identify import Identification, common_decimator
from calib.identification.loop import per_joint
from calib.identification.rows import Case, pool, segmented_states, triangulate
from calib.identification.uncertainty.torque_errors import (
    COVERED,
    SIGMAS,
    TorqueDiscrepancy,
    TorqueErrorModel,
    estimated_columns,
)

OPTIMISM = 0.6
"""Factor on the deviations between blocks: errors on other motion exceed those on held-out time.

Friction and filters were chosen on that time, too. It holds 95 % on average over two kinds of pairs that count alike:
33 of parts of real recordings (1.35 to 50 s to learn from; 92.5 %) and 14 of simulated arms, which are the same on
every motion (97.8 %).
"""
BORROWED = 4.0
"""Blocks' worth of what the errors of all joints together say of those of one (our choice)."""


CHANCES = (np.arange(41) + 0.5) / 41
"""Probabilities at which the t distribution of the errors' size is evaluated."""
FINER_BY = 8
"""Samples of the trajectory per decimated sample, at most, in which states are looked up."""


DOUBLING, PRIOR = 2.0, 0.02
"""The log(1 + d²) at which errors have twice their variance before any data; as share of all rows (our choice)."""
MAX_ERROR = 5.0
"""Standard deviations that an error counts as, at most."""


MIN_ERROR = 1e-9
"""Share of a joint's rms error, below which it counts as this share."""
MAX_WEIGHT_SAMPLES = 4000
"""Errors of a torque row from which the weights of its variance are estimated, about."""


@dataclass(frozen=True, eq=False)
class _HeldOut:
    """Prediction errors on held-out time, and the terms of their expected variance.

    Attributes:
        errors: (m, rows) errors of the torques [N m or N].
        variance_terms: (m, rows, 3) variance due to the parameters, 1, and log(1 + d²), with d the distance from the
            training data.
        moves: (m, rows) whether the row's joint moves.
    """

    errors: np.ndarray
    variance_terms: np.ndarray
    moves: np.ndarray


def learn_torque_errors(
    identification: Identification, cases: Sequence[Case], covariance: np.ndarray | None = None
) -> TorqueErrorModel | None:
    """Return a model of the torque errors, estimated on held-out time; None if the recordings are too short.

    Args:
        identification: the model and its rows.
        cases: the training recordings.
        covariance: (p, p) covariance of the parameters; None: that of the estimate.
    """
    if not isinstance(identification.dynamics.model, IdentificationModel):
        return None
    samples = _collect_samples(identification, cases)
    numbers = range(samples.block.max(initial=-1) + 1)
    blocks = [block for block in numbers if np.count_nonzero(samples.block == block) > 1]
    if len(blocks) < 2:
        return None

    # Hold out each run of the motion, and each half of all runs.
    runs = _independent_runs(samples, blocks)
    middle = len(runs) // 2
    halves = []
    for half in (runs[:middle], runs[middle:]):
        half_blocks = np.unique(np.concatenate(half))
        if len(half_blocks) < len(blocks):
            halves.append(half_blocks)
    friction = _coulomb_friction(identification)
    standing_speeds = _standing_speeds(identification, friction)
    folds = [_hold_out(identification, samples, run, standing_speeds) for run in (*runs, *halves)]

    run_count = len(runs)
    weights = _variance_weights(folds, run_count)
    factors = _interval_factors(folds, weights, len(runs))
    weights = weights * factors[:, None] ** 2
    rest = _rest_floors(folds[: len(runs)], friction, weights)
    parameters, floor, beyond = weights.T.tolist()
    standing = tuple(standing_speeds.tolist())
    discrepancy = replace(
        samples.training_range(),
        parameters=tuple(parameters),
        floor=tuple(floor),
        beyond=tuple(beyond),
        rest=tuple(rest.tolist()),
        standing=standing,
    )
    if covariance is None:
        covariance = identification.fitted.estimate.covariance
    columns = estimated_columns(identification.dynamics, identification.names)
    return TorqueErrorModel(columns, covariance, discrepancy)


def _interval_factors(folds: Sequence[_HeldOut], weights: np.ndarray, run_count: int) -> np.ndarray:
    """Return factors (rows,) of predicted sigmas with which ± 1.96 sigma cover 95 % of errors on other motion.

    The size of a row's normalised errors varies from run to run (a run is a set of time blocks held out together). The
    variance of its logarithm over runs, regularised towards the mean of all rows, shows how large the errors of one
    more run may be: Student's t distribution with that variance.

    Args:
        folds: held-out runs, then halves.
        weights: (rows, 3) κ, v and u.
        run_count: number of runs.
    """
    log_sizes, normalised = [], []
    for row, row_weights in enumerate(weights):
        row_log_sizes, row_errors = _normalised_errors(folds, row, row_weights)
        log_sizes.append(row_log_sizes)
        normalised.append(row_errors)
    variances = [np.var(log_size[:run_count], ddof=1) for log_size in log_sizes]
    variance = np.array(variances)
    freedom = run_count - 1 + BORROWED
    variance = ((run_count - 1) * variance + BORROWED * variance.mean()) / freedom
    variance_of_next_run = variance * (1.0 + 1.0 / run_count)

    quantiles = stdtrit(freedom, CHANCES)
    factors = np.empty(len(weights))
    for row, errors in enumerate(normalised):
        deviation = np.sqrt(variance_of_next_run[row])
        possible_sizes = np.exp(log_sizes[row].mean() + deviation * (OPTIMISM + quantiles))
        factors[row] = np.quantile(np.outer(errors, possible_sizes), COVERED) / SIGMAS
    return factors


@dataclass(frozen=True, eq=False)
class _Samples:
    """Motion and residuals of M decimated samples of all recordings.

    Attributes:
        states: (3, M, n) q, v and a.
        torque, error: (M, rows) recorded torque, and prediction error of the final model [N m or N].
        matrix: (M, rows, p) filtered columns.
        block: (M,) number of the time block; -1 for samples that are not used.
        trajectory, trajectory_block: (K, 2 n) q and v at up to the full rate, and their time blocks (K,).
        triangles: R factors of all rows by time block and torque row.
        values: (p,) parameters estimated from all rows.
    """

    states: np.ndarray
    torque: np.ndarray
    error: np.ndarray
    matrix: np.ndarray
    block: np.ndarray
    trajectory: np.ndarray
    trajectory_block: np.ndarray
    triangles: Triangles
    values: np.ndarray

    def training_range(self, selected: np.ndarray | slice = slice(None)) -> TorqueDiscrepancy:
        """Return the range of the selected states, with the standard deviations of all states.

        The error terms of the result are empty.
        """
        states = self.states[:, selected]
        lower = tuple(map(tuple, states.min(axis=1).tolist()))
        upper = tuple(map(tuple, states.max(axis=1).tolist()))
        deviation = np.maximum(self.states.std(axis=1), 1e-6)
        scale = tuple(map(tuple, deviation.tolist()))
        return TorqueDiscrepancy((), (), (), lower, upper, scale)


def _collect_samples(identification: Identification, cases: Sequence[Case]) -> _Samples:
    """Return motion and residuals of all recordings at their decimated samples.

    Args:
        identification: the model and its rows.
        cases: the training recordings.
    """
    dynamics = identification.dynamics
    decimator = common_decimator(cases, identification.settings)
    states = []
    torques = []
    errors = []
    matrices = []
    blocks = []
    trajectories = []
    trajectory_blocks = []
    for case, rows in zip(cases, identification.rows):
        motion = case.motion
        index = kept(motion.segment, decimator)
        q = motion.q[index]
        v = motion.v[index]
        a = motion.a[index]
        memory = segmented_states(dynamics.model.columns, case)[:, index]
        torque = np.asarray(case.target[index])
        error = torque - dynamics.model.torque(dynamics.values, q, v, a, case.carried, memory)
        matrix = rows.matrix
        if matrix.shape[1] != error.shape[1]:
            # Drop the zero rows of the other recordings, see `ObservationRows.by_recording`.
            matrix = matrix.sum(axis=1, keepdims=True)
        states.append(np.stack([q, v, a]))
        torques.append(torque)
        errors.append(error)
        matrices.append(matrix)
        blocks.append(np.where(motion.weight[index] > 0.5, rows.block, -1))

        thinned = np.arange(0, len(motion), max(1, decimator.factor // FINER_BY))
        nearest = np.searchsorted(index, thinned).clip(max=len(index) - 1)
        trajectories.append(np.hstack([motion.q, motion.v])[thinned])
        trajectory_blocks.append(rows.block[nearest])
    triangles = triangulate(identification.rows)
    all_blocks = range(triangles.groups // len(identification.fitted.std))
    values, _ = _estimate(identification, triangles, all_blocks)
    block = np.concatenate(blocks)
    trajectory = np.concatenate(trajectories)
    trajectory_block = np.concatenate(trajectory_blocks)
    return _Samples(
        states=np.concatenate(states, axis=1),
        torque=np.concatenate(torques),
        error=np.concatenate(errors),
        matrix=np.concatenate(matrices),
        block=block,
        trajectory=trajectory,
        trajectory_block=trajectory_block,
        triangles=triangles,
        values=values,
    )


def _independent_runs(samples: _Samples, blocks: Sequence[int]) -> list[np.ndarray]:
    """Return sets of blocks to hold out together ("runs"): each block with all blocks that repeat its motion.

    Another block repeats a block's motion if it passes through at least half of its states
    (`calib.data.signals.persistency.repeats`). If this gives fewer than two runs, each block is a run.

    Args:
        samples: motion of all recordings.
        blocks: numbers of the time blocks.
    """
    spread = np.maximum(samples.trajectory.std(axis=0), 1e-6)
    trees = {}
    for block in blocks:
        trees[block] = KDTree(samples.trajectory[samples.trajectory_block == block] / spread)
    runs: list[tuple[int, ...]] = []
    for block in blocks:
        positions_and_speeds = samples.states[:2, samples.block == block].transpose(1, 0, 2)
        visited = positions_and_speeds.reshape(-1, len(spread)) / spread
        run = []
        for candidate, tree in trees.items():
            if candidate == block or share_met(tree, visited) >= REPEATED:
                run.append(candidate)
        if tuple(run) not in runs and len(run) < len(blocks):
            runs.append(tuple(run))
    if len(runs) < 2:
        return [np.array([block]) for block in blocks]
    return [np.array(run) for run in runs]


def _estimate(identification: Identification, data: Triangles, blocks: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters (p,) estimated from some time blocks, and a root (p, k) of their covariance.

    Args:
        identification: the model, with weights and prior.
        data: R factors by time block and torque row.
        blocks: numbers of the time blocks in use.
    """
    fitted = identification.fitted
    base_count = identification.base.b
    friction_group = np.asarray(identification.friction.groups, dtype=int)
    group = np.concatenate([np.full(base_count, -1), friction_group])
    prior_rows, tempered_rows = None, None
    if identification.prior is not None:
        prior_rows = identification.prior.widened(len(group) - base_count)
        if prior_rows is not None:
            tempered_rows = np.sqrt(identification.prior.tempering) * prior_rows
    rows = len(fitted.std)
    pooled = pool(data, rows, blocks)
    values, ridges = time_folds.estimate(pooled, fitted.std, fitted.inflation, group, tempered_rows)

    # The covariance of the columns that no ridge has switched off, inverted in units of a diagonal of 1.
    active = np.flatnonzero(ridges > 0.0)
    weight = 1.0 / (fitted.std * np.sqrt(fitted.inflation))
    whitened = pooled.factors[:, :, :-1] * weight[:, None, None]
    whitened = whitened.reshape(-1, len(group))
    if prior_rows is not None:
        whitened = np.vstack([whitened, prior_rows[:, :-1]])
    square = whitened.T @ whitened
    prior_information = np.diag(ridges[active] ** -2.0)
    information = square[np.ix_(active, active)] + prior_information
    unit = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(information * np.outer(unit, unit))
    root = np.zeros((len(group), len(active)))
    size = np.sqrt(np.maximum(eigenvalues, 1e-10))
    root[active] = unit[:, None] * vectors / size
    return values, root


def _coulomb_friction(identification: Identification) -> np.ndarray:
    """Return the Coulomb friction (rows,) of torque rows that contain a motor's friction, else zero [N m or N].

    Args:
        identification: the model with its parameter values.
    """
    # Recordings that are weighed apart repeat the rows of the model.
    coulomb = identification.rows[0].coulomb[: identification.dynamics.model.rows]
    return np.sum(np.abs(identification.fitted.estimate.values) * coulomb, axis=1)


def _standing_speeds(identification: Identification, friction: np.ndarray) -> np.ndarray:
    """Return the speeds (n,) below which joints count as at rest, the width of Coulomb's sign [rad/s or m/s].

    They are zero if no torque row contains friction.

    Args:
        identification: the model, with the width of Coulomb's sign.
        friction: (rows,) Coulomb friction of the torque rows [N m or N].
    """
    n = identification.dynamics.model.n
    if not friction.any():
        return np.zeros(n)
    return np.array(per_joint(identification.settings.v0, n, "v0"), dtype=float)


def _hold_out(
    identification: Identification, samples: _Samples, run: Sequence[int] | np.ndarray, standing_speeds: np.ndarray
) -> _HeldOut:
    """Return the errors on the blocks of a run, predicted with parameters estimated from all other blocks.

    Errors are limited to the rms torque: a fold that fails completely is not representative of the final model.

    Args:
        identification: the model and its rows.
        samples: motion and residuals.
        run: numbers of the held-out blocks.
        standing_speeds: (n,) speeds below which a joint counts as at rest [rad/s or m/s].
    """
    block_count = samples.triangles.groups // len(identification.fitted.std)
    remaining = [block for block in range(block_count) if block not in run]
    values, covariance_root = _estimate(identification, samples.triangles, remaining)

    held_out = np.isin(samples.block, run)
    matrix = samples.matrix[held_out]
    q, v, a = samples.states[:, held_out]
    torque_rms = np.sqrt(np.mean(samples.torque**2, axis=0))
    errors = samples.error[held_out] + matrix @ (samples.values - values)
    by_parameters = np.sum((matrix @ covariance_root) ** 2, axis=2)
    rows = by_parameters.shape[1]
    training_range = samples.training_range(~held_out)
    distance = training_range.distance(q, v, a, rows)
    variance_terms = np.stack([by_parameters, np.ones_like(by_parameters), distance], axis=2)
    standing = tuple(standing_speeds.tolist())
    with_rest = replace(training_range, rest=(0.0,) * rows, standing=standing)
    moves = ~with_rest.at_rest(v, rows)
    return _HeldOut(errors.clip(-torque_rms, torque_rms), variance_terms, moves)


def _rest_floors(folds: Sequence[_HeldOut], friction: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the variance (rows,) of unmodelled effects for joints at rest [N² m² or N²].

    Args:
        folds: held-out runs.
        friction: (rows,) Coulomb friction [N m or N].
        weights: (rows, 3) κ, v and u in motion.
    """
    expected = weights[:, 1] + friction**2 / 3.0
    total = BORROWED * expected
    standstills = np.full(len(friction), BORROWED)
    for fold in folds:
        for row in range(len(friction)):
            rests = ~fold.moves[:, row]
            if not rests.any():
                continue
            begins = rests[1:] & ~rests[:-1]
            count = max(1, int(np.sum(begins) + rests[0]))
            total[row] += count * float(np.mean(fold.errors[rests, row] ** 2))
            standstills[row] += count
    return total / standstills


def _variance_weights(folds: Sequence[_HeldOut], run_count: int) -> np.ndarray:
    """Return the weights κ, v, u (rows, 3) of the error variance in motion, regularised by all rows' errors.

    In units of a row's mean square error, κ and u / v are comparable between rows. A row's errors are supplemented by
    those of all other rows, which count as `BORROWED` blocks, and by two expectations: that the covariance is correct
    (counting as one block), and that errors grow beyond the training range, which repeated motion hardly tests.

    Args:
        folds: held-out runs, then halves.
        run_count: number of runs.
    """
    errors = np.concatenate([fold.errors for fold in folds])
    terms = np.concatenate([fold.variance_terms for fold in folds])
    moves = np.concatenate([fold.moves for fold in folds])
    step = max(1, len(errors) // MAX_WEIGHT_SAMPLES)
    squares = errors[::step].T ** 2
    terms = terms[::step].transpose(1, 0, 2).copy()
    counts = moves[::step].T.astype(float)
    # A joint that never moves is assessed at rest.
    counts[counts.sum(axis=1) < 0.5 * run_count] = 1.0

    weighted = np.sum(squares * counts, axis=1)
    mean_square = np.maximum(weighted / counts.sum(axis=1), 1e-300)
    squares = np.maximum(squares / mean_square[:, None], MIN_ERROR**2)
    terms[:, :, 0] /= mean_square[:, None]

    row_count, sample_count = squares.shape
    expected_squares = np.array([1.0, 2.0])
    expected_terms = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, DOUBLING]])
    expected_counts = np.array([sample_count / run_count, max(1.0, PRIOR * sample_count)])
    weights = np.empty((row_count, 3))
    for row in range(row_count):
        other_rows = np.delete(np.arange(row_count), row)
        thinned = slice(None, None, max(1, len(other_rows)))
        other_squares = squares[other_rows, thinned].ravel()
        other_terms = terms[other_rows, thinned].reshape(-1, 3)
        other_counts = BORROWED / run_count * counts[other_rows, thinned].ravel()
        mean_term = float(terms[row, :, 0].mean())
        scale = np.array([max(mean_term, 1e-300), 1.0, 1.0])
        all_squares = np.concatenate([squares[row], other_squares, expected_squares])
        all_terms = np.concatenate([terms[row], other_terms, expected_terms])
        all_counts = np.concatenate([counts[row], other_counts, expected_counts])
        equal = np.full(3, 1.0 / 3.0)
        row_weights = variance_weights(all_squares, all_terms / scale, equal, all_counts)
        weights[row] = row_weights / scale * [1.0, mean_square[row], mean_square[row]]
    return weights


def _normalised_errors(folds: Sequence[_HeldOut], row: int, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the log sizes of a row's normalised errors in each fold, and all its errors divided by sigma and size.

    Normalised errors are errors over predicted sigma; their size is their rms. Errors are those in motion, or at rest
    in a fold in which the row's joint does not move.

    Args:
        folds: held-out blocks.
        row: torque row.
        weights: (3,) κ, v and u of this row.
    """
    squares, variances = [], []
    for fold in folds:
        moves = fold.moves[:, row]
        selected = moves if moves.any() else slice(None)
        squares.append(fold.errors[selected, row] ** 2)
        variances.append(fold.variance_terms[selected, row] @ weights)
    mean_square = float(np.mean(np.concatenate(squares)))
    min_variance = max(MIN_ERROR**2 * mean_square, 1e-30)

    log_sizes, normalised = [], []
    for square, variance in zip(squares, variances):
        ratio = np.sqrt(square / np.maximum(variance, min_variance))
        log_size = 0.5 * np.log(np.mean(np.minimum(ratio, MAX_ERROR) ** 2) + 1e-12)
        log_sizes.append(log_size)
        normalised.append(ratio / np.exp(log_size))
    return np.array(log_sizes), np.concatenate(normalised)

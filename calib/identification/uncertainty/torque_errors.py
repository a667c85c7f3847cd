"""Expected errors of predicted torques: due to the parameters' uncertainty, and due to unmodelled effects.

    E e_j² = κ_j w_j Σ w_jᵀ + v_j + u_j log(1 + d_j²)

where w_j is the torque row's regressor, Σ the covariance of the parameters, and d_j the distance of its joint's q, v, a
from the training range, each in units of its standard deviation. The effect of the parameters far from the training
range is in Σ. Unmodelled effects (friction of another form, ripple) have a limited size and grow slowly with distance,
hence the logarithm. κ, v and u are estimated from errors on held-out time
(`calib.identification.uncertainty.learned_torque_errors`).

`Uncertainty` contains the parameters' part alone: standard deviations of torques from the covariance.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.dynamics.base import standard_name
from calib.dynamics.idim import friction_states
from calib.errors import UsageError, refused_as
from calib.estimation.whiteness import inflation
from calib.folders import COVARIANCE, read_covariance
from calib.identification.prediction import Dynamics, IntervalCoverage
from calib.identification.rows import Case, segmented_states
from calib.records import evenly
from calib.trajectories.timing.profile import Sampled

BLOCK = 4000
"""Samples whose regressor is held in memory at a time."""
COVERED, SIGMAS = 0.95, 1.96
"""Share of errors that intervals are to contain, and their half width in standard deviations."""
MAX_INTERVAL_SAMPLES = 5000
"""Samples of a recording at which intervals are evaluated, at most."""
MAX_OUTSIDE = 0.05
"""Share of the training range by which a motion may leave it before it counts as extrapolation (our choice)."""
EXTRAPOLATIONS = (
    "outside the range of joint",
    "faster than in training at joint",
    "accelerating more than in training at joint",
)


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """An identified model with the covariance of its parameters.

    Attributes:
        dynamics: the model; values of payloads that are not attached are zero.
        carried: labels of the attached payloads.
        columns: (k,) indices of the estimated columns of the regressor.
        covariance: (k, k) covariance of the estimated parameters.
    """

    dynamics: Dynamics
    carried: tuple[str, ...]
    columns: np.ndarray
    covariance: np.ndarray

    def sigma(self, sampled: Sampled) -> np.ndarray:
        """Return the largest standard deviation √(w Σ wᵀ) of each joint's torque along a motion (n,) [N m or N].

        Args:
            sampled: times, positions, velocities and accelerations of the motion; w is the torque's regressor, Σ the
                covariance.
        """
        state = sampled.q, sampled.v, sampled.a
        variances = parameter_variances(self.dynamics, self.columns, self.covariance, *state, self.carried)
        return np.sqrt(variances.max(axis=0))[-sampled.q.shape[1] :]


def estimated_columns(dynamics: Dynamics, names: Sequence[str]) -> np.ndarray:
    """Return the regressor columns (k,) of the estimated parameters, by their names.

    Args:
        dynamics: the model.
        names: names of the k estimated parameters; for a base parameter such as ``ZZ1R``, the column is that of
            ``ZZ1``.

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
    """Return the variances w Σ wᵀ (N, rows) of torques [N² m² or N²] due to the parameters' covariance.

    Args:
        dynamics: the model.
        columns: (k,) indices of the estimated columns.
        covariance: Σ (k, k).
        q, v, a: (N, n) states.
        carried: labels of the attached payloads; None: all.
        states: (s, N) states of friction with hysteresis; None: computed here, with q as one uninterrupted record.
    """
    model = dynamics.model
    if states is None:
        states = friction_states(model, q)
    # A root of the covariance, computed in units in which its diagonal is 1.
    unit = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    root = unit[:, None] * vectors * np.sqrt(np.maximum(eigenvalues, 0.0))

    load_dependent = bool(model.with_load())
    variances = []
    for start in range(0, len(q), BLOCK):
        block = slice(start, start + BLOCK)
        q_block = np.ascontiguousarray(q[block])
        v_block = np.ascontiguousarray(v[block])
        a_block = np.ascontiguousarray(a[block])
        load = None
        if load_dependent:
            load = model.transmitted(dynamics.values, q_block, v_block, a_block, carried)
        regressor = model.regressor(q_block, v_block, a_block, load, carried, states[:, block])
        by_parameter = regressor[:, :, columns] @ root
        variances.append(np.sum(by_parameter**2, axis=2))
    return np.concatenate(variances)


def read_uncertainty(folder: Path, dynamics: Dynamics, carried: Sequence[str]) -> Uncertainty | None:
    """Return an identified model with the covariance of its parameters, read from its folder; None without the file.

    Args:
        folder: folder of the identification.
        dynamics: the model of this folder.
        carried: labels of the attached payloads.

    Raises:
        UsageError: if covariance and model do not match.
    """
    if not (folder / COVARIANCE).is_file():
        return None
    names, covariance = read_covariance(folder)
    with refused_as(
        UsageError, ValueError, f"{folder}/covariance.csv and dynamics.json do not match: {{}}; identify again"
    ):
        columns = estimated_columns(dynamics, names)
    return Uncertainty(dynamics, tuple(carried), columns, covariance)


@dataclass(frozen=True)
class TorqueDiscrepancy:
    """Variance model of the torque errors, estimated on held-out time.

    Attributes:
        parameters: (rows,) κ, factor of the parameters' variance.
        floor: (rows,) v [N² m² or N²], variance of unmodelled effects.
        beyond: (rows,) u, additional variance per log(1 + d²), with d the distance from the training data.
        lower, upper, scale: (3, n) smallest and largest q, v, a of the training data, and their standard deviations.
        rest: (rows,) variance that replaces v while a joint is at rest [N² m² or N²]; () in files of earlier versions.
        standing: (n,) speeds below which a joint counts as at rest [rad/s or m/s]; () in files of earlier versions.
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
        """Return the mask (N, rows) of torque rows whose joint is at rest, from velocities v (N, n).

        Args:
            v: (N, n) joint velocities [rad/s or m/s].
            rows: number of torque rows.
        """
        if not self.rest:
            return np.zeros((len(v), rows), dtype=bool)
        stands = np.abs(v) < np.array(self.standing)
        repetitions, remainder = divmod(rows, stands.shape[1])
        if remainder:
            # Rows that are not of single joints never stand.
            return np.zeros((len(v), rows), dtype=bool)
        return np.tile(stands, repetitions)

    def floors(self, v: np.ndarray, rows: int) -> np.ndarray:
        """Return the variance of unmodelled effects (N, rows) [N² m² or N²] for velocities v (N, n).

        It is v_j in motion, and `rest` while the joint is at rest.

        Args:
            v: (N, n) joint velocities [rad/s or m/s].
            rows: number of torque rows.
        """
        moving = np.broadcast_to(np.array(self.floor), (len(v), rows))
        if not self.rest:
            return moving
        return np.where(self.at_rest(v, rows), np.array(self.rest), moving)

    def distance(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, rows: int) -> np.ndarray:
        """Return log(1 + d²) (N, rows), with d the distance of states q, v, a (N, n) from the training range.

        d has no unit: distances in q, v and a are divided by the standard deviations of the training data. It is that
        of the row's joint; for rows of other torques than those of single joints, that of all joints together.

        Args:
            q, v, a: (N, n) states [rad or m, and per s, per s²].
            rows: number of torque rows.
        """
        scaled = self._excess(q, v, a) / np.array(self.scale)[:, None]
        square = np.sum(scaled**2, axis=0)
        repetitions, remainder = divmod(rows, square.shape[1])
        if remainder:
            total = square.sum(axis=1)[:, None]
            return np.log1p(np.broadcast_to(total, (len(q), rows)))
        return np.log1p(np.tile(square, repetitions))

    def extrapolated(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the mask (3, N, n) of q, v, a (first index) of each joint that are outside the training range."""
        training_range = np.array(self.upper) - np.array(self.lower)
        return self._excess(q, v, a) > MAX_OUTSIDE * training_range[:, None]

    def _excess(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the distances (3, N, n) of q, v, a of each joint from the training range; zero within it.

        They are in units of the standard deviations of the training data.
        """
        states = np.stack([q, v, a])
        lower = np.array(self.lower)[:, None]
        upper = np.array(self.upper)[:, None]
        return np.maximum(lower - states, 0.0) + np.maximum(states - upper, 0.0)


@dataclass(frozen=True, eq=False)
class TorqueErrorModel:
    """Model of the standard deviation of torque prediction errors.

    Attributes:
        columns: (k,) indices of the estimated columns of the model's regressor.
        covariance: (k, k) covariance of the estimated parameters.
        discrepancy: variance model of the errors.
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
        """Return standard deviations (N, rows) of errors of predicted torques [N m or N]; ± 1.96 of them cover 95 %.

        Args:
            dynamics: the model that predicts.
            q, v, a: (N, n) states [rad or m, and per s, per s²].
            carried: labels of the attached payloads; None: all.
            states: (s, N) states of friction with hysteresis; None: computed here, with q as one uninterrupted record.
        """
        discrepancy = self.discrepancy
        by_parameters = parameter_variances(dynamics, self.columns, self.covariance, q, v, a, carried, states)
        rows = by_parameters.shape[1]
        by_distance = discrepancy.distance(q, v, a, rows) * np.array(discrepancy.beyond)
        variance = np.array(discrepancy.parameters) * by_parameters + discrepancy.floors(v, rows) + by_distance
        return np.sqrt(variance)


@dataclass(frozen=True, eq=False)
class TorqueIntervals:
    """Predicted error intervals of a model at M samples of a recording, and whether they contain the errors.

    Attributes:
        index: (M,) indices of the samples.
        sigma: (M, rows) predicted standard deviations [N m or N].
        contains: (M, rows) whether the actual errors are within 1.96 predicted standard deviations.
        valid: (M,) False at lost samples, which are not counted.
        standing: (M, rows) whether the row's joint is at rest.
        extrapolated: (3, M, n) whether q, v, a (first index) of each joint are outside the training range.
    """

    index: np.ndarray
    sigma: np.ndarray
    contains: np.ndarray
    valid: np.ndarray
    standing: np.ndarray
    extrapolated: np.ndarray

    @property
    def covered(self) -> float:
        """Share of all errors that are within their intervals."""
        return float(np.mean(self.contains[self.valid]))

    @property
    def joints(self) -> np.ndarray:
        """Share of the errors of each torque row that are within their intervals (rows,)."""
        return np.asarray(np.mean(self.contains[self.valid], axis=0))

    @property
    def independent(self) -> np.ndarray:
        """Number of independent errors of each torque row (rows,), from the autocorrelation of `contains`."""
        contains = self.contains[self.valid].astype(float)
        return np.array([len(contains) / inflation(column) for column in contains.T])

    @property
    def median(self) -> np.ndarray:
        """Median half width of the intervals in motion (rows,) [N m or N]; at rest for a joint that does not move."""
        moving = self._median(~self.standing)
        return np.where(np.isfinite(moving), moving, self._median(self.standing))

    @property
    def median_at_rest(self) -> np.ndarray:
        """Median half width of the intervals at rest (rows,) [N m or N]; NaN for a joint that is never at rest."""
        return self._median(self.standing)

    def _median(self, selected: np.ndarray) -> np.ndarray:
        """Return the median half width of each row (rows,) over the selected samples (M, rows); NaN without any."""
        medians = np.full(selected.shape[1], np.nan)
        for row in range(selected.shape[1]):
            sigma = self.sigma[selected[:, row], row]
            if len(sigma):
                medians[row] = SIGMAS * np.median(sigma)
        return medians

    @property
    def beyond(self) -> np.ndarray:
        """Mask (M,) of samples in which any joint is outside the training range."""
        return np.asarray(self.extrapolated.any(axis=(0, 2)))

    def coverage(self) -> IntervalCoverage:
        """Return the record of the shares of errors that are within their intervals."""
        samples = int(self.valid.sum())
        beyond_percent = 100.0 * float(self.beyond.mean())
        return IntervalCoverage(
            100.0 * self.covered, 100.0 * self.joints, self.median, samples, beyond_percent, self.median_at_rest
        )

    def ways(self, joints: Sequence[str]) -> list[str]:
        """Return texts on how the motion leaves the training range: position, speed or acceleration, and which joints.

        `joints` are the names of the joints.
        """
        texts = []
        for text, by_joint in zip(EXTRAPOLATIONS, np.any(self.extrapolated, axis=1).tolist()):
            names = [name for name, extrapolated in zip(joints, by_joint) if extrapolated]
            if names:
                texts.append(f"{text} {', '.join(names)}")
        return texts


def intervals(errors: TorqueErrorModel, dynamics: Dynamics, case: Case, predicted: np.ndarray) -> TorqueIntervals:
    """Return a model's 95 % error intervals on a recording, and which errors are within them.

    Args:
        errors: model of the errors.
        dynamics: the model that predicts.
        case: the recording.
        predicted: (N, rows) predicted torques [N m or N].
    """
    motion = case.motion
    count = len(motion)
    index = evenly(count, MAX_INTERVAL_SAMPLES)
    q = np.asarray(motion.q[index])
    v = np.asarray(motion.v[index])
    a = np.asarray(motion.a[index])
    states = segmented_states(dynamics.model.columns, case)[:, index]
    sigma = errors.sigma(dynamics, q, v, a, case.carried, states)
    contains = np.abs(case.target[index] - predicted[index]) <= SIGMAS * sigma
    valid = np.asarray(motion.weight[index] > 0.5)
    standing = errors.discrepancy.at_rest(v, sigma.shape[1])
    extrapolated = errors.discrepancy.extrapolated(q, v, a)
    return TorqueIntervals(index, sigma, contains, valid, standing, extrapolated)

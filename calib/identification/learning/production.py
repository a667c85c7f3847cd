"""Recursive update of identified dynamics by further logs, with friction and drive gains that drift.

The state of `calib.estimation.recursive` contains changes of the estimated parameters since the first identification,
x, and of the torque rows' gains, ε:

    τ_j - τ̂_j = w_j x + ε_j τ̂_j + e_j,

with τ̂_j the torque predicted by the first identification and w_j its regressor. Friction (group `FRICTION`) and gains
(`GAIN`) drift with date, bodies and motor inertia do not. Rows are weighted by the spectral density of the first
identification's errors; a standstill counts as one row.

A log is first predicted. If its errors exceed what `TorqueDiscrepancy` and the parameters' covariance predict, one
cause after another is added to the model (Baarda 1968): friction or gain of a joint, the unit of all torques, a load at
the last link. The cause with the best criterion of Schwarz (1978) is accepted if the rest is as predicted. A load or
another unit, which would pass into inertias that do not drift, is accepted within these errors, too, if the criterion
gains more than one per independent row: on open recordings without a change it gains 0.3 at most, with 0.5 kg on a
UR10e 2.3 to 4.1.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import scipy.linalg

from calib.data.signals.filtering import Decimator, decimate, kept
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import IdentificationModel
from calib.estimation.recursive import STILL, DriftBank, start
from calib.estimation.triangles import retriangulate
from calib.estimation.whiteness import inflation
from calib.identification.prediction import Dynamics, predict
from calib.identification.prior import MAX_INFLATION, TEMPERING
from calib.identification.rows import Case, observe, observe_terms, segments, thinned
from calib.identification.uncertainty.torque_errors import SIGMAS, TorqueDiscrepancy

FRICTION, GAIN = 0, 1
"""Drift groups of the parameters."""
FIRST_GAIN_SIGMA = 1e-6
"""Standard deviation of a gain's change at the first identification, whose torques define the gain."""
BEYOND = 2.0
"""Ratio of a joint's errors to those predicted, rms, from which on they are not as predicted (our choice)."""
MIN_COVERED = 0.90
"""Share of a joint's errors within 1.96 standard deviations below which they are not as predicted (our choice)."""
OUTSIDE_SHARE = 0.05
"""Share of normally distributed errors beyond 1.96 standard deviations."""
CHANCE_SIGMAS = 3.0
"""Standard deviations of chance by which this share may be lower."""
SURE_SIGMAS = 3.0
"""Standard deviations from which on a change is one (our choice)."""
STEADY_SHAPES = ("acceleration",)
"""Shapes of drive terms that do not drift: the motors' inertia."""
LOAD_PARAMETERS = 10
"""Number of the standard parameters of a load."""
UNOBSERVED = 1e-6
"""Relative singular value below which a log says nothing of a combination of a cause's columns."""
DEPENDENT = 1e-8
"""Relative singular value below which columns of a log count as dependent."""
MIN_TORQUE = 1e-12
"""Least torque that others are divided by [N m or N]."""


@dataclass(frozen=True, eq=False)
class WorkingModel:
    """An identified model whose parameters further logs update.

    Attributes:
        dynamics: the first identification's model with its values, which are the reference of all changes.
        names, units: names and units of the p parameters: k estimated ones, then one gain per torque row.
        columns: (k,) indices of the estimated parameters in the model.
        values: (k,) their values in the first identification.
        density: (rows,) spectral density of its torque errors [N² m² s or N² s].
        discrepancy: distribution of its torque errors; None if too little was recorded for one.
        row_names: names of the torque rows.
    """

    dynamics: Dynamics[IdentificationModel]
    names: tuple[str, ...]
    units: tuple[str, ...]
    columns: np.ndarray
    values: np.ndarray
    density: np.ndarray
    discrepancy: TorqueDiscrepancy | None
    row_names: tuple[str, ...]

    @property
    def k(self) -> int:
        """Number of the estimated parameters, without the gains."""
        return len(self.columns)

    def term(self, parameter: int) -> DriveTerm | None:
        """Return the drive term of an estimated parameter (index below `k`); None for a parameter of a body."""
        model = self.dynamics.model
        column = int(self.columns[parameter]) - model.inertial
        if column < 0:
            return None
        return model.columns[column]

    def drift_groups(self) -> np.ndarray:
        """Return the drift group (p,) of each parameter."""
        groups = np.full(len(self.names), GAIN)
        for parameter in range(self.k):
            term = self.term(parameter)
            drifts = term is not None and term.shape not in STEADY_SHAPES
            groups[parameter] = FRICTION if drifts else STILL
        return groups

    def first_state(self, covariance: np.ndarray) -> DriftBank:
        """Return the state before any log, from the covariance (k, k) of the first identification."""
        p = len(self.names)
        joint_covariance = np.eye(p) * FIRST_GAIN_SIGMA**2
        joint_covariance[: self.k, : self.k] = covariance
        sizes = np.ones(p)
        sizes[: self.k] = np.sqrt(self.values**2 + np.diag(covariance))
        return start(np.zeros(p), joint_covariance, self.drift_groups(), sizes, prior_count=float(self.k))

    def updated(self, changes: np.ndarray) -> Dynamics[IdentificationModel]:
        """Return the model with changes (p,) of its parameters; those of the gains scale no parameter."""
        values = np.array(self.dynamics.values)
        values[self.columns] = self.values + changes[: self.k]
        return Dynamics(self.dynamics.model, values)


@dataclass(frozen=True, eq=False)
class LogRows:
    """Rows of one log, decimated to M samples.

    Attributes:
        matrix: (M, rows, p) regressor of the parameters' changes.
        load: (M, rows, 10) regressor of a load at the last link.
        target: (M, rows) measured torque minus that of the first identification [N m or N].
        torque: (M, rows) measured torque.
        present: (M, rows) mask of the rows that are used.
        standing: (M, rows) mask of the rows whose joint is at rest.
        sigma: (M, rows) standard deviation that each row is weighted by [N m or N].
        floor: (M, rows) variance of the errors beside that of the parameters [N² m² or N²].
        extrapolated: share of the samples outside the first identification's range of motion.
    """

    matrix: np.ndarray
    load: np.ndarray
    target: np.ndarray
    torque: np.ndarray
    present: np.ndarray
    standing: np.ndarray
    sigma: np.ndarray
    floor: np.ndarray
    extrapolated: float

    @property
    def whitened(self) -> np.ndarray:
        """The used rows [W y] (N, p + 1), divided by their standard deviations."""
        return self._whitened(self.matrix)

    def with_load(self) -> np.ndarray:
        """Return the used rows [W load y] (N, p + 11), divided by their standard deviations."""
        return self._whitened(np.concatenate([self.matrix, self.load], axis=2))

    def _whitened(self, matrix: np.ndarray) -> np.ndarray:
        augmented = np.concatenate([matrix, self.target[:, :, None]], axis=2)
        return (augmented / self.sigma[:, :, None])[self.present]

    def count(self, errors: np.ndarray) -> float:
        """Return the number of independent rows, by the autocorrelation of errors (M, rows) in motion."""
        total = 0.0
        for row in range(errors.shape[1]):
            moving = self.present[:, row] & ~self.standing[:, row]
            if moving.sum() > 1:
                total += moving.sum() / min(inflation(errors[moving, row]), MAX_INFLATION)
            at_rest = self.present[:, row] & self.standing[:, row]
            total += float(np.sum(np.diff(np.append(0, at_rest.astype(int))) > 0))
        return total


def log_rows(model: WorkingModel, case: Case, decimator: Decimator) -> LogRows:
    """Return the rows of a log for the update of a model.

    Args:
        model: the model.
        case: the log, with the torque rows of the model.
        decimator: filter and decimation.
    """
    dynamics = model.dynamics
    segment = case.motion.segment
    predicted = predict(dynamics, case)
    first_torque = decimate(predicted, decimator, segment)
    torque = decimate(case.target, decimator, segment)
    present = thinned(case.present, segment, decimator)

    index = kept(segment, decimator)
    velocity = case.motion.v[index]
    rate = case.motion.rate / decimator.factor
    rows = torque.shape[1]
    floor = np.broadcast_to(model.density * rate, torque.shape)
    standing = np.zeros(torque.shape, dtype=bool)
    extrapolated = 0.0
    sigma = np.sqrt(floor)
    if model.discrepancy is not None:
        states = case.motion.q[index], velocity, case.motion.a[index]
        at_rest = model.discrepancy.at_rest(case.motion.v, rows)
        standing = thinned(at_rest, segment, decimator)
        distance = model.discrepancy.distance(*states, rows)
        floor = model.discrepancy.floors(velocity, rows) + distance * np.array(model.discrepancy.beyond)
        extrapolated = float(model.discrepancy.extrapolated(*states).any(axis=(0, 2)).mean())
        at_rest_sigma = np.sqrt(floor * _standstill_lengths(standing))
        sigma = np.where(standing, np.maximum(at_rest_sigma, sigma), sigma)
    sigma = sigma * np.sqrt(TEMPERING)

    matrix = np.zeros((*torque.shape, len(model.names)))
    matrix[:, :, : model.k] = _parameter_columns(model, case, decimator)
    undecided = [k for k in range(model.k) if _undecided(model.term(k))]
    matrix[:, :, undecided] = np.where(standing[:, :, None], 0.0, matrix[:, :, undecided])
    for row in range(rows):
        matrix[:, row, model.k + row] = first_torque[:, row]
    bodies = _bodies_alone(dynamics.model)
    last_body = int(np.flatnonzero(bodies.bodies.coordinates >= 0)[-1])
    load_columns = LOAD_PARAMETERS * last_body + np.arange(LOAD_PARAMETERS)
    return LogRows(
        matrix=matrix,
        load=observe(bodies, load_columns, case, decimator).matrix,
        target=torque - first_torque,
        torque=torque,
        present=present,
        standing=standing,
        sigma=sigma,
        floor=floor,
        extrapolated=extrapolated,
    )


def _bodies_alone(model: IdentificationModel) -> IdentificationModel:
    """Return a model without its drive terms, some of which need transmitted torques."""
    return replace(model, terms=())


def _undecided(term: DriveTerm | None) -> bool:
    """Return whether a drive term's torque is unknown for a joint at rest; False for bodies (None)."""
    return term is not None and term.form.undecided_at_rest


def _parameter_columns(model: WorkingModel, case: Case, decimator: Decimator) -> np.ndarray:
    """Return the regressor (M, rows, k) of the estimated parameters, filtered and decimated."""
    dynamics = model.dynamics
    inertial = model.columns < dynamics.model.inertial
    bodies = observe(_bodies_alone(dynamics.model), model.columns[inertial], case, decimator).matrix
    terms = [dynamics.model.columns[column - dynamics.model.inertial] for column in model.columns[~inertial]]
    load = None
    if dynamics.model.with_load():
        load = dynamics.transmitted(case)
    drives = observe_terms(terms, case, decimator, load, dynamics.model.torque_rows)
    columns = np.zeros((*bodies.shape[:2], model.k))
    columns[:, :, inertial] = bodies
    columns[:, :, ~inertial] = drives
    return columns


def _standstill_lengths(standing: np.ndarray) -> np.ndarray:
    """Return the number of rows (M, rows) of each row's standstill, from the mask (M, rows); 1 in motion."""
    lengths = np.ones(standing.shape)
    for row in range(standing.shape[1]):
        for first, stop in segments(standing[:, row]):
            if standing[first, row]:
                lengths[first:stop, row] = stop - first
    return lengths


class Cause(Enum):
    """Kind of cause why a log's errors are not as predicted; the value is its name in tables."""

    NONE = "as predicted"
    FRICTION = "friction"
    GAIN = "gain"
    UNIT = "unit"
    LOAD = "load"
    MOTION = "motion"
    UNKNOWN = "unknown"


@dataclass(frozen=True, eq=False)
class Judgement:
    """Comparison of a log with its prediction.

    Attributes:
        ratios: (rows,) rms of the errors divided by the predicted standard deviations; NaN without rows.
        unexpected: indices of the torque rows whose errors are not as predicted.
        cause: the cause.
        row: torque row of the cause; None if it has none.
        change, sigma: size of the change with its standard deviation: of the unit or gain as a factor - 1, of the load
            as a mass [kg], of friction as the change of the joint's torque in motion, rms [N m or N]; NaN otherwise.
        steps: (p,) standard deviations of the step that the parameters make before the log is absorbed.
        weights: (rows,) factors by which the rows' standard deviations are raised, for errors of the model itself.
        accepted: whether the log is absorbed.
    """

    ratios: np.ndarray
    unexpected: tuple[int, ...]
    cause: Cause
    row: int | None
    change: float
    sigma: float
    steps: np.ndarray
    weights: np.ndarray
    accepted: bool


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A cause with the columns (q, c) that it adds: parameters' or load's columns combined; see `_fits`."""

    cause: Cause
    row: int | None
    columns: np.ndarray


@dataclass(frozen=True, eq=False)
class _Fit:
    """A hypothesis with changes (c,), a root (c, c) of their covariance, its criterion, and residuals (M, rows)."""

    hypothesis: _Hypothesis
    changes: np.ndarray
    root: np.ndarray
    criterion: float
    residual: np.ndarray


def judge(model: WorkingModel, state: DriftBank, rows: LogRows) -> Judgement:
    """Return the comparison of a log with its prediction, and the cause of errors beyond it.

    Args:
        model: the model.
        state: the state at the log's date.
        rows: the log's rows.
    """
    mean, covariance = state.posterior()
    errors = rows.target - rows.matrix @ mean
    by_parameters = np.einsum("mri,ij,mrj->mr", rows.matrix, covariance, rows.matrix, optimize=True)
    if model.discrepancy is not None:
        by_parameters = by_parameters * np.array(model.discrepancy.parameters)
    expected = np.sqrt(by_parameters + rows.floor)
    ratios, unexpected = _compare(errors, expected, rows)
    judgement = Judgement(
        ratios=ratios,
        unexpected=unexpected,
        cause=Cause.NONE,
        row=None,
        change=np.nan,
        sigma=np.nan,
        steps=np.zeros(len(model.names)),
        weights=np.ones(len(ratios)),
        accepted=True,
    )
    fits = _fits(model, state, rows, errors)
    best = max(fits, key=lambda fit: fit.criterion)
    lasting = best.hypothesis.cause in (Cause.LOAD, Cause.UNIT)
    change, sigma = _size(best, rows)
    sure = abs(change) > SURE_SIGMAS * sigma
    clear = lasting and sure and best.criterion > rows.count(errors)
    if not unexpected and not clear:
        return judgement
    if not unexpected:
        judgement = replace(judgement, unexpected=(int(np.nanargmax(ratios)),))

    # a single cause
    _, unexplained = _compare(best.residual, expected * _noise_factors(best, change), rows)
    if not unexplained and sure:
        cause, row = best.hypothesis.cause, best.hypothesis.row
        steps = judgement.steps
        if cause in (Cause.FRICTION, Cause.GAIN):
            steps = np.abs(best.hypothesis.columns[: len(steps)]) @ _widths(best)
        accepted = bool(steps.any())
        return replace(judgement, cause=cause, row=row, change=change, sigma=sigma, steps=steps, accepted=accepted)

    # errors of the model itself, which no values of its parameters explain
    free_errors = rows.target - rows.matrix @ _best_values(rows)
    free_ratios, unexplained = _compare(free_errors, expected, rows)
    if unexplained:
        weights = np.fmax(free_ratios, 1.0)
        return replace(judgement, cause=Cause.MOTION, weights=weights)
    return replace(judgement, cause=Cause.UNKNOWN, accepted=False)


def _noise_factors(fit: _Fit, change: float) -> np.ndarray:
    """Return the factors (rows,) of the noise under a fit's cause: torques in a smaller unit have larger noise, too.

    Args:
        fit: fit of the cause.
        change: its change of the unit or the gain, as a factor - 1.
    """
    factors = np.ones(fit.residual.shape[1])
    if fit.hypothesis.cause is Cause.UNIT:
        factors[:] = max(1.0, abs(1.0 + change))
    elif fit.hypothesis.cause is Cause.GAIN:
        factors[fit.hypothesis.row] = max(1.0, abs(1.0 + change))
    return factors


def _compare(errors: np.ndarray, expected: np.ndarray, rows: LogRows) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return rms ratios (rows,) of errors to the expected standard deviations, and the rows that are not as expected.

    Args:
        errors, expected: (M, rows) errors and their standard deviations.
        rows: the log's rows.
    """
    ratios = np.full(errors.shape[1], np.nan)
    unexpected = []
    for row in range(errors.shape[1]):
        present = rows.present[:, row]
        if not present.any():
            continue
        relative = errors[present, row] / expected[present, row]
        ratios[row] = np.sqrt(np.mean(relative**2))
        inside = (np.abs(relative) <= SIGMAS).astype(float)
        independent = len(inside) / inflation(inside)
        chance = CHANCE_SIGMAS * np.sqrt(OUTSIDE_SHARE * (1.0 - OUTSIDE_SHARE) / max(independent, 1.0))
        if ratios[row] > BEYOND and inside.mean() < MIN_COVERED - chance:
            unexpected.append(row)
    return ratios, tuple(unexpected)


def _hypotheses(model: WorkingModel) -> Iterable[_Hypothesis]:
    """Yield the causes that are compared, with their columns among [W load] (p + 10, c)."""
    p = len(model.names)
    identity = np.eye(p + LOAD_PARAMETERS)
    by_row: dict[int, list[int]] = {}
    groups = model.drift_groups()
    for parameter in np.flatnonzero(groups == FRICTION).tolist():
        term = model.term(parameter)
        assert term is not None
        for row, _ in term.acts[:1]:
            by_row.setdefault(row, []).append(parameter)
    for row, parameters in by_row.items():
        yield _Hypothesis(Cause.FRICTION, row, identity[:, parameters])
    gains = range(model.k, p)
    for row, gain in enumerate(gains):
        yield _Hypothesis(Cause.GAIN, row, identity[:, [gain]])
    unit = identity[:, list(gains)].sum(axis=1)
    yield _Hypothesis(Cause.UNIT, None, unit[:, None])
    yield _Hypothesis(Cause.LOAD, None, identity[:, p:])


def _fits(model: WorkingModel, state: DriftBank, rows: LogRows, errors: np.ndarray) -> list[_Fit]:
    """Return the fits of all causes: log and state together, with the cause's columns without a prior.

    Args:
        model: the model.
        state: the state at the log's date.
        rows: the log's rows.
        errors: (M, rows) errors of the prediction.
    """
    p = len(model.names)
    whitened = rows.with_load()
    prior = state.factors[int(np.argmax(state.weights))]
    compressed = retriangulate(whitened)
    count = max(rows.count(errors), 1.0)
    every_column = np.concatenate([rows.matrix, rows.load], axis=2)
    fits = []
    for hypothesis in _hypotheses(model):
        added = compressed[:, :-1] @ hypothesis.columns
        norms = np.linalg.norm(added, axis=0)
        used = norms > 0.0
        c = int(used.sum())
        if not c:
            continue
        directions = hypothesis.columns[:, used] / norms[used]
        stacked = np.zeros((len(prior) + len(compressed), p + c + 1))
        stacked[: len(prior), :p] = prior[:, :-1]
        stacked[: len(prior), -1] = prior[:, -1]
        stacked[len(prior) :, :p] = compressed[:, :p]
        stacked[len(prior) :, p:-1] = added[:, used] / norms[used]
        stacked[len(prior) :, -1] = compressed[:, -1]
        upper = retriangulate(stacked)
        lower = upper[p:-1, p:-1]
        inverse = np.linalg.pinv(lower, rcond=UNOBSERVED)
        changes = inverse @ upper[p:-1, -1]
        # sum of squares that the columns remove, less Schwarz's price for each
        criterion = float(np.sum((lower @ changes) ** 2)) - c * float(np.log(count))
        values = scipy.linalg.solve_triangular(upper[:p, :p], upper[:p, -1] - upper[:p, p:-1] @ changes)
        step = np.append(values, np.zeros(LOAD_PARAMETERS)) + directions @ changes
        residual = rows.target - every_column @ step
        fitted = _Hypothesis(hypothesis.cause, hypothesis.row, directions)
        fits.append(_Fit(fitted, changes, inverse, criterion, residual))
    return fits


def _widths(fit: _Fit) -> np.ndarray:
    """Return the standard deviation (c,) of a step that is as large as a fit's changes."""
    return np.hypot(fit.changes, np.linalg.norm(fit.root, axis=1))


def _size(fit: _Fit, rows: LogRows) -> tuple[float, float]:
    """Return the size of a change with its standard deviation, as described at `Judgement`."""
    hypothesis = fit.hypothesis
    in_parameters = hypothesis.columns @ fit.changes
    root = hypothesis.columns @ fit.root
    sigmas = np.linalg.norm(root, axis=1)
    if hypothesis.cause is Cause.LOAD:
        return float(in_parameters[-1]), float(sigmas[-1])
    if hypothesis.cause is Cause.FRICTION:
        assert hypothesis.row is not None
        regressor = rows.matrix[:, hypothesis.row]
        torque = regressor @ in_parameters[: regressor.shape[1]]
        sigma = np.linalg.norm(regressor @ root[: regressor.shape[1]], axis=1)
        return float(np.sqrt(np.mean(torque**2))), float(np.sqrt(np.mean(sigma**2)))
    largest = int(np.argmax(np.abs(in_parameters)))
    return float(in_parameters[largest]), float(sigmas[largest])


def _best_values(rows: LogRows) -> np.ndarray:
    """Return the changes (p,) that explain a log best, of all parameters without a prior."""
    whitened = rows.whitened
    norms = np.linalg.norm(whitened[:, :-1], axis=0)
    scale = np.where(norms > 0.0, norms, 1.0)
    solution, *_ = np.linalg.lstsq(whitened[:, :-1] / scale, whitened[:, -1], rcond=DEPENDENT)
    return solution / scale


def absorbed(state: DriftBank, rows: LogRows, judgement: Judgement) -> DriftBank:
    """Return the state after a log, with the steps and weights of its judgement.

    Args:
        state: the state at the log's date.
        rows: the log's rows.
        judgement: comparison of the log with its prediction.
    """
    rows = replace(rows, sigma=rows.sigma * judgement.weights)
    if judgement.steps.any():
        state = state.freed(judgement.steps)
    mean, _ = state.posterior()
    errors = rows.target - rows.matrix @ mean
    return state.absorb(rows.whitened, rows.count(errors) / TEMPERING)


def torque_shares(rows: LogRows, covariance: np.ndarray) -> np.ndarray:
    """Return the torque (p,) that each parameter's standard deviation moves, as a share of the torque.

    The share is that of the torque row in which it is largest, rms over the log. Parameters without effect have zero.

    Args:
        rows: the log's rows.
        covariance: (p, p) covariance of the parameters.
    """
    present = rows.present[:, :, None]
    count = np.maximum(present.sum(axis=0), 1)
    effect = np.sqrt(np.sum((rows.matrix * present) ** 2, axis=0) / count)
    torque = np.sqrt(np.sum((rows.torque[:, :, None] * present) ** 2, axis=0) / count)
    relative = effect / np.maximum(torque, MIN_TORQUE)
    return np.asarray(np.sqrt(np.diag(covariance)) * relative.max(axis=0))

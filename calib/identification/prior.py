"""Normal prior of the dynamic parameters, whose standard deviations are estimated from the data by maximum evidence.

Standard parameters χ of one kind, i.e. of one shape and unit (masses, first moments, inertias; rotor inertia, viscous
friction, Coulomb friction, offsets), have about equal sizes, and all parameters of the robot are about s times known
ones, u, from its CAD or from rods between the joints:

    χ = s u + δ,    δ_i ~ N(0, σ_kind²),    s ~ N(0, κ²).

Rotor inertia, viscous and Coulomb friction of the drives have such common directions, too, with the joints' torque
limits as u: a joint that never reverses then gets the friction of the other joints instead of an offset. The base
parameters T χ have the prior N(0, T (diag σ² + U diag κ² Uᵀ) Tᵀ), where U are these directions. The sizes σ and κ
maximise the marginal likelihood of the data (MacKay 1992, automatic relevance of groups),

    log p(y | σ, κ) = -½ [log det K + zᵀ K⁻¹ z] + const,   K = I + R P Rᵀ,

with [R z] the triangle of the whitened [W y] and P the prior covariance, times a wide prior of their logarithms. Its
mean is the size with which a kind alone would explain `EXPLAINED_SHARE` of all torque (offsets: `OFFSET_SHARE`), its
standard deviation `KIND_WIDTH` (our choice). Sizes are also bounded: without a bound, motion that hardly excites a kind
is explained by large parameters that cancel each other.

Rows are weighted by their joint's residual. The residual's autocorrelation determines how many rows count as one, but
at most `MAX_INFLATION`, since residuals of a short record resemble a single wave whatever the model is. Errors of the
model are not noise and differ on other motion. Therefore residuals have `TEMPERING` times less weight when sizes are
estimated, and the prior as many times more weight for the values than for their covariance; the factor is larger if
held-out ranges of motion are then predicted better (`tempered_prior`).

The prior does not affect directions that the motion identifies well; directions that it does not identify follow the
whole robot. The prior does not make bodies physically consistent, which is the task of a semidefinite program in
another module; but least squares keeps motor inertia positive and friction dissipative at any speed
(`cone_program.bounded`).

Rods between the joints replace the masses of a robot whose description has none.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
from scipy.linalg.lapack import dtrtri  # type: ignore[attr-defined]

from calib.dynamics import pseudo_inertia
from calib.dynamics.base import Base
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.regressor_model import RegressorModel
from calib.estimation.triangles import Triangles, retriangulate
from calib.estimation.whiteness import inflation
from calib.identification.rows import ObservationRows, RestWeights, triangulate
from calib.identification.standstill import divided
from calib.identification.time_folds import CrossValidation, Regimes, estimate
from calib.records import frozen
from calib.robot.chain import Chain

RADIUS = 0.1
"""Radius of the balls that rods are made of [m]."""
PAYLOAD = (2.0, 0.1)
"""Mass and radius of a payload [kg, m]."""
TEMPERING = 2.0
"""Weight of the prior for the values, at least: chosen on motion other than that of the training data."""
TEMPERINGS = (TEMPERING, 2.0 * TEMPERING, 4.0 * TEMPERING)
"""Weights that are tried."""
MIN_TEMPERING_GAIN = 0.08
"""Decrease of the logarithm of squared errors that a stronger prior has to bring (our choice)."""
MIN_NOISE = 1e-9
"""Noise in units of the largest joint's torque, at least: exact data must not turn into infinite weights."""
NOISE = 0.03
"""Residual at the start in units of a joint's torque (our choice); larger ones start on the smooth side."""
DRIVES = 3.0
"""Standard deviation of terms without CAD, in units of what would explain all of the torque."""
ROTOR = 0.15
"""Radius of gyration [m]: motor inertias are of the order of the robot's mass times its square, seen from the joint."""
MAX_INFLATION = 10.0
"""Rows of a residual that count as one, at most, where they are weighed (our choice)."""
ROUNDS = 12
"""Rounds of sizes, values and weights, at most."""
SETTLED = 0.03
"""Change of every parameter in units of its sigma, and relative change of every residual, that ends the rounds."""
FIRST_FIT_ROUNDS = 4
"""Rounds of values and weights of a fit without prior."""
RESTING_SHARE = 0.5
"""A parameter whose variance the data lower by less than this share rests on the prior."""
MIN_CAD_DEVIATION = 0.03
"""Least deviation in units of the robot's parameters of a kind, rms: no CAD is known to be nearer (our choice)."""
MAX_DEVIATION = 3.0
"""Largest deviation in the same units, or in those of what explains all torque (our choice)."""
EXPLAINED_SHARE = 0.2
"""Share of all torque that a kind of parameters explains before any data (our choice)."""
OFFSET_SHARE = 0.01
"""The same of constant torques: motors have friction rather than offsets (our choice)."""
WHOLE_WIDTH = 1.0
"""Deviation of the logarithm of κ, whose size is known: the whole robot explains all torque (our choice)."""
KIND_WIDTH = 3.0
"""Deviation of the logarithm of a kind's size (our choice)."""


class FirstFit(NamedTuple):
    """A first fit of the base parameters, which gives the row weights.

    Attributes:
        std, inflation: (rows,) standard deviation [N m or N] and variance inflation of its residuals.
        values: (b,) base parameters.
        rest_weights: weights of standstills.
    """

    std: np.ndarray
    inflation: np.ndarray
    values: np.ndarray
    rest_weights: RestWeights


@dataclass(frozen=True, eq=False)
class Prior:
    """A normal prior of b base parameters with mean zero.

    Attributes:
        covariance: (b, b) prior covariance.
        deviation: (b,) prior standard deviations of δ, i.e. about the common part s u of the whole robot.
        sizes: size σ by kind of parameters, and κ under the name ``whole``.
        source: source of u, ``cad`` or ``sizes`` (rods between the joints).
        first: the fit of the base parameters with this prior, without additional friction.
        tempering: weight of the prior for the values, relative to its weight for their covariance.
        contradiction: logarithm of the evidence of free sizes over that of fixed ones; 0 if none are fixed.
    """

    covariance: np.ndarray
    deviation: np.ndarray
    sizes: Mapping[str, float]
    source: str
    first: FirstFit
    tempering: float = TEMPERING
    contradiction: float = 0.0

    @property
    def rows(self) -> np.ndarray:
        """The prior as whitened rows (b, b + 1), to be appended to the rows [W y] of observation matrix and torques."""
        unit = np.sqrt(np.diag(self.covariance))
        lower = np.linalg.cholesky(self.covariance / np.outer(unit, unit))
        inverse = scipy.linalg.solve_triangular(lower, np.diag(1.0 / unit), lower=True)
        return np.hstack([inverse, np.zeros((len(unit), 1))])

    def widened(self, count: int) -> np.ndarray:
        """Return the prior's whitened rows (b, b + count + 1) with `count` zero columns after the base columns."""
        return np.insert(self.rows, [len(self.deviation)] * count, 0.0, axis=1)

    def resting(self, covariance: np.ndarray) -> np.ndarray:
        """Return the mask (b,) of parameters that the prior determines rather than the data.

        The data reduce their variance by less than `RESTING_SHARE`. Variances are those about s u, since few data
        suffice to identify the common factor s.

        Args:
            covariance: (p, p) covariance of the estimate, base parameters first.
        """
        variance = np.diag(covariance)[: len(self.deviation)]
        return variance > (1.0 - RESTING_SHARE) * self.deviation**2


@dataclass(frozen=True, eq=False)
class _Sizes:
    """Prior standard deviations of p parameters and k common directions, as functions of log sizes t.

    Attributes:
        names: names of the sizes; empty for those of additional friction.
        member: (p + k,) index of the size of each parameter and direction.
        centre, width: (sizes,) prior mean and standard deviation of t.
        lower, upper: (sizes,) bounds of t.
    """

    names: tuple[str, ...]
    member: np.ndarray
    centre: np.ndarray
    width: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def fixing(self, fixed: Mapping[str, float]) -> "_Sizes":
        """Return these sizes, those of the given names with bounds that leave the given value alone.

        Names of other models' sizes are passed over: `EarlierChoice.check_sizes` refuses them.
        """
        lower, upper = np.array(self.lower), np.array(self.upper)
        for name in set(fixed).intersection(self.names):
            index = self.names.index(name)
            lower[index] = upper[index] = np.log(fixed[name])
        return replace(self, lower=lower, upper=upper)

    def deviations(self, t: np.ndarray) -> np.ndarray:
        """Return the standard deviations (p + k,) at log sizes t."""
        return np.exp(np.clip(t, -40.0, 40.0))[self.member]


def find_prior(
    model: RegressorModel,
    base: Base,
    rows: Sequence[ObservationRows],
    robot: np.ndarray | None = None,
    source: str = "sizes",
    noise: np.ndarray | None = None,
    groups: np.ndarray | None = None,
    start: Prior | None = None,
    effort: np.ndarray | None = None,
    tempering: float = TEMPERING,
    fixed: Mapping[str, float] | None = None,
) -> Prior:
    """Return the prior of the base parameters with sizes that maximise the evidence.

    Args:
        model: model of the base parameters.
        base: base parameters of the model.
        rows: rows in the base columns, followed by those of additional friction.
        robot: u, the bodies' parameters up to a factor; None: unknown.
        source: source of `robot`: ``cad`` or ``sizes``.
        noise: (rows,) standard deviation of the torques' noise, up to a common factor; None: from the residuals.
        groups: (k,) group of each column of additional friction, which have one size per group; None: there are no such
            columns.
        start: prior with which the search starts, e.g. without additional friction; None: none.
        effort: (n,) torque limits of the joints, up to a factor; None: equal limits.
        tempering: weight of the prior for the values, relative to its weight for their covariance.
        fixed: sizes by name that are not estimated; None: all are.
    """
    parts = divided(rows)
    rest_weights = rows[0].rest
    data = parts.joined(rest_weights)
    if groups is None:
        groups = np.zeros(0, int)

    # Columns of the base parameters and richer friction, by each of χ, and by each s of a common direction.
    transform = base.transform
    robot_direction = np.zeros(model.p)
    if robot is not None:
        robot_direction[: len(robot)] = robot
    shared = _shared_directions(model, robot_direction, effort)
    direction_count = shared.shape[1]
    identity = np.eye(len(groups))
    single = np.asarray(scipy.linalg.block_diag(transform, identity))
    common = np.vstack([transform @ shared, np.zeros((len(groups), direction_count))])
    columns = np.column_stack([single, common])
    free_sizes = _sizes(model, data, columns, shared, groups)
    sizes = free_sizes.fixing(fixed or {})

    squares = np.sum(data.factors[:, :, -1] ** 2, axis=1)
    std = NOISE * np.sqrt(squares / np.maximum(data.rows, 1))
    std = np.maximum(std, MIN_NOISE * max(float(std.max()), 1e-300))
    inflation = np.full(len(std), 3.0)
    t = np.array(sizes.centre)
    values = np.zeros(len(columns))
    if start is not None:
        std = start.first.std
        inflation = start.first.inflation
        for name, size in start.sizes.items():
            t[sizes.names.index(name)] = np.log(size)
    t = np.clip(t, sizes.lower, sizes.upper)
    for _ in range(ROUNDS):
        previous_values, previous_std = values, std
        tempered = tempering * inflation
        noise_of_row = (std * np.sqrt(tempered))[:, None, None]
        stacked = (data.factors / noise_of_row).reshape(-1, len(columns) + 1)
        factor = retriangulate(stacked)
        t = _most_probable(factor, columns, sizes, t)
        values, covariance = _posterior(factor, columns, sizes.deviations(t))
        std, inflation = weighing(rows, data, values, covariance, std, tempered, noise)
        rest_weights = parts.weights(values, std, inflation)
        data = parts.joined(rest_weights)
        still = np.abs(values - previous_values) < SETTLED * np.sqrt(np.diag(covariance))
        if still.all() and (np.abs(std / previous_std - 1.0) < SETTLED).all():
            break

    contradiction = 0.0
    if fixed:
        free = _most_probable(factor, columns, free_sizes, t)
        cost = _cost(factor, columns, free_sizes)
        contradiction = cost(t)[0] - cost(free)[0]
    deviations = sizes.deviations(t)
    single_root = transform * deviations[: model.p]
    common_root = columns[: base.b, -direction_count:] * deviations[-direction_count:]
    single_covariance = single_root @ single_root.T
    single_covariance[np.diag_indices(base.b)] *= 1.0 + 1e-9
    deviation = frozen(np.sqrt(np.diag(single_covariance)))
    first = FirstFit(frozen(std), frozen(inflation), frozen(values[: base.b]), rest_weights)
    prior_covariance = single_covariance + common_root @ common_root.T
    return Prior(
        covariance=frozen(prior_covariance),
        deviation=deviation,
        sizes={name: float(np.exp(log_size)) for name, log_size in zip(sizes.names, t) if name},
        source=source,
        first=first,
        tempering=tempering,
        contradiction=contradiction,
    )


def first_fit(rows: Sequence[ObservationRows], noise: np.ndarray | None = None) -> FirstFit:
    """Return a minimum-norm least-squares fit without prior, as the first fit.

    Args:
        rows: rows of all recordings.
        noise: (rows,) standard deviation of the torques' noise, up to a common factor; None: from the residuals.
    """
    row_count = rows[0].target.shape[1]
    parts = divided(rows)
    rest_weights = rows[0].rest
    std = np.ones(row_count)
    inflation = np.ones(row_count)
    values = np.zeros(parts.moving.parameters)
    for _ in range(FIRST_FIT_ROUNDS):
        data = parts.joined(rest_weights)
        no_ridges = np.full(data.parameters, -1)
        values, _ = estimate(data, std, np.ones(row_count), no_ridges)
        std = np.sqrt(data.residual_squares(values) / np.maximum(data.rows, 1))
        std = np.maximum(std, 1e-9 * max(float(std.max()), 1e-300))
        std = scaled(noise, std, data.rows)
        inflation = residual_inflation(rows, values)
        rest_weights = parts.weights(values, std, inflation)
    return FirstFit(std, inflation, values, rest_weights)


def weighing(
    rows: Sequence[ObservationRows],
    data: Triangles,
    values: np.ndarray,
    covariance: np.ndarray,
    std: np.ndarray,
    inflation: np.ndarray,
    noise: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return standard deviation and variance inflation of the residuals (rows,), with their degrees of freedom.

    Args:
        rows: rows of all recordings.
        data: R factors of the rows, one group per torque row.
        values, covariance: (p,), (p, p) the estimate.
        std, inflation: (rows,) standard deviation [N m or N] and variance inflation with which the estimate was
            weighted.
        noise: (rows,) standard deviation of the torques' noise, up to a common factor; None: from the residuals.
    """
    columns = data.factors[:, :, :-1]
    parameters_of_row = np.einsum("gik,gik->g", columns @ covariance, columns) / (std**2 * inflation)
    inflation = np.minimum(residual_inflation(rows, values), MAX_INFLATION)
    counts = np.maximum(data.rows, 1)
    residual = data.factors @ np.append(values, -1.0)
    squares = np.sum(residual**2, axis=1)
    freedom = np.maximum(data.rows - inflation * parameters_of_row, 0.1 * counts)
    std = np.sqrt(squares / freedom)
    torque_squares = np.sum(data.factors[:, :, -1] ** 2, axis=1)
    torque_rms = np.sqrt(torque_squares / counts)
    std = np.maximum(std, MIN_NOISE * max(float(torque_rms.max()), 1e-300))
    return scaled(noise, std, data.rows), inflation


def scaled(noise: np.ndarray | None, std: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the stated noise (rows,) scaled to the residuals by one common factor; `std` if no noise is stated.

    The stated noise is used only relative between joints (our choice): the variance over repetitions does not contain
    errors that are equal in every period, so that its absolute size would be too small. The decimation filter's gain
    for white noise, equal for all joints, is thereby irrelevant.

    Args:
        noise: (rows,) stated standard deviation of the torques' noise, up to a common factor; None: none is stated.
        std: (rows,) standard deviations of the residuals [N m or N].
        counts: (rows,) numbers of residuals.
    """
    if noise is None:
        return std
    weights = np.maximum(counts, 1)
    mean_square_ratio = np.average((std / noise) ** 2, weights=weights)
    return noise * np.sqrt(mean_square_ratio)


def residual_inflation(all_rows: Sequence[ObservationRows], values: np.ndarray) -> np.ndarray:
    """Return the variance inflation of each torque row's residuals in motion (rows,).

    It is the integrated autocorrelation, averaged over the cases by their number of residuals.

    Args:
        all_rows: rows of all recordings.
        values: (p,) estimate.
    """
    row_count = all_rows[0].target.shape[1]
    total = np.zeros(row_count)
    weight = np.zeros(row_count)
    for rows in all_rows:
        residual = rows.target - rows.matrix @ values
        moves = rows.standing == 0.0
        has_motion = rows.present.any(axis=0) & moves.any(axis=0)
        for row in np.flatnonzero(has_motion):
            in_motion = residual[moves[:, row], row]
            total[row] += len(in_motion) * inflation(in_motion)
            weight[row] += len(in_motion)
    return np.maximum(total / np.maximum(weight, 1.0), 1.0)


def _shared_directions(model: RegressorModel, robot: np.ndarray, effort: np.ndarray | None) -> np.ndarray:
    """Return common directions (p, k) of the parameters: of the robot's bodies, then of each kind of drive term.

    Args:
        model: model of the parameters.
        robot: (p,) parameters of the robot's bodies, up to a factor.
        effort: (n,) torque limits of the joints, up to a factor, which give the drives' directions; None: equal limits.
    """
    by_kind: dict[str, np.ndarray] = {}
    for column, term in enumerate(model.columns):
        if term.nonnegative and term.joint is not None:
            direction = by_kind.setdefault(_kind(term), np.zeros(model.p))
            direction[model.inertial + column] = 1.0 if effort is None else effort[term.joint]
    directions = [direction for direction in by_kind.values() if np.count_nonzero(direction) > 1]
    return np.column_stack([robot, *directions])


def _kind(term: DriveTerm) -> str:
    return f"{term.shape} [{term.unit}]"


def _sizes(
    model: RegressorModel, data: Triangles, columns: np.ndarray, shared: np.ndarray, groups: np.ndarray
) -> _Sizes:
    """Return the sizes of the kinds of parameters, with their priors and bounds.

    Args:
        model: model of the p parameters.
        data: R factors of the rows.
        columns: columns of the parameters, and of the common directions, in the basis of `data`.
        shared: (p, k) common directions.
        groups: groups of the columns of additional friction; their sizes have no names.
    """
    # Names of the sizes of single parameters, then of the directions; and which parameter has which.
    kinds = [f"bodies [{unit}]" for unit in model.units[: model.inertial]]
    kinds += [_kind(term) for term in model.columns]
    distinct_kinds = list(dict.fromkeys(kinds))
    distinct_groups, group = np.unique(groups, return_inverse=True)
    single_count = len(distinct_kinds) + len(distinct_groups)
    direction_names = [f"shared {kinds[np.flatnonzero(direction)[0]]}" for direction in shared.T[1:]]
    names = (*distinct_kinds, *([""] * len(distinct_groups)), "whole", *direction_names)
    member_of_kind = [distinct_kinds.index(kind) for kind in kinds]
    members = [*member_of_kind, *(len(distinct_kinds) + group), *range(single_count, len(names))]
    member = np.array(members, int)

    # Logarithms of the sizes that explain all torque, each alone; of what no torque shows, nothing is known.
    torque_columns = data.factors[:, :, :-1] @ columns
    squares = np.sum(torque_columns**2, axis=(0, 1))
    target_square = np.sum(data.factors[:, :, -1] ** 2)
    total = max(float(target_square), 1e-300)
    size_squares = np.bincount(member, squares, len(names))
    min_squares = max(1e-12 * float(size_squares.max()), 1e-300)
    explaining = 0.5 * np.log(total / np.maximum(size_squares, min_squares))

    # Sizes of the bodies' parameters are within factors of the robot's own parameters of their kind.
    count = np.maximum(np.bincount(member, minlength=len(names)), 1)
    shared_squares = np.bincount(member[: model.p], shared[:, 0] ** 2, len(names))
    mean_square = shared_squares / count
    of_robot = explaining[single_count] + 0.5 * np.log(np.maximum(mean_square, 1e-300))
    has_robot = mean_square > 0.0
    lower = np.where(has_robot, of_robot + np.log(MIN_CAD_DEVIATION), -np.inf)
    upper = np.where(has_robot, of_robot, explaining) + np.log(MAX_DEVIATION)

    share_of_shape = {"one": OFFSET_SHARE, "whole": 1.0}
    shares = [share_of_shape.get(name.split(" ")[0], EXPLAINED_SHARE) for name in names]
    centre = np.clip(explaining + np.log(np.array(shares)), lower, upper)
    is_robot = np.array([name == "whole" for name in names])
    width = np.where(is_robot, WHOLE_WIDTH, KIND_WIDTH)
    return _Sizes(names, member, centre, width, lower, upper)


def _posterior(factor: np.ndarray, columns: np.ndarray, deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return posterior values (b,) and their covariance (b, b).

    Args:
        factor: (b + 1, b + 1) triangle [R z; 0 ρ] of the whitened rows.
        columns: (b, p) matrix that maps p independent, normally distributed unknowns to the values.
        deviations: (p,) prior standard deviations of these unknowns.
    """
    b, p = columns.shape
    whitened = columns * deviations
    stacked = np.zeros((b + p, p + 1))
    stacked[:b, :p] = factor[:b, :b] @ whitened
    stacked[:b, p] = factor[:b, b]
    stacked[b:, :p] = np.eye(p)
    upper = retriangulate(stacked, overwrite=True)
    identity = np.eye(p)
    inverse = np.asarray(scipy.linalg.solve_triangular(upper[:p, :p], identity))
    root = whitened @ inverse
    return root @ upper[:p, p], root @ root.T


def _most_probable(factor: np.ndarray, columns: np.ndarray, sizes: _Sizes, start: np.ndarray) -> np.ndarray:
    """Return the log sizes (k,) that maximise evidence times prior.

    Args:
        factor: (b + 1, b + 1) triangle [R z; 0 ρ] of the whitened rows.
        columns: (b, p) matrix that maps independent unknowns to the values.
        sizes: sizes with their priors.
        start: (k,) first log sizes.
    """
    bounds = np.column_stack([sizes.lower, sizes.upper])
    clipped_start = np.clip(start, sizes.lower, sizes.upper)
    cost = _cost(factor, columns, sizes)
    solution = scipy.optimize.minimize(
        cost, clipped_start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60, "ftol": 1e-8}
    )
    return np.asarray(solution.x)


def _cost(factor: np.ndarray, columns: np.ndarray, sizes: _Sizes) -> Callable[[np.ndarray], tuple[float, np.ndarray]]:
    """Return the negative logarithm of evidence times prior, with its gradient, as a function of log sizes (k,).

    Args:
        factor, columns, sizes: as in `_most_probable`.
    """
    b = len(columns)
    unscaled = factor[:b, :b] @ columns
    target = factor[:b, b]

    def cost(t: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the negative logarithm of evidence times prior at log sizes t (k,), and its gradient (k,)."""
        root = unscaled * sizes.deviations(t)
        # Inverse of the root of the covariance of y.
        information = root @ root.T + np.eye(b)
        inverse, _ = dtrtri(np.linalg.cholesky(information), lower=1)
        whitened_root = inverse @ root
        whitened = inverse @ target
        deviation = (t - sizes.centre) / sizes.width
        value = 0.5 * float(whitened @ whitened + deviation @ deviation)
        value -= float(np.log(np.diag(inverse)).sum())
        evidence_slope = (whitened @ whitened_root) ** 2 - np.einsum("ij,ij->j", whitened_root, whitened_root)
        return value, deviation / sizes.width - np.bincount(sizes.member, evidence_slope, len(t))

    return cost


def rods(chain: Chain, model: IdentificationModel, total: float = 1.0) -> np.ndarray:
    """Return the standard parameters (B, 10) of rods from each body's frame to the next.

    Masses are proportional to length plus thickness, with `total` [kg] as their sum. A payload is a ball of fixed mass.

    Args:
        chain: the arm, which gives the frames.
        model: its model, with B bodies.
        total: sum of the masses [kg].
    """
    bodies = model.bodies
    moves = bodies.coordinates >= 0
    tail_end = np.asarray(chain.tail)[:3, 3]
    ends = np.array([tail_end] * bodies.count)
    for i, parent in enumerate(bodies.parents):
        if parent >= 0 and moves[i]:
            ends[parent] = bodies.placements[i][:3, 3]
    length = np.linalg.norm(ends, axis=1) + 2 * RADIUS
    share = np.where(moves, length, 0.0)
    masses = total * share / share.sum()
    parameters = []
    for i in range(bodies.count):
        if moves[i]:
            parameters.append(pseudo_inertia.rod(masses[i], ends[i], RADIUS))
        else:
            parameters.append(pseudo_inertia.ball(*PAYLOAD))
    return np.array(parameters)


def tempered_prior(
    find: Callable[..., Prior], prior: Prior, rows: Sequence[ObservationRows], regimes: Regimes
) -> Prior:
    """Return the prior with the tempering that best predicts held-out ranges of motion.

    Tempering is the prior's weight for the values, relative to its weight for their covariance.

    The criterion is the squared error of all rows, in units of their residuals, as geometric mean over the ranges, so
    that a range with large errors for every prior does not dominate. A stronger prior must be better by
    `MIN_TEMPERING_GAIN`.

    Args:
        find: function that returns the prior of given rows; keyword arguments are the prior to start from and the
            tempering.
        prior: the prior with the smallest of `TEMPERINGS`.
        rows: rows in the base columns.
        regimes: ranges of motion of these rows.
    """
    data = triangulate(rows)
    columns = np.arange(len(rows[0].names))
    no_ridges = np.full(len(columns), -1)
    std = prior.first.std
    best, best_error = prior, np.inf
    for tempering in TEMPERINGS:
        candidate = prior
        if tempering != TEMPERINGS[0]:
            candidate = find(rows, start=prior, tempering=tempering)
        inflation = tempering * candidate.first.inflation
        validation = CrossValidation(
            data, len(std), 1, candidate.first.std, inflation, no_ridges, candidate.rows, lambda: regimes
        )
        squares = (validation.extrapolated(columns) / std**2).sum(axis=1)
        error = float(np.log(np.maximum(squares, 1e-300)).mean())
        if error < best_error - MIN_TEMPERING_GAIN:
            best, best_error = candidate, error
    return best

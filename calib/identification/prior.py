"""Prior of the parameters: proper, always used, with sizes estimated from the data by maximum evidence.

Standard parameters χ of one kind (masses, first moments, inertias; rotor inertia, viscous friction, Coulomb friction,
offsets: whatever has one shape and one unit) are about equally large, and the robot as a whole is about s times a known
one, u: its CAD, or rods between the joints,

    χ = s u + δ,    δ_i ~ N(0, σ_kind²),    s ~ N(0, κ²),

and so are rotor inertia, viscous and Coulomb friction of the drives, with the joints' torque limits in place of u: a
joint that never reverses has the others' friction, and no offset in its place. The base parameters T χ have the prior
N(0, T (diag σ² + U diag κ² Uᵀ) Tᵀ), U of these directions. Sizes σ and κ are where the marginal likelihood of the data
is largest (MacKay 1992, automatic relevance of groups),

    log p(y | σ, κ) = -½ [log det K + zᵀ K⁻¹ z] + const,   K = I + R P Rᵀ,

with [R z] the triangle of the whitened [W y] and P the prior covariance, times a wide prior of their logarithms: what a
kind would be if it alone explained `explained_share` of all torque (offsets: `offset_share`), within a factor
exp(`kind_width`) (our choice), and bounded: without a bound, motion that hardly shows a kind is explained by large
parameters that cancel. Rows are weighed by their joint's residual, worth as many independent values as its
autocorrelation lets it, but not fewer than one in `max_inflation`: residuals of a short record look like one wave
whatever the model is. What the model lacks is no noise, and differs on other motion: where sizes are found residuals
count `TEMPERING` times less, and the prior as many times more for the values than for their covariance; more where
regimes left out ask for it (`calib.identification.prior`).

Directions that the motion identifies well do not feel the prior; those that it does not identify follow the whole
robot. It does not make the parameters those of possible bodies: that is the semidefinite fit of another module; but
`bounded` keeps the drives' inertia positive, and lets friction brake at any speed.

Rods between the joints stand for the masses of a robot whose description holds none.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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

RADIUS = 0.1  # [m] of the balls that rods are made of
PAYLOAD = (2.0, 0.1)  # [kg, m]
TEMPERING = 2.0  # weight of the prior for the values, at least: chosen on motion other than learnt from
MIN_NOISE = 1e-9  # of the largest joint's torque: exact data must not turn into infinite weights
NOISE = 0.03  # of a joint's torque: the residual at the start (our choice); larger ones start on the smooth side
ROUNDS = 12
SETTLED = 0.03  # of every parameter's sigma, and of every residual
DRIVES = 3.0  # terms without CAD: standard deviation in units of what would explain all of the torque
ROTOR = 0.15  # [m]: motor inertias are of the order of the robot's mass times its square, seen from the joint


class FirstFit(NamedTuple):
    """A first fit of the base parameters for row weights.

    std and inflation of its residuals (rows,), values (b,), and the weights of standstills.
    """

    std: np.ndarray
    inflation: np.ndarray
    values: np.ndarray
    rest: RestWeights


@dataclass(frozen=True, eq=False)
class Prior:
    """A normal prior of b base parameters with mean zero.

    Attributes:
        covariance: (b, b).
        own: (b,) standard deviations about the common part of the whole robot, s u.
        sizes: kind → σ, and ``whole`` → κ.
        source: of u, ``cad`` or ``sizes``.
        first: the fit of the base parameters with this prior, without richer friction.
        tempering: weight of the prior for the values, relative to its weight for their covariance.
    """

    covariance: np.ndarray
    own: np.ndarray
    sizes: Mapping[str, float]
    source: str
    first: FirstFit
    tempering: float = TEMPERING

    @property
    def rows(self) -> np.ndarray:
        """The prior as whitened rows of [W y], (b, b + 1)."""
        unit = np.sqrt(np.diag(self.covariance))
        lower = np.linalg.cholesky(self.covariance / np.outer(unit, unit))
        inverse = scipy.linalg.solve_triangular(lower, np.diag(1.0 / unit), lower=True)
        return np.hstack([inverse, np.zeros((len(unit), 1))])

    def widened(self, more: int) -> np.ndarray:
        """Return the prior's rows with `more` zero columns inserted after the base columns."""
        return np.insert(self.rows, [len(self.own)] * more, 0.0, axis=1)

    def resting(self, covariance: np.ndarray) -> np.ndarray:
        """Return the parameters (b,) that rest on the prior: data reduce their variance by less than `resting_share`.

        Counted about the whole robot's share: its factor s is one number, and soon identified.
        """
        b = len(self.own)
        resting_share = 0.5  # a parameter whose variance the data lower by less than this share rests on the prior
        return np.diag(covariance)[:b] > (1.0 - resting_share) * self.own**2


@dataclass(frozen=True, eq=False)
class _Sizes:
    """Prior standard deviations exp(E t) of p parameters and k directions, as functions of log sizes t."""

    names: tuple[str, ...]
    member: np.ndarray  # (p + k,) which size each has
    centre: np.ndarray  # (k,) of t
    width: np.ndarray  # (k,)
    least: np.ndarray  # (k,) of t
    most: np.ndarray  # (k,) of t

    def deviations(self, t: np.ndarray) -> np.ndarray:
        return np.exp(np.clip(t, -40.0, 40.0))[self.member]


def find_prior(
    model: RegressorModel,
    base: Base,
    rows: Sequence[ObservationRows],
    whole: np.ndarray | None = None,
    source: str = "sizes",
    noise: np.ndarray | None = None,
    groups: np.ndarray | None = None,
    start: Prior | None = None,
    effort: np.ndarray | None = None,
    tempering: float = TEMPERING,
) -> Prior:
    """Return the prior of the base parameters with sizes that maximise the evidence.

    Args:
        rows: in the base columns, and those of richer friction behind them.
        whole: u, the first of the model's parameters, up to a factor; None: nothing is known of the whole robot.
        source: of `whole`: ``cad`` or ``sizes``.
        noise: (rows,) of the torques up to a common factor; None: from the residuals.
        groups: (k,) of the columns of richer friction, each of a size of its own, which serves here alone.
        start: the prior without that friction, or of another tempering, to start from.
        effort: (n,) torque limits of the joints, up to a factor; None: joints alike.
        tempering: see `Prior`.
    """
    n = rows[0].target.shape[1]
    parts, rest = divided(rows), rows[0].rest
    data = parts.joined(rest)
    transform = base.transform
    known = np.zeros(model.p)
    if whole is not None:
        known[: len(whole)] = whole
    more = np.zeros(0, int) if groups is None else groups
    shared = _shared(model, known, effort)
    columns = np.asarray(scipy.linalg.block_diag(transform, np.eye(len(more))))  # by each of χ, and by each s
    columns = np.column_stack([columns, np.vstack([transform @ shared, np.zeros((len(more), shared.shape[1]))])])
    sizes = _sizes(model, data, columns, shared, more)
    squares, count = np.sum(data.factors[:, :, -1] ** 2, axis=1), np.maximum(data.rows, 1)
    std, tau = NOISE * np.sqrt(squares / count), np.full(n, 3.0)
    std = np.maximum(std, MIN_NOISE * max(float(std.max()), 1e-300))
    t, values = np.array(sizes.centre), np.zeros(len(columns))
    if start is not None:
        std, tau = start.first.std, start.first.inflation
        for name, size in start.sizes.items():
            t[sizes.names.index(name)] = np.log(size)
    for _ in range(ROUNDS):
        tempered = tempering * tau
        factor = retriangulate((data.factors / (std * np.sqrt(tempered))[:, None, None]).reshape(-1, len(columns) + 1))
        t = _most_probable(factor, columns, sizes, t)
        before, (values, covariance) = values, _posterior(factor, columns, sizes.deviations(t))
        last, (std, tau) = std, weighing(rows, data, values, covariance, std, tempered, noise)
        rest = parts.weights(values, std, tau)
        data = parts.joined(rest)
        still = np.abs(values - before) < SETTLED * np.sqrt(np.diag(covariance))
        if still.all() and (np.abs(std / last - 1.0) < SETTLED).all():
            break
    deviation = sizes.deviations(t)
    common = slice(-shared.shape[1], None)
    spread, whole_part = transform * deviation[: model.p], columns[: base.b, common] * deviation[common]
    own = spread @ spread.T
    own[np.diag_indices(base.b)] *= 1.0 + 1e-9
    return Prior(
        frozen(own + whole_part @ whole_part.T),
        frozen(np.sqrt(np.diag(own))),
        {name: float(np.exp(one)) for name, one in zip(sizes.names, t) if name},
        source,
        FirstFit(frozen(std), frozen(tau), frozen(values[: base.b]), rest),
        tempering,
    )


def first_fit(rows: Sequence[ObservationRows], noise: np.ndarray | None = None) -> FirstFit:
    """Return a minimum-norm fit: standard deviation and inflation of its residuals (rows,), and values (b,)."""
    count = rows[0].target.shape[1]
    parts, rest = divided(rows), rows[0].rest
    std, tau = np.ones(count), np.ones(count)
    values = np.zeros(parts.moving.parameters)
    for _ in range(4):
        data = parts.joined(rest)
        values, _ = estimate(data, std, np.ones(count), np.full(data.parameters, -1))
        std = np.sqrt(data.residual_squares(values) / np.maximum(data.rows, 1))
        std = scaled(noise, np.maximum(std, 1e-9 * max(float(std.max()), 1e-300)), data.rows)
        tau = residual_inflation(rows, values)
        rest = parts.weights(values, std, tau)
    return FirstFit(std, tau, values, rest)


def weighing(
    rows: Sequence[ObservationRows],
    data: Triangles,
    values: np.ndarray,
    covariance: np.ndarray,
    std: np.ndarray,
    tau: np.ndarray,
    noise: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return standard deviation and inflation of the residuals (rows,), by their degrees of freedom.

    Args:
        data: triangles of the rows, one group per torque row.
        values, covariance: (p,), (p, p) the estimate.
        std, tau: (rows,) that it was weighed with.
        noise: (rows,) of the torques up to a common factor; None: from the residuals.
    """
    columns = data.factors[:, :, :-1]
    taken = np.einsum("gik,gik->g", columns @ covariance, columns) / (std**2 * tau)  # of the parameters, by row
    max_inflation = 10.0  # rows of a residual that count as one, at most, where they are weighed (our choice)
    tau = np.minimum(residual_inflation(rows, values), max_inflation)
    squares = np.sum((data.factors @ np.append(values, -1.0)) ** 2, axis=1)
    std = np.sqrt(squares / np.maximum(data.rows - tau * taken, 0.1 * np.maximum(data.rows, 1)))
    size = np.sqrt(np.sum(data.factors[:, :, -1] ** 2, axis=1) / np.maximum(data.rows, 1))
    std = np.maximum(std, MIN_NOISE * max(float(size.max()), 1e-300))
    return scaled(noise, std, data.rows), tau


def scaled(noise: np.ndarray | None, std: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the stated noise (rows,) scaled to the residuals by one common factor; `std` if no noise is stated.

    Relative between joints, with a common scale (our choice): the variance over repeats does not see what every period
    has alike, so as it stands it would promise too much; and the decimation filter's gain for white noise, one number
    for all joints, drops out.
    """
    return std if noise is None else noise * np.sqrt(np.average((std / noise) ** 2, weights=np.maximum(counts, 1)))


def residual_inflation(all_rows: Sequence[ObservationRows], values: np.ndarray) -> np.ndarray:
    """Return the integrated autocorrelation of each row's residuals in motion (rows,), averaged by length of cases."""
    rows = all_rows[0].target.shape[1]
    total, weight = np.zeros(rows), np.zeros(rows)
    for part in all_rows:
        residual, seen = part.target - part.matrix @ values, np.asarray(part.present.any(axis=0))
        moves = part.standing == 0.0
        for row in np.flatnonzero(seen & moves.any(axis=0)):
            in_motion = residual[moves[:, row], row]
            total[row] += len(in_motion) * inflation(in_motion)
            weight[row] += len(in_motion)
    return np.maximum(total / np.maximum(weight, 1.0), 1.0)


def _shared(model: RegressorModel, whole: np.ndarray, effort: np.ndarray | None) -> np.ndarray:
    """Return common directions (p, k) of the parameters: the whole robot, then drives by their torque limits.

    Args:
        whole: (p,) of the robot's bodies, up to a factor.
        effort: (n,) torque limits of the joints, up to a factor; None: joints alike.
    """
    columns = {}
    for k, one in enumerate(model.columns):
        if one.nonnegative and one.joint is not None:
            size = 1.0 if effort is None else effort[one.joint]
            columns.setdefault(_kind(one), np.zeros(model.p))[model.inertial + k] = size
    return np.column_stack([whole, *(own for own in columns.values() if np.count_nonzero(own) > 1)])


def _kind(term: DriveTerm) -> str:
    return f"{term.shape} [{term.unit}]"


def _sizes(model: RegressorModel, data: Triangles, columns: np.ndarray, shared: np.ndarray, more: np.ndarray) -> _Sizes:
    """Return the kinds of parameters and the prior of each kind's size; groups in `more` have no names."""
    kinds = [f"bodies [{unit}]" for unit in model.units[: model.inertial]]
    kinds += [_kind(one) for one in model.columns]
    own = tuple(dict.fromkeys(kinds))
    found, group = np.unique(more, return_inverse=True)
    common = [f"shared {kinds[np.flatnonzero(column)[0]]}" for column in shared.T[1:]]
    names = (*own, *("" for _ in found), "whole", *common)
    single = len(own) + len(found)  # sizes of single parameters; those of directions follow
    member = np.array([*map(own.index, kinds), *(len(own) + group), *range(single, len(names))], int)
    seen = data.factors[:, :, :-1] @ columns
    squares = np.sum(seen**2, axis=(0, 1))  # of the torque, per unit of each parameter
    total = max(float(np.sum(data.factors[:, :, -1] ** 2)), 1e-300)
    each = np.bincount(member, squares, len(names))
    least = max(1e-12 * float(each.max()), 1e-300)  # of what no torque tells, nothing is known
    alone = 0.5 * np.log(total / np.maximum(each, least))  # log of the size that explains all torque
    count = np.maximum(np.bincount(member, minlength=len(names)), 1)
    mean_square = np.bincount(member[: model.p], shared[:, 0] ** 2, len(names)) / count
    body = alone[single] + 0.5 * np.log(np.maximum(mean_square, 1e-300))
    known = mean_square > 0.0
    # of the whole robot's parameters of a kind, rms: no CAD is known to be nearer (our choice)
    min_cad_deviation = 0.03
    near = np.where(known, body + np.log(min_cad_deviation), -np.inf)
    max_deviation = 3.0  # of the whole robot's parameters of a kind, rms, or of what explains all torque (our choice)
    far = np.where(known, body, alone) + np.log(max_deviation)
    offset_share = 0.01  # the same of constant torques: motors have friction rather than offsets (our choice)
    shares = {"one": offset_share, "whole": 1.0}
    explained_share = 0.2  # of all torque, what a kind of parameters explains before any data (our choice)
    share = np.array([shares.get(name.split(" ")[0], explained_share) for name in names])
    whole_width = 1.0  # the same of κ, of which the size is known: the whole robot explains all torque (our choice)
    kind_width = 3.0  # of a kind's logarithm of size, one standard deviation (our choice)
    width = np.where([name == "whole" for name in names], whole_width, kind_width)
    return _Sizes(names, member, np.clip(alone + np.log(share), near, far), width, near, far)


def _posterior(factor: np.ndarray, columns: np.ndarray, deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return posterior values (b,) and their covariance (b, b)."""
    (b, p), whitened = columns.shape, columns * deviations
    stacked = np.zeros((b + p, p + 1))
    stacked[:b, :p], stacked[:b, p], stacked[b:, :p] = factor[:b, :b] @ whitened, factor[:b, b], np.eye(p)
    upper = retriangulate(stacked, overwrite=True)
    inverse = np.asarray(scipy.linalg.solve_triangular(upper[:p, :p], np.eye(p)))
    root = whitened @ inverse
    return root @ upper[:p, p], root @ root.T


def _most_probable(factor: np.ndarray, columns: np.ndarray, sizes: _Sizes, start: np.ndarray) -> np.ndarray:
    """Return the logarithms of the sizes (k,) that maximise evidence times their prior."""
    b = len(columns)
    unscaled, target = factor[:b, :b] @ columns, factor[:b, b]

    def lost(t: np.ndarray) -> tuple[float, np.ndarray]:
        own = unscaled * sizes.deviations(t)
        inverse, _ = dtrtri(np.linalg.cholesky(own @ own.T + np.eye(b)), lower=1)  # of the root of y's covariance
        seen, whitened = inverse @ own, inverse @ target
        away = (t - sizes.centre) / sizes.width
        value = 0.5 * float(whitened @ whitened + away @ away) - float(np.log(np.diag(inverse)).sum())
        slope = (whitened @ seen) ** 2 - np.einsum("ij,ij->j", seen, seen)  # of the evidence by each log deviation
        return value, away / sizes.width - np.bincount(sizes.member, slope, len(t))

    found = scipy.optimize.minimize(
        lost,
        np.clip(start, sizes.least, sizes.most),
        jac=True,
        method="L-BFGS-B",
        bounds=np.column_stack([sizes.least, sizes.most]),
        options={"maxiter": 60, "ftol": 1e-8},
    )
    return np.asarray(found.x)


def rods(chain: Chain, model: IdentificationModel, total: float = 1.0) -> np.ndarray:
    """Return parameters (B, 10) of rods from each body's frame to the next, mass by length and thickness."""
    arm = model.bodies
    ends = np.array([np.asarray(chain.tail)[:3, 3]] * arm.count)
    for i, parent in enumerate(arm.parents):
        if parent >= 0 and arm.coordinates[i] >= 0:
            ends[parent] = arm.placements[i][:3, 3]
    moving = arm.coordinates >= 0
    share = np.where(moving, np.linalg.norm(ends, axis=1) + 2 * RADIUS, 0.0)
    masses = total * share / share.sum()
    return np.array(
        [
            pseudo_inertia.rod(mass, end, RADIUS) if moves else pseudo_inertia.ball(*PAYLOAD)
            for mass, end, moves in zip(masses, ends, moving)
        ]
    )


STEPS = (TEMPERING, 2.0 * TEMPERING, 4.0 * TEMPERING)


def tempered_prior(
    find: Callable[..., Prior], found: Prior, rows: Sequence[ObservationRows], regimes: Regimes
) -> Prior:
    """Return the prior with the tempering that best predicts held-out ranges of motion.

    Errors are squares of all rows, each in units of its residuals, and their geometric mean over the regimes: where
    one kind of extreme is hard for every prior it decides no more than the others. A stronger prior has to be better by
    `min_gain`.

    Args:
        find: `find_prior` of rows, a prior to start from, and a tempering.
        found: the prior with the least of `STEPS`.
        rows: in the base columns.
        regimes: of these rows.
    """
    data, columns, best = triangulate(rows), np.arange(len(rows[0].names)), None
    std = found.first.std
    min_gain = 0.08  # in the logarithm of squared errors, by which a stronger prior has to be better (our choice)
    for tempering in STEPS:
        own = found if tempering == STEPS[0] else find(rows, start=found, tempering=tempering)
        inflation = tempering * own.first.inflation
        validation = CrossValidation(
            data, len(std), 1, own.first.std, inflation, np.full(len(columns), -1), own.rows, regimes
        )
        squares = (validation.extrapolated(columns) / std**2).sum(axis=1)
        error = float(np.log(np.maximum(squares, 1e-300)).mean())
        if best is None or error < best[0] - min_gain:
            best = error, own
    assert best is not None
    return best[1]

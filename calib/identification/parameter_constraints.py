"""What parameters must satisfy, by the names of files, and an estimate held to it: the PC methods' common part.

A row is lower <= aᵀ β <= upper over the columns that are estimated. A standard parameter, or a weighted sum of several,
is such a row where the torques depend on it alone: cᵀ χ = aᵀ β with c = Tᵀ a, T the regrouping of the base; any other
has no effect, and a bound on it would say nothing of the estimate (Janot's slides on the TX40). Inertia matrices M(q)
over random postures are matrix inequalities: λ_min(S M(q; β) S) >= `MIN_EIGENVALUE`, S making the mean diagonal one.
Bodies that can exist are a cone (`calib.identification.body_cone`), which M(q) > 0 follows from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np

from calib.arrays import frozen
from calib.config import strict
from calib.config_types import Checked, Expect, Flag, Real, Text, Whole
from calib.dynamics import base as bases
from calib.dynamics.base import Base
from calib.dynamics.drives import DriveTerm
from calib.dynamics.regressor_model import RegressorModel
from calib.errors import NotConverged, UsageError, require, suggestion
from calib.estimation.convex.cone_program import Definite
from calib.estimation.convex.constrained import Constrained, within
from calib.estimation.convex.constraint_relations import contradicting, restricted
from calib.estimation.linear import LinearFit
from calib.estimation.triangles import Triangles
from calib.identification.body_cone import BodyCone, cone_of
from calib.records import Number

POSTURES = 50  # at which M(q) must be positive definite (our choice)
MIN_EIGENVALUE = 1e-3  # of the smallest eigenvalue of S M(q) S (our choice): what falls below moves at no torque at all
RAISED_BY, MAX_EIGENVALUE = (
    10**0.5,
    0.4,
)  # factor and limit of the same where an estimate cannot be simulated (our choice)


def _in_order(value: Any) -> Any:
    if (
        isinstance(value, list | tuple)
        and len(value) == 2
        and all(type(x) in (int, float) for x in value)
        and value[0] > value[1]
    ):
        raise ValueError(f"the lower bound {value[0]:g} is above the upper {value[1]:g}")
    return value


@strict
@dataclass(frozen=True)
class WeightedSum:
    """A weighted sum of parameters, and what it must be: `equal`, or not below `least`, not above `most`."""

    weights: Mapping[str, float]
    least: float | None = None
    most: float | None = None
    equal: float | None = None
    name: Text = ""


Bounds = Annotated[
    tuple[Annotated[float, Real(infinite=True)], Annotated[float, Real(infinite=True)]],
    Expect("two numbers, [lower, upper]; -inf and inf leave one out"), Checked(_in_order),
]  # fmt: skip


@strict
@dataclass(frozen=True)
class ConstraintSettings:
    """Table [constraints] of the options file; without it the PC methods take its defaults.

    Attributes:
        signs: drives' inertia and friction are not negative.
        inertia: number of random postures in which M(q) is positive definite; 0: none.
        bodies: the parameters are those of bodies that can exist, in place of `inertia`.
        bounds: name of a parameter → [lower, upper]; both alike fix it.
        sum: weighted sums of parameters.
    """

    signs: Flag = True
    inertia: Annotated[int, Whole(0, 10_000)] = POSTURES
    bodies: Flag = False
    bounds: Mapping[str, Bounds] = field(default_factory=dict)
    sum: tuple[WeightedSum, ...] = ()


@dataclass(frozen=True, eq=False)
class Constraints:
    """What p columns must satisfy.

    Attributes:
        names: c, of the rows, as a user reads them.
        matrix, lower, upper: (c, p), (c,), (c,).
        inertia: (K, n, n, p), M(q_k; β) = inertia[k] β.
        cone: of bodies that can exist; None where that is not asked.
        plane: name of the row that stands for the cone (`touched`); empty where none does.
        least: of the smallest eigenvalue of S M(q) S, see `raised`.
        likely: indices of the postures that held the estimate of a problem much like the next.
    """

    names: tuple[str, ...]
    matrix: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    inertia: np.ndarray
    cone: BodyCone | None = None
    plane: str = ""
    least: float = MIN_EIGENVALUE
    likely: np.ndarray | None = None

    def __post_init__(self) -> None:
        for key in ("matrix", "lower", "upper", "inertia"):
            object.__setattr__(self, key, frozen(getattr(self, key)))

    def solve(self, factor: np.ndarray) -> Constrained:
        """Return argmin ½ ‖R β - z‖² under these constraints, see `calib.estimation.convex.constrained.within`.

        Raises:
            NotConverged: with the last β, where no robot of definite inertia satisfies the others.
        """
        if self.cone is not None:
            return self.touched(factor).solve(factor)
        p = len(factor) - 1
        free = np.linalg.solve(factor[:p, :p], factor[:p, p])
        try:
            wanted = _definite(self.inertia, free, self.least, self.likely)
            return within(factor, self.matrix, self.lower, self.upper, wanted)
        except NotConverged as error:
            raise NotConverged(
                f"[constraints]: no estimate was found that satisfies {'; '.join(self.names) or 'them'}, with M(q) "
                f"positive definite in {len(self.inertia)} postures: take bounds back, or tell them apart by motion "
                f"({error})",
                error.last,
            ) from error

    def raised(self) -> Constraints | None:
        """Return these with M(q) three times as far from singular, None where it already is by `MAX_EIGENVALUE`.

        A robot may have a definite inertia, and yet so little in a direction that a sampled controller cannot hold it.
        """
        least = self.least * RAISED_BY
        return replace(self, least=least) if len(self.inertia) and least <= MAX_EIGENVALUE else None

    def touched(self, factor: np.ndarray) -> Constraints:
        """Return these constraints with the cone of bodies replaced by the plane that holds the optimum of `factor`.

        Raises:
            NotConverged: where no bodies that can exist satisfy the others.
        """
        if self.cone is None:
            return self
        try:
            plane = self.cone.touching(factor, self.matrix, self.lower, self.upper)
        except NotConverged as error:
            raise NotConverged(
                f"[constraints]: no bodies that can exist satisfy {'; '.join(self.names) or 'them'}: take bounds back "
                f"({error})",
                error.last,
            ) from error
        if plane is None:
            return replace(self, cone=None)
        named = f"bodies that can exist ({', '.join(plane.bodies) or 'all'} on the border)"
        return replace(
            self, cone=None, plane=named, names=(*self.names, named), matrix=np.vstack([self.matrix, plane.normal]),
            lower=np.append(self.lower, plane.bound), upper=np.append(self.upper, np.inf),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Binding:
    """A constraint that holds an estimate.

    Attributes:
        name: of the constraint.
        multiplier: μ, slope of ½ ‖R β - z‖² against the bound; of an equality with either sign.
        free: aᵀ β of the data alone, with its standard deviation; NaN for M(q).
        sigma: see `free`.
        bound: where it is held.
        equality: whether it was asked to be there.
    """

    name: str
    multiplier: Number
    free: Number
    sigma: Number
    bound: Number
    equality: bool


@dataclass(frozen=True, eq=False)
class Held:
    """A constrained estimate beside the free one.

    Attributes:
        names: of all constraints.
        solution: the optimum with its multipliers.
        binding: those that hold it.
        tight: indices of the postures in which M(q) is on its bound.
        free: the free estimate.
        plane: name of the one that stands for bodies that can exist.
        least: see `Constraints`.
    """

    names: tuple[str, ...]
    solution: Constrained
    binding: tuple[Binding, ...]
    tight: np.ndarray
    free: LinearFit
    plane: str = ""
    least: float = MIN_EIGENVALUE

    @property
    def postures(self) -> int:
        """Number of postures in which M(q) is on its bound."""
        return len(self.tight)

    def lines(self) -> list[str]:
        """Return what a user should know of constraints that hold the estimate."""
        told = []
        max_sigmas = 3.0  # standard deviations by which the data speak against an equality that is told (our choice)
        for one in self.binding:
            said = f"the data alone say {one.free:.3g} ± {one.sigma:.2g}"
            if one.name == self.plane:
                away = abs(one.free - one.bound) / max(one.sigma, 1e-300)
                told.append(
                    f"held to {one.name}: the data alone lie {away:.3g} standard deviations beyond; the motion is too "
                    "poor, or the estimate is biased"
                )
            elif not one.equality:
                told.append(
                    f"an estimate sits on its bound, {one.name}: {said}; the bound may exclude the truth, or the "
                    "estimate is biased"
                )
            elif abs(one.free - one.bound) > max_sigmas * one.sigma:
                told.append(f"the data speak against {one.name}: {said}")
        if self.postures:
            told.append(
                f"M(q) is held positive definite in {self.postures} postures: the data alone give a robot that cannot "
                "be there; the motion is too poor, or the estimate is biased"
            )
        if self.postures and self.least > MIN_EIGENVALUE:
            told.append(
                f"M(q) is kept {self.least / MIN_EIGENVALUE:.0f} times as far from singular as asked: nearer, the "
                "controller cannot hold the simulated robot"
            )
        return told


def make_constraints(
    settings: ConstraintSettings,
    model: RegressorModel,
    base: Base,
    names: Sequence[str],
    terms: Sequence[DriveTerm | None],
    seed: int = 0,
) -> Constraints:
    """Return what the settings ask of the columns of an estimate.

    Args:
        names: (p,) of the columns: those of the base, then richer friction.
        terms: (p,) the drive term behind each column; None for parameters of bodies.
        seed: of the postures.

    Raises:
        UsageError: for a name that is none, a bound without effect on the torques, bounds that contradict each other.
    """
    p = len(names)
    told, rows, lower, upper = [], [], [], []
    for name, (low, high) in settings.bounds.items():
        told.append(_words(name, low, high))
        rows.append(_row({name: 1.0}, base, names))
        lower.append(low)
        upper.append(high)
    for number, one in enumerate(settings.sum, 1):
        low = one.equal if one.equal is not None else -np.inf if one.least is None else one.least
        high = one.equal if one.equal is not None else np.inf if one.most is None else one.most
        named = one.name or " + ".join(f"{weight:g} {name}" for name, weight in one.weights.items())
        if one.equal is not None and (one.least, one.most) != (None, None):
            raise UsageError(f"[[constraints.sum]] number {number}: 'equal' goes without 'least' and 'most'")
        if low > high or not (np.isfinite(low) or np.isfinite(high)):
            raise UsageError(f"[[constraints.sum]] number {number} ({named}): expected equal, or least <= most")
        told.append(_words(named, low, high))
        rows.append(_row(one.weights, base, names))
        lower.append(low)
        upper.append(high)
    if settings.signs:
        stated = set(settings.bounds)
        for k, one in enumerate(terms):
            if one is not None and one.nonnegative and names[k] not in stated:
                told.append(f"{names[k]} >= 0")
                rows.append(np.eye(p)[k])
                lower.append(0.0)
                upper.append(np.inf)
    matrix, low, high = np.reshape(rows, (-1, p)), np.array(lower, dtype=float), np.array(upper, dtype=float)
    against = contradicting(matrix, low, high) if len(matrix) else ()
    if against:
        raise UsageError(
            f"[constraints] contradict each other: {'; '.join(told[k] for k in against)}: no estimate satisfies them "
            "together; take one of them back"
        )
    cone = cone_of(model, base) if settings.bodies and model.inertial else None
    inertia = _inertia(settings if cone is None else replace(settings, inertia=0), model, base, p, seed)
    return Constraints(tuple(told), matrix, low, high, inertia, cone)


def signs(names: Sequence[str], positive: Sequence[str]) -> Constraints:
    """Return x_j >= 0 for columns by name.

    Raises:
        UsageError: for a name that is none of the columns.
    """
    for name in positive:
        require(name in names, f"'{name}' is none of the estimated parameters {', '.join(names)}", UsageError)
    matrix = np.eye(len(names))[[list(names).index(name) for name in positive]]
    count = len(positive)
    return Constraints(
        tuple(f"{name} >= 0" for name in positive), matrix, np.zeros(count), np.full(count, np.inf),
        np.zeros((0, 0, 0, len(names))),
    )  # fmt: skip


def hold(
    fit: LinearFit, factor: np.ndarray, data: Triangles, std: np.ndarray, constraints: Constraints, stated: bool
) -> tuple[LinearFit, Held]:
    """Return a fit under constraints, its covariance with those that bind taken as equalities, and what binds.

    Args:
        fit: the free estimate.
        factor: (p + 1, p + 1) triangle [R z; 0 ρ] that it minimises.
        data: triangles of the rows whose residuals give the noise, one group per torque row.
        std: (g,) of the groups.
        stated: whether the covariance takes `std` as the noise; otherwise σ² of the residuals, of the constrained
            estimate.
    """
    free = fit.estimate
    constraints = constraints.touched(factor)
    found = constraints.solve(factor)
    normals = found.normals[found.binding]
    before, after = (data.residual_squares(values) for values in (free.values, found.values))
    dof = free.dof + int(np.linalg.matrix_rank(normals)) if len(normals) else free.dof
    ratio = float(np.sum(after / std**2) / dof / max(np.sum(before / std**2) / free.dof, 1e-300))
    covariance = restricted(np.asarray(free.covariance), factor, normals) * (1.0 if stated else ratio)
    estimate = replace(
        free, values=found.values, covariance=covariance, residual_std=free.residual_std * np.sqrt(ratio), dof=dof
    )
    group = fit.group_std * np.sqrt(after / np.where(before > 0.0, before, np.inf))
    held = replace(fit, estimate=estimate, group_std=np.where(before > 0.0, group, fit.group_std))
    return held, _told(constraints, found, fit)


def _told(constraints: Constraints, found: Constrained, free: LinearFit) -> Held:
    """Return the constraints that bind, in words; multipliers come as `within` orders them."""
    same = constraints.lower == constraints.upper
    low = np.flatnonzero(np.isfinite(constraints.lower) & ~same)
    high = np.flatnonzero(np.isfinite(constraints.upper) & ~same)
    postures = len(constraints.inertia)
    places = np.concatenate([low, high, np.full(postures, -1), np.flatnonzero(same)]).astype(int)
    upper = np.zeros(len(places), bool)
    upper[len(low) : len(low) + len(high)] = True
    binding = []
    for k in np.flatnonzero(found.binding & (places >= 0)):
        row = constraints.matrix[places[k]]
        bound = (constraints.upper if upper[k] else constraints.lower)[places[k]]
        binding.append(Binding(
            constraints.names[places[k]], float(found.multipliers[k]), float(row @ free.estimate.values),
            float(np.sqrt(max(row @ free.estimate.covariance @ row, 0.0))), float(bound), bool(same[places[k]]),
        ))  # fmt: skip
    tight = frozen(np.flatnonzero(found.binding[places < 0]), int)
    return Held(constraints.names, found, tuple(binding), tight, free, constraints.plane, constraints.least)


def _words(name: str, low: float, high: float) -> str:
    if low == high:
        return f"{name} = {low:g}"
    if np.isinf(low):
        return f"{name} <= {high:g}"
    return f"{name} >= {low:g}" if np.isinf(high) else f"{low:g} <= {name} <= {high:g}"


def _row(weights: Mapping[str, float], base: Base, names: Sequence[str]) -> np.ndarray:
    """Return a (p,) of a weighted sum of columns and standard parameters.

    Raises:
        UsageError: where the torques do not depend on the sum alone.
    """
    row, standard = np.zeros(len(names)), np.zeros(len(base.standard))
    for name, weight in weights.items():
        if name in names:
            row[list(names).index(name)] += weight
        elif name in base.standard:
            standard[base.standard.index(name)] += weight
        else:
            raise UsageError(
                f"[constraints]: '{name}' is no parameter of this model{suggestion(name, (*names, *base.standard))}; "
                f"it estimates {', '.join(names)}"
            )
    own = standard[base.kept]  # T of the kept columns is the identity
    if np.abs(base.transform.T @ own - standard).max() > 1e-6 * max(np.abs(standard).max(), 1e-300):
        raise UsageError(_without_effect(weights, base))
    row[: base.b] += own
    require(row.any(), f"[constraints]: the weights of {', '.join(weights)} add to nothing", UsageError)
    return row


def _without_effect(weights: Mapping[str, float], base: Base) -> str:
    """Say why a sum of standard parameters cannot be constrained."""
    silent = [name for name in weights if name in base.without_effect]
    if silent:
        return (
            f"[constraints]: {', '.join(silent)} has no effect on the torques of this robot: a bound on it would say "
            "nothing of the estimate; leave it out"
        )
    parts = [
        line for line in bases.expressions(base)
        if any(name in line.replace("=", " ").split() for name in weights)
    ]  # fmt: skip
    return (
        f"[constraints]: {', '.join(weights)}: torques identify it only in sums with others: {'; '.join(parts[:4])}. "
        "State the bound for such a sum"
    )


def _inertia(settings: ConstraintSettings, model: RegressorModel, base: Base, p: int, seed: int) -> np.ndarray:
    """Return the tensor (K, n, n, p) of inertia matrices over random postures, each column that of an acceleration."""
    if not settings.inertia or not model.inertial or model.rows != model.n:
        return np.zeros((0, model.n, model.n, p))
    q = bases.random_samples(model, settings.inertia, seed).q
    count, n = q.shape
    still = np.zeros_like(q)
    rest = model.regressor(q, still, still)[:, :, base.kept]
    tensor = np.zeros((count, n, n, p))
    for j in range(n):
        moving = still.copy()
        moving[:, j] = 1.0
        tensor[:, :, j, : base.b] = model.regressor(q, still, moving)[:, :, base.kept] - rest
    return 0.5 * (tensor + tensor.transpose(0, 2, 1, 3))


def _definite(inertia: np.ndarray, free: np.ndarray, least: float, likely: np.ndarray | None) -> Definite | None:
    """Return S M(q) S over the postures, S from the size of the diagonal of the free estimate."""
    if not len(inertia):
        return None
    size = np.abs(np.einsum("kiip,p->ki", inertia, free)).mean(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(size, 1e-6 * size.max()))
    return Definite(inertia * scale[:, None, None] * scale[None, :, None], least, likely)

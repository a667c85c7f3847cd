"""Constraints on parameters by name, and constrained estimates: the common part of the methods pc-*.

A linear constraint is lower <= aᵀ β <= upper for the estimated columns' parameters β. A standard parameter, or a
weighted sum cᵀ χ of several, can be constrained so if the torques identify it: cᵀ χ = aᵀ β with c = Tᵀ a, where T is
the regrouping of the base parameters. A bound on any other sum has no effect on the estimate (Janot's slides on the
TX40) and is refused. Inertia matrices M(q) at random postures are matrix inequalities: λ_min(S M(q; β) S) >=
`MIN_EIGENVALUE`, with a scaling S that makes the mean diagonal one. Physically consistent bodies form a cone
(`calib.identification.methods.body_cone`), which implies M(q) > 0. The user's own functions h(β) >= 0 may be nonlinear
(`calib.identification.methods.curved`); convex constraints in CVXPY are rows and convex sets
(`calib.identification.methods.convex`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from calib.dynamics import base as bases
from calib.dynamics.base import Base
from calib.dynamics.drives import DriveTerm
from calib.dynamics.regressor_model import RegressorModel
from calib.errors import Finding, NotConverged, UsageError, finding, refuse_option, require, suggestion
from calib.estimation.convex_sets import ConvexSet
from calib.estimation.linear import LinearFit
from calib.estimation.triangles import Triangles
from calib.identification.methods.body_cone import BodyCone, cone_of
from calib.identification.methods.constrained import Constrained, Definite, contradicting, restricted, within
from calib.identification.methods.constraint_settings import Binding, ConstraintSettings, Held
from calib.identification.methods.convex import UserConstraints, is_empty, user_constraints
from calib.identification.methods.curved import Curved, make_curved, tangents
from calib.identification.methods.method import IdentificationProblem
from calib.records import Frozen, frozen

# of the smallest eigenvalue of S M(q) S (our choice): what falls below moves at no torque at all
MIN_EIGENVALUE = 1e-3
# factor and limit of it where an estimate cannot be simulated (our choice)
RAISED_BY, MAX_EIGENVALUE = 10**0.5, 0.4


@dataclass(frozen=True, eq=False)
class Constraints(Frozen):
    """Constraints on the parameters β of p columns.

    Attributes:
        names: c names of the constraints, for users.
        matrix, lower, upper: (c, p), (c,), (c,), linear constraints lower <= matrix β <= upper.
        inertia: (K, n, n, p), inertia matrices M(q_k; β) = inertia[k] β of K postures.
        cone: cone of physically consistent bodies; None if not requested.
        plane: name of the row that replaces the cone (`touched`); empty without one.
        least: lower bound of the smallest eigenvalue of S M(q) S.
        likely: indices of the postures whose constraint was binding in a similar problem; None: unknown.
        curved: constraints h(β) >= 0.
        tangents: names of the rows that replace the curved constraints (`touched`).
        sets: convex sets; touching: names of the rows that replace those that bind (`touched`), inactive: the others.
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
    curved: tuple[Curved, ...] = ()
    tangents: tuple[str, ...] = ()
    sets: tuple[ConvexSet, ...] = ()
    touching: tuple[str, ...] = ()
    inactive: tuple[str, ...] = ()

    def solve(self, factor: np.ndarray, free: np.ndarray | None = None) -> Constrained:
        """Return argmin ½ ‖R β - z‖² under these constraints, computed by `constrained.within`.

        Args:
            factor: (p + 1, p + 1) upper triangle [R z; 0 ρ] of the least-squares problem in the parameters β.
            free: (p,) unconstrained β, which gives the scale of M(q); None: the least-squares solution of the triangle.

        Raises:
            NotConverged: with the last β, if no positive definite inertia satisfies the other constraints.
        """
        if self.cone is not None or self.curved or self.sets:
            return self.touched(factor, free).solve(factor, free)
        return self._optimum(factor, free)

    def _optimum(self, factor: np.ndarray, free: np.ndarray | None) -> Constrained:
        """Return the optimum under rows, inertia matrices and convex sets."""
        p = len(factor) - 1
        if free is None:
            upper_triangle = factor[:p, :p]
            free = np.linalg.solve(upper_triangle, factor[:p, p])
        postures = f"M(q) positive definite in {len(self.inertia)} postures"
        with _unsatisfied(f"no estimate satisfies {self} with {postures}: remove bounds, or record other motion"):
            definite = _definite(self.inertia, free, self.least, self.likely)
            return within(factor, self.matrix, self.lower, self.upper, definite, self.sets)

    def __str__(self) -> str:
        names = (*self.names, *(convex.name for convex in self.sets))
        return "; ".join(names) or "them"

    def raised(self) -> Constraints | None:
        """Return the constraints with a three times larger bound on the inertia matrix M(q)'s smallest eigenvalue.

        The result is None if the bound would exceed `MAX_EIGENVALUE`. A robot may have a positive definite inertia
        matrix, but so little inertia in some direction that a sampled controller cannot stabilise it.
        """
        least = self.least * RAISED_BY
        if len(self.inertia) and least <= MAX_EIGENVALUE:
            return replace(self, least=least)
        return None

    def touched(self, factor: np.ndarray, free: np.ndarray | None = None) -> Constraints:
        """Return the constraints with the cone, convex sets and curved constraints replaced by planes at the optimum.

        Args:
            factor: (p + 1, p + 1) upper triangle [R z; 0 ρ], which defines the optimum.
            free: (p,) β without constraints, from which the scale of M(q) is taken; None: that of the factor.

        Raises:
            NotConverged: if no estimate, or no physically consistent bodies, satisfy the other constraints.
        """
        if self.curved:
            return self._flattened(factor).touched(factor, free)
        if self.cone is None and not self.sets:
            return self
        linear = replace(self, cone=None, sets=())
        if self.cone is None:
            optimum = self._optimum(factor, free)
            return linear._with_planes(self.sets, optimum.planes, optimum.values)
        with _unsatisfied(f"no physically consistent bodies satisfy {self}: remove bounds"):
            touching = self.cone.touching(factor, self.matrix, self.lower, self.upper, self.sets)
        linear = linear._with_planes(self.sets, touching.planes, touching.values)
        if touching.normal is None:
            return linear
        label = f"physically consistent bodies ({', '.join(touching.bodies) or 'all'} on the border)"
        with_plane = linear._with_row(label, touching.normal, touching.values)
        return replace(with_plane, plane=label)

    def _with_planes(
        self, sets: Sequence[ConvexSet], planes: Sequence[np.ndarray | None], values: np.ndarray
    ) -> Constraints:
        """Return the constraints with the planes (p,) that touch convex sets at an optimum (p,); None: inactive."""
        constraints = self
        for convex, normal in zip(sets, planes):
            if normal is None:
                constraints = replace(constraints, inactive=(*constraints.inactive, convex.name))
            else:
                constraints = constraints._with_row(convex.name, normal, values)
                constraints = replace(constraints, touching=(*constraints.touching, convex.name))
        return constraints

    def _with_row(self, name: str, normal: np.ndarray, values: np.ndarray) -> Constraints:
        """Return the constraints with a plane νᵀ β >= νᵀ β*."""
        names = (*self.names, name)
        matrix = np.vstack([self.matrix, normal])
        lower = np.append(self.lower, normal @ values)
        upper = np.append(self.upper, np.inf)
        return replace(self, names=names, matrix=matrix, lower=lower, upper=upper)

    def _flattened(self, factor: np.ndarray) -> Constraints:
        """Return the constraints with the curved ones replaced by their tangent planes at the optimum.

        Args:
            factor: (p + 1, p + 1) upper triangle [R z; 0 ρ], which defines the optimum.
        """
        linear = replace(self, curved=())
        m = len(self.curved)
        p = len(factor) - 1
        start = linear.solve(factor).values
        upper_triangle = factor[:-1, :-1]
        least_squares = np.linalg.solve(upper_triangle, factor[:-1, -1])
        free = np.append(least_squares, np.zeros(m))

        def solve(triangle: np.ndarray, rows: np.ndarray, lower: np.ndarray) -> Constrained:
            """Return the optimum of parameters and m further unknowns, under more inequalities rows · b >= lower.

            Args:
                triangle: (p + m + 1, p + m + 1) upper triangle of the problem.
                rows: (k, p + m) rows of the further inequalities.
                lower: (k,) their lower bounds.
            """
            wider = np.pad(self.matrix, ((0, 0), (0, m)))
            names = ("",) * len(rows) + self.names
            matrix = np.vstack([rows, wider])
            upper = np.append(np.full(len(lower), np.inf), self.upper)
            padding = ((0, 0), (0, 0), (0, 0), (0, m))
            inertia = np.pad(self.inertia, padding)
            lower = np.append(lower, self.lower)
            sets = tuple(convex.of(np.eye(p, p + m)) for convex in self.sets)
            further = replace(linear, names=names, matrix=matrix, lower=lower, upper=upper, inertia=inertia, sets=sets)
            return further.solve(triangle, free)

        names = tuple(constraint.name for constraint in self.curved)
        with _unsatisfied(f"no estimate satisfies {'; '.join(names)} together with {linear}: remove one of them"):
            normals, bounds = tangents(self.curved, factor, start, solve)
        all_names = (*self.names, *names)
        matrix = np.vstack([self.matrix, normals])
        lower = np.append(self.lower, bounds)
        upper = np.append(self.upper, np.full(m, np.inf))
        return replace(linear, tangents=names, names=all_names, matrix=matrix, lower=lower, upper=upper)


@contextmanager
def _unsatisfied(message: str) -> Iterator[None]:
    """Prefix the message of a `NotConverged` that is raised in the context with `message`."""
    try:
        yield
    except NotConverged as error:
        raise NotConverged(f"[constraints]: {message} ({error})", error.last) from error


def make_constraints(
    settings: ConstraintSettings,
    model: RegressorModel,
    base: Base,
    names: Sequence[str],
    terms: Sequence[DriveTerm | None],
) -> Constraints:
    """Return the constraints on an estimate's columns that the settings request.

    Args:
        settings: table [constraints] of the options.
        model, base: the model and its base parameters.
        names: (p,) names of the columns: base columns, then additional friction.
        terms: (p,) drive term of each column; None for parameters of bodies.

    Raises:
        UsageError: for an unknown name, a bound without effect on the torques, or contradicting bounds.
    """

    def row_of(weights: Mapping[str, float]) -> np.ndarray:
        return _row(weights, base, names)

    requests: list[tuple[str, Mapping[str, float], float, float]]
    requests = []
    for name, bounds in settings.bounds.items():
        requests.append((name, {name: 1.0}, *bounds))
    for number, weighted_sum in enumerate(settings.sum, 1):
        location = f"[[constraints.sum]] number {number}"
        low, high = weighted_sum.limits
        label = weighted_sum.name or " + ".join(f"{weight:g} {name}" for name, weight in weighted_sum.weights.items())
        twice = weighted_sum.equal is not None and (weighted_sum.least, weighted_sum.most) != (None, None)
        require(not twice, f"{location}: 'equal' cannot be combined with 'least' or 'most': remove one", UsageError)
        if low > high or not (np.isfinite(low) or np.isfinite(high)):
            refuse_option(f"{location} ({label})", "expected equal, or least <= most")
        requests.append((label, weighted_sum.weights, low, high))
    if settings.signs:
        for name, term in zip(names, terms):
            if term is not None and term.nonnegative and name not in settings.bounds:
                requests.append((name, {name: 1.0}, 0.0, np.inf))
    descriptions: list[str] = []
    rows: list[np.ndarray] = []
    lows: list[float] = []
    highs: list[float] = []
    for label, weights, low, high in requests:
        descriptions.append(_words(label, low, high))
        rows.append(row_of(weights))
        lows.append(low)
        highs.append(high)
    convex = UserConstraints((), ())
    function = settings.function
    if function is not None:
        convex = user_constraints(function, row_of)
    for constraint in convex.rows:
        descriptions.append(constraint.name)
        rows.append(constraint.row)
        lows.append(constraint.lower)
        highs.append(constraint.upper)
    matrix = np.reshape(rows, (-1, len(names)))
    lower = np.array(lows, dtype=float)
    upper = np.array(highs, dtype=float)
    against: Sequence[int] = ()
    if len(matrix):
        against = contradicting(matrix, lower, upper)
    if against:
        label = "; ".join(descriptions[k] for k in against)
        refuse_option(
            "[constraints] contradict each other", f"{label}: no estimate satisfies them together; remove one of them"
        )
    if convex.sets and is_empty(convex.sets, matrix, lower, upper):
        label = "; ".join([*descriptions, *(convex_set.name for convex_set in convex.sets)])
        refuse_option("[constraints] contradict each other", f"no estimate satisfies together {label}; remove one")
    cone = None
    if settings.bodies and model.inertial:
        cone = cone_of(model, base)
        # Physically consistent bodies have a positive definite inertia matrix at every posture.
        settings = replace(settings, inertia=0)
    inertia = _inertia(settings, model, base, len(names))
    curved = tuple(make_curved(constraint, row_of) for constraint in settings.curved)
    return Constraints(tuple(descriptions), matrix, lower, upper, inertia, cone, curved=curved, sets=convex.sets)


def constraints_of(problem: IdentificationProblem) -> Constraints:
    """Return the constraints on a problem's columns; without settings, the default ones.

    Raises:
        UsageError: for an unknown name, a bound without effect on the torques, or contradicting bounds.
    """
    richer_names = problem.rows[0].names[problem.base.b :]
    names = (*problem.base.names, *richer_names)
    settings = problem.constraints or ConstraintSettings()
    return make_constraints(settings, problem.model, problem.base, names, problem.terms)


def hold(
    fit: LinearFit, factor: np.ndarray, data: Triangles, std: np.ndarray, constraints: Constraints, stated_noise: bool
) -> tuple[LinearFit, Held]:
    """Return a constrained fit, whose covariance treats binding constraints as equalities, and its constraints.

    Args:
        fit: the unconstrained estimate.
        factor: (p + 1, p + 1) upper triangle [R z; 0 ρ] of its least-squares problem min ‖R β - z‖².
        data: R factors of the rows whose residuals give the noise, one group per torque row.
        std: (g,) noise standard deviations of the groups, in units of y.
        constraints: the constraints.
        stated_noise: whether `std` is the noise from which the covariance follows; otherwise σ² of the constrained
            estimate's residuals.

    Raises:
        NotConverged: if no estimate satisfies the constraints.
    """
    free = fit.estimate
    constraints = constraints.touched(factor)
    solution = constraints.solve(factor)
    normals = solution.normals[solution.binding]
    before = data.residual_squares(free.values)
    after = data.residual_squares(solution.values)
    dof = free.dof
    if len(normals):
        dof += int(np.linalg.matrix_rank(normals))
    variance_before = np.sum(before / std**2) / free.dof
    ratio = float(np.sum(after / std**2) / dof / max(variance_before, 1e-300))
    covariance = restricted(np.asarray(free.covariance), factor, normals) * (1.0 if stated_noise else ratio)
    residual_std = free.residual_std * np.sqrt(ratio)
    estimate = replace(free, values=solution.values, covariance=covariance, residual_std=residual_std, dof=dof)
    group_ratio = after / np.where(before > 0.0, before, np.inf)
    group = fit.group_std * np.sqrt(group_ratio)
    group_std = np.where(before > 0.0, group, fit.group_std)
    held_fit = replace(fit, estimate=estimate, group_std=group_std)
    return held_fit, _binding(constraints, solution, fit)


def _binding(constraints: Constraints, solution: Constrained, free: LinearFit) -> Held:
    """Return the constraints, and which of them bind at a solution.

    Args:
        constraints: the constraints.
        solution: the constrained optimum, in the order of `within`.
        free: the unconstrained estimate.
    """
    equal = constraints.lower == constraints.upper
    low = np.flatnonzero(np.isfinite(constraints.lower) & ~equal)
    high = np.flatnonzero(np.isfinite(constraints.upper) & ~equal)
    postures = len(constraints.inertia)
    posture_places = np.full(postures, -1)
    equalities = np.flatnonzero(equal)
    places = np.concatenate([low, high, posture_places, equalities]).astype(int)
    upper = np.zeros(len(places), bool)
    upper[len(low) : len(low) + len(high)] = True
    binding = []
    for k in np.flatnonzero(solution.binding & (places >= 0)):
        row = constraints.matrix[places[k]]
        bounds = constraints.upper if upper[k] else constraints.lower
        bound = bounds[places[k]]
        name = constraints.names[places[k]]
        origin = 0.0
        # told as h, by its plane, above zero
        if name in (*constraints.tangents, *constraints.touching):
            origin = bound
        multiplier = float(solution.multipliers[k])
        value = float(row @ free.estimate.values - origin)
        sigma = float(np.sqrt(max(row @ free.estimate.covariance @ row, 0.0)))
        is_equality = bool(equal[places[k]])
        binding.append(Binding(name, multiplier, value, sigma, float(bound - origin), is_equality))
    tight = frozen(np.flatnonzero(solution.binding[places < 0]), int)
    findings = tuple(_findings(constraints, binding, len(tight)))
    normals = solution.normals[solution.binding]
    names = (*constraints.names, *constraints.inactive)
    return Held(names, tuple(binding), tight, free, normals, findings)


def _findings(constraints: Constraints, binding: Sequence[Binding], postures: int) -> Iterator[Finding]:
    """Yield the findings on binding constraints; `postures` is the number of postures in which M(q) is at its bound."""
    # standard deviations by which the data speak against an equality that is named (our choice)
    max_sigmas = 3.0
    for one in binding:
        sigmas = abs(one.free - one.bound) / max(one.sigma, 1e-300)
        if one.name == constraints.plane:
            yield finding("held-to-bodies", name=one.name, sigmas=sigmas)
        elif one.name in constraints.touching:
            yield finding("held-to-convex", name=one.name, sigmas=sigmas)
        elif not one.equality or sigmas > max_sigmas:
            code = "against-equality" if one.equality else "on-its-bound"
            yield finding(code, name=one.name, free=one.free, sigma=one.sigma)
    if postures:
        yield finding("held-definite", postures=postures)
        if constraints.least > MIN_EIGENVALUE:
            yield finding("held-from-singular", times=constraints.least / MIN_EIGENVALUE)


def _words(name: str, low: float, high: float) -> str:
    if low == high:
        return f"{name} = {low:g}"
    if np.isinf(low):
        return f"{name} <= {high:g}"
    if np.isinf(high):
        return f"{name} >= {low:g}"
    return f"{low:g} <= {name} <= {high:g}"


def _row(weights: Mapping[str, float], base: Base, names: Sequence[str]) -> np.ndarray:
    """Return the row a (p,) of a weighted sum of columns and standard parameters, so that the sum is aᵀ β.

    Args:
        weights: name of a column or standard parameter to its weight.
        base: base parameters of the model.
        names: (p,) names of the columns.

    Raises:
        UsageError: if the torques do not identify the sum, or a name is unknown.
    """
    row = np.zeros(len(names))
    standard = np.zeros(len(base.standard))
    for name, weight in weights.items():
        if name in names:
            row[list(names).index(name)] += weight
        elif name in base.standard:
            standard[base.standard.index(name)] += weight
        else:
            choices = (*names, *base.standard)
            similar = suggestion(name, choices)
            message = f"'{name}' is not a parameter of this model{similar}; its parameters: {', '.join(names)}"
            refuse_option("[constraints]", message)
    # T of the kept columns is the identity
    base_row = standard[base.kept]
    if np.abs(base.transform.T @ base_row - standard).max() > 1e-6 * max(np.abs(standard).max(), 1e-300):
        refuse_option("[constraints]", _without_effect(weights, base))
    row[: base.b] += base_row
    require(
        row.any(), f"[constraints]: the weights of {', '.join(weights)} sum to zero; state other weights", UsageError
    )
    return row


def _without_effect(weights: Mapping[str, float], base: Base) -> str:
    """Return the text why a weighted sum of standard parameters cannot be constrained.

    Args:
        weights: name of a standard parameter to its weight.
        base: base parameters of the model.
    """
    silent = [name for name in weights if name in base.without_effect]
    if silent:
        return f"{', '.join(silent)} has no effect on the torques of this robot: remove the bound"
    lines = bases.expressions(base)
    parts = [line for line in lines if not weights.keys().isdisjoint(line.replace("=", " ").split())]
    sums = "; ".join(parts[:4])
    return f"{', '.join(weights)}: identifiable only in sums with others: {sums}. State the bound for such a sum"


def _inertia(settings: ConstraintSettings, model: RegressorModel, base: Base, p: int) -> np.ndarray:
    """Return the tensor (K, n, n, p) of the inertia matrices at random postures, M(q_k) = tensor[k] β.

    K is 0 if the constraint is not requested, or the rows are not those of all joint torques.

    Args:
        settings: table [constraints], with the number K of postures.
        model: the model.
        base: its base parameters.
        p: number of columns.
    """
    if not settings.inertia or not model.inertial or model.rows != model.n:
        return np.zeros((0, model.n, model.n, p))
    q = bases.random_samples(model, settings.inertia).q
    count, n = q.shape
    still = np.zeros_like(q)
    regressor = model.regressor(q, still, still)[:, :, base.kept]
    tensor = np.zeros((count, n, n, p))
    for j in range(n):
        moving = still.copy()
        moving[:, j] = 1.0
        accelerated = model.regressor(q, still, moving)[:, :, base.kept]
        tensor[:, :, j, : base.b] = accelerated - regressor
    return 0.5 * (tensor + tensor.transpose(0, 2, 1, 3))


def _definite(inertia: np.ndarray, free: np.ndarray, least: float, likely: np.ndarray | None) -> Definite | None:
    """Return the constraint on the scaled inertia matrices S M(q) S; None without matrices.

    S scales the mean diagonal at the unconstrained estimate `free` (p,) to one.

    Args:
        inertia: (K, n, n, p) inertia matrices M(q_k) = inertia[k] β.
        free: (p,) unconstrained estimate.
        least: lower bound of the eigenvalues of S M(q) S.
        likely: indices of matrices that were binding in a similar problem; None: unknown.
    """
    if not len(inertia):
        return None
    size = np.abs(np.einsum("kiip,p->ki", inertia, free)).mean(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(size, 1e-6 * size.max()))
    matrices = inertia * scale[:, None, None] * scale[None, :, None]
    return Definite(matrices, least, likely)

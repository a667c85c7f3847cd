"""Full set of physically consistent standard parameters, as simulators and URDFs require.

The data fix b combinations T χ of the p standard parameters; the rest is free, and most choices of it belong to no
body. With P_i the pseudo-inertia of body i (`calib.dynamics.pseudo_inertia`), P_i⁰ that of the CAD, d the drives' Ia,
Fv, Fc (1×1 matrices of the same kind), the parameters are

    argmin  ½ ‖R T χ - z‖² + ½ γ Σ_i D(P_i ‖ P_i⁰) + ½ Σ_d D(x_d ‖ x_d⁰)      R, z:
    `calib.identification.physical_consistency.information`

with the log-det divergence D (Lee, Wensing & Park 2020): convex, the same in any frame and any unit, and infinite at
the border, so every body is possible with a margin. A plain Euclidean distance would need a weight between kg and kg
m²; that in the coordinates of P_i⁰ does not, and may be asked for
(`calib.identification.physical_consistency.consistency_problem`).

How much the CAD counts. exp(-½ γ D) is, up to its norm, the Wishart density of a 4×4 matrix with mode P⁰ and γ + 5
degrees of freedom (our observation), so γ has a marginal likelihood,

    log p(data | γ) ≈ -J(χ̂) - ½ log det H(χ̂) + Σ_i log c(γ),
    log c(γ) = 2 (γ + 5) log γ - 2 γ - 2 (γ + 5) log 2 - log Γ₄((γ + 5) / 2) - 10 log γ + const,

Laplace's approximation, J the cost and H its curvature at the optimum: the weight is where that is largest (our choice;
blocks of one poor motion repeat each other, so that cross-validation on them wants no prior at all). γ is not let below
`MIN_CAD_WEIGHT`, where masses may be wrong by √(2/γ), a third (10 for rods, below which Laplace's approximation fails):
what no model explains must not pass for a wrong CAD. Only where a possible robot is within the estimate's covariance
and the result is not, γ is lowered until it is.

Where even the nearest possible robot, whatever its CAD, is d > √b standard deviations from the estimate, the data's
sigmas do not cover the errors of the model, and count d / √b times (Birge 1932): poor motion with a small residual
would otherwise overrule any CAD.

Newton's method solves it in milliseconds, strictly inside the cone; the nearest possible robot without any prior lies
on the border, a semidefinite program for Clarabel (`nearest`).

An estimate contradicts every robot that can exist where its distance from the nearest one is large. Where the model is
right, 95 % of all estimates are within √χ²(b) of a possible robot. Honest recordings are farther: friction of another
form has no place in a possible body, and the data's sigmas do not know of it. Only a distance several times that bound
points to signs, orders and robots; what it means is for a verdict to say.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg
from scipy.special import multigammaln  # type: ignore[attr-defined]

from calib.dynamics import pseudo_inertia
from calib.dynamics.idim import IdentificationModel
from calib.errors import NotConverged, UsageError, one_of
from calib.identification.physical_consistency.consistency_problem import (
    DRIVE,
    BodyCost,
    PriorBodies,
    blame,
    find_prior_bodies,
    make_problem,
    nearest,
)
from calib.identification.physical_consistency.information import Information, of
from calib.identification.prediction import Dynamics
from calib.records import Frozen
from calib.robot.chain import Chain

WEIGHTS = tuple(float(10.0 ** (k / 4)) for k in range(0, 19))
"""γ that are tried, 1 to 30 000."""
MIN_CAD_WEIGHT = 20.0
"""Least γ with a CAD."""
MIN_WEIGHT = 1e-3
"""Least γ, where the estimate asks for less CAD than the evidence does."""
WEAK_WEIGHT = 1.0
"""γ that hardly draws, yet keeps Newton's steps off the border: its distance is at most a tenth larger."""
MAX_TIMES = 3.0
"""Times the bound, up to which no semidefinite program is solved for the last tenth of a distance."""
PRIORS = ("entropic", "euclidean")
RIDGES = (0.0, 1e-12, 1e-10, 1e-8, 1e-6)
"""Ridges of a unit diagonal that are tried."""
SETTLED = 1e-8
"""Newton decrement² at which the search ends: the cost is within half of it of its minimum."""
MAX_STEPS = 200
"""Steps of Newton's method, at most."""
MIN_STEP = 1e-12
"""Fraction of a Newton step below which rounding keeps any step from lowering the cost."""
THIN_MARGIN = 1e-3
"""Consistency margin below which a body is hardly realistic [m]."""


if TYPE_CHECKING:
    from calib.identification.identify import Identification


@dataclass(frozen=True, eq=False)
class _Candidate:
    """The optimum of the cost for one prior weight.

    Attributes:
        evidence: log p(data | γ), up to a constant.
        gamma: prior weight γ.
        problem: the cost, with increased sigmas of the data.
        values: (p,) the optimum.
        references: the prior bodies.
    """

    evidence: float
    gamma: float
    problem: BodyCost
    values: np.ndarray
    references: PriorBodies


@dataclass(frozen=True, eq=False)
class PossibleBodies(Frozen):
    """Standard parameters of a physically consistent robot.

    Attributes:
        dynamics: the identified model with all its parameters.
        covariance: (p, p) covariance from data and prior, by the curvature at the optimum; zero for fixed parameters.
        weight: weight γ of the prior.
        doubt: factor by which the data's sigmas were increased; above 1 if no physically consistent robot is within
            them.
        margins: (B,) margin of physical consistency of each body [m], from `pseudo_inertia.margin`.
        distance: Mahalanobis distance of these parameters from the data's optimum, in standard deviations.
        nearest: distance of the nearest consistent robot; 0 if the estimate itself is consistent.
        allowed: 95 % limit of the distance for a correct model: √χ²(b).
        blamed: bodies or drive terms whose constraints contribute most to `nearest`, worst first, each with the
            distance without its constraint; empty if `nearest` is within `allowed`.
        source: text on the source of the prior bodies P⁰.
        prior: one of `PRIORS`.
        notes: remarks for the engineer.
    """

    dynamics: Dynamics
    covariance: np.ndarray
    weight: float
    doubt: float
    margins: np.ndarray
    distance: float
    nearest: float
    allowed: float
    blamed: tuple[tuple[str, float], ...]
    source: str
    prior: str
    notes: tuple[str, ...]

    @property
    def possible(self) -> bool:
        """Whether a physically consistent robot is within the estimate's confidence region."""
        return self.nearest <= self.allowed


def bound(b: int) -> float:
    """Return the 95 % limit √χ²(b) of the Mahalanobis distance of b estimated parameters from the true ones."""
    from scipy.special import chdtri

    return float(np.sqrt(chdtri(b, 0.05)))


def find_possible(information: Information, weight: float | None = None, prior: str = "entropic") -> PossibleBodies:
    """Return the full, physically consistent standard parameters of an identified model.

    Args:
        information: identified model with the information of its data.
        weight: prior weight γ; None: the weight with the largest evidence of the entropic prior.
        prior: ``entropic``, or ``euclidean``, its second-order expansion at P⁰, with which bodies may be at the limit
            of consistency.

    Raises:
        UsageError: for a model without bodies (motor side alone), or an unknown prior.
        NotConverged: if a solver does not converge.
    """
    one_of(prior, PRIORS, "prior", UsageError)
    model = information.dynamics.model
    if not model.torque_rows.has_bodies:
        raise UsageError("the model has only drives (kind 'drive'), no bodies to make consistent")
    allowed = bound(information.b)
    priors = find_prior_bodies(information.chain, model)
    choices = [(references, make_problem(information, references)) for references in priors]

    # Distance of the nearest consistent robot: of the first and the last choice, whose coordinates differ most.
    nearest_distance = np.inf
    nearest_problem = choices[0][1]
    for _, problem in choices[:: max(len(choices) - 1, 1)]:
        distance = information.distance(nearest(problem))
        if distance < nearest_distance:
            nearest_distance, nearest_problem = distance, problem
    blamed = ()
    if nearest_distance > allowed:
        blamed = blame(nearest_problem, information)

    # The weight of the prior by evidence, reduced where it alone leaves the estimate's covariance.
    doubt = max(1.0, nearest_distance / np.sqrt(information.b))
    candidates = [
        candidate for references, problem in choices for candidate in _candidates(references, problem, weight, doubt)
    ]
    best = max(candidates, key=lambda candidate: candidate.evidence)
    gamma = best.gamma
    problem = best.problem
    values = best.values
    euclidean = prior == "euclidean"
    if euclidean:
        values = nearest(problem, pull=gamma)
    if weight is None:
        while nearest_distance <= allowed < information.distance(values) and gamma > MIN_WEIGHT:
            gamma /= 2.0
            values = nearest(problem, pull=gamma) if euclidean else solve(problem, gamma)
    curvature_at = _reference(problem) if euclidean else values
    margins = [pseudo_inertia.margin(body) for body in _bodies(problem, values)]
    dynamics = Dynamics(model, values)
    covariance = _covariance(problem, gamma, curvature_at)
    notes = (*best.references.notes, *_notes(model, problem, values))
    distance = information.distance(values)
    reached_margins = np.array(margins)
    return PossibleBodies(
        dynamics=dynamics,
        covariance=covariance,
        weight=gamma,
        doubt=doubt,
        margins=reached_margins,
        distance=distance,
        nearest=nearest_distance,
        allowed=allowed,
        blamed=blamed,
        source=best.references.source,
        prior=prior,
        notes=notes,
    )


def _candidates(references: PriorBodies, problem: BodyCost, weight: float | None, doubt: float) -> Iterator[_Candidate]:
    """Yield the optimum and evidence for each tested prior weight; the data's sigmas are multiplied by `doubt`.

    Args:
        references: the prior bodies.
        problem: the cost.
        weight: the only weight γ to be used; None: several are tested.
        doubt: factor of the sigmas.
    """
    factor = problem.factor / doubt
    widened = replace(problem, factor=factor)
    weights: Sequence[float] = WEIGHTS[4::3]
    if weight is not None:
        weights = [weight]
    elif references.cad:
        weights = [gamma for gamma in WEIGHTS if gamma >= MIN_CAD_WEIGHT]
    values = None
    for gamma in weights:
        values = solve(widened, gamma, values)
        yield _Candidate(_evidence(widened, gamma, values), gamma, widened, values, references)


def solve(problem: BodyCost, gamma: float, start: np.ndarray | None = None) -> np.ndarray:
    """Return the parameters (p,) with the smallest cost, by Newton's method inside the cone of consistent bodies.

    The search starts from `start`, the optimum for another weight, or from the prior bodies. Far from the optimum, the
    weak barrier of the priors makes Newton's steps short. A search from the prior bodies therefore begins with priors
    as strong as the data and weakens them by factors of ten, as interior-point methods do.

    Args:
        problem: the cost.
        gamma: prior weight γ.
        start: (p,) first parameters; None: the prior bodies.

    Raises:
        NotConverged: with the last parameters.
    """
    if start is not None:
        return _descend(problem, gamma, start)
    values = _reference(problem)
    residual = problem.factor[:, :-1] @ values - problem.factor[:, -1]
    first_power = int(np.ceil(np.log10(1.0 + float(residual @ residual))))
    for power in range(max(first_power, 0), -1, -1):
        values = _descend(replace(problem, lift=10.0**power), gamma, values)
    return values


def _reference(problem: BodyCost) -> np.ndarray:
    """Return the standard parameters (p,) at which all priors are smallest.

    Args:
        problem: the cost, with prior bodies and drive terms.
    """
    free_terms = np.where(problem.positive, problem.sizes, 0.0)
    terms = np.where(problem.sizes > 0.0, free_terms, problem.fixed)
    return np.concatenate([pseudo_inertia.to_standard(problem.references).ravel(), terms])


def _descend(problem: BodyCost, gamma: float, values: np.ndarray) -> np.ndarray:
    """Return the optimum (p,) by Newton's method from `values`, with steps halved until the cost decreases (Armijo).

    Args:
        problem: the cost.
        gamma: prior weight γ.
        values: (p,) physically consistent parameters to start from.
    """
    free = problem.free
    settled = SETTLED if problem.lift == 1.0 else 0.1 * problem.lift
    current_cost = cost(problem, gamma, values)
    for _ in range(MAX_STEPS):
        slope, curvature = derivatives(problem, gamma, values)
        step = np.zeros_like(values)
        free_curvature = curvature[np.ix_(free, free)]
        step[free] = -_solved(free_curvature, slope[free])
        decrement = -float(slope @ step)
        if decrement < settled:
            return values + step
        size = 1.0
        step_cost = cost(problem, gamma, values + size * step)
        while step_cost > current_cost - 1e-4 * size * decrement:
            size /= 2.0
            if size < MIN_STEP:
                return values
            step_cost = cost(problem, gamma, values + size * step)
        values = values + size * step
        current_cost = step_cost
    raise NotConverged(f"the consistent parameters have not converged after {MAX_STEPS} Newton steps", values)


def cost(problem: BodyCost, gamma: float, values: np.ndarray) -> float:
    """Return the cost J(χ), data term plus prior, by the module's docstring; infinite for inconsistent parameters χ.

    Args:
        problem: the cost.
        gamma: prior weight γ.
        values: (p,) standard parameters χ.
    """
    residual = problem.factor[:, :-1] @ values - problem.factor[:, -1]
    pseudo = pseudo_inertia.from_standard(_bodies(problem, values))
    definite = np.linalg.eigvalsh(_scaled(problem, pseudo))[:, 0] > 0.0
    terms = values[10 * problem.bodies :]
    estimated = problem.sizes > 0.0
    positive = estimated & problem.positive
    ratio = terms[positive] / problem.sizes[positive]
    if not definite.all() or not (ratio > 0.0).all():
        return np.inf
    bodies = 0.0
    for weight, body, reference in zip(problem.weights(gamma), pseudo, problem.references):
        bodies = bodies + weight * pseudo_inertia.divergence(body, reference)
    drives = problem.lift * DRIVE * float(np.sum(ratio - np.log(ratio) - 1.0))
    unbounded = estimated & ~problem.positive
    relative = terms[unbounded] / problem.sizes[unbounded]
    unbounded_terms = float(np.sum(relative**2))
    return 0.5 * (float(residual @ residual) + bodies + drives + unbounded_terms)


def derivatives(problem: BodyCost, gamma: float, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return gradient (p,) and Hessian (p, p) of the cost at parameters `values` (p,).

    Args:
        problem: the cost.
        gamma: prior weight γ.
        values: (p,) standard parameters χ.
    """
    columns = problem.factor[:, :-1]
    target = problem.factor[:, -1]
    slope = columns.T @ (columns @ values - target)
    curvature = columns.T @ columns
    pseudo = pseudo_inertia.from_standard(_bodies(problem, values))
    basis = pseudo_inertia.BASIS
    for i, weight in enumerate(problem.weights(gamma)):
        part = slice(10 * i, 10 * i + 10)
        inverse = np.linalg.inv(pseudo[i])
        reference_inverse = np.linalg.inv(problem.references[i])
        turned = inverse @ basis
        slope[part] += 0.5 * weight * np.einsum("ij,kji->k", reference_inverse - inverse, basis)
        curvature[part, part] += 0.5 * weight * np.einsum("kij,lji->kl", turned, turned)
    half = 0.5 * problem.lift * DRIVE
    for term in np.flatnonzero(problem.sizes > 0.0):
        k = 10 * problem.bodies + term
        x = values[k]
        size = problem.sizes[term]
        if problem.positive[term]:
            slope[k] += half * (1.0 / size - 1.0 / x)
            curvature[k, k] += half / x**2
        else:
            slope[k] += x / size**2
            curvature[k, k] += 1.0 / size**2
    return slope, curvature


def _evidence(problem: BodyCost, gamma: float, values: np.ndarray) -> float:
    """Return the evidence log p(data | γ) by Laplace's approximation at the optimum `values`, up to a constant.

    Args:
        problem: the cost.
        gamma: prior weight γ.
        values: (p,) optimum for this weight.
    """
    free = problem.free
    _, curvature = derivatives(problem, gamma, values)
    curvature = curvature[np.ix_(free, free)]
    unit = np.sqrt(np.diag(curvature))
    root = np.linalg.cholesky(curvature / np.outer(unit, unit))
    log_diagonal = np.log(np.diag(root)).sum()
    half_log_det = float(log_diagonal + np.log(unit).sum())
    nu = gamma + 5.0
    log_gamma = float(multigammaln(nu / 2.0, 4))
    norm = 2.0 * nu * np.log(gamma) - 2.0 * gamma - 2.0 * nu * np.log(2.0) - log_gamma
    # The scale of P⁰ counts where references compete.
    scale = 2.5 * float(np.linalg.slogdet(problem.references)[1].sum())
    drawn_norm = norm * float(problem.drawn.sum())
    return -cost(problem, gamma, values) - half_log_det + drawn_norm - scale


def _covariance(problem: BodyCost, gamma: float, values: np.ndarray) -> np.ndarray:
    """Return the inverse of the cost's Hessian (p, p) at `values`; zero for fixed parameters.

    Args:
        problem: the cost.
        gamma: prior weight γ.
        values: (p,) optimum for this weight.
    """
    free = np.ix_(problem.free, problem.free)
    _, curvature = derivatives(problem, gamma, values)
    covariance = np.zeros((len(values), len(values)))
    identity = np.eye(int(problem.free.sum()))
    covariance[free] = _solved(curvature[free], identity)
    return 0.5 * (covariance + covariance.T)


def _solved(curvature: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return x of `curvature` x = `target` by Cholesky, after scaling `curvature` to a unit diagonal.

    A matrix that is indefinite by rounding gets the smallest ridge of `RIDGES` with which Cholesky succeeds; the
    resulting step is still a direction of descent.

    Raises:
        NotConverged: if no ridge suffices.
    """
    unit = np.sqrt(np.diag(curvature))
    normalised = curvature / np.outer(unit, unit)
    for ridge in RIDGES:
        with suppress(np.linalg.LinAlgError):
            root = scipy.linalg.cho_factor(normalised + ridge * np.eye(len(unit)))
            break
    else:
        raise NotConverged(
            "the consistent parameters cannot be distinguished to within rounding: record a richer motion"
        )
    scale = unit if target.ndim == 1 else unit[:, None]
    return scipy.linalg.cho_solve(root, target / scale) / scale


def _bodies(problem: BodyCost, values: np.ndarray) -> np.ndarray:
    """Return the standard parameters (B, 10) of the bodies among all parameters (p,).

    Args:
        problem: the cost, which gives the number B of bodies.
        values: (p,) all parameters.
    """
    return values[: 10 * problem.bodies].reshape(-1, 10)


def _scaled(problem: BodyCost, pseudo: np.ndarray) -> np.ndarray:
    """Return scaled pseudo-inertias L⁻¹ P L⁻ᵀ (B, 4, 4), P⁰ = L Lᵀ, which are of order one and definite if P is.

    Args:
        problem: the cost, with prior pseudo-inertias P⁰.
        pseudo: (B, 4, 4) pseudo-inertias P.
    """
    inverse = np.linalg.inv(np.linalg.cholesky(problem.references))
    return inverse @ pseudo @ inverse.transpose(0, 2, 1)


def _notes(model: IdentificationModel, problem: BodyCost, values: np.ndarray) -> Sequence[str]:
    """Return remarks on bodies thinner than a millimetre.

    Args:
        model: the model, which provides the bodies' names.
        problem: the cost.
        values: (p,) parameters.
    """
    notes = []
    for label, body in zip(model.bodies.labels, _bodies(problem, values)):
        if pseudo_inertia.margin(body) < THIN_MARGIN:
            notes.append(f"body {label} is thinner than a millimetre: hardly realistic")
    return notes


@dataclass(frozen=True)
class Contradiction:
    """Distance of an estimate from the nearest physically consistent robot.

    Attributes:
        distance: Mahalanobis distance in standard deviations; only approximate up to `MAX_TIMES` times `allowed`.
        allowed: 95 % limit of the distance for a correct model.
        unexplained: share of the weighted torques that the nearest consistent robot leaves unexplained in addition to
            the estimate [%].
    """

    distance: float
    allowed: float
    unexplained: float


def contradiction(identification: Identification, chain: Chain) -> Contradiction | None:
    """Return the distance of an estimate from the nearest physically consistent robot.

    The result is None for a model without bodies, or if no solver converged.

    Args:
        identification: the estimate.
        chain: the robot of the identification.
    """
    model = identification.dynamics.model
    if not isinstance(model, IdentificationModel) or not model.torque_rows.has_bodies:
        return None
    information = of(identification, chain)
    allowed = bound(information.b)
    problems = [make_problem(information, references) for references in find_prior_bodies(chain, model)]
    try:
        distance = information.distance(solve(problems[-1], WEAK_WEIGHT))
    except (NotConverged, ValueError):
        # The latter where curvatures overflow.
        distance = np.inf
    if distance > MAX_TIMES * allowed:
        for problem in problems[: max(len(problems) - 1, 1)]:
            with suppress(NotConverged):
                distance = min(distance, information.distance(nearest(problem)))
    if not np.isfinite(distance):
        return None
    torque = float(np.linalg.norm(information.factor[:, -1]))
    unexplained = 100.0 * float(distance) / torque
    return Contradiction(float(distance), allowed, unexplained)

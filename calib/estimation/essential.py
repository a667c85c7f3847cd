"""Elimination of base parameters down to essential ones: drop parameters that the data do not identify, one by one."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from scipy.special import fdtrc

from calib.errors import Unidentifiable, require
from calib.estimation.estimate import Estimate
from calib.estimation.linear import LinearFit, leverage, settled_std, wls
from calib.estimation.triangles import Triangles, combine, solve_triangle
from calib.records import Number


class Rule(Enum):
    """Criterion that ends the elimination.

    RSD rests on a ratio: with one parameter known to 0.01 % it drops others known to 1 %. F keeps every significant
    parameter, however small its effect. BOTH drops only parameters that both criteria would drop.
    """

    RSD = "rsd"
    F = "f"
    BOTH = "both"


@dataclass(frozen=True)
class EliminationStep:
    """One step of the elimination: a dropped parameter.

    Attributes:
        name: of the parameter.
        rsd: its relative standard deviation before it went [%]; infinite for one at zero.
        ratio: largest over smallest RSD of all parameters before it went.
        f, p: statistic (x / σ)² of leaving it out, and the probability of a larger one if it is truly zero.
        p_total: of leaving out all that went so far, against the base model.
        residual_std: of the weighted residuals after it went.
        listed: it went because it was on the drop list.
    """

    name: str
    rsd: Number
    ratio: Number
    f: Number
    p: Number
    p_total: Number
    residual_std: float
    listed: bool


@dataclass(frozen=True, eq=False)
class Elimination:
    """Result of the elimination from base to essential parameters.

    Attributes:
        base, essential: the fit before and after, with the same weights for the rows.
        kept: (b_e,) indices of the essential columns.
        steps: dropped parameters, in order.
        refused: the rejected step that ended the elimination; None if all candidates were dropped.
    """

    base: LinearFit
    essential: LinearFit
    kept: np.ndarray
    steps: tuple[EliminationStep, ...]
    refused: EliminationStep | None


def eliminate(
    data: Triangles,
    rule: Rule = Rule.BOTH,
    *,
    ratio: float = 20.0,
    level: float = 0.05,
    keep: Sequence[str] = (),
    drop: Sequence[str] = (),
    std: np.ndarray | None = None,
    inflation: np.ndarray | None = None,
) -> Elimination:
    """Return the elimination: drop the parameter with the largest RSD and re-estimate, until the rule stops it.

    RSD rule: stop when max RSD / min RSD < r_σ (Kolyubin et al. 2019; Jubien, Gautier & Janot 2014: r_σ in 10 … 30).
    F rule: stop when leaving out the next one is refuted, by F = x² / σ² ~ F(1, r - b_e), or when all left out together
    are, by F = [(RSS_ess - RSS_base) / (b - b_e)] / [RSS_base / (r - b)]; both computed as Wald statistics from the
    covariance, which is the same number and respects `inflation`. Testing both is our choice: the total alone lets one
    strong parameter hide among many that are zero.

    Args:
        data: triangles of the base columns.
        rule: see `Rule`.
        ratio: r_σ.
        level: probability of keeping a parameter that is zero, per step.
        keep: names of parameters that are never dropped.
        drop: names of parameters dropped first, whatever the rule.
        std: (g,) of the groups; None: converged on the base model, then kept.
        inflation: (g,) see `linear`; without it too many parameters are kept for autocorrelated residuals.
    """
    _check_lists(data.names, keep, drop)
    sigma = settled_std(data) if std is None else np.asarray(std, dtype=float)
    base = wls(data, sigma, inflation)
    current, kept, gone, steps = _Left.of(data, base, sigma, inflation), list(range(data.parameters)), [], []
    step = refused = None
    while len(kept) > 1 and (worst := _next(current.estimate, keep, drop)) is not None:
        smaller = current.without(worst)
        listed = current.estimate.names[worst] in drop
        step = _step(base.estimate, current.estimate, smaller.estimate, worst, [*gone, kept[worst]], listed)
        if not step.listed and _refused(step, rule, ratio, level):
            refused = step
            break
        gone.append(kept.pop(worst))
        steps.append(step)
        current = smaller
    essential = wls(data.select(np.array(kept)), sigma, inflation) if gone else base
    return Elimination(base, essential, np.array(kept), tuple(steps), refused)


@dataclass(frozen=True, eq=False)
class _Left:
    """Weighted least squares of the columns that are left of a problem.

    Attributes:
        data, std, inflation: the problem's triangles, and its groups' weights (g,).
        kept: (k,) indices of the columns.
        inverse: (k, k) (Wᵀ R⁻¹ W)⁻¹.
        leverage: (g,) of the groups.
        estimate: of the columns.
    """

    data: Triangles
    std: np.ndarray
    inflation: np.ndarray
    kept: np.ndarray
    inverse: np.ndarray
    leverage: np.ndarray
    estimate: Estimate

    @classmethod
    def of(cls, data: Triangles, fit: LinearFit, std: np.ndarray, inflation: np.ndarray | None) -> "_Left":
        """Return the problem with all columns, of which there is a fit."""
        root = solve_triangle(combine(data, std), data.names)[1]
        tau = np.ones(data.groups) if inflation is None else inflation
        kept = np.arange(data.parameters)
        return cls(data, std, tau, kept, root @ root.T, leverage(data, std, root), fit.estimate)

    def without(self, k: int) -> "_Left":
        """Return the fit with one column less: least squares under x_k = 0."""
        own, left = self.estimate, np.delete(np.arange(len(self.kept)), k)
        by = self.inverse[:, k] / self.inverse[k, k]  # how the others give way
        kept, values = self.kept[left], (own.values - by * own.values[k])[left]
        inverse = (self.inverse - np.outer(by, self.inverse[k]))[np.ix_(left, left)]
        cross = np.outer(own.covariance[:, k], by)
        covariance = own.covariance - cross - cross.T + own.covariance[k, k] * np.outer(by, by)
        seen = self.data.factors[:, :, self.kept] @ by
        taken = self.leverage - np.sum(seen**2, axis=1) / self.std**2 * self.inverse[k, k]
        whole = np.zeros(self.data.parameters)
        whole[kept] = values
        rows = self.data.rows - self.inflation * taken
        residual_std = float(np.sqrt(np.sum(self.data.residual_squares(whole) / self.std**2) / rows.sum()))
        names, units = (tuple(np.delete(x, k).tolist()) for x in (own.names, own.units))
        dof = int(np.round(np.sum(rows / self.inflation), 6))
        estimate = Estimate(names, units, values, covariance[np.ix_(left, left)], residual_std, dof)
        return replace(self, kept=kept, inverse=inverse, leverage=taken, estimate=estimate)


def nested_test(base: Estimate, gone: Sequence[int]) -> tuple[float, float]:
    """Return F and its p-value for the hypothesis that the parameters with these indices are all zero.

    Equal to the F-test of the two residual sums; F uses the residual variance of the base fit.
    """
    x = base.values[list(gone)]
    covariance = base.covariance[np.ix_(gone, gone)] * base.residual_std**2
    scale = np.sqrt(np.diag(covariance))
    y = x / scale
    f = float(y @ np.linalg.solve(covariance / np.outer(scale, scale), y)) / len(x)
    return f, float(fdtrc(len(x), base.dof, f))


def _step(
    base: Estimate, current: Estimate, smaller: Estimate, worst: int, gone: list[int], listed: bool
) -> EliminationStep:
    rsd = current.rsd
    f, p = nested_test(current, [worst])
    spread = float(rsd.max() / rsd.min()) if rsd.min() > 0.0 else np.inf
    return EliminationStep(
        current.names[worst], float(rsd[worst]), spread, f, p, nested_test(base, gone)[1], smaller.residual_std, listed,
    )  # fmt: skip


def _next(current: Estimate, keep: Sequence[str], drop: Sequence[str]) -> int | None:
    """Return the index of the next parameter to drop: listed ones first, then the largest RSD."""
    names, rsd = current.names, current.rsd
    listed = [k for k, name in enumerate(names) if name in drop]
    candidates = listed or [k for k, name in enumerate(names) if name not in keep]
    return max(candidates, key=lambda k: rsd[k]) if candidates else None


def _refused(step: EliminationStep, rule: Rule, ratio: float, level: float) -> bool:
    even = step.ratio < ratio
    needed = step.p < level or step.p_total < level
    return {Rule.RSD: even, Rule.F: needed, Rule.BOTH: even or needed}[rule]


def _check_lists(names: Sequence[str], keep: Sequence[str], drop: Sequence[str]) -> None:
    unknown = [name for name in (*keep, *drop) if name not in names]
    require(not unknown, f"keep or drop: unknown {', '.join(unknown)}; the parameters are {', '.join(names)}")
    both = [name for name in keep if name in drop]
    require(not both, f"{', '.join(both)} cannot be both kept and dropped")
    require(len(set(drop)) < len(names), "all parameters are dropped: no model remains", Unidentifiable, drop)

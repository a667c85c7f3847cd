"""Elimination of base parameters down to essential ones: drop parameters that the data do not identify, one by one."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.special import fdtrc

from calib.errors import Unidentifiable, require
from calib.estimation.linear import LinearFit, settled_std, wls
from calib.estimation.triangles import Triangles
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
    base = current = wls(data, sigma, inflation)
    kept, gone, steps = list(range(data.parameters)), [], []
    while True:
        worst = _next(current, keep, drop)
        if worst is None or len(kept) == 1:
            return Elimination(base, current, np.array(kept), tuple(steps), None)
        smaller = wls(data.select(np.delete(kept, worst)), sigma, inflation)
        step = _step(base, current, smaller, worst, [*gone, kept[worst]], current.estimate.names[worst] in drop)
        if not step.listed and _refused(step, rule, ratio, level):
            return Elimination(base, current, np.array(kept), tuple(steps), step)
        gone.append(kept.pop(worst))
        steps.append(step)
        current = smaller


def nested_test(base: LinearFit, gone: Sequence[int]) -> tuple[float, float]:
    """Return F and its p-value for the hypothesis that the parameters with these indices are all zero.

    Equal to the F-test of the two residual sums; F uses the residual variance of the base fit.
    """
    x = base.estimate.values[list(gone)]
    covariance = base.estimate.covariance[np.ix_(gone, gone)] * base.estimate.residual_std**2
    scale = np.sqrt(np.diag(covariance))
    y = x / scale
    f = float(y @ np.linalg.solve(covariance / np.outer(scale, scale), y)) / len(x)
    return f, float(fdtrc(len(x), base.estimate.dof, f))


def _step(
    base: LinearFit, current: LinearFit, smaller: LinearFit, worst: int, gone: list[int], listed: bool
) -> EliminationStep:
    rsd = current.estimate.rsd
    f, p = nested_test(current, [worst])
    spread = float(rsd.max() / rsd.min()) if rsd.min() > 0.0 else np.inf
    return EliminationStep(
        current.estimate.names[worst],
        float(rsd[worst]),
        spread,
        f,
        p,
        nested_test(base, gone)[1],
        smaller.estimate.residual_std,
        listed,
    )


def _next(current: LinearFit, keep: Sequence[str], drop: Sequence[str]) -> int | None:
    """Return the index of the next parameter to drop: listed ones first, then the largest RSD."""
    names, rsd = current.estimate.names, current.estimate.rsd
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

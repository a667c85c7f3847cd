"""Elimination from base to essential parameters: parameters that the data do not identify are dropped one by one."""

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

    RSD compares relative standard deviations: if one parameter is known to 0.01 %, RSD drops others known to 1 %. F
    keeps every statistically significant parameter, however small its effect. BOTH drops only parameters that both
    criteria would drop.
    """

    RSD = "rsd"
    F = "f"
    BOTH = "both"


@dataclass(frozen=True)
class EliminationStep:
    """One step of the elimination, in which one parameter is dropped.

    Attributes:
        name: name of the dropped parameter.
        rsd: relative standard deviation of this parameter before it was dropped [%]; infinite for a value of zero.
        ratio: largest over smallest RSD of all parameters before this step.
        f, p: statistic F = (x / σ)² of this parameter, and the probability of a larger F if its true value is zero.
        p_total: probability of a larger F in the joint test that all parameters dropped so far are zero in the base
            model.
        residual_std: standard deviation of the weighted residuals after this step.
        listed: whether the caller's list `drop` contains this parameter.
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
        base, essential: the fits before and after the elimination, both with the same row weights.
        kept: (b_e,) indices of the essential columns.
        steps: the steps that were made, in order.
        refused: the step that the rule rejected, which ended the elimination; None if all candidates were dropped.
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
    """Return the elimination: drop the parameter with the largest RSD and re-estimate, until the rule stops.

    The RSD rule stops when max RSD / min RSD < r_σ (Kolyubin et al. 2019; Jubien, Gautier & Janot 2014: r_σ in 10 …
    30). The F rule stops when one of two hypotheses is rejected: that the next parameter is zero, by F = x² / σ² ~ F(1,
    r - b_e), or that all dropped parameters are zero, by F = [(RSS_ess - RSS_base) / (b - b_e)] / [RSS_base / (r - b)].
    Both are computed as Wald statistics from the covariance, which gives equal numbers without inflation and accounts
    for `inflation`. Making both tests is our choice: in the joint test alone, one significant parameter may be masked
    by many that are zero.

    Args:
        data: R factors of the columns of the b base parameters, in g groups of rows.
        rule: criterion that ends the elimination.
        ratio: r_σ, the largest over the smallest RSD (relative standard deviation) at which the RSD rule stops.
        level: significance level of each test, i.e. the probability of keeping a parameter that is zero.
        keep: names of parameters that are never dropped.
        drop: names of parameters that are dropped first, whatever the rule.
        std: (g,) noise standard deviations of the groups of rows, in units of y; None: `settled_std` of the base model.
            They remain constant during the elimination.
        inflation: (g,) variance inflation of autocorrelated residuals (module `linear`); without it too many parameters
            are kept.

    Raises:
        CalibError: for an unknown name in `keep` or `drop`, or a name in both.
        Unidentifiable: if `drop` names all parameters.
    """
    _check_lists(data.names, keep, drop)
    if std is None:
        std = settled_std(data)
    sigma = np.asarray(std, dtype=float)
    base = wls(data, sigma, inflation)
    current = base
    columns = list(range(data.parameters))
    dropped: list[int] = []
    steps: list[EliminationStep] = []
    refused = None
    while len(columns) > 1:
        worst = _next(current, keep, drop)
        if worst is None:
            break
        name = current.estimate.names[worst]
        smaller = wls(data.select(np.delete(columns, worst)), sigma, inflation)
        step = _step(base, current, smaller, worst, [*dropped, columns[worst]], name in drop)
        if not step.listed and _refused(step, rule, ratio, level):
            refused = step
            break
        dropped.append(columns.pop(worst))
        steps.append(step)
        current = smaller
    return Elimination(base, current, np.array(columns), tuple(steps), refused)


def nested_test(base: LinearFit, dropped: Sequence[int]) -> tuple[float, float]:
    """Return the F statistic and its p-value for the hypothesis that the parameters at indices `dropped` are zero.

    F is the Wald statistic with the residual variance of the base fit. It equals the F statistic of the two residual
    sums of squares (with and without these parameters).

    Args:
        base: fit of all base parameters.
        dropped: indices of the parameters that are tested jointly.
    """
    values = base.estimate.values[list(dropped)]
    covariance = base.estimate.covariance[np.ix_(dropped, dropped)] * base.estimate.residual_std**2
    scale = np.sqrt(np.diag(covariance))
    scaled = values / scale
    correlation = covariance / np.outer(scale, scale)
    f = float(scaled @ np.linalg.solve(correlation, scaled)) / len(values)
    return f, float(fdtrc(len(values), base.estimate.dof, f))


def _step(
    base: LinearFit, current: LinearFit, smaller: LinearFit, worst: int, dropped: list[int], listed: bool
) -> EliminationStep:
    """Return the elimination step from the fit `current` to the fit `smaller`, which has one parameter less.

    Args:
        base: fit of all base parameters.
        current: fit before the step.
        smaller: fit after the step.
        worst: index of the dropped parameter in `current`.
        dropped: indices in `base` of all parameters dropped so far, including this one.
        listed: whether the caller's list of parameters to drop contains this parameter.
    """
    rsd = current.estimate.rsd
    ratio = np.inf
    if rsd.min() > 0.0:
        ratio = float(rsd.max() / rsd.min())
    f, p = nested_test(current, [worst])
    _, p_total = nested_test(base, dropped)
    return EliminationStep(
        name=current.estimate.names[worst],
        rsd=float(rsd[worst]),
        ratio=ratio,
        f=f,
        p=p,
        p_total=p_total,
        residual_std=smaller.estimate.residual_std,
        listed=listed,
    )


def _next(current: LinearFit, keep: Sequence[str], drop: Sequence[str]) -> int | None:
    """Return the index of the next parameter to drop, None if no candidate remains.

    Args:
        current: fit of the parameters that remain.
        keep: names of parameters that are never dropped.
        drop: names of parameters that are dropped first; of those not in `keep`, and of several in `drop`, the one with
            the largest RSD (relative standard deviation) is next.
    """
    names = current.estimate.names
    rsd = current.estimate.rsd
    candidates = [k for k, name in enumerate(names) if name in drop]
    if not candidates:
        candidates = [k for k, name in enumerate(names) if name not in keep]
    if not candidates:
        return None
    return max(candidates, key=lambda k: rsd[k])


def _refused(step: EliminationStep, rule: Rule, ratio: float, level: float) -> bool:
    """Return whether the rule rejects this step and so ends the elimination.

    Args:
        step: the step to judge.
        rule: criterion that ends the elimination.
        ratio: largest over smallest RSD (relative standard deviation) below which the RSD rule rejects the step.
        level: significance level of both F tests; a smaller p-value rejects the step.
    """
    even = step.ratio < ratio
    significant = step.p < level or step.p_total < level
    if rule is Rule.RSD:
        return even
    if rule is Rule.F:
        return significant
    return even or significant


def _check_lists(names: Sequence[str], keep: Sequence[str], drop: Sequence[str]) -> None:
    unknown = [name for name in (*keep, *drop) if name not in names]
    require(not unknown, f"keep or drop: unknown {', '.join(unknown)}; the parameters are {', '.join(names)}")
    both = [name for name in keep if name in drop]
    require(not both, f"{', '.join(both)} cannot be both kept and dropped: remove them from keep or drop")
    require(
        len(set(drop)) < len(names),
        "all parameters are dropped, so that no model remains: drop fewer",
        Unidentifiable,
        drop,
    )

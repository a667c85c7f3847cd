"""Summaries of trials: figures of merit of each method on each condition, and which methods differ significantly.

Failures count: a trial without an estimate has an infinite error, in medians and in comparisons. Methods are compared
in pairs on equal data sets by the sign test (Conover 1999, section 3.4), since the errors of two methods on one data
set are correlated and have long-tailed distributions. Of several start values, the first is used.

The rule of recommendation considers methods that give an estimate in at least `RELIABLE` of the trials. A method is as
good as the best if its torque error on the held-out motion is not significantly different from the best one's
(`LEVEL`), or is larger by no more than `SLACK` in the median data set. A method with fewer than `MIN_DATA_SETS` runs is
listed, but not compared. Of the methods that are as good as the best, those that need at most `ALIKE` times the
processor time of the cheapest count as cheap. The first cheap one in rank is recommended.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.stats import binomtest

from calib.apps.studies.conditions import Condition, Study
from calib.apps.studies.trial import TrialRow

# The rule's shares and factor (our choices), see above.
RELIABLE = 0.95
LEVEL = 0.05
SLACK = 0.05
ALIKE = 2.0
# Common data sets below which the sign test cannot tell at 5 %.
MIN_DATA_SETS = 6
# Error of a trial without an estimate.
FAILED_ERROR = float("inf")
FIGURES = (
    "torque_error",
    "torque_worst",
    "beta_error",
    "beta_distance",
    "beta_sigma",
    "coverage",
    "survey_tau",
    "survey_q",
    "iterations",
    "simulations",
    "cpu",
    "seconds",
)
# Of these a trial without an estimate has an infinite one.
ERROR_FIGURES = ("torque_error", "torque_worst", "beta_error", "beta_distance")


class Quartiles(NamedTuple):
    """Median and quartiles of a figure of merit over runs; a failed run counts as an infinite error."""

    median: float
    lower: float
    upper: float


@dataclass(frozen=True)
class MethodSummary:
    """Summary of one method on one condition.

    Attributes:
        method: name of the method.
        trials: number of the method's rows.
        failures: status to the number of trials that ended with it and without an estimate.
        examples: status to data set and message of the first such trial.
        figures: name of a figure of merit (`FIGURES`) to its median and quartiles.
        rank: rank by the median torque error, from 1.
        as_good: whether the method is reliable, and not significantly worse than the best or within `SLACK` of it.
        chosen: whether the method is the recommended one.
        p: p value of the sign test against the best method; NaN for the best method itself.
    """

    method: str
    trials: int
    failures: Mapping[str, int]
    examples: Mapping[str, str]
    figures: Mapping[str, Quartiles]
    rank: int = 0
    as_good: bool = False
    chosen: bool = False
    p: float = float("nan")

    @property
    def enough(self) -> bool:
        """Whether there are enough runs to compare the method with others."""
        return self.trials >= MIN_DATA_SETS

    @property
    def estimates(self) -> bool:
        """Whether the median torque error is finite: at least half of the trials gave an estimate."""
        return bool(np.isfinite(self.figures["torque_error"].median))

    @property
    def reliable(self) -> bool:
        return sum(self.failures.values()) <= (1.0 - RELIABLE) * self.trials


@dataclass(frozen=True)
class ConditionSummary:
    """Summaries of all methods on one condition, in order of rank (best first)."""

    condition: Condition
    methods: tuple[MethodSummary, ...]

    @property
    def chosen(self) -> MethodSummary | None:
        """The recommended method; None if there is none."""
        for method in self.methods:
            if method.chosen:
                return method
        return None

    @property
    def best(self) -> MethodSummary | None:
        """The first method in rank with enough runs and a finite median error; None if there is none."""
        for method in self.methods:
            if method.enough and method.estimates:
                return method
        return None

    @property
    def why_none(self) -> str:
        """Reason why no method is recommended; empty if one is, or if there are no rows."""
        if self.chosen or not self.methods:
            return ""
        if not any(method.enough for method in self.methods):
            return f"fewer than {MIN_DATA_SETS} runs of each method are too few: --runs {MIN_DATA_SETS} or more"
        return f"no method of {MIN_DATA_SETS} runs or more gives an estimate in {RELIABLE:.0%} of its trials"


def summarise(study: Study, rows: Iterable[TrialRow]) -> list[ConditionSummary]:
    """Return the summary of each condition of a study, over all methods that have rows.

    Rows of other conditions, and rows of an earlier version of a method, are ignored. Rows of methods that the study no
    longer contains are included.
    """
    by_digest: dict[str, dict[str, list[TrialRow]]] = {}
    for row in rows:
        if row.current:
            by_digest.setdefault(row.digest, {}).setdefault(row.method, []).append(row)
    summaries = []
    for condition, runs in zip(study.conditions, study.runs):
        by_method = by_digest.get(condition.digest, {})
        # Methods of the study first, in its order; each once.
        names = dict.fromkeys((*runs, *by_method))
        stored = {name: by_method[name] for name in names if name in by_method}
        summaries.append(_ranked(condition, stored))
    return summaries


def _ranked(condition: Condition, rows: Mapping[str, Sequence[TrialRow]]) -> ConditionSummary:
    """Return the summary of a condition, with ranked methods.

    Args:
        condition: the condition.
        rows: name of a method to its rows on this condition.
    """
    if not rows:
        return ConditionSummary(condition, ())
    summaries = []
    errors: dict[str, dict[int, float]] = {}
    for name, method_rows in rows.items():
        summaries.append(_summary(name, method_rows))
        errors[name] = {}
        for row in method_rows:
            # Of several guesses the first is compared.
            if row.seed % condition.guesses == 0:
                if row.found:
                    errors[name][row.seed] = row.torque_error
                else:
                    errors[name][row.seed] = FAILED_ERROR
    summaries.sort(key=lambda method: (not method.reliable, method.figures["torque_error"].median))
    best = None
    for method in summaries:
        if method.enough:
            best = method
            break
    ranked = []
    for rank, method in enumerate(summaries, 1):
        if best is None or method is best or not method.enough:
            as_good = method is best and method.reliable and method.estimates
            ranked.append(replace(method, rank=rank, as_good=as_good))
            continue
        p = sign_test(errors[method.method], errors[best.method])
        within_slack = _median_ratio(errors[method.method], errors[best.method]) <= 1.0 + SLACK
        as_good = method.reliable and best.reliable and (within_slack or p > LEVEL)
        ranked.append(replace(method, rank=rank, as_good=as_good, p=p))
    times = [method.figures["cpu"].median for method in ranked if method.as_good]
    cheapest = min(times, default=0.0)
    chosen = None
    for method in ranked:
        # Also true for a time that is NaN.
        cheap = not method.figures["cpu"].median > ALIKE * cheapest
        if method.as_good and cheap:
            chosen = method
            break
    return ConditionSummary(condition, tuple(replace(method, chosen=method is chosen) for method in ranked))


def _pairs(errors: Mapping[int, float], reference: Mapping[int, float]) -> list[tuple[float, float]]:
    """Return pairs of errors of two methods on the data sets that both have.

    Args:
        errors, reference: seed of the data set to error, for the two methods.
    """
    return [(errors[seed], reference[seed]) for seed in errors.keys() & reference.keys()]


def _median_ratio(errors: Mapping[int, float], reference: Mapping[int, float]) -> float:
    """Return the median ratio (`errors` / `reference`) of two methods' errors on common data sets.

    Infinite without common data sets.

    Args:
        errors, reference: seed of the data set to error, for the two methods.
    """
    ratios = []
    for error, reference_error in _pairs(errors, reference):
        if np.isfinite(reference_error):
            ratios.append(error / max(reference_error, 1e-300))
    if ratios:
        return float(np.median(ratios))
    return float("inf")


def _seed(row: TrialRow) -> int:
    return row.seed


def _summary(name: str, rows: Sequence[TrialRow]) -> MethodSummary:
    failures = Counter(row.status for row in rows if not row.found)
    examples = {}
    for status in failures:
        same_status = [row for row in rows if row.status == status]
        first = min(same_status, key=_seed)
        examples[status] = f"data set {first.seed}: {first.message}"
    figures = {}
    for figure in FIGURES:
        values = [float(getattr(row, figure)) for row in rows if row.found]
        if figure in ERROR_FIGURES:
            values += [FAILED_ERROR] * (len(rows) - len(values))
        figures[figure] = spread(values)
    return MethodSummary(name, len(rows), failures, examples, figures)


def spread(values: Sequence[float]) -> Quartiles:
    """Return median and quartiles of values, ignoring NaN; all three are NaN if no value is left."""
    numbers = np.sort([value for value in values if not math.isnan(value)])
    if len(numbers) == 0:
        return Quartiles(float("nan"), float("nan"), float("nan"))
    with np.errstate(invalid="ignore"):
        lower, upper = np.quantile(numbers, [0.25, 0.75], method="nearest")
    return Quartiles(float(np.median(numbers)), float(lower), float(upper))


def sign_test(errors: Mapping[int, float], reference: Mapping[int, float]) -> float:
    """Return the two-sided p value of the sign test between the errors of two methods.

    Args:
        errors, reference: seed of the data set to error; only seeds in both are compared, and ties are ignored.

    Returns:
        The p value; 1 where fewer than `MIN_DATA_SETS` data sets distinguish the methods.
    """
    larger = smaller = 0
    for error, reference_error in _pairs(errors, reference):
        larger += error > reference_error
        smaller += error < reference_error
    if larger + smaller < MIN_DATA_SETS:
        return 1.0
    return float(binomtest(larger, larger + smaller).pvalue)

"""Summaries of trials: figures of merit of each method on each condition, and which methods differ significantly.

Failures count: a trial without an estimate has an infinite error, in medians and in comparisons. Methods are compared
on the same data sets, pair by pair, by the sign test (Conover 1999, section 3.4), since errors of two methods on one
data set go together and their distributions have long tails; of several guesses the first one is compared.

The rule: of the methods that give an estimate in at least `RELIABLE` of the trials, those whose torque error on unseen
motion cannot be distinguished from the best one's (`LEVEL`), or larger by no more than `SLACK` in the median data set,
are as good as the best; a method of fewer than `MIN_DATA_SETS` runs is listed and takes no part. Of these one is
taken that is cheap: no more than `ALIKE` times the processor time of the cheapest, and of such the first in rank.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.stats import binomtest

from calib.rooms.studies.conditions import Condition, Study
from calib.rooms.studies.trial import TrialRow

RELIABLE, LEVEL, SLACK, ALIKE = 0.95, 0.05, 0.05, 2.0  # our choices
MIN_DATA_SETS = 6  # common data sets below which the sign test cannot tell at 5 %
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


class Quartiles(NamedTuple):
    """Median and quartiles of a figure over runs; a failed run counts as an infinite error."""

    median: float
    lower: float
    upper: float


@dataclass(frozen=True)
class MethodSummary:
    """Summary of one method on one condition.

    Attributes:
        trials: number of its rows; failures: status → how many of them gave no estimate.
        examples: status → data set and message of the first of these.
        figures: name of a figure (`FIGURES`) → its spread.
        rank: by the median torque error, from 1.
        as_good: not distinguishable from the best, or within `SLACK` of it, and reliable.
        chosen: the one of those to take.
        p: of the sign test against the best; NaN for the best itself.
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
        """Whether the runs suffice to distinguish the method from others."""
        return self.trials >= MIN_DATA_SETS

    @property
    def estimates(self) -> bool:
        """Whether the median torque error is finite, so not a failure."""
        return bool(np.isfinite(self.figures["torque_error"].median))

    @property
    def reliable(self) -> bool:
        return sum(self.failures.values()) <= (1.0 - RELIABLE) * self.trials


@dataclass(frozen=True)
class ConditionSummary:
    """Summaries of all methods on one condition, best first."""

    condition: Condition
    methods: tuple[MethodSummary, ...]

    @property
    def chosen(self) -> MethodSummary | None:
        """The recommended method; None if none is reliable."""
        return next((one for one in self.methods if one.chosen), None)

    @property
    def best(self) -> MethodSummary | None:
        """The best method with enough runs and an estimate; None without any."""
        return next((one for one in self.methods if one.enough and one.estimates), None)

    @property
    def why_none(self) -> str:
        """Reason why no method is recommended; "" if one is, or without rows."""
        if self.chosen or not self.methods:
            return ""
        if not any(one.enough for one in self.methods):
            return f"fewer than {MIN_DATA_SETS} runs of each method are too few: --runs {MIN_DATA_SETS} or more"
        return f"no method of {MIN_DATA_SETS} runs or more gives an estimate in {RELIABLE:.0%} of its trials"


def summarise(study: Study, rows: Iterable[TrialRow]) -> list[ConditionSummary]:
    """Return the summary of each condition of a study, over all methods that have rows.

    Rows of other conditions do not count, nor do those of a method that has changed since.

    Methods that the study no longer asks for stay in the summary while their rows are stored.
    """
    kept: dict[str, dict[str, list[TrialRow]]] = {}
    for row in (one for one in rows if one.current):
        kept.setdefault(row.digest, {}).setdefault(row.method, []).append(row)
    result = []
    for condition, runs in zip(study.conditions, study.runs):
        own = kept.get(condition.digest, {})
        result.append(_ranked(condition, {name: own[name] for name in dict.fromkeys((*runs, *own)) if name in own}))
    return result


def _ranked(condition: Condition, rows: Mapping[str, Sequence[TrialRow]]) -> ConditionSummary:
    lost = float("inf")  # error of a trial without an estimate
    first = {name: [row for row in own if not row.seed % condition.guesses] for name, own in rows.items()}
    errors = {name: {row.seed: row.torque_error if row.found else lost for row in own} for name, own in first.items()}
    plain = [_summary(name, own) for name, own in rows.items()]
    plain.sort(key=lambda one: (not one.reliable, one.figures["torque_error"].median))
    if not plain:
        return ConditionSummary(condition, ())
    best = next((one for one in plain if one.enough), None)
    judged = []
    for rank, one in enumerate(plain, 1):
        if best is None or one is best or not one.enough:
            good = one is best and one.reliable and one.estimates
            judged.append(replace(one, rank=rank, as_good=good))
            continue
        p = sign_test(errors[one.method], errors[best.method])
        near = _ratio(errors[one.method], errors[best.method]) <= 1.0 + SLACK
        judged.append(replace(one, rank=rank, as_good=one.reliable and best.reliable and (near or p > LEVEL), p=p))
    good = [one for one in judged if one.as_good]
    least = min((one.figures["cpu"].median for one in good), default=0.0)
    chosen = next((one for one in good if not one.figures["cpu"].median > ALIKE * least), None)
    return ConditionSummary(condition, tuple(replace(one, chosen=one is chosen) for one in judged))


def _ratio(one: Mapping[int, float], other: Mapping[int, float]) -> float:
    """Return the median ratio of two methods' errors on the same data sets; infinite without common data sets."""
    both = [(one[seed], other[seed]) for seed in one.keys() & other.keys() if np.isfinite(other[seed])]
    return float(np.median([a / max(b, 1e-300) for a, b in both])) if both else float("inf")


def _summary(name: str, rows: Sequence[TrialRow]) -> MethodSummary:
    failures = Counter(row.status for row in rows if not row.found)
    first = {row.status: row for row in sorted(rows, key=lambda row: -row.seed)}
    examples = {status: f"data set {first[status].seed}: {first[status].message}" for status in failures}
    figures = {}
    for figure in FIGURES:
        bad = figure in ("torque_error", "torque_worst", "beta_error", "beta_distance")
        values = [float(getattr(row, figure)) for row in rows if row.found]
        values += [float("inf")] * (len(rows) - len(values)) if bad else []
        figures[figure] = spread(values)
    return MethodSummary(name, len(rows), failures, examples, figures)


def spread(values: Sequence[float]) -> Quartiles:
    """Return median and quartiles of the values without NaN; NaN if none remain."""
    found = np.sort([value for value in values if value == value])
    if not len(found):
        return Quartiles(float("nan"), float("nan"), float("nan"))
    with np.errstate(invalid="ignore"):
        lower, upper = (float(x) for x in np.quantile(found, [0.25, 0.75], method="nearest"))
    return Quartiles(float(np.median(found)), lower, upper)


def sign_test(one: Mapping[int, float], other: Mapping[int, float]) -> float:
    """Return the two-sided p value of the sign test between the errors of two methods.

    Args:
        one, other: seed → error; seeds in both count, ties do not.

    Returns:
        1 where fewer than `MIN_DATA_SETS` data sets distinguish them.
    """
    both = [(one[seed], other[seed]) for seed in one.keys() & other.keys()]
    larger, smaller = sum(a > b for a, b in both), sum(a < b for a, b in both)
    if larger + smaller < MIN_DATA_SETS:
        return 1.0
    return float(binomtest(larger, larger + smaller).pvalue)

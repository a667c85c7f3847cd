"""Sigmas that were predicted before anything was moved, beside those that an estimate states afterwards."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SigmaComparison:
    """Sigmas of one kind of quantity, predicted and stated.

    Attributes:
        kind: of quantity, in words.
        unit: of the sigmas; "" where they have several.
        count: how many were both predicted and stated.
        predicted, stated: a typical one of each [unit].
        ratio: stated over predicted, in the median.
        low, high: between which that lies for eight in ten.
    """

    kind: str
    unit: str
    count: int
    predicted: float
    stated: float
    ratio: float
    low: float
    high: float

    @property
    def words(self) -> str:
        """The ratios."""
        return f"{self.ratio:.2g} in the median, {self.low:.2g} to {self.high:.2g} for eight in ten"


def compare_sigmas(
    kind: str,
    unit: str,
    predicted: Mapping[str, float],
    stated: Mapping[str, float],
    typical: Callable[[np.ndarray], float] = lambda sigmas: float(np.median(sigmas)),
) -> SigmaComparison | None:
    """Return how sigmas predicted and stated, by name, compare; None where they have no name in common."""
    common = [name for name in predicted if stated.get(name, 0.0) > 0.0 and predicted[name] > 0.0]
    if not common:
        return None
    before, after = (np.array([one[name] for name in common]) for one in (predicted, stated))
    low, middle, high = (float(x) for x in np.quantile(after / before, [0.1, 0.5, 0.9]))
    return SigmaComparison(kind, unit, len(common), typical(before), typical(after), middle, low, high)

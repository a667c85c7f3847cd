"""What an identification chose besides its parameters, for a later one that carries it on.

Friction terms and the sizes of the prior are chosen from the recordings. From other recordings they are chosen
differently, even if both are of one robot, and the σ of neighbouring parameters change with them. An identification
that continues an earlier one therefore keeps its choice, unless the recordings contradict it: friction terms are added
if the error on held-out time falls by `CLEAR_GAIN`, and sizes and ridges are chosen anew if that is `DECISIVE` times as
probable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from calib.dynamics.drives import DriveTerm
from calib.errors import UsageError, require
from calib.records import Number

CLEAR_GAIN = 0.2
"""Share by which a step of the friction ladder has to lower a joint's rms error on unseen time, beside terms that an
earlier identification chose (our choice)."""
DECISIVE = 100.0
"""Ratio of the evidence of new sizes and of earlier ones from which on these are left (Jeffreys: decisive)."""


@dataclass(frozen=True)
class ModelChoice:
    """The choice as it is stored in ``metrics.json``.

    Attributes:
        terms: names of the additional friction terms, without those that were switched off.
        groups: ridge group of each term.
        ridges: prior standard deviation of each term's parameter; NaN by methods without ridges.
        sizes: sizes of the prior of the base parameters by kind; empty without a prior.
        tempering: weight of the prior for the values, relative to its weight for their covariance.
    """

    terms: tuple[str, ...]
    groups: tuple[int, ...]
    ridges: tuple[Number, ...]
    sizes: Mapping[str, float]
    tempering: float

    @property
    def is_valid(self) -> bool:
        """Whether each term has a group and a ridge, and all sizes are positive; without a prior, ridges are NaN."""
        sizes = (self.tempering, *self.sizes.values())
        positive = all(math.isfinite(size) and size > 0.0 for size in sizes)
        counted = len(self.groups) == len(self.ridges) == len(self.terms)
        return positive and counted and not any(ridge <= 0.0 for ridge in self.ridges)


@dataclass(frozen=True)
class EarlierChoice:
    """The choice of an earlier identification, with its terms.

    Attributes:
        source: name of the earlier identification.
        terms: the additional friction terms.
        choice: groups and ridges of these terms, and the prior.
        contradiction: logarithm of the evidence of other sizes over that of the earlier ones, where these were left; 0
            where they are kept.
        seen: names of the validation recordings from which this choice was made.
    """

    source: str
    terms: tuple[DriveTerm, ...]
    choice: ModelChoice
    contradiction: float = 0.0
    seen: tuple[str, ...] = ()

    @property
    def ridges(self) -> dict[str, float]:
        """Ridge of each term by its name."""
        return dict(zip(self.choice.terms, self.choice.ridges))

    def without_prior(self, contradiction: float) -> EarlierChoice:
        """Return the choice of the terms alone: sizes, ridges and tempering are left.

        Args:
            contradiction: logarithm of the evidence of other sizes over that of the earlier ones.
        """
        ridges = (math.nan,) * len(self.terms)
        choice = replace(self.choice, ridges=ridges, sizes={})
        return replace(self, choice=choice, contradiction=contradiction)

    def check_sizes(self, names: Sequence[str]) -> None:
        """Raise a UsageError if there are sizes of a prior and those of the recordings have other names."""
        require(
            set(self.choice.sizes) in (set(), set(names)),
            f"after {self.source}: it was identified with other drive terms, torque rows or payloads, so that its "
            "prior is of other parameters; identify it again with these options",
            UsageError,
        )

"""Verdicts, and findings that hold them down: what every stage says of its own evidence, in one form."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

LEVELS = ("pass", "marginal", "fail")


@dataclass(frozen=True)
class Verdict:
    """``pass``, ``marginal`` or ``fail``, and why, in one sentence."""

    level: str
    reason: str

    def held_by(self, found: Sequence[Finding]) -> Verdict:
        """Return the verdict, no better than the findings allow; the one that holds it comes first in its reason."""
        worst = max(found, key=lambda one: LEVELS.index(one.allows), default=None)
        if worst is None or worst.allows == "pass" or LEVELS.index(worst.allows) < LEVELS.index(self.level):
            return self
        return Verdict(worst.allows, f"{worst.words}; {self.reason}")


@dataclass(frozen=True)
class Finding:
    """What is odd with measurements.

    Attributes:
        name: in the options' ``accept``.
        level: the best one it allows, where it is not accepted.
        words: a sentence, without its end.
        accepted: whether the options say that it is meant.
    """

    name: str
    level: str
    words: str
    accepted: bool = False

    @property
    def allows(self) -> str:
        """The best level that a verdict beside it may have."""
        return "pass" if self.accepted else self.level

    @property
    def told(self) -> str:
        """The sentence for a user, with what to do where it is meant."""
        if self.accepted:
            return f"{self.words} (accepted by the options)"
        advice = f'; if that is meant, accept = ["{self.name}"] in the options'
        return self.words if self.level == "pass" else f"{self.words}{advice}"


def settled(found: Iterable[Finding], accepted: Collection[str]) -> tuple[Finding, ...]:
    """Return findings, those among `accepted` marked as such, worst first."""
    marked = [replace(one, accepted=one.name in accepted) for one in found]
    return tuple(sorted(marked, key=lambda one: -LEVELS.index(one.level)))

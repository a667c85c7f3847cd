"""Verdicts, and findings that hold them down: what every stage says of its own evidence, in one form."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

PREDICTION_ONLY = "pass (prediction only)"  # of a model that predicts well and cannot be exported
LEVELS = ("pass", PREDICTION_ONLY, "marginal", "fail")


@dataclass(frozen=True)
class Verdict:
    """One of `LEVELS`, and why, in one sentence."""

    level: str
    reason: str

    def __str__(self) -> str:
        return f"verdict {self.level}: {self.reason}"

    def for_prediction(self, why: str) -> Verdict:
        """Return the verdict of a model that cannot be exported, and `why`: a pass is one for prediction only."""
        return Verdict(PREDICTION_ONLY, f"{self.reason}; {why}") if self.level == "pass" else self

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


UNJUDGED = Verdict("", "the session judges, by unseen rows: see verdict.json at its root")


@dataclass(frozen=True)
class Verdicts:
    """What was judged of a robot.

    Attributes:
        stages: ``geometry``, ``dynamics`` → the verdict on what is to be delivered.
        deliverables: of the geometry, ``urdf`` and ``corrections`` → the verdict on it; empty where nobody told apart.
    """

    stages: Mapping[str, Verdict] = field(default_factory=dict)
    deliverables: Mapping[str, Verdict] = field(default_factory=dict)

    @property
    def level(self) -> str:
        """The worst of the stages' verdicts; empty without any."""
        return max((one.level for one in self.stages.values()), key=LEVELS.index, default="")

    def of(self, deliverable: str, dynamics: bool = False) -> Verdicts:
        """Return what was judged of one deliverable, with the dynamics or without."""
        own = {name: one for name, one in self.stages.items() if dynamics or name != "dynamics"}
        if deliverable in self.deliverables:
            own["geometry"] = self.deliverables[deliverable]
        return Verdicts(own)

    def __str__(self) -> str:
        """Say the worst verdict, with the reason of every stage that has it."""
        reasons = (f"{stage}: {one.reason}" for stage, one in self.stages.items() if one.level == self.level)
        return f"verdict {self.level}: {'; '.join(reasons)}{'; do not use' if self.level == 'fail' else ''}"

    def table(self) -> dict[str, Any]:
        """Return the worst verdict, and that of each stage with its reason, as JSON holds them."""
        stages = {stage: {"verdict": one.level, "reason": one.reason} for stage, one in self.stages.items()}
        return {"verdict": self.level, **stages}

    @property
    def remark(self) -> str:
        """What is to be said in a file that does not pass; else empty."""
        return str(self) if self.level in ("marginal", "fail") else ""


def settled(found: Iterable[Finding], accepted: Collection[str]) -> tuple[Finding, ...]:
    """Return findings, those among `accepted` marked as such, worst first."""
    marked = [replace(one, accepted=one.name in accepted) for one in found]
    return tuple(sorted(marked, key=lambda one: -LEVELS.index(one.level)))

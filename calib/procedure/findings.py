"""Findings as sentences, and the verdicts that they give: all that may be said stands in ``findings.toml``.

A stage makes values, ``finding("moved", times=…)`` (`calib.errors.Finding`). The catalogue has for each code

    says     the sentence, number first; ``{rms:.3g mm}`` prints a value [SI] in a unit, ``{names:5}`` five of many,
             ``<, …>`` a part that is left out where one of its values is None or empty
    advice   what to do
    level    note, marginal or fail; or
    limits   value -> level -> above what it holds: the mildest of several values' counts, none of them: nothing is said
    accept   the name in the options' ``accept`` that lets a verdict pass
    means    what `calib explain` says besides
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from string import Formatter
from typing import Any

from calib.errors import Finding, UsageError, suggestion
from calib.units import DEG
from calib.words import listing

RANKS = ("", "note", "marginal", "fail")
UNITS = {"mm": 1e3, "µm": 1e6, "mrad": 1e3, "°": 1 / DEG, "%": 100.0, "ms": 1e3}  # SI -> as printed; others as they are
PREDICTION_ONLY = "pass (prediction only)"  # of a model that predicts well and cannot be exported
LEVELS = ("pass", PREDICTION_ONLY, "marginal", "fail")


@dataclass(frozen=True)
class Verdict:
    """One of `LEVELS`, why, in one sentence, the code of the finding that decided, and what to do.

    It equals the name of its level: ``fit.verdict == "pass"``.
    """

    level: str
    reason: str
    code: str = ""
    advice: str = ""

    def __str__(self) -> str:
        return f"verdict {self.level}: {self.reason}"

    def __eq__(self, other: object) -> bool:
        if isinstance(other, str):
            return self.level == other
        return isinstance(other, Verdict) and (self.level, self.reason) == (other.level, other.reason)

    def __hash__(self) -> int:
        return hash(self.level)

    @classmethod
    def of(cls, figures: str, findings: Iterable[Finding] = ()) -> Verdict:
        """Return what the worst of findings, the first of equals, allows; `figures` come first in its reason."""
        worst = max(findings, key=lambda one: RANKS.index(level_of(one)), default=None)
        if worst is None or level_of(worst) in ("", "note"):
            return cls("pass", figures)
        reason, advice = "; ".join(filter(None, [figures, sentence(worst)])), catalogue()[worst.code].advice
        return cls(level_of(worst), reason, worst.code, _filled(advice, worst.values))

    def for_prediction(self, why: str) -> Verdict:
        """Return the verdict of a model that cannot be exported, and `why`: a pass is one for prediction only."""
        return Verdict(PREDICTION_ONLY, f"{self.reason}; {why}") if self.level == "pass" else self


UNJUDGED = Verdict("", "the session judges, by unseen rows: see verdict.json at its root")


@dataclass(frozen=True)
class Verdicts:
    """What was judged of a robot.

    Attributes:
        stages: ``geometry``, ``dynamics`` → the verdict on what is to be delivered.
        deliverables: of the geometry, ``urdf`` and ``corrections`` → the verdict on it; empty where there is one only.
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


@dataclass(frozen=True)
class Entry:
    """One entry of the catalogue, see the module's text."""

    says: str
    advice: str = ""
    level: str = "note"
    limits: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    accept: str = ""
    means: str = ""


@cache
def catalogue() -> Mapping[str, Entry]:
    """Return the catalogue, code -> entry."""
    text = Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
    return {code: Entry(**entry) for code, entry in tomllib.loads(text).items()}


def level_of(one: Finding) -> str:
    """Return one of `RANKS` for a finding, by the catalogue's rule; an accepted one is a note."""
    entry = catalogue()[one.code]
    reached = [
        max((name for name, limit in steps.items() if one.values[value] > limit), key=RANKS.index, default="")
        for value, steps in entry.limits.items()
    ]
    level = min(reached or [entry.level], key=RANKS.index)
    return "note" if level and one.accepted else level


def limit(code: str, value: str, level: str = "fail") -> float:
    """Return above what a value of a finding has a level."""
    return catalogue()[code].limits[value][level]


def settle(found: Iterable[Finding], accepted: Collection[str] = ()) -> tuple[Finding, ...]:
    """Return the findings that there is something to say of, those accepted by the options marked, worst first."""
    marked = [replace(one, accepted=catalogue()[one.code].accept in accepted) for one in found]
    return tuple(sorted(filter(level_of, marked), key=lambda one: -RANKS.index(level_of(one))))


def sentence(one: Finding) -> str:
    """Return what the catalogue says of a finding, without advice and full stop."""
    return _filled(catalogue()[one.code].says, one.values)


class Warned(str):
    """A line on a finding that keeps a verdict from pass: a command always prints it."""


def lines_of(found: Iterable[Finding]) -> list[str]:
    """Return findings as lines for a user: the sentence, the advice, and how to accept it."""
    lines = [(_line(one, catalogue()[one.code]), level_of(one)) for one in found]
    return [Warned(words) if level in LEVELS else words for words, level in lines]


def _line(one: Finding, entry: Entry) -> str:
    words = [sentence(one), _filled(entry.advice, one.values)]
    if one.accepted:
        return f"{words[0]} (accepted by the options)"
    if entry.accept and level_of(one) != "note":
        words.append(f'if this is intended, add accept = ["{entry.accept}"] to the options')
    return "; ".join(filter(None, words))


@cache
def glossary() -> Mapping[str, str]:
    """Return the field's terms that messages and reports use, term -> what it means."""
    return tomllib.loads(Path(__file__).with_name("glossary.toml").read_text(encoding="utf-8"))


def explain(code: str) -> str:
    """Return what a code of the catalogue means and what to do, or what a term of the glossary means.

    Raises:
        UsageError: for a code or term that there is none of.
    """
    terms = {term.lower(): f"{term}\n  {meaning}" for term, meaning in glossary().items()}
    if (meaning := terms.get(code.lower())) and code not in catalogue():
        return meaning
    if (entry := catalogue().get(code)) is None:
        near = suggestion(code, [*catalogue(), *glossary()])
        raise UsageError(f"no finding or term '{code}'{near}; calib explain lists them")
    rules = [
        f"{level} where {value} > {limit:g}" for value, steps in entry.limits.items() for level, limit in steps.items()
    ]
    accept = f'accept = ["{entry.accept}"] in the options file lets the verdict pass' if entry.accept else ""
    parts = (entry.says, "; ".join(rules) or f"level: {entry.level}", entry.means, f"{entry.advice}", accept)
    return "\n".join([code, *(f"  {part}" for part in parts if part)])


def _filled(template: str, values: Mapping[str, Any]) -> str:
    """Return a template with values printed; an optional part goes where a value of it is None or empty."""

    def kept(part: re.Match[str]) -> str:
        needed = [name for _, name, _, _ in Formatter().parse(part[1]) if name]
        return "" if any(values[name] in (None, "", (), [], False) for name in needed) else part[1]

    return _Printer().vformat(re.sub(r"<([^<>]*)>", kept, template), (), values)


class _Printer(Formatter):
    def format_field(self, value: Any, format_spec: str) -> str:
        number, _, unit = format_spec.partition(" ")
        if isinstance(value, list | tuple):
            return listing(value, int(number)) if number else listing(value)
        printed = format(value * UNITS.get(unit, 1.0) if unit else value, number)
        return printed + ("" if unit in ("", "°") else " ") + unit

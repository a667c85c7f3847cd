"""Findings as sentences, and verdicts from findings: all sentences and limits are in ``findings.toml``.

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

from calib.errors import Finding, UsageError, listing, suggestion
from calib.units import DEG

RANKS = ("", "note", "marginal", "fail")
UNITS = {"mm": 1e3, "µm": 1e6, "mrad": 1e3, "°": 1 / DEG, "%": 100.0, "ms": 1e3}  # SI -> as printed; others as they are
PREDICTION_ONLY = "pass (prediction only)"  # of a model that predicts well and cannot be exported
NOT_JUDGED = "not judged"  # of results for which nobody stated what is good enough
LEVELS = ("pass", PREDICTION_ONLY, NOT_JUDGED, "marginal", "fail")


@dataclass(frozen=True)
class Verdict:
    """Verdict on a result: one of `LEVELS`, the reason in one sentence, the code of the deciding finding, and advice.

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
        """Return the verdict that follows from the worst finding; the reason begins with the text `figures`."""
        worst = max(findings, key=lambda one: RANKS.index(level_of(one)), default=None)
        if worst is None or level_of(worst) in ("", "note"):
            return cls("pass", figures)
        reason, advice = "; ".join(filter(None, [figures, sentence(worst)])), catalogue()[worst.code].advice
        return cls(level_of(worst), reason, worst.code, _filled(advice, worst.values))

    def for_prediction(self, why: str) -> Verdict:
        """Return the verdict of a model that cannot be exported for the reason `why`: pass becomes prediction only."""
        return Verdict(PREDICTION_ONLY, f"{self.reason}; {why}") if self.level == "pass" else self


UNJUDGED = Verdict("", "judged by the session on unseen rows: see verdict.json in the session's folder")


@dataclass(frozen=True)
class Verdicts:
    """Verdicts on the stages and deliverables of one robot.

    Attributes:
        stages: ``geometry``, ``dynamics`` → the verdict on what is to be delivered.
        deliverables: of the geometry: ``urdf`` and ``corrections`` → the verdict on it; empty if there is only one.
    """

    stages: Mapping[str, Verdict] = field(default_factory=dict)
    deliverables: Mapping[str, Verdict] = field(default_factory=dict)

    @property
    def level(self) -> str:
        """Worst level among the stages' verdicts; empty without stages."""
        return max((one.level for one in self.stages.values()), key=LEVELS.index, default="")

    def of(self, deliverable: str, dynamics: bool = False) -> Verdicts:
        """Return the verdicts that concern one deliverable, with or without the dynamics."""
        own = {name: one for name, one in self.stages.items() if dynamics or name != "dynamics"}
        if deliverable in self.deliverables:
            own["geometry"] = self.deliverables[deliverable]
        return Verdicts(own)

    def __str__(self) -> str:
        """Return the worst verdict, with the reasons of all stages that have it."""
        reasons = (f"{stage}: {one.reason}" for stage, one in self.stages.items() if one.level == self.level)
        return f"verdict {self.level}: {'; '.join(reasons)}{'; do not use' if self.level == 'fail' else ''}"

    def table(self) -> dict[str, Any]:
        """Return the worst verdict, and each stage's verdict and reason, as a table for JSON."""
        stages = {stage: {"verdict": one.level, "reason": one.reason} for stage, one in self.stages.items()}
        return {"verdict": self.level, **stages}

    @property
    def remark(self) -> str:
        """Remark for files whose verdict is marginal or fail; else empty."""
        return str(self) if self.level in ("marginal", "fail") else ""


@dataclass(frozen=True)
class Entry:
    """One entry of the catalogue; the module's docstring explains its fields."""

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
    """Return the level of a finding (one of `RANKS`) from the catalogue's limits; an accepted finding is a note."""
    entry = catalogue()[one.code]
    reached = [
        max((name for name, limit in steps.items() if one.values[value] > limit), key=RANKS.index, default="")
        for value, steps in entry.limits.items()
    ]
    level = min(reached or [entry.level], key=RANKS.index)
    return "note" if level and one.accepted else level


def limit(code: str, value: str, level: str = "fail") -> float:
    """Return the limit above which a value of a finding reaches a level."""
    return catalogue()[code].limits[value][level]


def settle(found: Iterable[Finding], accepted: Collection[str] = ()) -> tuple[Finding, ...]:
    """Return the findings that reach a level, worst first, with those marked that the options accept."""
    marked = [replace(one, accepted=catalogue()[one.code].accept in accepted) for one in found]
    return tuple(sorted(filter(level_of, marked), key=lambda one: -RANKS.index(level_of(one))))


def sentence(one: Finding) -> str:
    """Return the sentence of a finding, without advice and full stop."""
    return _filled(catalogue()[one.code].says, one.values)


class Warned(str):
    """Text of a finding that prevents the verdict pass; commands always print it."""


def lines_of(found: Iterable[Finding]) -> list[str]:
    """Return one line for each finding: its sentence, its advice, and how to accept it."""
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
    """Return the technical terms of messages and reports, term -> meaning."""
    return tomllib.loads(Path(__file__).with_name("glossary.toml").read_text(encoding="utf-8"))


def levels(entry: Entry) -> str:
    """Return in words what level a finding has, and from which values on; a limit below zero is exceeded always."""
    rules = [
        f"{level} where {value} > {limit:g}" if limit >= 0.0 else f"{level} always"
        for value, steps in entry.limits.items()
        for level, limit in steps.items()
        if limit >= 0.0 or len(entry.limits) == 1
    ]
    return "; ".join(rules) or entry.level


def explain(code: str) -> str:
    """Return the explanation of a finding's code (sentence, limits, advice) or of a term of the glossary.

    Raises:
        UsageError: for a code or term that there is none of.
    """
    terms = {term.lower(): f"{term}\n  {meaning}" for term, meaning in glossary().items()}
    if (meaning := terms.get(code.lower())) and code not in catalogue():
        return meaning
    if (entry := catalogue().get(code)) is None:
        near = suggestion(code, [*catalogue(), *glossary()])
        raise UsageError(f"no finding or term is called '{code}'{near}; `calib explain` lists all")
    accept = f'accept = ["{entry.accept}"] in the options file lets the verdict pass' if entry.accept else ""
    parts = (entry.says, f"level: {levels(entry)}", entry.means, f"{entry.advice}", accept)
    return "\n".join([code, *(f"  {part}" for part in parts if part)])


def _filled(template: str, values: Mapping[str, Any]) -> str:
    """Return a template with values inserted; an optional part ``<…>`` is left out if its value is None or empty."""

    def kept(part: re.Match[str]) -> str:
        needed = [name for _, name, _, _ in Formatter().parse(part[1]) if name]
        return "" if any(values.get(name) in (None, "", (), [], False) for name in needed) else part[1]

    return _Printer().vformat(re.sub(r"<([^<>]*)>", kept, template), (), values)


class _Printer(Formatter):
    def format_field(self, value: Any, format_spec: str) -> str:
        number, _, unit = format_spec.partition(" ")
        if isinstance(value, list | tuple):
            return listing(value, int(number)) if number else listing(value)
        printed = format(value * UNITS.get(unit, 1.0) if unit else value, number)
        return printed + ("" if unit in ("", "°") else " ") + unit

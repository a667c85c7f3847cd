"""Findings as sentences, and verdicts from findings: all sentences and limits are in ``findings.toml``.

A stage creates a finding by ``finding("moved", times=…)`` (`calib.errors.Finding`). For each finding's code, the
catalogue ``findings.toml`` states::

    says     the sentence, number first; ``{rms:.3g mm}`` prints a value [SI] in a unit, ``{names:5}`` the first five
             of a list, ``<, …>`` an optional part, omitted if one of its values is None or empty
    advice   what the user should do
    level    note, marginal or fail; or
    limits   value -> level -> limit above which the value reaches the level; if several values have limits, the
             mildest of their levels counts; a finding that reaches no level is not reported
    accept   the name in the options' ``accept`` by which a user accepts the finding
    means    additional explanation for `calib explain`
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
# SI -> as printed; other units as they are
UNITS = {"mm": 1e3, "µm": 1e6, "mrad": 1e3, "°": 1 / DEG, "%": 100.0, "ms": 1e3}
# verdict on a model that predicts well and cannot be exported
PREDICTION_ONLY = "pass (prediction only)"
# verdict on results for which nobody stated what is good enough
NOT_JUDGED = "not judged"
LEVELS = ("pass", PREDICTION_ONLY, NOT_JUDGED, "marginal", "fail")
# values for which an optional part of a sentence is left out
OMITTED_VALUES = (None, "", (), [], False)


@dataclass(frozen=True)
class Verdict:
    """Verdict on a result: one of `LEVELS`, the reason in one sentence, the code of the deciding finding, and advice.

    A verdict compares equal to the name of its level: ``fit.verdict == "pass"``. The code is empty if no finding
    decided.
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
        """Return the verdict that follows from the worst finding; without findings above a note, it is pass.

        Args:
            figures: text with which the reason begins.
            findings: findings on the result.
        """
        worst = max(findings, key=_rank, default=None)
        if worst is None or level_of(worst) in ("", "note"):
            return cls("pass", figures)
        parts = [part for part in (figures, sentence(worst)) if part]
        advice = _filled(catalogue()[worst.code].advice, worst.values)
        return cls(level_of(worst), "; ".join(parts), worst.code, advice)

    def for_prediction(self, reason: str) -> Verdict:
        """Return the verdict on a model that cannot be exported: pass becomes pass (prediction only).

        Args:
            reason: why the model cannot be exported.
        """
        if self.level != "pass":
            return self
        return Verdict(PREDICTION_ONLY, f"{self.reason}; {reason}")


UNJUDGED = Verdict("", "judged by the session on unseen rows: see verdict.json in the session's folder")


@dataclass(frozen=True)
class Verdicts:
    """Verdicts on the stages and deliverables of one robot.

    Attributes:
        stages: name of a stage (``geometry``, ``dynamics``) -> verdict on its result.
        deliverables: ``urdf`` or ``corrections`` -> verdict on this form of the geometry; empty if the forms are not
            judged separately.
    """

    stages: Mapping[str, Verdict] = field(default_factory=dict)
    deliverables: Mapping[str, Verdict] = field(default_factory=dict)

    @property
    def level(self) -> str:
        """Worst level among the verdicts on the stages; empty without stages."""
        stage_levels = [verdict.level for verdict in self.stages.values()]
        return max(stage_levels, key=LEVELS.index, default="")

    def of(self, deliverable: str, dynamics: bool = False) -> Verdicts:
        """Return the verdicts that apply to one deliverable.

        Args:
            deliverable: ``urdf`` or ``corrections``.
            dynamics: whether the deliverable contains the dynamics, so that the verdict on them applies too.
        """
        stages = {name: verdict for name, verdict in self.stages.items() if dynamics or name != "dynamics"}
        if deliverable in self.deliverables:
            stages["geometry"] = self.deliverables[deliverable]
        return Verdicts(stages)

    def __str__(self) -> str:
        """Return the worst level, with the reason of each stage whose verdict has this level."""
        level = self.level
        reasons = [f"{stage}: {verdict.reason}" for stage, verdict in self.stages.items() if verdict.level == level]
        text = f"verdict {level}: {'; '.join(reasons)}"
        if level == "fail":
            text += "; do not use"
        return text

    def table(self) -> dict[str, object]:
        """Return the worst level, and the level and reason of each stage, as a table for JSON."""
        table: dict[str, object] = {"verdict": self.level}
        for stage, verdict in self.stages.items():
            table[stage] = {"verdict": verdict.level, "reason": verdict.reason}
        return table

    @property
    def remark(self) -> str:
        """Remark to be written into delivered files if the worst level is marginal or fail; otherwise empty."""
        if self.level in ("marginal", "fail"):
            return str(self)
        return ""


@dataclass(frozen=True)
class CatalogueEntry:
    """One entry of ``findings.toml``; the module's docstring explains its fields."""

    says: str
    advice: str = ""
    level: str = "note"
    limits: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    accept: str = ""
    means: str = ""


@cache
def catalogue() -> Mapping[str, CatalogueEntry]:
    """Return the catalogue of findings: code -> entry."""
    text = Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
    return {code: CatalogueEntry(**entry) for code, entry in tomllib.loads(text).items()}


def level_of(finding: Finding) -> str:
    """Return the level of a finding (one of `RANKS`) by the catalogue's limits; an accepted finding is a note."""
    entry = catalogue()[finding.code]
    levels = []
    for value, limits in entry.limits.items():
        reached = [level for level, limit in limits.items() if finding.values[value] > limit]
        levels.append(max(reached, key=RANKS.index, default=""))
    # the mildest of several values' levels counts
    level = min(levels or [entry.level], key=RANKS.index)
    if level and finding.accepted:
        return "note"
    return level


def _rank(finding: Finding) -> int:
    """Return the position of a finding's level in `RANKS`, in which levels are sorted by severity."""
    return RANKS.index(level_of(finding))


def limit(code: str, value: str, level: str = "fail") -> float:
    """Return the limit in the catalogue above which a value of a finding reaches a level.

    Args:
        code: code of the finding.
        value: name of the value.
        level: the level.
    """
    return catalogue()[code].limits[value][level]


def settle(findings: Iterable[Finding], accepted: Collection[str] = ()) -> tuple[Finding, ...]:
    """Return the findings that reach a level (note, marginal or fail) of the catalogue, worst first.

    Args:
        findings: findings of a stage.
        accepted: names of findings that the options accept; these findings are returned marked as accepted.
    """
    marked = []
    for finding in findings:
        is_accepted = catalogue()[finding.code].accept in accepted
        marked.append(replace(finding, accepted=is_accepted))
    reaching = list(filter(level_of, marked))
    # a reversed sort keeps the order of findings of one level
    reaching.sort(key=_rank, reverse=True)
    return tuple(reaching)


def sentence(finding: Finding) -> str:
    """Return the sentence of a finding with its values inserted, without advice and without a full stop."""
    return _filled(catalogue()[finding.code].says, finding.values)


@dataclass(frozen=True)
class Note:
    """A line of text for the user.

    If `is_warning`, the line reports a finding that prevents the verdict pass; commands always print such lines.
    """

    text: str
    is_warning: bool = False

    def __str__(self) -> str:
        return self.text


def notes_of(findings: Iterable[Finding]) -> list[Note]:
    """Return one note for each finding: its sentence, its advice, and how the user can accept it."""
    notes = []
    for finding in findings:
        line = _line(finding, catalogue()[finding.code])
        notes.append(Note(line, level_of(finding) in LEVELS))
    return notes


def lines_of(findings: Iterable[Finding]) -> list[str]:
    """Return a line of text for each finding: its sentence, its advice, and how the user can accept it."""
    return [note.text for note in notes_of(findings)]


def as_notes(lines: Iterable[str], findings: Iterable[Finding]) -> list[Note]:
    """Return lines of text as notes.

    A line that reports one of the findings that prevent the verdict pass is a warning.

    Args:
        lines: the lines.
        findings: findings whose lines are among them.
    """
    warnings = {note.text for note in notes_of(findings) if note.is_warning}
    return [Note(line, line in warnings) for line in lines]


def _line(finding: Finding, entry: CatalogueEntry) -> str:
    text = sentence(finding)
    if finding.accepted:
        return f"{text} (accepted by the options)"
    parts = [text, _filled(entry.advice, finding.values)]
    if entry.accept and level_of(finding) != "note":
        parts.append(f'if this is intended, add accept = ["{entry.accept}"] to the options')
    return "; ".join(part for part in parts if part)


@cache
def glossary() -> Mapping[str, str]:
    """Return the glossary of technical terms in messages and reports: term -> meaning."""
    return tomllib.loads(Path(__file__).with_name("glossary.toml").read_text(encoding="utf-8"))


def levels(entry: CatalogueEntry) -> str:
    """Return a text on the levels of a catalogue entry and their limits; a limit below zero is always exceeded."""
    rules = []
    for value, limits in entry.limits.items():
        for level, limit in limits.items():
            if limit >= 0.0:
                rules.append(f"{level} where {value} > {limit:g}")
            elif len(entry.limits) == 1:
                rules.append(f"{level} always")
    return "; ".join(rules) or entry.level


def explain(code: str) -> str:
    """Return the explanation of a finding's code (example, limits, meaning) or of a term of the glossary.

    Raises:
        UsageError: for an unknown code or term.
    """
    terms = {term.lower(): f"{term}\n  {meaning}" for term, meaning in glossary().items()}
    entry = catalogue().get(code)
    if entry is None:
        meaning = terms.get(code.lower())
        if meaning:
            return meaning
        hint = suggestion(code, [*catalogue(), *glossary()])
        raise UsageError(f"no finding or term is called '{code}'{hint}; `calib explain` lists all")
    says, advice = example_texts(code)
    parts = [f"for example: {says}", advice, f"level: {levels(entry)}", entry.means]
    if entry.accept:
        parts.append(f'accept = ["{entry.accept}"] in the options file lets the verdict pass')
    lines = [f"  {part}" for part in parts if part]
    return "\n".join([code, *lines])


def example(code: str) -> Finding:
    """Return a finding with plausible values, as an example of its message.

    Values by name, and what a finding has otherwise, are in ``finding_examples.toml``.
    """
    values = _example_values()
    return Finding(code, {**values["any"], **values.get(code, {})})


@cache
def _example_values() -> Mapping[str, Mapping[str, object]]:
    return tomllib.loads(Path(__file__).with_name("finding_examples.toml").read_text(encoding="utf-8"))


def example_texts(code: str) -> tuple[str, str]:
    """Return the sentence and the advice of a finding's example; the advice is empty if there is none."""
    return sentence(example(code)), _filled(catalogue()[code].advice, example(code).values)


def _with_unit(text: str, unit: str) -> str:
    """Return a printed value `text` followed by its unit, with a space except before a degree sign."""
    if unit in ("", "°"):
        return text + unit
    return f"{text} {unit}"


def _filled(template: str, values: Mapping[str, object]) -> str:
    """Return a template with the values inserted.

    An optional part ``<…>`` is omitted if one of its values is None or empty.

    Args:
        template: sentence of the catalogue.
        values: name -> value.
    """

    def part(match: re.Match[str]) -> str:
        for _, name, _, _ in Formatter().parse(match[1]):
            if name and values.get(name) in OMITTED_VALUES:
                return ""
        return match[1]

    return _Printer().vformat(re.sub(r"<([^<>]*)>", part, template), (), values)


class _Printer(Formatter):
    def format_field(self, value: Any, format_spec: str) -> str:
        number, _, unit = format_spec.partition(" ")
        if isinstance(value, list | tuple):
            if number:
                return listing(value, int(number))
            return listing(value)
        if unit:
            value = value * UNITS.get(unit, 1.0)
        return _with_unit(format(value, number), unit)

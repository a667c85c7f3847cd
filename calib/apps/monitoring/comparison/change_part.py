"""Common base of the two parts of a comparison, geometry and dynamics: verdict, findings, report section, numbers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calib.apps.monitoring.comparison.change_test import ChangeTest, ParameterChange
from calib.errors import Finding, finding
from calib.toolkit.report_pages import Block, KeyFigure, RecordColumn, Section, Text, met, table
from calib.toolkit.result_folders import Verdict, notes_of, settle
from calib.units import SMALL

if TYPE_CHECKING:
    from calib.toolkit.report_charts import Chart

# parameters shown; all are in the table on disk
MAX_PARAMETERS = 12


@dataclass(frozen=True, eq=False)
class ChangePart(ABC):
    """Change of the geometry, or of the dynamics, and whether the earlier parameters are still good enough.

    Attributes:
        before, after: the calibrations, with the attributes ``name``, ``judged`` and ``serial``.
        change: result of the change test, and figures specific to geometry or dynamics.
        tolerance: largest accepted value of `today`; None without one.
    """

    kind: ClassVar[str]
    table: ClassVar[str]
    captions: ClassVar[Sequence[str]]
    error_words: ClassVar[str]
    model_option: ClassVar[str]

    before: Any
    after: Any
    change: Any
    tolerance: float | None

    @property
    @abstractmethod
    def today(self) -> float:
        """The robot's error if it still used the earlier parameters today, in the unit of the tolerance."""

    @property
    @abstractmethod
    def words(self) -> str:
        """Short description of the change, for the verdict's reason."""

    @abstractmethod
    def specific_findings(self) -> list[Finding]:
        """Return the findings that are specific to geometry or dynamics."""

    @abstractmethod
    def blocks(self) -> list[Block]:
        """Return the report blocks specific to geometry or dynamics.

        The first block is put before the notes; the table of parameters follows the last one.
        """

    @abstractmethod
    def charts(self) -> dict[str, Chart]:
        """Return the figures of this part, by name."""

    @abstractmethod
    def shown(self, value: float) -> str:
        """Return `value`, an error in the unit of the tolerance, as text with its unit."""

    @abstractmethod
    def numbers(self) -> dict[str, object]:
        """Return the numbers specific to geometry or dynamics, by name [SI]."""

    @cached_property
    def noticed(self) -> tuple[Finding, ...]:
        """All findings on this part, worst first."""
        return settle([*self.specific_findings(), *self._shared_findings()])

    @cached_property
    def verdict(self) -> Verdict:
        """Verdict on whether the earlier parameters are still within tolerance."""
        figures = f"{self.words}, χ² {self.change.chi2:.3g} on {self.change.freedom}"
        if self.tolerance:
            state = "not"
            if self.today <= self.tolerance:
                state = "still"
            figures = f"{state} within the tolerance of {self.shown(self.tolerance)}: {figures}"
        return Verdict.of(figures, self.noticed)

    def _shared_findings(self) -> Iterator[Finding]:
        change_test: ChangeTest = self.change
        names = {"before": self.before.name, "after": self.after.name}
        if change_test.changed and change_test.parameters:
            first = change_test.parameters[0]
            code = "several-parameters-changed"
            if change_test.alone:
                code = "one-parameter-changed"
            change = plus_minus(first.alone, first.alone_sigma, first.unit)
            yield finding(code, name=first.name, change=change, left=change_test.unexplained, rivals=change_test.rivals)
        if any(change_test.extra):
            earlier, later = change_test.extra
            yield finding("combinations-left-out", earlier=earlier, later=later, option=self.model_option, **names)
        for calibration in (self.before, self.after):
            if calibration.judged[0] == "fail":
                yield finding("earlier-failed", name=calibration.name, reason=calibration.judged[1])
        if self.before.serial and self.after.serial and self.before.serial != self.after.serial:
            yield finding("other-serial-number", first=self.before.serial, second=self.after.serial, **names)

    def section(self) -> Section:
        """Return the report section with verdict, changes, notes and changed parameters."""
        allowed = ""
        if self.tolerance:
            allowed = self.shown(self.tolerance)
        reached = met(self.today, self.tolerance or 0.0)
        figure = KeyFigure(self.error_words, "", self.shown(self.today), "", self.basis, allowed, reached)

        title = "Changed parameters, in the order of how much of the change they explain"
        compared = [parameter for parameter in self.change.parameters if parameter.sigma or parameter.explained]
        parameters = table(title, _PARAMETERS, compared[:MAX_PARAMETERS], f"All in {self.table}.")
        blocks = [*self.blocks(), parameters]
        blocks.insert(1, Text("Notes", notes_of(self.noticed), "note"))
        return Section(f"Change of the {self.kind}", blocks, self.verdict.level, self.verdict.reason, [figure])

    @property
    @abstractmethod
    def basis(self) -> str:
        """Description of the measurements from which `today` is computed."""

    def to_dict(self) -> dict[str, object]:
        """Return all numbers as ``metrics.json`` contains them [SI]."""
        change_test: ChangeTest = self.change
        return {
            "verdict": self.verdict.level,
            "reason": self.verdict.reason,
            "tolerance": self.tolerance,
            "today": self.today,
            "chi2": change_test.chi2,
            "freedom": change_test.freedom,
            "probability": change_test.probability,
            "noticed": self.noticed,
            **self.numbers(),
        }


def plus_minus(value: float, sigma: float, unit: str) -> str:
    """Return a change with its σ as text; empty where σ is zero or NaN.

    Args:
        value, sigma: change and its σ [SI].
        unit: SI unit; small units (mm, mrad, …) are printed instead.
    """
    if not sigma or np.isnan(sigma):
        return ""
    factor, printed = SMALL.get(unit, (1.0, unit))
    return f"{factor * value:+.3g} ± {factor * sigma:.2g} {printed}"


def _value(value: float, unit: str) -> str:
    if np.isnan(value):
        return ""
    factor, printed = SMALL.get(unit, (1.0, unit))
    return f"{factor * value:.4g} {printed}"


def _before(parameter: ParameterChange) -> str:
    return _value(parameter.before, parameter.unit)


def _after(parameter: ParameterChange) -> str:
    return _value(parameter.after, parameter.unit)


def _change(parameter: ParameterChange) -> str:
    return plus_minus(parameter.after - parameter.before, parameter.sigma, parameter.unit)


def _sigmas(parameter: ParameterChange) -> str:
    if not parameter.sigma:
        return ""
    return f"{abs(parameter.after - parameter.before) / parameter.sigma:.1f}"


def _change_alone(parameter: ParameterChange) -> str:
    return plus_minus(parameter.alone, parameter.alone_sigma, parameter.unit)


_PARAMETERS = [
    RecordColumn("parameter", "{0.name}", number=False),
    RecordColumn("before", _before),
    RecordColumn("after", _after),
    RecordColumn("change", _change),
    RecordColumn("σ", _sigmas),
    RecordColumn("if it changed alone", _change_alone),
    RecordColumn("χ² explained", "{0.explained:.3g}"),
]

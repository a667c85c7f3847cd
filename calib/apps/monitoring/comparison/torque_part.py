"""The dynamics' part of a comparison: change of the torque along motions, with a figure of its course."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from calib.apps.monitoring.comparison.change_part import ChangePart
from calib.apps.monitoring.comparison.torque_change import TorqueChange
from calib.errors import Finding, finding
from calib.toolkit.report_pages import Block, RecordColumn, Text, table

if TYPE_CHECKING:
    from calib.toolkit.report_charts import Chart


class _TorqueRow(NamedTuple):
    """The change of one torque row along one motion.

    Attributes:
        motion, name: names of the motion and of the torque row.
        change, expected, worst: rms change, σ of the change, and largest change [N m or N].
        torque: rms torque of the later model [N m or N].
    """

    motion: str
    name: str
    change: float
    expected: float
    worst: float
    torque: float


@dataclass(frozen=True, eq=False)
class TorquePart(ChangePart):
    """Change of the dynamics.

    ``today`` is the share [%] of the torque measured for the later model that the earlier model leaves unexplained, on
    the worst motion.
    """

    kind: ClassVar = "dynamics"
    table: ClassVar = "torque_changes.csv"
    captions: ClassVar = ("Change of the torque from the earlier to the later model. Dashed: two sigmas.",)
    error_words: ClassVar = "torque unexplained by the earlier model"
    model_option: ClassVar = "--friction"

    @cached_property
    def judged(self) -> TorqueChange:
        """Change on the motion from which `today` is computed: the worst of those measured for the later model."""
        measured = [
            change for change in self.change.torques if change.unexplained and change.where in self.after.motions
        ]
        return max(measured or self.change.torques, key=_unexplained_before)

    @property
    def today(self) -> float:
        if self.judged.unexplained is None:
            return np.nan
        return self.judged.unexplained[0]

    @property
    def words(self) -> str:
        change = self.judged
        expected = f"expected from σ: {_rms(change.expected):.2g} {self.unit}"
        return f"the torque changed by {change.rms:.3g} {self.unit} rms ({expected})"

    @property
    def unit(self) -> str:
        return self.after.unit

    @property
    def basis(self) -> str:
        return self.judged.where

    def shown(self, value: float) -> str:
        return f"{value:.3g} %"

    def specific_findings(self) -> list[Finding]:
        test = self.change
        change = self.judged
        residual = 0.0
        if change.unexplained:
            residual = 1e-2 * min(change.unexplained) * _rms(change.torque)
        ratio = change.rms / max(residual, 1e-12)
        times_residual = ratio
        result: list[Finding] = []
        if self.tolerance:
            # Whether the change matters is then said by the tolerance.
            times_residual = 0.0
            times = self.today / self.tolerance
            result.append(finding("model-outgrown", times=times, today=self.today, after=self.after.name))
        hidden_by = None
        if ratio <= 1.0:
            hidden_by = residual
        result.append(
            finding(
                "dynamics-changed",
                sigmas=test.sigmas,
                beyond=times_residual,
                unit=self.unit,
                probability=test.probability,
                left=hidden_by,
            )
        )
        part = test.part
        if test.changed and not test.alone and part:
            share = part.explained / test.chi2
            result.append(finding("part-changed", name=part.name, share=share, rms=part.rms, unit=self.unit))
        return result

    def blocks(self) -> list[Block]:
        unit = self.unit
        rows = []
        for change in self.change.torques:
            for j, name in enumerate(self.after.rows):
                rows.append(
                    _TorqueRow(
                        motion=change.where,
                        name=name,
                        change=_rms(change.change[:, j]),
                        expected=_rms(change.expected[:, j]),
                        worst=np.abs(change.change[:, j]).max(),
                        torque=_rms(change.torque[:, j]),
                    )
                )
        torques = [
            RecordColumn("motion", "{0.motion}", number=False),
            RecordColumn("torque of", "{0.name}", number=False),
            RecordColumn(f"change rms {unit}", "{0.change:.3g}"),
            RecordColumn("expected from σ", "{0.expected:.2g}"),
            RecordColumn("worst", "{0.worst:.3g}"),
            RecordColumn("torque rms", "{0.torque:.3g}"),
        ]
        parts = [
            RecordColumn("part", "{0.name}", number=False),
            RecordColumn("χ² explained", "{0.explained:.3g}"),
            RecordColumn("of combinations", "{0.count}"),
            RecordColumn(f"torque if it changed alone, rms {unit}", "{0.rms:.3g}"),
        ]
        return [
            Text("Torque", [self._words(change) for change in self.change.torques]),
            table("Change of the torque", torques, rows),
            table("Change that one joint's friction or one link's body explains", parts, self.change.parts, most=6),
        ]

    def _words(self, change: TorqueChange) -> str:
        text = f"{change.where}: the torque changed by {change.rms:.3g} {self.unit} rms"
        if change.unexplained:
            earlier, later = change.unexplained
            text += f"; the earlier model leaves {earlier:.3g} % of the torque unexplained, the later one {later:.3g} %"
        return text

    def charts(self) -> dict[str, Chart]:
        from calib.toolkit.report_charts import AFTER, QUIET, Chart, Line, Panel

        change = self.judged
        panels = []
        for j, name in enumerate(self.after.rows):
            two_sigmas = 2.0 * change.expected[:, j]
            layers = [
                Line(change.t, change.change[:, j], "-", AFTER, 0.7),
                Line(change.t, -two_sigmas, "--", QUIET, 0.6),
                Line(change.t, two_sigmas, "--", QUIET, 0.6),
            ]
            panels.append(Panel(layers, f"{name} [{self.unit}]", "time [s]", xlim=(change.t[0], change.t[-1])))
        rows_of_panels = -(-len(panels) // 2)
        return {"torque": Chart(panels, 0.7 + 0.95 * rows_of_panels, 2, title=change.where, shared="x")}

    def numbers(self) -> dict[str, object]:
        torques = {}
        for change in self.change.torques:
            torques[change.where] = {
                "rms": change.rms,
                "expected": _rms(change.expected),
                "unexplained_percent": change.unexplained,
                "by_row": [_rms(column) for column in change.change.T],
            }
        parts = [{"name": part.name, "explained": part.explained, "rms": part.rms} for part in self.change.parts]
        return {"torques": torques, "parts": parts}


def _unexplained_before(change: TorqueChange) -> float:
    """Return the share of the torque [%] that the earlier model leaves unexplained; 0 where no torque was measured.

    Args:
        change: change of the torque along one motion.
    """
    if change.unexplained is None:
        return 0.0
    return change.unexplained[0]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))

"""The change of the dynamics as a part of a comparison: change of the torque over motions, with its curve."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from calib.apps.monitoring.comparison.change_part import ChangePart
from calib.apps.monitoring.comparison.torque_change import TorqueChange
from calib.errors import Finding, finding
from calib.toolkit.report_pages import Block, RecordColumn, Text, table

if TYPE_CHECKING:
    from calib.toolkit.report_charts import Chart


@dataclass(frozen=True, eq=False)
class TorquePart(ChangePart):
    """What changed; ``today``: the worst share [%] that the earlier model leaves of the torques measured later."""

    kind: ClassVar = "dynamics"
    table: ClassVar = "torque_changes.csv"
    captions: ClassVar = ("Change of the torque from the earlier to the later model. Dashed: two sigmas.",)
    error_words: ClassVar = "torque unexplained by the earlier model"
    model_option: ClassVar = "--friction"

    @cached_property
    def judged(self) -> TorqueChange:
        """The motion that `today` rests on: of those measured for the later model the worst."""
        measured_changes = [
            change for change in self.found.torques if change.unexplained and change.where in self.after.motions
        ]
        return max(measured_changes or self.found.torques, key=lambda change: (change.unexplained or (0.0,))[0])

    @property
    def today(self) -> float:
        return self.judged.unexplained[0] if self.judged.unexplained else np.nan

    @property
    def words(self) -> str:
        change = self.judged
        expected = f"σ lets expect {_rms(change.expected):.2g} {self.unit}"
        return f"the torque changed by {change.rms:.3g} {self.unit} rms ({expected})"

    @property
    def unit(self) -> str:
        return self.after.unit

    @property
    def basis(self) -> str:
        return self.judged.where

    def shown(self, value: float) -> str:
        return f"{value:.3g} %"

    def own_findings(self) -> list[Finding]:
        change_test, change, result = self.found, self.judged, list[Finding]()
        if self.tolerance:
            times = self.today / self.tolerance
            result.append(finding("model-outgrown", times=times, today=self.today, after=self.after.name))
        residual_torque = 1e-2 * min(change.unexplained) * _rms(change.torque) if change.unexplained else 0.0
        ratio = change.rms / max(residual_torque, 1e-12)
        result.append(
            finding(
                "dynamics-changed",
                sigmas=change_test.sigmas,
                beyond=0.0 if self.tolerance else ratio,
                unit=self.unit,
                probability=change_test.probability,
                left=residual_torque if ratio <= 1.0 else None,
            )
        )
        if change_test.changed and not change_test.alone and change_test.part:
            part = change_test.part
            result.append(
                finding(
                    "part-changed",
                    name=part.name,
                    share=part.explained / change_test.chi2,
                    rms=part.rms,
                    unit=self.unit,
                )
            )
        return result

    def blocks(self) -> list[Block]:
        unit, names = self.unit, self.after.rows
        rows = [(change, j) for change in self.found.torques for j in range(len(names))]
        torques = [
            RecordColumn("motion", lambda row: row[0].where, number=False),
            RecordColumn("torque of", lambda row: names[row[1]], number=False),
            RecordColumn(f"change rms {unit}", lambda row: f"{_rms(row[0].change[:, row[1]]):.3g}"),
            RecordColumn("σ of that", lambda row: f"{_rms(row[0].expected[:, row[1]]):.2g}"),
            RecordColumn("worst", lambda row: f"{np.abs(row[0].change[:, row[1]]).max():.3g}"),
            RecordColumn("torque rms", lambda row: f"{_rms(row[0].torque[:, row[1]]):.3g}"),
        ]
        parts = [
            RecordColumn("part", "{0.name}", number=False),
            RecordColumn("χ² explained", "{0.explained:.3g}"),
            RecordColumn("of combinations", "{0.count}"),
            RecordColumn(f"torque if it changed alone, rms {unit}", "{0.rms:.3g}"),
        ]
        return [
            Text("Torque", [self._words(change) for change in self.found.torques]),
            table("Change of the torque", torques, rows),
            table("What one joint's friction or one link's body explains", parts, self.found.parts, most=6),
        ]

    def _words(self, change: TorqueChange) -> str:
        text = f"{change.where}: the torque changed by {change.rms:.3g} {self.unit} rms"
        if change.unexplained:
            earlier, later = change.unexplained
            text += f"; the earlier model leaves {earlier:.3g} % of it unexplained, the later one {later:.3g} %"
        return text

    def charts(self) -> dict[str, Chart]:
        from calib.toolkit.report_charts import AFTER, QUIET, Chart, Panel, line

        change, panels = self.judged, []
        for j, name in enumerate(self.after.rows):
            band = [line(change.t, sign * 2.0 * change.expected[:, j], "--", QUIET, 0.6) for sign in (-1.0, 1.0)]
            lines = [line(change.t, change.change[:, j], "-", AFTER, 0.7), *band]
            panels.append(Panel(lines, f"{name} [{self.unit}]", "time [s]", xlim=(change.t[0], change.t[-1])))
        return {"torque": Chart(panels, 0.7 + 0.95 * -(-len(panels) // 2), 2, title=change.where, shared="x")}

    def numbers(self) -> dict[str, object]:
        torques = {
            one.where: {
                "rms": one.rms,
                "expected": _rms(one.expected),
                "unexplained_percent": one.unexplained,
                "by_row": [_rms(column) for column in one.change.T],
            }
            for one in self.found.torques
        }
        parts = [{"name": one.name, "explained": one.explained, "rms": one.rms} for one in self.found.parts]
        return {"torques": torques, "parts": parts}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))

"""The change of the dynamics as a part of a comparison: change of the torque over motions, with its curve."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calib.apps.monitoring.comparison.change_part import ChangePart
from calib.apps.monitoring.comparison.torque_change import TorqueChange
from calib.errors import Finding, finding
from calib.procedure.report.page import Block, Column, Text, table

if TYPE_CHECKING:
    from calib.procedure.report.charts import Chart


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
        mine = [one for one in self.found.torques if one.unexplained and one.where in self.after.motions]
        return max(mine or self.found.torques, key=lambda one: (one.unexplained or (0.0,))[0])

    @property
    def today(self) -> float:
        return self.judged.unexplained[0] if self.judged.unexplained else np.nan

    @property
    def words(self) -> str:
        one = self.judged
        return (
            f"the torque changed by {one.rms:.3g} {self.unit} rms (σ lets expect {_rms(one.expected):.2g} {self.unit})"
        )

    @property
    def unit(self) -> str:
        return self.after.unit

    @property
    def basis(self) -> str:
        return self.judged.where

    def shown(self, value: float) -> str:
        return f"{value:.3g} %"

    def own_findings(self) -> list[Finding]:
        found, one, result = self.found, self.judged, list[Finding]()
        if self.tolerance:
            times = self.today / self.tolerance
            result.append(finding("model-outgrown", times=times, today=self.today, after=self.after.name))
        left = 1e-2 * min(one.unexplained) * _rms(one.torque) if one.unexplained else 0.0
        beyond = one.rms / max(left, 1e-12)
        result.append(
            finding(
                "dynamics-changed",
                sigmas=found.sigmas,
                beyond=0.0 if self.tolerance else beyond,
                unit=self.unit,
                probability=found.probability,
                left=left if beyond <= 1.0 else None,
            )
        )
        if found.changed and not found.alone and found.part:
            part = found.part
            result.append(
                finding("part-changed", name=part.name, share=part.explained / found.chi2, rms=part.rms, unit=self.unit)
            )
        return result

    def blocks(self) -> list[Block]:
        unit, names = self.unit, self.after.rows
        rows = [(one, j) for one in self.found.torques for j in range(len(names))]
        torques = [
            Column("motion", lambda row: row[0].where, number=False),
            Column("torque of", lambda row: names[row[1]], number=False),
            Column(f"change rms {unit}", lambda row: f"{_rms(row[0].change[:, row[1]]):.3g}"),
            Column("σ of that", lambda row: f"{_rms(row[0].expected[:, row[1]]):.2g}"),
            Column("worst", lambda row: f"{np.abs(row[0].change[:, row[1]]).max():.3g}"),
            Column("torque rms", lambda row: f"{_rms(row[0].torque[:, row[1]]):.3g}"),
        ]
        parts = [
            Column("part", "{0.name}", number=False),
            Column("χ² explained", "{0.explained:.3g}"),
            Column("of combinations", "{0.count}"),
            Column(f"torque if it changed alone, rms {unit}", "{0.rms:.3g}"),
        ]
        return [
            Text("Torque", [self._words(one) for one in self.found.torques]),
            table("Change of the torque", torques, rows),
            table("What one joint's friction or one link's body explains", parts, self.found.parts, most=6),
        ]

    def _words(self, one: TorqueChange) -> str:
        words = f"{one.where}: the torque changed by {one.rms:.3g} {self.unit} rms"
        if one.unexplained:
            earlier, later = one.unexplained
            words += f"; the earlier model leaves {earlier:.3g} % of it unexplained, the later one {later:.3g} %"
        return words

    def charts(self) -> dict[str, Chart]:
        from calib.procedure.report.charts import Chart, Panel, line
        from calib.procedure.report.style import AFTER, QUIET

        one, panels = self.judged, []
        for j, name in enumerate(self.after.rows):
            band = [line(one.t, sign * 2.0 * one.expected[:, j], "--", QUIET, 0.6) for sign in (-1.0, 1.0)]
            lines = [line(one.t, one.change[:, j], "-", AFTER, 0.7), *band]
            panels.append(Panel(lines, f"{name} [{self.unit}]", "time [s]", xlim=(one.t[0], one.t[-1])))
        return {"torque": Chart(panels, 0.7 + 0.95 * -(-len(panels) // 2), 2, title=one.where, shared="x")}

    def numbers(self) -> dict[str, Any]:
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

"""The change of the geometry as a part of a comparison: motion of the tool in mm and mrad, with its map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from calib.apps.monitoring.comparison import geometry_change
from calib.apps.monitoring.comparison.change_part import ChangePart
from calib.apps.monitoring.comparison.geometry_change import ToolMotion
from calib.apps.monitoring.settings import DEFAULT_DIFF, DiffSettings
from calib.errors import Finding, finding
from calib.procedure.report.fit_report import FittedParameter
from calib.procedure.report.page import Block, Column, Text, table
from calib.units import JOINT

if TYPE_CHECKING:
    from calib.procedure.report.charts import Chart


@dataclass(frozen=True, eq=False)
class ToolPart(ChangePart):
    """What moved; ``today`` is the rms error [m] with the earlier parameters over the poses of both fits."""

    kind: ClassVar = "geometry"
    table: ClassVar = "changes.csv"
    captions: ClassVar = (
        "Motion of the tool from the earlier to the later calibration.",
        "Grey: less than two sigmas.",
    )
    error_words: ClassVar = "error with the earlier parameters"
    model_option: ClassVar = "--model"

    settings: DiffSettings = DEFAULT_DIFF

    @property
    def today(self) -> float:
        return float(np.hypot(self.found.motions[0].rms, self.after.left))

    @property
    def words(self) -> str:
        moved = self.found.motions[0]
        return f"the tool moved by {1e3 * moved.rms:.3g} mm rms (σ lets expect {1e3 * moved.expected:.2g} mm)"

    @property
    def basis(self) -> str:
        return f"{len(self.found.motions[0].q)} poses"

    def shown(self, value: float) -> str:
        return f"{1e3 * value:.3g} mm"

    def own_findings(self) -> list[Finding]:
        one, two, found, result = self.before, self.after, self.found, list[Finding]()
        moved, left = found.motions[0], max(one.left, two.left)
        if self.tolerance:
            result.append(finding("outgrown", times=self.today / self.tolerance, today=self.today, after=two.name))
            wide = found.motions[1]
            times = np.sqrt(max(wide.rms**2 - wide.expected**2, 0.0)) / self.tolerance
            result.append(finding("outgrown-elsewhere", times=times, moved=wide.rms, expected=wide.expected))
        beyond = moved.rms / max(left, 1e-12)
        if not found.freedom:
            result.append(finding("arm-not-tested", names=[one.name, two.name]))
        result.append(
            finding(
                "arm-changed",
                sigmas=found.sigmas,
                beyond=0.0 if self.tolerance else beyond,
                probability=found.probability,
                left=left if beyond <= 1.0 else None,
            )
        )
        corrected, counts = [each.name for each in (one, two) if each.cell.deflection.terms], self.settings
        if corrected and not (counts.same_base or counts.same_tool):
            whole = geometry_change.corrected_motion(one, two, counts)
            result.append(finding("corrections-not-compared", names=corrected, moved=whole))
        held: Mapping[str, bool] = {"base": counts.same_base, "tool": counts.same_tool}
        for name, step in found.frames.items():
            if not held[name]:
                size = {"way": np.linalg.norm(step[:3]), "turn": np.linalg.norm(step[3:])}
                what = {"base": "the base in the instrument's frame", "tool": "the tool on the flange"}[name]
                result.append(finding("placed-again", what=what, option=f"--same-{name}", **size))
        return result

    def blocks(self) -> list[Block]:
        joints = self.before.chain.joints
        motions = [
            Column("target's motion at", "{0.where}", number=False),
            Column("poses", lambda one: f"{len(one.q)}"),
            Column("median mm", lambda one: f"{1e3 * np.median(one.position):.3g}"),
            Column("rms mm", lambda one: f"{1e3 * one.rms:.3g}"),
            Column("σ of that mm", lambda one: f"{1e3 * one.expected:.2g}"),
            Column("worst mm", lambda one: f"{1e3 * one.position.max():.3g}"),
            Column("median mrad", lambda one: f"{1e3 * np.median(one.orientation):.3g}"),
            Column("worst mrad", lambda one: f"{1e3 * one.orientation.max():.3g}"),
            Column("worst at", lambda one: _joints(one, joints), number=False),
        ]
        by_joint = [Column("joint", "{0[0]}", number=False), Column("rms mm", lambda one: f"{1e3 * one[1]:.3g}")]
        return [
            Text("Motion", self._motion()),
            table("Motion of the tool", motions, self.found.motions),
            table("Motion of the tool by what describes one joint", by_joint, self.found.by_joint),
        ]

    def _motion(self) -> list[str]:
        """Return sentences on the target's motion: how far, where most, and by which joint."""
        found = self.found
        joint, most = max(found.by_joint, key=lambda one: one[1])
        lines = [
            f"{one.where} ({len(one.q)}): the tool moved by {1e3 * np.median(one.position):.3g} mm (median), "
            f"{1e3 * one.position.max():.3g} mm (worst, at {_joints(one, self.before.chain.joints)}), "
            f"and turned by {1e3 * np.median(one.orientation):.3g} and {1e3 * one.orientation.max():.3g} mrad"
            for one in found.motions
        ]
        return [*lines, f"most of it comes from {joint}: {1e3 * most:.3g} mm rms"] if found.changed else lines

    def charts(self) -> dict[str, Chart]:
        from calib.procedure.report.geometry_figures import error_map, parameter_changes

        motion = self.found.motions[0]
        arm = {element.name: k for k, element in enumerate(self.before.chain.elements)}
        rows = [
            FittedParameter(one.name, one.unit, one.before, one.after, one.sigma, None, "arm")
            for one in sorted(self.found.parameters, key=lambda one: arm[one.name])
            if one.sigma
        ]
        result = {"map": error_map(motion.points, motion.position, words="the tool moved by up to {}")}
        if rows:
            result["parameters"] = parameter_changes(rows, of="later - earlier")
        return result

    def numbers(self) -> dict[str, Any]:
        motions = {
            one.where: {
                "poses": len(one.q),
                "rms": one.rms,
                "expected": one.expected,
                "median": float(np.median(one.position)),
                "worst": float(one.position.max()),
                "worst_at": one.q[one.position.argmax()],
                "turn_median": float(np.median(one.orientation)),
                "turn_worst": float(one.orientation.max()),
            }
            for one in self.found.motions
        }
        return {"motions": motions, "by_joint": dict(self.found.by_joint)}


def _joints(motion: ToolMotion, joints: Any) -> str:
    """Return the joint values of the worst pose."""
    worst = motion.q[motion.position.argmax()]
    shown = (JOINT[one.kind] for one in joints)
    return ", ".join(f"{factor * value:.0f} {unit}" for (factor, unit), value in zip(shown, worst))

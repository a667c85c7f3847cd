"""The change of the geometry as a part of a comparison: motion of the tool in mm and mrad, with its map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from calib.apps.monitoring.comparison import geometry_change
from calib.apps.monitoring.comparison.change_part import ChangePart
from calib.apps.monitoring.comparison.geometry_change import ToolMotion
from calib.apps.monitoring.settings import DEFAULT_DIFF, DiffSettings
from calib.errors import Finding, finding
from calib.toolkit.report_pages import Block, FittedParameter, RecordColumn, Text, table
from calib.units import JOINT, NamedJoint

if TYPE_CHECKING:
    from calib.toolkit.report_charts import Chart


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
        motion = self.found.motions[0]
        return f"the tool moved by {1e3 * motion.rms:.3g} mm rms (σ lets expect {1e3 * motion.expected:.2g} mm)"

    @property
    def basis(self) -> str:
        return f"{len(self.found.motions[0].q)} poses"

    def shown(self, value: float) -> str:
        return f"{1e3 * value:.3g} mm"

    def own_findings(self) -> list[Finding]:
        before, after, change_test, result = self.before, self.after, self.found, list[Finding]()
        motion, residual = change_test.motions[0], max(before.left, after.left)
        if self.tolerance:
            result.append(finding("outgrown", times=self.today / self.tolerance, today=self.today, after=after.name))
            wide = change_test.motions[1]
            times = np.sqrt(max(wide.rms**2 - wide.expected**2, 0.0)) / self.tolerance
            result.append(finding("outgrown-elsewhere", times=times, moved=wide.rms, expected=wide.expected))
        ratio = motion.rms / max(residual, 1e-12)
        if not change_test.freedom:
            result.append(finding("arm-not-tested", names=[before.name, after.name]))
        result.append(
            finding(
                "arm-changed",
                sigmas=change_test.sigmas,
                beyond=0.0 if self.tolerance else ratio,
                probability=change_test.probability,
                left=residual if ratio <= 1.0 else None,
            )
        )
        corrected, counts = (
            [calibration.name for calibration in (before, after) if calibration.cell.deflection.terms],
            self.settings,
        )
        if corrected and not (counts.same_base or counts.same_tool):
            corrected_rms = geometry_change.corrected_motion(before, after, counts)
            result.append(finding("corrections-not-compared", names=corrected, moved=corrected_rms))
        counted: Mapping[str, bool] = {"base": counts.same_base, "tool": counts.same_tool}
        for name, step in change_test.frames.items():
            if not counted[name]:
                size = {"way": np.linalg.norm(step[:3]), "turn": np.linalg.norm(step[3:])}
                frame = {"base": "the base in the instrument's frame", "tool": "the tool on the flange"}[name]
                result.append(finding("placed-again", what=frame, option=f"--same-{name}", **size))
        return result

    def blocks(self) -> list[Block]:
        joints = self.before.chain.joints
        motions = [
            RecordColumn("target's motion at", "{0.where}", number=False),
            RecordColumn("poses", lambda motion: f"{len(motion.q)}"),
            RecordColumn("median mm", lambda motion: f"{1e3 * np.median(motion.position):.3g}"),
            RecordColumn("rms mm", lambda motion: f"{1e3 * motion.rms:.3g}"),
            RecordColumn("σ of that mm", lambda motion: f"{1e3 * motion.expected:.2g}"),
            RecordColumn("worst mm", lambda motion: f"{1e3 * motion.position.max():.3g}"),
            RecordColumn("median mrad", lambda motion: f"{1e3 * np.median(motion.orientation):.3g}"),
            RecordColumn("worst mrad", lambda motion: f"{1e3 * motion.orientation.max():.3g}"),
            RecordColumn("worst at", lambda motion: _joints(motion, joints), number=False),
        ]
        by_joint = [
            RecordColumn("joint", "{0[0]}", number=False),
            RecordColumn("rms mm", lambda motion: f"{1e3 * motion[1]:.3g}"),
        ]
        return [
            Text("Motion", self._motion()),
            table("Motion of the tool", motions, self.found.motions),
            table("Motion of the tool by what describes one joint", by_joint, self.found.by_joint),
        ]

    def _motion(self) -> list[str]:
        """Return sentences on the target's motion: how far, where most, and by which joint."""
        change_test = self.found
        joint, joint_rms = max(change_test.by_joint, key=lambda motion: motion[1])
        lines = [
            f"{motion.where} ({len(motion.q)}): the tool moved by {1e3 * np.median(motion.position):.3g} mm (median), "
            f"{1e3 * motion.position.max():.3g} mm (worst, at {_joints(motion, self.before.chain.joints)}), "
            f"and turned by {1e3 * np.median(motion.orientation):.3g} and {1e3 * motion.orientation.max():.3g} mrad"
            for motion in change_test.motions
        ]
        return (
            [*lines, f"most of it comes from {joint}: {1e3 * joint_rms:.3g} mm rms"] if change_test.changed else lines
        )

    def charts(self) -> dict[str, Chart]:
        from calib.toolkit.report_charts import error_map, parameter_changes

        motion = self.found.motions[0]
        arm = {element.name: k for k, element in enumerate(self.before.chain.elements)}
        rows = [
            FittedParameter(
                parameter.name, parameter.unit, parameter.before, parameter.after, parameter.sigma, None, "arm"
            )
            for parameter in sorted(self.found.parameters, key=lambda parameter: arm[parameter.name])
            if parameter.sigma
        ]
        result = {"map": error_map(motion.points, motion.position, words="the tool moved by up to {}")}
        if rows:
            result["parameters"] = parameter_changes(rows, of="later - earlier")
        return result

    def numbers(self) -> dict[str, object]:
        motions = {
            motion.where: {
                "poses": len(motion.q),
                "rms": motion.rms,
                "expected": motion.expected,
                "median": float(np.median(motion.position)),
                "worst": float(motion.position.max()),
                "worst_at": motion.q[motion.position.argmax()],
                "turn_median": float(np.median(motion.orientation)),
                "turn_worst": float(motion.orientation.max()),
            }
            for motion in self.found.motions
        }
        return {"motions": motions, "by_joint": dict(self.found.by_joint)}


def _joints(motion: ToolMotion, joints: Sequence[NamedJoint]) -> str:
    """Return the joint values of the worst pose."""
    worst = motion.q[motion.position.argmax()]
    factors_and_units = (JOINT[joint.kind] for joint in joints)
    return ", ".join(f"{factor * value:.0f} {unit}" for (factor, unit), value in zip(factors_and_units, worst))

"""The geometry's part of a comparison: motion of the tool in mm and mrad, with a map over the workspace."""

from __future__ import annotations

from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from calib.apps.monitoring.comparison import geometry_change
from calib.apps.monitoring.comparison.change_part import ChangePart
from calib.apps.monitoring.comparison.geometry_change import ToolMotion
from calib.apps.monitoring.settings import DEFAULT_DIFF, DiffSettings
from calib.errors import Finding, finding
from calib.toolkit.report_pages import Block, FittedParameter, RecordColumn, Text, table
from calib.units import JOINT

if TYPE_CHECKING:
    from calib.toolkit.report_charts import Chart


@dataclass(frozen=True, eq=False)
class ToolPart(ChangePart):
    """Change of the geometry; ``today`` is the rms error [m] with the earlier parameters at the poses of both fits."""

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
        return float(np.hypot(self.change.motions[0].rms, self.after.residual_rms))

    @property
    def words(self) -> str:
        motion = self.change.motions[0]
        return f"the tool moved by {1e3 * motion.rms:.3g} mm rms (expected from σ: {1e3 * motion.expected:.2g} mm)"

    @property
    def basis(self) -> str:
        return f"{len(self.change.motions[0].q)} poses"

    def shown(self, value: float) -> str:
        return f"{1e3 * value:.3g} mm"

    def specific_findings(self) -> list[Finding]:
        before = self.before
        after = self.after
        change = self.change
        motion = change.motions[0]
        residual_rms = max(before.residual_rms, after.residual_rms)
        ratio = motion.rms / max(residual_rms, 1e-12)
        times_residual = ratio
        result: list[Finding] = []
        if self.tolerance:
            # Whether the change matters is then said by the tolerance.
            times_residual = 0.0
            result.append(finding("outgrown", times=self.today / self.tolerance, today=self.today, after=after.name))
            at_random = change.motions[1]
            significant = np.sqrt(max(at_random.rms**2 - at_random.expected**2, 0.0))
            times = significant / self.tolerance
            result.append(finding("outgrown-elsewhere", times=times, moved=at_random.rms, expected=at_random.expected))
        if not change.freedom:
            result.append(finding("arm-not-tested", names=[before.name, after.name]))
        hidden_by = None
        if ratio <= 1.0:
            hidden_by = residual_rms
        sigmas = change.sigmas
        result.append(
            finding("arm-changed", sigmas=sigmas, beyond=times_residual, probability=change.probability, left=hidden_by)
        )

        same_base = self.settings.same_base
        same_tool = self.settings.same_tool
        corrected = [calibration.name for calibration in (before, after) if calibration.cell.deflection.terms]
        if corrected and not (same_base or same_tool):
            corrected_rms = geometry_change.corrected_motion(before, after, self.settings)
            result.append(finding("corrections-not-compared", names=corrected, moved=corrected_rms))
        frames = (
            ("base", same_base, "the base in the instrument's frame"),
            ("tool", same_tool, "the tool on the flange"),
        )
        for name, counts, description in frames:
            step = change.frames.get(name)
            if step is None or counts:
                continue
            way = np.linalg.norm(step[:3])
            turn = np.linalg.norm(step[3:])
            result.append(finding("placed-again", what=description, option=f"--same-{name}", way=way, turn=turn))
        return result

    def blocks(self) -> list[Block]:
        motions = [
            RecordColumn("target's motion at", "{0.where}", number=False),
            RecordColumn("poses", _pose_count),
            RecordColumn("median mm", _median_mm),
            RecordColumn("rms mm", _rms_mm),
            RecordColumn("expected from σ mm", _expected_mm),
            RecordColumn("worst mm", _worst_mm),
            RecordColumn("median mrad", _median_mrad),
            RecordColumn("worst mrad", _worst_mrad),
            RecordColumn("worst at", self._worst_joints, number=False),
        ]
        by_joint = [
            RecordColumn("joint", "{0[0]}", number=False),
            RecordColumn("rms mm", lambda row: f"{1e3 * row[1]:.3g}"),
        ]
        return [
            Text("Motion", self._motion()),
            table("Motion of the tool", motions, self.change.motions),
            table("Motion of the tool that the parameters of one joint explain", by_joint, self.change.by_joint),
        ]

    def _motion(self) -> list[str]:
        """Return sentences on the target's motion: its size, the pose where it is largest, and the joint causing it."""
        change = self.change
        lines = []
        for motion in change.motions:
            beginning = f"{motion.where} ({len(motion.q)}): the tool moved by {_median_mm(motion)} mm (median)"
            worst = f"{_worst_mm(motion)} mm (worst, at {self._worst_joints(motion)})"
            turns = f"and turned by {_median_mrad(motion)} and {_worst_mrad(motion)} mrad"
            lines.append(f"{beginning}, {worst}, {turns}")
        if change.changed:
            joint, joint_rms = max(change.by_joint, key=itemgetter(1))
            lines.append(f"most of this motion comes from {joint}: {1e3 * joint_rms:.3g} mm rms")
        return lines

    def _worst_joints(self, motion: ToolMotion) -> str:
        """Return as text the joint values at the pose where the target moved most.

        Args:
            motion: motion of the target at several poses.
        """
        values = []
        for joint, value in zip(self.before.chain.joints, motion.q[motion.position.argmax()]):
            factor, unit = JOINT[joint.kind]
            values.append(f"{factor * value:.0f} {unit}")
        return ", ".join(values)

    def charts(self) -> dict[str, Chart]:
        from calib.toolkit.report_charts import error_map, parameter_changes

        motion = self.change.motions[0]
        changes = {parameter.name: parameter for parameter in self.change.parameters}
        rows = []
        for element in self.before.chain.elements:
            change = changes[element.name]
            if change.sigma:
                rows.append(
                    FittedParameter(change.name, change.unit, change.before, change.after, change.sigma, None, "arm")
                )
        charts = {"map": error_map(motion.points, motion.position, words="the tool moved by up to {}")}
        if rows:
            charts["parameters"] = parameter_changes(rows, of="later - earlier")
        return charts

    def numbers(self) -> dict[str, object]:
        motions = {}
        for motion in self.change.motions:
            motions[motion.where] = {
                "poses": len(motion.q),
                "rms": motion.rms,
                "expected": motion.expected,
                "median": float(np.median(motion.position)),
                "worst": float(motion.position.max()),
                "worst_at": motion.q[motion.position.argmax()],
                "turn_median": float(np.median(motion.orientation)),
                "turn_worst": float(motion.orientation.max()),
            }
        return {"motions": motions, "by_joint": dict(self.change.by_joint)}


def _pose_count(motion: ToolMotion) -> str:
    return f"{len(motion.q)}"


def _rms_mm(motion: ToolMotion) -> str:
    return f"{1e3 * motion.rms:.3g}"


def _expected_mm(motion: ToolMotion) -> str:
    return f"{1e3 * motion.expected:.2g}"


def _median_mm(motion: ToolMotion) -> str:
    return f"{1e3 * np.median(motion.position):.3g}"


def _worst_mm(motion: ToolMotion) -> str:
    return f"{1e3 * motion.position.max():.3g}"


def _median_mrad(motion: ToolMotion) -> str:
    return f"{1e3 * np.median(motion.orientation):.3g}"


def _worst_mrad(motion: ToolMotion) -> str:
    return f"{1e3 * motion.orientation.max():.3g}"

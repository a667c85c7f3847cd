"""Comparison of two calibrations of a robot in Python: `calib.diff`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib.apps.monitoring import report_folder
from calib.apps.monitoring.comparison import geometry_change, torque_change
from calib.apps.monitoring.comparison.calibration_sources import Place, place_of
from calib.apps.monitoring.comparison.change_part import ChangePart
from calib.apps.monitoring.comparison.change_test import ParameterChange
from calib.apps.monitoring.comparison.geometry_calibration import read_fits
from calib.apps.monitoring.comparison.geometry_change import GeometryChange
from calib.apps.monitoring.comparison.identifications import read_models, read_states
from calib.apps.monitoring.comparison.tool_part import ToolPart
from calib.apps.monitoring.comparison.torque_change import DynamicsChange
from calib.apps.monitoring.comparison.torque_part import TorquePart
from calib.apps.monitoring.settings import DEFAULT_DIFF, DiffSettings
from calib.arguments import checked
from calib.config_types import Plots
from calib.errors import Finding, UsageError, require
from calib.records import plain
from calib.result_kinds import BY_NAME
from calib.toolkit.report_pages import Block, KeyFigure, Section
from calib.toolkit.result_folders import (
    LEVELS,
    ChartedResult,
    DynamicsModel,
    GeometryFit,
    ReportedResult,
    Verdict,
    saved,
)

if TYPE_CHECKING:
    from calib.toolkit.report_charts import Chart

TABLES = (ToolPart.table, TorquePart.table)


@dataclass(frozen=True, eq=False)
class RobotChange(ChartedResult, ReportedResult):
    """Change between two calibrations of a robot.

    ``print`` shows the verdict, the motion of the tool and the changed parameters.

    Attributes:
        parts: change of the geometry, of the dynamics, or both.
    """

    parts: tuple[ChangePart, ...]

    kind = BY_NAME["comparison"]
    tab = "verdict geometry dynamics noticed plot save to_dict"

    @property
    def verdict(self) -> Verdict:
        """Verdict on whether the earlier parameters are still within tolerance: that of the worst part."""
        worst = max(self.parts, key=lambda part: LEVELS.index(part.verdict.level))
        verdict = worst.verdict
        if len(self.parts) == 1:
            return verdict
        return replace(verdict, reason=f"{worst.kind}: {verdict.reason}")

    @property
    def noticed(self) -> tuple[Finding, ...]:
        """Findings on all parts of the comparison."""
        findings: list[Finding] = []
        for part in self.parts:
            findings += part.noticed
        return tuple(findings)

    @property
    def geometry(self) -> GeometryChange | None:
        """The change of the geometry; None where only dynamics are compared."""
        return self._change_of("geometry")

    @property
    def dynamics(self) -> DynamicsChange | None:
        """The change of the dynamics; None where only geometries are compared."""
        return self._change_of("dynamics")

    def _change_of(self, kind: str) -> Any:
        for part in self.parts:
            if part.kind == kind:
                return part.change
        return None

    def section(self) -> Section:
        """Return all parts as one report section."""
        blocks: list[Block] = []
        figures: list[KeyFigure] = []
        for part in self.parts:
            section = part.section()
            blocks += section.blocks
            figures += section.figures
        return Section("Change", blocks, self.verdict.level, self.verdict.reason, figures)

    def charts(self) -> dict[str, Chart]:
        """Return the figures by name: motion of the tool over the workspace, change of the torque."""
        charts: dict[str, Chart] = {}
        for part in self.parts:
            charts |= part.charts()
        return charts

    @checked
    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Write the comparison into a folder and return its path.

        The folder contains report.html, tables of all parameters, metrics.json, and the figures as PNG.

        Args:
            out: the folder.
            plots: whether figures are drawn.
        """
        parts = []
        for part in self.parts:
            charts: dict[str, Chart] = {}
            if plots:
                charts = part.charts()
            parameters = (part.table, ParameterChange._fields, part.change.parameters)
            parts.append(report_folder.ResultPart(part.section(), charts, part.captions, parameters))
        earlier, later, robot = self._names
        setup = {"earlier": earlier, "later": later}
        return report_folder.save(
            Path(out), "comparison", f"Change of {robot}", setup, parts, self.to_dict(), TABLES, plots
        )

    @property
    def _names(self) -> tuple[str, str, str]:
        part = self.parts[0]
        return part.before.name, part.after.name, part.before.robot.chain.name

    def to_dict(self) -> dict[str, object]:
        """Return the numbers as ``metrics.json`` contains them [SI]."""
        before, after, _ = self._names
        numbers: dict[str, Any] = {
            "before": before,
            "after": after,
            "verdict": self.verdict.level,
            "reason": self.verdict.reason,
        }
        for part in self.parts:
            numbers[part.kind] = part.to_dict()
        return plain(numbers)

    def __repr__(self) -> str:
        return f"<RobotChange of {self._names[2]}: {self.verdict.level}>"


Compared = str | Path | GeometryFit | DynamicsModel


@checked
def diff(before: Compared, after: Compared, settings: DiffSettings = DEFAULT_DIFF) -> RobotChange:
    """Compare two calibrations of one robot: what changed, and whether the earlier parameters are still good enough.

    Args:
        before, after: fits, identifications, their folders, or folders of sessions. Geometry and dynamics are compared
            where both calibrations contain them. One of the two may be the nominal robot (file or name), for a
            comparison of geometry with a fit.
        settings: tolerances, whether changes of base and tool placement count, and files of motions along which the
            change of the torque is computed.

    Returns:
        ``verdict``, ``geometry`` with the test and the tool's motion, ``dynamics`` with the test and the change of the
        torque, figures (`plot`), `save`.

    Raises:
        UsageError: the calibrations have no part in common, or a folder contains no calibration.
        RobotError: the calibrations are of different robots.
    """
    with saved(before) as first, saved(after) as second:
        earlier = place_of(first)
        later = place_of(second)
        parts = [*_tool_parts(earlier, later, settings), *_torque_parts(earlier, later, settings)]
    message = f"nothing to compare: {earlier.words}, {later.words}"
    if earlier.nominal and later.nominal:
        message = f"neither {before} nor {after} is the folder of a fit or of a session; give at least one"
    require(parts, message, UsageError)
    return RobotChange(tuple(parts))


def _tool_parts(before: Place, after: Place, settings: DiffSettings) -> list[ChangePart]:
    if not before.fit and not after.fit:
        return []
    # Where one of the two has no fit, it has to be the nominal robot.
    for calibration in (before, after):
        if not calibration.fit and not calibration.nominal:
            return []
    earlier, later = read_fits(before, after)
    change = geometry_change.compare(earlier, later, settings)
    tolerance = settings.tolerance or later.tolerance or earlier.tolerance
    return [ToolPart(earlier, later, change, tolerance, settings)]


def _torque_parts(before: Place, after: Place, settings: DiffSettings) -> list[ChangePart]:
    if not (before.identification and after.identification):
        return []
    earlier, later = read_models(before, after)
    motions = {**later.motions, **earlier.motions}
    for name in settings.motions:
        states = read_states(Path(name), later.model.n)
        require(states, f"{name}: no accelerations; expected columns q_…, v_… and a_…", UsageError)
        motions[name] = states  # type: ignore[assignment]
    message = f"neither {earlier.name} nor {later.name} contains a motion without payload; give one with --motion"
    require(motions, message, UsageError)
    change = torque_change.compare(earlier, later, motions)  # ty: ignore[invalid-argument-type]
    tolerance = settings.torque_tolerance or later.tolerance or earlier.tolerance or None
    return [TorquePart(earlier, later, change, tolerance)]

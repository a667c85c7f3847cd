"""Comparison of two calibrations of a robot in Python: `calib.diff`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib import files, folders
from calib.api.kinematic import GeometryFit
from calib.api.rendering import Drawn, Judged, saved
from calib.arguments import checked
from calib.errors import Finding, finding
from calib.procedure.findings import Verdict, lines_of, settle
from calib.procedure.report.fit_report import FittedParameter
from calib.procedure.report.page import Block, Column, KeyFigure, Picture, Pictures, Section, Text, met, table
from calib.records import plain
from calib.rooms.over_time import geometry_change
from calib.rooms.over_time.calibrations import Calibration, read_pair
from calib.rooms.over_time.change_test import ParameterChange
from calib.rooms.over_time.geometry_change import GeometryChange, ToolMotion
from calib.rooms.over_time.settings import DEFAULT_DIFF, DiffSettings
from calib.units import JOINT, SMALL, small

if TYPE_CHECKING:
    from calib.procedure.report.charts import Chart

TABLE, PAGE, PICTURE = "changes.csv", "report.html", "plot_{}.png"
FIGURES = ("map", "parameters")
OURS = (TABLE, PAGE, folders.METRICS, *(PICTURE.format(name) for name in FIGURES))
MOST = 12  # parameters shown; all are in `TABLE`


@dataclass(frozen=True, eq=False)
class RobotChange(Drawn, Judged):
    """What moved between two calibrations of a robot. ``print`` shows the verdict, the tool's motion, the parameters.

    Attributes:
        before, after: the calibrations.
        settings: of the comparison.
        geometry: what moved.
        tolerance: that the verdict rests on [m]; None without.
        noticed: findings, worst first.
        verdict: whether the earlier parameters are still within tolerance.
    """

    before: Calibration
    after: Calibration
    settings: DiffSettings
    geometry: GeometryChange
    tolerance: float | None
    noticed: tuple[Finding, ...]
    verdict: Verdict

    tab = "verdict geometry noticed plot save to_dict"

    @property
    def today(self) -> float:
        """Rms error [m] that the robot would have today with the earlier parameters, over the poses of both fits."""
        return _today(self.after, self.geometry)

    def section(self) -> Section:
        """Return a report section with verdict, motions of the tool, changed parameters and notes."""
        found, joints = self.geometry, self.before.chain.joints
        motions = [
            Column("target's motion at", "{0.where}", number=False), Column("poses", lambda one: f"{len(one.q)}"),
            Column("median mm", lambda one: f"{1e3 * np.median(one.position):.3g}"),
            Column("rms mm", lambda one: f"{1e3 * one.rms:.3g}"),
            Column("σ of that mm", lambda one: f"{1e3 * one.expected:.2g}"),
            Column("worst mm", lambda one: f"{1e3 * one.position.max():.3g}"),
            Column("median mrad", lambda one: f"{1e3 * np.median(one.orientation):.3g}"),
            Column("worst mrad", lambda one: f"{1e3 * one.orientation.max():.3g}"),
            Column("worst at", lambda one: _joints(one, joints), number=False),
        ]  # fmt: skip
        parameters = [
            Column("parameter", "{0.name}", number=False), Column("before", lambda one: small(one.before, one.unit, 4)),
            Column("after", lambda one: small(one.after, one.unit, 4)),
            Column("change", lambda one: _plus_minus(one.after - one.before, one.sigma, one.unit)),
            Column("σ", lambda one: f"{abs(one.after - one.before) / one.sigma:.1f}" if one.sigma else ""),
            Column("if it changed alone", lambda one: _plus_minus(one.alone, one.alone_sigma, one.unit)),
            Column("χ² explained", lambda one: f"{one.explained:.3g}"),
        ]  # fmt: skip
        by_joint = [Column("joint", "{0[0]}", number=False), Column("rms mm", lambda one: f"{1e3 * one[1]:.3g}")]
        shown = [one for one in found.parameters if one.sigma or one.explained][:MOST]
        blocks: list[Block] = [
            Text("Motion", self._motion()), Text("Notes", lines_of(self.noticed), "note"),
            table("Motion of the tool", motions, found.motions),
            table("Changed parameters, those first that explain most", parameters, shown, f"All in {TABLE}."),
            table("Motion of the tool by what describes one joint", by_joint, found.by_joint),
        ]  # fmt: skip
        figure = KeyFigure(
            "error with the earlier parameters", "", f"{1e3 * self.today:.3g} mm rms", "",
            f"{len(found.motions[0].q)} poses", f"{1e3 * self.tolerance:.3g} mm" if self.tolerance else "",
            met(self.today, self.tolerance or 0.0),
        )  # fmt: skip
        return Section("Change", blocks, self.verdict.level, self.verdict.reason, [figure])

    def _motion(self) -> list[str]:
        """Return sentences on the target's motion: how far, where most, and by which joint."""
        found = self.geometry
        joint, most = max(found.by_joint, key=lambda one: one[1])
        lines = [
            f"{one.where} ({len(one.q)}): the tool moved by {1e3 * np.median(one.position):.3g} mm (median), "
            f"{1e3 * one.position.max():.3g} mm (worst, at {_joints(one, self.before.chain.joints)}), "
            f"and turned by {1e3 * np.median(one.orientation):.3g} and {1e3 * one.orientation.max():.3g} mrad"
            for one in found.motions
        ]
        return [*lines, f"most of it comes from {joint}: {1e3 * most:.3g} mm rms"] if found.changed else lines

    def charts(self) -> dict[str, Chart]:
        """Return what the figures show: the tool's motion over the workspace, and the parameters' changes."""
        from calib.procedure.report.geometry_figures import error_map, parameter_changes

        motion = self.geometry.motions[0]
        arm = {element.name: k for k, element in enumerate(self.before.chain.elements)}
        rows = [
            FittedParameter(one.name, one.unit, one.before, one.after, one.sigma, None, "arm")
            for one in sorted(self.geometry.parameters, key=lambda one: arm[one.name]) if one.sigma
        ]  # fmt: skip
        return {
            "map": error_map(motion.points, motion.position, words="the tool moved by up to {}"),
            "parameters": parameter_changes(rows, of="later - earlier"),
        }

    @checked
    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write a folder: report.html, changes.csv with all parameters, metrics.json, and the figures as PNG."""
        folders.check_target(Path(out), OURS, (folders.METRICS, TABLE), "comparison")
        return folders.write_staged(Path(out), OURS, lambda folder: self._write(folder, plots))

    def _write(self, folder: Path, plots: bool) -> None:
        from calib.procedure.report.charts import picture
        from calib.rooms.certificate.record import Entry, report
        from calib.rooms.certificate.rendering import html

        captions = ("Motion of the tool from the earlier to the later calibration.", "Grey: less than two sigmas.")
        drawn: dict[str, Picture] = {}
        if plots:
            drawn = {name: picture(chart, words) for (name, chart), words in zip(self.charts().items(), captions)}
        for name, one in drawn.items():
            files.write(folder / PICTURE.format(name), one.image)
        own = self.section()
        shown = Section(
            own.title, [*own.blocks, Pictures("", list(drawn.values()))], own.verdict, own.reason, own.figures
        )
        setup = [Entry("earlier", self.before.name), Entry("later", self.after.name)]
        title = f"Change of {self.before.chain.name}"
        files.write(folder / PAGE, html(report(title, f"{self.before.name} to {self.after.name}", setup, [shown])))
        files.write_table(folder / TABLE, ParameterChange._fields, self.geometry.parameters)
        files.write_json(folder / folders.METRICS, self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers as in ``metrics.json`` [SI]."""
        found = self.geometry
        motions = {
            one.where: {
                "poses": len(one.q), "rms": one.rms, "expected": one.expected, "median": float(np.median(one.position)),
                "worst": float(one.position.max()), "worst_at": one.q[one.position.argmax()],
                "turn_median": float(np.median(one.orientation)), "turn_worst": float(one.orientation.max()),
            }
            for one in found.motions
        }  # fmt: skip
        return plain({
            "before": self.before.name, "after": self.after.name, "verdict": self.verdict.level,
            "reason": self.verdict.reason, "tolerance": self.tolerance, "today": self.today, "chi2": found.chi2,
            "freedom": found.freedom, "probability": found.probability, "motions": motions,
            "by_joint": dict(found.by_joint), "noticed": self.noticed,
        })  # fmt: skip

    def __repr__(self) -> str:
        return f"<RobotChange of {self.before.chain.name}: {self.verdict.level}>"


def _plus_minus(value: float, sigma: float, unit: str) -> str:
    factor, printed = SMALL[unit]
    return "" if not sigma or np.isnan(sigma) else f"{factor * value:+.3g} ± {factor * sigma:.2g} {printed}"


def _joints(motion: ToolMotion, joints: Any) -> str:
    """Return the joint values of the worst pose."""
    worst = motion.q[motion.position.argmax()]
    shown = (JOINT[one.kind] for one in joints)
    return ", ".join(f"{factor * value:.0f} {unit}" for (factor, unit), value in zip(shown, worst))


def _today(after: Calibration, found: GeometryChange) -> float:
    return float(np.hypot(found.motions[0].rms, after.left))


@checked
def diff(
    before: str | Path | GeometryFit, after: str | Path | GeometryFit, settings: DiffSettings = DEFAULT_DIFF
) -> RobotChange:
    """Compare two calibrations of one robot: what moved, and whether the earlier parameters are still good enough.

    Args:
        before, after: fits, or folders of fits or sessions; one of the two may be the nominal robot (file or name).
        settings: tolerance, and whether base and tool placement count.

    Returns:
        ``verdict``, ``geometry`` with the test and the tool's motion, figures (`plot`), `save`.

    Raises:
        UsageError: where neither is a fit, or a folder holds none.
        RobotError: where they are of different robots.
    """
    with saved(before) as first, saved(after) as second:
        one, two = read_pair(first, second)
    found = geometry_change.compare(one, two, settings)
    tolerance = settings.tolerance or two.tolerance or one.tolerance
    noticed = settle(_findings(one, two, found, settings, tolerance))
    moved = found.motions[0]
    figures = (
        f"the tool moved by {1e3 * moved.rms:.3g} mm rms (σ lets expect {1e3 * moved.expected:.2g} mm), "
        f"χ² {found.chi2:.3g} on {found.freedom}"
    )
    if tolerance:
        state = "still" if _today(two, found) <= tolerance else "not"
        figures = f"{state} within the tolerance of {1e3 * tolerance:.3g} mm: {figures}"
    return RobotChange(one, two, settings, found, tolerance, noticed, Verdict.of(figures, noticed))


def _findings(
    one: Calibration, two: Calibration, found: GeometryChange, settings: DiffSettings, tolerance: float | None
) -> list[Finding]:
    moved, left, result = found.motions[0], max(one.left, two.left), list[Finding]()
    names = {"before": one.name, "after": two.name}
    if tolerance:
        today = _today(two, found)
        result.append(finding("outgrown", times=today / tolerance, today=today, after=two.name))
        wide = found.motions[1]
        times = np.sqrt(max(wide.rms**2 - wide.expected**2, 0.0)) / tolerance
        result.append(finding("outgrown-elsewhere", times=times, moved=wide.rms, expected=wide.expected))
    beyond = moved.rms / max(left, 1e-12)
    result.append(finding(
        "arm-changed", sigmas=found.sigmas, beyond=0.0 if tolerance else beyond, probability=found.probability,
        left=left if beyond <= 1.0 else None,
    ))  # fmt: skip
    if found.changed and found.parameters:
        first = found.parameters[0]
        code = "one-parameter-changed" if found.alone else "several-parameters-changed"
        change = _plus_minus(first.alone, first.alone_sigma, first.unit)
        result.append(finding(code, name=first.name, change=change, left=found.unexplained, rivals=found.rivals))
    if any(found.extra):
        result.append(finding("combinations-left-out", earlier=found.extra[0], later=found.extra[1], **names))
    corrected = [each.name for each in (one, two) if each.cell.deflection.terms]
    if corrected and not (settings.same_base or settings.same_tool):
        whole = geometry_change.corrected_motion(one, two, settings)
        result.append(finding("corrections-not-compared", names=corrected, moved=whole))
    counts: Mapping[str, bool] = {"base": settings.same_base, "tool": settings.same_tool}
    for name, step in found.frames.items():
        if not counts[name]:
            size = {"way": np.linalg.norm(step[:3]), "turn": np.linalg.norm(step[3:])}
            what = {"base": "the base in the instrument's frame", "tool": "the tool on the flange"}[name]
            result.append(finding("placed-again", what=what, option=f"--same-{name}", **size))
    for each in (one, two):
        if each.judged[0] == "fail":
            result.append(finding("earlier-failed", name=each.name, reason=each.judged[1]))
    if one.serial and two.serial and one.serial != two.serial:
        result.append(finding("other-serial-number", first=one.serial, second=two.serial, **names))
    return result

"""Report of a fleet: which arms drift, which share a bad tool, how parameters are distributed over arms of one type."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from calib import files, folders
from calib.api.rendering import Judged
from calib.apps.fleet import prior
from calib.apps.fleet.prior import ParameterSpread
from calib.apps.fleet.tools import MIN_ARMS, MIN_TIMES, ToolUse, tools
from calib.apps.fleet.visits import visits
from calib.apps.monitoring.comparison.calibrations import Calibration
from calib.apps.monitoring.comparison.geometry_change import ToolMotion
from calib.apps.monitoring.comparison.places import check_same_robot
from calib.apps.monitoring.comparison.robot_change import RobotChange, diff
from calib.arguments import checked
from calib.errors import Finding, RobotError, counted, finding
from calib.geometry.fit import PLAUSIBLE
from calib.procedure.findings import Verdict, lines_of, settle
from calib.procedure.report.page import Block, Column, Section, Text, table
from calib.records import plain
from calib.units import small

PAGE, PRIOR = "report.html", "prior"
OURS = (PAGE, folders.METRICS)


@dataclass(frozen=True, eq=False)
class ArmType:
    """Arms of one nominal description, each by its latest calibration.

    Attributes:
        name: of the description, with a number where several descriptions have one name.
        arms: their calibrations.
        failed: names of those whose fit's verdict is fail: no part of `parameters`.
        odd: names of others whose geometry is not plausible for this type: no part of `parameters`, either.
        parameters: their distribution.
        tools: of all arms.
    """

    name: str
    arms: tuple[Calibration, ...]
    failed: tuple[str, ...]
    odd: tuple[str, ...]
    parameters: tuple[ParameterSpread, ...]
    tools: tuple[ToolUse, ...]

    @property
    def plausible(self) -> list[Calibration]:
        """The arms that `parameters` are of."""
        return [one for one in self.arms if one.name not in (*self.failed, *self.odd)]


@dataclass(frozen=True, eq=False)
class FleetReport(Judged):
    """What the calibrations of many arms say together. ``print`` shows the verdict, drifts, tools and parameters.

    Attributes:
        types: the arms by their nominal description.
        changes: (serial number, comparison of two consecutive calibrations of that arm).
        noticed: findings, worst first.
        verdict: marginal where a fit failed, an arm drifted, a tool is bad, or an arm is unlike its type; fail where
            all arms of a type failed.
    """

    types: tuple[ArmType, ...]
    changes: tuple[tuple[str, RobotChange], ...]
    noticed: tuple[Finding, ...]
    verdict: Verdict

    def section(self) -> Section:
        """Return the report's section."""
        drift = [
            Column("arm", "{0[0]}", number=False),
            Column("from", lambda one: Path(one[1].parts[0].before.name).name, False),
            Column("to", lambda one: Path(one[1].parts[0].after.name).name, False),
            Column("tool moved, mm rms", lambda one: f"{1e3 * _moved(one[1]).rms:.3g}"),
            Column("σ of that", lambda one: f"{1e3 * _moved(one[1]).expected:.2g}"),
            Column("p", lambda one: f"{one[1].geometry.probability:.1g}"),
            Column("", "{0[1].verdict.level}", number=False),
        ]
        blocks: list[Block] = [
            Text("Notes", lines_of(self.noticed), "note"),
            table("Arms calibrated more than once", drift, self.changes),
        ]
        for one in self.types:
            blocks += _tables(one)
        return Section("Fleet", blocks, self.verdict.level, self.verdict.reason)

    @checked
    def save(self, out: str | Path) -> Path:
        """Write a folder: report.html, metrics.json, and for each type a prior for the fit of its next arm."""
        out = Path(out)
        folders.check_target(out, OURS, (folders.METRICS,), "fleet report")
        folders.write_staged(out, OURS, self._write)
        for one in self.types:
            if one.parameters:
                prior.write(out / PRIOR / one.name, [each.robot for each in one.plausible], one.parameters)
        return out

    def _write(self, folder: Path) -> None:
        from calib.procedure.report.certificate.record import report
        from calib.procedure.report.certificate.rendering import html

        count = sum(len(one.arms) for one in self.types)
        files.write(folder / PAGE, html(report("Fleet", f"{count} arms", (), [self.section()])))
        files.write_json(folder / folders.METRICS, self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers as in ``metrics.json`` [SI]."""
        types = {
            one.name: {
                "arms": [each.name for each in one.arms],
                "failed": one.failed,
                "odd": one.odd,
                "parameters": one.parameters,
                "tools": one.tools,
            }
            for one in self.types
        }
        changes = [{"arm": arm} | one.to_dict() for arm, one in self.changes]
        return plain(
            {
                "verdict": self.verdict.level,
                "reason": self.verdict.reason,
                "types": types,
                "changes": changes,
                "noticed": self.noticed,
            }
        )


def _tables(one: ArmType) -> list[Block]:
    def cell(name: str) -> Column:
        return Column(name, lambda row: small(getattr(row, name), row.unit, 3))

    parameters = [
        Column("parameter", "{0.name}", number=False),
        Column("arms", "{0.arms}"),
        *map(cell, ("mean", "sigma", "width")),
    ]
    used = [
        Column("tool", "{0.tool}", number=False),
        Column("arms", lambda row: f"{len(row.arms)}"),
        Column("from the others' mm", lambda row: f"{1e3 * row.moved:.3g}"),
        Column("σ", "{0.moved_sigmas:.1f}"),
        Column("error, times the others'", "{0.times:.3g}"),
        Column("σ ", lambda row: f"{row.times_sigmas:.1f}" if row.times > MIN_TIMES else ""),
    ]
    arms = [
        Column("arm", lambda row: row.serial or row.name, number=False),
        Column("calibrated", "{0.name}", number=False),
        Column("verdict", "{0.judged[0]}", number=False),
        Column("rms mm", lambda row: f"{1e3 * row.left:.3g}"),
    ]
    note = "Deviations from nominal; the next arm is expected within width of the mean."
    compared = [row for row in one.tools if row.moved is not None]
    return [
        table(f"Arms of type {one.name}", arms, one.arms, most=20),
        table(f"Tools of {one.name}", used, compared),
        table(f"Parameters of {one.name}", parameters, one.parameters, note),
    ]


@checked
def report_fleet(calibrations: str | Path | Sequence[str | Path]) -> FleetReport:
    """Compare the calibrations of many arms.

    Args:
        calibrations: folders of fits or sessions. Sessions that state one serial number are of one arm, in order of
            their dates; a fit states none and counts as an arm of its own. Sessions without a verdict are left out.

    Returns:
        ``types`` with the distribution of each parameter, ``changes``, ``noticed``, `save`.

    Raises:
        UsageError: for a folder that holds no fit, or one given twice; where unfinished sessions leave one or none.
    """
    given = visits(calibrations)
    by_arm = given.by_arm
    usable = {arm: [one for one in own if not _failed(one)] for arm, own in by_arm.items()}
    changes = [(arm, diff(one.name, two.name)) for arm, own in usable.items() for one, two in pairwise(own)]
    types: list[list[Calibration]] = []
    for own in by_arm.values():
        alike = next((each for each in types if _same(each[0], own[-1])), None)
        if alike is None:
            types.append(alike := [])
        alike.append(own[-1])
    names = [each[0].chain.name for each in types]
    labels = [name if names.count(name) == 1 else f"{name}_{k + 1}" for k, name in enumerate(names)]
    made = tuple(_arm_type(label, each) for label, each in zip(labels, types))
    earlier = [_failure(one, 0.0) for own in by_arm.values() for one in own[:-1] if _failed(one)]
    noticed = settle([*given.noticed, *_findings(made, changes), *earlier])
    failed = sum(len(one.failed) for one in made)
    parts = [f"{counted(len(by_arm), 'arm')} of {counted(len(made), 'type')}", failed and f"{failed} failed"]
    words = ", ".join(filter(None, [*parts, f"{len(changes)} calibrated again"]))
    return FleetReport(made, tuple(changes), noticed, Verdict.of(words, noticed))


def _failed(one: Calibration) -> bool:
    return one.judged[0] == "fail"


def _failure(one: Calibration, share: float) -> Finding:
    """Return that a fit failed, and why; `share`: of the arms of its type whose fits did."""
    return finding("arm-failed", arm=one.name, reason=one.judged[1], share=share)


def _same(one: Calibration, two: Calibration) -> bool:
    with suppress(RobotError):
        check_same_robot((one.name, two.name), (one.robot, two.robot))
        return True
    return False


def _arm_type(name: str, arms: Sequence[Calibration]) -> ArmType:
    failed = tuple(one.name for one in arms if _failed(one))
    odd = tuple(one.name for one in arms if one.name not in failed and _farthest(one)[1] > 1.0)
    sound = [one.robot for one in arms if one.name not in (*failed, *odd) and one.robot.covariance is not None]
    used = {one.name: (one.cell.tool_names[0], one.cell.tools[0][:3, 3], one.left) for one in arms}
    return ArmType(name, tuple(arms), failed, odd, prior.spread(sound) if sound else (), tuple(tools(used)))


def _farthest(one: Calibration) -> tuple[str, float]:
    """Return the parameter farthest from nominal, and how far in what is plausible (`PLAUSIBLE`)."""
    nominal = one.robot.nominal or one.chain
    sizes = np.abs(one.chain.values - nominal.values) / [PLAUSIBLE[unit] for unit in nominal.units]
    k = int(sizes.argmax())
    return nominal.names[k], float(sizes[k])


def _moved(change: RobotChange) -> ToolMotion:
    assert change.geometry is not None
    return change.geometry.motions[0]


def _findings(types: Sequence[ArmType], changes: Sequence[tuple[str, RobotChange]]) -> list[Finding]:
    found = [
        finding("arm-drifts", arm=arm, moved=_moved(one).rms, reason=one.verdict.reason)
        for arm, one in changes
        if one.verdict.level in ("marginal", "fail")
    ]
    for one in types:
        found += [_failure(arm, len(one.failed) / len(one.arms)) for arm in one.arms if arm.name in one.failed]
        found += [
            finding("arm-marginal", arm=arm.name, reason=arm.judged[1])
            for arm in one.arms
            if arm.judged[0] == "marginal"
        ]
        if len(one.tools) == 1 and len(one.arms) >= sum(MIN_ARMS):
            at = np.array([arm.cell.tools[0][:3, 3] for arm in one.plausible or one.arms])
            away = np.linalg.norm(at - np.median(at, axis=0), axis=1).max()
            found.append(finding("tools-unnamed", type=one.name, tool=one.tools[0].tool, away=away))
        found += [
            finding("unlike-its-type", arm=arm.name, name=_farthest(arm)[0]) for arm in one.arms if arm.name in one.odd
        ]
        found += [each for tool in one.tools for each in tool.findings()]
    return found

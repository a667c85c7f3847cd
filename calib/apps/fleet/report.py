"""Report of a fleet: which arms drift, which share a bad tool, how parameters are distributed over arms of one type."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from calib import files, folders
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
from calib.records import plain
from calib.result_kinds import BY_NAME
from calib.toolkit.installations import PLAUSIBLE
from calib.toolkit.report_pages import Block, RecordColumn, Section, Text, table
from calib.toolkit.result_folders import Judged, Verdict, lines_of, settle
from calib.units import small

PAGE, PRIOR = "report.html", "prior"
# A row per arm.
ARMS = "fleet.csv"
ARMS_HEADER = ("type", "arm", "verdict", "in the distribution")
OURS = (PAGE, folders.METRICS, ARMS)


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
        return [arm for arm in self.arms if arm.name not in (*self.failed, *self.odd)]


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

    kind = BY_NAME["fleet"]

    types: tuple[ArmType, ...]
    changes: tuple[tuple[str, RobotChange], ...]
    noticed: tuple[Finding, ...]
    verdict: Verdict

    def section(self) -> Section:
        """Return the report's section."""
        drift = [
            RecordColumn("arm", "{0[0]}", number=False),
            RecordColumn("from", lambda arm_type: Path(arm_type[1].parts[0].before.name).name, False),
            RecordColumn("to", lambda arm_type: Path(arm_type[1].parts[0].after.name).name, False),
            RecordColumn("tool moved, mm rms", lambda arm_type: f"{1e3 * _moved(arm_type[1]).rms:.3g}"),
            RecordColumn("σ of that", lambda arm_type: f"{1e3 * _moved(arm_type[1]).expected:.2g}"),
            RecordColumn("p", lambda arm_type: f"{arm_type[1].geometry.probability:.1g}"),
            RecordColumn("", "{0[1].verdict.level}", number=False),
        ]
        blocks: list[Block] = [
            Text("Notes", lines_of(self.noticed), "note"),
            table("Arms calibrated more than once", drift, self.changes),
        ]
        for arm_type in self.types:
            blocks += _tables(arm_type)
        return Section("Fleet", blocks, self.verdict.level, self.verdict.reason)

    @checked
    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write a folder: report.html, fleet.csv (a row per arm), metrics.json; and for each type a prior.

        That is for the fit of the type's next arm.
        """
        out = Path(out)
        folders.check_target(out, OURS, (folders.METRICS,), "fleet report")
        folders.write_staged(out, OURS, self._write)
        for arm_type in self.types:
            if arm_type.parameters:
                prior.write(out / PRIOR / arm_type.name, [arm.robot for arm in arm_type.plausible], arm_type.parameters)
        return out

    def _write(self, folder: Path) -> None:
        from calib.toolkit.report_pages import as_html, report_page

        count = sum(len(arm_type.arms) for arm_type in self.types)
        files.write(folder / PAGE, as_html(report_page("Fleet", f"{count} arms", (), [self.section()])))
        arms = []
        for arm_type in self.types:
            usable = [arm.name for arm in arm_type.plausible]
            arms += [(arm_type.name, arm.name, arm.judged[0], arm.name in usable) for arm in arm_type.arms]
        files.write_table(folder / ARMS, ARMS_HEADER, arms)
        files.write_json(folder / folders.METRICS, self.to_dict())

    def to_dict(self) -> dict[str, object]:
        """Return the numbers as in ``metrics.json`` [SI]."""
        types = {
            item.name: {
                "arms": [calibration.name for calibration in item.arms],
                "failed": item.failed,
                "odd": item.odd,
                "parameters": item.parameters,
                "tools": item.tools,
            }
            for item in self.types
        }
        changes = [{"arm": arm} | item.to_dict() for arm, item in self.changes]
        return plain(
            {
                "verdict": self.verdict.level,
                "reason": self.verdict.reason,
                "types": types,
                "changes": changes,
                "noticed": self.noticed,
            }
        )


def _tables(arm_type: ArmType) -> list[Block]:
    def cell(name: str) -> RecordColumn:
        return RecordColumn(name, lambda row: small(getattr(row, name), row.unit, 3))

    parameters = [
        RecordColumn("parameter", "{0.name}", number=False),
        RecordColumn("arms", "{0.arms}"),
        *map(cell, ("mean", "sigma", "width")),
    ]
    tool_columns = [
        RecordColumn("tool", "{0.tool}", number=False),
        RecordColumn("arms", lambda row: f"{len(row.arms)}"),
        RecordColumn("from the others' mm", lambda row: f"{1e3 * row.moved:.3g}"),
        RecordColumn("σ", "{0.moved_sigmas:.1f}"),
        RecordColumn("error, times the others'", "{0.times:.3g}"),
        RecordColumn("σ ", lambda row: f"{row.times_sigmas:.1f}" if row.times > MIN_TIMES else ""),
    ]
    arms = [
        RecordColumn("arm", lambda row: row.serial or row.name, number=False),
        RecordColumn("calibrated", "{0.name}", number=False),
        RecordColumn("verdict", "{0.judged[0]}", number=False),
        RecordColumn("rms mm", lambda row: f"{1e3 * row.left:.3g}"),
    ]
    note = "Deviations from nominal; the next arm is expected within width of the mean."
    compared = [row for row in arm_type.tools if row.moved is not None]
    return [
        table(f"Arms of type {arm_type.name}", arms, arm_type.arms, most=20),
        table(f"Tools of {arm_type.name}", tool_columns, compared),
        table(f"Parameters of {arm_type.name}", parameters, arm_type.parameters, note),
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
    fleet_visits = visits(calibrations)
    by_arm = fleet_visits.by_arm
    usable = {
        arm: [calibration for calibration in calibrations_of_arm if not _failed(calibration)]
        for arm, calibrations_of_arm in by_arm.items()
    }
    changes = [
        (arm, diff(calibration.name, later.name))
        for arm, calibrations_of_arm in usable.items()
        for calibration, later in pairwise(calibrations_of_arm)
    ]
    types: list[list[Calibration]] = []
    for calibrations_of_arm in by_arm.values():
        alike = next((arms for arms in types if _same(arms[0], calibrations_of_arm[-1])), None)
        if alike is None:
            types.append(alike := [])
        alike.append(calibrations_of_arm[-1])
    names = [arms[0].chain.name for arms in types]
    labels = [name if names.count(name) == 1 else f"{name}_{k + 1}" for k, name in enumerate(names)]
    arm_types = tuple(_arm_type(label, arms) for label, arms in zip(labels, types))
    earlier = [
        _failure(calibration, 0.0)
        for calibrations_of_arm in by_arm.values()
        for calibration in calibrations_of_arm[:-1]
        if _failed(calibration)
    ]
    noticed = settle([*fleet_visits.noticed, *_findings(arm_types, changes), *earlier])
    failed = sum(len(calibration.failed) for calibration in arm_types)
    parts = [f"{counted(len(by_arm), 'arm')} of {counted(len(arm_types), 'type')}", failed and f"{failed} failed"]
    summary = ", ".join(filter(None, [*parts, f"{len(changes)} calibrated again"]))
    return FleetReport(arm_types, tuple(changes), noticed, Verdict.of(summary, noticed))


def _failed(calibration: Calibration) -> bool:
    return calibration.judged[0] == "fail"


def _failure(calibration: Calibration, share: float) -> Finding:
    """Return that a fit failed, and why; `share`: of the arms of its type whose fits did."""
    return finding("arm-failed", arm=calibration.name, reason=calibration.judged[1], share=share)


def _same(first: Calibration, second: Calibration) -> bool:
    with suppress(RobotError):
        check_same_robot((first.name, second.name), (first.robot, second.robot))
        return True
    return False


def _arm_type(name: str, arms: Sequence[Calibration]) -> ArmType:
    failed = tuple(calibration.name for calibration in arms if _failed(calibration))
    odd = tuple(
        calibration.name for calibration in arms if calibration.name not in failed and _farthest(calibration)[1] > 1.0
    )
    sound = [
        calibration.robot
        for calibration in arms
        if calibration.name not in (*failed, *odd) and calibration.robot.covariance is not None
    ]
    tool_uses = {
        calibration.name: (calibration.cell.tool_names[0], calibration.cell.tools[0][:3, 3], calibration.left)
        for calibration in arms
    }
    return ArmType(name, tuple(arms), failed, odd, prior.spread(sound) if sound else (), tuple(tools(tool_uses)))


def _farthest(calibration: Calibration) -> tuple[str, float]:
    """Return the parameter farthest from nominal, and how far in what is plausible (`PLAUSIBLE`)."""
    nominal = calibration.robot.nominal or calibration.chain
    sizes = np.abs(calibration.chain.values - nominal.values) / [PLAUSIBLE[unit] for unit in nominal.units]
    k = int(sizes.argmax())
    return nominal.names[k], float(sizes[k])


def _moved(change: RobotChange) -> ToolMotion:
    assert change.geometry is not None
    return change.geometry.motions[0]


def _findings(types: Sequence[ArmType], changes: Sequence[tuple[str, RobotChange]]) -> list[Finding]:
    findings = [
        finding("arm-drifts", arm=arm, moved=_moved(arm_type).rms, reason=arm_type.verdict.reason)
        for arm, arm_type in changes
        if arm_type.verdict.level in ("marginal", "fail")
    ]
    for arm_type in types:
        findings += [
            _failure(arm, len(arm_type.failed) / len(arm_type.arms))
            for arm in arm_type.arms
            if arm.name in arm_type.failed
        ]
        findings += [
            finding("arm-marginal", arm=arm.name, reason=arm.judged[1])
            for arm in arm_type.arms
            if arm.judged[0] == "marginal"
        ]
        if len(arm_type.tools) == 1 and len(arm_type.arms) >= sum(MIN_ARMS):
            at = np.array([arm.cell.tools[0][:3, 3] for arm in arm_type.plausible or arm_type.arms])
            away = np.linalg.norm(at - np.median(at, axis=0), axis=1).max()
            findings.append(finding("tools-unnamed", type=arm_type.name, tool=arm_type.tools[0].tool, away=away))
        findings += [
            finding("unlike-its-type", arm=arm.name, name=_farthest(arm)[0])
            for arm in arm_type.arms
            if arm.name in arm_type.odd
        ]
        findings += [tool_finding for tool in arm_type.tools for tool_finding in tool.findings()]
    return findings

"""Report of a fleet: arms that drift, bent or loose tools, and how parameters vary over arms of one type."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from calib import files, folders
from calib.apps.fleet import arm_distribution
from calib.apps.fleet.arm_distribution import ParameterSpread
from calib.apps.fleet.tools import MIN_ARMS, MIN_TIMES, ToolUse, tools
from calib.apps.fleet.visits import visits
from calib.apps.monitoring.comparison.calibration_sources import check_same_robot
from calib.apps.monitoring.comparison.geometry_calibration import Calibration
from calib.apps.monitoring.comparison.geometry_change import ToolMotion
from calib.apps.monitoring.comparison.robot_change import RobotChange, diff
from calib.arguments import checked
from calib.config_types import Plots
from calib.errors import Finding, RobotError, counted, finding
from calib.records import plain
from calib.result_kinds import BY_NAME
from calib.toolkit.installations import PLAUSIBLE
from calib.toolkit.report_pages import Block, RecordColumn, Section, Text, table
from calib.toolkit.result_folders import ReportedResult, Verdict, notes_of, settle
from calib.units import small

PAGE, PRIOR = "report.html", "prior"
# A row per arm.
ARMS = "fleet.csv"
ARMS_HEADER = ("type", "arm", "verdict", "in the distribution")
OURS = (PAGE, folders.METRICS, ARMS)


@dataclass(frozen=True, eq=False)
class ArmType:
    """Arms of one nominal description, each with its latest calibration.

    Attributes:
        name: name of the description, with a number appended where several descriptions have one name.
        arms: the latest calibration of each arm.
        failed: names of arms whose fit has the verdict fail; not used for `parameters`.
        odd: names of further arms whose geometry is not plausible for this type; not used for `parameters`.
        parameters: distribution of each parameter over all other arms.
        tools: comparison of the tools that all arms carry.
    """

    name: str
    arms: tuple[Calibration, ...]
    failed: tuple[str, ...]
    odd: tuple[str, ...]
    parameters: tuple[ParameterSpread, ...]
    tools: tuple[ToolUse, ...]

    @property
    def plausible(self) -> list[Calibration]:
        """Calibrations of the arms that were used for `parameters`: neither failed nor odd."""
        return [arm for arm in self.arms if arm.name not in (*self.failed, *self.odd)]


@dataclass(frozen=True, eq=False)
class FleetReport(ReportedResult):
    """Comparison of the calibrations of many arms. ``print`` shows the verdict, drifts, tools and parameters.

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
        """Return the report's section with tables of drifts, tools and parameters."""
        drift = [
            RecordColumn("arm", "{0[0]}", number=False),
            RecordColumn("from", _earlier_folder, False),
            RecordColumn("to", _later_folder, False),
            RecordColumn("tool moved, mm rms", _moved_mm),
            RecordColumn("expected from σ", _expected_mm),
            RecordColumn("p", "{0[1].geometry.probability:.1g}"),
            RecordColumn("", "{0[1].verdict.level}", number=False),
        ]
        blocks: list[Block] = [
            Text("Notes", notes_of(self.noticed), "note"),
            table("Arms calibrated more than once", drift, self.changes),
        ]
        for arm_type in self.types:
            blocks += _tables(arm_type)
        return Section("Fleet", blocks, self.verdict.level, self.verdict.reason)

    @checked
    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Write the report into a folder and return its path.

        The folder contains report.html, fleet.csv (a row per arm) and metrics.json, and for each type a prior for the
        fit of the type's next arm.

        Args:
            out: the folder.
            plots: whether figures are drawn.
        """
        out = Path(out)
        folders.check_target(out, OURS, (folders.METRICS,), "fleet report")
        folders.write_staged(out, OURS, self._write)
        for arm_type in self.types:
            if arm_type.parameters:
                robots = [arm.robot for arm in arm_type.plausible]
                arm_distribution.write(out / PRIOR / arm_type.name, robots, arm_type.parameters)
        return out

    def _write(self, folder: Path) -> None:
        from calib.toolkit.report_pages import as_html, report_page

        count = 0
        for arm_type in self.types:
            count += len(arm_type.arms)
        page = report_page("Fleet", f"{count} arms", (), [self.section()])
        files.write(folder / PAGE, as_html(page))
        rows = []
        for arm_type in self.types:
            usable = [arm.name for arm in arm_type.plausible]
            rows += [(arm_type.name, arm.name, arm.judged[0], arm.name in usable) for arm in arm_type.arms]
        files.write_table(folder / ARMS, ARMS_HEADER, rows)
        files.write_json(folder / folders.METRICS, self.to_dict())

    def to_dict(self) -> dict[str, object]:
        """Return the report's numbers as ``metrics.json`` contains them [SI]."""
        types = {}
        for arm_type in self.types:
            types[arm_type.name] = {
                "arms": [arm.name for arm in arm_type.arms],
                "failed": arm_type.failed,
                "odd": arm_type.odd,
                "parameters": arm_type.parameters,
                "tools": arm_type.tools,
            }
        changes = []
        for arm, change in self.changes:
            changes.append({"arm": arm} | change.to_dict())
        numbers = {
            "verdict": self.verdict.level,
            "reason": self.verdict.reason,
            "types": types,
            "changes": changes,
            "noticed": self.noticed,
        }
        return plain(numbers)


def _earlier_folder(row: tuple[str, RobotChange]) -> str:
    return Path(row[1].parts[0].before.name).name


def _later_folder(row: tuple[str, RobotChange]) -> str:
    return Path(row[1].parts[0].after.name).name


def _moved_mm(row: tuple[str, RobotChange]) -> str:
    return f"{1e3 * _tool_motion(row[1]).rms:.3g}"


def _expected_mm(row: tuple[str, RobotChange]) -> str:
    return f"{1e3 * _tool_motion(row[1]).expected:.2g}"


def _tables(arm_type: ArmType) -> list[Block]:
    parameters = [
        RecordColumn("parameter", "{0.name}", number=False),
        RecordColumn("arms", "{0.arms}"),
        RecordColumn("mean", _mean),
        RecordColumn("sigma", _sigma),
        RecordColumn("width", _width),
    ]
    tool_columns = [
        RecordColumn("tool", "{0.tool}", number=False),
        RecordColumn("arms", _arm_count),
        RecordColumn("from the others' mm", _displacement_mm),
        RecordColumn("σ", "{0.moved_sigmas:.1f}"),
        RecordColumn("error, times the others'", "{0.times:.3g}"),
        RecordColumn("σ ", _error_sigmas),
    ]
    arms = [
        RecordColumn("arm", _serial_or_name, number=False),
        RecordColumn("calibrated", "{0.name}", number=False),
        RecordColumn("verdict", "{0.judged[0]}", number=False),
        RecordColumn("rms mm", _residual_mm),
    ]
    note = "Deviations from nominal; the next arm is expected within width of the mean."
    compared = [row for row in arm_type.tools if row.moved is not None]
    return [
        table(f"Arms of type {arm_type.name}", arms, arm_type.arms, most=20),
        table(f"Tools of {arm_type.name}", tool_columns, compared),
        table(f"Parameters of {arm_type.name}", parameters, arm_type.parameters, note),
    ]


def _mean(row: ParameterSpread) -> str:
    return small(row.mean, row.unit, 3)


def _sigma(row: ParameterSpread) -> str:
    return small(row.sigma, row.unit, 3)


def _width(row: ParameterSpread) -> str:
    return small(row.width, row.unit, 3)


def _arm_count(row: ToolUse) -> str:
    return f"{len(row.arms)}"


def _displacement_mm(row: ToolUse) -> str:
    assert row.moved is not None
    return f"{1e3 * row.moved:.3g}"


def _error_sigmas(row: ToolUse) -> str:
    """Return as text how many σ the errors with a tool exceed those with other tools.

    Empty if they do not exceed them.

    Args:
        row: comparison of arms with the tool against arms with other tools.
    """
    assert row.times is not None
    if row.times > MIN_TIMES:
        return f"{row.times_sigmas:.1f}"
    return ""


def _serial_or_name(arm: Calibration) -> str:
    return arm.serial or arm.name


def _residual_mm(arm: Calibration) -> str:
    return f"{1e3 * arm.residual_rms:.3g}"


@checked
def report_fleet(calibrations: str | Path | Sequence[str | Path]) -> FleetReport:
    """Compare the calibrations of many arms.

    Args:
        calibrations: folders of fits or sessions. Sessions with one serial number are calibrations of one arm, in order
            of their dates; a fit has no serial number and counts as a separate arm. Sessions without a verdict are left
            out.

    Returns:
        The report: ``types`` with the distribution of each parameter, ``changes``, ``noticed``, `save`.

    Raises:
        UsageError: a folder without a fit or given twice, or fewer than two finished calibrations.
    """
    fleet_visits = visits(calibrations)
    changes: list[tuple[str, RobotChange]] = []
    types: list[list[Calibration]] = []
    earlier_failures = []
    failed_count = 0
    for serial, visits_of_arm in fleet_visits.by_arm.items():
        sound = [calibration for calibration in visits_of_arm if not _failed(calibration)]
        for before, after in pairwise(sound):
            changes.append((serial, diff(before.name, after.name)))
        latest = visits_of_arm[-1]
        _arms_of_type(types, latest).append(latest)
        earlier_failures += [_failure(calibration, 0.0) for calibration in visits_of_arm[:-1] if _failed(calibration)]

    names = [arms[0].chain.name for arms in types]
    arm_types = []
    for k, (name, arms) in enumerate(zip(names, types)):
        label = name
        if names.count(name) > 1:
            label = f"{name}_{k + 1}"
        arm_type = _arm_type(label, arms)
        failed_count += len(arm_type.failed)
        arm_types.append(arm_type)

    noticed = settle([*fleet_visits.noticed, *_findings(arm_types, changes), *earlier_failures])
    parts = [f"{counted(len(fleet_visits.by_arm), 'arm')} of {counted(len(arm_types), 'type')}"]
    if failed_count:
        parts.append(f"{failed_count} failed")
    parts.append(f"{len(changes)} calibrated again")
    verdict = Verdict.of(", ".join(parts), noticed)
    return FleetReport(tuple(arm_types), tuple(changes), noticed, verdict)


def _arms_of_type(types: list[list[Calibration]], calibration: Calibration) -> list[Calibration]:
    """Return the list in `types` of the arms with this arm's nominal description.

    Where there is no such list, an empty one is appended to `types` and returned.

    Args:
        types: lists of calibrations, each of arms with one nominal description.
        calibration: calibration of the arm.
    """
    for arms in types:
        with suppress(RobotError):
            check_same_robot((arms[0].name, calibration.name), (arms[0].robot, calibration.robot))
            return arms
    types.append([])
    return types[-1]


def _failed(calibration: Calibration) -> bool:
    return calibration.judged[0] == "fail"


def _failure(calibration: Calibration, share: float) -> Finding:
    """Return the finding that an arm's fit failed.

    Args:
        calibration: the arm's calibration.
        share: share of the arms of its type whose fits failed, from 0 to 1.
    """
    return finding("arm-failed", arm=calibration.name, reason=calibration.judged[1], share=share)


def _arm_type(name: str, arms: Sequence[Calibration]) -> ArmType:
    failed: list[str] = []
    odd: list[str] = []
    robots = []
    tool_uses = {}
    for arm in arms:
        tool_uses[arm.name] = (arm.cell.tool_names[0], arm.cell.tools[0][:3, 3], arm.residual_rms)
        if _failed(arm):
            failed.append(arm.name)
        elif _farthest(arm)[1] > 1.0:
            odd.append(arm.name)
        elif arm.robot.covariance is not None:
            robots.append(arm.robot)
    parameters: tuple[ParameterSpread, ...] = ()
    if robots:
        parameters = arm_distribution.spread(robots)
    return ArmType(name, tuple(arms), tuple(failed), tuple(odd), parameters, tuple(tools(tool_uses)))


def _farthest(calibration: Calibration) -> tuple[str, float]:
    """Return the name of the parameter that is farthest from nominal, and its deviation.

    The deviation is divided by the plausible one for the parameter's unit (`PLAUSIBLE`).

    Args:
        calibration: calibration of the arm.
    """
    nominal = calibration.robot.nominal or calibration.chain
    plausible = [PLAUSIBLE[unit] for unit in nominal.units]
    sizes = np.abs(calibration.chain.values - nominal.values) / plausible
    k = int(sizes.argmax())
    return nominal.names[k], float(sizes[k])


def _tool_motion(change: RobotChange) -> ToolMotion:
    assert change.geometry is not None
    return change.geometry.motions[0]


def _findings(types: Sequence[ArmType], changes: Sequence[tuple[str, RobotChange]]) -> list[Finding]:
    findings = []
    for serial, change in changes:
        if change.verdict.level in ("marginal", "fail"):
            motion = _tool_motion(change)
            findings.append(finding("arm-drifts", arm=serial, moved=motion.rms, reason=change.verdict.reason))
    for arm_type in types:
        share = len(arm_type.failed) / len(arm_type.arms)
        findings += [_failure(arm, share) for arm in arm_type.arms if arm.name in arm_type.failed]
        for arm in arm_type.arms:
            if arm.judged[0] == "marginal":
                findings.append(finding("arm-marginal", arm=arm.name, reason=arm.judged[1]))
        # one name for the tools of so many arms: the fits were not told which tool is which
        if len(arm_type.tools) == 1 and len(arm_type.arms) >= sum(MIN_ARMS):
            positions = np.array([arm.cell.tools[0][:3, 3] for arm in arm_type.plausible or arm_type.arms])
            distances = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
            tool = arm_type.tools[0].tool
            findings.append(finding("tools-unnamed", type=arm_type.name, tool=tool, away=distances.max()))
        for arm in arm_type.arms:
            if arm.name in arm_type.odd:
                findings.append(finding("unlike-its-type", arm=arm.name, name=_farthest(arm)[0]))
        for tool in arm_type.tools:
            findings += tool.findings()
    return findings

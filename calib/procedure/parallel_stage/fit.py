"""Fit the geometry of a parallel robot to a CSV of encoder readings, with platform poses beside them or without.

Columns: one per actuated joint, by its name [rad or m, or the unit in brackets behind it]; and, where the platform was
measured, one per coordinate of its freedom (``x [mm]``, ``rz [deg]``), counted from home in the base's axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.csv_table import Table, read_table
from calib.errors import MeasurementError, UsageError
from calib.mechanism.closure import NoPosture
from calib.mechanism.geometric_fit import LoopFit, fit_loops, platform_errors
from calib.mechanism.parallel_robot import COORDINATES, ParallelRobot
from calib.procedure.parallel_stage.robots import FoundRobot


@dataclass(frozen=True, eq=False)
class ParallelFit:
    """A geometric calibration and its files.

    Attributes:
        nominal: the robot before.
        files: that were read.
        found: the calibration.
        errors: rms of platform coordinates (2, r), nominal and calibrated, over `judged`; None without platform poses.
        judged: which rows: "unseen" of validation files, else "fitted".
    """

    nominal: FoundRobot
    files: tuple[Path, ...]
    found: LoopFit
    errors: np.ndarray | None
    judged: str

    def metrics(self) -> dict[str, Any]:
        """Return the content of ``metrics.json``."""
        robot, found = self.nominal.known.robot, self.found
        errors = None
        if self.errors is not None:
            errors = {
                k: dict(zip(robot.freedom, row.tolist())) for k, row in zip(("nominal", "calibrated"), self.errors)
            }
        return {
            "robot": robot.name, "parameters": len(found.parameters), "not_told": list(found.vague),
            "reading_rms": {"nominal": found.before, "calibrated": found.after}, "platform_rms": errors,
            "judged_on": self.judged, "iterations": found.iterations,
        }  # fmt: skip

    def lines(self) -> list[str]:
        """Return what the command prints."""
        robot, found = self.nominal.known.robot, self.found
        told = len(found.parameters) - len(found.vague)
        lines = [
            f"{robot.name}: {len(found.parameters)} constants of the loops, {told} told by the data; encoders off by "
            f"{found.before:.3g}, calibrated by {found.after:.3g} (rms, rad or m)"
        ]
        for k, name in enumerate(robot.freedom if self.errors is not None else ()):
            factor, unit = (1e3, "mm") if name in COORDINATES[:3] else (1e3, "mrad")
            before, after = factor * self.errors[:, k]  # type: ignore[index]
            lines.append(f"  platform {name} on {self.judged} rows: {before:.3g} -> {after:.3g} {unit} rms")
        if self.errors is None:
            lines.append(
                "from readings alone: scale and place of the whole robot are the nominal ones; what encoders "
                "contradict each other by is mended"
            )
        return lines


def fit_parallel(robot: FoundRobot, measured: Sequence[Path], validate: Sequence[Path] = ()) -> ParallelFit:
    """Fit the geometry of a parallel robot to measured files.

    Raises:
        MeasurementError: for columns that are missing, or rows that no posture reaches.
        Unidentifiable: for readings alone of a robot without redundant encoders.
    """
    known = robot.known
    readings, coordinates = _stacked([read_rows(path, known.robot) for path in measured], measured)
    try:
        found = fit_loops(known, readings, coordinates)
    except NoPosture as error:
        raise MeasurementError(f"{error}", measured[0]) from error
    unseen = _stacked([read_rows(path, known.robot) for path in validate], validate) if validate else None
    judged = (readings, coordinates) if unseen is None else unseen
    errors = None
    if judged[1] is not None:
        errors = np.array([
            np.sqrt(np.mean(platform_errors(one, judged[0], judged[1]) ** 2, axis=0)) for one in (known, found.known)
        ])  # fmt: skip
    what = "fitted" if unseen is None else "unseen"
    return ParallelFit(robot, tuple(measured), found, errors, what)


def read_rows(path: Path, robot: ParallelRobot) -> tuple[np.ndarray, np.ndarray | None]:
    """Return readings (m, n) and platform coordinates (m, r), None where the file has no such columns.

    Raises:
        MeasurementError: naming the column that is missing, and which there are.
    """
    table = read_table(path)
    readings = [table.numbers(joint.name, "angle" if joint.kind == "revolute" else "length") for joint in robot.joints]
    present = [name for name in robot.freedom if name in table]
    _refuse_others(table, robot, path)
    if not present:
        return np.column_stack(readings), None
    columns = [table.numbers(name, "length" if name in COORDINATES[:3] else "angle") for name in robot.freedom]
    return np.column_stack(readings), np.column_stack(columns)


def _refuse_others(table: Table, robot: ParallelRobot, path: Path) -> None:
    passive = [joint.name for leg in robot.legs for joint in leg.chain.joints if joint.name not in robot.joint_names]
    for name in table.header:
        if name in passive:
            raise MeasurementError(
                f"column '{name}' is of a passive joint, whose encoder the fit does not know yet; leave it out", path
            )


def _stacked(
    parts: Sequence[tuple[np.ndarray, np.ndarray | None]], paths: Sequence[Path]
) -> tuple[np.ndarray, np.ndarray | None]:
    with_poses = [own is not None for _, own in parts]
    if any(with_poses) != all(with_poses):
        bare = paths[with_poses.index(False)]
        raise UsageError(f"{bare} has no platform coordinates, other files have: fit them apart")
    readings = np.concatenate([own for own, _ in parts])
    return readings, np.concatenate([own for _, own in parts if own is not None]) if all(with_poses) else None

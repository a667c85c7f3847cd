"""The two calibrations that are compared, read from folders of fits, sessions, or from a robot's description."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from calib.errors import RobotError, UsageError, command_line, listing, require
from calib.folders import METRICS, SESSION
from calib.geometry import installation
from calib.geometry.installation import Installation
from calib.geometry.observation import layout
from calib.procedure.kinematic_stage import tables
from calib.procedure.kinematic_stage.folder import FitFolder
from calib.procedure.kinematic_stage.metrics import ComparedRows, FitMetrics
from calib.procedure.session.folder import open_session
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain, Deflection
from calib.robot.chain import Chain, Element
from calib.robot.library import load_calibrated

SAME = 1e-9  # of two nominal descriptions: largest difference [m, rad] that rounding in files explains


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration of a robot.

    Attributes:
        name: as the user gave it.
        robot: the calibrated arm; the nominal one of a description.
        cell: that arm in its cell, with joint corrections.
        free, covariance: of steps along the cell's fitted parameters (`calib.geometry.observation`); empty if nominal.
        learnt: (m, n) the fitted poses [rad or m]; None if nominal.
        metrics: of the fit; None if nominal.
        judged: level and reason of its verdict; empty if nominal.
        rows: errors on unseen poses, else on the fitted ones; None if nominal.
        tolerance: asked of the fit [m]; None without.
        serial: of the robot, as its certificate states it; empty if unknown.
    """

    name: str
    robot: CalibratedChain
    cell: Installation
    free: np.ndarray
    covariance: np.ndarray
    learnt: np.ndarray | None = None
    metrics: FitMetrics | None = None
    judged: tuple[str, str] = ("", "")
    rows: ComparedRows | None = None
    tolerance: float | None = None
    serial: str = ""

    @property
    def nominal(self) -> bool:
        """Whether this is a robot's description, and nothing was fitted."""
        return self.metrics is None

    @property
    def chain(self) -> Chain:
        """The geometry without joint corrections."""
        return self.robot.chain

    @cached_property
    def rigid(self) -> tuple[Installation, np.ndarray]:
        """The cell with the geometry that was fitted without joint corrections, and the covariance (p, p) of its arm.

        The covariance is by the cell's whole parameter vector, zero for what is not of the arm.
        """
        cell = replace(self.cell, chain=self.chain, deflection=Deflection())
        result, arm = np.zeros((len(layout(cell).names),) * 2), len(self.chain.elements)
        if self.robot.covariance is not None:
            result[:arm, :arm] = self.robot.covariance
        return cell, result

    @cached_property
    def whole(self) -> tuple[Installation, np.ndarray]:
        """The cell with all that was fitted, and the covariance (p, p) of its whole parameter vector."""
        result = np.zeros((len(layout(self.cell).names),) * 2)
        result[np.ix_(self.free, self.free)] = self.covariance
        return self.cell, result

    @property
    def left(self) -> float:
        """Rms error [m] that this calibration leaves on its rows without joint corrections; 0 if nominal."""
        errors = self.rows and self.rows.judged("urdf").main
        return 1e-3 * errors.rms if errors else 0.0


def read_pair(before: str | Path, after: str | Path) -> tuple[Calibration, Calibration]:
    """Return two calibrations of one robot: each from the folder of a fit or a session, or one nominal from its file.

    Raises:
        UsageError: where neither is a fit, or a folder holds none.
        RobotError: where they are of different robots.
    """
    fitted = [_is_fitted(Path(each)) for each in (before, after)]
    words = f"neither {before} nor {after} is the folder of a fit or of a session; give at least one"
    require(any(fitted), words, UsageError)
    given = [read(each, Path(each)) if known else None for each, known in zip((before, after), fitted)]
    chain = next(each.chain for each in given if each is not None)
    one, two = (each or _nominal(name, chain) for each, name in zip(given, (before, after)))
    check_same(one, two)
    return one, two


def _is_fitted(path: Path) -> bool:
    if not path.is_dir():
        return False
    words = f"{path} is neither the folder of a fit (robot.toml, {METRICS}) nor of a session ({SESSION})"
    require((path / SESSION).exists() or FitFolder(path).robot.exists(), words, UsageError)
    return True


def read(name: str | Path, path: Path) -> Calibration:
    """Return the calibration in the folder of a fit or a session; `name`: as the user gave it.

    Raises:
        UsageError: where the folder holds none.
    """
    session = open_session(path) if (path / SESSION).exists() else None
    folder = session.fit if session else FitFolder(path)
    go_on = command_line("next", path)
    words = f"{path}: this session does not fit the geometry" if session and not session.geometric else ""
    words = words or (f"{path} has no fitted geometry yet: {go_on}" if session else f"{path} is not a fit's folder")
    require((folder.path / METRICS).exists() and (folder.path / tables.folders.ESTIMATE).exists(), words, UsageError)
    metrics, cell = folder.metrics(), installation.read(folder.path)
    judged = session.validation.metrics() if session and (session.validation.judged).exists() else metrics
    unseen = [rows for rows in judged.validation.values() if rows.unseen]
    free, covariance = tables.read_covariance(folder.path, cell)
    robot = calibrated.read(folder.path)
    asked = session.settings.fit.tolerance_mm if session else metrics.tolerance_mm
    serial = session.settings.certificate.robot_serial if session else ""
    return Calibration(
        str(name), robot, cell, free, covariance, folder.learnt_joints(robot.chain.joints), metrics,
        (judged.verdict, judged.reason), (unseen or [metrics.fit])[0], 1e-3 * asked if asked else None, serial,
    )  # fmt: skip


def _nominal(name: str | Path, like: Chain) -> Calibration:
    """Return the robot of a description, between a calibrated one's links, as a calibration without covariance."""
    links = {"base": like.base, "tip": like.tip} if str(name).endswith(".urdf") else {}
    robot = CalibratedChain(load_calibrated(name, **links).chain)
    return Calibration(str(name), robot, Installation(robot.chain), np.zeros(0, dtype=int), np.zeros((0, 0)))


def check_same(one: Calibration, two: Calibration) -> None:
    """Refuse two calibrations whose nominal descriptions differ."""
    first, second = ((each.robot.nominal or each.chain) for each in (one, two))
    both = f"{one.name} and {two.name} are of different robots"
    for what in ("joint_names", "names"):
        mine, other = getattr(first, what), getattr(second, what)
        strange = [name for name in (*mine, *other) if (name in mine) != (name in other)]
        kind = "joints" if what == "joint_names" else "parameters"
        words = f"{both} ({first.name}, {second.name}): {kind} {listing(strange, 5)} exist in one of them only"
        require(mine == other, words if strange else f"{both}: their {kind} are in another order", RobotError)
    away = np.abs(first.values - second.values)
    away = np.maximum(away, [np.abs(_placed(a) - _placed(b)).max() for a, b in zip(first.elements, second.elements)])
    moved = [name for name, size in zip(first.names, away) if size > SAME]
    tail = np.abs(first.tail - second.tail).max()
    words = f"{both}: the nominal {listing(moved or ['tip'], 5)} differ; fit both from one description"
    require(not moved and tail <= SAME, words, RobotError)


def _placed(element: Element) -> np.ndarray:
    return np.eye(4) if element.placement is None else element.placement

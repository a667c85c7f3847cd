"""A calibration of a robot's geometry, read from a fit's folder or a robot description, for comparison with another."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calib.apps.monitoring.comparison.calibration_sources import Place, check_same_robot
from calib.toolkit.chains import CalibratedChain, Chain, Deflection, load_calibrated, read_calibrated
from calib.toolkit.installations import Installation, layout, read_installation
from calib.toolkit.result_folders import ComparedRows, FitMetrics, read_covariance


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration of a robot's geometry.

    Attributes:
        name: folder, file or name that the user gave.
        robot: the calibrated arm; for a robot description, the nominal one.
        cell: the arm with stations and tools, and with joint corrections.
        free, covariance: indices of the fitted parameters in the cell's parameter vector, and the covariance of small
            steps along them (`calib.geometry.observation`); empty if nominal.
        fitted_joints: (m, n) joint values of the fitted poses [rad or m]; None if nominal.
        metrics: metrics of the fit; None if nominal.
        judged: level and reason of the fit's verdict; within a session, of the verdict on held-out poses; empty if
            nominal.
        rows: errors at held-out poses, or at the fitted poses if none were held out; None if nominal.
        tolerance: tolerance that was required of the fit [m]; None without one.
        serial: serial number of the robot, as its certificate states it; empty if unknown.
    """

    name: str
    robot: CalibratedChain
    cell: Installation
    free: np.ndarray
    covariance: np.ndarray
    fitted_joints: np.ndarray | None = None
    metrics: FitMetrics | None = None
    judged: tuple[str, str] = ("", "")
    rows: ComparedRows | None = None
    tolerance: float | None = None
    serial: str = ""

    @property
    def nominal(self) -> bool:
        """Whether the robot is a description without any fitted parameter."""
        return self.metrics is None

    @property
    def chain(self) -> Chain:
        """The arm's geometry without joint corrections."""
        return self.robot.chain

    @cached_property
    def rigid(self) -> tuple[Installation, np.ndarray]:
        """The cell without joint corrections, and the covariance (p, p) of the arm's parameters.

        The covariance is over the cell's whole parameter vector; it is zero for stations and tools.
        """
        cell = replace(self.cell, chain=self.chain, deflection=Deflection())
        count = len(layout(cell).names)
        arm = len(self.chain.elements)
        covariance = np.zeros((count, count))
        if self.robot.covariance is not None:
            covariance[:arm, :arm] = self.robot.covariance
        return cell, covariance

    @cached_property
    def with_corrections(self) -> tuple[Installation, np.ndarray]:
        """The cell with all fitted parameters, and the covariance (p, p) of the cell's whole parameter vector."""
        count = len(layout(self.cell).names)
        covariance = np.zeros((count, count))
        covariance[np.ix_(self.free, self.free)] = self.covariance
        return self.cell, covariance

    @property
    def residual_rms(self) -> float:
        """Rms residual of this calibration at the poses of `rows`, without joint corrections [m]; 0 if nominal."""
        if self.rows is None:
            return 0.0
        errors = self.rows.judged("urdf").main
        if errors is None:
            return 0.0
        return 1e-3 * errors.rms


def read_fits(before: Place, after: Place) -> tuple[Calibration, Calibration]:
    """Return two calibrations of one robot, read from their folders; one of the two may be nominal.

    Args:
        before, after: sources of the earlier and of the later calibration.

    Raises:
        RobotError: the calibrations are of different robots.
    """
    earlier = later = None
    if before.fit:
        earlier = read_fit(before)
    if after.fit:
        later = read_fit(after)
    if earlier is None:
        assert later is not None
        earlier = _nominal(before.name, later.chain)
    elif later is None:
        later = _nominal(after.name, earlier.chain)
    check_same_robot((earlier.name, later.name), (earlier.robot, later.robot))
    return earlier, later


def read_fit(source: Place) -> Calibration:
    """Return the calibration in the folder of a fit or of a session.

    Args:
        source: the folder; its fit must exist.
    """
    folder = source.fit
    assert folder is not None
    metrics = folder.metrics()
    verdict_metrics = metrics
    tolerance_mm = metrics.tolerance_mm
    if source.session:
        # A session's verdict is that of its validation, by the tolerance that its settings state today.
        tolerance_mm = source.session.settings.fit.tolerance_mm
        if source.session.validation.judged.exists():
            verdict_metrics = source.session.validation.metrics()
    tolerance = None
    if tolerance_mm:
        tolerance = 1e-3 * tolerance_mm
    rows = metrics.fit
    for compared_rows in verdict_metrics.validation.values():
        if compared_rows.unseen:
            rows = compared_rows
            break

    cell = read_installation(folder.path)
    free, covariance = read_covariance(folder.path, cell)
    robot = read_calibrated(folder.path)
    return Calibration(
        name=source.name,
        robot=robot,
        cell=cell,
        free=free,
        covariance=covariance,
        fitted_joints=folder.learnt_joints(robot.chain.joints),
        metrics=metrics,
        judged=(verdict_metrics.verdict, verdict_metrics.reason),
        rows=rows,
        tolerance=tolerance,
        serial=source.serial,
    )


def _nominal(name: str, like: Chain) -> Calibration:
    """Return the nominal robot `name` as a calibration without covariance.

    Args:
        name: file or name of the robot.
        like: chain of the other calibration, whose base and tip links are used for this robot, too.
    """
    base = tip = None
    if name.endswith(".urdf"):
        base = like.base
        tip = like.tip
    robot = CalibratedChain(load_calibrated(name, base, tip).chain)
    nothing_free = np.zeros(0, dtype=int)
    return Calibration(name, robot, Installation(robot.chain), nothing_free, np.zeros((0, 0)))

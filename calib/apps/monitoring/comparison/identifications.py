"""An identified dynamic model of a robot, read from its folder, for comparison with another one."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib import folders
from calib.apps.monitoring.comparison.calibration_sources import Place, check_same_robot
from calib.errors import UsageError, require
from calib.toolkit.chains import CalibratedChain, read_calibrated
from calib.toolkit.pose_data import read_table
from calib.toolkit.torque_models import (
    Dynamics,
    IdentificationModel,
    estimated_columns,
    read_model_table,
    standard_name,
)
from calib.units import TORQUE


@dataclass(frozen=True, eq=False)
class MotionStates:
    """States along a motion.

    Attributes:
        t: (N,) times [s].
        motion: q, v and a, each (N, n).
        measured: (N, rows) measured torques; None if none were measured.
    """

    t: np.ndarray
    motion: tuple[np.ndarray, np.ndarray, np.ndarray]
    measured: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Identified:
    """An identified dynamic model.

    Attributes:
        name: folder that the user gave.
        robot: the arm with whose geometry the model was identified.
        dynamics: the model and its parameter values.
        names, units: names and units of the b estimated parameters.
        columns: (b,) indices of their columns in the regressor.
        covariance: (b, b) covariance, including the part due to uncertain geometry; zero for parameters that were not
            measured.
        regrouping: key of a base parameter to its linear combination: standard parameter to coefficient.
        motions: held-out motions by name; the fitted motion if none was held out.
        unit: unit of the torques.
        judged: level and reason of the verdict.
        tolerance: largest accepted unexplained share of the torque [%]; 0: none.
        serial: serial number of the robot; empty if unknown.
    """

    name: str
    robot: CalibratedChain
    dynamics: Dynamics
    names: tuple[str, ...]
    units: tuple[str, ...]
    columns: np.ndarray
    covariance: np.ndarray
    regrouping: Mapping[Hashable, Mapping[str, float]]
    motions: Mapping[str, MotionStates]
    unit: str
    judged: tuple[str, str]
    tolerance: float
    serial: str

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the torque rows."""
        return tuple(self.model.torque_rows.titles(self.robot.chain.joint_names))

    @property
    def model(self) -> IdentificationModel:
        return self.dynamics.model

    @property
    def values(self) -> np.ndarray:
        """Values (b,) of the estimated parameters."""
        return self.dynamics.values[self.columns]

    @property
    def keys(self) -> list[Hashable]:
        """Keys that match each estimated parameter between models.

        The key is the standard name of the parameter; for friction terms it also contains the form of the term.
        """
        return [_key(self.model, k) for k in self.columns]


def read_models(before: Place, after: Place) -> tuple[Identified, Identified]:
    """Return two identified models of one robot, each read from its folder.

    Args:
        before, after: sources of the earlier and of the later model.

    Raises:
        UsageError: the torques are of different kinds or units.
        RobotError: the models are of different robots.
    """
    earlier = _read(before)
    later = _read(after)
    check_same_robot((earlier.name, later.name), (earlier.robot, later.robot))
    kind_before = f"{earlier.model.torque_rows.name} in {earlier.unit}"
    kind_after = f"{later.model.torque_rows.name} in {later.unit}"
    kinds = f"torques of {kind_before} and of {kind_after}"
    message = f"{earlier.name} and {later.name}: {kinds} cannot be compared; identify both alike"
    require(kind_before == kind_after, message, UsageError)
    return earlier, later


def _read(source: Place) -> Identified:
    folder = source.identification
    assert folder is not None
    dynamics = folder.dynamics()
    table = read_model_table(folder.path)
    names, covariance = folders.read_covariance(folder.path)
    measured = ~np.isin(names, folder.metrics().switched_off)

    standard = dynamics.model.names
    unit_of = dict(zip(standard, dynamics.model.units))
    units = [unit_of[standard_name(name, standard)] for name in names]
    regrouping = {}
    for name, row in table["regrouping"].items():
        column = standard.index(standard_name(name, standard))
        regrouping[_key(dynamics.model, column)] = row

    motions = {}
    for path in folder.torques:
        states = read_states(path, dynamics.model.n)
        if states:
            motions[f"{source.name}/{path.name}"] = states
    tolerance_percent = 0.0
    if source.session:
        tolerance_percent = source.session.settings.dynamics.tolerance_percent
    verdict = folder.judged
    return Identified(
        name=source.name,
        robot=read_calibrated(folder.path),
        dynamics=dynamics,
        names=names,
        units=tuple(units),
        columns=estimated_columns(dynamics, names),
        covariance=covariance * np.outer(measured, measured),
        regrouping=regrouping,
        motions=motions,
        unit=table.get("unit", TORQUE),
        judged=(verdict.verdict, verdict.reason),
        tolerance=tolerance_percent,
        serial=source.serial,
    )


def _key(model: IdentificationModel, column: int) -> Hashable:
    name = model.names[column]
    if column < model.inertial:
        return name
    term = model.columns[column - model.inertial]
    return name, term.shape, term.settings


def read_states(path: Path, joints: int) -> MotionStates | None:
    """Return the states of a motion from a table; None if the table lacks positions, velocities or accelerations.

    Columns ``measured_…`` are the torques, if there are any.

    Args:
        path: CSV file with columns ``q_…``, ``v_…``, ``a_…``.
        joints: number of joints.

    Raises:
        UsageError: a number of joints other than `joints`.
    """
    table = read_table(path)
    q = table.block("q")
    v = table.block("v")
    a = table.block("a")
    if q is None or v is None or a is None:
        return None
    message = f"{path}: columns q_…, v_… and a_… of {joints} joints each are needed"
    require(q.shape[1] == v.shape[1] == a.shape[1] == joints, message, UsageError)
    t = np.arange(len(q), dtype=float)
    if "t" in table.header:
        t = table.numbers("t", None)
    return MotionStates(t, (q, v, a), table.block("measured"))

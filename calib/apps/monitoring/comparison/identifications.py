"""An identified model of a robot's dynamics that is compared with another one, read from its folder."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib import folders
from calib.apps.monitoring.comparison.places import Place, check_same_robot
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
    """States of a motion: times (N,) [s], q, v, a (N, n), and the torques (N, rows) measured there, if any."""

    t: np.ndarray
    motion: tuple[np.ndarray, np.ndarray, np.ndarray]
    measured: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Identified:
    """An identified model.

    Attributes:
        name: as the user gave it.
        robot: on whose geometry it was identified.
        dynamics: model and values.
        names, units: of the b estimated parameters.
        columns: (b,) of the regressor.
        covariance: (b, b), geometry's part included; zero for what was not measured.
        regrouping: key of a base parameter -> standard parameter -> coefficient.
        motions: unseen ones, else the fitted one.
        unit: of the torques.
        judged: level and reason of the verdict.
        tolerance: largest accepted share of the torque that is unexplained [%]; 0: none.
        serial: of the robot; empty if unknown.
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
        """The estimate (b,)."""
        return self.dynamics.values[self.columns]

    @property
    def keys(self) -> list[Hashable]:
        """What each estimated parameter is: its standard name, that of a drive's term with its form."""
        return [_key(self.model, k) for k in self.columns]


def read_models(before: Place, after: Place) -> tuple[Identified, Identified]:
    """Return two identified models of one robot, each read from its folder.

    Raises:
        UsageError: where their torques are of different kinds.
        RobotError: where they are of different robots.
    """
    earlier, later = _read(before), _read(after)
    check_same_robot((earlier.name, later.name), (earlier.robot, later.robot))
    kinds = [(model.unit, model.model.torque_rows.name) for model in (earlier, later)]
    message = f"{earlier.name} and {later.name}: torques of {{}} and of {{}} cannot be compared; identify both alike"
    require(kinds[0] == kinds[1], message.format(*(" in ".join(kind[::-1]) for kind in kinds)), UsageError)
    return earlier, later


def _read(place: Place) -> Identified:
    folder, session = place.identification, place.session
    assert folder is not None
    dynamics, metrics, table = folder.dynamics(), folder.metrics(), read_model_table(folder.path)
    names, covariance = folders.read_covariance(folder.path)
    measured = ~np.isin(names, metrics.switched_off)
    standard = dynamics.model.names
    regrouping = {
        _key(dynamics.model, standard.index(standard_name(name, standard))): row
        for name, row in table["regrouping"].items()
    }
    units = dict(zip(standard, dynamics.model.units))
    verdict, tables = folder.judged, {f"{place.name}/{path.name}": path for path in folder.torques}
    motions = {name: read_states(path, dynamics.model.n) for name, path in tables.items()}
    return Identified(
        place.name,
        read_calibrated(folder.path),
        dynamics,
        names,
        tuple(units[standard_name(name, standard)] for name in names),
        estimated_columns(dynamics, names),
        covariance * np.outer(measured, measured),
        regrouping,
        {name: states for name, states in motions.items() if states},
        table.get("unit", TORQUE),
        (verdict.verdict, verdict.reason),
        session.settings.dynamics.tolerance_percent if session else 0.0,
        place.serial,
    )


def _key(model: IdentificationModel, column: int) -> Hashable:
    name = model.names[column]
    if column < model.inertial:
        return name
    term = model.columns[column - model.inertial]
    return name, term.shape, term.settings


def read_states(path: Path, joints: int) -> MotionStates | None:
    """Return the states of a motion, with the torques ``measured_…`` if there are any, from a table; None without v, a.

    Raises:
        UsageError: for another number of joints.
    """
    table = read_table(path)
    q, v, a, measured = (table.block(name) for name in ("q", "v", "a", "measured"))
    if q is None or v is None or a is None:
        return None
    message = f"{path}: columns q_…, v_… and a_… of {joints} joints each are needed"
    require({block.shape[1] for block in (q, v, a)} == {joints}, message, UsageError)
    t = table.numbers("t", None) if "t" in table.header else np.arange(len(q), dtype=float)
    return MotionStates(t, (q, v, a), measured)

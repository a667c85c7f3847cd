"""The fastest motion of a parallel robot through platform waypoints, within its actuators' speeds and torques.

Waypoints are the rows of a CSV in their order. The columns are either the platform's coordinates (``x [mm]``, ``rz
[deg]``), counted from home in the base's axes, or the readings of all actuators under their names. The path is a spline
through the waypoints in the platform's coordinates, or, if the settings ask for lines, straight between waypoints. Its
timing is that of serial arms (`calib.trajectories.timing.time_scaling`), computed on the actuators' motion along the
path. Torques of redundant actuators are those of least norm, plus the identified preload.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from calib.api.motions import MotionPlan
from calib.config_types import Plots
from calib.data.csv_table import read_table
from calib.errors import MeasurementError, NoPosture, UsageError, refuse_data, refuse_option
from calib.parallel.design_goal import read_model
from calib.parallel.excite import actuator_bounds, write_motion
from calib.parallel.loop_fit import read_coordinates, read_rows
from calib.parallel.mechanism.closure import ClosedRobot, coordinates_of
from calib.parallel.mechanism.parallel_model import ParallelModel
from calib.parallel.robots import ParallelMechanism, refuse_unread
from calib.procedure.excitation.settings import DEFAULT_PLAN, PlanSettings
from calib.procedure.robot_kinds import joints_of
from calib.records import shaped
from calib.robot.chain import Chain
from calib.trajectories.setpoints import joined
from calib.trajectories.timing.path import Path as JointPath
from calib.trajectories.timing.path import check_within, spline, through
from calib.trajectories.timing.path_limits import TimingLimits
from calib.trajectories.timing.profile import track
from calib.trajectories.timing.time_scaling import time_optimal

FRICTIONLESS = "friction unknown (no model): a real robot needs more torque than planned"
# Names of the settings that apply to parallel robots.
READ = ("payloads", "lines", "rate")
# Smoothing of Coulomb's sign along a path [rad/s or m/s]: nearly none, since the direction of motion is known.
SIGN_SMOOTHING = 1e-9
# Length [m] that a radian counts as in the length of a path (our choice).
LEVER = 0.1
# Number of points per span of a path at which the actuators are solved for.
POINTS_PER_SPAN = 100


@dataclass(frozen=True, eq=False)
class _PlatformDynamics:
    """Dynamics along a path of the actuated joints: actuator torques for time-optimal planning.

    Attributes:
        model: model of the robot.
        values: (p,) values of the model's parameters.
        carried: labels of the payloads on board.
    """

    model: ParallelModel
    values: np.ndarray
    carried: tuple[str, ...] = ()

    def along(
        self, q: np.ndarray, slope: np.ndarray, curvature: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return A, B, Γ, each (N, n), with the torque A s̈ + B ṡ² + Γ along a path with the parameter s.

        Args:
            q: (N, n) joint values at N points of the path.
            slope, curvature: (N, n) first and second derivatives of the joint values by s.
        """
        still = np.zeros_like(q)
        rigid = np.where(self._rubbing(), 0.0, self.values)
        gravity = self._torque(rigid, q, still, still)
        inertial = self._torque(rigid, q, still, slope)
        torque = self._torque(rigid, q, slope, curvature)
        return inertial - gravity, torque - gravity, gravity

    def friction(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the actuator torques (N, n) against friction, including that of passive joints."""
        rubbing = self._rubbing() & (self.values != 0.0)
        if rubbing.any():
            friction_values = np.where(rubbing, self.values, 0.0)
            return self._torque(friction_values, q, v, a)
        return np.zeros_like(q)

    def torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the actuator torques (N, n) of a motion q, v, a (N, n) of the actuated joints."""
        return self._torque(self.values, q, v, a)

    def _torque(self, values: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        motion = self.model.moved(q, v, a)
        return self.model.actuator_torques(values, motion, self.carried)

    def _rubbing(self) -> np.ndarray:
        """Return whether each parameter is one of friction, (p,) bool."""
        rubs = [column.shape in ("velocity", "sign") for column in self.model.columns]
        inertial = [False] * self.model.inertial
        return np.array(inertial + rubs)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ParallelPlan(MotionPlan):
    """A planned motion of a parallel robot; the fields of the plan refer to the actuators.

    Attributes:
        robot: the robot, with its file.
        coordinates: (N, r) platform coordinates along the motion [m, rad].
    """

    robot: ParallelMechanism
    coordinates: np.ndarray

    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Write the result folder of `calib plan`."""
        from calib.procedure.report.outputs import write_plan

        def write_figures(target: Path) -> None:
            if plots:
                write_plan(self, target, plots)

        metrics = self.to_dict()
        return write_motion(self.robot, Path(out), self.track, self.coordinates, self.bounds, metrics, write_figures)

    def to_dict(self) -> dict[str, object]:
        """Return the metrics of ``metrics.json``."""
        track: Any = self.track
        peak_torque = np.abs(track.tau).max(axis=0)
        peak_speed = np.abs(track.v).max(axis=0)
        metrics = super().to_dict()
        metrics["robot"] = self.robot.chain.name
        metrics["peak_torque"] = peak_torque.tolist()
        metrics["peak_speed"] = peak_speed.tolist()
        return metrics


def plan_parallel(
    robot: ParallelMechanism,
    waypoints: Path | np.ndarray,
    settings: PlanSettings = DEFAULT_PLAN,
    *,
    model: Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> ParallelPlan:
    """Return the fastest motion of a parallel robot through waypoints.

    Args:
        robot: the robot.
        waypoints: a CSV file (columns: see the module), or platform coordinates (m, r) [m, rad].
        settings: payloads, lines and rate; other settings apply to serial arms only.
        model: folder of an identification of the same robot; None: the inertias of the robot's file, without friction.
        progress: function called with a line of text; None: none.

    Raises:
        UsageError: for options that apply to serial arms only, waypoints outside the platform's box, or actuators
            without limits.
        NoPosture: for a path that leaves the workspace; the message names the position.
    """
    mechanism = robot.mechanism
    refuse_unread(settings, DEFAULT_PLAN, READ)
    law = _law(robot, model, settings.payloads)
    bounds = actuator_bounds(mechanism)
    limits = TimingLimits(bounds.velocity, bounds.acceleration, bounds.torque)
    points = _read_waypoints(waypoints, mechanism)
    if progress is not None:
        progress("the path")
    paths = _paths(mechanism, points, settings.lines)
    for path in paths:
        check_within(path, mechanism.robot.lower, mechanism.robot.upper, points)
    actuator_paths = [_of_actuators(mechanism, path) for path in paths]
    if progress is not None:
        progress("timing")
    timings = []
    tracks = []
    for path in actuator_paths:
        timing = time_optimal(path, limits, law, rate=settings.rate)
        timings.append(timing)
        tracks.append(track(timing.path, timing.profile, settings.rate, law.torque))
    motion = joined(tracks)
    posture = mechanism.locate(motion.q)
    coordinates = coordinates_of(mechanism, posture)
    notes: tuple[str, ...] = ()
    if model is None:
        notes = (FRICTIONLESS,)
    joints = joints_of(mechanism.robot)
    return ParallelPlan(
        chain=cast(Chain, mechanism.robot),
        bounds=bounds,
        limits=limits,
        lower=joints.lower,
        upper=joints.upper,
        timings=tuple(timings),
        track=motion,
        notes=notes,
        robot=robot,
        coordinates=coordinates,
    )


def _read_waypoints(path: Path | np.ndarray, mechanism: ClosedRobot) -> np.ndarray:
    """Return the platform coordinates (m, r) of waypoints: an array of them, or a CSV (see the module).

    Raises:
        MeasurementError: for missing columns, or readings at which the loops do not close.
    """
    if not isinstance(path, Path):
        return shaped(path, (None, len(mechanism.robot.freedom)), "waypoints")
    table = read_table(path)
    if any(name in table for name in mechanism.robot.freedom):
        return read_coordinates(table, mechanism.robot)
    if not any(name in table for name in mechanism.robot.joint_names):
        refuse_data(
            path,
            f"neither the platform's coordinates ({', '.join(mechanism.robot.freedom)}) nor the actuators "
            f"({', '.join(mechanism.robot.joint_names)}) are among its columns: {', '.join(table.header)}",
        )
    try:
        rows = read_rows(path, mechanism.robot)
        readings = rows[:, : mechanism.robot.n]
        posture = mechanism.locate(readings)
        return coordinates_of(mechanism, posture)
    except NoPosture as error:
        raise MeasurementError(f"waypoint out of reach: {error}; move it", path) from error


def _law(robot: ParallelMechanism, folder: Path | None, payloads: tuple[str, ...]) -> _PlatformDynamics:
    """Return the dynamics for planning, with some payloads on board.

    Args:
        robot: the robot.
        folder: folder of an identification; None: the inertias of the robot's file, without friction.
        payloads: labels of the payloads on board.

    Raises:
        UsageError: for payloads that were not identified.
    """
    if folder is None and payloads:
        raise UsageError(f"payloads {', '.join(payloads)}: only an identified model has payloads; give --model")
    model, values = read_model(robot, folder)
    unknown = sorted(set(payloads) - set(model.payloads))
    if unknown:
        refuse_option(folder, f"no payload '{unknown[0]}' was identified; known: {', '.join(model.payloads) or 'none'}")
    terms = []
    for term in model.terms:
        if term.shape == "sign":
            term = replace(term, settings=(SIGN_SMOOTHING,))
        terms.append(term)
    path_model = replace(model, terms=tuple(terms))
    return _PlatformDynamics(path_model, values, payloads)


def _paths(mechanism: ClosedRobot, points: np.ndarray, lines: bool) -> list[JointPath]:
    """Return the path through waypoints (m, r) in platform coordinates: a spline, or with `lines` a line per span."""
    scale = np.where(mechanism.robot.selected < 3, 1.0, 1.0 / LEVER)
    if not lines:
        return [spline(points, scale=scale)]
    if len(points) < 2:
        return [spline(points)]
    return [spline(points[k : k + 2], scale=scale) for k in range(len(points) - 1)]


def _of_actuators(mechanism: ClosedRobot, path: JointPath) -> JointPath:
    """Return the path of the actuated joints that corresponds to a path in platform coordinates.

    Raises:
        UsageError: if the path leaves the workspace.
    """
    spans = len(path.knots) - 1
    positions = np.linspace(0.0, spans, POINTS_PER_SPAN * spans + 1)
    s = np.interp(positions, np.arange(spans + 1), path.knots)
    try:
        posture = mechanism.place(path(s))
    except NoPosture as error:
        raise UsageError(f"the path leaves the workspace: {error}; move or add waypoints") from error
    dense = through(posture.q[:, mechanism.robot.actuated], s)
    return JointPath(dense.derivative, path.knots)

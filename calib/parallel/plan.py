"""The fastest motion of a parallel robot through platform waypoints, within its actuators' speeds and torques.

Waypoints are a CSV, a row each, in order: the platform's coordinates (``x [mm]``, ``rz [deg]``), counted from home in
the base's axes; or readings of all actuators under their names. The path is a spline through them in the platform's
coordinates (a straight line between each two, where asked for); its timing is that of serial arms
(`calib.trajectories.timing.time_scaling`) on the actuators' own motion along it, redundant torques those of least norm
with
the identified preload.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from calib.api.motions import MotionPlan
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
# of the settings
READ = ("payloads", "lines", "rate")


@dataclass(frozen=True, eq=False)
class _PlatformDynamics:
    """Dynamics along a path of the actuated joints: actuator torques for time-optimal planning.

    Attributes:
        model: model of the robot; values: (p,) of its parameters.
        carried: payloads carried.
    """

    model: ParallelModel
    values: np.ndarray
    carried: tuple[str, ...] = ()

    def along(
        self, q: np.ndarray, slope: np.ndarray, curvature: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return A, B, Γ, each (N, n), as `calib.dynamics.path_dynamics.PathDynamics.along`."""
        still = np.zeros_like(q)
        rigid = np.where(self._rubbing(), 0.0, self.values)
        gravity = self._torque(rigid, q, still, still)
        torque = self._torque(rigid, q, slope, curvature)
        return self._torque(rigid, q, still, slope) - gravity, torque - gravity, gravity

    def friction(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the actuator torques (N, n) against friction, including that of passive joints."""
        rubbing = self._rubbing() & (self.values != 0.0)
        if rubbing.any():
            return self._torque(np.where(rubbing, self.values, 0.0), q, v, a)
        return np.zeros_like(q)

    def torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the actuator torques (N, n) of a motion q, v, a (N, n) of the actuated joints."""
        return self._torque(self.values, q, v, a)

    def _torque(self, values: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        return self.model.actuator_torques(values, self.model.moved(q, v, a), self.carried)

    def _rubbing(self) -> np.ndarray:
        rubs = [column.shape in ("velocity", "sign") for column in self.model.columns]
        return np.array([False] * self.model.inertial + rubs)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ParallelPlan(MotionPlan):
    """A planned motion of a parallel robot; the fields of the plan refer to the actuators.

    Attributes:
        robot: the robot, with its file.
        coordinates: (N, r) platform coordinates along the motion [m, rad].
    """

    robot: ParallelMechanism
    coordinates: np.ndarray

    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write the result folder of `calib plan`."""
        from calib.procedure.report import motion_figures

        def write_figures(target: Path) -> None:
            if plots:
                motion_figures.write_plan(self, target)

        metrics = self.to_dict()
        return write_motion(self.robot, Path(out), self.track, self.coordinates, self.bounds, metrics, write_figures)

    def to_dict(self) -> dict[str, object]:
        """Return the metrics of ``metrics.json``."""
        track: Any = self.track
        return super().to_dict() | {
            "robot": self.robot.chain.name,
            "peak_torque": np.abs(track.tau).max(axis=0).tolist(),
            "peak_speed": np.abs(track.v).max(axis=0).tolist(),
        }


def plan_parallel(
    robot: ParallelMechanism,
    waypoints: Path | np.ndarray,
    settings: PlanSettings = DEFAULT_PLAN,
    *,
    model: Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> ParallelPlan:
    """Return the fastest motion of a parallel robot through the waypoints of a file.

    Args:
        settings: payloads, lines and rate; other settings apply to serial arms only.
        model: folder of an identification of the same robot; None: the file's inertias, without friction.

    Raises:
        UsageError: for options that apply to serial arms only, waypoints outside the platform's box, or actuators
            without limits.
        NoPosture: for a path that leaves the workspace; the message names the position.
    """
    say = progress or (lambda message: None)
    mechanism = robot.mechanism
    refuse_unread(settings, DEFAULT_PLAN, READ)
    law = _law(robot, model, settings.payloads)
    bounds = actuator_bounds(mechanism)
    limits = TimingLimits(bounds.velocity, bounds.acceleration, bounds.torque)
    points = _read_waypoints(waypoints, mechanism)
    say("the path")
    paths = _paths(mechanism, points, settings.lines)
    for path in paths:
        check_within(path, mechanism.robot.lower, mechanism.robot.upper, points)
    actuator_paths = [_of_actuators(mechanism, path) for path in paths]
    say("timing")
    timings = tuple(time_optimal(path, limits, law, rate=settings.rate) for path in actuator_paths)
    motion = joined([track(timing.path, timing.profile, settings.rate, law.torque) for timing in timings])
    joints = joints_of(mechanism.robot)
    return ParallelPlan(
        chain=cast(Chain, mechanism.robot),
        bounds=bounds,
        limits=limits,
        lower=joints.lower,
        upper=joints.upper,
        timings=timings,
        track=motion,
        notes=() if model else (FRICTIONLESS,),
        robot=robot,
        coordinates=coordinates_of(mechanism, mechanism.locate(motion.q)),
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
        readings = read_rows(path, mechanism.robot)[:, : mechanism.robot.n]
        return coordinates_of(mechanism, mechanism.locate(readings))
    except NoPosture as error:
        raise MeasurementError(f"waypoint out of reach: {error}; move it", path) from error


def _law(robot: ParallelMechanism, folder: Path | None, payloads: tuple[str, ...]) -> _PlatformDynamics:
    """Return the identified dynamics, or those of the file's inertias, with the given payloads."""
    if folder is None and payloads:
        raise UsageError(f"payloads {', '.join(payloads)}: only an identified model has payloads; give --model")
    model, values = read_model(robot, folder)
    unknown = sorted(set(payloads) - set(model.payloads))
    if unknown:
        refuse_option(folder, f"no payload '{unknown[0]}' was identified; known: {', '.join(model.payloads) or 'none'}")
    # smoothing of Coulomb's sign: along a path its direction is known
    smoothing = 1e-9
    terms = []
    for term in model.terms:
        if term.shape == "sign":
            term = replace(term, settings=(smoothing,))
        terms.append(term)
    return _PlatformDynamics(replace(model, terms=tuple(terms)), values, payloads)


def _paths(mechanism: ClosedRobot, points: np.ndarray, lines: bool, lever: float = 0.1) -> list[JointPath]:
    # lever: of the base's size that a radian counts as in the length of a path (our choice)
    scale = np.where(mechanism.robot.selected < 3, 1.0, 1.0 / lever)
    if not lines:
        return [spline(points, scale=scale)]
    if len(points) < 2:
        return [spline(points)]
    return [spline(points[k : k + 2], scale=scale) for k in range(len(points) - 1)]


def _of_actuators(mechanism: ClosedRobot, path: JointPath, places_per_span: int = 100) -> JointPath:
    """Return the path of the actuated joints that corresponds to a path in platform coordinates.

    `places_per_span`: number of points per span at which the actuators are solved for.
    """
    spans = len(path.knots) - 1
    s = np.interp(np.linspace(0.0, spans, places_per_span * spans + 1), np.arange(spans + 1), path.knots)
    try:
        posture = mechanism.place(path(s))
    except NoPosture as error:
        raise UsageError(f"the path leaves the workspace: {error}; move or add waypoints") from error
    dense = through(posture.q[:, mechanism.robot.actuated], s)
    return JointPath(dense.derivative, path.knots)

"""Plan the fastest motion of a parallel robot through platform waypoints, within its actuators' speeds and torques.

Waypoints are a CSV, a row each, in order: the platform's coordinates (``x [mm]``, ``rz [deg]``), counted from home in
the base's axes; or readings of all actuators under their names. The path is a spline through them in the platform's
coordinates (a straight line between each two, where asked for); its timing is that of serial arms
(`trajectories.timing.time_scaling`) on the actuators' own motion along it, redundant torques those of least norm.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from calib.data.csv_table import read_table
from calib.errors import MeasurementError, NoPosture, UsageError, refuse_data, refuse_option
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.coefficients import PLANNED
from calib.procedure.excitation.motion_bounds import MotionBounds
from calib.procedure.excitation.settings import DEFAULT_PLAN, PlanSettings
from calib.procedure.robot_kinds import refuse_unread
from calib.rooms.parallel.excite import actuator_bounds, read_model
from calib.rooms.parallel.loop_fit import read_coordinates, read_rows
from calib.rooms.parallel.mechanism.closure import ClosedRobot, coordinates_of
from calib.rooms.parallel.mechanism.parallel_model import ParallelModel, make_parallel_model
from calib.rooms.parallel.mechanism.velocities import distributed
from calib.rooms.parallel.results import ParallelResult, ResultFolder, write_motion
from calib.rooms.parallel.robots import ParallelMechanism
from trajectories.setpoints import Setpoints, joined
from trajectories.timing.limits import TimingLimits
from trajectories.timing.path import Path as JointPath
from trajectories.timing.path import check_within, spline, through
from trajectories.timing.profile import track
from trajectories.timing.time_scaling import Timing, time_optimal

READ = ("payloads", "lines", "rate")  # of the settings


@dataclass(frozen=True, eq=False)
class _PlatformDynamics:
    """Actuator torques along a path of their own joints; a `trajectories.timing.limits.Law`.

    Attributes:
        model: of the robot; values (p,) of its parameters.
        carried: payloads on board.
    """

    model: ParallelModel
    values: np.ndarray
    carried: tuple[str, ...] = ()

    def along(
        self, q: np.ndarray, slope: np.ndarray, curvature: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return A, B, Γ, each (N, n), as `calib.dynamics.path_dynamics.PathDynamics.along`."""
        still, rigid = np.zeros_like(q), np.where(self._rubbing(), 0.0, self.values)
        gravity = self._torque(rigid, q, still, still)
        moved = self._torque(rigid, q, slope, curvature)
        return self._torque(rigid, q, still, slope) - gravity, moved - gravity, gravity

    def friction(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the actuator torques (N, n) that overcome friction, of passive joints too."""
        rubbing = self._rubbing() & (self.values != 0.0)
        return self._torque(np.where(rubbing, self.values, 0.0), q, v, a) if rubbing.any() else np.zeros_like(q)

    def torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the actuator torques (N, n) of a motion q, v, a (N, n) of the actuated joints."""
        return self._torque(self.values, q, v, a)

    def _torque(self, values: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        motion = self.model.moved(q, v, a)
        return distributed(self.model.known, motion.jacobians, self.model.platform_force(values, motion, self.carried))

    def _rubbing(self) -> np.ndarray:
        own = [one.shape in ("velocity", "sign") for one in self.model.terms]
        return np.array([False] * self.model.inertial + own)


@dataclass(frozen=True, eq=False, repr=False)
class ParallelPlan(ParallelResult):
    """A planned motion of a parallel robot.

    Attributes:
        robot: with its file.
        bounds: what limits its actuators, and where that is stated.
        timings: one for all waypoints, or one per straight line.
        track: of the actuators at the controller's rate, with torques where a model is known.
        coordinates: (N, r) of the platform along it [m, rad].
        notes: what a user should know.
    """

    robot: ParallelMechanism
    bounds: MotionBounds
    timings: tuple[Timing, ...]
    track: Setpoints
    coordinates: np.ndarray
    notes: tuple[str, ...]
    folder: ClassVar = ResultFolder((PLANNED, coefficients.NAME), (PLANNED,), "motion")

    @property
    def duration(self) -> float:
        """How long the motion takes [s]."""
        return self.track.duration

    def write(self, folder: Path, plots: bool) -> None:
        """Write the motion at the controller's rate."""
        write_motion(self.robot, self.bounds, self.track, self.coordinates, folder)

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as ``metrics.json`` holds them."""
        tau, margins = self.track.tau, [one.margins for one in self.timings]
        return {
            "robot": self.robot.known.robot.name,
            "duration": self.duration,
            "paths": [one.duration for one in self.timings],
            "margins": {kind: np.min([own[kind] for own in margins], axis=0).tolist() for kind in margins[0]},
            "peak_torque": None if tau is None else np.abs(tau).max(axis=0).tolist(),
            "peak_speed": np.abs(self.track.v).max(axis=0).tolist(),
            "limits": self.bounds.lines(),
            "notes": list(self.notes),
        }

    def lines(self) -> list[str]:
        """Return what the command prints."""
        robot = self.robot.known.robot
        lines = [f"{robot.name}: {self.duration:.4g} s through the waypoints, {len(self.track)} samples"]
        for kind, unit in (("velocity", "of the speed limits"), ("torque", "of the torque limits")):
            used = [one.margins[kind] for one in self.timings if kind in one.margins]
            if used:
                share = 1.0 - np.min(used, axis=0)
                named = ", ".join(f"{name} {100 * x:.0f} %" for name, x in zip(robot.joint_names, share))
                lines.append(f"most {unit} in use: {named}")
        return [*lines, *self.bounds.lines(), *self.notes]

    def __repr__(self) -> str:
        return f"<ParallelPlan for {self.robot.known.robot.name}: {self.duration:g} s>"


def plan_parallel(
    robot: ParallelMechanism,
    waypoints: Path,
    settings: PlanSettings = DEFAULT_PLAN,
    *,
    model: Path | None = None,
    limits: Path | None = None,
    drives: Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> ParallelPlan:
    """Plan the fastest motion of a parallel robot through the waypoints of a file.

    Args:
        settings: payloads, lines and rate; the others are for serial arms.
        model: folder of an identification of the same robot; None: the file's inertias, without friction.

    Raises:
        UsageError: for options that only serial arms know, waypoints out of the platform's box, no limits to keep.
        NoPosture: for a path that leaves the workspace, naming the place.
    """
    say, known = progress or (lambda words: None), robot.known
    refuse_unread(settings, DEFAULT_PLAN, READ)
    if limits is not None or drives is not None:
        raise UsageError("limits and drives are in a parallel robot's own file (velocity, effort) and in its model")
    law, notes = _law(robot, model, settings)
    bounds = actuator_bounds(known, law is not None)
    kept = TimingLimits(bounds.velocity, bounds.acceleration, bounds.torque)
    points = _read_waypoints(waypoints, known)
    say("the path")
    paths = _paths(known, points, settings.lines)
    for path in paths:
        check_within(path, known.robot.lower, known.robot.upper, points)
    own = [_of_actuators(known, path) for path in paths]
    say("timing")
    timings = tuple(time_optimal(path, kept, law, rate=settings.rate) for path in own)
    torque = None if law is None else law.torque
    motion = joined([track(one.path, one.profile, settings.rate, torque) for one in timings])
    return ParallelPlan(robot, bounds, timings, motion, coordinates_of(known, known.locate(motion.q)), notes)


def _read_waypoints(path: Path, known: ClosedRobot) -> np.ndarray:
    """Return the platform coordinates (m, r) of waypoints in a CSV (see the module).

    Raises:
        MeasurementError: for columns that are missing, and readings that no posture has.
    """
    table = read_table(path)
    if any(name in table for name in known.robot.freedom):
        return read_coordinates(table, known.robot)
    if not any(name in table for name in known.robot.joint_names):
        refuse_data(path, f"neither the platform's coordinates ({', '.join(known.robot.freedom)}) nor the actuators "
            f"({', '.join(known.robot.joint_names)}) are among its columns: {', '.join(table.header)}")  # fmt: skip
    try:
        return coordinates_of(known, known.locate(read_rows(path, known.robot).readings))
    except NoPosture as error:
        raise MeasurementError(f"waypoint out of reach: {error}", path) from error


def _law(
    robot: ParallelMechanism, folder: Path | None, settings: PlanSettings
) -> tuple[_PlatformDynamics | None, tuple[str, ...]]:
    """Return the dynamics: identified, or the file's inertias; None without any."""
    if folder is None:
        if settings.payloads:
            raise UsageError(f"payloads {', '.join(settings.payloads)}: they are identified ones: name the model")
        model = make_parallel_model(robot.known, ("",))
        values = model.known_parameters()
        if values is None:
            return None, ()
        return _PlatformDynamics(model, values), (
            "friction not known (no model): planned without, a real robot needs more torque",
        )
    model, values = read_model(robot, folder)
    if unknown := sorted(set(settings.payloads) - set(model.payloads)):
        refuse_option(
            folder, f"no payload '{unknown[0]}' was identified; it knows {', '.join(model.payloads) or 'none'}"
        )
    smoothing = 1e-9  # smoothing of Coulomb's sign: along a path its direction is known
    terms = tuple(replace(one, settings=(smoothing,)) if one.shape == "sign" else one for one in model.terms)
    return _PlatformDynamics(replace(model, terms=terms), values, settings.payloads), ()


def _paths(known: ClosedRobot, points: np.ndarray, lines: bool, lever: float = 0.1) -> list[JointPath]:
    # lever: of the base's size that a radian counts as in the length of a path (our choice)
    scale = np.where(known.robot.selected < 3, 1.0, 1.0 / lever)
    if not lines:
        return [spline(points, scale=scale)]
    return [spline(points[k : k + 2], scale=scale) for k in range(len(points) - 1)] or [spline(points)]


def _of_actuators(known: ClosedRobot, path: JointPath, places_per_span: int = 100) -> JointPath:
    """Return the path of the actuated joints along one of the platform's coordinates.

    `places_per_span`: places per span of the path at which the actuators are solved for.
    """
    spans = len(path.knots) - 1
    s = np.interp(np.linspace(0.0, spans, places_per_span * spans + 1), np.arange(spans + 1), path.knots)
    try:
        posture = known.place(path(s))
    except NoPosture as error:
        raise UsageError(f"the path leaves the workspace: {error}; move or add waypoints") from error
    dense = through(posture.q[:, known.robot.actuated], s)
    return JointPath(dense.derivative, path.knots)

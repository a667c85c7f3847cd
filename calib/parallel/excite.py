"""Design of an exciting motion of a parallel robot: the search for serial arms, applied to platform coordinates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.api.motions import ExcitationDesign, Sampled
from calib.config_types import Plots
from calib.errors import UsageError, one_of, require
from calib.folders import METRICS, check_target, figure_files, write_staged
from calib.identification.identify_options import IdentifySettings
from calib.parallel.design_goal import Purpose, foretold, of_folder, of_options, purpose_of, read_model, whole
from calib.parallel.mechanism.closure import ClosedRobot
from calib.parallel.mechanism.parallel_model import ParallelModel, PlatformRegressor
from calib.parallel.mechanism.parallel_robot import ParallelRobot
from calib.parallel.mechanism.velocities import LoopMotion
from calib.parallel.robots import ParallelMechanism, refuse_unread
from calib.procedure.excitation import coefficients, folder, prediction
from calib.procedure.excitation.coefficients import PLANNED
from calib.procedure.excitation.design import INSTANTS, search_motion
from calib.procedure.excitation.goals import GUARD
from calib.procedure.excitation.inputs import ExcitationInputs
from calib.procedure.excitation.limits import MotionBounds, MotionLimits
from calib.procedure.excitation.settings import COARSE, DEFAULT_DESIGN, ExcitationSettings
from calib.records import field_values
from calib.robot.calibrated import COVARIANCE, ROBOT
from calib.robot.chain import Joint
from calib.robot.tables import dumps
from calib.trajectories.basis import SampledMotion
from calib.trajectories.constraints import BoxLimit, MotionConstraint, TwoSided
from calib.trajectories.design.verify import dense_motion
from calib.trajectories.setpoints import Setpoints
from calib.units import headings

# Number of instants over the period during the search.
SAMPLES = 100
# Names of the settings that apply to parallel robots.
READ = (
    "period",
    "harmonics",
    "drives",
    "starts",
    "evaluations",
    "seed",
    "rate",
    "outlook",
    "goals",
    "hard",
    "loads",
    "columns",
)
# Design criteria that are available for parallel robots.
GOALS = ("raw", "normalised", "logdet", "smallest")
FIGURES = figure_files("*")
# Files of a motion's folder.
MOTION = (ROBOT, COVARIANCE, METRICS, PLANNED, coefficients.NAME, prediction.NAME, folder.PAGE, *FIGURES)


@dataclass(frozen=True, eq=False)
class _ActuatorLimit(TwoSided):
    """Limit of each actuator's torque |τ| ≤ τ_max, or speed |q̇| ≤ v_max.

    Attributes:
        plan: function of platform coordinates that gives the robot's motion.
        of: function that maps a motion of N samples to the limited quantity (N, n).
        limits: (n,) finite limits.
        rows: names of the n actuators.
        name, unit: name and unit of the limited quantity.
        joints: (n,) indices of the actuators.
    """

    plan: PlatformRegressor
    of: Callable[[LoopMotion], np.ndarray]
    limits: np.ndarray
    rows: tuple[str, ...] = ()  # ty: ignore[incompatible-attribute-override]
    name: str = "torque"
    unit: str = "N m"
    joints: np.ndarray = field(init=False)  # ty: ignore[incompatible-attribute-override]

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", np.arange(len(self.limits)))

    @property
    def scale(self) -> np.ndarray:
        return np.tile(self.limits, 2)

    def values(self, motion: SampledMotion) -> np.ndarray:
        robot_motion = self.plan.motion(motion.q, motion.v, motion.a)
        values = self.of(robot_motion)
        above = values - self.limits
        below = -values - self.limits
        return np.concatenate([above, below], axis=1)

    def slopes(self, motion: SampledMotion, weights: np.ndarray) -> np.ndarray:
        k = len(self.limits)
        result = np.zeros((4, *motion.q.shape))
        # Weights of the upper limits less those of the lower ones.
        net = weights[:, :k] - weights[:, k:]
        result[:3] = self.plan.slopes(motion.q, motion.v, motion.a, self.of, net)
        return result


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ParallelExcitation(ExcitationDesign):
    """An exciting motion of a parallel robot; the fields of the design refer to the platform's coordinates.

    Attributes:
        robot: the robot, with its file.
        plan: function of platform coordinates that gives the robot's motion and torques.
    """

    robot: ParallelMechanism
    plan: PlatformRegressor

    def orders(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return x, v, a (N, r) of the platform's coordinates at times (N,) [s] of the periodic motion."""
        family = self.family
        phases = np.mod(times, family.period)
        motion = dense_motion(family, self.found.x, phases)
        return motion.q, motion.v, motion.a

    def sampled(self, rate: float | None = None) -> Sampled:
        """Return t (N,) [s] and q, v, a (N, n) of the actuators over one period at `rate` [Hz], ends included."""
        platform_track = folder.one_period(self, rate)
        track = self._actuators(platform_track)
        return track.times, track.q, track.v, track.a

    def _actuators(self, track: Setpoints) -> Setpoints:
        """Return the setpoints of the actuators (q, v, a, torques) for setpoints of the platform."""
        motion = self.plan.motion(track.q, track.v, track.a)
        actuated = self.robot.chain.actuated
        q = motion.posture.q[:, actuated]
        v = motion.v[:, actuated]
        a = motion.a[:, actuated]
        torques = self._torques(motion)
        return Setpoints(track.rate, q, v, a, torques)

    def _torques(self, motion: LoopMotion) -> np.ndarray:
        """Return the torques (N, n) of the actuators; of several loads the torque of the largest magnitude."""
        all_torques = self.plan.torques(motion)
        torques = all_torques.reshape(len(motion.v), -1, self.robot.chain.n)
        heaviest = np.abs(torques).argmax(axis=1, keepdims=True)
        return np.take_along_axis(torques, heaviest, axis=1)[:, 0]

    @property
    def peaks(self) -> tuple[np.ndarray, np.ndarray]:
        """Largest torque of each actuator (n,) [N m or N] and acceleration of each platform coordinate (r,)."""
        times = self.period / INSTANTS * np.arange(INSTANTS)
        x, v, a = self.orders(times)
        motion = self.plan.motion(x, v, a)
        peak_torques = np.abs(self._torques(motion)).max(axis=0)
        peak_accelerations = np.abs(a).max(axis=0)
        return peak_torques, peak_accelerations

    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Write the result folder of `calib excite`: one period at the controller's rate, and the actuators' series."""
        period_motion = folder.one_period(self)
        bounds = self.inputs.limits.bounds

        def write_series(target: Path) -> None:
            series = coefficients.table(self._series(), ROBOT, bounds.lines())
            files.write(target / coefficients.NAME, dumps(series))
            if self.predicted:
                prediction.write(self.predicted, target)
            if plots:
                from calib.procedure.report.outputs import write_design

                write_design(self, target, plots)

        track = self._actuators(period_motion)
        return write_motion(self.robot, Path(out), track, period_motion.q, bounds, self.to_dict(), write_series)

    def _series(self, max_error: float = 1e-8, samples: int = 2048) -> coefficients.Periodic:
        """Return the periodic motion of the actuators as Fourier series.

        Args:
            max_error: largest deviation of the series from the motion [rad or m].
            samples: number of samples over the period from which the series are computed.
        """
        times = self.period / samples * np.arange(samples)
        x, _, _ = self.orders(times)
        robot = self.robot.chain
        posture = self.robot.mechanism.place(x)
        q = posture.q[:, robot.actuated]
        lines = np.fft.rfft(q, axis=0) / samples
        # bound of the error that results if the harmonics from a given one on are omitted
        amplitudes = 2.0 * np.abs(lines)
        from_last = np.cumsum(amplitudes[::-1], axis=0)
        remainder = from_last[::-1].max(axis=1)
        needed = int((remainder[1:] > max_error).sum())
        last = 1 + max(1, needed)
        series = []
        for line in lines.T:
            constant = [line[0].real]
            sines = -2.0 * line[1:last].imag
            cosines = 2.0 * line[1:last].real
            series.append(np.concatenate([constant, sines, cosines]))
        kinds = tuple(joint.kind for joint in robot.joints)
        rate = self.settings.rate
        return coefficients.Periodic(robot.joint_names, kinds, self.period, rate, 1, "fourier", tuple(series))

    def to_dict(self) -> dict[str, object]:
        """Return the metrics of ``metrics.json``."""
        torque, acceleration = self.peaks
        metrics = super().to_dict()
        metrics["robot"] = self.robot.chain.name
        metrics["peak_torque"] = torque.tolist()
        metrics["peak_acceleration"] = acceleration.tolist()
        return metrics

    def __repr__(self) -> str:
        return f"<ParallelExcitation for {self.robot.chain.name}: {self.period:g} s>"

    def __str__(self) -> str:
        torques, _ = self.peaks
        names = self.robot.chain.joint_names
        peaks = [f"{name} {torque:.3g}" for name, torque in zip(names, torques)]
        return f"{super().__str__()}\npeak torques: {', '.join(peaks)}"


def excite_parallel(
    robot: ParallelMechanism,
    settings: ExcitationSettings,
    *,
    model: Path | None = None,
    options: IdentifySettings | str | Path | None = None,
    after: Path | None = None,
    map: Callable = map,
    progress: Callable[[str], None] | None = None,
) -> ParallelExcitation:
    """Return an exciting motion of a parallel robot within the torque limits and platform box of its file.

    Args:
        robot: the robot.
        settings: period, harmonics, drives, loads, columns, goals (`GOALS`), starts, evaluations, seed, rate; other
            settings apply to serial arms only.
        model: folder of an identification of the same robot, which predicts the torques and whose drive terms are to
            be identified; None: the inertias of the robot's file.
        options: options of the identification that will follow: rows, drives, friction of passive joints, payloads.
        after: folder of an identification that the motion is to complement; it also serves as `model`.
        map: `map`, or a replacement that evaluates the starts of the search in parallel.
        progress: function called with a line of text; None: none.

    Raises:
        UsageError: for options that apply to serial arms only.
    """
    refuse_unread(settings, DEFAULT_DESIGN, READ)
    for text in (*settings.goals, *settings.hard):
        name = text.partition("=")[0]
        one_of(name, GOALS, "goals: of a parallel robot", UsageError)
    require(after is None or model is None, "after: its folder is also the model; leave --model out", UsageError)
    folder = model or after
    if options is None and after is None and not settings.loads and not settings.columns:
        parallel_model, values = read_model(robot, folder, settings.drives or "Fv Fc off")
        return design_parallel(robot, parallel_model, values, settings, map=map, progress=progress)
    require(
        options is None or folder is None,
        f"{folder} already states rows, drives and payloads; leave the options out",
        UsageError,
    )
    if folder is None:
        parallel_model, values, loads, notes = of_options(robot, options, settings)
    else:
        parallel_model, values, loads, notes = of_folder(robot, folder, settings)
    purpose = purpose_of(parallel_model, values, loads, notes, settings, folder, after)
    design = design_parallel(robot, parallel_model, values, settings, purpose=purpose, map=map, progress=progress)
    if after is None:
        return design
    return foretold(design)


def design_parallel(
    robot: ParallelMechanism,
    model: ParallelModel,
    values: np.ndarray,
    settings: ExcitationSettings,
    *,
    acceleration: np.ndarray | None = None,
    purpose: Purpose | None = None,
    map: Callable = map,
    progress: Callable[[str], None] | None = None,
) -> ParallelExcitation:
    """Return a motion of the platform, optimised to identify the base parameters of a parallel robot.

    Without goals in the settings the determinant of the information is maximised. σ of the rows is the one that equal
    noise of all torques has at home. A share `GUARD` of the torque limits remains in reserve.

    Args:
        robot: the robot, with its file.
        model: model of the robot, with payloads and the preload of redundant actuators.
        values: (p,) parameters that predict the actuators' torques.
        settings: period, harmonics, starts, evaluations, seed, rate.
        acceleration: (r,) limits of the second derivatives of the platform's coordinates [m/s², rad/s²], infinite for
            a coordinate without limit; None: no limits.
        purpose: design goal; None: all base parameters, on the platform's coordinates.
        map: `map`, or a replacement that evaluates the starts of the search in parallel.
        progress: function called with a line of text; None: none.

    Raises:
        UsageError: if an actuator's speed or torque has no limit.
        NothingFeasible: if no motion keeps the limits; the message names the limit concerned.
    """
    mechanism = model.mechanism
    parallel_robot = model.mechanism.robot
    bounds = actuator_bounds(mechanism)
    purpose = purpose or whole(model, values)
    plan: Any = purpose.model.exact
    rows = getattr(plan, "row_names", parallel_robot.joint_names)
    coordinates = tuple(f"platform {name}" for name in parallel_robot.freedom)
    box = BoxLimit(0, parallel_robot.lower, parallel_robot.upper, rows=coordinates)
    constraints: list[MotionConstraint] = [box]
    if acceleration is not None:
        constraints.append(BoxLimit(2, -acceleration, acceleration, rows=coordinates))
    guarded_torque = (1.0 - GUARD) * bounds.torque
    torque_limits = np.resize(guarded_torque, len(rows))
    constraints.append(_ActuatorLimit(plan, plan.torques, torque_limits, rows))
    names = parallel_robot.joint_names
    constraints.append(_ActuatorLimit(plan, plan.speeds, bounds.velocity, names, "velocity", "rad/s"))
    platform: Any = _PlatformAxes(parallel_robot)
    free = np.full(parallel_robot.r, np.inf)
    limits = MotionLimits(tuple(constraints), bounds, free, None, 0.0, None, None, ())
    excited = replace(purpose.model, values=None, covariance=None)
    inputs = ExcitationInputs(platform, limits, excited, {}, purpose.columns, purpose.prior)
    goals = settings.goals or ("logdet",)
    harmonics = settings.harmonics or COARSE
    design_settings = replace(settings, goals=goals, harmonics=harmonics, samples=SAMPLES)
    design = search_motion(inputs, design_settings, map, progress)
    return ParallelExcitation(**field_values(design), robot=robot, plan=plan)


@dataclass(frozen=True)
class _PlatformAxes:
    """The platform's coordinates in the role of an arm's joints, whose motion is searched for."""

    robot: ParallelRobot

    @property
    def name(self) -> str:
        return self.robot.name

    @property
    def n(self) -> int:
        return self.robot.r

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self.robot.freedom

    @property
    def joints(self) -> tuple[Joint, ...]:
        joints = []
        for name in self.robot.freedom:
            kind = "prismatic"
            if name.startswith("r"):
                kind = "revolute"
            joints.append(Joint(name, kind))
        return tuple(joints)


def actuator_bounds(mechanism: ClosedRobot) -> MotionBounds:
    """Return the limits of the actuators: speeds and efforts of the robot's file.

    Raises:
        UsageError: if an actuator has no limit.
    """
    joints = mechanism.robot.joints
    velocity = np.array([joint.velocity for joint in joints])
    effort = np.array([joint.effort for joint in joints])
    free = np.full(len(joints), np.inf)
    origin: dict[str, str] = dict.fromkeys(("velocity", "torque"), "robot's file")
    location = "in the robot's file: velocity and effort of the actuated joints"
    return MotionBounds(mechanism.robot.name, joints, velocity, free, effort, origin, location)


def check_motion_target(out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
    """Raise UsageError if an output folder has other content or contains an input file."""
    check_target(out, MOTION, (METRICS, PLANNED), "motion", inputs)


def write_motion(
    robot: ParallelMechanism,
    out: Path,
    track: Setpoints,
    coordinates: np.ndarray,
    bounds: MotionBounds,
    metrics: dict[str, object],
    write_files: Callable[[Path], None],
) -> Path:
    """Write the folder of a motion: ``robot.toml``, ``motion.csv``, ``metrics.json`` and what `write_files` adds.

    Args:
        robot: the robot, with its file.
        out: the folder.
        track: setpoints of the actuators, written to ``motion.csv``.
        coordinates: (N, r) coordinates of the platform [m, rad], written to ``motion.csv``.
        bounds: limits that the motion keeps, written at the head of ``motion.csv``.
        metrics: content of ``metrics.json``.
        write_files: function that writes further files into the folder it is given.

    Returns:
        The folder.
    """
    parts = {"q": track.q, "v": track.v, "tau": track.tau}
    names = []
    for name in robot.chain.freedom:
        unit = "m"
        if name.startswith("r"):
            unit = "rad"
        names.append(f"{name} [{unit}]")
    for part in parts:
        names += headings(part, robot.chain.joints)
    table = np.hstack([track.times[:, None], coordinates, *parts.values()])  # ty: ignore[no-matching-overload]

    def write(folder: Path) -> None:
        robot.write(folder)
        bounds.check(track)
        files.write_numbers(folder / PLANNED, ["t [s]", *names], table, notes=bounds.lines())
        write_files(folder)
        files.write_json(folder / METRICS, metrics)

    check_motion_target(out, [robot.source])
    return write_staged(out, MOTION, write)

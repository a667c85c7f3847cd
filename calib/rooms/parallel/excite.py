"""Design an exciting motion of a parallel robot as the command does."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from calib import files
from calib.dynamics import base as bases
from calib.dynamics.base import Base
from calib.dynamics.shapes import V0
from calib.errors import RobotError, UsageError
from calib.identification.model_file import MODEL
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.coefficients import PLANNED
from calib.procedure.excitation.goals import SCALINGS
from calib.procedure.excitation.motion_bounds import MotionBounds
from calib.procedure.excitation.settings import COARSE, DEFAULT_DESIGN, ExcitationSettings
from calib.procedure.robot_kinds import refuse_unread
from calib.robot.calibrated import ROBOT
from calib.robot.tables import dumps
from calib.rooms.parallel.mechanism.closure import ClosedRobot
from calib.rooms.parallel.mechanism.parallel_model import ParallelModel, make_parallel_model, rows_named
from calib.rooms.parallel.mechanism.platform_motion import PlatformRegressor, along
from calib.rooms.parallel.mechanism.velocities import LoopMotion, loop_jacobians
from calib.rooms.parallel.results import ParallelResult, ResultFolder, write_motion
from calib.rooms.parallel.robots import ParallelMechanism
from trajectories.basis import SampledMotion
from trajectories.constraints import BoxLimit, MotionConstraint
from trajectories.design.objectives import Excitation, Index, condition_numbers
from trajectories.design.optimise import design
from trajectories.design.problem import ExcitationProblem
from trajectories.design.search import SearchResult
from trajectories.design.verify import Verification, dense_motion, ensured
from trajectories.fourier import Fourier, fourier_family
from trajectories.setpoints import Setpoints

SAMPLES = 100  # instants over the period while searching
INSTANTS = 1000  # over the period, at which condition numbers and torques are reported


@dataclass(frozen=True, eq=False)
class _ActuatorLimit:
    """|τ| ≤ τ_max, or |q̇| ≤ v_max, of each actuator; a `trajectories.constraints.MotionConstraint`.

    Attributes:
        of: platform coordinates x, v, a (N, r) -> (N, n).
        gradient: (x, v, a, G (N, n)) -> slopes of Σ G · of by x, v, a.
        names: of the n actuators; limits (n,), finite.
        name, unit: of the limit.
    """

    of: Callable[..., np.ndarray]
    gradient: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]
    names: tuple[str, ...]
    limits: np.ndarray
    name: str = "torque"
    unit: str = "N m"

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"{name} {side}" for side in ("upper", "lower") for name in self.names)

    @property
    def scale(self) -> np.ndarray:
        return np.tile(self.limits, 2)

    @property
    def groups(self) -> np.ndarray:
        return np.tile(np.arange(len(self.limits)), 2)

    def values(self, motion: SampledMotion) -> np.ndarray:
        own = self.of(motion.q, motion.v, motion.a)
        return np.concatenate([own - self.limits, -own - self.limits], axis=1)

    def slopes(self, motion: SampledMotion, weights: np.ndarray) -> np.ndarray:
        k, result = len(self.limits), np.zeros((4, *motion.q.shape))
        result[:3] = self.gradient(motion.q, motion.v, motion.a, weights[:, :k] - weights[:, k:])
        return result


@dataclass(frozen=True, eq=False)
class ParallelDesign:
    """An exciting motion of a parallel robot with its proof.

    Attributes:
        robot: regressor and torques along platform coordinates.
        base: base parameters it is to identify.
        family, found: the Fourier series of the platform's coordinates; proof: margins, checked independently.
        condition: of the observation matrix over `INSTANTS` samples: raw, and with columns of unit norm.
        peak: (n,) largest torque of each actuator [N m or N]; fastest: (r,) largest acceleration of each coordinate.
        bounds: what limits its actuators, and where that is stated.
    """

    robot: PlatformRegressor
    base: Base
    family: Fourier
    found: SearchResult
    proof: Verification
    condition: dict[str, float]
    peak: np.ndarray | None
    fastest: np.ndarray
    bounds: MotionBounds

    def orders(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return x, v, a (N, r) of the platform's coordinates at times (N,) [s]; it repeats with its period."""
        motion = dense_motion(self.family, self.found.x, np.mod(times, self.family.period))
        return motion.q, motion.v, motion.a

    def along(self, times: np.ndarray) -> LoopMotion:
        """Return the whole robot's motion at times (N,)."""
        return along(self.robot.model.known, *self.orders(times))


def design_parallel(
    model: ParallelModel,
    settings: ExcitationSettings,
    *,
    values: np.ndarray | None = None,
    acceleration: np.ndarray | None = None,
    margin: float = 0.0,
    preload: float = 0.0,
    index: Index = "cond",
    map: Callable = map,
    report: Callable[[int, int, str], None] | None = None,
) -> ParallelDesign:
    """Design a motion of the platform that excites the base parameters of a robot.

    Args:
        model: of the robot, with what it carries.
        settings: period, harmonics, starts, evaluations, seed, rate.
        values: (p,) parameters that predict the actuators' torques; None: they are not known.
        acceleration: (r,) limits of the coordinates' second derivatives; infinite where there is none.
        margin: share of the torque limits that stays free.
        preload: overconstraint of redundant actuators [N m or N].
        index: what is optimised of the observation matrix, rows in units of what equal noise of all torques makes of
            them at home: ``cond`` (both condition numbers), or ``logdet``, which makes the motion large besides.

    Raises:
        UsageError: where nothing limits an actuator's speed or torque.
        NothingFeasible: naming the limit that stands in the way.
    """
    robot = model.known.robot
    bounds = actuator_bounds(model.known, values is not None)
    exciting = ParallelModel(model.known, model.terms, rows_named(model.known), ())
    base = bases.find(exciting)
    plan = PlatformRegressor(model, _columns(model, base), values, preload)
    constraints: list[MotionConstraint] = [BoxLimit(0, robot.lower, robot.upper)]
    if acceleration is not None:
        constraints.append(BoxLimit(2, -np.asarray(acceleration), np.asarray(acceleration)))
    names = robot.joint_names
    torque = (1.0 - margin) * bounds.torque
    constraints.append(_ActuatorLimit(plan.torques, plan.torques_gradient, names, torque))
    constraints.append(_ActuatorLimit(plan.speeds, plan.speeds_gradient, names, bounds.velocity, "velocity", "rad/s"))
    family = fourier_family(settings.harmonics or COARSE, settings.period, robot.r, rate=settings.rate)
    problem = ExcitationProblem(
        family, plan.regressor,
        plan.regressor_gradient, _objectives(plan, index),
        tuple(constraints), samples=SAMPLES,
    )  # fmt: skip
    found = design(
        problem, starts=settings.starts, evaluations=settings.evaluations, seed=settings.seed, map=map, report=report
    )
    found, proof = ensured(problem, found, tuple(constraints), instants=INSTANTS)
    times = settings.period / INSTANTS * np.arange(INSTANTS)
    motion = dense_motion(family, found.x, times)
    condition = condition_numbers(plan.regressor(motion.q, motion.v, motion.a), _sigmas(plan))
    peak = None if values is None else np.abs(plan.torques(motion.q, motion.v, motion.a)).max(axis=0)
    return ParallelDesign(plan, base, family, found, proof, condition, peak, np.abs(motion.a).max(axis=0), bounds)


def actuator_bounds(known: ClosedRobot, predicted: bool) -> MotionBounds:
    """Return what limits the actuators: speeds of the robot's file and, where a model predicts torques, its efforts.

    Raises:
        UsageError: where nothing limits one.
    """
    joints = known.robot.joints
    velocity, effort = (np.array([getattr(joint, key) for joint in joints]) for key in ("velocity", "effort"))
    free = np.full(len(joints), np.inf)
    torque = effort if predicted else free
    origin: dict[str, str] = dict.fromkeys(("velocity", "torque"), "robot's file")
    place = "in the robot's file: velocity and effort of the actuated joints, and inertias"
    return MotionBounds(known.robot.name, joints, velocity, free, torque, origin, place)


def _sigmas(plan: PlatformRegressor) -> np.ndarray:
    """Return what equal noise of all torques makes of the rows at home (r,)."""
    known = plan.model.known
    return np.linalg.norm(loop_jacobians(known, known.home).readings[0], axis=0)


def _objectives(plan: PlatformRegressor, index: Index) -> tuple[tuple[Excitation, float], ...]:
    sigmas = _sigmas(plan)
    if index != "cond":
        return ((Excitation(index, sigmas=sigmas), 1.0),)
    return tuple((Excitation("cond", scaling=one, sigmas=sigmas), 0.5) for one in SCALINGS)


def _columns(model: ParallelModel, base: Base) -> np.ndarray:
    """Return where the base columns of the empty robot stand in a model with payloads."""
    index = {name: k for k, name in enumerate(model.names)}
    return np.array([index[base.standard[k]] for k in base.kept])


DRIVES = ("Ia", "Fv", "Fc", "off")
GUARD = 0.2  # share of the torque limits kept free, where friction is not known (our choice)
READ = ("period", "harmonics", "drives", "starts", "evaluations", "seed", "rate", "outlook")  # of the settings
EXACT = 1e-8  # by which the series of the actuators may leave the motion [rad or m]
HARMONIC_SAMPLES = 2048  # over the period, of which the actuators' series are made


@dataclass(frozen=True, eq=False, repr=False)
class ParallelExcitation(ParallelResult):
    """An exciting motion of a parallel robot: what `calib.design_excitation` returns of one.

    Attributes:
        robot: with its file.
        designed: the motion and its proof.
        rate: of the controller [Hz].
    """

    robot: ParallelMechanism
    designed: ParallelDesign
    rate: float
    folder: ClassVar = ResultFolder((PLANNED, coefficients.NAME), (PLANNED,), "motion")

    def write(self, folder: Path, plots: bool) -> None:
        """Write one period at the controller's rate, and the actuators' series."""
        design, own = self.designed, self.robot.known.robot.actuated
        t = np.arange(round(design.family.period * self.rate) + 1) / self.rate
        orders, motion = design.orders(t), design.along(t)
        tau = None if design.robot.values is None else design.robot.torques(*orders)
        track = Setpoints(self.rate, motion.posture.q[:, own], motion.v[:, own], motion.a[:, own], tau)
        write_motion(self.robot, design.bounds, track, orders[0], folder)
        series = coefficients.table(_actuators_series(design, self.rate), ROBOT, design.bounds.lines())
        files.write(folder / coefficients.NAME, dumps(series))

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as ``metrics.json`` holds them."""
        design = self.designed
        return {
            "robot": self.robot.known.robot.name,
            "period": design.family.period,
            "parameters": list(design.base.names),
            "condition_number": {key: float(value) for key, value in design.condition.items()},
            "peak_torque": None if design.peak is None else design.peak.tolist(),
            "peak_acceleration": design.fastest.tolist(),
            "margins": [
                {"limit": one.name, "of": one.label, "margin": float(one.margin), "unit": one.unit}
                for one in design.proof.margins
            ],
            "limits": design.bounds.lines(),
        }

    def lines(self) -> list[str]:
        """Return what the command prints."""
        design, robot = self.designed, self.robot.known.robot
        lines = [
            f"{robot.name}: {design.family.period:g} s, condition number {design.condition['raw']:.4g}, with columns "
            f"of unit norm {design.condition['normalised']:.4g}, of {len(design.base.names)} base parameters"
        ]
        if design.peak is not None:
            pairs = zip(robot.joint_names, design.peak)
            lines.append("peak torques: " + ", ".join(f"{name} {peak:.3g}" for name, peak in pairs))
        worst = min(design.proof.margins, key=lambda one: one.share)
        label = worst.label
        for k, name in enumerate(robot.freedom if worst.name in ("position", "acceleration") else ()):
            label = label.replace(f"joint {k + 1} ", f"platform {name} ")
        closest = f"closest limit: {worst.name} of {label}, {worst.margin:.3g} {worst.unit} left"
        return [*lines, closest, *design.bounds.lines()]

    def __repr__(self) -> str:
        return f"<ParallelExcitation for {self.robot.known.robot.name}: {self.designed.family.period:g} s>"


def excite_parallel(
    robot: ParallelMechanism,
    settings: ExcitationSettings,
    *,
    model: Path | None = None,
    limits: Path | None = None,
    map: Callable = map,
    progress: Callable[[str], None] | None = None,
) -> ParallelExcitation:
    """Design a motion that excites a parallel robot within the torque limits and platform box of its file.

    Args:
        settings: period, harmonics, drives, starts, evaluations, seed, rate; the others are for serial arms.
        model: folder of an identification of the same robot, which predicts the torques and whose drive terms are to
            be told; None: the file's inertias.

    Raises:
        UsageError: for options that only serial arms know.
    """
    refuse_unread(settings, DEFAULT_DESIGN, READ)
    if limits is not None:
        raise UsageError("limits are for serial arms yet; a parallel robot's are in its own file: effort, lower, upper")
    say = progress or (lambda words: None)
    if model is None:
        made = make_parallel_model(robot.known, (settings.drives,), v0=0.05)
        values = _values(made)
    else:
        made, values = read_model(robot, model)
    designed = design_parallel(
        made, settings, values=values, margin=GUARD, index="logdet", map=map,
        report=lambda done, total, what: say(f"{what} ({done} of {total})"),
    )  # fmt: skip
    return ParallelExcitation(robot, designed, settings.rate)


def read_model(robot: ParallelMechanism, folder: Path) -> tuple[ParallelModel, np.ndarray]:
    """Return the model that an identification left in `folder`, on the robot's loops, with its values (p,).

    Raises:
        RobotError: where the folder holds no model, or one of other bodies.
    """
    path, tree = folder / MODEL, robot.known.robot
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        known = {str(name): float(value) for name, value in table["values"].items()}
        texts = [" ".join(one for one in DRIVES if one + label in known) for label in tree.labels]
        passive = next((text for j, text in enumerate(texts) if j not in tree.actuated and text), "")
        model = make_parallel_model(
            robot.known, [texts[j] for j in tree.actuated], v0=float(table.get("v0", V0)),
            payloads=[str(label) for label in table.get("payloads", ())], passive=passive,
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RobotError(
            f"{path} holds no model of a parallel robot ({error!r}); give a folder of calib identify"
        ) from error
    if missing := [name for name in model.names[: model.inertial] if name not in known]:
        raise RobotError(f"{path} is of another robot: it has no {missing[0]}")
    return model, np.array([known.get(name, 0.0) for name in model.names])


def _values(model: ParallelModel) -> np.ndarray | None:
    bodies = model.known_parameters()
    return None if bodies is None else np.concatenate([bodies, np.zeros(model.p - model.inertial)])


def _actuators_series(design: ParallelDesign, rate: float) -> coefficients.Periodic:
    """Return the periodic motion of the actuators as Fourier series, long enough to be exact within `EXACT`."""
    known, period = design.robot.model.known, design.family.period
    times = period / HARMONIC_SAMPLES * np.arange(HARMONIC_SAMPLES)
    lines = np.fft.rfft(design.along(times).posture.q[:, known.robot.actuated], axis=0) / HARMONIC_SAMPLES
    above = np.cumsum(2.0 * np.abs(lines[::-1]), axis=0)[::-1].max(axis=1)
    last = 1 + max(1, int((above[1:] > EXACT).sum()))
    own = tuple(np.concatenate([[c[0].real], -2.0 * c[1:last].imag, 2.0 * c[1:last].real]) for c in lines.T)
    return coefficients.Periodic(known.robot.joint_names, period, rate, 1, "fourier", own)

"""Exciting motions of parallel robots: designed in the platform's coordinates, within the actuators' torques.

The platform's box and accelerations are limits of the coordinates themselves; the actuators' torques are those of least
norm with the stated preload, so that redundant ones are limited one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib.dynamics import base as bases
from calib.dynamics.base import Base
from calib.procedure.excitation.goals import SCALINGS
from calib.procedure.excitation.motion_bounds import MotionBounds
from calib.procedure.excitation.settings import COARSE, ExcitationSettings
from calib.rooms.parallel.mechanism.closure import ClosedRobot
from calib.rooms.parallel.mechanism.parallel_model import ParallelModel, rows_named
from calib.rooms.parallel.mechanism.platform_motion import PlatformRegressor, along
from calib.rooms.parallel.mechanism.velocities import LoopMotion, loop_jacobians
from trajectories.basis import SampledMotion
from trajectories.constraints import BoxLimit, MotionConstraint
from trajectories.design.objectives import Excitation, Index, condition_numbers
from trajectories.design.optimise import design
from trajectories.design.problem import ExcitationProblem
from trajectories.design.search import SearchResult
from trajectories.design.verify import Verification, dense_motion, ensured
from trajectories.fourier import Fourier, fourier_family

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

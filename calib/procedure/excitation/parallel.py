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
from calib.mechanism.parallel_model import ParallelModel, rows_named
from calib.mechanism.platform_motion import PlatformRegressor, along
from calib.mechanism.velocities import LoopMotion, loop_jacobians
from calib.procedure.excitation.goals import SCALINGS
from calib.procedure.excitation.settings import COARSE, ExcitationSettings
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
    """|τ| ≤ (1 - margin) τ_max of each actuator; a `trajectories.constraints.MotionConstraint`.

    Attributes:
        robot: predicts torques along platform coordinates.
        names: of the n actuators; limits (n,) τ_max [N m or N], finite.
        margin: a share of the limits that stays free.
    """

    robot: PlatformRegressor
    names: tuple[str, ...]
    limits: np.ndarray
    margin: float = 0.0
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
        torque, bound = self.robot.torques(motion.q, motion.v, motion.a), (1.0 - self.margin) * self.limits
        return np.concatenate([torque - bound, -torque - bound], axis=1)

    def slopes(self, motion: SampledMotion, weights: np.ndarray) -> np.ndarray:
        k, result = len(self.limits), np.zeros((4, *motion.q.shape))
        result[:3] = self.robot.torques_gradient(motion.q, motion.v, motion.a, weights[:, :k] - weights[:, k:])
        return result


@dataclass(frozen=True, eq=False)
class ParallelDesign:
    """An exciting motion of a parallel robot with its proof.

    Attributes:
        robot: regressor and torques along platform coordinates.
        base: base parameters it is to tell.
        family, found: the Fourier series of the platform's coordinates; proof: margins, checked independently.
        condition: of the observation matrix over `INSTANTS` samples: raw, and with columns of unit norm.
        peak: (n,) largest torque of each actuator [N m or N]; fastest: (r,) largest acceleration of each coordinate.
    """

    robot: PlatformRegressor
    base: Base
    family: Fourier
    found: SearchResult
    proof: Verification
    condition: dict[str, float]
    peak: np.ndarray | None
    fastest: np.ndarray

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
    """Design a motion of the platform that tells the base parameters of a robot.

    Args:
        model: of the robot, with what it carries.
        settings: period, harmonics, starts, evaluations, seed, rate.
        values: (p,) parameters that predict the actuators' torques; None: torques are not limited.
        acceleration: (r,) limits of the coordinates' second derivatives; infinite where there is none.
        margin: share of the torque limits that stays free.
        preload: overconstraint of redundant actuators [N m or N].
        index: what is optimised of the observation matrix, rows in units of what equal noise of all torques makes of
            them at home: ``cond`` (both condition numbers), or ``logdet``, which makes the motion large besides.

    Raises:
        NothingFeasible: naming the limit that stands in the way.
    """
    robot = model.known.robot
    exciting = ParallelModel(model.known, model.terms, rows_named(model.known), ())
    base = bases.find(exciting)
    plan = PlatformRegressor(model, _columns(model, base), values, preload)
    constraints: list[MotionConstraint] = [BoxLimit(0, robot.lower, robot.upper)]
    if acceleration is not None:
        constraints.append(BoxLimit(2, -np.asarray(acceleration), np.asarray(acceleration)))
    effort = np.array([joint.effort for joint in robot.joints])
    if values is not None and np.isfinite(effort).all():
        constraints.append(_ActuatorLimit(plan, robot.joint_names, effort, margin))
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
    return ParallelDesign(plan, base, family, found, proof, condition, peak, np.abs(motion.a).max(axis=0))


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

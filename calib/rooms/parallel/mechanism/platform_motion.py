"""Regressor rows and torques of motions in platform coordinates x(t), with gradients for motion design."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.rooms.parallel.mechanism.closure import ClosedRobot
from calib.rooms.parallel.mechanism.leg_links import Posture
from calib.rooms.parallel.mechanism.parallel_model import ParallelModel
from calib.rooms.parallel.mechanism.velocities import LoopMotion, distributed, loop_jacobians, of_platform

STEP = 1e-6  # of the differences by x


def along(known: ClosedRobot, x: np.ndarray, v: np.ndarray, a: np.ndarray, near: Posture | None = None) -> LoopMotion:
    """Return the robot's motion along platform coordinates x (N, r) with derivatives v, a.

    Args:
        near: (N,) postures to start Newton from; None: from home.
    """
    posture = known.place(x, near)
    return of_platform(known, posture, *_twist_of(known, x, v, a))


def _twist_of(known: ClosedRobot, x: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the independent parts of the platform's twist and their derivatives, each (N, r).

    Position's are v and a themselves; ω = ψ̇ z + φ̇ Rz y + ρ̇ Rz Ry x of roll ρ, pitch φ, yaw ψ about the base's axes.
    """
    selected = known.robot.selected
    if not (selected > 2).any() or ((selected > 2).sum() == 1 and 5 in selected):
        return v, a
    full = np.zeros((3, len(x), 6))
    full[:, :, selected] = x, v, a
    angles, rates, changes = full[:, :, 3:]
    Rz = Rotation.from_euler("z", angles[:, 2:]).as_matrix()
    Rzy = Rz @ Rotation.from_euler("y", angles[:, 1:2]).as_matrix()
    axes = np.stack([Rzy[:, :, 0], Rz[:, :, 1], np.broadcast_to([0.0, 0.0, 1.0], (len(x), 3))], axis=2)
    yaw = rates[:, 2:] * axes[:, :, 2]
    pitch = rates[:, 1:2] * axes[:, :, 1]
    roll = rates[:, :1] * axes[:, :, 0]
    full[1, :, 3:] = yaw + pitch + roll
    full[2, :, 3:] = np.einsum("nij,nj->ni", axes, changes) + np.cross(yaw, pitch) + np.cross(yaw + pitch, roll)
    return full[1][:, selected], full[2][:, selected]


@dataclass(frozen=True, eq=False)
class PlatformRegressor:
    """Rows on the platform's coordinates, and actuator torques, as functions of x, v, a with slopes by differences.

    Attributes:
        model: of the robot.
        columns: (b,) of the model's that count.
        values: (p,) parameters that predict torques; None where unknown.
        preload: overconstraint of redundant actuators [N m or N].
    """

    model: ParallelModel
    columns: np.ndarray
    values: np.ndarray | None = None
    preload: float = 0.0
    carried: Collection[str] | None = None

    def motion(self, x: np.ndarray, v: np.ndarray, a: np.ndarray) -> LoopMotion:
        """Return the robot's motion along x, v, a (N, r), clipped to the robot's box."""
        return along(self.model.known, self._reachable(x), v, a)

    def regressor(self, x: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return W (N, r, b) in the selected columns."""
        return self._columns(self.motion(x, v, a))

    def regressor_gradient(
        self, x: np.ndarray, v: np.ndarray, a: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the slopes of Σ weights · W (N, r, b) by x, v, a, each (N, r)."""
        return self.slopes(x, v, a, self._columns, weights)

    def torques(self, motion: LoopMotion) -> np.ndarray:
        """Return the actuators' torques (N, n) of a motion, by the model's `values`."""
        assert self.values is not None
        forces = self.model.platform_force(self.values, motion, self.carried)
        return distributed(self.model.known, motion.jacobians, forces, self.preload)

    def speeds(self, motion: LoopMotion) -> np.ndarray:
        """Return the actuators' speeds (N, n) of a motion."""
        return motion.v[:, self.model.known.robot.actuated]

    def _reachable(self, x: np.ndarray, spare_share: float = 0.01) -> np.ndarray:
        """Return coordinates clipped to the robot's box: a search may leave it.

        `spare_share`: of the box's width, beyond it (our choice).
        """
        robot = self.model.known.robot
        spare = spare_share * (robot.upper - robot.lower)
        return np.clip(x, robot.lower - spare, robot.upper + spare)

    def _columns(self, motion: LoopMotion) -> np.ndarray:
        return self.model.platform_regressor(motion, self.carried).transpose(2, 1, 0)[self.columns].transpose(2, 1, 0)

    def slopes(
        self, x: np.ndarray, v: np.ndarray, a: np.ndarray, of: Callable[[LoopMotion], np.ndarray], weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the slopes of Σ weights · of(motion) by x, v, a; central differences, exact to rounding for v, a.

        Args:
            of: the motion of N samples -> values (N, ...); weights: of the same shape.
        """
        known, (count, r) = self.model.known, x.shape
        within = self._reachable(x)
        near, inside = known.place(within), within == x
        still = loop_jacobians(known, near)
        result = np.empty((3, count, r))
        for order, step in enumerate((STEP, 1e-3, 1.0)):
            for j in range(r):
                ends = []
                for shift in (step * np.eye(r)[j], -step * np.eye(r)[j]):
                    moved = [within, v, a]
                    moved[order] = moved[order] + shift
                    posture = known.place(moved[0], near) if order == 0 else near
                    twist = _twist_of(known, *moved)
                    ends.append(of(of_platform(known, posture, *twist, None if order == 0 else still)))
                result[order, :, j] = ((ends[0] - ends[1]) * weights).reshape(count, -1).sum(axis=1) / (2.0 * step)
        return result[0] * inside, result[1], result[2]

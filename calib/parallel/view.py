"""Scene of a parallel robot for `calib view`: closed loops and platform as lines, measured poses, torque rows."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.csv_table import read_table
from calib.parallel.mechanism.closure import ClosedRobot, pose_of
from calib.parallel.mechanism.parallel_model import rows_named
from calib.parallel.mechanism.parallel_robot import COORDINATES
from calib.parallel.robots import ParallelMechanism
from calib.procedure.kinematic_stage.folder import FitFolder
from calib.robot.chain import Joint
from calib.robot.kinematics import forward, joint_frames

# Dimension of each coordinate of the platform.
DIMENSIONS: dict[str, str] = {}
DIMENSIONS.update(dict.fromkeys(COORDINATES[:3], "length"))
DIMENSIONS.update(dict.fromkeys(COORDINATES[3:], "angle"))


@dataclass(frozen=True, eq=False)
class MechanismPicture:
    """A parallel robot in the form that the viewer draws (`calib.results.scene.Drawn`).

    In all methods q (m, n) are readings of the actuated joints [rad or m].
    """

    mechanism: ClosedRobot

    @property
    def n(self) -> int:
        """Number of actuated joints."""
        return self.mechanism.robot.n

    @property
    def joints(self) -> tuple[Joint, ...]:
        """The actuated joints with their limits."""
        return self.mechanism.robot.joints

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the actuated joints."""
        return self.mechanism.robot.joint_names

    def strips(self, q: np.ndarray) -> list[np.ndarray]:
        """Return lines (m, k, 3) [m] in the base's frame: one per leg, and the outline of the platform.

        A leg's line connects its joints, its end, its attachment on the platform, and the platform's origin. End and
        attachment coincide if the loop closes.
        """
        robot = self.mechanism.robot
        posture = self.mechanism.locate(q)
        legs = []
        ends = []
        for leg, first in zip(robot.legs, robot.starts):
            q_leg = posture.q[:, first : first + leg.chain.n]
            frames = joint_frames(leg.chain, q_leg)
            joints = frames[:, :, :3, 3].transpose(1, 0, 2)
            end = forward(leg.chain, q_leg)[:, :3, 3]
            attachment = (posture.pose @ leg.attachment)[:, :3, 3]
            origin = posture.pose[:, :3, 3]
            beyond_joints = np.stack([end, attachment, origin], axis=1)
            legs.append(np.concatenate([joints, beyond_joints], axis=1))
            ends.append(attachment)
        outline = np.stack([*ends, ends[0]], axis=1)
        return [*legs, outline]

    def torque_rows(self, kind: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return titles and units of the torque rows of an identification: platform, motor or power."""
        rows = rows_named(self.mechanism, kind)
        if kind == "power":
            units = ("W",)
        else:
            prismatic = [joint.kind == "prismatic" for joint in self.joints]
            units = rows.units(prismatic)
        return rows.titles(self.joint_names), units

    def measured(self, path: Path) -> tuple[np.ndarray, ...]:
        """Return the poses stored in a fit's folder, in the order of `calib.results.scene.Measured`.

        Returns:
            Readings q (m, n); positions (m, 3) of the platform [m], measured, by the nominal and by the calibrated
            robot; mask (m,) of the held-out poses; rotation vectors (m, 3) [rad] from the calibrated to the measured
            orientation, NaN if no angle was measured. Without measured coordinates all three positions are the
            calibrated robot's.
        """
        robot = self.mechanism.robot
        table = read_table(FitFolder(path).residuals)
        readings = [table.numbers(joint.name, "joint") for joint in robot.joints]
        q = np.column_stack(readings)
        calibrated = self.mechanism.locate(q).pose
        turned = np.full((len(q), 3), np.nan)
        places = [calibrated[:, :3, 3]] * 3
        if robot.freedom[0] in table:

            def columns(prefix: str) -> np.ndarray:
                coordinates = [table.numbers(prefix + name, DIMENSIONS[name]) for name in robot.freedom]
                return np.column_stack(coordinates)

            at = columns("")
            after = columns("d")
            before = columns("nominal d")
            measured_pose = pose_of(self.mechanism, at)
            nominal = pose_of(self.mechanism, at - before)
            still = pose_of(self.mechanism, at - after)
            places = []
            for pose in (measured_pose, nominal, still):
                error = pose[:, :3, 3] - still[:, :3, 3]
                places.append(error + calibrated[:, :3, 3])
            if (robot.selected > 2).any():
                still_inverse = still[:, :3, :3].transpose(0, 2, 1)
                rotation = measured_pose[:, :3, :3] @ still_inverse
                turned = Rotation.from_matrix(rotation).as_rotvec()
        held_out = np.array(table.texts("set")) != "fit"
        return q, *places, held_out, turned


def picture(robot: ParallelMechanism) -> MechanismPicture:
    """Return the drawable form of a parallel robot."""
    return MechanismPicture(robot.mechanism)

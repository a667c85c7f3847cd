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

DIMENSIONS: dict[str, str] = {}
DIMENSIONS.update(dict.fromkeys(COORDINATES[:3], "length"))
DIMENSIONS.update(dict.fromkeys(COORDINATES[3:], "angle"))


@dataclass(frozen=True, eq=False)
class MechanismPicture:
    """A parallel robot to be drawn, as `calib.results.scene.Drawn`; q (m, n) are readings of its actuated joints."""

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
        """Return lines (m, k, 3) [m] in the base: each leg up to the platform's origin, and the platform's outline.

        A leg's line passes its joints, its end and its attachment: where the loop does not close, these are apart.
        """
        robot = self.mechanism.robot
        posture = self.mechanism.locate(q)
        legs = []
        ends = []
        for leg, first in zip(robot.legs, robot.starts):
            q_leg = posture.q[:, first : first + leg.chain.n]
            joints = joint_frames(leg.chain, q_leg)[:, :, :3, 3].transpose(1, 0, 2)
            end = forward(leg.chain, q_leg)[:, :3, 3]
            attachment = (posture.pose @ leg.attachment)[:, :3, 3]
            beyond_joints = np.stack([end, attachment, posture.pose[:, :3, 3]], axis=1)
            legs.append(np.concatenate([joints, beyond_joints], axis=1))
            ends.append(attachment)
        return [*legs, np.stack([*ends, ends[0]], axis=1)]

    def torque_rows(self, kind: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return titles and units of the torque rows of an identification: platform, motor or power."""
        rows = rows_named(self.mechanism, kind)
        if kind == "power":
            units = ("W",)
        else:
            units = rows.units([joint.kind == "prismatic" for joint in self.joints])
        return rows.titles(self.joint_names), units

    def measured(self, path: Path) -> tuple[np.ndarray, ...]:
        """Return the poses stored in a fit's folder, in the order of `calib.results.scene.Measured`.

        Readings q (m, n); positions (m, 3) of the platform seen, by the nominal and by the calibrated robot [m];
        mask (m,) of the held-out poses; rotation vectors from the calibrated to the measured orientation (m, 3) [rad],
        NaN where no angle was measured. Without measured coordinates all positions are the calibrated robot's.
        """
        robot = self.mechanism.robot
        table = read_table(FitFolder(path).residuals)
        q = np.column_stack([table.numbers(joint.name, "joint") for joint in robot.joints])
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
            poses = (measured_pose, nominal, still)
            places = [pose[:, :3, 3] - still[:, :3, 3] + calibrated[:, :3, 3] for pose in poses]
            if (robot.selected > 2).any():
                rotation = measured_pose[:, :3, :3] @ still[:, :3, :3].transpose(0, 2, 1)
                turned = Rotation.from_matrix(rotation).as_rotvec()
        return q, *places, np.array(table.texts("set")) != "fit", turned


def picture(robot: ParallelMechanism) -> MechanismPicture:
    """Return the drawable form of a parallel robot."""
    return MechanismPicture(robot.mechanism)

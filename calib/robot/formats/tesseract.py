"""Joint origins as tesseract reads them: the file of ``<calibration_config filename=.../>`` in a SRDF."""

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import refuse_robot
from calib.robot.formats.urdf_tree import read
from calib.robot.formats.yaml_block import block

HEAD = "# For <calibration_config filename=.../> in the SRDF of the nominal robot; m, unit quaternions.\n"


def joint_origins(source: str, edited: str, where: str) -> str:
    """Return the YAML with the origins of all joints that differ between two URDF texts.

    Args:
        source, edited: the nominal robot, and the calibrated one with the same joints.
        where: names them in messages.

    Raises:
        RobotError: for an origin that is no rotation.
    """
    before, after = read(source, where), read(edited, where)
    moved = {}
    max_difference = 1e-9  # of a rotation matrix, to be one
    for name, joint in after.joints.items():
        if np.array_equal(joint.origin, before.joints[name].origin):
            continue
        turn = Rotation.from_matrix(joint.origin[:3, :3]).as_quat()
        if np.abs(Rotation.from_quat(turn).as_matrix() - joint.origin[:3, :3]).max() > max_difference:
            refuse_robot(where, f"the origin of joint '{name}' is no rotation")
        moved[name] = {
            "position": dict(zip("xyz", joint.origin[:3, 3].tolist())),
            "orientation": dict(zip("xyzw", turn.tolist())),
        }
    return HEAD + block({"calibration": {"joints": moved}})

"""Can these orientations be those of this arm's target? What no file alone can say, and the nominal arm can.

A quaternion read in another order is still a quaternion, and of two rows the angle |log R_iᵀ R_j| = 2 acos |q_i · q_j|
does not depend on the order. But to move the w is an odd permutation, a reflection of the quaternions' sphere, so that
what is read is P R_iᵀ Q with constant P, Q: an inverse, which no placement S, X brings to the arm's S A_i X.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.poses.measurements import PoseMeasurements, Poses
from calib.errors import refuse_data
from calib.geometry.hand_eye import place_pose
from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from calib.transforms import from_quaternion


def check_orientations(chain: Chain, block: PoseMeasurements) -> None:
    """Refuse quaternions that stand as w x y z under a header x y z w, and inverse orientations.

    Args:
        chain: the nominal arm.
        block: of any kind; only full poses are looked at.

    Raises:
        MeasurementError: where the orientations contradict the arm as they are read, and agree read otherwise.
    """
    if not isinstance(block, Poses):
        return
    rows = np.flatnonzero(block.tool == np.argmax(np.bincount(block.tool)))
    max_rows = 200  # how many are looked at; our choice
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, max_rows).astype(int))]
    arm, position, stated = forward(chain, block.q[rows]), block.position[rows], block.quaternion[rows]
    min_angle = 20.0  # median misfit [deg] from which on the file's orientations are not what they are said to be
    if len(rows) < 4 or (found := _misfit(arm, position, stated)[0]) <= min_angle:
        return
    readings = {
        "as w x y z they do: are these w first? Name the columns in the order they stand in: qw, qx, qy, qz": np.roll(
            stated, -1, axis=1
        ),
        "inverted they do: they have to be those of the target seen from the instrument": stated * [-1, -1, -1, 1],
    }
    max_misfit = 0.1  # of the positions' spread: their median misfit then
    max_angle = 5.0  # and below which another reading of them is
    for words, quaternion in readings.items():
        angle, distance = _misfit(arm, position, quaternion)
        if angle < max_angle and distance < max_misfit:
            refuse_data(
                block.file,
                f"the orientations do not turn with the arm (as x y z w they are off by {found:.0f}° in the median, "
                f"wherever instrument and tool are placed); {words}",
            )


def _misfit(arm: np.ndarray, position: np.ndarray, quaternion: np.ndarray) -> tuple[float, float]:
    """Return how far measured poses are from the arm's after the best placement of instrument and tool.

    Args:
        arm: (m, 4, 4) poses of the tip in the base.
        position: (m, 3) [m].
        quaternion: (m, 4) x y z w.

    Returns:
        The median angle [deg], and the median distance over the positions' spread.
    """
    seen = from_quaternion(position, quaternion)
    station, tool = place_pose(arm, seen)
    predicted = station @ arm @ tool
    turned = Rotation.from_matrix(np.swapaxes(predicted[:, :3, :3], 1, 2) @ seen[:, :3, :3]).magnitude()
    distance = np.linalg.norm(predicted[:, :3, 3] - position, axis=1)
    spread = float(np.sqrt(np.sum(np.var(position, axis=0))))
    return float(np.degrees(np.median(turned))), float(np.median(distance)) / max(spread, 1e-9)

"""Names of the small measurement file that `conftest.good` holds."""

from calib.data.schema import Joints

JOINTS = ("shoulder", "elbow", "wrist")
POSE = "q1,q2,q3,x,y,z,qx,qy,qz,qw"


def within(limits=(None, None), kinds=()):
    """Return the joints of the rows, with limits and kinds."""
    return Joints(JOINTS, kinds, *limits)

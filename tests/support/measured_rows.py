"""Names of the small measurement file that `conftest.good` holds."""

JOINTS = ("shoulder", "elbow", "wrist")
POSE = "q1,q2,q3,x,y,z,qx,qy,qz,qw"

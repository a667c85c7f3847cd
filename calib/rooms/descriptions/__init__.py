"""Descriptions of robots by ROS and MuJoCo: xacro and MJCF files, read as URDF."""

OFFERS = {"descriptions": "reading:", "topics": ":TOPICS"}
TOPICS = {
    "descriptions": ("robots as xacro and MJCF", "calib.rooms.descriptions.xacro_files calib.rooms.descriptions.mjcf")
}

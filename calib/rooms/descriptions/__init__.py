"""Descriptions of robots in the words of ROS and MuJoCo: xacro and MJCF in, MoveIt's limits in, a ROS 2 package out."""

OFFERS = {"descriptions": "reading:", "topics": ":TOPICS"}
TOPICS = {
    "descriptions": ("robots as xacro and MJCF", "calib.rooms.descriptions.xacro_files calib.rooms.descriptions.mjcf")
}

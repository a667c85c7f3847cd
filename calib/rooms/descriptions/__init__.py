"""Descriptions by ROS, MoveIt and MuJoCo: xacro and MJCF read as URDF, MoveIt's limits, ROS 2 packages."""

OFFERS = {
    "descriptions": "reading:",
    "limit_tables": "moveit:limit_tables",
    "ros2_package": "ros2_package:write_package",
    "topics": ":TOPICS",
}
TOPICS = {
    "descriptions": (
        "robots as xacro, MJCF and a UR's calibration.conf",
        "calib.rooms.descriptions.xacro_files calib.rooms.descriptions.mjcf calib.rooms.descriptions.ur_calibration",
    ),
    "moveit": ("MoveIt's joint_limits.yaml and SRDF as limits", "calib.rooms.descriptions.moveit"),
    "ros2": ("ROS 2 package of a calibrated robot, of calib export --ros2", "calib.rooms.descriptions.ros2_package"),
}

"""Descriptions of robots by ROS, MuJoCo and Universal Robots, read as URDF."""

"""Robot descriptions of ROS (xacro), MuJoCo (MJCF) and Universal Robots, converted to URDF when read."""

"""Pairs of poses without joints: pose of the robot's tool, and of a board (or camera), one pair per sample.

========================  =============================================================================================
CSV                       two poses per row, told apart by what their columns' names share: ``robot_x … robot_qw`` and
                          ``cam_x … cam_qw``; ``x_tool``, ``tcp.position.x``, ``tvec_0``, ``board_r11`` … are understood
easy_handeye              YAML with ``samples: [{robot: …, optical: …}]``
MoveIt                    samples as its calibration panel saves them: ``effector_wrt_world`` and ``object_wrt_sensor``,
                          16 numbers each, row by row
OpenCV                    FileStorage (YAML, XML, JSON) with ``R_gripper2base``, ``t_gripper2base``, ``R_target2cam``,
                          ``t_target2cam``: matrices or rotation vectors, one per sample
any YAML, JSON            a list of samples with two poses each, or two lists of poses of equal length
========================  =============================================================================================

A pose is a 4 x 4 matrix, or a position with a quaternion, a matrix, a rotation vector or three angles. Which convention
and which direction is meant is found by what agrees (`calib.apps.registration.agreement`) where names do not say it.
"""

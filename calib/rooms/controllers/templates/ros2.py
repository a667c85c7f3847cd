#!/usr/bin/env python3
"""{{ name }}: {{ poses|length }} poses for a calibration; written by armature-calib.

{% for line in head %}
{{ line }}
{% endfor %}

python3 {{ name }}.py --ros-args -p controller:=joint_trajectory_controller
"""

import csv
import time

import rclpy
from builtin_interfaces.msg import Duration
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionClient
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectoryPoint

JOINTS = {{ joints }}
POSES = [
{% for pose in poses %}
    [{{ pose|join(", ") }}],
{% endfor %}
]
SPEED = {{ "%.4f"|format(speed / 100 * 3.14159) }}  # [rad/s] of the joint that moves farthest


class Measuring(Node):
    def __init__(self):
        super().__init__("{{ name }}")
        controller = self.declare_parameter("controller", "joint_trajectory_controller").value
        self.client = ActionClient(self, FollowJointTrajectory, f"/{controller}/follow_joint_trajectory")
        self.state = None
        self.create_subscription(JointState, "/joint_states", self.heard, 10)

    def heard(self, message):
        if set(JOINTS) <= set(message.name):
            self.state = dict(zip(message.name, message.position))

    def listen(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(self, timeout_sec=0.05)
        if self.state is None:
            raise SystemExit("no /joint_states with " + ", ".join(JOINTS))
        return [self.state[name] for name in JOINTS]

    def move(self, pose):
        far = max(abs(to - at) for to, at in zip(pose, self.listen(0.5)))
        seconds = max(1.0, 2.0 * far / SPEED)
        end = Duration(sec=int(seconds), nanosec=int(seconds % 1 * 1e9))
        goal = FollowJointTrajectory.Goal()
        goal.trajectory.joint_names = JOINTS
        goal.trajectory.points = [JointTrajectoryPoint(positions=pose, velocities=[0.0] * len(pose), time_from_start=end)]
        self.client.wait_for_server()
        sent = self.client.send_goal_async(goal)
        rclpy.spin_until_future_complete(self, sent)
        if not sent.result().accepted:
            raise SystemExit("the controller refused the pose")
        done = sent.result().get_result_async()
        rclpy.spin_until_future_complete(self, done)
        if done.result().result.error_code != FollowJointTrajectory.Result.SUCCESSFUL:
            raise SystemExit(f"not reached: {done.result().result.error_string}")


def main():
    rclpy.init()
    node = Measuring()
    with open("{{ name }}_joints.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow([f"{name} [rad]" for name in JOINTS])
        for number, pose in enumerate(POSES, 1):
            node.move(pose)
            table.writerow(node.listen({{ [settle, 0.1]|max }}))
            file.flush()
            input(f"pose {number} of {len(POSES)}: measure, then press Enter ")


main()

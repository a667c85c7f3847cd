"""Motions as ROS 2 messages trajectory_msgs/msg/JointTrajectory, in JSON or YAML (for ``ros2 topic pub``)."""

import json
from collections.abc import Sequence

import numpy as np

from .errors import BadInput, require
from .setpoints import Setpoints

DIGITS = 9  # after the point: 1e-9 rad, and whole nanoseconds


def joint_trajectory(
    track: Setpoints, joint_names: Sequence[str], every: int = 1, frame: str = ""
) -> dict[str, object]:
    """Return a motion as a ROS message in plain dictionaries.

    Positions are in rad or m; effort is in N m or N, and is left out where torques are unknown.

    Args:
        track: the motion.
        joint_names: (n,) names of the joints.
        every: number of samples from one point of the message to the next, for controllers that interpolate; the last
            sample is always included.
        frame: frame_id of the message's header.

    Raises:
        BadInput: `joint_names` are not one per joint, or `every` is below 1.
    """
    if len(joint_names) != track.n or len(set(joint_names)) != track.n:
        raise BadInput(f"the motion has {track.n} joints, the given names are {', '.join(joint_names) or 'none'}")
    require(every >= 1, f"every {every}: expected 1 or more")
    numbers = np.append(np.arange(0, len(track), every), len(track) - 1)
    rows = np.unique(numbers)
    points = [_point(track, int(k)) for k in rows]
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame},
        "joint_names": list(joint_names),
        "points": points,
    }


def to_json(message: dict[str, object]) -> str:
    """Return the message as JSON, one point per line."""
    lines = ["    " + json.dumps(point, allow_nan=False) for point in message["points"]]
    points = ",\n".join(lines)
    header = {key: message[key] for key in ("header", "joint_names")}
    head = json.dumps(header, indent=2)[:-2]
    return f'{head},\n  "points": [\n{points}\n  ]\n}}\n'


def to_yaml(message: dict[str, object]) -> str:
    """Return the message as YAML. Numbers always have a decimal point, since YAML 1.1 reads 1e-05 as text."""
    stamp = message["header"]["stamp"]
    quoted = [json.dumps(name) for name in message["joint_names"]]
    names = ", ".join(quoted)
    lines = [
        "header:",
        f"  stamp: {{sec: {stamp['sec']}, nanosec: {stamp['nanosec']}}}",
        f"  frame_id: {json.dumps(message['header']['frame_id'])}",
        f"joint_names: [{names}]",
        "points:",
    ]
    for point in message["points"]:
        for key, values in point.items():
            lead = "- " if key == "positions" else "  "
            if key == "time_from_start":
                text = f"{{sec: {values['sec']}, nanosec: {values['nanosec']}}}"
            else:
                numbers = ", ".join(f"{value:.{DIGITS}f}" for value in values)
                text = f"[{numbers}]"
            lines.append(f"{lead}{key}: {text}")
    return "\n".join(lines) + "\n"


def _point(track: Setpoints, k: int) -> dict[str, object]:
    nanoseconds = round(k / track.rate * 1e9)
    effort = []
    if track.tau is not None:
        effort = _rounded(track.tau[k])
    seconds, remaining_nanoseconds = divmod(nanoseconds, 10**9)
    return {
        "positions": _rounded(track.q[k]),
        "velocities": _rounded(track.v[k]),
        "accelerations": _rounded(track.a[k]),
        "effort": effort,
        "time_from_start": {"sec": seconds, "nanosec": remaining_nanoseconds},
    }


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(value), DIGITS) for value in values]

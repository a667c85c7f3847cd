"""What folders of motions have in common: whose they are, samples for a controller, and messages for ROS 2."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import UsageError
from trajectories.messages import joint_trajectory, to_json, to_yaml
from trajectories.setpoints import Setpoints


def check_target(out: Path, ours: Sequence[str], what: str) -> None:
    """Refuse, before any work is done, a file, or a folder whose files of these names are not ours to replace."""
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out} is a file; --out needs a folder")
    present = [name for name in ours if (out / name).exists()]
    if present and not all((out / name).exists() for name in ours):
        raise UsageError(f"{out} holds {', '.join(present)} which no earlier {what} left there; choose another")


def write_track(track: Setpoints, path: Path) -> Path:
    """Write t, q, v, a and, where known, tau; SI, a row per sample of the controller."""
    parts = {"q": track.q, "v": track.v, "a": track.a} | ({} if track.tau is None else {"tau": track.tau})
    header = ["t", *(f"{letter}{j + 1}" for letter in parts for j in range(track.n))]
    return files.write_table(path, header, np.column_stack([track.times, *parts.values()]).tolist())


def write_optional(track: Setpoints | None, path: Path) -> None:
    """Write a track, or take away what an earlier run left in its place."""
    if track is None:
        path.unlink(missing_ok=True)
    else:
        write_track(track, path)


def write_messages(track: Setpoints, joint_names: Sequence[str], out: Path, every: int = 1) -> None:
    """Write ``trajectory.json`` and ``trajectory.yaml`` (trajectory_msgs/JointTrajectory), one sample of `every`."""
    message = joint_trajectory(track, joint_names, every)
    files.write(out / "trajectory.json", to_json(message))
    files.write(out / "trajectory.yaml", to_yaml(message))

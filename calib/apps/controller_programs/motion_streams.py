"""Motions for controllers that take streams: ``calib program 6-excitation/motion.csv --for ur``.

A motion of `calib excite` or `calib plan` (columns ``t [s]``, ``q_joint1 [rad]`` …) becomes setpoints at the
controller's cycle, by cubic splines: for UR a program of ``servoj``, for KUKA (RSI) and ABB (EGM) a table that a host
program sends. For ROS these commands write a JointTrajectory themselves. The motion keeps its speed.
"""

from pathlib import Path

import numpy as np

from calib.apps.controller_programs.targets import formatted
from calib.errors import UsageError
from calib.toolkit.chains import Axes, Controller, NamedJoint, PlainJoint
from calib.toolkit.pose_data import read_header, read_table
from calib.toolkit.result_folders import open_result
from calib.units import LENGTHS

PREFIX = "q_"


def motion_file(path: Path) -> Path:
    """Return the path of a motion: of the motion in a result's folder, or `path` itself if it is a file.

    Raises:
        UsageError: a folder without a motion.
    """
    if path.is_file() and path.suffix != ".npz":
        return path
    return open_result(path, "program").motion()


def is_motion(path: Path) -> bool:
    """Return whether the CSV file `path` contains a motion, recognised by a column t."""
    return "t" in read_header(path)[0]


def setpoints(path: Path, controller: Controller) -> tuple[np.ndarray, list[NamedJoint]]:
    """Return the setpoints (k, n) [rad or m] of a motion, interpolated at a controller's cycle, and the joints.

    Args:
        path: CSV file of the motion.
        controller: the controller.

    Raises:
        UsageError: a controller that cannot stream setpoints, or a file without joint positions.
    """
    from scipy.interpolate import CubicSpline  # slow to load

    if not controller.stream:
        raise UsageError(f"{path} is a motion, and {controller.title} takes no stream; give a list of poses")
    table = read_table(path)
    columns = [name for name in table.header if name.startswith(PREFIX)]
    if not columns:
        raise UsageError(f"{path}: no positions ({PREFIX}joint1 [rad]); found {', '.join(table.header)}")
    t = table.numbers("t", None)
    q = np.column_stack([table.numbers(name, "joint") for name in columns])
    joints: list[NamedJoint] = []
    for name in columns:
        unit = table.units[table.index(name)].lower()
        kind = "revolute"
        if unit in LENGTHS:
            kind = "prismatic"
        joints.append(PlainJoint(name.removeprefix(PREFIX), kind))
    rising = np.all(np.diff(t) > 0.0)
    if len(t) <= 3 or not rising:
        raise UsageError(f"{path}: expected at least four rows of rising t")
    count = round(float(t[-1] - t[0]) / controller.cycle)
    times = t[0] + controller.cycle * np.arange(count + 1)
    # a rounded number of cycles may end behind the motion
    times = np.minimum(times, t[-1])
    return CubicSpline(t, q)(times), joints


def stream_values(controller: Controller, axes: Axes, q: np.ndarray) -> dict[str, object]:
    """Return the variables of a controller's stream template for setpoints q (k, n) [rad or m], by name."""
    controller_values = axes.shown(controller, q)
    headings = []
    for label, unit in zip(axes.labels(), axes.units(controller.unit)):
        headings.append((label.replace(" ", "_"), unit))
    rows = formatted(controller_values, controller.decimals)
    relative = formatted(controller_values - controller_values[0], controller.decimals)
    return {"rows": rows, "relative": relative, "cycle": controller.cycle, "headings": headings}

"""Joint values and measured points joined, in Python: `calib.join`."""

from __future__ import annotations

from pathlib import Path

from calib.arguments import checked
from calib.data.csv_table import read_table
from calib.robot.calibrated import CalibratedChain
from calib.robot.library import load_calibrated
from calib.rooms.instruments import joining


@checked
def join(
    joints: str | Path,
    points: str | Path,
    *,
    by: str = "",
    robot: str | Path | CalibratedChain | None = None,
    base: str | None = None,
    tip: str | None = None,
) -> joining.Joined:
    """Join a controller's joint values and an instrument's points to one table of measured poses.

    Args:
        joints: CSV file of joint values, one row per pose, or a log over time.
        points: CSV file of measured points.
        by: ``name``, ``time``, ``row`` or ``geometry``; empty: the first of them that both files have columns for.
        robot, base, tip: the nominal robot, as of `load`, whose geometry checks the order, or finds it.

    Returns:
        The table, the index of each row's pose, and notes; ``write(path)`` writes the CSV that `fit_geometry` takes.

    Raises:
        MeasurementError: where the files do not go together.
    """
    arm = load_calibrated(robot, base, tip) if isinstance(robot, str | Path) else robot
    return joining.join(read_table(joints), read_table(points), by, arm and arm.complete)

"""Points that an instrument measured at planned poses, without joint values: the planned joint values are used."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.apps.joining.joined import NAMES, column_of
from calib.apps.joining.joining import MIN_POINTS, merged, ordered
from calib.errors import finding
from calib.toolkit.chains import Chain, forward
from calib.toolkit.pose_data import (
    POSITION,
    FileOptions,
    PoseMeasurements,
    Positions,
    Sheet,
    Table,
    is_robodk_file,
    read_measurements,
    read_poses,
    read_table,
)
from calib.toolkit.result_folders import joints_of, lines_of

# standard deviation of the difference between commanded and reached joint position [rad or m] (our choice)
SIGMA_JOINT = 1e-4
# step of the central differences that propagate this standard deviation to the tip [rad or m]
STEP = 1e-6


def read_planned(path: Path, chain: Chain, options: FileOptions) -> list[PoseMeasurements]:
    """Return the points of a file, joined with the planned joint values from the file ``options.planned``.

    Poses are identified by the numbers in the points' names, otherwise by the order of the rows. Where the nominal arm
    contradicts both, the order is found from the arm's geometry (`calib.apps.joining.order`).

    Args:
        path: the file of the points.
        chain: the nominal arm.
        options: how the file is read; ``planned`` is the file of the planned poses.

    Returns:
        One block; an empty list where the file has joint columns, or no positions.

    Raises:
        MeasurementError: the points were not measured at the planned poses, in whatever order.
    """
    points = read_table(path)
    sheet = Sheet(points, options)
    position_columns = sheet.family(POSITION.names)
    joint_columns = {*chain.joint_names, *(f"q_{name}" for name in chain.joint_names), "q1", *options.columns}
    if joint_columns & set(points.header) or is_robodk_file(points.header) or not position_columns:
        return []
    q = read_poses(options.planned, joints_of(chain))
    orders = _stated_orders(points, len(q))
    pose, notes = ordered(chain, q, points, orders, sheet)

    # the planned joints in place of the controller's file
    no_units = ("",) * chain.n
    numbers = np.arange(1, len(q) + 1)
    plan = Table(options.planned, chain.joint_names, no_units, tuple(q.T), numbers)
    units = list(points.units)
    for name in position_columns:
        units[points.index(name)] = sheet.unit(name, "position")
    name_column = column_of(points, NAMES)
    keys = {name_column} - {""}
    joined = merged(plan, replace(points, units=tuple(units)), pose, notes, keys, name_missing=False)
    (block,) = read_measurements(joined.table, joints_of(chain), replace(options, units={}))

    # the arm stops beside where it was sent
    sigma = _stop_sigma(chain, block.q)
    note = finding("joints-planned", sigma=np.sqrt(np.mean(3.0 * sigma**2)))
    block = replace(block, notes=(*lines_of([note]), *joined.notes, *block.notes))
    if isinstance(block, Positions) and block.sigma is not None:
        block = replace(block, sigma=np.hypot(block.sigma, sigma[:, None]))
    return [block]


def _stated_orders(points: Table, count: int) -> dict[str, np.ndarray]:
    """Return the orders that the file suggests, by names or by rows: description to (m,) index of each point's pose.

    Args:
        points: table of the m points.
        count: number of planned poses.
    """
    orders = dict[str, np.ndarray]()
    name = column_of(points, NAMES)
    if name:
        numbered = []
        for text in points.texts(name):
            digits = re.findall(r"\d+", text)
            numbered.append(int(digits[-1]) - 1 if digits else -1)
        orders["by the numbers in their names"] = _in_plan(np.array(numbered), count)
    if len(points) < MIN_POINTS:
        return orders
    # a run that was interrupted goes on somewhere
    for start in range(max(count - len(points), 0) + 1):
        origin = "in the order of the list"
        if start:
            origin += f" from pose {start + 1} on"
        orders[origin] = _in_plan(np.arange(len(points)) + start, count)
    return orders


def _in_plan(pose: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of poses, with -1 in place of those beyond the `count` planned ones."""
    return np.where(pose < count, pose, -1)


def _stop_sigma(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the standard deviation (m,) [m] per axis of the tip's position due to the accuracy of stopping.

    Each joint is assumed to have the standard deviation `SIGMA_JOINT`.

    Args:
        chain: the arm.
        q: (m, n) joint values [rad or m].
    """
    squares = []
    for axis in np.eye(chain.n):
        ahead = forward(chain, q + STEP * axis)
        behind = forward(chain, q - STEP * axis)
        difference = ahead[:, :3, 3] - behind[:, :3, 3]
        squares.append(np.square(difference))
    rms = np.sqrt(np.sum(squares, axis=(0, 2)) / 3.0)
    return SIGMA_JOINT * rms / (2.0 * STEP)

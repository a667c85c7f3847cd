"""Points that an instrument measured at planned poses, without joint values: the planned joints are used."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.apps.joining.joined import NAMES, column_of
from calib.apps.joining.joining import MIN_POINTS, merged, ordered
from calib.data.csv_table import Table, read_table
from calib.data.poses.columns import POSITION, Sheet
from calib.data.poses.fit_options import FileOptions
from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.data.poses.pose_files import read_measurements
from calib.data.poses.pose_lists import read_poses
from calib.data.poses.robodk import recognises
from calib.errors import finding
from calib.procedure.findings import lines_of
from calib.procedure.robot_kinds import joints_of
from calib.robot.chain import Chain
from calib.robot.kinematics import forward

SIGMA_JOINT = 1e-4  # between a commanded and a reached joint position [rad or m] (our choice)
STEP = 1e-6  # of the differences that propagate it [rad or m]


def read_planned(path: Path, chain: Chain, options: FileOptions) -> list[PoseMeasurements]:
    """Return the points of the file at `path` with the joints of the poses planned in ``options.planned``.

    The poses are those that the points' names number, else those in the list's order; where the nominal arm
    contradicts both, their order is found from it (`calib.apps.joining.order`).

    Returns:
        One block; none where the file has joint columns, or no positions.

    Raises:
        MeasurementError: where the points are not those of the planned poses in any order.
    """
    points = read_table(path)
    sheet = Sheet(points, options)
    forms = {*chain.joint_names, *(f"q_{name}" for name in chain.joint_names), "q1", *options.columns}
    if forms & set(points.header) or recognises(points.header) or not sheet.family(POSITION.names):
        return []
    q = read_poses(options.planned, joints_of(chain))
    pose, notes = ordered(chain, q, points, _stated(points, len(q)), sheet)
    plan = Table(options.planned, chain.joint_names, ("",) * chain.n, tuple(q.T), np.arange(1, len(q) + 1))
    units = tuple(
        sheet.unit(name, "position") if name in sheet.family(POSITION.names) else unit
        for name, unit in zip(points.header, points.units)
    )
    keys = [name for name in [column_of(points, NAMES)] if name]
    joined = merged(plan, replace(points, units=units), pose, notes, keys, name_missing=False)
    (block,) = read_measurements(joined.table, joints_of(chain), replace(options, units={}))
    sigma = _stop_sigma(chain, block.q)
    note = finding("joints-planned", sigma=np.sqrt(np.mean(3.0 * sigma**2)))
    block = replace(block, notes=(*lines_of([note]), *joined.notes, *block.notes))
    if isinstance(block, Positions) and block.sigma is not None:
        block = replace(block, sigma=np.hypot(block.sigma, sigma[:, None]))
    return [block]


def _stated(points: Table, count: int) -> dict[str, np.ndarray]:
    """Return the orders that the file itself may state, in words → (m,) index of the pose."""
    numbers, orders = np.arange(len(points)), dict[str, np.ndarray]()
    starts = range(max(count - len(points), 0) + 1) if len(points) >= MIN_POINTS else ()
    for start in starts:  # a run that was interrupted goes on somewhere
        origin = f"in the order of the list{f' from pose {start + 1} on' if start else ''}"
        orders[origin] = np.where(numbers + start < count, numbers + start, -1)
    if name := column_of(points, NAMES):
        digit_lists = [re.findall(r"\d+", text)[-1:] for text in points.texts(name)]
        numbered = np.array([int(digits[0]) - 1 if digits else -1 for digits in digit_lists])
        orders = {"by the numbers in their names": np.where(numbered < count, numbered, -1)} | orders
    return orders


def _stop_sigma(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the standard deviation (m,) [m] per axis of the tip's position from `SIGMA_JOINT` at each joint."""
    differences = [
        forward(chain, q + STEP * axis)[:, :3, 3] - forward(chain, q - STEP * axis)[:, :3, 3]
        for axis in np.eye(chain.n)
    ]
    return SIGMA_JOINT * np.sqrt(np.sum(np.square(differences), axis=(0, 2)) / 3.0) / (2.0 * STEP)

"""Targets for `calib compensate`: desired poses of the real tool, one per row of a CSV table.

==================  ===================================================================================================
joints              the robot's joint names, or ``q_<joint name>``, or ``q1`` to ``qn``: the pose that the *nominal*
                    robot would have there
pose                ``x y z``, with ``qx qy qz qw`` or ``r11`` to ``r33``; also with ``_target``. Without an
                    orientation only the position counts
both                the pose is the target; the joints say which configuration to keep (elbow, wrist, turns)
==================  ===================================================================================================

A unit in brackets is converted (``q1 [deg]``, ``x [mm]``); plain headers are SI. All other columns are ignored and
listed. Frames are not in the file: they are said by ``--frame`` and ``--tool``.

COMMANDS.csv has one row per target, in their order. Where a target cannot be reached nothing is written, and the exit
code is 2; with ``--partial`` the others are written, and its row has no joints:

==================  ===================================================================================================
row                 the target's number, from 1
joints              what to send, under the targets' joint columns and units (else the joint names, rad or m); empty
                    where the target cannot be reached
status              ``reached`` or ``not reached``
left                position [mm] and orientation [mrad] that the calibrated model leaves at these joints
before              the same for the nominal joints: what goes wrong without compensation
sigma               of the tool's position [mm] and orientation [mrad] (root of the sum over the axes), from the fit's
                    covariance
unseen_rms [mm]     rms error of the calibrated arm on poses that its fit has not seen
expected [mm]       standard deviation of the real tool's position error at this target, all axes together, with all
                    that the model leaves and the instrument's noise, as the fit found it on held-out rows: what to
                    expect of a real arm there; empty where the fit does not say
interval95 [mm]     radius within which 95 % of such errors are to be
extrapolated        1 where a joint stands outside the range that was measured for the fit, else 0
reason              why not, or what is odd
==================  ===================================================================================================
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from calib import files
from calib.column_changes import assigned
from calib.data.csv_table import read_table
from calib.data.poses import plausible
from calib.data.poses.columns import MATRIX, POSITION, QUATERNION, Sheet
from calib.data.poses.fit_options import FileOptions
from calib.data.poses.measurements import PoseMeasurements
from calib.data.schema import BOUNDS, Joints
from calib.errors import MeasurementError, listing
from calib.records import frozen, shaped
from calib.units import ANGLES, JOINT, LENGTHS

SUFFIXES = ("", "_target")
# header of the mass that the tip carries in planned poses
PAYLOAD = "payload [kg]"
# Read-back and commanded joints of one pose differ by less [rad or m] (our choice).
MAX_JOINT_DIFFERENCE = 0.02
# Share of the rows that most rows are (our choice).
HALF = 0.5
# Added to the cost of a reversed joint, so that of two equal ones the unreversed is taken.
REVERSED_COST = 1e-9


def write_poses(
    path: str | Path,
    q: ArrayLike,
    joint_names: Sequence[str],
    kinds: Sequence[str] | None = None,
    payload: np.ndarray | None = None,
) -> Path:
    """Write joint values to a CSV file in deg or mm, with headers such as ``joint1 [deg]``, and return its path.

    Args:
        path: the file.
        q: (m, n) joint values [rad or m].
        joint_names: names of the joints.
        kinds: URDF type of each joint; None: all revolute.
        payload: (m,) mass at the tip in each pose [kg], a further column; None for no such column.
    """
    values = shaped(q, (None, len(joint_names)), "q")
    header, factors = joint_columns(joint_names, kinds or ["revolute"] * len(joint_names))
    values = values * factors
    if payload is not None:
        header.append(PAYLOAD)
        values = np.column_stack([values, payload])
    return files.write_numbers(path, header, values)


def joint_columns(names: Sequence[str], kinds: Sequence[str]) -> tuple[list[str], np.ndarray]:
    """Return the headers of joint columns, ``joint1 [deg]`` or ``[mm]``, and the factors (n,) from SI to the units.

    Args:
        names: names of the joints.
        kinds: URDF type of each joint.
    """
    headers = []
    factors = []
    for name, kind in zip(names, kinds):
        factor, unit = JOINT["prismatic" if kind == "prismatic" else "revolute"]
        headers.append(f"{name} [{unit}]")
        factors.append(factor)
    return headers, np.array(factors)


def filled_in(path: Path, joints: int) -> bool:
    """Return whether the user has entered measurements into a CSV list of planned poses with `joints` joint columns.

    Args:
        path: the CSV file.
        joints: number of joint columns.
    """
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    planned = joints
    if lines and re.split("[,;\t]", lines[0])[joints : joints + 1] == [PAYLOAD]:
        planned += 1
    for line in lines[1:]:
        cells = re.split("[,;\t]", line)
        if any(cell.strip() for cell in cells[planned:]):
            return True
    return False


def read_poses(
    source: str | Path | ArrayLike | PoseMeasurements,
    joints: Joints | Sequence[str],
    options: FileOptions | None = None,
) -> np.ndarray:
    """Return joint values (m, n) [rad or m] in the order of `joints`, from a CSV file, measurements or an array.

    A file's columns and checks are those of a measurement file.

    Args:
        source: a CSV file, measurements, or joint values (m, n) [rad or m].
        joints: the robot's n joints, or only their names (then taken as revolute without limits).
        options: options for reading a file; None: the defaults.
    """
    robot = Joints.of(joints)
    if not isinstance(source, str | Path):
        q = source.q if isinstance(source, PoseMeasurements) else source
        return shaped(q, (None, len(robot.names)), "joint values")
    sheet = Sheet(read_table(source), options or FileOptions())
    sheet.check_names(robot.names)
    q, columns = sheet.joints(robot)
    if len(q) > 1:
        check_planned(q, sheet, columns, robot)
    return q


def check_planned(q: np.ndarray, sheet: Sheet, columns: Sequence[str], robot: Joints) -> tuple[str, ...]:
    """Check planned joint values and return the notes of `check_joints`; a plan may consist of one repeated pose.

    Args:
        q: (m, n) planned joint values [rad or m].
        sheet: the file's table with its options.
        columns: the file's names of the joint columns.
        robot: types and limits of the joints.
    """
    moves = np.ptp(q, axis=0).max() > BOUNDS.min_travel
    return plausible.check_joints(q if moves else q[:1], sheet, columns, robot)


def check_against(
    plan: ArrayLike, measured: PoseMeasurements, max_difference: float = MAX_JOINT_DIFFERENCE
) -> tuple[str, ...]:
    """Return notes on measured rows that were not planned.

    A planned and a measured pose count as equal if no joint differs by more than `max_difference`.

    Args:
        plan: (k, n) planned joint values [rad or m].
        measured: the measurements.
        max_difference: largest difference of a joint [rad or m].

    Raises:
        MeasurementError: most rows were not planned; the message names the cause if degrees, or swapped or reversed
            joint columns, explain it.
    """
    plan = shaped(plan, (None, measured.q.shape[1]), "plan")
    q, rows = _distinct(measured)
    is_planned = _has_match(plan, q, max_difference)
    if is_planned.mean() < HALF:
        raise _explain(plan, q, rows, measured, max_difference)
    unplanned = rows[~is_planned]
    if not len(unplanned):
        return ()
    return (f"{len(unplanned)} rows were not planned: {listing(unplanned, 10)}",)


def unmeasured(
    plan: ArrayLike, measured: Sequence[PoseMeasurements], max_difference: float = MAX_JOINT_DIFFERENCE
) -> tuple[str, ...]:
    """Return a note on the planned poses that are in none of the measured blocks; () if all were measured.

    Args:
        plan: (k, n) planned joint values [rad or m].
        measured: blocks of measurements.
        max_difference: largest difference of a joint between equal poses [rad or m].
    """
    if not measured:
        return ()
    plan = np.asarray(plan)
    is_measured = [_has_match(block.q, plan, max_difference) for block in measured]
    remaining = np.flatnonzero(~np.any(is_measured, axis=0)) + 1
    if not len(remaining):
        return ()
    note = f"{len(remaining)} of {len(plan)} planned poses remain to be measured: {listing(remaining, 10)}"
    return (f"{note} (in a further file, then calib next again)",)


def _distinct(measured: PoseMeasurements) -> tuple[np.ndarray, np.ndarray]:
    """Return joint values and row numbers of a block, with each row of the file once.

    Several targets measured at one pose come from one row of the file.
    """
    rows, first = np.unique(measured.rows if measured.rows is not None else [], return_index=True)
    return measured.q[first], rows


def _has_match(candidates: np.ndarray, q: np.ndarray, max_difference: float) -> np.ndarray:
    """Return for each row of `q` whether a row of `candidates` differs by at most `max_difference` in every joint.

    Args:
        candidates: (k, n) joint values to compare with [rad or m].
        q: (m, n) joint values [rad or m].
        max_difference: largest difference of a joint between equal poses [rad or m].
    """
    distance, _ = KDTree(candidates).query(q, p=math.inf)
    return distance <= max_difference


def _explain(
    plan: np.ndarray, q: np.ndarray, rows: np.ndarray, measured: PoseMeasurements, max_difference: float
) -> MeasurementError:
    names = measured.joint_names
    units = ((1.0, ""), (math.pi / 180, "degrees"), (180 / math.pi, "radians converted from degrees"))
    for factor, unit in units:
        order, sign = _best_order(plan, q * factor)
        if _has_match(plan, q[:, order] * sign * factor, max_difference).mean() < HALF:
            continue
        causes = []
        if unit:
            causes.append(f"the values are {unit}")
        swapped = [j for j in range(len(names)) if order[j] != j]
        if swapped:
            pairs = ", ".join(f"{names[order[j]]} contains joint {j + 1}" for j in swapped)
            causes.append(f"columns are swapped ({pairs})")
        if (sign < 0).any():
            reversed_names = ", ".join(names[order[j]] for j in np.flatnonzero(sign < 0))
            causes.append(f"the sign is reversed ({reversed_names})")
        message = f"the measured joints agree with the plan if {' and '.join(causes)}"
        column = names[order[swapped[0]]] if swapped else names[0]
        return MeasurementError(f"{message}; correct the header or the options", measured.file, None, column)
    distance, index = KDTree(plan).query(q, p=math.inf)
    distance, index = np.atleast_1d(distance), np.atleast_1d(index)
    worst = int(np.argmax(distance))
    joint = int(np.argmax(np.abs(q[worst] - plan[index[worst]])))
    count = int((distance <= max_difference).sum())
    message = (
        f"only {count} of {len(q)} rows are planned poses; the one nearest to this row differs by {distance[worst]:.3g}"
    )
    advice = "is this the right plan? If other poses were measured on purpose, set plan = false under [poses]"
    return MeasurementError(f"{message}: {advice} in session.toml", measured.file, int(rows[worst]), names[joint])


def _best_order(plan: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which measured column fits each planned joint best (n,), and the sign of the match (n,).

    Each pair of columns is compared as two sets of numbers (mean distance to the nearest number, at most 1), so that
    order and completeness of the rows do not matter. The assignment of columns minimises the sum of these distances.

    Args:
        plan: (k, n) planned joint values [rad or m].
        q: (m, n) measured joint values [rad or m].
    """
    n = plan.shape[1]
    cost = np.empty((2, n, n))
    for j in range(n):
        planned = KDTree(plan[:, j : j + 1])
        for k in range(n):
            for s, sign in enumerate((1.0, -1.0)):
                to_plan = planned.query(sign * q[:, k : k + 1])[0]
                from_plan = KDTree(sign * q[:, k : k + 1]).query(plan[:, j : j + 1])[0]
                mean_distance = np.minimum(to_plan, 1.0).mean() + np.minimum(from_plan, 1.0).mean()
                cost[s, j, k] = mean_distance + REVERSED_COST * s
    return assigned(cost)


@dataclass(frozen=True, eq=False)
class Targets:
    """Targets of a compensation from one file, m rows.

    Attributes:
        q: (m, n) nominal joint values [rad or m]; None if the file has none.
        position: (m, 3) desired tool positions [m]; None if joint values define the targets.
        rotation: (m, 3, 3) desired tool orientations; None without orientations.
        columns: the file's headers of the joint columns, with units in brackets; () without joints.
        factors: (n,) SI value of one unit of each joint column.
        ignored: names of columns that were not read.
        notes: remarks on unusual values that were accepted.
        file: path of the file.
    """

    q: np.ndarray | None
    position: np.ndarray | None = None
    rotation: np.ndarray | None = None
    columns: tuple[str, ...] = ()
    factors: tuple[float, ...] = ()
    ignored: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    file: str = ""

    def __post_init__(self) -> None:
        for name in ("q", "position", "rotation"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, frozen(value))

    @staticmethod
    def of(targets: Targets | np.ndarray) -> Targets:
        """Return targets from memory: poses (m, 4, 4) [m], or joint values (m, n) [rad or m]."""
        if isinstance(targets, Targets):
            return targets
        if targets.ndim == 3:
            return Targets(None, targets[:, :3, 3], targets[:, :3, :3], file="the array")
        return Targets(targets, file="the array")

    def __len__(self) -> int:
        return len(self.q if self.q is not None else self.position)  # ty: ignore[invalid-argument-type]  # one of them is there


def read_targets(path: str | Path, joints: Joints | Sequence[str]) -> Targets:
    """Return the targets in the file at `path`.

    Args:
        path: the CSV file.
        joints: the robot's n joints, or only their names. Some rows may be outside the joint limits; a file with most
            rows outside is refused.

    Raises:
        MeasurementError: an invalid file or value; the message contains row and column.
    """
    sheet = Sheet(read_table(path), suffixes=SUFFIXES)
    robot = Joints.of(joints)
    table, joints = sheet.table, robot.names
    joint_forms = (*joints, *(f"q_{name}" for name in joints), *(f"q{k + 1}" for k in range(len(joints))))
    position_columns = sheet.family(POSITION.names)
    rotation_columns = sheet.family(QUATERNION.names) or sheet.family(MATRIX.names)
    q, joint_headings, notes = None, (), ()
    if any(name in table for name in joint_forms):
        q, joint_headings = sheet.joints(robot)
        # Limits count where most rows are outside of them: it is the file then, not the row.
        outside_share = plausible.outside(q, robot.lower, robot.upper).any(axis=1).mean()
        if outside_share <= HALF:
            robot = replace(robot, lower=None, upper=None)
        notes = check_planned(q, sheet, joint_headings, robot)
    if not joint_headings and not position_columns and not rotation_columns:
        needed = f"joints ({', '.join(joints)}, or q1 to q{len(joints)}), or x y z with or without qx qy qz qw"
        sheet.fail(f"no targets found: expected {needed}; found {', '.join(table.header)}")
    if rotation_columns and not position_columns:
        sheet.fail(f"has {rotation_columns[0]} but no x y z: a target needs a position")

    position = None
    if position_columns:
        position = sheet.numbers(position_columns, POSITION)
    rotation = None
    if rotation_columns:
        rotation = Rotation.from_quat(plausible.orientation(sheet, rotation_columns)).as_matrix()
    columns = []
    factors = []
    for name in joint_headings:
        unit = table.units[table.index(name)]
        columns.append(f"{name} [{unit}]" if unit else name)
        factors.append((ANGLES | LENGTHS)[unit.lower()] if unit else 1.0)
    read_columns = {*joint_headings, *position_columns, *rotation_columns}
    return Targets(
        q=q,
        position=position,
        rotation=rotation,
        columns=tuple(columns),
        factors=tuple(factors),
        ignored=tuple(name for name in table.header if name not in read_columns),
        notes=notes,
        file=table.file,
    )

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

MAX_JOINT_DIFFERENCE = 0.02  # read-back and commanded joints of one pose differ by less [rad or m]; our choice


def write_poses(path: str | Path, q: ArrayLike, joint_names: Sequence[str], kinds: Sequence[str] | None = None) -> Path:
    """Write joint values (m, n) [rad or m] to a CSV file in deg or mm, under ``joint1 [deg]``.

    Args:
        kinds: URDF's type of each joint; all revolute by default.
    """
    values = shaped(q, (None, len(joint_names)), "q")
    header, factors = joint_columns(joint_names, kinds or ["revolute"] * len(joint_names))
    return files.write_numbers(path, header, values * factors)


def joint_columns(names: Sequence[str], kinds: Sequence[str]) -> tuple[list[str], np.ndarray]:
    """Return headers of joints' columns for people, ``joint1 [deg]`` or ``[mm]``, and the factors (n,) from SI."""
    units = [JOINT["prismatic" if kind == "prismatic" else "revolute"] for kind in kinds]
    return [f"{name} [{unit}]" for name, (_, unit) in zip(names, units)], np.array([factor for factor, _ in units])


def filled_in(path: Path, joints: int) -> bool:
    """Return whether the user has entered measurements into a list of planned poses."""
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()[1:]
    return any(cell.strip() for line in lines for cell in re.split("[,;\t]", line)[joints:])


def read_poses(
    given: str | Path | ArrayLike | PoseMeasurements, joints: Joints | Sequence[str], options: FileOptions | None = None
) -> np.ndarray:
    """Return joint values (m, n) [rad or m] in the order of `joints`, from a CSV file, measurements or an array.

    Columns and checks of a file are those of measurements.
    """
    robot = Joints.of(joints)
    if not isinstance(given, str | Path):
        q = given.q if isinstance(given, PoseMeasurements) else given
        return shaped(q, (None, len(robot.names)), "joint values")
    sheet = Sheet(read_table(given), options or FileOptions())
    sheet.check_names(robot.names)
    q, columns = sheet.joints(robot.names)
    if len(q) > 1:
        check_planned(q, sheet, columns, robot)
    return q


def check_planned(q: np.ndarray, sheet: Sheet, columns: Sequence[str], robot: Joints) -> tuple[str, ...]:
    """Check planned joint values and return the notes of `check_joints`; a plan may repeat one pose."""
    moves = np.ptp(q, axis=0).max() > BOUNDS.min_travel
    return plausible.check_joints(q if moves else q[:1], sheet, columns, robot)


def check_against(plan: ArrayLike, measured: PoseMeasurements, near: float = MAX_JOINT_DIFFERENCE) -> tuple[str, ...]:
    """Return notes on differences between measured joint values and planned poses (m, n) [rad or m].

    A planned and a measured pose are the same if no joint differs by more than `near`.

    Returns:
        Notes: rows that nobody planned.

    Raises:
        MeasurementError: where most rows were not planned, with the cause if degrees, swapped or reversed joint
            columns explain it.
    """
    plan = shaped(plan, (None, measured.q.shape[1]), "plan")
    q, rows = _distinct(measured)
    if (matched := _matched(plan, q, near)).mean() < 0.5:
        raise _explain(plan, q, rows, measured, near)
    strange = rows[~matched]
    return (f"{len(strange)} rows were not planned: {listing(strange, 10)}",) if len(strange) else ()


def unmeasured(
    plan: ArrayLike, measured: Sequence[PoseMeasurements], near: float = MAX_JOINT_DIFFERENCE
) -> tuple[str, ...]:
    """Return a note on the planned poses (m, n) [rad or m] that are in none of the blocks; empty if all are."""
    found = [_matched(block.q, np.asarray(plan), near) for block in measured]
    remain = np.flatnonzero(~np.any(found, axis=0)) + 1 if found else ()
    words = f"{len(remain)} of {len(np.asarray(plan))} planned poses remain to be measured: {listing(remain, 10)}"
    return (f"{words} (in a further file, then calib next again)",) if len(remain) else ()


def _distinct(measured: PoseMeasurements) -> tuple[np.ndarray, np.ndarray]:
    """Return joint values and file row numbers, one per row of the file (several targets share a row)."""
    rows, first = np.unique(measured.rows if measured.rows is not None else [], return_index=True)
    return measured.q[first], rows


def _matched(these: np.ndarray, those: np.ndarray, near: float) -> np.ndarray:
    """Return the mask of rows of `those` with a row of `these` within `near` (largest joint difference)."""
    distance, _ = KDTree(these).query(those, p=math.inf)
    return distance <= near


def _explain(
    plan: np.ndarray, q: np.ndarray, rows: np.ndarray, measured: PoseMeasurements, near: float
) -> MeasurementError:
    names = measured.joint_names
    for factor, what in ((1.0, ""), (math.pi / 180, "degrees"), (180 / math.pi, "radians converted from degrees")):
        order, sign = _best_order(plan, q * factor)
        if _matched(plan, q[:, order] * sign * factor, near).mean() < 0.5:
            continue
        causes = [f"the values are {what}"] if what else []
        moved = [j for j in range(len(names)) if order[j] != j]
        if moved:
            pairs = ", ".join(f"{names[order[j]]} contains joint {j + 1}" for j in moved)
            causes.append(f"columns are swapped ({pairs})")
        if (sign < 0).any():
            turned = ", ".join(names[order[j]] for j in np.flatnonzero(sign < 0))
            causes.append(f"the sign is reversed ({turned})")
        message = f"the measured joints agree with the plan if {' and '.join(causes)}"
        column = names[order[moved[0]]] if moved else names[0]
        return MeasurementError(f"{message}; correct the header or the options", measured.file, None, column)
    distance, index = (np.atleast_1d(found) for found in KDTree(plan).query(q, p=math.inf))
    worst = int(np.argmax(distance))
    joint = int(np.argmax(np.abs(q[worst] - plan[index[worst]])))
    count = int((distance <= near).sum())
    message = f"only {count} of {len(q)} rows are planned poses; the nearest one differs by {distance[worst]:.3g}"
    advice = "is it the right plan? If other poses were measured on purpose, set plan = false under [poses]"
    return MeasurementError(f"{message}: {advice} in session.toml", measured.file, int(rows[worst]), names[joint])


def _best_order(plan: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which measured column fits each planned joint best (n,), and its sign (n,).

    Each pair of columns is compared as two sets of numbers (mean distance to the nearest one, at most 1), so that order
    and completeness of the rows do not matter; the assignment minimises the sum.
    """
    n = plan.shape[1]
    cost = np.empty((2, n, n))
    for j in range(n):
        planned = KDTree(plan[:, j : j + 1])
        for k in range(n):
            for s, sign in enumerate((1.0, -1.0)):
                taken = planned.query(sign * q[:, k : k + 1])[0]
                missed = KDTree(sign * q[:, k : k + 1]).query(plan[:, j : j + 1])[0]
                cost[s, j, k] = np.minimum(taken, 1.0).mean() + np.minimum(missed, 1.0).mean() + 1e-9 * s
    return assigned(cost)


SUFFIXES = ("", "_target")


@dataclass(frozen=True, eq=False)
class Targets:
    """Targets of a compensation from one file, m rows.

    Attributes:
        q: (m, n) nominal joint values [rad or m]; None where the file has none.
        position: (m, 3) [m]; None where joints say it all.
        rotation: (m, 3, 3); None without an orientation.
        columns: the file's names of the joint columns with their units in brackets; () without joints.
        factors: (n,) SI value of one unit of each joint column.
        ignored: columns that were not read.
        notes: what is odd but was accepted.
        file: where it came from.
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
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, frozen(value))

    @staticmethod
    def of(given: Targets | np.ndarray) -> Targets:
        """Return targets in memory: poses (m, 4, 4) [m], or joint values (m, n) [rad or m]."""
        if isinstance(given, Targets):
            return given
        if given.ndim == 3:
            return Targets(None, given[:, :3, 3], given[:, :3, :3], file="the array")
        return Targets(given, file="the array")

    def __len__(self) -> int:
        return len(self.q if self.q is not None else self.position)  # type: ignore[arg-type]  # one of them is there


def read_targets(path: str | Path, joints: Joints | Sequence[str]) -> Targets:
    """Return the targets in the file at `path` for a robot with these joints.

    Args:
        joints: the robot's n joints, or their names. Single rows may lie outside the limits; a file of which most rows
            do holds something else.

    Raises:
        MeasurementError: for whatever cannot be what it claims to be, with row and column.
    """
    sheet, robot = Sheet(read_table(path), suffixes=SUFFIXES), Joints.of(joints)
    table, joints = sheet.table, robot.names
    forms = (*joints, *(f"q_{name}" for name in joints), *(f"q{k + 1}" for k in range(len(joints))))
    position, turned = sheet.family(POSITION.names), sheet.family(QUATERNION.names) or sheet.family(MATRIX.names)
    q, columns, notes = None, (), ()
    if any(name in table for name in forms):
        q, columns = sheet.joints(joints)
        # limits count where most rows (our choice) are outside: it is the file then, not the row
        outside = plausible.outside(q, robot.lower, robot.upper).any(axis=1).mean() > 0.5
        notes = check_planned(q, sheet, columns, robot if outside else replace(robot, lower=None, upper=None))
    if not columns and not position and not turned:
        needed = f"joints ({', '.join(joints)}, or q1 to q{len(joints)}), or x y z with or without qx qy qz qw"
        sheet.fail(f"no targets found: expected {needed}; found {', '.join(table.header)}")
    if turned and not position:
        sheet.fail(f"has {turned[0]} but no x y z: a target needs a position")
    used = {*columns, *position, *turned}
    units = [table.units[table.index(name)] for name in columns]
    return Targets(
        q,
        sheet.numbers(position, POSITION) if position else None,
        Rotation.from_quat(plausible.orientation(sheet, turned)).as_matrix() if turned else None,
        tuple(f"{name} [{unit}]" if unit else name for name, unit in zip(columns, units)),
        tuple((ANGLES | LENGTHS)[unit.lower()] if unit else 1.0 for unit in units),
        tuple(name for name in table.header if name not in used),
        notes,
        table.file,
    )

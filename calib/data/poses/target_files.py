"""Targets for `calib compensate`: where the real tool is to stand, one row each, as a CSV table.

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

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.arrays import frozen
from calib.data.csv_table import read_table
from calib.data.poses import plausible
from calib.data.poses.columns import MATRIX, POSITION, QUATERNION, Sheet
from calib.data.poses.plans import check_planned
from calib.data.poses.plausible import Limits
from calib.data.schema import BOUNDS
from calib.units import ANGLES, LENGTHS

SUFFIXES = ("", "_target")


@dataclass(frozen=True, eq=False)
class Targets:
    """m targets from one file.

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

    @staticmethod
    def of(given: Targets | np.ndarray) -> Targets:
        """Return targets in memory: poses (m, 4, 4) [m], or joint values (m, n) [rad or m]."""
        if isinstance(given, Targets):
            return given
        if given.ndim == 3:
            return Targets(None, given[:, :3, 3], given[:, :3, :3], file="the array")
        return Targets(given, file="the array")

    def __post_init__(self) -> None:
        for name in ("q", "position", "rotation"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, frozen(value))

    def __len__(self) -> int:
        return len(self.q if self.q is not None else self.position)  # type: ignore[arg-type]  # one of them is there


def read_targets(
    path: str | Path, joints: Sequence[str], *, kinds: Sequence[str] | None = None, limits: Limits | None = None
) -> Targets:
    """Read the targets in `path` for a robot with these joints.

    Args:
        joints: the robot's n joint names.
        kinds: URDF's type of each joint (revolute, continuous, prismatic); all revolute by default.
        limits: lower and upper limits, each (n,) [rad or m]. Single rows may lie outside; a file of which most rows do
            holds something else.

    Raises:
        MeasurementError: for whatever cannot be what it claims to be, with row and column.
    """
    sheet = Sheet(read_table(path), suffixes=SUFFIXES)
    table = sheet.table
    forms = (*joints, *(f"q_{name}" for name in joints), *(f"q{k + 1}" for k in range(len(joints))))
    position, turned = sheet.family(POSITION.names), sheet.family(QUATERNION.names) or sheet.family(MATRIX.names)
    q, columns, notes = None, (), ()
    if any(name in table for name in forms):
        q, columns = sheet.joints(joints)
        notes = check_planned(q, sheet, columns, joints, kinds, _kept_by_most(q, limits))
    if not columns and not position and not turned:
        needed = f"joints ({', '.join(joints)}, or q1 to q{len(joints)}), or x y z with or without qx qy qz qw"
        sheet.fail(f"no targets found: expected {needed}; found {', '.join(table.header)}")
    if turned and not position:
        sheet.fail(f"has {turned[0]} but no x y z: an orientation alone is no target")
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


def _kept_by_most(q: np.ndarray, limits: Limits | None, max_outside: float = 0.5) -> Limits | None:
    """Return `limits` where most rows of q (m, n) are outside: it is the file then, not the row.

    `max_outside`: of all rows outside the limits: it is the file, not the row (our choice).
    """
    if limits is None:
        return None
    lower, upper = (np.asarray(side, dtype=float) for side in limits)
    outside = ((q < lower - BOUNDS.limit_slack) | (q > upper + BOUNDS.limit_slack)).any(axis=1)
    return limits if outside.mean() > max_outside else None

"""Direction of measured poses, and parts of a set-up that agree only each by itself.

Poses of the target in the instrument's frame are B_i = S A_i X with the arm's poses A_i; those of the instrument in the
target's frame are their inverses. Which it is, is told by the misfit after the best placements S and X (Shah 2013): of
all rows, or, where these do not agree, of half of them or of rows paired with the next pose, so that a change halfway
or a shift of rows does not hide the direction.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Poses, Positions
from calib.errors import Finding, finding
from calib.geometry.first_guess import (
    LEVER,
    Placements,
    checked_rows,
    chordal_turns,
    misfit,
    place_pose,
    place_position,
)
from calib.records import evenly
from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from calib.transforms import from_quaternion, invert
from calib.units import DEG

# Smallest ratio of misfits at which one direction is taken, and at which one is taken by some of the rows only.
CLEAR_RATIO = 2.5
CLEAR_RATIO_OF_PART = 5.0
# Largest misfit of poses that agree, as a share of the arm's motion, rotations included.
MAX_SHARE = 0.1
# Fewest rows of which both directions are tried, and of a part of the rows.
MIN_ROWS = 4
MIN_PART = 5
# The same of positions: the two placements take nine of their numbers.
MIN_PART_OF_POSITIONS = 8
# Smallest misfit of positions, as a share of the arm's motion, at which a change is searched for: smaller ones are for
# `calib.geometry.checks.row_changes`.
MIN_SHARE_OF_POSITIONS = 0.01
# Largest number of rows in which a change is searched for.
MAX_ROWS = 150
# Largest misfit of two parts, as a share of the misfit of all rows.
MAX_LEFT = 0.2
# Smallest changes that are named: angle [rad] and distance [m].
MIN_TURN = 0.5 * DEG
MIN_SHIFT = 1e-3

Placing = Callable[[np.ndarray, np.ndarray], Placements]


@dataclass(frozen=True)
class Direction:
    """How poses agree with those of an arm, read as they are and as their inverse.

    Attributes:
        direct, inverse: median misfits of all rows [m], angles included.
        is_inverse: whether the inverse is to be taken; None where both agree, or neither.
        agrees: whether one of the readings agrees, for all rows or for a part of them.
    """

    direct: float
    inverse: float
    is_inverse: bool | None
    agrees: bool


def direction(arm: np.ndarray, measured: np.ndarray) -> Direction:
    """Return in which direction poses agree with an arm's.

    Args:
        arm: (m, 4, 4) poses of the tip in the base.
        measured: (m, 4, 4) poses of the target in the instrument's frame, or their inverses.
    """
    opposite = invert(measured)
    limit = MAX_SHARE * _motion(arm)
    direct = median_misfit(arm, measured)
    inverse = median_misfit(arm, opposite)
    smaller, larger = sorted((direct, inverse))
    if smaller < limit:
        is_inverse = None
        if larger > CLEAR_RATIO * smaller:
            is_inverse = inverse < direct
        return Direction(direct, inverse, is_inverse, True)
    part_direct = min(_misfits_of_parts(arm, measured), default=direct)
    part_inverse = min(_misfits_of_parts(arm, opposite), default=inverse)
    smaller, larger = sorted((part_direct, part_inverse))
    if smaller < limit and larger > CLEAR_RATIO_OF_PART * smaller:
        return Direction(direct, inverse, part_inverse < part_direct, True)
    return Direction(direct, inverse, None, False)


def median_misfit(arm: np.ndarray, measured: np.ndarray) -> float:
    """Return the median misfit [m] of poses B_i = S A_i X with the best S and X, angles included.

    Args:
        arm: (m, 4, 4) A_i.
        measured: (m, 4, 4) B_i.
    """
    with warnings.catch_warnings():
        # SciPy's, of poses that turn too little; their misfit says it
        warnings.simplefilter("ignore", UserWarning)
        placements = place_pose(arm, measured)
    return float(np.median(misfit(arm, measured, *placements, LEVER)))


def _misfits_of_parts(arm: np.ndarray, measured: np.ndarray) -> Iterator[float]:
    """Yield the median misfits of both halves of the rows, and of rows paired with the next and the previous pose."""
    m = len(arm)
    if m < 2 * MIN_PART:
        return
    half = m // 2
    yield median_misfit(arm[:half], measured[:half])
    yield median_misfit(arm[half:], measured[half:])
    yield median_misfit(arm[1:], measured[:-1])
    yield median_misfit(arm[:-1], measured[1:])


def _motion(poses: np.ndarray) -> float:
    """Return the rms motion [m] of poses (m, 4, 4) about their mean, rotations included."""
    distance = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    _, turns = chordal_turns(poses[:, :3, :3])
    squares = np.sum(distance**2, axis=1) + LEVER**2 * np.sum(turns**2, axis=1)
    return float(np.sqrt(np.mean(squares)))


def as_seen_by_instrument(chain: Chain, block: PoseMeasurements) -> PoseMeasurements:
    """Return poses of the target in the instrument's frame, inverted if they are those of the instrument in it.

    The first is a tracker's convention, and that of a camera beside the arm; a camera on the arm measures the second:
    the board in its own frame. The reading is taken that agrees with the arm; a note says so where it is the second.

    Args:
        chain: the nominal arm.
        block: measurements of any kind; only full poses are tried both agreement.
    """
    if not isinstance(block, Poses) or block.lever is not None or block.base is not None:
        return block
    rows = checked_rows(block)
    if len(rows) < MIN_ROWS:
        return block
    arm = forward(chain, block.q[rows])
    agreement = direction(arm, from_quaternion(block.position[rows], block.quaternion[rows]))
    if not agreement.is_inverse:
        return block
    note = (
        f"the poses agree as their inverse ({1e3 * agreement.inverse:.3g} mm, as they are "
        f"{1e3 * agreement.direct:.3g} mm, median misfit): read as what stands (board) seen from what the arm carries "
        "(camera)"
    )
    if not block.mounting:
        note += "; if the arm carries the board, state [camera] mounting = 'to hand' in the options"
    return replace(block.inverted(), notes=(*block.notes, note))


def parted_set_up(chain: Chain, block: PoseMeasurements) -> list[Finding]:
    """Return a finding if the rows before and after some row agree with the arm each by themselves, not together.

    This finds large changes, in small sets too; `calib.geometry.checks.row_changes` finds small ones.

    Args:
        chain: the nominal arm.
        block: measurements of any kind; only positions and full poses are tested.
    """
    min_part = MIN_PART if isinstance(block, Poses) else MIN_PART_OF_POSITIONS
    if not isinstance(block, Positions) or not 2 * min_part <= len(block) <= MAX_ROWS or np.ptp(block.tool) > 0:
        return []
    arm = forward(chain, block.q)
    if isinstance(block, Poses):
        solve: Placing = place_pose
        measured = from_quaternion(block.position, block.quaternion)
    else:
        solve = _place_positions
        measured = from_quaternion(block.position, np.tile([0.0, 0.0, 0.0, 1.0], (len(block), 1)))
    together = _rms_misfit(arm, measured, solve)
    if solve is not place_pose and together < MIN_SHARE_OF_POSITIONS * _motion(arm):
        return []

    def squares(cut: int) -> float:
        before = _rms_misfit(arm[:cut], measured[:cut], solve)
        after = _rms_misfit(arm[cut:], measured[cut:], solve)
        return cut * before**2 + (len(arm) - cut) * after**2

    cut = min(range(min_part, len(arm) - min_part + 1), key=squares)
    parted = float(np.sqrt(squares(cut) / len(arm)))
    if parted > MAX_LEFT * together or parted > MAX_SHARE * _motion(arm):
        return []
    station, tool = solve(arm[:cut], measured[:cut])
    later_station, later_tool = solve(arm[cut:], measured[cut:])
    carried = invert(tool) @ later_tool
    standing = station @ invert(later_station)
    changed, change = ("what the arm carries", carried)
    if _size(standing) > _size(carried):
        changed, change = ("what stands beside the arm", standing)
    angle = _angle(change)
    shift = float(np.linalg.norm(change[:3, 3]))
    if angle < MIN_TURN and shift < MIN_SHIFT:
        return []
    rows = block.rows
    return [
        finding(
            "set-up-parted",
            file=block.file.rsplit("/", 1)[-1] or "measurements",
            first=rows[0],
            last=rows[cut - 1],
            next=rows[cut],
            end=rows[-1],
            apart=parted,
            together=together,
            changed=changed,
            angle=angle,
            shift=shift,
        )
    ]


def _place_positions(arm: np.ndarray, measured: np.ndarray) -> Placements:
    """Return the placements S and X for measured positions; the rotations of `measured` (m, 4, 4) are not used."""
    return place_position(arm, measured[:, :3, 3], None, None)


def _rms_misfit(arm: np.ndarray, measured: np.ndarray, solve: Placing) -> float:
    """Return the rms misfit [m] of poses with the best placements; angles are included where they were measured."""
    rows = evenly(len(arm), MAX_ROWS)
    lever = LEVER if solve is place_pose else 0.0
    values = misfit(arm[rows], measured[rows], *solve(arm[rows], measured[rows]), lever)
    return float(np.sqrt(np.mean(values**2)))


def _angle(change: np.ndarray) -> float:
    """Return the angle [rad] of a motion (4, 4)."""
    cosine = 0.5 * (np.trace(change[:3, :3]) - 1.0)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _size(change: np.ndarray) -> float:
    """Return the size of a motion (4, 4) [m], its angle included."""
    return float(np.linalg.norm(change[:3, 3])) + LEVER * _angle(change)

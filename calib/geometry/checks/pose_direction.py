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
from calib.geometry.checks import pose_steps, row_lags
from calib.geometry.first_guess import LEVER, checked_rows, chordal_turns, misfit, place_pose, place_position
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
# Fewest positions of a part: the two placements take nine of their numbers.
MIN_PART_OF_POSITIONS = 8
# Smallest misfit of positions, as a share of the arm's motion, at which a change is searched for: smaller ones are for
# `calib.geometry.checks.row_changes`.
MIN_SHARE_OF_POSITIONS = 0.01
# What changed, by the part of the set-up.
CHANGED = {"tool": "what the arm carries", "station": "what stands beside the arm"}
# Numbers of parts into which rows are divided: after two changes, one of five parts is of one set-up.
PARTS = (2, 3, 5)
# Shares of the rows, from the first on, in which a change is searched for where several may be.
BEGINNINGS = (0.8, 0.65, 0.5)
# Largest number of rows in which a change is searched for.
MAX_ROWS = 150
# Largest misfit of two parts by themselves, as a share of the misfit of all rows together.
MAX_LEFT = 0.2
# Smallest changes that are named: angle [rad] and distance [m].
MIN_TURN = 0.5 * DEG
MIN_SHIFT = 1e-3


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
    """Yield the median misfits of parts of the rows, and of rows that lag behind the arm's or lead them."""
    m = len(arm)
    if m < 2 * MIN_PART:
        return
    for count in PARTS:
        size = m // count
        if size < MIN_PART:
            continue
        for start in range(0, size * count, size):
            stop = start + size
            yield median_misfit(arm[start:stop], measured[start:stop])
    lag = row_lags.last_lag(arm, measured)
    if lag:
        first = row_lags.first_of_lag(arm, measured, lag)
        partners = np.arange(first, m) + lag
        present = (partners >= 0) & (partners < m)
        if present.sum() >= MIN_PART:
            yield median_misfit(arm[partners[present]], measured[first:][present])


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
        block: measurements of any kind; only full poses are tried in both directions.
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
    subject = "the poses agree"
    if agreement.inverse > MAX_SHARE * _motion(arm):
        subject = "the poses do not agree with the arm; some of their rows, or shifted rows, do"
    note = (
        f"{subject} as their inverse ({1e3 * agreement.inverse:.3g} mm, as they are "
        f"{1e3 * agreement.direct:.3g} mm, median misfit): read as what stands (board) seen from what the arm carries "
        "(camera)"
    )
    if not block.mounting:
        note += "; if the arm carries the board, state [camera] mounting = 'to hand' in the options"
    return replace(block.inverted(), notes=(*block.notes, note))


def parted_set_up(chain: Chain, block: PoseMeasurements) -> list[Finding]:
    """Return a finding if the rows before and after some row agree with the arm each by themselves, not together.

    Large changes are found by placing both parts, small ones of full poses by `calib.geometry.checks.pose_steps`.

    Args:
        chain: the nominal arm.
        block: measurements of any kind; only positions and full poses are tested.
    """
    if not isinstance(block, Positions) or not 2 * MIN_PART <= len(block) <= MAX_ROWS or np.ptp(block.tool) > 0:
        return []
    arm = forward(chain, block.q)
    if isinstance(block, Poses):
        return _parted_poses(block, arm)
    return _parted_positions(block, arm)


def _parted_poses(block: Poses, arm: np.ndarray) -> list[Finding]:
    """Return a finding if the set-up was another after some row of full poses.

    Args:
        block: the poses.
        arm: (m, 4, 4) poses of the tip in the base.
    """
    measured = from_quaternion(block.position, block.quaternion)
    end = len(arm)
    step = pose_steps.small_step(arm, measured, place_pose(arm, measured)) or _large_step(arm, measured)
    if step is None and _rms_misfit(arm, measured) > MAX_SHARE * _motion(arm):
        # the first of several changes
        for share in BEGINNINGS:
            end = round(share * len(arm))
            step = _large_step(arm[:end], measured[:end])
            if step is not None:
                break
    if step is None:
        return []
    turned = f"{step.angle / DEG:.3g}° (σ {step.angle_sigma / DEG:.1g}°)"
    moved = f"{1e3 * step.shift:.3g} mm (σ {1e3 * step.shift_sigma:.1g} mm)"
    sizes = step.misfit, _rms_misfit(arm[:end], measured[:end])
    return [_parted(block, step.cut, end, sizes, CHANGED[step.part], turned, moved)]


def _parted_positions(block: Positions, arm: np.ndarray) -> list[Finding]:
    """Return a finding if the set-up was another after some row of positions, by placing both parts.

    Args:
        block: the positions.
        arm: (m, 4, 4) poses of the tip in the base.
    """
    if len(block) < 2 * MIN_PART_OF_POSITIONS:
        return []
    together = _rms_of_positions(arm, block.position)
    if together < MIN_SHARE_OF_POSITIONS * _motion(arm):
        return []
    cut, parted = _best_cut(arm, block.position, MIN_PART_OF_POSITIONS, _rms_of_positions)
    if parted > MAX_LEFT * together or parted > MAX_SHARE * _motion(arm):
        return []
    station, tool = place_position(arm[:cut], block.position[:cut], None, None)
    later_station, later_tool = place_position(arm[cut:], block.position[cut:], None, None)
    part, change = "tool", invert(tool) @ later_tool
    standing = station @ invert(later_station)
    if _size(standing) > _size(change):
        part, change = "station", standing
    angle = _angle(change)
    shift = float(np.linalg.norm(change[:3, 3]))
    if angle < MIN_TURN and shift < MIN_SHIFT:
        return []
    turned, moved = f"{angle / DEG:.3g}°", f"{1e3 * shift:.3g} mm"
    return [_parted(block, cut, len(arm), (parted, together), CHANGED[part], turned, moved)]


def _parted(
    block: PoseMeasurements, cut: int, end: int, sizes: tuple[float, float], changed: str, turned: str, moved: str
) -> Finding:
    """Return the finding of a changed set-up.

    Args:
        block: the measurements.
        cut, end: index of the first row after the change, and of the first one that was not considered.
        sizes: rms misfits [m] of both parts by themselves, and of all rows.
        changed: what changed.
        turned, moved: by what angle and what distance.
    """
    rows = block.rows
    return finding(
        "set-up-parted",
        file=block.file.rsplit("/", 1)[-1] or "measurements",
        first=rows[0],
        last=rows[cut - 1],
        next=rows[cut],
        end=rows[end - 1],
        apart=sizes[0],
        together=sizes[1],
        changed=changed,
        turned=turned,
        moved=moved,
    )


def _large_step(arm: np.ndarray, measured: np.ndarray) -> pose_steps.Step | None:
    """Return the step that shows when the rows before and after it are placed by themselves; None without one.

    Args:
        arm: (m, 4, 4) poses of the tip in the base.
        measured: (m, 4, 4) poses of the target in the instrument's frame.
    """
    if len(arm) < 2 * MIN_PART:
        return None
    together = _rms_misfit(arm, measured)
    cut, parted = _best_cut(arm, measured, MIN_PART, _rms_misfit)
    if parted > MAX_LEFT * together or parted > MAX_SHARE * _motion(arm):
        return None
    first = place_pose(arm[:cut], measured[:cut])
    step = pose_steps.step_at(arm, measured, cut, first)
    if step.angle < MIN_TURN and step.shift < MIN_SHIFT:
        return None
    return step


def _best_cut(
    arm: np.ndarray, measured: np.ndarray, min_part: int, rms: Callable[[np.ndarray, np.ndarray], float]
) -> tuple[int, float]:
    """Return the index of the row before which two parts of the rows fit best, and the rms misfit [m] of both.

    Args:
        arm: (m, 4, 4) poses of the tip in the base.
        measured: (m, 4, 4) poses or (m, 3) positions of the target in the instrument's frame.
        min_part: fewest rows of a part.
        rms: rms misfit [m] of a part by its best placements.
    """
    count = len(arm)
    cuts = range(min_part, count - min_part + 1)
    squares = []
    for cut in cuts:
        before = rms(arm[:cut], measured[:cut])
        after = rms(arm[cut:], measured[cut:])
        squares.append(cut * before**2 + (count - cut) * after**2)
    best = int(np.argmin(squares))
    return cuts[best], float(np.sqrt(squares[best] / count))


def _rms_misfit(arm: np.ndarray, measured: np.ndarray) -> float:
    """Return the rms misfit [m] of poses with the best placements, angles included."""
    rows = evenly(len(arm), MAX_ROWS)
    values = misfit(arm[rows], measured[rows], *place_pose(arm[rows], measured[rows]), LEVER)
    return float(np.sqrt(np.mean(values**2)))


def _rms_of_positions(arm: np.ndarray, measured: np.ndarray) -> float:
    """Return the rms misfit [m] of positions (m, 3) with the best placements."""
    station, tool = place_position(arm, measured, None, None)
    predicted = (station @ arm @ tool)[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum((measured - predicted) ** 2, axis=1))))


def _angle(change: np.ndarray) -> float:
    """Return the angle [rad] of a motion (4, 4)."""
    cosine = 0.5 * (np.trace(change[:3, :3]) - 1.0)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _size(change: np.ndarray) -> float:
    """Return the size of a motion (4, 4) [m], its angle included."""
    return float(np.linalg.norm(change[:3, 3])) + LEVER * _angle(change)

"""Initial values for a fit of images: lens, mounting (camera or board on the arm), and placements.

Each image gives the board's pose from its corners alone (`calib.data.images.board_and_lens`); with the arm's poses a
closed form places camera and board (`calib.geometry.camera.robust_placement`). Both ways of mounting are tried.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from calib.data.images.board import corners
from calib.data.images.board_and_lens import board_poses, estimate_lens
from calib.data.images.lens import Lens
from calib.data.images.optics import BoardShape, Optics
from calib.data.images.pixels import Pixels
from calib.data.poses import IN_HAND, TO_HAND
from calib.data.poses.measurements import PoseMeasurements, Poses, take
from calib.errors import MeasurementError, counted, listing, refuse_data
from calib.geometry.camera import pixel_residuals  # noqa: F401  # registers what images say of the geometry
from calib.geometry.camera.robust_placement import Placement, place_robustly
from calib.geometry.first_guess import average_pose, guess, misfit
from calib.records import evenly
from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from calib.transforms import invert, pose, to_quaternion

ODD = 8.0  # robust deviations from which on a corner does not fit into its image, and is left out
LOST = 0.2  # median misfit over the distance to the board beyond which nothing is placed


@dataclass(frozen=True, eq=False)
class CameraPlacement:
    """Estimated placement of camera and board for one block of images.

    Attributes:
        rows: (k,) the rows that were looked at.
        poses: (k, 4, 4) of the board in the camera's frame, by PnP.
        mounting: ``in hand`` or ``to hand``.
        placed: station and tool.
    """

    rows: np.ndarray
    poses: np.ndarray
    mounting: str
    placed: Placement


def complete_camera(chain: Chain, block: Pixels, others: Sequence[PoseMeasurements] = ()) -> Pixels:
    """Return a block of images with its lens and mounting; refuse images that contradict the arm's motion.

    Args:
        chain: the nominal arm.
        block: of images.
        others: blocks fitted already; the lens of one with images of this size is taken over.

    Corners that do not fit into their own image, and images that contradict all others, are left out and named.

    Raises:
        MeasurementError: where images and joints do not belong together, or the board is not of the stated size.
    """
    given = block
    for other in others:
        if block.lens is None and isinstance(other, Pixels) and other.size == block.size and other.lens is not None:
            block = replace(block, lens=other.lens, mounting=block.mounting or other.mounting, free=())
    if block.lens is None:
        if not block.size[0]:
            raise MeasurementError("image size unknown: no lens (camera.yaml) and no image was given", block.file)
        block = replace(block, lens=estimate_lens(block.board, block.pixel, block.size, block.model, block.file))
    arm = forward(chain, block.q)
    found = place_camera(block, arm)
    _check_square(block, arm[found.rows], found)
    block = replace(block, mounting=found.mounting)
    poses = _own_poses(block, np.arange(len(block)))
    strange, words = _strangers(block, arm, found.placed, poses)
    if len(strange):  # and once more without them, the lens too
        kept = take(replace(given, notes=(*given.notes, words)), np.setdiff1d(np.arange(len(block)), strange))
        return complete_camera(chain, kept, others)
    return _without_gross_corners(block, poses)


def _lens_of(block: Pixels) -> Lens:
    """Return the lens of a block of images; raise if it is unknown."""
    if block.lens is None:
        raise MeasurementError("the lens of these images is unknown", block.file)
    return block.lens


def _own_poses(block: Pixels, rows: np.ndarray, max_at_once: int = 500) -> np.ndarray:
    """Return the board's pose (k, 4, 4) in the camera's frame for each of the given rows.

    `max_at_once`: images whose corners are looked at together.
    """
    own, lens = np.array_split(rows, len(rows) // max_at_once + 1), _lens_of(block)
    return np.concatenate([board_poses(lens, block.board, block.pixel[each]).poses for each in own])


def _without_gross_corners(block: Pixels, poses: np.ndarray, median_length: float = 1.1774) -> Pixels:
    """Return the block without outlier corners; the removed corners are named in its notes.

    A gross corner moves the pose that the others are judged by: the worst go first, and poses (m, 4, 4) are found anew.

    `median_length`: of the length of a vector of two standard normals.
    """
    lens, table, before = _lens_of(block), corners(block.board), block.seen
    off, stale = np.full(before.shape, np.nan), np.arange(len(block))
    max_rounds = 4  # of leaving corners out
    for _ in range(max_rounds):
        point = np.einsum("mij,kj->mki", poses[:, :3, :3], table) + poses[:, None, :3, 3]
        flat = lens.project(point.reshape(-1, 3)).reshape(*point.shape[:2], 2)
        off[stale] = np.linalg.norm(block.pixel[stale] - flat, axis=2)
        gross = off > ODD * np.nanmedian(off) / median_length
        gross &= off >= 0.5 * np.nanmax(off, axis=1, keepdims=True, initial=0.0)
        if not gross.any():
            break
        block = replace(block, pixel=np.where(gross[:, :, None], np.nan, block.pixel))
        stale = np.flatnonzero(gross.any(axis=1))
        poses = _own_poses(block, stale)
    gone = np.argwhere(before & ~block.seen)
    if not len(gone):
        return block
    max_named = 3
    named = listing((f"corner {k} of {block.name(int(block.rows[row]))}" for row, k in gone), max_named)
    words = f"{len(gone)} of {before.sum()} corners are outliers in their image, excluded: {named}"
    return replace(block, notes=(*block.notes, words))


def _strangers(block: Pixels, arm: np.ndarray, placed: Placement, poses: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the rows of images that contradict the other images, and a sentence that names them.

    Raises:
        MeasurementError: where they are many.
    """
    lever = float(np.median(np.linalg.norm(poses[:, :3, 3], axis=1)))

    def far(board: np.ndarray) -> np.ndarray:
        return misfit(arm, seen_target(block.mounting, board), placed.station, placed.tool, lever)

    own = far(poses)
    most = max(LOST * lever, ODD * float(np.median(own)))
    strange = np.flatnonzero(own > most)
    if not len(strange):
        return strange, ""
    turned = far(pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)) @ poses)[strange] <= most
    cause = (
        "they match if turned by 180°; did a program rotate them?"
        if turned.mean() > 0.5
        else "wrong joint values, or was camera or board moved?"
    )
    words = f"show the board {1e3 * float(np.median(own[strange])):.0f} mm from its place in all other images: {cause}"
    words += f" ({listing((block.name(int(block.rows[row])) for row in strange), 5)})"
    max_strange = 0.3  # share of images that may contradict the others, and are left out; more are refused
    if len(strange) > max_strange * len(block):
        raise MeasurementError(f"{len(strange)} of {len(block)} images {words}", block.file)
    return strange, f"{len(strange)} image{'s are' if len(strange) > 1 else ' is'} excluded: they {words}"


def seen_target(mounting: str, poses: np.ndarray) -> np.ndarray:
    """Return the moving body's poses (m, 4, 4) in the fixed one's frame (camera and board), from board poses."""
    return invert(poses) if mounting == IN_HAND else poses


def pnp_poses(block: Pixels) -> Poses:
    """Return the images as measured poses: one pose per image, computed from its corners (PnP)."""
    seen = seen_target(block.mounting, _own_poses(block, np.arange(len(block))))
    return Poses(
        block.q,
        block.joint_names,
        seen[:, :3, 3],
        to_quaternion(seen),
        station=block.station,
        tool_names=block.tool_names,
        file=block.file,
        rows=block.rows,
        torque=block.torque,
    )


def place_camera(block: Pixels, arm: np.ndarray) -> CameraPlacement:
    """Return the placement of camera and board for a block of images; the mounting with the smaller error is taken.

    Args:
        block: with its lens.
        arm: (m, 4, 4) poses of the tip in the base.

    Raises:
        MeasurementError: where images and joints do not belong together.
    """
    max_images = 100  # images that it is placed by (our choice)
    rows = evenly(len(block), max_images)
    found = board_poses(_lens_of(block), block.board, block.pixel[rows])
    good = np.flatnonzero(np.isfinite(found.rms))
    min_images = 3  # images that place a camera at all
    if len(good) < min_images:
        raise MeasurementError(
            f"{len(good)} images with a board do not determine the camera: at least {min_images} from different sides, "
            "20 to 40 for a calibration",
            block.file,
        )
    rows, poses = rows[good], found.poses[good]
    lever = float(np.median(np.linalg.norm(poses[:, :3, 3], axis=1)))
    choices = [block.mounting] if block.mounting else [IN_HAND, TO_HAND]
    tried = {each: place_robustly(arm[rows], seen_target(each, poses), lever) for each in choices}
    mounting = min(tried, key=lambda each: tried[each].error)
    _check_pairing(block, arm[rows], poses, choices, tried[mounting], lever)
    min_contrast = 3.0  # a mounting is found where the other one's misfit is so many times as large
    if len(tried) == 2:
        one, other = sorted(each.error for each in tried.values())
        if other < min_contrast * one:
            raise MeasurementError(
                f"whether the arm carries the camera or the board cannot be determined ({1e3 * one:.1f} against "
                f"{1e3 * other:.1f} mm): state in the options [camera] mounting = 'in hand' or 'to hand'",
                block.file,
            )
    return CameraPlacement(rows, poses, mounting, tried[mounting])


def _check_pairing(
    block: Pixels, arm: np.ndarray, poses: np.ndarray, mountings: Sequence[str], placed: Placement, lever: float
) -> None:
    """Raise if the joint values are shifted against the images by some rows, or do not match them at all."""
    if placed.error <= 0.01 * lever or len(arm) < 6:
        return
    max_left = 0.25  # of the misfit is left with the rows shifted: they were
    for shift, mounting in product((-1, 1, -2, 2), mountings):
        seen = seen_target(mounting, poses)
        own = slice(max(shift, 0), len(arm) + min(shift, 0)), slice(max(-shift, 0), len(arm) + min(-shift, 0))
        again = place_robustly(arm[own[0]], seen[own[1]], lever)
        if again.error < max_left * placed.error:
            rows = counted(abs(shift), "row")
            raise MeasurementError(
                f"images and joint values are shifted by {rows}: the median board error is "
                f"{1e3 * placed.error:.0f} mm as recorded; paired with the joints {rows} "
                f"{'further down' if shift > 0 else 'further up'} by {1e3 * again.error:.1f} mm; correct the column "
                "'image'",
                block.file,
            )
    if placed.error > LOST * lever:
        raise MeasurementError(
            f"images and joint values do not match: with camera and board placed best, the median board error is "
            f"{1e3 * placed.error:.0f} mm. Were the joints logged at these images, in this order and "
            "unit, on this robot? Was the board (or the camera) moved?",
            block.file,
        )


def _check_square(block: Pixels, arm: np.ndarray, found: CameraPlacement, max_scale_error: float = 0.04) -> None:
    """Raise if the stated square size contradicts the size computed from the arm's motion.

    Of B_i = S A_i X with the board's lengths times λ, for fixed rotations, the translations are linear in λ.

    `max_scale_error`: relative error of the board's scale that is refused.
    """
    placed, count = found.placed, len(arm)
    turn, seen = placed.station[:3, :3], seen_target(found.mounting, found.poses)
    if count < 6:
        return
    rows = np.zeros((count, 3, 7))
    rows[:, :, 0] = -seen[:, :3, 3]
    rows[:, :, 1:4] = turn @ arm[:, :3, :3]
    rows[:, :, 4:] = np.eye(3)
    target = -(arm[:, :3, 3] @ turn.T)
    keep = placed.misfit <= np.quantile(placed.misfit, 0.8)
    matrix, wanted = rows[keep].reshape(-1, 7), target[keep].ravel()
    solution, _, rank, _ = np.linalg.lstsq(matrix, wanted, rcond=1e-6)
    spare = max(len(wanted) - 7, 1)
    noise = float(np.linalg.norm(matrix @ solution - wanted)) / np.sqrt(spare)
    sigma = noise * float(np.sqrt(np.linalg.pinv(matrix.T @ matrix)[0, 0]))
    factor = float(solution[0])
    if rank == 7 and abs(factor - 1.0) > max(max_scale_error, 6.0 * sigma) and sigma < 0.1:
        stated = 1e3 * block.board.square
        raise MeasurementError(
            f"a square of the board is {stated * factor:.2f} mm (±{stated * sigma:.2f}) by the arm's motion, "
            f"{stated:.2f} in board.toml: measure the print and correct board.toml (was it printed at 100 %?)",
            block.file,
        )


def optics_of(measured: Sequence[Pixels]) -> Optics:
    """Return the lenses and boards of all image blocks; a camera's lens is that of its first block.

    Raises:
        MeasurementError: for images whose camera is not known, or one camera with images of two sizes.
    """
    lenses, boards, free = {}, {}, set[str]()
    for block in measured:
        if block.lens is None or not block.mounting:
            refuse_data(block.file, "lens and mounting of the camera are unknown (see complete_camera)")
        lens = lenses.setdefault(block.camera, block.lens)
        if lens.size != block.lens.size or lens.model != block.lens.model:
            refuse_data(
                block.file,
                f"camera '{block.camera}' took images of {lens.size} and of {block.lens.size} pixels: are these two "
                "cameras? Give --tools each (a camera in the hand) or --stations each, or name them in the options",
            )
        boards.setdefault(block.target, BoardShape())
        for name in block.free:
            free.add(f"{block.camera if name in lens.names else block.target}.{name}")
    return Optics(tuple(lenses.values()), tuple(lenses), tuple(boards.values()), tuple(boards), frozenset(free))


@guess.register
def _guess_frames(
    block: Pixels, arm: np.ndarray, rows: np.ndarray, station: np.ndarray | None, tool: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return station and tool (4, 4) of a block of images, from the arm's poses (m, 4, 4); one may be given."""
    found = place_camera(block, arm)
    if station is None and tool is None:
        return found.placed.station, found.placed.tool
    seen, own = seen_target(block.mounting, found.poses), arm[found.rows]
    if station is not None:
        return station, average_pose(invert(own) @ invert(station) @ seen)
    return average_pose(seen @ invert(own @ tool)), np.asarray(tool)

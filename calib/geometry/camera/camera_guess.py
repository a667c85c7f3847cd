"""Initial values for a fit of images: lens, mounting (camera or board on the arm), placements of camera and board.

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

# robust deviations from which on a corner does not fit into its image, and is left out
ODD = 8.0
# median misfit over the distance to the board beyond which nothing is placed
LOST = 0.2
# images whose corners are looked at together
MAX_AT_ONCE = 500
# median length of a vector of two standard normals
MEDIAN_LENGTH = 1.1774
# of leaving corners out
MAX_ROUNDS = 4
# corners, and images, that a note names
MAX_CORNERS_NAMED, MAX_IMAGES_NAMED = 3, 5
# share of images that may contradict the others, and are left out; more are refused
MAX_STRANGE = 0.3
# images that a camera is placed by, at least and at most (our choice)
MIN_IMAGES, MAX_IMAGES = 3, 100
# a mounting is found where the other one's misfit is so many times as large
MIN_CONTRAST = 3.0
# of the misfit that remains with the rows shifted: they were
MAX_SHIFTED_SHARE = 0.25
# relative error of the board's scale that is refused
MAX_SCALE_ERROR = 0.04


@dataclass(frozen=True, eq=False)
class CameraPlacement:
    """Estimated placement of camera and board for one block of images.

    Attributes:
        rows: (k,) rows of the block from which the placement was estimated.
        poses: (k, 4, 4) poses of the board in the camera's frame, computed from the corners (PnP).
        mounting: ``in hand`` (camera on the arm) or ``to hand`` (board on the arm).
        placed: estimated station and tool.
    """

    rows: np.ndarray
    poses: np.ndarray
    mounting: str
    placed: Placement


def complete_camera(chain: Chain, block: Pixels, fitted_blocks: Sequence[PoseMeasurements] = ()) -> Pixels:
    """Return a block of images with its lens and mounting; refuse images that contradict the arm's motion.

    Corners that contradict their own image, and images that contradict all others, are removed and named in the block's
    notes.

    Args:
        chain: the nominal arm.
        block: the block of images.
        fitted_blocks: blocks fitted already; the lens of a block with images of the same size is taken over.

    Raises:
        MeasurementError: where images and joints do not belong together, or the board is not of the stated size.
    """
    original = block
    if block.lens is None:
        block = _with_fitted_lens(block, fitted_blocks)
    if block.lens is None:
        if not block.size[0]:
            raise MeasurementError(
                "the image size is unknown, since neither a lens nor an image was given: give camera.yaml", block.file
            )
        lens = estimate_lens(block.board, block.pixel, block.size, block.model, block.file)
        block = replace(block, lens=lens)
    arm = forward(chain, block.q)
    placement = place_camera(block, arm)
    _check_square(block, arm[placement.rows], placement)
    block = replace(block, mounting=placement.mounting)
    all_rows = np.arange(len(block))
    poses = _own_poses(block, all_rows)
    strange, exclusion_note = _strangers(block, arm, placement.placed, poses)
    if len(strange):
        # and once more without them, the lens too
        noted = replace(original, notes=(*original.notes, exclusion_note))
        consistent = take(noted, np.setdiff1d(all_rows, strange))
        return complete_camera(chain, consistent, fitted_blocks)
    return _without_gross_corners(block, poses)


def _with_fitted_lens(block: Pixels, fitted_blocks: Sequence[PoseMeasurements]) -> Pixels:
    """Return the block with the lens of the first fitted block with images of its size; unchanged if there is no such
    block.
    """
    for fitted in fitted_blocks:
        if isinstance(fitted, Pixels) and fitted.size == block.size and fitted.lens is not None:
            return replace(block, lens=fitted.lens, mounting=block.mounting or fitted.mounting, free=())
    return block


def _lens_of(block: Pixels) -> Lens:
    """Return the lens of a block of images; raise if it is unknown."""
    if block.lens is None:
        raise MeasurementError("the lens of these images is unknown: give it (camera.yaml)", block.file)
    return block.lens


def _own_poses(block: Pixels, rows: np.ndarray) -> np.ndarray:
    """Return the board's pose in the camera's frame (k, 4, 4) for each of the given rows (k,) of a block."""
    lens = _lens_of(block)
    chunks = np.array_split(rows, len(rows) // MAX_AT_ONCE + 1)
    return np.concatenate([board_poses(lens, block.board, block.pixel[chunk]).poses for chunk in chunks])


def _without_gross_corners(block: Pixels, poses: np.ndarray) -> Pixels:
    """Return the block without outlier corners; the removed corners are named in its notes.

    A gross corner falsifies its image's pose, by which the other corners are judged: the worst corners are removed
    first, then the board's poses (m, 4, 4) are computed again.
    """
    lens, table, before = _lens_of(block), corners(block.board), block.seen
    distance = np.full(before.shape, np.nan)
    stale = np.arange(len(block))
    for _ in range(MAX_ROUNDS):
        point = np.einsum("mij,kj->mki", poses[:, :3, :3], table) + poses[:, None, :3, 3]
        flat = lens.project(point.reshape(-1, 3)).reshape(*point.shape[:2], 2)
        distance[stale] = np.linalg.norm(block.pixel[stale] - flat, axis=2)
        largest = np.nanmax(distance, axis=1, keepdims=True, initial=0.0)
        is_odd = distance > ODD * np.nanmedian(distance) / MEDIAN_LENGTH
        gross = is_odd & (distance >= 0.5 * largest)
        if not gross.any():
            break
        block = replace(block, pixel=np.where(gross[:, :, None], np.nan, block.pixel))
        stale = np.flatnonzero(gross.any(axis=1))
        poses = _own_poses(block, stale)
    excluded = np.argwhere(before & ~block.seen)
    if not len(excluded):
        return block
    names = [f"corner {corner} of {block.name(int(block.rows[row]))}" for row, corner in excluded]
    corner_names = listing(names, MAX_CORNERS_NAMED)
    note = f"{len(excluded)} of {before.sum()} corners are outliers in their image, excluded: {corner_names}"
    return replace(block, notes=(*block.notes, note))


def _strangers(block: Pixels, arm: np.ndarray, placed: Placement, poses: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the rows of images that contradict the other images, and a sentence that names them.

    Args:
        block: the images.
        arm: (m, 4, 4) poses of the tip in the base.
        placed: the placement estimated from all images.
        poses: (m, 4, 4) poses of the board in the camera's frame.

    Raises:
        MeasurementError: if many images contradict the others.
    """
    lever = float(np.median(np.linalg.norm(poses[:, :3, 3], axis=1)))

    def board_misfit(board: np.ndarray) -> np.ndarray:
        return misfit(arm, seen_target(block.mounting, board), placed.station, placed.tool, lever)

    misfits = board_misfit(poses)
    max_misfit = max(LOST * lever, ODD * float(np.median(misfits)))
    strange = np.flatnonzero(misfits > max_misfit)
    if not len(strange):
        return strange, ""

    half_turn = pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    fits_turned = board_misfit(half_turn @ poses)[strange] <= max_misfit
    cause = "wrong joint values, or was camera or board moved?"
    if fits_turned.mean() > 0.5:
        cause = "they match if turned by 180°; did a program rotate them?"
    distance_mm = 1e3 * float(np.median(misfits[strange]))
    names = listing((block.name(int(block.rows[row])) for row in strange), MAX_IMAGES_NAMED)
    description = f"show the board {distance_mm:.0f} mm from its place in all other images: {cause} ({names})"
    if len(strange) > MAX_STRANGE * len(block):
        raise MeasurementError(f"{len(strange)} of {len(block)} images {description}", block.file)
    images = "image is"
    if len(strange) > 1:
        images = "images are"
    return strange, f"{len(strange)} {images} excluded: they {description}"


def seen_target(mounting: str, poses: np.ndarray) -> np.ndarray:
    """Return the poses (m, 4, 4) of the carried one of camera and board in the fixed one's frame, from board poses."""
    if mounting == IN_HAND:
        return invert(poses)
    return poses


def pnp_poses(block: Pixels) -> Poses:
    """Return the images as measured poses: one pose per image, computed from its corners (PnP)."""
    targets = seen_target(block.mounting, _own_poses(block, np.arange(len(block))))
    return Poses(
        block.q,
        block.joint_names,
        targets[:, :3, 3],
        to_quaternion(targets),
        station=block.station,
        tool_names=block.tool_names,
        file=block.file,
        rows=block.rows,
        torque=block.torque,
    )


def place_camera(block: Pixels, arm: np.ndarray) -> CameraPlacement:
    """Return the placement of camera and board for a block of images, for the mounting with the smaller error.

    Args:
        block: images with their lens.
        arm: (m, 4, 4) poses of the tip in the base.

    Raises:
        MeasurementError: where images and joints do not belong together.
    """
    rows = evenly(len(block), MAX_IMAGES)
    pnp = board_poses(_lens_of(block), block.board, block.pixel[rows])
    good = np.flatnonzero(np.isfinite(pnp.rms))
    if len(good) < MIN_IMAGES:
        raise MeasurementError(
            f"{len(good)} images with a board do not determine the camera: at least {MIN_IMAGES} from different sides, "
            "20 to 40 for a calibration",
            block.file,
        )
    rows, poses = rows[good], pnp.poses[good]
    lever = float(np.median(np.linalg.norm(poses[:, :3, 3], axis=1)))
    mountings = [block.mounting] if block.mounting else [IN_HAND, TO_HAND]
    placements = {}
    for candidate in mountings:
        placements[candidate] = place_robustly(arm[rows], seen_target(candidate, poses), lever)
    mounting = min(placements, key=lambda candidate: placements[candidate].error)
    _check_pairing(block, arm[rows], poses, mountings, placements[mounting], lever)
    if len(placements) == 2:
        smaller, larger = sorted(candidate.error for candidate in placements.values())
        if larger < MIN_CONTRAST * smaller:
            raise MeasurementError(
                f"whether the arm carries the camera or the board cannot be determined ({1e3 * smaller:.1f} against "
                f"{1e3 * larger:.1f} mm): state in the options [camera] mounting = 'in hand' or 'to hand'",
                block.file,
            )
    return CameraPlacement(rows, poses, mounting, placements[mounting])


def _check_pairing(
    block: Pixels, arm: np.ndarray, poses: np.ndarray, mountings: Sequence[str], placed: Placement, lever: float
) -> None:
    """Raise MeasurementError if the joint values are shifted against the images by some rows, or do not match."""
    if placed.error <= 0.01 * lever or len(arm) < 6:
        return
    count = len(arm)
    for shift, mounting in product((-1, 1, -2, 2), mountings):
        targets = seen_target(mounting, poses)
        arm_rows = slice(max(shift, 0), count + min(shift, 0))
        target_rows = slice(max(-shift, 0), count + min(-shift, 0))
        shifted = place_robustly(arm[arm_rows], targets[target_rows], lever)
        if shifted.error < MAX_SHIFTED_SHARE * placed.error:
            rows = counted(abs(shift), "row")
            direction = "further down" if shift > 0 else "further up"
            raise MeasurementError(
                f"images and joint values are shifted by {rows}: the median board error is "
                f"{1e3 * placed.error:.0f} mm as recorded; paired with the joints {rows} "
                f"{direction} by {1e3 * shifted.error:.1f} mm; correct the column 'image'",
                block.file,
            )
    if placed.error > LOST * lever:
        raise MeasurementError(
            f"images and joint values do not match: with camera and board placed best, the median board error is "
            f"{1e3 * placed.error:.0f} mm. Were the joints logged at these images, in this order and "
            "unit, on this robot? Was the board (or the camera) moved?",
            block.file,
        )


def _check_square(block: Pixels, arm: np.ndarray, placement: CameraPlacement) -> None:
    """Raise MeasurementError if the stated square size contradicts the size computed from the arm's motion.

    In B_i = S A_i X with the board's lengths multiplied by λ, the translations are linear in λ for fixed rotations.
    """
    placed = placement.placed
    count = len(arm)
    if count < 6:
        return
    turn = placed.station[:3, :3]
    targets = seen_target(placement.mounting, placement.poses)
    rows = np.zeros((count, 3, 7))
    rows[:, :, 0] = -targets[:, :3, 3]
    rows[:, :, 1:4] = turn @ arm[:, :3, :3]
    rows[:, :, 4:] = np.eye(3)
    target = -(arm[:, :3, 3] @ turn.T)
    consistent = placed.misfit <= np.quantile(placed.misfit, 0.8)
    matrix = rows[consistent].reshape(-1, 7)
    translations = target[consistent].ravel()
    solution, _, rank, _ = np.linalg.lstsq(matrix, translations, rcond=1e-6)
    spare = max(len(translations) - 7, 1)
    error = matrix @ solution - translations
    noise = float(np.linalg.norm(error)) / np.sqrt(spare)
    sigma = noise * float(np.sqrt(np.linalg.pinv(matrix.T @ matrix)[0, 0]))
    factor = float(solution[0])
    if rank == 7 and abs(factor - 1.0) > max(MAX_SCALE_ERROR, 6.0 * sigma) and sigma < 0.1:
        square_mm = 1e3 * block.board.square
        raise MeasurementError(
            f"a square of the board is {square_mm * factor:.2f} mm (±{square_mm * sigma:.2f}) by the arm's motion, "
            f"{square_mm:.2f} in board.toml: measure the print and correct board.toml (was it printed at 100 %?)",
            block.file,
        )


def optics_of(measured: Sequence[Pixels]) -> Optics:
    """Return the lenses and boards of all image blocks; a camera's lens is that of its first block.

    Raises:
        MeasurementError: if a block's camera is not known, or one camera has images of two sizes.
    """
    lenses, boards, free = {}, {}, set[str]()
    for block in measured:
        if block.lens is None or not block.mounting:
            refuse_data(block.file, "lens and mounting of the camera are unknown: call complete_camera before the fit")
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
    """Return station and tool (4, 4) of a block of images, from the arm's poses (m, 4, 4).

    A `station` or `tool` that is given stays; None for one to be estimated.
    """
    placement = place_camera(block, arm)
    if station is None and tool is None:
        return placement.placed.station, placement.placed.tool
    targets, tips = seen_target(block.mounting, placement.poses), arm[placement.rows]
    if station is not None:
        return station, average_pose(invert(tips) @ invert(station) @ targets)
    return average_pose(targets @ invert(tips @ tool)), np.asarray(tool)

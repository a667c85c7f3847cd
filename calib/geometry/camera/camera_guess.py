"""Initial values for a fit of images: lens, mounting (camera or board on the arm), placements of camera and board.

The board's pose in the camera's frame is computed from the corners of each image (`calib.data.images.board_and_lens`).
From these poses and the arm's poses a closed form gives the placements of camera and board
(`calib.geometry.camera.robust_placement`). If the mounting is unknown, both mountings are tried.
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
from calib.geometry.camera import pixel_residuals  # noqa: F401  # registers the residuals of images
from calib.geometry.camera.robust_placement import Placement, place_robustly
from calib.geometry.first_guess import average_pose, guess, misfit
from calib.records import evenly
from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from calib.transforms import invert, pose, to_quaternion

# Robust deviations [-] from which on a corner counts as an outlier of its image.
ODD = 8.0
# Median misfit over the distance to the board [-] beyond which images and joint values are said not to match.
LOST = 0.2
# Number of images whose corners are processed together; bounds the memory.
MAX_AT_ONCE = 500
# Median length of a vector of two standard normals.
MEDIAN_LENGTH = 1.1774
# Number of rounds in which outlier corners are removed.
MAX_ROUNDS = 4
# Numbers of corners and of images that a note names.
MAX_CORNERS_NAMED = 3
MAX_IMAGES_NAMED = 5
# Share of images that may contradict the others and be removed; with more, the data are refused.
MAX_STRANGE = 0.3
# Smallest and largest number of images from which a placement is estimated (our choice).
MIN_IMAGES = 3
MAX_IMAGES = 100
# Smallest ratio of both mountings' misfits at which the mounting is accepted as determined.
MIN_CONTRAST = 3.0
# Images and joint values count as shifted if a shift by rows lowers the misfit below this share.
MAX_SHIFTED_SHARE = 0.25
# Relative error of the stated square size from which on the board is refused.
MAX_SCALE_ERROR = 0.04
# Number of images from which on shifted rows and the square size are checked.
MIN_CHECKED_IMAGES = 6
# Share of the distance to the board below which the misfit is small enough to skip the check of shifted rows.
SMALL_MISFIT = 0.01
# Quantile of the misfits up to which images enter the check of the square size.
CONSISTENT_QUANTILE = 0.8
# The square size is refused at so many standard deviations, and only where σ of the scale is below MAX_SCALE_SIGMA.
SCALE_SIGMAS = 6.0
MAX_SCALE_SIGMA = 0.1


@dataclass(frozen=True, eq=False)
class CameraPlacement:
    """Estimated placement of camera and board for one block of images.

    Attributes:
        rows: (k,) indices of the images from which the placement was estimated.
        poses: (k, 4, 4) poses of the board in the camera's frame, computed from the corners (PnP).
        mounting: ``in hand`` (camera on the arm) or ``to hand`` (board on the arm).
        placed: estimated station and tool.
    """

    rows: np.ndarray
    poses: np.ndarray
    mounting: str
    placed: Placement


def complete_camera(chain: Chain, block: Pixels, fitted_blocks: Sequence[PoseMeasurements] = ()) -> Pixels:
    """Return a block of images completed by its lens and its mounting (camera or board on the arm).

    Corners that contradict the other corners of their image are removed, and so are images that contradict the other
    images; the block's notes name them.

    Args:
        chain: the nominal arm.
        block: the block of images.
        fitted_blocks: blocks that were fitted before; if one of them has images of the same size, its lens is used.

    Raises:
        MeasurementError: if images and joint values do not match, or the board's squares are not of the stated size.
    """
    original = block
    if block.lens is None:
        block = _with_fitted_lens(block, fitted_blocks)
    if block.lens is None:
        if not block.size[0]:
            raise MeasurementError(
                "the image size is unknown, since neither a lens nor an image was given: give camera.yaml", block.file
            )
        size = block.size
        lens = estimate_lens(block.board, block.pixel, size, block.model, block.file)
        block = replace(block, lens=lens)
    arm = forward(chain, block.q)
    placement = place_camera(block, arm)
    _check_square(block, arm[placement.rows], placement)
    block = replace(block, mounting=placement.mounting)
    all_rows = np.arange(len(block))
    poses = _board_poses(block, all_rows)
    strange, exclusion_note = _strangers(block, arm, placement.placed, poses)
    if len(strange):
        # and once more without them, the lens too
        noted = replace(original, notes=(*original.notes, exclusion_note))
        consistent = take(noted, np.setdiff1d(all_rows, strange))
        return complete_camera(chain, consistent, fitted_blocks)
    return _without_gross_corners(block, poses)


def _with_fitted_lens(block: Pixels, fitted_blocks: Sequence[PoseMeasurements]) -> Pixels:
    """Return the block with the lens of the first fitted block whose images have the same size.

    Without such a fitted block, the block is returned unchanged.
    """
    for fitted in fitted_blocks:
        if isinstance(fitted, Pixels) and fitted.size == block.size and fitted.lens is not None:
            mounting = block.mounting or fitted.mounting
            return replace(block, lens=fitted.lens, mounting=mounting, free=())
    return block


def _lens_of(block: Pixels) -> Lens:
    """Return the lens of a block of images; raise if it is unknown."""
    if block.lens is None:
        raise MeasurementError("the lens of these images is unknown: give it (camera.yaml)", block.file)
    return block.lens


def _board_poses(block: Pixels, rows: np.ndarray) -> np.ndarray:
    """Return the board's pose in the camera's frame (k, 4, 4) for each of the given rows (k,) of a block."""
    lens = _lens_of(block)
    chunk_count = len(rows) // MAX_AT_ONCE + 1
    poses = []
    for chunk in np.array_split(rows, chunk_count):
        pnp = board_poses(lens, block.board, block.pixel[chunk])
        poses.append(pnp.poses)
    return np.concatenate(poses)


def _board_distance(poses: np.ndarray) -> float:
    """Return the median distance [m] between camera and board over poses (k, 4, 4) of the board in the camera's frame.

    Rotations [rad] are multiplied by this lever to compare them with translations.
    """
    distances = np.linalg.norm(poses[:, :3, 3], axis=1)
    return float(np.median(distances))


def _without_gross_corners(block: Pixels, poses: np.ndarray) -> Pixels:
    """Return the block without outlier corners, which the block's notes name.

    An outlier corner also shifts the estimated pose of its image, and with it the residuals of the other corners.
    Therefore only the worst corners are removed in a round, after which the pose is estimated again.

    Args:
        block: the images.
        poses: (m, 4, 4) poses of the board in the camera's frame.
    """
    lens = _lens_of(block)
    table = corners(block.board)
    before = block.seen
    distance = np.full(before.shape, np.nan)
    stale = np.arange(len(block))
    for _ in range(MAX_ROUNDS):
        rotated = np.einsum("mij,kj->mki", poses[:, :3, :3], table)
        points = rotated + poses[:, None, :3, 3]
        pixels = lens.project(points.reshape(-1, 3))
        predicted = pixels.reshape(*points.shape[:2], 2)
        residual = block.pixel[stale] - predicted
        distance[stale] = np.linalg.norm(residual, axis=2)
        largest = np.nanmax(distance, axis=1, keepdims=True, initial=0.0)
        max_distance = ODD * np.nanmedian(distance) / MEDIAN_LENGTH
        is_odd = distance > max_distance
        gross = is_odd & (distance >= 0.5 * largest)
        if not gross.any():
            break
        remaining = np.where(gross[:, :, None], np.nan, block.pixel)
        block = replace(block, pixel=remaining)
        stale = np.flatnonzero(gross.any(axis=1))
        poses = _board_poses(block, stale)
    excluded = np.argwhere(before & ~block.seen)
    if not len(excluded):
        return block
    names = []
    for row, corner in excluded:
        image_name = block.name(int(block.rows[row]))
        names.append(f"corner {corner} of {image_name}")
    corner_names = listing(names, MAX_CORNERS_NAMED)
    note = f"{len(excluded)} of {before.sum()} corners are outliers in their image, excluded: {corner_names}"
    return replace(block, notes=(*block.notes, note))


def _strangers(block: Pixels, arm: np.ndarray, placed: Placement, poses: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the indices of images that contradict the other images, and a sentence that names them.

    Args:
        block: the images.
        arm: (m, 4, 4) poses of the tip in the base.
        placed: the placement estimated from all images.
        poses: (m, 4, 4) poses of the board in the camera's frame.

    Returns:
        Indices (k,) of the images, and a sentence for the block's notes; no indices and "" if no image contradicts.

    Raises:
        MeasurementError: if more than the share `MAX_STRANGE` of the images contradicts the others.
    """
    lever = _board_distance(poses)

    def board_misfit(board: np.ndarray) -> np.ndarray:
        targets = seen_target(block.mounting, board)
        return misfit(arm, targets, placed.station, placed.tool, lever)

    misfits = board_misfit(poses)
    typical_misfit = float(np.median(misfits))
    max_misfit = max(LOST * lever, ODD * typical_misfit)
    strange = np.flatnonzero(misfits > max_misfit)
    if not len(strange):
        return strange, ""

    about_optical_axis = np.diag([-1.0, -1.0, 1.0])
    half_turn = pose(about_optical_axis, np.zeros(3))
    turned_misfits = board_misfit(half_turn @ poses)
    fits_turned = turned_misfits[strange] <= max_misfit
    cause = "wrong joint values, or was camera or board moved?"
    if fits_turned.mean() > 0.5:
        cause = "they match if turned by 180°; did a program rotate them?"
    distance_mm = 1e3 * float(np.median(misfits[strange]))
    image_names = [block.name(int(row)) for row in block.rows[strange]]
    names = listing(image_names, MAX_IMAGES_NAMED)
    description = f"show the board {distance_mm:.0f} mm from its place in all other images: {cause} ({names})"
    if len(strange) > MAX_STRANGE * len(block):
        raise MeasurementError(f"{len(strange)} of {len(block)} images {description}", block.file)
    images = "image is"
    if len(strange) > 1:
        images = "images are"
    return strange, f"{len(strange)} {images} excluded: they {description}"


def seen_target(mounting: str, poses: np.ndarray) -> np.ndarray:
    """Return the poses (m, 4, 4) of the device on the arm (camera or board) in the frame of the fixed device.

    Args:
        mounting: ``in hand`` (the arm carries the camera) or ``to hand`` (the arm carries the board).
        poses: (m, 4, 4) poses of the board in the camera's frame.
    """
    if mounting == IN_HAND:
        return invert(poses)
    return poses


def pnp_poses(block: Pixels) -> Poses:
    """Return the images as measured poses: one pose per image, computed from its corners (PnP)."""
    board = _board_poses(block, np.arange(len(block)))
    targets = seen_target(block.mounting, board)
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
        load=block.load,
    )


def place_camera(block: Pixels, arm: np.ndarray) -> CameraPlacement:
    """Return the placement of camera and board for a block of images, with the mounting of the smaller misfit.

    Args:
        block: images with their lens.
        arm: (m, 4, 4) poses of the tip in the base.

    Raises:
        MeasurementError: if too few images show the board, images and joint values do not match, or both mountings
            explain the images.
    """
    rows = evenly(len(block), MAX_IMAGES)
    lens = _lens_of(block)
    pnp = board_poses(lens, block.board, block.pixel[rows])
    good = np.flatnonzero(np.isfinite(pnp.rms))
    if len(good) < MIN_IMAGES:
        raise MeasurementError(
            f"{len(good)} images with a board do not determine the camera: at least {MIN_IMAGES} from different sides, "
            "20 to 40 for a calibration",
            block.file,
        )
    rows = rows[good]
    poses = pnp.poses[good]
    lever = _board_distance(poses)
    mountings = [block.mounting] if block.mounting else [IN_HAND, TO_HAND]
    tips = arm[rows]
    placements = {}
    errors = {}
    for candidate in mountings:
        targets = seen_target(candidate, poses)
        placement = place_robustly(tips, targets, lever)
        placements[candidate] = placement
        errors[candidate] = placement.error
    mounting = min(mountings, key=errors.__getitem__)
    placed = placements[mounting]
    _check_pairing(block, tips, poses, mountings, placed, lever)
    if len(errors) == 2:
        smaller, larger = sorted(errors.values())
        if larger < MIN_CONTRAST * smaller:
            raise MeasurementError(
                f"whether the arm carries the camera or the board cannot be determined ({1e3 * smaller:.1f} against "
                f"{1e3 * larger:.1f} mm): state in the options [camera] mounting = 'in hand' or 'to hand'",
                block.file,
            )
    return CameraPlacement(rows, poses, mounting, placed)


def _check_pairing(
    block: Pixels, arm: np.ndarray, poses: np.ndarray, mountings: Sequence[str], placed: Placement, lever: float
) -> None:
    """Raise MeasurementError if the joint values are shifted against the images by some rows, or do not match."""
    if placed.error <= SMALL_MISFIT * lever or len(arm) < MIN_CHECKED_IMAGES:
        return
    count = len(arm)
    for shift, mounting in product((-1, 1, -2, 2), mountings):
        targets = seen_target(mounting, poses)
        overlap = count - abs(shift)
        first_arm = max(shift, 0)
        first_target = max(-shift, 0)
        arm_rows = arm[first_arm : first_arm + overlap]
        target_rows = targets[first_target : first_target + overlap]
        shifted = place_robustly(arm_rows, target_rows, lever)
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
    if count < MIN_CHECKED_IMAGES:
        return
    turn = placed.station[:3, :3]
    targets = seen_target(placement.mounting, placement.poses)
    target_shift = targets[:, :3, 3]
    arm_turn = arm[:, :3, :3]
    arm_shift = arm[:, :3, 3]
    # unknowns: λ, the tool's and the station's translations
    rows = np.zeros((count, 3, 7))
    rows[:, :, 0] = -target_shift
    rows[:, :, 1:4] = turn @ arm_turn
    rows[:, :, 4:] = np.eye(3)
    target = -(arm_shift @ turn.T)
    max_misfit = np.quantile(placed.misfit, CONSISTENT_QUANTILE)
    consistent = placed.misfit <= max_misfit
    matrix = rows[consistent].reshape(-1, 7)
    translations = target[consistent].ravel()
    solution, _, rank, _ = np.linalg.lstsq(matrix, translations, rcond=1e-6)
    degrees_of_freedom = max(len(translations) - 7, 1)
    error = matrix @ solution - translations
    noise = float(np.linalg.norm(error)) / np.sqrt(degrees_of_freedom)
    cofactors = np.linalg.pinv(matrix.T @ matrix)
    sigma = noise * float(np.sqrt(cofactors[0, 0]))
    factor = float(solution[0])
    max_error = max(MAX_SCALE_ERROR, SCALE_SIGMAS * sigma)
    if rank == 7 and abs(factor - 1.0) > max_error and sigma < MAX_SCALE_SIGMA:
        square_mm = 1e3 * block.board.square
        raise MeasurementError(
            f"a square of the board is {square_mm * factor:.2f} mm (±{square_mm * sigma:.2f}) by the arm's motion, "
            f"{square_mm:.2f} in board.toml: measure the print and correct board.toml (was it printed at 100 %?)",
            block.file,
        )


def optics_of(measured: Sequence[Pixels]) -> Optics:
    """Return the lenses and boards of all image blocks.

    If several blocks are of one camera, the lens of the first block is used.

    Raises:
        MeasurementError: if a block's camera is not known, or one camera has images of two sizes.
    """
    lenses = {}
    boards = {}
    free = set[str]()
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
            owner = block.target
            if name in lens.names:
                owner = block.camera
            free.add(f"{owner}.{name}")
    return Optics(
        lenses=tuple(lenses.values()),
        lens_names=tuple(lenses),
        boards=tuple(boards.values()),
        board_names=tuple(boards),
        free=frozenset(free),
    )


@guess.register
def _guess_frames(
    block: Pixels, arm: np.ndarray, rows: np.ndarray, station: np.ndarray | None, tool: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return station and tool (4, 4) of a block of images, from the arm's poses (m, 4, 4).

    A `station` or `tool` that is not None is returned unchanged; None marks the transform to be estimated.
    """
    placement = place_camera(block, arm)
    if station is None and tool is None:
        return placement.placed.station, placement.placed.tool
    targets = seen_target(block.mounting, placement.poses)
    tips = arm[placement.rows]
    if station is not None:
        tools = invert(tips) @ invert(station) @ targets
        return station, average_pose(tools)
    stations = targets @ invert(tips @ tool)
    return average_pose(stations), np.asarray(tool)

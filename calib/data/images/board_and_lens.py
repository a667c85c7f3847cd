"""Estimates from images of a flat board: the board's pose in each image (PnP) with a known lens, and the lens itself.

Pose: a homography between the board's corners and their rays (direct linear transformation; Zhang 2000, sec. 3.1) is
the start of Gauss–Newton on the reprojection error. A distant plane has a second pose with nearly the same image,
tilted to the other side of the line of sight (Schweighofer & Pinz 2006). Both poses are refined, and the pose with the
smaller error is returned.

Lens: the reprojection error is minimised over the lens and one pose per image (Zhang 2000), by variable projection
(Golub & Pereyra 1973; Kaufman 1975): for a given lens every image has a best pose. A QR factorisation of an image's
rows eliminates its six pose columns, so that a least-squares problem in the lens alone remains. The iteration starts
at that of several focal lengths (`STARTS`) with the smallest reprojection error.
"""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.images.board import Board, corners
from calib.data.images.lens import Lens, rays
from calib.errors import CalibError, counted, refuse_data
from calib.records import evenly
from calib.transforms import orthonormal, pose

# Largest number of Gauss–Newton steps of a pose.
STEPS = 12
# Relative change of all images' costs up to which the iteration ends.
SETTLED = 1e-9
# Smallest number of corners that determines a pose.
MIN_SEEN = 6
# Smallest distance of a board before the camera [m] during the iteration.
MIN_DISTANCE = 0.01
# Smallest ratio of a corner's depth to its distance from the optical axis during the iteration.
MIN_DEPTH_RATIO = 0.3

# Focal lengths at which the fit of a lens may start, in widths of the image (our choice).
STARTS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.5, 2.2, 3.2)
# Number of fitted values of a lens: focal lengths, principal point, four of distortion.
FITTED = 8
# Numbers of distortion coefficients of the lens models.
COEFFICIENTS = {"pinhole": 5, "fisheye": 4}
# Reprojection error [px] from which on a fisheye is tried, and factor by which its error must be smaller.
BENT = 0.5
# Reprojection error [px] from which on no lens explains the images.
WRONG = 50.0
# Smallest number of corners of an image from which a lens is estimated.
MIN_LENS_CORNERS = 8
# Smallest and largest number of images from which a lens is estimated, and number of images that choose its start.
MIN_IMAGES = 4
MAX_IMAGES = 30
MAX_TRIED = 8
# Relative sigma of the focal length above which the images do not identify the lens (our choice).
MAX_FOCAL_SIGMA = 0.01
# Relative sigma above which a message calls the focal length not identified at all.
UNKNOWN_FOCAL_SIGMA = 0.5
# Smallest noise of a corner [px] that the focal length's sigma is computed with.
MIN_NOISE = 0.02
# Largest number of steps of the fit of a lens, and relative change of its cost up to which the fit ends.
LENS_STEPS = 60
LENS_SETTLED = 1e-6
# Damping of the fit of a lens from which on the fit ends.
MAX_DAMPING = 1e6


@dataclass(frozen=True, eq=False)
class BoardPoses:
    """Board poses (PnP) in m images, with their reprojection errors.

    Attributes:
        poses: (m, 4, 4) poses of the board in the camera's frame.
        rms: (m,) reprojection error per coordinate [px]; NaN where there are too few corners.
        information: (m, 6, 6) JᵀJ with J the derivative of the corners [px] by the board's twist [v; ω] in the camera's
            axes, about the board's origin.
    """

    poses: np.ndarray
    rms: np.ndarray
    information: np.ndarray


def board_poses(lens: Lens, board: Board, pixel: np.ndarray) -> BoardPoses:
    """Return the pose of the board in the camera's frame for each image, from its corners [px].

    Args:
        lens: lens of the camera.
        board: the board in the images.
        pixel: (m, K, 2) corners [px], NaN where not seen.
    """
    table = corners(board)
    directions = rays(lens, pixel.reshape(-1, 2))
    sight = directions.reshape(pixel.shape)
    first_poses = [_from_homography(table, image_rays) for image_rays in sight]
    start = np.array(first_poses)
    second_start = _tilted_back(start, table)
    upright = _refine(lens, table, pixel, start)
    tilted = _refine(lens, table, pixel, second_start)
    is_tilted = tilted.rms < upright.rms
    by_pose = is_tilted[:, None, None]
    poses = np.where(by_pose, tilted.poses, upright.poses)
    information = np.where(by_pose, tilted.information, upright.information)
    rms = np.fmin(upright.rms, tilted.rms)
    return BoardPoses(poses, rms, information)


def _from_homography(table: np.ndarray, sight: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of a board in the camera's frame, by the homography between its corners and their rays.

    Args:
        table: (K, 3) corners in the board's frame [m].
        sight: (K, 2) ray of each corner, (X/Z, Y/Z); NaN where the corner was not detected.

    Returns:
        The pose; with fewer than `MIN_SEEN` corners a pose 1 m before the camera.
    """
    visible = np.flatnonzero(~np.isnan(sight[:, 0]))
    if len(visible) < MIN_SEEN:
        return pose(None, [0.0, 0.0, 1.0])
    ray = sight[visible]
    points = table[visible, :2]
    count = len(visible)
    middle = points.mean(axis=0)
    size = points.std() + 1e-9
    scaled = (points - middle) / size
    flat = np.column_stack([scaled, np.ones(count)])
    rows = np.zeros((2 * count, 9))
    rows[0::2, :3] = flat
    rows[1::2, 3:6] = flat
    rows[:, 6:] = -ray.reshape(-1, 1) * np.repeat(flat, 2, axis=0)
    _, _, axes = np.linalg.svd(rows, full_matrices=False)

    # homography of the points without centring and scaling
    scaling = np.diag([1 / size, 1 / size, 1.0])
    plane = axes[-1].reshape(3, 3) @ scaling
    plane[:, 2] -= plane[:, :2] @ middle

    # its first two columns have unit length, and the board lies before the camera
    x_length = np.linalg.norm(plane[:, 0])
    y_length = np.linalg.norm(plane[:, 1])
    plane = plane / np.sqrt(x_length * y_length)
    board_middle = plane @ [*middle, 1.0]
    plane = plane * np.sign(board_middle[2])
    x, y, position = plane.T
    axes_of_board = np.column_stack([x, y, np.cross(x, y)])
    turn = orthonormal(axes_of_board)
    return pose(turn, position)


def _tilted_back(poses: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Return second candidates (m, 4, 4) for the board's poses: board normals mirrored about the line of sight."""
    centre = table.mean(axis=0)
    middle = poses[:, :3, :3] @ centre + poses[:, :3, 3]
    distance = np.linalg.norm(middle, axis=1, keepdims=True)
    sight = middle / distance
    normal = poses[:, :3, 2]
    across = np.cross(normal, sight)
    sine = np.linalg.norm(across, axis=1)
    cosine = np.sum(normal * sight, axis=1)
    angle = 2.0 * np.arctan2(sine, cosine)
    unit = across / np.maximum(sine[:, None], 1e-12)
    mirrored = Rotation.from_rotvec(unit * angle[:, None])
    turn = mirrored.as_matrix() @ poses[:, :3, :3]
    return pose(turn, middle - turn @ centre)


def _refine(lens: Lens, table: np.ndarray, pixel: np.ndarray, poses: np.ndarray) -> BoardPoses:
    """Return the poses that minimise each image's reprojection error, by damped Gauss–Newton (Levenberg–Marquardt).

    Args:
        lens: lens of the camera.
        table: (K, 3) corners in the board's frame [m].
        pixel: (m, K, 2) detected corners [px], NaN where not detected.
        poses: (m, 4, 4) poses of the board in the camera's frame at which the iteration starts.
    """
    visible = ~np.isnan(pixel[:, :, 0])
    damping = np.full(len(poses), 1e-6)
    cost, gradient, information = _normal(lens, table, pixel, visible, poses)
    for _ in range(STEPS):
        diagonal = np.einsum("mii->mi", information)
        scale = np.sqrt(diagonal) + 1e-9
        scale_product = scale[:, :, None] * scale[:, None, :]
        scaled = information / scale_product
        system = scaled + damping[:, None, None] * np.eye(6)
        scaled_gradient = (gradient / scale)[:, :, None]
        scaled_step = np.linalg.solve(system, scaled_gradient)[:, :, 0]
        step = scaled_step / scale
        rotation = Rotation.from_rotvec(step[:, 3:])
        trial = poses.copy()
        trial[:, :3, :3] = rotation.as_matrix() @ poses[:, :3, :3]
        trial[:, :3, 3] += step[:, :3]
        trial[:, 2, 3] = np.maximum(trial[:, 2, 3], MIN_DISTANCE)
        trial_cost, trial_gradient, trial_information = _normal(lens, table, pixel, visible, trial)
        better = trial_cost < cost
        gain = cost - trial_cost
        settled = np.all(gain <= SETTLED * cost)
        poses = np.where(better[:, None, None], trial, poses)
        cost = np.where(better, trial_cost, cost)
        gradient = np.where(better[:, None], trial_gradient, gradient)
        information = np.where(better[:, None, None], trial_information, information)
        damping = np.where(better, damping / 10.0, damping * 30.0)
        damping = np.clip(damping, 1e-9, 1e6)
        if settled and better.any():
            break
    count = visible.sum(axis=1)
    degrees_of_freedom = np.maximum(2.0 * count - 6.0, 1.0)
    rms = np.sqrt(cost / degrees_of_freedom)
    rms = np.where(count >= MIN_SEEN, rms, np.nan)
    return BoardPoses(poses, rms, information)


def _normal(
    lens: Lens, table: np.ndarray, pixel: np.ndarray, visible: np.ndarray, poses: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ‖r‖² (m,), Jᵀr (m, 6) and JᵀJ (m, 6, 6) of each image.

    r are the corners' residuals [px], J their derivatives with respect to the board's twist [v; ω]. Arguments as in
    `_refine`; `visible` (m, K): whether each corner was detected.
    """
    turned = np.einsum("mij,kj->mki", poses[:, :3, :3], table)
    point = turned + poses[:, None, :3, 3]
    # A poor start may put corners beside or behind the camera, where no lens model applies.
    off_axis = np.linalg.norm(point[:, :, :2], axis=2)
    min_depth = MIN_DEPTH_RATIO * np.maximum(off_axis, 1e-3)
    point[:, :, 2] = np.maximum(point[:, :, 2], min_depth)
    flat, by_point, _ = lens.project_with_slopes(point.reshape(-1, 3))
    residual = pixel - flat.reshape(pixel.shape)
    residual = np.where(visible[:, :, None], residual, 0.0)
    error = residual.reshape(len(poses), -1)
    by_point = by_point.reshape(*pixel.shape, 3)
    by_point = np.where(visible[:, :, None, None], by_point, 0.0)
    by_turn = np.cross(turned[:, :, None, :], by_point)
    by_twist = np.concatenate([by_point, by_turn], axis=3)
    slope = by_twist.reshape(len(poses), -1, 6)
    gradient = np.einsum("mrk,mr->mk", slope, error)
    information = np.einsum("mrk,mrl->mkl", slope, slope)
    return np.sum(error**2, axis=1), gradient, information


def estimate_lens(
    board: Board, pixel: np.ndarray, size: tuple[int, int], model: str = "pinhole", file: str = ""
) -> Lens:
    """Return the lens estimated from the corners of a flat board in m images.

    Args:
        board: the board in the images.
        pixel: (m, K, 2) corners [px], NaN where not seen.
        size: width and height of the images [px].
        model: ``pinhole`` or ``fisheye``.
        file: name of the file or folder, for messages.

    Raises:
        MeasurementError: if there are too few images, or all show the board from one direction, so that the focal
            length is undetermined.
    """
    is_detected = ~np.isnan(pixel[:, :, 0])
    corner_counts = is_detected.sum(axis=1)
    good = np.flatnonzero(corner_counts >= MIN_LENS_CORNERS)
    if len(good) < MIN_IMAGES:
        refuse_data(
            file,
            f"{counted(len(good), 'image')} with a board, a lens needs at least {MIN_IMAGES} with different tilts "
            "(15 for a good one): take more, or give the lens (camera.yaml)",
        )
    spread = evenly(len(good), MAX_IMAGES)
    sample = pixel[good[spread]]
    lens, rms, matrix = _fitted(board, sample, size, model)
    if rms > BENT and model == "pinhole":
        _, fisheye_rms, _ = _fitted(board, sample, size, "fisheye")
        if fisheye_rms < BENT * rms:
            refuse_data(
                file,
                f"reprojection error {fisheye_rms:.2f} px with a fisheye lens, {rms:.2f} px with a pinhole: state "
                "[camera] model = 'fisheye' in the options, or give the lens (camera.yaml)",
            )
    if not rms < WRONG:
        refuse_data(
            file,
            f"reprojection error {rms:.1f} px with the best {model} lens, so no lens explains these images. Were all "
            "taken by one camera, at one focus, of this board?",
        )
    focal_sigma = _focal_sigma(lens, matrix, rms)
    if not focal_sigma < MAX_FOCAL_SIGMA:
        accuracy = "not at all"
        if focal_sigma < UNKNOWN_FOCAL_SIGMA:
            accuracy = f"to ±{100 * focal_sigma:.2g} % only"
        refuse_data(
            file,
            f"the focal length is identified {accuracy}: the images show the board from too few directions; tilt it "
            "(or the camera) by 20 to 45° both ways in a dozen images, or give the lens (camera.yaml)",
        )
    return lens


def _fitted(board: Board, pixel: np.ndarray, size: tuple[int, int], model: str) -> tuple[Lens, float, np.ndarray]:
    """Return the fitted lens, its reprojection error [px], and the Jacobian (rows, `FITTED`) of the lens.

    The Jacobian is that of the problem in the lens alone, from which the poses are eliminated.

    Args:
        board: the board in the images.
        pixel: (m, K, 2) corners [px], NaN where not detected.
        size: width and height of the images [px].
        model: ``pinhole`` or ``fisheye``.
    """
    middle = 0.5 * (np.array(size) - 1.0)
    zero = np.zeros(COEFFICIENTS[model])
    starts = []
    for share in STARTS:
        focal = share * max(size)
        values = np.array([focal, focal, *middle, *zero])
        starts.append(Lens(model, values, size))

    def start_error(start: Lens) -> float:
        rms = board_poses(start, board, pixel[:MAX_TRIED]).rms
        limited = np.minimum(rms, WRONG)
        return float(np.nanmean(limited))

    lens = min(starts, key=start_error)
    fixed = np.zeros(len(lens.values) - FITTED)
    rows = _beside_poses(lens, board, pixel)
    cost = _squares(rows)
    damping = 1e-3
    for _ in range(LENS_STEPS):
        matrix = rows[:, :FITTED]
        residual = rows[:, FITTED]
        length = np.linalg.norm(matrix, axis=0) + 1e-300
        damping_rows = np.sqrt(damping) * np.eye(FITTED)
        padded = np.concatenate([matrix / length, damping_rows])
        target = np.append(residual, np.zeros(FITTED))
        solution, *_ = np.linalg.lstsq(padded, target, rcond=None)
        step = np.append(solution / length, fixed)
        trial_lens = lens
        trial_rows = rows
        # A focal length below zero raises; then the step is refused.
        with suppress(CalibError):
            trial_lens = lens.with_values(lens.values + step)
            trial_rows = _beside_poses(trial_lens, board, pixel)
        trial_cost = _squares(trial_rows)
        if trial_cost < cost:
            settled = cost - trial_cost < LENS_SETTLED * cost
            lens = trial_lens
            rows = trial_rows
            cost = trial_cost
            damping = damping / 10.0
            if settled:
                break
        else:
            damping = 10.0 * damping
            if damping > MAX_DAMPING:
                break
    detected_coordinates = (~np.isnan(pixel)).sum()
    rms = float(np.sqrt(cost / detected_coordinates))
    return lens, rms, rows[:, :FITTED]


def _squares(rows: np.ndarray) -> float:
    """Return the sum of squared residuals (last column of `rows`); infinite if any residual is not finite."""
    residual = rows[:, FITTED]
    return float(np.nan_to_num(residual @ residual, nan=np.inf))


def _beside_poses(lens: Lens, board: Board, pixel: np.ndarray) -> np.ndarray:
    """Return the rows (R, `FITTED` + 1) of the problem in the lens alone: its Jacobian, then the residuals [px].

    Args:
        lens: the lens at which the problem is linearised.
        board: the board in the images.
        pixel: (m, K, 2) corners [px], NaN where not detected.
    """
    table = corners(board)
    poses = board_poses(lens, board, pixel).poses
    rows = []
    for board_pose, image_pixels in zip(poses, pixel):
        visible = ~np.isnan(image_pixels[:, 0])
        turned = table[visible] @ board_pose[:3, :3].T
        points = turned + board_pose[:3, 3]
        flat, by_point, by_lens = lens.project_with_slopes(points)
        by_turn = np.cross(turned[:, None], by_point)
        residual = (image_pixels[visible] - flat)[:, :, None]
        columns = np.concatenate([by_point, by_turn, by_lens[:, :, :FITTED], residual], axis=2)
        # The rows of the triangle after the six of the pose do not depend on the pose.
        image_rows = columns.reshape(-1, 7 + FITTED)
        triangle = np.asarray(np.linalg.qr(image_rows, mode="r"))
        rows.append(triangle[6:, 6:])
    return np.concatenate(rows)


def _focal_sigma(lens: Lens, matrix: np.ndarray, rms: float) -> float:
    """Return the relative σ of that focal length (fx or fy) which is less certain; infinite if it is not identifiable.

    Args:
        lens: the fitted lens.
        matrix: (rows, `FITTED`) Jacobian of the lens, poses eliminated.
        rms: reprojection error [px].
    """
    size = np.linalg.norm(matrix, axis=0) + 1e-300
    _, values, axes = np.linalg.svd(matrix / size, full_matrices=False)
    if values[-1] < 1e-9 * values[0]:
        return float("inf")
    noise = max(rms, MIN_NOISE)
    scaled_sigma = noise * np.linalg.norm(axes.T / values, axis=1)
    sigma = scaled_sigma / size
    relative = sigma[:2] / lens.values[:2]
    return float(np.max(relative))

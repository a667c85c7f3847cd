"""Estimates from images of a flat board: its pose in each image (PnP) with a known lens, and the lens.

Pose: a homography between table and rays (direct linear transformation; Zhang 2000, sec. 3.1) starts Gauss–Newton on
the reprojection error. Seen from afar a plane has a second pose of nearly the same picture, tilted the other way about
the line of sight (Schweighofer & Pinz 2006): both are refined, the better is taken.

Lens: Zhang's (2000) problem, min over lens and one pose per image of the reprojection error, by variable projection
(Golub & Pereyra 1973; Kaufman 1975): for a given lens every image has its own best pose; a QR of the image's rows
eliminates the six pose columns, which leaves a least-squares problem in the lens alone. The focal length starts at the
best of a few tried values.
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

# of Gauss–Newton
STEPS = 12
# relative change of the cost after which no image needs another
SETTLED = 1e-9
# corners that a pose needs
MIN_SEEN = 6

# focal lengths tried first, in widths of the image (our choice)
STARTS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.5, 2.2, 3.2)
# of a lens's values: focal lengths, principal point, four of distortion
FITTED = 8
# number of distortion's coefficients of a model
COEFFICIENTS = {"pinhole": 5, "fisheye": 4}
# reprojection error from which on the other model is tried [px], and share of it that makes it the better
BENT = 0.5
# reprojection error of no lens [px]
WRONG = 50.0
# images that a lens needs; that a first lens is found from; that starts are tried on (our choice)
MIN_IMAGES = 4
MAX_IMAGES = 30
MAX_TRIED = 8
# relative sigma of the focal length above which images do not tell it (our choice)
MAX_FOCAL_SIGMA = 0.01
# of the fit of a lens
LENS_STEPS = 60


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
    sight = rays(lens, pixel.reshape(-1, 2)).reshape(pixel.shape)
    start = np.array([_from_homography(table, image_rays) for image_rays in sight])
    upright = _refine(lens, table, pixel, start)
    tilted = _refine(lens, table, pixel, _tilted_back(start, table))
    is_tilted = (tilted.rms < upright.rms)[:, None, None]
    poses = np.where(is_tilted, tilted.poses, upright.poses)
    information = np.where(is_tilted, tilted.information, upright.information)
    return BoardPoses(poses, np.fmin(upright.rms, tilted.rms), information)


def _from_homography(table: np.ndarray, sight: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of a board from the rays of its corners (K, 2), by the homography between them."""
    visible = np.flatnonzero(~np.isnan(sight[:, 0]))
    if len(visible) < MIN_SEEN:
        return pose(None, [0.0, 0.0, 1.0])
    ray = sight[visible]
    points = table[visible, :2]
    middle = points.mean(axis=0)
    size = points.std() + 1e-9
    flat = np.column_stack([(points - middle) / size, np.ones(len(visible))])
    rows = np.zeros((2 * len(visible), 9))
    rows[0::2, :3] = flat
    rows[1::2, 3:6] = flat
    rows[:, 6:] = -ray.reshape(-1, 1) * np.repeat(flat, 2, axis=0)
    _, _, axes = np.linalg.svd(rows, full_matrices=False)
    # of the points as they are, with columns of unit length and the board ahead
    plane = axes[-1].reshape(3, 3) @ np.diag([1 / size, 1 / size, 1.0])
    plane[:, 2] -= plane[:, :2] @ middle
    plane = plane / np.sqrt(np.linalg.norm(plane[:, 0]) * np.linalg.norm(plane[:, 1]))
    plane = plane * np.sign((plane @ [*middle, 1.0])[2])
    x, y, position = plane.T
    turn = orthonormal(np.column_stack([x, y, np.cross(x, y)]))
    return pose(turn, position)


def _tilted_back(poses: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Return the second candidate poses (m, 4, 4): board normals mirrored about the line of sight."""
    centre = table.mean(axis=0)
    middle = poses[:, :3, :3] @ centre + poses[:, :3, 3]
    sight = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    normal = poses[:, :3, 2]
    across = np.cross(normal, sight)
    sine = np.linalg.norm(across, axis=1)
    angle = 2.0 * np.arctan2(sine, np.sum(normal * sight, axis=1))
    unit = across / np.maximum(sine[:, None], 1e-12)
    mirrored = Rotation.from_rotvec(unit * angle[:, None]).as_matrix()
    turn = mirrored @ poses[:, :3, :3]
    return pose(turn, middle - turn @ centre)


def _refine(lens: Lens, table: np.ndarray, pixel: np.ndarray, poses: np.ndarray) -> BoardPoses:
    """Return the poses that minimise each image's reprojection error, by damped Gauss–Newton from given poses."""
    visible = ~np.isnan(pixel[:, :, 0])
    damping = np.full(len(poses), 1e-6)
    cost, gradient, information = _normal(lens, table, pixel, visible, poses)
    for _ in range(STEPS):
        scale = np.sqrt(np.einsum("mii->mi", information)) + 1e-9
        scaled = information / (scale[:, :, None] * scale[:, None, :])
        system = scaled + damping[:, None, None] * np.eye(6)
        scaled_gradient = (gradient / scale)[:, :, None]
        step = np.linalg.solve(system, scaled_gradient)[:, :, 0] / scale
        trial = poses.copy()
        trial[:, :3, :3] = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ poses[:, :3, :3]
        trial[:, :3, 3] += step[:, :3]
        trial[:, 2, 3] = np.maximum(trial[:, 2, 3], 0.01)
        trial_cost, trial_gradient, trial_information = _normal(lens, table, pixel, visible, trial)
        better = trial_cost < cost
        settled = np.all(cost - trial_cost <= SETTLED * cost)
        poses = np.where(better[:, None, None], trial, poses)
        cost = np.where(better, trial_cost, cost)
        gradient = np.where(better[:, None], trial_gradient, gradient)
        information = np.where(better[:, None, None], trial_information, information)
        damping = np.where(better, damping / 10.0, damping * 30.0)
        damping = np.clip(damping, 1e-9, 1e6)
        if settled and better.any():
            break
    count = visible.sum(axis=1)
    rms = np.sqrt(cost / np.maximum(2.0 * count - 6.0, 1.0))
    return BoardPoses(poses, np.where(count >= MIN_SEEN, rms, np.nan), information)


def _normal(
    lens: Lens, table: np.ndarray, pixel: np.ndarray, visible: np.ndarray, poses: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ‖r‖² (m,), Jᵀr (m, 6) and JᵀJ (m, 6, 6) of each image; J with respect to the board's twist [v; ω]."""
    turned = np.einsum("mij,kj->mki", poses[:, :3, :3], table)
    point = turned + poses[:, None, :3, 3]
    # a wild guess behind the camera is put before it
    aside = np.maximum(np.linalg.norm(point[:, :, :2], axis=2), 1e-3)
    point[:, :, 2] = np.maximum(point[:, :, 2], 0.3 * aside)
    flat, by_point, _ = lens.project_with_slopes(point.reshape(-1, 3))
    residual = pixel - flat.reshape(pixel.shape)
    error = np.where(visible[:, :, None], residual, 0.0).reshape(len(poses), -1)
    by_point = by_point.reshape(*pixel.shape, 3)
    by_point = np.where(visible[:, :, None, None], by_point, 0.0)
    by_turn = np.cross(turned[:, :, None, :], by_point)
    slope = np.concatenate([by_point, by_turn], axis=3).reshape(len(poses), -1, 6)
    gradient = np.einsum("mrk,mr->mk", slope, error)
    information = np.einsum("mrk,mrl->mkl", slope, slope)
    return np.sum(error**2, axis=1), gradient, information


def estimate_lens(
    board: Board, pixel: np.ndarray, size: tuple[int, int], model: str = "pinhole", file: str = ""
) -> Lens:
    """Return the lens estimated from images (m, K, 2) of a flat board.

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
    corner_counts = (~np.isnan(pixel[:, :, 0])).sum(axis=1)
    good = np.flatnonzero(corner_counts >= 8)
    if len(good) < MIN_IMAGES:
        refuse_data(
            file,
            f"{counted(len(good), 'image')} with a board, a lens needs at least {MIN_IMAGES} with different tilts "
            "(15 for a good one): take more, or give the lens (camera.yaml)",
        )
    sample = pixel[good[evenly(len(good), MAX_IMAGES)]]
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
        if focal_sigma < 0.5:
            accuracy = f"to ±{100 * focal_sigma:.2g} % only"
        refuse_data(
            file,
            f"the focal length is identified {accuracy}: the images show the board from too few directions; tilt it "
            "(or the camera) by 20 to 45° both ways in a dozen images, or give the lens (camera.yaml)",
        )
    return lens


def _fitted(board: Board, pixel: np.ndarray, size: tuple[int, int], model: str) -> tuple[Lens, float, np.ndarray]:
    """Return the fitted lens, its reprojection error [px], and the lens Jacobian with the poses projected out."""
    middle = 0.5 * (np.array(size) - 1.0)
    zero = np.zeros(COEFFICIENTS[model])
    starts = []
    for share in STARTS:
        focal = share * max(size)
        starts.append(Lens(model, np.array([focal, focal, *middle, *zero]), size))

    def start_error(start: Lens) -> float:
        rms = board_poses(start, board, pixel[:MAX_TRIED]).rms
        return float(np.nanmean(np.minimum(rms, WRONG)))

    lens = min(starts, key=start_error)
    fixed = np.zeros(len(lens.values) - FITTED)
    rows = _beside_poses(lens, board, pixel)
    cost = _squares(rows)
    damping = 1e-3
    for _ in range(LENS_STEPS):
        matrix = rows[:, :FITTED]
        residual = rows[:, FITTED]
        length = np.linalg.norm(matrix, axis=0) + 1e-300
        padded = np.concatenate([matrix / length, np.sqrt(damping) * np.eye(FITTED)])
        target = np.append(residual, np.zeros(FITTED))
        solution, *_ = np.linalg.lstsq(padded, target, rcond=None)
        step = np.append(solution / length, fixed)
        trial_lens = lens
        trial_rows = rows
        # not with a focal length below zero
        with suppress(CalibError):
            trial_lens = lens.with_values(lens.values + step)
            trial_rows = _beside_poses(trial_lens, board, pixel)
        trial_cost = _squares(trial_rows)
        if trial_cost < cost:
            settled = cost - trial_cost < 1e-6 * cost
            lens = trial_lens
            rows = trial_rows
            cost = trial_cost
            damping = damping / 10.0
            if settled:
                break
        else:
            damping = 10.0 * damping
            if damping > 1e6:
                break
    rms = float(np.sqrt(cost / (~np.isnan(pixel)).sum()))
    return lens, rms, rows[:, :FITTED]


def _squares(rows: np.ndarray) -> float:
    """Return the sum of squared residuals (last column of `rows`); infinite if any residual is not finite."""
    residual = rows[:, FITTED]
    return float(np.nan_to_num(residual @ residual, nan=np.inf))


def _beside_poses(lens: Lens, board: Board, pixel: np.ndarray) -> np.ndarray:
    """Return the lens Jacobian and the residuals of all images side by side, with the poses projected out."""
    table = corners(board)
    poses = board_poses(lens, board, pixel).poses
    rows = []
    for board_pose, image_pixels in zip(poses, pixel):
        visible = ~np.isnan(image_pixels[:, 0])
        turned = table[visible] @ board_pose[:3, :3].T
        flat, by_point, by_lens = lens.project_with_slopes(turned + board_pose[:3, 3])
        by_turn = np.cross(turned[:, None], by_point)
        residual = (image_pixels[visible] - flat)[:, :, None]
        columns = np.concatenate([by_point, by_turn, by_lens[:, :, :FITTED], residual], axis=2)
        # what a QR leaves beyond the six columns of the pose
        triangle = np.asarray(np.linalg.qr(columns.reshape(-1, 7 + FITTED), mode="r"))
        rows.append(triangle[6:, 6:])
    return np.concatenate(rows)


def _focal_sigma(lens: Lens, matrix: np.ndarray, rms: float) -> float:
    """Return the relative σ of the less certain focal length; infinite if it is not identifiable."""
    size = np.linalg.norm(matrix, axis=0) + 1e-300
    _, values, axes = np.linalg.svd(matrix / size, full_matrices=False)
    if values[-1] < 1e-9 * values[0]:
        return float("inf")
    noise = max(rms, 0.02)
    sigma = noise * np.linalg.norm(axes.T / values, axis=1) / size
    return float(np.max(sigma[:2] / lens.values[:2]))

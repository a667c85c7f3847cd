"""Estimates from images of a flat board: its pose in each image (PnP) with a known lens, and the lens.

Pose: a homography between table and rays (direct linear transformation; Zhang 2000, sec. 3.1) starts Gauss–Newton on
the reprojection error. Seen from afar a plane has a second pose of nearly the same picture, tilted the other way about
the line of sight (Schweighofer & Pinz 2006): both are refined, the better is taken.

Lens: Zhang's (2000) problem, min over lens and one pose per image of the reprojection error, by variable projection
(Golub & Pereyra 1973; Kaufman 1975): for a lens every image has its own best pose, and what a QR of its rows leaves
beyond those six columns is a least-squares problem in the lens alone. The focal length starts at the best of a few.
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

STEPS = 12  # of Gauss–Newton
SETTLED = 1e-9  # relative change of the cost after which no image needs another
MIN_SEEN = 6


@dataclass(frozen=True, eq=False)
class BoardPoses:
    """Board poses (PnP) in m images, with their reprojection errors.

    Attributes:
        poses: (m, 4, 4) of the board in the camera's frame.
        rms: (m,) reprojection error per coordinate [px]; NaN where there are too few corners.
        information: (m, 6, 6) JᵀJ [px²] of [v; ω] in the camera's axes, about the board's origin.
    """

    poses: np.ndarray
    rms: np.ndarray
    information: np.ndarray


def board_poses(lens: Lens, board: Board, pixel: np.ndarray) -> BoardPoses:
    """Return the pose of the board in the camera's frame for each image, from its corners [px].

    Args:
        lens: of the camera.
        board: what was seen.
        pixel: (m, K, 2) corners [px], NaN where not seen.
    """
    table = corners(board)
    sight = rays(lens, pixel.reshape(-1, 2)).reshape(pixel.shape)
    start = np.array([_from_homography(table, image_rays) for image_rays in sight])
    upright, tilted = (_refine(lens, table, pixel, guess) for guess in (start, _tilted_back(start, table)))
    worse = (tilted.rms < upright.rms)[:, None, None]
    return BoardPoses(
        np.where(worse, tilted.poses, upright.poses),
        np.fmin(upright.rms, tilted.rms),
        np.where(worse, tilted.information, upright.information),
    )


def _from_homography(table: np.ndarray, sight: np.ndarray) -> np.ndarray:
    visible = np.flatnonzero(~np.isnan(sight[:, 0]))
    ray = sight[visible]
    if len(visible) < MIN_SEEN:
        return pose(None, [0.0, 0.0, 1.0])
    middle, size = table[visible, :2].mean(axis=0), table[visible, :2].std() + 1e-9
    flat = np.column_stack([(table[visible, :2] - middle) / size, np.ones(len(visible))])
    rows = np.zeros((2 * len(visible), 9))
    rows[0::2, :3] = rows[1::2, 3:6] = flat
    rows[:, 6:] = -ray.reshape(-1, 1) * np.repeat(flat, 2, axis=0)
    plane = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3) @ np.diag([1 / size, 1 / size, 1.0])
    plane[:, 2] -= plane[:, :2] @ middle
    plane = plane / np.sqrt(np.linalg.norm(plane[:, 0]) * np.linalg.norm(plane[:, 1]))
    plane = plane * np.sign((plane @ [*middle, 1.0])[2])
    turn = orthonormal(np.column_stack([plane[:, 0], plane[:, 1], np.cross(plane[:, 0], plane[:, 1])]))
    return pose(turn, plane[:, 2])


def _tilted_back(poses: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Return the second candidate poses (m, 4, 4): board normals mirrored about the line of sight."""
    middle = poses[:, :3, :3] @ table.mean(axis=0) + poses[:, :3, 3]
    sight = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    normal = poses[:, :3, 2]
    across = np.cross(normal, sight)
    angle = 2.0 * np.arctan2(np.linalg.norm(across, axis=1), np.sum(normal * sight, axis=1))
    unit = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    turn = Rotation.from_rotvec(unit * angle[:, None]).as_matrix() @ poses[:, :3, :3]
    return pose(turn, middle - turn @ table.mean(axis=0))


def _refine(lens: Lens, table: np.ndarray, pixel: np.ndarray, poses: np.ndarray) -> BoardPoses:
    """Return the poses that minimise each image's reprojection error, by damped Gauss–Newton from given poses."""
    visible = ~np.isnan(pixel[:, :, 0])
    damping = np.full(len(poses), 1e-6)
    cost, gradient, information = _normal(lens, table, pixel, visible, poses)
    for _ in range(STEPS):
        scale = np.sqrt(np.einsum("mii->mi", information)) + 1e-9
        system = information / (scale[:, :, None] * scale[:, None, :]) + damping[:, None, None] * np.eye(6)
        step = np.linalg.solve(system, (gradient / scale)[:, :, None])[:, :, 0] / scale
        trial = poses.copy()
        trial[:, :3, :3] = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ poses[:, :3, :3]
        trial[:, :3, 3] += step[:, :3]
        trial[:, 2, 3] = np.maximum(trial[:, 2, 3], 0.01)
        trial_normal = _normal(lens, table, pixel, visible, trial)
        better = trial_normal[0] < cost
        settled = np.all(cost - trial_normal[0] <= SETTLED * cost)
        poses = np.where(better[:, None, None], trial, poses)
        cost, gradient = np.where(better, trial_normal[0], cost), np.where(better[:, None], trial_normal[1], gradient)
        information = np.where(better[:, None, None], trial_normal[2], information)
        damping = np.clip(np.where(better, damping / 10.0, damping * 30.0), 1e-9, 1e6)
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
    aside = np.maximum(np.linalg.norm(point[:, :, :2], axis=2), 1e-3)
    point[:, :, 2] = np.maximum(point[:, :, 2], 0.3 * aside)
    flat, by_point, _ = lens.project_with_slopes(point.reshape(-1, 3))
    residual = np.where(visible[:, :, None], pixel - flat.reshape(pixel.shape), 0.0)
    by_point = np.where(visible[:, :, None, None], by_point.reshape(*pixel.shape, 3), 0.0)
    slope = np.concatenate([by_point, np.cross(turned[:, :, None, :], by_point)], axis=3).reshape(len(poses), -1, 6)
    error = residual.reshape(len(poses), -1)
    return np.sum(error**2, axis=1), np.einsum("mrk,mr->mk", slope, error), np.einsum("mrk,mrl->mkl", slope, slope)


STARTS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.5, 2.2, 3.2)  # focal lengths tried first, in widths of the image (our choice)
FITTED = 8  # of a lens's values: focal lengths, principal point, four of distortion
BENT = 0.5  # reprojection error from which on the other model is tried [px], and share of it that makes it the better
WRONG = 50.0  # reprojection error of no lens [px]


def estimate_lens(
    board: Board, pixel: np.ndarray, size: tuple[int, int], model: str = "pinhole", file: str = ""
) -> Lens:
    """Return the lens estimated from images (m, K, 2) [px] of a flat board.

    Args:
        board: what was seen.
        pixel: corners, NaN where not seen.
        size: width and height of the images [px].
        model: ``pinhole`` or ``fisheye``.
        file: for messages.

    Raises:
        MeasurementError: too few images, or all from one direction, so that the focal length cannot be determined.
    """
    good = np.flatnonzero((~np.isnan(pixel[:, :, 0])).sum(axis=1) >= 8)
    min_images = 4
    if len(good) < min_images:
        refuse_data(
            file,
            f"{counted(len(good), 'image')} with a board, a lens needs at least {min_images} with different tilts "
            "(15 for a good one): take more, or give the lens (camera.yaml)",
        )
    max_images = 30  # images that a first lens is found from (our choice)
    good = good[evenly(len(good), max_images)]
    sample = pixel[good]
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
    loose = _focal_sigma(lens, matrix, rms)
    max_focal_sigma = 0.01  # relative sigma of the focal length above which images do not tell it (our choice)
    if not loose < max_focal_sigma:
        accuracy = f"to ±{100 * loose:.2g} % only" if loose < 0.5 else "not at all"
        refuse_data(
            file,
            f"the focal length is identified {accuracy}: the images show the board from too few directions; tilt it "
            "(or the camera) by 20 to 45° both ways in a dozen images, or give the lens (camera.yaml)",
        )
    return lens


def _fitted(board: Board, pixel: np.ndarray, size: tuple[int, int], model: str) -> tuple[Lens, float, np.ndarray]:
    """Return the fitted lens, its reprojection error [px], and the lens Jacobian with the poses projected out."""
    middle, zero = 0.5 * (np.array(size) - 1.0), np.zeros({"pinhole": 5, "fisheye": 4}[model])
    starts = [Lens(model, np.array([f * max(size), f * max(size), *middle, *zero]), size) for f in STARTS]
    max_tried = 8  # images that they are tried on (our choice)
    lens = min(
        starts,
        key=lambda candidate: float(
            np.nanmean(np.minimum(board_poses(candidate, board, pixel[:max_tried]).rms, WRONG))
        ),
    )
    rows, damping = _beside_poses(lens, board, pixel), 1e-3
    cost = _squares(rows)
    max_steps = 60
    for _ in range(max_steps):
        matrix, residual = rows[:, :FITTED], rows[:, FITTED]
        length = np.linalg.norm(matrix, axis=0) + 1e-300
        padded = np.concatenate([matrix / length, np.sqrt(damping) * np.eye(FITTED)])
        step = np.linalg.lstsq(padded, np.append(residual, np.zeros(FITTED)), rcond=None)[0] / length
        trial_lens, trial_rows = lens, rows
        with suppress(CalibError):  # a focal length below zero
            trial_lens = lens.with_values(lens.values + np.append(step, np.zeros(len(lens.values) - FITTED)))
            trial_rows = _beside_poses(trial_lens, board, pixel)
        after = _squares(trial_rows)
        if after < cost:
            settled = cost - after < 1e-6 * cost
            lens, rows, cost, damping = trial_lens, trial_rows, after, damping / 10.0
            if settled:
                break
        elif (damping := 10.0 * damping) > 1e6:
            break
    return lens, float(np.sqrt(cost / (~np.isnan(pixel)).sum())), rows[:, :FITTED]


def _squares(rows: np.ndarray) -> float:
    """Return the sum of squared residuals (last column of `rows`); infinite if the projection is not valid."""
    return float(np.nan_to_num(rows[:, FITTED] @ rows[:, FITTED], nan=np.inf))


def _beside_poses(lens: Lens, board: Board, pixel: np.ndarray) -> np.ndarray:
    """Return the lens Jacobian and the residuals of all images side by side, with the poses projected out."""
    table, rows = corners(board), []
    for board_pose, image_pixels in zip(board_poses(lens, board, pixel).poses, pixel):
        visible = ~np.isnan(image_pixels[:, 0])
        turned = table[visible] @ board_pose[:3, :3].T
        flat, by_point, by_lens = lens.project_with_slopes(turned + board_pose[:3, 3])
        parts = [
            by_point,
            np.cross(turned[:, None], by_point),
            by_lens[:, :, :FITTED],
            (image_pixels[visible] - flat)[:, :, None],
        ]
        rows.append(np.asarray(np.linalg.qr(np.concatenate(parts, axis=2).reshape(-1, 7 + FITTED), mode="r"))[6:, 6:])
    return np.concatenate(rows)


def _focal_sigma(lens: Lens, matrix: np.ndarray, rms: float) -> float:
    """Return the relative σ of the less certain focal length; infinite if it is not identifiable."""
    size = np.linalg.norm(matrix, axis=0) + 1e-300
    _, values, axes = np.linalg.svd(matrix / size, full_matrices=False)
    if values[-1] < 1e-9 * values[0]:
        return float("inf")
    sigma = max(rms, 0.02) * np.linalg.norm(axes.T / values, axis=1) / size
    return float(np.max(sigma[:2] / lens.values[:2]))

"""Estimation of a lens from images of a board, with a check that it is identifiable.

Zhang's (2000) problem, min over lens and one pose per image of the reprojection error, by variable projection (Golub &
Pereyra 1973; Kaufman 1975): for a lens every image has its own best pose, and what a QR of its rows leaves beyond those
six columns is a least-squares problem in the lens alone. The focal length starts at the best of a few.
"""

from contextlib import suppress

import numpy as np

from calib.errors import CalibError, counted, refuse_data
from calib.rooms.camera.board import Board, corners
from calib.rooms.camera.board_pose import board_poses
from calib.rooms.camera.lens import Lens

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
            f"{counted(len(good), 'image')} with a board: a lens takes {min_images} at least, tilted "
            "differently, and a good one 15; take more, or give the lens (camera.yaml)",
        )
    max_images = 30  # images that a first lens is found from (our choice)
    good = good[np.unique(np.linspace(0, len(good) - 1, max_images).astype(int))]
    own = pixel[good]
    found, rms, matrix = _fitted(board, own, size, model)
    if rms > BENT and model == "pinhole" and (other := _fitted(board, own, size, "fisheye")[1]) < BENT * rms:
        refuse_data(
            file,
            f"a fisheye lens explains these images to {other:.2f} px, a pinhole's to {rms:.2f} px only: state "
            "[camera] model = 'fisheye' in the options, or give the lens (camera.yaml)",
        )
    if not rms < WRONG:
        refuse_data(
            file,
            f"no {model} lens explains these images: {rms:.1f} px remain with the best one. Were they all taken with "
            "one camera, at one focus, of this board?",
        )
    loose = _focal_sigma(found, matrix, rms)
    max_focal_sigma = 0.01  # relative sigma of the focal length above which images do not tell it (our choice)
    if not loose < max_focal_sigma:
        told = f"to ±{100 * loose:.2g} % only" if loose < 0.5 else "not at all"
        refuse_data(
            file,
            f"the focal length is identified {told}: the images see the board from too few "
            "directions; tilt it (or the camera) by 20 to 45° both ways in a dozen images, or give the lens "
            "(camera.yaml)",
        )
    return found


def _fitted(board: Board, pixel: np.ndarray, size: tuple[int, int], model: str) -> tuple[Lens, float, np.ndarray]:
    """Return the best lens, its reprojection error [px], and ∂residual/∂values with the poses projected out."""
    middle, zero = 0.5 * (np.array(size) - 1.0), np.zeros({"pinhole": 5, "fisheye": 4}[model])
    starts = [Lens(model, np.array([f * max(size), f * max(size), *middle, *zero]), size) for f in STARTS]
    max_tried = 8  # images that they are tried on (our choice)
    lens = min(
        starts, key=lambda each: float(np.nanmean(np.minimum(board_poses(each, board, pixel[:max_tried]).rms, WRONG)))
    )
    rows, damping = _beside_poses(lens, board, pixel), 1e-3
    cost = _squares(rows)
    max_steps = 60
    for _ in range(max_steps):
        matrix, residual = rows[:, :FITTED], rows[:, FITTED]
        length = np.linalg.norm(matrix, axis=0) + 1e-300
        padded = np.concatenate([matrix / length, np.sqrt(damping) * np.eye(FITTED)])
        step = np.linalg.lstsq(padded, np.append(residual, np.zeros(FITTED)), rcond=None)[0] / length
        trial = rows
        with suppress(CalibError):  # a focal length below zero
            moved = lens.with_values(lens.values + np.append(step, np.zeros(len(lens.values) - FITTED)))
            trial = _beside_poses(moved, board, pixel)
        after = _squares(trial)
        if after < cost:
            settled = cost - after < 1e-6 * cost
            lens, rows, cost, damping = moved, trial, after, damping / 10.0
            if settled:
                break
        elif (damping := 10.0 * damping) > 1e6:
            break
    return lens, float(np.sqrt(cost / (~np.isnan(pixel)).sum())), rows[:, :FITTED]


def _squares(rows: np.ndarray) -> float:
    """Return the sum of squares of the residuals (last column); infinite for a lens without valid projection."""
    return float(np.nan_to_num(rows[:, FITTED] @ rows[:, FITTED], nan=np.inf))


def _beside_poses(lens: Lens, board: Board, pixel: np.ndarray) -> np.ndarray:
    """Return [∂residual/∂values, residual] of all images with each image's pose projected out."""
    table, rows = corners(board), []
    for where, own in zip(board_poses(lens, board, pixel).poses, pixel):
        seen = ~np.isnan(own[:, 0])
        turned = table[seen] @ where[:3, :3].T
        flat, by_point, by_lens = lens.project_with_slopes(turned + where[:3, 3])
        parts = [by_point, np.cross(turned[:, None], by_point), by_lens[:, :, :FITTED], (own[seen] - flat)[:, :, None]]
        rows.append(np.asarray(np.linalg.qr(np.concatenate(parts, axis=2).reshape(-1, 7 + FITTED), mode="r"))[6:, 6:])
    return np.concatenate(rows)


def _focal_sigma(lens: Lens, matrix: np.ndarray, rms: float) -> float:
    """Return the larger relative sigma of both focal lengths with unknown poses; infinite if not identifiable."""
    size = np.linalg.norm(matrix, axis=0) + 1e-300
    _, values, axes = np.linalg.svd(matrix / size, full_matrices=False)
    if values[-1] < 1e-9 * values[0]:
        return float("inf")
    sigma = max(rms, 0.02) * np.linalg.norm(axes.T / values, axis=1) / size
    return float(np.max(sigma[:2] / lens.values[:2]))

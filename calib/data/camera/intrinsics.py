"""A lens from images of a board alone (Zhang 2000; OpenCV's calibrateCamera), and whether they tell it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from calib.data.camera.board import Board, corners
from calib.data.camera.board_pose import board_poses
from calib.data.camera.lens import Lens, project_with_slopes
from calib.errors import MeasurementError

MOST = 30  # images that a first lens is found from (our choice)
FEWEST = 4
LOOSE = 0.01  # relative sigma of the focal length above which images do not tell it (our choice)


@dataclass(frozen=True, eq=False)
class LensGuess:
    """A lens found from images.

    Attributes:
        lens: see there.
        rms: reprojection error per coordinate [px].
        focal_sigma: of fx and fy, relative.
    """

    lens: Lens
    rms: float
    focal_sigma: float


def estimate_lens(
    board: Board, pixel: np.ndarray, size: tuple[int, int], model: str = "pinhole", file: str = ""
) -> LensGuess:
    """Return the lens that images (m, K, 2) [px] of a flat board tell.

    Args:
        board: what was seen.
        pixel: corners, NaN where not seen.
        size: width and height of the images [px].
        model: ``pinhole`` or ``fisheye``.
        file: for messages.

    Raises:
        MeasurementError: too few images, or all from one direction, so that the focal length cannot be told.
    """
    table = corners(board)
    seen = ~np.isnan(pixel[:, :, 0])
    good = np.flatnonzero(seen.sum(axis=1) >= 8)
    if len(good) < FEWEST:
        raise MeasurementError(
            f"{len(good)} images with a board: a lens takes {FEWEST} at least, tilted differently, and a good one 15; "
            "take more, or give the lens (camera.yaml)",
            file,
        )
    good = good[np.unique(np.linspace(0, len(good) - 1, MOST).astype(int))]
    objects = [table[seen[k]].astype(np.float32) for k in good]
    images = [pixel[k][seen[k]].astype(np.float32) for k in good]
    try:
        lens, rms = (_fisheye if model == "fisheye" else _pinhole)(objects, images, size)
    except cv2.error as error:
        raise MeasurementError(
            f"no lens explains these images ({str(error).splitlines()[0][:120]}): were they all taken with one camera, "
            "at one focus, of this board?",
            file,
        ) from error
    loose = _focal_sigma(lens, board, pixel[good], rms)
    if not loose < LOOSE:
        told = f"to ±{100 * loose:.2g} % only" if loose < 0.5 else "not at all"
        raise MeasurementError(
            f"the focal length is told {told}: the images see the board from too few "
            "directions; tilt it (or the camera) by 20 to 45° both ways in a dozen images, or give the lens "
            "(camera.yaml)",
            file,
        )
    return LensGuess(lens, rms, loose)


def _pinhole(objects: list[np.ndarray], images: list[np.ndarray], size: tuple[int, int]) -> tuple[Lens, float]:
    focal = 1.2 * max(size)
    guess = np.array([[focal, 0, 0.5 * (size[0] - 1)], [0, focal, 0.5 * (size[1] - 1)], [0, 0, 1.0]])
    flags = cv2.CALIB_FIX_K3
    guessed = cv2.initCameraMatrix2D(objects, images, size, 1.0)
    if not np.isfinite(guessed).all() or not 0.2 * max(size) < guessed[0, 0] < 20 * max(size):
        guessed = guess
    rms, matrix, bend, _, _ = cv2.calibrateCamera(objects, images, size, guessed, np.zeros(5), flags=flags)
    values = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *bend.ravel()[:4], 0.0])
    return Lens("pinhole", values, size), float(rms) / np.sqrt(2.0)


def _fisheye(objects: list[np.ndarray], images: list[np.ndarray], size: tuple[int, int]) -> tuple[Lens, float]:
    places: Any = cv2 if hasattr(cv2, "CALIB_RECOMPUTE_EXTRINSIC") else cv2.fisheye  # version 5, and before
    flags = places.CALIB_RECOMPUTE_EXTRINSIC | places.CALIB_FIX_SKEW
    shaped = [each.reshape(1, -1, 3).astype(np.float64) for each in objects]
    seen = [each.reshape(1, -1, 2).astype(np.float64) for each in images]
    rms, matrix, bend, _, _ = cv2.fisheye.calibrate(shaped, seen, size, np.eye(3), np.zeros(4), flags=flags)
    values = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *bend.ravel()])
    return Lens("fisheye", values, size), float(rms) / np.sqrt(2.0)


def _focal_sigma(lens: Lens, board: Board, pixel: np.ndarray, rms: float) -> float:
    """Return the larger relative sigma of the focal lengths, every image's pose being unknown; infinite for none.

    OpenCV's own is a pseudo-inverse's, and tiny where nothing is told.
    """
    table, seen, rows = corners(board), ~np.isnan(pixel[:, :, 0]), []
    places, fitted = board_poses(lens, board, pixel).poses, np.array([0, 1, 2, 3, 4, 5, 6, 7])
    for where, own in zip(places, seen):
        turned = table[own] @ where[:3, :3].T
        _, by_point, by_lens = project_with_slopes(lens, turned + where[:3, 3])
        slope = np.concatenate([by_point, np.cross(turned[:, None], by_point), by_lens[:, :, fitted]], axis=2)
        rows.append(np.asarray(np.linalg.qr(slope.reshape(-1, 14), mode="r"))[6:, 6:])
    matrix = np.concatenate(rows)
    size = np.linalg.norm(matrix, axis=0) + 1e-300
    _, values, axes = np.linalg.svd(matrix / size, full_matrices=False)
    if values[-1] < 1e-9 * values[0]:
        return float("inf")
    sigma = max(rms, 0.02) * np.linalg.norm(axes.T / values, axis=1) / size
    return float(np.max(sigma[:2] / lens.values[:2]))

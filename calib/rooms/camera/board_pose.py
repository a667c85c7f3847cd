"""Pose of a flat board relative to a camera with known lens (PnP): one pose per image, from its corners.

A homography between table and rays (direct linear transformation; Zhang 2000, sec. 3.1) starts Gauss–Newton on the
reprojection error. Seen from afar a plane has a second pose of nearly the same picture, tilted the other way about the
line of sight (Schweighofer & Pinz 2006): both are refined, the better is taken.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.rooms.camera.board import Board, corners
from calib.rooms.camera.lens import Lens, rays
from calib.transforms import orthonormal, pose

STEPS = 12  # of Gauss–Newton
SETTLED = 1e-9  # relative change of the cost after which no image needs another
MIN_CORNERS = 6


@dataclass(frozen=True, eq=False)
class BoardPoses:
    """Board poses and reprojection errors of m images, from PnP.

    Attributes:
        poses: (m, 4, 4) of the board in the camera's frame.
        rms: (m,) reprojection error per coordinate [px]; NaN where there are too few corners.
        information: (m, 6, 6) JᵀJ [px²] of [v; ω] in the camera's axes, about the board's origin.
    """

    poses: np.ndarray
    rms: np.ndarray
    information: np.ndarray


def board_poses(lens: Lens, board: Board, pixel: np.ndarray) -> BoardPoses:
    """Return the board's pose in the camera's frame for each image.

    Args:
        lens: of the camera.
        board: what was seen.
        pixel: (m, K, 2) corners [px], NaN where not seen.
    """
    table = corners(board)
    sight = rays(lens, pixel.reshape(-1, 2)).reshape(pixel.shape)
    start = np.array([_from_homography(table, each) for each in sight])
    one, two = (_refine(lens, table, pixel, guess) for guess in (start, _tilted_back(start, table)))
    worse = (two.rms < one.rms)[:, None, None]
    return BoardPoses(
        np.where(worse, two.poses, one.poses), np.fmin(one.rms, two.rms),
        np.where(worse, two.information, one.information),
    )  # fmt: skip


def _from_homography(table: np.ndarray, sight: np.ndarray) -> np.ndarray:
    seen = np.flatnonzero(~np.isnan(sight[:, 0]))
    ray = sight[seen]
    if len(seen) < MIN_CORNERS:
        return pose(None, [0.0, 0.0, 1.0])
    middle, size = table[seen, :2].mean(axis=0), table[seen, :2].std() + 1e-9
    flat = np.column_stack([(table[seen, :2] - middle) / size, np.ones(len(seen))])
    rows = np.zeros((2 * len(seen), 9))
    rows[0::2, :3] = rows[1::2, 3:6] = flat
    rows[:, 6:] = -ray.reshape(-1, 1) * np.repeat(flat, 2, axis=0)
    plane = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3) @ np.diag([1 / size, 1 / size, 1.0])
    plane[:, 2] -= plane[:, :2] @ middle
    plane = plane / np.sqrt(np.linalg.norm(plane[:, 0]) * np.linalg.norm(plane[:, 1]))
    plane = plane * np.sign((plane @ [*middle, 1.0])[2])
    turn = orthonormal(np.column_stack([plane[:, 0], plane[:, 1], np.cross(plane[:, 0], plane[:, 1])]))
    return pose(turn, plane[:, 2])


def _tilted_back(poses: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Return poses (m, 4, 4) with the boards' normals mirrored about the line of sight to their centre."""
    middle = poses[:, :3, :3] @ table.mean(axis=0) + poses[:, :3, 3]
    sight = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    normal = poses[:, :3, 2]
    across = np.cross(normal, sight)
    angle = 2.0 * np.arctan2(np.linalg.norm(across, axis=1), np.sum(normal * sight, axis=1))
    unit = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    turn = Rotation.from_rotvec(unit * angle[:, None]).as_matrix() @ poses[:, :3, :3]
    return pose(turn, middle - turn @ table.mean(axis=0))


def _refine(lens: Lens, table: np.ndarray, pixel: np.ndarray, poses: np.ndarray) -> BoardPoses:
    """Return poses refined by damped Gauss–Newton on the reprojection error of each image; see `board_poses`."""
    seen = ~np.isnan(pixel[:, :, 0])
    damping = np.full(len(poses), 1e-6)
    cost, gradient, information = _normal(lens, table, pixel, seen, poses)
    for _ in range(STEPS):
        scale = np.sqrt(np.einsum("mii->mi", information)) + 1e-9
        system = information / (scale[:, :, None] * scale[:, None, :]) + damping[:, None, None] * np.eye(6)
        step = np.linalg.solve(system, (gradient / scale)[:, :, None])[:, :, 0] / scale
        trial = poses.copy()
        trial[:, :3, :3] = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ poses[:, :3, :3]
        trial[:, :3, 3] += step[:, :3]
        trial[:, 2, 3] = np.maximum(trial[:, 2, 3], 0.01)
        found = _normal(lens, table, pixel, seen, trial)
        better = found[0] < cost
        settled = np.all(cost - found[0] <= SETTLED * cost)
        poses = np.where(better[:, None, None], trial, poses)
        cost, gradient = np.where(better, found[0], cost), np.where(better[:, None], found[1], gradient)
        information = np.where(better[:, None, None], found[2], information)
        damping = np.clip(np.where(better, damping / 10.0, damping * 30.0), 1e-9, 1e6)
        if settled and better.any():
            break
    count = seen.sum(axis=1)
    rms = np.sqrt(cost / np.maximum(2.0 * count - 6.0, 1.0))
    return BoardPoses(poses, np.where(count >= MIN_CORNERS, rms, np.nan), information)


def _normal(
    lens: Lens, table: np.ndarray, pixel: np.ndarray, seen: np.ndarray, poses: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ‖r‖² (m,), Jᵀr (m, 6) and JᵀJ (m, 6, 6) of [v; ω] about the board's origin."""
    turned = np.einsum("mij,kj->mki", poses[:, :3, :3], table)
    point = turned + poses[:, None, :3, 3]
    aside = np.maximum(np.linalg.norm(point[:, :, :2], axis=2), 1e-3)
    point[:, :, 2] = np.maximum(point[:, :, 2], 0.3 * aside)
    flat, by_point, _ = lens.project_with_slopes(point.reshape(-1, 3))
    residual = np.where(seen[:, :, None], pixel - flat.reshape(pixel.shape), 0.0)
    by_point = np.where(seen[:, :, None, None], by_point.reshape(*pixel.shape, 3), 0.0)
    slope = np.concatenate([by_point, np.cross(turned[:, :, None, :], by_point)], axis=3).reshape(len(poses), -1, 6)
    error = residual.reshape(len(poses), -1)
    return np.sum(error**2, axis=1), np.einsum("mrk,mr->mk", slope, error), np.einsum("mrk,mrl->mkl", slope, slope)

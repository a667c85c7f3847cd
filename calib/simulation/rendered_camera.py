"""A synthetic camera: rendered images of a printed board with lens, focus, light and sensor noise.

    grey = round(clip(255 exposure · light(u, v) · (defocus * mean over the exposure of reflectance), 0, 255) + noise)

Reflectance is looked up along the ray of every sub-pixel, distortion included. Noise has the variance
read² + shot · grey. Pixels of a board that bends are looked up on the bent surface.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from calib.data.images.board import Board
from calib.data.images.board_print import raster
from calib.data.images.lens import Lens, rays
from calib.data.images.optics import BoardShape, shaped_points

SUB = 3  # sub-pixels each way
NODES = 16  # pixels between the nodes at which rays are computed; cubic in between
PAPER = 0.02  # white margin around the pattern [m]


@dataclass(frozen=True)
class Imaging:
    """Exposure, focus, light and noise of an image.

    Attributes:
        exposure: grey level of white paper in full light, as a share of 255; above 1 it saturates.
        uneven: how much darker the light is at the image's dark side, as a share.
        defocus: standard deviation of the blur [px].
        read: noise of the sensor [grey levels].
        shot: variance of the photon noise per grey level [grey levels].
        background: reflectance behind the board.
    """

    exposure: float = 0.8
    uneven: float = 0.2
    defocus: float = 0.7
    read: float = 1.0
    shot: float = 0.02
    background: float = 0.35


def render(
    board: Board,
    lens: Lens,
    poses: np.ndarray,
    imaging: Imaging | None = None,
    seed: int | np.random.Generator = 0,
    shape: BoardShape | None = None,
) -> np.ndarray:
    """Return the rendered 8-bit image (height, width) of a board.

    Args:
        board: what was printed.
        lens: of the camera.
        poses: (4, 4) of the board in the camera's frame, or several (k, 4, 4) that the exposure runs through evenly:
            motion blur.
        imaging: light, focus and noise.
        seed: of the noise.
        shape: of the print: scale and bending.
    """
    imaging, rng = imaging or Imaging(), np.random.default_rng(seed)
    exposure_poses = np.atleast_3d(poses.T).T.reshape(-1, 4, 4)
    image = np.zeros(lens.size[::-1], dtype=np.float32)
    for pose in exposure_poses:
        image += _reflectance(board, lens, pose, imaging.background, shape or BoardShape()) / len(exposure_poses)
    if imaging.defocus > 0.0:
        image = cv2.GaussianBlur(image, (0, 0), imaging.defocus)
    across = np.linspace(-0.5, 0.5, lens.size[0], dtype=np.float32)[None]
    down = np.linspace(-0.5, 0.5, lens.size[1], dtype=np.float32)[:, None]
    light = 1.0 - imaging.uneven * (0.5 + 0.7 * across + 0.3 * down)
    grey = 255.0 * imaging.exposure * light * image
    grey += rng.standard_normal(grey.shape, dtype=np.float32) * np.sqrt(imaging.read**2 + imaging.shot * grey)
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)


def _reflectance(board: Board, lens: Lens, pose: np.ndarray, background: float, shape: BoardShape) -> np.ndarray:
    """Return the reflectance image (height, width) of one board pose, averaged over each pixel."""
    result = np.full(lens.size[::-1], background, dtype=np.float32)
    outline = _outline(board)
    outline_camera = shaped_points(board, shape, outline) @ pose[:3, :3].T + pose[:3, 3]
    if np.any(outline_camera[:, 2] < 0.02):
        return result
    pixel = lens.project(outline_camera)
    low = np.maximum(np.floor(pixel.min(axis=0)) - 2, 0).astype(int)
    high = np.minimum(np.ceil(pixel.max(axis=0)) + 3, lens.size).astype(int)
    if np.any(high <= low):
        return result
    scale = SUB * float(np.max(lens.values[:2]) / outline_camera[:, 2].min())
    level = int(np.ceil(np.log(scale) / np.log(1.25)))
    sheet, per_metre = _sheet_at(board, level), 1.25**level
    board_points = _on_sheet(board, lens, pose, shape, low, high)
    x, y = (((board_points[:, :, axis] + PAPER) * per_metre - 0.5).astype(np.float32) for axis in (0, 1))
    fine = cv2.remap(sheet, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=background)
    size = high - low
    result[low[1] : high[1], low[0] : high[0]] = cv2.resize(fine, tuple(size.tolist()), interpolation=cv2.INTER_AREA)
    return result


@lru_cache(maxsize=4)
def _sheet_at(board: Board, level: int) -> np.ndarray:
    return raster(board, 1.25**level, PAPER)


def _outline(board: Board) -> np.ndarray:
    """Return points (N, 3) [m] along the edge of the paper."""
    width, height = board.extent
    x, y = np.linspace(-PAPER, width + PAPER, 9), np.linspace(-PAPER, height + PAPER, 9)
    edge = [(a, b) for a in x for b in (y[0], y[-1])] + [(a, b) for a in (x[0], x[-1]) for b in y]
    return np.column_stack([np.array(edge), np.zeros(len(edge))])


def _on_sheet(
    board: Board, lens: Lens, pose: np.ndarray, shape: BoardShape, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Return the board points (h·SUB, w·SUB, 2) [m] seen by the sub-pixels of an image window."""
    knots = [np.arange(a - NODES, b + 2 * NODES, NODES, dtype=float) for a, b in zip(low, high)]
    grid = np.stack(np.meshgrid(*knots), axis=-1)
    ray = np.concatenate([rays(lens, grid.reshape(-1, 2)), np.ones((grid[..., 0].size, 1))], axis=1)
    normal, turned = pose[:3, 2], pose[:3, :3]
    hit = np.zeros((len(ray), 2))
    for _ in range(4 if shape.bent else 1):
        rise = shaped_points(board, shape, np.column_stack([hit, np.zeros(len(hit))]))[:, 2]
        depth = (normal @ pose[:3, 3] + rise) / (ray @ normal)
        hit = ((ray * depth[:, None] - pose[:3, 3]) @ turned)[:, :2] / shape.scale
    nodes = hit.reshape(grid.shape).astype(np.float32)  # 1e-4 px
    down, across = (_cubic(count, len(line)) for count, line in zip((high - low)[::-1], knots[::-1]))
    return np.stack([down @ nodes[:, :, k] @ across.T for k in (0, 1)], axis=-1)


def _cubic(count: int, columns: int) -> np.ndarray:
    """Return the matrix that interpolates from nodes to the sub-pixels of `count` pixels (Catmull & Rom 1974)."""
    at = (np.arange(count * SUB) + 0.5) / SUB - 0.5 + NODES  # pixels after the first node
    first, t = np.divmod(at / NODES, 1.0)
    result = np.zeros((len(at), columns), dtype=np.float32)
    weights = [-t * (1 - t) ** 2, 2 - 5 * t**2 + 3 * t**3, t * (1 + 4 * t - 3 * t**2), -(t**2) * (1 - t)]
    for offset, weight in zip((-1, 0, 1, 2), weights):
        result[np.arange(len(at)), first.astype(int) + offset] += 0.5 * weight
    return result

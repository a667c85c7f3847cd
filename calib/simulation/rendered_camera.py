"""A synthetic camera: rendered images of a printed board with lens, focus, light and sensor noise.

    grey = round(clip(255 exposure · light(u, v) · (defocus * mean over the exposure of reflectance), 0, 255) + noise)

Reflectance is looked up along the ray of every sub-pixel, distortion included. Noise has the variance
read² + shot · grey. Pixels of a board that bends are looked up on the bent surface.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calib.data.images.board import Board
from calib.data.images.board_print import raster
from calib.data.images.lens import Lens, rays
from calib.data.images.optics import BoardShape, shaped_points
from calib.workers.extras import needing

with needing("cv2"):
    import cv2

# Number of sub-pixels per pixel in each direction.
SUB = 3
# Distance [px] of the nodes at which rays are computed; between nodes the board points are interpolated.
NODES = 16
# White margin around the pattern [m].
PAPER = 0.02
# Number of iterations that intersect a ray with a bent board.
BENT_ITERATIONS = 4
# Smallest distance [m] of the paper's edge from the camera; a nearer board is not drawn.
MIN_DEPTH = 0.02
# Ratio of the resolutions at which drawings of a board are made: a drawing serves similar distances.
RESOLUTION_RATIO = 1.25


@dataclass(frozen=True)
class Imaging:
    """Exposure, focus, light and noise of an image.

    Attributes:
        exposure: grey level of white paper in full light, as a share of 255; above 1 it saturates.
        uneven: share by which the light is weaker at the darkest side of the image.
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
        board: the printed board.
        lens: lens of the camera.
        poses: pose (4, 4) of the board in the camera's frame, or poses (k, 4, 4) passed at even times during the
            exposure (motion blur).
        imaging: light, focus and noise.
        seed: seed of the noise.
        shape: shape of the print (scale and bending); None for an exact print.
    """
    imaging = imaging or Imaging()
    shape = shape or BoardShape()
    rng = np.random.default_rng(seed)
    width, height = lens.size
    exposure_poses = np.atleast_3d(poses.T).T.reshape(-1, 4, 4)
    image = np.zeros((height, width), dtype=np.float32)
    for pose in exposure_poses:
        reflectance = _reflectance(board, lens, pose, imaging.background, shape)
        image += reflectance / len(exposure_poses)
    if imaging.defocus > 0.0:
        image = cv2.GaussianBlur(image, (0, 0), imaging.defocus)
    across = np.linspace(-0.5, 0.5, width, dtype=np.float32)[None]
    down = np.linspace(-0.5, 0.5, height, dtype=np.float32)[:, None]
    light = 1.0 - imaging.uneven * (0.5 + 0.7 * across + 0.3 * down)
    grey = 255.0 * imaging.exposure * light * image
    noise_sigma = np.sqrt(imaging.read**2 + imaging.shot * grey)
    standard_noise = rng.standard_normal(grey.shape, dtype=np.float32)
    grey += standard_noise * noise_sigma
    rounded = np.clip(np.round(grey), 0, 255)
    return rounded.astype(np.uint8)


def _reflectance(board: Board, lens: Lens, pose: np.ndarray, background: float, shape: BoardShape) -> np.ndarray:
    """Return the reflectance image (height, width) of one board pose, averaged over each pixel."""
    result = np.full(lens.size[::-1], background, dtype=np.float32)
    outline = shaped_points(board, shape, _outline(board))
    outline_camera = outline @ pose[:3, :3].T + pose[:3, 3]
    depth = outline_camera[:, 2]
    if np.any(depth < MIN_DEPTH):
        return result
    # window of the image that the paper fills
    pixel = lens.project(outline_camera)
    before = np.floor(pixel.min(axis=0)) - 2
    behind = np.ceil(pixel.max(axis=0)) + 3
    low = np.maximum(before, 0).astype(int)
    high = np.minimum(behind, lens.size).astype(int)
    if np.any(high <= low):
        return result
    # drawing of the board that is at least as fine as the sub-pixels
    focal = np.max(lens.values[:2])
    scale = SUB * float(focal / depth.min())
    steps = np.log(scale) / np.log(RESOLUTION_RATIO)
    level = int(np.ceil(steps))
    per_metre = RESOLUTION_RATIO**level
    sheet = _sheet_at(board, level)
    board_points = _on_sheet(board, lens, pose, shape, low, high)
    sheet_pixels = (board_points + PAPER) * per_metre - 0.5
    sheet_pixels = sheet_pixels.astype(np.float32)
    x = np.ascontiguousarray(sheet_pixels[:, :, 0])
    y = np.ascontiguousarray(sheet_pixels[:, :, 1])
    fine = cv2.remap(sheet, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=background)
    size = tuple((high - low).tolist())
    left, top = low
    right, bottom = high
    result[top:bottom, left:right] = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
    return result


@lru_cache(maxsize=4)
def _sheet_at(board: Board, level: int) -> np.ndarray:
    """Return the drawing of a board at ``RESOLUTION_RATIO**level`` pixels per metre."""
    return raster(board, RESOLUTION_RATIO**level, PAPER)


def _outline(board: Board) -> np.ndarray:
    """Return points (N, 3) [m] along the edge of the paper."""
    width, height = board.extent
    x = np.linspace(-PAPER, width + PAPER, 9)
    y = np.linspace(-PAPER, height + PAPER, 9)
    edge = []
    for along in x:
        edge += [(along, y[0]), (along, y[-1])]
    for side in (x[0], x[-1]):
        edge += [(side, along) for along in y]
    heights = np.zeros(len(edge))
    return np.column_stack([np.array(edge), heights])


def _on_sheet(
    board: Board, lens: Lens, pose: np.ndarray, shape: BoardShape, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Return the board points (h·SUB, w·SUB, 2) [m] seen by the sub-pixels of an image window."""
    # rays through nodes around the window
    first = low - NODES
    last = high + 2 * NODES
    columns = np.arange(first[0], last[0], NODES, dtype=float)
    rows = np.arange(first[1], last[1], NODES, dtype=float)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    direction = rays(lens, grid.reshape(-1, 2))
    ray = np.column_stack([direction, np.ones(len(direction))])
    # points at which the rays meet the sheet, by iteration if the sheet is bent
    turn = pose[:3, :3]
    position = pose[:3, 3]
    normal = pose[:3, 2]
    hit = np.zeros((len(ray), 2))
    iterations = 1
    if shape.bent:
        iterations = BENT_ITERATIONS
    for _ in range(iterations):
        flat = np.column_stack([hit, np.zeros(len(hit))])
        rise = shaped_points(board, shape, flat)[:, 2]
        distance = normal @ position + rise
        depth = distance / (ray @ normal)
        from_origin = ray * depth[:, None] - position
        on_board = from_origin @ turn
        hit = on_board[:, :2] / shape.scale
    # single precision is 1e-4 px
    nodes = hit.reshape(grid.shape).astype(np.float32)
    width, height = high - low
    down = _cubic(height, len(rows))
    across = _cubic(width, len(columns))
    x = down @ nodes[:, :, 0] @ across.T
    y = down @ nodes[:, :, 1] @ across.T
    return np.stack([x, y], axis=-1)


def _cubic(count: int, columns: int) -> np.ndarray:
    """Return the matrix that interpolates from nodes to the sub-pixels of `count` pixels (Catmull & Rom 1974)."""
    # position of each sub-pixel [px], counted from the first node
    sub_pixels = np.arange(count * SUB) + 0.5
    position = sub_pixels / SUB - 0.5 + NODES
    first, t = np.divmod(position / NODES, 1.0)
    node = first.astype(int)
    row = np.arange(len(position))
    result = np.zeros((len(position), columns), dtype=np.float32)
    before = -t * (1 - t) ** 2
    at_node = 2 - 5 * t**2 + 3 * t**3
    after = t * (1 + 4 * t - 3 * t**2)
    second_after = -(t**2) * (1 - t)
    result[row, node - 1] += 0.5 * before
    result[row, node] += 0.5 * at_node
    result[row, node + 1] += 0.5 * after
    result[row, node + 2] += 0.5 * second_after
    return result

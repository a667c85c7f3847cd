"""Lens models from points to pixels: pinhole with Brown–Conrady distortion, and fisheye; with exact derivatives.

A point (X, Y, Z) [m] in the camera's frame (x right, y down, z forward) has a = X/Z, b = Y/Z, r² = a² + b²:

    pinhole   s = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)   (Brown 1971; OpenCV's rational model)
              x = a s + 2 p1 a b + p2 (r² + 2 a²),  y = b s + p1 (r² + 2 b²) + 2 p2 a b
    fisheye   θ = atan r,  x = a θ(1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) / r   (Kannala & Brandt 2006; OpenCV's)
    pixel     u = fx x + cx,  v = fy y + cy; the centre of the first pixel is (0, 0)

A lens is written as ROS ``camera_info`` YAML (camera_calibration_parsers), and read from more files
(`calib.data.images.lens_files`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import CalibError
from calib.records import frozen

# Names of a lens's values, by model.
NAMES = {
    "pinhole": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
# Numbers of values that a lens of a model may have.
COUNTS = {"pinhole": (9, 12), "fisheye": (8,)}
# Largest number of Newton steps from a pixel to its ray; few are needed.
ITERATIONS = 20
# Largest depth below which a point counts as behind the camera [m].
MIN_DEPTH = 1e-6
# Name of a lens's file in a folder of images.
LENS = "camera.yaml"


@dataclass(frozen=True, eq=False)
class Lens:
    """Intrinsics of one camera.

    Attributes:
        model: ``pinhole`` or ``fisheye``.
        values: fx fy cx cy [px] and the distortion coefficients, in the order of `NAMES`; 9 or 12 values for a pinhole.
        size: width and height of the camera's images [px].
    """

    model: str
    values: np.ndarray
    size: tuple[int, int]

    def __post_init__(self) -> None:
        values = frozen(self.values)
        if self.model not in NAMES or len(values) not in COUNTS[self.model]:
            raise CalibError(f"no camera model '{self.model}' with {len(values)} values; known: pinhole, fisheye")
        if not np.isfinite(values).all() or min(values[:2]) <= 0.0:
            raise CalibError(
                f"camera: focal lengths {values[0]:g}, {values[1]:g} px are impossible: they must be above 0"
            )
        object.__setattr__(self, "values", values)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the intrinsic parameters."""
        return NAMES[self.model][: len(self.values)]

    def with_values(self, values: np.ndarray) -> Lens:
        """Return the lens with other parameter values."""
        return replace(self, values=values)

    def in_sight(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Return whether points (N, 3) [m] project into the image, at least `margin` [px] from its edge: (N,) bool.

        A point beyond the angle at which the distortion polynomial ceases to increase is never in sight, even if its
        pixel lies in the image.
        """
        ahead = points[:, 2] > MIN_DEPTH
        safe = np.where(ahead[:, None], points, [0.0, 0.0, 1.0])
        pixel = self.project(safe)
        largest = np.array(self.size) - 1 - margin
        in_image = np.all((pixel >= margin) & (pixel <= largest), axis=1)
        # The ray of the pixel must pass through the point.
        centre = self.values[2:4]
        image_pixel = np.where(in_image[:, None], pixel, centre)
        ray = rays(self, image_pixel)
        plane = safe[:, :2] / safe[:, 2:]
        error = np.abs(ray - plane).max(axis=1)
        size = np.abs(plane).max(axis=1)
        return ahead & in_image & (error < 1e-6 * (1.0 + size))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return pixels (N, 2) of points (N, 3) [m] in the camera's frame."""
        return self.project_with_slopes(points)[0]

    def project_with_slopes(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return pixels (N, 2), ∂pixel/∂point (N, 2, 3) [px/m] and ∂pixel/∂values (N, 2, k) for points (N, 3) [m]."""
        depth = points[:, 2]
        focal = self.values[:2]
        centre = self.values[2:4]
        plane = points[:, :2] / depth[:, None]
        bent, across, by_value = BEND[self.model](plane, self.values[4:])
        count = len(points)
        by_depth = -np.einsum("nij,nj->ni", across, plane)
        by_point = np.empty((count, 2, 3))
        by_point[:, :, :2] = across / depth[:, None, None]
        by_point[:, :, 2] = by_depth / depth[:, None]
        by_lens = np.zeros((count, 2, len(self.values)))
        by_lens[:, 0, 0] = bent[:, 0]
        by_lens[:, 1, 1] = bent[:, 1]
        by_lens[:, 0, 2] = 1.0
        by_lens[:, 1, 3] = 1.0
        by_lens[:, :, 4:] = by_value * focal[:, None]
        pixel = bent * focal + centre
        return pixel, by_point * focal[:, None], by_lens


def _brown_conrady(plane: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the coordinates distorted by a pinhole lens, and their Jacobians.

    Args:
        plane: (N, 2) coordinates a, b of the module's formulas.
        k: (K,) distortion coefficients.

    Returns:
        Distorted coordinates x, y (N, 2), their Jacobians with respect to `plane` (N, 2, 2) and to k (N, 2, K).
    """
    a = plane[:, 0]
    b = plane[:, 1]
    square = a * a + b * b
    k1, k2, p1, p2, k3 = k[:5]
    k4 = k5 = k6 = 0.0
    if len(k) > 5:
        k4, k5, k6 = k[5:]
    above = 1.0 + square * (k1 + square * (k2 + square * k3))
    below = 1.0 + square * (k4 + square * (k5 + square * k6))
    scale = above / below
    tangent_x = 2 * p1 * a * b + p2 * (square + 2 * a * a)
    tangent_y = p1 * (square + 2 * b * b) + 2 * p2 * a * b
    tangential = np.stack([tangent_x, tangent_y], axis=1)
    bent = plane * scale[:, None] + tangential

    # derivative of the scale by the square of the radius
    above_slope = k1 + square * (2 * k2 + 3 * k3 * square)
    below_slope = k4 + square * (2 * k5 + 3 * k6 * square)
    steep = above_slope / below
    steep -= scale * below_slope / below
    across = np.empty((len(plane), 2, 2))
    across[:, 0, 0] = scale + 2 * a * a * steep + 2 * p1 * b + 6 * p2 * a
    across[:, 1, 1] = scale + 2 * b * b * steep + 6 * p1 * b + 2 * p2 * a
    mixed = 2 * a * b * steep + 2 * p1 * a + 2 * p2 * b
    across[:, 0, 1] = mixed
    across[:, 1, 0] = mixed

    by_value = np.empty((len(plane), 2, len(k)))
    for index, power in ((0, 1), (1, 2), (4, 3)):
        by_coefficient = square**power / below
        by_value[:, :, index] = plane * by_coefficient[:, None]
    for index, power in zip(range(5, len(k)), (1, 2, 3)):
        by_coefficient = -scale * square**power / below
        by_value[:, :, index] = plane * by_coefficient[:, None]
    by_value[:, 0, 2] = 2 * a * b
    by_value[:, 1, 2] = square + 2 * b * b
    by_value[:, 0, 3] = square + 2 * a * a
    by_value[:, 1, 3] = 2 * a * b
    return bent, across, by_value


def _fisheye(plane: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distorted coordinates and Jacobians of a fisheye lens, in the form of `_brown_conrady`."""
    radius = np.linalg.norm(plane, axis=1)
    r = np.maximum(radius, 1e-12)
    angle = np.arctan(r)
    powers = angle[:, None] ** np.array([2, 4, 6, 8])
    length = angle * (1.0 + powers @ k)
    scale = length / r
    bent = plane * scale[:, None]
    # derivative of the length by r
    power_slopes = powers * np.array([3, 5, 7, 9])
    by_angle = 1.0 + power_slopes @ k
    steep = by_angle / (1.0 + r * r)
    unit = plane / r[:, None]
    excess = (steep - scale)[:, None, None]
    along = excess * unit[:, :, None] * unit[:, None, :]
    across = scale[:, None, None] * np.eye(2) + along
    length_by_value = angle[:, None] * powers
    by_value = unit[:, :, None] * length_by_value[:, None, :]
    return bent, across, by_value


BEND = {"pinhole": _brown_conrady, "fisheye": _fisheye}


def rays(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """Return the ray direction (X/Z, Y/Z) (N, 2) of each pixel (N, 2), by Newton's method; NaN without a solution."""
    distorted = (pixels - lens.values[2:4]) / lens.values[:2]
    plane = distorted.copy()
    if lens.model == "fisheye":
        length = np.linalg.norm(distorted, axis=1)
        angle = np.clip(length, 0.0, 1.5)
        start = np.tan(angle) / np.maximum(length, 1e-12)
        plane = distorted * start[:, None]
    for _ in range(ITERATIONS):
        bent, across, _ = BEND[lens.model](plane, lens.values[4:])
        error = bent - distorted
        error_x, error_y = error.T
        (xx, xy), (yx, yy) = np.moveaxis(across, 0, -1)
        determinant = xx * yy - xy * yx
        determinant = np.where(np.abs(determinant) < 1e-9, np.nan, determinant)
        step_x = yy * error_x - xy * error_y
        step_y = xx * error_y - yx * error_x
        step = np.stack([step_x, step_y], axis=1)
        plane = plane - step / determinant[:, None]
        if np.nanmax(np.abs(error), initial=0.0) < 1e-12:
            break
    return plane


def write_lens(lens: Lens, path: str | Path, name: str = "camera") -> Path:
    """Write a lens as ``camera_info`` YAML."""
    fx, fy, cx, cy = lens.values[:4].tolist()
    coefficients = lens.values[4:].tolist()
    model = "rational_polynomial"
    if lens.model == "fisheye":
        model = "equidistant"
    elif len(lens.values) == 9:
        model = "plumb_bob"
    camera = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    projection = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    identity = np.eye(3).ravel().tolist()
    lines = [
        f"image_width: {lens.size[0]}",
        f"image_height: {lens.size[1]}",
        f"camera_name: {name}",
        _matrix("camera_matrix", 3, 3, camera),
        f"distortion_model: {model}",
        _matrix("distortion_coefficients", 1, len(coefficients), coefficients),
        _matrix("rectification_matrix", 3, 3, identity),
        _matrix("projection_matrix", 3, 4, projection),
    ]
    return files.write(path, "\n".join(lines) + "\n")


def _matrix(name: str, rows: int, columns: int, data: list[float]) -> str:
    """Return a matrix as an entry of ``camera_info`` YAML; `data`: its values row by row."""
    numbers = ", ".join(repr(value) for value in data)
    return f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: [{numbers}]"

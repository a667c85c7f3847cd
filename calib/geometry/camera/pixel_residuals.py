"""Residuals of images of a rigid board: corner by corner, with one pose per image.

    r = y - π(P c + p),   ∂π/∂x = ∂π/∂point · (ω × R c + v) + ∂π/∂lens + ∂π/∂point · R ∂c/∂shape

with (R, p) the board in the camera's frame. All corners of an image share the six numbers [v; ω]: a QR of its own
2K x (6 + k + 1) matrix leaves 6 + k + 1 rows of the least-squares problem, the same problem (Golub & Van Loan 2013,
sec. 5.3), so that thousands of images take the memory of thousands of poses.

Noise of images: of each corner alone, and of all corners of an image together.

    r_i = J_i M_i ξ_i + ε_i,   ε ~ N(0, f² σ²),   ξ ~ N(0, diag(s_v², s_v², s_v², s_ω², s_ω², s_ω²))

ξ is what the arm does not repeat and the model does not explain: a displacement and a turn of what the arm carries,
common to all corners of the image (M_i takes them to the board's twist). Were it left out, forty-eight corners would
count as forty-eight measurements of the arm. Both variances are estimated: f from what remains in each image after its
own best pose (2K - 6 numbers), s_v and s_ω by moments of those best poses' residuals beyond what ε explains
(variance components; Rao 1972).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from calib.data.images.board import corners
from calib.data.images.optics import shape_slopes
from calib.data.images.pixels import Pixels
from calib.data.poses import IN_HAND
from calib.errors import refuse_data
from calib.estimation import robust
from calib.geometry.installation import Seen
from calib.geometry.residuals import ResidualPart, parts
from calib.records import Frozen

# change of a noise that repeats no fit, as a share, and of its [m, rad] (our choice)
MAX_NOISE_CHANGE, MIN_NOISE = 0.05, 2e-6


@dataclass(frozen=True, eq=False)
class ImageNoise(Frozen):
    """Noise estimates of one block of images.

    Attributes:
        factor: of the corners' stated sigmas.
        displacement: s_v [m].
        turn: s_ω [rad].
        weight: (m,) robust weight of each image.
        shared: (N, 2, 6) what one standard deviation of each component of ξ does to the corners [px] at a state that
            the fit began at, so that a fit has one metric; None: of the state at hand.
    """

    factor: float = 1.0
    displacement: float = 0.0
    turn: float = 0.0
    weight: np.ndarray = field(default_factory=lambda: np.ones(0))
    shared: np.ndarray | None = None

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations (6,) of ξ."""
        return np.repeat([self.displacement, self.turn], 3)

    def unweighted(self, images: int) -> ImageNoise:
        """Return this noise for another number of images, with all weights equal to 1."""
        return replace(self, weight=np.ones(images), shared=None)

    def near(self, noise: ImageNoise) -> bool:
        """Return whether two noise estimates agree, so that the fit is not repeated."""
        pairs = ((self.factor, noise.factor), (self.displacement, noise.displacement), (self.turn, noise.turn))
        alike = all(abs(a - b) <= MAX_NOISE_CHANGE * max(a, b) + MIN_NOISE for a, b in pairs)
        return alike and np.abs(self.weight - noise.weight).max(initial=0.0) < 0.05


@dataclass(frozen=True, eq=False)
class OwnPoses:
    """Results of fitting a free pose to each of k images.

    Attributes:
        residual: (k, 6) of what the arm carries: best pose minus predicted [v; ω].
        information: (k, 6, 6) of it, at the stated sigmas.
        within: (k,) squared residual that the own pose leaves, in sigmas.
        spare: (k,) numbers that are left for it, 2K - 6.
    """

    residual: np.ndarray
    information: np.ndarray
    within: np.ndarray
    spare: np.ndarray


def estimate_noise(fits: OwnPoses, unknowns: int, loss: str = "none", scale: float | None = None) -> ImageNoise:
    """Return the noise of the images, estimated from the residuals of a fit.

    Args:
        fits: of a free pose to each image.
        unknowns: parameters fitted to them.
        loss, scale: of a robust fit, for the images' weights.
    """
    k = len(fits.spare)
    share = max(1.0 - unknowns / max(6 * k, 1), 0.2)
    use = fits.spare > 0
    factor = 1.0
    if use.any():
        variances = fits.within[use] / fits.spare[use]
        robustly = loss != "none"
        factor = float(np.sqrt(np.median(variances) if robustly else fits.within[use].sum() / fits.spare[use].sum()))
    factor = max(factor, 1e-3)
    covariance = factor**2 * np.linalg.pinv(fits.information, hermitian=True)
    variances_of_poses = np.einsum("kii->ki", covariance)
    square = fits.residual**2
    max_ratio = 25.0  # squared residuals beyond so many times their median are taken for it (our choice)
    square = np.minimum(square, max_ratio * np.median(square, axis=0)) / share
    spread = [_component(square[:, axes], variances_of_poses[:, axes]) for axes in (slice(0, 3), slice(3, 6))]
    total = covariance + np.diag(np.repeat(np.square(spread), 3))
    size = np.sqrt(np.einsum("ki,ki->k", fits.residual, np.linalg.solve(total, fits.residual[:, :, None])[:, :, 0]) / 6)
    return ImageNoise(factor, *spread, weight=robust.weights(size, loss, scale))


def _component(square: np.ndarray, explained: np.ndarray, max_steps: int = 20) -> float:
    """Return the standard deviation s with E[t²] = s² + known, by maximum likelihood: Σ (t² - s² - c)/(s² + c)² = 0."""
    value = max(float(np.mean(square - explained)), 1e-3 * float(np.median(square)))
    for _ in range(max_steps):
        weight = 1.0 / (value + explained) ** 2
        value = max(float(np.sum(weight * (square - explained)) / np.sum(weight)), 0.0)
        if value == 0.0:
            break
    return float(np.sqrt(value))


FIRST_NOISE = 1e-4  # displacement [m] and turn [rad] of an image that a fit begins with (our choice)
STEEPEST = {"pinhole": 2.0, "fisheye": 10.0}  # tangent of the angle off the axis beyond which a corner is taken at it


@dataclass(frozen=True, eq=False)
class PixelPart(ResidualPart):
    """Residuals of corners, ordered by image; ``jacobian`` is the Jacobian of each image's board pose.

    Attributes:
        value, sigma: (2, N) [px].
        jacobian: (f, 6 + k, m) of the board's twist [v; ω] in the camera's axes, and of lens and board.
        index: (N,) image of each corner.
        local: (N, 2, 6 + k) derivative of the corner by those.
        corner: (N,) its number in the board's table.
        depth: (N,) pixels per metre there, across the line of sight.
        axes: (m, 3, 3) a displacement of what the arm carries, in the station's axes, per one of the board in the
            camera's.
        carried: (m, 6, 6) the board's twist per twist [v; ω] of what the arm carries, both in the camera's axes.
        noise: an `ImageNoise`; None for that of the scale alone.
    """

    local: np.ndarray
    corner: np.ndarray
    depth: np.ndarray
    axes: np.ndarray
    carried: np.ndarray
    noise: ImageNoise | None = field(default=None, kw_only=True)

    @property
    def height(self) -> int:
        return len(np.unique(self.index)) * (self.local.shape[2] + 1)

    @property
    def per_length(self) -> np.ndarray | float:
        return self.depth

    def sizes(self) -> np.ndarray:
        square = np.sum((self.value / self.depth) ** 2, axis=0)
        count = np.bincount(self.index)
        return np.sqrt(np.bincount(self.index, square)[count > 0] / count[count > 0])

    def per_row(self) -> ResidualPart:
        images, image, count = np.unique(self.index, return_inverse=True, return_counts=True)
        mean = np.array([np.bincount(image, axis / self.depth) / count for axis in self.value])
        flat = np.vstack([mean, np.zeros(len(images))])  # along the line of sight a mean offset says nothing
        return ResidualPart(
            "position", np.einsum("mij,jm->im", self.axes[images], flat), self.jacobian[:, :0], None, 0, images
        )

    def row_weights(self, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        images, image, count = np.unique(self.index, return_inverse=True, return_counts=True)
        mean = np.bincount(image, weight) / count
        return images, mean if self.noise is None else mean * self.noise.weight[images]

    def fill(self, residual: np.ndarray, matrix: np.ndarray, scale: np.ndarray) -> None:
        scale = np.broadcast_to(scale, self.value.shape)
        images, first = np.unique(self.index, return_index=True)
        edges = np.append(first, len(self.index))
        width = self.local.shape[2] + 1
        shared = None
        if self.noise is not None:
            shared = self._shared_errors(self.noise) if self.noise.shared is None else self.noise.shared
        chunk = 500  # images reduced at once
        for start in range(0, len(images), chunk):
            chunk_images = slice(start, min(start + chunk, len(images)))
            rows, counts = (
                slice(edges[chunk_images.start], edges[chunk_images.stop]),
                np.diff(edges[chunk_images.start : chunk_images.stop + 1]),
            )
            unit = scale.T[rows, :, None]
            table = np.concatenate([self.local[rows], self.value.T[rows, :, None]], axis=2) / unit
            padded = _padded(table, counts)
            if shared is not None and self.noise is not None:
                padded = _whitened(padded, _padded(shared[rows] / unit, counts, padded.shape[1]))
                padded = padded * np.sqrt(self.noise.weight[images[chunk_images]])[:, None, None]
            small = np.asarray(np.linalg.qr(padded, mode="r"))
            reduced_rows = slice(chunk_images.start * width, chunk_images.stop * width)
            residual[reduced_rows] = small[:, :, -1].ravel()
            by_image = self.jacobian[:, :, images[chunk_images]].transpose(2, 1, 0)
            matrix[:, reduced_rows] = (small[:, :, :-1] @ by_image).reshape(-1, len(self.jacobian)).T

    def _shared_errors(self, noise: ImageNoise) -> np.ndarray:
        return np.einsum("ncl,nlk->nck", self.local[:, :, :6], self.carried[self.index]) * noise.deviations

    def own_poses(self, scale: np.ndarray) -> OwnPoses:
        """Return the fit of a free pose to each image, with corner σ `scale` (2, N) [px]."""
        images, first = np.unique(self.index, return_index=True)
        counts = np.diff(np.append(first, len(self.index)))
        table = np.concatenate([self.local[:, :, :6], self.value.T[:, :, None]], axis=2) / scale.T[:, :, None]
        small = np.asarray(np.linalg.qr(_padded(table, counts), mode="r"))
        system = small[:, :6, :6] @ self.carried[images]
        information = system.transpose(0, 2, 1) @ system
        gradient = np.einsum("kji,kj->ki", system, small[:, :6, 6])
        residual = np.einsum("kij,kj->ki", np.linalg.pinv(information, hermitian=True), gradient)
        return OwnPoses(residual, information, small[:, 6, 6] ** 2, np.maximum(2 * counts - 6, 0))

    def common_noise(self, sigma: np.ndarray, unknowns: int, loss: str, scale: float | None, start: bool) -> ImageNoise:
        noise = estimate_noise(self.own_poses(sigma), unknowns, loss, scale)
        if start:
            noise = replace(noise, displacement=FIRST_NOISE, turn=FIRST_NOISE)
        weight = np.ones(self.jacobian.shape[2])
        weight[np.unique(self.index)] = noise.weight
        return replace(noise, weight=weight, shared=self._shared_errors(noise))

    def alone(self, sigma: np.ndarray) -> np.ndarray:
        """Return the residuals (2, N) [px] of all corners after a free pose is fitted to each image."""
        images, image = np.unique(self.index, return_inverse=True)
        fits = self.own_poses(sigma)
        twists = np.einsum("kij,kj->ki", self.carried[images], fits.residual)
        return self.value - np.einsum("ncl,nl->cn", self.local[:, :, :6], twists[image])


def _padded(table: np.ndarray, counts: np.ndarray, height: int = 0) -> np.ndarray:
    """Return corner rows (N, 2, w) as one block per image (images, height, w), filled up with zeros."""
    width = table.shape[2]
    max_corners = height // 2 or max(int(counts.max(initial=0)), (width + 1) // 2)
    padded = np.zeros((len(counts), max_corners, 2, width))
    image = np.repeat(np.arange(len(counts)), counts)
    padded[image, np.arange(len(table)) - np.repeat(np.cumsum(counts) - counts, counts)] = table
    return padded.reshape(len(counts), 2 * max_corners, width)


def _whitened(rows: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Return (I + G Gᵀ)^(-1/2) A for A (images, h, w) and G (images, h, 6), by the eigenvectors of Gᵀ G."""
    values, vectors = np.linalg.eigh(shared.transpose(0, 2, 1) @ shared)
    values = np.maximum(values, 0.0)
    axes = shared @ vectors
    # U (1 - 1/sqrt(1 + s²)) Uᵀ with U = G V / s
    factor = (1.0 - 1.0 / np.sqrt(1.0 + values)) / np.maximum(values, 1e-300)
    return rows - axes @ (factor[:, :, None] * (axes.transpose(0, 2, 1) @ rows))


@parts.register
def _pixels(measured: Pixels, seen: Seen, jacobian: np.ndarray) -> list[ResidualPart]:
    """Return the corner residuals r = y - π(point) of a block of images, with their Jacobians."""
    if seen.view is None:
        refuse_data(measured.file, "the camera of these images is unknown")
    view, in_hand = seen.view, measured.mounting == IN_HAND
    image, corner = np.nonzero(measured.seen)
    points, bend = shape_slopes(measured.board, view.shape, corners(measured.board))
    turn = np.moveaxis(seen.rotation, 0, -1).transpose(1, 0, 2)  # (m, 3, 3), columns are the target's axes
    origin = seen.point.T
    if in_hand:  # the target is the camera, in the board's frame
        turn = turn.transpose(0, 2, 1)
        origin = -np.einsum("mij,mj->mi", turn, origin)
    turned = np.einsum("nij,nj->ni", turn[image], points[corner])
    point = turned + origin[image]
    aside = np.maximum(np.linalg.norm(point[:, :2], axis=1), 1e-3)
    point[:, 2] = np.maximum(point[:, 2], aside / STEEPEST[view.lens.model])  # of a wild guess, behind the camera
    pixel, by_point, by_lens = view.lens.project_with_slopes(point)
    local = np.empty((len(image), 2, 6 + len(view.in_view)))
    local[:, :, :3] = by_point
    local[:, :, 3:6] = np.cross(turned[:, None, :], by_point)  # g · (ω × c) = (c × g) · ω
    if len(view.in_view):
        by_shape = by_point @ np.einsum("nij,njs->nis", turn[image], bend[corner])
        local[:, :, 6:] = np.concatenate([by_lens, by_shape], axis=2)[:, :, view.in_view]
    shared = np.zeros((len(jacobian), 6 + len(view.in_view), len(measured)))
    shared[:, :6] = _twist_of_board(jacobian, turn, origin) if in_hand else jacobian
    shared[view.in_free, 6 + np.arange(len(view.in_view))] = 1.0
    value = (measured.pixel[image, corner] - pixel).T
    sigma = None if measured.sigma is None else np.broadcast_to(measured.sigma[image, corner], value.shape)
    depth = np.sqrt(np.abs(np.prod(view.lens.values[:2]))) / point[:, 2]
    carried = np.tile(np.eye(6), (len(measured), 1, 1))
    if in_hand:  # ω × (o - c): the camera turns about itself, and the board's origin swings
        carried[:, :3, 3:] = np.cross(origin[:, None], np.eye(3))
    axes = -turn.transpose(0, 2, 1) if in_hand else np.tile(np.eye(3), (len(measured), 1, 1))
    return [PixelPart("pixel", value, shared, sigma, 0, image, local, corner, depth, axes, carried)]


def _twist_of_board(jacobian: np.ndarray, turn: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the board's twist [v; ω] in the camera's axes (f, 6, m), from the camera's twist in the board's axes.

    With the board at (R, o) in the camera's frame, ω' = -R ω and o' = -R v + ω' × o.

    Args:
        jacobian: (f, 6, m) of the camera, in the board's axes.
        turn: (m, 3, 3) R.
        origin: (m, 3) o [m].
    """
    omega = -np.einsum("mij,fjm->fim", turn, jacobian[:, 3:])
    velocity = -np.einsum("mij,fjm->fim", turn, jacobian[:, :3])
    return np.concatenate([velocity + np.cross(omega, origin.T[None], axis=1), omega], axis=1)

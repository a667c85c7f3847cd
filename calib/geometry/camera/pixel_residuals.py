"""Residuals of images of a rigid board: corner by corner, with one pose per image.

    r = y - π(P c + p),   ∂π/∂x = ∂π/∂point · (ω × R c + v) + ∂π/∂lens + ∂π/∂point · R ∂c/∂shape

with (R, p) the board in the camera's frame. All corners of an image share the six numbers [v; ω]: a QR of its own
2K x (6 + k + 1) matrix leaves 6 + k + 1 rows of the least-squares problem, the same problem (Golub & Van Loan 2013,
sec. 5.3), so that thousands of images take the memory of thousands of poses.

Noise of images has two parts: that of each corner alone, and that common to all corners of an image.

    r_i = J_i M_i ξ_i + ε_i,   ε ~ N(0, f² σ²),   ξ ~ N(0, diag(s_v², s_v², s_v², s_ω², s_ω², s_ω²))

ξ is the part of a pose that the arm does not repeat or the model does not explain: a displacement and a rotation of
what the arm carries, common to all corners of the image (M_i takes them to the board's twist). Without this common
part, forty-eight corners would count as forty-eight measurements of the arm. Both variances are estimated: f from what
remains in each image after its own best pose (2K - 6 numbers), s_v and s_ω by moments of those best poses' residuals
beyond what ε explains (variance components; Rao 1972).
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
# change of an image's weight that repeats no fit
MAX_WEIGHT_CHANGE = 0.05
# squared residuals beyond so many times their median are taken for it (our choice)
MAX_RATIO = 25.0
# of the search for a variance component
MAX_STEPS = 20
# displacement [m] and turn [rad] of an image that a fit begins with (our choice)
FIRST_NOISE = 1e-4
# tangent of the angle off the axis beyond which a corner is taken at it
STEEPEST = {"pinhole": 2.0, "fisheye": 10.0}
# images reduced at once
CHUNK = 500


@dataclass(frozen=True, eq=False)
class ImageNoise(Frozen):
    """Noise estimates of one block of images.

    Attributes:
        factor: f, the factor on the corners' stated sigmas.
        displacement: s_v, standard deviation of the displacement common to an image [m].
        turn: s_ω, standard deviation of the rotation common to an image [rad].
        weight: (m,) robust weight of each image.
        shared: (N, 2, 6) displacement of the corners [px] by one standard deviation of each component of ξ, evaluated
            where the fit began, so that a whole fit has one metric; None to evaluate it at the present state.
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
        for a, b in pairs:
            if abs(a - b) > MAX_NOISE_CHANGE * max(a, b) + MIN_NOISE:
                return False
        weight_change = np.abs(self.weight - noise.weight).max(initial=0.0)
        return bool(weight_change < MAX_WEIGHT_CHANGE)


@dataclass(frozen=True, eq=False)
class OwnPoses:
    """Results of fitting a free pose to each of k images.

    Attributes:
        residual: (k, 6) best minus predicted pose of what the arm carries, as [v; ω].
        information: (k, 6, 6) information matrix (inverse covariance) of `residual`, at the stated sigmas.
        within: (k,) sum of squared residuals of the image's corners after the free pose, in sigmas.
        spare: (k,) degrees of freedom of `within`, 2K - 6 for K corners.
    """

    residual: np.ndarray
    information: np.ndarray
    within: np.ndarray
    spare: np.ndarray


def estimate_noise(fits: OwnPoses, unknowns: int, loss: str = "none", scale: float | None = None) -> ImageNoise:
    """Return the noise of the images, estimated from the residuals of a fit.

    Args:
        fits: fits of a free pose to each image.
        unknowns: number of parameters fitted to the images.
        loss, scale: the robust loss and its constant, from which the images' weights follow.
    """
    k = len(fits.spare)
    share = max(1.0 - unknowns / max(6 * k, 1), 0.2)
    # of the corners alone
    factor = 1.0
    determined = fits.spare > 0
    if determined.any():
        within, spare = fits.within[determined], fits.spare[determined]
        variance = within.sum() / spare.sum()
        if loss != "none":
            variance = np.median(within / spare)
        factor = float(np.sqrt(variance))
    factor = max(factor, 1e-3)

    # of the images
    covariance = factor**2 * np.linalg.pinv(fits.information, hermitian=True)
    explained = np.einsum("kii->ki", covariance)
    square = fits.residual**2
    square = np.minimum(square, MAX_RATIO * np.median(square, axis=0)) / share
    displacement = _component(square[:, :3], explained[:, :3])
    turn = _component(square[:, 3:], explained[:, 3:])
    variances = np.repeat(np.square([displacement, turn]), 3)
    total = covariance + np.diag(variances)
    weighted = np.linalg.solve(total, fits.residual[:, :, None])[:, :, 0]
    size = np.sqrt(np.einsum("ki,ki->k", fits.residual, weighted) / 6)
    return ImageNoise(factor, displacement, turn, weight=robust.weights(size, loss, scale))


def _component(square: np.ndarray, explained: np.ndarray) -> float:
    """Return the standard deviation s with E[t²] = s² + c, by maximum likelihood: Σ (t² - s² - c)/(s² + c)² = 0.

    Args:
        square: t², the square of each residual.
        explained: c, the known part of each residual's variance.
    """
    excess = square - explained
    value = max(float(np.mean(excess)), 1e-3 * float(np.median(square)))
    for _ in range(MAX_STEPS):
        weight = 1.0 / (value + explained) ** 2
        value = max(float(np.sum(weight * excess) / np.sum(weight)), 0.0)
        if value == 0.0:
            break
    return float(np.sqrt(value))


@dataclass(frozen=True, eq=False)
class PixelPart(ResidualPart):
    """Residuals of corners, ordered by image; ``jacobian`` is the Jacobian of each image's board pose.

    Attributes:
        value, sigma: (2, N) [px].
        jacobian: (f, 6 + k, m) derivatives, by f parameters, of the board's twist [v; ω] in the camera's axes and of
            the k values of lens and board.
        index: (N,) number of the image of each corner.
        local: (N, 2, 6 + k) derivative of the corner by the rows of `jacobian` [px per unit].
        corner: (N,) number of each corner in the board's table.
        depth: (N,) pixels per metre at the corner's distance, across the line of sight.
        axes: (m, 3, 3) displacement of what the arm carries (camera or board), in the station's axes, per displacement
            of the board in the camera's axes.
        carried: (m, 6, 6) the board's twist per twist [v; ω] of what the arm carries, both in the camera's axes.
        noise: noise common to the corners of an image; None if corners have their own noise (`scale`) only.
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
        sums = np.bincount(self.index, square)
        in_image = count > 0
        return np.sqrt(sums[in_image] / count[in_image])

    def per_row(self) -> ResidualPart:
        images, image, count = np.unique(self.index, return_inverse=True, return_counts=True)
        lengths_x, lengths_y = self.value / self.depth
        mean_x = np.bincount(image, lengths_x) / count
        mean_y = np.bincount(image, lengths_y) / count
        # along the line of sight a mean offset says nothing
        mean = np.vstack([mean_x, mean_y, np.zeros(len(images))])
        displacement = np.einsum("mij,jm->im", self.axes[images], mean)
        return ResidualPart("position", displacement, self.jacobian[:, :0], None, 0, images)

    def row_weights(self, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        images, image, count = np.unique(self.index, return_inverse=True, return_counts=True)
        mean = np.bincount(image, weight) / count
        if self.noise is None:
            return images, mean
        return images, mean * self.noise.weight[images]

    def fill(self, residual: np.ndarray, matrix: np.ndarray, scale: np.ndarray) -> None:
        scale = np.broadcast_to(scale, self.value.shape)
        images, first = np.unique(self.index, return_index=True)
        edges = np.append(first, len(self.index))
        width = self.local.shape[2] + 1
        shared = None
        if self.noise is not None:
            shared = self.noise.shared
            if shared is None:
                shared = self._shared_errors(self.noise)
        for start in range(0, len(images), CHUNK):
            stop = min(start + CHUNK, len(images))
            chunk = images[start:stop]
            rows = slice(edges[start], edges[stop])
            counts = np.diff(edges[start : stop + 1])
            unit = scale.T[rows, :, None]
            columns = [self.local[rows], self.value.T[rows, :, None]]
            padded = _padded(np.concatenate(columns, axis=2) / unit, counts)
            if shared is not None and self.noise is not None:
                padded = _whitened(padded, _padded(shared[rows] / unit, counts, padded.shape[1]))
                padded = padded * np.sqrt(self.noise.weight[chunk])[:, None, None]
            triangle = np.asarray(np.linalg.qr(padded, mode="r"))
            reduced_rows = slice(start * width, stop * width)
            residual[reduced_rows] = triangle[:, :, -1].ravel()
            by_image = self.jacobian[:, :, chunk].transpose(2, 1, 0)
            reduced = triangle[:, :, :-1] @ by_image
            matrix[:, reduced_rows] = reduced.reshape(-1, len(self.jacobian)).T

    def _shared_errors(self, noise: ImageNoise) -> np.ndarray:
        by_twist = self.local[:, :, :6]
        return np.einsum("ncl,nlk->nck", by_twist, self.carried[self.index]) * noise.deviations

    def own_poses(self, scale: np.ndarray) -> OwnPoses:
        """Return the results of fitting a free pose to each image, for corners with standard deviations `scale` (2, N)
        [px].
        """
        images, first = np.unique(self.index, return_index=True)
        counts = np.diff(np.append(first, len(self.index)))
        columns = [self.local[:, :, :6], self.value.T[:, :, None]]
        table = np.concatenate(columns, axis=2) / scale.T[:, :, None]
        triangle = np.asarray(np.linalg.qr(_padded(table, counts), mode="r"))
        system = triangle[:, :6, :6] @ self.carried[images]
        information = system.transpose(0, 2, 1) @ system
        gradient = np.einsum("kji,kj->ki", system, triangle[:, :6, 6])
        inverse = np.linalg.pinv(information, hermitian=True)
        residual = np.einsum("kij,kj->ki", inverse, gradient)
        spare = np.maximum(2 * counts - 6, 0)
        return OwnPoses(residual, information, triangle[:, 6, 6] ** 2, spare)

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
        by_twist = self.local[:, :, :6]
        return self.value - np.einsum("ncl,nl->cn", by_twist, twists[image])


def _padded(table: np.ndarray, counts: np.ndarray, height: int = 0) -> np.ndarray:
    """Return corner rows (N, 2, w) as one block per image (images, height, w), padded with zeros.

    Args:
        table: (N, 2, w) rows, ordered by image.
        counts: (images,) corners per image.
        height: height of a block, twice the corners it has space for; 0 for the image with the most corners.
    """
    width = table.shape[2]
    max_corners = height // 2
    if not max_corners:
        max_corners = max(int(counts.max(initial=0)), (width + 1) // 2)
    image = np.repeat(np.arange(len(counts)), counts)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    padded = np.zeros((len(counts), max_corners, 2, width))
    padded[image, np.arange(len(table)) - first] = table
    return padded.reshape(len(counts), 2 * max_corners, width)


def _whitened(rows: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Return (I + G Gᵀ)^(-1/2) A for A (images, h, w) and G (images, h, 6), by the eigenvectors of Gᵀ G."""
    values, vectors = np.linalg.eigh(shared.transpose(0, 2, 1) @ shared)
    values = np.maximum(values, 0.0)
    axes = shared @ vectors
    # U (1 - 1/sqrt(1 + s²)) Uᵀ with U = G V / s
    factor = (1.0 - 1.0 / np.sqrt(1.0 + values)) / np.maximum(values, 1e-300)
    along = axes.transpose(0, 2, 1) @ rows
    return rows - axes @ (factor[:, :, None] * along)


@parts.register
def _pixels(measured: Pixels, seen: Seen, jacobian: np.ndarray) -> list[ResidualPart]:
    """Return the corner residuals r = y - π(point) of a block of images, with their Jacobians."""
    view = seen.view
    if view is None:
        refuse_data(measured.file, "the camera of these images is unknown: give its lens (camera.yaml)")
    in_hand = measured.mounting == IN_HAND
    count = len(measured)
    lens_count = len(view.in_view)
    image, corner = np.nonzero(measured.seen)

    # the board in the camera's frame: (m, 3, 3) and (m, 3); columns are the target's axes
    turn = np.moveaxis(seen.rotation, 0, -1).transpose(1, 0, 2)
    origin = seen.point.T
    if in_hand:
        # the target is the camera, in the board's frame
        turn = turn.transpose(0, 2, 1)
        origin = -np.einsum("mij,mj->mi", turn, origin)
    points, bend = shape_slopes(measured.board, view.shape, corners(measured.board))
    turned = np.einsum("nij,nj->ni", turn[image], points[corner])
    point = turned + origin[image]
    # of a wild guess, behind the camera
    aside = np.maximum(np.linalg.norm(point[:, :2], axis=1), 1e-3)
    point[:, 2] = np.maximum(point[:, 2], aside / STEEPEST[view.lens.model])

    pixel, by_point, by_lens = view.lens.project_with_slopes(point)
    local = np.empty((len(image), 2, 6 + lens_count))
    local[:, :, :3] = by_point
    # g · (ω × c) = (c × g) · ω
    local[:, :, 3:6] = np.cross(turned[:, None, :], by_point)
    if lens_count:
        turned_bend = np.einsum("nij,njs->nis", turn[image], bend[corner])
        by_shape = by_point @ turned_bend
        by_optics = np.concatenate([by_lens, by_shape], axis=2)
        local[:, :, 6:] = by_optics[:, :, view.in_view]

    shared = np.zeros((len(jacobian), 6 + lens_count, count))
    shared[:, :6] = _twist_of_board(jacobian, turn, origin) if in_hand else jacobian
    shared[view.in_free, 6 + np.arange(lens_count)] = 1.0
    value = (measured.pixel[image, corner] - pixel).T
    sigma = None
    if measured.sigma is not None:
        sigma = np.broadcast_to(measured.sigma[image, corner], value.shape)
    focal = np.sqrt(np.abs(np.prod(view.lens.values[:2])))
    depth = focal / point[:, 2]
    carried = np.tile(np.eye(6), (count, 1, 1))
    axes = np.tile(np.eye(3), (count, 1, 1))
    if in_hand:
        # ω × (o - c): the camera turns about itself, and the board's origin swings
        carried[:, :3, 3:] = np.cross(origin[:, None], np.eye(3))
        axes = -turn.transpose(0, 2, 1)
    return [PixelPart("pixel", value, shared, sigma, 0, image, local, corner, depth, axes, carried)]


def _twist_of_board(jacobian: np.ndarray, turn: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the board's twist [v; ω] in the camera's axes (f, 6, m), from the camera's twist in the board's axes.

    With the board at (R, o) in the camera's frame, ω' = -R ω and o' = -R v + ω' × o.

    Args:
        jacobian: (f, 6, m) twist of the camera in the board's axes, per unit of f parameters.
        turn: (m, 3, 3) rotation R.
        origin: (m, 3) translation o [m].
    """
    omega = -np.einsum("mij,fjm->fim", turn, jacobian[:, 3:])
    velocity = -np.einsum("mij,fjm->fim", turn, jacobian[:, :3])
    swing = np.cross(omega, origin.T[None], axis=1)
    return np.concatenate([velocity + swing, omega], axis=1)

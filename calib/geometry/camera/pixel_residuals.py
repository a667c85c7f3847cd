"""Residuals of images of a rigid board: corner by corner, with one pose per image.

    r = y - π(P c + p),   ∂π/∂x = ∂π/∂point · (ω × R c + v) + ∂π/∂lens + ∂π/∂point · R ∂c/∂shape

with (R, p) the board in the camera's frame. All corners of an image share the six numbers [v; ω]. A QR factorisation
therefore reduces the 2K rows of an image of K corners to 6 + k + 1 rows of the same least-squares problem (Golub & Van
Loan 2013, sec. 5.3; k: number of lens and board values), so that an image takes no more memory than a measured pose.

The noise of images has two parts: ε is independent from corner to corner, ξ is common to all corners of an image.

    r_i = J_i M_i ξ_i + ε_i,   ε ~ N(0, f² σ²),   ξ ~ N(0, diag(s_v², s_v², s_v², s_ω², s_ω², s_ω²))

ξ is the part of a pose that the arm does not repeat or the model does not explain: a displacement and a rotation of
the device on the arm (camera or board); M_i maps them to the board's twist. Without ξ, forty-eight corners would count
as forty-eight measurements of the arm. Both parts are estimated: f from the corners' residuals after a free pose is
fitted to each image (2K - 6 degrees of freedom), s_v and s_ω from the differences between free and predicted poses, by
the part of their squares that ε does not explain (variance components; Rao 1972).
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

# Relative and absolute [m, rad] change of a noise estimate up to which the fit is not repeated (our choice).
MAX_NOISE_CHANGE = 0.05
MIN_NOISE = 2e-6
# Change of an image's weight up to which the fit is not repeated.
MAX_WEIGHT_CHANGE = 0.05
# Squared residuals above this multiple of their median are clipped to it (our choice).
MAX_RATIO = 25.0
# Smallest factor f: residuals of simulated images may be exactly zero.
MIN_FACTOR = 1e-3
# Smallest share of degrees of freedom: with few images, the fit's parameters would take all of them.
MIN_SPARE_SHARE = 0.2
# Number of iterations of the search for a variance component.
MAX_STEPS = 20
# Displacement [m] and rotation [rad] common to an image with which a fit begins (our choice).
FIRST_NOISE = 1e-4
# Tangent of the largest angle off the optical axis at which a corner is projected.
STEEPEST = {"pinhole": 2.0, "fisheye": 10.0}
# Number of images that are reduced together; bounds the memory.
CHUNK = 500


def _no_weights() -> np.ndarray:
    return np.ones(0)


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
    weight: np.ndarray = field(default_factory=_no_weights)
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
        before = np.array([self.factor, self.displacement, self.turn])
        after = np.array([noise.factor, noise.displacement, noise.turn])
        largest = np.maximum(before, after)
        change = np.abs(before - after)
        if np.any(change > MAX_NOISE_CHANGE * largest + MIN_NOISE):
            return False
        weight_change = np.abs(self.weight - noise.weight)
        return bool(weight_change.max(initial=0.0) < MAX_WEIGHT_CHANGE)


@dataclass(frozen=True, eq=False)
class FreePoses:
    """Results of fitting a free pose to each of k images: the pose that the image's corners alone determine.

    Attributes:
        residual: (k, 6) free minus predicted pose of the device on the arm (camera or board), as [v; ω] [m, rad].
        information: (k, 6, 6) information matrix (inverse covariance) of `residual`, at the stated sigmas.
        within: (k,) sum of squared residuals of the image's corners at the free pose, in units of their sigmas.
        spare: (k,) degrees of freedom of `within`, 2K - 6 for K corners.
    """

    residual: np.ndarray
    information: np.ndarray
    within: np.ndarray
    spare: np.ndarray


def estimate_noise(
    fits: FreePoses, unknowns: int, loss: str | robust.Loss = "none", scale: float | None = None
) -> ImageNoise:
    """Return the noise of the images, estimated from the residuals of a fit.

    Args:
        fits: fits of a free pose to each image.
        unknowns: number of parameters fitted to the images.
        loss, scale: name of the robust loss, and its constant (None: the default), for the images' weights.
    """
    coordinates = max(6 * len(fits.spare), 1)
    spare_share = max(1.0 - unknowns / coordinates, MIN_SPARE_SHARE)

    # noise of the corners
    factor = 1.0
    determined = fits.spare > 0
    if determined.any():
        within = fits.within[determined]
        spare = fits.spare[determined]
        variance = within.sum() / spare.sum()
        if loss != "none":
            variance = np.median(within / spare)
        factor = float(np.sqrt(variance))
    factor = max(factor, MIN_FACTOR)

    # noise common to the corners of an image
    cofactors = np.linalg.pinv(fits.information, hermitian=True)
    covariance = factor**2 * cofactors
    explained = np.einsum("kii->ki", covariance)
    square = fits.residual**2
    largest = MAX_RATIO * np.median(square, axis=0)
    square = np.minimum(square, largest) / spare_share
    displacement = _component(square[:, :3], explained[:, :3])
    turn = _component(square[:, 3:], explained[:, 3:])

    # weights by the Mahalanobis distance of each image
    deviations = np.repeat([displacement, turn], 3)
    total = covariance + np.diag(np.square(deviations))
    column = fits.residual[:, :, None]
    weighted = np.linalg.solve(total, column)[:, :, 0]
    squared_distance = np.einsum("ki,ki->k", fits.residual, weighted)
    weight = robust.weights(np.sqrt(squared_distance / 6), loss, scale)
    return ImageNoise(factor, displacement, turn, weight)


def _component(square: np.ndarray, explained: np.ndarray) -> float:
    """Return the standard deviation s with E[t²] = s² + c, by maximum likelihood: Σ (t² - s² - c)/(s² + c)² = 0.

    Args:
        square: t², the square of each residual.
        explained: c, the known part of each residual's variance.
    """
    excess = square - explained
    smallest = 1e-3 * float(np.median(square))
    value = max(float(np.mean(excess)), smallest)
    for _ in range(MAX_STEPS):
        weight = 1.0 / (value + explained) ** 2
        mean = np.sum(weight * excess) / np.sum(weight)
        value = max(float(mean), 0.0)
        if value == 0.0:
            break
    return float(np.sqrt(value))


@dataclass(frozen=True, eq=False)
class PixelPart(ResidualPart):
    """Residuals of N corners, ordered by image; their Jacobian is the product of `local` and `jacobian`.

    Attributes:
        value, sigma: (2, N) residuals and their standard deviations [px].
        jacobian: (f, 6 + k, m) derivatives, by f parameters, of the board's twist [v; ω] in the camera's axes and of
            the k values of lens and board.
        index: (N,) number of the image of each corner.
        local: (N, 2, 6 + k) derivatives of each corner's pixel by the 6 + k rows of `jacobian` [px per unit].
        corner: (N,) number of each corner in the board's table.
        depth: (N,) pixels per metre at the corner's distance, across the line of sight.
        axes: (m, 3, 3) matrices that map a displacement of the board in the camera's axes to the displacement of the
            device on the arm (camera or board) in the station's axes.
        carried: (m, 6, 6) matrices that map a twist [v; ω] of the device on the arm to the board's twist, both in the
            camera's axes.
        noise: noise common to the corners of an image; None if the corners' noise is independent.
    """

    local: np.ndarray
    corner: np.ndarray
    depth: np.ndarray
    axes: np.ndarray
    carried: np.ndarray
    noise: ImageNoise | None = field(default=None, kw_only=True)

    @property
    def height(self) -> int:
        rows_per_image = self.local.shape[2] + 1
        return len(np.unique(self.index)) * rows_per_image

    @property
    def per_length(self) -> np.ndarray | float:
        return self.depth

    def sizes(self) -> np.ndarray:
        lengths = self.value / self.depth
        square = np.sum(lengths**2, axis=0)
        count = np.bincount(self.index)
        sums = np.bincount(self.index, square)
        in_image = count > 0
        return np.sqrt(sums[in_image] / count[in_image])

    def per_row(self) -> ResidualPart:
        images, image, count = np.unique(self.index, return_inverse=True, return_counts=True)
        lengths_x, lengths_y = self.value / self.depth
        mean_x = np.bincount(image, lengths_x) / count
        mean_y = np.bincount(image, lengths_y) / count
        # a mean offset of the corners does not determine the displacement along the line of sight
        mean_z = np.zeros(len(images))
        mean = np.vstack([mean_x, mean_y, mean_z])
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
            value = self.value.T[rows, :, None]
            table = np.concatenate([self.local[rows], value], axis=2)
            padded = _padded(table / unit, counts)
            if shared is not None and self.noise is not None:
                common = _padded(shared[rows] / unit, counts, padded.shape[1])
                padded = _whitened(padded, common)
                root_weight = np.sqrt(self.noise.weight[chunk])
                padded = padded * root_weight[:, None, None]
            triangle = np.asarray(np.linalg.qr(padded, mode="r"))
            reduced_rows = slice(start * width, stop * width)
            residual[reduced_rows] = triangle[:, :, -1].ravel()
            jacobian = self.jacobian[:, :, chunk]
            by_image = jacobian.transpose(2, 1, 0)
            reduced = triangle[:, :, :-1] @ by_image
            flat = reduced.reshape(-1, len(self.jacobian))
            matrix[:, reduced_rows] = flat.T

    def _shared_errors(self, noise: ImageNoise) -> np.ndarray:
        by_twist = self.local[:, :, :6]
        carried = self.carried[self.index]
        by_carried = np.einsum("ncl,nlk->nck", by_twist, carried)
        return by_carried * noise.deviations

    def free_poses(self, scale: np.ndarray) -> FreePoses:
        """Return the results of fitting a free pose to each image.

        Args:
            scale: (2, N) standard deviations of the corners [px].
        """
        images, first = np.unique(self.index, return_index=True)
        edges = np.append(first, len(self.index))
        counts = np.diff(edges)
        by_twist = self.local[:, :, :6]
        value = self.value.T[:, :, None]
        table = np.concatenate([by_twist, value], axis=2)
        padded = _padded(table / scale.T[:, :, None], counts)
        triangle = np.asarray(np.linalg.qr(padded, mode="r"))
        # columns of the triangle: six of the board's twist, then the residual
        right = triangle[:, :6, 6]
        remainder = triangle[:, 6, 6]
        system = triangle[:, :6, :6] @ self.carried[images]
        information = system.transpose(0, 2, 1) @ system
        gradient = np.einsum("kji,kj->ki", system, right)
        inverse = np.linalg.pinv(information, hermitian=True)
        residual = np.einsum("kij,kj->ki", inverse, gradient)
        spare = np.maximum(2 * counts - 6, 0)
        return FreePoses(residual, information, remainder**2, spare)

    def common_noise(
        self, sigma: np.ndarray, unknowns: int, loss: str | robust.Loss, scale: float | None, start: bool
    ) -> ImageNoise:
        fits = self.free_poses(sigma)
        noise = estimate_noise(fits, unknowns, loss, scale)
        if start:
            noise = replace(noise, displacement=FIRST_NOISE, turn=FIRST_NOISE)
        weight = np.ones(self.jacobian.shape[2])
        weight[np.unique(self.index)] = noise.weight
        return replace(noise, weight=weight, shared=self._shared_errors(noise))

    def alone(self, sigma: np.ndarray) -> np.ndarray:
        """Return the residuals (2, N) [px] of all corners after a free pose is fitted to each image."""
        images, image = np.unique(self.index, return_inverse=True)
        fits = self.free_poses(sigma)
        carried = self.carried[images]
        twists = np.einsum("kij,kj->ki", carried, fits.residual)
        by_twist = self.local[:, :, :6]
        return self.value - np.einsum("ncl,nl->cn", by_twist, twists[image])


def _padded(table: np.ndarray, counts: np.ndarray, height: int = 0) -> np.ndarray:
    """Return the rows of all corners as a block per image, (images, height, w), filled up with zero rows.

    Args:
        table: (N, 2, w) two rows per corner, ordered by image.
        counts: (images,) number of corners of each image.
        height: number of rows of a block; 0: as many as the image with the most corners needs.
    """
    width = table.shape[2]
    max_corners = height // 2
    if not max_corners:
        most = int(counts.max(initial=0))
        max_corners = max(most, (width + 1) // 2)
    image = np.repeat(np.arange(len(counts)), counts)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    padded = np.zeros((len(counts), max_corners, 2, width))
    padded[image, np.arange(len(table)) - first] = table
    return padded.reshape(len(counts), 2 * max_corners, width)


def _whitened(rows: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Return (I + G Gᵀ)^(-1/2) A for A (images, h, w) and G (images, h, 6), by the eigenvectors of Gᵀ G."""
    gram = shared.transpose(0, 2, 1) @ shared
    values, vectors = np.linalg.eigh(gram)
    values = np.maximum(values, 0.0)
    axes = shared @ vectors
    # U (1 - 1/sqrt(1 + s²)) Uᵀ with U = G V / s
    reduction = 1.0 - 1.0 / np.sqrt(1.0 + values)
    factor = reduction / np.maximum(values, 1e-300)
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
    axes_last = np.moveaxis(seen.rotation, 0, -1)
    turn = axes_last.transpose(1, 0, 2)
    origin = seen.point.T
    if in_hand:
        # the target is the camera, in the board's frame
        turn = turn.transpose(0, 2, 1)
        origin = -np.einsum("mij,mj->mi", turn, origin)
    nominal = corners(measured.board)
    points, bend = shape_slopes(measured.board, view.shape, nominal)
    turned = np.einsum("nij,nj->ni", turn[image], points[corner])
    point = turned + origin[image]
    # A poor first guess may put corners beside or behind the camera, where no lens model applies.
    off_axis = np.linalg.norm(point[:, :2], axis=1)
    min_depth = np.maximum(off_axis, 1e-3) / STEEPEST[view.lens.model]
    point[:, 2] = np.maximum(point[:, 2], min_depth)

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
    board_twist = jacobian
    if in_hand:
        board_twist = _twist_of_board(jacobian, turn, origin)
    shared[:, :6] = board_twist
    shared[view.in_free, 6 + np.arange(lens_count)] = 1.0
    value = (measured.pixel[image, corner] - pixel).T
    sigma = None
    if measured.sigma is not None:
        sigma = np.broadcast_to(measured.sigma[image, corner], value.shape)
    focal_product = np.prod(view.lens.values[:2])
    focal = np.sqrt(np.abs(focal_product))
    depth = focal / point[:, 2]
    carried = np.tile(np.eye(6), (count, 1, 1))
    axes = np.tile(np.eye(3), (count, 1, 1))
    if in_hand:
        # ω × (o - c): when the camera turns about its centre c, the board's origin o moves in its frame
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

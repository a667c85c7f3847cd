"""Residuals and Jacobians of the geometry for each kind of measurement.

Each function takes the predicted targets and returns residual parts; a part is r = measured - predicted with the
derivative ∂predicted/∂x. Unknown socket points, planes and bar centres are nuisance parameters in which the residuals
are linear (or nearly so). They are set to their best value in closed form, and their columns are projected out
(variable projection, Golub & Pereyra 1973; for planes and bars by the Jacobian of Kaufman 1975, whose gradient is
exact).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import singledispatch
from typing import Protocol, Self

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.poses.measurements import Bars, Distances, Planes, PoseMeasurements, Poses, Positions, Sockets
from calib.errors import refuse_data
from calib.estimation.robust import Loss
from calib.geometry.installation import Seen

# largest number of Gauss–Newton steps for the centre of a bar, and length of a step that ends them [m]
CENTRE_STEPS = 20
MIN_CHANGE = 1e-13
# ridge of a centre's normal equations over their trace (our choice): along directions of less the centre hardly moves
RIDGE = 1e-12


class CommonNoise(Protocol):
    """Errors that several rows share, such as those of all corners of an image.

    `calib.geometry.camera.pixel_residuals.ImageNoise` implements this interface.
    """

    @property
    def factor(self) -> float:
        """Factor by which the stated sigmas are multiplied."""
        ...

    def near(self, noise: Self) -> bool:
        """Return whether two noise estimates agree, so that the fit need not be repeated.

        Args:
            noise: noise estimated in another pass.
        """
        ...

    def unweighted(self, images: int) -> Self:
        """Return this noise for another number of images, with all weights equal to 1."""
        ...


@dataclass(frozen=True, eq=False)
class ResidualPart:
    """Residuals of one kind with their Jacobian, all in one unit.

    Attributes:
        label: ``position``, ``orientation``, ``consistency``, ``distance``, ``plane`` or ``pixel``.
        value: (rows, m) [m] or [rad].
        jacobian: (f, rows, m) derivative of the prediction by the f fitted parameters.
        sigma: (rows, m) stated standard deviations; None if they are to be estimated.
        nuisances: number of nuisance parameters that were eliminated.
        index: (m,) number of the measured row of each column.
        noise: errors that rows share, used by `fill` for whitening and estimated by `common_noise`; None for no shared
            errors.
    """

    label: str
    value: np.ndarray
    jacobian: np.ndarray
    sigma: np.ndarray | None
    nuisances: int
    index: np.ndarray
    _: KW_ONLY
    noise: CommonNoise | None = None

    @property
    def height(self) -> int:
        """Number of rows in the least-squares problem."""
        return self.value.size

    def fill(self, residual: np.ndarray, matrix: np.ndarray, scale: np.ndarray) -> None:
        """Write residuals to `residual` (height,) and the Jacobian to `matrix` (f, height), both divided by `scale`.

        Args:
            residual, matrix: arrays to write.
            scale: standard deviation of each residual, broadcast to the shape of `value`.
        """
        residual[:] = (self.value / scale).ravel()
        np.divide(self.jacobian, scale, out=matrix.reshape(self.jacobian.shape))

    def whitened(self, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals (height,) and the Jacobian W (height, f), both divided by `scale`."""
        residual = np.empty(self.height)
        matrix = np.empty((len(self.jacobian), self.height))
        self.fill(residual, matrix, scale)
        return residual, matrix.T

    @property
    def per_length(self) -> np.ndarray | float:
        """Numbers by which residuals are divided to convert them to metres.

        1 for residuals in metres; for pixels, the pixels per metre.
        """
        return 1.0

    def sizes(self) -> np.ndarray:
        """Return the norm of each measured row's residual [m or rad]."""
        return np.linalg.norm(self.value, axis=0)

    def row_weights(self, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers of the measured rows and the weight of each, from weights (m,) of the columns."""
        return self.index, weight

    def per_row(self) -> ResidualPart:
        """Return the part with one column per measured row, in m or rad."""
        return self

    def common_noise(
        self, sigma: np.ndarray, unknowns: int, loss: str | Loss, scale: float | None, start: bool
    ) -> CommonNoise | None:
        """Return the errors that rows share, estimated from the residuals; None for kinds without shared errors.

        Args:
            sigma: (rows, m) standard deviations of the residuals, in their unit.
            unknowns: number of parameters fitted to the residuals.
            loss, scale: robust loss of the fit, and its constant in sigmas (None: its default).
            start: True at the start of a fit, when the residuals do not yet show their common errors.
        """
        return None

    def alone(self, sigma: np.ndarray) -> np.ndarray:
        """Return the residuals (rows, m) without the errors that rows share.

        Args:
            sigma: (rows, m) standard deviations of the residuals, in their unit.
        """
        return self.value


def joined(pieces: Sequence[ResidualPart]) -> ResidualPart:
    """Return one residual part from consecutive pieces of a block; the rows of each piece are numbered from 0."""
    values, jacobians, sigmas, indices = [], [], [], []
    nuisances = 0
    start = 0
    for piece in pieces:
        values.append(piece.value)
        jacobians.append(piece.jacobian)
        if piece.sigma is not None:
            sigmas.append(piece.sigma)
        indices.append(piece.index + start)
        start += len(piece.index)
        nuisances += piece.nuisances
    return replace(
        pieces[0],
        value=np.concatenate(values, axis=1),
        jacobian=np.concatenate(jacobians, axis=2),
        sigma=np.concatenate(sigmas, axis=1) if sigmas else None,
        nuisances=nuisances,
        index=np.concatenate(indices),
    )


@singledispatch
def parts(measured: PoseMeasurements, seen: Seen, jacobian: np.ndarray) -> list[ResidualPart]:
    """Return the residual parts of a block, computed by the function registered for its type.

    Args:
        measured: the block, m rows.
        seen: the predicted targets.
        jacobian: (f, 6, m), velocity and angular velocity [v; ω] of the targets per unit of each fitted parameter.

    Raises:
        MeasurementError: no function is registered for the type.
    """
    refuse_data(measured.file, f"no residual is registered for measurements of kind '{measured.kind}'")


@parts.register
def _pose(measured: Poses, seen: Seen, jacobian: np.ndarray) -> list[ResidualPart]:
    """Return the residuals of poses: y - p of positions, log(R_y Rᵀ) of orientations.

    y, R_y are measured and p, R predicted. The derivative of the logarithm is d log = J_r⁻¹(r) ω
    (`inverse_right_jacobian`).

    Args:
        measured: the block, m rows.
        seen: the predicted targets.
        jacobian: (f, 6, m), [v; ω] of the targets per unit of each fitted parameter.
    """
    predicted = Rotation.from_matrix(seen.rotation.transpose(2, 1, 0))
    turn = (Rotation.from_quat(measured.quaternion) * predicted.inv()).as_rotvec().T
    angular = inverse_right_jacobian(turn, jacobian[:, 3:])
    sigma = None
    if measured.sigma_rotation is not None:
        sigma = measured.sigma_rotation.T
    orientation = ResidualPart("orientation", turn, angular, sigma, 0, np.arange(len(measured)))
    if measured.lever is not None:
        measured, seen, jacobian = _at_lever(measured, measured.lever, seen, jacobian)
    return [*_position(measured, seen, jacobian), orientation]


def _at_lever(measured: Poses, lever: np.ndarray, seen: Seen, jacobian: np.ndarray) -> tuple[Poses, Seen, np.ndarray]:
    """Return poses, predicted targets and their Jacobian (f, 6, m) for points of the target instead of its origin.

    Args:
        measured: the block, m rows.
        lever: (m, 3) points in the target's frame [m].
        seen: the predicted targets.
        jacobian: (f, 6, m), [v; ω] of the targets' origins per unit of each fitted parameter.
    """
    from_origin = np.einsum("edm,me->dm", seen.rotation, lever)
    turns = Rotation.from_quat(measured.quaternion).as_matrix()
    measured_from_origin = np.einsum("mde,me->md", turns, lever)
    velocity = jacobian[:, :3] + np.cross(jacobian[:, 3:], from_origin[None], axis=1)
    return (
        replace(measured, position=measured.position + measured_from_origin),
        replace(seen, point=seen.point + from_origin),
        np.concatenate([velocity, jacobian[:, 3:]], axis=1),
    )


@parts.register
def _position(measured: Positions, seen: Seen, jacobian: np.ndarray) -> list[ResidualPart]:
    """Return the residuals of positions, r = y - p (measured minus predicted), without errors that all rows share.

    Args:
        measured: the block, m rows.
        seen: the predicted targets.
        jacobian: (f, 6, m), [v; ω] of the targets per unit of each fitted parameter.
    """
    value = measured.position.T - seen.point
    linear = jacobian[:, :3]
    shared = 0
    if measured.late is not None and len(measured) > 1:
        shared = measured.late.shape[1]
        rows = np.concatenate([value[None], linear]).reshape(-1, value.size)
        nuisance = measured.late.transpose(2, 0, 1).reshape(value.size, shared)
        projected = _project(rows, nuisance).reshape(-1, *value.shape)
        value = projected[0]
        linear = projected[1:]
    sigma = None
    if measured.sigma is not None:
        sigma = measured.sigma.T
    return [ResidualPart("position", value, linear, sigma, shared, np.arange(len(measured)))]


@parts.register
def _distance(measured: Distances, seen: Seen, jacobian: np.ndarray) -> list[ResidualPart]:
    """Return the residuals of distances, r = L - |p_a - p_b|, for the two rows of each pair.

    Args:
        measured: the block of m rows, with the measured distances L.
        seen: the predicted targets, p_a and p_b in the two rows of a pair.
        jacobian: (f, 6, m), [v; ω] of the targets per unit of each fitted parameter.
    """
    first, second = _pairs(measured)
    gap = seen.point[:, first] - seen.point[:, second]
    length = np.linalg.norm(gap, axis=0)
    relative = jacobian[:, :3, first] - jacobian[:, :3, second]
    along = np.einsum("im,fim->fm", gap / length, relative)
    value = measured.distance[first] - length
    sigma = None
    if measured.sigma is not None:
        sigma = measured.sigma[first][None]
    return [ResidualPart("distance", value[None], along[:, None], sigma, 0, first)]


def _pairs(measured: Distances) -> tuple[np.ndarray, np.ndarray]:
    """Return the row indices of the first and second pose of each pair.

    Args:
        measured: distances, one per pair of rows.
    """
    order = np.argsort(measured.group, kind="stable")
    groups, counts = np.unique(measured.group, return_counts=True)
    wrong = np.flatnonzero(counts != 2)
    if len(wrong):
        pair = groups[wrong[0]]
        row = int(measured.rows[measured.group == pair][0])
        refuse_data(measured.file, f"pair {pair} has {counts[wrong[0]]} rows; a distance needs two", row=row)
    return order[0::2], order[1::2]


@parts.register
def _sockets(measured: Sockets, seen: Seen, jacobian: np.ndarray) -> list[ResidualPart]:
    """Return the residuals of sockets: group mean minus p, and L - |mean_a - mean_b| for known socket distances L.

    Args:
        measured: the block of m rows, with the socket of each.
        seen: the predicted targets p; mean is their mean over the rows at one socket.
        jacobian: (f, 6, m), [v; ω] of the targets per unit of each fitted parameter.
    """
    groups, group_of_row, counts = np.unique(measured.group, return_inverse=True, return_counts=True)
    rows = np.arange(len(measured))
    average = np.zeros((len(measured), len(groups)))
    average[rows, group_of_row] = 1.0 / counts[group_of_row]
    linear = jacobian[:, :3]
    means = seen.point @ average
    mean_jacobian = linear @ average
    value = means[:, group_of_row] - seen.point
    slope = linear - mean_jacobian[:, :, group_of_row]
    sigma = None
    if measured.sigma is not None:
        sigma = measured.sigma.T
    result = [ResidualPart("consistency", value, slope, sigma, 3 * len(groups), rows)]
    number = {int(group): k for k, group in enumerate(groups)}
    links = [link for link in measured.links if link[0] in number and link[1] in number]
    if links:
        first = np.array([number[link[0]] for link in links])
        second = np.array([number[link[1]] for link in links])
        gap = means[:, first] - means[:, second]
        length = np.linalg.norm(gap, axis=0)
        relative = mean_jacobian[:, :, first] - mean_jacobian[:, :, second]
        along = np.einsum("il,fil->fl", gap / length, relative)
        value = np.array([link[2] for link in links]) - length
        first_rows = np.array([int(np.flatnonzero(group_of_row == k)[0]) for k in first])
        result.append(ResidualPart("distance", value[None], along[:, None], None, 0, first_rows))
    return result


@parts.register(Planes)
@parts.register(Bars)
def _fitted(measured: Planes | Bars, seen: Seen, jacobian: np.ndarray) -> list[ResidualPart]:
    """Return the residuals against a plane (normal n) or a ball bar's centre c, fitted to each group of rows.

    For planes r = -n · (p - mean); for bars r = L - |p - c|.

    Args:
        measured: the block of m rows, with the plane or the bar (of length L) of each.
        seen: the predicted targets p.
        jacobian: (f, 6, m), [v; ω] of the targets per unit of each fitted parameter.
    """
    value = np.zeros(len(measured))
    slope = np.zeros((len(jacobian), len(measured)))
    groups, counts = np.unique(measured.group, return_counts=True)
    # three points lie on a plane, and three lengths meet in a centre, anyway
    rows_of_groups = [np.flatnonzero(measured.group == group) for group in groups[counts > 3]]
    centres = np.zeros((0, 3))
    if isinstance(measured, Bars):
        points_of_groups = [seen.point[:, rows] for rows in rows_of_groups]
        centres = sphere_centres(points_of_groups, [measured.distance[rows] for rows in rows_of_groups])
    for number, rows in enumerate(rows_of_groups):
        points = seen.point[:, rows]
        if isinstance(measured, Planes):
            centred = points - points.mean(axis=1, keepdims=True)
            axes = np.linalg.svd(centred, full_matrices=False)[0]
            value[rows] = -axes[:, 2] @ centred
            direction = axes[:, 2:]
            nuisance = np.column_stack([np.ones(len(rows)), centred.T @ axes[:, :2]])
        else:
            from_centre = points - centres[number][:, None]
            length = np.linalg.norm(from_centre, axis=0)
            value[rows] = measured.distance[rows] - length
            direction = from_centre / length
            nuisance = direction.T
        along = np.einsum("im,fim->fm", np.broadcast_to(direction, points.shape), jacobian[:, :3, rows])
        slope[:, rows] = _project(along, nuisance)
    sigma = None
    if measured.sigma is not None:
        sigma = measured.sigma[None]
    # all numbers of a smaller group
    unknowns = int(np.minimum(counts, 3).sum())
    label = "plane" if isinstance(measured, Planes) else "distance"
    return [ResidualPart(label, value[None], slope[:, None], sigma, unknowns, np.arange(len(measured)))]


def sphere_centres(groups: Sequence[np.ndarray], lengths: Sequence[np.ndarray]) -> np.ndarray:
    """Return the centres (g, 3) whose distances to the points of each group fit its lengths best, by Gauss–Newton.

    The start value is the linear solution of |p|² - L² = 2 p·c - |c|² (algebraic sphere fit). All groups take their
    steps together; rows that fill a group up to the size of the largest are zero.

    Args:
        groups: points (3, m) of each of g groups.
        lengths: their distances (m,) from the centre.
    """
    size = max(map(len, lengths), default=0)
    points = np.zeros((3, len(groups), size))
    distance = np.zeros((len(groups), size))
    present = np.zeros((len(groups), size))
    for number, (group, length) in enumerate(zip(groups, lengths)):
        points[:, number, : len(length)] = group
        distance[number, : len(length)] = length
        present[number, : len(length)] = 1.0
    matrix = np.concatenate([2.0 * points, -present[None]]).swapaxes(0, 1)
    squares = np.einsum("igm,igm->gm", points, points) - distance**2
    centres = _least_squares(matrix, squares)[:, :3]
    for _ in range(CENTRE_STEPS):
        to_centre = centres.T[..., None] - points
        # a point in the centre has no direction
        length = np.sqrt(np.maximum(np.einsum("igm,igm->gm", to_centre, to_centre), 1e-300))
        directions = (to_centre * (present / length)).swapaxes(0, 1)
        change = _least_squares(directions, (distance - length) * present)
        centres = centres + change
        if np.abs(change).max(initial=0.0) < MIN_CHANGE:
            break
    return centres


def _least_squares(matrices: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the solutions (g, k) of g small least-squares problems, with hardly any change along undetermined axes.

    Args:
        matrices: (g, k, m) transposed matrices.
        values: (g, m) right-hand sides.
    """
    square = matrices @ matrices.swapaxes(1, 2)
    # of a group without any direction, as of lengths zero, the matrix is zero
    ridge = np.maximum(RIDGE * np.trace(square, axis1=1, axis2=2), np.finfo(float).tiny)
    square += ridge[:, None, None] * np.eye(square.shape[1])
    return np.linalg.solve(square, matrices @ values[..., None])[..., 0]


def _project(rows: np.ndarray, nuisance: np.ndarray) -> np.ndarray:
    """Return the part of `rows` (f, m) that is orthogonal to the nuisance columns (m, k)."""
    q, _ = np.linalg.qr(nuisance)
    return rows - (rows @ q) @ q.T


def inverse_right_jacobian(turn: np.ndarray, angular: np.ndarray) -> np.ndarray:
    """Return J_r⁻¹(r) ω for rotation vectors r (3, m) and angular velocities (f, 3, m).

    J_r⁻¹(r) = I + [r]×/2 + (1/θ² - (1 + cos θ)/(2 θ sin θ)) [r]×²  with θ = |r| (Chirikjian 2012, vol. 2, eq. 10.86).
    Since log(R_y (exp(ω) R)ᵀ) = log(exp(r) exp(-ω)), a rotation ω of the prediction changes the residual by -J_r⁻¹(r)
    ω.

    Args:
        turn: r (3, m), rotation vectors [rad].
        angular: ω (f, 3, m), angular velocities per unit of f parameters.
    """
    theta = np.linalg.norm(turn, axis=0)
    if theta.max(initial=0.0) < 1e-9:
        return angular
    small = theta < 1e-4
    safe = np.where(small, 1.0, theta)
    exact = 1.0 / safe**2 - (1.0 + np.cos(safe)) / (2.0 * safe * np.sin(safe))
    # the limit of the factor for small angles
    factor = np.where(small, 1.0 / 12.0, exact)
    by_row = angular.transpose(0, 2, 1)
    once = np.cross(turn.T[None], by_row)
    twice = np.cross(turn.T[None], once)
    return (by_row + 0.5 * once + factor[:, None] * twice).transpose(0, 2, 1)

"""Expected position error of a fitted arm at any pose, from its parameters' covariance and from the model's errors.

    E |e(q)|² = κ trace J Σ Jᵀ + s(q) v_0 + v_1 d(q)² + v_2 g(q)²

Σ is the parameters' covariance. d is the distance of q from the nearest fitted pose, and g the distance of q from the
fitted ranges of the single joints; joint differences are multiplied by the joint's lever [m/rad]. s is the factor by
which the error variance at q is larger than on average (`calib.geometry.left_out`). κ and v are the most probable
values given the errors on held-out rows. Near rows were held out at random; far rows were held out by region or
station, or at the ends of a joint's range. Near and far errors have equal weight.

The radius is the number of standard deviations that contains 95 % of the errors. It is a quantile of the errors on
held-out rows in units of sigma (`calib.geometry.left_out`), without an assumed distribution. It changes from the near
rows' quantile to the far rows' quantile as d² + g² increases from the median of the near rows to that of the far rows.
Outside the range of a joint the radius is larger, by the factor observed when that end of the range was held out.
Stated sigmas are scaled so that the larger of the two radii contains 95 % of the errors.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.blas import dtrsm  # type: ignore[attr-defined]
from scipy.spatial import KDTree

from calib.data.poses.measurements import PoseMeasurements, Positions, take
from calib.estimation.relevance import SETTLED, Gram, condensed, gram, relevance
from calib.geometry.fit import plausible_deviation
from calib.geometry.installation import Installation
from calib.geometry.left_out import LeftOut, Profile, unevenness
from calib.geometry.many_corrections import position_variances
from calib.geometry.model_choice.cross_validation import project_out, term_groups, term_sizes, with_terms
from calib.geometry.model_choice.folds import Folds, random_folds
from calib.geometry.model_choice.ladder import MAX_RESIDUAL, ModelSelection
from calib.geometry.observation import layout, observe, prepare
from calib.geometry.residuals import ResidualPart
from calib.geometry.static_torques.load_errors import DESCRIBED, load_masses, load_variance, unlearnt_share
from calib.geometry.weighing import GeometricFit
from calib.records import evenly
from calib.robot.calibrated import Deflection
from calib.robot.chain import Chain
from calib.robot.kinematics import forward

# share of the poses that is held out at each end of a joint's range (our choice)
END_SHARE = 0.2
# share of the fitted poses that define a joint's range near a pose (our choice)
NEAR_SHARE = 0.02
# smallest number of poses for an error model (our choice)
MIN_POSES = 20
# largest number of poses by which folds are evaluated (our choice)
MAX_POSES = 1500
# prior standard deviation of a parameter without prior, for folds that do not determine it [m, rad] (our choice)
PRIOR_SIGMA = 1.0
# smallest factor κ of the parameters' variance by which other variances are divided
SMALLEST_FACTOR = 1e-6
# number of poses and step [rad or m] by which a joint's lever is computed, and the smallest lever [m/rad or 1]
LEVER_POSES = 50
LEVER_STEP = 1e-4
MIN_LEVER = 0.05


@dataclass(frozen=True)
class Discrepancy:
    """Parameters of the error model, estimated on held-out rows.

    Attributes:
        parameters: κ, the factor of the variance due to the parameters.
        floor: v_0 [m²], error variance at the fitted poses for s = 1, with the instrument's noise.
        far: v_1 [m²/m²], error variance per squared distance from the nearest fitted pose.
        beyond: v_2 [m²/m²], error variance per squared distance from the fitted ranges of the joints.
        radii: number of sigmas that contained 95 % of the errors, for the near and for the far held-out rows.
        reach: median of d² + g² over the near rows, and over the far rows [m²].
        levers: (n,) motion of the tool per unit of each joint [m/rad or 1], rms over the poses.
        profile: log s as one function per joint; empty for s = 1 everywhere.
        placed: radii for rows on which base and tool placement are fitted; None if equal to `radii`.
        wider: factors by which the 95 % interval widens below and above each joint's range; empty if unknown.
        loads: masses that the arm carried in the fitted poses beyond its masses [kg]; empty if unknown.
        mass_doubt: standard deviation of the masses by which compliance was fitted, as a share of them.
        unlearnt: share of a load's usual deflection that the rows leave open, where no compliance by torques is fitted.
    """

    parameters: float
    floor: float
    far: float
    beyond: float
    radii: tuple[float, float]
    reach: tuple[float, float]
    levers: tuple[float, ...]
    profile: Profile = ()
    placed: tuple[float, float] | None = None
    wider: tuple[tuple[float, float], ...] = ()
    loads: tuple[float, ...] = ()
    mass_doubt: float = DESCRIBED
    unlearnt: float = 1.0

    @property
    def radius(self) -> float:
        """Half-width of the 95 % interval in standard deviations, the larger of the near and the far radius."""
        return max(self.radii)


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """Model of the expected tool position error of a fitted arm.

    Attributes:
        cell: the installation.
        free, covariance: indices of the fitted parameters in the full vector (`calib.geometry.observation`), and their
            covariance.
        learnt: (m, n) fitted poses [rad or m].
        discrepancy: parameters of the error model.
    """

    cell: Installation
    free: np.ndarray
    covariance: np.ndarray
    learnt: np.ndarray
    discrepancy: Discrepancy

    def position_sigma(self, rows: PoseMeasurements, station: int = 0, tool: np.ndarray | int = 0) -> np.ndarray:
        """Return the expected tool position error (m,) [m] at poses: the standard deviation, all axes together.

        Args:
            rows: joint values (m, n), and gravity torques if the model has compliance terms.
            station: index of the station of reference; -1 for the arm's base.
            tool: index of the tool, one or (m,).
        """
        variance = position_variances(self.cell, rows, self.free, self.covariance, station, tool)
        variance = variance + self._load_variance(rows)
        sigma, radius = self._sigma_and_radius(variance, rows.q, self.discrepancy.radii)
        return sigma * (radius * self._widening(rows.q)) / self.discrepancy.radius

    def sigma_on(self, cell: Installation, block: Positions, placed_anew: bool = False) -> np.ndarray:
        """Return the expected position error (m,) [m] at the poses of measured rows, as `position_sigma` does.

        Args:
            cell: the installation whose predictions are judged: that of the fit, or the same arm with new placements.
            block: the block of m rows.
            placed_anew: True where base and tool placement were fitted to these rows; errors that a placement can
                compensate are then excluded.
        """
        ready = prepare(cell, [block])[0]
        if not placed_anew:
            return self.position_sigma(block, ready.station, ready.tool)
        fit_layout = layout(self.cell)
        new_layout = layout(cell)
        kinds = np.array(fit_layout.kinds)[self.free]
        stays = ~np.isin(kinds, ("station", "tool"))
        shift = np.where(kinds[stays] == "arm", 0, len(new_layout.names) - len(fit_layout.names))
        frames = len(new_layout.frame_index)
        columns = np.concatenate([new_layout.frame_index, self.free[stays] + shift])
        jacobian = _position_part(observe(cell, ready, columns)).jacobian
        jacobian = project_out(jacobian, np.arange(frames))[frames:]
        values, vectors = np.linalg.eigh(self.covariance[np.ix_(stays, stays)])
        root = vectors * np.sqrt(np.clip(values, 0.0, None))
        count = len(root)
        spread = root.T @ jacobian.reshape(count, 3 * len(block))
        spread = spread.reshape(count, 3, len(block))
        variance = np.sum(spread**2, axis=(0, 1)) + self._load_variance(block)
        radii = self.discrepancy.placed
        if radii is not None:
            sigma, radius = self._sigma_and_radius(variance, block.q, radii)
            return sigma * radius / self.discrepancy.radius
        sigma, radius = self._sigma_and_radius(variance, block.q, self.discrepancy.radii)
        return sigma * (radius * self._widening(block.q)) / self.discrepancy.radius

    def _load_variance(self, rows: PoseMeasurements) -> np.ndarray | float:
        """Return the variance (m,) due to a load with which no pose was fitted, as a part of trace J Σ Jᵀ [m²].

        Args:
            rows: the poses.
        """
        model = self.discrepancy
        variance = load_variance(self.cell, rows, model.loads, model.mass_doubt, model.unlearnt)
        if variance is None:
            return 0.0
        return variance / max(model.parameters, SMALLEST_FACTOR)

    def _sigma_and_radius(
        self, parameter_variance: np.ndarray, q: np.ndarray, radii: tuple[float, float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the standard deviation (m,) [m] of each error, and the multiple of it (m,) that contains 95 % of
        errors.

        Args:
            parameter_variance: (m,) error variance [m²] due to the parameters, trace J Σ Jᵀ.
            q: (m, n) poses [rad or m].
            radii: the 95 % radii of near and far errors.
        """
        model = self.discrepancy
        from_poses, from_ranges = _distances(q, self.learnt, np.array(model.levers))
        model_variance = (
            unevenness(model.profile, q) * model.floor + model.far * from_poses + model.beyond * from_ranges
        )
        sigma = np.sqrt(model.parameters * parameter_variance + model_variance)
        return sigma, np.interp(from_poses + from_ranges, model.reach, radii)

    def _widening(self, q: np.ndarray) -> np.ndarray:
        """Return the factors (m,) by which the 95 % intervals widen outside the fitted joint ranges; 1 inside.

        Args:
            q: (m, n) joint values [rad or m].
        """
        result = np.ones(len(q))
        for joint, (below, above) in enumerate(self.discrepancy.wider):
            levels = [0.0, END_SHARE, 1.0 - END_SHARE, 1.0]
            low, first, last, high = np.quantile(self.learnt[:, joint], levels)
            position = q[:, joint]
            below_range = _widened(low - position, first - low, below)
            above_range = _widened(position - high, high - last, above)
            result = np.maximum(result, below_range)
            result = np.maximum(result, above_range)
        return result


def outside(q: np.ndarray, learnt: np.ndarray) -> np.ndarray:
    """Return a mask (m, n) of the joint values q (m, n) that are outside the range of the poses `learnt` (k, n)."""
    return np.asarray((q < learnt.min(axis=0)) | (q > learnt.max(axis=0)))


def _widened(distance: np.ndarray, width: float, factor: float) -> np.ndarray:
    """Return the widening (m,) at a distance (m,) beyond the end of a range.

    It rises linearly from 1 at the end to `factor` at half of `width` beyond, and then stays constant.

    Args:
        distance: (m,) distance beyond the end [rad or m].
        width: the range's width [rad or m].
        factor: widening at half of `width` beyond.
    """
    share = np.clip(2.0 * distance / max(width, 1e-9), 0.0, 1.0)
    return 1.0 + (factor - 1.0) * share


def _position_part(parts: Sequence[ResidualPart]) -> ResidualPart:
    return next(part for part in parts if part.label == "position")


def _variances(precision: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the diagonal (k,) of Jᵀ P⁻¹ J for columns J (p, k) and a precision matrix P with unit diagonal."""
    try:
        factor = np.linalg.cholesky(precision + 1e-12 * np.eye(len(precision)))
    except np.linalg.LinAlgError:
        # not positive by rounding; the eigenvalues take five times as long
        values, vectors = np.linalg.eigh(precision)
        spread = columns.T @ vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    else:
        # rows (L⁻¹ J)ᵀ, without copies
        spread = dtrsm(1.0, factor.T, columns.T, side=1)
    return np.einsum("kp,kp->k", spread, spread)


def _distances(q: np.ndarray, learnt: np.ndarray, levers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return squared distances (m,) [m²] of poses: from the nearest fitted pose, and from the joints' fitted ranges.

    For each joint, the second distance is the smallest one within which a share `NEAR_SHARE` of the fitted poses lie. A
    few poses far from the others therefore do not extend the fitted range.

    Args:
        q: (m, n) joint values [rad or m].
        learnt: (k, n) joint values of the fitted poses.
        levers: (n,) motion of the tool per unit of each joint [m/rad or 1], by which joint differences are multiplied.
    """
    nearest = KDTree(learnt * levers).query(q * levers)[0]
    count = len(learnt)
    neighbours = int(np.clip(round(NEAR_SHARE * count), 1, count))
    from_ranges = np.zeros(len(q))
    for joint, lever in enumerate(levers):
        values = np.sort(learnt[:, joint])
        position = q[:, joint]
        # all intervals that hold as many of the poses; before the middle their low end is the further one
        low = values[: count - neighbours + 1]
        high = values[neighbours - 1 :]
        middle = np.searchsorted(low + high, 2.0 * position)
        before = np.maximum(middle - 1, 0)
        after = np.minimum(middle, count - neighbours)
        distance_before = np.maximum(np.abs(low[before] - position), np.abs(high[before] - position))
        distance_after = np.maximum(np.abs(low[after] - position), np.abs(high[after] - position))
        from_ranges += (lever * np.minimum(distance_before, distance_after)) ** 2
    return np.asarray(nearest) ** 2, from_ranges


def _joint_levers(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the motion of the tip per unit of each joint (n,) [m/rad or 1], rms over poses.

    Args:
        chain: the arm.
        q: (m, n) joint values of the poses [rad or m].
    """
    poses = q[evenly(len(q), LEVER_POSES)]
    result = np.zeros(chain.n)
    for joint in range(chain.n):
        change = np.zeros(chain.n)
        change[joint] = LEVER_STEP
        ahead = forward(chain, poses + change)[:, :3, 3]
        behind = forward(chain, poses - change)[:, :3, 3]
        squares = np.sum((ahead - behind) ** 2, axis=1)
        result[joint] = np.sqrt(np.mean(squares)) / (2.0 * LEVER_STEP)
    return np.maximum(result, MIN_LEVER)


def learn_errors(
    selection: ModelSelection, measured: Sequence[PoseMeasurements], seed: int = 0, mass_doubt: float = DESCRIBED
) -> ErrorModel | None:
    """Return the error model, estimated from the errors on held-out rows; None where too few positions were measured.

    For every fold, the geometry and the ridges (prior standard deviations) of all chosen effects are estimated again,
    since ridges from all rows would depend on the held-out rows. With a robust loss, rows beyond `MAX_RESIDUAL` robust
    sigmas are ignored.

    Args:
        selection: the model and its fit of all rows.
        measured: the blocks to which it was fitted.
        seed: seed of the random folds.
        mass_doubt: standard deviation of the masses by which compliance was fitted, as a share of them.
    """
    fit = selection.fit
    poses = sum(len(block) for block in measured)
    if poses < MIN_POSES or not all(isinstance(block, Positions) for block in measured):
        return None
    q = np.concatenate([block.q for block in measured])
    levers = _joint_levers(fit.cell.chain, q)
    rows = _Rows(selection, measured)
    near_errors = list(rows.left_out(random_folds(measured, 5, seed), levers))
    far_errors = list(rows.left_out(selection.folds, levers))
    joints = [-1] * len(far_errors)
    for joint, folds in _range_folds(measured):
        of_ends = list(rows.left_out(folds, levers))
        far_errors += of_ends
        joints += [joint] * len(of_ends)
    samples, profile = LeftOut.of(near_errors, far_errors, joints).scaled(rows.poses)
    weights, radii = samples.learnt()
    near_reach = float(np.median(samples.away[samples.near]))
    far_reach = float(np.median(samples.away[~samples.near]))
    reach = near_reach, max(far_reach, near_reach * (1.0 + 1e-9) + 1e-12)
    # an interval holds 95 % of a fold whose poses took no part in it
    near_factor, far_factor = samples.surprise(weights, reach)
    wide_radii = radii[0] * near_factor, radii[1] * far_factor
    discrepancy = Discrepancy(
        *weights,
        radii=wide_radii,
        reach=reach,
        levers=tuple(levers.tolist()),
        profile=profile,
        placed=radii,
        wider=samples.wider(weights, wide_radii, reach, rows.poses),
        loads=load_masses(measured),
        mass_doubt=mass_doubt,
        unlearnt=unlearnt_share(fit, measured),
    )
    return ErrorModel(fit.cell, fit.free, fit.estimate.covariance, q, discrepancy)


def _range_folds(measured: Sequence[PoseMeasurements]) -> list[tuple[int, Folds]]:
    """Return, for each joint that moves, its index and two folds.

    The folds hold out the lower and the upper end of the joint's range.

    Args:
        measured: the blocks of measurements.
    """
    q = np.concatenate([block.q for block in measured])
    edges = np.cumsum([len(block) for block in measured])[:-1]
    result = []
    for joint in range(q.shape[1]):
        values = q[:, joint]
        low, high = np.quantile(values, [END_SHARE, 1.0 - END_SHARE])
        if high - low < 1e-6:
            continue
        fold = np.full(len(values), 2)
        fold[values > high] = 1
        fold[values < low] = 0
        result.append((joint, Folds("ranges", 2, tuple(np.split(fold, edges)))))
    return result


class _Rows:
    """Residuals and Jacobians of a fit's rows at the rigid geometry, from which folds are evaluated.

    Attributes:
        chosen: for each block, the numbers of the rows used to evaluate the folds.
        measured: for each block, the measurements of the chosen rows.
        pose: for each block, (m,) number of each row's pose.
        poses: (p, n) joint values of all poses.
        counts: for each block, (m,) mask of the rows that are not gross outliers.
        free: indices of the fit's parameters without its chosen corrections, then of all terms of the chosen effects.
        station: positions of the station placements in `free`.
        prior: standard deviations about the optimum, for parameters that a fold does not determine.
        coordinates: coordinates of the columns in which the statistics are expressed.
        whitened: for each block and residual part, residual and Jacobian.
        metric: for each block, residual and Jacobian of positions [m].
        total: statistics of all rows.
    """

    def __init__(self, selection: ModelSelection, measured: Sequence[PoseMeasurements]):
        fit = selection.fit
        terms = selection.offered
        self._choose(measured)
        self._number_poses()
        gross = set()
        if selection.loss != "none":
            gross = {(file, row) for file, row, *_ in fit.outliers(MAX_RESIDUAL)}
        self.counts = []
        for block in self.measured:
            good = [(block.file, int(row)) not in gross for row in block.rows]
            self.counts.append(np.array(good, bool))
        cell = fit.cell
        # compliance from other recordings, which is fitted with the geometry
        stated_count = len(selection.rigid.cell.deflection.terms)
        if terms:
            reference = selection.reference or selection.nominal.cell.chain
            stated = Deflection(cell.deflection.terms[:stated_count], cell.deflection.coefficients[:stated_count])
            cell = with_terms(replace(cell, deflection=stated), terms, reference)
        table = layout(cell)
        terms_index = table.index("deflection")[stated_count:]
        geometry = np.flatnonzero(~np.isin(fit.free, terms_index))
        self.free = np.concatenate([fit.free[geometry], terms_index])
        self.station = np.flatnonzero(np.isin(self.free, table.index("station")))
        width = plausible_deviation(cell, self.free[: len(geometry)])
        if fit.prior is not None:
            width = np.minimum(width, fit.prior[geometry])
        self.prior = np.where(np.isfinite(width), width, PRIOR_SIGMA)
        self._observe(fit, cell)
        total = self._gram(0, slice(None))
        for number in range(1, len(self.measured)):
            total = total + self._gram(number, slice(None))
        groups = np.concatenate([np.full(len(geometry), -1), term_groups(terms)]).astype(int)
        sizes = np.concatenate([np.ones(len(geometry)), term_sizes(terms)])
        self.coordinates = condensed(lambda columns: total.square[np.ix_(columns, columns)], groups, sizes)
        self.total = self.coordinates.gram(total)
        self._condense()

    def _choose(self, measured: Sequence[PoseMeasurements]) -> None:
        """Choose the rows used to evaluate the folds: of very many rows, every k-th.

        Args:
            measured: the blocks of measurements.
        """
        stride = max(1, -(-sum(map(len, measured)) // MAX_POSES))
        self.chosen = [np.arange(0, len(block), stride) for block in measured]
        self.measured = [take(block, rows) for block, rows in zip(measured, self.chosen)]

    def _number_poses(self) -> None:
        self.pose: list[np.ndarray] = []
        poses: list[np.ndarray] = []
        count = 0
        for block in self.measured:
            _, first, pose_of_row = np.unique(block.together, return_index=True, return_inverse=True)
            self.pose.append(pose_of_row + count)
            poses.append(block.q[first])
            count += len(first)
        self.poses = np.concatenate(poses)

    def _observe(self, fit: GeometricFit, cell: Installation) -> None:
        """Compute residuals and Jacobians of all rows, whitened and in metres.

        Args:
            fit: the fit of all rows, whose sigmas and weights whiten them.
            cell: the rigid installation at which derivatives are computed.
        """
        sigmas = fit.used_sigmas()
        weights = fit.row_weights()
        self.whitened: list[list[tuple[np.ndarray, np.ndarray]]] = []
        self.metric: list[tuple[np.ndarray, np.ndarray]] = []
        for number, block in enumerate(prepare(cell, self.measured)):
            parts = observe(cell, block, self.free)
            root = np.sqrt(weights[number][self.chosen[number]])
            whitened = []
            for part in parts:
                sigma = sigmas[number][part.label]
                whitened.append((part.value * root / sigma, part.jacobian * root / sigma))
            self.whitened.append(whitened)
            position = _position_part(parts)
            self.metric.append((position.value, position.jacobian))

    def _condense(self) -> None:
        """Express all Jacobians in the coordinates of the statistics."""
        columns = self.coordinates.columns
        for number, block in enumerate(self.whitened):
            self.whitened[number] = [(value, columns(jacobian)) for value, jacobian in block]
        self.metric = [(value, columns(jacobian)) for value, jacobian in self.metric]

    def _gram(self, block: int, rows: np.ndarray | slice) -> Gram:
        statistics = []
        for value, jacobian in self.whitened[block]:
            matrix = jacobian[:, :, rows].reshape(len(jacobian), -1).T
            statistics.append(gram(value[:, rows].ravel(), matrix))
        return sum(statistics[1:], statistics[0])

    def left_out(self, folds: Folds, levers: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the errors on the held-out rows of each fold, as an array (rows, 5).

        The columns are |e|² [m²] of the position error e, its variance trace J Σ Jᵀ [m²] due to the parameters (J
        Jacobian, Σ their covariance), squared distances from the fitted poses and from the joints' ranges [m²] (as of
        `_distances`), and the index of the pose.

        Args:
            folds: the partition of the rows.
            levers: (n,) motion of the tool per unit of each joint [m/rad or 1].
        """
        space = self.coordinates
        diagonal = np.arange(len(self.prior))
        sizes = space.sizes
        for fold in range(folds.count):
            held_out = []
            for members, rows in zip(folds.members, self.chosen):
                held_out.append(np.flatnonzero(members[rows] == fold))
            if not 0 < sum(map(len, held_out)) < sum(map(len, self.measured)):
                continue
            data = self.total
            for number, rows in enumerate(held_out):
                if len(rows):
                    data = data - self._gram(number, rows)
            square = data.square.copy()
            square[diagonal, diagonal] += 1.0 / self.prior**2
            estimate = relevance(replace(data, square=square), space.groups, sizes, 8, SETTLED, space.counts)
            # where the next fold's search begins
            ridged = np.isfinite(estimate.ridge) & (estimate.ridge > 0.0)
            sizes = np.where(ridged, estimate.ridge, space.sizes)
            alive = np.flatnonzero(estimate.ridge > 0.0)
            precision = square[np.ix_(alive, alive)] / estimate.noise**2
            precision = precision + np.diag(estimate.ridge[alive] ** -2.0)
            scale = 1.0 / np.sqrt(np.diag(precision))
            precision *= np.outer(scale, scale)
            fitted_poses = []
            fitted_stations = set()
            for block, rows in zip(self.measured, held_out):
                fitted_poses.append(np.delete(block.q, rows, axis=0))
                if len(rows) < len(block):
                    fitted_stations.add(block.station)
            learnt = np.concatenate(fitted_poses)
            for number, rows in enumerate(held_out):
                if not len(rows):
                    continue
                block = self.measured[number]
                value, jacobian = self.metric[number]
                value = value[..., rows]
                jacobian = jacobian[..., rows]
                if block.station not in fitted_stations:
                    # its placement is fitted to the held-out rows
                    stacked = project_out(np.concatenate([jacobian, value[None]]), self.station)
                    jacobian = stacked[:-1]
                    value = stacked[-1]
                error = value - np.einsum("f,fim->im", estimate.values, jacobian)
                variances = _variances(precision, scale[:, None] * jacobian[alive].reshape(len(alive), -1))
                from_poses, from_ranges = _distances(block.q[rows], learnt, levers)
                squares = np.sum(error**2, axis=0)
                variance = variances.reshape(3, -1).sum(axis=0)
                table = np.stack([squares, variance, from_poses, from_ranges, self.pose[number][rows]], axis=1)
                yield table[self.counts[number][rows]]

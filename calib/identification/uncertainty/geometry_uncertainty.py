"""Effect of the geometry's uncertainty on the identified dynamics: sensitivities and the total covariance.

The estimate φ on a geometry g (values of the chain's elements) minimises ‖(y - W(g) φ) / σ‖² (plus the term of a prior,
if there is one), so that at fixed torques y and weights

    dφ/dg_k = A⁻¹ [ (∂W/∂g_k)ᵀ R⁻¹ (y - W φ) - Wᵀ R⁻¹ (∂W/∂g_k) φ ],     A = Wᵀ R⁻¹ W (+ the prior's information),

with R the variances that weighted the residuals, and with W, ∂W/∂g_k φ and y equally low-passed and decimated. This is
the implicit derivative of the normal equations. ∂W/∂g_k is a central difference of the regressor's kernel, element by
element, accurate to nine digits. Errors of the geometric fit and of the torques are independent of each other, hence

    Σ = Σ_torque + S Σ_geometry Sᵀ,    S = dφ/dg.

The intervals refer to φ* = T(g*) χ*: the standard parameters χ* of the real bodies in the link frames of the real
geometry g*, regrouped on this geometry. Link frames are those of the fit's convention: elements that the fit keeps at
nominal values, because they merge with the frame of the instrument or tool, have no error, since they are a choice of
frames. The coefficients of T printed with an estimate are those of T(ĝ). Their uncertainty does not widen any interval
of φ*, since the estimate does not use them.

S neglects the dependence on g of the weights, of the prior, and of the columns of load-dependent friction (which depend
on the fitted torque, and this hardly changes with g). With instruments Z, Zᵀ R⁻¹ (y - W φ) = 0 gives

    dφ/dg_k = -(Zᵀ R⁻¹ W)⁻¹ Zᵀ R⁻¹ (∂W/∂g_k) φ    [+ (Zᵀ R⁻¹ W)⁻¹ (dZ/dg_k)ᵀ R⁻¹ (y - W φ)].

The bracket is neglected: it vanishes with the residual, and on average, since no function of the reference is
correlated with the noise. (For `didim`, W is Z.) For other methods the sensitivity is that of WLS with the standard
deviations of their residuals.

`compare` adds a second identification from the same torques, on the nominal geometry.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

from calib.data.signals.filtering import Decimator, decimate, kept, spread
from calib.dynamics import rigid_body
from calib.dynamics.bodies import Bodies
from calib.dynamics.regressor_model import RegressorModel
from calib.dynamics.torque_rows import BODIES
from calib.estimation.triangles import retriangulate
from calib.identification.identify import Identification, common_decimator
from calib.identification.link_motion import bodies_torques, chosen_terms, joint_terms, motion_of_bases
from calib.identification.rows import Case, ObservationRows, observe, segments
from calib.identification.settings import make_bodies, make_model
from calib.records import Frozen, frozen
from calib.robot.calibrated import CalibratedChain, as_calibrated, target_elements
from calib.robot.chain import Chain

STEP = 1e-5
"""Step of the central differences [m or rad]."""
SAMPLES = 30_000
"""Samples at the full rate; longer recordings are represented by pieces spread over them (our choice)."""
DEFLECTION_SAMPLES = 10_000
"""The same for the sensitivity to joint corrections (our choice)."""
MIN_PIECE = 32
"""Decimated samples of such a piece, at least."""
PIECE = 4096
"""Samples of such a piece at the full rate, about."""
BLOCK = 4096
"""Samples at a time: their states stay in the processor's cache."""
CHUNK = 2000
"""Decimated samples at a time, where each needs its own line of a matrix."""
NOTHING = 0.01
"""Share below which a growth of σ is no change (our choice)."""
TILTS = ("gravity.rx", "gravity.ry")

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class _Estimator:
    """An estimate φ as a function of its rows: A φ = Wᵀ R⁻¹ y + pull, A = Wᵀ R⁻¹ W + LᵀL.

    Attributes:
        deviation: (rows,) standard deviations, R = diag(deviation²).
        beforehand: (k, p) L, whitened rows of the prior; (0, p) without one.
        pull: (p,) information of the prior times its mean, including the effect of bounds.
    """

    deviation: np.ndarray
    beforehand: np.ndarray
    pull: np.ndarray


def estimator(identification: Identification[RegressorModel]) -> _Estimator:
    """Return an identification's estimator, i.e. the weights of its rows and its prior."""
    fitted = identification.fitted
    p = fitted.pooled.parameters
    deviation = np.array(fitted.std) if fitted.weighted else np.ones(len(fitted.std))
    prior_rows = fitted.beforehand
    if prior_rows is None:
        beforehand = np.zeros((0, p))
        return _Estimator(deviation, beforehand, np.zeros(p))
    deviation = deviation * np.sqrt(fitted.inflation)
    weighted = fitted.pooled.factors / deviation[:, None, None]
    factors = weighted.reshape(-1, p + 1)
    matrix = factors[:, :p]
    target = factors[:, p]
    values = fitted.estimate.values
    pull = matrix.T @ (matrix @ values - target) + prior_rows.T @ (prior_rows @ values)
    return _Estimator(deviation, prior_rows, pull)


def estimate(estimator: _Estimator, all_rows: Sequence[ObservationRows]) -> tuple[np.ndarray, np.ndarray]:
    """Return φ (p,) and A⁻¹ (p, p) for given rows, by QR of the whitened rows.

    Args:
        estimator: weights of the rows, and prior.
        all_rows: rows of all recordings.
    """
    p = len(estimator.pull)
    no_target = np.zeros((len(estimator.beforehand), 1))
    factor = np.hstack([estimator.beforehand, no_target])
    for rows in all_rows:
        augmented = np.column_stack([stacked(rows), rows.target.ravel()])
        whitened = augmented * weights(estimator, rows)[:, None]
        factor = retriangulate(np.vstack([factor, whitened]))
    upper = factor[:p, :p]
    inverse = inverted(upper)
    solution = factor[:p, p]
    return inverse @ (solution + inverse.T @ estimator.pull), inverse @ inverse.T


def rows_on(identification: Identification, chain: Chain, cases: Sequence[Case]) -> list[ObservationRows]:
    """Return the rows of an identification, recomputed for another geometry; friction columns are unchanged.

    Args:
        identification: the model and its rows.
        chain: the arm with the other geometry.
        cases: training data of the identification.
    """
    model = make_model(chain, identification.settings)
    decimator = common_decimator(cases, identification.settings)
    base_count = identification.base.b
    result = []
    for rows, case in zip(identification.rows, cases):
        observed = observe(model, identification.base.kept, case, decimator)
        # In a standstill nothing decides Coulomb's friction: its column is zero there.
        at_rest = (rows.standing > 0.0)[:, :, None] & rows.coulomb[:, :base_count]
        base_columns = np.where(at_rest, 0.0, observed.matrix)
        matrix = np.concatenate([base_columns, rows.matrix[:, :, base_count:]], axis=2)
        result.append(replace(rows, matrix=matrix))
    return result


def cut(rows: ObservationRows, part: slice) -> ObservationRows:
    """Return the rows of the samples in the slice `part`."""
    matrix = rows.matrix[part]
    target = rows.target[part]
    present = rows.present[part]
    block = rows.block[part]
    standing = rows.standing[part]
    swing = rows.swing[part]
    breakaway = rows.breakaway[part]
    return replace(
        rows,
        matrix=matrix,
        target=target,
        present=present,
        block=block,
        standing=standing,
        swing=swing,
        breakaway=breakaway,
    )


def inverted(upper: np.ndarray) -> np.ndarray:
    """Return the inverse of an upper triangular matrix (p, p), computed with columns scaled to unit norm."""
    unit = np.linalg.norm(upper, axis=0)
    identity = np.eye(len(unit))
    inverse = np.asarray(scipy.linalg.solve_triangular(upper / unit, identity))
    return inverse / unit[:, None]


def stacked(rows: ObservationRows) -> np.ndarray:
    """Return the observation matrix of the rows as (M · rows, p), sample by sample."""
    return rows.matrix.reshape(-1, rows.matrix.shape[2])


def weights(estimator: _Estimator, rows: ObservationRows, divisor: np.ndarray | None = None) -> np.ndarray:
    """Return the weight of each stacked row (M · rows,): 1 / deviation, or zero for rows not used in training.

    Args:
        estimator: the estimator.
        rows: M samples.
        divisor: (rows,) numbers by which weights are divided instead of the estimator's deviation; None: the deviation.
    """
    if divisor is None:
        divisor = estimator.deviation
    return (rows.weight / divisor).ravel()


@dataclass(frozen=True, eq=False)
class GeometryUncertainty(Frozen):
    """Sensitivity of the estimate to the geometry, and its contribution to the covariance.

    Attributes:
        names: names of the p estimated parameters.
        elements, units: names and units of the K elements of the chain, then of the tilts of gravity about the base's x
            and y axes.
        sensitivity: (p, K + 2) dφ/dg.
        torque: (p, p) covariance due to the torques' noise, i.e. the covariance of the estimate.
        deviations: (K + 2,) standard deviations of the geometry; NaN where unknown.
        geometry: (p, p) S Σ_geometry Sᵀ; None if the covariance of the geometry is unknown.
        felt, left: (K + 2,) rms change of the rigid torque over rows and samples per unit of each element [N m or N],
            with fixed parameters, and with parameters estimated again.
    """

    names: tuple[str, ...]
    elements: tuple[str, ...]
    units: tuple[str, ...]
    sensitivity: np.ndarray
    torque: np.ndarray
    deviations: np.ndarray
    geometry: np.ndarray | None
    felt: np.ndarray
    left: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        """Total covariance (p, p): Σ_torque (`torque`) + S Σ_geometry Sᵀ (`geometry`), with S the sensitivity."""
        return np.asarray(self.torque) if self.geometry is None else self.torque + self.geometry

    @property
    def sigma_torque(self) -> np.ndarray:
        """Standard deviation (p,) of the parameters due to the torques' noise."""
        return np.sqrt(np.clip(np.diag(self.torque), 0.0, None))

    @property
    def sigma_geometry(self) -> np.ndarray:
        """Standard deviation (p,) of the parameters due to the uncertain geometry; zero if the geometry is exact."""
        if self.geometry is None:
            return np.zeros(len(self.names))
        return np.sqrt(np.clip(np.diag(self.geometry), 0.0, None))

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation (p,) of the parameters due to torque noise and geometry together."""
        return np.hypot(self.sigma_torque, self.sigma_geometry)

    @property
    def changed(self) -> np.ndarray:
        """Mask (p,) of parameters whose σ grows by a share of more than `NOTHING` due to the geometry."""
        return self.sigma > (1.0 + NOTHING) * self.sigma_torque

    @property
    def dominated(self) -> np.ndarray:
        """Mask (p,) of parameters for which the geometry's part of σ exceeds the part of the torque noise."""
        return self.sigma_geometry > self.sigma_torque


def propagate(
    identification: Identification,
    robot: Chain | CalibratedChain,
    cases: Sequence[Case],
    progress: Progress | None = None,
) -> GeometryUncertainty:
    """Return the geometry's contribution to the covariance of the identified parameters.

    Args:
        identification: the model and its rows.
        robot: the robot of the identification; without a covariance (K, K) its geometry is taken as exact. If joint
            corrections move the links, the uncertainty of their coefficients is included.
        cases: training data of the identification.
        progress: function that is called with a short text at each part; None: not called.
    """
    robot = as_calibrated(robot)
    chain, covariance = robot.chain, robot.covariance
    deflected = cases[0].link is not None
    if deflected and robot.corrections is not None:
        chain, covariance = robot.complete, robot.corrections.covariance
    matrix, felt, left = sensitivity(identification, chain, cases, progress)

    element_count = len(chain.elements)
    deviations = np.full(element_count + len(TILTS), np.nan)
    geometry = None
    if covariance is not None:
        by_geometry = matrix[:, :element_count]
        if deflected:
            by_deflection = deflection_sensitivity(identification, robot, cases)
            by_geometry = np.hstack([by_geometry, by_deflection])
        geometry = frozen(by_geometry @ covariance @ by_geometry.T)
        element_deviations = np.sqrt(np.clip(np.diag(covariance)[:element_count], 0.0, None))
        deviations[:element_count] = np.where(element_deviations > 0.0, element_deviations, np.nan)
    elements = (*chain.names, *TILTS)
    units = (*chain.units, *(["rad"] * len(TILTS)))
    return GeometryUncertainty(
        names=identification.names,
        elements=elements,
        units=units,
        sensitivity=matrix,
        torque=identification.fitted.estimate.covariance,
        deviations=deviations,
        geometry=geometry,
        felt=felt,
        left=left,
    )


def sensitivity(
    identification: Identification, chain: Chain, cases: Sequence[Case], progress: Progress | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return dφ/dg (p, K + 2), and two arrays (K + 2,) of rms changes of the rigid torque per unit of g.

    The first rms changes are with fixed parameters φ, the second with parameters estimated again. The last two columns
    of dφ/dg are tilts of gravity about the base's x and y axes [per rad].

    Args:
        identification: the model and its rows, with p parameters φ.
        chain: the arm; g are the values of its K elements [m or rad], then two tilts of gravity [rad].
        cases: training data of the identification.
        progress: function that is called with a short text at each part; None: not called.
    """
    if not identification.dynamics.model.torque_rows.has_bodies:
        # Without bodies, no geometry affects the rows.
        count = len(chain.elements) + len(TILTS)
        no_sensitivity = np.zeros((len(identification.names), count))
        return no_sensitivity, np.zeros(count), np.zeros(count)
    differences = partial(_differences, identification, _neighbours(identification, chain))
    return solve_sensitivity(identification, cases, differences, SAMPLES, progress)


def solve_sensitivity(
    identification: Identification[RegressorModel],
    cases: Sequence[Case],
    differences: Callable[..., tuple[np.ndarray, np.ndarray]],
    samples: int,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the results of `sensitivity` for any robot with K changes of its geometry.

    Args:
        identification: the model and its rows.
        cases: its training data.
        differences: function of a case, a slice of its samples, R⁻¹ (y - W φ) (residuals of the estimate φ over their
            variances R) and the decimator that returns ∂(W φ - y)/∂g (M, rows, K) and (∂W/∂g)ᵀ R⁻¹ (y - W φ) (b, K).
        samples: largest number of samples at the full rate; longer recordings are represented by pieces.
        progress: function that is called with a short text at each part; None: not called.
    """
    weighting = estimator(identification)
    p = len(weighting.pull)
    decimator = common_decimator(cases, identification.settings)
    values = identification.fitted.estimate.values
    total_samples = sum(len(case.motion) for case in cases)
    step = -(-total_samples // samples)
    recordings = identification.fitted.instruments
    if not recordings:
        recordings = tuple((case, rows, None) for rows, case in zip(identification.rows, cases))

    # Whitened columns, changes of the residuals and instruments of all pieces.
    matrices = []
    row_weights = []
    changes = []
    instruments = []
    pull: np.ndarray | float = 0.0
    present_rows = 0
    for case, rows, instrument in recordings:
        present_rows += np.count_nonzero(rows.present)
        for number, (part, span) in enumerate(pieces(case, decimator, step)):
            if progress is not None:
                progress(f"sensitivity to the geometry: {case.name}, part {number + 1}")
            piece = cut(rows, part)
            residual = piece.target - piece.matrix @ values
            weighted_residual = residual * piece.weight**2 / weighting.deviation**2
            change, piece_pull = differences(case, span, weighted_residual, decimator)
            # Power has a row per recording, of which each piece fills one.
            change = np.broadcast_to(change, (*residual.shape, change.shape[2]))
            matrices.append(stacked(piece))
            row_weights.append(weights(weighting, piece))
            changes.append(change.reshape(-1, change.shape[2]))
            pull = pull + piece_pull
            if instrument is not None:
                instruments.append(instrument[part].reshape(-1, p))
    matrix = np.concatenate(matrices)
    scale = np.concatenate(row_weights)
    change = np.concatenate(changes)

    if instruments:
        augmented = np.hstack([np.concatenate(instruments), matrix, change])
        factor = retriangulate(augmented * scale[:, None])[:p, p:]
        unit = np.linalg.norm(factor[:, :p], axis=0)
        scaled_factor = factor[:, :p] / unit
        scaled_slopes = -np.linalg.solve(scaled_factor, factor[:, p:])
        slopes = scaled_slopes / unit[:, None]
    else:
        # The prior counts as much beside the pieces as it did beside all rows.
        share = float(np.count_nonzero(scale) / present_rows)
        padding = ((0, 0), (0, change.shape[1]))
        prior_rows = np.sqrt(share) * np.pad(weighting.beforehand, padding)
        whitened = np.hstack([matrix, change]) * scale[:, None]
        factor = retriangulate(np.vstack([prior_rows, whitened]))
        upper = factor[:p, :p]
        inverse = inverted(upper)
        base_rows = inverse[: identification.base.b]
        slopes = inverse @ (base_rows.T @ pull - factor[:p, p:])
    used = scale > 0.0
    after = change + matrix @ slopes
    return slopes, _rms(change[used]), _rms(after[used])


def _neighbours(identification: Identification, chain: Chain) -> list[tuple[Bodies, Bodies]]:
    """Return pairs of bodies with one geometric element, or one tilt of gravity, changed by +`STEP` and -`STEP`.

    Args:
        identification: the model, with its payloads.
        chain: the arm.
    """
    settings = identification.settings
    values = np.array(chain.values)
    pairs = []
    for step in STEP * np.eye(len(chain.elements)):
        up = make_bodies(chain.with_values(values + step), settings)
        down = make_bodies(chain.with_values(values + -step), settings)
        pairs.append((up, down))
    gravity = np.array(identification.dynamics.model.bodies.gravity)
    for turn in STEP * np.eye(3)[:2]:
        gravity_up = Rotation.from_rotvec(turn).apply(gravity)
        gravity_down = Rotation.from_rotvec(-turn).apply(gravity)
        up = make_bodies(chain, replace(settings, gravity=tuple(gravity_up.tolist())))
        down = make_bodies(chain, replace(settings, gravity=tuple(gravity_down.tolist())))
        pairs.append((up, down))
    return pairs


def pieces(case: Case, decimator: Decimator, step: int = 1) -> list[tuple[slice, slice]]:
    """Return every `step`-th piece of a case, as pairs of slices; with step 1 each segment is one piece.

    The first slice selects decimated rows, the second the full-rate samples on which these depend.

    Args:
        case: the recording.
        decimator: filter and decimation of the rows.
        step: 1 for all samples; k for every k-th piece only.
    """
    factor = decimator.factor
    size = max(PIECE // factor, MIN_PIECE)
    result = []
    first = 0
    for start, stop in segments(case.motion.segment):
        count = len(kept(np.zeros(stop - start, dtype=int), decimator))
        length = max(count, 1) if step == 1 else size
        for number, row in enumerate(range(0, count, length)):
            if number % step:
                continue
            row_count = min(length, count - row)
            begin = start + row * factor
            end = begin + (row_count - 1) * factor + 2 * decimator.reach + 1
            result.append((slice(first + row, first + row + row_count), slice(begin, end)))
        first += count
    return result


def _differences(
    identification: Identification,
    pairs: Sequence[tuple[Bodies, Bodies]],
    case: Case,
    span: slice,
    residual: np.ndarray,
    decimator: Decimator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return (∂W/∂g) φ (M, rows, K + 2), filtered and decimated, and (∂W/∂g)ᵀ R⁻¹ (y - W φ) (b, K + 2).

    Args:
        identification: the model and its rows.
        pairs: bodies with a changed geometry, from `_neighbours`.
        case: the recording.
        span: slice of its full-rate samples.
        residual: (M, rows) R⁻¹ (y - W φ) of the decimated rows that depend on these samples.
        decimator: filter and decimation.
    """
    model = identification.dynamics.model
    base = identification.base
    n = model.bodies.n
    inertial = model.inertial
    onboard = model.carried_columns(case.carried)
    base_values = identification.fitted.estimate.values[: base.b]
    parameters = base.to_standard(base_values)[:inertial] * onboard
    q, v, a = (np.asarray(series[span]) for series in case.links)

    # The residuals as torques of the joints at the full rate.
    torque_rows = model.torque_rows
    joint_residual = spread(residual, decimator, len(q))[:, :, None]
    if torque_rows.projection is not None:
        # No geometry changes the projection.
        joint_residual = np.einsum("nrk,nrc->nkc", torque_rows.projection.torques(q, v), joint_residual)
    unprojected = replace(torque_rows, projection=None)
    joint_residual = unprojected.fold(joint_residual, (BODIES,))[:, :, 0]

    neighbours = [bodies for pair in pairs for bodies in pair]
    # in the memory order in which `decimate` filters without a copy
    change = np.empty((n, len(pairs), len(q)))
    pull = np.zeros((inertial, len(pairs)))
    for start in range(0, len(q), BLOCK):
        part = slice(start, start + BLOCK)
        states = (q[part], v[part], a[part])
        products = rigid_body.regressor_products(neighbours, parameters, *states, joint_residual[part])
        # the iterator twice: the two neighbours of a pair follow each other
        for k, ((torque_up, sums_up), (torque_down, sums_down)) in enumerate(zip(products, products)):
            change[:, k, part] = (torque_up - torque_down) / (2.0 * STEP)
            pull[:, k] += (sums_up - sums_down) / (2.0 * STEP)
    acts = (BODIES,) * len(pairs)
    rows = torque_rows.observe(change.transpose(2, 0, 1), acts, q, v)
    of_bodies = base.kept < inertial
    base_pull = np.zeros((base.b, len(pairs)))
    base_pull[of_bodies] = (pull * onboard[:, None])[base.kept[of_bodies]]
    return decimate(rows, decimator), base_pull


def _rms(values: np.ndarray) -> np.ndarray:
    """Return the root mean square of each column.

    Args:
        values: (M, columns) numbers.
    """
    return np.sqrt(np.mean(values**2, axis=0))


@dataclass(frozen=True, eq=False)
class GeometryComparison:
    """Two estimates from the same torques, on two geometries.

    Attributes:
        names, units: names and units of the p parameters.
        values: (2, p) estimates on the nominal (CAD) and on the calibrated geometry.
        sigma: (2, p) standard deviations: due to torque noise alone on the nominal geometry, total on the calibrated
            geometry.
        difference: (p,) standard deviation of the difference: the geometry's part, and the small part of the torque
            noise that affects the two estimates differently.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    sigma: np.ndarray
    difference: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """Relative difference (p,), 100 (nominal - calibrated) / |calibrated| [%]; NaN if calibrated is zero."""
        nominal, calibrated = self.values
        with np.errstate(divide="ignore", invalid="ignore"):
            percent = 100.0 * (nominal - calibrated) / np.abs(calibrated)
        return np.where(calibrated == 0.0, np.nan, percent)


def compare(
    identification: Identification, uncertainty: GeometryUncertainty, nominal: Chain, cases: Sequence[Case]
) -> GeometryComparison:
    """Return a comparison of the estimate with one from the same torques on the nominal geometry.

    Weighted least squares with equal weights is solved on both geometries. The estimate on the nominal geometry is the
    identification's estimate plus the difference of these two solutions.

    Args:
        identification: the model and its rows.
        uncertainty: contribution of the geometry to the covariance.
        nominal: chain with the nominal geometry.
        cases: training data.
    """
    fitted = identification.fitted
    weighting = estimator(identification)
    undeflected = [replace(case, link=None) for case in cases]
    nominal_rows = rows_on(identification, nominal, undeflected)
    nominal_values, nominal_inverse = estimate(weighting, nominal_rows)
    calibrated_values, calibrated_inverse = estimate(weighting, identification.rows)

    # Variances of the nominal estimate, and of the difference: the noise of each sample acts on both estimates.
    noise = np.array(fitted.std) * np.sqrt(fitted.inflation)
    variance = np.zeros(len(nominal_values))
    difference_variance = np.array(uncertainty.sigma_geometry**2)
    for nominal_part, calibrated_part in zip(nominal_rows, identification.rows):
        for start in range(0, len(nominal_part.target), CHUNK):
            chunk = slice(start, start + CHUNK)
            rows = cut(nominal_part, chunk)
            nominal_gain = _gain(nominal_inverse, weighting, rows)
            calibrated_gain = _gain(calibrated_inverse, weighting, cut(calibrated_part, chunk))
            row_noise = np.tile(noise, len(nominal_part.target[chunk]))
            variance += np.sum((nominal_gain * row_noise) ** 2, axis=1)
            difference_variance += np.sum(((nominal_gain - calibrated_gain) * row_noise) ** 2, axis=1)
    values = np.asarray(fitted.estimate.values)
    sigma = frozen(np.stack([np.sqrt(variance), uncertainty.sigma]))
    difference = frozen(np.sqrt(difference_variance))
    values_of_both = frozen(np.stack([values + nominal_values - calibrated_values, values]))
    return GeometryComparison(identification.names, fitted.estimate.units, values_of_both, sigma, difference)


def _gain(inverse: np.ndarray, weighting: _Estimator, rows: ObservationRows) -> np.ndarray:
    """Return A⁻¹ Wᵀ R⁻¹ (p, M · rows): the change of the estimate per unit of each row's torque.

    Args:
        inverse: A⁻¹ (p, p), with A = Wᵀ R⁻¹ W plus the prior's information.
        weighting: weights of the rows.
        rows: M samples.
    """
    weight = weights(weighting, rows, weighting.deviation**2)
    return inverse @ (stacked(rows) * weight[:, None]).T


def deflection_sensitivity(found: Identification, robot: CalibratedChain, cases: Sequence[Case]) -> np.ndarray:
    """Return the derivatives (p, E) of the estimate by the coefficients of E joint corrections; zero for unused ones.

        dφ/dc = -(Wᵀ R⁻¹ W)⁻¹ Wᵀ R⁻¹ Σ_s ∂τ/∂s b_s,    s one of q, v, a of the joint, b_s the basis or its derivative

    with W the observation matrix, R the variances of its rows, τ the torques; as in `sensitivity`, but without the part
    that is proportional to the residual. A model without bodies (rows ``drive``) feels no deflection.

    Args:
        found: the identification.
        robot: its robot, with joint corrections.
        cases: training data of the identification, with the motion of the links.
    """
    terms = robot.deflection
    chain = robot.complete
    settings = found.settings
    where = target_elements(chain, terms)
    how = estimator(found)
    inverse = estimate(how, found.rows)[1]
    decimator = common_decimator(cases, found.settings)
    model = found.dynamics.model
    base_values = found.fitted.estimate.values[: found.base.b]
    standard = found.base.to_standard(base_values)[: model.inertial]
    pull = np.zeros((len(inverse), len(terms.terms)))
    if not model.inertial:
        return pull
    seen = 0
    every = -(-sum(len(case.motion) for case in cases) // DEFLECTION_SAMPLES)
    for rows, case in zip(found.rows, cases):
        torque = bodies_torques(joint_terms(chain, terms), case, settings)
        values = standard * model.carried_columns(case.carried)
        spans = []
        for chosen, span in pieces(case, decimator, every):
            part = cut(rows, chosen)
            squared = (weights(how, part) ** 2).reshape(part.present.shape)
            white = part.matrix * squared[:, :, None]
            back = spread(white, decimator, span.stop - span.start)
            acts = (BODIES,) * back.shape[2]
            spans.append((span, model.torque_rows.fold(back, acts)))
            seen += np.count_nonzero(part.present)
        for j in np.flatnonzero(np.isin(chain.moving, where)):
            own = where == chain.moving[j]
            bases = motion_of_bases(chosen_terms(terms, own), case.motion, torque)
            for span, felt in spans:
                link_motion = [x[span] for x in case.links]
                joint = int(j)
                slopes = _torque_slopes(model.bodies, values, link_motion, joint)
                pull[:, own] += np.einsum("nip,sni,sen->pe", felt, slopes, bases[:, :, span], optimize=True)
    row_count = sum(np.count_nonzero(part.present) for part in found.rows)
    return -inverse @ pull * (row_count / seen)


def _torque_slopes(bodies: Bodies, values: np.ndarray, states: Sequence[np.ndarray], joint: int) -> np.ndarray:
    """Return ∂τ/∂q_j, ∂τ/∂v_j and ∂τ/∂a_j (3, N, n) for one joint j, by central differences.

    Args:
        bodies: the robot's bodies.
        values: (10 B,) standard parameters.
        states: q, v, a, (N, n) each [rad or m, and per s, per s²].
        joint: index of joint j, from 0.
    """
    result = np.zeros((3, *states[0].shape))
    for order in range(3):
        for sign in (1.0, -1.0):
            moved = [np.array(x) for x in states]
            moved[order][:, joint] += sign * STEP
            result[order] += sign / (2.0 * STEP) * rigid_body.inverse_dynamics(bodies, values, *moved)
    return result

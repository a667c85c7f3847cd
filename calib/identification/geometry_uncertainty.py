"""Effect of the geometry's uncertainty on the identified dynamics: sensitivities and the total covariance.

The estimate on a geometry g (values of the chain's elements) minimises ‖(y - W(g) φ) / σ‖² (plus a prior's term, if
there is one), so that at fixed torques y and weights

    dφ/dg_k = A⁻¹ [ (∂W/∂g_k)ᵀ R⁻¹ (y - W φ) - Wᵀ R⁻¹ (∂W/∂g_k) φ ],     A = Wᵀ R⁻¹ W (+ the prior's information),

with R the residuals' variances as the estimate weighed them, and W, ∂W/∂g_k φ, y low-passed and thinned alike. It is
the implicit derivative of the normal equations; ∂W/∂g_k is a central difference of the regressor's kernel, element by
element, good to nine digits. Errors of the geometric fit and of the torques are independent of each other, hence

    Σ = Σ_torque + S Σ_geometry Sᵀ.

What the intervals are about: φ* = T(g*) χ*, the standard parameters χ* of the real bodies in the link frames of the
real geometry g*, regrouped there. Link frames are those of the fit's own convention: elements that it keeps at their
nominal because they merge with the instrument's or the tool's frame have no error of their own, they are a choice of
frames. The coefficients of T printed with an estimate are those of T(ĝ); that they are uncertain, too, widens no
interval of φ*, for the estimate never uses them.

Not part of S: the weights' and the prior's own dependence on g, and that of load-dependent friction's columns (which
rest on the fitted torque, and that hardly changes with g). With instruments Z, Zᵀ R⁻¹ (y - W φ) = 0 gives

    dφ/dg_k = -(Zᵀ R⁻¹ W)⁻¹ Zᵀ R⁻¹ (∂W/∂g_k) φ    [+ (Zᵀ R⁻¹ W)⁻¹ (dZ/dg_k)ᵀ R⁻¹ (y - W φ)],

the bracket left out: it vanishes with the residual, and in the mean, since no function of the reference is correlated
with the noise. (`didim`: W is Z.) For other methods the sensitivity is that of WLS with their residuals' spread.

`compare` adds one identification on two geometries, the nominal and the calibrated one, from the same torques.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

from calib.data.signals.filtering import Decimator, decimate, kept, spread
from calib.dynamics import rigid_body
from calib.dynamics.bodies import Bodies
from calib.dynamics.torque_rows import BODIES
from calib.estimation.triangles import retriangulate
from calib.extensions import needed
from calib.identification.identify import Identification, common_decimator
from calib.identification.rows import Case, ObservationRows, observe, segments
from calib.identification.settings import make_bodies, make_model
from calib.records import Frozen, frozen
from calib.robot.calibrated import CalibratedChain, as_calibrated
from calib.robot.chain import Chain


@dataclass(frozen=True, eq=False)
class _Estimator:
    """An estimate as a function of its rows: A φ = Wᵀ R⁻¹ y + pull, A = Wᵀ R⁻¹ W + LᵀL.

    Attributes:
        deviation: (rows,) R = diag(deviation²).
        beforehand: (k, p) L, whitened rows of the prior; (0, p) without one.
        pull: (p,) information of the prior times its mean, including the effect of bounds.
    """

    deviation: np.ndarray
    beforehand: np.ndarray
    pull: np.ndarray


def estimator(found: Identification[Any]) -> _Estimator:
    """Return an identification's estimator: weights of its rows and prior."""
    fitted = found.fitted
    p = fitted.pooled.parameters
    deviation = np.array(fitted.std) if fitted.weighted else np.ones(len(fitted.std))
    if fitted.beforehand is None:
        return _Estimator(deviation, np.zeros((0, p)), np.zeros(p))
    deviation = deviation * np.sqrt(fitted.inflation)
    factors = (fitted.pooled.factors / deviation[:, None, None]).reshape(-1, p + 1)
    known, values = fitted.beforehand, fitted.estimate.values
    pull = factors[:, :p].T @ (factors[:, :p] @ values - factors[:, p]) + known.T @ (known @ values)
    return _Estimator(deviation, known, pull)


def estimate(how: _Estimator, all_rows: Sequence[ObservationRows]) -> tuple[np.ndarray, np.ndarray]:
    """Return φ (p,) from rows, and A⁻¹ (p, p); by QR of the whitened rows."""
    p = len(how.pull)
    factor = np.hstack([how.beforehand, np.zeros((len(how.beforehand), 1))])
    for part in all_rows:
        white = np.column_stack([stacked(part), part.target.ravel()]) * weights(how, part)[:, None]
        factor = retriangulate(np.vstack([factor, white]))
    inverse, solution = inverted(factor[:p, :p]), factor[:p, p]
    return inverse @ (solution + inverse.T @ how.pull), inverse @ inverse.T


def rows_on(found: Identification, chain: Chain, cases: Sequence[Case]) -> list[ObservationRows]:
    """Return the rows of an identification recomputed for another geometry; friction columns are unchanged."""
    model, decimator = make_model(chain, found.settings), common_decimator(cases, found.settings)
    result = []
    for part, case in zip(found.rows, cases):
        own = observe(model, found.base.kept, case, decimator)
        at_rest = (part.standing > 0.0)[:, :, None] & part.coulomb[:, : found.base.b]
        bodies = np.where(at_rest, 0.0, own.matrix)
        matrix = np.concatenate([bodies, part.matrix[:, :, found.base.b :]], axis=2)
        result.append(replace(part, matrix=matrix))
    return result


def cut(rows: ObservationRows, own: slice) -> ObservationRows:
    """Return the part of the rows in a slice."""
    return replace(
        rows,
        matrix=rows.matrix[own],
        target=rows.target[own],
        present=rows.present[own],
        block=rows.block[own],
        standing=rows.standing[own],
        swing=rows.swing[own],
        slowness=rows.slowness[own],
    )


def inverted(upper: np.ndarray) -> np.ndarray:
    """Return the inverse of an upper triangular matrix (p, p) whose columns have different units."""
    unit = np.linalg.norm(upper, axis=0)
    return np.asarray(scipy.linalg.solve_triangular(upper / unit, np.eye(len(unit)))) / unit[:, None]


def stacked(rows: ObservationRows) -> np.ndarray:
    return rows.matrix.reshape(-1, rows.matrix.shape[2])


def weights(how: _Estimator, rows: ObservationRows, by: np.ndarray | None = None) -> np.ndarray:
    """Return the weight of each stacked row, 1 / deviation (or 1 / `by`); zero for rows not used in training."""
    return (rows.weight / (how.deviation if by is None else by)).ravel()


STEP = 1e-5  # of the central differences [m or rad]
SAMPLES = 30_000  # at the full rate; longer recordings are represented by pieces spread over them (our choice)
NOTHING = 0.01  # a σ that grows by a smaller share has not changed (our choice)
TILTS = ("gravity.rx", "gravity.ry")

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class GeometryUncertainty(Frozen):
    """Sensitivity of the estimate to the geometry, and its contribution to the covariance.

    Attributes:
        names: names of the p estimated parameters.
        elements, units: the K elements of the chain, then the tilts of gravity about the base's x and y axes.
        sensitivity: (p, K + 2) dφ/dg.
        torque: (p, p) covariance from the torques' noise: the estimate's own.
        deviations: (K + 2,) standard deviations of the geometry; NaN where unknown.
        geometry: (p, p) S Σ_geometry Sᵀ; None where no covariance of the geometry is known.
        felt, left: (K + 2,) rms change of the rigid torque over rows and samples per unit of each element [N m or N],
            at fixed parameters, and after estimating them again.
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
        """Total covariance (p, p): Σ_torque + S Σ_geometry Sᵀ."""
        return np.asarray(self.torque) if self.geometry is None else self.torque + self.geometry

    @property
    def sigma_torque(self) -> np.ndarray:
        return np.sqrt(np.clip(np.diag(self.torque), 0.0, None))

    @property
    def sigma_geometry(self) -> np.ndarray:
        """Standard deviation (p,) of the parameters due to the uncertain geometry; zero if the geometry is exact."""
        if self.geometry is None:
            return np.zeros(len(self.names))
        return np.sqrt(np.clip(np.diag(self.geometry), 0.0, None))

    @property
    def sigma(self) -> np.ndarray:
        return np.hypot(self.sigma_torque, self.sigma_geometry)

    @property
    def changed(self) -> np.ndarray:
        """Parameters whose σ grows by more than `NOTHING` (p,) bool."""
        return self.sigma > (1.0 + NOTHING) * self.sigma_torque

    @property
    def dominated(self) -> np.ndarray:
        """Parameters whose geometric part of σ exceeds the torque part (p,) bool."""
        return self.sigma_geometry > self.sigma_torque


def propagate(
    found: Identification, robot: Chain | CalibratedChain, cases: Sequence[Case], progress: Progress | None = None
) -> GeometryUncertainty:
    """Return the share of the identified parameters' covariance that comes from the covariance of the geometry.

    Args:
        found: the identification.
        robot: the one it was made on; where it brings no covariance (K, K), the geometry is taken as exact. Where
            joint corrections move the links, their coefficients' uncertainty takes part.
        cases: its training data.
    """
    robot = as_calibrated(robot)
    chain, covariance, deflected = robot.chain, robot.covariance, cases[0].link is not None
    if deflected and robot.corrections is not None:
        chain, covariance = robot.complete, robot.corrections.covariance
    matrix, felt, left = sensitivity(found, chain, cases, progress)
    count = len(chain.elements)
    geometry, deviations, felt_by = None, np.full(count + len(TILTS), np.nan), matrix[:, :count]
    if covariance is not None:
        if deflected:
            felt_by = np.hstack([felt_by, needed("deflection_sensitivity")(found, robot, cases)])
        geometry = frozen(felt_by @ covariance @ felt_by.T)
        own = np.sqrt(np.clip(np.diag(covariance)[:count], 0.0, None))
        deviations[:count] = np.where(own > 0.0, own, np.nan)
    return GeometryUncertainty(
        found.names,
        (*chain.names, *TILTS),
        (*chain.units, *("rad" for _ in TILTS)),
        matrix,
        found.fitted.estimate.covariance,
        deviations,
        geometry,
        felt,
        left,
    )


def sensitivity(
    found: Identification, chain: Chain, cases: Sequence[Case], progress: Progress | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return dφ/dg (p, K + 2), and rms changes of the rigid torque per unit, with φ fixed or re-estimated (K + 2,).

    The last two columns turn gravity about the base's x and y axes [per rad].
    """
    p, count = len(found.names), len(chain.elements) + len(TILTS)
    if not found.dynamics.model.torque_rows.has_bodies:  # no bodies: rows that no geometry reaches
        return np.zeros((p, count)), np.zeros(count), np.zeros(count)
    return solve_sensitivity(found, cases, partial(_differences, found, _neighbours(found, chain)), SAMPLES, progress)


def solve_sensitivity(
    found: Identification[Any],
    cases: Sequence[Case],
    differences: Callable[..., tuple[np.ndarray, np.ndarray]],
    samples: int,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the results of `sensitivity` for any robot, K changes of whose geometry `differences` evaluates.

    Args:
        differences: takes a case, samples of it, R⁻¹ (y - W φ) and the decimator; returns ∂(W φ - y)/∂g (M, rows, K)
            and (∂W/∂g)ᵀ R⁻¹ (y - W φ) (b, K).
        samples: at the full rate; longer recordings are represented by pieces.
    """
    say, how = progress or (lambda words: None), estimator(found)
    p, decimator = len(how.pull), common_decimator(cases, found.settings)
    step = -(-sum(len(case.motion) for case in cases) // samples)
    used: list[ObservationRows] = []
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    instruments: list[np.ndarray] = []
    own_rows = found.fitted.instruments or tuple((case, part, None) for part, case in zip(found.rows, cases))
    for case, part, z in own_rows:
        for number, (own, span) in enumerate(pieces(case, decimator, step)):
            say(f"sensitivity to the geometry: {case.name}, part {number + 1}")
            used.append(cut(part, own))
            residual = used[-1].target - used[-1].matrix @ found.fitted.estimate.values
            change, pull = differences(case, span, residual * used[-1].weight ** 2 / how.deviation**2, decimator)
            all_rows = np.broadcast_to(change, (*residual.shape, change.shape[2]))  # power: rows by recording
            parts.append((all_rows.reshape(-1, change.shape[2]), pull))
            instruments += [] if z is None else [z[own].reshape(-1, p)]
    matrix, scale = (np.concatenate(x) for x in zip(*[(stacked(part), weights(how, part)) for part in used]))
    change, pulled = np.concatenate([x for x, _ in parts]), sum(pull for _, pull in parts)
    share = float(np.count_nonzero(scale) / sum(np.count_nonzero(part.present) for _, part, _ in own_rows))
    known = np.sqrt(share) * np.pad(how.beforehand, ((0, 0), (0, change.shape[1])))
    if instruments:
        factor = retriangulate(np.hstack([np.concatenate(instruments), matrix, change]) * scale[:, None])[:p, p:]
        unit = np.linalg.norm(factor[:, :p], axis=0)
        again = -np.linalg.solve(factor[:, :p] / unit, factor[:, p:]) / unit[:, None]
    else:
        factor = retriangulate(np.vstack([known, np.hstack([matrix, change]) * scale[:, None]]))
        inverse = inverted(factor[:p, :p])
        again = inverse @ (inverse[: found.base.b].T @ pulled - factor[:p, p:])
    seen = scale > 0.0
    after = change + matrix @ again
    return again, _rms(change[seen]), _rms(after[seen])


def _neighbours(found: Identification, chain: Chain) -> list[tuple[Bodies, Bodies]]:
    """Return pairs of bodies with one geometric element or one tilt of gravity changed by `STEP` up and down."""

    def moved(step: np.ndarray) -> Bodies:
        return make_bodies(chain.with_values(np.array(chain.values) + step), found.settings)

    def tilted(turn: np.ndarray) -> Bodies:
        gravity = Rotation.from_rotvec(turn).apply(np.array(found.dynamics.model.bodies.gravity))
        return make_bodies(chain, replace(found.settings, gravity=tuple(gravity.tolist())))

    elements, tilts = STEP * np.eye(len(chain.elements)), STEP * np.eye(3)[:2]
    return [*((moved(one), moved(-one)) for one in elements), *((tilted(one), tilted(-one)) for one in tilts)]


def pieces(case: Case, decimator: Decimator, step: int = 1, min_piece: int = 32) -> list[tuple[slice, slice]]:
    """Return (decimated rows, full-rate samples that they depend on) of every `step`-th piece of a case.

    With step 1 each segment is one piece.

    `min_piece`: thinned samples of such a piece at least.
    """
    result, first, h, r = [], 0, decimator.reach, decimator.factor
    size = max(4096 // r, min_piece)
    for start, stop in segments(case.motion.segment):
        count = len(kept(np.zeros(stop - start, dtype=int), decimator))
        length = max(count, 1) if step == 1 else size
        for number, i in enumerate(range(0, count, length)):
            if number % step:
                continue
            rows = min(length, count - i)
            begin = start + i * r
            result.append((slice(first + i, first + i + rows), slice(begin, begin + (rows - 1) * r + 2 * h + 1)))
        first += count
    return result


def _differences(
    found: Identification,
    moved: Sequence[tuple[Bodies, Bodies]],
    case: Case,
    span: slice,
    residual: np.ndarray,
    decimator: Decimator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return (∂W/∂g) φ (M, rows, K + 2), filtered and decimated, and (∂W/∂g)ᵀ R⁻¹ (y - W φ) (b, K + 2).

    Args:
        residual: (M, rows) R⁻¹ (y - W φ) of the rows that the samples in `span` make.
    """
    model, b = found.dynamics.model, found.base.b
    bodies = model.inertial
    onboard = model.carried_columns(case.carried)
    parameters = found.base.to_standard(found.fitted.estimate.values[:b])[:bodies] * onboard
    q, v, a = (np.asarray(x[span]) for x in case.links)
    torque_rows, felt = model.torque_rows, spread(residual, decimator, len(q))[:, :, None]
    if torque_rows.projection is not None:  # which no geometry changes
        felt = np.einsum("nrk,nrc->nkc", torque_rows.projection.torques(q, v), felt)
    felt = replace(torque_rows, projection=None).fold(felt, (BODIES,))[:, :, 0]
    change = np.zeros((len(moved), model.bodies.n, len(q)))
    pulled = np.zeros((bodies, len(moved)))
    block = 256  # samples at a time: the regressor of so many stays in the processor's cache
    for start in range(0, len(q), block):
        part = slice(start, min(start + block, len(q)))
        weights = np.ascontiguousarray(felt[part].T).ravel()
        out = np.zeros((bodies, model.bodies.n, min(block, len(q) - start)))  # what is zero is so in all of them
        regressor = out.reshape(bodies, -1)
        for k, both in enumerate(moved):
            for one, factor in zip(both, (0.5 / STEP, -0.5 / STEP)):
                rigid_body.fill_regressor(one, q[part], v[part], a[part], out)
                change[k, :, part] += factor * (parameters @ regressor).reshape(model.bodies.n, -1)
                pulled[:, k] += factor * (regressor @ weights)
    rows = model.torque_rows.observe(change.transpose(2, 1, 0), (BODIES,) * len(moved), q, v)
    inertial = found.base.kept < bodies
    result = np.zeros((b, len(moved)))
    result[inertial] = (pulled * onboard[:, None])[found.base.kept[inertial]]
    return decimate(rows, decimator), result


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(values**2, axis=0))


@dataclass(frozen=True, eq=False)
class GeometryComparison:
    """Two estimates from the same torques, on two geometries.

    Attributes:
        names, units: names and units of the p parameters.
        values: (2, p) on the nominal (CAD) and on the calibrated geometry.
        sigma: (2, p) of both: from torque noise alone on the nominal, total on the calibrated geometry.
        difference: (p,) standard deviation of the difference: the geometry's part, and the small part of the noise that
            the two estimates do not share.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    sigma: np.ndarray
    difference: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """Relative difference (p,): 100 (nominal - calibrated) / |calibrated| [%]; NaN at zero."""
        with np.errstate(divide="ignore", invalid="ignore"):
            found = 100.0 * (self.values[0] - self.values[1]) / np.abs(self.values[1])
        return np.where(self.values[1] == 0.0, np.nan, found)


def compare(
    found: Identification, carried: GeometryUncertainty, nominal: Chain, cases: Sequence[Case]
) -> GeometryComparison:
    """Return the comparison of the estimate with one from the same torques on the nominal geometry.

    Both by weighted least squares with the same weights; the difference is added to the estimate that there is.
    """
    how, noise = estimator(found), np.array(found.fitted.std) * np.sqrt(found.fitted.inflation)
    both = (rows_on(found, nominal, [replace(case, link=None) for case in cases]), found.rows)
    (first, inverse), (second, own) = (estimate(how, rows) for rows in both)
    values = np.asarray(found.fitted.estimate.values)
    alone, apart = np.zeros(len(values)), np.array(carried.sigma_geometry**2)
    chunk = 2000  # thinned samples at a time, where each needs its own line of a matrix
    for one, other in zip(*both):
        for start in range(0, len(one.target), chunk):
            part = slice(start, start + chunk)
            gain, ours = (
                matrix @ (stacked(cut(rows, part)) * weights(how, cut(rows, part), how.deviation**2)[:, None]).T
                for matrix, rows in ((inverse, one), (own, other))
            )
            spread_of = np.tile(noise, len(one.target[part]))
            alone += np.sum((gain * spread_of) ** 2, axis=1)
            apart += np.sum(((gain - ours) * spread_of) ** 2, axis=1)
    return GeometryComparison(
        found.names,
        found.fitted.estimate.units,
        frozen(np.stack([values + first - second, values])),
        frozen(np.stack([np.sqrt(alone), carried.sigma])),
        frozen(np.sqrt(apart)),
    )

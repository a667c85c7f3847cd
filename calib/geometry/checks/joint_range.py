"""Joint range in which a fit is valid: measured range of the joints, and σ of the target over the whole joint range.

A fit to poses of one region determines the parameters that move the target in that region. In other regions, other
combinations of parameters matter. The uncertainty given the data and the prior of making
(`calib.geometry.fit.PLAUSIBLE`, the plausible deviations of a manufactured arm from nominal) is the posterior
covariance

    C = (Wᵀ W + Λ)⁻¹,   σ² = tr(J C Jᵀ),

with W the whitened observation matrix of all rigid parameters, Λ the precision of the prior of making and J the
target's Jacobian at random postures within the joint limits.
"""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from calib.data.poses.measurements import Positions
from calib.errors import CalibError
from calib.geometry.accuracy import errors
from calib.geometry.fit import plausible_deviation, polish_frames
from calib.geometry.installation import Installation
from calib.geometry.observation import layout, pose_sigmas, positions, prepare, whitened
from calib.geometry.weighing import GeometricFit
from calib.robot.chain import random_joints

# number of random postures by which a fit is judged over the whole joint range
POSTURES = 300
# a joint that moved by less was at rest [rad, m]; in random postures it keeps its measured value
STILL = 1e-3
# smallest precision relative to the largest one, for placements, which have no prior
MIN_PRECISION = 1e-12


@dataclass(frozen=True)
class JointRange:
    """Range of the joints in which a fit was made, and its expected error over the whole joint range.

    Attributes:
        joints, units: (n,) names of the joints, and ``rad`` or ``m``.
        lower, upper: (n,) smallest and largest measured joint values [rad or m].
        shares: (n,) measured range divided by the joint's whole range (at most one turn).
        sigma: rms over the whole range of σ of the target's position [m]; None where no positions were measured.
        nominal: rms error of the nominal arm over the whole range, if the calibrated arm is true [m]; None where no
            positions were measured.
        left: rms residual of the rigid arm at the fitted poses [m].
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    shares: tuple[float, ...]
    sigma: float | None
    nominal: float | None
    left: float

    @property
    def moved(self) -> list[int]:
        """Indices of the joints that moved during the measurement."""
        return [j for j, (low, high) in enumerate(zip(self.lower, self.upper)) if high - low > STILL]


def joint_range(fit: GeometricFit, nominal: Installation) -> JointRange:
    """Return the joint range of a rigid fit, with σ over the whole range.

    Args:
        fit: the fit without joint corrections.
        nominal: the nominal arm, with stations and tools fitted to the same rows.
    """
    chain = fit.cell.chain
    blocks = [block.measured for block in fit.blocks]
    q = np.concatenate([block.q for block in blocks])
    low = q.min(axis=0)
    high = q.max(axis=0)
    lower, upper = chain.sampling_limits()
    turn = np.array([np.inf if joint.kind == "prismatic" else 2.0 * np.pi for joint in chain.joints])
    full_range = np.maximum(np.minimum(upper - lower, turn), STILL)
    shares = np.minimum((high - low) / full_range, 1.0)
    sigma = nominal_error = None
    if any(isinstance(block, Positions) for block in blocks):
        postures = random_joints(chain, POSTURES)
        stood = high - low <= STILL
        postures[:, stood] = np.median(q, axis=0)[stood]
        sigma = float(np.sqrt(np.mean(sigma_at(fit.cell, fit, postures) ** 2)))
        nominal_error = _nominal_error(fit, nominal, postures)
    units = tuple(joint.unit for joint in chain.joints)
    return JointRange(
        joints=chain.joint_names,
        units=units,
        lower=tuple(low.tolist()),
        upper=tuple(high.tolist()),
        shares=tuple(shares.tolist()),
        sigma=sigma,
        nominal=nominal_error,
        left=errors(fit.cell, blocks).rms,
    )


def sigma_at(cell: Installation, fit: GeometricFit, q: np.ndarray) -> np.ndarray:
    """Return σ of the first target's position (m,) [m] at postures q (m, n), in its station's frame.

    If all rigid parameters were candidates of the fit, σ is computed from the fit's covariance. Otherwise it is
    computed from the posterior covariance given the fit's data and the prior of making
    (`calib.geometry.fit.PLAUSIBLE`).

    Args:
        cell: installation of the arm whose target is predicted: the calibrated or the nominal one.
        fit: the rigid fit, with its data and its covariance.
        q: (m, n) joint values [rad or m].
    """
    table = layout(cell)
    columns = table.rigid_index
    arm = np.intersect1d(columns, table.index("arm"))
    # of these, what the fit leaves at nominal has no effect, or displaces base or tool, which the fit places
    if fit.prior is not None and np.isin(arm, fit.candidates).all():
        columns = fit.free
        covariance = fit.estimate.covariance
    else:
        covariance = _posterior(cell, fit, columns)
    return pose_sigmas(cell, _positions_at(cell, fit, q), columns, covariance)[:, 0]


def _posterior(cell: Installation, fit: GeometricFit, columns: np.ndarray) -> np.ndarray:
    """Return the posterior covariance (c, c) of the parameters `columns` (c,).

    It follows from the data of the fit and the prior of making.

    Args:
        cell: the installation at which the derivatives are computed.
        fit: the fit whose measurements are the data.
        columns: (c,) indices in the full parameter vector (`calib.geometry.observation`).
    """
    square = np.zeros((len(columns), len(columns)))
    for number, block in enumerate(fit.blocks):
        pieces = [piece for piece in fit.pieces if piece.block == number]
        scales = [piece.sigma / np.sqrt(piece.weight) for piece in pieces]
        noises = [piece.part.noise for piece in pieces]
        for _, matrix in whitened(cell, block, columns, scales, noises):
            square += matrix.T @ matrix
    square /= fit.estimate.residual_std**2
    precision = plausible_deviation(cell, columns) ** -2.0
    ridge = MIN_PRECISION * float(np.diag(square).max())
    return scipy.linalg.inv(square + np.diag(precision + ridge))


def _positions_at(cell: Installation, fit: GeometricFit, q: np.ndarray) -> Positions:
    """Return positions of the first target as an installation predicts them at postures q (m, n) [rad or m].

    They have the form of measurements, so that functions on measurements can be applied to them.

    Args:
        cell: the installation.
        fit: the fit, whose first block of positions provides the names of target and station.
        q: (m, n) joint values [rad or m].
    """
    measured = next(block.measured for block in fit.blocks if isinstance(block.measured, Positions))
    block = Positions(
        q,
        measured.joint_names,
        position=np.zeros((len(q), 3)),
        tool_names=measured.tool_names[:1],
        station=measured.station,
    )
    (prepared,) = prepare(cell, [block])
    return replace(block, position=positions(cell, prepared).T)


def _nominal_error(fit: GeometricFit, nominal: Installation, q: np.ndarray) -> float | None:
    """Return the nominal arm's rms error [m] at postures q (m, n), if the calibrated arm is true.

    None where this error cannot be computed.

    Args:
        fit: the fit of the calibrated arm.
        nominal: the nominal arm; its base and tool placement are fitted to the calibrated arm's positions.
        q: (m, n) joint values [rad or m].
    """
    block = _positions_at(fit.cell, fit, q)
    with suppress(CalibError):
        placed = polish_frames(nominal, [block]).cell
        return errors(placed, [block]).rms
    return None

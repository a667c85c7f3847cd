"""Drive gains of a parallel robot from currents, by runs without and with a payload of known mass.

No model determines the proportions in which redundant actuators share the forces. The forces on the platform are
determined,

    J_p^invᵀ diag(i) K = W χ + P χ_L,    an entry of χ_L known

(Briot, Gautier & Krut 2013, eq. 24; Gautier & Briot 2011). The columns of the gains K contain the noise σ_k of the
currents, which is taken from their part above the identification band (our choice). It gives row r the variance
m_r = Σ_k K_k² σ_k² mean(J_kr²), so that

    min Σ_r ‖J_rᵀ diag(i) K - W_r χ - P_r χ_L‖² / m_r(K)

is a total least-squares problem: the noise's contribution to the sum does not depend on K. With a constant m_r, noise
would bias K towards zero.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from calib.data.signals.filtering import decimate
from calib.dynamics import base as bases
from calib.errors import NotConverged, Unidentifiable, UsageError
from calib.estimation.triangles import Triangles
from calib.identification.gains import DriveGains
from calib.identification.identify import common_decimator, find_base
from calib.identification.prior import residual_inflation
from calib.identification.rows import Case, ObservationRows, observe, pool, triangulate, with_blocks
from calib.identification.settings import IdentificationSettings
from calib.parallel.identification import model_of
from calib.parallel.mechanism.closure import closed
from calib.parallel.mechanism.parallel_model import PLATFORM, rows_named
from calib.parallel.mechanism.parallel_robot import ParallelRobot
from calib.parallel.mechanism.velocities import loop_jacobians
from calib.records import frozen

# Largest number of Gauss–Newton steps of the total least squares, and relative step at which it has converged.
MAX_ROUNDS = 100
SETTLED = 1e-9
# Share of the mean noise that is added to each current's noise, which may be zero in simulations.
MIN_NOISE_SHARE = 1e-12


def drive_gains(
    robot: ParallelRobot,
    cases: Sequence[Case],
    settings: IdentificationSettings,
    known_values: Mapping[str, float],
    reference: int | None,
) -> DriveGains:
    """Return the drive gains of a parallel robot with their covariance.

    Each sigma is the larger of two: from the residuals, and from a jackknife that omits a block of time in turn (Efron
    & Tibshirani 1993, eq. 11.5). The jackknife includes a part of the model's error.

    Args:
        robot: the robot.
        cases: recordings whose targets (N, n) are the actuators' currents [A].
        settings: settings of the identification.
        known_values: values of known parameters of payloads by name, in SI.
        reference: index of the joint relative to which a serial arm's gains are identified; not None is refused.

    Raises:
        UsageError: without a known payload, or if no recording distinguishes the payload.
    """
    if reference is not None:
        raise UsageError(
            "currents without gains: state gains = [...] (N m/A), or identify them with [gain_identification], runs "
            "without and with a payload of known mass"
        )
    mechanism = closed(robot)
    platform_rows = rows_named(mechanism, PLATFORM)
    model = model_of(mechanism, replace(settings, torque_rows=platform_rows))
    samples = bases.random_samples(model, seed=settings.seed)
    base = find_base(model, cases, samples)
    names = [model.names[k] for k in base.kept]
    missing = [name for name in known_values if name not in names]
    if missing:
        raise UsageError(f"'{missing[0]}' is not separately identifiable from these runs; was the payload attached?")
    decimator = common_decimator(cases, settings)
    rows = []
    squares = []
    noises = []
    is_known = [name in known_values for name in names]
    fixed = np.array(is_known)
    stated_values = [known_values.get(name, 0.0) for name in names]
    drive_values = np.array(stated_values)
    for case in cases:
        motion = case.motion
        posture = mechanism.locate(motion.q)
        jacobians = loop_jacobians(mechanism, posture)
        J = jacobians.readings.transpose(0, 2, 1)
        currents = J * case.target[:, None]
        rows_kind = model.torque_rows
        present = rows_kind.of_joints(case.present)
        projected = replace(case, target=currents.sum(axis=2), torque_rows=rows_kind, present=present)
        row_set = observe(model, base.kept, projected, decimator)
        # Unknown are the gains of the currents, and the parameters without stated value.
        currents = decimate(currents, decimator, motion.segment)
        free_columns = row_set.matrix[:, :, ~fixed]
        matrix = np.concatenate([currents, -free_columns], axis=2)
        unknowns = (*robot.joint_names, *np.array(names)[~fixed])
        target = row_set.matrix @ drive_values
        units = ("",) * matrix.shape[2]
        gain_rows = replace(row_set, matrix=matrix, target=target, names=unknowns, units=units)
        rows.append(gain_rows)
        squares.append(np.mean(J**2, axis=0))
        out_of_band = case.target - motion.in_band(case.target)
        noises.append(np.mean(out_of_band**2, axis=0))
    noise = np.mean(noises, axis=0) + MIN_NOISE_SHARE * np.mean(noises)
    squares = noise * np.mean(squares, axis=0)
    folds = max(settings.folds, 2 * len(cases))
    data = triangulate(with_blocks(rows, folds))
    solution = _total_least_squares(data, squares, rows)

    # jackknife over the blocks of time
    replicates = []
    has_rows = data.rows.reshape(-1, len(squares)).any(axis=1)
    blocks = np.flatnonzero(has_rows).tolist()
    for block in blocks:
        without_block = [k for k in blocks if k != block]
        # Raised where the block contains the only run with the payload.
        with suppress(NotConverged, Unidentifiable):
            replicate = _total_least_squares(data, squares, rows, without_block)
            replicates.append(replicate.gains)
    variance = np.var(replicates, axis=0)
    jackknife = np.sqrt((len(replicates) - 1) * variance)
    sigmas = np.sqrt(np.diag(solution.covariance))
    wider = np.maximum(1.0, jackknife / sigmas)

    values = np.zeros(len(names))
    values[fixed] = drive_values[fixed]
    values[~fixed] = solution.remaining
    scale = ", ".join(f"{name} = {value:g}" for name, value in known_values.items())
    covariance = solution.covariance * np.outer(wider, wider)
    sigma = np.sqrt(solution.share * noise)
    return DriveGains(frozen(solution.gains), frozen(covariance), tuple(names), frozen(values), frozen(sigma), scale)


class _Solution(NamedTuple):
    """Solution of the total least squares.

    Attributes:
        gains, covariance: gains (n,) and their covariance (n, n).
        remaining: (b,) values of the other unknown parameters.
        share: ratio of the rows' residual variance to the variance that the currents' noise predicts.
    """

    gains: np.ndarray
    covariance: np.ndarray
    remaining: np.ndarray
    share: float


def _total_least_squares(
    data: Triangles, squares: np.ndarray, rows: Sequence[ObservationRows], blocks: Sequence[int] | None = None
) -> _Solution:
    """Return the solution for rows whose first n columns are the currents on the platform's r coordinates.

    Args:
        data: triangles of the rows by block and coordinate.
        squares: (r, n) σ² mean(J²), the variance of a coordinate's rows per squared gain, due to each current's noise.
        rows: the rows, from which the autocorrelation of the residuals is estimated.
        blocks: numbers of the blocks that enter; None: all.

    Raises:
        NotConverged: if the gains do not converge.
        Unidentifiable: if the rows do not identify all unknowns.
    """
    n = squares.shape[1]
    data = pool(data, len(squares), blocks)
    factors = np.array(data.factors)
    norms = np.linalg.norm(factors, axis=(0, 1))
    size = np.maximum(norms, 1e-300)
    size[-1] = 1.0
    factors /= size
    matrix = factors[:, :, :-1]
    target = factors[:, :, -1]
    flat = matrix.reshape(-1, matrix.shape[2])
    x = np.linalg.lstsq(flat, target.ravel(), rcond=1e-12)[0]
    tau = residual_inflation(rows, x / size[:-1])
    rounds = 0
    while True:
        rounds += 1
        gain = x[:n] / size[:n]
        scatter = squares @ gain**2
        residual = matrix @ x - target
        weigh = 1.0 / np.sqrt(scatter * tau)[:, None]
        # derivative of the weighted residual by the gains: the weight depends on them, too
        slopes = matrix.copy()
        share = gain * squares / scatter[:, None] / size[:n]
        slopes[:, :, :n] -= residual[:, :, None] * share[:, None]
        weighted_slopes = slopes * weigh[:, :, None]
        flat = weighted_slopes.reshape(-1, len(x))
        weighted = (residual * weigh).ravel()
        step = np.linalg.lstsq(flat, -weighted, rcond=1e-12)[0]
        x = x + step
        largest_step = np.abs(step[:n]).max()
        if largest_step < SETTLED * np.abs(x[:n]).max():
            break
        if rounds == MAX_ROUNDS:
            message = "the drive gains do not converge; check that the payload moves with every actuator"
            raise NotConverged(message, gain)
    if np.linalg.matrix_rank(flat, rtol=1e-10) < len(x):
        raise Unidentifiable("these runs do not identify the drive gains: record richer motion", data.names[:n])
    inverse = np.linalg.pinv(flat) / size[:-1, None]
    independent_rows = (data.rows / tau).sum()
    variance = float(weighted @ weighted) / max(independent_rows - len(x), 1.0)
    weighted_square = np.sum(residual**2 / scatter[:, None])
    share_of_noise = weighted_square / max(data.rows.sum() - len(x), 1)
    gains = x[:n] / size[:n]
    remaining = x[n:] / size[n:-1]
    cofactors = inverse @ inverse.T
    covariance = variance * cofactors[:n, :n]
    return _Solution(gains, covariance, remaining, float(share_of_noise))

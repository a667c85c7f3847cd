"""Drive gains of a parallel robot from currents, by runs without and with a payload of known mass.

Redundant actuators share the forces in proportions that no model determines. Determined are the forces on the platform,

    J_p^invᵀ diag(i) K = W χ + P χ_L,    an entry of χ_L known

(Briot, Gautier & Krut 2013, eq. 24; Gautier & Briot 2011), with noise σ_k of the currents, taken from
their part above the identification band (our choice), in the columns of the gains K. It scatters row r by
m_r = Σ_k K_k² σ_k² mean(J_kr²), and

    min Σ_r ‖J_rᵀ diag(i) K - W_r χ - P_r χ_L‖² / m_r(K)

is a total least squares: what noise adds to the sum does not depend on K. With m_r constant, noise would bias K towards
zero.
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


def drive_gains(
    robot: ParallelRobot,
    cases: Sequence[Case],
    settings: IdentificationSettings,
    known_values: Mapping[str, float],
    reference: int | None,
) -> DriveGains:
    """Return the drive gains of a parallel robot; each sigma is the larger one of the residuals' and of a jackknife.

    The jackknife leaves out blocks of time (Efron & Tibshirani 1993, eq. 11.5) and so includes part of the model's
    error.

    Args:
        cases: recordings whose targets (N, n) are the actuators' currents [A].
        known: parameters of payloads whose values are known, in SI.
        reference: index of the joint to which gains would be relative without a known payload; refused here.

    Raises:
        UsageError: without a known payload, or if no recording distinguishes the payload.
    """
    if reference is not None:
        raise UsageError(
            "currents without gains: state gains = [...] (N m/A), or identify them with [gain_identification], runs "
            "without and with a payload of known mass"
        )
    mechanism = closed(robot)
    model = model_of(mechanism, replace(settings, torque_rows=rows_named(mechanism, PLATFORM)))
    base = find_base(model, cases, bases.random_samples(model, seed=settings.seed))
    names = [model.names[k] for k in base.kept]
    missing = [name for name in known_values if name not in names]
    if missing:
        raise UsageError(f"'{missing[0]}' is not separately identifiable from these runs; was the payload attached?")
    decimator = common_decimator(cases, settings)
    rows = []
    squares = []
    noises = []
    fixed = np.array([name in known_values for name in names])
    drive_values = np.array([known_values.get(name, 0.0) for name in names])
    for case in cases:
        motion = case.motion
        J = loop_jacobians(mechanism, mechanism.locate(motion.q)).readings.transpose(0, 2, 1)
        currents = J * case.target[:, None]
        rows_kind = model.torque_rows
        present = rows_kind.of_joints(case.present)
        projected = replace(case, target=currents.sum(axis=2), torque_rows=rows_kind, present=present)
        row_set = observe(model, base.kept, projected, decimator)
        # Unknown: gains of the currents, and the parameters that are not stated.
        currents = decimate(currents, decimator, motion.segment)
        matrix = np.concatenate([currents, -row_set.matrix[:, :, ~fixed]], axis=2)
        unknowns = (*robot.joint_names, *np.array(names)[~fixed])
        target = row_set.matrix @ drive_values
        units = ("",) * matrix.shape[2]
        rows.append(replace(row_set, matrix=matrix, target=target, names=unknowns, units=units))
        squares.append(np.mean(J**2, axis=0))
        out_of_band = case.target - motion.in_band(case.target)
        noises.append(np.mean(out_of_band**2, axis=0))
    noise = np.mean(noises, axis=0) + 1e-12 * np.mean(noises)
    squares = noise * np.mean(squares, axis=0)
    folds = max(settings.folds, 2 * len(cases))
    data = triangulate(with_blocks(rows, folds))
    solution = _total_least_squares(data, squares, rows)
    pseudo_values = []
    blocks = np.flatnonzero(data.rows.reshape(-1, len(squares)).any(axis=1)).tolist()
    for block in blocks:
        without_block = [k for k in blocks if k != block]
        # without the only run that carries the payload
        with suppress(NotConverged, Unidentifiable):
            pseudo_values.append(_total_least_squares(data, squares, rows, without_block).gains)
    jackknife = np.sqrt((len(pseudo_values) - 1) * np.var(pseudo_values, axis=0))
    wider = np.maximum(1.0, jackknife / np.sqrt(np.diag(solution.covariance)))
    values = np.zeros(len(names))
    values[fixed] = drive_values[fixed]
    values[~fixed] = solution.remaining
    scale = ", ".join(f"{name} = {value:g}" for name, value in known_values.items())
    covariance = solution.covariance * np.outer(wider, wider)
    sigma = np.sqrt(solution.share * noise)
    return DriveGains(frozen(solution.gains), frozen(covariance), tuple(names), frozen(values), frozen(sigma), scale)


class _Solution(NamedTuple):
    """Gains (n,) with covariance (n, n), other parameters (b,), and the share of the currents' noise in the rows."""

    gains: np.ndarray
    covariance: np.ndarray
    remaining: np.ndarray
    share: float


def _total_least_squares(
    data: Triangles, squares: np.ndarray, rows: Sequence[ObservationRows], blocks: Sequence[int] | None = None
) -> _Solution:
    """Return the solution for rows whose first n columns are the currents on the platform's coordinates.

    Args:
        data: triangles of the rows by block and coordinate; blocks: that count, None: all.
        squares: (r, n) σ² mean(J²) of each current's noise.
    """
    n = squares.shape[1]
    data = pool(data, len(squares), blocks)
    factors = np.array(data.factors)
    size = np.maximum(np.linalg.norm(factors, axis=(0, 1)), 1e-300)
    size[-1] = 1.0
    factors /= size
    matrix = factors[:, :, :-1]
    target = factors[:, :, -1]
    flat = matrix.reshape(-1, matrix.shape[2])
    x = np.linalg.lstsq(flat, target.ravel(), rcond=1e-12)[0]
    tau = residual_inflation(rows, x / size[:-1])
    max_rounds = 100
    rounds = 0
    while True:
        rounds += 1
        gain = x[:n] / size[:n]
        scatter = squares @ gain**2
        residual = matrix @ x - target
        weigh = 1.0 / np.sqrt(scatter * tau)[:, None]
        slopes = matrix.copy()
        share = gain * squares / scatter[:, None] / size[:n]
        slopes[:, :, :n] -= residual[:, :, None] * share[:, None]
        flat = (slopes * weigh[:, :, None]).reshape(-1, len(x))
        weighted = (residual * weigh).ravel()
        step = np.linalg.lstsq(flat, -weighted, rcond=1e-12)[0]
        x = x + step
        if np.abs(step[:n]).max() < 1e-9 * np.abs(x[:n]).max():
            break
        if rounds == max_rounds:
            message = "the drive gains do not converge; check that the payload moves with every actuator"
            raise NotConverged(message, gain)
    if np.linalg.matrix_rank(flat, rtol=1e-10) < len(x):
        raise Unidentifiable("these runs do not identify the drive gains: record richer motion", data.names[:n])
    inverse = np.linalg.pinv(flat) / size[:-1, None]
    variance = float(weighted @ weighted) / max((data.rows / tau).sum() - len(x), 1.0)
    weighted_square = np.sum(residual**2 / scatter[:, None])
    squared = weighted_square / max(data.rows.sum() - len(x), 1)
    gains = x[:n] / size[:n]
    covariance = variance * (inverse @ inverse.T)[:n, :n]
    return _Solution(gains, covariance, x[n:] / size[n:-1], float(squared))

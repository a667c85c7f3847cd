"""Drive gains from currents: torque = gain · current, identified from runs without and with a payload of known mass.

A model fitted to currents is known up to one scale per joint. Parameters that affect several joints (a link's mass
affects all joints before it) relate these scales to each other, and a payload of known mass determines them (Gautier &
Briot 2011, 2014):

    K_j i_j = W_j χ  (unloaded),    K_j i_j = W_j χ + P_j χ_L  (loaded),    one entry of χ_L known.

Gautier & Briot solve the homogeneous system by total least squares (TLS), because the noise is in the currents. If the
noise of joint j is only in i_j, the problem is the weighted nonlinear one

    min Σ_j ‖i_j - [W_j P_j] x / K_j‖² / σ_j²,

which is solved here by Gauss–Newton on triangles, with σ_j re-estimated in each step. Least squares with the currents
as columns gives the start (our choice: unstructured TLS assumes noise of every joint's current in every row).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import NotConverged, Unidentifiable
from calib.estimation.triangles import Triangles, retriangulate
from calib.identification.rows import pool
from calib.records import Array, frozen

LEFT = 1.6
"""Factor by which relative gains are further off than noise and blocks of time show.

What the model leaves moves them alike all along a recording: 13 gains of a UR10e, of four recordings, are rms 1.6 such
sigmas from the maker's.
"""
ROUNDING = 1e-9
"""Sigma of a gain that is set, in units of the gain: rounding."""
MAX_ROUNDS = 60
"""Rounds of Gauss and Newton."""
MAX_LOG_STEP = 0.7
"""Largest step of the logarithm of a gain."""
CONVERGED = 1e-7
"""Step of the logarithms of the gains at which the search has converged."""
MAX_SIGMA = 0.3
"""Sigma of a relative gain, in units of the gain, up to which the motion identifies it (our choice)."""
MAX_FACTOR = 10.0
"""Factor between gains of one robot's motors beyond which one counts as not identified (our choice)."""
MIN_START = 0.05
"""Least start value of a gain, in units of the median of all."""


@dataclass(frozen=True, eq=False)
class DriveGains:
    """Estimated drive gains with covariance, and the other parameters of the fit.

    Attributes:
        gains: (n,) torque per current [N m/A or N/A].
        covariance: (n, n) covariance of the gains.
        names, values: all parameters in torque units: base parameters and the payload's.
        std: (n,) standard deviation of the residual currents [A].
        scale: text on what determines the scale.
        own: joints, from 0, whose gain the motion does not identify; it is set to 1, so that the joint's torque is in
            amperes.
    """

    gains: np.ndarray
    covariance: np.ndarray
    names: tuple[str, ...]
    values: np.ndarray
    std: np.ndarray
    scale: str
    own: tuple[int, ...] = ()

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations of the gains (n,) [N m/A or N/A]."""
        return np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))

    @property
    def told(self) -> tuple[str, ...]:
        """Status of each gain: ``told`` (identified), ``not told``, or ``reference`` (other gains relative to it)."""
        status = []
        for joint, (gain, sigma) in enumerate(zip(self.gains, self.sigma)):
            if joint in self.own:
                status.append("not told")
            elif sigma < ROUNDING * gain:
                status.append("reference")
            else:
                status.append("told")
        return tuple(status)


@dataclass(frozen=True, eq=False)
class GainRecord:
    """Record of drive gains in files, by joint: torque = gain · current.

    Attributes:
        values: (n,) gains; NaN if the motion does not identify a gain, so that this joint's torque is in amperes.
        sigma: (n,) standard deviations; NaN for the reference joint and for gains that are not identified.
        told: status of each gain, as in `DriveGains.told`.
        covariance: (n, n) covariance of the gains.
        unit, scale: unit of the gains, and what determines their scale.
    """

    values: Array
    sigma: Array
    told: tuple[str, ...]
    covariance: Array
    unit: str
    scale: str

    @classmethod
    def of(cls, gains: DriveGains, unit: str) -> GainRecord:
        """Return the record of estimated gains; `unit` is the unit of torques."""
        status = np.array(gains.told)
        values = np.where(status == "not told", np.nan, gains.gains)
        sigma = np.where(status == "told", gains.sigma, np.nan)
        return cls(
            values=values,
            sigma=sigma,
            told=gains.told,
            covariance=gains.covariance,
            unit=f"{unit} per A",
            scale=gains.scale,
        )


def identify_gains(
    currents: Triangles,
    payload: Mapping[str, float],
    inflation: np.ndarray | None = None,
    start: Sequence[float] | None = None,
    reference: int | None = None,
    own: Sequence[int] = (),
) -> DriveGains:
    """Return the drive gains estimated from R factors of [W P | i], one group per joint.

    W are the columns of the robot's base parameters, P those of the payload's parameters, i the currents.

    Args:
        currents: R factors with the columns of a model with payload, and the currents as target.
        payload: parameters of known value (a payload's mass, its centre of mass), in SI units.
        inflation: (n,) variance inflation, i.e. number of rows that count as one; None: 1.
        start: (n,) first guess of the gains; None: from least squares with the torques of the known parameters.
        reference: joint whose gain is set to 1 if no parameter is known: other gains are relative to it, and torques
            are in amperes of that joint. None: `payload` determines the scale.
        own: joints whose gain is fixed at 1, so that their torque is in amperes.

    Raises:
        Unidentifiable: without a known parameter and reference.
        NotConverged: if the iteration does not converge, e.g. because the payload does not load every joint.
    """
    n, names = currents.groups, currents.names
    fixed = np.array([names.index(name) for name in payload], dtype=int)
    free = np.setdiff1d(np.arange(len(names)), fixed)
    fixed_values = np.array([payload[names[column]] for column in fixed])
    if reference is None and (not len(fixed) or not np.any(fixed_values)):
        raise Unidentifiable(
            "gains need a payload of known mass: without it, currents identify torques only up to a scale", names
        )
    if inflation is None:
        inflation = np.ones(n)

    # Columns in units of their norm; what the known parameters contribute to the torque.
    factors = np.array(currents.factors)
    norms = np.linalg.norm(factors[:, :, free], axis=(0, 1))
    norms = np.where(norms > 0.0, norms, 1.0)
    columns = factors[:, :, free] / norms
    load = factors[:, :, fixed] @ fixed_values
    current = factors[:, :, -1]
    if start is not None:
        gains = np.array(start, dtype=float)
    elif reference is not None:
        gains = np.ones(n)
    else:
        gains = _start(columns, load, current)
    x = _parameters(columns, load, current, gains)
    fitted = [joint for joint in range(n) if joint != reference and joint not in own]
    moving = np.array(fitted, dtype=int)
    for _ in range(MAX_ROUNDS):
        torque = columns @ x + load
        residual = torque / gains[:, None] - current
        std = np.sqrt(np.sum(residual**2, axis=1) / currents.rows)
        # Derivatives by the logarithms of the gains.
        by_gain = np.zeros((n, factors.shape[1], n))
        by_gain[moving, :, moving] = -torque[moving] / gains[moving, None]
        by_x = columns / gains[:, None, None]
        rows = np.concatenate([by_x, by_gain, residual[:, :, None]], axis=2)
        noise = std * np.sqrt(inflation)
        rows = rows / noise[:, None, None]
        stacked = rows.reshape(-1, rows.shape[2])
        triangle = retriangulate(stacked)
        upper = triangle[:-1, :-1]
        solution = np.linalg.lstsq(upper, triangle[:-1, -1], rcond=1e-12)[0]
        step = -solution
        x_step = step[: len(free)]
        gain_step = step[len(free) :]
        largest = float(np.abs(gain_step).max())
        size = min(1.0, MAX_LOG_STEP / max(largest, 1e-12))
        x = x + size * x_step
        gains = gains * np.exp(size * gain_step)
        if largest < CONVERGED:
            break
    else:
        if reference is None:
            raise NotConverged("the drive gains do not converge; check that the payload loads every joint", gains)
        raise NotConverged(
            f"without gains or a payload of known mass, currents identify gains only through the coupling of joints, "
            f"relative to joint {reference + 1}; this motion does not identify them. State the gains (options: gains), "
            "or record runs without and with a payload ([gain_identification])",
            gains,
        )
    inverse = np.linalg.pinv(upper, rcond=1e-12)
    relative = (inverse @ inverse.T)[len(free) :, len(free) :]
    covariance = relative * np.outer(gains, gains)
    values = np.zeros(len(names))
    values[free] = x / norms
    values[fixed] = fixed_values
    if reference is None:
        scale = ", ".join(f"{name} = {value:g}" for name, value in payload.items())
    else:
        scale = f"gain of joint {reference + 1} = 1"
    return DriveGains(frozen(gains), frozen(covariance), names, frozen(values), frozen(std), scale, tuple(own))


def identify_relative_gains(data: Triangles, joints: int, inflation: np.ndarray, reference: int) -> DriveGains:
    """Return gains relative to the gain of a reference joint; gains that the motion does not identify are set to 1.

    The standard deviations are the larger of two, times `LEFT`: those from the residuals, and those of a jackknife over
    time blocks (Efron & Tibshirani 1993, eq. 11.5), which contain part of the model's errors. A gain counts as
    identified if its standard deviation is below `MAX_SIGMA` times the gain, and the gain is within a factor
    `MAX_FACTOR` of the median of all gains. At a wrist, torques shared with other joints are small compared with
    friction, so that a fit mistakes model errors for inertia (our choice). If the search does not converge, the gain
    that diverged most counts as not identified.

    Args:
        data: R factors of [W i] (columns of the base parameters, and currents) by time block and joint, group = block ·
            joints + joint.
        joints: number of joints.
        inflation: (joints,) variance inflation, i.e. number of rows that count as one.
        reference: joint whose gain is 1, from 0.

    Raises:
        NotConverged: if the search does not converge with any set of joints.
    """
    rows_of_block = np.asarray(data.rows).reshape(-1, joints).sum(axis=1)
    blocks = np.flatnonzero(rows_of_block).tolist()
    unidentified: tuple[int, ...] = ()
    while True:
        try:
            currents = pool(data, joints, blocks)
            fit = identify_gains(currents, {}, inflation, reference=reference, own=unidentified)
        except NotConverged as error:
            unidentified = (*unidentified, _most_distant(error, reference, unidentified))
            continue
        formal_sigma = fit.sigma / fit.gains
        jackknife_sigma = _jackknife(data, blocks, fit, inflation, reference, unidentified)
        sigma = LEFT * np.maximum(formal_sigma, jackknife_sigma)
        free = np.ones(joints, dtype=bool)
        free[[reference, *unidentified]] = False
        log_gains = np.log(fit.gains)
        distance = np.abs(log_gains - np.median(log_gains))
        by_distance = distance / np.log(MAX_FACTOR)
        doubt = np.where(free, np.maximum(sigma / MAX_SIGMA, by_distance), 0.0)
        if doubt.max() <= 1.0:
            estimated = free & (formal_sigma > 0.0)
            safe_sigma = np.where(formal_sigma > 0.0, formal_sigma, 1.0)
            factor = np.where(estimated, sigma / safe_sigma, 1.0)
            covariance = frozen(fit.covariance * np.outer(factor, factor))
            return replace(fit, covariance=covariance)
        unidentified = (*unidentified, int(np.argmax(doubt)))


def _jackknife(
    data: Triangles,
    blocks: Sequence[int],
    fit: DriveGains,
    inflation: np.ndarray,
    reference: int,
    unidentified: tuple[int, ...],
) -> np.ndarray:
    """Return jackknife standard deviations of the log gains (joints,); zero with fewer than three time blocks.

    Args:
        data: R factors by time block and joint.
        blocks: numbers of the time blocks, each omitted in turn.
        fit: gains from all blocks, with which each search starts.
        inflation: (joints,) variance inflation.
        reference: joint whose gain is 1, from 0.
        unidentified: joints whose gain is fixed at 1.
    """
    joints = len(fit.gains)
    if len(blocks) <= 2:
        return np.zeros(joints)
    log_gains = []
    for block in blocks:
        remaining = pool(data, joints, [other for other in blocks if other != block])
        try:
            start = fit.gains.tolist()
            part = identify_gains(remaining, {}, inflation, start, reference, unidentified)
            log_gains.append(np.log(part.gains))
        except NotConverged:
            log_gains.append(np.where(np.arange(joints) == reference, 0.0, np.inf))
    with np.errstate(invalid="ignore"):
        deviation = np.array(log_gains) - np.mean(log_gains, axis=0)
    squares = np.nan_to_num(deviation, nan=np.inf) ** 2
    factor = (len(blocks) - 1) / len(blocks)
    return np.sqrt(factor * np.sum(squares, axis=0))


def _most_distant(error: NotConverged, reference: int, unidentified: Sequence[int]) -> int:
    """Return the joint whose gain diverged most, which the motion does not identify.

    Args:
        error: failure of the search, with the last gains.
        reference: reference joint.
        unidentified: joints that are excluded already.

    Raises:
        NotConverged: `error` itself, if no joint remains.
    """
    gains = np.array(error.last, dtype=float)
    log_gains = np.nan_to_num(np.log(gains), nan=np.inf)
    distance = np.abs(log_gains - np.median(log_gains))
    distance[[reference, *unidentified]] = -1.0
    if not distance.max() >= 0.0:
        raise error
    return int(np.argmax(distance))


def _start(columns: np.ndarray, load: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Return start values of the gains by least squares of [i -W] [K; χ] = P m, which is biased towards zero.

    Args:
        columns: (n, rows, p) W, R factor of each joint.
        load: (n, rows) torques P m of the known parameters.
        current: (n, rows) currents i.
    """
    n, size, p = columns.shape
    matrix = np.zeros((n, size, n + p))
    for joint in range(n):
        matrix[joint, :, joint] = current[joint]
    matrix[:, :, n:] = -columns
    flat = matrix.reshape(-1, n + p)
    solution, *_ = np.linalg.lstsq(flat, load.ravel(), rcond=1e-12)
    gains = np.abs(solution[:n])
    median = float(np.median(gains))
    return np.where(gains > MIN_START * median, gains, max(median, 1e-3))


def _parameters(columns: np.ndarray, load: np.ndarray, current: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Return the least-squares parameters (p,) for given gains (n,).

    Args:
        columns: (n, rows, p) W, R factor of each joint.
        load: (n, rows) torques of the known parameters.
        current: (n, rows) currents.
        gains: (n,) torque per current.
    """
    matrix = columns / gains[:, None, None]
    target = current - load / gains[:, None]
    flat = matrix.reshape(-1, columns.shape[2])
    x, *_ = np.linalg.lstsq(flat, target.ravel(), rcond=1e-12)
    return x

"""Drive gains from currents: torque = gain · current, identified from runs without and with a payload of known mass.

A model fitted to currents is known up to a scale per joint; what joints share (a link's mass is felt by all before it)
ties the scales together, and a payload of known mass fixes them (Gautier & Briot 2011, 2014):

    K_j i_j = W_j χ  (unloaded),    K_j i_j = W_j χ + P_j χ_L  (loaded),    one entry of χ_L known.

Gautier & Briot solve the homogeneous system by total least squares, for the noise is in the currents. With the noise
of joint j only in i_j, that is the weighted nonlinear problem

    min Σ_j ‖i_j - [W_j P_j] x / K_j‖² / σ_j²,

which is solved here by Gauss and Newton on triangles, with σ_j settled; total least squares gives the start (our
choice: the unstructured TLS lets every joint's current be noisy in every row).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import NotConverged, Unidentifiable
from calib.estimation.triangles import Triangles, retriangulate
from calib.identification.rows import pool
from calib.records import Array, frozen

LEFT = 1.6  # by which relative gains are further off than noise and blocks of time show: what the model leaves moves
# them alike all along a recording. 13 gains of a UR10e, of four recordings, are rms 1.6 such sigmas from the maker's


@dataclass(frozen=True, eq=False)
class DriveGains:
    """Estimated drive gains with covariance, and the other parameters of the fit.

    Attributes:
        gains: (n,) torque per current [N m/A or N/A].
        covariance: (n, n).
        names, values: all parameters in torque units: base parameters and the payload's.
        std: (n,) of the residual currents [A].
        scale: text on what determines the scale.
        own: joints, from 0, whose gain the motion does not identify: set to one, torque in amperes.
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
        return np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))

    @property
    def told(self) -> tuple[str, ...]:
        """Status of each gain: identified (``told``), ``reference`` of the others, or unidentified (``not told``)."""
        sigma = self.sigma
        rounding = 1e-9  # sigma of a gain that is set, of it: rounding
        return tuple(
            "not told" if j in self.own else "reference" if sigma[j] < rounding * self.gains[j] else "told"
            for j in range(len(self.gains))
        )


@dataclass(frozen=True, eq=False)
class GainRecord:
    """Record of drive gains in files, by joint: torque = gain · current.

    Attributes:
        values: (n,); NaN where the motion does not identify the gain: that joint's torque is in amperes.
        sigma: (n,); NaN for the reference joint and where the gain is not identified.
        told: see `DriveGains.told`.
        covariance: (n, n).
        unit, scale: unit of the gains, and what determines their scale.
    """

    values: Array
    sigma: Array
    told: tuple[str, ...]
    covariance: Array
    unit: str
    scale: str

    @classmethod
    def of(cls, found: DriveGains, unit: str) -> GainRecord:
        """Return the record of estimated gains; `unit` is the torques' unit."""
        told = np.array(found.told)
        return cls(
            np.where(told == "not told", np.nan, found.gains),
            np.where(told == "told", found.sigma, np.nan),
            found.told,
            found.covariance,
            f"{unit} per A",
            found.scale,
        )


def identify_gains(
    currents: Triangles,
    known: Mapping[str, float],
    inflation: np.ndarray | None = None,
    start: Sequence[float] | None = None,
    reference: int | None = None,
    own: Sequence[int] = (),
) -> DriveGains:
    """Return the drive gains estimated from R factors of [W P | i], one group per joint.

    Args:
        currents: columns of the model with the payload, target the currents.
        known: parameters whose values are known (a payload's mass, its centre of mass), in SI.
        inflation: (n,) how many rows count as one.
        start: (n,) first guess of the gains; None: from least squares on the torques of the known ones.
        reference: where nothing is known, the joint whose gain is set to 1: the others follow relative to it, and
            torques come out in amperes of that joint.
        own: joints whose gain stays at one, their torque in amperes of their own.

    Raises:
        Unidentifiable: where nothing known is felt by a joint, directly or through others.
    """
    n, names = currents.groups, currents.names
    fixed = np.array([names.index(name) for name in known], dtype=int)
    free = np.setdiff1d(np.arange(len(names)), fixed)
    given = np.array([known[names[k]] for k in fixed])
    if reference is None and (not len(fixed) or not np.any(given)):
        raise Unidentifiable(
            "gains need a payload of known mass: without it, currents identify torques only up to a scale", names
        )
    tau = np.ones(n) if inflation is None else inflation
    factors = np.array(currents.factors)
    norms = np.linalg.norm(factors[:, :, free], axis=(0, 1))
    norms = np.where(norms > 0.0, norms, 1.0)
    body, load, current = factors[:, :, free] / norms, factors[:, :, fixed] @ given, factors[:, :, -1]
    if start is not None or reference is not None:
        gain = np.ones(n) if start is None else np.array(start, dtype=float)
    else:
        gain = _start(body, load, current)
    x = _parameters(body, load, current, gain)
    moving = np.array([j for j in range(n) if j != reference and j not in own], dtype=int)
    max_rounds = 60
    for _ in range(max_rounds):
        torque = body @ x + load
        residual = torque / gain[:, None] - current
        std = np.sqrt(np.sum(residual**2, axis=1) / currents.rows)
        by_gain = np.zeros((n, factors.shape[1], n))
        by_gain[moving, :, moving] = -torque[moving] / gain[moving, None]  # by log K_j
        rows = np.concatenate([body / gain[:, None, None], by_gain, residual[:, :, None]], axis=2)
        rows = rows / (std * np.sqrt(tau))[:, None, None]
        stacked = retriangulate(rows.reshape(-1, rows.shape[2]))
        upper = stacked[:-1, :-1]
        step = -np.linalg.lstsq(upper, stacked[:-1, -1], rcond=1e-12)[0]
        size = min(1.0, 0.7 / max(float(np.abs(step[len(free) :]).max()), 1e-12))
        x, gain = x + size * step[: len(free)], gain * np.exp(size * step[len(free) :])
        if np.abs(step[len(free) :]).max() < 1e-7:
            inverse = np.linalg.pinv(upper, rcond=1e-12)
            covariance = (inverse @ inverse.T)[len(free) :, len(free) :] * np.outer(gain, gain)
            values = np.zeros(len(names))
            values[free], values[fixed] = x / norms, given
            scale = ", ".join(f"{name} = {value:g}" for name, value in known.items())
            scale = scale if reference is None else f"gain of joint {reference + 1} = 1"
            return DriveGains(frozen(gain), frozen(covariance), names, frozen(values), frozen(std), scale, tuple(own))
    if reference is None:
        raise NotConverged("the drive gains do not converge; check that the payload loads every joint", gain)
    raise NotConverged(
        f"without gains or a payload of known mass, currents identify gains only through the coupling of joints, "
        f"relative to joint {reference + 1}; this motion does not identify them. State the gains (options: gains), "
        "or record runs without and with a payload ([gain_identification])",
        gain,
    )


def identify_relative_gains(data: Triangles, joints: int, inflation: np.ndarray, reference: int) -> DriveGains:
    """Return the gains relative to that of a reference joint; gains that the motion does not identify are set to one.

    Sigmas are the larger of the residuals' and of a jackknife over blocks of time (Efron & Tibshirani 1993, eq. 11.5),
    which sees part of what the model leaves, times `LEFT`. A gain is identified where its sigma is below `max_sigma` of
    it and it is within a factor `max_factor` of the others: what links share with one motor at the wrist is little
    beside friction, and a fit then takes what the model leaves for inertia (our choice). Where the search does not
    settle, the gain that ran away furthest is not identified.

    Args:
        data: triangles of [W i] by block and joint, group = block · joints + joint.
        inflation: (joints,) how many rows count as one.
        reference: the joint whose gain is one.
    """
    blocks = [k for k in range(data.groups // joints) if data.rows[k * joints : (k + 1) * joints].any()]
    own: tuple[int, ...] = ()
    max_sigma = 0.3  # sigma of a relative gain, of it, up to which the motion tells it
    max_factor = 10.0  # factor between gains of one robot's motors beyond which one counts as not identified
    while True:
        try:
            found = identify_gains(pool(data, joints, blocks), {}, inflation, reference=reference, own=own)
        except NotConverged as error:
            own = (*own, _astray(error, reference, own))
            continue
        logs, again = np.log(found.gains), []
        for block in blocks if len(blocks) > 2 else ():
            others = pool(data, joints, [other for other in blocks if other != block])
            try:
                again.append(np.log(identify_gains(others, {}, inflation, found.gains.tolist(), reference, own).gains))
            except NotConverged:
                again.append(np.where(np.arange(joints) == reference, 0.0, np.inf))
        formal = found.sigma / found.gains
        with np.errstate(invalid="ignore"):
            spread = np.array(again) - np.mean(again, axis=0) if again else np.zeros((1, joints))
        jackknife = np.sqrt((len(spread) - 1) / len(spread) * np.sum(np.nan_to_num(spread, nan=np.inf) ** 2, axis=0))
        sigma = LEFT * np.maximum(formal, jackknife)
        free = np.array([j != reference and j not in own for j in range(joints)])
        apart = np.abs(logs - np.median(logs))
        doubt = np.where(free, np.maximum(sigma / max_sigma, apart / np.log(max_factor)), 0.0)
        if doubt.max() <= 1.0:
            factor = np.where(free & (formal > 0.0), sigma / np.where(formal > 0.0, formal, 1.0), 1.0)
            return replace(found, covariance=frozen(found.covariance * np.outer(factor, factor)))
        own = (*own, int(np.argmax(doubt)))


def _astray(error: NotConverged, reference: int, own: Sequence[int]) -> int:
    """Return the joint whose gain diverged most (gains not converged): the motion does not identify this gain.

    Raises:
        NotConverged: the error, where no joint is left.
    """
    last = np.array(error.last, dtype=float)
    logs = np.nan_to_num(np.log(last), nan=np.inf)
    apart = np.abs(logs - np.median(logs))
    apart[[reference, *own]] = -1.0
    if not apart.max() >= 0.0:
        raise error
    return int(np.argmax(apart))


def _start(body: np.ndarray, load: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Return start values of the gains, least squares of [i -W] [K; χ] = P m: biased towards zero."""
    n, size, p = body.shape
    matrix = np.zeros((n, size, n + p))
    for j in range(n):
        matrix[j, :, j] = current[j]
    matrix[:, :, n:] = -body
    found = np.linalg.lstsq(matrix.reshape(-1, n + p), load.ravel(), rcond=1e-12)[0][:n]
    usual = float(np.median(np.abs(found)))
    return np.where(np.abs(found) > 0.05 * usual, np.abs(found), max(usual, 1e-3))


def _parameters(body: np.ndarray, load: np.ndarray, current: np.ndarray, gain: np.ndarray) -> np.ndarray:
    matrix, target = body / gain[:, None, None], current - load / gain[:, None]
    return np.linalg.lstsq(matrix.reshape(-1, body.shape[2]), target.ravel(), rcond=1e-12)[0]

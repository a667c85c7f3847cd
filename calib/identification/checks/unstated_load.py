"""A payload in one of several recordings that no options state: a free body at the tip of that recording alone.

Recordings of one robot are fitted together by bodies of any masses, each recording with friction and offsets of its
own, since these change with temperature. Where a body on the last link of one recording explains the torques far
better than other gains of its torques do, and about as well as masses of their own in every recording do, that
recording carries something.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.estimation.whiteness import inflation
from calib.identification.checks.recorded_motion import MotionSamples, basis

MAX_LEFT = 0.8  # rms residual with the load over that without (geometric mean over the joints; all below: our choice)
MAX_BEYOND = 1.15  # rms residual with the load over that with masses of their own in each recording
# rms residual with the load over that with other gains of the joints' torques: 0.59 to 0.88 for real loads of a UR10e
# (16 pairs of recordings), 0.99 and more where one recording's torques were scaled instead
MAX_SCALED = 0.93
MIN_SIGMAS = 10.0  # of the mass
MAX_REACH = 1.0  # of the load's centre of mass from the last joint [m]
MIN_FACTOR = 0.1  # between torques of one joint in two recordings
RANK = 1e-10  # of WᵀW with columns of unit norm, below which a direction is not identified
MAX_UNTOLD = 1e-3  # of the mass, that may be in such directions
ROUNDS = 4  # of weighing joints by their residuals
BODY = 10  # standard parameters of a body
MASS = 9  # index of the mass in them
FIRST_MOMENT = slice(6, 9)


@dataclass(frozen=True)
class UnstatedLoad:
    """A load that explains a recording's torques.

    Attributes:
        name: of the recording.
        mass, sigma: of the load, and its standard deviation [kg, or in proportion to the torques' unit].
        reach: distance of its centre of mass from the last joint's frame [m].
        before, after: unexplained share of the joints' rms torque without and with the load, geometric means.
    """

    name: str
    mass: float
    sigma: float
    reach: float
    before: float
    after: float


def unstated_load(samples: Mapping[str, MotionSamples]) -> UnstatedLoad | None:
    """Return the load in one of two or more recordings, by name, that are said to carry the same; None without any."""
    if len(samples) < 2:
        return None
    names = list(samples)
    rows = [_rows(motion) for motion in samples.values()]
    nobody = _fit(rows, None)
    apart = [residual for part in rows for residual in _fit([part], None).residuals]
    loaded = [_fit(rows, index) for index in range(len(rows))]
    best = min(range(len(rows)), key=lambda index: _size(loaded[index].residuals))
    # of two recordings either one explains the other's load by a negative one
    if len(rows) == 2 and loaded[best].values[MASS] < 0.0:
        best = 1 - best
    fit = loaded[best]
    before, after = _size(nobody.residuals), _size(fit.residuals)
    mass, sigma = float(fit.values[MASS]), fit.sigma
    reach = float(np.linalg.norm(fit.values[FIRST_MOMENT])) / max(abs(mass), 1e-12)
    explained = after < MAX_LEFT * before and after < MAX_BEYOND * _size(apart)
    explained = explained and after < MAX_SCALED * _size(_scaled(rows, best))
    if not explained or mass < MIN_SIGMAS * sigma or reach > MAX_REACH:
        return None
    size = _size([part[:, :, -1] for part in rows])
    return UnstatedLoad(names[best], mass, sigma, reach, before / size, after / size)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Residuals (m, n) by recording, bodies' and rotors' values (p,), a load's (10,), and its mass's sigma."""

    residuals: list[np.ndarray]
    bodies: np.ndarray
    values: np.ndarray
    sigma: float


def _rows(motion: MotionSamples) -> np.ndarray:
    """Return columns (m, n, 10 B + n + 1): bodies, rotors' inertias and torques, without friction and offsets."""
    m, n = motion.q.shape
    drives = motion.drives.reshape(m, n, n, 4)
    columns = np.concatenate([motion.inertial, drives[..., 0], motion.torque[:, :, None]], axis=2)
    for joint in range(n):
        friction = basis(drives[:, joint, joint, 1:])
        columns[:, joint] -= friction @ (friction.T @ columns[:, joint])
    return columns


def _fit(rows: Sequence[np.ndarray], loaded: int | None) -> _Fit:
    """Return the fit of recordings with the same bodies, and a load on the last one of recording `loaded`."""
    n, size = rows[0].shape[1], rows[0].shape[2] - 1
    last = slice(size - n - BODY, size - n)
    parts = []
    for index, part in enumerate(rows):
        load = part[:, :, last] * (index == loaded)
        parts.append(np.concatenate([part[:, :, :-1], load], axis=2))
    residuals = [part[:, :, -1] for part in rows]
    bodies, values, sigma = np.zeros(size), np.zeros(BODY), np.inf
    for _ in range(ROUNDS):
        weight = 1.0 / np.maximum(_mean_squares(residuals), 1e-300)
        square = sum(np.einsum("mjp,j,mjq->pq", part, weight, part, optimize=True) for part in parts)
        product = sum(
            np.einsum("mjp,j,mj->p", part, weight, own[:, :, -1], optimize=True) for part, own in zip(parts, rows)
        )
        inverse = _inverse(np.asarray(square))
        solution = inverse @ np.asarray(product)
        residuals = [own[:, :, -1] - part @ solution for part, own in zip(parts, rows)]
        bodies, values = solution[:-BODY], solution[-BODY:]
        sigma = float(np.sqrt(inverse[MASS - BODY, MASS - BODY]))
        # 1 where the rows tell the mass by itself, less where only sums with others
        told = float(inverse[MASS - BODY] @ np.asarray(square)[:, MASS - BODY])
        sigma = sigma if told > 1.0 - MAX_UNTOLD else np.inf
    spread = [inflation(residual) for part in residuals for residual in part.T]
    return _Fit(residuals, bodies, values, sigma * float(np.sqrt(max(spread))))


def _scaled(rows: Sequence[np.ndarray], scaled: int) -> list[np.ndarray]:
    """Return the residuals where the joints' torques of one recording are too large by factors, and none is loaded."""
    part = rows[scaled]
    torque = part[:, :, -1]
    fit = _fit([*rows[:scaled], *rows[scaled + 1 :]], None)
    residuals = []
    for _ in range(ROUNDS):
        expected = part[:, :, :-1] @ fit.bodies
        factor = np.sum(expected * torque, axis=0) / np.maximum(np.sum(expected**2, axis=0), 1e-300)
        changed = np.array(part)
        changed[:, :, -1] /= np.where(np.abs(factor) > MIN_FACTOR, factor, 1.0)
        fit = _fit([*rows[:scaled], changed, *rows[scaled + 1 :]], None)
        residuals = list(fit.residuals)
        residuals[scaled] = torque - factor * (part[:, :, :-1] @ fit.bodies)
    return residuals


def _inverse(square: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse (p, p) of WᵀW, columns scaled to unit norm."""
    size = np.sqrt(np.diag(square))
    scale = np.where(size > 1e-9 * size.max(), size, np.inf)
    both = np.outer(scale, scale)
    return np.asarray(np.linalg.pinv(square / both, rcond=RANK, hermitian=True) / both)


def _mean_squares(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean squares (n,) of residuals (m, n) of all recordings."""
    return np.mean(np.concatenate(residuals) ** 2, axis=0)


def _size(residuals: Sequence[np.ndarray]) -> float:
    """Return the geometric mean over the joints of the rms of residuals (m, n) of all recordings."""
    return float(np.exp(0.5 * np.mean(np.log(np.maximum(_mean_squares(residuals), 1e-300)))))

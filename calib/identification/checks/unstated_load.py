"""Detection of a payload that the options do not state: a free body at the tip in one of several recordings.

Recordings of one robot are fitted together, with the same bodies of any masses, but with friction and offsets per
recording, since these change with temperature. A recording is reported to carry a load if a body on its last link
explains the torques far better than changed torque gains do, and about as well as separate masses in every recording
do.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.estimation.whiteness import inflation
from calib.identification.checks.recorded_motion import MotionSamples, basis

MAX_LEFT = 0.8
"""Rms residual with the load over that without (geometric mean over the joints; all below: our choice)."""
MAX_BEYOND = 1.15
"""Rms residual with the load over that with masses of their own in each recording."""
MAX_SHORT = 0.05
"""Share of what masses of their own in each recording explain that the load may leave, if that is more.

A load that explains nearly all leaves little else, of which separate masses absorb a part (our choice).
"""
MAX_SCALED = 0.93
"""Rms residual with the load over that with other gains of the joints' torques.

0.59 to 0.88 for real loads of a UR10e (16 pairs of recordings), 0.99 and more where one recording's torques were scaled
instead.
"""
MIN_SIGMAS = 10.0
"""Mass of a load in sigmas, at least."""
MAX_REACH = 1.0
"""Distance of the load's centre of mass from the last joint, at most [m]."""
MIN_FACTOR = 0.1
"""Factor between torques of one joint in two recordings, at least."""
RANK = 1e-10
"""Eigenvalue of WᵀW with columns of unit norm, below which a direction is not identified."""
MAX_UNIDENTIFIED = 1e-3
"""Share of the mass that may be in such directions."""
ROUNDS = 4
"""Rounds of weighing joints by their residuals."""
BODY = 10
"""Standard parameters of a body."""
MASS = 9
"""Index of the mass in them."""
FIRST_MOMENT = slice(6, 9)


@dataclass(frozen=True)
class UnstatedLoad:
    """A load that explains a recording's torques.

    Attributes:
        name: name of the recording.
        mass, sigma: mass of the load and its standard deviation [kg, or in proportion to the torques' unit].
        reach: distance of the load's centre of mass from the last joint's frame [m].
        before, after: unexplained share of the joints' rms torque without and with the load, geometric means.
    """

    name: str
    mass: float
    sigma: float
    reach: float
    before: float
    after: float


def unstated_load(samples: Mapping[str, MotionSamples]) -> UnstatedLoad | None:
    """Return the unstated load of one of two or more recordings; None if there is none.

    Args:
        samples: samples of each recording by name; all are stated to carry the same load.
    """
    if len(samples) < 2:
        return None
    names = list(samples)
    rows = [_rows(motion) for motion in samples.values()]
    unloaded = _fit(rows, None)
    separate = []
    for part in rows:
        separate += _fit([part], None).residuals
    loaded = [_fit(rows, index) for index in range(len(rows))]
    sizes = [_size(fit.residuals) for fit in loaded]
    best = int(np.argmin(sizes))
    if len(rows) == 2 and loaded[best].values[MASS] < 0.0:
        # Of two recordings either one explains the other's load by a negative one.
        best = 1 - best
    fit = loaded[best]
    before = _size(unloaded.residuals)
    after = sizes[best]
    mass = float(fit.values[MASS])
    first_moment = float(np.linalg.norm(fit.values[FIRST_MOMENT]))
    reach = first_moment / max(abs(mass), 1e-12)
    alone = _size(separate)
    most = max(MAX_BEYOND * alone, alone + MAX_SHORT * (before - alone))
    explained = after < MAX_LEFT * before and after < most
    explained = explained and after < MAX_SCALED * _size(_scaled(rows, best))
    if not explained or mass < MIN_SIGMAS * fit.sigma or reach > MAX_REACH:
        return None
    torque = _size([part[:, :, -1] for part in rows])
    name = names[best]
    return UnstatedLoad(name, mass, fit.sigma, reach, before / torque, after / torque)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Result of fitting several recordings together.

    Attributes:
        residuals: (m, n) residuals of each recording.
        bodies: (p,) parameters of bodies and rotors.
        values: (10,) standard parameters of the load.
        sigma: standard deviation of the load's mass; infinite if it is not identified.
    """

    residuals: list[np.ndarray]
    bodies: np.ndarray
    values: np.ndarray
    sigma: float


def _rows(motion: MotionSamples) -> np.ndarray:
    """Return the columns (m, n, 10 B + n + 1) of bodies and rotor inertias, and the torque, of m samples.

    Each is reduced by its projection onto friction and offsets, which are thereby free parameters of the recording.

    Args:
        motion: m samples of one recording.
    """
    m, n = motion.q.shape
    drives = motion.drives.reshape(m, n, n, 4)
    target = motion.torque[:, :, None]
    columns = np.concatenate([motion.inertial, drives[..., 0], target], axis=2)
    for joint in range(n):
        friction = basis(drives[:, joint, joint, 1:])
        columns[:, joint] -= friction @ (friction.T @ columns[:, joint])
    return columns


def _fit(rows: Sequence[np.ndarray], loaded: int | None) -> _Fit:
    """Return the fit of recordings with common bodies, and with a load on the last body in one of them.

    Args:
        rows: columns of each recording, from `_rows`.
        loaded: index of the recording with the load; None: no recording has one.
    """
    n = rows[0].shape[1]
    size = rows[0].shape[2] - 1
    last_body = slice(size - n - BODY, size - n)
    matrices, targets = [], []
    for index, part in enumerate(rows):
        load = part[:, :, last_body] * (index == loaded)
        columns = part[:, :, :-1]
        matrices.append(np.concatenate([columns, load], axis=2))
        targets.append(part[:, :, -1])
    residuals = targets
    bodies = np.zeros(size)
    values = np.zeros(BODY)
    sigma = np.inf
    for _ in range(ROUNDS):
        weight = 1.0 / np.maximum(_mean_squares(residuals), 1e-300)
        square = np.zeros((size + BODY, size + BODY))
        product = np.zeros(size + BODY)
        for matrix, target in zip(matrices, targets):
            square = square + np.einsum("mjp,j,mjq->pq", matrix, weight, matrix, optimize=True)
            product = product + np.einsum("mjp,j,mj->p", matrix, weight, target, optimize=True)
        inverse = _inverse(square)
        solution = inverse @ product
        residuals = [target - matrix @ solution for matrix, target in zip(matrices, targets)]
        bodies = solution[:-BODY]
        values = solution[-BODY:]
        # 1 where the rows identify the mass by itself, less where only sums with others.
        identified = float(inverse[MASS - BODY] @ square[:, MASS - BODY])
        sigma = np.inf
        if identified > 1.0 - MAX_UNIDENTIFIED:
            sigma = float(np.sqrt(inverse[MASS - BODY, MASS - BODY]))
    spread = [inflation(residual) for part in residuals for residual in part.T]
    return _Fit(residuals, bodies, values, sigma * float(np.sqrt(max(spread))))


def _scaled(rows: Sequence[np.ndarray], recording: int) -> list[np.ndarray]:
    """Return the residuals of a fit without load, with a free factor per joint on the torques of one recording.

    Args:
        rows: columns of each recording, from `_rows`.
        recording: index of the recording whose torques are scaled.
    """
    before = rows[:recording]
    part = rows[recording]
    after = rows[recording + 1 :]
    torque = part[:, :, -1]
    fit = _fit([*before, *after], None)
    residuals = []
    for _ in range(ROUNDS):
        expected = part[:, :, :-1] @ fit.bodies
        square = np.maximum(np.sum(expected**2, axis=0), 1e-300)
        factor = np.sum(expected * torque, axis=0) / square
        changed = np.array(part)
        safe_factor = np.where(np.abs(factor) > MIN_FACTOR, factor, 1.0)
        changed[:, :, -1] /= safe_factor
        fit = _fit([*before, changed, *after], None)
        residuals = list(fit.residuals)
        residuals[recording] = torque - factor * (part[:, :, :-1] @ fit.bodies)
    return residuals


def _inverse(square: np.ndarray) -> np.ndarray:
    """Return the pseudo-inverse (p, p) of WᵀW, computed with columns scaled to unit norm.

    Args:
        square: WᵀW (p, p).
    """
    size = np.sqrt(np.diag(square))
    scale = np.where(size > 1e-9 * size.max(), size, np.inf)
    scales = np.outer(scale, scale)
    return np.asarray(np.linalg.pinv(square / scales, rcond=RANK, hermitian=True) / scales)


def _mean_squares(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean squares (n,) of the residuals (m, n) of all recordings together."""
    return np.mean(np.concatenate(residuals) ** 2, axis=0)


def _size(residuals: Sequence[np.ndarray]) -> float:
    """Return the rms of the residuals (m, n) of all recordings, as geometric mean over the joints."""
    squares = np.maximum(_mean_squares(residuals), 1e-300)
    mean_log = np.mean(np.log(squares))
    return float(np.exp(0.5 * mean_log))

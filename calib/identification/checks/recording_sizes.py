"""Can recordings be of this robot? Its own masses, its limits, and the clock of the torques against that of positions.

Numbers only; what they mean for a verdict is said in `calib.procedure.dynamic_stage.plausibility`. Everything is looked
at on a few samples with standard friction: sizes and signs, no model. All thresholds are our choice; on the real
recordings at hand (Panda, KR300, LWR4+, TX40, TIAGo, 22 of a UR10e) none is reached.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.dynamics.bodies import Bodies, bodies_of, with_gravity
from calib.dynamics.rigid_body import regressor
from calib.identification.cases import Case
from calib.identification.checks.recorded_motion import CREEP, share_of_nominal
from calib.identification.rows import segments
from calib.robot.chain import Chain

ROWS = 1500  # samples on which a lag is looked for
EDGE = 0.3  # left out at both ends of a segment [s], so that shifted torques are still recorded ones
LAGS = 0.25  # largest lag that is tried [s], in steps of
STEP = 0.005
SMOOTH = 0.02  # window of a moving average of the torques [s]: else a shift between samples smooths, and seems to help
FALLS, ALIKE, LEAST = 0.2, 0.01, 0.015
"""A joint prefers a lag where its residual falls by this share; joints agree within this [s] or a quarter of it, on no
less than this [s]."""
TRAVEL = 0.05  # a joint that travels less says nothing of its velocity's size [rad or m]


@dataclass(frozen=True)
class Lag:
    """By how much torques come later than the positions of their row [s], and what that explains.

    Attributes:
        before, after: rms share of the joints' torques that bodies and standard friction leave: as recorded, shifted.
    """

    seconds: float
    before: float
    after: float


@dataclass(frozen=True)
class RecordingSizes:
    """A recording beside the robot it is said to be of.

    Attributes:
        name: of the case.
        masses: (n,) recorded torque of gravity over that of the robot's own masses; NaN where a joint says nothing.
        speed: (n,) measured velocities over the slopes of the positions; NaN where there are none, or no travel.
        lag: of the torques; None where the recording is too short to tell.
    """

    name: str
    masses: np.ndarray
    speed: np.ndarray
    lag: Lag | None


def compare_sizes(
    case: Case, chain: Chain, gravity: Sequence[float] | None = None, newtons: bool = True
) -> RecordingSizes:
    """Hold a recording of the motors' torques against its robot.

    Args:
        case: a recording.
        chain: the arm, whose masses count where it has any.
        gravity: in the base frame [m/s²], where it is not the robot's own.
        newtons: whether the torques are in N m; those of currents without known gains compare with no masses.
    """
    n, motion = chain.n, case.motion
    nothing = np.full(n, np.nan)
    known = newtons and case.target.shape[1] == n
    known = known and chain.inertias is not None and bool(np.any(chain.inertias[:, 9] > 0.0))
    masses = share_of_nominal(motion.t, motion.q, case.target, chain, gravity, static=True) if known else nothing
    speed = nothing if motion.v_measured is None else speed_ratio(motion.t, motion.q, motion.v_measured)
    return RecordingSizes(case.name, masses, speed, lag_of(case, _under(chain, gravity)))


def speed_ratio(t: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return (n,) measured velocities over the slopes of the positions (N, n): ∫v dt on q, both without their trend.

    Integrals compare where slopes are noise. NaN for joints that hardly travel.
    """
    grown = np.concatenate([np.zeros((1, q.shape[1])), np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(t)[:, None], axis=0)])
    trend = np.column_stack([np.ones(len(t)), t - t.mean()])
    own, seen = (x - trend @ np.linalg.lstsq(trend, x, rcond=None)[0] for x in (np.asarray(q), grown))
    power = np.maximum((own**2).sum(axis=0), 1e-300)
    alike = (own * seen).sum(axis=0) > 0.9 * np.sqrt(power * (seen**2).sum(axis=0))
    return np.where(alike & (np.ptp(q, axis=0) > TRAVEL), (own * seen).sum(axis=0) / power, np.nan)


def lag_of(case: Case, bodies: Bodies) -> Lag | None:
    """Return the lag of the torques on which most joints agree; None where they do not, or for too few samples.

    One joint alone may prefer a lag, since its friction is of another form than assumed; a clock is everybody's. With
    an orthonormal basis B of a joint's columns at the samples, the residual of its torque shifted by s is
    ‖τ(t+s)‖² - ‖Bᵀτ(t+s)‖²: one decomposition serves all shifts.
    """
    motion, n = case.motion, case.motion.n
    edge = int(EDGE * motion.rate)
    inner = np.concatenate([np.arange(a + edge, b - edge) for a, b in segments(motion.segment)])
    if len(inner) < 20 * n or case.target.shape[1] != n:
        return None
    index = inner[:: max(1, len(inner) // ROWS)]
    effort = _smoothed(np.asarray(case.target), max(1, round(SMOOTH * motion.rate)))
    columns = _columns(bodies, *(np.ascontiguousarray(x[index]) for x in (motion.q, motion.v, motion.a)))
    shifts = np.arange(-LAGS, LAGS + STEP / 2, STEP)
    places = index + shifts[:, None] * motion.rate
    left = np.array([_left(_basis(columns[:, j]), effort[:, j], places) for j in range(n)])  # (n, shifts)
    now = left[:, len(shifts) // 2]
    better = left.min(axis=1) < (1.0 - FALLS) ** 2 * now
    if not better.any():
        return None
    own = shifts[left.argmin(axis=1)]
    common = float(np.median(own[better]))
    agree = better & (np.abs(own - common) <= np.maximum(ALIKE, 0.25 * abs(common)))
    if 2 * agree.sum() < n or abs(common) < LEAST:
        return None
    common = float(own[agree].mean())
    shifted = left[:, int(np.argmin(np.abs(shifts - common)))]
    return Lag(common, float(np.sqrt(now.mean())), float(np.sqrt(shifted.mean())))


def _under(chain: Chain, gravity: Sequence[float] | None) -> Bodies:
    bodies = bodies_of(chain)
    return bodies if gravity is None else with_gravity(bodies, np.asarray(gravity, dtype=float))


def _columns(bodies: Bodies, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the columns (N, n, p) of bodies and of Ia, Fv, Fc, off of each joint."""
    m, n = q.shape
    drives, joints = np.zeros((m, n, n, 4)), np.arange(n)
    drives[:, joints, joints] = np.stack([a, v, np.tanh(v / CREEP), np.ones((m, n))], axis=-1)
    return np.concatenate([regressor(bodies, q, v, a).reshape(m, n, -1), drives.reshape(m, n, -1)], axis=2)


def _basis(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of what the columns span."""
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 1e-9 * size.max()] / size[size > 1e-9 * size.max()]
    values, vectors = np.linalg.eigh(columns.T @ columns)
    kept = values > 1e-9 * values[-1]
    return columns @ (vectors[:, kept] / np.sqrt(values[kept]))


def _left(basis: np.ndarray, effort: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return the share (shifts,) of the effort's variance that the basis does not explain, taken at places in samples.

    Args:
        basis: (m, k) orthonormal.
        effort: (N,).
        places: (shifts, m).
    """
    shifted = np.interp(places, np.arange(len(effort)), effort)
    shifted = shifted - shifted.mean(axis=1, keepdims=True)
    power = (shifted**2).sum(axis=1)
    return np.maximum(power - ((shifted @ basis) ** 2).sum(axis=1), 0.0) / np.maximum(power, 1e-300)


def _smoothed(values: np.ndarray, width: int) -> np.ndarray:
    """Return the moving average (N, n) over an odd number of samples, three at least."""
    half = max(1, width // 2)
    padded = np.pad(values, ((half + 1, half), (0, 0)), mode="edge")
    total = np.cumsum(padded, axis=0)
    return (total[2 * half + 1 :] - total[: -2 * half - 1]) / (2 * half + 1)

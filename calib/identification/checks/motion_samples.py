"""A few samples of a recording, and how much of its torques columns explain: what quick looks at recordings share."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.dynamics.bodies import Bodies
from calib.dynamics.rigid_body import regressor
from calib.identification.checks.recorded_motion import CREEP
from calib.identification.rows import Case, segments


@dataclass(frozen=True, eq=False)
class MotionSamples:
    """N samples of a motion of n joints.

    Attributes:
        index: (N,) which of the motion's.
        q, v, a: (N, n).
        effort: torques of the whole motion, smoothed; velocity: of the whole motion.
        bodies: of the robot.
    """

    index: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    effort: np.ndarray
    velocity: np.ndarray
    bodies: Bodies

    @property
    def torque(self) -> np.ndarray:
        """(N, n)."""
        return self.effort[self.index]

    @cached_property
    def inertial(self) -> np.ndarray:
        """(N, n, 10 B) columns of the bodies."""
        return regressor(self.bodies, self.q, self.v, self.a).reshape(*self.q.shape, -1)

    @cached_property
    def at_rest(self) -> np.ndarray:
        """(N, n, 10 B) columns of the bodies where they stand: of gravity alone."""
        still = np.zeros_like(self.v)
        return regressor(self.bodies, self.q, still, still).reshape(*self.q.shape, -1)

    @cached_property
    def drives(self) -> np.ndarray:
        """(N, n, 4 n) columns of Ia, Fv, Fc, off of each joint."""
        m, n = self.q.shape
        found, joints = np.zeros((m, n, n, 4)), np.arange(n)
        found[:, joints, joints] = drive_columns(self.v, self.a)
        return found.reshape(m, n, -1)


def take_samples(case: Case, bodies: Bodies, count: int) -> MotionSamples | None:
    """Return some `count` samples of a recording of the motors' torques; None where too few are left."""
    motion, n = case.motion, case.motion.n
    # left out at both ends of a segment [s], so that shifted torques are still recorded ones (our choice)
    edge_time = 0.3
    edge = int(edge_time * motion.rate)
    inner = np.concatenate([np.arange(a + edge, b - edge) for a, b in segments(motion.segment)])
    if len(inner) < 20 * n or case.target.shape[1] != n:
        return None
    index = inner[:: max(1, len(inner) // count)]
    # window of a moving average of the torques [s]: else a shift between samples smooths, and seems to help
    window = 0.02
    effort = _smoothed(np.asarray(case.target), max(1, round(window * motion.rate)))
    q, v, a = (np.ascontiguousarray(x[index]) for x in (motion.q, motion.v, motion.a))
    return MotionSamples(index, q, v, a, effort, motion.v, bodies)


def drive_columns(v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return a, v, sign(v) smoothed, and ones, for velocities and accelerations (...): (..., 4)."""
    return np.stack([a, v, np.tanh(v / CREEP), np.ones_like(v)], axis=-1)


def basis(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (N, k) of what columns (N, p) span."""
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 1e-9 * size.max()] / size[size > 1e-9 * size.max()]
    values, vectors = np.linalg.eigh(columns.T @ columns)
    kept = values > 1e-9 * values[-1]
    return np.asarray(columns @ (vectors[:, kept] / np.sqrt(values[kept])))


def left_share(columns: np.ndarray, effort: np.ndarray) -> np.ndarray:
    """Return the shares (m,) of the variance of torques (m, N) that an orthonormal basis (N, k) does not explain."""
    own = effort - effort.mean(axis=1, keepdims=True)
    power = (own**2).sum(axis=1)
    return np.maximum(power - ((own @ columns) ** 2).sum(axis=1), 0.0) / np.maximum(power, 1e-300)


def _smoothed(values: np.ndarray, width: int) -> np.ndarray:
    """Return the moving average (N, n) over an odd number of samples, three at least."""
    half = max(1, width // 2)
    padded = np.pad(values, ((half + 1, half), (0, 0)), mode="edge")
    total = np.cumsum(padded, axis=0)
    return (total[2 * half + 1 :] - total[: -2 * half - 1]) / (2 * half + 1)

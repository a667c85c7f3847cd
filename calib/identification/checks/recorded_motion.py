"""Checks of a recording against the designed motion and the robot's nominal masses.

All comparisons use a common coarse time grid; `calib.trajectories.recall` finds the motion and its repetitions. This
module also contains what the quick checks of torques have in common: a small sample of a recording, and the share of
torques that a set of columns explains.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Protocol

import numpy as np

from calib.column_changes import Change, assigned, best_changes, coupling, couplings
from calib.data.recordings.recording import Recording
from calib.dynamics.bodies import Bodies, bodies_of, standard_parameters
from calib.dynamics.rigid_body import inverse_dynamics, regressor
from calib.estimation.base_columns import split_columns
from calib.identification.rows import Case, segments
from calib.records import interpolated
from calib.robot.chain import Chain
from calib.trajectories.errors import BadInput
from calib.trajectories.recall import Recalled, find_periods, sliding_products

EDGE_TIME = 0.25
"""Time before and after the motion that is kept for the filters' borders [s]."""
STEP = 0.01
"""Step of the coarse grid [s] (this and all below: our choice)."""
SPEEDS = (0.1, 0.2, 0.25, 0.5, 2.0)
"""Rehearsal factors that are tried to explain another motion."""
UNITS = (1.0, np.pi / 180, 180 / np.pi)
"""Factors on recorded positions that are tried."""
CREEP = 0.05
"""Speed over which the sign of Coulomb friction is smoothed [rad/s or m/s]."""
MAX_GAP = 60.0
"""Gap between samples that the coarse grid bridges [s]; a log may go on after weeks."""
MIN_LIKENESS = 0.9
"""Share of the motion's variance that a recorded period has to explain."""
MIN_TORQUE = 0.03
"""Rigid-body torque, in units of the torque limit, from which a joint says something of its masses."""
DEFAULT_LIMIT = 100.0
"""Torque limit of a joint that states none [N m or N]."""
MIN_SIGN_CORRELATION = 0.8
"""Partial correlation with the torque of the nominal masses from which its sign counts."""
HALF_WIDTH = 10
"""Half width of the window for derivatives, in steps of the coarse grid."""
SEGMENT_EDGE = 0.3
"""Time omitted at both ends of a segment, so that shifted torques are still recorded ones [s]."""
RANDOM_STATES = 100
"""Random states of a robot at which the columns of its bodies are compared."""
CACHED = 4
"""Number of robots whose independent columns are kept."""
TORQUE_WINDOW = 0.02
"""Window of a moving average of the torques [s]: else a shift between samples smooths, and seems to help."""

Pair = tuple[np.ndarray, np.ndarray]
"""Recorded positions (N, n), and one period of a motion (P, n)."""


class DesignedMotion(Protocol):
    """A periodic motion of n joints.

    `period` is its period [s]; `orders` maps times (N,) [s] to q, v and a, (N, n) each.
    """

    @property
    def period(self) -> float: ...

    def orders(self, times: np.ndarray, /) -> tuple[np.ndarray, np.ndarray, np.ndarray]: ...


@dataclass(frozen=True)
class LocatedMotion:
    """Location of a designed motion in a recording.

    Attributes:
        start, stop: start and end of the complete repetitions, with a short margin [s], in the recording's time.
        began: start of the first repetition according to the positions [s]; later than commanded, by the tracking lag.
        periods: number of complete repetitions.
        tracking: (n,) rms of recorded minus designed positions [rad or m].
        likeness: share of the motion's variance that the worst of the recorded periods explains.
        loosest: index of the joint with the largest tracking error relative to its travel.
    """

    start: float
    stop: float
    began: float
    periods: int
    tracking: tuple[float, ...]
    likeness: float
    loosest: int


def locate(recording: Recording, motion: DesignedMotion) -> LocatedMotion | None:
    """Return the location of the repetitions of a designed motion in a recording; None if it contains none.

    Args:
        recording: recording of n joints.
        motion: the designed motion, which may be repeated.
    """
    grid, q = _on_grid(recording)
    reference = _one_period(motion)
    recalled = _recalled(q, reference)
    if recalled is None:
        return None
    start = float(grid[recalled.start])
    stop = float(grid[min(recalled.rows.stop, len(grid) - 1)])
    recorded = q[recalled.rows]
    designed = np.tile(reference, (recalled.periods, 1))[: len(recorded)]
    tracking = np.sqrt(np.mean((recorded - designed) ** 2, axis=0))
    relative = tracking / np.maximum(np.std(reference, axis=0), 1e-9)
    began = start + STEP * recalled.lag
    likeness = min(recalled.likeness)
    loosest = int(np.argmax(relative))
    padded_start = start - EDGE_TIME
    padded_stop = stop + EDGE_TIME
    return LocatedMotion(
        start=max(float(recording.t[0]), padded_start),
        stop=min(float(recording.t[-1]), padded_stop),
        began=began,
        periods=recalled.periods,
        tracking=tuple(tracking.tolist()),
        likeness=likeness,
        loosest=loosest,
    )


def another_motion(
    recording: Recording, motion: DesignedMotion, alternatives: Mapping[str, DesignedMotion]
) -> Change | None:
    """Return the change of the designed motion that explains a recording, e.g. other units; None if none does.

    Args:
        recording: recording of n joints.
        motion: the motion that should have been played; it is tested at other `SPEEDS`, in other `UNITS`, with columns
            swapped or reversed, and with joint positions that are relative to the previous joint.
        alternatives: designed motions by name, one of which may have been played instead.
    """
    _, q = _on_grid(recording)
    reference = _one_period(motion)
    n = q.shape[1]

    def with_motion(replacement: DesignedMotion, speed: float = 1.0) -> Callable[[Pair], Pair]:
        return lambda data: (data[0], _one_period(replacement, speed))

    def with_columns(matrix: np.ndarray) -> Callable[[Pair], Pair]:
        return lambda data: (data[0] @ matrix.T, data[1])

    changes = []
    for name, alternative in alternatives.items():
        changes.append(Change("motion-exchanged", with_motion(alternative), values={"motion": name}))
    changes += [Change("motion-rehearsed", with_motion(motion, speed), values={"speed": speed}) for speed in SPEEDS]
    if len(q) >= len(reference):
        order, sign = _best_order(q, reference)
        permutation = sign[:, None] * np.eye(n)[order]
        for unit in UNITS:
            values = {"unit": unit, "order": order.tolist(), "sign": sign.tolist()}
            changes.append(Change("motion-altered", with_columns(unit * permutation), values=values))
    for joint, motor, direction in couplings(n):
        matrix = coupling(n, joint, motor, direction)
        sign_text = "-" if direction < 0.0 else "+"
        changes.append(Change("motion-coupled", with_columns(matrix), (joint, motor), {"way": sign_text}))
    explanation = best_changes((q, reference), changes, _unlike)
    return None if explanation is None else explanation.changes[0]


def _on_grid(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of the coarse grid (N,) and the positions at these times (N, n).

    Args:
        recording: recording of n joints.
    """
    grid = _coarse(recording.t)
    return grid, interpolated(grid, recording.t, recording.q)


def _coarse(t: np.ndarray) -> np.ndarray:
    """Return a time grid with spacing `STEP` [s] over sample times (N,); longer gaps are shortened to `MAX_GAP`."""
    before_gap = np.flatnonzero(np.diff(t) > MAX_GAP)
    starts = t[np.append(0, before_gap + 1)]
    stops = np.append(t[before_gap] + MAX_GAP, t[-1])
    pieces = [np.arange(start, stop, STEP) for start, stop in zip(starts, stops)]
    return np.concatenate(pieces)


def _one_period(motion: DesignedMotion, speed: float = 1.0) -> np.ndarray:
    """Return positions (P, n) over one period of a motion played at `speed` times its speed, about every `STEP` [s]."""
    count = round(motion.period / speed / STEP)
    q, _, _ = motion.orders(np.arange(count) * motion.period / count)
    return q


def _recalled(q: np.ndarray, reference: np.ndarray) -> Recalled | None:
    """Return the repetitions of one period (P, n) of a motion in positions (N, n); None if there are none.

    Args:
        q: (N, n) positions on the coarse grid [rad or m].
        reference: (P, n) positions over one period on a grid of equal spacing.
    """
    try:
        return find_periods(q, reference, likeness=MIN_LIKENESS)
    except BadInput:
        return None


def _unlike(data: Pair) -> np.ndarray:
    """Return the share (1,) of variance that is unexplained in the worst recorded period; 1 without periods.

    Args:
        data: recorded positions (N, n), and one period (P, n) of the designed motion.
    """
    q, reference = data
    recalled = _recalled(q, reference)
    if recalled is None:
        return np.array([1.0])
    return np.array([max(1.0 - min(recalled.likeness), 1e-9)])


def _best_order(q: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the recorded column (n,) and sign (n,) for each joint that correlate best with the designed motion.

    Args:
        q: (N, n) recorded positions on the coarse grid.
        reference: (P, n) positions over one period of the designed motion.
    """
    n = reference.shape[1]
    likeness = np.zeros((2, n, n))
    window = np.ones(len(reference))
    for j in range(n):
        designed = reference[:, j] - reference[:, j].mean()
        size = max(np.linalg.norm(designed), 1e-12)
        for k in range(n):
            recorded = q[:, k] - q[:, k].mean()
            product = sliding_products(recorded, designed) / size
            power = np.sqrt(np.maximum(sliding_products(recorded**2, window), 1e-12))
            likeness[0, j, k] = (product / power).max()
            likeness[1, j, k] = (-product / power).max()
    return assigned(-likeness)


def share_of_nominal(
    t: np.ndarray,
    q: np.ndarray,
    effort: np.ndarray,
    chain: Chain,
    gravity: Sequence[float] | None = None,
    static: bool = False,
) -> np.ndarray:
    """Return the ratios (n,) of recorded torques to the nominal masses' torques; drives are estimated as well.

    τ_j is fitted by least squares with τ_nominal,j, a_j, v_j, tanh(v_j / v0) and 1 on the coarse grid; a_j is the
    column of the rotor's inertia, which would otherwise be attributed to the mass. A joint is judged only if its
    rigid-body torque exceeds `MIN_TORQUE` of its limit and the partial correlation of both torques exceeds
    `MIN_SIGN_CORRELATION`.

    Args:
        t: (N,) sample times [s].
        q, effort: (N, n) positions [rad or m] and torques [N m or N].
        chain: the arm with its nominal masses.
        gravity: (3,) gravity vector [m/s²]; None: the chain's.
        static: whether only gravity torques are compared; the torques of motion are then fitted with a free factor.

    Returns:
        (n,) factors of τ_nominal: 1 for correct masses, below 0 for a reversed sign; NaN for joints that are not
            judged.
    """
    grid = _coarse(t)
    torque = _smooth(interpolated(grid, t, effort))
    positions = interpolated(grid, t, q)
    q = _smooth(positions, 0)
    v = _smooth(positions, 1)
    a = _smooth(positions, 2)
    bodies = bodies_under(chain, gravity)
    parameters = standard_parameters(chain)
    rigid = inverse_dynamics(bodies, parameters, q, v, a)
    of_motion = None
    if static:
        of_gravity = inverse_dynamics(bodies, parameters, q, np.zeros_like(v), np.zeros_like(a))
        of_motion = rigid - of_gravity
        rigid = of_gravity
    limit = np.array([joint.effort for joint in chain.joints])
    limit = np.where(np.isfinite(limit), limit, DEFAULT_LIMIT)
    heavy = rigid.std(axis=0) > MIN_TORQUE * limit
    share = np.full(chain.n, np.nan)
    for j in np.flatnonzero(heavy):
        free = drive_columns(v[:, j], a[:, j])
        if of_motion is not None:
            free = np.column_stack([free, of_motion[:, j]])
        nominal = _without(free, rigid[:, j])
        recorded = _without(free, torque[:, j])
        common, power = nominal @ recorded, nominal @ nominal
        size = max(np.sqrt(power * (recorded @ recorded)), 1e-12)
        if abs(common) / size > MIN_SIGN_CORRELATION:
            share[j] = common / max(power, 1e-12)
    return share


def _without(columns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the residual (N,) of values (N,) after least squares on columns (N, k)."""
    return values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]


def bodies_under(chain: Chain, gravity: Sequence[float] | None) -> Bodies:
    """Return the chain's bodies with gravity set to the given vector [m/s²]; None keeps the chain's gravity."""
    bodies = bodies_of(chain)
    if gravity is None:
        return bodies
    return bodies.with_gravity(np.asarray(gravity, dtype=float))


def _smooth(values: np.ndarray, order: int = 0) -> np.ndarray:
    """Return values (N, n) on the coarse grid, or their time derivatives, smoothed by cubics over a moving window.

    `order` is the order of the derivative, 0 for the values themselves.
    """
    # Imported here because it is slow to load.
    from scipy.signal import savgol_filter

    size = 2 * min(HALF_WIDTH, (len(values) - 1) // 2) + 1
    degree = min(3, size - 1)
    return np.asarray(savgol_filter(values, size, degree, order, STEP, axis=0))


@dataclass(frozen=True, eq=False)
class MotionSamples:
    """N samples of a recorded motion of n joints, from which the regressors of the torques are computed.

    Attributes:
        index: (N,) indices of the samples in the motion.
        q, v, a: (N, n) [rad or m, per s, per s²].
        effort, velocity: (M, n) smoothed torques [N m or N], and velocities [per s], of all M samples of the motion.
        bodies: rigid bodies of the robot.
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
        """Smoothed torques (N, n) at the samples."""
        return self.effort[self.index]

    @cached_property
    def inertial(self) -> np.ndarray:
        """Regressor of the bodies (N, n, 10 B)."""
        columns = regressor(self.bodies, self.q, self.v, self.a)
        return columns.reshape(*self.q.shape, -1)

    @cached_property
    def at_rest(self) -> np.ndarray:
        """Regressor of the bodies at zero velocity and acceleration (N, n, 10 B): gravity alone."""
        zero = np.zeros_like(self.v)
        columns = regressor(self.bodies, self.q, zero, zero)
        return columns.reshape(*self.q.shape, -1)

    @cached_property
    def drives(self) -> np.ndarray:
        """Regressor of the drives (N, n, 4 n): motor inertia, viscous and Coulomb friction, offset of each joint."""
        m, n = self.q.shape
        joints = np.arange(n)
        columns = np.zeros((m, n, n, 4))
        columns[:, joints, joints] = drive_columns(self.v, self.a)
        return columns.reshape(m, n, -1)


@lru_cache(maxsize=CACHED)
def base_columns(bodies: Bodies) -> np.ndarray:
    """Return the indices of independent columns of the bodies' regressor, in any motion a basis of all columns.

    Args:
        bodies: rigid bodies of a robot.
    """
    q, v, a = np.random.default_rng(0).standard_normal((3, RANDOM_STATES, bodies.n))
    columns = regressor(bodies, q, v, a)
    return split_columns(columns.reshape(-1, columns.shape[2])).kept


def take_samples(case: Case, bodies: Bodies, count: int) -> MotionSamples | None:
    """Return about `count` samples of a recording of motor torques; None if too few are usable.

    Samples near the ends of a segment are omitted.

    Args:
        case: the recording.
        bodies: rigid bodies of the robot.
        count: number of samples.
    """
    # Imported here because it is slow to load.
    from scipy.ndimage import uniform_filter1d

    motion = case.motion
    edge = int(SEGMENT_EDGE * motion.rate)
    pieces = [np.arange(start + edge, stop - edge) for start, stop in segments(motion.segment)]
    inner = np.concatenate(pieces)
    if len(inner) < 20 * motion.n or case.target.shape[1] != motion.n:
        return None
    index = inner[:: max(1, len(inner) // count)]
    window = 2 * max(1, round(TORQUE_WINDOW * motion.rate) // 2) + 1
    effort = uniform_filter1d(np.array(case.target), window, axis=0, mode="nearest")
    q = np.ascontiguousarray(motion.q[index])
    v = np.ascontiguousarray(motion.v[index])
    a = np.ascontiguousarray(motion.a[index])
    return MotionSamples(index, q, v, a, effort, motion.v, bodies)


def drive_columns(v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the drive columns (..., 4) for velocities and accelerations (...): a, v, smoothed sign(v), and 1."""
    sign = np.tanh(v / CREEP)
    return np.stack([a, v, sign, np.ones_like(v)], axis=-1)


def basis(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (N, k) of the space that columns (N, p) span."""
    return np.asarray(columns @ spanning(columns.T @ columns))


def spanning(square: np.ndarray) -> np.ndarray:
    """Return the matrix S (p, k) for which W S is an orthonormal basis of the column space of W, from WᵀW (p, p).

    Args:
        square: WᵀW of the columns W (N, p); k is their rank.
    """
    size = np.sqrt(np.diag(square))
    nonzero = np.flatnonzero(size > 1e-9 * size.max(initial=0.0))
    nonzero_size = size[nonzero]
    block = square[np.ix_(nonzero, nonzero)]
    scale = nonzero_size[:, None] * nonzero_size
    values, vectors = np.linalg.eigh(block / scale)
    independent = values > 1e-9 * values.max(initial=0.0)
    result = np.zeros((len(size), int(independent.sum())))
    unit_directions = vectors[:, independent] / np.sqrt(values[independent])
    result[nonzero] = unit_directions / nonzero_size[:, None]
    return result

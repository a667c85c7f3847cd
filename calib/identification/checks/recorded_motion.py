"""Checks of a recording against the designed motion and the robot's nominal masses.

Everything is looked at on a coarse common grid; `calib.trajectories.recall` finds the motion and its repetitions. What
quick
looks at torques share stands here, too: a few samples of a recording, and how much columns explain of its torques.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from calib.column_changes import Change, assigned, best_changes, coupling, couplings
from calib.data.recordings.recording import Recording
from calib.dynamics.bodies import Bodies, bodies_of, standard_parameters
from calib.dynamics.rigid_body import inverse_dynamics, regressor
from calib.identification.rows import Case, segments
from calib.robot.chain import Chain
from calib.trajectories.errors import BadInput
from calib.trajectories.recall import Recalled, find_periods, sliding_products

EDGE_TIME = 0.25  # kept before and after the motion [s], for the filters' borders
STEP = 0.01  # of the coarse grid [s] (this and all below: our choice)
SPEEDS = (0.1, 0.2, 0.25, 0.5, 2.0)  # rehearsal factors that are tried to explain another motion
UNITS = (1.0, np.pi / 180, 180 / np.pi)  # factors on recorded positions that are tried
CREEP = 0.05  # speed over which the sign of Coulomb friction is smoothed [rad/s or m/s]
Pair = tuple[np.ndarray, np.ndarray]
"""Recorded positions (N, n), and one period of a motion (P, n)."""


class DesignedMotion(Protocol):
    """A periodic motion of n joints: its period [s], and a function of times (N,) that returns q, v and a."""

    @property
    def period(self) -> float: ...

    def orders(self, times: np.ndarray, /) -> tuple[np.ndarray, np.ndarray, np.ndarray]: ...


@dataclass(frozen=True)
class LocatedMotion:
    """Location of a designed motion in a recording.

    Attributes:
        start, stop: of the complete repetitions with a short margin [s], in the recording's time.
        began: of the first of them, where the positions match best [s]: later than asked for by the tracking lag.
        periods: number of complete repetitions.
        tracking: (n,) rms of recorded minus designed positions [rad or m].
        likeness: smallest share of the motion's variance that a recorded period explains.
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
    """Return the repetitions of a designed motion in a recording; None if it contains none."""
    grid, q = _on_grid(recording)
    reference = _one_period(motion)
    found = _found(q, reference)
    if found is None:
        return None
    start, stop = grid[found.start], grid[min(found.rows.stop, len(grid) - 1)]
    played = q[found.rows] - np.tile(reference, (found.periods, 1))[: len(q[found.rows])]
    tracking = np.sqrt(np.mean(played**2, axis=0))
    return LocatedMotion(
        start=max(float(recording.t[0]), float(start) - EDGE_TIME),
        stop=min(float(recording.t[-1]), float(stop) + EDGE_TIME),
        began=float(start) + STEP * found.lag,
        periods=found.periods,
        tracking=tuple(map(float, tracking)),
        likeness=min(found.likeness),
        loosest=int(np.argmax(tracking / np.maximum(np.std(reference, axis=0), 1e-9))),
    )


def another_motion(recording: Recording, motion: DesignedMotion, others: Mapping[str, DesignedMotion]) -> Change | None:
    """Return the change of the designed motion that explains a recording, e.g. other units; None if no tested one does.

    Args:
        recording: of n joints.
        motion: the one that was to be played; it is tried at other `SPEEDS`, in other `UNITS`, with its columns swapped
            and reversed, and with joints that count from the one before them.
        others: designed motions by name, one of which may have been played instead.
    """
    q, reference = _on_grid(recording)[1], _one_period(motion)

    def instead(other: DesignedMotion, speed: float = 1.0) -> Callable[[Pair], Pair]:
        return lambda data: (data[0], _one_period(other, speed))

    def altered(matrix: np.ndarray) -> Callable[[Pair], Pair]:
        return lambda data: (data[0] @ matrix.T, data[1])

    table = [Change("motion-exchanged", instead(other), values={"motion": name}) for name, other in others.items()]
    table += [Change("motion-rehearsed", instead(motion, speed), values={"speed": speed}) for speed in SPEEDS]
    if len(q) >= len(reference):
        order, sign = _best_order(q, reference)
        moved = sign[:, None] * np.eye(len(order))[order]
        values = {"order": order.tolist(), "sign": sign.tolist()}
        table += [Change("motion-altered", altered(unit * moved), values={"unit": unit, **values}) for unit in UNITS]
    table += [
        Change("motion-coupled", altered(coupling(len(q[0]), j, k, way)), (j, k), {"way": "+-"[way < 0.0]})
        for j, k, way in couplings(len(q[0]))
    ]
    found = best_changes((q, reference), table, _unlike)
    return found and found.changes[0]


def _on_grid(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    grid = _coarse(recording.t)
    return grid, _sampled(recording.t, recording.q, grid)


def _coarse(t: np.ndarray, max_gap: float = 60.0) -> np.ndarray:
    """Return a time grid with spacing `STEP` [s] over sample times (N,); longer gaps are cut to `max_gap`.

    `max_gap`: between samples that the grid bridges [s]; a log may go on after weeks.
    """
    last = np.flatnonzero(np.diff(t) > max_gap)
    spans = zip(t[np.append(0, last + 1)], np.append(t[last] + max_gap, t[-1]))
    return np.concatenate([np.arange(start, stop, STEP) for start, stop in spans])


def _sampled(t: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(grid, t, column) for column in values.T])


def _one_period(motion: DesignedMotion, speed: float = 1.0) -> np.ndarray:
    """Return the positions (P, n) of one period of a motion, sampled about every `STEP`, at `speed` times its speed."""
    count = round(motion.period / speed / STEP)
    return motion.orders(np.arange(count) * motion.period / count)[0]


def _found(q: np.ndarray, reference: np.ndarray, min_likeness: float = 0.9) -> Recalled | None:
    # min_likeness: share of the motion's variance a recorded period has to explain
    try:
        return find_periods(q, reference, likeness=min_likeness)
    except BadInput:
        return None


def _unlike(data: Pair) -> np.ndarray:
    """Return the share (1,) of a motion's variance that the worst recorded period leaves unexplained; 1 if none is."""
    found = _found(*data)
    return np.array([1.0 if found is None else max(1.0 - min(found.likeness), 1e-9)])


def _best_order(q: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each joint the recorded column (n,) and its sign (n,) that correlate best with the designed motion."""
    n = reference.shape[1]
    likeness = np.zeros((2, n, n))
    for j in range(n):
        r = reference[:, j] - reference[:, j].mean()
        for k in range(n):
            x = q[:, k] - q[:, k].mean()
            crossed = sliding_products(x, r) / max(np.linalg.norm(r), 1e-12)
            power = np.sqrt(np.maximum(sliding_products(x**2, np.ones(len(r))), 1e-12))
            likeness[0, j, k], likeness[1, j, k] = (crossed / power).max(), (-crossed / power).max()
    return assigned(-likeness)


def share_of_nominal(
    t: np.ndarray,
    q: np.ndarray,
    effort: np.ndarray,
    chain: Chain,
    gravity: Sequence[float] | None = None,
    static: bool = False,
) -> np.ndarray:
    """Return the ratios (n,) of recorded torques to those of the nominal masses, with the drives estimated as well.

    Least squares of τ_j on [τ_nominal,j, a_j, v_j, tanh(v_j / v0), 1] on the coarse grid: without the rotor's inertia
    (a_j) it is taken for mass. A joint counts where its rigid-body torque is more than `min_torque` of its limit and
    the partial correlation of both torques is above `min_sign_correlation`.

    Args:
        t: (N,) [s]; q, effort: (N, n).
        chain: the arm with its nominal masses.
        gravity: [m/s²], where it is not the robot's own.
        static: compare torques of gravity alone, the others left free like the drives'.

    Returns:
        (n,) factors on τ_nominal: 1 for right masses, below 0 for a reversed sign; NaN for joints that do not count.
    """
    grid = _coarse(t)
    torque, place = _smooth(_sampled(t, effort, grid)), _sampled(t, q, grid)
    q, v, a = (_smooth(place, order) for order in range(3))
    bodies, parameters = bodies_under(chain, gravity), standard_parameters(chain)
    rigid = inverse_dynamics(bodies, parameters, q, v, a)
    other = None
    if static:
        still = inverse_dynamics(bodies, parameters, q, np.zeros_like(v), np.zeros_like(a))
        rigid, other = still, rigid - still
    limit = np.array([joint.effort for joint in chain.joints])
    min_torque = 0.03  # of the torque limit: rigid-body torques smaller than this say nothing
    default_limit = 100.0  # torque limit of a joint that states none [N m or N]
    heavy = rigid.std(axis=0) > min_torque * np.where(np.isfinite(limit), limit, default_limit)
    share = np.full(chain.n, np.nan)
    # partial correlation with the torque of the nominal masses from which on its sign counts
    min_sign_correlation = 0.8
    for j in np.flatnonzero(heavy):
        drive = drive_columns(v[:, j], a[:, j])
        free = drive if other is None else np.column_stack([drive, other[:, j]])
        own, seen = (x - free @ np.linalg.lstsq(free, x, rcond=None)[0] for x in (rigid[:, j], torque[:, j]))
        common, power = own @ seen, own @ own
        if abs(common) / max(np.sqrt(power * (seen @ seen)), 1e-12) > min_sign_correlation:
            share[j] = common / max(power, 1e-12)
    return share


def bodies_under(chain: Chain, gravity: Sequence[float] | None) -> Bodies:
    """Return the chain's bodies with gravity set to the given vector [m/s²]; None keeps the chain's gravity."""
    bodies = bodies_of(chain)
    return bodies if gravity is None else bodies.with_gravity(np.asarray(gravity, dtype=float))


def _smooth(values: np.ndarray, order: int = 0, half_width: int = 10) -> np.ndarray:
    """Return values (N, n) of the coarse grid, or their derivatives, smoothed by cubics over a moving window.

    `half_width`: half width of the window for derivatives, in steps of the coarse grid.
    """
    from scipy.signal import savgol_filter  # slow to load

    size = 2 * min(half_width, (len(values) - 1) // 2) + 1
    return np.asarray(savgol_filter(values, size, min(3, size - 1), order, STEP, axis=0))


@dataclass(frozen=True, eq=False)
class MotionSamples:
    """N samples of a recorded motion of n joints, with the regressors of its torques.

    Attributes:
        index: (N,) indices of the samples in the motion.
        q, v, a: (N, n).
        effort: torques of the whole motion, smoothed; velocity: of the whole motion.
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
        """Torques (N, n), smoothed."""
        return self.effort[self.index]

    @cached_property
    def inertial(self) -> np.ndarray:
        """Regressor of the bodies (N, n, 10 B)."""
        return regressor(self.bodies, self.q, self.v, self.a).reshape(*self.q.shape, -1)

    @cached_property
    def at_rest(self) -> np.ndarray:
        """Regressor of the bodies at rest (N, n, 10 B): gravity alone."""
        still = np.zeros_like(self.v)
        return regressor(self.bodies, self.q, still, still).reshape(*self.q.shape, -1)

    @cached_property
    def drives(self) -> np.ndarray:
        """Regressor of the drives (N, n, 4 n): Ia, Fv, Fc and off of each joint."""
        m, n = self.q.shape
        found, joints = np.zeros((m, n, n, 4)), np.arange(n)
        found[:, joints, joints] = drive_columns(self.v, self.a)
        return found.reshape(m, n, -1)


def take_samples(case: Case, bodies: Bodies, count: int) -> MotionSamples | None:
    """Return about `count` samples of a recording of motor torques; None if too few are usable."""
    from scipy.ndimage import uniform_filter1d  # slow to load

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
    size = 2 * max(1, round(window * motion.rate) // 2) + 1  # odd
    effort = uniform_filter1d(np.array(case.target), size, axis=0, mode="nearest")
    q, v, a = (np.ascontiguousarray(x[index]) for x in (motion.q, motion.v, motion.a))
    return MotionSamples(index, q, v, a, effort, motion.v, bodies)


def drive_columns(v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the drive columns (..., 4) of velocities and accelerations (...): a, v, smoothed sign(v), and 1."""
    return np.stack([a, v, np.tanh(v / CREEP), np.ones_like(v)], axis=-1)


def basis(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (N, k) of the column space of (N, p)."""
    return np.asarray(columns @ spanning(columns.T @ columns))


def spanning(square: np.ndarray) -> np.ndarray:
    """Return the matrix (p, k) that turns columns W into an orthonormal basis of their space, from WᵀW (p, p)."""
    size = np.sqrt(np.diag(square))
    used = np.flatnonzero(size > 1e-9 * size.max())
    values, vectors = np.linalg.eigh(square[np.ix_(used, used)] / (size[used, None] * size[used]))
    kept = values > 1e-9 * values[-1]
    result = np.zeros((len(size), int(kept.sum())))
    result[used] = vectors[:, kept] / np.sqrt(values[kept]) / size[used, None]
    return result

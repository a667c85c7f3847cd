"""Checks whether a recording belongs to a robot: masses, limits, joints' signs, order and zeros, and the clock.

Numbers only; what they mean for a verdict is said in `calib.procedure.dynamic_stage.plausibility`. Everything is looked
at on a few samples. All thresholds are our choice; on the real recordings at hand (Panda, KR300, LWR4+, TX40, TIAGo, 22
of a UR10e) none is reached.

A clock that runs s times too slow makes accelerations s² times too small, so that inertias come out s² times too large
while masses, which gravity identifies, stay as they are. How large inertias are compared with masses, lengths alone say
nearly: for rods between the joints their ratio is known up to 17 % on every recording at hand that identifies it
(Panda, LWR4+, TX40, 11 of a UR10e), whatever the masses and the unit of the torques are. All these have six joints or
more; arms of two, whose last link has no known length, are not looked at: one gave 45. A simulated TX40 gave 0.46; so
where the description has masses, inertias are compared with these if they are nearer (0.9 to 1.2 on these recordings).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np
from scipy.optimize import nnls

from calib.column_changes import Change, Explanation, best_changes, coupling, couplings, exchange, reversal
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.rigid_body import inverse_dynamics
from calib.estimation.whiteness import inflation
from calib.identification.checks.recorded_motion import (
    MotionSamples,
    basis,
    bodies_under,
    drive_columns,
    share_of_nominal,
    spanning,
    take_samples,
)
from calib.identification.checks.torque_lag import Lag, lag_of
from calib.identification.prior import rods
from calib.identification.rows import Case, segments
from calib.robot.chain import Chain


@dataclass(frozen=True)
class ClockRatio:
    """Ratio of identified inertias to masses, relative to that of rods between the joints, and its relative sigma."""

    ratio: float
    relative_sigma: float

    @property
    def clock(self) -> float:
        """Factor by which the time stamps are too large."""
        return float(np.sqrt(self.ratio))


def clock_ratio(samples: MotionSamples, chain: Chain) -> ClockRatio | None:
    """Return the ratio of inertias to masses; None if the motion or the arm does not identify both.

    Torques are τ = α τ_rods + free: α of the rods' torques of motion beside any torque of gravity, then α of their
    gravity beside any torque of motion; drives free in both. Where the description has masses, the ratio to theirs
    counts if it is nearer to 1.
    """
    min_joints = 3  # of the shortest arm that is looked at (our choice)
    if chain.n < min_joints:
        return None
    wholes = [np.asarray(rods(chain, IdentificationModel(bodies_of(chain), ()))).ravel()]
    if chain.inertias is not None and chain.inertias[:, 9].any():
        wholes.append(standard_parameters(chain))
    found = [one for whole in wholes if (one := _ratio_to(whole, samples)) is not None]
    return min(found, key=lambda one: abs(np.log(one.ratio)), default=None)


def _ratio_to(whole: np.ndarray, samples: MotionSamples) -> ClockRatio | None:
    """Return the ratio of inertias to masses over that of bodies (10 B,); None where it is not identified."""
    still, moving = samples.at_rest, samples.inertial - samples.at_rest
    inertia, own = common_factor(samples.torque, moving @ whole, np.concatenate([still, samples.drives], axis=2))
    mass, other = common_factor(samples.torque, still @ whole, np.concatenate([moving, samples.drives], axis=2))
    min_factor_sigmas = 5.0  # sigmas from which on a factor is told
    if inertia < min_factor_sigmas * own or mass < min_factor_sigmas * other:
        return None
    return ClockRatio(inertia / mass, float(np.hypot(own / inertia, other / mass)))


def common_factor(torque: np.ndarray, common: np.ndarray, free: np.ndarray, rounds: int = 3) -> tuple[float, float]:
    """Return α of torques τ (m, n) = α common + free x and its sigma, each joint weighted by its residual.

    `rounds`: of weighing joints by what is left of them.
    """
    m, n = torque.shape
    weight, left, own = np.ones(n), torque, common
    alpha = power = 0.0
    for _ in range(rounds):
        scale = np.repeat(weight, m)
        rows = free.transpose(1, 0, 2).reshape(m * n, -1) * scale[:, None]
        spanned = basis(rows)
        seen, part = (x - spanned @ (spanned.T @ x) for x in (torque.T.ravel() * scale, common.T.ravel() * scale))
        power = float(part @ part)
        if not power > 0.0:
            return 0.0, np.inf
        alpha = float(part @ seen) / power
        left, own = ((x / scale).reshape(n, m) for x in (seen - alpha * part, part))
        weight = 1.0 / np.maximum(left.std(axis=1), 1e-9 * max(float(torque.std()), 1e-300))
    spread = [inflation(each) for each in left]
    return alpha, float(np.sqrt(np.sum(weight[:, None] ** 2 * own**2 * np.array(spread)[:, None]))) / power


def wrong_joints(samples: MotionSamples) -> Explanation | None:
    """Return the joints with reversed or exchanged torques, or coupled positions; None if all joints are right.

    One model of all joints is fitted to each: bodies and offsets of any size, Ia, Fv and Fc of every drive not
    negative, since no drive brakes backwards. The robot's own masses need not be known. What is left are shares of the
    joints' torques.
    """
    n = samples.q.shape[1]
    shares = cache(_shares)

    def mixed(matrix: np.ndarray) -> Callable[[tuple], tuple]:
        return lambda data: (data[0], matrix @ data[1])

    def counted(matrix: np.ndarray) -> Callable[[tuple], tuple]:
        return lambda data: (_changed(data[0], matrix), data[1])

    # shares that may be left: sound recordings at hand are left 0.91 and more, and 0.84 by couplings (our choice)
    max_left, max_left_coupled, max_left_exchanged = 0.8, 0.7, 0.6
    table = [Change("torque-sign", mixed(reversal(n, j)), (j,), max_left=max_left) for j in range(n)]
    table += [
        Change("torques-exchanged", mixed(exchange(n, *pair)), pair, max_left=max_left_exchanged)
        for pair in combinations(range(n), 2)
    ]
    table += [
        Change("axis-coupled", counted(coupling(n, j, k, way)), (j, k), {"way": "+-"[way < 0.0]}, max_left_coupled)
        for j, k, way in couplings(n)
    ]
    return best_changes((samples, np.eye(n)), table, lambda data: shares(data[0])(data[1]), max_changes=n)


def _shares(samples: MotionSamples) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from torques by joint to the unexplained share of each one's variance (n,).

    Its argument (n, n) mixes the recorded columns: the identity, with signs reversed or rows exchanged.
    """
    m, n = samples.q.shape
    scale = 1.0 / np.maximum(samples.torque.std(axis=0), 1e-12)

    def rows(columns: np.ndarray) -> np.ndarray:
        return (columns * scale[:, None]).transpose(1, 0, 2).reshape(n * m, -1)

    drives = samples.drives.reshape(m, n, n, 4)
    free = rows(np.concatenate([samples.inertial, drives[..., 3]], axis=2))
    free = free @ spanning(free.T @ free)
    positive = rows(drives[..., :3].reshape(m, n, -1))
    positive /= np.maximum(np.abs(positive).max(axis=0), 1e-12)
    positive -= free @ (free.T @ positive)
    across, triangle = np.linalg.qr(positive)

    def left(mixing: np.ndarray) -> np.ndarray:
        torque = (scale * (samples.torque @ mixing.T)).T.ravel()
        power = torque.reshape(n, m).var(axis=1)
        torque = torque - free @ (free.T @ torque)
        residual = torque - positive @ nnls(triangle, across.T @ torque)[0]
        return np.maximum((residual.reshape(n, m) ** 2).mean(axis=1) / np.maximum(power, 1e-300), 1e-9)

    return left


def rearranged(samples: MotionSamples, chain: Chain) -> Explanation | None:
    """Return the exchange of two joints or the zero offset of one joint that best explains the torques, or None.

    The torques are those of the robot's own masses, and what is left of each joint's is a share of its variance.
    """
    n, masses = chain.n, standard_parameters(chain)
    samples = replace(samples, index=np.arange(len(samples.index)), effort=samples.torque)

    def exchanged(pair: tuple[int, int]) -> Callable[[MotionSamples], MotionSamples]:
        return lambda data: replace(_changed(data, exchange(n, *pair)), effort=data.effort @ exchange(n, *pair))

    def turned(joint: int, angle: float) -> Callable[[MotionSamples], MotionSamples]:
        return lambda data: replace(data, q=data.q + angle * np.eye(n)[joint])

    speed = samples.v.std(axis=0)
    max_left = 0.5  # largest share of their torques' variance that is left as recorded
    min_exchanged_speed = 0.3  # rms, of the fastest joint's: one that hardly moves may have any column
    moves = np.flatnonzero((speed > min_exchanged_speed * speed.max()) & (_left(samples, masses) < max_left)).tolist()
    turning = [j for j, joint in enumerate(chain.joints) if joint.kind != "prismatic"]
    table = [Change("columns-exchanged", exchanged(pair), pair) for pair in combinations(moves, 2)]
    table += [
        Change("zero-elsewhere", turned(j, angle), (j,), {"angle": angle})
        for j in turning
        for angle in (0.5 * np.pi, np.pi, -0.5 * np.pi)
    ]
    return best_changes(samples, table, lambda changed: _left(changed, masses))


def _changed(samples: MotionSamples, matrix: np.ndarray) -> MotionSamples:
    """Return samples with the joints' positions, velocities and accelerations multiplied by a matrix (n, n)."""
    q, v, a = (np.ascontiguousarray(x @ matrix.T) for x in (samples.q, samples.v, samples.a))
    return replace(samples, q=q, v=v, a=a)


def _left(samples: MotionSamples, masses: np.ndarray) -> np.ndarray:
    """Return the unexplained share of each joint's torque variance (n,).

    Each torque is that of gravity and that of motion, by the robot's masses, each times a factor, its own drive and
    those of the joints beside it: wrists are coupled by their gears, which an exchange would seem to explain.
    """
    still = inverse_dynamics(samples.bodies, masses, samples.q, np.zeros_like(samples.v), np.zeros_like(samples.a))
    moving = inverse_dynamics(samples.bodies, masses, samples.q, samples.v, samples.a) - still
    drives, shares = drive_columns(samples.v, samples.a), []
    for joint, torque in enumerate((samples.torque - samples.torque.mean(axis=0)).T):
        beside = drives[:, max(joint - 1, 0) : joint + 2].reshape(len(torque), -1)
        spanned = basis(np.column_stack([still[:, joint], moving[:, joint], beside]))
        shares.append(1.0 - ((torque @ spanned) ** 2).sum() / max(float(torque @ torque), 1e-300))
    return np.maximum(shares, 1e-9)


MAX_LAG_SAMPLES, MAX_SAMPLES = 1500, 500  # samples on which a lag is looked for, and all else
FOLLOWS = 0.9  # correlation from which on measured velocities, integrated, are the positions


@dataclass(frozen=True)
class RecordingSizes:
    """Results of comparing a recording with the robot's description: masses, limits, velocities, lag and clock.

    Attributes:
        name: name of the case.
        masses: (n,) recorded gravity torque over that of the nominal masses; NaN where a joint does not identify it.
        limits: (n,) torques over the joints' limits, without the largest 1 % of them; NaN where no limit is known.
        speed: (n,) measured velocities over the slopes of the positions; NaN without velocities or travel, or
            where the two are not correlated.
        speed_sigma: (n,) sigma of `speed`.
        follows: (n,) correlation of the measured velocities' integrals with the positions; NaN without travel.
        counted: whether the samples' times are computed from the measured velocities.
        rate: sampling rate, by the samples' times [Hz].
        lag: lag of the torques; None where the recording is too short to estimate it.
        clock: ratio of inertias to masses; None where the motion does not identify it.
        other: change of the columns with which the masses explain more; None if no change does, or none was tested.
        jumps: text on jumps of the positions.
    """

    name: str
    masses: np.ndarray
    limits: np.ndarray
    speed: np.ndarray
    speed_sigma: np.ndarray
    follows: np.ndarray
    counted: bool
    rate: float
    lag: Lag | None
    clock: ClockRatio | None = None
    other: Explanation | None = None
    jumps: tuple[str, ...] = ()


def compare_sizes(
    case: Case, chain: Chain, gravity: Sequence[float] | None = None, newtons: bool = True
) -> RecordingSizes:
    """Return a comparison of recorded motor torques, velocities and time stamps with the robot's description.

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
    limits = nothing
    spike_share = 0.01  # share of the samples that may be spikes
    if newtons and case.target.shape[1] == n:
        limit = np.array([joint.effort for joint in chain.joints])
        usual = np.quantile(np.abs(case.target), 1.0 - spike_share, axis=0)
        limits = np.where(np.isfinite(limit) & (limit > 0.0), usual / np.where(limit > 0.0, limit, 1.0), np.nan)
    speed, v = (nothing, nothing, nothing), motion.v_measured
    if v is not None:
        speed = _speed_ratio(motion.t, motion.q, v, motion.segment)
    counted = motion.sampling.clock.kind == "counted"
    bodies = bodies_under(chain, gravity)
    many, few = (take_samples(case, bodies, count) for count in (MAX_LAG_SAMPLES, MAX_SAMPLES))
    lag = None if many is None else lag_of(many, motion.rate)
    clock = clock_ratio(few, chain) if newtons and few is not None else None
    other = rearranged(few, chain) if known and few is not None else None
    return RecordingSizes(case.name, masses, limits, *speed, counted, motion.rate, lag, clock, other, motion.jumps)


def signs_of(case: Case, chain: Chain, gravity: Sequence[float] | None = None) -> Explanation | None:
    """Return the joints of a recording with reversed torques or coupled positions; None if it is too short."""
    few = take_samples(case, bodies_under(chain, gravity), MAX_SAMPLES)
    return None if few is None else wrong_joints(few)


def _speed_ratio(
    t: np.ndarray, q: np.ndarray, v: np.ndarray, segment: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ratios of measured velocities to differentiated positions, their sigmas, and correlations, (n,) each.

    That is ∫v dt on q, both without their trend: integrals compare where slopes are noise; each segment (N,) by itself,
    since nobody knows the speed in a gap. Of a short motion little is left beside its trend, while an error of the
    dates moves the whole travel. NaN for joints that hardly travel, and the ratio where velocities do not follow.
    """
    own, seen = np.array(q), np.empty_like(q)
    for a, b in segments(segment):
        step = np.diff(t[a:b])[:, None]
        seen[a:b] = np.concatenate([0.0 * v[a : a + 1], np.cumsum((v[a + 1 : b] + v[a : b - 1]) / 2 * step, axis=0)])
        trend = np.column_stack([np.ones(b - a), t[a:b] - t[a:b].mean()])
        for x in (own, seen):
            x[a:b] -= trend @ np.linalg.lstsq(trend, x[a:b], rcond=None)[0]
    power = np.maximum((own**2).sum(axis=0), 1e-300)
    ratio = (own * seen).sum(axis=0) / power
    date_error = 0.01  # share of a joint's travel by which errors of dates move its positions
    dated = date_error * np.ptp(q, axis=0) / np.maximum(np.ptp(own, axis=0), 1e-300)
    min_travel = 0.05  # a joint that travels less says nothing of its velocity's size [rad or m]
    travels = np.ptp(q, axis=0) > min_travel
    follows = np.where(travels, ratio * np.sqrt(power / np.maximum((seen**2).sum(axis=0), 1e-300)), np.nan)
    # independent errors in what velocities leave of the positions: those with a dead zone drift for long
    independent_errors = 6
    sigma = np.hypot(np.sqrt(((seen - ratio * own) ** 2).sum(axis=0) / power / independent_errors), dated)
    return np.where(travels & (follows > FOLLOWS), ratio, np.nan), sigma, follows

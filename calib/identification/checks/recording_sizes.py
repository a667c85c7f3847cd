"""Can recordings be of this robot? Its own masses, its limits, and the clock of the torques against that of positions.

Numbers only; what they mean for a verdict is said in `calib.procedure.dynamic_stage.plausibility`. Everything is looked
at on a few samples: sizes, signs and clocks, no model. All thresholds are our choice; on the real
recordings at hand (Panda, KR300, LWR4+, TX40, TIAGo, 22 of a UR10e) none is reached.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.column_changes import Explanation
from calib.dynamics.bodies import Bodies, bodies_of
from calib.identification.checks.motion_samples import take_samples
from calib.identification.checks.recorded_motion import share_of_nominal
from calib.identification.checks.torque_lag import Lag, lag_of
from calib.identification.checks.whole_robot import ClockRatio, clock_ratio, rearranged, wrong_joints
from calib.identification.rows import Case, segments
from calib.robot.chain import Chain

MAX_LAG_SAMPLES, MAX_SAMPLES = 1500, 500  # samples on which a lag is looked for, and all else
FOLLOWS = 0.9  # correlation from which on measured velocities, integrated, are the positions


@dataclass(frozen=True)
class RecordingSizes:
    """A recording beside the robot it is said to be of.

    Attributes:
        name: of the case.
        masses: (n,) recorded torque of gravity over that of the robot's own masses; NaN where a joint says nothing.
        limits: (n,) torques over the joints' limits, without the largest per cent of them; NaN where none is known.
        speed: (n,) measured velocities over the slopes of the positions; NaN where there are none, or no travel, or
            where the ones do not follow the others.
        speed_sigma: (n,) its sigma.
        follows: (n,) correlation of the measured velocities' integrals with the positions; NaN as `speed`.
        counted: whether the samples are dated by the measured velocities.
        rate: of the samples, by their dates [Hz].
        lag: of the torques; None where the recording is too short to estimate it.
        clock: inertias beside masses; None where the motion does not identify it.
        other: change of the columns with which the masses explain more; None where none does, or is looked for.
        jumps: of positions, in words.
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
    limits = nothing
    spike_share = 0.01  # share of the samples that may be spikes
    if newtons and case.target.shape[1] == n:
        limit = np.array([joint.effort for joint in chain.joints])
        usual = np.quantile(np.abs(case.target), 1.0 - spike_share, axis=0)
        limits = np.where(np.isfinite(limit) & (limit > 0.0), usual / np.where(limit > 0.0, limit, 1.0), np.nan)
    speed, v = (nothing, nothing, nothing), motion.v_measured
    if v is not None:
        speed = _speed_ratio(motion.t, motion.q, v, motion.segment)
    counted = motion.sampling.clock == "counted"
    bodies = _under(chain, gravity)
    many, few = (take_samples(case, bodies, count) for count in (MAX_LAG_SAMPLES, MAX_SAMPLES))
    lag = None if many is None else lag_of(many, motion.rate)
    clock = clock_ratio(few, chain) if newtons and few is not None else None
    other = rearranged(few, chain) if known and few is not None else None
    return RecordingSizes(case.name, masses, limits, *speed, counted, motion.rate, lag, clock, other, motion.jumps)


def signs_of(case: Case, chain: Chain, gravity: Sequence[float] | None = None) -> Explanation | None:
    """Return which joints have torques of the wrong sign, or count from another joint; arguments as `compare_sizes`."""
    few = take_samples(case, _under(chain, gravity), MAX_SAMPLES)
    return None if few is None else wrong_joints(few)


def _speed_ratio(
    t: np.ndarray, q: np.ndarray, v: np.ndarray, segment: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (n,) measured velocities over the slopes of the positions (N, n), the sigmas, and how alike they are.

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


def _under(chain: Chain, gravity: Sequence[float] | None) -> Bodies:
    bodies = bodies_of(chain)
    return bodies if gravity is None else bodies.with_gravity(np.asarray(gravity, dtype=float))

"""Checks whether a recording was made with the described robot: masses, limits, joints' signs, order, zeros, and clock.

This module computes numbers only; `calib.procedure.dynamic_stage.plausibility` turns them into findings. All checks use
a few samples. All thresholds are our choice; none is reached on the real recordings at hand (Panda, KR300, LWR4+, TX40,
TIAGo, 22 of a UR10e).

If a clock runs s times too slow, accelerations appear s² times too small, so that inertias are identified s² times too
large, while masses, which gravity identifies, are unaffected. The ratio of inertias to masses depends nearly on lengths
alone. The ratio of rods between the joints is correct within 17 % on every recording at hand that identifies it (Panda,
LWR4+, TX40, 11 of a UR10e), whatever the masses and the torques' unit are. All these arms have six joints or more. Arms
of two joints, whose last link has no known length, are not checked (the ratio of one was 45). The ratio of a simulated
TX40 was 0.46; therefore, if the description has masses, the ratio relative to the described bodies is used if it is
nearer to 1 (0.9 to 1.2 on these recordings).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.column_changes import Explanation
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.estimation.whiteness import inflation
from calib.identification.checks.mistaken_columns import rearranged, wrong_joints
from calib.identification.checks.recorded_motion import (
    MotionSamples,
    base_columns,
    basis,
    bodies_under,
    share_of_nominal,
    take_samples,
)
from calib.identification.checks.torque_lag import Lag, lag_of
from calib.identification.prior import rods
from calib.identification.rows import Case, segments
from calib.robot.chain import Chain

MAX_LAG_SAMPLES, MAX_SAMPLES = 1500, 500
"""Samples on which a lag is estimated, and everything else."""
FOLLOWS = 0.9
"""Correlation from which on measured velocities, integrated, are the positions."""
MIN_JOINTS = 3
"""Joints of the shortest arm whose clock is checked (our choice)."""
MIN_FACTOR_SIGMAS = 5.0
"""Sigmas from which on a factor of the inertias or masses is identified."""
ROUNDS = 3
"""Rounds of weighing joints by their residuals."""
SPIKE_SHARE = 0.01
"""Share of the samples that may be spikes."""
DATE_ERROR = 0.01
"""Share of a joint's travel by which errors of dates move its positions."""
MIN_TRAVEL = 0.05
"""Travel below which a joint says nothing of its velocity's size [rad or m]."""
INDEPENDENT_ERRORS = 6
"""Independent errors in what velocities leave of the positions: those with a dead zone drift for long."""


@dataclass(frozen=True)
class ClockRatio:
    """Ratio of inertias to masses of the recorded robot, divided by the ratio of reference bodies (rods).

    Attributes:
        ratio: the ratio, 1 for a correct clock.
        relative_sigma: standard deviation of the ratio over the ratio.
    """

    ratio: float
    relative_sigma: float

    @property
    def clock(self) -> float:
        """Factor by which the time stamps are too large: the square root of the ratio."""
        return float(np.sqrt(self.ratio))


def clock_ratio(samples: MotionSamples, chain: Chain) -> ClockRatio | None:
    """Return the ratio of inertias to masses; None if motion or arm do not identify both.

    Torques τ are modelled as α τ_rods + free, twice: α is a factor of τ_rods, the torques of rods between the joints.
    In the first fit α scales the rods' torques of motion, and any gravity torque is allowed; in the second, α scales
    the rods' gravity torques, and any torque of motion is allowed. Both fits include free drives. If the description
    has masses, the ratio relative to the described bodies is returned if it is nearer to 1.

    Args:
        samples: samples of a recording.
        chain: the arm.
    """
    if chain.n < MIN_JOINTS:
        return None
    bodies = bodies_of(chain)
    bodies_alone = IdentificationModel(bodies, ())
    robots = [np.asarray(rods(chain, bodies_alone)).ravel()]
    if chain.inertias is not None and chain.inertias[:, 9].any():
        robots.append(standard_parameters(chain))
    ratios = []
    for robot in robots:
        ratio = _ratio_to(robot, samples)
        if ratio is not None:
            ratios.append(ratio)
    return min(ratios, key=lambda ratio: abs(np.log(ratio.ratio)), default=None)


def _ratio_to(robot: np.ndarray, samples: MotionSamples) -> ClockRatio | None:
    """Return the robot's ratio of inertias to masses over the reference bodies' ratio; None if not identified.

    Args:
        robot: (10 B,) standard parameters of the reference bodies.
        samples: samples of a recording.
    """
    of_gravity = samples.at_rest
    of_motion = samples.inertial - of_gravity
    independent = base_columns(samples.bodies)
    beside_motion = np.concatenate([of_gravity[:, :, independent], samples.drives], axis=2)
    beside_gravity = np.concatenate([of_motion[:, :, independent], samples.drives], axis=2)
    inertia, inertia_sigma = common_factor(samples.torque, of_motion @ robot, beside_motion)
    mass, mass_sigma = common_factor(samples.torque, of_gravity @ robot, beside_gravity)
    if inertia < MIN_FACTOR_SIGMAS * inertia_sigma or mass < MIN_FACTOR_SIGMAS * mass_sigma:
        return None
    relative_sigma = float(np.hypot(inertia_sigma / inertia, mass_sigma / mass))
    return ClockRatio(inertia / mass, relative_sigma)


def common_factor(torque: np.ndarray, common: np.ndarray, free: np.ndarray) -> tuple[float, float]:
    """Return α and its sigma for torques τ (m, n) = α `common` + `free` x, each joint weighted by its residual.

    Args:
        torque: (m, n) torques τ [N m or N].
        common: (m, n) torques whose factor α all joints share, in the unit of τ.
        free: (m, n, p) columns with free parameters x.
    """
    m, n = torque.shape
    min_deviation = 1e-9 * max(float(torque.std()), 1e-300)
    weight = np.ones(n)
    residual, part = torque, common
    alpha = power = 0.0
    for _ in range(ROUNDS):
        scale = np.repeat(weight, m)
        flat = free.transpose(1, 0, 2).reshape(m * n, -1)
        columns = flat * scale[:, None]
        free_basis = basis(columns)
        torque_part = _without(free_basis, torque.T.ravel() * scale)
        common_part = _without(free_basis, common.T.ravel() * scale)
        power = float(common_part @ common_part)
        if not power > 0.0:
            return 0.0, np.inf
        alpha = float(common_part @ torque_part) / power
        residual = ((torque_part - alpha * common_part) / scale).reshape(n, m)
        part = (common_part / scale).reshape(n, m)
        weight = 1.0 / np.maximum(residual.std(axis=1), min_deviation)
    spread = np.array([inflation(joint_residual) for joint_residual in residual])
    variance = np.sum(weight[:, None] ** 2 * part**2 * spread[:, None])
    return alpha, float(np.sqrt(variance)) / power


def _without(orthonormal: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (N,) minus their projection onto an orthonormal basis (N, k)."""
    return values - orthonormal @ (orthonormal.T @ values)


@dataclass(frozen=True)
class RecordingSizes:
    """Comparison of a recording with the robot's description: masses, limits, velocities, lag and clock.

    Attributes:
        name: name of the recording.
        masses: (n,) recorded gravity torque over that of the nominal masses; NaN where it is not identified.
        limits: (n,) largest torque, ignoring the largest 1 %, over the joint's limit; NaN where no limit is known.
        speed: (n,) measured velocities over the slopes of the positions; NaN without velocities or travel, or if the
            two are not correlated.
        speed_sigma: (n,) standard deviation of `speed`.
        follows: (n,) correlation of the integrated measured velocities with the positions; NaN without travel.
        counted: whether the samples' times were computed by counting samples, from the measured velocities.
        rate: sampling rate according to the time stamps [Hz].
        lag: lag of the torques; None if the recording is too short to estimate it.
        clock: ratio of inertias to masses; None if the motion does not identify it.
        other: change of the columns with which the masses explain the torques better; None if no change does, or none
            was tested.
        jumps: texts on jumps of the positions.
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

    def without_masses(self) -> "RecordingSizes":
        """Return the comparison without masses and clock, which wrong columns of the recording change as well."""
        unknown = np.full_like(self.masses, np.nan)
        return replace(self, masses=unknown, clock=None, other=None)


def compare_sizes(
    case: Case, chain: Chain, gravity: Sequence[float] | None = None, newtons: bool = True
) -> RecordingSizes:
    """Return a comparison of recorded motor torques, velocities and time stamps with the robot's description.

    Args:
        case: a recording.
        chain: the arm; its masses are used if it has any.
        gravity: (3,) gravity vector in the base frame [m/s²]; None: the chain's.
        newtons: whether the torques are in N m; torques from currents without known gains are not compared with masses.
    """
    motion = case.motion
    unknown = np.full(chain.n, np.nan)
    of_motors = newtons and case.target.shape[1] == chain.n
    has_masses = False
    if chain.inertias is not None:
        has_masses = bool(np.any(chain.inertias[:, 9] > 0.0))

    masses, limits = unknown, unknown
    if of_motors and has_masses:
        masses = share_of_nominal(motion.t, motion.q, case.target, chain, gravity, static=True)
    if of_motors:
        limit = np.array([joint.effort for joint in chain.joints])
        torque = np.quantile(np.abs(case.target), 1.0 - SPIKE_SHARE, axis=0)
        share = torque / np.where(limit > 0.0, limit, 1.0)
        limits = np.where(np.isfinite(limit) & (limit > 0.0), share, np.nan)
    speed, speed_sigma, follows = unknown, unknown, unknown
    if motion.v_measured is not None:
        speed, speed_sigma, follows = _speed_ratio(motion.t, motion.q, motion.v_measured, motion.segment)

    bodies = bodies_under(chain, gravity)
    lag_samples = take_samples(case, bodies, MAX_LAG_SAMPLES)
    samples = take_samples(case, bodies, MAX_SAMPLES)
    lag, clock, other = None, None, None
    if lag_samples is not None:
        lag = lag_of(lag_samples, motion.rate)
    if newtons and samples is not None:
        clock = clock_ratio(samples, chain)
    if of_motors and has_masses and samples is not None:
        other = rearranged(samples, chain)
    counted = motion.sampling.clock.kind == "counted"
    return RecordingSizes(
        name=case.name,
        masses=masses,
        limits=limits,
        speed=speed,
        speed_sigma=speed_sigma,
        follows=follows,
        counted=counted,
        rate=motion.rate,
        lag=lag,
        clock=clock,
        other=other,
        jumps=motion.jumps,
    )


def signs_of(case: Case, chain: Chain, gravity: Sequence[float] | None = None) -> Explanation | None:
    """Return the changes of a recording's columns that explain its torques much better.

    The result is None if all columns are correct or the recording is too short.

    Args:
        case: a recording.
        chain: the arm.
        gravity: (3,) gravity vector in the base frame [m/s²]; None: the chain's.
    """
    bodies = bodies_under(chain, gravity)
    samples = take_samples(case, bodies, MAX_SAMPLES)
    return None if samples is None else wrong_joints(samples)


def _speed_ratio(
    t: np.ndarray, q: np.ndarray, v: np.ndarray, segment: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return measured velocities over differentiated positions, their standard deviations, and correlations, (n,) each.

    The ratio is the regression coefficient of ∫v dt on q, both detrended, since slopes of q are noisy. Each segment is
    integrated separately, since the velocity in a gap is unknown. The correlation is NaN for joints that hardly move;
    the ratio is also NaN if the velocities do not follow the positions.

    Args:
        t: (N,) times [s].
        q, v: (N, n) positions [rad or m] and measured velocities [rad/s or m/s].
        segment: (N,) number of the gap-free segment of each sample.
    """
    position = np.array(q)
    integral = np.empty_like(q)
    for start, stop in segments(segment):
        part = slice(start, stop)
        step = np.diff(t[part])[:, None]
        mean_velocity = (v[start + 1 : stop] + v[start : stop - 1]) / 2
        travelled = np.cumsum(mean_velocity * step, axis=0)
        integral[part] = np.concatenate([0.0 * v[start : start + 1], travelled])
        centred = t[part] - t[part].mean()
        trend = np.column_stack([np.ones(stop - start), centred])
        position_trend = np.linalg.lstsq(trend, position[part], rcond=None)[0]
        position[part] -= trend @ position_trend
        integral_trend = np.linalg.lstsq(trend, integral[part], rcond=None)[0]
        integral[part] -= trend @ integral_trend
    power = np.maximum((position**2).sum(axis=0), 1e-300)
    integral_power = np.maximum((integral**2).sum(axis=0), 1e-300)
    ratio = (position * integral).sum(axis=0) / power
    travel = np.ptp(q, axis=0)
    travels = travel > MIN_TRAVEL
    follows = np.where(travels, ratio * np.sqrt(power / integral_power), np.nan)
    by_dates = DATE_ERROR * travel / np.maximum(np.ptp(position, axis=0), 1e-300)
    squares = ((integral - ratio * position) ** 2).sum(axis=0)
    by_noise = np.sqrt(squares / power / INDEPENDENT_ERRORS)
    sigma = np.hypot(by_noise, by_dates)
    return np.where(travels & (follows > FOLLOWS), ratio, np.nan), sigma, follows

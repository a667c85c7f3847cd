"""Coulomb signs and noise: what the encoders' noise does to the mean of a sign's column, by simulation.

A sign s(v) is not linear, so that noise does not average out of it, and no instruments remove what is left:

    noise e of the log alone       W has E s(v + e), the torque s(v);
    noise in the loop              the feedback moves the robot by d, too: W has E s(v + d + e), the torque E s(v + d).

Both are simulated with noise like the recording's, and what a recording would have made of the sign is taken back:

    W + ½ Σ_± [mean over the period of s(v_±) - s(filtered (q_± + e_±))]        (our choice)

v_± is the motion under the noise e and under -e, which cancels what is linear in the draw. v_± within a control period
is averaged by Simpson's rule: under a derivative of noise it changes by more than a sign's width from one instant to
the next. The measured sign remains, and with it reversals that the simulation does not know.

Both signs are those of a speed that is low-passed until its noise is a sign's width, but not below half the band: what
that rounds off is taken back with the rest, and less noise remains in the column.

The share of the noise that is in the loop is told by the torques: above the motion's band a controller answers the
noise that it sees, and no other. It is the slope of the recorded covariances of positions and torques, by lags, on
those of a simulation with all noise in the loop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from calib.data.signals.bandwidth import USABLE
from calib.data.signals.filtering import low_pass, slope
from calib.errors import CannotSimulate, NotConverged
from calib.identification.closed_loop.loop_recordings import Loop, simulated_case, simulated_samples
from calib.identification.closed_loop.simulated_runs import simulated_run
from calib.identification.closed_loop.simulation import Plant, Sensing, SimulatedRun
from calib.identification.closed_loop.timing import motor_torques
from calib.identification.rows import Case

# Of all noise drawn here; other than the seeds by which logs are simulated, whose noise must not be drawn again.
SEED = 20_190_613
# Control periods per sample of a noisy run, and Simpson's weights of the three samples of a period.
HALF = 0.5
SIMPSON = [1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0]
# Share of noise in the loop below which it is not simulated: of its effect on a sign it is less than 1 % (our choice).
MIN_SHARE = 0.1
# Samples by which torques may follow positions, beyond the controller's delay.
LAGS = 2


@dataclass(frozen=True, eq=False)
class PositionNoise:
    """Standard deviation of a recording's position noise in the loop and in the log alone, each (n,) [rad or m]."""

    loop: np.ndarray
    log: np.ndarray

    @property
    def share(self) -> np.ndarray:
        """Share of the noise that is in the loop (n,), 0 to 1."""
        return self.loop / np.maximum(np.hypot(self.loop, self.log), 1e-300)


def position_noise(plant: Plant, case: Case, loop: Loop) -> PositionNoise:
    """Return the noise of a recording's positions in the loop and in the log, by the torques that answer it.

    A recording without torques of the motors does not tell: its noise is taken to be in the loop.

    Args:
        plant: robot to simulate; it hardly matters, as torques answer noise by the controller's gains.
        case: the recording.
        loop: its closed loop.
    """
    motion = case.motion
    noise = motion.cutoffs.noise
    torque = motor_torques(case)
    if torque is None and motion.kind == "torque":
        torque = np.asarray(motion.effort)
    if torque is None or motion.q_measured is None:
        return PositionNoise(noise, np.zeros(motion.n))
    run = simulated_run(plant, case, loop, Sensing(sigma_q=noise, every=loop.every), SEED)
    samples = simulated_samples(case, run.t, loop)
    cutoff = min(float(np.max(motion.velocity_cutoff)), 0.5 * USABLE * motion.rate / 2)
    lags = LAGS + int(np.ceil(loop.controller.delay / loop.every))

    def answered(q: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return the covariances (lags, n) of positions and later torques above the cut-off.

        Args:
            q: (N, n) positions [rad or m].
            tau: (N, n) torques at the same samples [N m or N].
        """
        fast_q = q - low_pass(q, motion.rate, cutoff)
        fast_tau = tau - low_pass(tau, motion.rate, cutoff)
        count = len(q) - lags
        covariances = []
        for lag in range(lags + 1):
            products = fast_q[:count] * fast_tau[lag : lag + count]
            covariances.append(products.mean(axis=0))
        return np.array(covariances)

    expected = answered(run.measured[samples], run.tau[samples])
    recorded = answered(motion.q_measured, torque)
    slope = np.sum(recorded * expected, axis=0) / np.maximum(np.sum(expected**2, axis=0), 1e-300)
    share = np.clip(slope, 0.0, 1.0)
    share[share < MIN_SHARE] = 0.0
    return PositionNoise(share * noise, np.sqrt(1.0 - share**2) * noise)


def mean_signs(
    columns: Callable[[Case], np.ndarray],
    plant: Plant,
    case: Case,
    loop: Loop,
    run: SimulatedRun,
    noise: PositionNoise,
    width: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return columns of signs (M, rows, k), means over noise: of the true motion, and of that recorded and filtered.

    Args:
        columns: function of a case that returns its columns of signs.
        run: the noise-free run of the loop, at the recording's rate.
        plant: the simulated robot.
        case: the recording.
        loop: its closed loop.
        noise: standard deviations of the noise in the loop and in the log.
        width: as in `with_quiet_speed`.
    """
    true_means = []
    recorded_means = []
    for factor in (1.0, -1.0):
        q, speeds, weights = run.q, [run.v], [1.0]
        if np.any(noise.loop):
            q, speeds = _in_loop(plant, case, loop, run, factor * noise.loop)
            weights = SIMPSON
        error = factor * noise.log * np.random.default_rng([SEED, 1]).normal(size=q.shape)
        recorded = simulated_case(case, replace(run, q=q + error), loop)
        samples = simulated_samples(case, run.t, loop)
        recorded_columns = columns(with_quiet_speed(recorded, width))
        true_columns = np.zeros_like(recorded_columns)
        for weight, speed in zip(weights, speeds):
            motion = replace(recorded.motion, v=speed[samples])
            true_columns += weight * columns(replace(recorded, motion=motion))
        true_means.append(0.5 * true_columns)
        recorded_means.append(0.5 * recorded_columns)
    return true_means[0] + true_means[1], recorded_means[0] + recorded_means[1]


def with_quiet_speed(case: Case, width: float) -> Case:
    """Return the case with a speed whose noise is a sign's `width` [rad/s or m/s] at most, or that of half the band."""
    motion = case.motion
    noise = np.maximum(motion.velocity_noise(), 1e-300)
    cutoff = motion.velocity_cutoff * np.minimum(1.0, (width / noise) ** (2.0 / 3.0))
    cutoff = np.maximum(cutoff, 0.5 * motion.band)
    v = np.array(motion.v)
    for joint in np.flatnonzero(cutoff < motion.velocity_cutoff):
        q = low_pass(motion.q[:, joint], motion.rate, float(cutoff[joint]))
        quiet = slope(q, motion.rate)
        v[:, joint] = np.where(np.isnan(quiet), motion.v[:, joint], quiet)
    return replace(case, motion=replace(motion, v=v))


def _in_loop(
    plant: Plant, case: Case, loop: Loop, run: SimulatedRun, sigma: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return measured positions (N, n) at the instants of `run`, and velocities at begin, middle and end of periods.

    Args:
        sigma: (n,) standard deviations of the noise in the loop, all below 0 for the draw with its sign changed.
        plant: the simulated robot.
        case: the recording.
        loop: its closed loop.
        run: the noise-free run of the loop, whose N instants are used.

    Raises:
        CannotSimulate: if the loop is unstable under the noise.
    """
    try:
        noisy = simulated_run(plant, case, loop, Sensing(sigma_q=sigma, every=HALF), SEED)
    except NotConverged as error:
        raise CannotSimulate(f"under the noise of the positions {error}", error.last) from error
    places = np.arange(len(run.t)) * loop.every / HALF
    nearest = np.minimum(places.astype(int), len(noisy.t) - 1)
    error = (noisy.measured - noisy.q)[nearest]
    if np.all(places == nearest):
        q = noisy.q[nearest]
    else:
        q = CubicSpline(np.arange(len(noisy.t)), noisy.q)(places)
    speeds = []
    for step in range(len(SIMPSON)):
        instants = np.minimum(nearest + step, len(noisy.t) - 1)
        speeds.append(noisy.v[instants])
    return q + error, speeds

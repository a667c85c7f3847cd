"""Why a particle filter is none of the methods: its error and time beside the Kalman filters', on a study's conditions.

    python examples/survey/particle_filter.py [--conditions MCS-RV2SQ-1-1,MCS-TX40-1-1] [--particles 1300] [--seeds 1]

State and noise are those of the Kalman filters (`calib.identification.survey.filters`); every particle is a motion with
parameters of its own. Weights are the Gaussian density of the measured positions (Gordon, Salmond & Smith 1993), and
the parameters move as

    jitter       each particle by 1 % of the standard deviation; 5 % of the guess at first (the survey's, 25 p)
    shrinkage    towards the mean, the covariance kept (Liu & West 2001, a = 0.99), from the Kalman filters' start
    tempered     the same, positions said to be 30 times as noisy as they are, so that more than one survives

Prints the error [%] of noise-free torques along another motion, as `calib study` has it, the mean number of particles
that count, 1 / Σ w², and the share of the parameters within 1.96 of the stated σ.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import calib
from calib.apps.studies.conditions import read_study
from calib.apps.studies.experiment import Experiment, make_experiment
from calib.identification.methods.least_squares import WLS
from calib.identification.methods.method import IdentificationProblem
from calib.identification.registry import method_named
from calib.identification.survey.filters import samples_with_torques, thinning_factor
from calib.identification.survey.simulated_robot import Stepper, believed_robot, stepper

# scheme of the parameters' motion: factor of the positions' noise
SCHEMES = {"jitter": 1.0, "shrinkage": 1.0, "tempered": 30.0}
# factor a of Liu & West
SHRINK = 0.99
# shares of the standard deviation in each step, and of the guess at first (survey)
JITTER, SPREAD = 0.01, 0.05
# least spread of the parameters at first, as a multiple of the σ of wls (as in the Kalman filters)
WIDTH = 5.0
# share of particles that count, below which they are resampled
MIN_EFFECTIVE = 0.5
METHODS = ("wls", "ekf", "ukf", "srcdkf")


@dataclass
class Particles:
    """K motions with parameters of their own.

    Attributes:
        q, v: (K, n) positions and velocities [rad or m, per s].
        x: (K, p) base parameters.
        weights: (K,) weights with sum 1.
    """

    q: np.ndarray
    v: np.ndarray
    x: np.ndarray
    weights: np.ndarray

    def take(self, index: np.ndarray) -> Particles:
        """Return the particles of an index with equal weights."""
        weights = np.full(len(index), 1.0 / len(index))
        return Particles(self.q[index], self.v[index], self.x[index], weights)

    @property
    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (p,) and covariance (p, p) of the parameters."""
        mean = self.weights @ self.x
        deviations = self.x - mean
        return mean, (deviations * self.weights[:, None]).T @ deviations

    @property
    def effective(self) -> float:
        """Number of particles that count, 1 / Σ w²."""
        return 1.0 / np.sum(self.weights**2)


@dataclass(frozen=True, eq=False)
class FilterModel:
    """What a particle filter believes of robot and noise.

    Attributes:
        stepper: simulated robot with K states.
        columns: (p,) columns of the estimated parameters among all of the robot.
        size: number of all parameters of the robot.
        period: time between two samples [s].
        torque_noise: (n,) standard deviation of the torques of a period [N m or N].
        position_noise: (n,) standard deviation of the measured positions [rad or m].
        scheme: one of `SCHEMES`.
        rng: source of all random numbers.
    """

    stepper: Stepper
    columns: np.ndarray
    size: int
    period: float
    torque_noise: np.ndarray
    position_noise: np.ndarray
    scheme: str
    rng: np.random.Generator


def particle_filter(
    problem: IdentificationProblem, scheme: str, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean (p,) and σ (p,) of the parameters after a recording, and the mean number of particles that count.

    Args:
        problem: identification problem with a guess.
        scheme: one of `SCHEMES`.
        count: number of particles.
        seed: seed of all random numbers.
    """
    rng = np.random.default_rng(seed)
    plain = WLS.estimate(problem)
    case = problem.cases[0]
    motion = case.motion
    guess = problem.start
    assert guess is not None
    robot = believed_robot(problem, method_named("ukf"))

    # noise, as the Kalman filters have it
    thin = thinning_factor(case)
    position_noise = SCHEMES[scheme] * motion.cutoffs.noise / np.sqrt(thin)
    torque_noise = plain.std / np.sqrt(thin * np.sum(np.square(problem.decimator.taps)))
    slow = 1e-3 * np.abs(motion.v).max(axis=0)
    velocity_noise = np.maximum(motion.velocity_noise(), slow)

    # first particles
    if scheme == "jitter":
        spread = SPREAD * np.abs(guess)
    else:
        spread = np.maximum(WIDTH * plain.estimate.sigma, np.abs(guess - plain.estimate.values))
    q = motion.q[0] + position_noise * rng.standard_normal((count, motion.n))
    v = motion.v[0] + velocity_noise * rng.standard_normal((count, motion.n))
    x = guess + spread * rng.standard_normal((count, len(guess)))
    particles = Particles(q, v, x, np.full(count, 1.0 / count))

    model = FilterModel(
        stepper(robot.at(guess, case), robot.columns),
        robot.columns,
        len(robot.plant.parameters),
        thin / motion.rate,
        torque_noise,
        position_noise,
        scheme,
        rng,
    )
    effective = []
    for measured, torques in samples_with_torques(case, slice(0, len(motion))):
        _predict(particles, model, torques)
        _weigh(particles, model, measured)
        effective.append(particles.effective)
        if scheme == "jitter" or effective[-1] < MIN_EFFECTIVE * count:
            particles = _resampled(particles, rng)
    mean, covariance = particles.moments
    return mean, np.sqrt(np.diag(covariance)), float(np.mean(effective))


def _predict(particles: Particles, model: FilterModel, torques: np.ndarray) -> None:
    """Move particles by one sample, under the torques (s, n) of its s time steps and torque noise.

    Args:
        particles: the particles, which are changed.
        model: belief of robot and noise.
        torques: mean torques of the time steps [N m or N].
    """
    particles.x = _moved_parameters(particles, model)
    gain = _advance(particles, model, torques)
    torque_errors = model.torque_noise * model.rng.standard_normal(particles.q.shape)
    acceleration = torque_errors @ gain.T
    particles.q = particles.q + 0.5 * model.period**2 * acceleration
    particles.v = particles.v + model.period * acceleration


def _weigh(particles: Particles, model: FilterModel, measured: np.ndarray) -> None:
    """Multiply the weights by the Gaussian density of the measured positions (n,)."""
    misfit = np.sum(((measured - particles.q) / model.position_noise) ** 2, axis=1)
    logarithms = np.log(particles.weights + 1e-300) - 0.5 * misfit
    particles.weights = np.exp(logarithms - logarithms.max())
    particles.weights /= particles.weights.sum()


def _resampled(particles: Particles, rng: np.random.Generator) -> Particles:
    """Return as many particles of equal weight, drawn in proportion to the weights (systematic resampling)."""
    count = len(particles.weights)
    levels = (rng.random() + np.arange(count)) / count
    index = np.searchsorted(np.cumsum(particles.weights), levels)
    return particles.take(np.minimum(index, count - 1))


def _moved_parameters(particles: Particles, model: FilterModel) -> np.ndarray:
    """Return parameters (K, p) moved by the scheme, see above."""
    mean, covariance = particles.moments
    noise = model.rng.standard_normal(particles.x.shape)
    if model.scheme == "jitter":
        return particles.x + JITTER * np.sqrt(np.diag(covariance)) * noise
    eigenvalues, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(eigenvalues, 0.0))
    return SHRINK * particles.x + (1.0 - SHRINK) * mean + np.sqrt(1.0 - SHRINK**2) * noise @ root.T


def _advance(particles: Particles, model: FilterModel, torques: np.ndarray) -> np.ndarray:
    """Move particles through torques (s, n); return M⁻¹ (n, n) of the first particle.

    A particle whose parameters are physically inconsistent, so that it cannot be simulated, becomes a copy of another.
    """
    n = particles.q.shape[1]
    count = len(particles.x)
    gain = np.zeros((n, n))
    step = model.period / len(torques)
    for torque in np.ascontiguousarray(torques):
        while True:
            parameters = np.zeros((count, model.size))
            parameters[:, model.columns] = particles.x
            try:
                particles.q, particles.v, gain = model.stepper.points(
                    parameters, particles.q, particles.v, torque, step
                )
                break
            except calib.CalibError as error:
                # the message names the first particle that failed
                failed = int(str(error).split("point ")[1].split(":")[0])
                source = model.rng.integers(count)
                for values in (particles.q, particles.v, particles.x):
                    values[failed] = values[source]
    return gain


def table_line(
    data: Experiment, name: str, values: np.ndarray, sigma: np.ndarray, effective: str, seconds: float
) -> str:
    """Return a line of the table: name, torque error, parameters covered, particles that count, seconds.

    Args:
        data: the data set with its truth.
        name: name of the method.
        values: (p,) estimated base parameters, and maybe further ones behind them.
        sigma: (p,) their standard deviations.
        effective: number of particles that count; empty for another method.
        seconds: processor time [s].
    """
    b = data.problem.base.b
    residual = data.matrix @ values[:b] - data.torque
    error = 100.0 * float(np.linalg.norm(residual) / np.linalg.norm(data.torque))
    covered = np.abs(values[:b] - data.truth) < 1.96 * sigma[:b]
    coverage = 100.0 * float(np.mean(covered))
    return f"| {name} | {error:.3g} | {coverage:.0f} | {effective} | {seconds:.3g} |"


def table_lines(data: Experiment, count: int, seed: int) -> Iterator[str]:
    """Yield the table's line of each method.

    Args:
        data: the data set with its truth.
        count: number of particles.
        seed: seed of the particle filters.
    """
    assert data.problem.start is not None
    yield table_line(data, "guess", data.problem.start, np.zeros(data.problem.base.b), "", 0.0)
    for name in METHODS:
        start = time.process_time()
        result = method_named(name).estimate(data.problem)
        seconds = time.process_time() - start
        if result.found:
            estimate = result.estimate
            yield table_line(data, name, estimate.values, np.asarray(estimate.sigma), "", seconds)
    for scheme in SCHEMES:
        start = time.process_time()
        mean, sigma, effective = particle_filter(data.problem, scheme, count, seed)
        seconds = time.process_time() - start
        yield table_line(data, f"{count} particles, {scheme}", mean, sigma, f"{effective:.1f}", seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--conditions", default="MCS-RV2SQ-1-1,MCS-TX40-1-1")
    parser.add_argument("--particles", type=int, default=1300)
    parser.add_argument("--seeds", type=int, default=1)
    arguments = parser.parse_args()
    for condition in read_study(arguments.conditions.split(",")).conditions:
        for seed in range(arguments.seeds):
            print(f"{condition.name}, seed {seed}\n\n| | torque [%] | covered [%] | particles | CPU [s] |")
            print("|---|---:|---:|---:|---:|")
            for line in table_lines(make_experiment(condition, seed), arguments.particles, seed):
                print(line, flush=True)
            print()


if __name__ == "__main__":
    main()

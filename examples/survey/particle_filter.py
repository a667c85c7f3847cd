"""Why a particle filter is none of the methods: its error and time beside the Kalman filters', on a study's conditions.

    python examples/survey/particle_filter.py [--conditions MCS-RV2SQ-1-1,MCS-TX40-1-1] [--particles 1300] [--seeds 1]

State and noise are those of the Kalman filters (`calib.identification.survey.filters`); every particle is a motion with
parameters of its own. Weights are the Gaussian density of the measured positions (Gordon, Salmond & Smith 1993), and
the parameters move as

    jitter       each resampled one by 1 % of the standard deviation; 5 % of the guess at first (the survey's, 25 p)
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

from calib.apps.studies.conditions import read_study
from calib.apps.studies.experiment import Experiment, make_experiment
from calib.errors import CalibError
from calib.identification.methods.least_squares import WLS
from calib.identification.methods.method import IdentificationProblem
from calib.identification.registry import method_named
from calib.identification.survey.filters import _steps, _thin
from calib.identification.survey.simulated_robot import Stepper, believed_robot, stepper

WAYS = {"jitter": 1.0, "shrinkage": 1.0, "tempered": 30.0}  # times the positions' noise
SHRINK, JITTER, SPREAD, WIDTH = 0.99, 0.01, 0.05, 5.0  # of Liu & West, the survey (2), and the Kalman filters


@dataclass
class Particles:
    """K motions q, v (K, n) with parameters x (K, p) of their own, and weights (K,)."""

    q: np.ndarray
    v: np.ndarray
    x: np.ndarray
    weights: np.ndarray

    def chosen(self, index: np.ndarray) -> Particles:
        """Return particles of equal weight."""
        return Particles(self.q[index], self.v[index], self.x[index], np.full(len(index), 1.0 / len(index)))

    @property
    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (p,) and covariance (p, p) of the parameters."""
        mean = self.weights @ self.x
        away = self.x - mean
        return mean, (away * self.weights[:, None]).T @ away


def filtered(problem: IdentificationProblem, way: str, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean (p,) and σ (p,) of the parameters after a recording, and the mean number of particles that count."""
    rng, plain, case = np.random.default_rng(seed), WLS.estimate(problem), problem.cases[0]
    robot, motion, thin = believed_robot(problem, method_named("ukf")), case.motion, _thin(case)
    guess = problem.start
    assert guess is not None
    made = stepper(robot.at(guess, case), robot.columns)
    wide = np.maximum(WIDTH * plain.estimate.sigma, np.abs(guess - plain.estimate.values))
    wide = SPREAD * np.abs(guess) if way == "jitter" else wide
    seen = WAYS[way] * motion.cutoffs.noise / np.sqrt(thin)
    torque = plain.std / np.sqrt(thin * np.sum(np.square(problem.decimator.taps)))
    moving = np.maximum(motion.velocity_noise(), 1e-3 * np.abs(motion.v).max(axis=0))
    n, p = motion.n, len(guess)
    now = Particles(
        motion.q[0] + seen * rng.standard_normal((count, n)), motion.v[0] + moving * rng.standard_normal((count, n)),
        guess + wide * rng.standard_normal((count, p)), np.full(count, 1.0 / count),
    )  # fmt: skip
    effective = []
    for measured, tau in _steps(case, slice(0, len(motion))):
        now.x = _moved(now, way, rng)
        gain = _advance(now, made, robot.columns, len(robot.plant.parameters), tau, thin / motion.rate, rng)
        kick = (torque * rng.standard_normal((count, n))) @ gain.T
        now.q, now.v = now.q + 0.5 * (thin / motion.rate) ** 2 * kick, now.v + thin / motion.rate * kick
        logs = np.log(now.weights + 1e-300) - 0.5 * np.sum(((measured - now.q) / seen) ** 2, axis=1)
        now.weights = np.exp(logs - logs.max())
        now.weights /= now.weights.sum()
        effective.append(1.0 / np.sum(now.weights**2))
        if way == "jitter" or effective[-1] < 0.5 * count:
            steps = (rng.random() + np.arange(count)) / count
            now = now.chosen(np.minimum(np.searchsorted(np.cumsum(now.weights), steps), count - 1))
    mean, covariance = now.moments
    return mean, np.sqrt(np.diag(covariance)), float(np.mean(effective))


def _moved(now: Particles, way: str, rng: np.random.Generator) -> np.ndarray:
    mean, covariance = now.moments
    noise = rng.standard_normal(now.x.shape)
    if way == "jitter":
        return now.x + JITTER * np.sqrt(np.diag(covariance)) * noise
    sizes, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(sizes, 0.0))
    return SHRINK * now.x + (1.0 - SHRINK) * mean + np.sqrt(1.0 - SHRINK**2) * noise @ root.T


def _advance(
    now: Particles, made: Stepper, columns: np.ndarray, size: int, tau: np.ndarray, period: float,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """Move particles through torques tau (s, n); one that is no robot becomes another. Returns M⁻¹ of the first one."""
    gain = np.zeros((now.q.shape[1],) * 2)
    for own in np.ascontiguousarray(tau):
        while True:
            values = np.zeros((len(now.x), size))
            values[:, columns] = now.x
            try:
                now.q, now.v, gain = made.points(values, now.q, now.v, own, period / len(tau))
                break
            except CalibError as error:
                bad, other = int(str(error).split("point ")[1].split(":")[0]), rng.integers(len(now.x))
                now.q[bad], now.v[bad], now.x[bad] = now.q[other], now.v[other], now.x[other]
    return gain


def shown(data: Experiment, particles: int, seed: int) -> Iterator[str]:
    """Yield a table's line for each method: name, torque error, parameters covered, particles that count, seconds."""
    own = data.problem.base.b

    def line(name: str, values: np.ndarray, sigma: np.ndarray, counted: str, seconds: float) -> str:
        wrong = data.matrix @ values[:own] - data.torque
        error = 100.0 * float(np.linalg.norm(wrong) / np.linalg.norm(data.torque))
        inside = 100.0 * float(np.mean(np.abs(values[:own] - data.truth) < 1.96 * sigma[:own]))
        return f"| {name} | {error:.3g} | {inside:.0f} | {counted} | {seconds:.3g} |"

    assert data.problem.start is not None
    yield line("guess", data.problem.start, np.zeros(own), "", 0.0)
    for name in ("wls", "ekf", "ukf", "srcdkf"):
        began = time.process_time()
        found = method_named(name).estimate(data.problem)
        if found.found:
            estimate = found.estimate
            yield line(name, estimate.values, np.asarray(estimate.sigma), "", time.process_time() - began)
    for way in WAYS:
        began = time.process_time()
        mean, sigma, counted = filtered(data.problem, way, particles, seed)
        yield line(f"{particles} particles, {way}", mean, sigma, f"{counted:.1f}", time.process_time() - began)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--conditions", default="MCS-RV2SQ-1-1,MCS-TX40-1-1")
    parser.add_argument("--particles", type=int, default=1300)
    parser.add_argument("--seeds", type=int, default=1)
    given = parser.parse_args()
    for condition in read_study(given.conditions.split(",")).conditions:
        for seed in range(given.seeds):
            print(f"{condition.name}, seed {seed}\n\n| | torque [%] | covered [%] | particles | CPU [s] |")
            print("|---|---:|---:|---:|---:|")
            for line in shown(make_experiment(condition, seed), given.particles, seed):
                print(line, flush=True)
            print()


if __name__ == "__main__":
    main()

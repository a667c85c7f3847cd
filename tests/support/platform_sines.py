"""Motions of a platform for the tests of parallel robots, and what encoders and motors show of them."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from calib.data.recordings.recording import Recording
from calib.parallel.mechanism.closure import ClosedRobot
from calib.parallel.mechanism.geometric_fit import LoopCovariance, fit_loops
from calib.parallel.mechanism.parallel_model import PlatformRegressor, make_parallel_model
from calib.parallel.robots import ParallelMechanism, find


def sines(t: np.ndarray, frequencies: tuple[float, ...], size, rng: np.random.Generator) -> np.ndarray:
    """Return x, v, a (3, N, r) of sums of sines of frequencies [Hz] at times (N,) [s]; `size` (r,), or of a frequency.

    Phases are random, one for each coordinate and frequency.
    """
    motion = np.zeros((3, len(t), 1))
    for frequency in frequencies:
        amplitude = np.asarray(size(frequency) if callable(size) else size)
        omega = 2 * np.pi * frequency
        angle = omega * t[:, None] + rng.uniform(0, 6, len(amplitude))
        x = np.sin(angle)
        v = omega * np.cos(angle)
        a = -(omega**2) * np.sin(angle)
        motion = motion + amplitude * np.stack([x, v, a])
    return motion


def truth(known: ClosedRobot, drives: str = "Fv Fc") -> tuple:
    """Return the model of a robot that may carry payload 5, of 5.37 kg and off its centre, and its parameters."""
    model = make_parallel_model(known, [drives], v0=0.05, payloads=["5"])
    amounts = {"Ia": 0.01, "Fv": 0.05, "Fc": 0.3}
    drive_values = [amounts[term.name[:2]] for term in model.terms]
    values = np.concatenate([model.known_parameters(), drive_values])
    for name, value in {"M5": 5.37, "MX5": -0.127, "ZZ5": 0.0161}.items():
        values[model.names.index(name)] = value
    return model, values


def recorded(
    known: ClosedRobot,
    carried: Collection[str] = (),
    *,
    seed: int = 0,
    samples: int = 1000,
    preload: float = 0.0,
    noise: float = 0.1,
    gains: np.ndarray | float = 1.0,
    encoder: float = 1e-6,
    values: np.ndarray | None = None,
) -> Recording:
    """Return a recording at 1 kHz of a robot of `truth`, with noise on torques or currents, by the model alone."""
    robot = known.robot
    model, true_values = truth(known)
    model = replace(model, preload=(preload,) * (robot.n - robot.r))
    if values is None:
        values = true_values
    rng = np.random.default_rng(seed)
    t = np.arange(samples) / 1000.0
    x, v, a = sines(t, (1.5, 2.5, 4.0, 5.5), 0.04 * (robot.upper - robot.lower), rng)
    regressor = PlatformRegressor(model, np.arange(model.p), values, carried)
    motion = regressor.motion(x, v, a)
    q = motion.posture.q[:, robot.actuated] + encoder * rng.normal(size=(samples, robot.n))
    effort = (regressor.torques(motion) + noise * rng.normal(size=q.shape)) / gains
    kind = "torque" if np.ndim(gains) == 0 else "current"
    name = f"{'load' if carried else 'empty'}{seed}.csv"
    return Recording(t, q, effort, kind, robot.joint_names, file=name)


def fitted(known: ClosedRobot, seed: int = 0) -> ParallelMechanism:
    """Return a robot calibrated by 60 poses with 0.2 mrad (mm) of noise on each encoder; the true one is `known`."""
    robot = known.robot
    rng = np.random.default_rng(seed)
    x = rng.uniform(robot.lower, robot.upper, (60, robot.r))
    q = known.place(x).q[:, robot.actuated]
    fit = fit_loops(known, q + 2e-4 * rng.normal(size=q.shape), x)
    return ParallelMechanism(fit.mechanism, find(robot.name).source, LoopCovariance.fitted(fit))

"""Do estimates that take a loop for granted agree with those that do not? Output error beside instruments, same rows.

CLOE and CLIE fit a simulated loop; what of the loop is stated wrongly goes into their parameters, and no residual need
tell: half a period's delay of a velocity is just kd / (2 rate) more inertia. Instruments need the loop but roughly, and
least squares not at all. Noise of the positions biases least squares, so parameters alone decide nothing: the recorded
torques must side against the loop as well, beside simulated motion, which is free of noise.
"""

from dataclasses import dataclass

import numpy as np

from calib.identification.methods.bias import LoopTest
from calib.identification.methods.least_squares import WLS
from calib.identification.methods.method import IdentificationProblem, MethodEstimate

SIGMAS = 5.0  # of both together, by which a parameter differs surely (our choice)


@dataclass(frozen=True)
class LoopDisagreement:
    """An estimate that takes the loop for granted, beside one that does not.

    Attributes:
        method, beside: of the two.
        parameter, sigmas: the one that differs most, and by how many standard deviations of both together.
        left, beside_left: by torque row, share of the torque in the band that each leaves unexplained [%].
        factor: by torque row, the method's torque over the other's.
    """

    method: str
    beside: str
    parameter: str
    sigmas: float
    left: tuple[float, ...]
    beside_left: tuple[float, ...]
    factor: tuple[float, ...]


def disagreement(problem: IdentificationProblem, found: MethodEstimate, test: LoopTest) -> LoopDisagreement | None:
    """Return where an output-error estimate is refuted by recorded torques; None where it is not, or is another's.

    Args:
        problem: of both.
        found: the estimate.
        test: what instruments say; without any, least squares takes their place.
    """
    if not (found.found and found.alone and found.loops is not None):
        return None
    own, instruments = found.estimate, test.found
    max_beside_instruments = 1.2  # times the torque that instruments leave unexplained (our choice)
    max_beside_wls = 2.0  # the same beside least squares, of which it is the least that there is (our choice)
    if instruments is not None and instruments.valid and len(instruments.names) == len(own.values):
        name, other, limit = instruments.estimator.name, instruments.fit.estimate, max_beside_instruments
        left, beside = (instruments.simulated_error(x.values) for x in (own, other))
    else:
        plain = WLS.estimate(problem)
        if not plain.found:
            return None
        name, other, limit = "wls", plain.estimate, max_beside_wls
        size = np.maximum(problem.pooled.residual_squares(np.zeros(len(own.values))), 1e-300)
        left, beside = (100.0 * np.sqrt(problem.pooled.residual_squares(x.values) / size) for x in (own, other))
    away = np.abs(own.values - other.values) / np.maximum(np.hypot(own.sigma, other.sigma), 1e-300)
    worst = int(np.argmax(away))
    if away[worst] < SIGMAS or not np.any(left > limit * beside):
        return None
    return LoopDisagreement(
        found.method, name, other.names[worst], float(away[worst]), tuple(left.tolist()), tuple(beside.tolist()),
        _factors(problem, own.values, other.values),
    )  # fmt: skip


def _factors(problem: IdentificationProblem, own: np.ndarray, other: np.ndarray) -> tuple[float, ...]:
    """Return by torque row the slope of W own against W other."""
    factors = problem.pooled.factors[:, :, :-1]
    mine, theirs = factors @ own, factors @ other
    return tuple(map(float, np.sum(mine * theirs, axis=1) / np.maximum(np.sum(theirs**2, axis=1), 1e-300)))

"""The survey's neural networks on the rows as they were observed: an adaptive linear neuron, Hopfield and Tank's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib.estimation.linear import LinearFit
from calib.identification.methods.least_squares import samples_of, weighed
from calib.identification.methods.method import EstimateStatus, IdentificationProblem, Method, MethodEstimate, attempted
from calib.rooms.studies.methods.networks import adaline, hopfield

Train = Callable[[IdentificationProblem, np.ndarray, np.ndarray], tuple[LinearFit, int]]


@dataclass(frozen=True)
class _Network(Method):
    """A method that comes to rest at weighted least squares.

    Attributes:
        train: the problem, (rows,) standard deviations and inflation to the fit, and the number of rounds.
    """

    train: Train

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the weights of the network at rest, with the covariance of least squares and that of the training."""
        return attempted(self.name, problem, lambda: self._estimate(problem))

    def _estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        std, tau = weighed(problem)
        fit, rounds = self.train(problem, std, tau)
        return MethodEstimate(self.name, EstimateStatus.FOUND, fit, problem.pooled, std, tau, iterations=rounds)


_LIKE_WLS = "each joint's torque is as noisy as its own residuals say, q, v and a exact"
ADALINE = _Network(
    "adaline", f"{_LIKE_WLS}; samples in random order",
    lambda problem, std, tau: adaline(samples_of(problem), problem.pooled, std, tau),
)  # fmt: skip
HOPFIELD = _Network(
    "hopfield", f"{_LIKE_WLS}; no parameter is near the bound of its neuron",
    lambda problem, std, tau: hopfield(problem.pooled, std, tau),
)  # fmt: skip

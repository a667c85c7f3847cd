"""What an identified model does not know of its torques: standard deviations from the covariance of its parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.dynamics.base import standard_name
from calib.dynamics.idim import with_load
from calib.errors import UsageError
from calib.identification.model_file import read_covariance
from calib.identification.prediction import Dynamics
from trajectories.timing.profile import Sampled

BLOCK = 4000


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What was fitted, and how well.

    Attributes:
        dynamics: the model; values of payloads that are not on board are zero.
        carried: labels of the payloads on board.
        columns: (k,) of the regressor.
        covariance: (k, k) of their parameters.
    """

    dynamics: Dynamics
    carried: tuple[str, ...]
    columns: np.ndarray
    covariance: np.ndarray

    def sigma(self, sampled: Sampled) -> np.ndarray:
        """Return the largest standard deviation (n,) of each torque along a motion: √(w Σ wᵀ) [N m or N]."""
        model, n = self.dynamics.model, sampled.q.shape[1]
        largest = np.zeros(n)
        for start in range(0, len(sampled.q), BLOCK):
            part = slice(start, start + BLOCK)
            q, v, a = (np.ascontiguousarray(x[part]) for x in (sampled.q, sampled.v, sampled.a))
            load = None
            if with_load(model):
                load = model.transmitted(self.dynamics.values, q, v, a)
            W = model.regressor(q, v, a, load, self.carried)[:, -n:][:, :, self.columns]
            variance = np.einsum("Nib,bc,Nic->Ni", W, self.covariance, W, optimize=True)
            largest = np.maximum(largest, np.sqrt(np.maximum(variance, 0.0)).max(axis=0))
        return largest


def read_uncertainty(folder: Path, dynamics: Dynamics, carried: Sequence[str]) -> Uncertainty | None:
    """Return the uncertainty that ``covariance.csv`` of an identification states; None without the file."""
    found = read_covariance(folder)
    if found is None:
        return None
    names, covariance = found
    try:
        standard = dynamics.model.names
        columns = np.array([standard.index(standard_name(name, standard)) for name in names])
    except ValueError as error:
        raise UsageError(f"{folder}/covariance.csv does not fit dynamics.json beside it: {error}") from error
    return Uncertainty(dynamics, tuple(carried), columns, covariance)

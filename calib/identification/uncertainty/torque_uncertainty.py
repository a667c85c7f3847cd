"""What an identified model does not know of its torques: standard deviations from the covariance of its parameters."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.dynamics.base import standard_name
from calib.dynamics.idim import friction_states
from calib.errors import UsageError, refused_as
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
        state = sampled.q, sampled.v, sampled.a
        variances = parameter_variances(self.dynamics, self.columns, self.covariance, *state, self.carried)
        return np.sqrt(variances.max(axis=0))[-sampled.q.shape[1] :]


def estimated_columns(dynamics: Dynamics, names: Sequence[str]) -> np.ndarray:
    """Return which columns of the regressor (k,) estimated parameters are of.

    Raises:
        ValueError: for a name that the model does not have.
    """
    standard = dynamics.model.names
    return np.array([standard.index(standard_name(name, standard)) for name in names])


def parameter_variances(
    dynamics: Dynamics, columns: np.ndarray, covariance: np.ndarray, q: np.ndarray, v: np.ndarray,
    a: np.ndarray, carried: Collection[str] | None = None, states: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return w Σ wᵀ (N, rows) of torques, with Σ (k, k) of the parameters of these columns (k,) [N² m² or N²].

    Args:
        q, v, a: (N, n) states.
        carried: labels of the payloads on board; None: all.
        states: (s, N) of friction with memory; None: q is one uninterrupted record.
    """
    model, result = dynamics.model, []
    loaded = bool(model.with_load())
    states = friction_states(model, q) if states is None else states
    unit = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    root = unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    for start in range(0, len(q), BLOCK):
        part = slice(start, start + BLOCK)
        here, speed, change = (np.ascontiguousarray(x[part]) for x in (q, v, a))
        load = model.transmitted(dynamics.values, here, speed, change, carried) if loaded else None
        rows = model.regressor(here, speed, change, load, carried, states[:, part])[:, :, columns]
        result.append(np.sum((rows @ root) ** 2, axis=2))
    return np.concatenate(result)


def read_uncertainty(folder: Path, dynamics: Dynamics, carried: Sequence[str]) -> Uncertainty | None:
    """Return the uncertainty that ``covariance.csv`` of an identification states; None without the file."""
    found = read_covariance(folder)
    if found is None:
        return None
    names, covariance = found
    with refused_as(UsageError, ValueError, f"{folder}/covariance.csv does not fit dynamics.json beside it: {{}}"):
        columns = estimated_columns(dynamics, names)
    return Uncertainty(dynamics, tuple(carried), columns, covariance)

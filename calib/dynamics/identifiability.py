"""What motions tell of a base model's columns: their information, and the columns left where some joints rest.

A joint at rest feels stiction, any value up to Coulomb's: its torque row is left out. Of the model's base columns those
stay that the other rows tell; they are chosen in order, so that a column that folds into others stands for what it and
they have in common while that joint stays where it is.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.dynamics.base import BaseModel, random_samples
from calib.estimation.base_columns import split_columns

INDEPENDENT = 1e-4  # of a column at unit norm that no other one explains (our choice)
BLOCK = 4000  # samples at a time


def information(model: BaseModel, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return Σ ωᵀω (b, b) of a motion's regressors ω.

    Args:
        model: with b columns; q, v, a: (N, n) [rad or m, and per s, per s²].
    """
    total = np.zeros((len(model.names),) * 2)
    for start in range(0, len(q), BLOCK):
        part = (np.ascontiguousarray(x[start : start + BLOCK]) for x in (q, v, a))
        W = model.regressor(*part)
        rows = W.reshape(-1, W.shape[-1])
        total += rows.T @ rows
    return total


def columns_at_rest(
    model: BaseModel,
    resting: Mapping[int, float | None],
    lower: np.ndarray,
    upper: np.ndarray,
    known: np.ndarray | None = None,
) -> np.ndarray:
    """Return which base columns (c,) are independent where some joints rest.

    Args:
        model: with b columns.
        resting: joint → where it rests [rad or m]; None: anywhere, but in one place.
        lower, upper: (n,) finite limits of the random states at which columns are compared.
        known: (b, b) information of other motions, in which those joints may move.
    """
    states = random_samples(model.model, lower=lower, upper=upper)
    q, v, a = (np.array(x) for x in (states.q, states.v, states.a))
    for j, value in resting.items():
        q[:, j], v[:, j], a[:, j] = q[0, j] if value is None else value, 0.0, 0.0
    Y = model.regressor(q, v, a)
    Y[:, list(resting)] = 0.0
    rows = Y.reshape(-1, Y.shape[-1])
    if known is not None:
        values, V = np.linalg.eigh(known)
        rows = np.concatenate([rows, np.sqrt(np.maximum(values, 0.0))[:, None] * V.T])
    return np.asarray(split_columns(rows, [np.array([k]) for k in range(rows.shape[1])], INDEPENDENT).kept)

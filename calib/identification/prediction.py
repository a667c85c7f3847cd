"""An identified model as a predictor of torques."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from calib.arrays import frozen
from calib.dynamics.idim import IdentificationModel, with_load
from calib.dynamics.rigid_body import inverse_dynamics
from calib.dynamics.tree import FIXED
from calib.identification.cases import Case
from calib.identification.rows import BLOCK, segmented_states


@dataclass(frozen=True, eq=False)
class Dynamics:
    """A model with numbers.

    Attributes:
        model: bodies and drive terms.
        values: (p,) a value of every standard parameter and term; regrouped parameters hold base values, the others
            zero, so that single ones need not be those of any body (`calib.dynamics.base.to_standard`).
    """

    model: IdentificationModel
    values: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", frozen(self.values))


def predict(dynamics: Dynamics, case: Case) -> np.ndarray:
    """Return the torques of all rows at the full rate (N, rows) [N m or N]: W(q, v, a) · values, block by block."""
    model, motion = dynamics.model, case.motion
    load = transmitted(dynamics, case) if with_load(model) else None
    states = segmented_states(model.columns, case)
    result = np.empty((len(motion), model.rows))
    for start in range(0, len(motion), BLOCK):
        part = slice(start, start + BLOCK)
        own = None if load is None else load[part]
        block = model.regressor(motion.q[part], motion.v[part], motion.a[part], own, case.carried, states[:, part])
        result[part] = block @ dynamics.values
    return result


def transmitted(dynamics: Dynamics, case: Case) -> np.ndarray:
    """Return the torques (N, n) the gears pass on to the bodies, by the model: what load-dependent friction feels."""
    model, motion = dynamics.model, case.motion
    bodies = np.array(dynamics.values[: 10 * model.tree.bodies]) * carried_columns(model, case.carried)
    return inverse_dynamics(model.tree, bodies, motion.q, motion.v, motion.a)


def carried_columns(model: IdentificationModel, carried: Collection[str]) -> np.ndarray:
    """Return (10 B,) one for parameters of bodies that are there, zero for those of payloads that are not."""
    present = [kind != FIXED or label in carried for label, kind in zip(model.tree.labels, model.tree.kinds)]
    return np.repeat(np.array(present, dtype=float), 10)

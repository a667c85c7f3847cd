"""An identified model as a predictor of torques."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic

import numpy as np
from typing_extensions import TypeVar

from calib.arrays import Frozen
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.regressor_model import RegressorModel
from calib.identification.rows import BLOCK, Case, segmented_states

Model = TypeVar("Model", bound=RegressorModel, default=IdentificationModel, covariant=True)


@dataclass(frozen=True, eq=False)
class Dynamics(Frozen, Generic[Model]):
    """A model with numbers.

    Attributes:
        model: bodies and drive terms, or whatever else is linear in its parameters.
        values: (p,) a value of every standard parameter and term; regrouped parameters hold base values, the others
            zero, so that single ones need not be those of any body (`calib.dynamics.base.to_standard`).
    """

    model: Model
    values: np.ndarray

    def transmitted(self: Dynamics[IdentificationModel], case: Case) -> np.ndarray:
        """Return the torques (N, n) the gears pass on to the bodies, by the model; friction may depend on them."""
        model, motion = self.model, case.motion
        result = np.empty(motion.q.shape)
        for start in range(0, len(motion), BLOCK):
            part = slice(start, start + BLOCK)
            q, v, a = motion.q[part], motion.v[part], motion.a[part]
            result[part] = model.transmitted(self.values, q, v, a, case.carried)
        return result


def predict(dynamics: Dynamics[RegressorModel], case: Case) -> np.ndarray:
    """Return the torques of all rows at the full rate (N, rows) [N m or N]: W(q, v, a) · values, without W."""
    model, motion = dynamics.model, case.motion
    states = segmented_states(model.columns, case)
    result = np.empty((len(motion), model.rows))
    for start in range(0, len(motion), BLOCK):
        part = slice(start, start + BLOCK)
        q, v, a = motion.q[part], motion.v[part], motion.a[part]
        result[part] = model.torque(dynamics.values, q, v, a, case.carried, states[:, part])
    return result

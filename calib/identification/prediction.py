"""An identified model as a predictor of torques."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic

import numpy as np
from typing_extensions import TypeVar

from calib.dynamics.idim import IdentificationModel
from calib.dynamics.regressor_model import RegressorModel
from calib.identification.rows import BLOCK, Case, segmented_states
from calib.records import Frozen

Model = TypeVar("Model", bound=RegressorModel, default=IdentificationModel, covariant=True)


@dataclass(frozen=True, eq=False)
class Dynamics(Frozen, Generic[Model]):
    """A dynamic model with its parameter values.

    Attributes:
        model: bodies and drive terms, or another model that is linear in its parameters.
        values: (p,) of all standard parameters and terms; regrouped parameters have base values, the others
            zero, so that single ones may not be physically consistent (`calib.dynamics.base.to_standard`).
    """

    model: Model
    values: np.ndarray

    def transmitted(self: Dynamics[IdentificationModel], case: Case) -> np.ndarray:
        """Return the torques (N, n) that the gears transmit to the bodies; load-dependent friction needs them."""
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

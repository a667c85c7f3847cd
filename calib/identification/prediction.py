"""An identified model as a predictor of torques."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from calib.arrays import frozen
from calib.dynamics.bodies import FIXED
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.rigid_body import inverse_dynamics
from calib.dynamics.torque_rows import BODIES
from calib.identification.cases import Case
from calib.identification.rows import BLOCK, term_columns


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
    """Return the torques of all rows at the full rate (N, rows) [N m or N]: W(q, v, a) · values, without W."""
    model, motion = dynamics.model, case.motion
    load = transmitted(dynamics, case) if model.inertial else None
    parts = {BODIES: np.zeros(motion.q.shape) if load is None else load}
    for one, value in zip(model.columns, dynamics.values[model.inertial :]):
        own = parts.setdefault(one.side, np.zeros(motion.q.shape))
        for row, values in term_columns(one, case, load):
            own[:, row] += value * values
    result = np.zeros((len(motion), model.rows))
    for side, own in parts.items():
        result += model.torque_rows.observe(own[:, :, None], (side,), motion.q, motion.v)[:, :, 0]
    return result


def transmitted(dynamics: Dynamics, case: Case) -> np.ndarray:
    """Return the torques (N, n) the gears pass on to the bodies, by the model: what load-dependent friction feels."""
    model, motion = dynamics.model, case.motion
    bodies = np.array(dynamics.values[: model.inertial]) * carried_columns(model, case.carried)
    result = np.empty(motion.q.shape)
    for start in range(0, len(motion), BLOCK):
        part = slice(start, start + BLOCK)
        result[part] = inverse_dynamics(model.bodies, bodies, motion.q[part], motion.v[part], motion.a[part])
    return result


def carried_columns(model: IdentificationModel, carried: Collection[str]) -> np.ndarray:
    """Return (10 B,) one for parameters of bodies that are there, zero for those of payloads that are not."""
    present = [kind != FIXED or label in carried for label, kind in zip(model.bodies.labels, model.bodies.kinds)]
    return np.repeat(np.array(present, dtype=float), 10)

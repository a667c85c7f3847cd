"""Drives as simulators and URDFs know them: one motor inertia, one viscous and one Coulomb coefficient per joint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.identification.prediction import Dynamics

PLAIN = {"acceleration": 0, "velocity": 1, "sign": 2, "one": 3}


@dataclass(frozen=True, eq=False)
class Drives:
    """What of the drive terms fits a table, and what does not.

    Attributes:
        values: (n, 4) armature [kg m² or kg], damping [N m s/rad or N s/m], friction, offset [N m or N].
        sigma: (n, 4) of them; None where no covariance is known.
        left: names of terms that no such table holds: couplings, richer friction.
    """

    values: np.ndarray
    left: tuple[str, ...]
    sigma: np.ndarray | None = None


def without_left(dynamics: Dynamics) -> Dynamics:
    """Return an identified model without the terms that no such table holds."""
    left, first = drive_table(dynamics).left, dynamics.model.inertial
    values = np.array(dynamics.values)
    values[[first + k for k, one in enumerate(dynamics.model.columns) if one.name in left]] = 0.0
    return Dynamics(dynamics.model, values)


def drive_table(dynamics: Dynamics, covariance: np.ndarray | None = None) -> Drives:
    """Return the drive terms of an identified model by joint, those of motor and link side added.

    Args:
        dynamics: the model.
        covariance: of all its parameters.
    """
    model = dynamics.model
    values, left = np.zeros((model.bodies.n, 4)), []
    adds = np.zeros((*values.shape, len(dynamics.values)))
    for k, (one, value) in enumerate(zip(model.columns, dynamics.values[model.inertial :]), model.inertial):
        if not one.acts or value == 0.0:
            continue
        if one.shape in PLAIN and one.joint is not None:
            values[one.joint, PLAIN[one.shape]] += value
            adds[one.joint, PLAIN[one.shape], k] = 1.0
        else:
            left.append(one.name)
    if covariance is None:
        return Drives(values, tuple(left))
    variance = np.einsum("nki,ij,nkj->nk", adds, covariance, adds)
    return Drives(values, tuple(left), np.sqrt(np.clip(variance, 0.0, None)))

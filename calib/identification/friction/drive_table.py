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
        left: names of terms that no such table holds: couplings, richer friction.
    """

    values: np.ndarray
    left: tuple[str, ...]


def drive_table(dynamics: Dynamics) -> Drives:
    """Return the drive terms of an identified model by joint, those of motor and link side added."""
    model = dynamics.model
    values, left = np.zeros((model.bodies.n, 4)), []
    for one, value in zip(model.columns, dynamics.values[model.inertial :]):
        if not one.acts or value == 0.0:
            continue
        if one.shape in PLAIN and one.joint is not None:
            values[one.joint, PLAIN[one.shape]] += value
        else:
            left.append(one.name)
    return Drives(values, tuple(left))

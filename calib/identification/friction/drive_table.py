"""Drives as simulators and URDFs state them: one motor inertia, one viscous and one Coulomb coefficient per joint."""

from dataclasses import dataclass

import numpy as np

from calib.dynamics.drives import DriveTerm
from calib.identification.prediction import Dynamics

PLAIN = {"acceleration": 0, "velocity": 1, "sign": 2, "one": 3}


@dataclass(frozen=True, eq=False)
class Drives:
    """Drive terms that fit a table, and those that do not.

    Attributes:
        values: (n, 4) armature [kg m² or kg], damping [N m s/rad or N s/m], friction, offset [N m or N].
        left: names of terms that do not fit the table: richer friction.
        couplings: (c, 4) the same values for motors that turn with two joints (`calib.dynamics.drives.coupled`).
        pairs: (c,) their joints, from 0, and the weight of the second: 1 for the sum, -1 for the difference.
        sigma: (n + c, 4) of all values; None where no covariance is known.
    """

    values: np.ndarray
    left: tuple[str, ...]
    couplings: np.ndarray
    pairs: tuple[tuple[int, int, float], ...] = ()
    sigma: np.ndarray | None = None


def without_left(dynamics: Dynamics) -> Dynamics:
    """Return an identified model without the terms that do not fit the table."""
    left, first = drive_table(dynamics).left, dynamics.model.inertial
    values = np.array(dynamics.values)
    values[[first + k for k, one in enumerate(dynamics.model.columns) if one.name in left]] = 0.0
    return Dynamics(dynamics.model, values)


def drive_table(dynamics: Dynamics, covariance: np.ndarray | None = None) -> Drives:
    """Return the drive parameters of an identified model by joint, motor side plus link side.

    Args:
        dynamics: the model.
        covariance: of all its parameters.
    """
    model = dynamics.model
    n, left = model.bodies.n, []
    pairs = tuple(dict.fromkeys(pair for one in model.columns if (pair := _pair(one)) is not None))
    values = np.zeros((n + len(pairs), 4))
    adds = np.zeros((*values.shape, len(dynamics.values)))
    for k, (one, value) in enumerate(zip(model.columns, dynamics.values[model.inertial :]), model.inertial):
        if not one.acts or value == 0.0:
            continue
        if one.shape in PLAIN and one.joint is not None:
            values[one.joint, PLAIN[one.shape]] += value
            adds[one.joint, PLAIN[one.shape], k] = 1.0
        elif (pair := _pair(one)) is not None:
            values[n + pairs.index(pair), PLAIN[one.shape]] = value
            adds[n + pairs.index(pair), PLAIN[one.shape], k] = 1.0
        else:
            left.append(one.name)
    if covariance is None:
        return Drives(values[:n], tuple(left), values[n:], pairs)
    variance = np.einsum("nki,ij,nkj->nk", adds, covariance, adds)
    return Drives(values[:n], tuple(left), values[n:], pairs, np.sqrt(np.clip(variance, 0.0, None)))


def _pair(one: DriveTerm) -> tuple[int, int, float] | None:
    """Return the joints that a term couples and the weight of the second; None for any other term."""
    if one.shape not in PLAIN or len(one.acts) != 2:
        return None
    (first, motion), (second, _) = one.acts
    weights = dict(motion)
    return None if second not in weights else (first, second, weights[second])

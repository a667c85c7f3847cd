"""The cost of standard parameters that belong to bodies that can exist, as arrays: data, prior bodies, drive terms."""

from dataclasses import dataclass

import numpy as np

from calib.dynamics import pseudo_inertia
from calib.identification.possible.information import Information
from calib.identification.possible.prior_bodies import PriorBodies
from calib.identification.prior import DRIVES, ROTOR

DRIVE = 1.0  # weight of the prior of Ia, Fv, Fc
WEAK = 2.0  # γ of payloads: nothing is known of them but the order of size


@dataclass(frozen=True, eq=False)
class BodyCost:
    """The cost as arrays; parameters that the data do not see and no prior holds are fixed beforehand.

    Attributes:
        factor: (k, p + 1) [R T, z].
        bodies: number of bodies, ten parameters each, before all others.
        references: (B, 4, 4) P⁰.
        drawn: (B,) whether the common weight γ counts for a body; `WEAK` does otherwise.
        sizes: (p - 10 B,) x⁰ of positive drive terms; standard deviation of the free ones; 0 where fixed.
        positive: (p - 10 B,) which terms are positive.
        fixed: (p - 10 B,) their values where fixed.
        lift: factor of all priors, 1 but on the way to the optimum.
    """

    factor: np.ndarray
    bodies: int
    references: np.ndarray
    drawn: np.ndarray
    sizes: np.ndarray
    positive: np.ndarray
    fixed: np.ndarray
    lift: float = 1.0

    @property
    def free(self) -> np.ndarray:
        """(p,) which parameters are unknown."""
        return np.concatenate([np.ones(10 * self.bodies, bool), self.sizes > 0.0])

    def weights(self, gamma: float) -> np.ndarray:
        """(B,) the weight of each body."""
        return self.lift * np.where(self.drawn, gamma, WEAK)


def make_problem(information: Information, references: PriorBodies) -> BodyCost:
    """Return the cost of an identified model; sizes of drive terms come from the torque they could explain."""
    model = information.dynamics.model
    bodies = model.bodies.count
    columns = information.factor[:, :-1] @ information.transform
    norms, target = np.linalg.norm(columns, axis=0), np.linalg.norm(information.factor[:, -1])
    usual = np.median(norms[norms > 0.0])  # not the largest: a term that was switched off is pinned to zero
    norms = norms[10 * bodies :]
    seen = norms > 1e-8 * usual
    whole = target / np.where(seen, norms, 1.0)  # would explain all of the torque
    positive = np.array([one.nonnegative for one in model.columns], dtype=bool)
    sizes = np.where(positive, 0.1 * whole, DRIVES * whole)
    mass = float(references.parameters[:, 9].sum())
    for k, one in enumerate(model.columns):
        if one.shape == "acceleration" and positive[k]:
            sizes[k] = min(sizes[k], mass * ROTOR**2)
    return BodyCost(
        np.column_stack([columns, information.factor[:, -1]]), bodies,
        pseudo_inertia.from_standard(references.parameters),
        references.drawn, np.where(seen, sizes, 0.0), positive, information.dynamics.values[10 * bodies :],
    )  # fmt: skip

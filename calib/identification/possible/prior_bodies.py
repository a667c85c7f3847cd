"""The bodies that consistent parameters are regularised towards: the CAD's, else rods between the joints."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calib.arrays import frozen
from calib.dynamics import pseudo_inertia
from calib.dynamics.bodies import standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.identification.rods import PAYLOAD, RADIUS, rods
from calib.robot.chain import Chain

THIN = 5e-3  # [m]: no body of a robot's arm has its mass within less, as a standard deviation (our choice)
LIGHT = 0.02  # of the heaviest body: the mass of one whose CAD has none
TOTALS = tuple(float(10.0 ** (k / 2)) for k in range(0, 7))  # [kg] of an arm without CAD, 1 kg to 1 t


@dataclass(frozen=True, eq=False)
class PriorBodies:
    """One body per body of a model.

    Attributes:
        parameters: (B, 10) standard ones, all of possible bodies.
        drawn: (B,) False where only the order of size is meant.
        cad: whether they come from a CAD.
        source: in words.
        notes: what had to be mended.
    """

    parameters: np.ndarray
    drawn: np.ndarray
    cad: bool
    source: str
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", frozen(self.parameters))
        object.__setattr__(self, "drawn", frozen(self.drawn, bool))


def find_prior_bodies(chain: Chain, model: IdentificationModel) -> Iterator[PriorBodies]:
    """Yield the references between which the evidence decides: one of the CAD, or rods of several total masses."""
    carried = model.bodies.coordinates < 0
    if chain.inertias is not None and chain.inertias[:, 9].max() > 0.0:
        yield _cad(chain, model, carried)
        return
    for total in TOTALS:
        bodies = rods(chain, model, total)
        words = f"no masses in the robot's description: rods between the joints, {total:.3g} kg in all, by the evidence"
        yield PriorBodies(bodies, ~carried, False, words)


def _cad(chain: Chain, model: IdentificationModel, carried: np.ndarray) -> PriorBodies:
    bodies = np.zeros((model.bodies.count, 10))
    own = standard_parameters(chain).reshape(-1, 10)
    bodies[: len(own)] = own
    heaviest, notes, drawn = float(own[:, 9].max()), [], ~carried
    for i, label in enumerate(model.bodies.labels):
        if carried[i]:
            bodies[i] = pseudo_inertia.ball(*PAYLOAD)
        elif not own[i, 9] > 0.0:
            bodies[i], drawn[i] = pseudo_inertia.ball(LIGHT * heaviest, RADIUS / 2), False
            notes.append(f"body {label} has no mass in the CAD: weakly regularised towards {LIGHT * heaviest:.2g} kg")
        elif pseudo_inertia.margin(own[i]) < THIN:
            bodies[i] = _thickened(own[i])
            if pseudo_inertia.margin(own[i]) < 0.0:
                notes.append(
                    f"CAD inertia of body {label} is physically inconsistent: the nearest consistent one is taken"
                )
    return PriorBodies(bodies, drawn, True, "the inertias of the robot's description", tuple(notes))


def _thickened(body: np.ndarray) -> np.ndarray:
    """Return a body with its mass spread by at least `THIN` in every direction about its centre."""
    pseudo = pseudo_inertia.from_standard(body)
    mass, centre = pseudo[3, 3], pseudo[:3, 3] / pseudo[3, 3]
    size, axes = np.linalg.eigh(pseudo[:3, :3] / mass - np.outer(centre, centre))
    pseudo[:3, :3] = mass * ((axes * np.maximum(size, THIN**2)) @ axes.T + np.outer(centre, centre))
    return pseudo_inertia.to_standard(pseudo)

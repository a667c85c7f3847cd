"""Robots with known dynamics and known controllers, from the truths in the library."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from calib.dynamics import drives
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.robot import description, library
from calib.simulation.loop.closed_loop import Plant
from calib.simulation.loop.controllers import Controller, pd

SIDED = ("Ia", "Fvl", "Fcl", "offl", "Fvm", "Fcm", "offm")  # drive terms of a joint with a torque sensor


@cache
def truth(name: str) -> dict[str, Any]:
    """Return the truth of ``tx40``, ``rv2sq`` or ``lwr4plus``."""
    return description.read_extra(library.path(f"{name}_truth"))["truth"]


def plant(name: str, coupled: bool = False, offset: np.ndarray | None = None) -> Plant:
    """Return the TX40 or RV-2SQ with Ia, Fv, Fc of every joint.

    Args:
        coupled: with the TX40's wrist coupling: Ia6 on both rows, Fvm6, Fcm6.
        offset: (n,) torque offsets, terms ``off1`` …; None for none.
    """
    chain, known = description.read(library.path(name)), truth(name)
    own = "Ia Fv Fc" if offset is None else "Ia Fv Fc off"
    values = {key: known["drives"][key] for key in ("Ia", "Fv", "Fc")}
    values["off"] = np.zeros(chain.n) if offset is None else offset
    terms = list(drives.standard([own] * chain.n, known["drives"]["v0"]))
    amounts = [values[key][joint] for joint in range(chain.n) for key in own.split()]
    if coupled:
        link = known["coupling"]
        first, second = (joint - 1 for joint in link["joints"])
        gear = drives.coupled(first, second, known["drives"]["v0"])
        place = next(k for k, one in enumerate(terms) if one.shape == "acceleration" and one.joint == second)
        # one motor inertia: Iam6 is Ia6, which acts on row 5 by a6 and on row 6 by a5 + a6
        both = ((first, ((second, 1.0),)), (second, ((first, 1.0), (second, 1.0))))
        terms[place] = replace(terms[place], acts=both)
        terms += gear[1:]
        amounts += [link["Fvm"], link["Fcm"]]
    return Plant(bodies_of(chain), tuple(terms), np.concatenate([standard_parameters(chain), amounts]))


def controller(name: str) -> Controller:
    """Return the published PD controller of the TX40 or RV-2SQ."""
    known = truth(name)["control"]
    return pd(np.array(known["kp"]), np.array(known["kd"]), np.array(known.get("limit", np.inf)))


def model(plant: Plant) -> IdentificationModel:
    """Return the identification model whose parameters are those of the plant."""
    return IdentificationModel(plant.bodies, plant.terms)

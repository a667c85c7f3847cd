"""Robots with known dynamics and known controllers, from the truths in the library."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from calib.dynamics import drives
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.tree import standard_parameters, tree
from calib.robot import description, library
from calib.simulation.closed_loop import Plant
from calib.simulation.controllers import Controller, pd

SIDED = ("Ia", "Fvl", "Fcl", "offl", "Fvm", "Fcm", "offm")  # drive terms of a joint with a torque sensor


@cache
def truth(name: str) -> dict[str, Any]:
    """Return the truth of ``tx40``, ``rv2sq`` or ``lwr4plus``."""
    return description.read_extra(library.path(f"{name}_truth"))["truth"]


def plant(name: str, coupled: bool = False, offset: np.ndarray | None = None) -> Plant:
    """Return the TX40 or RV-2SQ with Ia, Fv, Fc of every joint.

    Args:
        coupled: with the TX40's wrist coupling Iam6, Fvm6, Fcm6.
        offset: (n,) torque offsets, terms ``off1`` …; None for none.
    """
    chain, known = description.read(library.path(name)), truth(name)
    own = "Ia Fv Fc" if offset is None else "Ia Fv Fc off"
    values = {key: known["drives"][key] for key in ("Ia", "Fv", "Fc")}
    values["off"] = np.zeros(chain.n) if offset is None else offset
    terms = drives.standard([own] * chain.n, known["drives"]["v0"])
    amounts = [values[key][joint] for joint in range(chain.n) for key in own.split()]
    if coupled:
        link = known["coupling"]
        terms += drives.coupled(link["joints"][0] - 1, link["joints"][1] - 1, known["drives"]["v0"])
        amounts += [link["Iam"], link["Fvm"], link["Fcm"]]
    return Plant(tree(chain), terms, np.concatenate([standard_parameters(chain), amounts]))


def controller(name: str) -> Controller:
    """Return the published PD controller of the TX40 or RV-2SQ."""
    known = truth(name)["control"]
    return pd(np.array(known["kp"]), np.array(known["kd"]), np.array(known.get("limit", np.inf)))


def model(plant: Plant) -> IdentificationModel:
    """Return the identification model whose parameters are those of the plant."""
    return IdentificationModel(plant.tree, plant.terms)

"""The effects a ladder of models may add to the geometry, each a family of deflection terms."""

from collections.abc import Callable

import numpy as np

from calib.data.poses.choices import MODELS as CHOICES
from calib.robot.chain import Chain
from calib.robot.deflection import Term


def _stiffness(chain: Chain, known: bool) -> list[Term]:
    """Return the deflection of each joint about its axis under gravity: by known torques, else by fitted moments."""
    names = chain.names
    if known:
        return [Term(names[k], "torque", j) for j, k in enumerate(chain.moving) if chain.joints[j].kind == "revolute"]
    return [term for k in chain.moving if chain.elements[k].axis[0] == "r" for term in _sag(chain, int(k))]


def _bending(chain: Chain, known: bool) -> list[Term]:
    """Return the tilt of each joint's frame across its axis under gravity: bearings and links give way too."""
    moving = set(chain.moving.tolist())
    places = [k for k, e in enumerate(chain.elements) if e.axis[0] == "r" and k not in moving and e.owner < chain.n]
    return [term for k in places for term in _sag(chain, k)]


def _sag(chain: Chain, place: int) -> list[Term]:
    element = chain.elements[place]
    return [Term(element.name, "lever", i, a) for i in range(element.owner, chain.n) for a in range(3)]


def _coupling(chain: Chain, known: bool) -> list[Term]:
    """Return what a joint's own reading and its neighbours' add to it: gear ratio and coupled transmissions."""
    names = chain.names
    near = [(j, i) for j in range(chain.n) for i in (j - 1, j, j + 1) if 0 <= i < chain.n]
    return [Term(names[chain.moving[j]], "joint", i) for j, i in near]


def _harmonics(chain: Chain, known: bool, max_order: int = 60) -> list[Term]:
    """Return sin and cos of k q_j on each revolute joint, k = 1 … `max_order`: encoder and gear errors."""
    return [
        Term(chain.names[k], basis, j, order)
        for j, k in enumerate(chain.moving)
        if chain.joints[j].kind == "revolute"
        for order in range(1, max_order + 1)
        for basis in ("cos", "sin")
    ]


def _wobble(chain: Chain, known: bool, max_order: int = 2) -> list[Term]:
    """Return low harmonics of q_j on every other element of joint j: its axis wobbles as it turns."""
    moving = set(chain.moving.tolist())
    return [
        Term(element.name, basis, element.owner, order)
        for k, element in enumerate(chain.elements)
        if k not in moving and element.owner < chain.n and chain.joints[element.owner].kind == "revolute"
        for order in range(1, max_order + 1)
        for basis in ("cos", "sin")
    ]


MODELS = CHOICES[1:]
FAMILIES = (_stiffness, _bending, _coupling, _harmonics, _wobble)
# by name: from a chain, and whether gravity torques are known, to terms
EFFECTS: dict[str, Callable[[Chain, bool], list[Term]]] = dict(zip(MODELS[3:], FAMILIES, strict=True))


def term_groups(terms: tuple[Term, ...]) -> np.ndarray:
    """Return the ridge each term shares (E,): all harmonics of one joint on one element, all else stands alone.

    With a ridge for each order the evidence switches most of them off and takes the rest too large, which rows nearby
    do not show and rows elsewhere do; `term_sizes` says how they fall with their order.
    """
    keys: dict[tuple, int] = {}
    result = []
    for term in terms:
        paired = term.basis in ("cos", "sin")
        key = (term.element, "turn" if paired else term.basis, term.source, 0 if paired else term.order)
        result.append(keys.setdefault(key, len(keys)))
    return np.array(result, dtype=int)


def term_sizes(terms: tuple[Term, ...]) -> np.ndarray:
    """Return the first guess of each coefficient's size (E,); those of harmonics fall with their order.

    Our choice, of one size for all orders, a fall with the root and one with the order itself: regions left out of a
    UR5 and of a Motoman are predicted best by the last.
    """
    return np.array([1e-4 / term.order if term.basis in ("cos", "sin") else 1e-4 for term in terms])

"""What the joint angles do not say: compliance under gravity, coupled axes, encoder and gear errors.

Every effect is linear in its coefficients and adds to the displacement of one element of the chain:

    δ_e(q) = Σ_terms c · b(q),    b one of

    torque        τ_j(q), gravity torque at joint j [N m]: c is the compliance [rad/N m]
    lever         (z_e × R_i e_a) · ĝ, the moment about the element's axis z_e of a first moment of link i along its
                  axis a (0 x, 1 y, 2 z), gravity being a unit vector: sag where the masses are not known
    joint         q_i: gear ratio error (i = j) or coupling of another axis (i ≠ j)
    cos, sin      cos(k q_i), sin(k q_i): harmonics of order k
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibError, one_of
from calib.robot.chain import Chain
from calib.robot.kinematics import joint_frames, sweep

BASES = ("torque", "lever", "joint", "cos", "sin")


@dataclass(frozen=True)
class Term:
    """One effect: element name it moves, basis, joint or link it comes from (index), order k (or axis of a lever)."""

    element: str
    basis: str
    source: int
    order: int = 0

    def __post_init__(self) -> None:
        one_of(self.basis, BASES, "deflection basis")


@dataclass(frozen=True, eq=False)
class Deflection:
    """Terms with their coefficients (E,); ``torque`` (m, n) comes with the poses where a term needs it.

    Attributes:
        terms: the E effects.
        coefficients: (E,) [unit of the element per unit of the basis].
        reference: the chain on which levers (and gravity torques) are evaluated: the nominal one, so that a basis does
            not change while the geometry is fitted.
    """

    terms: tuple[Term, ...] = ()
    coefficients: np.ndarray | tuple[float, ...] = ()
    reference: Chain | None = None

    def with_coefficients(self, values: np.ndarray) -> Deflection:
        return replace(self, coefficients=np.asarray(values, dtype=float))

    def names(self, chain: Chain) -> tuple[str, ...]:
        """Return one readable name per term, e.g. ``theta3 per N·m``, ``theta3 sin 2 q4``."""
        return tuple(_name(term, chain) for term in self.terms)


def _name(term: Term, chain: Chain) -> str:
    source = chain.joint_names[term.source]
    if term.basis == "torque":
        return f"{term.element} compliance"
    if term.basis == "lever":
        return f"{term.element} sag of {source} {'xyz'[term.order]}"
    if term.basis == "joint":
        return f"{term.element} per {source}"
    return f"{term.element} {term.basis} {term.order} {source}"


def evaluate(deflection: Deflection, q: np.ndarray, torque: np.ndarray | None = None) -> np.ndarray:
    """Return the bases b of every term at joint values q (m, n): (E, m).

    Args:
        deflection: the terms, with their reference chain.
        q: (m, n).
        torque: (m, n) gravity torques [N m], for terms of basis ``torque``.
    """
    result = np.empty((len(deflection.terms), len(q)))
    for basis, turn in (("cos", np.cos), ("sin", np.sin)):
        where = [e for e, term in enumerate(deflection.terms) if term.basis == basis]
        orders = np.array([deflection.terms[e].order for e in where])
        result[where] = turn(orders[:, None] * q.T[[deflection.terms[e].source for e in where]])
    for e, term in enumerate(deflection.terms):
        if term.basis == "torque":
            if torque is None:
                raise CalibError("a compliance needs gravity torques: give the robot masses, or ask for fitted ones")
            result[e] = torque[:, term.source]
        elif term.basis == "joint":
            result[e] = q[:, term.source]
    if where := [e for e, term in enumerate(deflection.terms) if term.basis == "lever"]:
        levers = _Levers(deflection, q)
        for e in where:
            result[e] = levers.moment(deflection.terms[e])
    return result


class _Levers:
    """Directions of the elements and links of the reference chain, for one batch of poses."""

    def __init__(self, deflection: Deflection, q: np.ndarray):
        chain = deflection.reference
        if chain is None:
            raise CalibError("sag terms need the reference chain of the deflection")
        self.gravity = chain.gravity / np.linalg.norm(chain.gravity)
        self.across = np.cross(self.gravity, np.moveaxis(sweep(chain, q).directions, 1, -1))
        self.links = joint_frames(chain, q)[:, :, :3, :3]
        self.index = {name: k for k, name in enumerate(chain.names)}

    def moment(self, term: Term) -> np.ndarray:
        """Return (z × u) · ĝ = (ĝ × z) · u for every pose (m,)."""
        return np.einsum("mi,mi->m", self.across[self.index[term.element]], self.links[term.source, :, :, term.order])


def extra_displacements(
    chain: Chain, deflection: Deflection, q: np.ndarray, bases: np.ndarray | None = None
) -> np.ndarray | None:
    """Return what the deflection adds to each element's displacement, (K, m); None without terms."""
    if not deflection.terms:
        return None
    bases = evaluate(deflection, q) if bases is None else bases
    extra = np.zeros((len(chain.elements), len(q)))
    where = target_elements(chain, deflection)
    for place in np.unique(where):
        extra[place] = np.asarray(deflection.coefficients)[where == place] @ bases[where == place]
    return extra


def target_elements(chain: Chain, deflection: Deflection) -> np.ndarray:
    """Return the index of the element each term moves, (E,)."""
    table = {name: k for k, name in enumerate(chain.names)}
    return np.array([table[term.element] for term in deflection.terms], dtype=int)

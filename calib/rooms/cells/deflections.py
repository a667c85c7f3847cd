"""What no rigid geometry holds: a stated, smooth deflection of the joints, hidden from the calibration.

δ_j(q) = c_j τ_j(q) + Σ_k a_jk sin(k q_j + φ_jk),  k = 2, 3: compliance under gravity, and gear harmonics. Orders 0
and 1 would be joint offsets and eccentricities, which a rigid geometry takes over in part.
"""

from __future__ import annotations

import numpy as np

from calib.robot.chain import Chain
from calib.robot.deflection import Deflection, Term

ORDERS = (2, 3)


def deflection(chain: Chain, compliance: np.ndarray, amplitude: np.ndarray, seed: int) -> Deflection:
    """Return compliance and harmonics of every joint of a chain.

    Args:
        chain: the true arm.
        compliance: (n,) [rad/(N m)].
        amplitude: (n,) of each harmonic [rad, or m for a prismatic joint].
        seed: of the phases φ.
    """
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (chain.n, len(ORDERS)))
    terms, values = [], []
    for j, k in enumerate(chain.moving):
        name = chain.elements[k].name
        terms.append(Term(name, "torque", j))
        values.append(compliance[j])
        for order, phase in zip(ORDERS, phases[j]):
            terms += [Term(name, "sin", j, order), Term(name, "cos", j, order)]
            values += [amplitude[j] * np.cos(phase), amplitude[j] * np.sin(phase)]
    return Deflection(tuple(terms), np.array(values), chain)

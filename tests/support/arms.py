"""Arms for the tests: library ones, and one that has everything at once."""

from dataclasses import replace

import numpy as np

from calib.robot.chain import Chain, Element, Joint
from calib.transforms import displace

LIBRARY = ("lwr4plus", "tx40", "rv2sq", "ur5", "panda")


def physical(count: int, seed: int = 0) -> np.ndarray:
    """Return standard parameters (count, 10) of bodies that can exist."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(count):
        points, mass = rng.normal(size=(6, 3)) * 0.2, rng.uniform(0.1, 1.0, 6)
        second = np.einsum("k,ki,kj->ij", mass, points, points)
        inertia = np.trace(second) * np.eye(3) - second
        rows.append([*inertia[np.triu_indices(3)], *(mass @ points), mass.sum()])
    return np.array(rows)


def motley(seed: int = 3) -> Chain:
    """Return a five-joint arm with prismatic joints, axes x, y and z, signs, placements, and gravity askew."""
    rng = np.random.default_rng(seed)
    axes = ("rx", "tz", "ry", "rz", "tx")
    kinds = ("revolute", "prismatic", "revolute", "revolute", "prismatic")
    elements = []
    for j, axis in enumerate(axes):
        placement = displace(np.eye(4), rng.normal(size=6) * 0.5)
        elements.append(Element(f"before{j}", "ty", 0.1 * j, j, placement=placement))
        sign = -1.0 if j in (1, 3) else 1.0
        elements.append(Element(f"moving{j}", axis, 0.3 * rng.normal(), j, j, sign=sign))
        elements.append(Element(f"after{j}", "rx", 0.2, j))
    joints = tuple(Joint(f"joint{j + 1}", kind, -2.0, 2.0) for j, kind in enumerate(kinds))
    return Chain("motley", joints, tuple(elements), inertias=physical(5), gravity=np.array([1.0, -2.0, -9.0]))


def states(n: int, count: int = 20, seed: int = 0) -> np.ndarray:
    """Return q, v, a stacked, (3, count, n)."""
    return np.random.default_rng(seed).normal(size=(3, count, n))


def motley_with_follower() -> Chain:
    """Return the motley arm with a joint that follows another at half its angle."""
    chain = motley()
    return replace(chain, elements=(*chain.elements, Element("follower", "ry", 0.1, 4, 2, ratio=0.5)))

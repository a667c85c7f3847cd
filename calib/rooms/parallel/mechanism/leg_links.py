"""Jacobians, attachments and closure gaps of the legs at given postures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calib.dynamics.bodies import Bodies, bodies_of, upright_turn
from calib.records import frozen
from calib.rooms.parallel.mechanism.parallel_robot import Leg, ParallelRobot


@dataclass(frozen=True, eq=False)
class Posture:
    """N solutions: joints of the whole tree q (N, n_t) [rad or m], and poses of the platform (N, 4, 4)."""

    q: np.ndarray
    pose: np.ndarray

    def __len__(self) -> int:
        return len(self.q)

    def __getitem__(self, index) -> Posture:  # type: ignore[no-untyped-def]
        return Posture(self.q[index], self.pose[index])


@dataclass(frozen=True, eq=False)
class LegLinks:
    """One leg at N postures.

    Attributes:
        full: (N, 6, n) Jacobian of its end: velocity, angular velocity; jacobian: (N, c, n) the held part of it.
        inverse: (N, n, c) J⁺.
        carried: (N, c, 6) G, velocity of its attachment by the platform's twist.
        gap: (N, c) by which its end misses the attachment [m, rad].
        lever: (N, 3) from the platform's origin to the attachment, in the base's axes.
    """

    full: np.ndarray
    jacobian: np.ndarray
    inverse: np.ndarray
    carried: np.ndarray
    gap: np.ndarray
    lever: np.ndarray


def leg_links(robot: ParallelRobot, posture: Posture) -> list[LegLinks]:
    """Return every leg's Jacobian, attachment and gap at postures, by rigid-body relations alone."""
    starts = robot.starts
    return [links_of(leg, posture.q[:, a:b], posture.pose) for leg, a, b in zip(robot.legs, starts, starts[1:])]


def pseudo_inverse(J: np.ndarray) -> np.ndarray:
    """Return J⁺ (N, n, c) of matrices (N, c, n) with at least as many rows as columns."""
    try:
        if J.shape[1] == J.shape[2]:
            return np.linalg.inv(J)
        across = J.transpose(0, 2, 1)
        return np.linalg.solve(across @ J, across)
    except np.linalg.LinAlgError:
        return np.linalg.pinv(J)


def times(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return A x sample by sample; A (N, k, l), x (N, l)."""
    return (A @ x[:, :, None])[:, :, 0]


def links_of(leg: Leg, q: np.ndarray, pose: np.ndarray) -> LegLinks:
    """Return Jacobian, attachment and gap of a leg at joint values q (N, n) and platform poses (N, 4, 4)."""
    from calib.rooms.parallel.mechanism import closure_kernels

    count, n = q.shape
    shapes = ((6, n), (n, leg.held), (leg.held, 6), (leg.held,), (3,))
    full, inverse, carried, gap, lever = (np.zeros((count, *shape)) for shape in shapes)
    bodies, tail = compiled(leg)
    q, pose = (np.require(x, requirements=["C", "W"]) for x in (q, pose))  # numba compiles per kind of array
    closure_kernels.legs(
        bodies.links, bodies.constants, tail, leg.attachment, q, pose, full, inverse, carried, gap, lever
    )
    return LegLinks(full, full[:, : leg.held], inverse, carried, gap, lever)


@lru_cache(maxsize=256)
def compiled(leg: Leg) -> tuple[Bodies, np.ndarray]:
    """Return a leg's arrays for the kernels: its bodies, and its end (4, 4) in its last body's turned frame."""
    bodies = bodies_of(leg.chain)
    turn = upright_turn(int(bodies.axes[-1]))
    return bodies, frozen(turn.T @ leg.chain.tail)

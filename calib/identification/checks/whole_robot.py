"""Torques beside those of the whole robot: does its clock run right, are signs, order and zeros of its joints as said?

A clock that runs s times too slow makes accelerations s² times too small, so that inertias come out s² times too large
while masses, which gravity identifies, stay as they are. How large inertias are compared with masses, lengths alone say
nearly: for rods between the joints their ratio is known up to 17 % on every recording at hand that identifies it
    (Panda, LWR4+, TX40,
11 of a UR10e), whatever the masses and the unit of the torques are. All these have six joints or more; arms of two,
whose last link has no known length, are not looked at: one gave 45. All thresholds are our choice.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np
from scipy.optimize import nnls

from calib.column_changes import Change, Explanation, best_changes, coupling, couplings, exchange, reversal
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.rigid_body import inverse_dynamics
from calib.estimation.whiteness import inflation
from calib.identification.checks.motion_samples import MotionSamples, basis, drive_columns, left_share
from calib.identification.prior import rods
from calib.robot.chain import Chain


@dataclass(frozen=True)
class ClockRatio:
    """Inertias over masses, both beside those of rods between the joints, and the ratio's relative sigma."""

    ratio: float
    relative_sigma: float

    @property
    def clock(self) -> float:
        """By how many times the stamps are too large."""
        return float(np.sqrt(self.ratio))


def clock_ratio(samples: MotionSamples, chain: Chain) -> ClockRatio | None:
    """Return how large inertias are compared with masses; None where neither motion nor arm identify both.

    Torques are τ = α τ_rods + free: α of the rods' torques of motion beside any torque of gravity, then α of their
    gravity beside any torque of motion; drives free in both.
    """
    min_joints = 3  # of the shortest arm that is looked at (our choice)
    if chain.n < min_joints:
        return None
    whole = np.asarray(rods(chain, IdentificationModel(bodies_of(chain), ()))).ravel()
    still, moving = samples.at_rest, samples.inertial - samples.at_rest
    inertia, own = _factor(samples.torque, moving @ whole, np.concatenate([still, samples.drives], axis=2))
    mass, other = _factor(samples.torque, still @ whole, np.concatenate([moving, samples.drives], axis=2))
    min_factor_sigmas = 5.0  # sigmas from which on a factor is told
    if inertia < min_factor_sigmas * own or mass < min_factor_sigmas * other:
        return None
    return ClockRatio(inertia / mass, float(np.hypot(own / inertia, other / mass)))


def _factor(torque: np.ndarray, common: np.ndarray, free: np.ndarray, rounds: int = 3) -> tuple[float, float]:
    """Return α of τ = α common + free x and its sigma, joints weighed by what is left of them.

    `rounds`: of weighing joints by what is left of them.
    """
    m, n = torque.shape
    weight, left, own = np.ones(n), torque, common
    alpha = power = 0.0
    for _ in range(rounds):
        scale = np.repeat(weight, m)
        rows = free.transpose(1, 0, 2).reshape(m * n, -1) * scale[:, None]
        spanned = basis(rows)
        seen, part = (x - spanned @ (spanned.T @ x) for x in (torque.T.ravel() * scale, common.T.ravel() * scale))
        power = float(part @ part)
        if not power > 0.0:
            return 0.0, np.inf
        alpha = float(part @ seen) / power
        left, own = ((x / scale).reshape(n, m) for x in (seen - alpha * part, part))
        weight = 1.0 / np.maximum(left.std(axis=1), 1e-9 * max(float(torque.std()), 1e-300))
    spread = [inflation(each) for each in left]
    return alpha, float(np.sqrt(np.sum(weight[:, None] ** 2 * own**2 * np.array(spread)[:, None]))) / power


def wrong_joints(samples: MotionSamples) -> Explanation | None:
    """Return joints whose torques have the opposite sign, or that count from the joint before; None without such.

    One model of all joints is fitted to each: bodies and offsets of any size, Ia, Fv and Fc of every drive not
    negative, since no drive brakes backwards. The robot's own masses need not be known. What is left are shares of the
    joints' torques.
    """
    n = samples.q.shape[1]
    shares = cache(_shares)

    def reversed_(joint: int) -> Callable[[tuple], tuple]:
        return lambda data: (data[0], data[1] @ reversal(n, joint))

    def counted(matrix: np.ndarray) -> Callable[[tuple], tuple]:
        return lambda data: (_changed(data[0], matrix), data[1])

    # shares that may be left: sound recordings at hand are left 0.91 and more, and 0.84 by couplings (our choice)
    max_left, max_left_coupled = 0.8, 0.7
    table = [Change("torque-sign", reversed_(j), (j,), max_left=max_left) for j in range(n)]
    table += [
        Change("axis-coupled", counted(coupling(n, j, k, way)), (j, k), {"way": "+-"[way < 0.0]}, max_left_coupled)
        for j, k, way in couplings(n)
    ]
    return best_changes((samples, np.ones(n)), table, lambda data: shares(data[0])(data[1]), max_changes=n)


def _shares(samples: MotionSamples) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that says what a model leaves of each joint's torque (n,), its variance being 1, by signs."""
    m, n = samples.q.shape
    scale = 1.0 / np.maximum(samples.torque.std(axis=0), 1e-12)

    def rows(columns: np.ndarray) -> np.ndarray:
        return (columns * scale[:, None]).transpose(1, 0, 2).reshape(n * m, -1)

    drives = samples.drives.reshape(m, n, n, 4)
    free = basis(rows(np.concatenate([samples.inertial, drives[..., 3]], axis=2)))
    positive, each = rows(drives[..., :3].reshape(m, n, -1)), rows(samples.torque[:, :, None] * np.eye(n))
    positive /= np.maximum(np.abs(positive).max(axis=0), 1e-12)
    positive, each = (x - free @ (free.T @ x) for x in (positive, each))
    across, triangle = np.linalg.qr(positive)

    def left(signs: np.ndarray) -> np.ndarray:
        torque = each @ signs
        residual = torque - positive @ nnls(triangle, across.T @ torque)[0]
        return np.maximum((residual.reshape(n, m) ** 2).mean(axis=1), 1e-9)

    return left


def rearranged(samples: MotionSamples, chain: Chain) -> Explanation | None:
    """Return the exchange of two joints, or the right angles at one's zero, that explain most more; None without such.

    The torques are those of the robot's own masses, and what is left of each joint's is a share of its variance.
    """
    n, masses = chain.n, standard_parameters(chain)

    def left(changed: MotionSamples) -> np.ndarray:
        return np.maximum(list(_left(changed, masses)), 1e-9)

    def exchanged(pair: tuple[int, int]) -> Callable[[MotionSamples], MotionSamples]:
        return lambda data: replace(_changed(data, exchange(n, *pair)), effort=data.effort @ exchange(n, *pair))

    def turned(joint: int, angle: float) -> Callable[[MotionSamples], MotionSamples]:
        return lambda data: replace(data, q=data.q + angle * np.eye(n)[joint])

    speed = samples.v.std(axis=0)
    max_left = 0.5  # largest share of their torques' variance that is left as recorded
    min_exchanged_speed = 0.3  # rms, of the fastest joint's: one that hardly moves may have any column
    moves = np.flatnonzero((speed > min_exchanged_speed * speed.max()) & (left(samples) < max_left)).tolist()
    turning = [j for j, joint in enumerate(chain.joints) if joint.kind != "prismatic"]
    table = [Change("columns-exchanged", exchanged(pair), pair) for pair in combinations(moves, 2)]
    table += [
        Change("zero-elsewhere", turned(j, angle), (j,), {"angle": angle})
        for j in turning
        for angle in (0.5 * np.pi, np.pi, -0.5 * np.pi)
    ]
    return best_changes(samples, table, left)


def _changed(samples: MotionSamples, matrix: np.ndarray) -> MotionSamples:
    """Return samples with the joints' columns recombined by a matrix (n, n)."""
    q, v, a = (np.ascontiguousarray(x @ matrix.T) for x in (samples.q, samples.v, samples.a))
    return replace(samples, q=q, v=v, a=a)


def _left(samples: MotionSamples, masses: np.ndarray) -> Iterator[float]:
    """Yield what is left of each joint's torque, as a share of its variance.

    Each torque is that of gravity and that of motion, by the robot's masses, each times a factor, its own drive and
    those of the joints beside it: wrists are coupled by their gears, which an exchange would seem to explain.
    """
    still = inverse_dynamics(samples.bodies, masses, samples.q, np.zeros_like(samples.v), np.zeros_like(samples.a))
    moving = inverse_dynamics(samples.bodies, masses, samples.q, samples.v, samples.a) - still
    drives, torque = drive_columns(samples.v, samples.a), samples.torque
    for joint in range(torque.shape[1]):
        beside = drives[:, max(joint - 1, 0) : joint + 2].reshape(len(torque), -1)
        columns = np.column_stack([still[:, joint], moving[:, joint], beside])
        yield float(left_share(basis(columns), torque[None, :, joint])[0])

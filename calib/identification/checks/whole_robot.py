"""Torques beside those of the whole robot: does its clock run right, are signs, order and zeros of its joints as said?

A clock that runs s times too slow makes accelerations s² times too small, so that inertias come out s² times too large
while masses, which gravity identifies, stay as they are. How large inertias are compared with masses, lengths alone say
nearly: for rods between the joints their ratio is known up to 17 % on every recording at hand that identifies it
    (Panda, LWR4+, TX40,
11 of a UR10e), whatever the masses and the unit of the torques are. All these have six joints or more; arms of two,
whose last link has no known length, are not looked at: one gave 45. All thresholds are our choice.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import nnls

from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.rigid_body import inverse_dynamics
from calib.estimation.whiteness import inflation
from calib.identification.checks.motion_samples import MotionSamples, basis, drive_columns, left_share
from calib.identification.rods import rods
from calib.robot.chain import Chain

# least rms speed of exchanged joints, of the fastest one's: one that hardly moves may have any column
QUARTERS = (1, 2, 3)  # turns of a joint's zero that are tried [90 deg]


@dataclass(frozen=True)
class ClockRatio:
    """Inertias over masses, both beside those of rods between the joints, and the ratio's relative sigma."""

    ratio: float
    relative_sigma: float

    @property
    def clock(self) -> float:
        """By how many times the stamps are too large."""
        return float(np.sqrt(self.ratio))


@dataclass(frozen=True)
class Rearranged:
    """Positions rearranged so that the robot's own masses explain more of the torques.

    Attributes:
        joints: the two, from 0, whose columns are exchanged; or the one whose zero is moved.
        quarters: by how many right angles that is added to; 0: columns are exchanged.
        factor: what is left of the torques over what is left as recorded, rms, the geometric mean of all joints.
        left: largest share of a joint's variance that is left then.
    """

    joints: tuple[int, ...]
    quarters: int
    factor: float
    left: float


@dataclass(frozen=True)
class ReversedSigns:
    """Joints whose torques one model of the robot explains with the opposite sign.

    Attributes:
        joints: these, from 0.
        before, after: rms shares of their torques that are left: as recorded, and with the signs reversed.
    """

    joints: tuple[int, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]


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


def reversed_signs(samples: MotionSamples) -> ReversedSigns | None:
    """Return the joints whose torques are explained with the opposite sign, and how well; None where there are none.

    One model of all joints is fitted to each choice of signs: bodies and offsets of any size, Ia, Fv and Fc of every
    drive not negative, since no drive brakes backwards. Signs are reversed one by one, the one that explains most
    first, as long as the geometric mean of what is left of the joints falls to `max_left` of it. The robot's own
    masses need not be known.
    """
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

    signs = np.ones(n)
    before = now = left(signs)
    max_left = 0.8  # of what is left as recorded, with a sign reversed: sound recordings at hand are left 0.91 and more
    while True:
        tried = [left(np.where(np.arange(n) == j, -signs, signs)) for j in range(n)]
        factors = [np.exp(0.5 * np.mean(np.log(one / now))) for one in tried]
        best = int(np.argmin(factors))
        if factors[best] > max_left:
            break
        signs[best], now = -signs[best], tried[best]
    joints = np.flatnonzero(signs < 0.0)
    if not len(joints):
        return None
    return ReversedSigns(*(tuple(x.tolist()) for x in (joints, np.sqrt(before[joints]), np.sqrt(now[joints]))))


def rearranged(samples: MotionSamples, chain: Chain) -> Rearranged | None:
    """Return the exchange of two joints, or the right angles at one's zero, that explain most more; None without such.

    Each joint's torque is that of gravity and that of motion, by the robot's masses, each times a factor, its own drive
    and those of the joints beside it: wrists are coupled by their gears, which an exchange would seem to explain.
    """
    masses = standard_parameters(chain)
    order, straight = np.arange(chain.n), np.zeros(chain.n)
    before = np.maximum(list(_left(samples, masses, order, straight)), 1e-9)
    speed = samples.v.std(axis=0)
    max_left = 0.5  # largest share of their torques' variance that is left as recorded
    min_exchanged_speed = 0.3
    moves = (speed > min_exchanged_speed * speed.max()) & (before < max_left)
    tried = [((a, b), 0) for a, b in combinations(np.flatnonzero(moves).tolist(), 2)]
    turning = [j for j, joint in enumerate(chain.joints) if joint.kind != "prismatic"]
    tried += [((j,), quarters) for j in turning for quarters in QUARTERS]
    found = None
    for joints, quarters in tried:
        now, zero = order.copy(), straight.copy()
        now[list(joints)] = joints[::-1]
        zero[list(joints)] = quarters * np.pi / 2
        after = np.maximum(list(_left(samples, masses, now, zero)), 1e-9)
        factor = float(np.exp(0.5 * np.mean(np.log(after / before))))
        if found is None or factor < found.factor:
            found = Rearranged(joints, quarters, factor, float(after.max()))
    return found


def _left(samples: MotionSamples, masses: np.ndarray, order: np.ndarray, zero: np.ndarray) -> Iterator[float]:
    """Yield what is left of each recorded joint's torque.

    Args:
        order: (n,) recorded column that holds each joint.
        zero: (n,) added to its positions [rad].
    """
    q, v, a = (np.ascontiguousarray(x[:, order]) for x in (samples.q, samples.v, samples.a))
    q += zero
    still = inverse_dynamics(samples.bodies, masses, q, np.zeros_like(v), np.zeros_like(a))
    moving = inverse_dynamics(samples.bodies, masses, q, v, a) - still
    drives, torque = drive_columns(v, a), samples.torque
    for joint, recorded in sorted(enumerate(order), key=lambda one: one[1]):
        beside = drives[:, max(joint - 1, 0) : joint + 2].reshape(len(q), -1)
        columns = np.column_stack([still[:, joint], moving[:, joint], beside])
        yield float(left_share(basis(columns), torque[None, :, recorded])[0])

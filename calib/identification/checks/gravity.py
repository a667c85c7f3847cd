"""Gravity as a hypothesis: the stated vector, another direction, or torques that hold none at some joints.

For stated masses torque is linear in the gravity vector g, and for a stated g in the masses χ:

    τ = Y(q, v, a; 0) χ + Σ_k g_k Y_k(q) χ + drives,    k = x, y, z in the base frame.

So each direction costs one least-squares fit of bodies of any masses, from products that are computed once, and all
directions together have a bound that costs one more: masses of their own for each of x, y, z. Magnitude stays the
stated one's, since only the ratio of masses to inertias tells it (`recording_sizes.ClockRatio`). Masses that may be
negative fit -g nearly as well as g in slow motion; in fast motion the same first moments bend the inertias.

Whether a joint's torque holds gravity at all is another question: bodies without mass explain torques without
gravity. There the gravity torque of the robot's masses (else of rods, as large as their inertias are) is fitted to each
joint, beside motion and drive. An arm whose joints all turn about the vertical shows neither, and nothing is said.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calib.dynamics.bodies import standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.rigid_body import inverse_dynamics, regressor
from calib.estimation.whiteness import inflation
from calib.identification.checks.recorded_motion import MotionSamples, basis, drive_columns
from calib.identification.checks.recording_sizes import common_factor
from calib.identification.prior import rods
from calib.robot.chain import Chain

STANDARD_GRAVITY = 9.81  # [m/s²], where the stated one is zero
# residual with another hypothesis over that with gravity as stated, from which on it is reported; 0.95 and more on the
# real recordings at hand (our choice)
MAX_LEFT = 0.8
MAX_WORSE = 1.02  # the same for joints whose torques lack what is expected: no worse
MIN_ANGLE = np.radians(10.0)  # between both directions: a robot on a floor that slopes by less is not mounted otherwise
RIVAL = 1.1  # residual with the opposite direction over the best one's, up to which both explain the torques
MAX_FACTOR = 0.15  # gravity torque over the expected, with 2 sigmas, up to which a joint's torque holds none
MIN_SHARE = 0.2  # of the largest joint's expected gravity torque, below which nothing is said of a joint
MIN_CORRELATED = 0.1  # of a joint's expected gravity torque that motion and friction do not explain as well
MIN_SIGMAS = 5.0  # of the inertias' size relative to rods, from which on it is known
MASSES = [6, 7, 8, 9]  # of a body's standard parameters, those that gravity acts on
ROUNDS = 4  # of weighing joints by their residuals
DIRECTIONS = 60  # of a half sphere that are tried first: some 20 degrees apart


@dataclass(frozen=True, eq=False)
class GravityHypotheses:
    """What the torques of a recorded motion say of gravity.

    Attributes:
        stated: (3,) in the base frame [m/s²].
        before: (n,) unexplained share of the joints' rms torque with it.
        direction: (3,) another one of the same magnitude that explains the torques; None without any.
        after: (n,) unexplained share with it; that with the stated one where there is none.
        ambiguous: whether its opposite, or yet another direction, explains as much.
        absent: joints, from 0, whose torques hold no gravity.
        factors: (n,) gravity torque over the expected one; NaN where the motion does not tell.
        sigmas: (n,) of `factors`.
    """

    stated: np.ndarray
    before: np.ndarray
    direction: np.ndarray | None
    after: np.ndarray
    ambiguous: bool
    absent: tuple[int, ...]
    factors: np.ndarray
    sigmas: np.ndarray

    @property
    def factor(self) -> float:
        """Ratio of the rms residuals with the other direction and with the stated one, their geometric mean."""
        return float(np.exp(np.mean(np.log(self.after / self.before))))

    @property
    def refuted(self) -> bool:
        """Whether the torques refute gravity as stated."""
        return self.direction is not None or bool(self.absent)


def gravity_of(motions: Sequence[MotionSamples], chain: Chain, newtons: bool = True) -> GravityHypotheses:
    """Return what recordings of one robot, all mounted alike, say of gravity.

    Args:
        motions: samples of the recordings, their bodies under the stated gravity.
        chain: the arm, whose masses count where it has any.
        newtons: whether torques are in N m; of those in another unit only proportions count.
    """
    sums = _Sums(motions)
    stated = np.array(motions[0].bodies.gravity)
    before = sums.left(stated)
    turned = _another_direction(sums, stated, before)
    gravity, after = (stated, before) if turned is None else (turned, sums.left(turned))
    factors, sigmas, outweighed = _gravity_factors(motions, chain, gravity, newtons)
    ambiguous = False
    if turned is not None and _mean(sums.left(-gravity) / after) < RIVAL:
        # masses are positive: the expected torques' sign decides between both
        ambiguous = not np.isfinite(factors).any()
        if not ambiguous and np.nanmedian(factors) < 0.0:
            turned, gravity, after, factors = -turned, -gravity, sums.left(-gravity), -factors
    # and the whole torque varies less than gravity's alone would
    certain = np.isfinite(factors) & (np.abs(factors) + 2.0 * sigmas < MAX_FACTOR) & outweighed
    absent = _without_gravity(sums, gravity, after, np.flatnonzero(certain).tolist())
    return GravityHypotheses(stated, before, turned, after, ambiguous, absent, factors, sigmas)


def _another_direction(sums: "_Sums", stated: np.ndarray, before: np.ndarray) -> np.ndarray | None:
    """Return the gravity vector (3,) of the stated one's magnitude that explains the torques instead; None if it does.

    `before`: (n,) unexplained shares with the stated vector.
    """
    bound = sums.bound()
    if _mean(bound / before) > MAX_LEFT:
        return None
    axis = _best_direction(sums, float(np.linalg.norm(stated)) or STANDARD_GRAVITY, bound)
    best = min((axis, -axis), key=lambda gravity: _mean(sums.left(gravity)))
    left = sums.left(best)
    none = sums.left(np.zeros(3))
    helps = _mean(left / before) < MAX_LEFT and _mean(left / none) < MAX_LEFT
    return best if helps and _angle(best, stated) > MIN_ANGLE else None


def _without_gravity(
    sums: "_Sums", gravity: np.ndarray, left: np.ndarray, candidates: Sequence[int]
) -> tuple[int, ...]:
    """Return the joints whose torques hold no gravity: those that are better explained without.

    Of `candidates`, whose torques lack what is expected of the robot's masses, it is enough that they are explained
    as well. `left`: (n,) unexplained shares with gravity at all joints.
    """
    absent, now = list(candidates), left
    if absent:
        now = sums.left(gravity, absent)
        absent, now = (absent, now) if _mean(now / left) < MAX_WORSE else ([], left)
    while len(absent) < sums.n:
        tried = {joint: sums.left(gravity, [*absent, joint]) for joint in range(sums.n) if joint not in absent}
        joint = min(tried, key=lambda each: _mean(tried[each]))
        if _mean(tried[joint] / now) > MAX_LEFT:
            break
        absent, now = [*absent, joint], tried[joint]
    return tuple(sorted(absent))


class _Sums:
    """Products of the columns of motions by joint: bodies in motion without gravity, in each of x, y, z, and drives."""

    def __init__(self, motions: Sequence[MotionSamples]) -> None:
        """Sum the products WᵀW of all motions, joint by joint."""
        self.n, self.bodies = motions[0].q.shape[1], motions[0].bodies.count
        self.squares = np.sum([_products(motion) for motion in motions], axis=0)
        self.heavy = slice(10 * self.bodies, 22 * self.bodies)
        self.power = np.maximum(self.squares[:, -1, -1], 1e-300)

    def left(self, gravity: np.ndarray, without: Collection[int] = ()) -> np.ndarray:
        """Return the unexplained share (n,) of the joints' rms torques under a gravity vector (3,).

        `without`: joints, from 0, whose torques hold none.
        """
        squares = np.array(self.squares)
        for joint in without:
            squares[joint, self.heavy] = 0.0
            squares[joint, :, self.heavy] = 0.0
        return self._left(self._under(gravity), squares)

    def bound(self) -> np.ndarray:
        """Return the share (n,) that is left where each axis of the base has masses of its own."""
        return self._left(np.eye(self.squares.shape[1]), self.squares)

    def cost(self, left: np.ndarray) -> Callable[[np.ndarray], float]:
        """Return a function from a gravity vector (3,) to the sum of squares, joints weighed by shares (n,) left."""
        whole = np.tensordot(1.0 / (left**2 * self.power), self.squares, 1)

        def squares(gravity: np.ndarray) -> float:
            change = self._under(gravity)
            own = change.T @ whole @ change
            return float(own[-1, -1] - own[-1, :-1] @ _solved(own))

        return squares

    def _under(self, gravity: np.ndarray) -> np.ndarray:
        """Return the matrix (k, p + 1) from the columns of bodies under a gravity vector (3,) to all columns."""
        inertial = np.eye(10 * self.bodies)
        masses = inertial.reshape(self.bodies, 10, -1)[:, MASSES].reshape(4 * self.bodies, -1)
        mixed = np.vstack([inertial, *(component * masses for component in gravity)])
        rest = np.eye(4 * self.n + 1)
        return np.block([[mixed, np.zeros((len(mixed), len(rest)))], [np.zeros((len(rest), mixed.shape[1])), rest]])

    def _left(self, change: np.ndarray, squares: np.ndarray) -> np.ndarray:
        """Return the unexplained shares (n,) of products by joint, their columns changed by a matrix (k, p + 1)."""
        left = self.power
        for _ in range(ROUNDS):
            whole = np.tensordot(1.0 / np.maximum(left, 1e-12 * self.power), squares, 1)
            values = change @ np.append(_solved(change.T @ whole @ change), -1.0)
            left = np.maximum((squares @ values) @ values, 0.0)
        return np.sqrt(np.maximum(left / self.power, 1e-12))


def _products(motion: MotionSamples) -> np.ndarray:
    """Return WᵀW by joint (n, k, k) of the columns W = [bodies without gravity, in x, y, z, drives, torque]."""
    columns = _columns(motion).transpose(1, 0, 2)
    return np.asarray(columns.transpose(0, 2, 1) @ columns)


def _columns(motion: MotionSamples) -> np.ndarray:
    """Return the columns (m, n, 10 B + 3 · 4 B + 4 n + 1): bodies without gravity, in x, y, z, drives, and torque."""
    m, n = motion.q.shape
    still = np.zeros_like(motion.v)
    parts = [_flat(regressor(motion.bodies.with_gravity(np.zeros(3)), motion.q, motion.v, motion.a))]
    for axis in np.eye(3):
        heavy = regressor(motion.bodies.with_gravity(axis), motion.q, still, still)
        parts.append(heavy.reshape(m, n, -1, 10)[..., MASSES].reshape(m, n, -1))
    torque = motion.torque - motion.torque.mean(axis=0)
    return np.concatenate([*parts, motion.drives, torque[:, :, None]], axis=2)


def _flat(columns: np.ndarray) -> np.ndarray:
    return columns.reshape(*columns.shape[:2], -1)


def _solved(square: np.ndarray) -> np.ndarray:
    """Return the least-squares solution (p,) of [W y]ᵀ[W y] (p + 1, p + 1), directions without data left at zero."""
    size = np.sqrt(np.diag(square)[:-1])
    scale = np.where(size > 1e-9 * size.max(), size, np.inf)
    scaled = square[:-1, :-1] / (scale[:, None] * scale)
    scaled.flat[:: len(scaled) + 1] += 1e-9
    return np.asarray(np.linalg.solve(scaled, square[:-1, -1] / scale) / scale)


def _mean(ratios: np.ndarray) -> float:
    """Return the geometric mean of ratios (n,)."""
    return float(np.exp(np.mean(np.log(ratios))))


def _angle(one_vector: np.ndarray, other_vector: np.ndarray) -> float:
    """Return the angle between two vectors (3,) [rad]; a right one where one of them is zero."""
    size = float(np.linalg.norm(one_vector) * np.linalg.norm(other_vector))
    return float(np.arccos(np.clip(one_vector @ other_vector / size, -1.0, 1.0))) if size > 0.0 else 0.5 * np.pi


def _best_direction(sums: _Sums, size: float, left: np.ndarray) -> np.ndarray:
    """Return the gravity vector (3,) of a size [m/s²] that leaves least unexplained, of both signs either.

    Joints are weighed by what masses of their own for each axis leave of them (n,), then by what the direction leaves.
    """
    cost = sums.cost(left)
    first = min(size * _half_sphere(DIRECTIONS), key=cost)
    near = min((first, -first), key=cost)
    for _ in range(2):
        near = _refined(cost, near)
        cost = sums.cost(sums.left(near))
    return near


def _refined(cost: Callable[[np.ndarray], float], first: np.ndarray) -> np.ndarray:
    """Return the vector (3,) of least cost near `first`, of the same size."""
    from scipy.optimize import minimize  # slow to load

    size = float(np.linalg.norm(first))
    across = np.linalg.svd(first[None])[2][1:]

    def turned(amounts: np.ndarray) -> np.ndarray:
        vector = first + size * amounts @ across
        return np.asarray(size * vector / np.linalg.norm(vector))

    corners = [[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]]
    options = {"initial_simplex": corners, "xatol": 1e-4, "fatol": 1e-4 * cost(first), "maxfev": 80}
    return turned(minimize(lambda amounts: cost(turned(amounts)), np.zeros(2), method="Nelder-Mead", options=options).x)


def _half_sphere(count: int) -> np.ndarray:
    """Return directions (count, 3) spread evenly over the half sphere z > 0 by the golden angle."""
    height = 1.0 - (np.arange(count) + 0.5) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    radius = np.sqrt(1.0 - height**2)
    return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), height])


def _gravity_factors(
    motions: Sequence[MotionSamples], chain: Chain, gravity: np.ndarray, newtons: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the joints' gravity torques over those expected under a vector (3,), and their sigmas, (n,) each.

    The third array says where the expected torque of gravity varies more than the whole recorded one.

    Each joint's torque is that of gravity by the robot's masses, that of motion by its inertias, each times a factor,
    and that of its drive. NaN where no gravity torque is expected, or motion and friction look like it.
    """
    n = chain.n
    own_masses = chain.inertias is not None and bool(chain.inertias[:, 9].any())
    rod_like = rods(chain, IdentificationModel(motions[0].bodies, ()))
    reference = standard_parameters(chain) if own_masses else np.asarray(rod_like).ravel()
    scale = 1.0 if own_masses and newtons else _inertia_factor(motions, reference)
    factors, sigmas = np.full(n, np.nan), np.full(n, np.nan)
    if not np.isfinite(scale):
        return factors, sigmas, np.zeros(n, dtype=bool)
    expected, moved = [], []
    for motion in motions:
        still = np.zeros_like(motion.v)
        free, heavy = motion.bodies.with_gravity(np.zeros(3)), motion.bodies.with_gravity(gravity)
        moved.append(inverse_dynamics(free, reference, motion.q, motion.v, motion.a))
        expected.append(inverse_dynamics(heavy, reference, motion.q, still, still))
    weight, inertia = np.concatenate(expected), np.concatenate(moved)
    torque = np.concatenate([motion.torque for motion in motions])
    drives = np.concatenate([drive_columns(motion.v, motion.a) for motion in motions])
    size = weight.std(axis=0)
    least = MIN_SHARE * max(float(size.max()), 1e-9)
    for joint in np.flatnonzero(size > least):
        spanned = basis(np.column_stack([inertia[:, joint], drives[:, joint]]))
        part, seen = (x - spanned @ (spanned.T @ x) for x in (weight[:, joint], torque[:, joint]))
        if np.sqrt(np.mean(part**2)) < MIN_CORRELATED * size[joint]:
            continue
        power = float(part @ part)
        factor = float(part @ seen) / power
        rest = seen - factor * part
        factors[joint] = factor / scale
        sigmas[joint] = np.sqrt(inflation(rest) * float(rest @ rest) / len(rest) / power) / scale
    return factors, sigmas, abs(scale) * size > torque.std(axis=0)


def _inertia_factor(motions: Sequence[MotionSamples], reference: np.ndarray) -> float:
    """Return the robot's inertias over those of bodies (10 B,), whatever gravity is; NaN where motion does not tell."""
    moving, free, torque = [], [], []
    for motion in motions:
        columns = _columns(motion)
        moving.append(columns[:, :, : len(reference)] @ reference)
        free.append(columns[:, :, len(reference) : -1])
        torque.append(columns[:, :, -1])
    factor, sigma = common_factor(np.concatenate(torque), np.concatenate(moving), np.concatenate(free))
    return factor if factor > MIN_SIGMAS * sigma else np.nan

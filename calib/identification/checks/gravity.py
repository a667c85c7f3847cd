"""Test of gravity: do the torques show the stated vector, another direction, or no gravity at some joints?

Torque is linear in the gravity vector g for given masses χ, and linear in χ for a given g:

    τ = Y(q, v, a; 0) χ + Σ_k g_k Y_k(q) χ + drives,    k = x, y, z in the base frame.

So each tested direction needs one least-squares fit of bodies with any masses, from matrix products that are computed
once. A further fit with separate masses for x, y and z gives a lower bound of the residual of all directions. The
magnitude of g remains the stated one, since torques identify only the ratio of masses to inertias
(`recording_sizes.ClockRatio`). If masses may be negative, -g fits nearly as well as g in slow motion; in fast motion
the first moments must also fit the inertial torques, which decides the sign.

A separate test decides whether a joint's torque contains gravity at all, since bodies without mass also explain torques
without gravity. The gravity torque of the robot's masses (if these are unknown, of rods scaled by the robot's inertias)
is fitted to each joint's torque, together with the torques of motion and drive. For an arm whose joints all turn about
the vertical neither test applies, and no result is reported.
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

STANDARD_GRAVITY = 9.81
"""Gravity where the stated one is zero [m/s²]."""
MAX_LEFT = 0.8
"""Residual with another hypothesis over that with gravity as stated, from which on it is reported.

0.95 and more on the real recordings at hand (our choice).
"""
MAX_WORSE = 1.02
"""The same for joints whose torques lack what is expected: no worse."""
MIN_ANGLE = np.radians(10.0)
"""Angle between both directions: a robot on a floor that slopes by less is not mounted otherwise [rad]."""
RIVAL = 1.1
"""Residual with the opposite direction over the best one's, up to which both explain the torques."""
MAX_FACTOR = 0.15
"""Gravity torque over the expected, with 2 sigmas, up to which a joint's torque holds none."""
MIN_SHARE = 0.2
"""Expected gravity torque in units of the largest joint's, from which something is said of a joint."""
MIN_CORRELATED = 0.1
"""Share of a joint's expected gravity torque that motion and friction do not explain as well, at least."""
MIN_SIGMAS = 5.0
"""Sigmas of the inertias' size relative to rods, from which on it is known."""
MASSES = [6, 7, 8, 9]
"""Standard parameters of a body that gravity acts on."""
ROUNDS = 4
"""Rounds of weighing joints by their residuals."""
DIRECTIONS = 60
"""Directions of a half sphere that are tried first: some 20 degrees apart."""


@dataclass(frozen=True, eq=False)
class GravityHypotheses:
    """Gravity as identified from the torques of recorded motions, compared with the stated vector.

    Attributes:
        stated: (3,) stated gravity vector in the base frame [m/s²].
        before: (n,) unexplained share of each joint's rms torque with the stated vector.
        direction: (3,) another vector of the same magnitude that explains the torques; None if there is none.
        after: (n,) unexplained share with `direction`; equal to `before` if `direction` is None.
        ambiguous: whether the opposite of `direction`, or a third direction, explains the torques as well.
        absent: joints, from 0, whose torques contain no gravity.
        factors: (n,) identified over expected gravity torque; NaN where the motion does not identify this factor.
        sigmas: (n,) standard deviations of `factors`.
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
        """Ratio of rms residuals with `direction` and with the stated gravity, geometric mean over the joints."""
        ratio = self.after / self.before
        return float(np.exp(np.mean(np.log(ratio))))

    @property
    def refuted(self) -> bool:
        """Whether another direction explains the torques, or some joints' torques contain no gravity."""
        return self.direction is not None or bool(self.absent)


def gravity_of(motions: Sequence[MotionSamples], chain: Chain, newtons: bool = True) -> GravityHypotheses:
    """Return gravity as identified from recordings of one robot in one mounting, compared with the stated vector.

    Args:
        motions: samples of the recordings; their bodies have the stated gravity.
        chain: the arm; its masses are used if it has any.
        newtons: whether torques are in N m; in another unit only their proportions are used.
    """
    sums = _GravitySums(motions)
    stated = np.array(motions[0].bodies.gravity)
    before = sums.unexplained(stated)
    direction = _another_direction(sums, stated, before)
    gravity, after = stated, before
    if direction is not None:
        gravity, after = direction, sums.unexplained(direction)
    factors, sigmas, outweighed = _gravity_factors(motions, chain, gravity, newtons)
    ambiguous = False
    if direction is not None:
        opposite = sums.unexplained(-gravity)
        if _mean(opposite / after) < RIVAL:
            # Masses are positive: the expected torques' sign decides between both.
            ambiguous = not np.isfinite(factors).any()
            if not ambiguous and np.nanmedian(factors) < 0.0:
                direction = -direction
                gravity = -gravity
                after = opposite
                factors = -factors
    # Outweighed: the whole torque varies less than gravity's alone would.
    certain = np.isfinite(factors) & (np.abs(factors) + 2.0 * sigmas < MAX_FACTOR) & outweighed
    candidates = np.flatnonzero(certain).tolist()
    absent = _without_gravity(sums, gravity, after, candidates)
    return GravityHypotheses(stated, before, direction, after, ambiguous, absent, factors, sigmas)


def _another_direction(sums: "_GravitySums", stated: np.ndarray, before: np.ndarray) -> np.ndarray | None:
    """Return the gravity vector (3,) that explains the torques better than the stated one; None if there is none.

    Args:
        sums: regressor products of the motions.
        stated: (3,) stated gravity vector, which gives the magnitude.
        before: (n,) unexplained share of each joint's rms torque with the stated vector.
    """
    bound = sums.bound()
    if _mean(bound / before) > MAX_LEFT:
        return None
    magnitude = float(np.linalg.norm(stated)) or STANDARD_GRAVITY
    axis = _best_direction(sums, magnitude, bound)
    best = min((axis, -axis), key=lambda gravity: _mean(sums.unexplained(gravity)))
    with_best = sums.unexplained(best)
    with_none = sums.unexplained(np.zeros(3))
    helps = _mean(with_best / before) < MAX_LEFT and _mean(with_best / with_none) < MAX_LEFT
    return best if helps and _angle(best, stated) > MIN_ANGLE else None


def _without_gravity(
    sums: "_GravitySums", gravity: np.ndarray, unexplained: np.ndarray, candidates: Sequence[int]
) -> tuple[int, ...]:
    """Return the joints whose torques contain no gravity, i.e. that a model without gravity explains better.

    Args:
        sums: regressor products of the motions.
        gravity: (3,) gravity vector.
        unexplained: (n,) unexplained share of each joint's rms torque with gravity at all joints.
        candidates: joints whose torques do not contain the gravity torque of the robot's masses; for them it suffices
            that the fit without gravity is as good.
    """
    absent: list[int] = []
    if candidates:
        without = sums.unexplained(gravity, candidates)
        if _mean(without / unexplained) < MAX_WORSE:
            absent, unexplained = list(candidates), without
    while len(absent) < sums.n:
        shares = {}
        for joint in range(sums.n):
            if joint not in absent:
                shares[joint] = sums.unexplained(gravity, [*absent, joint])
        best = min(shares, key=lambda joint: _mean(shares[joint]))
        if _mean(shares[best] / unexplained) > MAX_LEFT:
            break
        absent.append(best)
        unexplained = shares[best]
    return tuple(sorted(absent))


class _GravitySums:
    """Regressor products WᵀW of each joint, summed over motions.

    The columns of W describe bodies in motion without gravity, bodies at rest under gravity along x, y and z, and
    drives; the last column is the torque.
    """

    def __init__(self, motions: Sequence[MotionSamples]) -> None:
        """Sum the products WᵀW of all motions, joint by joint."""
        self.n = motions[0].q.shape[1]
        self.bodies = motions[0].bodies.count
        self.squares = np.sum([_products(motion) for motion in motions], axis=0)
        self.heavy = slice(10 * self.bodies, 22 * self.bodies)
        self.power = np.maximum(self.squares[:, -1, -1], 1e-300)

    def unexplained(self, gravity: np.ndarray, without: Collection[int] = ()) -> np.ndarray:
        """Return the unexplained share (n,) of each joint's rms torque under a gravity vector.

        Args:
            gravity: (3,) vector in the base frame [m/s²].
            without: joints, from 0, at which gravity is omitted.
        """
        squares = np.array(self.squares)
        for joint in without:
            squares[joint, self.heavy] = 0.0
            squares[joint, :, self.heavy] = 0.0
        return self._unexplained(self._under(gravity), squares)

    def bound(self) -> np.ndarray:
        """Return the unexplained share (n,) with separate masses for each axis: a lower bound for any direction."""
        return self._unexplained(np.eye(self.squares.shape[1]), self.squares)

    def cost(self, unexplained: np.ndarray) -> Callable[[np.ndarray], float]:
        """Return a function that maps a gravity vector (3,) to the weighted sum of squared residuals of all joints.

        Args:
            unexplained: (n,) unexplained shares, by whose inverse squares the joints are weighted.
        """
        weight = 1.0 / (unexplained**2 * self.power)
        total = np.tensordot(weight, self.squares, 1)

        def squares(gravity: np.ndarray) -> float:
            change = self._under(gravity)
            square = change.T @ total @ change
            explained = square[-1, :-1] @ _solved(square)
            return float(square[-1, -1] - explained)

        return squares

    def _under(self, gravity: np.ndarray) -> np.ndarray:
        """Return the matrix (k, p + 1) from the k columns to p columns under a gravity vector (3,), and the torque."""
        inertial = np.eye(10 * self.bodies)
        by_body = inertial.reshape(self.bodies, 10, -1)
        masses = by_body[:, MASSES].reshape(4 * self.bodies, -1)
        heavy = [component * masses for component in gravity]
        bodies = np.vstack([inertial, *heavy])
        drives = np.eye(4 * self.n + 1)
        beside_bodies = np.zeros((len(bodies), len(drives)))
        beside_drives = np.zeros((len(drives), bodies.shape[1]))
        return np.block([[bodies, beside_bodies], [beside_drives, drives]])

    def _unexplained(self, change: np.ndarray, squares: np.ndarray) -> np.ndarray:
        """Return the unexplained shares (n,) of a fit with the columns combined by a matrix `change` (k, p + 1).

        Args:
            change: matrix that combines the k columns into p columns and the torque.
            squares: (n, k, k) WᵀW of each joint.
        """
        residual = self.power
        for _ in range(ROUNDS):
            weight = 1.0 / np.maximum(residual, 1e-12 * self.power)
            total = np.tensordot(weight, squares, 1)
            values = change @ np.append(_solved(change.T @ total @ change), -1.0)
            residual = np.maximum((squares @ values) @ values, 0.0)
        return np.sqrt(np.maximum(residual / self.power, 1e-12))


def _products(motion: MotionSamples) -> np.ndarray:
    """Return WᵀW of each joint (n, k, k) for the columns of `_columns`.

    Args:
        motion: samples of one recording.
    """
    columns = _columns(motion).transpose(1, 0, 2)
    return np.asarray(columns.transpose(0, 2, 1) @ columns)


def _columns(motion: MotionSamples) -> np.ndarray:
    """Return the columns (m, n, 10 B + 3 · 4 B + 4 n + 1) of m samples of n joints.

    They describe bodies in motion without gravity, bodies at rest under gravity along x, y and z, and drives; the last
    column is the torque.

    Args:
        motion: m samples of one recording of n joints and B bodies.
    """
    m, n = motion.q.shape
    zero = np.zeros_like(motion.v)
    weightless = motion.bodies.with_gravity(np.zeros(3))
    body_columns = regressor(weightless, motion.q, motion.v, motion.a)
    columns = [body_columns.reshape(m, n, -1)]
    for axis in np.eye(3):
        at_rest = regressor(motion.bodies.with_gravity(axis), motion.q, zero, zero)
        heavy = at_rest.reshape(m, n, -1, 10)[..., MASSES]
        columns.append(heavy.reshape(m, n, -1))
    torque = motion.torque - motion.torque.mean(axis=0)
    target = torque[:, :, None]
    return np.concatenate([*columns, motion.drives, target], axis=2)


def _solved(square: np.ndarray) -> np.ndarray:
    """Return the least-squares solution (p,) from [W y]ᵀ[W y] (p + 1, p + 1); unidentified directions are zero."""
    size = np.sqrt(np.diag(square)[:-1])
    scale = np.where(size > 1e-9 * size.max(), size, np.inf)
    scaled = square[:-1, :-1] / (scale[:, None] * scale)
    scaled.flat[:: len(scaled) + 1] += 1e-9
    solution = np.linalg.solve(scaled, square[:-1, -1] / scale)
    return np.asarray(solution / scale)


def _mean(ratios: np.ndarray) -> float:
    """Return the geometric mean of ratios (n,)."""
    return float(np.exp(np.mean(np.log(ratios))))


def _angle(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle between the vectors `first` and `second` (3,) [rad]; a right angle if one of them is zero."""
    size = float(np.linalg.norm(first) * np.linalg.norm(second))
    if not size > 0.0:
        return 0.5 * np.pi
    return float(np.arccos(np.clip(first @ second / size, -1.0, 1.0)))


def _best_direction(sums: _GravitySums, magnitude: float, unexplained: np.ndarray) -> np.ndarray:
    """Return the gravity vector (3,) of the given magnitude with the smallest residual; both signs are tried.

    Args:
        sums: regressor products of the motions.
        magnitude: length of the vector [m/s²].
        unexplained: (n,) unexplained shares with separate masses for each axis, which weight the joints at first; later
            the shares of the best direction do.
    """
    cost = sums.cost(unexplained)
    axis = min(magnitude * _half_sphere(DIRECTIONS), key=cost)
    best = min((axis, -axis), key=cost)
    for _ in range(2):
        best = _refined(cost, best)
        cost = sums.cost(sums.unexplained(best))
    return best


def _refined(cost: Callable[[np.ndarray], float], start: np.ndarray) -> np.ndarray:
    """Return the vector (3,) with the smallest cost near `start`, of equal length.

    Args:
        cost: function of a vector (3,).
        start: first vector, whose length is kept.
    """
    # Imported here because it is slow to load.
    from scipy.optimize import minimize

    size = float(np.linalg.norm(start))
    across = np.linalg.svd(start[None])[2][1:]

    def turned(amounts: np.ndarray) -> np.ndarray:
        vector = start + size * amounts @ across
        return np.asarray(size * vector / np.linalg.norm(vector))

    def turned_cost(amounts: np.ndarray) -> float:
        problem = turned(amounts)
        return cost(problem)

    corners = [[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]]
    options = {"initial_simplex": corners, "xatol": 1e-4, "fatol": 1e-4 * cost(start), "maxfev": 80}
    solution = minimize(turned_cost, np.zeros(2), method="Nelder-Mead", options=options)
    return turned(solution.x)


def _half_sphere(count: int) -> np.ndarray:
    """Return directions (count, 3) spread evenly over the half sphere z > 0 by the golden angle."""
    height = 1.0 - (np.arange(count) + 0.5) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    radius = np.sqrt(1.0 - height**2)
    return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), height])


def _gravity_factors(
    motions: Sequence[MotionSamples], chain: Chain, gravity: np.ndarray, newtons: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return identified over expected gravity torques of the joints, standard deviations of these factors, and a mask.

    The mask marks joints whose expected gravity torque varies more than the whole recorded torque. All three arrays are
    (n,).

    Each joint's torque is modelled as a factor times the gravity torque of the robot's masses, plus a factor times the
    torque of its inertias in motion, plus the drive's torque. Factor and sigma are NaN if hardly any gravity torque is
    expected, or if motion and friction cannot be distinguished from it.

    Args:
        motions: samples of the recordings.
        chain: the arm; rods replace its masses if it has none.
        gravity: (3,) gravity vector [m/s²].
        newtons: whether torques are in N m.
    """
    n = chain.n
    factors = np.full(n, np.nan)
    sigmas = np.full(n, np.nan)
    has_masses = chain.inertias is not None and bool(chain.inertias[:, 9].any())
    if has_masses:
        reference = standard_parameters(chain)
    else:
        bodies_alone = IdentificationModel(motions[0].bodies, ())
        reference = np.asarray(rods(chain, bodies_alone)).ravel()
    scale = 1.0
    if not (has_masses and newtons):
        scale = _inertia_factor(motions, reference)
    if not np.isfinite(scale):
        return factors, sigmas, np.zeros(n, dtype=bool)

    of_gravity, of_motion = [], []
    for motion in motions:
        zero = np.zeros_like(motion.v)
        weightless = motion.bodies.with_gravity(np.zeros(3))
        heavy = motion.bodies.with_gravity(gravity)
        of_motion.append(inverse_dynamics(weightless, reference, motion.q, motion.v, motion.a))
        of_gravity.append(inverse_dynamics(heavy, reference, motion.q, zero, zero))
    expected = np.concatenate(of_gravity)
    inertia = np.concatenate(of_motion)
    torque = np.concatenate([motion.torque for motion in motions])
    drives = np.concatenate([drive_columns(motion.v, motion.a) for motion in motions])
    size = expected.std(axis=0)
    min_size = MIN_SHARE * max(float(size.max()), 1e-9)
    for joint in np.flatnonzero(size > min_size):
        columns = np.column_stack([inertia[:, joint], drives[:, joint]])
        free = basis(columns)
        expected_part = expected[:, joint] - free @ (free.T @ expected[:, joint])
        torque_part = torque[:, joint] - free @ (free.T @ torque[:, joint])
        if np.sqrt(np.mean(expected_part**2)) < MIN_CORRELATED * size[joint]:
            continue
        power = float(expected_part @ expected_part)
        factor = float(expected_part @ torque_part) / power
        residual = torque_part - factor * expected_part
        mean_square = float(residual @ residual) / len(residual)
        factors[joint] = factor / scale
        sigmas[joint] = np.sqrt(inflation(residual) * mean_square / power) / scale
    return factors, sigmas, abs(scale) * size > torque.std(axis=0)


def _inertia_factor(motions: Sequence[MotionSamples], reference: np.ndarray) -> float:
    """Return the ratio of the robot's inertias to reference inertias, for any gravity; NaN if not identified.

    Args:
        motions: samples of the recordings.
        reference: (10 B,) standard parameters of the reference bodies.
    """
    moving = []
    free = []
    torque = []
    for motion in motions:
        columns = _columns(motion)
        moving.append(columns[:, :, : len(reference)] @ reference)
        free.append(columns[:, :, len(reference) : -1])
        torque.append(columns[:, :, -1])
    torques = np.concatenate(torque)
    moving_torques = np.concatenate(moving)
    free_torques = np.concatenate(free)
    factor, sigma = common_factor(torques, moving_torques, free_torques)
    return factor if factor > MIN_SIGMAS * sigma else np.nan

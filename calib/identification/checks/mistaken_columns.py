"""Search for columns of a recording that belong to another joint or robot, or have another sign, factor or zero.

Every hypothesis is a `Change` of the torque or position columns, or of the robot. All have one common score: the
unexplained share of the joints' torques after a fit of bodies of any masses. The described masses are not needed. A
hypothesis is named only where the score becomes much smaller than with the columns as recorded, which is the hypothesis
'none of these'.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, lru_cache, partial
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from scipy.optimize import fminbound, nnls

from calib.column_changes import Change, Explanation, best_changes, coupling, couplings, exchange, reversal
from calib.dynamics.bodies import REVOLUTE, Bodies, bodies_of, standard_parameters
from calib.dynamics.rigid_body import inverse_dynamics
from calib.identification.checks.recorded_motion import MotionSamples, base_columns, basis, drive_columns, spanning
from calib.robot.chain import Chain
from calib.robot.library import load, names

MAX_LEFT = 0.8
"""Share of a joint's residual that a reversed sign or a factor of the torques may leave.

Sound recordings at hand keep 0.91 and more, and 0.84 by couplings (our choice, as the next two).
"""
MAX_LEFT_COUPLED = 0.7
"""The same of a coupling."""
MAX_LEFT_EXCHANGED = 0.6
"""The same of an exchange, a reversed position, and another zero.

29 sound recordings keep 0.80 and more; planted mistakes at three arms leave 0.41 and less.
"""
MAX_LEFT_RECORDED = 0.5
"""Largest share of their torques' variance that joints to exchange leave as recorded."""
MIN_EXCHANGED_SPEED = 0.3
"""Rms speed in units of the fastest joint's: one that hardly moves may have any column."""
MIN_TRAVEL = 1e-3
"""Range of positions from which on a joint moves [rad or m]."""
ZEROS = (0.5 * np.pi, np.pi, -0.5 * np.pi)
"""Angles by which a joint's zero may differ [rad]."""
FACTORS = np.geomspace(1e-3, 1e3, 25)
"""Factors of a joint's torques from which the best one is searched: units, gear ratios, gains (our choice)."""
MAX_FACTOR_STEP = float(np.log(FACTORS[1] / FACTORS[0]))
"""Range of the search around the best of them, as a logarithm."""
MAX_WORSE = 1.02
"""Unexplained share after a change by the described masses, over that before, by the common score: no worse."""
ROUNDING = 1e-8
"""Share of a column's size up to which what is left of it after a projection is rounding."""
CACHED = 4
"""Number of changed positions whose factorisations are kept: they are large."""


MAX_LEFT_ROBOT = 0.6
"""Share of the joints' residuals that another robot's geometry may leave.

The library's other robots leave 0.95 and more of 29 sound recordings (our choice).
"""


class Columns(NamedTuple):
    """Columns of a recording under a hypothesis.

    The fields are samples with the positions of the hypothesis, and the matrix (n, n) that multiplies their torques.
    """

    samples: MotionSamples
    mixing: np.ndarray


ColumnChange = Callable[[Columns], Columns]


def wrong_joints(samples: MotionSamples) -> Explanation | None:
    """Return the changes of columns that explain the torques much better; None if all columns are correct.

    For each tested change one model of all joints is fitted: bodies and offsets of any size, and non-negative motor
    inertia, viscous and Coulomb friction of every drive. The robot's masses need not be known. Residuals are shares of
    the joints' torque variances.

    Args:
        samples: samples of a recording of motor torques.
    """
    n = samples.q.shape[1]
    function_of = lru_cache(maxsize=CACHED)(_unexplained_function)

    def unexplained(columns: Columns) -> np.ndarray:
        return function_of(columns.samples)(columns.mixing)

    as_recorded = Columns(samples, np.eye(n))
    changes = [*_torque_changes(as_recorded, unexplained), *_position_changes(samples), *_robot_changes(samples)]
    return best_changes(as_recorded, changes, unexplained, max_changes=n)


def corrected(samples: MotionSamples, explanation: Explanation | None) -> MotionSamples:
    """Return samples with the changes of an explanation made; None: unchanged samples.

    Args:
        samples: samples of a recording.
        explanation: changes of its columns, from `wrong_joints`.
    """
    if explanation is None:
        return samples
    columns = Columns(samples, np.eye(samples.q.shape[1]))
    for change in explanation.changes:
        columns = change.make(columns)
    return _mixed(columns)


def with_torques(matrix: np.ndarray) -> ColumnChange:
    """Return the change that multiplies the torques of all joints by a matrix (n, n)."""
    return lambda columns: Columns(columns.samples, matrix @ columns.mixing)


def with_motion(change: Callable[[MotionSamples], MotionSamples]) -> ColumnChange:
    """Return the change of columns that makes a change of the motion alone."""
    return lambda columns: Columns(change(columns.samples), columns.mixing)


def with_positions(matrix: np.ndarray) -> ColumnChange:
    """Return the change that multiplies the positions of all joints by a matrix (n, n)."""
    return with_motion(partial(_changed, matrix=matrix))


def with_both(matrix: np.ndarray) -> ColumnChange:
    """Return the change that multiplies positions and torques of all joints by a matrix (n, n)."""
    return _in_turn(with_positions(matrix), with_torques(matrix))


def _in_turn(first: ColumnChange, second: ColumnChange) -> ColumnChange:
    return lambda columns: second(first(columns))


def with_zero(joint: int, angle: float) -> ColumnChange:
    """Return the change that adds an angle [rad] to the positions of a joint."""

    def turned(columns: Columns) -> Columns:
        q = np.array(columns.samples.q)
        q[:, joint] += angle
        return Columns(replace(columns.samples, q=q), columns.mixing)

    return turned


def _torque_changes(columns: Columns, unexplained: Callable[[Columns], np.ndarray]) -> list[Change[Columns]]:
    """Return the hypotheses on torques: reversed, exchanged, or multiplied by a factor.

    Args:
        columns: the columns as recorded.
        unexplained: function that maps columns to the unexplained shares (n,) of the joints' torque variances.
    """
    n = len(columns.mixing)
    changes = []
    for joint in range(n):
        reversed_sign = with_torques(reversal(n, joint))
        changes.append(Change("torque-sign", reversed_sign, (joint,), max_left=MAX_LEFT))
    for pair in combinations(range(n), 2):
        exchanged = with_torques(exchange(n, *pair))
        changes.append(Change("torques-exchanged", exchanged, pair, max_left=MAX_LEFT_EXCHANGED))
    for joint in range(n):
        factor = _best_factor(columns, unexplained, joint)
        scaled = with_torques(_scaling(n, joint, factor))
        changes.append(Change("torque-scaled", scaled, (joint,), {"times": 1.0 / factor}, MAX_LEFT))
    return changes


def _best_factor(columns: Columns, unexplained: Callable[[Columns], np.ndarray], joint: int) -> float:
    """Return the factor of a joint's torques with which all torques are explained best.

    Args:
        columns: the columns as recorded.
        unexplained: function that maps columns to the unexplained shares (n,) of the joints' torque variances.
        joint: index of the joint.
    """
    n = len(columns.mixing)

    def cost(logarithm: float) -> float:
        scaled = with_torques(_scaling(n, joint, float(np.exp(logarithm))))
        return float(np.log(unexplained(scaled(columns))).sum())

    start = min(np.log(FACTORS), key=cost)
    return float(np.exp(fminbound(cost, start - MAX_FACTOR_STEP, start + MAX_FACTOR_STEP)))


def _scaling(n: int, joint: int, factor: float) -> np.ndarray:
    """Return the matrix (n, n) that multiplies one of n columns by a factor."""
    scaling = np.eye(n)
    scaling[joint, joint] = factor
    return scaling


def _position_changes(samples: MotionSamples) -> list[Change[Columns]]:
    """Return the hypotheses on positions: coupled, reversed, exchanged alone or with the torques, or of another zero.

    Joints that do not move are omitted, since they may have any column.

    Args:
        samples: samples of a recording.
    """
    n = samples.q.shape[1]
    moving = np.flatnonzero(np.ptp(samples.q, axis=0) > MIN_TRAVEL).tolist()
    changes = []
    for joint, motor, direction in couplings(n):
        if joint in moving and motor in moving:
            coupled = with_positions(coupling(n, joint, motor, direction))
            values = {"way": "-" if direction < 0.0 else "+"}
            changes.append(Change("axis-coupled", coupled, (joint, motor), values, MAX_LEFT_COUPLED))
    for joint in moving:
        reversed_position = with_positions(reversal(n, joint))
        changes.append(Change("position-sign", reversed_position, (joint,), max_left=MAX_LEFT_EXCHANGED))
    for pair in combinations(moving, 2):
        matrix = exchange(n, *pair)
        # Both hypotheses share one motion, and so its factorisation.
        exchanged = with_motion(lru_cache(maxsize=1)(partial(_changed, matrix=matrix)))
        with_torques_too = _in_turn(exchanged, with_torques(matrix))
        changes.append(Change("positions-exchanged", exchanged, pair, max_left=MAX_LEFT_EXCHANGED))
        changes.append(Change("columns-exchanged", with_torques_too, pair, max_left=MAX_LEFT_EXCHANGED))
    bodies = samples.bodies
    turning = np.unique(bodies.coordinates[bodies.kinds == REVOLUTE])
    for joint, angle in product(np.intersect1d(moving, turning).tolist(), ZEROS):
        turned = with_zero(joint, angle)
        changes.append(Change("zero-elsewhere", turned, (joint,), {"angle": angle}, MAX_LEFT_EXCHANGED))
    return changes


def without_offsets(samples: MotionSamples) -> tuple[float, float]:
    """Return the unexplained rms shares of the torques without and with offsets, geometric means over the joints.

    Torques that were tared lack the gravity torque of one pose, which an offset makes up for.

    Args:
        samples: samples of a recording.
    """
    unchanged = np.eye(samples.q.shape[1])
    shares = [_unexplained_function(samples, offsets)(unchanged) for offsets in (False, True)]
    without, with_offsets = (float(np.exp(0.5 * np.mean(np.log(share)))) for share in shares)
    return without, with_offsets


def _unexplained_function(samples: MotionSamples, offsets: bool = True) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that maps a mixing matrix of the torques to unexplained shares of the joints' variances (n,).

    The matrix (n, n) multiplies the recorded torques: the identity, or one with signs reversed or rows exchanged.

    Args:
        samples: samples of a recording of n joints.
        offsets: whether each joint's torque has an offset.
    """
    m, n = samples.q.shape
    scale = 1.0 / np.maximum(samples.torque.std(axis=0), 1e-12)

    # A column is a row of the arrays, joint after joint: samples are contiguous, as the regressor writes them.
    # Bodies and offsets are free, the drives' other parameters not negative.
    columns = samples.inertial.transpose(2, 1, 0)[base_columns(samples.bodies)]
    weighted = columns * scale[:, None]
    free = weighted.reshape(-1, n * m)
    if offsets:
        free = np.concatenate([free, np.repeat(np.diag(scale), m, axis=1)])
    span = spanning(free @ free.T)

    def without_free(columns: np.ndarray) -> np.ndarray:
        return columns - columns @ free.T @ span @ span.T @ free

    positive = _drive_rows(samples, scale)
    size = np.linalg.norm(positive, axis=1)
    positive = without_free(positive)
    # what bodies and offsets explain wholly leaves rounding, which as a column would explain some noise
    is_independent = np.linalg.norm(positive, axis=1) > ROUNDING * size
    positive = positive[is_independent]
    # coordinates in an orthonormal basis of these columns
    square = positive @ positive.T
    orthonormal = spanning(square)
    coordinates = orthonormal.T @ square

    def unexplained(mixing: np.ndarray) -> np.ndarray:
        torque = (scale * (samples.torque @ mixing.T)).T.ravel()
        power = torque.reshape(n, m).var(axis=1)
        torque = without_free(torque)
        values = np.zeros(len(positive))
        # without a column, SciPy's solver ends the process
        if len(positive):
            values, _ = nnls(coordinates, orthonormal.T @ (positive @ torque))
        residual = torque - values @ positive
        mean_square = (residual.reshape(n, m) ** 2).mean(axis=1)
        return np.maximum(mean_square / np.maximum(power, 1e-300), 1e-9)

    return unexplained


def _drive_rows(samples: MotionSamples, scale: np.ndarray) -> np.ndarray:
    """Return the columns of the drives' parameters but offsets as rows (3 n, n m), joint after joint, each at most 1.

    Args:
        samples: m samples of a recording of n joints.
        scale: (n,) factors of the joints' torques.
    """
    m, n = samples.q.shape
    joints = np.arange(n)
    drives = drive_columns(samples.v, samples.a)[..., :3] * scale[:, None]
    rows = np.zeros((n, 3, n, m))
    # a drive acts on its joint's torque alone
    rows[joints, :, joints] = drives.transpose(1, 2, 0)
    rows = rows.reshape(3 * n, n * m)
    return rows / np.maximum(np.abs(rows).max(axis=1), 1e-12)[:, None]


def _robot_changes(samples: MotionSamples) -> list[Change[Columns]]:
    """Return the hypotheses that the recording is of another robot, each of the library's with the same joints.

    Args:
        samples: samples of a recording.
    """

    def with_bodies(bodies: Bodies) -> ColumnChange:
        return lambda columns: Columns(replace(columns.samples, bodies=bodies), columns.mixing)

    kinds = tuple(samples.bodies.kinds[samples.bodies.coordinates >= 0].tolist())
    changes = []
    for name, bodies in _library_bodies().items():
        if tuple(bodies.kinds.tolist()) == kinds:
            change = with_bodies(bodies.with_gravity(samples.bodies.gravity))
            changes.append(Change("another-robot", change, values={"robot": name}, max_left=MAX_LEFT_ROBOT))
    return changes


@cache
def _library_bodies() -> dict[str, Bodies]:
    """Return the bodies of the library's robots by name."""
    return {name: bodies_of(load(name)) for name in names()}


def rearranged(samples: MotionSamples, chain: Chain) -> Explanation | None:
    """Return the exchange of two joints, or zero offset of a joint, that best explains the torques; None if none does.

    The torques are predicted from the robot's masses. Residuals are shares of the variance of each joint's torque. A
    change after which bodies of any masses explain the torques worse is no explanation.

    Args:
        samples: samples of a recording of motor torques.
        chain: the arm with its masses.
    """
    masses = standard_parameters(chain)
    samples = replace(samples, index=np.arange(len(samples.index)), effort=samples.torque)
    speed = samples.v.std(axis=0)
    moves = speed > MIN_EXCHANGED_SPEED * speed.max()
    unexplained = _unexplained_by_masses(samples, masses) < MAX_LEFT_RECORDED
    changes = []
    for pair in combinations(np.flatnonzero(moves & unexplained).tolist(), 2):
        exchanged = with_both(exchange(chain.n, *pair))
        changes.append(Change("columns-exchanged", exchanged, pair))
    for number, joint in enumerate(chain.joints):
        if joint.kind == "prismatic":
            continue
        for angle in ZEROS:
            turned = with_zero(number, angle)
            changes.append(Change("zero-elsewhere", turned, (number,), {"angle": angle}))
    as_recorded = Columns(samples, np.eye(chain.n))
    explanation = best_changes(as_recorded, changes, lambda columns: _unexplained_by_masses(_mixed(columns), masses))
    if explanation is None:
        return None
    with_change = corrected(samples, explanation)
    after = _common_score(with_change)
    return explanation if after < MAX_WORSE * _common_score(samples) else None


def _mixed(columns: Columns) -> MotionSamples:
    """Return the samples of `columns` with their torques multiplied by the matrix of the hypothesis."""
    samples = columns.samples
    return replace(samples, effort=samples.effort @ columns.mixing.T)


def _common_score(samples: MotionSamples) -> float:
    """Return the unexplained rms share of the torques, geometric mean over the joints, for bodies of any masses."""
    shares = _unexplained_function(samples)(np.eye(samples.q.shape[1]))
    return float(np.exp(0.5 * np.mean(np.log(shares))))


def _changed(samples: MotionSamples, matrix: np.ndarray) -> MotionSamples:
    """Return the samples with joint positions, velocities and accelerations multiplied by a matrix (n, n).

    Args:
        samples: samples of a recording of n joints.
        matrix: matrix that multiplies the joint values of each sample.
    """
    q = np.ascontiguousarray(samples.q @ matrix.T)
    v = np.ascontiguousarray(samples.v @ matrix.T)
    a = np.ascontiguousarray(samples.a @ matrix.T)
    return replace(samples, q=q, v=v, a=a)


def _unexplained_by_masses(samples: MotionSamples, masses: np.ndarray) -> np.ndarray:
    """Return the share (n,) of each joint's torque variance that the robot's masses do not explain.

    Each torque is modelled by four parts: a factor times the gravity torque of the robot's masses, a factor times their
    torque of motion, the drive of the joint, and the drives of the neighbouring joints. The last part is needed because
    wrists are coupled by their gears, which could be mistaken for an exchange of joints.

    Args:
        samples: samples of a recording.
        masses: (10 B,) standard parameters of the robot.
    """
    q = samples.q
    v = samples.v
    a = samples.a
    of_gravity = inverse_dynamics(samples.bodies, masses, q, np.zeros_like(v), np.zeros_like(a))
    of_motion = inverse_dynamics(samples.bodies, masses, q, v, a) - of_gravity
    drives = drive_columns(v, a)
    centred = samples.torque - samples.torque.mean(axis=0)
    shares = []
    for joint, torque in enumerate(centred.T):
        near = drives[:, max(joint - 1, 0) : joint + 2]
        neighbours = near.reshape(len(torque), -1)
        joint_columns = np.column_stack([of_gravity[:, joint], of_motion[:, joint], neighbours])
        orthonormal = basis(joint_columns)
        explained = ((torque @ orthonormal) ** 2).sum()
        shares.append(1.0 - explained / max(float(torque @ torque), 1e-300))
    return np.maximum(shares, 1e-9)

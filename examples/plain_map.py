"""A plain fit of a rigid arm, as a reference: Pinocchio and SciPy alone, nothing shared with the toolkit.

Station, joint origins and targets are links of a chain, each displaced by a twist ξ = (translation, rotation vector):

    T(q) = S exp(ξ_S) · Π_k [O_k exp(ξ_k) · M_k(q_k)] · tail · X exp(ξ_X)

with O_k the nominal joint origins of the URDF, M_k the joints' motions, S and X guesses of station and target. Measured
positions (and orientations) and a Gaussian prior on every ξ_k are minimised together: the maximum a posteriori. No
parameter is selected, none is dropped. The noise's σ comes from the residuals, by the effective number of parameters.

Derivative of a point y by a twist δ = (v, w) behind frame F = (R, p): R v + (R w) × (y - p); δ = J_r(ξ) dξ.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from planted_arms import Arm, pinocchio_model, set_joint
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

POSITION_PRIOR = 5e-3  # of making: σ of a joint origin along each axis [m]; 3 to 10 mm give the same
ANGLE_PRIOR = 10e-3  # of making: σ of a joint origin about each axis [rad]; 3 to 50 mrad give the same
FRAME_PRIOR = (10.0, 3.0)  # of station and target about their guess [m, rad]: practically none
LEVER = 0.3  # length by which angles count beside lengths in the first guess [m/rad]
RANDOM_STARTS = 12  # rotations of the station that are tried beside the closed form
GUESS_ROWS = 150  # rows of the first guess
ROUNDS = 5  # of σ (and weights) and fit
CAUCHY = 2.385  # residual over σ at which a robust row counts half (95 % efficient for Gaussian noise)


@dataclass(frozen=True)
class Targets:
    """Measured targets of m postures.

    Attributes:
        positions: (m, t, 3) [m] of t targets in the instrument's frame.
        orientations: (m, 3, 3) of a single target; None where positions alone were measured.
    """

    positions: np.ndarray
    orientations: np.ndarray | None = None

    def take(self, rows: np.ndarray) -> "Targets":
        """Return some of the postures."""
        if self.orientations is None:
            return Targets(self.positions[rows])
        return Targets(self.positions[rows], self.orientations[rows])


@dataclass(frozen=True)
class Chain:
    """A nominal arm as Pinocchio reads it: origins (n, 4, 4) and ends, and the motion of its joints."""

    origins: np.ndarray
    head: np.ndarray
    tail: np.ndarray
    motions: Callable[[np.ndarray], np.ndarray]

    @classmethod
    def of(cls, arm: Arm) -> "Chain":
        """Read an arm whose base stands still in its URDF."""
        model = pinocchio_model(arm)
        base = model.frames[model.getFrameId(arm.base, pin.FrameType.BODY)]
        tip = model.frames[model.getFrameId(arm.tip, pin.FrameType.BODY)]
        if base.parentJoint != 0:
            raise ValueError(f"{arm.base} moves: give a base link above all joints")
        joints = [model.getJointId(name) for name in arm.names]

        def motions(q: np.ndarray) -> np.ndarray:
            """Return the motions (n, m, 4, 4) of the joints at joint values (m, n) [rad or m]."""
            result = np.empty((len(joints), len(q), 4, 4))
            for k, index in enumerate(joints):
                joint = model.joints[index]
                data = joint.createData()
                for row, value in enumerate(q[:, k]):
                    configuration = pin.neutral(model)
                    set_joint(configuration, joint, value)
                    joint.calc(data, configuration)
                    result[k, row] = data.M.homogeneous
            return result

        origins = np.array([model.jointPlacements[index].homogeneous for index in joints])
        return cls(origins, base.placement.inverse().homogeneous, tip.placement.homogeneous, motions)


@dataclass(frozen=True)
class Cell:
    """An arm between a station (4, 4) and targets (t, 4, 4), each displaced by its twist (6,).

    `twists` (1 + n + t, 6) are those of station, joint origins and targets [m, rad].
    """

    chain: Chain
    station: np.ndarray
    targets: np.ndarray
    twists: np.ndarray

    @property
    def joints(self) -> int:
        return len(self.chain.origins)

    def frames(self, motions: np.ndarray) -> np.ndarray:
        """Return the frames (1 + n + t, m, 4, 4) behind the twists, the last t those of the targets.

        `motions` (n, m, 4, 4) are those of the joints.
        """
        displaced = np.array([pin.exp6(twist).homogeneous for twist in self.twists])
        frame = np.broadcast_to(self.station @ displaced[0], (motions.shape[1], 4, 4))
        frames = [frame]
        frame = frame @ self.chain.head
        for k in range(self.joints):
            frame = frame @ self.chain.origins[k] @ displaced[1 + k]
            frames.append(frame)
            frame = frame @ motions[k]
        frame = frame @ self.chain.tail
        for target, displacement in zip(self.targets, displaced[1 + self.joints :], strict=True):
            frames.append(frame @ target @ displacement)
        return np.array(frames)

    def positions(self, q: np.ndarray) -> np.ndarray:
        """Return the targets' positions (m, t, 3) [m] in the instrument's frame."""
        frames = self.frames(self.chain.motions(q))
        return np.swapaxes(frames[1 + self.joints :, :, :3, 3], 0, 1)


@dataclass(frozen=True)
class Problem:
    """Residuals and Jacobian of a cell over a choice of its twists, with σ of position [m] and orientation [rad]."""

    cell: Cell
    motions: np.ndarray
    measured: Targets
    free: np.ndarray  # which twists
    prior: np.ndarray  # σ (free, 6)
    sigma: tuple[float, float] = (1.0, 1.0)
    weights: np.ndarray | None = None  # (m,), for robust fits

    def at(self, values: np.ndarray) -> Cell:
        """Return the cell with the free twists at values (free * 6,)."""
        twists = self.cell.twists.copy()
        twists[self.free] = values.reshape(-1, 6)
        return replace(self.cell, twists=twists)

    def errors(self, cell: Cell) -> tuple[np.ndarray, np.ndarray]:
        """Return errors of position (m, t, 3) [m] and orientation (m, 3) [rad]; (m, 0) without orientations."""
        frames = cell.frames(self.motions)[1 + cell.joints :]
        shifts = np.swapaxes(frames[:, :, :3, 3], 0, 1) - self.measured.positions
        if self.measured.orientations is None:
            return shifts, np.zeros((len(shifts), 0))
        turns = np.swapaxes(self.measured.orientations, 1, 2) @ frames[0, :, :3, :3]
        return shifts, Rotation.from_matrix(turns).as_rotvec()

    def row_weights(self) -> np.ndarray:
        """Return what errors of a row are multiplied by, (m, 1)."""
        if self.weights is None:
            return np.ones((len(self.measured.positions), 1))
        return np.sqrt(self.weights)[:, None]

    def residuals(self, values: np.ndarray) -> np.ndarray:
        """Return weighted errors over σ, of positions, orientations and prior."""
        shifts, turns = self.errors(self.at(values))
        flat = shifts.reshape(len(shifts), -1)
        weight = self.row_weights()
        by_position = flat * weight / self.sigma[0]
        by_turn = turns * weight / self.sigma[1]
        by_prior = values / self.prior.ravel()
        return np.concatenate([by_position.ravel(), by_turn.ravel(), by_prior])

    def jacobian(self, values: np.ndarray) -> np.ndarray:
        """Return the derivatives of the residuals by the free twists."""
        cell = self.at(values)
        frames = cell.frames(self.motions)
        ends = frames[1 + cell.joints :]
        count = len(self.measured.positions)
        by_position = np.zeros((count, len(ends), 3, len(self.free), 6))
        by_turn = np.zeros((count, 3, len(self.free), 6))
        for column, link in enumerate(self.free):
            twisting = pin.Jexp6(cell.twists[link])
            for number, end in enumerate(ends):
                another_targets_twist = link > cell.joints and link != 1 + cell.joints + number
                if not another_targets_twist:
                    by_position[:, number, :, column] = point_derivative(frames[link], end[:, :3, 3]) @ twisting
            rotation = frames[link, :, :3, :3]
            turned = np.swapaxes(ends[0, :, :3, :3], 1, 2) @ rotation
            by_turn[:, :, column] = np.concatenate([np.zeros_like(turned), turned], axis=2) @ twisting
        weight = self.row_weights()[:, :, None]
        width = 6 * len(self.free)
        parts = [by_position.reshape(count, -1, width) * weight / self.sigma[0]]
        if self.measured.orientations is not None:
            parts.append(by_turn.reshape(count, 3, width) * weight / self.sigma[1])
        parts.append(np.diag(1.0 / self.prior.ravel()))
        return np.concatenate([part.reshape(-1, width) for part in parts])

    def solve(self) -> tuple[Cell, OptimizeResult]:
        """Return the cell at the minimum, started from its twists."""
        start = self.cell.twists[self.free].ravel()
        result = least_squares(self.residuals, start, self.jacobian, x_scale=self.prior.ravel())
        return self.at(result.x), result


def point_derivative(frame: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the derivative (m, 3, 6) of points (m, 3) [m] by a twist behind frames (m, 4, 4)."""
    rotation = frame[:, :3, :3]
    lever = point - frame[:, :3, 3]
    across = np.cross(np.swapaxes(rotation, 1, 2), lever[:, None])  # rows: (R e_i) x lever
    return np.concatenate([rotation, np.swapaxes(across, 1, 2)], axis=2)


def frame_prior(free: np.ndarray) -> np.ndarray:
    """Return the σ (free, 6) of twists that are practically free [m, rad]."""
    return np.tile(np.repeat(FRAME_PRIOR, 3), (len(free), 1))


def placed(chain: Chain, q: np.ndarray, measured: Targets, seed: int = 0) -> Cell:
    """Return the nominal arm with station and targets fitted: a closed form and random rotations, the best of them."""
    rng = np.random.default_rng(seed)
    rows = rng.permutation(len(q))[:GUESS_ROWS]
    motions = chain.motions(q[rows])
    sample = measured.take(rows)
    joints = len(chain.origins)
    targets = sample.positions.shape[1]
    twists = np.zeros((1 + joints + targets, 6))
    nominal = Cell(chain, np.eye(4), np.tile(np.eye(4), (targets, 1, 1)), twists)
    tips = nominal.frames(motions)[1 + joints]
    free = np.r_[0, np.arange(1 + joints, 1 + joints + targets)]

    best = nominal
    lowest_cost = np.inf
    rotations = [closed_form(tips, sample.positions[:, 0]), *Rotation.random(RANDOM_STARTS, rng).as_matrix()]
    for rotation in rotations:
        start = guess(nominal, rotation, tips, sample)
        cell, result = Problem(start, motions, sample, free, frame_prior(free), (1.0, 1.0 / LEVER)).solve()
        if result.cost < lowest_cost:
            best = cell
            lowest_cost = result.cost
    return with_frames(best, q, measured)


def guess(nominal: Cell, rotation: np.ndarray, tips: np.ndarray, measured: Targets) -> Cell:
    """Return a cell with station and targets guessed from a rotation (3, 3) of the station.

    Args:
        nominal: the cell with both at the identity.
        rotation: of the station.
        tips: (m, 4, 4) poses of the tip in the base frame.
        measured: of the same postures.
    """
    station = np.eye(4)
    station[:3, :3] = rotation
    station[:3, 3] = measured.positions[:, 0].mean(axis=0) - rotation @ tips[:, :3, 3].mean(axis=0)
    targets = nominal.targets.copy()
    if measured.orientations is not None:
        turned = np.swapaxes(rotation @ tips[:, :3, :3], 1, 2) @ measured.orientations
        targets[0, :3, :3] = Rotation.from_matrix(turned).mean().as_matrix()
    return replace(nominal, station=station, targets=targets)


def closed_form(tips: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the station's rotation (3, 3) from A y_i + b - R_i t = a_i, linear in A = Sᵀ, b and the target t."""
    matrix = np.zeros((len(tips), 3, 15))
    for axis in range(3):
        matrix[:, axis, 3 * axis : 3 * axis + 3] = points
        matrix[:, axis, 9 + axis] = 1.0
    matrix[:, :, 12:] = -tips[:, :3, :3]
    solution = np.linalg.lstsq(matrix.reshape(-1, 15), tips[:, :3, 3].ravel(), rcond=None)[0]
    # the nearest rotation
    u, _, vt = np.linalg.svd(solution[:9].reshape(3, 3))
    return (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T


def with_frames(cell: Cell, q: np.ndarray, measured: Targets) -> Cell:
    """Return a cell whose station and targets are fitted anew, its joint origins as they are."""
    links = np.arange(len(cell.twists))
    free = links[(links == 0) | (links > cell.joints)]
    problem = Problem(cell, cell.chain.motions(q), measured, free, frame_prior(free), (1.0, 1.0 / LEVER))
    return problem.solve()[0]


def fit(
    cell: Cell,
    q: np.ndarray,
    measured: Targets,
    position_prior: float = POSITION_PRIOR,
    angle_prior: float = ANGLE_PRIOR,
    robust: bool = False,
) -> Cell:
    """Return the cell at the maximum a posteriori, σ of the noise estimated.

    Args:
        cell: as `placed` returns it.
        q: (m, n) joint values [rad or m].
        measured: of the same postures.
        position_prior, angle_prior: σ of each joint origin [m, rad].
        robust: rows are weighted by Cauchy's function of their largest error.
    """
    free = np.arange(len(cell.twists))
    prior = frame_prior(free)
    prior[1 : 1 + cell.joints] = np.repeat((position_prior, angle_prior), 3)
    problem = Problem(cell, cell.chain.motions(q), measured, free, prior)
    shifts, turns = problem.errors(cell)
    sigma = (rms(shifts), rms(turns) if turns.size else 1.0)
    for _ in range(ROUNDS):
        problem = replace(problem, sigma=sigma)
        fitted, result = problem.solve()
        problem = replace(problem, cell=fitted)
        shifts, turns = problem.errors(fitted)
        weight = problem.row_weights()
        freedom = np.sqrt((weight**2).mean() * residual_freedom(result, priors=free.size * 6))
        sigma_position = rms(shifts.reshape(len(q), -1) * weight) / freedom
        sigma_turn = rms(turns * weight) / freedom if turns.size else 1.0
        sigma = (sigma_position, sigma_turn)
        if robust:
            largest = np.abs(shifts).max(axis=(1, 2)) / sigma_position
            problem = replace(problem, weights=1.0 / (1.0 + (largest / CAUCHY) ** 2))
    return problem.cell


def residual_freedom(result: OptimizeResult, priors: int) -> float:
    """Return the share of the measured residuals' degrees of freedom that parameters leave, at least 0.2.

    Args:
        result: of the fit.
        priors: number of the prior's rows, which are the last.
    """
    measured = len(result.fun) - priors
    jacobian = result.jac
    resolution = np.linalg.solve(jacobian.T @ jacobian, jacobian[:measured].T @ jacobian[:measured])
    return max(1.0 - np.trace(resolution) / measured, 0.2)


def rms(values: np.ndarray) -> float:
    """Return the root mean square of all entries."""
    return float(np.sqrt(np.mean(values**2)))

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
from planted_arms import Arm, pinocchio_model
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
        orientations = None if self.orientations is None else self.orientations[rows]
        return Targets(self.positions[rows], orientations)


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
                    entry = [np.cos(value), np.sin(value)] if joint.nq == 2 else [value]
                    configuration[joint.idx_q : joint.idx_q + joint.nq] = entry
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

    def scale(self) -> np.ndarray:
        """Return what errors of a row are multiplied by, (m, 1)."""
        count = len(self.measured.positions)
        return np.ones((count, 1)) if self.weights is None else np.sqrt(self.weights)[:, None]

    def residuals(self, values: np.ndarray) -> np.ndarray:
        shifts, turns = self.errors(self.at(values))
        flat = shifts.reshape(len(shifts), -1)
        seen = [flat * self.scale() / self.sigma[0], turns * self.scale() / self.sigma[1]]
        return np.concatenate([part.ravel() for part in seen] + [values / self.prior.ravel()])

    def jacobian(self, values: np.ndarray) -> np.ndarray:
        cell = self.at(values)
        frames = cell.frames(self.motions)
        ends = frames[1 + cell.joints :]
        count, targets = len(self.measured.positions), len(ends)
        by_position = np.zeros((count, targets, 3, len(self.free), 6))
        by_turn = np.zeros((count, 3, len(self.free), 6))
        for column, link in enumerate(self.free):
            rotation, point = frames[link, :, :3, :3], frames[link, :, :3, 3]
            twisting = pin.Jexp6(cell.twists[link])
            for number, end in enumerate(ends):
                if link > cell.joints and link != 1 + cell.joints + number:
                    continue  # another target's twist
                lever = end[:, :3, 3] - point
                across = np.cross(np.swapaxes(rotation, 1, 2), lever[:, None])  # rows: (R e_i) x lever
                body = np.concatenate([rotation, np.swapaxes(across, 1, 2)], axis=2)
                by_position[:, number, :, column] = body @ twisting
            turned = np.swapaxes(ends[0, :, :3, :3], 1, 2) @ rotation
            by_turn[:, :, column] = np.concatenate([np.zeros_like(turned), turned], axis=2) @ twisting
        scale = self.scale()[:, :, None]
        width = 6 * len(self.free)
        parts = [(by_position.reshape(count, -1, width) * scale / self.sigma[0]).reshape(-1, width)]
        if self.measured.orientations is not None:
            parts.append((by_turn.reshape(count, 3, width) * scale / self.sigma[1]).reshape(-1, width))
        parts.append(np.diag(1.0 / self.prior.ravel()))
        return np.concatenate(parts)

    def solve(self) -> tuple[Cell, OptimizeResult]:
        """Return the cell at the minimum, started from its twists."""
        start = self.cell.twists[self.free].ravel()
        found = least_squares(self.residuals, start, self.jacobian, x_scale=self.prior.ravel())
        return self.at(found.x), found


def placed(chain: Chain, q: np.ndarray, measured: Targets, seed: int = 0) -> Cell:
    """Return the nominal arm with station and targets fitted: a closed form and random rotations, the best of them."""
    rng = np.random.default_rng(seed)
    rows = rng.permutation(len(q))[:GUESS_ROWS]
    motions = chain.motions(q[rows])
    few = measured.take(rows)
    count, targets = len(chain.origins), few.positions.shape[1]
    bare = Cell(chain, np.eye(4), np.tile(np.eye(4), (targets, 1, 1)), np.zeros((1 + count + targets, 6)))
    tips = bare.frames(motions)[1 + count]
    frames_free = np.r_[0, np.arange(1 + count, 1 + count + targets)]
    prior = np.tile(np.repeat(FRAME_PRIOR, 3), (len(frames_free), 1))

    best, lowest = bare, np.inf
    for rotation in (closed_form(tips, few.positions[:, 0]), *Rotation.random(RANDOM_STARTS, rng).as_matrix()):
        station = np.eye(4)
        station[:3, :3] = rotation
        station[:3, 3] = few.positions[:, 0].mean(axis=0) - rotation @ tips[:, :3, 3].mean(axis=0)
        ends = np.tile(np.eye(4), (targets, 1, 1))
        if few.orientations is not None:
            turned = np.swapaxes(rotation @ tips[:, :3, :3], 1, 2) @ few.orientations
            ends[0, :3, :3] = Rotation.from_matrix(turned).mean().as_matrix()
        start = replace(bare, station=station, targets=ends)
        cell, result = Problem(start, motions, few, frames_free, prior, (1.0, 1.0 / LEVER)).solve()
        if result.cost < lowest:
            best, lowest = cell, result.cost
    return with_frames(best, q, measured)


def closed_form(tips: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the station's rotation (3, 3) from A y_i + b - R_i t = a_i, linear in A = Sᵀ, b and the target t."""
    count = len(tips)
    left = np.zeros((count, 3, 15))
    for axis in range(3):
        left[:, axis, 3 * axis : 3 * axis + 3] = points
        left[:, axis, 9 + axis] = 1.0
    left[:, :, 12:] = -tips[:, :3, :3]
    solution = np.linalg.lstsq(left.reshape(-1, 15), tips[:, :3, 3].ravel(), rcond=None)[0]
    u, _, vt = np.linalg.svd(solution[:9].reshape(3, 3))
    return (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T


def with_frames(cell: Cell, q: np.ndarray, measured: Targets) -> Cell:
    """Return a cell whose station and targets are fitted anew, its joint origins as they are."""
    links = np.arange(len(cell.twists))
    free = links[(links == 0) | (links > cell.joints)]
    prior = np.tile(np.repeat(FRAME_PRIOR, 3), (len(free), 1))
    return Problem(cell, cell.chain.motions(q), measured, free, prior, (1.0, 1.0 / LEVER)).solve()[0]


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
    prior = np.tile(np.repeat(FRAME_PRIOR, 3), (len(free), 1))
    prior[1 : 1 + cell.joints] = np.repeat((position_prior, angle_prior), 3)
    problem = Problem(cell, cell.chain.motions(q), measured, free, prior)
    shifts, turns = problem.errors(cell)
    sigma = (rms(shifts), rms(turns) if turns.size else 1.0)
    for _ in range(ROUNDS):
        problem = replace(problem, sigma=sigma)
        problem_cell, result = problem.solve()
        problem = replace(problem, cell=problem_cell)
        seen = len(result.fun) - free.size * 6
        jacobian = result.jac
        informed = np.linalg.solve(jacobian.T @ jacobian, jacobian[:seen].T @ jacobian[:seen])
        share = max(1.0 - np.trace(informed) / seen, 0.2)  # of the residuals' degrees of freedom
        shifts, turns = problem.errors(problem.cell)
        scale = problem.scale()
        counted = np.sqrt((scale**2).mean() * share)
        sigma = (rms(shifts.reshape(len(q), -1) * scale) / counted, rms(turns * scale) / counted if turns.size else 1.0)
        if robust:
            largest = np.abs(shifts).max(axis=(1, 2)) / sigma[0]
            problem = replace(problem, weights=1.0 / (1.0 + (largest / CAUCHY) ** 2))
    return problem.cell


def rms(values: np.ndarray) -> float:
    """Return the root mean square of all entries."""
    return float(np.sqrt(np.mean(values**2)))

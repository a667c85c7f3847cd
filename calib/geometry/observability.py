"""Observation Jacobians of candidate poses: the callables used by pose selection (package `poses`).

Both pickle, so that selection can run on several processes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.data.poses.measurements import Poses, Positions
from calib.errors import Unidentifiable, UsageError, one_of, require
from calib.geometry.identifiability import base_columns
from calib.geometry.installation import Installation, see
from calib.geometry.observation import prepare, target_jacobian
from calib.geometry.parameters import layout
from calib.robot.chain import Chain, random_joints
from calib.robot.kinematics import element_jacobian, joint_jacobian, twist_product
from calib.transforms import pose, to_quaternion

KINDS = (Poses.kind, Positions.kind)
SAMPLES = 300  # random postures that decide what is identifiable
SIGMA_POSITION, SIGMA_ORIENTATION = 1e-4, 1e-4  # [m], [rad]: our choice where none is stated


@dataclass(frozen=True, eq=False)
class Observation:
    """Whitened observation Jacobian in base columns: q (m, n) -> (m, rows, p).

    Attributes:
        cell: the nominal arm, its base at the instrument's origin, with its targets; rigid.
        full: whether orientations are measured, too: six rows per target instead of three.
        free: (p,) indices of the identifiable parameters in the full vector.
        sigmas: of a position [m] and of an orientation [rad].
    """

    cell: Installation
    full: bool
    free: np.ndarray
    sigmas: tuple[float, float] = (SIGMA_POSITION, SIGMA_ORIENTATION)

    def __call__(self, q: np.ndarray) -> np.ndarray:
        rows = []
        for number in range(len(self.cell.tools)):
            seen = see(self.cell, q, 0, number)
            jacobian = target_jacobian(self.cell, seen, self.free, 0, np.full(len(q), number))
            rows.append(jacobian[:, :3] / self.sigmas[0])
            if self.full:
                rows.append(jacobian[:, 3:] / self.sigmas[1])
        return np.concatenate(rows, axis=1).transpose(2, 1, 0)

    def position(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the position of the first target (m, 3) [m] and its unwhitened Jacobian (m, 3, p)."""
        return see(self.cell, q).point.T, self(q)[:, :3] * self.sigmas[0]

    def product(self, q: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Return Σ G[i] · ∂J[i]/∂q (m, n) for weights G (m, rows, p) of the whitened Jacobian; exact."""
        chain, count = self.cell.chain, len(self.cell.chain.elements)
        places = np.where(self.free < count, self.free, np.where(self._in_station, -1, count))
        weights, result = G.transpose(2, 1, 0), np.zeros((chain.n, len(q)))
        rows = 6 if self.full else 3
        for number in range(len(self.cell.tools)):
            seen = see(self.cell, q, 0, number)
            columns = target_jacobian(self.cell, seen, self.free, 0, np.full(len(q), number))
            weight = np.zeros(columns.shape)
            for first, sigma in zip(range(0, rows, 3), self.sigmas):
                at = rows * number + first
                weight[:, first : first + 3] = weights[:, at : at + 3] / sigma
            elements = element_jacobian(chain, seen.walked, seen.point)
            result += twist_product(chain, elements, columns, places, weight)
        return result.T

    @property
    def _in_station(self) -> np.ndarray:
        """Mask (p,) of the parameters that place the instrument."""
        return np.isin(self.free, layout(self.cell).station_index)


@dataclass(frozen=True, eq=False)
class Target:
    """Pose of a target in the arm's base: q (m, n) -> rotation (m, 3, 3), position (m, 3) [m]."""

    cell: Installation
    number: int = 0

    def __call__(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        poses = see(self.cell, q, 0, self.number).poses()
        return poses[:, :3, :3], poses[:, :3, 3]


@dataclass(frozen=True, eq=False)
class TargetJacobian:
    """Velocity and angular velocity of a target per joint velocity: q (m, n) -> (m, 6, n)."""

    cell: Installation
    number: int = 0

    def __call__(self, q: np.ndarray) -> np.ndarray:
        seen = see(self.cell, q, 0, self.number)
        return joint_jacobian(self.cell.chain, seen.walked, seen.point)


def targets_of(chain: Chain, tools: Sequence[Sequence[float]] = ()) -> Installation:
    """Return the arm with targets at places (3,) [m] in the tip's frame; one at the tip if none are given."""
    places = [np.asarray(tool, dtype=float) for tool in tools] or [np.zeros(3)]
    names = tuple(f"tool {k + 1}" for k in range(len(places))) if len(places) > 1 else ("tool",)
    return Installation(chain, tools=np.array([pose(None, place) for place in places]), tool_names=names)


def observation(
    cell: Installation, kind: str = "pose", sigmas: tuple[float, float] | None = None, seed: int = 0
) -> Observation:
    """Return the observation Jacobian of a nominal arm in the columns that random postures can identify.

    Args:
        cell: see `targets_of`.
        kind: ``pose`` or ``position``.
        sigmas: of a position [m] and an orientation [rad].
        seed: of the postures.
    """
    one_of(kind, KINDS, "kind", UsageError)
    full = kind == Poses.kind
    q = random_joints(cell.chain, SAMPLES, seed)
    blocks = prepare(cell, [_measured(q, cell, number, full) for number in range(len(cell.tools))])
    columns = np.arange(len(layout(cell).names))
    if not full:  # a point has no orientation of its own
        turns = [k for k in layout(cell).tool_index if layout(cell).units[k] == "rad"]
        columns = np.setdiff1d(columns, turns)
    split = base_columns(cell, blocks, columns)
    require(split.rank, f"robot '{cell.chain.name}': no parameter affects the measured quantities", Unidentifiable)
    return Observation(cell, full, columns[split.kept], sigmas or (SIGMA_POSITION, SIGMA_ORIENTATION))


def _measured(q: np.ndarray, cell: Installation, number: int, full: bool) -> Positions:
    """Return the noise-free measurements of one target."""
    poses = see(cell, q, 0, np.full(len(q), number)).poses()
    common: dict[str, Any] = {"tool_names": (cell.tool_names[number],), "station": cell.station_names[0]}
    if full:
        return Poses(q, cell.chain.joint_names, poses[:, :3, 3], to_quaternion(poses), **common)
    return Positions(q, cell.chain.joint_names, poses[:, :3, 3], **common)

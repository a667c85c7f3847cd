"""Drift of an instrument or a base between two measurements of the same poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.robot.chain import Chain
from calib.robot.kinematics import forward


@dataclass(frozen=True)
class Drift:
    """Differences between two measurements of the same poses.

    Attributes:
        poses: pairs of measurements.
        rms: of the measured points' distances, less what differing joints explain [m].
    """

    poses: int
    rms: float

    def exceeds(self, sigma: float) -> bool:
        """Say whether the differences are above `min_drift_sigmas` standard errors of noise of `sigma` per axis [m]."""
        min_drift_sigmas = 3.0  # standard errors that repeated poses have to be off to be called drift
        return self.rms > (min_drift_sigmas / np.sqrt(self.poses) + 1.0) * noise_of_difference(sigma)


def noise_of_difference(sigma: float) -> float:
    """Return the rms distance [m] of two points, each measured with `sigma` per axis [m]."""
    return float(np.sqrt(6.0) * sigma)


def drift_between(chain: Chain, first: Sequence[PoseMeasurements], later: PoseMeasurements) -> Drift | None:
    """Compare measurements with later ones of the same joints and tool; None where no pose was measured in both.

    What the joints differ by is taken off as the nominal arm says, at its size: the instrument's frame is not known.

    Args:
        chain: the nominal arm.
        first, later: measured poses or positions; other kinds are left out.
    """
    return _compared(chain, _points(first), _points([later]), own=False)


def drift_within(chain: Chain, measured: PoseMeasurements) -> Drift | None:
    """Compare the poses of one series that were measured more than once, as `drift_between`; None where none was."""
    points = _points([measured])
    return _compared(chain, points, points, own=True)


def _points(blocks: Sequence[PoseMeasurements]) -> list[tuple[Positions, int]]:
    return [(block, k) for block in blocks if isinstance(block, Positions) for k in range(len(block))]


def _compared(
    chain: Chain, first: Sequence[tuple[Positions, int]], later: Sequence[tuple[Positions, int]], own: bool
) -> Drift | None:
    if not first or not later:
        return None
    q, squares = np.array([block.q[k] for block, k in first]), []
    max_apart = 1e-3  # joints of a pose that is visited again differ by less [rad or m]; our choice
    for place, (block, k) in enumerate(later):
        near = [int(i) for i in np.flatnonzero(np.abs(q - block.q[k]).max(axis=1) < max_apart)]
        near = [i for i in near if not own or i < place]
        near = [i for i in near if first[i][0].tool[first[i][1]] == block.tool[k]]
        if not near:
            continue
        other, row = first[near[0]]
        before, after = forward(chain, np.array([other.q[row], block.q[k]]))[:, :3, 3]
        shift, joints = block.position[k] - other.position[row], after - before
        squares.append(max(float(shift @ shift) - float(joints @ joints), 0.0))
    return Drift(len(squares), float(np.sqrt(np.mean(squares)))) if squares else None

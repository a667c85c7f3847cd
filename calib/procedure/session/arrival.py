"""What measured poses say of themselves on arrival: joints read back or only commanded, drift between two visits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.data.poses.plans import NEAR
from calib.robot.chain import Chain
from calib.robot.kinematics import forward

SAME = 1e-3  # joints of a pose that is visited again differ by less [rad or m] (this and the next: our choice)
MANY = 3.0  # sigmas that a repeated pose has to be off to be called drift
EXACT = 1e-8  # read-back joints that equal the commanded ones to so much were not read back [rad or m]


def readback(plan: np.ndarray, measured: PoseMeasurements) -> list[str]:
    """Say how far the joints read back are from those commanded (m, n) [rad or m]."""
    distance, index = (np.atleast_1d(found) for found in KDTree(plan).query(measured.q, p=np.inf))
    close = distance <= NEAR
    if not close.any():
        return []
    off = np.abs(measured.q[close] - plan[index[close]])
    if off.max() < EXACT:
        return ["the joint values are the commanded ones to the last digit; log what the encoders read once it stands"]
    j = int(np.argmax(off.max(axis=0)))
    rms = 1e3 * float(np.sqrt(np.mean(off**2)))
    return [
        f"joints read back are off the commanded ones by {rms:.2g} mrad rms, {1e3 * off[:, j].max():.2g} at most "
        f"({measured.joint_names[j]})"
    ]


def drift(
    chain: Chain, blocks: Sequence[PoseMeasurements], again: Sequence[PoseMeasurements], sigma: float
) -> list[str]:
    """Compare poses with their repetitions: within a block, and between blocks and what was measured again at the end.

    What the joints differ by is taken off as the nominal arm says, at its size: the instrument's frame is not known.

    Args:
        blocks: measured for the fit; again: files whose name starts with drift.
        sigma: of one position, per axis [m]; 0: not known, then only the figure is given.
    """
    notes = []
    seen = [(block, k) for block in blocks if isinstance(block, Positions) for k in range(len(block))]
    for later in again:
        pairs = _pairs(seen, [(later, k) for k in range(len(later))] if isinstance(later, Positions) else [], chain)
        notes += _judged(pairs, sigma, f"{Path(later.file).name}: measured again at the end")
    for block in blocks:
        own = [(block, k) for k in range(len(block))] if isinstance(block, Positions) else []
        notes += _judged(_pairs(own, own, chain), sigma, f"{Path(block.file).name}: measured more than once")
    return notes


def _pairs(
    first: Sequence[tuple[Positions, int]], later: Sequence[tuple[Positions, int]], chain: Chain
) -> list[tuple[float, float]]:
    """Return the shift between two visits of one pose, and what their joints explain of it [m]."""
    if not first or not later:
        return []
    q = np.array([block.q[k] for block, k in first])
    result = []
    for place, (block, k) in enumerate(later):
        near = [int(i) for i in np.flatnonzero(np.abs(q - block.q[k]).max(axis=1) < SAME)]
        near = [i for i in near if first is not later or i < place]
        near = [i for i in near if first[i][0].tool[first[i][1]] == block.tool[k]]
        if not near:
            continue
        other, row = first[near[0]]
        both = forward(chain, np.array([other.q[row], block.q[k]]))[:, :3, 3]
        shift = float(np.linalg.norm(block.position[k] - other.position[row]))
        result.append((shift, float(np.linalg.norm(both[1] - both[0]))))
    return result


def _judged(pairs: list[tuple[float, float]], sigma: float, label: str) -> list[str]:
    if not pairs:
        return []
    shift, joints = (np.array(column) for column in zip(*pairs))
    beyond = np.sqrt(np.maximum(np.mean(np.maximum(shift**2 - joints**2, 0.0)), 0.0))
    words = f"{label}, {len(pairs)} poses differ by {1e3 * beyond:.3g} mm rms"
    expected = np.sqrt(6.0) * sigma  # of a difference of two points, three axes each
    if not sigma:
        return [words]
    if beyond > MANY / np.sqrt(len(pairs)) * expected + expected:
        return [
            f"{words}, where noise alone gives {1e3 * expected:.2g} mm: did base, tool or instrument move? Measure the "
            "base again, and the poses from where it began"
        ]
    return [f"{words}, as noise alone would ({1e3 * expected:.2g} mm)"]

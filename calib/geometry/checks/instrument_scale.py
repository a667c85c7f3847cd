"""Can an instrument have seen this arm? One factor on all lengths, of the measured ones or of the fitted ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.geometry.installation import Installation
from calib.geometry.observation import observe, prepare
from calib.geometry.parameters import layout
from calib.geometry.result import GeometricFit
from calib.robot.chain import element_length

Torques = Sequence[np.ndarray | None] | None


@dataclass(frozen=True)
class Scale:
    """One factor on all measured lengths, fitted together with base and tool placement of the nominal arm.

    Attributes:
        factor: measured over the arm's.
        sigma: of the factor.
        explained: share of the squares of the nominal arm's errors that it takes away.
    """

    factor: float
    sigma: float
    explained: float


def scale_of(nominal: Installation, blocks: Sequence[PoseMeasurements], torques: Torques = None) -> Scale | None:
    """Return the factor on the instrument's lengths; None without positions.

    Args:
        nominal: the arm with base and tool placement fitted for it.
        blocks: of any kinds; those that measure positions count.
    """
    frames, rows, columns = layout(nominal).frame_index, [], []
    for block in prepare(nominal, blocks, torques):
        if not isinstance(block.measured, Positions):
            continue
        part = next(part for part in observe(nominal, block, frames) if part.label == "position")
        seen = np.asarray(block.measured.position)[part.index]
        rows.append(part.value.ravel())
        columns.append(
            np.column_stack([part.jacobian.reshape(len(frames), -1).T, (seen - seen.mean(axis=0)).T.ravel()])
        )
    if not rows:
        return None
    value, matrix = np.concatenate(rows), np.concatenate(columns)
    size = np.maximum(np.linalg.norm(matrix, axis=0), 1e-12)
    return _scale(value, matrix / size, float(size[-1]))


def _scale(value: np.ndarray, matrix: np.ndarray, size: float) -> Scale | None:
    """Return the last column's share in explaining `value`, the others being free: y - p = (1 - 1/s) y."""
    others, last = matrix[:, :-1], matrix[:, -1]
    left, own = (x - others @ np.linalg.lstsq(others, x, rcond=1e-9)[0] for x in (value, last))
    power, count = float(own @ own), len(value) - matrix.shape[1]
    if count < 1 or power < 1e-12:
        return None
    slope = float(own @ left) / power
    squares = float(left @ left)
    rest = max(squares - slope**2 * power, 0.0)
    return Scale(
        1.0 / (1.0 - slope / size), float(np.sqrt(rest / count / power)) / size, 1.0 - rest / max(squares, 1e-300)
    )


def length_factor(fit: GeometricFit) -> Scale | None:
    """Return the factor by which all lengths of a fitted arm grew together; None where fewer than two were fitted.

    Its sigma is that of the measurements; how much of the lengths' change it explains says whether it is one factor.
    """
    chain, split, candidates = fit.start.chain, fit.split, fit.candidates
    if split is None or candidates is None:
        return None
    arm = len(chain.elements)
    own = np.array([element_length(chain, int(k)) if k < arm else 0.0 for k in candidates])
    total = own[split.kept] + split.coefficients @ own[split.dropped]  # with those that are merged into them
    place = {int(k): number for number, k in enumerate(fit.free)}
    used = [(place[int(k)], int(k), size) for k, size in zip(candidates[split.kept], total) if int(k) in place]
    min_length = 0.01  # [m]: lengths below say nothing of a factor
    used = [one for one in used if one[1] < arm and chain.elements[one[1]].axis[0] == "t" and abs(one[2]) > min_length]
    if len(used) < 2:
        return None
    index, elements, lengths = (np.array(each) for each in zip(*used))
    grown = fit.cell.chain.values[elements] - chain.values[elements]
    weight = np.linalg.pinv(fit.estimate.covariance[np.ix_(index, index)], hermitian=True)
    power, common = float(lengths @ weight @ lengths), float(lengths @ weight @ grown)
    if not power > 0.0:
        return None
    share = common**2 / power / max(float(grown @ weight @ grown), 1e-300)
    return Scale(1.0 + common / power, power**-0.5, share)

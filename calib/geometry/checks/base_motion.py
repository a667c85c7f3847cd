"""Motion of a base frame during a series: instrument and base moved against each other, or noise alone.

Let d_i be the deviations of the frame's position from its mean over the m rows, along three axes. Two figures of noise
are compared with their rms: the stated σ, and the differences of successive rows, which a slow motion leaves small
(von Neumann 1941):

    rms² = Σ |d_i|² / m,   σ² = Σ |p_i+1 - p_i|² / 2 (m - 1)

The same holds for rotation vectors. Under white noise rms/σ deviates from 1 by 1/√(2 dof), dof = 3 (m - 1).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.poses.base_frame import is_constant
from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.errors import Finding, finding

# standard errors by which rms exceeds noise where the frame moved (our choice): simulated, at most 0.4 % of still
# series of 5 to 200 rows are above, and 99.8 % of those that drift by 16 σ
MIN_SIGMAS = 3.0
# rows below which noise and motion are not compared (our choice)
MIN_ROWS = 5
# ratio of a spread to its stated σ that no instrument has, but metres under a header of millimetres (our choice)
MIN_SPREAD = 0.01


@dataclass(frozen=True)
class Spread:
    """Spread of three coordinates over a series, with its noise [m or rad].

    Attributes:
        rms, largest: lengths of the deviations from the mean.
        noise: rms that noise explains: the smaller one of its two figures.
        from_sigma: rms that the stated σ explain; 0 if not known.
        exceeds: whether the rms is larger than noise explains.
    """

    rms: float
    largest: float
    noise: float
    from_sigma: float
    exceeds: bool


def base_motion(blocks: Sequence[PoseMeasurements]) -> list[Finding]:
    """Return a finding on each block with a base frame: how far it moved, within its noise or beyond.

    Args:
        blocks: the measurements; kinds without a base frame are skipped.
    """
    findings = []
    for block in blocks:
        if not isinstance(block, Positions) or block.base is None or block.base_sigma is None:
            continue
        # several targets of a row share its base frame
        _, index = np.unique(block.rows, return_index=True)
        base = block.base[index]
        file = Path(block.file).name or "measurements"
        if is_constant(base):
            findings.append(finding("base-frame-constant", file=file, rows=len(base)))
        elif len(base) >= MIN_ROWS:
            findings.append(_judged(file, block, base, block.base_sigma[index]))
    return findings


def _judged(file: str, block: Positions, base: np.ndarray, sigma: np.ndarray) -> Finding:
    """Return the finding on a base frame that varies.

    Args:
        file: name of the file.
        block: the measurements.
        base: (m, 7) measured base frames, one per row of the file.
        sigma: (m, 6) their standard deviations.
    """
    turns = Rotation.from_quat(base[:, 3:])
    vectors = (turns * turns.mean().inv()).as_rotvec()
    shift = spread_of(base[:, :3], sigma[:, :3])
    turn = spread_of(vectors, sigma[:, 3:])
    if shift.rms < MIN_SPREAD * shift.from_sigma:
        return finding("base-frame-quiet", file=file, rms=shift.rms, noise=shift.from_sigma)
    code = "base-frame-still"
    if shift.exceeds or turn.exceeds:
        code = "base-frame-moved"
    return finding(
        code,
        file=file,
        rows=len(base),
        rms=shift.rms,
        largest=shift.largest,
        noise=shift.noise,
        turn=turn.rms,
        largest_turn=turn.largest,
        turn_noise=turn.noise,
        added=_added_noise(block),
    )


def spread_of(values: np.ndarray, sigma: np.ndarray) -> Spread:
    """Return the spread of coordinates (m, 3) in the order of measurement.

    Args:
        values: positions [m] or rotation vectors [rad].
        sigma: (m, 3) stated standard deviations; NaN where not known.
    """
    count = len(values)
    lengths = np.linalg.norm(values - values.mean(axis=0), axis=1)
    rms = np.sqrt(np.mean(lengths**2))
    share = 1.0 - 1.0 / count
    steps = np.diff(values, axis=0)
    noise = np.sqrt(share * np.mean(np.sum(steps**2, axis=1)) / 2.0)
    from_sigma = 0.0
    if np.isfinite(sigma).all():
        from_sigma = np.sqrt(share * np.mean(np.sum(sigma**2, axis=1)))
        noise = min(noise, from_sigma)
    dof = 3 * (count - 1)
    exceeds = rms > (1.0 + MIN_SIGMAS / np.sqrt(2.0 * dof)) * noise
    return Spread(float(rms), float(lengths.max()), float(noise), float(from_sigma), bool(exceeds))


def _added_noise(block: Positions) -> float | None:
    """Return the rms length [m] of the error that the base frame's stated σ cause at the target; None if not known.

    Args:
        block: measured positions, relative to the base frame.
    """
    if block.base_sigma is None or not np.isfinite(block.base_sigma[:, :3]).all():
        return None
    squares = block.base_sigma**2
    lever = np.linalg.norm(block.position, axis=1)
    across = 2.0 / 3.0 * lever**2 * np.nan_to_num(squares[:, 3:]).sum(axis=1)
    return float(np.sqrt(np.mean(squares[:, :3].sum(axis=1) + across)))

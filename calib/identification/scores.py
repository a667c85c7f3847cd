"""How good a prediction of torques is: relative errors, moving and standing apart, and the share no model reaches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.data.motion import in_band, moving
from calib.estimation.whiteness import Whiteness, examine, r_squared
from calib.identification.cases import Case
from calib.identification.rows import segments


@dataclass(frozen=True, eq=False)
class Part:
    """Errors on one set of samples.

    Attributes:
        total: 100 ‖τ - τ̂‖_F / ‖τ‖_F over all rows and samples [%].
        joints: (rows,) 100 ‖τ_j - τ̂_j‖ / ‖τ_j‖ [%]; NaN where nothing was measured.
        rms: (rows,) of τ - τ̂ in the torque's unit.
        samples: how many rows it rests on, in all.
    """

    total: float
    joints: np.ndarray
    rms: np.ndarray
    samples: int


@dataclass(frozen=True, eq=False)
class Score:
    """One case, predicted.

    Attributes:
        raw: against the torque as recorded, at the full rate.
        filtered: both sides low-passed to the identification band, at the full rate.
        moving, standing: rows of joints that move, or stand, against the torque as recorded.
        above: (rows,) share of the torque that lies above the identification band, 100 ‖τ - τ_f‖ / ‖τ‖ [%]: noise,
            ripple, elasticity; a floor for `raw` of any model whose prediction stays in the band.
        r_squared: (rows,) of the raw torque.
        whiteness: of the residuals below the band, per row; None for series too short to say.
        rate: of the series whose whiteness was looked at: thinned to its band [Hz].
        motion_share: part of the rows that move; where it is small, little but friction at rest was tested.
    """

    raw: Part
    filtered: Part
    moving: Part
    standing: Part
    above: np.ndarray
    r_squared: np.ndarray
    whiteness: tuple[Whiteness | None, ...]
    rate: float
    motion_share: float


def score(case: Case, predicted: np.ndarray, slow: float | tuple[float, ...] | None = None) -> Score:
    """Return the errors of a prediction (N, rows) at the full rate; lost samples count nowhere."""
    motion = case.motion
    known = motion.weight > 0.5
    target, predicted = np.asarray(case.target), np.asarray(predicted)
    moves = moving(motion) if slow is None else moving(motion, slow)
    moves = np.hstack([moves] * (target.shape[1] // motion.n))
    low = [in_band(motion, values) for values in (target, predicted)]
    factor = motion.decimator.factor
    seen = np.repeat(known[:, None], target.shape[1], axis=1)
    return Score(
        part(target, predicted, seen),
        part(low[0], low[1], seen),
        part(target, predicted, seen & moves),
        part(target, predicted, seen & ~moves),
        _above(target, low[0]),
        np.array([r_squared(target[known, j], (target - predicted)[known, j]) for j in range(target.shape[1])]),
        _whiteness((low[0] - low[1])[::factor], motion.segment[::factor]),
        motion.rate / factor,
        float(moves.mean()),
    )


def part(target: np.ndarray, predicted: np.ndarray, used: np.ndarray) -> Part:
    """Return the errors over the entries (N, rows) in use."""
    square = np.where(used, (target - predicted) ** 2, 0.0).sum(axis=0)
    size, count = np.where(used, target**2, 0.0).sum(axis=0), used.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        joints = 100.0 * np.sqrt(square / size)
        rms = np.sqrt(square / count)
        total = float(100.0 * np.sqrt(square.sum() / size.sum()))
    return Part(total, np.where(size > 0.0, joints, np.nan), np.where(count > 0, rms, np.nan), int(count.sum()))


def _above(target: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Return the share of the torque above the band (rows,) [%]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = 100.0 * np.linalg.norm(target - low, axis=0) / np.linalg.norm(target, axis=0)
    return np.where(np.isfinite(share), share, 0.0)


def _whiteness(residual: np.ndarray, segment: np.ndarray) -> tuple[Whiteness | None, ...]:
    """Return the verdicts on the longest segment of the thinned residuals (M, rows)."""
    spans = segments(segment)
    first, last = max(spans, key=lambda span: span[1] - span[0]) if spans else (0, 0)
    found: list[Whiteness | None] = []
    for column in residual[first:last].T:
        enough = len(column) > 40 and np.ptp(column) > 0.0
        found.append(examine(column, min(30, len(column) // 2)) if enough else None)
    return tuple(found)

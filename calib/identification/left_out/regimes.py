"""Regimes of a motion that models are judged on without having been fitted to them: each joint's extremes.

A model that is right goes on being right where a joint is faster, accelerates more, or stands farther out than in
its training data, and in the direction of travel that it has not seen. Blocks of time hardly ask for that: each holds
some of everything.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.data.signals.filtering import Decimator, kept
from calib.identification.cases import Case
from calib.identification.rows import ObservationRows

FAST_SHARE, END_SHARE = 0.1, 0.15  # of the rows: a joint's fastest, its hardest accelerated; at each end (our choice)


@dataclass(frozen=True, eq=False)
class Regimes:
    """[W y]ᵀ[W y] of what each regime holds, row by row: of joint j's rows those at which joint j is in it.

    Attributes:
        squares, counts: (k, rows, p + 1, p + 1) and (k, rows) of the k regimes.
        whole, total: (rows, p + 1, p + 1) and (rows,) of all rows.
    """

    squares: np.ndarray
    counts: np.ndarray
    whole: np.ndarray
    total: np.ndarray


def regimes(all_rows: Sequence[ObservationRows], cases: Sequence[Case], decimator: Decimator) -> Regimes:
    """Return the regimes of cases, from their rows."""
    motions = [case.motion for case in cases]
    chosen = [kept(motion.segment, decimator) for motion in motions]
    q, v, a = (
        np.concatenate([getattr(motion, key)[own] for motion, own in zip(motions, chosen)]) for key in ("q", "v", "a")
    )
    rows, p = all_rows[0].matrix.shape[1:]
    joint = np.arange(rows) % q.shape[1]
    if rows % q.shape[1]:  # rows of the platform, or the power: of all joints together, and of the one that moves most
        joint = np.full(rows, np.argmax(np.std(q, axis=0)))
        v, a = (np.copysign(np.linalg.norm(x / (np.std(x, axis=0) + 1e-12), axis=1)[:, None], x) for x in (v, a))
    low, high = np.quantile(q, [END_SHARE, 1.0 - END_SHARE], axis=0)
    fastest, hardest = (np.abs(x) > np.quantile(np.abs(x), 1.0 - FAST_SHARE, axis=0) for x in (v, a))
    inside = np.stack([fastest, hardest, q < low, q > high, v > 0.0, v < 0.0])[:, :, joint]
    stacked = [np.concatenate([part.matrix, part.target[:, :, None]], axis=2) for part in all_rows]
    squares, counts = np.zeros((len(inside), rows, p + 1, p + 1)), np.zeros((len(inside), rows))
    whole, total = np.zeros((rows, p + 1, p + 1)), np.zeros(rows)
    start = 0
    for part, both in zip(all_rows, stacked):
        own = slice(start, start + len(both))
        start += len(both)
        for row in range(rows):
            used = part.present[:, row]
            whole[row] += both[used, row].T @ both[used, row]
            total[row] += used.sum()
            for k in range(len(inside)):
                held = both[used & inside[k, own, row], row]
                squares[k, row] += held.T @ held
                counts[k, row] += len(held)
    return Regimes(squares, counts, whole, total)

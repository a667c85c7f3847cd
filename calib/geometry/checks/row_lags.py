"""Rows of measured poses that belong to other rows of the arm's poses, by angles that no placement changes.

With B_i = S A_i X, or with its inverse, the rotation between the poses of two rows has the same angle for both:
|log R_Aᵢᵀ R_Aⱼ| = |log R_Bᵢᵀ R_Bⱼ|. So rows are compared before anything is placed and before the direction is known.
"""

from collections.abc import Iterator

import numpy as np

# Steps between the rows whose rotations are compared.
STEPS = (1, 2)
# Smallest number of the last rows by which a lag is chosen, and their share of all rows.
MIN_TAIL = 6
TAIL = 1 / 3
# Largest difference of angles [rad] that counts: a wrong row counts no more than this.
MAX_DIFFERENCE = 0.2
# Mean difference of a row's angles over the median of all, up to which the row agrees with its partner (our choice).
TIED = 3.0


def last_lag(arm: np.ndarray, measured: np.ndarray) -> int:
    """Return the lag k at which the last measured rows i agree best with the arm's rows i + k.

    Args:
        arm: (m, 4, 4) poses of the tip in the base; NaN in rows that are absent.
        measured: (m, 4, 4) poses of the target in the instrument's frame, or their inverses, likewise.
    """
    m = len(arm)
    tail = max(MIN_TAIL, round(TAIL * m))
    best = (np.inf, 0)
    # the smaller of two lags that agree as well
    for lag in sorted(range(-(m - tail), m - tail), key=abs):
        end = m - max(lag, 0)
        rows = np.arange(max(end - tail, 0, -lag), end)
        differences = np.concatenate(list(_differences(arm, measured, rows + lag, rows)))
        differences = differences[np.isfinite(differences)]
        if len(differences) >= MIN_TAIL:
            best = min(best, (float(np.median(differences)), lag), key=lambda choice: choice[0])
    return best[1]


def first_of_lag(arm: np.ndarray, measured: np.ndarray, lag: int) -> int:
    """Return the index of the first measured row that agrees with the arm's row `lag` rows further down only.

    A row beside one that was stored twice agrees with both rows of the arm, and is not counted as further down.

    Args:
        arm, measured: (m, 4, 4) poses, as for `last_lag`.
        lag: number of rows; negative: rows further up.
    """
    m = len(arm)
    rows = np.arange(m)
    sums = []
    typical = []
    for first in range(m - MIN_TAIL + 1):
        partners = np.where(rows >= first, rows + lag, rows)
        present = (partners >= 0) & (partners < m)
        # further up, the first rows have no partners: the arm's rows there belong to those before
        present &= (rows < first) | (partners >= first) | (first == 0)
        total = 0.0
        of_steps = list(_differences(arm, measured, partners[present], rows[present]))
        for differences in of_steps:
            total += float(np.nansum(np.minimum(differences, MAX_DIFFERENCE)))
            # absent rows are no agreement
            total += MAX_DIFFERENCE * (m - np.isfinite(differences).sum())
        sums.append(total)
        available = np.concatenate(of_steps)
        available = available[np.isfinite(available)]
        typical.append(float(np.median(available)) if len(available) else 0.0)
    first = int(np.argmin(sums))
    # a row is part of two angles of each step
    tie = TIED * 2 * len(STEPS) * typical[first]
    largest = sums[first] + tie
    while first + 1 < len(sums) and sums[first + 1] <= largest:
        first += 1
    return first


def _differences(
    arm: np.ndarray, measured: np.ndarray, arm_rows: np.ndarray, measured_rows: np.ndarray
) -> Iterator[np.ndarray]:
    """Yield the absolute differences of the angles [rad] between rows of both lists that are some steps apart.

    Args:
        arm, measured: (m, 4, 4) poses.
        arm_rows, measured_rows: (k,) indices of rows that are taken for each other.
    """
    for step in STEPS:
        arm_angles = _angles(arm[arm_rows[:-step]], arm[arm_rows[step:]])
        measured_angles = _angles(measured[measured_rows[:-step]], measured[measured_rows[step:]])
        yield np.abs(arm_angles - measured_angles)


def _angles(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the angles (k,) [rad] between the orientations of two lists of poses (k, 4, 4); NaN for absent ones."""
    trace = np.einsum("kij,kij->k", first[:, :3, :3], second[:, :3, :3])
    return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))

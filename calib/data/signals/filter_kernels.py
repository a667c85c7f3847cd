"""Compiled kernel (numba) of recursive filters."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def both_ways(sections, values):
    """Filter rows (k, N) in place, forwards and backwards, by sections (s, 5) of gain 1 at rest: b0, b1, b2, a1, a2.

    Each pass begins in the steady state of its first value (transposed direct form II).
    """
    count, last = len(sections), values.shape[1] - 1
    state = np.zeros((count, 2))
    for row in values:
        for start, step in ((0, 1), (last, -1)):
            first = row[start]
            state[:] = 0.0
            for i in range(last + 1):
                x = row[start + i * step] - first
                for k in range(count):
                    y = sections[k, 0] * x + state[k, 0]
                    state[k, 0] = sections[k, 1] * x - sections[k, 3] * y + state[k, 1]
                    state[k, 1] = sections[k, 2] * x - sections[k, 4] * y
                    x = y
                row[start + i * step] = x + first

"""Motions of a platform for the tests of parallel robots."""

import numpy as np


def sines(t: np.ndarray, frequencies: tuple[float, ...], size, rng: np.random.Generator) -> np.ndarray:
    """Return x, v, a (3, N, r) of sums of sines of frequencies [Hz] at times (N,) [s]; `size` (r,), or of a frequency.

    Phases are random, one for each coordinate and frequency.
    """
    parts, t = 0.0, t[:, None]
    for frequency in frequencies:
        own, w = np.asarray(size(frequency) if callable(size) else size), 2 * np.pi * frequency
        phase = rng.uniform(0, 6, len(own))
        parts += own * np.stack([np.sin(w * t + phase), w * np.cos(w * t + phase), -(w**2) * np.sin(w * t + phase)])
    return parts

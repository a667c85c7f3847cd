"""Fingerprint of a recording: samples by which it is recognised under another name, thinned or cut.

The samples must have the same values in single precision. A copy with fewer digits, or resampled between its samples,
is not recognised. Samples at rest do not count: an arm that waits at home gives equal ones in different logs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SKETCH = 64
"""Samples by which a log is recognised: those with the smallest hashes (Broder 1997)."""
FINE_SKETCH = 512
"""Samples of a recording that a model was identified from: a piece of a fiftieth has ten of them (our choice)."""
MIN_COMMON = 5
"""Common samples from which on two logs share a part (our choice): coarse encoders may agree in some by chance."""
MIN_SHARE = 0.01
"""Smallest share of common samples: a hundredth counted twice changes less than a log left out (our choice)."""
STEP = 0.1
"""Time before and after a sample in which the arm has to move [s] (our choice)."""
MIN_MOTION = 1e-3
"""Change of some joint in this time from which on the arm moves [rad or m]: above steps of encoders (our choice)."""


@dataclass(frozen=True)
class Fingerprint:
    """By what a recording is recognised.

    Attributes:
        name: its name in results.
        file: its path, which may contain its date; empty for a recording in memory.
        samples: the smallest hashes of its samples, each as 16 hexadecimal digits.
    """

    name: str
    file: str
    samples: str

    @classmethod
    def of(cls, name: str, file: str, hashes: np.ndarray) -> Fingerprint:
        """Return the fingerprint of a recording with sorted hashes (N,)."""
        return cls(name, file, hashes[:FINE_SKETCH].astype(">u8").tobytes().hex())

    @property
    def hashes(self) -> np.ndarray:
        """The smallest hashes (up to `FINE_SKETCH`,) of its samples."""
        return np.frombuffer(bytes.fromhex(self.samples), ">u8").astype(np.uint64)


@dataclass(frozen=True)
class Fingerprints:
    """Fingerprints of the recordings that a model was identified from: content of ``recordings.json``."""

    recordings: tuple[Fingerprint, ...] = ()


def in_motion(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return whether the arm moves before and after each sample (N,); samples at both ends of a log do not count.

    Args:
        t: rising times (N,) [s].
        q: positions (N, n) [rad or m].
    """
    before = np.zeros(len(t))
    after = np.zeros(len(t))
    for joint in q.T:
        earlier = np.interp(t - STEP, t, joint)
        later = np.interp(t + STEP, t, joint)
        before = np.fmax(before, np.abs(joint - earlier))
        after = np.fmax(after, np.abs(later - joint))
    return np.minimum(before, after) > MIN_MOTION


def sample_hashes(series: Sequence[np.ndarray]) -> np.ndarray:
    """Return the sorted distinct hashes (N,) of samples of positions and torques, before any filter.

    The hash of a sample is a product-sum of its bits, mixed as in SplitMix64 (Steele et al. 2014).

    Args:
        series: arrays (N, n): positions, torques.
    """
    samples = np.column_stack(series).astype(np.float32)
    bits = np.ascontiguousarray(samples).view(np.uint32).astype(np.uint64)
    multipliers = np.random.default_rng(0).integers(1, 2**63, bits.shape[1], dtype=np.uint64) * np.uint64(2)
    hashes = (bits * (multipliers + np.uint64(1))).sum(axis=1, dtype=np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        hashes = (hashes ^ (hashes >> np.uint64(shift))) * np.uint64(factor)
    return np.unique(hashes ^ (hashes >> np.uint64(31)))


def sketch(hashes: np.ndarray) -> np.ndarray:
    """Return the `SKETCH` smallest hashes (64,) of a log; of a shorter one, the last hash, or 0, is repeated."""
    smallest = hashes[:SKETCH]
    last = smallest[-1] if len(smallest) else 0
    padding = np.full(SKETCH - len(smallest), last, dtype=np.uint64)
    return np.concatenate([smallest, padding])


def common_share(hashes: np.ndarray, earlier: np.ndarray) -> float:
    """Return the share of an earlier log's samples that a log contains; 0 below `MIN_COMMON` samples or `MIN_SHARE`.

    Args:
        hashes: hashes (N,) of the log.
        earlier: sketch (64,) of the earlier log, or the hashes of a `Fingerprint`.
    """
    distinct = np.unique(earlier)
    count = int(np.isin(distinct, hashes).sum())
    if count < max(MIN_COMMON, MIN_SHARE * len(distinct)):
        return 0.0
    return count / len(distinct)

"""Fingerprint of a recording: samples by which it is recognised under another name or in another format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SKETCH = 64
"""Samples by which a log is recognised: those with the smallest hashes (Broder 1997)."""
FINE_SKETCH = 512
"""Samples of a recording that a model was identified from: a piece of a hundredth has five of them (our choice)."""
MIN_COMMON = 3
"""Common samples from which on two logs share a part (our choice); samples of different logs differ."""


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


def sample_hashes(series: Sequence[np.ndarray]) -> np.ndarray:
    """Return the sorted distinct hashes (N,) of a log's samples of positions and torques, before any filter.

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
    """Return the `SKETCH` smallest hashes (64,) of a log; of a shorter one, the last hash is repeated."""
    smallest = hashes[:SKETCH]
    padding = np.repeat(smallest[-1:], SKETCH - len(smallest))
    return np.concatenate([smallest, padding])


def common_share(hashes: np.ndarray, earlier: np.ndarray) -> float:
    """Return the share of an earlier log's samples that a log contains; 0 where fewer than `MIN_COMMON` are equal.

    Args:
        hashes: hashes (N,) of the log.
        earlier: sketch (64,) of the earlier log, or the hashes of a `Fingerprint`.
    """
    distinct = np.unique(earlier)
    count = int(np.isin(distinct, hashes).sum())
    if count < MIN_COMMON:
        return 0.0
    return count / len(distinct)

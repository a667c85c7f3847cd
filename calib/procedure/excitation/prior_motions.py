"""Motions that were recorded, or designed, before: what they tell already counts in the next design."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.dynamics.base import BaseModel
from calib.errors import UsageError
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.model import ExcitedModel
from calib.robot.chain import Chain

BLOCK = 4000


@dataclass(frozen=True, eq=False)
class Existing:
    """What motions before tell.

    Attributes:
        names: of the files or folders.
        seconds: of motion.
        information: (b, b) ∫ ωᵀω dt, of the design's columns.
    """

    names: tuple[str, ...]
    seconds: float
    information: np.ndarray

    def per_sample(self, count: int, duration: float) -> np.ndarray:
        """Return the information in units of one of `count` samples that stand for `duration` seconds of new motion."""
        return self.information * (count / duration)


def read_existing(paths: Sequence[str], dynamics: ExcitedModel, chain: Chain) -> Existing | None:
    """Read recordings (``log.npz@0:9.4`` cuts) and folders of `calib excite`; None where there are none.

    Recordings are filtered and differentiated as `calib identify` does it.

    Raises:
        UsageError, MeasurementError: for what is neither, or belongs to another robot.
    """
    if not paths:
        return None
    total, seconds = np.zeros((len(dynamics.exact.names),) * 2), 0.0
    for text in paths:
        q, v, a, rate = _designed(Path(text), chain) if _is_designed(Path(text)) else _recorded(text, chain)
        total += _information(dynamics.exact, q, v, a) / rate
        seconds += len(q) / rate
    return Existing(tuple(str(path) for path in paths), seconds, total)


def _is_designed(path: Path) -> bool:
    return path.is_dir() and (path / coefficients.NAME).exists()


def _designed(folder: Path, chain: Chain) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return all periods of a designed motion, at 50 samples a second at least."""
    found = coefficients.read(folder)
    if found.joint_names != tuple(chain.joint_names):
        raise UsageError(
            f"--existing {folder}: a motion of {', '.join(found.joint_names)}; {chain.name} has "
            f"{', '.join(chain.joint_names)}"
        )
    count = max(1000, round(50 * found.period))
    q, v, a = found.orders(np.arange(count) * (found.period / count))
    every = found.repeat
    return np.tile(q, (every, 1)), np.tile(v, (every, 1)), np.tile(a, (every, 1)), count / found.period


def _recorded(text: str, chain: Chain) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    from calib.identification.identify_options import FileSettings
    from calib.procedure.dynamic_stage.identify import read_motion

    motion = read_motion(text, chain, FileSettings())
    present = motion.weight > 0.5
    return motion.q[present], motion.v[present], motion.a[present], motion.rate


def _information(model: BaseModel, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return Σ ωᵀω (b, b), block by block."""
    total = np.zeros((len(model.names),) * 2)
    for start in range(0, len(q), BLOCK):
        part = (np.ascontiguousarray(x[start : start + BLOCK]) for x in (q, v, a))
        W = model.regressor(*part)
        rows = W.reshape(-1, W.shape[-1])
        total += rows.T @ rows
    return total

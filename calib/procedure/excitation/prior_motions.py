"""Information of earlier motions, recorded or designed, that a new one adds to."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, cast

import numpy as np

from calib.dynamics.base import information
from calib.errors import UsageError
from calib.folders import COVARIANCE
from calib.identification.identify_options import FileSettings
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.dynamic_stage.geometry_tables import TORQUE_COVARIANCE
from calib.procedure.dynamic_stage.inputs import read_motion
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.excited_model import ExcitedModel, covariance_of
from calib.robot.chain import Chain


class GeometrySpread(Protocol):
    """Principal errors of a calibrated geometry, g_1 … g_r: √λ_i u_i of its covariance Σ λ_i u_i u_iᵀ."""

    @property
    def before(self) -> np.ndarray:
        """Changes (b, r) of the parameters of an earlier identification by each error; zero without one."""
        ...

    def felt(self, values: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the torques' changes (N, rows, r) by each error at fixed base parameters `values` (b,)."""
        ...


@dataclass(frozen=True, eq=False)
class PriorMotions:
    """Information matrix of earlier motions, recorded or designed.

    Attributes:
        names: of the files or folders.
        seconds: of motion.
        information: (b, b) ∫ ωᵀω dt, of the design's columns, rows in units of `sigmas`.
        sigmas: (rows,) root of the torque errors' density, where an identification states it; None: 1.
    """

    names: tuple[str, ...]
    seconds: float
    information: np.ndarray
    sigmas: np.ndarray | None = None

    def per_sample(self, count: int, duration: float) -> np.ndarray:
        """Return the information (b, b) per sample of a new motion of `duration` seconds and `count` samples."""
        return self.information * (count / duration)


def read_prior(
    paths: Sequence[str],
    model: ExcitedModel,
    chain: Chain,
    after: Path | None = None,
    noise: np.ndarray | None = None,
    geometry: GeometrySpread | None = None,
) -> PriorMotions | None:
    """Return the information from recordings (``log.npz@0:9.4`` cuts) and folders of `calib excite`; None if none.

    Recordings are filtered and differentiated as `calib identify` does it. What an identification `after` knows, its
    prior included, is the inverse of its covariance, without the part of the geometry.

    Args:
        noise: (rows,) by which torque rows are divided where no identification states it; None: 1.

    Raises:
        UsageError, MeasurementError: for a path that is neither, or belongs to another robot.
    """
    if not paths and after is None:
        return None
    total, seconds, sigmas = np.zeros((len(model.exact.names),) * 2), 0.0, None
    names, trained = [], ()
    if after is not None:
        total, sigmas = _known(after, model, geometry)
        names, trained = ["what is identified"], tuple(IdentificationFolder(after).metrics().identification)
    for text in paths:
        if Path(text).name in trained:
            raise UsageError(f"existing {text}: {after} was identified from this recording; leave it out")
        designed = (Path(text) / coefficients.NAME).exists()
        q, v, a, rate = designed_orders(Path(text), chain) if designed else _recorded(text, chain)
        total += information(model.exact, q, v, a, noise if sigmas is None else sigmas) / rate
        seconds += len(q) / rate
    return PriorMotions((*names, *paths), seconds, total, sigmas)


def _known(folder: Path, model: ExcitedModel, geometry: GeometrySpread | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the information (b, b) of an identification, and the square root of its torque error density (rows,).

    Args:
        geometry: where it is given, its part is not in the information.
    """
    metrics, path = IdentificationFolder(folder).metrics(), folder / COVARIANCE
    density, rows = metrics.error_density, metrics.rows
    path = path if geometry is None else folder / TORQUE_COVARIANCE
    covariance = covariance_of(path, model.exact)
    if density is None:
        raise UsageError(f"{folder}/metrics.json has no error_density of the torque rows; identify again")
    if len(density) != model.exact.model.rows:
        designed = model.exact.model.torque_rows.name
        raise UsageError(
            f"{folder} states torque errors of {', '.join(rows)}, and a motion is designed for rows = '{designed}': "
            f"identify again with rows = '{designed}', or name the folder as --model, without --after"
        )
    if covariance is None:
        raise UsageError(
            f"{path} is missing or lacks columns of the design; if the model has payloads, state each run's load "
            "(--load none --load tool)"
        )
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    # what a constraint holds has no spread and gains nothing: as if known to a millionth (our choice)
    spread = np.where(spread > 0.0, spread, np.maximum(1e-6 * np.abs(cast(np.ndarray, model.values)), 1e-12))
    unit = covariance / np.outer(spread, spread)
    np.fill_diagonal(unit, 1.0 + 1e-9)
    if not np.linalg.eigvalsh(unit)[0] > 0.0:
        raise UsageError(f"{path} is not positive definite, so it is damaged; identify again")
    return np.linalg.inv(unit) / np.outer(spread, spread), np.tile(np.sqrt(density), len(model.exact.loads))


def designed_orders(folder: Path, chain: Chain) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return q, v, a of all periods of a designed motion, sampled at 50 Hz or more, and the sampling rate [Hz]."""
    found = coefficients.read(folder)
    if found.joint_names != tuple(chain.joint_names):
        raise UsageError(
            f"{folder}: the motion has joints {', '.join(found.joint_names)}; {chain.name} has "
            f"{', '.join(chain.joint_names)}"
        )
    count = max(1000, round(50 * found.period))
    q, v, a = found.orders(np.arange(count) * (found.period / count))
    every = found.repeat
    return np.tile(q, (every, 1)), np.tile(v, (every, 1)), np.tile(a, (every, 1)), count / found.period


def _recorded(text: str, chain: Chain) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    motion = read_motion(text, chain, FileSettings())
    present = motion.weight > 0.5
    return motion.q[present], motion.v[present], motion.a[present], motion.rate

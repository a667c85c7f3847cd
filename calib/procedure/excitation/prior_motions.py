"""Information matrices of earlier motions, recorded or designed, which a new motion complements."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, cast

import numpy as np

from calib.dynamics.base import information, places
from calib.errors import UsageError
from calib.estimation.triangles import retriangulate
from calib.folders import COVARIANCE
from calib.identification.identify_options import FileSettings
from calib.identification.physical_consistency.information import INFORMATION, read_factor
from calib.identification.uncertainty.error_bands import ErrorBands
from calib.identification.uncertainty.error_growth import ErrorGrowth
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.dynamic_stage.geometry_tables import TORQUE_COVARIANCE
from calib.procedure.dynamic_stage.inputs import read_motion
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.excited_model import ExcitedModel, covariance_of
from calib.robot.chain import Chain

# of a parameter that a constraint holds: its sigma as a share of its value, and at least
CONSTRAINED_SHARE = 1e-6
SMALLEST_SIGMA = 1e-12
# added to the correlation matrix, so that it can be inverted
REGULARISATION = 1e-9
# of a designed motion: samples per period, and rate [Hz], at least
MIN_SAMPLES = 1000
MIN_RATE = 50


class PrincipalErrors(Protocol):
    """Principal errors g_i (i = 1 … r) of a calibrated geometry: g_i = √λ_i u_i.

    λ_i and u_i are the eigenvalues of the covariance of the geometric parameters that are not negligible, and their
    eigenvectors.
    """

    @property
    def before(self) -> np.ndarray:
        """Shifts (b, r) of an earlier identification's parameters by each error; zero without an identification."""
        ...

    def felt(self, values: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the changes (N, rows, r) of the torques [N m or N] by each principal error.

        The base parameters are constant.

        Args:
            values: (b,) base parameters.
            q, v, a: (N, n) positions, velocities and accelerations.
        """
        ...


@dataclass(frozen=True, eq=False)
class PriorMotions:
    """Information matrix of earlier motions, recorded or designed.

    Attributes:
        names: names of the files or folders of the motions.
        seconds: duration of the motions [s].
        information: (b, b) ∫ ωᵀω dt of the regressor ω (rows, b), restricted to the columns of the design, with the
            rows divided by `sigmas`.
        sigmas: (rows,) square root of the torque errors' spectral density that an identification states; None: 1.
        data: (b, b) part of the information that is stored for the recordings; None: all of it.
        growth: how the errors of the torques grow with the motion; None if unknown.
        bands: how their density depends on the identification band; None if unknown.
    """

    names: tuple[str, ...]
    seconds: float
    information: np.ndarray
    sigmas: np.ndarray | None = None
    data: np.ndarray | None = None
    growth: ErrorGrowth | None = None
    bands: ErrorBands | None = None

    def per_sample(self, count: int, duration: float) -> np.ndarray:
        """Return the information (b, b) of the earlier motions in units of one sample of a new motion.

        Args:
            count: number of samples of the new motion.
            duration: duration of the new motion [s].
        """
        return self.information * (count / duration)


def read_prior(
    paths: Sequence[str],
    model: ExcitedModel,
    chain: Chain,
    after: Path | None = None,
    noise: np.ndarray | None = None,
    geometry: PrincipalErrors | None = None,
) -> PriorMotions | None:
    """Return the information of earlier motions from recordings and folders; None if there are none.

    Recordings are filtered and differentiated as in `calib identify`. The information of an identification `after`, its
    prior included, is the inverse of its covariance without the geometry's part.

    Args:
        paths: recordings with optional cuts (``log.npz@0:9.4``), or folders of `calib excite`.
        model: the model to excite.
        chain: the arm.
        after: folder of an identification; None: no identification.
        noise: (rows,) σ by which torque rows are divided if no identification states their errors; None: 1.
        geometry: principal errors of the geometry; None: the geometry is taken as exact.

    Raises:
        UsageError, MeasurementError: for a path that is neither recording nor folder of a motion, or belongs to another
            robot.
    """
    if not paths and after is None:
        return None
    column_count = len(model.exact.names)
    total = np.zeros((column_count, column_count))
    sigmas = growth = bands = data = None
    names: list[str] = []
    identified: tuple[str, ...] = ()
    if after is not None:
        total, sigmas = _identified_information(after, model, geometry)
        names.append("what is identified")
        growth = _growth(after, model)
        bands = _bands(after, model)
        data = _data_information(after, model)
        identified = tuple(IdentificationFolder(after).metrics().identification)
    row_sigmas = noise if sigmas is None else sigmas
    seconds = 0.0
    for text in paths:
        if Path(text).name in identified:
            raise UsageError(f"existing {text}: {after} was identified from this recording; leave it out")
        if (Path(text) / coefficients.NAME).exists():
            q, v, a, rate = designed_orders(Path(text), chain)
        else:
            q, v, a, rate = _recorded(text, chain)
        motion_information = information(model.exact, q, v, a, row_sigmas) / rate
        total += motion_information
        if data is not None:
            data += motion_information
        seconds += len(q) / rate
    return PriorMotions((*names, *paths), seconds, total, sigmas, data, growth, bands)


def _identified_information(
    folder: Path, model: ExcitedModel, geometry: PrincipalErrors | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the information (b, b) of an identification, and the square root of its torque error density (rows,).

    Args:
        folder: folder of the identification.
        model: the model to excite.
        geometry: principal errors; if given, the geometry's part of the covariance is excluded; None: included.

    Raises:
        UsageError: if the stored covariance or torque errors are missing, damaged or of another model.
    """
    metrics = IdentificationFolder(folder).metrics()
    density = metrics.error_density
    path = folder / (COVARIANCE if geometry is None else TORQUE_COVARIANCE)
    covariance = covariance_of(path, model.exact)
    if density is None:
        raise UsageError(f"{folder}/metrics.json has no error_density of the torque rows; identify again")
    if len(density) != model.exact.model.rows:
        designed = model.exact.model.torque_rows.name
        raise UsageError(
            f"{folder} states torque errors of {', '.join(metrics.rows)}, "
            f"and a motion is designed for rows = '{designed}': identify again with "
            f"rows = '{designed}', or name the folder as --model, without --after"
        )
    if covariance is None:
        raise UsageError(
            f"{path} is missing or lacks columns of the design; if the model has payloads, state each run's load "
            "(--load none --load tool)"
        )
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    # what a constraint holds has no spread and gains nothing: as if known to a millionth (our choice)
    smallest = np.maximum(CONSTRAINED_SHARE * np.abs(cast(np.ndarray, model.values)), SMALLEST_SIGMA)
    sigma = np.where(sigma > 0.0, sigma, smallest)
    scale = np.outer(sigma, sigma)
    correlation = covariance / scale
    np.fill_diagonal(correlation, 1.0 + REGULARISATION)
    if not np.linalg.eigvalsh(correlation)[0] > 0.0:
        raise UsageError(f"{path} is not positive definite, so it is damaged; identify again")
    root_density = np.tile(np.sqrt(density), len(model.exact.loads))
    return np.linalg.inv(correlation) / scale, root_density


def _growth(folder: Path, model: ExcitedModel) -> ErrorGrowth | None:
    """Return how the torque errors of an identification grow with the motion; None for files of earlier versions."""
    metrics = IdentificationFolder(folder).metrics()
    if metrics.error_growth is None or metrics.torque_variance is None:
        return None
    loads = len(model.exact.loads)
    return ErrorGrowth(np.tile(metrics.error_growth, loads), np.tile(metrics.torque_variance, loads))


def _bands(folder: Path, model: ExcitedModel) -> ErrorBands | None:
    """Return how the errors of an identification depend on the band; None for files of earlier versions.

    Raises:
        UsageError: if the stored bands are damaged.
    """
    bands = IdentificationFolder(folder).metrics().error_bands
    if bands is None:
        return None
    expected = (len(bands.rows_per_second), model.exact.model.rows)
    if np.shape(bands.density) != expected or not np.all(np.asarray(bands.density) > 0.0):
        raise UsageError(f"{folder}/metrics.json: error_bands is damaged; identify again")
    density = np.tile(bands.density, len(model.exact.loads))
    return ErrorBands(bands.rows_per_second, density, bands.seconds)


def _data_information(folder: Path, model: ExcitedModel) -> np.ndarray | None:
    """Return the information (b, b) that an identification stores for its recordings; None if there is none.

    Columns that are not designed are marginalised; those of terms that are switched off are zero.
    """
    if not (folder / INFORMATION).is_file():
        return None
    names, factor = read_factor(folder)
    switched_off = IdentificationFolder(folder).switched_off()
    estimated = [k for k, name in enumerate(names) if name not in switched_off]
    names = tuple(names[k] for k in estimated)
    factor = factor[:, [*estimated, factor.shape[1] - 1]]
    index = places(model.exact.names, names, model.exact.model.names)
    if index is None:
        return None
    other = np.setdiff1d(np.arange(len(names)), index)
    triangle = retriangulate(factor[:, [*other, *index]])
    of_design = triangle[len(other) :, len(other) :]
    return of_design.T @ of_design


def designed_orders(folder: Path, chain: Chain) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return q, v, a (N, n) of all periods of a designed motion, sampled at 50 Hz or more, and the sampling rate [Hz].

    Args:
        folder: folder that `calib excite` wrote.
        chain: the arm.

    Raises:
        UsageError: if the motion belongs to a robot with other joints.
    """
    motion = coefficients.read(folder)
    if motion.joint_names != tuple(chain.joint_names):
        raise UsageError(
            f"{folder}: the motion is of another robot: it has joints {', '.join(motion.joint_names)}, "
            f"{chain.name} has "
            f"{', '.join(chain.joint_names)}"
        )
    count = max(MIN_SAMPLES, round(MIN_RATE * motion.period))
    q, v, a = motion.orders(np.arange(count) * (motion.period / count))
    periods = (motion.repeat, 1)
    return np.tile(q, periods), np.tile(v, periods), np.tile(a, periods), count / motion.period


def _recorded(text: str, chain: Chain) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    motion = read_motion(text, chain, FileSettings())
    present = motion.weight > 0.5
    return motion.q[present], motion.v[present], motion.a[present], motion.rate

"""Information of an identification's data on the standard parameters, without a prior: ‖R T χ - z‖².

T regroups the p parameters χ of the model into the b that the motion identifies separately. R and z are the estimate β
and its covariance Σ as rows, RᵀR = Σ⁻¹ and z = R β. Where a prior took part in the estimate, or constraints hold it,
they are the data's own triangle instead (``information.csv``), so that what was known beforehand is not counted twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib import files
from calib.errors import RobotError, refused_as, require
from calib.estimation.estimate import whitened
from calib.estimation.triangles import combine, retriangulate
from calib.folders import read_covariance, read_estimate
from calib.identification.model_file import read_dynamics, read_table, regrouping
from calib.identification.prediction import Dynamics
from calib.records import Frozen
from calib.robot.chain import Chain

if TYPE_CHECKING:
    from calib.identification.identify import Identification

INFORMATION = "information.csv"


@dataclass(frozen=True, eq=False)
class Information(Frozen):
    """An identified model with the information matrix of its data.

    Attributes:
        chain: the robot it was identified on.
        dynamics: the model; its values hold base parameters.
        names, units: b strings each.
        values, covariance: (b,), (b, b) the estimate as identified, including a prior if one was used.
        transform: T (b, p).
        factor: (k, b + 1) the rows [R z].
    """

    chain: Chain
    dynamics: Dynamics
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    transform: np.ndarray
    factor: np.ndarray

    @property
    def b(self) -> int:
        return len(self.names)

    @property
    def best(self) -> float:
        """The minimum of ‖R β - z‖² over all β, physically inconsistent ones included."""
        unit = np.linalg.norm(self.factor[:, :-1], axis=0)
        scaled = self.factor[:, :-1] / np.where(unit > 0.0, unit, 1.0)
        found = np.linalg.lstsq(scaled, self.factor[:, -1], rcond=1e-12)[0]
        return float(np.sum((scaled @ found - self.factor[:, -1]) ** 2))

    def distance(self, standard: np.ndarray) -> float:
        """Return the Mahalanobis distance of standard parameters (p,) from the data's optimum, in sigmas."""
        rest = self.factor[:, :-1] @ (self.transform @ standard) - self.factor[:, -1]
        return float(np.sqrt(max(float(rest @ rest) - self.best, 0.0)))


def of(found: Identification, chain: Chain) -> Information:
    """Return the information of the data of an identification in memory."""
    estimate, standard = found.fitted.estimate, found.dynamics.model.names
    transform = _transform(found.names, regrouping(found.base), standard)
    return Information(
        chain,
        found.dynamics,
        found.names,
        estimate.units,
        estimate.values,
        estimate.covariance,
        transform,
        _information(found),
    )


def _information(found: Identification) -> np.ndarray:
    """Return the R factor [R z] (b + 1, b + 1) of an identification's data, without prior or constraints.

    Rows count as their residuals' autocorrelation lets them. The ridge of richer friction stays in: those terms have
    no other prior.
    """
    fitted, own = found.fitted, found.base.b
    data, std, inflation = fitted.testable()
    rows = [combine(data, std * np.sqrt(inflation))]
    count = len(found.names) - own
    if count:
        group = np.concatenate([np.full(own, -1), found.friction.groups]).astype(int)
        from calib.identification.time_folds import estimate

        known = None if found.prior is None else found.prior.widened(count)
        ridges = estimate(fitted.pooled, fitted.std, fitted.inflation, group, known)[1]
        drawn = np.zeros((count, own + count + 1))
        drawn[:, own:-1] = np.diag(1.0 / np.maximum(ridges[own:], 1e-12))
        rows.append(drawn)
    return retriangulate(np.vstack(rows))


def read(folder: str | Path, given: tuple[Chain, Dynamics] | None = None) -> Information:
    """Return the information of the identification stored in `folder`; `given`: its robot and model, read already.

    Raises:
        RobotError: where the folder holds none, or one of a version that did not write how parameters regroup.
    """
    folder = Path(folder)
    chain, dynamics = given or read_dynamics(folder)
    groups = read_table(folder).get("regrouping")
    if groups is None:
        raise RobotError(f"{folder}/dynamics.json lacks the regrouping of parameters; identify again")
    with refused_as(
        RobotError,
        (OSError, KeyError, ValueError),
        f"{folder}: estimate.csv, covariance.csv and dynamics.json do not agree: {{}}",
    ):
        estimate = read_estimate(folder)
        names, units = (tuple(getattr(one, key) for one in estimate) for key in ("name", "unit"))
        values = np.array([one.value for one in estimate])
        covariance = read_covariance(folder)[1]
        transform = _transform(names, groups, dynamics.model.names)
        data, known = folder / INFORMATION, (folder / INFORMATION).is_file()
        require(known or (np.diag(covariance) > 0.0).all(), "a parameter without variance", ValueError)
        factor = np.loadtxt(data, delimiter=",", skiprows=1, ndmin=2) if known else whitened(values, covariance)
        if covariance.shape != (len(names), len(names)) or factor.shape[1] != len(names) + 1:
            raise ValueError("files of different sizes")
    return Information(chain, dynamics, names, units, values, covariance, transform, factor)


def _transform(names: tuple[str, ...], groups: dict[str, dict[str, float]], standard: tuple[str, ...]) -> np.ndarray:
    """Return the regrouping matrix T (b, p) of standard parameters; rows of richer friction are unit rows."""
    place = {name: k for k, name in enumerate(standard)}
    result = np.zeros((len(names), len(standard)))
    for row, name in enumerate(names):
        for own, coefficient in groups.get(name, {name: 1.0}).items():
            result[row, place[own]] = coefficient
    return result


def write(found: Identification, folder: Path) -> None:
    """Write the R factor of an identification's data (`_information`)."""
    files.write_numbers(folder / INFORMATION, (*found.names, "target"), _information(found))

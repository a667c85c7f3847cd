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
        """Number of estimated parameters."""
        return len(self.names)

    @property
    def best(self) -> float:
        """The minimum of ‖R β - z‖² over all β, physically inconsistent ones included."""
        matrix = self.factor[:, :-1]
        target = self.factor[:, -1]
        unit = np.linalg.norm(matrix, axis=0)
        scaled = matrix / np.where(unit > 0.0, unit, 1.0)
        solution = np.linalg.lstsq(scaled, target, rcond=1e-12)[0]
        return float(np.sum((scaled @ solution - target) ** 2))

    def distance(self, standard: np.ndarray) -> float:
        """Return the Mahalanobis distance of standard parameters (p,) from the data's optimum, in sigmas."""
        base_values = self.transform @ standard
        residual = self.factor[:, :-1] @ base_values - self.factor[:, -1]
        square = float(residual @ residual) - self.best
        return float(np.sqrt(max(square, 0.0)))


def of(identification: Identification, chain: Chain) -> Information:
    """Return the information of the data of an identification in memory."""
    estimate = identification.fitted.estimate
    standard = identification.dynamics.model.names
    groups = regrouping(identification.base)
    transform = _transform(identification.names, groups, standard)
    factor = _information(identification)
    return Information(
        chain=chain,
        dynamics=identification.dynamics,
        names=identification.names,
        units=estimate.units,
        values=estimate.values,
        covariance=estimate.covariance,
        transform=transform,
        factor=factor,
    )


def _information(identification: Identification) -> np.ndarray:
    """Return the R factor [R z] (b + 1, b + 1) of an identification's data, without prior or constraints.

    Rows count as their residuals' autocorrelation lets them. The ridge of richer friction stays in: those terms have
    no other prior.
    """
    from calib.identification.time_folds import estimate

    fitted = identification.fitted
    base_count = identification.base.b
    data, std, inflation = fitted.testable()
    factors = [combine(data, std * np.sqrt(inflation))]
    richer_count = len(identification.names) - base_count
    if richer_count:
        base_groups = np.full(base_count, -1)
        group = np.concatenate([base_groups, identification.friction.groups]).astype(int)
        prior_rows = None
        if identification.prior is not None:
            prior_rows = identification.prior.widened(richer_count)
        _, ridges = estimate(fitted.pooled, fitted.std, fitted.inflation, group, prior_rows)
        ridge_rows = np.zeros((richer_count, base_count + richer_count + 1))
        richer_ridges = np.maximum(ridges[base_count:], 1e-12)
        ridge_rows[:, base_count:-1] = np.diag(1.0 / richer_ridges)
        factors.append(ridge_rows)
    stacked = np.vstack(factors)
    return retriangulate(stacked)


def read(folder: str | Path, model: tuple[Chain, Dynamics] | None = None) -> Information:
    """Return the information of the identification stored in `folder`; `model`: its robot and model, read already.

    Raises:
        RobotError: where the folder holds none, or one of a version that did not write how parameters regroup.
    """
    folder = Path(folder)
    chain, dynamics = model or read_dynamics(folder)
    groups = read_table(folder).get("regrouping")
    if groups is None:
        raise RobotError(f"{folder}/dynamics.json lacks the regrouping of parameters; identify again")
    with refused_as(
        RobotError,
        (OSError, KeyError, ValueError),
        f"{folder}: estimate.csv, covariance.csv and dynamics.json do not agree: {{}}; identify again",
    ):
        parameters = read_estimate(folder)
        names = tuple(parameter.name for parameter in parameters)
        units = tuple(parameter.unit for parameter in parameters)
        values = np.array([parameter.value for parameter in parameters])
        _, covariance = read_covariance(folder)
        transform = _transform(names, groups, dynamics.model.names)
        if (folder / INFORMATION).is_file():
            factor = np.loadtxt(folder / INFORMATION, delimiter=",", skiprows=1, ndmin=2)
        else:
            require((np.diag(covariance) > 0.0).all(), "a parameter without variance", ValueError)
            factor = whitened(values, covariance)
        if covariance.shape != (len(names), len(names)) or factor.shape[1] != len(names) + 1:
            raise ValueError("files of different sizes")
    return Information(chain, dynamics, names, units, values, covariance, transform, factor)


def _transform(names: tuple[str, ...], groups: dict[str, dict[str, float]], standard: tuple[str, ...]) -> np.ndarray:
    """Return the regrouping matrix T (b, p) of standard parameters; rows of richer friction are unit rows."""
    column_of = {name: column for column, name in enumerate(standard)}
    transform = np.zeros((len(names), len(standard)))
    for row, name in enumerate(names):
        coefficients = groups.get(name, {name: 1.0})
        for standard_name, coefficient in coefficients.items():
            transform[row, column_of[standard_name]] = coefficient
    return transform


def write(identification: Identification, folder: Path) -> None:
    """Write the R factor of an identification's data (`_information`)."""
    files.write_numbers(folder / INFORMATION, (*identification.names, "target"), _information(identification))

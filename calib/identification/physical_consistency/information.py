"""Information of an identification on the standard parameters: ‖R T χ - z‖².

T regroups the p standard parameters χ of the model into the b parameters β that the motion identifies. R and z express
the estimate β with its covariance Σ as rows, RᵀR = Σ⁻¹ and z = R β. If the estimate includes a prior or constraints, R
and z are instead the R factor of the rows that were fitted (``information.csv``), those of the prior included. Prior
knowledge is therefore used twice. Of the data alone, the consistent parameters of a real Panda did not converge.
"""

from __future__ import annotations

import csv
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
    """An identified model with the information of its data.

    Attributes:
        chain: the robot of the identification.
        dynamics: the model with its base parameters as values.
        names, units: names and units of the b estimated parameters.
        values, covariance: (b,) and (b, b), the estimate as identified, including a prior if one was used.
        transform: regrouping matrix T (b, p).
        factor: (k, b + 1) rows [R z] of the data.
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
        """Minimum of ‖R β - z‖² (data's rows `factor`) over all β (b,), including physically inconsistent ones."""
        matrix = self.factor[:, :-1]
        target = self.factor[:, -1]
        unit = np.linalg.norm(matrix, axis=0)
        scaled = matrix / np.where(unit > 0.0, unit, 1.0)
        solution = np.linalg.lstsq(scaled, target, rcond=1e-12)[0]
        return float(np.sum((scaled @ solution - target) ** 2))

    def distance(self, standard: np.ndarray) -> float:
        """Return the Mahalanobis distance of standard parameters (p,) from the data's optimum."""
        base_values = self.transform @ standard
        residual = self.factor[:, :-1] @ base_values - self.factor[:, -1]
        square = float(residual @ residual) - self.best
        return float(np.sqrt(max(square, 0.0)))


def of(identification: Identification, chain: Chain) -> Information:
    """Return the information of the data of an identification (result in memory) of the robot `chain`."""
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
    """Return the R factor [R z] (b + 1, b + 1) of an identification's rows, without constraints.

    Rows are weighted according to their residuals' autocorrelation. They include those of the prior, and the ridges of
    additional friction once more.
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
        if identification.settings.earlier is not None and fitted.beforehand is not None:
            ridges = 1.0 / np.linalg.norm(fitted.beforehand, axis=0)
        ridge_rows = np.zeros((richer_count, base_count + richer_count + 1))
        richer_ridges = np.maximum(ridges[base_count:], 1e-12)
        ridge_rows[:, base_count:-1] = np.diag(1.0 / richer_ridges)
        factors.append(ridge_rows)
    stacked = np.vstack(factors)
    return retriangulate(stacked)


def read(folder: str | Path, model: tuple[Chain, Dynamics] | None = None) -> Information:
    """Return the information of the identification stored in `folder`.

    Args:
        folder: folder of the identification.
        model: robot and model of this folder, if they have been read already; None: they are read here.

    Raises:
        RobotError: if the folder contains no identification, or one of a version without the regrouping matrix.
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


def read_factor(folder: Path) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the names of the b parameters in a folder's ``information.csv``, and the rows [R z] (k, b + 1).

    Raises:
        RobotError: if the file is missing or damaged.
    """
    path = folder / INFORMATION
    with refused_as(RobotError, (OSError, ValueError), f"{path} cannot be read ({{}}); identify again"):
        with path.open(encoding="utf-8", newline="") as file:
            names = next(csv.reader(file), [])[:-1]
        factor = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
        require(factor.shape[1] == len(names) + 1, "names and columns differ in number", ValueError)
    return tuple(names), factor


def _transform(names: tuple[str, ...], groups: dict[str, dict[str, float]], standard: tuple[str, ...]) -> np.ndarray:
    """Return the regrouping matrix T (b, p) from standard parameters; rows of additional friction are unit rows.

    Args:
        names: names of the b estimated parameters.
        groups: for each base parameter, its standard parameters and their coefficients.
        standard: names of the p standard parameters.
    """
    column_of = {name: column for column, name in enumerate(standard)}
    transform = np.zeros((len(names), len(standard)))
    for row, name in enumerate(names):
        coefficients = groups.get(name, {name: 1.0})
        for standard_name, coefficient in coefficients.items():
            transform[row, column_of[standard_name]] = coefficient
    return transform


def write(identification: Identification, folder: Path) -> None:
    """Write the R factor [R z] of an identification's data to ``information.csv`` in `folder`.

    Args:
        identification: the result in memory.
        folder: an existing folder.
    """
    files.write_numbers(folder / INFORMATION, (*identification.names, "target"), _information(identification))

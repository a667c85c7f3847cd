"""Distribution of geometric parameters over arms of one type, and from it a prior for the next arm's fit.

With x_i the deviations of arm i's parameters from nominal, which its fit estimates as x̂_i with covariance C_i,

    x̂_i ~ N(x_i, C_i),  x_i ~ N(μ, diag τ²)

Mean μ and variances τ² are the most probable ones, by expectation maximisation (Dempster, Laird and Rubin 1977;
parametric empirical Bayes, Morris 1983). Two choices are ours, for fleets of a few arms. The nominal parameters count
as one more arm. A parameter's τ² is regularised towards that of its family (joint offsets, other angles, lengths), as
if `FAMILY` more arms had the family's τ². The next arm is expected at μ ± τ √(1 + 1/n), where n counts the nominal too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import UsageError, require
from calib.toolkit.chains import CalibratedChain, nominal_of, write_calibrated
from calib.toolkit.installations import Installation, families

# arms that the variance of a family of parameters counts as (our choice)
FAMILY = 4.0
# [m, rad] of the prior (our choice)
MIN_WIDTH = 1e-6
# of τ², [m², rad²], from which expectation maximisation starts
FIRST_VARIANCE = 1e-4
# it ends at this relative change of τ², or after so many updates (our choice)
SETTLED = 1e-4
MAX_UPDATES = 500
# in the prior's folder
OPTIONS = "options.toml"


@dataclass(frozen=True)
class ParameterSpread:
    """Distribution of one parameter over the arms of a type.

    Attributes:
        name, unit: name and unit of the parameter.
        arms: number of arms in which it was fitted.
        mean, sigma: mean and σ, over the arms, of the parameter's deviation from nominal; the uncertainty of the fits
            is not included in σ.
        width: standard deviation about ``nominal + mean`` that is expected for the next arm.
    """

    name: str
    unit: str
    arms: int
    mean: float
    sigma: float
    width: float


def spread(robots: Sequence[CalibratedChain]) -> tuple[ParameterSpread, ...]:
    """Return the distribution of each parameter that was fitted in at least one arm.

    Args:
        robots: calibrated arms with one nominal description.

    Raises:
        UsageError: no fit has a covariance.
    """
    chain = nominal_of(robots[0])
    covariances = []
    for robot in robots:
        covariance = robot.covariance
        if covariance is None:
            covariance = np.zeros((len(chain.values),) * 2)
        covariances.append(covariance)
    fitted = np.array([np.diag(covariance) > 0.0 for covariance in covariances])
    columns = np.flatnonzero(fitted.any(axis=0))
    require(len(columns), "no fit of these arms states the covariance of its geometry; fit them again", UsageError)

    data = []
    for robot, covariance, fitted_in_arm in zip(robots, covariances, fitted[:, columns]):
        k = columns[fitted_in_arm]
        information = np.linalg.inv(covariance[np.ix_(k, k)])
        deviations = (robot.chain.values - chain.values)[k]
        data.append((fitted_in_arm, information, information @ deviations))
    _, family = np.unique(families(Installation(chain))[columns], return_inverse=True)
    mean, sigma = _most_probable(data, family)
    count = fitted[:, columns].sum(axis=0)
    width = np.maximum(sigma * np.sqrt(1.0 + 1.0 / (count + 1)), MIN_WIDTH)

    parameters = []
    for row, k in enumerate(columns):
        parameters.append(
            ParameterSpread(
                name=chain.names[k],
                unit=chain.elements[k].unit,
                arms=int(count[row]),
                mean=float(mean[row]),
                sigma=float(sigma[row]),
                width=float(width[row]),
            )
        )
    return tuple(parameters)


def _most_probable(
    data: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], family: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean μ (k,) and standard deviation τ (k,) of k parameters over the arms, by expectation maximisation.

    Args:
        data: for each arm, whether each parameter was fitted (k,), and of the f fitted ones the inverse C⁻¹ (f, f) of
            the covariance, and C⁻¹ x̂ (f,) with the fitted deviations x̂ from nominal.
        family: (k,) number of each parameter's family (joint offsets, other angles, lengths).
    """
    mean = np.zeros(len(family))
    variance = np.full(len(family), FIRST_VARIANCE)
    count = np.sum([fitted for fitted, _, _ in data], axis=0)
    for _ in range(MAX_UPDATES):
        total = np.zeros_like(mean)
        square = np.zeros_like(mean)
        estimates = []
        for fitted, information, pull in data:
            covariance = np.linalg.inv(information + np.diag(1.0 / variance[fitted]))
            estimate = covariance @ (pull + mean[fitted] / variance[fitted])
            total[fitted] += estimate
            square[fitted] += np.diag(covariance)
            estimates.append((fitted, estimate))
        mean = total / (count + 1)
        for fitted, estimate in estimates:
            square[fitted] += (estimate - mean[fitted]) ** 2
        # the nominal counts as an arm
        square += mean**2
        pooled = np.bincount(family, square) / np.bincount(family, count)
        earlier_variance = variance
        variance = np.maximum((FAMILY * pooled[family] + square) / (FAMILY + count), MIN_WIDTH**2)
        if np.abs(np.log(variance / earlier_variance)).max() < SETTLED:
            break
    return mean, np.sqrt(variance)


def expected_arm(robots: Sequence[CalibratedChain], parameters: Sequence[ParameterSpread]) -> CalibratedChain:
    """Return the arm expected next: the nominal description with the mean deviations added to its parameters.

    Args:
        robots: calibrated arms with one nominal description.
        parameters: distribution of each fitted parameter over these arms.
    """
    nominal = nominal_of(robots[0])
    means = {parameter.name: parameter.mean for parameter in parameters}
    values = nominal.values + np.array([means.get(name, 0.0) for name in nominal.names])
    return replace(robots[0], chain=nominal.with_values(values), nominal=nominal, covariance=None, corrections=None)


def write(folder: Path, robots: Sequence[CalibratedChain], parameters: Sequence[ParameterSpread]) -> Path:
    """Write the prior for `calib fit` into a folder, and return its path.

    ``robot.toml`` is the expected arm; the options file contains the prior's standard deviations.

    Args:
        folder: the folder.
        robots: calibrated arms with one nominal description.
        parameters: distribution of each fitted parameter over these arms.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_calibrated(folder, expected_arm(robots, parameters), comment=f"mean of {len(robots)} arms")
    lines = [f'"{parameter.name}" = {parameter.width:.4g}' for parameter in parameters]
    files.write(folder / OPTIONS, "\n".join(["[prior]", *lines, ""]))
    return folder

"""What is known before any data: the CAD's inertias, or only the order of sizes; how strongly, the evidence says.

Base parameters θ = T χ of standard ones χ ~ N(χ_CAD, f² S) have the prior N(T χ_CAD, f² T S Tᵀ). The one number f is
where the marginal likelihood of the data is largest,

    log p(y | f) = -½ [log det C + eᵀ C⁻¹ e] + const,   C = I + R P Rᵀ,   e = z - R μ,

with [R z] the triangle of the whitened [W y], μ and P the prior's mean and covariance (MacKay 1992). Directions that
the motion tells well do not feel the prior; those that it does not tell stay at the CAD's values. It does not make the
parameters those of possible bodies: that is the semidefinite fit of another module; but with a prior, `bounded` keeps
inertia and friction of the drives from being negative.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.optimize

from calib.arrays import frozen
from calib.dynamics.base import Base
from calib.dynamics.regressor_model import RegressorModel
from calib.errors import UsageError
from calib.estimation.triangles import Triangles, retriangulate

SCALES = tuple(float(10.0 ** (k / 4)) for k in range(-6, 7))  # f from 0.03 to 30
MOST = 1.0  # largest f of a CAD prior: what no model explains must not pass for a wrong CAD (our choice)
SPREAD = 0.3  # of a CAD value: standard deviation at f = 1 (our choice)
LEVER = 0.03  # of a centre of mass [m]
RADIUS = 0.08  # of gyration [m]
DRIVES = 3.0  # terms without CAD: standard deviation in units of what would explain all of the torque
ROTOR = 0.15  # [m]: motor inertias are of the order of the robot's mass times its square, seen from the joint
TOLD = 0.5  # a parameter whose variance the data lower by less than this share rests on the prior


@dataclass(frozen=True, eq=False)
class Prior:
    """A normal prior of b base parameters.

    Attributes:
        mean: (b,).
        covariance: (b, b).
        scale: f.
        source: ``cad`` or ``sizes``.
    """

    mean: np.ndarray
    covariance: np.ndarray
    scale: float
    source: str

    @property
    def rows(self) -> np.ndarray:
        """(b, b + 1) the prior as rows of [W y], already whitened."""
        unit = np.sqrt(np.diag(self.covariance))
        lower = np.linalg.cholesky(self.covariance / np.outer(unit, unit) + 1e-9 * np.eye(len(unit)))
        inverse = scipy.linalg.solve_triangular(lower, np.diag(1.0 / unit), lower=True)
        return np.hstack([inverse, (inverse @ self.mean)[:, None]])


def find_prior(
    cad: np.ndarray | None, model: RegressorModel, base: Base, data: Triangles, std: np.ndarray,
    inflation: np.ndarray, wanted: str = "auto",
) -> Prior:  # fmt: skip
    """Return the prior whose strength the evidence chose.

    Args:
        cad: the first of the model's parameters by the robot's description; None where it holds no masses.
        data: triangles of the base columns, one group per row.
        std, inflation: (rows,) of the residuals.
        wanted: ``cad``: these must be there; ``auto``: sizes alone serve where they are not.
    """
    weight = 1.0 / (std * np.sqrt(inflation))
    factor = retriangulate((data.factors * weight[:, None, None]).reshape(-1, data.parameters + 1))
    mean, covariance, source = _shape(cad, model, base, data, wanted)
    drives = model.inertial
    inertial = np.array([k < drives for k in base.kept])
    both = np.outer(inertial, inertial)
    scales = [f for f in SCALES if source != "cad" or f <= MOST]
    found = [_evidence(factor, mean, np.where(both, f**2, 1.0) * covariance) for f in scales]
    scale = scales[int(np.argmax(found))]
    return Prior(frozen(mean), frozen(np.where(both, scale**2, 1.0) * covariance), scale, source)


def resting(prior: Prior, covariance: np.ndarray) -> np.ndarray:
    """Return (b,) which parameters rest on the prior: the data lower their variance by less than `TOLD`."""
    b = len(prior.mean)
    return np.diag(covariance)[:b] > (1.0 - TOLD) * np.diag(prior.covariance)


def _shape(
    own: np.ndarray | None, model: RegressorModel, base: Base, data: Triangles, wanted: str
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return mean, covariance at f = 1, and where they come from."""
    bodies = model.inertial
    squares = np.sum(data.factors**2, axis=(0, 1))
    size = np.sqrt(squares[-1] / np.maximum(squares[:-1], 1e-12 * squares[:-1].max()))  # would explain all of y
    if own is None:
        if wanted == "cad":
            raise UsageError("prior = 'cad', but the robot's description holds no masses")
        return np.zeros(base.b), np.diag(np.where(base.kept < bodies, size, DRIVES * size) ** 2), "sizes"
    cad = np.zeros(len(base.standard))
    cad[: len(own)] = own
    spread = np.zeros(len(base.standard))
    for first in range(0, len(own), 10):
        body = own[first : first + 10]
        mass = max(body[9], 0.02 * float(own[9::10].max()))
        spread[first : first + 6] = SPREAD * np.abs(body[:6]) + mass * RADIUS**2
        spread[first + 6 : first + 9] = SPREAD * np.abs(body[6:9]) + mass * LEVER
        spread[first + 9] = SPREAD * mass
    covariance = base.transform @ np.diag(spread**2) @ base.transform.T
    mean = base.transform @ cad
    for row, k in enumerate(base.kept):
        if k >= len(own):  # drives, payloads
            covariance[row, :] = covariance[:, row] = 0.0
            covariance[row, row] = (DRIVES * size[row]) ** 2
            if k >= bodies and model.columns[k - bodies].shape == "acceleration":
                covariance[row, row] = min(covariance[row, row], (float(own[9::10].sum()) * ROTOR**2) ** 2)
    return mean, covariance, "cad"


def _evidence(factor: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> float:
    """Return the log marginal likelihood but for a constant."""
    p = len(mean)
    upper, target = factor[:p, :p], factor[:p, p]
    rest = target - upper @ mean
    c = np.eye(p) + upper @ covariance @ upper.T
    lower = np.linalg.cholesky(c)
    white = scipy.linalg.solve_triangular(lower, rest, lower=True)
    return float(-np.log(np.diag(lower)).sum() - 0.5 * white @ white)


def bounded(factor: np.ndarray, nonnegative: np.ndarray) -> np.ndarray:
    """Return argmin ‖R x - z‖² with some parameters (motor inertias, viscous and Coulomb friction) not negative.

    Args:
        factor: (p + 1, p + 1) triangle of data and prior, whitened.
        nonnegative: (p,) bool.
    """
    p = len(nonnegative)
    lower = np.where(nonnegative, 0.0, -np.inf)
    norms = np.linalg.norm(factor[:p, :p], axis=0)
    found = scipy.optimize.lsq_linear(factor[:p, :p] / norms, factor[:p, p], (lower, np.inf), method="bvls")
    return found.x / norms

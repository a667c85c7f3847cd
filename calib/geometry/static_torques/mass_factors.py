"""Masses of an arm as unknowns of its fit, where poses under several stated loads separate them from the compliance.

Gravity turns an element by c (m_load(q) + Σ_i m_i(q, f_i, Δ_i)): c is its compliance, m_load the moment
of the stated load, m_i that of body i. f_i is the logarithm of the factor of its described mass, Δ_i [m] the change of
its centre of mass. Their prior is normal: all bodies have one factor in common, as descriptions of another arm of the
family or without motors do, and each has one of its own. The estimate is the most probable one, by Gauss–Newton steps
in which the parameters of the fit move along. Under a single load only the product of c and the masses is determined,
and the prior remains. The fit's prior of c has a width estimated from the same rows. It is taken as the prior of that
product, the deflection: a prior of c alone, fixed during a step, would draw c to zero and the masses to large values.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.errors import Finding, finding
from calib.geometry.installation import Installation
from calib.geometry.observation import layout, prepare
from calib.geometry.static_torques.gravity_fit import carried_load, reference_masses
from calib.geometry.static_torques.load_errors import load_masses, load_motions
from calib.geometry.static_torques.sources import with_stated_load
from calib.geometry.weighing import GeometricFit
from calib.robot.calibrated import BY_TORQUE
from calib.robot.chain import Chain

# prior standard deviations of the logarithm of the factor that all masses have in common, and of that of a single
# body, of described masses (our choice)
DESCRIBED_FACTOR = 0.5, 0.3
# the same of the masses of a usual arm, of bodies whose masses are not described (our choice)
USUAL_FACTOR = 1.0, 0.5
# prior standard deviation of a centre of mass, as a share of the arm's length (our choice)
CENTRE_SHARE = 0.05
# [kg/m²] mass of a usual arm over the square of its length (our choice)
USUAL_MASS = 40.0
# largest change of a logarithm in one step, and change in standard deviations below which the steps end (our choice)
MAX_STEP, SETTLED = 1.0, 0.1
# step of the differences by which the residuals' derivatives are computed, in standard deviations of the prior (our
# choice)
DIFFERENCE = 0.02
# standard deviations by which the total mass has to differ from the described one to be stated (our choice)
MIN_SIGMAS = 3.0
# standard deviations at the limit of an interval of 95 %
LIMIT = 1.96
# [kg] load whose deflection is compared with its doubt: any does, since both grow with it; every arm carries this one
TEST_LOAD = 1e-3
# size of a column below which gravity does not turn its element
TINY = 1e-12


@dataclass(frozen=True, eq=False)
class MassFactors:
    """Unknown masses of an arm of n bodies: logarithms of factors (n), then changes of centres of mass (3 n) [m].

    Attributes:
        chain: the nominal arm, with described masses; of bodies without, with those of a usual arm.
        values, prior: (4 n,) most probable unknowns so far, and (4 n, 4 n) covariance of their prior.
        covariance: (4 n, 4 n) posterior covariance; the prior before the first step.
        doubt: standard deviation of a load's deflection due to the masses, as a share of it.
        described: (n,) mask of the bodies whose masses are those of the description.
    """

    chain: Chain
    values: np.ndarray
    prior: np.ndarray
    covariance: np.ndarray
    doubt: float
    described: np.ndarray

    @classmethod
    def before(cls, chain: Chain) -> "MassFactors":
        """Return the unknowns of a nominal arm before any measurement."""
        described = np.zeros(chain.n, dtype=bool) if chain.inertias is None else chain.inertias[:, 9] > 0.0
        masses = reference_masses(replace(chain, inertias=None))
        masses *= USUAL_MASS * chain.stretched_length() ** 2 / masses[:, 9].sum()
        if chain.inertias is not None:
            masses[described] = chain.inertias[described]
        n = chain.n
        prior = np.diag(np.full(4 * n, (CENTRE_SHARE * chain.stretched_length()) ** 2))
        prior[:n, :n] = 0.0
        for bodies, (common, single) in ((described, DESCRIBED_FACTOR), (~described, USUAL_FACTOR)):
            prior[:n, :n] += common**2 * np.outer(bodies, bodies) + single**2 * np.diag(bodies)
        doubt = float(np.sqrt(np.max(np.diag(prior)[:n])))
        return cls(replace(chain, inertias=masses), np.zeros(4 * n), prior, prior, doubt, described)

    @property
    def masses(self) -> np.ndarray:
        """Most probable standard parameters (n, 10); their gravity torques are right, single parameters are not."""
        return self._masses(self.values)

    def _masses(self, values: np.ndarray) -> np.ndarray:
        n = self.chain.n
        result = np.array(self.chain.inertias)
        result[:, 6:9] += result[:, 9:] * values[n:].reshape(n, 3)
        return result * np.exp(values[:n, None])

    def change_from(self, earlier: "MassFactors") -> float:
        """Return the largest change of the unknowns since an earlier step, in standard deviations of the posterior."""
        return float(np.max(np.abs(self.values - earlier.values) / np.sqrt(np.diag(self.covariance))))

    def blocks(self, measured: Sequence[PoseMeasurements], masses: np.ndarray) -> list[PoseMeasurements]:
        """Return blocks with the torques of other masses (n, 10), and of the stated loads."""
        chain = replace(self.chain, inertias=masses)
        return [with_stated_load(chain, block) for block in measured]

    def step(self, fit: GeometricFit, measured: Sequence[PoseMeasurements]) -> "MassFactors":
        """Return the unknowns after one Gauss–Newton step.

        Args:
            fit: a fit with compliance by torques of the present masses.
            measured: the fitted blocks, with the torques of these masses.
        """
        residual, by_masses, by_fit = self._derivatives(fit, measured)
        slope = -fit.estimate.covariance @ by_fit.T @ by_masses
        # the fit's parameters move along, and take with them what they explain
        precision = np.linalg.inv(self.prior)
        information = by_masses.T @ by_masses + by_masses.T @ by_fit @ slope + precision
        covariance = np.linalg.inv(0.5 * (information + information.T))
        change = covariance @ (by_masses.T @ residual - precision @ self.values)
        n = self.chain.n
        change /= max(1.0, float(np.max(np.abs(change[:n]))) / MAX_STEP)
        doubt = self._doubt(fit, measured, slope, covariance)
        return replace(self, values=self.values + change, covariance=covariance, doubt=doubt)

    def _derivatives(
        self, fit: GeometricFit, measured: Sequence[PoseMeasurements]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return whitened residuals (N,) of rows and of the compliance's prior, and the derivatives of the predictions.

        These are by the unknowns (N, 4 n), from differences, and by the fit's parameters (N, f).

        Args:
            fit, measured: arguments of `step`.
        """
        noise = fit.estimate.residual_std
        residual, by_fit = fit.whitened_rows(fit.cell, fit.blocks, fit.free)
        positions = _compliance_positions(fit)
        sizes = np.linalg.norm(by_fit[:, positions], axis=0)
        columns, growths = [], []
        for number, variance in enumerate(np.diag(self.prior)):
            difference = DIFFERENCE * np.sqrt(variance)
            values = self.values.copy()
            values[number] += difference
            masses = self._masses(values)
            cell = _of_masses(fit.cell, masses)
            blocks = prepare(cell, self.blocks(measured, masses))
            changed, by_compliance = fit.whitened_rows(cell, blocks, fit.free[positions])
            # a residual is measured minus predicted
            columns.append((residual - changed) / difference)
            growths.append((np.linalg.norm(by_compliance, axis=0) - sizes) / np.maximum(sizes, TINY) / difference)
        by_masses = np.stack(columns, axis=1) / noise
        # the prior of a compliance is one of its deflection: it narrows as the masses grow
        prior = np.full(len(fit.free), np.inf) if fit.prior is None else fit.prior
        in_sigmas = np.asarray(fit.estimate.values)[positions] / prior[positions]
        widths = np.zeros((len(positions), len(fit.free)))
        widths[np.arange(len(positions)), positions] = 1.0 / prior[positions]
        residual = np.concatenate([residual / noise, -in_sigmas])
        by_masses = np.concatenate([by_masses, in_sigmas[:, None] * np.stack(growths, axis=1)])
        return residual, by_masses, np.concatenate([by_fit / noise, widths])

    def _doubt(
        self, fit: GeometricFit, measured: Sequence[PoseMeasurements], slope: np.ndarray, covariance: np.ndarray
    ) -> float:
        """Return the standard deviation of the deflection by a load at the fitted poses, as a share of it.

        That of its logarithm is computed. The deflection is log-normal, and the share is that of its upper limit.

        Args:
            fit, measured: arguments of `step`.
            slope: (f, 4 n) change of the fit's parameters per unknown.
            covariance: (4 n, 4 n) posterior covariance of the unknowns.
        """
        chain = fit.cell.chain
        compliance, slopes = _compliance_slopes(fit, slope)
        test_load = carried_load(chain, np.array([[TEST_LOAD, 0.0, 0.0, 0.0]]))
        total, doubtful = 0.0, 0.0
        for block in measured:
            motions = load_motions(fit.cell, replace(block, load=np.tile(test_load, (len(block), 1))))
            total += float(np.sum(np.einsum("k,kim->im", compliance, motions) ** 2))
            by_unknown = np.einsum("ku,kim->uim", slopes, motions).reshape(len(self.values), -1)
            doubtful += float(np.sum((covariance @ by_unknown) * by_unknown))
        of_logarithm = float(np.sqrt(doubtful / max(total, 1e-300)))
        return float(np.expm1(LIMIT * of_logarithm)) / LIMIT

    def findings(self) -> list[Finding]:
        """Return findings: the doubt of a load's deflection, and masses that together differ from a description.

        Neighbours share the moment of a body: gravity does not tell its mass where theirs are not described.
        """
        doubt = [finding("load-unlearnt", doubt=self.doubt)]
        if not self.described.all():
            return doubt
        described = np.asarray(self.chain.inertias)[:, 9]
        masses = self.masses[:, 9]
        factor = float(masses.sum() / described.sum())
        shares = masses / masses.sum()
        n = self.chain.n
        sigma = float(np.sqrt(shares @ self.covariance[:n, :n] @ shares))
        if abs(np.log(factor)) < MIN_SIGMAS * sigma:
            return doubt
        return [*doubt, finding("masses-scaled", factor=factor, sigma=factor * sigma)]


def several_loads(measured: Sequence[PoseMeasurements]) -> bool:
    """Return whether poses were measured under several stated loads."""
    return any(block.payload is not None for block in measured) and len(load_masses(measured)) > 1


def _compliance_slopes(fit: GeometricFit, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the fitted compliance (K,) of each element [rad/(N m)], and its change (K, u) per unknown.

    Args:
        fit: a fit with compliance by torques.
        slope: (f, u) change of the fit's parameters per unknown.
    """
    cell = fit.cell
    chain = cell.chain
    elements = {name: number for number, name in enumerate(chain.names)}
    numbers = layout(cell).index("deflection").tolist()
    compliance = np.zeros(len(chain.elements))
    slopes = np.zeros((len(chain.elements), slope.shape[1]))
    for position in _compliance_positions(fit):
        number = numbers.index(fit.free[position])
        element = elements[cell.deflection.terms[number].element]
        compliance[element] += np.asarray(cell.deflection.coefficients)[number]
        slopes[element] += slope[position]
    return compliance, slopes


def _compliance_positions(fit: GeometricFit) -> np.ndarray:
    """Return the positions (k,) of the coefficients of compliance by torques among a fit's parameters."""
    numbers = layout(fit.cell).index("deflection")
    by_torque = [term.basis in BY_TORQUE for term in fit.cell.deflection.terms]
    return np.flatnonzero(np.isin(fit.free, numbers[by_torque]))


def _of_masses(cell: Installation, masses: np.ndarray) -> Installation:
    """Return an installation whose compliance is driven by other masses (n, 10)."""
    reference = cell.deflection.reference
    assert reference is not None
    deflection = replace(cell.deflection, reference=replace(reference, inertias=masses))
    return replace(cell, deflection=deflection)

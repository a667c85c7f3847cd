"""Equations of the joint estimate of geometry and dynamics: rows, priors, solution, and widening of its covariance.

The cost that is minimised, and its symbols, stand in `calib.identification.uncertainty.joint_estimate`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

from calib.data.signals.filtering import Decimator, kept
from calib.dynamics import rigid_body
from calib.dynamics.torque_rows import BODIES
from calib.identification.identify import Identification, common_decimator
from calib.identification.physical_consistency.information import of as information_of
from calib.identification.physical_consistency.solve import find_possible
from calib.identification.prior import residual_inflation
from calib.identification.rows import Case, observe
from calib.identification.settings import IdentificationSettings, Payload, make_bodies, make_model
from calib.identification.uncertainty.geometry_uncertainty import STEP, TILTS
from calib.robot.chain import Chain

GAIN = 0.01
"""Standard deviation of the gain of a torque row from 1 (our choice): torque sensors, torque constants."""
MASS_SHARE = 0.005
"""Standard deviation of a payload's stated mass, as a share of it (our choice)."""
CENTRE = 1e-3
"""Standard deviation of a payload's stated centre of mass [m] (our choice)."""
FOLDS = 4
"""Folds of held-out blocks (our choice)."""
PIECES = 2 * FOLDS
"""Contiguous pieces of time of which the folds consist."""
BLOCKS = 40
"""Blocks of time, about, whose products of rows are kept (our choice)."""
BINS = 10
"""Groups of equal velocity or position, with equal numbers of rows (our choice)."""
BLOCK_COUNTS = (40, 20, 10)
"""Numbers of blocks whose scores are compared (our choice)."""
FIRST_MOMENTS = slice(6, 10)
"""MX, MY, MZ and M among the ten standard parameters of a body."""
FIXED = 1e12
"""Precision of a parameter that the identification fixes, relative to that of its data."""
LEAST_SCALE = 1e-9
"""Least diagonal of a precision, relative to that of the data, by which its rows and columns are scaled."""
SINGULAR = 1e-10
"""Relative eigenvalue of a correlation matrix below which its inverse leaves a combination out."""


def changed(chain: Chain, settings: IdentificationSettings, change: np.ndarray) -> tuple[Chain, IdentificationSettings]:
    """Return the chain and the settings with changed geometry and direction of gravity.

    Args:
        chain: the arm with K elements.
        settings: settings of the identification.
        change: (K + 2,) change of the element values [m or rad], and tilts of gravity [rad].
    """
    count = len(chain.elements)
    gravity = chain.gravity if settings.gravity is None else np.array(settings.gravity)
    turn = Rotation.from_rotvec([change[count], change[count + 1], 0.0])
    turned = turn.apply(np.array(gravity))
    changed_chain = replace(chain.with_values(chain.values + change[:count]), gravity=turned)
    if settings.gravity is not None:
        settings = replace(settings, gravity=tuple(turned.tolist()))
    return changed_chain, settings


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution of one linearisation.

    Attributes:
        change: (K,) change of the elements from the geometry before the torques [m or rad].
        values: (p,) parameters of bodies and drives, then the gains' deviations from 1.
        covariance: (K, K) covariance of the change.
        gain_sigma: (rows,) standard deviations of the gains.
    """

    change: np.ndarray
    values: np.ndarray
    covariance: np.ndarray
    gain_sigma: np.ndarray


@dataclass(frozen=True, eq=False)
class JointProblem:
    """Rows and priors of a joint estimate about an identification.

    Attributes:
        identification: the identification whose weights and prior are used.
        settings: its settings, with the direction of gravity before the torques.
        chain: the arm before the torques.
        cases: training recordings.
        free: (K,) indices of the estimated elements and tilts.
        prior: (K, K) their covariance before the torques.
        doubted: labels of payloads whose stated mass and centre are not used.
    """

    identification: Identification
    settings: IdentificationSettings
    chain: Chain
    cases: tuple[Case, ...]
    free: np.ndarray
    prior: np.ndarray
    doubted: tuple[str, ...]

    @property
    def computed(self) -> np.ndarray:
        """Indices of the model's columns that are computed anew: the bodies', and regrouped ones of drives."""
        base = self.identification.base
        inertial = self.identification.dynamics.model.inertial
        dropped = np.setdiff1d(np.arange(len(base.standard)), base.kept)
        return np.concatenate([np.arange(inertial), dropped[dropped >= inertial]])

    @property
    def columns(self) -> np.ndarray:
        """Indices of the drives' columns among those of the identification's rows."""
        base = self.identification.base
        inertial = self.identification.dynamics.model.inertial
        of_drives = np.flatnonzero(base.kept >= inertial)
        friction = np.arange(base.b, len(self.identification.names))
        return np.concatenate([of_drives, friction])

    @cached_property
    def beforehand(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Most probable parameters (p,) of the identification, and precision (p, p) and pull (p,) of their prior.

        The inertias are physically consistent; their prior is quadratic about them.
        """
        identification = self.identification
        base = identification.base
        information = information_of(identification, self.chain)
        possible = find_possible(information)
        friction = [identification.dynamics.model.names.index(name) for name in identification.names[base.b :]]
        drives = base.kept[self.columns[self.columns < base.b]]
        index = np.concatenate([self.computed, drives, friction]).astype(int)
        values = possible.dynamics.values
        # data of the identification alone, and the slope of their cost at the most probable values
        factor = information.factor[:, :-1] @ information.transform / possible.doubt
        target = information.factor[:, -1] / possible.doubt
        slope = factor.T @ (factor @ values - target)
        covariance = possible.covariance[np.ix_(index, index)]
        # precision of the prior: of the estimate, less that of the data
        free = np.diag(covariance) > 0.0
        precision = np.zeros_like(covariance)
        data = factor[:, index].T @ factor[:, index]
        precision[np.ix_(free, free)] = scaled_inverse(covariance[np.ix_(free, free)]) - data[np.ix_(free, free)]
        precision = _nonnegative((precision + precision.T) / 2.0, np.diag(data))
        fixed = np.flatnonzero(~free)
        precision[fixed, fixed] += FIXED * (1.0 + np.diag(data)[fixed])
        values = values[index]
        pull = precision @ values + np.where(free, slope[index], 0.0)
        of_friction = np.arange(len(index) - len(friction), len(index))
        if len(of_friction) and identification.fitted.beforehand is not None:
            ridges = np.sum(identification.fitted.beforehand**2, axis=0)[base.b :]
            precision[of_friction, of_friction] += ridges
        return values, precision, pull

    @cached_property
    def deviation(self) -> np.ndarray:
        """Standard deviation (rows,) of the torques [N m or N], raised by the residuals' autocorrelation.

        The identification limits this autocorrelation, since it weighs rows by it; here it states a covariance.
        """
        fitted = self.identification.fitted
        autocorrelation = residual_inflation(self.identification.rows, fitted.estimate.values)
        return np.array(fitted.std) * np.sqrt(np.maximum(fitted.inflation, autocorrelation))

    def start(self) -> np.ndarray:
        """Return the parameters (p,) to start with, then the gains' deviations (rows,) from 1."""
        return np.concatenate([self.beforehand[0], np.zeros(len(self.identification.fitted.std))])

    @cached_property
    def parameters_prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Precision and pull of the prior of parameters and gains, with those of stated payloads."""
        _, of_parameters, pull = self.beforehand
        gains = np.full(len(self.identification.fitted.std), GAIN**-2.0)
        precision = scipy.linalg.block_diag(of_parameters, np.diag(gains))
        pull = np.concatenate([pull, np.zeros(len(gains))])
        bodies = self.identification.dynamics.model.bodies
        for label, payload in self.settings.payloads.items():
            if payload.parameters is None or label in self.doubted:
                continue
            first = 10 * bodies.labels.index(label)
            moments = np.arange(first, first + 10)[FIRST_MOMENTS]
            information, stated = payload_information(payload)
            precision[np.ix_(moments, moments)] += information
            pull[moments] += information @ stated
        return precision, pull

    def whitened_rows(self, change: np.ndarray, values: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the whitened rows [W, W χ, ∂(W χ)/∂g, y] (M, rows, P + 1) of each case, y with the change's effect."""
        identification = self.identification
        of_elements = np.zeros(len(self.chain.elements) + len(TILTS))
        of_elements[self.free] = change
        chain, settings = changed(self.chain, self.settings, of_elements)
        model = make_model(chain, settings)
        decimator = common_decimator(self.cases, settings)
        inertial = model.inertial
        columns = self.columns
        row_count = len(identification.fitted.std)
        for case, rows in zip(self.cases, identification.rows):
            observed = observe(model, self.computed, case, decimator)
            slopes = self._slopes(chain, settings, case, decimator, values[:inertial])
            target = rows.target + slopes @ change
            of_parameters = np.concatenate([observed.matrix, rows.matrix[:, :, columns]], axis=2)
            predicted = of_parameters @ values[: of_parameters.shape[2]]
            gains = predicted[:, :, None] * np.eye(row_count)
            matrix = np.concatenate([of_parameters, gains, slopes, target[:, :, None]], axis=2)
            yield matrix * (rows.weight / self.deviation)[:, :, None]

    def products(self, change: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the products (blocks, P + 1, P + 1) of the whitened rows of about `BLOCKS` blocks of time."""
        total = sum(len(rows.target) for rows in self.identification.rows)
        result = []
        for matrix in self.whitened_rows(change, values):
            count = max(1, round(BLOCKS * len(matrix) / total))
            for block in np.array_split(matrix, count):
                flat = block.reshape(-1, block.shape[2])
                result.append(flat.T @ flat)
        return np.array(result)

    def _slopes(
        self, chain: Chain, settings: IdentificationSettings, case: Case, decimator: Decimator, values: np.ndarray
    ) -> np.ndarray:
        """Return ∂(W χ)/∂g (M, rows, K) at the decimated samples."""
        index = kept(case.motion.segment, decimator)
        states = [np.asarray(series[index]) for series in case.links]
        model = make_model(chain, settings)
        parameters = values * model.carried_columns(case.carried)
        slopes = np.zeros((len(index), model.bodies.n, len(self.free)))
        for column, element in enumerate(self.free):
            for sign in (1.0, -1.0):
                step = np.zeros(len(chain.elements) + len(TILTS))
                step[element] = sign * STEP
                bodies = make_bodies(*changed(chain, settings, step))
                torque = rigid_body.inverse_dynamics(bodies, parameters, *states)
                slopes[:, :, column] += sign / (2.0 * STEP) * torque
        acts = (BODIES,) * len(self.free)
        return model.torque_rows.observe(slopes, acts, states[0], states[1])

    def solve(self, products: np.ndarray, freed: bool = True) -> Solution:
        """Return the solution of one linearisation.

        Args:
            products: products of whitened rows.
            freed: whether the geometry is estimated; otherwise it is that before the torques.
        """
        total = products.sum(axis=0)
        p = len(total) - 1 - len(self.free)
        matrix = total[:-1, :-1].copy()
        right = total[:-1, -1].copy()
        precision, pull = self.parameters_prior
        matrix[:p, :p] += precision
        right[:p] += pull
        matrix[p:, p:] += scaled_inverse(self.prior)
        if not freed:
            matrix, right = matrix[:p, :p], right[:p]
        unit = np.sqrt(np.diag(matrix))
        factor = scipy.linalg.cho_factor(matrix / np.outer(unit, unit))
        solution = np.zeros(len(total) - 1)
        solution[: len(unit)] = scipy.linalg.cho_solve(factor, right / unit) / unit
        covariance = scipy.linalg.cho_solve(factor, np.eye(len(unit))) / np.outer(unit, unit)
        gain_sigma = np.sqrt(np.diag(covariance)[p - len(self.identification.fitted.std) : p])
        return Solution(solution[p:], solution[:p], covariance[p:, p:], gain_sigma)

    def _geometric(self, products: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the map (K, P) from scores of all columns to those of the geometry alone, and its information."""
        total = products.sum(axis=0)
        p = len(total) - 1 - len(self.free)
        precision, _ = self.parameters_prior
        inner = total[:p, :p] + precision
        unit = np.sqrt(np.diag(inner))
        factor = scipy.linalg.cho_factor(inner / np.outer(unit, unit))
        gain = scipy.linalg.cho_solve(factor, total[:p, p:-1] / unit[:, None]) / unit[:, None]
        selection = np.hstack([-gain.T, np.eye(len(self.free))])
        information = total[p:-1, p:-1] - total[p:-1, :p] @ gain
        return selection, (information + information.T) / 2.0

    def widening(self, products: np.ndarray, change: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return by direction the ratio (K,) of the scores' variance over groups of rows to the stated one, at least 1.

        Groups are blocks of time of several lengths, and rows of one joint with about the same velocity or position:
        friction that the model lacks has the same errors in every period of a motion, and no block of time shows them.
        """
        selection, information = self._geometric(products)
        directions = self._directions(information)
        variance = np.einsum("ki,kl,li->i", directions, information, directions)
        project = selection.T @ directions
        solution = np.concatenate([values, change, [-1.0]])
        decimator = common_decimator(self.cases, self.settings)
        # scores of each direction: derivatives of the cost by row
        scores = []
        for matrix in self.whitened_rows(change, values):
            residual = matrix @ solution
            scores.append(matrix[:, :, :-1] @ project * residual[:, :, None])
        all_scores = np.concatenate(scores)
        index = [kept(case.motion.segment, decimator) for case in self.cases]
        positions = np.concatenate([case.motion.q[k] for case, k in zip(self.cases, index)])
        velocities = np.concatenate([case.motion.v[k] for case, k in zip(self.cases, index)])

        # groups: number of the group of each row and sample
        count = len(all_scores)
        groupings = []
        for blocks in BLOCK_COUNTS:
            of_time = np.arange(count) * blocks // count
            groupings.append(np.repeat(of_time[:, None], all_scores.shape[1], axis=1))
        for states in (positions, velocities):
            joints = np.arange(all_scores.shape[1]) % states.shape[1]
            ranks = np.argsort(np.argsort(states, axis=0), axis=0)
            bins = (ranks * BINS // count)[:, joints]
            groupings.append(bins + BINS * np.arange(len(joints)))
        # squared sums of scores over groups: on average the stated variance, if rows are independent
        ratio = np.ones(len(variance))
        effective = variance > 0.0
        for groups in groupings:
            sums = np.zeros((groups.max() + 1, len(variance)))
            np.add.at(sums, groups.ravel(), all_scores.reshape(-1, len(variance)))
            squares = np.sum(sums**2, axis=0)
            ratio[effective] = np.maximum(ratio[effective], squares[effective] / variance[effective])
        return ratio

    def widened(self, products: np.ndarray, solution: Solution, widening: np.ndarray) -> Solution:
        """Return the solution with the torques' information of each direction divided by its widening (K,)."""
        _, information = self._geometric(products)
        directions = self._directions(information)
        strength = np.clip(np.einsum("ki,kl,li->i", directions, information, directions), 0.0, None)
        trusted = strength / widening
        # share of the torques in the estimate, with and without the widening
        share = np.divide(strength, 1.0 + strength)
        widened_share = np.divide(trusted, 1.0 + trusted)
        factor = np.divide(widened_share, share, out=np.ones(len(share)), where=share > 0.0)
        amount = np.linalg.pinv(directions) @ solution.change
        covariance = (directions / (1.0 + trusted)) @ directions.T
        return replace(solution, change=directions @ (factor * amount), covariance=covariance)

    def _directions(self, information: np.ndarray) -> np.ndarray:
        """Return combinations of elements (K, K) that are independent, of unit variance before the torques."""
        unit = np.sqrt(np.diag(self.prior))
        values, vectors = np.linalg.eigh(self.prior / np.outer(unit, unit))
        half = unit[:, None] * vectors * np.sqrt(np.clip(values, 0.0, None))
        _, turns = np.linalg.eigh(half.T @ information @ half)
        return np.asarray(half @ turns)

    def held_out(self, products: np.ndarray) -> float:
        """Return the ratio of squared errors on held-out time, with the geometry estimated to with it unchanged."""
        fold = (np.arange(len(products)) * PIECES // len(products)) % FOLDS
        squares = np.zeros(2)
        for number in range(FOLDS):
            training, test = products[fold != number], products[fold == number]
            if not len(training) or not len(test):
                return 1.0
            test_products = test.sum(axis=0)
            for k, freed in enumerate((True, False)):
                solution = self.solve(training, freed)
                weights = np.concatenate([solution.values, solution.change, [-1.0]])
                squares[k] += weights @ test_products @ weights
        return float(squares[0] / squares[1])


def payload_information(payload: Payload) -> tuple[np.ndarray, np.ndarray]:
    """Return the precision (4, 4) of a stated payload's MX, MY, MZ [kg m] and M [kg], and their values (4,).

    Args:
        payload: mass and centre of mass.
    """
    stated = np.array(payload.parameters)[FIRST_MOMENTS]
    mass = stated[3]
    # an uncertain centre, and an uncertain mass at that centre
    slopes = np.diag([mass, mass, mass, 1.0])
    slopes[:3, 3] = stated[:3] / mass
    half = slopes * np.array([CENTRE, CENTRE, CENTRE, MASS_SHARE * mass])
    return np.linalg.inv(half @ half.T), stated


def _nonnegative(matrix: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the positive semidefinite matrix that is nearest once rows and columns are scaled.

    Args:
        matrix: (p, p) symmetric.
        scale: (p,) sizes that its diagonal is compared with.
    """
    diagonal = np.maximum(np.abs(np.diag(matrix)), LEAST_SCALE * scale)
    unit = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(matrix / np.outer(unit, unit))
    half = vectors * np.sqrt(np.clip(values, 0.0, None)) * unit[:, None]
    return half @ half.T


def scaled_inverse(covariance: np.ndarray) -> np.ndarray:
    """Return the (pseudo-)inverse of a covariance, with rows scaled to unit variance."""
    unit = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(unit, unit)
    return np.linalg.pinv(correlation, rcond=SINGULAR, hermitian=True) / np.outer(unit, unit)

"""Joint estimate of geometry and dynamics from torques: most probable values, and covariance.

Two stages, a geometric fit and an identification on its geometry, use the torques for the dynamics alone. But torques
depend on the geometry, too: gravity shows the offsets of joints 2 to n - 1, and a known payload shows them well. With g
the values of the chain's elements and two tilts of gravity, χ the standard parameters of bodies and drives, and y the
torques, this module minimises

    ‖(y - (1 + ε) W(g) χ) / σ‖² + (g - ĝ)ᵀ Σ⁻¹ (g - ĝ) + D(χ) + ‖ε / σ_ε‖² + ‖(m(χ) - m₀) / σ_m‖²,

with ĝ and Σ the result of the geometric fit, i.e. all that measured poses say, D the prior of physically consistent
bodies (`calib.identification.physical_consistency.solve`) to second order, ε the gains of the torque rows, and m the
mass and first moments of payloads whose values are stated. The method is Gauss-Newton with rows [W, W χ, ∂(W χ)/∂g];
its start is the result of the two stages. All standard parameters are estimated, not base parameters, since their
regrouping depends on the geometry: without the prior of physically consistent inertias, small changes of lengths would
have large effects.

If the fit has joint corrections (compliance, gears, encoders), the geometry is that fitted with them; their
coefficients follow its change by the correlations of the fit.

Residuals of recorded torques are correlated. Their weights account for the autocorrelation within a row
(`calib.estimation.whiteness.inflation`); in addition, the scores of groups of rows (blocks of time, and equal velocity
or position of a joint) are compared with the variance that these weights state, as in a sandwich estimator (Liang and
Zeger 1986). For each combination of elements, a larger one lowers the weight of the torques beside the prior.

The covariance of all parameters is (A + Λ)⁻¹, A the information of the torques, Λ that of the priors. By the inverse of
a partitioned matrix, the dynamics' part is Σ_torque + S Σ_g Sᵀ with Σ_g the covariance of the geometry after the
torques, S as in `calib.identification.uncertainty.geometry_uncertainty`, and the part of both is S Σ_g.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

from calib.data.signals.filtering import Decimator, kept
from calib.dynamics import rigid_body
from calib.dynamics.torque_rows import BODIES
from calib.estimation.base_columns import split_columns
from calib.geometry.fit import PLAUSIBLE, TYPICAL
from calib.identification.identify import Identification, common_decimator, identify
from calib.identification.physical_consistency.information import of as information_of
from calib.identification.physical_consistency.solve import find_possible
from calib.identification.prior import residual_inflation
from calib.identification.rows import Case, observe
from calib.identification.settings import IdentificationSettings, Payload, make_bodies, make_model
from calib.identification.uncertainty.geometry_uncertainty import STEP, TILTS
from calib.records import Frozen
from calib.robot.calibrated import CalibratedChain, CorrectedChain
from calib.robot.chain import Chain, random_joints
from calib.robot.kinematics import forward, jacobian

TILT = 0.01
"""Standard deviation of gravity's direction in the base frame [rad] (our choice): a base that was levelled by eye."""
GAIN = 0.01
"""Standard deviation of the gain of a torque row from 1 (our choice): torque sensors, torque constants."""
MASS_SHARE = 0.005
"""Standard deviation of a payload's stated mass, as a share of it (our choice)."""
CENTRE = 1e-3
"""Standard deviation of a payload's stated centre of mass [m] (our choice)."""
POSTURES = 100
"""Random postures in which effects of elements are compared (our choice)."""
DEPENDENT = 1e-6
"""Relative size of the independent part of an effect below which it counts as dependent."""
PASSES = 6
"""Joint estimates, each with the weights and the prior of an identification on the geometry of the last, at most."""
PASS_SETTLED = 0.2
"""Change of every element in units of its σ that ends the passes (our choice)."""
ROUNDS = 8
"""Linearisations at most."""
SETTLED = 0.02
"""Change of every element in units of its σ that ends the rounds."""
FOLDS = 4
"""Folds of held-out blocks (our choice)."""
PIECES = 2 * FOLDS
"""Contiguous pieces of time of which the folds consist."""
NEGLIGIBLE = 1e-9
"""Relative variance that counts as zero."""
BLOCKS = 40
"""Blocks of time, about, whose products of rows are kept (our choice)."""
BINS = 10
"""Groups of equal velocity or position, with equal numbers of rows (our choice)."""
BLOCK_COUNTS = (40, 20, 10)
"""Numbers of blocks whose scores are compared (our choice)."""
MIN_DATA_SHARE = 0.5
"""Share of the prior variance by which the torques reduce that of an element that they show (our choice)."""
FIRST_MOMENTS = slice(6, 10)
"""MX, MY, MZ and M among the ten standard parameters of a body."""
FIXED = 1e12
"""Precision of a parameter that the identification fixes, relative to that of its data."""
LEAST_SCALE = 1e-9
"""Least diagonal of a precision, relative to that of the data, by which its rows and columns are scaled."""
SINGULAR = 1e-10
"""Relative eigenvalue of a correlation matrix below which its inverse leaves a combination out."""

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class JointEstimate(Frozen):
    """Geometry after the torques, beside its prior.

    Attributes:
        elements, units: names and units of the K free elements and tilts of gravity.
        index: (K,) index of each in the chain's elements; tilts follow the last element.
        before, after: (K,) values before (the geometric fit's, or nominal ones) and after the torques [m or rad].
        prior, covariance: (K, K) covariance of the values before and after.
        widening: factor by which the variance of the torques was raised, as groups of rows ask for; median over
            combinations of elements.
        held_out: ratio of squared torque errors on held-out blocks of time to those with the geometry before.
        rounds: number of linearisations.
        gains, gain_sigma: (rows,) gains of the torque rows, measured over true torques, and their standard deviations.
    """

    elements: tuple[str, ...]
    units: tuple[str, ...]
    index: tuple[int, ...]
    before: np.ndarray
    after: np.ndarray
    prior: np.ndarray
    covariance: np.ndarray
    widening: float
    held_out: float
    rounds: int
    gains: np.ndarray
    gain_sigma: np.ndarray

    @property
    def change(self) -> np.ndarray:
        """Change of the values (K,) by the torques [m or rad]."""
        return np.asarray(self.after - self.before)

    @property
    def sigma_before(self) -> np.ndarray:
        """Standard deviation (K,) before the torques [m or rad]."""
        return np.sqrt(np.diag(self.prior))

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation (K,) after the torques [m or rad]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def identified(self) -> np.ndarray:
        """Mask (K,) of the values whose variance the torques reduce by at least `MIN_DATA_SHARE`."""
        return self.sigma**2 < (1.0 - MIN_DATA_SHARE) * self.sigma_before**2

    @property
    def surprise(self) -> np.ndarray:
        """Change (K,) in units of its standard deviation if prior and torques agree; 0 where they are equal.

        The variance of the change is that before minus that after the torques.
        """
        variance = self.sigma_before**2 - self.sigma**2
        noticeable = variance > NEGLIGIBLE * self.sigma_before**2
        return np.where(noticeable, self.change / np.sqrt(np.where(noticeable, variance, 1.0)), 0.0)

    @cached_property
    def combinations(self) -> tuple[np.ndarray, np.ndarray]:
        """Share of prior variance that the torques remove (K,), largest first, and change in units of the prior's σ.

        The combinations of elements are independent of each other, before and after the torques.
        """
        unit = self.sigma_before
        values, vectors = np.linalg.eigh(self.prior / np.outer(unit, unit))
        positive = values > NEGLIGIBLE
        whitening = (vectors[:, positive] / np.sqrt(values[positive])) / unit[:, None]
        removed, turn = np.linalg.eigh(np.eye(int(positive.sum())) - whitening.T @ self.covariance @ whitening)
        order = np.argsort(-removed)
        change = turn.T @ (whitening.T @ self.change)
        return np.clip(removed, 0.0, 1.0)[order], change[order]

    @property
    def identified_combinations(self) -> int:
        """Number of independent combinations of elements that the torques rather than the prior determine."""
        removed, _ = self.combinations
        return int(np.sum(removed >= MIN_DATA_SHARE))

    def regrouped(self, chain: Chain) -> JointEstimate:
        """Return the estimate of the independent elements of a chain, each with those regrouped into it, and of tilts.

        Args:
            chain: the arm before.
        """
        count = len(chain.elements)
        index, matrix = independent_elements(chain)
        free = np.array(self.index)
        elements = free < count
        transform = scipy.linalg.block_diag(matrix[:, free[elements]], np.eye(int(np.sum(~elements))))
        prior = transform @ self.prior @ transform.T
        estimated = np.diag(prior) > 0.0
        transform = transform[estimated]
        regrouped = np.concatenate([index, free[~elements]])[estimated]
        names = np.array([*chain.names, *TILTS])[regrouped]
        units = np.array([*chain.units, *(["rad"] * len(TILTS))])[regrouped]
        before = np.append(chain.values, np.zeros(len(TILTS)))[regrouped]
        return replace(
            self,
            elements=tuple(names.tolist()),
            units=tuple(units.tolist()),
            index=tuple(regrouped.tolist()),
            before=before,
            after=before + transform @ self.change,
            prior=transform @ self.prior @ transform.T,
            covariance=transform @ self.covariance @ transform.T,
        )

    def distances(self, robot: CalibratedChain) -> np.ndarray:
        """Return the differences (K,) from a robot's values in units of their σ; 0 for what torques do not determine.

        Args:
            robot: the robot with the covariance of its fit, which these torques did not enter.
        """
        count = len(robot.complete.elements)
        index, matrix = independent_elements(robot.complete)
        of_fit = np.zeros(count + len(TILTS))
        of_fit[index] = np.diag(matrix @ prior_of(robot)[:count, :count] @ matrix.T)
        compared = np.array(self.index)
        distance = self.change / np.sqrt(self.sigma**2 + of_fit[compared])
        return np.where(self.identified & (compared < count), distance, 0.0)


def prior_of(robot: CalibratedChain, fitted: bool = True) -> np.ndarray:
    """Return the prior covariance (K + 2, K + 2) of a robot's element values and of the tilts of gravity.

    It is that of the geometric fit. Without a fit, joint offsets have the deviation `PLAUSIBLE` and all other elements
    between the first and the last joint `TYPICAL`. Elements before and after these place base and tool.

    Args:
        robot: the robot.
        fitted: whether the covariance of its fit is used; otherwise the elements have the deviations of a robot without
            a fit.
    """
    chain = robot.complete
    count = len(chain.elements)
    covariance = np.zeros((count + len(TILTS), count + len(TILTS)))
    tilts = np.arange(count, count + len(TILTS))
    covariance[tilts, tilts] = TILT**2
    of_fit = robot.covariance if robot.corrections is None else robot.corrections.covariance
    if of_fit is not None and fitted:
        covariance[:count, :count] = of_fit[:count, :count]
        return covariance
    for k in independent_elements(chain).index:
        unit = chain.units[k]
        deviation = TYPICAL[unit]
        if k in chain.moving:
            deviation = PLAUSIBLE[unit]
        covariance[k, k] = deviation**2
    return covariance


class Regrouping(NamedTuple):
    """Elements whose effects on the tip's pose are independent of each other and of the frames of base and tool.

    Attributes:
        index: (k,) indices of these elements; joint offsets are preferred to elements with the same effect.
        matrix: (k, K) changes of these elements with the effect of a change of every element of the chain.
    """

    index: np.ndarray
    matrix: np.ndarray


def independent_elements(chain: Chain) -> Regrouping:
    """Return the independent elements of a chain, into which all others are regrouped."""
    q = random_joints(chain, POSTURES)
    motion = jacobian(chain, q)
    poses = forward(chain, q)
    count = motion.shape[2]
    frames = np.zeros((len(q), 6, 12))
    frames[:, :3, :3] = frames[:, 3:, 3:6] = np.eye(3)
    frames[:, :3, 3:6] = np.cross(np.eye(3), poses[:, None, :3, 3]).transpose(0, 2, 1)
    frames[:, :3, 6:9] = frames[:, 3:, 9:] = poses[:, :3, :3]
    stacked = np.concatenate([frames, motion], axis=2).reshape(-1, 12 + count)
    constant = np.setdiff1d(np.arange(count), chain.moving)
    groups = [np.arange(12), *(12 + chain.moving[:, None]), *(12 + constant[:, None])]
    factor = np.asarray(np.linalg.qr(stacked, mode="r"))
    split = split_columns(factor, groups, DEPENDENT)
    columns = np.sort(split.kept[split.kept >= 12])
    effects = np.zeros((12 + count, 12 + count))
    effects[split.kept, split.kept] = 1.0
    effects[np.ix_(split.kept, split.dropped)] = split.coefficients
    return Regrouping(columns - 12, effects[columns, 12:])


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


def updated(
    robot: CalibratedChain, settings: IdentificationSettings, joint: JointEstimate
) -> tuple[CalibratedChain, IdentificationSettings]:
    """Return the robot with the geometry and covariance after the torques, and settings with the estimated gravity.

    Args:
        robot: the robot before.
        settings: settings of the identification.
        joint: the joint estimate.
    """
    count = len(robot.chain.elements)
    change = np.zeros(count + len(TILTS))
    change[list(joint.index)] = joint.change
    chain, changed_settings = changed(robot.chain, settings, change)
    nominal = robot.nominal or robot.chain
    free = np.array(joint.index)
    elements = free < count
    index = free[elements]
    covariance = joint.covariance[np.ix_(elements, elements)]
    if robot.corrections is not None:
        complete, _ = changed(robot.complete, settings, change)
        corrections = _conditioned(replace(robot.corrections, chain=complete), index, change[index], covariance)
        return replace(robot, chain=chain, nominal=nominal, corrections=corrections), changed_settings
    of_chain = np.zeros((count, count))
    of_chain[np.ix_(index, index)] = covariance
    return replace(robot, chain=chain, nominal=nominal, covariance=of_chain), changed_settings


def _conditioned(
    corrections: CorrectedChain, index: np.ndarray, change: np.ndarray, covariance: np.ndarray
) -> CorrectedChain:
    """Return joint corrections whose coefficients follow the change of the geometry by their correlation.

    Args:
        corrections: the changed geometry, with the coefficients and the covariance (K + E, K + E) before.
        index: (k,) changed elements.
        change: (k,) their changes.
        covariance: (k, k) their covariance after the torques.
    """
    before = corrections.covariance
    if before is None:
        return corrections
    # regression of all values on the changed elements
    gain = before[:, index] @ _inverse(before[np.ix_(index, index)])
    after = before + gain @ (covariance - before[np.ix_(index, index)]) @ gain.T
    shift = (gain @ change)[len(corrections.chain.elements) :]
    coefficients = np.asarray(corrections.deflection.coefficients) + shift
    deflection = replace(corrections.deflection, coefficients=coefficients)
    return replace(corrections, deflection=deflection, covariance=after)


class JointIdentification(NamedTuple):
    """Result of geometry and dynamics identified together.

    Attributes:
        estimate: the geometry.
        robot: the robot with this geometry and its covariance.
        identification: the identification on it; its settings have the estimated direction of gravity.
    """

    estimate: JointEstimate
    robot: CalibratedChain
    identification: Identification


def identify_jointly(
    identification: Identification,
    robot: CalibratedChain,
    cases: Sequence[Case],
    settings: IdentificationSettings,
    doubted: Sequence[str] = (),
    fitted: bool = True,
    progress: Progress | None = None,
) -> JointIdentification:
    """Return geometry and dynamics identified together, by repeated joint estimates and identifications.

    Errors of the geometry enter the residuals, and thereby the weights and the prior of a first pass; each further pass
    has those of a better geometry, until the geometry changes by less than `PASS_SETTLED` σ.

    Args:
        identification: the identification on the robot's geometry.
        robot: the robot, with the covariance of its geometric fit if it has one.
        cases: training recordings.
        settings: settings of the identifications.
        doubted: labels of payloads whose stated mass and centre are not used.
        fitted: whether the covariance of the fit is the prior; otherwise torques alone determine the geometry.
        progress: called with a short text at each step; None: not called.
    """
    joint = None
    updated_robot = robot
    for _ in range(PASSES):
        previous = joint
        joint = estimate_jointly(identification, robot, cases, previous, doubted, fitted, progress)
        updated_robot, updated_settings = updated(robot, settings, joint)
        identification = identify(updated_robot, cases, updated_settings, progress)
        if previous is not None and (np.abs(joint.after - previous.after) < PASS_SETTLED * joint.sigma).all():
            break
    assert joint is not None
    return JointIdentification(joint, updated_robot, identification)


def estimate_jointly(
    identification: Identification,
    robot: CalibratedChain,
    cases: Sequence[Case],
    start: JointEstimate | None = None,
    doubted: Sequence[str] = (),
    fitted: bool = True,
    progress: Progress | None = None,
) -> JointEstimate:
    """Return the geometry after the torques, estimated together with the dynamics.

    Args:
        identification: the identification on the robot's geometry, with a prior of its parameters.
        robot: the robot, with the covariance of its geometric fit.
        cases: training data of the identification.
        start: an earlier joint estimate, whose geometry the identification used; None: it used that of the robot.
        doubted: labels of payloads whose stated mass and centre are not used.
        fitted: whether the covariance of the fit is the prior; otherwise torques alone determine the geometry.
        progress: called with a short text at each round; None: not called.
    """
    say = progress or (lambda text: None)
    chain = robot.complete
    prior = prior_of(robot, fitted)
    free = np.flatnonzero(np.diag(prior) > 0.0)
    settings = identification.settings
    change = np.zeros(len(free))
    if start is not None:
        change = start.after - start.before
        backwards = np.zeros(len(prior))
        backwards[free] = -change
        _, settings = changed(chain, settings, backwards)
    problem = _Problem(identification, settings, chain, tuple(cases), free, prior[np.ix_(free, free)], tuple(doubted))
    values = problem.start()
    for rounds in range(1, ROUNDS + 1):
        say(f"geometry and dynamics together, round {rounds}")
        products = problem.products(change, values)
        solution = problem.solve(products)
        step = solution.change - change
        change, values = solution.change, solution.values
        if (np.abs(step) < SETTLED * np.sqrt(np.diag(solution.covariance))).all():
            break
    widening = problem.widening(products, change, values)
    solution = problem.widened(products, solution, widening)
    names = (*chain.names, *TILTS)
    units = (*chain.units, *(["rad"] * len(TILTS)))
    before = np.append(chain.values, np.zeros(len(TILTS)))[free]
    return JointEstimate(
        elements=tuple(names[k] for k in free),
        units=tuple(units[k] for k in free),
        index=tuple(free.tolist()),
        before=before,
        after=before + solution.change,
        prior=problem.prior,
        covariance=solution.covariance,
        widening=float(np.median(widening)),
        held_out=problem.held_out(products),
        rounds=rounds,
        gains=1.0 + solution.values[-len(solution.gain_sigma) :],
        gain_sigma=solution.gain_sigma,
    )


@dataclass(frozen=True, eq=False)
class _Solution:
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
class _Problem:
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
        precision[np.ix_(free, free)] = _inverse(covariance[np.ix_(free, free)]) - data[np.ix_(free, free)]
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

    def solve(self, products: np.ndarray, freed: bool = True) -> _Solution:
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
        matrix[p:, p:] += _inverse(self.prior)
        if not freed:
            matrix, right = matrix[:p, :p], right[:p]
        unit = np.sqrt(np.diag(matrix))
        factor = scipy.linalg.cho_factor(matrix / np.outer(unit, unit))
        solution = np.zeros(len(total) - 1)
        solution[: len(unit)] = scipy.linalg.cho_solve(factor, right / unit) / unit
        covariance = scipy.linalg.cho_solve(factor, np.eye(len(unit))) / np.outer(unit, unit)
        gain_sigma = np.sqrt(np.diag(covariance)[p - len(self.identification.fitted.std) : p])
        return _Solution(solution[p:], solution[:p], covariance[p:, p:], gain_sigma)

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

    def widened(self, products: np.ndarray, solution: _Solution, widening: np.ndarray) -> _Solution:
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


def _inverse(covariance: np.ndarray) -> np.ndarray:
    """Return the (pseudo-)inverse of a covariance, with rows scaled to unit variance."""
    unit = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(unit, unit)
    return np.linalg.pinv(correlation, rcond=SINGULAR, hermitian=True) / np.outer(unit, unit)

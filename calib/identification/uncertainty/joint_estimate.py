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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg

from calib.estimation.base_columns import split_columns
from calib.geometry.fit import PLAUSIBLE, TYPICAL
from calib.identification.identify import Identification, identify
from calib.identification.rows import Case
from calib.identification.settings import IdentificationSettings
from calib.identification.uncertainty.geometry_uncertainty import TILTS
from calib.identification.uncertainty.joint_problem import JointProblem, changed, scaled_inverse
from calib.records import Frozen
from calib.robot.calibrated import CalibratedChain, CorrectedChain
from calib.robot.chain import Chain, random_joints
from calib.robot.kinematics import forward, jacobian

TILT = 0.01
"""Standard deviation of gravity's direction in the base frame [rad] (our choice): a base that was levelled by eye."""
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
NEGLIGIBLE = 1e-9
"""Relative variance that counts as zero."""
MIN_DATA_SHARE = 0.5
"""Share of the prior variance by which the torques reduce that of an element that they show (our choice)."""

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
    gain = before[:, index] @ scaled_inverse(before[np.ix_(index, index)])
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
    problem = JointProblem(
        identification, settings, chain, tuple(cases), free, prior[np.ix_(free, free)], tuple(doubted)
    )
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

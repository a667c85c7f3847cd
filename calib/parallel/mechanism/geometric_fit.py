"""Geometric calibration of a parallel robot from its closure: from platform poses, or from redundant encoders alone.

    poses       r = q - q(P; g)                 encoders against the legs' joints at the measured pose
    encoders    r = Nᵀ (q - q(x̂; g))            contradictions of redundant encoders, with the best-fitting pose x̂

    ∂q/∂g = -J⁺ ∂gap/∂g                         of the closure J δq = G t - gap(g), so no forward kinematics is
                                                differentiated (self-calibration: Wampler, Hollerbach & Arai 1995)

g: the constants of the rows of each leg, the leg's pose in the base, its attachment, and the zeros of the encoders
(theta of a row, or r of a prismatic joint). A parameter whose change would open a loop in all postures (such as an axis
tilted out of a planar robot's plane) is not fitted. Linearly dependent parameters, choices of frames among them, are
regularised towards the nominal robot by a prior with σ = `SPREAD`; parameters that the data do not identify keep the
prior's covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import NotConverged, Unidentifiable, refuse_robot
from calib.estimation.base_columns import split_columns
from calib.estimation.estimate import Estimate
from calib.parallel.mechanism.closure import ClosedRobot, Posture, closed, coordinates_of, leg_links, links_of, times
from calib.parallel.mechanism.parallel_robot import COORDINATES, Leg, ParallelRobot
from calib.parallel.mechanism.velocities import loop_jacobians, preload_directions
from calib.records import frozen
from calib.transforms import displace

# Step of the differences by a parameter [m or rad].
STEP = 1e-6
# Share of a parameter's effect on a gap that joints and freedoms may be unable to follow (our choice).
OPENS = 1e-6
# Largest number of Gauss–Newton steps.
LIMIT = 30
# Standard deviation of a parameter before any measurement [m or rad] (our choice).
SPREAD = 0.01
# Share of SPREAD above which the σ of a parameter counts as not reduced by the data.
VAGUE_SHARE = 0.5
# Name of the set of cross-validated rows.
LEFT_OUT = "left out"
# Norm of the part of a column of unit norm that other columns do not explain, below which it counts as dependent.
TOLERANCE = 1e-6


@dataclass(frozen=True)
class LoopParameter:
    """One constant of a leg: an element of its chain by index, or a displacement of its base or attachment."""

    name: str
    unit: str
    leg: int
    # "element", "base" or "attachment"
    part: str
    index: int


@dataclass(frozen=True, eq=False)
class LoopFit:
    """A geometric calibration of a parallel robot: the calibrated robot and its estimate.

    Attributes:
        mechanism: the calibrated robot, its loops closed.
        parameters: the fitted constants.
        estimate: changes of the constants from the nominal robot [m, rad], with covariance.
        vague: names of parameters whose σ remains above half the σ of the prior.
        before, after: rms of the encoders' residuals [rad or m] of the nominal and of the calibrated robot.
        iterations: number of Gauss–Newton iterations.
    """

    mechanism: ClosedRobot
    parameters: tuple[LoopParameter, ...]
    estimate: Estimate
    vague: tuple[str, ...]
    before: float
    after: float
    iterations: int


@dataclass(frozen=True, eq=False)
class LoopCovariance:
    """Covariance (K, K) [m², rad²] of K constants of a parallel robot's loops, by name.

    Constants without effect on the relation of encoders and platform (position of a planar leg along its axis, zero of
    a passive joint) are choices of frames, without uncertainty. Constants with an effect that the poses of a fit did
    not identify keep the uncertainty assumed before the fit.
    """

    names: tuple[str, ...]
    matrix: np.ndarray

    @classmethod
    def fitted(cls, fit: LoopFit) -> LoopCovariance:
        """Return the covariance of a fit; directions that are choices of frames have no variance."""
        directions = visible_directions(fit.mechanism, fit.parameters)
        across = directions @ directions.T
        names = tuple(parameter.name for parameter in fit.parameters)
        return cls(names, frozen(across @ fit.estimate.covariance @ across))

    def of(self, mechanism: ClosedRobot) -> tuple[LoopParameter, ...]:
        """Return the constants of a robot that have the covariance's names.

        Raises:
            RobotError: for a name that none of its loops has.
        """
        by_name = {parameter.name: parameter for parameter in loop_parameters(mechanism)}
        missing = [name for name in self.names if name not in by_name]
        if missing:
            refuse_robot(
                mechanism.robot.name, f"its covariance has the parameter '{missing[0]}', which none of its loops has"
            )
        return tuple(by_name[name] for name in self.names)


def loop_parameters(mechanism: ClosedRobot) -> tuple[LoopParameter, ...]:
    """Return the geometric constants of a robot whose change joints and platform can follow with closed loops."""
    robot = mechanism.robot
    links = leg_links(robot, mechanism.home)
    jacobians = loop_jacobians(mechanism, mechanism.home)
    parameters = []
    for k, (leg, link) in enumerate(zip(robot.legs, links)):
        follows = np.hstack([link.jacobian[0], link.carried[0] @ jacobians.platform[0]])
        across = np.eye(leg.held) - follows @ np.linalg.pinv(follows)
        for parameter in _candidates(leg, k):
            slope = _gap_slope(robot, mechanism.home, parameter)[0]
            size = float(np.abs(slope).max())
            if size > 1e-9 and float(np.abs(across @ slope).max()) < OPENS * size:
                parameters.append(parameter)
    return tuple(parameters)


def fit_loops(
    nominal: ClosedRobot,
    readings: np.ndarray,
    coordinates: np.ndarray | None = None,
    *,
    fixed: Sequence[str] = (),
    loss: float = 1e-6,
) -> LoopFit:
    """Return the geometry of a parallel robot fitted to encoder readings, with or without platform coordinates.

    Args:
        nominal: the robot to start from.
        readings: (m, n) of the actuated joints [rad or m].
        coordinates: (m, r) measured platform coordinates from home [m, rad]; None: readings alone, of a robot with more
            encoders than freedoms.
        fixed: names of parameters that are not fitted.
        loss: relative change of the residuals' sum of squares below which the fit has converged.

    Raises:
        Unidentifiable: if the data identify no parameter, or only readings are given for a robot without redundant
            encoders.
        NoPosture: for rows at which no posture exists.
        NotConverged: if the fit has not converged after 30 steps.
    """
    robot = nominal.robot
    if coordinates is None and not robot.redundant:
        raise Unidentifiable(
            f"'{robot.name}' has as many encoders as freedoms: readings alone determine nothing of its geometry; "
            "measure platform poses"
        )
    parameters = tuple(parameter for parameter in loop_parameters(nominal) if parameter.name not in fixed)
    count = len(parameters)
    mechanism = nominal
    square = np.inf
    before = np.nan
    std = np.nan
    changes = np.zeros(count)
    W = np.zeros((0, count))
    for iteration in range(1, LIMIT + 1):
        residual, W = _observed(mechanism, readings, coordinates, parameters)
        rank = len(split_columns(W, tolerance=TOLERANCE).kept)
        if not rank or len(residual) <= rank:
            raise Unidentifiable(f"{len(residual)} residuals for {rank} parameters of the loops: measure more poses")
        total = float(residual @ residual)
        if iteration == 1:
            before = float(np.sqrt(total / len(residual)))
        std = float(np.sqrt(total / (len(residual) - rank)))
        if total < 1e-24 or (np.isfinite(square) and abs(square - total) <= loss * square):
            break
        square = total
        pull = max(std, 1e-12) / SPREAD
        rows = np.vstack([W, pull * np.eye(count)])
        changes = changes + np.linalg.lstsq(rows, np.concatenate([residual, -pull * changes]), rcond=None)[0]
        mechanism = closed(changed(nominal.robot, parameters, changes))
    else:
        raise NotConverged(f"the geometry of '{robot.name}' has not converged after {LIMIT} steps", mechanism)
    # Rows of the measurements, and of what was known of the parameters beforehand.
    white = np.vstack([W / max(std, 1e-12), np.eye(count) / SPREAD])
    inverse = np.linalg.inv(np.linalg.qr(white, mode="r"))
    covariance = inverse @ inverse.T
    sigmas = np.sqrt(np.diag(covariance))
    max_sigma = VAGUE_SHARE * SPREAD
    vague = tuple(parameter.name for parameter, sigma in zip(parameters, sigmas) if sigma > max_sigma)
    names = tuple(parameter.name for parameter in parameters)
    units = tuple(parameter.unit for parameter in parameters)
    estimate = Estimate(names, units, changes, covariance, std, len(residual) - rank)
    after = float(np.sqrt(np.mean(residual**2)))
    return LoopFit(mechanism, parameters, estimate, vague, before, after, iteration)


def visible_directions(mechanism: ClosedRobot, parameters: Sequence[LoopParameter], postures: int = 100) -> np.ndarray:
    """Return orthonormal directions (p, k) in which changes of the constants affect readings at given platform poses.

    Changes orthogonal to all these directions have no effect: they are choices of frames.

    Args:
        mechanism: the robot.
        parameters: p constants.
        postures: number of random platform poses in the robot's box at which the effect is computed.
    """
    robot = mechanism.robot
    coordinates = np.random.default_rng(0).uniform(robot.lower, robot.upper, (postures, robot.r))
    readings = mechanism.place(coordinates).q[:, robot.actuated]
    _, jacobian = _observed(mechanism, readings, coordinates, parameters)
    _, sizes, directions = np.linalg.svd(jacobian, full_matrices=False)
    return directions[sizes > TOLERANCE * sizes[0]].T


def changed(robot: ParallelRobot, parameters: Sequence[LoopParameter], values: np.ndarray) -> ParallelRobot:
    """Return the robot with its parameters changed by values (p,)."""
    legs = list(robot.legs)
    for parameter, value in zip(parameters, values):
        if value != 0.0:
            legs[parameter.leg] = _changed_leg(legs[parameter.leg], parameter, float(value))
    return robot.with_legs(tuple(legs))


def platform_errors(mechanism: ClosedRobot, readings: np.ndarray, coordinates: np.ndarray) -> np.ndarray:
    """Return measured less computed platform coordinates (m, r) [m, rad] at encoder readings (m, n)."""
    return coordinates - coordinates_of(mechanism, mechanism.locate(readings))


def contradictions(mechanism: ClosedRobot, readings: np.ndarray) -> np.ndarray:
    """Return the contradictions (m, n - r) Nᵀ (q - q(x̂)) of redundant encoder readings (m, n) [rad or m]."""
    posture = mechanism.locate(readings)
    across = preload_directions(mechanism, loop_jacobians(mechanism, posture)).transpose(0, 2, 1)
    return times(across, readings - posture.q[:, mechanism.robot.actuated])


def _observed(
    mechanism: ClosedRobot, readings: np.ndarray, coordinates: np.ndarray | None, parameters: Sequence[LoopParameter]
) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals (m n or m (n - r),) and their Jacobian with respect to the parameters: r ≈ W δg."""
    robot = mechanism.robot
    if coordinates is not None:
        posture = mechanism.place(coordinates)
    else:
        posture = mechanism.locate(readings)
    links = leg_links(robot, posture)
    residual = readings - posture.q[:, robot.actuated]
    W = np.zeros((len(readings), robot.n, len(parameters)))
    counts = [len(leg.actuated) for leg in robot.legs]
    first = np.concatenate([[0], np.cumsum(counts)]).astype(int)
    for p, parameter in enumerate(parameters):
        rows = slice(first[parameter.leg], first[parameter.leg + 1])
        inverse = links[parameter.leg].inverse[:, list(robot.legs[parameter.leg].actuated)]
        W[:, rows, p] = -times(inverse, _gap_slope(robot, posture, parameter))
    if coordinates is None:
        across = preload_directions(mechanism, loop_jacobians(mechanism, posture)).transpose(0, 2, 1)
        residual = times(across, residual)
        W = across @ W
    return residual.ravel(), W.reshape(-1, len(parameters))


def _gap_slope(robot: ParallelRobot, posture: Posture, parameter: LoopParameter) -> np.ndarray:
    """Return ∂gap/∂parameter (N, c) of the parameter's leg, by central differences."""
    a = robot.starts[parameter.leg]
    b = robot.starts[parameter.leg + 1]
    ends = []
    for step in (STEP, -STEP):
        leg = _changed_leg(robot.legs[parameter.leg], parameter, step)
        ends.append(links_of(leg, posture.q[:, a:b], posture.pose).gap)
    return (ends[0] - ends[1]) / (2.0 * STEP)


def _candidates(leg: Leg, k: int) -> list[LoopParameter]:
    """Return all constants of leg number k: those of its elements, and displacements of its base and attachment."""
    candidates = []
    for index, element in enumerate(leg.chain.elements):
        candidates.append(LoopParameter(f"{leg.name}.{element.name}", element.unit, k, "element", index))
    # A spherical end constrains the position of the attachment only, so that its orientation has no effect.
    for part, count in (("base", len(COORDINATES)), ("attachment", leg.held)):
        for index, axis in enumerate(COORDINATES[:count]):
            unit = "m" if index < 3 else "rad"
            candidates.append(LoopParameter(f"{leg.name}.{part}.{axis}", unit, k, part, index))
    return candidates


def _changed_leg(leg: Leg, parameter: LoopParameter, value: float) -> Leg:
    """Return a leg with one constant changed by `value` [m or rad]."""
    if parameter.part == "attachment":
        return replace(leg, attachment=displace(leg.attachment, value * np.eye(6)[parameter.index]))
    elements = list(leg.chain.elements)
    if parameter.part == "base":
        first = elements[0]
        if first.placement is None:
            placement = np.eye(4)
        else:
            placement = first.placement
        elements[0] = replace(first, placement=displace(placement, value * np.eye(6)[parameter.index]))
    else:
        element = elements[parameter.index]
        elements[parameter.index] = replace(element, value=element.value + value)
    return replace(leg, chain=replace(leg.chain, elements=tuple(elements)))

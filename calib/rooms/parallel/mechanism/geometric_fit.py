"""Geometric calibration of a parallel robot from its closure: from platform poses, or from redundant encoders alone.

    poses       r = q - q(P; g)                 encoders against the legs' joints at the measured pose
    encoders    r = Nᵀ (q - q(x̂; g))            what n encoders of r freedoms contradict each other by; x̂ fits them
    best

    ∂q/∂g = -J⁺ ∂gap/∂g                         of the closure J δq = G t - gap(g), so no forward kinematics is
                                                differentiated (self-calibration: Wampler, Hollerbach & Arai 1995)

g: the constants of every leg's rows, its place in the base, its attachment, and the zeros of the encoders (they are the
thetas, or r of prismatic joints). A parameter that would open a loop for good (an axis tilted out of a planar robot's
plane) is left out. Parameters that depend on each other, gauge included, are regularised towards the nominal robot by a
prior of `SPREAD`, and keep its covariance where the data do not identify them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import NotConverged, Unidentifiable, refuse_robot
from calib.estimation.base_columns import split_columns
from calib.estimation.estimate import Estimate
from calib.records import frozen
from calib.rooms.parallel.mechanism.closure import (
    ClosedRobot,
    Posture,
    closed,
    coordinates_of,
    leg_links,
    links_of,
    times,
)
from calib.rooms.parallel.mechanism.parallel_robot import COORDINATES, Leg, ParallelRobot
from calib.rooms.parallel.mechanism.velocities import loop_jacobians, preload_directions
from calib.transforms import displace

# of differences by a parameter [m or rad]
STEP = 1e-6
# of a parameter's effect on a gap that no joint and no freedom can follow (our choice)
OPENS = 1e-6
LIMIT = 30
# standard deviation of a parameter before anything is measured [m or rad] (our choice)
SPREAD = 0.01
# name of rows that folds of a fit left out in turn
LEFT_OUT = "left out"
# of a column that no other explains, at unit norm: counts what the poses could tell
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
        known: the calibrated robot, its loops closed.
        parameters: that may change; estimate: their changes from the nominal robot, with covariance.
        vague: names of parameters of which the data identify less than half of what was known beforehand.
        before, after: rms of the encoders' residuals [rad or m], nominal and calibrated.
        iterations: of Gauss and Newton.
    """

    known: ClosedRobot
    parameters: tuple[LoopParameter, ...]
    estimate: Estimate
    vague: tuple[str, ...]
    before: float
    after: float
    iterations: int


@dataclass(frozen=True, eq=False)
class LoopCovariance:
    """Covariance (K, K) [m², rad²] of K constants of a parallel robot's loops, by name.

    Constants that no relation of encoders and platform shows (where along its axis a planar leg lies, how the angle of
    a passive joint is counted) are choices of frames, without uncertainty. Those that could be shown, but were not by
    the poses of a fit, keep the uncertainty that was assumed before it.
    """

    names: tuple[str, ...]
    matrix: np.ndarray

    @classmethod
    def fitted(cls, found: LoopFit) -> LoopCovariance:
        """Return the covariance of a fit, without the part that is a choice of frames."""
        directions = visible_directions(found.known, found.parameters)
        across = directions @ directions.T
        names = tuple(one.name for one in found.parameters)
        return cls(names, frozen(across @ found.estimate.covariance @ across))

    def of(self, known: ClosedRobot) -> tuple[LoopParameter, ...]:
        """Return the constants of a robot that the names are of.

        Raises:
            RobotError: for a name that none of its loops has.
        """
        found = {one.name: one for one in loop_parameters(known)}
        missing = [name for name in self.names if name not in found]
        if missing:
            refuse_robot(known.robot.name, f"none of its loops has '{missing[0]}', which its covariance is of")
        return tuple(found[name] for name in self.names)


def loop_parameters(known: ClosedRobot) -> tuple[LoopParameter, ...]:
    """Return the geometric constants of a robot that may change without opening a loop for good."""
    robot = known.robot
    links = leg_links(robot, known.home)
    jacobians = loop_jacobians(known, known.home)
    found = []
    for k, (leg, one) in enumerate(zip(robot.legs, links)):
        follows = np.hstack([one.jacobian[0], one.carried[0] @ jacobians.platform[0]])
        across = np.eye(leg.held) - follows @ np.linalg.pinv(follows)
        for parameter in _candidates(leg, k):
            slope = _gap_slope(robot, known.home, parameter)[0]
            size = float(np.abs(slope).max())
            if size > 1e-9 and float(np.abs(across @ slope).max()) < OPENS * size:
                found.append(parameter)
    return tuple(found)


def fit_loops(
    nominal: ClosedRobot,
    readings: np.ndarray,
    coordinates: np.ndarray | None = None,
    *,
    held: Sequence[str] = (),
    loss: float = 1e-6,
) -> LoopFit:
    """Return the geometry of a parallel robot fitted to encoder readings, with or without platform coordinates.

    Args:
        nominal: to start from.
        readings: (m, n) of the actuated joints [rad or m].
        coordinates: (m, r) measured platform coordinates from home [m, rad]; None: readings alone, of a robot with more
            encoders than freedoms.
        held: names of parameters that stay.
        loss: relative change of the residuals' sum of squares at which the fit is settled.

    Raises:
        Unidentifiable: where the data identify no parameter; readings alone of a robot without redundancy.
        NoPosture: for rows at which no posture exists.
        NotConverged: after 30 steps.
    """
    robot = nominal.robot
    if coordinates is None and not robot.redundant:
        raise Unidentifiable(
            f"'{robot.name}' has as many encoders as freedoms: readings alone determine nothing of its geometry; "
            "measure platform poses"
        )
    parameters = tuple(one for one in loop_parameters(nominal) if one.name not in held)
    count = len(parameters)
    known = nominal
    square = np.inf
    before = np.nan
    std = np.nan
    changes = np.zeros(count)
    W = np.zeros((0, count))
    for iteration in range(1, LIMIT + 1):
        residual, W = _observed(known, readings, coordinates, parameters)
        rank = len(split_columns(W, tolerance=TOLERANCE).kept)
        if not rank or len(residual) <= rank:
            raise Unidentifiable(f"{len(residual)} residuals for {rank} parameters of the loops: measure more poses")
        total = float(residual @ residual)
        before = float(np.sqrt(total / len(residual))) if iteration == 1 else before
        std = float(np.sqrt(total / (len(residual) - rank)))
        if total < 1e-24 or (np.isfinite(square) and abs(square - total) <= loss * square):
            break
        square = total
        pull = max(std, 1e-12) / SPREAD
        rows = np.vstack([W, pull * np.eye(count)])
        changes = changes + np.linalg.lstsq(rows, np.concatenate([residual, -pull * changes]), rcond=None)[0]
        known = closed(changed(nominal.robot, parameters, changes))
    else:
        raise NotConverged(f"the geometry of '{robot.name}' does not settle within {LIMIT} steps", known)
    inverse = np.linalg.inv(np.linalg.qr(np.vstack([W / max(std, 1e-12), np.eye(count) / SPREAD]), mode="r"))
    covariance = inverse @ inverse.T
    out = tuple(one.name for one, own in zip(parameters, np.sqrt(np.diag(covariance))) if own > 0.5 * SPREAD)
    names, units = (tuple(getattr(one, key) for one in parameters) for key in ("name", "unit"))
    estimate = Estimate(names, units, changes, covariance, std, len(residual) - rank)
    return LoopFit(known, parameters, estimate, out, before, float(np.sqrt(np.mean(residual**2))), iteration)


def visible_directions(known: ClosedRobot, parameters: Sequence[LoopParameter], postures: int = 100) -> np.ndarray:
    """Return orthonormal directions (p, k) of the constants that relate encoders to the platform somewhere in its box.

    Across them, constants change without effect: they are choices of frames.
    """
    robot = known.robot
    coordinates = np.random.default_rng(0).uniform(robot.lower, robot.upper, (postures, robot.r))
    readings = known.place(coordinates).q[:, robot.actuated]
    _, sizes, directions = np.linalg.svd(_observed(known, readings, coordinates, parameters)[1], full_matrices=False)
    return directions[sizes > TOLERANCE * sizes[0]].T


def changed(robot: ParallelRobot, parameters: Sequence[LoopParameter], values: np.ndarray) -> ParallelRobot:
    """Return the robot with its parameters changed by values (p,)."""
    legs = list(robot.legs)
    for one, value in zip(parameters, values):
        if value != 0.0:
            legs[one.leg] = _changed_leg(legs[one.leg], one, float(value))
    return robot.with_legs(tuple(legs))


def platform_errors(known: ClosedRobot, readings: np.ndarray, coordinates: np.ndarray) -> np.ndarray:
    """Return measured less computed platform coordinates (m, r) [m, rad] at encoder readings (m, n)."""
    return coordinates - coordinates_of(known, known.locate(readings))


def contradictions(known: ClosedRobot, readings: np.ndarray) -> np.ndarray:
    """Return the contradictions (m, n - r) Nᵀ (q - q(x̂)) of redundant encoder readings (m, n) [rad or m]."""
    posture = known.locate(readings)
    across = preload_directions(known, loop_jacobians(known, posture)).transpose(0, 2, 1)
    return times(across, readings - posture.q[:, known.robot.actuated])


def _observed(
    known: ClosedRobot, readings: np.ndarray, coordinates: np.ndarray | None, parameters: Sequence[LoopParameter]
) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals (m n or m (n - r),) and their Jacobian with respect to the parameters: r ≈ W δg."""
    robot = known.robot
    posture = known.place(coordinates) if coordinates is not None else known.locate(readings)
    links = leg_links(robot, posture)
    residual = readings - posture.q[:, robot.actuated]
    W = np.zeros((len(readings), robot.n, len(parameters)))
    first = np.concatenate([[0], np.cumsum([len(leg.actuated) for leg in robot.legs])]).astype(int)
    for p, one in enumerate(parameters):
        rows = slice(first[one.leg], first[one.leg + 1])
        inverse = links[one.leg].inverse[:, list(robot.legs[one.leg].actuated)]
        W[:, rows, p] = -times(inverse, _gap_slope(robot, posture, one))
    if coordinates is None:
        across = preload_directions(known, loop_jacobians(known, posture)).transpose(0, 2, 1)
        residual = times(across, residual)
        W = across @ W
    return residual.ravel(), W.reshape(-1, len(parameters))


def _gap_slope(robot: ParallelRobot, posture: Posture, one: LoopParameter) -> np.ndarray:
    """Return ∂gap/∂parameter (N, c) of the parameter's leg, by central differences."""
    a = robot.starts[one.leg]
    b = robot.starts[one.leg + 1]
    ends = []
    for step in (STEP, -STEP):
        leg = _changed_leg(robot.legs[one.leg], one, step)
        ends.append(links_of(leg, posture.q[:, a:b], posture.pose).gap)
    return (ends[0] - ends[1]) / (2.0 * STEP)


def _candidates(leg: Leg, k: int) -> list[LoopParameter]:
    elements = [
        LoopParameter(f"{leg.name}.{one.name}", one.unit, k, "element", e) for e, one in enumerate(leg.chain.elements)
    ]
    places = [
        LoopParameter(f"{leg.name}.{part}.{axis}", "m" if i < 3 else "rad", k, part, i)
        for part in ("base", "attachment")
        for i, axis in enumerate(COORDINATES)
        if part == "base" or i < leg.held
    ]
    return elements + places


def _changed_leg(leg: Leg, one: LoopParameter, value: float) -> Leg:
    if one.part == "attachment":
        return replace(leg, attachment=displace(leg.attachment, value * np.eye(6)[one.index]))
    elements = list(leg.chain.elements)
    if one.part == "base":
        first = elements[0]
        held = np.eye(4) if first.placement is None else first.placement
        elements[0] = replace(first, placement=displace(held, value * np.eye(6)[one.index]))
    else:
        own = elements[one.index]
        elements[one.index] = replace(own, value=own.value + value)
    return replace(leg, chain=replace(leg.chain, elements=tuple(elements)))

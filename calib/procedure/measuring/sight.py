"""Lines of sight from an instrument to its targets: limits on acceptance cone, range, and links in between.

With several targets (such as reflectors on a plate, each facing its own direction), a pose is feasible if at least one
target is seen; the observation Jacobian then contains only the rows of the targets that are seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calib.geometry.installation import Installation
from calib.geometry.observability import Observation, TargetJacobian, TargetPose
from calib.poses import pose_constraints
from calib.poses.space import PoseConstraint, constraint_gradient
from calib.robot.capsules import ALWAYS, SAMPLES
from calib.robot.chain import Chain, random_joints

if TYPE_CHECKING:
    from calib.robot.collision import DistanceModel

# distance [m] of a link from the line of sight below which it blocks it: about a tracker beam's radius (our choice)
BEAM = 0.01
# number of nearest links checked per line of sight; if two exchange their ranks, both are included (our choice)
DISTANCES = 2
# largest constraint violation at which a target still counts as seen
SEEN = 1e-6


@dataclass(frozen=True, eq=False)
class _Behind:
    """Constraint that keeps links off a line of sight: `BEAM` minus the distances of the `DISTANCES` nearest links [m].

    Attributes:
        arm: collision model with a method ``beam`` (distances of links from a line of sight), see
            `calib.robot.capsules.Capsules.beam`.
        target: pose of the target as a function of q.
        velocity: Jacobian of the target's pose as a function of q.
        instrument: (3,) position of the instrument in the arm's base frame [m].
        links: indices of the links that can block the view. Links next to the target in every posture are excluded,
            since the direction that the target faces accounts for them.
    """

    arm: DistanceModel
    target: TargetPose
    velocity: TargetJacobian
    instrument: np.ndarray
    links: np.ndarray

    def __call__(self, q: np.ndarray) -> np.ndarray:
        return self._nearest(q)[0]

    def gradient(self, q: np.ndarray) -> np.ndarray:
        """Return the derivatives (m, `DISTANCES`, n) of the constraint with respect to q (m, n)."""
        return self._nearest(q)[1]

    def _nearest(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        position = self.target(q)[1]
        velocity = self.velocity(q)[:, :3]
        beam = self.arm.beam(q, position, velocity, self.instrument)
        distances = beam[0][:, self.links]
        gradients = beam[1][:, self.links]
        nearest = np.argsort(distances, axis=1)[:, :DISTANCES]
        rows = np.arange(len(q))[:, None]
        return BEAM - distances[rows, nearest], -gradients[rows, nearest]


@dataclass(frozen=True, eq=False)
class Sight:
    """The lines of sight from an instrument to the targets of an arm.

    Attributes:
        targets: for each target, the constraints that must all be satisfied for the instrument to see it.
    """

    targets: tuple[tuple[PoseConstraint, ...], ...]

    def constraints(self) -> tuple[PoseConstraint, ...]:
        """Return the line-of-sight constraints of a pose; with several targets, those of the best visible target."""
        if len(self.targets) == 1:
            return self.targets[0]
        return (PoseConstraint("line of sight to one of the targets", self._best, self._best_gradient),)

    def visible(self, q: np.ndarray) -> np.ndarray:
        """Return flags (m, T): whether each of T targets is seen at poses q (m, n)."""
        return self._values(q).max(axis=2) <= SEEN

    def _values(self, q: np.ndarray) -> np.ndarray:
        """Return the constraint values (m, T, k) of each of T targets; a target is seen where all k values are <= 0.

        Args:
            q: (m, n) joint values [rad or m].
        """

        def violations(parts: Sequence[PoseConstraint]) -> np.ndarray:
            return np.concatenate([constraint.function(q) for constraint in parts], axis=1)

        return np.stack([violations(parts) for parts in self.targets], axis=1)

    def _best(self, q: np.ndarray) -> np.ndarray:
        values = self._values(q)
        best_target = values.max(axis=2).argmin(axis=1)
        return values[np.arange(len(q)), best_target]

    def _best_gradient(self, q: np.ndarray) -> np.ndarray:
        values = self._values(q)
        best_target = values.max(axis=2).argmin(axis=1)
        gradient = np.zeros((len(q), values.shape[2], q.shape[1]))
        for number in np.unique(best_target):
            rows = best_target == number
            parts = [constraint_gradient(constraint, q[rows]) for constraint in self.targets[number]]
            gradient[rows] = np.concatenate(parts, axis=1)
        return gradient


@dataclass(frozen=True, eq=False)
class SeenOnly:
    """Observation Jacobian J in which the rows of targets that are not seen are zero."""

    of: Observation
    sight: Sight

    def __call__(self, q: np.ndarray) -> np.ndarray:
        return self.of(q) * self._mask(q)

    def product(self, q: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Return the gradient (m, n) of Σ G · J with respect to q, for weights G and the Jacobian J (m, rows, p).

        The set of seen targets is taken as constant.

        Args:
            q: (m, n) joint values [rad or m].
            G: (m, rows, p) weights.
        """
        return self.of.product(q, G * self._mask(q))

    def _mask(self, q: np.ndarray) -> np.ndarray:
        rows_per_target = 3
        if self.of.full:
            rows_per_target = 6
        return np.repeat(self.sight.visible(q), rows_per_target, axis=1)[:, :, None]


def sight_of(
    cell: Installation,
    instrument: np.ndarray,
    facing: Sequence[Sequence[float]],
    half_angle: float | None,
    span: tuple[float, float],
    arm: DistanceModel | None,
) -> Sight | None:
    """Return the lines of sight from an instrument to the targets of an arm; None if there is no condition on them.

    Args:
        cell: the arm with its T targets.
        instrument: (3,) position of the instrument in the arm's base frame [m].
        facing: (T, 3) direction that each target faces, in the target's frame; a single direction applies to all.
        half_angle: half angle of the acceptance cone [rad]; None: no limit.
        span: smallest and largest allowed distance of the target from the instrument [m].
        arm: model of the arm's links, which may block the view (`_Behind`); None: not checked.
    """
    directions = [*facing]
    if len(facing) == 1:
        directions = directions * len(cell.tools)
    nearest, largest = span
    targets = []
    for number, direction in enumerate(directions):
        target = TargetPose(cell, number)
        velocity = TargetJacobian(cell, number)
        parts: list[PoseConstraint] = []
        if half_angle is not None:
            parts.append(pose_constraints.line_of_sight(target, instrument, direction, half_angle, velocity))
        if nearest > 0.0 or np.isfinite(largest):
            parts.append(pose_constraints.distance(target, nearest or -np.inf, largest, instrument, velocity))
        if arm is not None:
            links = _blocking_links(arm, cell.chain, target)
            behind = _Behind(arm, target, velocity, np.asarray(instrument, dtype=float), links)
            parts.append(PoseConstraint("view past the arm", behind, behind.gradient))
        targets.append(tuple(parts))
    if not targets or not targets[0]:
        return None
    return Sight(tuple(targets))


def _blocking_links(arm: DistanceModel, chain: Chain, target: TargetPose) -> np.ndarray:
    """Return the indices of links that can block the view: all except those next to the target in every posture.

    Args:
        arm: model of the arm's links.
        chain: the arm.
        target: pose of the target as a function of the joint values.
    """
    q = random_joints(chain, SAMPLES)
    position = target(q)[1]
    # a beam of almost no length: the distances of the links from the target itself
    distances, _ = arm.beam(q, position, np.zeros((len(q), 3, chain.n)), position + 1e-6)
    return np.flatnonzero((distances <= BEAM).mean(axis=0) < ALWAYS)

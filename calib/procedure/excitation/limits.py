"""The limits file of excitation: where the arm may go, how fast, and with which torques.

TOML; every table is optional. ``[joints]``, ``[target]`` (height, axis_distance, reach, of the tip), ``[collision]``
and ``[[obstacle]]`` are those of pose selection (`calib.procedure.kinematic_stage.pose_limits`). Besides, per joint or
``all``::

    [velocity]                       # moduli; default the robot's own
    q1 = "90 deg/s"
    share = 0.9                      # of the limits, those of the robot included
    [acceleration]                   # default: none
    all = 8.0
    [jerk]
    all = 100.0
    [torque]                         # default the robot's effort limits
    margin = 0.1                     # a share of the limits that stays free
    deviations = 2.0                 # standard deviations of the predicted torque, where the model has a covariance
    [friction]                       # where no identified model tells: Fv [N m s/rad], Fc [N m], per joint
    Fv = [14.4, 15.3, 6.55, 11.0, 4.29, 2.26, 1.6]
    Fc = [11.9, 11.5, 8.98, 8.35, 8.31, 4.72, 6.04]
    [[point]]                        # a named point, which keeps [target]'s height and axis_distance
    name = "elbow"
    joint = 4                        # of the link behind this joint, or 0: of the tip
    xyz = [0.0, 0.0, 0.0]            # in the frame behind the joint
    [frequency]
    resonance = "5 Hz"               # the smallest resonance: all frequencies of the motion stay below
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import RobotError, UsageError
from calib.geometry.observability import targets_of
from calib.procedure.kinematic_stage.pose_limits import Limits, read_limits
from calib.robot.chain import Chain
from calib.robot.kinematics import element_jacobian, joint_frames, joint_jacobian, sweep
from calib.robot.tables import check_keys, load, number, vector
from poses.space import PoseConstraint
from trajectories.basis import SampledMotion
from trajectories.constraints import BoxLimit, MotionConstraint, box_limits
from trajectories.places import Clearance, Workspace

STEP = 1e-6  # [rad or m] of the central differences of collision distances (our choice)


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """What `read_motion_limits` found.

    Attributes:
        constraints: all but torque.
        torque: (n,) limits [N m or N]; infinite where there is none.
        margin, deviations: of the torque limit; `margin` None where the file does not say.
        friction: (2, n) Fv and Fc; None where the file does not say.
        resonance: [rad/s] or None.
        notes: what a user should know.
    """

    constraints: tuple[MotionConstraint, ...]
    torque: np.ndarray
    margin: float | None
    deviations: float
    friction: np.ndarray | None
    resonance: float | None
    notes: tuple[str, ...]

    @property
    def positions(self) -> BoxLimit:
        """The joint limits; infinite where there are none."""
        free = np.full(len(self.torque), np.inf)
        own = (one for one in self.constraints if isinstance(one, BoxLimit) and one.order == 0)
        return next(own, BoxLimit(0, -free, free))


def read_motion_limits(path: Path | None, chain: Chain, source: Path | None = None) -> MotionLimits:
    """Read the limits of a motion.

    Args:
        path: the file; None for the robot's own limits alone.
        source: the robot's file, for its collision shapes.

    Raises:
        UsageError: for an unknown key or a value that a key cannot have.
    """
    cell = targets_of(chain)
    found = read_limits(path, cell, source)
    table, where = ({}, "limits") if path is None else (load(path), str(path))
    try:
        velocity = _per_joint(table, "velocity", chain, where, np.array([j.velocity for j in chain.joints]))
        bounds = [_per_joint(table, key, chain, where) for key in ("acceleration", "jerk")]
        torque = _per_joint(table, "torque", chain, where, np.array([j.effort for j in chain.joints]))
        own = table.get("torque", {})
        margin = number(own["margin"], f"{where}, torque.margin") if "margin" in own else None
        deviations = number(own.get("deviations", 2.0), f"{where}, torque.deviations")
        points = _points(table, chain, where)
        friction = _friction(table, chain, where)
        resonance = _resonance(table, where)
    except RobotError as error:
        raise UsageError(str(error)) from error
    linear = [joint.kind == "prismatic" for joint in chain.joints]
    constraints: list[MotionConstraint] = [*box_limits(found.lower, found.upper, velocity, *bounds, linear=linear)]
    constraints += _places(table, found, points, where)
    if found.collision is not None:
        constraints.append(_clearance(found))
    notes = found.notes if found.collision is not None else (*found.notes, _unchecked(path))
    return MotionLimits(tuple(constraints), torque, margin, deviations, friction, resonance, notes)


def _unchecked(path: Path | None) -> str:
    """Return what nothing keeps the motion from."""
    if path is None:
        return "collisions and floor are NOT checked, the tool may pass the table: name them with --limits"
    return f"collisions are NOT checked: {path} has no [collision] (its floor = … keeps off the floor)"


@dataclass(frozen=True, eq=False)
class Points:
    """Named points of links: q (N, n) -> (N, k, 3) [m] in the base frame."""

    chain: Chain
    joints: tuple[int, ...]
    places: np.ndarray

    def __call__(self, q: np.ndarray) -> np.ndarray:
        frames = joint_frames(self.chain, q)
        tip = sweep(self.chain, q).poses()
        carriers = [frames[j - 1] if j else tip for j in self.joints]
        return np.stack([f[:, :3, :3] @ p + f[:, :3, 3] for f, p in zip(carriers, self.places)], axis=1)

    def product(self, q: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Return the slopes (N, n) of Σ G · points."""
        walked, points = sweep(self.chain, q), self(q)
        result = np.zeros(q.shape)
        for k, joint in enumerate(self.joints):
            elements = element_jacobian(self.chain, walked, np.ascontiguousarray(points[:, k].T))[:, :3]
            if joint:
                elements[self.chain.moving[joint - 1] + 1 :] = 0.0
            result += np.einsum("nim,mi->mn", joint_jacobian(self.chain, elements), G[:, k])
        return result


@dataclass(frozen=True, eq=False)
class PoseLimit:
    """A constraint of pose selection, kept along a motion."""

    of: PoseConstraint
    count: int
    unit: str = ""

    @property
    def name(self) -> str:
        return self.of.name

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"{self.of.name} {k + 1}" for k in range(self.count))

    @property
    def scale(self) -> np.ndarray:
        return np.ones(self.count)

    @property
    def groups(self) -> np.ndarray:
        return np.arange(self.count)

    def values(self, motion: SampledMotion) -> np.ndarray:
        return np.asarray(self.of.function(motion.q), dtype=float)

    def slopes(self, motion: SampledMotion, weights: np.ndarray) -> np.ndarray:
        from poses.space import constraint_gradient

        result = np.zeros((4, *motion.q.shape))
        result[0] = np.einsum("mk,mkn->mn", weights, constraint_gradient(self.of, motion.q))
        return result


def _places(table: Mapping[str, Any], found: Limits, points: Points, where: str) -> list[MotionConstraint]:
    """Return the workspace of tip and named points, and what else a pose must keep."""
    target = table.get("target", {})
    radius = number(target["axis_distance"], where, "length") if "axis_distance" in target else None
    lowest, highest = None, None
    if "height" in target:
        span = target["height"]
        lowest, highest = map(float, vector(span, 2, where, "length")) if isinstance(span, list) else (
            number(span, where, "length"), None
        )  # fmt: skip
    result: list[MotionConstraint] = []
    if target.keys() & {"axis_distance", "height"}:
        names = ("tool", *(entry["name"] for entry in table.get("point", [])))
        result.append(Workspace(points, points.product, names, radius, lowest, highest))
    others = [one for one in found.constraints if one.name not in ("height", "distance from the axis")]
    still = np.zeros((1, len(found.lower)))
    return result + [PoseLimit(one, np.asarray(one.function(still)).shape[1]) for one in others]


def _clearance(found: Limits) -> Clearance:
    names = tuple(f"{one} - {two}" for one, two in found.collision.pairs)
    return Clearance(found.collision.distances, partial(_distance_product, found.collision), names, found.clearance)


def _distance_product(collision: Any, q: np.ndarray, G: np.ndarray) -> np.ndarray:
    """Return the slopes (N, n) of Σ G · distances by central differences: coal gives no derivatives."""
    result = np.empty(q.shape)
    for j in range(q.shape[1]):
        step = STEP * np.eye(q.shape[1])[j]
        both = collision.distances(np.concatenate([q + step, q - step]))
        result[:, j] = ((both[: len(q)] - both[len(q) :]) * G).sum(axis=1) / (2 * STEP)
    return result


def _per_joint(table: Mapping[str, Any], key: str, chain: Chain, where: str, default: np.ndarray | None = None) -> Any:
    """Return limits (n,) of a table with joints' names, q1 …, ``all`` and ``share``; the default without the table."""
    own, where = table.get(key, {}), f"{where}, {key}"
    numbered = {f"q{j + 1}": j for j in range(chain.n)} | {name: j for j, name in enumerate(chain.joint_names)}
    check_keys(own, ("all", "share", *(("margin", "deviations") if key == "torque" else ()), *numbered), where)
    bounds = np.full(chain.n, np.inf) if default is None else default.copy()
    for name in [name for name in own if name == "all" or name in numbered]:
        rows = range(chain.n) if name == "all" else [numbered[name]]
        for j in rows:
            revolute = chain.joints[j].kind == "revolute"
            units = {"velocity": ("angular speed", "speed"), "torque": ("torque", "force")}.get(key, (None, None))
            value = number(own[name], f"{where}.{name}", units[0] if revolute else units[1])
            bounds[j] = value if default is None else min(value, bounds[j])
    share = number(own.get("share", 1.0), f"{where}.share")
    if not 0 < share <= 1:
        raise UsageError(f"{where}.share: expected a share of the limits above 0 and up to 1, found {share:g}")
    bounds = bounds * share
    return None if default is None and not np.isfinite(bounds).any() else bounds


def _points(table: Mapping[str, Any], chain: Chain, where: str) -> Points:
    joints, places = [0], [np.zeros(3)]
    for k, entry in enumerate(table.get("point", [])):
        place = f"{where}, [[point]] {k + 1}"
        check_keys(entry, ("name", "joint", "xyz"), place)
        joint = entry.get("joint", 0)
        if "name" not in entry or isinstance(joint, bool) or not isinstance(joint, int) or not 0 <= joint <= chain.n:
            raise UsageError(f"{place}: needs a name, and a joint from 1 to {chain.n} (0: the tip)")
        joints.append(joint)
        places.append(vector(entry.get("xyz", [0.0, 0.0, 0.0]), 3, f"{place}, xyz", "length"))
    return Points(chain, tuple(joints), np.array(places))


def _friction(table: Mapping[str, Any], chain: Chain, where: str) -> np.ndarray | None:
    if "friction" not in table:
        return None
    own = table["friction"]
    check_keys(own, ("Fv", "Fc"), f"{where}, friction")
    zero = [0.0] * chain.n
    return np.array([vector(own.get(key, zero), chain.n, f"{where}, friction.{key}") for key in ("Fv", "Fc")])


def _resonance(table: Mapping[str, Any], where: str) -> float | None:
    own = table.get("frequency", {})
    check_keys(own, ("resonance",), f"{where}, frequency")
    if "resonance" not in own:
        return None
    value = own["resonance"]
    if isinstance(value, str) and value.strip().endswith("Hz"):
        return 2 * np.pi * number(value.strip().removesuffix("Hz"), f"{where}, frequency.resonance")
    return number(value, f"{where}, frequency.resonance", "angular speed")

"""Distances between an arm of capsules, the floor and obstacles, in batches of poses without a loop.

Each body is a capsule along the line from its joint's frame to the next one, the last one's to the tip, and each target
that it carries a thin one from the tip to the target: coarse where links bend away from these lines. Distances between
capsules are those of their lines (Ericson 2005, Real-Time Collision Detection, 5.1.9) less the radii.

Distances are signed: negative is the depth inside. Those of convex bodies are convex functions of the point, so that
the nearest point of a line is found by golden sections, inside as outside.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any

import numpy as np

from calib.errors import RobotError, listing, refuse_robot
from calib.records import shaped
from calib.robot.chain import AXES, Chain, random_joints
from calib.robot.kinematics import moving_frames, sweep

ALWAYS = 0.95
SAMPLES = 200
SIZES = {"box": 3, "sphere": 1, "cylinder": 2}
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Fixed obstacle in the arm's base frame: box, sphere or cylinder.

    Attributes:
        kind: "box" (size: three edges), "sphere" (radius) or "cylinder" (radius, length along its z) [m].
        placement: (4, 4), pose of its centre.
    """

    name: str
    kind: str
    size: tuple[float, ...]
    placement: np.ndarray

    def __post_init__(self) -> None:
        if self.kind not in SIZES:
            refuse_robot(f"obstacle '{self.name}'", f"kind '{self.kind}' is not one of {', '.join(SIZES)}")
        count = SIZES[self.kind]
        if len(self.size) != count or min(self.size) <= 0:
            refuse_robot(f"obstacle '{self.name}'", f"a {self.kind} has {count} positive sizes, not {tuple(self.size)}")


@dataclass(frozen=True, eq=False)
class Wall:
    """Half-space allowed for the arm: normal · x ≥ offset, with a unit normal (3,) in the base frame."""

    name: str
    normal: np.ndarray
    offset: float


@dataclass(frozen=True, eq=False)
class Attached:
    """Link outside the chain: a capsule fixed to a body of the arm, or to its base; a sphere where it has no length.

    Attributes:
        body: number of moving elements before it; 0 is the base.
        start, end: (3,) in the frame of the last of these, or in the base frame [m].
    """

    name: str
    body: int
    start: np.ndarray
    end: np.ndarray


def signed_distance(obstacle: Obstacle, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances (...) [m] of points (..., 3) from an obstacle, and the outward normals (..., 3)."""
    rotation, local = obstacle.placement[:3, :3], _seen_from(obstacle, points)
    if obstacle.kind == "sphere":
        length = np.linalg.norm(local, axis=-1, keepdims=True)
        return length[..., 0] - obstacle.size[0], (local / np.maximum(length, 1e-12)) @ rotation.T
    beyond = _beyond(obstacle, local)
    if obstacle.kind == "box":
        slopes = np.sign(local)
    else:
        across = np.linalg.norm(local[..., :2], axis=-1)
        slopes = np.concatenate(
            [local[..., :2] / np.maximum(across, 1e-12)[..., None], np.sign(local[..., 2:])], axis=-1
        )
    out = np.maximum(beyond, 0.0)
    length, deepest = np.linalg.norm(out, axis=-1), beyond.max(axis=-1)
    inside = beyond == deepest[..., None]
    share = np.where((deepest > 0.0)[..., None], out / np.maximum(length, 1e-12)[..., None], inside)
    if obstacle.kind == "cylinder":
        share = np.repeat(share, (2, 1), axis=-1)
    return np.where(deepest > 0.0, length, deepest), (share * slopes) @ rotation.T


def _seen_from(obstacle: Obstacle, points: np.ndarray) -> np.ndarray:
    return (points - obstacle.placement[:3, 3]) @ obstacle.placement[:3, :3]


def _beyond(obstacle: Obstacle, local: np.ndarray) -> np.ndarray:
    """Return the signed distances (..., k) of points (..., 3) in the obstacle's frame from its faces."""
    if obstacle.kind == "box":
        return np.abs(local) - np.array(obstacle.size) / 2
    across = np.linalg.norm(local[..., :2], axis=-1)
    return np.stack([across - obstacle.size[0], np.abs(local[..., 2]) - obstacle.size[1] / 2], axis=-1)


def _distance(obstacle: Obstacle, points: np.ndarray) -> np.ndarray:
    """Return the signed distances (...) [m] of points (..., 3) from an obstacle, without normals."""
    local = _seen_from(obstacle, points)
    if obstacle.kind == "sphere":
        return np.linalg.norm(local, axis=-1) - obstacle.size[0]
    faces = np.moveaxis(_beyond(obstacle, local), -1, 0)
    deepest, outside = reduce(np.maximum, faces), np.maximum(faces, 0.0)
    return np.where(deepest > 0.0, np.sqrt(sum(one * one for one in outside)), deepest)


def nearest_on_lines(obstacle: Obstacle, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the positions (...) from 0 to 1 on lines from start to end (..., 3) that are nearest to an obstacle."""
    low, high = np.zeros(start.shape[:-1]), np.ones(start.shape[:-1])
    along = end - start

    def far(place: np.ndarray) -> np.ndarray:
        return _distance(obstacle, start + place[..., None] * along)

    one, two = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    far_one, far_two = far(one), far(two)
    steps = 44  # of the golden section: 0.618^44 is 6e-10 of the line
    for _ in range(steps):
        left = far_one < far_two
        low, high = np.where(left, low, one), np.where(left, two, high)
        fresh = np.where(left, high - _GOLDEN * (high - low), low + _GOLDEN * (high - low))
        value = far(fresh)
        one, two = np.where(left, fresh, two), np.where(left, one, fresh)
        far_one, far_two = np.where(left, value, far_two), np.where(left, far_one, value)
    return (low + high) / 2


def inseparable(
    pairs: Sequence[tuple[str, str]], distances: np.ndarray, fixed: np.ndarray, margin: float, slack: float = 0.0
) -> tuple[np.ndarray, tuple[tuple[str, str], ...]]:
    """Return the mask (pairs,) of pairs that touch in nearly every posture, and their names.

    Parts of an arm: those nearer than `margin` in at least 95 % of the postures (MoveIt's setup assistant: that touch),
    or never further apart than margin + slack: neighbours, whose shapes overlap by construction. Against what stands
    fixed in the world: only pairs that are nearer, at a distance that no joint changes; an obstacle that the arm nearly
    always hits is an obstacle. A link at a distance that no joint changes, the turret of an arm, may touch what it
    stands on: by as much as shapes this coarse cannot tell.

    Args:
        pairs: names of link and thing.
        distances: (N, pairs) [m] in N random postures, signed.
        fixed: (pairs,) whether the pair is one with the world.
        margin: the least distance that will be asked for [m].
        slack: distance that shapes as coarse as these cannot resolve [m].

    Raises:
        RobotError: for a floor or obstacle in permanent collision with a link (wrong size or place).
    """
    near, highest = (distances <= margin).mean(axis=0) >= ALWAYS, distances.max(axis=0)
    moves = np.ptp(distances, axis=0) >= 1e-6
    max_overlap = 0.01  # by which a turret may reach into what it stands on [m] (our choice)
    buried = np.flatnonzero(fixed & (highest <= np.where(moves, 0.0, -slack - max_overlap)))
    if len(buried):
        shown = listing((f"link '{pairs[k][0]}' in '{pairs[k][1]}'" for k in buried.tolist()), 3)
        raise RobotError(
            f"in all of {len(distances)} random postures {shown} collide: no pose is free of collision. Sizes and "
            "places are in m (or write \"20 mm\"), in the arm's base frame, maybe above the floor; an obstacle's xyz "
            "is its centre; if links are modelled by capsules, [collision] radius may be too large"
        )
    gone = np.where(fixed, (highest <= margin) & ~moves, near | (highest <= margin + slack))
    return gone, tuple(pair for pair, out in zip(pairs, gone, strict=True) if out)


MIN_RADIUS, RADIUS_SHARE = 0.05, 0.05
"""Default radius of capsules: a least radius [m], and a share of the stretched arm's length (our choice)."""
TARGET_RADIUS = 0.02
"""Radius of a target and its stem [m]; a 1.5 inch reflector has 0.019. Our choice."""


def usual_radius(chain: Chain) -> float:
    """Return the default radius [m] of the capsules that represent an arm's links.

    A base below the first joint counts as no longer than the longest link: an arm on a pillar is no thicker for it.
    """
    lines = _lines_of(chain, np.zeros((1, chain.n)), np.empty((0, 3)))
    lengths = np.linalg.norm(lines.end - lines.start, axis=2)[0]
    mount = float(np.linalg.norm(lines.end[0, 0]))
    length = chain.stretched_length() - max(0.0, mount - float(lengths[1:].max()))
    return max(MIN_RADIUS, round(RADIUS_SHARE * length, 3))


@dataclass(frozen=True, eq=False)
class _Lines:
    """Centre lines of the capsules in m postures.

    Attributes:
        start, end: (m, C, 3) [m].
        axes, places: (m, K, 3) of the K moving elements: direction, and where they stand.
    """

    start: np.ndarray
    end: np.ndarray
    axes: np.ndarray
    places: np.ndarray


@dataclass(frozen=True, eq=False)
class Capsules:
    """Collision model of an arm of capsules, walls and obstacles; same methods as `calib.robot.collision.Collision`.

    Attributes:
        chain: the arm.
        names: (C,) of the capsules.
        bodies: (C,) number of moving elements before each; 0 is the fixed base.
        radii: (C,) [m].
        solid: (S,) capsules with a length; the others are ignored.
        targets: (T, 3) in the tip's frame [m]; their capsules are the last T.
        beside: links outside the chain; their capsules come before those of the targets.
        own: (P, 2) pairs of capsules to compare.
        world: (W, 2) pairs of capsule and wall or obstacle (walls first) to compare.
        walls: the floor among them.
        obstacles: in the base frame.
        excluded: pairs that are not compared, since they touch in nearly every posture.
    """

    chain: Chain
    names: tuple[str, ...]
    bodies: np.ndarray
    radii: np.ndarray
    solid: np.ndarray
    targets: np.ndarray
    own: np.ndarray
    world: np.ndarray
    walls: tuple[Wall, ...]
    obstacles: tuple[Obstacle, ...]
    excluded: tuple[tuple[str, str], ...] = ()
    missing: tuple[str, ...] = ()
    beside: tuple[Attached, ...] = ()

    @cached_property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Names of the compared pairs, in the order of the columns of `distances`."""
        things = [one.name for one in (*self.walls, *self.obstacles)]
        own = [(self.names[i], self.names[j]) for i, j in self.own]
        return (*own, *((self.names[i], things[k]) for i, k in self.world))

    def distances(self, q: np.ndarray) -> np.ndarray:
        """Return the distances (m, pairs) [m] at joint values q (m, n); negative: depth of penetration."""
        return self._measured(self.lines_at(q))[0]

    def gradients(self, q: np.ndarray) -> np.ndarray:
        """Return the derivatives (m, pairs, n) of `distances`: normal times the velocities of the nearest points."""
        lines = self.lines_at(q)
        _, normal, one, two = self._measured(lines)
        count = len(self.own)
        second = np.concatenate([self.bodies[self.own[:, 1]], self.bodies[self.world[:, 0]]])
        slope = self._closing(lines, normal, two, second)
        slope[:, :count] -= self._closing(lines, normal[:, :count], one[:, :count], self.bodies[self.own[:, 0]])
        return slope

    def free(self, q: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Return the mask (m,) of joint values q (m, n) with all distances larger than `margin` [m]."""
        from calib.robot.capsule_kernels import clear  # numba

        q = shaped(q, (None, self.chain.n), f"joint values of '{self.chain.name}'")
        good = clear(q, *self._compiled, margin)
        near_obstacles = self._with_obstacles
        if near_obstacles is not None and good.any():
            unsure = np.flatnonzero(good)
            lines = self.lines_at(q[unsure])
            near = ~np.all(near_obstacles._measured(lines, rough=True)[0] > margin, axis=1)
            some = _Lines(*(part[near] for part in (lines.start, lines.end, lines.axes, lines.places)))
            good[unsure[near]] = np.all(near_obstacles._measured(some)[0] > margin, axis=1)
        return good

    @cached_property
    def _compiled(self) -> tuple[Any, Any, float, Any, Any, Any, Any, Any]:
        """Arguments of `calib.robot.capsule_kernels.clear` between q and margin."""
        form = [
            (AXES.index(e.axis), e.sign, e.value, e.ratio, -1.0 if e.joint is None else e.joint)
            for e in self.chain.elements
        ]
        fixed = [np.eye(4) if e.placement is None else e.placement for e in self.chain.elements]
        place = [np.concatenate([each[:3, :3].ravel(), each[:3, 3]]) for each in (*fixed, self.chain.tail)]
        faces = [
            (body, *self.walls[thing].normal, self.walls[thing].offset)
            for body, thing in self.world
            if thing < len(self.walls)
        ]
        attached = [np.concatenate([[one.body], one.start, one.end]) for one in self.beside]
        return (
            np.array(form),
            np.array(place),
            min(self.chain.floor, 0.0),
            np.array(attached).reshape(-1, 7),
            self.targets,
            self.own,
            self.radii,
            np.array(faces).reshape(-1, 5),
        )

    @cached_property
    def _with_obstacles(self) -> Capsules | None:
        """The same model with the pairs of arm and obstacles only; None without obstacles."""
        world = self.world[self.world[:, 1] >= len(self.walls)]
        return replace(self, own=self.own[:0], world=world) if len(world) else None

    def beam(self, q: np.ndarray, start: np.ndarray, slope: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the links' distances from lines of sight to a target on the last body, with their derivatives.

        Args:
            q: (m, n).
            start: (m, 3) position of the target [m], and slope: (m, 3, n) its derivative by the joint values.
            end: (3,) or (m, 3), position of the instrument in the base frame [m].

        Returns:
            Distances (m, L) [m] of the L capsules of all other bodies, and their derivatives (m, L, n).
        """
        lines = self.lines_at(q)
        others = self.solid[self.bodies[self.solid] < self.bodies.max()]
        shape = (len(q), len(others), 3)
        first, last = np.broadcast_to(start[:, None], shape), np.broadcast_to(np.atleast_2d(end)[:, None], shape)
        along, place = _nearest(first, last, lines.start[:, others], lines.end[:, others])
        seen = first + along[..., None] * (last - first)
        link = lines.start[:, others] + place[..., None] * (lines.end - lines.start)[:, others]
        distance, normal = _apart(seen, link)
        gradient = self._closing(lines, normal, link, self.bodies[others]) - (1.0 - along)[..., None] * (normal @ slope)
        return distance - self.radii[others], gradient

    def lines_at(self, q: np.ndarray) -> _Lines:
        """Return the lines along the middles of the capsules at postures q (m, n)."""
        return _lines_of(self.chain, q, self.targets, self.beside)

    def _measured(self, lines: _Lines, rough: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return distances (m, P + W), normals (m, P + W, 3) towards the second body, and the nearest points.

        For the W pairs with the world the second body is the arm's. `rough` takes from obstacles what they are at least
        away, by the middles of the lines.
        """
        m, count = len(lines.start), len(self.own) + len(self.world)
        normal, one, two = (np.empty((m, count, 3)) for _ in range(3))
        distance = np.empty((m, count))
        i, j = self.own.T
        s, t = _nearest(lines.start[:, i], lines.end[:, i], lines.start[:, j], lines.end[:, j])
        own = slice(0, len(i))
        one[:, own] = lines.start[:, i] + s[..., None] * (lines.end - lines.start)[:, i]
        two[:, own] = lines.start[:, j] + t[..., None] * (lines.end - lines.start)[:, j]
        distance[:, own], normal[:, own] = _apart(one[:, own], two[:, own])
        distance[:, own] -= self.radii[i] + self.radii[j]
        for thing in np.unique(self.world[:, 1]):
            at = len(i) + np.flatnonzero(self.world[:, 1] == thing)
            body = self.world[at - len(i), 0]
            start, end = lines.start[:, body], lines.end[:, body]
            if thing < len(self.walls):
                wall = self.walls[thing]
                two[:, at] = np.where((start @ wall.normal < end @ wall.normal)[..., None], start, end)
                distance[:, at], normal[:, at] = two[:, at] @ wall.normal - wall.offset, wall.normal
            else:
                obstacle = self.obstacles[thing - len(self.walls)]
                place = np.full(start.shape[:2], 0.5) if rough else nearest_on_lines(obstacle, start, end)
                two[:, at] = start + place[..., None] * (end - start)
                distance[:, at], normal[:, at] = signed_distance(obstacle, two[:, at])
                distance[:, at] -= np.linalg.norm(end - start, axis=-1) / 2 if rough else 0.0
            distance[:, at] -= self.radii[body]
        return distance, normal, one, two

    def _closing(self, lines: _Lines, normal: np.ndarray, point: np.ndarray, bodies: np.ndarray) -> np.ndarray:
        return closing(self.chain, lines.axes, lines.places, normal, point, bodies)


def closing(
    chain: Chain, axes: np.ndarray, places: np.ndarray, normal: np.ndarray, point: np.ndarray, bodies: np.ndarray
) -> np.ndarray:
    """Return the speed along the normals (m, P, n) of points (m, P, 3) on bodies (P,), per unit of each joint.

    Args:
        axes, places: (m, K, 3) of the K moving elements: direction, and where they stand.
        bodies: how many moving elements stand before each point.
    """
    z, o = axes.transpose(0, 2, 1), np.cross(axes, places).transpose(0, 2, 1)
    turned = np.cross(point, normal) @ z - normal @ o  # u · (z × (p - o))
    turns = np.array([chain.elements[k].axis[0] == "r" for k in chain.driven])
    speed = np.where(turns, turned, normal @ z)
    return speed * (np.arange(z.shape[2]) < bodies[:, None]) @ chain.rates


def from_chain(
    chain: Chain,
    radius: float | None = None,
    floor: float | None = None,
    obstacles: Sequence[Obstacle] = (),
    *,
    walls: Sequence[Wall] = (),
    targets: np.ndarray | Sequence[Sequence[float]] = (),
    margin: float = 0.0,
    within: bool = True,
    ignored: Collection[frozenset[str]] = (),
    beside: Sequence[Attached] = (),
    seed: int = 0,
) -> Capsules:
    """Return the collision model of an arm with capsules from each joint frame to the next.

    Bodies whose frame and the next one coincide (in a spherical wrist) have no capsule.

    Args:
        chain: the arm.
        radius: of the capsules [m]; None: `usual_radius`.
        floor: height of a floor in the base frame [m]; None for no floor.
        obstacles: in the base frame.
        walls: that it does not pass.
        targets: (T, 3) of what is measured, in the tip's frame [m].
        margin: the least distance that will be asked for [m]; pairs that never have it are left out.
        within: False: parts of the arm are not compared with each other.
        ignored: pairs of links that are not compared.
        beside: links outside the chain, compared with all that moves relative to them.
        seed: of the random postures that show which pairs those are.
    """
    size = usual_radius(chain) if radius is None else radius
    places = np.asarray(targets, dtype=float).reshape(-1, 3)
    places = places[np.linalg.norm(places, axis=1) > 1e-6]
    lines = _lines_of(chain, np.zeros((1, chain.n)), places, beside)
    length = np.linalg.norm(lines.end - lines.start, axis=2)[0]
    moving, first = [chain.elements[k] for k in chain.driven], set(chain.moving.tolist())
    links = chain.links or tuple(f"{name}_link" for name in chain.joint_names)
    own_names = (
        links[one.joint or 0] if k in first else f"{one.name}_link" for k, one in zip(chain.driven.tolist(), moving)
    )
    names = [chain.base, *own_names, *(one.name for one in beside)]
    names += ["target"] if len(places) == 1 else [f"target {k + 1}" for k in range(len(places))]
    others = np.zeros(len(names), dtype=bool)
    others[len(moving) + 1 : len(moving) + 1 + len(beside)] = True
    bodies = np.array([*range(len(moving) + 1), *(one.body for one in beside), *[len(moving)] * len(places)])
    radii = np.array([*[size] * (len(moving) + 1 + len(beside)), *[TARGET_RADIUS] * len(places)])
    there = np.flatnonzero((length > 1e-6) | others)
    own = [(i, j) for i in there for j in there if bodies[j] > bodies[i] + (0 if others[i] or others[j] else 1)]
    own = own if within else []
    own = [(i, j) for i, j in own if frozenset((names[i], names[j])) not in ignored]
    planes = (*([] if floor is None else [Wall("floor", np.array([0.0, 0.0, 1.0]), floor)]), *walls)
    world = [(i, k) for k in range(len(planes) + len(obstacles)) for i in there if bodies[i]]
    found = Capsules(
        chain,
        tuple(names),
        bodies,
        radii,
        there,
        places,
        np.array(own, dtype=int).reshape(-1, 2),
        np.array(world, dtype=int).reshape(-1, 2),
        planes,
        tuple(obstacles),
        beside=tuple(beside),
    )
    if not found.pairs:
        return found
    fixed = np.arange(len(own) + len(world)) >= len(own)
    distances = found.distances(random_joints(chain, SAMPLES, seed))
    gone, excluded = inseparable(found.pairs, distances, fixed, margin, size)
    return replace(found, own=found.own[~gone[: len(own)]], world=found.world[~gone[len(own) :]], excluded=excluded)


def _lines_of(chain: Chain, q: np.ndarray, targets: np.ndarray, beside: Sequence[Attached] = ()) -> _Lines:
    """Return the centre lines of base (from its foot), moving bodies, links beside and targets at q (m, n)."""
    walked = sweep(chain, q)
    axes, places = (part[chain.driven].transpose(2, 0, 1) for part in (walked.directions, walked.origins))
    begins = places.copy()
    for k, element in enumerate(chain.elements[index] for index in chain.driven):
        if element.axis[0] == "t":
            begins[:, k] += axes[:, k] * (element.value + element.ratio * q[:, element.joint])[:, None]
    m, tip = len(q), walked.position.T[:, None]
    seen = tip + np.einsum("tc,cdm->mtd", targets, walked.rotation)
    stand = np.broadcast_to([0.0, 0.0, min(chain.floor, 0.0)], (m, 1, 3))
    first, last = _attached_ends(chain, q, beside)
    start = np.concatenate([stand, begins, first, np.repeat(tip, len(targets), axis=1)], axis=1)
    return _Lines(start, np.concatenate([places, tip, last, seen], axis=1), axes, places)


def _attached_ends(chain: Chain, q: np.ndarray, beside: Sequence[Attached]) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and last points (m, E, 3) [m] of the links outside the chain at joint values q (m, n)."""
    if not beside:
        return np.empty((len(q), 0, 3)), np.empty((len(q), 0, 3))
    base = np.broadcast_to(np.eye(4), (1, len(q), 4, 4))
    frames = np.concatenate([base, moving_frames(chain, q)])[[one.body for one in beside]]
    points = [np.array([getattr(one, end) for one in beside])[:, None, :, None] for end in ("start", "end")]
    first, last = (((frames[..., :3, :3] @ each)[..., 0] + frames[..., :3, 3]).swapaxes(0, 1) for each in points)
    return first, last


def _nearest(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest positions (...), from 0 to 1, on the lines a to b and c to d (..., 3)."""
    u, v, w = b - a, d - c, a - c
    uu, vv, uv = (np.maximum((x * y).sum(-1), least) for x, y, least in ((u, u, 1e-18), (v, v, 1e-18), (u, v, -np.inf)))
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    across = uu * vv - uv**2
    s = np.where(across > 1e-12 * uu * vv, np.clip((uv * vw - vv * uw) / np.maximum(across, 1e-30), 0, 1), 0.5)
    t = np.clip((uv * s + vw) / vv, 0, 1)
    return np.clip((uv * t - uw) / uu, 0, 1), t


def _apart(one: np.ndarray, two: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances (...) of points (..., 3), and the unit vectors from the first to the second."""
    away = two - one
    distance = np.linalg.norm(away, axis=-1)
    return distance, away / np.maximum(distance, 1e-12)[..., None]

"""Distances between an arm made of capsules, walls and obstacles, computed for many poses at once.

Each body is a capsule along the line from its joint's frame to the next joint's frame, for the last body to the tip.
Each target is a thin capsule from the tip to the target. This is coarse where links deviate from these lines. The
distance of two capsules is the distance of their centre lines (Ericson 2005, Real-Time Collision Detection, 5.1.9)
minus the radii. `calib.robot.obstacles` defines obstacles and signed distances from them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calib.errors import RobotError, listing
from calib.records import shaped
from calib.robot.chain import AXES, Chain, random_joints
from calib.robot.kinematics import moving_frames, sweep
from calib.robot.obstacles import TINY, Obstacle, Wall, nearest_on_lines, signed_distance

# Random postures that show which pairs touch in nearly every posture, and the share of them that is nearly all.
SAMPLES = 200
ALWAYS = 0.95
# Change of a distance [m] over the random postures below which no joint changes it.
MIN_CHANGE = 1e-6
# By how much a turret may reach into what it stands on [m] (our choice).
MAX_OVERLAP = 0.01

# Default radius of capsules: a least radius [m], and a share of the stretched arm's length (our choice).
MIN_RADIUS = 0.05
RADIUS_SHARE = 0.05
# Radius of a target and its stem [m]; a 1.5 inch reflector has 0.019. Our choice.
TARGET_RADIUS = 0.02

# Length [m] below which a line is a point.
MIN_LENGTH = 1e-6
# Least squared length of a line [m²], so that a point can be divided by it.
MIN_SQUARE = 1e-18


@dataclass(frozen=True, eq=False)
class Attached:
    """Link outside the chain, as a capsule fixed to a body of the arm or to the base.

    A link whose start and end coincide is a sphere.

    Attributes:
        name: name of the link.
        body: number of moving elements before the link; 0 for a link fixed to the base.
        start, end: (3,) ends of the capsule's centre line [m], in the frame of the last of these elements, or in the
            base frame.
    """

    name: str
    body: int
    start: np.ndarray
    end: np.ndarray


def inseparable(
    pairs: Sequence[tuple[str, str]], distances: np.ndarray, fixed: np.ndarray, margin: float, slack: float = 0.0
) -> tuple[np.ndarray, tuple[tuple[str, str], ...]]:
    """Return which pairs touch in nearly every posture, (pairs,) bool, and the names of these pairs.

    Two parts of the arm are such a pair if they are nearer than `margin` in at least 95 % of the postures (as in
    MoveIt's setup assistant), or never further apart than margin + slack: neighbours, whose shapes overlap by
    construction. A part of the arm and an object fixed in the world are such a pair only if no joint changes their
    distance, since an obstacle that the arm nearly always hits remains an obstacle. A part of the arm that no joint
    moves relative to the object, such as a turret, may overlap the object by the resolution of the shapes.

    Args:
        pairs: names of link and link, or of link and object.
        distances: (N, pairs) signed distances in N random postures [m].
        fixed: (pairs,) whether the second of the pair is fixed in the world.
        margin: the least distance that will be required [m].
        slack: distance that shapes as coarse as capsules cannot resolve [m].

    Raises:
        RobotError: a floor or obstacle in permanent collision with a link (wrong size or position).
    """
    nearly_always = (distances <= margin).mean(axis=0) >= ALWAYS
    highest = distances.max(axis=0)
    changes = np.ptp(distances, axis=0) >= MIN_CHANGE
    depth_allowed = np.where(changes, 0.0, -slack - MAX_OVERLAP)
    buried = np.flatnonzero(fixed & (highest <= depth_allowed))
    if len(buried):
        collisions = listing((f"link '{pairs[k][0]}' in '{pairs[k][1]}'" for k in buried.tolist()), 3)
        raise RobotError(
            f"in all of {len(distances)} random postures {collisions} collide: no pose is free of collision. Sizes and "
            "places are in m (or write \"20 mm\"), in the arm's base frame, maybe above the floor; an obstacle's xyz "
            "is its centre; if links are modelled by capsules, [collision] radius may be too large"
        )
    of_world = (highest <= margin) & ~changes
    of_arm = nearly_always | (highest <= margin + slack)
    touching = np.where(fixed, of_world, of_arm)
    excluded = tuple(pairs[k] for k in np.flatnonzero(touching).tolist())
    return touching, excluded


def usual_radius(chain: Chain) -> float:
    """Return the default radius of the capsules that represent an arm's links [m].

    The radius is a share of the arm's length. A base below the first joint counts at most as long as the longest link,
    so that a pillar does not thicken the arm.

    Args:
        chain: the arm.
    """
    lines = _lines_of(chain, np.zeros((1, chain.n)), np.empty((0, 3)))
    lengths = np.linalg.norm(lines.end - lines.start, axis=2)[0]
    mount = float(np.linalg.norm(lines.end[0, 0]))
    pillar = max(0.0, mount - float(lengths[1:].max()))
    length = chain.stretched_length() - pillar
    return max(MIN_RADIUS, round(RADIUS_SHARE * length, 3))


@dataclass(frozen=True, eq=False)
class _Lines:
    """Centre lines of C capsules, and axes of the moving elements, in m postures.

    Attributes:
        start, end: (m, C, 3) ends of the centre lines [m].
        axes, origins: (m, K, 3) direction and origin [m] of the axis of each of K moving elements.
    """

    start: np.ndarray
    end: np.ndarray
    axes: np.ndarray
    origins: np.ndarray

    def of_postures(self, chosen: np.ndarray) -> _Lines:
        """Return the lines in only the postures `chosen`, a mask (m,) or indices."""
        return _Lines(self.start[chosen], self.end[chosen], self.axes[chosen], self.origins[chosen])


@dataclass(frozen=True, eq=False)
class Capsules:
    """Collision model of an arm made of capsules, with walls and obstacles.

    It has the same methods as `calib.robot.collision.Collision`.

    Attributes:
        chain: the arm.
        names: (C,) names of the capsules.
        bodies: (C,) number of moving elements before each capsule; 0 for the fixed base.
        radii: (C,) radii of the capsules [m].
        solid: (S,) indices of the capsules with a length; others are ignored.
        targets: (T, 3) positions of the targets in the tip's frame [m]; their capsules are the last T.
        arm_pairs: (P, 2) pairs of capsules to compare.
        world_pairs: (W, 2) pairs of a capsule and a wall or obstacle (walls first) to compare.
        walls: planes that the arm must not cross, including the floor.
        obstacles: obstacles in the base frame.
        excluded: pairs that are not compared, since they touch in nearly every posture.
        beside: links outside the chain; their capsules precede those of the targets.
    """

    chain: Chain
    names: tuple[str, ...]
    bodies: np.ndarray
    radii: np.ndarray
    solid: np.ndarray
    targets: np.ndarray
    arm_pairs: np.ndarray
    world_pairs: np.ndarray
    walls: tuple[Wall, ...]
    obstacles: tuple[Obstacle, ...]
    excluded: tuple[tuple[str, str], ...] = ()
    missing: tuple[str, ...] = ()
    beside: tuple[Attached, ...] = ()

    @cached_property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Names of the compared pairs, in the order of the columns of `distances`."""
        world_names = [solid.name for solid in (*self.walls, *self.obstacles)]
        arm_pairs = [(self.names[i], self.names[j]) for i, j in self.arm_pairs]
        world_pairs = [(self.names[i], world_names[k]) for i, k in self.world_pairs]
        return (*arm_pairs, *world_pairs)

    def distances(self, q: np.ndarray) -> np.ndarray:
        """Return the distances (m, pairs) [m] at joint values q (m, n); negative values are depths of penetration."""
        return self._pair_distances(self.lines_at(q))[0]

    def gradients(self, q: np.ndarray) -> np.ndarray:
        """Return the derivatives (m, pairs, n) of `distances` by the joint values.

        They are the relative velocities of the nearest points along the normal.

        Args:
            q: (m, n) joint values [rad or m].
        """
        lines = self.lines_at(q)
        _, normal, first_point, second_point = self._pair_distances(lines)
        count = len(self.arm_pairs)
        first_bodies = self.bodies[self.arm_pairs[:, 0]]
        second_bodies = np.concatenate([self.bodies[self.arm_pairs[:, 1]], self.bodies[self.world_pairs[:, 0]]])
        slope = self._closing_speed(lines, normal, second_point, second_bodies)
        slope[:, :count] -= self._closing_speed(lines, normal[:, :count], first_point[:, :count], first_bodies)
        return slope

    def free(self, q: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Return at which joint values q (m, n) all distances are larger than `margin` [m], (m,) bool."""
        from calib.robot.capsule_kernels import clear  # numba

        q = shaped(q, (None, self.chain.n), f"joint values of '{self.chain.name}'")
        is_free = clear(q, *self._compiled, margin)
        obstacle_model = self._with_obstacles
        if obstacle_model is None or not is_free.any():
            return is_free
        # Rough distances first: only few postures come so near to an obstacle that it has to be measured exactly.
        open_rows = np.flatnonzero(is_free)
        lines = self.lines_at(q[open_rows])
        rough_distances = obstacle_model._pair_distances(lines, rough=True)[0]
        doubtful = ~np.all(rough_distances > margin, axis=1)
        distances = obstacle_model._pair_distances(lines.of_postures(doubtful))[0]
        is_free[open_rows[doubtful]] = np.all(distances > margin, axis=1)
        return is_free

    @cached_property
    def _compiled(self) -> tuple[object, object, float, object, object, object, object, object]:
        """Arguments of `calib.robot.capsule_kernels.clear` between `q` and `margin`."""
        motions = []
        transforms = []
        for element in self.chain.elements:
            joint = -1.0 if element.joint is None else element.joint
            motions.append((AXES.index(element.axis), element.sign, element.value, element.ratio, joint))
            transforms.append(np.eye(4) if element.placement is None else element.placement)
        transforms.append(self.chain.tail)
        placements = [np.concatenate([transform[:3, :3].ravel(), transform[:3, 3]]) for transform in transforms]
        faces = []
        for body, number in self.world_pairs:
            if number < len(self.walls):
                wall = self.walls[number]
                faces.append((body, *wall.normal, wall.offset))
        attached = [np.concatenate([[link.body], link.start, link.end]) for link in self.beside]
        return (
            np.array(motions),
            np.array(placements),
            min(self.chain.floor, 0.0),
            np.array(attached).reshape(-1, 7),
            self.targets,
            self.arm_pairs,
            self.radii,
            np.array(faces).reshape(-1, 5),
        )

    @cached_property
    def _with_obstacles(self) -> Capsules | None:
        """This model with only the pairs of arm and obstacles; None without obstacles."""
        obstacle_pairs = self.world_pairs[self.world_pairs[:, 1] >= len(self.walls)]
        if not len(obstacle_pairs):
            return None
        return replace(self, arm_pairs=self.arm_pairs[:0], world_pairs=obstacle_pairs)

    def beam(self, q: np.ndarray, start: np.ndarray, slope: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the links' distances from lines of sight to a target on the last body, with derivatives.

        A line of sight goes from the target to the instrument.

        Args:
            q: (m, n) joint values [rad or m].
            start: (m, 3) position of the target [m].
            slope: (m, 3, n) derivative of `start` by the joint values.
            end: (3,) or (m, 3), position of the instrument in the base frame [m].

        Returns:
            Distances (m, L) [m] of the L capsules of all other bodies, and their derivatives (m, L, n).
        """
        lines = self.lines_at(q)
        links = self.solid[self.bodies[self.solid] < self.bodies.max()]
        shape = (len(q), len(links), 3)
        sight_start = np.broadcast_to(start[:, None], shape)
        sight_end = np.broadcast_to(np.atleast_2d(end)[:, None], shape)
        sight_position, link_position = _nearest(sight_start, sight_end, lines.start[:, links], lines.end[:, links])
        sight_point = sight_start + sight_position[..., None] * (sight_end - sight_start)
        link_point = lines.start[:, links] + link_position[..., None] * (lines.end - lines.start)[:, links]
        distance, normal = _point_distances(sight_point, link_point)
        # Joints move the link, and the target's end of the line of sight with it.
        link_speed = self._closing_speed(lines, normal, link_point, self.bodies[links])
        sight_speed = (1.0 - sight_position)[..., None] * (normal @ slope)
        return distance - self.radii[links], link_speed - sight_speed

    def lines_at(self, q: np.ndarray) -> _Lines:
        """Return the centre lines of the capsules at joint values q (m, n)."""
        return _lines_of(self.chain, q, self.targets, self.beside)

    def _pair_distances(
        self, lines: _Lines, rough: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return distances (m, P + W), normals (m, P + W, 3) towards the second body, and the pairs of nearest points.

        In the W pairs with walls or obstacles, the second body is the arm's.

        Args:
            lines: centre lines of the capsules.
            rough: use a lower bound of the distance to obstacles, computed from the midpoints of the lines.
        """
        m = len(lines.start)
        count = len(self.arm_pairs) + len(self.world_pairs)
        normal = np.empty((m, count, 3))
        first_point = np.empty((m, count, 3))
        second_point = np.empty((m, count, 3))
        distance = np.empty((m, count))
        directions = lines.end - lines.start

        i, j = self.arm_pairs.T
        s, t = _nearest(lines.start[:, i], lines.end[:, i], lines.start[:, j], lines.end[:, j])
        of_arm = slice(0, len(i))
        first_point[:, of_arm] = lines.start[:, i] + s[..., None] * directions[:, i]
        second_point[:, of_arm] = lines.start[:, j] + t[..., None] * directions[:, j]
        distance[:, of_arm], normal[:, of_arm] = _point_distances(first_point[:, of_arm], second_point[:, of_arm])
        distance[:, of_arm] -= self.radii[i] + self.radii[j]

        for number in np.unique(self.world_pairs[:, 1]):
            rows = np.flatnonzero(self.world_pairs[:, 1] == number)
            columns = len(i) + rows
            bodies = self.world_pairs[rows, 0]
            start, end = lines.start[:, bodies], lines.end[:, bodies]
            if number < len(self.walls):
                wall = self.walls[number]
                start_is_nearer = start @ wall.normal < end @ wall.normal
                second_point[:, columns] = np.where(start_is_nearer[..., None], start, end)
                distance[:, columns] = second_point[:, columns] @ wall.normal - wall.offset
                normal[:, columns] = wall.normal
            else:
                obstacle = self.obstacles[number - len(self.walls)]
                position = np.full(start.shape[:2], 0.5) if rough else nearest_on_lines(obstacle, start, end)
                second_point[:, columns] = start + position[..., None] * (end - start)
                distance[:, columns], normal[:, columns] = signed_distance(obstacle, second_point[:, columns])
                if rough:
                    distance[:, columns] -= np.linalg.norm(end - start, axis=-1) / 2
            distance[:, columns] -= self.radii[bodies]
        return distance, normal, first_point, second_point

    def _closing_speed(self, lines: _Lines, normal: np.ndarray, point: np.ndarray, bodies: np.ndarray) -> np.ndarray:
        return closing_speed(self.chain, lines.axes, lines.origins, normal, point, bodies)


def closing_speed(
    chain: Chain, axes: np.ndarray, origins: np.ndarray, normal: np.ndarray, point: np.ndarray, bodies: np.ndarray
) -> np.ndarray:
    """Return the speed (m, P, n) of P points along normals in m postures, per unit speed of each joint.

    Args:
        chain: the arm.
        axes, origins: (m, K, 3) direction and origin [m] of the axis of each of K moving elements.
        normal: (m, P, 3) unit normals.
        point: (m, P, 3) positions of the points [m].
        bodies: (P,) number of moving elements before each point.
    """
    z = axes.transpose(0, 2, 1)
    moment = np.cross(axes, origins).transpose(0, 2, 1)
    # u · (z × (p - o))
    rotation_speed = np.cross(point, normal) @ z - normal @ moment
    translation_speed = normal @ z
    is_rotation = np.array([chain.elements[k].axis[0] == "r" for k in chain.driven])
    speed = np.where(is_rotation, rotation_speed, translation_speed)
    carries_point = np.arange(z.shape[2]) < bodies[:, None]
    return speed * carries_point @ chain.rates


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
    """Return the collision model of an arm with capsules from each joint frame to the next one.

    A body whose frame coincides with the next one (in a spherical wrist) has no capsule.

    Args:
        chain: the arm.
        radius: radius of the capsules [m]; None: `usual_radius`.
        floor: height of a floor in the base frame [m]; None for no floor.
        obstacles: obstacles in the base frame.
        walls: planes that the arm must not cross.
        targets: (T, 3) positions of the measured targets in the tip's frame [m].
        margin: the least distance that will be required [m]; pairs that are nearer in nearly all postures are excluded
            (`inseparable`).
        within: whether parts of the arm are compared with each other.
        ignored: pairs of names of links that are not compared.
        beside: links outside the chain, compared with every link that moves relative to them.
        seed: seed of the random postures that determine the excluded pairs.
    """
    link_radius = usual_radius(chain) if radius is None else radius
    target_positions = np.asarray(targets, dtype=float).reshape(-1, 3)
    target_positions = target_positions[np.linalg.norm(target_positions, axis=1) > MIN_LENGTH]
    lines = _lines_of(chain, np.zeros((1, chain.n)), target_positions, beside)
    length = np.linalg.norm(lines.end - lines.start, axis=2)[0]

    # Capsules in this order: base and moving bodies, links outside the chain, targets.
    names = [*_body_names(chain), *(link.name for link in beside)]
    if len(target_positions) == 1:
        names.append("target")
    else:
        names += [f"target {number}" for number in range(1, len(target_positions) + 1)]
    moving_count = len(chain.driven)
    link_count = moving_count + 1 + len(beside)
    is_attached = np.zeros(len(names), dtype=bool)
    is_attached[moving_count + 1 : link_count] = True
    attached_bodies = [link.body for link in beside]
    target_bodies = [moving_count] * len(target_positions)
    bodies = np.array([*range(moving_count + 1), *attached_bodies, *target_bodies])
    radii = np.array([link_radius] * link_count + [TARGET_RADIUS] * len(target_positions))

    solid = np.flatnonzero((length > MIN_LENGTH) | is_attached)
    arm_pairs: list[tuple[int, int]] = []
    if within:
        for i in solid.tolist():
            for j in solid.tolist():
                # Neighbours in the chain overlap by construction.
                gap = 0 if is_attached[i] or is_attached[j] else 1
                if bodies[j] > bodies[i] + gap and frozenset((names[i], names[j])) not in ignored:
                    arm_pairs.append((i, j))
    planes = [] if floor is None else [Wall("floor", np.array([0.0, 0.0, 1.0]), floor)]
    planes += walls
    moving = [i for i in solid.tolist() if bodies[i]]
    world_pairs = [(i, number) for number in range(len(planes) + len(obstacles)) for i in moving]
    model = Capsules(
        chain=chain,
        names=tuple(names),
        bodies=bodies,
        radii=radii,
        solid=solid,
        targets=target_positions,
        arm_pairs=np.array(arm_pairs, dtype=int).reshape(-1, 2),
        world_pairs=np.array(world_pairs, dtype=int).reshape(-1, 2),
        walls=tuple(planes),
        obstacles=tuple(obstacles),
        beside=tuple(beside),
    )
    if not model.pairs:
        return model

    count = len(arm_pairs)
    fixed = np.arange(count + len(world_pairs)) >= count
    distances = model.distances(random_joints(chain, SAMPLES, seed))
    touching, excluded = inseparable(model.pairs, distances, fixed, margin, link_radius)
    return replace(
        model,
        arm_pairs=model.arm_pairs[~touching[:count]],
        world_pairs=model.world_pairs[~touching[count:]],
        excluded=excluded,
    )


def _body_names(chain: Chain) -> list[str]:
    """Return the names of the base and of the body after each moving element.

    Args:
        chain: the arm.
    """
    links = chain.links
    if not links:
        links = tuple(f"{name}_link" for name in chain.joint_names)
    main_elements = set(chain.moving.tolist())
    names = [chain.base]
    for k in chain.driven.tolist():
        element = chain.elements[k]
        if k in main_elements:
            names.append(links[element.joint or 0])
        else:
            names.append(f"{element.name}_link")
    return names


def _lines_of(chain: Chain, q: np.ndarray, targets: np.ndarray, beside: Sequence[Attached] = ()) -> _Lines:
    """Return the centre lines of base, moving bodies, links outside the chain and targets at joint values q (m, n).

    Args:
        chain: the arm.
        q: (m, n) joint values [rad or m].
        targets: (T, 3) positions of the targets in the tip's frame [m].
        beside: the links outside the chain.
    """
    walk = sweep(chain, q)
    axes = walk.directions[chain.driven].transpose(2, 0, 1)
    origins = walk.origins[chain.driven].transpose(2, 0, 1)
    # The line of a body behind a sliding joint starts where the joint has moved it.
    body_starts = origins.copy()
    for number, k in enumerate(chain.driven):
        element = chain.elements[k]
        if element.axis[0] == "t":
            travel = element.value + element.ratio * q[:, element.joint]
            body_starts[:, number] += axes[:, number] * travel[:, None]

    tip = walk.position.T[:, None]
    target_points = tip + np.einsum("tc,cdm->mtd", targets, walk.rotation)
    foot = np.broadcast_to([0.0, 0.0, min(chain.floor, 0.0)], (len(q), 1, 3))
    attached_starts, attached_ends = _attached_ends(chain, q, beside)
    target_starts = np.repeat(tip, len(targets), axis=1)
    start = np.concatenate([foot, body_starts, attached_starts, target_starts], axis=1)
    end = np.concatenate([origins, tip, attached_ends, target_points], axis=1)
    return _Lines(start, end, axes, origins)


def _attached_ends(chain: Chain, q: np.ndarray, beside: Sequence[Attached]) -> tuple[np.ndarray, np.ndarray]:
    """Return start and end points (m, E, 3) [m] of the links outside the chain, in the base, at q (m, n).

    Args:
        chain: the arm.
        q: (m, n) joint values [rad or m].
        beside: the E links.
    """
    if not beside:
        return np.empty((len(q), 0, 3)), np.empty((len(q), 0, 3))
    base = np.broadcast_to(np.eye(4), (1, len(q), 4, 4))
    bodies = [link.body for link in beside]
    frames = np.concatenate([base, moving_frames(chain, q)])[bodies]

    def in_base(points: list[np.ndarray]) -> np.ndarray:
        rotated = (frames[..., :3, :3] @ np.array(points)[:, None, :, None])[..., 0]
        return (rotated + frames[..., :3, 3]).swapaxes(0, 1)

    return in_base([link.start for link in beside]), in_base([link.end for link in beside])


def _nearest(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions (...) of the nearest points on the segments a to b and c to d: 0 at a or c, 1 at b or d.

    The ends a, b, c, d of the segments are (..., 3).
    """
    u, v, w = b - a, d - c, a - c
    uu = np.maximum((u * u).sum(-1), MIN_SQUARE)
    vv = np.maximum((v * v).sum(-1), MIN_SQUARE)
    uv = (u * v).sum(-1)
    uw = (u * w).sum(-1)
    vw = (v * w).sum(-1)
    determinant = uu * vv - uv**2
    # Parallel lines: any place will do, the middle of the first.
    skew = determinant > 1e-12 * uu * vv
    s = np.where(skew, np.clip((uv * vw - vv * uw) / np.maximum(determinant, 1e-30), 0, 1), 0.5)
    t = np.clip((uv * s + vw) / vv, 0, 1)
    s = np.clip((uv * t - uw) / uu, 0, 1)
    return s, t


def _point_distances(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances (...) from points `start` to `end` (..., 3), and the unit vectors in this direction."""
    difference = end - start
    distance = np.linalg.norm(difference, axis=-1)
    return distance, difference / np.maximum(distance, TINY)[..., None]

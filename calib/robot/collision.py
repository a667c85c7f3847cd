"""Distances between the links of an arm, the floor and obstacles, computed by Pinocchio and coal.

Shapes are those in the URDF's ``<collision>``: boxes, spheres, cylinders, capsules, and the convex hulls of meshes (our
choice: faster and conservative). A robot without shapes is made of capsules (`calib.robot.capsules`).

Some pairs are not compared: parts of one body, bodies connected by a joint, the fixed base with floor and obstacles,
and pairs that touch in nearly every posture (`calib.robot.capsules.inseparable`, listed in `Collision.excluded`). A
floor or an obstacle that collides with a link in every posture is refused.
"""

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import refuse_robot
from calib.records import shaped
from calib.robot.capsules import MIN_LENGTH, SAMPLES, TARGET_RADIUS, Capsules, closing_speed, inseparable
from calib.robot.chain import Chain, random_joints
from calib.robot.formats import urdf
from calib.robot.formats.native import NativeModel, NativeShape
from calib.robot.formats.simulators import configurations, driven_joints, link_frame
from calib.robot.formats.urdf_tree import Node, is_urdf, numbers, origin, parse, text
from calib.robot.kinematics import sweep
from calib.robot.obstacles import Obstacle, Wall
from calib.transforms import pose

PACKAGE_PATH = "ROS_PACKAGE_PATH"
# Radius [m] of a line of sight, which coal takes for a thin capsule.
SIGHT_RADIUS = 1e-4


@dataclass(frozen=True, eq=False)
class Collision:
    """Collision model of a URDF: pairs of shapes whose distances coal computes.

    Attributes:
        pairs: names of the compared shapes, in the order of the columns of `distances`.
        excluded: pairs that are not compared, since they touch in nearly every posture.
        missing: meshes of the URDF that were not found or not readable; their shapes are ignored.
    """

    pairs: tuple[tuple[str, str], ...]
    excluded: tuple[tuple[str, str], ...]
    missing: tuple[str, ...]
    _model: NativeModel
    _geometry: NativeShape
    _chain: Chain
    _links: int
    _posture: Mapping[str, float]

    @property
    def links(self) -> set[str]:
        """Names of the links that have a shape."""
        shapes = self._geometry.geometryObjects[: self._links]
        return {self._model.frames[shape.parentFrame].name for shape in shapes}

    def distances(self, q: np.ndarray) -> np.ndarray:
        """Return the distances (m, pairs) [m] at joint values q (m, n); negative values are depths of penetration."""
        distances: list[float] = []
        for results in self._distance_results(q):
            distances += [result.min_distance for result in results]
        return np.array(distances).reshape(len(q), len(self.pairs))

    def gradients(self, q: np.ndarray) -> np.ndarray:
        """Return the derivatives (m, pairs, n) of `distances` by the joint values, at q (m, n).

        With the unit normal u from the first shape's nearest point to the second's, d' = u · (velocity of the second
        point - velocity of the first). The effect of the shapes' curvature is of second order. Where nearest points
        jump, the derivative is one-sided.
        """
        shape = (len(q), len(self.pairs), 3)
        normals = np.empty(shape)
        first_points = np.empty(shape)
        second_points = np.empty(shape)
        for row, results in enumerate(self._distance_results(q)):
            for k, result in enumerate(results):
                normals[row, k] = result.normal
                first_points[row, k] = result.getNearestPoint1()
                second_points[row, k] = result.getNearestPoint2()
        # From Pinocchio's world to the arm's base.
        rotation = self._base_pose.rotation
        origin = self._base_pose.translation
        normals = normals @ rotation
        first_points = (first_points - origin) @ rotation
        second_points = (second_points - origin) @ rotation
        pairs = self._geometry.collisionPairs
        second_speed = self._closing_speed(q, normals, second_points, [pair.second for pair in pairs])
        first_speed = self._closing_speed(q, normals, first_points, [pair.first for pair in pairs])
        return second_speed - first_speed

    def beam(self, q: np.ndarray, start: np.ndarray, slope: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the links' distances from the lines of sight to a target, with derivatives.

        The result is that of `calib.robot.capsules.Capsules.beam`: distances (m, L) [m] of L links, and derivatives.

        Args:
            q: (m, n) joint values [rad or m].
            start: (m, 3) position of the target [m].
            slope: (m, 3, n) derivative of `start` by the joint values.
            end: (3,) or (m, 3), position of the instrument in the base frame [m].
        """
        pin, coal = _libraries()
        data = self._model.createData()
        geometry_data = pin.GeometryData(self._geometry)
        tip = self._model.frames[link_frame(self._model, self._chain.tip)].parentJoint
        shapes = self._geometry.geometryObjects
        links = [k for k in range(self._links) if shapes[k].parentJoint != tip]
        distances, shares = np.empty((2, len(q), len(links)))
        normals, points = np.empty((2, len(q), len(links), 3))
        request = coal.DistanceRequest(True, coal.GJKInitialGuess.DefaultGuess)
        ends = np.broadcast_to(end, start.shape)
        for i, configuration in enumerate(self._configurations(q)):
            pin.updateGeometryPlacements(self._model, data, self._geometry, geometry_data, configuration)
            sight = ends[i] - start[i]
            length = float(np.linalg.norm(sight))
            rotation = Rotation.align_vectors(sight[None] / length, [[0.0, 0.0, 1.0]])[0].as_matrix()
            ray = coal.Capsule(SIGHT_RADIUS, length)
            ray_pose = coal.Transform3s(rotation, start[i] + sight / 2)
            for column, k in enumerate(links):
                result = coal.DistanceResult()
                T_base_link = self._base_pose.actInv(geometry_data.oMg[k])
                link_pose = coal.Transform3s(T_base_link.rotation, T_base_link.translation)
                link_shape = shapes[k].geometry
                distances[i, column] = coal.distance(ray, ray_pose, link_shape, link_pose, request, result)
                normals[i, column] = result.normal
                points[i, column] = result.getNearestPoint2()
                share = (result.getNearestPoint1() - start[i]) @ sight / length**2
                shares[i, column] = np.clip(share, 0.0, 1.0)
        # Joints move the link, and the target's end of the line of sight with it.
        link_speed = self._closing_speed(q, normals, points, links)
        sight_speed = (1.0 - shares)[..., None] * (normals @ slope)
        return distances, link_speed - sight_speed

    def _distance_results(self, q: np.ndarray) -> Iterator[Sequence[NativeShape]]:
        """Yield coal's distance results for all pairs, for each row of joint values q (m, n)."""
        pin, _ = _libraries()
        data = self._model.createData()
        geometry_data = self._geometry.createData()
        q = shaped(q, (None, self._chain.n), f"joint values of '{self._chain.name}'")
        for configuration in self._configurations(q):
            pin.computeDistances(self._model, data, self._geometry, geometry_data, configuration)
            yield geometry_data.distanceResults

    def _configurations(self, q: np.ndarray) -> np.ndarray:
        """Return Pinocchio's configurations (m, nq) at q (m, n); joints outside the chain have their fixed values."""
        result = configurations(self._model, self._chain, q)
        set_still(self._model, result, self._posture)
        return result

    def _closing_speed(self, q: np.ndarray, normal: np.ndarray, point: np.ndarray, shapes: list[int]) -> np.ndarray:
        """Return the speed (m, P, n) of points along normals, per unit speed of each joint.

        Args:
            q: (m, n) joint values [rad or m].
            normal: (m, P, 3) unit normals.
            point: (m, P, 3) positions of the points [m].
            shapes: (P,) index of the shape to which each point belongs.
        """
        walk = sweep(self._chain, q)
        axes = walk.directions[self._chain.driven].transpose(2, 0, 1)
        origins = walk.origins[self._chain.driven].transpose(2, 0, 1)
        return closing_speed(self._chain, axes, origins, normal, point, self._bodies[shapes])

    @cached_property
    def _base_pose(self) -> NativeShape:
        """Pose of the arm's base in Pinocchio's world, as Pinocchio's SE3."""
        return _link_pose(self._model, self._chain.base, self._posture)

    @cached_property
    def _bodies(self) -> np.ndarray:
        """Number of the chain's moving elements before each shape."""
        driven = {joint.id for joint in driven_joints(self._model, self._chain)}
        counts = []
        for shape in self._geometry.geometryObjects:
            joints_above = self._model.supports[shape.parentJoint]
            counts.append(sum(joint in driven for joint in joints_above))
        return np.array(counts, dtype=int)

    def free(self, q: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Return at which joint values q (m, n) all distances are larger than `margin` [m], (m,) bool."""
        return np.all(self.distances(q) > margin, axis=1)


DistanceModel: TypeAlias = Collision | Capsules
"""Collision model of an arm in its surroundings."""


def from_urdf(
    path: str | Path,
    base: str | None = None,
    tip: str | None = None,
    floor: float | None = None,
    obstacles: Sequence[Obstacle] = (),
    mesh_folders: Sequence[str | Path] = (),
    *,
    walls: Sequence[Wall] = (),
    targets: np.ndarray | Sequence[Sequence[float]] = (),
    margin: float = 0.0,
    within: bool = True,
    ignored: Collection[frozenset[str]] = (),
    posture: Mapping[str, float] | None = None,
    seed: int = 0,
) -> Collision:
    """Return the collision model of a URDF's collision shapes; joints outside the chain are fixed.

    Args:
        path: the URDF.
        base, tip: links at the ends of the arm; None: chosen by `calib.robot.formats.arm_ends`.
        floor: height of a floor in the base frame [m]; None for no floor.
        obstacles: obstacles in the base frame.
        mesh_folders: folders in which ``package://name/...`` is searched, besides the URDF's folder and its parents.
        walls: planes that the arm must not cross.
        targets: (T, 3) positions of the measured targets in the tip's frame [m]; each is represented by a thin capsule
            from the tip.
        margin: the least distance that will be required [m]; pairs that are nearer in nearly all postures are excluded
            (`calib.robot.capsules.inseparable`).
        within: whether parts of the arm are compared with each other.
        ignored: pairs of names of links that are not compared.
        posture: values of joints outside the chain [rad or m]; all others are zero. None: all are zero.
        seed: seed of the random postures that determine the excluded pairs.

    Raises:
        RobotError: the URDF has no usable collision shape.
    """
    pin, _ = _libraries()
    source = text(path)[0]
    chain = urdf.parse(source, str(path), base, tip)
    model = pin.buildModelFromXML(source)
    folders = [*map(Path, mesh_folders), *Path(path).resolve().parents]
    geometry = pin.GeometryModel()
    missing: list[str] = []
    for link in parse(source, str(path)).all("link"):
        link_name = link.attributes.get("name", "")
        for number, node in enumerate(link.all("collision")):
            where = f"{path}, line {node.line}, link '{link_name}'"
            shape = _shape(node.first("geometry"), folders, missing, where)
            if shape is not None:
                shape_name = f"{link_name}_{number}" if number else link_name
                _attach(model, geometry, link_name, shape_name, origin(node, where), shape)
    if geometry.ngeoms == 0:
        hint = f" ({len(missing)} meshes were not found, e.g. {missing[0]})" if missing else ""
        refuse_robot(path, f"no usable <collision> shape{hint}; give mesh_folders, or use capsules")
    _add_targets(model, geometry, chain, targets)
    arm_count = geometry.ngeoms

    posture = posture or {}
    planes = [] if floor is None else [Wall("floor", np.array([0.0, 0.0, 1.0]), floor)]
    planes += walls
    _surround(geometry, _link_pose(model, chain.base, posture), planes, obstacles)
    joints = [shape.parentJoint for shape in geometry.geometryObjects]
    links = [model.frames[shape.parentFrame].name for shape in geometry.geometryObjects]
    for first in range(arm_count):
        for second in range(first + 1, len(joints)):
            i, j = sorted((joints[first], joints[second]))
            if i == j:
                continue
            link_pair = frozenset((links[first], links[second]))
            compared = within and model.parents[j] != i and link_pair not in ignored
            if second >= arm_count or compared:
                geometry.addCollisionPair(pin.CollisionPair(first, second))
    collision = Collision(_pair_names(geometry), (), tuple(missing), model, geometry, chain, arm_count, posture)
    if not collision.pairs:
        return collision
    return _without_inseparable(collision, margin, seed)


def _add_targets(
    model: NativeModel, geometry: NativeShape, chain: Chain, targets: np.ndarray | Sequence[Sequence[float]]
) -> None:
    """Add thin capsules from the tip to each target to `geometry`; `targets` (T, 3) are in the tip's frame [m].

    Args:
        model: Pinocchio's model of the arm.
        geometry: coal's shapes, to which is added.
        chain: the arm.
        targets: (T, 3) positions of the targets in the tip's frame [m].
    """
    _, coal = _libraries()
    for number, position in enumerate(np.asarray(targets, dtype=float).reshape(-1, 3), 1):
        length = float(np.linalg.norm(position))
        if length > MIN_LENGTH:
            rotation = Rotation.align_vectors(position[None] / length, [[0.0, 0.0, 1.0]])[0]
            name = "target" if len(targets) == 1 else f"target {number}"
            shape = coal.Capsule(TARGET_RADIUS, length)
            _attach(model, geometry, chain.tip, name, pose(rotation, position / 2), shape)


def _without_inseparable(collision: Collision, margin: float, seed: int) -> Collision:
    """Return the collision model without the pairs that touch in nearly every posture.

    Args:
        collision: the model.
        margin: the least distance that will be required [m].
        seed: seed of the random postures.
    """
    geometry = collision._geometry
    fixed = np.array([pair.second >= collision._links for pair in geometry.collisionPairs])
    distances = collision.distances(random_joints(collision._chain, SAMPLES, seed))
    touching, excluded = inseparable(collision.pairs, distances, fixed, margin)
    for index in np.flatnonzero(touching)[::-1]:
        geometry.removeCollisionPair(geometry.collisionPairs[int(index)])
    return replace(collision, pairs=_pair_names(geometry), excluded=excluded)


def _pair_names(geometry: NativeShape) -> tuple[tuple[str, str], ...]:
    shapes = geometry.geometryObjects
    return tuple((shapes[pair.first].name, shapes[pair.second].name) for pair in geometry.collisionPairs)


def _attach(
    model: NativeModel, geometry: NativeShape, link: str, name: str, placed: np.ndarray, shape: NativeShape
) -> None:
    """Add a shape to `geometry`, fixed to a link's frame.

    Args:
        model, geometry: Pinocchio's models.
        link: name of the link.
        name: name of the shape.
        placed: (4, 4) pose of the shape in the link's frame.
        shape: the shape.
    """
    pin, _ = _libraries()
    index = link_frame(model, link)
    frame = model.frames[index]
    placement = frame.placement * pin.SE3(placed[:3, :3], placed[:3, 3])
    geometry.addGeometryObject(pin.GeometryObject(name, frame.parentJoint, index, placement, shape))


def _surround(
    geometry: NativeShape, base_pose: NativeShape, walls: Sequence[Wall], obstacles: Sequence[Obstacle]
) -> None:
    """Add walls and obstacles to `geometry`, fixed in the world, from their poses in the arm's base.

    Args:
        geometry: coal's shapes, to which is added.
        base_pose: pose of the arm's base in the world, as Pinocchio's SE3.
        walls, obstacles: walls and obstacles in the base frame.
    """
    pin, coal = _libraries()

    def add(name: str, shape: NativeShape, T_base_shape: np.ndarray) -> None:
        placement = base_pose * pin.SE3(T_base_shape[:3, :3], T_base_shape[:3, 3])
        geometry.addGeometryObject(pin.GeometryObject(name, 0, 0, placement, shape))

    for wall in walls:
        add(wall.name, coal.Halfspace(wall.normal, wall.offset), np.eye(4))
    for obstacle in obstacles:
        add(obstacle.name, _solid(obstacle.kind, obstacle.size), obstacle.placement)


def _solid(kind: str, sizes: Sequence[float]) -> NativeShape:
    _, coal = _libraries()
    makers = {"box": coal.Box, "sphere": coal.Sphere, "cylinder": coal.Cylinder, "capsule": coal.Capsule}
    return makers[kind](*map(float, sizes))


def set_still(model: NativeModel, configurations: np.ndarray, posture: Mapping[str, float]) -> None:
    """Write the values of joints outside the chain [rad or m], by name, into Pinocchio's configurations (m, nq).

    Args:
        model: Pinocchio's model.
        configurations: (m, nq), changed in place.
        posture: values of joints outside the chain [rad or m], by name.
    """
    for name, value in posture.items():
        joint = model.joints[model.getJointId(name)]
        values = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        configurations[:, joint.idx_q : joint.idx_q + joint.nq] = values


def _link_pose(model: NativeModel, link: str, posture: Mapping[str, float]) -> NativeShape:
    """Return the pose of a link in Pinocchio's world; joints have the values in `posture`, or else zero.

    Args:
        model: Pinocchio's model.
        link: name of the link.
        posture: values of joints by name [rad or m].
    """
    pin, _ = _libraries()
    data = model.createData()
    configuration = pin.neutral(model)[None]
    set_still(model, configuration, posture)
    pin.framesForwardKinematics(model, data, configuration[0])
    return data.oMf[link_frame(model, link)].copy()


def _shape(node: Node | None, folders: Sequence[Path], missing: list[str], where: str) -> NativeShape | None:
    """Return the coal shape of a <geometry> node; for an unreadable mesh None, and its name is added to `missing`.

    Args:
        node: the XML element; None for a missing one, which has no shape.
        folders: folders in which meshes are searched.
        missing: names of unreadable meshes, extended in place.
        where: name of the link in messages.
    """
    kind = node.children[0] if node is not None and node.children else None
    if kind is None:
        refuse_robot(where, "<collision> without a shape: add a <geometry>")
    if kind.tag == "mesh":
        return _hull(kind, folders, missing, where)
    if kind.tag == "box":
        return _solid(kind.tag, numbers(kind, "size", where).tolist())
    if kind.tag not in ("sphere", "cylinder", "capsule"):
        refuse_robot(where, f"<{kind.tag}> is not one of box, sphere, cylinder, capsule, mesh")
    sizes = [numbers(kind, "radius", where, count=1)[0]]
    if kind.tag != "sphere":
        sizes.append(numbers(kind, "length", where, count=1)[0])
    return _solid(kind.tag, sizes)


def _hull(node: Node, folders: Sequence[Path], missing: list[str], where: str) -> NativeShape | None:
    """Return the scaled convex hull of a mesh file; if it is unreadable None, and its name is added to `missing`.

    Args:
        node: the XML element <mesh>.
        folders: folders in which the mesh is searched.
        missing: names of unreadable meshes, extended in place.
        where: name of the link in messages.
    """
    _, coal = _libraries()
    name = node.attributes.get("filename", "")
    path = find_mesh(name, folders)
    if path is None:
        missing.append(name)
        return None
    scale = numbers(node, "scale", where, "1 1 1")
    try:
        mesh = coal.MeshLoader().load(str(path), scale)
        mesh.buildConvexHull(True, "Qt")
        return mesh.convex
    except Exception as error:
        missing.append(f"{name} ({error})")
        return None


def find_mesh(name: str, folders: Sequence[Path]) -> Path | None:
    """Return the file of a mesh that a URDF names (a path, ``file://`` or ``package://``); None if it is not found.

    Args:
        name: the mesh as named in the URDF.
        folders: folders in which it is searched.
    """
    if name.startswith("file://"):
        name = name.removeprefix("file://")
    variants = [name]
    if name.startswith("package://"):
        inner = name.removeprefix("package://")
        variants = [inner, inner.partition("/")[2]]
    for folder in (*folders, *package_folders()):
        for variant in variants:
            path = folder / variant
            if path.is_file():
                return path
    return None


def package_folders() -> list[Path]:
    """Return the folders with ROS packages: those of ``ROS_PACKAGE_PATH``, and those of the installed ROS."""
    sources = os.environ.get(PACKAGE_PATH, "").split(os.pathsep)
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    folders = [Path(source) for source in sources if source]
    folders += [Path(prefix, "share") for prefix in prefixes if prefix]
    return folders


def meshes_beside(path: Path) -> dict[str, Path | str]:
    """Return the mesh files of a URDF's collision shapes, by the paths that they need next to a copy of the URDF.

    The copy is in ``1-robot``. Meshes with absolute names, or with names that lead out of the URDF's folder, are left
    out.
    """
    if not is_urdf(path):
        return {}
    folders = list(path.resolve().parents)
    meshes: dict[str, Path | str] = {}
    for _, _, node in urdf_meshes(path, "collision"):
        name = node.attributes.get("filename", "")
        mesh = find_mesh(name, folders)
        inner = name.removeprefix("package://")
        leaves_folder = inner.startswith(("/", "file:")) or ".." in Path(inner).parts
        if mesh is not None and not leaves_folder:
            meshes[f"1-robot/{inner}"] = mesh
    return meshes


def urdf_meshes(path: str | Path, tag: str) -> list[tuple[Node, Node, Node]]:
    """Return each mesh in a URDF's ``<visual>`` or ``<collision>`` elements (`tag`): link, that element, and mesh.

    Args:
        path: the URDF.
        tag: ``visual`` or ``collision``.
    """
    meshes: list[tuple[Node, Node, Node]] = []
    for link in parse(text(path)[0], str(path)).all("link"):
        for node in link.all(tag):
            for geometry in node.all("geometry"):
                meshes += [(link, node, mesh) for mesh in geometry.all("mesh")]
    return meshes


def _libraries() -> tuple[ModuleType, ModuleType]:
    """Return the modules pinocchio and coal; they are imported only here, when collisions are computed."""
    import coal
    import pinocchio

    return pinocchio, coal

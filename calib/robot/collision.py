"""Distances between the links of an arm, the floor and obstacles, computed by Pinocchio and coal.

Shapes come from the URDF's ``<collision>``: boxes, spheres, cylinders, capsules, and meshes by their convex hull (our
choice: faster and on the safe side). A robot without shapes is made of capsules (`calib.robot.capsules`).

Not compared: parts of one body, bodies joined by a joint, the fixed base with floor and obstacles, and pairs that
touch in nearly every posture (`calib.robot.capsules.inseparable`, listed in `Collision.excluded`). A floor or an
obstacle that a link never leaves is refused.
"""

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import refuse_robot
from calib.records import shaped
from calib.robot.capsules import SAMPLES, TARGET_RADIUS, Obstacle, Wall, closing, inseparable
from calib.robot.chain import Chain, random_joints
from calib.robot.formats import urdf
from calib.robot.formats.simulators import configurations, driven_joints, link_frame
from calib.robot.formats.urdf_tree import Node, is_urdf, numbers, origin, parse, text
from calib.robot.kinematics import sweep
from calib.transforms import pose

PACKAGE_PATH = "ROS_PACKAGE_PATH"


@dataclass(frozen=True, eq=False)
class Collision:
    """Collision model of a URDF: pairs of shapes whose distances are computed by coal.

    Attributes:
        pairs: names of the shapes compared, in the order of the columns of `distances`.
        excluded: pairs that are not compared, since they touch in nearly every posture.
        missing: meshes of the URDF that were not found or not readable; their shapes are ignored.
    """

    pairs: tuple[tuple[str, str], ...]
    excluded: tuple[tuple[str, str], ...]
    missing: tuple[str, ...]
    _model: Any
    _geometry: Any
    _chain: Chain
    _links: int
    _posture: Mapping[str, float]

    @property
    def links(self) -> set[str]:
        """Names of the links that have a shape."""
        return {self._model.frames[shape.parentFrame].name for shape in self._geometry.geometryObjects[: self._links]}

    def distances(self, q: np.ndarray) -> np.ndarray:
        """Return the distances (m, pairs) [m] at joint values q (m, n); negative: depth of penetration."""
        found = [[one.min_distance for one in measured] for measured in self._measured(q)]
        return np.array(found).reshape(len(q), len(self.pairs))

    def gradients(self, q: np.ndarray) -> np.ndarray:
        """Return the derivatives (m, pairs, n) of `distances` with respect to q (m, n).

        With the normal u from the first shape's nearest point to the second's: d' = u · (velocity of the second point -
        velocity of the first), the shapes' curvature being of second order. One-sided where nearest points jump.
        """
        found = np.empty((3, len(q), len(self.pairs), 3))
        for row, measured in enumerate(self._measured(q)):
            for k, one in enumerate(measured):
                found[:, row, k] = one.normal, one.getNearestPoint1(), one.getNearestPoint2()
        turn, foot = self._stand.rotation, self._stand.translation
        normal, first, second = found[0] @ turn, (found[1] - foot) @ turn, (found[2] - foot) @ turn
        pairs = self._geometry.collisionPairs
        slope = self._closing(q, normal, second, [pair.second for pair in pairs])
        return slope - self._closing(q, normal, first, [pair.first for pair in pairs])

    def beam(self, q: np.ndarray, start: np.ndarray, slope: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the links' distances from lines of sight; see `calib.robot.capsules.Capsules.beam`."""
        pin, coal = _libraries()
        data, placed = self._model.createData(), pin.GeometryData(self._geometry)
        tip = self._model.frames[link_frame(self._model, self._chain.tip)].parentJoint
        shapes = self._geometry.geometryObjects
        links = [k for k in range(self._links) if shapes[k].parentJoint != tip]
        distances, shares = np.empty((2, len(q), len(links)))
        normals, points = np.empty((2, len(q), len(links), 3))
        asked, ends = coal.DistanceRequest(True, coal.GJKInitialGuess.DefaultGuess), np.broadcast_to(end, start.shape)
        for i, configuration in enumerate(self._configurations(q)):
            pin.updateGeometryPlacements(self._model, data, self._geometry, placed, configuration)
            away = ends[i] - start[i]
            length = float(np.linalg.norm(away))
            turned = Rotation.align_vectors(away[None] / length, [[0.0, 0.0, 1.0]])[0].as_matrix()
            ray, middle = coal.Capsule(1e-4, length), coal.Transform3s(turned, start[i] + away / 2)
            for column, k in enumerate(links):
                found, there = coal.DistanceResult(), self._stand.actInv(placed.oMg[k])
                there = coal.Transform3s(there.rotation, there.translation)
                distances[i, column] = coal.distance(ray, middle, shapes[k].geometry, there, asked, found)
                normals[i, column], points[i, column] = found.normal, found.getNearestPoint2()
                shares[i, column] = np.clip((found.getNearestPoint1() - start[i]) @ away / length**2, 0.0, 1.0)
        return distances, self._closing(q, normals, points, links) - (1.0 - shares)[..., None] * (normals @ slope)

    def _measured(self, q: np.ndarray) -> Iterator[Any]:
        """Yield coal's distance results of all pairs, for each row of joint values q (m, n)."""
        pin, _ = _libraries()
        data, measured = self._model.createData(), self._geometry.createData()
        q = shaped(q, (None, self._chain.n), f"joint values of '{self._chain.name}'")
        for configuration in self._configurations(q):
            pin.computeDistances(self._model, data, self._geometry, measured, configuration)
            yield measured.distanceResults

    def _configurations(self, q: np.ndarray) -> np.ndarray:
        """Return Pinocchio's configurations (m, nq) at joint values q (m, n), other joints at the posture."""
        result = configurations(self._model, self._chain, q)
        set_still(self._model, result, self._posture)
        return result

    def _closing(self, q: np.ndarray, normal: np.ndarray, point: np.ndarray, shapes: list[int]) -> np.ndarray:
        """Return the speed along normals (m, P, n) of points (m, P, 3) on shapes (P,), per unit of each joint."""
        walked = sweep(self._chain, q)
        axes, places = (part[self._chain.driven].transpose(2, 0, 1) for part in (walked.directions, walked.origins))
        return closing(self._chain, axes, places, normal, point, self._bodies[shapes])

    @cached_property
    def _stand(self) -> Any:
        """Pose of the base in Pinocchio's world."""
        return _stand(self._model, self._chain.base, self._posture)

    @cached_property
    def _bodies(self) -> np.ndarray:
        """Number of the chain's moving elements before each shape."""
        driven = {joint.id for joint in driven_joints(self._model, self._chain)}
        carriers = [self._model.supports[shape.parentJoint] for shape in self._geometry.geometryObjects]
        return np.array([sum(joint in driven for joint in above) for above in carriers], dtype=int)

    def free(self, q: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Return the mask (m,) of joint values q (m, n) with all distances larger than `margin` [m]."""
        return np.all(self.distances(q) > margin, axis=1)


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
    """Return the collision model of a URDF's collision shapes; joints outside the chain stand still.

    Args:
        path: the URDF.
        base, tip: see `calib.robot.formats.arm_ends`.
        floor: height of a floor in the base frame [m]; None for no floor.
        obstacles: in the base frame.
        mesh_folders: where ``package://name/...`` is looked for, besides the URDF's folder and the ones above it.
        walls: that it does not pass.
        targets: (T, 3) of what is measured, in the tip's frame [m]: each a thin capsule from the tip.
        margin: the least distance that will be asked for [m]; pairs that never have it are left out.
        within: False: parts of the arm are not compared with each other.
        ignored: pairs of links that are not compared.
        posture: values of joints outside the chain [rad or m] that do not stand at zero.
        seed: of the random postures that show which pairs those are.

    Raises:
        RobotError: where the URDF has no usable collision shape.
    """
    pin, _ = _libraries()
    source = text(path)[0]
    chain = urdf.parse(source, str(path), base, tip)
    model = pin.buildModelFromXML(source)
    folders = [*map(Path, mesh_folders), *Path(path).resolve().parents]
    geometry, missing = pin.GeometryModel(), []
    for link in parse(source, str(path)).all("link"):
        for number, node in enumerate(link.all("collision")):
            place = f"{path}, line {node.line}, link '{link.attributes['name']}'"
            shape = _shape(node.first("geometry"), folders, missing, place)
            if shape is not None:
                name = link.attributes["name"] + (f"_{number}" if number else "")
                _attach(model, geometry, link.attributes["name"], name, origin(node, place), shape)
    if geometry.ngeoms == 0:
        lost = f" ({len(missing)} meshes were not found, e.g. {missing[0]})" if missing else ""
        refuse_robot(path, f"no usable <collision> shape{lost}; give mesh_folders, or use capsules")
    _add_targets(model, geometry, chain, targets)
    own = geometry.ngeoms
    planes = [*([] if floor is None else [Wall("floor", np.array([0.0, 0.0, 1.0]), floor)]), *walls]
    _surround(geometry, _stand(model, chain.base, posture or {}), planes, obstacles)
    carriers = [shape.parentJoint for shape in geometry.geometryObjects]
    links = [model.frames[shape.parentFrame].name for shape in geometry.geometryObjects]
    for one in range(own):
        for two in range(one + 1, len(carriers)):
            i, j = sorted((carriers[one], carriers[two]))
            compared = within and model.parents[j] != i and frozenset((links[one], links[two])) not in ignored
            if i != j and (two >= own or compared):
                geometry.addCollisionPair(pin.CollisionPair(one, two))
    found = Collision(_names(geometry), (), tuple(missing), model, geometry, chain, own, posture or {})
    return _without_inseparable(found, margin, seed) if found.pairs else found


def _add_targets(model: Any, geometry: Any, chain: Chain, targets: np.ndarray | Sequence[Sequence[float]]) -> None:
    """Attach targets (T, 3) [m] to the tip's frame, as thin capsules."""
    _, coal = _libraries()
    for number, place in enumerate(np.asarray(targets, dtype=float).reshape(-1, 3), 1):
        if (length := float(np.linalg.norm(place))) > 1e-6:
            along = Rotation.align_vectors(place[None] / length, [[0.0, 0.0, 1.0]])[0]
            name = "target" if len(targets) == 1 else f"target {number}"
            _attach(model, geometry, chain.tip, name, pose(along, place / 2), coal.Capsule(TARGET_RADIUS, length))


def _without_inseparable(found: Collision, margin: float, seed: int) -> Collision:
    """Return the collision model without the pairs that touch in nearly every posture."""
    geometry = found._geometry
    fixed = np.array([pair.second >= found._links for pair in geometry.collisionPairs])
    distances = found.distances(random_joints(found._chain, SAMPLES, seed))
    gone, excluded = inseparable(found.pairs, distances, fixed, margin)
    for index in np.flatnonzero(gone)[::-1]:
        geometry.removeCollisionPair(geometry.collisionPairs[int(index)])
    return replace(found, pairs=_names(geometry), excluded=excluded)


def _names(geometry: Any) -> tuple[tuple[str, str], ...]:
    shapes = geometry.geometryObjects
    return tuple((shapes[pair.first].name, shapes[pair.second].name) for pair in geometry.collisionPairs)


def _attach(model: Any, geometry: Any, link: str, name: str, placed: np.ndarray, shape: Any) -> None:
    """Add a shape to `geometry`, attached to a link's frame."""
    pin, _ = _libraries()
    index = link_frame(model, link)
    frame = model.frames[index]
    placement = frame.placement * pin.SE3(placed[:3, :3], placed[:3, 3])
    geometry.addGeometryObject(pin.GeometryObject(name, frame.parentJoint, index, placement, shape))


def _surround(geometry: Any, stand: Any, walls: Sequence[Wall], obstacles: Sequence[Obstacle]) -> None:
    """Add walls and obstacles to `geometry`, fixed relative to the base, whose pose is `stand`."""
    pin, coal = _libraries()
    things: list[Any] = [(wall.name, coal.Halfspace(wall.normal, wall.offset), np.eye(4)) for wall in walls]
    things += [(obstacle.name, _solid(obstacle.kind, obstacle.size), obstacle.placement) for obstacle in obstacles]
    for name, shape, placed in things:
        placement = stand * pin.SE3(placed[:3, :3], placed[:3, 3])
        geometry.addGeometryObject(pin.GeometryObject(name, 0, 0, placement, shape))


def _solid(kind: str, sizes: Sequence[float]) -> Any:
    _, coal = _libraries()
    makers = {"box": coal.Box, "sphere": coal.Sphere, "cylinder": coal.Cylinder, "capsule": coal.Capsule}
    return makers[kind](*map(float, sizes))


def set_still(model: Any, configurations: np.ndarray, posture: Mapping[str, float]) -> None:
    """Write the values of the joints of a posture [rad or m] into Pinocchio's configurations (m, nq)."""
    for name, value in posture.items():
        joint = model.joints[model.getJointId(name)]
        values = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        configurations[:, joint.idx_q : joint.idx_q + joint.nq] = values


def _stand(model: Any, base: str, posture: Mapping[str, float]) -> Any:
    """Return the pose of the base in Pinocchio's world, at zero joints but those of a posture."""
    pin, _ = _libraries()
    data = model.createData()
    still = pin.neutral(model)[None]
    set_still(model, still, posture)
    pin.framesForwardKinematics(model, data, still[0])
    return data.oMf[link_frame(model, base)].copy()


def _shape(node: Node | None, folders: Sequence[Path], missing: list[str], place: str) -> Any | None:
    """Return the coal shape of a <geometry>; None, with an entry in `missing`, for an unreadable mesh."""
    kind = node.children[0] if node is not None and node.children else None
    if kind is None:
        refuse_robot(place, "<collision> without a shape")
    if kind.tag == "mesh":
        return _hull(kind, folders, missing, place)
    if kind.tag == "box":
        return _solid(kind.tag, numbers(kind, "size", place).tolist())
    if kind.tag not in ("sphere", "cylinder", "capsule"):
        refuse_robot(place, f"<{kind.tag}> is not one of box, sphere, cylinder, capsule, mesh")
    keys = ("radius",) if kind.tag == "sphere" else ("radius", "length")
    return _solid(kind.tag, [numbers(kind, key, place, count=1)[0] for key in keys])


def _hull(node: Node, folders: Sequence[Path], missing: list[str], place: str) -> Any | None:
    """Return the scaled convex hull of a mesh file; None, with an entry in `missing`, if unreadable."""
    _, coal = _libraries()
    name = node.attributes.get("filename", "")
    path = find_mesh(name, folders)
    if path is None:
        missing.append(name)
        return None
    scale = numbers(node, "scale", place, "1 1 1")
    try:
        mesh = coal.MeshLoader().load(str(path), scale)
        mesh.buildConvexHull(True, "Qt")
        return mesh.convex
    except Exception as error:
        missing.append(f"{name} ({error})")
        return None


def find_mesh(name: str, folders: Sequence[Path]) -> Path | None:
    """Return the path of a mesh by its name in a URDF; None if no folder contains it."""
    if name.startswith("file://"):
        name = name.removeprefix("file://")
    variants = [name]
    if name.startswith("package://"):
        inner = name.removeprefix("package://")
        variants = [inner, inner.partition("/")[2]]
    found = (folder / variant for folder in (*folders, *package_folders()) for variant in variants)
    return next((path for path in found if path.is_file()), None)


def package_folders() -> list[Path]:
    """Return the folders that hold ROS packages: of ``ROS_PACKAGE_PATH``, and of the installed ROS."""
    places = [Path(one) for one in os.environ.get(PACKAGE_PATH, "").split(os.pathsep) if one]
    return places + [Path(one, "share") for one in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if one]


def meshes_beside(path: Path) -> dict[str, Path | str]:
    """Return the mesh files of a URDF's collision shapes, by their paths next to its copy in ``1-robot``.

    Names from the root, or that lead out of their folder, are left out: a copy of the URDF finds them, or nothing does.
    """
    if not is_urdf(path):
        return {}
    folders, found = list(path.resolve().parents), dict[str, Path | str]()
    for _, _, node in urdf_meshes(path, "collision"):
        name = node.attributes.get("filename", "")
        inner, mesh = name.removeprefix("package://"), find_mesh(name, folders)
        if mesh is not None and not inner.startswith(("/", "file:")) and ".." not in Path(inner).parts:
            found[f"1-robot/{inner}"] = mesh
    return found


def urdf_meshes(path: str | Path, tag: str) -> list[tuple[Node, Node, Node]]:
    """Return each mesh of a URDF's ``<visual>`` or ``<collision>`` elements, with its link and its element."""
    shapes = [(link, node) for link in parse(text(path)[0], str(path)).all("link") for node in link.all(tag)]
    return [(*own, mesh) for own in shapes for shape in own[1].all("geometry") for mesh in shape.all("mesh")]


def _libraries() -> tuple[Any, Any]:
    """Return the modules pinocchio and coal, imported only when collisions are computed."""
    import coal
    import pinocchio

    return pinocchio, coal

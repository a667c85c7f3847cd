"""Distances between the parts of an arm, the floor and obstacles, by Pinocchio and coal.

Shapes come from the URDF's ``<collision>``: boxes, spheres, cylinders, capsules, and meshes by their convex hull (our
choice: faster and on the safe side). A robot without shapes gets one capsule of a stated radius per body, from the
body's frame to the next one (`from_chain`): coarse where links bend away from the line between frames.

Not compared: parts of one body, bodies joined by a joint, the fixed base with floor and obstacles, and pairs that touch
in at least 95 % of 200 random postures (as MoveIt's setup assistant does); the last are listed in `Collision.excluded`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.arrays import shaped
from calib.errors import RobotError
from calib.robot.chain import Chain, random_joints
from calib.robot.formats import urdf
from calib.robot.formats.markup import Node, parse, text
from calib.robot.formats.urdf_tree import origin
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.formats.urdf_write import write_new
from calib.transforms import pose

ALWAYS = 0.95
SAMPLES = 200


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A fixed thing in the arm's base frame.

    Attributes:
        kind: "box" (size: three edges), "sphere" (radius) or "cylinder" (radius, length along its z) [m].
        placement: (4, 4), where its middle is.
    """

    name: str
    kind: str
    size: tuple[float, ...]
    placement: np.ndarray


@dataclass(frozen=True)
class Column:
    """Where value + ratio · q of a joint goes in Pinocchio's configuration, and its rate in the velocity."""

    place: int
    joint: int
    ratio: float
    offset: float
    circular: bool
    speed: int


@dataclass(frozen=True, eq=False)
class Collision:
    """Pairs of shapes and what it takes to measure between them.

    Attributes:
        pairs: names of the shapes compared, in the order of the columns of `distances`.
        excluded: pairs left out because they touch in nearly every posture.
        missing: meshes of the URDF that were not found or not readable; their shapes are left out.
    """

    pairs: tuple[tuple[str, str], ...]
    excluded: tuple[tuple[str, str], ...]
    missing: tuple[str, ...]
    _model: Any
    _geometry: Any
    _chain: Chain
    _columns: tuple[Column, ...]

    def distances(self, q: np.ndarray) -> np.ndarray:
        """Return the distances (m, pairs) [m] at joint values q (m, n); negative is the depth of a penetration."""
        pin, _ = _libraries()
        q = shaped(q, (None, self._chain.n), f"joint values of '{self._chain.name}'")
        data, measured = self._model.createData(), self._geometry.createData()
        result = np.empty((len(q), len(self.pairs)))
        for row, configuration in zip(result, _configurations(self._model, self._columns, q), strict=True):
            pin.computeDistances(self._model, data, self._geometry, measured, configuration)
            row[:] = [found.min_distance for found in measured.distanceResults]
        return result

    def gradients(self, q: np.ndarray) -> np.ndarray:
        """Return the derivatives (m, pairs, n) of `distances` with respect to q (m, n).

        With the normal u from the first shape's nearest point to the second's: d' = u · (velocity of the second point -
        velocity of the first), the shapes' curvature being of second order. One-sided where nearest points jump.
        """
        pin, _ = _libraries()
        q = shaped(q, (None, self._chain.n), f"joint values of '{self._chain.name}'")
        data, measured = self._model.createData(), self._geometry.createData()
        shapes, world = self._geometry.geometryObjects, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        ends = np.array([(shapes[pair.first].parentJoint, shapes[pair.second].parentJoint)
                         for pair in self._geometry.collisionPairs], dtype=int).reshape(-1, 2)  # fmt: skip
        normals, points = np.empty((len(q), len(ends), 1, 3)), np.empty((len(q), len(ends), 2, 3))
        stands = np.empty((len(q), self._model.njoints, 3))
        moved = np.zeros((len(q), self._model.njoints, 6, self._model.nv))
        for i, configuration in enumerate(_configurations(self._model, self._columns, q)):
            pin.computeDistances(self._model, data, self._geometry, measured, configuration)
            pin.computeJointJacobians(self._model, data, configuration)
            for joint in range(1, self._model.njoints):
                moved[i, joint] = pin.getJointJacobian(self._model, data, joint, world)
            stands[i] = [placement.translation for placement in data.oMi]
            for k, found in enumerate(measured.distanceResults):
                normals[i, k, 0], points[i, k] = found.normal, (found.getNearestPoint1(), found.getNearestPoint2())
        wrench = np.concatenate(np.broadcast_arrays(normals, np.cross(points - stands[:, ends], normals)), axis=-1)
        wrench[:, :, 0] *= -1.0
        rates = np.zeros((self._model.nv, self._chain.n))
        for column in self._columns:
            rates[column.speed, column.joint] += column.ratio
        return np.einsum("mkew,mkewv->mkv", wrench, moved[:, ends], optimize=True) @ rates

    def free(self, q: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Tell (m,) for which joint values q (m, n) every distance is larger than `margin` [m]."""
        return np.all(self.distances(q) > margin, axis=1)


def from_urdf(
    path: str | Path,
    base: str | None = None,
    tip: str | None = None,
    floor: float | None = None,
    obstacles: Sequence[Obstacle] = (),
    mesh_folders: Sequence[str | Path] = (),
    seed: int = 0,
) -> Collision:
    """Build the comparison from a URDF's collision shapes; joints off the chain stay at zero.

    Args:
        path: the URDF.
        base, tip: see `calib.robot.formats.urdf.ends`.
        floor: height of a floor in the base frame [m]; None for no floor.
        obstacles: in the base frame.
        mesh_folders: where ``package://name/...`` is looked for, besides the URDF's folder and the ones above it.
        seed: of the random postures.

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
        raise RobotError(f"{path}: no usable <collision> shape{lost}; give mesh_folders, or use capsules (from_chain)")
    return _finish(model, geometry, chain, floor, obstacles, missing, seed)


def from_chain(
    chain: Chain,
    radius: float,
    floor: float | None = None,
    obstacles: Sequence[Obstacle] = (),
    seed: int = 0,
) -> Collision:
    """Build the comparison from capsules of a radius [m] along the lines from each joint frame to the next.

    Bodies whose frame and the next one coincide (in a spherical wrist) have no capsule.
    """
    pin, coal = _libraries()
    source = write_new(chain)
    tree, plain = read_tree(source, chain.name), urdf.parse(source, chain.name, chain.base, chain.tip)
    model, geometry = pin.buildModelFromXML(source), pin.GeometryModel()
    for joint in tree.joints.values():
        end = joint.origin[:3, 3]
        if (length := float(np.linalg.norm(end))) > 1e-6:
            along = Rotation.align_vectors(end[None] / length, [[0.0, 0.0, 1.0]])[0]
            _attach(model, geometry, joint.parent, joint.parent, pose(along, end / 2), coal.Capsule(radius, length))
    return _finish(model, geometry, plain, floor, obstacles, [], seed)


def _finish(
    model: Any,
    geometry: Any,
    chain: Chain,
    floor: float | None,
    obstacles: Sequence[Obstacle],
    missing: list[str],
    seed: int,
) -> Collision:
    """Add floor and obstacles, choose the pairs, and drop those that always touch."""
    pin, _ = _libraries()
    own = geometry.ngeoms
    _surround(model, geometry, chain.base, floor, obstacles)
    carriers = [shape.parentJoint for shape in geometry.geometryObjects]
    for one in range(own):
        for two in range(one + 1, len(carriers)):
            i, j = sorted((carriers[one], carriers[two]))
            if i != j and (two >= own or model.parents[j] != i):
                geometry.addCollisionPair(pin.CollisionPair(one, two))
    columns = _columns(model, chain)
    kept = Collision(_names(geometry), (), tuple(missing), model, geometry, chain, columns)
    if not kept.pairs:
        return kept
    touching = (kept.distances(random_joints(chain, SAMPLES, seed)) <= 0.0).mean(axis=0) >= ALWAYS
    excluded = tuple(pair for pair, touches in zip(kept.pairs, touching, strict=True) if touches)
    for index in np.flatnonzero(touching)[::-1]:
        geometry.removeCollisionPair(geometry.collisionPairs[int(index)])
    return Collision(_names(geometry), excluded, tuple(missing), model, geometry, chain, columns)


def _names(geometry: Any) -> tuple[tuple[str, str], ...]:
    shapes = geometry.geometryObjects
    return tuple((shapes[pair.first].name, shapes[pair.second].name) for pair in geometry.collisionPairs)


def _attach(model: Any, geometry: Any, link: str, name: str, placed: np.ndarray, shape: Any) -> None:
    """Hang a shape on a link's frame."""
    pin, _ = _libraries()
    index = model.getFrameId(link)
    frame = model.frames[index]
    placement = frame.placement * pin.SE3(placed[:3, :3], placed[:3, 3])
    geometry.addGeometryObject(pin.GeometryObject(name, frame.parentJoint, index, placement, shape))


def _surround(model: Any, geometry: Any, base: str, floor: float | None, obstacles: Sequence[Obstacle]) -> None:
    """Add the floor and the obstacles to the fixed world, which is where the base is at zero joints."""
    pin, coal = _libraries()
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    stand = data.oMf[model.getFrameId(base)]
    things = [] if floor is None else [("floor", coal.Halfspace(np.array([0.0, 0.0, 1.0]), floor), np.eye(4))]
    things += [(obstacle.name, _solid(obstacle), obstacle.placement) for obstacle in obstacles]
    for name, shape, placed in things:
        placement = stand * pin.SE3(placed[:3, :3], placed[:3, 3])
        geometry.addGeometryObject(pin.GeometryObject(name, 0, 0, placement, shape))


def _solid(obstacle: Obstacle) -> Any:
    _, coal = _libraries()
    makers = {"box": (coal.Box, 3), "sphere": (coal.Sphere, 1), "cylinder": (coal.Cylinder, 2)}
    if obstacle.kind not in makers:
        raise RobotError(f"obstacle '{obstacle.name}': kind '{obstacle.kind}' is none of {', '.join(makers)}")
    maker, count = makers[obstacle.kind]
    if len(obstacle.size) != count or min(obstacle.size) <= 0:
        raise RobotError(
            f"obstacle '{obstacle.name}': a {obstacle.kind} has {count} positive sizes, not {obstacle.size}"
        )
    return maker(*map(float, obstacle.size))


def _columns(model: Any, chain: Chain) -> tuple[Column, ...]:
    """Return how q fills Pinocchio's configuration; continuous joints have cosine and sine there."""
    columns = []
    for element in chain.elements:
        if element.joint is not None:
            joint = model.joints[model.getJointId(element.name.removesuffix(".offset"))]
            columns.append(Column(joint.idx_q, element.joint, element.ratio, element.value, joint.nq == 2, joint.idx_v))
    return tuple(columns)


def _configurations(model: Any, columns: Sequence[Column], q: np.ndarray) -> np.ndarray:
    """Return Pinocchio's configurations (m, nq)."""
    pin, _ = _libraries()
    result = np.tile(pin.neutral(model), (len(q), 1))
    for column in columns:
        value = column.ratio * q[:, column.joint] + column.offset
        result[:, column.place] = np.cos(value) if column.circular else value
        if column.circular:
            result[:, column.place + 1] = np.sin(value)
    return result


def _shape(node: Node | None, folders: Sequence[Path], missing: list[str], place: str) -> Any | None:
    """Return the coal shape of a <geometry>; None, with an entry in `missing`, for a mesh that cannot be had."""
    _, coal = _libraries()
    kind = node.children[0] if node is not None and node.children else None
    if kind is None:
        raise RobotError(f"{place}: <collision> without a shape")
    match kind.tag:
        case "box":
            return coal.Box(*_numbers(kind, "size", 3, place))
        case "sphere":
            return coal.Sphere(*_numbers(kind, "radius", 1, place))
        case "cylinder" | "capsule":
            maker = coal.Cylinder if kind.tag == "cylinder" else coal.Capsule
            return maker(*_numbers(kind, "radius", 1, place), *_numbers(kind, "length", 1, place))
        case "mesh":
            return _hull(kind, folders, missing, place)
    raise RobotError(f"{place}: <{kind.tag}> is none of box, sphere, cylinder, capsule, mesh")


def _numbers(node: Node, key: str, count: int, place: str) -> list[float]:
    try:
        values = [float(word) for word in node.attributes.get(key, "").split()]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise RobotError(f"{place}: <{node.tag}> in line {node.line} needs {key} with {count} finite number(s)")
    return values


def _hull(node: Node, folders: Sequence[Path], missing: list[str], place: str) -> Any | None:
    """Return the convex hull of a mesh file, scaled."""
    _, coal = _libraries()
    name = node.attributes.get("filename", "")
    path = find_mesh(name, folders)
    if path is None:
        missing.append(name)
        return None
    scale = np.array(_numbers(node, "scale", 3, place) if "scale" in node.attributes else [1.0, 1.0, 1.0])
    try:
        mesh = coal.MeshLoader().load(str(path), scale)
        mesh.buildConvexHull(True, "Qt")
        return mesh.convex
    except Exception as error:
        missing.append(f"{name} ({error})")
        return None


def find_mesh(name: str, folders: Sequence[Path]) -> Path | None:
    """Return the file a mesh name means: ``package://`` is tried with and without the package's own folder."""
    if name.startswith("file://"):
        name = name.removeprefix("file://")
    variants = [name]
    if name.startswith("package://"):
        inner = name.removeprefix("package://")
        variants = [inner, inner.partition("/")[2]]
    found = (folder / variant for folder in folders for variant in variants)
    return next((path for path in found if path.is_file()), None)


def _libraries() -> tuple[Any, Any]:
    """Import Pinocchio and coal where they are needed: only collisions need them here."""
    import coal
    import pinocchio

    return pinocchio, coal

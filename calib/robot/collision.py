"""Distances between the parts of an arm, the floor and obstacles, by Pinocchio and coal.

Shapes come from the URDF's ``<collision>``: boxes, spheres, cylinders, capsules, and meshes by their convex hull (our
choice: faster and on the safe side). A robot without shapes is made of capsules (`calib.robot.capsules`).

Not compared: parts of one body, bodies joined by a joint, the fixed base with floor and obstacles, and pairs that no
posture parts (`calib.robot.obstacles.inseparable`); the last are listed in `Collision.excluded`. A floor or an obstacle
that a link never leaves is refused (`calib.robot.obstacles.check_reachable`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.arrays import shaped
from calib.errors import refuse_robot
from calib.robot.capsules import TARGET_RADIUS
from calib.robot.chain import Chain, random_joints
from calib.robot.formats import urdf
from calib.robot.formats.markup import Node, parse, text
from calib.robot.formats.urdf_tree import origin
from calib.robot.obstacles import SAMPLES, Obstacle, Wall, check_reachable, inseparable
from calib.transforms import pose


@dataclass(frozen=True)
class _Column:
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
        excluded: pairs left out because no posture parts them.
        missing: meshes of the URDF that were not found or not readable; their shapes are left out.
    """

    pairs: tuple[tuple[str, str], ...]
    excluded: tuple[tuple[str, str], ...]
    missing: tuple[str, ...]
    _model: Any
    _geometry: Any
    _chain: Chain
    _columns: tuple[_Column, ...]
    _links: int

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
        return np.einsum("mkew,mkewv->mkv", wrench, moved[:, ends], optimize=True) @ self._rates

    @property
    def _rates(self) -> np.ndarray:
        """(nv, n) Pinocchio's velocities per joint's."""
        rates = np.zeros((self._model.nv, self._chain.n))
        for column in self._columns:
            rates[column.speed, column.joint] += column.ratio
        return rates

    def beam(self, q: np.ndarray, start: np.ndarray, slope: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, ...]:
        """Measure the links against lines of sight; see `calib.robot.capsules.Capsules.beam`."""
        pin, coal = _libraries()
        data, placed = self._model.createData(), pin.GeometryData(self._geometry)
        tip = self._model.frames[self._model.getFrameId(self._chain.tip)].parentJoint
        shapes = self._geometry.geometryObjects
        links = [k for k in range(self._links) if shapes[k].parentJoint != tip]
        distances, gradients = np.empty((len(q), len(links))), np.empty((len(q), len(links), self._chain.n))
        asked, world = coal.DistanceRequest(True, coal.GJKInitialGuess.DefaultGuess), pin.LOCAL_WORLD_ALIGNED
        ends = np.broadcast_to(end, start.shape)
        for i, configuration in enumerate(_configurations(self._model, self._columns, q)):
            pin.computeJointJacobians(self._model, data, configuration)
            pin.updateGeometryPlacements(self._model, data, self._geometry, placed, configuration)
            away = ends[i] - start[i]
            length = float(np.linalg.norm(away))
            turned = Rotation.align_vectors(away[None] / length, [[0.0, 0.0, 1.0]])[0].as_matrix()
            ray, middle = coal.Capsule(1e-4, length), coal.Transform3s(turned, start[i] + away / 2)
            for column, k in enumerate(links):
                found = coal.DistanceResult()
                there = coal.Transform3s(placed.oMg[k].rotation, placed.oMg[k].translation)
                distances[i, column] = coal.distance(ray, middle, shapes[k].geometry, there, asked, found)
                seen, point, normal = found.getNearestPoint1(), found.getNearestPoint2(), found.normal
                share = float(np.clip((seen - start[i]) @ away / length**2, 0.0, 1.0))
                joint = shapes[k].parentJoint
                moved = (
                    pin.getJointJacobian(self._model, data, joint, world) if joint else np.zeros((6, self._model.nv))
                )
                lever = np.cross(point - data.oMi[joint].translation, normal)
                gradients[i, column] = (normal @ moved[:3] + lever @ moved[3:]) @ self._rates
                gradients[i, column] -= (1.0 - share) * normal @ slope[i]
        return distances, gradients

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
    *,
    walls: Sequence[Wall] = (),
    targets: np.ndarray | Sequence[Sequence[float]] = (),
    margin: float = 0.0,
    within: bool = True,
    seed: int = 0,
) -> Collision:
    """Build the comparison from a URDF's collision shapes; joints off the chain stay at zero.

    Args:
        path: the URDF.
        base, tip: see `calib.robot.formats.urdf.ends`.
        floor: height of a floor in the base frame [m]; None for no floor.
        obstacles: in the base frame.
        mesh_folders: where ``package://name/...`` is looked for, besides the URDF's folder and the ones above it.
        walls: that it does not pass.
        targets: (T, 3) of what is measured, in the tip's frame [m]: each a thin capsule from the tip.
        margin: the least distance that will be asked for [m]; pairs that never have it are left out.
        within: False: parts of the arm are not compared with each other.
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
    planes = [*([] if floor is None else [Wall("floor", np.array([0.0, 0.0, 1.0]), floor)]), *walls]
    return _finish(model, geometry, chain, planes, obstacles, missing, margin, within, seed)


def _add_targets(model: Any, geometry: Any, chain: Chain, targets: np.ndarray | Sequence[Sequence[float]]) -> None:
    """Hang what is measured on the tip's frame."""
    _, coal = _libraries()
    for number, place in enumerate(np.asarray(targets, dtype=float).reshape(-1, 3), 1):
        if (length := float(np.linalg.norm(place))) > 1e-6:
            along = Rotation.align_vectors(place[None] / length, [[0.0, 0.0, 1.0]])[0]
            name = "target" if len(targets) == 1 else f"target {number}"
            _attach(model, geometry, chain.tip, name, pose(along, place / 2), coal.Capsule(TARGET_RADIUS, length))


def _finish(
    model: Any,
    geometry: Any,
    chain: Chain,
    walls: Sequence[Wall],
    obstacles: Sequence[Obstacle],
    missing: list[str],
    margin: float,
    within: bool,
    seed: int,
) -> Collision:
    """Add floor and obstacles, choose the pairs, and drop those that no posture parts."""
    pin, _ = _libraries()
    own = geometry.ngeoms
    _surround(model, geometry, chain.base, walls, obstacles)
    carriers = [shape.parentJoint for shape in geometry.geometryObjects]
    for one in range(own):
        for two in range(one + 1, len(carriers)):
            i, j = sorted((carriers[one], carriers[two]))
            if i != j and (two >= own or (within and model.parents[j] != i)):
                geometry.addCollisionPair(pin.CollisionPair(one, two))
    columns = _columns(model, chain)
    kept = Collision(_names(geometry), (), tuple(missing), model, geometry, chain, columns, own)
    if not kept.pairs:
        return kept
    fixed = np.array([pair.second >= own for pair in geometry.collisionPairs])
    distances = kept.distances(random_joints(chain, SAMPLES, seed))
    check_reachable(kept.pairs, distances, fixed)
    gone = inseparable(distances, fixed, margin)
    excluded = tuple(pair for pair, out in zip(kept.pairs, gone, strict=True) if out)
    for index in np.flatnonzero(gone)[::-1]:
        geometry.removeCollisionPair(geometry.collisionPairs[int(index)])
    return Collision(_names(geometry), excluded, tuple(missing), model, geometry, chain, columns, own)


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


def _surround(model: Any, geometry: Any, base: str, walls: Sequence[Wall], obstacles: Sequence[Obstacle]) -> None:
    """Add walls and obstacles to the fixed world, which is where the base is at zero joints."""
    pin, coal = _libraries()
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    stand = data.oMf[model.getFrameId(base)]
    things: list[Any] = [(wall.name, coal.Halfspace(wall.normal, wall.offset), np.eye(4)) for wall in walls]
    things += [(obstacle.name, _solid(obstacle), obstacle.placement) for obstacle in obstacles]
    for name, shape, placed in things:
        placement = stand * pin.SE3(placed[:3, :3], placed[:3, 3])
        geometry.addGeometryObject(pin.GeometryObject(name, 0, 0, placement, shape))


def _solid(obstacle: Obstacle) -> Any:
    _, coal = _libraries()
    makers = {"box": coal.Box, "sphere": coal.Sphere, "cylinder": coal.Cylinder}
    return makers[obstacle.kind](*map(float, obstacle.size))


def _columns(model: Any, chain: Chain) -> tuple[_Column, ...]:
    """Return how q fills Pinocchio's configuration; continuous joints have cosine and sine there."""
    columns = []
    for element in chain.elements:
        if element.joint is not None:
            joint = model.joints[model.getJointId(element.name.removesuffix(".offset"))]
            columns.append(
                _Column(joint.idx_q, element.joint, element.ratio, element.value, joint.nq == 2, joint.idx_v)
            )
    return tuple(columns)


def _configurations(model: Any, columns: Sequence[_Column], q: np.ndarray) -> np.ndarray:
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
        refuse_robot(place, "<collision> without a shape")
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
    refuse_robot(place, f"<{kind.tag}> is none of box, sphere, cylinder, capsule, mesh")


def _numbers(node: Node, key: str, count: int, place: str) -> list[float]:
    try:
        values = [float(word) for word in node.attributes.get(key, "").split()]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        refuse_robot(place, f"<{node.tag}> in line {node.line} needs {key} with {count} finite number(s)")
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


def meshes_beside(path: Path) -> dict[str, Path | str]:
    """Return the meshes of a URDF's collision shapes by where they go beside a copy of it, in ``1-robot``.

    Names from the root, or that lead out of their folder, are left out: a copy of the URDF finds them, or nothing does.
    """
    if path.suffix != ".urdf":
        return {}
    folders, found = list(path.resolve().parents), dict[str, Path | str]()
    for link in parse(text(path)[0], str(path)).all("link"):
        for node in link.all("collision"):
            kinds = [each for shape in node.all("geometry") for each in shape.all("mesh")]
            for name in (each.attributes.get("filename", "") for each in kinds):
                inner = name.removeprefix("package://")
                mesh = find_mesh(name, folders)
                if mesh is not None and not inner.startswith(("/", "file:")) and ".." not in Path(inner).parts:
                    found[f"1-robot/{inner}"] = mesh
    return found


def _libraries() -> tuple[Any, Any]:
    """Import Pinocchio and coal where they are needed: only collisions need them here."""
    import coal
    import pinocchio

    return pinocchio, coal

"""The meshes a URDF draws its links with, where their files can be found.

Read from our own parsed XML, not by yourdfpy: one capsule, or one ``<visual>`` without geometry, makes that refuse the
whole file (ValueError, TypeError), and ``package://`` is resolved as for collision shapes, see `find_mesh`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arrays import frozen
from calib.robot.collision import find_mesh
from calib.robot.formats.markup import Node, parse, text
from calib.transforms import from_xyz_rpy

KINDS = (".stl", ".obj", ".dae", ".glb", ".gltf")


@dataclass(frozen=True, eq=False)
class Visual:
    """A mesh file that moves with a link: its placement (4, 4) in the link's frame, its scale (3,)."""

    link: str
    file: Path
    placement: np.ndarray
    scale: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "placement", frozen(self.placement))
        object.__setattr__(self, "scale", frozen(self.scale))


def visuals(path: str | Path, folders: Sequence[str | Path] = ()) -> tuple[list[Visual], list[str]]:
    """Return the meshes of a URDF's ``<visual>`` elements, and the names of those that were not found.

    Args:
        path: the URDF.
        folders: where ``package://name/...`` is looked for, besides the URDF's folder and the ones above it.
    """
    root = parse(text(path)[0], str(path))
    places = [*map(Path, folders), *Path(path).resolve().parents]
    found, missing = [], []
    for link in root.all("link"):
        for visual in link.all("visual"):
            mesh = _mesh(visual)
            if mesh is None:
                continue
            name = mesh.attributes.get("filename", "")
            file = find_mesh(name, places)
            if file is None or file.suffix.lower() not in KINDS:
                missing.append(name)
                continue
            origin = visual.first("origin")
            given = origin.attributes if origin is not None else {}
            xyz, rpy = _triple(given, "xyz", "0 0 0"), _triple(given, "rpy", "0 0 0")
            scale = np.array(_triple(mesh.attributes, "scale", "1 1 1"))
            found.append(Visual(link.attributes.get("name", ""), file, from_xyz_rpy(xyz, rpy), scale))
    return found, missing


def _mesh(visual: Node) -> Node | None:
    geometry = visual.first("geometry")
    return None if geometry is None else geometry.first("mesh")


def _triple(attributes: dict[str, str], key: str, otherwise: str) -> list[float]:
    return [float(word) for word in attributes.get(key, otherwise).split()]

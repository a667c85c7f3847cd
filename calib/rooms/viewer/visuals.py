"""Meshes of a robot's ``<visual>`` elements in its URDF."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.records import Frozen
from calib.robot.collision import find_mesh, urdf_meshes
from calib.robot.formats.urdf_tree import numbers, origin

DRAWABLE = (".stl", ".obj", ".dae", ".glb", ".gltf")  # meshes that the viewer shows


@dataclass(frozen=True, eq=False)
class Visual(Frozen):
    """A mesh file that moves with a link: its placement (4, 4) in the link's frame, its scale (3,)."""

    link: str
    file: Path
    placement: np.ndarray
    scale: np.ndarray


def visuals(path: str | Path) -> tuple[list[Visual], list[str]]:
    """Return the meshes of a URDF's ``<visual>`` elements, and the names of missing files.

    Read from our own parsed XML, not by yourdfpy: one capsule, or one ``<visual>`` without geometry, makes that refuse
    the whole file (ValueError, TypeError), and ``package://`` is resolved as for collision shapes, see `find_mesh`.
    """
    places, found, missing = list(Path(path).resolve().parents), [], []
    for link, visual, mesh in urdf_meshes(path, "visual"):
        name = mesh.attributes.get("filename", "")
        file = find_mesh(name, places)
        if file is None or file.suffix.lower() not in DRAWABLE:
            missing.append(name)
            continue
        scale = numbers(mesh, "scale", str(path), "1 1 1")
        found.append(Visual(link.attributes.get("name", ""), file, origin(visual, str(path)), scale))
    return found, missing

"""What an engineer with a camera brings and knows: its rough place for choosing poses, and a folder of images."""

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from calib import files
from calib.data.poses.choices import IN_HAND
from calib.data.poses.pose_lists import read_poses
from calib.rooms.camera.board import write_board
from calib.rooms.camera.camera_info import write_lens
from calib.rooms.camera.lens import Lens
from calib.rooms.cells.camera_cell import CameraCell, camera_cell, take_pictures
from calib.rooms.cells.cell import Cell
from calib.transforms import invert, pose, to_xyz_rpy

LENS = Lens("pinhole", np.array([1250.0, 1252.0, 640.0, 508.0, -0.12, 0.05, 4e-4, -3e-4, 0.0]), (1280, 1024))
DIGITS = 2  # digits to which places are told [m, rad]
LIMITS = """[camera]
mounting = "in hand"
lens = "camera.yaml"
board = "board.toml"
carried = {{xyz = {carried[0]}, rpy = {carried[1]}}}
stands = {{xyz = {stands[0]}, rpy = {stands[1]}}}
range = [0.25, 0.7]
tilt = "45 deg"
"""


def seen_by_camera(cell: Cell) -> CameraCell:
    """Return a virtual cell with a 1.3-megapixel camera in the hand."""
    return camera_cell(cell, IN_HAND, lens=LENS)


@contextmanager
def limits_of(found: CameraCell) -> Iterator[Path]:
    """Yield a constraints file with the camera's rough place, beside its lens and its board."""
    truth, folder = found.cell.truth, Path(tempfile.mkdtemp(prefix="calib-demo-"))
    middle = pose(None, 0.5 * np.array([*found.board.extent, 0.0]))
    places = {"carried": truth.tools[0], "stands": invert(truth.stations[0]) @ middle}
    told = {name: [np.round(part, DIGITS).tolist() for part in to_xyz_rpy(place)] for name, place in places.items()}
    try:
        write_lens(found.lens, folder / "camera.yaml")
        write_board(found.board, folder / "board.toml")
        yield files.write(folder / "limits.toml", LIMITS.format(**told))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def bring_images(folder: Path, found: CameraCell, seed: int, progress: Callable[[str], None]) -> None:
    """Let the camera take an image at every pose planned in a session's folder; the lens is left to be found."""
    kinds = [joint.kind for joint in found.cell.nominal.joints]
    for number, (plan, name) in enumerate((("poses", "measured"), ("validation", "validation"))):
        path = folder / f"2-poses/{plan}.csv"
        if not path.exists():
            continue
        q = read_poses(path, found.cell.nominal.joint_names, kinds=kinds)
        tell = partial(_say, progress, name)
        take_pictures(found, q, folder / f"3-measured/{name}", seed=seed + number, say=tell)


def _say(progress: Callable[[str], None], name: str, image: str) -> None:
    progress(f"rendering {name}/{image}")

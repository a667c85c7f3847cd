"""A virtual cell with a camera: true arm, true placements of camera and board, and simulated images.

Corners are either projected, with white noise (`photograph`), or found in rendered images (`take_pictures`), which have
everything that real images have: see `calib.simulation.rendered_camera`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from calib import files
from calib.data.images import board as boards
from calib.data.images.board import Board, corners
from calib.data.images.lens import Lens, write_lens
from calib.data.images.optics import BoardShape, Optics, shaped_points
from calib.data.images.pixels import Pixels
from calib.data.poses import BOARD, IN_HAND, JOINTS
from calib.errors import CannotSimulate
from calib.geometry.installation import Installation
from calib.procedure.measuring.camera_view import CameraView
from calib.robot.calibrated import Deflection
from calib.robot.chain import Chain, random_joints
from calib.robot.kinematics import forward
from calib.simulation.cell import Cell, true_poses
from calib.transforms import invert, pose, to_xyz_rpy
from calib.units import JOINT

if TYPE_CHECKING:
    from calib.simulation.rendered_camera import Imaging

CHARUCO = Board("charuco", 9, 7, 0.03, 0.021)
FIVE_MEGAPIXEL = Lens(
    "pinhole", np.array([2400.0, 2405.0, 1220.0, 1010.0, -0.12, 0.05, 4e-4, -3e-4, 0.0]), (2448, 2048)
)  # an 8 mm lens before 3.45 µm pixels, about
RANGE, TILT = (0.35, 0.8), 0.7  # distance [m] and largest tilt [rad] of what is looked at; our choice


@dataclass(frozen=True, eq=False)
class CameraCell:
    """A cell with one camera and one board.

    Attributes:
        cell: the arm, and where camera and board are; its truth has `Installation.optics`.
        board: as its file says.
        mounting: ``in hand`` or ``to hand``.
    """

    cell: Cell
    board: Board
    mounting: str

    @property
    def lens(self) -> Lens:
        """True lens."""
        return self.cell.truth.optics.lenses[0]

    @property
    def shape(self) -> BoardShape:
        """True shape of the printed board."""
        return self.cell.truth.optics.boards[0]


@dataclass(frozen=True)
class Views:
    """Ranges of random views: distance [m] and largest tilt [rad] of the board, and whether it is fully in view."""

    distance: tuple[float, float] = RANGE
    tilt: float = TILT
    whole: bool = True


def camera_cell(
    cell: Cell,
    mounting: str = IN_HAND,
    *,
    board: Board = CHARUCO,
    lens: Lens = FIVE_MEGAPIXEL,
    shape: BoardShape | None = None,
    reach_of_arm: float | None = None,
) -> CameraCell:
    """Return a virtual cell whose instrument is a camera.

    Args:
        cell: whose arm it is; its instrument is left out but for the noise of the encoders.
        mounting: what the arm carries: the camera (``in hand``) or the board (``to hand``).
        board, lens, shape: the board, the camera, and how the print differs.
        reach_of_arm: how far the arm's workspace reaches [m]; None to find out.
    """
    arm = cell.truth.chain
    reach = reach_of_arm or _reach(arm)
    middle = 0.5 * np.array([*board.extent, 0.0])
    optics = Optics((lens,), ("camera",), (shape or BoardShape(),), ("board",))
    if mounting == IN_HAND:  # the board lies on a table beside the base, facing up
        board_pose = pose(Rotation.from_euler("x", np.pi), np.array([0.55 * reach, 0.0, 0.0])) @ pose(None, -middle)
        station, names = invert(board_pose), ("board", "camera")
        tool = pose(Rotation.from_euler("xyz", [0.05, -0.1, 0.6]), [0.04, 0.02, 0.06])
    else:  # the camera stands beyond the workspace and looks at the base's axis
        eye = np.array([1.2 * reach, -0.15 * reach, 0.65 * reach])
        station, names = invert(_looking(eye, np.array([0.35 * reach, 0.0, 0.35 * reach]))), ("camera", "board")
        tool = pose(Rotation.from_euler("xyz", [0.1, 0.15, 0.3]), [0.02, 0.03, 0.05]) @ pose(None, -middle)
    truth = Installation(
        arm, station[None], tool[None], names[:1], names[1:], deflection=cell.truth.deflection, optics=optics
    )
    note = f"{cell.note}; a camera {mounting} sees a {board.words}"
    return CameraCell(replace(cell, truth=truth, note=note), board, mounting)


def _reach(chain: Chain) -> float:
    return float(np.quantile(np.linalg.norm(forward(chain, random_joints(chain, 500, 0))[:, :3, 3], axis=1), 0.9))


def _looking(eye: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the pose of a camera at `eye` (3,) [m] that looks at a point, with horizontal x axis."""
    ahead = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return pose(np.column_stack([right, np.cross(ahead, right), ahead]), eye)


def board_poses(camera: CameraCell, q: np.ndarray) -> np.ndarray:
    """Return the board's true poses (m, 4, 4) in the camera's frame."""
    poses = true_poses(camera.cell, q)
    return invert(poses) if camera.mounting == IN_HAND else poses


def views(
    camera: CameraCell, count: int, seed: int | np.random.Generator = 0, sought: Views | None = None
) -> np.ndarray:
    """Return random joint values (count, n) at which the camera sees the board.

    Args:
        camera: the cell.
        count: how many.
        seed: of the draw.
        sought: which views.

    Raises:
        CannotSimulate: where hardly any are found.
    """
    sought, arm = sought or Views(), camera.cell.nominal
    min_distance, max_distance = (
        sought.distance if camera.mounting == IN_HAND else (2.0 * sought.distance[0], 3.0 * sought.distance[1])
    )
    cell = replace(camera.cell.truth, chain=arm, deflection=Deflection())
    view = CameraView(cell, camera.board, camera.mounting, sought.tilt, (min_distance, max_distance), 0.0)

    min_corners = len(corners(camera.board)) if sought.whole else 12
    q = view.draw(
        count, lambda candidates: visible(camera, candidates).sum(axis=1) >= min_corners, *arm.sampling_limits(), seed
    )
    if len(q) < count:
        raise CannotSimulate(f"the camera sees the board at hardly any posture of the arm ({len(q)} of {count} found)")
    return q


def visible(camera: CameraCell, q: np.ndarray) -> np.ndarray:
    """Return whether each corner is visible to the camera at joint values q (m, n): (m, K) bool."""
    poses = board_poses(camera, q)
    flat = _points(camera, poses).reshape(-1, 3)
    facing = np.einsum("mi,mi->m", poses[:, :3, 2], poses[:, :3, 3]) > 0.0
    return camera.lens.in_sight(flat, 6.0).reshape(len(q), len(corners(camera.board))) & facing[:, None]


def _points(camera: CameraCell, poses: np.ndarray) -> np.ndarray:
    table = shaped_points(camera.board, camera.shape, corners(camera.board))
    return np.einsum("mij,kj->mki", poses[:, :3, :3], table) + poses[:, None, :3, 3]


def photograph(
    camera: CameraCell, q: np.ndarray, noise: float = 0.05, seed: int | np.random.Generator = 0, file: str = "images"
) -> Pixels:
    """Return simulated images at q (m, n): projected corners with white noise [px]; the lens is left unknown.

    The recorded joints carry the encoders' noise.
    """
    rng, names = np.random.default_rng(seed), camera.cell.truth
    in_view, points = visible(camera, q), _points(camera, board_poses(camera, q))
    flat = np.where(in_view.reshape(-1, 1), points.reshape(-1, 3), [0.0, 0.0, 1.0])
    pixel = camera.lens.project(flat).reshape(*in_view.shape, 2)
    pixel = np.where(in_view[:, :, None], pixel + rng.normal(0.0, noise, pixel.shape), np.nan)
    recorded = q + rng.normal(0.0, camera.cell.instrument.encoder_sigma, q.shape)
    free = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    return Pixels(
        recorded,
        camera.cell.nominal.joint_names,
        pixel,
        camera.board,
        None,
        sigma=np.full(in_view.shape, max(noise, 1e-3)),
        station=names.station_names[0],
        tool_names=names.tool_names,
        size=camera.lens.size,
        file=file,
        free=free,
        names=tuple(f"{k + 1:04}.png" for k in range(len(q))),
    )


def take_pictures(
    camera: CameraCell,
    q: np.ndarray,
    folder: Path,
    imaging: Imaging | None = None,
    seed: int = 0,
    moving: np.ndarray | None = None,
    say: Callable[[str], None] | None = None,
) -> Path:
    """Write rendered images at q (m, n) into a folder with ``joints.csv`` and ``board.toml``.

    Args:
        camera: the cell.
        q: joint values [rad or m]; recorded with the encoders' noise.
        folder: to write into.
        imaging: light, focus and noise.
        seed: of all noise.
        moving: (m, n) how far the joints move during the exposure [rad or m]; None: the arm stands still.
        say: called with a line on each image.
    """
    from calib.data.images.images import write_image
    from calib.simulation.rendered_camera import render

    boards.write_board(camera.board, folder / BOARD)
    rng = np.random.default_rng([seed, 11])
    recorded = q + rng.normal(0.0, camera.cell.instrument.encoder_sigma, q.shape)
    names = [f"{k + 1:04}.png" for k in range(len(q))]
    for k, name in enumerate(names):
        if say:
            say(f"rendering {folder.name}/{name}")
        exposure_joints = q[k : k + 1]
        if moving is not None and moving[k].any():
            exposure_joints = q[k] + np.linspace(-0.5, 0.5, 7)[:, None] * moving[k]
        poses, noise = board_poses(camera, exposure_joints), np.random.default_rng([seed, k])
        write_image(folder / name, render(camera.board, camera.lens, poses, imaging, noise, camera.shape))
    units = [JOINT[joint.kind] for joint in camera.cell.nominal.joints]
    heads = [f"{joint_name} [{unit}]" for joint_name, (_, unit) in zip(camera.cell.nominal.joint_names, units)]
    rows = [[name, *map(float, row * [factor for factor, _ in units])] for name, row in zip(names, recorded)]
    files.write_table(folder / JOINTS, ["image", *heads], rows)
    return folder


DEMO_LENS = Lens("pinhole", np.array([1250.0, 1252.0, 640.0, 508.0, -0.12, 0.05, 4e-4, -3e-4, 0.0]), (1280, 1024))
DIGITS = 2  # digits to which places are stated [m, rad]
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
    """Return a virtual cell with a 1.3-megapixel camera on the arm."""
    return camera_cell(cell, IN_HAND, lens=DEMO_LENS)


@contextmanager
def limits_of(camera: CameraCell) -> Iterator[Path]:
    """Yield a constraints file with the camera's approximate placement, next to its lens and board files."""
    truth, middle = camera.cell.truth, pose(None, 0.5 * np.array([*camera.board.extent, 0.0]))
    places = {"carried": truth.tools[0], "stands": invert(truth.stations[0]) @ middle}
    placements = {
        name: [np.round(part, DIGITS).tolist() for part in to_xyz_rpy(frame)] for name, frame in places.items()
    }
    with tempfile.TemporaryDirectory(prefix="calib-demo-", ignore_cleanup_errors=True) as folder:
        write_lens(camera.lens, Path(folder, "camera.yaml"))
        boards.write_board(camera.board, Path(folder, BOARD))
        yield files.write(Path(folder, "limits.toml"), LIMITS.format(**placements))

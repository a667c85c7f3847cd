"""A virtual cell with a camera: true arm, true placements of camera and board, and simulated images.

Corners are either projected, with white noise (`photograph`), or detected in rendered images (`take_pictures`) with
lens, blur, light and noise: see `calib.simulation.rendered_camera`.
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
# Smallest number of visible corners of a board that need not be fully in view.
MIN_CORNERS = 12

# Intrinsics fx, fy, cx, cy [px] and distortion k1, k2, p1, p2, k3, about those of an 8 mm lens and 3.45 µm pixels.
FIVE_MEGAPIXEL_INTRINSICS = np.array([2400.0, 2405.0, 1220.0, 1010.0, -0.12, 0.05, 4e-4, -3e-4, 0.0])
FIVE_MEGAPIXEL = Lens("pinhole", FIVE_MEGAPIXEL_INTRINSICS, (2448, 2048))

# Distances [m] and largest tilt [rad] of the board in random views (our choice).
RANGE = (0.35, 0.8)
TILT = 0.7

# Intrinsics of a 1.3-megapixel camera, with the distortion of the lens above.
DEMO_INTRINSICS = np.array([1250.0, 1252.0, 640.0, 508.0, -0.12, 0.05, 4e-4, -3e-4, 0.0])
DEMO_LENS = Lens("pinhole", DEMO_INTRINSICS, (1280, 1024))
# Decimals to which the constraints file states the camera's placement [m, rad]: it is known only roughly.
DIGITS = 2
LIMITS = """[camera]
mounting = "in hand"
lens = "camera.yaml"
board = "board.toml"
carried = {{xyz = {carried[0]}, rpy = {carried[1]}}}
stands = {{xyz = {stands[0]}, rpy = {stands[1]}}}
range = [0.25, 0.7]
tilt = "45 deg"
"""


@dataclass(frozen=True, eq=False)
class CameraCell:
    """A cell with one camera and one board.

    Attributes:
        cell: the arm and the placements of camera and board; its truth has `Installation.optics`.
        board: the board as described in its file.
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
        cell: the cell whose arm and encoder noise are used; its instrument is replaced by the camera.
        mounting: what the arm carries: the camera (``in hand``) or the board (``to hand``).
        board, lens, shape: the board, the camera's lens, and the deviation of the print; None for an exact print.
        reach_of_arm: largest distance of the arm's workspace from its base [m]; None to compute it.
    """
    arm = cell.truth.chain
    deflection = cell.truth.deflection
    reach = reach_of_arm or _reach(arm)
    middle = 0.5 * np.array([*board.extent, 0.0])
    from_middle = pose(None, -middle)
    if mounting == IN_HAND:
        # the board lies on a table beside the base, facing up
        facing_up = Rotation.from_euler("x", np.pi)
        table = np.array([0.55 * reach, 0.0, 0.0])
        station = invert(pose(facing_up, table) @ from_middle)
        station_name = "board"
        tool_name = "camera"
        camera_turn = Rotation.from_euler("xyz", [0.05, -0.1, 0.6])
        tool = pose(camera_turn, [0.04, 0.02, 0.06])
    else:
        # the camera stands beyond the workspace and looks at the base's axis
        eye = reach * np.array([1.2, -0.15, 0.65])
        target = reach * np.array([0.35, 0.0, 0.35])
        station = invert(_looking(eye, target))
        station_name = "camera"
        tool_name = "board"
        board_turn = Rotation.from_euler("xyz", [0.1, 0.15, 0.3])
        tool = pose(board_turn, [0.02, 0.03, 0.05]) @ from_middle
    board_shape = shape or BoardShape()
    optics = Optics((lens,), ("camera",), (board_shape,), ("board",))
    truth = Installation(
        arm, station[None], tool[None], (station_name,), (tool_name,), deflection=deflection, optics=optics
    )
    note = f"{cell.note}; a camera {mounting} sees a {board.words}"
    seen_cell = replace(cell, truth=truth, note=note)
    return CameraCell(seen_cell, board, mounting)


def _reach(chain: Chain) -> float:
    """Return the distance [m] from the base within which the tip is in 90 % of random postures."""
    q = random_joints(chain, 500, 0)
    poses = forward(chain, q)
    distances = np.linalg.norm(poses[:, :3, 3], axis=1)
    return float(np.quantile(distances, 0.9))


def _looking(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the pose of a camera at `eye` (3,) [m] that looks at `target` (3,) [m], with horizontal x axis."""
    ahead = target - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    return pose(np.column_stack([right, down, ahead]), eye)


def board_poses(camera: CameraCell, q: np.ndarray) -> np.ndarray:
    """Return the board's true poses (m, 4, 4) in the camera's frame, at joint values q (m, n)."""
    poses = true_poses(camera.cell, q)
    if camera.mounting == IN_HAND:
        return invert(poses)
    return poses


def views(
    camera: CameraCell, count: int, seed: int | np.random.Generator = 0, sought: Views | None = None
) -> np.ndarray:
    """Return random joint values (count, n) at which the camera sees the board.

    Args:
        camera: the cell.
        count: number of views.
        seed: seed of the random draw.
        sought: ranges of the views; None for the default ranges.

    Raises:
        CannotSimulate: if hardly any such joint values are found.
    """
    sought = sought or Views()
    min_distance, max_distance = sought.distance
    if camera.mounting != IN_HAND:
        # a camera beside the arm stands farther away
        min_distance = 2.0 * min_distance
        max_distance = 3.0 * max_distance
    min_corners = MIN_CORNERS
    if sought.whole:
        min_corners = len(corners(camera.board))

    def in_view(candidates: np.ndarray) -> np.ndarray:
        return visible(camera, candidates).sum(axis=1) >= min_corners

    arm = camera.cell.nominal
    cell = replace(camera.cell.truth, chain=arm, deflection=Deflection())
    view = CameraView(cell, camera.board, camera.mounting, sought.tilt, (min_distance, max_distance), 0.0)
    lower, upper = arm.sampling_limits()
    q = view.draw(count, in_view, lower, upper, seed)
    if len(q) < count:
        raise CannotSimulate(f"the camera sees the board at hardly any posture of the arm ({len(q)} of {count} found)")
    return q


def visible(camera: CameraCell, q: np.ndarray) -> np.ndarray:
    """Return whether each corner is visible to the camera at joint values q (m, n): (m, K) bool."""
    poses = board_poses(camera, q)
    points = _points(camera, poses)
    in_sight = camera.lens.in_sight(points.reshape(-1, 3), 6.0)
    normals = poses[:, :3, 2]
    positions = poses[:, :3, 3]
    facing = np.einsum("mi,mi->m", normals, positions) > 0.0
    return in_sight.reshape(points.shape[:2]) & facing[:, None]


def _points(camera: CameraCell, poses: np.ndarray) -> np.ndarray:
    """Return the corners (m, K, 3) [m] of the printed board in the camera's frame."""
    nominal = corners(camera.board)
    table = shaped_points(camera.board, camera.shape, nominal)
    turned = np.einsum("mij,kj->mki", poses[:, :3, :3], table)
    return turned + poses[:, None, :3, 3]


def photograph(
    camera: CameraCell, q: np.ndarray, noise: float = 0.05, seed: int | np.random.Generator = 0, file: str = "images"
) -> Pixels:
    """Return simulated images at joint values q (m, n): projected corners with white noise.

    The result states no lens, so that a fit has to estimate it. Its joint values contain the encoders' noise.

    Args:
        camera: the cell.
        q: (m, n) true joint values [rad or m].
        noise: standard deviation of each pixel coordinate [px].
        seed: seed of all noise.
        file: file name that messages about these images give.
    """
    rng = np.random.default_rng(seed)
    in_view = visible(camera, q)
    points = _points(camera, board_poses(camera, q))
    # corners out of view are projected from a point that is in view, and dropped below
    points = np.where(in_view[:, :, None], points, [0.0, 0.0, 1.0])
    pixel = camera.lens.project(points.reshape(-1, 3))
    pixel = pixel.reshape(*in_view.shape, 2)
    pixel = pixel + rng.normal(0.0, noise, pixel.shape)
    pixel = np.where(in_view[:, :, None], pixel, np.nan)
    sigma = np.full(in_view.shape, max(noise, 1e-3))
    recorded = _recorded(camera, q, rng)
    truth = camera.cell.truth
    return Pixels(
        recorded,
        camera.cell.nominal.joint_names,
        pixel,
        camera.board,
        None,
        sigma=sigma,
        station=truth.station_names[0],
        tool_names=truth.tool_names,
        size=camera.lens.size,
        file=file,
        free=("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
        names=tuple(_image_names(len(q))),
    )


def _recorded(camera: CameraCell, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return joint values (m, n) with the encoders' noise [rad or m]."""
    sigma = camera.cell.instrument.encoder_sigma
    return q + rng.normal(0.0, sigma, q.shape)


def _image_names(count: int) -> list[str]:
    return [f"{number:04}.png" for number in range(1, count + 1)]


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
        folder: folder to write into.
        imaging: light, focus and noise.
        seed: seed of all noise.
        moving: (m, n) motion of the joints during the exposure [rad or m]; None: the arm stands still.
        say: function called with a line of text before each image is rendered; None: no function.

    Returns:
        The folder.
    """
    from calib.data.images.images import write_image
    from calib.simulation.rendered_camera import render

    boards.write_board(camera.board, folder / BOARD)
    recorded = _recorded(camera, q, np.random.default_rng([seed, 11]))
    names = _image_names(len(q))
    for k, name in enumerate(names):
        if say:
            say(f"rendering {folder.name}/{name}")
        exposure_joints = q[k : k + 1]
        if moving is not None and moving[k].any():
            share_of_exposure = np.linspace(-0.5, 0.5, 7)
            exposure_joints = q[k] + share_of_exposure[:, None] * moving[k]
        poses = board_poses(camera, exposure_joints)
        noise = np.random.default_rng([seed, k])
        image = render(camera.board, camera.lens, poses, imaging, noise, camera.shape)
        write_image(folder / name, image)

    header = ["image"]
    factors = []
    for joint in camera.cell.nominal.joints:
        factor, unit = JOINT[joint.kind]
        header.append(f"{joint.name} [{unit}]")
        factors.append(factor)
    rows = []
    for name, joints in zip(names, recorded):
        rows.append([name, *map(float, joints * factors)])
    files.write_table(folder / JOINTS, header, rows)
    return folder


def seen_by_camera(cell: Cell) -> CameraCell:
    """Return a virtual cell with a 1.3-megapixel camera on the arm."""
    return camera_cell(cell, IN_HAND, lens=DEMO_LENS)


@contextmanager
def limits_of(camera: CameraCell) -> Iterator[Path]:
    """Yield the path of a constraints file with the camera's approximate placement, beside its lens and board files.

    The files are deleted at the end of the context.
    """
    truth = camera.cell.truth
    board_middle = 0.5 * np.array([*camera.board.extent, 0.0])
    middle = pose(None, board_middle)
    frames = {"carried": truth.tools[0], "stands": invert(truth.stations[0]) @ middle}
    placements = {}
    for name, frame in frames.items():
        xyz, rpy = to_xyz_rpy(frame)
        rounded_xyz = np.round(xyz, DIGITS)
        rounded_rpy = np.round(rpy, DIGITS)
        placements[name] = [rounded_xyz.tolist(), rounded_rpy.tolist()]
    with tempfile.TemporaryDirectory(prefix="calib-demo-", ignore_cleanup_errors=True) as folder:
        write_lens(camera.lens, Path(folder, "camera.yaml"))
        boards.write_board(camera.board, Path(folder, BOARD))
        limits = LIMITS.format(**placements)
        yield files.write(Path(folder, "limits.toml"), limits)

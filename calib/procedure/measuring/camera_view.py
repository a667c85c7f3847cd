"""Pose selection with a camera that sees a board: visibility constraint and observation Jacobian of images.

The table ``[camera]`` of the constraints file describes camera and board (`calib formats constraints`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.images.board import Board, corners, read_board
from calib.data.images.lens import Lens
from calib.data.images.lens_files import read_lens
from calib.data.images.optics import BoardShape, Optics
from calib.data.images.pixels import Pixels
from calib.data.poses import IN_HAND
from calib.errors import UsageError, require
from calib.geometry.camera.pixel_residuals import ImageNoise
from calib.geometry.installation import Installation, see
from calib.geometry.inverse import Goal, reach, seen_at
from calib.geometry.observability import Observation, base_columns
from calib.geometry.observation import Block, layout, observe, prepare, target_jacobian
from calib.poses.space import PoseConstraint
from calib.procedure.measuring.constraints_file import CameraTable
from calib.robot.chain import Chain
from calib.robot.tables import placement
from calib.transforms import invert, pose

# noise that a pose is judged by: of corners [px], of the arm's repeatability per axis [m], [rad] (our choice)
CORNER = 0.05
DISPLACEMENT = 2e-5
TURN = 2e-5
ASSUMED = (
    f"predicted σ: for corner noise of {CORNER:g} px and a repeatability of {1e3 * DISPLACEMENT:g} mm and "
    f"{1e3 * TURN:g} mrad per axis; unmodelled effects are not included"
)
# times that views are drawn
TRIES = 60
# steps of the inverse kinematics of a view
INVERSE_STEPS = 30
# [m and rad] difference of a pose from the drawn view up to which it is reached
REACHED = 1e-3
# postures drawn to find the identifiable columns, and of those needed at least
POSTURES = 100
MIN_POSTURES = 20
# largest constraint violation at which the board still counts as seen
SEEN = 1e-8
# share of the half image in which the board's middle is drawn
CENTRAL = 0.8
# parameters of a lens that may be fitted
FREE_LENS_PARAMETERS = 8


@dataclass(frozen=True, eq=False)
class CameraView:
    """Constraint "the camera sees the whole board", satisfied where all values are <= 0.

    It is a function of joint values q (m, n) with values (m, 19).

    Attributes:
        cell: the arm with approximate placements of camera and board.
        board: the calibration board.
        mounting: ``in hand`` (the arm carries the camera) or ``to hand`` (the arm carries the board).
        tilt: largest allowed angle between the line of sight and the board's normal [rad].
        span: smallest and largest allowed distance of the board's centre from the camera [m].
        margin: smallest allowed distance of the board from the image's edge [px].
    """

    cell: Installation
    board: Board
    mounting: str
    tilt: float
    span: tuple[float, float]
    margin: float

    @property
    def lens(self) -> Lens:
        """Lens parameters of the camera."""
        return self.cell.optics.lenses[0]

    def poses(self, q: np.ndarray) -> np.ndarray:
        """Return the board's poses (m, 4, 4) in the camera frame at joint values q (m, n) [rad or m]."""
        poses = see(self.cell, q).poses()
        if self.mounting == IN_HAND:
            return invert(poses)
        return poses

    def __call__(self, q: np.ndarray) -> np.ndarray:
        poses = self.poses(q)
        size = np.array(self.lens.size)
        table = corners(self.board)
        (left, bottom), (right, top) = table[:, :2].min(axis=0), table[:, :2].max(axis=0)
        edge = np.array([[left, bottom, 0.0], [left, top, 0.0], [right, bottom, 0.0], [right, top, 0.0]])
        point = np.einsum("mij,kj->mki", poses[:, :3, :3], edge) + poses[:, None, :3, 3]
        # points behind or beside the camera are projected as if ahead of it: far outside of the image
        lateral = np.maximum(np.linalg.norm(point[:, :, :2], axis=2), 1e-3)
        depth = np.maximum(point[:, :, 2:], lateral[:, :, None] / 2.0)
        ahead = np.concatenate([point[:, :, :2], depth], axis=2)
        pixel = self.lens.project(ahead.reshape(-1, 3)).reshape(len(q), -1, 2)
        outside_image = np.concatenate([self.margin - pixel, pixel + self.margin + 1 - size], axis=2) / size[0]

        middle = poses[:, :3, :3] @ (0.5 * np.array([*self.board.extent, 0.0])) + poses[:, :3, 3]
        distance = np.linalg.norm(middle, axis=1)
        cosine = np.einsum("mi,mi->m", poses[:, :3, 2], middle) / np.maximum(distance, 1e-9)
        tilt = np.cos(self.tilt) - cosine
        limits = np.column_stack([self.span[0] - distance, distance - self.span[1], tilt])
        return np.concatenate([outside_image.reshape(len(q), -1), limits], axis=1)

    @property
    def stand(self) -> np.ndarray:
        """Position (3,) in the arm's base frame [m] of the fixed camera, or of the fixed board's centre."""
        T_base_station = invert(self.cell.stations[0])
        middle = np.zeros(2)
        if self.mounting == IN_HAND:
            middle = 0.5 * np.array(self.board.extent)
        return (T_base_station @ [*middle, 0.0, 1.0])[:3]

    def constraint(self) -> PoseConstraint:
        """Return the visibility of the whole board as a constraint of pose selection."""
        return PoseConstraint("board in view of the camera", self)

    @property
    def assumed(self) -> str:
        """Sentence for the user that states the measurement noise assumed in the prediction of σ."""
        return ASSUMED

    def observation(self, lower: np.ndarray, upper: np.ndarray, seed: int = 0) -> ImageObservation:
        """Return the observation Jacobian of images, limited to the parameters that images of the board can identify.

        Args:
            lower, upper: (n,) joint limits [rad or m].
            seed: seed of the random postures at which identifiability is examined.

        Raises:
            UsageError: if the board is in view at too few of these postures.
        """
        columns = layout(self.cell).rigid_index

        def in_view(q: np.ndarray) -> np.ndarray:
            return np.all(self(q) <= SEEN, axis=1)

        q = self.draw(POSTURES, in_view, lower, upper, seed)
        if len(q) < MIN_POSTURES:
            raise UsageError(
                f"the camera sees the board at hardly any posture ({len(q)} of {POSTURES} found): check [camera], "
                "carried, stands, tilt and range"
            )
        split = base_columns(self.cell, self.block(q), columns)
        return ImageObservation(self.cell, True, columns[split.kept], view=self)

    def block(self, q: np.ndarray) -> list[Block]:
        """Return an image measurement at joint values q (m, n), prepared for a fit, whose corner pixels are all zero.

        Only the Jacobian of this measurement is used, and it does not depend on the measured pixels.
        """
        pixel = np.zeros((len(q), len(corners(self.board)), 2))
        block = Pixels(
            q,
            self.cell.chain.joint_names,
            pixel,
            self.board,
            self.lens,
            mounting=self.mounting,
            station=self.cell.station_names[0],
            tool_names=self.cell.tool_names,
        )
        return prepare(self.cell, [block])

    def draw(
        self,
        count: int,
        feasible: Callable[[np.ndarray], np.ndarray],
        lower: np.ndarray,
        upper: np.ndarray,
        seed: int | np.random.Generator,
    ) -> np.ndarray:
        """Return random postures (at most `count`, n) [rad or m] at which the board is in view.

        Random relative poses of board and camera are drawn and solved by inverse kinematics, since only about one in a
        thousand random postures has the board in view.

        Args:
            count: number of postures.
            feasible: function q (m, n) -> (m,) that returns whether each posture is feasible.
            lower, upper: (n,) joint limits [rad or m].
            seed: seed or generator of random numbers.
        """
        stream = np.random.default_rng(seed)
        goal = Goal(self.cell, 6, lower, upper)
        result = np.zeros((0, self.cell.chain.n))
        for attempt in range(TRIES):
            targets = self._views(4 * count, stream)
            if self.mounting == IN_HAND:
                targets = invert(targets)
            starts = stream.uniform(lower, upper, (len(targets), len(lower)))
            q = reach(goal, targets, starts, INVERSE_STEPS)
            difference = np.linalg.norm(seen_at(goal, q).poses() - targets, axis=(1, 2))
            q = q[difference < REACHED]
            if len(q):
                q = q[feasible(q)]
            result = np.concatenate([result, q])
            # hardly any after a tenth of the tries: there will not be enough
            hopeless = attempt >= TRIES // 10 and len(result) < count // 50
            if len(result) >= count or hopeless:
                break
        return result[:count]

    def _views(self, count: int, stream: np.random.Generator) -> np.ndarray:
        """Return random poses (count, 4, 4) of the board in the camera frame, at allowed distance and tilt.

        Args:
            count: number of poses.
            stream: generator of the random numbers.
        """
        azimuth = stream.uniform(-np.pi, np.pi, count)
        tilt = self.tilt * np.sqrt(stream.uniform(0.0, 1.0, count))
        axis = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)])
        roll = Rotation.from_rotvec(np.outer(stream.uniform(-np.pi, np.pi, count), [0.0, 0.0, 1.0]))
        rotation = (Rotation.from_rotvec(tilt[:, None] * axis) * roll).as_matrix()
        depth = stream.uniform(*self.span, count)
        offset = stream.uniform(-CENTRAL, CENTRAL, (count, 2)) * 0.5 * np.array(self.lens.size) / self.lens.values[:2]
        middle = np.column_stack([offset * depth[:, None], depth])
        return pose(rotation, middle - rotation @ (0.5 * np.array([*self.board.extent, 0.0])))


@dataclass(frozen=True, eq=False)
class ImageObservation(Observation):
    """Whitened observation Jacobian of images, as a function of joint values.

    It maps q (m, n) to the derivatives (m, rows, p) of the measured quantities, divided by their noise, by p
    identifiable parameters. The corners of one image are condensed to their information on the board's pose and the
    lens. The assumed noise of corners and of the arm's repeatability is our choice (`CORNER`, `DISPLACEMENT`, `TURN`).

    Attributes:
        view: placements of camera and board.
    """

    _: KW_ONLY
    view: CameraView
    product = None  # type: ignore[assignment]

    def position(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the position (m, 3) [m] of the carried camera or board, and its Jacobian (m, 3, p).

        The Jacobian is not divided by the measurement noise.

        Args:
            q: (m, n) joint values [rad or m].
        """
        target = see(self.cell, q, -1)
        columns = target_jacobian(self.cell, target, self.free, -1, np.zeros(len(q), dtype=int))
        return target.point.T, columns[:, :3].transpose(2, 1, 0)

    def __call__(self, q: np.ndarray) -> np.ndarray:
        part = observe(self.cell, self.view.block(q)[0], self.free)[0]
        noise = ImageNoise(1.0, DISPLACEMENT, TURN, np.ones(len(q)))
        matrix = replace(part, noise=noise).whitened(np.full(part.value.shape, CORNER))[1]
        return matrix.reshape(len(q), -1, len(self.free))


def camera_view(table: CameraTable, chain: Chain, where: str, folder: Path) -> CameraView:
    """Return the camera view that the table ``[camera]`` of a constraints file describes.

    Args:
        table: table ``[camera]`` of the file.
        chain: the nominal arm.
        where: name of the constraints file for messages.
        folder: folder that contains the lens file and the board file.

    Raises:
        UsageError, MeasurementError, RobotError: for a missing file or an invalid placement.
    """
    for name in (table.lens, table.board):
        require((folder / name).is_file(), f"{where}: camera: no file '{name}' next to it: copy it there", UsageError)
    if not table.range[0] < table.range[1]:
        raise UsageError(f"{where}: camera.range: {table.range[0]:g} is not below {table.range[1]:g}")
    lens = read_lens(folder / table.lens)
    board = read_board(folder / table.board)
    carried = placement(dict(table.carried), f"{where}: camera.carried")
    stands = placement(dict(table.stands), f"{where}: camera.stands")
    # the places are those of the board's middle
    T_middle_board = pose(None, -0.5 * np.array([*board.extent, 0.0]))
    if table.mounting == IN_HAND:
        station, tool = "board", "camera"
        stands = stands @ T_middle_board
    else:
        station, tool = "camera", "board"
        carried = carried @ T_middle_board
    free = frozenset(f"camera.{name}" for name in lens.names[:FREE_LENS_PARAMETERS])
    optics = Optics((lens,), ("camera",), (BoardShape(),), ("board",), free)
    cell = Installation(chain, invert(stands)[None], carried[None], (station,), (tool,), optics=optics)
    return CameraView(cell, board, table.mounting, table.tilt, table.range, table.margin)

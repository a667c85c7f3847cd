"""Pose selection with a camera: visibility of the board, and observation Jacobian of images.

``[camera]`` of the constraints file states the camera (`calib formats constraints`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.images.board import Board, corners, read_board
from calib.data.images.lens import Lens, read_lens
from calib.data.images.optics import BoardShape, Optics
from calib.data.images.pixels import Pixels
from calib.data.poses import IN_HAND
from calib.errors import UsageError, require
from calib.geometry.camera.pixel_residuals import ImageNoise
from calib.geometry.installation import Installation, see
from calib.geometry.inverse import Goal, reach, seen_at
from calib.geometry.observability import Observation, base_columns
from calib.geometry.observation import Block, layout, observe, prepare, target_jacobian
from calib.procedure.measuring.constraints_file import CameraTable
from calib.robot.chain import Chain
from calib.robot.tables import placement
from calib.transforms import invert, pose
from poses.space import PoseConstraint

CORNER, DISPLACEMENT, TURN = 0.05, 2e-5, 2e-5  # noise that a pose is judged by [px], [m], [rad]; our choice
ASSUMED = (
    f"predicted σ: for corner noise of {CORNER:g} px and a repeatability of {1e3 * DISPLACEMENT:g} mm and "
    f"{1e3 * TURN:g} mrad per axis; unmodelled effects come on top"
)
TRIES = 60


@dataclass(frozen=True, eq=False)
class CameraView:
    """Constraint "the camera sees the whole board": q (m, n) -> (m, 19), satisfied where <= 0.

    Attributes:
        cell: the arm with camera and board where they roughly are.
        board: to be seen whole.
        mounting: ``in hand`` or ``to hand``.
        tilt: largest angle [rad].
        span: least and largest distance [m].
        margin: to the image's edge [px].
    """

    cell: Installation
    board: Board
    mounting: str
    tilt: float
    span: tuple[float, float]
    margin: float

    @property
    def lens(self) -> Lens:
        """Lens of the camera."""
        return self.cell.optics.lenses[0]

    def poses(self, q: np.ndarray) -> np.ndarray:
        """Return the board's poses (m, 4, 4) in the camera's frame."""
        found = see(self.cell, q).poses()
        return invert(found) if self.mounting == IN_HAND else found

    def __call__(self, q: np.ndarray) -> np.ndarray:
        poses, size = self.poses(q), np.array(self.lens.size)
        table = corners(self.board)
        wide, high = table[:, :2].min(axis=0), table[:, :2].max(axis=0)
        edge = np.array([[x, y, 0.0] for x in (wide[0], high[0]) for y in (wide[1], high[1])])
        point = np.einsum("mij,kj->mki", poses[:, :3, :3], edge) + poses[:, None, :3, 3]
        aside = np.maximum(np.linalg.norm(point[:, :, :2], axis=2), 1e-3)
        ahead = np.concatenate([point[:, :, :2], np.maximum(point[:, :, 2:], aside[:, :, None] / 2.0)], axis=2)
        pixel = self.lens.project(ahead.reshape(-1, 3)).reshape(len(q), -1, 2)
        outside = np.concatenate([self.margin - pixel, pixel + self.margin + 1 - size], axis=2) / size[0]
        middle = poses[:, :3, :3] @ (0.5 * np.array([*self.board.extent, 0.0])) + poses[:, :3, 3]
        far = np.linalg.norm(middle, axis=1)
        lean = np.cos(self.tilt) - np.einsum("mi,mi->m", poses[:, :3, 2], middle) / np.maximum(far, 1e-9)
        rest = np.column_stack([self.span[0] - far, far - self.span[1], lean])
        return np.concatenate([outside.reshape(len(q), -1), rest], axis=1)

    @property
    def stand(self) -> np.ndarray:
        """Position (3,) of the fixed camera or of the fixed board's centre in the arm's base [m]."""
        placed = invert(self.cell.stations[0])
        middle = 0.5 * np.array(self.board.extent) if self.mounting == IN_HAND else np.zeros(2)
        return (placed @ [*middle, 0.0, 1.0])[:3]

    def constraint(self) -> PoseConstraint:
        """Return the visibility constraint for pose selection."""
        return PoseConstraint("board in view of the camera", self)

    @property
    def assumed(self) -> str:
        """The noise assumed when σ is predicted, as a sentence."""
        return ASSUMED

    def observation(self, lower: np.ndarray, upper: np.ndarray, seed: int = 0) -> ImageObservation:
        """Return the observation Jacobian of images for the parameters that views of the board can identify."""
        columns = layout(self.cell).rigid_index
        q = self.draw(100, lambda each: np.all(self(each) <= 1e-8, axis=1), lower, upper, seed)
        if len(q) < 20:
            raise UsageError(
                f"the camera sees the board at hardly any posture ({len(q)} of 100 found): check [camera], "
                "carried, stands, tilt and range"
            )
        split = base_columns(self.cell, self.block(q), columns)
        return ImageObservation(self.cell, True, columns[split.kept], view=self)

    def block(self, q: np.ndarray) -> list[Block]:
        """Return a block of images at joint values q (m, n), ready for a fit, with all corners set to zero."""
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
        """Return up to `count` random postures (·, n) with the board in view: views are drawn, and the arm put there.

        Postures drawn at random see a board once in a thousand.
        """
        rng, goal = np.random.default_rng(seed), Goal(self.cell, 6, lower, upper)
        result = np.zeros((0, self.cell.chain.n))
        for attempt in range(TRIES):
            wanted = self._views(4 * count, rng)
            targets = invert(wanted) if self.mounting == IN_HAND else wanted
            q = reach(goal, targets, rng.uniform(lower, upper, (len(targets), len(lower))), 30)
            q = q[np.linalg.norm(seen_at(goal, q).poses() - targets, axis=(1, 2)) < 1e-3]
            result = np.concatenate([result, q[feasible(q)] if len(q) else q])
            if len(result) >= count or (attempt >= TRIES // 10 and len(result) < count // 50):
                break
        return result[:count]

    def _views(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return random poses (count, 4, 4) of the board in front of the camera."""
        about, lean = rng.uniform(-np.pi, np.pi, count), self.tilt * np.sqrt(rng.uniform(0.0, 1.0, count))
        axis = np.column_stack([np.cos(about), np.sin(about), np.zeros(count)])
        roll = Rotation.from_rotvec(np.outer(rng.uniform(-np.pi, np.pi, count), [0.0, 0.0, 1.0]))
        turn = (Rotation.from_rotvec(lean[:, None] * axis) * roll).as_matrix()
        depth = rng.uniform(*self.span, count)
        share = rng.uniform(-0.8, 0.8, (count, 2)) * 0.5 * np.array(self.lens.size) / self.lens.values[:2]
        place = np.column_stack([share * depth[:, None], depth])
        return pose(turn, place - turn @ (0.5 * np.array([*self.board.extent, 0.0])))


@dataclass(frozen=True, eq=False)
class ImageObservation(Observation):
    """Whitened observation Jacobian of images for the p identifiable parameters: q (m, n) -> (m, rows, p).

    An image's corners are reduced to what they say of the board's pose and the lens; noise of corners and of the arm's
    repeatability are our choice (`CORNER`, `DISPLACEMENT`, `TURN`).

    Attributes:
        view: camera and board.
    """

    _: KW_ONLY
    view: CameraView
    product = None  # type: ignore[assignment]

    def position(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the position (m, 3) [m] of the carried camera or board, and its Jacobian (m, 3, p), not whitened."""
        seen = see(self.cell, q, -1)
        columns = target_jacobian(self.cell, seen, self.free, -1, np.zeros(len(q), dtype=int))
        return seen.point.T, columns[:, :3].transpose(2, 1, 0)

    def __call__(self, q: np.ndarray) -> np.ndarray:
        part = observe(self.cell, self.view.block(q)[0], self.free)[0]
        noise = ImageNoise(1.0, DISPLACEMENT, TURN, np.ones(len(q)))
        matrix = replace(part, noise=noise).whitened(np.full(part.value.shape, CORNER))[1]
        return matrix.reshape(len(q), -1, len(self.free))


def camera_view(stated: CameraTable, chain: Chain, where: str, folder: Path) -> CameraView:
    """Return the camera view described by a constraints file.

    Args:
        stated: its table.
        chain: the nominal arm.
        where: for messages.
        folder: that the lens's and the board's files are beside.

    Raises:
        UsageError, MeasurementError, RobotError: for a file that is missing, or a place that cannot be.
    """
    for name in (stated.lens, stated.board):
        require((folder / name).is_file(), f"{where}: camera: no file '{name}' next to it", UsageError)
    if not stated.range[0] < stated.range[1]:
        raise UsageError(f"{where}: camera.range: {stated.range[0]:g} is not below {stated.range[1]:g}")
    lens, board = read_lens(folder / stated.lens), read_board(folder / stated.board)
    carried = placement(dict(stated.carried), f"{where}: camera.carried")
    stands = placement(dict(stated.stands), f"{where}: camera.stands")
    names = ("board", "camera") if stated.mounting == IN_HAND else ("camera", "board")
    middle = pose(None, -0.5 * np.array([*board.extent, 0.0]))  # places are those of the board's middle
    if stated.mounting == IN_HAND:
        stands = stands @ middle
    else:
        carried = carried @ middle
    free = frozenset(f"camera.{name}" for name in lens.names[:8])
    optics = Optics((lens,), ("camera",), (BoardShape(),), ("board",), free)
    cell = Installation(chain, invert(stands)[None], carried[None], names[:1], names[1:], optics=optics)
    return CameraView(cell, board, stated.mounting, stated.tilt, stated.range, stated.margin)

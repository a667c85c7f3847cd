"""What an image adds to an installation: lenses, and the shape of boards as printed; their parameters and derivatives.

A corner (x, y, 0) of the table stands on the board at (s x, s y, w), w = b₁ X² + b₂ XY + b₃ Y² with X, Y counted
from the board's middle: s is the scale of the print, b how the board bends [1/m].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.data.camera.board import Board
from calib.data.camera.lens import Lens

SHAPE = ("scale", "bend_xx", "bend_xy", "bend_yy")
UNITS = ("", "1/m", "1/m", "1/m")


@dataclass(frozen=True)
class BoardShape:
    """How a print differs from its table: scale, and bending [1/m]."""

    scale: float = 1.0
    bend_xx: float = 0.0
    bend_xy: float = 0.0
    bend_yy: float = 0.0

    @property
    def values(self) -> np.ndarray:
        """The four values."""
        return np.array([self.scale, self.bend_xx, self.bend_xy, self.bend_yy])

    @property
    def bent(self) -> bool:
        """Whether it is not flat."""
        return any((self.bend_xx, self.bend_xy, self.bend_yy))


@dataclass(frozen=True, eq=False)
class Optics:
    """All cameras and boards of an installation; without any where nothing was seen by a camera.

    Attributes:
        lenses: one per camera, by name.
        boards: one per board, by name.
        free: names of the parameters that may be fitted.
    """

    lenses: tuple[Lens, ...] = ()
    lens_names: tuple[str, ...] = ()
    boards: tuple[BoardShape, ...] = ()
    board_names: tuple[str, ...] = ()
    free: frozenset[str] = frozenset()

    @property
    def names(self) -> tuple[str, ...]:
        """One per parameter: the lenses' values first, then the boards' shapes."""
        own = [f"{name}.{value}" for name, lens in zip(self.lens_names, self.lenses) for value in lens.names]
        return (*own, *(f"{name}.{value}" for name in self.board_names for value in SHAPE))

    @property
    def units(self) -> tuple[str, ...]:
        """One per parameter."""
        own = [unit for lens in self.lenses for unit in ("px", "px", "px", "px", *[""] * (len(lens.values) - 4))]
        return (*own, *(UNITS * len(self.boards)))

    @property
    def values(self) -> np.ndarray:
        """All parameters."""
        own = [lens.values for lens in self.lenses] + [board.values for board in self.boards]
        return np.concatenate([np.zeros(0), *own])

    @property
    def moving(self) -> np.ndarray:
        """Positions of those that may be fitted."""
        return np.array([k for k, name in enumerate(self.names) if name in self.free], dtype=int)

    def __len__(self) -> int:
        return sum(len(lens.values) for lens in self.lenses) + len(SHAPE) * len(self.boards)

    def with_values(self, values: np.ndarray) -> Optics:
        """Return the same with other values; a focal length changes by half at most, however wild the step."""
        lenses, start = [], 0
        for lens in self.lenses:
            own = np.array(values[start : start + len(lens.values)])
            own[:2] = np.clip(own[:2], 0.5 * lens.values[:2], 1.5 * lens.values[:2])
            lenses.append(lens.with_values(own))
            start += len(lens.values)
        shapes = np.asarray(values[start:]).reshape(-1, len(SHAPE))
        return replace(self, lenses=tuple(lenses), boards=tuple(BoardShape(*map(float, row)) for row in shapes))

    def like(self, other: Optics) -> Optics:
        """Return the same cameras and boards with the values of another's where they are of one kind; none is free."""
        known = {(lens.model, lens.size): lens for lens in reversed(other.lenses)}
        lenses = tuple(known.get((lens.model, lens.size), lens) for lens in self.lenses)
        shapes = {name: shape for name, shape in zip(other.board_names, other.boards)}
        alone = other.boards[0] if len(other.boards) == 1 else BoardShape()
        boards = tuple(shapes.get(name, alone) for name in self.board_names)
        return replace(self, lenses=lenses, boards=boards, free=frozenset())

    def place(self, camera: str, board: str) -> np.ndarray:
        """Return the positions of the parameters that an image by `camera` of `board` depends on."""
        edges = np.cumsum([0, *(len(lens.values) for lens in self.lenses)])
        lens = self.lens_names.index(camera)
        first = int(edges[-1]) + len(SHAPE) * self.board_names.index(board)
        return np.concatenate([np.arange(edges[lens], edges[lens + 1]), np.arange(first, first + len(SHAPE))])


@dataclass(frozen=True, eq=False)
class View:
    """The camera and the board of one block of images, for its residuals.

    Attributes:
        lens, shape: of the camera and the board.
        own: (k,) which of their values (the lens's, then the board's) are among the free parameters.
        place: (k,) where those stand among the f free parameters.
    """

    lens: Lens
    shape: BoardShape
    own: np.ndarray
    place: np.ndarray


def shaped_points(board: Board, shape: BoardShape, points: np.ndarray) -> np.ndarray:
    """Return where points (N, 3) [m] of a board's table stand on the print."""
    return _shaped(board, shape, points)[0]


def shape_slopes(board: Board, shape: BoardShape, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where points (N, 3) [m] stand, and the derivative by the four values (N, 3, 4)."""
    return _shaped(board, shape, points)


def _shaped(board: Board, shape: BoardShape, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x, y = (points[:, :2] - 0.5 * np.array(board.extent)).T
    slope = np.zeros((len(points), 3, 4))
    slope[:, :2, 0] = points[:, :2]
    slope[:, 2, 1:] = np.stack([x * x, x * y, y * y], axis=1)
    place = points * [shape.scale, shape.scale, 0.0]
    place[:, 2] = slope[:, 2, 1:] @ shape.values[1:]
    return place, slope

"""Calibration parameters of images: lenses and shapes of printed boards, with derivatives.

A nominal corner (x, y, 0) lies on the printed board at (s x, s y, w), w = b₁ X² + b₂ XY + b₃ Y² with X, Y measured from
the board's centre: s is the scale of the print, b the curvature of the board [1/m]. In ``robot.toml`` of a fit::

    [[camera]]                       # its lens
    name = "camera"
    model = "pinhole"                # or fisheye
    size = [2448, 2048]              # of its images [px]
    values = [2400.0, ...]           # fx fy cx cy k1 k2 p1 p2 k3 [k4 k5 k6], or fx fy cx cy k1 k2 k3 k4
    [[board]]                        # the print: scale, and bending [1/m]
    name = "board"
    scale = 1.0
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from calib.data.images.board import Board
from calib.data.images.lens import Lens
from calib.data.images.pixels import Pixels
from calib.data.poses.measurements import PoseMeasurements
from calib.errors import refuse_option
from calib.records import read_record

SHAPE = ("scale", "bend_xx", "bend_xy", "bend_yy")
UNITS = ("", "1/m", "1/m", "1/m")


@dataclass(frozen=True)
class BoardShape:
    """Deviation of a printed board from its nominal shape: scale, and bending [1/m]."""

    scale: float = 1.0
    bend_xx: float = 0.0
    bend_xy: float = 0.0
    bend_yy: float = 0.0

    @property
    def values(self) -> np.ndarray:
        """The four values (scale and bending)."""
        return np.array([self.scale, self.bend_xx, self.bend_xy, self.bend_yy])

    @property
    def bent(self) -> bool:
        """Whether the board is not flat."""
        return any((self.bend_xx, self.bend_xy, self.bend_yy))


@dataclass(frozen=True, eq=False)
class Optics:
    """All cameras and boards of an installation; empty without images.

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
        """Names of the parameters: the lenses' values first, then the boards' shapes."""
        result: list[str] = []
        for name, lens in zip(self.lens_names, self.lenses):
            result += [f"{name}.{value}" for value in lens.names]
        for name in self.board_names:
            result += [f"{name}.{value}" for value in SHAPE]
        return tuple(result)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the parameters."""
        result: list[str] = []
        for lens in self.lenses:
            result += ["px"] * 4 + [""] * (len(lens.values) - 4)
        return (*result, *(UNITS * len(self.boards)))

    @property
    def values(self) -> np.ndarray:
        """Values of all parameters."""
        values = [np.zeros(0)]
        values += [lens.values for lens in self.lenses]
        values += [board.values for board in self.boards]
        return np.concatenate(values)

    @property
    def moving(self) -> np.ndarray:
        """Indices of the parameters that may be fitted."""
        indices = [k for k, name in enumerate(self.names) if name in self.free]
        return np.array(indices, dtype=int)

    def __len__(self) -> int:
        return sum(len(lens.values) for lens in self.lenses) + len(SHAPE) * len(self.boards)

    def with_values(self, values: np.ndarray) -> Optics:
        """Return the optics with other parameter values; each focal length is limited to a change by half of its
        present value.
        """
        lenses = []
        start = 0
        for lens in self.lenses:
            lens_values = np.array(values[start : start + len(lens.values)])
            lens_values[:2] = np.clip(lens_values[:2], 0.5 * lens.values[:2], 1.5 * lens.values[:2])
            lenses.append(lens.with_values(lens_values))
            start += len(lens.values)
        shapes = np.asarray(values[start:]).reshape(-1, len(SHAPE))
        boards = tuple(BoardShape(*row) for row in shapes.astype(float).tolist())
        return replace(self, lenses=tuple(lenses), boards=boards)

    def like(self, source: Optics) -> Optics:
        """Return these optics with the values of other optics (same lens model, same board); no parameter is free."""
        lens_by_kind = {(lens.model, lens.size): lens for lens in reversed(source.lenses)}
        lenses = tuple(lens_by_kind.get((lens.model, lens.size), lens) for lens in self.lenses)
        shapes = dict(zip(source.board_names, source.boards))
        default_shape = source.boards[0] if len(source.boards) == 1 else BoardShape()
        boards = tuple(shapes.get(name, default_shape) for name in self.board_names)
        return replace(self, lenses=lenses, boards=boards, free=frozenset())

    def view(self, measured: PoseMeasurements, free: np.ndarray) -> View | None:
        """Return lens, board shape and free parameters of a block of images; None for other measurements."""
        if not isinstance(measured, Pixels):
            return None
        if measured.camera not in self.lens_names or measured.target not in self.board_names:
            refuse_option(
                measured.file,
                f"camera '{measured.camera}' with board '{measured.target}' is not part of the "
                f"installation, which has {', '.join(self.lens_names) or 'no camera'}",
            )
        edges = np.cumsum([0, *(len(lens.values) for lens in self.lenses)])
        lens = self.lens_names.index(measured.camera)
        board = self.board_names.index(measured.target)
        first_of_shape = int(edges[-1]) + len(SHAPE) * board
        lens_parameters = np.arange(edges[lens], edges[lens + 1])
        shape_parameters = np.arange(first_of_shape, first_of_shape + len(SHAPE))
        parameters = np.concatenate([lens_parameters, shape_parameters])
        _, in_view, in_free = np.intersect1d(parameters, free, return_indices=True)
        return View(self.lenses[lens], self.boards[board], in_view, in_free)

    def tables(self) -> dict[str, object]:
        """Return the tables ``camera`` and ``board`` of ``robot.toml``; `read_optics` reads them."""
        cameras = []
        for name, lens in zip(self.lens_names, self.lenses):
            cameras.append({"name": name, "model": lens.model, "size": list(lens.size), "values": lens.values.tolist()})
        boards = [{"name": name, **asdict(shape)} for name, shape in zip(self.board_names, self.boards)]
        return {"camera": cameras, "board": boards}


@dataclass(frozen=True)
class _Camera:
    """An entry of the table ``camera``."""

    name: str
    model: str
    size: tuple[int, int]
    values: tuple[float, ...]


@dataclass(frozen=True)
class _Board(BoardShape):
    """An entry of the table ``board``."""

    name: str = ""


def read_optics(cameras: Sequence[Mapping[str, object]], boards: Sequence[Mapping[str, object]]) -> Optics:
    """Return the cameras and boards of the tables ``camera`` and ``board`` of a fit's ``robot.toml``.

    Raises:
        ValueError, CalibError: for an invalid table.
    """
    lenses: list[Lens] = []
    lens_names: list[str] = []
    for camera in read_record(tuple[_Camera, ...], cameras):
        lenses.append(Lens(camera.model, np.array(camera.values), camera.size))
        lens_names.append(camera.name)
    shapes: list[BoardShape] = []
    board_names: list[str] = []
    for board in read_record(tuple[_Board, ...], boards):
        shapes.append(BoardShape(*board.values))
        board_names.append(board.name)
    return Optics(tuple(lenses), tuple(lens_names), tuple(shapes), tuple(board_names))


@dataclass(frozen=True, eq=False)
class View:
    """Lens and board shape that predict one block of images.

    Attributes:
        lens, shape: lens of the camera, and shape of the board.
        in_view: (k,) indices of the fitted values among the lens's values followed by the board's.
        in_free: (k,) positions of these k values among the f free parameters of the fit.
    """

    lens: Lens
    shape: BoardShape
    in_view: np.ndarray
    in_free: np.ndarray


def shaped_points(board: Board, shape: BoardShape, points: np.ndarray) -> np.ndarray:
    """Return the positions (N, 3) [m] of nominal board points on the printed board."""
    return shape_slopes(board, shape, points)[0]


def shape_slopes(board: Board, shape: BoardShape, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (N, 3) [m] on the printed board, and their Jacobian (N, 3, 4) with respect to its shape."""
    x, y = (points[:, :2] - 0.5 * np.array(board.extent)).T
    slope = np.zeros((len(points), 3, 4))
    slope[:, :2, 0] = points[:, :2]
    slope[:, 2, 1:] = np.stack([x * x, x * y, y * y], axis=1)
    positions = points * [shape.scale, shape.scale, 0.0]
    positions[:, 2] = slope[:, 2, 1:] @ shape.values[1:]
    return positions, slope

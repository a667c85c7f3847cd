"""Printed boards: the positions of their corners, and the file ``board.toml``.

The board's frame lies in its upper left corner as printed: x to the right, y down, z into the paper, so that a board
held upright before a camera has the camera's own axes. Corners are numbered as OpenCV numbers them: row by row the
inner corners of a ChArUco board and a chessboard; of an AprilTag grid four per tag, from its upper left clockwise.
Squares are counted, not inner corners::

    kind = "charuco"                 # charuco, chessboard, apriltag
    columns = 9                      # squares (or tags) across and down
    rows = 7
    square = 0.03                    # side of a square (or of a tag) [m], as measured on the print
    marker = 0.021                   # side of a marker [m]; apriltag: the gap between two tags
    dictionary = "5x5_100"           # of the markers: 4x4_50 … 7x7_1000, apriltag_36h11 …
    legacy = false                   # ChArUco with even rows as OpenCV drew it before 4.6 (setLegacyPattern)
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np

from calib import files
from calib.config import parse, read_toml, strict
from calib.config_types import Flag, OneOf, Real, Whole
from calib.data.poses import BOARD

KINDS = ("charuco", "chessboard", "apriltag")
DICTIONARIES = {f"{bits}x{bits}_{count}": count for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)} | {
    "apriltag_16h5": 30,
    "apriltag_25h9": 35,
    "apriltag_36h10": 2320,
    "apriltag_36h11": 587,
}
"""Number of markers in each dictionary."""
# Smallest number of corners with which an image is used.
MIN_CORNERS = 8
# Smallest and largest marker (of an AprilTag grid: gap between tags), as shares of the side of a square.
MARKER_SHARES = {"charuco": (0.3, 0.9), "apriltag": (0.05, 2.0)}
KIND_NAMES = {"charuco": "ChArUco", "chessboard": "chessboard", "apriltag": "AprilTag grid"}


@strict
@dataclass(frozen=True)
class Board:
    """Type, size and markers of a printed board."""

    kind: Annotated[str, OneOf(KINDS)] = "charuco"
    columns: Annotated[int, Whole(2)] = 9
    rows: Annotated[int, Whole(2)] = 7
    square: Annotated[float, Real(above=0, most=2.0, unit="m", quantity="length")] = 0.03
    marker: Annotated[float, Real(least=0, most=2.0, unit="m", quantity="length")] = 0.0
    dictionary: Annotated[str, OneOf(tuple(DICTIONARIES))] = "5x5_100"
    legacy: Flag = False

    def __post_init__(self) -> None:
        if max(self.columns, self.rows) > 100:
            raise ValueError(f"{self.columns} x {self.rows} squares: the limit is 100 per row")
        min_share, max_share = MARKER_SHARES.get(self.kind, (0.0, np.inf))
        if not min_share * self.square <= self.marker <= max_share * self.square:
            quantity = "gap between two tags"
            if self.kind == "charuco":
                quantity = "side of a marker"
            raise ValueError(
                f"marker = {self.marker:g}: the {quantity} must be between {min_share:g} and {max_share:g} of "
                f"square = {self.square:g}"
            )
        if self.kind == "chessboard" and (self.columns + self.rows) % 2 == 0:
            squares = f"{self.columns} x {self.rows} squares"
            raise ValueError(
                f"{squares} look the same upside down: take an even and an odd number of squares (squares are counted, "
                "not inner corners)"
            )
        if self.kind == "chessboard" and min(self.columns, self.rows) < 4:
            raise ValueError("a chessboard needs at least 4 squares in each direction")
        count = DICTIONARIES.get(self.dictionary, self.tags)
        if self.tags > count:
            raise ValueError(f"{self.tags} markers are needed, the dictionary {self.dictionary} has {count}")

    @property
    def tags(self) -> int:
        """Number of markers on the board."""
        count = self.columns * self.rows
        tags_by_kind = {"charuco": count // 2, "apriltag": count, "chessboard": 0}
        return tags_by_kind[self.kind]

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height of the pattern [m]."""
        if self.kind == "apriltag":
            pitch = self.square + self.marker
            width = self.columns * pitch - self.marker
            height = self.rows * pitch - self.marker
            return width, height
        return self.columns * self.square, self.rows * self.square

    @property
    def words(self) -> str:
        """Short description of the board."""
        return f"{KIND_NAMES[self.kind]} {self.columns} x {self.rows}, {1e3 * self.square:g} mm"


def corners(board: Board) -> np.ndarray:
    """Return the positions (K, 3) [m] of a board's corners in the board's frame."""
    if board.kind == "apriltag":
        pitch = board.square + board.marker
        side = board.square
        positions = []
        for row, column in product(range(board.rows), range(board.columns)):
            x = column * pitch
            y = row * pitch
            for shift_x, shift_y in ((0.0, 0.0), (side, 0.0), (side, side), (0.0, side)):
                positions.append((x + shift_x, y + shift_y, 0.0))
        return np.array(positions)
    columns = np.arange(1, board.columns)
    rows = np.arange(1, board.rows)
    across, down = np.meshgrid(columns, rows)
    heights = np.zeros(across.size)
    counts = np.column_stack([across.ravel(), down.ravel(), heights])
    return board.square * counts


def read_board(path: str | Path) -> Board:
    """Return the board that a file describes; of a folder, the file ``board.toml`` is read.

    Raises:
        UsageError: for an unknown key or an impossible value.
    """
    path = Path(path)
    if path.is_dir():
        path = path / BOARD
    return parse(Board, read_toml(path), str(path))


def write_board(board: Board, path: str | Path) -> Path:
    """Write a board as ``board.toml``; return the path."""
    marker_comments = {"apriltag": "the gap between two tags [m]", "charuco": "side of a marker [m]"}
    comment = marker_comments.get(board.kind, "unused")
    lines = [
        f'kind = "{board.kind}"',
        f"columns = {board.columns}".ljust(32) + "# squares (tags) across",
        f"rows = {board.rows}".ljust(32) + "# and down",
        f"square = {board.square!r}".ljust(32) + "# side of a square (tag) [m]: put in what you measure on the print",
        f"marker = {board.marker!r}".ljust(32) + f"# {comment}",
        f'dictionary = "{board.dictionary}"',
    ]
    if board.legacy:
        lines.append("legacy = true".ljust(32) + "# pattern of OpenCV before 4.6")
    return files.write(path, "\n".join(lines) + "\n")

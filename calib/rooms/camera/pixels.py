"""Camera measurements: corners of a board in images, one row per image."""

from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

import numpy as np

from calib.data.poses import IMAGES, IN_HAND
from calib.data.poses.measurements import PoseMeasurements
from calib.rooms.camera.board import Board
from calib.rooms.camera.lens import Lens


@dataclass(frozen=True, eq=False)
class Pixels(PoseMeasurements):
    """Pixel positions of a rigid board's corners in m images.

    The camera in the hand: the arm carries the camera (``tool``), ``station`` is the board's place. The camera to the
    hand: the arm carries the board (``tool``), ``station`` is the camera's place.

    Attributes:
        pixel: (m, K, 2) corners of the board's table [px]; NaN where not seen.
        board: the board.
        lens: of the camera, where known beforehand or estimated from images.
        mounting: ``in hand`` or ``to hand``; empty where it is yet to be found.
        sigma: (m, K) standard deviation of a coordinate [px].
        names: of all images of the file; ``rows`` count them from 1.
        size: width and height of the images [px]; 0, 0 where unknown.
        model: of a lens that is yet to be found.
        known: whether the lens was given, and not found from these images.
        free: what is fitted of the lens (``fx`` …) and of the board (``scale``, ``bend_xx`` …).
    """

    pixel: np.ndarray
    board: Board
    lens: Lens | None
    _: KW_ONLY
    mounting: str = ""
    sigma: np.ndarray | None = None
    names: tuple[str, ...] = ()
    size: tuple[int, int] = (0, 0)
    model: str = "pinhole"
    known: bool = False
    free: tuple[str, ...] = ()

    kind: ClassVar[str] = IMAGES
    placing: ClassVar[int] = 1
    has_instrument: ClassVar[bool] = True

    @property
    def seen(self) -> np.ndarray:
        """Whether each corner was detected, (m, K)."""
        return ~np.isnan(self.pixel[:, :, 0])

    @property
    def measured(self) -> np.ndarray:
        return np.nan_to_num(self.pixel.reshape(len(self), -1), nan=-1.0)

    @property
    def camera(self) -> str:
        """Name of the camera among an installation's lenses: the tool or station that holds it."""
        return self.tool_names[0] if self.mounting == IN_HAND else self.station

    @property
    def carried(self) -> tuple[str, object]:
        return ("camera", self.size) if self.mounting == IN_HAND else ("board", self.board)

    @property
    def target(self) -> str:
        """Name of the board among an installation's boards."""
        return self.station if self.mounting == IN_HAND else self.tool_names[0]

    def name(self, row: int) -> str:
        """Return the image's name by its row number in the file."""
        return self.names[row - 1] if 0 < row <= len(self.names) else f"image {row}"

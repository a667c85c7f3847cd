"""Camera measurements: corners of a board in images, one row per image.

``corners.csv``: the corners detected in the images of a folder, one per row, and why other images are unusable.

Columns ``image``, ``corner``, ``u [px]``, ``v [px]``, ``sigma [px]``; an image without a usable board has one row with
its ``problem`` and nothing else. Written beside the images, so that they are looked at once; a file that another
program has written is read as well (without ``sigma``: 0.1 px).
"""

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from calib import files
from calib.data.images.board import Board, corners
from calib.data.images.lens import Lens
from calib.data.poses import IMAGES, IN_HAND
from calib.data.poses.measurements import PoseMeasurements
from calib.errors import MeasurementError, refuse_data, refused_as


@dataclass(frozen=True, eq=False)
class Pixels(PoseMeasurements):
    """Measured pixel positions of a board's corners in m images.

    Mounting in hand: the arm carries the camera (``tool``), and ``station`` is the board's placement. Mounting to hand:
    the arm carries the board (``tool``), and ``station`` is the camera's placement.

    Attributes:
        pixel: (m, K, 2) pixels of the board's K corners [px]; NaN where not seen.
        board: the board.
        lens: lens of the camera, given or estimated from images; None where not known yet.
        mounting: ``in hand`` or ``to hand``; empty where not known yet.
        sigma: (m, K) standard deviation of a coordinate [px].
        names: names of all images of the folder; ``rows`` number them from 1.
        size: width and height of the images [px]; 0, 0 where unknown.
        model: lens model (``pinhole``, ``fisheye``) for a lens that is to be estimated.
        known: whether the lens was given instead of estimated from these images.
        free: names of the fitted parameters of the lens (``fx`` …) and of the board (``scale``, ``bend_xx`` …).
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
        """Name of the camera among an installation's lenses: that of the tool or station at which it is mounted."""
        if self.mounting == IN_HAND:
            return self.tool_names[0]
        return self.station

    @property
    def carried(self) -> tuple[str, object]:
        if self.mounting == IN_HAND:
            return "camera", self.size
        return "board", self.board

    @property
    def target(self) -> str:
        """Name of the board among an installation's boards."""
        if self.mounting == IN_HAND:
            return self.station
        return self.tool_names[0]

    def name(self, row: int) -> str:
        """Return the name of an image by its row number in the file, counted from 1; ``image 3`` if it has no name."""
        if 0 < row <= len(self.names):
            return self.names[row - 1]
        return f"image {row}"


HEADER = ("image", "corner", "u [px]", "v [px]", "sigma [px]", "edge [px]", "problem")
# Sigma assumed for corners of a file that states none [px] (our choice).
USUAL = 0.1


@dataclass(frozen=True, eq=False)
class Detection:
    """Corners detected in one image.

    Attributes:
        pixel: (K, 2) pixel of each corner of the board; NaN where not seen.
        sigma: (K,) standard deviation of each coordinate [px].
        problem: reason why the image is not usable; empty if it is usable.
        edge: median width of the edges [px]; NaN without a board.
    """

    pixel: np.ndarray
    sigma: np.ndarray
    problem: str = ""
    edge: float = float("nan")

    @property
    def seen(self) -> np.ndarray:
        """Whether each corner was detected, (K,)."""
        return ~np.isnan(self.pixel[:, 0])


@dataclass(frozen=True, eq=False)
class Detections:
    """Detected corners by image name, the images' width and height [px] (0, 0 if unknown), and remarks on the board."""

    images: dict[str, Detection]
    size: tuple[int, int] = (0, 0)
    notes: tuple[str, ...] = ()


def write_corners(path: Path, detections: Detections) -> Path:
    """Write detections as ``corners.csv``."""
    rows: list[list[object]] = [["", "", *detections.size, None, None, "size of the images"]]
    for name, detection in detections.images.items():
        if detection.problem:
            rows.append([name, None, None, None, None, detection.edge, detection.problem])
        for k in np.flatnonzero(detection.seen).tolist():
            u, v = detection.pixel[k].tolist()
            rows.append([name, k, u, v, float(detection.sigma[k]), detection.edge, ""])
    return files.write_table(path, HEADER, rows)


def read_corners(path: Path, board: Board) -> Detections:
    """Return the detections of a ``corners.csv`` for a board.

    Raises:
        MeasurementError: for corner numbers that the board does not have.
    """
    import csv

    count = len(corners(board))
    images = dict[str, Detection]()
    size = (0, 0)
    kinds = (OSError, UnicodeDecodeError, csv.Error)
    readable = refused_as(MeasurementError, kinds, "cannot be read as a table ({})", path)
    with readable, path.open(encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file, restkey="further cells", restval=""))
    for number, row in enumerate(rows, 1):
        if "further cells" in row:
            refuse_data(path, "has more cells than the header has columns: check its commas", row=number)
        cells = {}
        for heading, cell in row.items():
            key = (heading or "").split("[")[0].strip()
            cells[key] = (cell or "").strip()
        name = cells.get("image", "")
        problem = cells.get("problem", "")
        with refused_as(
            MeasurementError, (KeyError, ValueError, OverflowError), "expected image, corner, u, v ({})", path, number
        ):
            if not name and problem:
                size = int(float(cells["u"])), int(float(cells["v"]))
                continue
            if name not in images:
                no_pixels = np.full((count, 2), np.nan)
                no_sigmas = np.full(count, np.nan)
                edge = float(cells.get("edge") or "nan")
                images[name] = Detection(no_pixels, no_sigmas, problem, edge)
            if problem or not cells.get("corner"):
                continue
            k = int(cells["corner"])
            corner_pixel = float(cells["u"]), float(cells["v"])
        if not 0 <= k < count:
            refuse_data(path, f"corner {k}: the board ({board.words}) has corners 0 to {count - 1}", "corner", number)
        images[name].pixel[k] = corner_pixel
        images[name].sigma[k] = float(cells.get("sigma") or USUAL)
    return Detections(images, size)

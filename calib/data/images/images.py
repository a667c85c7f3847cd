"""Reading and writing image files as 8-bit grey levels, without EXIF rotation."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from calib.errors import MeasurementError, refused_as, require
from calib.workers.extras import needing

with needing("cv2"):
    import cv2

PNG = b"\x89PNG\r\n\x1a\n"
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".webp")


def read_image(path: Path) -> np.ndarray:
    """Return an image (height, width) as 8-bit grey.

    An EXIF orientation is ignored, since rotating the picture would rotate the camera's axes.

    Raises:
        MeasurementError: for a file that is missing, empty or damaged.
    """
    with refused_as(
        MeasurementError, (OSError, ValueError), "cannot be read as an image ({}): was it copied whole?", path
    ):
        return decode(path.read_bytes())


@contextmanager
def quiet() -> Iterator[None]:
    """Keep OpenCV from writing to the terminal within the context: this toolkit reports errors itself."""
    before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(before)


def decode(content: bytes) -> np.ndarray:
    """Return a compressed image's grey levels (height, width), 8 bits; see `read_image`.

    Raises:
        ValueError: if the content is no image.
    """
    require(content, "the file is empty", ValueError)
    # libpng would write a complaint to the terminal
    if content.startswith(PNG) and b"IEND" not in content[-64:]:
        raise ValueError("the image format is unknown, or the file is incomplete")
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    stored = np.frombuffer(content, np.uint8)
    try:
        with quiet():
            pixels = cv2.imdecode(stored, flags)
    except cv2.error as error:
        raise ValueError(str(error)) from error
    if pixels is None:
        raise ValueError("the image format is unknown, or the file is incomplete")
    return to_grey(pixels)


def to_grey(image: np.ndarray) -> np.ndarray:
    """Return any image as 8-bit grey levels (height, width); more than 8 bits are scaled to the image's range."""
    if image.ndim == 3:
        colours = np.ascontiguousarray(image[:, :, :3])
        image = cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY)
    if image.dtype == np.uint8:
        return image
    values = image.astype(np.float32)
    low, high = np.percentile(values[::7, ::7], [0.1, 99.9])
    value_range = max(float(high - low), 1e-9)
    scaled = (values - low) * (255.0 / value_range)
    return np.clip(scaled, 0, 255).astype(np.uint8)


def write_image(path: Path, image: np.ndarray) -> Path:
    """Write an image in the format of its suffix."""
    from calib import files

    success, content = cv2.imencode(path.suffix, image)
    require(success, "cannot be written as an image", MeasurementError, path)
    return files.write(path, content.tobytes())

"""Names of models, losses and files of a geometric fit; imports little, so that the command line starts fast."""

from pathlib import Path
from typing import Annotated

from calib.config_types import OneOf

MODELS = ("auto", "frames", "offsets", "geometry", "stiffness", "bending", "coupling", "harmonics", "wobble")
LOSSES = ("auto", "none", "huber", "cauchy")
IMAGES = "pixels"  # the kind of measurement that images of a board are
IN_HAND, TO_HAND = "in hand", "to hand"  # the arm carries the camera, or the board
MEASURED, IGNORED = "measured", "ignored"  # a base frame has to be in a file, or is not read
JOINTS, CORNERS, BOARD = "joints.csv", "corners.csv", "board.toml"  # files of a folder of images
MIN_SIGMA = 1e-10  # no instrument's sigma is smaller [m or rad]; our choice

Model = Annotated[str, OneOf(MODELS)]
Loss = Annotated[str, OneOf(LOSSES)]


def is_image_folder(path: Path) -> bool:
    """Return whether a path is a folder of board images (or of detected corners) with joint values."""
    return path.is_dir() and ((path / JOINTS).exists() or (path / BOARD).exists())

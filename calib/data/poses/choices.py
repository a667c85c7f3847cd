"""What a fit of the geometry may be asked for, by name; loads nothing, so that the command line starts at once."""

from typing import Annotated

from calib.config_types import OneOf

MODELS = ("auto", "frames", "offsets", "geometry", "stiffness", "bending", "coupling", "harmonics", "wobble")
LOSSES = ("auto", "none", "huber", "cauchy")
MIN_SIGMA = 1e-10  # no instrument's sigma is smaller [m or rad]; our choice

Model = Annotated[str, OneOf(MODELS)]
Loss = Annotated[str, OneOf(LOSSES)]

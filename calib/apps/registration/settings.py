"""Settings of the quick calibrations of tool, base, camera and board."""

from dataclasses import dataclass

from calib.arguments import checked
from calib.config_types import Holdout, Tolerance


@checked
@dataclass(frozen=True)
class PlacementSettings:
    """Settings of a quick calibration.

    Attributes:
        tolerance: largest rms residual [m; on the command line mm]; above it the verdict is fail
        holdout: share of the poses held out, on which the residual is judged
    """

    tolerance: Tolerance = None
    holdout: Holdout = 0.0


DEFAULT_PLACEMENT = PlacementSettings()

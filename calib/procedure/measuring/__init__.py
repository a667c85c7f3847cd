"""Measuring at selected poses: limits of poses, the measuring run, its settings, and the predicted accuracy."""

from dataclasses import dataclass
from typing import Annotated

from calib.arguments import checked
from calib.config_types import Real


@checked
@dataclass(frozen=True)
class RunSettings:
    """Settings of a measuring run: speed of the moves and dwell time at each pose.

    Attributes:
        speed: speed of the run, as a share of the joints' largest speeds.
        dwell: time at each pose to settle and measure [s].
    """

    speed: Annotated[float, Real(above=0.0, most=1.0)] = 0.3
    dwell: Annotated[float, Real(least=0.0, most=3600.0, unit="s")] = 6.0


DEFAULT_RUN = RunSettings()

"""How a measuring run is driven."""

from dataclasses import dataclass
from typing import Annotated

from calib.arguments import checked
from calib.config_types import Real


@checked
@dataclass(frozen=True)
class RunSettings:
    """How a run is driven.

    Attributes:
        speed: share of the joints' largest speeds that the run is driven at.
        dwell: seconds that each pose takes to settle and be measured.
    """

    speed: Annotated[float, Real(above=0.0, most=1.0, unit="of the joints' speeds")] = 0.3
    dwell: Annotated[float, Real(least=0.0, most=3600.0, unit="s")] = 6.0


DEFAULT_RUN = RunSettings()

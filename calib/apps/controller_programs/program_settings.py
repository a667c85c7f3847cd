"""Settings of a program of poses. This module imports little: `calib` starts fast."""

from dataclasses import dataclass
from typing import Annotated

from calib.config import strict
from calib.config_types import Real, Whole

# in place of a controller: the poses of a program as a table
CSV = "csv"


@strict
@dataclass(frozen=True)
class ProgramSettings:
    """How a program of poses moves and waits.

    Attributes:
        settle: seconds to wait at each pose before it is measured
        speed: of joint moves, percent of the fastest
        output: number of the digital output that is raised for the instrument for half a second (ABB: signal do1 …);
            without it the operator presses a key
        pulses: pulses per degree of each axis, for controllers whose programs have pulses (Yaskawa)
    """

    settle: Annotated[float, Real(least=0.0, most=600.0, words="seconds from 0 to 600")] = 2.0
    speed: Annotated[int, Whole(1, 100)] = 10
    output: Annotated[int, Whole(0, 4096)] | None = None
    pulses: tuple[float, ...] = ()

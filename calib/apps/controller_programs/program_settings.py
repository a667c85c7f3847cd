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
        pulses: pulses per degree (per mm of sliding axes) of each axis, the arm's first, for controllers whose programs
            have pulses (Yaskawa)
        external: joint that is an external axis (rail, positioner), where names and kinds do not tell; in a program
            that is read with its unit, as rail [mm]
        external_group: FANUC, Yaskawa: group of the external axes: 1, the arm's (E1; base axis), or 2, their own (GP2;
            station); by default 2, but 1 for a Yaskawa's sliding axes
    """

    settle: Annotated[float, Real(least=0.0, most=600.0, words="seconds from 0 to 600")] = 2.0
    speed: Annotated[int, Whole(1, 100)] = 10
    output: Annotated[int, Whole(0, 4096)] | None = None
    pulses: tuple[float, ...] = ()
    external: tuple[str, ...] = ()
    external_group: Annotated[int, Whole(1, 2)] | None = None

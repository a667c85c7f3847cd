"""Settings of the comparison of two calibrations, and of drift."""

from dataclasses import dataclass

from calib.arguments import checked
from calib.config_types import Flag, Positive, Seed, Text, Tolerance


@checked
@dataclass(frozen=True)
class DiffSettings:
    """Settings of a comparison of two calibrations.

    Attributes:
        tolerance: largest rms error [m; on the command line mm] of the robot today with the earlier parameters; above
            it the verdict is fail. Default: that of the later fit or session, else of the earlier one
        torque_tolerance: largest share [%] that the earlier model leaves unexplained of the torques measured for the
            later one; above it the verdict is fail. Default: that of the later session, else of the earlier one
        motions: tables of further motions (q, v, a), over which the change of the torque is stated
        same_base: robot and instrument stood in the same places at both visits: a change of the base placement counts
        same_tool: the same target on the same mount: a change of the tool placement counts
        seed: of the random poses
    """

    tolerance: Tolerance = None
    torque_tolerance: Positive | None = None
    motions: tuple[Text, ...] = ()
    same_base: Flag = False
    same_tool: Flag = False
    seed: Seed = 0


DEFAULT_DIFF = DiffSettings()


@checked
@dataclass(frozen=True)
class DriftSettings:
    """Settings of a study of drift.

    Attributes:
        tolerance: way of the target over the whole measurement [m; on the command line mm] above which it is beyond
            need. Default: how far noise of sigma lets two readings differ; without a sigma, none
        sigma: of one measured position, per axis [m; on the command line mm]
    """

    tolerance: Tolerance = None
    sigma: Tolerance = None


DEFAULT_DRIFT = DriftSettings()

"""Results held against measurements they have not seen."""

from collections.abc import Sequence
from typing import Any, overload

from calib.api.dynamic import DynamicsModel, Recorded
from calib.api.given import listed
from calib.api.kinematic import GeometryFit, Measured, Several
from calib.arguments import checked
from calib.errors import UsageError, require
from calib.procedure.dynamic_stage import identify as arm_identify
from calib.procedure.kinematic_stage import fit as arm_fit
from calib.procedure.kinematic_stage import inputs as measured
from calib.procedure.robot_kinds import MechanismResult


@overload
def validate(result: GeometryFit, unseen: Several) -> GeometryFit: ...
@overload
def validate(result: DynamicsModel, unseen: Recorded | Sequence[Recorded]) -> DynamicsModel: ...
@overload
def validate(result: MechanismResult, unseen: Any) -> Any: ...
@checked
def validate(
    result: GeometryFit | DynamicsModel | MechanismResult,
    unseen: Measured | Recorded | Sequence[Measured | Recorded | Sequence[Measured]],
) -> Any:
    """Hold a result against poses or motion it has not seen, and judge it anew.

    Args:
        result: a fit or an identification; nothing is fitted again.
        unseen: measurements or recordings, files or in memory, beside those it was judged on before.

    Returns:
        The same result with the errors on all unseen rows and the verdict that follows.

    Raises:
        MeasurementError: for files that cannot be right, naming row and column.
    """
    given = listed(unseen)
    require(given, "validate: unseen: nothing is given to validate on", UsageError)
    if isinstance(result, GeometryFit):
        return arm_fit.assessed(result, measured.with_unseen(result.inputs, given, result.options, result.settings))
    if not isinstance(result, DynamicsModel):
        return result.with_unseen(given)
    return arm_identify.assessed(result, result.inputs.with_unseen(given))

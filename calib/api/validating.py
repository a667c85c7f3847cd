"""Results held against measurements they have not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, overload

from calib.api.dynamic import DynamicsModel, Recorded
from calib.api.kinematic import GeometryFit, Measured
from calib.api.reading import listed
from calib.arguments import checked
from calib.procedure.dynamic_stage import identify
from calib.procedure.dynamic_stage import inputs as recorded
from calib.procedure.kinematic_stage import fit
from calib.procedure.kinematic_stage import inputs as measured


@overload
def validate(result: GeometryFit, unseen: Measured | Sequence[Measured]) -> GeometryFit: ...
@overload
def validate(result: DynamicsModel, unseen: Recorded | Sequence[Recorded]) -> DynamicsModel: ...
@checked
def validate(result: GeometryFit | DynamicsModel, unseen: Measured | Recorded | Sequence[Measured | Recorded]) -> Any:
    """Hold a result against poses or motion it has not seen, and judge it anew.

    Args:
        result: a fit or an identification; nothing is fitted again.
        unseen: measurements or recordings, files or in memory, beside those it was judged on before.

    Returns:
        The same result with the errors on all unseen rows and the verdict that follows.

    Raises:
        MeasurementError: for files that cannot be right, naming row and column.
    """
    if isinstance(result, GeometryFit):
        given = measured.with_unseen(result.outcome.inputs, listed(unseen), result.options, result.settings)
        return replace(result, outcome=fit.assessed(result.outcome, given, result.options, result.settings))
    more = recorded.with_unseen(result.outcome.inputs, listed(unseen))
    return replace(result, outcome=identify.assessed(result.outcome, more))

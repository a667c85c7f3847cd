"""Check where a verb's results go, before any work is done, for serial arms and other robots alike."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal


def check_destination(
    verb: Literal["fit", "identify", "excite", "plan"],
    robot: object,
    out: Path,
    inputs: Sequence[str | Path | None] = (),
) -> None:
    """Refuse, before any work is done, a folder that is not for what `verb` writes of a robot, or holds its inputs.

    Args:
        robot: a serial arm or another robot, as a person names it.
        out: where results are to go.
        inputs: what is read; none of it is written over.

    Raises:
        UsageError: with the file or folder concerned.
    """
    from calib.procedure.robot_kinds import stage_of

    if (stage := stage_of(robot, verb)) is not None:
        check = stage.check
    elif verb == "fit":
        from calib.procedure.kinematic_stage.folder import check_fit_target as check
    elif verb == "identify":
        from calib.procedure.dynamic_stage.folder import check_identification_target as check
    elif verb == "excite":
        from calib.procedure.excitation.folder import check_design_target as check
    else:
        from calib.procedure.excitation.folder import check_plan_target as check
    check(out, inputs)

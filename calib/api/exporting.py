"""What leaves the toolkit: calibrated geometry and identified dynamics in the forms other programs read."""

import warnings
from pathlib import Path

from calib.api.dynamic import DynamicsModel
from calib.api.given import optional, saved
from calib.api.kinematic import GeometryFit
from calib.arguments import checked
from calib.errors import CalibWarning, RobotError, UsageError, refused_as
from calib.procedure.export import delivery, geometry
from calib.procedure.export.identified import is_identified
from calib.procedure.robot_kinds import MechanismResult, stage_of
from calib.robot.load import resolve


@checked
def export(
    result: GeometryFit | DynamicsModel | MechanismResult | str | Path,
    into: str | Path,
    *,
    urdf: str | Path | None = None,
    prior: str = "entropic",
) -> tuple[str, ...]:
    """Write a calibrated robot, with its dynamics where they were identified, for other programs.

    Of a fit: robot.urdf, joint_offsets.csv, ur_kinematics.yaml of a UR arm, joint corrections where there are any. Of
    an identification also masses and friction, as URDF, MJCF, drives.csv and parameters.json. Each file is read back by
    an independent reader before it is put in place. A result whose verdict is no pass is exported with a warning that
    says why, which stands in the URDFs and a README.txt, too.

    Args:
        result: a fit, an identification, or the folder of one.
        into: folder for the files.
        urdf: description of the nominal robot to edit, everything else in it kept; by default the fit's own source.
        prior: what masses that the torques do not identify are regularised towards, ``entropic`` or ``euclidean``.

    Returns:
        What was written and what to know of it, in words.

    Raises:
        RobotError: where a file does not read back as the robot; it is not written.
    """
    into = Path(into)
    with saved(result) as place:
        stage_of(place, "export")
        source = optional(urdf)
        if is_identified(place):
            wanted = delivery.Export(source, identified=place, prior=prior)
        else:
            wanted = delivery.Export(source or _source_of(place), place)
        delivery.check_into(wanted, into, place)
        lines = delivery.deliver(wanted, into)
        judged = delivery.mark(into, delivery.verdicts(place))
    for words in judged:
        warnings.warn(words, CalibWarning, stacklevel=3)
    return (*judged, *lines)


def _source_of(place: Path) -> Path:
    """Return the description that a fit's folder says it was made from."""
    source = geometry.read(place).source
    with refused_as(
        UsageError, RobotError, f"{place} was fitted from {source}, which is not there: name its URDF (urdf)"
    ):
        return resolve(source)

"""Joint commands for nominal targets, in Python: `calib.compensate`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib import files
from calib.apps.compensation import joint_commands
from calib.arguments import checked
from calib.errors import CalibError
from calib.records import as_subclass
from calib.toolkit.pose_data import Targets, read_targets
from calib.toolkit.result_folders import GeometryFit, Progress, Shown, joints_of, saved, stage_of


class JointCommands(Shown, joint_commands.Commands):
    """Joint commands that move the real tool to nominal targets.

    ``print`` shows which targets are reached, and the errors.
    """

    tab = "q reached reason left before sigma expected beyond notes save"

    @checked
    def save(self, path: str | Path, *, partial: bool = False, overwrite: bool = False) -> Path:
        """Write the joint commands as CSV and return its path.

        Args:
            path: the CSV file.
            partial: also write the commands if some targets are not reached.
            overwrite: also replace a file that no earlier run of calib wrote, or that was edited since.
        """
        with files.results([(Path(path), (".csv",))], overwrite=overwrite):
            return joint_commands.write(self, Path(path), partial)

    def __repr__(self) -> str:
        return f"<JointCommands: {int(self.reached.sum())} of {len(self.q)} targets reached>"

    def __str__(self) -> str:
        return "\n".join(joint_commands.lines(self))


def read_fitted(folder: str | Path) -> joint_commands.Fitted:
    """Return the fitted arm with its instrument placements and tools from a fit's folder.

    Raises:
        UsageError: the folder has no fit, an incomplete one, or the fit of a parallel robot.
    """
    try:
        return joint_commands.read(folder)
    except CalibError:  # looked at again only where reading failed
        stage_of(folder, "compensation")
        raise


@checked
def compensate(
    fitted: GeometryFit | joint_commands.Fitted | str | Path,
    targets: Targets | str | Path | np.ndarray,
    *,
    frame: str = "base",
    tool: str = "flange",
    dof: int | None = None,
    start: Sequence[float] | None = None,
    tolerance: tuple[float, float] = joint_commands.TOLERANCE,
    payload: float | Sequence[float] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> JointCommands:
    """Compute the joint commands that move the real tool to nominal targets.

    Args:
        fitted: a fit, its folder, or the result of `read_fitted`.
        targets: CSV file (``calib formats targets``), targets in memory, or an array: poses (m, 4, 4) [m], or nominal
            joint values (m, n) [rad or m].
        frame: frame of the targets: ``base`` of the calibrated robot, ``nominal``, or a station's name.
        tool: what is at the targets: ``flange``, a tool of the fit, or ``x,y,z[,roll,pitch,yaw]`` [m, rad].
        dof: pose components that count: 6; 5, free to turn about the tool's z; 3, position only; None: all that the
            targets give and the arm can reach.
        start: (n,) joint values [rad or m] near which targets without joints are sought; None: the middle of the
            limits.
        tolerance: largest accepted position [m] and orientation [rad] residual at a target, by the calibrated model.
        payload: mass that the tip carries [kg], or mass and its centre x, y, z in the tip's frame [m]; None: what the
            arm carried in the fit.
        seed: seed of the starts for targets without joints.
        progress: called with a short text as the computation proceeds; None for no report.

    Raises:
        UsageError: an unknown frame or tool, an invalid tolerance, or a start beyond the limits.
    """
    if isinstance(fitted, joint_commands.Fitted):
        calibrated = fitted
    else:
        with saved(fitted) as path:
            calibrated = read_fitted(path)
    chain = calibrated.nominal.chain
    if isinstance(targets, str | Path):
        targets = read_targets(targets, joints_of(chain))
    commands = joint_commands.computed(
        calibrated.carrying(payload),
        Targets.of(targets),
        frame=frame,
        tool=tool,
        dof=dof,
        start=start,
        tolerance=tolerance,
        seed=seed,
        progress=progress,
    )
    return as_subclass(commands, JointCommands)

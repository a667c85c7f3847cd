"""Command for joint commands that reach nominal targets: compensate."""

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.shared import Out, Seed, command, numbers, progress, say

app = typer.Typer()


@command(app, "Motion")
def compensate(
    folder: Annotated[Path, typer.Argument(metavar="FIT")],
    targets: Path,
    out: Out,
    frame: str = "base",
    tool: str = "flange",
    dof: int | None = None,
    start: str | None = None,
    tolerance: Annotated[str, typer.Option(metavar="MM,MRAD")] = "0.001,0.01",
    partial: bool = False,
    overwrite: bool = False,
    seed: Seed = 0,
) -> None:
    """Compute joint commands that move the real tool to targets.

    Targets of a workpiece that the instrument has measured: --frame STATION (the file's name, see the fit's report).

    Targets taught with the robot, or commands that are to change least: --frame nominal.

    Targets of an offline model of the cell, which stand in the robot's base: --frame base.

    Example: calib compensate fit w.csv --out sent.csv

    Args:
        folder: the folder of a fit, or of a session with a fit
        targets: CSV of nominal joints or tool poses: calib formats targets
        out: CSV file of joint commands
        frame: frame of the targets: base (of the calibrated robot), nominal, or a station
        tool: what is placed at the targets: flange, a tool of the fit, or x,y,z[,roll,pitch,yaw] [m, rad]
        dof: constrained degrees: 6; 5, free about the tool's z axis; 3, position only
        start: q1,...,qn [rad, m] initial guess for targets without joints
        tolerance: largest error of a command by the calibrated model
        partial: write the reached targets even if others are not reached
    """
    from calib.files import check_results
    from calib.procedure.export.geometry import results
    from calib.rooms.compensation import api

    may = numbers(tolerance, 2, "--tolerance")
    fitted = api.read_fitted(folder)
    check_results([(out, (".csv",))], [targets, *results(fitted.folder)], overwrite)
    with progress() as show:
        found = api.compensate(
            fitted, targets, frame=frame, tool=tool, dof=dof, tolerance=(1e-3 * may[0], 1e-3 * may[1]), seed=seed,
            start=numbers(start, fitted.nominal.chain.n, "--start") if start else None, progress=show,
        )  # fmt: skip
    found.save(out, partial=partial, overwrite=overwrite)
    say(str(found))
    say(f"{int(found.reached.sum())} of {len(found.q)} commands written to {out}")

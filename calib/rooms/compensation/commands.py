"""Command for joint commands that reach nominal targets: compensate."""

from pathlib import Path
from typing import Annotated, Any

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
    controller: str = "",
    partial: bool = False,
    overwrite: bool = False,
    seed: Seed = 0,
) -> None:
    """Compute joint commands that move the real tool to targets.

    Targets of a workpiece that the instrument has measured: --frame STATION (the file's name, see the fit's report).

    Targets taught with the robot, or commands that are to change least: --frame nominal.

    Targets of an offline model of the cell, which stand in the robot's base: --frame base.

    Targets inside a program (KRL, RAPID, FANUC .ls, URScript) are rewritten there, all else stays as it is.

    Example: calib compensate fit w.csv --out sent.csv

    Args:
        folder: the folder of a fit, or of a session with a fit
        targets: CSV of nominal joints or tool poses, or a program: calib formats targets
        out: CSV file of joint commands, or the program with new targets
        frame: frame of the targets: base (of the calibrated robot), nominal, or a station
        tool: what is placed at the targets: flange, a tool of the fit, or x,y,z[,roll,pitch,yaw] [m, rad]
        dof: constrained degrees: 6; 5, free about the tool's z axis; 3, position only
        start: q1,...,qn [rad, m] initial guess for targets without joints
        tolerance: largest error of a command by the calibrated model
        controller: whose program it is, if not as its suffix says: calib program --list
        partial: write the reached targets even if others are not reached
    """
    from calib import files
    from calib.errors import UsageError
    from calib.procedure.export.geometry import results
    from calib.rooms.compensation import api
    from calib.rooms.compensation.programs import compensated
    from calib.rooms.controllers.targets import is_program, read_program

    may = numbers(tolerance, 2, "--tolerance")
    fitted = api.read_fitted(folder)
    whole = read_program(targets, controller) if controller or is_program(targets) else None
    if whole is not None and targets.suffix.lower() in whole.controller.saved:
        words = (
            "lists registers that the controller saved, no program: compensate the program, or calib program --for csv"
        )
        raise UsageError(f"{targets}: {words}")
    written = [(out, (".csv",) if whole is None else (targets.suffix,))]
    files.check_results(written, [targets, *results(fitted.folder)], overwrite)
    asked: dict[str, Any] = {
        "frame": frame, "tool": tool, "dof": dof, "tolerance": (1e-3 * may[0], 1e-3 * may[1]), "seed": seed,
        "start": numbers(start, fitted.nominal.chain.n, "--start") if start else None,
    }  # fmt: skip
    with progress() as show:
        if whole is not None:
            made = compensated(fitted, whole, **asked, progress=show)
            with files.results(written, overwrite=overwrite):
                made.write(out, partial)
            say(*made.lines(), f"{len(made.values) - len(made.lost)} of {len(made.values)} targets written to {out}")
            return
        found = api.compensate(fitted, targets, **asked, progress=show)
    found.save(out, partial=partial, overwrite=overwrite)
    say(str(found))
    say(f"{int(found.reached.sum())} of {len(found.q)} commands written to {out}")

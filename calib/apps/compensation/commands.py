"""Command for joint commands that reach nominal targets: compensate."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli.shared import Out, Seed, command, numbers, progress, say

if TYPE_CHECKING:
    from calib.records import FieldValues

app = typer.Typer()


@command(app, "Motion")
def compensate(
    folder: Annotated[Path, typer.Argument(metavar="FIT")],
    targets: Path,
    out: Out,
    frame: str = "base",
    tool: str | None = None,
    user_frame: str | None = None,
    frames: list[Path] | None = None,
    world: str | None = None,
    flange: str | None = None,
    dof: int | None = None,
    start: str | None = None,
    tolerance: Annotated[str, typer.Option(metavar="MM,MRAD")] = "0.001,0.01",
    controller: str = "",
    external: list[str] | None = None,
    pulses: Annotated[str | None, typer.Option("--pulse", metavar="NUMBERS")] = None,
    payload: str | None = None,
    partial: bool = False,
    overwrite: bool = False,
    seed: Seed = 0,
) -> None:
    """Compute joint commands that move the real tool to targets.

    Targets of a workpiece that the instrument has measured: --frame STATION (the file's name, see the fit's report).

    Targets taught with the robot, or commands that are to change least: --frame nominal.

    Targets of an offline model of the cell, which stand in the robot's base: --frame base.

    Targets inside a program (KRL, RAPID, FANUC .ls, URScript) are rewritten there, all else stays as it is. Tools, user
    frames and configurations of its poses are read from it; what it does not say is stated, or it is refused.

    Example: calib compensate fit w.csv --out sent.csv

    Args:
        folder: the folder of a fit, or of a session with a fit
        targets: CSV of nominal joints or tool poses, or a program: calib formats targets
        out: CSV file of joint commands, or the program with new targets
        frame: frame of the targets: base (of the calibrated robot), nominal, or a station
        tool: what is placed at the targets: flange (default of a CSV), a tool of the fit, or x,y,z[,roll,pitch,yaw] [m,
            rad]; of a program in the controller's flange, where the program does not say it
        user_frame: program: x,y,z[,roll,pitch,yaw] [m, rad] of its user frame in the controller's base, if not in it
        frames: program: file with numbers of its tools and user frames (SYSFRAME.VA, $config.dat, a module); repeatable
        world: program: pose of the controller's base frame in the arm's, if the URDF does not say it (calib deliver)
        flange: program: the same of the controller's flange in the arm's tip
        dof: constrained degrees: 6; 5, free about the tool's z axis; 3, position only
        start: q1,...,qn [rad, m] initial guess for targets without joints
        tolerance: largest error of a command by the calibrated model
        controller: whose program it is, if not as its suffix says: calib program --list
        external: program: joint that is an external axis, where names and kinds do not tell; repeatable
        pulses: program: pulses per degree or mm of each axis, the arm's first (Yaskawa)
        payload: mass[,x,y,z] [kg, m] at the tip and its centre; default: what the arm carried in the fit
        partial: write the reached targets even if others are not reached
    """
    from calib import files
    from calib.apps.compensation import api
    from calib.apps.compensation.program_frames import Statements
    from calib.apps.compensation.programs import compensated
    from calib.apps.controller_programs.frames import stated_frame
    from calib.apps.controller_programs.targets import is_program, read_program, text_of
    from calib.errors import UsageError
    from calib.toolkit.result_folders import geometry_results

    position_mm, turn_mrad = numbers(tolerance, 2, "--tolerance")
    fitted = api.read_fitted(folder)
    if payload:
        count = 4 if "," in payload else 1
        fitted = fitted.carrying(numbers(payload, count, "--payload", "a mass [kg], or mass,x,y,z [kg, m]"))
    program = None
    suffix = ".csv"
    if controller or is_program(targets):
        counts = numbers(pulses, fitted.nominal.chain.n, "--pulse") if pulses else ()
        program = read_program(targets, controller, fitted.nominal.chain.joints, external or (), counts)
        suffix = targets.suffix
    if program is not None and targets.suffix.lower() in program.controller.saved:
        message = "contains saved registers, not a program: compensate the program, or use calib program --for csv"
        raise UsageError(f"{targets}: {message}")
    written = [(out, (suffix,))]
    files.check_results(written, [targets, *geometry_results(fitted.folder)], overwrite)
    start_q = None
    if start:
        start_q = numbers(start, fitted.nominal.chain.n, "--start")
    options: FieldValues = {
        "frame": frame,
        "dof": dof,
        "tolerance": (1e-3 * position_mm, 1e-3 * turn_mrad),
        "seed": seed,
        "start": start_q,
    }
    if program is None and (user_frame or frames or world or flange):
        raise UsageError(
            "--user-frame, --frames, --world and --flange are for programs; the frame of a CSV is stated by --frame"
        )
    with progress() as show:
        if program is not None:
            texts = {str(path): text_of(path) for path in frames or ()}
            poses = stated_frame(world, "--world"), stated_frame(flange, "--flange")
            statements = Statements(tool, user_frame, *poses, texts)
            compensated_program = compensated(fitted, program, **options, statements=statements, progress=show)
            with files.results(written, overwrite=overwrite):
                compensated_program.write(out, partial)
            count = len(compensated_program.values)
            reached = count - len(compensated_program.lost)
            say(*compensated_program.lines(), f"{reached} of {count} targets written to {out}")
            return
        result = api.compensate(fitted, targets, tool=tool or "flange", **options, progress=show)
    result.save(out, partial=partial, overwrite=overwrite)
    say(str(result))
    say(f"{int(result.reached.sum())} of {len(result.q)} commands written to {out}")

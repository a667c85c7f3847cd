"""Commands for controllers: program, deliver."""

from pathlib import Path
from typing import Annotated

import typer

from calib.apps.controller_programs.program_settings import CSV, ProgramSettings
from calib.cli.shared import command, say

app = typer.Typer()


@command(app, "Geometry")
def program(
    settings: ProgramSettings,
    poses: Annotated[Path | None, typer.Argument()] = None,
    controller: Annotated[str, typer.Option("--for", metavar="NAME")] = "",
    source: Annotated[str, typer.Option("--from", metavar="NAME")] = "",
    out: Path | None = None,
    overwrite: bool = False,
    listed: Annotated[bool, typer.Option("--list")] = False,
) -> None:
    """Write a program that drives the poses of a list, and waits at each for the measurement.

    A program that was edited by hand is read back with --for csv.

    Example: calib program poses.csv --for krl

    Args:
        poses: CSV of poses to drive, a motion or its folder (UR, KUKA RSI, ABB EGM), or a program of poses
        controller: the robot's controller; csv: the poses as a table; --list shows all
        source: the controller of a program that is read, if its suffix does not say it
        out: file of the program; by default beside the poses
        listed: list controllers, with what each can be told of a calibration
    """
    from calib import files
    from calib.apps.controller_programs.motion_streams import motion_file
    from calib.apps.controller_programs.program import program_files
    from calib.apps.controller_programs.targets import is_program, read_program
    from calib.errors import UsageError
    from calib.toolkit.chains import controllers

    if listed:
        for name, row in controllers().items():
            file_names = ", ".join(pattern.format(name="NAME") for pattern in row.files.values())
            say(f"{name}: {row.title}, {file_names}", result=True)
            say(f"    takes: {row.takes}", f"    closed: {row.closed}", f"    checked by: {row.checked}", result=True)
        return
    if poses is None or not controller:
        names = ", ".join((*controllers(), CSV))
        raise UsageError(f"give a list of poses and its controller: --for {names}")
    poses = motion_file(poses)
    # by default beside the poses
    if out is None and controller == CSV:
        out = poses.with_suffix(".csv")
    elif out is None:
        out = poses.with_name(poses.name.partition(".")[0])
    texts = program_files(poses, out, controller, settings, source)
    if source or is_program(poses):
        program = read_program(poses, source, None, settings.external, settings.pulses)
        remarks = [remark for remark in (*program.notes, program.unread) if remark]
        say(*remarks)
    with files.results([(path, ()) for path in texts], [poses], overwrite):
        written = [files.write(path, text) for path, text in texts.items()]
        say(*(f"written to {path}" for path in written))


@command(app, "Geometry")
def deliver(
    folder: Annotated[Path, typer.Argument(metavar="FIT")],
    controller: Annotated[str, typer.Option("--for", metavar="NAME")],
    world: Annotated[str | None, typer.Option(metavar="POSE")] = None,
    flange: Annotated[str | None, typer.Option(metavar="POSE")] = None,
    external: list[str] | None = None,
    out: Path | None = None,
    overwrite: bool = False,
) -> None:
    """State a calibration in a controller's words: tool and base frames, mastering offsets, what it cannot take.

    Frames stand in the controller's base and flange: World of a FANUC at the height of axis 2, Base of a UR turned by
    180°. The URDF's links base and tool0 say where; where nothing says it, state it.

    Example: calib deliver fit --for krl

    Args:
        folder: the folder of a fit, or of a session with a fit
        controller: the robot's controller: calib program --list
        world: x,y,z[,roll,pitch,yaw] [m, rad] of the controller's base frame in the arm's, if the URDF does not say it
        flange: the same of the controller's flange (its all-zero tool) in the arm's tip
        external: joint that is an external axis (rail, positioner), where names and kinds do not tell; repeatable
        out: text file; by default it is printed
    """
    from calib import files
    from calib.apps.controller_programs.delivery import delivery_text
    from calib.apps.controller_programs.frames import stated_frame
    from calib.toolkit.chains import controller_named
    from calib.toolkit.result_folders import geometry_results

    statements = stated_frame(world, "--world"), stated_frame(flange, "--flange")
    text = delivery_text(folder, controller_named(controller), *statements, external or ())
    if out is None:
        say(text, result=True)
        return
    with files.results([(out, (".txt",))], geometry_results(folder), overwrite):
        say(f"written to {files.write(out, text)}")

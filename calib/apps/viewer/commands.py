"""Command that shows a folder's results in Rerun: view."""

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.shared import command, say
from calib.errors import UsageError, command_line, require

app = typer.Typer()


@command(app, "Files and studies")
def view(
    folder: Path,
    save: Path | None = None,
    spawn: Annotated[bool | None, typer.Option("--spawn/--no-spawn")] = None,
    robot: str | None = None,
    overwrite: bool = False,
) -> None:
    """Show robot, errors, poses, motions or torques in Rerun.

    Example: calib view fit

    Args:
        folder: of a fit, a session, an identification, a motion; or a CSV
        save: write a Rerun recording (.rrd), and open no window
        spawn: open Rerun's window; by default where nothing is saved
        robot: the robot to draw, where the folder does not say
    """
    from calib.apps.viewer import viewer
    from calib.files import results

    require(folder.exists(), f"{folder}: no such folder or CSV: check the path", UsageError)
    if save is None and spawn is False:
        raise UsageError("nothing to do: give --save FILE.rrd, or omit --no-spawn")
    scene = None
    if save:
        inputs = [folder, robot]
        if folder.is_dir():
            inputs += [path for path in folder.iterdir() if path.suffix != ".rrd"]
        with results([(save, (".rrd",))], inputs, overwrite):
            scene = viewer.write(folder, save, robot)
        size = f"{1e-6 * save.stat().st_size:.1f} MB"
        say(f"{save}: {size}; {command_line(save, program='rerun')} shows it")
    if spawn or (spawn is None and save is None):
        scene = viewer.spawn(folder, robot)
    if scene is not None:
        for note in scene.notes:
            say(f"note: {note}")

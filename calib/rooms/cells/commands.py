"""Command for a calibration of a simulated robot: demo."""

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.completion import robots
from calib.cli.shared import Seed, command, exit_failed, reporting
from calib.errors import command_line

app = typer.Typer()


@command(app, "Start")
def demo(
    out: Path = Path("calib-demo"),
    robot: Annotated[str, typer.Option(autocompletion=robots)] = "lwr4plus",
    geometry_only: bool = False,
    instrument: str = "cmm",
    guided: bool = False,
    bring: Path | None = None,
    seed: Seed = 0,
    plots: bool = True,
) -> None:
    """Calibrate a simulated robot; compare with the hidden truth.

    Example: calib demo --out calib-demo

    Args:
        out: folder of the session
        robot: a robot of the library
        geometry_only: calibrate the geometry only, not the dynamics
        instrument: cmm, or camera: rendered images of a board
        guided: stop at each step that an engineer performs
        bring: session folder: simulate the files that it waits for
    """
    from calib.rooms.cells import demo as demonstration

    with reporting() as (say, progress):
        if bring is not None:
            demonstration.simulate_next(bring, say)
            return
        found = demonstration.run(
            out, robot, seed, say, progress, dynamics=not geometry_only, guided=guided, plots=plots,
            instrument=instrument,
        )  # fmt: skip
    say("", *found.asks)
    if found.results:
        say(f"{found.seconds:.1f} s, {found.memory:.0f} MB. Look at")
    for words, name in found.results:
        place, folder = found.session.folder / name, found.session.folder
        how = f"  ({command_line(place, program='rerun')}, or {command_line('view', folder)})"
        say(f"{words:15} {place}{how if words == 'to play' else ''}")
    exit_failed(found.verdict)

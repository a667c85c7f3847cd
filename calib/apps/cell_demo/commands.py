"""Command for a calibration of a simulated robot: demo."""

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.completion import robots
from calib.cli.shared import Seed, command, exit_failed, reporting
from calib.config_types import Plots
from calib.errors import UsageError

app = typer.Typer()


@command(app, "Start")
def demo(
    out: Path = Path("calib-demo"),
    robot: Annotated[str, typer.Option(autocompletion=robots)] = "",
    hard: bool = False,
    geometry_only: bool = False,
    instrument: str = "cmm",
    guided: bool = False,
    bring: Path | None = None,
    payload: Annotated[list[str] | None, typer.Option()] = None,
    seed: Seed = 0,
    plots: Plots = True,
    verbose: bool = False,
) -> None:
    """Calibrate a simulated robot; compare with the hidden truth.

    Example: calib demo --out calib-demo

    Args:
        out: folder of the session
        robot: a robot of the library; default tx40
        hard: the LWR4+, whose hidden errors no model explains well: ends marginal, and says what that means
        geometry_only: calibrate the geometry only, not the dynamics
        instrument: cmm, or camera: rendered images of a board
        guided: stop at each step that an engineer performs
        bring: session folder: simulate the files that it waits for
        payload: label=kg of a payload, with which the motions are played again; as of calib new; repeatable
    """
    from calib.apps.cell_demo import demo as demonstration
    from calib.apps.cell_demo.step_lines import paths, reasons

    with reporting() as (say, progress):
        if bring is not None:
            demonstration.simulate_next(bring, say)
            return
        if hard and robot:
            raise UsageError(f"--robot {robot} and --hard both name a robot: leave one out")
        if hard:
            robot = demonstration.HARD
        result = demonstration.run(
            out,
            robot or demonstration.ROBOT,
            seed,
            say,
            progress,
            dynamics=not geometry_only,
            guided=guided,
            plots=plots,
            instrument=instrument,
            payloads=payload or (),
            verbose=verbose,
        )
    if result.asks:
        say("", *result.asks)
        return
    say(demonstration.row("time", result.seconds, "s"), *reasons(result.session))
    say("", *paths(result.session))
    exit_failed(result.verdict)

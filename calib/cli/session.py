"""The guided session: new, next, status, redo, demo; and formats."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.shared import Base, Seed, Tip, make_console, told

app = typer.Typer()

Folder = Annotated[Path, typer.Argument(help="the session's folder")]


@app.command()
def new(
    folder: Folder,
    robot: Annotated[str, typer.Option(help="a .urdf, an MDH .toml, a library name, or the folder of an earlier fit")],
    instrument: Annotated[str, typer.Option(help="cmm, tracker, tracker6d, mocap, camera, other-pose, other-position")],
    poses: Annotated[int, typer.Option(help="poses to choose for the fit")] = 40,
    validation: Annotated[int, typer.Option(help="poses to measure and never fit; 0 for none")] = 20,
    base: Base = "",
    tip: Tip = "",
    seed: Seed = 0,
) -> None:
    """Make a session FOLDER: calibrate a robot step by step, with a certificate at the end.

    What is to be measured goes into FOLDER/3-measured as CSV (calib formats measurements); how the session goes on is
    said in FOLDER/session.toml (calib formats session).
    """
    from calib.procedure import guided

    made = guided.begin(
        folder, robot, instrument, poses=poses, validation=validation, base=base or "", tip=tip or "", seed=seed
    )
    make_console().print(f"made {made.folder}; next: calib next {made.folder}", soft_wrap=True, markup=False)


@app.command()
def formats(
    topic: Annotated[
        str | None,
        typer.Argument(help="measurements, targets, options, constraints, mdh, robot, session or recordings"),
    ] = None,
) -> None:
    """Print what the files of this toolkit hold: columns, keys, units."""
    from calib.procedure import formats as documents

    print(documents.describe(topic) if topic else "\n".join(documents.overview()))


@app.command("next")
def next_step(folder: Folder) -> None:
    """Do what can be done in a session, then say what to do at the robot."""
    _go_on(folder, f"calib next {folder}")


@app.command()
def redo(
    folder: Folder,
    step: Annotated[str, typer.Argument(help="describe, select, measure, fit, validate, export, certificate")],
) -> None:
    """Make a step of a session again, and all that rests on it."""
    _go_on(folder, f"calib redo {folder} {step}", step)


@app.command()
def status(folder: Folder) -> None:
    """Show how far a session is, and what is stale because something changed."""
    from calib.procedure import guided

    console = make_console()
    for renderable in guided.status_lines(folder):
        console.print(renderable, soft_wrap=True)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="the session's folder")] = Path("calib-demo"),
    robot: Annotated[str, typer.Option(help="a robot of the library")] = "lwr4plus",
    geometry_only: Annotated[bool, typer.Option("--geometry-only", help="leave the dynamics out")] = False,
    guided: Annotated[bool, typer.Option("--guided", help="stop where an engineer would")] = False,
    bring: Annotated[Path | None, typer.Option(help="let the simulated cell bring what this session waits for")] = None,
    seed: Seed = 0,
) -> None:
    """Calibrate a simulated robot with simulated instruments, and compare with the hidden truth."""
    from calib.procedure import demo as demonstration

    with told() as (console, say, progress):
        if bring is not None:
            demonstration.bring_what_waits(bring, say)
            say(f"next: calib next {bring}")
            return
        found = demonstration.run(
            out, robot, seed, say, progress, dynamics=not geometry_only, guided=guided,
        )  # fmt: skip
    for line in ("", *found.asks):
        console.print(line, soft_wrap=True, markup=False)
    if found.results:
        console.print(f"{found.seconds:.1f} s, {found.memory:.0f} MB. Look at", soft_wrap=True, markup=False)
    for words, name in found.results:
        console.print(f"  {words:15} {found.session.folder / name}", soft_wrap=True, markup=False)
    if found.verdict == "fail":
        raise typer.Exit(1)


def _go_on(folder: Path, command: str, again: str = "") -> None:
    from calib.procedure import guided

    with told() as (console, say, progress):
        stop = guided.go_on(folder, say, progress, command, again)
    for line in stop.lines:
        console.print(line, soft_wrap=True, markup=False)
    if stop.verdict == "fail":
        raise typer.Exit(1)

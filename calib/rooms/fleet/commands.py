"""Command for many sessions: run."""

from pathlib import Path

import typer

from calib.cli.shared import command, reporting

app = typer.Typer()


@command(app, "Files and studies")
def run(sessions: list[Path], workers: str = "1", plots: bool = True) -> None:
    """Run many SESSIONS, one folder per robot, as far as possible. A table at the end shows their states.

    A robot that fails does not stop the others; see its folder's run.log. The exit code is the worst of all.

    Example: calib run cell1 cell2 --workers 2

    Args:
        sessions: session.toml files, or the sessions' folders
    """
    import time

    from calib.rooms.fleet import fleet

    folders, started, outcomes = fleet.folders_of(sessions), time.perf_counter(), []
    with reporting() as (say, progress):
        progress(f"running {len(folders)} sessions")
        for outcome in fleet.run_sessions(
            folders, workers=workers, plots=plots, command=f"calib run --workers {workers}"
        ):
            outcomes.append(outcome)
            say(outcome.line())
            progress(f"{len(outcomes)} of {len(folders)} sessions")
    places = [str(folder) for folder in folders]
    outcomes.sort(key=lambda one: places.index(one.folder))
    say(fleet.table(outcomes), result=True)
    say(*fleet.remarks(outcomes))
    say(fleet.summary(outcomes, time.perf_counter() - started))
    if code := max(one.code for one in outcomes):
        raise typer.Exit(code)

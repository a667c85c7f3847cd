"""Commands for many robots: run, fleet."""

from pathlib import Path

import typer

from calib.cli.shared import command, exit_failed, reporting, say
from calib.config_types import Plots

app = typer.Typer()


@command(app, "Files and studies")
def run(sessions: list[str], workers: str = "1", plots: Plots = True) -> None:
    """Run many SESSIONS, one folder per robot, as far as possible. A table at the end shows their states.

    A robot that fails does not stop the others; see its folder's run.log. The exit code is the worst of all. The same
    command again goes on from what is done, also after a scheduler, a worker or this command was killed.

    Example: calib run cell1 cell2 --workers 2

    Args:
        sessions: session.toml files, the sessions' folders, or addresses such as 's3://bucket/cells/*'
    """
    import time

    from calib.apps.fleet import fleet as runs
    from calib.apps.fleet import stores
    from calib.apps.fleet.throughput import Throughput
    from calib.toolkit.sessions import folders_of
    from calib.workers import workers as opened

    started = time.perf_counter()
    folders = folders_of(sessions, stores.sessions)
    pace = Throughput()
    outcomes = []
    with reporting() as (say, progress):
        progress(f"running {len(folders)} sessions")
        for outcome in runs.run(folders, opened(workers), f"calib run --workers {workers}", plots, pace):
            outcomes.append(outcome)
            say(outcome.line())
            progress(f"{len(outcomes)} of {len(folders)} sessions")
    order = {str(folder): number for number, folder in enumerate(folders)}
    outcomes.sort(key=lambda outcome: order[outcome.folder])
    say(runs.table(outcomes), result=True)
    say(*runs.remarks(outcomes), *pace.lines())
    say(runs.summary(outcomes, time.perf_counter() - started))
    code = max(outcome.code for outcome in outcomes)
    if code:
        raise typer.Exit(code)


@command(app, "Files and studies")
def fleet(calibrations: list[Path], out: Path | None = None) -> None:
    """Compare the calibrations of many arms: which drift, which share a bad tool, how far do arms of a type differ?

    With --out, each type gets a prior for its next arm, which then needs fewer poses:
    calib fit fleet/prior/ur5 measured.csv --options fleet/prior/ur5/options.toml

    Arms whose fit failed are named, and left out of the prior; so are sessions without a verdict.

    Tools are compared by their names, which the options of each fit give (tool = "ball B"); without one, all are called
    'tool'. A comparison needs two arms with the tool, and three with others.

    Example: calib fleet cell1 cell2 cell3 --out fleet

    Args:
        calibrations: folders of fits or sessions; those of one robot (serial number) in order of time: by measured_on,
            else by the day the session was made, else as given
        out: folder for the report and the priors. Default: nothing is written
    """
    from calib.apps.fleet.fleet_report import report_fleet

    report = report_fleet(calibrations)
    if out is not None:
        report.save(out)
    say(*report.renderables(), result=True)
    if out is not None:
        say(f"written to {out}")
    exit_failed(report.verdict.level)

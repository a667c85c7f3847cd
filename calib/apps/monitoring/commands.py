"""Commands on a robot over time: diff, drift, log."""

from pathlib import Path
from typing import Annotated, Any

import typer

from calib.apps.monitoring.settings import DiffSettings, DriftSettings
from calib.cli.completion import Robot
from calib.cli.shared import command, exit_failed, say
from calib.config_types import Plots

app = typer.Typer()
Folder = Annotated[
    Path | None, typer.Option("--out", help="folder for report, table and figures. Default: nothing is written")
]


@command(app, "Geometry")
def diff(before: str, after: str, settings: DiffSettings, out: Folder = None, plots: Plots = True) -> None:
    """Compare two calibrations of one robot: what changed, in σ, mm and N m. Is it still within tolerance?

    Exit codes: 0 the earlier parameters are still within tolerance, or none is given; 1 they are not.

    Example: calib diff fit2025 fit2026 --tolerance 0.3 --out changes

    Args:
        before: folder of the earlier fit, identification or session, or the nominal robot
        after: folder of the later one, or the nominal robot
    """
    from calib.apps.monitoring.comparison import robot_change

    change = robot_change.diff(before, after, settings)
    _shown(change, out, plots)


@command(app, "Geometry")
def drift(
    robot: Robot,
    measured: list[Path],
    settings: DriftSettings,
    out: Folder = None,
    plots: Plots = True,
    options: Annotated[Path | None, typer.Option(help="TOML, see calib formats options")] = None,
    base: str | None = None,
    tip: str | None = None,
) -> None:
    """Show how the target drifts with time and temperature, from poses of ROBOT measured more than once.

    Example: calib drift robot.urdf measured.csv drift.csv --tolerance 0.1

    Args:
        measured: CSV files (calib formats measurements) with a column time, or temperature
    """
    from calib.apps.monitoring import drift_page

    _shown(drift_page.drift(robot, measured, settings, options, base, tip), out, plots)


@command(app, "Files and studies")
def log(sessions: list[Path], out: Folder = None, plots: Plots = True, mixed: bool = False) -> None:
    """List the calibrations of one robot: date, verdict, errors, and what changed since the one before.

    Example: calib log cell2025 cell2026 --out history

    Args:
        sessions: folders of finished sessions of one robot
        mixed: take robots of other names or serial numbers for one
    """
    from calib.apps.monitoring import log as robot_log

    _shown(robot_log.log(sessions, mixed=mixed), out, plots, result=True)


@command(app, "Dynamics")
def update(
    folder: Path,
    logs: list[str],
    out: Annotated[Path, typer.Option(help="folder for the updated model, its report and its state")],
    options: Annotated[Path | None, typer.Option(help="TOML of the identification: gains, columns, payloads")] = None,
    enough: Annotated[float | None, typer.Option(min=0.0, metavar="PERCENT")] = None,
    plots: Plots = True,
) -> None:
    """Update identified dynamics by LOGS of production, one after another; friction and gains drift with date.

    Each log is predicted before it is learnt from. One that is not as predicted (a load that was not stated, other
    friction, another unit, another arm) is named with its cause, and not averaged in.

    Example: calib update dynamics log.csv --out today

    Args:
        folder: folder of calib identify, or of an earlier update
        logs: recordings of q and torque or current, with their dates in their names
        enough: stop when one sigma of no parameter moves more than this share of the torque
    """
    from calib.apps.monitoring.learning.update import update_dynamics
    from calib.cli.shared import progress

    with progress() as show:
        updated = update_dynamics(folder, logs, options=options, enough=enough, progress=show)
        show("writing")
        updated.save(out, plots=plots)
    say(*updated.renderables())
    say(f"written to {out}")
    exit_failed(updated.verdict.level)


def _shown(outcome: Any, out: Path | None, plots: Plots, result: bool = False) -> None:
    """Print a result, write it to the folder `out` if one is given, and exit with code 1 if its verdict is fail.

    Args:
        outcome: the result.
        out: folder for the result; None: it is not written.
        plots: whether figures are written.
        result: whether the tables are the command's result, and are therefore printed to standard output.
    """
    if out is not None:
        outcome.save(out, plots=plots)
    say(*outcome.renderables(), result=result)
    if out is not None:
        say(f"written to {out}")
    exit_failed(outcome.section().verdict)

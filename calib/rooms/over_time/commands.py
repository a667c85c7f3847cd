"""Commands on a robot over time: diff."""

from pathlib import Path

import typer

from calib.cli.shared import command, exit_failed, say
from calib.rooms.over_time.settings import DiffSettings

app = typer.Typer()


@command(app, "Geometry")
def diff(before: str, after: str, settings: DiffSettings, out: Path | None = None, plots: bool = True) -> None:
    """Compare two calibrations of one robot: what changed, in σ, mm and N m. Is it still within tolerance?

    Exit codes: 0 the earlier parameters are still within tolerance, or none is given; 1 they are not.

    Example: calib diff fit2025 fit2026 --tolerance 0.3 --out changes

    Args:
        before: folder of the earlier fit, identification or session, or the nominal robot
        after: folder of the later one, or the nominal robot
        out: folder for report, table and figures. Default: nothing is written
    """
    from calib.rooms.over_time import robot_change

    found = robot_change.diff(before, after, settings)
    if out is not None:
        found.save(out, plots=plots)
    say(*found.renderables(), *([f"written to {out}"] if out else []))
    exit_failed(found.verdict.level)

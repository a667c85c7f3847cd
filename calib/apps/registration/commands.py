"""Quick commands, each of which calibrates and prints some frames: tool, base, hand-eye."""

from pathlib import Path
from typing import Annotated

import typer

from calib.apps.registration.settings import PlacementSettings
from calib.cli.completion import Robot
from calib.cli.shared import check_destination, command, exit_failed, progress, say

app = typer.Typer()
Measured = Annotated[
    list[Path],
    typer.Argument(help="CSV files (calib formats measurements), or folders of images (calib formats images)"),
]
Folder = Annotated[Path | None, typer.Option("--out", help="folder for the whole fit. Default: nothing is written")]
Options = Annotated[Path | None, typer.Option("--options", help="TOML, see calib formats options")]


def _add(name: str, frames: tuple[str, ...], help_text: str) -> None:
    """Add a command that fits placements of instrument and targets.

    Args:
        name: name of the command.
        frames: beginnings of the names of the frames that it prints.
        help_text: help text of the command.
    """

    def place(
        robot: Robot,
        measured: Measured,
        settings: PlacementSettings,
        out: Folder = None,
        options: Options = None,
        base: str | None = None,
        tip: str | None = None,
    ) -> None:
        from calib.apps.registration import api

        if out is not None:
            check_destination("fit", robot, out, [options, *measured])
        with progress() as show:
            fit = api.tool(robot, measured, settings, options=options, base=base, tip=tip, progress=show)
            if out is not None:
                fit.save(out)
        say(*fit.lines(*frames))
        if out is not None:
            say(f"written to {out}")
        exit_failed(fit.verdict.level)

    place.__doc__ = help_text
    command(app, "Geometry", name)(place)


_add(
    "tool",
    ("tool",),
    """Calibrate the tool (TCP) of ROBOT from a dozen measured poses, the arm left as it is.

    Example: calib tool robot.urdf m.csv --tolerance 0.5
    """,
)
_add(
    "base",
    ("base", "instrument"),
    """Calibrate where ROBOT stands, its base in the instrument's frame, from a dozen measured poses.

    Example: calib base robot.urdf measured.csv
    """,
)
_add(
    "hand-eye",
    ("camera", "board"),
    """Calibrate camera and board, one on ROBOT and the other beside it, from a dozen images.

    Example: calib hand-eye robot.urdf photos --holdout 0.25
    """,
)

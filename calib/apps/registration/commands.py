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
_HAND_EYE_FILES = (
    "folders of images; CSV files of joints and poses; or pairs of poses without joints: CSV, easy_handeye, MoveIt, "
    "OpenCV (calib formats pairs)"
)
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


@command(app, "Geometry", "hand-eye")
def hand_eye(
    robot: Robot,
    settings: PlacementSettings,
    measured: Annotated[list[Path] | None, typer.Argument(help=_HAND_EYE_FILES)] = None,
    out: Folder = None,
    urdf: Annotated[Path | None, typer.Option(help="URDF of ROBOT with links for camera and board")] = None,
    controller: Annotated[
        str | None, typer.Option("--for", metavar="NAME", help="controller: see calib deliver")
    ] = None,
    world: Annotated[str | None, typer.Option(metavar="POSE", help="as in calib deliver")] = None,
    flange: Annotated[str | None, typer.Option(metavar="POSE", help="as in calib deliver")] = None,
    options: Options = None,
    base: str | None = None,
    tip: str | None = None,
    overwrite: bool = False,
) -> None:
    """Calibrate camera and board, one on ROBOT and the other beside it, from a dozen images or poses.

    Poses of the robot and the board without joints need no robot: calib hand-eye samples.yaml

    Example: calib hand-eye robot.urdf photos --holdout 0.25
    """
    from calib import files
    from calib.apps.registration import api

    sources = measured or []
    if out is not None:
        check_destination("fit", robot, out, [options, *sources])
    with progress() as show:
        fit = api.hand_eye(robot, sources, settings, options=options, base=base, tip=tip, progress=show)
        if out is not None:
            fit.save(out)
    say(*fit.lines(), result=True)
    source = Path(robot) if sources else None
    if controller is not None:
        say(*fit.for_controller(controller, source, world, flange), result=True)
    if out is not None:
        say(f"written to {out}")
    if urdf is not None:
        text, links = fit.urdf(source)
        with files.results([(urdf, (".urdf", ".xml"))], [Path(robot), *sources], overwrite):
            say(f"written to {files.write(urdf, text)}: links {', '.join(links)}")
    exit_failed(fit.verdict.level)

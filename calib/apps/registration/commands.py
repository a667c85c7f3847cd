"""Quick commands, each of which calibrates and prints some frames: tool, base, hand-eye."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from calib.apps.registration.settings import PlacementSettings
from calib.cli.completion import Robot
from calib.cli.shared import check_destination, command, exit_failed, progress, say
from calib.errors import NO_RESULT_CODE

if TYPE_CHECKING:
    from calib.apps.registration.api import Placements

Fit = TypeVar("Fit", bound="Placements")
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


def _fitted(
    place: Callable[..., Fit],
    robot: str,
    measured: list[Path],
    settings: PlacementSettings,
    arguments: Mapping[str, str | Path | None],
    out: Path | None,
) -> Fit:
    """Return placements, saved if a folder is given.

    Args:
        place: function of `calib.apps.registration.api`.
        robot, measured, settings: its arguments.
        arguments: its arguments by name: ``options``, ``base``, ``tip``.
        out: folder of the fit; None: not saved.
    """
    if out is not None:
        check_destination("fit", robot, out, [arguments["options"], *measured])
    with progress() as show:
        fit = place(robot, measured, settings, **arguments, progress=show)
        if out is not None:
            fit.save(out)
    return fit


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

        arguments = {"options": options, "base": base, "tip": tip}
        fit = _fitted(api.tool, robot, measured, settings, arguments, out)
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
    arguments = {"options": options, "base": base, "tip": tip}
    fit = _fitted(api.hand_eye, robot, sources, settings, arguments, out)
    say(*fit.lines(), result=True)
    source = Path(robot) if sources else None
    if out is not None:
        say(f"written to {out}")
    exit_failed(fit.verdict.level)
    if fit.is_open:
        raise typer.Exit(NO_RESULT_CODE)
    if controller is not None:
        say(*fit.for_controller(controller, source, world, flange), result=True)
    if urdf is not None:
        text, links = fit.urdf(source)
        with files.results([(urdf, (".urdf", ".xml"))], [Path(robot), *sources], overwrite):
            say(f"written to {files.write(urdf, text)}: links {', '.join(links)}")

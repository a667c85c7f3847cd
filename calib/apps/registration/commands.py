"""Quick commands of one frame each: tool, base, hand-eye."""

from pathlib import Path
from typing import Annotated, Any

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


@command(app, "Geometry")
def tool(
    robot: Robot,
    measured: Measured,
    settings: PlacementSettings,
    out: Folder = None,
    options: Options = None,
    base: str | None = None,
    tip: str | None = None,
) -> None:
    """Calibrate the tool (TCP) of ROBOT from a dozen measured poses, the arm left as it is.

    Example: calib tool robot.urdf m.csv --tolerance 0.5
    """
    _place("tool", ("tool",), robot, measured, settings, out, options=options, base=base, tip=tip)


@command(app, "Geometry")
def base(
    robot: Robot,
    measured: Measured,
    settings: PlacementSettings,
    out: Folder = None,
    options: Options = None,
    base: str | None = None,
    tip: str | None = None,
) -> None:
    """Calibrate where ROBOT stands, its base in the instrument's frame, from a dozen measured poses.

    Example: calib base robot.urdf measured.csv
    """
    _place("base", ("base", "instrument"), robot, measured, settings, out, options=options, base=base, tip=tip)


@command(app, "Geometry", "hand-eye")
def hand_eye(
    robot: Robot,
    measured: Measured,
    settings: PlacementSettings,
    out: Folder = None,
    options: Options = None,
    base: str | None = None,
    tip: str | None = None,
) -> None:
    """Calibrate camera and board, one on ROBOT and the other beside it, from a dozen images.

    Example: calib hand-eye robot.urdf photos --holdout 0.25
    """
    _place("hand_eye", ("camera", "board"), robot, measured, settings, out, options=options, base=base, tip=tip)


def _place(
    verb: str,
    frame_names: tuple[str, ...],
    robot: str,
    measured: list[Path],
    settings: PlacementSettings,
    out: Path | None,
    **options: Any,
) -> None:
    from calib.apps.registration import api

    if out is not None:
        check_destination("fit", robot, out, [options["options"], *measured])
    with progress() as show:
        fit = getattr(api, verb)(robot, measured, settings, progress=show, **options)
        if out is not None:
            fit.save(out)
    say(*fit.lines(*frame_names), *([f"written to {out}"] if out else []))
    exit_failed(fit.verdict.level)

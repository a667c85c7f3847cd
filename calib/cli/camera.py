"""A camera as the instrument: board, images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.shared import Overwrite, progress, say

app = typer.Typer()


@app.command()
def board(
    out: Annotated[Path, typer.Option(help="folder for board.toml, board.pdf and board.svg")],
    kind: Annotated[str, typer.Option(help="charuco, chessboard or apriltag (a grid)")] = "charuco",
    columns: Annotated[int | None, typer.Option(help="squares (tags) across; by default 9, of a chessboard 10")] = None,
    rows: Annotated[int, typer.Option(help="squares (tags) down")] = 7,
    square: Annotated[float, typer.Option(metavar="MM", help="side of a square (tag), in mm")] = 30.0,
    marker: Annotated[
        float | None, typer.Option(metavar="MM", help="side of a marker; of apriltag the gap between tags")
    ] = None,
    dictionary: Annotated[str | None, typer.Option(help="of the markers: 4x4_50 to 7x7_1000, apriltag_36h11")] = None,
    paper: Annotated[str | None, typer.Option(help="a4, a3, a2, a1 or a0; by default the smallest that fits")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Make a board to print at true scale; a ruler checks the print.

    ChArUco is the one to take: seen in part it still counts, and its corners are found to hundredths of a pixel; the
    corners of tags ten times worse. Print at 100 %, glue it onto something flat, measure a square, correct board.toml.
    """
    from calib.procedure.measuring import boards

    for line in boards.make(out, kind, columns, rows, square, marker, dictionary, paper, overwrite):
        say(line)


@app.command()
def images(
    source: Annotated[Path, typer.Argument(help="a folder of images with board.toml, or a ROS bag / MCAP file")],
    board: Annotated[Path | None, typer.Option(help="board.toml, of a bag")] = None,
    out: Annotated[Path | None, typer.Option(help="folder to write images' corners and joints into, of a bag")] = None,
    image_topic: Annotated[str | None, typer.Option(help="of a bag with several cameras")] = None,
    joint_topic: Annotated[str | None, typer.Option(help="of a bag with several robots")] = None,
) -> None:
    """Find the board in images or a bag; say which are useless. A bag's images become a folder.

    A folder that was looked at holds corners.csv, and goes where a CSV file of measured poses goes: calib fit ROBOT
    FOLDER. See calib formats images.
    """
    from calib.errors import UsageError
    from calib.procedure.measuring import boards

    with progress() as show:
        if source.is_dir() and (source / "board.toml").exists():
            lines = boards.look(source, show)
        elif not source.exists():
            raise UsageError(f"{source}: no such file or folder")
        elif board is None or out is None:
            raise UsageError(f"{source} has no board.toml; of a bag --board and --out are needed")
        else:
            lines = boards.from_bag(source, board, out, image_topic, joint_topic, show)
    for line in lines:
        say(line)

"""Commands for a camera as the instrument: board, images."""

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.shared import Out, command, progress, say

app = typer.Typer()
Millimetres = typer.Option(metavar="MM")


@command(app, "Geometry")
def board(
    out: Out,
    kind: str = "charuco",
    columns: int | None = None,
    rows: int = 7,
    square: Annotated[float, Millimetres] = 30.0,
    marker: Annotated[float | None, Millimetres] = None,
    dictionary: str | None = None,
    paper: str | None = None,
    overwrite: bool = False,
) -> None:
    """Make a calibration board to print; check it with a ruler.

    Take ChArUco: it may be seen in part, and its corners are found to hundredths of a pixel; the
    corners of tags ten times worse. Print at 100 %, glue it onto something flat, measure a square, correct board.toml.

    Example: calib board --paper a4 --square 20 --out board

    Args:
        out: folder for board.toml, board.pdf and board.svg
        kind: charuco, chessboard or apriltag (a grid)
        columns: squares (tags) per row; default 9, chessboard 10
        rows: squares (tags) per column
        square: side of a square (or tag) [mm]
        marker: side of a marker; for apriltag the gap between tags
        dictionary: marker dictionary: 4x4_50 to 7x7_1000, apriltag_36h11
        paper: a4, a3, a2, a1 or a0; by default the smallest that fits
    """
    from calib.toolkit.boards import print_board

    for line in print_board(out, kind, columns, rows, square, marker, dictionary, paper, overwrite):
        say(line)


@command(app, "Geometry")
def images(
    source: Path,
    board: Path | None = None,
    out: Path | None = None,
    image_topic: str | None = None,
    joint_topic: str | None = None,
) -> None:
    """Find the board in images or a bag. Unusable images are named; a bag's images become a folder.

    The folder then contains corners.csv, and goes where a CSV file of measured poses goes: calib fit ROBOT
    FOLDER. See calib formats images.

    Example: calib images photos

    Args:
        source: a folder of images with board.toml, or a ROS bag / MCAP file
        board: board.toml for a bag
        out: output folder for corners and joints of a bag
        image_topic: image topic of a bag with several cameras
        joint_topic: joint topic of a bag with several robots
    """
    from calib.errors import UsageError

    with progress() as show:
        if source.is_dir() and (source / "board.toml").exists():
            from calib.toolkit.boards import look_at_images

            lines = look_at_images(source, show)
        elif not source.exists():
            raise UsageError(f"{source}: no such file or folder")
        elif board is None or out is None:
            raise UsageError(f"{source} has no board.toml; for a bag give --board and --out")
        else:
            from calib.toolkit.boards import images_from_bag

            lines = images_from_bag(source, board, out, image_topic, joint_topic, show)
    for line in lines:
        say(line)

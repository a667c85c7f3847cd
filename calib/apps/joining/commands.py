"""Command that joins joint values and measured points: join."""

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.completion import Robot
from calib.cli.shared import Out, command, say

app = typer.Typer()


@command(app, "Geometry")
def join(
    joints: Path,
    points: Path,
    out: Out,
    by: Annotated[str, typer.Option(metavar="name|time|row|geometry|motion")] = "",
    robot: Annotated[Robot | None, typer.Option()] = None,
    base: str | None = None,
    tip: str | None = None,
    options: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Join the JOINTS of the controller and the POINTS of the instrument to one file of measured poses.

    Several readings of one pose are averaged; missing poses, and readings that contradict each other, are named.
    Two logs of one motion (positions, torques) become one recording for calib identify, by their times.
    With --by motion, points measured while the arm moves: the clocks' offset is found, and rows are thinned.

    Example: calib join joints.csv points.csv --out m.csv

    Args:
        joints: CSV of joint values, one row per pose, or a log over time
        points: CSV of measured points: calib formats join
        out: CSV file of measured poses, for calib fit
        by: how rows are matched. Default: the first that both files have columns for
        options: TOML with [columns] and [units], as for calib fit and calib identify
        robot: its nominal geometry checks the order, or finds it (--by geometry), or the clocks (--by motion)
        options: TOML whose [columns], [units], controller and euler say how the two files are read: calib formats
            options; calib fit reads the result without them
    """
    from calib.apps.joining import joining
    from calib.files import results

    with results([(out, (".csv",))], [joints, points, robot, options], overwrite):
        joined = joining.join(joints, points, by=by, robot=robot, base=base, tip=tip, options=options)
        joined.write(out)
    say(*joined.notes, f"{len(joined.poses)} {joined.rows} written to {out}")

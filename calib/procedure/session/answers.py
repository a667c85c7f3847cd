"""What `calib new` is given, by options or at a terminal; loads nothing, so that the command line starts at once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from calib.config import strict
from calib.config_types import Expect, OneOf, Real, Text, Typed

CAMERA = ("mounting", "lens", "board", "carried", "stands")
CELL = ("instrument_at", "cone", "facing", "box", "obstacles", *CAMERA)
Held = Annotated[float, Real(least=-3.0, most=3.0, unit="m", quantity="length")]
Torques = Annotated[str, OneOf(("motor", "link", "both"))]


@strict
@dataclass(frozen=True)
class Answers:
    """Answers as they were typed; None where nothing was said.

    Of the cell, "unknown" says that it is not known and not checked, "none" that there is no such thing.

    Attributes:
        robot: a .urdf, an MDH .toml, a library name, or the folder of an earlier fit.
        instrument: cmm, tracker, tracker6d, mocap, camera, camera-poses, other-pose, other-position, none.
        tool: x,y,z: where the target roughly sits in the tip's frame [m].
        limits: TOML file that states the cell: instrument or [camera], obstacles, speeds; none: asked for now.
        mounting: of a camera: in hand (the arm carries it), to hand (the board), or unknown.
        lens: camera_info YAML of the camera, roughly right; or unknown.
        board: board.toml, of calib board; or unknown.
        carried: what the arm carries, the camera or the board, in the tip's frame [m]: 'x,y,z facing z'; or unknown.
        stands: the other of the two in the robot's base frame [m]: '0.5,0,0 facing z'; or unknown.
        instrument_at: x,y,z: where the instrument stands in the robot's base frame [m]; unknown, or none.
        cone: half angle of the cone in which the target sees the instrument [deg] (a reflector: 30); or unknown.
        facing: where the target faces in the tip's frame: z, -x ….
        box: x,x,y,y,z,z that no part of the arm leaves, in its base frame [m]; unknown, or none.
        obstacles: 'table box 1.2,0.8,0.05 at 0.7,0,-0.03' [m], its middle; unknown, or none; repeatable.
        dynamics: identify the dynamics, too (default).
        torques: what the log holds.
        payloads: label=kg of a body to record with as well; repeatable.
    """

    robot: Text | None = None
    instrument: Text | None = None
    tool: Annotated[tuple[Held, Held, Held], Expect("x,y,z in metres, at most 3 m from the flange")] | None = None
    limits: Path | None = None
    mounting: Text | None = None
    lens: Text | None = None
    board: Text | None = None
    carried: Text | None = None
    stands: Text | None = None
    instrument_at: Text | None = None
    cone: Text | None = None
    facing: Text | None = None
    box: Text | None = None
    obstacles: tuple[str, ...] | None = None
    dynamics: Annotated[bool, Typed("--dynamics/--geometry-only")] | None = None
    torques: Torques | None = None
    payloads: tuple[str, ...] = ()

    @property
    def cell(self) -> dict[str, Any]:
        """What was said of the cell."""
        return {name: value for name in CELL if (value := getattr(self, name)) is not None}

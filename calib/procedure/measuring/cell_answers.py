"""What `calib new` is told of the cell, as tables of the limits file (`calib formats limits`) that the session keeps.

"unknown" is an answer to every question: what it is about is then not checked, and the certificate says so. "none" says
that there is no such thing, and nothing is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.config_types import number
from calib.data.camera.board import FILE, read_board
from calib.data.camera.camera_info import read_lens
from calib.data.poses.pixels import IN_HAND, TO_HAND
from calib.errors import UsageError
from calib.transforms import pose, to_xyz_rpy

UNKNOWN = ("", "unknown", "not known", "?", "-")
NONE = "none"
FAR, WIDE, HELD = 100.0, 10.0, 3.0  # [m]: an instrument, a cell, a tool beyond which a number is taken for millimetres
CAMERA = ("mounting", "lens", "board", "carried", "stands")
AXES = {
    f"{sign}{axis}": [(-1.0 if sign == "-" else 1.0) * (k == j) for j in range(3)]
    for k, axis in enumerate("xyz")
    for sign in ("", "+", "-")
}


def cell_tables(
    instrument_at: str | None = None,
    cone: str | None = None,
    facing: str | None = None,
    box: str | None = None,
    obstacles: Sequence[str] | None = None,
    **camera: str | None,
) -> dict[str, Any]:
    """Return the tables of a limits file that answers come to; empty where nothing is known.

    Args:
        instrument_at: x,y,z of the instrument in the robot's base frame [m].
        cone: half angle in which the target sees it [deg].
        facing: the target's direction in the tip's frame: x, -z … or three numbers.
        box: x,x,y,y,z,z that the arm stays in, in its base frame [m].
        obstacles: ``NAME KIND SIZES at X,Y,Z`` each: ``table box 1.2,0.8,0.05 at 0.7,0,-0.03`` [m].
        camera: `CAMERA`, see `_camera`.

    Raises:
        UsageError: for an answer that cannot be one, with what can.
    """
    without = [name for name, text in (("instrument", instrument_at), ("box", box)) if _plain(text) == NONE]
    instrument, target, collision = dict[str, Any](), dict[str, Any](), dict[str, Any]()
    if (place := _known(instrument_at)) is not None:
        instrument = {"xyz": _numbers("--instrument-at", place, 3, "x,y,z in metres", FAR)}
    if (angle := _known(cone)) is not None:
        if not instrument:
            raise UsageError(f"--cone {angle}: say where the instrument stands, too (--instrument-at x,y,z)")
        instrument |= {"sight": _cone(angle)}
    if (direction := _known(facing)) is not None:
        target = {"facing": _direction("--facing", direction)}
    if (walls := _known(box)) is not None:
        sides = _numbers("--box", walls, 6, "x,x,y,y,z,z in metres, the smaller one first", WIDE)
        ranges = [sides[k : k + 2] for k in (0, 2, 4)]
        if any(low >= high for low, high in ranges):
            raise UsageError(f"--box {walls}: expected x,x,y,y,z,z in metres, the smaller one first")
        _check_inside(ranges, walls)
        collision = {"box": ranges}
    stated = [text for each in obstacles or () for text in each.split(";") if _plain(text) not in UNKNOWN]
    without += ["obstacles"] if [_plain(text) for text in stated] == [NONE] else []
    things = [_obstacle(text) for text in stated if _plain(text) != NONE]
    seen = _camera(**camera) if any(_known(text) for text in camera.values()) else {}
    tables = {"without": without, "instrument": instrument, "target": target, "collision": collision}
    return {name: table for name, table in (tables | {"obstacle": things, "camera": seen}).items() if table}


def _plain(text: str | None) -> str:
    return (text or "").strip().lower()


def _known(text: str | None) -> str | None:
    return None if _plain(text) in (*UNKNOWN, NONE) else (text or "").strip()


def _numbers(option: str, text: str, count: int, form: str, most: float) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise UsageError(f"{option} {text}: expected {form}, or unknown")
    if max(map(abs, values)) > most:
        raise UsageError(f"{option} {text}: {max(map(abs, values)):g} m? These look like mm; give metres")
    return values


def _cone(text: str) -> float:
    angle = number(text if any(map(str.isalpha, text)) else f"{text} deg", f"--cone {text}", "angle")
    if not np.radians(1.0) <= angle <= np.pi:
        raise UsageError(f"--cone {text}: expected the half angle of the cone in degrees, 1 to 180, or unknown")
    return angle


def _direction(option: str, text: str) -> list[float]:
    if (axis := AXES.get(text.lower())) is not None:
        return axis
    frame = "base" if option == "--stands" else "tip"
    values = _numbers(option, text, 3, f"an axis of the {frame}'s frame (x, -z …) or three numbers", FAR)
    if not any(values):
        raise UsageError(f"{option} {text}: no direction")
    return values


def _camera(
    mounting: str | None = None,
    lens: str | None = None,
    board: str | None = None,
    carried: str | None = None,
    stands: str | None = None,
) -> dict[str, Any]:
    """Return [camera], ``unknown`` where nothing was said.

    Args:
        mounting: in hand (the arm carries the camera) or to hand (it carries the board).
        lens, board: files.
        carried: ``X,Y,Z facing AXIS`` [m] of what the arm carries, in the tip's frame; a camera faces what it looks at.
        stands: the same of the other, in the base's frame.
    """
    found: dict[str, Any] = dict.fromkeys(CAMERA, UNKNOWN[1])
    held = ""
    if (how := _known(mounting)) is not None:
        held = how.lower().replace("-", " ").replace("_", " ")
        if held not in (IN_HAND, TO_HAND):
            raise UsageError(f"--mounting {how}: expected {IN_HAND} (the arm carries the camera), {TO_HAND} or unknown")
        found |= {"mounting": held}
    for name, text in (("lens", lens), ("board", board)):
        if (file := _known(text)) is not None:
            found[name] = _file(name, Path(file).expanduser())
    for name, text, most in (("carried", carried, HELD), ("stands", stands, FAR)):
        if (place := _known(text)) is not None:
            if not held:
                raise UsageError(f"--{name} {place}: of the camera or of the board? Say --mounting, too")
            looks = (held == IN_HAND) == (name == "carried")
            found[name] = _turned(f"--{name}", place, most, looks)
    return found


def _file(name: str, path: Path) -> str:
    """Return the path of a lens or a board that can be read."""
    path = path / FILE if name == "board" and path.is_dir() else path
    if not path.is_file():
        raise UsageError(f"--{name} {path}: no such file; give one, or unknown")
    read_board(path) if name == "board" else read_lens(path)
    return str(path)


def _turned(option: str, text: str, most: float, looks: bool) -> dict[str, list[float]]:
    """Return a place whose z axis is the direction of view: along a camera's, against a board's facing."""
    form = "x,y,z in metres and the way it faces, e.g. 0.5,0,0 facing z"
    spot, _, way = text.partition("facing")
    if not way.strip() and option == "--stands":
        raise UsageError(f"{option} {text}: expected {form}, or unknown")
    along = np.array(_direction(option, way.strip() or "z"))
    turn = Rotation.align_vectors([along if looks else -along], [[0.0, 0.0, 1.0]])[0].as_matrix()
    xyz, rpy = to_xyz_rpy(pose(turn, _numbers(option, spot.strip(), 3, form, most)))
    return {"xyz": [float(x) for x in xyz], "rpy": [round(float(x), 6) for x in rpy]}


def _check_inside(box: list[list[float]], text: str) -> None:
    if not all(low <= 0.0 <= high for low, high in box[:2]):
        raise UsageError(f"--box {text}: the robot's base, at 0,0, stands outside; places are in its base frame")


def _obstacle(text: str) -> dict[str, Any]:
    form = "NAME box|sphere|cylinder SIZES at X,Y,Z in metres, e.g. table box 1.2,0.8,0.05 at 0.7,0,-0.03"
    words = text.replace(" at ", " ").split()
    counts = {"box": 3, "sphere": 1, "cylinder": 2}
    if len(words) != 4 or words[1] not in counts:
        raise UsageError(f"--obstacle {text.strip()}: expected {form}")
    sizes = _numbers(f"--obstacle {words[0]}", words[2], counts[words[1]], f"{counts[words[1]]} sizes: {form}", WIDE)
    if min(sizes) <= 0:
        raise UsageError(f"--obstacle {words[0]} {words[2]}: sizes are above 0")
    place = _numbers(f"--obstacle {words[0]}", words[3], 3, f"its middle x,y,z: {form}", WIDE)
    return {"name": words[0], "kind": words[1], "size": sizes, "xyz": place}

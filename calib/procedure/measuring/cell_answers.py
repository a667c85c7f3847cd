"""What `calib new` is given of the cell, as tables of the limits file (`calib formats limits`) that the session keeps.

"unknown" is an answer to every question: what it is about is then not checked, and the certificate says so. "none" says
that there is no such thing, and nothing is missing.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.config import parse
from calib.config_types import Real
from calib.data.poses.choices import BOARD, IN_HAND, TO_HAND
from calib.errors import UsageError, require
from calib.extensions import needed
from calib.procedure.measuring.constraints_file import AXES, ConstraintsFile
from calib.transforms import pose, to_xyz_rpy

UNKNOWN = ("", "unknown", "not known", "?", "-")
NONE = "none"
MAX_FAR, MAX_WIDE, MAX_HELD = 100.0, 10.0, 3.0  # [m]: of an instrument, a cell, a tool; beyond, numbers are millimetres
CAMERA = ("mounting", "lens", "board", "carried", "stands")
ABSENT = {"instrument_at": "instrument", "box": "box", "obstacles": "obstacles"}  # what "none" says is not there


def cell_tables(**answers: str | Sequence[str] | None) -> dict[str, Any]:
    """Return the tables of a limits file that answers come to; empty where nothing is known.

    Args:
        answers: by the names of `calib.procedure.session.answers.Answers`.

    Raises:
        UsageError: for an answer that cannot be one, with what can.
    """
    texts = {name: text if isinstance(text, str) else ";".join(text or ()) for name, text in answers.items()}
    found: dict[str, Any] = {}
    if absent := [ABSENT[name] for name, text in texts.items() if name in ABSENT and _plain(text) == NONE]:
        found["without"] = absent
    known = {name: text.strip() for name, text in texts.items() if _plain(text) not in (*UNKNOWN, NONE)}
    for name, text in known.items():
        place, read = _KEYS[name]
        table, _, key = place.partition(".")
        try:
            value = read(text, known) if name in ("carried", "stands") else read(text)
        except ValueError as wrong:
            option = name.removesuffix("s") if name == "obstacles" else name
            raise UsageError(f"--{option.replace('_', '-')} {text}: {wrong}, or unknown") from None
        found[table] = found.get(table, {}) | {key: value} if key else value
    if "camera" in found:
        found["camera"] = dict.fromkeys(CAMERA, UNKNOWN[1]) | found["camera"]
    parse(ConstraintsFile, found, "the cell")
    return found


def _plain(text: str) -> str:
    return text.strip().lower()


def _lengths(text: str, count: int, most: float, expected: str = "x,y,z in metres") -> list[float]:
    values = [Real(least=-most, most=most, unit="m", quantity="length").read(part) for part in text.split(",")]
    require(len(values) == count, f"expected {expected}", ValueError)
    return values


def _cone(text: str) -> str:
    return text if any(map(str.isalpha, text)) else f"{text} deg"


def _direction(text: str) -> Any:
    return text.lower() if text.lower() in AXES else [Real(quantity="1").read(part) for part in text.split(",")]


def _box(text: str) -> list[list[float]]:
    sides = _lengths(text, 6, MAX_WIDE, "x,x,y,y,z,z in metres, the smaller one first")
    ranges = [sides[k : k + 2] for k in (0, 2, 4)]
    if any(low >= high for low, high in ranges):
        raise ValueError("expected x,x,y,y,z,z in metres, the smaller one first")
    if not all(low <= 0.0 <= high for low, high in ranges[:2]):
        raise ValueError("the robot's base, at 0,0, stands outside; places are in its base frame")
    return ranges


def _obstacles(text: str) -> list[dict[str, Any]]:
    form = "NAME box|sphere|cylinder SIZES at X,Y,Z in metres, e.g. table box 1.2,0.8,0.05 at 0.7,0,-0.03"
    result = []
    for each in text.split(";"):
        words = each.replace(" at ", " ").split()
        if _plain(each) in (*UNKNOWN, NONE):
            continue
        require(len(words) == 4, f"expected {form}", ValueError)
        sizes = [Real(above=0, most=MAX_WIDE, unit="m", quantity="length").read(part) for part in words[2].split(",")]
        result.append({"name": words[0], "kind": words[1], "size": sizes, "xyz": _lengths(words[3], 3, MAX_WIDE)})
    return result


def _mounting(text: str) -> str:
    held = text.lower().replace("-", " ").replace("_", " ")
    require(held in (IN_HAND, TO_HAND), f"expected {IN_HAND} (the arm carries the camera), {TO_HAND}", ValueError)
    return held


def _file(read: str, text: str) -> str:
    """Return the path of a lens or a board that can be read."""
    path = Path(text).expanduser()
    path = path / BOARD if read == "read_board" and path.is_dir() else path
    require(path.is_file(), "no such file; give one", ValueError)
    needed(read)(path)
    return str(path)


def _turned(name: str, most: float, text: str, known: dict[str, str]) -> dict[str, list[float]]:
    """Return a place whose z axis is the direction of view: along a camera's, against a board's facing."""
    require("mounting" in known, "of the camera or of the board? Say --mounting, too", ValueError)
    looks = (_mounting(known["mounting"]) == IN_HAND) == (name == "carried")
    spot, _, way = text.partition("facing")
    if not way.strip() and name == "stands":
        raise ValueError("expected x,y,z in metres and the way it faces, e.g. 0.5,0,0 facing z")
    direction = _direction(way.strip() or "z")
    along = np.array(AXES[direction] if isinstance(direction, str) else direction)
    if along.shape != (3,) or not along.any():
        raise ValueError("expected an axis of the frame (x, -z …) or three numbers behind facing")
    turn = Rotation.align_vectors([along if looks else -along], [[0.0, 0.0, 1.0]])[0].as_matrix()
    xyz, rpy = to_xyz_rpy(pose(turn, _lengths(spot.strip(), 3, most)))
    return {"xyz": [float(x) for x in xyz], "rpy": [round(float(x), 6) for x in rpy]}


_KEYS: dict[str, tuple[str, Any]] = {  # of the limits file, and how the answer is read
    "instrument_at": ("instrument.xyz", partial(_lengths, count=3, most=MAX_FAR)),
    "cone": ("instrument.sight", _cone),
    "facing": ("target.facing", _direction),
    "box": ("collision.box", _box),
    "obstacles": ("obstacle", _obstacles),
    "mounting": ("camera.mounting", _mounting),
    "lens": ("camera.lens", partial(_file, "read_lens")),
    "board": ("camera.board", partial(_file, "read_board")),
    "carried": ("camera.carried", partial(_turned, "carried", MAX_HELD)),
    "stands": ("camera.stands", partial(_turned, "stands", MAX_FAR)),
}

"""Questions of `calib new`: known instruments, questions at a terminal, and checks of the answers."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.config import described, parse
from calib.config_types import OneOf, Real
from calib.data.images.board import read_board
from calib.data.images.lens import read_lens
from calib.data.poses import BOARD, IMAGES, IN_HAND, TO_HAND
from calib.errors import UsageError, one_of, refused_as, require
from calib.procedure.answers import CAMERA, CELL, Answers, CertificateSection
from calib.procedure.measuring.constraints_file import AXES, ConstraintsFile
from calib.procedure.session.settings import NOTHING, InstrumentSection
from calib.robot.library import resolve
from calib.transforms import pose, to_xyz_rpy

MAX_MASS = 2000.0  # [kg]: of a payload (our choice)


INSTRUMENTS = {  # starting values in ``session.toml``; a sigma of 0 is estimated from the residuals
    "cmm": InstrumentSection("optical CMM", "pose", 60e-6, 0.2e-3),  # Nikon K610: 60 µm volumetric; turn: our guess
    "tracker": InstrumentSection("laser tracker", "position", 20e-6),  # about 15 µm + 6 µm/m in a small cell: our guess
    "tracker6d": InstrumentSection("laser tracker, 6-D probe", "pose", 30e-6, 0.1e-3),  # our guess
    "mocap": InstrumentSection("motion capture", "pose"),
    "camera": InstrumentSection("camera and board", "pixels"),
    "camera-poses": InstrumentSection("camera and board", "pose"),  # by another program
    "none": InstrumentSection("no instrument", NOTHING),
    "other-pose": InstrumentSection("instrument", "pose"),
    "other-position": InstrumentSection("instrument", "position"),
}


def instrument_named(name: str) -> InstrumentSection:
    """Return the settings of an instrument by its name.

    Raises:
        UsageError: for an unknown name, with the known ones.
    """
    return INSTRUMENTS[one_of(name, INSTRUMENTS, "instrument", UsageError)]


def _measures(given: Answers) -> str:
    """Return what the instrument in the answers measures; "" if the instrument is unknown."""
    return INSTRUMENTS[given.instrument].measures if given.instrument in INSTRUMENTS else ""


@dataclass(frozen=True)
class Question:
    """A question at the terminal: option name and default of the answer."""

    name: str
    default: str
    of: type = Answers

    @property
    def words(self) -> str:
        """Text of the question, from the help of the option."""
        about = described(self.of)[self.name]
        return f"{self.name.replace('_', ' ')} ({about})" if self.of is Answers else f"{about} (Enter: by hand, later)"

    def open(self, given: Answers) -> bool:
        """Return whether the question still needs an answer, given the earlier answers."""
        if self.of is CertificateSection:
            return bool(given.details) and not getattr(given.certificate, self.name)
        if getattr(given, self.name) not in (None, ()) or (self.name in CELL and given.limits is not None):
            return False
        camera, nothing = _measures(given) == IMAGES, _measures(given) == NOTHING
        match self.name:
            case "tool" | "instrument_at":
                return not camera and not nothing
            case "limits":
                return not given.cell
            case "cone" | "facing":
                return "instrument" in cell_tables(instrument_at=given.instrument_at)
            case "mounting":
                return camera
            case "lens" | "board" | "carried" | "stands":
                return camera and (given.mounting or "").lower() not in UNSAID
            case "dynamics":
                return not nothing
            case "torques" | "payloads" | "tolerance_percent":
                return given.dynamics is not False
            case "tolerance_mm" | "program":
                return not nothing
        return True


DEFAULTS = {
    "robot": "",
    "instrument": "tracker",
    "tool": "0.05,0,0.05",
    "program": "none",
    "limits": "none",
    "facing": "z",
    "dynamics": "yes",
    "torques": "motor",
    "payloads": "none",
    "tolerance_mm": "0",
    "tolerance_percent": "0",
    "details": "yes",
}
QUESTIONS = (
    *(Question(one.name, DEFAULTS.get(one.name, "unknown")) for one in fields(Answers) if one.name != "certificate"),
    *(Question(one.name, "", CertificateSection) for one in fields(CertificateSection)),
)


def with_answer(given: Answers, question: Question, text: str) -> Answers:
    """Return the answers with the text of one more answer added, after checking it.

    Raises:
        UsageError: for an invalid answer, with the valid form.
    """
    name, empty = question.name, text.lower() in ("", "none", "-")
    if question.of is CertificateSection:
        entry = getattr(parse(CertificateSection, {name: text}, ""), name)
        return replace(given, certificate=replace(given.certificate, **{name: entry}))
    said = {"y": True, "n": False}.get(text[:1].lower(), text)
    values: dict[str, Any] = {
        "tool": text.split(","),
        "limits": None if empty else text,
        "payloads": [] if empty else text.split(),
        "obstacles": [text],
        "dynamics": said,
        "details": said,
    }
    found = replace(given, **{name: getattr(parse(Answers, {name: values.get(name, text)}, ""), name)})
    if name == "robot":
        require(text, "a robot is needed", UsageError)
        resolve(text)
    checked(replace(found, robot=found.robot or "", instrument=found.instrument or "tracker"))
    return found


def checked(given: Answers) -> dict[str, Any]:
    """Return the arguments of `calib.procedure.session.commands.new_session` from checked answers.

    Raises:
        UsageError: for an invalid answer.
    """
    robot, instrument = given.robot, given.instrument
    require(robot is not None and instrument is not None, "a robot and an instrument are needed", UsageError)
    instrument_named(instrument or "")
    stated = next((name for name in CAMERA if getattr(given, name) is not None), None)
    require(
        _measures(given) == IMAGES or not stated,
        f"--{stated} applies to a camera that takes images; the instrument is {instrument}",
    )
    dynamics = given.dynamics is not False
    words = "--payload and --torques apply to the dynamics, which --geometry-only excludes"
    require(dynamics or not (given.payloads or given.torques), words, UsageError)
    result = {"robot": robot, "instrument": instrument, "dynamics": dynamics, "limits": given.limits}
    if given.limits is not None:
        require(given.limits.exists(), f"--limits {given.limits}: no such file", UsageError)
        option = next(iter(given.cell), "").replace("_", "-").replace("obstacles", "obstacle")
        words = f"--{option} and --limits both describe the cell; put it into {given.limits}"
        require(not given.cell, words, UsageError)
    else:
        result["limits"] = cell_tables(**given.cell) or None
    others = {"payloads": dict(map(_payload, given.payloads)), "certificate": asdict(given.certificate)}
    others |= {
        name: getattr(given, name) for name in ("tool", "program", "torques", "tolerance_mm", "tolerance_percent")
    }
    return result | {name: value for name, value in others.items() if value and value != NONE}


def _payload(text: str) -> tuple[str, float]:
    label, _, mass = text.partition("=")
    try:
        value = float(mass.removesuffix("kg"))
    except ValueError:
        value = float("nan")
    words = f"--payload {text}: expected label=kg, e.g. loaded=3.28 (the label goes into the file's name)"
    require(label.isidentifier() and 0.0 < value < MAX_MASS, words, UsageError)
    return label, value


UNSAID = ("", "unknown", "not known", "?", "-")
NONE = "none"
MAX_FAR, MAX_WIDE, MAX_HELD = 100.0, 10.0, 3.0  # [m]: of an instrument, a cell, a tool; beyond, numbers are millimetres
ABSENT = {"instrument_at": "instrument", "box": "box", "obstacles": "obstacles"}  # what "none" says is not there


def cell_tables(**answers: str | Sequence[str] | None) -> dict[str, Any]:
    """Return the content of a limits file, from the answers on the cell; empty without such answers.

    Every question may be answered by "unknown": the subject is then not checked, and the certificate says so. "none"
    means that it does not exist, so that nothing has to be checked.

    Args:
        answers: by the names of `calib.procedure.answers.Answers`.

    Raises:
        UsageError: for an invalid answer, with the valid form.
    """
    texts = {name: text if isinstance(text, str) else ";".join(text or ()) for name, text in answers.items()}
    found: dict[str, Any] = {}
    if absent := [ABSENT[name] for name, text in texts.items() if name in ABSENT and _plain(text) == NONE]:
        found["without"] = absent
    known = {name: text.strip() for name, text in texts.items() if _plain(text) not in (*UNSAID, NONE)}
    require("cone" not in known or "instrument_at" in known, "--cone needs --instrument-at, too", UsageError)
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
        found["camera"] = dict.fromkeys(CAMERA, "unknown") | found["camera"]
    parse(ConstraintsFile, found, "the cell")
    return found


def _plain(text: str) -> str:
    return text.strip().lower()


def _lengths(text: str, count: int, most: float, expected: str = "x,y,z in metres") -> list[float]:
    values = [Real(least=-most, most=most, unit="m", quantity="length").read(part) for part in text.split(",")]
    require(len(values) == count, f"expected {expected}", ValueError)
    return values


def _direction(text: str) -> Any:
    with refused_as(ValueError, ValueError, f"expected {', '.join(AXES)}, or three numbers"):
        return text.lower() if text.lower() in AXES else [Real(quantity="1").read(part) for part in text.split(",")]


def _box(text: str) -> list[list[float]]:
    sides = _lengths(text, 6, MAX_WIDE, "x,x,y,y,z,z in metres, the smaller one first")
    ranges = [sides[k : k + 2] for k in (0, 2, 4)]
    if any(low >= high for low, high in ranges):
        raise ValueError("expected x,x,y,y,z,z in metres, the smaller one first")
    if not all(low <= 0.0 <= high for low, high in ranges[:2]):
        raise ValueError("the robot's base, at 0,0, is outside the box; coordinates are in the base frame")
    return ranges


def _obstacles(text: str) -> list[dict[str, Any]]:
    form = "NAME box|sphere|cylinder SIZES at X,Y,Z in metres, e.g. table box 1.2,0.8,0.05 at 0.7,0,-0.03"
    result = []
    for each in text.split(";"):
        words = each.replace(" at ", " ").split()
        if _plain(each) in (*UNSAID, NONE):
            continue
        require(len(words) == 4, f"expected {form}", ValueError)
        sizes = [Real(above=0, most=MAX_WIDE, unit="m", quantity="length").read(part) for part in words[2].split(",")]
        result.append({"name": words[0], "kind": words[1], "size": sizes, "xyz": _lengths(words[3], 3, MAX_WIDE)})
    return result


def _mounting(text: str) -> str:
    return OneOf((IN_HAND, TO_HAND)).read(text.lower().replace("-", " ").replace("_", " "))


def _file(read: Callable[[Path], object], text: str) -> str:
    """Return the path of a lens or board file, after checking that it can be read."""
    path = Path(text).expanduser()
    path = path / BOARD if read is read_board and path.is_dir() else path
    require(path.is_file(), "no such file; give an existing one", ValueError)
    read(path)
    return str(path)


def _turned(name: str, most: float, text: str, known: dict[str, str]) -> dict[str, list[float]]:
    """Return a placement with z along the viewing direction: the camera's, or opposite to the board's normal."""
    require(
        "mounting" in known,
        "it is not known whether the arm carries the camera or the board; give --mounting, too",
        ValueError,
    )
    looks = (_mounting(known["mounting"]) == IN_HAND) == (name == "carried")
    spot, _, way = text.partition("facing")
    if not way.strip() and name == "stands":
        raise ValueError("expected x,y,z in metres and a direction, e.g. 0.5,0,0 facing z")
    direction = _direction(way.strip() or "z")
    along = np.array(AXES[direction] if isinstance(direction, str) else direction)
    if along.shape != (3,) or not along.any():
        raise ValueError("expected an axis of the frame (x, -z …) or three numbers after facing")
    turn = Rotation.align_vectors([along if looks else -along], [[0.0, 0.0, 1.0]])[0].as_matrix()
    xyz, rpy = to_xyz_rpy(pose(turn, _lengths(spot.strip(), 3, most)))
    return {"xyz": [float(x) for x in xyz], "rpy": [round(float(x), 6) for x in rpy]}


_KEYS: dict[str, tuple[str, Any]] = {  # of the limits file, and how the answer is read
    "instrument_at": ("instrument.xyz", partial(_lengths, count=3, most=MAX_FAR)),
    "cone": ("instrument.sight", lambda text: text if any(map(str.isalpha, text)) else f"{text} deg"),
    "facing": ("target.facing", _direction),
    "box": ("collision.box", _box),
    "obstacles": ("obstacle", _obstacles),
    "mounting": ("camera.mounting", _mounting),
    "lens": ("camera.lens", partial(_file, read_lens)),
    "board": ("camera.board", partial(_file, read_board)),
    "carried": ("camera.carried", partial(_turned, "carried", MAX_HELD)),
    "stands": ("camera.stands", partial(_turned, "stands", MAX_FAR)),
}

"""Questions of `calib new`: known instruments, questions at a terminal, and checks of the answers."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.config import described, parse
from calib.config_types import OneOf, ParsedTable, Real
from calib.controllers.table import controller_named
from calib.data.images.board import read_board
from calib.data.images.lens_files import read_lens
from calib.data.poses import BOARD, IMAGES, IN_HAND, TO_HAND
from calib.data.poses.measurements import Poses, Positions
from calib.errors import CalibError, UsageError, one_of, refused_as, require
from calib.procedure.answers import CAMERA, CELL, Answers, CertificateSection
from calib.procedure.excitation.settings import DEFAULT_DESIGN, checked_goal
from calib.procedure.measuring.constraints_file import AXES, ConstraintsFile
from calib.procedure.session.recording_names import check_labels
from calib.procedure.session.settings import NOTHING, InstrumentSection
from calib.records import FieldValues
from calib.robot.library import resolve
from calib.transforms import pose, to_xyz_rpy

# of a payload [kg] (our choice)
MAX_MASS = 2000.0
# answers for what is not known, and for what does not exist
UNSAID = ("", "unknown", "not known", "?", "-")

# starting values in ``session.toml``; a sigma of 0 is estimated from the residuals
INSTRUMENTS = {
    # Nikon K610: 60 µm volumetric; turn: our guess
    "cmm": InstrumentSection("optical CMM", "pose", 60e-6, 0.2e-3),
    # about 15 µm + 6 µm/m in a small cell: our guess
    "tracker": InstrumentSection("laser tracker", "position", 20e-6),
    # our guess
    "tracker6d": InstrumentSection("laser tracker, 6-D probe", "pose", 30e-6, 0.1e-3),
    "mocap": InstrumentSection("motion capture", "pose"),
    "camera": InstrumentSection("camera and board", "pixels"),
    # determined by another program
    "camera-poses": InstrumentSection("camera and board", "pose"),
    "none": InstrumentSection("no instrument", NOTHING),
    "other-pose": InstrumentSection("instrument", "pose"),
    "other-position": InstrumentSection("instrument", "position"),
}


def instrument_named(name: str) -> InstrumentSection:
    """Return the settings of an instrument by its name.

    Raises:
        UsageError: for an unknown name; the message lists the known names.
    """
    return INSTRUMENTS[one_of(name, INSTRUMENTS, "instrument", UsageError)]


def _measures(answers: Answers) -> str:
    """Return which quantity the instrument in the answers measures; empty if the instrument is unknown."""
    if answers.instrument not in INSTRUMENTS:
        return ""
    return INSTRUMENTS[answers.instrument].measures


@dataclass(frozen=True)
class Question:
    """A question at the terminal.

    Attributes:
        name: name of the option that the question is about.
        default: default answer.
        of: dataclass with this option: `Answers` or `CertificateSection`.
    """

    name: str
    default: str
    of: type = Answers

    @property
    def words(self) -> str:
        """Text of the question, made from the option's help text."""
        about = described(self.of)[self.name]
        return f"{self.name.replace('_', ' ')} ({about})" if self.of is Answers else f"{about} (Enter: by hand, later)"

    def open(self, answers: Answers) -> bool:
        """Return whether the question still has to be asked, given the earlier answers."""
        if self.of is CertificateSection:
            return bool(answers.details) and not getattr(answers.certificate, self.name)
        if getattr(answers, self.name) not in (None, ()):
            return False
        # a limits file describes the cell
        if self.name in CELL and answers.limits is not None:
            return False
        measures = _measures(answers)
        camera, nothing = measures == IMAGES, measures == NOTHING
        match self.name:
            case "tool" | "instrument_at":
                return not camera and not nothing
            case "limits":
                return not answers.cell
            case "cone" | "facing":
                return "instrument" in cell_tables(instrument_at=answers.instrument_at)
            case "reference":
                return measures == Poses.kind
            case "mounting":
                return camera
            case "lens" | "board" | "carried" | "stands":
                return camera and (answers.mounting or "").lower() not in UNSAID
            case "dynamics":
                return not nothing
            case "torques" | "payloads" | "goals" | "period" | "tolerance_percent" | "tolerance_torque":
                return answers.dynamics is not False
            case "front":
                return answers.dynamics is not False and any("=" in goal for goal in answers.goals)
            case "tolerance_mm" | "program":
                return not nothing
        return True


def _questions() -> tuple[Question, ...]:
    """Return all questions in the order in which they are asked: session first, then certificate."""
    names = [answer.name for answer in fields(Answers) if answer.name != "certificate"]
    questions = [Question(name, DEFAULTS.get(name, "unknown")) for name in names]
    questions += [Question(entry.name, "", CertificateSection) for entry in fields(CertificateSection)]
    return tuple(questions)


DEFAULTS = {
    "robot": "",
    "instrument": "tracker",
    "reference": "no",
    "tool": "0.05,0,0.05",
    "program": "none",
    "limits": "none",
    "facing": "z",
    "dynamics": "yes",
    "torques": "motor",
    "payloads": "none",
    "goals": "none",
    "period": f"{DEFAULT_DESIGN.period:g}",
    "front": "0",
    "tolerance_mm": "0",
    "tolerance_percent": "0",
    "tolerance_torque": "none",
    "details": "yes",
}
QUESTIONS = _questions()


def with_answer(answers: Answers, question: Question, text: str) -> Answers:
    """Return the answers with the answer to one more question added, after a check.

    Args:
        answers: the earlier answers.
        question: the question.
        text: the answer as typed.

    Raises:
        UsageError: for an invalid answer; the message states the valid form.
    """
    name = question.name
    if question.of is CertificateSection:
        entry = getattr(parse(CertificateSection, {name: text}, ""), name)
        return replace(answers, certificate=replace(answers.certificate, **{name: entry}))

    value: object = text
    is_empty = text.lower() in ("", "none", "-")
    match name:
        case "tool":
            value = text.split(",")
        case "limits":
            value = None if is_empty else text
        case "payloads":
            value = [] if is_empty else [part.strip() for part in text.split(";")]
        case "goals":
            value = [] if is_empty else text.split()
        case "period":
            with refused_as(UsageError, ValueError, f"--period {text}: expected a number of seconds"):
                value = Real(quantity="1").read(text)
        case "front":
            value = int(text) if text.isdecimal() else text
        case "obstacles":
            value = [text]
        case "dynamics" | "details" | "reference":
            value = {"y": True, "n": False}.get(text[:1].lower(), text)
    result = replace(answers, **{name: getattr(parse(Answers, {name: value}, ""), name)})
    if name == "program" and not is_empty:
        controller_named(text)
    if name == "robot":
        require(text, "a robot is needed: a file, or a robot of the library", UsageError)
        resolve(text)
    # what is not answered yet is no error
    checked(replace(result, robot=result.robot or "", instrument=result.instrument or "tracker"))
    return result


def checked(answers: Answers) -> FieldValues:
    """Return the arguments of `calib.procedure.session.commands.new_session` that follow from the answers.

    Raises:
        UsageError: for an invalid answer.
    """
    robot, instrument = answers.robot, answers.instrument
    require(
        robot is not None and instrument is not None,
        "a robot and an instrument are needed: give --robot and --instrument",
        UsageError,
    )
    instrument_named(instrument or "")
    of_camera = [name for name in CAMERA if getattr(answers, name) is not None]
    if of_camera and _measures(answers) != IMAGES:
        raise CalibError(
            f"--{of_camera[0]} applies to a camera that takes images; the instrument is {instrument}: leave it out"
        )
    require(
        not answers.reference or _measures(answers) in (Poses.kind, Positions.kind),
        f"--reference applies to a target's pose or position; the instrument is {instrument}: leave it out",
        UsageError,
    )
    dynamics = answers.dynamics is not False
    for goal in answers.goals:
        checked_goal(goal)
    of_dynamics = {
        "payload": answers.payloads,
        "torques": answers.torques,
        "goal": answers.goals,
        "period": answers.period,
        "front": answers.front,
        "tolerance-percent": answers.tolerance_percent,
        "tolerance-torque": answers.tolerance_torque,
    }
    for option, answer in of_dynamics.items():
        require(
            dynamics or not answer, f"--{option} applies to the dynamics, which --geometry-only excludes", UsageError
        )

    limits: Path | dict[str, object] | None = answers.limits
    if answers.limits is None:
        limits = cell_tables(**answers.cell) or None
    else:
        require(answers.limits.exists(), f"--limits {answers.limits}: no such file", UsageError)
        if answers.cell:
            first = next(iter(answers.cell))
            option = first.replace("_", "-").replace("obstacles", "obstacle")
            raise UsageError(f"--{option} and --limits both describe the cell; state it in {answers.limits} only")

    optional = {
        "payloads": stated_payloads(answers.payloads),
        "certificate": asdict(answers.certificate),
        "reference": answers.reference,
        "tool": answers.tool,
        "program": answers.program,
        "torques": answers.torques,
        "goals": list(answers.goals),
        "period": answers.period,
        "front": answers.front,
        "tolerance_mm": answers.tolerance_mm,
        "tolerance_percent": answers.tolerance_percent,
        "tolerance_torque": _joint_tolerances(answers.tolerance_torque or NONE),
    }
    result = {"robot": robot, "instrument": instrument, "dynamics": dynamics, "limits": limits}
    return result | {name: value for name, value in optional.items() if value and value != NONE}


def stated_payloads(texts: Sequence[str]) -> dict[str, dict[str, object]]:
    """Return the payloads of a session by label, from answers such as ``loaded=3.28 at 0,0,0.05``.

    Args:
        texts: the answers, each ``label``, ``label=kg`` or ``label=kg at x,y,z``.

    Raises:
        UsageError: for an invalid answer, or a label that is stated twice.
    """
    payloads: dict[str, dict[str, object]] = {}
    for text in texts:
        label, payload = _payload(text)
        require(
            label not in payloads, f"--payload {text}: '{label}' is stated twice; give each payload a label", UsageError
        )
        payloads[label] = payload
    with refused_as(UsageError, ValueError, "--payload: {}"):
        check_labels(payloads)
    return payloads


def _joint_tolerances(text: str) -> list[float]:
    """Return the tolerances of the joints' torques [N m or N] from numbers with commas; an empty list for "none"."""
    if _plain(text) in (*UNSAID, NONE):
        return []
    message = f"--tolerance-torque {text}: expected a number, or one per joint with commas, e.g. 2,2,1,0.5"
    with refused_as(UsageError, ValueError, message):
        return [Real(least=0, quantity="1").read(part) for part in text.split(",")]


def _payload(text: str) -> tuple[str, dict[str, object]]:
    """Return label and keys of a payload.

    Args:
        text: ``label``, ``label=kg`` or ``label=kg at x,y,z`` with the centre of mass in the tip's frame [m].
    """
    labelled_mass, _, position = text.partition(" at ")
    label, equals, mass = (part.strip() for part in labelled_mass.partition("="))
    payload: dict[str, object] = {}
    try:
        require(label.isidentifier(), f"'{label}' is no label: letters, digits and _ only", ValueError)
        if equals:
            payload["mass"] = Real(above=0, most=MAX_MASS, unit="kg", quantity="1").read(mass.removesuffix("kg"))
        if position:
            payload["com"] = _lengths(position, 3, MAX_HELD)
    except ValueError as fault:
        form = "label=kg, e.g. loaded=3.28, label=kg at x,y,z with the centre of mass in the tip's frame [m], or label"
        raise UsageError(
            f"--payload {text}: {fault}; expected {form} (the label goes into the file's name; what is not stated is "
            "identified)"
        ) from None
    return label, payload


NONE = "none"
# [m]: of an instrument, a cell, a tool; beyond, numbers are millimetres
MAX_FAR, MAX_WIDE, MAX_HELD = 100.0, 10.0, 3.0
# what the answer "none" says is not there
ABSENT = {"instrument_at": "instrument", "box": "box", "obstacles": "obstacles"}


def cell_tables(**answers: str | Sequence[str] | None) -> dict[str, object]:
    """Return the content of a limits file that follows from the answers about the cell; empty without such answers.

    The answer "unknown" to a question means that the subject is not checked, which the certificate states. The answer
    "none" means that the object does not exist, so that nothing has to be checked.

    Args:
        answers: answers by the field names of `calib.procedure.answers.Answers`.

    Raises:
        UsageError: for an invalid answer; the message states the valid form.
    """
    texts = {}
    absent = []
    for name, answer in answers.items():
        text = answer if isinstance(answer, str) else ";".join(answer or ())
        if name in ABSENT and _plain(text) == NONE:
            absent.append(ABSENT[name])
        if _plain(text) not in (*UNSAID, NONE):
            texts[name] = text.strip()
    require("cone" not in texts or "instrument_at" in texts, "--cone needs --instrument-at, too", UsageError)

    tables: ParsedTable = {}
    if absent:
        tables["without"] = absent
    for name, text in texts.items():
        path, read = _KEYS[name]
        table, _, key = path.partition(".")
        try:
            # the placement of camera and board depends on which of them the arm carries
            value = read(text, texts) if name in ("carried", "stands") else read(text)
        except ValueError as error:
            option = "obstacle" if name == "obstacles" else name.replace("_", "-")
            raise UsageError(f"--{option} {text}: {error}, or the word unknown") from None
        if key:
            tables[table] = tables.get(table, {}) | {key: value}
        else:
            tables[table] = value
    if "camera" in tables:
        tables["camera"] = dict.fromkeys(CAMERA, "unknown") | tables["camera"]
    parse(ConstraintsFile, tables, "the cell")
    return tables


def _plain(text: str) -> str:
    return text.strip().lower()


def _lengths(text: str, count: int, most: float, expected: str = "x,y,z in metres") -> list[float]:
    values = [Real(least=-most, most=most, unit="m", quantity="length").read(part) for part in text.split(",")]
    require(len(values) == count, f"expected {expected}", ValueError)
    return values


def _direction(text: str) -> str | list[float]:
    """Return a direction given as the name of an axis (lower case), or as three numbers.

    Raises:
        ValueError: for another text.
    """
    if text.lower() in AXES:
        return text.lower()
    with refused_as(ValueError, ValueError, f"expected {', '.join(AXES)}, or three numbers"):
        return [Real(quantity="1").read(part) for part in text.split(",")]


def _box(text: str) -> list[list[float]]:
    """Return the ranges along x, y and z of a box around the robot [m].

    Args:
        text: the answer, ``x,x,y,y,z,z``.

    Raises:
        ValueError: for another form, or if the base is outside the box.
    """
    sides = _lengths(text, 6, MAX_WIDE, "x,x,y,y,z,z in metres, the smaller one first")
    ranges = [sides[k : k + 2] for k in (0, 2, 4)]
    if any(low >= high for low, high in ranges):
        raise ValueError("expected x,x,y,y,z,z in metres, the smaller one first")
    horizontal = ranges[:2]
    if not all(low <= 0.0 <= high for low, high in horizontal):
        raise ValueError("the robot's base, at 0,0, is outside the box; coordinates are in the base frame")
    return ranges


def _obstacles(text: str) -> list[dict[str, object]]:
    """Return the tables of obstacles, given as texts separated by semicolons.

    Raises:
        ValueError: for an obstacle of another form.
    """
    form = "NAME box|sphere|cylinder SIZES at X,Y,Z in metres, e.g. table box 1.2,0.8,0.05 at 0.7,0,-0.03"
    length = Real(above=0, most=MAX_WIDE, unit="m", quantity="length")
    tables = []
    for obstacle in text.split(";"):
        if _plain(obstacle) in (*UNSAID, NONE):
            continue
        parts = obstacle.replace(" at ", " ").split()
        require(len(parts) == 4, f"expected {form}", ValueError)
        name, kind, sizes, position = parts
        size = [length.read(part) for part in sizes.split(",")]
        tables.append({"name": name, "kind": kind, "size": size, "xyz": _lengths(position, 3, MAX_WIDE)})
    return tables  # ty: ignore[invalid-explicit-return]


def _mounting(text: str) -> str:
    return OneOf((IN_HAND, TO_HAND)).read(text.lower().replace("-", " ").replace("_", " "))


def _file(read: Callable[[Path], object], text: str) -> str:
    """Return the path of a lens or board file, after checking that it can be read.

    Args:
        read: function that reads the file.
        text: the path, or a folder with a board file.
    """
    path = Path(text).expanduser()
    path = path / BOARD if read is read_board and path.is_dir() else path
    require(path.is_file(), "no such file; give an existing one", ValueError)
    read(path)
    return str(path)


def _turned(name: str, most: float, text: str, answers: dict[str, str]) -> dict[str, list[float]]:
    """Return the placement (xyz, rpy) of a camera or board, given as a position and the direction that it faces.

    The z axis of a camera is along its viewing direction, and the z axis of a board is opposite to the direction that
    it faces.

    Args:
        name: ``carried`` (on the arm) or ``stands`` (fixed).
        most: largest allowed coordinate [m].
        text: the answer, such as ``0.5,0,0 facing z``.
        answers: all answers; ``mounting`` states whether the arm carries the camera or the board.

    Raises:
        ValueError: for an invalid answer.
    """
    require(
        "mounting" in answers,
        "it is not known whether the arm carries the camera or the board; give --mounting, too",
        ValueError,
    )
    position, _, facing = text.partition("facing")
    if not facing.strip() and name == "stands":
        raise ValueError("expected x,y,z in metres and a direction, e.g. 0.5,0,0 facing z")
    direction = _direction(facing.strip() or "z")
    axis = np.array(AXES[direction] if isinstance(direction, str) else direction)
    if axis.shape != (3,) or not axis.any():
        raise ValueError("expected an axis of the frame (x, -z …) or three numbers after facing")
    # the board looks against its normal
    is_camera = (_mounting(answers["mounting"]) == IN_HAND) == (name == "carried")
    if not is_camera:
        axis = -axis
    rotation = Rotation.align_vectors([axis], [[0.0, 0.0, 1.0]])[0]
    xyz, rpy = to_xyz_rpy(pose(rotation.as_matrix(), _lengths(position.strip(), 3, most)))
    return {"xyz": [float(x) for x in xyz], "rpy": [round(float(x), 6) for x in rpy]}


def _cone(text: str) -> str:
    """Return the half angle `text` of a cone with its unit; an angle without a unit is in degrees."""
    return text if any(map(str.isalpha, text)) else f"{text} deg"


_KEYS: dict[str, tuple[str, Callable[..., object]]] = {  # of the limits file, and how the answer is read
    "instrument_at": ("instrument.xyz", partial(_lengths, count=3, most=MAX_FAR)),
    "cone": ("instrument.sight", _cone),
    "facing": ("target.facing", _direction),
    "box": ("collision.box", _box),
    "obstacles": ("obstacle", _obstacles),
    "mounting": ("camera.mounting", _mounting),
    "lens": ("camera.lens", partial(_file, read_lens)),
    "board": ("camera.board", partial(_file, read_board)),
    "carried": ("camera.carried", partial(_turned, "carried", MAX_HELD)),
    "stands": ("camera.stands", partial(_turned, "stands", MAX_FAR)),
}

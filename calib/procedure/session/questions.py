"""What `calib new` needs to know: instruments by name, options or questions at a terminal, each answer checked."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from calib.config import described, parse
from calib.errors import UsageError, require
from calib.procedure.measuring.cell_answers import UNKNOWN, cell_tables
from calib.procedure.session.answers import CAMERA, CELL, Answers
from calib.procedure.session.settings import NOTHING
from calib.robot.load import resolve

MAX_MASS = 2000.0  # [kg]: of a payload (our choice)


@dataclass(frozen=True)
class InstrumentPreset:
    """An instrument's starting values in ``session.toml``.

    Attributes:
        label: its name for people.
        measures: ``pose``, ``position`` or ``pixels``.
        sigma_position, sigma_orientation: of one measurement, per axis [m], [rad]; 0: to be estimated.
        source: where the sigmas come from.
    """

    label: str
    measures: str
    sigma_position: float
    sigma_orientation: float
    source: str


INSTRUMENTS = {
    "cmm": InstrumentPreset(
        "optical CMM", "pose", 60e-6, 0.2e-3, "Nikon K610: 60 µm volumetric; orientation our guess"
    ),
    "tracker": InstrumentPreset(
        "laser tracker", "position", 20e-6, 0.0, "about 15 µm + 6 µm/m in a small cell; our guess"
    ),
    "tracker6d": InstrumentPreset("laser tracker, 6-D probe", "pose", 30e-6, 0.1e-3, "our guess"),
    "mocap": InstrumentPreset("motion capture", "pose", 0.0, 0.0, "estimated from the residuals"),
    "camera": InstrumentPreset("camera and board", "pixels", 0.0, 0.0, "estimated from the residuals"),
    "camera-poses": InstrumentPreset(
        "camera and board", "pose", 0.0, 0.0, "poses by another program; estimated from the residuals"
    ),
    "none": InstrumentPreset("no instrument", NOTHING, 0.0, 0.0, "dynamics alone"),
    "other-pose": InstrumentPreset("instrument", "pose", 0.0, 0.0, "estimated from the residuals"),
    "other-position": InstrumentPreset("instrument", "position", 0.0, 0.0, "estimated from the residuals"),
}


def instrument_named(name: str) -> InstrumentPreset:
    """Return an instrument by name.

    Raises:
        UsageError: with the names there are.
    """
    if name not in INSTRUMENTS:
        known = ", ".join(f"{key} ({each.label}, {each.measures})" for key, each in INSTRUMENTS.items())
        raise UsageError(f"no instrument '{name}'; there are {known}")
    return INSTRUMENTS[name]


def by_nothing(given: Answers) -> bool:
    """Say whether the geometry is taken as it is described."""
    return _measures(given) == NOTHING


def by_camera(given: Answers) -> bool:
    """Say whether images are taken: where the camera is takes more than a place."""
    return _measures(given) == "pixels"


def _measures(given: Answers) -> str:
    return INSTRUMENTS[given.instrument].measures if given.instrument in INSTRUMENTS else ""


@dataclass(frozen=True)
class Question:
    """One question: which answer it is about, what an empty answer means, and when it is put."""

    name: str
    default: str
    applies: Callable[[Answers], bool] = lambda given: True

    @property
    def words(self) -> str:
        """What is asked, as the option's help says it."""
        return f"{self.name.replace('_', ' ')} ({described(Answers)[self.name]})"

    def open(self, given: Answers) -> bool:
        """Say whether it is to be put."""
        return getattr(given, self.name) in (None, ()) and self.applies(given)


def _about_camera(given: Answers, name: str) -> bool:
    """Put a question on a camera where no file states it, once it is known what the arm carries."""
    known = name == "mounting" or (given.mounting or "").lower() not in UNKNOWN
    return by_camera(given) and given.limits is None and known


def _about_cell(given: Answers, name: str) -> bool:
    """Put a question on the cell where no file states it, and on the target's cone where the instrument is known."""
    known = name not in ("cone", "facing") or "instrument" in cell_tables(instrument_at=given.instrument_at)
    return given.limits is None and known and not (name == "instrument_at" and (by_camera(given) or by_nothing(given)))


QUESTIONS = (
    Question("robot", ""),
    Question("instrument", "tracker"),
    Question("tool", "0.05,0,0.05", lambda given: not (by_camera(given) or by_nothing(given))),
    Question("limits", "none", lambda given: not given.cell),
    *(Question(name, "unknown", partial(_about_camera, name=name)) for name in CAMERA),
    *(
        Question(name, "z" if name == "facing" else "unknown", partial(_about_cell, name=name))
        for name in CELL
        if name not in CAMERA
    ),
    Question("dynamics", "yes", lambda given: not by_nothing(given)),
    Question("torques", "motor", lambda given: given.dynamics is not False),
    Question("payloads", "none", lambda given: given.dynamics is not False),
)


def with_answer(given: Answers, question: Question, text: str) -> Answers:
    """Return the answers with one more.

    Raises:
        UsageError: where it cannot be one, with what can.
    """
    name, empty = question.name, text.lower() in ("", "none", "-")
    values: dict[str, Any] = {
        "tool": text.split(","), "limits": None if empty else text, "payloads": [] if empty else text.split(),
        "obstacles": [text], "dynamics": {"y": True, "n": False}.get(text[:1].lower(), text),
    }  # fmt: skip
    found = replace(given, **{name: getattr(parse(Answers, {name: values.get(name, text)}, ""), name)})
    if name == "robot":
        require(text, "a robot is needed", UsageError)
        resolve(text)
    checked(replace(found, robot=found.robot or "", instrument=found.instrument or "tracker"))
    return found


def checked(given: Answers) -> dict[str, Any]:
    """Return the arguments of `calib.api.sessions.new_session`.

    Raises:
        UsageError: for an answer that cannot be.
    """
    robot, instrument = given.robot, given.instrument
    require(robot is not None and instrument is not None, "a robot and an instrument are needed", UsageError)
    instrument_named(instrument or "")
    told = next((name for name in CAMERA if getattr(given, name) is not None), None)
    require(
        by_camera(given) or not told, f"--{told} is about a camera that takes images; the instrument is {instrument}"
    )
    dynamics = given.dynamics is not False
    words = "--payload and --torques are about the dynamics, which --geometry-only leaves out"
    require(dynamics or not (given.payloads or given.torques), words, UsageError)
    result = {"robot": robot, "instrument": instrument, "dynamics": dynamics, "limits": given.limits}
    if given.limits is not None:
        require(given.limits.is_file(), f"--limits {given.limits}: no such file", UsageError)
        option = next(iter(given.cell), "").replace("_", "-").replace("obstacles", "obstacle")
        words = f"--{option} and --limits both say what the cell is like; put it into {given.limits}"
        require(not given.cell, words, UsageError)
    else:
        result["limits"] = cell_tables(**given.cell) or None
    stated = {"tool": given.tool, "torques": given.torques, "payloads": dict(map(_payload, given.payloads))}
    return result | {name: value for name, value in stated.items() if value}


def _payload(text: str) -> tuple[str, float]:
    label, _, mass = text.partition("=")
    try:
        value = float(mass.removesuffix("kg"))
    except ValueError:
        value = float("nan")
    words = f"--payload {text}: expected label=kg, e.g. loaded=3.28 (the label goes into the file's name)"
    require(label.isidentifier() and 0.0 < value < MAX_MASS, words, UsageError)
    return label, value

"""What `calib new` needs to know: instruments by name, options or questions at a terminal, each answer checked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import UsageError
from calib.procedure.measuring.cell_answers import CAMERA, UNKNOWN, cell_tables
from calib.procedure.session.settings import NOTHING, TORQUES
from calib.robot import library
from calib.robot.load import resolve


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


@dataclass(frozen=True)
class Answers:
    """Options of `calib new` as they were typed; None where nothing was said."""

    robot: str | None = None
    instrument: str | None = None
    tool: str | None = None
    limits: Path | None = None
    dynamics: bool | None = None
    payloads: tuple[str, ...] = ()
    torques: str | None = None
    instrument_at: str | None = None
    cone: str | None = None
    facing: str | None = None
    box: str | None = None
    obstacles: tuple[str, ...] | None = None
    mounting: str | None = None
    lens: str | None = None
    board: str | None = None
    carried: str | None = None
    stands: str | None = None

    @property
    def cell(self) -> dict[str, Any]:
        """What was said of the cell."""
        return {name: value for name in CELL if (value := getattr(self, name)) is not None}

    @property
    def by_nothing(self) -> bool:
        """Whether the geometry is taken as it is described."""
        return self.instrument in INSTRUMENTS and INSTRUMENTS[self.instrument].measures == NOTHING

    @property
    def by_camera(self) -> bool:
        """Whether images are taken: where the camera is takes more than a place."""
        return self.instrument in INSTRUMENTS and INSTRUMENTS[self.instrument].measures == "pixels"


@dataclass(frozen=True)
class _Question:
    """One question: which answer it is about, its words, what an empty answer means, and when it is put."""

    name: str
    words: str
    default: str
    open: Callable[[Answers], bool]


def _unanswered(name: str) -> Callable[[Answers], bool]:
    return lambda given: getattr(given, name) is None


def _of_the_cell(name: str) -> Callable[[Answers], bool]:
    """Put a question on the cell where no file states it, and on the target's cone where the instrument is known."""
    known = "instrument" if name in ("cone", "facing") else ""

    def is_open(given: Answers) -> bool:
        told = not known or known in cell_tables(given.instrument_at)
        asked = name != "instrument_at" or not (given.by_camera or given.by_nothing)
        return given.limits is None and getattr(given, name) is None and told and asked

    return is_open


def _of_the_camera(name: str, mounting: str = "") -> Callable[[Answers], bool]:
    """Put a question on a camera where no file states it, once it is known what the arm carries."""

    def is_open(given: Answers) -> bool:
        how = (given.mounting or "").lower().replace("-", " ")
        told = name == "mounting" or how == mounting or (not mounting and how not in UNKNOWN)
        return given.by_camera and given.limits is None and getattr(given, name) is None and told

    return is_open


CELL = ("instrument_at", "cone", "facing", "box", "obstacles", *CAMERA)
QUESTIONS = (
    _Question("robot", f"robot (.urdf, .toml, or {' '.join(library.names())})", "", _unanswered("robot")),
    _Question("instrument", f"instrument ({' '.join(INSTRUMENTS)})", "tracker", _unanswered("instrument")),
    _Question(
        "tool", "where the target sits in the tip's frame, x,y,z [m]", "0.05,0,0.05",
        lambda given: given.tool is None and not (given.by_camera or given.by_nothing),
    ),
    _Question(
        "limits", "file that states the cell: instrument, obstacles, speeds (none: asked for now)", "none",
        lambda given: given.limits is None and not given.cell and not given.by_camera,
    ),
    _Question(
        "limits", "file that states the cell, [camera] with it: lens, board, roughly where both are (none: asked for "
        "now)", "none", lambda given: given.limits is None and not given.cell and given.by_camera,
    ),
    _Question(
        "mounting", "what the arm carries: the camera (in hand), or the board (to hand); unknown: whether poses see "
        "the board is not checked", "unknown", _of_the_camera("mounting"),
    ),
    _Question("lens", "the lens: a camera_info YAML, roughly right (unknown)", "unknown", _of_the_camera("lens")),
    _Question("board", "the board's board.toml, of calib board (unknown)", "unknown", _of_the_camera("board")),
    _Question(
        "carried", "where the camera roughly sits in the tip's frame, and looks: x,y,z facing z [m] (unknown)",
        "unknown", _of_the_camera("carried", "in hand"),
    ),
    _Question(
        "carried", "where the board's middle roughly sits in the tip's frame, and faces: x,y,z facing z [m] (unknown)",
        "unknown", _of_the_camera("carried", "to hand"),
    ),
    _Question(
        "stands", "where the board's middle roughly is in the robot's base frame, and faces: 0.5,0,0 facing z [m] "
        "(unknown)", "unknown", _of_the_camera("stands", "in hand"),
    ),
    _Question(
        "stands", "where the camera roughly stands in the robot's base frame, and looks: 1.5,0,0.5 facing -x [m] "
        "(unknown)", "unknown", _of_the_camera("stands", "to hand"),
    ),
    _Question(
        "instrument_at", "where the instrument roughly stands, x,y,z [m] in the robot's base frame (unknown; none: "
        "it sees from everywhere)", "unknown", _of_the_cell("instrument_at"),
    ),
    _Question(
        "cone", "half angle of the cone in which the target sees it [deg] (a reflector: 30; unknown)", "unknown",
        _of_the_cell("cone"),
    ),
    _Question("facing", "the direction the target faces in the tip's frame (x, -z …)", "z", _of_the_cell("facing")),
    _Question(
        "box", "box that no part of the arm leaves, x,x,y,y,z,z [m] in its base frame (unknown; none)", "unknown",
        _of_the_cell("box"),
    ),
    _Question(
        "obstacles", "what stands there: table box 1.2,0.8,0.05 at 0.7,0,-0.03; … [m], middles (unknown; none)",
        "unknown", _of_the_cell("obstacles"),
    ),
    _Question(
        "dynamics", "identify the dynamics, too (yes, no)", "yes",
        lambda given: given.dynamics is None and not given.by_nothing,
    ),
    _Question(
        "torques", "torques in the log (motor, link, both)", "motor",
        lambda given: given.dynamics is not False and given.torques is None,
    ),
    _Question(
        "payloads", "payloads to record with as well, label=kg (none)", "none",
        lambda given: given.dynamics is not False and not given.payloads,
    ),
)  # fmt: skip


def with_answer(given: Answers, question: _Question, text: str) -> Answers:
    """Return the answers with one more.

    Raises:
        UsageError: where it cannot be one, with what can.
    """
    empty = text.lower() in ("", "none", "-")
    if question.name == "dynamics":
        if text.lower() not in ("yes", "no", "y", "n"):
            raise UsageError(f"'{text}': yes or no")
        return replace(given, dynamics=text.lower().startswith("y"))
    values: dict[str, Any] = {
        "limits": None if empty else Path(text),
        "payloads": () if empty else tuple(text.split()),
        "obstacles": (text,),
    }
    found = replace(given, **{question.name: values.get(question.name, text)})
    if question.name == "robot":
        resolve(text) if text else _fail("a robot is needed")
    checked(replace(found, robot=found.robot or "", instrument=found.instrument or "tracker"))
    return found


def _fail(words: str) -> None:
    raise UsageError(words)


def checked(given: Answers) -> dict[str, Any]:
    """Return the arguments of `calib.procedure.session.commands.begin`.

    Raises:
        UsageError: for an answer that cannot be.
    """
    robot, instrument = given.robot, given.instrument
    if robot is None or instrument is None:
        raise UsageError("a robot and an instrument are needed")
    instrument_named(instrument)
    dynamics = given.dynamics is not False
    result: dict[str, Any] = {"robot": robot, "instrument": instrument, "dynamics": dynamics}
    if given.tool is not None:
        result["tool"] = _place(given.tool)
    if not given.by_camera and (told := [name for name in CAMERA if getattr(given, name) is not None]):
        raise UsageError(f"--{told[0]} is about a camera that takes images; the instrument is {instrument}")
    if given.limits is not None:
        if not given.limits.is_file():
            raise UsageError(f"--limits {given.limits}: no such file")
        if given.cell:
            told = next(iter(given.cell)).replace("_", "-").replace("obstacles", "obstacle")
            raise UsageError(f"--{told} and --limits both say what the cell is like; put it into {given.limits}")
        result["limits"] = given.limits
    elif tables := cell_tables(**given.cell):
        result["limits"] = tables
    if given.torques is not None:
        if given.torques not in TORQUES:
            raise UsageError(f"--torques {given.torques}: expected {', '.join(TORQUES)}")
        result["torques"] = given.torques
    if given.payloads:
        result["payloads"] = dict(_payload(text) for text in given.payloads)
    if not dynamics and (given.payloads or given.torques):
        raise UsageError("--payload and --torques are about the dynamics, which --geometry-only leaves out")
    return result


def _place(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3 or not np.isfinite(values).all():
        raise UsageError(f"--tool {text}: expected x,y,z in metres")
    if max(map(abs, values)) > 3.0:
        raise UsageError(f"--tool {text}: {max(map(abs, values)):g} m from the flange? These look like mm; give metres")
    return values


def _payload(text: str) -> tuple[str, float]:
    label, _, mass = text.partition("=")
    try:
        value = float(mass.removesuffix("kg"))
    except ValueError:
        value = float("nan")
    if not label.isidentifier() or not 0.0 < value < 2000.0:
        raise UsageError(f"--payload {text}: expected label=kg, e.g. loaded=3.28 (the label goes into the file's name)")
    return label, value

"""Settings of a session, ``session.toml``: robot, instrument, poses, fit and dynamics.

Lengths are in m, angles in rad. The dataclasses of this module define every key with its allowed values, default and
comment.
"""

from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from operator import attrgetter
from pathlib import Path, PurePath
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated, get_type_hints

import rtoml

from calib.config import described, parse, read_toml, strict
from calib.config_types import Checked, Expect, Flag, Holdout, Name, NotNegative, OneOf, Seed, Text, Whole, shown
from calib.data.poses import Loss, Model
from calib.data.poses.fit_options import FitOptions, MetresOrZero, RadiansOrZero
from calib.data.poses.measurements import Poses, Positions
from calib.errors import SessionError
from calib.identification.friction.friction_ladder import NAMES as FRICTION
from calib.identification.registry import METHODS
from calib.identification.settings import IdentificationSettings, Payload, mass_as_payload
from calib.procedure.answers import CertificateSection, Torques
from calib.procedure.excitation.settings import (
    DEFAULT_DESIGN,
    HARMONICS,
    Evaluations,
    Front,
    Goal,
    HardGoal,
    Harmonics,
    Period,
    Rate,
    Starts,
)
from calib.procedure.kinematic_stage.settings import (
    DEFAULT_SELECTION,
    Deliverable,
    FitSettings,
    Index,
    Method,
    Stations,
)
from calib.procedure.session.recording_names import check_labels

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

# version of ``session.toml``, and those that can be read: a session of schema 1 knows no dynamics; it goes on as
# geometry alone
SCHEMA = 2
READABLE_SCHEMAS = (1, SCHEMA)
# is measured: the geometry is taken as it is described
NOTHING = "nothing"
# of a designed motion (our choice): 160 MB per joint and derivative
MAX_SAMPLES = 20_000_000
# letters of a file's name
MAX_NAME = 200
# where comments begin and end
COLUMN, WIDTH = 41, 118

FILES = ("robot.file", "poses.constraints", "fit.options", "dynamics.limits", "dynamics.options")
_HEAD = (
    "A calibration session; see `calib status` and `calib next`. Lengths in m, angles in rad.",
    "All values may be changed: steps that depend on a changed value become stale and are repeated.",
)


def _beside(value: object) -> object:
    """Return a value unchanged after a check that a text is a relative path, which is next to ``session.toml``.

    Raises:
        ValueError: for an absolute or too long path.
    """
    if not isinstance(value, str):
        return value
    if PurePath(value).is_absolute() or len(value) > MAX_NAME or "\0" in value:
        raise ValueError(f"expected a file next to session.toml, found {shown(value)}; copy it there and give its name")
    return value


Beside = Annotated[str, Expect("the name of a file next to session.toml, or an empty text"), Checked(_beside)]


@strict
@dataclass(frozen=True)
class RobotSection:
    """Section ``[robot]``: the robot and its file.

    Attributes:
        file: description of the robot, beside session.toml
        given: name or file as given to calib new
        base: URDF: first link of the arm; empty: the root
        tip: URDF: last link of the arm; empty: its flange
        controller: whose program of the poses is written beside them, as krl; see `calib program --list`
        external: joints that are the controller's external axes, where names and kinds do not tell
    """

    file: Annotated[Name, Checked(_beside)]
    given: Text = ""
    base: Text = ""
    tip: Text = ""
    controller: Text = ""
    external: tuple[Name, ...] = ()


@strict
@dataclass(frozen=True)
class InstrumentSection:
    """Section ``[instrument]``: the measuring instrument, and its σ.

    Attributes:
        name: what it is called
        measures: pose (position and orientation), position or pixels; nothing: the geometry is not fitted
        sigma_position: standard deviation of one measurement, per axis [m]; 0: estimated from the residuals
        sigma_orientation: standard deviation of one measurement, per axis [rad]; 0: estimated from the residuals
        reference: true: a frame on the robot's base is measured with every row (columns base_x …), and the target is
            seen from there
        tool: approximate position of the target in the tip's frame; for pose selection only
    """

    name: Text
    measures: Annotated[str, OneOf(("pose", "position", "pixels", NOTHING))]
    sigma_position: MetresOrZero = 0.0
    sigma_orientation: RadiansOrZero = 0.0
    tool: Annotated[tuple[float, float, float], Expect("three numbers [m]")] = (0.05, 0.0, 0.05)
    reference: Flag = False

    def __post_init__(self) -> None:
        if self.reference and self.measures not in (Poses.kind, Positions.kind):
            raise ValueError(
                f"reference = true applies to poses and positions; the instrument measures {self.measures}"
            )


@strict
@dataclass(frozen=True)
class PosesSection:
    """Section ``[poses]``: number and limits of the poses to measure.

    Attributes:
        fit: number of poses to choose for the fit
        validation: number of additional poses, never fitted; 0: no validation
        plan: true: poses are chosen, and are measured; false: none are chosen, the measured files contain any poses
        index: observability index that the chosen poses maximise
        method: search method for the poses
        constraints: a TOML file next to this one; see `calib formats constraints`
    """

    fit: Annotated[int, Whole(1)] = 30
    validation: Annotated[int, Whole(0)] = 15
    plan: Flag = True
    index: Index = DEFAULT_SELECTION.index
    method: Method = DEFAULT_SELECTION.method
    constraints: Beside = ""


@strict
@dataclass(frozen=True)
class FitSection:
    """Section ``[fit]``: fit and validation of the geometry.

    Attributes:
        model: or {others}
        loss: or {others}; auto: robust if rows are grossly wrong
        options: a TOML file next to this one: column names, units; see `calib formats options`
        stations: base placements of the robot: each (one per measured file) or one (the same for all files)
        validation_frames: base and tool placement of validation files: fit (as fitted) or own (fitted anew)
        tolerance_mm: largest accepted rms [mm] on unseen poses, above it the verdict is fail; 0: none, and
            pass only means better than the nominal robot
        deliverable: what the verdict rates: robot.urdf alone, or corrections: with joint_corrections.csv
        holdout: share of the measured poses that is held out if there is no validation file; 0: none
        rounds: how often identified masses may return into the gravity torques of a fit with compliance, while
            geometry or dynamics still moves by more than a tenth of its sigma; 0: never
    """

    model: Model = FitOptions.model
    loss: Loss = FitOptions.loss
    options: Beside = ""
    stations: Stations = FitSettings.stations
    validation_frames: Annotated[str, OneOf(("fit", "own"))] = "fit"
    tolerance_mm: NotNegative = 0.0
    deliverable: Deliverable = FitSettings.deliverable
    holdout: Holdout = FitSettings.holdout
    rounds: Annotated[int, Whole(0, 20)] = 3


def _as_list(value: object) -> object:
    """Return a number as a list with it; other values unchanged."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return [value]
    return value


@strict
@dataclass(frozen=True)
class DynamicsSection:
    """Section ``[dynamics]``: identification and validation of the dynamics.

    Attributes:
        wanted: true: identify the dynamics, too; false: geometry only
        plan: true: the designed motions are recorded; false: the recordings contain other motions
        validation: true: a second motion is recorded for validation; false: none is requested
        period: of the designed motion [s]; the validation motion's is 0.8 of it
        harmonics: number of frequencies per joint
        rate: of the controller [Hz]
        goals, hard, front: of the training motion, see calib excite --help
        repeats: number of repetitions of each motion
        starts: number of random starts of the search for a motion
        evaluations: largest number of motions that are evaluated per start
        limits: a TOML file next to this one; see `calib formats limits`
        torques: motor, link (sensors behind the gears), or both
        friction: or standard, or one step of the ladder; see `calib formats identify-options`
        method: or ols, irls, tls, …; see calib study --list-methods
        with_geometry: true: joint offsets, lengths and the direction of gravity are estimated again from torques,
            together with the dynamics
        options: a TOML file next to this one; see `calib formats identify-options`; for methods with a [loop] the
            designed motion is the reference of recordings without columns q_ref
        holdout: share at the end of each recording that is held out if there is no validation recording; 0:
            none
        tolerance_percent: largest accepted torque error of the exported robot on unseen motion [%]; 0: none
        tolerance_torque: largest accepted rms error of each joint's torque on unseen motion [N m or N]: one number per
            joint (0: none), or one for all joints; []: none
        sigma_percent: largest standard deviation of essential parameters that is wanted [%]; 0: none. Where joints are
            above tolerance_percent, or parameters above this, a further motion is designed (6-excitation/round2);
            with neither stated, the session's end names what is above 10 %
        payloads: bodies at the flange by label: mass [kg] and, if known, centre of mass in the tip's frame [m], as
            loaded = 3.28 or loaded = { mass = 3.28, com = [0, 0, 0.05] }; what is not stated is identified
    """

    wanted: Flag = True
    plan: Flag = True
    validation: Flag = True
    period: Period = DEFAULT_DESIGN.period
    harmonics: Harmonics = HARMONICS
    rate: Rate = DEFAULT_DESIGN.rate
    goals: tuple[Goal, ...] = ()
    hard: tuple[HardGoal, ...] = ()
    front: Front = 0
    repeats: Annotated[int, Whole(1)] = 3
    starts: Starts = DEFAULT_DESIGN.starts
    evaluations: Evaluations = DEFAULT_DESIGN.evaluations
    limits: Beside = ""
    torques: Torques = "motor"
    friction: Annotated[str, OneOf(FRICTION)] = IdentificationSettings.friction
    method: Annotated[str, OneOf(tuple(METHODS))] = IdentificationSettings.method
    with_geometry: Flag = False
    options: Beside = ""
    holdout: Holdout = 0.0
    tolerance_percent: NotNegative = 0.0
    tolerance_torque: Annotated[tuple[NotNegative, ...], Checked(_as_list)] = ()
    sigma_percent: NotNegative = 0.0
    payloads: Mapping[str, Annotated[Payload, Checked(mass_as_payload)]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_labels(self.payloads)
        if self.repeats > MAX_SAMPLES / max(self.period * self.rate, 1e-300):  # a quotient: repeats may be huge
            raise ValueError(
                f"period {self.period:g} s at rate {self.rate:g} Hz, repeated {self.repeats} times, is more than "
                f"{MAX_SAMPLES:.0e} samples: lower one of them"
            )


@strict
@dataclass(frozen=True)
class SessionSettings:
    """The content of ``session.toml``, by sections.

    Attributes:
        name: of the robot, for titles
        created: when it was made, UTC
        schema: version of this file's form
        seed: of pose selection, cross-validation and all other random choices
        certificate: stated on the certificate besides results; what is empty is a line to fill in by hand
    """

    name: Text
    created: Text
    seed: Seed
    robot: RobotSection
    instrument: InstrumentSection
    poses: PosesSection
    fit: FitSection
    dynamics: DynamicsSection
    certificate: CertificateSection = field(default_factory=CertificateSection)
    schema: Annotated[int, Whole(1)] = SCHEMA


def read_settings(path: Path) -> SessionSettings:
    """Read ``session.toml`` at `path`; missing keys get their defaults, and files of schema 1 get no dynamics.

    Raises:
        SessionError: if the file was made by a newer version, is damaged, or has an invalid value.
    """
    table = read_toml(path, SessionError)
    check_schema(path, table.get("schema"))
    if table["schema"] == 1:
        table.setdefault("dynamics", {"wanted": False})
    settings = parse(SessionSettings, table, str(path), SessionError)
    for key in FILES:
        name = attrgetter(key)(settings)
        if name and (path.parent / name).is_dir():
            raise SessionError(f"{path}: {key}: expected a file, found the folder '{name}'")
    return settings


def check_schema(path: Path, schema: object) -> None:
    """Raise a SessionError, with advice, if this version cannot read the schema of a session's file.

    Args:
        path: the file, for the message.
        schema: the schema number in the file; None: the file has no such number.
    """
    if schema in READABLE_SCHEMAS and type(schema) is int:
        return
    if isinstance(schema, int) and schema > SCHEMA:
        raise SessionError(f"{path}: schema {schema} was made by a newer version; this one reads {SCHEMA}: upgrade")
    if schema is None:
        raise SessionError(
            f"{path} contains no key 'schema', maybe since it was truncated while copying; copy the session again"
        )
    readable = " and ".join(map(str, READABLE_SCHEMAS))
    raise SessionError(f"{path}: schema {shown(schema)} is unknown, this version reads {readable}; make a new session")


def default_keys(section: str) -> dict[str, object]:
    """Return the default values of a section of ``session.toml`` by key; empty if there is no such section."""
    kind = get_type_hints(SessionSettings).get(section)
    keys = fields(kind) if is_dataclass(kind) else ()
    return {key.name: key.default for key in keys if key.default is not MISSING}


def written(settings: SessionSettings) -> str:
    """Return the text of ``session.toml`` for the given settings, with a comment for every key."""
    lines = [f"# {line}" for line in _HEAD]
    lines.append(f"schema = {settings.schema}")
    lines += _lines(settings)
    return "\n".join(lines) + "\n"


def _lines(section: "DataclassInstance | type[DataclassInstance]", prefix: str = "") -> Iterator[str]:
    """Yield the lines of a section: first keys with comments aligned in one column, then tables.

    Args:
        section: the section, or its class for the default values.
        prefix: names of the sections that contain it, each followed by a dot; empty: none.
    """
    comments = described(type(section))
    tables = []
    for key in fields(section):
        value, comment = getattr(section, key.name), comments.get(key.name, "")
        if is_dataclass(value) or isinstance(value, Mapping):
            header = f"[{prefix}{key.name}]"
            tables += ["", *_with_comment(header, comment)]
            if is_dataclass(value):
                tables += _lines(value, f"{key.name}.")
            else:
                tables += [_mapping_line(name, entry) for name, entry in value.items()]
        elif key.name != "schema":
            yield from _with_comment(rtoml.dumps({key.name: value}).rstrip(), comment)
    yield from tables


def _with_comment(entry: str, comment: str) -> Iterator[str]:
    """Yield the line of an entry with its comment, which is continued below where it is long."""
    first, *further = wrap(comment, WIDTH - COLUMN) or [""]
    yield f"{entry:<{COLUMN - 3}} # {first}" if first else entry
    for line in further:
        yield f"{'':{COLUMN - 2}}# {line}"


def _mapping_line(name: str, entry: object) -> str:
    """Return the line of an entry whose name the user chose; a payload with a centre of mass becomes a table."""
    if isinstance(entry, Payload) and entry.mass is not None and entry.com is None:
        entry = entry.mass
    if not is_dataclass(entry):
        return rtoml.dumps({name: entry}).rstrip()
    key, _, _ = rtoml.dumps({name: 0}).partition(" =")
    values = {item.name: getattr(entry, item.name) for item in fields(entry)}
    keys = {key_name: value for key_name, value in values.items() if value is not None}
    return f"{key} = {{ {', '.join(rtoml.dumps(keys).splitlines())} }}"


def example() -> str:
    """Return the text of an example ``session.toml`` with every key."""
    settings = SessionSettings(
        name="",
        created="",
        seed=0,
        robot=RobotSection(""),
        instrument=InstrumentSection("", "pose"),
        poses=PosesSection(),
        fit=FitSection(),
        dynamics=DynamicsSection(),
    )
    return written(settings)

"""The settings of a session, ``session.toml``: what is to be calibrated, with what, how.

Lengths in m, angles in rad. Every key, what it may be, its default and its comment stand here and nowhere else.
"""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from operator import attrgetter
from pathlib import Path, PurePath
from textwrap import wrap
from typing import Annotated, Any, get_type_hints

import tomlkit
from tomlkit.items import Comment, Trivia

from calib.config import described, parse, read_toml, strict
from calib.config_types import (  # fmt: skip
    Checked,
    Expect,
    Flag,
    Holdout,
    Name,
    NotNegative,
    OneOf,
    Real,
    Seed,
    Text,
    Whole,
    shown,
)
from calib.data.poses.choices import Loss, Model
from calib.data.poses.fit_options import FitOptions, MetresOrZero, RadiansOrZero
from calib.errors import SessionError
from calib.identification.friction.friction_ladder import NAMES as FRICTION
from calib.identification.methods.registry import METHODS
from calib.identification.settings import IdentificationSettings
from calib.procedure.excitation.settings import DEFAULT_DESIGN, HARMONICS, Evaluations, Harmonics, Period, Rate, Starts
from calib.procedure.kinematic_stage.settings import (  # fmt: skip
    DEFAULT_SELECTION,
    Deliverable,
    FitSettings,
    Index,
    Method,
    Stations,
)
from calib.procedure.session.answers import Torques

SCHEMA = 2
READ = (1, SCHEMA)  # a session of schema 1 knows no dynamics; it goes on as geometry alone
NOTHING = "nothing"  # is measured: the geometry is taken as it is described
MAX_SAMPLES = 20_000_000  # of a designed motion (our choice): 160 MB per joint and derivative
FILES = ("robot.file", "poses.constraints", "fit.options", "dynamics.limits", "dynamics.options")
COLUMN, WIDTH = 41, 118  # where comments begin and end
_HEAD = (
    "A calibration session; see `calib status` and `calib next`. Lengths in m, angles in rad.",
    "Change what you like: steps made from something that changed are shown as stale and made again.",
)


def _beside(value: Any) -> Any:
    """Refuse a path from the root, and one that no file system takes."""
    if isinstance(value, str) and (PurePath(value).is_absolute() or len(value) > 200 or "\0" in value):
        raise ValueError(f"expected a file beside session.toml, found {shown(value)}; copy it there and give its name")
    return value


Beside = Annotated[str, Expect("the name of a file beside session.toml, or an empty text"), Checked(_beside)]


@strict
@dataclass(frozen=True)
class RobotSection:
    """Which robot.

    Attributes:
        given: what it was called
        base: URDF: the link the arm starts at, empty: the root
        tip: URDF: the link the arm ends at, empty: the longest chain's end
    """

    file: Annotated[Name, Checked(_beside)]
    given: Text = ""
    base: Text = ""
    tip: Text = ""


@strict
@dataclass(frozen=True)
class InstrumentSection:
    """What measures, and how well.

    Attributes:
        measures: pose (with orientation), position or pixels; nothing: the geometry is taken as it is described
        sigma_position: of one measurement, per axis; 0: to be estimated
        tool: where the target roughly sits in the tip's frame; only pose selection uses it
    """

    name: Text
    measures: Annotated[str, OneOf(("pose", "position", "pixels", NOTHING))]
    sigma_position: MetresOrZero = 0.0
    sigma_orientation: RadiansOrZero = 0.0
    tool: Annotated[tuple[float, float, float], Expect("three numbers [m]")] = (0.05, 0.0, 0.05)


@strict
@dataclass(frozen=True)
class PosesSection:
    """Which poses to measure.

    Attributes:
        fit: how many poses to choose for the fit
        validation: how many more to measure and never fit; 0: no validation
        plan: false: measured files hold other poses than those chosen here
        constraints: a TOML file beside this one; see `calib formats constraints`
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
    """How to fit and to judge the geometry.

    Attributes:
        model: or frames, offsets, geometry, stiffness, bending, coupling, harmonics, wobble
        loss: or none, huber, cauchy; auto: robust where rows are grossly wrong
        options: a TOML file beside this one: column names, units; see `calib formats options`
        stations: each measured file has its own base placement, or one for all
        validation_frames: own: base and tool placement are fitted anew on validation files
        tolerance_mm: largest rms [mm] on unseen poses that is good enough: above it the verdict is fail; 0: none, and
            pass only means better than the nominal robot
        deliverable: what the verdict is about: robot.urdf alone, or corrections: with joint_corrections.csv
        holdout: share of the measured poses that is not fitted but judged on, for want of a validation file; 0: none
    """

    model: Model = FitOptions.model
    loss: Loss = FitOptions.loss
    options: Beside = ""
    stations: Stations = FitSettings.stations
    validation_frames: Annotated[str, OneOf(("fit", "own"))] = "fit"
    tolerance_mm: NotNegative = 0.0
    deliverable: Deliverable = FitSettings.deliverable
    holdout: Holdout = FitSettings.holdout


@strict
@dataclass(frozen=True)
class DynamicsSection:
    """Whether and how to identify and to judge the dynamics.

    Attributes:
        wanted: false: geometry only
        plan: false: recorded files hold other motions than those designed here
        validation: false: no second motion is designed or asked for
        period: of the designed motion [s]; the validation motion's is 0.8 of it
        harmonics: frequencies per joint
        rate: of the controller [Hz]
        repeats: how often the robot plays each motion
        starts: random starts of the search for a motion
        evaluations: most per start
        limits: a TOML file beside this one; see `calib formats limits`
        torques: motor, link, or both: sensors behind the gears beside the motors' torques
        friction: or standard, or one rung of the ladder; see calib identify --friction
        method: or ols, irls, tls
        options: a TOML file beside this one; see `calib formats identify-options`
        holdout: share of each recording, its end, that is not identified from but judged on, for want of another; 0:
            none
        tolerance_percent: largest torque error of the exported robot on unseen motion that is good enough [%]; 0: none
        payloads: label = mass [kg] of bodies at the flange: loaded = 3.28
    """

    wanted: Flag = True
    plan: Flag = True
    validation: Flag = True
    period: Period = DEFAULT_DESIGN.period
    harmonics: Harmonics = HARMONICS
    rate: Rate = DEFAULT_DESIGN.rate
    repeats: Annotated[int, Whole(1)] = 3
    starts: Starts = DEFAULT_DESIGN.starts
    evaluations: Evaluations = DEFAULT_DESIGN.evaluations
    limits: Beside = ""
    torques: Torques = "motor"
    friction: Annotated[str, OneOf(FRICTION)] = IdentificationSettings.friction
    method: Annotated[str, OneOf(tuple(METHODS))] = IdentificationSettings.method
    options: Beside = ""
    holdout: Holdout = 0.0
    tolerance_percent: NotNegative = 0.0
    payloads: Mapping[str, Annotated[float, Real(above=0, words="its mass [kg], a number above 0")]] = field(
        default_factory=dict
    )

    def __post_init__(self) -> None:
        if self.repeats > MAX_SAMPLES / max(self.period * self.rate, 1e-300):  # a quotient: repeats may be huge
            raise ValueError(
                f"period {self.period:g} s at rate {self.rate:g} Hz, {self.repeats} times: more than "
                f"{MAX_SAMPLES:.0e} samples"
            )


@strict
@dataclass(frozen=True)
class SessionSettings:
    """What ``session.toml`` says, section by section.

    Attributes:
        seed: of pose selection, cross-validation and everything else random
    """

    name: Text
    created: Text
    seed: Seed
    robot: RobotSection
    instrument: InstrumentSection
    poses: PosesSection
    fit: FitSection
    dynamics: DynamicsSection
    schema: Annotated[int, Whole(1)] = SCHEMA


def read_settings(path: Path) -> SessionSettings:
    """Read ``session.toml``; one of schema 1 gets no dynamics, missing keys their defaults.

    Raises:
        SessionError: where it was made by a newer version, is damaged, or a value cannot be.
    """
    table = read_toml(path, SessionError)
    check_schema(path, table.get("schema"))
    if table["schema"] == 1:
        table.setdefault("dynamics", {"wanted": False})
    found = parse(SessionSettings, table, str(path), SessionError)
    for key in FILES:
        name = attrgetter(key)(found)
        if name and (path.parent / name).is_dir():
            raise SessionError(f"{path}: {key}: expected a file, found the folder '{name}'")
    return found


def check_schema(path: Path, found: Any) -> None:
    """Refuse the schema of another version.

    Raises:
        SessionError: with what to do.
    """
    if found in READ and type(found) is int:
        return
    if isinstance(found, int) and found > SCHEMA:
        raise SessionError(f"{path}: schema {found} was made by a newer version; this one reads {SCHEMA}: upgrade")
    if found is None:
        raise SessionError(f"{path} states no schema: was it cut short as it was copied? Copy the session again")
    known = " and ".join(map(str, READ))
    raise SessionError(
        f"{path}: schema {shown(found)} is not known to this version, which reads {known}; make a new session"
    )


def default_keys(section: str) -> dict[str, Any]:
    """Return the keys of a section that have defaults, with these; of a key outside sections nothing."""
    kind = get_type_hints(SessionSettings).get(section)
    keys = fields(kind) if is_dataclass(kind) else ()
    return {key.name: key.default for key in keys if key.default is not MISSING}


def written(settings: SessionSettings) -> str:
    """Return ``session.toml``: these settings, every key with its comment."""
    document = tomlkit.document()
    for line in _HEAD:
        document.add(tomlkit.comment(line))
    document.add("schema", tomlkit.item(settings.schema))
    _fill(document, settings)
    return tomlkit.dumps(document)


def _fill(table: Any, section: Any) -> None:
    """Add the keys of a section to a table of the document, comments in one column; tables come last."""
    words = described(type(section))
    for key in fields(section):
        value, about = getattr(section, key.name), words.get(key.name, "")
        if is_dataclass(value) or isinstance(value, Mapping):
            inner = tomlkit.table()
            if about:
                inner.comment(about)
                inner.trivia.comment_ws = "  "
            if is_dataclass(value):
                _fill(inner, value)
            else:
                inner.update(value)
            table.add(tomlkit.nl())
            table.add(key.name, inner)
        elif key.name != "schema":
            _add(table, key.name, tomlkit.item(list(value) if isinstance(value, tuple) else value), about)


def _add(table: Any, key: str, item: Any, about: str) -> None:
    """Add a key with its comment behind it, wrapped into lines below where it is long."""
    first, *rest = wrap(about, WIDTH - COLUMN) or [""]
    if first:
        item.comment(first)
        item.trivia.comment_ws = " " * max(2, COLUMN - 2 - len(f"{key} = {item.as_string()}"))
    table.add(key, item)
    for line in rest:
        table.add(Comment(Trivia(indent=" " * (COLUMN - 2), comment=f"# {line}")))


def example() -> str:
    """Return a ``session.toml`` with every key."""
    return written(
        SessionSettings(
            "", "", 0, RobotSection(""), InstrumentSection("", "pose"), PosesSection(), FitSection(), DynamicsSection()
        )
    )

"""The identification options file: settings of recordings (if not in their files) and of the identification.

TOML; every key is optional, and a key that is none of these is refused. SI units; joints are counted from 1::

    friction = "auto"                # auto, standard, or one rung of the ladder; all names: below; auto tries cable
                                     # where rows = "both"
    method = "wls"                   # ols, wls, irls, tls, gtls, ml, adaline, hopfield, set-membership; ekf, ukf, cdkf
                                     # and their square-root forms srekf …; iv, didim (called CLIE elsewhere), cloe,
                                     # clie (the survey's) simulate the closed loop, see [loop]; pc-ols, pc-wls,
                                     # pc-irls, pc-iv, pc-didim: under [constraints]; all names: below
    weights = "residuals"            # of the joints' rows in wls: from their residuals; repeats: from the variance over
                                     # the periods that `calib recall` averaged, relative between joints
    drives = "Ia Fv Fc off"          # a text for all joints, or one per joint; default by rows: motor as here, link
                                     # Fvl Fcl offl, drive Ia Fvm Fcm offm, both all seven
    passive = "Fv Fc"                # friction of a parallel robot's passive joints; default none
    identical_legs = true            # of a parallel robot: one set of inertial parameters for all, friction apart
    v0 = 0.01                        # smoothing of the Coulomb sign [rad/s or m/s], or one per joint
    rows = "motor"                   # which torques are explained: motor; with joint torque sensors (columns tau_l and
                                     # tau_m or tau) also link (Model 1), both (Model 2), drive (Model 3: tau_m - tau_l)
                                     # or power: one row, the power of all motors (no accelerations)
    gravity = [0, 0, -9.81]          # in the robot's base frame; default the robot's own
    gains = [10.0, 10.7]             # torque per current of each joint, signed; default the file's own
    slow = 0.01                      # errors at rest are those below this share of a joint's peak speed; or a speed
                                     # per joint (standstills in the training count once: v0)
    essential = "both"               # none, rsd, f, both: the rule of the elimination
    ratio = 20.0                     # r_sigma of the RSD rule
    level = 0.05                     # of the F rule
    keep = ["ZZ1R"]                  # parameters never left out
    drop = ["offl3"]                 # parameters left out first
    prior = "auto"                   # auto, none, cad: regularise what is not identified towards CAD values;
                                     # auto: where there are none, to rods between the joints
    folds = 6                        # parts of the motion, with their repetitions, that are held out in turn
    samples = 20000                  # largest number of rows per torque; beyond it every second, third … row
    deflections = true               # joint corrections of the fit (compliance, gears, encoders) move the links
    with_geometry = false            # joint offsets, lengths and gravity's direction together with the dynamics: poses
                                     # (the fit's covariance) and torques; a payload of known mass helps
    accept = []                      # findings that are meant so, by the name that their line prints

    [filter]                         # default: from the data
    cutoff = 20.0                    # f_q of the positions' filter [Hz], or one per joint
    velocity_cutoff = 50.0           # f_v, of the positions that velocities come from [Hz], or one per joint; default:
                                     # f_q where that is stated, else as far above it as the encoders are quiet
    order = 4
    band = 10.0                      # f_p, the identification band [Hz]
    dynamics = 2.0                   # f_dyn, where it is known [Hz]
    width = 4                        # half-width of the central differences [samples]
    borders = 0.1                    # left out at both ends [s]
    clock = "auto"                   # auto, stamps, even, counted
    gap = 0.05                       # the longest gap that is bridged [s]
    decimator = "kaiser"             # or chebyshev
    [recording]                      # how files are read
    kind = "current"                 # torque or current
    rate = 1000.0                    # of files without stamps [Hz]
    topic = "/joint_states"
    use_range = true                 # follow the file's own use_range
    samples = 600000                 # used of a longer recording, in pieces spread over it
    lag = 0.0                        # by which torques and currents come later than the positions of their row [s]
    names = { torque = "tau_m" }     # our name = the file's; [columns] says the same, and joint by joint
    units = { q = "deg" }            # of columns that state none; "counts/4096@2048": encoder counts, and that at zero
    [columns]                        # of recordings: our name = the file's
    q = "/states/{joint}/position"   # {joint} stands for each joint's name or number
    torque_1 = "Axis A load"         # or joint by joint: q1, torque_1, i1, or a joint's name for its position
    [[coupling]]                     # a motor that turns with the sum of two joints: Iam Fvm Fcm
    joints = [5, 6]                  # the two joints, from 1
    label = "6"                      # ends the names of its parameters
    [[term]]                         # any other torque term, e.g. a counterbalance
    name = "Ks2"                     # of the parameter
    shape = "sine"                   # see calib.dynamics.shapes
    joint = 2                        # from 1
    side = "motor"                   # or link, of a joint torque sensor
    settings = [1.0, inf]            # of the shape; a sine's order 1 is gravity's own shape: only wide and fast motion
                                     # distinguishes them
    [payload.tool]                   # a body at the flange
    mass = 2.805                     # known mass [kg]
    com = [0.0, 0.0, 0.05]           # known centre of mass in the tip's frame [m]
    [gain_identification]            # torque = gain x current, from runs without and with a payload of known mass
    unloaded = "run.npz"             # recordings of the command line, or other files
    loaded = "run_load.npz"          # the same motion with the payload
    [loop]                           # the closed loop they came from: see calib.identification.loop
    controller = "identify"
    [constraints]                    # what parameters must satisfy, for the methods pc-*; with a file ols, wls, iv, too
    # file = "constraints.py"         # a Python file that is executed: its function constraints(beta) returns a list of
                                     # CVXPY constraints: [beta["M3"] >= 2, cp.norm(beta["MX2", "MY2"]) <= 0.3]
    signs = true                     # inertia and friction of drives are not negative
    inertia = 50                     # random postures in which M(q) is positive definite; 0: not asked
    bodies = false                   # of bodies that can exist (pseudo-inertias), in place of M(q) over postures
    bounds = { Fv1 = [0.5, 5.0], ZZ1R = [0.0, inf] }   # [lower, upper]; both alike fix a parameter
    [[constraints.sum]]              # a weighted sum of parameters: equal, or least and most
    weights = { Fv5 = 1.0, Fv6 = -1.0 }  # name of a parameter -> its weight
    equal = 0.0                      # what the sum is
    # least = 0.0                    # or the least that it may be
    # most = 1.0                     # and the most
    name = "wrist joints alike"      # of the constraint, for messages
    [[constraints.curved]]           # a twice differentiable function of parameters, h >= 0; numbers, + - * / **, sqrt,
    h = "XX2R * ZZ2R >= XZ2R**2"     # exp, log, sin, cos, tanh; in Python also a function with its derivatives `slope`
    [files."run_load.npz"]           # for this file only: payload, gains, reference; keys of filter and recording
    payload = ["tool"]
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated

from calib.arguments import checked
from calib.config import check_keys, inherited, own_table, parse, read_toml, strict
from calib.config_types import Checked, Expect, JointNumber, Name, Names, OneOf, OneOrMany, Real, Spread, shown
from calib.data.recordings.recording import parse_cut
from calib.data.recordings.recording_options import RecordingOptions
from calib.data.signals.motion import FilterOptions
from calib.dynamics.drives import term
from calib.dynamics.shapes import SHAPES
from calib.dynamics.torque_rows import MOTOR, ROWS
from calib.errors import CalibError, UsageError, refuse_option, refused_as, require
from calib.identification.settings import Choices, Coupling, IdentificationSettings, Payload

USED = 600_000
"""Samples of a recording, unless stated: ten minutes at 1 kHz (our choice)."""


def _no_zero(value: object) -> object:
    """Raise a ValueError for a list of numbers that contains a zero; return any other value unchanged."""
    if isinstance(value, list):
        for number in value:
            if type(number) in (int, float) and number == 0:
                raise ValueError(f"expected finite numbers other than zero, found {shown(value)}")
    return value


REMOVED = {"cut_slow": "standing rows are no longer cut, since each standstill of a joint counts once: remove the line"}
"""Keys of earlier versions, and what replaced them."""
FINDINGS = (
    "masses",
    "limit",
    "speed",
    "lag",
    "clock",
    "order",
    "zero",
    "coupling",
    "sign",
    "jump",
    "bodies",
    "description",
    "loop",
    "gravity",
    "encoder",
    "payload",
    "robot",
)
"""Names in ``accept``: the codes in chapters 9 and 10 of the catalogue of findings."""
Texts = Annotated[tuple[Name, ...], Spread(words="a text, or a list of texts")]
Gains = Annotated[tuple[float, ...], Expect("a list of finite numbers other than zero"), Checked(_no_zero)]


@strict
@dataclass(frozen=True)
class FileSettings:
    """Settings of one recording: how it is read and filtered, payload labels, gains, and the file of its reference."""

    recording: RecordingOptions = field(default_factory=RecordingOptions)
    filter: FilterOptions = field(default_factory=FilterOptions)
    payload: Names = ()
    gains: Gains | None = None
    reference: Name = ""
    columns: Mapping[str, Name] = field(default_factory=dict)


@strict
@dataclass(frozen=True)
class GainPair:
    """Recordings without and with a payload of known mass, by file name, from which drive gains are identified."""

    unloaded: Texts
    loaded: Texts


@strict
@dataclass(frozen=True)
class TermTable:
    """A torque term of the options file; `joint` is counted from 0."""

    name: Name
    shape: Annotated[str, OneOf(tuple(SHAPES))]
    joint: JointNumber
    settings: Annotated[tuple[Annotated[float, Real(infinite=True)], ...], Spread(words="a list of numbers")] = ()
    side: Annotated[str, OneOf(("motor", "link"))] = "motor"


@checked
@dataclass(frozen=True)
class IdentifySettings(Choices):
    """Settings of an identification: the keys of the options file, see ``calib formats identify-options``.

    Tables may be given as dictionaries: ``IdentifySettings(method="iv", filter={"cutoff": 20.0})``.
    """

    drives: Texts = ()
    rows: Annotated[str, OneOf(tuple(ROWS))] = MOTOR.name
    coupling: tuple[Coupling, ...] = ()
    term: tuple[TermTable, ...] = ()
    payload: Mapping[str, Payload] = field(default_factory=dict)
    slow: Annotated[float | tuple[float, ...], OneOrMany(Real(above=0))] | None = None
    accept: tuple[Annotated[str, OneOf(FINDINGS)], ...] = ()
    gain_identification: GainPair | None = None
    recording: RecordingOptions = field(default_factory=RecordingOptions)
    columns: Mapping[str, Name] = field(default_factory=dict)
    filter: FilterOptions = field(default_factory=FilterOptions)
    gains: Gains | None = None
    files: Mapping[str, FileSettings] = field(default_factory=dict)


@dataclass(frozen=True)
class IdentifyOptions:
    """The content of an options file.

    Attributes:
        settings: settings of the identification.
        every, files: settings of all recordings, and of single ones by file name.
        slow: speed below which a joint counts as at rest, as a share of its peak speed or one speed per joint; None:
            the default share.
        gain_pair: recordings that identify the drive gains; None without any.
        accept: findings that do not affect the verdict on the model, some of `FINDINGS`.
        source: name of the file in messages.
    """

    settings: IdentificationSettings = field(default_factory=IdentificationSettings)
    every: FileSettings = field(default_factory=FileSettings)
    files: Mapping[str, FileSettings] = field(default_factory=dict)
    slow: float | tuple[float, ...] | None = None
    gain_pair: GainPair | None = None
    accept: tuple[str, ...] = ()
    source: str = ""

    def file_settings(self, path: str | Path) -> FileSettings:
        """Return the settings of a recording (or a cut of one), including which torques its rows need.

        Args:
            path: the recording, as the user stated it.
        """
        settings = own_table(self.files, parse_cut(str(path))[0]) or self.every
        rows = self.settings.torque_rows
        samples = settings.recording.samples or USED
        columns = {**settings.recording.columns, **settings.columns}
        recording = replace(
            settings.recording,
            samples=samples,
            columns=columns,
            rows=rows.name,
            motors=rows.driven,
            sensors=rows.sensed,
        )
        return replace(settings, recording=recording)


def read_options(path: str | Path | None = None) -> IdentifyOptions:
    """Return the options in the file at `path`; None: the default options.

    Raises:
        UsageError: for a missing file, invalid TOML, an unknown key, or an invalid value.
    """
    if path is None:
        return IdentifyOptions()
    options = parse_options(read_toml(path), str(path))
    constraints = options.settings.constraints
    if constraints is None or not constraints.file:
        return options
    file = str((Path(path).parent / constraints.file).resolve())
    constraints = replace(constraints, file=file)
    # an error of the file is told before recordings are read
    require(callable(constraints.function), f"{file}: no function", UsageError)
    return replace(options, settings=replace(options.settings, constraints=constraints))


def parse_options(table: Mapping[str, object], source: str = "options") -> IdentifyOptions:
    """Return the options in a parsed TOML table; `source` names the file in messages.

    Raises:
        UsageError: for an unknown key or an invalid value.
    """
    for key in table.keys() & REMOVED.keys():
        message = REMOVED[key]
        refuse_option(f"{source}: {key}", message)
    # Payloads are bodies here and their labels in [files], so that they are not handed down.
    handed_down = {key: value for key, value in table.items() if key != "payload"}
    keys = inherited(handed_down, FileSettings)
    if "payload" in table:
        keys = {**keys, "payload": table["payload"]}
    return options_of(parse(IdentifySettings, keys, source), source)


def options_of(keys: IdentifySettings, source: str = "settings") -> IdentifyOptions:
    """Return the options of an identification from the keys of an options file.

    Args:
        keys: keys and values of the options file.
        source: name of the file in messages.

    Raises:
        UsageError: for an invalid term, or an unknown payload of a file.
    """
    choices = {choice.name: getattr(keys, choice.name) for choice in fields(Choices)}
    terms = []
    for number, row in enumerate(keys.term, 1):
        with refused_as(UsageError, CalibError, f"{source}: [[term]] number {number}: {{}}"):
            drive_term = term(row.name, row.shape, row.joint, *row.settings, side=row.side)
            terms.append(drive_term)
    torque_rows = ROWS[keys.rows]
    settings = IdentificationSettings(
        **choices,
        sets=keys.drives,
        torque_rows=torque_rows,
        couplings=keys.coupling,
        terms=tuple(terms),
        payloads=keys.payload,
    )
    for name, file in keys.files.items():
        check_keys(dict.fromkeys(file.payload), keys.payload, f'{source}: files."{name}".payload')
    every = FileSettings(keys.recording, keys.filter, gains=keys.gains, columns=keys.columns)
    return IdentifyOptions(
        settings=settings,
        every=every,
        files=keys.files,
        slow=keys.slow,
        gain_pair=keys.gain_identification,
        accept=keys.accept,
        source=source,
    )

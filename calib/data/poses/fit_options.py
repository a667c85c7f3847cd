"""Options file of a fit: reading of measurement files (where their headers are silent), model and loss.

TOML; every key is optional, and an unknown key is refused. Lengths in m, angles in rad::

    kind = "position"                # pose, position, distance, bar, sockets, plane; where the header does not state it
    format = "csv"                   # csv, robodk, three_smr; where the header does not state it
    euler = "xyz fixed"              # what rx ry rz (a b c, w p r, roll pitch yaw) mean: turns about fixed axes one
                                     # after the other, "zyx moving" (KUKA's A B C) about axes that turn along, or
                                     # "vector", a rotation vector (UR); wpr is xyz fixed, xyz is xyz moving
    groups = ["tool_position"]       # columns that, with the socket (plane), name one group
    controller = "fanuc"             # joints are as this controller shows them (signs, axes that count from the
                                     # horizontal): calib program --list
    external = ["rail"]              # joints that are the controller's external axes, if names and kinds do not tell
    station = "tracker A"            # one name for the instrument placement; by default each file has its own
    tool = "ball"                    # the tool's (reflector's) name
    check_limits = true              # refuse joint values outside the robot's limits
    planned = "poses.csv"            # of a file without joints: the poses driven, in this order or found by geometry
    base_frame = "auto"              # a frame on the base in columns base_x …: used where it is there; "measured": it
                                     # must be there; "ignored": the target is seen from the instrument
    payload = { mass = 2.5, centre = [0, 0, 0.1] } # that the tip carries [kg], [m] in the tip's frame; mass 0: none
    socket_distance = 0.05           # between two sockets of the same fixture position
    socket_pairs = [["0", "1"]]      # which sockets that joins, where there are more than two
    model = "auto"                   # or the largest model of the ladder to fit; all names: below
    loss = "auto"                    # auto (cauchy where rows are grossly wrong), none, huber, cauchy
    loss_scale = 1.345               # its constant, in sigmas
    beta = true                      # a sixth element for nearly parallel axes of an MDH table
    fix = ["theta1"]                 # parameters that stay at their nominal value
    free = ["d3"]                    # if given, only these move
    accept = []                      # findings that are meant so, by the name that their line prints

    [columns]                        # our name = the file's; y and z go with x
    x = "X_leica"
    [units]                          # of columns whose header states none: our name, or joints, position, distance,
                                     # orientation, sigma, sigma_rotation
    joints = "deg"                   # or encoder counts per turn, and the count at zero: "counts/4096@2048"
    [sigma]                          # standard deviations: a number, or one per axis
    position = [1e-5, 1e-5, 2e-5]
    orientation = 1e-4
    distance = 1e-5
    floor = 1e-6                     # sigmas in the file's columns [m] are raised to this
    [where]                          # keep the rows whose cell is (one of) this
    tool_position = ["back_left", "high"]
    [prior]                          # standard deviation of a parameter about its nominal
    theta2 = 1e-3
    [camera]                         # of folders of images
    mounting = "in hand"             # or "to hand" (the arm carries the board); found out where not stated
    intrinsics = "fit"               # with the geometry, or given; default: given where there is a camera.yaml
    model = "pinhole"                # or fisheye, of a lens that is found from the images
    board = ["scale", "bend"]        # what of the print is fitted; scale needs another instrument beside
    [files."day2.csv"]               # for this file only: keys down to socket_pairs, columns, units, sigma, where,
    kind = "pose"                    # camera
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from calib.config import inherited, own_table, parse, read_toml, strict
from calib.config_types import Expect, Flag, Hidden, Label, Name, Names, OneOf, Positive, Real, Spread
from calib.data.poses import IGNORED, IN_HAND, MEASURED, MIN_SIGMA, TO_HAND, Loss, Model
from calib.data.poses.measurements import KINDS
from calib.errors import refuse_option, suggestion
from calib.units import ANGLES, COUNTS, LENGTHS

FORMATS = ("csv", "robodk", "three_smr")
AXES = ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx", "zyz", "zxz")
CONVENTIONS = ("vector", *(f"{axes} {frame}" for axes in AXES for frame in ("fixed", "moving")))
EULER = ("vector", "wpr", "xyz", *CONVENTIONS[1:])

Metres = Annotated[float, Real(above=0, least=MIN_SIGMA, most=0.1, unit="m")]
Radians = Annotated[float, Real(above=0, least=MIN_SIGMA, most=1.0, unit="rad")]
Prior = Annotated[float, Real(above=0, least=1e-12, most=1e6)]  # [m, rad, or a deflection's unit]
MetresOrZero = Annotated[float, Real(above=0, least=MIN_SIGMA, most=0.1, unit="m", zero=True)]
RadiansOrZero = Annotated[float, Real(above=0, least=MIN_SIGMA, most=1.0, unit="rad", zero=True)]
Each = Spread(3, "a number or three")


OF_COLUMNS = (
    "sign",
    "coupling",
    "still",
    "order",
    "zero",
    "rows",
    "targets",
    "reflection",
    "convention",
    "copies",
    "units",
)
FINDINGS = ("unexplained", *OF_COLUMNS, "moved", "scale", "commanded", "range", "payload")
"""Names in ``accept``: those of chapter 1 of the catalogue of findings."""


COUNTED = "or counts/4096@2048: an encoder's counts per turn, and its count at the joint's zero"


@strict
@dataclass(frozen=True)
class Sigma:
    """Standard deviations of measurements; None where not stated.

    Attributes:
        position, orientation: per axis [m], [rad]; one number for all axes, or three.
        distance: of a measured distance [m].
        floor: lower bound to which sigmas of the file's columns are raised [m].
    """

    position: Annotated[tuple[Metres, Metres, Metres], Each] | None = None
    orientation: Annotated[tuple[Radians, Radians, Radians], Each] | None = None
    distance: Metres | None = None
    floor: MetresOrZero = 0.0


@strict
@dataclass(frozen=True)
class CameraOptions:
    """Options of image folders ([camera])."""

    mounting: Annotated[str, OneOf(("auto", IN_HAND, TO_HAND))] = "auto"
    intrinsics: Annotated[str, OneOf(("auto", "given", "fit"))] = "auto"
    model: Annotated[str, OneOf(("pinhole", "fisheye"))] = "pinhole"
    board: Annotated[
        tuple[Annotated[str, OneOf(("scale", "bend"))], ...], Expect("a list of 'scale', 'bend' or both")
    ] = ()


@strict
@dataclass(frozen=True)
class Carried:
    """What the tip carries, beyond the masses of the robot's description; None for what is not stated.

    Attributes:
        mass: its mass [kg]; 0 for nothing.
        centre: its centre of mass in the tip's frame [m].
    """

    mass: Annotated[float, Real(above=0, most=1e4, unit="kg", zero=True)] | None = None
    centre: Annotated[tuple[float, float, float], Expect("three numbers [m]")] | None = None


@strict
@dataclass(frozen=True)
class FileOptions:
    """Options for reading one measurement file; by default its header determines everything. Keys as in the file.

    Attributes:
        columns: the toolkit's name of a column → the file's name.
        units: the toolkit's name of a column, or a family of columns → its unit.
        where: column → texts; only rows with one of these texts are used.
        external: names of joints that are external axes of the controller, where names and kinds do not tell.
        planned: CSV of the poses that were to be measured, for a file without joints.
        base_frame: whether the target is seen from the base frame that the file's columns ``base_`` contain.
        payload: what the tip carries; a column ``payload`` replaces its mass.
    """

    kind: Annotated[str, OneOf(tuple(KINDS))] = ""
    controller: Name = ""
    external: Names = ()
    format: Annotated[str, OneOf(FORMATS)] = ""
    euler: Annotated[str, OneOf(EULER)] = ""
    columns: Mapping[str, Name] = field(default_factory=dict)
    units: Mapping[str, Annotated[str, OneOf((*ANGLES, *LENGTHS), COUNTED, COUNTS)]] = field(default_factory=dict)
    sigma: Sigma = field(default_factory=Sigma)
    groups: Names = ()
    where: Mapping[str, Annotated[tuple[Label, ...], Spread(words="a text, a number, or a list of them")]] = field(
        default_factory=dict
    )
    station: Name = ""
    tool: Name = "tool"
    socket_distance: Annotated[float, Real(above=0, most=10.0, unit="m")] | None = None
    socket_pairs: Annotated[tuple[tuple[Label, Label], ...], Expect('pairs of socket labels, [["0", "1"]]')] = ()
    check_limits: Flag = True
    planned: Name = ""
    base_frame: Annotated[str, OneOf(("auto", MEASURED, IGNORED))] = "auto"
    payload: Carried = field(default_factory=Carried)
    camera: CameraOptions = field(default_factory=CameraOptions)


@strict
@dataclass(frozen=True)
class FitOptions(FileOptions):
    """Options of one fit: default options for reading files, options per file, model, loss and priors.

    Attributes:
        files: file name → options for reading that file.
        source: the options file, for messages.
    """

    files: Mapping[str, FileOptions] = field(default_factory=dict)
    model: Model = "auto"
    loss: Loss = "auto"
    loss_scale: Positive | None = None
    beta: Flag = True
    fix: Names = ()
    free: Names = ()
    accept: tuple[Annotated[str, OneOf(FINDINGS)], ...] = ()
    prior: Mapping[str, Prior] = field(default_factory=dict)
    source: Annotated[str, Hidden()] = ""

    def for_file(self, path: str | Path) -> FileOptions:
        """Return the options for the file at `path`: its table under [files] if there is one, else the common ones."""
        return own_table(self.files, path) or self


def read_options(path: str | Path | None = None) -> FitOptions:
    """Return the options in the file at `path`; the defaults for None.

    Raises:
        UsageError: a file that is missing or not TOML, an unknown key, or an invalid value.
    """
    return FitOptions() if path is None else parse_options(read_toml(path), str(path))


def parse_options(table: Mapping[str, object], source: str = "options") -> FitOptions:
    """Return the options in a parsed TOML table; `source` is the file's name in messages."""
    options = parse(FitOptions, inherited(table, FileOptions), source)
    if "free" in table and not options.free:
        refuse_option(source, "free: the list is empty; remove the key to free all parameters")
    fixed_and_free = set(options.fix) & set(options.free)
    if fixed_and_free:
        refuse_option(source, f"'{min(fixed_and_free)}' is in fix and in free; remove it from one")
    return replace(options, source=source)


def check_files(options: FitOptions, paths: Sequence[str | Path]) -> None:
    """Raise UsageError for a [files] table of a file that is not among `paths`.

    Args:
        options: options of the fit, with a table [files].
        paths: the measurement files of the fit.
    """
    names = [Path(path).name for path in paths]
    for name in options.files:
        if not any(own_table({name: name}, path) for path in paths):
            near = suggestion(name, names)
            refuse_option(options.source, f'files."{name}" is not among the files given{near}: {", ".join(names)}')

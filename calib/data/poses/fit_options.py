"""The fit options file: what the headers of the measurement files do not tell, and how to fit.

TOML; every key is optional, and a key that is none of these is refused. Lengths in m, angles in rad::

    kind = "position"                # pose, position, distance, bar, sockets, plane; where the header does not tell
    format = "csv"                   # csv, robodk, three_smr; where the header does not tell
    euler = "wpr"                    # robodk: wpr is Rz(r)Ry(p)Rx(w), xyz is Rx(w)Ry(p)Rz(r), vector turns about it
    groups = ["tool_position"]       # columns that, with the socket (plane), name one group
    station = "tracker A"            # one name for the instrument placement; by default each file has its own
    tool = "ball"                    # the tool's (reflector's) name
    check_limits = true              # refuse joint values outside the robot's limits
    socket_distance = 0.05           # between two sockets of the same fixture position
    socket_pairs = [["0", "1"]]      # which sockets that joins, where there are more than two
    model = "auto"                   # or frames, offsets, geometry, stiffness, bending, coupling, harmonics, wobble
    loss = "auto"                    # auto (cauchy where rows are grossly wrong), none, huber, cauchy
    loss_scale = 1.345               # its constant, in sigmas
    beta = true                      # a sixth element for nearly parallel axes of an MDH table
    fix = ["theta1"]                 # parameters that stay at their nominal value
    free = ["d3"]                    # if given, only these move

    [columns]                        # our name = the file's
    x = "X_leica"
    [units]                          # of columns whose header states none: our name, or joints, position, distance,
    joints = "deg"                   # orientation, sigma, sigma_rotation
    [sigma]                          # standard deviations: a number, or one per axis
    position = [1e-5, 1e-5, 2e-5]
    orientation = 1e-4
    distance = 1e-5
    floor = 1e-6                     # sigmas in the file's columns [m] are raised to this
    [where]                          # keep the rows whose cell is (one of) this
    tool_position = ["back_left", "high"]
    [prior]                          # standard deviation of a parameter about its nominal
    theta2 = 1e-3
    [files."day2.csv"]               # for this file only: keys down to socket_pairs, columns, units, sigma, where
    kind = "pose"
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from calib.data import values
from calib.data.csv_table import nearest
from calib.data.poses.measurements import KINDS
from calib.errors import UsageError

FORMATS = ("csv", "robodk", "three_smr")
EULER = ("wpr", "xyz", "vector")
MODELS = ("auto", "frames", "offsets", "geometry", "stiffness", "bending", "coupling", "harmonics", "wobble")
LOSSES = ("auto", "none", "huber", "cauchy")


@dataclass(frozen=True)
class FileOptions:
    """How one measurement file is to be read; the defaults leave everything to its header. Keys as in the file.

    Attributes:
        columns: our column name → the file's.
        units: our column name or a family of columns → unit.
        sigma_position, sigma_orientation: standard deviation per axis [m], [rad]; None where not stated.
        sigma_distance, sigma_floor: [m].
        where: column → the texts whose rows are kept.
    """

    kind: str = ""
    format: str = ""
    euler: str = "wpr"
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    sigma_position: values.Triple | None = None
    sigma_orientation: values.Triple | None = None
    sigma_distance: float | None = None
    sigma_floor: float = 0.0
    groups: tuple[str, ...] = ()
    where: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    station: str = ""
    tool: str = "tool"
    socket_distance: float | None = None
    socket_pairs: tuple[tuple[str, str], ...] = ()
    check_limits: bool = True


@dataclass(frozen=True)
class FitOptions:
    """The options of one fit.

    Attributes:
        every: how files are read.
        files: file name → how that file is read.
        model, loss, loss_scale, beta, fix, free, prior: as in the options file.
        source: the options file, for messages.
    """

    every: FileOptions = field(default_factory=FileOptions)
    files: Mapping[str, FileOptions] = field(default_factory=dict)
    model: str = "auto"
    loss: str = "auto"
    loss_scale: float | None = None
    beta: bool = True
    fix: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    prior: Mapping[str, float] = field(default_factory=dict)
    source: str = ""

    def for_file(self, path: str | Path) -> FileOptions:
        """Return the options for the file at `path`: its own where there is a [files] table of that name."""
        return values.own_table(self.files, path) or self.every


def read_options(path: str | Path | None = None) -> FitOptions:
    """Read the options file at `path`; the defaults without one.

    Raises:
        UsageError: for a file that is missing or no TOML, an unknown key, or a value that a key cannot have.
    """
    if path is None:
        return FitOptions()
    return parse_options(values.read_toml(path), str(path))


def parse_options(table: Mapping[str, Any], source: str = "options") -> FitOptions:
    """Return the options that a parsed TOML table holds; `source` is for messages."""
    values.known(table, {*_FILE, *_FIT, "files"}, source)
    every = _file_options({key: value for key, value in table.items() if key in _FILE}, FileOptions(), source)
    own = values.table(table.get("files", {}), f"{source}: files")
    files = {}
    for name, entries in own.items():
        place = f'{source}: files."{name}"'
        if isinstance(entries, Mapping) and set(entries) == {"csv"}:
            raise UsageError(f'{place}: the dot needs quotes: [files."{name}.csv"]')
        values.known(values.table(entries, place), set(_FILE), place)
        files[name] = _file_options(entries, every, place)
    fit = {key: _FIT[key](value, f"{source}: {key}") for key, value in table.items() if key in _FIT}
    both = set(fit.get("fix", ())) & set(fit.get("free", ()))
    if both:
        raise UsageError(f"{source}: '{min(both)}' stands in fix and in free; take it out of one")
    return FitOptions(every, files, source=source, **fit)


def check_files(options: FitOptions, paths: Sequence[str | Path]) -> None:
    """Refuse a [files] table that names none of the files at `paths`."""
    names = [Path(path).name for path in paths]
    for name in options.files:
        wanted = Path(name).parts
        if not any(Path(path).parts[-len(wanted) :] == wanted for path in paths):
            message = f'{options.source}: files."{name}" is none of the files given{nearest(name, names)}'
            raise UsageError(f"{message}: {', '.join(names)}")


def _file_options(table: Mapping[str, Any], base: FileOptions, source: str) -> FileOptions:
    read = {key: _FILE[key](value, f"{source}: {key}") for key, value in table.items()}
    for key in ("columns", "units", "where"):
        if key in read:
            read[key] = {**getattr(base, key), **read[key]}
    read |= {f"sigma_{key}": value for key, value in read.pop("sigma", {}).items()}
    return replace(base, **read)


def _sigma(value: Any, place: str) -> dict[str, Any]:
    parsers = {
        "position": values.triple(0.1, "m"),
        "orientation": values.triple(1.0, "rad"),
        "distance": values.positive(0.1, "m"),
        "floor": values.positive(0.1, "m"),
    }
    values.known(values.table(value, place), set(parsers), place)
    return {key: parsers[key](item, f"{place}.{key}") for key, item in value.items()}


def _prior(value: Any, place: str) -> dict[str, float]:
    return {key: values.positive()(item, f"{place}.{key}") for key, item in values.table(value, place).items()}


_FILE: dict[str, Callable[[Any, str], Any]] = {
    "kind": values.one_of(*KINDS),
    "format": values.one_of(*FORMATS),
    "euler": values.one_of(*EULER),
    "columns": values.texts,
    "units": values.units,
    "sigma": _sigma,
    "groups": values.names,
    "where": values.where,
    "station": values.text,
    "tool": values.text,
    "socket_distance": values.positive(10.0, "m"),
    "socket_pairs": values.pairs,
    "check_limits": values.flag,
}
_FIT: dict[str, Callable[[Any, str], Any]] = {
    "model": values.one_of(*MODELS),
    "loss": values.one_of(*LOSSES),
    "loss_scale": values.positive(),
    "beta": values.flag,
    "fix": values.names,
    "free": values.names,
    "prior": _prior,
}

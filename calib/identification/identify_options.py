"""The identification options file: what recordings do not say of themselves, and how to identify.

TOML; every key is optional, and a key that is none of these is refused. SI units; joints are counted from 1::

    friction = "auto"                # auto, standard, or a rung: load, presliding, stribeck, asymmetric, root, cubic,
                                     # ripple
    method = "wls"                   # ols, wls, irls, tls, iv
    weights = "residuals"            # of the joints' rows in wls: from their residuals; repeats: from the variance over
                                     # the periods that `calib recall` averaged, relative between joints
    drives = "Ia Fv Fc off"          # a text for all joints, or one per joint; default by rows: motor as here, link
                                     # Fvl Fcl offl, drive Ia Fvm Fcm offm, both all seven
    v0 = 0.01                        # smoothing of the Coulomb sign [rad/s or m/s], or one per joint
    rows = "motor"                   # which torques are explained: motor; with joint torque sensors (columns tau_l and
                                     # tau_m or tau) also link (Model 1), both (Model 2), drive (Model 3: tau_m - tau_l)
    gravity = [0, 0, -9.81]          # in the robot's base frame; default the robot's own
    gains = [10.0, 10.7]             # torque per current of each joint, signed; default the file's own
    slow = 0.01                      # a joint stands below this share of its peak speed; or a speed per joint
    cut_slow = false                 # learn nothing from rows of joints that stand
    essential = "both"               # none, rsd, f, both: the rule of the elimination
    ratio = 20.0                     # r_sigma of the RSD rule
    level = 0.05                     # of the F rule
    keep = ["ZZ1R"]                  # parameters never left out
    drop = ["offl3"]                 # parameters left out first
    prior = "auto"                   # auto, none, cad: draw what the motion does not tell to the robot's own inertias
    folds = 6                        # time blocks of the cross-validation

    [filter]                         # default: from the data
    cutoff = 20.0                    # f_q of the positions' filter [Hz], or one per joint
    order = 4
    band = 10.0                      # f_p, the identification band [Hz]
    dynamics = 2.0                   # f_dyn, where it is known [Hz]
    borders = 0.1                    # left out at both ends [s]
    clock = "auto"                   # auto, stamps, even, counted
    gap = 0.05                       # the longest gap that is bridged [s]
    decimator = "kaiser"             # or chebyshev
    [recording]                      # how files are read
    kind = "current"                 # torque or current
    rate = 1000.0                    # of files without stamps [Hz]
    topic = "/joint_states"
    use_range = true                 # follow the file's own use_range
    names = { torque = "tau_m" }     # our name = the file's
    units = { q = "deg" }            # of columns that state none
    [[coupling]]                     # a motor that turns with the sum of two joints: Iam Fvm Fcm
    joints = [5, 6]
    label = "6"
    [[term]]                         # any other torque term, e.g. a counterbalance
    name = "Ks2"
    shape = "sine"                   # see calib.dynamics.shapes
    joint = 2
    settings = [1.0, inf]            # order 1 is gravity's own shape: only wide and fast motion tells them apart
    [payload.tool]                   # a body at the flange
    mass = 2.805                     # known mass [kg]
    com = [0.0, 0.0, 0.05]           # known centre of mass in the tip's frame [m]
    [gain_identification]            # torque = gain x current, from runs without and with a payload of known mass
    unloaded = "run.npz"             # recordings of the command line, or other files
    loaded = "run_load.npz"
    [loop]                           # the closed loop they came from: see calib.identification.loop.loop_settings
    controller = "identify"
    [files."run_load.npz"]           # for this file only: payload, gains, reference; keys of filter and recording
    payload = ["tool"]
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.data import values
from calib.data.recordings.clock import CLOCKS
from calib.data.recordings.recording import parse_cut
from calib.data.recordings.recording_options import RecordingOptions
from calib.data.signals.decimation import KINDS as DECIMATORS
from calib.data.signals.motion import FilterOptions
from calib.dynamics.drives import DriveTerm, term
from calib.dynamics.shapes import SHAPES
from calib.dynamics.torque_rows import ROWS, TorqueRows
from calib.errors import CalibError, UsageError
from calib.identification.friction.friction_ladder import NAMES
from calib.identification.loop.loop_settings import parse_loop
from calib.identification.methods.least_squares import METHODS
from calib.identification.settings import PRIORS, RULES, WEIGHTS, Coupling, IdentificationSettings, Payload


@dataclass(frozen=True)
class FileSettings:
    """How one recording is read: reader's options, filters, payload labels, gains, a file for its reference."""

    recording: RecordingOptions = field(default_factory=RecordingOptions)
    filter: FilterOptions = field(default_factory=FilterOptions)
    payload: tuple[str, ...] = ()
    gains: tuple[float, ...] | None = None
    reference: str = ""


@dataclass(frozen=True)
class GainPair:
    """Recordings without and with a payload of known mass, by file name."""

    unloaded: tuple[str, ...]
    loaded: tuple[str, ...]


@dataclass(frozen=True)
class IdentifyOptions:
    """The content of an options file.

    Attributes:
        settings: of the identification.
        every, files: how recordings are read.
        slow: see the module; None: the default share.
        cut_slow: learn nothing from rows of standing joints.
        gain_pair: recordings that tell the drive gains.
        source: the file, for messages.
    """

    settings: IdentificationSettings = field(default_factory=IdentificationSettings)
    every: FileSettings = field(default_factory=FileSettings)
    files: Mapping[str, FileSettings] = field(default_factory=dict)
    slow: float | tuple[float, ...] | None = None
    cut_slow: bool = False
    gain_pair: GainPair | None = None
    source: str = ""

    def for_file(self, path: str | Path) -> FileSettings:
        """Return the settings of the recording at `path`, whose torques are those the model's rows explain."""
        found = values.own_table(self.files, path) or self.every
        return replace(found, recording=_for_rows(found.recording, self.settings.torque_rows))


def _for_rows(recording: RecordingOptions, rows: TorqueRows) -> RecordingOptions:
    return replace(recording, rows=rows.name, motors=rows.driven, sensors=rows.sensed)


def read_options(path: str | Path | None = None) -> IdentifyOptions:
    """Read the options file at `path`; the defaults without one.

    Raises:
        UsageError: for a file that is missing or no TOML, an unknown key, or a value that a key cannot have.
    """
    if path is None:
        return IdentifyOptions()
    return parse_options(values.read_toml(path), str(path))


def parse_options(table: Mapping[str, Any], source: str = "options") -> IdentifyOptions:
    """Return the options that a parsed TOML table holds; `source` is for messages."""
    values.known(table, {*_SETTINGS, *_OWN, *_FILE, *_TABLES}, source)
    chosen = {_FIELD.get(key, key): _SETTINGS[key](table[key], f"{source}: {key}") for key in table if key in _SETTINGS}
    settings = IdentificationSettings(
        **chosen,
        couplings=tuple(_coupling(v, f"{source}: coupling") for v in _list(table, "coupling", source)),
        terms=tuple(_term(v, f"{source}: term") for v in _list(table, "term", source)),
        payloads=_payloads(table.get("payload", {}), f"{source}: payload"),
        loop=parse_loop(table["loop"], f"{source}: loop") if "loop" in table else None,
    )
    every = _file({key: table[key] for key in table if key in _FILE}, FileSettings(), settings, source)
    files = {}
    for name, own in values.table(table.get("files", {}), f"{source}: files").items():
        place = f'{source}: files."{name}"'
        if isinstance(own, Mapping) and len(own) == 1 and isinstance(next(iter(own.values())), Mapping):
            inner = next(iter(own))
            if inner not in ("filter", "recording"):
                raise UsageError(f'{place}: the dot needs quotes: [files."{name}.{inner}"]')
        values.known(values.table(own, place), {*_FILE, "payload", "reference"}, place)
        files[name] = _file(own, every, settings, place)
    rest: dict[str, Any] = {key: _OWN[key](table[key], f"{source}: {key}") for key in table if key in _OWN}
    if "gain_identification" in table:
        rest["gain_pair"] = _gain_pair(table["gain_identification"], f"{source}: gain_identification")
    return IdentifyOptions(settings, every, files, source=source, **rest)


def _file(table: Mapping[str, Any], base: FileSettings, settings: IdentificationSettings, place: str) -> FileSettings:
    result = base
    if "recording" in table:
        result = replace(result, recording=_recording(table["recording"], base.recording, f"{place}: recording"))
    if "filter" in table:
        result = replace(result, filter=_filter(table["filter"], base.filter, f"{place}: filter"))
    if "gains" in table:
        gains = _numbers(table["gains"], f"{place}: gains")
        if not all(np.isfinite(x) and x != 0.0 for x in gains):
            raise values.refuse(table["gains"], f"{place}: gains", "finite numbers, none of them zero")
        result = replace(result, gains=gains)
    if "reference" in table:
        result = replace(result, reference=values.text(table["reference"], f"{place}: reference"))
    if isinstance(table.get("payload"), list):
        labels = values.names(table["payload"], f"{place}: payload")
        for label in labels:
            values.known({label: None}, set(settings.payloads), f"{place}: payload")
        result = replace(result, payload=labels)
    return result


def _recording(value: Any, base: RecordingOptions, place: str) -> RecordingOptions:
    parsers: dict[str, Callable[[Any, str], Any]] = {
        "kind": values.one_of("torque", "current"), "rate": values.positive(), "topic": values.text,
        "use_range": values.flag, "names": values.texts, "units": values.texts,
    }  # fmt: skip
    found = _parsed(value, parsers, place)
    try:
        return replace(base, **found)
    except CalibError as error:
        raise UsageError(f"{place}: {error}") from error


def _filter(value: Any, base: FilterOptions, place: str) -> FilterOptions:
    parsers: dict[str, Callable[[Any, str], Any]] = {
        "cutoff": _one_or_many, "order": _whole(1, 12), "band": values.positive(), "dynamics": values.positive(),
        "borders": values.positive(), "clock": values.one_of("auto", *CLOCKS), "gap": values.positive(),
        "decimator": values.one_of(*DECIMATORS), "width": _whole(1, 4),
    }  # fmt: skip
    return replace(base, **_parsed(value, parsers, place))


def _parsed(value: Any, parsers: Mapping[str, Callable[[Any, str], Any]], place: str) -> dict[str, Any]:
    values.known(values.table(value, place), set(parsers), place)
    return {key: parsers[key](item, f"{place}.{key}") for key, item in value.items()}


def _coupling(value: Any, place: str) -> Coupling:
    parsers = {"joints": _joints, "label": values.text}
    found = _parsed(value, parsers, place)
    if len(found.get("joints", ())) != 2:
        raise UsageError(f"{place}: expected joints = [first, second]")
    return Coupling(found["joints"], found.get("label", ""))


def _term(value: Any, place: str) -> DriveTerm:
    parsers = {
        "name": values.text, "shape": values.one_of(*SHAPES), "joint": _whole(1, 99), "settings": _numbers,
        "side": values.one_of("motor", "link"),
    }  # fmt: skip
    found = _parsed(value, parsers, place)
    for key in ("name", "shape", "joint"):
        if key not in found:
            raise UsageError(f"{place}: there is no '{key}'; a term needs name, shape and joint")
    try:
        side = found.get("side", "motor")
        return term(found["name"], found["shape"], found["joint"] - 1, *found.get("settings", ()), side=side)
    except CalibError as error:
        raise UsageError(f"{place}: {error}") from error


def _payloads(value: Any, place: str) -> dict[str, Payload]:
    found = {}
    for label, own in values.table(value, place).items():
        parsers = {"mass": values.positive(1e4, "kg"), "com": _numbers}
        parsed = _parsed(own, parsers, f"{place}.{label}")
        if "com" in parsed and len(parsed["com"]) != 3:
            raise values.refuse(own["com"], f"{place}.{label}.com", "three numbers [m]")
        found[label] = Payload(**parsed)
    return found


def _gain_pair(value: Any, place: str) -> GainPair:
    found = _parsed(value, {"unloaded": _text_or_texts, "loaded": _text_or_texts}, place)
    if set(found) != {"unloaded", "loaded"}:
        raise UsageError(f"{place}: expected unloaded and loaded, a recording (or a list of them) each")
    return GainPair(**found)


def _list(table: Mapping[str, Any], key: str, source: str) -> list[Any]:
    value = table.get(key, [])
    if not isinstance(value, list):
        raise values.refuse(value, f"{source}: {key}", f"a list of tables, [[{key}]]")
    return value


def _joints(value: Any, place: str) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(isinstance(k, int) and not isinstance(k, bool) and k > 0 for k in value):
        raise values.refuse(value, place, "numbers of joints, from 1")
    return tuple(k - 1 for k in value)


def _numbers(value: Any, place: str) -> tuple[float, ...]:
    if (
        not isinstance(value, list)
        or not value
        or any(isinstance(x, bool) or not isinstance(x, (int, float)) for x in value)
    ):
        raise values.refuse(value, place, "a list of numbers")
    if any(np.isnan(x) for x in value):
        raise values.refuse(value, place, "numbers, not nan")
    return tuple(float(x) for x in value)


def _one_or_many(value: Any, place: str) -> float | tuple[float, ...]:
    if not isinstance(value, list):
        return values.positive()(value, place)
    return tuple(values.positive()(item, place) for item in value)


def _share_or_speeds(value: Any, place: str) -> float | tuple[float, ...]:
    return _one_or_many(value, place)


def _whole(least: int, most: int) -> Callable[[Any, str], int]:
    def parse(value: Any, place: str) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            raise values.refuse(value, place, f"a whole number from {least} to {most}")
        return value

    return parse


def _text_or_texts(value: Any, place: str) -> tuple[str, ...]:
    return values.names(value, place) if isinstance(value, list) else (values.text(value, place),)


def _as_tuple(value: Any, place: str) -> tuple[float, ...]:
    found = _one_or_many(value, place)
    return found if isinstance(found, tuple) else (found,)


def _torque_rows(value: Any, place: str) -> TorqueRows:
    return ROWS[values.one_of(*ROWS)(value, place)]


def _gravity(value: Any, place: str) -> tuple[float, ...]:
    found = _numbers(value, place)
    if len(found) != 3:
        raise values.refuse(value, place, "three numbers [m/s²]")
    return found


_FIELD = {"drives": "sets", "rows": "torque_rows"}
_SETTINGS: dict[str, Callable[[Any, str], Any]] = {
    "friction": values.one_of(*NAMES),
    "method": values.one_of(*METHODS),
    "weights": values.one_of(*WEIGHTS),
    "drives": _text_or_texts,
    "v0": _as_tuple,
    "rows": _torque_rows,
    "gravity": _gravity,
    "essential": values.one_of(*RULES),
    "ratio": values.positive(),
    "level": values.positive(1.0),
    "keep": values.names,
    "drop": values.names,
    "prior": values.one_of(*PRIORS),
    "folds": _whole(2, 50),
    "samples": _whole(1000, 10_000_000),
}
_OWN: dict[str, Callable[[Any, str], Any]] = {
    "slow": _share_or_speeds,
    "cut_slow": values.flag,
}
_FILE = ("recording", "filter", "gains")
_TABLES = ("coupling", "term", "payload", "files", "gain_identification", "loop")
assert {_FIELD.get(key, key) for key in _SETTINGS} <= {f.name for f in fields(IdentificationSettings)}


def file_settings(options: IdentifyOptions, path: str) -> FileSettings:
    """Return the settings of a recording that may have a cut behind its name."""
    return options.for_file(parse_cut(path)[0])

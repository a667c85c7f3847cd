"""A session: a folder with numbered, human-readable files, that may be moved, copied, opened and edited.

session.toml     what is to be calibrated, with what, how; written by `calib new`, edited by people
1-robot/         the robot's description, copied, so that the folder can move
2-poses/         poses.csv to measure and fit, validation.csv to measure and never fit
3-measured/      what people bring: measured.csv (any name), files whose name starts with validation, and drift.csv,
                 some of the poses measured once more at the end (never fitted); columns: `calib formats measurements`
4-fit/  5-validation/
6-excitation/    training and validation: two motions for the robot to play, at the controller's rate
7-recorded/      what people bring: the logs of them, training.csv (any name; .npz or a ROS bag, too), and files whose
                 name starts with validation; a file whose name holds a payload's label was recorded with it on board:
                 `calib formats recordings`
8-dynamics/      the identified model; unseen/ holds it against the validation motion
9-export/  certificate.html
                 Without dynamics there are no 6 to 8, and the export is 6-export.
state.json       which step was made from which files (SHA-256), when, by which version; written whole or not at all
simulated.txt    there where a simulated cell brought files (calib demo); the certificate then says that it is simulated
session.lock     there while a command works on the session
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import socket
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from datetime import datetime
from pathlib import Path
from typing import Any

from calib import files
from calib.errors import SessionError

SCHEMA = 2
READ = (1, SCHEMA)  # a session of schema 1 knows no dynamics; it goes on as geometry alone
FOLDERS = ("1-robot", "2-poses", "3-measured", "4-fit", "5-validation")
DYNAMIC = ("6-excitation", "7-recorded", "8-dynamics")
EXPORT = {False: "6-export", True: "9-export"}  # without, with dynamics
MARK = "simulated.txt"
TORQUES = ("motor", "link", "both")
_HEAD = """# A calibration session; see `calib status` and `calib next`. Lengths in m, angles in rad.
# Change what you like: steps made from something that changed are shown as stale and made again.
schema = {schema}
name = "{name}"
created = "{created}"
seed = {seed}                          # of pose selection, cross-validation and everything else random

[robot]
file = "{robot}"
given = "{given}"
base = "{base}"                        # URDF: the link the arm starts at, empty: the root
tip = "{tip}"                          # URDF: the link the arm ends at, empty: the longest chain's end

[instrument]
name = "{instrument}"
measures = "{measures}"                # pose (with orientation) or position
sigma_position = {sigma_position}      # of one measurement, per axis; 0: to be estimated
sigma_orientation = {sigma_orientation}
tool = {tool}               # where the target roughly sits in the tip's frame; only pose selection uses it

[poses]
fit = {fit}                            # how many poses to choose for the fit
validation = {validation}              # how many more to measure and never fit; 0: no validation
plan = true                            # false: measured files hold other poses than those chosen here
index = "O1"
method = "detmax"
constraints = "{constraints}"                       # a TOML file beside this one; see `calib formats constraints`

[fit]
model = "auto"                         # or frames, offsets, geometry, stiffness, bending, coupling, harmonics, wobble
loss = "none"                          # or huber, cauchy
options = ""                           # a TOML file beside this one: column names, units; see `calib formats options`
stations = "each"                      # each measured file has its own base placement, or one for all
validation_frames = "fit"              # own: base and tool placement are fitted anew on validation files
tolerance_mm = 0.0                     # largest rms [mm] on unseen poses that is good enough: above it the verdict is
                                       # fail; 0: none, and pass only means better than the nominal robot

[dynamics]
wanted = {dynamics}                          # false: geometry only
plan = true                            # false: recorded files hold other motions than those designed here
validation = true                      # false: no second motion is designed or asked for
period = {period}                          # of the designed motion [s]; the validation motion's is 0.8 of it
harmonics = 5                          # frequencies per joint
rate = {rate}                          # of the controller [Hz]
repeats = {repeats}                            # how often the robot plays each motion
starts = {starts}                             # random starts of the search for a motion
evaluations = {evaluations}                      # most per start
limits = "{limits}"                            # a TOML file beside this one; see `calib formats limits`
torques = "{torques}"                      # motor, link, or both: sensors behind the gears beside the motors' torques
friction = "auto"                      # or standard, or one rung of the ladder; see calib identify --friction
method = "wls"                         # or ols, irls, tls
options = ""                           # a TOML file beside this one; see `calib formats identify-options`
tolerance_percent = 0.0                # largest torque error on unseen motion that is good enough; 0: none

[dynamics.payloads]                    # label = mass [kg] of bodies at the flange: loaded = 3.28
{payloads}"""
_LATER = {("fit", "tolerance_mm")}  # keys that sessions made before do not have; the example's value stands for them
_DEFAULTS: Mapping[str, Any] = {
    "tool": (0.05, 0.0, 0.05), "constraints": "", "dynamics": True, "period": 20.0, "rate": 1000.0, "repeats": 3,
    "starts": 4, "evaluations": 400, "limits": "", "torques": "motor", "payloads": {},
}  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """What ``session.toml`` says, section by section; see its comments."""

    name: str
    created: str
    seed: int
    robot: Mapping[str, Any]
    instrument: Mapping[str, Any]
    poses: Mapping[str, Any]
    fit: Mapping[str, Any]
    dynamics: Mapping[str, Any]
    schema: int = SCHEMA


@dataclass(frozen=True)
class Session:
    """An open session: its folder, and its settings as they stand now."""

    folder: Path
    settings: Settings
    notes: tuple[str, ...] = field(default=())

    def path(self, name: str) -> Path:
        """Return a file of the session by its name relative to the folder."""
        return self.folder / name

    @property
    def dynamic(self) -> bool:
        """Whether the dynamics are identified, too."""
        return bool(self.settings.dynamics["wanted"])

    @property
    def export(self) -> str:
        """The folder of the export, relative to the session's."""
        return EXPORT[self.dynamic]


def create(
    folder: Path, robot_file: Path, given: str, copied: Mapping[str, Path] | None = None, **values: Any
) -> Session:
    """Make a session folder, whole or not at all.

    Args:
        folder: new, or empty.
        robot_file: the description, copied into ``1-robot``.
        given: what the user called it.
        copied: other files to copy, by their names in the folder.
        values: the other fields of ``session.toml``; those with a default may be left out.

    Raises:
        SessionError: where something is there already, or the folder cannot be written.
    """
    if (folder / "session.toml").exists():
        raise SessionError(f"{folder} is a session already; go on with: calib next {folder}")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SessionError(f"{folder} is not empty; give a new folder")
    staging = folder.parent / f".{folder.name}.part"
    try:
        shutil.rmtree(staging, ignore_errors=True)
        wanted = bool(values.get("dynamics", _DEFAULTS["dynamics"]))
        for name in (*FOLDERS, *(DYNAMIC if wanted else ()), EXPORT[wanted]):
            (staging / name).mkdir(parents=True)
        for name, source in (copied or {}).items():
            shutil.copyfile(source, staging / name)
        target = f"1-robot/robot{robot_file.suffix}"
        shutil.copyfile(robot_file, staging / target)
        created = datetime.now().astimezone().isoformat(timespec="seconds")
        head = _filled(robot=target, given=_escaped(given), created=created, **values)
        files.write(staging / "session.toml", head)
        if folder.exists():
            folder.rmdir()
        os.replace(staging, folder)
    except OSError as error:
        shutil.rmtree(staging, ignore_errors=True)
        raise SessionError(f"cannot make {folder}: {error.strerror or error}; nothing was left there") from error
    return open_session(folder)


def _filled(**values: Any) -> str:
    """Return ``session.toml`` with these values, defaults for the others."""
    known = {**_DEFAULTS, **values}
    known["dynamics"] = "true" if known["dynamics"] else "false"
    known["tool"] = f"[{', '.join(f'{float(x)}' for x in known['tool'])}]"
    known["payloads"] = "".join(f'"{_escaped(k)}" = {float(mass)}\n' for k, mass in known["payloads"].items())
    for name in ("period", "rate"):
        known[name] = float(known[name])
    return _HEAD.format(schema=SCHEMA, **known)


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')


def open_session(folder: Path) -> Session:
    """Read the session in `folder`.

    Raises:
        SessionError: where there is none, it was made by a newer version, or its file is damaged.
    """
    path = folder / "session.toml"
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SessionError(f"{folder} is no session (no session.toml); make one with: calib new {folder}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SessionError(f"cannot read {path}: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise SessionError(f"{path}: is no TOML: {error}; correct that line") from error
    _check_schema(path, table.get("schema"))
    known = {each.name for each in fields(Settings)}
    for section, values in tomllib.loads(example()).items():
        if section == "dynamics" and (table["schema"] == 1 or section in table):
            table[section] = _with_defaults(values, table.get(section, {"wanted": False}))
        if section not in table:
            raise SessionError(f"{path}: '{section}' is missing")
        if isinstance(values, dict) and isinstance(table[section], dict):
            table[section] = {k: v for k, v in values.items() if (section, k) in _LATER} | table[section]
        _check_section(path, section, values, table[section])
    unknown = sorted(set(table) - known)
    if unknown:
        raise SessionError(f"{path}: unknown key '{unknown[0]}'; known are {', '.join(sorted(known))}")
    return Session(folder, Settings(**table))


def example() -> str:
    """Return a ``session.toml`` with every key."""
    return _filled(
        name="", created="", seed=0, robot="", given="", base="", tip="", instrument="", measures="pose",
        sigma_position=0.0, sigma_orientation=0.0, fit=30, validation=15,
    )  # fmt: skip


def _check_schema(path: Path, found: Any) -> None:
    if found in READ:
        return
    if isinstance(found, int) and found > SCHEMA:
        raise SessionError(f"{path}: schema {found} was made by a newer version; this one reads {SCHEMA}: upgrade")
    if found is None:
        raise SessionError(f"{path} states no schema: was it cut short as it was copied? Copy the session again")
    known = " and ".join(map(str, READ))
    raise SessionError(
        f"{path}: schema {found!r} is not known to this version, which reads {known}; make a new session"
    )


def _check_section(path: Path, section: str, expected: Any, found: Any) -> None:
    """Refuse keys and values that a section cannot have, by the example's types."""
    if not isinstance(expected, dict):
        if not isinstance(found, type(expected)) or isinstance(found, bool) != isinstance(expected, bool):
            raise SessionError(f"{path}: {section} = {found!r}: expected {type(expected).__name__}")
        return
    if not isinstance(found, dict):
        raise SessionError(f"{path}: [{section}] has to be a table")
    for key, value in expected.items():
        if key not in found:
            raise SessionError(f"{path}: [{section}] {key} is missing; its default is {value!r}")
        numeric = isinstance(value, float) and isinstance(found[key], int) and not isinstance(found[key], bool)
        if not numeric and type(found[key]) is not type(value):
            raise SessionError(f"{path}: [{section}] {key} = {found[key]!r}: expected {type(value).__name__}")
    for key in ("tolerance_mm", "tolerance_percent"):
        if found.get(key, 0.0) < 0.0:
            raise SessionError(f"{path}: [{section}] {key} = {found[key]:g}: expected 0 or more")
    if section == "dynamics":
        _check_dynamics(path, found)
    unknown = sorted(set(found) - set(expected))
    if unknown:
        raise SessionError(f"{path}: [{section}] has no key '{unknown[0]}'; it has {', '.join(expected)}")


def _with_defaults(values: Mapping[str, Any], given: Any) -> Any:
    """Return the dynamics' keys that were given, and the defaults of the others."""
    return {**values, **given} if isinstance(given, dict) else given


def _check_dynamics(path: Path, found: Mapping[str, Any]) -> None:
    """Refuse values of the dynamics that cannot be."""
    if found["torques"] not in TORQUES:
        raise SessionError(f"{path}: [dynamics] torques = '{found['torques']}': expected {', '.join(TORQUES)}")
    for key in ("period", "rate", "harmonics", "repeats", "starts", "evaluations"):
        if not found[key] > 0:
            raise SessionError(f"{path}: [dynamics] {key} = {found[key]:g}: expected a number above 0")
    for label, mass in found["payloads"].items():
        if isinstance(mass, bool) or not isinstance(mass, (int, float)) or not mass > 0:
            raise SessionError(f"{path}: [dynamics.payloads] {label} = {mass!r}: expected its mass [kg], above 0")


def fingerprint(path: Path) -> str:
    """Return the SHA-256 of a file, in hex."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def read_state(session: Session) -> dict[str, Any]:
    """Return what ``state.json`` records; an empty record where there is none.

    Raises:
        SessionError: for a damaged file or one by a newer version, with what to do.
    """
    path = session.path("state.json")
    if not path.exists():
        return {"schema": SCHEMA, "steps": {}}
    try:
        state = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(state["steps"], dict):
            raise TypeError("steps")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SessionError(f"{path} is damaged ({error}); delete it, and calib next makes the steps again") from error
    _check_schema(path, state.get("schema"))
    return state


def write_state(session: Session, state: Mapping[str, Any]) -> None:
    """Record `state`, whole or not at all."""
    files.write_json(session.path("state.json"), state)


@contextmanager
def locked(session: Session, say: Any = print) -> Iterator[None]:
    """Hold the session for one command; the lock of a command that was killed is taken over.

    The lock is the kernel's (flock), so that it ends with the process; the file says whose it is.

    Raises:
        SessionError: while another command works on it.
    """
    import fcntl

    path = session.path("session.lock")
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise SessionError(f"cannot write in {session.folder}: {error.strerror or error}") from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            holder = os.read(handle, 200).decode(errors="replace").strip() or "another command"
            raise SessionError(f"{session.folder} is busy: {holder} works on it; wait for it to end") from None
        if not path.exists() or os.stat(path).st_ino != os.fstat(handle).st_ino:
            raise SessionError(f"{session.folder} was busy a moment ago; try again")
        before = os.read(handle, 200).decode(errors="replace").strip()
        if before:
            say(f"the last command ({before}) was interrupted; going on from there")
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
        yield
        path.unlink(missing_ok=True)
    except Exception:
        with_own = path.exists() and os.stat(path).st_ino == os.fstat(handle).st_ino and _mine(handle)
        if with_own:
            path.unlink(missing_ok=True)
        raise
    finally:
        os.close(handle)


def _mine(handle: int) -> bool:
    return os.pread(handle, 200, 0).decode(errors="replace").startswith(f"process {os.getpid()} ")

"""The guided procedure as the commands `calib new`, `next`, `status` and `redo` run it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from calib.config import parse
from calib.errors import UsageError, command_line, require
from calib.extensions import needed
from calib.folders import CERTIFICATE, SESSION
from calib.geometry.observability import targets_of
from calib.procedure.excitation.limits import read_motion_limits
from calib.procedure.kinematic_stage.folder import URDF
from calib.procedure.measuring.constraints_file import ConstraintsFile, beside
from calib.procedure.measuring.pose_limits import limits_of, read_limits
from calib.procedure.session import instructions, steps
from calib.procedure.session.folder import VERDICT, Session, create, locked, open_session, read_state
from calib.procedure.session.questions import instrument_named
from calib.procedure.session.settings import NOTHING, SessionSettings
from calib.robot.chain import Chain
from calib.robot.collision import meshes_beside
from calib.robot.load import load, resolve
from calib.robot.tables import dumps

Say = Callable[[str], None]
LIMITS = "limits.toml"
CAMERA_FILES = {"lens": "camera.yaml", "board": "board.toml"}  # a camera's files, beside the limits
HEAD = "# What the cell is like, as stated to calib new; calib formats limits says what may stand here.\n"
COLOURS = {"done": "green", "kept": "green", "ready": "cyan", "stale": "yellow", "waiting": "yellow", "after": "dim"}


@dataclass(frozen=True)
class _Stop:
    """Where `go_on` stopped: lines that say what to do now, and the verdict once there is one."""

    lines: tuple[str, ...]
    verdict: str = ""


def begin(
    folder: Path, robot: str, instrument: str, poses: int = 40, validation: int = 20, seed: int = 0, *,
    base: str = "", tip: str = "", tool: Sequence[float] | None = None,
    limits: Path | Mapping[str, Any] | None = None, dynamics: bool = True, motion: Mapping[str, Any] | None = None,
) -> Session:  # fmt: skip
    """Make a session in the new folder `folder`, for a robot, which is read once to see that it can be.

    Args:
        robot: see `calib.robot.load`.
        instrument: a key of `calib.procedure.session.questions.INSTRUMENTS`; ``none``: the geometry is taken as it is.
        poses, validation: how many to choose.
        seed: of everything random.
        base, tip: of a URDF, empty for its own.
        tool: (3,) where the target roughly sits in the tip's frame [m].
        limits: a file of limits, copied, that both poses and motions keep; or its tables.
        dynamics: identify the dynamics, too.
        motion: other keys of ``[dynamics]``: ``torques``, ``payloads``, ``period`` …

    Raises:
        UsageError: for a value that a key of ``session.toml`` cannot have.
    """
    device, source = instrument_named(instrument), resolve(robot)
    words = "nothing is measured and no dynamics are wanted: nothing is left to be done"
    require(dynamics or device.measures != NOTHING, words, UsageError)
    chain = load(robot, base or None, tip or None)
    copied, named = _limits(limits, chain, source, dynamics)
    sigmas = {key: getattr(device, key) for key in ("measures", "sigma_position", "sigma_orientation")}
    table = {
        "name": chain.name, "created": "", "seed": seed, "fit": {},
        "robot": {"file": source.name, "given": robot, "base": base, "tip": tip},
        "instrument": {"name": device.label, **sigmas, **({} if tool is None else {"tool": [*map(float, tool)]})},
        "poses": {"fit": poses, "validation": validation, "constraints": named},
        "dynamics": {"wanted": dynamics, "limits": named, **(motion or {})},
    }  # fmt: skip
    return create(folder, source, parse(SessionSettings, table, SESSION), copied | meshes_beside(source))


def _limits(
    stated: Path | Mapping[str, Any] | None, chain: Chain, source: Path, motions: bool
) -> tuple[dict[str, Path | str], str]:
    """Return what is to be copied of stated limits, which are read once to see that they can be, and its name."""
    if stated is None:
        return {}, ""
    if isinstance(stated, Path):
        if motions:
            read_motion_limits(stated, chain, source)
        read_limits(stated, targets_of(chain), source)
        return {LIMITS: stated, **beside(stated)}, LIMITS
    told = parse(ConstraintsFile, stated, "the cell")
    limits_of(told, targets_of(chain), source, "the cell")
    if told.camera is None:
        return {LIMITS: f"{HEAD}{dumps(stated)}"}, LIMITS
    if not told.camera.unknown:
        needed("camera_view")(told.camera, chain, "the cell", Path())
    given = {key: getattr(told.camera, key) for key in CAMERA_FILES if key not in told.camera.unknown}
    tables = {**stated, "camera": {**stated["camera"], **{key: CAMERA_FILES[key] for key in given}}}
    copied = {CAMERA_FILES[key]: Path(name) for key, name in given.items()}
    return {LIMITS: f"{HEAD}{dumps(tables)}", **copied}, LIMITS


def go_on(folder: Path, say: Say, progress: Say, command: str, again: str = "", plots: bool = True) -> _Stop:
    """Run what can be run, and say what to do then.

    Args:
        folder: of the session.
        say, progress: lines that stay, and words that pass.
        command: for the record.
        again: name of a step to make again, with all that rests on it.
        plots: whether figures are drawn.
    """
    session = open_session(folder, plots)
    with locked(session, say):
        if again:
            steps.forget(session, steps.find(session, again))
        state = steps.run_next(session, say, progress, command)
    if state is not None:
        return _Stop(("", *instructions.asks(session, state)))
    return _Stop(_ending(session), session.verdicts().level)


def _ending(session: Session) -> tuple[str, ...]:
    """Return what is said of a session that has come to its end: a failed one's robot is for inspection only."""
    page, robot = session.path(CERTIFICATE), session.path(f"{session.export}/{URDF}")
    level = session.verdicts().level
    if level == "fail":
        return ("", f"certificate: {page}", f"verdict fail: exported for inspection only, do not use: {robot}")
    why = VERDICT if session.path(VERDICT).exists() else f"{robot.parent.name}/README.txt"
    held = "" if level == "pass" else f" (verdict {level}: {why} says why)"
    return ("", f"done; certificate: {page}", f"robot: {robot}{held}" if robot.exists() else "no robot was exported")


def status_lines(folder: Path) -> Iterator[RenderableType]:
    """Say how every step of a session stands, and what comes next."""
    session = open_session(folder)
    settings, found = session.settings, steps.states(session)
    yield Text.assemble((settings.name, "bold"), f", {settings.instrument.name}, made {settings.created[:10]}")
    table = Table("", "step", "state", "", box=None, pad_edge=False)
    for number, state in enumerate(found, 1):
        table.add_row(str(number), state.step.name, Text(state.kind, COLOURS[state.kind]), Text(state.words))
    yield table
    ahead = next((state for state in found if state.kind not in (steps.DONE, steps.KEPT)), None)
    if ahead is None:
        yield f"certificate: {session.path(CERTIFICATE)}"
    elif ahead.kind == steps.WAITING:
        yield from instructions.asks(session, ahead)
    else:
        yield f"next: {command_line('next', folder)}"


def noted(folder: Path) -> list[str]:
    """Return what was noted as each step of a session was made."""
    recorded = read_state(open_session(folder)).steps
    return [f"  {name}: {note}" for name, record in recorded.items() for note in record.notes]

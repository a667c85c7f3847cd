"""The steps of a session in their order: what each needs and made, what is stale, and how the next one is run.

A step is current while its inputs' fingerprints are those recorded when it was made. Outputs that a person has replaced
are kept and said. Before a step runs, it is marked as running; a killed one is found marked and made again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from calib.errors import SessionError
from calib.procedure import stages
from calib.procedure.session import Session, fingerprint, read_state, write_state

Say = Callable[[str], None]
DONE, READY, WAITING, STALE, KEPT, AFTER = "done", "ready", "waiting", "stale", "kept", "after"


@dataclass(frozen=True)
class Step:
    """One step.

    Attributes:
        name, purpose: for people.
        folder: what it makes; other files in it are people's.
        settings: sections of ``session.toml`` it depends on.
        inputs: the files it reads, as they are now.
        make: runs it; returns what is to be said.
        outputs: names or patterns, relative to the session, of what it makes.
    """

    name: str
    purpose: str
    settings: tuple[str, ...]
    inputs: Callable[[Session], list[Path]]
    make: Callable[[Session, Say], list[str]]
    outputs: tuple[str, ...]


@dataclass(frozen=True)
class State:
    """How a step stands, and why."""

    step: Step
    kind: str
    words: str


def _robot(session: Session) -> list[Path]:
    return [stages.robot_file(session)]


def _plan(session: Session) -> list[Path]:
    name = session.settings.poses["constraints"]
    return [*_robot(session), *([session.path(name)] if name else [])]


def _arrived(session: Session) -> list[Path]:
    return [*_robot(session), session.path("2-poses/poses.csv"), *_options(session), *stages.measured_files(session)[0]]


def _options(session: Session) -> list[Path]:
    name = session.settings.fit["options"]
    return [session.path(name)] if name else []


def _fitted(session: Session) -> list[Path]:
    return [*_robot(session), *_options(session), *stages.measured_files(session)[0]]


def _validated(session: Session) -> list[Path]:
    fit = [session.path("4-fit") / name for name in ("robot.toml", "report.json")]
    return [*fit, session.path("2-poses/validation.csv"), *_options(session), *stages.measured_files(session)[1]]


def _exported(session: Session) -> list[Path]:
    return [*_robot(session), session.path("4-fit/robot.toml"), session.path("4-fit/robot.urdf")]


def _certified(session: Session) -> list[Path]:
    names = ("4-fit/report.json", "5-validation/metrics.json", "6-export/robot.urdf", "2-poses/selection.json")
    return [session.path(name) for name in names]


STEPS = (
    Step("describe", "read the robot", ("robot",), _robot, stages.describe, ("1-robot/summary.txt",)),
    Step(
        "select", "choose the poses to measure", ("robot", "instrument", "poses", "seed"), _plan, stages.select,
        ("2-poses/poses.csv", "2-poses/validation.csv", "2-poses/selection.json"),
    ),
    Step(
        "measure", "check what was measured", ("robot", "instrument", "poses", "fit"), _arrived, stages.arrive,
        ("3-measured/checked.txt",),
    ),
    Step("fit", "fit the geometry", ("robot", "instrument", "fit", "seed"), _fitted, stages.fit, ("4-fit/*",)),
    Step(
        "validate", "hold it against unseen poses", ("robot", "instrument", "poses", "fit", "seed"), _validated,
        stages.validate, ("5-validation/metrics.json", "5-validation/errors.csv", "5-validation/rows.json"),
    ),
    Step("export", "write the calibrated robot", ("robot",), _exported, stages.export, ("6-export/*",)),
    Step(
        "certificate", "print the certificate", ("name", "created", "instrument", "poses", "fit"), _certified,
        stages.certify, ("certificate.html",),
    ),
)  # fmt: skip


def find(name: str) -> Step:
    """Return a step by its name or number.

    Raises:
        SessionError: with the names there are.
    """
    for number, step in enumerate(STEPS, 1):
        if name in (step.name, str(number)):
            return step
    raise SessionError(f"no step '{name}'; there are {', '.join(step.name for step in STEPS)}")


def states(session: Session) -> list[State]:
    """Return how every step stands."""
    recorded, result, current = read_state(session), [], True
    for step in STEPS:
        state = _state(session, step, recorded) if current else _behind(session, step, recorded)
        result.append(state)
        current = current and state.kind in (DONE, KEPT)
    return result


def _behind(session: Session, step: Step, recorded: dict[str, Any]) -> State:
    words = "made before; an earlier step comes first" if step.name in recorded["steps"] else "comes later"
    return State(step, AFTER, words)


def _state(session: Session, step: Step, recorded: dict[str, Any]) -> State:
    entry = recorded["steps"].get(step.name)
    if missing := _missing(session, step):
        return State(step, WAITING, missing)
    if recorded.get("running") == step.name:
        return State(step, READY, "was interrupted; will be made again")
    if entry is None:
        return State(step, READY, step.purpose)
    if changes := _changes(entry["inputs"], _inputs(session, step)):
        if step.name == "select" and stages.measured_files(session)[0]:
            return State(step, KEPT, f"{changes}; kept, since files were measured to it (calib redo select: new poses)")
        return State(step, STALE, changes)
    gone = [name for name in entry["outputs"] if not session.path(name).exists()]
    if gone:
        return State(step, STALE, f"{gone[0]} is gone")
    replaced = [name for name, mark in entry["outputs"].items() if fingerprint(session.path(name)) != mark]
    by_hand = f"; replaced by hand: {', '.join(replaced)}" if replaced else ""
    return State(step, DONE, f"{entry['finished'][:16].replace('T', ' ')}{by_hand}")


def _missing(session: Session, step: Step) -> str:
    """Say which of people's files a step waits for."""
    fit, unseen = stages.measured_files(session)
    if step.name == "measure" and not fit:
        return "a file of measured poses"
    if step.name == "validate" and session.settings.poses["validation"] and not unseen:
        return "a file of measured validation poses"
    absent = [path for path in step.inputs(session) if not path.exists()]
    own = [path for path in absent if not path.name.startswith(("poses.csv", "validation.csv", "selection.json"))]
    return f"{own[0].relative_to(session.folder)}, which is missing" if own else ""


def _inputs(session: Session, step: Step) -> dict[str, str]:
    """Return the fingerprints of what a step depends on."""
    marks = {str(path.relative_to(session.folder)): fingerprint(path) for path in step.inputs(session) if path.exists()}
    for section in step.settings:
        marks[f"session.toml [{section}]"] = json.dumps(getattr(session.settings, section), sort_keys=True)
    return marks


def _changes(before: dict[str, str], now: dict[str, str]) -> str:
    """Say what differs between two sets of fingerprints."""
    changed = [name for name in now if name in before and before[name] != now[name]]
    added, gone = sorted(set(now) - set(before)), sorted(set(before) - set(now))
    parts = [f"{name} has changed" for name in changed]
    parts += [f"{name} is new" for name in added] + [f"{name} is gone" for name in gone]
    return ", ".join(parts)


def run_next(session: Session, say: Say, progress: Say, command: str = "calib next") -> State | None:
    """Run every step that can run, up to the next one that waits for people; return that one, None at the end.

    The session has to be locked.
    """
    stages.clear_staging(session)
    while True:
        state = next((each for each in states(session) if each.kind not in (DONE, KEPT)), None)
        if state is None or state.kind == WAITING:
            return state
        _run(session, state.step, say, progress, command)


def _run(session: Session, step: Step, say: Say, progress: Say, command: str) -> None:
    number = STEPS.index(step) + 1
    recorded = read_state(session)
    recorded["steps"].pop(step.name, None)
    write_state(session, recorded | {"running": step.name})
    inputs, started = _inputs(session, step), time.perf_counter()
    progress(step.purpose)
    try:
        notes = step.make(session, progress)
    except BaseException:
        write_state(session, recorded)
        raise
    produced = sorted({path for name in step.outputs for path in session.folder.glob(name) if path.is_file()})
    recorded["steps"][step.name] = {
        "finished": datetime.now().astimezone().isoformat(timespec="seconds"),
        "seconds": round(time.perf_counter() - started, 2),
        "command": command,
        "toolkit": stages.certificate.versions(),
        "inputs": inputs,
        "outputs": {str(path.relative_to(session.folder)): fingerprint(path) for path in produced},
        "notes": notes,
    }
    recorded.pop("running", None)
    write_state(session, recorded)
    say(f"{number} {step.name}: {notes[0] if notes else 'done'}")
    for note in notes[1:]:
        say(f"    {note}")


def forget(session: Session, step: Step) -> None:
    """Let a step and all behind it be made again."""
    recorded = read_state(session)
    for later in STEPS[STEPS.index(step) :]:
        recorded["steps"].pop(later.name, None)
    write_state(session, recorded)


def asks(session: Session, state: State) -> tuple[str, str]:
    """Return two lines: what to do at the robot, and which file to bring, in which form."""
    if state.kind == WAITING and state.step.name in ("measure", "validate"):
        name = "poses" if state.step.name == "measure" else "validation"
        target = "measured.csv" if name == "poses" else "validation.csv"
        both = name == "poses" and not stages.measured_files(session)[1]
        return _at_the_robot(session, name, both), _form(session, target, both)
    return f"step {state.step.name} needs {state.words}", f"put it into {session.folder} and run calib next again"


def _at_the_robot(session: Session, name: str, both: bool) -> str:
    path = session.path(f"2-poses/{name}.csv")
    what = "pose" if session.settings.instrument["measures"] == "pose" else "position"
    device = session.settings.instrument["name"]
    if not session.settings.poses["plan"] or not path.exists():
        return f"Measure the target's {what} with the {device} at poses all over the workspace."
    count = sum(1 for _ in path.open()) - 1
    return (
        f"Drive the {count} poses of {path}{_and_validation(session) if both else ''}, let the arm settle, measure the "
        f"target's {what} with the {device} and log the joint angles read back."
    )


def _and_validation(session: Session) -> str:
    """Name the list of validation poses, so that the robot is visited once."""
    path = session.path("2-poses/validation.csv")
    if not session.settings.poses["validation"] or not path.exists():
        return ""
    return f" and, into a file of their own, the {sum(1 for _ in path.open()) - 1} of {path} (never fitted)"


def _form(session: Session, target: str, both: bool) -> str:
    try:
        joints = stages.chain_of(session).joint_names
    except Exception as error:
        raise SessionError(f"the robot cannot be read: {error}") from error
    full = session.settings.instrument["measures"] == "pose"
    columns = ", ".join((*(f"{joint} [deg]" for joint in joints), *(f"{axis} [mm]" for axis in "xyz")))
    quaternion = ", qx, qy, qz, qw" if full else ""
    files = [str(session.path("3-measured") / target)]
    if both and session.settings.poses["validation"]:
        files.append(str(session.path("3-measured/validation.csv")))
    each = f"Bring {' and '.join(files)}, one row per pose: {columns}{quaternion} (calib formats measurements)"
    return f"{each}; then: calib next {session.folder}"

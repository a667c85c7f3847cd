"""Status of a session's steps (done, stale, waiting …), and the run of the next steps.

A step is done while its inputs have the fingerprints that were recorded with it. Outputs that a person has replaced
are kept and reported. A running step is marked; if its command was killed, the step is repeated.

`STEPS` lists the steps: the files that each reads and writes, its settings, and the files that people provide.
"""

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from calib.errors import SessionError
from calib.extensions import Point
from calib.files import fingerprint
from calib.procedure.excitation.coefficients import NAME as MOTION
from calib.procedure.findings import Warned
from calib.procedure.report.templates import versions
from calib.procedure.session import dynamics_steps, folder, geometry_steps
from calib.procedure.session.folder import Say, Session, StateFile, StepRecord, read_state
from calib.procedure.session.geometry_steps import clear_staging
from calib.procedure.session.settings import default_keys

MORE_STEPS: "Point[SessionStep]" = Point("steps", "steps after the export")

FOLDERS = {"geometry": ("2-", "3-", "4-", "5-", "export/"), "dynamics": ("6-", "7-", "8-")}  # of one stage alone


@dataclass(frozen=True)
class SessionStep:
    """A step of a session: inputs, outputs, settings and function.

    Attributes:
        name, purpose: for people.
        make: runs it; returns what is to be said.
        reads: the files it reads, by names between blanks: of the session, with ``?`` where one may be missing;
            ``fit/`` and ``export/`` stand for the folders of this session; ``poses:constraints``: what that key of
            ``session.toml`` names; ``measured`` …: what people brought (`BROUGHT`).
        makes: names or patterns of what it makes.
        settings: sections of ``session.toml`` it depends on, or keys of one (``dynamics.period,rate``).
        stage: ``geometry`` or ``dynamics``, where only sessions with that have it; ``need``: those that state one.
        brings: what people bring before it, and in words.
        kept: what it is not made again for, once that is brought, and in words; empty: always made again.
    """

    name: str
    purpose: str
    make: Callable[[Session, Say], list[str]]
    reads: str
    makes: str
    settings: str
    stage: str = ""
    brings: tuple[str, str] = ("", "")
    kept: tuple[tuple[str, ...], str] = ((), "")

    def inputs(self, session: Session) -> dict[Path, bool]:
        """Return the files that the step reads, and for each whether it may be missing."""
        names = self.reads.split()
        return {path: name.endswith("?") for name in names for path in _paths(session, name.rstrip("?"))}

    def waits(self, session: Session) -> str:
        """Return a text on the user's files that the step waits for; empty if none are missing."""
        kind, words = self.brings
        poses, dynamics = session.settings.poses, session.settings.dynamics
        holdouts = {"validation": (poses, session.settings.fit), "unseen": (dynamics, dynamics)}
        if kind in holdouts:
            planned, judged = holdouts[kind]
            if not planned.validation or judged.holdout:
                return ""
        return "" if not kind or session.brought(kind) else words


def _paths(session: Session, name: str) -> Iterator[Path]:
    """Yield the paths of the files that a name in `SessionStep.reads` denotes."""
    left_out = () if session.geometric else FOLDERS["geometry"]
    left_out += () if session.dynamic else FOLDERS["dynamics"]
    if name in folder.BROUGHT:
        yield from session.files_brought(name)
    elif name.startswith("fit/"):
        yield session.fit.path / name.removeprefix("fit/")
    elif ":" in name:
        section, key = name.split(":")
        if named := getattr(getattr(session.settings, section), key):
            yield session.path(named)
    elif not name.startswith(left_out) and not (name == folder.VERDICT and session.geometric):
        yield session.path(name.replace("export/", f"{session.export}/"))


MODEL = "torques,friction,method,options,payloads,holdout"
STEPS = (
    SessionStep(
        "describe",
        "read the robot",
        geometry_steps.describe,
        "robot:file",
        f"{folder.SUMMARY} {folder.AS_GIVEN}/*",
        "robot",
    ),
    SessionStep(
        "select",
        "choose the poses to measure",
        geometry_steps.select,
        "robot:file poses:constraints",
        f"2-poses/{folder.POSES} 2-poses/{folder.WAYS} 2-poses/{folder.UNSEEN} "
        f"{folder.SELECTION} {folder.PREDICTED} {folder.PREDICTION}",
        "robot instrument poses seed",
        "geometry",
        kept=(("measured",), "these poses were already measured; `calib redo select` chooses new ones"),
    ),
    SessionStep(
        "measure",
        "check what was measured",
        geometry_steps.arrive,
        f"robot:file 2-poses/{folder.POSES}? fit:options measured drift",
        folder.POSES_CHECKED,
        "robot instrument poses fit",
        "geometry",
        ("measured", "a file of measured poses"),
    ),
    SessionStep(
        "fit",
        "fit the geometry",
        geometry_steps.fit,
        f"robot:file fit:options measured {folder.MASSES}/dynamics.json?",
        "4-fit/*",
        "robot instrument fit seed",
        "geometry",
    ),
    SessionStep(
        "validate",
        "validate the geometry on unseen poses",
        geometry_steps.validate,
        f"fit/robot.toml fit/report.json 2-poses/{folder.UNSEEN}? fit:options validation",
        "5-validation/*",
        "robot instrument poses fit seed",
        "geometry",
        ("validation", "a file of measured validation poses"),
    ),
    SessionStep(
        "excite",
        "design the motions to record",
        dynamics_steps.excite,
        "fit/robot.toml dynamics:limits",
        "6-excitation/training/* 6-excitation/validation/*",
        "dynamics.plan,validation,period,harmonics,rate,starts,evaluations,limits seed",
        "dynamics",
        kept=(("training", "unseen"), "these motions were already recorded; `calib redo excite` designs new ones"),
    ),
    SessionStep(
        "record",
        "check what was recorded",
        dynamics_steps.record,
        f"fit/robot.toml 6-excitation/training/{MOTION}? dynamics:options training",
        f"{folder.MOTION_CHECKED} {folder.CUTS}",
        "dynamics.plan,repeats,torques,options,payloads,holdout",
        "dynamics",
        ("training", "a recording of the training motion"),
    ),
    SessionStep(
        "identify",
        "identify the dynamics",
        dynamics_steps.identify,
        f"fit/robot.toml {folder.CUTS} dynamics:options training",
        "8-dynamics/*",
        f"dynamics.{MODEL} seed",
        "dynamics",
    ),
    SessionStep(
        "predict",
        "validate the dynamics on unseen motion",
        dynamics_steps.predict,
        "8-dynamics/robot.toml 8-dynamics/dynamics.json 8-dynamics/metrics.json "
        f"6-excitation/validation/{MOTION}? {folder.CUTS} dynamics:options training unseen",
        "8-dynamics/unseen/*",
        f"dynamics.plan,validation,repeats,tolerance_percent,{MODEL} seed",
        "dynamics",
        ("unseen", "a recording of the validation motion"),
    ),
    SessionStep(
        "export",
        "write the calibrated robot",
        geometry_steps.export,
        "robot:file fit/robot.toml 4-fit/robot.urdf 5-validation/metrics.json 8-dynamics/dynamics.json "
        "8-dynamics/estimate.csv 8-dynamics/covariance.csv 8-dynamics/unseen/report.json",
        f"6-export/* 9-export/* {folder.VERDICT}",
        "robot",
    ),
)


DONE, READY, WAITING, STALE, KEPT, AFTER = "done", "ready", "waiting", "stale", "kept", "after"


@dataclass(frozen=True)
class State:
    """Status of a step, and the reason."""

    step: SessionStep
    kind: str
    words: str


def steps_of(session: Session) -> tuple[SessionStep, ...]:
    """Return the steps of a session, without those of stages that the settings exclude."""
    left_out = {"dynamics": not session.dynamic, "geometry": not session.geometric, "need": not session.needs}
    return tuple(step for step in (*STEPS, *MORE_STEPS.all()) if not left_out.get(step.stage))


def find(session: Session, name: str) -> SessionStep:
    """Return a step by its name or number.

    Raises:
        SessionError: with the names there are.
    """
    there = steps_of(session)
    for number, step in enumerate(there, 1):
        if name in (step.name, str(number)):
            return step
    if stage := next((step.stage for step in (*STEPS, *MORE_STEPS.all()) if step.name == name), ""):
        keys = {"dynamics": "wanted = true under [dynamics]", "need": "sigma_percent under [dynamics]"}
        key = keys.get(stage, "what measures under [instrument]")
        raise SessionError(f"this session does not include the {stage}; for '{name}' write {key} in session.toml")
    raise SessionError(f"unknown step '{name}'; steps: {', '.join(step.name for step in there)}")


def states(session: Session) -> list[State]:
    """Return the status of every step."""
    recorded, result, current = read_state(session), [], True
    for step in steps_of(session):
        words = (
            "was completed, but an earlier step has to be repeated first"
            if step.name in recorded.steps
            else "comes later"
        )
        state = _state(session, step, recorded) if current else State(step, AFTER, words)
        result.append(state)
        current = current and state.kind in (DONE, KEPT)
    return result


def _state(session: Session, step: SessionStep, recorded: StateFile) -> State:
    entry = recorded.steps.get(step.name)
    if missing := _missing(session, step):
        return State(step, WAITING, missing)
    if recorded.running == step.name:
        return State(step, READY, "was interrupted; will be repeated")
    if entry is None:
        return State(step, READY, step.purpose)
    if changes := changed_inputs(entry.inputs, _inputs(session, step)):
        kinds, used = step.kept
        if session.brought(*kinds):
            return State(step, KEPT, f"{changes}; kept, since {used}")
        return State(step, STALE, changes)
    gone = [name for name in entry.outputs if not session.path(name).exists()]
    if gone:
        return State(step, STALE, f"{gone[0]} is missing")
    replaced = [name for name, mark in entry.outputs.items() if fingerprint(session.path(name)) != mark]
    by_hand = f"; replaced manually: {', '.join(replaced)}" if replaced else ""
    return State(step, DONE, f"{entry.finished[:16].replace('T', ' ')}{by_hand}")


def _missing(session: Session, step: SessionStep) -> str:
    """Return a text on the user's files that a step waits for."""
    absent = (path for path, may_miss in step.inputs(session).items() if not may_miss and not path.exists())
    path = next(absent, None)
    return step.waits(session) or ("" if path is None else f"{path.relative_to(session.folder)}, which is missing")


def _inputs(session: Session, step: SessionStep) -> dict[str, str]:
    """Return the fingerprints of the files and settings on which a step depends."""
    marks = {str(path.relative_to(session.folder)): fingerprint(path) for path in step.inputs(session) if path.exists()}
    settings = asdict(session.settings)
    for setting in step.settings.split():
        section, _, keys = setting.partition(".")
        for key in keys.split(",") if session.dynamic or section != "dynamics" else ():
            values = settings[section]
            place = f"{folder.SETTINGS} [{section}] {key}".rstrip()
            marks[place] = json.dumps(values[key] if key else values, sort_keys=True)
    return marks


def changed_inputs(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Return a text on the differences between two sets of fingerprints."""
    changed = [name for name in now if _value(name, before.get(name, "{}")) != _value(name, now[name])]
    parts = [f"{name} {'has changed' if name in before else 'is new'}" for name in changed]
    return ", ".join([*parts, *(f"{name} is gone" for name in sorted(before.keys() - now))])


def _value(name: str, mark: str) -> Any:
    """Return a fingerprint in comparable form: settings as values (3 equals 3.0), missing keys as their defaults."""
    if not name.startswith(folder.SETTINGS):
        return mark
    section, _, key = name.removeprefix(f"{folder.SETTINGS} [").partition("]")
    value = json.loads(mark)
    if key and mark != "{}":
        value = {key.strip(): value}
    return default_keys(section) | value if isinstance(value, dict) else value


def run_next(session: Session, say: Say, progress: Say, command: str = "calib next") -> State | None:
    """Run all steps up to the next step that waits for the user; return this step, or None at the end.

    The session has to be locked.
    """
    clear_staging(session)
    with suppress(OSError):  # the folder of a session with the other stages is missing, or this one has files
        os.replace(session.path(folder.EXPORT[not session.dynamic]), session.path(session.export))
    while True:
        state = next((each for each in states(session) if each.kind not in (DONE, KEPT)), None)
        if state is None or state.kind == WAITING:
            return state
        _run(session, state.step, say, progress, command)


def _run(session: Session, step: SessionStep, say: Say, progress: Say, command: str) -> None:
    number = steps_of(session).index(step) + 1
    recorded = read_state(session).without(step.name)
    session.write_state(replace(recorded, running=step.name))
    inputs, started = _inputs(session, step), time.perf_counter()
    progress(step.purpose)
    try:
        notes = step.make(session, progress)
    except BaseException:
        session.write_state(recorded)
        raise
    produced = sorted({path for name in step.makes.split() for path in session.folder.glob(name) if path.is_file()})
    made = StepRecord(
        finished=datetime.now().astimezone().isoformat(timespec="seconds"),
        inputs=inputs,
        outputs={str(path.relative_to(session.folder)): fingerprint(path) for path in produced},
        seconds=round(time.perf_counter() - started, 2),
        command=command,
        seed=session.settings.seed,
        toolkit=versions(),
        notes=tuple(notes),
    )
    session.write_state(StateFile({**recorded.steps, step.name: made}))
    say(f"{number} {step.name}: {notes[0] if notes else 'done'}")
    for note in notes[1:]:
        say(f"    {'warning: ' if isinstance(note, Warned) else ''}{note}")


def forget(session: Session, step: SessionStep) -> None:
    """Mark a step and all steps after it to be run again, but not a design that people have carried out."""
    there = steps_of(session)
    again = (later for later in there[there.index(step) :] if later is step or not session.brought(*later.kept[0]))
    session.write_state(read_state(session).without(*(later.name for later in again)))

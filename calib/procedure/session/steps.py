"""Status of a session's steps (done, stale, waiting …), and functions that run the next steps.

A step is done as long as its inputs have the fingerprints that were recorded when the step ran. Outputs that the user
has replaced are kept and reported. A running step is marked in ``state.json``; if its command was killed, the step is
repeated. `STEPS` lists the steps with the files that each reads and writes, its settings, and the files that the user
has to provide.
"""

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path

from calib.config import parse
from calib.errors import CalibError, SessionError, command_line, require
from calib.extensions import Point
from calib.files import fingerprint
from calib.folders import COVARIANCE, ESTIMATE, METRICS, REPORT
from calib.identification.model_file import MODEL
from calib.identification.settings import Payload, mass_as_payload
from calib.procedure.excitation.coefficients import NAME as MOTION
from calib.procedure.findings import Note
from calib.procedure.kinematic_stage.folder import URDF
from calib.procedure.report.templates import versions
from calib.procedure.session import dynamics_steps, folder, geometry_steps
from calib.procedure.session.folder import Say, Session, StateFile, StepRecord, read_state
from calib.procedure.session.geometry_steps import clear_staging
from calib.procedure.session.settings import default_keys
from calib.robot import calibrated

MORE_STEPS: "Point[SessionStep]" = Point("steps", "steps after the export")

# beginnings of the files of one stage alone
GEOMETRIC_FILES = ("2-", "3-", "4-", "5-")
DYNAMIC_FILES = ("6-", "7-", "8-")
# states of a step
DONE, READY, WAITING, STALE, KEPT, AFTER = "done", "ready", "waiting", "stale", "kept", "after"


@dataclass(frozen=True)
class SessionFile:
    """A file in the session's folder that a step reads; it is ignored if the session lacks the stage that writes it.

    Attributes:
        name: name of the file, relative to the session's folder.
        optional: whether the file may be missing.
        without_geometry: whether the file is read only if no geometry is fitted.
    """

    name: str
    optional: bool = False
    without_geometry: bool = False

    def paths(self, session: Session) -> list[Path]:
        """Return the path of the file as a list; empty if the file does not apply to the session."""
        if self.name.startswith(GEOMETRIC_FILES) and not session.geometric:
            return []
        if self.name.startswith(DYNAMIC_FILES) and not session.dynamic:
            return []
        if self.without_geometry and session.geometric:
            return []
        return [session.path(self.name)]


@dataclass(frozen=True)
class FitFile:
    """A file that a step reads from the folder of the fit or, without a fit, from the folder of the nominal robot."""

    name: str
    optional: bool = False

    def paths(self, session: Session) -> list[Path]:
        """Return the path of the file in a session's folder of the fit, as a list."""
        return [session.fit.path / self.name]


@dataclass(frozen=True)
class ExportedFile:
    """A file that a step reads from the folder of the export; it does not apply if no geometry is fitted."""

    name: str
    optional: bool = False

    def paths(self, session: Session) -> list[Path]:
        """Return the path of the file in a session's export, as a list; empty if the session fits no geometry."""
        return [session.path(f"{session.export}/{self.name}")] if session.geometric else []


@dataclass(frozen=True)
class NamedFile:
    """A file that a step reads and that a key of ``session.toml`` names; it does not apply if the key is empty."""

    section: str
    key: str
    optional: bool = False

    def paths(self, session: Session) -> list[Path]:
        """Return the path of the file that a session's settings name, as a list; empty if the key is empty."""
        name = getattr(getattr(session.settings, self.section), self.key)
        return [session.path(name)] if name else []


@dataclass(frozen=True)
class UserFiles:
    """Files that the user provides and a step reads; `kind` is a key of `folder.BROUGHT`."""

    kind: str
    optional: bool = False

    def paths(self, session: Session) -> list[Path]:
        """Return the paths of the files in a session's folder, including files in folders that the user provided."""
        return session.files_brought(self.kind)


@dataclass(frozen=True)
class StatedConstraints:
    """The Python file of constraints that the identification options name; it does not apply if they name none."""

    optional: bool = False

    def paths(self, session: Session) -> list[Path]:
        """Return the path of the file of constraints, as a list; empty without one, or with unreadable options."""
        try:
            constraints = dynamics_steps.options_of(session).settings.constraints
        except CalibError:
            # the step that reads the options says what is wrong with them
            return []
        return [Path(constraints.file)] if constraints is not None and constraints.file else []


Input = SessionFile | FitFile | ExportedFile | NamedFile | StatedConstraints | UserFiles


@dataclass(frozen=True)
class StepSetting:
    """A section or value of ``session.toml`` on which a step depends.

    Attributes:
        section: name of the section, or key outside sections.
        keys: keys of the section on which the step depends; empty: all keys.
    """

    section: str
    keys: tuple[str, ...] = ()


# makes the outputs of a step and returns notes
Make = Callable[[Session, Say], Sequence[str | Note]]


@dataclass(frozen=True)
class SessionStep:
    """A step of a session: inputs, outputs, settings and function.

    Attributes:
        name, purpose: name, and purpose as text for the user.
        make: function that runs the step and returns notes for the user.
        reads: files that the step reads.
        makes: names or patterns of the files that the step writes.
        settings: sections and keys of ``session.toml`` on which the step depends.
        stage: ``geometry`` or ``dynamics``: only sessions with this stage have the step; ``need``: only sessions that
            request an accuracy have the step; empty: all sessions have the step.
        brings: kind of files that the user provides before the step, and their description.
        kept: kinds of files whose existence keeps the step from being repeated, and the reason as text; empty: the step
            is always repeated if its inputs change.
    """

    name: str
    purpose: str
    make: Make
    reads: tuple[Input, ...]
    makes: tuple[str, ...]
    settings: tuple[StepSetting, ...]
    stage: str = ""
    brings: tuple[str, str] = ("", "")
    kept: tuple[tuple[str, ...], str] = ((), "")

    def inputs(self, session: Session) -> dict[Path, bool]:
        """Return the files of a session that the step reads: path -> whether the file may be missing."""
        paths = {}
        for source in self.reads:
            paths |= dict.fromkeys(source.paths(session), source.optional)
        return paths

    def waits(self, session: Session) -> str:
        """Return a description of the user's files for which the step of a session waits.

        Empty if no files are missing.
        """
        kind, words = self.brings
        # a part of the measured poses or recordings may be held out instead
        poses, fit, dynamics = session.settings.poses, session.settings.fit, session.settings.dynamics
        if kind == "validation" and (not poses.validation or fit.holdout):
            return ""
        if kind == "unseen" and (not dynamics.validation or dynamics.holdout):
            return ""
        if not kind:
            return ""
        return "" if session.brought(kind) else words

    def lacks(self, session: Session) -> str:
        """Return a description of further recordings that a step waits for, unless it was completed without them."""
        kind, words = self.brings
        missing = dynamics_steps.unrecorded_payloads(session) if kind == "training" else []
        if not missing:
            return ""
        return f"{words} with '{missing[0]}'; if there is none, remove [dynamics.payloads] from session.toml"


ROBOT = NamedFile("robot", "file")
FITTED_ROBOT = FitFile(calibrated.ROBOT)
FIT_OPTIONS = NamedFile("fit", "options")
IDENTIFY_OPTIONS = NamedFile("dynamics", "options")
# keys of [dynamics] on which the identified model depends
MODEL_KEYS = ("torques", "friction", "method", "options", "payloads", "holdout")
# keys of [dynamics] on which its verdict depends
TOLERANCES = ("tolerance_percent", "tolerance_torque")
# keys of [dynamics] on which a designed motion depends
DESIGN_KEYS = (
    "plan",
    "torques",
    "payloads",
    "validation",
    "period",
    "harmonics",
    "rate",
    "goals",
    "hard",
    "front",
    "starts",
    "evaluations",
    "limits",
)
STEPS = (
    SessionStep(
        "describe",
        "read the robot",
        geometry_steps.describe,
        reads=(ROBOT,),
        makes=(folder.SUMMARY, f"{folder.AS_GIVEN}/*"),
        settings=(StepSetting("robot"),),
    ),
    SessionStep(
        "select",
        "choose the poses to measure",
        geometry_steps.select,
        reads=(ROBOT, NamedFile("poses", "constraints")),
        makes=(
            f"2-poses/{folder.POSES}",
            f"2-poses/{folder.WAYS}",
            f"2-poses/{folder.UNSEEN}",
            folder.SELECTION,
            folder.PREDICTED,
            folder.PREDICTION,
        ),
        settings=(StepSetting("robot"), StepSetting("instrument"), StepSetting("poses"), StepSetting("seed")),
        stage="geometry",
        kept=(("measured",), "these poses were already measured; `calib redo select` chooses new ones"),
    ),
    SessionStep(
        "measure",
        "check what was measured",
        geometry_steps.arrive,
        reads=(
            ROBOT,
            SessionFile(f"2-poses/{folder.POSES}", optional=True),
            FIT_OPTIONS,
            UserFiles("measured"),
            UserFiles("drift"),
        ),
        makes=(folder.POSES_CHECKED,),
        settings=(StepSetting("robot"), StepSetting("instrument"), StepSetting("poses"), StepSetting("fit")),
        stage="geometry",
        brings=("measured", "a file of measured poses"),
    ),
    SessionStep(
        "fit",
        "fit the geometry",
        geometry_steps.fit,
        reads=(ROBOT, FIT_OPTIONS, UserFiles("measured"), SessionFile(f"{folder.MASSES}/{MODEL}", optional=True)),
        makes=("4-fit/*",),
        settings=(StepSetting("robot"), StepSetting("instrument"), StepSetting("fit"), StepSetting("seed")),
        stage="geometry",
    ),
    SessionStep(
        "validate",
        "validate the geometry on unseen poses",
        geometry_steps.validate,
        reads=(
            FITTED_ROBOT,
            FitFile(REPORT),
            SessionFile(f"2-poses/{folder.UNSEEN}", optional=True),
            FIT_OPTIONS,
            UserFiles("validation"),
        ),
        makes=("5-validation/*",),
        settings=(
            StepSetting("robot"),
            StepSetting("instrument"),
            StepSetting("poses"),
            StepSetting("fit"),
            StepSetting("seed"),
        ),
        stage="geometry",
        brings=("validation", "a file of measured validation poses"),
    ),
    SessionStep(
        "excite",
        "design the motions to record",
        dynamics_steps.excite,
        reads=(FITTED_ROBOT, NamedFile("dynamics", "limits"), IDENTIFY_OPTIONS),
        makes=("6-excitation/training/*", "6-excitation/validation/*"),
        settings=(StepSetting("dynamics", DESIGN_KEYS), StepSetting("seed")),
        stage="dynamics",
        kept=(("training", "unseen"), "these motions were already recorded; `calib redo excite` designs new ones"),
    ),
    SessionStep(
        "record",
        "check what was recorded",
        dynamics_steps.record,
        reads=(
            FITTED_ROBOT,
            SessionFile(f"6-excitation/training/{MOTION}", optional=True),
            IDENTIFY_OPTIONS,
            UserFiles("training"),
        ),
        makes=(folder.MOTION_CHECKED, folder.CUTS),
        settings=(StepSetting("dynamics", ("plan", "repeats", "torques", "options", "payloads", "holdout")),),
        stage="dynamics",
        brings=("training", "a recording of the training motion"),
    ),
    SessionStep(
        "identify",
        "identify the dynamics",
        dynamics_steps.identify,
        reads=(FITTED_ROBOT, SessionFile(folder.CUTS), IDENTIFY_OPTIONS, StatedConstraints(), UserFiles("training")),
        makes=("8-dynamics/*",),
        settings=(StepSetting("dynamics", MODEL_KEYS), StepSetting("seed")),
        stage="dynamics",
    ),
    SessionStep(
        "predict",
        "validate the dynamics on unseen motion",
        dynamics_steps.predict,
        reads=(
            SessionFile(f"8-dynamics/{calibrated.ROBOT}"),
            SessionFile(f"8-dynamics/{MODEL}"),
            SessionFile(f"8-dynamics/{METRICS}"),
            SessionFile(f"6-excitation/validation/{MOTION}", optional=True),
            SessionFile(folder.CUTS),
            IDENTIFY_OPTIONS,
            UserFiles("training"),
            UserFiles("unseen"),
        ),
        makes=("8-dynamics/unseen/*",),
        settings=(
            StepSetting("dynamics", ("plan", "validation", "repeats", *TOLERANCES, *MODEL_KEYS)),
            StepSetting("seed"),
        ),
        stage="dynamics",
        brings=("unseen", "a recording of the validation motion"),
    ),
    SessionStep(
        "export",
        "write the calibrated robot",
        geometry_steps.export,
        reads=(
            ROBOT,
            FITTED_ROBOT,
            SessionFile(f"4-fit/{URDF}"),
            SessionFile(f"5-validation/{METRICS}"),
            SessionFile(f"8-dynamics/{MODEL}"),
            SessionFile(f"8-dynamics/{ESTIMATE}"),
            SessionFile(f"8-dynamics/{COVARIANCE}"),
            SessionFile(f"8-dynamics/unseen/{REPORT}"),
        ),
        makes=("6-export/*", "9-export/*", folder.VERDICT),
        settings=(StepSetting("robot"),),
    ),
)


@dataclass(frozen=True)
class State:
    """Status of a step (such as `DONE` or `WAITING`), and a text with the reason."""

    step: SessionStep
    kind: str
    words: str


def all_steps() -> tuple[SessionStep, ...]:
    """Return the steps of all kinds of sessions, in the order in which they run."""
    return (*STEPS, *MORE_STEPS.all())


def steps_of(session: Session) -> tuple[SessionStep, ...]:
    """Return the steps of a session, without those of stages that its settings exclude."""
    included = {"": True, "dynamics": session.dynamic, "geometry": session.geometric, "need": session.needs}
    return tuple(step for step in all_steps() if included[step.stage])


def find(session: Session, name: str) -> SessionStep:
    """Return a step of a session by its name or number.

    Raises:
        SessionError: for an unknown step, or a step that the session's settings exclude; the message gives advice.
    """
    included = steps_of(session)
    for number, step in enumerate(included, 1):
        if name in (step.name, str(number)):
            return step
    for step in all_steps():
        if step.name == name:
            keys = {"dynamics": "wanted = true under [dynamics]", "need": "sigma_percent under [dynamics]"}
            key = keys.get(step.stage, "what measures under [instrument]")
            raise SessionError(
                f"this session does not include the {step.stage}; for '{name}' write {key} in session.toml"
            )
    raise SessionError(f"unknown step '{name}'; steps: {', '.join(step.name for step in included)}")


def states(session: Session) -> list[State]:
    """Return the status of every step of a session."""
    recorded = read_state(session)
    result: list[State] = []
    for step in steps_of(session):
        if all(state.kind in (DONE, KEPT) for state in result):
            result.append(_state(session, step, recorded))
        elif step.name in recorded.steps:
            result.append(State(step, AFTER, "was completed, but an earlier step has to be repeated first"))
        else:
            result.append(State(step, AFTER, "comes later"))
    return result


def _state(session: Session, step: SessionStep, recorded: StateFile) -> State:
    """Return the status of a step whose preceding steps are all done.

    Args:
        session: the session.
        step: the step.
        recorded: content of ``state.json``.
    """
    missing = _missing(session, step)
    if missing:
        return State(step, WAITING, missing)
    if recorded.running == step.name:
        return State(step, READY, "was interrupted; will be repeated")
    entry = recorded.steps.get(step.name)
    changes = "" if entry is None else changed_inputs(entry.inputs, _fingerprints(session, step))
    lacking = step.lacks(session) if entry is None or changes else ""
    if lacking:
        return State(step, WAITING, lacking)
    if entry is None:
        return State(step, READY, step.purpose)
    if changes:
        kinds, reason = step.kept
        if session.brought(*kinds):
            return State(step, KEPT, f"{changes}; kept, since {reason}")
        return State(step, STALE, changes)
    for name in entry.outputs:
        if not session.path(name).exists():
            return State(step, STALE, f"{name} is missing")
    replaced = [name for name, mark in entry.outputs.items() if fingerprint(session.path(name)) != mark]
    words = entry.finished[:16].replace("T", " ")
    if replaced:
        words += f"; replaced manually: {', '.join(replaced)}"
    return State(step, DONE, words)


def _missing(session: Session, step: SessionStep) -> str:
    """Return a description of the files for which a step of a session waits; empty if no files are missing."""
    waits = step.waits(session)
    if waits:
        return waits
    for path, optional in step.inputs(session).items():
        if not optional and not path.exists():
            return f"{path.relative_to(session.folder)}, which is missing"
    return ""


def _fingerprints(session: Session, step: SessionStep) -> dict[str, str]:
    """Return the fingerprints of a session's files and settings on which a step depends.

    Returns:
        Name -> SHA-256 of the file, or value of the setting as JSON.
    """
    marks = {}
    for path in step.inputs(session):
        if path.exists():
            marks[str(path.relative_to(session.folder))] = fingerprint(path)
    values = asdict(session.settings)
    for setting in step.settings:
        section = setting.section
        if section == "dynamics" and not session.dynamic:
            continue
        if not setting.keys:
            marks[f"{folder.SETTINGS} [{section}]"] = json.dumps(values[section], sort_keys=True)
        for key in setting.keys:
            marks[f"{folder.SETTINGS} [{section}] {key}"] = json.dumps(values[section][key], sort_keys=True)
    return marks


def changed_inputs(before: Mapping[str, str], after: Mapping[str, str]) -> str:
    """Return a text on the differences between two sets of fingerprints; empty if there are none.

    Args:
        before, after: name of a file or setting -> fingerprint.
    """
    parts = []
    for name, mark in after.items():
        if name not in before and _comparable(name, "{}") != _comparable(name, mark):
            parts.append(f"{name} is new")
        if name in before and _comparable(name, before[name]) != _comparable(name, mark):
            parts.append(f"{name} has changed")
    parts += [f"{name} was removed" for name in sorted(before.keys() - after)]
    return ", ".join(parts)


def _comparable(name: str, mark: str) -> object:
    """Return a fingerprint in a form that can be compared.

    Settings are compared as values (3 equals 3.0), with defaults for missing keys.

    Args:
        name: name of a file or setting.
        mark: fingerprint of the file or setting.
    """
    if not name.startswith(folder.SETTINGS):
        return mark
    section, _, key = name.removeprefix(f"{folder.SETTINGS} [").partition("]")
    value = json.loads(mark)
    if key.strip() == "payloads":
        # records of older sessions state masses alone
        return {label: parse(Payload, mass_as_payload(payload), name) for label, payload in value.items()}
    if key and mark != "{}":
        value = {key.strip(): value}
    if isinstance(value, dict):
        return json.loads(json.dumps(default_keys(section))) | value
    return value


def run_next(session: Session, say: Say, progress: Say, command: str = "calib next") -> State | None:
    """Run steps of a session until one has to wait for the user.

    The caller has to lock the session.

    Args:
        session: the session, locked.
        say, progress: functions that print permanent lines, and progress messages.
        command: the command to record for the steps.

    Returns:
        The status of the step that waits; None if all steps are done.
    """
    clear_staging(session)
    # the folder of a session with the other stages is missing, or this one has files
    with suppress(OSError):
        os.replace(session.path(folder.EXPORT[not session.dynamic]), session.path(session.export))
    while True:
        pending = [state for state in states(session) if state.kind not in (DONE, KEPT)]
        if not pending:
            return None
        if pending[0].kind == WAITING:
            return pending[0]
        _run(session, pending[0].step, say, progress, command)


def run_instead(session: Session, step: SessionStep, make: Make, say: Say, progress: Say, command: str) -> None:
    """Run a step with another function, such as one that takes a stored motion instead of a search.

    Args:
        session: the session, locked.
        step: the step.
        make: function that makes the step's outputs and returns notes.
        say, progress: functions that print permanent lines, and progress messages.
        command: the command for the record.

    Raises:
        SessionError: if an earlier step is not completed, or people have carried out what the step planned.
    """
    go_on = command_line("next", session.folder)
    kinds, reason = step.kept
    for state in states(session):
        if state.step.name == step.name:
            require(not session.brought(*kinds), f"step {step.name}: {reason}", SessionError)
            require(state.kind == DONE, f"step {step.name}: {state.words}; first repeat it: {go_on}", SessionError)
            break
        require(state.kind in (DONE, KEPT), f"first complete the step {state.step.name}: {go_on}", SessionError)
    _run(session, replace(step, make=make), say, progress, command)


def _run(session: Session, step: SessionStep, say: Say, progress: Say, command: str) -> None:
    """Run a step, record it in ``state.json``, and print its notes.

    Args:
        session: the session, locked.
        step: the step.
        say, progress: functions that print permanent lines, and progress messages.
        command: the command for the record.
    """
    number = [included.name for included in steps_of(session)].index(step.name) + 1
    recorded = read_state(session).without(step.name)
    session.write_state(replace(recorded, running=step.name))
    # files that change while the step runs make it stale
    inputs = _fingerprints(session, step)
    started = time.perf_counter()
    progress(step.purpose)
    try:
        notes = step.make(session, progress)
    except BaseException:
        session.write_state(recorded)
        raise
    produced: set[Path] = set()
    for pattern in step.makes:
        produced.update(path for path in session.folder.glob(pattern) if path.is_file())
    outputs = {str(path.relative_to(session.folder)): fingerprint(path) for path in sorted(produced)}
    record = StepRecord(
        finished=datetime.now().astimezone().isoformat(timespec="seconds"),
        inputs=inputs,
        outputs=outputs,
        seconds=round(time.perf_counter() - started, 2),
        command=command,
        seed=session.settings.seed,
        toolkit=versions(),
        notes=tuple(str(note) for note in notes),
    )
    session.write_state(StateFile({**recorded.steps, step.name: record}))
    say(f"{number} {step.name}: {notes[0] if notes else 'done'}")
    for note in notes[1:]:
        warning = ""
        if isinstance(note, Note) and note.is_warning:
            warning = "warning: "
        say(f"    {warning}{note}")


def forget(session: Session, step: SessionStep) -> None:
    """Mark a step and all later steps of a session as not done, so that they run again.

    Later steps that selected poses or designed motions are not marked if the user has already measured or recorded
    them.
    """
    included = steps_of(session)
    names = [step.name]
    for later in included[included.index(step) + 1 :]:
        kinds, _ = later.kept
        if not session.brought(*kinds):
            names.append(later.name)
    session.write_state(read_state(session).without(*names))

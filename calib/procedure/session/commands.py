"""The guided procedure behind the commands `calib new`, `calib next`, `calib status` and `calib redo`.

A waiting session prints two texts: the task at the robot, and the file to provide with its format.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from calib.arguments import checked
from calib.config import parse
from calib.config_types import ParsedTable, Plots
from calib.controllers.axes import check_controller
from calib.data.csv_table import read_table
from calib.data.poses import IMAGES
from calib.errors import UsageError, command_line, require
from calib.folders import CERTIFICATE, PAGES, SESSION
from calib.geometry.observability import targets_of
from calib.procedure.dynamic_stage.computed_torque import check_tolerances
from calib.procedure.excitation.coefficients import RUN, SAMPLES
from calib.procedure.excitation.limits import read_motion_limits
from calib.procedure.kinematic_stage.folder import CORRECTED_URDF, TERMS, URDF
from calib.procedure.measuring.constraints_file import UNKNOWN, beside
from calib.procedure.measuring.pose_limits import read_limits, tables_of
from calib.procedure.report import page
from calib.procedure.robot_kinds import stage_of
from calib.procedure.session import steps
from calib.procedure.session.dynamics_steps import design_motions, picked_front, unrecorded_payloads
from calib.procedure.session.folder import POSES, UNSEEN, WAYS, Say, Session, create, locked, open_session, read_state
from calib.procedure.session.geometry_steps import chain_of
from calib.procedure.session.questions import instrument_named
from calib.procedure.session.recording_names import labels_in, log_name
from calib.procedure.session.second_round import promised
from calib.procedure.session.settings import NOTHING, SessionSettings
from calib.procedure.session.steps import DONE, KEPT, WAITING, State
from calib.robot.chain import Chain
from calib.robot.collision import meshes_beside
from calib.robot.library import load, resolve
from calib.robot.tables import dumps
from calib.units import JOINT

# units of a log: positions and torques
UNITS = {"prismatic": ("m", "N"), "revolute": ("deg", "Nm")}
# the file of the cell in a session, and a camera's files beside it
LIMITS = "limits.toml"
CAMERA_FILES = {"lens": "camera.yaml", "board": "board.toml"}
LIMITS_HEAD = "# The cell, as given to `calib new`. `calib formats limits` lists the possible keys.\n"
# files of measured poses, as they are proposed, by the list of planned ones
MEASURED_FILES = {POSES: "measured.csv", UNSEEN: "validation_measured.csv"}


def asks(session: Session, state: State) -> tuple[str, str]:
    """Return two texts for a session that waits: the task at the robot, and the file to provide with its format.

    Args:
        session: the session.
        state: status of the step that waits.
    """
    step, next_command = state.step.name, command_line("next", session.folder)
    if state.kind == WAITING and step in ("record", "predict"):
        task, file = _to_record(session, step)
    elif state.kind == WAITING and step in ("measure", "validate"):
        task, file = _to_measure(session, step)
    else:
        return f"step {step} needs {state.words}", f"put it into {session.folder} and run {next_command} again"
    return task, f"Provide {file}; then: {next_command}"


def _to_measure(session: Session, step: str) -> tuple[str, str]:
    """Return two texts: the poses to measure at the robot, and the files of measurements or images to provide.

    Args:
        session: the session.
        step: the step that waits: ``measure``, or the step for validation poses.
    """
    settings, joints = session.settings, chain_of(session).joint_names
    instrument, images = settings.instrument, settings.instrument.measures == IMAGES
    lists = [POSES] if step == "measure" else [UNSEEN]
    # both are measured in one visit, unless rows of the first are held out
    has_validation = settings.poses.validation and not settings.fit.holdout
    if step == "measure" and has_validation and not session.brought("validation"):
        lists.append(UNSEEN)

    planned = _planned_poses(session, lists)
    ways = session.path(f"2-poses/{WAYS}")
    if planned and lists[0] == POSES and not images and ways.exists():
        planned[0] += f" in their order (ways: {ways}; calib view {session.folder} rehearses them)"
    poses = " and, into a separate file, ".join(planned) or "poses all over the workspace"
    files = [str(session.path("3-measured") / MEASURED_FILES[name]) for name in lists]

    if images:
        if not planned:
            poses += ", with the board near, far and tilted"
        task = _numbered(
            f"Drive {poses}; at each let the arm settle for a second.",
            "Take an image of the board (fixed focus, zoom and exposure; images neither rotated nor scaled).",
            "Log the joint angles read back.",
        )
        folders = " and ".join(file.removesuffix(".csv") for file in files)
        return task, (
            f"{folders}: images, joints.csv (image, {joints[0]} "
            f"[deg] … {joints[-1]} [deg]; one row per image), board.toml (calib board makes boards), and camera.yaml "
            "if the lens is known (calib formats images)"
        )
    base_frame = ""
    if instrument.reference:
        base_frame = " and, at the same time, the frame on the base"
    task = _numbered(
        f"Drive {poses}; at each let the arm settle.",
        f"Measure the target's {instrument.measures}{base_frame} with the {instrument.name} "
        "and log the joint angles read back.",
        "At the end, measure the first three again to check for drift (optional, into drift.csv).",
    )
    columns = ", ".join(measured_columns(session))
    return task, (
        f"{' and '.join(files)}, one row per pose: {columns} (calib formats measurements), "
        "or joints and points apart, by calib join"
    )


def measured_columns(session: Session) -> list[str]:
    """Return the header of a file of measured poses, as a session's instrument fills it: joints, target, base frame."""
    instrument = session.settings.instrument
    columns = []
    for joint in chain_of(session).joints:
        _, unit = JOINT["prismatic" if joint.kind == "prismatic" else "revolute"]
        columns.append(f"{joint.name} [{unit}]")
    columns += ["x [mm]", "y [mm]", "z [mm]"]
    if instrument.measures == "pose":
        columns += ["qx", "qy", "qz", "qw"]
    if instrument.reference:
        columns += ["base_x [mm]", "base_y [mm]", "base_z [mm]", "base_qx", "base_qy", "base_qz", "base_qw"]
    return columns


def recorded_columns(session: Session) -> list[str]:
    """Return the header of a log of a motion, with the torques that a session asks for."""
    section, joints = session.settings.dynamics, chain_of(session).joints
    columns = ["t [s]"]
    columns += [f"q_{joint.name} [{UNITS[joint.kind][0]}]" for joint in joints]
    if section.torques != "link":
        columns += [f"tau_{joint.name} [{UNITS[joint.kind][1]}]" for joint in joints]
    if section.torques != "motor":
        columns += [f"tau_link_{joint.name} [{UNITS[joint.kind][1]}]" for joint in joints]
    return columns


def _planned_poses(session: Session, lists: Sequence[str]) -> list[str]:
    """Return a text on each existing list of planned poses: number of poses, file, and robot programs.

    Args:
        session: the session.
        lists: file names of the lists in ``2-poses``.
    """
    if not session.settings.poses.plan:
        return []
    planned = []
    for name in lists:
        path = session.path(f"2-poses/{name}")
        if not path.exists():
            continue
        noun, remark = "poses ", ""
        # the second list is that for validation
        if planned:
            noun, remark = "", " (never fitted)"
        programs = {*path.parent.glob(f"{path.stem}.*")} - {path}
        if session.settings.robot.controller and programs:
            remark = f" (program: {', '.join(map(str, sorted(programs)))}){remark}"
        planned.append(f"the {len(read_table(path))} {noun}of {path}{remark}")
    return planned


def _numbered(*parts: str) -> str:
    return "\n".join(f"{number} {part}" for number, part in enumerate(parts, 1))


def _to_record(session: Session, step: str) -> tuple[str, str]:
    """Return two texts: the motions to play, and the logs to provide.

    Args:
        session: the session.
        step: the step that waits: ``record``, or the step for the validation motion.
    """
    section, joints = session.settings.dynamics, chain_of(session).joints
    names = []
    missing = unrecorded_payloads(session) if step == "record" else []
    if step == "record" and (missing or not session.brought("training")):
        names.append("training")
    if section.validation and not section.holdout and not session.brought("unseen"):
        names.append("validation")

    if section.plan:
        task = _to_play(session, names, missing)
    else:
        task = "Record two motions of all joints: one for training, and a different one for validation."
    first, last = joints[0], joints[-1]
    (position, torque), (last_position, last_torque) = UNITS[first.kind], UNITS[last.kind]
    columns = [f"q_{first.name} [{position}] to q_{last.name} [{last_position}]"]
    if section.torques != "link":
        columns.append(f"tau_{first.name} [{torque}] to tau_{last.name} [{last_torque}]")
    if section.torques != "motor":
        columns.append(f"tau_link_{first.name} to tau_link_{last.name} (the sensors')")
    logs = []
    for name in names:
        if name == "validation" or not session.brought("training"):
            logs.append(log_name(name))
        logs += [log_name(name, label) for label in missing]
    files = " and ".join(str(session.path(f"7-recorded/{log}")) for log in logs)
    return task, (
        f"{files}, one row per sample: t [s], {', '.join(columns)}; currents are i_{first.name} [A] …; .npz and ROS "
        f"bags work, too (calib formats recordings){_present_logs(session)}"
    )


def _present_logs(session: Session) -> str:
    """Return how the recordings of a session that are there were taken by their names; empty without recordings."""
    taken = [(path, "training") for path in session.brought("training")]
    taken += [(path, "validation") for path in session.brought("unseen")]
    if not taken:
        return ""
    payloads = session.settings.dynamics.payloads
    parts = []
    for path, motion in taken:
        labels = labels_in(path.stem, payloads)
        load = f" with {' and '.join(labels)}" if labels else " without payload"
        parts.append(f"{path.name} ({motion}{load if payloads else ''})")
    return f". By their names there are already: {'; '.join(parts)}"


def _to_play(session: Session, names: Sequence[str], payloads: Sequence[str]) -> str:
    """Return a text that explains how to play designed motions.

    Args:
        session: the session.
        names: names of the motions, which are folders in ``6-excitation``.
        payloads: labels of payloads with which the motions are played again.
    """
    section = session.settings.dynamics
    file = RUN if section.repeats > 1 else SAMPLES
    motions = " and, into a separate file, ".join(str(session.path(f"6-excitation/{name}/{file}")) for name in names)
    remark = " (never used for training)" if "validation" in names else ""
    parts = [
        "Rehearse: play the motion at a low override to check for collisions.",
        f"Play {motions}{remark}, the motion {section.repeats} times each, at {section.rate:g} Hz, from rest at its "
        "first row.",
        "Log joint positions and torques all the time.",
    ]
    if payloads:
        loads = " and ".join(f"'{label}' ({section.payloads[label]})" for label in payloads)
        motions_again = "both" if len(names) > 1 else "it"
        parts.append(f"Repeat {motions_again} with {loads} on the flange, into files with the label in their names.")
    return _numbered(*parts)


COLOURS = {
    **page.COLOURS,
    "done": "green",
    "kept": "green",
    "ready": "cyan",
    "stale": "yellow",
    "waiting": "yellow",
    "waits": "yellow",
    "after": "dim",
    "failed": "red",
}


@dataclass(frozen=True)
class _Stop:
    """Result of `go_on`.

    Attributes:
        session: the session.
        waiting: status of the step that waits for the user; None: the session is complete.
        lines: instructions for the user.
        verdict: level of the session's verdict; empty while the session is not complete.
    """

    session: Session
    waiting: State | None
    lines: tuple[str, ...]
    verdict: str = ""


@checked
def new_session(
    folder: str | Path,
    robot: str | Path,
    instrument: str,
    *,
    poses: int = 40,
    validation: int = 20,
    tool: Sequence[float] | None = None,
    limits: str | Path | Mapping[str, object] | None = None,
    dynamics: bool = True,
    base: str = "",
    tip: str = "",
    seed: int = 0,
    program: str = "",
    tolerance_mm: float = 0.0,
    reference: bool = False,
    plan: bool = True,
    holdout: float = 0.0,
    certificate: Mapping[str, object] | None = None,
    **motion: object,
) -> Path:
    """Create the folder of a guided session for a robot, like the command `calib new`.

    Args:
        folder: new folder.
        robot, base, tip: arguments of `calib.load`.
        instrument: ``cmm``, ``tracker``, ``tracker6d``, ``mocap``, ``camera``, ``other-pose``, ``other-position``, or
            ``none``: only the dynamics are identified, on the geometry of the robot's description.
        poses, validation: number of poses to select for the fit, and number of held-out poses for the validation.
        tool: (3,) approximate position of the target in the tip's frame [m]; None: default of ``session.toml``.
        limits: TOML file of limits for both poses and motions (``calib formats limits``), or its content as tables;
            None: defaults.
        dynamics: whether to identify the dynamics, too.
        seed: seed of all random numbers.
        program: robot controller in whose language the poses are written, too (`calib program --list`); empty: none.
        tolerance_mm: largest accepted rms on held-out poses [mm]; 0: none.
        reference: whether a frame on the robot's base is measured beside the target.
        plan: whether the session chooses poses and designs motions; otherwise other poses and motions are measured.
        holdout: share of measured poses, and of recordings, that is held out where there is no file for validation.
        certificate: keys of ``[certificate]``: entries of the certificate besides results; None: all are empty.
        motion: other keys of ``[dynamics]`` (``calib formats session``): torques, payloads, period …

    Returns:
        The folder, whose ``session.toml`` contains the settings of the session.

    Raises:
        UsageError: if the folder is in use, or a value is not valid.
    """
    stage_of(robot, "a guided session")
    device, source = instrument_named(instrument), resolve(robot)
    words = "neither geometry nor dynamics were requested: choose an instrument, or identify the dynamics"
    require(dynamics or device.measures != NOTHING, words, UsageError)
    chain = load(robot, base or None, tip or None)
    if program:
        check_controller(program, chain.joints)
    of_instrument: dict[str, object] = {**asdict(device), "reference": reference}
    if tool is not None:
        of_instrument["tool"] = [*map(float, tool)]
    tolerances = motion.get("tolerance_torque", ())
    if isinstance(tolerances, Sequence):
        check_tolerances(tolerances, chain.n)
    copied, named = _limits(limits, chain, source, dynamics)
    table = {
        "name": chain.name,
        "created": "",
        "seed": seed,
        "fit": {"tolerance_mm": tolerance_mm, "holdout": holdout},
        "robot": {"file": source.name, "given": str(robot), "base": base, "tip": tip, "controller": program},
        "instrument": of_instrument,
        "poses": {"fit": poses, "validation": validation, "plan": plan, "constraints": named},
        "dynamics": {"wanted": dynamics, "limits": named, "plan": plan, "holdout": holdout, **motion},
        "certificate": dict(certificate or {}),
    }
    create(Path(folder), source, parse(SessionSettings, table, SESSION), copied | meshes_beside(source))
    return Path(folder)


def _limits(
    limits: str | Path | Mapping[str, object] | None, chain: Chain, source: Path, motions: bool
) -> tuple[dict[str, Path | str], str]:
    """Return the files with limits that the session needs (name -> path or text), and the name of the limits file.

    The limits are checked by reading them.

    Args:
        limits: file, folder or tables with limits; None: defaults, which yields no file and an empty name.
        chain: the arm.
        source: file of the robot.
        motions: whether the limits are also used for motions.
    """
    if limits is None:
        return {}, ""
    if isinstance(limits, str):
        limits = Path(limits)
    if motions and isinstance(limits, Path):
        read_motion_limits(limits, chain, source)
    read_limits(limits, targets_of(chain), source)
    content, _ = tables_of(limits, chain, source, "")
    if isinstance(content, str | Path):
        return {LIMITS: Path(content), **beside(Path(content))}, LIMITS
    tables: ParsedTable = dict(content or {})
    camera = tables.get("camera", {})
    files: dict[str, Path | str] = {}
    for key, name in CAMERA_FILES.items():
        # the session's limits name the copies beside them
        if camera.get(key, UNKNOWN) != UNKNOWN:
            files[name] = Path(camera[key])
            tables["camera"] = {**tables["camera"], key: name}
    return {LIMITS: f"{LIMITS_HEAD}{dumps(tables)}", **files}, LIMITS


def go_on(
    folder: Path, say: Say, progress: Say, command: str, again: str = "", plots: Plots = True, pick: int = 0
) -> _Stop:
    """Run all steps whose inputs exist, and return the step that waits for input, with instructions.

    Args:
        folder: folder of the session.
        say, progress: functions that print permanent lines and progress messages.
        command: the running command, to be recorded in the session.
        again: name of a step to repeat, together with all steps that depend on it; empty: no step.
        plots: whether to draw figures.
        pick: number of the front's motion that becomes the training motion; 0: none.
    """
    session = open_session(folder, plots)
    with locked(session, say):
        if pick:
            step = steps.find(session, "excite")
            make = partial(design_motions, picked=picked_front(session, pick))
            steps.run_instead(session, step, make, say, progress, command)
        if again:
            steps.forget(session, steps.find(session, again))
        state = steps.run_next(session, say, progress, command)
    if state is not None:
        return _Stop(session, state, ("", *asks(session, state)))
    return _Stop(session, None, _ending(session), session.verdicts().level)


def _ending(session: Session) -> tuple[str, ...]:
    """Return the closing lines for a complete session: the verdict, and the paths of certificate and robot."""
    first, *further_pages = PAGES
    page = f"{session.path(first)} ({', '.join(further_pages)})"
    verdicts, further = session.verdicts(), promised(session)
    robot = session.path(f"{session.export}/{URDF}")
    corrected = session.path(f"{session.export}/{CORRECTED_URDF}")
    use = ""
    if session.settings.fit.deliverable == "corrections" and corrected.exists():
        robot, use = corrected, f" with {TERMS}"
    if verdicts.level == "fail":
        use += " (for inspection only, do not use)"
    deliverable = f"robot: {robot}{use}" if robot.exists() else "no robot was exported"
    return ("", str(verdicts), f"certificate: {page}", deliverable, *further)


def status_lines(folder: Path) -> Iterator[RenderableType]:
    """Yield lines on the status of every step of a session, and on the next task or command.

    Args:
        folder: folder of the session.
    """
    session = open_session(folder)
    settings, states = session.settings, steps.states(session)
    pending = [state for state in states if state.kind not in (DONE, KEPT)]
    if not pending:
        yield str(session.verdicts())
    yield Text.assemble((settings.name, "bold"), f", {settings.instrument.name}, made {settings.created[:10]}")
    table = Table("", "step", "state", "", box=None, pad_edge=False)
    for number, state in enumerate(states, 1):
        table.add_row(str(number), state.step.name, Text(state.kind, COLOURS[state.kind]), Text(state.words))
    yield table
    if not pending:
        yield f"certificate: {session.path(CERTIFICATE)}"
    elif pending[0].kind == WAITING:
        yield from asks(session, pending[0])
    else:
        yield f"next: {command_line('next', folder)}"


def noted(folder: Path) -> list[str]:
    """Return the notes of all completed steps of the session in a folder, each beginning with the step's name."""
    lines = []
    for name, record in read_state(open_session(folder)).steps.items():
        lines += [f"  {name}: {note}" for note in record.notes]
    return lines

"""The demonstration: a calibration session on a simulated cell, then a comparison with the hidden true parameters."""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.apps.cell_demo.step_lines import Telling, row
from calib.config_types import Plots
from calib.errors import SessionError, UsageError, command_line
from calib.folders import read_estimate
from calib.records import read_lines
from calib.toolkit.chains import load, read_calibrated, robot_names
from calib.toolkit.installations import read_installation
from calib.toolkit.pose_data import IMAGES, Positions
from calib.toolkit.sessions import (
    DONE,
    KEPT,
    MARK,
    ROUND,
    WAITING,
    Payload,
    Say,
    Session,
    StepState,
    asks,
    designed_motions,
    locked,
    log_name,
    new_session,
    next_round,
    open_session,
    run_next,
    stated_payloads,
    step_states,
)
from calib.toolkit.simulations import (
    REST,
    TRUTH,
    CameraCell,
    Cell,
    MovingArm,
    carrying,
    drift_path,
    limits_of,
    measure_frames,
    moving_arm,
    planned_poses,
    play,
    record,
    seen_by_camera,
    sensed,
    share_within,
    take_pictures,
    true_base,
    true_position_errors,
    true_torque_errors,
    virtual_cell,
    wandering,
    write_log,
    write_measured,
)
from calib.toolkit.torque_models import read_dynamics

# numbers of poses: of the fit, of the validation, and of those that are measured again
FIT, VALIDATION, REPEATED = 40, 20, 3
# how far the simulated instrument wanders over a series [m]
DRIFT = 10e-6
# pose of the simulated LEDs in the arm's base, where there are any: beside the foot (our choice)
BASE_LEDS = np.array([[1.0, 0.0, 0.0, 0.25], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.1], [0.0, 0.0, 0.0, 1.0]])
# by default; where effects that no model holds are as large as those that some do
ROBOT, HARD = "tx40", "lwr4plus"
# little effort, for time
MOTION = {"period": 10.0, "rate": 500.0, "starts": 1, "evaluations": 150, "repeats": 2}
SIMULATED = "simulated cell: {note}; nothing was measured on a robot"
TRAINING = "training"
# seeds of their noise, how long the arm ran before [s]
LOGS = ((TRAINING, 2, 240.0), ("validation", 3, 480.0))
# how long the arm ran before the logs of further rounds, and between logs without and with a payload [s]
ROUND_RUNNING, PAYLOAD_RUNNING = 720.0, 60.0
# true payload where mass or centre of mass are not stated: mass [kg], centre of mass in the tip's frame [m]
PAYLOAD = Payload(2.0, (0.01, 0.02, 0.07))


@dataclass(frozen=True)
class DemoResult:
    """Result of the demonstration.

    Attributes:
        session: the session.
        verdict: verdict of the session; empty where the demonstration stopped for an engineer's work.
        seconds: wall-clock time [s].
        asks: instructions to the engineer where the demonstration stopped; else empty.
        nominal, calibrated: rms position errors of the nominal and of the calibrated arm against the hidden truth [mm];
            NaN where the demonstration stopped.
        memory: peak memory use of the process (largest resident set) [MB]; 0 on Windows.
    """

    session: Session
    verdict: str
    seconds: float
    asks: tuple[str, ...] = ()
    nominal: float = float("nan")
    calibrated: float = float("nan")
    memory: float = 0.0


def run(
    folder: Path,
    robot: str,
    seed: int,
    say: Say,
    progress: Say,
    *,
    dynamics: bool = True,
    guided: bool = False,
    plots: Plots = True,
    instrument: str = "cmm",
    payloads: Sequence[str] = (),
    verbose: bool = False,
) -> DemoResult:
    """Run a session on a simulated robot, compare the calibrated robot with the hidden truth, and return the result.

    Args:
        folder: the session's folder, to be created.
        robot: name of a robot of the library.
        seed: seed of the robot's errors, the noise, the pose selection and the motions.
        say, progress: functions that print a permanent line, and show a transient status.
        dynamics: whether dynamics are identified too, where the library has the robot's masses.
        guided: stop where an engineer has to act; `simulate_next` then simulates that step.
        plots: whether figures are drawn.
        instrument: ``cmm``, or ``camera``, for which images of a board are rendered.
        payloads: bodies at the flange, with which the motions are played again, as of ``calib new --payload``.
        verbose: print the session's messages too.

    Raises:
        UsageError: an unknown instrument.
    """
    if instrument not in ("cmm", "camera"):
        raise UsageError(f"--instrument {instrument}: expected cmm or camera")
    if payloads and not dynamics:
        raise UsageError("--payload applies to the dynamics, which --geometry-only excludes")
    started = time.perf_counter()
    cell = virtual_cell(robot, seed)
    if dynamics and cell.nominal.inertias is None:
        supported = ", ".join(name for name in robot_names() if load(name).inertias is not None)
        say(f"geometry only: masses are known for {supported} only")
        dynamics = False
    motion: dict[str, Any] = {}
    if dynamics:
        torques = "both" if sensed(robot) else "motor"
        motion = MOTION | {"torques": torques, "payloads": stated_payloads(payloads)}
    begin = partial(
        new_session, folder, robot, instrument, poses=FIT, validation=VALIDATION, seed=seed, dynamics=dynamics, **motion
    )
    if instrument == "camera":
        camera_cell = seen_by_camera(cell)
        cell = camera_cell.cell
        with limits_of(camera_cell) as limits:
            begin(limits=limits)
    else:
        begin()

    session = open_session(folder, plots)
    teller = Telling(session, say, progress, verbose)
    teller.said(f"the cell: {cell.note}")
    with locked(session):
        waiting = run_next(session, say if guided else teller.said, teller.progress, "calib demo")
        while waiting is not None and waiting.kind == WAITING and not guided:
            _bring_for(session, waiting.step.name, teller.said, teller.progress)
            waiting = run_next(session, teller.said, teller.progress, "calib demo")
    if waiting is not None:
        if not guided:
            raise SessionError(f"the demonstration stopped at {waiting.step.name}: {waiting.words}")
        return DemoResult(session, "", time.perf_counter() - started, _stopped(session, waiting))

    before, after = _compare_with_truth(session, cell, say)
    if isinstance(session.plots, str):
        from calib.apps.cell_demo.picture import draw

        draw(session, session.plots)
    memory = _peak_memory()
    seconds = time.perf_counter() - started
    verdict = session.verdicts().level
    return DemoResult(session, verdict, seconds, (), before, after, memory)


def _stopped(session: Session, waiting: StepState) -> tuple[str, ...]:
    """Return the engineer's instructions for the step `waiting`, and the commands that simulate it and continue.

    Args:
        session: the session.
        waiting: the step that waits for the engineer.
    """
    folder = session.folder
    simulate, go_on = command_line("demo", "--bring", folder), command_line("next", folder)
    return *asks(session, waiting), f"(or simulate this step: {simulate}; then: {go_on})"


def _compare_with_truth(session: Session, cell: Cell, say: Say) -> tuple[float, float]:
    """Return the rms tool errors [mm] of the nominal and of the calibrated arm against the hidden truth.

    All errors are printed, and written to ``truth.txt`` and ``truth.json`` in the session's folder.

    Args:
        session: the calibrated session.
        cell: the simulated cell with its true parameters.
        say: function that prints a line.
    """
    cell_fit = read_installation(session.fit.path)
    urdf = read_calibrated(session.fit.path).chain
    before, after, bare = true_position_errors(cell, cell_fit, urdf)
    truth: dict[str, object] = {"position_mm": {"nominal": before, "calibrated": after, "urdf_alone": bare}}
    notes = [cell.note, f"errors over {TRUTH} poses of the whole joint range, rms"]
    lines = [
        row("truth", before, "mm true error of the nominal robot"),
        row("truth", bare, "mm true error of robot.urdf"),
    ]
    if session.dynamic:
        arm = arm_of(session, cell)
        chain, dynamics = read_dynamics(session.identification.path)
        torques = true_torque_errors(cell, arm, dynamics.model, dynamics.values, chain)
        # friction in the middle of the motion that was fitted
        motion = designed_motions(session)[TRAINING]
        running = LOGS[0][2] + REST + motion.period * motion.repeat / 2.0
        payloads = {label: payload.parameters or () for label, payload in _true_payloads(session).items()}
        true = true_base(dynamics.model, cell, arm, session.settings.seed, running, payloads)
        within, count = share_within(true, read_estimate(session.identification.path))
        truth["torque_percent"] = torques.identified
        truth["within_two_sigma"] = within
        truth["base_parameters"] = count
        notes.append(arm.note)
        lines.append(row("truth", torques.identified, "% true torque error on a random motion"))
        lines.append(row("truth", 100.0 * within, "% of parameters are within two sigma"))
    files.write(session.path("truth.txt"), "\n".join([*notes, *lines]) + "\n")
    files.write_json(session.path("truth.json"), truth)
    for line in lines:
        say(line)
    return before, after


def simulate_next(folder: Path, say: Say) -> None:
    """Simulate the files that the session in `folder` waits for; compare a finished session with the hidden truth.

    Raises:
        UsageError: the session waits for no files, or its robot is not in the library.
    """
    session = open_session(folder)
    robot = session.settings.robot.given
    if robot not in robot_names():
        raise UsageError(f"{folder} is about {robot}; the simulated cells are of {', '.join(robot_names())}")
    with locked(session, say):
        step = _step_to_simulate(session)
        if not step:
            cell, _ = _cells_of(session)
            _compare_with_truth(session, cell, say)
            return
        _bring_for(session, step, say)
    say(f"next: {command_line('next', folder)}")


def _step_to_simulate(session: Session) -> str:
    """Return the name of the step that waits for files; empty for a finished session.

    Raises:
        UsageError: a step waits for something other than files.
    """
    for state in step_states(session):
        if state.kind == WAITING:
            return state.step.name
        if state.kind not in (DONE, KEPT):
            raise UsageError(f"{session.folder} waits for no files; next: {command_line('next', session.folder)}")
    if next_round(session) in designed_motions(session):
        return "record"
    return ""


def _cells_of(session: Session) -> tuple[Cell, CameraCell | None]:
    """Return the session's virtual cell, and this cell with a camera; the second is None for other instruments."""
    cell = virtual_cell(session.settings.robot.given, session.settings.seed)
    if session.settings.instrument.reference:
        cell = replace(cell, instrument=replace(cell.instrument, base_frame=BASE_LEDS))
    if session.settings.instrument.measures != IMAGES:
        return cell, None
    camera_cell = seen_by_camera(cell)
    return camera_cell.cell, camera_cell


def _bring_for(session: Session, step: str, say: Say, progress: Say = lambda text: None) -> None:
    """Simulate the files that a step of a session waits for, and write them into the session's folder.

    Args:
        session: the session.
        step: name of the step.
        say, progress: functions that print a permanent line, and show a transient status.
    """
    seed = session.settings.seed
    cell, camera_cell = _cells_of(session)
    if step in ("measure", "validate") and camera_cell is not None:
        _mark(session, camera_cell.cell.note)
        for number, name, q in planned_poses(session.folder, cell.nominal):
            images = session.path(f"3-measured/{name}")
            take_pictures(camera_cell, q, images, seed=seed + number, say=progress)
        say("    (the simulated camera takes an image at every pose of both lists)")
    elif step in ("measure", "validate"):
        simulate_measurements(session, cell, seed)
        say("    (the simulated cell measures both lists of poses)")
    elif step in ("record", "predict"):
        simulate_recordings(session, arm_of(session, cell), seed)
        loads = ", without and with each payload" if session.settings.dynamics.payloads else ""
        say(f"    (the simulated arm plays both motions{loads})")
    else:
        raise SessionError(f"the demonstration cannot simulate the files that step {step} needs")


def arm_of(session: Session, cell: Cell) -> MovingArm:
    """Return the session's simulated arm with its true dynamics, built on the simulated cell `cell`."""
    return moving_arm(cell, session.settings.robot.given, session.settings.seed)


def simulate_measurements(session: Session, cell: Cell, seed: int) -> None:
    """Simulate measurements of the planned poses with a drifting CMM, and write them into the session's folder.

    The first three poses to fit are measured again at the end, so that the drift can be found.

    Args:
        session: the session.
        cell: the simulated cell with its true parameters.
        seed: seed of the noise and of the drift.
    """
    _mark(session, cell.note)
    for number, name, q in planned_poses(session.folder, cell.nominal):
        noise = np.random.default_rng([seed, number])
        path = session.path(f"3-measured/{name}.csv")
        _write_series(*measure_frames(cell, q, noise, warm=number * FIT), path, seed)
        if name == "measured":
            noise = np.random.default_rng([seed, 7])
            path = session.path("3-measured/drift.csv")
            _write_series(*measure_frames(cell, q[:REPEATED], noise, warm=len(q)), path, seed, begin=1.0)


def _write_series(measured: Positions, bases: np.ndarray | None, path: Path, seed: int, begin: float = 0.0) -> None:
    """Write a measured series to the file `path`, in which the instrument drifts from `begin` (0 to 1) to the end.

    Args:
        measured: poses or positions in the instrument's frame.
        bases: (m, 4, 4) base frames, which drift alike; None without base LEDs.
        path: path of the file.
        seed: seed of the drift's direction.
        begin: when the series begins.
    """
    if bases is not None:
        bases = bases.copy()
        bases[:, :3, 3] += drift_path(len(bases), DRIFT, seed, begin)
    write_measured(wandering(measured, DRIFT, seed, begin), path, bases=bases)


def _mark(session: Session, note: str) -> None:
    """Mark a session's files as simulated, so that its certificate says so; `note` describes the simulated errors."""
    path = session.path(MARK)
    line = SIMULATED.format(note=note)
    marks = list(read_lines(path))
    if line not in marks:
        marks.append(line)
    files.write(path, "\n".join(marks) + "\n")


def _true_payloads(session: Session) -> dict[str, Payload]:
    """Return the session's payloads by label; an unstated mass or centre of mass is that of `PAYLOAD`."""
    payloads = {}
    for label, payload in session.settings.dynamics.payloads.items():
        mass = PAYLOAD.mass if payload.mass is None else payload.mass
        payloads[label] = Payload(mass, payload.com or PAYLOAD.com)
    return payloads


def simulate_recordings(session: Session, arm: MovingArm, seed: int) -> None:
    """Simulate torque recordings of the designed motions, without and with each payload.

    They are written into the session's folder.

    Args:
        session: the session.
        arm: the simulated arm with its true dynamics.
        seed: seed of the noise.
    """
    payloads = _true_payloads(session)
    payload_notes = [f"; payload '{label}': {payload}" for label, payload in payloads.items()]
    _mark(session, arm.note + "".join(payload_notes))
    motions = designed_motions(session)
    logs = list(LOGS)
    for name in motions:
        if name.startswith(ROUND):
            noise_seed = int(name.removeprefix(ROUND)) + 10
            logs.append((name, noise_seed, ROUND_RUNNING))
    for name, noise_seed, running in logs:
        if name not in motions:
            continue
        motion = motions[name]
        t = np.arange(round(motion.period * motion.rate) + 1) / motion.rate
        reference = play(t, *motion.orders(t), motion.repeat)
        noise = np.random.default_rng([seed, noise_seed])
        recorded = record(arm, reference, noise, running)
        write_log(recorded, session.path(f"7-recorded/{log_name(name)}"))
        for number, (label, payload) in enumerate(payloads.items(), 1):
            loaded = carrying(arm, payload.parameters or ())
            noise = np.random.default_rng([seed, noise_seed, number])
            recorded = record(loaded, reference, noise, running + number * PAYLOAD_RUNNING)
            write_log(recorded, session.path(f"7-recorded/{log_name(name, label)}"))


def _peak_memory() -> float:
    """Return the largest resident set of this process [MB]; 0 on Windows, where it is not asked for."""
    if sys.platform == "win32":
        return 0.0
    import resource

    # the system counts in bytes on macOS, in kB on Linux
    unit = 2.0**20 if sys.platform == "darwin" else 2.0**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit

"""The demonstration: a session on a simulated cell, then a comparison with the hidden truth."""

import resource
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.apps.cell_demo.summary import Telling, row
from calib.errors import SessionError, UsageError, command_line
from calib.folders import read_estimate
from calib.records import read_lines
from calib.toolkit.chains import load, read_calibrated, robot_names
from calib.toolkit.installations import read_installation
from calib.toolkit.pose_data import IMAGES
from calib.toolkit.sessions import (
    DONE,
    KEPT,
    MARK,
    ROUND,
    WAITING,
    Say,
    Session,
    StepState,
    asks,
    designed_motions,
    locked,
    new_session,
    next_round,
    open_session,
    run_next,
    step_states,
)
from calib.toolkit.simulations import (
    REST,
    TRUTH,
    CameraCell,
    Cell,
    MovingArm,
    limits_of,
    measure,
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
# by default; where effects that no model holds are as large as those that some do
ROBOT, HARD = "tx40", "lwr4plus"
# little effort, for time
MOTION = {"period": 10.0, "rate": 500.0, "starts": 1, "evaluations": 150, "repeats": 2}
SIMULATED = "simulated cell: {note}; nothing was measured on a robot"
TRAINING = "training"
# seeds of their noise, how long the arm ran before [s]
LOGS = ((TRAINING, 2, 240.0), ("validation", 3, 480.0))
# how long the arm ran before the logs of further rounds [s]
ROUND_RUNNING = 720.0


@dataclass(frozen=True)
class DemoResult:
    """Result of the demonstration.

    Attributes:
        session: the session.
        verdict: verdict of the session; empty where it stopped for an engineer.
        seconds: wall-clock time [s].
        asks: instructions to the engineer where it stopped; else empty.
        nominal, calibrated: rms position errors of both arms against the hidden truth [mm]; NaN where it stopped.
        memory: largest resident set [MB].
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
    plots: bool = True,
    instrument: str = "cmm",
    verbose: bool = False,
) -> DemoResult:
    """Return the result of a session on a simulated robot, compared with its hidden truth.

    Args:
        folder: the session's folder, to be created.
        robot: name of a robot of the library.
        seed: seed of the robot's errors, the noise, the pose selection and the motions.
        say, progress: print a permanent line, and show a transient status.
        dynamics: whether to identify dynamics too, where the library knows the robot's masses.
        guided: stop where an engineer has to act; `simulate_next` then simulates that step.
        plots: whether figures are drawn.
        instrument: ``cmm``, or ``camera``, which takes rendered images.
        verbose: print the session's messages too.

    Raises:
        UsageError: an unknown instrument.
    """
    if instrument not in ("cmm", "camera"):
        raise UsageError(f"--instrument {instrument}: expected cmm or camera")
    started = time.perf_counter()
    cell = virtual_cell(robot, seed)
    if dynamics and cell.nominal.inertias is None:
        supported = ", ".join(name for name in robot_names() if load(name).inertias is not None)
        say(f"geometry only: masses are known for {supported} only")
        dynamics = False
    motion: dict[str, Any] = {}
    if dynamics:
        torques = "both" if sensed(robot) else "motor"
        motion = MOTION | {"torques": torques}
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
    if plots:
        from calib.apps.cell_demo.picture import draw

        draw(session)
    # the system counts in bytes on macOS, in kB on Linux
    unit = 2.0**20 if sys.platform == "darwin" else 2.0**10
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    seconds = time.perf_counter() - started
    verdict = session.verdicts().level
    return DemoResult(session, verdict, seconds, (), before, after, memory)


def _stopped(session: Session, waiting: StepState) -> tuple[str, ...]:
    """Return the engineer's instructions, and the command that simulates them."""
    folder = session.folder
    simulate, go_on = command_line("demo", "--bring", folder), command_line("next", folder)
    return *asks(session, waiting), f"(or simulate this step: {simulate}; then: {go_on})"


def _compare_with_truth(session: Session, cell: Cell, say: Say) -> tuple[float, float]:
    """Return the rms tool errors [mm] of nominal and calibrated arm against the truth; print and write all errors."""
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
        true = true_base(dynamics.model, cell, arm, session.settings.seed, running)
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
    """Simulate the files that the session in `folder` waits for; compare a finished session with the truth.

    Raises:
        UsageError: the session waits for no files, or its robot is not one of the library.
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
    """Return the virtual cell of a session, and the same cell with its camera (None for other instruments)."""
    cell = virtual_cell(session.settings.robot.given, session.settings.seed)
    if session.settings.instrument.measures != IMAGES:
        return cell, None
    camera_cell = seen_by_camera(cell)
    return camera_cell.cell, camera_cell


def _bring_for(session: Session, step: str, say: Say, progress: Say = lambda text: None) -> None:
    """Simulate the files that a step waits for."""
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
        say("    (the simulated arm plays both motions)")
    else:
        raise SessionError(f"the demonstration cannot simulate the files that step {step} needs")


def arm_of(session: Session, cell: Cell) -> MovingArm:
    """Return the simulated arm of a session, with its dynamics."""
    return moving_arm(cell, session.settings.robot.given, session.settings.seed)


def simulate_measurements(session: Session, cell: Cell, seed: int) -> None:
    """Simulate measurements of the planned poses, with three repeated at the end and drift of the CMM."""
    _mark(session, cell.note)
    for number, name, q in planned_poses(session.folder, cell.nominal):
        noise = np.random.default_rng([seed, number])
        measured = measure(cell, q, noise, warm=number * FIT)
        write_measured(wandering(measured, DRIFT, seed), session.path(f"3-measured/{name}.csv"))
        if name == "measured":
            noise = np.random.default_rng([seed, 7])
            repeated = measure(cell, q[:REPEATED], noise, warm=len(q))
            write_measured(wandering(repeated, DRIFT, seed, begin=1.0), session.path("3-measured/drift.csv"))


def _mark(session: Session, note: str) -> None:
    """Mark a session's files as simulated, for its certificate."""
    path = session.path(MARK)
    line = SIMULATED.format(note=note)
    marks = list(read_lines(path))
    if line not in marks:
        marks.append(line)
    files.write(path, "\n".join(marks) + "\n")


def simulate_recordings(session: Session, arm: MovingArm, seed: int) -> None:
    """Simulate recordings of the designed motions."""
    _mark(session, arm.note)
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
        write_log(recorded, session.path(f"7-recorded/{name}_log.csv"))

"""Simulations of recordings' closed loops: of the initial regular robot, and of robots between two estimates.

The distance of a simulation from the recorded motion shows how reliable the simulation is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.dynamics.drives import DriveTerm, standard
from calib.dynamics.idim import IdentificationModel
from calib.errors import CalibError, CannotSimulate, UsageError
from calib.estimation.whiteness import inflation
from calib.identification.closed_loop.loop_recordings import Loop, low_passed, simulated_samples
from calib.identification.closed_loop.simulation import Plant, Sensing, SimulatedRun, plant_of
from calib.identification.rows import Case
from calib.records import frozen

# halvings of a step to parameters that cannot be simulated (our choice)
MAX_RETREATS = 6
# of distances from the reference, recorded and simulated: beyond, gains are others (our choice)
MAX_GAIN_RATIO = 1.25

# each recording with its loop, and the run of that
Runs = list[tuple[tuple[Case, Loop], SimulatedRun]]


def regular_plant(
    model: IdentificationModel, terms: Sequence[DriveTerm], loop: Loop, inertia: np.ndarray | None
) -> Plant:
    """Return the robot of the first simulation: joint inertias J only, without bodies and gravity.

    J are its last n parameters.

    Args:
        model: model of the robot.
        terms: additional friction terms, with values of zero.
        loop: loop of the first recording.
        inertia: J (n,) [kg m²]; None: kd² / (2 kp) of the loop's controller.

    Raises:
        UsageError: if the controller's gains give no positive inertia.
    """
    if inertia is None:
        with np.errstate(divide="ignore", invalid="ignore"):
            inertia = loop.controller.kd**2 / (2.0 * loop.controller.kp)
        if not np.all(np.isfinite(inertia)) or not np.all(inertia > 0.0):
            raise UsageError("kd² / (2 kp) of these gains is no inertia above 0; give the inertia (n,) [kg m²]")
    extra = tuple(replace(motor, name=f"regular {motor.name}") for motor in standard(["Ia"] * model.n))
    values = np.concatenate([np.zeros(model.p + len(terms)), inertia])
    return plant_of(model, values, (*terms, *extra))


def simulated_runs(plant: Plant, cases: Sequence[tuple[Case, Loop]]) -> Runs:
    """Return noise-free simulations of the loops of all recordings.

    Args:
        plant: the simulated robot.
        cases: gap-free parts of recordings, each with its loop.
    """
    result: Runs = []
    for case, loop in cases:
        run = simulated_run(plant, case, loop, Sensing(every=loop.every))
        result.append(((case, loop), run))
    return result


def simulated_run(plant: Plant, case: Case, loop: Loop, sensing: Sensing, seed: int = 0) -> SimulatedRun:
    """Return the simulation of a recording's loop with the recording's payloads.

    Args:
        plant: the simulated robot.
        case: the recording, which has the payloads.
        loop: its loop.
        sensing: noise, resolution and sampling.
        seed: seed of all noise.
    """
    robot = plant.carrying(case.carried)
    controller = loop.controller
    if loop.design is not None:
        controller = controller.scaled(robot.inertia_diagonal(loop.reference.q[::200]) / loop.design)
    return robot.run(controller, loop.reference, sensing, seed)


def between(start: Plant, end: Plant, share: float) -> Plant:
    """Return the robot with parameters (1 - share) · start + share · end."""
    return end.with_parameters(share * end.parameters + (1.0 - share) * start.parameters)


def nearer(start: Plant, end: Plant, cases: Sequence[tuple[Case, Loop]]) -> tuple[Plant, Runs]:
    """Return a robot between `start` and `end` that can be simulated, with its simulations.

    The robot is halfway, or nearer to `start` if that robot cannot be simulated.

    Args:
        start, end: robots with different parameters; `start` can be simulated.
        cases: gap-free parts of recordings, each with its loop.

    Raises:
        CannotSimulate: if no robot near `start` can be simulated.
    """
    problem: CalibError | None = None
    for halvings in range(1, MAX_RETREATS + 1):
        candidate = between(start, end, 0.5**halvings)
        try:
            return candidate, simulated_runs(candidate, cases)
        except CalibError as error:
            problem = error
    raise CannotSimulate(f"no parameters between the start and the estimate can be simulated: {problem}", start)


def distance_percent(runs: Runs) -> np.ndarray:
    """Return the rms difference of simulated and recorded positions (n,), relative to the motion's rms [%].

    Args:
        runs: simulations of the recordings' loops.
    """
    n = runs[0][0][0].motion.n
    away, size = np.zeros((2, n))
    for (case, loop), run in runs:
        motion = case.motion
        simulated = low_passed(run.q, motion)[simulated_samples(case, run.t, loop)]
        away += np.sum((motion.q - simulated) ** 2, axis=0)
        deviation = motion.q - motion.q.mean(axis=0)
        size += np.sum(deviation**2, axis=0)
    return frozen(100.0 * np.sqrt(away / size))


def error_ratio(runs: Runs) -> np.ndarray:
    """Return the ratios (n,) of recorded to simulated tracking errors, by regression; NaN if noise hides the ratio.

    Args:
        runs: simulations of the recordings' loops.
    """
    measured_errors = []
    expected_errors = []
    for (case, loop), run in runs:
        motion = case.motion
        samples = simulated_samples(case, run.t, loop)
        ticks = np.arange(len(run.t)) * loop.every
        reference, *_ = loop.reference.at(ticks)
        reference = low_passed(reference, motion)[samples]
        position = low_passed(run.q, motion)[samples]
        measured_errors.append(reference - motion.q)
        expected_errors.append(reference - position)
    measured = np.concatenate(measured_errors)
    expected = np.concatenate(expected_errors)
    size = np.maximum(np.sum(expected**2, axis=0), 1e-300)
    slope = np.sum(measured * expected, axis=0) / size
    residual = measured - slope * expected
    inflations = np.array([inflation(joint) for joint in residual.T])
    sigma = np.sqrt(inflations * np.mean(residual**2, axis=0) / size)
    clear = 5.0 * sigma < np.abs(slope) * np.log(MAX_GAIN_RATIO)
    return frozen(np.where(clear, slope, np.nan))

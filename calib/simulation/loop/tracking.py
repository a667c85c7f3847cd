"""What a model is good for: how far a robot strays from its reference when the model's torques are fed forward.

A second judgement beside the computed-torque test, which by itself is "not a direct answer" about tracking (Kolyubin,
Shiriaev & Jubien 2019, section 7): an error of torque that the feedback swallows costs nothing here.
"""

import numpy as np

from calib.dynamics.idim import IdentificationModel
from calib.simulation.loop.closed_loop import Plant, Sensing, sample_ticks, simulate
from calib.simulation.loop.controllers import Controller
from calib.simulation.loop.references import Reference


def feed_forward(believed: Plant, reference: Reference) -> np.ndarray:
    """Return the torques (N, n) that the believed robot needs along the reference, drives included [N m or N]."""
    model = IdentificationModel(believed.bodies, believed.terms)
    block = 4096  # instants at a time
    parts = [slice(k, k + block) for k in range(0, len(reference.t), block)]
    regressors = (model.regressor(reference.q[part], reference.v[part], reference.a[part]) for part in parts)
    return np.concatenate([regressor @ believed.parameters for regressor in regressors])


def replayed_error(
    robot: Plant, controller: Controller, reference: Reference, ahead: np.ndarray | None, push: np.ndarray
) -> np.ndarray:
    """Return the rms of q - q_r (n,) [rad or m] under torques (N, n) ahead and (N, n) that push, without noise."""
    own = controller if ahead is None else controller.with_feedforward(ahead)
    run = simulate(robot, own, reference, push=push)
    return np.sqrt(np.mean((run.q - reference.q) ** 2, axis=0))


def tracking_error(
    robot: Plant,
    believed: Plant | None,
    controller: Controller,
    reference: Reference,
    sensing: Sensing | None = None,
    seed: int = 0,
) -> np.ndarray:
    """Return the rms of q - q_r (n,) [rad or m] of the robot under feedback and the believed robot's torques.

    Args:
        robot: what moves; on a real arm the best model there is stands for it.
        believed: whose torques are fed forward; None: feedback alone.
    """
    ahead = controller if believed is None else controller.with_feedforward(feed_forward(believed, reference))
    run = simulate(robot, ahead, reference, sensing, seed)
    tick = sample_ticks(len(reference.t), 1 if sensing is None else sensing.every)
    return np.sqrt(np.mean((run.q - reference.at(tick)[0]) ** 2, axis=0))

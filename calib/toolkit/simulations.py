"""Simulation: virtual cells with known truth, and arms in closed loop with their controllers."""

from calib.identification.closed_loop.controllers import Reference
from calib.identification.closed_loop.simulation import (
    Plant,
    Sensing,
    SimulatedRun,
    feed_forward,
    simulate,
    tracking_error,
)
from calib.identification.loop import LoopController, LoopSettings
from calib.simulation.camera_cell import CameraCell, limits_of, seen_by_camera, take_pictures
from calib.simulation.cell import (
    Cell,
    SimulatedInstrument,
    drift_path,
    measure,
    measure_frames,
    planned_poses,
    true_poses,
    wandering,
    write_log,
    write_measured,
)
from calib.simulation.known_robots import controller as published_controller
from calib.simulation.known_robots import model as plant_model
from calib.simulation.known_robots import plant as known_plant
from calib.simulation.known_robots import random_fourier
from calib.simulation.known_robots import truth as known_truth
from calib.simulation.truth import TRUTH, share_within, true_base
from calib.simulation.truth import position_errors as true_position_errors
from calib.simulation.truth import torque_errors as true_torque_errors
from calib.simulation.virtual_arm import REST, MovingArm, carrying, moving_arm, play, record, sensed
from calib.simulation.virtual_cells import lwr4plus_cell, perturbed_cell, rigid, virtual_cell

__all__ = [
    "REST",
    "TRUTH",
    "CameraCell",
    "Cell",
    "LoopController",
    "LoopSettings",
    "MovingArm",
    "Plant",
    "Reference",
    "Sensing",
    "SimulatedInstrument",
    "SimulatedRun",
    "carrying",
    "drift_path",
    "feed_forward",
    "known_plant",
    "known_truth",
    "limits_of",
    "lwr4plus_cell",
    "measure",
    "measure_frames",
    "moving_arm",
    "perturbed_cell",
    "planned_poses",
    "plant_model",
    "play",
    "published_controller",
    "random_fourier",
    "record",
    "rigid",
    "seen_by_camera",
    "sensed",
    "share_within",
    "simulate",
    "take_pictures",
    "tracking_error",
    "true_base",
    "true_poses",
    "true_position_errors",
    "true_torque_errors",
    "virtual_cell",
    "wandering",
    "write_log",
    "write_measured",
]

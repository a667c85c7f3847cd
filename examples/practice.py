"""A robot cell to practise on: it writes the files that your instrument and your robot's controller would bring.

Each function stands for an afternoon in the cell. The UR5's true geometry is a little off its nominal one, the TX40's
true masses are; the examples never see that truth, only the files.
"""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import calib
from calib.rooms.cells import cell, demo, virtual_arm, virtual_cells
from calib.rooms.cells.cell import write_log, write_measured
from calib.rooms.cells.known_robots import random_fourier

NEAR = np.array([0.3, -1.2, 1.6, -1.1, -1.4, 0.5])  # where the UR5 works [rad]
TAUGHT = NEAR + np.random.default_rng(3).uniform(-0.4, 0.4, (50, 6))


def enter(script: str) -> None:
    """Change to the folder given on the command line; by default one named after the script's number."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else f"example-{Path(script).name[:2]}")
    folder.mkdir(parents=True, exist_ok=True)
    os.chdir(folder)


def ur5() -> cell.Cell:
    """Return the simulated cell of a UR5 measured by an optical CMM."""
    return virtual_cells.perturbed_cell(calib.load("ur5").chain, seed=1)


def measure(path: str, poses: int = 80) -> None:
    """Measure random poses of the UR5: joints [deg], position [mm] and orientation of the tool, a row per pose."""
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (poses, 6))
    write_measured(cell.measure(ur5(), q, seed=2), path)


def teach(path: str) -> None:
    """Write target positions [m] in the instrument's frame, and joint values [rad] near their solutions."""
    exact = cell.SimulatedInstrument(position_sigma=0.0, orientation_sigma=0.0, encoder_sigma=0.0)
    seen = cell.measure(replace(ur5(), instrument=exact), TAUGHT)
    write_measured(replace(seen, sigma=None, sigma_rotation=None), path, degrees=False)


def missed(q: np.ndarray) -> float:
    """Return the distance of the real tool from the taught places at joint values q (50, 6) [rad]: rms [mm]."""
    off = cell.true_poses(ur5(), q)[:, :3, 3] - cell.true_poses(ur5(), TAUGHT)[:, :3, 3]
    return float(1e3 * np.sqrt(np.mean(np.sum(off**2, axis=1))))


def record(path: str, motion: int) -> None:
    """Log a motion of the TX40, 10 s at 500 Hz: positions [deg] and torques [N m]."""
    arm = virtual_arm.moving_arm(virtual_cells.virtual_cell("tx40", 0), "tx40", 0)
    speeds = 0.5 * np.array([joint.velocity for joint in arm.chain.joints])
    limits = arm.chain.lower, arm.chain.upper
    reference = random_fourier(*limits, speeds, 10.0, 500.0, acceleration=15.0, seed=motion)
    write_log(virtual_arm.record(arm, reference, motion), path)


def bring(session: str) -> None:
    """Simulate the files that a session waits for: measured poses, or logs of its motions."""
    demo.simulate_next(Path(session), print)

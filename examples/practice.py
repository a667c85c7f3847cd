"""A robot cell to practise on: it writes the files that your instrument and your robot's controller would bring.

Each function stands for an afternoon in the cell. The UR5's true geometry is a little off its nominal one, the TX40's
true masses are; the examples never see that truth, only the files. From a shell, in place of an instrument or a
controller: ``python examples/practice.py FUNCTION ARGUMENTS``, as the tutorials do.
"""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

import calib
from calib.apps.cell_demo import demo
from calib.data.poses.pose_lists import read_poses
from calib.data.recordings.recording import Recording
from calib.data.schema import Joints
from calib.dynamics.bodies import bodies_of
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.pseudo_inertia import ball
from calib.files import write_numbers
from calib.identification.closed_loop.controllers import Reference
from calib.identification.prior import rods
from calib.parallel.mechanism.closure import ClosedRobot, closed
from calib.parallel.mechanism.geometric_fit import changed, loop_parameters
from calib.parallel.mechanism.parallel_model import PlatformRegressor, make_parallel_model
from calib.parallel.robots import find
from calib.procedure.excitation import coefficients
from calib.simulation import camera_cell, cell, virtual_arm, virtual_cells
from calib.simulation.cell import write_log, write_measured
from calib.simulation.known_robots import random_fourier, truth

WORKING_POSTURE = np.array([0.3, -1.2, 1.6, -1.1, -1.4, 0.5])  # where the UR5 works [rad]
TAUGHT = WORKING_POSTURE + np.random.default_rng(3).uniform(-0.4, 0.4, (50, 6))  # joints at its targets [rad]
GAINS = np.array([14.87, 13.26, 11.13, 10.62, 11.03, 11.47])  # of a UR10e [N m/A] (De Luca, in Mamedov & Mikhel 2020)
TOOL = ball(2.8, 0.06, np.array([0.01, 0.02, 0.07]))  # the true tool: 2.8 kg, 7 cm before the flange
PLATE_MASS = 5.37  # of the DualV's payload [kg]


def enter(script: str) -> None:
    """Change to the folder given on the command line; by default one named after the script's number."""
    folder = Path(f"example-{Path(script).name[:2]}")
    if len(sys.argv) > 1:
        folder = Path(sys.argv[1])
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
    exact = calib.SimulatedInstrument(position_sigma=0.0, orientation_sigma=0.0, encoder_sigma=0.0)
    targets = cell.measure(replace(ur5(), instrument=exact), TAUGHT)
    write_measured(replace(targets, sigma=None, sigma_rotation=None), path, degrees=False)


def target_error(q: np.ndarray) -> float:
    """Return the distance of the real tool from the targets at joint values q (50, 6) [rad]: rms [mm]."""
    reached = cell.true_poses(ur5(), q)[:, :3, 3]
    targets = cell.true_poses(ur5(), TAUGHT)[:, :3, 3]
    squared_distances = np.sum((reached - targets) ** 2, axis=1)
    return float(1e3 * np.sqrt(np.mean(squared_distances)))


def record(path: str, motion: int) -> None:
    """Log a motion of the TX40, 10 s at 500 Hz: positions [deg] and torques [N m]."""
    arm = virtual_arm.moving_arm(virtual_cells.virtual_cell("tx40", 0), "tx40", 0)
    limits = (arm.chain.lower, arm.chain.upper)
    write_log(virtual_arm.record(arm, random_motion(arm, limits, seed=motion), motion), path)


def random_motion(arm: virtual_arm.MovingArm, limits: tuple[np.ndarray, np.ndarray], seed: int) -> Reference:
    """Return a random motion of 10 s at 500 Hz within position limits (n,) and half the speeds."""
    speeds = 0.5 * np.array([joint.velocity for joint in arm.chain.joints])
    return random_fourier(*limits, speeds, 10.0, 500.0, acceleration=15.0, seed=seed)


def tracker(plan: str, path: str, robot: str = "tx40") -> None:
    """Measure planned poses with a laser tracker: joints [deg] and the reflector's position [mm], a row per pose."""
    instrument = calib.SimulatedInstrument("laser tracker", position_sigma=15e-6, orientation_sigma=None)
    arm = virtual_cells.virtual_cell(robot, 0, instrument)
    q = read_poses(Path(plan), Joints.of(arm.nominal.joint_names))
    write_measured(cell.measure(arm, q, seed=1), path)


def cmm(plan: str, path: str, robot: str = "lwr4plus") -> None:
    """Measure planned poses with an optical CMM: joints [deg], the fixture's position [mm] and orientation."""
    arm = virtual_cells.virtual_cell(robot, 0)
    q = read_poses(Path(plan), Joints.of(arm.nominal.joint_names))
    write_measured(cell.measure(arm, q, sum(map(ord, path))), path)


def stream(log: str, points: str, robot: str = "tx40") -> None:
    """Follow a slow motion of 4 min with a laser tracker at 1 kHz, and log the joints at 125 Hz.

    The tracker's clock is 0.137 s ahead. Its noise, 15 µm, is correlated over some 0.06 s; its beam breaks at times.
    """
    arm = virtual_cells.virtual_cell(robot, 0)
    nominal = arm.nominal
    rng = np.random.default_rng(1)
    rate = 1000.0
    speeds = np.full(nominal.n, 0.15)
    motion = random_fourier(nominal.lower, nominal.upper, speeds, 240.0, rate, harmonics=12, seed=2)

    t = motion.t[::8]
    q = motion.q[::8]
    encoders = q + rng.normal(0.0, 1e-5, q.shape)
    header = ["t [s]", *(f"{name} [deg]" for name in nominal.joint_names)]
    write_numbers(log, header, np.column_stack([t, np.degrees(encoders)]))

    memory = np.exp(-1.0 / (0.03 * rate))
    white = rng.normal(size=(len(motion.t), 3))
    noise = lfilter([15e-6 * np.sqrt(1.0 - memory**2)], [1.0, -memory], white, axis=0)
    positions = 1e3 * (cell.true_poses(arm, motion.q)[:, :3, 3] + noise)
    broken_beam = rng.uniform(size=len(positions)) < 0.01
    positions[broken_beam] = 0.0
    readings = np.column_stack([motion.t + 0.137, positions])
    write_numbers(points, ["t [s]", "x [mm]", "y [mm]", "z [mm]"], readings[1000:-2000])


def photos(folder: str, count: str = "30") -> None:
    """Take images of a board on the table with a camera in the hand of a UR5, and write its joints beside them."""
    camera = camera_cell.seen_by_camera(ur5())
    postures = camera_cell.views(camera, int(count), 1)
    camera_cell.take_pictures(camera, postures, Path(folder), seed=1)


def moving(robot: str, load: bool = False) -> virtual_arm.MovingArm:
    """Return the moving arm of a robot, with or without a load; the library's masses, or rods between the joints.

    The load is the tool; of the LWR4+ that of Kolyubin, Shiriaev and Jubien (2019), 3.28 kg beside axis 7.
    """
    arm_cell = virtual_cells.virtual_cell(robot, 0)
    nominal = arm_cell.nominal
    if nominal.inertias is None:
        masses = rods(nominal, IdentificationModel(bodies_of(nominal), ()), total=30.0)
        arm_cell = replace(arm_cell, nominal=replace(nominal, inertias=masses))
    arm = virtual_arm.moving_arm(arm_cell, robot, 0)
    if not load:
        return arm
    if robot == "lwr4plus":
        return virtual_arm.carrying(arm, truth(robot)["payload"]["inertia"])
    return virtual_arm.carrying(arm, TOOL)


def log(path: str, robot: str, motion: str, quantity: str = "torque", load: str = "") -> None:
    """Log a motion of a robot: a design's folder, played twice, or the number of a random one of 10 s at 500 Hz.

    Args:
        path: CSV to write: time [s], positions [deg], and
        quantity: motor torques (torque), torques of joint sensors (link), both, or motor currents (current).
        load: "load": with the load of `moving`.
    """
    arm = moving(robot, load == "load")
    if Path(motion).is_dir():
        reference = played_design(Path(motion))
    else:
        limits = (np.maximum(arm.chain.lower, -2.5), np.minimum(arm.chain.upper, 2.5))
        reference = random_motion(arm, limits, seed=int(motion))
    noise_seed = sum(map(ord, path))
    recording = virtual_arm.record(arm, reference, noise_seed)
    match quantity:
        case "both":
            write_log(recording, path)
        case "link":
            write_log(replace(recording, effort=recording.tau_link, tau_link=None), path)
        case "current":
            write_currents(recording, path)
        case _:
            write_log(replace(recording, tau_link=None), path)


def played_design(folder: Path) -> Reference:
    """Return the motion of a design's folder, played twice."""
    design = coefficients.read(folder)
    t = np.arange(round(design.period * design.rate) + 1) / design.rate
    return virtual_arm.play(t, *design.orders(t), 2)


def write_currents(recording: Recording, path: str) -> None:
    """Write a log with motor currents [A] in place of torques."""
    currents = recording.effort / GAINS
    file = write_log(replace(recording, effort=currents, tau_link=None), path)
    header, rows = file.read_text().split("\n", 1)
    header = header.replace("tau_", "current_").replace("[Nm]", "[A]")
    file.write_text(header + "\n" + rows)


def degrade(log: str, path: str, noise: str = "1") -> None:
    """Copy a log and add white noise [mrad] to its positions, as a bad encoder would: the torques stay as they are."""
    header, rows = Path(log).read_text(encoding="utf-8").split("\n", 1)
    names = header.split(",")
    values = np.loadtxt(rows.splitlines(), delimiter=",")
    positions = [k for k, name in enumerate(names) if name.startswith("q_")]
    white = np.random.default_rng(0).normal(size=(len(values), len(positions)))
    values[:, positions] += np.degrees(1e-3 * float(noise)) * white
    write_numbers(path, names, values)


def platform(folder: str) -> None:
    """Write a DualV's files: encoder readings with platform poses, logs without and with a payload of 5.37 kg.

    The true legs are 1 mm and 1 mrad (1 sigma) off their nominal; the torques are the model's, with noise.
    """
    nominal = find("dualv").mechanism
    rng = np.random.default_rng(0)
    parameters = loop_parameters(nominal)
    errors = 1e-3 * rng.normal(size=len(parameters))
    true = closed(changed(nominal.robot, parameters, errors))
    _measure_platform(true, nominal, Path(folder, "measured.csv"), rng)

    model = make_parallel_model(true, ["Fv Fc"], v0=0.05, payloads=["plate"])
    friction = np.tile([0.05, 0.3], 4)
    values = np.concatenate([model.known_parameters(), friction])
    values[model.names.index("Mplate")] = PLATE_MASS
    for name, payloads in (("empty", ()), ("load", ("plate",)), ("other", ("plate",))):
        regressor = PlatformRegressor(model, np.arange(model.p), values, payloads)
        _log_platform(regressor, true, Path(folder, f"{name}.csv"), rng)


def _measure_platform(true: ClosedRobot, nominal: ClosedRobot, path: Path, rng: np.random.Generator) -> None:
    """Write 60 platform poses with encoder readings: motors [deg], x, y [mm] and turn [deg]."""
    x = 0.9 * rng.uniform(nominal.robot.lower, nominal.robot.upper, (60, 3))
    q = true.place(x).q[:, nominal.robot.actuated]
    encoders = q + 1e-5 * rng.normal(size=q.shape)
    header = [f"{name} [deg]" for name in nominal.robot.joint_names]
    header += ["x [mm]", "y [mm]", "rz [deg]"]
    table = np.column_stack([np.degrees(encoders), 1e3 * x[:, :2], np.degrees(x[:, 2])])
    write_numbers(path, header, table)


def _log_platform(regressor: PlatformRegressor, true: ClosedRobot, path: Path, rng: np.random.Generator) -> None:
    """Write 1 s of a platform's motion at 1 kHz: motors' positions [deg] and torques [N m]."""
    t = np.arange(1000) / 1000.0
    # four sines along x and y [m], and about z [rad]
    frequency = 2 * np.pi * np.array([1.5, 2.5, 4.0, 5.5])[:, None, None]
    amplitude = np.array([0.02, 0.02, 0.12])
    angle = frequency * t[:, None] + rng.uniform(0, 6, (4, 1, 3))
    x = (amplitude * np.sin(angle)).sum(axis=0)
    velocity = (amplitude * (frequency * np.cos(angle))).sum(axis=0)
    acceleration = (amplitude * (-(frequency**2) * np.sin(angle))).sum(axis=0)
    motion = regressor.motion(x, velocity, acceleration)
    q = motion.posture.q[:, true.robot.actuated]
    encoders = q + 1e-5 * rng.normal(size=q.shape)
    tau = regressor.torques(motion) + 0.5 * rng.normal(size=q.shape)
    header = ["t [s]"]
    header += [f"{name}_q [deg]" for name in true.robot.joint_names]
    header += [f"{name}_tau [Nm]" for name in true.robot.joint_names]
    write_numbers(path, header, np.column_stack([t, np.degrees(encoders), tau]))


def bring(session: str) -> None:
    """Simulate the files that a session waits for: measured poses, or logs of its motions."""
    demo.simulate_next(Path(session), print)


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])

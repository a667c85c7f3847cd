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
from calib.data.schema import Joints
from calib.dynamics.bodies import bodies_of
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.pseudo_inertia import ball
from calib.files import write_numbers
from calib.identification.prior import rods
from calib.parallel.mechanism.closure import closed
from calib.parallel.mechanism.geometric_fit import changed, loop_parameters
from calib.parallel.mechanism.parallel_model import PlatformRegressor, make_parallel_model
from calib.parallel.robots import find
from calib.procedure.excitation import coefficients
from calib.simulation import camera_cell, cell, virtual_arm, virtual_cells
from calib.simulation.cell import write_log, write_measured
from calib.simulation.known_robots import random_fourier, truth

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


def target_error(q: np.ndarray) -> float:
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


def tracker(plan: str, path: str, robot: str = "tx40") -> None:
    """Measure planned poses with a laser tracker: joints [deg] and the reflector's position [mm], a row per pose."""
    instrument = cell.SimulatedInstrument("laser tracker", position_sigma=15e-6, orientation_sigma=None)
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
    arm, rng, rate = virtual_cells.virtual_cell(robot, 0), np.random.default_rng(1), 1000.0
    speeds = np.full(arm.nominal.n, 0.15)
    motion = random_fourier(arm.nominal.lower, arm.nominal.upper, speeds, 240.0, rate, harmonics=12, seed=2)
    joints = np.degrees(motion.q[::8] + rng.normal(0.0, 1e-5, motion.q[::8].shape))
    write_numbers(
        log, ["t [s]", *(f"{name} [deg]" for name in arm.nominal.joint_names)], np.column_stack([motion.t[::8], joints])
    )
    memory = np.exp(-1.0 / (0.03 * rate))
    noise = lfilter([15e-6 * np.sqrt(1.0 - memory**2)], [1.0, -memory], rng.normal(size=(len(motion.t), 3)), axis=0)
    seen = 1e3 * (cell.true_poses(arm, motion.q)[:, :3, 3] + noise)
    seen[rng.uniform(size=len(seen)) < 0.01] = 0.0
    write_numbers(
        points, ["t [s]", "x [mm]", "y [mm]", "z [mm]"], np.column_stack([motion.t + 0.137, seen])[1000:-2000]
    )


def photos(folder: str, count: str = "30") -> None:
    """Take images of a board on the table with a camera in the hand of a UR5, and write its joints beside them."""
    eye = camera_cell.seen_by_camera(ur5())
    camera_cell.take_pictures(eye, camera_cell.views(eye, int(count), 1), Path(folder), seed=1)


GAINS = np.array([14.87, 13.26, 11.13, 10.62, 11.03, 11.47])  # of a UR10e [N m/A] (De Luca, in Mamedov & Mikhel 2020)
TOOL = ball(2.8, 0.06, np.array([0.01, 0.02, 0.07]))  # the true tool: 2.8 kg, 7 cm before the flange


def moving(robot: str, load: bool = False) -> virtual_arm.MovingArm:
    """Return the moving arm of a robot, with or without a load; the library's masses, or rods between the joints.

    The load is the tool; of the LWR4+ that of Kolyubin, Shiriaev and Jubien (2019), 3.28 kg beside axis 7.
    """
    place = virtual_cells.virtual_cell(robot, 0)
    if place.nominal.inertias is None:
        masses = rods(place.nominal, IdentificationModel(bodies_of(place.nominal), ()), total=30.0)
        place = replace(place, nominal=replace(place.nominal, inertias=masses))
    arm = virtual_arm.moving_arm(place, robot, 0)
    if not load:
        return arm
    body = truth(robot)["payload"]["inertia"] if robot == "lwr4plus" else TOOL
    return virtual_arm.carrying(arm, body)


def log(path: str, robot: str, motion: str, what: str = "torque", load: str = "") -> None:
    """Log a motion of a robot: a design's folder, played twice, or the number of a random one of 10 s at 500 Hz.

    Args:
        path: CSV to write: time [s], positions [deg], and
        what: motor torques (torque), torques of joint sensors (link), both, or motor currents (current).
        load: "load": with the load of `moving`.
    """
    arm, seed = moving(robot, load == "load"), sum(map(ord, path))
    if Path(motion).is_dir():
        design = coefficients.read(Path(motion))
        t = np.arange(round(design.period * design.rate) + 1) / design.rate
        reference = virtual_arm.play(t, *design.orders(t), 2)
    else:
        speeds = 0.5 * np.array([joint.velocity for joint in arm.chain.joints])
        limits = np.maximum(arm.chain.lower, -2.5), np.minimum(arm.chain.upper, 2.5)
        reference = random_fourier(*limits, speeds, 10.0, 500.0, acceleration=15.0, seed=int(motion))
    seen = virtual_arm.record(arm, reference, seed)
    if what == "link":
        seen = replace(seen, effort=seen.tau_link)
    elif what == "current":
        seen = replace(seen, effort=seen.effort / GAINS)
    file = write_log(seen if what == "both" else replace(seen, tau_link=None), path)
    if what == "current":
        head, rows = file.read_text().split("\n", 1)
        file.write_text(head.replace("tau_", "current_").replace("[Nm]", "[A]") + "\n" + rows)


def degrade(log: str, path: str, noise: str = "1") -> None:
    """Copy a log and add white noise [mrad] to its positions, as a bad encoder would: the torques stay as they are."""
    head, rows = Path(log).read_text(encoding="utf-8").split("\n", 1)
    names = head.split(",")
    values = np.loadtxt(rows.splitlines(), delimiter=",")
    positions = [name.startswith("q_") for name in names]
    sigma = np.degrees(1e-3 * float(noise))
    values[:, positions] += sigma * np.random.default_rng(0).normal(size=(len(values), sum(positions)))
    write_numbers(path, names, values)


def platform(folder: str) -> None:
    """Write a DualV's files: encoder readings with platform poses, logs without and with a payload of 5.37 kg.

    The true legs are 1 mm and 1 mrad (1 sigma) off their nominal; the torques are the model's, with noise.
    """
    known, place, rng = find("dualv").mechanism, Path(folder), np.random.default_rng(0)
    motors = known.robot.joint_names
    parameters = loop_parameters(known)
    true = closed(changed(known.robot, parameters, 1e-3 * rng.normal(size=len(parameters))))
    x = 0.9 * rng.uniform(known.robot.lower, known.robot.upper, (60, 3))
    q = true.place(x).q[:, known.robot.actuated] + 1e-5 * rng.normal(size=(60, 4))
    head = [*(f"{name} [deg]" for name in motors), "x [mm]", "y [mm]", "rz [deg]"]
    write_numbers(place / "measured.csv", head, np.column_stack([np.degrees(q), 1e3 * x[:, :2], np.degrees(x[:, 2])]))

    model = make_parallel_model(true, ["Fv Fc"], v0=0.05, payloads=["plate"])
    values = np.concatenate([model.known_parameters(), np.tile([0.05, 0.3], 4)])
    values[model.names.index("Mplate")] = 5.37
    t, order = np.arange(1000) / 1000.0, 2 * np.pi * np.array([1.5, 2.5, 4.0, 5.5])[:, None, None]
    for name, carried in (("empty", ()), ("load", ("plate",)), ("other", ("plate",))):
        angle = order * t[:, None] + rng.uniform(0, 6, (4, 1, 3))
        size = np.array([0.02, 0.02, 0.12])
        plan = PlatformRegressor(model, np.arange(model.p), values, carried)
        motion = plan.motion(*((size * part).sum(axis=0) for part in (
            np.sin(angle), order * np.cos(angle), -(order**2) * np.sin(angle)
        )))  # fmt: skip
        q = motion.posture.q[:, true.robot.actuated] + 1e-5 * rng.normal(size=(len(t), 4))
        tau = plan.torques(motion) + 0.5 * rng.normal(size=q.shape)
        head = ["t [s]", *(f"{name}_q [deg]" for name in motors), *(f"{name}_tau [Nm]" for name in motors)]
        write_numbers(place / f"{name}.csv", head, np.column_stack([t, np.degrees(q), tau]))


def bring(session: str) -> None:
    """Simulate the files that a session waits for: measured poses, or logs of its motions."""
    demo.simulate_next(Path(session), print)


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])

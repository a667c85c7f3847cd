"""The verbs of the Python API on real recordings, for processes that time them."""

import time
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from recordings import DATA

import calib

ARM, PANDA = DATA / "ur5_gts3800", DATA / "franka_panda_inria"
SEARCH = calib.ExcitationSettings(period=10.0, starts=1, evaluations=60, outlook=False)


@cache
def fitted() -> calib.GeometryFit:
    return fit_geometry()


@cache
def identified() -> calib.DynamicsModel:
    return identify_dynamics()


def load():
    return calib.load(ARM / "model.urdf")


def select_poses():
    return calib.select_poses(ARM / "model.urdf", 30)


def fit_geometry():
    return calib.fit_geometry(ARM / "model.urdf", ARM / "grid_800.csv", calib.FitSettings(holdout=0.25))


def position_sigma():
    return fitted().position_sigma(np.random.default_rng(0).uniform(-1.0, 1.0, (500, 6)))


def export():
    with TemporaryDirectory() as folder:
        return calib.export(fitted(), folder)


def compensate():
    with TemporaryDirectory() as folder:
        targets = Path(folder) / "targets.csv"
        positions = np.random.default_rng(0).uniform((0.3, -0.3, 0.2), (0.5, 0.3, 0.5), (50, 3))
        np.savetxt(targets, positions, delimiter=",", header="x [m],y [m],z [m]", comments="")
        return calib.compensate(fitted(), targets)


def design_excitation():
    return calib.design_excitation(PANDA / "model.urdf", SEARCH)


def identify_dynamics():
    log = PANDA / "traj1_first60pct.npz"
    return calib.identify_dynamics(PANDA / "model.urdf", f"{log}@0:8.5", validate=f"{log}@8.5:12.6")


def torque_sigma():
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (2000, 7))
    return identified().torque_sigma(q, q, q)


VERBS = (
    load,
    select_poses,
    fit_geometry,
    position_sigma,
    export,
    compensate,
    design_excitation,
    identify_dynamics,
    torque_sigma,
)


def processor_time(verb: str) -> float:
    """Return the processor time of all threads [s] that a verb takes in this process."""
    began = time.process_time()
    globals()[verb]()
    return time.process_time() - began

"""The demonstration: a session on a simulated cell, ended by a comparison with the truth it did not know."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib import files
from calib.data.measurements import PoseMeasurements
from calib.data.plans import read_poses
from calib.dynamics.gravity import gravity_torques
from calib.errors import SessionError
from calib.geometry.deflection import evaluate
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation, see
from calib.procedure import calibrated, steps
from calib.procedure.guided import begin
from calib.procedure.session import Session, locked
from calib.robot.chain import random_joints
from calib.simulation import brought
from calib.simulation.cell import Cell, measure, true_poses
from calib.simulation.cells import virtual_cell
from calib.transforms import to_quaternion

Say = Callable[[str], None]
FIT, VALIDATION, TRUTH = 40, 20, 2000
RESULTS = (
    ("certificate", "certificate.html"),
    ("plots", "4-fit"),
    ("calibrated URDF", "6-export/robot.urdf"),
    ("the session", "session.toml"),
)


@dataclass(frozen=True)
class Found:
    """What the demonstration came to: the session, its verdict, and errors against the hidden truth, rms [mm]."""

    session: Session
    verdict: str
    nominal: float
    calibrated: float
    seconds: float


def run(folder: Path, robot: str, seed: int, say: Say, progress: Say) -> Found:
    """Calibrate a simulated robot in a session, and compare with its hidden truth.

    Args:
        folder: new; the session.
        robot: of the library.
        seed: of the robot's errors (other robots than lwr4plus), the noise, and the pose selection.
        say, progress: lines that stay, and words that pass.
    """
    started = time.perf_counter()
    cell = virtual_cell(robot, seed)
    session = begin(folder, robot, "cmm", poses=FIT, validation=VALIDATION, seed=seed, base="", tip="")
    say(f"the cell: {cell.note}")
    with locked(session):
        steps.run_next(session, say, progress, "calib demo")
        bring(session, cell, seed)
        say("    (the simulated cell measures both lists of poses)")
        waiting = steps.run_next(session, say, progress, "calib demo")
    if waiting is not None:
        raise SessionError(f"the demonstration stopped at {waiting.step.name}: {waiting.words}")
    before, after, bare = against_truth(session, cell)
    words = (
        f"hidden truth, over {TRUTH} poses of the whole joint range: the tool is off by {before:.3f} mm rms with the "
        f"nominal arm, {after:.3f} mm with the calibrated one"
    )
    if bare > after:
        words += f" ({bare:.3f} mm with its URDF alone, without the joint corrections)"
    files.write(session.path("truth.txt"), f"{cell.note}\n{words}\n")
    say(words)
    verdict = json.loads(session.path("5-validation/metrics.json").read_text(encoding="utf-8"))["verdict"]
    return Found(session, verdict, before, after, time.perf_counter() - started)


def bring(session: Session, cell: Cell, seed: int) -> None:
    """Let the simulated cell measure the planned poses."""
    kinds = [joint.kind for joint in cell.nominal.joints]
    for number, (plan, name) in enumerate((("poses", "measured"), ("validation", "validation"))):
        q = read_poses(session.path(f"2-poses/{plan}.csv"), cell.nominal.joint_names, kinds=kinds)
        brought.write(measure(cell, q, np.random.default_rng([seed, number])), session.path(f"3-measured/{name}.csv"))


def against_truth(session: Session, cell: Cell) -> tuple[float, float, float]:
    """Return rms position errors against the noise-free truth [mm]: nominal, calibrated, and its URDF alone.

    The nominal arm and the URDF get their best station and tool for these very poses, so that arms are compared.
    """
    q = random_joints(cell.nominal, TRUTH, 12345)
    true = true_poses(cell, q)
    points = true[:, :3, 3]
    block = PoseMeasurements("pose", q, cell.nominal.joint_names, position=points, quaternion=to_quaternion(true))
    rigid = calibrated.rigid_chain(session.path("4-fit"))
    nominal, alone = (polish_frames(install(chain, [block]), [block]).cell for chain in (cell.nominal, rigid))
    found = calibrated.read(session.path("4-fit"))
    before, after, bare = (_rms(arm, q, points) for arm in (nominal, found, alone))
    return before, after, bare


def _rms(arm: Installation, q: np.ndarray, points: np.ndarray) -> float:
    bases = None
    if arm.deflection.terms:
        reference = arm.deflection.reference or arm.chain
        torque = None if reference.inertias is None else gravity_torques(reference, q)
        bases = evaluate(arm.deflection, q, torque)
    error = see(arm, q, bases=bases).point.T - points
    return float(1e3 * np.sqrt(np.mean(np.sum(error**2, axis=1))))

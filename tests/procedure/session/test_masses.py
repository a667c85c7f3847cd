"""Identified masses in the compliance's gravity torques: by settings, by command, and as rounds of a session."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest
from without_figures import run

import calib
from calib.data.poses.measurements import Poses
from calib.errors import UsageError
from calib.identification.model_file import identified_masses
from calib.procedure.session.commands import new_session
from calib.procedure.session.folder import MASSES, open_session, read_state
from calib.procedure.session.masses import ROUNDS, largest_move
from calib.records import read_json
from calib.robot import calibrated, description
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain
from calib.robot.kinematics import forward, gravity_torques
from calib.transforms import pose, to_quaternion

COMPLIANCE = np.array([0.0, -5e-5, -2e-4])  # [rad/(N m)]; the first axis is vertical


def believed() -> Chain:
    """Return the arm with the masses of a data sheet, which are up to 30 % off."""
    return replace(planted.arm(), inertias=planted.INERTIAS * np.array([[1.1], [0.7], [1.3]]))


def measured(seed: int, count: int) -> Poses:
    """Return poses of the arm with compliant joints, noise 20 µm."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-2.2, 2.2, (count, planted.N))
    bent = q + COMPLIANCE * gravity_torques(planted.arm(), q)
    seen = pose(position=[1.5, -0.5, 0.3]) @ forward(planted.arm(), bent) @ pose(position=[0.1, 0.05, 0.08])
    names = planted.arm().joint_names
    return Poses(q, names, seen[:, :3, 3] + 2e-5 * rng.normal(size=(count, 3)), to_quaternion(seen), tool_names=("t",))


@pytest.fixture(scope="module")
def identified(tmp_path_factory) -> Path:
    """Return the folder of an identification of the arm, masses of the data sheet beside."""
    folder = tmp_path_factory.mktemp("identified")
    robot, log = description.write(folder / "arm.toml", believed()), planted.write(folder, "log.npz", 1)
    settings = calib.IdentifySettings(friction="standard", filter={"cutoff": 30.0, "band": 10.0})
    return calib.identify_dynamics(robot, log, settings).save(folder / "out", plots=False)


@pytest.mark.slow
def test_masses_have_true_gravity_torques(identified):
    """Identified masses have the true gravity torques."""
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (50, planted.N))
    own = replace(planted.arm(), inertias=identified_masses(identified, planted.arm()))
    found, true, wrong = (gravity_torques(arm, q) for arm in (own, planted.arm(), believed()))
    assert np.abs(found - true).max() < 0.05 < 1.0 < np.abs(wrong - true).max()


@pytest.mark.slow
def test_identified_masses_fix_compliance(identified, tmp_path):
    """Compliance is right with identified masses, and wrong with those of the data sheet."""
    poses = measured(1, 50)
    for masses, limits in (("", (0.15, 1.0)), (str(identified), (0.0, 0.01))):
        found = calib.fit_geometry(
            CalibratedChain(believed()), poses, calib.FitSettings(model="stiffness", masses=masses)
        )
        rows = dict(zip(found.estimate.names, zip(found.estimate.values, found.estimate.sigma)))
        value, sigma = rows["elbow compliance"]
        assert limits[0] <= abs(value / COMPLIANCE[2] - 1.0) <= limits[1]
    read = calibrated.read(found.save(tmp_path / "fit", plots=False))
    np.testing.assert_allclose(read.deflection.reference.inertias, identified_masses(identified, believed()))
    np.testing.assert_array_equal(read.complete.inertias, believed().inertias)
    names = (*read.complete.names, *read.deflection.names(read.complete))
    own = names.index("elbow compliance")
    assert np.sqrt(read.corrections.covariance[own, own]) == pytest.approx(sigma, rel=1e-9)


@pytest.mark.slow
def test_masses_of_another_arm_are_refused(identified, tmp_path):
    """Masses of another arm or of no folder are refused."""
    with pytest.raises(UsageError, match="has 7"):
        identified_masses(identified, calib.load("lwr4plus").chain)
    with pytest.raises(Exception, match="identif"):
        identified_masses(tmp_path, planted.arm())
    assert largest_move(tmp_path, identified) == np.inf and largest_move(identified, identified) == 0.0


@pytest.mark.slow
def test_masses_return_until_nothing_moves(tmp_path):
    """A session returns masses until nothing moves."""
    robot = description.write(tmp_path / "arm.toml", believed())
    session = new_session(tmp_path / "s", robot, "other-pose", friction="standard", plan=False)
    text = (session / "session.toml").read_text()
    head, tail = text.split("[poses]", 1)
    (session / "session.toml").write_text(f"{head}[poses]{tail.replace('plan = true', 'plan = false', 1)}")
    for name, seed, count in (("measured", 1, 50), ("validation", 2, 20)):
        block = measured(seed, count)
        names = [*(f"{name} [rad]" for name in block.joint_names), "x [m]", "y [m]", "z [m]", "qx", "qy", "qz", "qw"]
        rows = np.column_stack([block.q, block.position, block.quaternion])
        np.savetxt(session / f"3-measured/{name}.csv", rows, delimiter=",", header=",".join(names), comments="")
    for name, seed in (("training", 1), ("validation", 2)):
        planted.write(session / "7-recorded", f"{name}.npz", seed)
    assert run("next", session) == 1  # without its corrections the arm is no better: the springs are what was wrong
    state = read_state(open_session(session))
    words = " ".join(state.steps["identify"].notes)
    assert "converged" in words and "not converged" not in words
    assert read_json(session / MASSES / ROUNDS, "", dict[str, int]) == {"rounds": 0}
    found = calibrated.read(session / "4-fit").deflection
    own = found.names(planted.arm()).index("elbow compliance")
    assert float(np.asarray(found.coefficients)[own]) == pytest.approx(COMPLIANCE[2], rel=0.03)

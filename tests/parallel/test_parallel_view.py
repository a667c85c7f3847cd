"""`calib view` of a parallel robot's folders: loops drawn closed, poses with their errors, motions, torques."""

import csv
from pathlib import Path

import numpy as np
import pytest

from calib import cli
from calib.apps.viewer import viewer
from calib.parallel.mechanism.closure import closed
from calib.parallel.mechanism.geometric_fit import changed, loop_parameters
from calib.parallel.robots import find
from calib.parallel.view import picture
from calib.results import scene_files as viewing


def recorded(path: Path) -> dict[str, list]:
    """Return the chunks of a recording's entities that change in time."""
    chunks, found = pytest.importorskip("rerun.chunk"), {}
    for chunk in chunks.RrdReader(str(path)).store().stream():
        if not chunk.is_static:
            found.setdefault(chunk.entity_path, []).append(chunk)
    return found


@pytest.mark.parametrize("name", ["dualv", "fivebar", "stewart"])
def test_the_lines_are_closed_loops(name):
    robot = find(name)
    x = np.random.default_rng(0).uniform(robot.chain.lower, robot.chain.upper, (4, robot.chain.r))
    q = robot.mechanism.place(x).q[:, robot.chain.actuated]
    *legs, outline = picture(robot).strips(q)
    assert len(legs) == len(robot.chain.legs) and outline.shape == (4, len(legs) + 1, 3)
    for k, leg in enumerate(legs):
        np.testing.assert_allclose(leg[:, -3], outline[:, k], atol=1e-9)  # its end, where the platform holds it
        np.testing.assert_allclose(leg[:, -1], legs[0][:, -1], atol=1e-9)  # the platform's origin


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Path:
    """The folder of a fit of 20 poses of a five-bar linkage of another geometry, 5 of them unseen."""
    here, robot, rng = tmp_path_factory.mktemp("view"), find("fivebar"), np.random.default_rng(0)
    parameters = loop_parameters(robot.mechanism)
    true = closed(changed(robot.chain, parameters, 1e-3 * rng.normal(size=len(parameters))))
    x = 0.8 * rng.uniform(robot.chain.lower, robot.chain.upper, (20, 2))
    q = true.place(x).q[:, robot.chain.actuated] + 1e-5 * rng.normal(size=(20, 2))
    with (here / "poses.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["motor_left", "motor_right", "x [mm]", "y [mm]"], *np.hstack([q, 1e3 * x])])
    assert cli.run(["fit", "fivebar", f"{here}/poses.csv", "--holdout", "0.25", "--out", f"{here}/fit"]) == 0
    return here / "fit"


@pytest.mark.slow
def test_a_fit_shows_its_poses_and_errors(fitted, tmp_path):
    assert cli.run(["view", str(fitted), "--save", str(tmp_path / "a.rrd")]) == 0
    found = recorded(tmp_path / "a.rrd")
    for name in ("/errors/nominal", "/errors/calibrated", "/errors/unseen", "/world/pose", "/world/robot/lines"):
        assert sum(chunk.num_rows for chunk in found[name]) == 20, name
    table = found["/world/robot/lines"][0].to_record_batch()
    strips = next(table.column(name) for name in table.schema.names if name.endswith("strips"))
    assert all(len(strip) == 3 for strip in strips.to_pylist())  # two legs and the platform
    measured = viewing.read(fitted).measured[0]
    with (fitted / "residuals.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["set"] == "fit" for row in rows] == (~measured.unseen).tolist()
    for points, head in ((measured.calibrated, ""), (measured.nominal, "nominal ")):
        wanted = [[float(row[f"{head}d{axis} [mm]"]) for axis in "xy"] for row in rows]
        np.testing.assert_allclose(1e3 * (measured.seen - points)[:, :2], wanted, atol=1e-8)
    assert np.isnan(measured.turned).all()


@pytest.mark.slow
def test_views_name_actuators_and_rows(fitted, tmp_path):
    """Motions and torques are shown under the names of actuators and rows."""
    folder = tmp_path / "id"
    find("dualv").write(folder)
    q = np.tile(find("dualv").mechanism.home.q[:, find("dualv").chain.actuated], (3, 1))
    t = [[0.0], [0.02], [0.04]]
    (folder / "dynamics.json").write_text('{"kind": "platform", "unit": "N m"}')
    head = [f"{what}{k + 1}" for what in ("measured_", "predicted_") for k in range(3)] + ["q1", "q2", "q3", "q4"]
    table = np.hstack([t, np.zeros((3, 6)), q])
    np.savetxt(folder / "torques_1.csv", table, delimiter=",", header=",".join(["t [s]", *head]), comments="")
    head = ["t [s]", "x", "y", "rz", *(f"{key}_motor{k}" for key in ("q", "v", "tau") for k in range(1, 5))]
    table = np.hstack([t, np.zeros((3, 3)), q, 0 * q, 0 * q])
    np.savetxt(folder / "motion.csv", table, delimiter=",", header=",".join(head), comments="")
    scene = viewer.write(folder, tmp_path / "b.rrd")
    assert [title.split()[0] for title in scene.torques[0].rows] == ["x", "y", "rz"]
    assert scene.torques[0].units == ("N", "N", "N m") and "motion *motion*: 0.0 s" in viewer.about(scene)
    found = recorded(tmp_path / "b.rrd")
    assert "/motion/velocity/motor4" in found and "/limits/velocity/motor1/upper" in found
    assert sum(chunk.num_rows for chunk in found["/world/robot/lines"]) == 6

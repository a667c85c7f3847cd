"""What `calib view` records is all that the folder holds: read back from the file, entity by entity."""

import csv
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from calib import cli
from calib.apps.viewer import viewer
from calib.errors import UsageError
from calib.geometry import installation
from calib.procedure.excitation import coefficients
from calib.results import scene_files as viewing
from calib.results.scene import thinned
from calib.results.scene_files import visuals
from calib.robot.formats import urdf_write
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.robot.tables import dumps
from calib.simulation.cell import SimulatedInstrument, measure
from calib.simulation.virtual_cells import perturbed_cell


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Path:
    """A fit of 60 poses of a UR5, 15 of them kept aside."""
    folder = tmp_path_factory.mktemp("viewer")
    cell = perturbed_cell(load("ur5"), 2, SimulatedInstrument(position_sigma=3e-5, orientation_sigma=1e-4))
    q = np.random.default_rng(0).uniform(-2, 2, (60, 6))
    seen = measure(cell, q, 1)
    with (folder / "seen.csv").open("w", newline="") as file:
        head = [*(f"q{k + 1}" for k in range(6)), "x", "y", "z", "qx", "qy", "qz", "qw"]
        csv.writer(file).writerows([head, *np.hstack([seen.q, seen.position, seen.quaternion]).tolist()])
    arguments = ["fit", "ur5", folder / "seen.csv", "--holdout", "0.25", "--model", "geometry", "--no-plots"]
    assert cli.run([*map(str, arguments), "--out", str(folder / "done")]) == 0
    return folder / "done"


@pytest.fixture
def session(fitted, tmp_path) -> Path:
    """A folder laid out as a session: the fit, a pose plan, a motion, and torques."""
    rng, here = np.random.default_rng(5), tmp_path / "session"
    for name in ("2-poses", "6-excitation/training", "8-dynamics/unseen"):
        (here / name).mkdir(parents=True)
    (here / "4-fit").symlink_to(fitted)
    names = load("ur5").joint_names

    def table(path: str, head: list[str], columns: np.ndarray) -> None:
        with (here / path).open("w", newline="") as file:
            csv.writer(file).writerows([head, *columns.tolist()])

    table("2-poses/poses.csv", list(names), rng.uniform(-1, 1, (7, 6)))
    t = np.arange(0, 2, 0.01)[:, None]
    wave = np.sin(t + np.arange(6))
    head = ["t", *(f"{letter}{k + 1}" for letter in "qva" for k in range(6))]
    table("6-excitation/training/trajectory.csv", head, np.hstack([t, wave, np.cos(t + np.arange(6)), -wave]))
    head = ["t [s]"]
    for what in ("measured_", "predicted_", "q", "sigma_", "nominal_"):
        head += [f"{what}{k + 1}" for k in range(6)]
    (here / "8-dynamics/dynamics.json").write_text('{"kind": "motor", "unit": "N m"}')
    sigma = np.full_like(wave, 0.05)
    table("8-dynamics/unseen/torques_1.csv", head, np.hstack([t + 0.5, wave, wave - 0.1, wave, sigma, wave - 0.3]))
    return here


def rows(path: Path) -> Counter[str]:
    """Return how many rows each entity of a recording has, those logged once for all times left out."""
    chunks = pytest.importorskip("rerun.chunk")
    found: Counter[str] = Counter()
    for chunk in chunks.RrdReader(str(path)).store().stream():
        if not chunk.is_static:
            found[chunk.entity_path] += chunk.num_rows
    return found


def constant(path: Path) -> set[str]:
    chunks = pytest.importorskip("rerun.chunk")
    return {chunk.entity_path for chunk in chunks.RrdReader(str(path)).store().stream() if chunk.is_static}


def test_fit_shows_poses_of_both_arms(fitted, tmp_path):
    """A fit shows every pose as both arms see it."""
    pytest.importorskip("rerun")
    scene = viewer.write(fitted, tmp_path / "a.rrd")
    measured = scene.measured[0]
    assert (len(measured.q), int(measured.unseen.sum())) == (60, 15)
    found, still = rows(tmp_path / "a.rrd"), constant(tmp_path / "a.rrd")
    axes = [f"/axes/{nature}/{axis}" for nature in ("position", "orientation") for axis in "xyz"]
    errors = ("/errors/nominal", "/errors/calibrated", "/errors/unseen", "/turns/calibrated")
    for name in (*errors, *axes, "/world/pose", "/world/robot/lines"):
        assert found[name] == 60, name
    scale = measured.arrow_scale(scene.chain)
    assert {f"/world/errors_times_{scale:g}/{arm}" for arm in ("nominal", "calibrated")} <= still
    assert f"{scale:g} times as long as the errors" in viewer.about(scene)
    assert "45 fitted poses: " in viewer.about(scene) and "15 unseen poses: " in viewer.about(scene)


def test_held_out_poses_have_intervals(fitted, tmp_path):
    """The radii of ``residuals.csv`` are drawn beside the errors of the rows that were held out."""
    pytest.importorskip("rerun")
    scene = viewer.write(fitted, tmp_path / "a.rrd")
    measured = scene.measured[0]
    with (fitted / "residuals.csv").open(newline="") as file:
        stated = [float(row["interval95 [mm]"] or "nan") for row in csv.DictReader(file)]
    assert 1e3 * measured.interval == pytest.approx(np.array(stated), nan_ok=True)
    assert rows(tmp_path / "a.rrd")["/errors/interval95"] == np.isfinite(measured.interval).sum() == 15


def test_torques_have_band_and_cad_geometry(session):
    """Torques come with the interval that is expected to contain 95 %, and with those of the CAD geometry."""
    (torques,) = viewing.read(session).torques
    lower, upper = torques.band
    assert upper - lower == pytest.approx(np.full((200, 6), 2 * 1.96 * 0.05))
    assert 0.5 * (lower + upper) == pytest.approx(torques.predicted)
    assert torques.measured - torques.nominal == pytest.approx(np.full((200, 6), 0.3))
    assert "95 % light green" in viewer.about(viewing.read(session))
    table = session / "8-dynamics/unseen/torques_1.csv"
    plain = [",".join(line.split(",")[:19]) for line in table.read_text().splitlines()]
    table.write_text("\n".join(plain))
    (torques,) = viewing.read(session).torques
    assert torques.band is None and torques.nominal is None


def test_front_of_trade_offs_is_drawn(session, tmp_path):
    """The front of a motion's folder is drawn with the designed motion marked; a damaged one is noted."""
    pytest.importorskip("rerun")
    folder = session / "6-excitation/training"
    head = "motion,condition number,torque slack,not dominated,designed"
    lines = [head, "1,30,0.9,True,False", "2,35,0.8,True,True", "3,40,0.85,False,False"]
    (folder / "front.csv").write_text("\n".join(lines))
    assert "no front is shown" in viewing.read(session).notes[-1]  # its motions are missing
    for number in "123":
        (folder / "front" / number).mkdir(parents=True)
        motion = coefficients.Periodic(("a",), ("revolute",), 1.0, 100.0, 1, "fourier", (np.zeros(3),))
        text = dumps(coefficients.table(motion, "ur5", ()))
        (folder / "front" / number / "trajectory.toml").write_text(text)
    scene = viewer.write(session, tmp_path / "f.rrd")
    (front,) = scene.fronts
    assert front.best.tolist() == [True, True, False] and front.designed == 1
    assert front.drawn == pytest.approx(np.array([[0.0, 1.0], [0.5, 0.0], [1.0, 0.5]]))
    assert front.labels[1] == "2: condition number 35, torque slack 0.8"
    assert {"/front/training/motions", "/front/training/best"} <= constant(tmp_path / "f.rrd")
    assert "motion 2 of 3 was designed" in viewer.about(scene)


def test_arrows_are_the_reported_errors(fitted):
    """The arrows are the errors that the fit reports."""
    measured = viewing.read(fitted).measured[0]
    with (fitted / "residuals.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    for points, column in ((measured.calibrated, "size [mm]"), (measured.nominal, "nominal size [mm]")):
        sizes = 1e3 * np.linalg.norm(measured.seen - points, axis=1)
        assert sizes == pytest.approx([float(row[column]) for row in table], rel=1e-4)
    turns = [[float(row[f"dr{axis} [deg]"]) for axis in "xyz"] for row in table]
    assert np.degrees(measured.turned) == pytest.approx(np.array(turns))
    tool = installation.read(fitted).tools[0]
    at = (forward(load(fitted), measured.q) @ tool)[:, :3, 3]
    assert np.abs(at - measured.calibrated).max() < 1e-9  # in the base of the arm that is drawn


def test_session_plays_on_one_clock(session, tmp_path):
    """A session plays poses, motions and torques on one clock."""
    chunks = pytest.importorskip("rerun.chunk")
    scene = viewer.write(session, tmp_path / "s.rrd")
    found = rows(tmp_path / "s.rrd")
    some = len(thinned(scene.played[0].t))
    assert some == 101  # 2 s at 50 Hz
    assert found["/world/chosen/poses"] == 7
    elbow = "elbow_joint_motor_torque"
    assert scene.torques[0].rows[2] == "elbow_joint motor torque" and scene.torques[0].units == ("N m",) * 6
    assert found["/motion/position/elbow_joint"] == some and found["/limits/velocity/elbow_joint/upper"] == 2
    curves = ("measured", "predicted", "lower", "upper", "nominal")
    assert [found[f"/torques/{elbow}/{curve}"] for curve in curves] == [200] * 5 and found[f"/residuals/{elbow}"] == 200
    assert not [name for name in found if "\\" in name or " " in name]
    assert found["/world/robot/lines"] == 7 + 60 + 2 * some
    clocks = {}
    for chunk in chunks.RrdReader(str(tmp_path / "s.rrd")).store().stream():
        if not chunk.is_static and chunk.entity_path[1:].split("/")[0] in ("chosen", "errors", "motion", "torques"):
            assert "time" in chunk.timeline_names
            values = chunk.to_record_batch().column("time").to_numpy(zero_copy_only=False).astype("int64")
            part = chunk.entity_path[1:].split("/")[0]
            low, high = clocks.get(part, (values[0], values[-1]))
            clocks[part] = (min(low, *values), max(high, *values))
    order = [clocks[part] for part in ("chosen", "errors", "motion", "torques")]
    assert all(before[1] < after[0] for before, after in pairwise(order))


def test_links_are_meshes_where_files_exist(session, tmp_path):
    """Links are meshes where their files are found."""
    pytest.importorskip("rerun")
    mesh = tmp_path / "arm_description" / "meshes" / "a.stl"
    mesh.parent.mkdir(parents=True)
    mesh.write_bytes(b"solid a\nendsolid a\n")
    visual = "<visual><origin xyz='0 0 0.1' rpy='0 0 1'/><geometry><mesh filename='{}'/></geometry></visual>"
    both = "".join(visual.format(f"package://arm_description/meshes/{name}.stl") for name in "ab")
    text = urdf_write.write_new(load("ur5"))
    link = "elbow_joint_link"
    edited = text.replace(f'<link name="{link}"/>', f'<link name="{link}">{both}</link>')
    assert edited != text
    (tmp_path / "arm.urdf").write_text(edited)
    meshes, missing = visuals(tmp_path / "arm.urdf")
    assert [(one.link, one.file) for one in meshes] == [(link, mesh)]
    assert missing == ["package://arm_description/meshes/b.stl"]
    assert meshes[0].placement[2, 3] == 0.1 and meshes[0].scale.tolist() == [1, 1, 1]
    folder = session / "6-excitation" / "training"
    scene = viewer.write(folder, tmp_path / "m.rrd", str(tmp_path / "arm.urdf"))
    assert rows(tmp_path / "m.rrd")[f"/world/robot/links/{link}"] == 101
    assert f"/world/robot/links/{link}/mesh_0" in constant(tmp_path / "m.rrd")
    assert any("b.stl" in note for note in scene.notes)


def test_missing_rerun_is_said(fitted, monkeypatch, capsys, tmp_path):
    """Without Rerun the command says what to install, and a session goes on."""
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert cli.run(["view", str(fitted), "--save", str(tmp_path / "x.rrd")]) == 2
    assert "pip install 'armature-calib[view]'" in capsys.readouterr().err
    assert not (tmp_path / "x.rrd").exists()
    assert "is not installed" in viewer.write_beside(fitted)


def test_failing_recording_stops_nothing(fitted, monkeypatch):
    """A recording that fails stops nothing."""

    def broken(*arguments: object) -> None:
        raise RuntimeError("no room")

    monkeypatch.setattr(viewer, "write", broken)
    assert viewer.write_beside(fitted) == "no session.rrd: no room"


def test_empty_folders_are_refused(tmp_path):
    """Folders that show nothing are refused."""
    with pytest.raises(UsageError, match="contains no result; give a folder with measured poses"):
        viewing.read(tmp_path)
    with pytest.raises(UsageError, match="neither folder nor CSV"):
        viewing.read(tmp_path / "none")
    assert cli.run(["view", str(tmp_path), "--no-spawn"]) == 2


def test_motion_alone_needs_its_robot(session):
    """A motion alone needs to be told its robot."""
    folder = session / "6-excitation" / "training"
    assert "--robot" in viewing.read(folder).notes[-1]
    scene = viewing.read(folder, "ur5")
    assert scene.chain is not None and scene.chain.n == 6 and not scene.notes

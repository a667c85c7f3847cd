"""Claims: poses chosen for a camera see the board; boards are made; a session with images goes to its certificate."""

import json
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from sessions import begin

from calib.cli import run
from calib.data.images.board import read_board
from calib.data.images.board_print import make
from calib.data.images.image_bags import ImageBag, write_image_folder
from calib.data.images.pixels import Detection, Detections
from calib.data.poses.measurements import Distances, PoseMeasurements
from calib.data.poses.pose_lists import read_poses
from calib.errors import UsageError
from calib.geometry.observability import targets_of
from calib.poses.space import is_feasible
from calib.procedure.kinematic_stage import selection
from calib.procedure.kinematic_stage.settings import SelectionSettings
from calib.procedure.measuring.pose_limits import read_limits
from calib.procedure.session.commands import go_on
from calib.procedure.session.folder import open_session
from calib.procedure.session.questions import cell_tables
from calib.robot.calibrated import Deflection
from calib.robot.library import load
from calib.simulation import camera_cell as camera
from calib.simulation.cell import SimulatedInstrument
from calib.simulation.virtual_cells import rigid, virtual_cell
from calib.transforms import from_xyz_rpy, pose

SILENT = partial(lambda *words: None)


@pytest.fixture(scope="module")
def cell() -> camera.CameraCell:
    arm = rigid(virtual_cell("lwr4plus", instrument=SimulatedInstrument(encoder_sigma=1e-5)))
    return camera.camera_cell(arm, lens=camera.DEMO_LENS, reach_of_arm=0.75)


@pytest.mark.slow
def test_view_has_to_hold_the_whole_board(cell):
    """Against the projection of every corner; the places in the file are rounded to centimetres."""
    with camera.limits_of(cell) as path:
        limits = read_limits(path, targets_of(cell.cell.nominal))
    view = limits.camera
    assert view is not None and "the whole board in the camera's view, its range and its tilt" in limits.checked
    exact = replace(
        view, cell=replace(cell.cell.truth, deflection=Deflection()), margin=6.0, tilt=np.pi / 2, span=(0.0, 9.0)
    )
    q = camera.views(cell, 200, 3, camera.Views((0.2, 0.7), 0.9, whole=False))
    seen, kept = camera.visible(cell, q).all(axis=1), (exact(q) <= 0.0).all(axis=1)
    assert 0.2 < seen.mean() < 0.9 and (seen == kept).mean() > 0.97
    space = limits.space(view.observation(limits.lower, limits.upper))
    found = view.draw(10, partial(is_feasible, space), limits.lower, limits.upper, 0)
    assert len(found) == 10 and is_feasible(space, found).all()
    assert "view past the arm" in limits.checked


@pytest.mark.slow
def test_chosen_poses_see_the_board(cell, tmp_path):
    """Chosen poses see the board, and tell what images tell."""
    with camera.limits_of(cell) as path:
        chosen = selection.choose("lwr4plus", 15, SelectionSettings(candidates=120), constraints=path)
        limits = read_limits(path, targets_of(cell.cell.nominal))
    assert chosen.parameters == 42  # 34 of the arm with both placements, 8 of the lens
    assert chosen.selection.value > 1.05 * chosen.selection.random_baseline
    assert (limits.camera(chosen.selection.q) <= 1e-8).all()
    others = chosen.outlook.others
    assert [one.poses for one in others] == [10, 20, 40, 80] and np.all(np.diff([one.rms for one in others]) < 0.0)


@pytest.mark.slow
def test_camera_without_a_board_is_refused(cell, tmp_path):
    """A camera that sees no board is refused."""
    with camera.limits_of(cell) as path:
        path.write_text(path.read_text().replace("tilt", "# tilt").replace("stands = {xyz = [0", "stands = {xyz = [9"))
        with pytest.raises(UsageError, match="sees the board at hardly any posture"):
            selection.choose("lwr4plus", 15, SelectionSettings(candidates=60), constraints=path)
        path.write_text(path.read_text().replace("camera.yaml", "lens.yaml"))
        with pytest.raises(UsageError, match=r"camera: no file 'lens.yaml' next to it"):
            read_limits(path, targets_of(load("lwr4plus")))


def test_stated_camera_is_checked_or_said(cell, tmp_path):
    """A camera looks along its z, a board's z goes into it; what is unknown is named in what is unchecked."""
    arm = targets_of(cell.cell.nominal)
    with camera.limits_of(cell) as path:
        told = {
            "mounting": "in-hand", "lens": str(path.parent / "camera.yaml"), "board": str(path.parent),
            "carried": "0.04,0.02,0.06", "stands": "0.46,0,0 facing z",
        }  # fmt: skip
        whole, part = cell_tables(**told), cell_tables(**{**told, "lens": "unknown", "stands": None})
        for name, tables in (("whole", whole), ("part", part)):
            begin(tmp_path / name, "lwr4plus", "camera", 30, 10, limits=tables, dynamics=False)
    carried, stands = (from_xyz_rpy(**whole["camera"][key])[:3, 2] for key in ("carried", "stands"))
    np.testing.assert_allclose([carried, stands], [[0, 0, 1], [0, 0, -1]], atol=1e-5)
    seen, blind = (read_limits(tmp_path / name / "limits.toml", arm) for name in ("whole", "part"))
    assert seen.camera is not None and not any("camera" in words for words in seen.unchecked)
    assert blind.camera is None and "the camera's view of the board (not known: lens, stands)" in blind.unchecked
    assert not (tmp_path / "part/camera.yaml").exists() and (tmp_path / "part/board.toml").exists()


def test_images_without_a_board_are_an_error(tmp_path, capsys):
    assert run(["board", "--out", str(tmp_path)]) == 0
    for k in range(2):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((200, 300), 128, np.uint8))
    assert run(["images", str(tmp_path)]) == 2
    assert "none of 2 images is usable (ChArUco" in capsys.readouterr().err


def test_a_board_that_was_measured_is_kept(tmp_path):
    for _ in range(2):
        assert run(["board", "--out", str(tmp_path)]) == 0
    path = tmp_path / "board.toml"
    path.write_text(path.read_text().replace("square = 0.03 ", "square = 0.0297 "))
    kept = path.read_bytes()
    assert run(["board", "--out", str(tmp_path)]) == 2 and path.read_bytes() == kept
    assert run(["board", "--out", str(tmp_path), "--overwrite"]) == 0 and path.read_bytes() != kept


def test_boards_are_made_or_refused(tmp_path, capsys):
    """Boards are made, and impossible ones refused."""
    given = ["--square", "25", "--columns", "7", "--rows", "5", "--paper", "A4"]
    assert run(["board", "--out", str(tmp_path), *given]) == 0
    made = read_board(tmp_path)
    assert (made.square, made.columns, made.rows, made.marker) == pytest.approx((0.025, 7, 5, 0.0175))
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF") and (tmp_path / "board.svg").exists()
    for wrong, words in (
        (["--kind", "dots"], "expected one of charuco, chessboard, apriltag"),
        (["--paper", "a4"], "squares of 25 mm would fit"),
        (["--paper", "b5"], "--paper b5: expected one of a4"),
        (["--dictionary", "5x5"], "dictionary: expected one of"),
        (["--square", "0.03"], "--square is in mm"),
        (["--columns", "3", "--rows", "3"], "has 4 corners, an image needs 8"),
    ):
        assert run(["board", "--out", str(tmp_path), *wrong]) == 2
        assert words in capsys.readouterr().err
    assert make(tmp_path, "chessboard", None, 7, 30.0, None, None, None)[0].startswith("chessboard 10 x 7, 30 mm")
    assert make(tmp_path, "apriltag", 4, 3, 30.0, None, None, None)[0].startswith(
        "AprilTag grid 4 x 3, 30 mm, 48 corners"
    )


def shots(cell, q, seed, folder):
    """Write what a detector would have found, as a folder without images."""
    block = camera.photograph(cell, q, 0.05, seed)
    images = {name: Detection(pixel, sigma) for name, pixel, sigma in zip(block.names, block.pixel, block.sigma)}
    images[block.names[2]] = Detection(np.full_like(block.pixel[2], np.nan), block.sigma[2], "blurred: still moving")
    write_image_folder(
        ImageBag(block.names, block.joint_names, block.q, Detections(images, block.size), ()), block.board, folder
    )


@pytest.mark.slow
def test_session_with_images_reaches_its_end(cell, tmp_path):
    """A session with images goes to its certificate."""
    with camera.limits_of(cell) as path:
        begin(tmp_path / "s", "lwr4plus", "camera", 30, 10, limits=path, dynamics=False)
    said: list[str] = []
    stop = go_on(tmp_path / "s", said.append, SILENT, "test", plots=False)
    asked = " ".join(stop.lines)
    assert "take an image of the board" in asked.lower() and "joints.csv (image, joint1 [deg]" in asked
    assert "board.toml" in asked and "3-measured/validation" in asked
    session, names = open_session(tmp_path / "s"), cell.cell.nominal.joint_names
    for seed, (plan, name) in enumerate((("poses", "measured"), ("validation_poses", "validation_measured"))):
        q = read_poses(session.path(f"2-poses/{plan}.csv"), names)
        shots(cell, q, seed, session.path(f"3-measured/{name}"))
    stop = go_on(tmp_path / "s", said.append, SILENT, "test", plots=False)
    told = " ".join(said)
    assert "not usable (blurred: still moving): 0003.png" in told and "the arm carries the camera" in told
    assert "the board sets the scale (30 mm per square)" in told
    assert stop.verdict == "pass"
    found = json.loads(session.path("5-validation/metrics.json").read_text())
    unseen = found["validation"]["validation_measured"]
    assert unseen["reprojection_px"]["calibrated"] < 0.2 < unseen["reprojection_px"]["nominal"]
    assert go_on(tmp_path / "s", said.append, SILENT, "test", plots=False).verdict == "pass"


@pytest.mark.slow
def test_prediction_is_sigma_of_a_fit(cell):
    """Sigma over the workspace from poses alone, against that of a fit of noisy images at them."""
    from calib.geometry.camera.camera_guess import complete_camera
    from calib.geometry.first_guess import install
    from calib.geometry.fit import fit
    from calib.geometry.observation import layout, pose_sigmas
    from calib.procedure.measuring.prediction import predicted as foretold
    from calib.robot.chain import random_joints

    with camera.limits_of(cell) as path:
        limits = read_limits(path, targets_of(cell.cell.nominal))
    q, everywhere = camera.views(cell, 40, 5), random_joints(cell.cell.nominal, 200, 1)
    seen = limits.camera.observation(limits.lower, limits.upper)
    predicted = foretold(seen, seen(q), everywhere)
    block = complete_camera(cell.cell.nominal, camera.photograph(cell, q, 0.05, 5))
    start = install(cell.cell.nominal, [block])
    table = layout(start)
    found = fit(start, [block], table.rigid_index)
    stated = pose_sigmas(
        found.cell, PoseMeasurements(everywhere, block.joint_names), found.free, found.estimate.covariance, station=-1
    )[:, 0]
    assert 0.4 < np.median(stated / predicted.spread) < 2.5  # the noise of the arm is our choice there
    assert np.corrcoef(np.log(stated), np.log(predicted.spread))[0, 1] > 0.5


@pytest.mark.slow
def test_images_are_a_tool_of_their_own(cell, tmp_path):
    """A tracker's reflector in the same hand, and distances of pairs of it; no option names the tools."""
    from calib.geometry.camera.camera_guess import complete_camera
    from calib.procedure.kinematic_stage.fit import run as fitted
    from calib.procedure.kinematic_stage.inputs import gather
    from calib.procedure.kinematic_stage.settings import FitSettings
    from calib.procedure.report import fit_report, geometry_figures
    from calib.robot.chain import random_joints
    from calib.simulation.cell import measure, true_poses

    arm, reflector = cell.cell.nominal, pose(None, [0.1, 0.0, 0.1])
    images = replace(
        camera.photograph(cell, camera.views(cell, 30, 5, camera.Views((0.5, 0.8))), 0.05, 5), tool_names=("tool",)
    )
    truth = replace(
        cell.cell.truth, stations=pose(None, [2.0, 1.0, 0.5])[None], tools=reflector[None], tool_names=("tool",)
    )
    tracker = replace(cell.cell, truth=truth, instrument=SimulatedInstrument("tracker", 20e-6, None))
    points = measure(tracker, random_joints(arm, 30, 6), 6)
    q = random_joints(arm, 40, 7)
    place = true_poses(tracker, q)[:, :3, 3].reshape(20, 2, 3)
    rng = np.random.default_rng(7)
    length = np.linalg.norm(place[:, 0] - place[:, 1], axis=1) + rng.normal(0.0, 2e-5, 20)
    pairs = Distances(q, arm.joint_names, np.repeat(length, 2), group=np.repeat(np.arange(20), 2))
    given = gather("lwr4plus", [images, points, pairs], settings=FitSettings(model="geometry"))
    assert [block.tool_names for block in given.fit] == [("camera",), ("tool",), ("tool",)]
    found = fitted(given, settings=FitSettings(model="geometry"))
    assert found.verdict.level == "pass"
    block = complete_camera(arm, images)
    (seen,) = fit_report.collect(found).images
    assert np.sum(seen.count) == block.seen.sum() and seen.size == cell.lens.size
    assert 0.03 < np.sqrt(np.sum(np.square(seen.rms) * seen.count) / np.sum(seen.count)) < 0.15
    assert "coverage" in geometry_figures.captioned(fit_report.collect(found))


@pytest.mark.slow
@pytest.mark.parametrize("share, word", [(1.0, "pass"), (0.98, "marginal"), (1.02, "marginal")])
def test_board_of_wrong_size_is_no_pass(cell, share, word):
    """A square that is off by less than its own check tells makes all fitted lengths grow by one factor."""
    from calib.procedure.kinematic_stage.fit import run as fitted
    from calib.procedure.kinematic_stage.inputs import gather
    from calib.procedure.kinematic_stage.settings import FitSettings

    block = camera.photograph(cell, camera.views(cell, 36, 5), 0.05, 5)
    board = replace(block.board, square=share * block.board.square, marker=share * block.board.marker)
    given = gather("lwr4plus", [replace(block, board=board)])
    found = fitted(given, settings=FitSettings(model="geometry"))
    assert found.verdict.level == word and (word == "pass" or "lengths are" in found.verdict.reason)

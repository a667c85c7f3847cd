"""Claims of corners in images: exact derivatives, an exact reduction, recovery of what was planted, honest sigmas."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from differences import check
from planted import perturb
from scipy.spatial.transform import Rotation

from calib.data.images.board_and_lens import board_poses
from calib.data.images.lens import Lens
from calib.data.images.optics import SHAPE, BoardShape
from calib.data.images.pixels import Pixels
from calib.data.poses import IN_HAND, TO_HAND
from calib.data.poses.measurements import Positions, take
from calib.errors import MeasurementError
from calib.geometry.camera.camera_guess import complete_camera
from calib.geometry.camera.robust_placement import place_robustly
from calib.geometry.first_guess import install
from calib.geometry.fit import fit, placed_on
from calib.geometry.installation import see
from calib.geometry.observation import layout, observe, prepare, step
from calib.geometry.weighing import Settings
from calib.procedure.kinematic_stage.verdict.image_findings import image_notes
from calib.robot.calibrated import Deflection
from calib.robot.library import load
from calib.simulation import camera_cell as camera
from calib.simulation.cell import Cell, SimulatedInstrument, measure
from calib.simulation.truth import position_errors
from calib.simulation.virtual_cells import rigid, virtual_cell
from calib.transforms import pose

FISHEYE = Lens("fisheye", np.array([900.0, 905.0, 1220.0, 1010.0, 0.05, -0.02, 0.01, 0.003]), (2448, 2048))
NONE = np.array([], dtype=int)


@cache
def study(mounting: str = IN_HAND, count: int = 40, seed: int = 0, encoder: float = 1e-5) -> tuple:
    """Return a rigid LWR4+ with a camera, and the corners of `count` images, lens and mounting not told."""
    instrument = SimulatedInstrument(encoder_sigma=encoder)
    cell = camera.camera_cell(rigid(virtual_cell("lwr4plus", instrument=instrument)), mounting, reach_of_arm=0.75)
    return cell, camera.photograph(cell, camera.views(cell, count, seed), 0.05, seed)


def started(cell, block, *others):
    block = complete_camera(cell.cell.nominal, block)
    start = install(cell.cell.nominal, [block, *others])
    return block, start, layout(start).rigid_index


def fitted(cell, block, *others, **more):
    block, start, candidates = started(cell, block, *others)
    return block, fit(start, [block, *others], candidates, **more)


@pytest.mark.parametrize("mounting", [IN_HAND, pytest.param(TO_HAND, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "lens", [camera.FIVE_MEGAPIXEL, pytest.param(FISHEYE, marks=pytest.mark.slow)], ids=["pinhole", "fisheye"]
)
def test_residual_slope_is_minus_jacobian(mounting, lens):
    """Arm, both placements, every value of the lens, scale and bending; some corners unseen; away from the truth."""
    arm = Cell(load("ur5"), replace(virtual_cell("ur5").truth, deflection=Deflection()))
    cell = camera.camera_cell(arm, mounting, lens=lens, shape=BoardShape(1.01, 0.1, -0.2, 0.3))
    block = camera.photograph(cell, camera.views(cell, 4, 1), 0.5, 0)
    pixel = block.pixel.copy()
    pixel[1, 5:20] = np.nan
    block = replace(block, pixel=pixel, mounting=mounting, lens=lens)
    away = replace(cell.cell.truth, chain=perturb(cell.cell.truth.chain, 3))
    ready = prepare(away, [block])[0]
    free = np.random.default_rng(0).permutation(len(layout(away).names))
    part = observe(away, ready, free)[0]
    dense = np.einsum("ncl,fln->fcn", part.local, part.jacobian[:, :, part.index])
    check(
        lambda x: observe(step(away, free, x), ready, NONE)[0].value / 1e3,
        -dense.transpose(1, 2, 0) / 1e3, np.zeros(len(free)), step=1e-6, tolerance=1e-6,
    )  # fmt: skip
    residual, matrix = part.whitened(part.sigma)
    whole = (dense / part.sigma).reshape(len(free), -1).T
    values = (part.value / part.sigma).ravel()
    assert len(residual) < len(values)  # the same least-squares problem in fewer rows
    assert np.abs(matrix.T @ matrix - whole.T @ whole).max() < 1e-12 * np.abs(whole.T @ whole).max()
    assert np.abs(matrix.T @ residual - whole.T @ values).max() < 1e-9 * np.abs(whole.T @ values).max()
    assert residual @ residual == pytest.approx(values @ values, rel=1e-12)


@pytest.mark.slow
def test_whitening_is_of_full_covariance():
    """Rᵀ R of the reduced rows equals Jᵀ (f² σ² I + G S Gᵀ)⁻¹ J over all corners of an image."""
    cell, block = study(count=6)
    block, start, candidates = started(cell, block)
    found = fit(start, [block], candidates[-20:])  # frames and lens
    piece = found.pieces[0]
    noise = piece.part.noise
    part = replace(observe(found.cell, found.blocks[0], found.free)[0], noise=noise)
    matrix = part.whitened(piece.sigma)[1]
    total = np.zeros((len(found.free),) * 2)
    for image in range(6):
        own = part.index == image
        local = part.local[own].reshape(-1, part.local.shape[2])
        slope = local @ part.jacobian[:, :, image].T
        shared = noise.shared[own].reshape(-1, 6)  # of the state that the last pass began at
        now = local[:, :6] @ part.carried[image] * noise.deviations
        assert np.abs(shared - now).max() < 0.05 * np.abs(now).max()
        sigma = piece.sigma.T[own].reshape(-1)
        total += slope.T @ np.linalg.solve(np.diag(sigma**2) + shared @ shared.T, slope)
    assert np.abs(matrix.T @ matrix - total).max() < 1e-8 * np.abs(total).max()


@pytest.mark.parametrize("mounting", [IN_HAND, pytest.param(TO_HAND, marks=pytest.mark.slow)])
def test_arm_lens_and_mounting_recovered(mounting):
    """The arm is recovered, with lens and mounting found."""
    cell, block = study(mounting)
    block, found = fitted(cell, block)
    assert block.mounting == mounting
    assert block.lens.values[:2] == pytest.approx(cell.lens.values[:2], rel=2e-3)
    before, placed, arm = position_errors(cell.cell, found.cell, found.cell.chain)
    assert before > 3.0 and arm < 0.03 and placed < 0.3  # a camera at 1.5 m knows its own place to 0.1 mm
    assert found.estimate.residual_std == pytest.approx(1.0, abs=0.05)
    lens = found.cell.optics.lenses[0]
    names = [f"{block.camera}.{name}" for name in ("fx", "fy", "cx", "cy")]
    sigma = dict(zip(found.estimate.names, found.estimate.sigma))
    off = (lens.values - cell.lens.values)[:4] / [sigma[name] for name in names]
    assert np.abs(off).max() < 4.0


@pytest.mark.slow
def test_a_lens_that_was_given_stays():
    cell, block = study()
    _, found = fitted(cell, replace(block, lens=cell.lens, known=True, free=()))
    assert np.array_equal(found.cell.optics.lenses[0].values, cell.lens.values)
    assert found.estimate.names[-1].endswith(".rz")


@pytest.mark.slow
def test_print_of_another_size_is_measured():
    """Board scale and bending are fitted where tracker points tell the scale; pixels and points in one fit."""
    plain, _ = study()
    shape = BoardShape(1.002, 0.05, 0.0, -0.04)
    cell = camera.camera_cell(plain.cell, IN_HAND, shape=shape, reach_of_arm=0.75)
    block = camera.photograph(cell, camera.views(cell, 40, 3), 0.05, 3)
    block = replace(block, lens=cell.lens, known=True, free=SHAPE)
    points = measure(virtual_cell_points(cell), camera.views(cell, 40, 4), 5)
    block, found = fitted(cell, block, points)
    values = dict(zip(found.estimate.names, zip(found.estimate.values, found.estimate.sigma)))
    for name, true in zip(SHAPE, shape.values):
        value, sigma = values[f"{block.target}.{name}"]
        assert abs(value - true) < 4.0 * sigma
        assert sigma < (2e-4 if name == "scale" else 5e-3)


def virtual_cell_points(cell) -> Cell:
    """Return the same arm with a tracker that sees a reflector."""
    truth = replace(
        cell.cell.truth, stations=pose(Rotation.from_euler("z", 1.0), [2.0, 1.0, 0.5])[None],
        station_names=("tracker",),
        tools=pose(None, [0.05, 0.0, 0.1])[None], tool_names=("reflector",),
    )  # fmt: skip
    return Cell(cell.cell.nominal, truth, SimulatedInstrument("tracker", 20e-6, None))


@pytest.mark.slow
def test_two_cameras_see_one_board():
    cell, one = study()
    two_cell = camera.camera_cell(cell.cell, TO_HAND, lens=FISHEYE, reach_of_arm=0.75)
    two = replace(
        camera.photograph(two_cell, camera.views(two_cell, 25, 7), 0.05, 7), station="other camera", model="fisheye"
    )
    two = complete_camera(cell.cell.nominal, replace(two, tool_names=("other board",)))
    _, found = fitted(cell, one, two)
    assert found.cell.optics.lens_names == ("camera", "other camera")
    own = replace(found.cell, stations=found.cell.stations[:1], tools=found.cell.tools[:1])
    assert position_errors(cell.cell, own, found.cell.chain)[2] < 0.03


@pytest.mark.slow
def test_worse_corners_are_said():
    """Corners that are detected worse than stated are said."""
    cell, block = study()
    _, found = fitted(cell, replace(block, sigma=0.1 * block.sigma))
    (one,) = [one for one in image_notes(found) if one.code == "corners-off"]
    assert one.values["times"] == pytest.approx(10.0, rel=0.1)


@pytest.mark.slow
def test_arm_noise_is_told_from_corners():
    """Encoders of 0.1 mrad before corners of 0.05 px: the fit finds both, and its sigmas are those of the arm."""
    cell, block = study(count=60, encoder=1e-4)
    _, found = fitted(cell, block)
    noise = found.pieces[0].part.noise
    assert noise.factor == pytest.approx(1.0, abs=0.1)
    assert noise.turn == pytest.approx(1e-4 * np.sqrt(7 / 3), rel=0.5)
    assert found.estimate.residual_std == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_bad_corners_and_images_are_named():
    """Bad corners and images are named and do little harm."""
    cell, block = study()
    block, start, candidates = started(cell, replace(block, lens=cell.lens))
    pixel = block.pixel.copy()
    pixel[3, 10] += [6.0, -4.0]
    pixel[17] += 40.0
    found = fit(start, [replace(block, pixel=pixel)], candidates, settings=Settings(loss="cauchy"))
    named = [row for _, row, label, *_ in found.outliers(8.0) if label == "position"]
    assert named[0] == 18
    weight = found.pieces[0].weight
    part = found.pieces[0].part
    assert weight[(part.index == 3) & (part.corner == 10)] < 0.05
    assert np.median(weight[part.index == 3]) > 0.5
    assert position_errors(cell.cell, found.cell, found.cell.chain)[1] < 0.08


@pytest.mark.slow
def test_gross_corners_and_images_left_out():
    """Without a robust loss, too: one corner that is another one's, images turned by a program, joints exchanged."""
    cell, block = study()
    pixel, q = block.pixel.copy(), block.q.copy()
    pixel[3, 10] += [6.0, -4.0]
    pixel[[5, 6]] = np.array(block.size) - 1.0 - pixel[[5, 6]]
    q[[20, 30]] = q[[30, 20]]
    said = complete_camera(cell.cell.nominal, replace(block, pixel=pixel)).notes
    assert "2 images are excluded" in said[0] and "turned by 180°" in said[0]
    assert said[0].endswith("(0006.png, 0007.png)")
    assert said[1].startswith("1 of ") and said[1].endswith("excluded: corner 10 of 0004.png")
    done, _, _ = started(cell, replace(block, pixel=pixel, q=q, lens=cell.lens))
    assert set(done.rows) == set(block.rows) - {6, 7, 21, 31}


@pytest.mark.slow
def test_half_contradicting_is_too_many():
    """Without images that contradict all others the fit is good, and half of them are too many."""
    cell, block = study()
    q = block.q.copy()
    q[[20, 30]] = q[[30, 20]]
    _, found = fitted(cell, replace(block, q=q, lens=cell.lens), settings=Settings(loss="none"))
    assert position_errors(cell.cell, found.cell, found.cell.chain)[1] < 0.05
    q = np.concatenate([block.q[:27], np.roll(block.q[27:], 3, axis=0)])
    with pytest.raises(MeasurementError, match=r"13 of 40 images show the board .* was camera or board moved"):
        complete_camera(cell.cell.nominal, replace(block, q=q, lens=cell.lens))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_noise_of_images_settles(seed):
    """Far boards of small images: what an image is off by shrinks slowly from fit to fit; planted are encoders only."""
    cell = camera.camera_cell(rigid(virtual_cell("lwr4plus")), TO_HAND, lens=camera.DEMO_LENS, reach_of_arm=0.75)
    block = camera.photograph(cell, camera.views(cell, 30, seed, camera.Views((0.25, 0.6))), 0.03, seed)
    _, found = fitted(cell, block)
    noise = found.pieces[0].part.noise
    assert noise.displacement < 5e-5 and noise.turn < 2e-4
    assert position_errors(cell.cell, found.cell, found.cell.chain)[2] < 0.08


@pytest.mark.slow
def test_rows_shifted_by_one_are_said_to_be():
    cell, block = study()
    block = replace(block, lens=cell.lens)
    shifted = replace(take(block, np.arange(1, 40)), q=block.q[:-1])
    with pytest.raises(MeasurementError, match=r"shifted by 1 row: .* further down"):
        complete_camera(cell.cell.nominal, shifted)
    mixed = replace(block, q=block.q[np.random.default_rng(0).permutation(40)])
    with pytest.raises(MeasurementError, match="images and joint values do not match"):
        complete_camera(cell.cell.nominal, mixed)


@pytest.mark.slow
def test_board_of_other_square_is_refused():
    """A board of another square is refused with its size."""
    cell, block = study()
    wrong = replace(block, board=replace(block.board, square=0.025, marker=0.0175))
    with pytest.raises(MeasurementError, match=r"square of the board is (29\.\d|30\.\d).* 25.00 in board.toml"):
        complete_camera(cell.cell.nominal, wrong)


@pytest.mark.slow
def test_one_direction_hides_focal_length():
    """Images from one direction do not tell the focal length."""
    cell, _ = study()
    q = camera.views(cell, 12, 0, camera.Views((0.35, 0.4), 0.01))
    with pytest.raises(MeasurementError, match=r"focal length is identified .* tilt it"):
        complete_camera(cell.cell.nominal, camera.photograph(cell, q, 0.05, 0))
    with pytest.raises(MeasurementError, match="1 image with a board, a lens needs at least 4"):
        complete_camera(cell.cell.nominal, take(study()[1], [0]))


@pytest.mark.slow
def test_distant_flat_board_has_one_pose():
    """Both poses that a distant plane may have are tried."""
    cell, _ = study(TO_HAND)
    q = camera.views(cell, 60, 5, camera.Views((0.6, 0.6), 0.5))
    block = camera.photograph(cell, q, 0.1, 5)
    found = board_poses(cell.lens, cell.board, block.pixel)
    true = camera.board_poses(cell, q)
    angle = Rotation.from_matrix(found.poses[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1)).magnitude()
    assert angle.max() < 0.02 and np.nanmax(found.rms) < 0.13
    assert np.abs(found.poses[:, :2, 3] - true[:, :2, 3]).max() < 1e-3


@pytest.mark.parametrize("method", ["Shah", "Li", "Park-Martin"])
def test_closed_forms_place_exact_poses(method, monkeypatch):
    """Every closed form places exact poses."""
    from calib.geometry.camera import robust_placement as robust
    from calib.geometry.first_guess import place_pose

    rng = np.random.default_rng(1)
    arm, station, tool = (pose(Rotation.random(n, rng=rng), rng.normal(size=(n, 3))) for n in (12, 1, 1))
    seen = station[0] @ arm @ tool[0]
    only = {"Shah": place_pose, "Li": robust.by_li, "Park-Martin": robust.by_park_martin}[method]
    one, two = only(arm, seen)
    assert one == pytest.approx(station[0], abs=1e-9) and two == pytest.approx(tool[0], abs=1e-9)
    assert place_robustly(arm, seen, 1.0).error < 1e-9


@pytest.mark.slow
def test_unseen_frames_use_the_fitted_lens():
    """Frames of unseen images are placed with the lens of the fit."""
    cell, block = study()
    block, found = fitted(cell, block)
    later = camera.photograph(cell, camera.views(cell, 15, 8), 0.05, 8)
    later = complete_camera(cell.cell.nominal, later, [block])
    assert later.lens is block.lens and not later.free
    again = placed_on(found.cell, replace(later, station="moved"), Settings()).cell
    assert np.array_equal(again.optics.lenses[0].values, found.cell.optics.lenses[0].values)
    assert see(again, later.q).point == pytest.approx(see(found.cell, later.q).point, abs=1e-4)
    assert isinstance(later, Pixels) and not isinstance(later, Positions)

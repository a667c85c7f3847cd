"""A base frame measured beside the target keeps a fit's accuracy where instrument and base move; its cost is stated."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.data.poses.fit_options import FileOptions
from calib.data.poses.measurements import Positions
from calib.data.poses.pose_files import read_measurements
from calib.errors import Finding
from calib.geometry.checks.base_motion import base_motion, spread_of
from calib.geometry.first_guess import install
from calib.geometry.fit import fit, polish_frames
from calib.geometry.installation import see
from calib.geometry.observability import observation, targets_of
from calib.geometry.weighing import Settings
from calib.procedure.findings import level_of, sentence
from calib.procedure.measuring.prediction import predicted
from calib.robot.chain import random_joints
from calib.simulation import lwr4plus
from calib.simulation.cell import Cell, SimulatedInstrument, measure, measure_frames, true_poses, write_measured
from calib.simulation.virtual_cells import lwr4plus_cell
from calib.transforms import invert, pose

ARM = lwr4plus.nominal_chain()
LEDS = pose(None, [0.25, 0.0, 0.1])


@cache
def study_poses(count: int, seed: int) -> np.ndarray:
    """Return poses under the constraints of Table 1 of Kolyubin et al. (2019)."""
    nominal, _ = lwr4plus.table_2()
    q = random_joints(ARM, 20 * count, seed)
    return q[lwr4plus.feasible(ARM, lwr4plus.station(nominal), lwr4plus.tool(nominal), q)][:count]


def cell_of(drift: float) -> Cell:
    """Return the study's rigid arm before its optical CMM, which drifts [m] over a series."""
    return lwr4plus_cell(SimulatedInstrument(base_frame=LEDS, drift=drift), hidden=0.0)


def measured(folder: Path, drift: float, seed: int, mode: str = "measured", count: int = 17) -> Positions:
    """Return a simulated series, written and read as a file."""
    series, bases = measure_frames(cell_of(drift), study_poses(count, seed), seed)
    path = write_measured(series, folder / "series.csv", bases=bases)
    (block,) = read_measurements(path, ARM.joint_names, FileOptions(base_frame=mode))
    assert isinstance(block, Positions)
    return block


def true_error(block: Positions) -> float:
    """Return the rms error of the calibrated arm at unseen poses [mm], wherever the instrument stands."""
    cell = cell_of(0.0)
    start = polish_frames(install(cell.nominal, [block]), [block]).cell
    found = fit(start, [block], settings=Settings(passes=1))
    unseen = study_poses(200, 99)
    points = see(found.cell, unseen).point.T
    truth = true_poses(cell, unseen)[:, :3, 3]
    points, truth = points - points.mean(axis=0), truth - truth.mean(axis=0)
    turn = Rotation.align_vectors(truth, points)[0]
    return float(1e3 * np.sqrt(np.mean(np.sum((turn.apply(points) - truth) ** 2, axis=1))))


@pytest.mark.slow
def test_base_frame_removes_the_drift(tmp_path):
    """With 1 mm of drift a fit by base frames is as accurate as without drift; one without them is not."""
    errors = {}
    for drift in (0.0, 1e-3):
        for mode in ("measured", "ignored"):
            errors[drift, mode] = [true_error(measured(tmp_path, drift, seed, mode)) for seed in range(6)]
    medians = {case: np.median(values) for case, values in errors.items()}
    np.testing.assert_allclose(errors[1e-3, "measured"], errors[0.0, "measured"], rtol=1e-3)
    assert medians[1e-3, "ignored"] > 2.5 * medians[0.0, "ignored"]
    assert medians[1e-3, "ignored"] > 1.2 * medians[1e-3, "measured"]
    assert medians[0.0, "ignored"] < medians[0.0, "measured"]  # the noise of a second frame, where nothing moves


def only(block: Positions) -> Finding:
    (found,) = base_motion([block])
    assert level_of(found) and sentence(found)
    return found


@pytest.mark.slow
def test_motion_is_stated_beside_its_noise(tmp_path):
    """Motion of 1 mm is found in all series; a still base is taken for one that moves in hardly any."""
    codes = [only(measured(tmp_path, 1e-3, seed)).code for seed in range(8)]
    assert set(codes) == {"base-frame-moved"}
    still = [only(measured(tmp_path, 0.0, seed)) for seed in range(8)]
    assert sum(found.code == "base-frame-moved" for found in still) <= 1
    moved = only(measured(tmp_path, 1e-3, 0, count=60))
    assert moved.values["rms"] == pytest.approx(1e-3 / np.sqrt(12.0), rel=0.15)
    assert moved.values["noise"] == pytest.approx(np.sqrt(3.0) * 60e-6, rel=0.15)
    assert moved.values["turn"] == pytest.approx(np.sqrt(3.0) * 0.2e-3, rel=0.2)
    # the noise that is stated to be added is that of the simulated LEDs
    block, alone = (measured(tmp_path, 0.0, 1, mode) for mode in ("measured", "ignored"))
    assert block.sigma is not None and alone.sigma is not None
    extra = np.sqrt(np.mean(np.sum(block.sigma**2 - alone.sigma**2, axis=1)))
    assert only(block).values["added"] == pytest.approx(extra, rel=0.01)


@pytest.mark.parametrize("rows", [5, 17, 100])
@pytest.mark.parametrize("stated", [1.0, np.nan])
def test_still_series_rarely_seem_to_move(rows, stated):
    rng = np.random.default_rng(rows)
    sigma = np.full((rows, 3), stated)
    noise = rng.normal(size=(600, rows, 3))
    assert np.mean([spread_of(series, sigma).exceeds for series in noise]) <= 0.01
    drift = 16.0 * np.linspace(0.0, 1.0, rows)[:, None] * np.array([1.0, 0.0, 0.0])
    assert np.mean([spread_of(series + drift, sigma).exceeds for series in noise[:100]]) >= 0.95


def test_jumps_are_judged_by_stated_sigma(tmp_path):
    """Where every row has its place of the instrument, successive rows tell nothing, but the stated σ does."""
    block = measured(tmp_path, 0.0, 2)
    assert block.base is not None and block.base_sigma is not None
    base = block.base.copy()
    base[:, :3] += np.random.default_rng(3).normal(0.0, 1e-3, (len(base), 3))
    jumping = replace(block, base=base)
    assert only(jumping).code == "base-frame-moved"
    assert only(replace(jumping, base_sigma=np.full((len(base), 6), np.nan))).code == "base-frame-still"


def test_empty_base_frames_are_named(tmp_path):
    """A constant base frame adds no noise and is named; so are metres under a header of millimetres."""
    block, alone = (measured(tmp_path, 0.0, 4, mode) for mode in ("measured", "ignored"))
    assert block.base is not None
    path = tmp_path / "series.csv"
    head, *lines = path.read_text().splitlines()
    rows = [line.split(",") for line in lines]
    for row in rows:
        row[-7:] = rows[0][-7:]
    path.write_text("\n".join([head, *(",".join(row) for row in rows)]))
    (constant,) = read_measurements(path, ARM.joint_names)
    assert isinstance(constant, Positions) and constant.sigma is not None and alone.sigma is not None
    assert only(constant).code == "base-frame-constant"
    np.testing.assert_allclose(constant.sigma, alone.sigma)

    base = block.base.copy()
    base[:, :3] *= 1e-3
    assert only(replace(block, base=base)).code == "base-frame-quiet"


def test_no_base_frame_no_finding(tmp_path):
    """Blocks without base frame are silent."""
    assert not base_motion([measured(tmp_path, 1e-3, 0, "ignored")])


@pytest.mark.slow
def test_predicted_sigma_counts_both_frames(tmp_path):
    """Errors from the base frame at unseen poses are as large as the pose plan predicts."""
    q = study_poses(40, 5)
    unseen = study_poses(200, 99)
    instrument = SimulatedInstrument()
    target = lwr4plus.tool(lwr4plus.table_2()[0])[:3, 3]
    sigmas = instrument.position_sigma, instrument.orientation_sigma or 0.0
    seen = observation(targets_of(ARM, [target.tolist()]), "pose", sigmas, reference=True)
    prediction = predicted(seen, seen(q), unseen)
    cell = lwr4plus_cell(SimulatedInstrument(base_frame=np.eye(4)), hidden=0.0)
    truth = (invert(cell.truth.stations[0]) @ true_poses(cell, unseen))[:, :3, 3]
    squares = []
    for seed in range(8):
        block = measure(cell, q, seed)
        start = polish_frames(install(cell.nominal, [block]), [block]).cell
        found = fit(start, [block], settings=Settings(passes=1))
        squares.append(np.mean(np.sum((see(found.cell, unseen).point.T - truth) ** 2, axis=1)))
    assert np.sqrt(np.mean(squares)) / prediction.rms == pytest.approx(1.0, abs=0.2)

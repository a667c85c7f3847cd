"""ISO 9283's numbers against their definitions, and repeated poses kept together."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib import cli
from calib.data.poses.measurements import Poses, Positions
from calib.geometry import repeatability
from calib.geometry.installation import Installation, see
from calib.geometry.repeatability import RepeatedPoses
from calib.procedure.kinematic_stage import inputs
from calib.procedure.kinematic_stage.metrics import FitMetrics
from calib.procedure.report.geometry_section import iso9283_tables
from calib.records import read_record
from calib.robot.library import load
from calib.simulation.cell import SimulatedInstrument, measure
from calib.simulation.virtual_cells import perturbed_cell
from calib.transforms import from_xyz_rpy

STATION = from_xyz_rpy([1.0, -2.0, 0.5], [0.2, -0.4, 1.0])


def repeated(poses: int = 4, cycles: int = 8, shift=(0.0, 0.0, 0.0), spread: float = 0.0, seed: int = 0):
    """Return an arm and poses measured `cycles` times each, in rounds, off by `shift` in the base and with noise."""
    rng = np.random.default_rng(seed)
    chain = load("ur5")
    cell = Installation(chain, STATION[None])
    q = np.tile(rng.uniform(-2, 2, (poses, 6)), (cycles, 1))
    seen = see(cell, q).poses()
    noise = rng.normal(0.0, 1.0, (len(q), 3)) * spread
    points = seen[:, :3, 3] + (np.asarray(shift) + noise) @ STATION[:3, :3].T
    turns = Rotation.from_matrix(seen[:, :3, :3])
    block = Poses(q + rng.uniform(-2e-5, 2e-5, q.shape), chain.joint_names, points, turns.as_quat(), file="a")
    return cell, block


def iso(cell: Installation, block: Positions) -> RepeatedPoses:
    found = repeatability.repeated_poses((cell, cell), [block])
    assert found is not None
    return found


def test_accuracy_is_barycentre_from_command():
    """Accuracy is the barycentre from the command in the base's axes."""
    cell, block = repeated(shift=(1e-3, -2e-3, 3e-3))
    found = iso(cell, block)
    assert found.cycles == (8, 8) and found.poses == 4
    for one in found.each:  # the joints read back are off by 20 µrad
        assert one.nominal_mm == one.calibrated_mm == pytest.approx([1.0, -2.0, 3.0], abs=0.1)
        assert np.abs(one.calibrated_deg).max() < np.degrees(1e-4)
    assert found.repeatability_mm["max"] < 1e-6


def test_repeatability_is_mean_and_3_sigma():
    """Repeatability is the mean radius and three deviations."""
    points = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 3.0, 0], [0, -3.0, 0]])  # radii 1 1 3 3
    assert repeatability.spread(points) == pytest.approx(2.0 + 3.0 * np.sqrt(4.0 / 3.0))
    found = iso(*repeated(poses=3, cycles=400, spread=1e-4, seed=1))
    # of normal noise the radius is Maxwell's: mean 1.596 σ, deviation 0.673 σ
    assert [one.repeatability_mm / 0.1 for one in found.each] == pytest.approx([1.596 + 3 * 0.673] * 3, rel=0.1)


def test_turns_count_about_axes_of_the_base():
    """Turns are counted about the base's axes."""
    cell, block = repeated(poses=1, cycles=400)
    rng, base = np.random.default_rng(2), Rotation.from_matrix(STATION[:3, :3])
    small = Rotation.from_rotvec(rng.normal(0.0, [1e-4, 2e-4, 3e-4], (400, 3)) + np.array([5e-4, 0.0, 0.0]))
    turned = base * small * base.inv() * Rotation.from_quat(block.quaternion)
    (one,) = iso(cell, Poses(block.q, block.joint_names, block.position, turned.as_quat())).each
    assert np.radians(one.nominal_deg) == pytest.approx([5e-4, 0.0, 0.0], abs=1e-4)
    assert np.radians(one.repeatability_deg) == pytest.approx([3e-4, 6e-4, 9e-4], rel=0.15)


def test_dependence_on_approach_is_stated():
    """A pose that is reached 0.1 mm short of where it comes from, alternately from two sides."""
    chain = load("ur5")
    cell = Installation(chain, STATION[None])
    pose = np.array([0.3, -1.2, 1.4, -0.9, -1.5, 0.2])
    aside = np.array([0.3, 0, 0, 0, 0, 0])
    sides = np.array([pose + aside, pose - aside])
    q = np.concatenate([[side, pose] for _ in range(6) for side in sides])
    q += np.random.default_rng(4).uniform(-1e-8, 1e-8, q.shape)  # no two rows have the very same numbers
    points = see(cell, q).point.T.copy()
    way = points[1::2] - points[0::2]
    points[1::2] -= 1e-4 * way / np.linalg.norm(way, axis=1, keepdims=True)
    found = iso(cell, Positions(q, chain.joint_names, points))
    chord = np.linalg.norm(way[0] / np.linalg.norm(way[0]) - way[1] / np.linalg.norm(way[1]))
    for one in found.each:
        wanted = None if len(one.rows) != 12 else pytest.approx(0.1 * chord, rel=1e-3)
        assert one.multidirectional_mm == wanted
    assert found.cycles == (6, 12)


def test_copies_are_no_repeats():
    """Copies and single poses are no repeats."""
    cell, block = repeated(poses=3, cycles=1)
    assert repeatability.repeated_poses((cell, cell), [block]) is None
    copy = [0] * 9 + [1, 2]
    block = Positions(block.q[copy], block.joint_names, block.position[copy])
    assert repeatability.repeated_rows(block) == []


def test_cycles_are_held_out_together():
    """Cycles of a pose are held out together."""
    _, block = repeated(poses=10, cycles=5, spread=1e-5)
    kept, aside = inputs.hold_out(block, 0.3, 1)
    assert aside is not None and (len(kept), len(aside)) == (35, 15)
    gap = np.abs(kept.q[:, None] - aside.q[None]).max(axis=2)
    assert gap.min() > 0.01


@pytest.fixture
def files(tmp_path, monkeypatch) -> Path:
    """Forty poses once, five of them thirty times, and a validation file at the fit's joints."""
    monkeypatch.chdir(tmp_path)
    cell = perturbed_cell(load("ur5"), 1, SimulatedInstrument(position_sigma=2e-5, orientation_sigma=5e-5))
    rng = np.random.default_rng(3)
    once, five = rng.uniform(-2, 2, (60, 6)), rng.uniform(-2, 2, (5, 6))
    for name, q, seed in (("fit", once, 1), ("iso", np.tile(five, (30, 1)), 2), ("again", once, 3)):
        seen = measure(cell, q, seed)
        head = [*(f"q{k + 1}" for k in range(6)), "x", "y", "z", "qx", "qy", "qz", "qw"]
        with (tmp_path / f"{name}.csv").open("w", newline="") as file:
            csv.writer(file).writerows([head, *np.hstack([seen.q, seen.position, seen.quaternion]).tolist()])
    return tmp_path


@pytest.mark.slow
def test_fit_states_iso_beside_its_errors(files, capsys):
    """The fit states the figures of ISO 9283 beside its own errors."""
    arguments = ["fit", "ur5", "fit.csv", "--validate", "iso.csv", "--model", "geometry", "--out", "done", "--no-plots"]
    assert cli.run([*arguments, "--stations", "one"]) == 0
    said = capsys.readouterr().out
    assert "ISO 9283 on 5 poses repeated 30 times" in said and "too few poses to state an accuracy" in said
    found = json.loads(Path("done/metrics.json").read_text())
    stated = found["validation"]["iso.csv"]["iso9283"]
    assert found["fit"]["iso9283"] is None
    noise = 0.02 * (1.596 + 3 * 0.673)
    assert stated["repeatability_mm"]["mean"] == pytest.approx(noise, rel=0.2)
    assert stated["accuracy_mm"]["calibrated"]["mean"] < 0.3 * stated["accuracy_mm"]["nominal"]["mean"]
    (table,) = iso9283_tables(read_record(FitMetrics, found))
    assert len(table.rows) == 5 and "100 or more" in table.note


@pytest.mark.slow
def test_validation_at_fit_joints_is_void(files, capsys):
    """A validation at the fit's joints proves nothing."""
    code = cli.run(
        ["fit", "ur5", "fit.csv", "--validate", "again.csv", "--model", "geometry", "--out", "done", "--no-plots"]
    )
    said = capsys.readouterr().out
    assert "at joint values of fitted rows, so they do not count as validation" in said
    assert "NOT unseen" in said and code == 0

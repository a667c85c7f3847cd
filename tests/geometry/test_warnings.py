"""Two-sided: every warning on measurements and poses is given where it is due, and not where it is not."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from planted import cell, load, measure, perturb, random_joints

from calib.column_changes import coupling
from calib.data.poses.measurements import PoseMeasurements, Positions, take
from calib.data.poses.pose_files import read_measurements
from calib.errors import Finding
from calib.geometry import diagnosis
from calib.geometry.diagnosis import diagnose, neighbour_floor
from calib.geometry.first_guess import install
from calib.geometry.fit import fit, polish_frames
from calib.geometry.installation import Installation, see
from calib.geometry.observability import PLACES, unidentified
from calib.procedure.findings import lines_of
from calib.procedure.kinematic_stage.verdict import plausibility
from calib.robot.calibrated import Deflection, Term
from calib.robot.chain import Chain
from calib.simulation.cell import measure as measured_by
from calib.simulation.virtual_cells import perturbed_cell

SIGMA = 5e-5


def truth_of(seed: int) -> Installation:
    return cell(perturb(load("ur5"), seed, 0.5e-3, 1e-3), seed)


def calibrate(measured: PoseMeasurements):
    start = polish_frames(install(load("ur5"), [measured]), [measured])
    return fit(start.cell, [measured])


def nearby(truth: Installation, centres: int, each: int, seed: int, sigma: float = SIGMA, wide: float = 0.05):
    """Measure clusters of neighbouring joints."""
    rng = np.random.default_rng(seed)
    q = np.repeat(random_joints(truth.chain, centres, rng), each, axis=0)
    q = q + wide * rng.normal(size=q.shape)
    point = see(truth, q).point.T
    position = point + sigma * rng.normal(size=point.shape)
    return Positions(q, truth.chain.joint_names, position=position, file="cluster.csv")


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3, 4))])
def test_noise_alone_gives_no_warning(seed):
    for measured in (
        measure(truth_of(seed), "position", 150, seed, sigma=SIGMA, stated=seed % 2 == 0),
        measure(truth_of(seed), "pose", 100, seed, sigma=SIGMA),
        nearby(truth_of(seed), 30, 6, seed),
    ):
        assert diagnose(calibrate(measured)) == []


def with_bad_rows(seed: int) -> PoseMeasurements:
    """Return 160 positions, the first 40 eight times as noisy."""
    measured = measure(truth_of(seed), "position", 160, seed, sigma=SIGMA, stated=False, file="day.csv")
    position = measured.position.copy()
    position[:40] += 8 * SIGMA * np.random.default_rng(seed).normal(size=(40, 3))
    return replace(measured, position=position)


def changes(found) -> list[Finding]:
    return [one for one in diagnose(found) if one.code == "set-up-changed"]


@pytest.mark.parametrize("seed", range(4))
def test_rows_of_another_set_up_are_named(seed):
    (found,) = changes(calibrate(with_bad_rows(seed)))
    assert (found.values["file"], found.values["first"]) == ("day.csv", 1)
    assert found.values["worse"] > found.values["rest"]
    assert abs(found.values["last"] - 40) <= 16  # a tenth of the rows


def scattered(seed: int) -> PoseMeasurements:
    return replace(take(with_bad_rows(seed), np.random.default_rng(seed).permutation(160)), rows=None)


def one_component(seed: int) -> PoseMeasurements:
    return measure(truth_of(0), "distance", 160, seed, sigma=SIGMA)


@pytest.mark.parametrize("measured", [scattered, pytest.param(one_component, marks=pytest.mark.slow)])
@pytest.mark.parametrize("seeds", [range(4), pytest.param(range(4, 16), marks=pytest.mark.slow)])
def test_scattered_bad_rows_are_no_set_up(measured, seeds):
    """Bad rows scattered over the day, and noise of one component, are no set-up."""
    assert not any(changes(calibrate(measured(seed))) for seed in seeds)


def test_shared_errors_are_systematic():
    """Errors that neighbours share are called systematic."""
    truth = truth_of(1)
    terms = (Term("theta2", "sin", 1, 3), Term("theta3", "cos", 2, 4))
    wavy = replace(truth, deflection=Deflection(terms, np.array([4e-4, 4e-4]), truth.chain))
    assert any(one.code == "systematic-residual" for one in diagnose(calibrate(nearby(wavy, 40, 6, 1))))


def test_poor_instrument_is_named():
    """An instrument worse than it states is named."""
    measured = measure(truth_of(2), "position", 120, 2, sigma=10 * SIGMA)
    optimistic = replace(measured, sigma=np.full((120, 3), SIGMA))
    (found,) = diagnose(calibrate(optimistic))
    assert found.code == "sigma-too-small" and found.values["times"] == pytest.approx(10, rel=0.1)
    assert diagnose(calibrate(measured)) == []
    (found,) = diagnose(calibrate(replace(measured, sigma=np.full((120, 3), 100 * SIGMA))))
    assert found.code == "sigma-too-large" and found.values["times"] == pytest.approx(10, rel=0.1)


def test_neighbours_differ_by_the_noise():
    found = calibrate(nearby(truth_of(3), 100, 4, 3))
    floor = neighbour_floor(found.blocks[0].measured.q, found.pieces[0].part)
    assert floor == pytest.approx(SIGMA * np.sqrt(3), rel=0.15)


def test_the_rank_is_told_with_its_gap():
    rank, *others = unidentified(calibrate(measure(truth_of(0), "pose", 60, 0, sigma=SIGMA)))
    assert (rank.code, rank.values["rank"], rank.values["parameters"]) == ("rank", 30, 38)
    assert rank.values["next"] < rank.values["tolerance"] < rank.values["last"]
    merged = [one.values for one in others if one.code == "merged"]
    assert {"alpha1", "d1", "r1", "theta1", "theta6"} <= {name for one in merged for name in one["names"]}
    assert all(any(place in one["into"] for one in merged) for place in PLACES.values())


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_confusion_of_tool_and_base_is_said(seed):
    """Positions in a small region with the wrist held still, against positions anywhere."""
    truth = truth_of(seed)
    centre = np.array([0.3, -1.2, 1.4, -0.5, 1.2, 0.4])
    rng = np.random.default_rng(seed)
    q = centre + np.array([0.3, 0.3, 0.3, 1e-4, 1e-4, 1e-4]) * rng.normal(size=(150, 6))
    q[:, 3] -= (q[:, 1:3] - centre[1:3]).sum(axis=1)
    point = see(truth, q).point.T
    still = Positions(q, truth.chain.joint_names, position=point + SIGMA * rng.normal(size=point.shape))
    loose = [one for one in unidentified(calibrate(still)) if one.code == "loose-tool"]
    assert loose and loose[0].values["station"]
    free = measure(truth, "position", 150, seed, sigma=SIGMA)
    assert not any(one.code == "loose-tool" for one in unidentified(calibrate(free)))


@pytest.mark.parametrize(
    ("turned", "most"),
    [((), 1), pytest.param((1,), 8, marks=pytest.mark.slow), pytest.param((2, 5), 10, marks=pytest.mark.slow)],
)
def test_unplaceable_reversal_not_searched(monkeypatch, turned, most):
    """Trying every joint fits placements 7, 12 and 16 times."""
    cell, placed = perturbed_cell(load("ur5"), seed=1), []
    block = measured_by(cell, random_joints(cell.nominal, 60, 0), 1)
    q = block.q.copy()
    q[:, list(turned)] *= -1.0
    block = replace(block, q=q)
    polish = diagnosis.polish_frames
    monkeypatch.setattr(diagnosis, "polish_frames", lambda *given: placed.append(given) or polish(*given))
    found = diagnosis.wrong_columns(install(cell.nominal, [block]), [block])
    assert (found.joints if found else ()) == turned
    assert len(placed) <= most


@pytest.mark.parametrize(
    ("joint", "end"),
    [(5, "--tip "), pytest.param(0, "--base ", marks=pytest.mark.slow), pytest.param(2, None, marks=pytest.mark.slow)],
)
def test_joint_without_effect_is_named(joint, end):
    """A gripper's column beside the arm's, a track that carries the instrument, too."""
    cell = perturbed_cell(load("ur5"), seed=2)
    q = random_joints(cell.nominal, 60, 0)
    still = q.copy()
    still[:, joint] = 0.3
    block = replace(measured_by(cell, still, 1), q=q)
    found = diagnosis.wrong_columns(install(cell.nominal, [block]), [block])
    assert found is not None and (found.code, found.joints) == ("joint-without-effect", (joint,))
    named = replace(cell.nominal, links=tuple(f"l{k}" for k in range(6)))
    cure = diagnosis.wrong_columns(install(named, [block]), [block])
    assert cure is not None and (cure.changes[0].values["end"] or "").startswith(end or "")
    assert (end is None) == (cure.changes[0].values["end"] is None)
    (said,) = lines_of([cure.finding(named.joint_names, rms=1e-3, before=0.1, times=100.0)])
    assert f"with {named.joint_names[joint]} held still" in said and (end or "Calibrate the arm without it") in said


REAL = {
    "ur5_gts3800": ("model.urdf", "grid_800.csv"),
    "ur10_ipa": ("model.urdf", "A_grid_2500.csv"),
    "motoman_leica": ("model_right.urdf", "right_wide_386.csv"),
}


@cache
def real_positions(folder: Path) -> tuple[Chain, PoseMeasurements]:
    """Return a robot and a hundred of its measured poses."""
    robot, file = (folder / name for name in REAL[folder.name])
    arm = load(robot)
    (block,) = read_measurements(file, arm.joint_names)
    return arm, take(block, np.arange(0, len(block), max(1, len(block) // 100)))


@pytest.mark.parametrize(
    "folder", [pytest.param(name, marks=[pytest.mark.slow] * (name != "ur5_gts3800")) for name in REAL]
)
@pytest.mark.parametrize("way", [0.0, 1.0])
def test_real_poses_are_sound(data, folder, way):
    """Real poses are sound unless a joint counts from the one before."""
    arm, block = real_positions(data / folder)
    changed = replace(block, q=block.q @ coupling(arm.n, 2, 1, -way).T)
    found = diagnosis.wrong_columns(install(arm, [changed]), [changed], mirrored=True)
    assert (found and (found.code, found.joints)) == (("joint-coupled", (2, 1)) if way else None)


@pytest.mark.slow
def test_joint_without_effect_reaches_the_user():
    """The explanation of a search is a finding of the fit, with the joint's name."""
    cell = perturbed_cell(load("ur5"), seed=2)
    q = random_joints(cell.nominal, 60, 0)
    still = q.copy()
    still[:, 0] = 0.3
    nominal = install(cell.nominal, [replace(measured_by(cell, still, 1), q=q)])
    explanation = diagnosis.wrong_columns(nominal, [replace(measured_by(cell, still, 1), q=q)])
    (remark,) = plausibility._explanation(explanation, nominal)
    assert remark.code == "joint-without-effect"

"""What changed while measuring is named with its rows and its size; a sound file is not remarked upon."""

from dataclasses import replace

import numpy as np
import pytest
from planted import cell, load, perturb, random_joints

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.errors import Finding
from calib.geometry.checks.row_changes import row_changes
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation, see
from calib.transforms import from_xyz_rpy, to_quaternion

NOISE = 2e-5
ROWS, CUT = 60, 35


def measured(truth: Installation, later: Installation, q: np.ndarray, seed: int, poses: bool = False) -> Positions:
    """Return positions, or poses, of which those behind row `CUT` are of another installation."""
    rng = np.random.default_rng(seed)
    seen = [see(each, q).poses() for each in (truth, later)]
    both = np.concatenate([seen[0][:CUT], seen[1][CUT:]])
    position = both[:, :3, 3] + NOISE * rng.standard_normal((len(q), 3))
    quaternion = to_quaternion(both) if poses else None
    return PoseMeasurements.of(q, position, quaternion, joint_names=truth.chain.joint_names, file="day.csv")


def truth_of(seed: int) -> Installation:
    return cell(perturb(load("ur5"), seed, 0.5e-3, 1e-3), seed)


def changes(block: Positions) -> list[Finding]:
    return row_changes(polish_frames(install(load("ur5"), [block]), [block]))


def moved_station(truth: Installation) -> Installation:
    return replace(truth, stations=np.array([from_xyz_rpy([3e-4, 2e-4, 0.0], [0, 0, 0]) @ truth.stations[0]]))


def slipped_target(truth: Installation) -> Installation:
    return replace(truth, tools=np.array([truth.tools[0] @ from_xyz_rpy([5e-4, 0.0, -3e-4], [0, 0, 0])]))


def slipped_encoder(truth: Installation) -> Installation:
    (name,) = (truth.chain.elements[int(k)].name for k in truth.chain.moving[2:3])
    values = dict(zip(truth.chain.names, truth.chain.values))
    return replace(truth, chain=truth.chain.with_values({name: values[name] + 1e-3}))


CHANGES = [
    (moved_station, "station-changed", np.hypot(3e-4, 2e-4)),
    (slipped_target, "target-changed", np.hypot(5e-4, 3e-4)),
    (slipped_encoder, "zero-changed", 1e-3),
]


@pytest.mark.parametrize("poses", [False, True])
@pytest.mark.parametrize(("change", "code", "size"), CHANGES)
def test_step_is_named_with_row_and_size(change, code, size, poses):
    """A step is named with its row and its size."""
    truth = truth_of(1)
    block = measured(truth, change(truth), random_joints(truth.chain, ROWS, 1), 1, poses)
    (found,) = changes(block)
    assert (found.code, found.values["last"], found.values["next"]) == (code, CUT, CUT + 1)
    assert abs(found.values["size"]) == pytest.approx(size, abs=4 * found.values["sigma"])
    assert found.values["after"] < 3 * NOISE < found.values["before"]


@pytest.mark.parametrize(("code", "growth"), [("station-drifts", False), ("scale-drifts", True)])
def test_a_drift_is_told_from_a_step(code, growth):
    truth = truth_of(2)
    block = measured(truth, truth, random_joints(truth.chain, ROWS, 2), 2)
    time = np.linspace(0.0, 1.0, ROWS)[:, None]
    position = block.position * (1.0 + 3e-4 * time) if growth else block.position + time * [5e-4, 2e-4, 3e-4]
    (found,) = changes(replace(block, position=position))
    size = 3e-4 if growth else np.linalg.norm([5e-4, 2e-4, 3e-4])
    assert (found.code, "last" in found.values) == (code, False)
    assert abs(found.values["size"]) == pytest.approx(size, abs=4 * found.values["sigma"])


def test_changing_scale_is_named():
    """A scale that changes between rows is named."""
    truth = truth_of(2)
    block = measured(truth, truth, random_joints(truth.chain, ROWS, 2), 2)
    later = (np.arange(ROWS) >= CUT)[:, None]
    (found,) = changes(replace(block, position=block.position * (1.0 + 5e-4 * later)))
    assert (found.code, found.values["last"]) == ("scale-changed", CUT)
    assert abs(found.values["size"]) == pytest.approx(5e-4, abs=4 * found.values["sigma"])


@pytest.mark.parametrize("code", ["target-wanders", "zero-drifts"])
def test_a_drift_of_target_or_zero_is_named(code):
    truth = truth_of(2)
    q = random_joints(truth.chain, ROWS, 2)
    time = np.linspace(0.0, 1.0, ROWS)
    if code == "zero-drifts":
        driven = q.copy()
        driven[:, 2] += 1.5e-3 * time
        position = see(truth, driven).poses()[:, :3, 3]
    else:
        poses = see(truth, q).poses()
        position = poses[:, :3, 3] + np.einsum("nij,n,j->ni", poses[:, :3, :3], time, [8e-4, 0.0, -5e-4])
    position = position + NOISE * np.random.default_rng(2).standard_normal(position.shape)
    block = PoseMeasurements.of(q, position, None, joint_names=truth.chain.joint_names, file="day.csv")
    (found,) = changes(block)
    assert found.code == code


@pytest.mark.parametrize("seeds", [range(5), pytest.param(range(5, 40), marks=pytest.mark.slow)])
def test_a_sound_file_changed_nowhere(seeds):
    for seed in seeds:
        truth = truth_of(seed)
        assert changes(measured(truth, truth, random_joints(truth.chain, ROWS, seed), seed, seed % 2 == 0)) == []


def test_effect_in_sorted_rows_is_no_change():
    """Rows in the order of joint 1, at whose middle something in the arm gives way: a model lacks that, no time."""
    truth = truth_of(3)
    q = random_joints(truth.chain, ROWS, 3)
    for order, codes in ((np.argsort(q[:, 0]), []), (np.arange(ROWS), ["station-changed"])):
        block = measured(truth, truth, q[order], 3)
        later = (np.arange(ROWS) >= CUT)[:, None]
        assert [one.code for one in changes(replace(block, position=block.position + later * [0, 0, 4e-4]))] == codes


def test_gross_rows_hide_no_change():
    """Grossly wrong rows hide no change and are none."""
    truth = truth_of(4)
    q = random_joints(truth.chain, ROWS, 4)
    for later, codes in ((truth, []), (moved_station(truth), ["station-changed"])):
        block = measured(truth, later, q, 4)
        position = block.position.copy()
        position[[5, 50]] += [0.0, 0.02, 0.0]
        assert [one.code for one in changes(replace(block, position=position))] == codes

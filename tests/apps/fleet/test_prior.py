"""The distribution of parameters over arms of one type, the prior it gives, and tools that several arms share."""

from dataclasses import replace

import numpy as np
import pytest

import calib
from calib.apps.fleet import arm_distribution
from calib.apps.fleet.tools import tools
from calib.data.poses.fit_options import read_options
from calib.data.poses.measurements import Positions
from calib.errors import CalibError, UsageError
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import random_joints
from calib.robot.kinematics import forward

NOMINAL = calib.load("ur5").chain
LENGTHS = np.array([unit == "m" for unit in NOMINAL.units])
BETWEEN = np.where(LENGTHS, 5e-4, 2e-3)  # standard deviation of arms about their mean
MEAN = np.where(LENGTHS, 1e-3, -3e-3)


def arms(count: int, seed: int, uncertainty: float = 0.3) -> tuple[np.ndarray, list[CalibratedChain]]:
    """Return true values (count, p) of arms, and their calibrations, uncertain by a share of what arms differ by."""
    random = np.random.default_rng(seed)
    true = NOMINAL.values + MEAN + BETWEEN * random.standard_normal((count, len(MEAN)))
    mixed = uncertainty * BETWEEN[:, None] * random.standard_normal((len(MEAN), len(MEAN))) / np.sqrt(len(MEAN))
    covariance = mixed @ mixed.T + np.diag((0.1 * BETWEEN) ** 2)
    found = random.multivariate_normal(np.zeros(len(MEAN)), covariance, count) + true
    return true, [CalibratedChain(NOMINAL.with_values(one), NOMINAL, covariance) for one in found]


def test_mean_and_deviation_are_recovered() -> None:
    """Without what the fits themselves are uncertain by; the nominal, far off, counts as one of 101."""
    found = arm_distribution.spread(arms(100, 1, uncertainty=1.0)[1])
    assert [one.name for one in found] == list(NOMINAL.names) and {one.arms for one in found} == {100}
    mean, sigma = np.array([[one.mean, one.sigma] for one in found]).T
    assert np.abs((mean - MEAN) / BETWEEN).max() < 0.4
    assert np.abs(sigma / BETWEEN - 1.0).max() < 0.3


@pytest.mark.parametrize("count", [2, 4, 8])
def test_next_arm_is_where_expected(count: int) -> None:
    """χ² per parameter over 20 fleets: near 1, whatever the number of arms."""
    total = []
    for seed in range(20):
        true, robots = arms(count + 1, seed)
        found = arm_distribution.spread(robots[:-1])
        mean, width = np.array([[one.mean, one.width] for one in found]).T
        total.append(np.mean(((true[-1] - NOMINAL.values - mean) / width) ** 2))
    assert 0.7 < np.mean(total) < 1.4, np.mean(total)


def test_rare_parameter_has_family_deviation() -> None:
    """A parameter that few arms fitted takes its family's deviation."""
    _, robots = arms(6, 3)
    assert robots[0].covariance is not None
    fewer = robots[0].covariance.copy()
    fewer[0], fewer[:, 0] = 0.0, 0.0
    found = arm_distribution.spread([robots[0], *(replace(one, covariance=fewer) for one in robots[1:])])
    assert (found[0].arms, found[1].arms) == (1, 6)
    with pytest.raises(UsageError, match="no fit of these arms states the covariance"):
        arm_distribution.spread([replace(one, covariance=None) for one in robots])


@pytest.mark.slow
def test_ten_poses_are_enough_with_a_prior(tmp_path) -> None:
    """Without, they are refused. The prior is read from its folder, as the command does."""
    true, robots = arms(9, 5)
    arm_distribution.write(tmp_path, robots[:-1], arm_distribution.spread(robots[:-1]))
    arm = NOMINAL.with_values(true[-1])

    def measured(count: int, seed: int) -> Positions:
        q = random_joints(NOMINAL, count, seed)
        noise = 5e-5 * np.random.default_rng(seed).standard_normal((count, 3))
        position = (forward(arm, q) @ [0.05, 0.02, 0.1, 1.0])[:, :3] + noise
        return Positions(q, NOMINAL.joint_names, position, file="a.csv")

    few, unseen, settings = measured(10, 1), measured(100, 2), calib.FitSettings(model="geometry")
    with pytest.raises(CalibError, match="10 poses are too few"):
        calib.fit_geometry("ur5", few, settings, validate=unseen)
    found = calib.fit_geometry(
        tmp_path, few, settings, validate=unseen, options=read_options(tmp_path / arm_distribution.OPTIONS)
    ).validation["a.csv"]
    expected, calibrated = (1e3 * one.position.mean() for one in found.errors)
    assert calibrated < 0.2 * expected, (calibrated, expected)


def test_a_bent_and_a_loose_tool_are_named() -> None:
    random, used = np.random.default_rng(2), {}
    for k in range(24):
        tool, place = f"T{k % 6}", np.array([0.0, 0.0, 0.1]) + 1e-4 * random.standard_normal(3)
        error = 2e-4 * np.exp(0.2 * random.standard_normal())
        used[f"arm{k}"] = tool, place + (tool == "T2") * np.array([2e-3, 0.0, 0.0]), error * (1 + 2 * (tool == "T4"))
    found = {one.tool: one for one in tools(used)}
    named = {name: one.findings()[0].values for name, one in found.items() if one.findings()}
    assert set(named) == {"T2", "T4"}
    assert named["T2"]["times"] is None and named["T2"]["moved"] == pytest.approx(2e-3, rel=0.2)
    assert named["T4"]["moved"] is None and 2.0 < named["T4"]["times"] < 4.5
    assert not [one for one in tools({name: row for name, row in used.items() if row[0] == "T2"}) if one.findings()]


@pytest.mark.slow
def test_few_agreeing_arms_accuse_no_tool() -> None:
    """Of three arms with each of two equal tools, 2.6 σ are exceeded as seldom as said, in distance and in error.

    The tool's position scatters along one axis, as it does where that is also the last link's.
    """
    random, sigmas = np.random.default_rng(3), []
    for _ in range(500):
        rows = [
            ([3e-5, 3e-5, 1e-3] * random.standard_normal(3), np.exp(0.2 * random.standard_normal())) for _ in range(6)
        ]
        found = tools({f"arm{k}": (f"T{k % 2}", *row) for k, row in enumerate(rows)})
        sigmas += [(one.moved_sigmas, one.times_sigmas) for one in found]
    beyond = (np.abs(np.array(sigmas, dtype=float)) > 2.6).mean(axis=0)
    assert (beyond < 0.02).all(), beyond


def test_three_arms_show_a_tool_far_off() -> None:
    """Heights [mm] of six simulated arms' tools, one 4 mm longer; with the names exchanged, none is accused."""
    heights = {"A": (99.426, 100.962, 100.204), "B": (104.099, 104.56, 103.478)}
    used = {f"{tool}{z}": (tool, np.array([0.05, 0.02, 1e-3 * z]), 5e-5) for tool, own in heights.items() for z in own}
    assert all(one.findings() for one in tools(used))
    mixed = {arm: (("A" if number < 4 else "B"), *row[1:]) for number, (arm, row) in enumerate(used.items())}
    exchanged = {arm: (f"T{number % 2}", *row[1:]) for number, (arm, row) in enumerate(used.items())}
    assert not [one for each in (mixed, exchanged) for one in tools(each) if one.findings()]

"""Speed of pose selection: run with `pytest tests/benchmarks/test_selection.py --benchmark-only -s`."""

import library_arm
import pytest

from calib.poses.convex import bound
from calib.poses.select import SearchSettings, select_poses

CASES = {
    "17 of 2000, pose": (2000, 17, library_arm.jacobian),
    "30 of 2000, position only": (2000, 30, library_arm.point_jacobian),
    "100 of 20000, pose": (20000, 100, library_arm.jacobian),
}


@pytest.mark.parametrize("case", CASES)
def test_select(benchmark, case):
    count, m, function = CASES[case]
    jacobians = function(library_arm.random_poses(count, 0))
    chosen = benchmark.pedantic(select_poses, (jacobians, m), rounds=3 if count < 5000 else 1, warmup_rounds=1)
    random = chosen.efficiency * (chosen.random_baseline / chosen.value) ** 2
    figures = {"efficiency": chosen.efficiency, "random": random, "bound_gap": chosen.bound.gap}
    benchmark.extra_info.update(figures)
    print(f"\n{case}: efficiency {chosen.efficiency:.4f}, best of 1000 random sets {random:.4f} of the bound")


@pytest.mark.parametrize("case", CASES)
def test_bound(benchmark, case):
    count, m, function = CASES[case]
    jacobians = function(library_arm.random_poses(count, 0))
    result = benchmark.pedantic(bound, (jacobians, m), rounds=3 if count < 5000 else 1, warmup_rounds=1)
    benchmark.extra_info["gap"] = result.gap


@pytest.mark.parametrize("index", ["O3", "O4", "cond"])
def test_select_by_index(benchmark, index):
    """Restarts included: their effort is a number of trial sets."""
    jacobians = library_arm.jacobian(library_arm.random_poses(2000, 0))
    chosen = benchmark.pedantic(select_poses, (jacobians, 17, SearchSettings(index=index)), rounds=1)
    benchmark.extra_info.update({"value": chosen.value, "random": chosen.random_baseline})

"""Claims on swaps of members and candidates."""

from itertools import product

import library_arm
import numpy as np
import pytest

from calib.poses.design import Pool, design_of
from calib.poses.scaled_jacobians import prepared
from calib.poses.swaps import first_swap


@pytest.mark.parametrize("function", [library_arm.jacobian, library_arm.point_jacobian])
def test_many_members_at_once_as_one_by_one(function):
    """The first swap that gains is the same for many members at once as by comparing every swap."""
    candidates = prepared(function(library_arm.random_poses(120, 0)), 30)
    pool = Pool(candidates.z, candidates.known)
    members = tuple(range(30))
    design = design_of(pool, members)
    gains = np.full((30, 120), -np.inf)
    for member, candidate in product(members, range(30, 120)):
        swapped = [candidate if k == member else k for k in members]
        rows = pool.z[swapped].reshape(-1, pool.z.shape[2])
        gains[member, candidate] = np.linalg.slogdet(rows.T @ rows)[1] - design.logdet
    least = np.sort(gains.max(axis=1))[20]
    leaving = int(np.argmax(gains.max(axis=1) > least))
    for start in (0, leaving):
        swap = first_swap(pool, design, members[start : leaving + 4], least)
        assert swap is not None and swap.leaving == leaving
        assert swap.design.members[-1] == gains[leaving].argmax()
        assert swap.design.logdet - design.logdet == pytest.approx(gains[leaving].max(), abs=1e-4)
    assert first_swap(pool, design, members, gains.max() + 1e-3) is None
    assert first_swap(pool, design, members[leaving : leaving + 1], least) is not None


@pytest.mark.parametrize("seed", range(20))
def test_the_swap_of_a_nearly_indispensable_member_is_not_lost_to_rounding(seed):
    """The only swap that gains more than the limit, by 1e-5, replaces the one member in a weak direction."""
    p, weak = 24, 1e-3
    random = np.random.default_rng(seed)
    z = random.normal(size=(140, 1, p)) * 30.0 / np.sqrt(p)  # much larger than what is known in the weak direction
    z[:, 0, 0] = 0.0
    z[[0, 139], 0, 0] = weak * np.array([1.0, 1.5])
    rotation = np.linalg.qr(random.normal(size=(p, p)))[0]
    known = 1e4 * np.eye(p)
    known[0, 0] = 0.0
    pool = Pool(z @ rotation, rotation.T @ known @ rotation)
    design = design_of(pool, tuple(range(100)))
    swap = first_swap(pool, design, [0], 0.0)
    assert swap is not None
    gain = swap.design.logdet - design.logdet
    among = first_swap(pool, design, [0, 1], gain - 1e-5)
    assert among is not None and among.leaving == 0
    assert among.design.members[-1] == swap.design.members[-1]

"""Arms out of a generator, with planted errors: whatever parameters merge, the fit places the tip within the noise."""

import re
import zlib
from pathlib import Path

import numpy as np
import plain_map
import pytest
from arm_generator import arms
from differences import check
from hypothesis import Phase, given, settings
from plain_map import Chain, Problem, Targets
from planted_arms import Arm, target_link
from population import Conditions, calibrate_safely, rms_mm

LIMIT = 2.0  # error over the noise; sqrt(p / m) = 0.8 is what 40 parameters of 60 points have, without any bias
CONDITIONS = Conditions()


def measured(text: str, count: int, seed: int) -> tuple[Arm, np.ndarray, Targets, Arm]:
    """Return a nominal arm, joint values, noisy points of its target in its base frame, and the true arm."""
    rng = np.random.default_rng(seed)
    moving = len(re.findall(r'<joint name="joint_\d"', text))
    nominal = Arm(text, "world", target_link(text, "world", f"link_{moving}"))
    truth = nominal.with_errors(rng)
    q = nominal.postures(count, rng)
    points = truth.positions(q, np.array([0.05, -0.03, 0.1]))
    return nominal, q, Targets((points + rng.normal(0.0, CONDITIONS.noise, points.shape))[:, None]), truth


@pytest.mark.slow
@given(text=arms())
@settings(max_examples=10)
def test_plain_reference_recovers_arms(text: str):
    """So that a fit which does not has no excuse."""
    nominal, q, targets, truth = measured(text, CONDITIONS.poses, zlib.crc32(text.encode()))
    cell = plain_map.fit(plain_map.placed(Chain.of(nominal), q, targets), q, targets)
    unseen = nominal.postures(200, np.random.default_rng(1))
    error = cell.positions(unseen)[:, 0] - truth.positions(unseen, np.array([0.05, -0.03, 0.1]))
    assert rms_mm(error) <= 1e3 * LIMIT * CONDITIONS.noise


@pytest.mark.slow
@given(text=arms())
@settings(max_examples=5)
def test_the_plain_references_jacobian(text: str):
    nominal, q, targets, _ = measured(text, 4, 0)
    chain = Chain.of(nominal)
    cell = plain_map.placed(chain, q, targets)
    free = np.arange(len(cell.twists))
    problem = Problem(cell, chain.motions(q), targets, free, np.ones((len(free), 6)))
    start = np.random.default_rng(0).normal(0.0, 0.05, cell.twists.size)
    check(problem.residuals, problem.jacobian, start)


@pytest.mark.slow
@given(text=arms())
@settings(max_examples=12, phases=[Phase.generate])  # seconds each: shrinking would take hours
def test_default_fit_recovers_arms(tmp_path_factory: pytest.TempPathFactory, text: str):
    """The exported URDF is held against the truth by Pinocchio, and the tool in tool0 where the arm has one."""
    source = Path(tmp_path_factory.mktemp("generated")) / f"arm{zlib.crc32(text.encode())}.urdf"
    source.write_text(text)
    row = calibrate_safely(source, CONDITIONS)
    assert row.group != "error", row.remark
    assert row.exported_mm <= 1e3 * LIMIT * CONDITIONS.noise, row
    assert row.in_tool0_mm <= 1e3 * LIMIT * CONDITIONS.noise, row

"""Geometry of parallel robots from their closure: planted changes come back, and what cannot be told is said."""

import numpy as np
import pytest

from calib.errors import Unidentifiable
from calib.parallel.mechanism.closure import closed, coordinates_of
from calib.parallel.mechanism.geometric_fit import changed, fit_loops, loop_parameters, platform_errors
from calib.parallel.robots import find

NOISE = 1e-5  # of the encoders [rad or m]


def planted(name: str, seed: int = 0, rows: int = 60):
    """Return nominal and true robot, and readings and platform coordinates of the true one."""
    nominal, rng = find(name).mechanism, np.random.default_rng(seed)
    parameters = loop_parameters(nominal)
    true = closed(changed(nominal.robot, parameters, 1e-3 * rng.normal(size=len(parameters))))
    x = 0.9 * rng.uniform(nominal.robot.lower, nominal.robot.upper, (rows, nominal.robot.r))
    q = true.place(x).q[:, nominal.robot.actuated]
    return nominal, true, q + NOISE * rng.normal(size=q.shape), x


@pytest.mark.parametrize(
    "name", [pytest.param("dualv", marks=pytest.mark.slow), "fivebar", pytest.param("stewart", marks=pytest.mark.slow)]
)
def test_platform_poses_tell_the_geometry(name):
    """Residuals at the encoders' noise, and unseen poses a hundred times nearer than with the nominal geometry."""
    nominal, _, q, x = planted(name)
    found = fit_loops(nominal, q[:40], x[:40])
    assert found.after < 1.2 * NOISE < 0.01 * found.before
    before, after = (np.abs(platform_errors(one, q[40:], x[40:])).max() for one in (nominal, found.mechanism))
    assert after < 0.02 * before


@pytest.mark.slow
def test_redundant_encoders_mend_geometry():
    """Without any pose: the encoders of the DualV agree to their noise, and its angle is better by several times."""
    nominal, _, q, x = planted("dualv")
    found = fit_loops(nominal, q)
    assert found.after < 1.5 * NOISE < 0.01 * found.before
    assert len(found.vague) > 20  # scale, place and more stay the nominal ones
    angle = [np.std((x - coordinates_of(one, one.locate(q)))[:, 2]) for one in (nominal, found.mechanism)]
    assert angle[1] < 0.4 * angle[0]


def test_readings_alone_need_redundancy():
    """Readings alone tell nothing without redundancy."""
    nominal, _, q, _ = planted("stewart", rows=8)
    with pytest.raises(Unidentifiable, match="as many encoders as freedoms"):
        fit_loops(nominal, q)


def test_loop_opening_parameters_left_out():
    """No axis of a planar robot tilts: its loops would not close; of a spatial one all may."""
    names = [one.name for one in loop_parameters(find("dualv").mechanism)]
    assert "leg1.d2" in names and not any("alpha" in name or ".base.rx" in name or ".r2" in name for name in names)
    assert any("alpha" in one.name for one in loop_parameters(find("stewart").mechanism))

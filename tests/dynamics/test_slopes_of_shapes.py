"""Every row of the table of drive torques: its slopes are those of its values, or it says that it has none."""

import numpy as np
import pytest

from calib.dynamics import drives
from calib.dynamics.bodies import bodies_of
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.shapes import SHAPES, TermMotion
from calib.errors import CalibError
from calib.robot.library import load

STEP = 1e-6
# settings by name, smooth and rough; a shape with a new setting needs a value here
SMOOTH = {"v0": 0.3, "edge": 1.2, "rest": 0.2, "vs": 0.5, "exponent": 1.5, "order": 3.0, "speed": 0.7, "width": 0.1}
ROUGH = {
    "v0": 0.0,
    "edge": np.inf,
    "rest": 0.05,
    "vs": 0.8,
    "exponent": 2.0,
    "order": 1.0,
    "speed": np.inf,
    "width": 1.0,
}
BAND = {"left": 0.0, "middle": 1.0, "right": 2.0, "way": 1.0, "lower": -1.0, "upper": 1.0}
# constant between jumps, so that -7 times their slope is right, too
FLAT = ("one", "dead")
# [rad] and [rad/s], off zero and off the edges of the settings by far more than STEP
GRID = np.linspace(-2.0, 2.0, 41) + 0.0123


# place, value and slope of knots; the ends are off the grid
KNOTS = {
    "smooth": (-3.0, 0.5, 1.0, -0.5, -1.0, 2.0, 0.7, 1.5, -1.0, 3.0, 0.0, 0.5),
    "rough": (-0.8, 0.0, 9.0, 0.9, 1.0, 0.0),
}


def term_of(shape, settings):
    if SHAPES[shape].tabulated:
        return drives.term("term", shape, 0, *KNOTS["smooth" if settings is SMOOTH else "rough"])
    numbers = {**BAND, **settings}
    return drives.term("term", shape, 0, *(numbers[name] for name in SHAPES[shape].settings))


def motion(dx=0.0, dv=0.0, da=0.0):
    x, v = (axis.ravel() for axis in np.meshgrid(GRID, GRID))
    return TermMotion(x + dx, v + dv, 0.5 * x - v + da)


def slope_errors(term):
    """Return by how much the slopes by x, v and a differ at most from central differences, over their own size."""
    errors = []
    for axis, slope in zip(("dx", "dv", "da"), term.slopes(motion())):
        ahead = term.values(motion(**{axis: STEP}))
        behind = term.values(motion(**{axis: -STEP}))
        differences = (ahead - behind) / (2.0 * STEP)
        errors.append(np.max(np.abs(slope - differences)) / max(1.0, np.max(np.abs(differences))))
    return errors


@pytest.mark.parametrize("settings", (SMOOTH, ROUGH), ids=("smooth", "rough"))
@pytest.mark.parametrize("shape", [name for name, shape in SHAPES.items() if shape.slopes])
def test_slopes_are_those_of_the_values(shape, settings):
    assert max(slope_errors(term_of(shape, settings))) < 1e-7


@pytest.mark.parametrize("shape", [name for name, shape in SHAPES.items() if shape.slopes and name not in FLAT])
def test_a_planted_slope_is_noticed(shape, monkeypatch):
    """A slope -7 times the right one."""
    right = drives.DriveTerm.slopes
    monkeypatch.setattr(
        drives.DriveTerm, "slopes", lambda term, seen: tuple(-7.0 * np.array(s) for s in right(term, seen))
    )
    assert max(slope_errors(term_of(shape, SMOOTH))) > 1.0


@pytest.mark.parametrize("shape", [name for name, shape in SHAPES.items() if not shape.slopes])
def test_shapes_without_slopes_say_so(shape):
    model = IdentificationModel(bodies_of(load("tx40")), (term_of(shape, SMOOTH),))
    q = np.ones((1, 6))
    with pytest.raises(CalibError, match="no derivatives"):
        model.regressor_gradient(q, q, q, np.zeros((1, 6, model.p)))

"""Claims on pose search for real arms of 4, 6 and 7 joints, with and without constraints."""

from functools import cache
from pathlib import Path

import numpy as np
import planar
import pytest
from arms import motley
from differences import check

from calib.geometry.observability import observation, targets_of
from calib.poses.candidates import draw_candidates
from calib.poses.continuous.local import improved, merit_of
from calib.poses.space import PoseConstraint, SearchSpace, is_feasible
from calib.procedure.measuring.pose_limits import read_limits
from calib.robot.chain import Chain
from calib.robot.library import load

CONSTRAINTS = """
[target]
height = [0.1, 1.0]
axis_distance = 0.3
[instrument]
xyz = [2.5, 0.0, 0.8]
rpy = [0, 0, "180 deg"]
sight = "80 deg"
[collision]
radius = 0.04
floor = -0.1
"""


def scara() -> Chain:
    """Return the library UR5's first four joints: shoulder, elbow, and one turn of the wrist."""
    arm = load("ur5")
    elements = tuple(element for element in arm.elements if element.owner < 4)
    return Chain("four joints", arm.joints[:4], elements)


ARMS = {"4 joints": scara, "6 joints": lambda: load("ur5"), "7 joints": lambda: load("lwr4plus")}


@cache
def space_of(name: str, file: Path | None) -> SearchSpace:
    cell = targets_of(ARMS[name](), [(0.05, 0.02, 0.1)])
    return read_limits(file, cell).space(observation(cell, "position"))


@pytest.fixture(params=["free", "constrained"])
def file(request, tmp_path_factory) -> Path | None:
    path = tmp_path_factory.getbasetemp() / "constraints.toml"
    path.write_text(CONSTRAINTS)
    return path if request.param == "constrained" else None


def starts(space: SearchSpace, count: int, seed: int = 0) -> np.ndarray:
    return draw_candidates(space.lower, space.upper, count, lambda q: is_feasible(space, q), seed=seed)


@pytest.mark.parametrize(
    ("name", "index"),
    [
        pytest.param("4 joints", "cond", marks=pytest.mark.slow),
        pytest.param("6 joints", "O1", marks=pytest.mark.slow),
        pytest.param("4 joints", "O1", marks=pytest.mark.slow),
        pytest.param("6 joints", "cond", marks=pytest.mark.slow),
        pytest.param("7 joints", "O1", marks=pytest.mark.slow),
        pytest.param("7 joints", "cond", marks=pytest.mark.slow),
    ],
)
def test_far_local_search_stays_feasible(name, index, file):
    """The local search moves far and stays feasible."""
    space = space_of(name, file)
    q = starts(space, 12)
    run = improved(space, q, index, evaluations=40)
    assert run.merit > merit_of(space, q, index)[0] + (0.05 if index == "O1" else 0.2)
    assert run.merit == pytest.approx(merit_of(space, run.q, index)[0]) and run.history[-1] == run.merit
    assert is_feasible(space, run.q, 1e-8).all()


@pytest.mark.parametrize("name", [*ARMS, "motley"])
@pytest.mark.parametrize("kind", ["pose", "position"])
@pytest.mark.parametrize("reference", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_derivative_product_is_exact(name, kind, reference):
    chain = motley() if name == "motley" else ARMS[name]()
    seen = observation(targets_of(chain, [(0.05, 0.02, 0.1), (0.0, -0.1, 0.02)]), kind, reference=reference)
    rng = np.random.default_rng(3)
    q = rng.uniform(-1, 1, (2, chain.n))
    weights = rng.normal(size=seen(q).shape)
    check(
        lambda x: 1e-4 * (weights * seen(x.reshape(q.shape))).sum(),
        1e-4 * seen.product(q, weights).ravel(),
        q.ravel(),
        tolerance=1e-8,
    )


def test_outside_start_is_brought_inside():
    """A start outside the constraints is brought inside."""
    low = PoseConstraint("low", planar.height, planar.height_gradient)
    space = SearchSpace(planar.jacobian, planar.LOWER, planar.UPPER, planar.product, (low,))
    start = np.tile([0.9, 0.2, 0.1], (6, 1)) + 0.1 * np.random.default_rng(0).normal(size=(6, 3))
    assert not is_feasible(space, start).any()
    assert is_feasible(space, improved(space, start, evaluations=60).q, 1e-8).all()

"""The posture that a configuration means: found again among all that reach a pose, for arms of three makers."""

import numpy as np
import pytest

from calib.apps.controller_programs.configurations import configuration_of, has_spherical_wrist, postures, signs_at
from calib.controllers.axes import plain_axes
from calib.controllers.table import controller_named
from calib.geometry.installation import Installation
from calib.geometry.inverse import Goal
from calib.robot.formats.urdf import parse
from calib.robot.kinematics import forward
from calib.robot.library import load

HOME = {"fanuc": np.zeros(6), "rapid": np.zeros(6), "krl": np.array([0, -np.pi / 2, np.pi / 2, 0, 0, 0])}


def written(name: str, chain, q: np.ndarray) -> str:
    """Return what a controller would write at a posture (6,), by the manuals' words."""
    before, elbow, wrist = signs_at(chain, q[None], HOME[name])[0]
    if name == "fanuc":
        letters = "N" if wrist < 0 else "F", "U" if elbow > 0 else "D", "T" if before > 0 else "B"
        return " ".join([*letters, *(f"{round(q[k] / (2 * np.pi))}" for k in (3, 4, 5))])
    if name == "krl":
        status = (before < 0) + 2 * (elbow > 0) + 4 * (wrist < 0)
        return f"S {status} T {sum(1 << k for k in range(6) if q[k] < 0)}"
    quarters = [int(np.floor(q[k] / (np.pi / 2))) for k in (0, 3, 5)]
    return " ".join(map(str, [*quarters, 4 * (before < 0) + 2 * (elbow < 0) + (wrist < 0)]))


def arm(path):
    return parse(path.read_text(), str(path), tip="tool0")


ARMS = [
    ("fanuc", "fanuc__m10ia"),
    ("krl", "kuka_experimental__kr10r1420"),
    ("krl", "kroshu__kr120_r2700_2"),
    ("rapid", "abb_experimental__irb120_3_58"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "file"), ARMS)
def test_the_posture_is_found_again(data, name, file):
    path = data / "public_arms" / f"{file}.urdf"
    if not path.is_file():
        pytest.skip(f"no {path}")
    chain, controller = arm(path), controller_named(name)
    goal = Goal(Installation(chain), 6, chain.lower, chain.upper)
    lower, upper = chain.sampling_limits()
    drawn = np.random.default_rng(2).uniform(lower, upper, (60, 6))
    clear = np.abs(np.sin(drawn[:, 4])) > 0.05  # away from the boundary of the wrist
    if name == "fanuc":
        ahead = signs_at(chain, drawn, HOME[name])[:, 0] > 0  # U and D are not used behind axis 1
        clear &= ahead & (np.abs(drawn[:, [0, 2]]) < np.pi).all(axis=1)
    for q in drawn[clear][:12]:
        configuration = configuration_of(controller, written(name, chain, q))
        assert configuration is not None
        answer = postures(goal, forward(chain, q[None]), configuration, controller)
        assert answer.reasons == ("",), configuration.text
        np.testing.assert_allclose(answer.q[0], q, atol=1e-5)


@pytest.fixture(scope="module")
def m20ia(request):
    chain = arm(request.path.parent / "fanuc_m20ia.urdf")
    return chain, Goal(Installation(chain), 6, chain.lower, chain.upper)


def test_real_configuration_matches_joints(m20ia):
    """CURPOS.DG of an R-30iA: joints 86.75 -45.63 -10.99 56.19 -81.55 -94.01, CFG N U T, 0, 0, 0."""
    controller = controller_named("fanuc")
    q = plain_axes(6).uncoupled(controller, np.radians([[86.75, -45.63, -10.99, 56.19, -81.55, -94.01]]))
    configuration = configuration_of(controller, "N U T 0 0 0")
    assert configuration is not None and configuration.holds(controller, m20ia[0], q)[0]
    flipped = configuration_of(controller, "F U T 0 0 0")
    assert flipped is not None and not flipped.holds(controller, m20ia[0], q)[0]


def test_turns_choose_among_postures(m20ia):
    """Turns choose among postures a turn apart."""
    chain, goal = m20ia
    controller = controller_named("fanuc")
    q = np.radians([10.0, 20.0, 10.0, 30.0, -60.0, 200.0])
    poses = forward(chain, q[None])
    for words, expected in (("N U T 0 0 1", 200.0), ("N U T 0 0 0", -160.0)):
        configuration = configuration_of(controller, words)
        assert configuration is not None
        answer = postures(goal, poses, configuration, controller)
        assert answer.reasons == ("",) and np.degrees(answer.q[0, 5]) == pytest.approx(expected, abs=1e-4)


def test_impossible_configuration_is_said(m20ia):
    """A configuration that the pose does not have is said."""
    chain, goal = m20ia
    q = np.radians([0.0, 60.0, 60.0, 0.0, -60.0, 0.0])
    q[1] = chain.upper[1]  # stretched ahead and down: behind axis 1 nothing reaches that
    configuration = configuration_of(controller_named("fanuc"), "N U B 0 0 0")
    assert configuration is not None
    answer = postures(goal, forward(chain, q[None]), configuration, controller_named("fanuc"))
    assert "is no posture at this pose" in answer.reasons[0] and "before axis 1" in answer.reasons[0]


def test_contradicting_start_is_said(m20ia):
    """A start that contradicts the configuration is said."""
    chain, goal = m20ia
    controller = controller_named("fanuc")
    q = np.radians([10.0, 20.0, 10.0, 30.0, -60.0, 20.0])
    flipped = q + np.radians([0, 0, 0, -180.0, 120.0, -180.0])
    configuration = configuration_of(controller, "N U T 0 0 0")
    assert configuration is not None
    answer = postures(goal, forward(chain, q[None]), configuration, controller, start=flipped.tolist())
    np.testing.assert_allclose(answer.q[0], q, atol=1e-5)
    assert answer.contradicted[0] and answer.reasons == ("",)


def test_configuration_needs_spherical_wrist(m20ia):
    """Arms without a spherical wrist have no configuration."""
    assert (
        has_spherical_wrist(m20ia[0])
        and not has_spherical_wrist(load("ur5"))
        and not has_spherical_wrist(load("iiwa14"))
    )

"""Loops that close, and those that do not: branch, reach, singularities, and files that contradict themselves."""

import numpy as np
import pytest

from calib.errors import NoPosture, RobotError
from calib.parallel.mechanism import parallel_robot
from calib.parallel.mechanism.closure import closed, coordinates_of, leg_links
from calib.parallel.mechanism.velocities import of_platform, of_readings
from calib.parallel.robots import find

ROBOTS = ("dualv", "fivebar", "stewart")


def text(name: str) -> str:
    return parallel_robot.library()[name].read_text(encoding="utf-8")


def made(tmp_path, content: str):
    path = tmp_path / "robot.toml"
    path.write_text(content, encoding="utf-8")
    return closed(parallel_robot.read(path))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "stewart")) for name in ROBOTS]
)
def test_encoders_and_platform_agree(name):
    """Coordinates → joints → coordinates, on the branch of home, loops closed to rounding; records as random ones."""
    known, rng = find(name).mechanism, np.random.default_rng(0)
    robot = known.robot
    x = rng.uniform(robot.lower, robot.upper, (60, robot.r))
    posture = known.place(x)
    assert max(np.abs(one.gap).max() for one in leg_links(robot, posture)) < 1e-12
    back = known.locate(posture.q[:, robot.actuated])
    assert np.allclose(back.q, posture.q, atol=1e-10) and np.allclose(coordinates_of(known, back), x, atol=1e-10)
    slow = 0.5 * np.minimum(robot.upper, -robot.lower) * np.sin(np.linspace(0, 6, 400))[:, None]
    record = known.place(slow)
    assert np.allclose(record.q[::37], known.place(slow[::37]).q, atol=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_velocities_are_derivatives(name):
    """Velocities and accelerations are derivatives."""
    known, h = find(name).mechanism, 1e-4
    robot, rng = known.robot, np.random.default_rng(1)
    x = 0.5 * rng.uniform(robot.lower, robot.upper)
    rate = np.where(robot.selected < 3, rng.normal(size=robot.r), 0.0)  # roll-pitch-yaw is no integral of the twist
    rate[robot.selected == 5] = 0.5 if robot.r == 3 else 0.0
    steps = np.array([-h, 0.0, h])[:, None]
    posture = known.place(x + rate * steps + 0.5 * rate[::-1] * (rate != 0) * steps**2)
    found = of_platform(known, posture[1:2], rate[None], (rate[::-1] * (rate != 0))[None])
    assert np.allclose(found.v[0], (posture.q[2] - posture.q[0]) / (2 * h), atol=1e-6)
    assert np.allclose(found.a[0], (posture.q[2] - 2 * posture.q[1] + posture.q[0]) / h**2, atol=1e-5)
    own = robot.actuated
    again = of_readings(known, posture[1:2], found.v[:, own], found.a[:, own])
    assert np.allclose(again.a, found.a, atol=1e-9) and np.allclose(again.change, found.change, atol=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_files_are_read_back_exactly(name, tmp_path):
    robot = parallel_robot.read(parallel_robot.library()[name])
    again = parallel_robot.read(parallel_robot.write(tmp_path / "again.toml", robot))
    assert parallel_robot.to_table(again) == parallel_robot.to_table(robot)


def test_poses_out_of_reach_are_named():
    known = find("dualv").mechanism
    with pytest.raises(NoPosture, match=r"sample 2: .*leg\d stays .* mm from its attachment: out of reach") as told:
        known.place(np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]))
    assert told.value.samples == (1,)


def test_stretched_leg_is_type_1_singularity():
    """Leg 1 of the DualV at full reach, its attachment 0.56 m from its pivot, the other loops still closed."""
    known = find("dualv").mechanism
    pivot = 0.41 * np.array([np.cos(np.radians(15.52)), np.sin(np.radians(15.52))])
    with pytest.raises(NoPosture, match=r"leg[14] is (singular|stretched or folded).*type 1"):
        known.place(np.array([[pivot[0] - 0.56 * (1 - 1e-11), pivot[1] - 0.11, 0.0]]))


@pytest.mark.parametrize(
    ("y", "words"), [(0.1077033, "singular .type 2"), (0.05, "beyond a type 2 singularity|branch")]
)
def test_five_bar_tells_type_2_singularity(y, words):
    """Distal links in line, at y² = 0.3² - 0.28²: locked motors do not hold the tip."""
    known = find("fivebar").mechanism
    with pytest.raises(NoPosture, match=words):
        known.place(np.array([[0.0, y - 0.5]]))


def test_inverted_stewart_is_beyond_type_2():
    """A Stewart platform upside down is beyond a type 2 singularity."""
    known = find("stewart").mechanism
    with pytest.raises(NoPosture, match="type 2"):
        known.place(np.array([[0.0, 0.0, -0.5, 0.0, 0.0, 0.0]]))


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("dualv", "d = 0.41\n", "d = 1.41\n", "loop of leg1 does not close at the platform's home"),
        ("dualv", '["x", "y", "rz"]', '["x", "y"]', "lower: expected one value per coordinate|platform has 3 freedoms"),
        ("dualv", '["x", "y", "rz"]', '["x", "y", "rx"]', "the platform can move in x, y, rz"),
        ("dualv", '["x", "y", "rz"]', '["x", "y", "spin"]', r"names the platform's independent coordinates|lower"),
        ("dualv", 'actuated = ["motor1"]', 'actuated = ["motor9"]', "not one of its joints.*motor1"),
        ("dualv", 'actuated = ["motor4"]', 'actuated = ["motor4"]\nend = "spherical"', "leg4 is singular in all"),
        ("dualv", 'kind = "parallel"', 'kind = "serial"', 'state kind = "parallel"'),
        ("dualv", '"225.15 deg", ', "", "home: expected one value per joint, 3"),
        ("fivebar", 'actuated = ["motor_left"]', "actuated = []", "1 actuated joints cannot hold"),
        ("stewart", 'end = "spherical"', 'end = "ball"', "neither rigid nor spherical"),
        ("stewart", 'end = "spherical"', "", "freedom|close|motions"),
    ],
)
def test_contradictory_files_are_refused(tmp_path, name, old, new, words):
    """Files that contradict themselves are refused."""
    assert old in text(name)
    with pytest.raises(RobotError, match=words):
        made(tmp_path, text(name).replace(old, new, 1))

"""Distances on arms whose answers are known by hand."""

import numpy as np
import pytest
from arms import motley
from differences import check
from robot_oracle import axis, joint, robot
from scipy.spatial.transform import Rotation

from calib.errors import RobotError
from calib.robot import capsules, collision
from calib.robot.chain import random_joints
from calib.robot.kinematics import joint_jacobian, sweep
from calib.robot.library import load
from calib.robot.obstacles import Obstacle, Wall
from calib.transforms import pose


def shape(inner: str, xyz: str = "0.5 0 0", rpy: str = "0 0 0") -> str:
    return f'<collision><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{inner}</geometry></collision>'


def planar(*shapes: str) -> str:
    """Return three links of 1 m in the x-y plane at z = 0.5, turning about z (the second about -z)."""
    bodies = dict(zip(("base", "one", "two", "three"), shapes, strict=False))
    return robot(
        joint("a", "continuous", "base", "one", axis("0 0 1"), "0 0 0.5"),
        joint("b", "revolute", "one", "two", axis("0 0 -1"), "1 0 0"),
        joint("c", "revolute", "two", "three", axis("0 0 1"), "1 0 0"),
        bodies=bodies,
    )


BALL = '<sphere radius="0.1"/>'


@pytest.fixture
def balls(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(planar("", *[shape(BALL)] * 3))
    return path


def measured(found, q):
    return dict(zip(found.pairs, found.distances(np.array([q]))[0], strict=True))


def test_distances_by_hand(balls):
    wall = Obstacle("wall", "box", (0.2, 9.0, 9.0), pose(position=[3.0, 0, 0]))
    ball = Obstacle("ball", "sphere", (0.2,), pose(position=[0.5, 1.0, 0.5]))
    found = collision.from_urdf(balls, floor=0.1, obstacles=[wall, ball])
    assert found.pairs[0] == ("one", "three") and ("one", "two") not in found.pairs
    distances = measured(found, [0.0, 0, 0])
    assert distances["one", "three"] == pytest.approx(2.0 - 0.2)
    assert distances["three", "wall"] == pytest.approx(2.9 - 2.5 - 0.1)
    assert distances["two", "floor"] == pytest.approx(0.5 - 0.1 - 0.1)
    assert distances["one", "ball"] == pytest.approx(1.0 - 0.3)
    # the first two links stretched along y, the third folded back by 90 degrees about z and -z
    distances = measured(found, [np.pi / 2, np.pi / 2, 0.0])
    assert distances["two", "ball"] == pytest.approx(-0.3)
    assert distances["one", "three"] == pytest.approx(np.hypot(1.5, 0.5) - 0.2)


@pytest.mark.parametrize("arm", ["balls", "lwr4plus", pytest.param("ur5", marks=pytest.mark.slow)])
def test_gradients_follow_the_witness_points(arm, balls):
    box = Obstacle("box", "box", (0.3, 0.4, 0.5), pose(position=[0.5, 0.1, 0.4]))
    if arm == "balls":  # a continuous joint, a joint about -z
        found, q = collision.from_urdf(balls, floor=0.1, obstacles=[box]), random_joints(load("ur5"), 6, 1)[:, :3]
    else:
        found, q = capsules.from_chain(load(arm), 0.05, -0.1, [box]), random_joints(load(arm), 6, 1)
    for pose_ in q:
        check(lambda x: found.distances(x[None])[0], lambda x: found.gradients(x[None])[0], pose_)


def test_free_and_margin(balls):
    found = collision.from_urdf(
        balls, obstacles=[Obstacle("rod", "cylinder", (0.1, 2.0), pose(position=[2.8, 0, 0.5]))]
    )
    q = np.array([[0.0, 0, 0], [np.pi, 0, 0]])
    assert found.distances(q).shape == (2, len(found.pairs))
    assert found.free(q).tolist() == [True, True]
    assert found.free(q, 0.15).tolist() == [False, True]
    assert found.free(np.zeros((0, 3))).shape == (0,)


def test_every_primitive_and_a_mesh(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "tetrahedron.obj").write_text(
        "v 0 0 0\nv 100 0 0\nv 0 100 0\nv 0 0 100\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    mesh = '<mesh filename="package://arm/meshes/tetrahedron.obj" scale="0.001 0.001 0.001"/>'
    lost = '<mesh filename="package://arm/meshes/absent.stl"/>'
    source = planar(
        shape('<box size="0.1 0.1 0.1"/>', "0 0 0"),
        shape('<cylinder radius="0.1" length="0.4"/>') + shape(lost),
        shape('<capsule radius="0.1" length="0.4"/>'),
        shape(mesh, "0 0 0"),
    )
    (tmp_path / "arm.urdf").write_text(source)
    found = collision.from_urdf(tmp_path / "arm.urdf", floor=0.0)
    assert found.missing == ("package://arm/meshes/absent.stl",)
    distances = measured(found, [0.0, 0, 0])
    assert distances["one", "floor"] == pytest.approx(0.5 - 0.2)
    assert distances["two", "floor"] == pytest.approx(0.5 - 0.3)
    assert distances["three", "floor"] == pytest.approx(0.5)
    assert distances["one", "three"] == pytest.approx(2.0 - 0.6, abs=1e-6)
    assert ("base", "floor") not in found.pairs and ("base", "two") in found.pairs


def test_always_touching_pairs_are_listed(tmp_path):
    """Pairs that always touch are left out and listed."""
    path = tmp_path / "arm.urdf"
    path.write_text(planar("", *[shape('<sphere radius="2"/>')] * 3))
    found = collision.from_urdf(path)
    assert (found.pairs, found.excluded) == ((), (("one", "three"),))
    assert found.free(np.zeros((2, 3))).tolist() == [True, True]


@pytest.mark.parametrize(
    "surroundings, named",
    [
        ({"floor": 1000.0}, "link 'two' in 'floor'"),
        ({"obstacles": [Obstacle("wall", "box", (1e3, 1e3, 1e3), np.eye(4))]}, "link 'one' in 'wall'"),
    ],
)
def test_inescapable_surroundings_refused(balls, surroundings, named):
    """Surroundings that a link never leaves are refused."""
    with pytest.raises(RobotError, match=named):
        collision.from_urdf(balls, **surroundings)
    with pytest.raises(RobotError, match="no pose is free of collision"):
        capsules.from_chain(load("ur5"), **surroundings)


def test_capsules_along_a_chain():
    chain = load("ur10")
    wall = Obstacle("wall", "box", (0.1, 4.0, 4.0), pose(position=[-1.4, 0, 0]))
    found = capsules.from_chain(chain, 0.05, floor=-0.1, obstacles=[wall])
    distances = measured(found, [0.0] * 6)
    # at q = 0 the UR10 lies along -x: the forearm ends at x = -0.612 - 0.5723
    assert distances["elbow_joint_link", "wall"] == pytest.approx(1.35 - 1.1843 - 0.05, abs=1e-6)
    assert distances["shoulder_lift_joint_link", "floor"] == pytest.approx(0.1 + 0.1273 - 0.05, abs=1e-6)
    free = found.free(random_joints(chain, 200), 0.01)
    assert 0.05 < free.mean() < 0.95


@pytest.mark.parametrize(
    "arm",
    [pytest.param("lwr4plus", marks=pytest.mark.slow), "ur5", "rv2sq", pytest.param("motley", marks=pytest.mark.slow)],
)
def test_capsules_measure_as_coal_does(arm):
    """Capsule by capsule, over random postures: against each other, floor, box, sphere and cylinder."""
    import coal

    chain = motley() if arm == "motley" else load(arm)
    things = [
        Obstacle("box", "box", (0.3, 0.4, 0.5), pose(np.eye(3)[[1, 2, 0]], [0.5, 0.1, 0.4])),
        Obstacle("ball", "sphere", (0.2,), pose(position=[-0.4, 0.3, 0.6])),
        Obstacle("rod", "cylinder", (0.1, 0.8), pose(np.eye(3)[[2, 0, 1]], [0.0, -0.5, 0.5])),
    ]
    found = capsules.from_chain(chain, 0.04, -0.2, things, targets=[(0.05, 0, 0.05)])
    q = random_joints(chain, 20, 3)
    distances, lines = found.distances(q), found.lines_at(q)
    solids = [coal.Box(0.3, 0.4, 0.5), coal.Sphere(0.2), coal.Cylinder(0.1, 0.8)]
    assert len(found.world_pairs) > 6 and (arm == "motley" or len(found.arm_pairs) > 1)

    def capsule(i: int, k: int):
        start, end = lines.start[i, k], lines.end[i, k]
        turned = Rotation.align_vectors((end - start)[None], [[0.0, 0.0, 1.0]])[0].as_matrix()
        solid = coal.Capsule(found.radii[k], float(np.linalg.norm(end - start)))
        return solid, coal.Transform3s(turned, (start + end) / 2)

    for i in range(len(q)):
        for (one, two), distance in zip(found.arm_pairs, distances[i], strict=False):
            oracle = coal.distance(*capsule(i, one), *capsule(i, two), coal.DistanceRequest(), coal.DistanceResult())
            assert distance == pytest.approx(oracle, abs=1e-6)
        for (one, thing), distance in zip(found.world_pairs, distances[i, len(found.arm_pairs) :], strict=True):
            if thing == 0:  # the floor
                low = min(lines.start[i, one, 2], lines.end[i, one, 2])
                assert distance == pytest.approx(low + 0.2 - found.radii[one])
                continue
            placed = coal.Transform3s(things[thing - 1].placement[:3, :3], things[thing - 1].placement[:3, 3])
            asked, got = coal.DistanceRequest(), coal.DistanceResult()
            oracle = coal.distance(*capsule(i, one), solids[thing - 1], placed, asked, got)
            if oracle > 0:
                assert distance == pytest.approx(oracle, abs=1e-5)
            else:
                assert distance < 1e-6


@pytest.mark.parametrize("arm", ["lwr4plus", "ur5", "rv2sq", "motley"])
def test_free_is_what_the_distances_say(arm):
    """Compiled and by distances: fixed and moving bodies, a mimic joint, targets, floor, a wall and an obstacle."""
    chain = motley() if arm == "motley" else load(arm)
    box = Obstacle("box", "box", (0.3, 0.4, 0.5), pose(np.eye(3)[[1, 2, 0]], [0.5, 0.1, 0.4]))
    wall = Wall("side", np.array([0.6, 0.8, 0.0]), -0.5)
    found = capsules.from_chain(chain, 0.06, -0.2, [box], walls=[wall], targets=[(0.05, 0, 0.05)])
    q = random_joints(chain, 500, 3)
    for margin in (0.0, 0.02):
        free = found.free(q, margin)
        assert 0.05 < free.mean() < 0.95
        assert np.array_equal(free, (found.distances(q) > margin).all(axis=1))


@pytest.mark.parametrize("arm", ["balls", "lwr4plus", "ur5"])
def test_lines_of_sight(arm, balls):
    """The slope of what a line of sight keeps from the links, and a link that stands in the way."""
    chain = load(str(balls)) if arm == "balls" else load(arm)
    found = collision.from_urdf(balls) if arm == "balls" else capsules.from_chain(chain)
    there = np.array([2.0, 1.0, 0.8])

    def beam(q: np.ndarray):
        walked = sweep(chain, q[None])
        return found.beam(q[None], walked.position.T, joint_jacobian(chain, walked, walked.position)[:, :3], there)

    for q in random_joints(chain, 4, 2) / 2:
        check(lambda x: beam(x)[0][0], lambda x: beam(x)[1][0], q)
    if arm == "balls":  # stretched along x; seen from before the base, the first links stand in the way
        there = np.array([-2.0, 0.0, 0.5])
        assert beam(np.zeros(3))[0][0] == pytest.approx([-0.1, -0.1], abs=1e-3)
        there = np.array([3.0, 2.0, 0.5])
        assert (beam(np.zeros(3))[0][0] > 0.3).all()


@pytest.mark.parametrize("margin", [0.0, 0.01, 0.02, 0.05])
@pytest.mark.parametrize("radius", [None, 0.03, 0.04, 0.05])
@pytest.mark.parametrize("arm", ["ur5", "ur10", "panda", "lwr4plus"])
def test_no_margin_makes_arm_infeasible(arm, radius, margin):
    """A UR5's forearm and second wrist link are 0.0947 m apart in every posture, less two radii."""
    chain = load(arm)
    found = capsules.from_chain(chain, radius, margin=margin)
    assert found.free(random_joints(chain, 100, 1), margin).mean() > 0.3


def test_only_constant_hits_are_refused():
    """An obstacle that is mostly hit is an obstacle, and one always hit is refused."""
    chain = load("ur5")
    block = Obstacle("block", "box", (2.0, 2.0, 1.9), pose(position=[0, 0, 1.1]))
    found = capsules.from_chain(chain, obstacles=[block])
    assert found.free(random_joints(chain, 400, 1)).mean() < 0.4
    assert "block" not in {name for pair in found.excluded for name in pair}
    with pytest.raises(RobotError, match="in 'block'"):
        capsules.from_chain(chain, obstacles=[Obstacle("block", "box", (2.0, 2.0, 1.9), pose(position=[0, 0, 1.0]))])


def test_continuous_and_mimic_joints_move(tmp_path):
    """Continuous and mimic joints move the shapes."""
    path = tmp_path / "arm.urdf"
    follow = axis("0 0 1") + '<mimic joint="a" multiplier="-2" offset="0.3"/>'
    path.write_text(
        robot(
            joint("a", "continuous", "base", "one", axis("0 0 1")),
            joint("b", "revolute", "one", "two", follow, "1 0 0"),
            bodies={"two": shape(BALL, "1 0 0")},
        )
    )
    found = collision.from_urdf(path, obstacles=[Obstacle("ball", "sphere", (0.1,), pose(position=[9.0, 0, 0]))])
    turned = 0.4 + (-2 * 0.4 + 0.3)
    centre = np.array([np.cos(0.4) + np.cos(turned), np.sin(0.4) + np.sin(turned)])
    assert found.distances(np.array([[0.4]]))[0, 0] == pytest.approx(np.hypot(9 - centre[0], centre[1]) - 0.2)


@pytest.mark.parametrize(
    "inner, message",
    [
        ("", r"no usable <collision> shape; give mesh_folders, or use capsules"),
        (shape('<mesh filename="absent.stl"/>'), r"no usable .* \(1 meshes were not found, e\.g\. absent\.stl\)"),
        (shape('<box size="1 1"/>'), r"link 'one': size=\"1 1\" of <box> in line \d+ is not 3 finite numbers"),
        (shape('<torus radius="1"/>'), r"<torus> is not one of box, sphere"),
        (shape(""), r"<collision> without a shape"),
    ],
)
def test_bad_shapes(inner, message, tmp_path):
    (tmp_path / "arm.urdf").write_text(planar("", inner))
    with pytest.raises(RobotError, match=message):
        collision.from_urdf(tmp_path / "arm.urdf")


@pytest.mark.parametrize(
    ("kind", "size", "words"), [("cone", (1,), "kind 'cone' is not"), ("box", (1, 2), "3 positive")]
)
def test_bad_obstacles(kind, size, words):
    with pytest.raises(RobotError, match=words):
        Obstacle("o", kind, size, np.eye(4))

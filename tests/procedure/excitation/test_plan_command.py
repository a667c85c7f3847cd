"""`calib plan`: files, figures and exit codes; bad input gets one clear message."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from planned import CHAIN, WAYPOINTS, lwr, read_setpoints, write_model
from without_figures import run

from calib import files
from calib.dynamics.bodies import STANDARD
from calib.errors import CalibError
from calib.procedure.excitation import folder as motion_folder
from calib.procedure.excitation import planning
from calib.procedure.excitation.planning import read_waypoints
from calib.procedure.excitation.settings import PlanSettings
from calib.robot.calibrated import CalibratedChain
from calib.robot.kinematics import forward
from calib.simulation.known_robots import truth
from calib.transforms import to_quaternion


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a working folder with waypoints, drives, and an identified model in the form of `calib identify`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CALIB_DEBUG", raising=False)
    write_waypoints(WAYPOINTS)
    known = truth("lwr4plus")["drives"]
    amounts = {key: known[key] for key in ("Ia", "Fv", "Fc")}
    files.write(tmp_path / "drives.toml", "[drives]\n" + "".join(f"{key} = {amounts[key]}\n" for key in amounts))
    write_model(tmp_path / "model")
    return tmp_path


def write_waypoints(points, name: str = "way.csv", header: str = "q1,q2,q3,q4,q5,q6,q7") -> None:
    Path(name).write_text(header + "\n" + "\n".join(",".join(map(str, row)) for row in points) + "\n")


def plan(*more: str) -> int:
    given = list(more) if "--waypoints" in more else ["--waypoints", "way.csv", *more]
    return run("plan", "lwr4plus", *given, *(() if "--out" in more else ("--out", "out")))


@pytest.mark.slow
def test_an_identified_model_is_planned_with(room, capsys):
    assert plan("--model", "model", "--start", "0,0,0,0,0,0,0", "--slower", "2", "--plots", "png") == 0
    table = json.loads((room / "out" / "metrics.json").read_text())
    motion = read_setpoints(room / "out" / "motion.csv")
    assert motion["t"][-1] == pytest.approx(table["duration"], abs=1e-9)
    np.testing.assert_allclose(np.diff(motion["t"]), 1e-3, atol=1e-9)
    q, v, a, tau = (motion[name] for name in ("q", "v", "a", "tau"))
    np.testing.assert_allclose(tau[1:-1], lwr().torque(q, v, a)[1:-1], atol=1e-7)
    assert table["feasible"] and table["active_share"] > 0.97 and table["samples"] == len(q)
    for name in ("position", "velocity", "torque"):
        assert min(table["margins"][name]["joints"]) >= 0
    assert (np.abs(tau) <= [joint.effort for joint in CHAIN.joints]).all()
    message = yaml.load((room / "out" / "trajectory.yaml").read_text(), yaml.CSafeLoader)
    assert message == json.loads((room / "out" / "trajectory.json").read_text())
    assert message["joint_names"] == list(CHAIN.joint_names) and len(message["points"]) == len(q)
    lead, slow = (read_setpoints(room / "out" / f"{name}.csv") for name in ("approach", "rehearsal"))
    np.testing.assert_allclose(lead["q"][-1], WAYPOINTS[0], atol=1e-9)
    assert slow["t"][-1] == pytest.approx(2 * table["duration"], abs=1e-9)
    assert {"plot_motion.png", "plot_profile.png"} <= {path.name for path in (room / "out").iterdir()}
    assert "all limits are respected" in capsys.readouterr().out
    assert plan("--model", "model") == 0  # over the earlier plan, whose approach is no longer one's own
    assert not (room / "out" / "approach.csv").exists()


@pytest.mark.slow
def test_model_and_stated_drives_plan_alike(room):
    """Model and stated drives plan the same motion."""
    one = planning.plan("lwr4plus", room / "way.csv", model=room / "model")
    two = planning.plan("lwr4plus", room / "way.csv", drives=room / "drives.toml")
    assert one.track.duration == two.track.duration and "no covariance" in one.notes[1]
    assert "collisions and floor are NOT checked" in one.notes[0]
    bare = planning.plan("lwr4plus", room / "way.csv")
    assert bare.track.duration < one.track.duration and "friction unknown" in bare.notes[1]


@pytest.mark.slow
def test_lines(room):
    points = WAYPOINTS[0] + 0.3 * (WAYPOINTS - WAYPOINTS[0])
    write_waypoints(points)
    straight = planning.plan("lwr4plus", room / "way.csv", PlanSettings(lines=True), model=room / "model")
    table = motion_folder.plan_metrics(straight)
    assert len(table["segments"]) == 2 and table["line_deviation"]["position"] <= 1e-6
    corner = forward(CHAIN, points[1:2])[0, :3, 3]
    tool = forward(CHAIN, straight.track.q)[:, :3, 3]
    assert np.linalg.norm(tool - corner, axis=1).min() < 1e-4


@pytest.mark.slow
def test_shapes(room):
    shaped = planning.plan("lwr4plus", room / "way.csv", PlanSettings(shorten=4, stray=0.1), model=room / "model")
    found = motion_folder.plan_metrics(shaped)["shortened"]
    assert found["after"] <= found["before"] and found["evaluations"] >= 4


@pytest.mark.slow
def test_waypoints_of_the_tool(room, capsys):
    """Places are met exactly: with an orientation, without one, and in the configuration that joints beside it say."""
    poses = forward(CHAIN, WAYPOINTS)
    table = np.hstack([1e3 * poses[:, :3, 3], to_quaternion(poses)])
    write_waypoints(table, "pose.csv", "x [mm],y [mm],z [mm],qx,qy,qz,qw")
    write_waypoints(table[:, :3], "place.csv", "x [mm],y [mm],z [mm]")
    write_waypoints(
        np.hstack([WAYPOINTS + 0.05, table]), "both.csv", "q1,q2,q3,q4,q5,q6,q7,x [mm],y [mm],z [mm],qx,qy,qz,qw"
    )
    for name in ("pose", "place", "both"):
        q = read_waypoints(room / f"{name}.csv", CHAIN, CHAIN.lower, CHAIN.upper)
        assert (q >= CHAIN.lower).all() and (q <= CHAIN.upper).all()
        found = forward(CHAIN, q)
        np.testing.assert_allclose(found[:, :3, 3], poses[:, :3, 3], atol=1e-6)
        if name != "place":
            np.testing.assert_allclose(found, poses, atol=2e-6)
    assert np.abs(q - WAYPOINTS).max() < 0.2
    planned = planning.plan("lwr4plus", room / "both.csv", drives=room / "drives.toml")
    tool = forward(CHAIN, planned.track.q)[:, :3, 3]
    assert all(np.linalg.norm(tool - place, axis=1).min() < 2e-3 for place in poses[:, :3, 3])
    write_waypoints([[0.2, 0.1, 0.6], [2.0, 0.0, 0.5]], "far.csv", "x,y,z")
    assert plan("--waypoints", "far.csv") == 2
    assert "waypoint 2 is out of reach" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("[joints]\nq2 = [1.0, -1.0]\n", "is not below"),
        ("[joints]\nq2 = [0.4, 0.9]\n", "waypoint 2: joint 2 at 1 is 0.1 beyond"),
        ("[velocity]\nq3 = 0.0\n", "velocity limit of joint 3"),
        ("[velocity]\nq3 = nan\n", "is not a number"),
        ("[torque]\nq2 = 30.0\n", "joint 2 needs"),
        ("[torque]\nmargin = 1.5\n", "margin"),
        ("[target]\nheight = 0.9\n", "is violated by"),
        ("[speed]\nall = 1.0\n", "there is no key 'speed'"),
        (WAYPOINTS[:1], "1 waypoint"),
        (WAYPOINTS[[0, 0, 1]], "waypoints 1 and 2 are the same"),
        (WAYPOINTS[[0, 0]], "waypoints 1 and 2 are the same"),
        (np.where(WAYPOINTS == 1.0, np.nan, WAYPOINTS), "row 2, column 'q2': found an empty or NaN cell"),
        (WAYPOINTS * 2, "beyond"),
        (["--drives", "drives.toml"], "leave one of them out"),
        (["--model", "."], "contains no identified model"),
        (["--payload", "tool"], "no payload 'tool'"),
        (["--rate", "0"], "rate: expected"),
        (["--line", "--shorten", "10"], "leave no path to change"),
        (["--start", "0,0"], "expected 7 joint values"),
        (["--start", "0,9,0,0,0,0,0"], "beyond its limits"),
        (["--slower", "0.5"], "slower: expected"),
        (["--waypoints", "none.csv"], "none.csv"),
        (["--out", "way.csv"], "is a file"),
    ],
)
def test_impossible_plan_inputs_are_refused(room, capsys, given, message):
    """Limits, waypoints and options that leave no motion are refused."""
    Path("limits.toml").write_text(given if isinstance(given, str) else "")
    if isinstance(given, np.ndarray):
        write_waypoints(given)
    more = given if isinstance(given, list) else ["--limits", "limits.toml"]
    assert plan(*(() if "--model" in more else ("--model", "model")), *more) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1 and not (room / "out").exists()


def test_a_damaged_model_is_refused(room, capsys):
    place = room / "model" / "dynamics.json"
    table = json.loads(place.read_text())
    place.write_text(json.dumps(table | {"bodies": {}}))
    assert plan("--model", "model") == 2
    assert "damaged" in capsys.readouterr().err
    place.write_text(json.dumps(table | {"bodies": table["bodies"] | {"ZZ3": float("nan")}}))
    assert plan("--model", "model") == 2
    assert "not finite" in capsys.readouterr().err
    place.write_text("{")
    assert plan("--model", "model") == 2
    assert "no identified model" in capsys.readouterr().err


@pytest.mark.slow
def test_uncertain_model_keeps_torque_free(room, capsys):
    """Only Ia2 is uncertain, so sigma is its own times the largest acceleration of joint 2."""
    files.write_table(
        room / "model" / "covariance.csv", ("name", "Ia2", "ZZ3R"), [("Ia2", 0.04, 0.0), ("ZZ3R", 0.0, 0.0)]
    )
    sharp = planning.plan("lwr4plus", room / "way.csv", drives=room / "drives.toml")
    careful = planning.plan("lwr4plus", room / "way.csv", model=room / "model")
    assert careful.sigma is not None
    np.testing.assert_allclose(careful.sigma[1], 0.2 * np.abs(sharp.timings[0].sampled.a[:, 1]).max(), rtol=1e-6)
    np.testing.assert_allclose(careful.limits.torque, sharp.limits.torque - 2 * careful.sigma, atol=1e-9)
    assert careful.track.duration > sharp.track.duration
    assert (np.abs(careful.track.tau) <= careful.limits.torque).all()
    files.write_table(room / "model" / "covariance.csv", ("name", "Ia2"), [("Ia2", 1e4)])
    assert plan("--model", "model") == 2
    assert "the margin for torque uncertainty" in capsys.readouterr().err


@pytest.mark.slow
def test_a_payload_on_board_takes_longer(room):
    place = room / "model" / "dynamics.json"
    table = json.loads(place.read_text())
    load = dict(zip([f"{name}tool" for name in STANDARD], truth("lwr4plus")["payload"]["inertia"]))
    place.write_text(json.dumps(table | {"payloads": ["tool"], "bodies": table["bodies"] | load}))
    free, loaded = (
        planning.plan("lwr4plus", room / "way.csv", PlanSettings(payloads=on), model=room / "model").track.duration
        for on in ((), ("tool",))
    )
    assert free < loaded


def test_waypoints_do_not_shorten_the_arm(room, capsys):
    """Waypoints that leave a joint out plan no shorter arm."""
    from calib.robot.formats.urdf_write import write_new

    Path("arm.urdf").write_text(write_new(CHAIN))
    names = CHAIN.joint_names[:-1]
    Path("short.csv").write_text(",".join(names) + "\n" + ",".join("0" for _ in names) + "\n")
    assert run("plan", "arm.urdf", "--waypoints", "short.csv", "--out", "p") == 2
    said = capsys.readouterr().err
    assert f"column '{CHAIN.joint_names[-1]}' is missing" in said and "--tip" in said and not Path("p").exists()


@pytest.mark.parametrize(
    "change, message",
    [
        ({"M": -2.0}, "body after A4: a negative mass"),
        ({"velocity": 0.0}, "no limit for the speed of A4 (velocity 0 is not a limit)"),
        ({"velocity": 1e8}, "no limit for the speed of A4 (velocity 1e+08 is not a limit)"),
        ({"velocity": np.inf}, "no limit for the speed of A4; without it"),
        ({"effort": 0.0}, "no limit for the acceleration of A4 (effort 0 is not a limit)"),
    ],
)
def test_impossible_robot_gets_no_plan(room, capsys, change, message):
    """No motion is planned with a robot that cannot exist."""
    joints, bodies = list(CHAIN.joints), np.array(CHAIN.inertias)
    joints[3] = replace(joints[3], name="A4", **{key: value for key, value in change.items() if key != "M"})
    bodies[3, 9] = change.get("M", bodies[3, 9])
    wrong = replace(CHAIN, joints=tuple(joints), inertias=bodies)
    limits = Path("limits.toml")
    limits.write_text("")
    with pytest.raises(CalibError, match=re.escape(message)):
        planning.plan(CalibratedChain(wrong), Path("way.csv"), limits=limits)
    if "velocity" in change:
        limits.write_text('[velocity]\nA4 = "90 deg/s"\n')
        assert planning.plan(CalibratedChain(wrong), Path("way.csv"), limits=limits).limits.velocity[3] == np.pi / 2


@pytest.mark.parametrize(
    "stated",
    [
        pytest.param("", marks=pytest.mark.slow),
        pytest.param('[velocity]\nall = "30 deg/s"\n', marks=pytest.mark.slow),
        "[acceleration]\nq1 = 5.0\n",
    ],
)
def test_plan_needs_acceleration_limits(room, capsys, stated):
    """Masses are not known of a UR10e, so nothing but the limits file can say how fast its joints may gather speed."""
    write_waypoints([[0, -1.6, 1.6, -1.6, -1.6, 0], [0.7, -1.2, 1.4, -1.7, -1.6, 0.3]], header="q1,q2,q3,q4,q5,q6")
    Path("limits.toml").write_text(stated)
    words = ("plan", "ur10e", "--waypoints", "way.csv", "--limits", "limits.toml", "--out", "out")
    assert run(*words) == 2
    said = capsys.readouterr().err
    assert "no limit for the acceleration of" in said and "such as [acceleration] all = 5.0" in said
    assert said.count("\n") == 1 and not Path("out").exists()
    with pytest.raises(CalibError, match="no limit for the acceleration"):
        planning.plan("ur10e", Path("way.csv"))
    Path("limits.toml").write_text(stated.replace("q1", "all") + "[acceleration]\nall = 5.0\n" * ("q1" not in stated))
    assert run(*words) == 0
    head = [line for line in Path("out/motion.csv").read_text().splitlines() if line.startswith("#")]
    assert any("acceleration limits: 5 rad/s² all joints (limits.toml)" in line for line in head)
    assert Path("out/trajectory.yaml").read_text().splitlines()[: len(head)] == head
    assert np.abs(read_setpoints(Path("out/motion.csv"))["a"]).max() <= 5.0 * (1 + 1e-9)


def test_motion_beyond_bounds_is_not_written(room):
    """A motion beyond its bounds is not written."""
    planned = planning.plan("lwr4plus", room / "way.csv")
    with pytest.raises(CalibError, match=r"the velocity of joint\d reaches .*, so the motion is not written"):
        motion_folder.write_plan(replace(planned, track=replace(planned.track, v=2 * planned.track.v)), room / "out")
    assert not (room / "out").exists()


def test_absurd_torque_limits_limit_nothing(room):
    """Torque limits that no robot has limit no acceleration."""
    joints = tuple(replace(joint, effort=1e4) for joint in CHAIN.joints)
    with pytest.raises(CalibError, match=r"the acceleration of joint\d reaches \d+ in this motion, above 3000"):
        planning.plan(CalibratedChain(replace(CHAIN, joints=joints)), room / "way.csv")

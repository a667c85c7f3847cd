"""`calib compensate`: from nominal targets to commands that put the true tool there."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib import cli, config
from calib.apps.compensation import joint_commands
from calib.apps.controller_programs.targets import pose_values, read_program
from calib.controllers.table import controller_named
from calib.data.poses.measurements import Poses
from calib.data.poses.pose_lists import Targets, read_targets
from calib.geometry import inverse
from calib.geometry.installation import Installation
from calib.geometry.inverse import Goal
from calib.geometry.observation import layout
from calib.procedure.findings import catalogue
from calib.procedure.kinematic_stage import inputs
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.simulation.cell import Cell, SimulatedInstrument, measure, true_poses
from calib.simulation.virtual_cells import perturbed_cell
from calib.transforms import from_quaternion, from_xyz_rpy, rotation_vector, to_quaternion

SIGMA = 20e-6


@pytest.fixture(scope="module")
def cell() -> Cell:
    """A UR5 with errors in every element, gear harmonics and compliance, seen by a fine instrument."""
    return perturbed_cell(
        load("ur5"), 4, SimulatedInstrument(position_sigma=SIGMA, orientation_sigma=5e-5, encoder_sigma=0.0)
    )


def drawn(cell: Cell, count: int, seed: int) -> np.ndarray:
    """Draw joints clear of singularities, where no arm follows a correction."""
    q = np.random.default_rng(seed).uniform(-2.2, 2.2, (3 * count, cell.nominal.n))
    goal = Goal(Installation(cell.nominal))
    return q[inverse.conditions(goal, q) > 0.03][:count]


def write(path: Path, header: list[str], rows: np.ndarray) -> Path:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *np.asarray(rows).tolist()])
    return path


@pytest.fixture(scope="module")
def fitted(cell, tmp_path_factory) -> Path:
    """The folder of a fit of 150 poses, with 50 kept aside."""
    folder = tmp_path_factory.mktemp("compensation")
    seen = measure(cell, drawn(cell, 200, 0), 1)
    names = [*(f"q{k + 1}" for k in range(6)), "x", "y", "z", "qx", "qy", "qz", "qw"]
    write(folder / "seen.csv", names, np.hstack([seen.q, seen.position, seen.quaternion]))
    arguments = ["fit", "ur5", folder / "seen.csv", "--holdout", "0.25", "--out", folder / "done", "--no-plots"]
    assert cli.run([str(each) for each in arguments]) == 0
    return folder / "done"


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def commands(path: str = "commands.csv") -> list[dict[str, str]]:
    with Path(path).open(newline="") as file:
        return list(csv.DictReader(file))


def numbers(rows: list[dict[str, str]], names: list[str]) -> np.ndarray:
    return np.array([[float(row[name]) for name in names] for row in rows])


Q = [f"q{k + 1}" for k in range(6)]


def commanded(calib, fitted: Path, *more: str) -> str:
    code, out, err = calib("compensate", fitted, "t.csv", "--out", "commands.csv", *more)
    assert code == 0, err
    return out


def write_poses(path: Path, poses: np.ndarray, q: np.ndarray) -> None:
    names = ["x", "y", "z", "qx", "qy", "qz", "qw", *Q]
    write(path, names, np.hstack([poses[:, :3, 3], to_quaternion(poses), q]))


def off(one: np.ndarray, two: np.ndarray) -> tuple[float, float]:
    """Return rms differences of poses: position [m], orientation [rad]."""
    shift = np.linalg.norm(one[:, :3, 3] - two[:, :3, 3], axis=1)
    turn = np.linalg.norm(rotation_vector(one[:, :3, :3] @ np.swapaxes(two[:, :3, :3], 1, 2)), axis=1)
    return float(np.sqrt(np.mean(shift**2))), float(np.sqrt(np.mean(turn**2)))


def test_true_tool_meets_poses_of_instrument(cell, fitted, here, calib):
    """Round trip against the hidden truth: what is left is the model's own error, as the held-out poses state it."""
    wanted = true_poses(cell, drawn(cell, 120, 5))
    write(here / "t.csv", ["x [mm]", "y [mm]", "z [mm]", "qx", "qy", "qz", "qw", *Q], np.hstack(
        [1e3 * wanted[:, :3, 3], to_quaternion(wanted), drawn(cell, 120, 5)]
    ))  # fmt: skip
    out = commanded(calib, fitted, "--frame", "seen", "--tool", "tool")
    assert "instrument's frame, station 'seen'" in out and "tool 'tool'" in out
    rows = commands()
    assert {row["status"] for row in rows} == {"reached"}
    position, turn = off(true_poses(cell, numbers(rows, Q)), wanted)
    unseen = float(rows[0]["unseen_rms [mm]"]) * 1e-3
    metrics = json.loads((fitted / "metrics.json").read_text())["validation"]["seen.csv"]
    assert unseen == pytest.approx(1e-3 * metrics["calibrated"]["position_mm"]["rms"])
    assert position < 1.2 * unseen and turn < 2e-4
    before = numbers(rows, ["before [mm]", "left [mm]", "sigma [mm]"]) * 1e-3
    assert np.sqrt(np.mean(before[:, 0] ** 2)) > 10 * position
    assert before[:, 1].max() < 1e-6
    assert 0.2 * position < np.sqrt(np.mean(before[:, 2] ** 2)) < 2 * position
    expected, radius = (numbers(rows, [name])[:, 0] * 1e-3 for name in ("expected [mm]", "interval95 [mm]"))
    assert position < np.sqrt(np.mean(expected**2)) and 0.7 < np.sqrt(np.mean(expected**2)) / unseen < 1.3
    sizes = np.linalg.norm(true_poses(cell, numbers(rows, Q))[:, :3, 3] - wanted[:, :3, 3], axis=1)
    assert np.mean(sizes <= radius) > 0.9
    assert f"expected error of the real arm at these targets: {1e3 * np.sqrt(np.mean(expected**2)):.3g} mm rms" in out


def test_targets_outside_range_are_worse(cell, fitted, here, calib):
    """Targets outside the measured range are named, and expected to be worse."""
    q = np.array([[0.5, -1.2, 1.3, 0.4, 0.9, 0.2], [3.0, -1.2, 1.3, 0.4, 0.9, 3.1]])
    write(here / "t.csv", Q, q)
    out = commanded(calib, fitted)
    near, far = commands()
    names = cell.nominal.joint_names
    assert (near["extrapolated"], near["reason"], far["extrapolated"]) == ("0", "", "1")
    assert far["reason"] == f"extrapolated: {names[0]}, {names[5]} outside the measured range"
    assert f"EXTRAPOLATED: 1 of 2 targets have joints outside the measured range ({names[0]}, " in out
    assert float(far["expected [mm]"]) > 1.2 * float(near["expected [mm]"])


@pytest.mark.parametrize(
    ("first", "code"), [(0.5, "expected-as-unseen"), (3.1, "expected-beyond-range")], ids=["inside", "outside"]
)
def test_missing_error_model_is_said(cell, fitted, here, first, code):
    """Where there is no error model, and where orientations are missing, it is said."""
    given = joint_commands.read(fitted)
    table = layout(given.cell)
    kept = [not table.names[k].endswith((".rx", ".ry", ".rz")) for k in given.free]
    known = dict(free=given.free[kept], covariance=given.covariance[np.ix_(kept, kept)], discrepancy=None)
    found = joint_commands.computed(replace(given, **known), Targets(np.array([[first, -1.2, 1.3, 0.4, 0.9, 0.2]])))
    said = " ".join(joint_commands.lines(found))
    assert "no orientations were measured" in said and catalogue()[code].says.split(":")[0] in said


def test_joint_targets_are_nominal_poses(cell, fitted, here, calib):
    """In the base that URDF users see: the calibrated flange, base to tip, stands where the nominal one would."""
    q = drawn(cell, 100, 6)
    write(here / "t.csv", [f"q{k + 1} [deg]" for k in range(6)], np.rad2deg(q))
    out = commanded(calib, fitted)
    assert "base frame of the calibrated robot" in out and "tool 'flange'" in out
    sent = np.deg2rad(numbers(commands(), [f"q{k + 1} [deg]" for k in range(6)]))
    found = joint_commands.read(fitted)
    goal = Goal(joint_commands.placements(found)[1])
    at = inverse.seen_at(goal, sent).poses()
    position, turn = off(at, forward(cell.nominal, q))
    assert position < 1e-7 and turn < 1e-7
    assert np.abs(sent - q).max() < 0.2


def test_the_robots_file_is_parsed_once(cell, fitted, here, calib, monkeypatch):
    parsed, parse = [], config.tomllib.loads
    monkeypatch.setattr(config.tomllib, "loads", lambda text: (parsed.append(text), parse(text))[1])
    write(here / "t.csv", Q, drawn(cell, 3, 7))
    commanded(calib, fitted)
    assert parsed == [(fitted / "robot.toml").read_text()]


@pytest.mark.slow
def test_nominal_frame_moves_the_arm_least(cell, fitted, here, calib):
    """Placed where it fits best, the nominal robot is off by what the fit reports as its error, and by no more."""
    write(here / "t.csv", Q, drawn(cell, 200, 7))
    metrics = json.loads((fitted / "metrics.json").read_text())["validation"]["seen.csv"]
    sizes, said = {}, {}
    for frame in ("base", "nominal"):
        said[frame] = commanded(calib, fitted, "--frame", frame, "--tool", "tool")
        sizes[frame] = np.sqrt(np.mean(numbers(commands(), ["before [mm]"]) ** 2))
    assert sizes["nominal"] == pytest.approx(metrics["nominal"]["position_mm"]["rms"], rel=0.2)
    assert sizes["nominal"] < sizes["base"]
    own = " ".join(said["nominal"].split()).split(" without compensation")[0].rpartition("targets: ")[2]
    assert f"({own} from the arm itself" in " ".join(said["base"].split()) and "the arm itself" not in said["nominal"]


@pytest.mark.slow
def test_positions_are_sought_near_a_start(cell, fitted, here, calib):
    """Positions alone are sought near a start."""
    q = drawn(cell, 8, 8) * 0.3 + np.array([0.0, -1.2, 1.5, -1.0, -1.4, 0.3])
    poses = forward(cell.nominal, q)
    write(here / "t.csv", ["x", "y", "z"], poses[:, :3, 3])
    start = "0,-1.2,1.5,-1,-1.4,0.3"
    out = commanded(calib, fitted, "--start", start)
    assert "position only" in out
    rows = commands()
    sent = numbers(rows, list(cell.nominal.joint_names))
    assert np.abs(sent - np.array([0.0, -1.2, 1.5, -1.0, -1.4, 0.3])).max() < 1.5
    assert all(row["left [mrad]"] == "" for row in rows)


@pytest.mark.slow
def test_tool_in_numbers_is_the_flange_moved(cell, fitted, here, calib):
    """A tool given by numbers is the flange moved."""
    q = drawn(cell, 30, 9)
    tool = from_xyz_rpy([0.1, 0.0, 0.2], [0.0, 0.5, 0.0])
    at_tool = forward(cell.nominal, q) @ tool
    write_poses(here / "tool.csv", at_tool, q)
    write(here / "flange.csv", Q, q)
    assert calib("compensate", fitted, "flange.csv", "--out", "a.csv")[0] == 0
    code, _, err = calib("compensate", fitted, "tool.csv", "--tool", "0.1,0,0.2,0,0.5,0", "--out", "b.csv")
    assert code == 0, err
    assert np.abs(numbers(commands("a.csv"), Q) - numbers(commands("b.csv"), Q)).max() < 1e-7


@pytest.mark.slow
def test_unreachable_stops_all_or_is_empty(cell, fitted, here, calib):
    """What is out of reach stops all, or is left empty."""
    q = drawn(cell, 3, 10)
    poses = forward(cell.nominal, q)
    poses[1, :3, 3] *= 3.0 / np.linalg.norm(poses[1, :3, 3])
    write_poses(here / "t.csv", poses, q)
    code, _, err = calib("compensate", fitted, "t.csv", "--out", "commands.csv")
    assert (code, Path("commands.csv").exists()) == (2, False)
    assert "1 of 3 targets" in err and "target 2: out of reach" in err and "--partial" in err
    code, out, err = calib("compensate", fitted, "t.csv", "--out", "commands.csv", "--partial")
    assert code == 0 and "2 of 3 commands" in out and "target 2" in out
    rows = commands()
    assert [row["status"] for row in rows] == ["reached", "not reached", "reached"]
    assert rows[1]["q1"] == "" and "out of reach" in rows[1]["reason"]


def test_joint_limits_are_kept(cell, fitted, here, calib):
    """A target at a limit: the command would go beyond, and says so; one beyond it is named as such."""
    limit = cell.nominal.upper[1]
    q = np.tile([0.3, 0.0, 1.2, 0.4, 1.1, 0.2], (3, 1))
    q[0, 1], q[1, 1], q[2, 1] = limit, -limit, limit + 0.1
    write(here / "t.csv", Q, np.vstack([q, drawn(cell, 5, 1)]))
    commanded(calib, fitted, "--partial")
    rows = commands()
    assert "outside the limits" in rows[2]["reason"]
    assert {rows[0]["status"], rows[1]["status"]} == {"reached", "not reached"}  # one of the two ends is inside
    assert any("at a limit" in row["reason"] for row in rows[:2])
    sent = numbers([row for row in rows if row["status"] == "reached"], Q)
    assert (sent <= cell.nominal.upper).all() and (sent >= cell.nominal.lower).all()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        pytest.param("q1,q2,q3,q4,q5,q6\n", "no data rows", marks=pytest.mark.slow),
        ("q1,q2,q3,q4,q5,q6\n0,0,nan,0,0,0\n", "row 1, column 'q3'"),
        ("q1,q2,q3,q4,q5,q6\n10,-90,90,0,45,90\n20,-80,90,0,45,90\n", "deg"),
        pytest.param("x,y,z\n500,200,300\n", "name the column 'x [mm]'", marks=pytest.mark.slow),
        pytest.param("x,y\n0.5,0.2\n", "column 'z'", marks=pytest.mark.slow),
        ("a,b,c\n1,2,3\n", "no targets found"),
        pytest.param("qx,qy,qz,qw\n0,0,0,1\n", "a target needs a position", marks=pytest.mark.slow),
        ("x,y,z,qx,qy,qz,qw\n0.4,0.1,0.3,0,0,0,2\n", "norm 2"),
        pytest.param("q1,q2,q3,q4,q5\n0,0,0,0,0\n", "column 'q6'", marks=pytest.mark.slow),
    ],
)
def test_bad_targets_are_refused(fitted, here, calib, text, said):
    (here / "t.csv").write_text(text)
    code, _, err = calib("compensate", fitted, "t.csv", "--out", "commands.csv")
    assert (code, Path("commands.csv").exists()) == (2, False)
    assert said in err


@pytest.mark.slow
def test_unsuited_folders_and_words_fail(fitted, here, calib):
    """Folders and words that do not serve are refused."""
    write(here / "t.csv", Q, np.zeros((1, 6)) + 0.5)
    (here / "empty").mkdir()
    (here / "half").mkdir()
    (here / "half" / "robot.toml").write_text((fitted / "robot.toml").read_text())
    for arguments, said in (
        (("empty", "t.csv"), "give the folder of a fit"),
        (("half", "t.csv"), "half is a robot; give the folder of a fit"),
        ((fitted, "none.csv"), "none.csv"),
        ((fitted, "t.csv", "--frame", "table"), "seen"),
        ((fitted, "t.csv", "--tool", "1,2"), "x,y,z"),
        ((fitted, "t.csv", "--dof", "4"), "expected 6, 5"),
        ((fitted, "t.csv", "--start", "1,2"), "6 finite numbers"),
        ((fitted, "t.csv", "--payload", "heavy"), "--payload heavy: expected a mass [kg], or mass,x,y,z [kg, m]"),
    ):
        code, _, err = calib("compensate", *arguments, "--out", "commands.csv")
        assert code == 2 and said in err, (arguments, err)
    code, _, err = calib("compensate", fitted, "t.csv", "--out", "t.csv")
    assert code == 2 and "t.csv is an input and would be overwritten" in err


@pytest.mark.slow
def test_one_or_repeated_targets_are_targets(fitted, here, calib):
    """One target, and the same one twice, are targets."""
    for count in (1, 3):
        write(here / "t.csv", Q, np.full((count, 6), 0.7))
        commanded(calib, fitted)
        assert len(commands()) == count


def test_target_file_reads_as_documented(here):
    """The file of targets reads as documented."""
    write(here / "t.csv", ["name", "x_target [mm]", "y_target [mm]", "z_target [mm]"], [[1, 400, 0, 500]])
    found = read_targets("t.csv", Q)
    assert found.ignored == ("name",) and found.q is None
    assert found.position.tolist() == [[0.4, 0.0, 0.5]]


CASES = [  # folder, robot, file, held-out share, goal [mm]
    ("motoman_leica", "model_right.urdf", "right_6x6x6_150.csv", 1 / 3, 0.075),
    pytest.param("ur5_gts3800", "model.urdf", "grid_800.csv", 0.25, 0.07, marks=pytest.mark.slow),
    pytest.param("ur10_ipa", "model.urdf", "A_grid_2500.csv", 0.4, 0.12, marks=pytest.mark.slow),
]


@pytest.mark.slow
@pytest.mark.parametrize(("folder", "robot", "file", "share", "goal"), CASES)
def test_measured_poses_give_their_joints(data, real_fit, capsys, folder, robot, file, share, goal):
    """Commands for measured poses are the joints they were measured at."""
    fitted = joint_commands.read(real_fit(folder, robot, file, share))
    robot, file = data / folder / robot, data / folder / file
    unseen = inputs.gather(robot, [file], settings=FitSettings(holdout=share)).unseen[file.name].block
    turns = from_quaternion(unseen.position, unseen.quaternion)[:, :3, :3] if isinstance(unseen, Poses) else None
    targets = Targets(unseen.q, unseen.position, turns, file=file.name)
    found = joint_commands.computed(
        fitted, targets, frame=unseen.station, tool=unseen.tool_names[0], tolerance=(1e-6, 1e-5)
    )
    arms = joint_commands.placements(fitted, unseen.station, unseen.tool_names[0])
    ruler = Goal(replace(arms[0], tools=arms[1].tools))
    stood = inverse.seen_at(ruler, unseen.q).poses()
    off = {
        name: np.linalg.norm(inverse.differences(ruler, q, stood)[:, :3], axis=1)[found.reached]
        for name, q in (("nominal", found.nominal), ("compensated", found.q))
    }
    rms = {name: 1e3 * np.sqrt(np.mean(sizes**2)) for name, sizes in off.items()}
    with capsys.disabled():
        print(
            f"\n  {folder} {file.name}, {int(found.reached.sum())} of {len(unseen)} held-out poses: "
            f"{rms['nominal']:.3f} mm with the nominal joints, {rms['compensated']:.4f} mm with the commands"
        )
    assert found.reached.mean() > 0.97
    assert rms["compensated"] < goal
    assert rms["compensated"] < 0.5 * rms["nominal"]
    # both are rms errors of the same rows; the commands' are of joints, by the nominal arm's levers
    assert rms["compensated"] == pytest.approx(1e3 * fitted.unseen, rel=0.15)


AT_FLANGE = ("--tool", "flange", "--user-frame", "0,0,0")  # which the program does not say
PROGRAM = """DEF part()
; PTP {{A1 1, A2 2, A3 3, A4 4, A5 5, A6 6}}
PTP {{A1 {0:.6f}, A2 {1:.6f}, A3 {2:.6f}, A4 {3:.6f}, A5 {4:.6f}, A6 {5:.6f}}} C_PTP
LIN {{X {6:.6f}, Y {7:.6f}, Z {8:.6f}, A {9:.6f}, B {10:.6f}, C {11:.6f}, S 2, T 35}} C_DIS
{more}END
"""


@pytest.mark.slow
def test_targets_in_a_program_are_rewritten(cell, fitted, here, calib):
    """A joint target becomes the command that meets it, a pose the one that the nominal robot has there."""
    q = drawn(cell, 20, 5)[:1]
    pose = forward(cell.nominal, q)
    values = [*np.degrees(q[0]), *pose_values(controller_named("krl"), pose)[0]]
    text = PROGRAM.format(*values, more="")
    (here / "part.src").write_text(text)
    near = ",".join(map(str, q[0]))
    code, _, err = calib("compensate", fitted, "part.src", "--out", "sent.src", "--start", near, *AT_FLANGE)
    assert code == 0, err
    found, before = read_program(here / "sent.src"), read_program(here / "part.src")
    assert found.rewritten([np.array(each.values) for each in before.targets]) == text.encode(), "nothing else changed"
    position, turn = off(forward(cell.nominal, found.joints()), found.poses())
    assert position < 3e-8 and turn < 1e-7, "both mean the same joints"
    write(here / "t.csv", Q, q)
    commanded(calib, fitted)
    np.testing.assert_allclose(found.joints(), numbers(commands(), Q), atol=2e-8)


@pytest.mark.slow
def test_unreached_target_has_its_line(cell, fitted, here, calib):
    """A target of a program that is not reached is named with its line."""
    q = np.degrees(drawn(cell, 20, 5)[0])
    text = PROGRAM.format(*q, 9e3, 0, 0, 0, 0, 0, more="PTP {A1 400, A2 0, A3 0, A4 0, A5 0, A6 0}\nPTP_REL {A1 5}\n")
    (here / "part.src").write_text(text)
    code, _, err = calib("compensate", fitted, "part.src", "--out", "sent.src", *AT_FLANGE)
    assert code == 2 and "--start" in err and "the first in line 4" in err
    near = ("--start", "0,-1,1,0,1,0", "--partial", *AT_FLANGE)
    code, out, err = calib("compensate", fitted, "part.src", "--out", "sent.src", *near)
    assert "warning: 4 moves, 3 targets" in out
    assert code == 0 and "1 of 3 targets written" in out and "target unchanged: line 4: " in out, err
    assert (here / "sent.src").read_text().split("\n")[3:] == text.split("\n")[3:]
    (here / "joints.src").write_text("\n".join(line for line in text.split("\n") if "LIN" not in line))
    code, _, err = calib("compensate", fitted, "joints.src", "--out", "no.src")
    assert code == 2 and "line 4: the target itself is outside the limits" in err
    assert not (here / "no.src").exists()


def test_saved_registers_are_no_program(fitted, tmp_path, capsys):
    """Registers that a controller saved are no program to compensate."""
    (tmp_path / "POSREG.VA").write_text(
        "[1,1] =   'P1'   Group: 1\n" + "  ".join(f"J{k} = 1.0 deg" for k in range(1, 7))
    )
    assert cli.run(["compensate", str(fitted), str(tmp_path / "POSREG.VA"), "--out", str(tmp_path / "o.VA")]) == 2
    assert "contains saved registers, not a program" in capsys.readouterr().err

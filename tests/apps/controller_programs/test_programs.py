"""Programs of poses for controllers: they read back as the poses, and are what other parsers can check."""

import ast
import csv
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from sessions import begin, edit

from calib import cli
from calib.apps.controller_programs.program import joints_in, joints_table, program_files
from calib.apps.controller_programs.program_settings import CSV, ProgramSettings
from calib.apps.controller_programs.targets import read_program
from calib.controllers.axes import check_controller, plain_axes
from calib.controllers.table import controller_named, controllers
from calib.data.poses.fit_options import FileOptions
from calib.data.poses.pose_files import read_measurements
from calib.data.recordings.recording_files import read_recording
from calib.data.recordings.recording_options import RecordingOptions
from calib.errors import MeasurementError, UsageError
from calib.procedure.session import geometry_steps
from calib.procedure.session.folder import open_session

PULSES = (1341.4, 1341.4, 1341.4, 1000.0, -1000.0, 622.0)
Q = np.radians(np.random.default_rng(3).uniform(-170.0, 170.0, (7, 6)))
READABLE = [name for name, each in controllers().items() if each.joints]


def listed(path: Path, q: np.ndarray) -> Path:
    """Write poses as `calib select` does."""
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([[f"joint{k + 1} [deg]" for k in range(q.shape[1])], *np.degrees(q).tolist()])
    return path


def written(folder: Path, name: str, q: np.ndarray = Q, **settings: object) -> dict[str, Path]:
    """Write a program of the poses; return its files by suffix."""
    texts = program_files(listed(folder / "p.csv", q), folder / "cal", name, ProgramSettings(**settings))  # type: ignore[arg-type]
    for path, text in texts.items():
        path.write_text(text)
    return {path.suffix: path for path in texts}


@pytest.mark.parametrize("output", [None, 0, 3])
@pytest.mark.parametrize("name", READABLE)
def test_a_program_reads_back_as_its_poses(tmp_path, name, output):
    one = controller_named(name)
    if output is not None and not one.outputs:
        return
    pulses = PULSES if one.pulses else ()
    files = written(tmp_path, name, output=output, pulses=pulses)
    path = next(path for suffix, path in files.items() if suffix != ".pgx")
    q, _ = joints_in(path, name, ProgramSettings(pulses=pulses))
    rounding = 0.5 * 10.0**-one.decimals * (np.pi / 180 if one.unit == "deg" else 1.0)
    rounding /= min(map(abs, pulses), default=1.0)
    assert np.abs(q - Q).max() <= 2.01 * rounding, "a coupled axis carries the rounding of two"


def test_fanuc_joint_3_is_from_horizontal(tmp_path):
    """A Fanuc counts joint 3 from the horizontal."""
    text = written(tmp_path, "fanuc", np.radians([[10.0, 20.0, 30.0, 0.0, 0.0, 0.0]]))[".ls"].read_text()
    assert "J3=    10.000 deg" in text, "30 of the description, less the 20 of joint 2"
    count = int(text.partition("LINE_COUNT\t= ")[2].partition(";")[0])
    assert text.partition("/MN\n")[2].partition("/POS")[0].count("\n") == count
    remarks = [line.partition("!")[2].rstrip("; ") for line in text.split("\n") if "!" in line]
    assert remarks and max(map(len, remarks)) <= 32


@pytest.mark.parametrize("name", ["ros2", "franka"])
def test_a_node_is_python_with_the_poses(tmp_path, name):
    q = np.linspace(-1.0, 1.0, 21).reshape(3, 7)
    tree = ast.parse(written(tmp_path, name, q)[".py"].read_text())
    values = {node.targets[0].id: node.value for node in tree.body if isinstance(node, ast.Assign)}
    np.testing.assert_allclose(ast.literal_eval(values["POSES"]), q, atol=5e-10)
    assert ast.literal_eval(values["JOINTS"])[6] == "joint7"


def test_val3_is_xml_and_names_its_data(tmp_path):
    """VAL3 files are XML whose program names the data."""
    found = written(tmp_path, "staubli", output=2)
    trees = {suffix: ElementTree.parse(path).getroot() for suffix, path in found.items()}
    data = {node.get("name"): node for node in trees[".dtx"].iter() if node.tag.endswith("}Data")}
    assert len(data["jPose"]) == len(Q) and data["jRead"].get("size") == str(len(Q))
    code = "".join(trees[".pgx"].itertext())
    assert all(name in code for name in data)
    assert {node.get("file") for node in trees[".pjx"].iter()} - {None} == {"start.pgx", "cal.dtx"}


def test_joints_that_a_kuka_kept_are_read(tmp_path):
    data = written(tmp_path, "krl")[".dat"]
    assert not joints_in(data)[0].any()
    data.write_text(data.read_text().replace("A2 0.0", "A2 -90.5", 1))
    assert joints_in(data)[0][0, 1] == pytest.approx(np.radians(-90.5))


def test_what_controller_refuses_is_named(tmp_path):
    """What a controller does not take is named."""
    path = listed(tmp_path / "p.csv", Q)
    seven = listed(tmp_path / "seven.csv", np.zeros((2, 7)))
    for words, given in {
        "controller 'kuka' is not one of": (path, tmp_path / "cal", "kuka"),
        "'my-poses' is no name for a program": (path, tmp_path / "my-poses", "krl"),
        "7 joints": (seven, tmp_path / "cal", "fanuc"),
    }.items():
        with pytest.raises(UsageError, match=words):
            program_files(*given)
    with pytest.raises(UsageError, match="the operator presses a key"):
        program_files(path, tmp_path / "cal", "ros2", ProgramSettings(output=1))
    (tmp_path / "empty.src").write_text("DEF empty()\n; PTP {A1 1,A2 2,A3 3,A4 4,A5 5,A6 6}\nPTP {A1 5}\nEND\n")
    with pytest.raises(MeasurementError, match="has no complete targets"):
        read_program(tmp_path / "empty.src")
    (tmp_path / "rail.csv").write_text("rail [mm],joint1 [deg]\n1,2\n")
    with pytest.raises(UsageError, match=r"of which rail slide.* takes 6 turning joints or the four of a SCARA"):
        program_files(tmp_path / "rail.csv", tmp_path / "cal", "krl")
    (tmp_path / "plain.csv").write_text("q1,q2\n1,2\n")
    with pytest.raises(UsageError, match="no column of joint angles"):
        program_files(tmp_path / "plain.csv", tmp_path / "cal", CSV)


def test_other_bytes_stay_when_rewritten(tmp_path):
    """Other bytes stay when targets are rewritten."""
    text = (
        b"MODULE m\r\n  ! \xe4lter [[1,2,3,4,5,6],[9E9,9E9,9E9,9E9,9E9,9E9]]\r\n"
        b"  CONST jointtarget a:=[[1,-2.50,3,4,5,6],[9E9,9E9,9E9,9E9,9E9,9E9]];\r\n"
        b"  PERS tooldata t:=[TRUE,[[1,2,3],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\r\n"
        b"  MoveL [[500.5,0,400],[0,0,1,0],[0,-1,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v100,fine,t;\r\nENDMODULE"
    )
    path = tmp_path / "m.mod"
    path.write_bytes(text)
    found = read_program(path)
    assert [(each.line, each.kind) for each in found.targets] == [(3, "joints"), (5, "pose")]
    assert found.rewritten([None, None]) == text
    new = found.rewritten([np.array([1.0, -2.25, 3.0, 4.0, 5.0, 6.0]), None])
    assert new == text.replace(b"-2.50", b"-2.250000")
    turned = found.poses()[0]
    np.testing.assert_allclose(turned[:3], [[-1, 0, 0, 0.5005], [0, 1, 0, 0], [0, 0, -1, 0.4]], atol=1e-15)


def test_moves_without_target_are_named(tmp_path, capsys):
    """A program that was edited by hand is brought back: a typing error leaves no pose out unnoticed."""
    path = written(tmp_path, "krl", np.radians([[10.0, 20.0, 30.0, 0.0, 0.0, 0.0], [0.0] * 6]))[".src"]
    text = path.read_text()
    path.write_text(text.replace("A2 20", "A2 2o"))
    (line,) = [number for number, own in enumerate(path.read_text().split("\n"), 1) if "2o" in own]
    assert cli.run(["program", str(path), "--for", "csv", "--out", str(tmp_path / "back.csv")]) == 0
    said = capsys.readouterr().out
    assert "2 moves, 1 targets" in said and f"named or incomplete, are not read (line {line})" in said
    path.write_text(text.replace("A2", "A2 x"))
    with pytest.raises(MeasurementError, match=f"its moves are in line {line}, "):
        read_program(path)


def test_a_yaskawa_gets_pulses(tmp_path):
    with pytest.raises(UsageError, match="pulses per degree of each of 6 axes"):
        written(tmp_path, "yaskawa")
    pulses = (1341.4, 1341.4, 1341.4, 1000.0, -1000.0, 622.0)
    text = written(tmp_path, "yaskawa", pulses=pulses)[".jbi"].read_text()
    rows = [line.partition("=")[2] for line in text.split("\n") if line.startswith("C0")]
    np.testing.assert_allclose(np.array([row.split(",") for row in rows], int), np.degrees(Q) * pulses, atol=0.5)
    assert text.count("MOVJ C0") == text.count("PAUSE") == len(Q) and f"///NPOS {len(Q)},0" in text


@pytest.mark.parametrize(("name", "cycle"), [("ur", 0.008), ("krl", 0.004), ("rapid", 0.004)])
def test_motion_becomes_cycle_setpoints(tmp_path, name, cycle):
    """A motion becomes setpoints at the controller's cycle."""
    t = np.arange(201) / 100.0

    def q(t: np.ndarray) -> np.ndarray:
        return 0.5 * np.sin(t[:, None] * np.arange(1, 7))

    head = ["t [s]", *(f"q_joint{k + 1} [rad]" for k in range(6)), "v_joint1 [rad/s]"]
    with (tmp_path / "motion.csv").open("w", newline="") as file:
        csv.writer(file).writerows([head, *np.column_stack([t, q(t), t]).tolist()])
    (text,) = program_files(tmp_path / "motion.csv", tmp_path / "move", name).values()
    lines = [line for line in text.split("\n") if line[:1].isdigit() or "servoj([" in line]
    found = [line.partition("[")[2].partition("]")[0] if name == "ur" else line for line in lines]
    values = np.array([row.split(",") for row in found], float)
    values = values if name == "ur" else np.radians(values[:, 1:7])
    np.testing.assert_allclose(values, q(cycle * np.arange(len(values))), atol=2e-5)
    assert len(values) == round(2.0 / cycle) + 1
    with pytest.raises(UsageError, match="takes no stream"):
        program_files(tmp_path / "motion.csv", tmp_path / "move", "fanuc")


@pytest.mark.slow
def test_session_writes_program_beside_poses(tmp_path):
    """A session writes the program beside the poses."""
    session = begin(tmp_path / "cell", "tx40", "tracker", poses=12, validation=4)
    edit(tmp_path / "cell/session.toml", 'controller = ""', 'controller = "krl"')
    geometry_steps.select(open_session(session.folder), lambda words: None)
    q, _ = joints_in(tmp_path / "cell/2-poses/poses.src")
    planned, _ = joints_in(tmp_path / "cell/2-poses/poses.csv")
    assert len(q) == 12 and np.abs(q - planned).max() < 1e-7
    assert (tmp_path / "cell/2-poses/validation_poses.dat").is_file()


def test_fanuc_log_has_description_joints(tmp_path):
    """A log of a Fanuc is read as the description's joints."""
    t = np.arange(400) / 100.0
    q = 0.5 * np.sin(t[:, None] * np.arange(1, 7))
    shown = plain_axes(6).shown(controller_named("fanuc"), q)
    head = ["t", *(f"q{k + 1} [deg]" for k in range(6)), *(f"tau{k + 1}" for k in range(6))]
    with (tmp_path / "log.csv").open("w", newline="") as file:
        csv.writer(file).writerows([head, *np.column_stack([t, shown, q]).tolist()])
    found = read_recording(tmp_path / "log.csv", options=RecordingOptions(controller="fanuc"))
    np.testing.assert_allclose(found.q, q, atol=1e-9)
    np.testing.assert_allclose(found.effort, q, atol=1e-9)


@pytest.mark.parametrize("joint", ["q", "J"])
def test_fanuc_poses_have_description_joints(tmp_path, joint):
    """From our columns, and from RoboDK's."""
    shown = plain_axes(6).shown(controller_named("fanuc"), Q)
    unit = " [deg]" if joint == "q" else ""
    head = [*(f"{joint}{k + 1}{unit}" for k in range(6)), *(("x [mm]", "y [mm]", "z [mm]") if unit else "XYZ")]
    with (tmp_path / "m.csv").open("w", newline="") as file:
        csv.writer(file).writerows([head, *np.column_stack([shown, 900.0 * np.sin(Q[:, :3])]).tolist()])
    names = [f"q{k + 1}" for k in range(6)]
    (found,) = read_measurements(tmp_path / "m.csv", names, FileOptions(controller="fanuc"))
    np.testing.assert_allclose(found.q, Q, atol=1e-9)
    with pytest.raises(UsageError, match="controller 'fanuk' is not one of"):
        read_measurements(tmp_path / "m.csv", names, FileOptions(controller="fanuk"))


def test_joints_kept_by_fanuc_are_mapped(tmp_path):
    """Joints that a Fanuc kept have their pose's numbers and are those of the description."""
    # As backups hold POSREG.VA: register 2 was not read, 3 is a pose of the tool.
    (tmp_path / "POSREG.VA").write_text(
        "[*POSREG*]$POSREG  Storage: CMOS  Access: RW  : ARRAY[1,4] OF Position Reg\n"
        "    [1,1] =   'a'   Group: 1\n  J1 =    10.000 deg   J2 =    20.000 deg   J3 =    30.000 deg \n"
        "  J4 =      .000 deg   J5 =    50.000 deg   J6 =   -60.000 deg \n\n    [1,2] =   '' Uninitialized\n"
        "    [1,3] =   '' \n  Group: 1   Config: N U T, 0, 0, 0\n  X:  1.000   Y: 2.000   Z: 3.000\n"
        "    [1,4] =   ''   Group: 1\n  J1 =     1.000 deg   J2 =     2.000 deg   J3 =     3.000 deg \n"
        "  J4 =     4.000 deg   J5 =     5.000 deg   J6 =     6.000 deg \n"
    )
    table = joints_table(tmp_path / "POSREG.VA")
    assert table.header == ("pose", "q1", "q2", "q3", "q4", "q5", "q6") and table.cells[0].tolist() == [1, 4]
    assert table.cells[3] == pytest.approx([50.0, 5.0]), "J3 counts from the horizontal"


def test_session_refuses_unfit_controller(tmp_path):
    """A session refuses a controller that does not take its arm."""
    for name, words in (("krl", "takes 6"), ("kr", "is not one of"), ("yaskawa", "takes 6")):
        with pytest.raises(UsageError, match=words):
            check_controller(name, 7)
    with pytest.raises(UsageError, match="pulses per degree"):
        check_controller("yaskawa", 6)

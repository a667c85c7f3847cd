"""Whatever is wrong with the input: one message that says where, exit code 2, and nothing half-written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from calib.data.poses.fit_options import FitOptions
from calib.errors import CalibError
from calib.procedure.kinematic_stage.inputs import load_robot

POSE = ["q1", "q2", "q3", "q4", "q5", "q6", "x", "y", "z", "qx", "qy", "qz", "qw"]


def degrees(rows):
    return [row | {f"q{j}": row[f"q{j}"] * 57.29578 for j in range(1, 7)} for row in rows]


def millimetres(rows):
    return [row | {axis: 1000.0 * row[axis] for axis in "xyz"} for row in rows]


def not_a_number(rows):
    rows[4]["y"] = float("nan")
    return rows


def short_quaternion(rows):
    for name in ("qx", "qy", "qz", "qw"):
        rows[2][name] *= 0.5
    return rows


def beyond_limits(rows):
    rows[5]["q2"] = 6.29
    return rows


def all_equal(rows):
    return [rows[0]] * len(rows)


def few(rows):
    return rows[:3]


@pytest.mark.parametrize(
    ("spoil", "columns", "words"),
    [
        (degrees, POSE[:9], ("row 1", "q1", "deg")),
        (millimetres, POSE[:9], ("row 1", "'x'", "mm")),
        (lambda rows: rows, [*POSE[:8]], ("'z'", "missing")),
        (lambda rows: rows, [*POSE[:2], *POSE[3:9]], ("'q3'", "missing")),
        (not_a_number, POSE[:9], ("row 5", "'y'")),
        (short_quaternion, POSE, ("row 3", "norm 0.5")),
        (beyond_limits, POSE[:9], ("row 6", "q2", "limits")),
        (all_equal, POSE[:9], ("same joint values",)),
        (few, POSE[:9], ("3 usable rows",)),
    ],
    ids=["degrees", "millimetres", "no z", "no q3", "nan", "quaternion", "limits", "equal poses", "three poses"],
)
def test_impossible_measurements(cell, calib, spoil, columns, words):
    file = cell.write("bad.csv", spoil(cell.measure(30)), columns)
    code, _, err = calib("fit", "ur5", file, "--out", "done")
    assert code == 2
    assert len(err.splitlines()) == 1
    assert "bad.csv" in err
    for word in words:
        assert word in err
    assert sorted(path.name for path in cell.folder.iterdir()) == ["bad.csv"]


def test_a_column_twice(cell, calib):
    file = cell.write("bad.csv", cell.measure(30))
    lines = file.read_text().splitlines()
    file.write_text("\n".join([lines[0] + ",q1", *(line + ",0" for line in lines[1:])]))
    code, _, err = calib("fit", "ur5", file, "--out", "done")
    assert (code, "q1" in err, "twice" in err) == (2, True, True)


def test_a_unit_that_is_stated_is_not_advised(cell, calib):
    rows = [{(f"{k} [deg]" if k[0] == "q" else k): v for k, v in row.items()} for row in degrees(cell.measure(30))]
    for row in rows:
        row["q1 [deg]"] *= 60.0
    code, _, err = calib("fit", "ur5", cell.write("bad.csv", rows, list(rows[0])[:9]), "--out", "done")
    assert (code, "read as [deg]" in err or "columns swapped" in err, "looks like" in err) == (2, True, False)


def test_some_numbered_columns_may_be_named_by_the_urdfs_joints(tmp_path):
    links = "".join(f'<link name="link_{k}"/>' for k in range(4))
    joints = "".join(
        f'<joint name="joint_{k + 1}" type="continuous"><parent link="link_{k}"/><child link="link_{k + 1}"/>'
        '<origin xyz="0.1 0 0.3"/><axis xyz="0 1 0"/></joint>'
        for k in range(3)
    )
    (tmp_path / "robot.urdf").write_text(f'<robot name="r">{links}{joints}</robot>')
    (tmp_path / "m.csv").write_text("q1,q2,q3,x,y,z\n")
    options = FitOptions(columns={"joint_2": "q3", "joint_3": "q2"})
    assert load_robot(tmp_path / "robot.urdf", tmp_path / "m.csv", options)[0].n == 3


def test_swapped_joint_columns_cannot_pass_unnoticed(cell, calib):
    rows = [row | {"q2": row["q3"], "q3": row["q2"]} for row in cell.measure(60)]
    code, out, _ = calib("fit", "ur5", cell.write("swapped.csv", rows), "--holdout", "0.3", "--out", "done")
    assert code == 1 or "no rigid geometry explains" in out


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("fit", "ur7", "a.csv", "--out", "done"), "ur7"),
        (("fit", "ur5", "missing.csv", "--out", "done"), "missing.csv"),
        (("fit", "ur5", "a.csv"), "--out"),
        (("fit", "ur5", "a.csv", "--out", "done", "--model", "magic"), "magic"),
        (("fit", "ur5", "a.csv", "--out", "done", "--loss", "huge"), "huge"),
        (("fit", "ur5", "a.csv", "--out", "done", "--holdout", "1.5"), "holdout: expected a share"),
        (("fit", "ur5", "a.csv", "--out", "done", "--stations", "two"), "stations: expected one of"),
        (("fit", "ur5", "a.csv", "--out", "done", "--options", "none.toml"), "none.toml"),
        (("fit", "ur5", "a.csv", "--out", "a.csv"), "is a file"),
        (("fit", "ur5", "a.csv", "--out", "done", "--base", "nowhere"), "nowhere"),
        (("select", "ur5", "--kind", "smell", "--out", "p.csv"), "smell"),
        (("select", "ur5", "--index", "O9", "--out", "p.csv"), "O9"),
        (("select", "ur5", "--tool", "1,2", "--out", "p.csv"), "tools: expected x,y,z"),
        (("export", "nowhere", "--offsets", "o.csv"), "nowhere"),
        (("export", "nowhere"), "nothing to write"),
        (("frobnicate",), "frobnicate"),
    ],
)
def test_impossible_commands(cell, calib, arguments, word):
    cell.write("a.csv", cell.measure(30))
    code, _, err = calib(*arguments)
    assert code == 2
    assert word in err
    assert "Traceback" not in err
    assert sorted(path.name for path in cell.folder.iterdir()) == ["a.csv"]


def test_too_few_poses_to_tell_the_parameters(cell, calib):
    code, _, err = calib("select", "ur5", "-m", "3", "--out", "p.csv")
    assert (code, "at least 5 poses" in err, Path("p.csv").exists()) == (3, True, False)


URDF = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/>
<joint name="q1" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="q2" type="revolute"><parent link="b"/><child link="c"/><origin xyz="1 0 0"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>{more}</robot>"""


@pytest.mark.parametrize(
    ("text", "options", "word"),
    [
        (URDF.format(more='<joint name="q3" type="fixed"><parent link="c"/><child link="b"/></joint>'), (), "b"),
        (URDF.format(more=""), ("--tip", "hand"), "hand"),
        (URDF.format(more="").replace("</robot>", ""), (), "robot.urdf"),
    ],
    ids=["loop", "no such link", "broken XML"],
)
def test_impossible_urdf(cell, calib, text, options, word):
    Path("robot.urdf").write_text(text)
    cell.write("a.csv", cell.measure(30), ["q1", "q2", "x", "y", "z"])
    code, _, err = calib("fit", "robot.urdf", "a.csv", *options, "--out", "done")
    assert (code, word in err, "Traceback" in err) == (2, True, False)
    assert not Path("done").exists()


def test_a_folder_that_holds_other_things_is_left_alone(cell, calib):
    file = cell.write("a.csv", cell.measure(40))
    Path("mine").mkdir()
    Path("mine/robot.urdf").write_text("mine")
    code, _, err = calib("fit", "ur5", file, "--model", "offsets", "--out", "mine")
    assert (code, "robot.urdf" in err) == (2, True)
    assert [path.name for path in Path("mine").iterdir()] == ["robot.urdf"]
    Path("mine/robot.urdf").rename("mine/thesis.txt")
    assert calib("fit", "ur5", file, "--model", "geometry", "--out", "mine")[0] == 0
    assert calib("fit", "ur5", file, "--model", "geometry", "--out", "mine")[0] == 0
    assert Path("mine/thesis.txt").read_text() == "mine"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder(cell, calib):
    file = cell.write("a.csv", cell.measure(40))
    Path("locked").mkdir(mode=0o500)
    code, _, err = calib("fit", "ur5", file, "--out", "locked/done")
    assert (code, "cannot write" in err) == (2, True)


def test_a_full_disk_in_the_middle_leaves_nothing(cell, calib, monkeypatch):
    from calib import files

    file, whole = cell.write("a.csv", cell.measure(40)), files.write_json

    def refuse(path, value):
        if Path(path).name == "metrics.json":
            raise CalibError(f"cannot write {path}: no space left on device")
        return whole(path, value)

    monkeypatch.setattr(files, "write_json", refuse)
    code, _, err = calib("fit", "ur5", file, "--model", "offsets", "--out", "done")
    assert (code, "no space left" in err) == (2, True)
    assert [path.name for path in cell.folder.iterdir()] == ["a.csv"]


def test_a_killed_fit_leaves_no_folder(cell):
    file = cell.write("a.csv", cell.measure(400))
    command = [sys.executable, "-m", "calib.cli", "fit", "ur5", str(file), "--out", "done"]
    process = subprocess.Popen(command, cwd=cell.folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    process.stdout.readline()  # it has read its input and is about to fit
    time.sleep(0.2)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not Path("done").exists()


def test_debug_shows_the_traceback(cell, calib, monkeypatch):
    """What leaves the command line as an exception, Python prints with its traceback."""
    arguments = ["fit", "ur7", "a.csv", "--out", "done"]
    code, _, err = calib(*arguments)
    assert (code, "Traceback" in err) == (2, False)
    monkeypatch.setenv("CALIB_DEBUG", "1")
    with pytest.raises(CalibError, match="ur7"):
        calib(*arguments)


def test_a_number_that_is_not_finite_is_never_written(tmp_path):
    from calib import files

    with pytest.raises(CalibError, match=r"fit\.rms\[1\] is not a finite number"):
        files.write_json(tmp_path / "a.json", {"fit": {"rms": [1.0, float("nan")]}})
    assert not list(tmp_path.iterdir())


def test_poses_copied_ten_times_are_twenty_poses(cell, calib):
    file, judged = cell.write("a.csv", 10 * cell.measure(20)), ("--deliverable", "corrections")
    code, out, err = calib("fit", "ur5", file, *judged, "--no-plots", "--out", "o")
    assert (code, "180 rows" in out, "verdict: pass" in out) == (0, True, False), err


@pytest.mark.parametrize("given", [("fit", "ur5", "pipe"), ("fit", "ur5", "a.csv", "--options", "pipe")])
def test_a_pipe_that_nobody_fills_is_refused(cell, calib, given):
    os.mkfifo("pipe")
    cell.write("a.csv", cell.measure(10))
    code, _, err = calib(*given, "--out", "o")
    assert (code, "pipe: cannot be read: is a pipe" in err) == (2, True), err


def test_what_is_refused_is_quoted_as_it_was_written(cell, calib):
    rows = [row | {f"sigma_{axis}": -1e-5 for axis in "xyz"} for row in cell.measure(20)]
    file = cell.write("a.csv", rows)
    code, _, err = calib("fit", "ur5", file, "--out", "o")
    assert (code, "found -1e-05" in err) == (2, True), err
    Path("o.toml").write_text('[sigma]\nposition = "1 mm"\n')
    code, _, err = calib("fit", "ur5", file, "--options", "o.toml", "--out", "o")
    assert (code, "found '1 mm'" in err) == (2, True), err

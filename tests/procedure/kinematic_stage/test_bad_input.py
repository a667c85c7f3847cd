"""Whatever is wrong with the input: one message that says where, exit code 2, and nothing half-written."""

import os
import re
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


def test_impossible_poses_leave_nothing(cell, calib):
    """What is wrong with them, and how it is said: tests/data/poses/test_bad_measurements.py."""
    good = cell.measure(30)
    for rows, columns, word in (
        (good, POSE[:8], "'z'"),
        (good[:3], POSE[:9], "3 usable rows"),
        (good[:1] * 9, POSE, "same"),
    ):
        code, _, err = calib("fit", "ur5", cell.write("bad.csv", rows, columns), "--out", "done")
        assert (code, len(err.splitlines()), "bad.csv" in err, word in err) == (2, 1, True, True), err
        assert sorted(path.name for path in cell.folder.iterdir()) == ["bad.csv"]


def test_stated_unit_is_not_advised(cell, calib):
    """A unit that is stated is not advised."""
    rows = [{(f"{k} [deg]" if k[0] == "q" else k): 57.3 * v for k, v in row.items()} for row in cell.measure(30)]
    for row in rows:
        row["q1 [deg]"] *= 60.0
    code, _, err = calib("fit", "ur5", cell.write("bad.csv", rows, list(rows[0])[:9]), "--out", "done")
    assert (code, "read as [deg]" in err or "columns swapped" in err, "looks like" in err) == (2, True, False)


def test_columns_may_be_named_by_urdf_joints(tmp_path):
    """Some numbered columns may be named by the URDF's joints."""
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


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("fit", "ur7", "a.csv", "--out", "done"), "ur7"),
        (("fit", "ur5", "missing.csv", "--out", "done"), "missing.csv"),
        (("fit", "ur5", "a.csv"), "--out"),
        (("fit", "ur5", "a.csv", "--out", "done", "--model", "magic"), "magic"),
        (("fit", "ur5", "a.csv", "--out", "done", "--loss", "huge"), "huge"),
        (("fit", "ur5", "a.csv", "--out", "done", "--holdout", "1.5"), "--holdout: expected a share"),
        (("fit", "ur5", "a.csv", "--out", "done", "--stations", "two"), "--stations: expected one of"),
        (("fit", "ur5", "a.csv", "--out", "done", "--options", "none.toml"), "none.toml"),
        (("fit", "ur5", "a.csv", "--out", "a.csv"), "is a file"),
        (("fit", "ur5", "a.csv", "--out", "done", "--base", "nowhere"), "nowhere"),
        (("select", "ur5", "--kind", "smell", "--out", "p.csv"), "smell"),
        (("select", "ur5", "--index", "O9", "--out", "p.csv"), "O9"),
        (("select", "ur5", "--tool", "1,2", "--out", "p.csv"), "--tool: expected x,y,z"),
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


def test_too_few_poses_for_the_parameters(cell, calib):
    """Too few poses to tell the parameters are refused."""
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


@pytest.mark.slow
def test_foreign_folder_is_unchanged(cell, calib):
    """A folder that holds other things is left alone."""
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


def test_full_disk_leaves_nothing(cell, calib, monkeypatch):
    """A disk that fills up in the middle leaves nothing."""
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


@pytest.mark.slow
def test_a_killed_fit_leaves_no_folder(cell):
    file = cell.write("a.csv", cell.measure(400))
    command = [sys.executable, "-m", "calib", "fit", "ur5", str(file), "--out", "done"]
    process = subprocess.Popen(command, cwd=cell.folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    process.stdout.readline()  # it has read its input and is about to fit
    time.sleep(0.2)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not Path("done").exists()


def test_infinite_number_is_never_written(tmp_path):
    """A number that is not finite is never written."""
    from calib import files

    with pytest.raises(CalibError, match=r"fit\.rms\[1\] is not a finite number"):
        files.write_json(tmp_path / "a.json", {"fit": {"rms": [1.0, float("nan")]}})
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_poses_copied_ten_times_are_twenty(cell, calib):
    """Poses copied ten times are twenty poses."""
    rows = cell.measure(20)
    cell.write("once.csv", rows)
    cell.write("copied.csv", 10 * rows)
    verdicts = []
    for name in ("once", "copied"):
        code, out, err = calib("fit", "ur5", f"{name}.csv", "--deliverable", "corrections", "--no-plots", "--out", name)
        assert code == 0, err
        verdicts.append(re.findall("verdict: .*", out))
    assert "180 rows (21, 22, 23, 24, 25, ...) identical to another row of the file: not counted again" in out
    assert verdicts[0] and verdicts[0] == verdicts[1]


@pytest.mark.parametrize("given", [("fit", "ur5", "pipe"), ("fit", "ur5", "a.csv", "--options", "pipe")])
def test_a_pipe_that_nobody_fills_is_refused(cell, calib, given):
    os.mkfifo("pipe")
    cell.write("a.csv", cell.measure(10))
    code, _, err = calib(*given, "--out", "o")
    assert (code, "pipe: cannot be read: is a pipe" in err) == (2, True), err


def test_refused_text_is_quoted_as_written(cell, calib):
    """What is refused is quoted as it was written."""
    rows = [row | {f"sigma_{axis}": -1e-5 for axis in "xyz"} for row in cell.measure(20)]
    file = cell.write("a.csv", rows)
    code, _, err = calib("fit", "ur5", file, "--out", "o")
    assert (code, "found -1e-05" in err) == (2, True), err
    Path("o.toml").write_text('[sigma]\nposition = "1 mm"\n')
    code, _, err = calib("fit", "ur5", file, "--options", "o.toml", "--out", "o")
    assert (code, "found '1 mm'" in err) == (2, True), err

"""External axes and SCARA in programs: written where a controller has them, read back in the description's order."""

from pathlib import Path

import numpy as np
import pytest

from calib import cli
from calib.apps.controller_programs.program import joints_in, program_files
from calib.apps.controller_programs.program_settings import CSV, ProgramSettings
from calib.apps.controller_programs.targets import read_program
from calib.controllers.axes import as_described, axes_of, named_joints
from calib.controllers.table import controller_named, controllers
from calib.data.poses.pose_lists import write_poses
from calib.errors import UsageError

PULSES = (1341.4, 1341.4, 1341.4, 1000.0, -1000.0, 622.0)
NUMBERED = [f"joint{k}" for k in range(1, 7)]
TURNING = ["revolute"] * 6
SUFFIXES = {"krl": ".src", "fanuc": ".ls", "rapid": ".mod", "staubli": ".dtx", "yaskawa": ".jbi", "ros2": ".py"}
SCARA = (["j1", "j2", "j3", "j4"], ["revolute", "revolute", "prismatic", "revolute"])
CELLS = {
    "rail": (["rail", *NUMBERED], ["prismatic", *TURNING]),
    "track behind": ([*NUMBERED, "track"], [*TURNING, "prismatic"]),
    "gantry": (["gx", "gy", *NUMBERED], ["prismatic", "prismatic", *TURNING]),
    "positioner": (["tilt", "turn", *NUMBERED], ["revolute", "revolute", *TURNING]),
    "rail and table": (["rail", *NUMBERED, "table"], ["prismatic", *TURNING, "revolute"]),
}
WITH_EXTERNAL = [name for name, entry in controllers().items() if entry.external]
WITH_SCARA = [name for name, entry in controllers().items() if entry.scara]


def poses(kinds: list[str]) -> np.ndarray:
    """Return five poses of joints of these kinds, of up to 150° or 2 m."""
    drawn = np.random.default_rng(5).uniform(-1.0, 1.0, (5, len(kinds)))
    return drawn * np.where(np.array(kinds) == "prismatic", 2.0, np.radians(150.0))


def written(folder: Path, name: str, names: list[str], kinds: list[str], **settings: object) -> Path:
    """Write a program of `poses`, and return its file with targets."""
    path = write_poses(folder / "p.csv", poses(kinds), names, kinds)
    if controller_named(name).pulses:
        settings["pulses"] = (*PULSES, 400.0, 400.0)[: len(names)]
    texts = program_files(path, folder / "cal", name, ProgramSettings(**settings))  # type: ignore[arg-type]
    for file, text in texts.items():
        file.write_text(text)
    return folder / f"cal{SUFFIXES[name.partition('-')[0]]}"


def read_back(path: Path, name: str, kinds: list[str], external: tuple[str, ...] = ()) -> tuple[np.ndarray, list[str]]:
    pulses = (*PULSES, 400.0, 400.0)[: len(kinds)] if controller_named(name).pulses else ()
    q, joints = joints_in(path, name, ProgramSettings(pulses=pulses, external=external))
    return q, [f"{joint.name}:{joint.kind}" for joint in joints]


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("name", WITH_EXTERNAL)
def test_external_axes_read_back_as_written(tmp_path, name, cell):
    names, kinds = CELLS[cell]
    q, joints = read_back(written(tmp_path, name, names, kinds), name, kinds)
    assert joints == [f"{joint}:{kind}" for joint, kind in zip(names, kinds)]
    assert np.abs(q - poses(kinds)).max() < (2e-3 if controller_named(name).pulses else 3e-5)


@pytest.mark.parametrize("group", [1, 2])
@pytest.mark.parametrize("name", ["fanuc", "yaskawa"])
def test_group_of_external_axes_is_chosen(tmp_path, name, group):
    names, kinds = CELLS["rail"]
    path = written(tmp_path, name, names, kinds, external_group=group)
    marks = {"fanuc": ("E1=", "GP2:"), "yaskawa": ("\nBC00000=", "\nEC00000=")}[name]
    text = path.read_text()
    assert (marks[0] in text, marks[1] in text) == (group == 1, group == 2)
    if name == "fanuc":
        assert ("DEFAULT_GROUP\t= 1,1,*" in text) == (group == 2)
    q, _ = read_back(path, name, kinds)
    assert np.abs(q - poses(kinds)).max() < 2e-3


def test_a_group_is_refused_where_programs_have_none(tmp_path):
    names, kinds = CELLS["rail"]
    with pytest.raises(UsageError, match=r"--external-group: programs for KUKA .* have no groups of axes"):
        written(tmp_path, "krl", names, kinds, external_group=2)


@pytest.mark.parametrize("name", WITH_SCARA)
def test_a_scara_reads_back_as_written(tmp_path, name):
    """Its axis 3 slides and is in mm; it is not coupled to axis 2."""
    path = written(tmp_path, name, *SCARA)
    q, joints = read_back(path, name, SCARA[1])
    assert [joint.partition(":")[2] for joint in joints] == SCARA[1]
    assert np.abs(q - poses(SCARA[1])).max() < (2e-3 if controller_named(name).pulses else 3e-5)
    if not controller_named(name).pulses:
        assert f"{1e3 * poses(SCARA[1])[0, 2]:.3f}" in path.read_text()


def test_foreign_programs_are_asked_for_units_once(tmp_path, capsys):
    """KRL does not say whether E1 is in mm or deg; a program in which it stays 0 needs no answer."""
    target = "PTP {{A1 1,A2 2,A3 3,A4 4,A5 5,A6 6,E1 {}}}\n"
    path = tmp_path / "foreign.src"
    path.write_text("DEF foreign()\n" + target.format(0.0) + "END\n")
    assert joints_in(path)[0].shape == (1, 6)
    path.write_text("DEF foreign()\n" + target.format(0.0) + target.format(1500.0) + "END\n")
    assert cli.run(["program", str(path), "--for", "csv", "--out", str(tmp_path / "o.csv")]) == 2
    assert "does not say whether E1 is in mm or deg: state it, --external 'E1 [mm]'" in capsys.readouterr().err
    q, joints = read_back(path, "krl", [], ("rail [mm]",))
    assert joints[-1] == "rail:prismatic" and q[:, 6].tolist() == [0.0, 1.5]
    (text,) = program_files(path, tmp_path / "o.csv", CSV, ProgramSettings(external=("rail [mm]",))).values()
    assert text.startswith("q1 [deg],") and "rail [mm]" in text.split("\n")[0] and ",1500" in text


def test_fanuc_units_behind_numbers_count(tmp_path):
    """Saved registers of a robot with a positioner in group 2 and a rail in group 1."""
    head = "    [1,1] =   ''\n   Group: 1\n  J1 = 10.000 deg J2 = 20.000 deg J3 = 30.000 deg\n"
    (tmp_path / "POSREG.VA").write_text(
        f"{head}  J4 = .000 deg J5 = 50.000 deg J6 = -60.000 deg E1 = 700.000 mm\n   Group: 2\n  J1 = 45.000 deg\n"
    )
    q, joints = joints_in(tmp_path / "POSREG.VA")
    assert [joint.kind for joint in joints] == [*TURNING, "prismatic", "revolute"]
    np.testing.assert_allclose(q[0, [2, 6, 7]], [np.radians(50.0), 0.7, np.radians(45.0)])


@pytest.mark.parametrize(
    ("name", "names", "kinds", "external", "words"),
    [
        (
            "krl",
            ["tilt", "turn", "base", "arm", "elbow", "roll", "bend", "twist"],
            ["revolute"] * 8,
            (),
            "state which joints are external, --external NAME",
        ),
        ("krl", [f"joint{k}" for k in range(1, 8)], ["revolute"] * 7, (), "7 joints .* takes 6 turning"),
        ("krl", CELLS["rail"][0], CELLS["rail"][1], ("joint1",), "are not such an arm"),
        ("krl", CELLS["rail"][0], CELLS["rail"][1], ("rial",), "joint 'rial' is not one of"),
        ("staubli", CELLS["rail"][0], CELLS["rail"][1], (), "of which rail slide.*no external axes in its programs"),
        ("ur", *SCARA, (), "takes 6 turning joints, and no external"),
    ],
)
def test_unclear_axes_are_refused_with_a_cure(name, names, kinds, external, words):
    with pytest.raises(UsageError, match=words):
        axes_of(controller_named(name), named_joints(names, kinds), external)


def test_stated_axes_are_external_in_their_order(tmp_path):
    names = ["tilt", "turn", "base", "arm", "elbow", "roll", "bend", "twist"]
    path = written(tmp_path, "krl", names, ["revolute"] * 8, external=("turn", "tilt [deg]"))
    q, joints = read_back(path, "krl", [])
    assert joints == [f"{joint}:revolute" for joint in names]
    np.testing.assert_allclose(q, poses(["revolute"] * 8), atol=1e-8)
    first = read_program(path, "krl").targets[0].values
    assert first[6:] == pytest.approx(np.degrees(poses(["revolute"] * 8)[0, [1, 0]]), abs=1e-6)


def test_coupling_is_that_of_the_arms_axes():
    """A rail before a FANUC's arm does not shift which joints are coupled; a SCARA has none."""
    values = np.arange(7.0)
    described = as_described("fanuc", values, named_joints(*CELLS["rail"]))
    np.testing.assert_allclose(described, values + np.array([0, 0, 0, 2.0, 0, 0, 0]))
    np.testing.assert_allclose(as_described("fanuc", values[:4], named_joints(*SCARA)), values[:4])


def test_a_ros_node_moves_a_rail_in_metres(tmp_path):
    text = written(tmp_path, "ros2", *CELLS["rail"]).read_text()
    assert f"[{poses(CELLS['rail'][1])[0, 0]:.9f}, " in text and "SPEEDS = [0.1000, 0.3142" in text


def test_a_motion_with_a_rail_is_streamed(tmp_path):
    t = np.arange(201) / 100.0
    q = 0.1 * np.sin(t[:, None] * np.arange(1, 8))
    head = ["t [s]", "q_rail [m]", *(f"q_{joint} [rad]" for joint in NUMBERED)]
    lines = [",".join(head), *(",".join(map(str, row)) for row in np.column_stack([t, q]))]
    (tmp_path / "motion.csv").write_text("\n".join(lines) + "\n")
    (text,) = program_files(tmp_path / "motion.csv", tmp_path / "move", "krl").values()
    heading, *rows = [line for line in text.split("\n") if line and not line.startswith("#")]
    assert heading.split(",")[6:8] == ["axis_6 [deg]", "E1 [mm]"]
    assert float(rows[25].split(",")[7]) == pytest.approx(1e3 * 0.1 * np.sin(0.1), abs=1e-3)

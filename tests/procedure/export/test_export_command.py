"""What `calib export` promises: the source's file with other joint origins, and nothing else changed."""

import csv
import re
import shutil
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
import yaml
from robot_oracle import axis, joint, robot
from without_figures import run

from calib import export
from calib.data.poses.measurements import PoseMeasurements
from calib.geometry.accuracy import errors
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.procedure.export.geometry import check_readback
from calib.procedure.kinematic_stage.mastering import read as read_mastering
from calib.robot.formats import urdf
from calib.robot.formats.urdf_write import write_new
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.transforms import from_xyz_rpy, to_xyz_rpy


@pytest.fixture(scope="module")
def fitted_folder(cell_in, tmp_path_factory) -> Path:
    """A folder with a source URDF with things that have to stay, and a fit of it."""
    cell = cell_in(tmp_path_factory.mktemp("fitted"))
    text = write_new(cell.nominal)
    text = text.replace("</robot>", '  <!-- mine -->\n  <transmission name="t"><type>x</type></transmission>\n</robot>')
    (cell.folder / "source.urdf").write_text(text)
    file = cell.write("a.csv", cell.measure(60))
    with chdir(cell.folder):
        assert run("fit", "source.urdf", file, "--model", "geometry", "--out", "done") == 0
    return cell.folder


@pytest.fixture
def fitted(cell, fitted_folder) -> Path:
    """The fit, in a copy of that folder which is the working folder."""
    shutil.copytree(fitted_folder, cell.folder, dirs_exist_ok=True)
    return Path("done")


def test_source_changes_in_origins_alone(cell, calib, fitted):
    """The source keeps everything but its joint origins."""
    code, out, err = calib("export", fitted, "--urdf", "source.urdf", "--out", "new.urdf")
    assert code == 0, err
    assert "base link, flange and all else are unchanged" in out
    before, after = (Path(name).read_text() for name in ("source.urdf", "new.urdf"))
    assert before != after
    assert re.sub(r"<origin [^>]*>", "", before) == re.sub(r"<origin [^>]*>", "", after)
    q = np.random.default_rng(1).uniform(-2, 2, (30, 6))
    assert np.abs(forward(urdf.read("new.urdf"), q) - forward(load(fitted), q)).max() < 1e-9
    kept = after.replace("</robot>", "<!-- mine --></robot>")
    for content, expected in ((after, 0), (kept, 2), (before, 2)):  # its own file again; edited since; a copy
        Path("new.urdf").write_text(content)
        assert calib("export", fitted, "--urdf", "source.urdf", "--out", "new.urdf")[0] == expected
    assert Path("new.urdf").read_text() == before


def test_pinocchio_reads_the_calibrated_arm(cell, calib, fitted):
    """Pinocchio reads the exported URDF as the calibrated arm."""
    pin = pytest.importorskip("pinocchio")
    assert calib("export", fitted, "--urdf", "source.urdf", "--out", "new.urdf")[0] == 0
    chain, model = load(fitted), pin.buildModelFromUrdf("new.urdf")
    data, tip = model.createData(), model.getFrameId(chain.tip)
    for q in np.random.default_rng(2).uniform(-2, 2, (10, 6)):
        pin.framesForwardKinematics(model, data, q)
        assert np.abs(data.oMf[tip].homogeneous - forward(chain, q[None])[0]).max() < 1e-9


@pytest.mark.slow
def test_table_fit_goes_into_a_urdf(cell, calib, fitted):
    """Also after a second fit that started from the first one's folder: the first nominal is remembered."""
    file = cell.write("b.csv", cell.measure(60, 3))
    assert calib("fit", "ur5", "a.csv", "--model", "geometry", "--out", "table")[0] == 0
    assert calib("fit", "table", file, "--model", "geometry", "--out", "again")[0] == 0
    for folder in ("table", "again"):
        code, _, err = calib("export", folder, "--urdf", "source.urdf", "--out", f"{folder}.urdf")
        assert code == 0, err
        q = np.random.default_rng(1).uniform(-2, 2, (30, 6))
        difference = forward(urdf.read(f"{folder}.urdf"), q) - forward(load(folder), q)
        assert np.abs(difference).max() < 1e-9


def test_another_robots_urdf_is_refused(cell, calib, fitted):
    Path("other.urdf").write_text(write_new(load("ur10")))
    code, _, err = calib("export", fitted, "--urdf", "other.urdf", "--out", "new.urdf")
    assert (code, "not describe the nominal robot" in err, Path("new.urdf").exists()) == (2, True, False)


@pytest.mark.slow
def test_offsets_are_those_of_a_fit_of_offsets_alone(cell, calib, fitted):
    """The table of a fit of the full geometry has the offsets of ``--model offsets``, and says so."""
    code, out, _ = calib("export", fitted, "--offsets", "offsets.csv")
    assert code == 0 and "of a fit of joint offsets alone: " in out
    assert calib("fit", "source.urdf", "a.csv", "--model", "offsets", "--out", "alone")[0] == 0
    with Path("offsets.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    chain, nominal = load("alone"), load("source.urdf")
    assert [row["joint"] for row in rows] == list(chain.joint_names)
    for row, k in zip(rows, chain.moving):
        assert float(row["add_to_reading"]) == pytest.approx(chain.values[k] - nominal.values[k], abs=1e-9)
        assert float(row["add_to_command"]) == -float(row["add_to_reading"])
    assert float(rows[0]["add_to_reading"]) == 0.0  # the first joint's offset cannot be told from the station
    assert calib("export", "alone", "--offsets", "same.csv")[0] == 0
    with Path("same.csv").open(newline="") as file:
        for row, same in zip(rows, csv.DictReader(file), strict=True):
            assert {key: float(row[key] or 0) for key in row if key not in ("joint", "unit")} == pytest.approx(
                {key: float(same[key] or 0) for key in row if key not in ("joint", "unit")}, rel=1e-4, abs=1e-9
            )


def test_offsets_serve_the_nominal_arm_better_than_those_of_the_full_geometry(cell, calib, fitted):
    """The true arm errs less from the nominal one with these offsets than with those of the full geometry."""
    nominal, full = load("source.urdf"), load(fitted)
    mastering = read_mastering(fitted)
    only_offsets = nominal.values.copy()
    only_offsets[full.moving] = full.values[full.moving]
    q = np.random.default_rng(8).uniform(-2.0, 2.0, (200, 6))
    truth = PoseMeasurements.of(q, forward(cell.truth, q)[:, :3, 3])

    def error(chain):
        start = install(chain, [truth])
        return errors(polish_frames(start, [truth]).cell, [truth]).rms

    full_offsets = error(nominal.with_values(only_offsets))
    assert error(mastering.cell.chain) < min(full_offsets, error(nominal))


@pytest.mark.slow
def test_offsets_are_left_out_with_the_reason(cell, calib, fitted):
    """Where frames alone were fitted there are no offsets: the export says so, and is still one."""
    assert calib("fit", "source.urdf", "a.csv", "--model", "frames", "--out", "placed")[0] == 0
    code, out, _ = calib("export", "placed", "--urdf", "source.urdf", "--into", "robot")
    assert code == 0 and "joint_offsets.csv: left out: offsets of the full geometry would be wrong" in out
    assert not Path("robot/joint_offsets.csv").exists() and Path("robot/robot.urdf").exists()
    assert calib("export", "placed", "--urdf", "source.urdf", "--into", "robot", "--overwrite")[0] == 0
    code, _, err = calib("export", "placed", "--offsets", "offsets.csv")
    assert code == 2 and "--model offsets" in err


def test_ur_kinematics_keep_calibrated_poses(cell, calib, fitted):
    """UR kinematics give the calibrated poses in the frames of ur_description."""
    assert calib("export", fitted, "--ur-kinematics", "kinematics.yaml")[0] == 0
    text = Path("kinematics.yaml").read_text()
    assert re.search(r"^  hash: calib_\d+$", text, re.MULTILINE)
    origins = {}
    for link, block in re.findall(r"^  (\w+):\n((?:    \w+: \S+\n){6})", text, re.MULTILINE):
        value = {key: float(number) for key, number in re.findall(r"(\w+): (\S+)", block)}
        origins[link] = from_xyz_rpy([value[k] for k in "xyz"], [value[k] for k in ("roll", "pitch", "yaw")])
    assert list(origins) == ["shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"]
    q = np.random.default_rng(4).uniform(-2, 2, (10, 6))
    poses = np.broadcast_to(np.eye(4), (10, 4, 4))
    for j, origin in enumerate(origins.values()):
        poses = poses @ origin @ from_xyz_rpy(np.zeros((10, 3)), np.outer(q[:, j], [0, 0, 1]))
    # base_link_inertia is the controller's base, wrist_3's link the controller's flange
    assert np.abs(poses - forward(load(fitted), q)).max() < 1e-9


def test_the_source_is_never_written_over(cell, calib, fitted):
    before = Path("source.urdf").read_bytes()
    Path("link.urdf").symlink_to("source.urdf")
    for arguments in (
        ("--out", "source.urdf"),
        ("--out", "link.urdf"),
        ("--out", "n.urdf", "--offsets", "source.urdf"),
    ):
        code, _, err = calib("export", fitted, "--urdf", "source.urdf", *arguments)
        assert (code, "source.urdf" in err or "link.urdf" in err) == (2, True)
    assert calib("export", fitted, "--urdf", "source.urdf", "--out", "n.urdf", "--offsets", "n.urdf")[0] == 2
    assert Path("source.urdf").read_bytes() == before and not Path("n.urdf").exists()


@pytest.mark.slow
@pytest.mark.parametrize("old", [pytest.param(False, marks=pytest.mark.slow), True])
def test_flange_is_outside_ur_kinematics(cell, calib, old):
    """A flange 0.109 m behind the last joint, as in ur10_ipa; URDFs of old have UR's own d6 there instead."""
    text, name = write_new(cell.nominal), "wrist_3_joint"
    plain = re.search(rf'<joint name="{name}".*?<origin xyz="([^"]+)" rpy="([^"]+)"', text, re.DOTALL)
    assert plain
    at = from_xyz_rpy(*([float(number) for number in plain[k].split()] for k in (1, 2)))
    behind = from_xyz_rpy([0, 0, 0.0823], [0, 0, 0])
    if old:
        xyz, rpy = to_xyz_rpy(at @ np.linalg.inv(behind))
        numbers = [" ".join(repr(float(value)) for value in part) for part in (xyz, rpy)]
        start, end = plain.span(1)[0], plain.span(2)[1]
        text = f'{text[:start]}{numbers[0]}" rpy="{numbers[1]}{text[end:]}'
    last = re.search(rf'<joint name="{name}".*?<child link="([^"]+)"', text, re.DOTALL)
    assert last
    mounted = f'<link name="plate"/><joint name="plate" type="fixed"><parent link="{last[1]}"/><child link="plate"/>'
    text = text.replace("</robot>", f'{mounted}<origin xyz="0 0 {0.0823 if old else 0.109}"/></joint></robot>')
    Path("plate.urdf").write_text(text)
    file = cell.write("a.csv", cell.measure(60))
    assert calib("fit", "plate.urdf", file, "--tip", "plate", "--model", "geometry", "--out", "done")[0] == 0
    code, out, err = calib("export", "done", "--ur-kinematics", "k.yaml")
    assert code == 0, err
    assert ("wrist_3 includes plate" if old else "the fixed joint to plate, 109 mm") in out
    wrist = re.findall(r"wrist_3:\n    x: (\S+)\n    y: (\S+)\n", Path("k.yaml").read_text())[0]
    assert float(wrist[1]) == pytest.approx(0.0823, abs=2e-3)


def test_other_axes_have_no_ur_kinematics(cell, calib):
    """An arm without UR axes has no UR kinematics."""
    from calib.procedure.export.ur_kinematics import kinematics
    from calib.robot.calibrated import CalibratedChain

    panda = load("panda")
    with pytest.raises(Exception, match="not have the axes of a UR arm"):
        kinematics(CalibratedChain(panda, panda))


def test_failed_result_exports_with_code_1(cell, calib, fitted):
    """A failed result is exported with its verdict and exit code 1."""
    code, _, _ = calib("fit", "source.urdf", "a.csv", "--holdout", "0.25", "--tolerance", "1e-6", "--model", "geometry",
                       "--out", "bad")  # fmt: skip
    assert code == 1
    code, out, _ = calib("export", "bad", "--into", "x")
    assert code == 1 and "verdict fail: geometry: " in out and "above the tolerance" in out
    assert Path("x/README.txt").read_text().startswith("verdict fail: ")
    assert "<!-- verdict fail" in Path("x/robot.urdf").read_text()
    code, out, _ = calib("export", "bad", "--urdf", "source.urdf", "--out", "one.urdf", "--offsets", "one.csv")
    assert code == 1 and "verdict fail" in out and "<!-- verdict fail" in Path("one.urdf").read_text()
    assert Path("one.csv").exists() and not Path("README.txt").exists()
    with pytest.warns(UserWarning, match="verdict fail: geometry"):
        assert export("bad", "x")[0].startswith("verdict fail")
    assert calib("export", fitted, "--into", "x")[0] == 0
    assert "verdict fail" not in Path("x/README.txt").read_text() + Path("x/robot.urdf").read_text()


@pytest.mark.slow
def test_marginal_result_exports_its_reason(cell, calib, fitted):
    """A marginal result is exported with what made it marginal."""
    rows = [row | {"q3": row["q3"] + 0.3} for row in cell.measure(60)]
    assert calib("fit", "source.urdf", cell.write("b.csv", rows), "--model", "geometry", "--out", "odd")[0] == 0
    code, out, _ = calib("export", "odd", "--into", "x")
    said = "verdict marginal: geometry: "
    ends, _, verdict = out.partition("\n")
    assert code == 0 and "the arm ends at" in ends and verdict.startswith(said)
    assert "fitted far from nominal: " in out and "do not use" not in out
    assert Path("x/README.txt").read_text().startswith(said)
    assert f"<!-- {said}" in Path("x/robot.urdf").read_text()
    code, out, _ = calib("export", "odd", "--urdf", "source.urdf", "--out", "one.urdf", "--ur-kinematics", "k.yaml")
    assert code == 0 and said in out and f"<!-- {said}" in Path("one.urdf").read_text()
    for name in ("k.yaml", "x/ur_kinematics.yaml"):
        assert Path(name).read_text().startswith(f"# {said}")
    assert yaml.safe_load(Path("k.yaml").read_text())["kinematics"]
    with pytest.warns(UserWarning, match=said):
        assert export("odd", "x")[0].startswith(said)
    assert calib("export", fitted, "--into", "x")[0] == 0
    assert (
        Path("x/README.txt").read_text().startswith("verdict pass: ")
        and "verdict" not in Path("x/robot.urdf").read_text()
    )


def test_link_and_joint_of_one_name():
    """As in Sawyer's description, whose last fixed joint is called as its link; here the moving ones, too."""
    source = robot(
        joint("one", "revolute", "base", "one", axis("0 0 1"), "0.1 0 0.2"),
        joint("two", "revolute", "one", "two", axis("0 1 0"), "0 0.2 0.3"),
        joint("hand", "fixed", "two", "hand", "", "0 0 0.1"),
    )
    chain = urdf.parse(source)
    assert chain.tip == "hand" and check_readback(source, "same names", chain).startswith("Pinocchio and yourdfpy read")

"""Poses in a FANUC's program stand in World, its user frame and its tool: as if moved to the arm's base by hand."""

from pathlib import Path

import numpy as np
import pytest

from calib import cli
from calib.apps.controller_programs.targets import pose_values, read_program
from calib.controllers.table import controller_named
from calib.robot.formats.urdf import parse
from calib.robot.kinematics import forward
from calib.simulation.cell import SimulatedInstrument, measure, write_measured
from calib.simulation.virtual_cells import perturbed_cell
from calib.transforms import from_xyz_rpy, invert, to_quaternion

FANUC = Path(__file__).parent / "fanuc_m20ia.urdf"
WORLD = from_xyz_rpy([0.0, 0.0, 0.525], [0.0, 0.0, 0.0])
TOOL = from_xyz_rpy([0.01, 0.05, 0.25], [0.0, 0.3, 0.1])
USER = from_xyz_rpy([0.9, -0.3, 0.1], [0.02, -0.01, 0.4])
Q = np.radians([[5.0, 20.0, 20.0, 10.0, -70.0, 15.0], [-30.0, 35.0, 5.0, -40.0, -50.0, 60.0]])


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A fit of a FANUC with errors in every element, and its nominal chain."""
    folder = tmp_path_factory.mktemp("poses")
    chain = parse(FANUC.read_text(), str(FANUC))
    cell = perturbed_cell(chain, 4, SimulatedInstrument(position_sigma=2e-5, orientation_sigma=5e-5))
    write_measured(measure(cell, np.random.default_rng(1).uniform(-1.2, 1.2, (40, 6)), 1), folder / "seen.csv")
    words = ["fit", FANUC, folder / "seen.csv", "--model", "geometry", "--no-plots", "--out", folder / "fit"]
    assert cli.run([str(word) for word in words]) == 0
    return folder / "fit", chain


def line(name: str, pose: np.ndarray) -> str:
    """Return a frame as `calib deliver` prints it for a FANUC."""
    values = pose_values(controller_named("fanuc"), pose[None])[0]
    return controller_named("fanuc").tool_frame.replace("UTOOL[{n}]", name).format(*(f"{v:.9f}" for v in values), n=1)


def program(chain, head: str = "UF : 1, UT : 2", configuration: str = "N U T, 0, 0, 0") -> str:
    """Return a program with the nominal arm's poses at Q."""
    poses = invert(WORLD @ USER) @ forward(chain, Q) @ TOOL
    text = "/PROG P\n/MN\n   1:L P[1] 100mm/sec FINE ;\n   2:L P[2] 100mm/sec FINE ;\n/POS\n"
    for number, v in enumerate(pose_values(controller_named("fanuc"), poses), 1):
        text += (
            f"P[{number}]{{\n   GP1:\n\t{head},\t\tCONFIG : '{configuration}',\n\tX = {v[0]:.6f}  mm,"
            f"\tY = {v[1]:.6f}  mm,\tZ = {v[2]:.6f}  mm,\n\tW = {v[3]:.6f} deg,\tP = {v[4]:.6f} deg,"
            f"\tR = {v[5]:.6f} deg\n}};\n"
        )
    return text + "/END\n"


def run(capsys, *words: object) -> tuple[int, str, str]:
    code = cli.run(["compensate", *map(str, words)])
    out, err = capsys.readouterr()
    return code, out, err


def test_poses_equal_those_moved_by_hand(fitted, tmp_path, capsys):
    """Poses are those moved to the arm's base by hand."""
    folder, chain = fitted
    (tmp_path / "p.ls").write_text(program(chain))
    (tmp_path / "frames.txt").write_text(f"{line('UTOOL[2]', TOOL)}\n{line('UFRAME[1]', USER)}\n")
    sent = tmp_path / "sent.ls"
    code, out, err = run(capsys, folder, tmp_path / "p.ls", "--frames", tmp_path / "frames.txt", "--out", sent)
    assert code == 0, err
    assert "UTOOL[2]: 10, 50, 250 mm" in out and "UFRAME[1]: 900, -300, 100 mm" in out
    assert "World (link base, 0.525 m above base_link)" in out

    poses = forward(chain, Q) @ TOOL
    xyz, quaternion = poses[:, :3, 3], to_quaternion(poses)
    header = [*(f"q{k}" for k in range(1, 7)), "x", "y", "z", "qx", "qy", "qz", "qw"]
    rows = [",".join(map(repr, map(float, row))) for row in np.hstack([Q, xyz, quaternion])]
    (tmp_path / "t.csv").write_text("\n".join([",".join(header), *rows, ""]))
    code, _, err = run(
        capsys, folder, tmp_path / "t.csv", "--tool", "0.01,0.05,0.25,0,0.3,0.1", "--out", tmp_path / "c.csv"
    )
    assert code == 0, err
    table = np.genfromtxt(tmp_path / "c.csv", delimiter=",", names=True)
    commands = np.column_stack([table[f"q{k}"] for k in range(1, 7)])
    expected = invert(WORLD @ USER) @ forward(chain, commands) @ TOOL
    np.testing.assert_allclose(read_program(sent).poses(), expected, atol=2e-8)
    assert np.abs(expected - read_program(tmp_path / "p.ls").poses()).max() > 1e-4, "there was something to compensate"


def test_gaps_of_program_named_or_stated(fitted, tmp_path, capsys):
    """What the program does not say is named, or stated."""
    folder, chain = fitted
    path, sent = tmp_path / "p.ls", tmp_path / "sent.ls"
    path.write_text(program(chain))
    code, _, err = run(capsys, folder, path, "--out", sent)
    assert code == 2 and not sent.exists()
    assert "tool UTOOL[2] (line 9" in err and "user frame UFRAME[1]" in err and "SYSFRAME.VA" in err
    statements = "--tool", "0.01,0.05,0.25,0,0.3,0.1", "--user-frame", "0.9,-0.3,0.1,0.02,-0.01,0.4"
    code, _, err = run(capsys, folder, path, "--out", sent, *statements)
    assert code == 0, err
    (tmp_path / "frames.txt").write_text(line("UTOOL[2]", TOOL))
    words = "--frames", tmp_path / "frames.txt", "--tool", "0,0,0.1", *statements[2:]
    code, _, err = run(capsys, folder, path, "--out", tmp_path / "no.ls", *words)
    assert code == 2 and "--tool states 0, 0, 100 mm" in err and "in the program's files" in err
    path.write_text(program(chain, "UF : F, UT : F"))
    code, _, err = run(capsys, folder, path, "--out", tmp_path / "no.ls")
    assert code == 2 and "the active tool" in err and "the active user frame" in err


@pytest.mark.slow
def test_foreign_configuration_is_said(fitted, tmp_path, capsys):
    """A configuration that is not the pose's is said with its line."""
    folder, chain = fitted
    path = tmp_path / "p.ls"
    path.write_text(program(chain, configuration="N U B, 0, 0, 0"))
    statements = "--tool", "0.01,0.05,0.25,0,0.3,0.1", "--user-frame", "0.9,-0.3,0.1,0.02,-0.01,0.4"
    code, _, err = run(capsys, folder, path, "--out", tmp_path / "no.ls", *statements)
    assert code == 2 and "CONFIG N U B 0 0 0 (behind axis 1" in err and "before axis 1" in err
    path.write_text(program(chain, configuration="N U T, 3, 0, 0"))
    code, _, err = run(capsys, folder, path, "--out", tmp_path / "no.ls", *statements)
    assert code == 2 and "none within the joints' limits has the stated turns" in err and "line 9: " in err
    near = ",".join(map(str, Q[0]))
    code, out, err = run(capsys, folder, path, "--out", tmp_path / "near.ls", "--start", near, *statements)
    assert code == 0 and "warning: line 9: CONFIG N U T 3 0 0 has no posture" in out, err
    path.write_text(program(chain, configuration=""))
    code, _, err = run(capsys, folder, path, "--out", tmp_path / "no.ls", *statements)
    assert code == 2 and "--start" in err

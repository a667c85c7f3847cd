"""Programs of a FANUC on a rail: compensated joint targets bring the tool to where the nominal arm would have it."""

from pathlib import Path

import numpy as np
import pytest

from calib import cli
from calib.apps.controller_programs.program import program_files
from calib.apps.controller_programs.targets import read_program
from calib.data.poses.pose_lists import write_poses
from calib.robot.chain import Chain, joint_kinds
from calib.robot.formats.urdf import parse
from calib.robot.kinematics import forward
from calib.robot.library import load_calibrated
from calib.simulation.cell import SimulatedInstrument, measure, write_measured
from calib.simulation.virtual_cells import perturbed_cell

FANUC = Path(__file__).parent / "fanuc_m20ia.urdf"
RAIL = """<link name="floor"/><joint name="rail" type="prismatic"><parent link="floor"/><child link="base_link"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="1" effort="100"/></joint></robot>"""


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> tuple[Path, Chain]:
    folder = tmp_path_factory.mktemp("rail")
    text = FANUC.read_text().replace("</robot>", RAIL)
    (folder / "cell.urdf").write_text(text)
    chain = parse(text, "cell.urdf", "floor", "tool0")
    cell = perturbed_cell(chain, 4, SimulatedInstrument(position_sigma=2e-5, orientation_sigma=5e-5))
    write_measured(
        measure(cell, np.random.default_rng(1).uniform(-1.2, 1.2, (50, 7)), 1), folder / "seen.csv", degrees=False
    )
    # the heading of the rail in metres
    seen = (folder / "seen.csv").read_text()
    (folder / "seen.csv").write_text(seen.replace("rail [rad]", "rail [m]"))
    words = ["fit", folder / "cell.urdf", folder / "seen.csv", "--base", "floor", "--tip", "tool0"]
    words += ["--model", "geometry", "--no-plots", "--out", folder / "fit"]
    assert cli.run([str(word) for word in words]) == 0
    return folder / "fit", chain


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fanuc", "krl"])
def test_joint_targets_on_a_rail_are_compensated(tmp_path, fitted, name):
    folder, chain = fitted
    q = np.random.default_rng(3).uniform(-0.8, 0.8, (4, 7))
    path = write_poses(tmp_path / "p.csv", q, chain.joint_names, joint_kinds(chain))
    program = tmp_path / {"fanuc": "cal.ls", "krl": "cal.src"}[name]
    for file, text in program_files(path, tmp_path / "cal", name).items():
        file.write_text(text)
    out = program.with_stem("sent")
    assert cli.run(["compensate", str(folder), str(program), "--frame", "base", "--out", str(out)]) == 0
    sent = read_program(out, "", chain.joints).joints()
    calibrated = load_calibrated(folder).chain
    nominal_error = np.linalg.norm((forward(calibrated, q) - forward(chain, q))[:, :3, 3], axis=1)
    error = np.linalg.norm((forward(calibrated, sent) - forward(chain, q))[:, :3, 3], axis=1)
    assert error.max() < 5e-5 < 5e-4 < nominal_error.max()


@pytest.mark.slow
def test_poses_of_an_arm_on_a_rail_are_refused(tmp_path, fitted, capsys):
    folder, _ = fitted
    program = tmp_path / "p.src"
    program.write_text("DEF p()\nLIN {X 1000, Y 0, Z 900, A 0, B 90, C 0, S 2, T 2, E1 500}\nEND\n")
    assert cli.run(["compensate", str(folder), str(program), "--out", str(tmp_path / "o.src")]) == 2
    assert "line 2: poses of an arm with external axes are not compensated" in capsys.readouterr().err


@pytest.mark.slow
def test_offsets_of_a_rail_are_in_millimetres(fitted, capsys):
    folder, _ = fitted
    assert cli.run(["deliver", str(folder), "--for", "krl"]) == 0
    printed = capsys.readouterr().out
    assert "E1: true position = shown position" in printed and "axis 6: true angle" in printed, printed

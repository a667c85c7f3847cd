"""What the README says can be done, can be done."""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib import cli
from calib.data.poses.fit_options import FitOptions
from calib.data.recordings.recording_files import read_recording
from calib.procedure.excitation import design
from calib.procedure.excitation.inputs import ExcitationInputs
from calib.procedure.excitation.settings import ExcitationSettings
from calib.procedure.kinematic_stage.inputs import read_file
from calib.procedure.robot_kinds import joints_of
from calib.robot.chain import random_joints
from calib.robot.formats import urdf_write
from calib.robot.library import load
from calib.simulation.cell import measure, write_log, write_measured
from calib.simulation.known_robots import random_fourier
from calib.simulation.virtual_arm import moving_arm, record
from calib.simulation.virtual_cells import virtual_cell

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
ARM = "rv2sq"  # six joints, whose motion is designed in half the time of seven
BLOCKS = re.findall(r"```sh\n(.*?)```", README, flags=re.DOTALL)
SCRIPTS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
TABLES = re.findall(r"```csv\n(.*?)```", README, flags=re.DOTALL)


def commands(block: str) -> list[list[str]]:
    """Return the arguments of every `calib` command in a block, comments left out."""
    lines = [shlex.split(line, comments=True) for line in block.splitlines()]
    return [line[1:] for line in lines if line and line[0] == "calib"]


@pytest.fixture
def at_a_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files the README speaks of, but logs."""
    cell, arm = virtual_cell(ARM, 1), load(ARM)
    (tmp_path / "robot.urdf").write_text(urdf_write.write_new(arm))
    write_measured(measure(cell, random_joints(arm, 60, 1), 2), tmp_path / "measured.csv")
    joints = ",".join(f"{name} [rad]" for name in arm.joint_names)
    np.savetxt(tmp_path / "targets.csv", 0.5 * random_joints(arm, 5, 2), delimiter=",", header=joints, comments="")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def with_logs(at_a_cell: Path) -> Path:
    """All files the README speaks of."""
    cell, arm = virtual_cell(ARM, 1), load(ARM)
    moves, speed = moving_arm(cell, ARM, 1), np.array([joint.velocity for joint in arm.joints])
    for seed, name in enumerate(("log", "other")):
        motion = random_fourier(0.6 * arm.lower, 0.6 * arm.upper, 0.6 * speed, 15.0, 1000.0, seed=seed)
        write_log(record(moves, motion, seed), at_a_cell / f"{name}.csv")
    return at_a_cell


@pytest.fixture
def short_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the design of a motion end after few evaluations of one start."""
    searched = design.search_motion

    def ended_soon(inputs: ExcitationInputs, settings: ExcitationSettings, *more: object) -> design.Designed:
        return searched(inputs, replace(settings, starts=1, evaluations=40), *more)

    monkeypatch.setattr(design, "search_motion", ended_soon)


def test_blocks_are_found_and_short() -> None:
    assert len(README.split()) <= 600 and len(BLOCKS) == 4
    assert [len(commands(block)) for block in BLOCKS] == [0, 3, 6, 0]
    assert "calib demo" in BLOCKS[0] and "pytest" in BLOCKS[3]
    assert len(SCRIPTS) == 1 and len(SCRIPTS[0].splitlines()) <= 10


def test_its_four_lines_of_files_are_read(tmp_path: Path) -> None:
    arm, paths = load("tx40"), (tmp_path / "measured.csv", tmp_path / "log.csv")
    for path, table in zip(paths, TABLES, strict=True):
        path.write_text(table)
    (block,) = read_file(paths[0], arm, FitOptions())
    assert len(block) == 3 and block.q[0, 0] == pytest.approx(np.deg2rad(167.177))
    head, *rows = TABLES[1].splitlines()
    longer = [f"{0.002 * k:.3f},{rows[k % 3].partition(',')[2]}" for k in range(120)]  # three are too few for filters
    paths[1].write_text("\n".join([head, *longer]))
    log = read_recording(str(paths[1]), joints_of(arm))
    assert log.kind == "torque" and log.effort.shape == (120, 6) and log.effort[0, 1] == 27.251


def test_figures_are_those_of_document() -> None:
    """The README's figures of real robots are those of the document."""
    document = (ROOT / "examples/real_recordings.md").read_text()
    figures = r"(\S+)[^|]* \| (\S+) \((\S+)\)"  # nominal, calibrated, and in brackets what no URDF holds
    rows = re.findall(rf"^\| (\w+), (?:tracker|torques|currents) \| {figures}", README, flags=re.MULTILINE)
    for robot, *stated in rows:
        found = re.findall(rf"^\| {robot}[ ,].*", document, flags=re.MULTILINE)
        measured = [figure for figure in stated if figure != "–"]
        assert any(all(figure in row for figure in measured) for row in found), robot
    assert len(rows) == 5


def test_its_commands_exist() -> None:
    named = set(re.findall(r"`?calib ([a-z]+)", README)) - {"only"}
    assert named <= set(cli.command_tree().commands) and "fit" in named


@pytest.mark.slow
def test_its_script_runs(with_logs: Path) -> None:
    exec(compile(SCRIPTS[0], "README.md", "exec"), {})
    assert (with_logs / "calibrated/robot.urdf").exists()


@pytest.mark.slow
def test_its_session_begins(at_a_cell: Path, capsys: pytest.CaptureFixture) -> None:
    for arguments in commands(BLOCKS[1]):
        assert cli.run(arguments) == 0, (arguments, capsys.readouterr())


@pytest.mark.slow
@pytest.mark.usefixtures("short_search")
def test_its_commands_run(with_logs: Path, capsys: pytest.CaptureFixture) -> None:
    for arguments in commands(BLOCKS[2]):
        assert cli.run(arguments) == 0, (arguments, capsys.readouterr())
    made = ("fit/certificate.html", "motion/trajectory.csv", "calibrated/robot.urdf", "commands.csv")
    assert all((with_logs / name).exists() for name in made)


def test_what_it_points_to_is_there() -> None:
    for target in re.findall(r"\]\(((?!https:)[^)]+)\)", README):
        assert (ROOT / target).exists(), target
    assert (ROOT / "LICENSE").exists() and (ROOT / "CHANGELOG.md").exists()

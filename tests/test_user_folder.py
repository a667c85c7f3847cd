"""A user's own modules may have any name: scripts beside a poses.py, robot.py or data.py work."""

import subprocess
import sys
from pathlib import Path

import pytest

NAMES = ("poses", "trajectories", "robot", "data", "geometry", "files", "errors", "units")
SCRIPT = """
import poses, trajectories, robot, data
import calib
arm = calib.load("tx40")
chosen = calib.select_poses(arm, 12, calib.SelectionSettings(candidates=40))
assert len(chosen.q) == 12 and poses.MINE and robot.MINE
assert calib.design_excitation.__module__ == "calib.api.motions"
import calib.trajectories.recall
from calib.cli import run
assert run(["new", "cell", "--robot", "tx40", "--instrument", "tracker"]) == 0
select = ["select", "tx40", "-m", "12", "--candidates", "40", "--method", "local", "--out", "p.csv", "--no-plots"]
assert run(select) == 0
raise SystemExit(run(["formats", "mdh"]))
"""


@pytest.mark.slow
def test_a_folder_with_a_users_modules(tmp_path: Path):
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text("MINE = True\n")
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_no_calib_module_has_two_names(tmp_path: Path):
    """In a checkout the folders poses and trajectories can be imported by accident, too, with other classes."""
    script = (
        "import sys; from calib.cli import run; run(['new', 'cell', '--robot', 'tx40', '--instrument', 'tracker']); "
    )
    script += "assert not {'poses', 'trajectories'} & {name.split('.')[0] for name in sys.modules}"
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr

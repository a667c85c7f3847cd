"""Without the extras the core calibrates; what is missing is said with the line that installs it."""

import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from calib import cli
from calib.errors import UsageError
from calib.robot.chain import random_joints
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.workers.extras import PACKAGES, available, installed, lacking, needing

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
# distributions whose modules have other names
MODULES = {"opencv-python-headless": "cv2", "rerun-sdk": "rerun", "pin": "pinocchio", "dask": "distributed"}
# what only stands behind the packages of extras
BEHIND = ("coal", "trimesh", "PIL", "toppra", "uvicorn", "dask")


def modules(extra: str) -> set[str]:
    """Return the modules that an extra's own requirements install."""
    names = {re.split(r"[\[>=;]", requirement)[0] for requirement in EXTRAS[extra]}
    return {MODULES.get(name, name) for name in names}


@pytest.mark.parametrize("module", PACKAGES)
def test_each_message_names_an_extra_that_installs_the_package(module):
    """The line of the message would install it."""
    assert module in modules(PACKAGES[module].extra)
    assert f"pip install 'armature-calib[{PACKAGES[module].extra}]'" in lacking(module)


def test_the_core_asks_for_none_of_them():
    """What `pip install .` installs contains no package of an extra."""
    core = {re.split(r"[\[>=;]", requirement)[0] for requirement in PROJECT["dependencies"]}
    assert not {MODULES.get(name, name) for name in core} & set(PACKAGES)


def test_readme_installs_everything_that_is_not_asked_for_by_name():
    """README's one command brings all extras but five, and none that asks for trimesh's own extras."""
    (requirement,) = EXTRAS["all"]
    combined = set(requirement.partition("[")[2].rstrip("]").split(","))
    by_name = {"all", "yourdfpy", "mujoco", "parquet", "pandas", "cluster", "study", "test", "docs"}
    assert combined == set(EXTRAS) - by_name
    assert 'pip install ".[all]"' in (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("module", PACKAGES)
def test_a_missing_package_is_named_with_its_line(module, monkeypatch, caplog):
    """An import that fails becomes a message for users, and its absence a line of the log."""
    monkeypatch.setitem(sys.modules, module, None)
    assert not installed(module)
    with pytest.raises(UsageError, match=re.escape(lacking(module))), needing(module):
        importlib.import_module(module)
    assert not available(module)
    assert caplog.messages == [f"warning: left out: {lacking(module)}"]


def test_boards_and_images_need_opencv(monkeypatch, tmp_path, capsys):
    """The command for boards says what to install."""
    for name in [name for name in sys.modules if name.startswith(("cv2", "calib.data.images", "calib.toolkit.boards"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert cli.run(["board", "--out", str(tmp_path / "board")]) == 2
    assert "pip install 'armature-calib[camera]'" in capsys.readouterr().err


@pytest.mark.slow
def test_the_core_alone_selects_fits_and_exports(tmp_path):
    """Without any extra: poses, a fit with certificate, an export; each says what it left out."""
    arm = load("tx40")
    q = random_joints(arm, 40, 0)
    header = [*arm.joint_names, "x", "y", "z"]
    noise = np.random.default_rng(0).normal(0.0, 1e-5, (40, 3))
    measured = forward(arm, q + 0.01 * np.arange(arm.n))[:, :3, 3] + noise
    rows = np.hstack([q, measured])
    np.savetxt(tmp_path / "measured.csv", rows, delimiter=",", header=",".join(header), comments="")
    absent = ",".join([*PACKAGES, *BEHIND])

    def run(*arguments: str, code: int = 0) -> str:
        script = ROOT / "tests/support/without_packages.py"
        command = [sys.executable, str(script), absent, *arguments]
        finished = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert finished.returncode == code, finished.stdout + finished.stderr
        return finished.stdout + finished.stderr

    said = run("select", "tx40", "-m", "12", "--out", "poses.csv")
    assert "matplotlib" not in said and (tmp_path / "poses_figures.html").exists()
    run("fit", "tx40", "measured.csv", "--holdout", "0.25", "--plots", "svg", "--out", "fit")
    assert (tmp_path / "fit/plot_position.svg").exists() and "data-figure" in (tmp_path / "fit/report.html").read_text()
    assert (tmp_path / "fit/certificate.html").exists() and not (tmp_path / "fit/certificate.pdf").exists()
    said = run("fit", "tx40", "measured.csv", "--plots", "png", "--out", "drawn", code=2)
    assert "armature-calib[plots]" in said and "without it: --plots svg" in said
    said = run("certificate", "fit")
    assert "certificate.pdf was not written; typst, for the certificate as PDF, is not installed" in said
    said = run("export", "fit", "--into", "export")
    assert "[meshes]" in said and "[pdf]" not in said

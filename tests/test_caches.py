"""Where home and package are read-only, compiled kernels and fonts are kept in a temporary folder of this user."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from calib.workers import caches

NOWHERE = "/dev/null/home"  # cannot be made, not even by root


@pytest.fixture
def read_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package that is not writable, a user without home, and a temporary folder, which is returned."""
    package, temporary = tmp_path / "package", tmp_path / "temporary"
    (package / "dynamics").mkdir(parents=True)
    (package / "dynamics/kernels.py").touch()
    (package / "dynamics/__pycache__").touch()  # a file: no folder can be made
    temporary.mkdir()
    for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    # set first, so that what the test makes of them is undone
    for name in ("NUMBA_CACHE_DIR", "MPLCONFIGDIR"):
        monkeypatch.setenv(name, "")
    monkeypatch.setenv("HOME", NOWHERE)
    monkeypatch.setattr(caches, "PACKAGE", package)
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    monkeypatch.setitem(sys.modules, "numba", None)
    return temporary


def chosen() -> tuple[str, str]:
    caches.provide()
    return os.environ["NUMBA_CACHE_DIR"], os.environ["MPLCONFIGDIR"]


def test_both_caches_get_a_lasting_folder(read_only: Path) -> None:
    """Both caches get a folder of this user alone, and it stays."""
    numba, matplotlib = chosen()
    assert Path(numba).is_dir() and Path(matplotlib).is_dir() and numba != matplotlib
    parent = Path(numba).parent
    assert parent.parent == read_only and parent.stat().st_mode & 0o077 == 0
    os.environ["NUMBA_CACHE_DIR"] = os.environ["MPLCONFIGDIR"] = ""
    assert chosen() == (numba, matplotlib)


def test_code_others_may_write_is_not_loaded(read_only: Path) -> None:
    """Code that others may have written is not loaded."""
    public = read_only / caches.FOLDER.format(user=os.getuid())
    public.mkdir()
    public.chmod(0o777)
    numba, _ = chosen()
    assert Path(numba).is_dir() and public not in Path(numba).parents


def test_writable_folders_stay_as_they_are(read_only: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as home:
        home.setenv("HOME", str(tmp_path))
        assert chosen() == ("", "")
    (tmp_path / "package/dynamics/__pycache__").unlink()
    numba, matplotlib = chosen()
    assert numba == "" and matplotlib, "numba keeps its kernels beside their sources"


def test_what_the_user_sets_counts(read_only: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "mine")
    monkeypatch.setenv("MPLCONFIGDIR", "mine, too")
    assert chosen() == ("mine", "mine, too")
    assert not list(read_only.iterdir())


@pytest.mark.slow
def test_kernels_of_a_read_only_package_load(tmp_path: Path) -> None:
    """In a process of its own, with a copy of the package in which no cache can be made."""
    package = tmp_path / "calib"
    shutil.copytree(caches.PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    for source in package.rglob("*kernels.py"):
        (source.parent / "__pycache__").touch()
    settings = {"HOME": NOWHERE, "PYTHONPATH": str(tmp_path), "TMPDIR": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "NUMBA_", "MPL"))}
    code = "import calib.robot.capsule_kernels as kernels; print(kernels.__file__)"
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment | settings, cwd=tmp_path, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == str(package / "robot/capsule_kernels.py") and not run.stderr

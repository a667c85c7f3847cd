"""Result folders: whose files may be replaced, and what a killed run leaves."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from calib import files, folders
from calib.errors import CalibError, RobotError, UsageError
from calib.folders import METRICS, check_target, write_staged


def test_read_or_foreign_files_stay(tmp_path: Path) -> None:
    """Nothing is written over what is read, or is not ours."""
    out = tmp_path / "out"
    check_target(out, (METRICS, "a.csv"), (METRICS,), "fit", [tmp_path / "log.npz"])
    out.mkdir()
    (out / "a.csv").write_text("mine")
    with pytest.raises(UsageError, match="not from an earlier fit"):
        check_target(out, (METRICS, "a.csv"), (METRICS,), "fit")
    (out / METRICS).write_text("{}")
    check_target(out, (METRICS, "a.csv"), (METRICS,), "fit")
    with pytest.raises(UsageError, match=r"a\.csv is an input"):
        check_target(out, (METRICS, "a.csv"), (METRICS,), "fit", [f"{out / 'a.csv'}@0:9"])


def test_only_killed_runs_leftovers_go(tmp_path: Path) -> None:
    """Leftovers of killed runs go, and those of living ones stay."""
    gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    dead, living = int(gone.stdout), os.getpid()
    kept = {".out.b.7.x3.part", f".out.{living}.x2.part", f".a.csv.{living}.x.part"}
    for name in (f".out.{dead}.x1.part", f".a.csv.{dead}.x.part", *kept):
        (tmp_path / name).touch() if "csv" in name else (tmp_path / name).mkdir()
    write_staged(tmp_path / "out", (METRICS,), lambda folder: (folder / METRICS).touch())
    files.write(tmp_path / "a.csv", "1")
    assert {path.name for path in tmp_path.iterdir()} == kept | {"out", "a.csv"}
    assert (tmp_path / "out" / METRICS).exists()


def test_stale_figures_go_unless_of_others(tmp_path: Path) -> None:
    """Figures of others stay, and stale ones of ours go."""
    ours = (METRICS, "plot_torque_[0-9]*.png", "plot_map.png")
    for name in (METRICS, "plot_mine.png", "plot_torque_12.png", "plot_map.png", "plot_torque_mine.png"):
        (tmp_path / name).touch()
    write_staged(tmp_path, ours, lambda folder: (folder / METRICS).touch())
    assert sorted(path.name for path in tmp_path.iterdir()) == [METRICS, "plot_mine.png", "plot_torque_mine.png"]
    (tmp_path / "plot_map.png").touch()
    (tmp_path / METRICS).unlink()
    with pytest.raises(UsageError, match=r"contains plot_map\.png"):
        check_target(tmp_path, ours, (METRICS,), "fit")


def test_dangling_links_are_no_targets(tmp_path: Path) -> None:
    """Links that lead nowhere are no targets."""
    for name, aim in (("dangling", "absent"), ("loop", "loop")):
        (tmp_path / name).symlink_to(tmp_path / aim)
        with pytest.raises(UsageError, match=name):
            check_target(tmp_path / name, (METRICS,), (METRICS,), "fit")
    with pytest.raises(UsageError, match="too long"):
        files.check_target(tmp_path / ("x" * 300), [])


def test_covariance_returns_by_any_names(tmp_path: Path) -> None:
    """A covariance comes back by names of any kind."""
    names = ("plain", 'day1, "left"\nof it', "ü")
    matrix = np.diag([1.0, 2.0, 3.0])
    path = tmp_path / folders.COVARIANCE
    folders.write_covariance(path, names, matrix)
    found = folders.read_covariance(tmp_path)
    assert found[0] == names and np.array_equal(found[1], matrix)
    path.write_text(path.read_text().replace("ü,", "u,", 1))
    with pytest.raises(RobotError, match="parameter names of rows and columns differ"):
        folders.read_covariance(tmp_path)


def test_grouped_files_appear_together(tmp_path: Path) -> None:
    """Files written together appear together."""
    with pytest.raises(CalibError, match="nothing was changed"), files.together():
        files.write(tmp_path / "a.csv", "1")
        (tmp_path / "file").touch()
        files.write(tmp_path / "file" / "b.csv", "2")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    with files.together():
        files.write(tmp_path / "a.csv", "1")
        assert not (tmp_path / "a.csv").exists()
        files.write(tmp_path / "b.csv", "2")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "b.csv", "file"]


@pytest.mark.parametrize("mark", [METRICS, "session.toml"])
def test_foreign_result_folder_is_refused(mark, tmp_path: Path) -> None:
    """The folder of another result or a session is refused."""
    (tmp_path / mark).touch()
    with pytest.raises(UsageError, match=f"contains {mark}"):
        check_target(tmp_path, ("robot.urdf",), (), "export")


def test_an_error_names_the_folder_asked_for(tmp_path: Path) -> None:
    def write(folder: Path) -> None:
        raise CalibError(f"cannot write {folder / 'a.csv'}")

    with pytest.raises(CalibError) as caught:
        write_staged(tmp_path / "out", (METRICS,), write)
    assert str(caught.value) == f"cannot write {tmp_path / 'out' / 'a.csv'}"


WRITING = """
import time
from pathlib import Path

from calib import cli
from calib.cli import signals
from calib.folders import write_staged


def fill(folder):
    (folder / "estimate.csv").write_text("half")
    print("writing", flush=True)
    for _ in range({lost_exits}):
        try:
            time.sleep(60.0)
        except SystemExit:  # as a library whose callback is running
            pass
    time.sleep(60.0)


signals.EXIT_AGAIN = 0.2
cli._spread = list
cli.command_tree = lambda: lambda **arguments: write_staged(Path("out"), (), fill)
cli.main()
"""


LOSING = """
import signal
import time

from calib import cli


def compile_kernel():
    print("compiling", flush=True)
    try:
        time.sleep(60.0)
    except KeyboardInterrupt:  # as in a callback of ctypes
        pass
    raise RuntimeError("no compiled object yet")


cli._spread = list
cli.command_tree = lambda: lambda **arguments: compile_kernel()
cli.main()
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows ends a process without a signal")
def test_an_error_of_a_library_that_lost_ctrl_c_is_an_interruption(tmp_path: Path) -> None:
    """As of Numba, when Ctrl-C meets the compilation of a kernel: no internal error, no bug report."""
    command = subprocess.Popen(
        [sys.executable, "-c", LOSING, "fit"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert command.stdout is not None and command.stdout.readline() == "compiling\n"
    command.send_signal(signal.SIGINT)
    _, errors = command.communicate(timeout=30)
    assert command.returncode == 130 and "interrupted" in errors and "internal error" not in errors
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="Windows ends a process without a signal")
@pytest.mark.parametrize("lost_exits", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_terminated_command_leaves_no_staged_folder(tmp_path: Path, lost_exits: int) -> None:
    """Not even where a library loses the exit that the signal raised in its callback."""
    program = WRITING.format(lost_exits=lost_exits)
    command = subprocess.Popen(
        [sys.executable, "-c", program, "fit"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert command.stdout is not None and command.stdout.readline() == "writing\n"
    assert [path.suffix for path in tmp_path.iterdir()] == [".part"]
    command.terminate()
    _, errors = command.communicate(timeout=30)
    assert command.returncode == 143 and "no incomplete files were left" in errors
    assert list(tmp_path.iterdir()) == []

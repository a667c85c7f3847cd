"""What stands against Windows, as far as Linux can tell: modules and calls that it lacks, encodings, locks, quoting."""

import ast
import os
import re
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from calib import files
from calib.config import read_toml
from calib.errors import UsageError, command_line
from calib.workers import caches, processes

ROOT = Path(__file__).parents[1]
SOURCES = sorted(path for name in ("calib", "poses", "trajectories") for path in (ROOT / name).rglob("*.py"))
# modules and functions that Python has on POSIX alone
POSIX_MODULES = {"fcntl", "resource", "termios", "tty", "pty", "pwd", "grp", "curses", "readline", "syslog"}
POSIX_CALLS = (
    (os, ("getuid", "geteuid", "killpg", "getpgid", "setsid", "fork")),
    (signal, ("pthread_sigmask", "SIGKILL", "SIGHUP", "setitimer", "alarm")),
)
# functions that take an encoding, and the position of the mode among their arguments
OPENING = {"open": 0, "read_text": None, "write_text": None}


def calls(tree: ast.AST) -> list[ast.Call]:
    """Return the calls of methods or functions that open text files."""
    found = []
    for node in ast.walk(tree):
        name = getattr(getattr(node, "func", None), "attr", getattr(getattr(node, "func", None), "id", ""))
        if isinstance(node, ast.Call) and name in OPENING:
            found.append(node)
    return found


def opens_text_without_encoding(node: ast.Call) -> bool:
    """Return whether a call opens a text file in the system's encoding."""
    texts = [argument.value for argument in node.args if isinstance(argument, ast.Constant)]
    modes = [text for text in texts if isinstance(text, str) and set(text) <= set("rwabxt+")]
    is_binary = any("b" in mode for mode in modes)
    is_text = (
        getattr(node.func, "attr", "open") != "open" or modes or any(word.arg == "newline" for word in node.keywords)
    )
    has_encoding = any(word.arg in ("encoding", None) for word in node.keywords)
    return bool(is_text) and not is_binary and not has_encoding


def test_text_files_have_an_encoding():
    """No text file is opened in the system's encoding, which is no UTF-8 on Windows."""
    complaints = []
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        # parsing all modules takes seconds
        if any(name in text for name in OPENING):
            lines = [node.lineno for node in calls(ast.parse(text)) if opens_text_without_encoding(node)]
            complaints += [f"{path}, line {line}" for line in lines]
    assert complaints == []


def test_calls_without_encoding_are_seen():
    """The measure sees what it is for."""
    opened = ["open(a, 'w')", "a.read_text()", "a.open('r')", "open(a, newline='')"]
    sound = ["open(a, 'wb')", "a.read_text(encoding='utf-8')", "archive.open(name)", "open(**words)"]
    assert all(opens_text_without_encoding(node) for text in opened for node in calls(ast.parse(text)))
    assert not any(opens_text_without_encoding(node) for text in sound for node in calls(ast.parse(text)))


def test_no_module_needs_posix_when_it_is_loaded():
    """Modules that Windows lacks are imported in functions only."""
    # an import of several lines names its module in the first one, or several names of it
    importing = re.compile(rf"^(?:import|from)\b.*\b(?:{'|'.join(sorted(POSIX_MODULES))})\b", re.MULTILINE)
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        if not importing.search(text):
            continue
        for node in ast.parse(text).body:
            names = {alias.name for alias in node.names} if isinstance(node, ast.Import) else set()
            names |= {node.module} if isinstance(node, ast.ImportFrom) else set()
            assert not names & POSIX_MODULES, f"{path}, line {node.lineno}"


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[tuple[int, int]]:
    """Let this Python look like one on Windows: without POSIX's calls, with msvcrt's locks; return the locks."""
    locks: list[tuple[int, int]] = []

    def locking(number: int, mode: int, count: int) -> None:
        position = os.lseek(number, 0, os.SEEK_CUR)
        status = os.fstat(number)
        if (status.st_ino, position) in locks:
            raise OSError("locked")
        locks.append((status.st_ino, position))

    for module, names in POSIX_CALLS:
        for name in names:
            monkeypatch.delattr(module, name)
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_NBLCK=2))
    monkeypatch.setattr(sys, "platform", "win32")
    return locks


def test_lock_is_held_and_named(windows, tmp_path, monkeypatch):
    """A lock refuses a second command, which names the first; a lock file that stays names nobody."""
    path = tmp_path / ".lock"
    with files.locked(path, "busy: {}") as before:
        assert before == "" and len(windows) == 1
        with pytest.raises(UsageError, match="busy: process "), files.locked(path, "busy: {}"):
            pass
    windows.clear()

    def refused(self: Path, missing_ok: bool = False) -> None:
        raise PermissionError(13, "in use")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refused)
        with files.locked(path, "busy: {}"):
            pass
    windows.clear()
    with files.locked(path, "busy: {}") as before:
        assert before == ""


def test_caches_and_commands(windows, monkeypatch, tmp_path):
    """A temporary cache folder needs no user's number; commands are quoted as its shell reads them."""
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    assert caches._temporary("numba").parent.parent == tmp_path
    assert command_line("next", "cell 7") == 'calib next "cell 7"'


def test_a_path_that_toml_misreads_is_named(tmp_path):
    """Backslashes of a path in double quotes are escapes in TOML; the message says how to write it."""
    options = tmp_path / "options.toml"
    options.write_text('[camera]\nlens = "C:\\Users\\me\\lens.yaml"\n', encoding="utf-8")
    with pytest.raises(UsageError, match="in single quotes"):
        read_toml(options)
    options.write_text("[camera]\nlens = 'C:\\Users\\me\\lens.yaml'\n", encoding="utf-8")
    assert read_toml(options)["camera"]["lens"] == "C:\\Users\\me\\lens.yaml"


def test_processes_start_without_signal_masks(windows):
    """Worker processes are started where signals cannot be masked."""
    with processes._without_interrupt():
        assert not hasattr(signal, "pthread_sigmask")

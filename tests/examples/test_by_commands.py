"""The studies by commands: what ``by_commands.sh`` prints is what its page or ``by_commands.txt`` shows."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
PAGE = ROOT / "docs/tutorials/lwr_logs.md"
SCRIPT = EXAMPLES / "lwr4plus/by_commands.sh"
# of a printed number, relative: searches end elsewhere where a processor rounds otherwise
TOLERANCE = 0.3


def page_blocks() -> ModuleType:
    """Return the module that runs and compares the code of the documentation's pages."""
    specification = importlib.util.spec_from_file_location("blocks", ROOT / "docs/blocks.py")
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules["blocks"] = module
    specification.loader.exec_module(module)
    return module


def printed_by(script: Path, folder: Path) -> list[str]:
    """Return the lines that a script prints; it has to end without an error."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = os.environ | {"PATH": path, "COLUMNS": "100", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(["bash", str(script), str(folder)], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return (done.stdout + done.stderr).splitlines()


def test_the_page_explains_every_command():
    """The tutorial's commands are those of the script; `test_slow_blocks_run` runs and compares them."""
    page = "".join(re.findall(r"^```sh\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.S | re.M))
    script = SCRIPT.read_text(encoding="utf-8")
    assert script.split("\n\n", 1)[1] == page


@pytest.mark.parametrize("study", ["lwr4plus", "tx40", "dualv"])
def test_scripts_are_short(study):
    """A study by commands has some fifteen commands."""
    text = (EXAMPLES / study / "by_commands.sh").read_text(encoding="utf-8")
    assert len(re.findall(r"^\s*calib |^identify \S+\.csv", text, re.M)) <= 15


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("study", ["tx40", "dualv"])
def test_prints_what_is_stored(study, tmp_path):
    """One and two minutes of processor time."""
    script = EXAMPLES / study / "by_commands.sh"
    shown = script.with_suffix(".txt").read_text(encoding="utf-8").splitlines()
    _, wrong = page_blocks().compare(shown, printed_by(script, tmp_path / "run"), TOLERANCE)
    assert not wrong

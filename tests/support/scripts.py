"""Scripts run in this process, which has loaded long ago what a process of their own would load first."""

import runpy
import sys
from pathlib import Path

import pytest


def run_here(script: Path, *arguments: object, capsys: pytest.CaptureFixture[str]) -> str:
    """Run a script as its command line would; return what it printed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(Path.cwd())  # wherever it goes
        patch.setattr(sys, "argv", [str(script), *map(str, arguments)])
        patch.syspath_prepend(str(script.parent))
        runpy.run_path(str(script), run_name="__main__")
    return capsys.readouterr().out

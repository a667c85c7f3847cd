"""Scripts run in this process, which has loaded long ago what a process of their own would load first."""

import runpy
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import calib

PROBE = Path(__file__).with_name("package_path.py")


@cache
def require_same_package() -> None:
    """Fail where a script in a process of its own would import another package than the tests do."""
    probe = subprocess.run([sys.executable, PROBE], capture_output=True, text=True, check=True)
    assert Path(probe.stdout.strip()).resolve() == Path(calib.__file__).resolve()


def run_here(script: Path, *arguments: object, capsys: pytest.CaptureFixture[str]) -> str:
    """Run a script as its command line would; return what it printed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(Path.cwd())  # wherever it goes
        patch.setattr(sys, "argv", [str(script), *map(str, arguments)])
        patch.syspath_prepend(str(script.parent))
        runpy.run_path(str(script), run_name="__main__")
    return capsys.readouterr().out

"""Reports of internal errors: one message, and a file to send to the developers.

The file contains the command, versions and the traceback. It contains no data of the user except what the error's
message quotes.
"""

import platform
import shlex
import tempfile
import traceback
from collections.abc import Sequence
from datetime import datetime
from importlib import metadata
from pathlib import Path

from calib import files
from calib.errors import CalibError, brief

# Exit code of an internal error.
CODE = 4
# Address for reports, also in README and, once it is public, under Issues of [project.urls].
TRACKER = "the issue tracker of the repository you cloned (git remote -v)"
PACKAGES = ("armature-calib", "numpy", "scipy", "numba", "pin", "pydantic", "typer", "matplotlib", "clarabel")


def report(error: BaseException, command: Sequence[str], folder: Path | None = None) -> str:
    """Write a bug report for an unexpected error, and return a one-line message about it.

    Args:
        error: the error, with its traceback.
        command: the words after ``calib``.
        folder: folder of the report; None takes the current folder or, if it cannot be written, the system's folder for
            temporary files.
    """
    name = f"calib-bug-{datetime.now():%Y%m%d-%H%M%S}-{id(error) % 9973}.txt"
    content = "\n".join([f"calib {shlex.join(command)}", *_head(), "", *traceback.format_exception(error)])
    message = f"internal error: {type(error).__name__}: {brief(error)}"
    if folder is None:
        folder = Path()
    for target in (folder, Path(tempfile.gettempdir())):
        try:
            path = files.write(target / name, content)
        except CalibError:
            continue
        return f"{message}; a bug report was written: {path}. Check the input, then send it to {TRACKER}."
    return f"{message}; `calib --debug` shows the place. Please check the input, too."


def _head() -> list[str]:
    lines = [f"for {TRACKER}", f"Python {platform.python_version()}, {platform.platform()}"]
    for name in PACKAGES:
        try:
            lines.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            lines.append(f"{name} is not installed")
    return lines

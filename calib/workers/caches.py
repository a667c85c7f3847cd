"""Cache folders of numba and matplotlib, for users whose usual cache folders are not writable.

numba refuses to load a kernel that it cannot cache ("no locator available"); matplotlib warns, and searches for fonts
again in every process. If the usual folders are not writable (containers, CI, services), both libraries get a private
folder in the temporary folder. Variables that the user sets have priority; worker processes inherit the variables.
"""

import os
import stat
import sys
from contextlib import suppress
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
FOLDER = "calib-cache-{user}"  # in the temporary folder


def provide() -> None:
    """Set NUMBA_CACHE_DIR and MPLCONFIGDIR to temporary folders if the libraries' usual folders are not writable."""
    caches = _user_caches()
    if not os.environ.get("NUMBA_CACHE_DIR") and not _writable(caches) and not _kernels_writable():
        with suppress(OSError):
            os.environ["NUMBA_CACHE_DIR"] = str(_temporary("numba"))
            # Read from the environment when numba is imported, which may have been before.
            numba = sys.modules.get("numba")
            if numba:
                numba.config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]
    settings = Path(os.environ.get("XDG_CONFIG_HOME") or _home() / ".config")
    if not os.environ.get("MPLCONFIGDIR") and not (_writable(settings) and _writable(caches)):
        with suppress(OSError):
            os.environ["MPLCONFIGDIR"] = str(_temporary("matplotlib"))


def _home() -> Path:
    """Return the user's home folder; a path that does not exist for a user without a home folder."""
    home = Path(os.path.expanduser("~"))
    return home if home.is_absolute() else Path("/nonexistent")


def _user_caches() -> Path:
    """Return the user's cache folder, as numba and matplotlib determine it."""
    usual = _home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")
    return Path(os.environ.get("XDG_CACHE_HOME") or usual)


def _kernels_writable() -> bool:
    """Return whether numba can store every compiled kernel of this package in the folder of the kernel's source."""
    folders = {path.parent / "__pycache__" for path in PACKAGE.rglob("*kernels.py")}
    return all(_writable(folder) for folder in folders)


def _writable(folder: Path) -> bool:
    """Return whether files can be written into a folder, which is created if necessary."""
    existing = [part for part in (folder, *folder.parents) if part.exists()]
    return existing[0].is_dir() and os.access(existing[0], os.W_OK | os.X_OK)


def _temporary(name: str) -> Path:
    """Return a private folder of this user in the temporary folder, which later processes find again.

    If another user owns a folder with this name, a new folder is created, which is removed when this process ends.

    Args:
        name: name of the folder.

    Raises:
        OSError: if no temporary folder is writable.
    """
    import atexit
    import shutil
    import tempfile  # slow to load

    parent = Path(tempfile.gettempdir()) / FOLDER.format(user=_user())
    with suppress(FileExistsError):
        parent.mkdir(mode=0o700)
    # compiled code is loaded from there: nobody else may have written it
    status = parent.lstat()
    private = stat.S_ISDIR(status.st_mode)
    if sys.platform != "win32":  # there a user's temporary folder is the user's own
        private = private and status.st_uid == os.getuid() and not status.st_mode & 0o077
    if not private:
        parent = Path(tempfile.mkdtemp(prefix="calib-cache-"))
        atexit.register(shutil.rmtree, parent, ignore_errors=True)
    folder = parent / name
    folder.mkdir(exist_ok=True)
    return folder


def _user() -> str:
    """Return what distinguishes this user in the name of a folder."""
    if sys.platform == "win32":
        return "windows"
    return str(os.getuid())

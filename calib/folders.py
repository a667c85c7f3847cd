"""Folders of results: written whole, beside their place, then moved there."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterable
from pathlib import Path

from calib import files
from calib.errors import UsageError

METRICS = "metrics.json"
"""Written last: it says that the rest of a folder is there."""
REPORT, CERTIFICATE = "report.json", "certificate.html"
"""What figures and a certificate are made from, and the certificate."""


def check_target(
    out: Path, ours: Collection[str], marks: Collection[str], what: str, inputs: Iterable[str | Path | None] = ()
) -> None:
    """Refuse, before any work is done, a folder that cannot be written, or whose files are not ours to replace.

    Args:
        out: where results are to go.
        ours: names of all files that may be written there.
        marks: those by which an earlier result of the same kind is known.
        what: that kind, for messages.
        inputs: what is read, recordings with their cut (``log.npz@0:9``), too; none of it is written over.

    Raises:
        UsageError: with the file or folder concerned.
    """
    _check_folder(out)
    read = [one for path in inputs if path is not None for one in (path, str(path).rpartition("@")[0] or path)]
    files.check_not_input([out, *(out / name for name in ours)], read)
    present = [name for name in ours if (out / name).exists()]
    if present and not all((out / name).exists() for name in marks):
        raise UsageError(f"{out} holds {', '.join(present)} which no earlier {what} left there; choose another --out")


def _check_folder(out: Path) -> None:
    """Refuse, before any work is done, an `out` that is a file or cannot be written."""
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out} is a file; --out needs a folder")
    folder = out if out.is_dir() else next(parent for parent in out.absolute().parents if parent.exists())
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UsageError(f"cannot write to {folder}: {error.strerror or error}; nothing was changed there") from error


def write_staged(out: Path, ours: Collection[str], write: Callable[[Path], None]) -> Path:
    """Let `write` fill a temporary folder beside `out`, and move its files there.

    A folder that is not there appears whole; in one from an earlier run each file is replaced, its own other files
    (`ours` and plots, ``plot_*.png``) go, and what else lies there stays.

    Raises:
        UsageError: where the disk refuses.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        _clear_leftovers(out)
        staging = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}.{os.getpid()}.", suffix=".part"))
    except OSError as error:
        raise UsageError(f"cannot write beside {out}: {error.strerror or error}; nothing was changed there") from error
    try:
        write(staging)
        os.chmod(staging, 0o777 & ~_umask())
        if out.exists():
            _move_files(staging, out, ours)
        else:
            os.replace(staging, out)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return out


def _clear_leftovers(out: Path) -> None:
    """Remove what earlier runs for the same target left when they were killed; not what a living one is filling."""
    pattern = re.compile(rf"\.{re.escape(out.name)}\.(\d+)\.[^.]+\.part")
    for path in out.parent.iterdir():
        found = pattern.fullmatch(path.name)
        if found and path.is_dir() and not _alive(int(found[1])):
            shutil.rmtree(path, ignore_errors=True)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True  # another user's
    return True


def _move_files(staging: Path, out: Path, ours: Collection[str]) -> None:
    """Replace the files of an earlier run one by one, the metrics last, since they say that the rest is there."""
    fresh = sorted(path.name for path in staging.iterdir())
    stale = {name for name in ours if name not in fresh} | {path.name for path in out.glob("plot_*.png")} - set(fresh)
    try:
        for name in sorted(fresh, key=lambda name: name == METRICS):
            os.replace(staging / name, out / name)
        for name in stale:
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise UsageError(f"cannot write to {out}: {error.strerror or error}") from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask

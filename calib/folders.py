"""Folders of results: written whole, beside their place, then moved there."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Collection
from pathlib import Path

from calib.errors import UsageError


def check_folder(out: Path) -> None:
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
        staging = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}.", suffix=".part"))
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


def _move_files(staging: Path, out: Path, ours: Collection[str]) -> None:
    """Replace the files of an earlier run one by one, the metrics last, since they say that the rest is there."""
    fresh = sorted(path.name for path in staging.iterdir())
    stale = {name for name in ours if name not in fresh} | {path.name for path in out.glob("plot_*.png")} - set(fresh)
    try:
        for name in sorted(fresh, key=lambda name: name == "metrics.json"):
            os.replace(staging / name, out / name)
        for name in stale:
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise UsageError(f"cannot write to {out}: {error.strerror or error}") from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask

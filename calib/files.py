"""Files written whole or not at all."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from calib.errors import CalibError


def write(path: str | Path, content: str | bytes) -> Path:
    """Write `content` to `path` by way of a temporary file in the same folder and a rename.

    A killed process or a full disk leaves the old file as it was.

    Raises:
        CalibError: where the folder is missing, read-only or full; nothing is left behind.
    """
    path = Path(path)
    data = content.encode() if isinstance(content, str) else content
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        if temporary and os.path.exists(temporary):
            os.unlink(temporary)
        reason = error.strerror or str(error)
        raise CalibError(f"cannot write {path}: {reason}; nothing was changed there") from error
    return path


def write_json(path: str | Path, value: Any) -> Path:
    """Write `value` as indented JSON; NaN is refused, since JSON has none."""
    return write(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_table(path: str | Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> Path:
    """Write a CSV table; floats with 12 significant digits, so that a table read back serves as the value."""
    lines = [",".join(header)]
    lines += [",".join(_cell(cell) for cell in row) for row in rows]
    return write(path, "\n".join(lines) + "\n")


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.12g}"
    text = str(value)
    return '"' + text.replace('"', '""') + '"' if any(mark in text for mark in ',"\n') else text


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask

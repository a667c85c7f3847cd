"""Atomic writing of files, checks of target files before work begins, and lock files."""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import json
import math
import os
import re
import shutil
import socket
import stat
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import IO, TYPE_CHECKING

from calib.errors import CalibError, UsageError, refuse_option, refused_as, require
from calib.records import plain, shielded

if TYPE_CHECKING:  # the commands' help is written without loading it
    import numpy as np

# Name of the program in the metadata of figures and recordings, by which its own files are recognised.
MAKER = "armature-calib"
# File with the SHA-256 of each result in a folder when it was written, by file name.
RESULTS = ".armature-calib.json"
# Number of rows that are written at once: of general tables, and of tables of numbers.
TABLE_CHUNK = 1000
NUMBERS_CHUNK = 10_000
# Windows: byte of a lock file that is locked, far behind its text; right and exit code by which a process is known to
# run (PROCESS_QUERY_LIMITED_INFORMATION, STILL_ACTIVE of winbase.h).
LOCKED_BYTE = 1 << 30
QUERY_INFORMATION = 0x1000
STILL_ACTIVE = 259

Results = Sequence[tuple[Path, Sequence[str]]]
_staged: ContextVar[list[tuple[str, Path]] | None] = ContextVar("staged", default=None)


@contextmanager
def together() -> Iterator[None]:
    """Write all files of the block, or none: they replace their targets at the end of the block only.

    If one file cannot be written, no target is changed.
    """
    if _staged.get() is not None:  # part of a larger whole
        yield
        return
    staged: list[tuple[str, Path]] = []
    token = _staged.set(staged)
    try:
        yield
        while staged:
            temporary, path = staged[0]
            with refused_as(CalibError, OSError, f"cannot write {path}: {{}}"):
                os.replace(temporary, path)
            del staged[0]
    finally:
        _staged.reset(token)
        for temporary, _ in staged:
            os.unlink(temporary)


@contextmanager
def results(targets: Results, inputs: Iterable[str | Path | None] = (), overwrite: bool = False) -> Iterator[None]:
    """Write all files of the block, or none, as results.

    The targets are checked by `check_results`, and checksums of the files are stored.
    """
    check_results(targets, inputs, overwrite)
    with together():
        yield
        for folder in {target.parent for target, _ in targets}:
            staged = {path: Path(temporary) for temporary, path in _staged.get() or ()}
            register = folder / RESULTS
            fingerprints = _written(staged.get(register, register))
            for path, _ in targets:
                current_path = staged.get(path, path)
                if path.parent == folder and current_path.exists():
                    fingerprints[path.name] = fingerprint(current_path)
            write(register, json.dumps(fingerprints, indent=2))


def check_results(targets: Results, inputs: Iterable[str | Path | None] = (), overwrite: bool = False) -> None:
    """Raise an error, before any work is done, for target files that cannot be written, are inputs, or coincide.

    Args:
        targets: files to be written, each with its allowed suffixes. An existing file may be replaced if an earlier run
            wrote it and it has not changed since (by the checksums in the file `RESULTS`).
        inputs: input files; None is ignored.
        overwrite: True allows to replace any existing file.

    Raises:
        UsageError: a target is refused; the message names the file.
    """
    inputs = tuple(inputs)
    for number, (target, suffixes) in enumerate(targets):
        check_target(target, inputs, suffixes)
        if any(same_file(target, earlier) for earlier, _ in targets[:number]):
            raise UsageError(f"{target} would be written twice; give each file its own name")
        if overwrite or not target.exists() or not target.stat().st_size:
            continue
        if fingerprint(target) != _written(target.parent / RESULTS).get(target.name):
            raise UsageError(
                f"{target} exists, and was not written by an earlier run or has changed since; nothing was changed. "
                "Write elsewhere, or use --overwrite (in Python overwrite=True)"
            )


def _written(path: Path) -> dict[str, str]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


@contextmanager
def locked(path: Path, busy: str, kind: type[CalibError] = UsageError) -> Iterator[str]:
    """Hold a lock file during the block, and yield the name of its last holder if that process was killed, else "".

    The lock is the operating system's (flock; on Windows of one byte far behind the file's end), so that it ends with
    the process. The file contains the name of the process that holds it.

    Args:
        path: the lock file.
        busy: message of the error where another process holds the lock; ``{}`` is replaced by the name of that process.
        kind: class of that error.
    """
    with refused_as(CalibError, OSError, f"cannot write in {path.parent}: {{}}"):
        file = path.open("a+", encoding="utf-8", errors="replace")
    with file:
        file.seek(0)
        holder = file.read(200).strip()
        try:
            _lock(file)
        except OSError:
            raise kind(busy.replace("{}", holder or "another command")) from None
        if not path.exists() or not os.path.samestat(path.stat(), os.fstat(file.fileno())):
            raise kind(f"{path.parent} was busy a moment ago; try again")
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}")
        file.flush()
        try:
            yield holder
        except Exception:
            _remove_open(path, file)
            raise
        _remove_open(path, file)


def _lock(file: IO[str]) -> None:
    """Lock an open file for this process; raise OSError if another process holds it."""
    if sys.platform == "win32":
        import msvcrt

        os.lseek(file.fileno(), LOCKED_BYTE, os.SEEK_SET)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        return
    import fcntl

    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _remove_open(path: Path, file: IO[str]) -> None:
    """Remove a lock file that this process has open; where Windows refuses that, it stays without a holder's name."""
    try:
        path.unlink(missing_ok=True)
    except PermissionError:
        file.truncate(0)


def write(path: str | Path, content: str | bytes | Iterable[str]) -> Path:
    """Write `content`, whole or in parts, to `path`, by a temporary file in the same folder and a rename.

    If the process is killed or the disk is full, the old file is unchanged. Within a block of `together`, the rename
    takes place at the end of the block.

    Raises:
        CalibError: the folder cannot be created, or is read-only or full; the temporary file is removed.
    """
    path = Path(path)
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        clear_leftovers(path)
        prefix, suffix = staged_name(path)
        handle, temporary = tempfile.mkstemp(suffix, prefix, path.parent)
        with os.fdopen(handle, "wb") as file:
            file.writelines(_encoded(content))
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~umask())
        staged = _staged.get()
        if staged is not None:
            staged.append((temporary, path))
        else:
            os.replace(temporary, path)
    except BaseException as error:
        if temporary and os.path.exists(temporary):
            os.unlink(temporary)
        if not isinstance(error, OSError):
            raise
        reason = error.strerror or str(error)
        raise CalibError(f"cannot write {path}: {reason}; nothing was changed there") from error
    return path


def _encoded(content: str | bytes | Iterable[str]) -> Iterator[bytes]:
    """Yield the bytes of a file's content, whole or in parts."""
    if isinstance(content, bytes):
        yield content
    elif isinstance(content, str):
        yield content.encode()
    else:
        for part in content:
            yield part.encode() if isinstance(part, str) else part


def staged_name(path: Path) -> tuple[str, str]:
    """Return prefix and suffix of the temporary file for `path`; the prefix contains the process id."""
    return f".{path.name}.{os.getpid()}.", ".part"


def clear_leftovers(path: Path) -> None:
    """Remove temporary files for `path` that killed processes left; those of running processes are kept."""
    pattern = re.compile(rf"\.{re.escape(path.name)}\.(\d+)\.[^.]+\.part")
    for name in os.listdir(path.parent):
        match = pattern.fullmatch(name)
        if match and not _alive(int(match[1])):
            leftover = path.parent / name
            if leftover.is_dir():
                shutil.rmtree(leftover, ignore_errors=True)
            else:
                leftover.unlink(missing_ok=True)


def in_use(path: Path) -> bool:
    """Return whether a temporary file or folder (`staged_name`) belongs to a running process."""
    match = re.fullmatch(r"\..*\.(\d+)\.[^.]+\.part", path.name)
    return match is not None and _alive(int(match[1]))


def _alive(process: int) -> bool:
    if sys.platform == "win32":
        return _alive_on_windows(process)
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True  # another user's
    return True


def _alive_on_windows(process: int) -> bool:
    """Return whether a process runs; ``os.kill`` would end it there."""
    import ctypes

    kernel = ctypes.windll.kernel32  # ty: ignore[missing-attribute]
    handle = kernel.OpenProcess(QUERY_INFORMATION, False, process)
    if not handle:
        return False
    code = ctypes.c_ulong()
    kernel.GetExitCodeProcess(handle, ctypes.byref(code))
    kernel.CloseHandle(handle)
    return code.value == STILL_ACTIVE


def check_target(out: Path, inputs: Iterable[str | Path | None], suffixes: Sequence[str] = ()) -> None:
    """Raise an error, before any work is done, for a target file that cannot be written or is an input.

    Args:
        out: the file to write.
        inputs: input files, None ignored; the name of a recording may have a time range appended (``log.npz@0:9``).
        suffixes: allowed suffixes of `out`; empty allows all.

    Raises:
        UsageError: the file is refused; the message names it.
    """
    require(not (_reached(out) and out.is_dir()), f"{out} is a folder; give a file to write to", UsageError)
    check_writable(out.absolute().parent, out)
    check_not_input([out], inputs)
    if suffixes and out.suffix not in suffixes:
        refuse_option(out, f"give a file with the suffix {' or '.join(suffixes)}")


def check_writable(folder: Path, target: Path | None = None) -> None:
    """Raise an error, before any work is done, for a folder that cannot be created or written to.

    Args:
        folder: the folder.
        target: the file or folder to be written, named in the message; None names `folder`.

    Raises:
        UsageError: the folder cannot be written; the message gives target, folder and reason.
    """
    nearest = folder
    for nearest in (folder, *folder.absolute().parents):
        if _reached(nearest):
            break
    try:
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        message = f"cannot write {target or folder}: {error.strerror or error} in {nearest}; nothing was changed there"
        raise UsageError(message) from error


def _reached(path: Path) -> bool:
    """Return whether a file or folder exists at `path`.

    Raises:
        UsageError: the path is invalid: a link to a missing file or to itself, a name too long, a file in place of a
            folder.
    """
    try:
        path.stat()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        if isinstance(error, FileNotFoundError):
            if not path.is_symlink():
                return False
            reason = "a link to nowhere"
        raise UsageError(f"{str(path)[:200]} cannot be written: {reason}; choose another (--out)") from error
    return True


def check_not_input(targets: Iterable[Path], inputs: Iterable[str | Path | None]) -> None:
    """Raise an error, before any work is done, for a target that is one of the input files or folders.

    Args:
        targets: files to be written.
        inputs: input files and folders. The name of a recording may have a time range appended (``log.npz@0:9``). Names
            that do not exist on the disk (robots of the library), and None, are ignored.

    Raises:
        UsageError: a target is an input; the message names it.
    """
    existing: list[Path] = []
    for path in inputs:
        if path is None:
            continue
        for name in (path, str(path).rpartition("@")[0] or path):
            candidate = Path(name)
            # False for names that no file can have.
            if os.path.exists(candidate):
                existing.append(candidate)
    if not existing:
        return
    for target in targets:
        resolved = target.resolve()
        if resolved.exists() and any(resolved.samefile(path) for path in existing):
            raise UsageError(f"{target} is an input and would be overwritten; write elsewhere (--out)")


def same_file(first: Path, second: Path) -> bool:
    """Return whether two paths name the same file, also on file systems that ignore case."""
    if first.resolve() == second.resolve():
        return True
    return first.exists() and second.exists() and first.samefile(second)


def check_regular(path: str | Path, streams: bool = False) -> None:
    """Raise an error if the path is a pipe or a device.

    Args:
        path: path of a file or a folder.
        streams: True allows streams from a shell (``<(command)``, ``/dev/stdin``), for files that are read only once.

    Raises:
        OSError: the path is a pipe or a device, is missing, or its name is not UTF-8.
    """
    if str(path).encode(errors="ignore").decode() != str(path):
        raise OSError(errno.EILSEQ, "its name is not UTF-8: rename the file", str(path))
    mode = os.stat(path).st_mode
    is_stream = streams and str(path).startswith(("/dev/fd/", "/dev/stdin", "/proc/self/fd/"))
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode) or is_stream or str(path) == os.devnull):
        raise OSError(errno.EINVAL, "is a pipe or a device, not a file: write its content to a file first", str(path))


def fingerprint(path: Path) -> str:
    """Return the SHA-256 of a file in hex. The file is read again only if it changed since the last call."""
    status = path.stat()
    return _digest(path.absolute(), status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)


@lru_cache(maxsize=1024)
def _digest(path: Path, *_: int) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def write_json(path: str | Path, value: object) -> Path:
    """Write a record (`calib.records`), or any nesting of records, mappings and lists, as indented JSON.

    Raises:
        CalibError: a number is not finite, which JSON cannot represent; the message names its key, and nothing is
            written.
    """
    value = plain(value)
    try:
        content = json.dumps(value, indent=2, allow_nan=False)
    except ValueError as error:
        key = next(_not_finite(value, ""), "") or "somewhere"
        raise CalibError(
            f"{path} was not written: {key} is not a finite number. The "
            "measurements are too few, too similar, or do not belong to this robot. Measure more poses, or ask "
            "for a simpler model"
        ) from error
    return write(path, content + "\n")


def _not_finite(value: object, path: str) -> Iterator[str]:
    """Yield the names of numbers that are not finite, such as ``fit.nominal.position_mm.rms``.

    `path` is the name of `value`.
    """
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _not_finite(item, f"{path}.{key}" if path else str(key))
    elif isinstance(value, (list, tuple)):
        for number, item in enumerate(value):
            yield from _not_finite(item, f"{path}[{number}]")
    elif isinstance(value, float) and not math.isfinite(value):
        yield path


def write_table(
    path: str | Path, header: Sequence[str], rows: Iterable[Sequence[object]], notes: Sequence[str] = ()
) -> Path:
    """Write a CSV table below comment lines `notes`.

    Floats have 12 significant digits; None and NaN are empty cells. Cells with commas, quotes or line breaks are
    quoted, also in the header, since names may be taken from users' files. All cells of a header are quoted if it could
    be mistaken for a header with other separators, or for a comment. A text that a spreadsheet would read as a formula
    (``=1+1``) gets an apostrophe before it (`calib.records.shielded`).
    """

    def parts() -> Iterator[str]:
        yield remarks(notes) + _headed(header).getvalue()
        remaining = iter(rows)
        while chunk := list(islice(remaining, TABLE_CHUNK)):
            text = io.StringIO()
            writer = csv.writer(text, lineterminator="\n")
            for row in chunk:
                writer.writerow(map(_cell, row))
            yield text.getvalue()

    return write(path, parts())


def write_numbers(
    path: str | Path, header: Sequence[str], values: np.ndarray, names: Sequence[str] = (), notes: Sequence[str] = ()
) -> Path:
    """Write values (N, k) as CSV, twice as fast as `write_table`.

    Args:
        path: the file.
        header: names of the columns.
        values: the numbers.
        names: names of the rows, written as first column; empty for no such column.
        notes: comment lines above the header.
    """
    line = ",".join(["%.12g"] * values.shape[1]) + "\n"

    def parts() -> Iterator[str]:
        yield remarks(notes) + _headed(header).getvalue()
        for start in range(0, len(values), NUMBERS_CHUNK):
            chunk = values[start : start + NUMBERS_CHUNK]
            text = io.StringIO()
            if names:
                for name, row in zip(names[start:], chunk.tolist()):
                    text.write(f"{_quoted(name)},{line % tuple(row)}")
            else:
                text.write((line * len(chunk)) % tuple(chunk.ravel().tolist()))
            yield text.getvalue()

    return write(path, parts())


def remarks(notes: Sequence[str]) -> str:
    """Return the lines `notes` as comments of a CSV, TOML or YAML file."""
    return "".join(f"# {note}\n" for note in notes)


def _cell(value: object) -> object:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.12g}"
    return shielded(value) if isinstance(value, str) else value


def _quoted(name: str) -> str:
    """Return a text as one cell of a CSV line."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow([_cell(name)])
    return text.getvalue().removesuffix("\n")


def _headed(header: Sequence[str]) -> io.StringIO:
    text = io.StringIO()
    marks = ";\t" if len(header) > 1 else ";\t| "
    misread = header[0].startswith("#") or any(mark in name for name in header for mark in marks)
    quoting = csv.QUOTE_ALL if misread else csv.QUOTE_MINIMAL
    csv.writer(text, lineterminator="\n", quoting=quoting).writerow(map(_cell, header))
    return text


def umask() -> int:
    """Return the permission bits that are removed from new files of this process (umask)."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def shipped_text(package: str, file: str) -> str:
    """Return the text of a file that is installed with a package."""
    from importlib import resources  # 3 ms

    return resources.files(package).joinpath(file).read_text(encoding="utf-8")

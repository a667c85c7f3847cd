"""Atomic writing of files."""

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
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib.errors import CalibError, UsageError, refuse_option, refused_as, require
from calib.records import plain, shielded

if TYPE_CHECKING:  # the commands' help is written without loading it
    import numpy as np

MAKER = "armature-calib"  # by which figures and recordings are known as ours
Results = Sequence[tuple[Path, Sequence[str]]]
RESULTS = ".armature-calib.json"  # SHA-256 of the results in a folder, by name, as they were written
_staged: ContextVar[list[tuple[str, Path]] | None] = ContextVar("staged", default=None)


@contextmanager
def together() -> Iterator[None]:
    """Put all files written in the block into place at its end, or none of them if one cannot be written."""
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
    """Write the block's files together as results: targets are checked (`check_results`), checksums recorded."""
    check_results(targets, inputs, overwrite)
    with together():
        yield
        for folder in {target.parent for target, _ in targets}:
            staged = {path: Path(temporary) for temporary, path in _staged.get() or ()}
            now = {path.name: staged.get(path, path) for path, _ in targets if path.parent == folder}
            made = {name: fingerprint(path) for name, path in now.items() if path.exists()}
            write(
                folder / RESULTS, json.dumps(_written(staged.get(folder / RESULTS, folder / RESULTS)) | made, indent=2)
            )


def check_results(targets: Results, inputs: Iterable[str | Path | None] = (), overwrite: bool = False) -> None:
    """Raise an error, before any work is done, for target files that cannot be written, are inputs, or coincide.

    Args:
        targets: to be written, each with the suffixes that it may have; what stands there is replaced where an earlier
            run left it and nobody has changed it since (`RESULTS` says so), or with `overwrite`.
        inputs: what is read.

    Raises:
        UsageError: with the file concerned.
    """
    inputs = tuple(inputs)
    for number, (target, suffixes) in enumerate(targets):
        check_target(target, inputs, suffixes)
        if any(same_file(target, other) for other, _ in targets[:number]):
            raise UsageError(f"{target} would be written twice; give each file its own name")
        known = _written(target.parent / RESULTS).get(target.name)
        if not overwrite and target.exists() and target.stat().st_size and fingerprint(target) != known:
            raise UsageError(
                f"{target} exists, and was not written by an earlier run or has changed since; nothing was changed. "
                "Write elsewhere, or use --overwrite (in Python overwrite=True)"
            )


def _written(path: Path) -> dict[str, str]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


@contextmanager
def locked(path: Path, busy: str, kind: type[CalibError] = UsageError) -> Iterator[str]:
    """Hold a lock file for the block; yield who held it last, if that process was killed, else an empty text.

    The lock is the kernel's (flock), so that it ends with the process; the file says whose it is.

    Args:
        busy: the message where another process holds it; ``{}`` stands for its name.
        kind: of that error.
    """
    import fcntl

    with refused_as(CalibError, OSError, f"cannot write in {path.parent}: {{}}"):
        file = path.open("a+", errors="replace")
    with file:
        file.seek(0)
        holder = file.read(200).strip()
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
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
            path.unlink(missing_ok=True)
            raise
        path.unlink(missing_ok=True)


def write(path: str | Path, content: str | bytes | Iterable[str]) -> Path:
    """Write `content`, whole or in parts, to `path` by a temporary file in its folder and a rename (see `together`).

    A killed process or a full disk leaves the old file as it was.

    Raises:
        CalibError: where the folder is missing, read-only or full; nothing is left behind.
    """
    path = Path(path)
    whole = isinstance(content, (str, bytes))
    parts = (part.encode() if isinstance(part, str) else part for part in ([content] if whole else content))
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        clear_leftovers(path)
        prefix, suffix = staged_name(path)
        handle, temporary = tempfile.mkstemp(suffix, prefix, path.parent)
        with os.fdopen(handle, "wb") as file:
            file.writelines(parts)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~umask())
        if (staged := _staged.get()) is not None:
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


def staged_name(path: Path) -> tuple[str, str]:
    """Return prefix and suffix of the temporary file for `path`: the prefix contains the process id."""
    return f".{path.name}.{os.getpid()}.", ".part"


def clear_leftovers(path: Path) -> None:
    """Remove temporary files of `path` from killed processes; those of running processes stay."""
    pattern = re.compile(rf"\.{re.escape(path.name)}\.(\d+)\.[^.]+\.part")
    for name in os.listdir(path.parent):
        found = pattern.fullmatch(name)
        if found and not _alive(int(found[1])):
            left = path.parent / name
            if left.is_dir():
                shutil.rmtree(left, ignore_errors=True)
            else:
                left.unlink(missing_ok=True)


def in_use(path: Path) -> bool:
    """Return whether a temporary file or folder (`staged_name`) belongs to a running process."""
    found = re.fullmatch(r"\..*\.(\d+)\.[^.]+\.part", path.name)
    return found is not None and _alive(int(found[1]))


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True  # another user's
    return True


def check_target(out: Path, inputs: Iterable[str | Path | None], suffixes: Sequence[str] = ()) -> None:
    """Raise an error, before any work is done, for a target file that cannot be written or is an input.

    Args:
        out: the file to write.
        inputs: what is read; recordings may have their cut (``log.npz@0:9``).
        suffixes: those that `out` may have; all without any.

    Raises:
        UsageError: with the file concerned.
    """
    require(not (_reached(out) and out.is_dir()), f"{out} is a folder; give a file to write to", UsageError)
    check_writable(out.absolute().parent, out)
    check_not_input([out], inputs)
    if suffixes and out.suffix not in suffixes:
        refuse_option(out, f"give a file with the suffix {' or '.join(suffixes)}")


def check_writable(folder: Path, target: Path | None = None) -> None:
    """Refuse, before any work is done, a folder that cannot be created or written to, for `target` (default: itself).

    Raises:
        UsageError: with the target, the folder and the reason.
    """
    nearest = next(one for one in (folder, *folder.absolute().parents) if _reached(one))
    try:
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        message = f"cannot write {target or folder}: {error.strerror or error} in {nearest}; nothing was changed there"
        raise UsageError(message) from error


def _reached(path: Path) -> bool:
    """Return whether a file or folder exists at `path`; refuse an invalid path.

    Raises:
        UsageError: for a link to nowhere or to itself, a name too long, a file taken for a folder.
    """
    try:
        path.stat()
    except (OSError, ValueError) as error:
        if isinstance(error, FileNotFoundError) and not path.is_symlink():
            return False
        why = "a link to nowhere" if isinstance(error, FileNotFoundError) else getattr(error, "strerror", None) or error
        raise UsageError(f"{str(path)[:200]} cannot be written: {why}; choose another (--out)") from error
    return True


def check_not_input(targets: Iterable[Path], inputs: Iterable[str | Path | None]) -> None:
    """Raise an error, before any work is done, for a target that is one of the input files or folders.

    Args:
        targets: to be written.
        inputs: to be read, recordings with their cut (``log.npz@0:9``), too; names that are no path on the disk (robots
            of the library), and None, are passed over.

    Raises:
        UsageError: with the file that is both.
    """
    read = (one for path in inputs if path is not None for one in (path, str(path).rpartition("@")[0] or path))
    known = [path for path in map(Path, read) if os.path.exists(path)]  # False for names that no file can have
    for target in targets:
        if known and (place := target.resolve()).exists() and any(place.samefile(path) for path in known):
            raise UsageError(f"{target} is an input and would be overwritten; write elsewhere (--out)")


def same_file(one: Path, other: Path) -> bool:
    """Return whether two paths name the same file, also on file systems that ignore case."""
    return one.resolve() == other.resolve() or (one.exists() and other.exists() and one.samefile(other))


def check_regular(path: str | Path, streams: bool = False) -> None:
    """Raise an error if the path is a pipe or a device.

    Args:
        path: of a file, or a folder.
        streams: allow what a shell hands over (``<(command)``, ``/dev/stdin``): for what is read once.

    Raises:
        OSError: with the reason.
    """
    if str(path).encode(errors="ignore").decode() != str(path):
        raise OSError(errno.EILSEQ, "its name is not UTF-8: rename the file", str(path))
    mode = os.stat(path).st_mode
    handed = streams and str(path).startswith(("/dev/fd/", "/dev/stdin", "/proc/self/fd/"))
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode) or handed or str(path) == os.devnull):
        raise OSError(errno.EINVAL, "is a pipe or a device, not a file: write its content to a file first", str(path))


def fingerprint(path: Path) -> str:
    """Return the SHA-256 of a file in hex; the file is read again only if it changed."""
    found = path.stat()
    return _digest(path.absolute(), found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)


@lru_cache(maxsize=1024)
def _digest(path: Path, *_: int) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def write_json(path: str | Path, value: Any) -> Path:
    """Write a record (`calib.records`), or any nesting of records, mappings and lists, as indented JSON.

    Raises:
        CalibError: for a number that is not finite, since JSON has none, with its place; nothing is written.
    """
    value = plain(value)
    try:
        content = json.dumps(value, indent=2, allow_nan=False)
    except ValueError as error:
        place = next(_not_finite(value, ""), "") or "somewhere"
        raise CalibError(
            f"{path} was not written: {place} is not a finite number. The "
            "measurements are too few, too similar, or do not belong to this robot. Measure more poses, or ask "
            "for a simpler model"
        ) from error
    return write(path, content + "\n")


def _not_finite(value: Any, place: str) -> Iterator[str]:
    """Yield the paths of numbers that are not finite, as ``fit.nominal.position_mm.rms``."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _not_finite(item, f"{place}.{key}" if place else str(key))
    elif isinstance(value, (list, tuple)):
        for number, item in enumerate(value):
            yield from _not_finite(item, f"{place}[{number}]")
    elif isinstance(value, float) and not math.isfinite(value):
        yield place


def write_table(
    path: str | Path, header: Sequence[str], rows: Iterable[Sequence[Any]], notes: Sequence[str] = ()
) -> Path:
    """Write a CSV table below comment lines `notes`; floats have 12 significant digits, None and NaN are empty.

    Cells with commas, quotes or line breaks are quoted, those of the header too: names come from people's files. So is
    a whole header that would be taken for one with other separators, or for a comment. A text that a spreadsheet would
    take for a formula (``=1+1``) gets an apostrophe before it (`calib.records.shielded`).
    """

    def parts(many: int = 1000) -> Iterator[str]:
        yield remarks(notes) + _headed(header).getvalue()
        left = iter(rows)
        while some := list(islice(left, many)):
            text = io.StringIO()
            csv.writer(text, lineterminator="\n").writerows([_cell(cell) for cell in row] for row in some)
            yield text.getvalue()

    return write(path, parts())


def write_numbers(
    path: str | Path, header: Sequence[str], values: np.ndarray, names: Sequence[str] = (), notes: Sequence[str] = ()
) -> Path:
    """Write values (N, k) as CSV, optionally with a name per row, twice as fast as `write_table`.

    Args:
        notes: comment lines above the header.
    """
    line = ",".join(["%.12g"] * values.shape[1]) + "\n"

    def parts(many: int = 10_000) -> Iterator[str]:
        yield remarks(notes) + _headed(header).getvalue()
        for start in range(0, len(values), many):
            some, text = values[start : start + many], io.StringIO()
            if names:
                for name, row in zip(names[start:], some.tolist()):
                    text.write(f"{_quoted(name)},{line % tuple(row)}")
            else:
                text.write((line * len(some)) % tuple(some.ravel().tolist()))
            yield text.getvalue()

    return write(path, parts())


def remarks(notes: Sequence[str]) -> str:
    """Return lines as comments of a CSV, TOML or YAML file."""
    return "".join(f"# {note}\n" for note in notes)


def _cell(value: Any) -> Any:
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
    """Return the permission bits that new files of this process do not get (umask)."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def shipped_text(package: str, file: str) -> str:
    """Return the text of a file that is shipped in a package."""
    from importlib import resources  # 3 ms

    return resources.files(package).joinpath(file).read_text(encoding="utf-8")

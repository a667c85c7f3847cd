"""Sessions and studies in object storage or a shared folder, by addresses of fsspec (``s3://bucket/cell7``).

A process that works on such a folder downloads a copy, works on the copy, and uploads changed files: every few seconds,
and at the end. The files that mark a step as complete (`LAST`) are uploaded after all others, and never in part. After
a process was killed, the files that it had uploaded remain, and the next process continues from them.

The file ``calib.claim`` in the folder names the process that works on it. This process rewrites the file regularly. If
the file has not changed for `LEASE` seconds, the next process takes the folder over. If the earlier process was only
slow, it notices this and writes nothing more.
"""

from __future__ import annotations

import os
import socket
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from typing import Any

from calib.errors import Busy, CalibError, UsageError, refused_as, require
from calib.folders import SESSION, STATE

CLAIM = "calib.claim"
LAST = (STATE, "rows.sqlite")  # of a session, of a study
PASSING = (".part", ".lock")  # suffixes of files that stay where they are
LEASE = 20.0  # [s] that a claim may go unchanged (our choice)


def is_address(path: object) -> bool:
    """Return whether `path` is an address of fsspec, such as ``s3://…``, rather than a path."""
    return "://" in str(path)


def sessions(address: str) -> list[str]:
    """Return the addresses of the sessions that match an address with or without wildcards; an empty list for a path.

    Raises:
        UsageError: the storage cannot be read, or no session matches.
    """
    if not is_address(address):
        return []
    files, root = _opened(address)
    with refused_as(UsageError, Exception, f"{address} cannot be read: {{}}; check address and access"):
        session_paths = sorted(files.glob(f"{root}/{SESSION}"))
    require(
        session_paths,
        f"{address}: no session ({SESSION}) is there; give the folder that contains the sessions",
        UsageError,
    )
    return [files.unstrip_protocol(path.rpartition("/")[0]) for path in session_paths]


@contextmanager
def held(address: str, lease: float = LEASE) -> Iterator[Path]:
    """Yield a local copy of the folder at an address, claimed for this process; changed files are written back.

    Args:
        address: address of the folder.
        lease: time after which a claim that was not renewed may be taken over [s].

    Raises:
        UsageError: there is no storage at the address.
        Busy: another process works on the folder.
        CalibError: the folder cannot be read or written (another process took it over; the storage is full). Files that
            were written back before remain.
    """
    files, root = _opened(address)
    with refused_as(CalibError, Exception, f"cannot read or write {address}: {{}}; run the same command again"):
        claim = _Claim(files, address, f"{root}/{CLAIM}", lease)
    with TemporaryDirectory(prefix="calib-") as temporary_folder:
        try:
            copy = _Copy(files, root, Path(temporary_folder) / root.rpartition("/")[2], claim)
            stop, keeper = Event(), Thread(target=lambda: copy.keep(stop, lease / 4.0), daemon=True)
            keeper.start()
            try:
                yield copy.folder
            finally:
                stop.set()
                keeper.join()
                with refused_as(CalibError, Exception, f"cannot write {address}: {{}}; run the same command again"):
                    copy.put_back()
        finally:
            claim.release()


def _opened(address: str) -> tuple[Any, str]:
    message = f"{address}: {{}}; for addresses: pip install 'armature-calib[cluster]' and the storage's package"
    with refused_as(UsageError, (ImportError, ValueError), message):
        from fsspec.core import url_to_fs

        files, root = url_to_fs(address.rstrip("/"))
    return files, root


class _Claim:
    """The file at an address that names the process working on the folder; the constructor takes the claim.

    Args:
        files: file system of fsspec.
        address: address of the folder, for messages.
        path: path of the file in the file system.
        lease: time [s] after which a claim that was not renewed is taken over.
    """

    def __init__(self, files: Any, address: str, path: str, lease: float) -> None:
        self.files, self.address, self.path, self.beats = files, address, path, 0
        self.owner = f"process {os.getpid()} on {socket.gethostname()} ({uuid.uuid4().hex[:8]})"
        try:
            self._write("create")
        except FileExistsError:
            before = self._read()
            time.sleep(lease)
            after = self._read()
            # empty: its holder is just renewing it
            if after is not None and after != before:
                holder = (after or before or "another process").partition(" (")[0]
                raise Busy(f"{address} is busy: {holder} works on it; wait for it to end") from None
            self._write("overwrite")

    def _write(self, mode: str) -> None:
        self.files.makedirs(self.path.rpartition("/")[0], exist_ok=True)
        self.files.pipe_file(self.path, f"{self.owner} {self.beats}".encode(), mode=mode)

    def _read(self) -> str | None:
        """Return the claim's text; None where no process has a claim."""
        try:
            return self.files.cat_file(self.path).decode()
        except FileNotFoundError:
            return None

    def renew(self) -> None:
        """Rewrite the claim file to show that this process is alive; raise CalibError if another process took over."""
        holder = self._read() or ""
        message = f"{self.address} was taken over by {holder or 'nobody'}; nothing more was written there"
        require(holder.startswith(self.owner), message)
        self.beats += 1
        self._write("overwrite")

    def release(self) -> None:
        """Remove the claim file if it still names this process."""
        with refused_as(CalibError, Exception, f"cannot write {self.address}: {{}}"):
            if (self._read() or "").startswith(self.owner):
                self.files.rm_file(self.path)


class _Copy:
    """A local copy of a folder at an address, with the state of its files when they were last transferred."""

    def __init__(self, files: Any, root: str, folder: Path, claim: _Claim) -> None:
        self.files, self.root, self.folder, self.claim = files, root, folder, claim
        folder.mkdir()
        with refused_as(CalibError, Exception, f"cannot read {claim.address}: {{}}"):
            for path in files.find(root):
                name = path[len(root) + 1 :]
                if name != CLAIM and not name.endswith(PASSING):
                    (folder / name).parent.mkdir(parents=True, exist_ok=True)
                    files.get_file(path, str(folder / name))
        self.known = self._now()

    def _now(self) -> dict[str, tuple[int, int]]:
        """Return the modification time [ns] and size [bytes] of each file in the local copy, by name."""
        paths = (path for path in self.folder.rglob("*") if path.is_file() and path.suffix not in PASSING)
        return {
            path.relative_to(self.folder).as_posix(): (path.stat().st_mtime_ns, path.stat().st_size) for path in paths
        }

    def keep(self, stop: Event, period: float) -> None:
        """Renew the claim and write back changed files every `period` seconds until the event `stop`.

        Errors are ignored here; those that persist are raised by the last transfer, at the end.
        """
        while not stop.wait(period):
            try:
                self.put_back()
            except Exception:
                continue

    def put_back(self) -> None:
        """Write changed files to the address, those in `LAST` after all others."""
        self.claim.renew()
        state = self._now()
        changed = [name for name in state if state[name] != self.known.get(name)]
        for name in sorted(changed, key=lambda name: name in LAST):
            target = f"{self.root}/{name}"
            self.files.makedirs(target.rpartition("/")[0], exist_ok=True)
            self.files.put_file(str(self.folder / name), f"{target}.part")
            self.files.mv(f"{target}.part", target)
            self.known[name] = state[name]
        for name in self.known.keys() - state.keys():
            self.files.rm_file(f"{self.root}/{name}")
            del self.known[name]

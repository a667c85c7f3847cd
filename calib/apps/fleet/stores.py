"""Sessions and studies in object storage or a shared folder, by addresses of fsspec (``s3://bucket/cell7``).

Who works on one fetches its folder, works on the copy, and puts back what changed: every few seconds, and at the end;
the files that say what is complete (`LAST`) after all others, whole or not at all. A killed process thus leaves what
it had put back, and the next one goes on from there.

``calib.claim`` in the folder says who works on it, and is rewritten all the while. Where it has not changed for `LEASE`
seconds its owner is gone, and the next one takes it over; an owner that was only slow then writes nothing more.
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
    """Return whether `place` is an address, and no path."""
    return "://" in str(path)


def sessions(address: str) -> list[str]:
    """Return the addresses of the sessions that match one with or without wildcards; empty for a path."""
    if not is_address(address):
        return []
    files, root = _opened(address)
    with refused_as(UsageError, Exception, f"{address} cannot be read: {{}}"):
        session_paths = sorted(files.glob(f"{root}/{SESSION}"))
    require(session_paths, f"{address}: no session is there ({SESSION})", UsageError)
    return [files.unstrip_protocol(path.rpartition("/")[0]) for path in session_paths]


@contextmanager
def held(address: str, lease: float = LEASE) -> Iterator[Path]:
    """Yield a copy of the folder at an address, held for this process; what changes in it is put back.

    Raises:
        UsageError: where no storage is.
        Busy: while another process works on it.
        CalibError: where it cannot be read or written (another process took over; the storage is full). What was put
            back before stays.
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
    """The file that says who works on a folder; made by taking it."""

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
        """Return the claim's text; None where there is none."""
        try:
            return self.files.cat_file(self.path).decode()
        except FileNotFoundError:
            return None

    def renew(self) -> None:
        """Show that this process is alive; raise if another one took over."""
        holder = self._read() or ""
        message = f"{self.address} was taken over by {holder or 'nobody'}; nothing more was written there"
        require(holder.startswith(self.owner), message)
        self.beats += 1
        self._write("overwrite")

    def release(self) -> None:
        """Give the folder free, if it is still ours."""
        with refused_as(CalibError, Exception, f"cannot write {self.address}: {{}}"):
            if (self._read() or "").startswith(self.owner):
                self.files.rm_file(self.path)


class _Copy:
    """A folder's copy on this machine, with what is known of its files at the address."""

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
        """Return what tells whether a file has changed, by name."""
        paths = (path for path in self.folder.rglob("*") if path.is_file() and path.suffix not in PASSING)
        return {
            path.relative_to(self.folder).as_posix(): (path.stat().st_mtime_ns, path.stat().st_size) for path in paths
        }

    def keep(self, stop: Event, period: float) -> None:
        """Renew the claim and put back what changed until `stop`; what goes wrong is said when the work ends."""
        while not stop.wait(period):
            try:
                self.put_back()
            except Exception:
                continue

    def put_back(self) -> None:
        """Write what changed, `LAST` last."""
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

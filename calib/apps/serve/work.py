"""The worker of a served session: jobs run one at a time, each in a separate process.

A job is a run of `calib next` or `calib redo`, or a check or join of uploaded files. Its messages are stored here, so
that every page, reloaded or in another tab, shows the same progress.
"""

import os
import signal
import sys
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Lock, Thread
from typing import Any

from calib import bug_reports
from calib.apps.serve.received import Pairing, join_received
from calib.apps.serve.split_logs import MOTIONS, join_halves
from calib.errors import command_line, complaint
from calib.toolkit.sessions import POSES, UNSEEN, Session, open_session
from calib.workers.processes import end_with_parent

CHECK, JOIN, NEXT, REDO = "check", "join", "next", "redo"
# jobs on uploaded files, beside runs of the session
OF_FILES = (CHECK, JOIN)
INTERRUPTED = "it was interrupted; nothing is lost, continue from here"
# a forked process has threads of libraries that are not there
_spawned = get_context("spawn")


@dataclass
class Job:
    """A run, a check or a join, and its messages until now.

    Attributes:
        task: `CHECK`, `JOIN`, `NEXT` or `REDO`.
        subject: the kind of files to check or join, or the step to repeat; empty for `NEXT`.
        pairing: what is joined; None for other tasks.
        lines: permanent messages.
        words: the last transient message.
        problem: why the job failed; empty otherwise.
        began: time at which the job began, by `time.monotonic` [s].
    """

    task: str
    subject: str = ""
    pairing: Pairing | None = None
    lines: list[str] = field(default_factory=list)
    words: str = ""
    problem: str = ""
    began: float = 0.0

    @property
    def seconds(self) -> int:
        """Whole seconds since the job began."""
        return round(time.monotonic() - self.began)


class Work:
    """Runs jobs on a session's folder one after the other, each in a separate process.

    Attributes:
        current: the job in progress; None if there is none.
        last: the last run of `calib next` or `calib redo`; None if there was none.
        checks, joins: kind of files to their last check, and their last join.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.current: Job | None = None
        self.last: Job | None = None
        self.checks: dict[str, Job] = {}
        self.joins: dict[str, Job] = {}
        self._waiting: deque[Job] = deque()
        self._lock = Lock()
        self._process: Any = None

    def ask(self, task: str, subject: str = "", pairing: Pairing | None = None) -> bool:
        """Queue a job and return whether it was queued.

        A job is not queued if an equal one is already queued, or if it is a run and another run is queued or in
        progress.

        Args:
            task: `CHECK`, `JOIN`, `NEXT` or `REDO`.
            subject: the kind of files to check or join, or the step to repeat; empty for `NEXT`.
            pairing: what is to be joined; None for other tasks.
        """
        with self._lock:
            jobs = list(self._waiting)
            if self.current and task not in OF_FILES:
                jobs.append(self.current)
            for job in jobs:
                is_run = task not in OF_FILES and job.task not in OF_FILES
                if is_run or (job.task, job.subject, job.pairing) == (task, subject, pairing):
                    return False
            self._waiting.append(Job(task, subject, pairing))
            if self.current is None:
                self._begin()
            return True

    def _begin(self) -> None:
        self.current = job = self._waiting.popleft()
        job.began = time.monotonic()
        receiver, sender = _spawned.Pipe(duplex=False)
        self._process = _spawned.Process(target=_run, args=(sender, self.folder, job))
        self._process.start()
        sender.close()
        Thread(target=self._listen, args=(job, receiver, self._process), daemon=True).start()

    def _listen(self, job: Job, receiver: Connection, process: Any) -> None:
        with suppress(EOFError, OSError):
            while True:
                kind, text = receiver.recv()
                if kind == "line":
                    job.lines.append(text)
                else:
                    setattr(job, kind, text)
        process.join()
        if process.exitcode and not job.problem:
            job.problem = INTERRUPTED
        with self._lock:
            if job.task == CHECK:
                self.checks[job.subject] = job
            elif job.task == JOIN:
                self.joins[job.subject] = job
            else:
                self.last = job
            self.current = None
            if self._waiting:
                self._begin()

    def stop(self) -> None:
        """Interrupt the job in progress, as Ctrl-C does, and discard queued ones; the session can be resumed."""
        self._waiting.clear()
        if self._process is not None and self._process.is_alive():
            # Windows has no Ctrl-C for one process: what it wrote is whole all the same
            if sys.platform != "win32":
                with suppress(ProcessLookupError):
                    os.kill(self._process.pid, signal.SIGINT)
                self._process.join(10.0)
            self._process.kill()


def _run(sender: Connection, folder: Path, job: Job) -> None:
    """Run a job in this (separate) process, and send its messages through a pipe.

    Args:
        sender: the pipe.
        folder: the session's folder.
        job: the job.
    """
    from calib.toolkit.sessions import go_on

    def send(kind: str, text: object) -> None:
        sender.send((kind, str(text)))

    Thread(target=end_with_parent, daemon=True).start()
    say = partial(send, "line")
    command = command_line("serve", folder)
    try:
        if job.task == CHECK:
            for line in checked(open_session(folder), job.subject):
                say(line)
        elif job.task == JOIN and job.pairing is not None:
            join = join_received
            if job.subject in MOTIONS:
                join = join_halves
            for line in join(open_session(folder), job.subject, job.pairing):
                say(line)
        elif job.task == REDO:
            go_on(folder, say, partial(send, "words"), command, job.subject)
        else:
            go_on(folder, say, partial(send, "words"), command)
    except KeyboardInterrupt:
        send("problem", INTERRUPTED)
    except Exception as error:
        foreseen = complaint(error)
        if foreseen:
            send("problem", foreseen[0])
        else:
            send("problem", bug_reports.report(error, [command], folder))


def checked(session: Session, kind: str) -> list[str]:
    """Check uploaded files as the session's step would, and return notes on them.

    Args:
        session: the session.
        kind: kind of the files, a key of `calib.apps.serve.uploads.BROUGHT`.

    Raises:
        CalibError: files that the step would refuse.
    """
    from calib.toolkit.sessions import chain_of, check_recording, notes_on, read_measured

    paths = session.brought(kind)
    if kind in ("training", "unseen"):
        if not session.fit.robot.exists():
            return ["the logs are checked once the geometry is fitted"]
        motion = "validation"
        if kind == "training":
            motion = "training"
        notes = []
        for path in paths:
            notes += check_recording(session, path, motion)[1]
        return notes
    chain = chain_of(session)
    blocks = read_measured(session, chain, paths)
    if kind == "drift":
        return [f"{name}: {len(block)} rows" for name, block in blocks]
    plan = UNSEEN
    if kind == "measured":
        plan = POSES
    return [str(note) for note in notes_on(session, chain, blocks, plan)]

"""Parallel run of many sessions, one folder per robot; a failed session does not stop the others."""

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from calib import bug_reports, files
from calib.apps.fleet import stores
from calib.apps.fleet.stores import LEASE
from calib.apps.fleet.throughput import Throughput
from calib.arguments import checked
from calib.config_types import Plots
from calib.errors import Busy, CalibError, TaskLost, complaint
from calib.toolkit.result_folders import LEVELS
from calib.toolkit.sessions import COLOURS, DONE, SETTINGS, Say, folders_of, go_on, position_errors, torque_error
from calib.workers import Workers
from calib.workers import workers as opened

LOG = "run.log"
# what a session comes to, or `DONE`
WAITS = "waits"
BUSY = "busy"
FAILED = "failed"


@dataclass(frozen=True)
class FleetRow:
    """The outcome of one session: state, verdict, errors and exit code.

    Attributes:
        folder: the session's folder or address.
        state: `DONE`, `WAITS`, `BUSY` (another command works on the session) or `FAILED`.
        verdict: verdict of a finished session; else empty.
        words: the file for which the session waits, or the error message.
        asks: instructions to the engineer at the robot, one per line.
        nominal, calibrated: rms position errors of the nominal and of the calibrated robot at held-out poses [mm]; None
            without such poses.
        torque: unexplained share of the torque on the held-out motion [%]; None without dynamics.
        seconds: wall-clock time [s].
        code: exit code, as of `calib next`.
    """

    folder: str
    state: str
    verdict: str = ""
    words: str = ""
    nominal: float | None = None
    calibrated: float | None = None
    torque: float | None = None
    seconds: float = 0.0
    code: int = 0
    asks: tuple[str, ...] = ()

    def __str__(self) -> str:
        return "\n".join([self.line(), *(self.asks or remarks([self]))])

    def line(self) -> str:
        """Return the outcome of the session as one line."""
        parts = [self.state]
        if self.verdict:
            parts.append(self.verdict)
        if self.nominal is not None:
            parts.append(f"{self.nominal:.3g} → {self.calibrated:.3g} mm")
        if self.torque is not None:
            parts.append(f"torque {self.torque:.3g} %")
        parts.append(f"{self.seconds:.1f} s")
        return f"{self.folder}: {', '.join(parts)}"


@checked
def run_sessions(
    folders: str | Path | Sequence[str | Path],
    *,
    workers: str | int = 1,
    plots: Plots = True,
    command: str = "calib.run_sessions",
) -> Iterator[FleetRow]:
    """Run each session until it is complete or waits for files, and yield the outcome of each.

    A failed session does not stop the others.

    Args:
        folders: one or several folders of sessions, or their ``session.toml``. Or addresses of fsspec, with or without
            wildcards (``s3://bucket/cells/*``): each worker fetches its session, and writes it back.
        workers: number of local processes, or the address of a Dask scheduler.
        plots: whether figures are drawn.
        command: command line that the sessions record.

    Returns:
        Rows in the order in which sessions end: ``folder``, ``state`` (done, waits, busy or failed), ``verdict``;
        ``print`` shows the instructions to the engineer.

    Raises:
        UsageError: a session named twice, or a folder without one.
    """
    return run(folders_of(folders, stores.sessions), opened(workers), command, plots)


def run(
    folders: Sequence[Path | str],
    workers: AbstractContextManager[Workers],
    command: str,
    plots: Plots = True,
    pace: Throughput | None = None,
) -> Iterator[FleetRow]:
    """Run every session and yield each outcome as the session ends.

    Args:
        folders: the sessions' folders, or addresses. Workers on other machines need the folders at identical paths.
        workers: context that opens the workers.
        command: command line that the sessions record.
        plots: whether figures are drawn.
        pace: record of the workers' throughput, which is updated; None: not recorded.
    """
    pace = pace or Throughput()
    run_folder = partial(run_session, command=command, plots=plots)
    with workers as crew:
        tasks = list(folders)
        if not crew.here:
            # another process may stand in another folder
            tasks = [folder.absolute() if isinstance(folder, Path) else folder for folder in folders]
        for number, outcome in pace.completed(crew, run_folder, tasks):
            name = str(folders[number])
            if isinstance(outcome, TaskLost):
                yield FleetRow(name, FAILED, words=str(outcome), code=2)
            else:
                yield replace(outcome, folder=name)


def run_session(folder: Path | str, command: str = "calib run", plots: Plots = True, lease: float = LEASE) -> FleetRow:
    """Run one session until it is complete or waits for files, and return the outcome.

    Its output is written to ``run.log``. Errors become part of the outcome; only KeyboardInterrupt (Ctrl-C) is raised.

    Args:
        folder: the session's folder, or its address.
        command: command line that the session records.
        plots: whether figures are drawn.
        lease: time without a sign of life after which another process may take the session over [s], see
            `calib.apps.fleet.stores`.
    """
    if isinstance(folder, Path):
        return _run_here(folder, command, plots)
    started = time.perf_counter()
    try:
        with stores.held(folder, lease) as copy:
            outcome = _run_here(copy, command, plots)
    except CalibError as error:
        outcome = FleetRow(folder, _state_of(error), words=str(error), code=2)
    return replace(outcome, folder=folder, seconds=time.perf_counter() - started)


def _run_here(folder: Path, command: str, plots: Plots) -> FleetRow:
    started = time.perf_counter()
    messages: list[str] = []
    try:
        outcome = _go_on(folder, messages.append, command, plots)
    except Exception as error:  # a robot that fails must not stop the others
        foreseen = complaint(error)
        if foreseen:
            message, code = foreseen
        else:
            message = bug_reports.report(error, command.split()[1:], folder)
            code = bug_reports.CODE
        messages.append(f"failed: {message}")
        outcome = FleetRow(str(folder), _state_of(error), words=message, code=code)
    # The log of a busy session is of the command that works on it.
    if (folder / SETTINGS).exists() and outcome.state != BUSY:
        # A full disk, or a folder that cannot be written, is said already.
        with suppress(CalibError):
            files.write(folder / LOG, "\n".join(messages) + "\n")
    return replace(outcome, seconds=time.perf_counter() - started)


def _state_of(error: Exception) -> str:
    if isinstance(error, Busy):
        return BUSY
    return FAILED


def _go_on(folder: Path, say: Say, command: str, plots: Plots) -> FleetRow:
    stop = go_on(folder, say, _no_progress, command, plots=plots)
    if stop.waiting is not None:
        instructions = stop.lines[1:]
        for line in instructions:
            say(line)
        text = f"{stop.waiting.words} (step {stop.waiting.step.name}); instructions are in {LOG}"
        return FleetRow(str(folder), WAITS, words=text, asks=instructions)
    nominal = calibrated = None
    errors = position_errors(stop.session)
    if errors:
        nominal, calibrated = errors
    code = 0
    if stop.verdict == "fail":
        code = 1
    return FleetRow(
        folder=str(folder),
        state=DONE,
        verdict=stop.verdict,
        nominal=nominal,
        calibrated=calibrated,
        torque=torque_error(stop.session),
        code=code,
    )


def _no_progress(message: str) -> None:
    pass


def table(outcomes: Sequence[FleetRow]) -> RenderableType:
    """Return the summary table, one line per robot, with errors at held-out poses and torque on held-out motions.

    The columns are state, verdict, rms position errors [mm], unexplained share of the torque [%] and time [s].

    Args:
        outcomes: outcome of each session.
    """
    summary_table = Table("session", "state", "verdict", box=None, pad_edge=False)
    for name in ("nominal mm", "calibrated mm", "torque %", "s"):
        summary_table.add_column(name, justify="right", no_wrap=True)
    names = [Path(row.folder).resolve().name for row in outcomes]
    for row, name in zip(outcomes, names):
        label = name
        if names.count(name) > 1:
            label = row.folder
        cells: list[Text | str] = [Text(label)]
        for state in (row.state, row.verdict):
            cell: Text | str = ""
            if state:
                cell = Text(state, COLOURS.get(state, "yellow"))
            cells.append(cell)
        for number in (row.nominal, row.calibrated, row.torque):
            printed = ""
            if number is not None:
                printed = f"{number:.3g}"
            cells.append(printed)
        cells.append(f"{row.seconds:.1f}")
        summary_table.add_row(*cells)
    return summary_table


def remarks(outcomes: Sequence[FleetRow]) -> Iterator[str]:
    """Yield a line for each unfinished session: the file for which the session waits, or the error message.

    Args:
        outcomes: outcome of each session.
    """
    beginnings = {WAITS: "{} waits for ", FAILED: "{} failed: "}
    for row in outcomes:
        if row.state == DONE:
            continue
        beginning = beginnings.get(row.state, "").format(row.folder)
        yield f"{beginning}{row.words}"


def summary(outcomes: Sequence[FleetRow], seconds: float) -> str:
    """Return one line with the number of sessions in each state, the number with each verdict, and the total time.

    Args:
        outcomes: outcome of each session.
        seconds: the total time [s].
    """
    states = Counter(row.state for row in outcomes)
    verdicts = Counter(row.verdict for row in outcomes)
    finished = f"{states[DONE]} of {len(outcomes)} done"
    levels = [f"{verdicts[level]} {level}" for level in LEVELS if verdicts[level]]
    if levels:
        finished += f" ({', '.join(levels)})"
    parts = [finished]
    for state, label in ((WAITS, "waiting"), (BUSY, BUSY), (FAILED, FAILED)):
        if states[state]:
            parts.append(f"{states[state]} {label}")
    return f"{', '.join(parts)}; {seconds:.1f} s"

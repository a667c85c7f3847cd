"""Shared parts of the commands: arguments, the console, progress, lists of numbers, checks of the output folder."""

import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from math import inf, isfinite
from pathlib import Path
from typing import Annotated, Any, Literal

import typer


def check_destination(
    verb: Literal["fit", "identify", "excite", "plan"],
    robot: object,
    out: Path,
    inputs: Sequence[str | Path | None] = (),
) -> None:
    """Refuse, before any work is done, a folder that `verb` must not write to, or that contains its inputs.

    Args:
        robot: a serial arm or another robot, as a person names it.
        out: where results are to go.
        inputs: what is read; none of it is written over.

    Raises:
        UsageError: with the file or folder concerned.
    """
    from calib.procedure.robot_kinds import stage_of

    if (stage := stage_of(robot, verb)) is not None:
        check = stage.check
    elif verb == "fit":
        from calib.procedure.kinematic_stage.folder import check_fit_target as check
    elif verb == "identify":
        from calib.procedure.dynamic_stage.folder import check_identification_target as check
    elif verb == "excite":
        from calib.procedure.excitation.folder import check_design_target as check
    else:
        from calib.procedure.excitation.folder import check_plan_target as check
    check(out, inputs)


PIPED = 160  # columns of tables that no terminal bounds
MAX_LINES = 25  # that a command prints without -v, warnings and verdicts not counted
MAX_LAST_LINES = 9  # of these the ones it ends with

Out = Annotated[Path, typer.Option()]
Seed = Annotated[int, typer.Option(min=0, help="reproduces everything random")]


def make_console(**options: Any) -> Any:
    from rich.console import Console

    stream = sys.stderr if options.get("stderr") else sys.stdout
    if not stream.isatty() and "COLUMNS" not in os.environ:
        options.setdefault("width", PIPED)  # rich takes 80, and cuts the files' names
    return Console(highlight=False, **options)


class _Output:
    """Output of a command: everything with -v, else at most `MAX_LINES` without details (indented lines, tables)."""

    def __init__(self, verbose: bool) -> None:
        self.verbose, self.printed, self.left_out = verbose, 0, 0
        self.last: list[Any] = []  # what is printed at the end, with its console

    def show(self, line: Any, console: Any, result: bool) -> None:
        words = " " if hasattr(line, "add_column") else str(line)
        if self.verbose or result or re.match(r"\s*(verdict|warning)\b", words):
            self.last.append((line, console, True))
        elif words.startswith(" "):
            self.left_out += getattr(line, "row_count", 1)
        else:
            self.printed += 1
            self.last.append((line, console, False))
        if self.printed <= MAX_LINES - MAX_LAST_LINES:
            self.flush()
        elif self.printed > MAX_LINES:
            self.last.remove(next(one for one in self.last if not one[2]))
            self.printed, self.left_out = self.printed - 1, self.left_out + 1

    def flush(self) -> None:
        for line, console, _ in self.last:
            console.print(line, soft_wrap=True, markup=False)
        self.last = []

    def end(self) -> None:
        self.flush()
        if self.left_out:
            make_console().print(f"… {self.left_out} more lines with -v")


_OUTPUT: ContextVar[_Output | None] = ContextVar("output", default=None)


@contextmanager
def printing(verbose: bool) -> Iterator[None]:
    """Print the lines given to `say` in the block, or the most important of them."""
    output = _Output(verbose)
    token = _OUTPUT.set(output)
    try:
        yield
    finally:
        _OUTPUT.reset(token)
        output.end()


def say(*lines: Any, console: Any = None, result: bool = False) -> None:
    """Print lines of text and rich renderables; a `result` was asked for and is never left out."""
    console, output = console or make_console(), _OUTPUT.get() or _Output(verbose=True)
    for line in lines:
        output.show(line, console, result)


def say_written(lines: Iterable[Any], out: Path, verdict: str = "") -> None:
    """Print lines, and the path of the results.

    Raises:
        typer.Exit: with code 1 where the verdict is fail.
    """
    say(*lines, f"written to {out}")
    exit_failed(verdict)


def exit_failed(verdict: str) -> None:
    """Exit with code 1 if the verdict is fail."""
    if verdict == "fail":
        raise typer.Exit(1)


@contextmanager
def progress() -> Iterator[Any]:
    """Show the progress on stderr if it is a terminal."""
    console = make_console(stderr=True)
    with console.status("") as status:
        yield lambda words: status.update(str(words))


def _now_and_then(every: float) -> Callable[[str], None]:
    """Return a function that prints a message on stderr, at most once in the given seconds."""
    due = time.monotonic() + every

    def say_if_due(words: str) -> None:
        nonlocal due
        if (now := time.monotonic()) >= due:
            due = now + every
            print(words, file=sys.stderr, flush=True)

    return say_if_due


@contextmanager
def reporting(logged: float = inf) -> Iterator[tuple[Any, Any]]:
    """Yield two functions: one for permanent lines, one for progress messages.

    Args:
        logged: seconds between such words on stderr where the output is no terminal, but a file or a job's log.
    """
    from rich.markup import escape

    console = make_console()
    if not console.is_terminal and logged < inf:
        yield partial(say, console=console), _now_and_then(logged)
        return
    with console.status("") as status:
        yield partial(say, console=console), lambda words: status.update(escape(words))


def numbers(text: str, count: int, option: str, finite: bool = True) -> list[float]:
    from calib.errors import UsageError
    from calib.units import plain_number

    try:
        values = [plain_number(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or (finite and not all(map(isfinite, values))):
        raise UsageError(f"{option} {text}: expected {count} finite numbers separated by commas")
    return values

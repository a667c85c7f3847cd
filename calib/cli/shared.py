"""What several commands share: arguments, the console, progress, lists of numbers."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import typer

PIPED = 160  # columns of tables that no terminal bounds

Robot = Annotated[str, typer.Argument(help="a .urdf, an MDH .toml, a library name, or the folder of an earlier fit")]
Base = Annotated[str | None, typer.Option(help="URDF: the link the arm starts at")]
Tip = Annotated[str | None, typer.Option(help="URDF: the link the arm ends at")]
Plots = Annotated[bool, typer.Option("--plots/--no-plots", help="draw figures, or leave them out")]
Seed = Annotated[int, typer.Option(min=0, help="reproduces everything random")]


def make_console(**options: Any) -> Any:
    from rich.console import Console

    stream = sys.stderr if options.get("stderr") else sys.stdout
    if not stream.isatty() and "COLUMNS" not in os.environ:
        options.setdefault("width", PIPED)  # rich takes 80, and cuts the files' names
    return Console(highlight=False, **options)


def say_written(lines: Iterable[str], out: Path) -> None:
    """Print lines as they are, and where the results lie."""
    console = make_console()
    for words in (*lines, f"written to {out}"):
        console.print(words, soft_wrap=True, markup=False)


@contextmanager
def progress() -> Iterator[Any]:
    """Show on stderr what is being done, where stderr is a terminal."""
    console = make_console(stderr=True)
    with console.status("") as status:
        yield lambda words: status.update(str(words))


@contextmanager
def told() -> Iterator[tuple[Any, Any, Any]]:
    """Yield a console, and two functions on it: for lines that stay, and for words that show while work goes on."""
    from rich.markup import escape

    console = make_console()
    with console.status("") as status:
        say = lambda words: console.print(words, soft_wrap=True, markup=False)  # noqa: E731
        yield console, say, lambda words: status.update(escape(words))


def numbers(text: str, count: int, option: str, finite: bool = True) -> list[float]:
    from calib.errors import UsageError

    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or (finite and not all(map(isfinite, values))):
        raise UsageError(f"{option} {text}: expected {count} finite numbers with commas between them")
    return values

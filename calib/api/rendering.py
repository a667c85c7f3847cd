"""Results as text and HTML: console text for ``print(result)``, and the certificate as a page for notebooks.

What the verbs take in several forms: one or many, a file that may be missing, a result or its folder.
"""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from calib.procedure.report.page import Page, Section

import sys
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from calib.errors import refused_as

Progress = Callable[[str], None]


def listed(given: object | Sequence[object]) -> list:
    """Return a single value as a list of one, and nested sequences as a flat list."""
    if isinstance(given, (str, Path)) or not isinstance(given, Sequence):
        return [given]
    return [one for each in given for one in listed(each)]


def optional(given: Any) -> Any:
    """Return a text as a path, and any other value unchanged."""
    return Path(given) if isinstance(given, str) else given


def progress_shown(progress: Progress | None) -> Progress | None:
    """Return the given progress reporter; without one, in a notebook, a line below the cell; otherwise None."""
    notebook = sys.modules.get("IPython")
    if progress is not None or notebook is None or not hasattr(notebook.get_ipython(), "kernel"):
        return progress
    line = notebook.display.display({"text/plain": ""}, raw=True, display_id=True)
    return lambda words: line.update({"text/plain": words}, raw=True)


@contextmanager
def saved(result: Any) -> Iterator[Path]:
    """Yield the folder of a result: a given path unchanged, or a temporary folder of a result in memory."""
    if isinstance(result, (str, Path)):
        yield Path(result)
    else:
        with TemporaryDirectory() as place:
            yield result.save(Path(place) / "result", plots=False)


WIDTH = 120


def as_text(renderables: Iterable[Any]) -> str:
    """Return rich renderables as plain text."""
    from rich.console import Console

    console = Console(file=io.StringIO(), width=WIDTH, highlight=False, color_system=None)
    for each in renderables:
        console.print(each, soft_wrap=True)
    return console.file.getvalue().rstrip()  # type: ignore[attr-defined]


class Judged(ABC):
    """A result shown as a section of a report: on a console, by ``print``, and as a page in a notebook."""

    @abstractmethod
    def section(self) -> Section:
        """Return the report section: verdict, figures, tables, sentences."""

    @property
    def outcome(self) -> Self:
        """The result itself (for compatibility with earlier versions)."""
        return self

    def renderables(self) -> Iterator[Any]:
        """Yield the rich renderables that ``print`` shows."""
        from calib.procedure.report import page

        yield from page.section(self.section())

    def __str__(self) -> str:
        return as_text(self.renderables())

    def page(self) -> Page:
        """Return the section as a page with a title."""
        from calib.procedure.report import certificate

        return certificate.certificate(repr(self).strip("<>"), "", (), [self.section()])

    def _repr_html_(self) -> str:
        from calib.procedure.report import certificate

        return certificate.render(self.page())


def data_frame(rows: Iterable[Any], columns: list[str]) -> Any:
    """Return rows as a pandas DataFrame.

    Raises:
        UsageError: where pandas is not installed.
    """
    from calib.errors import UsageError

    with refused_as(UsageError, ImportError, "to_dataframe needs pandas: pip install pandas, or use to_dict"):
        from pandas import DataFrame  # pyright: ignore[reportMissingImports]
    return DataFrame(list(rows), columns=columns)

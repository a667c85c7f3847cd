"""Results as text and HTML: console text for ``print(result)``, and a page for notebooks, which a room makes.

What the verbs take in several forms: one or many, a file that may be missing, a result or its folder.
"""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, ClassVar, Self, overload

from calib.errors import UsageError, one_of, refused_as
from calib.workers.threads import one_blas_thread

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calib.procedure.report.charts import Chart
    from calib.procedure.report.page import Section

Progress = Callable[[str], None]


def listed(given: object | Sequence[object]) -> list:
    """Return a single value as a list of one, and nested sequences as a flat list."""
    if isinstance(given, (str, Path)) or not isinstance(given, Sequence):
        return [given]
    return [one for each in given for one in listed(each)]


def optional(given: Any) -> Any:
    """Return a text as a path, and any other value unchanged."""
    return Path(given) if isinstance(given, str) else given


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

    console = Console(file=io.StringIO(), width=WIDTH, highlight=False, color_system=None, force_jupyter=False)
    for each in renderables:
        console.print(each, soft_wrap=True)
    return console.file.getvalue().rstrip()  # type: ignore[attr-defined]


class Shown:
    """A result that a notebook shows as ``print`` does, with the members in `tab` on Tab."""

    tab: ClassVar[str] = ""

    def __dir__(self) -> list[str]:
        return self.tab.split()

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        return {"text/plain": str(self)}


class Drawn(Shown, ABC):
    """A result with figures."""

    @abstractmethod
    def charts(self) -> Mapping[str, Chart]:
        """Return what the figures show, by name."""

    @overload
    def plot(self) -> dict[str, Figure]: ...
    @overload
    def plot(self, name: str) -> Figure: ...
    @one_blas_thread()
    def plot(self, name: str | None = None) -> Any:
        """Return one of the figures, or all of them by name."""
        from calib.procedure.report import charts

        found = self.charts()
        if name is None:
            return {each: charts.figure(chart) for each, chart in found.items()}
        return charts.figure(found[one_of(name, found, "plot", UsageError)])


class Judged(Shown, ABC):
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

    def _repr_html_(self) -> str | None:
        """Return the result as a page, as notebooks show it."""
        from calib.procedure.report.certificate.results import notebook

        return notebook(self)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        """Return the page in a frame of its own, so that its style does not become the notebook's."""
        page, frame = self._repr_html_(), '<iframe srcdoc="{}" style="width: 100%; height: 60em; border: 0"></iframe>'
        return super()._repr_mimebundle_() | ({"text/html": frame.format(escape(page))} if page else {})


def data_frame(rows: Iterable[Any], columns: Sequence[str]) -> Any:
    """Return rows as a pandas DataFrame.

    Raises:
        UsageError: where pandas is not installed.
    """
    words = "data frames need pandas: pip install 'armature-calib[pandas]'; to_dict() and save() do without"
    with refused_as(UsageError, ImportError, words):
        from pandas import DataFrame  # pyright: ignore[reportMissingImports]
    return DataFrame(list(rows), columns=list(columns))

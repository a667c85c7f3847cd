"""Base classes of results in memory: console text for ``print(result)``, and a page for notebooks.

The module also has helpers for arguments of API functions that have several forms: one value or several, an optional
file, a result or its folder.
"""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self, overload

from calib.config_types import Plots
from calib.errors import CalibError, UsageError, one_of
from calib.procedure.findings import NOT_JUDGED, Verdict
from calib.result_kinds import ResultKind
from calib.workers.extras import needing
from calib.workers.threads import one_blas_thread

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calib.data.csv_table import Table
    from calib.procedure.report.figures.charts import Captioned, Chart
    from calib.procedure.report.page import ChartPicture, Section
    from calib.results.scene import Scene

Progress = Callable[[str], None]
# number of characters of a line of text
WIDTH = 120


def listed(value: object | Sequence[object]) -> list:
    """Return a single value as a list with one item, and nested sequences as a flat list."""
    if isinstance(value, (str, Path)) or not isinstance(value, Sequence):
        return [value]
    result = []
    for item in value:
        result += listed(item)
    return result


def charts_of(captioned: Mapping[str, Captioned]) -> dict[str, Chart]:
    """Return charts by name, without their captions."""
    return {name: chart for name, (chart, _) in captioned.items()}


def optional(value: object) -> Any:
    """Return a text as a path, and any other value unchanged."""
    return Path(value) if isinstance(value, str) else value


class SavedResult(Protocol):
    """A result that can be written to a folder."""

    def save(self, out: str | Path, /, *, plots: Plots = True) -> Path:
        """Write the result's folder, and return the folder's path.

        Args:
            out: folder to write.
            plots: False: no figures, True: in the page, ``png`` or ``svg``: as files, too.
        """
        ...


@contextmanager
def saved(result: str | Path | SavedResult) -> Iterator[Path]:
    """Yield the folder of a result: a given path unchanged, or a temporary folder (or file) of a result in memory.

    The temporary folder is removed at the end of the block.
    """
    if isinstance(result, (str, Path)):
        yield Path(result)
        return
    name = "result"
    if isinstance(result, Kept) and result.kind.companion:
        name = "result.csv"
    with TemporaryDirectory() as folder:
        path = result.save(Path(folder) / name, plots=False)
        try:
            yield path
        except CalibError as error:
            # Messages name the result, not a folder that is gone.
            error.args = tuple(_renamed(argument, str(path), repr(result)) for argument in error.args)
            raise


def _renamed(argument: object, path: str, name: str) -> object:
    """Return an error's argument; if it is a text, with the temporary `path` replaced by `name` of the result."""
    if isinstance(argument, str):
        return argument.replace(path, name)
    return argument


def as_text(renderables: Iterable[object]) -> str:
    """Return the plain text that the library rich prints for `renderables`, objects such as tables and panels."""
    from rich.console import Console

    console = Console(file=io.StringIO(), width=WIDTH, highlight=False, color_system=None, force_jupyter=False)
    for renderable in renderables:
        console.print(renderable, soft_wrap=True)
    return console.file.getvalue().rstrip()  # ty: ignore[missing-attribute]


class Shown:
    """A result that notebooks show with the text of ``print``.

    Completion by the Tab key lists the members named in `tab`.
    """

    tab: ClassVar[str] = ""

    def __dir__(self) -> list[str]:
        return self.tab.split()

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return {"text/plain": str(self)}


class Kept(Shown, ABC):
    """A result in memory that can be written to a folder.

    It implements the interface `calib.Result` by writing a temporary folder and reading it.

    Attributes:
        kind: kind of the result, one of `calib.result_kinds.KINDS`.
    """

    kind: ClassVar[ResultKind]

    @abstractmethod
    def save(self, out: str | Path, /, *, plots: Plots = True) -> Path:
        """Write the result's folder, and return the folder's path.

        Args:
            out: folder to write.
            plots: False: no figures, True: in the page, ``png`` or ``svg``: as files, too.
        """

    def figures(self) -> Mapping[str, ChartPicture]:
        """Return the figures by name; empty for a result without figures."""
        return {}

    def tables(self) -> Mapping[str, Table]:
        """Return the tables by name, with the content of the files that `save` writes."""
        from calib.results.result_classes import open_result

        with saved(self) as folder:
            return open_result(folder).tables()

    def scene(self, robot: str | None = None) -> Scene:
        """Return the scene that the viewer draws: robot, poses, motions, torques.

        Args:
            robot: name or file of the robot to draw; None takes the robot of the result.
        """
        from calib.results.result_classes import open_result

        with saved(self) as folder:
            return open_result(folder, "view").scene(robot)


class WithoutVerdict(Kept):
    """A result without a verdict, such as a designed motion."""

    @property
    def verdict(self) -> Verdict:
        """The verdict with the level `NOT_JUDGED`."""
        return Verdict(NOT_JUDGED, f"{self.kind.noun} has no verdict")


class ChartedResult(Kept):
    """A result with figures, made from charts."""

    def figures(self) -> Mapping[str, ChartPicture]:
        """Return the figures by name: charts, which are drawn when their ``image`` is asked for."""
        from calib.procedure.report.page import ChartPicture

        return {name: ChartPicture(chart, "", name) for name, chart in self.charts().items()}

    @abstractmethod
    def charts(self) -> Mapping[str, Chart]:
        """Return the charts, from which the figures are drawn, by name."""

    @overload
    def plot(self) -> dict[str, Figure]: ...
    @overload
    def plot(self, name: str) -> Figure: ...
    @one_blas_thread()
    def plot(self, name: str | None = None) -> Any:
        """Return the figure of the given name; without a name, all figures by name.

        Raises:
            UsageError: there is no figure of this name.
        """
        with needing("matplotlib"):
            from calib.procedure.report.figures.drawing import figure

        charts = self.charts()
        if name is None:
            return {title: figure(chart) for title, chart in charts.items()}
        one_of(name, charts, "plot", UsageError)
        return figure(charts[name])


class ReportedResult(Kept):
    """A result with a verdict and a report section, shown by ``print`` on the console and as a page in a notebook."""

    @abstractmethod
    def section(self) -> Section:
        """Return the report section of the result: verdict, figures, tables, sentences."""

    @property
    def outcome(self) -> Self:
        """The result itself (for compatibility with earlier versions)."""
        return self

    def renderables(self) -> Iterator[object]:
        """Yield the objects of the library rich that ``print`` shows."""
        from calib.procedure.report import page

        yield from page.section(self.section())

    def __str__(self) -> str:
        return as_text(self.renderables())

    def _repr_html_(self) -> str | None:
        """Return the HTML page of the result that notebooks show."""
        from calib.procedure.report.certificate.results import notebook

        return notebook(self)

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        """Return the page inside an HTML frame, so that its style does not affect the notebook."""
        bundle = super()._repr_mimebundle_()
        page = self._repr_html_()
        if page:
            frame = f'<iframe srcdoc="{escape(page)}" style="width: 100%; height: 60em; border: 0"></iframe>'
            bundle["text/html"] = frame
        return bundle

"""What the verbs take in several forms: one or many, a file that may be missing, a result or its folder."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any


def listed(given: object | Sequence[object]) -> list:
    """Return what was given, one or several, some of them several in turn, as a list."""
    if isinstance(given, (str, Path)) or not isinstance(given, Sequence):
        return [given]
    return [one for each in given for one in listed(each)]


def optional(given: Any) -> Any:
    """Return a text as the path it is, and any other value, None included, as it is."""
    return Path(given) if isinstance(given, str) else given


def progress_shown(progress: Callable[[str], None] | None) -> Callable[[str], None] | None:
    """Return what reports progress: what was given; by default, in a notebook, a line under its cell; else None."""
    notebook = sys.modules.get("IPython")
    if progress is not None or notebook is None or not hasattr(notebook.get_ipython(), "kernel"):
        return progress
    line = notebook.display.display({"text/plain": ""}, raw=True, display_id=True)
    return lambda words: line.update({"text/plain": words}, raw=True)


@contextmanager
def saved(result: Any) -> Iterator[Path]:
    """Yield the folder of a result: a path as it is, a result in memory written for as long as it is needed."""
    if isinstance(result, (str, Path)):
        yield Path(result)
    else:
        with TemporaryDirectory() as place:
            yield result.save(Path(place) / "result", plots=False)

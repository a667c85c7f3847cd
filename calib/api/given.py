"""What the verbs take in several forms: one or many, a file that may be missing, a result or its folder."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any


def listed(given: object | Sequence[object]) -> list:
    """Return what was given, one or several, some of them several in turn, as a list."""
    if isinstance(given, (str, Path)) or not isinstance(given, Sequence):
        return [given]
    return [one for each in given for one in listed(each)]


def optional(path: str | Path | None) -> Path | None:
    """Return a path that may be missing."""
    return None if path is None else Path(path)


@contextmanager
def saved(result: Any) -> Iterator[Path]:
    """Yield the folder of a result: a path as it is, a result in memory written for as long as it is needed."""
    if isinstance(result, (str, Path)):
        yield Path(result)
    else:
        with TemporaryDirectory() as place:
            yield result.save(Path(place) / "result", plots=False)

"""What the shell completes: robots of the library, topics, codes. Loads nothing heavy: Tab must answer at once."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from calib.config_types import OneOf
from calib.extensions import Point

LIBRARY: Point[Path] = Point("library", "folders of robots that go by a name")


def robots(incomplete: str) -> Iterator[str]:
    """Yield the library's robots that begin with what is typed, and then files and folders that do, too."""
    folders = (Path(__file__).parents[1] / "robot" / "library", *LIBRARY.all())
    names = sorted(path.stem for folder in folders for path in folder.glob(f"{incomplete}*.toml"))
    known = [name for name in names if not name.endswith("_truth")]
    yield from known
    yield from (path.name for path in Path().glob(f"{incomplete}*") if known)  # of files alone the shell knows more


def topics() -> list[tuple[str, str]]:
    """Return the topics of `calib formats` with their descriptions."""
    from calib.procedure.formats import TOPICS

    return [(name, words) for name, (words, _) in TOPICS.items()]


def codes() -> list[str]:
    """Return the findings' codes, and the terms in one word, that `calib explain` knows."""
    from calib.procedure.findings import catalogue, glossary

    return [*catalogue(), *(term for term in glossary() if " " not in term)]


def completion(allowed: OneOf) -> Callable[[], list[str]]:
    """Return the completion of an option that takes one of a few texts."""
    return lambda: list(allowed.names)


Robot = Annotated[str, typer.Argument(autocompletion=robots)]

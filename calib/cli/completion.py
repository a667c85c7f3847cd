"""Shell completion: robots of the library, topics, codes. Loads no heavy module, since completion must be fast."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from calib.config_types import OneOf


def robots(incomplete: str) -> Iterator[str]:
    """Yield the library's robots whose names begin with the text typed so far, then such files and folders."""
    from calib.procedure.robot_kinds import ROBOTS

    folders = [Path(__file__).parents[1] / "robot" / "library"]
    folders += [kind.LIBRARY for kind in ROBOTS.all()]
    names: list[str] = []
    for folder in folders:
        names += [path.stem for path in folder.glob(f"{incomplete}*.toml")]
    robot_names = [name for name in sorted(names) if not name.endswith("_truth")]
    yield from robot_names
    # Of files alone the shell knows more.
    if robot_names:
        for path in Path().glob(f"{incomplete}*"):
            yield path.name


def topics() -> list[tuple[str, str]]:
    """Return the topics of `calib formats` with their descriptions."""
    from calib.procedure.formats import TOPICS

    return [(name, description) for name, (description, _) in TOPICS.items()]


def codes() -> list[str]:
    """Return the codes of findings, and the one-word terms, that `calib explain` knows."""
    from calib.procedure.findings import catalogue, glossary

    terms = [term for term in glossary() if " " not in term]
    return [*catalogue(), *terms]


def completion(allowed: OneOf) -> Callable[[], list[str]]:
    """Return the completion of an option that takes one of a few texts."""
    return lambda: list(allowed.names)


Robot = Annotated[str, typer.Argument(autocompletion=robots)]

"""Completion in the shell: robots of the library, topics, codes. It imports no large module, since it must be fast."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from calib.config_types import OneOf


def robots(incomplete: str) -> Iterator[str]:
    """Yield completions of a robot's name.

    These are the robots of the library whose names begin with the typed text, followed by such files and folders.

    Args:
        incomplete: the text typed so far.
    """
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
    """Return the topics of `calib formats`, each with a description."""
    from calib.procedure.formats import TOPICS

    return [(name, description) for name, (description, _) in TOPICS.items()]


def codes() -> list[str]:
    """Return the codes of findings and the one-word terms that `calib explain` accepts."""
    from calib.procedure.findings import catalogue, glossary

    terms = [term for term in glossary() if " " not in term]
    return [*catalogue(), *terms]


def completion(allowed: OneOf) -> Callable[[], list[str]]:
    """Return a function that lists the allowed texts of an option, for the completion of this option in the shell."""
    return lambda: list(allowed.names)


Robot = Annotated[str, typer.Argument(autocompletion=robots)]

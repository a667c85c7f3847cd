"""Parallel robots as data: one TOML table each (`parallel_files`), with the source of its numbers."""

from importlib import resources
from pathlib import Path


def names() -> tuple[str, ...]:
    """Return the names of the parallel robots in the library."""
    return tuple(sorted(path.stem for path in Path(str(resources.files(__name__))).glob("*.toml")))


def path(name: str) -> Path:
    """Return the file of a parallel robot."""
    return Path(str(resources.files(__name__).joinpath(f"{name}.toml")))

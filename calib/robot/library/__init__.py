"""Library of robots: one TOML file each, with the source of its numbers."""

from importlib import resources
from pathlib import Path


def names() -> tuple[str, ...]:
    """Return the names of the robots in the library."""
    files = (entry.name for entry in resources.files(__name__).iterdir())
    return tuple(
        sorted(name.removesuffix(".toml") for name in files if name.endswith(".toml") and "_truth" not in name)
    )


def path(name: str) -> Path:
    """Return the path of the file of a library robot, or of its simulated truth (``lwr4plus_truth``)."""
    return Path(str(resources.files(__name__).joinpath(f"{name}.toml")))

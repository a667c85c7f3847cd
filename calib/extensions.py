"""Extension points: where several packages add to one table, each loaded at first use.

A package directly below one of `HOSTS` adds by a table ``OFFERS`` in its ``__init__.py``: name of a point →
``module:name`` below the package (``:name`` for the package itself, ``module:`` for a module), or several of them. The
module that asks declares the point with the type of what is offered there::

    METHODS: Point[Sequence[Method]] = Point("methods", "methods of identification")
    methods = [method for methods in METHODS.all() for method in methods]

A name that is none of `POINTS` is refused when the tables are read. A package that is deleted takes its offers along;
the rest works without.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from typing import Any, Generic, TypeVar

from calib.errors import CalibError, UsageError, suggestion

HOSTS = ("calib", "calib.apps")
POINTS = (
    "commands",
    "descriptions",
    "exports",
    "formats",
    "optics",
    "planned_poses",
    "recordings",
    "robots",
    "steps",
    "write_program",
)
T = TypeVar("T")


class Point(Generic[T]):
    """A door: a typed extension point where packages add to the toolkit; `T` is the type of each offer.

    Attributes:
        name: one of `POINTS`.
        about: description of the offers.
    """

    def __init__(self, name: str, about: str) -> None:
        if name not in POINTS:
            raise ValueError(f"extension point '{name}' is none of calib.extensions.POINTS{suggestion(name, POINTS)}")
        self.name = name
        self.about = about

    def all(self) -> list[T]:
        """Return all offers, in the order of the packages' names; empty without any.

        Raises:
            UsageError: where a table names a point that does not exist, or what it offers cannot be loaded.
        """
        return [_load(package, place) for package, table in _offers().items() for place in table.get(self.name, ())]

    def one(self) -> T:
        """Return the first offer.

        Raises:
            UsageError: if there is no offer, or as for `all`.
        """
        for offer in self.all():
            return offer
        words = f"{self.name.replace('_', ' ')}: no package provides it; install the toolkit again"
        raise UsageError(words)


def merged(point: Point[Mapping[str, T]]) -> dict[str, T]:
    """Return one table merged from the tables offered at a point."""
    return {key: value for table in point.all() for key, value in table.items()}


@cache
def _offers() -> dict[str, dict[str, tuple[str, ...]]]:
    """Return each package's table of offers, by the package's full name; refuse misspelt names of points."""
    tables = {}
    for name in _packages():
        table = getattr(_import(name), "OFFERS", {})
        for point in table:
            if point not in POINTS:
                raise UsageError(f"{name}: OFFERS: there is no extension point '{point}'{suggestion(point, POINTS)}")
        tables[name] = {point: (places,) if isinstance(places, str) else places for point, places in table.items()}
    return tables


def _packages() -> list[str]:
    """Return the full names of the packages directly below one of `HOSTS`, sorted by their own names."""
    found = []
    for host in HOSTS:
        try:
            folders = import_module(host).__path__
        except ModuleNotFoundError:
            continue
        found += [f"{host}.{module.name}" for module in pkgutil.iter_modules(folders) if module.ispkg]
    return sorted(set(found) - set(HOSTS), key=lambda name: name.rpartition(".")[2])


def _load(package: str, place: str) -> Any:
    module, _, name = place.rpartition(":")
    loaded = _import(f"{package}.{module}" if module else package)
    if not name:
        return loaded
    if not hasattr(loaded, name):
        raise UsageError(f"{package}: OFFERS: {place}: there is no '{name}'{suggestion(name, dir(loaded))}")
    return getattr(loaded, name)


def _import(module: str) -> Any:
    try:
        return import_module(module)
    except (CalibError, MemoryError):
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise UsageError(f"the extension {module} does not load: {reason}; correct it or remove its folder") from error

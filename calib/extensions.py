"""Extension points: named tables to which several packages add entries, each loaded at first use.

A package directly below one of `HOSTS` adds entries by a table ``OFFERS`` in its ``__init__.py``. The table maps the
name of an extension point to ``module:name`` below the package (``:name`` for an object of the package itself,
``module:`` for a module), or to several of these. The module that uses the entries declares the extension point with
the type of its entries::

    METHODS: Point[Sequence[Method]] = Point("methods", "methods of identification")
    methods = [method for methods in METHODS.all() for method in methods]

A name that is not one of `POINTS` is refused when the tables are read. If a package is deleted, its entries disappear
and all others still work.
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
    """An extension point (called a door), to which packages add offers of type `T`.

    Attributes:
        name: name of the extension point, one of `POINTS`.
        about: description of the offers.
    """

    def __init__(self, name: str, about: str) -> None:
        if name not in POINTS:
            raise ValueError(f"extension point '{name}' is none of calib.extensions.POINTS{suggestion(name, POINTS)}")
        self.name = name
        self.about = about

    def all(self) -> list[T]:
        """Return all offers in the order of the packages' names; empty if there are none.

        Raises:
            UsageError: a table names an extension point that does not exist, or an offer cannot be loaded.
        """
        result = []
        for package, table in _offers().items():
            result += [_load(package, address) for address in table.get(self.name, ())]
        return result

    def first(self) -> T:
        """Return the first offer.

        Raises:
            UsageError: there is no offer, a table names an extension point that does not exist, or an offer cannot be
                loaded.
        """
        for offer in self.all():
            return offer
        raise UsageError(f"{self.name.replace('_', ' ')}: no package provides it; install the toolkit again")


def merged(point: Point[Mapping[str, T]]) -> dict[str, T]:
    """Return one table that contains all entries of the tables offered at an extension point."""
    return {key: value for table in point.all() for key, value in table.items()}


@cache
def _offers() -> dict[str, dict[str, tuple[str, ...]]]:
    """Return the table of offers of each package, by the package's full name.

    Raises:
        UsageError: a table names an extension point that does not exist.
    """
    tables = {}
    for name in _packages():
        table = getattr(_import(name), "OFFERS", {})
        for point in table:
            if point not in POINTS:
                raise UsageError(f"{name}: OFFERS: there is no extension point '{point}'{suggestion(point, POINTS)}")
        tables[name] = {}
        for point, addresses in table.items():
            tables[name][point] = (addresses,) if isinstance(addresses, str) else addresses
    return tables


def _packages() -> list[str]:
    """Return the full names of the packages directly below one of `HOSTS`, sorted by the last part of their names."""
    names = set[str]()
    for host in HOSTS:
        try:
            folders = import_module(host).__path__
        except ModuleNotFoundError:
            continue
        names.update(f"{host}.{module.name}" for module in pkgutil.iter_modules(folders) if module.ispkg)
    return sorted(names - set(HOSTS), key=_last_part)


def _last_part(name: str) -> str:
    return name.rpartition(".")[2]


def _load(package: str, address: str) -> Any:
    """Return an object of a package.

    Args:
        package: full name of the package.
        address: ``module:name`` below it, ``:name`` or ``module:``.

    Raises:
        UsageError: it cannot be loaded.
    """
    module, _, name = address.rpartition(":")
    loaded = _import(f"{package}.{module}" if module else package)
    if not name:
        return loaded
    if not hasattr(loaded, name):
        raise UsageError(f"{package}: OFFERS: {address}: there is no '{name}'{suggestion(name, dir(loaded))}")
    return getattr(loaded, name)


def _import(module: str) -> Any:
    try:
        return import_module(module)
    except (CalibError, MemoryError):
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise UsageError(f"the extension {module} does not load: {reason}; correct it or remove its folder") from error

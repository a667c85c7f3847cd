"""Extension points: where several packages add to one table, each loaded at first use.

A package directly below `calib.rooms` adds by a table ``OFFERS`` in its ``__init__.py``: name of a point →
``module:name`` below the package (``:name`` for the package itself, ``module:`` for a module). The module that asks
declares the point with the type of what is offered there::

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

ROOMS = "calib.rooms"
POINTS = (
    "as_described",
    "camera_guess",
    "camera_view",
    "check_controller",
    "commands",
    "deflection_sensitivity",
    "descriptions",
    "drift",
    "drive_gains",
    "endings",
    "exports",
    "fit_notes",
    "fit_pages",
    "geometry_spread",
    "identified_masses",
    "image_coverage",
    "image_folders",
    "image_words",
    "joint_origins",
    "library",
    "limit_tables",
    "link_motion",
    "model_pages",
    "motors_as_described",
    "notebook",
    "optics",
    "planned_poses",
    "pose_forms",
    "read_bag",
    "read_board",
    "read_lens",
    "read_optics",
    "recordings",
    "reprojection",
    "return_masses",
    "robots",
    "ros2_package",
    "schemas",
    "stages",
    "steps",
    "topics",
    "ur_kinematics",
    "write_program",
)
T = TypeVar("T")


class Point(Generic[T]):
    """One place where packages add to the core; `T` is the type of what each of them offers there.

    Attributes:
        name: one of `POINTS`.
        about: what is offered.
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
        return [_load(package, table[self.name]) for package, table in _offers().items() if self.name in table]

    def one(self) -> T:
        """Return the first offer.

        Raises:
            UsageError: where there is none, and as `all`.
        """
        for offer in self.all():
            return offer
        words = f"{self.name.replace('_', ' ')}: no package of {ROOMS} provides it; install the toolkit again"
        raise UsageError(words)


def merged(point: Point[Mapping[str, T]]) -> dict[str, T]:
    """Return one table merged from the tables offered at a point."""
    return {key: value for table in point.all() for key, value in table.items()}


@cache
def _offers() -> dict[str, dict[str, str]]:
    """Return each package's table of offers, by the package's full name; refuse misspelt names of points."""
    try:
        host = import_module(ROOMS)
    except ImportError:
        return {}
    tables = {}
    for name in sorted(f"{ROOMS}.{module.name}" for module in pkgutil.iter_modules(host.__path__)):
        table = _import(name).OFFERS
        for point in table:
            if point not in POINTS:
                raise UsageError(f"{name}: OFFERS: there is no extension point '{point}'{suggestion(point, POINTS)}")
        tables[name] = table
    return tables


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
        raise UsageError(f"the extension {module} does not load: {reason}; mend it or remove its folder") from error

"""Table of all identification methods by name, including those of the packages in `calib.rooms`."""

from collections.abc import Mapping

from calib.errors import UsageError, one_of
from calib.extensions import Point
from calib.identification.methods.least_squares import OLS, WLS
from calib.identification.methods.method import Method

METHODS_OF_ROOMS: Point[tuple[Method, ...]] = Point("methods", "further methods")

METHODS: Mapping[str, Method] = {one.name: one for group in ((OLS, WLS), *METHODS_OF_ROOMS.all()) for one in group}
VERSIONS: Mapping[str, int] = {one.name: one.version for one in METHODS.values()}


def method_named(name: str) -> Method:
    """Return the identification method with a name.

    Raises:
        UsageError: for a name that is none of `METHODS`.
    """
    return METHODS[one_of(name, METHODS, "method", UsageError)]

"""Table of all identification methods by name, including those of the packages in `calib.rooms`."""

from collections.abc import Mapping

from calib.errors import UsageError, one_of
from calib.extensions import offered
from calib.identification.methods.least_squares import OLS, WLS
from calib.identification.methods.method import Method

_METHODS = [OLS, WLS]
for _offered_methods in offered("methods"):
    _METHODS += _offered_methods

METHODS: Mapping[str, Method] = {method.name: method for method in _METHODS}
VERSIONS: Mapping[str, int] = {method.name: method.version for method in _METHODS}


def method_named(name: str) -> Method:
    """Return the identification method with a name.

    Raises:
        UsageError: for a name that is none of `METHODS`.
    """
    return METHODS[one_of(name, METHODS, "method", UsageError)]

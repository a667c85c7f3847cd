"""Table of all identification methods by name."""

from collections.abc import Mapping

from calib.errors import UsageError, one_of
from calib.identification import survey
from calib.identification.closed_loop import simulated
from calib.identification.methods import estimators
from calib.identification.methods.least_squares import OLS, WLS
from calib.identification.methods.method import Method

_METHODS = (OLS, WLS, *estimators.METHODS, *simulated.METHODS, *survey.METHODS)

METHODS: Mapping[str, Method] = {method.name: method for method in _METHODS}
VERSIONS: Mapping[str, int] = {method.name: method.version for method in _METHODS}


def method_named(name: str) -> Method:
    """Return the identification method with this name.

    Raises:
        UsageError: for a name that is not a key of `METHODS`.
    """
    return METHODS[one_of(name, METHODS, "method", UsageError)]

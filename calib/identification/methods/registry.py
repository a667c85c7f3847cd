"""All methods by the names that options and files call them."""

from __future__ import annotations

from collections.abc import Mapping

from calib.errors import UsageError
from calib.identification.methods.least_squares import IRLS, OLS, PC_IRLS, PC_OLS, PC_WLS, TLS, WLS
from calib.identification.methods.method import Method
from calib.identification.methods.simulated import DIDIM, IV, PC_DIDIM, PC_IV

METHODS: Mapping[str, Method] = {
    one.name: one for one in (OLS, WLS, IRLS, TLS, IV, DIDIM, PC_OLS, PC_WLS, PC_IRLS, PC_IV, PC_DIDIM)
}


def method_named(name: str) -> Method:
    """Return the method that options and files call by this name.

    Raises:
        UsageError: for a name that is none of `METHODS`.
    """
    if name not in METHODS:
        raise UsageError(f"method '{name}' is none of {', '.join(METHODS)}")
    return METHODS[name]

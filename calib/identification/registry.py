"""Table of all identification methods by name."""

from collections.abc import Mapping
from dataclasses import replace

from calib.errors import UsageError, one_of
from calib.identification import survey
from calib.identification.closed_loop import simulated
from calib.identification.methods import estimators
from calib.identification.methods.constraint_settings import ConstraintSettings
from calib.identification.methods.least_squares import OLS, WLS
from calib.identification.methods.method import Method

_METHODS = (OLS, WLS, *estimators.METHODS, *simulated.METHODS, *survey.METHODS)

METHODS: Mapping[str, Method] = {method.name: method for method in _METHODS}
TAKING_FUNCTIONS = (OLS.name, WLS.name, simulated.IV.name)
"""Methods that satisfy constraints by a user's function beside the methods pc-*."""
VERSIONS: Mapping[str, int] = {method.name: method.version for method in _METHODS}


def method_named(name: str) -> Method:
    """Return the identification method with this name.

    Raises:
        UsageError: for a name that is not a key of `METHODS`.
    """
    return METHODS[one_of(name, METHODS, "method", UsageError)]


def under_constraints(
    method: Method, constraints: ConstraintSettings | None
) -> tuple[Method, ConstraintSettings | None]:
    """Return a method that takes constraints, and the constraints that it takes.

    Ordinary and weighted least squares and instrumental variables satisfy what a user's function of the parameters
    states, as their physically consistent forms do, without the constraints of those forms and without a prior. Other
    methods and constraints are returned as they are.
    """
    if constraints is None or method.takes_constraints or not constraints.by_function:
        return method, constraints
    if method.name not in TAKING_FUNCTIONS:
        return method, constraints
    consistent = METHODS[f"pc-{method.name}"]
    constrained = replace(consistent, name=method.name, assumes=method.assumes + estimators.CONSISTENT)
    return constrained, constraints.of_user

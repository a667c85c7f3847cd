"""All methods by the names that options and files call them, each with what a user asks of it before choosing."""

from collections.abc import Mapping

from calib.errors import UsageError, suggestion
from calib.extensions import offered
from calib.identification.methods.least_squares import IRLS, OLS, PC_IRLS, PC_OLS, PC_WLS, TLS, WLS
from calib.identification.methods.method import Method, MethodEntry
from calib.identification.methods.simulated import DIDIM, IV, PC_DIDIM, PC_IV

_CONSTRAINED = " under constraints on its parameters"
_SOUSA = "Sousa & Cortesão 2014; Wensing et al. 2018"
LISTING: tuple[MethodEntry, ...] = (
    MethodEntry(OLS, "least squares, all rows alike", "Gauss; Atkeson, An & Hollerbach 1986"),
    MethodEntry(WLS, "least squares, each joint by its residuals", "Gautier & Poignet 2001"),
    MethodEntry(
        IRLS, "least squares, weighted across joints, odd samples gated out", "Han, Wu, Liu & Xiong 2020",
        ("gate of 3 sigma",), version=2,
    ),
    MethodEntry(
        TLS, "total least squares with scaled columns", "Golub & Van Loan 1980; Van Huffel & Vandewalle 1991",
        ("ratio of the columns' noise to the torques'",), version=2,
    ),
    MethodEntry(
        IV, "instrumental variables from the simulated closed loop", "Janot, Vandanjon & Gautier 2014",
        ("tolerance 2.5 %", "10 rounds"),
    ),
    MethodEntry(
        DIDIM, "least squares on the simulated motion alone (the slides' CLIE)", "Gautier, Janot & Vandanjon 2013",
        ("tolerance 2.5 %", "10 rounds"),
    ),
    MethodEntry(PC_OLS, "ols" + _CONSTRAINED, _SOUSA),
    MethodEntry(PC_WLS, "wls" + _CONSTRAINED, _SOUSA),
    MethodEntry(PC_IRLS, "irls" + _CONSTRAINED, _SOUSA, ("gate of 3 sigma",), version=2),
    MethodEntry(PC_IV, "iv" + _CONSTRAINED, "Janot & Wensing 2021", ("tolerance 2.5 %", "10 rounds")),
    MethodEntry(PC_DIDIM, "didim" + _CONSTRAINED, "Leboutet et al. 2021", ("tolerance 2.5 %", "10 rounds")),
    *(entry for entries in offered("methods") for entry in entries),
)  # fmt: skip
METHODS: Mapping[str, Method] = {one.name: one.method for one in LISTING}
VERSIONS: Mapping[str, int] = {one.name: one.version for one in LISTING}


def method_named(name: str) -> Method:
    """Return the method that options and files call by this name.

    Raises:
        UsageError: for a name that is none of `METHODS`.
    """
    if name not in METHODS:
        raise UsageError(f"method '{name}' is none of {', '.join(METHODS)}{suggestion(name, METHODS)}")
    return METHODS[name]

"""All methods by the names that options and files call them, each with what a user asks of it before choosing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from calib.errors import UsageError, suggestion
from calib.identification.methods.filters import CDKF, EKF, SRCDKF, SREKF, SRUKF, UKF
from calib.identification.methods.least_squares import IRLS, OLS, PC_IRLS, PC_OLS, PC_WLS, TLS, WLS
from calib.identification.methods.maximum_likelihood import ML
from calib.identification.methods.method import Method
from calib.identification.methods.neural_networks import ADALINE, HOPFIELD
from calib.identification.methods.output_error import CLIE, CLOE
from calib.identification.methods.simulated import DIDIM, IV, PC_DIDIM, PC_IV


@dataclass(frozen=True)
class MethodEntry:
    """A method as a list shows it.

    Attributes:
        method: itself.
        description: one line.
        source: whose it is.
        tunes: what of it is chosen beforehand and not told by the data; () for nothing.
        version: raised whenever it gives another estimate, or another count of rounds, of the same data: what studies
            have kept of it from before then does not count, and is run again.
    """

    method: Method
    description: str
    source: str
    tunes: tuple[str, ...] = ()
    version: int = 1

    @property
    def name(self) -> str:
        """What options and files call it."""
        return self.method.name

    @property
    def needs_controller(self) -> bool:
        """Whether it simulates the closed loop, and so asks for the controller and its reference."""
        return self.method.needs_controller

    @property
    def needs_simulation(self) -> bool:
        """Whether it asks for a model whose motion can be computed from torques."""
        return self.method.needs_simulation


_CONSTRAINED = " under constraints on its parameters"
_TUNED = ("first covariance of the parameters", "rate of the filter")
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
        ML, "maximum likelihood: positions noisy too, noise levels estimated",
        "Olsen, Swevers & Verdonck 2002; Leboutet et al. 2021", ("tolerance 0.01 sigma", "40 rounds"),
    ),
    MethodEntry(
        IV, "instrumental variables from the simulated closed loop", "Janot, Vandanjon & Gautier 2014",
        ("tolerance 2.5 %", "10 rounds"),
    ),
    MethodEntry(
        DIDIM, "least squares on the simulated motion alone (the slides' CLIE)", "Gautier, Janot & Vandanjon 2013",
        ("tolerance 2.5 %", "10 rounds"),
    ),
    MethodEntry(
        CLOE, "closed-loop output error: simulated positions meet measured ones", "Landau 1979; Leboutet et al. 2021",
        ("damping", "tolerance 0.05 sigma"),
    ),
    MethodEntry(
        CLIE, "closed-loop input error: simulated torques meet measured ones", "Leboutet et al. 2021",
        ("damping", "tolerance 0.05 sigma"),
    ),
    MethodEntry(EKF, "extended Kalman filter, parameters as states", "Gautier & Poignet 2001", _TUNED),
    MethodEntry(SREKF, "the same, square-root form", "Kaminski, Bryson & Schmidt 1971", _TUNED),
    MethodEntry(UKF, "unscented Kalman filter, the same", "Julier & Uhlmann 2004", (*_TUNED, "α = 0.1")),
    MethodEntry(SRUKF, "the same, square-root form", "van der Merwe & Wan 2001", (*_TUNED, "α = 0.1")),
    MethodEntry(CDKF, "central-difference Kalman filter, the same", "Nørgaard, Poulsen & Ravn 2000", _TUNED),
    MethodEntry(SRCDKF, "the same, square-root form", "van der Merwe & Wan 2001", _TUNED),
    MethodEntry(
        ADALINE, "adaptive linear neuron, trained sample by sample", "Widrow & Hoff 1960; Widrow & Stearns 1985",
        ("decay of the learning rate", "60 epochs"),
    ),
    MethodEntry(
        HOPFIELD, "Hopfield-Tank network at rest", "Tank & Hopfield 1986; Atencia, Joya & Sandoval 2004",
        ("bounds of its neurons", "200 steps"),
    ),
    MethodEntry(PC_OLS, "ols" + _CONSTRAINED, _SOUSA),
    MethodEntry(PC_WLS, "wls" + _CONSTRAINED, _SOUSA),
    MethodEntry(PC_IRLS, "irls" + _CONSTRAINED, _SOUSA, ("gate of 3 sigma",), version=2),
    MethodEntry(PC_IV, "iv" + _CONSTRAINED, "Janot & Wensing 2021", ("tolerance 2.5 %", "10 rounds")),
    MethodEntry(PC_DIDIM, "didim" + _CONSTRAINED, "Leboutet et al. 2021", ("tolerance 2.5 %", "10 rounds")),
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

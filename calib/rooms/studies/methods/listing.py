"""The survey's methods that nobody calibrates by, each with what a user asks of it before choosing."""

from calib.identification.methods.method import MethodEntry
from calib.rooms.studies.methods.filters import CDKF, EKF, SRCDKF, SREKF, SRUKF, UKF
from calib.rooms.studies.methods.maximum_likelihood import ML
from calib.rooms.studies.methods.networks import ADALINE, HOPFIELD
from calib.rooms.studies.methods.output_error import CLIE, CLOE

_TUNED = ("first covariance of the parameters", "rate of the filter")
LISTING: tuple[MethodEntry, ...] = (
    MethodEntry(
        ML, "maximum likelihood: positions noisy too, noise levels estimated",
        "Olsen, Swevers & Verdonck 2002; Leboutet et al. 2021", ("tolerance 0.01 sigma", "40 rounds"),
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
)  # fmt: skip

"""Statistics on plain arrays: robust weights, relevance of columns, whiteness of residuals."""

from calib.estimation.estimate import Estimate, whitened
from calib.estimation.linear import LinearFit, settled_std, wls
from calib.estimation.relevance import gram, relevance
from calib.estimation.robust import spread
from calib.estimation.robust import weights as robust_weights
from calib.estimation.whiteness import autocorrelation, inflation

__all__ = [
    "Estimate",
    "LinearFit",
    "autocorrelation",
    "gram",
    "inflation",
    "relevance",
    "robust_weights",
    "settled_std",
    "spread",
    "whitened",
    "wls",
]

"""Test of identical legs: whether the recordings contradict common inertial parameters of all legs.

The model with common parameters (b) is nested in the model with separate parameters of each leg (b_1), so that

    F = [(RSS - RSS_1) / (b_1 - b)] / [RSS_1 / (N - b_1)]

has Fisher's distribution if the legs are identical. RSS and RSS_1 are the sums of squared residuals of the two models,
with equal weights of all rows; N is the number of independent rows.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import fdtrc

from calib.dynamics import base as bases
from calib.errors import Finding, finding
from calib.estimation.linear import wls
from calib.identification.identify import Identification, common_decimator, find_base
from calib.identification.rows import Case, observe, pool, triangulate
from calib.parallel.mechanism.parallel_model import ParallelModel


def legs_differ(
    identification: Identification[ParallelModel], cases: Sequence[Case], level: float = 0.001
) -> list[Finding]:
    """Return the finding that legs are not identical, with the parameters that differ most.

    Args:
        identification: identification of a model with identical legs.
        cases: its training data.
        level: probability of a wrong finding on identical legs (our choice).

    Returns:
        One finding; an empty list if the recordings do not contradict identical legs.
    """
    model = identification.dynamics.model
    settings = identification.settings
    fitted = identification.fitted
    std = fitted.std
    inflation = fitted.inflation

    # rows of the model with separate parameters of each leg
    single = model.single
    samples = bases.random_samples(single, seed=settings.seed)
    base = find_base(single, cases, samples)
    decimator = common_decimator(cases, settings)
    rows = []
    for k, case in enumerate(cases):
        case_rows = observe(single, base.kept, case, decimator)
        # power rows have a weight per recording
        if len(std) != model.rows:
            case_rows = case_rows.by_recording(k, len(cases))
        rows.append(case_rows)
    data = pool(triangulate(rows), len(std))

    # Fisher's test
    common = fitted.pooled
    common_fit = wls(common, std, inflation).estimate
    single_fit = wls(data, std, inflation).estimate
    common_squares = common.residual_squares(common_fit.values)
    single_squares = data.residual_squares(single_fit.values)
    common_rss = np.sum(common_squares / std**2 / inflation)
    single_rss = np.sum(single_squares / std**2 / inflation)
    added = data.parameters - common.parameters
    dof = single_fit.dof
    f = (common_rss - single_rss) / max(added, 1) / (single_rss / dof)
    p = 1.0
    if added:
        p = float(fdtrc(added, dof, max(f, 0.0)))
    if p >= level:
        return []

    # differences of the legs' parameters from the common ones, in sigmas
    common_values = common_fit.values[: identification.base.b]
    standard = identification.base.to_standard(common_values)
    identical_values = base.transform @ model.spread(standard)
    legs_of_parameter = np.bincount(model.owners)
    owners = model.owners[base.kept]
    is_common = legs_of_parameter[owners] > 1
    difference = np.abs(single_fit.values - identical_values)
    sigmas = np.where(is_common, difference / single_fit.sigma, 0.0)
    order = np.argsort(-sigmas)[: is_common.sum()]
    names = [f"{base.names[k]} ({sigmas[k]:.2g} σ)" for k in order]
    return [finding("legs-differ", p=p, names=names)]

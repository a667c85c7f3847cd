"""Test of identical legs: whether the recordings contradict a common set of inertial parameters for all legs.

The model with one set is nested in that with a set for each leg, so that by Fisher's test

    F = [(RSS - RSS_1) / (b_1 - b)] / [RSS_1 / (N - b_1)],

RSS_1 and b_1 being those of the model with more parameters; rows have equal weights, N counts independent rows.
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
    """Return the finding that legs are not identical, with the parameters that differ most; empty if they may be
    identical.

    Args:
        identification: identification with identical legs; cases: its training data.
        level: probability of a finding on legs that are identical (our choice).
    """
    model = identification.dynamics.model
    fitted = identification.fitted
    base = find_base(model.single, cases, bases.random_samples(model.single, seed=identification.settings.seed))
    decimator = common_decimator(cases, identification.settings)
    rows = [observe(model.single, base.kept, case, decimator) for case in cases]
    # power rows, weighed by recording
    if len(fitted.std) != model.rows:
        rows = [part.by_recording(k, len(cases)) for k, part in enumerate(rows)]
    data = pool(triangulate(rows), len(fitted.std))
    shared_fit = wls(fitted.pooled, fitted.std, fitted.inflation).estimate
    single_fit = wls(data, fitted.std, fitted.inflation).estimate
    shared_rss = np.sum(fitted.pooled.residual_squares(shared_fit.values) / fitted.std**2 / fitted.inflation)
    single_rss = np.sum(data.residual_squares(single_fit.values) / fitted.std**2 / fitted.inflation)
    added = data.parameters - fitted.pooled.parameters
    dof = single_fit.dof
    f = (shared_rss - single_rss) / max(added, 1) / (single_rss / dof)
    p = 1.0
    if added:
        p = float(fdtrc(added, dof, max(f, 0.0)))
    if p >= level:
        return []
    standard = identification.base.to_standard(shared_fit.values[: identification.base.b])
    alike = base.transform @ model.spread(standard)
    shared = np.bincount(model.owners)[model.owners[base.kept]] > 1
    away = np.where(shared, np.abs(single_fit.values - alike) / single_fit.sigma, 0.0)
    order = np.argsort(-away)[: shared.sum()]
    names = [f"{base.names[k]} ({away[k]:.2g} σ)" for k in order]
    return [finding("legs-differ", p=p, names=names)]

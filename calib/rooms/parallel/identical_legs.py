"""Test of identical legs: do the recordings contradict one set of inertial parameters for all?

The model with one set is nested in that with a set for each leg, so that by Fisher's test

    F = [(RSS - RSS_1) / (b_1 - b)] / [RSS_1 / (N - b_1)],

RSS_1 and b_1 of the model with more parameters; rows are weighed alike, N counts rows that the residuals take as one.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import fdtrc

from calib.dynamics import base as bases
from calib.errors import Finding, finding
from calib.estimation.linear import wls
from calib.identification.identify import Identification, common_decimator, find_base
from calib.identification.rows import Case, observe, pool, triangulate
from calib.rooms.parallel.mechanism.parallel_model import ParallelModel


def legs_differ(found: Identification[ParallelModel], cases: Sequence[Case], level: float = 0.001) -> list[Finding]:
    """Return the finding that legs are not identical, with the parameters that differ most; none where they may be.

    Args:
        found: identification with identical legs; cases: its training data.
        level: probability of a finding on legs that are identical (our choice).
    """
    one = found.dynamics.model
    fitted = found.fitted
    base = find_base(one.single, cases, bases.random_samples(one.single, seed=found.settings.seed))
    decimator = common_decimator(cases, found.settings)
    rows = [observe(one.single, base.kept, case, decimator) for case in cases]
    # power rows, weighed by recording
    if len(fitted.std) != one.rows:
        rows = [part.by_recording(k, len(cases)) for k, part in enumerate(rows)]
    data = pool(triangulate(rows), len(fitted.std))
    fits = [wls(own, fitted.std, fitted.inflation).estimate for own in (fitted.pooled, data)]
    squares = [
        np.sum(own.residual_squares(fit.values) / fitted.std**2 / fitted.inflation)
        for own, fit in zip((fitted.pooled, data), fits)
    ]
    more = data.parameters - fitted.pooled.parameters
    left = fits[1].dof
    f = (squares[0] - squares[1]) / max(more, 1) / (squares[1] / left)
    p = float(fdtrc(more, left, max(f, 0.0))) if more else 1.0
    if p >= level:
        return []
    alike = base.transform @ one.spread(found.base.to_standard(fits[0].values[: found.base.b]))
    shared = np.bincount(one.owners)[one.owners[base.kept]] > 1
    away = np.where(shared, np.abs(fits[1].values - alike) / fits[1].sigma, 0.0)
    names = [f"{base.names[k]} ({away[k]:.2g} σ)" for k in np.argsort(-away)[: shared.sum()]]
    return [finding("legs-differ", p=p, names=names)]

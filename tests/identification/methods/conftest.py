"""A problem of identification on the planted arm, for every method."""

import numpy as np
import planted_motion as planted
import pytest

from calib.identification.identify import chain_states, common_decimator, find_base
from calib.identification.methods.method import IdentificationProblem
from calib.identification.rows import observe
from calib.identification.settings import IdentificationSettings, make_model


@pytest.fixture(scope="module")
def problem() -> IdentificationProblem:
    settings, cases = IdentificationSettings(), [planted.case("a", 0)]
    model, decimator = make_model(planted.arm(), settings), common_decimator(cases, settings)
    base = find_base(model, cases, chain_states(planted.arm(), model))
    rows = tuple(observe(model, base.kept, case, decimator) for case in cases)
    terms = [None if k < model.inertial else model.columns[k - model.inertial] for k in base.kept]
    return IdentificationProblem(model, base, cases, decimator, rows, tuple(terms), np.full(base.b, -1))

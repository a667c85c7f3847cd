"""A model that is no serial chain is identified like one: identification asks for the protocol alone."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import planted_motion as planted
import pytest

from calib.dynamics.idim import IdentificationModel
from calib.errors import CalibError, UsageError
from calib.identification.identify import chain_states, identify, identify_model
from calib.identification.loop import LoopSettings
from calib.identification.prediction import predict
from calib.identification.settings import IdentificationSettings

PLAIN = IdentificationSettings(prior="none")


@dataclass(frozen=True)
class Other:
    """What `RegressorModel` asks for, of a class of its own."""

    inner: IdentificationModel

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)


@pytest.mark.parametrize(
    "method", [pytest.param("ols", marks=pytest.mark.slow), "wls", "irls", pytest.param("tls", marks=pytest.mark.slow)]
)
def test_the_estimate_is_that_of_a_chain(method):
    arm, cases, model = planted.arm(), [planted.case("a", 0)], Other(planted.model())
    settings = replace(PLAIN, method=method)
    found = identify_model(model, cases, settings, states=chain_states(arm, model.inner))
    chain = identify(arm, cases, replace(settings, friction="standard"))
    assert found.dynamics.model is model and found.friction.terms == () and found.ripples == ()
    assert found.names == chain.names and found.fitted.method == method
    np.testing.assert_allclose(found.fitted.estimate.values, chain.fitted.estimate.values, rtol=1e-9)
    np.testing.assert_allclose(found.fitted.estimate.covariance, chain.fitted.estimate.covariance, rtol=1e-9)
    assert found.elimination is not None and len(found.elimination.kept) == len(chain.elimination.kept)
    other = planted.case("b", 1)
    np.testing.assert_allclose(predict(found.dynamics, other), predict(chain.dynamics, other), rtol=1e-9)


def test_what_only_a_chain_has_is_asked_for():
    model, cases = Other(planted.model()), [planted.case("a", 0)]
    with pytest.raises(UsageError, match="states no masses"):
        identify_model(model, cases, IdentificationSettings(prior="cad"))
    loop = IdentificationSettings(method="didim", loop=LoopSettings("pd", (100.0,), (10.0,)))
    with pytest.raises(CalibError, match="can be simulated"):
        identify_model(model, cases, loop)

"""One set of inertial parameters for the legs of a parallel robot."""

import json

import numpy as np
import pytest
from platform_sines import recorded, truth

from calib.errors import UsageError
from calib.identification.identify_options import parse_options
from calib.parallel.export import export_parallel
from calib.parallel.identification import ParallelDynamics, identify_parallel
from calib.parallel.mechanism.parallel_model import make_parallel_model, rows_named
from calib.parallel.robots import find

DUALV = find("dualv")


def identified(change: float = 1.0, **options) -> ParallelDynamics:
    """Return the dynamics of a DualV from a run without and one with payload; leg 3's motor link times `change`."""
    values = truth(DUALV.mechanism)[1]
    values[truth(DUALV.mechanism)[0].names.index("ZZ13")] *= change
    logs = [recorded(DUALV.mechanism, load, seed=k, values=values) for k, load in enumerate(((), ("5",)))]
    table = {"payload": {"5": {}}, "files": {"load1.csv": {"payload": ["5"]}}, "drives": "Fv Fc", "v0": 0.05}
    return identify_parallel(DUALV, logs, options=parse_options(table | options))


def codes(found: ParallelDynamics) -> set[str]:
    return {one.code for one in found.findings.noticed}


@pytest.mark.parametrize("rows", ["platform", "power"])
def test_columns_are_sums_over_the_legs(rows):
    model = make_parallel_model(
        DUALV.mechanism, rows=rows_named(DUALV.mechanism, rows), payloads=["5"], passive="Fv", identical_legs=True
    )
    rng = np.random.default_rng(0)
    values, states = rng.normal(size=model.p), model.sample(10, rng)
    motion = (states.q, states.v, states.a)
    own = model.spread(values)
    wanted = model.single.torque(own, *motion)
    np.testing.assert_allclose(model.regressor(*motion) @ values, wanted, atol=1e-9)
    np.testing.assert_allclose(model.torque(values, *motion), wanted, atol=1e-9)
    energies = [one.energy_columns(*motion[:2]) @ x for one, x in ((model, values), (model.single, own))]
    np.testing.assert_allclose(*energies, atol=1e-9)
    names = dict(zip(model.single.names, own))
    assert names["ZZ21"] == names["ZZ24"] and names["Ia11"] == names["Ia13"] and names["Fv11"] != names["Fv12"]
    assert len(model.names) == len(set(model.names)) == len(model.preference()) == model.p
    assert len(model.columns) == model.p - model.inertial and model.columns[0].name == "Ia11"


@pytest.mark.slow
def test_identical_legs_have_smaller_sigma(tmp_path):
    """Truth within 4 σ, no finding, and the same file for other commands; a leg that is 20 % off is named."""
    alike, apart = identified(identical_legs=True, prior="none"), identified(prior="none")
    own, other = (dict(zip(x.estimate.names, x.estimate.sigma)) for x in (alike, apart))
    assert own["ZZ11"] < 0.7 * other["ZZ11"] and len(own) < len(other)
    model, values = truth(DUALV.mechanism)
    standard = dict(zip(model.names, values))
    wanted = alike.found.base.transform @ [standard[name] for name in alike.found.base.standard]
    assert (np.abs(alike.estimate.values - wanted) < 4.0 * alike.estimate.sigma).all()
    assert "legs-differ" not in codes(alike)
    table = json.loads((alike.save(tmp_path / "id", plots=False) / "dynamics.json").read_text())
    assert table["identical_legs"] and table["values"]["ZZ11"] == table["values"]["ZZ14"] > 0.0
    differ = identified(1.2, identical_legs=True)
    (told,) = (one for one in differ.findings.noticed if one.code == "legs-differ")
    assert told.values["names"][0].startswith("ZZ13R")


@pytest.mark.slow
def test_identical_legs_are_exported_as_legs(tmp_path):
    """The consistent bodies of all legs are alike, their masses those that regroup to the estimate."""
    found = identified(identical_legs=True)
    folder = found.save(tmp_path / "id", plots=False)
    export_parallel(find(folder), folder, tmp_path / "out")
    table = json.loads((tmp_path / "out" / "parameters.json").read_text())["dynamics"]["standard"]
    values = dict(zip(table["names"], table["values"]))
    assert values["M21"] == values["M24"] > 0.0 and len(table["covariance"]) == len(values)
    regrouped = values["M4"] + sum(values[f"ZZ2{k}"] for k in range(1, 5)) / 0.28**2
    estimate = dict(zip(found.estimate.names, found.estimate.values))
    assert regrouped == pytest.approx(estimate["M4"], rel=0.02)


def test_legs_of_different_build_are_refused():
    with pytest.raises(UsageError, match="right is built unlike left"):
        make_parallel_model(find("fivebar").mechanism, identical_legs=True)

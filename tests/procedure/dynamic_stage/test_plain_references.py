"""Plain least squares and the nominal masses stand beside a model on held-out motion, and a worse model is no pass."""

import json

import numpy as np
import planted_motion as planted
import pytest

import calib
from calib.estimation.triangles import collect
from calib.procedure.dynamic_stage.plain import RANK, PlainReferences, truncated, worse_than_plain
from calib.procedure.findings import level_of


def test_plain_ols_is_truncated_at_rank():
    """A column that repeats another changes no prediction, and neither does one that nearly does."""
    rng = np.random.default_rng(0)
    w, x = rng.normal(size=(400, 3)), np.array([1.0, -2.0, 0.5])
    y = w @ x + 0.01 * rng.normal(size=400)
    np.testing.assert_allclose(truncated(collect(w, y)), np.linalg.lstsq(w, y, rcond=None)[0], rtol=1e-9)
    twice = np.column_stack([w, w[:, 0]])
    np.testing.assert_allclose(truncated(collect(twice, y))[[0, 3]], 0.5, atol=0.01)
    faint = np.column_stack([w, w[:, 0] + 0.1 * RANK * rng.normal(size=400)])
    shared, torn = (values[0] - values[3] for values in (truncated(collect(faint, y)), np.linalg.lstsq(faint, y)[0]))
    assert abs(shared) < 0.05 < 0.5 < abs(torn), "the noise does not decide how twins share"


def test_plain_ols_weighs_joints():
    """Plain least squares weighs joints by their residuals."""
    rng = np.random.default_rng(1)
    noise, joint = np.repeat([0.01, 5.0], 300), np.repeat([0, 1], 300)
    w = rng.normal(size=(600, 4))
    y = w @ np.ones(4) + noise * rng.normal(size=600)
    assert np.abs(truncated(collect(w, y, joint)) - 1.0).max() < 0.005 < np.abs(truncated(collect(w, y)) - 1.0).max()


@pytest.mark.parametrize(("delivered", "level"), [(1.08, None), (1.15, "marginal")])
def test_model_worse_than_plain_ols_fails(delivered, level):
    """A model that plain least squares beats is no pass."""
    found = worse_than_plain({"a": PlainReferences(0.9, 1.0, 50.0), "b": PlainReferences(delivered, 1.0, np.nan)})
    assert [level_of(one) for one in found] == ([level] if level else [])
    assert all(one.values["file"] == "b" for one in found)


def test_no_comparison_without_plain_values():
    """Without plain values nothing is compared."""
    assert worse_than_plain({"a": PlainReferences(5.0, np.nan, np.nan)}) == []


@pytest.mark.slow
def test_identification_stores_references(robot, tmp_path):
    """Of rich motion with simple friction plain least squares is as good; the nominal masses lack friction."""
    train, other = planted.write(tmp_path, "train.npz", 0), planted.write(tmp_path, "other.npz", 1)
    model = calib.identify_dynamics(robot, train, validate=other)
    found = model.references["other.npz"]
    assert found.delivered == pytest.approx(model.validation["other.npz"].judged.total)
    assert found.plain == pytest.approx(found.delivered, rel=0.1) and found.nominal > 3.0 * found.plain
    assert "torque-worse-than-plain" not in {one.code for one in model.noticed}
    out = model.save(tmp_path / "out", plots=False)
    for name in ("metrics.json", "report.json"):
        stored = json.loads((out / name).read_text())["references"]["other.npz"]
        assert stored == pytest.approx({"delivered": found.delivered, "plain": found.plain, "nominal": found.nominal})
    assert "plain least squares" in str(model).lower()

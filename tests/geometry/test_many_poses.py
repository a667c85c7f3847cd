"""Thousands of poses are observed in pieces and begin from a sample: the fit is that of all rows at once."""

from dataclasses import replace

import numpy as np
import pytest
from planted import cell, load, measure, perturb

from calib.data.poses.measurements import Poses
from calib.estimation import nonlinear
from calib.estimation.relevance import gram
from calib.geometry import fit as fitting
from calib.geometry import observation, weighing
from calib.geometry.accuracy import errors, pair_errors
from calib.geometry.first_guess import install
from calib.geometry.many_corrections import MANY, position_variances, row_statistics, separable
from calib.geometry.model_choice.ladder import EFFECTS, ModelSelection, select_model
from calib.geometry.observation import layout, observe, pose_sigmas, prepare, rows_of
from calib.geometry.weighing import Settings
from calib.robot.calibrated import Deflection, Term
from calib.robot.kinematics import gravity_torques


def measured_arm(kind: str, loss: str):
    """Return the LWR4+ with a joint that gives way, measured 250 times; with a robust loss one row is 5 mm off."""
    arm = perturb(load("lwr4plus"), 1, 0.5e-3, 1e-3)
    truth = replace(cell(arm, 1), deflection=Deflection((Term("theta2", "torque", 1),), np.array([4e-5]), arm))
    pulled = lambda q: gravity_torques(load("lwr4plus"), q)  # noqa: E731
    rows = measure(truth, kind, 250, 1, sigma=4e-5, sigma_rotation=1e-4, stated=False, torque=pulled)
    position = rows.position.copy()
    position[70] += 5e-3 * (loss != "none")
    return replace(rows, position=position)


def climbed(measured, loss: str) -> ModelSelection:
    return select_model(install(load("lwr4plus"), [measured]), [measured], "stiffness", settings=Settings(loss=loss))


@pytest.mark.slow
@pytest.mark.parametrize("kind, loss, sigmas", [("position", "none", 0.02), ("pose", "cauchy", 0.2)])
def test_pieces_and_warm_start_agree(kind, loss, sigmas, monkeypatch):
    """Pieces and a warm start change nothing."""
    measured = measured_arm(kind, loss)
    whole = climbed(measured, loss)
    sizes, pairs = errors(whole.fit.cell, [measured]), pair_errors(whole.fit.cell, [measured])
    monkeypatch.setattr(observation, "PIECE", 40)
    for place in (nonlinear, weighing):
        monkeypatch.setattr(place, "MOST_NUMBERS", 2000)
    monkeypatch.setattr(fitting, "WARM_POSES", 30)
    counts = []
    monkeypatch.setattr(
        fitting, "rows_of", lambda cell, block, rows: counts.append(len(rows)) or rows_of(cell, block, rows)
    )
    found = climbed(measured, loss)
    assert counts and max(counts) < 200  # begun from samples
    assert found.chosen == whole.chosen and found.fit.estimate.names == whole.fit.estimate.names
    # merging parameters share what is identified by widths that are estimated from the sample
    base = replace(whole.fit, free=whole.fit.free[:-1]).regrouping()
    gap = base @ (found.fit.estimate.values - whole.fit.estimate.values)[:-1] / whole.fit.base_sigma()
    assert np.abs(gap).max() < sigmas  # robust weights are settled to 2 %, from wherever they begin
    assert found.fit.base_sigma() == pytest.approx(whole.fit.base_sigma(), rel=0.01)
    assert found.cross_validated == pytest.approx(whole.cross_validated, rel=0.01)
    assert found.fit.row_weights()[0] == pytest.approx(whole.fit.row_weights()[0], abs=0.03)
    assert errors(whole.fit.cell, [measured]).position == pytest.approx(sizes.position, rel=1e-9)
    assert pair_errors(whole.fit.cell, [measured]) == pytest.approx(pairs, rel=1e-6)


@pytest.mark.parametrize("kind", ["position", pytest.param("pose", marks=pytest.mark.slow)])
def test_elementwise_statistics_match_rows(kind, monkeypatch):
    """Beside frames and lengths: harmonics of three joints, more than `MANY` corrections of two of them."""
    arm, offered = load("ur5"), EFFECTS["harmonics"](load("ur5"), False)
    elements, few = dict.fromkeys(term.element for term in offered), (MANY + 2, MANY + 5, MANY - 20)
    terms = tuple(t for e, most in zip(elements, few) for t in [one for one in offered if one.element == e][:most])
    assert len(terms) == sum(few)
    found = replace(cell(arm, 2), deflection=Deflection(terms, np.zeros(len(terms)), arm))
    measured = measure(found, kind, 90, 3, sigma=4e-5, sigma_rotation=1e-4)
    table, random = layout(found), np.random.default_rng(4)
    free = np.concatenate([table.rigid_index, table.index("deflection")])
    monkeypatch.setattr(observation, "PIECE", 40)
    (block,) = prepare(found, [measured])
    parts = observe(found, block, free)
    scales = [random.uniform(1e-5, 1e-4, (len(part.value), len(measured))) for part in parts]
    for part, scale in zip(parts, scales):
        wanted = gram(*part.whitened(scale))
        own = [one for piece, one in row_statistics(found, block, free, scales) if piece.label == part.label]
        assert len(own) == 3 and sum(one.rows for one in own) == part.value.size
        for name in ("square", "cross", "total"):
            whole = getattr(wanted, name)
            summed = sum(getattr(one, name) for one in own)
            assert summed == pytest.approx(whole, rel=1e-9, abs=1e-9 * np.abs(whole).max())
    root = random.standard_normal((len(free), len(free))) * 1e-6
    covariance = root @ root.T
    sigma = pose_sigmas(found, measured, free, covariance, 0, 0)[:, 0]
    assert position_variances(found, measured, free, covariance, 0, 0) == pytest.approx(sigma**2, rel=1e-8)
    moving = replace(measured, late=np.ones((len(measured), 1, 3)))
    assert separable(measured) and not separable(moving) and isinstance(measured, Poses) == (kind == "pose")

"""The ladder takes up what was planted, and nothing where the truth is rigid."""

from dataclasses import replace
from functools import cache, partial
from itertools import pairwise

import numpy as np
import pytest
from planted import cell, load, measure, perturb, random_joints

from calib.errors import UsageError
from calib.geometry.first_guess import install
from calib.geometry.installation import Installation, see
from calib.geometry.model_choice.ladder import select_model
from calib.robot.calibrated import Deflection, Term, evaluate
from calib.robot.kinematics import gravity_torques

SIGMA = 4e-5


def climb(nominal, measured, *model: str, **more):
    return select_model(install(nominal, [measured]), [measured], *model, **more)


def rigid(robot: str, seed: int) -> Installation:
    return cell(perturb(load(robot), seed, 0.5e-3, 1e-3), seed)


def sagging(seed: int) -> Installation:
    """Return an LWR whose joints 2 and 4 give way: some millimetres at the tool."""
    truth = rigid("lwr4plus", seed)
    terms = (Term("theta2", "torque", 1), Term("theta4", "torque", 3))
    return replace(truth, deflection=Deflection(terms, np.array([4e-5, 8e-5]), truth.chain))


def wavy(seed: int) -> Installation:
    """Return a UR5 with gear errors of 0.1 to 0.2 mrad on three joints, twice per turn and more often."""
    truth = rigid("ur5", seed)
    terms = (Term("theta2", "sin", 1, 2), Term("theta3", "cos", 2, 5), Term("theta1", "sin", 0, 11))
    return replace(truth, deflection=Deflection(terms, np.array([2e-4, 1.5e-4, 2e-4]), truth.chain))


def unseen(found, truth: Installation, known: bool) -> float:
    """Return the rms position error at 400 other joints [m]."""
    q = random_joints(truth.chain, 400, 99)
    nominal = load(truth.chain.name)
    predicted = evaluate(found.cell.deflection, q, gravity_torques(nominal, q) if known else None)
    true = evaluate(truth.deflection, q, gravity_torques(nominal, q) if known else None)
    gap = see(found.cell, q, bases=predicted).point - see(truth, q, bases=true).point
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=0))))


@pytest.mark.parametrize(
    "robot, kind, count",
    [
        ("ur5", "position", 150),
        pytest.param("lwr4plus", "pose", 120, marks=pytest.mark.slow),
        pytest.param("ur5", "pose", 600, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_rigid_truth_shows_no_effect(robot, kind, count, seed):
    """A rigid truth gives the geometry and no effect."""
    truth = rigid(robot, seed)
    measured = measure(truth, kind, count, seed, sigma=SIGMA, sigma_rotation=1e-4)
    found = climb(load(robot), measured)
    assert found.chosen == "geometry"
    assert not found.fit.cell.deflection.terms
    kept = [rung.model for rung in found.rungs if rung.kept]
    assert kept[-1] == "geometry"
    best = next(rung for rung in found.rungs if rung.model == "geometry")
    assert best.cross_validated == pytest.approx(SIGMA * np.sqrt(3), rel=0.25)
    assert best.parameters == found.fit.identified == found.fit.split.rank


@pytest.mark.slow
def test_an_arm_that_is_its_nominal_stays_so():
    """The error of the fit is at most the noise that as many identifiable parameters take up."""
    truth = cell(load("ur5"), 1)
    found = climb(load("ur5"), measure(truth, "position", 150, 1, sigma=SIGMA))
    assert found.chosen == "geometry"
    assert unseen(found.fit, truth, False) < 1.3 * SIGMA * np.sqrt(found.fit.identified / 150)


@pytest.mark.slow
def test_offsets_cost_no_more_than_geometry():
    """Where only the offsets are wrong the full geometry finds that, to its noise."""
    nominal = load("ur5")
    moving = [nominal.names[k] for k in nominal.moving]
    offsets = dict(zip(moving, 2e-3 * np.random.default_rng(0).normal(size=6)))
    truth = cell(nominal.with_values(offsets), 1)
    measured = measure(truth, "position", 150, 1, sigma=SIGMA)
    found, offsets = climb(nominal, measured), climb(nominal, measured, "offsets")
    assert unseen(found.fit, truth, False) < 1.3 * SIGMA * np.sqrt(found.fit.identified / 150)
    assert unseen(offsets.fit, truth, False) < 1.3 * SIGMA * np.sqrt(offsets.fit.identified / 150)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
@pytest.mark.parametrize("known", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_planted_compliance_is_found(seed, known):
    """With gravity torques as compliances, near the planted ones; without, as moments fitted with the geometry."""
    truth, nominal = sagging(seed), load("lwr4plus")
    measured = measure(truth, "position", 200, seed, sigma=SIGMA, torque=partial(gravity_torques, nominal))
    measured = measured if known else replace(measured, torque=None)
    found = climb(nominal, measured)
    plain = climb(nominal, measured, "geometry")
    assert "stiffness" in found.chosen
    errors = [unseen(f.fit, truth, True) if known or f is plain else _unseen_sag(f.fit, truth) for f in (found, plain)]
    assert errors[0] < 2.5 * SIGMA < 5 * SIGMA < errors[1]
    if known:
        fitted = dict(zip(found.fit.cell.deflection.names(nominal), np.asarray(found.fit.cell.deflection.coefficients)))
        assert fitted["theta2 compliance"] == pytest.approx(4e-5, rel=0.1)
        assert fitted["theta4 compliance"] == pytest.approx(8e-5, rel=0.2)


def _unseen_sag(found, truth: Installation) -> float:
    q = random_joints(truth.chain, 400, 99)
    true = evaluate(truth.deflection, q, gravity_torques(load("lwr4plus"), q))
    gap = see(found.cell, q).point - see(truth, q, bases=true).point
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=0))))


@cache
def climbed(seed: int) -> tuple:
    """Return the ladder of a wavy UR5, and its geometry alone."""
    measured = measure(wavy(seed), "position", 400, seed, sigma=SIGMA)
    return climb(load("ur5"), measured), climb(load("ur5"), measured, "geometry")


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_planted_harmonics_are_found(seed):
    truth, nominal = wavy(seed), load("ur5")
    found, plain = climbed(seed)
    assert "harmonics" in found.chosen
    assert unseen(found.fit, truth, False) < 0.5 * unseen(plain.fit, truth, False)
    fitted = dict(zip(found.fit.cell.deflection.names(nominal), np.asarray(found.fit.cell.deflection.coefficients)))
    joints = nominal.joint_names
    assert fitted[f"theta2 sin 2 {joints[1]}"] == pytest.approx(2e-4, rel=0.25)
    assert fitted[f"theta3 cos 5 {joints[2]}"] == pytest.approx(1.5e-4, rel=0.25)
    assert fitted[f"theta1 sin 11 {joints[0]}"] == pytest.approx(2e-4, rel=0.25)


@pytest.mark.slow
def test_last_kept_rung_is_chosen():
    """The last rung kept is the one chosen, and each kept rung is better."""
    found, _ = climbed(0)
    kept = [rung for rung in found.rungs if rung.kept]
    assert np.all(np.diff([rung.cross_validated for rung in kept]) < 0)
    assert found.chosen.split(" + ")[-1] == kept[-1].model.removeprefix("+ ")
    assert kept[-1].parameters == found.fit.identified
    assert found.nominal.cell.chain is not found.fit.cell.chain
    assert np.array_equal(found.nominal.cell.chain.values, load("ur5").values)


@pytest.mark.parametrize("model", ["frames", "offsets", "geometry", "stiffness", "coupling"])
def test_any_rung_can_be_asked_for(model):
    found = climb(load("ur5"), measure(rigid("ur5", 2), "position", 120, 1, sigma=SIGMA), model)
    assert found.chosen.split(" + ")[-1] == model
    assert found.rungs[-1].kept


@pytest.mark.slow
def test_what_is_fixed_stays_at_its_nominal():
    from calib.geometry.observation import layout

    truth, nominal = rigid("ur5", 3), load("ur5")
    measured = measure(truth, "position", 120, 1, sigma=SIGMA)
    start = install(nominal, [measured])
    fixed = layout(start).find(["theta3", "d3"])
    found = select_model(start, [measured], "geometry", fixed=fixed)
    assert np.array_equal(found.fit.cell.chain.values[fixed], nominal.values[fixed])
    assert not np.isin(fixed, found.fit.free).any()


def test_unknown_model_is_refused_with_list():
    """An unknown model is refused with the list."""
    truth = rigid("ur5", 3)
    measured = measure(truth, "position", 40, 1, sigma=SIGMA)
    with pytest.raises(UsageError, match="harmonics"):
        select_model(truth, [measured], "neural")


def test_progress_is_told():
    truth = rigid("ur5", 3)
    measured = measure(truth, "position", 60, 1, sigma=SIGMA)
    told = []
    select_model(truth, [measured], "geometry", progress=lambda done, total, what: told.append((done, total, what)))
    assert list(dict.fromkeys(what for _, _, what in told)) == ["frames", "geometry"]
    assert all(a[0] <= b[0] for a, b in pairwise(told)) and told[-1][0] <= told[-1][1]

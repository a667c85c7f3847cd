"""Compliance from poses under two stated loads, without torques, with wrong or no masses; the arm is Pinocchio's."""

import re
from dataclasses import replace

import numpy as np
import pytest
from loaded_arm import HEAD, GivingArm, urdf

import calib
from calib.geometry.static_torques.load_errors import DESCRIBED
from calib.geometry.static_torques.mass_factors import MassFactors
from calib.procedure.kinematic_stage.folder import FitFolder
from calib.procedure.kinematic_stage.inputs import gather
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.robot.formats import urdf as urdf_format

COLUMNS = [*HEAD[:10], "payload [kg]"]
# noise of a position, all axes [m]
NOISE = np.sqrt(3.0) * 1e-4


def description(factor: float, own: float = 0.0) -> str:
    """Return the arm with all masses times a factor, and each times one of its own; without masses for factor 0."""
    random = np.random.default_rng(7)
    if not factor:
        return urdf()
    return re.sub(
        r'mass value="([\d.]+)"',
        lambda mass: f'mass value="{float(mass[1]) * factor * np.exp(own * random.normal()):.6g}"',
        urdf(True),
    )


def fitted(path, factor, own=0.0, seed=3, loads=(0.0, 2.5), unseen=5.0, settings=None):
    """Return a fit to poses under loads [kg], validated with another one."""
    return fitted_to(path, description(factor, own), seed, loads, unseen, settings)


def fitted_to(path, text, seed=3, loads=(0.0, 2.5), unseen=5.0, settings=None):
    """Return a fit of a described arm to poses under loads [kg], validated with another one."""
    arm = GivingArm(seed=seed)
    (path / "arm.urdf").write_text(text)
    tables = {"fit": np.concatenate([loaded(arm, 60, number, load) for number, load in enumerate(loads)])}
    tables["unseen"] = loaded(arm, 80, 9, unseen)
    for name, table in tables.items():
        arm.write(path / f"{name}.csv", table, COLUMNS)
    return calib.fit_geometry(path / "arm.urdf", path / "fit.csv", settings, validate=path / "unseen.csv")


def loaded(arm, count, seed, load):
    """Return rows of positions alone, and of the load that the tip carries."""
    table = arm.table(count, seed, load, (0.0, 0.0, 0.0))[:, :10]
    return np.column_stack([table, np.full(count, load)])


def codes(fit):
    return {finding.code: finding.values for finding in fit.assessment.noticed}


@pytest.mark.slow
def test_masses_described_2_5_times_too_large_are_seen_and_the_unseen_load_is_predicted(tmp_path):
    """With the described masses the error was twice the noise, and nothing was said."""
    fit = fitted(tmp_path, 2.5)
    (rows,) = fit.validation.values()
    assert rows.errors[1].rms < 1.3 * NOISE
    assert rows.intervals.covered >= 0.9
    assert np.median(rows.intervals.radius) < 4.0 * NOISE
    scaled = codes(fit)["masses-scaled"]
    assert abs(scaled["factor"] - 1.0 / 2.5) < 3.0 * scaled["sigma"]
    assert codes(fit)["torques-used"]["source"] == "of masses fitted to the deflection under the stated loads"
    folder = FitFolder(fit.save(tmp_path / "saved", plots=False))
    assert folder.findings().discrepancy.mass_doubt == fit.expected.discrepancy.mass_doubt
    driven = folder.driven(gather(tmp_path / "arm.urdf", [tmp_path / "fit.csv"]))
    assert np.allclose(driven.fit[0].torque, fit.inputs.fit[0].torque)


@pytest.mark.slow
def test_right_masses_are_kept(tmp_path):
    fit = fitted(tmp_path, 1.0)
    (rows,) = fit.validation.values()
    assert rows.errors[1].rms < 1.3 * NOISE
    assert "masses-scaled" not in codes(fit)


@pytest.mark.slow
def test_under_one_load_the_doubt_of_the_masses_remains(tmp_path):
    """One load tells the product of compliance and masses alone: the interval is that of the prior."""
    fit = fitted(tmp_path, 1.4, loads=(2.5,))
    assert fit.expected.discrepancy.mass_doubt == DESCRIBED
    assert "masses-scaled" not in codes(fit)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, 0.4, 0.0])
def test_nearly_equal_loads_leave_the_doubt_of_the_masses(tmp_path, factor):
    """Ten grams more tell no masses: the prior of compliance made them large, by which the interval was too narrow."""
    fit = fitted(tmp_path, factor, loads=(2.5, 2.51))
    (rows,) = fit.validation.values()
    assert rows.intervals.covered >= 0.9
    assert fit.expected.discrepancy.mass_doubt > DESCRIBED
    assert "masses-scaled" not in codes(fit)
    # without described masses it exceeds the deflection itself, and the verdict says so
    is_unlearnt = fit.expected.discrepancy.mass_doubt > 1.0
    assert is_unlearnt is (factor == 0.0) is ("by another load is uncertain" in str(fit.verdict))


@pytest.mark.parametrize("seed", [3, 4])
def test_a_deflection_that_a_rigid_model_leaves_is_within_the_intervals(tmp_path, seed):
    """The arm gives way, and the model has no compliance: what the loads show stays in its bound."""
    fit = fitted(tmp_path, 1.0, seed=seed, settings=FitSettings(model="geometry"))
    (rows,) = fit.validation.values()
    assert rows.intervals.covered >= 0.9
    assert 0.0 < fit.expected.discrepancy.unlearnt < 1.0


def test_a_common_factor_leaves_changed_centres_of_mass():
    """First moments kept their change: light masses were preferred, where centres were far from the described ones."""
    before = MassFactors.before(urdf_format.parse(description(1.0), "arm.urdf"))
    n = before.chain.n
    centres = np.linspace(-0.1, 0.1, 3 * n)
    moved, heavier = (
        replace(before, values=np.concatenate([np.full(n, logarithm), centres])) for logarithm in (0.0, np.log(2.0))
    )
    assert not np.allclose(moved.masses, before.masses)
    assert np.allclose(heavier.masses, 2.0 * moved.masses)


@pytest.mark.slow
def test_bodies_without_described_mass_are_unknown_beside_one_with(tmp_path):
    """They were kept without mass: the unseen load's error was larger than with no mass described at all."""
    described = description(1.0)
    links = re.split(r"(<inertial>.*?</inertial>)", described, flags=re.DOTALL)
    text = "".join(part for number, part in enumerate(links) if number % 2 == 0 or number == 5)
    fit = fitted_to(tmp_path, text)
    (rows,) = fit.validation.values()
    assert rows.errors[1].rms < 1.3 * NOISE
    assert rows.intervals.covered >= 0.9
    assert "masses-scaled" not in codes(fit)


@pytest.mark.slow
def test_an_arm_described_as_too_light_for_one_kilogram_is_fitted(tmp_path):
    """Of 0.3 kg, it may carry three times its mass; more was asked of it to find how well a deflection is known."""
    fit = fitted(tmp_path, 0.015, loads=(0.0, 0.9), unseen=0.6)
    assert codes(fit)["masses-scaled"]["factor"] > 1.0
    assert fit.expected.discrepancy.mass_doubt != DESCRIBED


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("factor", "own"), [(2.5, 0.0), (0.4, 0.0), (1.0, 0.3), (2.5, 0.3), (0.0, 0.0)])
def test_an_unseen_load_is_predicted_for_any_described_masses(tmp_path, factor, own, seed):
    """Of one factor, one of each body, or none described: 5 kg are predicted from 0 and 2.5 kg, and intervals hold."""
    fit = fitted(tmp_path, factor, own, seed)
    (rows,) = fit.validation.values()
    assert rows.errors[1].rms < 1.5 * NOISE
    assert rows.intervals.covered >= 0.9
    assert fit.expected.discrepancy.mass_doubt < 0.1

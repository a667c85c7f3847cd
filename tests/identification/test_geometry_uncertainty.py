"""Claims on sensitivity and total covariance: derivative, identities, and a small Monte Carlo of whole calibrations."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import differences
import numpy as np
import planted_motion as planted
import pytest

from calib import cli, files
from calib.data.csv_table import read_table
from calib.data.poses.measurements import PoseMeasurements
from calib.data.signals.filtering import decimate, design_decimator, spread
from calib.dynamics import base as bases
from calib.dynamics import rigid_body
from calib.dynamics.bodies import bodies_of
from calib.errors import RobotError
from calib.geometry.weighing import calibrated_chain
from calib.identification.identify import identify
from calib.identification.settings import IdentificationSettings
from calib.identification.uncertainty import geometry_uncertainty
from calib.procedure.dynamic_stage import geometry_tables
from calib.procedure.report.figures import figure_data
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain, Joint

PLAIN = IdentificationSettings(friction="standard", essential="none")
MOVED = {"up": np.pi / 2 + 0.01, "upper": 0.51, "shoulder": 0.02}


@pytest.mark.parametrize("factor", [1, 3, 8])
def test_spreading_is_adjoint_of_decimation(factor):
    """Spreading is the adjoint of decimation."""
    rng, decimator = np.random.default_rng(factor), design_decimator(100.0, factor)
    x = rng.normal(size=(311, 2))
    y = rng.normal(size=decimate(x, decimator).shape)
    back = spread(y, decimator, len(x))
    assert back.shape == x.shape
    assert np.sum(y * decimate(x, decimator)) == pytest.approx(np.sum(back * x), abs=1e-11)


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param(PLAIN, marks=pytest.mark.slow),
        replace(PLAIN, method="ols"),
        pytest.param(replace(PLAIN, friction="asymmetric"), marks=pytest.mark.slow),
        replace(PLAIN, prior="cad"),
        pytest.param(replace(PLAIN, samples=200), marks=pytest.mark.slow),
    ],
    ids=["wls", "ols", "ridge", "prior", "thinned"],
)
def test_sensitivity_is_slope_of_estimate(settings):
    """The sensitivity is the derivative of the estimate."""
    arm, case = planted.arm().with_values(MOVED), planted.case("a", 0)
    found = identify(CalibratedChain(arm, planted.arm()), [case], settings)
    how = geometry_uncertainty.estimator(found)
    again, _ = geometry_uncertainty.estimate(how, found.rows)
    np.testing.assert_allclose(again, found.fitted.estimate.values, atol=1e-9)
    matrix, _, _ = geometry_uncertainty.sensitivity(found, arm, [case])

    def refitted(values: np.ndarray) -> np.ndarray:
        return geometry_uncertainty.estimate(how, geometry_uncertainty.rows_on(found, arm.with_values(values), [case]))[
            0
        ]

    differences.check(refitted, matrix[:, :-2], np.array(arm.values), step=1e-5, tolerance=1e-7)


@pytest.mark.slow
def test_pieces_of_a_recording_tell_the_same(monkeypatch):
    """Pieces of a long recording tell the same."""
    arm, case = planted.arm(), planted.case("a", 0, noise=0.0, duration=60.0)
    found = identify(arm, [case], PLAIN)
    whole, _, _ = geometry_uncertainty.sensitivity(found, arm, [case])
    monkeypatch.setattr(geometry_uncertainty, "SAMPLES", 6000)
    part, _, _ = geometry_uncertainty.sensitivity(found, arm, [case])
    sigma = found.fitted.estimate.sigma[:, None]
    assert np.abs((part - whole) / sigma).max() < 0.1 * np.abs(whole / sigma).max()
    assert not np.array_equal(part, whole)


def test_element_is_a_joint_nobody_moves():
    """∂tau/∂value from the kernels' exact gradient, on a chain in which every element is a joint."""
    arm, case = planted.arm().with_values(MOVED), planted.case("a", 0, band=80.0, duration=6.0)
    found = identify(arm, [case], PLAIN)
    assert case.motion.decimator.factor == 1
    _, felt, _ = geometry_uncertainty.sensitivity(found, arm, [case])
    count = len(arm.elements)
    loose = Chain(
        "loose", tuple(Joint(f"j{k}") for k in range(count)),
        tuple(replace(e, joint=k, owner=k, value=0.0) for k, e in enumerate(arm.elements)), gravity=arm.gravity,
    )  # fmt: skip
    states = [np.zeros((len(case.motion), count)) for _ in range(3)]
    states[0] += arm.values
    values = np.zeros((count, 10))
    standard = found.base.to_standard(found.fitted.estimate.values)[:30].reshape(3, 10)
    for row, k in enumerate(arm.moving):
        values[k] = standard[row]
        for state, given in zip(states, (case.motion.q, case.motion.v, case.motion.a)):
            state[:, k] += given[:, row]
    square = np.zeros(count)
    for k in arm.moving:
        weights = np.zeros((len(case.motion), count, 10 * count))
        weights[:, k] = values.ravel()
        square += np.mean(rigid_body.regressor_gradient(bodies_of(loose), *states, weights)[0] ** 2, axis=0)
    np.testing.assert_allclose(felt[:-2], np.sqrt(square / 3), rtol=1e-7, atol=1e-9)


def test_last_offset_turns_last_body_alone():
    """An offset of the last joint turns its body's parameters, and nothing else."""
    arm, case = planted.arm(), planted.case("a", 0, noise=0.0)
    found = identify(arm, [case], PLAIN)
    carried = geometry_uncertainty.propagate(found, arm, [case])
    slope = dict.fromkeys(found.base.standard, 0.0)
    xx, xy, xz, yy, yz, _, mx, my, _, _ = planted.INERTIAS[2]
    slope |= {"XX3": 2 * xy, "XY3": yy - xx, "XZ3": yz, "YY3": -2 * xy, "YZ3": -xz, "MX3": my, "MY3": -mx}
    expected = found.base.transform @ list(slope.values())
    np.testing.assert_allclose(carried.sensitivity[:, carried.elements.index("elbow")], expected, atol=1e-7)
    assert carried.left[carried.elements.index("elbow")] < 1e-8 < carried.felt[carried.elements.index("elbow")]


def test_geometry_that_is_exact_adds_nothing():
    arm, case = planted.arm(), planted.case("a", 0)
    found = identify(arm, [case], PLAIN)
    without = geometry_uncertainty.propagate(found, arm, [case])
    assert without.geometry is None and "assumed exact" in geometry_tables.summary(without)
    np.testing.assert_array_equal(without.covariance, found.fitted.estimate.covariance)
    tiny = geometry_uncertainty.propagate(found, CalibratedChain(arm, covariance=1e-16 * np.eye(6)), [case])
    assert not tiny.changed.any() and "no propagation" in geometry_tables.summary(tiny)
    assert np.linalg.eigvalsh(tiny.covariance - tiny.torque).min() > -1e-12


@pytest.mark.slow
def test_intervals_need_propagation_to_cover():
    """60 calibrations: the geometry drawn from its covariance, the torques noisy; the truth stays."""
    real, settings = planted.arm(), PLAIN
    truth = np.append(bases.find(planted.model()).transform @ planted.truth(), [])
    spread_of = np.diag([0.0, 2e-3, 3e-3, 1e-3, 3e-3, 0.0]) ** 2
    rng = np.random.default_rng(3)
    inside, outside, dominated = [], [], []
    for _ in range(60):
        believed = real.with_values(real.values + np.sqrt(np.diag(spread_of)) * rng.standard_normal(6))
        case = planted.case("a", 0, noise=0.0)
        noisy = replace(case, target=case.target + 0.2 * rng.normal(size=case.target.shape))
        robot = CalibratedChain(believed, real, spread_of)
        found = identify(robot, [noisy], settings)
        carried = geometry_uncertainty.propagate(found, robot, [noisy])
        off = np.abs(found.fitted.estimate.values - truth)
        inside.append(off < 1.96 * carried.sigma)
        outside.append(off < 1.96 * carried.sigma_torque)
        dominated.append(carried.dominated)
    often = np.mean(dominated, axis=0) > 0.5
    assert 0.93 < np.mean(inside) < 0.97
    assert often.sum() >= 3 and (np.mean(outside, axis=0)[often] < 0.9).all()


def fitted_folder(tmp_path: Path, covariance: float | None) -> Path:
    """Return the folder of a fit of the planted arm, with the covariance of two elements."""
    folder, nominal = tmp_path / "fit", planted.arm()
    moved = nominal.with_values(MOVED)
    known = None if covariance is None else np.diag(np.where(np.isin(moved.names, ("up", "shoulder")), covariance, 0.0))
    calibrated.write(folder, CalibratedChain(moved, nominal, known))
    return folder


def run(folder: Path, tmp_path: Path, *more: str) -> tuple[dict, list[dict], Path]:
    train, out = planted.write(tmp_path, "train.npz", 0), tmp_path / "out"
    assert cli.run(["identify", *map(str, (folder, train, "--out", out, "--friction", "standard", *more))]) == 0
    rows = list(csv.DictReader((out / "estimate.csv").open()))
    return json.loads((out / "metrics.json").read_text())["geometry"], rows, out


@pytest.mark.slow
def test_command_carries_covariance_of_fit(tmp_path, capsys):
    """The command carries the fit's covariance."""
    found, rows, out = run(fitted_folder(tmp_path, 1e-6), tmp_path, "-v")
    assert found["propagated"] and found["geometry_exceeds_torque"] and found["largest_growth_of_sigma"] > 1.4
    for row in rows:
        total = np.hypot(float(row["sigma_torque"]), float(row["sigma_geometry"]))
        assert float(row["sigma"]) == pytest.approx(total, rel=1e-9)
    matrix = np.genfromtxt(out / "covariance.csv", delimiter=",", skip_header=1)[:, 1:]
    np.testing.assert_allclose(np.sqrt(np.diag(matrix)), [float(row["sigma"]) for row in rows])
    ranked = list(csv.DictReader((out / "geometry_effects.csv").open()))
    assert [row["element"] for row in ranked if row["sigma"]] == ["shoulder", "up"]
    assert {row["element"] for row in ranked} > {"gravity.rx", "turn", "fore"}
    assert "geometries" in figure_data.of_folder(out) and (out / "geometries.csv").is_file()
    torques = read_table(out / "torques_1.csv")
    measured, predicted, nominal = (torques.block(name) for name in ("measured", "predicted", "nominal"))
    errors = [np.sqrt(np.mean((measured - torque) ** 2)) for torque in (predicted, nominal)]
    assert np.abs(nominal - predicted).max() > 0.0 and errors[1] == pytest.approx(errors[0], rel=0.5)
    assert "which geometric errors matter" in capsys.readouterr().out
    kept = calibrated.read(out).covariance
    assert kept is not None and kept[1, 1] == pytest.approx(1e-6), "the identified robot carries it on"


@pytest.mark.slow
def test_geometry_taken_as_exact_is_said(tmp_path, capsys):
    """The command says where the geometry is taken as exact."""
    found, rows, out = run(fitted_folder(tmp_path, None), tmp_path, "--no-plots")
    assert not found["propagated"] and {row["sigma_geometry"] for row in rows} == {""}
    assert "assumed exact" in capsys.readouterr().out.replace("\n", " ")
    assert not (out / calibrated.COVARIANCE).exists()


def test_fit_writes_covariance_of_its_chain(tmp_path):
    """A fit writes the covariance of its chain."""
    from calib.geometry.first_guess import install
    from calib.geometry.fit import fit
    from calib.robot.chain import random_joints
    from calib.simulation.cell import measure
    from calib.simulation.virtual_cells import lwr4plus_cell

    cell = lwr4plus_cell(hidden=0.0)
    measured: PoseMeasurements = measure(cell, random_joints(cell.nominal, 40, 1), 2)
    found = fit(install(cell.nominal, [measured]), [measured])
    calibrated.write(tmp_path, calibrated_chain(found))
    read = calibrated.read(tmp_path).covariance
    assert read is not None
    sigma = dict(zip(found.estimate.names, found.estimate.sigma))
    for name, variance in zip(found.cell.chain.names, np.diag(read)):
        assert np.sqrt(variance) == pytest.approx(sigma.get(name, 0.0), rel=1e-9)
    arm = set(found.estimate.names) & set(found.cell.chain.names)
    assert np.count_nonzero(np.diag(read)) == len(arm) > 20
    files.write_table(tmp_path / calibrated.COVARIANCE, ("name", "alpha2"), [("d2", 1.0)])
    with pytest.raises(RobotError, match="parameter names of rows and columns differ"):
        calibrated.read(tmp_path)

"""The methods of ``calib identify`` on planted logs: each is right where its assumption holds, and says what it is."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest
from without_figures import run

from calib.estimation.triangles import collect
from calib.folders import read_estimate
from calib.identification.identify import identify as fit
from calib.identification.methods.estimators import scaled_tls
from calib.identification.registry import METHODS
from calib.procedure.dynamic_stage.inputs import gather
from calib.procedure.dynamic_stage.verdict import model_findings


def identify(robot: Path, log: Path, method: str, out: Path, code: int = 0) -> dict[str, tuple[float, float]]:
    """Return value and sigma of the drives' parameters; the verdict's exit code is `code`."""
    options = out.parent / "o.toml"
    options.write_text("[filter]\ncutoff = 30.0\nband = 8.0\n")
    chosen = ("--method", method, "--friction", "standard", "--options", options)
    assert run("identify", robot, log, *chosen, "--out", out) == code
    rows = csv.DictReader((out / "estimate.csv").open())
    return {row["name"]: (float(row["value"]), float(row["sigma"])) for row in rows}


def away(found: dict[str, tuple[float, float]], sigma: dict[str, tuple[float, float]]) -> float:
    """Return rms((x - truth) / σ) of friction and offsets."""
    truth = {f"{name}{j + 1}": planted.DRIVES[name][j] for name in ("Fv", "Fc", "off") for j in range(3)}
    return float(np.sqrt(np.mean([((found[name][0] - x) / sigma[name][1]) ** 2 for name, x in truth.items()])))


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [*(pytest.param(method, marks=pytest.mark.slow) for method in ("ols", "tls")), "irls"]
)
def test_all_methods_find_truth_of_clean_log(robot, tmp_path, capsys, method):
    """All methods find the truth of a clean log."""
    log = planted.write(tmp_path, "train.npz", 0)
    found = identify(robot, log, method, tmp_path / "out")
    assert away(found, found) < 2.0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["method"] == method and metrics["method_assumes"] == METHODS[method].assumes
    assert f"method {method}: assumes that" in capsys.readouterr().out


@pytest.mark.slow
def test_robust_weights_gate_hanging_sensor(robot, tmp_path):
    """Torques frozen for a second here and there: least squares is off by many of its clean sigmas, irls by few.

    Neither explains the frozen rows: both fail on the training motion.
    """
    logged = planted.series(0)
    tau = logged["tau"].copy()
    for start in (400, 1500, 2300, 3100):
        tau[start : start + 200] = tau[start] + np.array([25.0, -30.0, 8.0])
    clean = identify(robot, planted.write(tmp_path, "clean.npz", 0), "wls", tmp_path / "clean")
    log = planted.write(tmp_path, "hung.npz", 0, tau=tau)
    off = {method: away(identify(robot, log, method, tmp_path / method, 1), clean) for method in ("wls", "irls")}
    assert off["irls"] < 0.1 * off["wls"] and off["irls"] < 4.0


def test_tls_is_right_for_noisy_columns():
    """Two columns nearly alike, noise of a hundredth of each: least squares shrinks their difference, TLS does not."""
    rng = np.random.default_rng(0)
    names, truth = ("ZZ1R", "Fv1", "Fc1", "off1"), np.array([40.0, 20.0, 30.0, 5.0])
    true = rng.normal(size=(4000, 4)) * [3.0, 1.0, 1.0, 0.0] + [0.0, 0.0, 0.0, 1.0]
    true[:, 1] = true[:, 0] / 3.0 + 0.1 * true[:, 1]
    size = np.sqrt(np.mean(true**2, axis=0)) * [0.01, 0.01, 0.0, 0.0]
    errors = {"tls": [], "ls": []}
    std = 1.0
    for _ in range(40):
        noisy = true + size * rng.normal(size=true.shape)
        y = true @ truth + std * rng.normal(size=len(true))
        data = collect(noisy, y, np.zeros(len(y), dtype=int), names, ("",) * 4)
        found = scaled_tls(data, np.array([std]), np.array([False, False, True, True]))
        errors["tls"].append((found.estimate.values - truth) / found.estimate.sigma)
        errors["ls"].append((np.linalg.lstsq(noisy, y, rcond=None)[0] - truth) / found.estimate.sigma)
    mean = {name: np.abs(np.mean(each, axis=0)) * np.sqrt(40) for name, each in errors.items()}
    assert mean["tls"].max() < 3.5 and mean["ls"].max() > 10.0
    assert 0.7 < np.std(errors["tls"]) < 1.3


def test_joint_error_widens_all_sigmas(robot: Path, tmp_path: Path):
    """A slow wave in one joint's torque: irls and tls promise no more than weighted least squares of the same rows."""
    log = planted.series(0)
    drift = np.convolve(np.random.default_rng(0).normal(size=len(log["t"])), np.hanning(300), "same")
    wave = 0.3 * np.outer(drift, [0.0, 0.0, 1.0])
    path = planted.write(tmp_path, "wave.npz", 0, tau=log["tau"] + wave)
    inputs = gather(robot, [path], friction="standard")
    found = {
        method: fit(inputs.robot, inputs.cases, replace(inputs.options.settings, method=method, prior="none"))
        for method in ("wls", "irls", "tls")
    }
    assert found["wls"].fitted.inflation[2] > 3.0
    sigma = {method: one.fitted.estimate.sigma for method, one in found.items()}
    assert all(np.median(sigma[method] / sigma["wls"]) > 0.9 for method in ("irls", "tls"))
    assert "autocorrelated-residual" in {one.code for one in model_findings(inputs.cases, found["tls"])}


@pytest.mark.slow
def test_parameter_on_bound_has_no_sigma(robot: Path, tmp_path: Path):
    """Certainty would be the bound's, not the data's: the cell is empty, the others have theirs, readers get NaN."""
    options, out = tmp_path / "o.toml", tmp_path / "out"
    options.write_text("[constraints]\nbounds = { Fv1 = [4.0, inf] }\n")
    log = planted.write(tmp_path, "train.npz", 0)
    more = ("--method", "pc-wls", "--friction", "standard", "--options", options, "--out", out)
    run("identify", robot, log, *more)
    rows = {row["name"]: row for row in csv.DictReader((out / "estimate.csv").open())}
    assert float(rows["Fv1"]["value"]) == pytest.approx(4.0, rel=1e-5)
    assert rows["Fv1"]["sigma"] == rows["Fv1"]["rsd [%]"] == rows["Fv1"]["sigma_torque"] == ""
    assert "on its bound" in rows["Fv1"]["expression"]
    assert all(float(row["sigma"]) > 0.0 for name, row in rows.items() if name != "Fv1")
    stored = read_estimate(out)
    assert [one.name for one in stored if one.sigma is None] == ["Fv1"]


def test_every_method_says_what_it_assumes():
    least_squares = {"ols", "wls", "irls", "iv", "didim"}
    others = {"tls", "ml", "cloe", "clie", "adaline", "hopfield", "ekf", "srekf", "ukf", "srukf", "cdkf",
              "srcdkf", "gtls", "set-membership"}  # fmt: skip
    assert set(METHODS) == least_squares | others | {f"pc-{name}" for name in least_squares}
    assert all(one.name == name and len(one.assumes) > 20 for name, one in METHODS.items())
    assert all("\n" not in one.description and one.description and one.source for one in METHODS.values())
    assert {one.name for one in METHODS.values() if one.needs_controller} == {
        "iv", "didim", "cloe", "clie", "pc-iv", "pc-didim",
    }  # fmt: skip

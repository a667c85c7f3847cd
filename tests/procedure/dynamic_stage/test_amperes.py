"""Currents without gains: a model in amperes says so and goes nowhere; identified gains are kept."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest
from without_figures import run

from calib.dynamics import drives
from calib.identification.friction.friction_ladder import FrictionSelection, FrictionTrial
from calib.identification.identify import identify
from calib.identification.settings import IdentificationSettings

GAINS = np.array([10.0, 12.0, 8.0])


def currents(folder: Path, name: str, seed: int, payload: bool = False) -> Path:
    """Write a recording of currents, torque = gain · current."""
    t, q, v, a = planted.motion(seed, duration=12.0)
    tau = planted.torques(q, v, a, payload=payload)
    rng = np.random.default_rng(seed)
    path = folder / name
    np.savez(path, t=t, q=q, i=(tau + 0.02 * rng.normal(size=tau.shape)) / GAINS)
    return path


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from calib.robot import description

    return description.write(tmp_path_factory.mktemp("amperes") / "planted.toml", planted.arm())


@pytest.fixture(scope="module")
def amperes(robot: Path) -> Path:
    """Return the folder of a model in amperes."""
    out = robot.parent / "out"
    assert run("identify", robot, currents(robot.parent, "run.npz", 0), "--friction", "standard", "--out", out) == 0
    return out


def test_ampere_model_says_so_in_every_file(amperes):
    """A model in amperes says so in every file."""
    metrics, dynamics = (json.loads((amperes / name).read_text()) for name in ("metrics.json", "dynamics.json"))
    assert metrics["unit"] == dynamics["unit"] and dynamics["unit"].startswith("A of joint")
    assert "torques are in amperes, scaled to joint 2" in metrics["warnings"][0] and metrics["tracking_failure"]
    units = {row["unit"] for row in csv.DictReader((amperes / "estimate.csv").open())}
    assert units and all("A" in unit.split()[0] or unit.endswith("A/(N m)") for unit in units)
    assert not {"N m", "kg m²"} & {term["unit"] for term in dynamics["terms"]}


@pytest.mark.parametrize("command", ["export", "plan", "excite"])
def test_nothing_takes_amperes_for_torques(robot, amperes, tmp_path, capsys, command):
    points = tmp_path / "points.csv"
    points.write_text("joint1,joint2,joint3\n0,0,0\n0.5,0.5,0.5\n")
    arguments = {
        "export": (amperes, "--into", tmp_path / "x"),
        "plan": (robot, "--waypoints", points, "--model", amperes, "--out", tmp_path / "x"),
        "excite": (robot, "--model", amperes, "--out", tmp_path / "x"),
    }[command]
    assert run(command, *arguments) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "state gains" in said and "[gain_identification]" in said
    assert not (tmp_path / "x").exists()


def test_currents_and_torques_do_not_mix(robot, tmp_path, capsys):
    other = planted.write(tmp_path, "torques.npz", 1)
    bare = currents(tmp_path, "bare.npz", 0)
    assert run("identify", robot, bare, "--validate", other, "--friction", "standard", "--out", tmp_path / "x") == 2
    assert "one model cannot use both" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_identified_gains_are_kept(robot, tmp_path):
    plain, loaded = currents(tmp_path, "run.npz", 0), currents(tmp_path, "load.npz", 1, payload=True)
    options, out = tmp_path / "options.toml", tmp_path / "out"
    options.write_text(
        "[payload.load]\nmass = 2.0\n[gain_identification]\nunloaded = 'run.npz'\nloaded = 'load.npz'\n"
        "[files.'load.npz']\npayload = ['load']\n"
    )
    arguments = ("--options", options, "--friction", "standard", "--out", out)
    assert run("identify", robot, plain, loaded, *arguments) == 0
    for name in ("metrics.json", "dynamics.json"):
        kept = json.loads((out / name).read_text())["drive_gains"]
        off = np.array(kept["values"]) - GAINS
        assert kept["unit"] == "N m per A" and np.all(np.abs(off) < 5 * np.array(kept["sigma"]))
    rows = list(csv.DictReader((out / "drive_gains.csv").open()))
    np.testing.assert_allclose([float(row["gain [N m per A]"]) for row in rows], kept["values"], rtol=1e-9)
    assert json.loads((out / "dynamics.json").read_text())["unit"] == "N m"
    assert {row["status"] for row in rows} == {"identified"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[coupling]]\njoints = [2, 9]", "joints 1 to 3"),
        ("[[coupling]]\njoints = [2, 2]", "coupled with itself"),
        ("[[term]]\nname = 'K'\nshape = 'sine'\njoint = 9\nsettings = [1.0, inf]", "joints 1 to 3"),
        ("gains = [0]", "finite numbers other than zero"),
        ("gains = [inf]", "finite"),
    ],
)
def test_options_that_cannot_be_are_told(robot, tmp_path, capsys, text, said):
    train, options = planted.write(tmp_path, "train.npz", 0), tmp_path / "options.toml"
    options.write_text(text)
    assert run("identify", robot, train, "--options", options, "--out", tmp_path / "out") == 2
    assert said in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ZZ1R", pytest.param("ZZ1", marks=pytest.mark.slow)])
def test_a_regrouped_parameter_has_two_names(robot, tmp_path, name):
    train, options, out = planted.write(tmp_path, "train.npz", 0), tmp_path / "options.toml", tmp_path / "out"
    options.write_text(f"drop = ['{name}']")
    assert run("identify", robot, train, "--options", options, "--friction", "standard", "--out", out) == 0
    first = json.loads((out / "metrics.json").read_text())["elimination"][0]
    assert first["name"] == "ZZ1" and first["listed"]


def test_switched_off_step_is_dropped():
    """A step whose terms the final fit switched off is dropped."""
    terms = tuple(drives.term(f"Fs{joint + 1}", "stribeck", joint, 0.1, 1.0, 0.01) for joint in (0, 1))
    step = FrictionTrial("+ stribeck", 12, 5.0, (5.0, 5.0), (1, 2), terms=("Fs1", "Fs2"))
    one = FrictionSelection(terms, (0, 1), (step,)).fitted(np.array([1e-12, 0.02]))
    assert one.off == ("Fs1",) and one.steps[0].kept_at_joints == (2,) and one.chosen == "standard + stribeck"
    none = FrictionSelection(terms, (0, 1), (step,)).fitted(np.array([1e-12, 1e-12]))
    assert not none.steps[0].kept and none.steps[0].note and none.chosen == "standard"


def test_ladder_totals_leave_out_amperes() -> None:
    """A joint in amperes of its own may have any size: no total changes with it, and that joint's own error stays."""
    case = planted.case("train", 0, noise=0.05)
    large = replace(case, target=case.target * np.array([1.0, 1.0, 1e3]))
    settings = IdentificationSettings(friction="stribeck", essential="none", prior="none", apart=(2,))
    apart = identify(planted.arm(), [large], settings).friction.steps
    mixed = identify(planted.arm(), [large], replace(settings, apart=())).friction.steps
    for own, together in zip(apart, mixed, strict=True):
        assert own.joints_percent == together.joints_percent
        assert min(own.joints_percent[:2]) <= own.cross_validated_percent <= max(own.joints_percent[:2])
        assert together.cross_validated_percent == pytest.approx(together.joints_percent[2], rel=0.01)
